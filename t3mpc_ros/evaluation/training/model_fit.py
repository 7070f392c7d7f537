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
"""Fit of a model, predictor and fuzzy coefficients, to training data, and its cross-validation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
import math
import warnings

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import Nt3fsMpcParameters
from t3mpc_ros.evaluation.proposed_method import random_output_weights
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.training.training_data import TrainingData, TrainingError
from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.mpc.boltzmann_machine import BoltzmannMachine, LayerSizes, make_machine
from t3mpc_ros.mpc.online_learning_predictor import Predictor
from t3mpc_ros.mpc.predictive_controller import (
    PredictiveController,
    PredictiveParameters,
    learning_constants,
)
from t3mpc_ros.mpc.pretraining import SampleTiming, nominal_step_response

# -- predictor ------------------------------------------------------------------------------------

Segment = list[tuple[Array, Array]]
"""Errors and moves of each wheel without a gap, newest first as in the Boltzmann machine."""


@dataclass(frozen=True)
class MoveEffect:
    """Identified effect of v_p on the error."""

    response: float
    """Change of the error per lasting change of v_p, (rad/s)/(rad/s²)."""
    error: float
    """Standard error of the gain; infinite when it is not identifiable."""
    own: float
    """Standard deviation of the part of v_p that errors and older v_p do not predict, rad/s²."""


def estimate_move_effect(
    errors: Array, moves: Array, delta_lags: int, move_lags: int, ahead: int
) -> MoveEffect:
    r"""Return the effect of v_p ``ahead`` periods on, by least squares on the lags of (35).

    .. math:: \delta_t = \sum_{i=1}^{n_a} a_i \delta_{t-i} + \sum_{i=1}^{n_b} b_i v_{p,t-i} + w_t

    The standard error is that of the step response of this model, by its gradient (the delta
    method) and the covariance s² (XᵀX)^-1 of the coefficients (Ljung, System Identification,
    1999, chapter 9). In a closed loop v_p is nearly a function of the errors, so XᵀX is nearly
    singular unless something else moves it.

    Errors and moves are *newest first*, NaN where unknown, shape (N,).
    """
    count = errors.size - max(delta_lags, move_lags)
    nothing = MoveEffect(math.nan, math.inf, 0.0)
    if count < 1:
        return nothing
    lags = [errors[i : i + count] for i in range(1, delta_lags + 1)]
    lags += [moves[i : i + count] for i in range(1, move_lags + 1)]
    table = np.stack([errors[:count], *lags], axis=1)
    table = table[np.isfinite(table).all(axis=1)]
    known, target = table[:, 1:], table[:, 0]
    if len(table) <= 2 * known.shape[1]:
        return nothing
    newest, others = known[:, delta_lags], np.delete(known, delta_lags, axis=1)
    own = newest - others @ np.linalg.lstsq(others, newest, rcond=None)[0]
    spread = math.sqrt(float(own @ own) / len(table))
    if np.linalg.matrix_rank(known) < known.shape[1]:
        return replace(nothing, own=spread)
    values = np.linalg.lstsq(known, target, rcond=None)[0]
    missed = target - known @ values
    variance = float(missed @ missed) / (len(table) - values.size)
    covariance = variance * np.linalg.inv(known.T @ known)
    response = _response(values, delta_lags, ahead)
    slope = np.empty(values.size)
    for i, value in enumerate(values):
        step = 1e-6 * max(abs(value), 1e-3)
        moved = values.copy()
        moved[i] += step
        slope[i] = (_response(moved, delta_lags, ahead) - response) / step
    return MoveEffect(response, math.sqrt(float(slope @ covariance @ slope)), spread)


def _response(values: Array, delta_lags: int, ahead: int) -> float:
    """Return the error ``ahead`` periods after a unit step of v_p."""
    a, b = values[:delta_lags], values[delta_lags:]
    errors, moves = np.zeros(a.size), np.zeros(b.size)
    for _ in range(ahead):
        moves[1:] = moves[:-1].copy()
        moves[0] = 1.0
        new = float(a @ errors + b @ moves)
        errors[1:] = errors[:-1].copy()
        errors[0] = new
    return float(errors[0])


MIN_EXCITATION = 10.0
"""Least amount of usable data, s."""
JUDGED = 20
"""Least predictive periods without a gap for an evaluation."""
UNCERTAIN = 0.5
"""Largest standard error of the effect of v_p, as a share of the nominal one: at twice this an
effect could not be distinguished from none."""
PASSES, SHARE = 12, 0.1
"""Passes over a run, and mu of the first pass."""
SETTLING = 0.5
"""Start of every segment that is excluded from the fit, s: the estimate settles."""


@dataclass(frozen=True)
class PredictorFit:
    """Fitted predictor."""

    weights: dict[str, Array]
    """Weights as :meth:`PredictiveController.get_weights` returns them."""
    uncertainty: Array
    """Standard error of the effect of v_p over the nominal effect, shape (2,)."""
    duration: float
    """Duration of the data, s."""


def periods(
    data: TrainingData, parameters: PredictiveParameters, rate: float
) -> tuple[Array, Array]:
    """Return errors (rad/s) and moves (rad/s²) of each predictive period, oldest first, (N, 2).

    They are sampled as by the predictive controller: an error is the mean of the newest
    ``average`` ones at the step that takes the sample, and v_p holds from that step on.

    A row of NaN stands wherever v_p is unknown or runs are not contiguous; v_p is NaN in periods
    in which limits mostly cut u. Nothing is fitted across such a gap, nor to an error whose lags
    reach into one; all other rows count.
    """
    decimation, average = parameters.decimation, parameters.average
    gap = np.full((1, 2), math.nan)
    errors, moves = [gap], [gap]
    known = np.isfinite(data.moves.sum(axis=1))
    edges = data.begins | (known != np.roll(known, 1))
    for first, last in pairwise([*np.flatnonzero(edges).tolist(), len(data)]):
        new = 1 + np.flatnonzero(np.diff(data.moves[first:last], axis=0).any(axis=1))
        if not known[first] or not new.size:
            continue
        starts = np.arange(first + new[0] % decimation, last, decimation)
        starts = starts[starts >= first + average - 1]
        applied = np.minimum(starts[:, None] + np.arange(decimation), last - 1)
        move = data.moves[starts]
        move[data.limited[applied].mean(axis=1) > 0.5] = math.nan
        errors += [data.errors[starts[:, None] - np.arange(average)].mean(axis=1), gap]
        moves += [move, gap]
    return np.concatenate(errors), np.concatenate(moves)


def fit_predictor(parameters: Nt3fsMpcParameters, errors: Array, moves: Array) -> PredictorFit:
    """Return the predictor fitted to all of a run in periods, see :func:`periods`.

    TrainingError: there is too little data, or v_p moved too little to identify its effect.
    """
    predictive, period = parameters.predictive, 1.0 / parameters.rate
    timing = SampleTiming(period, predictive.decimation, predictive.average)
    duration = np.count_nonzero(np.isfinite(errors + moves).all(axis=1)) * timing.span
    parts = stretches(errors, moves)
    if duration < MIN_EXCITATION or not parts:
        raise TrainingError(
            f'the run must hold at least {MIN_EXCITATION:g} s with known errors and v_p, and of '
            f'these {JUDGED * timing.span:g} s without a gap: got {duration:.1f} s'
        )
    # The small-signal gain of the control law, 1/s: K, and the slope of (81)-(82).
    law, slope = parameters.law, parameters.law.gain
    if law.compensator:
        slope += parameters.compensated_bound / law.smoothing
    loop = replace(predictive.nominal, feedback_gain=min(slope, 100.0))
    middle = max(predictive.horizon // 2, 1)
    nominal = nominal_step_response(loop, timing, middle)[-1]
    runs = _newest_first(errors, moves)
    effects = [
        estimate_move_effect(*run, predictive.delta_lags, predictive.move_lags, middle)
        for run in runs
    ]
    uncertainty = np.array([each.error for each in effects]) / nominal
    if not np.max(uncertainty) <= UNCERTAIN:
        worst = int(np.argmax(uncertainty))
        raise TrainingError(
            'v_p must move more to show what it does: by itself, apart from what errors and older '
            f'v_p predict, it moved by {effects[worst].own:.2g} rad/s² (standard deviation), so '
            f'in {duration:.0f} s its effect is known to {100.0 * uncertainty[worst]:.0f} % of '
            f'the nominal one, and {100.0 * UNCERTAIN:.0f} % are needed. Set predictive.dither of '
            'the controller while recording (a few rad/s²), record for longer, or keep the '
            'predictor as it is (--keep-predictor)'
        )
    learning = learning_constants(predictive, timing.span)
    generator = np.random.default_rng(predictive.seed)
    longest = max(parts, key=lambda part: part[0][0].size)
    each = []
    for z, run in enumerate(runs):
        predictor = Predictor(_machine(predictive, generator), predictive.horizon, longest[z])
        trust = predictive.trust / timing.span
        predictor.fit(*run, predictive.excitation, trust, learning)
        each.append(predictor.get_weights())
    weights = {name: np.stack([one[name] for one in each]) for name in each[0]}
    return PredictorFit(weights, uncertainty, float(duration))


def _machine(parameters: PredictiveParameters, generator: np.random.Generator) -> BoltzmannMachine:
    shape = LayerSizes(parameters.delta_lags, parameters.move_lags, parameters.hidden)
    scales = parameters.delta_scale, parameters.move_scale
    return make_machine(shape, *scales, parameters.spread, generator)


def stretches(errors: Array, moves: Array) -> list[Segment]:
    """Return the segments of a run without a gap, of at least :data:`JUDGED` periods.

    Of what :func:`periods` returns, (errors, moves) of each wheel, *newest first*.
    """
    gaps = np.flatnonzero(np.isnan(errors + moves).any(axis=1))
    edges = [-1, *gaps.tolist(), len(errors)]
    return [
        _newest_first(errors[low + 1 : high], moves[low + 1 : high])
        for low, high in pairwise(edges)
        if high - low > JUDGED
    ]


def _newest_first(errors: Array, moves: Array) -> Segment:
    """Return both by wheel."""
    return [
        (np.ascontiguousarray(errors[::-1, z]), np.ascontiguousarray(moves[::-1, z]))
        for z in range(errors.shape[1])
    ]


def skills(
    parameters: PredictiveParameters, span: float, weights: dict[str, Array], parts: list[Segment]
) -> Array:
    """Return the skill of weights on a run: next step and middle of the horizon, (2, m).

    1 is perfect; 0 equals persistence, the prediction that the error stays constant. The squared
    errors of all ``parts``, see :func:`stretches`, are summed. NaN without one. ``span`` is the
    predictive period, s.
    """
    learning = learning_constants(parameters, span)
    outputs = len(weights['scales'])
    missed, persistence_mse = np.zeros((2, outputs)), np.zeros((2, outputs))
    for part in parts:
        for z, run in enumerate(part):
            machine = _machine(parameters, np.random.default_rng(parameters.seed))
            predictor = Predictor(machine, parameters.horizon, run)
            predictor.set_weights({name: value[z] for name, value in weights.items()}, learning)
            weight = run[0].size - 1 - predictor.history.errors.size
            missed[:, z] += weight * predictor.history.prediction_mse
            persistence_mse[:, z] += weight * predictor.history.persistence_mse
    with np.errstate(invalid='ignore'):
        return 1.0 - missed / persistence_mse


def fit_coefficients(parameters: Nt3fsMpcParameters, data: TrainingData) -> Array:
    r"""Return the coefficients with which g explains the estimator residual, (2, 2 r lambda).

    .. math:: \alpha \leftarrow P\left[\alpha + \gamma_n \Phi(\chi)
              \left(\hat d - \Phi(\chi)^T\alpha\right)\right], \qquad
              \gamma_n = \frac{\mu}{\|\Phi\|^2}

    This is (77)-(78) with the estimate's own error in the place of delta, per sample and
    normalised (Nagumo and Noda 1967, doi 10.1109/TAC.1967.1098599): any mu below 2 is stable. mu
    decreases with the passes, so that what is not a function of chi averages out. P is the
    projection of the adaptation. d is the estimator residual, as seen by the control
    law; g is to cancel it.
    """
    rows = _informative_rows(parameters, data)
    decimation = parameters.predictive.decimation
    if rows.size * decimation < MIN_EXCITATION * parameters.rate:
        raise TrainingError(
            f'the run must hold at least {MIN_EXCITATION:g} s of motion: '
            f'got {rows.size * decimation / parameters.rate:.1f} s'
        )
    # So large a gamma is clipped to the step limit: a share mu / |Phi|² of each residual.
    how = AdaptationParameters(gamma=1e6, radius=parameters.adaptation.radius)
    estimator = FuzzyEstimator(parameters.fuzzy, how)
    for number in range(PASSES):
        estimator.configure(replace(how, step_limit=SHARE / (1.0 + number)))
        for row in rows:
            estimate = estimator.evaluate(data.speeds[row])
            estimator.adapt(data.unexplained[row] - estimate, 1.0)
    return estimator.coefficients.copy()


def explained(parameters: Nt3fsMpcParameters, coefficients: Array, data: TrainingData) -> Array:
    """Return the share of the variance of the unexplained acceleration that g explains, (2,).

    Negative where g is worse than zero; NaN without usable rows.
    """
    rows = _informative_rows(parameters, data)
    if rows.size < 2:
        return np.full(2, math.nan)
    estimator = FuzzyEstimator(parameters.fuzzy, parameters.adaptation)
    estimator.coefficients = coefficients
    wanted = data.unexplained[rows]
    estimates = np.array([estimator.evaluate(data.speeds[row]) for row in rows])
    missed = np.mean((wanted - estimates) ** 2, axis=0)
    share: Array = 1.0 - missed / np.maximum(wanted.var(axis=0), 1e-12)
    return share


def _informative_rows(parameters: Nt3fsMpcParameters, data: TrainingData) -> NDArray[np.int64]:
    """Return the rows at which the estimate has settled, one in each predictive period."""
    settling = round(SETTLING * parameters.rate)
    since = np.arange(len(data))
    since -= np.maximum.accumulate(np.where(data.begins, since, 0))
    return np.flatnonzero(since >= settling)[:: parameters.predictive.decimation]


# -- cross-validation -----------------------------------------------------------------------------


FITTED, LOOP, RANDOM = 'fitted', 'nominal loop', 'random'
"""Compared predictors: fitted to the other folds, nominal only, and with random output
weights of the same size. Skill 0 is no prediction."""
NEXT_STEP, MIDDLE = 'next step', 'middle of the horizon'


@dataclass(frozen=True)
class Fold:
    """Model of the other folds, evaluated on this one."""

    name: str
    judged: float
    """Length of the evaluated part, s."""
    skills: Mapping[str, Array]
    """For each predictor (next step, middle) by (right, left); empty when none was fitted."""
    explained: Array
    """Explained share of the variance of the unexplained acceleration, by g, (2,)."""


def blocks(data: TrainingData, count: int) -> list[TrainingData]:
    """Return a run in ``count`` parts of equal length, each a run of its own."""
    if count < 2:
        raise ValueError(f'folds must be at least 2: got {count}')
    names = [item.name for item in fields(TrainingData)]
    columns = zip(*(np.array_split(getattr(data, name), count) for name in names), strict=True)
    parts = [TrainingData(*(column.copy() for column in each)) for each in columns]
    for part in parts:
        part.begins[:1] = True
    return parts


def cross_validate(
    parameters: Nt3fsMpcParameters,
    runs: Mapping[str, TrainingData],
    *,
    keep_predictor: bool = False,
) -> list[Fold]:
    """Return for each run the model of all others, evaluated on it.

    With ``keep_predictor`` the fuzzy coefficients only. There are at least two runs, with common
    parameters.
    """
    predictive = parameters.predictive
    span = predictive.decimation / parameters.rate
    found = []
    for name, left_out in runs.items():
        others = TrainingData.joined([run for other, run in runs.items() if other != name])
        judged = len(left_out) / parameters.rate
        ratings: dict[str, Array] = {}
        try:
            coefficients = fit_coefficients(parameters, others)
            if not keep_predictor:
                fit = fit_predictor(parameters, *periods(others, predictive, parameters.rate))
                parts = stretches(*periods(left_out, predictive, parameters.rate))
                judged = sum(part[0][0].size for part in parts) * span
                nominal = PredictiveController(
                    predictive, 1.0 / parameters.rate, parameters.law.gain
                ).get_weights()
                ratings = {
                    title: skills(predictive, span, weights, parts)
                    for title, weights in (
                        (FITTED, fit.weights),
                        (LOOP, nominal),
                        (RANDOM, random_output_weights(fit.weights, predictive.seed)),
                    )
                }
        except TrainingError as error:
            raise TrainingError(
                f'without {name} to learn from: {error}; record for longer, or give another bag'
            ) from error
        found.append(Fold(name, judged, ratings, explained(parameters, coefficients, left_out)))
    if not keep_predictor and not any(fold.judged for fold in found):
        raise TrainingError('there must be a stretch without a gap to evaluate: there is none')
    return found


def mean_and_spread(values: Sequence[Array]) -> tuple[Array, Array]:
    """Return mean and standard deviation over the folds with a value."""
    with warnings.catch_warnings():  # there may be one fold with a value, or none
        warnings.simplefilter('ignore', RuntimeWarning)
        return np.nanmean(values, axis=0), np.nanstd(values, axis=0, ddof=1)


def fold_table(folds: Sequence[Fold]) -> str:
    """Return the result in Markdown: rows are folds, each number is (right/left)."""
    names = [f'{fold.name} ({fold.judged:.1f} s)' for fold in folds]
    columns = {
        f'skill, {when}': {
            title: [fold.skills[title][row] for fold in folds] for title in folds[0].skills
        }
        for row, when in enumerate((NEXT_STEP, MIDDLE) if folds[0].skills else ())
    }
    columns['g explains'] = {'share': [fold.explained for fold in folds]}
    tables = []
    for what, measured in columns.items():
        cells = [[pair(value) for value in values] for values in measured.values()]
        spreads = [spread_text(values) for values in measured.values()]
        rows = [*zip(names, *cells, strict=True), ('mean ± spread', *spreads)]
        tables.append(Table('', (what, *measured), rows).markdown())
    return '\n\n'.join(tables)


def spread_text(values: Sequence[Array]) -> str:
    """Return mean ± standard deviation of both wheels as text."""
    return ' / '.join(
        f'{mean:.2f} ± {spread:.2f}' if math.isfinite(spread) else f'{mean:.2f}'
        for mean, spread in zip(*mean_and_spread(values), strict=True)
    )


def pair(values: Array, form: str = '.2f') -> str:
    """Return the numbers of both wheels as text, a dash for an unknown one."""
    return '/'.join(f'{value:{form}}' if math.isfinite(value) else '–' for value in values)
