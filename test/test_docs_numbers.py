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
"""Numbers of the pages are those of the files that commands have written, and of today's code."""

from collections import Counter
import csv
import random
import re

import pytest
from support import quantities
from support.checkout import ROOT

from bench import path_samplings
import t3mpc_ros as t3
from t3mpc_ros.evaluation.confidence_intervals import interval, mean, paired
from t3mpc_ros.evaluation.experiment import measured_run
from t3mpc_ros.evaluation.method_table import methods_for
from t3mpc_ros.evaluation.patrol.path_tracker_comparison import (
    TRACKED_PATHS,
    TrackingPlan,
    compare_trackers,
)
from t3mpc_ros.evaluation.patrol.patrol_comparison import PatrolPlan, compare_patrols
from t3mpc_ros.evaluation.scenario import Scenario

RESULTS = (ROOT / 'docs' / 'results.md').read_text()
README = (ROOT / 'README.md').read_text()
FULL = 'full'
YAW = '†'
"""Mark of the cases whose number is that of the yaw rate."""


def _tables(text, head):
    """Return the tables whose head begins with some columns, without marks: rows of cells."""
    found = re.findall(rf'^\| {re.escape(head)}.*\n\|[-|]+\n((?:\|.*\n)+)', text, re.M)
    return [
        [[cell.strip(' *¹²') for cell in line.strip('|').split('|')] for line in rows.splitlines()]
        for rows in found
    ]


def _table(text, head):
    """Return the rows of the only such table."""
    (rows,) = _tables(text, head)
    return rows


def _close(shown, value):
    """Return whether a printed number is a value, rounded to its digits."""
    digits = len(shown.partition('.')[2])
    return abs(float(shown) - value) <= 0.5 * 10.0**-digits + 1e-9


def test_the_table_of_the_stepper_robot_is_that_of_its_runs():
    others = (
        *('feed-forward', 'feed-forward + shaper', 'feed-forward + shaper + dead time'),
        'LMS body correction',
    )
    rows = _table(RESULTS, 'case | **full** | feed-forward | + shaper | + dead time')
    assert len(rows) == 23
    for name, *cells, ratio in rows:
        case = name.strip(f' {YAW}')
        metric = 'yaw_rate_settled' if YAW in name else 'settled'
        means = []
        for controller, cell in zip((FULL, *others), cells, strict=True):
            values = quantities.runs('twin', case, controller, metric)
            shown, half = cell.split(' ± ')
            assert _close(shown, mean(values)), (name, controller)
            assert _close(half, interval(values)), (name, controller)
            means.append(mean(values))
        assert _close(ratio, means[0] / min(means[1:])), name


def test_the_table_with_equal_means_is_that_of_its_runs():
    columns = [
        *(('torque', 'nominal', metric) for metric in ('overall', 'settled', 'variation')),
        *(('torque', case, 'overall') for case in ('friction x3', 'mass +30 %')),
        *(('servo', 'nominal', metric) for metric in ('overall', 'settled')),
        *(('servo', case, 'overall') for case in ('friction x3', 'unknown dead time')),
    ]
    rows = _table(RESULTS, 'method | torque drive | settled | variation')
    assert len(rows) == 12
    for name, *cells in rows:
        for (robot, case, metric), cell in zip(columns, cells, strict=True):
            if cell != '–':
                assert _close(cell, mean(quantities.runs(robot, case, name, metric))), (name, case)


def test_the_table_of_the_papers_plant_is_that_of_its_command():
    tables = (ROOT / 'docs' / 'results_tables.md').read_text()
    known = {}
    for drive in ('velocity', 'torque'):
        part = tables.partition(f'**RMSE (rad/s), {drive} drive, nominal robot**')[2]
        rows = part.partition('\n\n**')[0].splitlines()
        for cells in (line.strip('| ').split(' | ') for line in rows if line.startswith('|')):
            known[cells[0].strip('*').replace(' (preview)', ''), drive] = cells[1:]
    rows = _table(RESULTS, '| velocity drive, no noise')
    assert len(rows) == 12
    for name, *cells in rows:
        plain = name.partition('**')[0]
        for drive, shown in (('velocity', cells[:3]), ('torque', cells[3:])):
            none, _, some, _, growth = known[plain, drive]
            assert [none, some] == shown[:2], name
            assert growth.split()[0] == f'{float(shown[2]):+.3f}', name


