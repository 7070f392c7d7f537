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
r"""Response of a robot to its commands, a first-order lag behind a dead time, and its fit.

The model is that of the speed filter and of the estimator of the dead time:

.. math:: y(t) = k\,\chi(t - \tau) + o + \nu, \qquad \chi' = (c - \chi)/\lambda

with the command c, which holds until the next one, the dead time tau and the lag lambda. Commands
count from their receipt by the recorder, measured speeds at the stamps of the odometry.
:func:`fit_response` searches one speed over a wide grid; :func:`fit_wheels` starts there and
fits both wheels by least squares, with covariance. Errors that last for some time, such as
friction, are no white noise: the covariance is that of Newey and West (1987, doi 10.2307/1913610).
"""

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.evaluation.bag_report.motion_continuity import parts
from t3mpc_ros.evaluation.bag_report.recorded_run import Series
from t3mpc_ros.evaluation.confidence_intervals import student_quantile
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel

FINEST_STEP, COARSEST_STEP = 0.002, 0.01
"""Bounds of the step of the fit, s."""
LONGEST_DEAD_TIME, LONGEST_LAG = 1.0, 3.0
"""Largest dead time and lag that are searched, s."""
MOST = 20_000
"""Number of samples of a fit: of a longer run, the window in which the command varies most."""
FEWEST = 50
MIN_EXPLAINED = 0.3
"""Explained share below which the fit is rejected."""
MAX_SPREAD = 0.4
"""Widest range of delays that fit the data equally well, as a share of the delay, of a fit that is
determined; and at least :data:`MIN_SPREAD`."""
MIN_SPREAD = 0.02
"""s"""
OFFSETS = 4
"""Parameters that the data determine: dead time, lag, gain and offset."""
MIN_LAG = 1e-3
"""Lag below which a drive responds at once, s."""
CORRELATION_TIME = 0.5
"""Time over which the errors of the model are correlated at most, s."""
ITERATIONS = 60
DEAD_TIME, LAG = 0, 1
"""Parameters of the fit of both wheels."""


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
    shortest: float = 0.0
    longest: float = 0.0
    """Least and largest sum of dead time and lag that fit the data as well, s: those of the 95 %
    confidence region."""

    @property
    def delay(self) -> float:
        """Sum of dead time and lag, s."""
        return self.dead_time + self.lag

    @property
    def explains(self) -> bool:
        """Whether the fit explains enough of the response."""
        return self.explained >= MIN_EXPLAINED and self.gain > 0.0

    @property
    def determined(self) -> bool:
        """Whether the data determine the delay: no very different one fits them as well."""
        return bool(self.longest - self.shortest <= max(MIN_SPREAD, MAX_SPREAD * self.delay))

    @property
    def clear(self) -> bool:
        """Whether the fit explains enough of the response, and the data determine it."""
        return self.explains and self.determined


@kernel
def lag_behind(u: Array, keep: Array, out: Array) -> None:
    """Write ``u`` filtered by a first-order lag: each step keeps a share of the last output.

    u, keep, out : shape (n,)
    """
    out[0] = u[0]
    for k in range(1, u.size):
        out[k] = keep[k] * out[k - 1] + (1.0 - keep[k]) * u[k - 1]


def fit_response(command: Series, motion: Series, name: str) -> ResponseFit | None:
    """Return the dead time, lag and gain that fit the measured speed best.

    Least squares of the output error, with an offset, over a grid of lags and dead times, refined
    once. The sum of dead time and lag is better determined than either; which sums fit as well is
    said by the fit, widened by those of the halves of the run that contradict it. In a closed
    loop, noise fed back through the command biases the delay slightly upwards. None when the two
    series overlap too briefly or the command does not vary.
    """
    if min(len(command), len(motion)) < 3:
        return None
    gap = float(np.median(np.diff(motion.time)))
    step = min(max(0.25 * gap, FINEST_STEP), COARSEST_STEP)
    start, end = busiest(command, motion, name, MOST * step)
    if not end > start:
        return None
    count = int((end - start) / step) + 1
    shifts = int(LONGEST_DEAD_TIME / step) + 1
    if count < shifts + FEWEST:
        return None
    grid = start + step * np.arange(count, dtype=np.float64)
    u = command.held(name, grid)
    y = np.interp(grid, motion.time, motion[name])
    found = _fit(u, y, step, shifts)
    middle = count // 2
    if found is None or middle < shifts + FEWEST:
        return found
    for each in (slice(0, middle), slice(middle - shifts, count)):
        # A response that changes within the run is not that of the whole.
        part = _fit(u[each], y[each], step, shifts)
        if part is None or part.longest >= found.shortest and part.shortest <= found.longest:
            continue
        low, high = min(found.shortest, part.delay), max(found.longest, part.delay)
        found = replace(found, shortest=low, longest=high)
    return found


