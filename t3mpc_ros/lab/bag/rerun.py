# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag rerun``: the recorded inputs through the controller of today, or through another one."""

import argparse
from pathlib import Path
import time

from t3mpc_ros.settings.words import from_words


def add_rerun_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    """Add ``rerun`` to the commands of ``bag``; :func:`run` carries it out."""
    parser = commands.add_parser(
        'rerun',
        help='compute a recorded run again',
        description='Gives the recorded odometry and reference to the controller of today, '
        'offline and as fast as it goes, in the order in which the recorded controller took them. '
        'With other settings, or with another method of the lab, it says what would have been '
        'commanded; the robot does not answer to that.',
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='folder of the bag, or its file')
    parser.add_argument(
        '--output', type=Path, metavar='DIR', help='write a bag of what was computed'
    )
    parser.add_argument(
        '--rival', metavar='NAME', help="a method of the lab in the controller's place"
    )
    add_input_options(parser)
    parser.set_defaults(run=run)


def add_input_options(parser: argparse.ArgumentParser) -> None:
    """Add what says how a bag is taken as the inputs of a controller."""
    parser.add_argument(
        '--set',
        dest='settings',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='another setting than the recorded one, law.gain=30 say; may be given again',
    )
    parser.add_argument(
        '--model', type=Path, metavar='FILE', help='model file to begin with (default: as the bag)'
    )
    parser.add_argument('--namespace', help='of the robot, where the bag holds several')


def run(options: argparse.Namespace) -> int:
    """Return 0 when the run was computed; prints what became of it, and how fast.

    Raises
    ------
    RerunError
        The bag cannot be computed again.
    RecordError
        A bag cannot be read or written.
    SettingError
        A setting is unknown or cannot be used.
    """
    from t3mpc_ros.control.controller import ControllerSettings
    from t3mpc_ros.lab.rerun.compare import compare
    from t3mpc_ros.lab.rerun.inputs import load_inputs
    from t3mpc_ros.lab.rerun.rerun import OPEN_LOOP, rerun, start
    from t3mpc_ros.lab.rerun.tape import write_rerun
    from t3mpc_ros.lab.rerun.what_if import rerun_rival
    from t3mpc_ros.record.model import load_model

    changes = from_words(ControllerSettings, options.settings)
    model = load_model(options.model) if options.model else None
    begin = time.perf_counter()
    inputs = load_inputs(options.bag, options.namespace, model)
    read = time.perf_counter()
    if options.rival:
        ready = read
        again = rerun_rival(inputs, options.rival, changes)
    else:
        controllers = start(inputs, changes)
        ready = time.perf_counter()
        again = rerun(inputs, changes, controllers)
    end = time.perf_counter()
    reading, starting, running = read - begin, ready - read, end - ready
    span = again.steps / again.settings.rate
    whole, alone = span / (reading + running), span / running
    print(
        f'{again.steps} steps, {span:.1f} s of control, in {reading + running:.2f} s: '
        f'{whole:.0f} x real time, {alone:.0f} x without reading'
        + (f'; {starting:.2f} s to compile and to warm up are not counted' if starting else '')
    )
    print(compare(inputs, again).table())
    if options.rival or changes or options.model:
        print(OPEN_LOOP)
    if options.output:
        print(f'written to {write_rerun(inputs, again, options.output)}')
    return 0
