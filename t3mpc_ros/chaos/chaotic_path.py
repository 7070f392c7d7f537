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
r"""Chaotic path: portraits (y_i, y_j) of system (85), mapped evenly into an arena and switched.

A portrait as such fills its arena unevenly: most of its time passes in the middle. Each state is
therefore replaced by its own distribution function,

.. math:: u_i = F_i(y_i), \qquad F_i(y) = \frac1M \sum_m \Phi_l\left(\frac{y - y_{i,m}}{h}\right),

estimated from a long run of the system (a kernel estimate with the logistic function, whose
centres are quantiles), so that each coordinate is spread evenly. Of the six pairs of states,
(2, 3), (2, 4) and (3, 4) then fill the unit square most evenly: over 400 cells the standard
deviation of the time is 0.13, 0.23 and 0.20 of its mean, against 1.2 of (1, 2), which leaves a
third of the cells almost empty.

A portrait is a smooth curve: over a few seconds the robot moves only a tenth of a Lyapunov time.
What cannot be predicted on that scale is the switching: which portrait, which of its four mirror
images, and when, drawn from the seed. Where the curve jumps, at a sudden switch or another seed,
the path is a straight line. A Gaussian window over the length rounds it, so that it stays within
a convex arena.
"""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.chaos.switching_signal import SwitchingParameters, SwitchingSchedule
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters, group, parameter

SPACING = 0.01
"""Distance of the points of the path, m."""
CENTRES = 64
"""Centres of the estimate of each distribution function."""
BANDWIDTH = 0.05
"""Width of its kernel, in standard deviations of the state."""
CALIBRATION_TIME, CALIBRATION_STEP = 200.0, 0.02
"""Run that the distribution functions are estimated from, and its sampling interval, s."""


