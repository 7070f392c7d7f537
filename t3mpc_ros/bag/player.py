# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Playback in virtual time: due messages under pause, rate, seek, step and loop; read-ahead and latency statistics."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import math
import queue
import threading
from typing import Generic, NamedTuple, Self, TypeVar

from t3mpc_ros.bag.merged_reader import (
    MergedReader,
    ScheduledMessage,
    SerializedBag,
    StoredMessage,
    alignment_offsets_ns,
    loop_duration_ns,
    open_serialized_bag,
)
from t3mpc_ros.bag.topic_filter import PlayTopicFilter, PlayTopicFilterError, parse_remappings
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

COMMAND_TOPIC = 'cmd_vel'


VELOCITY_TYPES = ('geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped')


def velocity_command_risk(recorded: str, name: str, type_name: str) -> str:
    """Return why a topic could drive a robot, empty when it cannot.

    A robot listens to ``cmd_vel``, or to a velocity of any other name that its launch file gave
    it: only a velocity that was renamed on purpose, to something else than ``cmd_vel``, is safe.
    """
    if name.rsplit('/', 1)[-1] == COMMAND_TOPIC:
        return f'{name} may drive a robot'
    if type_name in VELOCITY_TYPES and name == recorded:
        return f'{name} is a velocity ({type_name}) and may drive a robot'
    return ''


_BIN_RATIO = math.log(1.02)
_MIN_LATENCY_NS = 1_000


class LatencyHistogram:
    """A histogram of delays whose bins grow by two percent, from one microsecond up."""

    def __init__(self) -> None:
        self._bins: dict[int, int] = {}
        self.count = 0
        self.max_ns = 0

    def note(self, late_ns: int) -> None:
        """Count one delay; what is not late at all counts as one microsecond."""
        late_ns = max(late_ns, _MIN_LATENCY_NS)
        number = math.ceil(math.log(late_ns / _MIN_LATENCY_NS) / _BIN_RATIO)
        self._bins[number] = self._bins.get(number, 0) + 1
        self.count += 1
        self.max_ns = max(self.max_ns, late_ns)

    def percentile_ns(self, percent: float) -> int:
        """Return the delay that so many percent do not exceed, within two percent; 0 for none."""
        rank, seen = math.ceil(percent / 100.0 * self.count), 0
        for number in sorted(self._bins.copy()):
            seen += self._bins[number]
            if seen >= max(rank, 1):
                return min(round(_MIN_LATENCY_NS * math.exp(number * _BIN_RATIO)), self.max_ns)
        return 0


T = TypeVar('T')

_BATCH_SIZE = 50
"""Items handed over at once: waking the other thread costs more than reading one."""


class ReadAheadQueue(Generic[T]):
    """The items of ``source``, in order, read before they are asked for.

    What the source raises is raised where its next item would have come. :meth:`close` ends the
    thread and the source.
    """

    def __init__(self, source: Iterator[T], items: int) -> None:
        self._source = source
        self._batches: queue.Queue[list[T] | BaseException | None] = queue.Queue(
            max(1, items // _BATCH_SIZE)
        )
        self._ready: deque[T] = deque()
        self._over = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name='read ahead', daemon=True)
        self._thread.start()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        while not self._ready:
            if self._over:
                raise StopIteration
            got = self._batches.get()
            if isinstance(got, list):
                self._ready.extend(got)
                continue
            self._over = True
            if got is not None:
                raise got
        return self._ready.popleft()

    def close(self) -> None:
        """Stop reading; nothing more comes."""
        self._closing.set()
        self._over = True
        self._ready.clear()
        while self._thread.is_alive():
            try:
                self._batches.get(timeout=0.01)  # room for what the thread waits to hand over
            except queue.Empty:
                continue
        self._thread.join()

    def _read(self) -> None:
        end: BaseException | None = None
        batch: list[T] = []
        size = 1  # the first item by itself: somebody is waiting for it
        try:
            for item in self._source:
                batch.append(item)
                if len(batch) == size:
                    self._batches.put(batch)
                    batch, size = [], _BATCH_SIZE
                if self._closing.is_set():
                    break
        except BaseException as error:  # handed over to whoever reads
            end = error
        finally:
            close = getattr(self._source, 'close', None)
            if close is not None:
                close()
            self._batches.put(batch)
            self._batches.put(end)


