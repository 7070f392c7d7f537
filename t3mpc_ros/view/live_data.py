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
"""Recent samples, facts and events of a run, for any number of readers in other threads."""

from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
import math
from threading import Lock
from typing import NamedTuple

Json = None | bool | int | float | str | Sequence['Json'] | Mapping[str, 'Json']

SPAN = 600.0
"""Time for which the samples of a live run are kept, s."""
MAX_EVENTS = 500
"""Number of events that are kept."""
STEP = 0.019
"""Least time between two samples that a page is shown, s: every second one at 100 Hz."""
DISORDER = 0.5
"""Time by which samples may arrive out of order, s: those without a stamp are timed by others."""
MAX_CHANGES = 5000
"""Samples and events that one answer holds at most: a page that opens must not stop a loop."""
DIGITS = 5
"""Decimals of the values and times of samples that a reader gets."""


class Cursor(NamedTuple):
    """How far a reader has read; a new one has read nothing."""

    change: int = 0
    """Number of the newest sample or event."""
    fact: int = 0
    """Number of the newest change of a fact."""


class LiveData:
    """Collects what happens in a run; each reader asks for what is new to it.

    Every change has a number, ascending from 1. A reader remembers the numbers up to which it has
    read, its *cursor*; a new reader gets all that is kept. Samples are kept for ``span`` s; those
    less than ``step`` s after the one before are left out.
    """

    def __init__(self, span: float = SPAN, step: float = 0.0) -> None:
        self._span, self._step = span, step
        self._lock = Lock()
        self._number = self._fact_number = 0
        self._streams: dict[str, _Stream] = {}
        self._facts: dict[str, tuple[int, Json]] = {}
        self._events: deque[tuple[int, Json]] = deque(maxlen=MAX_EVENTS)

    def add(self, stream: str, time: float, values: Sequence[float]) -> None:
        """Add a sample; what is older than the span, or newer than this sample, is dropped.

        Time goes back when a bag is played again, or a robot starts anew; a sample that is late
        by less than :data:`DISORDER` is left out.
        """
        with self._lock:
            kept = self._streams.get(stream)
            since = time - kept.times[-1] if kept else -math.inf
            if -DISORDER < since < self._step:
                return
            if kept is None or since < 0.0:
                kept = self._streams[stream] = _Stream(len(values))
            kept.drop_before(time - self._span)
            self._number += 1
            kept.append(self._number, time, values)

    def set(self, fact: str, value: Json) -> None:
        """Set a fact; readers get it if it has changed."""
        with self._lock:
            if fact not in self._facts or self._facts[fact][1] != value:
                self._fact_number += 1
                self._facts[fact] = self._fact_number, value

    def report(self, time: float, kind: str, text: str) -> None:
        """Add an event in one line.

        Its kind is ``switch``, ``fault``, ``slip``, ``stop``, ``resume`` (the end of a stop),
        ``parameter``, ``command`` or ``note``; of a recording also ``stall``, ``gap`` or ``jump``.
        """
        with self._lock:
            self._number += 1
            self._events.append((self._number, {'time': time, 'kind': kind, 'text': text}))

    def newest(self) -> Cursor:
        """Return the cursor of a reader who has read everything."""
        with self._lock:
            return Cursor(self._number, self._fact_number)

    def read(self, cursor: Cursor) -> tuple[dict[str, Json], Cursor]:
        """Return what has changed since the cursor, as JSON values, and the new cursor.

        The keys are ``streams`` (for each its times and columns), ``facts`` and ``events``; one
        without content is left out. ``more`` is true if a further answer has the rest.
        """
        with self._lock:
            oldest = [kept.numbers[kept.first] for kept in self._streams.values()]
            oldest += [self._events[0][0]] if self._events else []
            begin = max(cursor.change, min(oldest, default=1) - 1)
            end = min(self._number, begin + MAX_CHANGES)
            streams = {
                name: columns
                for name, kept in self._streams.items()
                if (columns := kept.between(begin, end))
            }
            facts = {
                name: value
                for name, (number, value) in self._facts.items()
                if number > cursor.fact
            }
            events = [value for number, value in self._events if begin < number <= end]
            found: dict[str, Json] = {'streams': streams, 'facts': facts, 'events': events}
            found['more'] = end < self._number
            return (
                {name: value for name, value in found.items() if value},
                Cursor(end, self._fact_number),
            )


class _Stream:
    """Samples in the order of their numbers; rows before ``first`` are dropped.

    Arrays: as tuples of Python's numbers, ten minutes would take 70 MB. A value that is not
    finite is NaN, and read as None: JSON has no other word for it.
    """

    def __init__(self, width: int) -> None:
        self.numbers = array('q')
        self.times = array('d')
        self._columns = [array('d') for _ in range(width)]
        self.first = 0

    def append(self, number: int, time: float, values: Sequence[float]) -> None:
        self.numbers.append(number)
        self.times.append(time)
        for column, value in zip(self._columns, values, strict=True):
            column.append(value)

    def drop_before(self, time: float) -> None:
        """Drop what is older, but for one sample."""
        last = len(self.times) - 1
        while self.first < last and self.times[self.first] < time:
            self.first += 1
        if self.first > max(1000, last - self.first):
            del self.numbers[: self.first]
            for column in (self.times, *self._columns):
                del column[: self.first]
            self.first = 0

    def between(self, begin: int, end: int) -> Json:
        """Return times and columns of the samples after number ``begin``, up to ``end``."""
        rows = slice(
            bisect_right(self.numbers, begin, self.first),
            bisect_right(self.numbers, end, self.first),
        )
        if rows.start == rows.stop:
            return None
        return {
            'time': [round(each, DIGITS) for each in self.times[rows]],
            'values': [
                [round(each, DIGITS) if math.isfinite(each) else None for each in column[rows]]
                for column in self._columns
            ],
        }
