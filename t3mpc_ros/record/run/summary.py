# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The summary of an MCAP file, read at once.

The library reads it number by number; of a short chunk with dozens of topics that takes longer
than to unpack and to decode the chunk. Layouts follow the MCAP specification (foxglove/mcap,
``website/docs/spec/index.md``); what is not said here is left to the library.
"""

from collections.abc import Mapping
from io import SEEK_END, BytesIO
import struct
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import read_magic
from mcap.summary import Summary
import numpy as np

_HEAD = struct.Struct('<BQ')
_FOOTER = struct.Struct('<QQI8s')
_PLACES = struct.Struct('<QQQQI')
_SIZES = struct.Struct('<QQ')
_LENGTH = struct.Struct('<I')
_OFFSETS = np.dtype([('channel', '<u2'), ('offset', '<u8')])
_OTHERS: Mapping[int, Any] = {
    Opcode.STATISTICS: Statistics,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}


def read_summary(file: BinaryIO) -> Summary | None:
    """Return the summary of a finished file; None when it has none.

    Raises
    ------
    ValueError
        The file does not end as a finished one does, or a record is torn. Bytes that are damaged
        in another way may raise what the library raises.
    """
    file.seek(0)
    read_magic(ReadDataStream(file))
    end = file.seek(-_HEAD.size - _FOOTER.size, SEEK_END)
    opcode, _ = _HEAD.unpack(file.read(_HEAD.size))
    start, _, _, _ = _FOOTER.unpack(file.read(_FOOTER.size))
    if opcode != Opcode.FOOTER:
        raise ValueError('it does not end with a footer')
    if start == 0:
        return None
    file.seek(start)
    section = file.read(max(end - start, 0))
    found = Summary()
    at = 0
    while at < len(section):
        opcode, size = _HEAD.unpack_from(section, at)
        body = section[at + _HEAD.size : at + _HEAD.size + size]
        if len(body) != size:
            raise ValueError('a record of the summary is torn')
        at += _HEAD.size + size
        if opcode == Opcode.CHUNK_INDEX:
            found.chunk_indexes.append(_chunk_index(body))
        elif opcode in _OTHERS:
            _keep(found, _OTHERS[opcode].read(ReadDataStream(BytesIO(body))))
    return found


def read_tables(file: BinaryIO, summary: Summary) -> dict[str, Mapping[str, str]]:
    """Return the tables of text of a file by title; of one title the newest.

    Raises
    ------
    ValueError
        An index leads to something else.
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
    first, last, offset, length, wide = _PLACES.unpack_from(body)
    rest = _PLACES.size + wide
    offsets = np.frombuffer(body, _OFFSETS, wide // _OFFSETS.itemsize, _PLACES.size)
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


def _keep(found: Summary, record: Any) -> None:
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
