# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc compare``: the controller and every baseline on one robot, case by case."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from t3mpc_ros.cli.run_options import (
    FULL,
    NOMINAL,
    ROBOTS,
    add_seeds,
    add_setting,
    add_workers,
    executor_of,
)

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.comparison import ComparisonPlan

DEFAULT_SEEDS = '201-206'


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Return the parser of ``compare``, added to the sub-parsers of a program."""
    parser: argparse.ArgumentParser = commands.add_parser(
        'compare',
        help='the controller, every baseline and your own on one robot, case by case',
        description='Compares the controller with every baseline; with your own controllers, '
        'compares them with the full controller in the nominal case.',
    )
    parser.add_argument(
        'own',
        nargs='*',
        metavar='FILE.py:NAME',
        help='a controller of your own: a class with step(observation), or a function of the '
        'observation',
    )
    add_setting(parser)
    add_seeds(
        parser,
        DEFAULT_SEEDS,
        'reference and robot; none of the default ones, a quick look, was used for tuning or is '
        'in another table',
    )
    parser.add_argument(
        '--cases',
        nargs='+',
        default=(),
        metavar='CASE',
        help='by name (default: all; with your own controllers: nominal)',
    )
    parser.add_argument(
        '--methods',
        nargs='+',
        default=(),
        metavar='METHOD',
        help='by name; all: with stages and ablations of the controller (default: the full '
        'controller and every baseline; with your own controllers: the full controller)',
    )
    parser.add_argument(
        '--gyro',
        action='store_true',
        help='twin: baselines take the yaw rate from the gyro in every case, not only where the '
        'robot is miscalibrated',
    )
    add_workers(parser)
    parser.add_argument('--json', type=Path, help='write every number to this file')
    parser.add_argument('--html', type=Path, help='write one page to this file')
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Print the tables and return 0."""
    from t3mpc_ros.evaluation.cases import cases_for
    from t3mpc_ros.evaluation.comparison import ComparisonPlan, default_methods
    from t3mpc_ros.evaluation.methods import methods_for, require_libraries
    from t3mpc_ros.parameters.table import find_names

    if options.own or options.reference or options.robot not in ROBOTS:
        return _run_own(options)
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
    return _compare_and_write(options, plan)


def _run_own(options: argparse.Namespace) -> int:
    """Compare controllers, or on a robot or reference, of one's own; errors are one sentence."""
    from t3mpc_ros.scripting.script_error import one_sentence

    return one_sentence(_compare_own)(options)


def _compare_own(options: argparse.Namespace) -> int:
    from t3mpc_ros.scripting.comparison_runs import make_plan
    from t3mpc_ros.scripting.controllers import loaded
    from t3mpc_ros.scripting.setting import Setting

    if options.gyro:
        raise ValueError('--gyro is for the methods of the package: got your own')
    plant = options.robot if options.robot in ROBOTS else loaded(options.robot)
    setting = Setting(plant, options.reference, options.noise, duration=options.duration)
    chosen = [*(options.methods or [FULL]), *options.own]
    plan = make_plan(chosen, options.seeds, options.cases or (NOMINAL,), setting)
    return _compare_and_write(options, plan)


def _compare_and_write(options: argparse.Namespace, plan: 'ComparisonPlan') -> int:
    from t3mpc_ros.evaluation import comparison_page
    from t3mpc_ros.evaluation.comparison import compare
    from t3mpc_ros.evaluation.experiment import print_report
    from t3mpc_ros.evaluation.reporting import strict_json
    from t3mpc_ros.scripting.run_executors import workers_for

    for path in (options.json, options.html):
        if path:  # a folder that cannot be made is an error before the runs, not after them
            path.parent.mkdir(parents=True, exist_ok=True)
    with executor_of(options) as executor:
        results = compare(plan, workers_for(executor, plan.runs()), print_report)
    print(comparison_page.markdown(plan, results))
    if options.json:
        content = comparison_page.record(plan, results)
        options.json.write_text(strict_json(content), encoding='utf-8')
    if options.html:
        options.html.write_text(comparison_page.page(plan, results), encoding='utf-8')
    return 0
