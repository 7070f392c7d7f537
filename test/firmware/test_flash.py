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
"""``make flash``: the programmer is found, and avrdude gets the right command."""

import importlib.util
import os
from pathlib import Path
import subprocess
import threading

import pytest
from support.missing_tools import needs

FIRMWARE = Path(__file__).resolve().parents[2] / 'firmware'


def load():
    spec = importlib.util.spec_from_file_location('flash', FIRMWARE / 'flash.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


flash = load()


@pytest.fixture
def sysfs(tmp_path):
    """Return the folder of a computer without USB devices, and a function that plugs one in."""
    (tmp_path / 'bus/usb/devices').mkdir(parents=True)
    (tmp_path / 'class/tty').mkdir(parents=True)

    def plug(name, usb_id, tty=None):
        device = tmp_path / 'devices' / name
        device.mkdir(parents=True)
        for file, text in zip(('idVendor', 'idProduct'), usb_id.split(':'), strict=True):
            (device / file).write_text(f'{text}\n')
        (tmp_path / 'bus/usb/devices' / name).symlink_to(device)
        if tty is not None:
            (device / f'{name}:1.0' / tty).mkdir(parents=True)
            entry = tmp_path / 'class/tty' / tty
            entry.mkdir()
            (entry / 'device').symlink_to(device / f'{name}:1.0' / tty)

    return tmp_path, plug


def fail(port):
    raise AssertionError(f'{port} must not be asked')


def test_a_programmer_on_usb_is_preferred_and_writes_fuses(sysfs):
    folder, plug = sysfs
    plug('1-1', '16c0:05dc')
    plug('1-2', '1a86:7523', 'ttyUSB0')
    plug('1-3', '046d:c534')
    programmer = flash.find_programmer(folder, None, fail)
    words = flash.command(programmer, 'robot', Path('robot.hex'))
    assert words[:5] == ['avrdude', '-c', 'usbasp', '-p', 'm2560']
    assert sum(':w:0x' in word for word in words) == 3
    assert words[-1] == 'flash:w:robot.hex:i'


def test_no_serial_port_is_opened_unasked(sysfs):
    """All were asked: that reset every device with such a chip, and wrote to it."""
    folder, plug = sysfs
    plug('1-1', '2341:0042', 'ttyACM0')
    plug('1-2', '1a86:7523', 'ttyUSB0')
    plug('1-3', '12d1:1506', 'ttyUSB1')  # a modem
    with pytest.raises(
        flash.FlashError, match=r'PORT=.*serial ports: /dev/ttyACM0, /dev/ttyUSB0\)'
    ):
        flash.find_programmer(folder, None, fail)


def test_only_the_named_port_is_asked(sysfs):
    folder, plug = sysfs
    plug('1-1', '16c0:05dc')
    plug('1-2', '1a86:7523', 'ttyUSB0')
    asked = []

    def ask(port):
        asked.append(port)
        return flash.boot_loader(port, 'wiring', 115200) if 'ACM' in port else None

    with pytest.raises(flash.FlashError, match='no programmer answers at /dev/ttyUSB0'):
        flash.find_programmer(folder, '/dev/ttyUSB0', ask)
    programmer = flash.find_programmer(folder, '/dev/ttyACM0', ask)
    assert asked == ['/dev/ttyUSB0', '/dev/ttyACM0']
    words = flash.command(programmer, 'robot', Path('robot.hex'))
    assert words[1:8] == ['-c', 'wiring', '-P', '/dev/ttyACM0', '-b', '115200', '-D']
    assert not any('fuse' in word for word in words)


def test_none_and_several_programmers_have_a_remedy(sysfs):
    folder, plug = sysfs
    with pytest.raises(flash.FlashError, match='plug in a USBasp'):
        flash.find_programmer(folder, None, fail)
    plug('1-1', '16c0:05dc')
    plug('1-2', '1781:0c9f')
    with pytest.raises(flash.FlashError, match=r'more than one(.|\n)*USBasp(.|\n)*USBtinyISP'):
        flash.find_programmer(folder, None, fail)


@pytest.mark.parametrize(
    'port, text', [('no-port', 'no-port does not exist'), ('closed', 'permission denied; sudo')]
)
def test_a_port_that_cannot_be_opened_is_named(port, text, tmp_path, monkeypatch, capsys):
    """It said that no programmer answers, and asked whether another program uses the port."""
    monkeypatch.chdir(tmp_path)
    Path('closed').touch()
    Path('robot.hex').touch()
    monkeypatch.setattr(flash.os, 'access', lambda path, mode: False)  # also for root
    assert flash.main(['robot', 'robot.hex', '--port', port]) == 2
    assert text in capsys.readouterr().err


def test_an_image_that_was_not_built_is_named(sysfs, capsys):
    folder, _ = sysfs
    assert flash.main(['robot', 'no.hex', '--port', 'x', '--sysfs', str(folder)]) == 2
    assert 'no.hex does not exist: make -C firmware avr writes it' in capsys.readouterr().err


@pytest.mark.parametrize('name', flash.QUESTIONS)
def test_programmers_at_a_port_are_distinguished(name, monkeypatch):
    """Each answers its own protocol at its own baud rate, and nothing to the others."""
    question = flash.QUESTIONS[name]
    monkeypatch.setattr(flash, '_TIMEOUT', 0.1)
    monkeypatch.setattr(flash.time, 'sleep', lambda seconds: None)
    master, slave = os.openpty()
    speeds, ended = [], threading.Event()
    configure = flash._configure

    def note_speed(handle, baud):
        speeds.append(baud)
        configure(handle, baud)

    monkeypatch.setattr(flash, '_configure', note_speed)

    def board():
        while not ended.is_set():
            data = os.read(master, 256)
            if speeds[-1] == question.baud and data.startswith(question.request[:2]):
                os.write(master, b'\x1b\x01\0\x0b\x0e\x01\0\x08' + question.answer)

    thread = threading.Thread(target=board, daemon=True)
    thread.start()
    programmer = flash.ask_port(os.ttyname(slave))
    ended.set()
    os.write(slave, b'end')
    thread.join(5.0)
    os.close(master)
    os.close(slave)
    assert programmer == question.programmer(programmer.options[3])
    assert programmer.options[5] == str(question.baud)
    assert bool(programmer.warning) == (name.startswith('boot loader'))


def run_make(*words):
    needs('make')
    return subprocess.run(['make', '-s', '-C', FIRMWARE, *words], capture_output=True, text=True)


def test_make_prints_what_it_found_and_the_command(sysfs):
    """The file is taken as it is, without a compiler: ``-o``."""
    folder, plug = sysfs
    plug('1-1', '16c0:05dc')
    old = ['-o', 'build/dongle.hex']
    done = run_make(*old, 'flash-dongle', 'DRY_RUN=1', f'FLASH=--sysfs {folder}')
    assert done.returncode == 0, done.stderr
    assert 'USBasp (USB 1-1): dongle' in done.stdout
    assert 'avrdude -c usbasp -p m328p' in done.stdout


@pytest.mark.parametrize('goal, board', [('flash', 'robot'), ('flash-dongle', 'dongle')])
def test_make_passes_the_port_of_the_page(goal, board):
    done = run_make('-n', goal, 'PORT=/dev/ttyUSB0', 'DRY_RUN=1')
    last = done.stdout.splitlines()[-1]
    assert f' {board} build/{board}.hex' in last
    assert '--port /dev/ttyUSB0' in last
    assert '--dry-run' in last


@pytest.mark.parametrize('goal', ['flash', 'flash-dongle', 'avr', 'core'])
def test_make_without_the_compiler_of_the_boards_has_a_remedy(goal, tmp_path):
    """It said ``avr-gcc: No such file or directory``."""
    done = run_make('AVR_CC=no-such-gcc', f'BUILD={tmp_path}', goal)
    assert done.returncode != 0
    assert 'error: no-such-gcc is not installed' in done.stderr
    assert 'remedy: sudo apt-get install gcc-avr' in done.stderr
