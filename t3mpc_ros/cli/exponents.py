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
"""``t3mpc exponents``: the Lyapunov exponents of the generator."""

import argparse

from t3mpc_ros.cli.shared_options import SECONDS, Commands, add_json, print_result


def add_parser(commands: Commands) -> None:
    """Add the subcommand ``exponents``."""
    parser = commands.add_parser('exponents', help='Lyapunov exponents of the generator')
    parser.add_argument(
        '--duration', type=SECONDS, default=200.0, help='system seconds (default 200)'
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
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
