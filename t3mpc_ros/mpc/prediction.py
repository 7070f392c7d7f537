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
    machine: BoltzmannMachine, history: History, first: int, offset: float, out: Array
) -> None:
    r"""Write the iterated predictions delta_hat(t+1) ... delta_hat(t+n) into ``out``.

    .. math:: \hat\delta(t+j) = y_{BM}(\hat\delta(t+j-1), \ldots, v_p(t+j-1), \ldots) + e(t)

    Equations (46), (49)-(50), (57)-(58). The offset ``e`` is added at *every* step and so passes
    through the machine's own dynamics, which removes the steady error (offset-free control). If
    it were added once to the finished response, as for a model without measured inputs, a steady
    error would remain, because the measured lags already contain part of the disturbance.

    machine : its work space is overwritten
    history : errors and moves are read, and ``planned_moves``, v_p for t, t+1, ... (rad/s²),
              instead of moves[first]; lagged_errors and lagged_moves are overwritten
    first   : index of the error to start from: 0 is the present one
    offset  : e(t), the filtered prediction error (rad/s)
    out     : shape (n,), n at most n_p, overwritten (rad/s)
    """
    n_errors = machine.delta_lags
    n_moves = machine.lags.size - n_errors
    for i in range(n_errors):
        history.lagged_errors[i] = history.errors[first + i]
    for i in range(1, n_moves):
        history.lagged_moves[i] = history.moves[first + i]
    for j in range(out.size):
        if j > 0:
            for i in range(n_errors - 1, 0, -1):
                history.lagged_errors[i] = history.lagged_errors[i - 1]
            history.lagged_errors[0] = out[j - 1]
            for i in range(n_moves - 1, 0, -1):
                history.lagged_moves[i] = history.lagged_moves[i - 1]
        history.lagged_moves[0] = history.planned_moves[j]
        set_visible(machine, history.lagged_errors, history.lagged_moves, 0)
        out[j] = predict_error(machine) + offset


@kernel
def free_response(
    machine: BoltzmannMachine, history: History, v_previous: float, out: Array
) -> None:
    """Write Psi_free (56): the response to a constant v_p(t-1), (46), (57)-(59).

    out : shape (n_p,), overwritten (rad/s)
    """
    history.planned_moves[:] = v_previous
    roll_forward(machine, history, 0, history.offsets[0], out)


@kernel
def step_response(
    machine: BoltzmannMachine,
    history: History,
    v_previous: float,
    probe: float,
    free: Array,
    out: Array,
) -> None:
    """Write s_0 ... s_{n_p-1}, equation (48), in (rad/s)/(rad/s²).

    s_j = (delta_hat_step(t+j+1) - delta_hat_free(t+j+1)) / dv: the response to a constant
    v_p(t-1) + dv, (49)-(51), minus that to a constant v_p(t-1) (59).

    v_previous, probe : v_p(t-1) and dv (rad/s²)
    free              : Psi_free (56), shape (n_p,)
    out               : shape (n_p,), overwritten
    """
    history.planned_moves[:] = v_previous + probe
    roll_forward(machine, history, 0, history.offsets[0], out)
    for j in range(out.size):
        out[j] = (out[j] - free[j]) / probe


@kernel
def toeplitz(step: Array, out: Array) -> None:
    """Write S, the lower-triangular Toeplitz matrix of the step response, (54) with E11.

    E11: the printed last row repeats s_{n_p-1}; it is s_{n_p-1}, s_{n_p-2}, ..., s_0.

    step : shape (n_p,)
    out  : shape (n_p, n_c); changes after n_c periods are zero
    """
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[j, i] = step[j - i] if j >= i else 0.0


@kernel
def predicted_errors(matrix: Array, changes: Array, free: Array, out: Array) -> None:
    """Write Psi = S dv + Psi_free (rad/s), shape (n_p,), (45), (52)-(53) with dv of (55)."""
    for j in range(out.size):
        out[j] = free[j]
        for i in range(min(j + 1, changes.size)):
            out[j] += matrix[j, i] * changes[i]


@kernel
def predict_responses(
    machine: BoltzmannMachine,
    history: History,
    v_previous: float,
    probe: float,
    known: Array,
    steps: Array,
    free: Array,
) -> None:
    """Write the step response (48), and Psi_free (56) plus the known errors.

    v_previous, probe : v_p(t-1), dv (rad/s²)
    known             : future errors caused by known jumps, shape (n_p,) (rad/s)
    steps, free       : shape (n_p,), overwritten
    """
    free_response(machine, history, v_previous, free)
    step_response(machine, history, v_previous, probe, free, steps)
    for j in range(free.size):
        free[j] += known[j]
