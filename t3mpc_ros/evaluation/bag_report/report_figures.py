# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Figures of the bag report in page order."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from matplotlib.ticker import MaxNLocator
import numpy as np

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import WHEELS
from t3mpc_ros.evaluation.bag_report.metrics import (
    UNMEASURED,
    WINDOW,
    driven,
    estimation_target,
    latencies,
    path_of,
    statistics,
    tracking_error,
)
from t3mpc_ros.evaluation.bag_report.response import busiest, fit_response, predicted, smooth
from t3mpc_ros.evaluation.bag_report.run_data import Run, Series
from t3mpc_ros.evaluation.bag_report.topic_roles import (
    COMMAND,
    ODOMETRY,
    REFERENCE,
    SIGNALS,
    TRUTH,
)
from t3mpc_ros.evaluation.plotting import (
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

DETAIL = 4.0
"""Length (s) of the zoomed window: where the command varies most."""


def response(run: Run) -> Any:
    """Return command and measured speed of both channels, with a zoom and the fit."""
    command, motion = run.motions.get(COMMAND), run.motions.get(run.measured)
    if not is_long(command) or not is_long(motion):
        return None
    figure, axes = new_panels(4, 1.6, shared=False)
    shown = {LABELS[run.measured]: (motion, run.measured), 'command': (command, COMMAND)}
    fitted = False
    for row, (name, title, _, unit) in enumerate(run.channels):
        axis, close = axes[2 * row : 2 * row + 2]
        axis.set_title(title)
        close.set_title(f'{title}, zoom')
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
    """Return acceleration and jerk of the measured speeds."""
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
            axis.set(title=f'{each.title}: {what}', ylabel=f'{each.unit}{power}')
    return over_time(figure, axes, run)


def _changes(motion: Series, name: str) -> tuple[Any, Any, Any]:
    time, _, rate, bend = smooth(motion, name)
    return time, rate, bend


COUNTED = {
    'robot_resets': 'resets of the robot board',
    'dongle_resets': 'resets of the dongle',
    'port_failures': 'port failures',
    'crc_errors': 'wrong checksums',
    'frame_errors': 'malformed frames',
}
_DASHES: tuple[Any, ...] = ('-', '--', ':', '-.', (0, (1, 3)))


def link(run: Run) -> Any:
    """Return answered cycles, round trips and counters of faults; None without a link."""
    if not run.links or run.links[0].time.size < 2:
        return None
    shown = run.links[0]
    values, answered = shown.values, shown.answered()
    reported = bool(np.isfinite(answered).any())
    trips = [key for key in ('round_trip_median_ms', 'round_trip_p99_ms') if key in values]
    counted = [key for key in COUNTED if np.isfinite(values.get(key, np.nan)).any()]
    if not (reported or trips or counted):
        return None
    figure, axes = new_panels(reported + bool(trips) + bool(counted), 1.5)
    free = iter(axes)
    if reported:
        axis = next(free)
        style = {'color': COLOURS['answered'], 'linewidth': 1.1, 'drawstyle': 'steps-pre'}
        axis.plot(shown.time, 100.0 * answered, **style)
        axis.set(title=f'{shown.name}: cycles answered since the report before', ylabel='%')
        axis.set_ylim(min(90.0, 100.0 * float(np.nanmin(answered)) - 2.0), 101.0)
    if trips:
        axis = next(free)
        for key, strength in zip(trips, (1.0, 0.5), strict=False):
            label = 'median' if 'median' in key else '99 % below'
            style = {'color': COLOURS['round trip'], 'alpha': strength, 'linewidth': 1.1}
            axis.plot(shown.time, values[key], label=label, **style)
        axis.set(title='round trip', ylabel='ms')
        axis.set_ylim(bottom=0.0)
        add_legend(axis)
    if counted:
        axis = next(free)
        for key, dash in zip(counted, _DASHES, strict=False):
            since = values[key] - values[key][np.isfinite(values[key])][0]
            style = {'color': COLOURS['resets'], 'linewidth': 1.1, 'linestyle': dash}
            axis.step(shown.time, since, where='post', label=COUNTED[key], **style)
        axis.set(title='faults since the first report', ylabel='number')
        axis.set_ylim(-0.05, max(1.0, 1.6 * axis.get_ylim()[1]))
        axis.legend(loc='upper left', ncols=3)
    name_time(axes)
    return figure


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
        axis.set(title=title, ylabel=f'speed / {unit}')
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
        axis.set(title=f'{title}, RMSE {size}', ylabel=f'error / {unit}')
    return over_time(figure, axes, run)


def switching(run: Run) -> Any:
    """Return the active mode and the chaotic signals of the wheels, the paper's Fig. 10."""
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
        axis.set(title=titles[name], ylabel='number')
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
        axis.set(title=f'commanded: {title}', ylabel=unit)
    for axis, (wheel, series) in zip(axes[len(WHEELS) :], applied.items(), strict=True):
        draw_line(axis, series, 'value', COLOURS['applied'])
        axis.set(title=f'acceleration u applied to the {wheel} wheel', ylabel='rad/s²')
    return over_time(figure, axes, run)


def terms(run: Run) -> Any:
    """Return each term of the control law, (66)-(67)."""
    names = [n for n in (*TERM_NAMES, 'applied') if any(is_long(_term(run, n, w)) for w in WHEELS)]
    if not names:
        return None
    symbols = ('$-g$', r'$-K\delta$', r'$\dot r$', '$v_c$', '$v_p$', '$u$')
    symbol = dict(zip((*TERM_NAMES, 'applied'), symbols, strict=True))
    figure, axes = new_panels(len(names), 1.15)
    for axis, name in zip(axes, names, strict=True):
        for wheel in WHEELS:
            if is_long(series := _term(run, name, wheel)):
                colour, strength = COLOURS[name], STRENGTH[wheel]
                label = f'{wheel} wheel'
                draw_line(axis, series, 'value', colour, label, strength=strength)
        axis.set(title=f'{name}, {symbol[name]}', ylabel='rad/s²')
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
        axis.set(title=f'{wheel} wheel', ylabel='rad/s²')
    return over_time(figure, axes, run)


def portrait(run: Run) -> Any:
    """Return one channel over the other, reference and measured, the paper's Figs. 9 and 14."""
    shown = _motions(run, REFERENCE, run.measured)
    if len(shown) < 2:
        return None
    figure = new_figure(3.9)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis, (name, motion) in zip(axes, shown.items(), strict=True):
        right, left = (motion[each.name] for each in run.channels)
        if name == REFERENCE:  # a jump is not drawn as a line
            jumps = np.flatnonzero(np.isin(motion.time, run.switches))
            right, left = np.insert(right, jumps, np.nan), np.insert(left, jumps, np.nan)
        axis.plot(every_nth(left), every_nth(right), color=COLOURS[name], linewidth=0.8)
        axis.set(title=LABELS[name], xlabel=f'{run.channels[1].title} / {run.channels[1].unit}')
    axes[0].set_ylabel(f'{run.channels[0].title} / {run.channels[0].unit}')
    return figure


def path(run: Run) -> Any:
    """Return the paths in the plane: measured, and integrated from the reference."""
    shown = _motions(run, ODOMETRY, TRUTH)
    if not shown:
        return None
    figure = new_figure(5.4)
    axis = figure.subplots()
    driven = run.motions[run.measured]
    reference = run.motions.get(REFERENCE)
    if is_long(reference):
        first = min(int(np.searchsorted(driven.time, reference.time[0])), len(driven) - 1)
        start = (driven['x'][first], driven['y'][first], driven['yaw'][first])
        x, y = path_of(reference, start)
        style = {'color': COLOURS[REFERENCE], 'linewidth': 0.8, 'label': LABELS[REFERENCE]}
        axis.plot(every_nth(x), every_nth(y), **style)
    for name, motion in shown.items():
        width = 2.6 if name == ODOMETRY else 1.1  # visible on both sides where they coincide
        x, y = every_nth(motion['x']), every_nth(motion['y'])
        axis.plot(x, y, color=COLOURS[name], lw=width, label=LABELS[name])
    axis.plot(driven['x'][0], driven['y'][0], 'o', color=COLOURS[REFERENCE], label='start')
    axis.set_aspect('equal', adjustable='datalim')
    axis.set(xlabel='x / m', ylabel='y / m')
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
        axis.set(title='V, half the squared error', ylabel='rad²/s²')
    if is_long(margin):
        axis = next(free)
        draw_line(axis, margin, 'value', COLOURS['margin'])
        axis.axhline(0.0, color='#6b7280', linewidth=0.8)
        below = 100.0 * float(np.mean(margin['value'] < 0.0))
        axis.set_title(f'margin of the guaranteed decrease, below zero {below:.1f} % of the time')
        axis.set_ylabel('rad²/s³')
    if skill:
        axis = next(free)
        for wheel, series in skill.items():
            colour, strength = COLOURS['skill'], STRENGTH[wheel]
            draw_line(axis, series, 'value', colour, f'{wheel} wheel', strength=strength)
        axis.set(title='skill of the predictor', ylabel='share')
        add_legend(axis)
    return over_time(figure, axes, run)


def timing(run: Run) -> Any:
    """Return the loop latency and the regularity of odometry and commands."""
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
        axis.set(title=title, ylabel='ms')
        axis.set_ylim(0.0, 1.1e3 * max(float(gap.max()), 1e-6))
    name_time(axes, 'receive time')
    return figure


def _motions(run: Run, *names: str) -> dict[str, Series]:
    return {name: motion for name in names if is_long(motion := run.motions.get(name))}


def _term(run: Run, name: str, wheel: str) -> Series | None:
    return run.numbers.get(f'controller/terms/{name}/{wheel}')


LINK = 'diagnostics of a radio link'


@dataclass(frozen=True)
class ReportFigure:
    """A figure with title and caption."""

    stem: str
    title: str
    caption: str
    draw: Callable[[Run], Any]
    needs: tuple[str, ...]
    """Relative names of the topics it needs."""


REPORT_FIGURES = (
    ReportFigure(
        'tracking',
        'Speeds and their references (Fig. 11)',
        'Wheel speeds are computed from the body twists by (1). Dashed lines are switches.',
        tracking,
        (REFERENCE, ODOMETRY, TRUTH),
    ),
    ReportFigure(
        'error',
        'Tracking error over time',
        'Speed minus reference at the stamps of the measurement, over the whole recording; the '
        'metrics count only the time in which the robot was driven.',
        error,
        (REFERENCE, ODOMETRY, TRUTH),
    ),
    ReportFigure(
        'switching',
        'Switching modes and chaotic signals (Fig. 10)',
        'As published by the reference node, at the time for which it is valid.',
        switching,
        ('reference/signals', *SIGNALS),
    ),
    ReportFigure(
        'control',
        'Commands (Fig. 12)',
        'The command is published as a body twist; u is the acceleration after all limits.',
        control,
        (COMMAND, *(f'controller/terms/applied/{wheel}' for wheel in WHEELS)),
    ),
    ReportFigure(
        'response',
        'Response of the robot to its commands',
        'The fit is the command with a dead time, a first-order lag and a gain that together '
        'explain most of the measured speed. Commands are placed by receive time, odometry by '
        'its stamps, so the delay is the one observed at the recorder.',
        response,
        (COMMAND, ODOMETRY),
    ),
    ReportFigure(
        'acceleration',
        'Acceleration and jerk',
        'Derivatives of the measured speeds, of parabolas fitted to short windows.',
        acceleration,
        (ODOMETRY, TRUTH),
    ),
    ReportFigure(
        'terms',
        'Terms of the control law (Fig. 12)',
        'The terms of (66)-(67) with E12, and the applied acceleration.',
        terms,
        tuple(f'controller/terms/{name}/{w}' for name in (*TERM_NAMES, 'applied') for w in WHEELS),
    ),
    ReportFigure(
        'estimates',
        'Estimates of the unknown dynamics and their targets (Fig. 13)',
        'The target is the measured acceleration of the wheel minus the applied one, both '
        f'smoothed over {WINDOW:g} s by a local straight line; it is undefined at switches, where '
        'the applied one jumps between two of its samples.',
        estimates,
        tuple(f'controller/estimate/{wheel}' for wheel in WHEELS),
    ),
    ReportFigure(
        'portrait',
        'Phase portrait, one speed against the other (Figs. 9 and 14)',
        'Both panels have the same axes.',
        portrait,
        (REFERENCE, ODOMETRY, TRUTH),
    ),
    ReportFigure(
        'path',
        'Path in the plane',
        'The reference is integrated from the initial pose of the robot. Speeds are tracked, not '
        'positions, so the paths diverge.',
        path,
        (ODOMETRY, TRUTH),
    ),
    ReportFigure(
        'certificate',
        'Run-time certificate and skill of the predictor',
        'The margin is the largest rate of V by E14 minus its actual rate: it is negative when '
        'the disturbance is larger than assumed, or just after a jump of the reference. '
        'Skill is 1 for perfect prediction and 0 for no better than persistence.',
        certificate,
        (
            'controller/lyapunov/value',
            'controller/lyapunov/margin',
            *(f'controller/skill/{wheel}' for wheel in WHEELS),
        ),
    ),
    ReportFigure(
        'link',
        'The radio link',
        'From the diagnostics of the bridge. A cycle is a command with a request for telemetry; '
        'it is answered when a measurement is received. Round trips are over the last '
        '500 cycles.',
        link,
        (LINK,),
    ),
    ReportFigure(
        'timing',
        'Punctuality of the loop',
        'By receive times at the recorder.',
        timing,
        (ODOMETRY, COMMAND),
    ),
)
"""In the order of the report."""
PACKAGE_FIGURES = (
    'tracking',
    'error',
    'switching',
    'terms',
    'estimates',
    'portrait',
    'certificate',
)
"""Stems of the figures that need topics of this package's nodes."""
