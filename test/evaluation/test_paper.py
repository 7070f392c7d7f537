# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc paper``: the plan, the campaign that can be stopped, statistics, claims and the page."""

import csv
from dataclasses import dataclass, field, fields, replace
from html import unescape
from html.parser import HTMLParser
import json
import math
import re

import matplotlib.image
import numpy as np
import pytest
from scipy import stats
from support.records import record_of
from support.unrendered import unrendered  # noqa: F401 - a fixture

from t3mpc_ros.evaluation.methods import FULL, ComparedMethod
from t3mpc_ros.evaluation.open_loop_estimation import EstimationResult
from t3mpc_ros.evaluation.paper import claims as claiming
from t3mpc_ros.evaluation.paper.claims import markdown
from t3mpc_ros.evaluation.paper.experiment_runs import (
    INTENDED_CASES,
    NOISES,
    PARTS,
    STAGES,
    WITHOUT,
    Experiment,
    ExperimentGrid,
    ExperimentSetup,
    RunFile,
    RunKey,
    RunNumbers,
    fingerprint,
    make_grid,
    measure,
    needed_experiments,
    plain,
    run_missing,
    source_digest,
)
from t3mpc_ros.evaluation.paper.figure_runs import (
    explained,
    follows_claim,
    largest_switch,
    switches_claim,
    switches_of,
)
from t3mpc_ros.evaluation.paper.paper_figures import floor_path
from t3mpc_ros.evaluation.paper.paper_page import EXHIBITS, counted
from t3mpc_ros.evaluation.paper.reproduce import RUNS, PaperOptions, reproduce
from t3mpc_ros.evaluation.paper.results import Results, all_tables, results_of
from t3mpc_ros.evaluation.reporting import finite, progress_bar
from t3mpc_ros.geometry.kinematics import WheelGeometry

pytestmark = pytest.mark.slow

CASES = (
    'nominal', 'mass +30 %', 'mass -30 %', 'friction x3', 'load change', 'disturbance',
    'dead time',
)  # fmt: skip
SEEDS = tuple(range(101, 121))
EXACT = 'linear MPC preview, exact model'


@dataclass(frozen=True)
class FakeMethod:
    name: str
    baseline: bool
    preview: bool
    parameters: dict = field(default_factory=dict)
    controller_type: type | None = None


@dataclass(frozen=True)
class FakeScenario:
    drive: str
    noise: float
    case: str
    seed: int
    duration: float = 60.0


def fake_methods(drive):
    """Return stages that get better one by one, and four baselines that never do."""
    baselines = (
        ('PI + feed-forward', False),
        ('type-1 fuzzy', False),
        ('NMPC', True),
        (EXACT, True),
    )
    table = {name: FakeMethod(name, True, ahead, {'error': 0.9}) for name, ahead in baselines}
    for i, stage in enumerate(STAGES):
        table[stage] = FakeMethod(stage, False, stage == FULL, {'error': 0.5 - 0.08 * i})
    for name in WITHOUT.values():
        table[name] = FakeMethod(name, False, name != WITHOUT['preview'], {'error': 0.3})
    return table