def _mean(robot, case, controller, metric='overall'):
    return mean(quantities.runs(robot, case, controller, metric))


def _worst_and_best_correction():
    """Return the errors of the yaw rate with the filter over those without, in wrong bodies."""
    cases = 'radii and track', 'track +6 %', 'right radius +5 %'
    return [
        _mean('twin', case, FULL, 'yaw_rate_settled')
        / _mean('twin', case, 'feed-forward + shaper + dead time', 'yaw_rate_settled')
        for case in cases
    ]


def test_the_numbers_of_the_readme_are_those_of_the_runs():
    computed, ramp = (
        _mean('torque', 'nominal', 'computed torque + ramp'),
        _mean('torque', 'nominal', FULL),
    )
    assert f'({computed:.3f} against {ramp:.3f}*)' in README
    worse = _mean('torque', 'friction x3', 'computed torque + ramp') / _mean(
        'torque', 'friction x3', FULL
    )
    assert f'has {worse:.1f} times our error with three times the friction' in README
    settled = [
        _mean('twin', 'nominal', name, 'settled')
        for name in (FULL, 'feed-forward + shaper + dead time', 'feed-forward')
    ]
    text = ' '.join(README.split())
    assert (
        '({:.4f} and {:.4f} rad/s between switches, plain feed-forward {:.4f})'.format(*settled)
        in text
    )
    shares = _worst_and_best_correction()
    assert f'to {min(shares):.2f} to {max(shares):.2f} of the error without it' in text
    rows = {row[0]: row[1:] for row in _table(RESULTS, '| velocity drive, no noise')}
    full = next(cells for name, cells in rows.items() if name.startswith('full'))
    assert f'RMSE {full[1].split()[0]} rad/s' in README
    assert f'Torque drive: {full[4].split()[0]} rad/s' in README
    assert f'CasADi NMPC {rows["CasADi NMPC"][4].split()[0]}' in README
    assert f'linear MPC preview {rows["linear MPC preview"][4].split()[0]}' in README
    assert f'without preview has {rows["computed torque"][1].split()[0]}' in README


def test_the_sentences_of_the_results_are_those_of_the_runs():
    text = ' '.join(RESULTS.split())
    names = FULL, 'computed torque + ramp'
    values = [quantities.runs('torque', 'nominal', name, 'overall') for name in names]
    found = paired(values[1], values[0])
    assert f'({found.mean:.4f} ± {found.half:.4f})'.replace('-', '−') in text
    ratios = [
        _mean(robot, case, names[1]) / _mean(robot, case, FULL)
        for robot, case in (
            ('torque', 'friction x3'), ('servo', 'friction x3'), ('torque', 'mass +30 %'),
        )
    ]  # fmt: skip
    shown = (
        'has {:.1f} times our error ({:.1f} times with the velocity drive), with 30 % more mass'
    )
    assert f'computed torque {shown} {{:.2f}} times'.format(*ratios) in text
    shares = _worst_and_best_correction()
    assert f'leaves {min(shares):.2f} to {max(shares):.2f} of the error' in text
    drift = [
        _mean('twin', 'right radius +5 %', name, 'drift') for name in ('LMS body correction', FULL)
    ]
    assert 'the yaw drifts by {:.3f} rad in 60 s, with full by {:.3f}'.format(*drift) in text


@pytest.mark.long
def test_runs_of_the_file_made_anew_have_its_digits():
    """Eight of them, drawn; the file is as long as an hour of runs."""
    for row in random.Random(33).sample(quantities.result_rows(), 8):
        scenario = Scenario(
            row['robot'],
            row['case'],
            int(row['seed']),
            float(row['duration']),
            float(row['noise']),
        )
        numbers = measured_run((scenario, methods_for(scenario.robot)[row['controller']]))
        for name, value in numbers.items():
            if row.get(name):
                assert float(f'{value:.7g}') == pytest.approx(float(row[name]), rel=2e-6), row


