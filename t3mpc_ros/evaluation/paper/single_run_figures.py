# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Figures 8 to 14: one run each."""

from typing import Any

from matplotlib.ticker import MaxNLocator
import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.bag_report.topic_roles import ODOMETRY, REFERENCE, TRUTH, WHEELS
from t3mpc_ros.evaluation.closed_loop import LoopRecord
from t3mpc_ros.evaluation.paper.experiment_runs import SETTLING
from t3mpc_ros.evaluation.paper.figure_runs import (
    FigureRuns,
    broken_at_switches,
    estimated_unknown,
    explained,
    largest_switch,
    switches_of,
    true_unknown,
)
from t3mpc_ros.evaluation.plotting import (
    COLOURS,
    legend_above,
    new_figure,
    new_panels,
    thinned,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose, twist_from_wheels
from t3mpc_ros.geometry.types import ORIGIN, WheelSpeeds

Array = NDArray[np.float64]

REFERENCE_COLOUR, DRIVEN = COLOURS[REFERENCE], COLOURS[TRUTH]
COMMAND, MEASURED = COLOURS['applied'], COLOURS[ODOMETRY]


def path(showcase: FigureRuns) -> Any:
    """Return the path on the floor of the simulated robot, the paper's Fig. 8."""
    run = showcase.velocity
    figure = new_figure(5.0)
    axis = figure.subplots()
    reference, driven = floor_path(run.reference, run.time), floor_path(run.speeds, run.time)
    axis.plot(*reference.T, color=REFERENCE_COLOUR, linewidth=1.0, label='reference')
    axis.plot(*driven.T, color=DRIVEN, linewidth=1.6, label='driven')
    axis.plot(*driven[0], 'o', color=REFERENCE_COLOUR, markersize=6, label='start')
    at = driven[1:][np.diff(run.modes) != 0]
    axis.plot(*at.T, 'D', color=COLOURS['switch'], markersize=5, label='switch')
    axis.set_aspect('equal', adjustable='datalim')
    axis.set(xlabel='x / m', ylabel='y / m')
    legend_above(figure, axis)
    return figure


def floor_path(speeds: Array, time: Array, geometry: WheelGeometry | None = None) -> Array:
    """Return places (m) on the way of a robot whose wheels turn so, shape (n, 2), from (0, 0).

    The body motion (1)-(3) is integrated in exact arcs, a wheel's speed held at the mean of
    both ends of a period.

    Parameters
    ----------
    speeds
        Right and left wheel, rad/s, shape (n, 2).
    time
        s, shape (n,).
    geometry
        Of the robot; the default one when None.
    """
    geometry = WheelGeometry() if geometry is None else geometry
    places = np.zeros((time.size, 2))
    pose = ORIGIN
    middles = 0.5 * (speeds[1:] + speeds[:-1])
    for k, (dt, wheels) in enumerate(zip(np.diff(time), middles, strict=True), 1):
        twist = twist_from_wheels(WheelSpeeds(float(wheels[0]), float(wheels[1])), geometry)
        pose = advance_pose(pose, twist, float(dt))
        places[k] = pose.x, pose.y
    return places


def path_in_words(showcase: FigureRuns) -> str:
    """Return how long the way was and where it ended."""
    run = showcase.velocity
    reference, driven = floor_path(run.reference, run.time), floor_path(run.speeds, run.time)
    way = float(np.hypot(*np.diff(driven, axis=0).T).sum())
    apart = float(np.hypot(*(driven[-1] - reference[-1])))
    return (
        f'A simulated robot: after {way:.1f} m in {run.time[-1]:.0f} s it is {apart:.2f} m from '
        'where the reference alone would have led, with nothing that corrects its place.'
    )


def portrait_in_words(showcase: FigureRuns) -> str:
    """Return how closely the simulated robot's wheels followed."""
    run = showcase.velocity
    return (
        f'A simulated robot: RMSE {run.rmse():.3f} rad/s, settled {run.rmse(cut=SETTLING):.3f} '
        'rad/s.'
    )


def robot_portrait(showcase: FigureRuns) -> Any:
    """Return the phase portrait of the simulated robot's wheels, the paper's Fig. 9."""
    return _portrait(showcase.velocity)


def portrait(showcase: FigureRuns) -> Any:
    """Return the phase portrait of the outputs in the paper's parameter, its Fig. 14."""
    return _portrait(showcase.torque)


def _portrait(run: LoopRecord) -> Any:
    figure = new_figure(3.4)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis, values, colour, title in zip(
        axes,
        (run.reference, run.speeds),
        (REFERENCE_COLOUR, DRIVEN),
        ('reference', 'robot'),
        strict=True,
    ):
        # The robot's way through a switch is part of its portrait, the reference's jump is not.
        shown = broken_at_switches(run, values) if values is run.reference else values
        axis.plot(shown[:, 1], shown[:, 0], color=colour, linewidth=0.8)
        axis.set(title=title, xlabel='left wheel / rad/s')
    axes[0].set_ylabel('right wheel / rad/s')
    return figure


def modes(showcase: FigureRuns) -> Any:
    """Return which chaotic signal drives which output, the paper's Fig. 10."""
    run = showcase.torque
    figure, axes = new_panels(2, 1.25)
    index = run.modes.astype(int) % len(showcase.pairs)
    signals = np.array(showcase.pairs)[index]
    end = run.time[-1] + run.time[1] - run.time[0]
    for axis, wheel, column in zip(axes, WHEELS, signals.T, strict=True):
        starts = np.concatenate(([0], np.flatnonzero(np.diff(column)) + 1))
        edges = np.append(run.time[starts], end)
        for left, right, k in zip(edges[:-1], edges[1:], starts, strict=True):
            axis.plot((left, right), (column[k],) * 2, color=COMMAND, linewidth=4.0)
        axis.step(run.time, column, where='post', color=COMMAND, linewidth=0.8)
        axis.set_title(f'signal that drives the {wheel} wheel')
        axis.set_yticks((1, 2, 3, 4), [f'$y_{k}$' for k in (1, 2, 3, 4)])
        axis.set_ylim(0.5, 4.5)
    _name_time(axes[-1])
    return figure


def outputs(showcase: FigureRuns) -> Any:
    """Return both outputs with their references, whole run and one switch, the paper's Fig. 11."""
    run = showcase.torque
    figure, axes = run_and_zoom(run, 'speed / rad/s', before=0.4, after=1.6)
    for row, i in zip(axes, range(2), strict=True):
        for axis, rows in zip(row, windows(run, 0.4, 1.6), strict=True):
            time = run.time[rows]
            if rows.size < run.time.size:
                axis.plot(
                    time, run.measured[rows, i], '.', color=MEASURED, ms=2.5, label='measured'
                )
            axis.plot(
                *thinned(time, run.reference[rows, i]),
                color=REFERENCE_COLOUR,
                lw=1.0,
                label='reference',
            )
            axis.plot(*thinned(time, run.speeds[rows, i]), color=DRIVEN, lw=1.2, label='robot')
    legend_above(figure, axes[0][-1])
    return figure


def control(showcase: FigureRuns) -> Any:
    """Return the control signals with their total variation, the paper's Fig. 12."""
    run = showcase.torque
    figure, axes = run_and_zoom(run, 'u / rad/s²', before=0.4, after=1.6)
    span = run.time[-1] - run.time[0]
    for row, i in zip(axes, range(2), strict=True):
        varied = float(np.abs(np.diff(run.command[:, i])).sum() / span)
        row[0].set_title(f'{WHEELS[i]} wheel, varies by {varied:.0f} rad/s² a second')
        for axis, rows in zip(row, windows(run, 0.4, 1.6), strict=True):
            axis.plot(*thinned(run.time[rows], run.command[rows, i]), color=COMMAND, lw=1.0)
    return figure


def estimates(showcase: FigureRuns) -> Any:
    """Return the estimates g with their targets, the paper's Fig. 13."""
    run = showcase.torque
    target, found = true_unknown(run), estimated_unknown(run)
    figure, axes = run_and_zoom(run, 'rad/s²', before=2.0, after=4.0)
    for row, i, share in zip(axes, range(2), explained(run), strict=True):
        row[0].set_title(f'{WHEELS[i]} wheel, {100 * share:.0f} % of the variance explained')
        for axis, rows in zip(row, windows(run, 2.0, 4.0), strict=True):
            rows = rows[rows < target.shape[0]]
            time = run.time[rows]
            axis.plot(
                *thinned(time, target[rows, i]),
                color=COLOURS['target'], lw=0.9, label="unknown, $\\dot\\chi - u$",
            )  # fmt: skip
            axis.plot(
                *thinned(time, found[rows, i]),
                color=COLOURS['estimate'], lw=1.3, label='estimate g',
            )  # fmt: skip
    legend_above(figure, axes[0][-1])
    return figure


def preview(showcase: FigureRuns) -> Any:
    """Return both wheels about a switch, with preview and without."""
    run, blind = showcase.velocity, showcase.blind
    middle = largest_switch(run)
    if blind is None or middle is None:
        return None
    before, after = 0.3, 0.8
    rows = rows_between(run, run.time[middle] - before, run.time[middle] + after)
    time = run.time[rows] - run.time[middle]
    figure, axes = new_panels(2, 2.1)
    for axis, i in zip(axes, range(2), strict=True):
        axis.axvline(0.0, color=COLOURS['switch'], linewidth=0.8, linestyle=(0, (4, 3)))
        axis.step(
            time,
            run.reference[rows, i],
            color=REFERENCE_COLOUR,
            lw=1.0,
            where='post',
            label='reference',
        )
        axis.plot(time, run.speeds[rows, i], color=DRIVEN, lw=1.6, label='with preview')
        axis.plot(time, blind.speeds[rows, i], color='#ea580c', lw=1.6, label='without preview')
        axis.set(title=f'{WHEELS[i]} wheel', ylabel='speed / rad/s')
        axis.margins(x=0.0)
    axes[-1].set_xlabel(f'time from the switch at {run.time[middle]:.0f} s / s')
    legend_above(figure, axes[0])
    return figure


def run_and_zoom(run: LoopRecord, unit: str, before: float, after: float) -> tuple[Any, Any]:
    """Return a figure with a row per wheel: the whole run, and about its largest switch."""
    figure = new_figure(4.6)
    zoomed = largest_switch(run) is not None
    widths = {'width_ratios': (1.7, 1.0)} if zoomed else {}
    columns = 2 if zoomed else 1
    axes = figure.subplots(2, columns, sharex='col', squeeze=False, gridspec_kw=widths)
    for row, wheel in zip(axes, WHEELS, strict=True):
        row[0].set(title=f'{wheel} wheel', ylabel=unit)
        for axis in row:
            for switch in switches_of(run):
                style = {'color': COLOURS['switch'], 'linewidth': 0.8, 'linestyle': (0, (4, 3))}
                axis.axvline(switch, zorder=1.5, **style)
    for axis, rows in zip(axes[-1], windows(run, before, after), strict=True):
        axis.set_xlim(run.time[rows[0]], run.time[rows[-1]])
        axis.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=(1, 2, 5, 10)))
        _name_time(axis)
    if zoomed:
        axes[0][1].set_title('about a switch')
    return figure, axes


def windows(run: LoopRecord, before: float, after: float) -> list[NDArray[np.intp]]:
    """Return the rows of the whole run, and those about its largest switch if it has one."""
    found = [np.arange(run.time.size)]
    middle = largest_switch(run)
    if middle is not None:
        found.append(rows_between(run, run.time[middle] - before, run.time[middle] + after))
    return found


def rows_between(run: LoopRecord, begin: float, end: float) -> NDArray[np.intp]:
    """Return the rows with a time (s) in a stretch."""
    return np.flatnonzero((run.time >= begin - 1e-9) & (run.time <= end + 1e-9))


def _name_time(axis: Any) -> None:
    axis.margins(x=0.01)
    axis.set_xlabel('time / s')
