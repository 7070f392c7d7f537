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
_CONSOLE_POLL_PERIOD_NS = NANOSECONDS // 1000
"""Longest time between two updates of the emulator, and between two checks for a client."""
_MAX_SLEEP = 0.1  # longest interruption of the process that virtual time catches up with, s


class PtyPortError(Exception):
    """The symbolic link cannot be made; the text contains the reason and the remedy."""


class PtyPort:
    """A pseudo-terminal and the symbolic link to it.

    An existing symbolic link is replaced; PtyPortError: the path is something else, or its
    folder is not writable.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self._master: int | None = None
        self._target = ''
        self.open()

    def open(self) -> None:
        """Open a new pseudo-terminal, redirect the link, then hang up the old one."""
        before = self._master
        self._master, slave = pty.openpty()
        try:
            # Before a client can open it: a cooked terminal echoes the input of the client.
            tty.setraw(slave)
            self._target = os.ttyname(slave)
        finally:
            # An open slave end would hide that a client closes its own.
            os.close(slave)
        os.set_blocking(self._master, False)
        self._publish()
        if before is not None:
            os.close(before)

    def close(self) -> None:
        """Hang up, and remove the link if it still leads to this terminal."""
        with suppress(OSError):
            if os.readlink(self._link) == self._target:
                self._link.unlink()
        if self._master is not None:
            os.close(self._master)
            self._master = None

    def wait(self, seconds: float) -> bytes | None:
        """Wait for input; return it, empty on timeout, None if there is no client."""
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
            # EIO: the slave end is closed, and the terminal is always readable.
            time.sleep(max(seconds, 0.0))
            return None

    def write(self, data: bytes) -> None:
        """Send to the client; data beyond the buffer are lost, as on a serial line."""
        if self._master is not None:
            with suppress(BlockingIOError):
                os.write(self._master, data)

    def _publish(self) -> None:
        link = self._link
        try:
            if link.exists() and not link.is_symlink():
                raise PtyPortError(f'{link} is no symbolic link: choose another path, or move it')
            # Atomic: the path exists at any time.
            new = link.with_name(f'{link.name}.{os.getpid()}')
            new.unlink(missing_ok=True)
            new.symlink_to(self._target)
            new.replace(link)
        except OSError as error:
            raise PtyPortError(f'{link} cannot be made: {error.strerror}') from error


def serve(
    emulator: Emulator,
    port: PtyPort,
    real_time_factor: float,
    stopped: Callable[[], bool],
    restart_on_open: bool = False,
    console_port: PtyPort | None = None,
    on_update: Callable[[], None] = lambda: None,
) -> None:
    """Run the emulator on the wall clock until ``stopped()`` is true.

    ``stopped`` is polled at least 50 times a second, ``on_update`` called after each update.
    ``restart_on_open``: opening a port reboots its board, as DTR does on most.
    """
    now_ns, clock = emulator.now_ns, time.monotonic()
    number, plugged_in, connected = emulator.port_number, emulator.port_open, False
    console = None
    if console_port is not None:
        console = _ConsolePort(emulator, console_port, restart_on_open)
    while not stopped():
        next_ns = emulator.next_ns
        until_ns = now_ns + _POLL_PERIOD_NS
        if console is not None and console.connected:
            until_ns = now_ns + _CONSOLE_POLL_PERIOD_NS  # a host may drive over it
        if next_ns is not None:
            until_ns = min(next_ns, until_ns)
        received = port.wait(max(until_ns - now_ns, 0) / NANOSECONDS / real_time_factor)
        elapsed = time.monotonic() - clock
        clock += elapsed
        now_ns += round(min(elapsed, _MAX_SLEEP) * real_time_factor * NANOSECONDS)
        if received is not None and not connected and restart_on_open:
            emulator.restart_dongle()
        connected = received is not None
        # Events that are due precede the input that has just arrived.
        replies = emulator.run_to(now_ns)
        if received:
            emulator.feed(received, now_ns)
        if connected:
            for _, data in replies:
                port.write(data)
        if console is not None:
            console.update(now_ns)
        on_update()
        if emulator.port_open != plugged_in:
            plugged_in = emulator.port_open
            port.open() if plugged_in else port.close()
        if emulator.port_number != number:
            number = emulator.port_number
            port.open()


class _ConsolePort:
    """USB port of the robot board, updated together with that of the dongle."""

    def __init__(self, emulator: Emulator, port: PtyPort, restart_on_open: bool) -> None:
        self._emulator = emulator
        self._port = port
        self._restart_on_open = restart_on_open
        self.connected = False  # whether a client has the port open

    def update(self, now_ns: int) -> None:
        received = self._port.wait(0.0)
        if received is not None and not self.connected and self._restart_on_open:
            self._emulator.restart_robot()
        self.connected = received is not None
        if received:
            self._emulator.feed_console(received, now_ns)
        for _, data in self._emulator.take_console():
            if self.connected:
                self._port.write(data)
