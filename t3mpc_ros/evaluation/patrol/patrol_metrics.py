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
"""All figures of a patrol from its path: coverage, evenness, entropies, exponent and skill.

The observer records positions without error, learns from the first half alone, and then states at
each instant of the second half where the robot will be, from what he has seen up to then. He has
several predictors, each fitted separately for each horizon:

* persistence: the robot stays where it is; constant velocity; an arc of constant speed and turn
  rate;
* linear: ridge regression on delay vectors (an autoregression);
* analogues: the mean of what followed the most similar delay vectors of the first half
  (Lorenz, J. Atmos. Sci. 26, 1969, doi 10.1175/1520-0469(1969)26<636:APARBN>2.0.CO;2; Farmer and
  Sidorowich, Phys. Rev. Lett. 59, 1987, doi 10.1103/PhysRevLett.59.845);
* kernel: kernel ridge regression with a Gaussian kernel on delay vectors (Saunders, Gammerman and
  Vovk, ICML 1998).

Their settings are chosen on the last third of the first half. For each horizon the predictor that
turns out best **on the second half** counts, which is in favour of the observer: the figure is an
upper bound of what these predictors attain.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
import math
from typing import Any, NamedTuple

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

    It is more than ``apart`` samples away in time (Theiler 1986: points of the same piece of the
    path are no recurrence) and at a distance above zero; -1 where there is none.
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


# -- observer -------------------------------------------------------------------------------------


STEP = 0.25
"""Interval of the observations, s."""
HORIZONS = (1.0, 2.0, 5.0, 10.0)
"""s; multiples of :data:`STEP`"""
CLIMATOLOGY = 'climatology'
KNOWN = 0.25
"""Error below which a place is known, m."""

_LAGS = ((0, 1, 2, 4), (0, 1, 2, 4, 8, 12, 16), (0, 1, 2, 4, 8, 12, 16, 24, 32, 40, 48))
"""Past of the delay vectors, in steps: 1, 4 and 12 s."""
_MOST = 1200
"""Most examples of the kernel, whose cost grows with their cube: all of ten minutes."""
_TRAINING = 2.0 / 3.0
"""Share of the first half that is learnt from when settings are chosen."""


class Skill(NamedTuple):
    """Skill at one horizon: 1 exact, 0 as good as the mean position of the first half."""

    horizon: float
    """s"""
    best: float
    """That of the best predictor, at least 0: climatology is one of them."""
    predictor: str
    """Its name."""
    error: float
    """Root mean square error of the best predictor, m. Unlike the skill it does not depend on how
    far the path spreads: of two paths that surprise equally, the one that covers more of the room
    has the higher skill."""
    median: float
    """Median error of it, m."""
    known: float
    """Share of the moments at which its error is below :data:`KNOWN`."""


def predictability(t: Array, x: Array, y: Array) -> tuple[Skill, ...]:
    r"""Return the skill of the observer at each of :data:`HORIZONS`.

    With the mean position m of the first half, over the second half:

    .. math:: s(h) = 1 - \frac{\sum_n |\hat p_n(h) - p(t_n + h)|^2}{\sum_n |m - p(t_n + h)|^2}

    Times (s) and positions (m), shape (n,), are sampled again every :data:`STEP` seconds. Raises
    ValueError for a path that is too short: each half must last 24 s and three of the longest
    horizon.
    """
    path = resampled(t, x, y, STEP)
    steps = np.array([round(horizon / STEP) for horizon in HORIZONS], dtype=np.int64)
    half, longest = len(path) // 2, int(steps.max())
    least = max(2 * _LAGS[-1][-1], 3 * longest)
    if half < least:
        raise ValueError(
            f'the path must last at least {2 * least * STEP:g} s for horizons up to '
            f'{max(HORIZONS):g} s: got {len(path) * STEP:g} s'
        )
    origins = np.arange(half, len(path) - longest)
    target = _positions(path, origins, steps)
    climatology = _square_errors(path[:half].mean(axis=0), target)
    if climatology.min() <= 0.0:  # a robot that stands where it stood
        return tuple(Skill(h, 1.0, CLIMATOLOGY, 0.0, 0.0, 1.0) for h in HORIZONS)
    skills = {CLIMATOLOGY: np.zeros(steps.size)}
    errors = {CLIMATOLOGY: np.hypot(*(path[:half].mean(axis=0) - target).transpose(2, 0, 1))}
    for name, predict in _PREDICTORS.items():
        found = predict(path, half, origins, steps)
        skills[name] = 1.0 - _square_errors(found, target) / climatology
        errors[name] = np.hypot(*(found - target).transpose(2, 0, 1))
    best = []
    for row, horizon in enumerate(HORIZONS):
        reached = {name: float(each[row]) for name, each in skills.items()}
        name = max(reached, key=reached.__getitem__)
        skill = reached[name]
        error = math.sqrt((1.0 - skill) * climatology[row])
        known = float((errors[name][row] < KNOWN).mean())
        median = float(np.median(errors[name][row]))
        best.append(Skill(horizon, skill, name, error, median, known))
    return tuple(best)


Rows = NDArray[np.int64]
Predictor = Callable[[Array, int, Rows, Rows], Array]
"""Returns the positions some steps after some origins, shape (steps, origins, 2), m, given the
path up to each origin for its input, and the first ``half`` samples to learn from."""


def _positions(path: Array, origins: Rows, steps: Rows) -> Array:
    found: Array = path[origins[None, :] + steps[:, None]]
    return found


def _square_errors(estimate: Array, target: Array) -> Array:
    """Return the mean square error of each step, shape (steps,)."""
    errors: Array = ((estimate - target) ** 2).sum(axis=2).mean(axis=1)
    return errors


def _persistence(path: Array, half: int, origins: Rows, steps: Rows) -> Array:
    return np.repeat(path[None, origins], steps.size, axis=0)


def _constant_velocity(path: Array, half: int, origins: Rows, steps: Rows) -> Array:
    moved = path[origins] - path[origins - 1]
    return path[None, origins] + steps[:, None, None] * moved[None]


def _constant_turn(path: Array, half: int, origins: Rows, steps: Rows) -> Array:
    """Continue the last two displacements as an arc, whose chords turn by equal angles."""
    moved = np.diff(path, axis=0) @ np.array([1.0, 1.0j])
    last, before = moved[origins - 1], moved[origins - 2]
    turn = np.angle(last * before.conj())  # zero at rest
    ahead = np.cumsum(np.exp(1j * turn[None, :] * np.arange(1, steps.max() + 1)[:, None]), axis=0)
    reached = last[None, :] * ahead[steps - 1]
    found: Array = path[None, origins] + np.stack([reached.real, reached.imag], axis=2)
    return found


class _Examples(NamedTuple):
    """Delay vectors and the displacements that followed each."""

    inputs: Array
    """Shape (n, d), standardised."""
    outputs: Array
    """m, shape (n, 2 * steps)."""


Fit = Callable[[_Examples, Array], Array]
"""Returns the displacements that follow some inputs, shape (n, 2 * steps), learnt from
the examples."""


def _inputs(path: Array, lags: Sequence[int], origins: Rows, half: int) -> Array:
    """Return position and past displacements, each in its spread over the first half."""
    rows = delay_vectors(path, lags)
    rows = np.hstack([rows[:, :2], rows[:, :-2] - rows[:, 2:]])
    learnt = rows[: half - lags[-1]]
    spread = learnt.std(axis=0)
    spread[spread < 1e-9] = 1.0
    scaled: Array = (rows[origins - lags[-1]] - learnt.mean(axis=0)) / spread
    return scaled


def _examples(path: Array, lags: Sequence[int], end: int, half: int, steps: Rows) -> _Examples:
    """Return the examples whose outcomes are before sample ``end``."""
    origins = np.arange(lags[-1], end - steps.max())
    outcome = _positions(path, origins, steps) - path[None, origins]
    return _Examples(
        _inputs(path, lags, origins, half),
        outcome.transpose(1, 0, 2).reshape(origins.size, 2 * steps.size),
    )


def _fit_linear(examples: _Examples, inputs: Array, ridge: float) -> Array:
    rows = np.hstack([examples.inputs, np.ones((len(examples.inputs), 1))])
    normal = rows.T @ rows + ridge * len(rows) * np.eye(rows.shape[1])
    weights = np.linalg.solve(normal, rows.T @ examples.outputs)
    found: Array = np.hstack([inputs, np.ones((len(inputs), 1))]) @ weights
    return found


def _fit_analogues(examples: _Examples, inputs: Array, neighbours: int) -> Array:
    count = min(neighbours, len(examples.inputs))
    squares = square_distances(inputs, examples.inputs)
    nearest = np.argpartition(squares, count - 1, axis=1)[:, :count]
    weights = 1.0 / (np.take_along_axis(squares, nearest, axis=1) + 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    found: Array = (weights[:, :, None] * examples.outputs[nearest]).sum(axis=1)
    return found


def _fit_kernel(examples: _Examples, inputs: Array, width: float, ridge: float) -> Array:
    every = -(-len(examples.inputs) // _MOST)
    examples = _Examples(examples.inputs[::every], examples.outputs[::every])
    squares = square_distances(examples.inputs, examples.inputs)
    scale = 2.0 * width**2 * float(np.median(squares)) + 1e-12
    gram = np.exp(-squares / scale)
    gram[np.diag_indices_from(gram)] += ridge
    weights = np.linalg.solve(gram, examples.outputs)
    found: Array = np.exp(-square_distances(inputs, examples.inputs) / scale) @ weights
    return found


_SETTINGS: dict[str, list[tuple[Sequence[int], Fit]]] = {
    'linear': [
        (lags, partial(_fit_linear, ridge=ridge))
        for lags in _LAGS
        for ridge in (1e-6, 1e-3, 1e-1, 1e1)
    ],
    'analogues': [
        (lags, partial(_fit_analogues, neighbours=neighbours))
        for lags in _LAGS
        for neighbours in (1, 5, 20)
    ],
    'kernel': [
        (lags, partial(_fit_kernel, width=width, ridge=ridge))
        for lags in _LAGS[:2]
        for width, ridge in ((0.5, 1e-2), (1.0, 1e-3), (1.0, 1e-1))
    ],
}
"""Delay vectors and fit of each setting; widths in median distances."""


def _learnt(name: str, path: Array, half: int, origins: Rows, steps: Rows) -> Array:
    """Return the predictions, for each step with the setting that its last third prefers."""

    def predicted(setting: tuple[Sequence[int], Fit], end: int, rows: Rows) -> Array:
        lags, fit = setting
        moved = fit(_examples(path, lags, end, half, steps), _inputs(path, lags, rows, half))
        found: Array = moved.reshape(rows.size, steps.size, 2).transpose(1, 0, 2)
        return path[None, rows] + found

    split = round(_TRAINING * half)
    checked = np.arange(split, half - steps.max())
    target = _positions(path, checked, steps)
    settings = _SETTINGS[name]
    errors = np.array(
        [_square_errors(predicted(each, split, checked), target) for each in settings]
    )
    chosen = errors.argmin(axis=0)
    answers = {row: predicted(settings[row], half, origins) for row in set(chosen.tolist())}
    return np.stack([answers[row][step] for step, row in enumerate(chosen.tolist())])


_PREDICTORS: dict[str, Predictor] = {
    'persistence': _persistence,
    'constant velocity': _constant_velocity,
    'constant turn': _constant_turn,
    **{name: partial(_learnt, name) for name in _SETTINGS},
}


# -- coverage, and all figures --------------------------------------------------------------------


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
