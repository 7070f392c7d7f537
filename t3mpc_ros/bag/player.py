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
"""Playback of bags: messages of several bags, parameters, timeline and read-ahead queue.

:class:`PlaybackTimeline` reads no clock: ``now_ns`` is a time of any monotonic clock. Positions
are nanoseconds on a timeline of consecutive loops. One anchor and the rate as an exact fraction
relate position and time, so no error accumulates.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from typing import Generic, NamedTuple, Self, TypeVar

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.mcap_file import RECEIVE_TIME, SerializedMessage
from t3mpc_ros.bag.metadata_yaml import TopicInformation
from t3mpc_ros.bag.reader import BagFile, BagReader, merge_streams, merge_topics, open_bag
from t3mpc_ros.bag.topic_filter import PlayTopicFilter, parse_remappings
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

_FIRST_LOOKBACK_NS = NANOSECONDS
"""First time range of a backward search; each further range is twice as long."""
MIN_LOOP_NS = 10_000_000
"""Minimum duration of a loop, for bags whose messages all have the same stamp."""
LONGEST = 1e10
"""Largest time in a bag or between bags, s: 300 years."""


class ScheduledMessage(NamedTuple):
    """Message with its position on the playback timeline."""

    at_ns: int
    """Time since the beginning of the first loop; loops are consecutive."""
    stamp_ns: int
    """Bag time at which the message is played."""
    message: SerializedMessage
    restored: bool = False
    """Whether it is a transient-local message from before the start of the playback."""


class MergedReader:
    """Selected topics of several bags, merged by time of receipt; damaged chunks are skipped.

    ``offsets_ns`` are added to the stamps of each bag. A topic with two types after remapping
    raises :class:`BagError`. :meth:`close` closes the bags.
    """

    def __init__(
        self,
        bags: Sequence[BagReader],
        offsets_ns: Sequence[int] = (),
        topic_filter: PlayTopicFilter | None = None,
    ) -> None:
        self._bags = list(bags)
        selection = topic_filter or PlayTopicFilter()
        offsets = offsets_ns or [0] * len(bags)
        self._files = [
            (file, offset) for bag, offset in zip(bags, offsets, strict=True) for file in bag.files
        ]
        some = [(file, offset) for file, offset in self._files if file.message_count]
        self.empty = not some
        self.start_ns = min((file.start_ns + offset for file, offset in some), default=0)
        self.end_ns = max((file.end_ns + offset for file, offset in some), default=0)
        selected = [
            topic
            for file, _ in self._files
            for topic in file.topics
            if selection.matches(topic.name)
        ]
        self.recorded_names: dict[str, set[str]] = {}
        """Names in the bags by remapped name."""
        types: dict[str, str] = {}
        for topic in selected:
            name = selection.remapped_name(topic.name)
            self.recorded_names.setdefault(name, set()).add(topic.name)
            if types.setdefault(name, topic.type_name) != topic.type_name:
                where = ' and '.join(str(bag.folder) for bag in bags)
                raise BagError(
                    f'{name} is {types[name]} and {topic.type_name} in {where}: exclude it, or '
                    'play one bag at a time'
                )
        self.topics: dict[str, TopicInformation] = merge_topics(
            replace(each, name=selection.remapped_name(each.name)) for each in selected
        )
        """By remapped name."""

    @property
    def damaged_count(self) -> int:
        """Number of messages in damaged chunks that were skipped so far."""
        return sum(sum(file.damaged.values()) for file, _ in self._files)

    def exclude_topic(self, topic: str) -> None:
        """Exclude a topic, given by its remapped name."""
        del self.topics[topic]
        del self.recorded_names[topic]

    def messages(self, start_ns: int) -> Iterator[SerializedMessage]:
        """Yield the messages received at ``start_ns`` or later.

        Messages with equal times are in the order of the bags, then of their files, then within
        the file. A file is not read before its start time is reached.
        """
        return merge_streams(
            (max(file.start_ns + offset, start_ns), self._shifted(file, offset, start_ns))
            for file, offset in self._files
            if file.end_ns + offset >= start_ns
        )

    def latched_messages_before(self, stamp_ns: int) -> list[SerializedMessage]:
        """Return what a late transient-local subscriber receives at a time, in order of receipt.

        For each transient-local topic these are as many messages as it had such publishers.
        """
        found: list[SerializedMessage] = []
        for name, topic in self.topics.items():
            if not (count := topic.transient_local_count):
                continue
            earlier = [
                message._replace(topic=name, received_ns=message.received_ns + offset)
                for file, offset in self._files
                for recorded in self.recorded_names[name]
                for message in _last_before(file, recorded, stamp_ns - offset, count)
            ]
            earlier.sort(key=RECEIVE_TIME)
            found += earlier[-count:]
        return sorted(found, key=RECEIVE_TIME)

    def schedule(
        self, from_ns: int, begin_ns: int, end_ns: int, loop: bool
    ) -> Iterator[ScheduledMessage]:
        """Yield the messages played from ``from_ns``: transient-local ones first, then each loop.

        A loop lasts from ``begin_ns`` to ``end_ns``, both included; the next one begins when the
        last one ends, so loops do not drift.
        """
        loop_ns, loops = loop_duration_ns(begin_ns, end_ns), 0
        while True:
            begin_at_ns, played = from_ns - begin_ns + loops * loop_ns, 0
            for message in self.latched_messages_before(from_ns):
                yield ScheduledMessage(begin_at_ns, from_ns, message, restored=True)
            for message in self.messages(from_ns):
                stamp_ns = message.received_ns
                if stamp_ns > end_ns:
                    break
                played += 1
                yield ScheduledMessage(stamp_ns - begin_ns + loops * loop_ns, stamp_ns, message)
            if not loop or (from_ns == begin_ns and not played):
                return
            from_ns, loops = begin_ns, loops + 1

    def close(self) -> None:
        """Close the bags."""
        for bag in self._bags:
            bag.close()

    def _shifted(
        self, file: BagFile, offset_ns: int, start_ns: int
    ) -> Iterator[SerializedMessage]:
        names = {recorded: name for name, each in self.recorded_names.items() for recorded in each}
        for topic, received_ns, published_ns, data in file.messages(
            names.keys(), start_ns - offset_ns, skip_damaged=True
        ):
            yield SerializedMessage(names[topic], received_ns + offset_ns, published_ns, data)


def _last_before(file: BagFile, topic: str, stamp_ns: int, count: int) -> list[SerializedMessage]:
    """Return the last ``count`` messages of a topic before a time, or fewer if there are."""
    stop_ns, lookback_ns = min(stamp_ns, file.end_ns + 1), _FIRST_LOOKBACK_NS
    found: list[SerializedMessage] = []
    while len(found) < count and stop_ns > file.start_ns:
        start_ns = max(stop_ns - lookback_ns, file.start_ns)
        found = [*file.messages([topic], start_ns, stop_ns, skip_damaged=True), *found]
        stop_ns, lookback_ns = start_ns, 2 * lookback_ns
    return found[-count:]


def loop_duration_ns(begin_ns: int, end_ns: int) -> int:
    """Return the duration of one loop at rate 1."""
    return max(end_ns - begin_ns, MIN_LOOP_NS)


# -- parameters -----------------------------------------------------------------------------------


COMMAND_TOPIC = 'cmd_vel'
VELOCITY_TYPES = ('geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped')

T = TypeVar('T')


@dataclass(frozen=True)
class PlaybackParameters(Parameters):
    """Bags to play, selection of topics, rate and time range."""

    prefix = 'play.'
    uris: tuple[str, ...] = parameter(
        (),
        'bags to play, merged by time of receipt: folders or files, MCAP or sqlite3',
        name='storage.uris',
    )
    align_bags: bool = parameter(False, 'shift every bag to the start time of the first one')
    bag_offsets: tuple[float, ...] = parameter(
        (),
        'time offset of each bag, after the alignment; empty = none',
        's',
        (-LONGEST, LONGEST),
    )
    rate: float = parameter(
        1.0, 'playback rate: seconds of the bag per second', bounds=(0.01, 100.0), dynamic=True
    )
    loop: bool = parameter(False, 'restart at the end')
    start_offset: float = parameter(
        0.0,
        'start of the playback, after the first message; transient-local messages from before it '
        'are published first',
        's',
        (0.0, LONGEST),
    )
    playback_duration: float = parameter(
        0.0, 'duration of the playback in bag time; 0 = to the end', 's', (0.0, LONGEST)
    )
    playback_until: float = parameter(
        0.0,
        'end of the playback, after the first message; 0 = the end of the bag',
        's',
        (0.0, LONGEST),
    )
    topics: tuple[str, ...] = parameter(
        (),
        'topics to play; * matches any text; without topics and regular expression all topics',
        name='play.topics_to_filter',
    )
    regex: str = parameter(
        '',
        'also play topics whose full name matches this regular expression; empty = none',
        name='play.regex_to_filter',
    )
    exclude_topics: tuple[str, ...] = parameter(
        (), 'topics that are not played; * matches any text'
    )
    exclude_regex: str = parameter(
        '', 'do not play topics whose full name matches this regular expression; empty = none'
    )
    remappings: tuple[str, ...] = parameter(
        (), 'new names of topics, each as old:=new', name='play.topic_remapping_options'
    )
    clock_publish_frequency: float = parameter(
        0.0, 'rate of /clock; 0 = no /clock', 'Hz', (0.0, 1000.0)
    )
    clock_publish_on_topic_publish: bool = parameter(
        False, 'publish /clock also before each message'
    )
    start_paused: bool = parameter(
        False, 'start paused: wait for ~/resume, ~/play_next or the space bar'
    )
    seek_time: float = parameter(
        0.0, 'target of ~/seek, after the first message', 's', (0.0, LONGEST), dynamic=True
    )
    play_next_count: int = parameter(
        1, 'number of messages that ~/play_next plays', bounds=(1, 1_000_000), dynamic=True
    )
    read_ahead_queue_size: int = parameter(
        1000, 'number of messages read ahead', bounds=(1, 1_000_000)
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for an empty time range or an invalid selection."""
        super().check_consistency()
        if self.playback_until and self.playback_until <= self.start_offset:
            raise ParameterError(
                'play.playback_until must be later than play.start_offset '
                f'({self.start_offset:g} s): got {self.playback_until:g} s'
            )
        if self.bag_offsets and len(self.bag_offsets) != len(self.uris):
            raise ParameterError(
                f'play.bag_offsets must have one number for each of the {len(self.uris)} bags: '
                f'got {len(self.bag_offsets)}'
            )
        self.topic_filter()

    def topic_filter(self) -> PlayTopicFilter:
        """Return the selection of topics and their remappings."""
        return PlayTopicFilter(
            self.topics,
            self.regex,
            self.exclude_topics,
            self.exclude_regex,
            parse_remappings(self.remappings),
        )

    def open_reader(self) -> tuple[MergedReader, tuple[str, ...]]:
        """Return a reader of all bags, and the incomplete files, which are not played."""
        bags: list[BagReader] = []
        try:
            for path in self.uris:
                bags.append(open_bag(path))
                files = {file.path.resolve() for bag in bags for file in bag.files}
                if len(files) < sum(len(bag.files) for bag in bags):
                    raise ParameterError(f'storage.uris must name each bag once: got {path} twice')
            offsets_ns = [round(offset * NANOSECONDS) for offset in self.bag_offsets]
            offsets_ns = offsets_ns or [0] * len(bags)
            if self.align_bags:
                offsets_ns = [
                    bags[0].start_ns - bag.start_ns + offset if bag.message_count else offset
                    for bag, offset in zip(bags, offsets_ns, strict=True)
                ]
            reader = MergedReader(bags, offsets_ns, self.topic_filter())
        except Exception:
            for bag in bags:
                bag.close()
            raise
        return reader, tuple(
            f'{bag.folder}/{name}' for bag in bags for name in bag.incomplete_files
        )

    def time_range_ns(self, reader: MergedReader) -> tuple[int, int]:
        """Return the first and the last receive time to play."""
        begin_ns = reader.start_ns + round(self.start_offset * NANOSECONDS)
        if begin_ns > reader.end_ns:
            length = (reader.end_ns - reader.start_ns) / NANOSECONDS
            raise ParameterError(
                f'play.start_offset must be at most the length of the bag, {length:.3f} s: '
                f'got {self.start_offset:g} s'
            )
        ends = [reader.end_ns]
        if self.playback_duration:
            ends.append(begin_ns + round(self.playback_duration * NANOSECONDS))
        if self.playback_until:
            ends.append(reader.start_ns + round(self.playback_until * NANOSECONDS))
        return begin_ns, min(ends)


