# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One line of a terminal that says how far the bag has come."""

from typing import TextIO

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.nodes.replaying.sender import Where

_BAR = 24


class ProgressLine:
    """Writes the same line anew; silent where nobody would see it."""

    def __init__(self, stream: TextIO, begin_ns: int, end_ns: int) -> None:
        self._stream = stream
        self._begin_ns, self._end_ns = begin_ns, end_ns
        self._shown = ''
        self.visible = stream.isatty()

    def show(self, where: Where) -> None:
        """Write where it is."""
        text = line(where, self._begin_ns, self._end_ns)
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


def line(where: Where, begin_ns: int, end_ns: int) -> str:
    """Return state, place, length, rate and time left in words."""
    length = (end_ns - begin_ns) / NANOSECONDS
    place = (where.stamp_ns - begin_ns) / NANOSECONDS
    filled = round(_BAR * place / length) if length else _BAR
    state = 'finished' if where.finished else 'paused' if where.paused else 'playing'
    laps = f'  lap {where.laps + 1}' if where.laps else ''
    return (
        f'{state:8s} [{"#" * filled:{_BAR}s}] {place:8.2f} / {length:.2f} s  '
        f'x{where.rate:.3g}  {where.left_ns / NANOSECONDS:.1f} s left{laps}'
    )
