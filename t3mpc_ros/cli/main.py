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
"""``t3mpc``: the command-line program; a subcommand is in the module of its name.

``topic``, ``param``, ``call`` and ``stop`` share :mod:`~t3mpc_ros.cli.topic_param_call`;
``estimation`` and ``exponents`` are in :mod:`~t3mpc_ros.cli.paper`.
"""

import argparse
from collections.abc import Mapping, Sequence
from importlib import import_module
import sys
from typing import Any

from t3mpc_ros.cli.shared_options import ArgumentParser, reject_removed, run_command
from t3mpc_ros.missing_library import remedy

PROGRAMS = {
    'bag': 'inspect, report, animate, recover, replay, compare bags, and train from them',
    'robot': 'settings, key, log, link test, channel scan, wheel jog of the real robot',
    'emulator': 'emulated dongle and robot board behind a serial port',
}
"""Subcommands with their own parser, in the module of the same name."""
COMMANDS = (
    'paper', 'compare', 'sweep', 'patrol', 'tune', 'train', 'faults', 'view', 'topic_param_call',
    'compile',
)  # fmt: skip
"""Modules of the other subcommands, in the order of the help, after ``demo``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code: 0 done, 1 failed with a reason, 2 wrong command line."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _run(words)
    except ModuleNotFoundError as error:
        if not (problem := remedy(error)):
            raise
        print(f'error: {problem}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130


def _run(words: Sequence[str]) -> int:
    if words and words[0] in PROGRAMS:
        # Imported only when it is used: `t3mpc --help` stays fast.
        code: int = _program(words[0]).main(words[1:])
        return code
    parser = _parser()
    reject_removed(parser, ' '.join(['t3mpc', *words[:1]]))
    return run_command(parser, words)


def _complete(options: argparse.Namespace) -> None:
    """Print what a shell reads to complete commands and options."""
    import shtab

    parser = _parser({name: _program(name).program_parser() for name in PROGRAMS})
    print(shtab.complete(parser, options.shell))


def _program(name: str) -> Any:
    return import_module(f't3mpc_ros.cli.{name}')


def _parser(
    programs: Mapping[str, argparse.ArgumentParser] | None = None,
) -> argparse.ArgumentParser:
    """Return the parser of the command line; ``programs`` are those of :data:`PROGRAMS`."""
    parser: argparse.ArgumentParser = ArgumentParser(
        prog='t3mpc',
        description='Tools of t3mpc_ros; topic, param, call, stop, view and demo use a ROS graph.',
    )
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')

    _program('demo').add_parser(commands)
    for name, text in PROGRAMS.items():
        commands.add_parser(name, help=text, add_help=False)
        if programs:
            commands.choices[name] = programs[name]
    for name in COMMANDS:
        _program(name).add_parser(commands)
    completing = commands.add_parser(
        'completion', help='print what bash or zsh completes: eval "$(t3mpc completion bash)"'
    )
    completing.add_argument('shell', choices=('bash', 'zsh'))
    completing.set_defaults(run=_complete)
    return parser


if __name__ == '__main__':
    sys.exit(main())
