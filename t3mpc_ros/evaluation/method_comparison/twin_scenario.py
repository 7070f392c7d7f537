# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Scenario of one run on the digital twin, and a baseline as its controller."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.control.actuation import LimitParameters, VelocityActuation
from t3mpc_ros.control.controller import ControllerParameters
from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController, NominalModel
from t3mpc_ros.evaluation.closed_loop import MethodLoop, observed_reference
from t3mpc_ros.evaluation.scenario import (
    RATE,
    SampledReference,
    check_run,
    nominal_model,
    sample_reference,
)
from t3mpc_ros.evaluation.simulated_links import (
    DROPOUTS,
    JITTER,
    LINK_TEXTS,
    NO_FAULTS,
    OVERLOAD,
    LinkFaults,
)
from t3mpc_ros.evaluation.twin_closed_loop import LEAD, loop_controller, loop_robot
from t3mpc_ros.geometry.kinematics import wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, State, wrap_angle
from t3mpc_ros.parameters.table import nearest_hint
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultEvent, FaultSchedule
from t3mpc_ros.simulation.plant.disturbances import DisturbanceParameters, MeasurementNoise
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

SHORTEST, LONGEST = 2.0, 3600.0
"""Bounds of the duration of a run, s."""
PATCHES = Path(__file__).with_name('patches.yaml')
"""World with slippery patches."""


