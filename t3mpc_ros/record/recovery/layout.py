# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Whether the bytes at some place of a file can be an MCAP record.

Most records say their length twice: in front, and by the lengths of their fields. A damaged
length is noticed because the two then disagree. Layouts follow the MCAP specification
(foxglove/mcap, ``website/docs/spec/index.md``).
"""

from enum import Enum
import struct
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

HEAD = struct.Struct('<BQ')
"""Opcode and length of the content, in front of every record."""
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, sequence, log time and publish time, in front of a message's data."""

_TEXT, _TABLE, _BLOB, _REST = 'text', 'table', 'blob', 'rest'
# Numbers are bytes of fixed fields; text and table have a length of 4 bytes, a blob one of 8.
_LAYOUTS: dict[int, tuple[int | str, ...]] = {
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
_TABLE_LIMIT = 2**26  # bytes of a table that are looked into before its length is believed


class Window:
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


class Fit(Enum):
    """How well a place of a file fits a record."""

    SOUND = 'both lengths agree'
    LIKELY = 'nothing speaks against it, but only its own length says where it ends'
    TORN = 'it goes on behind the end of the file'
    MAYBE_TORN = 'it would go on behind the end of the file, if its length can be believed'
    CONTRADICTORY = 'its lengths disagree'
    NONE = 'not a record'


class Look(NamedTuple):
    """What a place of a file looks like."""

    fit: Fit
    opcode: int
    end: int
    """Where the record ends by the length in front of it."""
    inner_end: int
    """Where it ends by its fields; 0 when they do not say."""


def look(window: Window, start: int) -> Look:
    """Return what the bytes at ``start`` look like, without reading large fields."""
    head = window.read(start, HEAD.size)
    if not head or head[0] == 0:
        return Look(Fit.NONE, 0, 0, 0)
    opcode = head[0]
    layout = _LAYOUTS.get(opcode)
    if len(head) < HEAD.size:
        return Look(Fit.TORN if layout else Fit.NONE, opcode, 0, 0)
    end = start + HEAD.size + HEAD.unpack(head)[1]
    if layout is None:
        return Look(Fit.LIKELY if end <= window.size else Fit.NONE, opcode, end, 0)
    inner_end = _measure(window, start + HEAD.size, layout, end)
    if inner_end < 0:  # a table that is none
        fit = Fit.CONTRADICTORY if end <= window.size else Fit.NONE
        return Look(fit, opcode, end, 0)
    if end > window.size:
        agree = inner_end in (0, end)
        if layout[-1] == _REST or inner_end == 0:
            return Look(Fit.MAYBE_TORN if agree else Fit.NONE, opcode, end, inner_end)
        return Look(Fit.TORN if agree else Fit.CONTRADICTORY, opcode, end, inner_end)
    if inner_end == end:
        return Look(Fit.LIKELY if layout[-1] == _REST else Fit.SOUND, opcode, end, inner_end)
    # Later versions of the format may append fields, so the inner end may come first.
    fit = Fit.LIKELY if 0 < inner_end < end and opcode != Opcode.CHUNK else Fit.CONTRADICTORY
    return Look(fit, opcode, end, inner_end)


def name_of(opcode: int) -> str:
    """Return what a record is called."""
    if opcode not in _LAYOUTS:
        return f'record of unknown kind 0x{opcode:02x}'
    return str(Opcode(opcode).name).lower().replace('_', ' ')


def _measure(window: Window, start: int, layout: tuple[int | str, ...], end: int) -> int:
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
            there = length <= _TABLE_LIMIT and position + length <= window.size
            if part == _TABLE and there and not _is_table(window.read(position, length)):
                return -1
            position += length
    return position


def _is_table(data: bytes) -> bool:
    """Return whether ``data`` is a sequence of an even number of whole texts."""
    position = count = 0
    while position < len(data):
        position += 4 + int.from_bytes(data[position : position + 4], 'little')
        count += 1
    return position == len(data) and count % 2 == 0
