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
"""``t3mpc tune``: tunes the compared methods, or identifies the drive of a robot from a bag."""

import argparse
from pathlib import Path

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli import shared_options
from t3mpc_ros.parameters.command_line import bounded_int

DRIVES = {'torque': 'torque', 'servo': 'velocity'}
"""Drives of the paper's plant by robot."""
TWIN = 'twin'
EVALUATIONS = 120
TWIN_EVALUATIONS = 30
OUTPUT = Path('runs') / 'tuned.json'


def add_parser(commands: shared_options.Commands) -> None:
    """Add the subcommand ``tune``."""
    parser = commands.add_parser(
        'tune',
        help='tune the parameters of every method with equally many evaluations, or those of the '
        'controller to the robot in a bag',
        description='With a simulated robot: tunes every method with equally many evaluations. '
        'With a bag of any robot with cmd_vel and odom: identifies lag, dead time and noise of '
        'the drive, and prints a parameter file of the controller with the gain that fits.',
    )
    add = parser.add_argument
    add('methods', nargs='*', metavar='METHOD', help='by name (default all)')
    add(
        '--robot',
        metavar='twin|servo|torque|BAG',
        help="twin: the stepper robot; servo, torque: the paper's plant with that drive; or the "
        'folder or file of a bag (default servo and torque)',
    )
    text = f'of each method with each robot (default {EVALUATIONS}; twin {TWIN_EVALUATIONS})'
    add('--evaluations', type=bounded_int(1, 100_000), help=text)
    shared_options.add_workers(parser)
    text = f'file to write (default {OUTPUT}; with a bag none but the standard output)'
    add('--output', type=Path, help=text)
    add('--resume', action='store_true', help='go on where the last tuning was interrupted')
    shared_options.add_json(parser, 'also write the parameters')
    shared_options.add_topic_options(parser.add_argument_group('with a bag'))
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Tune every method, or identify the drive in a bag; print the result."""
    if options.robot not in (None, TWIN, *DRIVES):
        _identify(options)
        return
    from t3mpc_ros.evaluation.experiment import print_report
    from t3mpc_ros.evaluation.method_table import (
        further_definitions,
        method_definitions,
        require_libraries,
    )
    from t3mpc_ros.evaluation.tuning import tune_methods
    from t3mpc_ros.evaluation.tuning.tuned_parameters import TuningBudget
    from t3mpc_ros.parameters.table import find_names

    known = [*method_definitions(), *further_definitions()]
    names = find_names('method', options.methods, [method.name for method in known])
    methods = [method for method in known if method.name in names or not names]
    require_libraries(method.name for method in methods)
    drives = [DRIVES[options.robot]] if options.robot in DRIVES else list(DRIVES.values())
    if options.robot is None:  # those of which a method is
        drives = [each for each in drives if any(each in method.start for method in methods)]
    with shared_options.executor_of(options) as executor:
        how = (executor, options.output or OUTPUT, print_report)
        if options.robot == TWIN:
            store = tune_methods.tune_twin(
                tune_methods.twin_definitions(methods),
                options.evaluations or TWIN_EVALUATIONS,
                *how,
                resume=options.resume,
            )
        else:
            store = tune_methods.tune_methods(
                methods,
                drives,
                TuningBudget(options.evaluations or EVALUATIONS),
                *how,
                resume=options.resume,
            )
    shared_options.print_result(options, store.table, store.to_dict)


def _identify(options: argparse.Namespace) -> None:
    """Print the parameter file for the robot in the bag ``options.robot``."""
    from t3mpc_ros.evaluation.topic_roles import bag_display_name
    from t3mpc_ros.evaluation.tuning.drive_identification import (
        drive_file,
        drive_record,
        identify_bag,
    )

    bag = Path(options.robot)
    if not bag.exists():
        raise ValueError(
            f'robot must be {TWIN}, {", ".join(sorted(DRIVES))} or an existing bag: got {bag}'
        )
    if options.methods or options.evaluations or options.resume:
        raise ValueError('methods, --evaluations and --resume are for simulated robots: got a bag')
    if options.output:
        shared_options.prepare_file(options.output)
    found = identify_bag(bag, shared_options.report_options(options))
    text = drive_file(*found, bag_display_name(bag))
    shared_options.print_result(options, lambda: text.rstrip('\n'), lambda: drive_record(*found))
    if options.output:
        write_atomically(options.output, text)
