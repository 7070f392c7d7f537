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
"""Robots, plants and noise of a script."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from t3mpc_ros.control.velocity_actuation import LimitParameters
from t3mpc_ros.evaluation.api.one_sentence_errors import described, one_sentence
from t3mpc_ros.evaluation.api.own_reference import numbers
from t3mpc_ros.geometry.types import Array, WheelSpeeds, read_only
from t3mpc_ros.mpc.pretraining import matrix_exponential
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

DRIVES = ('velocity', 'torque')
LONGEST_DEAD_TIME = 0.4
"""Upper bound of a dead time, s."""


@dataclass(frozen=True)
class Robot:
    """A differential-drive robot by its geometry, lag and limits: the servo plant (10) with them.

    Parameters
    ----------
    wheel_radius, wheel_separation
        m
    lag, dead_time
        Time constant of the wheel speed servo, and time before a command reaches it, s. The dead
        time is whole control periods.
    linear_velocity, angular_velocity, wheel_velocity
        Limits of the command, m/s, rad/s and rad/s of a wheel; None for those of the package's
        robot.
    linear_acceleration, angular_acceleration, wheel_acceleration
        The same in m/s², rad/s² and rad/s².
    parameters
        Other parameters of the plant by name, such as ``{'friction.coulomb': 0.01}``.
    """

    wheel_radius: float = 0.035
    wheel_separation: float = 0.147
    lag: float = 0.02
    dead_time: float = 0.01
    linear_velocity: float | None = None
    angular_velocity: float | None = None
    wheel_velocity: float | None = None
    linear_acceleration: float | None = None
    angular_acceleration: float | None = None
    wheel_acceleration: float | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @one_sentence
    def __post_init__(self) -> None:
        if not 0.0 <= self.dead_time <= LONGEST_DEAD_TIME:
            raise ScriptError(
                f'dead_time must be from 0 to {LONGEST_DEAD_TIME:g} s: got {self.dead_time}'
            )
        self.plant_parameters()
        self.limits()

    def plant_parameters(self, drive: str = 'velocity') -> PaperRobotParameters:
        """Return the parameters of the plant."""
        own = {
            'drive.kind': drive,
            'wheel_radius': self.wheel_radius,
            'wheel_separation': self.wheel_separation,
            'drive.lag': self.lag,
            'drive.dead_time': self.dead_time,
        }
        return PaperRobotParameters.from_dict({**own, **self.parameters})

    def limits(self) -> LimitParameters:
        """Return the limits of the command."""
        given = {
            'linear.x.max_velocity': self.linear_velocity,
            'angular.z.max_velocity': self.angular_velocity,
            'wheel.max_velocity': self.wheel_velocity,
            'linear.x.max_acceleration': self.linear_acceleration,
            'angular.z.max_acceleration': self.angular_acceleration,
            'wheel.max_acceleration': self.wheel_acceleration,
            'wheel.deadband_velocity': 0.0,  # it has no steps
        }
        return LimitParameters.from_dict({k: v for k, v in given.items() if v is not None})


@dataclass(frozen=True, eq=False)
class OdePlant:
    """A plant of one's own as an ordinary differential equation x' = f(t, x, u).

    It is integrated by the classical Runge-Kutta method with steps of 1 ms, u constant in each.

    Parameters
    ----------
    right_hand_side
        f: gets t (s), x, shape (states,), and u, shape (2,); returns x', shape (states,).
    states
        Number of states.
    output
        Wheel speeds (rad/s), right first, of a state; by default its first two entries.
    drive
        What u is: ``'velocity'``, commanded wheel speeds (rad/s), or ``'torque'``, torques
        (N m) that the nominal inertia of ``robot`` makes of accelerations.
    initial
        x at the start; zeros by default.
    robot
        What the controllers assume: geometry, lag, limits and dead time. The dead time is that of
        the plant too.
    """

    right_hand_side: Callable[[float, Array, Array], Any]
    states: int = 2
    output: Callable[[Array], Any] | None = None
    drive: str = 'velocity'
    initial: ArrayLike | None = None
    robot: Robot = field(default_factory=Robot)

    @one_sentence
    def __post_init__(self) -> None:
        if isinstance(self.states, bool) or not (
            isinstance(self.states, int) and self.states >= 1
        ):
            raise ScriptError(f'states must be a whole number, at least 1: got {self.states!r}')
        if self.output is None and self.states < 2:
            raise ScriptError('output must be given for a plant of one state: got None')
        self.simulation()

    @property
    def name(self) -> str:
        """Name in errors."""
        return str(getattr(self.right_hand_side, '__name__', 'right_hand_side'))

    def simulation(self) -> 'OwnSimulation':
        """Return the plant at its start, after one call of each function."""
        advanced = partial(self._advanced, plant_parameters(self).step)
        found = OwnSimulation(self, self.states, advanced, self._wheels)
        self._slope(0.0, found.state, np.zeros(2))
        self._wheels(0.0, found.state)
        return found

    def _advanced(self, h: float, t: float, x: Array, u: Array) -> Array:
        first = self._slope(t, x, u)
        second = self._slope(t + 0.5 * h, x + 0.5 * h * first, u)
        third = self._slope(t + 0.5 * h, x + 0.5 * h * second, u)
        fourth = self._slope(t + h, x + h * third, u)
        return x + h / 6.0 * (first + 2.0 * (second + third) + fourth)

    def _slope(self, time: float, state: Array, u: Array) -> Array:
        found = _called(time, 'right_hand_side', self.right_hand_side, time, state, u)
        if found.shape != state.shape:
            raise ScriptError(
                f'{self.name} must return {state.size} numbers, one for each state: got the shape '
                f'{found.shape}'
            )
        return found

    def _wheels(self, time: float, state: Array) -> Array:
        if self.output is None:
            return state[:2]
        found = _called(time, 'output', self.output, state)
        if found.shape != (2,):
            raise ScriptError(f'output must return two wheel speeds: got the shape {found.shape}')
        return found


def _called(time: float, what: str, function: Callable[..., Any], *arguments: Any) -> Array:
    """Return what a function of the plant makes of arguments; it cannot write their arrays."""
    given = [read_only(each) if isinstance(each, np.ndarray) else each for each in arguments]
    try:
        return np.array(function(*given), dtype=np.float64)
    except Exception as error:
        raise ScriptError(
            f'{what} of the plant raised {described(error)}, at {time:.3f} s'
        ) from None


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A linear plant of one's own: x' = A x + B u, wheel speeds = C x.

    It is exact at the control periods: u is constant in each.

    Parameters
    ----------
    A, B, C
        Shapes (n, n), (n, 2) and (2, n), in units of s; the wheel speeds are in rad/s.
    drive, initial, robot
        As for :class:`OdePlant`.
    """

    A: ArrayLike
    B: ArrayLike
    C: ArrayLike
    drive: str = 'velocity'
    initial: ArrayLike | None = None
    robot: Robot = field(default_factory=Robot)
    name: ClassVar[str] = 'state space'  # in errors

    @one_sentence
    def __post_init__(self) -> None:
        self.simulation()

    def simulation(self) -> 'OwnSimulation':
        """Return the plant at its start."""
        a, b, output = (numbers(name, getattr(self, name), 'of a matrix') for name in 'ABC')
        for name, matrix in zip('ABC', (a, b, output), strict=True):
            if matrix.ndim != 2:
                raise ScriptError(f'{name} must be a matrix: got the shape {matrix.shape}')
        size = len(a)
        for name, matrix, shape in (
            ('A', a, (size, size)),
            ('B', b, (size, 2)),
            ('C', output, (2, size)),
        ):
            if matrix.shape != shape:
                raise ScriptError(f'{name} must have the shape {shape}: got {matrix.shape}')
        both = np.zeros((size + 2, size + 2))
        both[:size] = np.hstack([a, b]) * plant_parameters(self).step
        held = matrix_exponential(both)
        transition, driven = held[:size, :size], held[:size, size:]
        return OwnSimulation(
            self, size, lambda _, x, u: transition @ x + driven @ u, lambda _, x: output @ x
        )


