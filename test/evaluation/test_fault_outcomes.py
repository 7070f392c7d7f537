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
"""Under each named fault the closed loop stays bounded, or stops with a reason, as docs say."""

from dataclasses import replace
import json
from pathlib import Path
import re

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.cli.main import main
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation import fault_outcomes
from t3mpc_ros.evaluation.loop import NodeMethod, run
from t3mpc_ros.evaluation.scenario import KINDS, OwnParts, Scenario, noisy_twin, sampled_speeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON
from t3mpc_ros.simulation.digital_twin import BROWN_OUT_REASON
from t3mpc_ros.simulation.fault_injection import FAULTS
from t3mpc_ros.simulation.fault_schedule import FaultEvent

pytestmark = pytest.mark.slow

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'faults.md'
NUMBER = re.compile(r'(?<![\w.])\d+(?:\.\d+)?')


def short_run(*events, duration=6.0, pauses=(), **changes):
    own = OwnParts(events=events, robot_parameters=changes, pauses=pauses)
    return run(Scenario('twin', 'nominal', 1, duration, own=own), NodeMethod('full', {}))


def fault_run(course, name):
    (found,) = (
        one for one in fault_outcomes.FAULT_RUNS if (one.course, one.name) == (course, name)
    )
    return found


def row_text(result):
    """Return the row of the page's table."""
    return f'| {" | ".join(fault_outcomes.table_row(result))} |\n'


def page_rows():
    """Return the rows of the page's outcome tables by (course, fault)."""
    text = (
        PAGE.read_text()
        .partition(fault_outcomes.BEGIN_MARK)[2]
        .partition(fault_outcomes.END_MARK)[0]
    )
    rows = {}
    for course, title in fault_outcomes.TITLES.items():
        part = text.partition(f'### {title}\n')[2].partition('###')[0]
        for line in part.splitlines():
            if line.startswith('| `'):
                rows[course, line.split('`')[1]] = line + '\n'
    return rows


def assert_same(line, other):
    """The words are the same, and the numbers but for what another processor rounds."""
    assert NUMBER.sub('#', line) == NUMBER.sub('#', other)
    for mine, yours in zip(NUMBER.findall(line), NUMBER.findall(other), strict=True):
        assert float(mine) == pytest.approx(float(yours), rel=0.1, abs=0.1), f'{line}{other}'


# --- the loop -----------------------------------------------------------------------------------


def test_equal_runs_are_bit_equal_with_scheduled_faults(tmp_path):
    event = FaultEvent(2.0, 'command_delay', 0.1, 0.5)
    first = short_run(event, duration=3.0)
    path = tmp_path / 'ride.yaml'
    path.write_text('- {at: 2.0, fault: command_delay, value: 0.1, for: 0.5}\n')
    second = short_run(duration=3.0, **{'faults.schedule': str(path)})
    for name, column in first.columns.items():
        np.testing.assert_array_equal(column, second[name])
    assert first.robot_reasons == second.robot_reasons
    assert not np.array_equal(first.speeds, short_run(duration=3.0).speeds)


def test_robot_waits_for_gyro_calibration_then_tracks():
    record = short_run()
    standing = record.time < KINDS['twin'].start
    assert not record['sent'][standing].any()
    assert set(np.array(record.driver_reasons)[standing]) == {'disabled by request'}
    assert not any(np.array(record.driver_reasons)[~standing])
    error = record.error[record.rows(3.0, 6.0)]
    assert np.sqrt(np.mean(error**2)) < 0.06


def test_a_person_can_pause_the_controller():
    record = short_run(pauses=[(3.0, 4.0)])
    assert not record['sent'][record.rows(3.0, 4.0)].any()
    assert record['sent'][record.rows(4.0, 6.0)].any()


def test_what_cannot_be_run_is_refused():
    short = OwnParts(reference=sampled_speeds(np.zeros((600, 2))))
    with pytest.raises(ValueError, match=r'reference must have at least 640 rows: got 600'):
        run(Scenario('twin', 'nominal', 1, 6.0, own=short), NodeMethod('full', {}))
    with pytest.raises(ParameterError, match='drive.kind must be stepper'):
        short_run(**{'drive.kind': 'velocity'})
    with pytest.raises(ValueError, match='rate of the controller must be 100 Hz: got 50'):
        run(Scenario('twin', 'nominal', 1, 6.0), NodeMethod('half', {'rate': 50.0}))


