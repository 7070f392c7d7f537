# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Serial port of the dongle; the only module that imports pyserial.

pyserial raises four kinds of errors: ``OSError`` (``SerialException`` is one), ``termios.error``
(not an ``OSError``), ``ValueError`` and ``TypeError`` (use after close). All of them are raised as
:class:`PortError` with a remedy in the text.
"""

from contextlib import suppress
import errno
import os
import termios
from typing import NoReturn

import serial

BAUD_RATE = 500_000
"""Exact on a 16 MHz AVR, and a rate Linux knows."""
_WRITE_TIMEOUT = 0.1
"""s; a whole transaction is on the line within 2 ms"""
_PORT_ERRORS = (OSError, termios.error, ValueError, TypeError)


class PortError(Exception):
    """The port cannot be used; the text says why and what to do."""

    def __init__(self, text: str, absent: bool) -> None:
        super().__init__(text)
        self.absent = absent
        """There is no such device: looking again costs nothing."""


class SerialPort:
    """An open serial port that never blocks for long.

    Parameters
    ----------
    path
        Such as ``/dev/serial/by-id/…``: it stays the same when the dongle is plugged in anew.
    device
        What ought to be there, for the words of errors.

    Raises
    ------
    PortError
        It cannot be opened; an error at any later call closes it first.
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
        self.low_latency = self._ask_for_low_latency()
        """Whether the driver took the request; CDC-ACM needs none, FTDI 16 ms without."""

    def fileno(self) -> int:
        """Return the file descriptor, to wait for bytes with.

        Raises
        ------
        PortError
            The port is closed.
        """
        try:
            return int(self._serial.fileno())
        except _PORT_ERRORS as error:
            self._give_up(error)

    def read(self) -> bytes:
        """Return what has arrived, maybe nothing; raise PortError when the dongle is gone."""
        try:
            # With timeout 0 this takes what is there; the size only bounds it.
            return bytes(self._serial.read(4096))
        except _PORT_ERRORS as error:
            self._give_up(error)

    def write(self, data: bytes) -> None:
        """Send ``data``; raise PortError when it cannot be done at once."""
        try:
            written = self._serial.write(data)
        except _PORT_ERRORS as error:
            self._give_up(error)
        if written != len(data):
            self._give_up(OSError(errno.EIO, f'{written} of {len(data)} bytes written'))

    def close(self) -> None:
        """Close the port; what goes wrong with it no longer matters."""
        with suppress(*_PORT_ERRORS):
            self._serial.close()

    def _ask_for_low_latency(self) -> bool:
        try:
            self._serial.set_low_latency_mode(True)
        except (*_PORT_ERRORS, NotImplementedError):  # only some drivers know it
            return False
        return True

    def _give_up(self, error: Exception) -> NoReturn:
        # At once: while the dead device is held, the dongle comes back under another name.
        self.close()
        raise _describe_error(self._path, self._device, error) from error


def _describe_error(path: str, device: str, error: Exception) -> PortError:
    """Return the error in words, with the remedy."""
    code = getattr(error, 'errno', None)
    if isinstance(error, termios.error) and error.args:
        code = error.args[0]
    if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV) or not os.path.exists(path):
        return PortError(f'{path} is not there: is {device} plugged in?', True)
    if code in (errno.EACCES, errno.EPERM):
        return PortError(
            f'{path} may not be opened: permission denied; sudo usermod -aG dialout $USER, '
            'log in again',
            False,
        )
    if code in (errno.EAGAIN, errno.EBUSY):
        return PortError(
            f'{path} is busy: another program has it open; lsof {path} names it', False
        )
    return PortError(f'{path} failed: {error}', False)
