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
"""``t3mpc robot``: settings, key, link test, scan, jog and calibration of the real robot."""

import argparse
from collections.abc import Callable, Iterator, Sequence
import os
from pathlib import Path
import sys
from typing import Any, TypeVar

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli import robot_calibrate
from t3mpc_ros.cli.shared_options import (
    STANDARD_OUTPUT,
    ArgumentParser,
    Commands,
    add_json,
    ask_line,
    check_two_ports,
    prepare_outputs,
    print_result,
)
from t3mpc_ros.evaluation.api.one_sentence_errors import sentence
from t3mpc_ros.parameters import command_line
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.parameters.yaml_loader import file_errors, read_yaml
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KeyFileError, key_check, read_key
from t3mpc_ros.radio.tool import (
    channel_scan,
    eeprom_records,
    key_provisioning,
    link_test,
    manoeuvre,
    procedure,
    robot_info,
    robot_settings,
)
from t3mpc_ros.radio.tool.procedure import DONGLE, ROBOT_BOARD, ProcedureError, Script
from t3mpc_ros.radio.tool.robot_settings import StoredSettings
from t3mpc_ros.stop_signal import StopSignal

EXIT_OK, EXIT_POOR, EXIT_FAILED, EXIT_INTERRUPTED = 0, 1, 2, 130
_SETTINGS = 'address', 'rate', 'power', 'microsteps', 'steps_per_turn', 'divider', 'sensors'
"""Settings with an option of their name; none of them can be 0 or empty."""
Value = TypeVar('Value')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code.

    0: done, result good; 1: done, result poor; 2: failed, or wrong command line; 130: interrupted.
    """
    options = program_parser().parse_args(arguments)
    with StopSignal() as stop:
        try:
            prepare_outputs(options)
            return int(options.run(options, stop) or EXIT_OK)
        except (ProcedureError, KeyFileError, ParameterError) as error:
            if stop():
                # The reason is another one where the radio of the dongle could not be restored.
                reason = '' if str(error) == 'interrupted' else f': {error}'
                print(f't3mpc robot: interrupted{reason}', file=sys.stderr)
                return EXIT_INTERRUPTED
            print(f't3mpc robot: {error}', file=sys.stderr)
            return EXIT_FAILED
        except OSError as error:  # what only writing a file shows, a full disk say
            print(f't3mpc robot: {sentence(error)}', file=sys.stderr)
            return EXIT_FAILED


# -- the key --------------------------------------------------------------------------------------


def _create_key(options: argparse.Namespace, stop: StopSignal) -> None:
    check = key_provisioning.create_key_file(options.file, os.urandom)
    print(
        f'{options.file}: new key, check value {check:08x}, readable by its owner only. Keep it: '
        'the robot follows no commands without it. Next: t3mpc robot key write'
    )


def _check_key(options: argparse.Namespace, stop: StopSignal) -> None:
    check = f'{key_check(read_key(options.file)):08x}'
    text = f'{options.file}: a key, check value {check}'
    print_result(options, lambda: text, lambda: {'check': check})


def _write_key(options: argparse.Namespace, stop: StopSignal) -> None:
    key = read_key(options.file)
    key_state = _run_at_board(key_provisioning.write_key(key), options, stop)
    print(key_provisioning.format_key_state(key_state) + ', equal to the file')


def _erase_key(options: argparse.Namespace, stop: StopSignal) -> None:
    script = key_provisioning.write_key(key_provisioning.ERASE_KEY)
    print(key_provisioning.format_key_state(_run_at_board(script, options, stop)))


def _show_key_state(options: argparse.Namespace, stop: StopSignal) -> int:
    key_state = _run_at_board(key_provisioning.read_key_state(), options, stop)
    text, same = key_provisioning.format_key_state(key_state), None
    if options.key is not None:
        same = key_provisioning.holds_key(key_state, read_key(options.key))
        text += '\nequal to the file' if same else '\ndifferent from the file'
    record = {**key_state._asdict(), 'equal_to_the_file': same}
    print_result(options, lambda: text, lambda: record)
    return EXIT_POOR if same is False else EXIT_OK


# -- the link -------------------------------------------------------------------------------------


def _setup(options: argparse.Namespace, stop: StopSignal) -> int:
    """Show the settings; change, compare, save them by the options."""
    changes = {name: getattr(options, name) for name in _SETTINGS if getattr(options, name)}
    if options.channel is not None:
        changes['channel'] = options.channel
    if options.invert is not None:
        changes['invert_left'] = options.invert in ('left', 'both')
        changes['invert_right'] = options.invert in ('right', 'both')
    if options.battery is not None:
        changes['battery_wired'] = options.battery == 'wired'
    loaded = _load_settings(options.load) if options.load is not None else None
    compared = _load_settings(options.diff) if options.diff is not None else None
    if options.save is not None:
        command_line.check_writable(options.save)
    stored = _run_at_board(robot_settings.read_settings(), options, stop)
    if loaded is not None or changes:
        base = loaded._asdict() if loaded is not None else {}
        wanted = robot_settings.change_settings(stored, {**base, **changes}, os.urandom)
        stored = _store_settings(stored, wanted, options, stop)
    print(robot_settings.format_settings(stored))
    if options.save is not None:
        if not stored.valid:
            raise ProcedureError('there are no settings to save: give the microsteps, or --load')
        write_atomically(options.save, robot_settings.settings_file(stored.content))
        print(
            f'{options.save}: radio_bridge --ros-args --params-file {options.save}, '
            f't3mpc robot ping --params-file {options.save}'
        )
    if compared is not None:
        changed = robot_settings.differences(stored.content, compared)
        print(changed or f'equal to {options.diff}')
        if changed:
            return EXIT_POOR
    return EXIT_OK if stored.state == frames.SETTINGS_GOOD else EXIT_POOR


def _store_settings(
    stored: StoredSettings,
    wanted: robot_settings.RobotSettings,
    options: argparse.Namespace,
    stop: StopSignal,
) -> StoredSettings:
    changed = robot_settings.differences(stored.content, wanted)
    if stored.state == frames.SETTINGS_GOOD and not changed:
        return stored
    print(changed if stored.valid else robot_settings.SETTINGS_TEXTS[stored.state])
    if not options.yes and not _ask('Write this to the robot?', stop):
        raise ProcedureError('nothing was written')
    return _run_at_board(robot_settings.write_settings(wanted), options, stop)


def _show_log(options: argparse.Namespace, stop: StopSignal) -> None:
    entries = _run_at_board(robot_info.read_log(), options, stop)
    print_result(options, lambda: robot_info.format_log(entries), lambda: entries)


def _load_settings(path: Path) -> robot_settings.RobotSettings:
    with file_errors(path, ParameterError):
        return robot_settings.settings_of_file(read_yaml(path))


def _ping(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    result = _run_at_dongle(link_test.run_link_test(parameters, options.count), options, stop)
    rows = link_test.evaluate(result, parameters)
    print_result(
        options, lambda: link_test.format_report(rows), lambda: {'rows': rows, 'result': result}
    )
    return EXIT_OK if link_test.is_usable(rows) else EXIT_POOR


def _scan(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    rates = frames.RATES if options.all_rates else (parameters.rate,)
    interactive = sys.stderr.isatty()

    def progress(done: int, total: int, result: str) -> None:
        if interactive:
            print(f'\r{done} of {total} channels', end='', file=sys.stderr, flush=True)
        if result:
            file = sys.stderr if options.json == STANDARD_OUTPUT else sys.stdout
            print(f'\r{result}' if interactive else result, file=file, flush=True)

    results = _run_at_dongle(
        channel_scan.scan_channels(parameters, rates, progress), options, stop
    )
    if interactive:
        print('\r' + 24 * ' ' + '\r', end='', file=sys.stderr)
    good, advice = channel_scan.recommend(results, parameters)
    print_result(options, lambda: advice, lambda: {'advice': advice, 'channels': results})
    return EXIT_OK if good else EXIT_POOR


def _show_parameters(options: argparse.Namespace, stop: StopSignal) -> None:
    parameters = _link_parameters(options)
    script = robot_info.read_robot_info(parameters, _key_option(options), os.urandom)
    robot = _run_at_dongle(script, options, stop)
    text = robot_info.format_robot_info(robot, parameters)
    print_result(options, lambda: text, lambda: robot)


def _jog(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    motion = (
        f'The {options.wheel} wheel will make {options.revolutions:g} turns at '
        f'{options.speed:g} rad/s. Both wheels must be in the air, hands and cables away; Ctrl-C '
        'stops.\nContinue?'
    )
    if not options.yes and not _ask(motion, stop):
        print('t3mpc robot: nothing was moved', file=sys.stderr)
        return EXIT_INTERRUPTED if stop() else EXIT_FAILED
    task = manoeuvre.Jog(
        parameters,
        _key_option(options),
        os.urandom,
        options.wheel,
        options.revolutions,
        options.speed,
        lambda text: print(f't3mpc robot: waiting, because {text}', file=sys.stderr),
    )
    procedure.run_at_port(task, options.port, stop)
    if task.result is not None:
        print(manoeuvre.format_result(task.result, options.wheel, options.revolutions))
    if task.error:
        raise ProcedureError(task.error)
    return EXIT_OK


def _calibrate(options: argparse.Namespace, stop: StopSignal) -> int:
    return robot_calibrate.calibrate(
        options, _link_parameters(options), _key_option(options), stop
    )


def _doctor(options: argparse.Namespace, stop: StopSignal) -> int:
    # Imported here: the other commands need no page.
    from t3mpc_ros.cli import robot_doctor
    from t3mpc_ros.radio.tool.link_test import FAIL

    command_line.check_writable(options.report)
    check_two_ports(options.port, options.robot_port)
    if not options.no_questions and not sys.stdin.isatty():
        raise ProcedureError(
            'the checklist asks questions, and the standard input is no terminal: use one, or use '
            '--no-questions'
        )

    def answer(question: str) -> str:
        if options.no_questions:
            return 'skip'
        question += ' [yes/no/skip] '
        while True:
            word = ask_line(question, stop).strip().lower() or 'skip'
            if stop():
                raise ProcedureError('interrupted')
            for each in ('yes', 'no', 'skip'):
                if word in (each, each[0]):
                    return each

    parameters, key = _link_parameters(options), _key_option(options)
    checks = robot_doctor.run_doctor(options, parameters, key, answer, stop)
    return EXIT_POOR if any(check.verdict == FAIL for check in checks) else EXIT_OK


def _ask(question: str, stop: StopSignal) -> bool:
    """Return whether the user answers yes at a terminal."""
    if not sys.stdin.isatty():
        raise ProcedureError('this needs a confirmation at a terminal, or --yes')
    return ask_line(f'{question} [yes/no] ', stop).strip().lower() in ('yes', 'y')


def _run_at_dongle(script: Script[Value], options: argparse.Namespace, stop: StopSignal) -> Value:
    return procedure.run_script(script, options.port, stop, DONGLE)


def _run_at_board(script: Script[Value], options: argparse.Namespace, stop: StopSignal) -> Value:
    return procedure.run_script(script, options.port, stop, ROBOT_BOARD)


# -- arguments ------------------------------------------------------------------------------------


def _key_option(options: argparse.Namespace) -> bytes:
    return read_key(options.key) if options.key is not None else b''


def _link_parameters(options: argparse.Namespace) -> LinkParameters:
    values = {} if options.params_file is None else _read_link_parameters(options.params_file)
    texts = [text.removeprefix('link.') for text in options.set]
    return LinkParameters.from_dict(values | command_line.parse_assignments(LinkParameters, texts))


def _read_link_parameters(path: Path) -> dict[str, object]:
    """Return the parameters below ``link`` of a ROS parameter file, names with dots."""
    with file_errors(path, ParameterError):
        content: Any = read_yaml(path)
    try:
        values = dict(_flat_items(content['/**']['ros__parameters']['link']))
    except (KeyError, TypeError, AttributeError) as error:
        raise ParameterError(
            f'{path} must be a parameter file of t3mpc robot setup, with link below /**'
        ) from error
    try:
        LinkParameters.from_dict(values)
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error
    return values


def _flat_items(group: dict[str, object]) -> Iterator[tuple[str, object]]:
    for name, value in group.items():
        if isinstance(value, dict):
            yield from ((f'{name}.{inner}', item) for inner, item in _flat_items(value))
        else:
            yield str(name), value


def _setting(name: str, convert: Callable[[str], object]) -> Callable[[str], object]:
    """Return the parser of an option for a setting, with the bounds of the setting."""

    def parse(text: str) -> object:
        try:
            value = convert(text)
            robot_settings.check_settings(robot_settings.RobotSettings()._replace(**{name: value}))  # type: ignore[arg-type]
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        return value

    return parse


def _sensors(text: str) -> tuple[str, ...]:
    names = tuple(text.split(','))
    return eeprom_records.SENSOR_COUNT * names if len(names) == 1 else names


def _revolutions(text: str) -> float:
    command_line.bounded_float(0.01, 100.0, 'turns, or negative')(text.removeprefix('-'))
    return float(text)


_revolutions.__name__ = 'number'  # argparse: "invalid number value: 'x'"


def program_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser: argparse.ArgumentParser = ArgumentParser(
        prog='t3mpc robot',
        description='Key, link and wheels of the real robot, on the bench.',
        epilog='exit code: 0 good, 1 poor result, 2 failed, 130 interrupted',
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _add_settings_commands(commands)
    _add_key_commands(commands)

    def link_command(
        name: str,
        run: Callable[[argparse.Namespace, StopSignal], int | None],
        text: str,
        key: bool,
    ) -> argparse.ArgumentParser:
        command: argparse.ArgumentParser = commands.add_parser(name, help=text)
        command.set_defaults(run=run)
        add = command.add_argument
        optional = name == 'calibrate'  # which may have the port of the robot alone
        add('--port', required=not optional, default='', help='port of the dongle, /dev/…')
        text = 'link parameters: a ROS parameter file'
        add('--params-file', type=Path, metavar='FILE', help=text)
        text = 'link parameter, e.g. channel=100 or robot.invert_left=true'
        add('--set', action='append', default=[], metavar='NAME=VALUE', help=text)
        if key:
            add('--key', type=Path, help='file with the key of the robot')
        return command

    ping = link_command('ping', _ping, 'test the link to dongle and robot', False)
    add_json(ping)
    add = ping.add_argument
    text = 'number of requests to each (default 200)'
    add('--count', type=command_line.bounded_int(1, 100_000), default=200, help=text)

    text = 'list the channels on which the robot answers'
    scan = link_command('scan', _scan, text, False)
    add_json(scan, 'also write the channels')
    add = scan.add_argument
    add('--all-rates', action='store_true', help='at 250k, 1M and 2M')

    text = 'turn one wheel, with both wheels in the air'
    add = link_command('jog', _jog, text, True).add_argument
    add('wheel', choices=(manoeuvre.LEFT, manoeuvre.RIGHT))
    add('revolutions', type=_revolutions, metavar='REVOLUTIONS', help='negative: backward')
    text = 'wheel speed, rad/s (default 2)'
    add('--speed', type=command_line.bounded_float(0.2, 10.0, 'rad/s'), default=2.0, help=text)
    add('--yes', action='store_true', help='do not ask whether the wheels are in the air')

    add_json(link_command('parameters', _show_parameters, 'list the board parameters', True))

    text = 'measure wheels, track, gyro, distance sensors and battery, step by step'
    robot_calibrate.add_arguments(link_command('calibrate', _calibrate, text, True))

    text = 'go through the bench checklist: measure, ask, write a report'
    add = link_command('doctor', _doctor, text, True).add_argument
    add('--robot-port', required=True, help='USB port of the robot board')
    text = 'requests of the link test (default 200)'
    add('--count', type=command_line.bounded_int(10, 100_000), default=200, help=text)
    add('--drive', action='store_true', help='turn each wheel once, after a confirmation')
    add('--no-questions', action='store_true', help='skip what only a person can judge')
    text = 'HTML file (default doctor.html); the same as JSON beside it'
    add('--report', type=Path, default=Path('doctor.html'), metavar='FILE', help=text)
    return parser


def _add_settings_commands(commands: Commands) -> None:
    command = commands.add_parser(
        'setup', help='show, change, save, load the settings of the robot, over its own USB'
    )
    command.set_defaults(run=_setup)
    add = command.add_argument
    add('--port', required=True, help='USB port of the robot board')
    add(
        '--address',
        type=_setting('address', robot_settings.parse_address),
        metavar='HEX',
        help='10 hexadecimal digits; default: as stored, on a new board random',
    )
    add('--channel', type=_setting('channel', int), help='2400 MHz plus this')
    add('--rate', choices=frames.RATES, help='bit/s; 250k only with nRF24L01+ chips')
    add('--power', choices=frames.POWERS, help='of the transmitter of the robot, dBm')
    text = 'as set by the jumpers of the drivers'
    add('--microsteps', type=_setting('microsteps', int), help=text)
    text = 'full steps of a turn of the wheel'
    add('--steps-per-turn', type=_setting('steps_per_turn', int), help=text)
    add('--invert', choices=('none', 'left', 'right', 'both'), help='wheels that turn backward')
    add('--divider', type=_setting('divider', float), help='of the battery voltage, 4: 1/4 of it')
    text = 'wired: the battery is measured, and the robot stops when it measures nothing'
    add('--battery', choices=('wired', 'unwired'), help=text)
    text = (
        f'distance sensors, one type or {eeprom_records.SENSOR_COUNT}: '
        f'{", ".join(eeprom_records.SENSORS)}'
    )
    add('--sensors', type=_setting('sensors', _sensors), metavar='TYPE[,…]', help=text)
    add('--diff', type=Path, metavar='FILE', help='compare with a file; exit code 1 if different')
    add('--load', type=Path, metavar='FILE', help='write the settings of a file')
    add('--save', type=Path, metavar='FILE', help='write a parameter file, for the host as well')
    add('--yes', action='store_true', help='do not ask before writing')
    command = commands.add_parser('log', help='print resets and faults that the robot has logged')
    command.set_defaults(run=_show_log)
    command.add_argument('--port', required=True, help='USB port of the robot board')
    add_json(command, 'also write the entries')


def _add_key_commands(commands: Commands) -> None:
    about = 'secret key of robot and host, transferred over the USB port of the robot board'
    actions = commands.add_parser('key', help=about).add_subparsers(
        required=True, metavar='ACTION'
    )
    for name, run, text in (
        ('create', _create_key, 'generate a key into a new file'),
        ('check', _check_key, 'print the check value of the key in a file'),
        ('write', _write_key, 'store the key of a file in the robot'),
        ('erase', _erase_key, 'erase the key of the robot: any radio can then drive it'),
        ('state', _show_key_state, 'print whether the robot has a key, and its check value'),
    ):
        action = actions.add_parser(name, help=text)
        action.set_defaults(run=run)
        if name in ('create', 'check', 'write'):
            action.add_argument('file', type=Path, metavar='FILE')
        if name in ('write', 'erase', 'state'):
            action.add_argument('--port', required=True, help='USB port of the robot board')
        if name == 'state':
            action.add_argument('--key', type=Path, help='key file to compare with')
        if name in ('check', 'state'):
            add_json(action, 'also write the state')


if __name__ == '__main__':
    sys.exit(main())
