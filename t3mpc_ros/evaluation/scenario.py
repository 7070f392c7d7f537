# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Scenario of one simulated run: drive, noise, case, seed and reference."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.control.actuation import LimitParameters
from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel
from t3mpc_ros.evaluation.simulated_links import (
    DROPOUTS,
    JITTER,
    LINK_TEXTS,
    NO_FAULTS,
    OVERLOAD,
    LinkFaults,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.simulation.plant.disturbances import DisturbanceParameters
from t3mpc_ros.simulation.plant.paper_plant import DisturbedPlant, PaperRobotParameters

Array = NDArray[np.float64]

DRIVES = ('torque', 'velocity')
"""torque: u is applied as the torque theta_bar u, as in the paper; velocity: the wheels follow
commanded speeds with delay and lag, as on the robot."""

TUNING_SEEDS = tuple(range(1, 10))
"""Seeds for tuning."""
PRETRAINING_SEEDS = (10, 11, 12)
"""Seeds of the pretraining runs, equal for all methods with adaptation."""
PRETRAINING_NOISE, PRETRAINING_DURATION = 0.04, 40.0
"""Noise ((rad/s)²) and length (s) of those runs; the robot is the nominal one."""
HELD_OUT_SEEDS = tuple(range(101, 121))
"""Seeds of the reported results; never used for tuning."""

RATE = 100.0
"""Control periods a second in every run."""
REFERENCE_DEVIATION = 3.0
"""Standard deviation of every signal of the reference, rad/s."""
STATE_DEVIATIONS = (10.6, 2.22, 0.937, 22.2)
"""Standard deviations of the raw states of (85), measured at q = 0.98 over 10 000 s."""
CROSSING = (0.5, 0.5)
"""Time before and after a switch within which methods cross from one reference to the other, s."""
LONGEST_DEAD_TIME = 0.06
"""Dead time up to which a reference is computed beyond the end of a run, s."""
_ROBOT_SEEDS = 10_000  # robot seeds start here: no reference has one of them by accident


@dataclass(frozen=True, slots=True)
class Case:
    """Difference of the true robot of a run from the nominal one."""

    text: str
    changes: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the robot from the start, by their flat names."""
    later: Mapping[str, float] = field(default_factory=dict)
    """Parameters that change during the run."""
    when: float = 0.5
    """Time of that change, as a share of the run."""
    known: bool = False
    """Whether the estimator and the methods know of ``changes``."""
    drives: tuple[str, ...] = DRIVES
    """Drives to which the case applies."""
    links: LinkFaults = NO_FAULTS
    """Faults of the links, in whole periods; unknown to all methods."""
    reproduced: bool = True
    """Whether it belongs to the reproduction of the paper."""


CASES: Mapping[str, Case] = {
    'nominal': Case('the nominal robot with its friction and disturbance'),
    'mass +30 %': Case(
        'body mass and inertia 30 % above nominal', {'mass_factor': 1.3, 'inertia_factor': 1.3}
    ),
    'mass -30 %': Case(
        'body mass and inertia 30 % below nominal', {'mass_factor': 0.7, 'inertia_factor': 0.7}
    ),
    'friction x3': Case('three times the friction', {'friction_factor': 3.0}),
    'load change': Case(
        'at half of the run body mass and inertia rise by 30 % and friction doubles',
        later={'mass_factor': 1.3, 'inertia_factor': 1.3, 'friction_factor': 2.0},
    ),
    'disturbance': Case(
        'three times the bound of the disturbance torque',
        {'disturbance.bound': 3.0 * DisturbanceParameters().bound},
    ),
    'dead time': Case(
        'a command takes 30 ms instead of 10 ms to reach the wheels, and everyone knows it',
        {'drive.dead_time': 0.03},
        known=True,
        drives=('velocity',),
    ),
    'dead time 60 ms': Case(
        'a command takes 60 ms instead of 10 ms to reach the wheels, and everyone knows it',
        {'drive.dead_time': 0.06},
        known=True,
        drives=('velocity',),
        reproduced=False,
    ),
    'unknown dead time': Case(
        'a command takes 30 ms to reach the wheels; everyone assumes 10 ms',
        {'drive.dead_time': 0.03},
        drives=('velocity',),
        reproduced=False,
    ),
    'unknown dead time 60 ms': Case(
        'a command takes 60 ms to reach the wheels; everyone assumes 10 ms',
        {'drive.dead_time': 0.06},
        drives=('velocity',),
        reproduced=False,
    ),
    'dropouts': Case(LINK_TEXTS[DROPOUTS], links=DROPOUTS, reproduced=False),
    'jitter': Case(LINK_TEXTS[JITTER], links=JITTER, reproduced=False),
    'overload': Case(LINK_TEXTS[OVERLOAD], links=OVERLOAD, reproduced=False),
}
"""Every case by name, in the order of the tables."""


@dataclass(frozen=True, slots=True)
class SampledReference:
    """A reference sampled once a control period, and on beyond the end of the run.

    The arrays are shared by all runs that have it, and cannot be written to.
    """

    time: Array
    """s, shape (n + m,)"""
    speeds: Array
    """r, rad/s, right wheel first, shape (n + m, 2)"""
    rate: Array
    """r' without the jumps, rad/s², shape (n + m, 2); at a jump that of the new signal"""
    modes: NDArray[np.int64]
    """Active switching mode, shape (n + m,)"""
    switched: NDArray[np.bool_]
    """Whether this is the first sample of a new mode, shape (n + m,)"""


class LoopPlant(Protocol):
    """What a closed loop controls: wheels that obey torques (N m) or wheel speeds (rad/s)."""

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


@dataclass(frozen=True)
class Scenario:
    """One run without its method.

    Two scenarios with the same seed have the same reference, and the same numbers drawn for
    disturbance and noise, whatever else differs: methods and cases are compared pair by pair.

    Parameters
    ----------
    drive, case, seed
        One of :data:`DRIVES`, one of :data:`CASES`, and the seed of the reference, from which the
        robot's own is derived.
    noise
        Variance of the measured wheel speeds, (rad/s)².
    duration, lead
        s; ``lead`` is how far ahead methods with preview see the reference.
    """

    drive: str
    noise: float
    case: str
    seed: int
    duration: float = 60.0
    lead: float = 0.4

    def __post_init__(self) -> None:
        if self.drive not in DRIVES:
            raise ValueError(f'drive must be one of {", ".join(DRIVES)}: got {self.drive!r}')
        if self.case not in CASES:
            raise ValueError(f'case must be one of {", ".join(CASES)}: got {self.case!r}')
        drives = CASES[self.case].drives
        if self.drive not in drives:
            raise ValueError(
                f'drive must be {" or ".join(drives)} in case {self.case!r}: got {self.drive!r}'
            )
        check_run(
            self,
            ('noise', 0.0, 100.0, '(rad/s)²'),
            ('duration', 1.0 / RATE, 3600.0, 's'),
            ('lead', 0.0, 10.0, 's'),
        )

    def __str__(self) -> str:
        return f'{self.drive}, noise {self.noise:g}, {self.case}, seed {self.seed}'

    @property
    def steps(self) -> int:
        """Number of control periods of the run."""
        return round(self.duration * RATE)

    @property
    def change_step(self) -> int:
        """The period at whose start :meth:`changed_robot` takes over."""
        return round(CASES[self.case].when * self.steps)

    @property
    def links(self) -> LinkFaults:
        """Faults of the links between robot and controller."""
        return CASES[self.case].links

    @property
    def limits(self) -> LimitParameters:
        """Limits of a velocity command, equal in every run."""
        return LimitParameters()

    def reference(self) -> SampledReference:
        """Return the reference wheel speeds over the run and the preview beyond it."""
        beyond = math.ceil((self.lead + LONGEST_DEAD_TIME) * RATE) + 3
        return _reference(self.seed, self.steps + beyond)

    def robot(self) -> PaperRobotParameters:
        """Return the true robot, as it is when the run begins."""
        return self._nominal().with_values(
            {
                'noise.variance': float(self.noise),
                'seed': _ROBOT_SEEDS + self.seed,
                **CASES[self.case].changes,
            }
        )

    def plant(self) -> LoopPlant:
        """Return the plant of a new run."""
        return DisturbedPlant(self.robot())

    def changed_robot(self) -> PaperRobotParameters | None:
        """Return the true robot from :attr:`change_step` on; None if it does not change."""
        later = CASES[self.case].later
        return self.robot().with_values(later) if later else None

    def nominal_model(self) -> NominalModel:
        """Return the nominal model for a method."""
        return nominal_model(self.drive, self._known_robot(), self.limits)

    def estimate(self) -> SpeedFilterParameters:
        """Return the parameters of the state estimator, equal for all methods.

        The true variance of the noise, and the lag and dead time that everyone knows.
        """
        drive = self._known_robot().drive
        return SpeedFilterParameters.from_dict(
            {
                'noise_variance': float(self.noise),
                'lag': drive.lag,
                'dead_time': drive.dead_time,
            }
        )

    def _nominal(self) -> PaperRobotParameters:
        return PaperRobotParameters.from_dict({'drive.kind': self.drive, 'rate': RATE})

    def _known_robot(self) -> PaperRobotParameters:
        case, nominal = CASES[self.case], self._nominal()
        return nominal.with_values(case.changes) if case.known else nominal


def check_run(run: Any, *ranges: tuple[str, float, float, str]) -> None:
    """Raise ValueError for a bad seed, or an attribute outside its (name, low, high, unit)."""
    if isinstance(run.seed, bool) or not isinstance(run.seed, int) or run.seed < 0:
        raise ValueError(f'seed must be a whole number of at least 0: got {run.seed!r}')
    for name, low, high, unit in ranges:
        value = getattr(run, name)
        if not low <= value <= high:
            raise ValueError(f'{name} must be from {low:g} to {high:g} {unit}: got {value}')


def reference_parameters(seed: int) -> ReferenceParameters:
    """Return the defaults with every signal scaled to :data:`DEVIATION`."""
    amplitude = tuple(REFERENCE_DEVIATION / deviation for deviation in STATE_DEVIATIONS)
    return ReferenceParameters.from_dict({'rate': RATE, 'amplitude': amplitude, 'seed': seed})


def _reference(seed: int, rows: int) -> SampledReference:
    return sample_reference(reference_parameters(seed), rows)


@lru_cache(maxsize=128)  # about 0.3 MB for a run of a minute
def sample_reference(parameters: ReferenceParameters, rows: int) -> SampledReference:
    """Return the first ``rows`` samples of a reference; its rate must be :data:`RATE`."""
    chaos = ChaoticReference(parameters, WheelGeometry())
    run = SampledReference(
        time=np.arange(rows) / RATE,
        speeds=np.empty((rows, 2)),
        rate=np.empty((rows, 2)),
        modes=np.empty(rows, dtype=np.int64),
        switched=np.empty(rows, dtype=np.bool_),
    )
    for k in range(rows):
        sample = chaos.advance()
        run.speeds[k] = sample.wheels
        run.rate[k] = sample.rate
        run.modes[k] = sample.mode
        run.switched[k] = sample.switched
    for values in (run.time, run.speeds, run.rate, run.modes, run.switched):
        values.setflags(write=False)
    return run


def counted_rows(
    time: Array, switches: Array, after: float, margins: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.bool_]:
    """Return which rows of a run count: from ``after`` on, without ``margins`` about a switch.

    All in s. Margins are before a switch, where methods with preview have already left the old
    reference, and after it. Rows from a switch on whose crossing the run does not contain whole
    never count, nor those before it in which preview leaves the old reference: what that costs
    would count, and not what it gains.
    """
    counted: NDArray[np.bool_] = time >= after
    before, behind = margins
    leaving, crossed = CROSSING
    for switch in switches.tolist():
        if time.size and switch + crossed > time[-1]:
            counted &= time < switch - leaving
        counted &= (time < switch - before) | (time >= switch + behind)
    if not counted.any():
        end = time[-1] if time.size else 0.0
        raise ValueError(
            f'after and margins must leave rows of a run that ends at {end:g} s: '
            f'got {after:g} s, {before:g} s and {behind:g} s'
        )
    return counted


def switch_times(time: Array, modes: NDArray[np.int64]) -> Array:
    """Return the instants (s) of the first row of each new mode."""
    instants: Array = time[1:][np.diff(modes) != 0]
    return instants


def nominal_model(
    drive: str, robot: PaperRobotParameters, limits: LimitParameters
) -> NominalModel:
    """Return the nominal model of a robot; with a torque drive, its acceleration is unlimited."""
    velocity = drive == 'velocity'
    return NominalModel(
        drive=drive,
        period=1.0 / RATE,
        lag=robot.drive.lag,
        acceleration=isotropic_acceleration(limits, robot.geometry) if velocity else math.inf,
        robot=robot,
    )


def isotropic_acceleration(limits: LimitParameters, geometry: WheelGeometry) -> float:
    """Return the acceleration (rad/s²) that both wheels may have at once, in any direction."""
    straight = limits.linear_acceleration / geometry.wheel_radius
    turning = limits.angular_acceleration * geometry.half_separation / geometry.wheel_radius
    return min(straight, turning, limits.wheel_acceleration)
