# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
from t3mpc_ros.nodes.player.player_thread import PlaybackStatus

KEYS = {
    b' ': 'space',
    b'\x1b[A': 'up',
    b'\x1b[B': 'down',
    b'\x1b[C': 'right',
    b'\x1b[D': 'left',
    # The same keys of a terminal in application mode.
    b'\x1bOA': 'up',
    b'\x1bOB': 'down',
    b'\x1bOC': 'right',
    b'\x1bOD': 'left',
    b'+': 'up',
    b'-': 'down',
}


class KeyboardHandler:
    """Calls ``pressed`` with the name of each key, from a thread of its own.

    The terminal echoes nothing and waits for no line; Ctrl-C still is Ctrl-C. It is restored by
    :meth:`close`, and when the process ends without having called it.
    """

    def __init__(self, pressed: Callable[[str], None]) -> None:
        self._pressed = pressed
        self._input = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._input)
        self._waker, self._wake = os.pipe()
        single = termios.tcgetattr(self._input)
        single[3] &= ~(termios.ICANON | termios.ECHO)
        single[6][termios.VMIN], single[6][termios.VTIME] = 1, 0
        atexit.register(self._restore)
        termios.tcsetattr(self._input, termios.TCSADRAIN, single)
        self._thread = threading.Thread(target=self._read, name='keyboard', daemon=True)
        self._thread.start()

    @staticmethod
    def usable() -> bool:
        """Return whether there is a terminal, and this process is the one in front of it."""
        try:
            number = sys.stdin.fileno()
            return os.isatty(number) and os.tcgetpgrp(number) == os.getpgrp()
        except (OSError, ValueError, AttributeError):  # closed, or no terminal at all
            return False

    def close(self) -> None:
        """Stop listening and give the terminal back; again, do nothing."""
        if self._wake >= 0:
            os.write(self._wake, b'.')
            self._thread.join()
            os.close(self._wake)
            os.close(self._waker)
            self._wake = self._waker = -1
            self._restore()
            atexit.unregister(self._restore)

    def _restore(self) -> None:
        # In the background the system would stop the process for touching the terminal.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
        try:
            termios.tcsetattr(self._input, termios.TCSADRAIN, self._before)
        except termios.error:
            return  # the terminal is gone: there is nothing to give back
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTTOU})

    def _read(self) -> None:
        while True:
            ready, _, _ = select.select([self._waker, self._input], [], [])
            if self._waker in ready:
                return
            try:
                read = os.read(self._input, 64)
            except OSError:
                return
            if not read:
                return
            for name in parse_keys(read):
                self._pressed(name)


def parse_keys(read: bytes) -> list[str]:
    """Return the known keys in what a terminal has sent; others are passed over."""
    found = []
    while read:
        key = next((key for key in KEYS if read.startswith(key)), read[:1])
        if key in KEYS:
            found.append(KEYS[key])
        read = read[len(key) :]
    return found


_BAR_WIDTH = 24


class ProgressLine:
    """Writes the same line anew; silent where nobody would see it."""

    def __init__(self, stream: TextIO, begin_ns: int, end_ns: int) -> None:
        self._stream = stream
        self._begin_ns, self._end_ns = begin_ns, end_ns
        self._shown = ''
        self.visible = stream.isatty()

    def show(self, where: PlaybackStatus) -> None:
        """Write where it is."""
        text = format_status(where, self._begin_ns, self._end_ns)
        if self.visible and text != self._shown:
            self._stream.write(f'\r{text}\x1b[K')
            self._stream.flush()
            self._shown = text

    def close(self) -> None:
        """Leave the last line standing."""
        if self._shown:
            self._stream.write('\n')
            self._stream.flush()
            self._shown = ''


def format_status(where: PlaybackStatus, begin_ns: int, end_ns: int) -> str:
    """Return state, place, length, rate and time left in words."""
    length = (end_ns - begin_ns) / NANOSECONDS
    place = (where.stamp_ns - begin_ns) / NANOSECONDS
    filled = round(_BAR_WIDTH * place / length) if length else _BAR_WIDTH
    state = 'finished' if where.finished else 'paused' if where.paused else 'playing'
    loops = f'  lap {where.loops + 1}' if where.loops else ''
    return (
        f'{state:8s} [{"#" * filled:{_BAR_WIDTH}s}] {place:8.2f} / {length:.2f} s  '
        f'x{where.rate:.3g}  {where.remaining_ns / NANOSECONDS:.1f} s left{loops}'
    )
