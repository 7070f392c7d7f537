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
"""What the commands share: parser, exit codes, questions, and options of several of them."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
import os
from pathlib import Path
import select
import signal
import sys
from typing import TYPE_CHECKING, Any, TypeAlias

from t3mpc_ros.atomic_file import check_new_folder, write_atomically
from t3mpc_ros.evaluation.api.one_sentence_errors import sentence
from t3mpc_ros.parameters.command_line import bounded_float, bounded_int, check_writable
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.version import VERSION

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.topic_roles import ReportOptions

Commands: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'
"""Subcommands of a parser."""
ROBOTS = ('twin', 'servo', 'torque')
FULL, NOMINAL = 'full', 'nominal'
STANDARD_OUTPUT = Path('-')
SECONDS = bounded_float(1.0, 86_400.0, 'seconds')
"""Type of a duration."""


def add_setting(parser: argparse.ArgumentParser) -> None:
    """Add robot, reference, noise and duration of the runs."""
    add = parser.add_argument
    text = (
        'twin: the stepper robot, ground truth of its body included (default); servo, '
        "torque: the paper's plant with that drive; or your own Robot, OdePlant or StateSpace"
    )
    add('--robot', default='twin', metavar='twin|servo|torque|FILE.py:NAME', help=text)
    text = (
        'columns time,right,left (s, rad/s) or time,linear,angular (s, m/s, rad/s) in place '
        'of the chaotic reference'
    )
    add('--reference', type=Path, metavar='CSV', help=text)
    text = 'variance of the measured wheel speeds, (rad/s)² (default 0.04)'
    add('--noise', type=bounded_float(0.0, 100.0, '(rad/s)²'), default=0.04, help=text)
    text = 'of each run, s (default 60)'
    add('--duration', type=bounded_float(2.0, 3600.0, 's'), default=60.0, help=text)


def add_seeds(
    parser: argparse.ArgumentParser,
    default: str,
    of: str,
    *,
    name: str = '--seeds',
    counted: bool = False,
    text: str = '',
) -> None:
    """Add the seeds ``A-B``; the help says what they are the seeds ``of``.

    ``counted``: their number was asked for once, so that one number alone is an error; ``text``
    says in the help which ones are the default.
    """
    parser.add_argument(
        name,
        type=uncounted_seeds if counted else seed_range,
        default=None if text else seed_range(default),
        metavar='A-B',
        help=f'seeds of {of} (default {text or default})',
    )


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add who computes: processes here, or the workers of a cluster."""
    parser.add_argument(
        '--workers',
        type=bounded_int(1, 10_000),
        default=max(1, len(os.sched_getaffinity(0))),
        help='processes (default: processors)',
    )
    parser.add_argument(
        '--scheduler',
        metavar='ADDRESS',
        help='compute on the workers of this Dask scheduler, tcp://HOST:8786, in place of '
        'processes here',
    )


