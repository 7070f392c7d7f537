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
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli import shared_options
from t3mpc_ros.parameters.command_line import bounded_int

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition
    from t3mpc_ros.evaluation.tuning.tuned_parameter_file import TunedParameters


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
    from t3mpc_ros.evaluation.methods import (
        further_definitions,
        method_definitions,
        require_libraries,
    )
    from t3mpc_ros.parameters.table import find_names

    if options.robot not in (None, TWIN, *DRIVES):
        _identify(options)
        return
    known = [*method_definitions(), *further_definitions()]
    names = find_names('method', options.methods, [method.name for method in known])
    methods = [method for method in known if method.name in names or not names]
    require_libraries(method.name for method in methods)
    with shared_options.executor_of(options) as executor:
        store = _tuned(options, methods, executor)
    shared_options.print_result(options, store.table, store.to_dict)


def _tuned(
    options: argparse.Namespace, methods: 'Sequence[MethodDefinition]', executor: 'int | Executor'
) -> 'TunedParameters':
    """Return the parameters after tuning on the chosen robots."""
    from t3mpc_ros.evaluation.experiment import print_report

    output = options.output or OUTPUT
    if options.robot == TWIN:
        from t3mpc_ros.evaluation.tuning.tune_methods import tune_twin, twin_definitions

        return tune_twin(
            twin_definitions(methods),
            options.evaluations or TWIN_EVALUATIONS,
            executor,
            output,
            print_report,
            resume=options.resume,
        )
    from t3mpc_ros.evaluation.tuning.tune_methods import tune_methods
    from t3mpc_ros.evaluation.tuning.tuned_parameter_file import TuningBudget

    drives = [DRIVES[options.robot]] if options.robot else list(DRIVES.values())
    return tune_methods(
        methods,
        [drive for drive in drives if options.robot or any(drive in m.start for m in methods)],
        TuningBudget(options.evaluations or EVALUATIONS),
        executor,
        output,
        print_report,
        resume=options.resume,
    )


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
    found = identify_bag(bag, shared_options.report_options(options))
    text = drive_file(*found, bag_display_name(bag))
    shared_options.print_result(options, lambda: text.rstrip('\n'), lambda: drive_record(*found))
    if options.output:
        write_atomically(options.output, text)
