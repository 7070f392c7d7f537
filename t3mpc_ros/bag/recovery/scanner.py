# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Scanner for damaged MCAP files: record classification and resynchronization.

The length of most records follows from two sources: the length in their head and the lengths of
their fields. A damaged length is detected because the two disagree. Record layouts follow the MCAP
specification (foxglove/mcap, ``website/docs/spec/index.md``).
"""

from collections.abc import Callable, Iterator
from enum import Enum
import re
import struct
from typing import NamedTuple

from mcap.opcode import Opcode

from t3mpc_ros.bag.mcap_file import (
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    ChunkError,
    DecodedChunk,
    FileWindow,
    attachment_is_valid,
    decode_chunk,
)

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
"""Records that duplicate information of other records; their loss is harmless."""

_STRING, _MAP, _BLOB, _REST = 'string', 'map', 'blob', 'rest'
# Numbers are bytes of fixed fields; strings and maps have a length of 4 bytes, a blob one of 8.
_RECORD_LAYOUTS: dict[int, tuple[int | str, ...]] = {
    Opcode.HEADER: (_STRING, _STRING),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _STRING, _STRING, _STRING),
    Opcode.CHANNEL: (4, _STRING, _STRING, _MAP),
    Opcode.MESSAGE: (MESSAGE_HEAD.size, _REST),
    Opcode.CHUNK: (28, _STRING, _BLOB),
    Opcode.MESSAGE_INDEX: (2, _STRING),
    Opcode.CHUNK_INDEX: (32, _STRING, 8, _STRING, 16),
    Opcode.ATTACHMENT: (16, _STRING, _STRING, _BLOB, 4),
    Opcode.METADATA: (_STRING, _MAP),
    Opcode.DATA_END: (4,),
    Opcode.ATTACHMENT_INDEX: (40, _STRING, _STRING),
    Opcode.METADATA_INDEX: (16, _STRING),
    Opcode.STATISTICS: (42, _STRING),
    Opcode.SUMMARY_OFFSET: (17,),
}
_MAP_SIZE_LIMIT = 2**26  # maximum size of a map whose content is verified, bytes
_BLOCK = 2**20
# A known opcode and a length below 2^40 bytes; a lookahead, because candidates may overlap.
_CANDIDATE = re.compile(rb'(?=[\x01-\x0f].{5}\x00\x00\x00|' + re.escape(MAGIC) + rb')', re.DOTALL)
_ZEROS = bytes(_BLOCK + HEAD.size - 1)
_TRUNCATED_SIZE_LIMIT = 2**28  # maximum plausible size of a possibly truncated record, bytes


class RecordFit(Enum):
    """Agreement of bytes with the layout of a record."""

    VALID = 'both lengths agree'
    PLAUSIBLE = 'valid, but only the length in the head gives its end'
    TRUNCATED = 'the file ends inside the record'
    POSSIBLY_TRUNCATED = 'the file ends inside the record if its length is correct'
    INCONSISTENT = 'the lengths disagree'
    NO_RECORD = 'not a record'


class Classification(NamedTuple):
    """Result of :func:`classify_record`."""

    fit: RecordFit
    opcode: int
    end: int
    """End of the record according to its head."""
    inner_end: int
    """End of the record according to its fields; 0 if unknown."""


def classify_record(window: FileWindow, start: int) -> Classification:
    """Classify the bytes at ``start`` without reading large fields."""
    head = window.read(start, HEAD.size)
    if not head or head[0] == 0:
        return Classification(RecordFit.NO_RECORD, 0, 0, 0)
    opcode = head[0]
    layout = _RECORD_LAYOUTS.get(opcode)
    if len(head) < HEAD.size:
        return Classification(RecordFit.TRUNCATED if layout else RecordFit.NO_RECORD, opcode, 0, 0)
    end = start + HEAD.size + HEAD.unpack(head)[1]
    if layout is None:
        return Classification(
            RecordFit.PLAUSIBLE if end <= window.size else RecordFit.NO_RECORD, opcode, end, 0
        )
    inner_end = _end_by_fields(window, start + HEAD.size, layout, end)
    if inner_end < 0:  # an invalid map
        fit = RecordFit.INCONSISTENT if end <= window.size else RecordFit.NO_RECORD
        return Classification(fit, opcode, end, 0)
    if end > window.size:
        agree = inner_end in (0, end)
        if layout[-1] == _REST or inner_end == 0:
            return Classification(
                RecordFit.POSSIBLY_TRUNCATED if agree else RecordFit.NO_RECORD,
                opcode,
                end,
                inner_end,
            )
        return Classification(
            RecordFit.TRUNCATED if agree else RecordFit.INCONSISTENT, opcode, end, inner_end
        )
    if inner_end == end:
        return Classification(
            RecordFit.PLAUSIBLE if layout[-1] == _REST else RecordFit.VALID, opcode, end, inner_end
        )
    # Later versions of the format may append fields, so the inner end may be smaller.
    fit = (
        RecordFit.PLAUSIBLE
        if 0 < inner_end < end and opcode != Opcode.CHUNK
        else RecordFit.INCONSISTENT
    )
    return Classification(fit, opcode, end, inner_end)


def record_name(opcode: int) -> str:
    """Return the name of a record type."""
    if opcode not in _RECORD_LAYOUTS:
        return f'record of unknown type 0x{opcode:02x}'
    return str(Opcode(opcode).name).lower().replace('_', ' ')


def _end_by_fields(window: FileWindow, start: int, layout: tuple[int | str, ...], end: int) -> int:
    """Return the end of the fields; 0 if the file ends before it, -1 for invalid fields."""
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
            readable = length <= _MAP_SIZE_LIMIT and position + length <= window.size
            if part == _MAP and readable and not _is_string_map(window.read(position, length)):
                return -1
            position += length
    return position


def _is_string_map(data: bytes) -> bool:
    """Return whether ``data`` is a sequence of an even number of complete strings."""
    position = count = 0
    while position < len(data):
        position += 4 + int.from_bytes(data[position : position + 4], 'little')
        count += 1
    return position == len(data) and count % 2 == 0


def chunk_time_range(window: FileWindow, start: int) -> tuple[int, int] | None:
    """Return first and last message time in the head of a chunk, ns; None if invalid."""
    head = window.read(start + HEAD.size, 16)
    if len(head) < 16:
        return None
    first, last = struct.unpack('<QQ', head)
    return (first, last) if first <= last < 2**63 else None


class Span(NamedTuple):
    """Range of a file: a record, or damaged or truncated bytes with the reason."""

    start: int
    end: int
    opcode: int
    """0 for bytes that are not a record."""
    reason: str = ''
    truncated: bool = False
    """The file ends inside this record."""


class Scanner:
    """Divides a file from ``start`` into consecutive spans.

    Parameters
    ----------
    is_known_channel
        Whether a channel number is defined. After damaged bytes, a message is accepted only if
        its channel is known.
    progress
        Called with the position in the search after damaged bytes, about once per megabyte.
    """

    def __init__(
        self,
        window: FileWindow,
        start: int,
        is_known_channel: Callable[[int], bool],
        progress: Callable[[int], None] = lambda position: None,
    ) -> None:
        self._window = window
        self._start = start
        self._is_known_channel = is_known_channel
        self._progress = progress
        # In a file with chunks, a message outside of a chunk is the content of a chunk with a
        # damaged length; no checksum covers it.
        self._chunked = False

    def spans(self) -> Iterator[Span]:
        """Yield the spans in order, up to the magic at the end of the file."""
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
                    yield Span(position, size, 0, 'bytes after the end of the file')
                return

    def _span_at(self, start: int) -> Span:
        found = classify_record(self._window, start)
        if found.opcode == Opcode.CHUNK and found.fit is not RecordFit.NO_RECORD:
            self._chunked = True
        name = record_name(found.opcode)
        if found.fit is RecordFit.VALID or (
            found.fit is RecordFit.PLAUSIBLE and self._continues_at(found.end)
        ):
            if name.startswith('record of'):
                return Span(start, found.end, found.opcode, f'a {name} is not copied')
            return Span(start, found.end, found.opcode)
        if found.fit is RecordFit.TRUNCATED:
            return self._truncated_span(start, found)
        if found.fit is RecordFit.INCONSISTENT:
            chunk = self._decode_complete(start) if found.opcode == Opcode.CHUNK else None
            if chunk is not None and chunk.checked:
                return Span(start, found.inner_end, found.opcode)
            for end in (found.end, found.inner_end):
                if end > start and self._continues_at(end):
                    return Span(start, end, found.opcode, f'the {name} is inconsistent')
        back = self._next_record(start + 1)
        if back is None and found.fit is RecordFit.POSSIBLY_TRUNCATED:
            return self._truncated_span(start, found)
        reason = 'no record found'
        return Span(start, self._window.size if back is None else back, 0, reason)

    def _truncated_span(self, start: int, found: Classification) -> Span:
        size = self._window.size
        reason = f'the file ends inside a {record_name(found.opcode)}'
        return Span(start, size, found.opcode, reason, truncated=True)

    def _continues_at(self, position: int, depth: int = 1) -> bool:
        """Return whether a record or the end of the file is plausible at ``position``."""
        if position > self._window.size:
            return False
        if position == self._window.size:
            return True
        found = classify_record(self._window, position)
        if found.opcode == Opcode.MESSAGE and not self._channel_is_known(position):
            return False
        if found.fit is RecordFit.TRUNCATED:
            return True
        if found.fit is RecordFit.POSSIBLY_TRUNCATED:
            return found.end - position < _TRUNCATED_SIZE_LIMIT
        if found.fit not in (RecordFit.VALID, RecordFit.PLAUSIBLE):
            return self._window.read(position, len(MAGIC)) == MAGIC
        return depth <= 1 or self._continues_at(found.end, depth - 1)

    def _channel_is_known(self, position: int) -> bool:
        channel = self._window.read(position + HEAD.size, 2)
        return len(channel) < 2 or self._is_known_channel(int.from_bytes(channel, 'little'))

    def _next_record(self, start: int) -> int | None:
        """Return the start of the next reliable record, or None.

        A message or attachment may contain a valid MCAP file: bytes between two MCAP magics are
        skipped.
        """
        within = False
        while start < self._window.size:
            self._progress(start)
            block = self._window.read(start, _BLOCK + HEAD.size - 1)
            if block == _ZEROS:  # a hole; no record begins with a zero
                start += _BLOCK
                continue
            for match in _CANDIDATE.finditer(block):
                offset = match.start()
                if offset >= _BLOCK:
                    continue
                if block.startswith(MAGIC, offset):
                    within = not within
                elif not within and self._is_anchor(start + offset):
                    return start + offset
            start += _BLOCK
        return None

    def _is_anchor(self, position: int) -> bool:
        found = classify_record(self._window, position)
        if found.end > self._window.size or found.inner_end != found.end:
            return False
        if found.opcode == Opcode.CHUNK:
            chunk = self._decode_complete(position)
            return chunk is not None and (chunk.checked or self._continues_at(found.end, 2))
        if found.opcode == Opcode.FOOTER:
            return self._window.read(found.end, len(MAGIC)) == MAGIC
        if found.opcode == Opcode.ATTACHMENT and not self._attachment_is_valid(position, found):
            return False
        if found.opcode == Opcode.MESSAGE:
            if self._chunked or not self._channel_is_known(position):
                return False
        elif self._chunked and found.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            return False
        return self._continues_at(found.end, 2)

    def _decode_complete(self, position: int) -> DecodedChunk | None:
        """Return the complete and valid chunk at ``position``, or None."""
        try:
            chunk = decode_chunk(self._window, position)
        except ChunkError:
            return None
        return chunk if chunk.complete else None

    def _attachment_is_valid(self, position: int, found: Classification) -> bool:
        return attachment_is_valid(
            self._window.read(position + HEAD.size, found.end - position - HEAD.size)
        )