def setting_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return what :func:`add_setting` added, as arguments of a function of the interface."""
    from t3mpc_ros.evaluation.api.script_inputs import loaded

    return {
        'plant': options.robot if options.robot in ROBOTS else loaded(options.robot),
        'reference': options.reference,
        'noise': options.noise,
        'duration': options.duration,
    }


def add_json(
    parser: argparse.ArgumentParser, text: str = 'also write the numbers', **how: Any
) -> None:
    """Add ``--json FILE|-``, see :func:`print_result`; the help says what is written."""
    text += ' to FILE as JSON, or with - to the standard output in place of the text'
    parser.add_argument('--json', type=Path, metavar='FILE|-', help=text, **how)


def print_result(
    options: argparse.Namespace, text: Callable[[], str], record: Callable[[], object]
) -> None:
    """Print a result as text, and write it to the file of ``--json``; ``-``: print only JSON."""
    from t3mpc_ros.evaluation.result_output import strict_json

    if options.json == STANDARD_OUTPUT:
        print(strict_json(record()), end='')
        return
    print(text())
    if options.json:
        write_atomically(options.json, strict_json(record()))


def add_outputs(parser: argparse.ArgumentParser, json: str = 'also write the numbers') -> None:
    """Add the files for the numbers and for the page of a study."""
    add_json(parser, json)
    parser.add_argument('--html', type=Path, help='write one page to this file')


def prepare_outputs(options: argparse.Namespace) -> None:
    """Make the folders of the files: one that cannot be written is an error before the work."""
    for path in (getattr(options, name, None) for name in ('json', 'html', 'csv')):
        if path and path != STANDARD_OUTPUT:
            prepare_file(path)


def prepare_file(path: Path) -> None:
    """Make the folder of a file; ParameterError if the file cannot be written."""
    with suppress(OSError):  # the check says so
        path.parent.mkdir(parents=True, exist_ok=True)
    check_writable(path)


def add_topic_options(parser: argparse._ActionsContainer) -> None:
    """Add which topics of a bag are whose, and the wheel geometry that it may lack."""
    add = parser.add_argument
    add('--namespace', help='whose topics (default: those of most known topics)')
    add('--odom', default='', metavar='TOPIC', help='odometry')
    add('--cmd-vel', default='', metavar='TOPIC', help='commands')
    text = 'radius of the wheels in m (default: as recorded)'
    add('--wheel-radius', type=float, metavar='M', help=text)
    add('--track', type=float, metavar='M', help='distance between the wheels in m, likewise')


def report_options(options: argparse.Namespace) -> 'ReportOptions':
    """Return what :func:`add_topic_options` added, and the ``--reference`` of a report."""
    from t3mpc_ros.evaluation.topic_roles import ReportOptions

    if (options.wheel_radius is None) != (options.track is None):
        raise ValueError('--wheel-radius and --track must be given together')
    names = {item.name for item in fields(ReportOptions)}
    return ReportOptions(**{name: value for name, value in vars(options).items() if name in names})


@contextmanager
def executor_of(options: argparse.Namespace) -> Iterator[Any]:
    """Enter who computes: the workers of ``--scheduler``, or the number of ``--workers``."""
    if not options.scheduler:
        yield options.workers
        return
    from t3mpc_ros.evaluation.api.parameter_sweep import cluster

    with cluster(options.scheduler) as executor:
        yield executor


def seed_range(text: str) -> tuple[int, ...]:
    """Return the seeds of ``A-B``, both included, or of ``A``; an argparse type."""
    first, dash, last = text.partition('-')
    try:
        low = int(first)
        high = int(last) if dash else low
    except ValueError:
        raise argparse.ArgumentTypeError(f'must be A-B, as in 201-206: got {text}') from None
    if not 0 <= low <= high or high - low >= 10_000:
        raise argparse.ArgumentTypeError(
            f'must be A-B with 0 <= A <= B and at most 10000 seeds: got {text}'
        )
    return tuple(range(low, high + 1))


def new_folder(text: str) -> Path:
    """Return the path of a folder that exists or can be made."""
    if not text:
        raise argparse.ArgumentTypeError("must name a folder, . for this one: got ''")
    try:
        check_new_folder(path := Path(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return path


def uncounted_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of ``A-B``, where a number alone was their number in earlier versions."""
    if text.isdecimal() and int(text):
        raise argparse.ArgumentTypeError(
            f'must be A-B, as in 1-{text}, or {text}-{text} for one; a number alone was how many '
            f'in earlier versions: got {text}'
        )
    return seed_range(text)


# -- parser, exit codes and questions -------------------------------------------------------------


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
        prepare_outputs(options)
        code = int(options.run(options) or 0)
        sys.stdout.flush()
        return code
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, BrokenPipeError) and _reader_has_ended():
            return 128 + signal.SIGPIPE
        print(f'error: {sentence(error)}', file=sys.stderr)
        return 1


def _reader_has_ended() -> bool:
    """Return whether nobody reads the standard output, as after ``| head``; then discard it."""
    asked = select.poll()
    asked.register(sys.stdout.fileno(), 0)
    ended = any(event & select.POLLERR for _, event in asked.poll(0))
    if ended:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return ended


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
