# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Scanner for damaged MCAP files: record classification, chunk decoding, resynchronization."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
import re
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.opcode import Opcode
import zstandard

from t3mpc_ros.bag.mcap_file import MAGIC

HEAD = struct.Struct('<BQ')
"""Opcode and length of the content, in front of every record."""
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, sequence, log time and publish time, in front of a message's data."""

_TEXT, _TABLE, _BLOB, _REST = 'text', 'table', 'blob', 'rest'
# Numbers are bytes of fixed fields; text and table have a length of 4 bytes, a blob one of 8.
_RECORD_LAYOUTS: dict[int, tuple[int | str, ...]] = {
    Opcode.HEADER: (_TEXT, _TEXT),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _TEXT, _TEXT, _TEXT),
    Opcode.CHANNEL: (4, _TEXT, _TEXT, _TABLE),
    Opcode.MESSAGE: (MESSAGE_HEAD.size, _REST),
    Opcode.CHUNK: (28, _TEXT, _BLOB),
    Opcode.MESSAGE_INDEX: (2, _TEXT),
    Opcode.CHUNK_INDEX: (32, _TEXT, 8, _TEXT, 16),
    Opcode.ATTACHMENT: (16, _TEXT, _TEXT, _BLOB, 4),
    Opcode.METADATA: (_TEXT, _TABLE),
    Opcode.DATA_END: (4,),
    Opcode.ATTACHMENT_INDEX: (40, _TEXT, _TEXT),
    Opcode.METADATA_INDEX: (16, _TEXT),
    Opcode.STATISTICS: (42, _TEXT),
    Opcode.SUMMARY_OFFSET: (17,),
}
_MAP_SIZE_LIMIT = 2**26  # bytes of a table that are looked into before its length is believed


class FileWindow:
    """A file of fixed size that can be read anywhere; what lies behind its end is empty."""

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


class RecordFit(Enum):
    """How well a place of a file fits a record."""

    SOUND = 'both lengths agree'
    LIKELY = 'nothing speaks against it, but only its own length says where it ends'
    TORN = 'it goes on behind the end of the file'
    MAYBE_TORN = 'it would go on behind the end of the file, if its length can be believed'
    CONTRADICTORY = 'its lengths disagree'
    NONE = 'not a record'


class Classification(NamedTuple):
    """What a place of a file looks like."""

    fit: RecordFit
    opcode: int
    end: int
    """Where the record ends by the length in front of it."""
    inner_end: int
    """Where it ends by its fields; 0 when they do not say."""


def classify_record(window: FileWindow, start: int) -> Classification:
    """Return what the bytes at ``start`` look like, without reading large fields."""
    head = window.read(start, HEAD.size)
    if not head or head[0] == 0:
        return Classification(RecordFit.NONE, 0, 0, 0)
    opcode = head[0]
    layout = _RECORD_LAYOUTS.get(opcode)
    if len(head) < HEAD.size:
        return Classification(RecordFit.TORN if layout else RecordFit.NONE, opcode, 0, 0)
    end = start + HEAD.size + HEAD.unpack(head)[1]
    if layout is None:
        return Classification(
            RecordFit.LIKELY if end <= window.size else RecordFit.NONE, opcode, end, 0
        )
    inner_end = _end_by_fields(window, start + HEAD.size, layout, end)
    if inner_end < 0:  # a table that is none
        fit = RecordFit.CONTRADICTORY if end <= window.size else RecordFit.NONE
        return Classification(fit, opcode, end, 0)
    if end > window.size:
        agree = inner_end in (0, end)
        if layout[-1] == _REST or inner_end == 0:
            return Classification(
                RecordFit.MAYBE_TORN if agree else RecordFit.NONE, opcode, end, inner_end
            )
        return Classification(
            RecordFit.TORN if agree else RecordFit.CONTRADICTORY, opcode, end, inner_end
        )
    if inner_end == end:
        return Classification(
            RecordFit.LIKELY if layout[-1] == _REST else RecordFit.SOUND, opcode, end, inner_end
        )
    # Later versions of the format may append fields, so the inner end may come first.
    fit = (
        RecordFit.LIKELY
        if 0 < inner_end < end and opcode != Opcode.CHUNK
        else RecordFit.CONTRADICTORY
    )
    return Classification(fit, opcode, end, inner_end)


def record_name(opcode: int) -> str:
    """Return what a record is called."""
    if opcode not in _RECORD_LAYOUTS:
        return f'record of unknown kind 0x{opcode:02x}'
    return str(Opcode(opcode).name).lower().replace('_', ' ')


