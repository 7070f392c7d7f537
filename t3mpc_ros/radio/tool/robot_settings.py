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
"""Settings of the robot over the USB of its board: change, compare, save to and load from YAML."""

from collections.abc import Callable, Mapping
import string
from typing import Any, NamedTuple

from t3mpc_ros.parameters.table import number_hint
from t3mpc_ros.parameters.yaml_checks import parameter_file, shortened
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import SETTINGS_RECORD
from t3mpc_ros.radio.tool import eeprom_records
from t3mpc_ros.radio.tool.procedure import Script

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
_LINK = ('address', 'channel', 'rate')
"""Settings that are link parameters of the host too."""
_KINDS = {int: 'a whole number', float: 'a number', bool: 'true or false', str: 'text in quotes'}
_BOARD = '/robot_board'
"""Name of no node: a node rejects parameters that it does not have."""


class SettingsFileError(Exception):
    """A file of settings cannot be read or written; the text contains the reason."""


StoredSettings = eeprom_records.Stored[eeprom_records.RobotSettings]


class Difference(NamedTuple):
    """A setting with two values."""

    name: str
    old: object
    new: object


def draw_address(entropy: Callable[[int], bytes]) -> bytes:
    """Return a random address; its text is no number, which ROS would not take for a string."""
    while True:
        address = entropy(ADDRESS_SIZE)
        letters = set(address.hex()) & set('abcdf')
        if letters and len(set(address)) > 1 and not set(address) & set(_CONFUSABLE):
            return address


def parse_address(text: object) -> bytes:
    """Return an address written as 10 hexadecimal digits; SettingsFileError: it is none."""
    if not isinstance(text, str):
        raise SettingsFileError(
            f'address must be text in quotes, 10 hexadecimal digits: got {shortened(text)}'
        )
    if len(text) != 2 * ADDRESS_SIZE or set(text.lower()) - set(string.hexdigits):
        raise SettingsFileError(
            f'address must be 10 hexadecimal digits, such as 54334d5043: got {shortened(text)}'
        )
    return bytes.fromhex(text)


def read_settings() -> Script[StoredSettings]:
    """Return the settings of the robot."""
    stored = yield from eeprom_records.read_record(SETTINGS_RECORD)
    return stored.decoded(eeprom_records.decode_settings)


def change_settings(
    stored: StoredSettings, changes: Mapping[str, object], entropy: Callable[[int], bytes]
) -> eeprom_records.RobotSettings:
    """Return the settings with changes, by field name.

    A robot without settings gets a random address, so that two robots never obey one host by
    accident.
    """
    settings = stored.content._replace(**changes)  # type: ignore[arg-type]
    if not stored.valid and 'address' not in changes:
        settings = settings._replace(address=draw_address(entropy))
    eeprom_records.check_settings(settings)
    return settings


def write_settings(settings: eeprom_records.RobotSettings) -> Script[StoredSettings]:
    """Store settings in both copies; return what the robot holds."""
    body = yield from eeprom_records.write_record(
        SETTINGS_RECORD, eeprom_records.encode_settings(settings)
    )
    return StoredSettings(frames.SETTINGS_GOOD, eeprom_records.decode_settings(body))


def differences(
    old: eeprom_records.RobotSettings, new: eeprom_records.RobotSettings
) -> list[Difference]:
    """Return the settings that differ; the sensors one by one."""
    pairs = [(name, getattr(old, name), getattr(new, name)) for name in old._fields[:-1]]
    pairs += [
        (f'sensors[{number}]', before, after)
        for number, (before, after) in enumerate(zip(old.sensors, new.sensors, strict=True))
    ]
    return [Difference(*pair) for pair in pairs if pair[1] != pair[2]]


def format_differences(rows: list[Difference]) -> str:
    """Return one line for each difference."""
    return '\n'.join(f'{row.name}: {_text(row.old)} -> {_text(row.new)}' for row in rows)


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


def settings_file(settings: eeprom_records.RobotSettings) -> str:
    """Return a ROS parameter file: the link parameters of the host, and all other settings."""
    values: dict[str, object] = settings._asdict()
    values |= {'address': settings.address.hex(), 'sensors': list(settings.sensors)}
    link = {name: values.pop(name) for name in _LINK}
    title = 'Settings of the robot, written by t3mpc robot setup.'
    return parameter_file(title, {'/**': {'link': link}, _BOARD: values})


def settings_of_file(content: object) -> eeprom_records.RobotSettings:
    """Return the settings of a file of :func:`settings_file`, parsed as YAML."""
    values: dict[str, Any] = {'battery_wired': False}  # which older files lack
    try:
        link = content['/**']['ros__parameters']['link']  # type: ignore[index]
        board = content[_BOARD]['ros__parameters']  # type: ignore[index]
        values |= {**link, **board}
        values['address'] = parse_address(values['address'])
        if not isinstance(values['sensors'], list):
            raise SettingsFileError(
                f'sensors must be a list of {eeprom_records.SENSOR_COUNT}: '
                f'got {shortened(values["sensors"])}'
            )
        values['sensors'] = tuple(map(str, values['sensors']))
    except SettingsFileError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise SettingsFileError(
            f'must be a file of t3mpc robot setup --save, with link below /**, and {_BOARD}'
        ) from error
    unknown, missing = (
        set(values) - set(eeprom_records.RobotSettings._fields),
        set(eeprom_records.RobotSettings._fields) - set(values),
    )
    if unknown or missing:
        names = ', '.join(sorted(unknown or missing))
        raise SettingsFileError(f'{"has unknown" if unknown else "lacks the"} settings: {names}')
    settings = eeprom_records.RobotSettings(**values)
    for name, kind in eeprom_records.RobotSettings.__annotations__.items():
        value = getattr(settings, name)
        allowed = {float: (int, float)}.get(kind, (kind,))
        if kind in (int, bool, float, str) and type(value) not in allowed:
            raise SettingsFileError(
                f'{name} must be {_KINDS[kind]}: got {shortened(value)}{number_hint(value)}'
            )
    try:
        eeprom_records.check_settings(settings)
    except (TypeError, ValueError) as error:
        raise SettingsFileError(str(error)) from error
    return settings


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return str(value)
