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
"""``t3mpc demo``: options and exit codes; the run is that of :mod:`~t3mpc_ros.cli.demo_run`."""

import argparse
from dataclasses import fields, replace
from datetime import datetime
from pathlib import Path
import sys
import webbrowser

from t3mpc_ros.cli.shared_options import SECONDS, Commands, new_folder
from t3mpc_ros.parameters.command_line import bounded_int

UNSOUND, TOO_SLOW = 3, 4
"""Exit codes of a demo that was recorded but is no valid measurement."""
DEMO_EXIT_CODES = """\
Exit code: 0 sound; 1 failed; 2 wrong use; 128 + N ended by signal N; the run is recorded, but no
valid measurement: 3 the robot did not follow, or data is missing; 4 the machine was too slow,
which may be why: repeat it."""
"""The last words of the help of the demo."""


def add_parser(commands: Commands) -> None:
    """Add the subcommand ``demo``."""
    demo = commands.add_parser(
        'demo',
        help='run all nodes as processes, record, report',
        epilog=DEMO_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument('--duration', type=SECONDS, default=60.0, help='seconds (default 60)')
    demo.add_argument('--output', type=new_folder, help='folder (default runs/<time>)')
    demo.add_argument('--headless', action='store_true', help='no bar, no browser')
    demo.add_argument('--view', action='store_true', help='show the run on a live page')
    demo.add_argument('--seed', type=bounded_int(0, 10**15), help='seed of reference and robot')
    text = 'patrol the world room on a chaotic path; without --seed it is unpredictable'
    demo.add_argument('--patrol', action='store_true', help=text)
    text = (
        "twin: the stepper robot with all its parts (default); servo: the paper's plant; "
        'emulator: the twin on an emulated board, driven over a serial port and a radio'
    )
    demo.add_argument('--robot', choices=('twin', 'servo', 'emulator'), default='twin', help=text)
    text = 'share of radio packets lost each way, with --robot emulator (default 0)'
    demo.add_argument('--loss', type=_share, default=0.0, help=text)
    text = 'parameter of a node, such as controller.law.gain=90; may be given again'
    demo.add_argument('--set', action='append', default=[], metavar='NODE.NAME=VALUE', help=text)
    demo.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the demo, show its report and return the exit code."""
    from t3mpc_ros.cli.demo_run import DemoInterruptedError, DemoOptions, parse_settings, run_demo

    if options.patrol and options.robot != 'twin':
        print(f'error: --patrol needs --robot twin: got {options.robot}', file=sys.stderr)
        return 2
    if options.loss and options.robot != 'emulator':
        print(f'error: --loss needs --robot emulator: got {options.robot}', file=sys.stderr)
        return 2
    names = {each.name for each in fields(DemoOptions)} - {'output'}
    wanted = DemoOptions(**{name: getattr(options, name) for name in names & {*vars(options)}})
    if options.set:
        wanted = replace(wanted, settings=parse_settings(wanted, options.set))
    wanted = replace(wanted, output=options.output or _new_run(Path('runs')))
    try:
        figures = run_demo(wanted)
    except DemoInterruptedError as interruption:
        print(interruption, file=sys.stderr)
        return 128 + interruption.number
    print(figures.verdict.text())
    print(figures.summary())
    if not options.headless:
        webbrowser.open(figures.report.resolve().as_uri())
    verdict = figures.verdict
    if verdict.sound:
        return 0
    # No lack of time damages a recording.
    return TOO_SLOW if verdict.slow and not verdict.damaged else UNSOUND


def _new_run(folder: Path) -> Path:
    """Return a new folder named after the time; the link ``latest`` beside it leads to it."""
    output = folder / f'{datetime.now():%Y%m%d-%H%M%S}'
    output.mkdir(parents=True)
    link, new_link = folder / 'latest', output / 'link'
    if link.is_symlink() or not link.exists():
        new_link.symlink_to(output.name)
        new_link.replace(link)  # at once, also for a second demo
    return output


def _share(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f'must be from 0 to below 1: got {text}')
    return value
