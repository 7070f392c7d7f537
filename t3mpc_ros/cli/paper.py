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
"""``t3mpc paper``, ``estimation`` and ``exponents``: what the paper states, reproduced."""

import argparse
from pathlib import Path

from t3mpc_ros.cli.shared_options import (
    SECONDS,
    Commands,
    add_json,
    add_seeds,
    add_workers,
    executor_of,
    new_folder,
    print_result,
)
from t3mpc_ros.parameters.command_line import bounded_float


def add_parser(commands: Commands) -> None:
    """Add the subcommands."""
    parser = commands.add_parser(
        'estimation', help='the kinds of fuzzy systems as estimators, without a controller (86)'
    )
    add_seeds(parser, '1-5', 'the runs', counted=True)
    parser.add_argument('--duration', type=SECONDS, default=60.0, help='seconds (default 60)')
    text = 'normalised gain of all kinds, 1/s² (default 40)'
    parser.add_argument('--gain', type=bounded_float(0.0, 1e6, '1/s²'), default=40.0, help=text)
    add_json(parser)
    parser.set_defaults(run=_compare_estimators)

    parser = commands.add_parser('exponents', help='Lyapunov exponents of the generator')
    text = 'system seconds (default 200)'
    parser.add_argument('--duration', type=SECONDS, default=200.0, help=text)
    add_json(parser)
    parser.set_defaults(run=_print_exponents)

    parser = commands.add_parser(
        'paper', help='every figure and table of the paper, and the verdict on its claims'
    )
    add = parser.add_argument
    add('--quick', action='store_true', help='few seeds and short runs: shows that all works')
    add_seeds(parser, '', 'the runs', counted=True, text='the 20 held-out ones, quick: 3')
    of, name = 'the comparison without a controller (86)', '--estimation-seeds'
    add_seeds(parser, '', of, name=name, counted=True, text='20, quick: 2')
    add_workers(parser)
    text = 'folder (default runs/paper, or runs/paper-quick)'
    add('--output', type=new_folder, help=text)
    add_json(parser, 'also write the results')
    add('--fresh', action='store_true', help='discard the runs that the folder holds')
    parser.set_defaults(run=_reproduce)


def _compare_estimators(options: argparse.Namespace) -> None:
    """Print the table of the kinds of fuzzy systems."""
    from t3mpc_ros.evaluation.fuzzy_estimation_error import compare, records
    from t3mpc_ros.evaluation.paper.paper_study import estimation

    results = compare(
        seeds=options.seeds, duration=options.duration, normalised_gain=options.gain, progress=True
    )
    print_result(
        options,
        lambda: '\n\n'.join(table.markdown() for table in estimation(results)),
        lambda: records(results),
    )


def _print_exponents(options: argparse.Namespace) -> None:
    """Print the exponents and their sum."""
    from t3mpc_ros.chaos.system_equations import hyperchaotic_system
    from t3mpc_ros.evaluation.lyapunov_exponents import lyapunov_exponents

    values = lyapunov_exponents(hyperchaotic_system(orders=(1.0,) * 4), duration=options.duration)
    text = ', '.join(f'{value:.3f}' for value in values)
    print_result(
        options,
        lambda: (
            f'Lyapunov exponents of (85) at q = 1: {text}\n'
            f'their sum: {sum(values):.3f} (trace of the Jacobian: -38)'
        ),
        lambda: {'exponents': [*values], 'sum': sum(values), 'duration': options.duration},
    )


def _reproduce(options: argparse.Namespace) -> None:
    """Write everything."""
    from t3mpc_ros.evaluation.experiment import print_report
    from t3mpc_ros.evaluation.method_table import NMPC, require_libraries
    from t3mpc_ros.evaluation.paper.reproduce import reproduce

    require_libraries([NMPC])
    output = options.output or Path('runs') / ('paper-quick' if options.quick else 'paper')
    with executor_of(options) as executor:
        text, numbers = reproduce(
            output,
            quick=options.quick,
            seeds=options.seeds,
            estimation_seeds=options.estimation_seeds,
            workers=executor,
            fresh=options.fresh,
            report=print_report,
        )
    print_result(options, lambda: text, lambda: numbers)
