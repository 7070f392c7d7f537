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
"""What the robot tells: identity and parameters by radio, its log over the USB of its board."""

from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
import struct
from typing import NamedTuple

from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.handshake import Session
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_uplink, encode
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.radio.tool import procedure
from t3mpc_ros.radio.tool.eeprom_records import request_part
from t3mpc_ros.radio.tool.robot_settings import SETTINGS_TEXTS

_REPLY_TIMEOUT = 0.25  # s
_MAX_ATTEMPTS = 20


class RobotInfo(NamedTuple):
    """Identity and board parameters of the robot."""

    info: frames.Info
    values: tuple[frames.Param, ...]


def read_robot_info(
    parameters: LinkParameters, key: bytes, entropy: Callable[[int], bytes]
) -> procedure.Script[RobotInfo]:
    """Return identity and board parameters of the robot.

    They are read in the current session of the robot, which continues undisturbed. Without one, a
    session is started, which needs the key if the robot has one.
    """
    yield from procedure.wait_for_dongle()
    before = yield from procedure.read_radio_setup()
    try:
        yield from procedure.configure_radio(parameters.configure(0))
        info = yield from _request_info(parameters)
        if not info.session:
            info = yield from _start_session(parameters, Session(key, entropy, 0, 0))
        values = []
        for number in range(info.parameters):
            values.append((yield from _read_parameter(parameters, info.session, number)))
    finally:
        yield from procedure.configure_radio(before)
    return RobotInfo(info, tuple(values))


def _transact(
    parameters: LinkParameters, first: frames.Downlink, what: int
) -> procedure.Script[frames.Uplink | None]:
    payloads = encode(first), encode(frames.Poll(0, 0, what))
    response = yield procedure.Request(
        frames.Transmit(0, parameters.gap_after(first), *payloads), _REPLY_TIMEOUT
    )
    if isinstance(response.reply, frames.Result) and response.reply.payload:
        try:
            return decode_uplink(response.reply.payload)
        except frames.FrameError as error:
            if error.kind is frames.FrameErrorKind.VERSION:
                version = response.reply.payload[0] >> 4
                raise procedure.ProcedureError(reasons.robot_version(version)) from error
            return None
    return None


def _request_info(parameters: LinkParameters) -> procedure.Script[frames.Info]:
    for _ in range(_MAX_ATTEMPTS):
        answer = yield from _transact(parameters, frames.Poll(0, 0, frames.INFO), frames.INFO)
        if isinstance(answer, frames.Info):
            if answer.protocol != frames.VERSION:
                raise procedure.ProcedureError(reasons.robot_version(answer.protocol))
            return answer
    raise procedure.ProcedureError(reasons.robot_absent(parameters.address, parameters.channel))


def _start_session(parameters: LinkParameters, session: Session) -> procedure.Script[frames.Info]:
    problem = reasons.robot_absent(parameters.address, parameters.channel)
    for number in range(_MAX_ATTEMPTS):
        # An artificial clock, strictly increasing: no command is sent in this session.
        hello = session.hello(1000 * number)
        answer = yield from _transact(parameters, hello, frames.INFO)
        if isinstance(answer, frames.Info):
            problem = session.accept(answer)
            if not problem:
                return answer
    raise procedure.ProcedureError(problem)


def _read_parameter(
    parameters: LinkParameters, session: int, number: int
) -> procedure.Script[frames.Param]:
    for seq in range(_MAX_ATTEMPTS):
        answer = yield from _transact(
            parameters, frames.ParamGet(session, seq, number), frames.STATE
        )
        if isinstance(answer, frames.Param) and (answer.id, answer.seq) == (number, seq):
            return answer
    raise procedure.ProcedureError('the robot stopped answering: is another host connected to it?')


def format_robot_info(robot: RobotInfo, parameters: LinkParameters) -> str:
    """Return the parameters as text: value, bounds, and the value that the bridge writes."""
    info, targets = robot.info, parameters.robot.to_wire()
    signed = 'signed commands only' if info.nonce else 'no key'
    lines = [
        f'firmware {info.major}.{info.minor}, {info.steps_per_rev} steps of {info.microsteps} '
        f'microsteps, {signed}',
        f'build {info.build:08x}, address {info.address.hex()}, channel {info.channel}, '
        f'{SETTINGS_TEXTS[info.settings]}',
        '',
        f'{"parameter":<14}  {"value":>7}  {"unit":<7}  {"allowed":<16}  {"bridge sets":>11}',
    ]
    for value in robot.values:
        lines.append(_format_parameter(value, targets.get(value.id)))
    return '\n'.join(lines)


def _format_parameter(value: frames.Param, target: int | None) -> str:
    known: Sequence[frames.BoardParameter] = frames.BOARD_PARAMETERS
    row = known[value.id] if value.id < len(known) else None
    name, unit = (row.name, row.unit) if row else (f'number {value.id}', '')
    bounds = 'fixed' if row and row.read_only else f'{value.low} to {value.high}'
    sets = '' if target is None else str(target)
    return f'{name:<14}  {value.value:>7}  {unit:<7}  {bounds:<16}  {sets:>11}'.rstrip()


# -- log: resets, faults, longest pass of the main loop -------------------------------------------


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

    number: int  # counts all entries, modulo 2**32
    kind: int  # a LogKind
    uptime: int  # time since the boot before, s
    value: int  # reset cause, millivolts, state or microseconds, by the kind


def read_log() -> procedure.Script[tuple[LogEntry, ...]]:
    """Return the entries of the log, oldest first."""
    yield from procedure.wait_for_board()
    places = []
    for place in range(_PLACES):
        places.append((yield from request_part(frames.Record(0, frames.LOG_RECORD, place))).data)
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
        return f'boot: {reasons.reset_cause(value)}'
    if kind == LogKind.RECORDS:
        known = value < len(SETTINGS_TEXTS)
        return SETTINGS_TEXTS[value] if known else f'records in state {value}'
    return _TEXTS.get(kind, f'unknown entry {kind}: {value}').format(value / 1000)
