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
"""Options that several commands share: robot, seeds, noise, who computes, topics of a bag."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from t3mpc_ros.parameters.command_line import bounded_float, bounded_int

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.topic_roles import ReportOptions

ROBOTS = ('twin', 'servo', 'torque')
FULL, NOMINAL = 'full', 'nominal'
STANDARD_OUTPUT = Path('-')


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
    from t3mpc_ros.evaluation.api.script_parts import loaded

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
    from t3mpc_ros.evaluation.reporting import strict_json

    if options.json == STANDARD_OUTPUT:
        print(strict_json(record()), end='')
        return
    print(text())
    if options.json:
        options.json.write_text(strict_json(record()), encoding='utf-8')


def add_outputs(parser: argparse.ArgumentParser, json: str = 'also write the numbers') -> None:
    """Add the files for the numbers and for the page of a study."""
    add_json(parser, json)
    parser.add_argument('--html', type=Path, help='write one page to this file')


def prepare_outputs(options: argparse.Namespace, *further: Path | None) -> None:
    """Make the folders of the files: one that cannot be made is an error before the runs."""
    for path in (options.json, getattr(options, 'html', None), *further):
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)


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
    from t3mpc_ros.evaluation.api.dask_workers import cluster

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


def uncounted_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of ``A-B``, where a number alone was their number in earlier versions."""
    if text.isdecimal() and int(text):
        raise argparse.ArgumentTypeError(
            f'must be A-B, as in 1-{text}, or {text}-{text} for one; a number alone was how many '
            f'in earlier versions: got {text}'
        )
    return seed_range(text)
