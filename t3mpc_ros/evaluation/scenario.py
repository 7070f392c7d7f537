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
"""Scenario of one simulated run: all that it depends on but its driver, as plain data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.control.controller import ControllerParameters, StepperControllerParameters
from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters
from t3mpc_ros.control.velocity_actuation import LimitParameters
from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel
from t3mpc_ros.evaluation.cases import CASES, NOMINAL, ROBOTS, Case, LinkFaults, cases_for
from t3mpc_ros.evaluation.run_record import PLANT_WINDOW, RATE, ROBOT_WINDOW, stamp_of
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import ParameterError, find_names
from t3mpc_ros.simulation import plant_adapter
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.fault_schedule import FaultEvent, FaultSchedule, load_schedule
from t3mpc_ros.simulation.plant.disturbances import MeasurementNoise
from t3mpc_ros.simulation.plant.paper_plant import PaperPlant, PaperRobotParameters

TUNING_SEEDS = tuple(range(1, 10))
"""Seeds for tuning."""
PRETRAINING_SEEDS = (10, 11, 12)
"""Seeds of the pretraining runs, equal for all methods with adaptation."""
PRETRAINING_NOISE, PRETRAINING_DURATION = 0.04, 40.0
"""Noise ((rad/s)²) and length (s) of those runs; the robot is the nominal one."""
HELD_OUT_SEEDS = tuple(range(101, 121))
"""Seeds of the reported results; never used for tuning."""

PLANT_OF = {'velocity': 'servo', 'torque': 'torque'}
"""Robots with the paper's plant by their drive."""
LEAD = 0.4
"""Lead of the reference over the odometry, s."""
LONGEST_DEAD_TIME = 0.06
"""Dead time up to which a reference is computed beyond the end of a run, s."""
LONGEST = 3600.0
"""Upper bound of the duration of a run, s."""
REFERENCE_DEVIATION = 3.0
"""Standard deviation of every signal of the reference of the paper's plant, rad/s."""
STATE_DEVIATIONS = (10.6, 2.22, 0.937, 22.2)
"""Standard deviations of the raw states of (85), measured at q = 0.98 over 10 000 s."""
_PLANT_SEEDS = 10_000  # seeds of the plant start here: no reference has one of them by accident


def held_out(seeds: Sequence[int]) -> tuple[int, ...]:
    """Return seeds that nothing was tuned or trained on; ValueError for others."""
    if not seeds or not {*seeds} <= {*HELD_OUT_SEEDS}:
        raise ValueError(
            f'seeds must be of {HELD_OUT_SEEDS[0]}-{HELD_OUT_SEEDS[-1]}, on which nothing was '
            f'tuned or trained: got {", ".join(map(str, seeds)) or "none"}'
        )
    return tuple(seeds)


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

    def __post_init__(self) -> None:
        for values in (self.time, self.speeds, self.rate, self.modes, self.switched):
            values.setflags(write=False)


class PlantSource(Protocol):
    """A plant of a script, as plain data."""

    def simulation(self) -> plant_adapter.Plant:
        """Return the plant at its start, without noise."""


class NoiseSource(Protocol):
    """Noise of a script, as plain data."""

    def simulation(self, seed: int) -> MeasurementNoise:
        """Return the noise of a run."""


@dataclass(frozen=True, eq=False)
class OwnParts:
    """What a script puts in place of the parts of a scenario."""

    reference: SampledReference | None = None
    links: LinkFaults | None = None
    events: Sequence[FaultEvent] = ()
    """Further faults of the twin."""
    noise: NoiseSource | None = None
    """Noise of the wheel speeds."""
    nominal: PaperRobotParameters | None = None
    """The robot that the methods assume, in place of the paper's."""
    limits: LimitParameters | None = None
    plant: PlantSource | None = None
    """``noise`` is given with it."""
    robot_parameters: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the true robot, unknown to all methods."""
    assumed: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the parameters of the node on the twin, from which all methods have the lag, the
    dead time and the noise of the drive."""
    pauses: Sequence[tuple[float, float]] = ()
    """Times at which a person disables and re-enables the driver, s."""
    text: str = ''
    """What the robot is, in words."""


NO_PARTS = OwnParts()


