# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc emulator``: emulated dongle and robot board behind a serial port."""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
import math
import os
from pathlib import Path
import sys

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters, StopTimeMonitor
from t3mpc_ros.emulator.fault_injection import FAULT_KINDS, Fault, FaultError, parse_fault
from t3mpc_ros.emulator.pty_port import PtyPort, PtyPortError, serve
from t3mpc_ros.parameters.command_line import bounded_float, parse_assignments
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.protocol.authentication import KeyFileError, read_key
from t3mpc_ros.simulation.world import WorldError
from t3mpc_ros.stop_signal import StopSignal


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the emulator until it is told to stop; return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        key = read_key(options.key) if options.key is not None else b''
        emulator = Emulator(_parameters(options), key, options.seed)
        if options.loss:
            emulator.play(Fault('loss', 0.0, math.inf, options.loss))
        for text in options.fault:
            emulator.play(parse_fault(text))
    except (FaultError, KeyFileError, ParameterError, WorldError) as error:
        print(f't3mpc emulator: {error}', file=sys.stderr)
        return 2
    with StopSignal() as stop:
        print('t3mpc emulator: getting ready', flush=True)
        emulator.plant.warm_up()
        with ExitStack() as ends:
            try:
                port = PtyPort(options.link)
                ends.callback(port.close)
                cable = None
                if options.robot_link is not None:
                    cable = PtyPort(options.robot_link)
                    ends.callback(cable.close)
            except PtyPortError as error:
                print(f't3mpc emulator: {error}', file=sys.stderr)
                return 2
            secured = 'signed commands only' if key else 'no key'
            usb = f", the robot's own USB at {options.robot_link.absolute()}" if cable else ''
            print(
                f't3mpc emulator: dongle and robot at {options.link.absolute()}{usb} ({secured}); '
                f'stop with Ctrl-C or kill {os.getpid()}',
                flush=True,
            )
            watch = StopTimeMonitor(emulator)
            serve(
                emulator,
                port,
                options.speed,
                stop,
                options.restart_on_open,
                cable,
                lambda: _tell(watch.news()),
            )
    print('t3mpc emulator: stopped', flush=True)
    return 0


def _tell(news: str) -> None:
    if news:
        print(f't3mpc emulator: {news}', flush=True)


def _parameters(options: argparse.Namespace) -> EmulatorParameters:
    values: dict[str, object] = {'twin.world': options.world, 'twin.seed': options.seed}
    return EmulatorParameters.from_dict(
        values | parse_assignments(EmulatorParameters, options.set)
    )


def _parser() -> argparse.ArgumentParser:
    faults = '\n'.join(
        f'  {kind.name:<16} {kind.text}' + ('' if math.isnan(kind.value) else f' ({kind.value:g})')
        for kind in FAULT_KINDS
    )
    parser = argparse.ArgumentParser(
        prog='t3mpc emulator',
        description='Dongle and robot behind a serial port, for the radio bridge to drive.',
        epilog=f'faults, with the value that is meant when none is given:\n{faults}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('--link', type=Path, required=True, help='path of the port: a symbolic link is put there')
    add('--robot-link', type=Path, help="the same for the USB of the robot's own board: its key")
    add('--world', default='', help='world to drive in; empty: an endless plain')
    add(
        '--loss', type=bounded_float(0.0, 1.0), default=0.0, help='share of lost packets, each way'
    )
    add(
        '--fault',
        action='append',
        default=[],
        metavar='NAME:AT[:FOR[:VALUE]]',
        help='what goes wrong when (s), for how long (s); more than once',
    )
    add('--key', type=Path, help='file with the key of the robot; without: an open link')
    add('--seed', type=int, default=1, help='of everything that is drawn')
    add(
        '--speed',
        type=bounded_float(0.01, 100.0),
        default=1.0,
        help='seconds of the robot in a second',
    )
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
