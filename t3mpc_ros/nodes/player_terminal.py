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
"""Keyboard control and progress line of the player."""

import atexit
from collections.abc import Callable
import os
import select
import signal
import sys
import termios
import threading
from typing import TextIO

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.player_publishers import PlaybackStatus

BAR_WIDTH = 24
"""Width of the progress bar, characters."""

KEYS = {
    b' ': 'space',
    b'\x1b[A': 'up',
    b'\x1b[B': 'down',
    b'\x1b[C': 'right',
    b'\x1b[D': 'left',
    # The same keys in the application mode of a terminal.
    b'\x1bOA': 'up',
    b'\x1bOB': 'down',
    b'\x1bOC': 'right',
    b'\x1bOD': 'left',
    b'+': 'up',
    b'-': 'down',
}


class KeyboardHandler:
    """Calls ``pressed`` with the name of each key, from a thread of its own.

    The terminal is in non-canonical mode without echo; Ctrl-C keeps its meaning. :meth:`close`
    restores the terminal, and so does the end of the process.
    """

    def __init__(self, pressed: Callable[[str], None]) -> None:
        self._pressed = pressed
        self._input = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._input)
        self._wake_read, self._wake_write = os.pipe()
        attributes = termios.tcgetattr(self._input)
        attributes[3] &= ~(termios.ICANON | termios.ECHO)
        attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
        atexit.register(self._restore)
        termios.tcsetattr(self._input, termios.TCSADRAIN, attributes)
        self._thread = threading.Thread(target=self._read, name='keyboard', daemon=True)
        self._thread.start()

    @staticmethod
    def usable() -> bool:
        """Return whether standard input is a terminal with this process in the foreground."""
        try:
            number = sys.stdin.fileno()
            return os.isatty(number) and os.tcgetpgrp(number) == os.getpgrp()
        except (OSError, ValueError, AttributeError):  # closed, or no terminal
            return False

    def close(self) -> None:
        """Stop reading keys and restore the terminal; idempotent."""
        if self._wake_write >= 0:
            os.write(self._wake_write, b'.')
            self._thread.join()
            os.close(self._wake_write)
            os.close(self._wake_read)
            self._wake_write = self._wake_read = -1
            self._restore()
            atexit.unregister(self._restore)

    def _restore(self) -> None:
        # SIGTTOU would stop a background process that sets the terminal.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
        try:
            termios.tcsetattr(self._input, termios.TCSADRAIN, self._before)
        except termios.error:
            return  # the terminal is closed
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTTOU})

    def _read(self) -> None:
        while True:
            ready, _, _ = select.select([self._wake_read, self._input], [], [])
            if self._wake_read in ready:
                return
            try:
                data = os.read(self._input, 64)
            except OSError:
                return
            if not data:
                return
            for name in parse_keys(data):
                self._pressed(name)


def parse_keys(data: bytes) -> list[str]:
    """Return the names of the known keys in the input of a terminal; others are ignored."""
    found = []
    while data:
        key = next((key for key in KEYS if data.startswith(key)), data[:1])
        if key in KEYS:
            found.append(KEYS[key])
        data = data[len(key) :]
    return found


class ProgressLine:
    """Shows the status of the playback in one line of a terminal; silent without a terminal."""

    def __init__(self, stream: TextIO, begin_ns: int, end_ns: int) -> None:
        self._stream = stream
        self._is_terminal = stream.isatty()
        self._begin_ns = begin_ns
        self._length = (end_ns - begin_ns) / NANOSECONDS
        self._shown = ''

    def show(self, status: PlaybackStatus) -> None:
        """Write the status in place of the former one."""
        text = self._text(status)
        if text != self._shown and self._is_terminal:
            self._stream.write(f'\r{text}\x1b[K')
            self._stream.flush()
            self._shown = text

    def close(self) -> None:
        """End the line."""
        if self._shown:
            self._stream.write('\n')
            self._stream.flush()
            self._shown = ''

    def _text(self, status: PlaybackStatus) -> str:
        """Return state, progress bar, position, length, rate, remaining time and loop."""
        position = (status.stamp_ns - self._begin_ns) / NANOSECONDS
        filled = round(BAR_WIDTH * position / self._length) if self._length else BAR_WIDTH
        bar = f'{"#" * filled:{BAR_WIDTH}s}'
        loop = f'  loop {status.loops + 1}' if status.loops else ''
        return (
            f'{status.state:8s} [{bar}] {position:8.2f} / {self._length:.2f} s  '
            f'x{status.rate:.3g}  {status.remaining_ns / NANOSECONDS:.1f} s left{loop}'
        )
