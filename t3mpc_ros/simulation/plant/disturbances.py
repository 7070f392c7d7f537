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
"""Friction, disturbance torque and wheel speed noise: f and tau_d of (10)."""

from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from t3mpc_ros.geometry.types import Array, WheelSpeeds
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class FrictionParameters(Parameters):
    """Friction of each wheel: f of (10), which the paper includes in the disturbance."""

    viscous: float = parameter(
        2e-4, 'viscous friction torque per wheel speed', 'N m s/rad', (0.0, 10.0), dynamic=True
    )
    coulomb: float = parameter(0.004, 'Coulomb friction torque', 'N m', (0.0, 10.0), dynamic=True)
    coulomb_width: ClassVar[float] = 0.2
    """Wheel speed within which the Coulomb torque changes sign, rad/s, assumed: 76 % of it."""


@dataclass(frozen=True)
class DisturbanceParameters(Parameters):
    """A bounded torque on each wheel, tau_d of (10): assumption 2 of the paper."""

    bound: float = parameter(
        0.002, 'largest disturbance torque of a wheel', 'N m', (0.0, 10.0), dynamic=True
    )
    frequencies: tuple[float, ...] = parameter(
        (0.11, 0.37, 1.3),
        'frequencies of the sines, which have equal amplitudes',
        'Hz',
        (0.0, 100.0),
    )
    walk_share: ClassVar[float] = 0.3  # part of the bound that a random walk uses, assumed
    walk_rate: float = parameter(
        0.5,
        'standard deviation of the walk after one second, relative to its part of the bound',
        '1/√s',
        (0.0, 100.0),
        dynamic=True,
    )


@dataclass(frozen=True)
class NoiseParameters(Parameters):
    """White noise on the measured wheel speeds."""

    variance: float = parameter(
        0.0,
        'variance of a measured wheel speed; the paper adds 0.04 and sweeps 0 to 0.1',
        '(rad/s)²',
        (0.0, 100.0),
        dynamic=True,
    )


class FrictionConstants(NamedTuple):
    """Friction of a wheel, for kernels."""

    viscous: float  # N m s/rad
    coulomb: float  # N m
    width: float  # rad/s


class DisturbanceSignals(NamedTuple):
    """Disturbance torques of both wheels, for kernels."""

    bound: float  # N m
    walk_share: float  # part of the bound used by the walk
    angular: Array  # angular frequencies of the sines, rad/s, shape (n,)
    phases: Array  # phases of each wheel, rad, shape (2, n)
    walk: Array  # random walk of each wheel, in [-1, 1], shape (2,)


def friction_constants(parameters: FrictionParameters, factor: float) -> FrictionConstants:
    """Return the constants of a wheel with ``factor`` times both kinds of friction."""
    return FrictionConstants(
        factor * parameters.viscous, factor * parameters.coulomb, parameters.coulomb_width
    )


@kernel
def friction_torque(speed: float, viscous: float, coulomb: float, width: float) -> float:
    """Return the friction torque (N m) that opposes a wheel speed (rad/s): f of (10).

    tanh in place of the sign keeps the dynamics smooth and the friction dissipative.
    """
    return viscous * speed + coulomb * math.tanh(speed / width)


@kernel
def disturbance_torque(wheel: int, time: float, signals: DisturbanceSignals) -> float:
    """Return tau_d of one wheel (N m) at ``time`` (s); never more than the bound in size."""
    sines = 0.0
    for index in range(signals.angular.size):
        sines += math.sin(signals.angular[index] * time + signals.phases[wheel, index])
    sines /= max(signals.angular.size, 1)
    share = signals.walk_share
    # The clamp removes rounding errors only.
    level = min(max((1.0 - share) * sines + share * signals.walk[wheel], -1.0), 1.0)
    return float(signals.bound * level)


class Disturbance:
    """Random part of the disturbance torque of a run.

    The generator is its own, so that other random numbers do not shift these; a change of the
    parameters takes effect at the next :meth:`draw`.
    """

    def __init__(self, parameters: DisturbanceParameters, generator: np.random.Generator) -> None:
        self.parameters = parameters
        angular = 2.0 * np.pi * np.array(parameters.frequencies, dtype=np.float64)
        phases = generator.uniform(0.0, 2.0 * np.pi, (2, angular.size))
        self._signals = DisturbanceSignals(
            parameters.bound, parameters.walk_share, angular, phases, np.zeros(2)
        )
        self._generator = generator
        self._drawn: Array = np.zeros(2)

    @property
    def signals(self) -> DisturbanceSignals:
        """Argument of :func:`disturbance_torque`."""
        if self.parameters.bound != self._signals.bound:
            self._signals = self._signals._replace(bound=self.parameters.bound)
        return self._signals

    @property
    def walk(self) -> Array:
        """Random walk of each wheel, shape (2,), in [-1, 1]."""
        return self._signals.walk

    def draw(self, dt: float) -> None:
        """Advance the walk of both wheels by ``dt`` seconds; it is reflected at -1 and 1.

        Two numbers are drawn whatever the parameters, so that a change does not shift later
        numbers.
        """
        self._generator.standard_normal(out=self._drawn)
        step = self.parameters.walk_rate * math.sqrt(dt)
        for wheel in (0, 1):
            self.walk[wheel] = reflect(float(self.walk[wheel] + step * self._drawn[wheel]))

    def torque(self, time: float) -> tuple[float, float]:
        """Return the torques (N m) on the right and left wheel at ``time`` (s)."""
        signals = self.signals
        return disturbance_torque(0, time, signals), disturbance_torque(1, time, signals)


def reflect(value: float) -> float:
    """Return ``value`` reflected at -1 and 1 into [-1, 1]."""
    unfolded = (value + 1.0) % 4.0
    return 1.0 - abs(unfolded - 2.0)


class MeasurementNoise(Protocol):
    """Noise of measured wheel speeds; :class:`SpeedNoise` is one."""

    def measure(self, wheels: WheelSpeeds, time: float) -> WheelSpeeds:
        """Return wheel speeds (rad/s) with noise at a time (s)."""


class SpeedNoise:
    """White noise of measured wheel speeds; same arguments as :class:`Disturbance`."""

    def __init__(self, parameters: NoiseParameters, generator: np.random.Generator) -> None:
        self.parameters = parameters
        self._generator = generator
        self._drawn: Array = np.zeros(2)

    def measure(self, wheels: WheelSpeeds, time: float = 0.0) -> WheelSpeeds:
        """Return ``wheels`` with noise. Two numbers are drawn, even at zero variance."""
        self._generator.standard_normal(out=self._drawn)
        spread = math.sqrt(self.parameters.variance)
        right, left = self._drawn.tolist()
        return WheelSpeeds(wheels.right + spread * right, wheels.left + spread * left)
