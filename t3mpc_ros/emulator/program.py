# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``board_emulator``: dongle and robot behind a serial port, as a command-line program."""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
import math
import os
from pathlib import Path
import sys

from t3mpc_ros.emulator.emulator import Emulator, EmulatorSettings
from t3mpc_ros.emulator.faults import KINDS, Fault, FaultError, parse_fault
from t3mpc_ros.emulator.rest import RestWatch
from t3mpc_ros.emulator.serial_end import LinkError, PseudoPort, serve
from t3mpc_ros.radio.authentication import KeyFileError, read_key
from t3mpc_ros.radio.host.stop import Stop
from t3mpc_ros.robot.arena.world import WorldError
from t3mpc_ros.settings import SettingError
from t3mpc_ros.settings.words import from_words, number


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the emulator until it is told to stop; return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        key = read_key(options.key) if options.key is not None else b''
        emulator = Emulator(_settings(options), key, options.seed)
        if options.loss:
            emulator.play(Fault('loss', 0.0, math.inf, options.loss))
        for text in options.fault:
            emulator.play(parse_fault(text))
    except (FaultError, KeyFileError, SettingError, WorldError) as error:
        print(f'board_emulator: {error}', file=sys.stderr)
        return 2
    with Stop() as stop:
        print('board_emulator: getting ready', flush=True)
        emulator.plant.warm_up()
        with ExitStack() as ends:
            try:
                port = PseudoPort(options.link)
                ends.callback(port.close)
                cable = None
                if options.robot_link is not None:
                    cable = PseudoPort(options.robot_link)
                    ends.callback(cable.close)
            except LinkError as error:
                print(f'board_emulator: {error}', file=sys.stderr)
                return 2
            secured = 'signed commands only' if key else 'no key'
            usb = f", the robot's own USB at {options.robot_link.absolute()}" if cable else ''
            print(
                f'board_emulator: dongle and robot at {options.link.absolute()}{usb} ({secured}); '
                f'stop with Ctrl-C or kill {os.getpid()}',
                flush=True,
            )
            watch = RestWatch(emulator)
            serve(
                emulator,
                port,
                options.speed,
                stop,
                options.restart_on_open,
                cable,
                lambda: _tell(watch.news()),
            )
    print('board_emulator: stopped', flush=True)
    return 0


def _tell(news: str) -> None:
    if news:
        print(f'board_emulator: {news}', flush=True)


def _settings(options: argparse.Namespace) -> EmulatorSettings:
    flat: dict[str, object] = {'twin.world': options.world, 'twin.seed': options.seed}
    return EmulatorSettings.from_flat(flat | from_words(EmulatorSettings, options.set))


def _parser() -> argparse.ArgumentParser:
    faults = '\n'.join(
        f'  {kind.name:<16} {kind.text}' + ('' if math.isnan(kind.value) else f' ({kind.value:g})')
        for kind in KINDS
    )
    parser = argparse.ArgumentParser(
        prog='board_emulator',
        description='Dongle and robot behind a serial port, for the radio bridge to drive.',
        epilog=f'faults, with the value that is meant when none is given:\n{faults}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('--link', type=Path, required=True, help='path of the port: a symbolic link is put there')
    add('--robot-link', type=Path, help="the same for the USB of the robot's own board: its key")
    add('--world', default='', help='world to drive in; empty: an endless plain')
    add('--loss', type=number(0.0, 1.0), default=0.0, help='share of lost packets, each way')
    add(
        '--fault',
        action='append',
        default=[],
        metavar='NAME:AT[:FOR[:VALUE]]',
        help='what goes wrong when (s), for how long (s); more than once',
    )
    add('--key', type=Path, help='file with the key of the robot; without: an open link')
    add('--seed', type=int, default=1, help='of everything that is drawn')
    add('--speed', type=number(0.01, 100.0), default=1.0, help='seconds of the robot in a second')
    add(
        '--restart-on-open',
        action='store_true',
        help='opening a port restarts its board, as it does with many',
    )
    add(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='a setting, twin.load_change or robot_clock say; more than once',
    )
    return parser


if __name__ == '__main__':
    sys.exit(main())
