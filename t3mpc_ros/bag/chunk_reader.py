# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Index of a bag, and its messages as blocks of undecoded bytes.

MCAP files with chunk indexes are read chunk by chunk; any other bag is read through ``rosbags``
and converted to the same blocks. The summary section is parsed here because the ``mcap`` library
reads it number by number, which takes longer than decompressing a short chunk. Record layouts
follow the MCAP specification (foxglove/mcap, ``website/docs/spec/index.md``).
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import SEEK_END, BytesIO
from pathlib import Path
import struct
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import get_chunk_data_stream, read_magic
from mcap.summary import Summary
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.writer import DataError

_HEAD = struct.Struct('<BQ')
_FOOTER = struct.Struct('<QQI8s')
_CHUNK_HEAD = struct.Struct('<QQQQI')
_SIZES = struct.Struct('<QQ')
_LENGTH = struct.Struct('<I')
_OFFSETS = np.dtype([('channel', '<u2'), ('offset', '<u8')])
_RECORD_TYPES: Mapping[int, Any] = {
    Opcode.STATISTICS: Statistics,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}


def read_summary(file: BinaryIO) -> Summary | None:
    """Return the summary section of a complete file; None if the file has none.

    Raises
    ------
    ValueError
        The file does not end with a footer, or a record is truncated. Other damage may raise
        errors of the library.
    """
    file.seek(0)
    read_magic(ReadDataStream(file))
    end = file.seek(-_HEAD.size - _FOOTER.size, SEEK_END)
    opcode, _ = _HEAD.unpack(file.read(_HEAD.size))
    start, _, _, _ = _FOOTER.unpack(file.read(_FOOTER.size))
    if opcode != Opcode.FOOTER:
        raise ValueError('the file does not end with a footer')
    if start == 0:
        return None
    if start > end:  # seek() itself raises OSError beyond 2^63, which is no error of the disk
        raise ValueError('its summary starts behind its end')
    file.seek(start)
    section = file.read(max(end - start, 0))
    found = Summary()
    at = 0
    while at < len(section):
        opcode, size = _HEAD.unpack_from(section, at)
        body = section[at + _HEAD.size : at + _HEAD.size + size]
        if len(body) != size:
            raise ValueError('a record of the summary is truncated')
        at += _HEAD.size + size
        if opcode == Opcode.CHUNK_INDEX:
            found.chunk_indexes.append(_chunk_index(body))
        elif opcode in _RECORD_TYPES:
            _add_record(found, _RECORD_TYPES[opcode].read(ReadDataStream(BytesIO(body))))
    return found


def read_metadata_records(file: BinaryIO, summary: Summary) -> dict[str, Mapping[str, str]]:
    """Return the metadata records of a file by title; the newest of each title.

    Raises
    ------
    ValueError
        An index does not point to a metadata record.
    """
    tables: dict[str, Mapping[str, str]] = {}
    for index in summary.metadata_indexes:
        file.seek(index.offset)
        opcode, size = _HEAD.unpack(file.read(_HEAD.size))
        if opcode != Opcode.METADATA or size > index.length:
            raise ValueError(f'the index of {index.name} is damaged')
        item = Metadata.read(ReadDataStream(BytesIO(file.read(size))))
        tables[item.name] = dict(item.metadata)
    return tables


def _chunk_index(body: bytes) -> ChunkIndex:
    first, last, offset, length, map_size = _CHUNK_HEAD.unpack_from(body)
    rest = _CHUNK_HEAD.size + map_size
    offsets = np.frombuffer(body, _OFFSETS, map_size // _OFFSETS.itemsize, _CHUNK_HEAD.size)
    (index_length,) = struct.unpack_from('<Q', body, rest)
    (size,) = _LENGTH.unpack_from(body, rest + 8)
    text = rest + 8 + _LENGTH.size
    compressed, uncompressed = _SIZES.unpack_from(body, text + size)
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=offset,
        compression=body[text : text + size].decode(),
        compressed_size=compressed,
        message_end_time=last,
        message_index_length=index_length,
        message_index_offsets=dict(
            zip(offsets['channel'].tolist(), offsets['offset'].tolist(), strict=True)
        ),
        message_start_time=first,
        uncompressed_size=uncompressed,
    )


