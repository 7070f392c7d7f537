# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of how a robot answers its commands; None when the run lacks what they show."""

from typing import Any

import numpy as np

from t3mpc_ros.lab.report.canvas import (
    COLOURS,
    LABELS,
    add_legend,
    draw_line,
    is_long,
    name_time,
    new_panels,
    over_time,
    thinned,
)
from t3mpc_ros.lab.report.recorded import Run, Series
from t3mpc_ros.lab.report.response.measures import busiest, fit_response, predicted, smooth
from t3mpc_ros.lab.report.topics import COMMAND

DETAIL = 4.0
"""Seconds of the stretch that is shown closely: the one in which the command varies most."""


def response(run: Run) -> Any:
    """Return command and measured speed of both channels, and closely what the fit expects."""
    command, motion = run.motions.get(COMMAND), run.motions.get(run.measured)
    if not is_long(command) or not is_long(motion):
        return None
    figure, axes = new_panels(4, 1.6, shared=False)
    shown = {LABELS[run.measured]: (motion, run.measured), 'command': (command, COMMAND)}
    fitted = False
    for row, (name, title, _, unit) in enumerate(run.channels):
        axis, close = axes[2 * row : 2 * row + 2]
        axis.set_title(title)
        close.set_title(f'{title}, closely')
        start, end = busiest(command, motion, name, DETAIL)
        for label, (series, key) in shown.items():
            draw_line(axis, series, name, COLOURS[key], label, width=0.9)
            low, high = np.searchsorted(series.time, [start, end]).tolist()
            part = slice(max(low - 1, 0), high + 1)
            held = 'steps-post' if key == COMMAND else 'default'
            style = {'color': COLOURS[key], 'linewidth': 1.0, 'drawstyle': held}
            close.plot(series.time[part], series[name][part], label=label, **style)
        fit = fit_response(command, motion, name)
        if fit is not None and fit.clear:
            time = np.arange(max(start - 10.0, command.time[0]), end, 0.005)
            value = predicted(fit, command, name, time)
            near = time >= start
            style = {'color': COLOURS['fit'], 'linewidth': 1.0, 'linestyle': (0, (4, 2))}
            close.plot(time[near], value[near], **style)
            close.set_title(
                f'{title}, closely: dead time {1e3 * fit.dead_time:.0f} ms, '
                f'lag {1e3 * fit.lag:.0f} ms, gain {fit.gain:.3g}'
            )
            axes[0].plot([], [], label=None if fitted else 'fit', **style)
            fitted = True
        for each in (axis, close):
            name_time([each])
            each.set_ylabel(unit)
        close.set_xlim(start, end)
    for axis in axes[:3]:
        axis.set_xlabel('')
    add_legend(axes[0])
    return figure


def acceleration(run: Run) -> Any:
    """Return how hard the measured speeds change, and their change in turn."""
    motion = run.motions.get(run.measured)
    if not is_long(motion):
        return None
    found = [(each, *_changes(motion, each.name)) for each in run.channels]
    if not any(np.isfinite(rate).any() for _, _, rate, _ in found):
        return None
    figure, axes = new_panels(4, 1.3)
    for row, (each, time, rate, bend) in enumerate(found):
        for axis, values, what, power in (
            (axes[2 * row], rate, 'acceleration', '²'),
            (axes[2 * row + 1], bend, 'jerk', '³'),
        ):
            axis.plot(*thinned(time, values), color=COLOURS[run.measured], linewidth=0.9)
            axis.set_title(f'{each.title}: {what}')
            axis.set_ylabel(f'{each.unit}{power}')
    return over_time(figure, axes, run)


def _changes(motion: Series, name: str) -> tuple[Any, Any, Any]:
    time, _, rate, bend = smooth(motion, name)
    return time, rate, bend
