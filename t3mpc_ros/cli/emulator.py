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
"""``t3mpc emulator``: emulated dongle and robot board behind a serial port."""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
import math
import os
from pathlib import Path
import sys

from t3mpc_ros.cli.shared_options import ArgumentParser
from t3mpc_ros.emulator.fault_injection import FAULT_KINDS, Fault, FaultError, parse_fault
from t3mpc_ros.parameters.command_line import bounded_float, parse_assignments
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.protocol.authentication import KeyFileError, read_key
from t3mpc_ros.stop_signal import StopSignal


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the emulator until a stop signal; return the exit code."""
    options = program_parser().parse_args(arguments)
    # They import the compiler, which the help does without.
    from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters, StopTimeMonitor
    from t3mpc_ros.emulator.firmware_library import FirmwareLibraryError
    from t3mpc_ros.emulator.pty_port import PtyPort, PtyPortError, serve
    from t3mpc_ros.simulation.world import WorldError

    try:
        if options.robot_link and options.robot_link.absolute() == options.link.absolute():
            raise PtyPortError(f'--link and --robot-link must be two paths: got {options.link}')
        key = read_key(options.key) if options.key is not None else b''
        values: dict[str, object] = {'twin.world': options.world, 'twin.seed': options.seed}
        values |= parse_assignments(EmulatorParameters, options.set)
        parameters = EmulatorParameters.from_dict(values)
        faults = [Fault('loss', 0.0, math.inf, options.loss)] if options.loss else []
        faults += map(parse_fault, options.fault)
        emulator = Emulator(parameters, key, options.seed, erased=options.erased)
        for fault in faults:
            emulator.schedule_fault(fault)
    except (
        FaultError,
        FirmwareLibraryError,
        KeyFileError,
        ParameterError,
        PtyPortError,
        WorldError,
    ) as error:
        return _fail(error)
    with StopSignal() as stop:
        _print('starting')
        emulator.plant.warm_up()
        with ExitStack() as ports:
            try:
                port = PtyPort(options.link)
                ports.callback(port.close)
                console_port = None
                if options.robot_link is not None:
                    console_port = PtyPort(options.robot_link)
                    ports.callback(console_port.close)
            except PtyPortError as error:
                return _fail(error)
            console = f', robot console at {options.robot_link.absolute()}' if console_port else ''
            security = 'signed commands only' if key else 'no key'
            _print(
                f'dongle and robot at {options.link.absolute()}{console} ({security}); '
                f'stop with Ctrl-C or kill {os.getpid()}'
            )
            monitor = StopTimeMonitor(emulator)

            def report() -> None:
                if text := monitor.poll():
                    _print(text)

            serve(
                emulator,
                port,
                options.real_time_factor,
                stop,
                options.restart_on_open,
                console_port,
                report,
            )
    _print('stopped')
    return 0


def _print(text: str) -> None:
    print(f't3mpc emulator: {text}', flush=True)


def _fail(error: Exception) -> int:
    print(f't3mpc emulator: {error}', file=sys.stderr)
    return 2


def program_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    faults = '\n'.join(
        f'  {kind.name:<16} {kind.text}' + ('' if math.isnan(kind.value) else f' ({kind.value:g})')
        for kind in FAULT_KINDS
    )
    parser: argparse.ArgumentParser = ArgumentParser(
        prog='t3mpc emulator',
        description='Emulated dongle and robot board behind a serial port, for radio_bridge.',
        epilog=f'faults, with the default value in parentheses:\n{faults}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('--link', type=Path, required=True, help='path of the port, made as a symbolic link')
    add('--robot-link', type=Path, help='path of the USB console of the robot board')
    add('--world', default='', help='world around the robot; default: no obstacles')
    text = 'share of lost radio packets, each way (default 0)'
    add('--loss', type=bounded_float(0.0, 1.0), default=0.0, help=text)
    text = 'fault with start (s), duration (s) and value; repeatable'
    add('--fault', action='append', default=[], metavar='NAME:AT[:FOR[:VALUE]]', help=text)
    add('--key', type=Path, help='file with the key of the robot; default: open link')
    add('--erased', action='store_true', help='new board: no settings, so it does not move yet')
    add('--seed', type=int, default=1, help='seed of all random generators (default 1)')
    text = 'virtual seconds per second (default 1)'
    add('--real-time-factor', type=bounded_float(0.01, 100.0), default=1.0, help=text)
    text = 'opening a port reboots its board, as on most boards'
    add('--restart-on-open', action='store_true', help=text)
    text = 'parameter, such as robot_clock_error or twin.load_change; repeatable'
    add('--set', action='append', default=[], metavar='NAME=VALUE', help=text)
    return parser


if __name__ == '__main__':
    sys.exit(main())
