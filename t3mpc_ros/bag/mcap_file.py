# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Complete MCAP files: topics, messages, metadata records and attachments.

The ``mcap`` library parses the records. It does not verify the checksum of the summary or of an
attachment, accepts fields that end early, skips unknown records silently, rejects the intact
beginning of a truncated chunk, and constructs an object for each record of a chunk, which takes
several times as long as unpacking its head.
"""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from io import SEEK_END, BytesIO
from operator import attrgetter
from pathlib import Path
import re
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
import zstandard

from t3mpc_ros.bag.metadata import NO_START_NS, BagMetadata, FileInformation, TopicInformation
from t3mpc_ros.bag.qos import QosError, QosProfile, profiles_from_yaml
from t3mpc_ros.bag.schema import BagError

MCAP_SUFFIX = '.mcap'
MAGIC = b'\x89MCAP0\r\n'
HEAD = struct.Struct('<BQ')
"""Opcode and content length of every record."""
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, sequence, log time and publish time before the data of a message."""
FOOTER = struct.Struct('<QQI')
"""Start of the summary, start of its offsets, checksum of the summary."""
END_NS = 2**64
"""After every stamp."""
MESSAGE_OVERHEAD = 256
"""Memory of a message in addition to its data, bytes."""

_MESSAGE = struct.Struct('<BQHIQQ')  # head of a record and of its message
_CHUNK_HEAD = struct.Struct('<QQQII')  # start, end, size, checksum, length of the compression name
_NAME_LIMIT = 32


class SerializedMessage(NamedTuple):
    """Message as CDR bytes; stamps in nanoseconds since 1970."""

    topic: str
    received_ns: int
    published_ns: int
    data: bytes

    @property
    def memory_size(self) -> int:
        """Memory of the message, bytes."""
        return len(self.data) + MESSAGE_OVERHEAD


RECEIVE_TIME = attrgetter('received_ns')


@dataclass(frozen=True, slots=True)
class Attachment:
    """File stored inside a bag, such as the model file of a controller."""

    name: str
    media_type: str
    data: bytes
    modified_ns: int = 0
    """Modification time, nanoseconds since 1970; 0 = unknown."""


