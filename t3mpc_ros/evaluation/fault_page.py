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
"""Outcomes of the fault study: lines, the tables of docs/faults.md, and an HTML page."""

from collections import Counter
from collections.abc import Sequence
import math
from pathlib import Path
from typing import Any

import numpy as np

from t3mpc_ros.evaluation import html_page, result_output
from t3mpc_ros.evaluation.experiment import Row
from t3mpc_ros.evaluation.fault_outcomes import ALLOWED, BEGIN, DURATION, ODOMETRY_WRONG
from t3mpc_ros.evaluation.figure_style import (
    COLOURS,
    drawing,
    file_of,
    legend_above,
    new_figure,
    scale_by_size,
)

BEGIN_MARK = '<!-- outcomes: written by `t3mpc faults`, do not edit by hand -->'
END_MARK = '<!-- end of outcomes -->'

TITLES = {
    'chaotic': 'Along the chaotic reference',
    'straight': 'Straight on at 0.2 m/s',
    'arc': 'Along an arc at 0.2 m/s',
}
TABLE_HEAD = (
    'fault',
    'outcome',
    'error of the wheels before, during, after (rad/s)',
    'odometry error before, at the end',
    'detected by robot or controller',
    'shown by ground truth only',
)
UNDETECTED = '**undetected by the robot**: '
UNREPORTED = '**no flag, no reason, and the counters advance**: '
_COLOURS = {'before': '#6b7280', 'during': COLOURS['error'], 'after': COLOURS['applied']}
_ENDINGS = {
    'bounded': 'stay within the limits and recover',
    'stops': 'stop the robot with a reason',
    'impaired': 'stay within the limits, but the error remains',
    'unbounded': 'exceed a limit',
}


def outcome_sentence(row: Row) -> str:
    """Return the outcome in words."""
    if row['verdict'] == 'unbounded':
        return f'unbounded: {row["reason"]}'
    if row['verdict'] == 'impaired':
        return 'within limits, but error not recovered'
    time = row['recovery_time']
    recovery = 'not recovered' if time is None else f'recovered after {time:g} s'
    recovery = 'error ' + ('recovered at once' if time == 0.0 else recovery)
    if row['verdict'] == 'bounded':
        return 'bounded' + ('' if row['after'] is None else f', {recovery}')
    text = f'stops: {_short(row["reason"])}'
    if row['resumption'] == 'by itself':
        return f'{text}, for {row["stopped_for"]:.1f} s; resumes by itself, {recovery}'
    return f'{text}, and remains stopped'


def hidden(row: Row) -> bool:
    """Return whether only ground truth shows an effect."""
    return bool(row['undetected'] and not row['detected'])


def table_row(row: Row) -> tuple[str, ...]:
    """Return the cells of a table."""
    after = result_output.EMPTY_CELL if row['after'] is None else f'{row["after"]:.2f}'
    undetected = ', '.join(row['undetected']) or result_output.EMPTY_CELL
    if hidden(row):
        undetected = (UNREPORTED if row['ranges'] else UNDETECTED) + undetected
    return (
        f'`{row["name"]}`',
        outcome_sentence(row),
        f'{row["before"]:.2f}, {row["during"]:.2f}, {after}',
        f'{_place(*row["odometry_before"])}; {_place(*row["odometry_after"])}',
        ', '.join(filter(None, [*row['detected'], row['ranges']])) or result_output.EMPTY_CELL,
        undetected,
    )