def plant_parameters(plant: OdePlant | StateSpace) -> PaperRobotParameters:
    """Return the parameters of the robot that controllers assume of a plant."""
    if plant.drive not in DRIVES:
        raise ScriptError(f'drive must be one of {", ".join(DRIVES)}: got {plant.drive!r}')
    return plant.robot.plant_parameters(plant.drive)


class OwnSimulation:
    """State of a plant of one's own, behind its dead time.

    ``advanced`` gets time (s), state and u, and returns the state a step later; ``output`` gets
    time and state, and returns the wheel speeds (rad/s).
    """

    def __init__(
        self,
        plant: OdePlant | StateSpace,
        size: int,
        advanced: Callable[[float, Array, Array], Array],
        output: Callable[[float, Array], Array],
    ) -> None:
        self._advanced, self._output = advanced, output
        self.state = np.zeros(size)
        if plant.initial is not None:
            self.state = numbers('initial', plant.initial, f'({size},)')
        if self.state.shape != (size,):
            raise ScriptError(f'initial must have the shape ({size},): got {self.state.shape}')
        parameters = plant_parameters(plant)
        self.step = parameters.step
        delay = parameters.drive.dead_time if plant.drive == 'velocity' else 0.0
        self._waiting = [np.zeros(2)] * round(delay / self.step)
        self._steps = 0

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._steps * self.step

    @property
    def wheels(self) -> tuple[float, float]:
        """Wheel speeds, rad/s, right first; NaN once the state is not finite."""
        if not np.isfinite(self.state).all():
            return math.nan, math.nan
        right, left = self._output(self.time, self.state).tolist()
        return right, left

    def configure(self, parameters: PaperRobotParameters) -> None:
        """Keep the plant: it has no parameters of the package's robot."""

    def run(self, command: tuple[float, float], count: int) -> None:
        """Integrate ``count`` steps under one command, which acts after the dead time."""
        sent = np.array(command)
        with np.errstate(all='ignore'):  # a plant that diverges ends the run
            for _ in range(count):
                self._waiting.append(sent)
                if np.isfinite(self.state).all():
                    self.state = self._advanced(self.time, self.state, self._waiting[0])
                del self._waiting[0]
                self._steps += 1

    def measure(self, dt: float) -> tuple[float, float]:
        """Return the wheel speeds, rad/s: the noise is added outside."""
        return self.wheels


