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
"""Tuning: equal budgets, a search that finds known optima, and a store that refuses bad files."""

from dataclasses import dataclass, replace
import itertools
import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from t3mpc_ros.cli.main import main
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.evaluation.cases import ROBOTS
from t3mpc_ros.evaluation.experiment import JobError
from t3mpc_ros.evaluation.loop import MethodSpec
from t3mpc_ros.evaluation.loop import run as closed_loop_run
from t3mpc_ros.evaluation.method_table import (
    further_definitions,
    method_definitions,
    methods,
    methods_for,
)
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, TUNING_SEEDS, Scenario
from t3mpc_ros.evaluation.tuning.cma_search import search_best
import t3mpc_ros.evaluation.tuning.tune_methods as tune_module
from t3mpc_ros.evaluation.tuning.tune_methods import (
    ClosedLoopObjective,
    history_path,
    objective,
    tune_methods,
)
from t3mpc_ros.evaluation.tuning.tuned_parameters import (
    PACKAGED_FILE,
    SMOOTHNESS,
    MethodDefinition,
    SearchRange,
    SearchSpace,
    StoreError,
    TunedEntry,
    TunedParameters,
    TuningBudget,
)
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter


@dataclass(frozen=True)
class Inner(Parameters):
    weight: float = parameter(1.0, 'weight', 's', (1e-6, 1e6))


@dataclass(frozen=True)
class Gains(Parameters):
    """Settings of every kind, for searches of every size."""

    a: float = parameter(2.0, 'a', '1/s', (0.0, 1e3))
    b: float = parameter(2.0, 'b', bounds=(-5.0, 1e3))
    c: float = parameter(2.0, 'c', bounds=(0.0, 1e3))
    d: float = parameter(2.0, 'd', bounds=(0.0, 1e3))
    e: float = parameter(2.0, 'e', bounds=(0.0, 1e3))
    f: float = parameter(2.0, 'f', bounds=(0.0, 1e3))
    g: float = parameter(2.0, 'g', bounds=(0.0, 1e3))
    h: float = parameter(2.0, 'h', bounds=(0.0, 1e3))
    count: int = parameter(10, 'count', bounds=(1, 40))
    on: bool = parameter(True, 'on')
    kind: str = parameter('x', 'kind', choices=('x', 'y'))
    levels: tuple[float, ...] = parameter((0.1, 0.2), 'levels', bounds=(0.0, None))
    inner: Inner = group(Inner)

    def check_consistency(self) -> None:
        if self.a + self.c > 1500.0:
            raise ParameterError(f'a and c must not exceed 1500 together: got {self.a + self.c}')


LETTERS = 'abcdefgh'


def linear(n, low=0.0, high=4.0):
    return SearchSpace(Gains, [SearchRange(name, low, high, log=False) for name in LETTERS[:n]])


def each(function):
    """Return an objective that evaluates points one by one, as arrays."""
    return lambda points: [function(np.array(list(point.values()))) for point in points]


def sphere(x):
    return float(np.sum((x - 1.2) ** 2))


def rosenbrock(x):
    return float(np.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2))


# The unit cube


def test_settings_and_cube_map_onto_each_other():
    space = SearchSpace(
        Gains,
        [
            SearchRange('inner.weight', 1e-4, 1e2),
            SearchRange('b', -3.0, 5.0, log=False),
            SearchRange('count', 1, 40),
            SearchRange('a', 0.1, 1000),
        ],
    )
    for point in np.random.default_rng(1).uniform(size=(200, 4)):
        values = space.values(point)
        parameters = Gains().with_values(values)
        assert space.of(parameters) == values
        again = space.point(parameters)
        np.testing.assert_allclose(np.delete(again - point, 2), 0.0, atol=1e-12)
        assert space.values(again) == pytest.approx(values, rel=1e-12)
        assert space.values(again)['count'] == values['count']
    ends = [space.values(np.full(4, p)) for p in (0.0, 0.5, 1.0)]
    assert [values['a'] for values in ends] == pytest.approx([0.1, 10.0, 1000.0], rel=1e-12)
    assert [values['b'] for values in ends] == pytest.approx([-3.0, 1.0, 5.0], rel=1e-12)
    assert [values['count'] for values in (ends[0], ends[2])] == [1, 40]


