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
"""Messages of several bags, filtered, remapped and merged by time of receipt, for playback."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from t3mpc_ros.bag.mcap_file import RECEIVE_TIME, SerializedMessage
from t3mpc_ros.bag.message_definitions import BagError
from t3mpc_ros.bag.metadata import TopicInformation
from t3mpc_ros.bag.qos import TRANSIENT_LOCAL
from t3mpc_ros.bag.reader import BagFile, BagReader, merge_streams, merge_topics
from t3mpc_ros.bag.topic_filter import PlayTopicFilter
from t3mpc_ros.geometry.types import NANOSECONDS

_FIRST_LOOKBACK_NS = NANOSECONDS
"""First time range of a backward search; each further range is twice as long."""
MIN_LOOP_NS = 10_000_000
"""Minimum duration of a loop, for bags whose messages all have the same stamp."""


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
            count = transient_local_count(topic)
            if not count:
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


def transient_local_count(topic: TopicInformation) -> int:
    """Return the number of transient-local publishers of a topic."""
    return sum(each.durability == TRANSIENT_LOCAL for each in topic.offered_qos_profiles)


def loop_duration_ns(begin_ns: int, end_ns: int) -> int:
    """Return the duration of one loop at rate 1."""
    return max(end_ns - begin_ns, MIN_LOOP_NS)


def alignment_offsets_ns(bags: Sequence[BagReader]) -> list[int]:
    """Return the offsets that make all bags begin with the first one."""
    return [bags[0].start_ns - bag.start_ns if bag.message_count else 0 for bag in bags]