def by_course(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Return title and rows of each course that was driven."""
    found = [(title, [row for row in rows if row['course'] == course])
             for course, title in TITLES.items()]  # fmt: skip
    return [(title, chosen) for title, chosen in found if chosen]


def markdown_tables(rows: Sequence[Row]) -> str:
    """Return a table for each course, one row for each outcome."""
    tables = [
        (title, result_output.Table('', TABLE_HEAD, [*map(table_row, chosen)]))
        for title, chosen in by_course(rows)
    ]
    return '\n'.join(f'### {title}\n\n{table.markdown()}\n' for title, table in tables)


def console_text(rows: Sequence[Row]) -> str:
    """Return the outcomes for a terminal, one line each."""
    lines = []
    for title, chosen in by_course(rows):
        lines.append(f'{title}:')
        for row in chosen:
            note = ' (not detected by the robot)' if hidden(row) else ''
            lines.append(f'  {row["name"]:24} {outcome_sentence(row)}{note}')
    return '\n'.join(lines)


def page_section(rows: Sequence[Row]) -> str:
    """Return the section of the page between the marks."""
    return f"""

The controller drives the twin. Each fault begins at {BEGIN:g} s and lasts 5 s; `brown_out`
restarts the board, which takes 0.5 s. A run lasts {DURATION:g} s, one into a wall 25 s, of which
the robot needs 11 s to get there.

Errors are root mean squares over both wheels, of rotor speed against reference:
from 3 s on before the fault, during it, and from 2 s after it and the last stop to the end. The
error has *recovered* when the rest of the run is no worse than {ALLOWED:g} times the same run
without the fault.

Ground truth shows full steps lost by the right and the left motor at most, and how much
faster (root mean square) the wheels turn than they roll.

{markdown_tables(rows)}
"""


def update_page(page: Path, rows: Sequence[Row]) -> None:
    """Replace the section between the marks of a page."""
    result_output.replace_section(page, BEGIN_MARK, END_MARK, page_section(rows))


def _short(reason: str) -> str:
    parts = [part for part in reason.split('; ') if not part.startswith('stop commanding ')]
    return '; '.join(part.split(':')[0] for part in parts)


def _place(metres: float, angle: float) -> str:
    length = f'{100.0 * metres:.1f} cm' if metres < 1.0 else f'{metres:.2f} m'
    return f'{length}, {math.degrees(angle):.1f}°'


def page(rows: Sequence[Row]) -> str:
    """Return the page as self-contained HTML."""
    blocks: list[html_page.Block] = [_verdict(rows)]
    for number, (title, chosen) in enumerate(by_course(rows)):
        worst = max(chosen, key=lambda row: row['during'])
        seen = (
            f'{title}: error of the wheels before, during and after each fault; the largest '
            f'during one is {worst["during"]:.2f} rad/s, of {worst["name"]}.'
        )
        blocks.append(html_page.Heading(title))
        if figure := drawing(_draw_errors, chosen):
            blocks.append(html_page.Picture(seen, file_of(figure, 'svg'), seen))
        if number == 0:
            blocks.append(html_page.Contents())
        cells = [[cell.replace('`', '').replace('**', '') for cell in table_row(row)]
                 for row in chosen]  # fmt: skip
        blocks.append(result_output.Table('', TABLE_HEAD, cells, text=len(TABLE_HEAD), wrap=True))
    return html_page.html_page('Fault study of the closed loop', blocks)


def _verdict(rows: Sequence[Row]) -> html_page.VerdictBox:
    """Return how many faults end in which way."""
    count = Counter(row['verdict'] for row in rows)
    reasons = [f'{count[kind]} {text}.' for kind, text in _ENDINGS.items() if count[kind]]
    if names := sorted({row['name'] for row in rows if hidden(row)}):
        reasons.append(f'Not detected by robot or controller: {", ".join(names)}.')
    if count['unbounded']:
        beyond = '; '.join(map(_run_name, [row for row in rows if row['verdict'] == 'unbounded']))
        return html_page.VerdictBox(f'Not every fault stays bounded: {beyond}', reasons, 'bad')
    lost = [row for row in rows if ODOMETRY_WRONG in row['undetected']]
    if not lost:
        return html_page.VerdictBox('Every fault stays bounded', reasons, 'good')
    worst = max(lost, key=lambda row: row['odometry_after'][0])
    headline = (
        f'Every fault stays within the limits, but the odometry is wrong at the end of '
        f'{len(lost)} of {len(rows)} runs, by up to {_place(*worst["odometry_after"])} '
        f'({_run_name(worst)})'
    )
    return html_page.VerdictBox(headline, reasons, 'open')


def _run_name(row: Row) -> str:
    """Return fault and course of a run, as its table names them."""
    title = TITLES[row['course']]
    return f'{row["name"]}, {title[0].lower()}{title[1:]}'


def _draw_errors(rows: Sequence[Row]) -> Any:
    """Return a figure of the errors of each fault."""
    figure, axis = new_figure(0.9 + 0.19 * len(rows))
    places = np.arange(len(rows))[::-1]
    for name, colour in _COLOURS.items():
        known = [(row[name], place) for row, place in zip(rows, places, strict=True)
                 if row[name] is not None]  # fmt: skip
        if known:
            axis.plot(*zip(*known, strict=True), 'o', color=colour, markersize=4, label=name)
    scale_by_size(axis, 'x', [row[name] for row in rows for name in _COLOURS if row[name]])
    axis.margins(y=0.5 / len(rows))
    axis.set_yticks(places, [row['name'] for row in rows])
    axis.set_xlabel('error of the wheels / (rad/s)')
    legend_above(figure, axis)
    return figure
