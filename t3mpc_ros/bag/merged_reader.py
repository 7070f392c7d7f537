# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Serialized messages of several bags, filtered, remapped and merged by time of receipt.

MCAP and sqlite3 bags are read through the ``rosbags`` library, which reads only the chunks (MCAP)
or index rows (sqlite3) of the requested time range.
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
import heapq
from pathlib import Path
import struct
from typing import Any, NamedTuple

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, ReaderError

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, read_file_summary
from t3mpc_ros.bag.metadata import METADATA_FILE_NAME, collect_metadata
from t3mpc_ros.bag.qos import TRANSIENT_LOCAL, UNLIMITED, QosProfile
from t3mpc_ros.bag.recovery.scanner import ChunkError, FileWindow, decode_chunk
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.topic_filter import PlayTopicFilter
from t3mpc_ros.geometry.types import NANOSECONDS

SQLITE_SUFFIX = '.db3'

_FIRST_LOOKBACK_NS = NANOSECONDS
"""First time range of a backward search; each further range is twice as long."""
MIN_LOOP_NS = 10_000_000
"""Minimum duration of a loop, for bags whose messages all have the same stamp."""


class StoredMessage(NamedTuple):
    """Recorded message as CDR bytes."""

    stamp_ns: int
    """Time of receipt."""
    topic: str
    data: bytes


@dataclass(frozen=True)
class RecordedTopic:
    """Topic of a bag, with the QoS profiles of its publishers."""

    topic: str
    type_name: str
    offered_qos_profiles: tuple[QosProfile, ...]
    message_count: int
    encoding: str = 'cdr'

    @property
    def transient_local_count(self) -> int:
        """Number of transient-local publishers."""
        return sum(p.durability == TRANSIENT_LOCAL for p in self.offered_qos_profiles)


class ScheduledMessage(NamedTuple):
    """Message with its position on the playback timeline."""

    at_ns: int
    """Time since the beginning of the first loop; loops are consecutive."""
    stamp_ns: int
    """Bag time at which the message is played."""
    message: StoredMessage
    restored: bool = False
    """Whether it is a transient-local message from before the start of the playback."""


class ChunkSpan(NamedTuple):
    """Times of the first and the last message of a chunk, and the number of its messages."""

    start_ns: int
    end_ns: int
    message_count: int