def _end_by_fields(window: FileWindow, start: int, layout: tuple[int | str, ...], end: int) -> int:
    """Return where the fields end: 0 when the file ends before it can be told, -1 never."""
    position = start
    for part in layout:
        if isinstance(part, int):
            position += part
        elif part == _REST:
            return end if position <= end else position
        else:
            width = 8 if part == _BLOB else 4
            prefix = window.read(position, width)
            if len(prefix) < width:
                return 0
            length = int.from_bytes(prefix, 'little')
            position += width
            there = length <= _MAP_SIZE_LIMIT and position + length <= window.size
            if part == _TABLE and there and not _is_string_map(window.read(position, length)):
                return -1
            position += length
    return position


def _is_string_map(data: bytes) -> bool:
    """Return whether ``data`` is a sequence of an even number of whole texts."""
    position = count = 0
    while position < len(data):
        position += 4 + int.from_bytes(data[position : position + 4], 'little')
        count += 1
    return position == len(data) and count % 2 == 0


_CHUNK_HEAD = struct.Struct(
    '<QQQII'
)  # start, end, size, checksum, length of the compression's name
_NAME_LIMIT = 32


class ChunkError(ValueError):
    """A chunk of which nothing can be trusted; the text says why."""


@dataclass(frozen=True)
class DecodedChunk:
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


def chunk_time_range(window: FileWindow, start: int) -> tuple[int, int] | None:
    """Return the times of the first and last message as the chunk at ``start`` says, in ns.

    None when it does not say, or says what cannot be.
    """
    head = window.read(start + HEAD.size, 16)
    if len(head) < 16:
        return None
    first, last = struct.unpack('<QQ', head)
    return (first, last) if first <= last < 2**63 else None


def decode_chunk(window: FileWindow, start: int) -> DecodedChunk:
    """Return the content of the chunk at ``start``; of one cut off, what can be had.

    Raises
    ------
    ChunkError
        The compression is not known, the data do not decompress, or they are not what the
        checksum, or for want of one the size, says.
    """
    position = start + HEAD.size
    head = window.read(position, _CHUNK_HEAD.size)
    if len(head) < _CHUNK_HEAD.size:
        raise ChunkError('the file ends inside the head of a chunk')
    _, _, size, checksum, name_length = _CHUNK_HEAD.unpack(head)
    position += _CHUNK_HEAD.size
    name = window.read(position, min(name_length, _NAME_LIMIT))
    position += name_length
    prefix = window.read(position, 8)
    if len(prefix) < 8:
        raise ChunkError('the file ends inside the head of a chunk')
    length = int.from_bytes(prefix, 'little')
    stored = window.read(position + 8, length)
    data, finished = _decompress(name, stored)
    if len(stored) < length:
        return DecodedChunk(data, whole=False, checked=False)
    if not finished:
        raise ChunkError('the data of a chunk stop before their end')
    if checksum:
        if zlib.crc32(data) != checksum:
            raise ChunkError('the checksum of a chunk is wrong')
    elif len(data) != size:
        raise ChunkError(f'a chunk has {len(data)} bytes instead of {size}')
    return DecodedChunk(data, whole=True, checked=checksum != 0)


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


INDEX_RECORDS = frozenset(
    {
        Opcode.MESSAGE_INDEX,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.STATISTICS,
        Opcode.SUMMARY_OFFSET,
        Opcode.FOOTER,
        Opcode.DATA_END,
    }
)
"""Records that only repeat what others say: their loss costs nothing."""

_BLOCK = 2**20
# A known opcode, and a length below 2^40 bytes; looking ahead, because candidates may overlap.
_CANDIDATE = re.compile(rb'(?=[\x01-\x0f].{5}\x00\x00\x00|' + re.escape(MAGIC) + rb')', re.DOTALL)
_TORN_LIMIT = 2**28  # bytes of a record that the end of the file may have torn in its head


class Span(NamedTuple):
    """A stretch of the file: one record, or one that is damaged or torn, with the reason."""

    start: int
    end: int
    opcode: int
    """0 when the bytes are no record at all."""
    reason: str = ''
    torn: bool = False
    """The file ends inside this record."""


