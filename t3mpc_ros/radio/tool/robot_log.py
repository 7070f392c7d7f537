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
"""Log of the robot, over the USB of its board: resets, faults, longest pass of its main loop."""

from collections.abc import Iterable
from enum import IntEnum
import struct
from typing import NamedTuple

from t3mpc_ros.radio.link.standstill_reasons import reset_cause
from t3mpc_ros.radio.protocol.frames import LOG_RECORD, Record
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.radio.tool.eeprom_records import request_part
from t3mpc_ros.radio.tool.procedure import Script, wait_for_board
from t3mpc_ros.radio.tool.robot_settings import SETTINGS_TEXTS

_PLACES = 16
_ENTRY = struct.Struct('<IBBIHHH')
_WORD = 1 << 32


class LogKind(IntEnum):
    """Kind of an entry."""

    BOOT = 1
    ESTOP = 2
    EXPIRED = 3
    IMU = 4
    RADIO = 5
    BATTERY = 6
    RECORDS = 7
    LOOP = 8


_TEXTS: dict[int, str] = {
    LogKind.ESTOP: 'emergency stop',
    LogKind.EXPIRED: 'stopped by itself: no command in time',
    LogKind.IMU: 'the inertial sensor does not answer',
    LogKind.RADIO: 'the radio chip does not answer',
    LogKind.BATTERY: 'battery below its cut-off: {:.1f} V',
    LogKind.LOOP: 'longest pass of the main loop: {:.1f} ms',
}


class LogEntry(NamedTuple):
    """An entry of the log."""

    number: int
    """Counts all entries, modulo 2**32."""
    kind: int
    """A LogKind."""
    uptime: int
    """Time since the boot before, s."""
    value: int
    """Reset cause, millivolts, state or microseconds, by the kind."""


def read_log() -> Script[tuple[LogEntry, ...]]:
    """Return the entries of the log, oldest first."""
    yield from wait_for_board()
    places = []
    for place in range(_PLACES):
        places.append((yield from request_part(Record(0, LOG_RECORD, place))).data)
    return decode_log(places)


def decode_log(places: Iterable[bytes]) -> tuple[LogEntry, ...]:
    """Return the valid entries of a ring, oldest first."""
    entries = []
    for data in places:
        number, kind, _, uptime, value, _, crc = _ENTRY.unpack(data)
        if crc == crc16(data[:-2]):
            entries.append(LogEntry(number, kind, uptime, value))
    if not entries:
        return ()
    # The numbers wrap: all lie within 16 before the newest.
    first = entries[0].number
    return tuple(sorted(entries, key=lambda entry: (entry.number - first + _WORD // 2) % _WORD))


def format_log(entries: tuple[LogEntry, ...]) -> str:
    """Return the log as text, one entry a line."""
    if not entries:
        return 'the log is empty'
    return '\n'.join(
        f'{entry.number:>6}  {entry.uptime:>7} s  {_describe(entry)}' for entry in entries
    )


def _describe(entry: LogEntry) -> str:
    kind, value = entry.kind, entry.value
    if kind == LogKind.BOOT:
        return f'boot: {reset_cause(value)}'
    if kind == LogKind.RECORDS:
        known = value < len(SETTINGS_TEXTS)
        return SETTINGS_TEXTS[value] if known else f'records in state {value}'
    return _TEXTS.get(kind, f'unknown entry {kind}: {value}').format(value / 1000)
