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
"""``t3mpc robot`` as a command: exit codes, messages, and one run over pseudo terminals."""

import argparse
import os
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from support.missing_tools import needs
from support.waiting import communicate

from t3mpc_ros.cli import robot as cli
from t3mpc_ros.cli import robot_calibrate, robot_doctor
from t3mpc_ros.radio.serial_port import SerialPort
from t3mpc_ros.radio.tool import manoeuvre, procedure
from t3mpc_ros.radio.tool.procedure import ProcedureError
from t3mpc_ros.robot.calibration import Recording


@pytest.fixture
def ports(tmp_path):
    """Yield the paths of both ports of an emulator process."""
    needs('C compiler')
    dongle, robot = tmp_path / 'dongle', tmp_path / 'robot'
    command = [sys.executable, '-m', 't3mpc_ros.cli.emulator', '--link', str(dongle)]
    child = subprocess.Popen(
        [*command, '--robot-link', str(robot)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
    )
    assert any('robot console' in line for line in child.stdout)
    yield str(dongle), str(robot)
    child.send_signal(signal.SIGTERM)
    output, _ = communicate(child)
    assert output.endswith('t3mpc emulator: stopped\n')
    assert 'Traceback' not in output
    assert not dongle.is_symlink()
    assert not robot.is_symlink()


def test_port_errors_contain_a_remedy(tmp_path, capsys):
    missing = str(tmp_path / 'nothing')
    for command in (['ping'], ['scan'], ['parameters'], ['jog', 'left', '1', '--yes']):
        assert cli.main([*command, '--port', missing]) == 2
        assert 'is the dongle plugged in?' in capsys.readouterr().err
    assert cli.main(['key', 'state', '--port', missing]) == 2
    assert "is the robot's board plugged in?" in capsys.readouterr().err
    master, slave = os.openpty()
    path = os.ttyname(slave)
    holder = SerialPort(path)
    assert cli.main(['ping', '--port', path]) == 2
    assert 'another program has it open' in capsys.readouterr().err
    holder.close()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize('answer', ['no', '', 'yeah', 'ctrl-c'])
@pytest.mark.slow
def test_jog_requires_a_confirmation(answer, capsys, monkeypatch):
    """Readline continues after a signal, so the prompt has to poll for Ctrl-C."""
    opened = []
    monkeypatch.setattr(procedure, 'run_at_port', lambda *arguments: opened.append(arguments))
    master, slave = os.openpty()
    with open(slave) as terminal:
        monkeypatch.setattr(sys, 'stdin', terminal)
        if answer == 'ctrl-c':
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            os.write(master, answer.encode() + b'\n')
        code = cli.main(['jog', 'left', '1', '--port', 'x'])
        assert code == (130 if answer == 'ctrl-c' else 2)
        assert opened == []
        os.write(master, b'yes\n')
        assert cli.main(['jog', 'left', '1', '--port', 'x']) == 0
    os.close(master)
    assert len(opened) == 1
    output = capsys.readouterr()
    assert 'in the air' in output.out
    assert 'nothing was moved' in output.err


def test_an_interrupted_calibration_keeps_what_it_found(capsys, monkeypatch, tmp_path):
    """Ctrl-C at the second step: the bias of the first one is saved."""
    rates = 0.01 + 5e-4 * np.random.default_rng(1).standard_normal(500)
    still = np.zeros(500)
    recording = Recording(0.02 * np.arange(500), still, still, rates, 500, 500)
    monkeypatch.setattr(robot_calibrate.CalibrationRobot, 'rest', lambda robot, seconds: recording)
    read, write = os.pipe()
    path = tmp_path / 'found.yaml'
    with os.fdopen(read) as terminal:
        monkeypatch.setattr(sys, 'stdin', Terminal(terminal))
        os.write(write, b'\n')
        code = cli.main(
            ['calibrate', '--port', 'x', '--steps', 'rest,radius', '--save', str(path)]
        )
    os.close(write)
    assert code == 130
    output = capsys.readouterr()
    assert 'bias of the gyro 0.57' in output.out
    assert 'interrupted' in output.err
    bias = robot_calibrate.read_parameter_file(path)[0].gyro_bias
    assert bias.value == pytest.approx(0.01, abs=1e-4)


def doctor_at_terminal(typed, ask, monkeypatch):
    """Return the exit code of a doctor that only asks; Ctrl-C follows the first line typed."""
    read, write = os.pipe()
    os.write(write, typed)
    os.close(write)
    monkeypatch.setattr(robot_doctor, 'run_doctor', lambda *given: ask(*given[3:]))
    with os.fdopen(read) as terminal:
        monkeypatch.setattr(sys, 'stdin', Terminal(terminal))
        return cli.main(['doctor', '--port', 'x', '--robot-port', 'y', '--drive'])


def test_ctrl_c_at_a_question_ends_the_checklist(monkeypatch, capsys):
    """It showed all further questions, skipped them, and had exit code 0."""

    def ask(answer, stop):
        answer('Both wheels in the air?')
        pytest.fail('a second question was asked')

    assert doctor_at_terminal(b'yes\nyes\n', ask, monkeypatch) == 130
    assert capsys.readouterr().err == 't3mpc robot: interrupted\n'


def test_ctrl_c_while_a_wheel_turns_fails_no_check(monkeypatch, tmp_path):
    """It was *left wheel: did not turn, try: interrupted* in a report, and exit code 1."""
    task = SimpleNamespace(error='interrupted')
    monkeypatch.setattr(manoeuvre, 'Jog', lambda *given: task)
    turned = []
    monkeypatch.setattr(procedure, 'run_at_port', lambda *given: turned.append(given))
    monkeypatch.setattr(procedure, 'run_script', failing)
    options = argparse.Namespace(
        port='x', robot_port='y', count=10, drive=True, report=tmp_path / 'doctor.html'
    )
    with pytest.raises(ProcedureError, match='^interrupted$'):
        robot_doctor.run_doctor(options, None, b'', lambda text: 'yes', lambda: bool(turned))
    assert not options.report.exists()


def failing(*given):
    raise ProcedureError('no board')


def test_a_misspelt_answer_is_asked_for_again(monkeypatch, capsys):
    """*yse* counted as *skip*: the check was lost."""
    lines = iter(['yse', 'Y'])
    monkeypatch.setattr(cli, 'ask_line', lambda question, stop: next(lines))
    monkeypatch.setattr(sys, 'stdin', SimpleNamespace(isatty=lambda: True))
    chosen = []
    monkeypatch.setattr(
        robot_doctor, 'run_doctor', lambda *given: chosen.append(given[3]('Free?')) or []
    )
    assert cli.main(['doctor', '--port', 'x', '--robot-port', 'y']) == 0
    assert chosen == ['yes']


class Terminal:
    """A pipe that claims to be a terminal; Ctrl-C follows the first line."""

    def __init__(self, pipe):
        self._pipe, self.fileno = pipe, pipe.fileno

    def isatty(self):
        return True

    def readline(self):
        line = self._pipe.readline()
        signal.raise_signal(signal.SIGINT)
        return line


@pytest.mark.slow
def test_setup_shows_asks_and_restores(ports, tmp_path, capsys, monkeypatch):
    """Nothing is written without a question or --yes; a file restores every setting."""
    _, robot = ports
    saved = tmp_path / 'robot.yaml'

    def run(*arguments):
        code = cli.main(['setup', '--port', robot, *arguments])
        output = capsys.readouterr()
        return code, output.out + output.err

    assert run('--save', str(saved))[0] == 0
    with open(os.devnull) as empty:
        monkeypatch.setattr(sys, 'stdin', empty)
        code, output = run('--channel', '100')
    assert (code, 'channel: 82 -> 100' in output, '--yes' in output) == (2, True, True)
    code, output = run('--diff', str(saved))
    assert (code, 'equal to' in output) == (0, True)
    changes = ['--channel', '100', '--invert', 'left', '--divider', '3.5', '--sensors', 'none']
    code, output = run(*changes, '--yes', '--diff', str(saved))
    assert (code, 'divider: 3.5 -> 4.0' in output, '8 x none' in output) == (1, True, True)
    code, output = run('--load', str(saved), '--yes')
    assert (code, 'invert_left: yes -> no' in output) == (0, True)
    assert run('--diff', str(saved))[0] == 0
    saved.write_text(saved.read_text().replace('channel: 82', 'channel: 126'))
    code, output = run('--load', str(saved))
    assert (code, 'channel must be from 0 to 125: got 126' in output) == (2, True)
