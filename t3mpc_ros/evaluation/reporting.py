# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Shared parts of reports: table, number format and progress line."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
import json
import math
import sys
from typing import TextIO


class Progress:
    """Prints the number of finished runs and the time left; the last line stays.

    Parameters
    ----------
    clock
        Seconds from any origin.
    stream
        A terminal gets one line that is rewritten, anything else a line at intervals; standard
        error when None.
    """

    def __init__(self, clock: Callable[[], float], stream: TextIO | None = None) -> None:
        self._clock = clock
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._last = 0.0
        self._total = 0
        self._marks = [(0, 0.0)]

    def write(self, text: str) -> None:
        """Write a line."""
        print(text, file=self._stream, flush=True)

    def begin(self, total: int) -> None:
        """Start counting ``total`` runs."""
        self._total = total
        self._last = self._clock()
        self._marks = [(0, self._last)]

    def done(self, count: int) -> None:
        """Report that ``count`` runs are finished; print when due."""
        now = self._clock()
        self._marks.append((count, now))
        pause = 0.5 if self._live else 15.0
        if now - self._last < pause and count < self._total:
            return
        self._last = now
        left = self._pace() * (self._total - count)
        text = f'  {count} of {self._total} runs, {100 * count // self._total} %'
        text += f', {format_duration(left)} left' if count < self._total else ', done in '
        text += '' if count < self._total else format_duration(now - self._marks[0][1])
        end = '' if self._live and count < self._total else '\n'
        begin = '\r\x1b[K' if self._live else ''
        print(f'{begin}{text}', end=end, file=self._stream, flush=True)

    def _pace(self) -> float:
        """Return seconds per run over the later half of the runs: the first ones compile."""
        count, now = self._marks[-1]
        earlier, then = self._marks[bisect_right(self._marks, (count // 2, math.inf)) - 1]
        return (now - then) / (count - earlier)

    def broken_off(self) -> None:
        """End the rewritten line."""
        if self._live:
            print(file=self._stream, flush=True)


def strict_json(content: object) -> str:
    """Return JSON that every reader accepts: null for numbers that are not finite."""
    return json.dumps(_finite(content), indent=1, ensure_ascii=False, allow_nan=False) + '\n'


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def format_duration(seconds: float) -> str:
    """Return a duration as text, rounded up to whole seconds."""
    whole = int(-(-seconds // 1))
    if whole < 60:
        return f'{whole} s'
    if whole < 3600:
        return f'{whole // 60} min {whole % 60:02d} s'
    return f'{whole // 3600} h {whole % 3600 // 60:02d} min'


@dataclass(frozen=True, slots=True)
class Table:
    """A table of words under a title; its first column names the rows."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bold: tuple[str, ...] = ()
    """Names of highlighted rows."""

    def markdown(self) -> str:
        """Return the table with its title in Markdown."""
        lines = [f'**{self.title}**', '', _line(self.head), '|---' * len(self.head) + '|']
        for name, *cells in self.rows:
            lines.append(_line([f'**{name}**' if name in self.bold else name, *cells]))
        return '\n'.join(lines)

    def html(self) -> str:
        """Return the table with its title as HTML."""
        head = ''.join(f'<th>{escape(word)}</th>' for word in self.head)
        body = ''.join(
            f'<tr{" class=own" if row[0] in self.bold else ""}>'
            + ''.join(f'<td>{escape(cell)}</td>' for cell in row)
            + '</tr>\n'
            for row in self.rows
        )
        caption = f'<caption>{escape(self.title)}</caption>'
        return f'<div class="wide"><table>{caption}<tr>{head}</tr>\n{body}</table></div>'


def format_interval(mean: float, ci95: float, sign: str = '', digits: int = 3) -> str:
    """Return a mean ± half its 95 % interval; a single seed has no interval."""
    if not math.isfinite(mean):
        return 'diverged'
    text = f'{mean:{sign}.{digits}f}'
    return f'{text} ± {ci95:.{digits}f}' if math.isfinite(ci95) else text


EMPTY_CELL = '–'


def _line(cells: Sequence[str]) -> str:
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'
