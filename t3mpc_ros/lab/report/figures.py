# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's figures, and a few more, drawn from a recorded run.

Each function returns a figure, or None when the run lacks what it shows.
"""

from typing import Any

from matplotlib.ticker import MaxNLocator
import numpy as np

from t3mpc_ros.lab.report.canvas import (
    COLOURS,
    LABELS,
    STRENGTH,
    add_legend,
    draw_line,
    every_nth,
    is_long,
    name_time,
    new_figure,
    new_panels,
    over_time,
    thinned,
)
from t3mpc_ros.lab.report.measures import (
    driven,
    estimation_target,
    latencies,
    path_of,
    statistics,
    tracking_error,
)
from t3mpc_ros.lab.report.merit import UNMEASURED
from t3mpc_ros.lab.report.recorded import Run, Series
from t3mpc_ros.lab.report.topics import COMMAND, ODOMETRY, REFERENCE, SIGNALS, TERMS, TRUTH, WHEELS


def tracking(run: Run) -> Any:
    """Return the reference and the speed of both channels over time, the paper's Fig. 11."""
    reference = run.motions.get(REFERENCE)
    shown = _motions(run, ODOMETRY, TRUTH)
    if not is_long(reference) or not shown:
        return None
    figure, axes = new_panels(2, 2.1)
    for axis, (wheel, title, _, unit) in zip(axes, run.channels, strict=True):
        for name, motion in shown.items():
            draw_line(axis, motion, wheel, COLOURS[name], LABELS[name])
        draw_line(axis, reference, wheel, COLOURS[REFERENCE], LABELS[REFERENCE], width=0.8)
        axis.set_title(title)
        axis.set_ylabel(f'speed / {unit}')
    return over_time(figure, axes, run)


def error(run: Run) -> Any:
    """Return the tracking error of both channels over time."""
    series = tracking_error(run, run.measured)
    if not is_long(series):
        return None
    figure, axes = new_panels(2, 1.8)
    moving = driven(series.time, run)
    for axis, (wheel, title, _, unit) in zip(axes, run.channels, strict=True):
        draw_line(axis, series, wheel, COLOURS['error'], 'speed minus reference')
        rmse = statistics(series[wheel][moving]).rmse
        size = f'{rmse:.3g} {unit} while driven' if moving.any() else UNMEASURED
        axis.set_title(f'{title}, RMSE {size}')
        axis.set_ylabel(f'error / {unit}')
    return over_time(figure, axes, run)


def switching(run: Run) -> Any:
    """Return which mode and which chaotic signals drive the wheels, the paper's Fig. 10."""
    shown = {name: run.numbers[name] for name in SIGNALS if name in run.numbers}
    if not shown:
        return None
    titles = {
        SIGNALS[0]: 'active mode',
        SIGNALS[1]: 'chaotic signal that drives the right wheel',
        SIGNALS[2]: 'chaotic signal that drives the left wheel',
    }
    figure, axes = new_panels(len(shown), 1.15)
    for axis, (name, series) in zip(axes, shown.items(), strict=True):
        end = max(run.duration, float(series.time[-1]))
        value = np.append(series['value'], series['value'][-1])
        time = np.append(series.time, end)
        axis.step(time, value, where='post', color=COLOURS['switch'], linewidth=1.6)
        axis.set_title(titles[name])
        axis.set_ylabel('number')
        axis.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axis.margins(y=0.2)
    name_time(axes)
    return figure


def control(run: Run) -> Any:
    """Return commanded wheel speeds and applied accelerations, the paper's Fig. 12."""
    command = run.motions.get(COMMAND)
    if not is_long(command):
        return None
    applied = {w: series for w in WHEELS if is_long(series := _term(run, 'applied', w))}
    figure, axes = new_panels(len(WHEELS) + len(applied), 1.5)
    for axis, (wheel, title, _, unit) in zip(axes, run.channels, strict=False):
        draw_line(axis, command, wheel, COLOURS[COMMAND], 'command')
        axis.set_title(f'commanded: {title}')
        axis.set_ylabel(unit)
    for axis, (wheel, series) in zip(axes[len(WHEELS) :], applied.items(), strict=True):
        draw_line(axis, series, 'value', COLOURS['applied'])
        axis.set_title(f'acceleration u applied to the {wheel} wheel')
        axis.set_ylabel('rad/s²')
    return over_time(figure, axes, run)


def terms(run: Run) -> Any:
    """Return what each term adds to the control, (66)-(67)."""
    names = [n for n in (*TERMS, 'applied') if any(is_long(_term(run, n, w)) for w in WHEELS)]
    if not names:
        return None
    symbols = ('$-g$', r'$-K\delta$', r'$\dot r$', '$v_c$', '$v_p$', '$u$')
    symbol = dict(zip((*TERMS, 'applied'), symbols, strict=True))
    figure, axes = new_panels(len(names), 1.15)
    for axis, name in zip(axes, names, strict=True):
        for wheel in WHEELS:
            if is_long(series := _term(run, name, wheel)):
                colour, strength = COLOURS[name], STRENGTH[wheel]
                label = f'{wheel} wheel'
                draw_line(axis, series, 'value', colour, label, strength=strength)
        axis.set_title(f'{name}, {symbol[name]}')
        axis.set_ylabel('rad/s²')
    return over_time(figure, axes, run)


