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
"""Encoding and decoding of every frame of protocol 2; the layouts are one table at the end.

A frame is decoded completely or rejected, and a value that does not fit is not encoded: FrameError
names the frame, the field, the bound and the value. All numbers are little endian.
"""

import struct
from typing import Any, NamedTuple, get_args

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import PAYLOAD_LIMIT, FrameError, FrameErrorKind


class ExchangeStatus(NamedTuple):
    """Result of the transmission of one radio payload."""

    acknowledged: bool
    has_payload: bool  # whether the acknowledgement carried a payload
    failed: bool  # no transmission was acknowledged (MAX_RT)
    skipped: bool  # not transmitted, because the payload before it failed
    retransmissions: int


def decode_exchange_status(status: int) -> ExchangeStatus:
    """Return the decoded status byte of a RESULT; FrameError: its bits contradict each other."""
    acknowledged, has_payload, failed, skipped = (bool(status & bit) for bit in (1, 2, 4, 8))
    retransmissions = status >> 4
    if (
        acknowledged + failed + skipped > 1
        or (has_payload and not acknowledged)
        or (skipped and retransmissions)
    ):
        raise FrameError(
            FrameErrorKind.VALUE, f'RESULT.status must be consistent: got {status:#04x}'
        )
    return ExchangeStatus(acknowledged, has_payload, failed, skipped, retransmissions)


def encode(
    frame: frames.Downlink
    | frames.Uplink
    | frames.ToDongle
    | frames.FromDongle
    | frames.ToBoard
    | frames.FromBoard,
) -> bytes:
    """Return the bytes of a frame without CRC, or raise FrameError with field, bound and value."""
    # The last field shows whether the optional end (nonce, tag, address) is present.
    fixed = _LAYOUTS[type(frame)][-1 if frame[-1] != b'' else 0].pack(frame)
    if isinstance(frame, frames.Transmit):
        _check_payloads(frame)
        return fixed + bytes([len(frame.first)]) + frame.first + frame.second
    if isinstance(frame, frames.Result):
        _check_result_payload(frame)
        return fixed + frame.payload
    return fixed


def layout(frame: Any) -> tuple[str, tuple[tuple[str, int], ...]]:
    """Return the name of a frame in docs/radio.md, and (name, size) of each fixed field."""
    form = _LAYOUTS[type(frame)][-1 if frame[-1] != b'' else 0]
    return form.name, form.field_sizes


def decode_downlink(data: bytes) -> frames.Downlink:
    """Return the radio payload from a host, or raise FrameError."""
    return _decode(data, _DOWNLINK)  # type: ignore[no-any-return]


def decode_uplink(data: bytes) -> frames.Uplink:
    """Return the radio payload from a robot, or raise FrameError."""
    return _decode(data, _UPLINK)  # type: ignore[no-any-return]


def decode_to_dongle(data: bytes) -> frames.ToDongle:
    """Return the USB frame from the host to the dongle, or raise FrameError."""
    if data[:1] != b'\x01':
        return _decode(data, _TO_DONGLE)  # type: ignore[no-any-return]
    if len(data) < 4:
        raise FrameError(
            FrameErrorKind.LENGTH, f'TX must be at least 4 bytes long: got {len(data)}'
        )
    end = 4 + data[3]
    frame = frames.Transmit(data[1], data[2], data[4:end], data[end:])
    if len(frame.first) != data[3]:
        raise FrameError(
            FrameErrorKind.LENGTH,
            f'TX must have {data[3]} bytes of payload: got {len(frame.first)}',
        )
    _check_payloads(frame)
    return frame


def decode_from_dongle(data: bytes) -> frames.FromDongle:
    """Return the USB frame from the dongle to the host, or raise FrameError."""
    if data[:1] != b'\x81':
        return _decode(data, _FROM_DONGLE)  # type: ignore[no-any-return]
    form = _LAYOUTS[frames.Result][0]
    frame: frames.Result = form.unpack(data[: form.size])._replace(payload=data[form.size :])
    _check_result_payload(frame)
    return frame


def decode_to_board(data: bytes) -> frames.ToBoard:
    """Return the USB frame from the host to the robot board, or raise FrameError."""
    return _decode(data, _TO_BOARD)  # type: ignore[no-any-return]


def decode_from_board(data: bytes) -> frames.FromBoard:
    """Return the USB frame from the robot board to the host, or raise FrameError."""
    return _decode(data, _FROM_BOARD)  # type: ignore[no-any-return]


class _Field(NamedTuple):
    name: str
    code: str
    low: int  # lower bound of a number, like the next the upper one; both are the length of bytes
    high: int

    def check(self, kind: str, value: object) -> None:
        if self.code.endswith('s'):
            if not isinstance(value, bytes) or len(value) != self.high:
                raise FrameError(
                    FrameErrorKind.VALUE,
                    f'{kind}.{self.name} must be {self.high} bytes: got {value!r}',
                )
        elif not isinstance(value, int) or not self.low <= value <= self.high:
            bound = f'from {self.low} to {self.high}' if self.low < self.high else f'{self.low}'
            raise FrameError(
                FrameErrorKind.VALUE, f'{kind}.{self.name} must be {bound}: got {value!r}'
            )