@pytest.mark.long
def test_the_result_of_the_tutorial_is_that_of_its_controller(tmp_path, monkeypatch):
    """It was older than the code, whose runs are equal to the last bit."""
    page = (ROOT / 'docs' / 'tutorial.md').read_text()
    (code,) = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    (tmp_path / 'tutorial_controller.py').write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    from tutorial_controller import Pi

    table = t3.compare([FULL, Pi], seeds=range(1, 6), executor=2)
    full, own = (table.values(name, 'settled') for name in (FULL, 'Pi'))
    found = table.difference('Pi', 'settled')
    shown = [f'{mean(each):.4f} ± {interval(each):.4f}' for each in (full, own)]
    text = ' '.join(page.split())
    assert f'{shown[0]} rad/s (`full`) and {shown[1]} rad/s (`Pi`)' in text
    assert f'a difference of {found.mean:+.4f} ± {found.half:.4f}: *worse*' in text


STATED, SHEETS = 40, 80
"""Most quantities that nothing of the repository has, and most values of data sheets."""


@pytest.mark.parametrize('page', quantities.pages(), ids=lambda page: page.name)
def test_every_quantity_of_a_page_is_compared(page):
    """Most numbers of the pages were written by hand, and stayed when a constant changed."""
    without = {(one.section, one.text) for one, kind in quantities.sources(page) if not kind}
    assert not without, (
        'not the value of a parameter that the paragraph names, and in no recorded table; give '
        f'docs/numbers.yaml an expression: {sorted(without)}'
    )


def _rows_of(path, section, record):
    """Return how many rows of tables with a recorded head a section has: all are recorded."""
    lines, inside, count = quantities.recorded_lines(record), False, 0
    blocks = quantities.blocks_of(path.read_text())
    rows = [quantities.plain(text) for name, text in blocks if name == section and text[0] == '|']
    for row, following in zip(rows, [*rows[1:], ''], strict=True):
        inside = row in lines if following.startswith('|---') else inside
        assert not inside or row in lines, row
        count += row in lines and '---' not in row
    return count


def test_few_quantities_are_only_stated():
    kinds = [kind for page in quantities.pages() for _, kind in quantities.sources(page)]
    assert kinds.count('stated') <= STATED
    sheets = quantities.ledger()[quantities.SHEETS]
    assert sum(map(len, sheets.values())) <= SHEETS


@pytest.mark.parametrize('page', [each for each in quantities.ledger() if each.endswith('.md')])
def test_what_the_numbers_of_a_page_are_compared_with_is_there(page):
    path = (quantities.DOCS if page != 'README.md' else ROOT) / page
    compared = Counter()
    for one, kind in quantities.sources(path):
        compared[one.section, kind] += 1
        compared[one.section, one.text] += 1
        compared['*', one.text] += 1
    sections = {section for section, _ in compared}
    for section, entries in quantities.ledger()[page].items():
        assert section in sections | {'*'}, (page, section)
        for name, value in entries.items():
            if name == 'test':
                assert page in (ROOT / value).read_text(), f'{value} does not read {page}'
                assert compared[section, 'test'], (page, section, value)
            elif name == 'record':
                assert _rows_of(path, section, value), (page, section, value)
            else:
                stated = name == 'stated'
                assert stated or re.search('[A-Za-z$]', str(value)), (
                    f'{page}: {value} names nothing'
                )
                for each in sum(value.values(), []) if stated else [name]:
                    assert compared[section, each], f'{page}, {section}: {each} is not on the page'


@pytest.mark.parametrize(
    'record', sorted((ROOT / 'docs' / 'measured').glob('*.txt')), ids=lambda path: path.stem
)
def test_records_say_where_they_are_from(record):
    """Each is of a commit, and a page names the command, or the program that it starts."""
    head = dict(
        line.split(': ', 1) for line in record.read_text().partition('\n\n')[0].splitlines()
    )
    assert [*head] == [
        'command', 'version', 'commit', 'python', 'machine', 'date', 'duration', 'load',
    ]  # fmt: skip
    assert re.fullmatch('[0-9a-f]{40}', head['commit'])
    program = re.match(r't3mpc \w+|[\w/.]+', head['command'])[0]
    assert any(program in page.read_text() for page in quantities.pages()), program