class BagFile:
    """Open file of a bag, or open folder of a bag that rosbag2 compressed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged: dict[tuple[int, int], int] = {}
        """Messages, of all topics, in damaged chunks that were skipped, by first and last time."""
        with _read_errors(path):
            self._reader = Reader(path)
            self._reader.open()
        count = self._reader.message_count
        self.start_ns: int = self._reader.start_time if count else 0
        self.end_ns: int = self._reader.end_time - 1 if count else -1  # rosbags' end is exclusive
        self.topics = [_recorded_topic(connection) for connection in self._reader.connections]

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int | None = None
    ) -> Iterator[StoredMessage]:
        """Yield the messages of ``topics`` from ``start_ns`` until before ``stop_ns``.

        A damaged chunk is skipped and counted in :attr:`damaged`.

        Raises
        ------
        BagError
            The file is damaged elsewhere.
        """
        selected = [item for item in self._reader.connections if item.topic in topics]
        if not selected or start_ns > self.end_ns:
            return  # the library would read all topics for an empty selection
        while True:
            last_ns = start_ns
            try:
                with _read_errors(self.path):
                    for item, stamp_ns, data in self._reader.messages(selected, start_ns, stop_ns):
                        last_ns = stamp_ns
                        yield StoredMessage(stamp_ns, item.topic, bytes(data))
                return
            except BagError:
                chunk = self._damaged_chunk(last_ns)
                if chunk is None:
                    raise
                self.damaged[chunk.start_ns, chunk.end_ns] = chunk.message_count
                start_ns = chunk.end_ns + 1

    def _damaged_chunk(self, from_ns: int) -> ChunkSpan | None:
        """Return the first damaged chunk with messages from a time on; None if it is unknown."""
        if self.path.suffix != MCAP_SUFFIX:
            return None
        with self.path.open('rb') as file:
            summary = make_reader(file).get_summary()
            window = FileWindow(file, self.path.stat().st_size)
            indexes = summary.chunk_indexes if summary is not None else []
            for item in sorted(indexes, key=lambda each: each.message_start_time):
                if item.message_end_time < from_ns:
                    continue
                try:
                    decode_chunk(window, item.chunk_start_offset)
                except ChunkError:
                    count = sum(
                        (int.from_bytes(window.read(offset + 1, 8), 'little') - 6) // 16
                        for offset in item.message_index_offsets.values()
                    )
                    return ChunkSpan(item.message_start_time, item.message_end_time, count)
        return None

    def last_before(self, topic: str, stamp_ns: int, count: int) -> list[StoredMessage]:
        """Return the last ``count`` messages of a topic before a time, or fewer if there are."""
        stop_ns, lookback_ns = min(stamp_ns, self.end_ns + 1), _FIRST_LOOKBACK_NS
        found: list[StoredMessage] = []
        while len(found) < count and stop_ns > self.start_ns:
            start_ns = max(stop_ns - lookback_ns, self.start_ns)
            found = [*self.messages([topic], start_ns, stop_ns), *found]
            stop_ns, lookback_ns = start_ns, 2 * lookback_ns
        return found[-count:]

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


class SerializedBag:
    """Open bag for playback; created by :func:`open_serialized_bag`.

    The time ranges of the files of a split or continued bag may overlap.
    """

    def __init__(
        self, path: Path, files: list[BagFile], incomplete_files: tuple[str, ...]
    ) -> None:
        self.path = path
        self.files = files
        self.incomplete_files = incomplete_files
        """Files without a valid end, which are not played."""
        some = [file for file in files if file.end_ns >= 0]
        self.start_ns = min((file.start_ns for file in some), default=0)
        self.end_ns = max((file.end_ns for file in some), default=-1)
        """Receive time of the last message; before the start if there is no message."""
        self.topics = merge_topics([topic for file in files for topic in file.topics], str(path))

    def close(self) -> None:
        """Close the files."""
        for file in self.files:
            file.close()


class MergedReader:
    """Selected topics of several bags, merged by time of receipt.

    Parameters
    ----------
    bags
        Open bags; :meth:`close` closes them.
    offsets_ns
        Offset of the stamps of each bag.
    topic_filter
        Selection and remapping; by default all topics under their recorded names.

    Raises
    ------
    BagError
        A topic has different types in two bags, after remapping.
    """

    def __init__(
        self,
        bags: Sequence[SerializedBag],
        offsets_ns: Sequence[int] = (),
        topic_filter: PlayTopicFilter | None = None,
    ) -> None:
        self._bags = list(bags)
        selection = topic_filter or PlayTopicFilter()
        self._offsets = dict(zip(map(id, bags), offsets_ns or [0] * len(bags), strict=True))
        some = [bag for bag in bags if bag.end_ns >= 0]
        self.start_ns = min((bag.start_ns + self._offset(bag) for bag in some), default=0)
        self.end_ns = max((bag.end_ns + self._offset(bag) for bag in some), default=0)
        selected = [
            topic
            for bag in bags
            for topic in bag.topics.values()
            if selection.matches(topic.topic)
        ]
        self.recorded_names: dict[str, set[str]] = {}
        """Names in the bags by remapped name."""
        for topic in selected:
            name = selection.remapped_name(topic.topic)
            self.recorded_names.setdefault(name, set()).add(topic.topic)
        remapped = [replace(t, topic=selection.remapped_name(t.topic)) for t in selected]
        self.topics: dict[str, RecordedTopic] = merge_topics(
            remapped, ' and '.join(str(b.path) for b in bags)
        )
        """By remapped name."""

    @property
    def damaged_count(self) -> int:
        """Number of messages in damaged chunks that were skipped so far."""
        return sum(sum(file.damaged.values()) for file, _ in self._files())

    def exclude_topic(self, topic: str) -> None:
        """Exclude a topic, given by its remapped name."""
        del self.topics[topic]
        del self.recorded_names[topic]

    def messages(self, start_ns: int) -> Iterator[StoredMessage]:
        """Yield the messages received at ``start_ns`` or later.

        Messages with equal times are in the order of the bags, then of their files, then within
        the file. A file is not read before its start time is reached.
        """
        waiting = sorted(
            (max(file.start_ns + offset_ns, start_ns), number, file, offset_ns)
            for number, (file, offset_ns) in enumerate(self._files())
            if file.end_ns + offset_ns >= start_ns
        )
        waiting.reverse()
        open_files: list[tuple[int, int, StoredMessage, Iterator[StoredMessage]]] = []
        while waiting or open_files:
            while waiting and (not open_files or waiting[-1][0] <= open_files[0][0]):
                _, number, file, offset_ns = waiting.pop()
                stream = self._shifted(file, offset_ns, start_ns)
                if (first := next(stream, None)) is not None:
                    heapq.heappush(open_files, (first.stamp_ns, number, first, stream))
            if not open_files:
                continue
            _, number, message, stream = open_files[0]
            yield message
            if (following := next(stream, None)) is not None:
                heapq.heapreplace(open_files, (following.stamp_ns, number, following, stream))
            else:
                heapq.heappop(open_files)

    def latched_messages_before(self, stamp_ns: int) -> list[StoredMessage]:
        """Return what a late transient-local subscriber receives at a time, in order of receipt.

        For each transient-local topic these are as many messages as it had such publishers.
        """
        found: list[StoredMessage] = []
        for name, topic in self.topics.items():
            count = topic.transient_local_count
            if not count:
                continue
            earlier = [
                StoredMessage(message.stamp_ns + offset_ns, name, message.data)
                for file, offset_ns in self._files()
                for recorded in self.recorded_names[name]
                for message in file.last_before(recorded, stamp_ns - offset_ns, count)
            ]
            earlier.sort(key=_stamp_of)
            found += earlier[-count:]
        return sorted(found, key=_stamp_of)

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
                if message.stamp_ns > end_ns:
                    break
                played += 1
                at_ns = message.stamp_ns - begin_ns + loops * loop_ns
                yield ScheduledMessage(at_ns, message.stamp_ns, message)
            if not loop or (from_ns == begin_ns and not played):
                return
            from_ns, loops = begin_ns, loops + 1

    def close(self) -> None:
        """Close the bags."""
        for bag in self._bags:
            bag.close()

    def _files(self) -> Iterator[tuple[BagFile, int]]:
        for bag in self._bags:
            for file in bag.files:
                yield file, self._offset(bag)

    def _offset(self, bag: SerializedBag) -> int:
        return self._offsets[id(bag)]

    def _shifted(self, file: BagFile, offset_ns: int, start_ns: int) -> Iterator[StoredMessage]:
        names = {recorded: name for name, each in self.recorded_names.items() for recorded in each}
        for message in file.messages(names.keys(), start_ns - offset_ns):
            yield StoredMessage(message.stamp_ns + offset_ns, names[message.topic], message.data)


def open_serialized_bag(path: Path | str) -> SerializedBag:
    """Open the bag in a folder, or a single bag file.

    All complete MCAP files of a folder are played, independently of ``metadata.yaml``, which is
    outdated if the recorder was killed. Bags that rosbag2 compressed, by file or by message, are
    read through their ``metadata.yaml``.

    Raises
    ------
    BagError
        The bag does not exist, has no complete file, or is damaged.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise BagError(f'there is no bag {path}')
    files, incomplete_files = _list_files(path)
    if not files:
        hint = f'; incomplete: {", ".join(incomplete_files)}: run t3mpc bag recover'
        raise BagError(f'no complete bag file in {path}{hint if incomplete_files else ""}')
    return SerializedBag(path, [BagFile(file) for file in files], incomplete_files)