_RANGES = {
    'B': (0, 0xFF),
    'H': (0, 0xFFFF),
    'I': (0, 0xFFFFFFFF),
    'h': (-0x8000, 0x7FFF),
    'i': (-0x80000000, 0x7FFFFFFF),
}


class _Form:
    """One layout of a frame: its first byte, then fields ``name code [low high]``.

    A field that the frame type lacks is reserved and holds its one valid value.
    """

    def __init__(self, kind: Any, name: str, head: int, fields: str) -> None:
        self._kind, self.name, self.head = kind, name, head
        self._fields = []
        for text in fields.split(', '):
            field, code, *bounds = text.split()
            low, high = map(int, bounds) if bounds else _RANGES.get(code) or 2 * (int(code[:-1]),)
            self._fields.append(_Field(field, code, low, high))
        self._struct = struct.Struct('<B' + ''.join(field.code for field in self._fields))
        self.size = self._struct.size
        self._names = {field.name for field in self._fields}
        self.field_sizes = tuple(
            (field.name, struct.calcsize('<' + field.code)) for field in self._fields
        )

    def pack(self, frame: Any) -> bytes:
        values = []
        for field in self._fields:
            value = getattr(frame, field.name, field.low)
            field.check(self.name, value)
            values.append(value)
        for name, default in self._kind._field_defaults.items():
            # A value outside this form would be lost.
            if name not in self._names and name not in _VARIABLE_FIELDS:
                value = getattr(frame, name)
                if value != default:
                    raise FrameError(
                        FrameErrorKind.VALUE,
                        f'{self.name}.{name} must be {default!r} without '
                        f'{self._kind._fields[-1]}: got {value!r}',
                    )
        return self._struct.pack(self.head, *values)

    def unpack(self, data: bytes) -> Any:
        if len(data) != self.size:
            raise FrameError(
                FrameErrorKind.LENGTH,
                f'{self.name} must be at least {self.size} bytes long: got {len(data)}',
            )
        values = {}
        for field, value in zip(self._fields, self._struct.unpack(data)[1:], strict=True):
            field.check(self.name, value)
            if field.name in self._kind._fields:
                values[field.name] = value
        return self._kind(**values)


_VARIABLE_FIELDS = ('first', 'second', 'payload')  # fields of TX and RESULT with variable length


def _decode(data: bytes, table: dict[int, tuple[_Form, ...]]) -> Any:
    if not data or len(data) > PAYLOAD_LIMIT:
        raise FrameError(
            FrameErrorKind.LENGTH,
            f'a frame must have 1 to {PAYLOAD_LIMIT} bytes: got {len(data)}',
        )
    forms = table.get(data[0])
    if forms is None:
        if table in (_DOWNLINK, _UPLINK) and data[0] >> 4 != frames.VERSION:
            raise FrameError(
                FrameErrorKind.VERSION,
                f'version must be {frames.VERSION}: got {data[0] >> 4}',
            )
        raise FrameError(FrameErrorKind.KIND, f'kind of frame must be known: got {data[0]:#04x}')
    for form in forms:
        if form.size == len(data):
            return form.unpack(data)
    sizes = ' or '.join(str(form.size) for form in forms)
    raise FrameError(
        FrameErrorKind.LENGTH,
        f'{forms[0].name} must be {sizes} bytes long: got {len(data)}',
    )


def _check_payloads(frame: frames.Transmit) -> None:
    for name, payload, least in (('first', frame.first, 1), ('second', frame.second, 0)):
        if not least <= len(payload) <= PAYLOAD_LIMIT:
            raise FrameError(
                FrameErrorKind.LENGTH,
                f'TX.{name} must have {least} to {PAYLOAD_LIMIT} bytes: got {len(payload)}',
            )


def _check_result_payload(frame: frames.Result) -> None:
    statuses = decode_exchange_status(frame.first), decode_exchange_status(frame.second)
    expected = any(status.has_payload for status in statuses)
    if len(frame.payload) > PAYLOAD_LIMIT or bool(frame.payload) != expected:
        bound = f'1 to {PAYLOAD_LIMIT}' if expected else 'no'
        raise FrameError(
            FrameErrorKind.LENGTH,
            f'RESULT.payload must have {bound} bytes: got {len(frame.payload)}',
        )


# -- layouts --------------------------------------------------------------------------------------

