# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Motion of a robot: its responses to commands, path length, stops."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from t3mpc_ros.evaluation.bag_report.run_data import Run, Series
from t3mpc_ros.evaluation.drive_response import ResponseFit, fit_response
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


@dataclass(frozen=True)
class MotionSummary:
    """Summary of the motion; s, m and m/s."""

    distance: float
    """Path length, forwards or backwards."""
    turned: float
    """Sum of absolute turning, rad."""
    fastest: float
    """Largest smoothed speed."""
    moving: float
    """Time in motion."""
    stops: tuple[tuple[float, float], ...]
    """Start and end of each standstill of at least :data:`PAUSE`."""
    disobeyed: float
    """Part of that time in which motion was commanded."""


def motion_summary(run: Run) -> MotionSummary | None:
    """Return the summary of the measured motion; None when there are too few samples."""
    motion = run.motions.get(run.measured)
    if motion is None:
        return None
    time, linear = smooth(motion, 'linear')
    _, angular = smooth(motion, 'angular')
    known = np.isfinite(linear)
    if not known.any():
        return None
    step = float(time[1] - time[0]) if time.size > 1 else 0.0
    still = known & (np.abs(linear) < STILL['linear']) & (np.abs(angular) < STILL['angular'])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    spans = [(int(low), int(high)) for low, high in edges.reshape(-1, 2)]
    spans = [(low, high) for low, high in spans if (high - low) * step >= PAUSE]
    disobeyed = 0.0
    command = run.motions.get(COMMAND)
    if command is not None and len(command):
        commanded = np.zeros(time.size, dtype=np.bool_)
        for name, least in STILL.items():
            commanded |= np.abs(command.held(name, time)) > 2.0 * least
        commanded &= time >= command.time[0]
        disobeyed = step * sum(int(np.count_nonzero(commanded[low:high])) for low, high in spans)
    return MotionSummary(
        distance=float(np.abs(linear[known]).sum() * step),
        turned=float(np.abs(angular[known]).sum() * step),
        fastest=float(np.abs(linear[known]).max()),
        moving=float(np.count_nonzero(known & ~still) * step),
        stops=tuple((float(time[low]), float(time[high - 1])) for low, high in spans),
        disobeyed=disobeyed,
    )


def responses(run: Run) -> Mapping[str, ResponseFit]:
    """Return the fitted response of each channel that is identifiable."""
    command, motion = run.motions.get(COMMAND), run.motions.get(run.measured)
    if command is None or motion is None:
        return {}
    fits = {each.name: fit_response(command, motion, each.name) for each in run.channels}
    return {name: fit for name, fit in fits.items() if fit is not None}