@dataclass(frozen=True)
class NoiseLaw:
    """Noise of the measured wheel speeds by a law of one's own.

    Parameters
    ----------
    draw
        Gets a generator (:class:`numpy.random.Generator`), the time (s) and the true wheel speeds
        (rad/s, shape (2,)); returns what is added to them, shape (2,).
    variance
        What the estimator of every method assumes, (rad/s)².
    """

    draw: Callable[[np.random.Generator, float, Array], Any]
    variance: float

    @one_sentence
    def __post_init__(self) -> None:
        if not callable(self.draw):
            raise ScriptError(
                f'draw must be a function of generator, time and speeds: got {self.draw!r}'
            )
        if not (isinstance(self.variance, int | float) and 0.0 <= self.variance <= 100.0):
            raise ScriptError(f'variance must be from 0 to 100 (rad/s)²: got {self.variance!r}')

    def simulation(self, seed: int) -> 'LawNoise':
        """Return the noise of a run."""
        return LawNoise(self.draw, np.random.default_rng((seed, 5)))


class LawNoise(NamedTuple):
    """Noise of a run, drawn by a law."""

    draw: Callable[[np.random.Generator, float, Array], Any]
    generator: np.random.Generator

    def measure(self, wheels: WheelSpeeds, time: float) -> WheelSpeeds:
        """Return wheel speeds (rad/s) with noise at a time (s)."""
        time, true = round(time, 9), np.array(wheels)  # a law may compare the time
        try:
            drawn = self.draw(self.generator, time, read_only(true))
            noise = np.asarray(drawn, dtype=np.float64)
        except Exception as error:
            raise ScriptError(
                f'the noise law raised {described(error)}, at {time:.2f} s'
            ) from None
        if noise.shape != (2,) or not np.isfinite(noise).all():
            raise ScriptError(
                f'the noise law must return two finite numbers: got {noise} at {time:.2f} s'
            )
        return WheelSpeeds(*(true + noise).tolist())


def gaussian_noise(variance: float) -> NoiseLaw:
    """Return the law of white noise with a variance in (rad/s)²."""
    return NoiseLaw(partial(_white_noise, math.sqrt(variance)), variance)


def _white_noise(deviation: float, generator: np.random.Generator, *_: object) -> Array:
    return deviation * generator.standard_normal(2)
