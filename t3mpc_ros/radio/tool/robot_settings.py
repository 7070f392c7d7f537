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
"""Settings of the robot: radio, motors, battery and sensors; their record, file and address."""

from collections.abc import Callable, Mapping
import string
import struct
from typing import Any, NamedTuple

from t3mpc_ros.parameters.table import number_hint
from t3mpc_ros.parameters.yaml_loader import YamlError, parameter_file, shortened
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.tool import procedure
from t3mpc_ros.radio.tool.eeprom_records import (
    SENSOR_COUNT,
    SENSORS,
    SETTINGS_FORMAT,
    Stored,
    read_record,
    unpack,
    write_record,
)

_SETTINGS = struct.Struct('<BBH5sBBHBH8s')


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


def encode_settings(settings: RobotSettings) -> bytes:
    """Return the record of the settings."""
    check_settings(settings)
    return _SETTINGS.pack(
        SETTINGS_FORMAT,
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
    _, channel, microsteps, address, rate, power, steps, inverted, divider, sensors = unpack(
        'settings', _SETTINGS, SETTINGS_FORMAT, body
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


def _choice(names: tuple[str, ...], number: int) -> str:
    return names[number] if number < len(names) else f'number {number}'


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