class Scanner:
    """The pieces of a file, without gap or overlap, from ``start`` to its end.

    Parameters
    ----------
    knows
        Whether a channel of this number was announced. Between damaged bytes a message is only
        believed when its channel is known.
    """

    def __init__(self, window: FileWindow, start: int, knows: Callable[[int], bool]) -> None:
        self._window = window
        self._start = start
        self._knows = knows
        # What looks like a message between the chunks of a file is the inside of a chunk whose
        # own length was damaged: no checksum would vouch for it.
        self._chunked = False

    def spans(self) -> Iterator[Span]:
        """Yield the pieces in order; nothing follows the end mark of the file."""
        size = self._window.size
        position = self._start
        while position < size:
            span = self._span_at(position)
            yield span
            position = span.end
            if span.opcode == Opcode.FOOTER and not span.reason:
                if self._window.read(position, len(MAGIC)) == MAGIC:
                    position += len(MAGIC)
                if position < size:
                    yield Span(position, size, 0, 'bytes behind the end mark')
                return

    def _span_at(self, start: int) -> Span:
        found = classify_record(self._window, start)
        if found.opcode == Opcode.CHUNK and found.fit is not RecordFit.NONE:
            self._chunked = True
        name = record_name(found.opcode)
        if found.fit is RecordFit.SOUND or (
            found.fit is RecordFit.LIKELY and self._goes_on(found.end)
        ):
            if name.startswith('record of'):
                return Span(start, found.end, found.opcode, f'a {name} is not copied')
            return Span(start, found.end, found.opcode)
        if found.fit is RecordFit.TORN:
            return self._torn(start, found)
        if found.fit is RecordFit.CONTRADICTORY:
            chunk = self._opened(start) if found.opcode == Opcode.CHUNK else None
            if chunk is not None and chunk.checked:
                return Span(start, found.inner_end, found.opcode)
            for end in (found.end, found.inner_end):
                if end > start and self._goes_on(end):
                    return Span(start, end, found.opcode, f'the {name} contradicts itself')
        back = self._find(start + 1)
        if back is None and found.fit is RecordFit.MAYBE_TORN:
            return self._torn(start, found)
        reason = 'no record can be made out'
        return Span(start, self._window.size if back is None else back, 0, reason)

    def _torn(self, start: int, found: Classification) -> Span:
        size = self._window.size
        reason = f'the file ends inside a {record_name(found.opcode)}'
        return Span(start, size, found.opcode, reason, torn=True)

    def _goes_on(self, position: int, depth: int = 1) -> bool:
        """Return whether a record, or the end of the file, may begin at ``position``."""
        if position > self._window.size:
            return False
        if position == self._window.size:
            return True
        found = classify_record(self._window, position)
        if found.opcode == Opcode.MESSAGE and not self._is_known(position):
            return False
        if found.fit is RecordFit.TORN:
            return True
        if found.fit is RecordFit.MAYBE_TORN:
            return found.end - position < _TORN_LIMIT
        if found.fit not in (RecordFit.SOUND, RecordFit.LIKELY):
            return self._window.read(position, len(MAGIC)) == MAGIC
        return depth <= 1 or self._goes_on(found.end, depth - 1)

    def _is_known(self, position: int) -> bool:
        channel = self._window.read(position + HEAD.size, 2)
        return len(channel) < 2 or self._knows(int.from_bytes(channel, 'little'))

    def _find(self, start: int) -> int | None:
        """Return where the next record begins that can be trusted; None when there is none.

        A message or attachment may hold an MCAP file of its own, all of it sound: what stands
        between two marks of the format is not ours.
        """
        within = False
        while start < self._window.size:
            block = self._window.read(start, _BLOCK + HEAD.size - 1)
            for match in _CANDIDATE.finditer(block):
                place = match.start()
                if place >= _BLOCK:
                    continue
                if block.startswith(MAGIC, place):
                    within = not within
                elif not within and self._is_anchor(start + place):
                    return start + place
            start += _BLOCK
        return None

    def _is_anchor(self, position: int) -> bool:
        found = classify_record(self._window, position)
        if found.end > self._window.size or found.inner_end != found.end:
            return False
        if found.opcode == Opcode.CHUNK:
            chunk = self._opened(position)
            return chunk is not None and (chunk.checked or self._goes_on(found.end, 2))
        if found.opcode == Opcode.FOOTER:
            return self._window.read(found.end, len(MAGIC)) == MAGIC
        if found.opcode == Opcode.ATTACHMENT and not self._attachment_is_sound(position, found):
            return False
        if found.opcode == Opcode.MESSAGE:
            if self._chunked or not self._is_known(position):
                return False
        elif self._chunked and found.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            return False
        return self._goes_on(found.end, 2)

    def _opened(self, position: int) -> DecodedChunk | None:
        """Return the whole, sound chunk that begins at ``position``, if one does."""
        try:
            chunk = decode_chunk(self._window, position)
        except ChunkError:
            return None
        return chunk if chunk.whole else None

    def _attachment_is_sound(self, position: int, found: Classification) -> bool:
        return attachment_is_valid(
            self._window.read(position + HEAD.size, found.end - position - HEAD.size)
        )


def attachment_is_valid(content: bytes) -> bool:
    """Return whether the checksum at the end of an attachment is right, or there is none."""
    checksum = int.from_bytes(content[-4:], 'little')
    return checksum in (0, zlib.crc32(content[:-4]))
