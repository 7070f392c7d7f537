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
"""Records in the EEPROM of the robot, and its calibration among them, over the USB of its board.

The robot holds each record in two copies with a CRC. A record is written completely or not at
all: a loss of power at any cell leaves the old values, the new ones, or a robot that accepts no
session.
docs/radio.md has the layouts and units of the wire; this module has SI units.

:func:`~t3mpc_ros.radio.tool.procedure.run_script` runs a script at a port::

    stored = run_script(write_calibration(found), '/dev/ttyACM0', interrupted, ROBOT_BOARD)
"""

from collections.abc import Callable
import math
import struct
from typing import Any, Generic, NamedTuple, TypeVar

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.radio.tool import procedure
from t3mpc_ros.robot.calibration import Calibration, DividerCorrection, Estimate, SharpCurve

SENSORS = ('none', 'GP2Y0A21', 'GP2Y0A41')  # types of a distance sensor
SENSOR_COUNT = 8
NOT_MEASURED = 0xFFFF  # count of a sensor that the converter has not measured
_SAMPLE_PERIOD = 0.05  # s; a distance sensor measures every 38 ms
_WRITE_TIMEOUT = 2.0  # s; at most 174 EEPROM cells of 3.4 ms, and the load of the radio
_MAX_ATTEMPTS = 5
SETTINGS_FORMAT, _CALIBRATION_FORMAT = 2, 1
_CALIBRATION = struct.Struct('<BIHIHhHhHhhH')
_CURVE = struct.Struct('<HhhB')
_MILLIDEGREE = math.radians(1e-3)


Content = TypeVar('Content')
Decoded = TypeVar('Decoded')


class Stored(NamedTuple, Generic[Content]):
    """A record of the robot."""

    state: int  # SETTINGS_GOOD, …
    content: Content  # in effect; of the defaults unless ``valid``

    @property
    def valid(self) -> bool:
        """Whether the robot holds the record, in one copy at least."""
        return self.state in (frames.SETTINGS_GOOD, frames.SETTINGS_ONE_COPY)

    def decoded(self, decode: Callable[[Content], Decoded]) -> 'Stored[Decoded]':
        """Return the record decoded; ProcedureError: it is valid, but of a newer firmware."""
        try:
            return Stored(self.state, decode(self.content))
        except ValueError as error:
            raise procedure.ProcedureError(
                f'the robot holds a record that this host does not know ({error}): update the host'
            ) from error


# -- layouts --------------------------------------------------------------------------------------


_ESTIMATES = {
    'wheel_radius': (0.0, 1e-7, 10_000, 100_000_000),
    'track': (0.0, 1e-7, 10_000, 100_000_000),
    'gyro_scale': (1.0, 1e-5, -20_000, 20_000),
    'gyro_bias': (0.0, _MILLIDEGREE, -0x8000, 0x7FFF),
}
"""Value that is stored as 0, unit, least and largest number of units of each estimate."""


def encode_calibration(calibration: Calibration) -> bytes:
    """Return the record of a calibration; ValueError names a value that does not fit.

    Lengths are 1 mm to 10 m with an uncertainty of at most 6.5 mm, the scale of the gyro 0.8 to
    1.2, its bias at most 0.57 rad/s, the gain of the divider at most 0.2.
    """
    if len(calibration.curves) != SENSOR_COUNT:
        raise ValueError(f'curves must be {SENSOR_COUNT}: got {len(calibration.curves)}')
    values: list[int] = []
    for name, (zero, unit, low, high) in _ESTIMATES.items():
        estimate: Estimate | None = getattr(calibration, name)
        if estimate is None:
            values += 0, 0
        else:
            values.append(_steps(name, estimate.value, unit, low, high, zero))
            values.append(_ceil(f'{name}.uncertainty', estimate.uncertainty, unit, 0xFFFF))
    if calibration.divider is None:
        values += 0, 0, 0
    else:
        gain, offset, uncertainty = calibration.divider
        values.append(_steps('divider.gain', gain, 1e-5, -20_000, 20_000))
        values.append(_steps('divider.offset', offset, 1e-3, -0x8000, 0x7FFF))
        values.append(_ceil('divider.uncertainty', uncertainty, 1e-3, 0xFFFF))
    head = _CALIBRATION.pack(_CALIBRATION_FORMAT, *values)
    return head + b''.join(
        _encode_curve(f'curves[{number}]', curve)
        for number, curve in enumerate(calibration.curves)
    )