# --- what becomes of it -------------------------------------------------------------------------

SLIP_STOP = f'{SLIP_STOP_REASON}; {Reason.PAUSED.value}'
EXPECTED = {
    'command_delay 0.1 s': ('bounded', '', ''),
    'command_jitter 0.05 s': ('bounded', '', ''),
    'command_loss 1': ('stops', f'no command for 0.25 s; {Reason.PAUSED.value}', 'by itself'),
    'gyro_bias_jump 0.35 rad/s': ('stops', SLIP_STOP, 'by itself'),
    'gyro_dead': ('bounded', '', ''),
    'ranges_dead': ('bounded', '', ''),
    'wheel_blocked right': ('stops', SLIP_STOP, 'by itself'),
    'load_change 3 kg': ('bounded', '', ''),
    'slippery 0': ('stops', SLIP_STOP, 'by itself'),
    'supply_sag 5 V': ('stops', BROWN_OUT_REASON, 'by itself'),
    'brown_out': ('stops', BROWN_OUT_REASON, 'by itself'),
}


SHORT = ('gyro_bias_jump 0.35 rad/s', 'command_delay 0.1 s')


@pytest.mark.parametrize('name', few_of(dict.fromkeys((*SHORT, *EXPECTED)), 1))
def test_the_loop_stays_bounded_or_stops_with_a_reason(name):
    """One strength of each fault, and the page says of it what comes out here."""
    (result,) = fault_outcomes.study_faults([fault_run('chaotic', name)])
    assert (result['verdict'], result['reason'], result['resumption']) == EXPECTED[name]
    assert_same(row_text(result), page_rows()['chaotic', name])


def test_every_fault_is_among_those_expected():
    assert [name.split()[0] for name in EXPECTED] == list(FAULTS) == list(fault_outcomes.STRENGTHS)


@pytest.mark.parametrize(
    'course, name',
    few_of(
        [
            ('straight', 'collision, head-on'),
            ('straight', 'wheel_blocked both'),
            ('straight', 'gyro_bias_jump 0.02 rad/s'),
            ('arc', 'collision, at a slant'),
        ]
    ),
)
def test_undetected_faults_are_named(course, name):
    (result,) = fault_outcomes.study_faults([fault_run(course, name)])
    assert not result['detected']
    assert 'odometry is wrong' in result['undetected']
    line = row_text(result)
    assert (
        fault_outcomes.UNREPORTED if 'collision' in name else fault_outcomes.UNDETECTED
    ) in line
    assert 'not detected' in fault_outcomes.console_text([result])
    assert_same(line, page_rows()[course, name])


def test_the_page_has_a_row_for_every_trial_and_no_other():
    assert list(page_rows()) == [(one.course, one.name) for one in fault_outcomes.FAULT_RUNS]
    names = {name.split()[0] for _, name in page_rows()}
    assert names >= {*FAULTS}
    assert {line.count('|') for line in page_rows().values()} == {7}
    assert (
        fault_outcomes.page_section([])
        .partition('\n###')[0]
        .split(fault_outcomes.END_MARK)[0]
        .strip()
        in PAGE.read_text()
    )


# --- the judge ----------------------------------------------------------------------------------

AT = fault_run('chaotic', 'gyro_dead')


def judged(record, parameters=None):
    undisturbed_run = fault_outcomes.undisturbed('chaotic', AT.duration)
    return fault_outcomes.evaluate_outcome(
        record, undisturbed_run, 10.0, 15.0, parameters or noisy_twin()
    )


def changed(column, rows, value):
    """Return the run without a fault with another value in some rows of a column."""
    record = fault_outcomes.undisturbed('chaotic', AT.duration)
    values = record[column].copy()
    values[rows] = value
    return replace(record, columns={**record.columns, column: values})


