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

import csv
from dataclasses import replace
from html import unescape
import json
import math
import re

import matplotlib.image
import numpy as np
import pytest
from support.records import record_of

from t3mpc_ros.evaluation import experiment, figure_style
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.method_table import FULL, methods
from t3mpc_ros.evaluation.paper import paper_study
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
from t3mpc_ros.evaluation.paper.paper_study import Results, all_tables
from t3mpc_ros.evaluation.paper.reproduce import EXHIBITS, RUNS, counted, reproduce
from t3mpc_ros.evaluation.result_output import finite
from t3mpc_ros.evaluation.run_record import switch_times
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
    if method.name in paper_study.STAGES:
        size = 0.5 - 0.08 * paper_study.STAGES.index(method.name)
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
    return [tuple(run.fields[name] for name in names) for run in paper_study.study_runs(extent)]


def test_the_full_study_has_each_run_once_the_quick_one_some(monkeypatch):
    monkeypatch.setattr(paper_study, 'digest', lambda *_: '')  # keys of thousands of runs
    full, quick = paper_study.chosen_extent(), paper_study.chosen_extent(quick=True)
    every = situations(full)
    assert len(every) == len({*every})
    assert {each[-1] for each in every} == {*HELD_OUT_SEEDS}
    wanted = [each[:-1] for each in every if each[-1] == 101]
    assert {name for name, *_ in wanted} == {*METHODS}
    for drive in paper_study.DRIVES:
        cases = [case for case in full.cases if (drive, case) != ('torque', 'dead time')]
        for name, method in METHODS.items():
            found = {
                (noise, case) for each, at, noise, case in wanted if (each, at) == (name, drive)
            }
            expected = {(noise, 'nominal') for noise in paper_study.NOISES}
            if name in paper_study.STAGES:
                expected |= {(noise, case) for noise in (0.0, 0.04) for case in cases}
            elif name in paper_study.WITHOUT.values():
                intended = {'nominal', *paper_study.INTENDED_CASES.get(name, ())}
                expected = {(0.04, case) for case in intended.intersection(cases)}
            elif method.preview:
                expected |= {(0.04, 'mass +30 %'), (0.04, 'mass -30 %')}
            assert found == expected, (name, drive)
    found = {*situations(quick)}
    assert found < {*every}
    assert (len(quick.seeds), quick.duration) == (3, 26.0)
    for _, case, drives in INTENDED:  # what a part is meant for is in the quick one
        assert {(FULL, drive, 0.04, case, 101) for drive in drives} <= found


@pytest.mark.parametrize('seeds', [(9,), (120, 121)])
def test_seeds_that_are_not_held_out_cannot_be_asked_for(seeds):
    with pytest.raises(ValueError, match='seeds must be of 101-120'):
        paper_study.chosen_extent(seeds=seeds)


def test_runs_have_keys_of_their_own_and_of_their_method(monkeypatch):
    few = {name: METHODS[name] for name in (FULL, 'ADRC')}
    monkeypatch.setattr(paper_study, 'methods', lambda drive: few)
    small = paper_study.Extent((101, 102), 6.0, ('nominal', 'dead time'), (0.0, 0.04))
    before = paper_study.study_runs(small)
    longer = paper_study.study_runs(replace(small, duration=7.0))
    assert len({run.key for run in before + longer}) == 2 * len(before)
    gain = METHODS['ADRC'].parameters.with_values({'gain': 7.0})
    few['ADRC'] = replace(METHODS['ADRC'], parameters=gain)
    after = paper_study.study_runs(small)
    apart = [run for run, other in zip(after, before, strict=True) if run.key != other.key]
    assert {run.fields['controller'] for run in apart} == {'ADRC'}
    monkeypatch.setattr(paper_study, 'measure', lambda record: {})
    assert not {run.key for run in paper_study.study_runs(small)} & {run.key for run in before}


def test_what_is_measured_of_a_run():
    run = record(20.0)
    run.speeds[:] = run.reference
    run.speeds[250] += 9.0  # within the start: nobody looks
    run.speeds[1210] += 0.5  # within the second about the switch at 12 s
    run.speeds[1700, 1] -= 0.25
    counted = 2 * 1700
    assert paper_study.measure(run) == {
        'rmse': pytest.approx(math.sqrt((2 * 0.25 + 0.0625) / counted)),
        'settled': pytest.approx(math.sqrt(0.0625 / (counted - 200))),
        'largest_error': pytest.approx(0.5),
        'chatter': run.variation(),
        'finite': True,
    }


def test_a_diverged_run_is_marked_as_not_finite():
    run = record(6.0)
    run['acceleration'][-1, 0] = math.inf
    found = paper_study.measure(run)
    assert not found['finite']
    assert all(math.isnan(found[name]) for name in paper_study.NUMBERS)


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


