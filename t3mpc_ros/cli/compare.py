# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc compare``: the controller and every baseline on one robot, case by case."""

import argparse
import os
from pathlib import Path
from typing import Any

from t3mpc_ros.parameters.command_line import bounded_float, bounded_int

ROBOTS = ('twin', 'servo', 'torque')
DEFAULT_SEEDS = '201-206'


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Return the parser of ``compare``, added to the sub-parsers of a program."""
    parser: argparse.ArgumentParser = commands.add_parser(
        'compare', help='the controller and every baseline on one robot, case by case'
    )
    parser.add_argument(
        '--robot',
        choices=ROBOTS,
        default='twin',
        help='twin: the stepper robot, ground truth of its body included (default); servo, '
        "torque: the paper's plant with that drive",
    )
    parser.add_argument(
        '--seeds',
        type=seed_range,
        default=seed_range(DEFAULT_SEEDS),
        metavar='A-B',
        help=f'seeds of reference and robot (default {DEFAULT_SEEDS}, a quick look; none of them '
        'was used for tuning or is in another table)',
    )
    parser.add_argument(
        '--cases', nargs='+', default=(), metavar='CASE', help='by name (default: all)'
    )
    parser.add_argument(
        '--methods',
        nargs='+',
        default=(),
        metavar='METHOD',
        help='by name; all: with stages and ablations of the controller (default: the full '
        'controller and every baseline)',
    )
    parser.add_argument(
        '--duration',
        type=bounded_float(2.0, 3600.0, 's'),
        default=60.0,
        help='of each run, s (default 60)',
    )
    parser.add_argument(
        '--noise',
        type=bounded_float(0.0, 100.0, '(rad/s)²'),
        default=0.04,
        help='variance of the measured wheel speeds, (rad/s)² (default 0.04)',
    )
    parser.add_argument(
        '--gyro',
        action='store_true',
        help='twin: baselines take the yaw rate from the gyro in every case, not only where the '
        'robot is miscalibrated',
    )
    parser.add_argument(
        '--workers',
        type=bounded_int(1, 10_000),
        default=max(1, len(os.sched_getaffinity(0))),
        help='processes (default: processors)',
    )
    parser.add_argument('--json', type=Path, help='write every number to this file')
    parser.add_argument('--html', type=Path, help='write one page to this file')
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Print the tables and return 0.

    Raises
    ------
    ValueError
        An unknown case or method.
    ModuleNotFoundError
        A method needs a library that is not installed.
    """
    from t3mpc_ros.evaluation.method_comparison import comparison_page
    from t3mpc_ros.evaluation.method_comparison.compared_runs import (
        ComparisonPlan,
        cases_for,
        compare,
        default_methods,
        methods_for,
    )
    from t3mpc_ros.evaluation.methods import require_libraries
    from t3mpc_ros.evaluation.reporting import strict_json
    from t3mpc_ros.evaluation.tuning.search_space import find_names

    known = methods_for(options.robot)
    wanted = list(known) if options.methods == ['all'] else options.methods
    names = find_names('method', wanted, known)
    plan = ComparisonPlan(
        options.robot,
        find_names('case', options.cases, cases_for(options.robot)) or cases_for(options.robot),
        names or default_methods(options.robot),
        options.seeds,
        options.duration,
        options.noise,
        options.gyro,
    )
    require_libraries(plan.methods)
    for path in (options.json, options.html):
        if path:  # a folder that cannot be made is an error before the runs, not after them
            path.parent.mkdir(parents=True, exist_ok=True)
    results = compare(plan, options.workers, progress=True)
    print(comparison_page.markdown(plan, results))
    if options.json:
        content = comparison_page.record(plan, results)
        options.json.write_text(strict_json(content), encoding='utf-8')
    if options.html:
        options.html.write_text(comparison_page.page(plan, results), encoding='utf-8')
    return 0


def seed_range(text: str) -> tuple[int, ...]:
    """Return the seeds of ``A-B``, both included, or of ``A``; an argparse type."""
    first, dash, last = text.partition('-')
    try:
        low = int(first)
        high = int(last) if dash else low
    except ValueError:
        raise argparse.ArgumentTypeError(f'must be A-B, as in 201-206: got {text}') from None
    if not 0 <= low <= high or high - low >= 10_000:
        raise argparse.ArgumentTypeError(
            f'must be A-B with 0 <= A <= B and at most 10000 seeds: got {text}'
        )
    return tuple(range(low, high + 1))
