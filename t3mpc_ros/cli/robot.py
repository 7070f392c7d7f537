# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc robot``: link test, channel scan, wheel jog, key and parameters of the real robot."""

import argparse
from collections.abc import Sequence
import math
import os
from pathlib import Path
import select
import sys
from typing import TypeVar

from t3mpc_ros.parameters.command_line import bounded_float, bounded_int, parse_assignments
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol.authentication import KeyFileError, key_check, read_key
from t3mpc_ros.radio.protocol.codec import decode_from_board, decode_from_dongle
from t3mpc_ros.radio.tool import channel_scan, jog, key_provisioning, link_test, robot_info
from t3mpc_ros.radio.tool.procedure import Procedure, ProcedureError, Script, run_at_port
from t3mpc_ros.stop_signal import StopSignal

EXIT_OK, EXIT_POOR, EXIT_FAILED, EXIT_INTERRUPTED = 0, 1, 2, 130
_RATES = ('250k', '1M', '2M')
Value = TypeVar('Value')


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the arguments say; return the exit code.

    0: done, and all is well; 1: done, but what was found is not good; 2: it could not be done;
    130: interrupted.
    """
    options = _parser().parse_args(arguments)
    with StopSignal() as stop:
        try:
            return int(options.run(options, stop))
        except (ProcedureError, KeyFileError, ParameterError) as error:
            if stop():
                print('t3mpc robot: interrupted', file=sys.stderr)
                return EXIT_INTERRUPTED
            print(f't3mpc robot: {error}', file=sys.stderr)
            return EXIT_FAILED


# -- the key --------------------------------------------------------------------------------------


def _create_key(options: argparse.Namespace, stop: StopSignal) -> int:
    check = key_provisioning.create_key_file(options.file, os.urandom)
    print(
        f'{options.file}: a new key, check value {check:08x}, readable by you only. Keep it: '
        'without it the robot follows nobody. Next: t3mpc robot key write'
    )
    return EXIT_OK


def _check_key(options: argparse.Namespace, stop: StopSignal) -> int:
    print(f'{options.file}: a key, check value {key_check(read_key(options.file)):08x}')
    return EXIT_OK


def _write_key(options: argparse.Namespace, stop: StopSignal) -> int:
    key = read_key(options.file)
    if key == key_provisioning.ERASE_KEY:
        raise KeyFileError(f'{options.file} holds zeros only: that is no key')
    told = _run_at_board(key_provisioning.write_key(key), options, stop)
    print(key_provisioning.format_key_state(told) + ': that of the file')
    return EXIT_OK


def _erase_key(options: argparse.Namespace, stop: StopSignal) -> int:
    print(
        key_provisioning.format_key_state(
            _run_at_board(key_provisioning.write_key(key_provisioning.ERASE_KEY), options, stop)
        )
    )
    return EXIT_OK


def _show_key_state(options: argparse.Namespace, stop: StopSignal) -> int:
    told = _run_at_board(key_provisioning.read_key_state(), options, stop)
    print(key_provisioning.format_key_state(told))
    if options.key is None:
        return EXIT_OK
    same = key_provisioning.holds_key(told, read_key(options.key))
    print('that of the file' if same else 'the file has another one')
    return EXIT_OK if same else EXIT_POOR


# -- the link -------------------------------------------------------------------------------------


def _ping(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    seen = _run_at_dongle(link_test.run_link_test(parameters, options.count), options, stop)
    rows = link_test.evaluate(seen, parameters)
    print(link_test.format_report(rows))
    return EXIT_OK if link_test.is_usable(rows) else EXIT_POOR


def _scan(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    rates = _RATES if options.all_rates else (parameters.rate,)
    live = sys.stderr.isatty()

    def progress(done: int, total: int, found: str) -> None:
        if live:
            print(f'\r{done} of {total} channels', end='', file=sys.stderr, flush=True)
        if found:
            print(f'\r{found}' if live else found, flush=True)

    places = _run_at_dongle(channel_scan.scan_channels(parameters, rates, progress), options, stop)
    if live:
        print('\r' + 24 * ' ' + '\r', end='', file=sys.stderr)
    good, advice = channel_scan.recommend(places, parameters)
    print(advice)
    return EXIT_OK if good else EXIT_POOR


def _show_parameters(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    talk = robot_info.read_robot_info(parameters, _key_option(options), os.urandom)
    print(robot_info.format_robot_info(_run_at_dongle(talk, options, stop), parameters))
    return EXIT_OK


def _jog(options: argparse.Namespace, stop: StopSignal) -> int:
    parameters = _link_parameters(options)
    if not options.yes and not _confirmed(options, stop):
        print('t3mpc robot: nothing was moved', file=sys.stderr)
        return EXIT_INTERRUPTED if stop() else EXIT_FAILED
    task = jog.Jog(
        parameters,
        _key_option(options),
        os.urandom,
        options.wheel,
        options.revolutions,
        options.speed,
        lambda text: print(f't3mpc robot: {text}', file=sys.stderr),
    )
    run_at_port(task, options.port, stop)
    if task.result is not None:
        print(jog.format_result(task.result, options.wheel, options.revolutions))
    if task.error:
        raise ProcedureError(task.error)
    return EXIT_OK


def _confirmed(options: argparse.Namespace, stop: StopSignal) -> bool:
    """Return whether a person at a terminal says that the wheels are in the air."""
    if not sys.stdin.isatty():
        raise ProcedureError('turning a wheel asks first, at a terminal: or say --yes')
    print(
        f'The {options.wheel} wheel will make {options.revolutions:g} turns at '
        f'{options.speed:g} rad/s. Both wheels must be in the air, hands and cables away; Ctrl-C '
        'stops.'
    )
    print('Are they? [yes/no] ', end='', flush=True)
    while not stop():
        # Not just readline: it would go on after Ctrl-C.
        ready, _, _ = select.select([sys.stdin], [], [], 0.1)
        if ready:
            return sys.stdin.readline().strip().lower() in ('y', 'yes')
    return False


def _run_at_dongle(talk: Script[Value], options: argparse.Namespace, stop: StopSignal) -> Value:
    return _run(Procedure(talk, decode_from_dongle), options, stop, 'the dongle')


def _run_at_board(talk: Script[Value], options: argparse.Namespace, stop: StopSignal) -> Value:
    return _run(Procedure(talk, decode_from_board), options, stop, "the robot's board")


def _run(
    errand: Procedure[Value], options: argparse.Namespace, stop: StopSignal, device: str
) -> Value:
    run_at_port(errand, options.port, stop, device)
    if errand.error or errand.result is None:
        raise ProcedureError(errand.error or 'interrupted')
    return errand.result


# -- arguments ------------------------------------------------------------------------------------


def _key_option(options: argparse.Namespace) -> bytes:
    return read_key(options.key) if options.key is not None else b''


def _link_parameters(options: argparse.Namespace) -> LinkParameters:
    texts = [text.removeprefix('link.') for text in options.set]
    return LinkParameters.from_dict(parse_assignments(LinkParameters, texts))


def _revolutions(text: str) -> float:
    value = float(text)
    if not 0.01 <= math.fabs(value) <= 100.0:
        raise argparse.ArgumentTypeError(f'must be from 0.01 to 100, or below 0: got {text}')
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='t3mpc robot',
        description='Key, link and wheels of the real robot, at the bench.',
        epilog='exit code: 0 all is well, 1 what was found is not good, 2 it could not be done',
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _add_key_commands(commands)

    ping = commands.add_parser('ping', help='how well dongle and robot hear each other')
    ping.add_argument(
        '--count', type=bounded_int(1, 100_000), default=200, help='times each is asked'
    )
    find = commands.add_parser('scan', help='on which channels the robot answers')
    find.add_argument('--all-rates', action='store_true', help='at 250k, 1M and 2M')
    turning = commands.add_parser('jog', help='turn one wheel, with both in the air')
    turning.add_argument('wheel', choices=(jog.LEFT, jog.RIGHT))
    turning.add_argument(
        'revolutions', type=_revolutions, metavar='REVOLUTIONS', help='below 0: backward'
    )
    turning.add_argument(
        '--speed', type=bounded_float(0.2, 10.0), default=2.0, help='of the wheel, rad/s'
    )
    turning.add_argument(
        '--yes', action='store_true', help='do not ask: the wheels are in the air'
    )
    table = commands.add_parser('parameters', help="the robot's parameters")
    for command, run in ((ping, _ping), (find, _scan), (turning, _jog), (table, _show_parameters)):
        command.set_defaults(run=run)
        command.add_argument('--port', required=True, help='of the dongle: /dev/serial/by-id/…')
        command.add_argument(
            '--set',
            action='append',
            default=[],
            metavar='NAME=VALUE',
            help='a setting of the link, channel=100 or robot.invert_left=true say',
        )
    for command in (turning, table):
        command.add_argument('--key', type=Path, help='file with the key of the robot')
    return parser


def _add_key_commands(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    about = "the key that only robot and host know; it goes over the robot's own USB"
    actions = commands.add_parser('key', help=about).add_subparsers(
        required=True, metavar='ACTION'
    )
    for name, run, text in (
        ('new', _create_key, 'draw a key into a new file'),
        ('check', _check_key, 'tell the check value of the key in a file'),
        ('write', _write_key, "let the robot keep a file's key"),
        ('forget', _erase_key, 'let the robot forget its key: then anybody can drive it'),
        ('state', _show_key_state, 'tell whether the robot has a key, and its check value'),
    ):
        action = actions.add_parser(name, help=text)
        action.set_defaults(run=run)
        if name in ('new', 'check', 'write'):
            action.add_argument('file', type=Path, metavar='FILE')
        if name in ('write', 'forget', 'state'):
            action.add_argument('--port', required=True, help="of the robot's board")
        if name == 'state':
            action.add_argument('--key', type=Path, help='file to compare with')


if __name__ == '__main__':
    sys.exit(main())
