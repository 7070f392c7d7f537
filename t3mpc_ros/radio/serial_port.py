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
"""Serial port of the dongle; the only module that imports pyserial.

pyserial raises four kinds of errors: ``OSError`` (``SerialException`` is one), ``termios.error``
(not an ``OSError``), ``ValueError`` and ``TypeError`` (use after close). All of them are raised as
:class:`PortError` with a remedy in the text.
"""

from contextlib import suppress
import errno
import glob
import os
import stat
import termios
from typing import NoReturn

import serial

BAUD_RATE = 500_000  # exact on a 16 MHz AVR, and a standard rate of Linux
_WRITE_TIMEOUT = 0.1  # s; a complete transaction takes 2 ms on the line
_PORT_ERRORS = (OSError, termios.error, ValueError, TypeError)


def find_ports(pattern: str) -> list[str]:
    """Return the devices of a path or pattern, each once; the pattern itself if there are none."""
    found = {os.path.realpath(path): path for path in sorted(glob.glob(pattern), reverse=True)}
    return sorted(found.values()) or [pattern]


class PortError(Exception):
    """The port cannot be used; the text contains the reason and the remedy."""

    def __init__(self, text: str, absent: bool) -> None:
        super().__init__(text)
        self.absent = absent  # whether the device does not exist, so that retries are cheap


class SerialPort:
    """An open serial port with short timeouts.

    ``device`` is its name in error texts. PortError: it cannot be opened; later methods close
    it before they raise.
    """

    def __init__(self, path: str, device: str = 'the dongle') -> None:
        self._path = path
        self._device = device
        try:
            self._serial = serial.Serial(
                path, BAUD_RATE, timeout=0, write_timeout=_WRITE_TIMEOUT, exclusive=True
            )
        except _PORT_ERRORS as error:
            raise _describe_error(path, device, error) from error
        self.low_latency = self._set_low_latency()
        """Whether the driver has a low-latency mode; FTDI needs it, CDC-ACM does not."""

    def fileno(self) -> int:
        """Return the file descriptor, for ``select``."""
        try:
            return int(self._serial.fileno())
        except _PORT_ERRORS as error:
            self._fail(error)

    def read(self) -> bytes:
        """Return the received bytes, possibly none; raise PortError if the device is gone."""
        try:
            # With timeout 0 this returns the available bytes, at most 4096.
            return bytes(self._serial.read(4096))
        except _PORT_ERRORS as error:
            self._fail(error)

    def write(self, data: bytes) -> None:
        """Write ``data``; raise PortError if that fails or blocks."""
        try:
            written = self._serial.write(data)
        except _PORT_ERRORS as error:
            self._fail(error)
        if written != len(data):
            self._fail(OSError(errno.EIO, f'{written} of {len(data)} bytes written'))

    def close(self) -> None:
        """Close the port, ignoring errors."""
        with suppress(*_PORT_ERRORS):
            self._serial.close()

    def _set_low_latency(self) -> bool:
        try:
            self._serial.set_low_latency_mode(True)
        except (*_PORT_ERRORS, NotImplementedError):  # only some drivers support it
            return False
        return True

    def _fail(self, error: Exception) -> NoReturn:
        # Immediately: while the dead device is open, the dongle reappears under another name.
        self.close()
        raise _describe_error(self._path, self._device, error) from error


def _describe_error(path: str, device: str, error: Exception) -> PortError:
    """Return the error as PortError with a remedy."""
    code = getattr(error, 'errno', None)
    if isinstance(error, termios.error) and error.args:
        code = error.args[0]
    if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV) or not os.path.exists(path):
        return PortError(f'{path} does not exist: is {device} plugged in?', True)
    if code in (errno.EACCES, errno.EPERM):
        return PortError(
            f'{path} cannot be opened: permission denied; sudo usermod -aG dialout $USER, '
            'log in again',
            False,
        )
    if code in (errno.EAGAIN, errno.EBUSY):
        return PortError(
            f'{path} is busy: another program has it open; lsof {path} names it', False
        )
    if not stat.S_ISCHR(os.stat(path).st_mode):
        return PortError(f'{path} is no serial port: ls -l /dev/serial/by-id lists them', False)
    return PortError(f'{path} failed: {error}', False)