def decode_calibration(body: bytes) -> Calibration:
    """Return the calibration of a record of the robot; ValueError for another format."""
    head = body[: _CALIBRATION.size]
    if len(body) != _CALIBRATION.size + SENSOR_COUNT * _CURVE.size:
        raise ValueError(f'calibration must be a known format: got {len(body)} bytes')
    _, *values = unpack('calibration', _CALIBRATION, _CALIBRATION_FORMAT, head)
    *pairs, gain, offset, battery = values
    estimates = {
        name: Estimate(zero + unit * steps, unit * uncertainty) if uncertainty else None
        for (name, (zero, unit, *_)), steps, uncertainty in zip(
            _ESTIMATES.items(), pairs[::2], pairs[1::2], strict=True
        )
    }
    return Calibration(
        **estimates,
        divider=DividerCorrection(1e-5 * gain, 1e-3 * offset, 1e-3 * battery) if battery else None,
        curves=tuple(
            SharpCurve(1e-4 * scale, 1e-4 * shift, 1e-4 * level, 1e-3 * error) if error else None
            for scale, shift, level, error in _CURVE.iter_unpack(body[_CALIBRATION.size :])
        ),
    )


def unpack(name: str, layout: struct.Struct, number: int, body: bytes) -> tuple[Any, ...]:
    """Return the fields of a record; ValueError: it is of another length or format."""
    if len(body) != layout.size or body[0] != number:
        raise ValueError(
            f'{name} must be of format {number}: got {len(body)} bytes, format {body[:1].hex()}'
        )
    return layout.unpack(body)


def _steps(name: str, value: float, unit: float, low: int, high: int, zero: float = 0.0) -> int:
    steps = round((value - zero) / unit) if math.isfinite(value) else high + 1
    if not low <= steps <= high:
        least, most = zero + low * unit, zero + high * unit
        raise ValueError(f'{name} must be from {least:.6g} to {most:.6g}: got {value}')
    return steps


def _ceil(name: str, value: float, unit: float, high: int) -> int:
    """Return an uncertainty in units; never less than it is, and never 0."""
    # Stored and read back it is the same, though 3e-4 / 1e-4 is above 3.
    steps = math.ceil(value / unit - 1e-6) if 0.0 < value < math.inf else high + 1
    if max(steps, 1) > high:
        raise ValueError(f'{name} must be above 0, up to {high * unit:.6g}: got {value}')
    return max(steps, 1)


def _encode_curve(name: str, curve: SharpCurve | None) -> bytes:
    if curve is None:
        return bytes(_CURVE.size)
    return _CURVE.pack(
        _steps(f'{name}.scale', curve.scale, 1e-4, 1, 10_485),
        _steps(f'{name}.shift', curve.shift, 1e-4, -0x8000, 0x7FFF),
        _steps(f'{name}.offset', curve.offset, 1e-4, -0x8000, 0x7FFF),
        _ceil(f'{name}.uncertainty', curve.uncertainty, 1e-3, 0xFF),
    )


# -- scripts --------------------------------------------------------------------------------------


def read_calibration() -> procedure.Script[Calibration]:
    """Return the calibration of the robot, all None if it was never calibrated."""
    stored = yield from read_record(frames.CALIBRATION_RECORD)
    if stored.state == frames.SETTINGS_DAMAGED:
        raise procedure.ProcedureError(
            'the calibration of the robot is damaged, so it accepts no session: write it again'
        )
    return stored.decoded(decode_calibration).content


