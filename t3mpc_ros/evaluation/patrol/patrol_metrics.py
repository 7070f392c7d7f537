# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""All figures of a patrol from its path."""

from collections.abc import Mapping
from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.evaluation.patrol.coverage import (
    CoverageGrid,
    Visits,
    coverage_at,
    evenness,
    time_to_cover,
    visits,
)
from t3mpc_ros.evaluation.patrol.predictability import HORIZONS, Skill, predictability
from t3mpc_ros.evaluation.patrol.time_series import (
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
_SEGMENT = 64


@dataclass(frozen=True)
class PatrolMetrics:
    """Figures of one patrol; NaN where the path is too short or a quantity is not known."""

    duration: float
    """s"""
    distance: float
    """Length of the path, m."""
    coverage: float
    """Share of the free cells entered."""
    times: Mapping[float, float]
    """Time (s) until a share of the cells is entered, by :data:`SHARES`; inf if it is not."""
    evenness: float
    """See :func:`~t3mpc_ros.evaluation.patrol.coverage.evenness`."""
    exponent: float
    """Largest Lyapunov exponent of the path, 1/s."""
    permutation_entropy: float
    """Of patterns of 4 positions 1 s apart, mean of x and y."""
    spectral_entropy: float
    """Of the displacements per second, mean of x and y."""
    skills: tuple[Skill, ...]
    """Skill of an observer at 1, 2, 5 and 10 s; empty for a path that is too short."""
    path_error: float = math.nan
    """Root mean square distance from the reference at the same time, m."""
    visits: Visits | None = None
    """What the coverage was computed from."""

    def skill(self, horizon: float) -> float:
        """Return the skill of the observer at a horizon (s); NaN if it was not computed."""
        return next((each.best for each in self.skills if each.horizon == horizon), math.nan)

    def prediction_error(self, horizon: float) -> float:
        """Return the error (m) of the observer at a horizon (s); NaN if it was not computed."""
        return next((each.error for each in self.skills if each.horizon == horizon), math.nan)

    def record(self) -> dict[str, object]:
        """Return the numbers for a JSON file."""
        return {
            'duration': self.duration,
            'distance': self.distance,
            'coverage': self.coverage,
            **{f'time_to_{100.0 * share:g}': self.times[share] for share in SHARES},
            'evenness': self.evenness,
            'exponent': self.exponent,
            'permutation_entropy': self.permutation_entropy,
            'spectral_entropy': self.spectral_entropy,
            **{f'skill_{each.horizon:g}': each.best for each in self.skills},
            **{f'prediction_error_{each.horizon:g}': each.error for each in self.skills},
            'path_error': self.path_error,
        }


def patrol_metrics(
    t: Array,
    x: Array,
    y: Array,
    grid: CoverageGrid,
    reference: Array | None = None,
    *,
    whole: bool = True,
) -> PatrolMetrics:
    """Return all figures of a path.

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
        Not a path: see :func:`~t3mpc_ros.evaluation.patrol.time_series.check_path`.
    """
    found = visits(t, x, y, grid)
    exponent = permutation = spectral = math.nan
    skills: tuple[Skill, ...] = ()
    if whole and found.duration >= SHORTEST:
        recent = t >= t[-1] - LONGEST
        t, px, py = t[recent], x[recent], y[recent]
        exponent = path_exponent(t, px, py)
        seconds = resampled(t, px, py, 1.0)
        permutation = float(np.mean([permutation_entropy(axis) for axis in seconds.T]))
        moves = np.diff(seconds, axis=0)
        spectral = float(np.mean([spectral_entropy(axis, _SEGMENT) for axis in moves.T]))
        skills = predictability(t, px, py, HORIZONS)
    error = math.nan
    if reference is not None:
        squares = ((np.column_stack([x, y]) - reference) ** 2).sum(axis=1)
        if (counted := np.isfinite(squares)).any():
            error = math.sqrt(float(squares[counted].mean()))
    return PatrolMetrics(
        duration=found.duration,
        distance=float(np.hypot(np.diff(x), np.diff(y)).sum()),
        coverage=float(coverage_at(found, grid, np.array([found.duration]))[0]),
        times={share: time_to_cover(found, grid, share) for share in SHARES},
        evenness=evenness(found, grid),
        exponent=exponent,
        permutation_entropy=permutation,
        spectral_entropy=spectral,
        skills=skills,
        path_error=error,
        visits=found,
    )


def path_exponent(t: Array, x: Array, y: Array) -> float:
    """Return the largest Lyapunov exponent of a path, 1/s; NaN if it never moves.

    By :func:`~t3mpc_ros.evaluation.patrol.time_series.divergence` of delay vectors of x and y
    with 0, 1 and 2 s of past; neighbours are more than 10 s apart and followed for 20 s.
    """
    points = delay_vectors(resampled(t, x, y, _STEP), _EXPONENT_LAGS)
    if not np.ptp(points, axis=0).any():
        return math.nan
    return divergence(points, _STEP, _APART, _FOLLOWED).exponent
