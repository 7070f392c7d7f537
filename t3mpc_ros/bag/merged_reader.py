# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Serialized messages of several bags, filtered, remapped and merged by time of receipt."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
import heapq
from pathlib import Path
import struct
from typing import Any, NamedTuple

from rosbags.rosbag2 import Reader, ReaderError

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, read_file_summary
from t3mpc_ros.bag.metadata import METADATA_FILE_NAME, collect_metadata
from t3mpc_ros.bag.qos import TRANSIENT_LOCAL, UNLIMITED, QosProfile
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.topic_filter import PlayTopicFilter
from t3mpc_ros.geometry.types import NANOSECONDS

SQLITE_SUFFIX = '.db3'

_FIRST_LOOKBACK_NS = NANOSECONDS
"""How far back from a time the first look for earlier messages goes; each next one goes twice."""


class StoredMessage(NamedTuple):
    """One recorded message."""

    stamp_ns: int
    """When it was received."""
    topic: str
    data: bytes


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag, and what its publishers offered."""

    topic: str
    type_name: str
    profiles: tuple[QosProfile, ...]
    message_count: int
    encoding: str = 'cdr'

    @property
    def latched(self) -> int:
        """How many publishers kept their last message for those who come late."""
        return sum(profile.durability == TRANSIENT_LOCAL for profile in self.profiles)


class BagFile:
    """One file of a bag, or a bag that can only be read as a whole, open for reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _read_errors(path):
            self._reader = Reader(path)
            self._reader.open()
        count = self._reader.message_count
        self.start_ns: int = self._reader.start_time if count else 0
        self.end_ns: int = self._reader.end_time - 1 if count else -1  # rosbags' end is exclusive
        self.tracks = [_recorded_topic(connection) for connection in self._reader.connections]

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int | None = None
    ) -> Iterator[StoredMessage]:
        """Yield the messages of some topics from ``start_ns``, before ``stop_ns``, by receipt.

        Raises
        ------
        BagError
            The file is damaged.
        """
        chosen = [item for item in self._reader.connections if item.topic in topics]
        if not chosen or start_ns > self.end_ns:
            return  # none chosen would mean all to the library
        with _read_errors(self.path):
            for item, stamp_ns, data in self._reader.messages(chosen, start_ns, stop_ns):
                yield StoredMessage(stamp_ns, item.topic, bytes(data))

    def last_before(self, topic: str, stamp_ns: int, count: int) -> list[StoredMessage]:
        """Return the last ``count`` messages of a topic before a time, or all that there are."""
        stop_ns, look_ns = min(stamp_ns, self.end_ns + 1), _FIRST_LOOKBACK_NS
        found: list[StoredMessage] = []
        while len(found) < count and stop_ns > self.start_ns:
            start_ns = max(stop_ns - look_ns, self.start_ns)
            found = [*self.messages([topic], start_ns, stop_ns), *found]
            stop_ns, look_ns = start_ns, 2 * look_ns
        return found[-count:]

    def close(self) -> None:
        """Let go of the file."""
        self._reader.close()


class SerializedBag:
    """A bag that is open for playing; made by :func:`open_bag`.

    A bag that was split, or continued, is several files whose times may overlap a little.
    """

    def __init__(self, path: Path, parts: list[BagFile], unfinished: tuple[str, ...]) -> None:
        self.path = path
        self.parts = parts
        self.unfinished = unfinished
        """Files that broke off and are not played."""
        some = [part for part in parts if part.end_ns >= 0]
        self.start_ns = min((part.start_ns for part in some), default=0)
        self.end_ns = max((part.end_ns for part in some), default=-1)
        """When the last message came; before the start when there is none."""
        self.tracks = merge_topics([track for part in parts for track in part.tracks], str(path))

    def close(self) -> None:
        """Let go of the files."""
        for part in self.parts:
            part.close()


