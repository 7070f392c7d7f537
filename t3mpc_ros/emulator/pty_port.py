# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pseudo-terminal port of the emulator, published under a symbolic link; reads the clock.

The path of the link is constant, like those below /dev/serial/by-id.
"""

from collections.abc import Callable
from contextlib import suppress
import errno
import os
from pathlib import Path
import pty
import select
import time
import tty

from t3mpc_ros.emulator.emulator import Emulator
from t3mpc_ros.geometry.types import NANOSECONDS

_POLL_PERIOD_NS = NANOSECONDS // 50
"""Longest time between two looks at the emulator, and for a client where there is none."""
_MAX_SLEEP = 0.1
"""s: after a longer sleep of this process its time is not made up for."""


class PtyPortError(Exception):
    """The path cannot lead to the emulator; the text says why and what to do."""


class PtyPort:
    """A pseudo terminal and the symbolic link that leads to it.

    Parameters
    ----------
    link
        Where clients look for the port; a symbolic link that is there already is replaced.

    Raises
    ------
    PtyPortError
        Something else is there, or the folder cannot be written to.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self._master: int | None = None
        self._target = ''
        self.open()

    def open(self) -> None:
        """Make a new terminal, and let the path lead to it; the old one hangs up afterwards."""
        before = self._master
        self._master, slave = pty.openpty()
        try:
            # Before anybody can open it: a cooked terminal would echo what the host writes.
            tty.setraw(slave)
            self._target = os.ttyname(slave)
        finally:
            # While we held it open, we could not see a client leave.
            os.close(slave)
        os.set_blocking(self._master, False)
        self._publish()
        if before is not None:
            os.close(before)

    def close(self) -> None:
        """Hang up, and take the path away if it still leads here."""
        with suppress(OSError):
            if os.readlink(self._link) == self._target:
                self._link.unlink()
        if self._master is not None:
            os.close(self._master)
            self._master = None

    def wait(self, seconds: float) -> bytes | None:
        """Return what the client has written, at the latest after so long; None: there is none."""
        if self._master is None:
            time.sleep(seconds)
            return None
        select.select([self._master], [], [], max(seconds, 0.0))
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b''
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            # Nobody has the other end open: the terminal is readable all the time.
            time.sleep(max(seconds, 0.0))
            return None

    def write(self, data: bytes) -> None:
        """Send to the client; what it does not read in time is lost, as on a serial line."""
        if self._master is not None:
            with suppress(BlockingIOError):
                os.write(self._master, data)

    def _publish(self) -> None:
        link = self._link
        try:
            if link.exists() and not link.is_symlink():
                raise PtyPortError(f'{link} is no symbolic link: choose another path, or move it')
            # In one piece: nobody ever finds the path missing.
            new = link.with_name(f'{link.name}.{os.getpid()}')
            new.unlink(missing_ok=True)
            new.symlink_to(self._target)
            new.replace(link)
        except OSError as error:
            raise PtyPortError(f'{link} cannot be made: {error.strerror}') from error


def serve(
    emulator: Emulator,
    port: PtyPort,
    speed: float,
    stopped: Callable[[], bool],
    restarts: bool = False,
    cable: PtyPort | None = None,
    look: Callable[[], None] = lambda: None,
) -> None:
    """Let the emulator run on the wall clock until ``stopped()``.

    Parameters
    ----------
    emulator
        Its time goes on from where it is.
    port
        Where the host is.
    speed
        Seconds of the emulator in a second.
    stopped
        Asked 50 times a second at least.
    restarts
        Opening a port restarts its board, as DTR does with many.
    cable
        Where the robot's own USB is, if anywhere.
    look
        Called whenever the emulator has moved on.
    """
    now_ns, clock = emulator.now_ns, time.monotonic()
    name, there, connected = emulator.port_name, emulator.port_open, False
    robot = None if cable is None else _ConsolePort(emulator, cable, restarts)
    while not stopped():
        next_ns = emulator.next_ns
        until_ns = (
            now_ns + _POLL_PERIOD_NS if next_ns is None else min(next_ns, now_ns + _POLL_PERIOD_NS)
        )
        received = port.wait(max(until_ns - now_ns, 0) / NANOSECONDS / speed)
        passed = time.monotonic() - clock
        clock += passed
        now_ns += round(min(passed, _MAX_SLEEP) * speed * NANOSECONDS)
        if received is not None and not connected and restarts:
            emulator.restart_dongle()
        connected = received is not None
        # What is due came before what has just arrived.
        arrived = emulator.run_to(now_ns)
        if received:
            emulator.feed(received, now_ns)
        if connected:
            for _, data in arrived:
                port.write(data)
        if robot is not None:
            robot.look(now_ns)
        look()
        if emulator.port_open != there:
            there = emulator.port_open
            port.open() if there else port.close()
        if emulator.port_name != name:
            name = emulator.port_name
            port.open()


class _ConsolePort:
    """The USB of the robot, looked at whenever the dongle's is: 50 times a second at least."""

    def __init__(self, emulator: Emulator, port: PtyPort, restarts: bool) -> None:
        self._emulator = emulator
        self._port = port
        self._restarts = restarts
        self._connected = False

    def look(self, now_ns: int) -> None:
        received = self._port.wait(0.0)
        if received is not None and not self._connected and self._restarts:
            self._emulator.restart_robot()
        self._connected = received is not None
        if received:
            self._emulator.feed_console(received, now_ns)
        for _, data in self._emulator.take_console():
            if self._connected:
                self._port.write(data)