def test_whole_numbers_have_equal_cells_and_stay_whole():
    space = SearchSpace(Gains, [SearchRange('count', 3, 7, log=False)])
    points = np.linspace(0.0005, 0.9995, 1000)[:, np.newaxis]
    counts = [space.values(point)['count'] for point in points]
    assert {type(count) for count in counts} == {int}
    assert [counts.count(n) for n in range(3, 8)] == [200] * 5


@pytest.mark.parametrize(
    'tuned, complaint',
    [
        (('a', 1.0, 2e3), 'a must be from 0 to 1000 1/s: got 2000'),
        (('inner.weight', 1e-7, 1.0), 'inner.weight must be from 1e-06'),
        (('on', 0.0, 1.0, False), 'on cannot be tuned: it must be one number'),
        (('levels', 0.0, 1.0, False), 'levels cannot be tuned: it must be one number'),
        (
            ('inner.wieght', 0.1, 1.0),
            'no parameter inner.wieght; did you mean inner.weight',
        ),
        (('b', -1.0, 1.0), 'b cannot be tuned: its range'),
        (('a', 2.0, 2.0), 'a cannot be tuned: its range'),
        (('a', math.nan, 1.0), 'a cannot be tuned: its range'),
        (('a', 3.0, 4.0), 'method, drive: a must be in its range from 3 to 4: got 2'),
    ],
)
def test_bad_ranges_are_rejected_by_name_bound_and_value(tuned, complaint):
    with pytest.raises(ParameterError, match=complaint):
        MethodDefinition(
            'method', BaselineController, {'drive': Gains()}, (SearchRange(*tuned),), Gains
        )


# The search


@pytest.mark.parametrize('n', [1, 8])
@pytest.mark.parametrize('evaluations', [1, 2, 10, 11, 61])
def test_every_method_gets_exactly_its_evaluations(n, evaluations):
    seen, progress = [], []

    def objective(points):
        seen.extend(points)
        return each(sphere)(points)

    found = search_best(
        objective, linear(n), Gains(), evaluations, 1, lambda *each: progress.append(each)
    )
    assert len(seen) == evaluations
    assert [point.values for point in found.history] == seen
    assert seen[0] == dict.fromkeys(LETTERS[:n], 2.0)
    assert found.value == min(point.value for point in found.history)
    assert sphere(np.array(list(found.values.values()))) == found.value
    assert progress[-1] == (evaluations, found.value)
    done = [count for count, _ in progress]
    assert done == sorted({*done})


def test_badly_scaled_gains_are_found_by_their_logarithms():
    """Optima and sensitivities apart by factors of thousands, as gains of a controller are."""
    optimum = np.array([3e-5, 400.0, 0.5, 30.0])
    weights = np.array([1.0, 1e3, 1e1, 1e-1])
    space = SearchSpace(
        Gains,
        [
            SearchRange('inner.weight', 1e-6, 1e-1),
            SearchRange('a', 1e-2, 1e3),
            SearchRange('c', 1e-3, 1e3),
            SearchRange('d', 1e-1, 1e3),
        ],
    )

    def bowl(x):
        return float(np.sum(weights * np.log(x / optimum) ** 2))

    start = Gains().with_values({'inner.weight': 1e-2, 'a': 1.0, 'c': 100.0, 'd': 1.0})
    found = search_best(each(bowl), space, start, 700, 1)
    assert list(found.values.values()) == pytest.approx(optimum.tolist(), rel=0.01)
    assert found.value < 1e-5 * found.history[0].value


def test_equal_seeds_give_equal_searches_without_global_rng():
    before = np.random.get_state()  # noqa: NPY002
    first, second, other = (
        search_best(each(rosenbrock), linear(4), Gains(), 90, seed) for seed in (5, 5, 6)
    )
    assert first == second
    assert other.history[1:] != first.history[1:]
    after = np.random.get_state()  # noqa: NPY002
    np.testing.assert_array_equal(before[1], after[1])
    assert before[2:] == after[2:]


def test_the_last_point_is_where_the_search_believes_the_optimum():
    """The mean of the distribution is nearer than its samples are."""
    better = 0
    for seed in range(10):
        found = search_best(each(sphere), linear(5), Gains(), 81, seed)
        values = [point.value for point in found.history]
        better += values[-1] < np.median(values[-9:-1])
    assert better >= 9


