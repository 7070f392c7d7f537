# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Opens the chunks of an MCAP file: whole ones by their checksum, torn ones as far as they go."""

from collections.abc import Iterator
from dataclasses import dataclass
import struct
from typing import Any
import zlib

import lz4.frame
import zstandard

from t3mpc_ros.record.recovery.layout import HEAD, Window

_FIXED = struct.Struct('<QQQII')  # start, end, size, checksum, length of the compression's name
_NAME_LIMIT = 32


class ChunkError(ValueError):
    """A chunk of which nothing can be trusted; the text says why."""


@dataclass(frozen=True)
class OpenChunk:
    """The records of one chunk, decompressed."""

    data: bytes
    whole: bool
    checked: bool
    """Whether a checksum vouches for the data."""

    def records(self) -> Iterator[tuple[int, memoryview]]:
        """Yield (opcode, content) of each record that is there in full.

        What is left over behind them comes last, as opcode 0.
        """
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


def chunk_span(window: Window, start: int) -> tuple[int, int] | None:
    """Return the times of the first and last message as the chunk at ``start`` says, in ns.

    None when it does not say, or says what cannot be.
    """
    head = window.read(start + HEAD.size, 16)
    if len(head) < 16:
        return None
    first, last = struct.unpack('<QQ', head)
    return (first, last) if first <= last < 2**63 else None


def open_chunk(window: Window, start: int) -> OpenChunk:
    """Return the content of the chunk at ``start``; of one cut off, what can be had.

    Raises
    ------
    ChunkError
        The compression is not known, the data do not decompress, or they are not what the
        checksum, or for want of one the size, says.
    """
    position = start + HEAD.size
    head = window.read(position, _FIXED.size)
    if len(head) < _FIXED.size:
        raise ChunkError('the file ends inside the head of a chunk')
    _, _, size, checksum, name_length = _FIXED.unpack(head)
    position += _FIXED.size
    name = window.read(position, min(name_length, _NAME_LIMIT))
    position += name_length
    prefix = window.read(position, 8)
    if len(prefix) < 8:
        raise ChunkError('the file ends inside the head of a chunk')
    length = int.from_bytes(prefix, 'little')
    stored = window.read(position + 8, length)
    data, finished = _decompress(name, stored)
    if len(stored) < length:
        return OpenChunk(data, whole=False, checked=False)
    if not finished:
        raise ChunkError('the data of a chunk stop before their end')
    if checksum:
        if zlib.crc32(data) != checksum:
            raise ChunkError('the checksum of a chunk is wrong')
    elif len(data) != size:
        raise ChunkError(f'a chunk has {len(data)} bytes instead of {size}')
    return OpenChunk(data, whole=True, checked=checksum != 0)


def _decompress(name: bytes, stored: bytes) -> tuple[bytes, bool]:
    """Return what can be had of ``stored``, and whether that is all of it.

    Sizes written in the chunk are not believed: nothing is allocated that does not come out.
    """
    if name == b'':
        return stored, True
    decoder: Any
    if name == b'zstd':
        decoder = zstandard.ZstdDecompressor().decompressobj()
    elif name == b'lz4':
        decoder = lz4.frame.LZ4FrameDecompressor()
    else:
        raise ChunkError(f'the compression of a chunk is unknown: {name!r}')
    if not stored:
        return b'', False
    try:
        data = bytes(decoder.decompress(stored))
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise ChunkError(f'a chunk does not decompress: {error}') from error
    return data, bool(decoder.eof)
