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
"""Every exit code that help or documentation names, produced once by every command that has it."""

from contextlib import nullcontext
import os
from pathlib import Path
import shlex
import signal
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.recovery import Damage, FileResult, RecoveryOutputError, RecoveryResult
from t3mpc_ros.cli import process_group
from t3mpc_ros.cli.main import main
from t3mpc_ros.cli.process_group import ProcessError, ProcessGroup
from t3mpc_ros.emulator.fault_injection import FaultError
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.tool.link_test import FAIL, PASS, POOR, SKIPPED, Check
from t3mpc_ros.radio.tool.procedure import ProcedureError
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, StoredSettings, settings_file

RUN = 'radio.tool.procedure.run_script'
EMULATOR, RECOVER = 'emulator.emulator.Emulator', 'bag.recovery.recover_bag'


class Interruption:
    """Ctrl-C while a procedure runs, which then ends for a reason."""

    def __init__(self, reason='interrupted'):
        self._reason = reason

    def __call__(self, *_):
        signal.raise_signal(signal.SIGINT)
        raise ProcedureError(self._reason)


def stored(state=frames.SETTINGS_GOOD, **changes):
    return {RUN: StoredSettings(state, RobotSettings()._replace(**changes))}


def rated(*verdicts):
    rows = [Check(2, 'a', verdict, '1', 'remedy') for verdict in verdicts]
    return {RUN: 'result', 'radio.tool.link_test.evaluate': rows}


def checked(*verdicts):
    return {'cli.robot_doctor.run_doctor': [Check(0, 'a', each, '') for each in verdicts]}


def answered(good):
    return {RUN: 'result', 'radio.tool.channel_scan.recommend': (good, 'advice')}


def jogged(error=''):
    task = SimpleNamespace(result=None, error=error)
    return {'radio.tool.manoeuvre.Jog': task, 'radio.tool.procedure.run_at_port': None}


def recovered(ended, *damages):
    file = FileResult('x', 1, ended=ended, damages=list(damages))
    return {RECOVER: RecoveryResult(Path('new'), (file,))}


def compared(same):
    module = 'evaluation.process_replay.'
    outcome = SimpleNamespace(table=lambda: '', same=same, to_dict=dict)
    return {
        f'{module}controller_inputs.load_inputs': None,
        f'{module}controller_replay.replay_controller': None,
        f'{module}replay_comparison.compare': outcome,
    }


def graph(**answers):
    return {'nodes.graph_client.graph': nullcontext(MagicMock(**answers))}


def studied(*verdicts):
    return {
        'evaluation.fault_outcomes.study_faults': [{'verdict': v} for v in verdicts],
        'evaluation.fault_outcomes.console_text': '',
    }


def swept(*errors):
    rows = [{'error': error} for error in errors]
    found = SimpleNamespace(table=lambda metric: metric, rows=rows)
    return {'evaluation.api.parameter_sweep.sweep': found}


