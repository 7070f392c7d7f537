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
from t3mpc_ros.lab.training.replay import Replay, TrainingError
from t3mpc_ros.mpc.machine import Shape, make_machine
from t3mpc_ros.mpc.predictive import PredictiveTerm
from t3mpc_ros.mpc.settings import PredictiveSettings
from t3mpc_ros.mpc.skill import Learning, Predictor, skill
from t3mpc_ros.mpc.training import Timing, nominal_step, split_runs

Array = NDArray[np.float64]

ENOUGH = 10.0
"""Least length of what can be learnt from, s."""
SHORTEST = 40
"""Least predictive periods of a stretch without a gap: shorter ones do not show their phase."""
UNCERTAIN = 0.5
"""Largest standard error of the effect of v_p, as a share of the nominal one: twice this, and an
effect could not be told from none."""
PASSES, SHARE = 12, 0.1
"""How often the coefficients go through a run, and mu of the first time."""
SETTLING = 0.5
"""Start of every stretch that the coefficients do not learn from, s: the estimate settles."""


@dataclass(frozen=True)
class PredictorLesson:
    """What the predictor learnt; rows of skills: next step, middle of the horizon."""

    weights: dict[str, Array]
    before: Array
    """Skill on the run kept back, of a predictor that knows the nominal loop only, (2, 2)."""
    after: Array
    """That of ``weights``, shape (2, 2)."""
    uncertainty: Array
    """Standard error of the effect of v_p over the nominal effect, shape (2,)."""
    taught: float
    """s"""
    kept_back: float
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
    """Return what the predictor learns from a run in periods, see :func:`periods`.

    Raises
    ------
    TrainingError
        Too little is known, or v_p moved too little to show what it does.
    """
    predictive, period = settings.predictive, 1.0 / settings.rate
    timing = Timing(period, predictive.every, predictive.average)
    runs = split_runs(errors, moves, 2)
    first, last = (
        min(np.count_nonzero(np.isfinite(run[part][0] + run[part][1])) for run in runs)
        * timing.span
        for part in (0, 1)
    )
    if first < ENOUGH or last < 0.1 * ENOUGH:
        raise TrainingError(
            f'the run must hold at least {ENOUGH:g} s with known errors and v_p, and after that '
            f'a quarter to judge by with {0.1 * ENOUGH:g} s without a gap, in stretches of at '
            f'least {SHORTEST * timing.span:g} s: got {first:.1f} s and {last:.1f} s'
        )
    loop = replace(predictive.nominal, feedback_gain=min(feedback_slope(settings), 100.0))
    middle = max(predictive.horizon // 2, 1)
    nominal = nominal_step(loop, timing, middle)[-1]
    effects = [
        effect(*run[0], predictive.delta_lags, predictive.move_lags, middle) for run in runs
    ]
    uncertainty = np.array([each.error for each in effects]) / nominal
    if not np.max(uncertainty) <= UNCERTAIN:
        worst = int(np.argmax(uncertainty))
        raise TrainingError(
            'v_p must move more to show what it does: by itself, apart from what errors and older '
            f'v_p foretell, it moved by {effects[worst].own:.2g} rad/s² (standard deviation), so '
            f'in {first:.0f} s its effect is known to {100.0 * uncertainty[worst]:.0f} % of the '
            f'nominal one, and {100.0 * UNCERTAIN:.0f} % are needed. Set predictive.dither of the '
            'controller while recording (a few rad/s²), record for longer, or keep the predictor '
            'as it is (--keep-predictor)'
        )
    term = PredictiveTerm(predictive, period, settings.law.gain)
    before = skills(predictive, timing.span, term.weights(), [run[1] for run in runs])
    term.relearn(errors, moves)
    return PredictorLesson(
        weights=term.weights(),
        before=before,
        after=np.stack([term.skill_next, term.skill]),
        uncertainty=uncertainty,
        taught=first,
        kept_back=last,
    )


def feedback_slope(settings: CompositionSettings) -> float:
    """Return what the law does against a small error, 1/s: K, and the slope of (81)-(82)."""
    law = settings.law
    return law.gain + (settings.compensated_bound / law.smoothing if law.compensator else 0.0)


def skills(
    settings: PredictiveSettings,
    span: float,
    weights: dict[str, Array],
    runs: list[tuple[Array, Array]],
) -> Array:
    """Return the skill of saved weights on a run: next step and middle of the horizon, (2, m).

    Parameters
    ----------
    settings, span
        Of the predictive term, and its period, s.
    weights
        As :meth:`PredictiveTerm.weights` returns them.
    runs
        (errors, moves) of each output, *newest first*, without a gap.
    """
    shape = Shape(settings.delta_lags, settings.move_lags, settings.hidden)
    learning = Learning.of(settings, span)
    found = np.empty((2, len(runs)))
    for z, run in enumerate(runs):
        machine = make_machine(
            shape,
            settings.delta_scale,
            settings.move_scale,
            settings.spread,
            np.random.default_rng(settings.seed),
        )
        predictor = Predictor(machine, settings.horizon, run)
        predictor.set_weights({name: value[z] for name, value in weights.items()}, learning)
        found[:, z] = skill(predictor.past, 0), skill(predictor.past, 1)
    return found


@dataclass(frozen=True)
class Effect:
    """What a run tells of the effect of v_p."""

    response: float
    """Change of the error per change of v_p that is held, (rad/s)/(rad/s²)."""
    error: float
    """Standard error of it; infinite when the run tells nothing."""
    own: float
    """Standard deviation of the v_p that neither errors nor older v_p foretell, rad/s²."""


def effect(errors: Array, moves: Array, delta_lags: int, move_lags: int, ahead: int) -> Effect:
    r"""Return the effect of v_p ``ahead`` periods on, by least squares on the lags of (35).

    .. math:: \delta_t = \sum_{i=1}^{n_a} a_i \delta_{t-i} + \sum_{i=1}^{n_b} b_i v_{p,t-i} + w_t

    The standard error is that of the step response of this model, by its gradient (the delta
    method) and the covariance s² (XᵀX)^-1 of the coefficients (Ljung, System Identification,
    1999, chapter 9). In a closed loop v_p is nearly a function of the errors, so XᵀX is nearly
    singular unless something else moves it.

    Parameters
    ----------
    errors, moves
        *Newest first*, NaN where they are not known, shape (N,).
    delta_lags, move_lags
        n_a and n_b.
    ahead
        Periods.
    """
    count = errors.size - max(delta_lags, move_lags)
    nothing = Effect(math.nan, math.inf, 0.0)
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
    return Effect(response, math.sqrt(float(slope @ covariance @ slope)), spread)


def _response(values: Array, delta_lags: int, ahead: int) -> float:
    """Return the error ``ahead`` periods after v_p has stepped from 0 to 1."""
    a, b = values[:delta_lags], values[delta_lags:]
    errors, moves = np.zeros(a.size), np.zeros(b.size)
    for _ in range(ahead):
        moves[1:] = moves[:-1].copy()
        moves[0] = 1.0
        new = float(a @ errors + b @ moves)
        errors[1:] = errors[:-1].copy()
        errors[0] = new
    return float(errors[0])


@dataclass(frozen=True)
class CoefficientLesson:
    """What the fuzzy systems learnt."""

    coefficients: Array
    """alpha, shape (2, 2 r lambda), rad/s²."""
    explained: Array
    """Share of the variance of the unexplained acceleration, kept back, that g accounts for."""
    samples: int


def teach_coefficients(settings: CompositionSettings, replay: Replay) -> CoefficientLesson:
    r"""Return the coefficients with which g explains what the estimate could not.

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
    every = settings.predictive.every
    settling = round(SETTLING * settings.rate)
    since = np.arange(len(replay))
    since -= np.maximum.accumulate(np.where(replay.begins, since, 0))
    rows = np.flatnonzero(np.isfinite(replay.errors).all(axis=1) & (since >= settling))[::every]
    if rows.size * every < ENOUGH * settings.rate:
        raise TrainingError(
            f'the run must hold at least {ENOUGH:g} s of motion: '
            f'got {rows.size * every / settings.rate:.1f} s'
        )
    taught, kept_back = np.split(rows, [3 * rows.size // 4])
    # So large a gamma is cut to the step limit: a share mu / |Phi|² of each miss.
    how = AdaptationSettings(gamma=1e6, radius=settings.adaptation.radius)
    estimator = FuzzyEstimator(settings.fuzzy, how)
    for number in range(PASSES):
        estimator.configure(replace(how, step_limit=SHARE / (1.0 + number)))
        for row in taught:
            estimate = estimator.evaluate(replay.speeds[row])
            estimator.adapt(replay.unexplained[row] - estimate, 1.0)
    wanted = replay.unexplained[kept_back]
    estimates = np.array([estimator.evaluate(replay.speeds[row]) for row in kept_back])
    missed = np.mean((wanted - estimates) ** 2, axis=0)
    return CoefficientLesson(
        estimator.coefficients, 1.0 - missed / np.maximum(wanted.var(axis=0), 1e-12), rows.size
    )