class DueMessage(NamedTuple):
    """Something to publish now."""

    due_ns: int
    """When it should have been published, on the caller's clock."""
    stamp_ns: int
    """What time it is in the bag."""
    message: StoredMessage | None
    """None: only the time is to be told."""


class PlaybackTimeline:
    """Plays the span from ``begin_ns`` to ``end_ns`` of a bag.

    Parameters
    ----------
    plan
        Returns what is played from a time in the bag on, see :meth:`Tape.plan`; what has a
        ``close`` is closed when it is no longer needed.
    begin_ns, end_ns
        The span to play.
    origin_ns
        From where a refused :meth:`seek` counts seconds; ``begin_ns`` when not given.
    rate
        Seconds of the bag in a second.
    clock_rate
        How often the time is told, in Hz of the caller's clock; 0 = only with messages.
    """

    def __init__(
        self,
        plan: Callable[[int], Iterator[ScheduledMessage]],
        begin_ns: int,
        end_ns: int,
        *,
        origin_ns: int | None = None,
        rate: float = 1.0,
        loop: bool = False,
        paused: bool = False,
        clock_rate: float = 0.0,
    ) -> None:
        self._plan = plan
        self._begin_ns, self._end_ns = begin_ns, max(begin_ns, end_ns)
        self._origin_ns = begin_ns if origin_ns is None else origin_ns
        self._loop_ns = loop_duration_ns(begin_ns, end_ns) if loop else 0
        self._tick_ns = round(NANOSECONDS / clock_rate) if clock_rate else 0
        self._next_tick_ns: int | None = None
        self._ratio = _rate_ratio(rate)
        self.rate = rate
        self.paused = paused
        self.finished = False
        self._steps = 0
        self._stream = plan(begin_ns)
        self._head: ScheduledMessage | None = None
        self._primed = False
        self._anchor_ns: int | None = None
        """When the place below was, or will be; None until time is told again."""
        self._place = 0

    # -- what to publish --------------------------------------------------------------------------

    def due(self, now_ns: int, most: int = 20) -> tuple[list[DueMessage], int | None]:
        """Return what is to be published now, at most so much, and when to ask again.

        Messages come in order; late ones come at once, none is left out. The time to ask again is
        None when nothing will happen unless another method is called. After a start or a seek
        the first call only waits for the first message to be read, so that reading does not make
        it late.

        Raises
        ------
        BagError
            The bag cannot be read on.
        """
        if not self._primed:
            self._advance()
            self._primed = True
            return [], now_ns
        if self._anchor_ns is None:
            self._anchor_ns = now_ns
        out: list[DueMessage] = []
        while len(out) < most and (head := self._head) is not None:
            due_ns = self._due_ns(head, now_ns)
            if due_ns is None or due_ns > now_ns:
                break
            out.append(DueMessage(due_ns, head.stamp_ns, head.message))
            if self.paused and not head.restored:
                self._steps -= 1
                self._place = max(self._place, head.at_ns)
            self._advance()
        if self._head is None and not self.finished:
            self.finished = True
            self._place, self._anchor_ns = self._place_at(now_ns), now_ns
        wake_ns = None if self._head is None else self._due_ns(self._head, now_ns)
        if wake_ns is None or wake_ns > now_ns:
            wake_ns = self._tick(now_ns, out, wake_ns)
        return out, wake_ns

    def _due_ns(self, planned: ScheduledMessage, now_ns: int) -> int | None:
        """Return when a message is due; None while that depends on somebody's asking."""
        if self.paused:
            told_at_once = planned.restored and planned.at_ns <= self._place
            return now_ns if told_at_once or self._steps else None
        anchor_ns = now_ns if self._anchor_ns is None else self._anchor_ns
        numerator, denominator = self._ratio
        ahead_ns = -((self._place - planned.at_ns) * denominator // numerator)  # rounded up
        return anchor_ns + max(0, ahead_ns)

    def _tick(self, now_ns: int, out: list[DueMessage], wake_ns: int | None) -> int | None:
        if not self._tick_ns or self.finished:
            return wake_ns
        if self._next_tick_ns is None:
            self._next_tick_ns = now_ns
        if self._next_tick_ns <= now_ns:
            out.append(DueMessage(self._next_tick_ns, self.stamp_ns(now_ns), None))
            # Missed ones are not made up for: there is only one time now.
            self._next_tick_ns += self._tick_ns * ((now_ns - self._next_tick_ns) // self._tick_ns)
            self._next_tick_ns += self._tick_ns
        return self._next_tick_ns if wake_ns is None else min(wake_ns, self._next_tick_ns)

    def _advance(self) -> None:
        self._head = next(self._stream, None)

    # -- where it is ------------------------------------------------------------------------------

    def stamp_ns(self, now_ns: int) -> int:
        """Return what time it is in the bag."""
        place = self._place_at(now_ns)
        if self._loop_ns:
            return self._begin_ns + place % self._loop_ns
        return min(self._begin_ns + place, self._end_ns)

    def loops(self, now_ns: int) -> int:
        """Return how many times the span has been played to its end, when it is a loop."""
        return self._place_at(now_ns) // self._loop_ns if self._loop_ns else 0

    def remaining_ns(self, now_ns: int) -> int:
        """Return how much longer the rest of the span takes, on the caller's clock."""
        numerator, denominator = self._ratio
        return (self._end_ns - self.stamp_ns(now_ns)) * denominator // numerator

    def _place_at(self, now_ns: int) -> int:
        if self.paused or self.finished or self._anchor_ns is None:
            return self._place
        numerator, denominator = self._ratio
        return self._place + max(0, now_ns - self._anchor_ns) * numerator // denominator

    # -- what a user asks for ---------------------------------------------------------------------

    def pause(self, now_ns: int) -> None:
        """Let time stand; what was due and has not been returned yet waits, too."""
        self._bind(now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Let time go on; steps that were not taken yet are forgotten."""
        self._bind(now_ns)
        self.paused = False
        self._steps = 0

    def set_rate(self, now_ns: int, rate: float) -> None:
        """Play at another rate from now on.

        Raises
        ------
        ValueError
            The rate is not a positive number.
        """
        ratio = _rate_ratio(rate)
        self._bind(now_ns)
        self.rate, self._ratio = rate, ratio

    def seek(self, now_ns: int, stamp_ns: int) -> str:
        """Go on at a time in the bag, with what latched topics held then; or say why not."""
        if not self._begin_ns <= stamp_ns <= self._end_ns:
            begin, end, asked = (
                (each - self._origin_ns) / NANOSECONDS
                for each in (self._begin_ns, self._end_ns, stamp_ns)
            )
            return f'the place must be from {begin:.3f} to {end:.3f} s: got {asked:.3f} s'
        self.close()
        self._stream = self._plan(stamp_ns)
        self._head, self._primed, self.finished = None, False, False
        self._place, self._anchor_ns, self._steps = stamp_ns - self._begin_ns, None, 0
        return ''

    def step(self, now_ns: int, count: int = 1) -> str:
        """Play the next ``count`` messages at once, then stand again; or say why not."""
        if not self.paused:
            return 'it must be paused to go step by step'
        if self.finished:
            return 'there is no next message'
        if count < 1:
            return f'the number of steps must be from 1: got {count}'
        self._steps += count
        return ''

    def close(self) -> None:
        """Let go of what is being read."""
        close = getattr(self._stream, 'close', None)
        if close is not None:
            close()

    def _bind(self, now_ns: int) -> None:
        """Make now the anchor, wherever that is."""
        place = self._place_at(now_ns)
        if self._anchor_ns is not None:
            self._anchor_ns = now_ns
        self._place = place


def _rate_ratio(rate: float) -> tuple[int, int]:
    if not (math.isfinite(rate) and rate > 0.0):
        raise ValueError(f'rate must be a positive number: got {rate}')
    return float(rate).as_integer_ratio()


@dataclass(frozen=True)
class PlaybackParameters(Parameters):
    """Bags, what of them is played, and how."""

    bags: tuple[str, ...] = parameter(
        (), 'bags to play, merged by time of receipt: folders or files, MCAP or sqlite3'
    )
    align: bool = parameter(False, 'let every bag begin when the first one does')
    bag_offsets: tuple[float, ...] = parameter(
        (), 'added to the times of each bag, after align; empty = nothing', unit='s'
    )
    rate: float = parameter(
        1.0, 'seconds of the bag in a second', low=0.01, high=100.0, dynamic=True
    )
    loop: bool = parameter(False, 'begin again at the end')
    start_offset: float = parameter(
        0.0,
        'where to begin, after the first message; what latched topics held then comes first',
        unit='s',
        low=0.0,
    )
    duration: float = parameter(
        0.0, 'how much to play from there, in time of the bag; 0 = to the end', unit='s', low=0.0
    )
    until: float = parameter(
        0.0, 'where to end, after the first message; 0 = at the end', unit='s', low=0.0
    )
    topics: tuple[str, ...] = parameter(
        (), 'topics to play; * stands for anything; none here and no regex = all'
    )
    regex: str = parameter('', 'play topics whose whole name matches, too; empty = none')
    exclude: tuple[str, ...] = parameter((), 'topics not to play; * stands for anything')
    exclude_regex: str = parameter('', 'do not play topics whose whole name matches; empty = none')
    remap: tuple[str, ...] = parameter((), 'new names of topics, each as old:=new')
    clock_rate: float = parameter(
        0.0, 'how often /clock is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    clock_with_messages: bool = parameter(False, 'publish /clock before each message, too')
    start_paused: bool = parameter(False, 'wait for ~/resume, ~/step or the space bar')
    seek_time: float = parameter(
        0.0, 'where ~/seek goes, after the first message', unit='s', low=0.0, dynamic=True
    )
    step_count: int = parameter(
        1, 'messages that ~/step plays', low=1, high=1_000_000, dynamic=True
    )
    read_ahead: int = parameter(1000, 'messages read before they are due', low=1, high=1_000_000)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for an end before the beginning, or an unusable choice."""
        super().check_consistency()
        if self.until and self.until <= self.start_offset:
            raise ParameterError(
                f'until must be later than start_offset ({self.start_offset:g} s): '
                f'got {self.until:g} s'
            )
        if self.bag_offsets and len(self.bag_offsets) != len(self.bags):
            raise ParameterError(
                f'bag_offsets must have one number for each of the {len(self.bags)} bags: '
                f'got {len(self.bag_offsets)}'
            )
        try:
            self.selection()
        except PlayTopicFilterError as error:
            raise ParameterError(str(error)) from error

    def selection(self) -> PlayTopicFilter:
        """Return which topics are played, and under which names."""
        return PlayTopicFilter(
            self.topics, self.regex, self.exclude, self.exclude_regex, parse_remappings(self.remap)
        )

    def open_reader(self) -> tuple[MergedReader, tuple[str, ...]]:
        """Return the opened bags as one, and the files that broke off and are not played.

        Raises
        ------
        BagError
            A bag cannot be read, or a topic has two types.
        """
        bags: list[SerializedBag] = []
        try:
            for path in self.bags:
                bags.append(open_serialized_bag(path))
            offsets_ns = [round(offset * NANOSECONDS) for offset in self.bag_offsets]
            offsets_ns = offsets_ns or [0] * len(bags)
            if self.align and bags:
                offsets_ns = [
                    a + b for a, b in zip(alignment_offsets_ns(bags), offsets_ns, strict=True)
                ]
            tape = MergedReader(bags, offsets_ns, self.selection())
        except Exception:
            for bag in bags:
                bag.close()
            raise
        return tape, tuple(f'{bag.path}/{name}' for bag in bags for name in bag.unfinished)

    def span_ns(self, tape: MergedReader) -> tuple[int, int]:
        """Return the receipt times between which ``tape`` is played.

        Raises
        ------
        ParameterError
            The beginning lies behind the bag's end.
        """
        begin_ns = tape.start_ns + round(self.start_offset * NANOSECONDS)
        if begin_ns > tape.end_ns:
            length = (tape.end_ns - tape.start_ns) / NANOSECONDS
            raise ParameterError(
                f'start_offset must be at most the length of the bag, {length:.3f} s: '
                f'got {self.start_offset:g} s'
            )
        ends = [tape.end_ns]
        if self.duration:
            ends.append(begin_ns + round(self.duration * NANOSECONDS))
        if self.until:
            ends.append(tape.start_ns + round(self.until * NANOSECONDS))
        return begin_ns, min(ends)
