# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Walks through an MCAP file record by record, and finds the way back after damage."""

from collections.abc import Callable, Iterator
import re
from typing import NamedTuple
import zlib

from mcap.opcode import Opcode

from t3mpc_ros.record.mcap_file import MAGIC
from t3mpc_ros.record.recovery.chunk import ChunkError, OpenChunk, open_chunk
from t3mpc_ros.record.recovery.layout import HEAD, Fit, Look, Window, look, name_of

INDEXES = frozenset(
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


class Piece(NamedTuple):
    """A stretch of the file: one record, or one that is damaged or torn, with the reason."""

    start: int
    end: int
    opcode: int
    """0 when the bytes are no record at all."""
    reason: str = ''
    torn: bool = False
    """The file ends inside this record."""


class Scan:
    """The pieces of a file, without gap or overlap, from ``start`` to its end.

    Parameters
    ----------
    knows
        Whether a channel of this number was announced. Between damaged bytes a message is only
        believed when its channel is known.
    """

    def __init__(self, window: Window, start: int, knows: Callable[[int], bool]) -> None:
        self._window = window
        self._start = start
        self._knows = knows
        # What looks like a message between the chunks of a file is the inside of a chunk whose
        # own length was damaged: no checksum would vouch for it.
        self._chunked = False

    def pieces(self) -> Iterator[Piece]:
        """Yield the pieces in order; nothing follows the end mark of the file."""
        size = self._window.size
        position = self._start
        while position < size:
            piece = self._piece(position)
            yield piece
            position = piece.end
            if piece.opcode == Opcode.FOOTER and not piece.reason:
                if self._window.read(position, len(MAGIC)) == MAGIC:
                    position += len(MAGIC)
                if position < size:
                    yield Piece(position, size, 0, 'bytes behind the end mark')
                return

    def _piece(self, start: int) -> Piece:
        found = look(self._window, start)
        if found.opcode == Opcode.CHUNK and found.fit is not Fit.NONE:
            self._chunked = True
        name = name_of(found.opcode)
        if found.fit is Fit.SOUND or (found.fit is Fit.LIKELY and self._goes_on(found.end)):
            if name.startswith('record of'):
                return Piece(start, found.end, found.opcode, f'a {name} is not copied')
            return Piece(start, found.end, found.opcode)
        if found.fit is Fit.TORN:
            return self._torn(start, found)
        if found.fit is Fit.CONTRADICTORY:
            chunk = self._opened(start) if found.opcode == Opcode.CHUNK else None
            if chunk is not None and chunk.checked:
                return Piece(start, found.inner_end, found.opcode)
            for end in (found.end, found.inner_end):
                if end > start and self._goes_on(end):
                    return Piece(start, end, found.opcode, f'the {name} contradicts itself')
        back = self._find(start + 1)
        if back is None and found.fit is Fit.MAYBE_TORN:
            return self._torn(start, found)
        reason = 'no record can be made out'
        return Piece(start, self._window.size if back is None else back, 0, reason)

    def _torn(self, start: int, found: Look) -> Piece:
        size = self._window.size
        reason = f'the file ends inside a {name_of(found.opcode)}'
        return Piece(start, size, found.opcode, reason, torn=True)

    def _goes_on(self, position: int, depth: int = 1) -> bool:
        """Return whether a record, or the end of the file, may begin at ``position``."""
        if position > self._window.size:
            return False
        if position == self._window.size:
            return True
        found = look(self._window, position)
        if found.opcode == Opcode.MESSAGE and not self._is_known(position):
            return False
        if found.fit is Fit.TORN:
            return True
        if found.fit is Fit.MAYBE_TORN:
            return found.end - position < _TORN_LIMIT
        if found.fit not in (Fit.SOUND, Fit.LIKELY):
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
        found = look(self._window, position)
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

    def _opened(self, position: int) -> OpenChunk | None:
        """Return the whole, sound chunk that begins at ``position``, if one does."""
        try:
            chunk = open_chunk(self._window, position)
        except ChunkError:
            return None
        return chunk if chunk.whole else None

    def _attachment_is_sound(self, position: int, found: Look) -> bool:
        return attachment_is_sound(
            self._window.read(position + HEAD.size, found.end - position - HEAD.size)
        )


def attachment_is_sound(content: bytes) -> bool:
    """Return whether the checksum at the end of an attachment is right, or there is none."""
    checksum = int.from_bytes(content[-4:], 'little')
    return checksum in (0, zlib.crc32(content[:-4]))
