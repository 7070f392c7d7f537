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
"""Entropies and largest Lyapunov exponent of sampled series, and what they are computed from."""

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array

_BLOCK = 512


def check_path(t: Array, x: Array, y: Array) -> None:
    """Raise ValueError when t, x, y are no path: shape (n,), n >= 2, finite, t increasing."""
    if not t.ndim == x.ndim == y.ndim == 1 or not t.size == x.size == y.size >= 2:
        raise ValueError(
            't, x, y must have one shape (n,) with n >= 2: '
            f'got {np.shape(t)}, {np.shape(x)}, {np.shape(y)}'
        )
    if not all(np.isfinite(each).all() for each in (t, x, y)):
        raise ValueError('t, x, y must be finite')
    if not (np.diff(t) > 0.0).all():
        raise ValueError('t must increase from sample to sample')


def resampled(t: Array, x: Array, y: Array, step: float) -> Array:
    """Return the positions at intervals of ``step`` (s), linearly interpolated, shape (m, 2).

    ValueError: not a path, see :func:`check_path`, or one shorter than a step.
    """
    check_path(t, x, y)
    duration = float(t[-1] - t[0])
    if not 0.0 < step <= duration:
        raise ValueError(f'step must be above 0 and at most {duration:g} s: got {step:g}')
    times = t[0] + step * np.arange(int(duration / step + 1e-9) + 1)
    return np.column_stack([np.interp(times, t, x), np.interp(times, t, y)])


def delay_vectors(series: Array, lags: Sequence[int]) -> Array:
    """Return one row (s[n - lag] for each lag) for each n that has them all.

    ``series`` has the shape (n, d), the result (n - lags[-1], d * len(lags)). ``lags`` are samples
    into the past, ascending from 0; row 0 is of n = lags[-1].
    """
    deepest = lags[-1]
    if not 0 <= deepest < len(series):
        raise ValueError(f'lags must be below the {len(series)} samples: got {deepest}')
    return np.hstack([series[deepest - lag : len(series) - lag] for lag in lags])


def square_distances(a: Array, b: Array) -> Array:
    """Return the squared Euclidean distances between rows, shape (len(a), len(b))."""
    squares: Array = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None, :] - 2.0 * a @ b.T
    return np.maximum(squares, 0.0)


def nearest_apart(points: Array, count: int, apart: int) -> NDArray[np.int64]:
    """Return the nearest neighbour of each of the first ``count`` points among the same.

    A neighbour is more than ``apart`` samples away in time (Theiler 1986: points of the same
    piece of the path are no recurrence) and at a distance above zero; -1 where there is none.
    """
    found = np.full(count, -1, dtype=np.int64)
    own = points[:count]
    places = np.arange(count)
    for start in range(0, count, _BLOCK):
        rows = places[start : start + _BLOCK]
        # Differences, not products: close neighbours would drown in rounding.
        squares = np.zeros((rows.size, count))
        for column in own.T:
            squares += (column[rows, None] - column[None, :]) ** 2
        squares[(np.abs(rows[:, None] - places[None, :]) <= apart) | (squares == 0.0)] = np.inf
        best = squares.argmin(axis=1)
        found[rows] = np.where(np.isfinite(squares[np.arange(rows.size), best]), best, -1)
    return found


# -- entropy --------------------------------------------------------------------------------------


def normalised_entropy(shares: Array) -> float:
    """Return the Shannon entropy of shares that add up to 1, relative to that of equal ones."""
    held = shares[shares > 0.0]
    return float(-(held * np.log(held)).sum() / math.log(shares.size)) + 0.0


def ordinal_shares(series: Array, order: int) -> Array:
    """Return how often each order of size of ``order`` values occurs, shape (order!,).

    Of equal values the earlier one counts as the smaller. The patterns are in the lexicographic
    order of the ranks.
    """
    windows = np.lib.stride_tricks.sliding_window_view(series, order).T
    ranks = windows.argsort(axis=0, kind='stable').argsort(axis=0, kind='stable')
    # The number of a permutation in the factorial number system (Lehmer code).
    number = np.zeros(ranks.shape[1], dtype=np.int64)
    for k in range(order):
        smaller = (ranks[k + 1 :] < ranks[k]).sum(axis=0)
        number += smaller * math.factorial(order - 1 - k)
    return np.bincount(number, minlength=math.factorial(order)) / number.size


