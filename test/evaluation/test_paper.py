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
"""``t3mpc paper``: the runs of the study, statistics, claims and the page."""

from concurrent.futures import ThreadPoolExecutor
import csv
from dataclasses import replace
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

from t3mpc_ros.evaluation import experiment, open_loop_estimation
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.methods import FULL, methods
from t3mpc_ros.evaluation.paper import reproduce as reproduction
from t3mpc_ros.evaluation.paper import study
from t3mpc_ros.evaluation.paper.claims import (
    ALONE,
    INTENDED,
    VERDICTS,
    Claim,
    all_claims,
    markdown,
)
from t3mpc_ros.evaluation.paper.paper_figures import (
    explained,
    floor_path,
    follows_claim,
    largest_switch,
    switches_claim,
)
from t3mpc_ros.evaluation.paper.paper_tables import Results, all_tables
from t3mpc_ros.evaluation.paper.reproduce import EXHIBITS, RUNS, counted, reproduce
from t3mpc_ros.evaluation.paper.study import (
    DRIVES,
    INTENDED_CASES,
    NOISES,
    NUMBERS,
    PARTS,
    STAGES,
    WITHOUT,
    Extent,
    chosen_extent,
    measure,
    study_runs,
)
from t3mpc_ros.evaluation.record import switch_times
from t3mpc_ros.evaluation.reporting import finite
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, Scenario
from t3mpc_ros.geometry.kinematics import WheelGeometry

pytestmark = pytest.mark.slow

PI, FUZZY, NMPC = 'PI + feed-forward', 'adaptive T1-FLS', 'CasADi NMPC'
EXACT = 'linear MPC preview, exact model'
METHODS = methods('torque')


