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
"""Errors that robots are known to reach, by robot and conditions, and the bound of a good run."""

from collections.abc import Mapping
from typing import NamedTuple

from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters

MAX_RATIO = 3.0
"""A settled RMSE of more than so many times the known one is not that of a good run. Single seeds
change it by a quarter (docs/results.md), a busy machine that loses no sample by less than 2 times
(0.0215 rad/s in bench/frozen/demo.mcap); one that stalls, by 9 times."""


class KnownResult(NamedTuple):
    """A settled RMSE that a robot reaches."""

    robot: str
    """Its name in a sentence."""
    parameters: Mapping[str, Mapping[str, str]]
    """Recorded parameters by node that make the robot and the task."""
    settled: float
    """The larger one of both wheels, rad/s."""
    source: str


_SIGNALS = {'reference_generator': {'source': 'signals', 'output': 'wheels'}}
KNOWN_RESULTS: tuple[KnownResult, ...] = (
    KnownResult(
        'digital twin',
        {'sim_robot': {'drive.kind': 'stepper', 'world': ''}, **_SIGNALS},
        0.012,
        'README.md: 60 s of scripts/demo, noise variance 0.04 (rad/s)²',
    ),
)
"""Of the parameters that are not named those of the twin must have their defaults, but for
:data:`FREE`."""
MAX_NOISE = 0.04
"""Largest variance of the measured wheel speeds of the known results, (rad/s)²."""
FREE = ('seed', 'noise.variance', 'drive.kind', 'world')
"""Parameters of the twin that may differ from their defaults, or are named."""


def known_result(records: Mapping[str, Mapping[str, str]]) -> KnownResult | None:
    """Return what the recorded robot is known to reach under these conditions, if anything.

    ``records`` are the recorded parameters by node.
    """
    twin = records.get('sim_robot', {})
    defaults = {
        name: _recorded(value) for name, value in DigitalTwinParameters().to_dict().items()
    }
    for name, value in twin.items():
        if name in defaults and name not in FREE and value != defaults[name]:
            return None
    try:
        if float(twin.get('noise.variance', '0')) > MAX_NOISE:
            return None
    except ValueError:
        return None
    for known in KNOWN_RESULTS:
        if all(
            records.get(node, {}).get(name) == value
            for node, values in known.parameters.items()
            for name, value in values.items()
        ):
            return known
    return None


def _recorded(value: object) -> str:
    """Return a value as a recorder writes it."""
    return str(list(value)) if isinstance(value, tuple) else str(value)
