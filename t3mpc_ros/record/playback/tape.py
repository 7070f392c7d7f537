# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Several bags as one sequence of messages, chosen, renamed, and laid out over time."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
import heapq
from typing import NamedTuple

from t3mpc_ros.record.playback.bag import Bag, Part, Stored, Track, merged
from t3mpc_ros.record.playback.selection import Selection
from t3mpc_ros.record.schema import RecordError

SHORTEST_LAP_NS = 10_000_000
"""A bag of a single instant would otherwise be played again and again without end at once."""


class Planned(NamedTuple):
    """A message and where it belongs."""

    at_ns: int
    """Time since the beginning of the first lap, on which laps follow each other."""
    stamp_ns: int
    """What time it is in the bag when the message is played."""
    message: Stored
    restored: bool = False
    """Whether it is from before the start: what a latched topic still held then."""


class Tape:
    """The chosen topics of some bags, merged by time of receipt.

    Parameters
    ----------
    bags
        Open bags; closed by :meth:`close`.
    offsets_ns
        Added to every stamp of the bag in the same place.

    Raises
    ------
    RecordError
        A topic has different types in two bags, under the name under which it is played.
    """

    def __init__(
        self,
        bags: Sequence[Bag],
        offsets_ns: Sequence[int] = (),
        selection: Selection | None = None,
    ) -> None:
        self._bags = list(bags)
        self._selection = selection or Selection()
        self._offsets = dict(zip(map(id, bags), offsets_ns or [0] * len(bags), strict=True))
        some = [bag for bag in bags if bag.end_ns >= 0]
        self.start_ns = min((bag.start_ns + self._offset(bag) for bag in some), default=0)
        self.end_ns = max((bag.end_ns + self._offset(bag) for bag in some), default=0)
        chosen = [
            track
            for bag in bags
            for track in bag.tracks.values()
            if self._selection.plays(track.topic)
        ]
        self.recorded: dict[str, set[str]] = {}
        """Names in the bags by the name under which a topic is played."""
        for track in chosen:
            self.recorded.setdefault(self._selection.new_name(track.topic), set()).add(track.topic)
        renamed = [replace(t, topic=self._selection.new_name(t.topic)) for t in chosen]
        self.tracks: dict[str, Track] = merged(renamed, ' and '.join(str(b.path) for b in bags))
        """By the name under which each is played."""

    def leave_out(self, topic: str) -> None:
        """Do not play a topic after all, by the name under which it would be."""
        del self.tracks[topic]
        del self.recorded[topic]

    def messages(self, start_ns: int) -> Iterator[Stored]:
        """Yield the messages received at ``start_ns`` or later; equal times keep their order.

        That is the order of the bags as given, then of their files, then within the file. A file
        is not looked into before its time has come.
        """
        waiting = sorted(
            (max(part.start_ns + offset_ns, start_ns), number, part, offset_ns)
            for number, (part, offset_ns) in enumerate(self._parts())
            if part.end_ns + offset_ns >= start_ns
        )
        waiting.reverse()
        open_parts: list[tuple[int, int, Stored, Iterator[Stored]]] = []
        while waiting or open_parts:
            while waiting and (not open_parts or waiting[-1][0] <= open_parts[0][0]):
                _, number, part, offset_ns = waiting.pop()
                stream = self._shifted(part, offset_ns, start_ns)
                if (first := next(stream, None)) is not None:
                    heapq.heappush(open_parts, (first.stamp_ns, number, first, stream))
            if not open_parts:
                continue
            _, number, message, stream = open_parts[0]
            yield message
            if (following := next(stream, None)) is not None:
                heapq.heapreplace(open_parts, (following.stamp_ns, number, following, stream))
            else:
                heapq.heappop(open_parts)

    def latched_before(self, stamp_ns: int) -> list[Stored]:
        """Return what late listeners would have been told at a time, in order of receipt.

        Of each latched topic the last message, or as many as it had latched publishers.
        """
        found: list[Stored] = []
        for name, track in self.tracks.items():
            if not track.latched:
                continue
            earlier = [
                Stored(message.stamp_ns + offset_ns, name, message.data)
                for part, offset_ns in self._parts()
                for topic in self.recorded[name]
                for message in part.last_before(topic, stamp_ns - offset_ns, track.latched)
            ]
            earlier.sort(key=_stamp)
            found += earlier[-track.latched :]
        return sorted(found, key=_stamp)

    def plan(self, from_ns: int, begin_ns: int, end_ns: int, loop: bool) -> Iterator[Planned]:
        """Yield what is played from ``from_ns`` on: latched topics first, then lap after lap.

        A lap lasts from ``begin_ns`` to ``end_ns``, both included; the next one begins at the
        very time the last one ended, so laps do not drift.
        """
        lap_ns, laps = lap_length(begin_ns, end_ns), 0
        while True:
            begin_at_ns, played = from_ns - begin_ns + laps * lap_ns, 0
            for message in self.latched_before(from_ns):
                yield Planned(begin_at_ns, from_ns, message, restored=True)
            for message in self.messages(from_ns):
                if message.stamp_ns > end_ns:
                    break
                played += 1
                at_ns = message.stamp_ns - begin_ns + laps * lap_ns
                yield Planned(at_ns, message.stamp_ns, message)
            if not loop or (from_ns == begin_ns and not played):
                return
            from_ns, laps = begin_ns, laps + 1

    def close(self) -> None:
        """Let go of the bags."""
        for bag in self._bags:
            bag.close()

    def _parts(self) -> Iterator[tuple[Part, int]]:
        for bag in self._bags:
            for part in bag.parts:
                yield part, self._offset(bag)

    def _offset(self, bag: Bag) -> int:
        return self._offsets[id(bag)]

    def _shifted(self, part: Part, offset_ns: int, start_ns: int) -> Iterator[Stored]:
        names = {recorded: name for name, each in self.recorded.items() for recorded in each}
        for message in part.messages(names.keys(), start_ns - offset_ns):
            yield Stored(message.stamp_ns + offset_ns, names[message.topic], message.data)


def lap_length(begin_ns: int, end_ns: int) -> int:
    """Return how long one lap takes at rate 1."""
    return max(end_ns - begin_ns, SHORTEST_LAP_NS)


def aligned(bags: Sequence[Bag]) -> list[int]:
    """Return the offsets that let every bag begin when the first one does."""
    return [bags[0].start_ns - bag.start_ns if bag.end_ns >= 0 else 0 for bag in bags]


def check_cdr(track: Track) -> None:
    """Raise :class:`RecordError` for a topic whose bytes are not what ROS 2 sends."""
    if track.encoding != 'cdr':
        raise RecordError(f'its messages are {track.encoding}, not cdr')


def _stamp(message: Stored) -> int:
    return message.stamp_ns
