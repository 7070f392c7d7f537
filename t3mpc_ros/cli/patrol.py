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
"""``t3mpc patrol``: how good a patrol our path is, against other paths."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
import sys
from typing import Any

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli import shared_options
from t3mpc_ros.parameters.command_line import bounded_float

DEFAULT_SEEDS = '101-105'
OUTPUT = Path('runs') / 'patrol'
RUNS = '.runs.jsonl'
"""End of the name of the file with the finished runs of an interrupted study."""


def add_parser(commands: shared_options.Commands) -> None:
    """Add the subcommand ``patrol``."""
    parser = commands.add_parser(
        'patrol', help='coverage and predictability of the chaotic patrol against other paths'
    )
    add = parser.add_argument
    text = (
        'exact: a robot that is always on its reference, in an empty room (default); twin: '
        'the simulated robot among unknown boxes with keep-out, which takes about as long as it '
        'drives'
    )
    add('--robot', choices=('exact', 'twin'), default='exact', help=text)
    add(
        '--planned',
        action='store_true',
        help='as --robot twin, and the path goes around what the robot has seen; the robot rests '
        'and looks before floor that it has not; also with --safety and --localization',
    )
    shared_options.add_seeds(parser, DEFAULT_SEEDS, 'path, robot and room')
    text = (
        'of each patrol (default 18, three times what the boustrophedon needs); from 2.2 on '
        'with predictability'
    )
    add('--minutes', type=bounded_float(0.1, 1440.0, 'min'), default=18.0, help=text)
    add(
        '--arena',
        type=float,
        nargs=4,
        default=[-1.75, -1.25, 1.75, 1.25],
        metavar=('LEFT', 'BOTTOM', 'RIGHT', 'TOP'),
        help='where the paths lie, around the start at 0 0, m (default -1.75 -1.25 1.75 1.25)',
    )
    text = 'by name (default: all); with --localization its cases'
    add('--paths', nargs='+', default=(), metavar='PATH', help=text)
    text = (
        'instead: how exactly the simulated robot follows a straight line, a square, a '
        'figure of eight and a recorded path, with and without each part of the controller and '
        'by pure pursuit; tune: errors of the choices of gains and lookaheads on another path'
    )
    add('--tracking', nargs='?', const='compare', choices=('compare', 'tune'), help=text)
    add(
        '--safety',
        action='store_true',
        help='instead: what the simulated robot touches when its range sensors fail, things are '
        'placed in its way, people step in or boxes are below its beams',
    )
    add(
        '--localization',
        action='store_true',
        help='instead: how well the simulated robot knows its place in a known room, by odometry '
        'and by the particle filter, also with more noise and after it was carried; a table',
    )
    shared_options.add_workers(parser)
    shared_options.add_json(parser, 'also write every run')
    add(
        '--output',
        type=shared_options.new_folder,
        default=OUTPUT,
        help=f'folder of the page (default {OUTPUT})',
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the tables, write page, pictures and numbers, and return 0."""
    from t3mpc_ros.evaluation.experiment import ResultFile, print_report
    from t3mpc_ros.evaluation.figure_style import write_pictures
    from t3mpc_ros.evaluation.result_output import strict_json

    if options.safety:
        return _safety(options)
    figures = options.output / 'figures'
    figures.mkdir(parents=True, exist_ok=True)  # an error before the runs, not after them
    if options.localization:
        return _compare_localizations(options)
    if options.tracking == 'tune':
        return _tune_tracking(options)
    name = 'tracking' if options.tracking else 'patrol'
    page, plan, compare = (_tracking if options.tracking else _patrols)(options)
    runs = options.output / f'{name}{RUNS}'
    with shared_options.executor_of(options) as executor:
        study = compare(plan, runs, executor, print_report)
    record = page.record(study)
    shared_options.print_result(options, lambda: page.markdown(study), lambda: record)
    drawn = write_pictures({each.stem: each.draw for each in page.PICTURES}, study, figures)
    write_atomically(options.output / f'{name}.json', strict_json(record))
    written = options.output / f'{name}.html'
    write_atomically(written, page.page(study, drawn))
    ResultFile(runs).remove(study.table.keys)
    print(f'written to {written}', file=sys.stderr)
    return 0


def _print_table(
    options: argparse.Namespace,
    measure: Callable[..., Any],
    markdown: Callable[[Any], str],
    numbers: Callable[[Any], object] = lambda found: found.rows,
) -> int:
    from t3mpc_ros.evaluation.experiment import print_report

    with shared_options.executor_of(options) as executor:
        found = measure(workers=executor, report=print_report)
    shared_options.print_result(options, lambda: markdown(found), lambda: numbers(found))
    return 0


def _tune_tracking(options: argparse.Namespace) -> int:
    from t3mpc_ros.evaluation.patrol import path_tracker_comparison as study

    return _print_table(options, study.tune_trackers, study.tuning_markdown, lambda found: found)


def _safety(options: argparse.Namespace) -> int:
    from t3mpc_ros.evaluation.patrol.safety_study import compare_safety, safety_table

    seconds = 60.0 * options.minutes
    measure = partial(compare_safety, options.seeds, seconds, planned=options.planned)
    return _print_table(options, measure, lambda found: safety_table(found).markdown())


def _compare_localizations(options: argparse.Namespace) -> int:
    from t3mpc_ros.evaluation.patrol import localization_study as study

    cases = options.paths or tuple(study.CASES)
    seconds = 60.0 * options.minutes
    plan = study.LocalizationPlan(cases, options.seeds, seconds, planned=options.planned)
    runs = options.output / f'localization{RUNS}'
    measure = partial(study.compare_localizations, plan, runs)
    return _print_table(options, measure, partial(study.markdown, plan))


_Study = tuple[Any, Any, Callable[..., Any]]
"""Module of the study, plan, and the function that measures it."""


def _tracking(options: argparse.Namespace) -> _Study:
    from t3mpc_ros.evaluation.patrol import path_tracker_comparison as study

    paths = options.paths or tuple(study.TRACKED_PATHS)
    plan = study.TrackingPlan(paths=paths, seeds=options.seeds)
    return study, plan, study.compare_trackers


def _patrols(options: argparse.Namespace) -> _Study:
    from t3mpc_ros.evaluation.patrol import patrol_comparison as study

    plan = study.PatrolPlan(
        paths=options.paths or study.PATHS,
        seeds=options.seeds,
        duration=60.0 * options.minutes,
        robot='twin' if options.planned else options.robot,
        planned=options.planned,
        arena=tuple(options.arena),
    )
    return study, plan, study.compare_patrols