@pytest.mark.slow
def test_a_search_that_converged_begins_again_and_leaves_a_trap():
    """Two basins of equal size; the start is beside the bottom of the lesser one."""

    def traps(x):
        return float(min(0.1 + abs(x[0] - 3.9), abs(x[0] - 0.3)))

    for seed in range(2):
        for evaluations, bottom in ((60, 3.9), (900, 0.3)):
            found = search_best(each(traps), linear(1), Gains(a=3.8), evaluations, seed)
            assert found.values['a'] == pytest.approx(bottom, abs=0.01)


@pytest.mark.parametrize('bad', [math.nan, -math.inf, 1e300])
def test_values_that_are_not_numbers_count_as_worst(bad):
    """Half of the cube fails, next to the optimum."""

    def objective(x):
        return bad if x[0] > 1.5 else sphere(x)

    start = Gains(a=1.4)
    with np.errstate(all='raise'):
        found = search_best(each(objective), linear(3), start, 300, 1)
    failed = [one for one in found.history if one.values['a'] > 1.5]
    assert failed
    assert all(one.value >= 1e300 for one in failed)
    assert found.value < 1e-3
    assert found.values['a'] <= 1.5
    hopeless = search_best(each(lambda x: bad), linear(3), start, 70, 1)
    assert len(hopeless.history) == 70
    assert hopeless.values == {'a': 1.4, 'b': 2.0, 'c': 2.0}


@pytest.mark.parametrize('n, log', [(1, True), (6, False)])
def test_bounds_are_never_exceeded_and_a_corner_is_reached(n, log):
    """The optimum lies outside, beyond every upper bound."""
    space = SearchSpace(Gains, [SearchRange(name, 0.5, 4.0, log) for name in LETTERS[:n]])
    found = search_best(
        each(lambda x: float(np.sum((x - 9.0) ** 2))), space, Gains(), 60 * n + 60, 1
    )
    tried = np.array([list(one.values.values()) for one in found.history])
    assert tried.min() >= 0.5
    assert tried.max() <= 4.0
    assert tried[found.history.index(min(found.history, key=lambda one: one.value))] == (
        pytest.approx([4.0] * n, rel=0.02)
    )


def test_what_cannot_be_searched_is_refused():
    for count in (0, -3):
        with pytest.raises(ValueError, match=f'evaluations must be at least 1: got {count}'):
            search_best(each(sphere), linear(2), Gains(), count, 1)
    with pytest.raises(ParameterError, match='a must be in its range'):
        search_best(each(sphere), linear(2), Gains(a=5.0), 10, 1)
    with pytest.raises(ValueError, match='one value a point, 1: got 2'):
        search_best(lambda points: [1.0, 2.0], linear(2), Gains(), 10, 1)


# Interrupted and resumed


class Interrupted(Exception):
    pass


def interrupted_after(generations):
    calls = itertools.count()

    def objective(points):
        if next(calls) == generations:
            raise Interrupted
        return each(lambda x: math.nan if x[0] > 3.0 else rosenbrock(x))(points)

    return objective


@pytest.mark.parametrize('generations', [0, 1, 2, 9])
def test_a_resumed_search_is_the_uninterrupted_one(tmp_path, generations):
    whole, cut = tmp_path / 'whole.jsonl', tmp_path / 'cut.jsonl'
    space, start = linear(4), Gains()
    expected = search_best(interrupted_after(-1), space, start, 107, 4, path=whole)
    with pytest.raises(Interrupted):
        search_best(interrupted_after(generations), space, start, 107, 4, path=cut)
    evaluated = []

    def counting(points):
        evaluated.extend(points)
        return interrupted_after(-1)(points)

    found = search_best(counting, space, start, 107, 4, path=cut, resume=True)
    assert found == expected
    assert cut.read_bytes() == whole.read_bytes()
    known = 0 if generations == 0 else 1 + 8 * (generations - 1)
    assert len(evaluated) == 107 - known


def test_a_finished_search_is_recalled_without_an_evaluation(tmp_path):
    path = tmp_path / 'history.jsonl'
    expected = search_best(each(sphere), linear(1), Gains(), 200, 4, path=path)
    found = search_best(interrupted_after(0), linear(1), Gains(), 200, 4, path=path, resume=True)
    assert found == expected
    with pytest.raises(Interrupted):  # not asked to resume: it begins anew
        search_best(interrupted_after(0), linear(1), Gains(), 200, 4, path=path)