def estimates(run: Run) -> Any:
    """Return the estimates of the unknown dynamics and their targets, the paper's Fig. 13."""
    shown = {
        wheel: series
        for wheel in WHEELS
        if is_long(series := run.numbers.get(f'controller/estimate/{wheel}'))
    }
    if not shown:
        return None
    figure, axes = new_panels(len(shown), 2.0)
    for axis, (wheel, series) in zip(axes, shown.items(), strict=True):
        target = estimation_target(run, wheel)
        if target is not None:
            draw_line(axis, target, 'value', COLOURS['target'], 'target')
        draw_line(axis, series, 'value', COLOURS['estimate'], 'estimate g')
        axis.set_title(f'{wheel} wheel')
        axis.set_ylabel('rad/s²')
    return over_time(figure, axes, run)


def portrait(run: Run) -> Any:
    """Return one channel against the other, wanted and driven, the paper's Figs. 9 and 14."""
    shown = _motions(run, REFERENCE, run.measured)
    if len(shown) < 2:
        return None
    figure = new_figure(3.9)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis, (name, motion) in zip(axes, shown.items(), strict=True):
        right, left = (motion[each.name] for each in run.channels)
        if name == REFERENCE:  # a jump is no line in the portrait
            jumps = np.flatnonzero(np.isin(motion.time, run.switches))
            right, left = np.insert(right, jumps, np.nan), np.insert(left, jumps, np.nan)
        axis.plot(every_nth(left), every_nth(right), color=COLOURS[name], linewidth=0.8)
        axis.set_title(LABELS[name])
        axis.set_xlabel(f'{run.channels[1].title} / {run.channels[1].unit}')
    axes[0].set_ylabel(f'{run.channels[0].title} / {run.channels[0].unit}')
    return figure


def path(run: Run) -> Any:
    """Return the paths in the plane: driven, and of a robot that had followed exactly."""
    shown = _motions(run, ODOMETRY, TRUTH)
    if not shown:
        return None
    figure = new_figure(5.4)
    axis = figure.subplots()
    driven = run.motions[run.measured]
    reference = run.motions.get(REFERENCE)
    if is_long(reference):
        first = min(int(np.searchsorted(driven.time, reference.time[0])), len(driven) - 1)
        start = (driven['x'][first], driven['y'][first], driven['heading'][first])
        x, y = path_of(reference, start)
        style = {'color': COLOURS[REFERENCE], 'linewidth': 0.8, 'label': LABELS[REFERENCE]}
        axis.plot(every_nth(x), every_nth(y), **style)
    for name, motion in shown.items():
        width = 2.6 if name == ODOMETRY else 1.1  # seen on both sides where they coincide
        x, y = every_nth(motion['x']), every_nth(motion['y'])
        axis.plot(x, y, color=COLOURS[name], lw=width, label=LABELS[name])
    axis.plot(driven['x'][0], driven['y'][0], 'o', color=COLOURS[REFERENCE], label='start')
    axis.set_aspect('equal', adjustable='datalim')
    axis.set_xlabel('x / m')
    axis.set_ylabel('y / m')
    add_legend(axis)
    return figure


def certificate(run: Run) -> Any:
    """Return the run-time certificate, (83) with E14, and the predictor's skill."""
    value, margin = (run.numbers.get(f'controller/lyapunov/{n}') for n in ('value', 'margin'))
    skill = {
        w: series for w in WHEELS if is_long(series := run.numbers.get(f'controller/skill/{w}'))
    }
    count = is_long(value) + is_long(margin) + bool(skill)
    if not count:
        return None
    figure, axes = new_panels(count, 1.5)
    free = iter(axes)
    if is_long(value):
        axis = next(free)
        draw_line(axis, value, 'value', COLOURS['value'])
        axis.set_title('V, half the squared error')
        axis.set_ylabel('rad²/s²')
    if is_long(margin):
        axis = next(free)
        draw_line(axis, margin, 'value', COLOURS['margin'])
        axis.axhline(0.0, color='#6b7280', linewidth=0.8)
        below = 100.0 * float(np.mean(margin['value'] < 0.0))
        axis.set_title(f'margin of the promised decrease, below zero {below:.1f} % of the time')
        axis.set_ylabel('rad²/s³')
    if skill:
        axis = next(free)
        for wheel, series in skill.items():
            colour, strength = COLOURS['skill'], STRENGTH[wheel]
            draw_line(axis, series, 'value', colour, f'{wheel} wheel', strength=strength)
        axis.set_title('skill of the predictor')
        axis.set_ylabel('share')
        add_legend(axis)
    return over_time(figure, axes, run)


def timing(run: Run) -> Any:
    """Return how long the loop took, and how regularly odometry and commands came."""
    delay = latencies(run)
    if not is_long(delay):
        return None
    figure, axes = new_panels(3, 1.5)
    middle, high = (1e3 * np.percentile(delay['value'], share) for share in (50.0, 99.0))
    title = f'odometry to command, median {middle:.2f} ms, 99 % below {high:.2f} ms'
    rows = [(delay.time, delay['value'], title, 'latency')]
    for name in (ODOMETRY, COMMAND):
        received = run.receipts[name]
        rows.append((received[1:], np.diff(received), f'between two messages of {name}', name))
    for axis, (time, gap, title, quantity) in zip(axes, rows, strict=True):
        few, some = thinned(time, gap)
        axis.plot(few, 1e3 * some, '.', color=COLOURS[quantity], markersize=2)
        axis.set_title(title)
        axis.set_ylabel('ms')
        axis.set_ylim(0.0, 1.1e3 * max(float(gap.max()), 1e-6))
    name_time(axes, 'time of receipt')
    return figure


def _motions(run: Run, *names: str) -> dict[str, Series]:
    return {name: motion for name in names if is_long(motion := run.motions.get(name))}


def _term(run: Run, name: str, wheel: str) -> Series | None:
    return run.numbers.get(f'controller/terms/{name}/{wheel}')
