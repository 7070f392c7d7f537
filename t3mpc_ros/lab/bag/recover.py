# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag recover``: a whole bag from one that broke off or was damaged."""

import argparse
from collections.abc import Callable
from pathlib import Path
import sys

from t3mpc_ros.lab.bag.columns import columns, size_text
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.record.recovery.bag import OutputError, default_output, recover
from t3mpc_ros.record.recovery.outcome import Damage, FileOutcome, Recovery

LOSS = 3
"""Exit code: a bag was written, but something was lost or may have been."""

USAGE = 2
"""Exit code: the output folder that was asked for cannot be written into."""

_MOST = 20  # damaged stretches of a file that are named one by one


def add_recover_parser(
    commands: 'argparse._SubParsersAction[argparse.ArgumentParser]', clock: Callable[[], float]
) -> None:
    """Add ``recover`` to the commands of ``bag``.

    ``clock`` tells seconds from any origin, for the time that is left.
    """
    parser = commands.add_parser(
        'recover',
        help='write what a damaged bag still holds into a new one',
        description='Writes what an MCAP file, or every MCAP file of a folder, still holds into '
        'a new folder, with index and metadata.yaml, and says what was kept and lost. The input '
        'is only read. Exit code 0: nothing was lost; 3: something was, or a file has no end, so '
        'that its writer may have held more; 1: nothing can be read, or the output cannot be '
        'written.',
    )
    parser.add_argument('bag', type=Path, metavar='FILE', help='an MCAP file, or a folder of such')
    parser.add_argument(
        '--output', type=Path, help='new or empty folder (default: FILE_recovered beside FILE)'
    )
    parser.set_defaults(run=_run, clock=clock)


def _run(options: argparse.Namespace) -> int:
    output = options.output or default_output(options.bag)
    try:
        result = recover(options.bag, output, _Progress(options.clock))
    except OutputError as error:
        print(f'error: {error}', file=sys.stderr)
        return USAGE
    print(_page(result))
    return 0 if result.clean else LOSS


def _page(result: Recovery) -> str:
    least = '' if result.exact else '>= '
    rows = [('topic', 'type', 'kept', 'unchecked', 'lost')]
    for topic in result.topics.values():
        lost = f'{least}{topic.lost}' if topic.lost else ('0' if result.exact else '?')
        rows.append((topic.name, topic.type_name, str(topic.kept), str(topic.unchecked), lost))
    parts = [columns(rows, right=(2, 3, 4))]
    parts += [_file(file) for file in result.files]
    if any(topic.unchecked for topic in result.topics.values()):
        parts.append('unchecked: no checksum of the file vouches for these messages')
    parts.append(_verdict(result, least))
    return '\n\n'.join(parts)


def _file(file: FileOutcome) -> str:
    if file.copied:
        return f'{file.name}: sound, copied'
    lines = [f'{file.name}: written anew']
    lines += [f'  {note}' for note in file.notes]
    lines += [f'  {_damage(damage)}' for damage in file.damages[:_MOST]]
    if len(file.damages) > _MOST:
        lines.append(f'  and {len(file.damages) - _MOST} more')
    return '\n'.join(lines)


def _damage(damage: Damage) -> str:
    where = f'bytes {damage.start} to {damage.end}: ' if damage.size else ''
    text = where + damage.reason
    if damage.harmless:
        return f'{text} (nothing is lost with it)'
    if damage.messages:
        text += f'; {damage.messages} messages lost'
    if damage.span_ns:
        text += f'; within {(damage.span_ns[1] - damage.span_ns[0]) / NANOSECONDS:.3f} s'
    return text


def _verdict(result: Recovery, least: str) -> str:
    kept = f'{result.kept} messages are kept in {result.output}'
    if result.clean:
        return f'{kept}; nothing is lost'
    seconds = result.lost_seconds
    during = '' if seconds is None else f', within {seconds:.3f} s'
    number = f'{least}{result.lost}' if result.lost or result.exact else 'nobody knows how many'
    return (
        f'{kept}; lost: {number} messages{during}, '
        f'{size_text(result.lost_bytes)} of the input not usable'
    )


class _Progress:
    """Says on stderr how far a large file is, about once a second."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._name = ''
        self._start = self._next = 0.0

    def __call__(self, name: str, done: int, size: int) -> None:
        now = self._clock()
        if name != self._name or done == 0:
            self._name, self._start, self._next = name, now, now + 1.0
        if now < self._next or not done:
            return
        self._next = now + 1.0
        left = (now - self._start) * (size - done) / done
        text = f'{name}: {100.0 * done / size:.0f} % of {size_text(size)}, {left:.0f} s left'
        print(text, file=sys.stderr, flush=True)