def _add_record(found: Summary, record: Any) -> None:
    if isinstance(record, Statistics):
        found.statistics = record
    elif isinstance(record, Schema):
        found.schemas[record.id] = record
    elif isinstance(record, Channel):
        found.channels[record.id] = record
    elif isinstance(record, AttachmentIndex):
        found.attachment_indexes.append(record)
    else:
        found.metadata_indexes.append(record)


MessageOffsets = list[tuple[str, bytes]]
"""Topic and, for each of its messages, two little-endian 64-bit numbers as in the message index:
the time of receipt (ns) and the offset of the record in the block. A record has opcode and length
(9 bytes), channel and sequence number (6), receive and publish stamps (16), then the CDR data."""
Blocks = Iterator[tuple[bytes, MessageOffsets]]

_INDEX = struct.Struct('<BQHI')


@dataclass(frozen=True)
class BagIndex:
    """Topics, metadata records and files of a bag, read without reading a message."""

    types: Mapping[str, str]
    """Message type by topic."""
    counts: Mapping[str, int]
    """Number of messages by topic."""
    metadata_records: Mapping[str, Mapping[str, str]]
    """Tables of text by title; the newest of each title."""
    start_ns: int
    """Receive time of the first message."""
    files: tuple[tuple[Path, Any], ...]
    """Each with its MCAP summary; None for files without chunk indexes."""


def read_bag_index(bag: Path) -> BagIndex:
    """Return the index of a bag, a folder or a single file.

    All complete MCAP files of a folder are included, as in
    :func:`~t3mpc_ros.bag.reader.open_bag`.

    Raises
    ------
    BagError
        The bag does not exist or is damaged.
    """
    paths = [bag] if bag.is_file() else sorted(bag.glob(f'*{MCAP_SUFFIX}'))
    tables: dict[str, Mapping[str, str]] = {}
    found = [(path, *_summary(path, alone=bag.is_file())) for path in paths]
    found = [each for each in found if each[1] is not None]
    files = tuple((path, summary) for path, summary, _ in found)
    if not files or not all(_is_indexed(summary) for _, summary in files):
        return _index_through_rosbags(bag)
    types: dict[str, str] = {}
    counts: dict[str, int] = {}
    starts = []
    for _, summary, own in sorted(found, key=lambda file: _start_ns(file[1])):
        if summary.statistics.message_count:
            starts.append(_start_ns(summary))
        for channel in summary.channels.values():
            types[channel.topic] = summary.schemas[channel.schema_id].name
            count = summary.statistics.channel_message_counts.get(channel.id, 0)
            counts[channel.topic] = counts.get(channel.topic, 0) + count
        tables |= own
    return BagIndex(types, counts, tables, min(starts, default=0), files)


def read_blocks(path: Path, summary: Any, topics: Collection[str]) -> Blocks:
    """Yield the blocks of one file of a :class:`BagIndex`, with the messages of ``topics``.

    Raises
    ------
    BagError
        The file is damaged.
    """
    return (
        _blocks_through_rosbags(path, topics)
        if summary is None
        else _indexed_blocks(path, summary, topics)
    )


def read_attachment_data(index: BagIndex) -> dict[str, bytes]:
    """Return the attachments of a bag by name; the newest of each name."""
    found: dict[str, bytes] = {}
    for path, summary in index.files:
        if summary is not None and summary.attachment_indexes:
            with path.open('rb') as file, _read_errors(path):
                for item in make_reader(file).iter_attachments():
                    found[item.name] = item.data
    return found


