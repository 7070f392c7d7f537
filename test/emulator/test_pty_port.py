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
"""Pseudo-terminal port of the emulator, and ``t3mpc emulator`` as a process."""

from itertools import product
import os
from pathlib import Path
import re
import select
import signal
import subprocess
import sys
import termios

import pytest
from support.missing_tools import needs
from support.waiting import communicate

from t3mpc_ros.cli import emulator, robot
from t3mpc_ros.emulator.pty_port import PtyPort, PtyPortError, serve
from t3mpc_ros.radio.serial_port import PortError, SerialPort

ROOT = Path(__file__).resolve().parents[2]
KEY = bytes(range(16))


@pytest.mark.slow
def test_a_command_reaches_the_process_over_a_pty_with_a_key(tmp_path, capsys):
    needs('C compiler')
    key_file, path = tmp_path / 'key', tmp_path / 'dongle'
    key_file.write_text(KEY.hex())
    key_file.chmod(0o600)
    words = f'--link {path} --key {key_file} --loss 0.05 --fault jam:0:0.2'
    command = [sys.executable, '-m', 't3mpc_ros.cli.emulator', *words.split()]
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as child:
        try:
            ready = next((line for line in child.stdout if 'dongle and robot' in line), '')
            assert str(path) in ready
            assert f'kill {child.pid}' in ready
            read = ['parameters', '--port', str(path), '--key', str(key_file)]
            # A process that gets no processor for 0.3 s looks like a dongle that restarted, and
            # the jam of the start like a robot out of range.
            for _ in range(5):
                if robot.main(read) == 0:
                    break
                errors = capsys.readouterr().err
                assert re.search('the dongle stopped answering|the robot does not answer', errors)
            assert 'ttl_max' in capsys.readouterr().out
            assert path.is_symlink()
            child.send_signal(signal.SIGINT)
            assert communicate(child) == ('t3mpc emulator: stopped\n', '')
            assert child.returncode == 0
        finally:
            child.kill()
    assert not path.is_symlink()


