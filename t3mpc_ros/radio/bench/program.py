# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``radio_tool``: key, link and wheels of the real robot at the bench, without ROS."""

import argparse
from collections.abc import Sequence
import math
import os
from pathlib import Path
import select
import sys
from typing import TypeVar

from t3mpc_ros.radio.authentication import KeyFileError, key_check, read_key
from t3mpc_ros.radio.bench import keys, probe, reading, search, turn
from t3mpc_ros.radio.bench.carrier import carry_out
from t3mpc_ros.radio.bench.errand import Errand, ErrandError, Talk
from t3mpc_ros.radio.codec import decode_from_board, decode_from_dongle
from t3mpc_ros.radio.host.stop import Stop
from t3mpc_ros.radio.link.settings import LinkSettings
from t3mpc_ros.settings import SettingError
from t3mpc_ros.settings.words import from_words, number, whole

DONE, NOT_GOOD, CANNOT, INTERRUPTED = 0, 1, 2, 130
_RATES = ('250k', '1M', '2M')
Value = TypeVar('Value')


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the arguments say; return the exit code.

    0: done, and all is well; 1: done, but what was found is not good; 2: it could not be done;
    130: interrupted.
    """
    options = _parser().parse_args(arguments)
    with Stop() as stop:
        try:
            return int(options.run(options, stop))
        except (ErrandError, KeyFileError, SettingError) as error:
            if stop():
                print('radio_tool: interrupted', file=sys.stderr)
                return INTERRUPTED
            print(f'radio_tool: {error}', file=sys.stderr)
            return CANNOT


# -- the key --------------------------------------------------------------------------------------


def _key_new(options: argparse.Namespace, stop: Stop) -> int:
    check = keys.new_key_file(options.file, os.urandom)
    print(
        f'{options.file}: a new key, check value {check:08x}, readable by you only. Keep it: '
        'without it the robot follows nobody. Next: radio_tool key write'
    )
    return DONE


def _key_check(options: argparse.Namespace, stop: Stop) -> int:
    print(f'{options.file}: a key, check value {key_check(read_key(options.file)):08x}')
    return DONE


def _key_write(options: argparse.Namespace, stop: Stop) -> int:
    key = read_key(options.file)
    if key == keys.FORGET:
        raise KeyFileError(f'{options.file} holds zeros only: that is no key')
    told = _at_robot(keys.write_key(key), options, stop)
    print(keys.describe(told) + ': that of the file')
    return DONE


def _key_forget(options: argparse.Namespace, stop: Stop) -> int:
    print(keys.describe(_at_robot(keys.write_key(keys.FORGET), options, stop)))
    return DONE


def _key_state(options: argparse.Namespace, stop: Stop) -> int:
    told = _at_robot(keys.ask_key(), options, stop)
    print(keys.describe(told))
    if options.key is None:
        return DONE
    same = keys.is_kept(told, read_key(options.key))
    print('that of the file' if same else 'the file has another one')
    return DONE if same else NOT_GOOD


# -- the link -------------------------------------------------------------------------------------


def _ping(options: argparse.Namespace, stop: Stop) -> int:
    settings = _settings(options)
    seen = _at_dongle(probe.probe(settings, options.count), options, stop)
    rows = probe.judge(seen, settings)
    print(probe.table(rows))
    return DONE if probe.is_good(rows) else NOT_GOOD


def _find(options: argparse.Namespace, stop: Stop) -> int:
    settings = _settings(options)
    rates = _RATES if options.all_rates else (settings.rate,)
    live = sys.stderr.isatty()

    def progress(done: int, total: int, found: str) -> None:
        if live:
            print(f'\r{done} of {total} channels', end='', file=sys.stderr, flush=True)
        if found:
            print(f'\r{found}' if live else found, flush=True)

    places = _at_dongle(search.find_robot(settings, rates, progress), options, stop)
    if live:
        print('\r' + 24 * ' ' + '\r', end='', file=sys.stderr)
    good, advice = search.advise(places, settings)
    print(advice)
    return DONE if good else NOT_GOOD


def _parameters(options: argparse.Namespace, stop: Stop) -> int:
    settings = _settings(options)
    talk = reading.read_parameters(settings, _key(options), os.urandom)
    print(reading.table(_at_dongle(talk, options, stop), settings))
    return DONE


def _turn(options: argparse.Namespace, stop: Stop) -> int:
    settings = _settings(options)
    if not options.yes and not _agreed(options, stop):
        print('radio_tool: nothing was moved', file=sys.stderr)
        return INTERRUPTED if stop() else CANNOT
    task = turn.Turn(
        settings,
        _key(options),
        os.urandom,
        options.wheel,
        options.revolutions,
        options.speed,
        lambda text: print(f'radio_tool: {text}', file=sys.stderr),
    )
    carry_out(task, options.port, stop)
    if task.result is not None:
        print(turn.describe(task.result, options.wheel, options.revolutions))
    if task.error:
        raise ErrandError(task.error)
    return DONE


def _agreed(options: argparse.Namespace, stop: Stop) -> bool:
    """Return whether a person at a terminal says that the wheels are in the air."""
    if not sys.stdin.isatty():
        raise ErrandError('turning a wheel asks first, at a terminal: or say --yes')
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


def _at_dongle(talk: Talk[Value], options: argparse.Namespace, stop: Stop) -> Value:
    return _carry(Errand(talk, decode_from_dongle), options, stop, 'the dongle')


def _at_robot(talk: Talk[Value], options: argparse.Namespace, stop: Stop) -> Value:
    return _carry(Errand(talk, decode_from_board), options, stop, "the robot's board")


def _carry(errand: Errand[Value], options: argparse.Namespace, stop: Stop, device: str) -> Value:
    carry_out(errand, options.port, stop, device)
    if errand.error or errand.result is None:
        raise ErrandError(errand.error or 'interrupted')
    return errand.result


# -- arguments ------------------------------------------------------------------------------------


def _key(options: argparse.Namespace) -> bytes:
    return read_key(options.key) if options.key is not None else b''


def _settings(options: argparse.Namespace) -> LinkSettings:
    texts = [text.removeprefix('link.') for text in options.set]
    return LinkSettings.from_flat(from_words(LinkSettings, texts))


def _revolutions(text: str) -> float:
    value = float(text)
    if not 0.01 <= math.fabs(value) <= 100.0:
        raise argparse.ArgumentTypeError(f'must be from 0.01 to 100, or below 0: got {text}')
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='radio_tool',
        description='Key, link and wheels of the real robot, at the bench.',
        epilog='exit code: 0 all is well, 1 what was found is not good, 2 it could not be done',
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _add_key(commands)

    ping = commands.add_parser('ping', help='how well dongle and robot hear each other')
    ping.add_argument('--count', type=whole(1, 100_000), default=200, help='times each is asked')
    find = commands.add_parser('find', help='on which channels the robot answers')
    find.add_argument('--all-rates', action='store_true', help='at 250k, 1M and 2M')
    turning = commands.add_parser('turn', help='turn one wheel, with both in the air')
    turning.add_argument('wheel', choices=(turn.LEFT, turn.RIGHT))
    turning.add_argument(
        'revolutions', type=_revolutions, metavar='REVOLUTIONS', help='below 0: backward'
    )
    turning.add_argument(
        '--speed', type=number(0.2, 10.0), default=2.0, help='of the wheel, rad/s'
    )
    turning.add_argument(
        '--yes', action='store_true', help='do not ask: the wheels are in the air'
    )
    table = commands.add_parser('parameters', help="the robot's parameters")
    for command, run in ((ping, _ping), (find, _find), (turning, _turn), (table, _parameters)):
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


def _add_key(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    about = "the key that only robot and host know; it goes over the robot's own USB"
    actions = commands.add_parser('key', help=about).add_subparsers(
        required=True, metavar='ACTION'
    )
    for name, run, text in (
        ('new', _key_new, 'draw a key into a new file'),
        ('check', _key_check, 'tell the check value of the key in a file'),
        ('write', _key_write, "let the robot keep a file's key"),
        ('forget', _key_forget, 'let the robot forget its key: then anybody can drive it'),
        ('state', _key_state, 'tell whether the robot has a key, and its check value'),
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
