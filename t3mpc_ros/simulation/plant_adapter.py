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
"""A plant of two wheels as a robot: no board, limits or pose, but a link that loses commands."""

from collections.abc import Mapping
from heapq import heappop, heappush
import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from t3mpc_ros.geometry.kinematics import twist_from_wheels
from t3mpc_ros.geometry.types import NANOSECONDS, Pose, State, WheelSpeeds
from t3mpc_ros.robot.interface import (
    ZERO_WHEEL_SPEEDS,
    RobotCommand,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.simulation.plant.disturbances import MeasurementNoise
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

_STATUS = RobotStatus(True, True, False, False, False)
_NO_POSE = Pose(math.nan, math.nan, math.nan)
_NO_COVARIANCE = np.full((3, 3), math.nan)


Signals = Mapping[str, Any]
"""Columns of a record by name, with their values now."""


class SimulatedRobot(Protocol):
    """What a closed loop uses of :class:`RobotInterface`, and what only a simulation knows."""

    @property
    def signals(self) -> Signals:
        """Columns of a record beside those of the state."""
        ...

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow a command; wheel speeds (rad/s), with a torque drive torques (N m)."""
        ...

    def advance(self, now_ns: int) -> RobotState:
        """Return the state at the next instant of the time grid."""
        ...


class Plant(Protocol):
    """Wheels that obey torques (N m) or wheel speeds (rad/s)."""

    @property
    def wheels(self) -> tuple[float, float]:
        """True wheel speeds chi, rad/s, right first; not finite when the plant has diverged."""
        ...

    def configure(self, parameters: PaperRobotParameters) -> None:
        """Continue with other parameters of the robot."""
        ...

    def run(self, command: tuple[float, float], count: int) -> None:
        """Integrate ``count`` steps under one command."""
        ...

    def measure(self, dt: float) -> tuple[float, float]:
        """Return the measured wheel speeds, ``dt`` seconds after the last time."""
        ...


class LinkDelay(NamedTuple):
    """What a link does to commands from ``begin`` to ``end`` (s)."""

    delay: float = 0.0  # s
    jitter: float = 0.0  # largest addition to it, s
    loss: float = 0.0  # share of the commands that is lost
    begin: float = 0.0
    end: float = math.inf


class PlantRobot:
    """A plant behind the robot interface; a command acts from the step at which it has arrived.

    A command that arrives after a later one is ignored. From ``change_ns`` on the robot is
    ``changed``; ``seed`` is that of the numbers that the link draws.
    """

    def __init__(
        self,
        plant: Plant,
        parameters: PaperRobotParameters,
        changed: PaperRobotParameters | None = None,
        change_ns: int = 0,
        link: LinkDelay | None = None,
        seed: int = 0,
    ) -> None:
        self._plant, self._parameters = plant, parameters
        self._changed, self._change_ns = changed, change_ns
        self._link = link or LinkDelay()
        self._generator = np.random.default_rng((seed, 4))
        self._in_transit: list[tuple[int, int, RobotCommand]] = []
        """A heap of (arrival, number, command); the number keeps ties in the order of sending."""
        self._sent = 0
        self._command = RobotCommand(ZERO_WHEEL_SPEEDS, -1)
        self._now_ns: int | None = None
        self.signals: Signals = {}

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Send a command: wheel speeds (rad/s), or with a torque drive torques (N m)."""
        link, arrival_ns = self._link, now_ns
        # Two numbers for each command, so that a change of loss does not shift delays.
        lost, late = self._generator.random(2).tolist()
        self._sent += 1
        if link.begin * NANOSECONDS <= now_ns < link.end * NANOSECONDS:
            if lost < link.loss:
                return ''
            arrival_ns += round((link.delay + link.jitter * late) * NANOSECONDS)
        heappush(self._in_transit, (arrival_ns, self._sent, command))
        return ''

    def advance(self, now_ns: int) -> RobotState:
        """Return the state one period after the last one; the first one at the start."""
        step, substeps = self._parameters.step, self._parameters.substeps
        if self._now_ns is None:
            measured = self._plant.measure(0.0)
        else:
            self._integrate(self._now_ns, substeps, step * NANOSECONDS)
            measured = self._plant.measure(substeps * step)
        self._now_ns = now_ns
        if self._changed is not None and now_ns >= self._change_ns:
            self._plant.configure(self._changed)
            self._changed = None
        speeds = WheelSpeeds(*measured)
        return RobotState(
            stamp_ns=now_ns,
            wheels=speeds,
            angles=WheelAngles(math.nan, math.nan),
            odometry=State(now_ns, _NO_POSE, twist_from_wheels(speeds, self._parameters.geometry)),
            covariance=_NO_COVARIANCE,
            commanded=self._command.wheels,
            status=_STATUS,
            reason='',
            true_wheels=WheelSpeeds(*self._plant.wheels),
        )

    def _integrate(self, start_ns: int, substeps: int, step_ns: float) -> None:
        """Run the steps of one period, in pieces where commands arrive."""
        done = 0
        while self._in_transit:
            # The step at or after the arrival; an instant on the grid is not the next one.
            arrival = math.ceil((self._in_transit[0][0] - start_ns) / step_ns - 1e-6)
            if arrival >= substeps:
                break
            if arrival > done:
                self._plant.run(self._command.wheels, arrival - done)
                done = arrival
            command = heappop(self._in_transit)[2]
            if command.stamp_ns > self._command.stamp_ns:
                self._command = command
        self._plant.run(self._command.wheels, substeps - done)


class NoisyPlant:
    """A plant without noise of its own, whose wheel speeds are measured with a given noise."""

    def __init__(self, plant: Plant, noise: MeasurementNoise) -> None:
        self._plant, self._noise = plant, noise
        self.configure, self.run = plant.configure, plant.run
        self._time = 0.0

    @property
    def wheels(self) -> tuple[float, float]:
        """True wheel speeds, rad/s."""
        return self._plant.wheels

    def measure(self, dt: float) -> tuple[float, float]:
        """Return the wheel speeds with noise, ``dt`` seconds after the last time."""
        self._time += dt
        right, left = self._plant.measure(dt)
        if not (math.isfinite(right) and math.isfinite(left)):
            return math.nan, math.nan
        return self._noise.measure(WheelSpeeds(right, left), self._time)
