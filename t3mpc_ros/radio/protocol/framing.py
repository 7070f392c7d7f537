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
"""Framing of the serial line: COBS(frame | CRC-16) and a zero byte, decoded from a byte stream.

The zero byte occurs nowhere else, so the decoder resynchronises at the next one after any error.
COBS: S. Cheshire, M. Baker, Consistent overhead byte stuffing, IEEE/ACM Trans. Networking 7, 1999,
DOI 10.1109/90.769765. CRC-16/IBM-3740: polynomial 0x1021, initial value 0xFFFF.
"""

from binascii import crc_hqx
from typing import NamedTuple

FRAME_LIMIT = 78  # maximum length of a frame, bytes; a TX with two radio payloads has 68

_CRC_SIZE = 2
_ENCODED_LIMIT = FRAME_LIMIT + _CRC_SIZE + 1


def crc16(data: bytes) -> int:
    """Return the CRC-16/IBM-3740 of ``data``: 0x29B1 of ``b'123456789'``."""
    return crc_hqx(data, 0xFFFF)


def cobs_encode(data: bytes) -> bytes:
    """Return ``data`` encoded without zero bytes, one byte longer (COBS; at most 254 bytes)."""
    if len(data) > 254:
        raise ValueError(f'data must be at most 254 bytes long: got {len(data)}')
    return b''.join(bytes([len(run) + 1]) + run for run in data.split(b'\0'))


def cobs_decode(encoded: bytes) -> bytes | None:
    """Return the decoded data, or None if no data encodes to these bytes."""
    runs, at = [], 0
    while at < len(encoded):
        code = encoded[at]
        run = encoded[at + 1 : at + code]
        if len(run) != code - 1 or b'\0' in run:
            return None
        runs.append(run)
        at += code
    return b'\0'.join(runs) if 0 < len(encoded) < 256 else None


def encode_frame(frame: bytes) -> bytes:
    """Return a frame of up to 78 bytes as on the line: COBS of frame and CRC, then a zero."""
    if not 1 <= len(frame) <= FRAME_LIMIT:
        raise ValueError(f'frame must have 1 to {FRAME_LIMIT} bytes: got {len(frame)}')
    return cobs_encode(frame + crc16(frame).to_bytes(_CRC_SIZE, 'little')) + b'\0'


class FrameCounts(NamedTuple):
    """Counters of a frame decoder."""

    frames: int  # valid frames
    crc_errors: int  # valid COBS, wrong CRC
    frame_errors: int  # too long, too short, or invalid COBS


class FrameDecoder:
    """Decodes frames from a byte stream that may be split, damaged or polluted anywhere.

    It buffers at most one frame; a longer piece is dropped and counts as one frame error.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._too_long = False
        self._frames = self._crc_errors = self._frame_errors = 0

    @property
    def counts(self) -> FrameCounts:
        """Counters since construction."""
        return FrameCounts(self._frames, self._crc_errors, self._frame_errors)

    def feed(self, data: bytes) -> list[bytes]:
        """Return the valid frames that end within ``data``, without CRC, in order."""
        frames = []
        *complete, partial = data.split(b'\0')
        for piece in complete:
            self._append(piece)
            frame = self._finish()
            if frame is not None:
                frames.append(frame)
        self._append(partial)
        return frames

    def reset(self) -> None:
        """Drop the partial frame, for a new connection."""
        self._buffer.clear()
        self._too_long = False

    def _append(self, piece: bytes) -> None:
        room = _ENCODED_LIMIT - len(self._buffer)
        self._too_long |= len(piece) > room
        self._buffer += piece[:room]

    def _finish(self) -> bytes | None:
        """Return the buffered frame, None if it is invalid; empty the buffer."""
        encoded, too_long = bytes(self._buffer), self._too_long
        self.reset()
        if not encoded:
            return None  # zeros in a row: a sender may start with one to resynchronise
        data = None if too_long else cobs_decode(encoded)
        if data is None or len(data) <= _CRC_SIZE:
            self._frame_errors += 1
            return None
        frame, crc = data[:-_CRC_SIZE], data[-_CRC_SIZE:]
        if crc16(frame) != int.from_bytes(crc, 'little'):
            self._crc_errors += 1
            return None
        self._frames += 1
        return frame
