# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Framing of the serial line: COBS(frame | CRC-16) and a zero byte, decoded from a byte stream.

The zero byte occurs nowhere else, so the decoder resynchronises at the next one after any error.
COBS: S. Cheshire, M. Baker, Consistent overhead byte stuffing, IEEE/ACM Trans. Networking 7, 1999,
DOI 10.1109/90.769765. CRC-16/IBM-3740: polynomial 0x1021, initial value 0xFFFF.
"""

from binascii import crc_hqx
from typing import NamedTuple

FRAME_LIMIT = 78
"""Bytes of the longest frame: a TX with two radio payloads has 68."""

_CRC_SIZE = 2
_ENCODED_LIMIT = FRAME_LIMIT + _CRC_SIZE + 1


def crc16(data: bytes) -> int:
    """Return the CRC-16/IBM-3740 of ``data``: 0x29B1 of ``b'123456789'``."""
    return crc_hqx(data, 0xFFFF)


def cobs_encode(data: bytes) -> bytes:
    """Return ``data`` without zeros, one byte longer (COBS; at most 254 bytes).

    Raises
    ------
    ValueError
        It is longer than that.
    """
    if len(data) > 254:
        raise ValueError(f'data must be at most 254 bytes long: got {len(data)}')
    return b''.join(bytes([len(run) + 1]) + run for run in data.split(b'\0'))


def cobs_decode(stuffed: bytes) -> bytes | None:
    """Return what :func:`stuff` was given, or None if nothing stuffs to this."""
    runs, at = [], 0
    while at < len(stuffed):
        code = stuffed[at]
        run = stuffed[at + 1 : at + code]
        if len(run) != code - 1 or b'\0' in run:
            return None
        runs.append(run)
        at += code
    return b'\0'.join(runs) if 0 < len(stuffed) < 256 else None


def encode_frame(frame: bytes) -> bytes:
    """Return the bytes to send for a frame: stuffed with its CRC, zero at the end.

    Raises
    ------
    ValueError
        The frame is empty or longer than :data:`FRAME_LIMIT`.
    """
    if not 1 <= len(frame) <= FRAME_LIMIT:
        raise ValueError(f'frame must have 1 to {FRAME_LIMIT} bytes: got {len(frame)}')
    return cobs_encode(frame + crc16(frame).to_bytes(_CRC_SIZE, 'little')) + b'\0'


class FrameCounts(NamedTuple):
    """What a splitter has seen so far."""

    frames: int
    """Good ones."""
    crc_errors: int
    """Well-formed, but another CRC."""
    frame_errors: int
    """Too long, too short, or no COBS."""


class FrameDecoder:
    """Cuts frames out of a stream, however it is split, damaged or polluted.

    At most one frame's length is kept; the rest of what is longer is counted once and dropped.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        self._too_long = False
        self._frames = self._crc_errors = self._frame_errors = 0

    @property
    def counts(self) -> FrameCounts:
        """What was seen so far."""
        return FrameCounts(self._frames, self._crc_errors, self._frame_errors)

    def feed(self, data: bytes) -> list[bytes]:
        """Return the good frames that end within ``data``, without CRC, in order."""
        found = []
        *ended, begun = data.split(b'\0')
        for piece in ended:
            self._keep(piece)
            frame = self._finish()
            if frame is not None:
                found.append(frame)
        self._keep(begun)
        return found

    def forget(self) -> None:
        """Drop the begun frame: the next byte comes from another connection."""
        self._kept.clear()
        self._too_long = False

    def _keep(self, piece: bytes) -> None:
        room = _ENCODED_LIMIT - len(self._kept)
        self._too_long |= len(piece) > room
        self._kept += piece[:room]

    def _finish(self) -> bytes | None:
        """Return the frame kept, None if it is none; start anew."""
        stuffed, too_long = bytes(self._kept), self._too_long
        self.forget()
        if not stuffed:
            return None  # zeros in a row: whoever is unsure of the line may send one first
        data = None if too_long else cobs_decode(stuffed)
        if data is None or len(data) <= _CRC_SIZE:
            self._frame_errors += 1
            return None
        frame, crc = data[:-_CRC_SIZE], data[-_CRC_SIZE:]
        if crc16(frame) != int.from_bytes(crc, 'little'):
            self._crc_errors += 1
            return None
        self._frames += 1
        return frame