@dataclass(frozen=True)
class Scenario:
    """One run without its driver.

    Two scenarios with the same robot and seed have the same reference, and the same numbers drawn
    for disturbance and noise, whatever else differs: methods and cases are compared pair by pair.

    """

    robot: str
    """One of :data:`ROBOTS`."""
    case: str
    seed: int
    """Of reference and robot."""
    duration: float = 60.0
    """s; the twin stands for the first 1.5 s."""
    noise: float = 0.04
    """Variance of the measured wheel speeds, (rad/s)², which every method knows."""
    gyro: bool = False
    """Whether the baselines take the yaw rate from the odometry with its gyro in every case."""
    own: OwnParts = NO_PARTS

    def __post_init__(self) -> None:
        (robot,) = find_names('robot', [self.robot], ROBOTS)
        object.__setattr__(self, 'robot', robot)
        (case,) = find_names('case', [self.case], self.known_cases)
        object.__setattr__(self, 'case', case)
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f'seed must be a whole number of at least 0: got {self.seed!r}')
        for name, low, high, unit in (
            ('noise', 0.0, 100.0, '(rad/s)²'),
            ('duration', self.kind.shortest, LONGEST, 's'),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f'{name} must be from {low:g} to {high:g} {unit}: got {value}')
        if self.gyro and not self.kind.has_gyro:
            raise ValueError(f'gyro is for the twin alone: got robot {self.robot}')

    def __str__(self) -> str:
        return f'{self.robot}, noise {self.noise:g}, {self.case}, seed {self.seed}'

    @property
    def kind(self) -> 'RobotKind':
        """What is particular to the robot."""
        return KINDS[self.robot]

    @property
    def text(self) -> str:
        """What the robot is, in words."""
        return self.own.text or self.kind.text

    @property
    def known_cases(self) -> tuple[str, ...]:
        """Cases that its robot can have; a plant of a script has the nominal one alone."""
        return cases_for(self.robot) if self.own.plant is None else (NOMINAL,)

    @property
    def parts(self) -> Case:
        """The case itself."""
        return CASES[self.case]

    @property
    def steps(self) -> int:
        """Number of control periods of the run."""
        return round(self.duration * RATE)

    @property
    def links(self) -> LinkFaults:
        """Faults of the links between robot and driver."""
        return self.parts.links if self.own.links is None else self.own.links

    @property
    def fault_span(self) -> tuple[float, float] | None:
        """Begin and end (s) of what does not last for the whole run; None without."""
        if self.parts.later:
            return 0.5 * self.duration, math.inf
        return self.links.span(self.duration) if self.links.begin else None

    @property
    def uses_gyro(self) -> bool:
        """Whether the baselines take the yaw rate from the odometry with its gyro."""
        return self.gyro or self.parts.gyro

    @property
    def limits(self) -> LimitParameters:
        """Limits of the command, equal for all methods."""
        return self.own.limits or self.kind.limits(self)

    def reference(self) -> SampledReference:
        """Return the reference wheel speeds over the run and the preview beyond it."""
        if self.own.reference is not None:
            return self.own.reference
        beyond = math.ceil((LEAD + LONGEST_DEAD_TIME) * RATE) + 3
        return sample_reference(self.kind.reference_parameters(self.seed), self.steps + beyond)

    def estimate(self) -> SpeedFilterParameters:
        """Return the parameters of the state estimator, equal for all methods.

        The true variance of the noise, and the lag and dead time that everyone knows.
        """
        return self.kind.estimate(self)

    def nominal_model(self) -> NominalModel:
        """Return the model that every method gets; with a torque drive nothing is limited."""
        robot = self.kind.assumed_robot(self)
        geometry, limits, acceleration = robot.geometry, self.limits, math.inf
        if self.kind.drive == 'velocity':  # what both wheels may have at once, in any direction
            straight = limits.linear_acceleration / geometry.wheel_radius
            turning = (
                limits.angular_acceleration * geometry.half_separation / geometry.wheel_radius
            )
            acceleration = min(straight, turning, limits.wheel_acceleration)
        return NominalModel(self.kind.drive, 1.0 / RATE, robot.drive.lag, acceleration, robot)

    def true_robot(self) -> PaperRobotParameters:
        """Return the true robot, as it is when the run begins."""
        return self.kind.true_robot(self).with_values(self.own.robot_parameters)

    def simulation(self) -> plant_adapter.SimulatedRobot:
        """Return the robot of a new run."""
        return self.kind.simulation(self)


