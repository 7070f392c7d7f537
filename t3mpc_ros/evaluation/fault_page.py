# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""HTML page of the fault study."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.fault_study import TABLE_HEAD, TITLES, Outcome, table_row
from t3mpc_ros.evaluation.plotting import COLOURS, legend_above, new_figure, png_of
from t3mpc_ros.evaluation.reporting import (
    Block,
    Contents,
    Heading,
    Picture,
    Table,
    VerdictBox,
    html_page,
)

_COLOURS = {'before': '#6b7280', 'during': COLOURS['error'], 'after': COLOURS['applied']}


def page(results: Sequence[Outcome]) -> str:
    """Return the page as self-contained HTML."""
    blocks: list[Block] = [_verdict(results)]
    for course, title in TITLES.items():
        chosen = [result for result in results if result.course == course]
        picture = png_of(_draw_errors, chosen)
        if picture is None:
            continue
        what = f'{title}: error of the wheels before, during and after each fault'
        worst = max(chosen, key=lambda each: each.during)
        seen = f'{what}; the largest during one is {worst.during:.2f} rad/s, of {worst.name}.'
        rows = [[cell.replace('`', '').replace('**', '') for cell in table_row(r)] for r in chosen]
        blocks += [Heading(title), Picture(seen, picture, seen)]
        if len(blocks) == 3:
            blocks.append(Contents())
        blocks.append(Table('', TABLE_HEAD, rows, text=len(TABLE_HEAD), wrap=True))
    return html_page('Fault study of the closed loop', blocks)


def _verdict(results: Sequence[Outcome]) -> VerdictBox:
    """Return how many faults end in which way."""
    count = {
        kind: sum(each.verdict == kind for each in results)
        for kind in ('bounded', 'stops', 'impaired', 'unbounded')
    }
    hidden = [each.name for each in results if each.undetected and not each.detected]
    words = {
        'bounded': 'stay within the limits and recover',
        'stops': 'stop the robot with a reason',
        'impaired': 'stay within the limits, but the error remains',
        'unbounded': 'exceed a limit',
    }
    reasons = [f'{count[kind]} {text}.' for kind, text in words.items() if count[kind]]
    if hidden:
        reasons.append(f'Not detected by robot or controller: {", ".join(sorted(set(hidden)))}.')
    if count['unbounded']:
        return VerdictBox('Not every fault stays bounded', reasons, 'bad')
    return VerdictBox('Every fault stays bounded', reasons, 'good')


def _draw_errors(results: Sequence[Outcome]) -> Any:
    """Return a figure of the errors of each fault; None without a fault."""
    if not results:
        return None
    figure = new_figure(0.9 + 0.19 * len(results))
    axis = figure.subplots()
    places = np.arange(len(results))[::-1]
    for name, colour in _COLOURS.items():
        known = [
            (getattr(each, name), place)
            for each, place in zip(results, places, strict=True)
            if getattr(each, name) is not None
        ]
        if known:
            axis.plot(*zip(*known, strict=True), 'o', color=colour, markersize=4, label=name)
    axis.set_xscale('log')
    axis.set_yticks(places, [each.name for each in results])
    axis.set_xlabel('error of the wheels / (rad/s)')
    legend_above(figure, axis)
    return figure