def _summary(path: Path, *, alone: bool) -> tuple[Any, dict[str, Mapping[str, str]]]:
    """Return the summary and the metadata records of a file.

    The summary is None for an incomplete file of a folder; ``alone`` makes it an error.
    """
    tables: dict[str, Mapping[str, str]] = {}
    if path.suffix != MCAP_SUFFIX:
        return None, tables
    with path.open('rb') as file:
        try:
            with _read_errors(path):
                summary = read_summary(file)
        except BagError:
            if alone:
                raise
            return None, tables
        if summary is not None:
            with _read_errors(path):
                tables |= read_metadata_records(file, summary)
                tables.pop('rosbag2', None)
    return summary, tables


def _index_through_rosbags(bag: Path) -> BagIndex:
    with open_bag(bag) as reader:
        types = {name: topic.type_name for name, topic in reader.topics.items()}
        counts = {name: topic.message_count for name, topic in reader.topics.items()}
        return BagIndex(types, counts, reader.metadata_records, reader.start_ns, ((bag, None),))


def _start_ns(summary: Any) -> int:
    return int(summary.statistics.message_start_time)


def _is_indexed(summary: Any) -> bool:
    """Return whether every message is in a chunk with an index."""
    statistics, chunks = summary.statistics, summary.chunk_indexes
    if statistics is None or statistics.chunk_count != len(chunks):
        return False
    if not chunks:
        return bool(statistics.message_count == 0)
    return all(chunk.message_index_offsets for chunk in chunks)


def _indexed_blocks(path: Path, summary: Any, topics: Collection[str]) -> Blocks:
    names = {item.id: item.topic for item in summary.channels.values() if item.topic in topics}
    with path.open('rb') as file, _read_errors(path):
        for index in sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset):
            offsets = index.message_index_offsets
            if names.keys().isdisjoint(offsets):
                continue
            file.seek(index.chunk_start_offset)
            raw = file.read(index.chunk_length + index.message_index_length)
            found: MessageOffsets = []
            for channel, offset in offsets.items():
                if channel in names:
                    at = offset - index.chunk_start_offset
                    opcode, _, owner, size = _INDEX.unpack_from(raw, at)
                    pairs = raw[at + _INDEX.size : at + _INDEX.size + size]
                    complete = len(pairs) == size and size % 16 == 0
                    if opcode != Opcode.MESSAGE_INDEX or owner != channel or not complete:
                        raise DataError(f'{path}: the index of {names[channel]} is damaged')
                    found.append((names[channel], pairs))
            yield _decompress_chunk(raw[: index.chunk_length]), found


def _decompress_chunk(record: bytes) -> bytes:
    """Return the records of a chunk, with its checksum verified."""
    stream, length = get_chunk_data_stream(
        Chunk.read(ReadDataStream(BytesIO(record[9:]))), validate_crc=True
    )
    data: bytes = stream.read(length)
    return data


def _blocks_through_rosbags(path: Path, topics: Collection[str]) -> Blocks:
    """Yield the messages of a bag that only ``rosbags`` reads, as one block."""
    rows: dict[str, bytearray] = {}
    data = bytearray()
    with _read_errors(path):
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        with reader:
            selected = [item for item in reader.connections if item.topic in topics]
            for connection, received_ns, message in reader.messages(selected):
                pair = struct.pack('<qq', received_ns, len(data))
                rows.setdefault(connection.topic, bytearray()).extend(pair)
                # rosbags does not return the publish stamp.
                head = (Opcode.MESSAGE, 22 + len(message), 0, 0, received_ns, received_ns)
                data += struct.pack('<BQHIQQ', *head) + message
    yield bytes(data), [(name, bytes(pairs)) for name, pairs in rows.items()]


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Convert the errors of the libraries for a damaged file to :class:`BagError`."""
    try:
        yield
    except (BagError, OSError):
        raise
    except Exception as error:  # parsers and decompressors raise anything on damaged bytes
        raise BagError(f'{path} cannot be read: {error}') from error
