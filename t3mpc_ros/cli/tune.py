# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc tune``: tunes the compared methods."""

import argparse
from collections.abc import Callable, Sequence
import os
from pathlib import Path
import sys
import time
from typing import TYPE_CHECKING

from t3mpc_ros.parameters.command_line import bounded_int

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition


DRIVES = ('torque', 'velocity')
EVALUATIONS = 120
OUTPUT = Path('runs') / 'tuned.json'

Table = Callable[[], 'Sequence[MethodDefinition]']
"""Returns the methods that can be tuned; a function, so that ``--help`` does not load them."""


def add_parser(
    commands: 'argparse._SubParsersAction[argparse.ArgumentParser]', table: Table
) -> None:
    """Add the subcommand ``tune``."""
    parser = commands.add_parser(
        'tune', help='tune the parameters of every method, with equally many evaluations'
    )
    parser.add_argument('methods', nargs='*', metavar='METHOD', help='by name (default all)')
    parser.add_argument('--drive', choices=DRIVES, help='(default both)')
    parser.add_argument(
        '--evaluations',
        type=bounded_int(1, 100_000),
        default=EVALUATIONS,
        help=f'of each method in each drive (default {EVALUATIONS})',
    )
    parser.add_argument(
        '--workers',
        type=bounded_int(1, 100_000),
        default=os.cpu_count() or 1,
        help='processes (default all cores)',
    )
    parser.add_argument(
        '--output', type=Path, default=OUTPUT, help=f'file to write (default {OUTPUT})'
    )
    parser.add_argument(
        '--resume', action='store_true', help='go on where the last tuning was interrupted'
    )
    parser.set_defaults(run=run, table=table)


def run(options: argparse.Namespace) -> int:
    """Tune every method, print the improvement and return 0.

    Raises
    ------
    ValueError
        An unknown method.
    """
    from t3mpc_ros.evaluation.tuning.search_space import find_names
    from t3mpc_ros.evaluation.tuning.tune_methods import tune_methods

    known = options.table()
    names = find_names('method', options.methods, [method.name for method in known])
    drives = (options.drive,) if options.drive else DRIVES
    methods = [method for method in known if method.name in names or not names]
    store = tune_methods(
        methods,
        [drive for drive in drives if options.drive or any(drive in m.start for m in methods)],
        options.evaluations,
        options.workers,
        options.output,
        lambda line: print(line, file=sys.stderr, flush=True),
        clock=time.monotonic,
        resume=options.resume,
    )
    print(store.table())
    return 0
