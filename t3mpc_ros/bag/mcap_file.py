# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Summary of an MCAP file, and completion of a file whose writer was interrupted.

A file without its summary section, because the writer was killed or the disk was full, is rejected
by ordinary readers, although every chunk written so far is intact.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import io
import os
from pathlib import Path
import struct
from typing import Any
import zlib

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk

from t3mpc_ros.bag.schema import BagError

MCAP_SUFFIX = '.mcap'
SPARE = 65_536
"""Bytes that :func:`finalize_file` leaves free on a full disk, for ``metadata.yaml``."""
MAGIC = b'\x89MCAP0\r\n'

_HEAD = struct.Struct('<BQ')  # opcode and length of every record
_FOOTER_SIZE = _HEAD.size + 20


@dataclass(frozen=True)
class ChannelSummary:
    """Topic of a file, with the unparsed metadata of its channel."""

    topic: str
    type_name: str
    profiles_text: str
    type_hash: str
    encoding: str
    message_count: int


@dataclass(frozen=True)
class FileSummary:
    """Content of the summary section of a complete file."""

    message_count: int
    start_ns: int
    end_ns: int
    channels: tuple[ChannelSummary, ...]
    metadata_records: Mapping[str, Mapping[str, str]]
    """Metadata records by name."""


def read_file_summary(path: Path) -> FileSummary | None:
    """Return the summary of a file; None if it is incomplete or its summary is damaged.

    Only the end of the file is read; its checksum is verified.
    """
    try:
        with path.open('rb') as file:
            if not _has_valid_end(file):
                return None
            file.seek(0)
            reader = make_reader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return None
            counts = summary.statistics.channel_message_counts
            return FileSummary(
                message_count=summary.statistics.message_count,
                start_ns=summary.statistics.message_start_time,
                end_ns=summary.statistics.message_end_time,
                channels=tuple(
                    ChannelSummary(
                        channel.topic,
                        _schema_name(summary.schemas.get(channel.schema_id)),
                        channel.metadata.get('offered_qos_profiles', ''),
                        channel.metadata.get('topic_type_hash', ''),
                        channel.message_encoding,
                        counts.get(channel.id, 0),
                    )
                    for channel in summary.channels.values()
                ),
                metadata_records={
                    item.name: dict(item.metadata) for item in reader.iter_metadata()
                },
            )
    except Exception:  # the parser of the library raises anything on damaged bytes
        return None


def finalize_file(path: Path) -> int:
    """Truncate an incomplete file at its last intact chunk, append the summary, count messages.

    Messages of the last, unwritten chunk are lost. If the disk is full, chunks are removed from
    the end until the summary fits and :data:`SPARE` bytes remain free. A complete file is not
    changed.

    Returns
    -------
    int
        Number of messages in the file.

    Raises
    ------
    BagError
        The file is not MCAP, or was not written by :class:`~t3mpc_ros.bag.writer.BagWriter`.
    OSError
        The file is not writable, or the disk has no room for an empty summary.
    """
    if (summary := read_file_summary(path)) is not None:
        return summary.message_count
    with open_unbuffered(path, 'r+b') as file:
        parts = list(_intact_parts(file))
        if not parts:
            raise BagError(f'{path} does not begin with the MCAP magic')
        while True:
            start = parts[-1].end
            try:
                file.truncate(start)
                file.seek(start)
                end = _end_of_file(parts, start)
                spare = SPARE if len(parts) > 1 else 0  # the last part cannot be removed
                write_all(file, end + bytes(spare))
                os.fsync(file.fileno())
                file.truncate(start + len(end))
            except OSError:
                file.truncate(start)
                if len(parts) == 1:
                    raise
                parts.pop()
                continue
            return sum(sum(part.counts.values()) for part in parts)


def open_unbuffered(path: Path, mode: str) -> Any:
    """Open ``path`` without a buffer, so that each write succeeds or fails immediately."""
    return path.open(mode, buffering=0)