def fake_run(scenario, method):
    """Return a record with a white error, smaller with each stage, which grows with the noise."""
    generator = np.random.default_rng((scenario.seed, len(scenario.case)))
    n = round(100 * scenario.duration)
    time = np.arange(n) / 100.0
    run = record_of(time, switches=np.arange(12.0, scenario.duration, 12.0))
    modes = np.minimum(time // 12.0, 4.0)
    phases = generator.uniform(0.0, 6.0, 2)
    reference = 4.0 * np.sin(0.8 * time[:, np.newaxis] + phases + 2.0 * modes[:, np.newaxis])
    size = 0.9 if method.baseline else 0.3
    if method.name in STAGES:
        size = 0.5 - 0.08 * STAGES.index(method.name)
    run['mode'][:] = modes
    run.reference[:] = reference
    size *= 1.0 + scenario.noise
    run.speeds[:] = reference + size * generator.standard_normal((n, 2))
    run['acceleration'][:] = np.gradient(reference, 0.01, axis=0)
    run['terms'][:, 0] = generator.standard_normal((n, 2))
    noise = math.sqrt(scenario.noise) * generator.standard_normal((n, 2))
    run['measured'][:] = run.speeds + noise
    return run


def record(duration, method=FULL):
    return fake_run(Scenario('torque', 'nominal', 101, duration), METHODS[method])


# The runs of the study


def situations(extent):
    names = ('controller', 'drive', 'noise', 'case', 'seed')
    return [tuple(run.fields[name] for name in names) for run in study_runs(extent)]


@pytest.mark.long
def test_full_study_holds_exactly_the_needed_runs():
    found = situations(chosen_extent())
    baselines = {name for name, method in METHODS.items() if method.baseline}
    expected = set()
    for drive in DRIVES:
        for noise in NOISES:
            expected |= {(name, drive, noise, 'nominal') for name in {*STAGES} | baselines}
            for case in Extent().cases[1:]:
                if drive == 'torque' and case == 'dead time':
                    continue
                if noise in (0.0, 0.04):
                    expected |= {(name, drive, noise, case) for name in STAGES}
                if noise == 0.04 and case in ('mass +30 %', 'mass -30 %'):
                    ahead = {name for name in baselines if METHODS[name].preview}
                    expected |= {(name, drive, noise, case) for name in ahead}
        for name in WITHOUT.values():
            for case in ('nominal', *INTENDED_CASES.get(name, ())):
                if drive == 'velocity' or case != 'dead time':
                    expected.add((name, drive, 0.04, case))
    assert len(found) == len(set(found))
    assert set(found) == {(*each, seed) for each in expected for seed in HELD_OUT_SEEDS}


def test_the_quick_study_is_part_of_the_full_one_and_shorter(monkeypatch):
    monkeypatch.setattr(study, 'digest', lambda *_: '')  # keys of thousands of runs
    quick = chosen_extent(quick=True)
    found = situations(quick)
    assert set(found) < set(situations(chosen_extent()))
    assert len(quick.seeds) == 3
    assert quick.duration < 60.0
    for _, case, drives in INTENDED:  # what a part is meant for is in the quick one
        for drive in drives:
            assert (FULL, drive, 0.04, case, 101) in found


@pytest.mark.parametrize('seeds', [(9,), (120, 121)])
def test_seeds_that_are_not_held_out_cannot_be_asked_for(seeds):
    with pytest.raises(ValueError, match='seeds must be of 101-120'):
        chosen_extent(seeds=seeds)


def test_runs_have_keys_of_their_own_and_of_their_method(monkeypatch):
    small = Extent((101, 102), 6.0, ('nominal', 'dead time'), (0.0, 0.04))
    before = study_runs(small)
    longer = study_runs(replace(small, duration=7.0))
    assert len({run.key for run in before + longer}) == 2 * len(before)

    def changed(drive):
        gain = METHODS['ADRC'].parameters.with_values({'gain': 7.0})
        return {**methods(drive), 'ADRC': replace(METHODS['ADRC'], parameters=gain)}

    monkeypatch.setattr(study, 'methods', changed)
    after = study_runs(small)
    apart = [run for run, other in zip(after, before, strict=True) if run.key != other.key]
    assert {run.fields['controller'] for run in apart} == {'ADRC'}
    monkeypatch.setattr(study, 'measure', lambda record: {})
    assert not {run.key for run in study_runs(small)} & {run.key for run in before}


def test_what_is_measured_of_a_run():
    run = record(20.0)
    run.speeds[:] = run.reference
    run.speeds[250] += 9.0  # within the start: nobody looks
    run.speeds[1210] += 0.5  # within the second about the switch at 12 s
    run.speeds[1700, 1] -= 0.25
    counted = 2 * 1700
    assert measure(run) == {
        'rmse': pytest.approx(math.sqrt((2 * 0.25 + 0.0625) / counted)),
        'settled': pytest.approx(math.sqrt(0.0625 / (counted - 200))),
        'largest_error': pytest.approx(0.5),
        'chatter': run.variation(),
        'finite': True,
    }


def test_a_diverged_run_is_marked_as_not_finite():
    run = record(6.0)
    run['acceleration'][-1, 0] = math.inf
    found = measure(run)
    assert not found['finite']
    assert all(math.isnan(found[name]) for name in NUMBERS)


# Results


def table_of(entries, *, few=False, settled=0.01, chatter=None, duration=59.5):
    """Return made-up runs from {(method, drive, noise, case): RMSE of each seed}.

    Values are repeated for all held-out seeds; with ``few`` there are no more seeds than values.
    """
    rows = []
    for (name, drive, noise, case), values in entries.items():
        values = values if few else np.resize(values, len(HELD_OUT_SEEDS))
        fields = {
            'controller': name, 'baseline': METHODS[name].baseline,
            'preview': METHODS[name].preview, 'drive': drive, 'noise': noise, 'case': case,
            'settled': settled, 'chatter': (chatter or {}).get(name, 100.0), 'duration': duration,
        }  # fmt: skip
        for seed, rmse in zip(HELD_OUT_SEEDS, values, strict=False):
            numbers = {'rmse': float(rmse), 'largest_error': 2.0 * float(rmse)}
            rows.append({**fields, **numbers, 'seed': seed, 'finite': math.isfinite(rmse)})
    return ResultTable(rows)


def in_all(drive, noise, values, case='nominal'):
    return {(name, drive, noise, case): runs for name, runs in values.items()}


def test_paired_differences_agree_with_the_paired_t_test():
    generator = np.random.default_rng(5)
    first = generator.normal(0.5, 0.1, 12)
    second = first - generator.normal(0.05, 0.02, 12)
    entries = in_all('torque', 0.04, {'+MPC': first, FULL: second})
    results = Results(table_of(entries, few=True))
    (pair,) = results.added
    bounds = stats.ttest_rel(second, first).confidence_interval(0.95)
    assert pair['difference'] - pair['ci95'] == pytest.approx(bounds.low, rel=1e-3)
    assert pair['difference'] + pair['ci95'] == pytest.approx(bounds.high, rel=1e-3)
    # What all seeds share drops out: unpaired, the same two could not be told apart.
    assert pair['ci95'] < 0.5 * results.row(FULL, 'torque', 0.04)['rmse_ci95']


def test_a_diverged_run_shows_in_its_row_and_in_strict_json():
    results = Results(table_of(in_all('torque', 0.04, {FULL: (math.nan, 0.1)})))
    row = finite(results.means[0])
    assert row['finite'] is False
    assert row['rmse_mean'] is row['largest_error'] is None
    json.dumps(row, allow_nan=False)
    assert '| **full** | diverged |' in markdown(all_tables(results, ResultTable([])), [])


def test_a_single_seed_has_a_mean_without_an_interval():
    results = Results(table_of(in_all('torque', 0.0, {FULL: (0.25,)}), few=True))
    assert finite(results.means[0])['rmse_ci95'] is None
    assert finite(results.means[0])['rmse_mean'] == 0.25


def test_stage_differences_compare_measured_neighbours():
    entries = in_all('torque', 0.04, dict.fromkeys(STAGES, (0.4, 0.5)))
    entries['+MPC', 'torque', 0.04, 'friction x3'] = (0.4, 0.5)
    pairs = Results(table_of(entries)).added
    found = [(pair['first'], pair['second']) for pair in pairs]
    assert found == list(zip(STAGES[1:], STAGES[:-1], strict=True))
    assert pairs.unique('case') == ('nominal',)


# Claims


def claims_of(entries, estimated=(), **numbers):
    """Return the claims on made-up runs by name."""
    found = all_claims(table_of(entries, **numbers), ResultTable(estimated))
    assert all(claim.record()['verdict'] == claim.verdict for claim in found)
    return {claim.name: claim for claim in found}


SHARE = 'share of the best baseline without preview, velocity, noise '


@pytest.mark.parametrize(
    'full, held', [((0.50, 0.58), True), ((0.50, 0.72), False), ((math.nan, 0.1), False)]
)
def test_share_of_best_baseline_excludes_preview(full, held):
    values = {FULL: full, PI: (0.9, 1.1), FUZZY: (1.2, 1.2), NMPC: (0.1, 0.1)}
    found = claims_of(in_all('velocity', 0.04, values))
    assert found[f'{SHARE}0.04'].held is held
    assert found[f'{SHARE}0.04'].numbers['best_rival'] == PI
    assert found['half of the best baseline, velocity, noise 0.04'].held is False
    assert found[f'{SHARE}0'].held is None


@pytest.mark.parametrize('other, held', [(0.30, True), (0.31, True), (0.29, False)])
def test_baselines_with_preview_and_a_wrong_inertia(other, held):
    name = 'baselines with preview, wrong inertia '
    values = {FULL: (0.3,), NMPC: (other,), FUZZY: (0.1,), EXACT: (0.1,)}
    found = claims_of(in_all('torque', 0.04, values))
    assert found[f'{name}in their models, torque'].held is held
    assert found[f'{name}in their models, velocity'].held is None
    up = in_all('torque', 0.04, {FULL: (0.3,), EXACT: (0.4,), NMPC: (0.1,)}, 'mass +30 %')
    down = in_all('torque', 0.04, {FULL: (0.3,), EXACT: (other,)}, 'mass -30 %')
    assert claims_of(up | down)[f'{name}of the robot, torque'].held is held
    assert claims_of(up)[f'{name}of the robot, torque'].held is None


@pytest.mark.parametrize('part, case, drives', INTENDED + ALONE)
def test_a_part_helps_if_its_paired_interval_is_negative(part, case, drives):
    pairs = {f'{part} is missed': (FULL, WITHOUT[part])}
    if part in PARTS:
        less, more = STAGES[PARTS.index(part) :][:2]
        pairs[f'{part} lowers RMSE'] = more, less
    base = np.array((0.5, 0.7, 0.9, 1.1))
    for name, (more, less) in pairs.items():
        for drive in drives:
            claim = f'{name}, {case}, {drive}'
            for shift, held in (
                ((-0.10, -0.11, -0.12, -0.10), True),
                ((-0.10, 0.09, -0.12, 0.10), False),
                ((0.10, 0.11, 0.12, 0.10), False),
                ((math.nan, -0.11, -0.12, -0.10), False),
            ):
                entries = in_all(drive, 0.04, {more: base + shift, less: base}, case)
                assert claims_of(entries)[claim].held is held
            one = in_all(drive, 0.04, {more: (0.1,), less: (0.9,)}, case)
            assert claims_of(one, few=True)[claim].verdict == 'inconclusive'


@pytest.mark.parametrize('pi, held', [(0.2, True), (0.1999, False)])
def test_noise_free_against_pi_with_feed_forward(pi, held):
    found = claims_of(in_all('velocity', 0.0, {FULL: (0.2,), PI: (pi,), FUZZY: (0.01,)}))
    assert found['noise-free against PI, velocity'].held is held
    assert found['noise-free against PI, torque'].held is None


def growing(**ends):
    names = {'full': FULL, 'pi': PI, 'nmpc': NMPC}
    first = {names[key]: (values[0],) for key, values in ends.items()}
    last = {names[key]: (values[1],) for key, values in ends.items()}
    return claims_of(in_all('torque', 0.0, first) | in_all('torque', 0.1, last))


GROWTH = ('smallest growth with noise', 'grows only slightly', 'others grow by half')


@pytest.mark.parametrize(
    'full, smallest, slightly',
    [((0.2, 0.21), True, True), ((0.2, 0.30), True, False), ((0.2, 0.45), False, False)],
)
def test_growth_with_noise_in_rad_per_s_and_in_shares(full, smallest, slightly):
    found = growing(full=full, pi=(0.5, 0.7), nmpc=(0.1, 0.4))  # PI: by 40 %
    assert [found[f'{name}, torque'].held for name in GROWTH] == [smallest, slightly, False]
    assert {found[f'{name}, velocity'].held for name in GROWTH} == {None}
    assert growing(full=full, nmpc=(0.1, 0.4))['others grow by half, torque'].held is True


@pytest.mark.parametrize('last, held', [(0.9, True), (math.nan, False)])
def test_what_diverges_under_noise_grows_most(last, held):
    found = growing(full=(0.2, last), pi=(0.5, math.nan))
    assert found['smallest growth with noise, torque'].held is held


@pytest.mark.parametrize('settled, held', [(0.0599, True), (0.0601, False)])
def test_settled_within_two_per_cent_of_the_reference(settled, held):
    found = claims_of(in_all('torque', 0.0, {FULL: (0.5,)}), settled=settled)
    assert found['settled, torque'].held is held


@pytest.mark.parametrize('own, held', [(100.0, True), (301.0, False)])
def test_chatter_claim_compares_the_median_baseline(own, held):
    chatter = {FULL: own, PI: 50.0, FUZZY: 300.0, NMPC: 9000.0}
    entries = in_all('torque', 0.04, dict.fromkeys(chatter, (0.1,)))
    assert claims_of(entries, chatter=chatter)['no chatter, torque'].held is held


@pytest.mark.parametrize(
    'type3, half, slight', [((0.05, 0.04, 0.054), True, True), ((0.1, 0.2, 0.3), False, False)]
)
def test_estimation_claims_of_the_paper(type3, half, slight):
    kinds = {'type3': type3, 'interval_type2': (0.1, 0.1, 0.3), 'type1': (0.1, 0.2, 0.3)}
    for count, verdicts in ((20, [half, slight]), (1, [None, None])):
        estimated = [
            {'kind': kind, 'noise_variance': noise, 'seed': seed, 'speed': value}
            for kind, values in kinds.items()
            for noise, value in zip((0.0, 0.04, 0.1), values, strict=True)
            for seed in range(count)
        ]
        found = claims_of(in_all('torque', 0.0, {FULL: (0.5,)}), estimated)
        names = 'estimation, half of the others', 'estimation, grows only slightly'
        assert [found[name].held for name in names] == verdicts


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
    entries = in_all('velocity', 0.04, {FULL: full, PI: (1.0,) * len(full)})
    claim = claims_of(entries, few=True)[f'{SHARE}0.04']
    assert claim.verdict == word
    assert claim.held is {'held': True, 'not held': False, 'inconclusive': None}[word]
    # The criterion decides when all seeds are there, with runs of the whole length.
    assert claims_of(entries)[f'{SHARE}0.04'].verdict in ('held', 'not held')
    if word == 'inconclusive' and len(full) > 1:
        wide = in_all('velocity', 0.04, {FULL: (0.1, 1.2), PI: (1.0,)})
        assert claims_of(wide)[f'{SHARE}0.04'].verdict == 'not held'
        assert claims_of(wide, duration=26.0)[f'{SHARE}0.04'].verdict == 'inconclusive'


def test_one_seed_leaves_every_claim_inconclusive():
    """All situations with one seed: nothing is held, nothing is not held."""
    generator = np.random.default_rng(7)
    runs = study_runs(chosen_extent(quick=True, seeds=(101,)))
    table = ResultTable(
        [run.fields | dict(zip(NUMBERS, generator.uniform(0.01, 1.0, 4), strict=True))
         for run in runs]
    )  # fmt: skip
    claims = all_claims(table, ResultTable([]))
    assert {claim.verdict for claim in claims} == {'inconclusive', 'not measured'}
    assert re.match(r'0 held, 0 not held, [1-9]\d* inconclusive, ', counted(claims))


@pytest.mark.parametrize('length, word', [(26.0, 'inconclusive'), (60.0, 'not held')])
def test_a_short_run_refutes_no_claim_about_a_run(length, word):
    assert follows_claim(record(length, PI)).verdict == word


def test_without_results_every_claim_is_not_measured():
    found = claims_of({}).values()
    assert {claim.verdict for claim in found} == {'not measured'}
    names = [claim.name for claim in found]
    assert len(names) == len(set(names))
    assert {claim.origin for claim in found} == {'ours', 'paper'}
    of_runs = {'four switches', 'outputs follow', 'estimates follow'}
    for exhibit in EXHIBITS:
        for start in {*exhibit.claims} - of_runs:
            assert any(name.startswith(start) for name in names), exhibit.title


def test_the_mark_of_an_exhibit_is_that_of_its_worst_claim():
    exhibit = next(e for e in EXHIBITS if len(e.claims) > 1)
    made = [Claim(name, 'ours', '', verdict='held') for name in exhibit.claims]
    for verdict in VERDICTS:
        assert exhibit.mark([*made[:-1], replace(made[-1], verdict=verdict)]) == verdict
    assert exhibit.mark([]) == 'not measured'
    assert replace(exhibit, comparable=False).mark(made) == 'not comparable'


# What is measured in a single run


def test_explained_share_is_one_if_perfect_zero_if_none():
    run = record(20.0)
    run['terms'][:-1, 0] = -(np.diff(run.speeds, axis=0) / 0.01 - run['acceleration'][:-1])
    assert explained(run) == pytest.approx((1.0, 1.0), abs=1e-9)
    run['terms'][:, 0] = 0.0
    assert max(explained(run)) <= 0.0


def test_switches_are_counted_and_only_a_whole_run_decides():
    run = record(60.0)
    assert switch_times(run.time, run['mode']) == pytest.approx([12.0, 24.0, 36.0, 48.0])
    assert switches_claim(run).held is True
    run['mode'][:] = 0
    assert switches_claim(run).held is False
    assert largest_switch(run) is None
    assert switches_claim(record(30.0)).held is None


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
def begun():
    """Return the runs that were begun since it was cleared, none of them a simulation."""
    found = []

    def run(scenario, method):
        found.append((scenario, method))
        return fake_run(scenario, method)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, 'run', run)
        yield found