def test_stage_differences_compare_measured_neighbours():
    rmse = {name: 0.5 - 0.1 * k + 0.01 * np.arange(4) for k, name in enumerate(paper_study.STAGES)}
    entries = in_all('torque', 0.04, rmse)
    entries['+MPC', 'torque', 0.04, 'friction x3'] = (0.4, 0.5)
    results = Results(table_of(entries, few=True))
    assert [(pair['first'], pair['second'], pair['case']) for pair in results.added] == [
        (more, less, 'nominal')
        for more, less in zip(paper_study.STAGES[1:], paper_study.STAGES[:-1], strict=True)
    ]
    # What all seeds share drops out: unpaired, the same two could not be told apart.
    for pair in results.added:
        assert (pair['difference'], pair['ci95']) == pytest.approx((-0.1, 0.0))
    assert results.row(FULL, 'torque', 0.04)['rmse_ci95'] > 0.02


def test_a_diverged_run_and_a_single_seed_show_in_strict_json():
    results = Results(table_of(in_all('torque', 0.04, {FULL: (math.nan, 0.1)})))
    row = finite(results.means[0])
    assert row['finite'] is False
    assert row['rmse_mean'] is row['largest_error'] is None
    json.dumps(row, allow_nan=False)
    assert '| **full** | diverged |' in markdown(all_tables(results, ResultTable([])), [])
    (row,) = Results(table_of(in_all('torque', 0.0, {FULL: (0.25,)}), few=True)).means
    assert (row['rmse_mean'], finite(row)['rmse_ci95']) == (0.25, None)


# Claims


def claims_of(entries, estimated=(), **numbers):
    """Return the claims on made-up runs by name."""
    found = all_claims(table_of(entries, **numbers), ResultTable(estimated))
    assert all(claim.record()['verdict'] == claim.verdict for claim in found)
    return {claim.name: claim for claim in found}


SHARE = 'share of the best baseline without preview, velocity, noise '


def rmse_of(drive='torque', noise=0.04, case='nominal', **values):
    """Return entries with one RMSE, or that of each seed, of methods by short names."""
    names = {'full': FULL, 'pi': PI, 'fuzzy': FUZZY, 'nmpc': NMPC, 'exact': EXACT}
    return in_all(drive, noise, {names[key]: np.ravel(rmse) for key, rmse in values.items()}, case)


def held(entries, *names, **numbers):
    """Return whether the claims of these names are held, None where it is not decided."""
    found = claims_of(entries, **numbers)
    return [found[name].held for name in names]


def test_share_of_best_baseline_excludes_preview():
    names = f'{SHARE}0.04', f'{SHARE}0', 'half of the best baseline, velocity, noise 0.04'
    for full, verdict in (((0.50, 0.58), True), ((0.50, 0.72), False), ((math.nan, 0.1), False)):
        entries = rmse_of('velocity', full=full, pi=(0.9, 1.1), fuzzy=1.2, nmpc=0.1)
        assert held(entries, *names) == [verdict, None, False]
        assert claims_of(entries)[names[0]].numbers['best_rival'] == PI


def test_baselines_with_preview_and_a_wrong_inertia():
    name = 'baselines with preview, wrong inertia '
    up = rmse_of(case='mass +30 %', full=0.3, exact=0.4, nmpc=0.1)
    for other, verdict in ((0.30, True), (0.31, True), (0.29, False)):
        entries = rmse_of(full=0.3, nmpc=other, fuzzy=0.1, exact=0.1)
        names = f'{name}in their models, torque', f'{name}in their models, velocity'
        assert held(entries, *names) == [verdict, None]
        down = rmse_of(case='mass -30 %', full=0.3, exact=other)
        assert held(up | down, f'{name}of the robot, torque') == [verdict]
    assert held(up, f'{name}of the robot, torque') == [None]


def test_noise_free_against_pi_with_feed_forward():
    names = [f'noise-free against PI, {drive}' for drive in paper_study.DRIVES]
    for pi, verdict in ((0.2, True), (0.1999, False)):
        entries = rmse_of('velocity', 0.0, full=0.2, pi=pi, fuzzy=0.01)
        assert held(entries, *names) == [None, verdict]


def test_growth_with_noise_in_rad_per_s_and_in_shares():
    def found(drive='torque', **ends):
        first, last = ({key: values[k] for key, values in ends.items()} for k in (0, 1))
        names = 'smallest growth with noise', 'grows only slightly', 'others grow by half'
        entries = rmse_of(noise=0.0, **first) | rmse_of(noise=0.1, **last)
        return held(entries, *(f'{name}, {drive}' for name in names))

    others = {'pi': (0.5, 0.7), 'nmpc': (0.1, 0.4)}  # PI: by 40 %
    assert found(full=(0.2, 0.21), **others) == [True, True, False]
    assert found(full=(0.2, 0.30), **others) == [True, False, False]
    assert found(full=(0.2, 0.45), **others) == [False, False, False]
    assert found('velocity', full=(0.2, 0.21), **others) == [None, None, None]
    assert found(full=(0.2, 0.45), nmpc=(0.1, 0.4))[2] is True
    # What diverges under noise grows most.
    assert found(full=(0.2, 0.9), pi=(0.5, math.nan))[0] is True
    assert found(full=(0.2, math.nan), pi=(0.5, math.nan))[0] is False


