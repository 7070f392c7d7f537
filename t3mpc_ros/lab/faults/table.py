# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The outcomes of faults as text: for a console, and for ``docs/faults.md``."""

from collections.abc import Sequence
import math
from pathlib import Path

from t3mpc_ros.lab.faults.outcomes import DURATION, PAUSE
from t3mpc_ros.lab.faults.verdict import ALLOWED, BEGIN, Outcome

BEGIN_MARK = '<!-- outcomes: written by `lab faults`, do not edit by hand -->'
END_MARK = '<!-- end of outcomes -->'

TITLES = {
    'chaotic': 'Along the chaotic reference',
    'straight': 'Straight on at 0.2 m/s',
    'arc': 'Along an arc at 0.2 m/s',
}
HEAD = (
    '| fault | outcome | error of the wheels before, during, after (rad/s) '
    '| odometry off the truth before, at the end | what the robot can know '
    '| what only the truth shows |\n'
    '|---|---|---|---|---|---|\n'
)
UNSEEN = '**not seen by the robot, only ground truth shows it**: '
UNHEEDED = '**no flag and no reason, the counters go on**: '


def sentence(outcome: Outcome) -> str:
    """Return what became of a trial in words."""
    back = (
        'error not back' if outcome.back is None else f'error back after {outcome.back:g} s'
        if outcome.back > 0.0 else 'error back at once'
    )  # fmt: skip
    if outcome.verdict == 'unbounded':
        return f'unbounded: {outcome.reason}'
    if outcome.verdict == 'impaired':
        return 'within limits, but error not back'
    if outcome.verdict == 'bounded':
        return 'bounded' + ('' if outcome.after is None else f', {back}')
    text = f'stops: {_short(outcome.reason)}'
    if outcome.goes_on == 'by itself':
        return f'{text}, for {outcome.stood:.1f} s; goes on by itself, {back}'
    if outcome.goes_on == 'after a pause':
        return f'{text}, until commands pause; then goes on, {back}'
    return f'{text}, and stays so'


def row(outcome: Outcome) -> str:
    """Return the line of a Markdown table."""
    after = '–' if outcome.after is None else f'{outcome.after:.2f}'
    before_m, before_rad = outcome.odometry_before
    after_m, after_rad = outcome.odometry_after
    unseen = ', '.join(outcome.unseen) or '–'
    if outcome.unseen and not outcome.noticed:
        unseen = (UNHEEDED if outcome.ranges else UNSEEN) + unseen
    known = [*outcome.noticed, outcome.ranges] if outcome.ranges else outcome.noticed
    cells = (
        f'`{outcome.name}`',
        sentence(outcome),
        f'{outcome.before:.2f}, {outcome.during:.2f}, {after}',
        f'{_length(before_m)}, {_degrees(before_rad)}; {_length(after_m)}, {_degrees(after_rad)}',
        ', '.join(known) or '–',
        unseen,
    )
    return '| ' + ' | '.join(cells) + ' |\n'


def markdown(results: Sequence[Outcome]) -> str:
    """Return a table for each course, one row for each outcome."""
    parts = []
    for course, title in TITLES.items():
        rows = [row(result) for result in results if result.course == course]
        if rows:
            parts.append(f'### {title}\n\n{HEAD}{"".join(rows)}')
    return '\n'.join(parts)


def console(results: Sequence[Outcome]) -> str:
    """Return the same for a terminal, a line for each outcome."""
    lines = []
    for course, title in TITLES.items():
        chosen = [result for result in results if result.course == course]
        lines += [f'{title}:'] if chosen else []
        for result in chosen:
            hidden = ' (not noticed by the robot)' if result.unseen and not result.noticed else ''
            lines.append(f'  {result.name:24} {sentence(result)}{hidden}')
    return '\n'.join(lines)


def section(results: Sequence[Outcome]) -> str:
    """Return what stands in the page between the marks, these included."""
    after, pause = PAUSE
    return f"""{BEGIN_MARK}

The controller drives the twin. Each fault comes at {BEGIN:g} s and lasts 5 s; `brown_out` restarts
the board, which is then away for 0.5 s. A run lasts {DURATION:g} s, one into a wall 25 s, of which
the robot needs 11 s to get there.

Errors are root mean squares over both wheels, of the speed of the rotors against what was wanted:
from 3 s on before the fault, during it, and from 2 s after it to the end. The error is *back* when
the rest of the run is no worse than {ALLOWED:g} times the same run without the fault. Where the
robot stands until commands pause, a person pauses the controller for {pause:g} s, {after:g} s
after the fault: the error after it is then that after the pause, the odometry that of a robot
left alone.

What only the truth shows: full steps lost by the right and the left motor at most, and how much
faster (root mean square) the wheels turn than the floor goes by.

{markdown(results)}
{END_MARK}
"""


def rewrite(page: Path, results: Sequence[Outcome]) -> None:
    """Replace what stands between the marks of a page.

    Raises
    ------
    ValueError
        The page does not have both marks, once and in this order.
    """
    text = page.read_text(encoding='utf-8')
    head, begun, rest = text.partition(BEGIN_MARK)
    _, ended, tail = rest.partition(END_MARK)
    if not begun or not ended or BEGIN_MARK in rest or END_MARK in tail:
        raise ValueError(
            f'{page} must hold the lines {BEGIN_MARK} and {END_MARK} once, in this order'
        )
    page.write_text(head + section(results).rstrip('\n') + tail, encoding='utf-8')


def _short(reason: str) -> str:
    return '; '.join(
        part.split(':')[0] for part in reason.split('; ') if 'command ' not in part[:8]
    )


def _length(metres: float) -> str:
    return f'{100.0 * metres:.1f} cm' if metres < 1.0 else f'{metres:.2f} m'


def _degrees(angle: float) -> str:
    return f'{math.degrees(angle):.1f}°'