EXPONENTS = 'evaluation.lyapunov_exponents.lyapunov_exponents'
KEY = frames.KeyState(0, 0, frames.KEY_HELD, 1)
LOSS, DOUBLE = Damage(0, 9, 'torn', messages=2), Damage(0, 9, 'torn', harmless=True)
ROBOT = {
    'ping --port p': 'answers',
    'scan --port p': 'answers',
    'parameters --port p': '',
    'setup --port p': '',
    'log --port p': '',
    'key state --port p': '',
    'key erase --port p': '',
    'key write key --port p': '',
}
CASES = [
    *((f'robot {words}', {RUN: ProcedureError('no board')}, 2, 'no board') for words in ROBOT),
    *((f'robot {words}', {RUN: Interruption()}, 130, 'interrupted') for words in ROBOT),
    ('robot scan --port p', {RUN: Interruption('not restored')}, 130, 'interrupted: not restor'),
    ('robot ping --port p', rated(PASS), 0, 'pass'),
    ('robot ping --port p', rated(PASS, POOR), 0, 'try: remedy'),
    ('robot ping --port p', rated(PASS, FAIL), 1, 'fail'),
    ('robot scan --port p', answered(True), 0, 'advice'),
    ('robot scan --port p', answered(False), 1, 'advice'),
    ('robot setup --port p', stored(), 0, 'settings stored in both copies'),
    ('robot setup --port p', stored(frames.SETTINGS_ONE_COPY), 1, 'one of their two copies'),
    ('robot setup --port p', stored(frames.SETTINGS_MISSING), 1, 'no settings'),
    ('robot setup --port p --diff robot.yaml', stored(), 0, 'equal to robot.yaml'),
    ('robot setup --port p --diff robot.yaml', stored(channel=9), 1, 'channel: 9 -> 82'),
    ('robot setup --port p --save new.yaml', stored(frames.SETTINGS_MISSING), 2, 'no settings to'),
    ('robot key state --port p', {RUN: KEY}, 0, 'the robot has a key, check value 00000001'),
    ('robot key state --port p --key key', {RUN: KEY}, 1, 'different from the file'),
    ('robot key create key', {}, 2, 'key exists: a key is never overwritten'),
    ('robot key create new', {}, 0, 'new: new key'),
    ('robot key check key', {}, 0, 'key: a key, check value'),
    ('robot jog left 1 --port p --yes', jogged(), 0, ''),
    ('robot jog left 1 --port p --yes', jogged('blocked'), 2, 'blocked'),
    ('robot doctor --port p --robot-port r --no-questions', checked(PASS, SKIPPED), 0, ''),
    ('robot doctor --port p --robot-port r --no-questions', checked(PASS, FAIL), 1, ''),
    ('emulator --link l', {EMULATOR: FaultError('no such fault')}, 2, 'no such'),
    ('emulator --link l --key none', {}, 2, 'none'),
    ('bag info none', {}, 1, 'none'),
    ('bag recover bag', recovered(True), 0, 'nothing is lost'),
    ('bag recover bag', recovered(True, DOUBLE), 0, 'nothing is lost with it'),
    ('bag recover bag', recovered(True, LOSS), 3, '2 messages lost'),
    ('bag recover bag', recovered(False), 3, ''),
    ('bag recover bag', {RECOVER: RecoveryOutputError('not empty')}, 2, 'not empty'),
    ('bag recover bag', {RECOVER: BagError('no message')}, 1, 'no message'),
    ('bag compare bag', compared(True), 0, ''),
    ('bag compare bag', compared(False), 3, ''),
    ('bag compare bag --abs -1', {}, 1, 'tolerance absolute must be from 0'),
    ('bag compare a b --set law.gain=1', compared(True), 1, 'give one bag only'),
    ('param set /n a 1', graph(**{'set_parameter.return_value': ''}), 0, 'successful'),
    ('param set /n a 1', graph(**{'set_parameter.return_value': 'read-only'}), 1, 'read-only'),
    ('call /s [1]', graph(), 1, 'the fields must be a YAML mapping'),
    ('stop', graph(**{'stop_robots.return_value': {'a': '', 'b': ''}}), 0, 'a: latched\nb: lat'),
    ('stop', graph(**{'stop_robots.return_value': {'a': '', 'b': 'no answer'}}), 1, 'b: no answe'),
    ('stop', graph(**{'stop_robots.return_value': {}}), 1, 'ROS_DOMAIN_ID'),
    ('faults', studied('bounded', 'stops', 'impaired'), 0, ''),
    ('faults', studied('bounded', 'unbounded'), 1, ''),
    ('faults no_fault', {}, 1, 'FAULT must be one of'),
    ('faults brown_out --output x', {}, 1, 'give no FAULT with it'),
    ('demo --patrol --robot servo', {}, 2, '--patrol needs --robot twin: got servo'),
    ('demo --loss 0.1', {}, 2, '--loss needs --robot emulator: got twin'),
    ('exponents', {EXPONENTS: (1.0, 0.5, -2.0)}, 0, '1.000, 0.500, -2.000\ntheir sum: -0.500'),
    ('exponents', {EXPONENTS: OSError('no file')}, 1, 'error: no file'),
    ('exponents', {EXPONENTS: RuntimeError('broken')}, 1, 'error: broken'),
    ('exponents', {EXPONENTS: ValueError('wrong')}, 1, 'error: wrong'),
    ('exponents', {EXPONENTS: KeyboardInterrupt()}, 130, 'stopped'),
    ('exponents', {EXPONENTS: ModuleNotFoundError('x', name='pyarrow')}, 1, 'pyarrow'),
    ('train bag --robot torque', {}, 1, 'robot must be servo for bags: got torque'),
    ('train --keep-predictor', {}, 1, '--keep-predictor is for bags'),
    ('tune --robot none', {}, 1, 'robot must be twin, servo, torque or an existing bag: got none'),
    *(
        (f'tune --robot key {words}', {}, 1, text)
        for words, text in {
            '--resume': 'are for simulated robots: got a bag',
            '--evaluations 3': 'are for simulated robots: got a bag',
            'adrc': 'are for simulated robots: got a bag',
            '--track 0.2': '--wheel-radius and --track must be given together',
        }.items()
    ),
    ('compare --methods feedforward', {}, 1, 'got feedforward; did you mean feed-forward'),
    ('compare --cases nominel', {}, 1, 'got nominel; did you mean nominal'),
    ('compare --robot servo --cases miscalibrated', {}, 1, 'case must be one of nominal, mass'),
    ('compare --robot servo --gyro', {}, 1, 'gyro is for the twin alone: got robot servo'),
    ('compare --gyro --reference x.csv', {}, 1, '--gyro is for the methods of the package'),
    ('sweep', swept('', ''), 0, '2 runs: runs/sweep.parquet'),
    ('sweep', swept('', 'diverged at 1.00 s'), 0, '2 runs: runs/sweep.parquet'),
    ('sweep', swept('', 'no file', 'no file'), 3, '2 of 3 runs failed'),
    ('paper --seeds 1-3', {}, 1, 'seeds must be of 101-120'),
    ('patrol --paths nothing', {}, 1, 'path must be one of'),
    ('patrol --arena 1 1 2 2', {}, 1, 'arena must contain the start'),
    ('bag report bag --track 1', {}, 1, '--wheel-radius and --track must be given together'),
    ('bag animate bag --output x.mp4', {}, 1, 'output must end in .gif'),
    ('bag animate bag --output x.gif --rate 99', {}, 2, 'rate: must be from 0.1 to 50 Hz'),
    *(
        (words, {}, 2, text)
        for words, text in {
            'demo --duration 0': 'must be from 1 to 86400 seconds: got 0',
            'demo --seed -1': 'argument --seed: must be from 0 to 1e+15: got -1',
            'demo --output key': 'must be a folder, or the path of a new one: got key',
            'demo --output key/a/b': 'of a new one: got key/a/b, and key is a file',
            "demo --output ''": "must name a folder, . for this one: got ''",
            'bag report b --output key/a': 'got key/a, and key is a file',
            'patrol --output key': 'of a new one: got key',
            'demo --output /dev/null/a': 'got /dev/null/a, and /dev/null is a file',
            'demo --loss 1': 'must be from 0 to below 1: got 1',
            'estimation --gain x': "invalid number value: 'x'",
            'paper --seeds 3': 'must be A-B, as in 1-3, or 3-3 for one',
            'estimation --seeds 2-1': 'must be A-B with 0 <= A <= B',
            'sweep --set gain': 'must be NAME=V,V,…: got gain',
            f'view --runs {__file__}': 'must be a folder, or the path of a new one',
            'view --port 70000': 'must be from 0 to 65535',
            'robot setup --port p --address 11': 'must be 10 hexadecimal digits',
            'robot setup --port p --microsteps 3': 'must be a power of two',
            'robot setup --port p --sensors x': 'sensors must be 8 of none',
            'robot jog left 0 --port p': 'must be from 0.01 to 100 turns, or negative',
            'robot jog left one --port p': "REVOLUTIONS: invalid number value: 'one'",
            'robot jog left 1 --speed 11 --port p': 'must be from 0.2 to 10 rad/s: got 11',
            'bag replay b --method DMC': '--method was removed: examples/recorded_reference.py',
            'bag compare': 'required: BAG',
            'bag compare --update-golden test/golden': 'removed: PYTHONPATH=. .venv/bin/python',
            'robot ping --port x --set channel=126': 'channel must be',
            'robot scan --port x --set rate': 'NAME=VALUE',
            'robot jog left 1 --port x --key no/such/file --yes': 'no/such/file',
            'robot jog left 1 --port x': 'or --yes',
            'robot key check no/such/file': 'no/such/file',
            'robot setup --port x --save no/such/file': 'no/such/file cannot be written',
            'robot doctor --port x --robot-port y': 'or use --no-questions',
            'robot doctor --port x --robot-port x --report no/such': 'no/such cannot be written',
            'robot calibrate --port x --save /': '/ cannot be written',
            'robot calibrate --port x': 'run it at a terminal',
            'robot calibrate --port x --steps rest,raduis': 'must be of rest, radius',
            'robot calibrate --port x --distances 0.1,0.2,0.3': 'at least 4, from 0.05 to 1 m',
            'robot': 'required: COMMAND',
            'topic': 'required',
            'nothing': 'invalid choice',
            'twin --quick': 'error: t3mpc twin was removed: examples/digital_twin.py',
            '': 'required: COMMAND',
        }.items()
    ),
]  # fmt: skip


