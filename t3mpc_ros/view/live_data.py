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
"""Data of a run for its page: recent samples, facts and events, and the banner of a live run."""

from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
import math
from threading import Lock
from typing import Literal, NamedTuple

Json = None | bool | int | float | str | Sequence['Json'] | Mapping[str, 'Json']

SPAN = 600.0
"""Time for which the samples of a live run are kept, s."""
MAX_EVENTS = 500
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


# -- a run in real time ---------------------------------------------------------------------------


Condition = Literal['normal', 'warning', 'stopped']

LOST = 1.5
"""Time without odometry after which the connection counts as lost, s."""
ROBOTS = ('sim_robot', 'radio_bridge')
ESTOP = 'emergency stop'
"""Begin of the reason of a robot whose e-stop is latched."""


class NodeReport(NamedTuple):
    """Newest report of a node about itself, from its log or its diagnostics."""

    text: str
    condition: Condition = 'normal'


PAUSED = NodeReport('paused')
"""Report of a reference generator that was paused."""
LOST_REMEDY = (
    'what is shown is old, and a stop may not reach the robot: use the switch on the robot, then '
    'check that sim_robot or radio_bridge runs and is connected'
)


class Banner(NamedTuple):
    """One line in large letters, and the reason for it."""

    kind: Literal['good', 'warning', 'stopped', 'lost']
    headline: str
    detail: str

    def cause(self) -> tuple[str, str]:
        """Return the headline and the first reason."""
        return self.headline, self.detail.partition('; ')[0]


def banner(
    reports: Mapping[str, NodeReport], odometry_age: float | None, others: Sequence[str] = ()
) -> Banner:
    """Return what a person has to know first.

    ``reports`` are the newest ones of the nodes; ``odometry_age`` is the time since the last
    odometry, s, None before the first one; ``others`` are namespaces of other robots. The reason
    of the robot stands before those of the other nodes: theirs often follow from it.
    """
    order = sorted(reports, key=lambda name: name not in ROBOTS)
    worse = {name: reports[name] for name in order if reports[name].condition != 'normal'}
    stops = {name: each for name, each in worse.items() if each.condition == 'stopped'}
    detail = '; '.join(f'{name}: {each.text}' for name, each in (stops or worse).items())
    if odometry_age is None:
        reason = detail or 'no odometry on the graph yet'
        if others:
            reason += f'; robots of other namespaces: {", ".join(others)} (t3mpc view --namespace)'
        return Banner('lost', 'Waiting for a robot', reason)
    if odometry_age > LOST:
        silence = f'no odometry for {odometry_age:.0f} s'
        return Banner('lost', 'Connection lost', f'{silence}: {detail or LOST_REMEDY}')
    if any(each.text.startswith(ESTOP) for each in stops.values()):
        return Banner('stopped', 'E-STOP', detail)
    if reports.get('reference_generator') == PAUSED:
        return Banner('warning', 'Reference paused', detail)
    if stops:
        return Banner('stopped', 'Stopped', detail)
    if worse:
        return Banner('warning', 'Driving, with a warning', detail)
    if 'controller' in reports:
        return Banner('good', 'Tracking the reference', '')
    return Banner('good', 'Following commands' if reports else 'Receiving odometry', '')


ODOMETRY = 'odometry'
"""Stream whose samples show that a robot is connected."""
MAX_AGE = 3.0
"""Age of a command up to which it is executed, s."""
STOPS = (('e_stop', True), ('enable', False), ('pause', True))
"""Commands that stop the robot, each with the value of its ``on``."""


class LiveRun(LiveData):
    """LiveData of a run in real time; the facts include the banner.

    Time of samples is that of the messages; the connection is judged by the time of their
    arrival, because clocks of other machines differ.
    """

    def __init__(self) -> None:
        super().__init__(step=STEP)
        self.set('span', SPAN)
        self._reports: dict[str, NodeReport] = {}
        self._odometry_pending = False
        self._last_odometry: float | None = None
        self._time = 0.0
        self._banner: Banner | None = None
        self._newest_stop = -math.inf
        self._others: Sequence[str] = ()

    def add(self, stream: str, time: float, values: Sequence[float]) -> None:
        """Add a sample."""
        super().add(stream, time, values)
        if stream == ODOMETRY:
            self._odometry_pending, self._time = True, time

    def node_report(self, name: str, text: str, condition: Condition) -> None:
        """Replace the newest report of a node."""
        self._reports[name] = NodeReport(text, condition)

    def node_gone(self, name: str) -> None:
        """Discard the report of a node that has left the graph."""
        self._reports.pop(name, None)

    def other_robots(self, namespaces: Sequence[str]) -> None:
        """Replace the namespaces of other robots."""
        self._others = namespaces

    def is_latched(self) -> bool:
        """Return whether the robot stands by its emergency stop."""
        return any(
            self._reports[name].text.startswith(ESTOP) for name in {*ROBOTS} & {*self._reports}
        )

    def tick(self, now: float) -> None:
        """Update the banner at steady time ``now`` (s); call it several times a second."""
        if self._odometry_pending:
            self._odometry_pending, self._last_odometry = False, now
        age = None if self._last_odometry is None else now - self._last_odometry
        shown = banner(self._reports, age, self._others)
        if shown == self._banner:
            return
        previous, self._banner = self._banner, shown
        self.set('banner', shown._asdict())
        if previous is None or shown.kind == previous.kind == 'lost':
            return
        if shown.kind in ('stopped', 'lost'):
            if shown.cause() == previous.cause():
                return  # what follows from a stop comes later: it is no other stop
            reason = f': {shown.detail}' if shown.detail else ''
            self.report(self._time, 'stop', f'{shown.headline}{reason}')
        elif previous.kind in ('stopped', 'lost'):
            self.report(self._time, 'resume', shown.headline)

    def refusal(self, name: str, on: object, asked: float, now: float) -> str:
        """Return why a command is not to be executed; '' for one that is.

        ``asked`` is the time of the click and ``now`` the present one on the same clock, s. While
        the program is suspended or the network stalls, clicks wait, and then arrive together and
        in any order. A stop is executed whenever it arrives. Anything else is executed only while
        it is recent, and never if it was asked for before the newest stop: a release that waited
        must not undo the stop that a person asked for after it.
        """
        if (name, on) in STOPS:
            self._newest_stop = max(self._newest_stop, min(asked, now))
            return ''
        if not now - MAX_AGE <= asked <= now + MAX_AGE:
            return (
                f'{name} was asked for more than {MAX_AGE:g} s ago and is not executed: ask again'
            )
        if asked <= self._newest_stop:
            return f'{name} was asked for before the last stop and is not executed: ask again'
        return ''
