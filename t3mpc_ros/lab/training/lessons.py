# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a replayed run teaches: the predictor's weights (35)-(44), the coefficients of (31)."""

from dataclasses import dataclass, replace
from itertools import pairwise
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.composition import CompositionSettings
from t3mpc_ros.fuzzy.adaptation import AdaptationSettings
from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
from t3mpc_ros.lab.training.effect import effect
from t3mpc_ros.lab.training.replay import Replay, TrainingError
from t3mpc_ros.mpc.machine import Machine, Shape, make_machine
from t3mpc_ros.mpc.settings import Learning, PredictiveSettings
from t3mpc_ros.mpc.skill import Predictor
from t3mpc_ros.mpc.training import Timing, nominal_step

Array = NDArray[np.float64]

ENOUGH = 10.0
"""Least length of what can be learnt from, s."""
SHORTEST = 40
"""Least predictive periods of a stretch without a gap: shorter ones do not show their phase."""
JUDGED = 20
"""Least predictive periods without a gap that a predictor is judged by."""
UNCERTAIN = 0.5
"""Largest standard error of the effect of v_p, as a share of the nominal one: twice this, and an
effect could not be told from none."""
PASSES, SHARE = 12, 0.1
"""How often the coefficients go through a run, and mu of the first time."""
SETTLING = 0.5
"""Start of every stretch that the coefficients do not learn from, s: the estimate settles."""


@dataclass(frozen=True)
class PredictorLesson:
    """What the predictor learnt."""

    weights: dict[str, Array]
    """As :meth:`PredictiveTerm.weights` returns them."""
    uncertainty: Array
    """Standard error of the effect of v_p over the nominal effect, shape (2,)."""
    taught: float
    """s"""


def periods(replay: Replay, settings: PredictiveSettings, rate: float) -> tuple[Array, Array]:
    """Return errors (rad/s) and moves (rad/s²) of each predictive period, oldest first, (N, 2).

    They are sampled as :func:`t3mpc_ros.mpc.skill.gather` does: an error is the mean of the newest
    ``average`` ones at the step that takes the sample, and v_p holds from that step on. How long
    before a published v_p that was is seen in u, which jumps with v_p: so a recording may begin
    at any time.

    Messages may be missing. What is not known is NaN: errors that were rebuilt wrongly or not at
    all, v_p in periods most of which limits cut u, and a whole row wherever a period is without a
    message, or runs do not follow each other. Nothing is learnt across such a gap, nor from an
    error whose lags reach into one; all the rest counts.

    Parameters
    ----------
    replay
        One or several runs.
    settings
        Of the predictive term.
    rate
        Control periods a second.

    Raises
    ------
    TrainingError
        v_p was published too seldom.
    """
    every, average, span = settings.every, settings.average, settings.every / rate
    gap = np.full((1, 2), math.nan)
    errors, moves = [gap], [gap]
    jumps = np.abs(np.diff(replay.rest, axis=0, prepend=replay.rest[:1])).sum(axis=1)
    edges = [*np.flatnonzero(replay.begins).tolist(), len(replay)]
    for first, last in pairwise(edges):
        said = first + np.flatnonzero(np.isfinite(replay.moves[first:last]).all(axis=1))
        said = _one_each(replay, said, span)
        said = said[said >= first + every + average]
        if said.size < SHORTEST:
            continue
        interval = float(np.median(np.diff(replay.time[said])))
        if interval > 1.5 * span:
            raise TrainingError(
                f'v_p must be published in each predictive period of {span:g} s: it was every '
                f"{interval:.2g} s; set the controller's terms_rate to {1.0 / span:g} Hz"
            )
        # The median, because limits make u jump too, but seldom.
        starts = said - np.argmax([np.median(jumps[said - late]) for late in range(every)])
        seen = starts[:, None] - np.arange(average)
        held = np.minimum(starts[:, None] + np.arange(every), last - 1)
        error, move = replay.errors[seen].mean(axis=1), replay.moves[said]
        whole = (average - 0.5) / rate > replay.time[starts] - replay.time[seen[:, -1]]
        error[~whole] = math.nan
        move[replay.limited[held].mean(axis=1) > 0.5] = math.nan
        torn = 1 + np.flatnonzero(np.abs(np.diff(replay.time[starts]) / span - 1.0) > 0.5)
        errors += [np.insert(error, torn, math.nan, axis=0), gap]
        moves += [np.insert(move, torn, math.nan, axis=0), gap]
    return np.concatenate(errors), np.concatenate(moves)