def _fit(u: Array, y: Array, step: float, shifts: int) -> ResponseFit | None:
    """Return the fit of samples ``step`` s apart, with fewer shifts than samples."""
    u, y = u - u.mean(), y - y[shifts:].mean()
    if not (np.ptp(u) > 1e-6 and np.ptp(y) > 1e-9):
        return None
    coarse = np.concatenate([[0.0], np.geomspace(0.5 * step, LONGEST_LAG, 30)])
    coarsely = _explained(u, y, shifts, step, coarse)
    best = float(coarse[int(np.argmax(coarsely.max(axis=1)))])
    near = int(np.searchsorted(coarse[1:], best)) + 1
    low = 0.0 if best == 0.0 else float(coarse[max(near - 1, 1)])
    high = float(coarse[min(near + 1, coarse.size - 1)])
    fine = np.array([best, *np.linspace(low, high, 16).tolist()])
    lags = np.concatenate([fine, coarse])
    explained = np.vstack([_explained(u, y, shifts, step, fine), coarsely])
    row, shift = np.unravel_index(int(np.argmax(explained)), explained.shape)
    largest, lag = float(explained[row, shift]), float(lags[row])
    if not math.isfinite(largest):
        return None
    seen = _lagged(u, lag, step)[shifts - shift : u.size - shift]
    seen = seen - seen.mean()
    gain = float(seen @ y[shifts:] / (seen @ seen))
    independent = seen.size / correlation(y[shifts:] - gain * seen)
    delays = lags[:, np.newaxis] + step * np.arange(shifts)
    # That of the likelihood of one parameter with so many independent errors, at 95 %.
    degrees, tolerance = int(independent) - OFFSETS, math.inf
    if degrees >= 1:
        tolerance = (1.0 - largest) * student_quantile(degrees) ** 2 / degrees
    fitting = delays[explained >= largest - tolerance]
    spread = float(fitting.min()), float(fitting.max())
    return ResponseFit(float(shift * step), lag, gain, largest, step, *spread)


def correlation(errors: Array) -> float:
    """Return over how many samples errors are correlated, at least 1.

    The integral of their autocorrelation up to where it is first below zero, on both sides.
    """
    size = fast_size(2 * errors.size)
    power = np.abs(np.fft.rfft(errors, size)) ** 2
    found = np.fft.irfft(power, size)[: errors.size]
    if not found[0] > 0.0:
        return 1.0
    below = np.flatnonzero(found <= 0.0)
    last = int(below[0]) if below.size else errors.size
    return float(1.0 + 2.0 * (found[1:last] / found[0]).sum())


