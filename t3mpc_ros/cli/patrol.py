# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc patrol``: how good a patrol our path is, against other paths."""

import argparse
from functools import partial
from pathlib import Path
import sys
from typing import Any, NamedTuple

from t3mpc_ros.cli.run_options import add_seeds, add_workers, executor_of
from t3mpc_ros.parameters.command_line import bounded_float

DEFAULT_SEEDS = '101-105'
OUTPUT = Path('runs') / 'patrol'
RUNS = '.runs.jsonl'
"""End of the name of the file with the finished runs of an interrupted study."""


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Return the parser of ``patrol``, added to the sub-parsers of a program."""
    parser: argparse.ArgumentParser = commands.add_parser(
        'patrol', help='coverage and predictability of the chaotic patrol against other paths'
    )
    parser.add_argument(
        '--robot',
        choices=('exact', 'twin'),
        default='exact',
        help='exact: a robot that is always on its reference, in an empty room (default); twin: '
        'the simulated robot among unknown boxes with keep-out, which takes about as long as it '
        'drives',
    )
    add_seeds(parser, DEFAULT_SEEDS, 'path, robot and room')
    parser.add_argument(
        '--minutes',
        type=bounded_float(0.1, 1440.0, 'min'),
        default=18.0,
        help='of each patrol (default 18, three times what the boustrophedon needs); from 2.2 on '
        'with predictability',
    )
    parser.add_argument(
        '--arena',
        type=float,
        nargs=4,
        default=[-1.75, -1.25, 1.75, 1.25],
        metavar=('LEFT', 'BOTTOM', 'RIGHT', 'TOP'),
        help='where the paths lie, around the start at 0 0, m (default -1.75 -1.25 1.75 1.25)',
    )
    parser.add_argument(
        '--paths', nargs='+', default=(), metavar='PATH', help='by name (default: all)'
    )
    parser.add_argument(
        '--tracking',
        nargs='?',
        const='compare',
        choices=('compare', 'tune'),
        help='instead: how exactly the simulated robot follows a straight line, a square, a '
        'figure of eight and a recorded path, with and without each part of the controller and '
        'by pure pursuit; tune: errors of the choices of gains and lookaheads on another path',
    )
    add_workers(parser)
    parser.add_argument(
        '--output', type=Path, default=OUTPUT, help=f'folder of the page (default {OUTPUT})'
    )
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Print the tables, write page, pictures and numbers, and return 0."""
    from t3mpc_ros.evaluation.plotting import write_pictures
    from t3mpc_ros.evaluation.reporting import strict_json

    figures = options.output / 'figures'
    figures.mkdir(parents=True, exist_ok=True)  # an error before the runs, not after them
    with executor_of(options) as executor:
        if options.tracking == 'tune':
            return _tune_tracking(executor)
        study = (_tracking if options.tracking else _patrols)(options, executor)
    page, plan, results = study.page, study.plan, study.results
    print(page.markdown(plan, results))
    drawn = write_pictures(page.PICTURES, study.drawn, figures)
    numbers = strict_json(page.record(plan, results))
    (options.output / f'{study.name}.json').write_text(numbers, encoding='utf-8')
    written = options.output / f'{study.name}.html'
    written.write_text(page.page(plan, results, drawn), encoding='utf-8')
    (options.output / f'{study.name}{RUNS}').unlink(missing_ok=True)
    print(f'written to {written}', file=sys.stderr)
    return 0


def _tune_tracking(executor: Any) -> int:
    from t3mpc_ros.evaluation.patrol import tracking_page
    from t3mpc_ros.evaluation.patrol.path_tracking import tune_trackers

    print(tracking_page.tuning_markdown(tune_trackers(executor, progress=True)))
    return 0


class _Study(NamedTuple):
    """Results, the module with their page, and what its pictures are drawn of."""

    name: str
    page: Any
    plan: Any
    results: Any
    drawn: Any


def _tracking(options: argparse.Namespace, executor: Any) -> _Study:
    from t3mpc_ros.evaluation.patrol import tracking_page
    from t3mpc_ros.evaluation.patrol.path_tracking import (
        TRACKED_PATHS,
        TrackingPlan,
        compare_trackers,
    )
    from t3mpc_ros.parameters.table import find_names

    names = tuple(TRACKED_PATHS)
    plan = TrackingPlan(
        paths=find_names('path', options.paths, names) or names, seeds=options.seeds
    )
    results = compare_trackers(plan, executor, progress=True)
    return _Study('tracking', tracking_page, plan, results, results)


def _patrols(options: argparse.Namespace, executor: Any) -> _Study:
    from t3mpc_ros.evaluation.patrol import patrol_page
    from t3mpc_ros.evaluation.patrol.patrol_comparison import PATHS, PatrolPlan, compare_patrols
    from t3mpc_ros.evaluation.patrol.patrol_figures import Comparison
    from t3mpc_ros.parameters.table import find_names

    plan = PatrolPlan(
        paths=find_names('path', options.paths, PATHS) or PATHS,
        seeds=options.seeds,
        duration=60.0 * options.minutes,
        robot=options.robot,
        arena=tuple(options.arena),
    )
    file = options.output / f'patrol{RUNS}'
    results = compare_patrols(plan, file, executor, partial(print, file=sys.stderr, flush=True))
    return _Study('patrol', patrol_page, plan, results, Comparison(plan, results))