# -- timeline -------------------------------------------------------------------------------------


class DueMessage(NamedTuple):
    """Message or clock tick to publish now."""

    due_ns: int
    """Due time on the clock of the caller."""
    stamp_ns: int
    """Bag time."""
    message: SerializedMessage | None
    """None for a clock tick."""


class PlaybackTimeline:
    """Determines the messages that are due under pause, rate, seek, step and loop.

    ``schedule`` returns the messages from a bag time, see :meth:`MergedReader.schedule`; it is
    closed after use. Those received from ``begin_ns`` to ``end_ns`` are played; errors of
    :meth:`seek` count seconds from ``origin_ns``. The clock ticks with ``clock_rate`` Hz of the
    caller's clock, 0 = never.
    """

    def __init__(
        self,
        schedule: Callable[[int], Iterator[ScheduledMessage]],
        begin_ns: int,
        end_ns: int,
        *,
        origin_ns: int | None = None,
        rate: float = 1.0,
        loop: bool = False,
        paused: bool = False,
        clock_rate: float = 0.0,
    ) -> None:
        self._schedule = schedule
        self._begin_ns, self._end_ns = begin_ns, max(begin_ns, end_ns)
        self._origin_ns = begin_ns if origin_ns is None else origin_ns
        self._loop_ns = loop_duration_ns(begin_ns, end_ns) if loop else 0
        self._tick_ns = round(NANOSECONDS / clock_rate) if clock_rate else 0
        self._next_tick_ns: int | None = None
        self.rate, self._ratio = rate, rate.as_integer_ratio()
        self.paused = paused
        self.finished = False
        self._steps = 0
        self._stream = schedule(begin_ns)
        self._head: ScheduledMessage | None = None
        self._primed = False
        self._anchor_ns: int | None = None
        """Time of the position below; None until the next call of :meth:`due_messages`."""
        self._position = 0

    def due_messages(
        self, now_ns: int, max_count: int = 20
    ) -> tuple[list[DueMessage], int | None]:
        """Return at most ``max_count`` due messages, and the time of the next call.

        Messages are in order, and late ones are due immediately. The time of the next call is
        None if nothing is due before a call of another method. After a start or a seek the first
        call only reads the first message, so that the time for reading does not delay it.
        """
        if not self._primed:
            self._advance()
            self._primed = True
            return [], now_ns
        if self._anchor_ns is None:
            self._anchor_ns = now_ns
        out: list[DueMessage] = []
        while len(out) < max_count and (head := self._head) is not None:
            due_ns = self._due_ns(head, now_ns)
            if due_ns is None or due_ns > now_ns:
                break
            out.append(DueMessage(due_ns, head.stamp_ns, head.message))
            if self.paused and not head.restored:
                self._steps -= 1
                self._position = max(self._position, head.at_ns)
            self._advance()
        if self._head is None and not self.finished:
            self._bind(now_ns)
            self.finished = True
        wake_ns = None if self._head is None else self._due_ns(self._head, now_ns)
        if wake_ns is None or wake_ns > now_ns:
            wake_ns = self._tick(now_ns, out, wake_ns)
        return out, wake_ns

    def _due_ns(self, message: ScheduledMessage, now_ns: int) -> int | None:
        """Return the due time of a message; None while the playback is paused."""
        if self.paused:
            immediate = message.restored and message.at_ns <= self._position
            return now_ns if immediate or self._steps else None
        anchor_ns = now_ns if self._anchor_ns is None else self._anchor_ns
        numerator, denominator = self._ratio
        ahead_ns = -((self._position - message.at_ns) * denominator // numerator)  # rounded up
        return anchor_ns + max(0, ahead_ns)

    def _tick(self, now_ns: int, out: list[DueMessage], wake_ns: int | None) -> int | None:
        if not self._tick_ns or self.finished:
            return wake_ns
        if self._next_tick_ns is None:
            self._next_tick_ns = now_ns
        if self._next_tick_ns <= now_ns:
            out.append(DueMessage(self._next_tick_ns, self.bag_time_ns(now_ns), None))
            # Missed ticks are skipped.
            self._next_tick_ns += self._tick_ns * ((now_ns - self._next_tick_ns) // self._tick_ns)
            self._next_tick_ns += self._tick_ns
        return self._next_tick_ns if wake_ns is None else min(wake_ns, self._next_tick_ns)

    def _advance(self) -> None:
        self._head = next(self._stream, None)

    def bag_time_ns(self, now_ns: int) -> int:
        """Return the current bag time."""
        position = self._position_at(now_ns)
        if self._loop_ns:
            return self._begin_ns + position % self._loop_ns
        return min(self._begin_ns + position, self._end_ns)

    def loops(self, now_ns: int) -> int:
        """Return the number of completed loops."""
        return self._position_at(now_ns) // self._loop_ns if self._loop_ns else 0

    def remaining_ns(self, now_ns: int) -> int:
        """Return the time to the end of the bag or of the loop, on the caller's clock."""
        numerator, denominator = self._ratio
        return (self._end_ns - self.bag_time_ns(now_ns)) * denominator // numerator

    def _position_at(self, now_ns: int) -> int:
        if self.paused or self.finished or self._anchor_ns is None:
            return self._position
        numerator, denominator = self._ratio
        return self._position + max(0, now_ns - self._anchor_ns) * numerator // denominator

    def pause(self, now_ns: int) -> None:
        """Pause, including the due messages that were not returned yet."""
        self._bind(now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Resume; pending steps are cancelled."""
        self._bind(now_ns)
        self.paused = False
        self._steps = 0

    def set_rate(self, now_ns: int, rate: float) -> None:
        """Change the rate, a positive number."""
        self._bind(now_ns)
        self.rate, self._ratio = rate, rate.as_integer_ratio()

    def seek(self, now_ns: int, stamp_ns: int) -> str:
        """Continue at a bag time, transient-local messages before it first; return the problem."""
        if not self._begin_ns <= stamp_ns <= self._end_ns:
            begin, end, target = (
                (each - self._origin_ns) / NANOSECONDS
                for each in (self._begin_ns, self._end_ns, stamp_ns)
            )
            return f'the seek target must be from {begin:.3f} to {end:.3f} s: got {target:.3f} s'
        self.close()
        self._stream = self._schedule(stamp_ns)
        self._head, self._primed, self.finished = None, False, False
        self._position, self._anchor_ns, self._steps = stamp_ns - self._begin_ns, None, 0
        return ''

    def play_next(self, now_ns: int, count: int = 1) -> str:
        """Play the next ``count`` messages immediately while paused; return the problem."""
        if not self.paused:
            return 'the player must be paused to play the next message'
        if self.finished:
            return 'there is no next message'
        self._steps += count
        return ''

    def close(self) -> None:
        """Close the message source."""
        close = getattr(self._stream, 'close', None)
        if close is not None:
            close()

    def _bind(self, now_ns: int) -> None:
        """Move the anchor to the current time and position."""
        position = self._position_at(now_ns)
        if self._anchor_ns is not None:
            self._anchor_ns = now_ns
        self._position = position


class ReadAheadQueue(Generic[T]):
    """Iterator over ``source`` that reads ahead in a thread, half of ``items`` at a time.

    An exception of the source is raised in place of its next item. :meth:`close` ends the thread
    and closes the source.
    """

    def __init__(self, source: Iterator[T], items: int) -> None:
        self._source = source
        self._batch_size = max(1, items // 2)
        self._ready: deque[T] = deque()
        self._error: Exception | None = None
        self._thread = ThreadPoolExecutor(1, 'read ahead')
        self._next = self._thread.submit(self._read, 1)  # the player waits for the first item

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        if not self._ready:
            self._ready.extend(self._next.result())
            if not self._ready:
                raise StopIteration
            self._next = self._thread.submit(self._read, self._batch_size)
        return self._ready.popleft()

    def close(self) -> None:
        """End the thread and close the source."""
        self._thread.shutdown()
        close = getattr(self._source, 'close', None)
        if close is not None:
            close()

    def _read(self, count: int) -> list[T]:
        """Return the next items; those before an error first, then raise it."""
        if self._error is not None:
            raise self._error
        found: list[T] = []
        try:
            for item in islice(self._source, count):
                found.append(item)
        except Exception as error:
            self._error = error
            if not found:
                raise
        return found


def velocity_command_risk(recorded: str, name: str, type_name: str) -> str:
    """Return why a topic may drive a robot, or an empty text if it does not.

    A robot subscribes to ``cmd_vel``, or to a velocity topic remapped by its launch file. A
    velocity topic is safe only after an explicit remapping to a name other than ``cmd_vel``.
    """
    if name.rsplit('/', 1)[-1] == COMMAND_TOPIC:
        return f'{name} may drive a robot'
    if type_name in VELOCITY_TYPES and name == recorded:
        return f'{name} is a velocity ({type_name}) and may drive a robot'
    return ''
