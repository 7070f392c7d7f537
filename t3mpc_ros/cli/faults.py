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
"""``t3mpc faults``: fault study of the closed loop."""

import argparse
from pathlib import Path

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli import shared_options


def add_parser(commands: shared_options.Commands) -> None:
    """Add the subcommand ``faults``."""
    parser = commands.add_parser(
        'faults', help='drive the digital twin under every named fault, and say what comes of it'
    )
    parser.add_argument(
        'names', nargs='*', metavar='FAULT', help='only these, brown_out say (default: all)'
    )
    parser.add_argument(
        '--output', type=Path, help='page whose table is to be replaced, docs/faults.md say'
    )
    shared_options.add_outputs(parser)
    shared_options.add_workers(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the outcome of each fault; return 0 when every loop stayed bounded, else 1."""
    from t3mpc_ros.evaluation import fault_outcomes
    from t3mpc_ros.evaluation.experiment import print_report
    from t3mpc_ros.evaluation.fault_outcomes import FAULT_RUNS, study_faults

    known = dict.fromkeys(fault_run.fault for fault_run in FAULT_RUNS)
    for name in options.names:
        if name not in known:
            raise ValueError(f'FAULT must be one of {", ".join(known)}: got {name}')
    if options.names and options.output:
        raise ValueError('--output replaces the whole table: give no FAULT with it')
    fault_runs = [
        fault_run
        for fault_run in FAULT_RUNS
        if not options.names or fault_run.fault in options.names
    ]
    with shared_options.executor_of(options) as executor:
        rows = study_faults(fault_runs, executor, print_report)
    shared_options.print_result(
        options, lambda: fault_outcomes.console_text(rows), lambda: list(rows)
    )
    if options.output:
        fault_outcomes.update_page(options.output, rows)
    if options.html:
        write_atomically(options.html, fault_outcomes.page(rows))
    return 1 if any(row['verdict'] == 'unbounded' for row in rows) else 0