class RobotKind:
    """What is particular to the paper's plant as a robot, see :data:`ROBOTS`."""

    start = 0.0
    """Standstill before the run, s."""
    settling = PLANT_WINDOW
    """Time before and after each switch that the settled errors leave out, s."""
    shortest = 1.0 / RATE
    """Lower bound of the duration of a run, s."""
    has_gyro = False
    mean_speeds = False
    """Whether a measured speed is the mean over the last period, as from counters of steps."""

    def __init__(self, text: str, drive: str) -> None:
        self.text, self.drive = text, drive
        self.tuned_for = drive
        """Name under which the parameters tuned for it are stored."""

    def reference_parameters(self, seed: int) -> ReferenceParameters:
        """Return the defaults with every signal scaled to :data:`REFERENCE_DEVIATION`."""
        amplitude = tuple(REFERENCE_DEVIATION / deviation for deviation in STATE_DEVIATIONS)
        return ReferenceParameters.from_dict({'rate': RATE, 'amplitude': amplitude, 'seed': seed})

    def controller_parameters(self, scenario: Scenario) -> ControllerParameters:
        """Return the parameters of the controller of the node, which needs a robot with a pose."""
        raise ValueError(f'the controller of the node drives the twin alone: got {scenario}')

    def limits(self, scenario: Scenario) -> LimitParameters:
        """Return the limits of a velocity command, equal in every run; a servo has no steps."""
        return LimitParameters(deadband=0.0)

    def assumed_robot(self, scenario: Scenario) -> PaperRobotParameters:
        """Return the robot that methods assume, without factors, disturbance and noise."""
        nominal = self._nominal(scenario)
        case = scenario.parts
        return nominal.with_values(case.changes) if case.known else nominal

    def estimate(self, scenario: Scenario) -> SpeedFilterParameters:
        """Return the parameters of the state estimator."""
        drive = self.assumed_robot(scenario).drive
        values = {'lag': drive.lag, 'dead_time': drive.dead_time}
        return SpeedFilterParameters.from_dict({'noise_variance': float(scenario.noise), **values})

    def preview_rows(self, dead_time: float) -> int:
        """Return how many periods of the reference preview gives, from the dead time (s) on."""
        return round(LEAD * RATE)

    def true_robot(self, scenario: Scenario) -> PaperRobotParameters:
        """Return the true robot, but for the changes of a script."""
        return self._nominal(scenario).with_values(
            {
                'noise.variance': float(scenario.noise),
                'seed': _PLANT_SEEDS + scenario.seed,
                **scenario.parts.changes,
            }
        )

    def simulation(self, scenario: Scenario) -> plant_adapter.SimulatedRobot:
        """Return the robot of a new run."""
        parameters, own = scenario.true_robot(), scenario.own
        plant: plant_adapter.Plant
        if own.noise is None:
            plant = PaperPlant(parameters)
        else:
            quiet = parameters.with_values({'noise.variance': 0.0})
            inner = PaperPlant(quiet) if own.plant is None else own.plant.simulation()
            plant = plant_adapter.NoisyPlant(inner, own.noise.simulation(parameters.seed))
        later = scenario.parts.later.get(scenario.robot)
        links = scenario.links
        least, most = links.command_delay
        return plant_adapter.PlantRobot(
            plant,
            parameters,
            parameters.with_values(later) if later else None,
            stamp_of(round(0.5 * scenario.steps)),
            plant_adapter.LinkDelay(
                least, most - least, links.command_loss, *links.span(scenario.duration)
            ),
            scenario.seed,
        )

    def _nominal(self, scenario: Scenario) -> PaperRobotParameters:
        if scenario.own.nominal is not None:
            return scenario.own.nominal
        return PaperRobotParameters.from_dict({'drive.kind': self.drive, 'rate': RATE})


