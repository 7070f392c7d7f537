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
"""Charts of the bag report in page order, each with a sentence on what is seen in it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import WHEELS
from t3mpc_ros.evaluation.bag_report import tracking_errors
from t3mpc_ros.evaluation.bag_report.diagnostic_history import COUNTED
from t3mpc_ros.evaluation.bag_report.metrics import (
    UNMEASURED,
    WINDOW,
    ReportMetrics,
    estimation_target,
    latencies,
    path_of,
)
from t3mpc_ros.evaluation.bag_report.motion_continuity import gaps, pose_jumps
from t3mpc_ros.evaluation.bag_report.patrol_section import followed_reference
from t3mpc_ros.evaluation.bag_report.recorded_run import SIGNAL_NAMES, Run, Series
from t3mpc_ros.evaluation.drive_response import ResponseFit, busiest, predicted
from t3mpc_ros.evaluation.html_page import Chart, Curve, Line, LineStyle, Plane, thinned
from t3mpc_ros.evaluation.result_output import format_number
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.simulation.world import world_outline

Shown = Iterator[Chart | Plane]

LABELS = {
    TRUTH: 'robot (ground truth)',
    ODOMETRY: 'robot (odometry)',
    REFERENCE: 'reference',
    COMMAND: 'command',
}
COLOURS = {TRUTH: 'truth', ODOMETRY: 'odometry', REFERENCE: 'reference', COMMAND: 'command'}
"""Variables of the style sheet by motion, the same in every chart."""
DASHES = {REFERENCE: (6, 4), COMMAND: (2, 3)}
TERM_COLOURS = ('fuzzy', 'feedback', 'feedforward', 'compensator', 'predictive', 'ink')
TERM_DASHES = ((), (6, 3), (2, 3), (8, 3, 2, 3), (1, 4), (4, 2))
WHEEL_DASHES: Mapping[str, tuple[int, ...]] = {'right': (), 'left': (6, 3)}
DETAIL = 4.0
"""Time in which the fitted response is shown, s: where the command varies most."""


def line(
    label: str, colour: str, series: Series, name: str = 'value', *, style: LineStyle = 'line',
    dash: tuple[int, ...] = (), scale: float = 1.0,
) -> Line:  # fmt: skip
    """Return one quantity of a series, interrupted at its gaps."""
    time, value = thinned(series.time, scale * series[name])
    middles = np.array([0.5 * (low + high) for low, high in gaps(series.time)])
    rows = np.searchsorted(time, middles)
    time, value = np.insert(time, rows, middles), np.insert(value, rows, np.nan)
    return Line(label, colour, time, value, dash, style)


def is_long(series: Series | None) -> TypeGuard[Series]:
    """Return whether there is more than one point."""
    return series is not None and len(series) > 1


def _extent(values: Array, unit: str) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return 'unknown'
    return f'from {format_number(known.min())} to {format_number(known.max())} {unit}'


def tracking(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the reference and the speed of both channels over time, the paper's Fig. 11."""
    reference, measured = run.motions.get(REFERENCE), _motions(run, ODOMETRY, TRUTH)
    if not is_long(reference) or not measured:
        return
    for name, title, _, unit in run.channels:
        lines = [line(LABELS[k], COLOURS[k], each, name) for k, each in measured.items()]
        dash = DASHES[REFERENCE]
        lines.append(line(LABELS[REFERENCE], COLOURS[REFERENCE], reference, name, dash=dash))
        settled = metrics.wheels[name].settled
        follows = (
            f'the {LABELS[run.measured]} follows it with a settled RMSE of '
            f'{format_number(settled.rmse)} {unit}'
            if settled.count
            else f'the settled error is {UNMEASURED}'
        )
        if run.follows_path:
            follows = 'the robot follows its poses'
        seen = f'The reference runs {_extent(reference[name], unit)}; {follows}.'
        yield Chart(title, unit, lines, seen)


