# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Run one subcommand and turn errors into exit codes."""

import argparse
from collections.abc import Sequence
import sys


def run_command(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    """Return the exit code of the command that was asked for: its own, or 1 with a reason.

    A wrong command line ends the program with 2, Ctrl-C gives 130.

    Parameters
    ----------
    parser
        Each of its commands has set ``run``, which takes the options and returns the exit code.
    arguments
        The words of the command line; None for those of the process.
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
