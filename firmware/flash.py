#!/usr/bin/env python3
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
"""Flash a board: ``make flash PORT=/dev/…``, ``make flash-dongle PORT=/dev/…``.

The port is that of an Arduino with the sketch ArduinoISP, or of the board itself, whose boot
loader answers. Without a port only programmers on USB are used: USBasp, USBtinyISP and AVRISP
mkII, by their USB ids. No other serial port is opened, because that resets the device behind it,
and what is asked there may move it. A boot loader keeps the fuses; a programmer writes them.
"""

import argparse
from collections.abc import Callable, Sequence
import fcntl
import os
from pathlib import Path
import select
import shlex
import struct
import subprocess
import sys
import termios
import time
from typing import NamedTuple

PARTS = {'robot': 'm2560', 'dongle': 'm328p'}
FUSES = ('lfuse:w:0xFF:m', 'hfuse:w:0xD7:m', 'efuse:w:0xFC:m')
"""16 MHz crystal, no boot loader, EEPROM survives, brown-out at 4.3 V."""
USB_PROGRAMMERS = {
    '16c0:05dc': ('usbasp', 'USBasp'),
    '1781:0c9f': ('usbtiny', 'USBtinyISP'),
    '03eb:2104': ('avrispmkII', 'AVRISP mkII'),
}
SERIAL_CHIPS = ('2341', '2a03', '1a86', '0403', '10c4')
"""Vendors of Arduinos and of the USB chips of their clones: their ports are listed."""
OLD_LOADER = (
    'this boot loader may keep the board resetting after a watchdog reset, until its power is cut '
    '(docs/robot.md, Boot loaders)'
)
_SYNC_V2 = bytes([0x1B, 1, 0, 1, 0x0E, 1, 0x1B ^ 1 ^ 0 ^ 1 ^ 0x0E ^ 1])
_TIMEOUT = 0.5


class FlashError(Exception):
    """No programmer, or more than one; the text contains the remedy."""


class Programmer(NamedTuple):
    """A way to flash a board."""

    name: str
    options: tuple[str, ...]
    """Of avrdude."""
    fuses: bool
    """Whether it can write fuses."""
    warning: str = ''


class Question(NamedTuple):
    """What to send to a serial port, and the answer of a programmer."""

    baud: int
    reset: bool
    """Whether the board is reset before: its boot loader answers for a second."""
    wait: float
    """s"""
    request: bytes
    answer: bytes
    programmer: Callable[[str], Programmer]


def arduino_as_isp(port: str) -> Programmer:
    """Return an Arduino with the sketch ArduinoISP."""
    options = ('-c', 'stk500v1', '-P', port, '-b', '19200')
    return Programmer(f'Arduino as ISP at {port}', options, True)


def boot_loader(port: str, protocol: str, baud: int, warning: str = '') -> Programmer:
    """Return the boot loader of the board itself."""
    options: tuple[str, ...] = ('-c', protocol, '-P', port, '-b', str(baud))
    if protocol == 'wiring':
        options += ('-D',)
    return Programmer(f'boot loader ({protocol}, {baud} baud) at {port}', options, False, warning)


QUESTIONS = {
    'boot loader of a Mega': Question(
        115200,
        True,
        0.25,
        _SYNC_V2,
        b'AVRISP_2',
        lambda port: boot_loader(port, 'wiring', 115200, OLD_LOADER),
    ),
    'optiboot': Question(
        115200,
        True,
        0.1,
        b'0 ' * 3,
        b'\x14\x10',
        lambda port: boot_loader(port, 'arduino', 115200),
    ),
    'boot loader of an old Nano': Question(
        57600,
        True,
        0.1,
        b'0 ' * 3,
        b'\x14\x10',
        lambda port: boot_loader(port, 'arduino', 57600, OLD_LOADER),
    ),
    'ArduinoISP': Question(19200, True, 2.5, b'1 ', b'\x14AVR ISP\x10', arduino_as_isp),
}


def usb_programmers(sysfs: Path) -> list[Programmer]:
    """Return the programmers on USB."""
    found = []
    for device in sorted((sysfs / 'bus/usb/devices').glob('*')):
        known = USB_PROGRAMMERS.get(_usb_id(device))
        if known is not None:
            found.append(Programmer(f'{known[1]} (USB {device.name})', ('-c', known[0]), True))
    return found


def serial_ports(sysfs: Path) -> list[str]:
    """Return the serial ports of Arduinos, ``/dev/…``."""
    ports = []
    for tty in sorted((sysfs / 'class/tty').glob('tty[AU]*')):
        device = (tty / 'device').resolve()
        for folder in (device, *list(device.parents)[:3]):
            if _usb_id(folder).split(':')[0] in SERIAL_CHIPS:
                ports.append(f'/dev/{tty.name}')
                break
    return ports


