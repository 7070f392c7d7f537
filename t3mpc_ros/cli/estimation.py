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
"""``t3mpc estimation``: compares the kinds of fuzzy systems as estimators (86)."""

import argparse

from t3mpc_ros.cli.shared_options import SECONDS, Commands, add_json, add_seeds, print_result
from t3mpc_ros.parameters.command_line import bounded_float


def add_parser(commands: Commands) -> None:
    """Add the subcommand ``estimation``."""
    parser = commands.add_parser(
        'estimation', help='the kinds of fuzzy systems as estimators, without a controller (86)'
    )
    add_seeds(parser, '1-5', 'the runs', counted=True)
    parser.add_argument('--duration', type=SECONDS, default=60.0, help='seconds (default 60)')
    text = 'normalised gain of all kinds, 1/s² (default 40)'
    parser.add_argument('--gain', type=bounded_float(0.0, 1e6, '1/s²'), default=40.0, help=text)
    add_json(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the table of the kinds."""
    from t3mpc_ros.evaluation.fuzzy_estimation_error import compare, records
    from t3mpc_ros.evaluation.paper.paper_tables import estimation

    results = compare(
        seeds=options.seeds, duration=options.duration, normalised_gain=options.gain, progress=True
    )
    print_result(
        options,
        lambda: '\n\n'.join(table.markdown() for table in estimation(results)),
        lambda: records(results),
    )
