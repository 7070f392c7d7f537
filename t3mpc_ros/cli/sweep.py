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
"""``t3mpc sweep``: runs over parameters × seeds × cases × controllers into one Parquet file."""

import argparse
from pathlib import Path
import sys

from t3mpc_ros.cli import shared_options
from t3mpc_ros.parameters.command_line import parsed_value

OUTPUT = Path('runs') / 'sweep.parquet'
SOME_FAILED = 3
"""Exit code: the file was written, but some of its runs failed."""


def add_parser(commands: shared_options.Commands) -> None:
    """Add the subcommand ``sweep``."""
    parser = commands.add_parser(
        'sweep',
        help='parameters × seeds × cases × controllers, on all processors or a cluster',
        description='Runs every combination and writes one row for each run. Started again after '
        'an interruption, or with more values, it runs only what the file lacks, and runs that '
        'failed. Exit code 0: every run has its result; 3: some failed; 1: none was made.',
    )
    add = parser.add_argument
    text = 'name of a method, or FILE.py:NAME (default full)'
    add('controllers', nargs='*', default=[shared_options.FULL], metavar='CONTROLLER', help=text)
    add(
        '--set',
        nargs='+',
        action='extend',
        default=[],
        type=_values,
        metavar='NAME=V,V,…',
        help='values of a parameter of the controller, of noise or duration, or of robot.NAME',
    )
    shared_options.add_setting(parser)
    shared_options.add_seeds(parser, '1-5', 'reference and robot')
    text = 'by name (default nominal)'
    add('--cases', nargs='+', default=(shared_options.NOMINAL,), metavar='CASE', help=text)
    add('--output', type=Path, default=OUTPUT, help=f'Parquet file (default {OUTPUT})')
    add('--metric', default='settled', help='column that the table shows (default settled)')
    shared_options.add_workers(parser)
    shared_options.add_json(parser, 'also write the rows')
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the sweep, print its table, and return 0, or :data:`SOME_FAILED`."""
    from t3mpc_ros.evaluation.api.comparison_runs import find_metric
    from t3mpc_ros.evaluation.api.parameter_sweep import has_failed, sweep

    names = [name for name, _ in options.set]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f'--set must name each parameter once, with all of its values: got {repeated[0]} again'
        )
    shared_options.prepare_file(options.output)
    metric = find_metric(options.metric).name
    with shared_options.executor_of(options) as executor:
        found = sweep(
            options.controllers,
            dict(options.set),
            seeds=options.seeds,
            cases=options.cases,
            **shared_options.setting_of(options),
            output=options.output,
            executor=executor,
            progress=True,
        )
    shared_options.print_result(
        options,
        lambda: f'{found.table(metric)}\n{len(found.rows)} runs: {options.output}',
        lambda: found.rows,
    )
    if failed := sum(map(has_failed, found.rows)):
        print(
            f'{failed} of {len(found.rows)} runs failed, for the reasons in the column error; the '
            'same command makes these again',
            file=sys.stderr,
        )
        return SOME_FAILED
    return 0


def _values(text: str) -> tuple[str, list[object]]:
    """Return name and values of ``NAME=V,V``; an argparse type."""
    name, sign, values = text.partition('=')
    if not (name and sign and values):
        raise argparse.ArgumentTypeError(f'must be NAME=V,V,…: got {text}')
    return name, [parsed_value(value) for value in values.split(',')]
