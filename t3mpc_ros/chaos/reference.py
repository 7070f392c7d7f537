# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reference wheel speeds: scaled, slowed and switched hyperchaos, equation (85) with E6."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.solver import FractionalSolver
from t3mpc_ros.chaos.switching import SwitchingParameters, SwitchingSchedule
from t3mpc_ros.chaos.system import hyperchaotic_system
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter


@dataclass(frozen=True)
class ReferenceParameters(Parameters):
    """How system (85) becomes wheel speeds."""

    rate: float = parameter(100.0, 'samples per second', unit='Hz', low=1.0, high=10000.0)
    output: str = parameter(
        'wheels',
        'wheels: the two signals are the speeds of right and left wheel; '
        'body: they drive v and omega through the two scales',
        choices=('wheels', 'body'),
        source='paper: wheels',
    )
    orders: tuple[float, ...] = parameter(
        (0.98, 0.98, 0.98, 0.98),
        'Caputo order q of each state',
        low=0.5,
        high=1.0,
        source='paper (85)',
    )
    time_scale: float = parameter(
        0.05,
        'kappa: seconds of system time per second. States 1 to 4 move 25, 29, 31 and 11 standard '
        'deviations per system second (measured at q = 0.98); with the default amplitudes 0.05 '
        'gives wheel accelerations of 3.5, 4.1, 4.3 and 1.5 rad/s² rms, and 99 % of the power '
        'below 0.7 Hz',
        low=1e-4,
        high=1.0,
    )
    amplitude: tuple[float, ...] = parameter(
        (0.26, 1.25, 3.0, 0.125),
        'wheel speed per unit of each state. Standard deviations measured at q = 0.98 over '
        '10 000 s: 10.6, 2.22, 0.937, 22.2; so each signal has 2.8 rad/s, peaks of 8 rad/s in a '
        'minute and of 13 rad/s in a day',
        unit='rad/s',
    )
    offset: tuple[float, ...] = parameter(
        (0.0, 0.0, 4.79, 0.0),
        'subtracted from each state first: its mean, measured at q = 0.98; states 1, 2 and 4 '
        'have mean 0 by the symmetry of (85)',
    )
    linear_scale: float = parameter(
        0.025,
        'output body: v per rad/s of the first signal',
        unit='m',
        low=-1.0,
        high=1.0,
    )
    angular_scale: float = parameter(
        0.33, 'output body: omega per rad/s of the second signal', low=-20.0, high=20.0
    )
    initial: tuple[float, ...] = parameter(
        (1.0, 1.0, 1.0, 1.0), 'state of (85) at which its memory begins', low=-30.0, high=30.0
    )
    seed: int = parameter(
        0, 'perturbs the initial state and draws random switching; 0: initial as given', low=0
    )
    perturbation: float = parameter(
        0.5, 'largest change of each initial state by the seed', low=1e-9, high=5.0
    )
    settle: float = parameter(
        20.0,
        'system time run before the first sample, to land on the attractor',
        unit='s',
        low=0.1,
        high=10000.0,
    )
    solver_step: float = parameter(
        1e-3,
        'longest solver step in system time; a whole number of steps makes one sample',
        unit='s',
        low=1e-6,
        high=2e-3,
    )
    memory_horizon: float = parameter(
        1e5,
        'system time over which the memory kernel keeps its tolerance; '
        'divided by the time scale, 23 days at the defaults',
        unit='s',
        low=10.0,
        high=1e9,
    )
    memory_tolerance: float = parameter(
        1e-8, 'relative error of the memory kernel', low=1e-12, high=1e-3
    )
    ramp: float = parameter(
        3.0,
        'time over which the reference grows smoothly from zero, for a robot at rest',
        unit='s',
        low=0.0,
        high=600.0,
    )
    switching: SwitchingParameters = group(SwitchingParameters)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` when a list does not have one value per state."""
        for name in ('orders', 'amplitude', 'offset', 'initial'):
            values = getattr(self, name)
            if len(values) != 4:
                raise ParameterError(f'{name} must have four values: got {len(values)}')

    @property
    def steps_per_sample(self) -> int:
        """How many solver steps make one sample."""
        longest = self.time_scale / (self.rate * self.solver_step)
        # The margin keeps a ratio that is whole but for rounding from taking one step more.
        return max(1, math.ceil(longest * (1.0 - 1e-9)))

    @property
    def step(self) -> float:
        """The solver step taken, in seconds of system time."""
        return self.time_scale / (self.rate * self.steps_per_sample)


@dataclass(frozen=True, slots=True)
class ReferenceSample:
    """The motion wanted at one instant of the grid n / rate."""

    index: int
    elapsed: float
    """s since the first sample"""
    wheels: WheelSpeeds
    """rad/s"""
    rate: WheelSpeeds
    """rad/s², time derivative of ``wheels``; at a sudden jump that of the new signal alone"""
    twist: BodyTwist
    """m/s and rad/s, equation (1)"""
    mode: int
    """index of the active mode"""
    selected: tuple[int, int]
    """the signals, from 1, that drive the first and the second output"""
    switched: bool
    """whether this is the first sample of a new mode"""
    states: tuple[float, float, float, float]
    """y1 ... y4 of (85), raw"""


class ChaoticReference:
    """Gives one sample after the other of the switching chaotic reference.

    Parameters
    ----------
    settings
        System, scaling and switching.
    geometry
        Turns wheel speeds into the body twist and back.
    """

    def __init__(self, parameters: ReferenceParameters, geometry: WheelGeometry) -> None:
        self._parameters = parameters
        self._geometry = geometry
        self._seed = parameters.seed
        self._solver = FractionalSolver(
            hyperchaotic_system(orders=parameters.orders),
            parameters.step,
            np.array(parameters.initial),
            parameters.memory_horizon,
            parameters.memory_tolerance,
        )
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Start again from the first sample, with another seed if one is given.

        The seed may be of any length: with 128 bits from the operating system a run cannot be
        guessed beforehand. It is kept nowhere but here.

        Raises
        ------
        ValueError
            A negative seed.
        """
        if seed is not None and seed < 0:
            raise ValueError('seed must not be negative')  # and must not be printed either
        self._seed = self._seed if seed is None else seed
        initial = np.array(self._parameters.initial)
        if self._seed:
            bound = self._parameters.perturbation
            # A stream apart from the schedule's: dwells that all can see must not tell this.
            generator = np.random.default_rng((self._seed, 1))
            initial += generator.uniform(-bound, bound, initial.size)
        self._schedule = SwitchingSchedule(self._parameters.switching, self._seed)
        self._solver.reset(initial)
        self._solver.advance(math.ceil(self._parameters.settle / self._parameters.step))
        self._index = 0
        self._switches = 0

    def advance(self) -> ReferenceSample:
        """Return the next sample; the first one after a reset has index 0.

        Raises
        ------
        FloatingPointError
            The solution of (85) has left the finite numbers.
        """
        parameters = self._parameters
        if self._index:
            self._solver.advance(parameters.steps_per_sample)
        elapsed = self._index / parameters.rate
        states = self._solver.state
        signals = np.array(parameters.amplitude) * (states - np.array(parameters.offset))
        # reference(t) = y(kappa t), so d/dt is kappa times the rate in system time.
        rates = parameters.time_scale * np.array(parameters.amplitude) * self._solver.rate
        selection = self._schedule.at(elapsed)
        selected = self._schedule.pairs[selection.mode]
        active = np.array(selected) - 1
        before = np.array(self._schedule.pairs[selection.previous]) - 1
        share = selection.blend
        value = (1.0 - share) * signals[before] + share * signals[active]
        slope = (1.0 - share) * rates[before] + share * rates[active]
        slope += selection.blend_rate * (signals[active] - signals[before])
        grown, growth = self._growth(elapsed)
        wheels = self._wheels(grown * value)
        sample = ReferenceSample(
            self._index,
            elapsed,
            wheels,
            self._wheels(grown * slope + growth * value),
            twist_from_wheels(wheels, self._geometry),
            selection.mode,
            selected,
            selection.switches != self._switches,
            tuple(states.tolist()),
        )
        self._index += 1
        self._switches = selection.switches
        return sample

    def _growth(self, elapsed: float) -> tuple[float, float]:
        """Return the ramp's share of the full reference and its derivative (1/s)."""
        if elapsed >= self._parameters.ramp:
            return 1.0, 0.0
        x = elapsed / self._parameters.ramp
        return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / self._parameters.ramp

    def _wheels(self, outputs: NDArray[np.float64]) -> WheelSpeeds:
        """Return wheel speeds (or their rates) of the two outputs; linear, so it serves both."""
        first, second = outputs.tolist()
        if self._parameters.output == 'wheels':
            return WheelSpeeds(first, second)
        return wheels_from_twist(
            BodyTwist(
                self._parameters.linear_scale * first, self._parameters.angular_scale * second
            ),
            self._geometry,
        )