@pytest.mark.parametrize(
    ('words', 'instead', 'code', 'text'),
    CASES,
    ids=[f'{words} {code} {text}'[:60] for words, _, code, text in CASES],
)
def test_the_exit_code_says_how_it_ended(
    words, instead, code, text, monkeypatch, tmp_path, capsys
):
    (tmp_path / 'key').write_text('01' * 16)
    (tmp_path / 'key').chmod(0o600)
    (tmp_path / 'robot.yaml').write_text(settings_file(RobotSettings()))
    monkeypatch.chdir(tmp_path)
    for name, result in instead.items():
        replace(monkeypatch, f't3mpc_ros.{name}', result)
    try:
        found = main(shlex.split(words))
    except SystemExit as end:
        found = end.code
    shown = capsys.readouterr()
    assert found == code
    assert text in shown.out + shown.err
    assert 'Traceback' not in shown.err


def replace(monkeypatch, target, result):
    """Let a function return something, or raise it."""

    def instead(*arguments, **named):
        if isinstance(result, BaseException):
            raise result
        return result(*arguments) if isinstance(result, Interruption) else result

    monkeypatch.setattr(target, instead)


# -- processes of others --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('end', 'code'),
    [
        ('sys.exit(0)', 0),
        ('sys.exit(3)', 3),
        ('os.kill(os.getpid(), signal.SIGKILL)', -signal.SIGKILL),
        ('os.kill(os.getpid(), signal.SIGTERM)', -signal.SIGTERM),
    ],
)
def test_the_code_of_a_process_is_how_it_ended(end, code, tmp_path, monkeypatch):
    """A node that a signal has killed has a negative code: it did not end cleanly."""
    program = tmp_path / 'node'
    # No path with a blank can stand behind "#!".
    program.write_text(f"#!/bin/sh\nexec '{sys.executable}' '{program}.py' \"$@\"\n")
    program.with_suffix('.py').write_text(
        'import os, signal, sys\nprint("here", flush=True)\n'
        f'signal.signal(2, lambda *_: None)\nsignal.sigwait([2]) if not sys.argv[1:] else None\n'
        f'{end}\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(process_group, 'executable', lambda name: program)

    def started(*arguments):
        group = ProcessGroup(tmp_path / 'log', os.environ)
        previous = signal.pthread_sigmask(signal.SIG_BLOCK, [2])  # inherited: for sigwait
        try:
            group.start('node', *arguments)
        finally:  # a later test would start what no Ctrl-C ends
            signal.pthread_sigmask(signal.SIG_SETMASK, previous)
        group.wait_for('node', 'here')
        return group

    assert started().stop_all() == {'node': code}
    group = started('now')
    with pytest.raises(ProcessError, match=f'node ended with code {code} before'):
        group.wait_for('node', 'never')
    with pytest.raises(ProcessError, match=f'node ended with code {code} during the run'):
        group.check()


@pytest.mark.slow
def test_an_output_that_is_cut_off_is_no_error():
    """``t3mpc topic echo /odom | head`` ended with *error: [Errno 32] Broken pipe*."""
    code = 'import sys; from t3mpc_ros.cli.main import main; sys.exit(main(sys.argv[1:]))'
    words = [sys.executable, '-c', code, 'exponents', '--duration', '1']
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        child.stdout.close()
        assert child.stderr.read() == b''
    assert child.returncode == 128 + signal.SIGPIPE
