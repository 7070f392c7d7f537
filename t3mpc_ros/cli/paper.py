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
"""``t3mpc paper``: reproduces figures, tables and claims of the paper."""

import argparse
from pathlib import Path

from t3mpc_ros.cli import shared_options


def add_parser(commands: shared_options.Commands) -> None:
    """Add the subcommand ``paper``."""
    parser = commands.add_parser(
        'paper', help='every figure and table of the paper, and the verdict on its claims'
    )
    add = parser.add_argument
    add('--quick', action='store_true', help='few seeds and short runs: shows that all works')
    shared_options.add_seeds(
        parser, '', 'the runs', counted=True, text='the 20 held-out ones, quick: 3'
    )
    shared_options.add_seeds(
        parser,
        '',
        'the comparison without a controller (86)',
        name='--estimation-seeds',
        counted=True,
        text='20, quick: 2',
    )
    shared_options.add_workers(parser)
    add(
        '--output',
        type=shared_options.new_folder,
        help='folder (default runs/paper, or runs/paper-quick)',
    )
    shared_options.add_json(parser, 'also write the results')
    add('--fresh', action='store_true', help='discard the runs that the folder holds')
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Write everything."""
    from t3mpc_ros.evaluation.experiment import print_report
    from t3mpc_ros.evaluation.method_table import NMPC, require_libraries
    from t3mpc_ros.evaluation.paper.reproduce import reproduce

    require_libraries([NMPC])
    output = options.output or Path('runs') / ('paper-quick' if options.quick else 'paper')
    with shared_options.executor_of(options) as executor:
        text, numbers = reproduce(
            output,
            quick=options.quick,
            seeds=options.seeds,
            estimation_seeds=options.estimation_seeds,
            workers=executor,
            fresh=options.fresh,
            report=print_report,
        )
    shared_options.print_result(options, lambda: text, lambda: numbers)