def fast_size(least: int) -> int:
    """Return the next size whose transform is fast: one of a prime takes 20 times longer."""
    return min(odd << max(0, ((least - 1) // odd).bit_length()) for odd in (1, 3, 5, 9, 15))


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


def _lagged(u: Array, lag: float, step: float) -> Array:
    if lag <= 0.0:
        return u
    x = np.empty(u.size)
    lag_behind(u, np.full(u.size, math.exp(-step / lag)), x)
    return x


def _explained(u: Array, y: Array, shifts: int, step: float, lags: Array) -> Array:
    """Return the share of ``y`` that the command explains, shape (lags, shifts).

    By lag and by shift in steps, each with the best gain and offset; -inf for a gain below zero.
    """
    # All shifts at once by the Fourier transform. A product for each of them would wait, on a busy
    # machine, thousands of times for the threads of the linear algebra library.
    wanted = y[shifts:]
    power = float(wanted @ wanted)
    size = fast_size(u.size)
    spectrum = np.conj(np.fft.rfft(wanted, size))
    explained = np.full((lags.size, shifts), -math.inf)
    for row, lag in enumerate(lags.tolist()):
        seen = _lagged(u, lag, step)
        sums, squares = (np.concatenate([[0.0], np.cumsum(each)]) for each in (seen, seen**2))
        total, energy = ((each[-shifts:] - each[1 : shifts + 1])[::-1] for each in (sums, squares))
        energy = energy - total**2 / wanted.size  # about its mean, as y is about its own
        product = np.fft.irfft(np.fft.rfft(seen, size) * spectrum, size)[shifts:0:-1]
        sound = (energy > 1e-12 * power) & (product > 0.0)
        explained[row, sound] = product[sound] ** 2 / (energy[sound] * power)
    return explained


class WheelData(NamedTuple):
    """Commands and measured speeds of both wheels."""

    switches: Array
    """Receipt of the commands, s, shape (n,)"""
    commands: Array
    """rad/s, shape (2, n)"""
    time: Array
    """Stamps of the measured speeds, s, shape (m,)"""
    measured: Array
    """rad/s, shape (2, m)"""
    window: float
    """Time before a stamp over which the measured speed is the mean, s; 0: the speed at it."""


class WheelFit(NamedTuple):
    """Fit of the model to both wheels, with a gain and an offset of each."""

    times: Array
    """tau and lambda, s"""
    covariance: Array
    """s², shape (2, 2)"""
    residuals: Array
    """rad/s, shape (2, m)"""
    data: WheelData

    @property
    def cost(self) -> float:
        """Sum of squared errors, (rad/s)²."""
        return float((self.residuals**2).sum())


def predicted(fit: ResponseFit, command: Series, name: str, time: Array) -> Array:
    """Return the speed that the fit predicts, in its unit, shape (n,)."""
    data = WheelData(command.time, command[name][np.newaxis], time, np.empty((1, 0)), 0.0)
    found: Array = fit.gain * respond(data, fit.dead_time, max(fit.lag, 1e-9))[0]
    return found


def respond(data: WheelData, dead_time: float, lag: float) -> Array:
    """Return chi(t - tau) at the stamps, or its mean over the window, rad/s, shape (2, m)."""
    switches, commands, time, _, window = data
    steps = np.diff(switches, prepend=switches[0])
    at_switches = np.empty_like(commands)
    for each, speeds in zip(commands, at_switches, strict=True):
        lag_behind(each, np.exp(-steps / lag), speeds)
    integral = np.cumsum(np.roll(commands, 1, axis=1) * steps, axis=1)

    def at(moments: Array) -> tuple[Array, Array]:
        """Return chi and the integral of the command (rad)."""
        rows = np.clip(np.searchsorted(switches, moments, 'right') - 1, 0, None)
        elapsed = np.maximum(moments - switches[rows], 0.0)
        now = commands[:, rows]
        speeds = now + (at_switches[:, rows] - now) * np.exp(-elapsed / lag)
        return speeds, integral[:, rows] + now * elapsed

    speeds, covered = at(time - dead_time)
    if window == 0.0:
        return speeds
    before, covered_before = at(time - dead_time - window)
    # Of chi' = (c - chi)/lag: the integral of chi is that of c less the change of chi.
    return (covered - covered_before - lag * (speeds - before)) / window


def fit_wheels(data: WheelData, delay: float) -> WheelFit:
    """Return the least-squares fit; ``delay`` is roughly the sum of dead time and lag, s.

    Gauss-Newton with halved steps, from the best of several shares of the lag in the delay.
    """

    def errors(times: Array) -> Array:
        """Return the errors (rad/s) with the best gains and offsets."""
        found = respond(data, float(times[DEAD_TIME]), float(times[LAG]))
        centred = found - found.mean(axis=1, keepdims=True)
        measured = data.measured - data.measured.mean(axis=1, keepdims=True)
        energy = np.maximum((centred**2).sum(axis=1), 1e-12)
        gains = (centred * measured).sum(axis=1) / energy
        missed: Array = measured - gains[:, np.newaxis] * centred
        return missed

    def slopes(times: Array) -> Array:
        """Return the derivatives of the errors by tau and lambda, shape (2, 2, m)."""
        found = np.empty((2, *data.measured.shape))
        for i in (DEAD_TIME, LAG):
            high, low = times.copy(), times.copy()
            change = max(1e-4, 0.02 * times[i])
            high[i] += change
            low[i] = max(low[i] - change, 0.1 * MIN_LAG) if i == LAG else low[i] - change
            found[i] = (errors(high) - errors(low)) / (high[i] - low[i])
        return found

    def cost(times: Array) -> float:
        return float((errors(times) ** 2).sum())

    total = max(delay - 0.5 * data.window, 2.0 * MIN_LAG)
    least = np.array([-data.window, 0.25 * MIN_LAG])
    shares = (0.05, 0.25, 0.5, 0.75, 0.95)
    starts = [np.array([total - share * total, max(share * total, MIN_LAG)]) for share in shares]
    times = min(starts, key=cost)
    for _ in range(ITERATIONS):
        design, missed = slopes(times).reshape(2, -1), errors(times).ravel()
        step = np.linalg.lstsq(design.T, -missed, rcond=None)[0]
        outward = (times <= least) & (step < 0.0)
        if outward.any():  # at a bound, along it
            step = np.zeros(2)
            step[~outward] = np.linalg.lstsq(design[~outward].T, -missed, rcond=None)[0]
        now, tried = cost(times), np.maximum(times + step, least)
        while cost(tried) >= now and np.abs(tried - times).max() >= 1e-7:
            step = 0.5 * step
            tried = np.maximum(times + step, least)
        if np.abs(tried - times).max() < 1e-7:
            break
        times = tried
    found = errors(times)
    return WheelFit(times, _covariance(slopes(times), found, data.time), found, data)


def _covariance(slopes: Array, errors: Array, time: Array) -> Array:
    """Return the covariance of tau and lambda for errors correlated over CORRELATION_TIME."""
    flat = slopes.reshape(2, -1)
    inverse = np.linalg.pinv(flat @ flat.T)
    scores = (slopes * errors).sum(axis=1)  # both wheels together: their errors are correlated
    spread = scores @ scores.T
    lags = max(1, round(CORRELATION_TIME / float(np.median(np.diff(time)))))
    for k in range(1, lags + 1):
        product = scores[:, k:] @ scores[:, :-k].T
        spread += (1.0 - k / (lags + 1.0)) * (product + product.T)
    white = float((errors**2).sum()) / (errors.size - 6)
    robust: Array = inverse @ spread @ inverse
    for i in (DEAD_TIME, LAG):
        # By chance the correlation may appear negative: never less than with white noise.
        robust[i, i] = max(robust[i, i], white * inverse[i, i])
    return robust