class TwinKind(RobotKind):
    """What is particular to the digital twin; its reference is that of ``scripts/demo``."""

    start = 1.5  # odometry uses the gyro only after a standstill of this length
    settling = ROBOT_WINDOW
    shortest = 2.0
    has_gyro = True
    mean_speeds = True

    def __init__(self, text: str) -> None:
        super().__init__(text, 'velocity')
        self.tuned_for = 'twin'

    def reference_parameters(self, seed: int) -> ReferenceParameters:
        """Return the defaults of the node with a seed."""
        return ReferenceParameters.from_dict({'rate': RATE, 'seed': seed})

    def controller_parameters(self, scenario: Scenario) -> ControllerParameters:
        """Return the parameters of the controller node for the twin, with the known values."""
        dead_time = scenario.parts.changes.get('drive.dead_time') if scenario.parts.known else None
        values = {} if dead_time is None else {'speed_filter.dead_time': dead_time}
        robot = scenario.true_robot()
        assert isinstance(robot, DigitalTwinParameters)
        stated = max(robot.odometry.gyro_scale_tolerance, robot.imu.gyro_scale_error)
        return StepperControllerParameters().with_values(
            {
                'speed_filter.noise_variance': float(scenario.noise),
                'body.gyro_scale_tolerance': stated,
                **values,
                **scenario.own.assumed,
            }
        )

    def limits(self, scenario: Scenario) -> LimitParameters:
        """Return those of the controller."""
        return self.controller_parameters(scenario).limits

    def estimate(self, scenario: Scenario) -> SpeedFilterParameters:
        """Return those of the controller."""
        return self.controller_parameters(scenario).speed_filter

    def assumed_robot(self, scenario: Scenario) -> PaperRobotParameters:
        """Return a servo with the lag that the node assumes.

        It has no friction: a stepper motor that loses no step keeps its speed under load.
        """
        estimate = self.estimate(scenario)
        return PaperRobotParameters.from_dict(
            {
                'drive.kind': 'velocity',
                'drive.lag': estimate.lag,
                'drive.dead_time': estimate.dead_time,
                'friction.viscous': 0.0,
                'friction.coulomb': 0.0,
                'rate': RATE,
            }
        )

    def preview_rows(self, dead_time: float) -> int:
        """Return what a reference with this lead has made known at the stamp of a report."""
        return round((LEAD - dead_time) * RATE) + 1

    def true_robot(self, scenario: Scenario) -> DigitalTwinParameters:
        """Return the true robot, but for the changes of a script."""
        return noisy_twin(seed=scenario.seed).with_values(
            {'noise.variance': float(scenario.noise), **scenario.parts.changes}
        )

    def simulation(self, scenario: Scenario) -> plant_adapter.SimulatedRobot:
        """Return the robot of a new run."""
        parameters = scenario.true_robot()
        assert isinstance(parameters, DigitalTwinParameters)
        if parameters.drive.kind != 'stepper':
            raise ParameterError(f'drive.kind must be stepper: got {parameters.drive.kind}')
        noise = scenario.own.noise
        further = load_schedule(parameters.faults.schedule).events
        schedule = FaultSchedule([*further, *fault_events(scenario)], scenario.case)
        return DigitalTwin(
            parameters, schedule, noise.simulation(parameters.seed) if noise else None
        )


def noisy_twin(world: str = '', seed: int = 1) -> DigitalTwinParameters:
    """Return the twin with the wheel speed noise that the controller assumes."""
    return DigitalTwinParameters.from_dict({'noise.variance': 0.04, 'world': world, 'seed': seed})


def fault_events(scenario: Scenario) -> list[FaultEvent]:
    """Return the faults of the twin and its command link in a scenario."""
    links = scenario.links
    begin, _ = links.span(scenario.duration)
    least, most = links.command_delay
    values = {
        'command_loss': links.command_loss,
        'command_delay': least,
        'command_jitter': most - least,
    }
    events = [
        FaultEvent(begin, name, value, links.lasting) for name, value in values.items() if value
    ]
    for name, value in scenario.parts.later.get(scenario.robot, {}).items():
        events.append(FaultEvent(0.5 * scenario.duration, name, value))
    return [*scenario.own.events, *events]


KINDS: Mapping[str, RobotKind] = {
    'twin': TwinKind('Digital twin'),
    'servo': RobotKind("The paper's plant with velocity drive", 'velocity'),
    'torque': RobotKind("The paper's plant with torque drive", 'torque'),
}
"""The robots by name."""


@lru_cache(maxsize=128)  # about 0.3 MB for a run of a minute
def sample_reference(parameters: ReferenceParameters, rows: int) -> SampledReference:
    """Return the first ``rows`` samples of a reference; its rate must be :data:`RATE`."""
    chaos = ChaoticReference(parameters, WheelGeometry())
    samples = [chaos.advance() for _ in range(rows)]
    return SampledReference(
        time=np.arange(rows) / RATE,
        speeds=np.array([sample.wheels for sample in samples]),
        rate=np.array([sample.rate for sample in samples]),
        modes=np.array([sample.mode for sample in samples], dtype=np.int64),
        switched=np.array([sample.switched for sample in samples], dtype=np.bool_),
    )


def sampled_speeds(speeds: Array) -> SampledReference:
    """Return a reference of one mode from wheel speeds (rad/s) of each period, shape (n, 2)."""
    count = len(speeds)
    slope = np.gradient(speeds, axis=0) * RATE
    none = np.zeros(count, dtype=np.int64)
    return SampledReference(np.arange(count) / RATE, speeds, slope, none, none.astype(np.bool_))
