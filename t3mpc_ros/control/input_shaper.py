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
r"""Input shaper: a reference that does not excite the oscillation of the rotors.

A stepper's rotor hangs on its field like a mass on a spring. Straight motion and turning have
different inertias, so the mean of both wheels and half of their difference oscillate each with its
own frequency, 14.6 and 9.1 Hz for the default robot. Two impulses of one half, half a period of
the oscillation apart, cancel each other's response (zero-vibration shaper; Singer and Seering
1990, doi 10.1115/1.2894142). With a known future they stand before and after the instant,

.. math:: \bar r_s(t) = \tfrac12\left(\bar r(t + d) + \bar r(t - d)\right), \qquad d = 1/(4f),

so the shaper has no delay: its response cos(2 pi f_r d) is zero at f_r = f and real everywhere.
At low frequencies it is 1 - 1.23 (f_r/f)², close to 1 - (f_r/f)², the inverse of the oscillator.
The impulses are positive: a reference within limits of speed and acceleration remains within.
"""

from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

HIGHEST = 1000.0  # largest frequency, Hz
EARLY = 0.6  # share of the period before which an odometry is too early for a step


@dataclass(frozen=True)
class InputShaperParameters(Parameters):
    """Frequencies that the command does not excite."""

    straight_frequency: float = parameter(
        14.6,
        'frequency at which the robot oscillates along its path, sqrt(k/J)/(2 pi) with the '
        'stiffness k of a motor and the inertia J that it accelerates; 0: none',
        'Hz',
        (0.0, HIGHEST),
        source='motor and body of the default robot',
    )
    turning_frequency: float = parameter(
        9.1,
        'frequency at which the robot oscillates in yaw; 0: none',
        'Hz',
        (0.0, HIGHEST),
        source='motor and body of the default robot',
    )

    @property
    def delays(self) -> tuple[float, float]:
        """Time d (s) of the impulses before and after the instant: straight, turning."""
        straight, turning = self.straight_frequency, self.turning_frequency
        return (
            0.25 / straight if straight > 0.0 else 0.0,
            0.25 / turning if turning > 0.0 else 0.0,
        )


class InputShaper:
    """Shapes the reference of both wheels; it needs the reference :attr:`lead` in advance.

    parameters : frequencies; both 0: the reference is unchanged and the lead is 0
    period : control period, s
    """

    def __init__(self, parameters: InputShaperParameters, period: float) -> None:
        self._period = period
        self._delays = np.array(parameters.delays) / period
        latest = float(self._delays.max())
        self._ahead = math.ceil(latest - 1e-9) + 1 if latest > 0.0 else 0
        self.lead_ns = round(self._ahead * period * NANOSECONDS)
        """Time by which the reference of :meth:`step` is ahead of the shaped one, ns."""
        self._planned: Array = np.zeros((math.ceil(2 * self._ahead / EARLY) + 2, 3))
        self.reset(np.zeros(2))
        self.reference: Array = np.zeros(2)  # shaped reference at the instant, rad/s, shape (2,)
        self.rate: Array = np.zeros(2)  # its derivative until one period later, rad/s², shape (2,)

    def retune(self, parameters: InputShaperParameters) -> None:
        """Use other frequencies; lower ones as far as the lead allows, which is kept."""
        most = max(self._ahead - 1.0, 0.0)
        self._delays[:] = np.minimum(np.array(parameters.delays) / self._period, most)

    def reset(self, speeds: Array) -> None:
        """Start at wheel speeds (rad/s), shape (2,), held up to now and for the lead."""
        self._planned[:, 0] = 0.5 * (speeds[0] + speeds[1])
        self._planned[:, 1] = 0.5 * (speeds[0] - speeds[1])
        self._planned[:, 2] = np.arange(len(self._planned))

    def step(self, planned: Array, elapsed: float) -> None:
        """Update the shaped reference by the reachable one (rad/s) one lead later.

        Between steps, ``elapsed`` s apart, the reference is interpolated.
        """
        shape(
            self._planned,
            planned,
            round(elapsed / self._period, 6),  # 1 at regular stamps, in whole nanoseconds
            self._ahead,
            self._delays,
            self._period,
            self.reference,
            self.rate,
        )


@kernel
def shape(
    rows: Array,
    planned: Array,
    elapsed: float,
    ahead: int,
    delays: Array,
    period: float,
    reference: Array,
    rate: Array,
) -> None:
    """Append a row, and write the shaped reference (rad/s) and its rate of change (rad/s²).

    ``rows``, shape (n, 3), are newest first: mean of the wheels, half their difference, age.
    Ages, the ``delays`` d and the time ``elapsed`` since the last row are in periods.
    """
    for j in range(rows.shape[0] - 1, 0, -1):
        rows[j, 0], rows[j, 1] = rows[j - 1, 0], rows[j - 1, 1]
        rows[j, 2] = rows[j - 1, 2] + elapsed
    rows[0, 0] = 0.5 * (planned[0] + planned[1])
    rows[0, 1] = 0.5 * (planned[0] - planned[1])
    mean, half = shaped_row(rows, float(ahead), delays)
    reference[0], reference[1] = mean + half, mean - half
    mean, half = shaped_row(rows, ahead - 1.0, delays)
    rate[0] = (mean + half - reference[0]) / period
    rate[1] = (mean - half - reference[1]) / period


@kernel
def shaped_row(rows: Array, age: float, delays: Array) -> tuple[float, float]:
    """Return the shaped columns of ``rows`` at an age."""
    mean = row_at(rows, 0, age - delays[0]) + row_at(rows, 0, age + delays[0])
    half = row_at(rows, 1, age - delays[1]) + row_at(rows, 1, age + delays[1])
    return 0.5 * mean, 0.5 * half


@kernel
def row_at(rows: Array, column: int, age: float) -> float:
    """Return a column of ``rows`` at an age, linearly interpolated between two rows."""
    first = 0
    while first < rows.shape[0] - 2 and rows[first + 1, 2] <= age:
        first += 1
    fraction = (age - rows[first, 2]) / (rows[first + 1, 2] - rows[first, 2])
    return float((1.0 - fraction) * rows[first, column] + fraction * rows[first + 1, column])
