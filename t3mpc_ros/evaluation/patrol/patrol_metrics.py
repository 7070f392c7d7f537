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
"""All figures of a patrol from its path."""

import math
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.patrol.coverage import (
    CoverageGrid,
    coverage_at,
    evenness,
    time_to_cover,
    visits,
)
from t3mpc_ros.evaluation.patrol.predictability import predictability
from t3mpc_ros.evaluation.patrol.time_series_analysis import (
    delay_vectors,
    divergence,
    permutation_entropy,
    resampled,
    spectral_entropy,
)
from t3mpc_ros.geometry.types import Array

SHARES = (0.5, 0.9, 0.95)
"""Shares of the grid whose times are measured."""
SHORTEST = 128.0
"""Shortest path with an exponent, entropies and skills, s: two segments of the spectrum."""
LONGEST = 1800.0
"""Of longer paths the last part of so many seconds counts for them: their cost is quadratic."""

_STEP = 0.25
_EXPONENT_LAGS = (0, 4, 8)
_APART, _FOLLOWED = 40, 80


def patrol_metrics(
    t: Array,
    x: Array,
    y: Array,
    grid: CoverageGrid,
    reference: Array | None = None,
    *,
    whole: bool = True,
) -> dict[str, Any]:
    """Return all figures of a path by name; NaN where it is too short or they are not known.

    ``duration`` (s); ``distance``, length of the path (m); ``coverage``, share of the free cells
    entered; ``time_to_90`` (s) until 90 % of them are, for each of :data:`SHARES`, inf if they are
    not; ``evenness``, see :func:`~t3mpc_ros.evaluation.patrol.coverage.evenness`; ``exponent``,
    largest Lyapunov exponent of the path (1/s); ``permutation_entropy`` of patterns of 4 positions
    1 s apart and ``spectral_entropy`` of the displacements per second, means of x and y;
    ``skill_5``, ``prediction_error_5`` (m), ``prediction_median_5`` (m), ``known_5`` (share of the
    moments known to 25 cm) and ``predictor_5``, the best predictor, of an observer 5 s ahead, for
    each of :data:`HORIZONS`, absent for a path that is too short; ``path_error``,
    root mean square distance from the reference at the same time (m).

    Parameters
    ----------
    t, x, y
        Times (s) and positions (m) of the robot's centre, shape (n,).
    grid
        Cells to cover.
    reference
        Positions at which the robot should be at the same times, m, shape (n, 2), NaN where they
        do not count.
    whole
        Whether the path has no gap: else exponent, entropies and skills are left out.

    Raises
    ------
    ValueError
        Not a path: see :func:`~t3mpc_ros.evaluation.patrol.time_series_analysis.check_path`.
    """
    found = visits(t, x, y, grid)
    exponent = permutation = spectral = error = math.nan
    observed: dict[str, Any] = {}
    if whole and found.duration >= SHORTEST:
        recent = t >= t[-1] - LONGEST
        late, px, py = t[recent], x[recent], y[recent]
        exponent = path_exponent(late, px, py)
        seconds = resampled(late, px, py, 1.0)
        permutation = float(np.mean([permutation_entropy(axis) for axis in seconds.T]))
        moves = np.diff(seconds, axis=0)
        spectral = float(np.mean([spectral_entropy(axis) for axis in moves.T]))
        skills = predictability(late, px, py)
        for name, of in (
            ('skill', 'best'),
            ('prediction_error', 'error'),
            ('prediction_median', 'median'),
            ('known', 'known'),
            ('predictor', 'predictor'),
        ):
            observed |= {f'{name}_{each.horizon:g}': getattr(each, of) for each in skills}
    if reference is not None:
        squares = ((np.column_stack([x, y]) - reference) ** 2).sum(axis=1)
        if (counted := np.isfinite(squares)).any():
            error = math.sqrt(float(squares[counted].mean()))
    return {
        'duration': found.duration,
        'distance': float(np.hypot(np.diff(x), np.diff(y)).sum()),
        'coverage': float(coverage_at(found, grid, np.array([found.duration]))[0]),
        **{f'time_to_{100.0 * share:g}': time_to_cover(found, grid, share) for share in SHARES},
        'evenness': evenness(found, grid),
        'exponent': exponent,
        'permutation_entropy': permutation,
        'spectral_entropy': spectral,
        **observed,
        'path_error': error,
    }


def path_exponent(t: Array, x: Array, y: Array) -> float:
    """Return the largest Lyapunov exponent of a path, 1/s; NaN if it never moves.

    By :func:`~t3mpc_ros.evaluation.patrol.time_series_analysis.divergence` of delay vectors of x
    and y with 0, 1 and 2 s of past; neighbours are more than 10 s apart and followed for 20 s.
    """
    points = delay_vectors(resampled(t, x, y, _STEP), _EXPONENT_LAGS)
    if not np.ptp(points, axis=0).any():
        return math.nan
    return divergence(points, _STEP, _APART, _FOLLOWED)