def merge_topics(topics: Collection[RecordedTopic], where: str) -> dict[str, RecordedTopic]:
    """Return one entry per topic, with the sum of the counts and all distinct profiles.

    Raises
    ------
    BagError
        A topic has two types.
    """
    result: dict[str, RecordedTopic] = {}
    for topic in topics:
        before = result.get(topic.topic)
        if before is None:
            result[topic.topic] = topic
            continue
        if before.type_name != topic.type_name:
            raise BagError(
                f'{topic.topic} is {before.type_name} and {topic.type_name} in {where}: '
                'exclude it, or play one bag at a time'
            )
        profiles = before.offered_qos_profiles
        new = [profile for profile in topic.offered_qos_profiles if profile not in profiles]
        result[topic.topic] = RecordedTopic(
            topic.topic,
            topic.type_name,
            (*profiles, *new),
            before.message_count + topic.message_count,
            before.encoding if before.encoding != 'cdr' else topic.encoding,
        )
    return result


def loop_duration_ns(begin_ns: int, end_ns: int) -> int:
    """Return the duration of one loop at rate 1."""
    return max(end_ns - begin_ns, MIN_LOOP_NS)


def alignment_offsets_ns(bags: Sequence[SerializedBag]) -> list[int]:
    """Return the offsets that make all bags begin with the first one."""
    return [bags[0].start_ns - bag.start_ns if bag.end_ns >= 0 else 0 for bag in bags]


def require_cdr(topic: RecordedTopic) -> None:
    """Raise :class:`BagError` for a topic whose messages are not CDR."""
    if topic.encoding != 'cdr':
        raise BagError(f'its messages are {topic.encoding}, not cdr')


def _list_files(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the paths to open, and the names of incomplete files."""
    if path.is_file():
        if path.suffix == MCAP_SUFFIX and read_file_summary(path) is None:
            return [], (path.name,)
        return [path], ()
    if (path / METADATA_FILE_NAME).is_file() and _is_compressed(path):
        return [path], ()
    metadata, incomplete_files = collect_metadata(path)
    found = [path / file.path for file in metadata.files]
    found += sorted(path.glob(f'*{SQLITE_SUFFIX}'))
    return found, incomplete_files


def _is_compressed(folder: Path) -> bool:
    """Return whether rosbag2 compressed files or messages, according to ``metadata.yaml``."""
    try:
        with Reader(folder) as reader:
            return bool(reader.compression_format)
    except Exception:  # damaged or outdated: the files are read without it
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
    """Convert the errors of the reading library to :class:`BagError`."""
    try:
        yield
    except BagError:
        raise
    except (ReaderError, OSError, struct.error, ValueError, KeyError, IndexError) as error:
        raise BagError(f'{path} cannot be read: {error}') from error
    except Exception as error:  # decompressors and sqlite3 have their own exception classes
        raise BagError(f'{path} cannot be read: {type(error).__name__}: {error}') from error


def _stamp_of(message: StoredMessage) -> int:
    return message.stamp_ns
