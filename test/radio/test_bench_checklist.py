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
"""Bench checklist: each defect of a robot fails its own line, and a good robot none."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from support.long_tests import few_of
from support.tool_bench import ToolBench

from t3mpc_ros.cli import robot_doctor as cli
from t3mpc_ros.evaluation.api.one_sentence_errors import sentence
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import Pong, Samples
from t3mpc_ros.radio.tool import procedure
from t3mpc_ros.radio.tool.bench_checklist import (
    BoardFindings,
    check_board,
    check_builds,
)
from t3mpc_ros.radio.tool.eeprom_records import Stored
from t3mpc_ros.radio.tool.link_test import FAIL, PASS, POOR, SKIPPED, Check
from t3mpc_ros.radio.tool.procedure import ProcedureError
from t3mpc_ros.radio.tool.robot_info import LogEntry, LogKind
from t3mpc_ros.radio.tool.robot_settings import RobotSettings
from t3mpc_ros.robot.calibration import Calibration, DividerCorrection

PONG = Pong(1, b'ping', 0, 2, 2, 0, 1, 0, 0, 0, 1, 0, 82, b'T3MPC', 7)
PARAMETERS = LinkParameters()


def samples(**changes):
    """Return samples of a good robot at rest, 12 V, nothing in front of its sensors."""
    source = np.random.default_rng(1)
    ranges = np.array(changes.get('ranges', 8 * [90]), dtype='<u2').tobytes()
    rows = []
    for noise in source.normal(0.0, 3.0, (50, 6)).round().astype(int):
        values = np.array([164, -80, 16_400, 20, -30, 40]) + noise
        registers = map(int, changes.get('imu', values))
        rows.append(Samples(1, ranges, changes.get('battery', 614), *registers))
    return tuple(rows)


def findings(**changes):
    found = BoardFindings(
        PONG,
        Stored(frames.SETTINGS_GOOD, RobotSettings()),
        Stored(frames.SETTINGS_MISSING, Calibration()),
        (LogEntry(0, LogKind.BOOT, 0, 1), LogEntry(1, LogKind.BOOT, 0, 2)),
        samples(),
    )
    return found._replace(**changes)


def failed(found):
    return [check.name for check in check_board(found, PARAMETERS) if check.verdict == FAIL]


def test_a_good_robot_passes():
    checks = check_board(findings(), PARAMETERS)
    assert {check.verdict for check in checks} == {PASS}
    assert all(check.remedy for check in checks)


SETTINGS = RobotSettings()
LOW_DIVIDER = Calibration(divider=DividerCorrection(-0.2, 0.0, 0.1))


GYRO = ['gravity', 'rate at rest', 'noise of the rate']
DEFECTS = [
    (['radio chip of the robot'], {'pong': PONG._replace(chip_ok=0)}),
    (['settings stored'], {'settings': Stored(frames.SETTINGS_MISSING, SETTINGS)}),
    (['settings equal to those of the host'], {'settings': Stored(0, RobotSettings(rate='250k'))}),
    (['calibration'], {'calibration': Stored(frames.SETTINGS_DAMAGED, Calibration())}),
    (['resets in the log'], {'log': (LogEntry(0, LogKind.BOOT, 0, 8),)}),
    (['resets in the log'], {'log': (LogEntry(0, LogKind.BOOT, 0, 4),)}),
    (['battery'], {'samples': samples(battery=0)}),
    (['battery'], {'samples': samples(battery=480)}),
    (['battery'], {'calibration': Stored(0, LOW_DIVIDER)}),
    (['battery'], {'samples': samples(battery=0xFFFF)}),
    (['inertial sensor'], {'samples': samples(imu=6 * [0])}),
    ([GYRO[0], GYRO[2]], {'samples': samples(imu=[0, 0, -16384, 0, 0, 1])}),
    (GYRO, {'samples': samples(imu=[0, 0, 13000, 1400, 0, 0])[:40]}),
    (['distance sensors'], {'samples': samples(ranges=[90, 1023, *6 * [90]])}),
    (['distance sensors'], {'samples': samples(ranges=[*7 * [90], 0])}),
    (['distance sensors'], {'samples': samples(ranges=8 * [0xFFFF])}),
]


@pytest.mark.parametrize('names, changes', DEFECTS)
def test_each_defect_fails_its_own_line(names, changes):
    assert failed(findings(**changes)) == names


def test_a_sensor_that_is_not_there_is_not_missed():
    settings = SETTINGS._replace(sensors=('none', *7 * ('GP2Y0A21',)))
    found = findings(settings=Stored(0, settings), samples=samples(ranges=[0, *7 * [90]]))
    assert failed(found) == []


def test_builds_of_both_boards_are_compared():
    assert check_builds(PONG, PONG).verdict == PASS
    assert check_builds(PONG, PONG._replace(build=8)).verdict == FAIL
    assert check_builds(None, PONG).verdict == SKIPPED


def test_a_poor_line_does_not_pass():
    """It said *pass*, and in the same line *poor, try: …*."""
    shown = cli.format_check(Check(2, 'cable', POOR, '3', 'another cable'))
    assert 'poor     cable: 3\n' in shown
    assert 'try: another cable' in shown
    assert 'pass' not in shown


def doctor_options(report, count=10, drive=False):
    return argparse.Namespace(
        port='dongle', robot_port='robot', count=count, drive=drive, report=report
    )


@pytest.mark.parametrize('drive', few_of([True, False]))
@pytest.mark.slow
def test_the_checklist_on_the_emulated_robot(drive, tmp_path, monkeypatch, capsys):
    """A wheel turns only with --drive and a confirmation; the report has every line."""
    bench = ToolBench()
    monkeypatch.setattr(
        procedure,
        'run_at_port',
        lambda task, path, *others: bench.run(task, robot=path == 'robot'),
    )

    def answer(question):
        if 'RIGHT' in question:
            return 'no'
        return 'yes' if 'left wheel will' in question or 'LEFT' in question else 'skip'

    options = doctor_options(tmp_path / 'r.html', count=50, drive=drive)
    checks = cli.run_doctor(options, PARAMETERS, b'', answer, lambda: False)
    verdicts = {check.name: check.verdict for check in checks}
    assert FAIL not in verdicts.values(), verdicts
    assert verdicts['left wheel'] == (PASS if drive else SKIPPED)
    assert verdicts['right wheel'] == SKIPPED
    left, right = bench.board.counters
    assert (abs(left - 3200) < 5, right) == (drive, 0)
    assert verdicts['build ids equal'] == verdicts['battery'] == verdicts['gravity'] == PASS
    saved = json.loads((tmp_path / 'r.json').read_text())
    assert [row['name'] for row in saved] == list(verdicts)
    page = (tmp_path / 'r.html').read_text()
    assert all(name in page for name in ('round trip to the robot', 'noise of the rate'))
    assert 'nothing failed; poor: 0, skipped: ' in capsys.readouterr().out


def test_a_silent_robot_board_does_not_end_the_examination(tmp_path, monkeypatch):
    bench = ToolBench()

    def run_at_port(task, path, interrupted, device=''):
        if path == 'robot':
            task.port_failed('the port does not exist', True, bench.now_ns)
            return
        bench.run(task)

    monkeypatch.setattr(procedure, 'run_at_port', run_at_port)
    options = doctor_options(tmp_path / 'r.html')
    checks = cli.run_doctor(options, PARAMETERS, b'', lambda question: 'skip', lambda: False)
    assert [check.name for check in checks if check.verdict == FAIL] == ['USB of the robot']
    assert any(check.name == 'robot answers by radio' for check in checks)


def test_a_full_disk_does_not_cost_the_checklist(monkeypatch, capsys):
    """It ended with a traceback, and said neither the file nor what to do."""
    monkeypatch.setattr(procedure, 'run_script', lambda *given: _no_answer())
    options = doctor_options(Path('/dev/full'))
    with pytest.raises(OSError, match='No space') as caught:
        cli.run_doctor(options, PARAMETERS, b'', lambda question: 'yes', lambda: False)
    assert sentence(caught.value).startswith('/dev/full cannot be written: No space')
    shown = capsys.readouterr().out
    assert 'pass     emergency stop: yes' in shown
    assert '2 of 12 checks failed' in shown


def _no_answer():
    raise ProcedureError('silent')
