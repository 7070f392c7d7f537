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
"""Serial port on a pseudo terminal: every failure is a PortError with a remedy."""

import errno
import os
import select
import termios
import tty

import pytest

from t3mpc_ros.radio import serial_port as module
from t3mpc_ros.radio.serial_port import PortError, SerialPort, find_ports


@pytest.fixture
def line(tmp_path):
    """Yield the master of a raw pseudo terminal, and the path of its slave."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = tmp_path / 'dongle'
    path.symlink_to(os.ttyname(slave))
    os.close(slave)
    ends = [master]
    yield ends, str(path)
    for end in ends:
        os.close(end)


def unplug(ends, path):
    """Remove the device, as when the dongle is unplugged."""
    os.close(ends.pop())
    os.unlink(path)


def test_ports_of_a_pattern_are_listed_once(tmp_path):
    """The udev rule gives a device two names."""
    for name in ('ttyUSB0', 'ttyUSB1'):
        (tmp_path / name).touch()
        (tmp_path / f'dongle_{name}').symlink_to(tmp_path / name)
    (tmp_path / 'dongle').symlink_to(tmp_path / 'ttyUSB1')
    found = find_ports(str(tmp_path / 'dongle*'))
    assert found == [str(tmp_path / name) for name in ('dongle', 'dongle_ttyUSB0')]
    assert find_ports('/dev/no_such_port*') == ['/dev/no_such_port*']
    assert find_ports(str(tmp_path / 'ttyUSB0')) == [str(tmp_path / 'ttyUSB0')]


def test_bytes_pass_unchanged_both_ways(line):
    (master, *_), path = line
    port = SerialPort(path)
    everything = bytes(range(256))
    port.write(everything)
    found = b''
    while len(found) < 256 and select.select([master], [], [], 5.0)[0]:
        found += os.read(master, 1000)
    assert found == everything
    assert port.read() == b''  # returns at once without bytes
    os.write(master, everything)
    found = b''
    while len(found) < 256 and select.select([port.fileno()], [], [], 5.0)[0]:
        found += port.read()
    assert found == everything
    assert not port.low_latency  # pseudo terminals have no such mode, which is no error
    port.close()
    port.close()


@pytest.mark.parametrize('use', ['read', 'write', 'fileno after read'])
def test_an_unplugged_dongle_is_detected_at_the_next_use(line, use):
    """Depending on the call, pyserial raises SerialException, OSError or termios.error."""
    ends, path = line
    port = SerialPort(path)
    unplug(ends, path)
    with pytest.raises(PortError, match='does not exist: is the dongle plugged in') as error:
        port.write(b'x') if use == 'write' else port.read()
    assert error.value.absent
    # The port is closed now; every later call raises the same error.
    for again in (port.read, port.fileno, lambda: port.write(b'x')):
        with pytest.raises(PortError):
            again()


def test_a_port_is_exclusive_and_free_after_close(line):
    _, path = line
    port = SerialPort(path)
    with pytest.raises(PortError, match=r'is busy: another program has it open; lsof') as error:
        SerialPort(path)
    assert not error.value.absent
    port.close()
    SerialPort(path).close()


def test_a_blocked_reader_does_not_block_write(line):
    _, path = line
    port = SerialPort(path)
    with pytest.raises(PortError, match='failed: Write timeout'):
        port.write(bytes(200_000))


def test_a_missing_port_is_absent_and_a_file_is_none(tmp_path):
    """It said: Could not configure port: (25, 'Inappropriate ioctl for device')."""
    (tmp_path / 'file').write_text('no port')
    for name, text in (
        ('nothing', 'nothing does not exist'),
        ('file', 'file is no serial port: ls -l /dev/serial'),
    ):
        with pytest.raises(PortError, match=text) as error:
            SerialPort(str(tmp_path / name))
        assert error.value.absent == (name == 'nothing')


@pytest.mark.parametrize(
    'error, expected',
    [
        (OSError(errno.EACCES, 'Permission denied'), 'usermod -aG dialout'),
        (OSError(errno.EPERM, 'not permitted'), 'permission denied'),
        (OSError(errno.EBUSY, 'busy'), 'is busy'),
        (OSError(errno.ENODEV, 'gone'), 'does not exist'),
        (termios.error(errno.EIO, 'Input/output error'), 'failed: .*Input/output error'),
        (termios.error(errno.ENXIO, 'gone'), 'does not exist'),
        (ValueError('Invalid baud rate'), 'failed: Invalid baud rate'),
        (TypeError('an integer is required'), 'failed: an integer is required'),
    ],
    ids=str,
)
def test_every_error_becomes_a_port_error_with_a_remedy(line, monkeypatch, error, expected):
    def fail(*args, **more):
        raise error

    monkeypatch.setattr(module.serial, 'Serial', fail)
    with pytest.raises(PortError, match=expected):
        SerialPort(line[1])
