# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Which samples of a run count, and which of them are *settled*; see docs/metrics.md.

The one definition, for simulated runs and for those in bags.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array

START = 3.0
"""Time of control at the start that no metric counts, s: the reference grows from zero. Of a run
of less than twice this time, its first half."""
CROSSING = (0.5, 0.5)
"""Time before and after a switch within which methods cross from one reference to the other, s."""


class SettlingWindow(NamedTuple):
    """Time about a switch in which a robot is not settled, s."""

    before: float
    """With preview it leaves the old reference so much earlier."""
    after: float


EVERYTHING = SettlingWindow(0.0, 0.0)
"""No window: what happens at switches counts."""
PLANT_WINDOW = SettlingWindow(0.4, 0.6)
"""Of the paper's plant, whose wheels do not ring."""
ROBOT_WINDOW = SettlingWindow(0.5, 1.0)
"""Of every robot with a body: the twin, a real one, and any in a bag."""


def counted_from(begin: float, end: float) -> float:
    """Return from when on samples count in a run that is controlled from begin to end, s."""
    return begin + min(START, 0.5 * (end - begin))


def counted_rows(
    time: Array,
    switches: Array,
    after: float,
    end: float,
    window: tuple[float, float] = EVERYTHING,
) -> NDArray[np.bool_]:
    """Return which samples count: from ``after`` to ``end``, outside ``window`` about switches.

    All in s. With the :class:`SettlingWindow` of the robot these are the *settled* samples. Those
    from a switch on whose crossing the run does not contain whole never count, nor those before it
    in which preview leaves the old reference: what that costs would count, and not what it gains.
    """
    rows: NDArray[np.bool_] = (time >= after) & (time <= end)
    before, behind = window
    leaving, crossed = CROSSING
    for switch in switches.tolist():
        rows &= (time < switch - before) | (time >= switch + behind)
        if switch + crossed > end:
            rows &= time < switch - leaving
    return rows
