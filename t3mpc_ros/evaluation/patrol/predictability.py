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
"""How well an observer who watched the first half of a path predicts the second half.

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
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.patrol.time_series_analysis import (
    delay_vectors,
    resampled,
    square_distances,
)
from t3mpc_ros.geometry.types import Array

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
    each = {CLIMATOLOGY: np.zeros(steps.size)}
    errors = {CLIMATOLOGY: np.hypot(*(path[:half].mean(axis=0) - target).transpose(2, 0, 1))}
    for name, predict in _PREDICTORS.items():
        found = predict(path, half, origins, steps)
        each[name] = 1.0 - _square_errors(found, target) / climatology
        errors[name] = np.hypot(*(found - target).transpose(2, 0, 1))
    best = [max(each, key=lambda name: each[name][row]) for row in range(steps.size)]
    return tuple(
        Skill(
            horizon,
            float(each[best[row]][row]),
            best[row],
            float(np.sqrt((1.0 - each[best[row]][row]) * climatology[row])),
            float(np.median(errors[best[row]][row])),
            float((errors[best[row]][row] < KNOWN).mean()),
        )
        for row, horizon in enumerate(HORIZONS)
    )


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
