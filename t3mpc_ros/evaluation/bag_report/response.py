# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Response of a robot to its commands: dead time, lag, accelerations, stops."""

from collections.abc import Mapping
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.bag_report.continuity import parts
from t3mpc_ros.evaluation.bag_report.run_data import Run, Series
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.topic_roles import COMMAND
from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]

LONGEST_DEAD_TIME, LONGEST_LAG = 1.0, 3.0
"""Largest dead time and lag that are searched, s."""
MOST = 20_000
"""Number of samples of a fit: of a longer run, the window in which the command varies most."""
FEWEST = 50
MIN_EXPLAINED = 0.3
"""Explained share below which the fit is rejected."""
WINDOW = 0.2
"""Least smoothing width (s) before differentiation."""
STILL = {'linear': 0.01, 'angular': 0.05}
"""Smoothed speeds (m/s, rad/s) below which the robot is at standstill."""
PAUSE = 0.5
"""Least duration of a stop, s."""


@dataclass(frozen=True)
class ResponseFit:
    """First-order response with dead time: the measured speed is k u(t - d) behind a lag."""

    dead_time: float
    """d, s; between receive times of commands and stamps of odometry."""
    lag: float
    """Time constant of the first-order lag, s."""
    gain: float
    """k, ratio of speed to command."""
    explained: float
    """Explained share of the variance of the measured speed."""
    step: float
    """Resolution of the dead time, s."""

    @property
    def clear(self) -> bool:
        """Whether the fit explains enough of the response."""
        return self.explained >= MIN_EXPLAINED and self.gain > 0.0


@kernel
def lag_behind(u: Array, keep: float, out: Array) -> None:
    """Write ``u`` filtered by a first-order lag: each step keeps a share of the last output.

    u, out : shape (n,)
    """
    out[0] = u[0]
    for k in range(1, u.size):
        out[k] = keep * out[k - 1] + (1.0 - keep) * u[k - 1]


def fit_response(command: Series, motion: Series, name: str) -> ResponseFit | None:
    """Return the dead time, lag and gain that fit the measured speed best.

    Least squares of the output error over a grid of lags and dead times, refined twice. The sum of
    dead time and lag is better determined than either. In a closed loop, noise fed back through
    the command biases the delay slightly upwards. None when the two series overlap too briefly
    or the command does not vary.
    """
    if min(len(command), len(motion)) < 3:
        return None
    gap = float(np.median(np.diff(motion.time)))
    step = min(max(0.25 * gap, 0.002), 0.01)
    start, end = busiest(command, motion, name, MOST * step)
    if not end > start:
        return None
    count = int((end - start) / step) + 1
    shifts = int(LONGEST_DEAD_TIME / step) + 1
    if count < shifts + FEWEST:
        return None
    grid = start + step * np.arange(count)
    u = command[name][np.maximum(np.searchsorted(command.time, grid, 'right') - 1, 0)]
    y = np.interp(grid, motion.time, motion[name])
    u, y = u - u.mean(), y - y[shifts:].mean()
    if not (np.ptp(u) > 1e-6 and np.ptp(y) > 1e-9):
        return None
    lags = np.geomspace(0.5 * step, LONGEST_LAG, 30)
    best = _best(u, y, step, shifts, [0.0, *lags.tolist()])
    near = int(np.searchsorted(lags, best.lag))
    low = 0.0 if best.lag == 0.0 else float(lags[max(near - 1, 0)])
    high = float(lags[min(near + 1, lags.size - 1)])
    return _best(u, y, step, shifts, [best.lag, *np.linspace(low, high, 16).tolist()])


def busiest(command: Series, motion: Series, name: str, most: float) -> tuple[float, float]:
    """Return the time span without a gap, at most ``most`` s, in which the command varies most.

    Start and end are equal where both series overlap nowhere.
    """
    moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(command[name])))])
    best, span = -1.0, (0.0, 0.0)
    for start, end in parts(command.time, motion.time):
        starts = np.array([start])
        if end - start > most:
            starts = np.append(np.arange(start, end - most, 0.25 * most), end - most)
        ends = np.minimum(starts + most, end)
        varied = np.interp(ends, command.time, moved) - np.interp(starts, command.time, moved)
        k = int(np.argmax(varied))
        if varied[k] > best:
            best, span = float(varied[k]), (float(starts[k]), float(ends[k]))
    return span


