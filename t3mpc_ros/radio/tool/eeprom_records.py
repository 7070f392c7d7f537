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
"""Records in the EEPROM of the robot: settings and calibration, over the USB of its board.

The robot holds each record in two copies with a CRC. A record is written completely or not at
all: a loss of power at any cell leaves the old values, the new ones, or a robot that accepts no
session.
docs/radio.md has the layouts and units of the wire; this module has SI units.

:func:`~t3mpc_ros.radio.tool.procedure.run_script` runs a script at a port::

    stored = run_script(write_calibration(found), '/dev/ttyACM0', interrupted, ROBOT_BOARD)
"""

from collections.abc import Callable, Mapping
import math
import string
import struct
from typing import Any, Generic, NamedTuple, TypeVar

from t3mpc_ros.parameters.table import number_hint
from t3mpc_ros.parameters.yaml_checks import YamlError, parameter_file, shortened
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
_SETTINGS = struct.Struct('<BBH5sBBHBH8s')
_SETTINGS_FORMAT, _CALIBRATION_FORMAT = 2, 1
_CALIBRATION = struct.Struct('<BIHIHhHhHhhH')
_CURVE = struct.Struct('<HhhB')
_MILLIDEGREE = math.radians(1e-3)


class RobotSettings(NamedTuple):
    """Settings of the robot; the defaults are those of a robot that was never set up."""

    address: bytes = b'T3MPC'  # 5 bytes that are not all equal, last transmitted byte first
    channel: int = 82  # 2400 MHz plus this, 0 to 125
    rate: str = '1M'  # one of ``frames.RATES``
    power: str = '0'  # one of ``frames.POWERS``
    microsteps: int = 16  # per full step, a power of two up to 256
    steps_per_turn: int = 200  # full steps of a turn of the wheel, 20 to 10000
    invert_left: bool = False  # the motor is mounted or wired in reverse
    invert_right: bool = False
    divider: float = 4.0  # battery voltage / voltage at the converter, 1 to 13
    battery_wired: bool = False
    """The battery is measured, so that 0 V (a broken wire) stops the robot."""
    sensors: tuple[str, ...] = SENSOR_COUNT * ('GP2Y0A21',)
    """One of :data:`SENSORS` each, in the order of STATE."""


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


def encode_settings(settings: RobotSettings) -> bytes:
    """Return the record of the settings."""
    check_settings(settings)
    return _SETTINGS.pack(
        _SETTINGS_FORMAT,
        settings.channel,
        settings.microsteps,
        settings.address,
        frames.RATES.index(settings.rate),
        frames.POWERS.index(settings.power),
        settings.steps_per_turn,
        settings.invert_left + 2 * settings.invert_right + 4 * settings.battery_wired,
        round(1000.0 * settings.divider),
        bytes(SENSORS.index(name) for name in settings.sensors),
    )


def check_settings(settings: RobotSettings) -> None:
    """Raise ValueError for the first impossible value."""
    sensors, powers = settings.sensors, [1 << power for power in range(9)]
    full = len(settings.address) == 5 and len(set(settings.address)) > 1
    known = len(sensors) == SENSOR_COUNT and set(sensors) <= set(SENSORS)
    bounds = (
        ('address', full, '10 hexadecimal digits, not of equal bytes'),
        ('channel', 0 <= settings.channel <= 125, 'from 0 to 125'),
        ('rate', settings.rate in frames.RATES, f'one of {", ".join(frames.RATES)}'),
        ('power', settings.power in frames.POWERS, f'one of {", ".join(frames.POWERS)} dBm'),
        ('microsteps', settings.microsteps in powers, 'a power of two from 1 to 256'),
        ('steps_per_turn', 20 <= settings.steps_per_turn <= 10_000, 'from 20 to 10000'),
        ('divider', 1.0 <= settings.divider <= 13.0, 'from 1 to 13'),
        ('sensors', known, f'{SENSOR_COUNT} of {", ".join(SENSORS)}'),
    )
    for name, good, bound in bounds:
        if not good:
            value = settings.address.hex() if name == 'address' else getattr(settings, name)
            raise ValueError(f'{name} must be {bound}: got {value!r}')


def decode_settings(body: bytes) -> RobotSettings:
    """Return the settings of a record of the robot; ValueError for another format."""
    _, channel, microsteps, address, rate, power, steps, inverted, divider, sensors = _unpack(
        'settings', _SETTINGS, _SETTINGS_FORMAT, body
    )
    settings = RobotSettings(
        address,
        channel,
        _choice(frames.RATES, rate),
        _choice(frames.POWERS, power),
        microsteps,
        steps,
        bool(inverted & 1),
        bool(inverted & 2),
        divider / 1000.0,
        bool(inverted & 4),
        tuple(_choice(SENSORS, number) for number in sensors),
    )
    check_settings(settings)
    return settings


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
    _, *values = _unpack('calibration', _CALIBRATION, _CALIBRATION_FORMAT, head)
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


def _unpack(name: str, layout: struct.Struct, number: int, body: bytes) -> tuple[Any, ...]:
    if len(body) != layout.size or body[0] != number:
        raise ValueError(
            f'{name} must be of format {number}: got {len(body)} bytes, format {body[:1].hex()}'
        )
    return layout.unpack(body)


def _choice(names: tuple[str, ...], number: int) -> str:
    return names[number] if number < len(names) else f'number {number}'


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