def write_calibration(calibration: Calibration) -> procedure.Script[Calibration]:
    """Store a calibration in both copies; return what the robot now holds, rounded to its units.

    It replaces the old one completely: to change a value, write ``read_calibration()`` with it
    replaced. The session of the robot ends, and the values are in effect at once. The robot must
    stand still, with its drivers off.
    """
    body = encode_calibration(calibration)
    return decode_calibration((yield from write_record(frames.CALIBRATION_RECORD, body)))


def read_samples() -> procedure.Script[frames.Samples]:
    """Return the newest raw samples of distance sensors, battery and inertial sensor."""
    return (yield from procedure.request_reply(frames.Sense(0), frames.Samples))


def range_counts(samples: frames.Samples) -> tuple[int, ...]:
    """Return the counts of the eight distance sensors, in the order of STATE."""
    return struct.unpack('<8H', samples.ranges)


def read_counts(samples: int) -> procedure.Script[list[tuple[int, ...]]]:
    """Return samples of the raw counts: eight distance sensors and, last, the battery."""
    yield from procedure.wait_for_board()
    counts = []
    for _ in range(samples):
        sample = yield from read_samples()
        counts.append((*range_counts(sample), sample.battery))
        yield procedure.Pause(_SAMPLE_PERIOD)
    return counts


def read_record(record: int) -> procedure.Script[Stored[bytes]]:
    """Return a record, after the board has answered."""
    yield from procedure.wait_for_board()
    return (yield from _read_parts(record))


def write_record(record: int, body: bytes) -> procedure.Script[bytes]:
    """Stage and store a record; return its content. A lost answer is harmless: it is read back."""
    yield from procedure.wait_for_board()
    for _ in range(_MAX_ATTEMPTS):
        for part, at in enumerate(range(0, len(body), frames.PART_SIZE)):
            data = body[at : at + frames.PART_SIZE].ljust(frames.PART_SIZE, b'\0')
            yield from request_part(frames.Record(0, record, part, data))
        response = yield procedure.Request(frames.Store(0, record, crc16(body)), _WRITE_TIMEOUT)
        if isinstance(response.reply, frames.RecordPart):
            check_stored(response.reply.rc)
        stored = yield from _read_parts(record)
        if stored.state == frames.SETTINGS_GOOD and stored.content == body:
            return body
    raise procedure.ProcedureError('the robot does not confirm the record: is the cable good?')


def check_stored(rc: int) -> None:
    """Raise ProcedureError for the answer of a robot that does not store a record or key."""
    if rc in _REASONS:
        raise procedure.ProcedureError(_REASONS[rc])


_REASONS = {
    frames.OUT_OF_RANGE: 'the robot rejects the values: is its firmware older than this host?',
    frames.BUSY: (
        'the robot stores nothing while it moves, its drivers are on, or it writes: stop the '
        'bridge, or press the reset button of the board'
    ),
    frames.FAILED: (
        'the EEPROM of the board did not store this: the robot is locked; try again; '
        'if it fails repeatedly, the chip is worn out'
    ),
}


def _read_parts(record: int) -> procedure.Script[Stored[bytes]]:
    first = yield from request_part(frames.Record(0, record, 0))
    body = first.data
    for part in range(1, -(-first.size // frames.PART_SIZE)):
        body += (yield from request_part(frames.Record(0, record, part))).data
    return Stored(first.state, body[: first.size])


def request_part(request: frames.Record) -> procedure.Script[frames.RecordPart]:
    """Return the answer to a RECORD, or raise ProcedureError."""
    reply = yield from procedure.request_reply(request, frames.RecordPart)
    if reply.rc != frames.OK:
        raise procedure.ProcedureError(procedure.OLD_FIRMWARE)
    return reply


# -- settings: their changes, text and file -------------------------------------------------------