@pytest.fixture(scope='module')
def folder(tmp_path_factory, begun):
    output = tmp_path_factory.mktemp('paper')
    reproduce(output, quick=True, seeds=(101, 102), estimation_seeds=(1,))
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
    with (folder / 'runs.csv').open() as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == len((folder / RUNS).read_text().splitlines())
    assert {row['seed'] for row in runs} == {'101', '102'}
    assert all(row['commit'] and row['machine'] and float(row['rmse']) > 0.0 for row in runs)


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
    inside = ('data:image/svg+xml;base64,', '#')
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


@pytest.mark.long
def test_nothing_depends_on_the_order_of_the_runs_or_on_a_resume(
    folder, begun, tmp_path, monkeypatch
):
    monkeypatch.setattr(reproduction, 'write_pictures', lambda *_: {})
    monkeypatch.setattr(reproduction, 'page', lambda *_: '')
    lines = (folder / RUNS).read_text().splitlines(keepends=True)
    (tmp_path / RUNS).write_text(''.join(lines[::-3]) + lines[1][:-9])
    begun.clear()
    with ThreadPoolExecutor(3) as executor:
        options = {'seeds': (101, 102), 'estimation_seeds': (1,), 'workers': executor}
        reproduce(tmp_path, quick=True, **options)
    assert len(begun) < len(lines)
    for name in ('results.json', 'results.csv', 'tables.md'):
        assert (tmp_path / name).read_text() == (folder / name).read_text(), name


def test_a_fresh_start_runs_everything_again(folder, begun, tmp_path, monkeypatch):
    monkeypatch.setattr(reproduction, 'write_pictures', lambda *_: {})
    monkeypatch.setattr(reproduction, 'page', lambda *_: '')
    monkeypatch.setattr(open_loop_estimation, 'compare', lambda **_: ResultTable([]))
    (tmp_path / RUNS).write_text(text := (folder / RUNS).read_text())
    begun.clear()
    options = {'quick': True, 'seeds': (101, 102), 'estimation_seeds': (1,), 'fresh': True}
    reproduce(tmp_path, **options)
    assert len(begun) >= len(text.splitlines())  # and those of the figures