_COMMAND = 'session B, seq B, flags B 0 7, ttl B, reserved B 0 0, left h, right h, echo_us I'
_PARAM_SET, _ACTION = 'session B, seq B, id B, value i', 'session B, seq B, verb B, reserved H 0 0'
_STATE = (
    'session B, seq B, status B, time_us I, left i, right i, gyro_z h, accel_x h, accel_y h, '
    'age H, ranges 8s'
)
_INFO = (
    'session B, seq B, protocol B, major B, minor B, reset_cause B, parameters B, '
    'steps_per_rev H, microsteps H, refusal B, settings B 0 5, channel B 0 125, address 5s, '
    'build I'
)
_AUX = (
    'session B, seq B, status B, battery H, temperature h, accel_z h, gyro_x h, gyro_y h, '
    'received H, duplicates H, bad_session H, stale H, expired H, bad_version H, malformed H, '
    'refusal B, refused 3s'
)
_RADIO_SETUP = (
    'id B, channel B 0 125, rate B 0 2, power B 0 3, retry_delay B 0 15, retries B 0 15, '
    'address 5s'
)
_PONG = (
    'id B, echo 4s, time_us I, protocol B, major B, minor B, chip_ok B 0 1, crc_errors H, '
    'frame_errors H, overruns H, reset_cause B, settings B 0 5, channel B 0 125, address 5s, '
    'build I'
)
_RECORD, _PART = 'id B, record B, part B', 'id B, rc B 0 5, record B, state B 0 4, size B, part B'
_SAMPLES = (
    'id B, ranges 16s, battery H, accel_x h, accel_y h, accel_z h, gyro_x h, gyro_y h, gyro_z h'
)
_HELLO = 'session B 1 255, seq B, flags B'
_SIGNATURE = ', host_us I, tag 8s'
_LAYOUTS: dict[Any, tuple[_Form, ...]] = {
    kind: tuple(_Form(kind, name, head, text) for text in texts)
    for kind, name, head, *texts in (
        (frames.Command, 'CMD', 0x21, _COMMAND, _COMMAND + _SIGNATURE),
        (frames.ParamGet, 'PARAM_GET', 0x22, 'session B, seq B, id B'),
        (frames.ParamSet, 'PARAM_SET', 0x23, _PARAM_SET, _PARAM_SET + _SIGNATURE),
        (
            frames.Hello,
            'HELLO',
            0x24,
            f'{_HELLO} 0 0',
            f'{_HELLO} 1 1, host_us I, nonce 8s, tag 8s',
        ),
        (frames.Poll, 'POLL', 0x25, 'session B, seq B, what B 0 2'),
        (frames.Action, 'ACTION', 0x26, _ACTION, _ACTION + _SIGNATURE),
        (frames.State, 'STATE', 0x21, _STATE),
        (frames.Param, 'PARAM', 0x22, 'session B, seq B, id B, rc B 0 4, value i, low i, high i'),
        (frames.Info, 'INFO', 0x23, _INFO, _INFO + ', nonce 8s'),
        (frames.Ack, 'ACK', 0x24, 'session B, seq B, verb B, rc B 0 4'),
        (frames.Aux, 'AUX', 0x25, _AUX),
        (frames.Transmit, 'TX', 0x01, 'id B, gap B'),
        (frames.Configure, 'CFG', 0x02, 'id B', _RADIO_SETUP),
        (frames.Ping, 'PING', 0x03, 'id B, echo 4s'),
        (frames.Key, 'KEY', 0x04, 'id B', 'id B, key 16s'),
        (frames.Record, 'RECORD', 0x06, _RECORD, _RECORD + ', data 16s'),
        (frames.Store, 'STORE', 0x07, 'id B, record B, crc H'),
        (frames.Sense, 'SENSE', 0x08, 'id B'),
        (frames.Result, 'RESULT', 0x81, 'id B, first B, second B, dongle_us I'),
        (frames.Configured, 'CFG', 0x82, _RADIO_SETUP + ', chip_ok B 0 1'),
        (frames.Pong, 'PONG', 0x83, _PONG),
        (frames.KeyState, 'KEY', 0x84, 'id B, rc B 0 5, state B 0 2, check I'),
        (frames.RecordPart, 'RECORD', 0x86, _PART + ', data 16s'),
        (frames.Samples, 'SENSE', 0x88, _SAMPLES),
        (frames.Refusal, 'ERR', 0x8F, 'code B 1 3, argument B'),
    )
}


def _table(union: Any) -> dict[int, tuple[_Form, ...]]:
    """Return the layouts of one way by their first byte."""
    return {_LAYOUTS[kind][0].head: _LAYOUTS[kind] for kind in get_args(union)}


_DOWNLINK, _UPLINK = _table(frames.Downlink), _table(frames.Uplink)
_TO_DONGLE, _FROM_DONGLE = _table(frames.ToDongle), _table(frames.FromDongle)
_TO_BOARD, _FROM_BOARD = _table(frames.ToBoard), _table(frames.FromBoard)
