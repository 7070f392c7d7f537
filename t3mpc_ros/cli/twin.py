# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc twin``: validates the digital twin."""

import argparse
from pathlib import Path
from typing import Any

from t3mpc_ros.parameters.command_line import bounded_int

SEED = 1
OUTPUT = Path('runs') / 'twin'


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Return the parser of ``twin``, added to the sub-parsers of a program."""
    parser: argparse.ArgumentParser = commands.add_parser(
        'twin', help='the simulated robot against data sheets, and its odometry under slip'
    )
    parser.add_argument('--output', type=Path, default=OUTPUT, help=f'folder (default {OUTPUT})')
    parser.add_argument(
        '--quick', action='store_true', help='one seed and short runs: shows that all works'
    )
    parser.add_argument(
        '--seed',
        type=bounded_int(0, 2**31 - 1),
        default=SEED,
        help=f'of the first of the robots (default {SEED})',
    )
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Write figures, page and tables and return 0."""
    from t3mpc_ros.evaluation.twin_validation.validation_page import FULL, QUICK, write_validation

    amount = QUICK if options.quick else FULL
    print(write_validation(options.output, options.seed, amount, progress=True))
    return 0
