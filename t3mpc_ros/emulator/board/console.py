# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""USB console of the robot board: status, and the key in EEPROM, written cell by cell."""

from collections import deque
from collections.abc import Callable
from typing import Protocol

from t3mpc_ros.emulator.board.uplink import FIRMWARE_MAJOR, FIRMWARE_MINOR
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
"""A cell of an AVR's EEPROM takes so long to be erased and written."""
_UNKNOWN, _MALFORMED = 1, 2
_KINDS = (0x03, 0x04)
_FORGET = bytes(KEY_SIZE)
_BLANK, _MARK = 0xFF, 0
_HALF, _WORD = 0xFFFF, 0xFFFFFFFF


class KeyStore:
    """Where the key is kept: a record with a CRC, and a mark while it is being changed.

    Parameters
    ----------
    key
        16 bytes that are stored already; empty: none are.
    """

    def __init__(self, key: bytes = b'') -> None:
        self._cells = bytearray([*_record(key), _BLANK])
        self._plan: deque[tuple[int, int]] = deque()
        self._next_us = 0

    @property
    def due_us(self) -> int | None:
        """When everything is written; None: it is."""
        return self._next_us + CELL_US * (len(self._plan) - 1) if self._plan else None

    def store(self, key: bytes, now_us: int) -> None:
        """Begin to write a key; an empty one is forgotten."""
        mark = len(self._cells) - 1
        wanted = _record(key)
        changed = [(at, to) for at, to in enumerate(wanted) if to != self._cells[at]]
        self._plan.extend([(mark, _MARK), *changed, (mark, _BLANK)])
        self._next_us = now_us + CELL_US

    def work(self, now_us: int) -> None:
        """Write what there has been time for."""
        while self._plan and now_us >= self._next_us:
            at, self._cells[at] = self._plan.popleft()
            self._next_us += CELL_US

    def cut(self, now_us: int) -> None:
        """Lose the supply: what is not written by now never will be."""
        self.work(now_us)
        self._plan.clear()

    def gate(self) -> CommandVerifier:
        """Return who decides which frames count, with the key that is stored."""
        *record, mark = self._cells
        key, crc = bytes(record[:KEY_SIZE]), bytes(record[KEY_SIZE:])
        if mark != _BLANK:
            return CommandVerifier(locked=True)
        if bytes(record) == _record(b''):
            return CommandVerifier()
        return CommandVerifier(key) if crc == _crc(key) else CommandVerifier(locked=True)


class _Board(Protocol):
    """What the console needs of its board."""

    slot: KeyStore
    gate: CommandVerifier

    @property
    def now_us(self) -> int: ...

    @property
    def rests(self) -> bool: ...

    @property
    def reset_cause(self) -> int: ...


class Console:
    """Answers what comes over the USB of the board.

    Parameters
    ----------
    board
        That it belongs to.
    """

    def __init__(self, board: _Board) -> None:
        self._board = board
        self.reply: Callable[[bytes], None] = lambda data: None
        """Takes the bytes of a frame for the host."""
        self.restart()

    def restart(self) -> None:
        """Forget what has come and what is under way."""
        self._splitter = FrameDecoder()
        self._writing: int | None = None

    def feed(self, data: bytes) -> None:
        """Take bytes that have arrived now."""
        for frame in self._splitter.feed(data):
            self._take(frame)

    def tick(self) -> None:
        """Tell the host when its key is stored."""
        board = self._board
        board.slot.work(board.now_us)
        if self._writing is None or board.slot.due_us is not None:
            return
        number, self._writing = self._writing, None
        board.gate = board.slot.gate()
        self._tell_key(number, frames.OK)

    def _take(self, data: bytes) -> None:
        if data[0] not in _KINDS:
            self._answer(Refusal(_UNKNOWN, data[0]))
            return
        try:
            frame = decode_to_board(data)
        except FrameError:
            self._answer(Refusal(_MALFORMED, data[0]))
            return
        if isinstance(frame, Ping):
            self._tell_state(frame)
        elif not frame.key:
            self._tell_key(frame.id, frames.OK)
        elif self._writing is not None or not self._board.rests:
            self._tell_key(frame.id, frames.BUSY)
        else:
            self._writing = frame.id
            self._board.gate = CommandVerifier(locked=True)
            key = b'' if frame.key == _FORGET else frame.key
            self._board.slot.store(key, self._board.now_us)

    def _tell_key(self, number: int, rc: int) -> None:
        gate = self._board.gate
        state, check = frames.NO_KEY, 0
        if gate.locked:
            state = frames.KEY_DAMAGED
        elif gate.key:
            state, check = frames.KEY_HELD, key_check(gate.key)
        self._answer(KeyState(number, rc, state, check))

    def _tell_state(self, ping: Ping) -> None:
        board, counts = self._board, self._splitter.counts
        who = VERSION, FIRMWARE_MAJOR, FIRMWARE_MINOR, 1
        faults = counts.crc_errors & _HALF, counts.frame_errors & _HALF, 0
        now = board.now_us & _WORD
        self._answer(Pong(ping.id, ping.echo, now, *who, *faults, board.reset_cause))

    def _answer(self, frame: FromBoard) -> None:
        self.reply(encode_frame(encode(frame)))


def _crc(key: bytes) -> bytes:
    return crc16(key).to_bytes(2, 'little')


def _record(key: bytes) -> bytes:
    return key + _crc(key) if key else bytes([_BLANK]) * (KEY_SIZE + 2)