def test_a_run_without_fault_is_bounded_and_notices_nothing():
    result = judged(fault_outcomes.undisturbed('chaotic', AT.duration))
    found = [result[name] for name in ('verdict', 'recovery_time', 'detected', 'undetected')]
    assert found == ['bounded', 0.0, [], []]
    result |= {'name': AT.name, 'course': 'arc'}
    lines = fault_outcomes.markdown_tables([result, {**result, 'course': 'chaotic'}]).splitlines()
    assert {line.count('|') for line in lines if line.startswith('|')} == {7}


def test_a_robot_moving_with_a_stop_reason_is_out_of_bounds():
    """A slip stop once lasted for no more than a period, and only the reason stayed."""
    record = fault_outcomes.undisturbed('chaotic', AT.duration)
    says = tuple(SLIP_STOP_REASON if 11.0 <= time < 15.0 else '' for time in record.time)
    result = judged(replace(record, robot_reasons=says))
    assert result['verdict'] == 'unbounded'
    assert 'moves' in result['reason']


@pytest.mark.parametrize(
    'field, value', [('commanded', (10.1, 10.1)), ('commanded', (-9.9, 9.9)), ('speeds', (0, 11))]
)
def test_speeds_beyond_the_limits_are_unbounded(field, value):
    parameters = noisy_twin().with_values({'angular.z.max_velocity': 4.0})
    assert judged(changed(field, 1200, value), parameters)['verdict'] == 'unbounded'


def test_a_lasting_error_is_impaired_a_passing_one_recovers():
    speeds = fault_outcomes.undisturbed('chaotic', AT.duration).speeds
    lasting, passing = slice(1500, None), slice(1500, 2000)
    result = judged(changed('speeds', lasting, speeds[lasting] + 1.0))
    assert result['verdict'] == 'impaired'
    result = judged(changed('speeds', passing, speeds[passing] + 1.0))
    assert result['verdict'] == 'bounded'
    assert 3.0 <= result['recovery_time'] <= 5.0


# --- the page and the command -------------------------------------------------------------------


@pytest.fixture
def two(monkeypatch):
    """Let the command make two short trials only."""
    event = FaultEvent(10.0, 'gyro_dead', True, 2.0)
    made = tuple(
        fault_outcomes.FaultRun('gyro_dead', course, event, '', 17.0)
        for course in ('chaotic', 'straight')
    )
    monkeypatch.setattr(fault_outcomes, 'FAULT_RUNS', made)


@pytest.mark.long
def test_command_writes_the_table_between_the_marks(two, tmp_path, capsys):
    page, numbers = tmp_path / 'page.md', tmp_path / 'numbers.json'
    page.write_text(
        f'before\n{fault_outcomes.BEGIN_MARK}\nold\n{fault_outcomes.END_MARK}\nafter\n'
    )
    html = tmp_path / 'faults.html'
    files = ['--output', str(page), '--json', str(numbers), '--html', str(html)]
    assert main(['faults', '--workers', '1', *files]) == 0
    shown = capsys.readouterr()
    assert 'gyro_dead' in shown.out
    assert '2/2 [' in shown.err
    text = page.read_text()
    assert text.startswith(f'before\n{fault_outcomes.BEGIN_MARK}\n')
    assert text.endswith(f'{fault_outcomes.END_MARK}\nafter\n')
    assert 'old' not in text
    assert text.count('| `gyro_dead` |') == 2
    shown = html.read_text(encoding='utf-8')
    assert shown.index('Every fault stays') < shown.index('<img') < shown.index('<nav')
    assert shown.count('<td class="text">gyro_dead</td>') == 2
    assert [one['course'] for one in json.loads(numbers.read_text())] == ['chaotic', 'straight']


@pytest.mark.parametrize(
    'text',
    [
        '',
        fault_outcomes.BEGIN_MARK,
        f'{fault_outcomes.END_MARK}{fault_outcomes.BEGIN_MARK}',
        2 * fault_outcomes.BEGIN_MARK,
    ],
)
def test_a_page_without_the_marks_is_left_alone(text, tmp_path):
    page = tmp_path / 'page.md'
    page.write_text(text)
    with pytest.raises(ValueError, match='must hold the lines'):
        fault_outcomes.update_page(page, [])
    assert page.read_text() == text