def permutation_entropy(series: Array, order: int = 4) -> float:
    """Return the entropy of the ordinal patterns, from 0 (monotone) to 1 (white noise).

    Bandt and Pompe, Phys. Rev. Lett. 88, 2002 (doi 10.1103/PhysRevLett.88.174102), divided by
    ln(order!). From N patterns white noise gives about (order! - 1) / (2 N ln(order!)) less
    than 1.

    ``series`` are uniform samples, shape (n,); ``order`` is the number of values in a pattern.
    """
    return normalised_entropy(ordinal_shares(series, order))


SEGMENT = 64
"""Samples of a segment of the spectrum, which has half as many frequencies."""


def spectral_entropy(series: Array) -> float:
    r"""Return the entropy of the power spectrum, from 0 (one line) to 1 (all alike).

    Shannon entropy of the shares of power of the frequencies above zero, relative to that of a
    flat spectrum (Inouye et al., Electroencephalogr. Clin. Neurophysiol. 79, 1991,
    doi 10.1016/0013-4694(91)90138-T). The spectrum is Welch's, with Hann windows that do not
    overlap. From K segments with N frequencies white noise gives about

    .. math:: 1 - (\psi(K + 1) - \ln K) / \ln N, \qquad \psi(K + 1) - \ln K \approx 1 / (2 K)

    NaN for a constant series. ``series`` are at least :data:`SEGMENT` uniform samples, shape (n,).
    """
    count = series.size // SEGMENT
    pieces = series[: count * SEGMENT].reshape(count, SEGMENT)
    pieces = pieces - series.mean()
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(SEGMENT) / SEGMENT)
    power = (np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2).mean(axis=0)[1:]
    total = power.sum()
    if total <= 1e-24 * SEGMENT**2 * max(1.0, float(np.abs(series).max()) ** 2):
        return math.nan
    return normalised_entropy(power / total)


# -- exponent -------------------------------------------------------------------------------------


FITTED = 0.8
"""Share of the way of the logarithmic distance that is fitted."""


def divergence(points: Array, step: float, apart: int, horizon: int) -> float:
    """Return the largest exponent (1/s) by the method of Rosenstein, Collins and De Luca.

    Physica D 65, 1993 (doi 10.1016/0167-2789(93)90009-P): the slope of the mean logarithmic
    distance of each point from its nearest neighbour, both followed in time. The slope is that
    of a straight line, by least squares, over the first part of the way of the distance, in
    logarithms, to that of two random points: beyond it the size of the attractor bounds the
    distance. It is within 6 % for the logistic map, the Hénon map and the Lorenz system from 3000
    to 5000 points.

    Any data give a number. Noise has no exponent: there the number grows without bound as the
    samples become denser, and compares only with that of other paths of the same sampling.

    ``points`` are delay vectors or states at times ``step`` (s) apart, shape (n, d); neighbours
    are more than ``apart`` samples from each other in time, about a mean period, and are followed
    for ``horizon`` samples. ValueError: there are too few points, or no point has a neighbour.
    """
    count = len(points) - horizon
    if horizon < 2 or count <= apart + 1:
        raise ValueError(
            f'points must be more than horizon + apart + 1 = {horizon + apart + 1}, with '
            f'horizon >= 2: got {len(points)} and {horizon}'
        )
    neighbour = nearest_apart(points, count, apart)
    own = np.flatnonzero(neighbour >= 0)
    if not own.size:
        raise ValueError('no point has a neighbour at a distance above zero')
    other = neighbour[own]
    logs = np.empty(horizon + 1)
    for k in range(horizon + 1):
        logs[k] = _mean_log(points[own + k] - points[other + k])
    # Points half of the data apart stand for random pairs.
    half = len(points) // 2
    limit = _mean_log(points[: len(points) - half] - points[half:])
    time: Array = step * np.arange(horizon + 1, dtype=np.float64)
    reached = np.flatnonzero(logs >= logs[0] + FITTED * (limit - logs[0]))
    last = int(reached[0]) if reached.size else horizon
    rows = slice(0, max(last, 2) + 1)  # three points at least
    return float(np.polyfit(time[rows], logs[rows], 1)[0])


def _mean_log(differences: Array) -> float:
    squares = (differences * differences).sum(axis=1)
    squares = squares[squares > 0.0]
    return float(0.5 * np.log(squares).mean()) if squares.size else -np.inf
