# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc faults``: fault study of the closed loop."""

import argparse
from dataclasses import asdict
from pathlib import Path


def add_outcomes_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
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
    parser.add_argument('--html', type=Path, help='write one page to this file')
    parser.add_argument('--json', type=Path, help='also write the numbers to this file')
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the outcome of each fault; return 0 when every loop stayed bounded, else 1."""
    from t3mpc_ros.evaluation import fault_page
    from t3mpc_ros.evaluation.fault_study import (
        FAULT_RUNS,
        console_text,
        study_faults,
        update_page,
    )
    from t3mpc_ros.evaluation.reporting import strict_json

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
    results = study_faults(fault_runs, progress=True)
    print(console_text(results))
    if options.output:
        update_page(options.output, results)
    if options.html:
        options.html.write_text(fault_page.page(results), encoding='utf-8')
    if options.json:
        text = strict_json([asdict(one) for one in results])
        options.json.write_text(text, encoding='utf-8')
    return 1 if any(one.verdict == 'unbounded' for one in results) else 0
