# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Completion of the writer's own file after a write error, in place because the disk may be full.

For every other file, :func:`~t3mpc_ros.bag.recovery.recover_bag.recover_bag` writes a new one.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
import os
from pathlib import Path
import struct
from typing import Any
import zlib

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from t3mpc_ros.bag.mcap_file import (
    FOOTER,
    HEAD,
    MAGIC,
    FileWindow,
    RecordError,
    decode_chunk,
    has_mcap_magic,
    parse_record,
    read_mcap_file,
    read_record,
)
from t3mpc_ros.bag.schema import BagError

SPARE = 65_536
"""Bytes that :func:`finalize_file` leaves free on a full disk, for ``metadata.yaml``."""

_SUMMARY_OPCODES = {
    Schema: Opcode.SCHEMA,
    Channel: Opcode.CHANNEL,
    Statistics: Opcode.STATISTICS,
    ChunkIndex: Opcode.CHUNK_INDEX,
    AttachmentIndex: Opcode.ATTACHMENT_INDEX,
    MetadataIndex: Opcode.METADATA_INDEX,
}
"""Records of a summary, in its order."""


@dataclass
class _CompletePart:
    """Part of a file that ends at ``end``, with its records of the summary."""

    end: int
    summary: list[Any] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel."""


def finalize_file(path: Path) -> int:
    """Truncate a file of the bag writer after its last complete chunk, and write its summary.

    If the disk is full, chunks are removed from the end until the summary fits and :data:`SPARE`
    bytes remain free. A complete file is not changed.

    Returns
    -------
    int
        Number of messages in the file.

    Raises
    ------
    BagError
        The file is not MCAP.
    OSError
        The file is not writable, or the disk has no room for an empty summary.
    """
    if (complete := read_mcap_file(path)) is not None:
        return complete.message_count
    if not has_mcap_magic(path):
        raise BagError(f'{path} does not begin with the MCAP magic')
    parts = [_CompletePart(len(MAGIC)), *_complete_parts(path)]
    with open_unbuffered(path, 'r+b') as file:
        while True:
            end = parts[-1].end
            try:
                file.truncate(end)
                file.seek(end)
                tail = _end_of_file(parts)
                spare = SPARE if len(parts) > 2 else 0  # the header cannot be removed
                write_all(file, tail + bytes(spare))
                os.fsync(file.fileno())
                file.truncate(end + len(tail))
                os.fsync(file.fileno())  # the spare bytes would hide the end of the file
            except OSError:
                file.truncate(end)
                if len(parts) <= 2:
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


def _complete_parts(path: Path) -> Iterator[_CompletePart]:
    """Yield header, metadata records, attachments and chunks followed by all message indexes."""
    chunk: _CompletePart | None = None
    with path.open('rb') as file:
        window = FileWindow(file, path.stat().st_size)
        start = len(MAGIC)
        while True:
            try:
                record, end = read_record(window, start)
                if isinstance(record, Chunk):
                    chunk = _chunk_part(window, start, end, record)
            except RecordError:
                return
            if isinstance(record, MessageIndex) and chunk:
                index = chunk.summary[-1]
                index.message_index_offsets[record.channel_id] = start
                index.message_index_length = end - chunk.end
                if index.message_index_offsets.keys() == chunk.counts.keys():
                    chunk.end = end
                    yield chunk
                    chunk = None
            elif isinstance(record, Header | Metadata | Attachment):
                yield _CompletePart(end, _indexes(record, start, end - start))
            elif not isinstance(record, Chunk):
                return
            start = end


def _indexes(record: Any, offset: int, length: int) -> list[Any]:
    """Return the records of the summary for a record outside of the chunks."""
    if isinstance(record, Metadata):
        return [MetadataIndex(offset, length, record.name)]
    if isinstance(record, Attachment):
        return [
            AttachmentIndex(
                create_time=record.create_time,
                data_size=len(record.data),
                length=length,
                log_time=record.log_time,
                media_type=record.media_type,
                name=record.name,
                offset=offset,
            )
        ]
    return []


def _chunk_part(window: FileWindow, start: int, end: int, chunk: Chunk) -> _CompletePart:
    """Return a chunk without its message indexes; its own index is the last of the summary."""
    part = _CompletePart(end)
    for opcode, content in decode_chunk(window, start).records():
        if opcode == Opcode.MESSAGE:
            channel = int.from_bytes(content[:2], 'little')
            part.counts[channel] = part.counts.get(channel, 0) + 1
        else:
            part.summary.append(parse_record(opcode, bytes(content)))
    index = ChunkIndex(
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
    part.summary.append(index)
    return part


def _end_of_file(parts: list[_CompletePart]) -> bytes:
    """Return the data-end record, the summary section and the footer."""
    groups: dict[type, list[Any]] = {kind: [] for kind in _SUMMARY_OPCODES}
    counts: dict[int, int] = {}
    for part in parts:
        for record in part.summary:
            groups[type(record)].append(record)
        for channel, count in part.counts.items():
            counts[channel] = counts.get(channel, 0) + count
    chunks = groups[ChunkIndex]
    statistics = Statistics(
        attachment_count=len(groups[AttachmentIndex]),
        channel_count=len(groups[Channel]),
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
        message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
        metadata_count=len(groups[MetadataIndex]),
        schema_count=len(groups[Schema]),
    )
    groups[Statistics] = [statistics]
    head, body, tail = RecordBuilder(), RecordBuilder(), RecordBuilder()
    DataEnd(0).write(head)
    data_end = head.end()
    start = parts[-1].end + len(data_end)
    offsets = []
    for kind, group in groups.items():
        before = body.count
        for record in group:
            record.write(body)
        if group:
            size = body.count - before
            offsets.append(SummaryOffset(_SUMMARY_OPCODES[kind], start + before, size))
    offset_start = start + body.count
    for offset in offsets:
        offset.write(body)
    summary = body.end()
    footer = HEAD.pack(Opcode.FOOTER, FOOTER.size) + struct.pack('<QQ', start, offset_start)
    Footer(start, offset_start, zlib.crc32(footer, zlib.crc32(summary))).write(tail)
    return bytes(data_end + summary + tail.end() + MAGIC)
