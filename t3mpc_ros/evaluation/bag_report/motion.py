# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Motion of a robot in a report: path length, speeds, stops."""

import numpy as np

from t3mpc_ros.evaluation.bag_report.metrics import format_number
from t3mpc_ros.evaluation.bag_report.run_data import Run, Series
from t3mpc_ros.evaluation.topic_roles import COMMAND
from t3mpc_ros.geometry.types import Array

WINDOW = 0.2
"""Least smoothing width, s."""
STILL = {'linear': 0.01, 'angular': 0.05}
"""Smoothed speeds (m/s, rad/s) below which the robot is at standstill."""
PAUSE = 0.5
"""Least duration of a stop, s."""


def smooth(series: Series, name: str) -> tuple[Array, Array]:
    """Return evenly spaced times with the smoothed speed.

    Parabolas are fitted to windows of :data:`WINDOW` or of eight samples, whichever is longer.
    Empty arrays when the series is too short; NaN across gaps longer than a window.
    """
    nothing = np.empty(0)
    if len(series) < 3:
        return nothing, nothing
    width = max(WINDOW, 8.0 * float(np.median(np.diff(series.time))))
    half = 10
    step = 0.5 * width / half
    count = int((series.time[-1] - series.time[0]) / step) + 1
    if not 2 * half + 1 <= count <= 20_000_000:
        return nothing, nothing
    grid = series.time[0] + step * np.arange(count)
    value = np.interp(grid, series.time, series[name])
    offsets = step * np.arange(-half, half + 1.0)
    design = np.stack([np.ones_like(offsets), offsets, 0.5 * offsets**2], axis=1)
    fitted = np.correlate(value, np.linalg.pinv(design)[0], 'valid')
    time = grid[half : count - half]
    following = np.clip(np.searchsorted(series.time, time, 'right'), 1, len(series) - 1)
    torn = np.diff(series.time)[following - 1] > width
    return time, np.where(torn, np.nan, fitted)


def motion_rows(run: Run) -> list[list[str]]:
    """Return path length, turning, speeds and stops as rows; none when there are few samples."""
    motion, command = run.motions.get(run.measured), run.motions.get(COMMAND)
    if motion is None:
        return []
    time, linear = smooth(motion, 'linear')
    _, angular = smooth(motion, 'angular')
    known = np.isfinite(linear)
    if not known.any():
        return []
    step = float(time[1] - time[0]) if time.size > 1 else 0.0
    still = known & (np.abs(linear) < STILL['linear']) & (np.abs(angular) < STILL['angular'])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    spans = [slice(*each) for each in edges.reshape(-1, 2).tolist()]
    spans = [each for each in spans if (each.stop - each.start) * step >= PAUSE]
    stops = [(float(time[each][0]), float(time[each][-1])) for each in spans]
    lengths = [end - start for start, end in stops]
    distance = float(np.abs(linear[known]).sum() * step)
    moving = float(np.count_nonzero(known & ~still) * step)
    mean, fastest = distance / moving if moving > 0.0 else 0.0, np.abs(linear[known]).max()
    turned = float(np.abs(angular[known]).sum() * step)
    rows = [
        ['path length, forwards and backwards', f'{format_number(distance)} m'],
        ['turning, both ways', f'{format_number(turned)} rad'],
        ['speed while moving, mean and largest', f'{mean:.3f} and {fastest:.3f} m/s'],
        ['time moving', f'{moving:.1f} s'],
        [
            'stops',
            f'{len(stops)}, {sum(lengths):.1f} s in all, the longest '
            f'{max(lengths, default=0.0):.1f} s',
        ],
    ]
    if stops:
        where = ', '.join(f'{start:.1f} to {end:.1f}' for start, end in stops[:5])
        more = f', and {len(stops) - 5} more' if len(stops) > 5 else ''
        rows.append(['standstill at', f'{where}{more} s'])
    if command is not None:
        commanded = np.zeros(time.size, dtype=np.bool_)
        for name, least in STILL.items():
            commanded |= np.abs(command.held(name, time)) > 2.0 * least
        commanded &= time >= command.time[0]
        disobeyed = step * sum(int(np.count_nonzero(commanded[each])) for each in spans)
        rows.append(['of that, motion was commanded', f'{disobeyed:.1f} s'])
    return rows