def test_torn_lines_and_those_of_another_search_are_not_used(tmp_path):
    path = tmp_path / 'history.jsonl'

    def evaluated(evaluations=40, **changes):
        count = []
        arguments = {'space': linear(2), 'start': Gains(), 'about': {'drive': 'torque'}, **changes}
        search_best(
            lambda points: count.extend(points) or each(sphere)(points),
            evaluations=evaluations, seed=4, path=path, resume=True, **arguments,
        )  # fmt: skip
        return len(count)

    assert evaluated() == 40
    path.write_text(path.read_text()[:-10])
    assert [evaluated(), evaluated()] == [1, 0]
    assert 0 < evaluated(60) <= 20 + 6  # the last generation of 40 was cut, and held the mean
    for change in ({'space': linear(2, high=5.0)}, {'start': Gains(h=3.0)}, {'about': {}}):
        assert evaluated(**change) == 40
    assert evaluated() == 0


# The objective of a run


@pytest.mark.parametrize(
    'error, varied, cost',
    [(0.2, 1000.0, 0.21), (math.nan, 1.0, math.inf), (1.0, math.nan, math.inf)],
)
def test_a_thousand_of_variation_costs_a_hundredth(error, varied, cost, monkeypatch):
    record = SimpleNamespace(rmse=lambda: error, variation=lambda: varied)
    monkeypatch.setattr(tune_module, 'run', lambda *job: record)
    assert objective(()) == pytest.approx(cost)


@pytest.mark.slow
def test_tuning_mixes_noises_and_excludes_held_out_seeds():
    runs = TuningBudget().scenarios('torque')
    assert {run.seed for run in runs} == {*TUNING_SEEDS}
    assert not {*TUNING_SEEDS} & {*HELD_OUT_SEEDS}
    assert [run.noise for run in runs] == 3 * [0.0, 0.04, 0.1]
    modes = runs[0].reference().modes[: runs[0].steps]
    assert np.count_nonzero(np.diff(modes)) >= 1
    assert {(run.robot, run.case) for run in runs} == {('torque', 'nominal')}
    mixed = budget(3, noise_levels=(0.04,), cases=('nominal', 'mass +30 %'))
    cases = [(run.robot, run.case) for run in mixed.scenarios('velocity')]
    assert cases == [('servo', case) for case in ('nominal', 'mass +30 %', 'nominal')]


@pytest.mark.parametrize(
    'changes, complaint',
    [
        ({'training_seeds': (1, 1)}, 'training_seeds must differ'),
        ({'noise_levels': (0.0, 0.1, 0.2)}, 'noise_levels must be 1 to 2, a seed each'),
        ({'cases': ('nominal', 'mass +30 %', 'jitter')}, 'cases must be 1 to 2'),
    ],
)
def test_an_evaluation_has_a_seed_for_each_noise_and_case(changes, complaint):
    with pytest.raises(ParameterError, match=complaint):
        budget(2, **changes)


def budget(seeds, **changes):
    given = {'noise_levels': (0.0, 0.1), 'duration': 5.0, **changes}
    return TuningBudget(**{'training_seeds': tuple(range(1, seeds + 1)), **given})


@dataclass(frozen=True)
class FeedbackParameters(Parameters):
    gain: float = parameter(5.0, 'gain', '1/s', (0.0, 1e3))
    fault: float = parameter(0.0, 'above 0 it fails', bounds=(0.0, 1.0))


class Feedback(BaselineController):
    """Feed-forward and proportional feedback: the least that tracks."""

    parameters_type = FeedbackParameters

    def __init__(self, parameters, nominal_model):
        if parameters.fault > 0.0:
            raise RuntimeError('asked to fail')
        self._gain, self._period = parameters.gain, nominal_model.period

    def step(self, observation):
        forward = (observation.next_reference - observation.reference) / self._period
        return (
            forward
            - observation.unexplained
            - self._gain * (observation.speeds - observation.reference)
        )


FEEDBACK = MethodDefinition(
    'P feedback',
    Feedback,
    {'torque': FeedbackParameters(), 'velocity': FeedbackParameters(gain=4.0)},
    (SearchRange('gain', 0.5, 50.0),),
)