def write_all(file: Any, data: bytes) -> None:
    """Write all of ``data`` to an unbuffered file, whose writes may be partial."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def _schema_name(schema: Any) -> str:
    return '' if schema is None else str(schema.name)


@dataclass
class _IntactPart:
    """Intact part of a file that ends at ``end``: header, metadata, attachment or chunk."""

    end: int
    schemas: list[Any] = field(default_factory=list)
    channels: list[Any] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    chunk: Any = None
    metadata: Any = None
    attachment: Any = None


def _has_valid_end(file: Any) -> bool:
    size = file.seek(0, io.SEEK_END)
    end = _FOOTER_SIZE + len(MAGIC)
    if size < len(MAGIC) + end:
        return False
    file.seek(size - end)
    tail = file.read(end)
    opcode, length = _HEAD.unpack_from(tail)
    start, _, crc = struct.unpack_from('<QQI', tail, _HEAD.size)
    if tail[-8:] != MAGIC or opcode != Opcode.FOOTER or length != 20 or start == 0:
        return False
    file.seek(start)
    covered = file.read(size - start - len(MAGIC) - 4)  # all but the checksum itself
    sound = crc in (0, zlib.crc32(covered))
    file.seek(0)
    return sound and file.read(len(MAGIC)) == MAGIC


def _records(file: Any) -> Iterator[tuple[int, int, bytes]]:
    """Yield (start, opcode, content) of each complete record."""
    size = file.seek(0, io.SEEK_END)
    position = len(MAGIC)
    while position + _HEAD.size <= size:
        file.seek(position)
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if position + _HEAD.size + length > size:
            return
        yield position, opcode, file.read(length)
        position += _HEAD.size + length


def _intact_parts(file: Any) -> Iterator[_IntactPart]:
    """Yield the intact parts; a chunk is intact if all of its message indexes follow it.

    Raises
    ------
    BagError
        The structure of the file is not that of ``BagWriter``: truncating it at the last known
        part could remove intact messages.
    """
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return
    waiting: _IntactPart | None = None
    for start, opcode, content in _records(file):
        end = start + _HEAD.size + len(content)
        stream = ReadDataStream(io.BytesIO(content))
        if opcode in _FOREIGN or (opcode == Opcode.CHUNK and waiting):
            raise BagError(
                'only files of BagWriter can be finalized: this file differs in structure'
            )
        if opcode == Opcode.HEADER:
            yield _IntactPart(end)
        elif opcode == Opcode.METADATA:
            name = Metadata.read(stream).name
            yield _IntactPart(end, metadata=MetadataIndex(start, end - start, name))
        elif opcode == Opcode.ATTACHMENT:
            try:
                yield _IntactPart(end, attachment=_attachment_index(start, end, content))
            except Exception:  # the parser of the library raises anything on damaged bytes
                return
        elif opcode == Opcode.CHUNK:
            try:
                waiting = _open_chunk(start, end, Chunk.read(stream))
            except Exception:  # the decompressor raises anything on damaged bytes
                return
        elif opcode == Opcode.MESSAGE_INDEX and waiting:
            channel = MessageIndex.read(stream).channel_id
            waiting.chunk.message_index_offsets[channel] = start
            waiting.end = end
            if waiting.chunk.message_index_offsets.keys() == waiting.counts.keys():
                waiting.chunk.message_index_length = (
                    end - waiting.chunk.chunk_start_offset - waiting.chunk.chunk_length
                )
                yield waiting
                waiting = None
        else:  # end of the data section, or a preallocated block
            return


def _open_chunk(start: int, end: int, chunk: Any) -> _IntactPart:
    part = _IntactPart(end)
    for record in breakup_chunk(chunk, validate_crc=True):
        if isinstance(record, Message):
            part.counts[record.channel_id] = part.counts.get(record.channel_id, 0) + 1
        elif isinstance(record, Channel):
            part.channels.append(record)
        elif isinstance(record, Schema):
            part.schemas.append(record)
    part.chunk = ChunkIndex(
        chunk_length=end - start,
        chunk_start_offset=start,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )
    return part


def _attachment_index(start: int, end: int, content: bytes) -> AttachmentIndex:
    """Return the index of an attachment, or raise ValueError if its checksum is wrong."""
    if zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], 'little'):
        raise ValueError('an attachment is damaged')
    item = Attachment.read(ReadDataStream(io.BytesIO(content)))
    return AttachmentIndex(
        create_time=item.create_time,
        data_size=len(item.data),
        length=end - start,
        log_time=item.log_time,
        media_type=item.media_type,
        name=item.name,
        offset=start,
    )


def _end_of_file(parts: list[_IntactPart], start: int) -> bytes:
    """Return the data-end record, the summary section and the footer."""
    chunks = [part.chunk for part in parts if part.chunk]
    schemas = [schema for part in parts for schema in part.schemas]
    channels = [channel for part in parts for channel in part.channels]
    metadata = [part.metadata for part in parts if part.metadata]
    attachments = [part.attachment for part in parts if part.attachment]
    counts: dict[int, int] = {}
    for part in parts:
        for channel, count in part.counts.items():
            counts[channel] = counts.get(channel, 0) + count
    statistics = Statistics(
        attachment_count=len(attachments),
        channel_count=len(channels),
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
        message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
        metadata_count=len(metadata),
        schema_count=len(schemas),
    )
    head, body = RecordBuilder(), RecordBuilder()
    DataEnd(0).write(head)
    head_bytes = head.end()
    summary_start = start + len(head_bytes)
    offsets = []
    for group in (schemas, channels, [statistics], chunks, attachments, metadata):
        before = body.count
        for record in group:
            record.write(body)
        if group:
            opcode = _OPCODES[type(group[0])]
            offsets.append(SummaryOffset(opcode, summary_start + before, body.count - before))
    offset_start = summary_start + body.count
    for offset in offsets:
        offset.write(body)
    body_bytes = body.end()
    footer = _HEAD.pack(Opcode.FOOTER, 20) + struct.pack('<QQ', summary_start, offset_start)
    crc = zlib.crc32(footer, zlib.crc32(body_bytes))
    tail = RecordBuilder()
    Footer(summary_start, offset_start, crc).write(tail)
    return bytes(head_bytes + body_bytes + tail.end() + MAGIC)


_FOREIGN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_OPCODES = {
    Schema: Opcode.SCHEMA,
    Channel: Opcode.CHANNEL,
    Statistics: Opcode.STATISTICS,
    ChunkIndex: Opcode.CHUNK_INDEX,
    AttachmentIndex: Opcode.ATTACHMENT_INDEX,
    MetadataIndex: Opcode.METADATA_INDEX,
}
