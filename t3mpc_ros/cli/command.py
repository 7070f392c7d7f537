# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs a subcommand and converts errors into exit codes."""

import argparse
from collections.abc import Sequence
import sys


def run_command(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    """Return the exit code of the chosen subcommand: its own, or 1 after an error.

    A wrong command line ends the program with 2, Ctrl-C gives 130.

    Parameters
    ----------
    parser
        Each subcommand sets ``run``, which takes the options and returns the exit code.
    arguments
        Command-line words; None for those of the process.
    """
    options = parser.parse_args(arguments)
    try:
        code: int = options.run(options)
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130
    except (OSError, RuntimeError, ValueError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    return code
