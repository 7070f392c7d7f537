# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recent samples, facts and events of a run, for any number of readers in other threads."""

from collections import deque
from collections.abc import Mapping, Sequence
from itertools import takewhile
import math
from threading import Lock
from typing import NamedTuple

Json = None | bool | int | float | str | Sequence['Json'] | Mapping[str, 'Json']

SPAN = 120.0
"""Time for which the samples of a live run are kept, s."""
MAX_EVENTS = 500
"""Number of events that are kept."""
STEP = 0.019
"""Least time between two samples that a page is shown, s: every second one at 100 Hz."""


class Sample(NamedTuple):
    """Values of a stream at an instant."""

    number: int
    """Number of the change."""
    time: float
    """s"""
    values: tuple[float | None, ...]
    """None for a value that is not finite: JSON has no other word for it."""


class LiveData:
    """Collects what happens in a run; each reader asks for what is new to it.

    Every change has a number, ascending from 1. A reader remembers the number up to which it has
    read, its *cursor*; a new reader begins with 0 and gets all that is kept. Samples are kept for
    ``span`` s; those less than ``step`` s after the one before are left out.
    """

    def __init__(self, span: float = SPAN, step: float = 0.0) -> None:
        self._span, self._step = span, step
        self._lock = Lock()
        self._number = 0
        self._streams: dict[str, deque[Sample]] = {}
        self._facts: dict[str, tuple[int, Json]] = {}
        self._events: deque[tuple[int, Json]] = deque(maxlen=MAX_EVENTS)

    def add(self, stream: str, time: float, values: Sequence[float]) -> None:
        """Add a sample; what is older than the span, or newer than this sample, is dropped.

        Time goes back when a bag is played again, or a robot starts anew.
        """
        finite = tuple(float(value) if math.isfinite(value) else None for value in values)
        with self._lock:
            kept = self._streams.setdefault(stream, deque())
            if kept and 0.0 <= time - kept[-1].time < self._step:
                return
            if kept and kept[-1].time > time:
                kept.clear()
            while kept and kept[0].time < time - self._span:
                kept.popleft()
            kept.append(Sample(self._next(), time, finite))

    def set(self, fact: str, value: Json) -> None:
        """Set a fact; readers get it if it has changed."""
        with self._lock:
            if fact not in self._facts or self._facts[fact][1] != value:
                self._facts[fact] = self._next(), value

    def report(self, time: float, kind: str, text: str) -> None:
        """Add an event: ``switch``, ``fault``, ``stop``, ``command`` or ``note``, in one line."""
        with self._lock:
            self._events.append((self._next(), {'time': time, 'kind': kind, 'text': text}))

    def read(self, cursor: int) -> tuple[Mapping[str, Json], int]:
        """Return what has changed since the cursor, as JSON values, and the new cursor.

        The keys are ``streams`` (for each its times and columns), ``facts`` and ``events``; one
        without content is left out.
        """
        with self._lock:
            streams = {
                name: _columns(new[::-1])
                for name, kept in self._streams.items()
                if (new := list(takewhile(lambda each: each.number > cursor, reversed(kept))))
            }
            facts = {
                name: value for name, (number, value) in self._facts.items() if number > cursor
            }
            events = [value for number, value in self._events if number > cursor]
            found: dict[str, Json] = {'streams': streams, 'facts': facts, 'events': events}
            return {name: value for name, value in found.items() if value}, self._number

    def _next(self) -> int:
        self._number += 1
        return self._number


def _columns(samples: Sequence[Sample]) -> Json:
    values = zip(*(sample.values for sample in samples), strict=True)
    return {'time': [sample.time for sample in samples], 'values': [list(each) for each in values]}
