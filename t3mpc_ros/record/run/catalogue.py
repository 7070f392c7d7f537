# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a bag holds, and its messages in blocks of bytes, without opening a single one.

MCAP files with chunks and their indexes are read so; what else ``rosbags`` can read takes its
slower way to the same blocks.
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
import struct
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.record.mcap_file import SUFFIX
from t3mpc_ros.record.reader import open_recording
from t3mpc_ros.record.run.summary import read_summary, read_tables
from t3mpc_ros.record.schema import RecordError
from t3mpc_ros.record.writer import DataError

Found = list[tuple[str, bytes]]
"""Topic, and of each of its messages two numbers of 8 bytes, little-endian, as they are in the
file: time of receipt (ns), and where in a block it begins: opcode and length (9 bytes), channel
and counter (6), receipt and publication (16), then what was serialised."""
Blocks = Iterator[tuple[bytes, Found]]

_INDEX = struct.Struct('<BQHI')


@dataclass(frozen=True)
class Catalogue:
    """What a bag holds, as far as it can be told without opening a message."""

    types: Mapping[str, str]
    """Message type by topic."""
    counts: Mapping[str, int]
    """Messages by topic."""
    details: Mapping[str, Mapping[str, str]]
    """Tables of text by title; of one title the newest."""
    start_ns: int
    """Receipt of the first message."""
    files: tuple[tuple[Path, Any], ...]
    """Each with its MCAP summary; None where messages are not in chunks with indexes."""


def catalogue(bag: Path) -> Catalogue:
    """Return what is in a bag: its folder, or a single file.

    Of a folder every finished MCAP file counts, as for
    :func:`~t3mpc_ros.record.reader.open_recording`.

    Raises
    ------
    RecordError
        There is no bag, or one that is damaged.
    """
    paths = [bag] if bag.is_file() else sorted(bag.glob(f'*{SUFFIX}'))
    tables: dict[str, Mapping[str, str]] = {}
    found = [(path, *_summary(path, alone=bag.is_file())) for path in paths]
    found = [each for each in found if each[1] is not None]
    files = tuple((path, summary) for path, summary, _ in found)
    if not files or not all(_indexed(summary) for _, summary in files):
        return _slow_catalogue(bag)
    types: dict[str, str] = {}
    counts: dict[str, int] = {}
    starts = []
    for _, summary, own in sorted(found, key=lambda file: _start(file[1])):
        if summary.statistics.message_count:
            starts.append(_start(summary))
        for channel in summary.channels.values():
            types[channel.topic] = summary.schemas[channel.schema_id].name
            count = summary.statistics.channel_message_counts.get(channel.id, 0)
            counts[channel.topic] = counts.get(channel.topic, 0) + count
        tables |= own
    return Catalogue(types, counts, tables, min(starts, default=0), files)


def blocks(path: Path, summary: Any, topics: Collection[str]) -> Blocks:
    """Yield the blocks of one file of a :class:`Catalogue`, and what they hold of some topics.

    Raises
    ------
    RecordError
        The file is damaged.
    """
    return _slowly(path, topics) if summary is None else _chunks(path, summary, topics)


def attachments(held: Catalogue) -> dict[str, bytes]:
    """Return the files that are kept in a bag, by name; of one name the newest."""
    found: dict[str, bytes] = {}
    for path, summary in held.files:
        if summary is not None and summary.attachment_indexes:
            with path.open('rb') as file, _readable(path):
                for item in make_reader(file).iter_attachments():
                    found[item.name] = item.data
    return found


def _summary(path: Path, *, alone: bool) -> tuple[Any, dict[str, Mapping[str, str]]]:
    """Return the summary of a file, and its tables of text by title.

    The summary is None for a file of a folder that has none: it broke off.
    """
    tables: dict[str, Mapping[str, str]] = {}
    if path.suffix != SUFFIX:
        return None, tables
    with path.open('rb') as file:
        try:
            with _readable(path):
                summary = read_summary(file)
        except RecordError:
            if alone:
                raise
            return None, tables
        if summary is not None:
            with _readable(path):
                tables |= read_tables(file, summary)
                tables.pop('rosbag2', None)
    return summary, tables


def _slow_catalogue(bag: Path) -> Catalogue:
    with open_recording(bag) as recording:
        types = {name: topic.type_name for name, topic in recording.topics.items()}
        counts = {name: topic.message_count for name, topic in recording.topics.items()}
        return Catalogue(types, counts, recording.details, recording.start_ns, ((bag, None),))


def _start(summary: Any) -> int:
    return int(summary.statistics.message_start_time)


def _indexed(summary: Any) -> bool:
    """Decide whether every message is in a chunk with an index."""
    counted, chunks = summary.statistics, summary.chunk_indexes
    if counted is None or counted.chunk_count != len(chunks):
        return False
    if not chunks:
        return bool(counted.message_count == 0)
    return all(chunk.message_index_offsets for chunk in chunks)


def _chunks(path: Path, summary: Any, topics: Collection[str]) -> Blocks:
    names = {item.id: item.topic for item in summary.channels.values() if item.topic in topics}
    with path.open('rb') as file, _readable(path):
        for index in sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset):
            offsets = index.message_index_offsets
            if names.keys().isdisjoint(offsets):
                continue
            file.seek(index.chunk_start_offset)
            raw = file.read(index.chunk_length + index.message_index_length)
            found: Found = []
            for channel, offset in offsets.items():
                if channel in names:
                    at = offset - index.chunk_start_offset
                    opcode, _, owner, size = _INDEX.unpack_from(raw, at)
                    pairs = raw[at + _INDEX.size : at + _INDEX.size + size]
                    whole = len(pairs) == size and size % 16 == 0
                    if opcode != Opcode.MESSAGE_INDEX or owner != channel or not whole:
                        raise DataError(f'{path}: the index of {names[channel]} is damaged')
                    found.append((names[channel], pairs))
            yield _opened(raw[: index.chunk_length]), found


def _opened(record: bytes) -> bytes:
    """Return what a chunk holds, its checksum verified."""
    stream, length = get_chunk_data_stream(
        Chunk.read(ReadDataStream(BytesIO(record[9:]))), validate_crc=True
    )
    data: bytes = stream.read(length)
    return data


def _slowly(path: Path, topics: Collection[str]) -> Blocks:
    """Yield one block in the form of a chunk from whatever ``rosbags`` can read."""
    rows: dict[str, bytearray] = {}
    data = bytearray()
    with _readable(path):
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        with reader:
            chosen = [item for item in reader.connections if item.topic in topics]
            for connection, received_ns, message in reader.messages(chosen):
                pair = struct.pack('<qq', received_ns, len(data))
                rows.setdefault(connection.topic, bytearray()).extend(pair)
                # When it was published nobody says.
                head = (Opcode.MESSAGE, 22 + len(message), 0, 0, received_ns, received_ns)
                data += struct.pack('<BQHIQQ', *head) + message
    yield bytes(data), [(name, bytes(pairs)) for name, pairs in rows.items()]


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn what the libraries raise for a damaged file into :class:`RecordError`."""
    try:
        yield
    except (RecordError, OSError):
        raise
    except Exception as error:  # torn bytes can fail anywhere in parsers and decompressors
        raise RecordError(f'{path} cannot be read: {error}') from error
