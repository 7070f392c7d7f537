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
"""All figures of a patrol from its path: coverage, evenness, entropies, exponent and skill."""

from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.patrol.predictability import (
    check_path,
    delay_vectors,
    divergence,
    normalised_entropy,
    permutation_entropy,
    predictability,
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


@dataclass(frozen=True)
class CoverageGrid:
    """Cells of a rectangle, without those that the robot cannot enter."""

    low: tuple[float, float]
    """Smallest x and y, m."""
    high: tuple[float, float]
    """Largest x and y, m."""
    columns: int = 20
    rows: int = 20
    blocked: NDArray[np.bool_] | None = None
    """Cells that do not count, shape (rows, columns), row 0 at the smallest y."""

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f'low must be below high: got {self.low}, {self.high}')
        if not self.free.any():
            raise ValueError('blocked must leave at least one cell free')

    @property
    def free(self) -> NDArray[np.bool_]:
        """Cells that count, shape (rows, columns)."""
        if self.blocked is None:
            return np.ones((self.rows, self.columns), dtype=np.bool_)
        return ~self.blocked

    @property
    def cell(self) -> tuple[float, float]:
        """Width and height of a cell, m."""
        return (
            (self.high[0] - self.low[0]) / self.columns,
            (self.high[1] - self.low[1]) / self.rows,
        )

    def centres(self) -> Array:
        """Return the centres of all cells (m), shape (rows, columns, 2)."""
        width, height = self.cell
        x = self.low[0] + width * (np.arange(self.columns) + 0.5)
        y = self.low[1] + height * (np.arange(self.rows) + 0.5)
        return np.stack(np.meshgrid(x, y), axis=-1)


class Visits(NamedTuple):
    """What the centre of a robot did in each cell, shapes (rows, columns)."""

    first: Array
    """Time of the first entry since the start, s; inf where there was none."""
    dwell: Array
    """Time spent, s."""
    duration: float
    """s"""


def visits(t: Array, x: Array, y: Array, grid: CoverageGrid) -> Visits:
    """Return first entry and dwell of each cell by the straight lines between the samples.

    A line is divided into pieces of at most a quarter of a cell, so that fast motion skips none
    but a corner. Time outside the grid or in blocked cells is not counted.
    """
    check_path(t, x, y)
    width, height = grid.cell
    u, v = (x - grid.low[0]) / width, (y - grid.low[1]) / height
    length = np.hypot(np.diff(u), np.diff(v))
    pieces = np.maximum(1, np.ceil(4.0 * length)).astype(np.int64)
    row = np.repeat(np.arange(t.size - 1), pieces)
    within = np.arange(row.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (within + 0.5) / pieces[row]  # the middle of each piece
    step = (np.diff(t) / pieces)[row]
    column = np.floor(u[row] + share * np.diff(u)[row]).astype(np.int64)
    line = np.floor(v[row] + share * np.diff(v)[row]).astype(np.int64)
    entered = t[row] - t[0] + within / pieces[row] * np.diff(t)[row]
    inside = (column >= 0) & (column < grid.columns) & (line >= 0) & (line < grid.rows)
    place = line[inside] * grid.columns + column[inside]
    count = grid.rows * grid.columns
    first = np.full(count, math.inf)
    np.minimum.at(first, place, entered[inside])
    dwell = np.bincount(place, weights=step[inside], minlength=count)
    shape = grid.rows, grid.columns
    free = grid.free
    return Visits(
        np.where(free, first.reshape(shape), math.inf),
        np.where(free, dwell.reshape(shape), 0.0),
        float(t[-1] - t[0]),
    )


def coverage_at(found: Visits, grid: CoverageGrid, times: Array) -> Array:
    """Return the share of free cells entered up to each time (s since the start), shape (n,)."""
    order = np.sort(found.first[grid.free])
    return np.searchsorted(order, times, side='right') / order.size


def time_to_cover(found: Visits, grid: CoverageGrid, share: float) -> float:
    """Return the time until ``share`` of the free cells is entered, s; inf if it is not."""
    if not 0.0 < share <= 1.0:
        raise ValueError(f'share must be above 0 and at most 1: got {share}')
    order = np.sort(found.first[grid.free])
    return float(order[math.ceil(share * order.size - 1e-9) - 1])


def evenness(found: Visits, grid: CoverageGrid) -> float:
    r"""Return how evenly the time is spread: 1 the same in each free cell, 0 all in one.

    Pielou's evenness (J. Theor. Biol. 13, 1966, doi 10.1016/0022-5193(66)90013-0), the Shannon
    entropy of the shares p of time, relative to its largest value for S free cells:

    .. math:: J = -\sum_i p_i \ln p_i / \ln S

    NaN for a path that never enters a free cell or a grid of one cell.
    """
    dwell = found.dwell[grid.free]
    total = dwell.sum()
    if total <= 0.0 or dwell.size < 2:
        return math.nan
    return normalised_entropy(dwell / total)


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
    not; ``evenness``, see :func:`evenness`; ``exponent``, see :func:`path_exponent`;
    ``permutation_entropy`` of patterns of 4 positions 1 s apart and ``spectral_entropy`` of the
    displacements per second, means of x and y; ``skill_5``, ``prediction_error_5`` (m),
    ``prediction_median_5`` (m), ``known_5`` (share of the moments known to 25 cm) and
    ``predictor_5``, the best predictor, of an observer 5 s ahead, for each of :data:`.HORIZONS`,
    absent for a path that is too short; ``path_error``, root mean square distance from the
    ``reference`` at the same time (m), which is NaN where it does not count, shape (n, 2).

    Times (s) and positions (m) of the robot's centre have the shape (n,); of a path that is not
    ``whole``, but has gaps, exponent, entropies and skills are left out. ValueError: not a path,
    see :func:`.check_path`.
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

    By :func:`.divergence` of delay vectors of x and y with 0, 1 and 2 s of past; neighbours are
    more than 10 s apart and followed for 20 s.
    """
    points = delay_vectors(resampled(t, x, y, _STEP), _EXPONENT_LAGS)
    if not np.ptp(points, axis=0).any():
        return math.nan
    return divergence(points, _STEP, _APART, _FOLLOWED)