def fake_run(scenario, method):
    """Return a record whose error is white, of the size the settings say, plus the noise."""
    generator = np.random.default_rng((scenario.seed, len(scenario.case)))
    n = round(100 * scenario.duration)
    time = np.arange(n) / 100.0
    run = record_of(time, switches=np.arange(12.0, scenario.duration, 12.0))
    modes = np.minimum(time // 12.0, 4.0)
    phases = generator.uniform(0.0, 6.0, 2)
    reference = 4.0 * np.sin(0.8 * time[:, np.newaxis] + phases + 2.0 * modes[:, np.newaxis])
    size = method.parameters['error'] * (1.0 + scenario.noise)
    run['mode'][:] = modes
    run.reference[:] = reference
    run.speeds[:] = reference + size * generator.standard_normal((n, 2))
    run['acceleration'][:] = np.gradient(reference, 0.01, axis=0)
    run['terms'][:, 0] = generator.standard_normal((n, 2))
    noise = math.sqrt(scenario.noise) * generator.standard_normal((n, 2))
    run['measured'][:] = run.speeds + noise
    return run


class FakeRunner:
    """Runs jobs one by one, in any order, remembers them, and can be stopped."""

    def __init__(self, *, backwards=False, stop_after=None):
        self.done = []
        self.closed = False
        self._backwards, self._stop_after = backwards, stop_after

    def __call__(self, jobs, made_of, workers):
        order = list(enumerate(jobs))
        try:
            for index, (scenario, method) in reversed(order) if self._backwards else order:
                if self._stop_after is not None and len(self.done) == self._stop_after:
                    raise KeyboardInterrupt
                self.done.append((method.name, scenario))
                yield index, made_of(fake_run(scenario, method))
        finally:
            self.closed = True


def fake_setup(runner=None, methods=fake_methods):
    return ExperimentSetup(methods, FakeScenario, runner or FakeRunner(), CASES, SEEDS)


SMALL = ExperimentGrid((101, 102, 103), 6.0, ('nominal', 'dead time'), (0.0, 0.04), (0.04,))


def small_campaign(path, runner, methods=fake_methods, sources='s', report=None):
    made = fake_setup(runner, methods)
    needed = needed_experiments(made, SMALL)
    return run_missing(made, SMALL, needed, RunFile(path), sources, report=report)


# The plan


def test_full_grid_holds_exactly_the_needed_experiments():
    found = needed_experiments(fake_setup(), make_grid(fake_setup()))
    names = fake_methods('torque')
    baselines = {name for name, method in names.items() if method.baseline}
    missing = {name for name in names if name.startswith('full with')}
    stages = set(names) - baselines - missing
    expected = set()
    for drive in ('torque', 'velocity'):
        for noise in NOISES:
            expected |= {Experiment(name, drive, noise, 'nominal') for name in stages | baselines}
            for case in CASES[1:]:
                if drive == 'torque' and case == 'dead time':
                    continue
                if noise in (0.0, 0.04):
                    expected |= {Experiment(name, drive, noise, case) for name in stages}
                if noise == 0.04 and case in ('mass +30 %', 'mass -30 %'):
                    expected |= {
                        Experiment(name, drive, noise, case)
                        for name in baselines
                        if names[name].preview
                    }
        for name in missing:
            for case in ('nominal', *INTENDED_CASES.get(name, ())):
                if drive == 'velocity' or case != 'dead time':
                    expected.add(Experiment(name, drive, 0.04, case))
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_the_quick_plan_is_part_of_the_full_one_and_shorter():
    quick = make_grid(fake_setup(), quick=True)
    assert set(needed_experiments(fake_setup(), quick)) < set(
        needed_experiments(fake_setup(), make_grid(fake_setup()))
    )
    assert len(quick.seeds) == 3
    assert quick.duration < 60.0
    for part, case, drives in claiming.INTENDED:  # what a part is meant for is in the quick one
        for drive in drives:
            assert Experiment(FULL, drive, 0.04, case) in needed_experiments(
                fake_setup(), quick
            ), part


@pytest.mark.parametrize('seeds', [0, 21])
def test_seeds_that_are_not_held_out_cannot_be_asked_for(seeds):
    with pytest.raises(ValueError, match='seeds must be from 1 to 20'):
        make_grid(fake_setup(), seeds=seeds)


def test_a_bench_without_the_full_controller_is_refused():
    lame = fake_setup(methods=lambda drive: {'PI': FakeMethod('PI', True, False)})
    with pytest.raises(ValueError, match='must hold full'):
        needed_experiments(lame, SMALL)


def test_a_stage_marked_as_baseline_is_rejected():
    def confused(drive):
        return fake_methods(drive) | {FULL: FakeMethod(FULL, True, True)}

    with pytest.raises(ValueError, match='must not be baselines: got full'):
        needed_experiments(fake_setup(methods=confused), SMALL)


# The campaign


def test_a_second_start_runs_nothing_and_gives_the_same(tmp_path):
    first, second = FakeRunner(), FakeRunner()
    numbers = small_campaign(tmp_path / 'r', first)
    assert len(first.done) == len(SMALL.seeds) * len(numbers)
    assert small_campaign(tmp_path / 'r', second) == numbers
    assert second.done == []


def test_a_stopped_campaign_goes_on_with_exactly_what_is_missing(tmp_path):
    whole, lines = FakeRunner(), []
    numbers = small_campaign(tmp_path / 'whole', whole)
    stopped, rest = FakeRunner(stop_after=7), FakeRunner(backwards=True)
    with pytest.raises(KeyboardInterrupt):
        small_campaign(tmp_path / 'r', stopped, report=lines.append)
    assert stopped.closed
    assert lines[-1].startswith(f'7 of {len(whole.done)} runs are kept')
    assert small_campaign(tmp_path / 'r', rest, report=lines.append) == numbers
    assert '7 are there already' in lines[-1]
    assert sorted(map(repr, stopped.done + rest.done)) == sorted(map(repr, whole.done))


def test_a_torn_last_line_costs_that_line_only(tmp_path, capsys):
    path = tmp_path / 'r'
    numbers = small_campaign(path, FakeRunner())
    content = path.read_bytes()
    lines = content.splitlines(keepends=True)
    for cut in (1, 20, len(lines[-1]) - 2, len(lines[-1]) - 1):  # the last: only its end is gone
        path.write_bytes(content[: -len(lines[-1])] + lines[-1][:cut])
        runner = FakeRunner()
        assert small_campaign(path, runner) == numbers
        assert len(runner.done) == (0 if cut == len(lines[-1]) - 1 else 1), cut
        file = RunFile(path)
        assert len(file.read()) == len(lines)
        assert small_campaign(path, FakeRunner()) == numbers


def test_lines_that_are_no_runs_are_skipped_and_counted(tmp_path):
    path = tmp_path / 'r'
    numbers = small_campaign(path, FakeRunner())
    path.write_bytes(b'\xff\xfe nonsense\n[1, 2]\n{"method": "full"}\n\n' + path.read_bytes())
    runner, file = FakeRunner(), RunFile(path)
    assert small_campaign(path, runner) == numbers
    assert not runner.done
    file.read()
    assert file.unreadable == 3


def test_new_settings_of_one_method_run_that_method_again_only(tmp_path):
    def changed(drive):
        table = fake_methods(drive)
        table['NMPC'] = replace(table['NMPC'], parameters={'error': 0.8})
        return table

    small_campaign(tmp_path / 'r', FakeRunner())
    runner = FakeRunner()
    numbers = small_campaign(tmp_path / 'r', runner, changed)
    assert {name for name, _ in runner.done} == {'NMPC'}
    assert numbers == small_campaign(tmp_path / 'other', FakeRunner(), changed)


def test_other_sources_run_everything_again(tmp_path):
    first, second = FakeRunner(), FakeRunner()
    small_campaign(tmp_path / 'r', first, sources='old')
    small_campaign(tmp_path / 'r', second, sources='new')
    assert len(second.done) == len(first.done) > 0


def test_a_fresh_file_forgets_its_runs(tmp_path):
    small_campaign(tmp_path / 'r', FakeRunner())
    with RunFile(tmp_path / 'r', fresh=True) as file:
        assert file.read() == {}


def test_two_campaigns_do_not_share_a_file(tmp_path):
    with RunFile(tmp_path / 'r'), pytest.raises(RuntimeError, match='another campaign'):
        small_campaign(tmp_path / 'r', FakeRunner())


def test_runs_that_never_come_back_are_an_error(tmp_path):
    with pytest.raises(RuntimeError, match='never came back'):
        small_campaign(tmp_path / 'r', lambda jobs, made_of, workers: iter(()))


def test_numbers_survive_the_file_bit_for_bit(tmp_path):
    made = fake_setup(FakeRunner())
    needed = needed_experiments(made, SMALL)
    fresh = run_missing(made, SMALL, needed, RunFile(tmp_path / 'r'), 's')
    again = run_missing(fake_setup(), SMALL, needed, RunFile(tmp_path / 'r'), 's')
    for experiment in needed:
        for one, other in zip(fresh[experiment], again[experiment], strict=True):
            assert one.rmse.hex() == other.rmse.hex()
            assert one.chatter.hex() == other.chatter.hex()


def test_what_is_measured_of_a_run():
    run = fake_run(FakeScenario('torque', 0.0, 'nominal', 101, 20.0), fake_methods('')[FULL])
    run.speeds[:] = run.reference
    run.speeds[250] += 9.0  # within the start: nobody looks
    run.speeds[1210] += 0.5  # within the second about the switch at 12 s
    run.speeds[1700, 1] -= 0.25
    found = measure(run)
    counted = 2 * 1700
    assert found.rmse == pytest.approx(math.sqrt((2 * 0.25 + 0.0625) / counted))
    assert found.settled == pytest.approx(math.sqrt(0.0625 / (counted - 200)))
    assert found.largest_error == pytest.approx(0.5)
    assert found.chatter == run.variation()
    assert found.finite


def test_a_diverged_run_is_marked_as_not_finite():
    run = fake_run(FakeScenario('torque', 0.0, 'nominal', 101, 6.0), fake_methods('')[FULL])
    run['acceleration'][-1, 0] = math.inf
    found = measure(run)
    assert not found.finite
    assert math.isnan(found.rmse)


def test_progress_shows_pace_and_time_left(capsys):
    with progress_bar(2) as bar:
        bar.update()
        bar.refresh()
        assert '1/2 [' in capsys.readouterr().err
        bar.update()
    assert '2/2 [' in capsys.readouterr().err
    with progress_bar(2, show=False) as bar:
        bar.update()
    assert capsys.readouterr().err == ''


# The fingerprint


def test_fingerprint_differs_by_parameters_types_arrays():
    method = FakeMethod('m', True, False, {'gains': np.array([1.0, 2.0]), 'count': 3})
    others = [
        replace(method, parameters={'gains': np.array([1.0, 2.5]), 'count': 3}),
        replace(method, parameters={'gains': np.array([1.0, 2.0]), 'count': 4}),
        replace(method, controller_type=FakeMethod),
    ]
    prints = {fingerprint(one, 's') for one in (method, *others)} | {fingerprint(method, 't')}
    assert len(prints) == 5
    for name, value in {'name': 'n', 'baseline': False, 'preview': True}.items():
        prints.add(fingerprint(replace(method, **{name: value}), 's'))
    assert len(prints) == 8
    assert {each.name for each in fields(ComparedMethod)} == {
        'name', 'controller_type', 'parameters', 'pretrained', 'baseline', 'preview',
    }  # fmt: skip
    equal = replace(method, parameters={'count': 3, 'gains': np.array([1.0, 2.0])})
    assert fingerprint(equal, 's') == fingerprint(method, 's')


def test_settings_that_are_not_plain_are_refused():
    """An object without fields prints with its address, so it would never look the same twice."""
    with pytest.raises(TypeError, match='plain data'):
        plain({'inner': object()})


def test_digest_covers_sources_that_change_a_run(tmp_path):
    names = (
        'control/law.py', 'evaluation/baselines/pi.py', 'evaluation/paper/experiment_runs.py',
        'evaluation/paper/page.py', 'nodes/a.py', 'cli/main.py', 'control/__pycache__/law.pyc',
        'control/notes.md',
    )  # fmt: skip
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('one')
    before = source_digest(tmp_path)
    for name in names[3:]:
        (tmp_path / name).write_text('two')
    assert source_digest(tmp_path) == before
    seen = {before}
    for name in names[:3]:
        (tmp_path / name).write_text('two')
        seen.add(source_digest(tmp_path))
    assert len(seen) == 4
    # Runs of a sweep and of a patrol depend on more.
    for name in ('scripting/plants.py', 'worlds/room.yaml', 'evaluation/tuning/tuned.json'):
        before = source_digest(tmp_path, every=True)
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('three')
        assert source_digest(tmp_path, every=True) != before


def test_each_part_of_a_key_makes_another_run(tmp_path):
    experiment = Experiment('m', 'torque', 0.04, 'nominal')
    key = RunKey(experiment, 1, 59.5, 'f')
    others = {'method': 'n', 'drive': 'velocity', 'noise': 0.1, 'case': 'disturbance'}
    keys = [key]
    keys += [replace(key, experiment=replace(experiment, **{k: v})) for k, v in others.items()]
    changes = {'seed': 2, 'duration': 26.0, 'fingerprint': 'g'}
    keys += [replace(key, **{name: value}) for name, value in changes.items()]
    assert {*others} == {each.name for each in fields(Experiment)}
    assert {'experiment', *changes} == {each.name for each in fields(RunKey)}
    written = {each: numbers_of(0.1 + k)[0] for k, each in enumerate(keys)}
    with RunFile(tmp_path / 'runs.jsonl') as file:
        for each, numbers in written.items():
            file.add(each, numbers)
        assert file.read() == written


# Results


def numbers_of(*rmse, chatter=100.0, settled=0.01):
    return tuple(RunNumbers(value, settled, chatter, 2.0 * value, True) for value in rmse)


def table_of(entries, settled=0.01, chatter=None, complete=True):
    """Return results from {(method, drive, noise, case): RMSE of each seed}."""
    kinds = {name: (method.baseline, method.preview) for name, method in fake_methods('').items()}
    chatter = chatter or {}
    numbers = {
        Experiment(*key): numbers_of(*rmse, settled=settled, chatter=chatter.get(key[0], 100.0))
        for key, rmse in entries.items()
    }
    return Results(kinds, numbers, 60.0, complete=complete)


def test_paired_differences_agree_with_the_paired_t_test():
    generator = np.random.default_rng(5)
    first = generator.normal(0.5, 0.1, 12)
    second = first - generator.normal(0.05, 0.02, 12)
    results = table_of(
        {('+MPC', 'torque', 0.04, 'nominal'): first, (FULL, 'torque', 0.04, 'nominal'): second}
    )
    pair = results.paired('+MPC', FULL, 'torque', 0.04)
    bounds = stats.ttest_rel(first, second).confidence_interval(0.95)
    assert pair.difference - pair.ci95 == pytest.approx(bounds.low, rel=1e-3)
    assert pair.difference + pair.ci95 == pytest.approx(bounds.high, rel=1e-3)
    assert not pair.below
    assert results.paired(FULL, '+MPC', 'torque', 0.04).below
    # What all seeds share drops out: unpaired, the same two could not be told apart.
    assert pair.ci95 < 0.5 * results.row(FULL, 'torque', 0.04).rmse_ci95


def test_rows_hold_means_and_intervals_over_the_seeds():
    values = (0.2, 0.3, 0.7)
    row = table_of({(FULL, 'torque', 0.0, 'nominal'): values}).row(FULL, 'torque', 0.0)
    half = stats.t.ppf(0.975, 2) * np.std(values, ddof=1) / math.sqrt(3)
    assert row.rmse_mean == pytest.approx(np.mean(values))
    assert row.rmse_ci95 == pytest.approx(half, rel=1e-3)
    assert (row.seeds, row.largest_error, row.duration) == (3, 1.4, 60.0)


def test_a_diverged_run_shows_in_its_row_and_in_strict_json():
    runs = (RunNumbers(math.nan, math.nan, math.nan, math.nan, False), *numbers_of(0.1, 0.1))
    results = Results(
        {FULL: (False, True)}, {Experiment(FULL, 'torque', 0.0, 'nominal'): runs}, 60.0
    )
    record = finite(results.rows[0].record())
    assert record['finite'] is False
    assert record['rmse_mean'] is None
    json.dumps(record, allow_nan=False)
    assert '| **full** | diverged |' in markdown(all_tables(results, []))


def test_a_single_seed_has_a_mean_without_an_interval():
    row = table_of({(FULL, 'torque', 0.0, 'nominal'): (0.25,)}).rows[0]
    assert finite(row.record())['rmse_ci95'] is None
    assert finite(row.record())['rmse_mean'] == 0.25


def test_stage_differences_compare_measured_neighbours():
    entries = {(stage, 'torque', 0.04, 'nominal'): (0.4, 0.5) for stage in STAGES}
    entries['+MPC', 'torque', 0.04, 'friction x3'] = (0.4, 0.5)
    pairs = table_of(entries).stage_differences()
    assert [(p.first, p.second) for p in pairs] == list(zip(STAGES[1:], STAGES[:-1], strict=True))
    assert {p.case for p in pairs} == {'nominal'}


def test_a_method_must_be_of_one_kind_with_both_drives():
    def mixed(drive):
        return {FULL: FakeMethod(FULL, False, drive == 'torque')}

    with pytest.raises(ValueError, match='same kind'):
        results_of(fake_setup(methods=mixed), SMALL, {})


# Claims


def in_all(drive, noise, values, case='nominal'):
    return {(name, drive, noise, case): runs for name, runs in values.items()}


def verdict(claim):
    assert claim.record()['verdict'] == claim.verdict
    return claim.held


@pytest.mark.parametrize(
    'full, held', [((0.50, 0.58), True), ((0.50, 0.72), False), ((math.nan, 0.1), False)]
)
def test_share_of_best_baseline_excludes_preview(full, held):
    values = {FULL: full, 'PI + feed-forward': (0.9, 1.1), 'type-1 fuzzy': (1.2, 1.2)}
    values['NMPC'] = (0.1, 0.1)
    results = table_of(in_all('velocity', 0.04, values))
    claim = claiming.share_of_best(results, 'velocity', 0.04, 0.60)
    assert verdict(claim) is held
    assert claim.numbers['best_rival'] == 'PI + feed-forward'
    assert verdict(claiming.share_of_best(results, 'velocity', 0.04, 0.6, paper=True)) is False
    assert verdict(claiming.share_of_best(results, 'velocity', 0.0, 0.60)) is None


@pytest.mark.parametrize('nmpc, held', [(0.30, True), (0.31, True), (0.29, False)])
def test_baselines_with_a_wrong_inertia(nmpc, held):
    values = {FULL: (0.3,), 'NMPC': (nmpc,), 'type-1 fuzzy': (0.1,), EXACT: (0.1,)}
    results = table_of(in_all('torque', 0.04, values))
    assert verdict(claiming.no_worse_than_preview(results, 'torque')) is held
    assert verdict(claiming.no_worse_than_preview(results, 'velocity')) is None


@pytest.mark.parametrize('down, held', [(0.30, True), (0.31, True), (0.29, False)])
def test_baselines_with_another_inertia_than_their_model(down, held):
    up = in_all('torque', 0.04, {FULL: (0.3,), EXACT: (0.4,), 'NMPC': (0.1,)}, CASES[1])
    below = in_all('torque', 0.04, {FULL: (0.3,), EXACT: (down,)}, CASES[2])
    assert verdict(claiming.no_worse_than_exact_model(table_of(up | below), 'torque')) is held
    assert verdict(claiming.no_worse_than_exact_model(table_of(up), 'torque')) is None


@pytest.mark.parametrize('part, case, drives', claiming.INTENDED)
def test_a_part_helps_if_its_paired_interval_is_negative(part, case, drives):
    more, less = STAGES[PARTS.index(part) + 1], STAGES[PARTS.index(part)]
    base = (0.5, 0.7, 0.9, 1.1)
    for shift, held in (
        ((-0.10, -0.11, -0.12, -0.10), True),
        ((-0.10, 0.09, -0.12, 0.10), False),
        ((0.10, 0.11, 0.12, 0.10), False),
    ):
        better = tuple(np.add(base, shift))
        for drive in drives:
            results = table_of(in_all(drive, 0.04, {more: better, less: base}, case))
            assert verdict(claiming.part_helps(results, part, case, drive)) is held
            out = table_of(in_all(drive, 0.04, {FULL: better, WITHOUT[part]: base}, case))
            assert verdict(claiming.part_is_missed(out, part, case, drive)) is held
    one = table_of(in_all(drives[0], 0.04, {more: (0.1,), less: (0.9,)}, case))
    assert verdict(claiming.part_helps(one, part, case, drives[0])) is None
    assert verdict(claiming.part_helps(table_of({}), part, case, drives[0])) is None


@pytest.mark.parametrize('pi, held', [(0.2, True), (0.1999, False)])
def test_noise_free_against_pi_with_feed_forward(pi, held):
    values = {FULL: (0.2,), 'PI + feed-forward': (pi,), 'type-1 fuzzy': (0.01,)}
    results = table_of(in_all('velocity', 0.0, values))
    assert verdict(claiming.no_larger_than_pi(results, 'velocity')) is held
    assert verdict(claiming.no_larger_than_pi(results, 'torque')) is None


def growing(**ends):
    names = {'full': FULL, 'pi': 'PI + feed-forward', 'nmpc': 'NMPC'}
    first = {names[key]: (values[0],) for key, values in ends.items()}
    last = {names[key]: (values[1],) for key, values in ends.items()}
    return table_of(in_all('torque', 0.0, first) | in_all('torque', 0.1, last))


@pytest.mark.parametrize(
    'full, smallest, slightly',
    [((0.2, 0.21), True, True), ((0.2, 0.30), True, False), ((0.2, 0.45), False, False)],
)
def test_growth_with_noise_in_rad_per_s_and_in_shares(full, smallest, slightly):
    results = growing(full=full, pi=(0.5, 0.7), nmpc=(0.1, 0.4))
    assert verdict(claiming.smallest_growth(results, 'torque')) is smallest
    assert verdict(claiming.grows_slightly(results, 'torque')) is slightly
    assert verdict(claiming.others_grow(results, 'torque')) is False  # PI: by 40 %
    assert verdict(claiming.others_grow(growing(full=full, nmpc=(0.1, 0.4)), 'torque')) is True
    for claim in (claiming.smallest_growth, claiming.grows_slightly, claiming.others_grow):
        assert verdict(claim(results, 'velocity')) is None


def test_who_diverges_under_noise_grows_most():
    results = growing(full=(0.2, 0.9), pi=(0.5, math.nan))
    assert verdict(claiming.smallest_growth(results, 'torque')) is True
    results = growing(full=(0.2, math.nan), pi=(0.5, math.nan))
    assert verdict(claiming.smallest_growth(results, 'torque')) is False


@pytest.mark.parametrize('settled, held', [(0.0599, True), (0.0601, False)])
def test_settled_within_two_per_cent_of_the_reference(settled, held):
    results = table_of(in_all('torque', 0.0, {FULL: (0.5,)}), settled=settled)
    assert verdict(claiming.settled(results, 'torque')) is held


@pytest.mark.parametrize('own, held', [(100.0, True), (301.0, False)])
def test_chatter_claim_compares_the_median_baseline(own, held):
    values = {FULL: (0.1,), 'PI + feed-forward': (0.1,), 'type-1 fuzzy': (0.1,), 'NMPC': (0.1,)}
    chatter = {FULL: own, 'PI + feed-forward': 50.0, 'type-1 fuzzy': 300.0, 'NMPC': 9000.0}
    results = table_of(in_all('torque', 0.04, values), chatter=chatter)
    assert verdict(claiming.calm_control(results, 'torque')) is held


@pytest.mark.parametrize(
    'type3, half, slight', [((0.05, 0.04, 0.054), True, True), ((0.1, 0.2, 0.3), False, False)]
)
def test_estimation_claims_of_the_paper(type3, half, slight):
    others = {'interval_type2': (0.1, 0.1, 0.3), 'type1': (0.1, 0.2, 0.3)}
    kinds = {'type3': type3} | others
    results = [
        EstimationResult(kind, noise, (value,), (1.0,))
        for kind, values in kinds.items()
        for noise, value in zip((0.0, 0.04, 0.1), values, strict=True)
    ]
    found = {claim.name: claim.held for claim in claiming.estimation_claims(results)}
    assert found == {
        'estimation, half of the others': half,
        'estimation, grows only slightly': slight,
    }
    assert {claim.held for claim in claiming.estimation_claims([])} == {None}


@pytest.mark.parametrize(
    'full, word',
    [
        ((0.50, 0.51, 0.49), 'held'),
        ((0.50, 0.68, 0.61), 'inconclusive'),
        ((0.50, 0.75, 0.70), 'inconclusive'),
        ((0.80, 0.82, 0.81), 'not held'),
        ((0.50,), 'inconclusive'),
        ((0.99,), 'inconclusive'),
        ((math.nan, 0.1, 0.1), 'not held'),
    ],
)
def test_few_seeds_decide_only_what_their_interval_does(full, word):
    """``paper --quick`` once reported claims as not held that three seeds cannot decide."""
    values = {FULL: full, 'PI + feed-forward': (1.0, 1.0, 1.0)[: len(full)]}
    few = table_of(in_all('velocity', 0.04, values), complete=False)
    claim = claiming.share_of_best(few, 'velocity', 0.04, 0.60)
    assert claim.record()['verdict'] == claim.verdict == word
    assert claim.held is {'held': True, 'not held': False, 'inconclusive': None}[word]
    # The criterion decides when all seeds are there.
    whole = table_of(in_all('velocity', 0.04, values))
    assert claiming.share_of_best(whole, 'velocity', 0.04, 0.60).verdict in ('held', 'not held')


def test_one_seed_leaves_every_claim_inconclusive():
    """A complete grid of one seed: nothing is held, nothing is not held."""
    setup = fake_setup()
    grid = make_grid(setup, quick=True, seeds=1)
    generator = np.random.default_rng(7)
    numbers = {
        experiment: (RunNumbers(*generator.uniform(0.01, 1.0, 4).tolist(), True),)
        for experiment in needed_experiments(setup, grid)
    }
    results = results_of(setup, grid, numbers)
    assert not results.complete
    estimated = [
        EstimationResult(kind, noise, (0.3,), (1.0,))
        for kind in ('type3', 'interval_type2', 'type1')
        for noise in (0.0, 0.04, 0.1)
    ]
    claims = claiming.all_claims(results, estimated)
    assert {claim.verdict for claim in claims} == {'inconclusive', 'not measured'}
    assert {claim.verdict for claim in claims[-2:]} == {'inconclusive'}  # estimation
    assert re.match(r'0 held, 0 not held, [1-9]\d* inconclusive, ', counted(claims))


def test_all_seeds_with_the_whole_duration_are_complete():
    setup = fake_setup()
    runs = numbers_of(*np.linspace(0.1, 0.2, 20))
    for quick, seeds, complete in ((False, None, True), (False, 19, False), (True, 20, False)):
        grid = make_grid(setup, quick=quick, seeds=seeds)
        results = results_of(setup, grid, {Experiment(FULL, 'torque', 0.0, 'nominal'): runs})
        assert results.complete is complete


@pytest.mark.parametrize('length, word', [(26.0, 'inconclusive'), (60.0, 'not held')])
def test_a_short_run_refutes_no_claim_about_a_run(length, word):
    scenario = FakeScenario('torque', 0.04, 'nominal', 101, length)
    run = fake_run(scenario, fake_methods('')['PI + feed-forward'])
    assert follows_claim(run).verdict == word


def test_without_results_every_claim_is_not_measured():
    found = claiming.all_claims(table_of({}), [])
    assert {claim.verdict for claim in found} == {'not measured'}
    names = [claim.name for claim in found]
    assert len(names) == len(set(names))
    assert {claim.origin for claim in found} == {'ours', 'paper'}
    for exhibit in EXHIBITS:
        if exhibit.claims:
            missing = [start for start in exhibit.claims if not any_starts(names, start)]
            of_runs = {'four switches', 'outputs follow', 'estimates follow'}
            assert set(missing) <= of_runs, exhibit.title


def any_starts(names, start):
    return any(name.startswith(start) for name in names)


def test_the_mark_of_an_exhibit_is_that_of_its_worst_claim():
    exhibit = next(e for e in EXHIBITS if len(e.claims) > 1)
    made = [claiming.Claim(name, 'ours', '', held=True) for name in exhibit.claims]
    assert exhibit.mark(made) == 'held'
    assert exhibit.mark([*made[:-1], replace(made[-1], held=None)]) == 'not measured'
    assert exhibit.mark([*made[:-1], replace(made[-1], held=False)]) == 'not held'
    unknown = replace(made[-1], held=None, inconclusive=True)
    assert exhibit.mark([*made[:-1], unknown]) == 'inconclusive'
    assert exhibit.mark([]) == 'not measured'
    assert replace(exhibit, comparable=False).mark(made) == 'not comparable'


# What is measured in a single run


def test_explained_share_is_one_if_perfect_zero_if_none():
    run = fake_run(FakeScenario('torque', 0.04, 'nominal', 101, 20.0), fake_methods('')[FULL])
    run['terms'][:-1, 0] = -(np.diff(run.speeds, axis=0) / 0.01 - run['acceleration'][:-1])
    assert explained(run) == pytest.approx((1.0, 1.0), abs=1e-9)
    run['terms'][:, 0] = 0.0
    assert max(explained(run)) <= 0.0


def test_switches_are_counted_and_only_a_whole_run_decides():
    method = fake_methods('')[FULL]
    run = fake_run(FakeScenario('torque', 0.04, 'nominal', 101, 60.0), method)
    assert switches_of(run) == pytest.approx([12.0, 24.0, 36.0, 48.0])
    assert switches_claim(run).held is True
    run['mode'][:] = 0
    assert switches_claim(run).held is False
    assert largest_switch(run) is None
    assert switches_claim(fake_run(FakeScenario('', 0.0, '', 1, 30.0), method)).held is None


def test_the_path_on_the_floor_is_exact_for_lines_and_circles():
    geometry = WheelGeometry()
    time = np.arange(2001) / 100.0
    straight = floor_path(np.full((2001, 2), 2.0), time)
    assert straight[-1] == pytest.approx((20.0 * 2.0 * geometry.wheel_radius, 0.0))
    rate = 2.0 * math.pi / 20.0  # once round in the whole run, wheels 1 rad/s on average
    turn = rate * geometry.half_separation / geometry.wheel_radius
    circle = floor_path(np.tile((1.0 + turn, 1.0 - turn), (2001, 1)), time)
    radius = geometry.wheel_radius / rate
    assert circle[-1] == pytest.approx((0.0, 0.0), abs=1e-9)
    assert circle[1000] == pytest.approx((0.0, 2.0 * radius))


# All of it


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    output = tmp_path_factory.mktemp('paper')
    options = PaperOptions(output, quick=True, seeds=2, estimation_seeds=1, json=output / 'copy')
    reproduce(fake_setup(), options)
    return output


def test_the_json_has_what_is_promised(folder):
    content = json.loads((folder / 'results.json').read_text())
    assert {'results', 'claims', 'parameters', 'version', 'estimation'} <= set(content)
    keys = {
        'controller', 'baseline', 'preview', 'drive', 'noise', 'case', 'rmse_mean', 'rmse_ci95',
        'settled_mean', 'settled_ci95', 'chatter_mean', 'largest_error', 'finite', 'seeds',
        'duration',
    }  # fmt: skip
    situations = set()
    for row in content['results']:
        assert set(row) == keys
        assert row['drive'] in ('torque', 'velocity')
        assert row['seeds'] == 2
        assert row['rmse_mean'] > 0.0
        assert row['rmse_ci95'] > 0.0
        situations.add(tuple(row[name] for name in ('controller', 'drive', 'noise', 'case')))
    assert len(situations) == len(content['results'])
    assert (FULL, 'velocity', 0.04, 'nominal') in situations
    assert {row['kind'] for row in content['estimation']} >= {'type1', 'type3'}
    assert all(claim['held'] in (True, False, None) for claim in content['claims'])
    assert content['parameters']['seeds'] == [101, 102]
    assert (folder / 'copy').read_text() == (folder / 'results.json').read_text()


def test_the_csv_equals_the_json(folder):
    content = json.loads((folder / 'results.json').read_text())
    rows = content['results'] + content['exact_models']
    assert not any('exact model' in row['controller'] for row in content['results'])
    with (folder / 'results.csv').open(newline='') as stream:
        read = list(csv.DictReader(stream))
    assert list(read[0]) == list(rows[0])
    for one, other in zip(read, rows, strict=True):
        for name, value in other.items():
            if isinstance(value, bool):
                assert one[name] == str(value).lower()
            elif isinstance(value, str):
                assert one[name] == value
            else:
                assert float(one[name]) == value


def test_every_figure_is_drawn_wide_enough_and_not_empty(folder):
    drawn = {path.stem for path in (folder / 'figures').glob('*.png')}
    assert drawn == {exhibit.stem for exhibit in EXHIBITS if exhibit.draw is not None}
    for path in (folder / 'figures').glob('*.png'):
        picture = matplotlib.image.imread(path)
        assert picture.shape[1] >= 800, path.name
        inked = np.mean(np.any(picture[..., :3] < 0.85, axis=2))
        assert 0.005 < inked < 0.7, path.name


class Loads(HTMLParser):
    """Collects all that a page would load, or lead to."""

    def __init__(self):
        super().__init__()
        self.found, self.tags = [], []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        names = ('src', 'href', 'srcset', 'data', 'action')
        self.found += [value for name, value in attributes if name in names]


def test_the_page_is_self_contained_and_shows_everything(folder):
    text = (folder / 'paper.html').read_text()
    page = Loads()
    page.feed(text)
    inside = ('data:image/png;base64,', '#')
    assert all(value.startswith(inside) for value in page.found)
    assert not {'script', 'link', 'iframe'} & set(page.tags)
    assert 'url(' not in text
    assert '@import' not in text
    assert page.tags.count('img') == sum(exhibit.draw is not None for exhibit in EXHIBITS)
    assert page.tags.count('section') == len(EXHIBITS)
    assert page.tags.index('img') < page.tags.index('nav') < page.tags.index('details')
    for mark in ('held', 'not held', 'inconclusive', 'not measured', 'not comparable'):
        assert f'">{mark}</span>' in text
    for claim in json.loads((folder / 'results.json').read_text())['claims']:
        assert claim['found'].split('<')[0][:30] in unescape(text)


def test_the_markdown_holds_the_numbers_of_the_json(folder):
    text = (folder / 'tables.md').read_text()
    content = json.loads((folder / 'results.json').read_text())
    for row in content['results']:
        assert f'{row["rmse_mean"]:.3f} ± {row["rmse_ci95"]:.3f}' in text
    for pair in content['stage_differences'] + content['losses']:
        assert f'{pair["difference"]:+.4f} ± {pair["ci95"]:.4f}' in text
    blocks = [block.splitlines() for block in text.split('\n\n') if block.startswith('|')]
    assert blocks
    for block in blocks:
        assert len({line.count('|') for line in block}) == 1


@pytest.mark.usefixtures('unrendered')
def test_nothing_depends_on_the_order_of_the_runs_or_on_a_resume(folder, tmp_path):
    lines = (folder / RUNS).read_text().splitlines(keepends=True)
    (tmp_path / RUNS).write_text(''.join(lines[::-3]) + lines[1][:-9])
    options = PaperOptions(tmp_path, quick=True, seeds=2, estimation_seeds=1, workers=3)
    runner = FakeRunner(backwards=True)
    reproduce(fake_setup(runner), options)
    assert len(runner.done) < len(lines)
    for name in ('results.json', 'results.csv', 'tables.md'):
        assert (tmp_path / name).read_text() == (folder / name).read_text(), name


@pytest.mark.usefixtures('unrendered')
def test_a_fresh_start_runs_everything_again(folder, tmp_path):
    (tmp_path / RUNS).write_text(text := (folder / RUNS).read_text())
    options = PaperOptions(tmp_path, quick=True, seeds=2, estimation_seeds=1, fresh=True)
    reproduce(fake_setup(runner := FakeRunner()), options)
    assert len(runner.done) >= len(text.splitlines())  # and those of the figures
