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
"""``t3mpc compare``: the controller and every baseline on one robot, case by case."""

import argparse
from pathlib import Path
import time
from typing import TYPE_CHECKING

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli import shared_options

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.comparison import ComparisonPlan

DEFAULT_SEEDS = '201-206'


def add_parser(commands: shared_options.Commands) -> None:
    """Add the subcommand ``compare``."""
    parser = commands.add_parser(
        'compare',
        help='the controller, every baseline and your own on one robot, case by case',
        description='Compares the controller with every baseline; with your own controllers, '
        'compares them with the full controller in the nominal case.',
    )
    add = parser.add_argument
    text = (
        'a controller of your own: a class with step(observation), or a function of the '
        'observation'
    )
    add('own', nargs='*', metavar='FILE.py:NAME', help=text)
    shared_options.add_setting(parser)
    shared_options.add_seeds(
        parser,
        DEFAULT_SEEDS,
        'reference and robot; none of the default ones, a quick look, was used for tuning or is '
        'in another table',
    )
    text = 'by name (default: all; with your own controllers: nominal)'
    add('--cases', nargs='+', default=(), metavar='CASE', help=text)
    text = (
        'by name; all: with stages and ablations of the controller (default: the full '
        'controller and every baseline; with your own controllers: the full controller)'
    )
    add('--methods', nargs='+', default=(), metavar='METHOD', help=text)
    add(
        '--gyro',
        action='store_true',
        help='twin: baselines take the yaw rate from the gyro in every case, not only where the '
        'robot is miscalibrated',
    )
    shared_options.add_workers(parser)
    shared_options.add_outputs(parser, 'write every number')
    add('--csv', type=Path, help='write a row for each run, with commit and machine')
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the tables."""
    from t3mpc_ros.evaluation.api.comparison_runs import Comparison
    from t3mpc_ros.evaluation.api.result_tables import writable
    from t3mpc_ros.evaluation.comparison import markdown, page, record, run_plan, step_times
    from t3mpc_ros.evaluation.experiment import print_report
    from t3mpc_ros.evaluation.result_output import columns_of, write_columns

    plan = _plan(options)
    with shared_options.executor_of(options) as executor:
        results = run_plan(plan, executor, print_report)
    times = step_times(plan, time.perf_counter_ns)
    shared_options.print_result(
        options,
        lambda: markdown(plan, results, times),
        lambda: record(plan, results, times),
    )
    if options.html:
        write_atomically(options.html, page(plan, results, times))
    if options.csv:
        write_columns(writable(options.csv), columns_of(Comparison(plan, results).rows()))


def _plan(options: argparse.Namespace) -> 'ComparisonPlan':
    """Return what is compared: methods of the package, or with a part of one's own what is named.

    With a controller, robot or reference of one's own, the first named method is the reference of
    the comparison.
    """
    from t3mpc_ros.evaluation.api.comparison_runs import make_plan
    from t3mpc_ros.evaluation.api.script_inputs import own_scenario
    from t3mpc_ros.evaluation.comparison import ComparisonPlan
    from t3mpc_ros.evaluation.method_table import default_methods, methods_for, require_libraries
    from t3mpc_ros.parameters.table import find_names

    own = bool(options.own or options.reference or options.robot not in shared_options.ROBOTS)
    if own and options.gyro:
        raise ValueError('--gyro is for the methods of the package: got your own')
    scenario = own_scenario(**shared_options.setting_of(options), gyro=options.gyro)
    if own:
        chosen = [*(options.methods or [shared_options.FULL]), *options.own]
        return make_plan(
            chosen, options.seeds, options.cases or (shared_options.NOMINAL,), scenario
        )
    known = methods_for(scenario.robot)
    wanted = list(known) if options.methods == ['all'] else options.methods
    names = find_names('method', wanted, known) or default_methods(scenario.robot)
    require_libraries(names)
    cases = find_names('case', options.cases, scenario.known_cases) or scenario.known_cases
    return ComparisonPlan(scenario, cases, {name: known[name] for name in names}, options.seeds)
