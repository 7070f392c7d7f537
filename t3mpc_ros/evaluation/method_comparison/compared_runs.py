# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs of the comparison: methods, cases and metrics of each robot, and all runs of a plan.

A robot is the digital twin with stepper motors (``twin``), or the paper's plant with velocity
drive (``servo``) or torque drive (``torque``).
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache
import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.controller import Controller
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController, NominalModel
from t3mpc_ros.evaluation.baselines.feed_forward import FeedForward, FeedForwardParameters
from t3mpc_ros.evaluation.closed_loop import (
    LoopRecord,
    MethodSpec,
    map_jobs,
    run,
    total_variation,
)
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.method_comparison.twin_scenario import CASES as TWIN_CASES
from t3mpc_ros.evaluation.method_comparison.twin_scenario import (
    TwinBaseline,
    TwinScenario,
    check_name,
)
from t3mpc_ros.evaluation.methods import (
    EXACT_MODEL,
    FULL,
    STAGES,
    WITHOUT,
    ComparedMethod,
    methods,
)
from t3mpc_ros.evaluation.paper.experiment_runs import SETTLING as PAPER_SETTLING
from t3mpc_ros.evaluation.scenario import CASES as PAPER_CASES
from t3mpc_ros.evaluation.scenario import RATE, Scenario, counted_rows, switch_times
from t3mpc_ros.evaluation.tuning.tuned_parameters import TunedParameters
from t3mpc_ros.evaluation.twin_closed_loop import (
    INITIAL_STANDSTILL,
    LoopController,
    TwinRecord,
    drive_twin,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.parameters.table import Parameters

Array = NDArray[np.float64]

DRIVES: Mapping[str, str] = {'twin': 'velocity', 'servo': 'velocity', 'torque': 'torque'}
"""Robots, and the drive of each."""
ROBOT_TEXTS: Mapping[str, str] = {
    'twin': 'Digital twin',
    'servo': "The paper's plant with velocity drive",
    'torque': "The paper's plant with torque drive",
}
"""Robots in words."""
TUNED_FOR: Mapping[str, str] = {**DRIVES, 'twin': 'twin'}
"""Robots, and the drive under which the parameters tuned for them are stored."""
FEED_FORWARD = 'feed-forward'
"""The method with which every other is compared."""
QUICK_SEEDS = tuple(range(201, 207))
"""Default seeds: none of them was used for tuning, or is in a table of the paper's results."""
SETTLING = (0.5, 1.0)
"""Time before and after each switch that the settled errors on the twin leave out, s; its rotors
ring longer than the wheels of the paper's plant, for which the time is that of its tables."""
START = 3.0
"""Time from the enabling of the controller that no metric counts, s."""
TWIN_ADVANCE = 0.0095
"""Lead of feed-forward over the dead time on the twin, s: its pulse generator ramps to a command
during the whole period that follows, and its rotors have hardly any lag."""
TWIN_PARTS: Mapping[str, Mapping[str, object]] = {
    'full without NT3FS': {'body.learning_rate': 0.0},
    'full without compensator': {'body.yaw_gain': 0.0},
    'full without shaper': {
        'command_shaper.straight_frequency': 0.0,
        'command_shaper.turning_frequency': 0.0,
    },
    'full without dead-time estimate': {'estimate_dead_time': False},
    'full without preview': {'jump_transition.preview': False},
    "full, the paper's composition": {'composition': 'paper'},
}
"""The node's controller on the twin with one part left out, and with NT3FS, compensator and v_p on
the wheel speeds. The compensator acts with the authority of NT3FS: without it, neither does."""
AFTER = 2.0
"""Time after faults before the error after them counts, s."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One number of a run; smaller is better."""

    name: str
    heading: str
    unit: str
    digits: int


SETTLED = Metric('settled', 'settled', 'rad/s', 4)
OVERALL = Metric('overall', 'with switches', 'rad/s', 4)
VARIATION = Metric('variation', 'variation', 'rad/s³', 1)
YAW_RATE = Metric('yaw_rate', 'yaw rate', 'rad/s', 4)
YAW_RATE_SETTLED = Metric('yaw_rate_settled', 'yaw rate settled', 'rad/s', 4)
DRIFT = Metric('drift', 'yaw drift', 'rad', 3)
STOPPED = Metric('stopped', 'stopped', 's', 2)
BEFORE = Metric('before', 'settled before', 'rad/s', 4)
DURING = Metric('during', 'settled during', 'rad/s', 4)
RECOVERED = Metric('after', 'settled after', 'rad/s', 4)
METRICS = (
    SETTLED,
    OVERALL,
    VARIATION,
    YAW_RATE_SETTLED,
    YAW_RATE,
    DRIFT,
    STOPPED,
    BEFORE,
    DURING,
    RECOVERED,
)
"""All metrics; a robot or case without one leaves it out."""


@dataclass(frozen=True, slots=True)
class TwinMethod:
    """A method on the twin: the controller of the node, or a baseline."""

    name: str
    changes: Mapping[str, object] | None = None
    """Changes of the node's parameters; None for a baseline."""
    baseline: Callable[[NominalModel], BaselineController] | None = None

    def controller(self, scenario: TwinScenario) -> LoopController:
        """Return a new controller for a run."""
        if self.baseline is not None:
            return TwinBaseline(self.baseline, scenario)
        controller = Controller(scenario.controller_parameters().with_values(self.changes or {}))
        controller.warm_up()
        return controller


class PlantMethod(Protocol):
    """A method on the paper's plant; :class:`MethodSpec` is one."""

    @property
    def name(self) -> str:
        """Name in tables and errors."""
        ...

    def __call__(self, nominal_model: NominalModel) -> BaselineController:
        """Return a new controller."""
        ...


AnyScenario = TwinScenario | Scenario
AnyMethod = TwinMethod | PlantMethod
Job = tuple[AnyScenario, AnyMethod]


@cache
def methods_for(robot: str) -> Mapping[str, AnyMethod]:
    """Return the methods of a robot by name; the first one is the full controller."""
    drive = DRIVES[robot]
    table = methods(drive)
    forward = MethodSpec(FEED_FORWARD, FeedForward, feed_forward_parameters(robot))
    ordered: dict[str, AnyMethod] = {FULL: table[FULL], FEED_FORWARD: forward, **table}
    return _twin_methods(table, forward) if robot == 'twin' else ordered


def feed_forward_parameters(robot: str) -> FeedForwardParameters:
    """Return the parameters of feed-forward on a robot."""
    if robot == 'twin':
        return FeedForwardParameters(advance=TWIN_ADVANCE)
    if robot == 'torque':  # the ramp that the other methods with preview have there
        return FeedForwardParameters().with_values({'jump_transition.acceleration': 200.0})
    return FeedForwardParameters()


def _twin_methods(
    table: Mapping[str, ComparedMethod], forward: MethodSpec
) -> Mapping[str, AnyMethod]:
    """Return the methods on the twin.

    The full controller has the defaults of the node, whatever is stored as tuned for it.
    Baselines have the parameters tuned for the twin; those of a baseline that was not are its
    :func:`twin_start`.
    """
    tuned = TunedParameters.load()
    found: dict[str, AnyMethod] = {
        FULL: TwinMethod(FULL, {}),
        FEED_FORWARD: TwinMethod(FEED_FORWARD, baseline=forward),
    }
    for name, method in table.items():
        if method.baseline:
            parameters = twin_start(method.parameters)
            tuned_name = name.removesuffix(EXACT_MODEL)
            if (tuned_name, TUNED_FOR['twin']) in tuned:
                parameters = tuned.applied(tuned_name, TUNED_FOR['twin'], parameters)
            spec = MethodSpec(name, method.controller_type, parameters)
            found[name] = TwinMethod(name, baseline=spec)
    return found | {name: TwinMethod(name, changes) for name, changes in TWIN_PARTS.items()}


def twin_start(parameters: Parameters) -> Parameters:
    """Return the parameters of a baseline before tuning on the twin.

    They are those tuned for the velocity drive, with the feedback gain ``gain`` at which the
    measured speed cancels in the command, (1 - exp(-T/lag))/T.
    """
    if 'gain' not in parameters.to_dict():
        return parameters
    model = TwinScenario('nominal', 0).nominal_model()
    return parameters.with_values({'gain': model.share / model.period})


def default_methods(robot: str) -> tuple[str, ...]:
    """Return the full controller and every baseline, without stages and ablations."""
    parts = {*STAGES, *WITHOUT, *TWIN_PARTS} - {FULL}
    return tuple(name for name in methods_for(robot) if name not in parts)


def cases_for(robot: str) -> tuple[str, ...]:
    """Return the names of the cases of a robot."""
    if robot == 'twin':
        return tuple(TWIN_CASES)
    return tuple(name for name, case in PAPER_CASES.items() if DRIVES[robot] in case.drives)


def case_texts(robot: str) -> Mapping[str, str]:
    """Return what each case of a robot changes."""
    texts = {name: case.text for name, case in PAPER_CASES.items()}
    if robot == 'twin':
        texts = {name: case.text for name, case in TWIN_CASES.items()}
    return {name: texts[name] for name in cases_for(robot)}


@dataclass(frozen=True)
class ComparisonPlan:
    """What is compared."""

    robot: str
    cases: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = QUICK_SEEDS
    duration: float = 60.0
    noise: float = 0.04
    gyro: bool = False

    @property
    def against(self) -> str:
        """The method with which every other is compared."""
        return FEED_FORWARD

    @property
    def robot_text(self) -> str:
        """What the robot is, in words."""
        return ROBOT_TEXTS[self.robot]

    @property
    def additional_knowledge(self) -> Mapping[str, str]:
        """What methods know that are no method of the robot, for the table of the page."""
        return {}

    def known_methods(self) -> Mapping[str, AnyMethod]:
        """Return every method that can be compared, by name."""
        return methods_for(self.robot)

    def __post_init__(self) -> None:
        check_name('robot', self.robot, DRIVES)
        known = self.known_methods()
        for case in self.cases:
            check_name('case', case, dict.fromkeys(cases_for(self.robot)))
        for method in self.methods:
            check_name('method', method, known)
        if self.gyro and self.robot != 'twin':
            raise ValueError(f'gyro is for the twin alone: got robot {self.robot}')
        for what, chosen in (
            ('case', self.cases),
            ('method', self.methods),
            ('seed', self.seeds),
        ):
            if not chosen:
                raise ValueError(f'at least one {what} must be given')

    def jobs(self) -> list[tuple[str, str, int]]:
        """Return (case, method, seed) of every run, methods of one seed next to each other."""
        return [
            (case, method, seed)
            for case in self.cases
            for seed in self.seeds
            for method in self.methods
        ]

    def job(self, case: str, method: str, seed: int) -> Job:
        """Return scenario and method of a run."""
        found = self.known_methods()[method]
        if self.robot == 'twin':
            return TwinScenario(case, seed, self.duration, self.noise, self.gyro), found
        return Scenario(DRIVES[self.robot], self.noise, case, seed, self.duration), found


Numbers = Mapping[str, float]
"""Metrics of a run by name; NaN where the run broke off."""
Results = Mapping[tuple[str, str], Sequence[Numbers]]
"""Metrics by case and method, one entry for each seed in the order of the plan."""


def compare(
    plan: ComparisonPlan, workers: int | Executor = 1, *, progress: bool = False
) -> Results:
    """Return the metrics of every run of a plan; ``workers`` as for :class:`WorkerPool`."""
    keys = plan.jobs()
    found = map_jobs(measured_run, [plan.job(*key) for key in keys], workers, progress=progress)
    numbers = dict(zip(keys, found, strict=True))
    return {
        (case, method): [numbers[case, method, seed] for seed in plan.seeds]
        for case in plan.cases
        for method in plan.methods
    }


def measured_run(job: Job) -> Numbers:
    """Return the metrics of one run."""
    scenario, method = job
    if isinstance(scenario, TwinScenario) and isinstance(method, TwinMethod):
        return twin_numbers(scenario, twin_run(scenario, method))
    if isinstance(scenario, Scenario) and not isinstance(method, TwinMethod):
        return paper_numbers(run(scenario, method))
    raise ValueError(f'{method.name} is no method of the robot of {scenario}')


def twin_run(scenario: TwinScenario, method: TwinMethod) -> TwinRecord:
    """Return the record of one run on the twin."""
    return drive_twin(
        scenario.robot(),
        method.controller(scenario),
        scenario.reference().speeds,
        scenario.duration,
        scenario.schedule(),
        links=scenario.links,
        speed_noise=scenario.speed_noise(),
    )


def paper_numbers(record: LoopRecord) -> Numbers:
    """Return the metrics of a run on the paper's plant."""
    if not record.finite:
        return {metric.name: math.nan for metric in (SETTLED, OVERALL, VARIATION)}
    start = min(START, 0.5 * float(record.time[-1]))
    return {
        SETTLED.name: record.rmse(start, cut=PAPER_SETTLING),
        OVERALL.name: record.rmse(start),
        VARIATION.name: record.chatter(),
    }


def twin_numbers(scenario: TwinScenario, record: TwinRecord) -> Numbers:
    """Return the metrics of a run on the twin, by the ground truth of rotors and body."""
    time, reference = record.time, scenario.reference()
    driven = float(time[-1]) - INITIAL_STANDSTILL
    start = INITIAL_STANDSTILL + min(START, 0.5 * driven)
    # With the switches soon after the end: preview leaves the reference before them.
    switches = switch_times(reference.time, reference.modes)
    counted = counted_rows(time, switches, start)
    settled = counted_rows(time, switches, start, SETTLING)
    effort = np.diff(record.requested, axis=0) * RATE
    error = record.rotors - record.reference
    geometry = WheelGeometry()
    rate = _yaw_rates(record.ground, geometry) - _yaw_rates(record.reference, geometry)
    turned = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    reasons = zip(record.robot_reasons, record.controller_reasons, strict=True)
    stopped = np.array([bool(robot or controller) for robot, controller in reasons])
    found = {
        SETTLED.name: rms(error[settled]),
        OVERALL.name: rms(error[counted]),
        VARIATION.name: total_variation(time[1:][counted[1:]], effort[counted[1:]]),
        YAW_RATE_SETTLED.name: rms(rate[settled]),
        YAW_RATE.name: rms(rate[counted]),
        DRIFT.name: abs(float(np.sum(turned[counted[1:]]))),
        STOPPED.name: float(np.mean(stopped[counted]) * (time[-1] - start)),
    }
    if span := scenario.fault_span:
        begin, end = span
        parts = {
            BEFORE.name: settled & (time < begin),
            DURING.name: settled & (time >= begin) & (time < end),
            RECOVERED.name: settled & (time >= end + AFTER),
        }
        found |= {name: rms(error[rows]) for name, rows in parts.items() if rows.any()}
    return found


def _yaw_rates(wheels: Array, geometry: WheelGeometry) -> Array:
    """Return the yaw rates (rad/s) of rows of wheel speeds, shape (n,)."""
    per_difference = twist_from_wheels(WheelSpeeds(1.0, 0.0), geometry).angular
    rates: Array = per_difference * (wheels[:, 0] - wheels[:, 1])
    return rates