def test_closed_loop_objective_is_computed_per_run():
    candidates = [FeedbackParameters(gain=gain) for gain in (1.0, 8.0)]
    with ClosedLoopObjective(budget(2), 1) as evaluate:
        found = evaluate(FEEDBACK, 'torque', candidates)
    for candidate, value in zip(candidates, found, strict=True):
        spec = MethodSpec('P feedback', Feedback, candidate)
        records = [
            closed_loop_run(Scenario('torque', 'nominal', seed, 5.0, noise=noise), spec)
            for seed, noise in ((1, 0.0), (2, 0.1))
        ]
        objectives = [record.rmse() + SMOOTHNESS * record.variation() for record in records]
        assert value == pytest.approx(np.mean(objectives), rel=1e-12)
    assert found[1] < found[0]


def test_failing_parameters_are_worst_a_failing_method_raises():
    good, bad = FeedbackParameters(), FeedbackParameters(fault=1.0)
    said = []
    with ClosedLoopObjective(budget(2), 1, said.append) as evaluate:
        with pytest.raises(JobError, match='asked to fail'):
            evaluate(FEEDBACK, 'torque', [bad])
        said.clear()
        found = evaluate(FEEDBACK, 'torque', [bad, good])
        assert found[0] == math.inf
        assert found[1] < 10.0
        assert evaluate(FEEDBACK, 'torque', [bad]) == [math.inf]
    assert len(said) == 2
    assert all('asked to fail' in line for line in said)


# Many methods


def lag_plant(method, drive, candidates):
    """A first-order plant and a step: a squared error that is known without a simulation."""
    lag = {'torque': 0.1, 'velocity': 0.3}[drive]
    return [
        1.0 / (2.0 * (values.to_dict()['gain'] + lag)) + 0.01 * values.to_dict()['gain']
        for values in candidates
    ]


@dataclass(frozen=True)
class PlantParameters(FeedbackParameters):
    other: float = parameter(1.0, 'no effect', bounds=(0.1, 10.0))
    third: float = parameter(1.0, 'no effect', bounds=(0.1, 10.0))


class Wider(Feedback):
    parameters_type = PlantParameters


WIDER = MethodDefinition(
    'wider, 2nd',
    Wider,
    {'velocity': PlantParameters(gain=40.0)},
    (
        SearchRange('gain', 0.5, 50.0),
        SearchRange('other', 0.1, 10.0),
        SearchRange('third', 0.1, 10.0),
    ),
)


def counted(evaluate):
    counts = {}

    def counting(method, drive, candidates):
        counts[method.name, drive] = counts.get((method.name, drive), 0) + len(candidates)
        return evaluate(method, drive, candidates)

    return counting, counts


def tune_both(path, evaluate=lag_plant, evaluations=80, **more):
    return tune_methods(
        [FEEDBACK, WIDER],
        ['torque', 'velocity'],
        TuningBudget(evaluations),
        1,
        path,
        evaluate=evaluate,
        **more,
    )


def test_methods_of_any_size_get_equal_budgets(tmp_path):
    path = tmp_path / 'sub' / 'tuned.json'
    evaluate, counts = counted(lag_plant)
    store = tune_both(path, evaluate)
    keys = [('P feedback', 'torque'), ('P feedback', 'velocity'), ('wider, 2nd', 'velocity')]
    assert counts == dict.fromkeys(keys, 80)
    assert list(store) == keys
    store.check_equal()
    loaded = TunedParameters.load(path)
    assert loaded == store
    for key in keys:
        entry = loaded.entry(*key)
        assert entry.objective <= entry.start_objective
        lag = {'torque': 0.1, 'velocity': 0.3}[key[1]]
        start = {method.name: method for method in (FEEDBACK, WIDER)}[key[0]].start[key[1]]
        parameters = loaded.applied(*key, start)
        assert parameters.to_dict() == entry.values
        assert parameters.gain == pytest.approx(math.sqrt(50.0) - lag, rel=0.1)
        assert lag_plant(None, key[1], [parameters]) == [entry.objective]
        assert f'| {key[0]} | {key[1]} | {entry.start_objective:.4f} ' in store.table()


def test_tuning_many_is_resumed_where_it_stopped(tmp_path):
    expected = tmp_path / 'whole.json'
    tune_both(expected)
    path = tmp_path / 'cut.json'

    def stopping(method, drive, candidates):
        if method is FEEDBACK and drive == 'velocity' and len(counts) > 1:
            calls.append(1)
            if len(calls) == 4:
                raise KeyboardInterrupt
        return lag_plant(method, drive, candidates)

    calls = []
    evaluate, counts = counted(stopping)
    with pytest.raises(KeyboardInterrupt):
        tune_both(path, evaluate)
    again, counts = counted(lag_plant)
    tune_both(path, again, resume=True)
    assert path.read_bytes() == expected.read_bytes()
    assert ('P feedback', 'torque') not in counts
    assert 0 < counts['P feedback', 'velocity'] < 80
    assert counts['wider, 2nd', 'velocity'] == 80
    history = history_path(path, FEEDBACK, 'velocity')
    assert history == tmp_path / 'cut.history' / 'p-feedback.velocity.jsonl'
    assert len(history.read_text().splitlines()) == 80


