# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a run tells of the effect of v_p, and how surely: by least squares."""

from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