def ask_port(port: str) -> Programmer | None:
    """Return the programmer at a serial port, None if none answers; FlashError if it is closed."""
    if not os.path.exists(port):
        raise FlashError(
            f'{port} does not exist: is the board plugged in? ls -l /dev/serial/by-id'
        )
    if not os.access(port, os.R_OK | os.W_OK):
        raise FlashError(
            f'{port} cannot be opened: permission denied; sudo usermod -aG dialout $USER, log in '
            'again'
        )
    for question in QUESTIONS.values():
        if question.answer in _ask(port, question):
            return question.programmer(port)
    return None


def find_programmer(
    sysfs: Path, port: str | None, ask: Callable[[str], Programmer | None] = ask_port
) -> Programmer:
    """Return the programmer at ``port``, else the only one on USB; FlashError if there is none."""
    if port:
        programmer = ask(port)
        if programmer is None:
            raise FlashError(
                f'no programmer answers at {port}: neither the sketch ArduinoISP nor the boot '
                'loader of a board; is another program using the port?'
            )
        return programmer
    found = usb_programmers(sysfs)
    if not found:
        ports = ', '.join(serial_ports(sysfs)) or 'none is plugged in'
        raise FlashError(
            'no programmer on USB, and no serial port is opened unasked, because that resets the '
            'device behind it: plug in a USBasp, or name the port of the board, or of an Arduino '
            f'with the sketch ArduinoISP: PORT=/dev/… (serial ports: {ports})'
        )
    if len(found) > 1:
        names = '\n  '.join(programmer.name for programmer in found)
        raise FlashError(f'more than one programmer: unplug all but one\n  {names}')
    return found[0]


def command(programmer: Programmer, board: str, file: Path) -> list[str]:
    """Return the avrdude command; it refuses a chip of another type."""
    writes = [*(FUSES if programmer.fuses else ()), f'flash:w:{file}:i']
    options = [word for write in writes for word in ('-U', write)]
    return ['avrdude', *programmer.options, '-p', PARTS[board], *options]


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code: that of avrdude, 2 without a programmer."""
    parser = argparse.ArgumentParser(description='Flash a board.')
    parser.add_argument('board', choices=sorted(PARTS))
    parser.add_argument('file', type=Path)
    parser.add_argument(
        '--port', help='serial port of board or programmer; default: programmers on USB'
    )
    parser.add_argument('--dry-run', action='store_true', help='print the command only')
    parser.add_argument('--sysfs', type=Path, default=Path('/sys'), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    try:
        if not options.dry_run and not options.file.is_file():
            raise FlashError(f'{options.file} does not exist: make -C firmware avr writes it')
        programmer = find_programmer(options.sysfs, options.port or None)
    except FlashError as error:
        print(f'flash: {error}', file=sys.stderr)
        return 2
    words = command(programmer, options.board, options.file)
    print(f'{programmer.name}: {options.board}')
    if programmer.warning:
        print(f'warning: {programmer.warning}')
    print(shlex.join(words), flush=True)
    if options.dry_run:
        return 0
    try:
        return subprocess.run(words).returncode
    except FileNotFoundError:
        print('flash: avrdude is not installed: sudo apt-get install avrdude', file=sys.stderr)
        return 2


def _usb_id(device: Path) -> str:
    try:
        names = ('idVendor', 'idProduct')
        return ':'.join((device / name).read_text().strip() for name in names)
    except OSError:
        return ''


def _ask(port: str, question: Question) -> bytes:
    try:
        handle = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return b''
    try:
        _configure(handle, question.baud)
        if question.reset:
            _reset(handle)
        time.sleep(question.wait)
        termios.tcflush(handle, termios.TCIOFLUSH)
        os.write(handle, question.request)
        return _read(handle, question.answer)
    except OSError:
        return b''
    finally:
        os.close(handle)


def _configure(handle: int, baud: int) -> None:
    speed = getattr(termios, f'B{baud}')
    control = termios.CS8 | termios.CREAD | termios.CLOCAL
    termios.tcsetattr(handle, termios.TCSANOW, [0, 0, control, 0, speed, speed, [0] * 32])


def _reset(handle: int) -> None:
    lines = struct.pack('I', termios.TIOCM_DTR | termios.TIOCM_RTS)
    try:
        fcntl.ioctl(handle, termios.TIOCMBIC, lines)
        time.sleep(0.1)
        fcntl.ioctl(handle, termios.TIOCMBIS, lines)
    except OSError:
        pass  # a pseudo terminal has no such lines


def _read(handle: int, answer: bytes) -> bytes:
    received, end = b'', time.monotonic() + _TIMEOUT
    while answer not in received and (left := end - time.monotonic()) > 0:
        if select.select([handle], [], [], left)[0]:
            received += os.read(handle, 256)
    return received


if __name__ == '__main__':
    sys.exit(main())