def test_inconsistent_parameters_cost_an_evaluation_no_run(tmp_path):
    """The table refuses a + c beyond 1500, though each is in range."""
    method = MethodDefinition(
        'pair',
        _baseline_of(Gains),
        {'torque': Gains(a=500.0, c=500.0)},
        (SearchRange('a', 1.0, 1000.0, log=False), SearchRange('c', 1.0, 1000.0, log=False)),
    )
    evaluate, counts = counted(
        lambda method, drive, candidates: [1e4 - each.a - each.c for each in candidates]
    )
    store = tune_methods(
        [method], ['torque'], TuningBudget(150), 1, tmp_path / 'a.json', evaluate=evaluate
    )
    assert counts['pair', 'torque'] < 150
    found = store.applied('pair', 'torque', Gains())
    assert 1400.0 < found.a + found.c <= 1500.0


def _baseline_of(table):
    return type('Made', (Feedback,), {'parameters_type': table})


def test_a_method_without_finite_objective_is_named(tmp_path):
    def hopeless(method, drive, candidates):
        if method is FEEDBACK:
            return [math.nan] * len(candidates)
        return lag_plant(method, drive, candidates)

    path = tmp_path / 'tuned.json'
    with pytest.raises(RuntimeError, match='P feedback, torque; P feedback, velocity'):
        tune_both(path, hopeless)
    assert list(TunedParameters.load(path)) == [('wider, 2nd', 'velocity')]


def test_results_of_unequal_budgets_do_not_share_a_file(tmp_path):
    path = tmp_path / 'tuned.json'
    tune_both(path, evaluations=20)
    with pytest.raises(StoreError, match='20 evaluations.*this would be 30 evaluations'):
        tune_methods([WIDER], ['velocity'], TuningBudget(30), 1, path, evaluate=lag_plant)
    tune_methods([WIDER], ['velocity'], TuningBudget(20), 1, path, evaluate=lag_plant)
    tune_both(path, evaluations=30)
    budgets = [entry.budget.evaluations for entry in TunedParameters.load(path).values()]
    assert budgets == [30, 30, 30]


def test_methods_that_cannot_be_tuned_are_refused(tmp_path):
    path = tmp_path / 'tuned.json'
    twin = replace(WIDER, name='P-Feedback')
    with pytest.raises(ValueError, match='different names: got p-feedback, p-feedback'):
        tune_methods([FEEDBACK, twin], ['torque'], TuningBudget(), 1, path, evaluate=lag_plant)
    with pytest.raises(ValueError, match="drive 'torque'"):
        tune_methods([WIDER], ['torque'], TuningBudget(), 1, path, evaluate=lag_plant)


# The file of tuned settings

BUDGET = TuningBudget(80, 1, (1, 2, 3), (0.0, 0.04), 30.0, 1e-5)
ENTRY = TunedEntry(Gains(a=1.0 / 3.0).to_dict(), ('a', 'inner.weight'), 0.2, 0.3, BUDGET, '0.1.0')


@pytest.fixture
def stored(tmp_path):
    """Return a function that damages a good file and gives its path back."""
    path = tmp_path / 'tuned.json'
    store = TunedParameters({('one', 'torque'): ENTRY, ('two', 'velocity'): ENTRY})
    store.save(path)

    def damage(change):
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
        return path

    return damage


def test_store_and_file_are_one(stored, tmp_path):
    path = stored(lambda content: None)
    loaded = TunedParameters.load(path)
    assert loaded == {('one', 'torque'): ENTRY, ('two', 'velocity'): ENTRY}
    assert loaded.applied('one', 'torque', Gains(b=3.0)) == Gains(a=1.0 / 3.0, b=3.0)
    loaded.check_equal()
    again = tmp_path / 'again.json'
    loaded.save(again)
    assert TunedParameters.load(again) == loaded
    with pytest.raises(StoreError, match='one was not tuned in drive velocity.*two in velocity'):
        loaded.entry('one', 'velocity')