def distance(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the distance from the path over time, of a robot that follows one."""
    series = tracking_errors.path_distance(run)
    if not is_long(series):
        return
    row = int(np.argmax(series['value']))
    seen = (
        f'Root mean square {format_number(1e3 * metrics.path_error)} mm, 99 % below '
        f'{format_number(1e3 * metrics.path_error_99)} mm; the largest distance is '
        f'{format_number(1e3 * float(series["value"][row]))} mm at {series.time[row]:.1f} s.'
    )
    if sets := tracking_errors.odometry_sets(run):
        more = f' and {len(sets) - 5} more' if len(sets) > 5 else ''
        times = ', '.join(f'{time:.1f}' for time in sets[:5])
        seen += (
            f' {ODOMETRY} was set at {times} s{more}: from there on the path is in its new frame.'
        )
    lines = [line('distance', 'c1', series, scale=1e3)]
    yield Chart('Distance from the path', 'mm', lines, seen)


def error(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the tracking error of both channels over time, of a robot that follows speeds."""
    known = run.motion is not None and not run.follows_path
    series = tracking_errors.tracking_error(run, run.measured) if known else None
    if not is_long(series):
        return
    moving, calm = tracking_errors.counted(series.time, run)
    lines, seen = [], []
    for wheel, (name, title, _, unit) in zip(WHEELS, run.channels, strict=True):
        found, text = metrics.wheels[name], UNMEASURED
        if moving.any():
            size = np.where(moving & np.isfinite(series[name]), np.abs(series[name]), -1.0)
            row = int(np.argmax(size))
            text = (
                f'RMSE {format_number(found.overall.rmse)} {unit} while driven, '
                f'{format_number(found.settled.rmse)} {unit} while driven and settled; the '
                f'largest error is {format_number(size[row])} {unit} at {series.time[row]:.1f} s'
            )
        lines.append(line(title, wheel, series, name, dash=WHEEL_DASHES[wheel]))
        seen.append(f'{title.capitalize()}: {text}.')
    if run.channels[0].unit == run.channels[1].unit:
        names = [each.name for each in run.channels]
        extent = extent_of(series, calm, names)
        yield Chart('Error', run.channels[0].unit, lines, ' '.join(seen), extent)
        return
    for each, channel, text in zip(lines, run.channels, seen, strict=True):
        extent = extent_of(series, calm, [channel.name])
        yield Chart(f'Error, {channel.title}', channel.unit, [each], text, extent)


def extent_of(
    series: Series, rows: NDArray[np.bool_], names: Sequence[str]
) -> tuple[float, float] | None:
    """Return the least and the largest value of some rows, a little wider; None without one."""
    values = np.concatenate([series[name][rows] for name in names])
    values = values[np.isfinite(values)]
    if not values.size or not np.ptp(values) > 0.0:
        return None
    edge = 0.05 * float(np.ptp(values))
    return float(values.min()) - edge, float(values.max()) + edge


def switching(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the active mode and the chaotic signals of the wheels, the paper's Fig. 10."""
    lines = []
    looks = (
        ('active mode', 'c4', ()), ('right wheel', 'right', (6, 3)), ('left wheel', 'left', (2, 3))
    )  # fmt: skip
    for name, (title, colour, dash) in zip(SIGNAL_NAMES, looks, strict=True):
        if series := run.numbers.get(name):
            time = np.append(series.time, max(run.duration, float(series.time[-1])))
            value = np.append(series['value'], series['value'][-1])  # to the end of the run
            lines.append(Line(title, colour, time, value, dash, 'steps'))
    if lines:
        count = run.switches.size
        times = ', '.join(f'{each:.1f}' for each in run.switches[:8])
        seen = f'The reference switches {count} times' + (f', at {times} s' if count else '')
        yield Chart('Active mode and chaotic signals', 'number', lines, f'{seen}.')


def control(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield commanded speeds and applied accelerations, the paper's Fig. 12."""
    command = run.motions.get(COMMAND)
    if not is_long(command):
        return
    for name, title, _, unit in run.channels:
        shown = line('command', COLOURS[COMMAND], command, name, style='steps')
        found = metrics.wheels[name]
        seen = (
            f'The command runs {_extent(command[name], unit)} and varies by '
            f'{format_number(found.chatter)} {unit} per second'
        )
        if np.isfinite(found.demand):
            seen += f'; the reference varies by {format_number(found.demand)}'
        yield Chart(f'Command, {title}', unit, [shown], f'{seen}.')
    if applied := _by_wheel(run, 'terms/applied'):
        lines = _wheel_lines(applied)
        values = np.concatenate([series['value'] for series in applied.values()])
        seen = f'The acceleration u after all limits is {_extent(values, "rad/s²")}.'
        yield Chart('Acceleration u applied', 'rad/s²', lines, seen)


def response(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield command and measured speed of both channels with the fit."""
    command, motion = run.motions.get(COMMAND), run.motion
    if not is_long(command) or not is_long(motion):
        return
    for name, title, _, unit in run.channels:
        lines = [
            line(LABELS[run.measured], COLOURS[run.measured], motion, name),
            line('command', COLOURS[COMMAND], command, name, style='steps', dash=DASHES[COMMAND]),
        ]
        fit = metrics.responses.get(name)
        seen = 'No clear response of the speed to the command was found.'
        if fit is not None and fit.explains and not fit.determined:
            seen = undetermined(fit)
        if fit is not None and fit.clear:
            start, end = busiest(command, motion, name, DETAIL)
            time = np.arange(max(start - 10.0, command.time[0]), end, 0.005)
            value, near = predicted(fit, command, name, time), time >= start
            lines.append(Line('fit', 'c4', time[near], value[near], (4, 2)))
            seen = (
                f'The robot responds {1e3 * fit.delay:.0f} ms late: dead time '
                f'{1e3 * fit.dead_time:.0f} ms, lag {1e3 * fit.lag:.0f} ms, gain {fit.gain:.3g}. '
                f'The fit is drawn from {start:.1f} to {end:.1f} s, where the command varies most.'
            )
        yield Chart(f'Response, {title}', unit, lines, seen)


def undetermined(fit: ResponseFit) -> str:
    """Return that the data do not determine the delay of a fit, as a sentence."""
    return (
        'The data do not determine the delay of the robot: each from '
        f'{1e3 * fit.shortest:.0f} to {1e3 * fit.longest:.0f} ms explains the speed as well, so '
        'none is shown. A longer run with faster changes of the command determines it.'
    )


def terms(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the terms of the control law, (66)-(67), by wheel."""
    names = (*TERM_NAMES, 'applied')
    symbols = ('−g', '−Kδ', 'ṙ', 'v_c', 'v_p', 'u')
    for wheel in WHEELS:
        lines, sizes = [], []
        for name, symbol, colour, dash in zip(
            names, symbols, TERM_COLOURS, TERM_DASHES, strict=True
        ):
            if series := _by_wheel(run, f'terms/{name}').get(wheel):
                lines.append(line(f'{name} {symbol}', colour, series, dash=dash))
                size = float(np.sqrt(np.nanmean(series['value'] ** 2)))
                sizes.append(f'{name} {format_number(size)}')
        if lines:
            seen = f'Root mean squares: {", ".join(sizes)} rad/s².'
            yield Chart(f'Terms, {wheel} wheel', 'rad/s²', lines, seen)


def estimates(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the estimates of the unknown dynamics and their targets, the paper's Fig. 13."""
    for wheel, series in _by_wheel(run, 'estimate').items():
        lines = []
        seen = f'The estimate runs {_extent(series["value"], "rad/s²")}'
        target = estimation_target(run, wheel)
        if target is not None:
            lines.append(line('target', 'reference', target))
            apart = target['value'] - np.interp(target.time, series.time, series['value'])
            if np.isfinite(apart).any():
                rmse = float(np.sqrt(np.nanmean(apart**2)))
                seen += f'; its RMSE against the target is {format_number(rmse)} rad/s²'
        lines.append(line('estimate g', 'c4', series))
        yield Chart(f'Estimate, {wheel} wheel', 'rad/s²', lines, f'{seen}.')


def portrait(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield one channel over the other, reference and measured, the paper's Figs. 9 and 14."""
    shown = _motions(run, REFERENCE, run.measured)
    if len(shown) < 2:
        return
    curves = []
    for name, motion in shown.items():
        right, left = (motion[each.name] for each in run.channels)
        breaks = np.flatnonzero(np.isin(motion.time, run.switches)) if name == REFERENCE else ()
        curves.append(_curve(name, motion, left, right, breaks))
    upwards, rightwards = (each.title for each in run.channels)
    units = ' and '.join(dict.fromkeys(each.unit for each in run.channels))
    seen = (
        f'The {upwards} upwards over the {rightwards}; the closer the curves, the better the '
        'tracking.'
    )
    yield Plane(f'{upwards.capitalize()} over {rightwards}', units, curves, seen)


def path(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the paths on the floor: measured, and integrated from the reference."""
    shown = _motions(run, ODOMETRY, TRUTH)
    if not shown:
        return
    curves = []
    for name, motion in shown.items():
        x, y = _on_floor(run) if name == ODOMETRY else (motion['x'], motion['y'])
        positions = np.stack([x, y], axis=1)
        breaks = [row for row, _ in pose_jumps(motion.time, positions, motion['linear'])]
        curves.append(_curve(name, motion, x, y, breaks))
    measured = curves[-1]
    reference = run.motions.get(REFERENCE)
    if is_long(reference):
        curves.insert(0, _curve(REFERENCE, reference, *_reference_path(run, reference)))
    slips = metrics.incidents.slips
    if slips:
        among = [(start <= measured.time) & (measured.time <= end) for start, end in slips]
        slipping = np.any(among, axis=0)
        x, y = (np.where(slipping, each, np.nan) for each in (measured.x, measured.y))
        curves.append(Curve('a wheel slips', 'slip', measured.time, x, y))
    stops = [start for start, kind, _ in metrics.incidents.events() if kind == 'stop']
    marks = _path_marks(run, measured, stops)
    seen = _path_summary(run, measured, slips, stops)
    yield Plane('Floor', 'm', curves, seen, world_outline(run.world), marks)


def _reference_path(run: Run, reference: Series) -> tuple[Array, Array]:
    """Return the poses that the robot follows, or the speeds integrated from where it is first."""
    if followed_reference(run) is not None:
        return reference['x'], reference['y']
    base = run.motions[run.measured]
    first = min(int(np.searchsorted(base.time, reference.time[0])), len(base) - 1)
    return path_of(reference, (base['x'][first], base['y'][first], base['yaw'][first]))


def _path_marks(
    run: Run, measured: Curve, stops: Sequence[float]
) -> list[tuple[float, float, float, str]]:
    """Return time, x, y and colour of the switches, the stops and what contradicts the map."""
    marks = []
    for times, colour in ((run.switches, 'switch'), (np.array(stops), 'stopped')):
        rows = np.searchsorted(measured.time, times[:200])
        rows = rows[rows < measured.time.size]
        columns = np.stack([measured.time, measured.x, measured.y], axis=1)[rows]
        marks += [(*mark, colour) for mark in columns[np.isfinite(columns).all(axis=1)].tolist()]
    return marks + [(each.found, each.x, each.y, 'fault') for each in run.map_changes]


def _path_summary(
    run: Run, measured: Curve, slips: Sequence[tuple[float, float]], stops: Sequence[float]
) -> str:
    """Return what is seen of the paths, in sentences."""
    x, y = measured.x[np.isfinite(measured.x)], measured.y[np.isfinite(measured.y)]
    seen = (
        f'The robot moved in x {_extent(x, "m")} and in y {_extent(y, "m")}, and ended '
        f'{format_number(float(np.hypot(x[-1] - x[0], y[-1] - y[0])))} m from its start.'
    )
    if run.motion is None:
        seen = f'Nothing measured from {run.topics[run.measured]} is valid.'
    if slips:
        seen += f' A wheel slips for {sum(end - start for start, end in slips):.1f} s.'
    found = {
        'switches': run.switches,
        'stops': stops,
        'what contradicts the map': run.map_changes,
    }
    if named := [name for name, each in found.items() if len(each)]:
        seen += f' Points: {" and ".join(named)}.'
    return seen


def _curve(
    name: str, motion: Series, x: Array, y: Array, breaks: Sequence[int] | NDArray[np.int64] = ()
) -> Curve:
    """Return a curve, interrupted before the rows ``breaks`` and at the gaps of the motion."""
    torn = [int(np.searchsorted(motion.time, high)) for _, high in gaps(motion.time)]
    rows = np.unique(np.array([*breaks, *torn], dtype=np.int64))
    time = np.insert(motion.time, rows, motion.time[rows])
    x, y = np.insert(x, rows, np.nan), np.insert(y, rows, np.nan)
    return Curve(LABELS[name], COLOURS[name], time, x, y, DASHES.get(name, ()))


def _on_floor(run: Run) -> tuple[Array, Array]:
    """Return the positions of the odometry, with its frame laid on the first common true pose."""
    odometry, truth = run.motions[ODOMETRY], run.motions.get(TRUTH)
    x, y = odometry['x'], odometry['y']
    if truth is None:
        return x, y
    start = max(odometry.time[0], truth.time[0])
    i = min(int(np.searchsorted(odometry.time, start)), len(odometry) - 1)
    k = min(int(np.searchsorted(truth.time, start)), len(truth) - 1)
    turn = truth['yaw'][k] - odometry['yaw'][i]
    x, y = x - x[i], y - y[i]
    c, s = np.cos(turn), np.sin(turn)
    return truth['x'][k] + c * x - s * y, truth['y'][k] + s * x + c * y


def certificate(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the run-time certificate, (83) with E14, and the predictor's skill."""
    value, margin = (run.numbers.get(f'controller/lyapunov/{n}') for n in ('value', 'margin'))
    if is_long(value):
        seen = f'V runs {_extent(value["value"], "rad²/s²")}.'
        yield Chart('V, half the squared error', 'rad²/s²', [line('V', 'c1', value)], seen)
    if is_long(margin):
        below = 100.0 * float(np.mean(margin['value'] < 0.0))
        seen = f'The margin is below zero {below:.1f} % of the time.'
        lines = [line('margin', 'c5', margin)]
        yield Chart('Margin of the guaranteed decrease', 'rad²/s³', lines, seen)
    if skill := _by_wheel(run, 'skill'):
        means = ', '.join(
            f'{format_number(float(np.nanmean(series["value"])))} of the {wheel} wheel'
            for wheel, series in skill.items()
        )
        yield Chart('Skill of the predictor', 'share', _wheel_lines(skill), f'Mean: {means}.')


def link(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield answered cycles, round trips and counters of faults."""
    if not run.links or run.links[0].time.size < 2:
        return
    shown = run.links[0]
    values, answered = shown.values, shown.answered()
    if np.isfinite(answered).any():
        series = Series(shown.time, {'value': 100.0 * answered})
        seen = f'Least share of a report: {100.0 * float(np.nanmin(answered)):.1f} %.'
        lines = [line('answered', 'c3', series, style='steps')]
        yield Chart(f'{shown.name}: cycles answered since the report before', '%', lines, seen)
    names = {'round_trip_median_ms': ('median', 'c1'), 'round_trip_p99_ms': ('99 % below', 'c2')}
    trips = {key: look for key, look in names.items() if key in values}
    if trips:
        series = Series(shown.time, values)
        lines = [line(*look, series, key) for key, look in trips.items()]
        extent = _extent(np.concatenate([values[key] for key in trips]), 'ms')
        yield Chart('Round trip', 'ms', lines, f'The round trip is {extent}.')
    counted = [key for key in COUNTED if key not in ('cycles', 'cycles_lost', 'sessions')]
    counted = [key for key in counted if key in values and np.isfinite(values[key]).any()]
    lines, grown = [], []
    for key, dash, colour in zip(counted, TERM_DASHES, TERM_COLOURS, strict=False):
        since = values[key] - values[key][np.isfinite(values[key])][0]
        series = Series(shown.time, {'value': since})
        lines.append(line(COUNTED[key], colour, series, style='steps', dash=dash))
        grown.append(f'{COUNTED[key]} {np.nanmax(since):.0f}')
    if lines:
        yield Chart('Faults since the first report', 'number', lines, f'{", ".join(grown)}.')


def timing(run: Run, metrics: ReportMetrics) -> Shown:
    """Yield the loop latency and the regularity of odometry and commands."""
    delay = latencies(run)
    if not is_long(delay):
        return
    seen = (
        f'Median {format_number(1e3 * metrics.latency)} ms, 99 % below '
        f'{format_number(1e3 * metrics.latency_99)} ms, largest '
        f'{format_number(1e3 * float(delay["value"].max()))} ms.'
    )
    lines = [line('latency', 'c1', delay, style='points', scale=1e3)]
    yield Chart('From odometry to command', 'ms', lines, seen)
    for name in (ODOMETRY, COMMAND):
        received = run.receipts[name]
        steps = 1e3 * np.diff(received)
        if steps.size < 1:
            continue
        row = int(np.argmax(steps))
        seen = (
            f'Median {format_number(float(np.median(steps)))} ms; the largest, '
            f'{format_number(float(steps[row]))} ms, ends at {received[row + 1]:.1f} s.'
        )
        lines = [Line(name, COLOURS[name], *thinned(received[1:], steps), (), 'points')]
        yield Chart(f'Between two messages of {name}', 'ms', lines, seen)


def _motions(run: Run, *names: str) -> dict[str, Series]:
    return {name: motion for name in names if is_long(motion := run.motions.get(name))}


def _by_wheel(run: Run, name: str) -> dict[str, Series]:
    """Return a scalar of the controller by wheel, where there is more than one value."""
    found = ((wheel, run.numbers.get(f'controller/{name}/{wheel}')) for wheel in WHEELS)
    return {wheel: series for wheel, series in found if is_long(series)}


def _wheel_lines(found: Mapping[str, Series]) -> list[Line]:
    return [
        line(f'{wheel} wheel', wheel, series, dash=WHEEL_DASHES[wheel])
        for wheel, series in found.items()
    ]


@dataclass(frozen=True)
class Section:
    """Charts below a heading, with a caption."""

    title: str
    caption: str
    draw: Callable[[Run, ReportMetrics], Shown]
    path_caption: str = ''
    """Caption for a robot that follows a path; empty: the same."""


SECTIONS = (
    Section(
        'Speeds and their references (Fig. 11)',
        'Wheel speeds are computed from the body twists by (1). Dashed vertical lines: switches '
        '(brown), stops (red), stalls of the machine (violet), gaps (grey), jumps (turquoise), '
        'slips (pink).',
        tracking,
    ),
    Section(
        'Tracking error over time',
        'Speed minus reference at the stamps of the measurement, over the whole recording. The '
        'metrics count only the time in which the robot was driven. The scale is that of the '
        'settled error: at switches and outside of the drive the line may leave the chart, until '
        'a part of the time is selected.',
        error,
    ),
    Section(
        'Path on the floor',
        'The reference is integrated from the initial pose of the robot. Speeds are tracked, not '
        'positions, so the paths diverge. With ground truth, the frame of the odometry is laid on '
        'the first true pose: later, their distance is the drift.',
        path,
        'The reference is drawn at its poses, which the robot follows: beyond the path it leaves '
        'it at obstacles only. With ground truth, the frame of the odometry is laid on the first '
        'true pose: later, their distance is the drift.',
    ),
    Section(
        'Distance from the path',
        'Distance of the robot from the place of its reference at the same time, from the first '
        'to the last command to move. It grows where the robot makes a detour around an obstacle '
        'or looks around: the reference goes on meanwhile, or waits.',
        distance,
    ),
    Section(
        'Terms of the control law (Fig. 12)',
        'The terms of (66)-(67) with E12, and the applied acceleration.',
        terms,
    ),
    Section(
        'Commands (Fig. 12)',
        'The command is published as a body twist; u is the acceleration after all limits.',
        control,
    ),
    Section(
        'Response of the robot to its commands',
        'The fit is the command with a dead time, a first-order lag and a gain that together '
        'explain most of the measured speed. Commands are placed by receive time, odometry by '
        'its stamps, so the delay is the one observed at the recorder.',
        response,
    ),
    Section(
        'Switching modes and chaotic signals (Fig. 10)',
        'As published by the reference node, at the time for which it is valid.',
        switching,
    ),
    Section(
        'Estimates of the unknown dynamics and their targets (Fig. 13)',
        'The target is the measured acceleration of the wheel minus the applied one, both '
        f'smoothed over {WINDOW:g} s by a local straight line; it is undefined at switches, where '
        'the applied one jumps between two of its samples.',
        estimates,
    ),
    Section(
        'Phase portrait, one speed against the other (Figs. 9 and 14)',
        'Both curves have the same axes.',
        portrait,
    ),
    Section(
        'Run-time certificate and skill of the predictor',
        'The margin is the largest rate of V by E14 minus its actual rate: it is negative when '
        'the disturbance is larger than assumed, or just after a jump of the reference. '
        'Skill is 1 for perfect prediction and 0 for no better than persistence.',
        certificate,
    ),
    Section(
        'The radio link',
        'From the diagnostics of the bridge. A cycle is a command with a request for telemetry; '
        'it is answered when a measurement is received. Round trips are over the last '
        '500 cycles.',
        link,
    ),
    Section('Punctuality of the loop', 'By receive times at the recorder.', timing),
)
"""In the order of the report."""
