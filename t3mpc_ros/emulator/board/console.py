# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""USB console of the robot board: status, and the key in EEPROM, written cell by cell."""

from collections import deque
from collections.abc import Callable
from typing import Protocol

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KEY_SIZE, CommandVerifier, key_check
from t3mpc_ros.radio.protocol.codec import decode_to_board, encode
from t3mpc_ros.radio.protocol.frames import (
    VERSION,
    FrameError,
    FromBoard,
    KeyState,
    Ping,
    Pong,
    Refusal,
)
from t3mpc_ros.radio.protocol.framing import FrameDecoder, crc16, encode_frame

CELL_US = 3_400
"""Time to erase and write one EEPROM cell of an AVR."""
FIRMWARE_MAJOR, FIRMWARE_MINOR = 1, 0
_UNKNOWN, _MALFORMED = 1, 2
_KINDS = (0x03, 0x04)
_ERASE = bytes(KEY_SIZE)
"""Key value that requests erasure."""
_BLANK, _MARK = 0xFF, 0
_HALF, _WORD = 0xFFFF, 0xFFFFFFFF


class KeyStore:
    """Key in EEPROM: a record with a CRC, and a cell that marks an unfinished write.

    Parameters
    ----------
    key
        Stored key, 16 bytes; empty: none.
    """

    def __init__(self, key: bytes = b'') -> None:
        self._cells = bytearray([*_record(key), _BLANK])
        self._writes: deque[tuple[int, int]] = deque()
        self._next_us = 0

    @property
    def done_us(self) -> int | None:
        """Time at which the write is complete; None: no write in progress."""
        return self._next_us + CELL_US * (len(self._writes) - 1) if self._writes else None

    def store(self, key: bytes, now_us: int) -> None:
        """Begin to write a key; an empty key erases the record."""
        mark = len(self._cells) - 1
        record = _record(key)
        changes = [(at, to) for at, to in enumerate(record) if to != self._cells[at]]
        self._writes.extend([(mark, _MARK), *changes, (mark, _BLANK)])
        self._next_us = now_us + CELL_US

    def update(self, now_us: int) -> None:
        """Write the cells that are due."""
        while self._writes and now_us >= self._next_us:
            at, self._cells[at] = self._writes.popleft()
            self._next_us += CELL_US

    def lose_power(self, now_us: int) -> None:
        """Abort the write: cells not written by now keep their content."""
        self.update(now_us)
        self._writes.clear()

    def create_verifier(self) -> CommandVerifier:
        """Return a verifier with the stored key; locked if the record is damaged."""
        *record, mark = self._cells
        key, crc = bytes(record[:KEY_SIZE]), bytes(record[KEY_SIZE:])
        if mark != _BLANK:
            return CommandVerifier(locked=True)
        if bytes(record) == _record(b''):
            return CommandVerifier()
        return CommandVerifier(key) if crc == _crc(key) else CommandVerifier(locked=True)


class _Board(Protocol):
    """Attributes of the board that the console uses."""

    key_store: KeyStore
    verifier: CommandVerifier

    @property
    def now_us(self) -> int: ...

    @property
    def at_rest(self) -> bool: ...

    @property
    def reset_cause(self) -> int: ...


class Console:
    """Replies to frames on the USB port of the board.

    Parameters
    ----------
    board
        Board of the console.
    """

    def __init__(self, board: _Board) -> None:
        self._board = board
        self.reply: Callable[[bytes], None] = lambda data: None
        """Receives the bytes of each frame for the host."""
        self.reset()

    def reset(self) -> None:
        """Discard partial input and the reply to a write in progress."""
        self._decoder = FrameDecoder()
        self._write_id: int | None = None

    def feed(self, data: bytes) -> None:
        """Process bytes that arrive now."""
        for frame in self._decoder.feed(data):
            self._process(frame)

    def update(self) -> None:
        """Write due EEPROM cells; reply when the key is complete."""
        board = self._board
        board.key_store.update(board.now_us)
        if self._write_id is None or board.key_store.done_us is not None:
            return
        number, self._write_id = self._write_id, None
        board.verifier = board.key_store.create_verifier()
        self._send_key_state(number, frames.OK)

    def _process(self, data: bytes) -> None:
        if data[0] not in _KINDS:
            self._send_frame(Refusal(_UNKNOWN, data[0]))
            return
        try:
            frame = decode_to_board(data)
        except FrameError:
            self._send_frame(Refusal(_MALFORMED, data[0]))
            return
        if isinstance(frame, Ping):
            self._send_pong(frame)
        elif not frame.key:
            self._send_key_state(frame.id, frames.OK)
        elif self._write_id is not None or not self._board.at_rest:
            self._send_key_state(frame.id, frames.BUSY)
        else:
            self._write_id = frame.id
            self._board.verifier = CommandVerifier(locked=True)
            key = b'' if frame.key == _ERASE else frame.key
            self._board.key_store.store(key, self._board.now_us)

    def _send_key_state(self, number: int, rc: int) -> None:
        verifier = self._board.verifier
        state, check = frames.NO_KEY, 0
        if verifier.locked:
            state = frames.KEY_DAMAGED
        elif verifier.key:
            state, check = frames.KEY_HELD, key_check(verifier.key)
        self._send_frame(KeyState(number, rc, state, check))

    def _send_pong(self, ping: Ping) -> None:
        board, counts = self._board, self._decoder.counts
        version = VERSION, FIRMWARE_MAJOR, FIRMWARE_MINOR, 1
        errors = counts.crc_errors & _HALF, counts.frame_errors & _HALF, 0
        now = board.now_us & _WORD
        self._send_frame(Pong(ping.id, ping.echo, now, *version, *errors, board.reset_cause))

    def _send_frame(self, frame: FromBoard) -> None:
        self.reply(encode_frame(encode(frame)))


def _crc(key: bytes) -> bytes:
    return crc16(key).to_bytes(2, 'little')


def _record(key: bytes) -> bytes:
    return key + _crc(key) if key else bytes([_BLANK]) * (KEY_SIZE + 2)