SETTINGS_TEXTS = (
    'settings stored in both copies',
    'settings stored, one of their two copies is damaged: t3mpc robot setup writes both',
    'no settings: the robot does not move until t3mpc robot setup --microsteps N stores them',
    'settings damaged: the robot does not move until t3mpc robot setup',
    'settings of an older firmware: the robot does not move until t3mpc robot setup',
    'calibration damaged: the robot does not move until it is written again',
)
"""By state of the settings."""
ADDRESS_SIZE = 5
_CONFUSABLE = (0x00, 0x55, 0xAA, 0xFF)
"""Bytes that the receiver takes for noise or a preamble (nRF24L01+ data sheet 1.0, 7.3.2)."""
_LINK = ('address', 'channel', 'rate')  # settings that are link parameters of the host too
_KINDS = {int: 'a whole number', float: 'a number', bool: 'true or false', str: 'text in quotes'}
_BOARD = '/robot_board'  # name of no node: a node rejects parameters that it does not have


StoredSettings = Stored[RobotSettings]


def draw_address(entropy: Callable[[int], bytes]) -> bytes:
    """Return a random address; its text is no number, which ROS would not take for a string."""
    while True:
        address = entropy(ADDRESS_SIZE)
        letters = set(address.hex()) & set('abcdf')
        if letters and len(set(address)) > 1 and not set(address) & set(_CONFUSABLE):
            return address


def parse_address(text: object) -> bytes:
    """Return an address written as 10 hexadecimal digits; YamlError: it is none."""
    if not isinstance(text, str):
        raise YamlError(
            f'address must be text in quotes, 10 hexadecimal digits: got {shortened(text)}'
        )
    if len(text) != 2 * ADDRESS_SIZE or set(text.lower()) - set(string.hexdigits):
        raise YamlError(
            f'address must be 10 hexadecimal digits, such as 54334d5043: got {shortened(text)}'
        )
    return bytes.fromhex(text)


def read_settings() -> procedure.Script[StoredSettings]:
    """Return the settings of the robot."""
    stored = yield from read_record(frames.SETTINGS_RECORD)
    return stored.decoded(decode_settings)


def change_settings(
    stored: StoredSettings, changes: Mapping[str, object], entropy: Callable[[int], bytes]
) -> RobotSettings:
    """Return settings with changes by name; a robot without any gets a random address."""
    settings = stored.content._replace(**changes)  # type: ignore[arg-type]
    if not stored.valid and 'address' not in changes:
        settings = settings._replace(address=draw_address(entropy))
    check_settings(settings)
    return settings


def write_settings(settings: RobotSettings) -> procedure.Script[StoredSettings]:
    """Store settings in both copies; return what the robot holds."""
    body = yield from write_record(frames.SETTINGS_RECORD, encode_settings(settings))
    return StoredSettings(frames.SETTINGS_GOOD, decode_settings(body))


def differences(old: RobotSettings, new: RobotSettings) -> str:
    """Return a line for each setting that differs; the sensors one by one."""
    pairs = [(name, getattr(old, name), getattr(new, name)) for name in old._fields[:-1]]
    pairs += [
        (f'sensors[{number}]', before, after)
        for number, (before, after) in enumerate(zip(old.sensors, new.sensors, strict=True))
    ]
    return '\n'.join(f'{name}: {_text(a)} -> {_text(b)}' for name, a, b in pairs if a != b)


def format_settings(stored: StoredSettings) -> str:
    """Return the settings as text."""
    lines = [SETTINGS_TEXTS[stored.state]]
    if not stored.valid:
        return lines[0]
    settings = stored.content
    same = len(set(settings.sensors)) == 1
    for name in settings._fields[:-1]:
        lines.append(f'  {name:<15} {_text(getattr(settings, name))}')
    sensors = settings.sensors[:1] if same else settings.sensors
    lines.append(f'  {"sensors":<15} {"8 x " if same else ""}{", ".join(sensors)}')
    return '\n'.join(lines)


def settings_file(settings: RobotSettings) -> str:
    """Return a ROS parameter file: the link parameters of the host, and all other settings."""
    values: dict[str, object] = settings._asdict()
    values |= {'address': settings.address.hex(), 'sensors': list(settings.sensors)}
    link = {name: values.pop(name) for name in _LINK}
    title = 'Settings of the robot, written by t3mpc robot setup.'
    return parameter_file(title, {'/**': {'link': link}, _BOARD: values})


def settings_of_file(content: object) -> RobotSettings:
    """Return the settings of a file of :func:`settings_file`, parsed as YAML."""
    values: dict[str, Any] = {'battery_wired': False}  # which older files lack
    try:
        link = content['/**']['ros__parameters']['link']  # type: ignore[index]
        board = content[_BOARD]['ros__parameters']  # type: ignore[index]
        values |= {**link, **board}
        values['address'] = parse_address(values['address'])
        if not isinstance(values['sensors'], list):
            raise YamlError(
                f'sensors must be a list of {SENSOR_COUNT}: got {shortened(values["sensors"])}'
            )
        values['sensors'] = tuple(map(str, values['sensors']))
    except YamlError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise YamlError(
            f'must be a file of t3mpc robot setup --save, with link below /**, and {_BOARD}'
        ) from error
    known = {*RobotSettings._fields}
    unknown, missing = {*values} - known, known - {*values}
    if unknown or missing:
        names = ', '.join(sorted(unknown or missing))
        raise YamlError(f'{"has unknown" if unknown else "lacks the"} settings: {names}')
    settings = RobotSettings(**values)
    for name, kind in RobotSettings.__annotations__.items():
        value = getattr(settings, name)
        allowed = {float: (int, float)}.get(kind, (kind,))
        if kind in (int, bool, float, str) and type(value) not in allowed:
            raise YamlError(
                f'{name} must be {_KINDS[kind]}: got {shortened(value)}{number_hint(value)}'
            )
    try:
        check_settings(settings)
    except (TypeError, ValueError) as error:
        raise YamlError(str(error)) from error
    return settings


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return str(value)