def test_defaults_beside_the_names_of_parameters_are_theirs():
    """`name` (2 s) and 2 s (`name`), on every page."""
    checked = 0
    for page in quantities.pages():
        for name, shown in quantities.stated_defaults(page.read_text()):
            if values := quantities.values_of(name):
                assert any(map(shown.shows, values)), (page.name, name, shown.text, values)
                checked += 1
    assert checked > 10


def test_stopping_times_of_the_page_are_those_of_the_trials():
    page = (ROOT / 'docs' / 'safety.md').read_text()
    trials = _measured('stopping_times.csv')
    rows = _table(page, 'fault | rest, s | way, m | after, m')
    assert {row[0] for row in rows} == {trial['fault'] for trial in trials}
    for name, *cells in rows:
        some = [trial for trial in trials if trial['fault'] == name]
        assert len(some) == 20, name
        for field, cell in zip(('rest', 'way', 'after'), cells, strict=True):
            values = [float(trial[field]) for trial in some if trial[field]]
            if cell.strip().isalpha() or ' ' in cell.strip() or cell.strip() == '-':
                continue
            assert _close(cell.strip(), max(values)), (name, field)
    assert max(float(trial['after']) for trial in trials) <= 2e-4


def _measured(name):
    """Return the rows of a file that a program of ``bench`` has written."""
    with (ROOT / 'docs' / 'measured' / name).open() as file:
        return list(csv.DictReader(file))


PATROL = (ROOT / 'docs' / 'patrol.md').read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    ('method', 'path'), [('**ours**', 'straight line'), ('pure pursuit', 'figure of eight')]
)
def test_drives_of_the_tracking_table_made_anew_have_its_digits(method, path):
    """Two of its 40 cells; ``t3mpc patrol --tracking`` makes all of them, in half an hour."""
    name, column = method.strip('*'), list(TRACKED_PATHS).index(path)
    plan = TrackingPlan(paths=(path,), methods=(name,))
    rows = compare_trackers(plan, None, 2, None).table.where(controller=name)
    errors = [1e3 * row['cross_track'] for row in rows]
    (table,) = _tables(PATROL, 'method | straight line | square')
    shown, _, half = next(row for row in table if row[0] == name)[1 + column].partition(' ± ')
    assert _close(shown, mean(errors))
    assert _close(half.partition(';')[0], interval(errors))


@pytest.mark.long
def test_a_patrol_of_the_table_made_anew_has_its_digits():
    """The one row whose seeds differ by less than these digits: one of them is enough."""
    plan = PatrolPlan(paths=('boustrophedon',), seeds=(142,), duration=1080.0)
    (row,) = compare_patrols(plan, None, 1, None).table.where(controller='boustrophedon')
    *_, table = _tables(PATROL, 'path | coverage, % | 50 %, s | 90 %, s | 95 %, s | evenness')
    shown = next(cells for cells in table if cells[0] == 'boustrophedon')
    made = [100.0 * row['coverage'], *(row[f'time_to_{share}'] for share in (50, 90, 95))]
    for cell, value in zip(shown[1:], [*made, row['evenness']], strict=True):
        assert _close(cell.partition(' ±')[0], value), (cell, value)


@pytest.mark.long
def test_a_path_of_the_samplings_made_anew_has_its_digits():
    """One of twelve rows of ``bench/path_samplings.py``: the plans, and the drive of ours.

    The bound needs toppra, which is not among the requirements.
    """
    name = 'line, 20 mm, noise 2 mm'
    (table,) = _tables(PATROL, 'path | bound | as given | smoothed | of the bound')
    shown = next(row[1:6] for row in table if row[0] == name)
    made = path_samplings.row(name, ('ours',))
    assert [made[i] for i in (1, 2, 4)] == [shown[i] for i in (1, 2, 4)]