def _one_each(replay: Replay, rows: NDArray[np.int64], span: float) -> NDArray[np.int64]:
    """Return one of the rows per predictive period: the first of those with the same v_p."""
    kept: list[int] = []
    for row in rows.tolist():
        if (
            not kept
            or replay.time[row] - replay.time[kept[-1]] > 0.9 * span
            or not np.array_equal(replay.moves[row], replay.moves[kept[-1]])
        ):
            kept.append(row)
    return np.array(kept, dtype=np.int64)


def teach_predictor(settings: CompositionSettings, errors: Array, moves: Array) -> PredictorLesson:
    """Return what the predictor learns from all of a run in periods, see :func:`periods`.

    Raises
    ------
    TrainingError
        Too little is known, or v_p moved too little to show what it does.
    """
    predictive, period = settings.predictive, 1.0 / settings.rate
    timing = Timing(period, predictive.every, predictive.average)
    taught = np.count_nonzero(np.isfinite(errors + moves).all(axis=1)) * timing.span
    parts = stretches(errors, moves)
    if taught < ENOUGH or not parts:
        raise TrainingError(
            f'the run must hold at least {ENOUGH:g} s with known errors and v_p, and of these '
            f'{JUDGED * timing.span:g} s without a gap: got {taught:.1f} s, the longest stretch '
            f'{_longest(errors + moves) * timing.span:.1f} s'
        )
    loop = replace(predictive.nominal, feedback_gain=min(feedback_slope(settings), 100.0))
    middle = max(predictive.horizon // 2, 1)
    nominal = nominal_step(loop, timing, middle)[-1]
    # Newest first, as everything in the machine's room.
    runs = [
        (np.ascontiguousarray(errors[::-1, z]), np.ascontiguousarray(moves[::-1, z]))
        for z in range(2)
    ]
    effects = [effect(*run, predictive.delta_lags, predictive.move_lags, middle) for run in runs]
    uncertainty = np.array([each.error for each in effects]) / nominal
    if not np.max(uncertainty) <= UNCERTAIN:
        worst = int(np.argmax(uncertainty))
        raise TrainingError(
            'v_p must move more to show what it does: by itself, apart from what errors and older '
            f'v_p foretell, it moved by {effects[worst].own:.2g} rad/s² (standard deviation), so '
            f'in {taught:.0f} s its effect is known to {100.0 * uncertainty[worst]:.0f} % of the '
            f'nominal one, and {100.0 * UNCERTAIN:.0f} % are needed. Set predictive.dither of the '
            'controller while recording (a few rad/s²), record for longer, or keep the predictor '
            'as it is (--keep-predictor)'
        )
    learning = Learning.of(predictive, timing.span)
    generator = np.random.default_rng(predictive.seed)
    longest = max(parts, key=lambda part: part[0][0].size)
    each = []
    for z, run in enumerate(runs):
        predictor = Predictor(_machine(predictive, generator), predictive.horizon, longest[z])
        trust = predictive.trust / timing.span
        predictor.teach(*run, predictive.excitation, trust, learning)
        each.append(predictor.weights())
    weights = {name: np.stack([one[name] for one in each]) for name in each[0]}
    return PredictorLesson(weights, uncertainty, float(taught))


def _machine(settings: PredictiveSettings, generator: np.random.Generator) -> Machine:
    """Return a machine with first weights."""
    shape = Shape(settings.delta_lags, settings.move_lags, settings.hidden)
    scales = settings.delta_scale, settings.move_scale
    return make_machine(shape, *scales, settings.spread, generator)


def stretches(errors: Array, moves: Array) -> list[list[tuple[Array, Array]]]:
    """Return the parts of a run without a gap, of at least :data:`JUDGED` periods.

    Parameters
    ----------
    errors, moves
        As :func:`periods` returns them, shape (N, 2).

    Returns
    -------
    list
        For each part (errors, moves) of each wheel, *newest first*.
    """
    gaps = np.flatnonzero(np.isnan(errors + moves).any(axis=1))
    edges = [-1, *gaps.tolist(), len(errors)]
    return [
        [
            (
                np.ascontiguousarray(errors[low + 1 : high, z][::-1]),
                np.ascontiguousarray(moves[low + 1 : high, z][::-1]),
            )
            for z in range(errors.shape[1])
        ]
        for low, high in pairwise(edges)
        if high - low > JUDGED
    ]


def _longest(table: Array) -> int:
    """Return how many rows in a row are known."""
    gaps = np.flatnonzero(np.isnan(table).any(axis=1))
    return int(np.diff([-1, *gaps.tolist(), len(table)]).max()) - 1


def feedback_slope(settings: CompositionSettings) -> float:
    """Return what the law does against a small error, 1/s: K, and the slope of (81)-(82)."""
    law = settings.law
    return law.gain + (settings.compensated_bound / law.smoothing if law.compensator else 0.0)


def skills(
    settings: PredictiveSettings,
    span: float,
    weights: dict[str, Array],
    parts: list[list[tuple[Array, Array]]],
) -> Array:
    """Return the skill of saved weights on a run: next step and middle of the horizon, (2, m).

    1 is perfect; 0 is no better than no prediction, which is that the error stays what it is. The
    squares of all stretches are put together. NaN when there is none.

    Parameters
    ----------
    settings, span
        Of the predictive term, and its period, s.
    weights
        As :meth:`PredictiveTerm.weights` returns them.
    parts
        As :func:`stretches` returns them.
    """
    learning = Learning.of(settings, span)
    outputs = len(weights['scales'])
    missed, persisted = np.zeros((2, outputs)), np.zeros((2, outputs))
    for part in parts:
        for z, run in enumerate(part):
            machine = _machine(settings, np.random.default_rng(settings.seed))
            predictor = Predictor(machine, settings.horizon, run)
            predictor.set_weights({name: value[z] for name, value in weights.items()}, learning)
            weight = run[0].size - 1 - predictor.past.errors.size
            missed[:, z] += weight * predictor.past.predicted
            persisted[:, z] += weight * predictor.past.persisted
    with np.errstate(invalid='ignore'):
        return 1.0 - missed / persisted


def teach_coefficients(settings: CompositionSettings, replay: Replay) -> Array:
    r"""Return the coefficients with which g explains what the estimate could not, (2, 2 r lambda).

    .. math:: \alpha \leftarrow P\left[\alpha + \gamma_n \Phi(\chi)
              \left(\hat d - \Phi(\chi)^T\alpha\right)\right], \qquad
              \gamma_n = \frac{\mu}{\|\Phi\|^2}

    This is (77)-(78) with the estimate's own error in the place of delta, per sample and
    normalised (Nagumo and Noda 1967, doi 10.1109/TAC.1967.1098599): any mu below 2 is stable. mu
    falls with the passes, so that what is not a function of chi averages out. P is the projection
    of the adaptation. d is the estimator's, as the law feels it; what g is to cancel.

    Raises
    ------
    TrainingError
        The run is too short.
    """
    rows = _telling(settings, replay)
    every = settings.predictive.every
    if rows.size * every < ENOUGH * settings.rate:
        raise TrainingError(
            f'the run must hold at least {ENOUGH:g} s of motion: '
            f'got {rows.size * every / settings.rate:.1f} s'
        )
    # So large a gamma is cut to the step limit: a share mu / |Phi|² of each miss.
    how = AdaptationSettings(gamma=1e6, radius=settings.adaptation.radius)
    estimator = FuzzyEstimator(settings.fuzzy, how)
    for number in range(PASSES):
        estimator.configure(replace(how, step_limit=SHARE / (1.0 + number)))
        for row in rows:
            estimate = estimator.evaluate(replay.speeds[row])
            estimator.adapt(replay.unexplained[row] - estimate, 1.0)
    return estimator.coefficients.copy()


def explained(settings: CompositionSettings, coefficients: Array, replay: Replay) -> Array:
    """Return which share of the variance of the unexplained acceleration g accounts for, (2,).

    Negative where g is worse than nothing; NaN when the run does not tell.
    """
    rows = _telling(settings, replay)
    if rows.size < 2:
        return np.full(2, math.nan)
    estimator = FuzzyEstimator(settings.fuzzy, settings.adaptation)
    estimator.coefficients = coefficients
    wanted = replay.unexplained[rows]
    estimates = np.array([estimator.evaluate(replay.speeds[row]) for row in rows])
    missed = np.mean((wanted - estimates) ** 2, axis=0)
    share: Array = 1.0 - missed / np.maximum(wanted.var(axis=0), 1e-12)
    return share


def _telling(settings: CompositionSettings, replay: Replay) -> NDArray[np.int64]:
    """Return the rows that tell of the unexplained acceleration, one in each predictive period."""
    settling = round(SETTLING * settings.rate)
    since = np.arange(len(replay))
    since -= np.maximum.accumulate(np.where(replay.begins, since, 0))
    known = np.isfinite(replay.errors).all(axis=1) & (since >= settling)
    return np.flatnonzero(known)[:: settings.predictive.every]
