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
"""Parser, exit codes and questions of the program and its subcommands."""

import argparse
from collections.abc import Callable, Sequence
import os
import select
import sys
from typing import Any

from t3mpc_ros.evaluation.api.error_messages import sentence
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.version import VERSION


class ArgumentParser(argparse.ArgumentParser):
    """A parser with ``--version``, which its subcommands have, too."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        if self.add_help:  # a subcommand without help leaves its arguments to another parser
            version = f't3mpc_ros {VERSION}'
            self.add_argument(
                '--version', action='version', version=version, help='show the version and exit'
            )


REMOVED = {
    't3mpc twin': 'examples/digital_twin.py draws the twin, test/simulation checks it',
    't3mpc bag replay --method': 'examples/recorded_reference.py compares methods in closed loop '
    'on the reference of a bag, with t3.compare',
    't3mpc bag compare --update-golden': 'PYTHONPATH=. .venv/bin/python '
    'test/support/golden_bags.py records the golden bags anew, in a checkout',
}
"""Successors of the commands and options that were removed."""


def reject_removed(parser: argparse.ArgumentParser, typed: str) -> None:
    """End with an error if ``typed`` is a key of :data:`REMOVED`."""
    if typed in REMOVED:
        parser.error(f'{typed} was removed: {REMOVED[typed]}')


class RemovedOption(argparse.Action):
    """An option of :data:`REMOVED`."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        """End with the error."""
        reject_removed(parser, f'{parser.prog} {option_string}')


def run_command(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    """Return the exit code of the chosen subcommand: its own, or 1 after an error.

    A wrong command line ends the program with 2. Each subcommand sets ``run``, which takes the
    options and returns the exit code, or nothing for 0.
    """
    options = parser.parse_args(arguments)
    try:
        return int(options.run(options) or 0)
    except (OSError, RuntimeError, ValueError) as error:
        print(f'error: {sentence(error)}', file=sys.stderr)
        return 1


def ask_line(question: str, stop: Callable[[], bool]) -> str:
    """Show a question; return the line that answers it, '' at the end of the input or a stop."""
    print(question, end='', flush=True)
    while not stop():
        # readline alone would continue after Ctrl-C.
        ready, _, _ = select.select([sys.stdin], [], [], 0.1)
        if ready:
            return sys.stdin.readline()
    return ''


def check_two_ports(dongle: str, robot: str) -> None:
    """Raise ParameterError if both ports are one device."""
    if os.path.realpath(dongle) == os.path.realpath(robot):
        raise ParameterError(
            f'--port is that of the dongle, --robot-port that of the robot board: got {dongle} '
            f'and {robot}, one device; ls -l /dev/serial/by-id lists both'
        )
