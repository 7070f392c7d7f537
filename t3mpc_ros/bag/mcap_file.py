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
"""Complete MCAP files: topics, messages, metadata records and attachments.

The ``mcap`` library parses the records. It does not verify the checksum of the summary or of an
attachment, accepts fields that end early, skips unknown records silently, and constructs an object
for each message of a chunk, which takes four times as long as unpacking its head.
"""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from io import SEEK_END, BytesIO
from operator import attrgetter
from pathlib import Path
import re
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.metadata_yaml import NO_START_NS, BagMetadata, FileInformation, TopicInformation
from t3mpc_ros.bag.qos import QosError, QosProfile, profiles_from_yaml

MCAP_SUFFIX = '.mcap'
MAGIC = b'\x89MCAP0\r\n'
HEAD = struct.Struct('<BQ')
"""Opcode and content length of every record."""
FOOTER = struct.Struct('<QQI')
"""Start of the summary, start of its offsets, checksum of the summary."""
END_NS = 2**64
"""After every stamp."""
MESSAGE_OVERHEAD = 256
"""Memory of a message in addition to its data, bytes."""


_MESSAGE = struct.Struct('<BQHIQQ')  # head of a record and of its message


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


class FileWindow:
    """Random access to a file of fixed size; reads after its end are empty."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = file.seek(0, SEEK_END)

    def read(self, start: int, count: int) -> bytes:
        """Return up to ``count`` bytes from ``start``."""
        count = min(count, self.size - start)
        if count <= 0:
            return b''
        self._file.seek(start)
        return self._file.read(count)


class RecordError(ValueError):
    """A record is incomplete or damaged."""


def read_record(window: FileWindow, start: int, kind: int = 0) -> tuple[Any, int]:
    """Return the record of the library at ``start`` and its end, or raise :class:`RecordError`.

    Its fields have the lengths that they state, and it has the type ``kind`` (0 = any); the data
    of chunks and messages are not checked.
    """
    opcode, end = record_head(window, start)
    name = _record_name(opcode)
    if kind not in (0, opcode):
        raise RecordError(f'a {name} is where the index has a {_record_name(kind)}')
    if end > window.size:
        raise RecordError(f'the file ends inside a {name}')
    content = window.read(start + HEAD.size, end - start - HEAD.size)
    stream = BytesIO(HEAD.pack(opcode, len(content)) + content)
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
    return record, end


def record_head(window: FileWindow, start: int) -> tuple[int, int]:
    """Return opcode and stated end of a record; an opcode of 0 after the last byte."""
    head = window.read(start, HEAD.size)
    opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
    return opcode, start + HEAD.size + length


def _record_name(opcode: int) -> str:
    try:
        return str(Opcode(opcode).name).lower().replace('_', ' ')
    except ValueError:
        return f'record of unknown type 0x{opcode:02x}'


def chunk_data(chunk: records.Chunk) -> bytes:
    """Return the decompressed records of a chunk; raise :class:`RecordError` if it is damaged.

    Its checksum must be right, or without a checksum its size.
    """
    if chunk.compression not in ('', 'lz4', 'zstd'):
        raise RecordError(f'the compression of a chunk is unknown: {chunk.compression!r}')
    try:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    except Exception as error:  # the decompressors raise anything on damaged bytes
        raise RecordError(f'a chunk cannot be decompressed: {error}') from error
    if not chunk.uncompressed_crc and size != chunk.uncompressed_size:
        raise RecordError(f'a chunk has {size} bytes instead of {chunk.uncompressed_size}')
    return bytes(stream.read(size))


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
        records.ChunkIndex: summary.chunk_indexes,
        records.AttachmentIndex: summary.attachment_indexes,
        records.MetadataIndex: summary.metadata_indexes,
    }
    try:
        for record in StreamReader(BytesIO(content), skip_magic=True).records:
            if isinstance(record, records.Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, records.Channel):
                summary.channels[record.id] = record
            elif isinstance(record, records.Statistics):
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
        raise :class:`BagError`, or with ``skip_damaged`` are counted in :attr:`damaged`.
        """
        channels = self._summary.channels.values()
        names = {
            each.id: each.topic for each in channels if topics is None or each.topic in topics
        }
        remedy = f'; `t3mpc bag recover {self.path}` writes what it still holds to a new bag'
        with self.path.open('rb') as file, read_errors(str(self.path), remedy=remedy):
            statistics: Any = self._summary.statistics
            if not statistics.chunk_count == len(self._summary.chunk_indexes) > 0:
                # Not every message is in a chunk with an index.
                for _, channel, message in NonSeekingReader(file).iter_messages(
                    set(names.values()), starting_at=max(start_ns, 0), ending_before=stop_ns
                ):
                    stamps = message.log_time, message.publish_time
                    yield SerializedMessage(channel.topic, *stamps, bytes(message.data))
                return
            window = FileWindow(file)
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
                    self.damaged[chunk.chunk_start_offset] = chunk_message_count(window, chunk)
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

    def attachments(self) -> list[records.Attachment]:
        """Return the attachments."""
        with self.path.open('rb') as file, read_errors(f'the attachments of {self.path}'):
            window = FileWindow(file)
            found = []
            for index in self._summary.attachment_indexes:
                try:
                    found.append(read_record(window, index.offset)[0])
                except RecordError as error:
                    text = f'the attachment {index.name} of {self.path} is damaged'
                    raise BagError(text) from error
            return found

    def attachment_sizes(self) -> list[tuple[str, str, int]]:
        """Return name, media type and size in bytes of each attachment."""
        indexes = self._summary.attachment_indexes
        return [(item.name, item.media_type, item.data_size) for item in indexes]


def _chunk_messages(
    window: FileWindow, index: Any, names: Mapping[int, str], start_ns: int, stop_ns: int
) -> list[SerializedMessage]:
    """Return the selected messages of one chunk."""
    content = chunk_data(read_record(window, index.chunk_start_offset, Opcode.CHUNK)[0])
    found = []
    data = content + bytes(_MESSAGE.size)
    position, end = 0, len(content)
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


def chunk_message_count(window: FileWindow, index: Any) -> int:
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
            window = FileWindow(file)
            found = read_summary(window) if window.read(0, len(MAGIC)) == MAGIC else None
            if found is None or found[0].statistics is None:
                return None
            summary = found[0]
            items = [read_record(window, each.offset)[0] for each in summary.metadata_indexes]
            tables = {item.name: dict(item.metadata) for item in items}
            tables.pop('rosbag2', None)
            return McapFile(path, summary, tables)
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
def read_errors(
    what: str, error_type: Callable[[str], BagError] = BagError, remedy: str = ''
) -> Iterator[None]:
    """Convert the errors of the libraries to a :class:`BagError`, with the remedy for damage."""
    try:
        yield
    except BagError:
        raise
    except Exception as error:  # parsers and decompressors raise anything on damaged bytes
        text = str(error) or type(error).__name__
        text += '' if isinstance(error, OSError) else remedy
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