def test_the_terminal_is_raw_before_it_is_published(tmp_path):
    """A cooked terminal echoes the input and translates carriage returns."""
    port = PtyPort(tmp_path / 'dongle')
    assert port.wait(0.0) is None
    client = os.open(tmp_path / 'dongle', os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    assert not termios.tcgetattr(client)[3] & (termios.ECHO | termios.ICANON)
    data = bytes(range(256))
    os.write(client, data)
    assert port.wait(1.0) == data
    port.write(data)
    select.select([client], [], [], 1.0)
    assert os.read(client, 1000) == data
    os.close(client)
    assert port.wait(0.0) is None
    port.close()
    assert not (tmp_path / 'dongle').is_symlink()


def test_a_new_terminal_hangs_up_the_old_one_and_moves_the_link(tmp_path):
    path = tmp_path / 'dongle'
    port = PtyPort(path)
    old = SerialPort(str(path))
    before = os.readlink(path)
    port.open()
    assert os.readlink(path) != before
    with pytest.raises(PortError):
        old.write(b'x')
    new = SerialPort(str(path))
    new.write(b'hello')
    assert port.wait(1.0) == b'hello'
    new.close()
    port.close()


def test_a_client_that_does_not_read_does_not_block(tmp_path):
    port = PtyPort(tmp_path / 'dongle')
    client = SerialPort(str(tmp_path / 'dongle'))
    for _ in range(100):
        port.write(bytes(4096))
    client.close()
    port.close()


def test_a_link_to_another_terminal_is_not_removed(tmp_path):
    path = tmp_path / 'dongle'
    first, second = PtyPort(path), PtyPort(path)
    first.close()
    assert path.is_symlink()
    second.close()
    assert not path.is_symlink()
    with pytest.raises(PtyPortError, match='No such file'):
        PtyPort(tmp_path / 'nowhere' / 'dongle')


class ScriptedPort:
    """A port whose client is there (bytes) or not (None) at each update."""

    def __init__(self, inputs):
        self.inputs, self.written, self.calls = [*inputs], [], []

    def wait(self, seconds):
        return self.inputs.pop(0)

    def write(self, data):
        self.written.append(data)

    def open(self):
        self.calls.append('open')

    def close(self):
        self.calls.append('close')


class ScriptedEmulator:
    """Records what it is told, and answers each update with its number."""

    now_ns, next_ns, port_number, port_open = 0, None, 0, True

    def __init__(self):
        self.updates, self.told = 0, []

    def run_to(self, now_ns):
        self.updates += 1
        return [(now_ns, b'%d' % self.updates)]

    def feed(self, data, now_ns):
        self.told.append(('dongle', self.updates, data))

    def feed_console(self, data, now_ns):
        self.told.append(('robot', self.updates, data))

    def take_console(self):
        return [(0, b'%d' % self.updates)]

    def restart_dongle(self):
        self.told.append(('dongle', self.updates + 1, 'restart'))

    def restart_robot(self):
        self.told.append(('robot', self.updates, 'restart'))


@pytest.mark.parametrize('restart_on_open', [True, False])
@pytest.mark.parametrize('scripted', ['dongle', 'robot'])
def test_each_opening_of_a_port_restarts_its_board(scripted, restart_on_open):
    """Whenever a client comes, after any history of clients, and no board but that of the port.

    What a client writes arrives once and after the restart; without a client nothing is written.
    """
    for inputs in product((None, b'', b'x'), repeat=5):
        inputs, absent = [*inputs, None], [None] * 6
        ports = {'dongle': ScriptedPort(absent), 'robot': ScriptedPort(absent)}
        ports[scripted] = ScriptedPort(inputs)
        emulator = ScriptedEmulator()
        serve(
            emulator,
            ports['dongle'],
            1.0,
            lambda emulator=emulator: emulator.updates == 6,
            restart_on_open,
            ports['robot'],
        )
        expected = []
        for update, (before, now) in enumerate(zip([None, *inputs], inputs, strict=False), 1):
            if restart_on_open and before is None and now is not None:
                expected.append((scripted, update, 'restart'))
            if now:
                expected.append((scripted, update, now))
        assert emulator.told == expected, inputs
        answered = [b'%d' % k for k, each in enumerate(inputs, 1) if each is not None]
        assert [port.written for port in ports.values()] == [
            answered if name == scripted else [] for name in ports
        ]


def test_the_port_follows_each_time_the_dongle_is_plugged_again():
    emulator, port, expected = ScriptedEmulator(), ScriptedPort([b''] * 9), []
    script = [(True, 0), (False, 0), (False, 0), (True, 0), (True, 1), (False, 1), (True, 1)]
    script += [(True, 2), (True, 2)]
    for (plugged, number), (now_plugged, now_number) in zip(script, script[1:], strict=False):
        expected += [('close', 'open')[now_plugged]] * (plugged != now_plugged)
        expected += ['open'] * (number != now_number)

    def update():
        emulator.port_open, emulator.port_number = script[emulator.updates - 1]

    serve(emulator, port, 1.0, lambda: emulator.updates == len(script), on_update=update)
    assert port.calls == expected


@pytest.mark.parametrize(
    'arguments, text',
    [
        (['--fault', 'jamm:1'], 'did you mean jam'),
        (['--set', 'twin.motor.microsteps=32'], 'microsteps'),
        (['--world', 'atlantis'], 'atlantis'),
        (['--key', 'no/such/file'], 'no/such/file'),
    ],
)
def test_invalid_arguments_are_reported_before_the_start(arguments, text, tmp_path, capsys):
    path = tmp_path / 'dongle'
    assert emulator.main(['--link', str(path), *arguments]) == 2
    assert text in capsys.readouterr().err
    assert not path.is_symlink()


def test_one_path_for_both_boards_is_refused(tmp_path, monkeypatch, capsys):
    """The second terminal took the place of the first, whose board nobody could reach."""
    monkeypatch.chdir(tmp_path)
    assert emulator.main(['--link', 'a', '--robot-link', str(tmp_path / 'a')]) == 2
    assert 'must be two paths: got a' in capsys.readouterr().err


def test_a_failed_robot_link_removes_the_other_link(tmp_path, capsys):
    needs('C compiler')
    thesis, path = tmp_path / 'thesis', tmp_path / 'dongle'
    thesis.write_text('chapter 1')
    assert emulator.main(['--link', str(path), '--robot-link', str(thesis)]) == 2
    assert 'no symbolic link' in capsys.readouterr().err
    assert not path.is_symlink()
    assert thesis.read_text() == 'chapter 1'


def test_help_names_every_fault(capsys):
    with pytest.raises(SystemExit):
        emulator.main(['--help'])
    output = capsys.readouterr().out
    for kind in emulator.FAULT_KINDS:
        assert f'  {kind.name} ' in output