@dataclass(frozen=True)
class PortraitParameters(Parameters):
    """Arena, switching and smoothing of the chaotic path."""

    arena: tuple[float, ...] = parameter(
        (-1.75, -1.25, 1.75, 1.25),
        'where the path lies: left, bottom, right, top, or x, y of the corners of a convex '
        'polygon, in the frame of the odometry; walls less the radius of the robot and a reserve',
        'm',
        (-1000.0, 1000.0),
    )
    switching: SwitchingParameters = group(
        SwitchingParameters,
        fixed=('kind', 'modes', 'times', 'shortest_dwell', 'longest_dwell'),
        kind='memoryless',
        modes=(2, 3, 3, 4, 4, 2, 3, 2, 4, 3, 2, 4),
        blend=2.0,
    )
    mirror: ClassVar[bool] = True
    """Draw one of the four mirror images of a portrait at each switch."""
    sample_step: ClassVar[float] = 5e-4
    """System time between two points of a portrait, s: about 1 cm apart in 4 m."""
    smoothing: float = parameter(
        0.25,
        'standard deviation of the Gaussian window over the length of the path',
        'm',
        (0.0, 1.0),
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for an impossible arena."""
        Arena(self.arena)


class PortraitPath:
    """Endless path through the portraits of one seed.

    Dwell times are those of a robot that drives steadily at ``speed`` (m/s). The seed has any
    length; 0: no perturbation.
    """

    def __init__(
        self, system: ReferenceParameters, parameters: PortraitParameters, speed: float, seed: int
    ) -> None:
        if not speed > 0.0:
            raise ValueError(f'speed must be positive: got {speed} m/s')
        self._system, self._parameters, self._speed = system, parameters, speed
        self.arena = Arena(parameters.arena)
        """Where the path lies."""
        substeps = math.ceil(parameters.sample_step / system.solver_step * (1.0 - 1e-9))
        self._substeps = max(1, substeps)
        self._solver = system.make_solver(self._solver_step)
        self._pairs = parameters.switching.pairs
        self._centres, self._widths = self._calibrate()
        reach = math.ceil(3.0 * parameters.smoothing / SPACING)
        window = np.arange(-reach, reach + 1) * SPACING
        weights = np.exp(-0.5 * (window / max(parameters.smoothing, 1e-9)) ** 2)
        self._weights = weights / weights.sum()
        self._tail = np.empty((0, 2))
        """Evenly spaced points that the next window needs."""
        self._last: Array | None = None
        """Last point of the portrait."""
        self._carried = 0.0
        """Distance from the last evenly spaced point to it, m."""
        self.reseed(seed)

    def reseed(self, seed: int) -> None:
        """Continue with the path of another seed, at first in a straight line to it.

        The seed is not published or logged.
        """
        system = self._system
        initial = np.array(system.initial)
        if seed:
            drawn = SecretRandom(seed, 'initial state').uniform(initial.size)
            initial += system.perturbation * (2.0 * drawn - 1.0)
        self._schedule = SwitchingSchedule(self._parameters.switching, seed)
        self._mirrors = SecretRandom(seed, 'mirrors')
        self._mirrored = self._mirrored_before = self._draw_mirror()
        self._switches = 0
        self._length = 0.0
        self._solver.reset(initial)
        self._solver.advance(math.ceil(system.settle / self._solver_step))

    def advance(self, length: float = 1.0) -> Array:
        """Return the next points (m), shape (n, 2), at least ``length`` m of the path."""
        needed = max(1, math.ceil(length / SPACING))
        while len(self._tail) - len(self._weights) + 1 < needed:
            self._tail = np.vstack([self._tail, self._next_points()])
        usable = len(self._tail) - len(self._weights) + 1
        smooth = np.column_stack(
            [np.convolve(column, self._weights, 'valid') for column in self._tail.T]
        )
        self._tail = self._tail[usable:]
        return smooth

    @property
    def _solver_step(self) -> float:
        return self._parameters.sample_step / self._substeps

    def _calibrate(self) -> tuple[Array, Array]:
        """Return centres, shape (CENTRES, 4), and widths, shape (4,), of the distributions.

        The run is that of the unperturbed initial state, so it depends on no seed.
        """
        solver = self._system.make_solver(CALIBRATION_STEP / 20.0)
        solver.advance(math.ceil(self._system.settle * 20.0 / CALIBRATION_STEP))
        states = np.empty((round(CALIBRATION_TIME / CALIBRATION_STEP), 4))
        for row in states:
            solver.advance(20)
            row[:] = solver.state
        shares = (np.arange(CENTRES) + 0.5) / CENTRES
        return np.quantile(states, shares, axis=0), BANDWIDTH * states.std(axis=0)

    def _evened(self, states: Array) -> Array:
        """Return the distribution functions at states of shape (n, 4)."""
        scaled = (states[:, None, :] - self._centres) / self._widths
        found: Array = 0.5 + 0.5 * np.tanh(0.5 * scaled).mean(axis=1)
        return found

    def _next_points(self) -> Array:
        """Return evenly spaced points along the next piece of the portraits."""
        states = np.empty((32, 4))
        for row in states:
            row[:] = self._solver.state
            self._solver.advance(self._substeps)
        found: list[Array] = []
        for values in self._evened(states):
            found += self._line_to(self._place(values))
        return np.array(found).reshape(-1, 2)

    def _place(self, values: Array) -> Array:
        """Return the point of the arena of the present mode, for evened states."""
        mode = self._schedule.at(self._length / self._speed)
        if mode.switches != self._switches:
            self._switches = mode.switches
            self._mirrored_before = self._mirrored
            self._mirrored = self._draw_mirror()
        place = _mirror(values[self._pair(mode.mode)], self._mirrored)
        if mode.blend < 1.0:
            before = _mirror(values[self._pair(mode.previous)], self._mirrored_before)
            place = mode.blend * place + (1.0 - mode.blend) * before
        found: Array = self.arena.from_unit_square(place[None])[0]
        return found

    def _pair(self, mode: int) -> list[int]:
        return [number - 1 for number in self._pairs[mode]]

    def _draw_mirror(self) -> NDArray[np.bool_]:
        return self._mirrors.uniform(2) < 0.5

    def _line_to(self, point: Array) -> list[Array]:
        """Return the evenly spaced points from the last point to ``point``."""
        if self._last is None:
            self._last = point
            return [point] * len(self._weights)  # the window begins at rest
        run = point - self._last
        length = math.hypot(*run)
        self._length += length
        found, at = [], SPACING - self._carried
        while at <= length:
            found.append(self._last + at / length * run)
            at += SPACING
        self._carried = length - (at - SPACING)
        self._last = point
        return found


def _mirror(values: Array, mirrored: NDArray[np.bool_]) -> Array:
    return np.where(mirrored, 1.0 - values, values)
