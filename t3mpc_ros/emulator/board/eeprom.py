# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""EEPROM of the robot board: key and settings, written cell by cell, torn by a loss of power."""

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KEY_SIZE, CommandVerifier
from t3mpc_ros.radio.protocol.framing import crc16

CELL_US = 3_400
"""Time to erase and write one EEPROM cell of an AVR."""
_BLANK, _MARK = 0xFF, 0
_FORMAT = 1
_ADDRESS_SIZE = 5
_MAX_CHANNEL, _MAX_MICROSTEPS = 125, 256
_SETTINGS_SIZE = 11
"""Bytes of one copy: format, channel, microsteps, address, CRC."""


class _Cells:
    """Cells of a record, and the writes that are still to come, in order."""

    def __init__(self, content: bytes) -> None:
        self._cells = bytearray(content)
        self._writes: deque[tuple[int, int]] = deque()
        self._next_us = 0

    @property
    def done_us(self) -> int | None:
        """Time at which the write is complete; None: no write in progress."""
        return self._next_us + CELL_US * (len(self._writes) - 1) if self._writes else None

    def update(self, now_us: int) -> None:
        """Write the cells that are due."""
        while self._writes and now_us >= self._next_us:
            at, self._cells[at] = self._writes.popleft()
            self._next_us += CELL_US

    def lose_power(self, now_us: int) -> None:
        """Abort the write: cells not written by now keep their content."""
        self.update(now_us)
        self._writes.clear()

    def _begin(self, writes: Iterable[tuple[int, int]], now_us: int) -> None:
        self._writes.extend(writes)
        self._next_us = now_us + CELL_US


class KeyStore(_Cells):
    """Key in EEPROM: a record with a CRC, and a cell that marks an unfinished write.

    Parameters
    ----------
    key
        Stored key, 16 bytes; empty: none.
    """

    def __init__(self, key: bytes = b'') -> None:
        super().__init__(bytes([*_key_record(key), _BLANK]))

    def store(self, key: bytes, now_us: int) -> None:
        """Begin to write a key; an empty key erases the record."""
        mark = len(self._cells) - 1
        record = _key_record(key)
        changes = [(at, to) for at, to in enumerate(record) if to != self._cells[at]]
        self._begin([(mark, _MARK), *changes, (mark, _BLANK)], now_us)

    def create_verifier(self) -> CommandVerifier:
        """Return a verifier with the stored key; locked if the record is damaged."""
        *record, mark = self._cells
        key, crc = bytes(record[:KEY_SIZE]), bytes(record[KEY_SIZE:])
        if mark != _BLANK:
            return CommandVerifier(locked=True)
        if bytes(record) == _key_record(b''):
            return CommandVerifier()
        return CommandVerifier(key) if crc == _crc(key) else CommandVerifier(locked=True)


class Setup(NamedTuple):
    """Values of the settings; the defaults are those of a board without settings."""

    channel: int = 82
    microsteps: int = 16
    address: bytes = b'T3MPC'

    @property
    def valid(self) -> bool:
        """Whether the values are possible."""
        power_of_two = self.microsteps > 0 and not self.microsteps & (self.microsteps - 1)
        return (
            self.channel <= _MAX_CHANNEL
            and power_of_two
            and self.microsteps <= _MAX_MICROSTEPS
            and len(set(self.address)) > 1
        )


class SettingsStore(_Cells):
    """Settings in EEPROM, in two copies.

    A copy becomes invalid by its first byte before the others change, and valid by it after them:
    no loss of power leaves a mixture of two writes.

    Parameters
    ----------
    setup
        Stored in both copies; None: a board that was never set up.
    """

    def __init__(self, setup: Setup | None) -> None:
        copy = bytes([_BLANK]) * _SETTINGS_SIZE if setup is None else _encode(setup)
        super().__init__(2 * copy)
        self._target = Setup()
        self.boot(0)

    @property
    def writing(self) -> bool:
        """Whether a write or a repair is in progress."""
        return bool(self._writes)

    def boot(self, now_us: int) -> None:
        """Read the record; begin to repair a damaged or differing copy."""
        copies = [self._copy(number) for number in (0, 1)]
        good = [number for number in (0, 1) if _decode(copies[number]) is not None]
        if not good:
            blank = set(copies[0] + copies[1]) == {_BLANK}
            self.state = frames.SETTINGS_MISSING if blank else frames.SETTINGS_DAMAGED
            """SETTINGS_GOOD, …"""
            self.setup = Setup()
            """Values in effect."""
            return
        self.setup = self._target = _decode(copies[good[0]]) or Setup()
        self.state = frames.SETTINGS_GOOD
        if copies[0] != copies[1]:
            self.state = frames.SETTINGS_ONE_COPY
            self._begin(self._changes(1 - good[0]), now_us)

    def store(self, setup: Setup, now_us: int) -> None:
        """Begin to write both copies; until they are complete, the record counts as damaged."""
        self.state = frames.SETTINGS_DAMAGED
        self._target = setup
        only_first = _decode(self._copy(0)) is not None and _decode(self._copy(1)) is None
        order = (1, 0) if only_first else (0, 1)
        self._begin([change for number in order for change in self._changes(number)], now_us)

    def update(self, now_us: int) -> None:
        """Write the cells that are due; the values are in effect after the last one."""
        writing = self.writing
        super().update(now_us)
        if writing and not self.writing:
            self.setup, self.state = self._target, frames.SETTINGS_GOOD

    def _copy(self, number: int) -> bytes:
        return bytes(self._cells[number * _SETTINGS_SIZE :][:_SETTINGS_SIZE])

    def _changes(self, number: int) -> list[tuple[int, int]]:
        """Return the writes of one copy in order: invalid, content, valid."""
        start = number * _SETTINGS_SIZE
        content = enumerate(_encode(self._target)[1:], start + 1)
        changes = [(at, to) for at, to in content if to != self._cells[at]]
        invalid = [] if self._cells[start] == _BLANK else [(start, _BLANK)]
        return [*invalid, *changes, (start, _FORMAT)]


def _encode(setup: Setup) -> bytes:
    body = bytes([_FORMAT, setup.channel, *setup.microsteps.to_bytes(2, 'little'), *setup.address])
    return body + _crc(body)


def _decode(copy: bytes) -> Setup | None:
    """Return the setup of a copy; None if it is not valid."""
    body = copy[:-2]
    if body[0] != _FORMAT or copy[-2:] != _crc(body):
        return None
    setup = Setup(body[1], int.from_bytes(body[2:4], 'little'), body[4 : 4 + _ADDRESS_SIZE])
    return setup if setup.valid else None


def _crc(data: bytes) -> bytes:
    return crc16(data).to_bytes(2, 'little')


def _key_record(key: bytes) -> bytes:
    return key + _crc(key) if key else bytes([_BLANK]) * (KEY_SIZE + 2)