class FileWindow:
    """Random access to a file of fixed size; reads after its end are empty."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self.size = size

    def read(self, start: int, count: int) -> bytes:
        """Return up to ``count`` bytes from ``start``."""
        count = min(count, self.size - start)
        if count <= 0:
            return b''
        self._file.seek(start)
        return self._file.read(count)


class RecordError(ValueError):
    """A record is incomplete or damaged."""


def read_record(window: FileWindow, start: int) -> tuple[Any, int]:
    """Return the record of the library at ``start`` and its end.

    Raises
    ------
    RecordError
        No complete and valid record begins there. The data of chunks and messages are not checked.
    """
    head = window.read(start, HEAD.size)
    opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
    end = start + HEAD.size + length
    name = record_name(opcode)
    if end > window.size:
        raise RecordError(f'the file ends inside a {name}')
    return parse_record(opcode, window.read(start + HEAD.size, length)), end


def parse_record(opcode: int, content: bytes) -> Any:
    """Return a record of the library, whose fields must have the lengths that they state.

    Raises
    ------
    RecordError
        The record is damaged, or its type is unknown.
    """
    name, head = record_name(opcode), HEAD.pack(opcode, len(content))
    stream = BytesIO(head + content)
    try:
        record = next(StreamReader(stream, True, emit_chunks=True, record_size_limit=None).records)
    except Exception as error:  # the library raises anything on damaged bytes
        raise RecordError(f'a {name} cannot be read: {error or type(error).__name__}') from error
    builder = RecordBuilder()
    record.write(builder)
    fields = bytes(builder.end()[HEAD.size :])
    if opcode == Opcode.ATTACHMENT:
        fields = fields[:-4]
        if int.from_bytes(content[-4:], 'little') not in (0, zlib.crc32(content[:-4])):
            raise RecordError('the checksum of an attachment is wrong')
    # Later versions of the format may append fields, but not to the end of a file.
    ends = opcode in (Opcode.DATA_END, Opcode.FOOTER)
    if not content.startswith(fields) or (ends and len(content) > len(fields)):
        raise RecordError(f'the lengths in a {name} are inconsistent')
    return record


def record_name(opcode: int) -> str:
    """Return the name of a record type."""
    try:
        return str(Opcode(opcode).name).lower().replace('_', ' ')
    except ValueError:
        return f'record of unknown type 0x{opcode:02x}'


@dataclass(frozen=True)
class DecodedChunk:
    """Decompressed records of one chunk."""

    data: bytes
    complete: bool
    checked: bool
    """Whether a checksum covers the data."""

    def records(self) -> Iterator[tuple[int, memoryview]]:
        """Yield (opcode, content) of each complete record, then the rest as opcode 0."""
        view = memoryview(self.data)
        position = 0
        while position + HEAD.size <= len(view):
            opcode, length = HEAD.unpack_from(view, position)
            end = position + HEAD.size + length
            if end > len(view):
                break
            yield opcode, view[position + HEAD.size : end]
            position = end
        if position < len(view):
            yield 0, view[position:]


def chunk_end(window: FileWindow, start: int) -> int:
    """Return the end of the chunk at ``start`` by the lengths of its fields; 0 if unknown."""
    name_length = window.read(start + HEAD.size + _CHUNK_HEAD.size - 4, 4)
    position = start + HEAD.size + _CHUNK_HEAD.size + int.from_bytes(name_length, 'little')
    prefix = window.read(position, 8)
    return position + 8 + int.from_bytes(prefix, 'little') if len(prefix) == 8 else 0


def decode_chunk(window: FileWindow, start: int) -> DecodedChunk:
    """Return the content of the chunk at ``start``; of a truncated chunk, the beginning.

    Raises
    ------
    RecordError
        The compression is unknown, decompression fails, or the checksum, or without a checksum
        the size, is wrong.
    """
    end = chunk_end(window, start)
    if not end:
        raise RecordError('the file ends inside the head of a chunk')
    position = start + HEAD.size
    _, _, size, checksum, name_length = _CHUNK_HEAD.unpack(window.read(position, _CHUNK_HEAD.size))
    position += _CHUNK_HEAD.size
    name = window.read(position, min(name_length, _NAME_LIMIT))
    position += name_length + 8
    data, finished = _decompress(name, window.read(position, end - position))
    if end > window.size:
        return DecodedChunk(data, complete=False, checked=False)
    if not finished:
        raise RecordError('the compressed data of a chunk are incomplete')
    if checksum:
        if zlib.crc32(data) != checksum:
            raise RecordError('the checksum of a chunk is wrong')
    elif len(data) != size:
        raise RecordError(f'a chunk has {len(data)} bytes instead of {size}')
    return DecodedChunk(data, complete=True, checked=checksum != 0)


def _decompress(name: bytes, stored: bytes) -> tuple[bytes, bool]:
    """Return the decompressed bytes of ``stored``, and whether they are complete.

    Memory is allocated by the actual output, not by the sizes in the chunk, which may be damaged.
    """
    if name == b'':
        return stored, True
    decoder: Any
    if name == b'zstd':
        decoder = zstandard.ZstdDecompressor().decompressobj()
    elif name == b'lz4':
        decoder = lz4.frame.LZ4FrameDecompressor()
    else:
        raise RecordError(f'the compression of a chunk is unknown: {name!r}')
    if not stored:
        return b'', False
    try:
        data = bytes(decoder.decompress(stored))
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise RecordError(f'a chunk does not decompress: {error}') from error
    return data, bool(decoder.eof)


def read_summary(window: FileWindow) -> tuple[Summary, int] | None:
    """Return the summary of a file and its start; None if it is missing or damaged."""
    footer_start = window.size - len(MAGIC) - FOOTER.size - HEAD.size
    tail = window.read(max(footer_start, 0), window.size)
    footer = tail[: HEAD.size] == HEAD.pack(Opcode.FOOTER, FOOTER.size)
    if not footer or tail[-len(MAGIC) :] != MAGIC:
        return None
    start, _, checksum = FOOTER.unpack(tail[HEAD.size : -len(MAGIC)])
    content = window.read(start or footer_start, window.size)
    if checksum and zlib.crc32(content[: -len(MAGIC) - 4]) != checksum:
        return None
    summary = Summary()
    lists = {
        ChunkIndex: summary.chunk_indexes,
        AttachmentIndex: summary.attachment_indexes,
        MetadataIndex: summary.metadata_indexes,
    }
    try:
        for record in StreamReader(BytesIO(content), skip_magic=True).records:
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
            elif isinstance(record, Statistics):
                summary.statistics = record
            elif type(record) in lists:
                lists[type(record)].append(record)
    except Exception:  # the library raises anything on damaged bytes
        return None
    return summary, start or footer_start


class McapFile:
    """Complete MCAP file; returned by :func:`read_mcap_file`. It is open only while it is read."""

    def __init__(
        self, path: Path, summary: Summary, metadata_records: Mapping[str, Mapping[str, str]]
    ) -> None:
        self.path = path
        self._summary = summary
        self.metadata_records = metadata_records
        """Tables of text by title; the newest of each title."""
        statistics: Any = summary.statistics
        self.message_count: int = statistics.message_count
        some = self.message_count > 0
        self.start_ns: int = statistics.message_start_time if some else 0
        self.end_ns: int = statistics.message_end_time if some else -1
        """Receive time of the last message; before the start if there is no message."""
        counts = statistics.channel_message_counts
        self.topics = [
            TopicInformation(
                channel.topic,
                summary.schemas[channel.schema_id].name if channel.schema_id else '',
                _profiles(channel.metadata.get('offered_qos_profiles', '')),
                channel.metadata.get('topic_type_hash', ''),
                counts.get(channel.id, 0),
                channel.message_encoding,
            )
            for channel in summary.channels.values()
        ]
        self.damaged: dict[int, int] = {}
        """Number of messages, of all topics, in skipped chunks, by position of the chunk."""

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int = 0,
        stop_ns: int = END_NS,
        skip_damaged: bool = False,
    ) -> Iterator[SerializedMessage]:
        """Yield the messages of ``topics`` from ``start_ns`` until before ``stop_ns``.

        They are in order of receipt, with equal times in the order of the file. Damaged chunks
        are an error, or with ``skip_damaged`` counted in :attr:`damaged`.

        Raises
        ------
        BagError
            The file is damaged.
        """
        channels = self._summary.channels.values()
        names = {
            each.id: each.topic for each in channels if topics is None or each.topic in topics
        }
        with self.path.open('rb') as file, read_errors(str(self.path)):
            if not self._indexed():
                for _, channel, message in NonSeekingReader(file).iter_messages(
                    set(names.values()), starting_at=max(start_ns, 0), ending_before=stop_ns
                ):
                    stamps = message.log_time, message.publish_time
                    yield SerializedMessage(channel.topic, *stamps, bytes(message.data))
                return
            window = FileWindow(file, file.seek(0, SEEK_END))
            chunks = [
                each
                for each in self._summary.chunk_indexes
                if each.message_end_time >= start_ns
                and each.message_start_time < stop_ns
                and not names.keys().isdisjoint(each.message_index_offsets or names)
            ]
            chunks.sort(key=lambda each: (each.message_start_time, each.chunk_start_offset))
            starts = [each.message_start_time for each in chunks[1:]] + [END_NS]
            pending: list[SerializedMessage] = []
            for chunk, next_start_ns in zip(chunks, starts, strict=False):
                try:
                    pending += _chunk_messages(window, chunk, names, start_ns, stop_ns)
                except RecordError:
                    if not skip_damaged:
                        raise
                    self.damaged[chunk.chunk_start_offset] = _message_count(window, chunk)
                pending.sort(key=RECEIVE_TIME)
                count = bisect_left(pending, next_start_ns, key=RECEIVE_TIME)
                yield from pending[:count]
                del pending[:count]

    def definition(self, type_name: str) -> str:
        """Return the ``ros2msg`` definition of a message type; empty if the file has none."""
        for schema in self._summary.schemas.values():
            if schema.name == type_name and schema.encoding == 'ros2msg':
                return bytes(schema.data).decode()
        return ''

    def attachments(self) -> list[tuple[int, Attachment]]:
        """Return the attachments, each with the time at which it was read.

        Raises
        ------
        BagError
            An attachment is damaged.
        """
        with self.path.open('rb') as file, read_errors(f'the attachments of {self.path}'):
            window = FileWindow(file, file.seek(0, SEEK_END))
            found = []
            for index in self._summary.attachment_indexes:
                try:
                    item, _ = read_record(window, index.offset)
                except RecordError as error:
                    text = f'the attachment {index.name} of {self.path} is damaged'
                    raise BagError(text) from error
                copy = Attachment(item.name, item.media_type, item.data, item.create_time)
                found.append((item.log_time, copy))
            return found

    def attachment_sizes(self) -> list[tuple[str, str, int]]:
        """Return name, media type and size in bytes of each attachment."""
        indexes = self._summary.attachment_indexes
        return [(item.name, item.media_type, item.data_size) for item in indexes]

    def _indexed(self) -> bool:
        """Return whether every message is in a chunk with an index."""
        statistics: Any = self._summary.statistics
        return bool(statistics.chunk_count == len(self._summary.chunk_indexes) > 0)


def _chunk_messages(
    window: FileWindow, index: Any, names: Mapping[int, str], start_ns: int, stop_ns: int
) -> list[SerializedMessage]:
    """Return the selected messages of one chunk."""
    chunk = decode_chunk(window, index.chunk_start_offset)
    if not chunk.complete:
        raise RecordError('the file ends inside a chunk')
    found = []
    data = chunk.data + bytes(_MESSAGE.size)
    position, end = 0, len(chunk.data)
    while position < end:
        opcode, length, channel, _, received_ns, published_ns = _MESSAGE.unpack_from(
            data, position
        )
        begin, position = position + _MESSAGE.size, position + HEAD.size + length
        if position > end:
            raise RecordError('a record of a chunk is truncated')
        if opcode == Opcode.MESSAGE and channel in names and start_ns <= received_ns < stop_ns:
            message = data[begin:position]
            found.append(SerializedMessage(names[channel], received_ns, published_ns, message))
    return found


def _message_count(window: FileWindow, index: Any) -> int:
    """Return the number of messages of a chunk by its message indexes."""
    return sum(
        (int.from_bytes(window.read(offset + 1, 8), 'little') - 6) // 16
        for offset in index.message_index_offsets.values()
    )


def read_mcap_file(path: Path) -> McapFile | None:
    """Return a complete file; None if it is incomplete or its summary is damaged.

    Only the end of the file and its metadata records are read.
    """
    try:
        with path.open('rb') as file:
            window = FileWindow(file, file.seek(0, SEEK_END))
            found = read_summary(window) if window.read(0, len(MAGIC)) == MAGIC else None
            if found is None or found[0].statistics is None:
                return None
            summary = found[0]
            items = [read_record(window, each.offset)[0] for each in summary.metadata_indexes]
            records = {item.name: dict(item.metadata) for item in items}
            records.pop('rosbag2', None)
            return McapFile(path, summary, records)
    except (OSError, RecordError, AttributeError):  # an offset may lead to another record
        return None


def has_mcap_magic(path: Path) -> bool:
    """Return whether a file begins as an MCAP file."""
    with path.open('rb') as file:
        return file.read(len(MAGIC)) == MAGIC


def find_files(folder: Path) -> tuple[list[McapFile], tuple[str, ...]]:
    """Return the complete MCAP files of a folder, and the names of the incomplete ones.

    Files are sorted by their first message, as players expect.
    """
    paths = sorted(folder.glob(f'*{MCAP_SUFFIX}'), key=lambda path: _natural_sort_key(path.name))
    found = {path: read_mcap_file(path) for path in paths}
    complete = [file for file in found.values() if file is not None]
    complete.sort(key=lambda file: file.start_ns if file.message_count else NO_START_NS)
    return complete, tuple(path.name for path, file in found.items() if file is None)


def collect_metadata(folder: Path) -> tuple[BagMetadata, tuple[str, ...]]:
    """Return the metadata of the complete MCAP files of ``folder``, and the incomplete files.

    A topic has one entry per distinct list of offered profiles: rosbags finds the messages of a
    file only under the profiles stored in that file.
    """
    complete, incomplete = find_files(folder)
    files = []
    topics: dict[tuple[object, ...], TopicInformation] = {}
    for file in complete:
        count, span = file.message_count, file.end_ns - file.start_ns
        name = file.path.name
        files.append(
            FileInformation(name, file.start_ns, span, count) if count else FileInformation(name)
        )
        for topic in file.topics:
            key = (topic.name, topic.type_name, topic.offered_qos_profiles, topic.type_hash)
            topics[key] = topics[key].merged(topic) if key in topics else topic
    return BagMetadata(tuple(files), tuple(topics.values())), incomplete


@contextmanager
def read_errors(what: str, error_type: Callable[[str], BagError] = BagError) -> Iterator[None]:
    """Convert the errors of the libraries for damaged files to a :class:`BagError`."""
    try:
        yield
    except BagError:
        raise
    except Exception as error:  # parsers and decompressors raise anything on damaged bytes
        text = str(error) or type(error).__name__
        raise error_type(f'{what} cannot be read: {text}') from error


@cache
def _profiles(text: str) -> tuple[QosProfile, ...]:
    """Return the profiles of a channel; none if another program wrote unknown policies."""
    try:
        return profiles_from_yaml(text)
    except QosError:
        return ()


def _natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that places ``run_10`` after ``run_9``."""
    return [
        (int(part), '') if part.isdecimal() else (-1, part) for part in re.split(r'(\d+)', name)
    ]
