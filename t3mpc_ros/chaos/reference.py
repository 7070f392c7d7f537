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
"""Reference wheel speeds: scaled, slowed and switched hyperchaos, equation (85) with E6.

The raw states of (85) change by some 25 standard deviations per second, which no wheel can follow.
The reference is therefore y(kappa t) with a time scale kappa much below 1, times an amplitude per
signal; only then does Assumption 3 of the paper hold, that the outputs can reach the reference.
"""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from t3mpc_ros.chaos.solver import FractionalSolver
from t3mpc_ros.chaos.switching_signal import SwitchingParameters, SwitchingSchedule
from t3mpc_ros.chaos.system_equations import hyperchaotic_system
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import Array, BodyTwist, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter


@dataclass(frozen=True)
class ReferenceParameters(Parameters):
    """Solution of system (85), and its conversion to wheel speeds."""

    rate: float = parameter(100.0, 'samples per second', 'Hz', (1.0, 10000.0))
    output: str = parameter(
        'wheels',
        'wheels: the two signals are the speeds of right and left wheel; '
        'body: they are v and omega, multiplied by the two scales',
        choices=('wheels', 'body'),
        source='paper: wheels',
    )
    orders: tuple[float, ...] = parameter(
        (0.98, 0.98, 0.98, 0.98),
        'Caputo order q of each state',
        bounds=(0.5, 1.0),
        source='paper (85)',
    )
    time_scale: float = parameter(
        0.05,
        'kappa: seconds of system time per second. States 1 to 4 move 25, 29, 31 and 11 standard '
        'deviations per system second (measured at q = 0.98); with the default amplitudes 0.05 '
        'gives wheel accelerations of 3.5, 4.1, 4.3 and 1.5 rad/s² rms, and 99 % of the power '
        'below 0.7 Hz',
        bounds=(1e-4, 1.0),
    )
    amplitude: tuple[float, ...] = parameter(
        (0.26, 1.25, 3.0, 0.125),
        'wheel speed per unit of each state. Standard deviations measured at q = 0.98 over '
        '10 000 s: 10.6, 2.22, 0.937, 22.2; so each signal has 2.8 rad/s, peaks of 8 rad/s per '
        'minute and of 13 rad/s per day',
        'rad/s',
    )
    offset: tuple[float, ...] = parameter(
        (0.0, 0.0, 4.79, 0.0),
        'subtracted from each state: its mean, measured at q = 0.98; states 1, 2 and 4 '
        'have mean 0 by the symmetry of (85)',
    )
    linear_scale: float = parameter(
        0.025, 'output body: v per rad/s of the first signal', 'm', (-1.0, 1.0)
    )
    angular_scale: float = parameter(
        0.33, 'output body: omega per rad/s of the second signal', bounds=(-20.0, 20.0)
    )
    initial: tuple[float, ...] = parameter(
        (1.0, 1.0, 1.0, 1.0), 'initial state of (85)', bounds=(-30.0, 30.0)
    )
    seed: int = parameter(
        0,
        'seed of the initial perturbation and of random switching; 0: no perturbation',
        bounds=(0, None),
    )
    perturbation: ClassVar[float] = 0.5
    """Maximum perturbation of each initial state by a seed, assumed."""
    settle: float = parameter(
        20.0,
        'system time simulated before the first sample, to reach the attractor',
        's',
        (0.1, 10000.0),
    )
    solver_step: ClassVar[float] = 1e-3
    """Maximum solver step in system time, s, assumed; one sample is a whole number of steps."""
    memory_horizon: ClassVar[float] = 1e5
    """System time over which the memory kernel is within its tolerance, s: 23 days at the default
    time scale."""
    memory_tolerance: ClassVar[float] = 1e-8
    """Relative error of the memory kernel, assumed."""
    ramp: float = parameter(
        3.0, 'duration of the smooth increase from zero, for a robot at rest', 's', (0.0, 600.0)
    )
    switching: SwitchingParameters = group(SwitchingParameters)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` when a list does not have one value per state."""
        for name in ('orders', 'amplitude', 'offset', 'initial'):
            values = getattr(self, name)
            if len(values) != 4:
                raise ParameterError(f'{name} must have four values: got {len(values)}')

    def make_solver(self, step: float) -> FractionalSolver:
        """Return the solver of (85) with a step in seconds of system time."""
        return FractionalSolver(
            hyperchaotic_system(orders=self.orders),
            step,
            np.array(self.initial),
            self.memory_horizon,
            self.memory_tolerance,
        )

    def initial_state(self, seed: int) -> Array:
        """Return the initial state of a seed of any length, shape (4,)."""
        if seed < 0:
            raise ValueError('seed must not be negative')  # without its value, which is secret
        initial = np.array(self.initial)
        if seed:
            # Independent of the schedule's stream: public dwell times must not reveal this one.
            generator = np.random.default_rng((seed, 1))
            initial += generator.uniform(-self.perturbation, self.perturbation, initial.size)
        return initial

    @property
    def steps_per_sample(self) -> int:
        """Number of solver steps per sample."""
        longest = self.time_scale / (self.rate * self.solver_step)
        # The margin prevents an additional step when rounding increases a whole ratio.
        return max(1, math.ceil(longest * (1.0 - 1e-9)))

    @property
    def step(self) -> float:
        """Solver step, in seconds of system time."""
        return self.time_scale / (self.rate * self.steps_per_sample)


@dataclass(frozen=True, slots=True)
class ReferenceSample:
    """Reference at one instant of the grid n / rate."""

    index: int
    elapsed: float
    """s since the first sample"""
    wheels: WheelSpeeds
    """rad/s"""
    rate: WheelSpeeds
    """rad/s², time derivative of ``wheels``; at a sudden switch that of the new signal alone"""
    twist: BodyTwist
    """m/s and rad/s, equation (1)"""
    mode: int
    """index of the active mode"""
    selected: tuple[int, int]
    """numbers, from 1, of the signals at the first and the second output"""
    switched: bool
    """whether this is the first sample of a new mode"""
    states: tuple[float, float, float, float]
    """y1 ... y4 of (85), raw"""


class ChaoticReference:
    """Generates the samples of the switching chaotic reference."""

    def __init__(self, parameters: ReferenceParameters, geometry: WheelGeometry) -> None:
        self._parameters = parameters
        self._geometry = geometry
        self._seed = parameters.seed
        self._solver = parameters.make_solver(parameters.step)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Restart at the first sample, with another seed if one is given.

        The seed may have any length: with 128 random bits a run cannot be predicted. The seed is
        not published or logged.
        """
        seed = self._seed if seed is None else seed
        initial = self._parameters.initial_state(seed)
        self._seed = seed
        self._schedule = SwitchingSchedule(self._parameters.switching, self._seed)
        self._solver.reset(initial)
        self._solver.advance(math.ceil(self._parameters.settle / self._parameters.step))
        self._index = 0
        self._switches = 0

    def advance(self) -> ReferenceSample:
        """Return the next sample; the first one after a reset has index 0."""
        parameters = self._parameters
        if self._index:
            self._solver.advance(parameters.steps_per_sample)
        elapsed = self._index / parameters.rate
        states = self._solver.state
        signals = np.array(parameters.amplitude) * (states - np.array(parameters.offset))
        # reference(t) = y(kappa t), so d/dt is kappa times the rate in system time.
        rates = parameters.time_scale * np.array(parameters.amplitude) * self._solver.rate
        mode = self._schedule.at(elapsed)
        selected = self._schedule.pairs[mode.mode]
        active = np.array(selected) - 1
        before = np.array(self._schedule.pairs[mode.previous]) - 1
        weight = mode.blend
        value = (1.0 - weight) * signals[before] + weight * signals[active]
        slope = (1.0 - weight) * rates[before] + weight * rates[active]
        slope += mode.blend_rate * (signals[active] - signals[before])
        grown, growth = self._growth(elapsed)
        wheels = self._wheels(grown * value)
        sample = ReferenceSample(
            self._index,
            elapsed,
            wheels,
            self._wheels(grown * slope + growth * value),
            twist_from_wheels(wheels, self._geometry),
            mode.mode,
            selected,
            mode.switches != self._switches,
            tuple(states.tolist()),
        )
        self._index += 1
        self._switches = mode.switches
        return sample

    def _growth(self, elapsed: float) -> tuple[float, float]:
        """Return the ramp's factor of the reference and its derivative (1/s)."""
        if elapsed >= self._parameters.ramp:
            return 1.0, 0.0
        x = elapsed / self._parameters.ramp
        return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / self._parameters.ramp

    def _wheels(self, outputs: Array) -> WheelSpeeds:
        """Return the wheel speeds, or their rates, of the two outputs; a linear map."""
        first, second = outputs.tolist()
        if self._parameters.output == 'wheels':
            return WheelSpeeds(first, second)
        return wheels_from_twist(
            BodyTwist(
                self._parameters.linear_scale * first, self._parameters.angular_scale * second
            ),
            self._geometry,
        )