def _best(u: Array, y: Array, step: float, shifts: int, lags: list[float]) -> ResponseFit:
    # All shifts at once by the Fourier transform. A product for each of them would wait, on a busy
    # machine, thousands of times for the threads of the linear algebra library.
    wanted = y[shifts:]
    power = float(wanted @ wanted)
    spectrum = np.conj(np.fft.rfft(wanted, u.size))
    found = ResponseFit(0.0, 0.0, 0.0, -math.inf, step)
    x = np.empty(u.size)
    for lag in lags:
        lag_behind(u, math.exp(-step / lag) if lag > 0.0 else 0.0, x)
        seen = x if lag > 0.0 else u
        squares = np.concatenate([[0.0], np.cumsum(seen**2)])
        energy = (squares[-shifts:] - squares[1 : shifts + 1])[::-1]
        product = np.fft.irfft(np.fft.rfft(seen) * spectrum, u.size)[shifts:0:-1]
        sound = (energy > 0.0) & (product > 0.0)
        explained = np.full(shifts, -math.inf)
        explained[sound] = product[sound] ** 2 / (energy[sound] * power)
        shift = int(np.argmax(explained))
        if explained[shift] > found.explained:
            gain = float(product[shift] / energy[shift])
            found = ResponseFit(shift * step, lag, gain, float(explained[shift]), step)
    return found


def predicted(fit: ResponseFit, command: Series, name: str, time: Array) -> Array:
    """Return the speed that the fit predicts at evenly spaced ``time``, in its unit."""
    late = time - fit.dead_time
    u = command[name][np.maximum(np.searchsorted(command.time, late, 'right') - 1, 0)]
    out = np.empty(u.size)
    step = float(time[1] - time[0])
    lag_behind(u, math.exp(-step / fit.lag) if fit.lag > 0.0 else 0.0, out)
    return fit.gain * out


def smooth(series: Series, name: str, held: bool = False) -> tuple[Array, Array, Array, Array]:
    """Return evenly spaced times with the speed and its first and second derivatives.

    Parabolas are fitted to windows of :data:`WINDOW` or of eight samples, whichever is longer.
    Empty arrays when the series is too short; NaN across gaps longer than a window. ``held``:
    each value holds until the next, as a command does.
    """
    nothing = np.empty(0)
    if len(series) < 3:
        return nothing, nothing, nothing, nothing
    width = max(WINDOW, 8.0 * float(np.median(np.diff(series.time))))
    half = 10
    step = 0.5 * width / half
    count = int((series.time[-1] - series.time[0]) / step) + 1
    if not 2 * half + 1 <= count <= 20_000_000:
        return nothing, nothing, nothing, nothing
    grid = series.time[0] + step * np.arange(count)
    if held:
        value = series[name][np.searchsorted(series.time, grid, 'right') - 1]
    else:
        value = np.interp(grid, series.time, series[name])
    offsets = step * np.arange(-half, half + 1.0)
    design = np.stack([np.ones_like(offsets), offsets, 0.5 * offsets**2], axis=1)
    weights = np.linalg.pinv(design)
    fitted = [np.correlate(value, row, 'valid') for row in weights]
    time = grid[half : count - half]
    following = np.clip(np.searchsorted(series.time, time, 'right'), 1, len(series) - 1)
    torn = np.diff(series.time)[following - 1] > width
    if not held:
        fitted = [np.where(torn, np.nan, each) for each in fitted]
    return time, fitted[0], fitted[1], fitted[2]


@dataclass(frozen=True)
class Roughness:
    """Rates of change of a speed, per s and per s² of its unit; NaN where unknown."""

    acceleration: float
    """Root mean square of acceleration and jerk."""
    acceleration_99: float
    """99th percentile of acceleration and jerk."""
    jerk: float
    jerk_99: float


def roughness(series: Series, name: str, held: bool = False) -> Roughness:
    """Return the rates of change of one quantity after smoothing, see :func:`smooth`."""
    _, _, rate, bend = smooth(series, name, held)
    numbers = []
    for each in (rate, bend):
        size = np.abs(each[np.isfinite(each)])
        if size.size:
            numbers += [rms(size), float(np.percentile(size, 99.0))]
        else:
            numbers += [math.nan, math.nan]
    return Roughness(*numbers)


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
    time, linear, _, _ = smooth(motion, 'linear')
    _, angular, _, _ = smooth(motion, 'angular')
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
        rows = np.searchsorted(command.time, time, 'right') - 1
        for name, least in STILL.items():
            commanded |= (rows >= 0) & (np.abs(command[name][np.maximum(rows, 0)]) > 2.0 * least)
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
