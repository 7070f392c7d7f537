# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Uniform sampling, delay vectors and nearest neighbours of a path."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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

    Raises
    ------
    ValueError
        Not a path, see :func:`check_path`, or one shorter than a step.
    """
    check_path(t, x, y)
    duration = float(t[-1] - t[0])
    if not 0.0 < step <= duration:
        raise ValueError(f'step must be above 0 and at most {duration:g} s: got {step:g}')
    times = t[0] + step * np.arange(int(duration / step + 1e-9) + 1)
    return np.column_stack([np.interp(times, t, x), np.interp(times, t, y)])


def delay_vectors(series: Array, lags: Sequence[int]) -> Array:
    """Return one row (s[n - lag] for each lag) for each n that has them all.

    Parameters
    ----------
    series
        Shape (n, d).
    lags
        Samples into the past, in increasing order, the first one 0; row 0 is of n = lags[-1].

    Returns
    -------
    Array
        Shape (n - lags[-1], d * len(lags)).
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
