# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Prediction over the horizon: free, step and forced response, (45)-(59) with E11."""

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.boltzmann_machine import BoltzmannMachine, History, predict_error, set_visible

Array = NDArray[np.float64]


@kernel
def roll_forward(
    machine: BoltzmannMachine, past: History, first: int, offset: float, out: Array
) -> None:
    r"""Write delta_hat(t+1) ... delta_hat(t+n) into ``out``, the machine fed with its own outputs.

    .. math:: \hat\delta(t+j) = y_{BM}(\hat\delta(t+j-1), \ldots, v_p(t+j-1), \ldots) + e(t)

    Equations (46), (49)-(50), (57)-(58). The offset ``e`` enters at *every* step and so runs
    through the machine's own dynamics; then a program that has come to rest has no steady error.
    Added once to the finished response, as for a model that is never fed with measurements, it
    would leave one: a machine fed with measured lags already carries part of the disturbance.

    machine : its passes are overwritten
    past    : errors and moves are read, ``past.planned`` holds v_p for t, t+1, ... (rad/s²), in
              place of moves[first]; seen_errors and seen_moves are overwritten
    first   : index of the newest error to start from: 0 is now
    offset  : e(t), the filtered prediction error (rad/s)
    out     : shape (n,), n at most n_p, overwritten (rad/s)
    """
    n_errors = machine.delta_lags
    n_moves = machine.lags.size - n_errors
    for i in range(n_errors):
        past.lagged_errors[i] = past.errors[first + i]
    for i in range(1, n_moves):
        past.lagged_moves[i] = past.moves[first + i]
    for j in range(out.size):
        if j > 0:
            for i in range(n_errors - 1, 0, -1):
                past.lagged_errors[i] = past.lagged_errors[i - 1]
            past.lagged_errors[0] = out[j - 1]
            for i in range(n_moves - 1, 0, -1):
                past.lagged_moves[i] = past.lagged_moves[i - 1]
        past.lagged_moves[0] = past.planned[j]
        set_visible(machine, past.lagged_errors, past.lagged_moves, 0)
        out[j] = predict_error(machine) + offset


@kernel
def free_response(machine: BoltzmannMachine, past: History, held: float, out: Array) -> None:
    """Write Psi_free (56): what happens when v_p(t-1) = ``held`` is held on, (46), (57)-(59).

    out : shape (n_p,), overwritten (rad/s)
    """
    past.planned[:] = held
    roll_forward(machine, past, 0, past.offsets[0], out)


@kernel
def step_response(
    machine: BoltzmannMachine, past: History, held: float, probe: float, free: Array, out: Array
) -> None:
    """Write s_0 ... s_{n_p-1}, equation (48), in (rad/s)/(rad/s²).

    s_j = (delta_hat_step(t+j+1) - delta_hat_free(t+j+1)) / dv: the future with v_p(t-1) + dv held
    on, (49)-(51), less the one with v_p(t-1) held on (59).

    held, probe : v_p(t-1) and dv (rad/s²)
    free        : Psi_free (56), shape (n_p,)
    out         : shape (n_p,), overwritten
    """
    past.planned[:] = held + probe
    roll_forward(machine, past, 0, past.offsets[0], out)
    for j in range(out.size):
        out[j] = (out[j] - free[j]) / probe


@kernel
def toeplitz(step: Array, out: Array) -> None:
    """Write S, lower-triangular Toeplitz of the step response, equation (54) with E11.

    E11: the printed last row repeats s_{n_p-1}; it is s_{n_p-1}, s_{n_p-2}, ..., s_0.

    step : shape (n_p,)
    out  : shape (n_p, n_c); fewer columns than rows when moves stop after n_c periods
    """
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[j, i] = step[j - i] if j >= i else 0.0


@kernel
def forced_response(step: Array, changes: Array, ahead: int) -> float:
    r"""Return delta_hat_forced(t + ahead), equation (47) with E11, in rad/s.

    .. math:: \sum_{\iota=0}^{j-1} s_\iota\, \Delta v_p(t + j - \iota - 1)

    E11: the printed index t + j - iota + 1 would let moves act before they are made.

    step    : shape (n_p,), s_0 ...
    changes : shape (n_c,), changes of v_p at t, t+1, ... (rad/s²), zero after the last
    ahead   : j, from 1 to n_p
    """
    total = 0.0
    for i in range(ahead):
        if ahead - i - 1 < changes.size:
            total += step[i] * changes[ahead - i - 1]
    return total


@kernel
def predicted_errors(matrix: Array, changes: Array, free: Array, out: Array) -> None:
    """Write Psi = S dv + Psi_free, (45), (52)-(53) with dv of (55), shape (n_p,), in rad/s."""
    for j in range(out.size):
        out[j] = free[j]
        for i in range(min(j + 1, changes.size)):
            out[j] += matrix[j, i] * changes[i]


@kernel
def predict_responses(
    machine: BoltzmannMachine,
    past: History,
    held: float,
    probe: float,
    known: Array,
    steps: Array,
    free: Array,
) -> None:
    """Write the step response (48) and Psi_free (56), the latter with the known part added.

    held, probe : v_p(t-1), dv (rad/s²)
    known       : part of the future error known from elsewhere, shape (n_p,) (rad/s)
    steps, free : shape (n_p,), overwritten
    """
    free_response(machine, past, held, free)
    step_response(machine, past, held, probe, free, steps)
    for j in range(free.size):
        free[j] += known[j]
