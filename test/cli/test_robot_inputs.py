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
"""``t3mpc robot``: any input that is wrong is answered by one sentence that names it."""

import itertools

import pytest
from support.long_tests import few_of
import yaml

from t3mpc_ros.cli import robot as cli
from t3mpc_ros.parameters.yaml_loader import YamlError
from t3mpc_ros.radio.tool.robot_settings import (
    RobotSettings,
    parse_address,
    settings_file,
    settings_of_file,
)

CONTENTS = {
    'binary': bytes(range(256)) * 9,
    'zeros': bytes(64),
    'utf-16': settings_file(RobotSettings()).encode('utf-16'),
    'empty': b'',
    'a number': b'7',
    'text': b'hello',
    'a list': b'- 1\n- 2\n',
    'tabs': b'a:\t- b\n\t c',
    'brackets': b'[' * 700,
    'a date': b'/**: {ros__parameters: {link: 2024-99-99}}',
    'nothing below': b'/**:\n',
    'a list below': b'/**: {ros__parameters: {link: [1, 2]}}\n/robot_board: [3]\n',
    'names that are numbers': b'/**: {ros__parameters: {link: {1: 2}}}',
    'a name that is a list': b'? [1, 2]\n: 3\n',
    'values that are groups': b'/**: {ros__parameters: {link: {channel: {a: {b: [1]}}}}}',
    'no numbers': b'/**: {ros__parameters: {link: {channel: .nan, cycle_rate: 1e999}}}',
}
COMMANDS = {
    'setup --load': 'setup --port none --load FILE --yes',
    'setup --diff': 'setup --port none --diff FILE',
    'ping --params-file': 'ping --port none --params-file FILE',
    'jog --key': 'jog left 1 --port none --key FILE --yes',
    'key check': 'key check FILE',
    'key write': 'key write FILE --port none',
    'key state': 'key state --port none --key FILE',
    'key create': 'key create FILE',
    'doctor --report': 'doctor --port none --robot-port none --no-questions --report FILE/x',
    'setup --save': 'setup --port none --save FILE/x',
}


def answer(words, capsys):
    try:
        code = cli.main(words)
    except SystemExit as end:
        code = end.code
    return code, capsys.readouterr().err


@pytest.mark.parametrize('content, words', few_of(itertools.product(CONTENTS, COMMANDS), step=3))
def test_any_file_is_answered_by_one_sentence(content, words, tmp_path, capsys):
    """A binary file ended in a traceback."""
    path = tmp_path / 'file'
    path.write_bytes(CONTENTS[content])
    path.chmod(0o600)
    code, shown = answer(
        [word.replace('FILE', str(path)) for word in COMMANDS[words].split()], capsys
    )
    assert code == 2, shown
    assert 'Traceback' not in shown
    assert len(shown.strip().splitlines()) == 1, shown
    assert len(shown) < 400
    assert shown.startswith('t3mpc robot: ')
    assert 'file' in shown or 'none does not exist' in shown


@pytest.mark.parametrize('words', COMMANDS.values(), ids=COMMANDS)
def test_a_folder_in_place_of_a_file_is_answered_by_one_sentence(words, tmp_path, capsys):
    folder = tmp_path / 'file'
    folder.mkdir()
    words = [
        word.replace('FILE/x', str(folder)).replace('FILE', str(folder)) for word in words.split()
    ]
    code, shown = answer(words, capsys)
    assert code == 2
    assert len(shown.strip().splitlines()) == 1, shown
    assert 'Errno' not in shown


@pytest.mark.parametrize('command', ['doctor', 'calibrate'])
def test_one_port_for_both_boards_is_refused(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'link').symlink_to('port')
    words = f'{command} --port port --robot-port link'.split()
    code, shown = answer([*words, *['--no-questions'] * (command == 'doctor')], capsys)
    assert code == 2
    assert 'got port and link, one device' in shown


def test_a_calibration_needs_a_port(capsys):
    code, shown = answer(['calibrate'], capsys)
    assert code == 2
    assert 'give --port of the dongle, --robot-port of the robot board, or both' in shown


STRANGE = [
    '4 V',
    '',
    'T3MPC',
    True,
    None,
    [1],
    {'a': 1},
    float('nan'),
    float('inf'),
    -1,
    10**30,
    1.5,
]


ACCEPTED = [
    ('battery_wired', True),
    ('invert_left', True),
    ('invert_right', True),
    ('divider', 1.5),
]


@pytest.mark.parametrize('name', RobotSettings._fields)
@pytest.mark.parametrize('value', STRANGE, ids=repr)
def test_any_value_in_a_settings_file_is_accepted_or_named(name, value):
    """``divider: '4 V'`` said: '<=' not supported between instances of 'float' and 'str'."""
    content = yaml.safe_load(settings_file(RobotSettings()))
    for group in (
        content['/**']['ros__parameters']['link'],
        content['/robot_board']['ros__parameters'],
    ):
        if name in group:
            group[name] = value
    try:
        settings_of_file(content)
    except YamlError as error:
        shown = str(error)
    else:
        shown = f'{name} accepted: got '
        assert (name, value) in ACCEPTED
    assert shown.startswith(name)
    assert ': got ' in shown
    assert 'supported' not in shown


def test_an_address_without_quotes_is_a_number():
    """54334d5043 is text, 1234567890 a number: its zeros in front would be lost."""
    with pytest.raises(YamlError, match='address must be text in quotes'):
        parse_address(1234567890)
    content = yaml.safe_load(settings_file(RobotSettings()).replace("'54334d5043'", '1234567890'))
    with pytest.raises(YamlError, match='address must be text in quotes'):
        settings_of_file(content)


@pytest.mark.parametrize(
    'text', ['T3MPC', '', '11', '54334d504', '54334d50433', 'g' * 10, '54 33 4d 50 43', 'é' * 10]
)
def test_an_address_must_be_ten_hexadecimal_digits(text, capsys):
    """``--address T3MPC`` said: non-hexadecimal number found in fromhex() arg at position 0."""
    code, shown = answer(['setup', '--port', 'none', '--address', text], capsys)
    assert code == 2
    assert 'address must be 10 hexadecimal digits, such as 54334d5043: got ' in shown
    assert 'fromhex' not in shown


def test_a_settings_file_of_older_firmware_has_no_wired_battery():
    content = yaml.safe_load(settings_file(RobotSettings(battery_wired=True)))
    assert settings_of_file(content).battery_wired
    del content['/robot_board']['ros__parameters']['battery_wired']
    assert not settings_of_file(content).battery_wired