def test_limits_of_the_settled_error_and_of_chatter():
    for settled, own, verdict in ((0.0599, 100.0, True), (0.0601, 301.0, False)):
        entries = rmse_of(noise=0.0, full=0.5)
        assert held(entries, 'settled, torque', settled=settled) == [verdict]
        chatter = {FULL: own, PI: 50.0, FUZZY: 300.0, NMPC: 9000.0}
        entries = in_all('torque', 0.04, dict.fromkeys(chatter, (0.1,)))
        assert held(entries, 'no chatter, torque', chatter=chatter) == [verdict]


@pytest.mark.parametrize('part, case, drives', INTENDED + ALONE)
def test_a_part_helps_if_its_paired_interval_is_negative(part, case, drives):
    pairs = {f'{part} is missed': (FULL, paper_study.WITHOUT[part])}
    if part in paper_study.PARTS:
        less, more = paper_study.STAGES[paper_study.PARTS.index(part) :][:2]
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
    runs = paper_study.study_runs(paper_study.chosen_extent(quick=True, seeds=(101,)))
    table = ResultTable(
        [run.fields | dict(zip(paper_study.NUMBERS, generator.uniform(0.01, 1.0, 4), strict=True))
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
def folder(tmp_path_factory):
    """Return what is written of runs that were never simulated."""
    output = tmp_path_factory.mktemp('paper')
    (output / RUNS).write_text('{"run": "of before"}\n')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, 'run', fake_run)
        # A picture takes long; test_figures.py renders one as SVG.
        file_of, picture = figure_style.file_of, {'svg': b'<svg/>'}
        patch.setattr(
            figure_style, 'file_of', lambda each, kind: picture.get(kind) or file_of(each, kind)
        )
        reproduce(output, quick=True, seeds=(101, 102), estimation_seeds=(1,), fresh=True)
    return output


def test_json_and_csv_have_what_is_promised(folder):
    content = json.loads((folder / 'results.json').read_text())
    assert {'results', 'claims', 'parameters', 'version', 'estimation'} <= set(content)
    situations = ('controller', 'drive', 'noise', 'case')
    keys = {
        *situations, 'baseline', 'preview', 'rmse_mean', 'rmse_ci95', 'settled_mean',
        'settled_ci95', 'chatter_mean', 'largest_error', 'finite', 'seeds', 'duration',
    }  # fmt: skip
    for row in content['results']:
        assert set(row) == keys
        assert row['seeds'] == 2
        assert row['rmse_mean'] > 0.0
        assert row['rmse_ci95'] > 0.0
    found = [tuple(row[name] for name in situations) for row in content['results']]
    assert len({*found}) == len(found)
    assert (FULL, 'velocity', 0.04, 'nominal') in found
    assert not any('exact model' in name for name, *_ in found)
    assert {row['kind'] for row in content['estimation']} >= {'type1', 'type3'}
    assert all(claim['held'] in (True, False, None) for claim in content['claims'])
    assert content['parameters']['seeds'] == [101, 102]
    read, runs = (
        list(csv.DictReader((folder / name).read_text().splitlines()))
        for name in ('results.csv', 'runs.csv')
    )
    rows = content['results'] + content['exact_models']
    assert list(read[0]) == list(rows[0])
    for one, other in zip(read, rows, strict=True):
        for name, value in other.items():
            shown = one[name] if isinstance(value, str) else json.loads(one[name])
            assert shown == value
    assert len(runs) == len((folder / RUNS).read_text().splitlines())
    assert {row['seed'] for row in runs} == {'101', '102'}
    assert all(row['commit'] and row['machine'] and float(row['rmse']) > 0.0 for row in runs)


def test_every_figure_is_drawn_wide_enough_and_not_empty(folder):
    drawn = {path.stem for path in (folder / 'figures').glob('*.png')}
    assert drawn == {exhibit.stem for exhibit in EXHIBITS if exhibit.draw is not None}
    for path in (folder / 'figures').glob('*.png'):
        picture = matplotlib.image.imread(path)
        assert picture.shape[1] >= 800, path.name
        inked = np.mean(np.any(picture[..., :3] < 0.85, axis=2))
        assert 0.005 < inked < 0.7, path.name


def test_the_page_is_self_contained_and_shows_everything(folder):
    text = (folder / 'paper.html').read_text()
    loaded = re.findall(r'\s(?:src|href|srcset|data|action)="?([^\s">]*)', text)
    assert all(value.startswith(('data:image/svg+xml;base64,', '#')) for value in loaded)
    assert not re.search(r'<(script|link|iframe)\b|url\(|@import', text)
    assert text.count('<img ') == sum(exhibit.draw is not None for exhibit in EXHIBITS)
    assert text.count('<section') == len(EXHIBITS)
    assert text.index('<img') < text.index('<nav') < text.index('<details')
    for mark in (*VERDICTS, 'not comparable'):
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