def open_serialized_bag(path: Path | str) -> SerializedBag:
    """Return the bag in a folder, or in the one file that is given instead.

    Every finished MCAP file of a folder is played, whatever ``metadata.yaml`` says, so that a bag
    whose recorder was killed can be played too. Bags that rosbag2 itself compressed, by file or
    by message, are read through their ``metadata.yaml``.

    Raises
    ------
    BagError
        There is no bag, nothing finished in it, or it is damaged.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise BagError(f'there is no bag {path}')
    files, unfinished = _files(path)
    if not files:
        broken = f'; unfinished: {", ".join(unfinished)}: bag recover mends them'
        raise BagError(f'no finished bag file in {path}{broken if unfinished else ""}')
    return SerializedBag(path, [BagFile(file) for file in files], unfinished)


def merge_topics(tracks: Collection[RecordedTopic], where: str) -> dict[str, RecordedTopic]:
    """Return one track for each topic: counts add up, and so do the different offers.

    Raises
    ------
    BagError
        A topic has two types.
    """
    result: dict[str, RecordedTopic] = {}
    for track in tracks:
        before = result.get(track.topic)
        if before is None:
            result[track.topic] = track
            continue
        if before.type_name != track.type_name:
            raise BagError(
                f'{track.topic} is {before.type_name} and {track.type_name} in {where}: '
                'exclude it, or play one bag at a time'
            )
        new = [profile for profile in track.profiles if profile not in before.profiles]
        result[track.topic] = RecordedTopic(
            track.topic,
            track.type_name,
            (*before.profiles, *new),
            before.message_count + track.message_count,
            before.encoding if before.encoding != 'cdr' else track.encoding,
        )
    return result


def _files(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return what to read one by one, and the names of files that broke off."""
    if path.is_file():
        if path.suffix == MCAP_SUFFIX and read_file_summary(path) is None:
            return [], (path.name,)
        return [path], ()
    if (path / METADATA_FILE_NAME).is_file() and _is_compressed(path):
        return [path], ()
    metadata, unfinished = collect_metadata(path)
    found = [path / file.path for file in metadata.files]
    found += sorted(path.glob(f'*{SQLITE_SUFFIX}'))
    return found, unfinished


def _is_compressed(folder: Path) -> bool:
    """Whether rosbag2 compressed files or messages, which only ``metadata.yaml`` tells."""
    try:
        with Reader(folder) as reader:
            return bool(reader.compression_format)
    except Exception:  # damaged or stale: the files speak for themselves
        return False


def _recorded_topic(connection: Any) -> RecordedTopic:
    return RecordedTopic(
        connection.topic,
        connection.msgtype,
        tuple(map(_qos_profile, connection.ext.offered_qos_profiles)),
        connection.msgcount,
        connection.ext.serialization_format,
    )


def _qos_profile(offered: Any) -> QosProfile:
    return QosProfile(
        history=offered.history.name.lower(),
        depth=max(0, offered.depth),
        reliability=offered.reliability.name.lower(),
        durability=offered.durability.name.lower(),
        deadline_ns=_nanoseconds(offered.deadline),
        lifespan_ns=_nanoseconds(offered.lifespan),
        liveliness=offered.liveliness.name.lower(),
        liveliness_lease_ns=_nanoseconds(offered.liveliness_lease_duration),
        avoid_ros_namespace_conventions=offered.avoid_ros_namespace_conventions,
    )