@dataclass(frozen=True, slots=True)
class TwinCase:
    """Difference of the true robot and its links from what every method assumes."""

    text: str
    robot: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the robot from the start."""
    load_change: float = 0.0
    """Mass added to the body at half of the run, kg."""
    links: LinkFaults = NO_FAULTS
    """Faults of the links; unknown to all methods."""
    assumed_dead_time: float = 0.01
    """Dead time that every method assumes, s."""
    gyro: bool = False
    """Whether the baselines take the yaw rate from the odometry with its gyro."""


CASES: Mapping[str, TwinCase] = {
    'nominal': TwinCase('the default twin'),
    'miscalibrated': TwinCase(
        'wheel radii +2 % and -1 %, track +3 %, slippery patches, 30 % more mass and inertia with '
        'the centre of mass 6 cm ahead of the axle instead of 2 cm',
        {
            'right_wheel_radius_multiplier': 1.02,
            'left_wheel_radius_multiplier': 0.99,
            'wheel_separation_multiplier': 1.03,
            'world': str(PATCHES),
            'mass_factor': 1.3,
            'inertia_factor': 1.3,
            'body.com_offset': 0.06,
        },
        gyro=True,
    ),
    'friction x3': TwinCase('three times the friction', {'friction_factor': 3.0}),
    'disturbance': TwinCase(
        'three times the bound of the disturbance torque',
        {'disturbance.bound': 3.0 * DisturbanceParameters().bound},
    ),
    'load change': TwinCase('at half of the run 1 kg is added to the body', load_change=1.0),
    'dead time': TwinCase(
        'a command takes 30 ms instead of 10 ms, and every method knows it',
        {'drive.dead_time': 0.03},
        assumed_dead_time=0.03,
    ),
    'dead time 60 ms': TwinCase(
        'a command takes 60 ms instead of 10 ms, and every method knows it',
        {'drive.dead_time': 0.06},
        assumed_dead_time=0.06,
    ),
    'unknown dead time': TwinCase(
        'a command takes 30 ms; every method assumes 10 ms', {'drive.dead_time': 0.03}
    ),
    'unknown dead time 60 ms': TwinCase(
        'a command takes 60 ms; every method assumes 10 ms', {'drive.dead_time': 0.06}
    ),
    'dropouts': TwinCase(LINK_TEXTS[DROPOUTS], links=DROPOUTS),
    'jitter': TwinCase(LINK_TEXTS[JITTER], links=JITTER),
    'overload': TwinCase(LINK_TEXTS[OVERLOAD], links=OVERLOAD),
}
"""Every case by name, in the order of the tables."""


@dataclass(frozen=True)
class TwinScenario:
    """One run on the twin without its method.

    The reference is that of ``scripts/demo`` with the seed, which is also the robot's. Scenarios
    with equal seeds have equal references, and equal numbers drawn for noise and disturbance.

    Parameters
    ----------
    case, seed
        One of :data:`CASES`, and the seed of reference and robot.
    duration
        s; the robot stands for the first 1.5 s.
    noise
        Variance of the measured wheel speeds, (rad/s)², which every method knows.
    gyro
        Whether the baselines take the yaw rate from the odometry with its gyro in every case.
    """

    case: str
    seed: int
    duration: float = 60.0
    noise: float = 0.04
    gyro: bool = False

    def __post_init__(self) -> None:
        check_name('case', self.case, CASES)
        check_run(self, ('noise', 0.0, 100.0, '(rad/s)²'), ('duration', SHORTEST, LONGEST, 's'))

    def __str__(self) -> str:
        return f'twin, noise {self.noise:g}, {self.case}, seed {self.seed}'

    @property
    def uses_gyro(self) -> bool:
        """Whether the baselines take the yaw rate from the odometry with its gyro."""
        return self.gyro or CASES[self.case].gyro

    @property
    def fault_span(self) -> tuple[float, float] | None:
        """Begin and end (s) of what does not last for the whole run; None without."""
        case = CASES[self.case]
        if case.load_change:
            return 0.5 * self.duration, math.inf
        return self.links.span(self.duration) if self.links.begin else None

    @property
    def links(self) -> LinkFaults:
        """Faults of the links between robot and controller."""
        return CASES[self.case].links

    @property
    def limits(self) -> LimitParameters:
        """Limits of the command, equal for all methods."""
        return self.controller_parameters().limits

    def reference(self) -> SampledReference:
        """Return the reference over the run and the preview beyond it."""
        parameters = ReferenceParameters.from_dict({'rate': RATE, 'seed': self.seed})
        return sample_reference(parameters, round((self.duration + LEAD) * RATE) + 1)

    def robot(self) -> DigitalTwinParameters:
        """Return the true robot."""
        return loop_robot(seed=self.seed).with_values(
            {'noise.variance': float(self.noise), **CASES[self.case].robot}
        )

    def speed_noise(self) -> MeasurementNoise | None:
        """Return the noise of the wheel speeds; None for white noise."""
        return None

    def schedule(self) -> FaultSchedule:
        """Return the faults of robot and command link."""
        case, links = CASES[self.case], self.links
        begin, _ = links.span(self.duration)
        least, most = links.command_delay
        values = {
            'command_loss': links.command_loss,
            'command_delay': least,
            'command_jitter': most - least,
        }
        events = [
            FaultEvent(begin, name, value, links.lasting)
            for name, value in values.items()
            if value
        ]
        if case.load_change:
            events.append(FaultEvent(0.5 * self.duration, 'load_change', case.load_change))
        return FaultSchedule(events, self.case)

    def controller_parameters(self) -> ControllerParameters:
        """Return the parameters of the controller node for the twin, with the known values."""
        return loop_controller().with_values(
            {
                'speed_filter.noise_variance': float(self.noise),
                'speed_filter.dead_time': CASES[self.case].assumed_dead_time,
            }
        )

    def estimate(self) -> SpeedFilterParameters:
        """Return the parameters of the state estimator, equal for all methods."""
        return self.controller_parameters().speed_filter

    def nominal_model(self) -> NominalModel:
        """Return the nominal model for a baseline: a servo with the lag that the node assumes.

        It has no friction: a stepper motor that loses no step keeps its speed under load.
        """
        estimate = self.estimate()
        robot = PaperRobotParameters.from_dict(
            {
                'drive.kind': 'velocity',
                'drive.lag': estimate.lag,
                'drive.dead_time': estimate.dead_time,
                'friction.viscous': 0.0,
                'friction.coulomb': 0.0,
                'rate': RATE,
            }
        )
        return nominal_model('velocity', robot, self.limits)


def check_name(kind: str, name: str, known: Mapping[str, object]) -> None:
    """Raise ValueError, with the nearest name, when ``name`` is not known."""
    if name not in known:
        hint = nearest_hint(name, known)
        raise ValueError(f'{kind} must be one of {", ".join(known)}: got {name!r}{hint}')


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BaselineStatus:
    """Status of one step."""

    stamp_ns: int
    reason: Reason


class TwinBaseline:
    """Drives the twin with a baseline, behind the state estimate and limits of the controller.

    It has no watchdog. A lost report is bridged by the estimator, as in the controller.
    """

    def __init__(
        self, method: Callable[[NominalModel], BaselineController], scenario: TwinScenario
    ) -> None:
        self._method = method
        self._model = scenario.nominal_model()
        self._geometry = self._model.robot.geometry
        self._uses_gyro = scenario.uses_gyro
        self._actuation = VelocityActuation(
            scenario.estimate(),
            scenario.limits,
            self._geometry,
            'velocity',
            self._model.period,
        )
        self._scenario = scenario
        self._enabled = True
        self._loop: MethodLoop | None = None
        self._last: tuple[int, float] = (0, 0.0)
        """Period and yaw of the last report."""

    def enable(self, on: bool) -> None:
        """Enable the robot's motion, or stop the robot."""
        self._enabled = on

    def add_reference(self, reference: State) -> bool:
        """Ignore the sample: the scenario has the reference."""
        return True

    def step(self, odometry: State) -> tuple[BodyTwist, BaselineStatus]:
        """Return the command that follows from a report of the robot."""
        stamp_ns = odometry.stamp_ns
        if not self._enabled:
            self._loop = None
            return STANDSTILL, BaselineStatus(stamp_ns, Reason.DISABLED)
        k = round(stamp_ns * RATE / NANOSECONDS)
        if self._loop is None:
            measured = self._measured(odometry, math.nan)
            self._actuation.reset(measured)
            self._loop = self._new_loop()
        else:
            measured = self._measured(odometry, (k - self._last[0]) * self._model.period)
        self._last = k, odometry.pose.yaw
        self._loop.send(self._loop.step(k, measured))
        return self._actuation.twist, BaselineStatus(stamp_ns, Reason.TRACKING)

    def _new_loop(self) -> MethodLoop:
        controller, dead_time = self._method(self._model), self._actuation.dead_time
        # What a reference with this lead has made known at the stamp of the report.
        rows = round((LEAD - dead_time) * RATE) + 1
        steps = round(self._scenario.duration * RATE)
        reference = observed_reference(
            self._scenario.reference(), steps, rows, dead_time, preview=controller.preview
        )
        return MethodLoop(controller, self._actuation, self._model.period, reference)

    def _measured(self, odometry: State, dt: float) -> Array:
        """Return the measured wheel speeds, rad/s, shape (2,).

        With the gyro, their difference is that of the yaw rate of the odometry's pose.
        """
        twist = odometry.twist
        if self._uses_gyro and not math.isnan(dt):
            turned = wrap_angle(odometry.pose.yaw - self._last[1])
            twist = BodyTwist(twist.linear, turned / dt)
        return np.array(wheels_from_twist(twist, self._geometry))