def _one(content):
    return content['methods']['one']['torque']


@pytest.mark.parametrize(
    'change, complaint',
    [
        (lambda c: _one(c)['values'].update(a=2000.0), 'one, torque: a must be from 0 to 1000'),
        (lambda c: _one(c).update(tuned=['z']), 'z was tuned, but has no value'),
        (lambda c: _one(c).pop('version'), "missing 1 required .* 'version'"),
        (lambda c: _one(c)['budget'].update(evaluations=0), 'evaluations must be at least 1'),
        (lambda c: c.update(format=2), 'format must be 1: got 2'),
        (lambda c: c.update(methods=[]), "no attribute 'items'"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_by_where_and_why(stored, change, complaint):
    path = stored(change)
    with pytest.raises(StoreError, match=complaint):
        TunedParameters.load(path).applied('one', 'torque', Gains())
    path.write_bytes(b'\xff')
    with pytest.raises(StoreError, match='tuned.json holds no tuned parameters'):
        TunedParameters.load(path)


def test_unequal_budgets_are_distinguished():
    other = replace(ENTRY, budget=replace(BUDGET, evaluations=90))
    store = TunedParameters({('one', 'torque'): ENTRY, ('two', 'torque'): other})
    with pytest.raises(
        StoreError, match='two, torque was tuned with 90 eval.*one, torque with 80'
    ):
        store.check_equal()
    elsewhere = TunedParameters({('one', 'torque'): ENTRY, ('two', 'twin'): other})
    elsewhere.check_equal()  # compared with nothing but methods on the twin


# The command line


def test_the_command_tunes_what_was_named(tmp_path, monkeypatch, capsys):
    asked = {}

    def instead(budget, workers, report):
        asked['workers'] = workers
        return _Instead()

    monkeypatch.setattr(tune_module, 'ClosedLoopObjective', instead)
    tunable = 't3mpc_ros.evaluation.method_table.method_definitions'
    monkeypatch.setattr(tunable, lambda: [FEEDBACK, WIDER])
    monkeypatch.setattr('t3mpc_ros.evaluation.method_table.further_definitions', list)
    path = tmp_path / 'tuned.json'
    line = ['tune', 'P-feedback', '--evaluations', '12', '--workers', '3', '--output', str(path)]
    assert main([*line, '--robot', 'servo']) == 0
    store = TunedParameters.load(path)
    assert list(store) == [('P feedback', 'velocity')]
    assert store.entry('P feedback', 'velocity').budget.evaluations == 12
    assert store.entry('P feedback', 'velocity').budget.training_seeds == TUNING_SEEDS
    assert asked == {'workers': 3}
    said = capsys.readouterr()
    assert said.out == store.table() + '\n'
    assert re.search(r'P feedback, velocity: 100%.* 12/12 .*best 0\.', said.err)
    assert main(['tune', *line[2:], '--resume']) == 0
    assert len(TunedParameters.load(path)) == 3


class _Instead:
    def __enter__(self):
        return lag_plant

    def __exit__(self, *_):
        return None


def test_the_packaged_tuning_has_the_names_of_the_methods():
    stored = json.loads(PACKAGED_FILE.read_text())['methods']
    needed = {each.name for each in method_definitions()}
    assert needed <= set(methods('velocity'))
    assert needed <= set(stored) <= needed | {each.name for each in further_definitions()}


def test_the_tables_of_the_pages_have_the_names_of_the_methods():
    """results.md once called them "linear MPC, preview", bags.md "dmc"."""
    docs = PACKAGED_FILE.parents[3] / 'docs'
    every = [name for robot in ROBOTS for name in methods_for(robot)]
    known = {name.partition(', exact')[0] for name in every}
    for page in ('results.md', 'results_tables.md'):
        text = (docs / page).read_text()
        rows = re.findall(r'^\| ([^|]+?) \|(?: [-+–\d.][^|]*\|){3,}', text, re.MULTILINE)
        named = {re.sub(r'\*\*| \(.*\)| [¹²]|, exact model', '', row) for row in rows}
        methods_there = {name for name in named if name in known}
        assert len(methods_there) >= 11, page
        similar = {
            name
            for name in {part for each in named for part in each.split(' less ')} - known
            if re.search(r'MPC|DMC|FLS|ADRC|sliding|torque|feed-forward', name)
        }
        assert not similar, page