def _nanoseconds(time: Any) -> int:
    return int(min(time.sec * NANOSECONDS + time.nsec, UNLIMITED))


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file does to the reading library into one error of ours."""
    try:
        yield
    except BagError:
        raise
    except (ReaderError, OSError, struct.error, ValueError, KeyError, IndexError) as error:
        raise BagError(f'{path} cannot be read: {error}') from error
    except Exception as error:  # decompressors and the database have roots of their own
        raise BagError(f'{path} cannot be read: {type(error).__name__}: {error}') from error


MIN_LOOP_NS = 10_000_000
"""A bag of a single instant would otherwise be played again and again without end at once."""


class ScheduledMessage(NamedTuple):
    """A message and where it belongs."""

    at_ns: int
    """Time since the beginning of the first lap, on which laps follow each other."""
    stamp_ns: int
    """What time it is in the bag when the message is played."""
    message: StoredMessage
    restored: bool = False
    """Whether it is from before the start: what a latched topic still held then."""


class MergedReader:
    """The chosen topics of some bags, merged by time of receipt.

    Parameters
    ----------
    bags
        Open bags; closed by :meth:`close`.
    offsets_ns
        Added to every stamp of the bag in the same place.

    Raises
    ------
    BagError
        A topic has different types in two bags, under the name under which it is played.
    """

    def __init__(
        self,
        bags: Sequence[SerializedBag],
        offsets_ns: Sequence[int] = (),
        selection: PlayTopicFilter | None = None,
    ) -> None:
        self._bags = list(bags)
        self._selection = selection or PlayTopicFilter()
        self._offsets = dict(zip(map(id, bags), offsets_ns or [0] * len(bags), strict=True))
        some = [bag for bag in bags if bag.end_ns >= 0]
        self.start_ns = min((bag.start_ns + self._offset(bag) for bag in some), default=0)
        self.end_ns = max((bag.end_ns + self._offset(bag) for bag in some), default=0)
        chosen = [
            track
            for bag in bags
            for track in bag.tracks.values()
            if self._selection.selects(track.topic)
        ]
        self.recorded: dict[str, set[str]] = {}
        """Names in the bags by the name under which a topic is played."""
        for track in chosen:
            self.recorded.setdefault(self._selection.remapped_name(track.topic), set()).add(
                track.topic
            )
        renamed = [replace(t, topic=self._selection.remapped_name(t.topic)) for t in chosen]
        self.tracks: dict[str, RecordedTopic] = merge_topics(
            renamed, ' and '.join(str(b.path) for b in bags)
        )
        """By the name under which each is played."""

    def exclude_topic(self, topic: str) -> None:
        """Do not play a topic after all, by the name under which it would be."""
        del self.tracks[topic]
        del self.recorded[topic]

    def messages(self, start_ns: int) -> Iterator[StoredMessage]:
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
        open_parts: list[tuple[int, int, StoredMessage, Iterator[StoredMessage]]] = []
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

    def latched_messages_before(self, stamp_ns: int) -> list[StoredMessage]:
        """Return what late listeners would have been told at a time, in order of receipt.

        Of each latched topic the last message, or as many as it had latched publishers.
        """
        found: list[StoredMessage] = []
        for name, track in self.tracks.items():
            if not track.latched:
                continue
            earlier = [
                StoredMessage(message.stamp_ns + offset_ns, name, message.data)
                for part, offset_ns in self._parts()
                for topic in self.recorded[name]
                for message in part.last_before(topic, stamp_ns - offset_ns, track.latched)
            ]
            earlier.sort(key=_stamp_of)
            found += earlier[-track.latched :]
        return sorted(found, key=_stamp_of)

    def plan(
        self, from_ns: int, begin_ns: int, end_ns: int, loop: bool
    ) -> Iterator[ScheduledMessage]:
        """Yield what is played from ``from_ns`` on: latched topics first, then lap after lap.

        A lap lasts from ``begin_ns`` to ``end_ns``, both included; the next one begins at the
        very time the last one ended, so laps do not drift.
        """
        loop_ns, loops = loop_duration_ns(begin_ns, end_ns), 0
        while True:
            begin_at_ns, played = from_ns - begin_ns + loops * loop_ns, 0
            for message in self.latched_messages_before(from_ns):
                yield ScheduledMessage(begin_at_ns, from_ns, message, restored=True)
            for message in self.messages(from_ns):
                if message.stamp_ns > end_ns:
                    break
                played += 1
                at_ns = message.stamp_ns - begin_ns + loops * loop_ns
                yield ScheduledMessage(at_ns, message.stamp_ns, message)
            if not loop or (from_ns == begin_ns and not played):
                return
            from_ns, loops = begin_ns, loops + 1

    def close(self) -> None:
        """Let go of the bags."""
        for bag in self._bags:
            bag.close()

    def _parts(self) -> Iterator[tuple[BagFile, int]]:
        for bag in self._bags:
            for part in bag.parts:
                yield part, self._offset(bag)

    def _offset(self, bag: SerializedBag) -> int:
        return self._offsets[id(bag)]

    def _shifted(self, part: BagFile, offset_ns: int, start_ns: int) -> Iterator[StoredMessage]:
        names = {recorded: name for name, each in self.recorded.items() for recorded in each}
        for message in part.messages(names.keys(), start_ns - offset_ns):
            yield StoredMessage(message.stamp_ns + offset_ns, names[message.topic], message.data)


def loop_duration_ns(begin_ns: int, end_ns: int) -> int:
    """Return how long one lap takes at rate 1."""
    return max(end_ns - begin_ns, MIN_LOOP_NS)


def alignment_offsets_ns(bags: Sequence[SerializedBag]) -> list[int]:
    """Return the offsets that let every bag begin when the first one does."""
    return [bags[0].start_ns - bag.start_ns if bag.end_ns >= 0 else 0 for bag in bags]


def require_cdr(track: RecordedTopic) -> None:
    """Raise :class:`BagError` for a topic whose bytes are not what ROS 2 sends."""
    if track.encoding != 'cdr':
        raise BagError(f'its messages are {track.encoding}, not cdr')


def _stamp_of(message: StoredMessage) -> int:
    return message.stamp_ns
