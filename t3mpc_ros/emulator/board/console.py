# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""USB console of the robot board: status, key and settings."""

from collections.abc import Callable
from typing import Protocol

from t3mpc_ros.emulator.board.eeprom import KeyStore, SettingsStore, Setup
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
    Settings,
    SettingsState,
)
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

FIRMWARE_MAJOR, FIRMWARE_MINOR = 1, 1
BUILD = 0
"""The emulator is no build of the firmware."""
_UNKNOWN, _MALFORMED = 1, 2
_KINDS = (0x03, 0x04, 0x05)
_ERASE = bytes(KEY_SIZE)
"""Key value that requests erasure."""
_HALF, _WORD = 0xFFFF, 0xFFFFFFFF


class _Board(Protocol):
    """Attributes of the board that the console uses."""

    key_store: KeyStore
    settings_store: SettingsStore
    verifier: CommandVerifier

    @property
    def now_us(self) -> int: ...

    @property
    def at_rest(self) -> bool: ...

    @property
    def reset_cause(self) -> int: ...

    def apply_settings(self) -> None: ...


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
        self._settings_id: int | None = None

    def feed(self, data: bytes) -> None:
        """Process bytes that arrive now."""
        for frame in self._decoder.feed(data):
            self._process(frame)

    def update(self) -> None:
        """Write due EEPROM cells; reply when the key or the settings are complete."""
        board = self._board
        board.settings_store.update(board.now_us)
        if self._settings_id is not None and not board.settings_store.writing:
            number, self._settings_id = self._settings_id, None
            board.apply_settings()
            self._send_settings(number, frames.OK)
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
        elif isinstance(frame, Settings):
            self._process_settings(frame)
        elif not frame.key:
            self._send_key_state(frame.id, frames.OK)
        elif self._busy:
            self._send_key_state(frame.id, frames.BUSY)
        else:
            self._write_id = frame.id
            self._board.verifier = CommandVerifier(locked=True)
            key = b'' if frame.key == _ERASE else frame.key
            self._board.key_store.store(key, self._board.now_us)

    @property
    def _busy(self) -> bool:
        board = self._board
        return self._write_id is not None or board.settings_store.writing or not board.at_rest

    def _process_settings(self, frame: Settings) -> None:
        board = self._board
        setup = Setup(frame.channel, frame.microsteps, frame.address)
        if not frame.address:
            self._send_settings(frame.id, frames.OK)
        elif not setup.valid:
            self._send_settings(frame.id, frames.OUT_OF_RANGE)
        elif self._busy:
            self._send_settings(frame.id, frames.BUSY)
        else:
            self._settings_id = frame.id
            board.verifier.end_session()
            board.settings_store.store(setup, board.now_us)

    def _send_settings(self, number: int, rc: int) -> None:
        store = self._board.settings_store
        self._send_frame(SettingsState(number, rc, store.state, *store.setup))

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
        store = board.settings_store
        radio = store.setup.channel, store.setup.address
        cause = board.reset_cause, store.state
        self._send_frame(Pong(ping.id, ping.echo, now, *version, *errors, *cause, *radio, BUILD))

    def _send_frame(self, frame: FromBoard) -> None:
        self.reply(encode_frame(encode(frame)))
