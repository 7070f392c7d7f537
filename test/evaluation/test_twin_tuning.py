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
"""Tuning on the digital twin: what an evaluation counts, and what the comparison uses of it."""

from concurrent.futures import ThreadPoolExecutor
import time

import numpy as np
import pytest

from t3mpc_ros.control.controller import StepperControllerParameters
from t3mpc_ros.evaluation.baselines.feedback_control import ProportionalIntegralParameters
from t3mpc_ros.evaluation.confidence_intervals import Difference
from t3mpc_ros.evaluation.loop import NodeMethod, run
from t3mpc_ros.evaluation.method_table import (
    EXACT_MODEL,
    FULL,
    LMS,
    OFFSET_FREE,
    RAMP,
    further_definitions,
    method_definitions,
    methods_for,
)
from t3mpc_ros.evaluation.run_record import OVERALL, VARIATION, measure, rolling_speeds
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, TUNING_SEEDS, Scenario
from t3mpc_ros.evaluation.tuning import tune_methods as twin_tuning
from t3mpc_ros.evaluation.tuning.tune_methods import (
    CASES,
    FULL_RANGES,
    TRAINING,
    TWIN,
    VALIDATION_SEEDS,
    ClosedLoopObjective,
    tune_twin,
    twin_definitions,
    twin_objective,
)
from t3mpc_ros.evaluation.tuning.tuned_parameters import SMOOTHNESS, TunedParameters

PI = 'PI + feed-forward'


@pytest.fixture(scope='module')
def definitions():
    return {each.name: each for each in twin_definitions(method_definitions())}


def test_every_method_starts_from_what_it_has_on_the_twin(definitions):
    assert list(definitions) == [each.name for each in method_definitions()]
    assert definitions[PI].start[TWIN].gain == pytest.approx(96.43, abs=0.01)
    assert definitions[FULL].start[TWIN] == StepperControllerParameters()
    start = definitions[PI].start[TWIN]
    trained = [definitions[PI].compared(start, drive).pretrained for drive in (TWIN, 'velocity')]
    assert trained == [False, True]
    assert definitions[FULL].space.names == tuple(each.name for each in FULL_RANGES)


def test_no_seed_of_the_tuning_is_reported():
    seeds = {*TRAINING.training_seeds, *VALIDATION_SEEDS}
    assert seeds <= {*TUNING_SEEDS}
    assert not seeds & {*HELD_OUT_SEEDS}
    assert not {*TRAINING.training_seeds} & {*VALIDATION_SEEDS}
    assert [(run.robot, run.case) for run in TRAINING.scenarios(TWIN)] == [
        (TWIN, case) for case in CASES
    ]


@pytest.mark.slow
def test_the_body_counts_where_baselines_have_the_gyro(definitions, monkeypatch):
    method = definitions[PI].compared(definitions[PI].start[TWIN], TWIN)
    for case, body in (('nominal', False), ('miscalibrated', True)):
        scenario = Scenario('twin', case, 1, 8.0)
        record = run(scenario, method)
        monkeypatch.setattr(twin_tuning, 'run', lambda *_, record=record: record)
        numbers = measure(record)
        cost = twin_objective((scenario, method)) - SMOOTHNESS * numbers[VARIATION.name]
        counted = record.time >= 4.5
        ground = rolling_speeds(record, scenario.true_robot().geometry)
        ground = np.sqrt(np.mean((ground - record.reference)[counted] ** 2))
        assert cost == pytest.approx(ground if body else numbers[OVERALL.name], rel=0.02)
        assert (cost == pytest.approx(numbers[OVERALL.name], rel=0.001)) != body


def test_an_evaluation_is_the_mean_of_its_runs(definitions):
    """In whatever order they are finished."""

    def cost(job):
        scenario, method = job
        time.sleep(0.02 * (scenario.seed == 1))
        return scenario.seed * method.parameters.gain + 1e3 * CASES.index(scenario.case)

    method = definitions[PI]
    candidates = [method.start[TWIN], method.start[TWIN].with_values({'gain': 20.0})]
    with (
        ThreadPoolExecutor(4) as executor,
        ClosedLoopObjective(TRAINING, executor, cost=cost) as objective,
    ):
        found = objective(method, TWIN, candidates)
    expected = [500.0 + 1.5 * parameters.gain for parameters in candidates]
    assert found == pytest.approx(expected, rel=1e-12)


def test_the_full_controller_is_that_of_the_node(definitions):
    changed = definitions[FULL].start[TWIN].with_values({'body.yaw_gain': 0.3})
    scenario = Scenario('twin', 'nominal', 1)
    method = definitions[FULL].compared(changed, TWIN)
    assert {*method.changes} == {*definitions[FULL].space.names}
    parameters = method.parameters_for(scenario)
    own = scenario.kind.controller_parameters(scenario)
    assert parameters == own.with_values({'body.yaw_gain': 0.3})
    assert parameters != own


@pytest.mark.parametrize(
    'mean, half, kept', [(-0.002, 0.001, False), (-0.001, 0.002, True), (0.002, 0.001, True)]
)
def test_defaults_stay_unless_others_are_better(
    definitions, monkeypatch, tmp_path, mean, half, kept
):
    method = definitions[FULL]
    default = method.start[TWIN].to_dict()['body.yaw_gain']

    def cost(job):
        return job[1].changes['body.yaw_gain']

    monkeypatch.setattr(twin_tuning, 'twin_objective', cost)
    monkeypatch.setattr(twin_tuning, 'validate', lambda *_: Difference(mean, half))
    lines = []
    path = tmp_path / 'tuned.json'
    store = tune_twin([method], 12, 1, path, lines.append)
    assert ('kept defaults' in lines[-1]) == kept
    entry = TunedParameters.load(path).entry(FULL, TWIN)
    assert entry == store.entry(FULL, TWIN)
    assert (entry.values['body.yaw_gain'] == default) == kept
    assert (entry.objective == entry.start_objective) == kept


# The packaged entries


def test_every_method_was_tuned_on_the_twin_alike(definitions):
    store = TunedParameters.load()
    store.check_equal()
    (lms,) = (each for each in twin_definitions(further_definitions()) if each.name == LMS)
    assert lms.start[TWIN].estimate_dead_time
    for name, method in {**definitions, LMS: lms}.items():
        entry = store.entry(name, TWIN)
        assert entry.tuned == method.space.names
        assert (entry.budget.training_seeds, entry.budget.cases) == (
            TRAINING.training_seeds,
            CASES,
        )
        assert entry.objective <= entry.start_objective
        for each in method.space.ranges:
            assert each.low <= entry.values[each.name] <= each.high


def test_the_comparison_uses_the_parameters_for_the_twin():
    store, found = TunedParameters.load(), methods_for('twin')
    for name, method in found.items():
        if isinstance(method, NodeMethod) or name.startswith('feed-forward'):
            continue
        tuned = [each for each in (name.removesuffix(EXACT_MODEL), name.removesuffix(RAMP))
                 if (each, TWIN) in store]  # fmt: skip
        entry = store.entry(tuned[0] if tuned else 'linear MPC preview', TWIN)
        values = method.parameters.to_dict()
        if name == OFFSET_FREE:
            assert values['disturbance_share'] == 0.0
            values['disturbance_share'] = entry.values['disturbance_share']
        assert {one: values[one] for one in entry.tuned} == {
            one: entry.values[one] for one in entry.tuned
        }
        if name.endswith(EXACT_MODEL):
            assert values['model_error'] == 1.0
    assert isinstance(found[PI].parameters, ProportionalIntegralParameters)
