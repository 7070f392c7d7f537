# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag``: what can be done with a recording without a ROS graph, as a command-line program."""

import argparse
from collections.abc import Sequence
import sys
import time

from t3mpc_ros.lab.bag.compare import add_compare_parser
from t3mpc_ros.lab.bag.info import add_info_parser
from t3mpc_ros.lab.bag.recover import add_recover_parser
from t3mpc_ros.lab.bag.report import add_report_parser
from t3mpc_ros.lab.bag.rerun import add_rerun_parser
from t3mpc_ros.lab.bag.train import add_train_parser
from t3mpc_ros.lab.commands import carry_out


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code: 0 done, 1 failed with a reason, 2 wrong command line.

    3 is the command's own: done, but not all is well with the bag.
    """
    return carry_out(_parser(), arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='bag', description=__doc__)
    commands = parser.add_subparsers(dest='command', required=True)
    add_info_parser(commands)
    add_recover_parser(commands, time.monotonic)
    add_report_parser(commands)
    add_rerun_parser(commands)
    add_compare_parser(commands)
    add_train_parser(commands)
    return parser


if __name__ == '__main__':
    sys.exit(main())
