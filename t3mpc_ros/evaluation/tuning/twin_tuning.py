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
"""Tuning of the methods on the digital twin, in the closed loop of its comparison.

Half of the runs of an evaluation are on the default twin, half on the miscalibrated one, on which
the baselines have the gyro.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.control.controller import ControllerParameters, StepperControllerParameters
from t3mpc_ros.evaluation.confidence_intervals import Difference, paired, rms
from t3mpc_ros.evaluation.experiment import Job, Report
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.methods import FULL, further_methods, methods, twin_start
from t3mpc_ros.evaluation.proposed_method import ProposedController
from t3mpc_ros.evaluation.record import START, VARIATION, measure, rolling_speeds
from t3mpc_ros.evaluation.scenario import KINDS, TUNING_SEEDS, Scenario
from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition, SearchRange
from t3mpc_ros.evaluation.tuning.tune_methods import ClosedLoopObjective, tune_methods
from t3mpc_ros.evaluation.tuning.tuned_parameter_file import (
    SMOOTHNESS,
    TunedEntry,
    TunedParameters,
    TuningBudget,
)
from t3mpc_ros.parameters.table import Parameters

TWIN = KINDS['twin'].tuned_for
CASES = ('nominal', 'miscalibrated')
TRAINING = TuningBudget(training_seeds=TUNING_SEEDS[:2], noise_levels=(0.04,), cases=CASES)
"""Runs of one evaluation."""
VALIDATION_SEEDS = TUNING_SEEDS[2:]
"""Seeds on which the tuned parameters of the full controller are compared with its defaults."""
FULL_RANGES = (
    SearchRange('body.wheel_tolerance', 0.002, 0.1),
    SearchRange('body.yaw_gain', 0.02, 1.0),
    SearchRange('body.max_yaw_correction', 0.01, 1.0),
)
"""What is free in the full controller after the rule for the gains."""
GAIN_RANGE = SearchRange('gain', 5.0, 100.0)
"""Range of the feedback gain of a baseline; it includes that of :func:`twin_start`."""


def twin_definitions(known: Iterable[MethodDefinition]) -> list[MethodDefinition]:
    """Return the methods as they are tuned on the twin.

    Baselines start from the parameters for the velocity drive, see :func:`twin_start`; the full
    controller from the defaults of the node.
    """
    tuned = methods('velocity') | further_methods('velocity')
    found = []
    for each in known:
        if each.name == FULL:
            start: Parameters = StepperControllerParameters()
            found.append(
                MethodDefinition(
                    FULL, ProposedController, {TWIN: start}, FULL_RANGES, ControllerParameters
                )
            )
            continue
        ranges = tuple(GAIN_RANGE if one.name == 'gain' else one for one in each.ranges)
        start = each.start.get(TWIN) or twin_start(tuned[each.name].parameters)
        found.append(replace(each, start={TWIN: start}, ranges=ranges))
    return found


def twin_objective(job: Job) -> float:
    """Return RMSE + rho times the variation of a run, rad/s; infinite if it is not finite.

    On the default twin the error is that of the rotors. Where the baselines have the gyro it is
    that of wheels rolling without slip under the true motion of the body: a method that corrects
    the body must not lose by it.
    """
    scenario, method = job
    record = run(scenario, method)
    counted = record.time >= record.start + START
    speeds = record.speeds
    if scenario.uses_gyro:
        speeds = rolling_speeds(record, scenario.true_robot().geometry)
    rmse = rms((speeds - record.reference)[counted])
    value = rmse + SMOOTHNESS * measure(record)[VARIATION.name]
    return value if math.isfinite(value) else math.inf


def validate(
    method: MethodDefinition, tuned: TunedEntry, objective: ClosedLoopObjective
) -> Difference:
    """Return the paired difference (rad/s) of the objective, tuned parameters less start.

    Each of :data:`VALIDATION_SEEDS` is driven in every case.
    """
    start = method.start[TWIN]
    found = start.with_values({name: tuned.values[name] for name in tuned.tuned})
    jobs = [
        (Scenario(TWIN, case, seed, TRAINING.duration), method.compared(parameters, TWIN))
        for seed in VALIDATION_SEEDS
        for case in CASES
        for parameters in (found, start)
    ]
    values = np.array([value for _, value in sorted(objective.workers.map(twin_objective, jobs))])
    with_tuned, with_start = values.reshape(-1, len(CASES), 2).mean(axis=1).T.tolist()
    return paired(with_tuned, with_start)


def tune_twin(
    selected: Sequence[MethodDefinition],
    evaluations: int,
    workers: int | Executor,
    path: Path,
    report: Report,
    *,
    resume: bool = False,
) -> TunedParameters:
    """Return the best parameters of each method on the twin; arguments as :func:`tune_methods`.

    The full controller keeps its defaults unless the tuned parameters are better on seeds that
    they were not tuned on, by more than the 95 % interval of the paired difference.
    """
    budget = replace(TRAINING, evaluations=evaluations)
    with ClosedLoopObjective(budget, workers, report, twin_objective) as objective:
        store = tune_methods(
            selected, [TWIN], budget, workers, path, report, resume=resume, evaluate=objective
        )
        for method in selected:
            if method.name != FULL:
                continue
            tuned = store.entry(FULL, TWIN)
            difference = validate(method, tuned, objective)
            better = difference.certain and difference.mean < 0.0
            report(
                f'  {FULL}, {TWIN}: on seeds {VALIDATION_SEEDS[0]} to {VALIDATION_SEEDS[-1]} the '
                f'tuned parameters differ from the defaults by {difference.mean:+.5f} ± '
                f'{difference.half:.5f} rad/s: {"they are stored" if better else "kept defaults"}'
            )
            if not better:
                assert tuned.start_objective is not None
                values = method.start[TWIN].to_dict()
                store[FULL, TWIN] = replace(tuned, values=values, objective=tuned.start_objective)
                store.save(path)
    return store
