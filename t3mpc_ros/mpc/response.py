# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the machine expects of the next n_p periods, equations (45)-(59) with E11.

And, from that, the moves (60)-(63): :func:`plan`. Before it the samples are gathered that the
machine sees.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.active_set import solve
from t3mpc_ros.mpc.machine import Machine, Past, look, predict
from t3mpc_ros.mpc.program import Space

Array = NDArray[np.float64]


class Signals(NamedTuple):
    """What each output's v_p is made of from step to step, shape (outputs,) each."""

    sums: Array
    """Sum of the errors of this sample so far, rad/s."""
    applied_sums: Array
    """Sum of the v_p applied since the last sample, rad/s²."""
    applied: Array
    """v_p as applied in this control period, rad/s²."""
    v: Array
    """v_p (63), held between samples, rad/s²."""
    dither: Array
    """Its random part, rad/s²."""
    drawn: Array
    """The random level to be added to the next one, rad/s²."""
    jumps: Array
    """What is left of the known jumps of the error, rad/s."""
    fades: Array
    """Share of the bound of v_p in force."""
    skills: Array
    """Skill in the middle of the horizon."""
    errors: Array
    """The last errors delta = chi - r, rad/s."""
    unforeseen: Array
    """The same less what was left of the known jumps, rad/s."""


@kernel
def signals_in(rows: Array) -> Signals:
    """Return the rows of a table, shape (11, outputs), as signals."""
    return Signals(
        rows[0],
        rows[1],
        rows[2],
        rows[3],
        rows[4],
        rows[5],
        rows[6],
        rows[7],
        rows[8],
        rows[9],
        rows[10],
    )


@kernel
def hold(signals: Signals, decay: float) -> None:
    """End a control period: known jumps die away, and v_p is taken to be applied as it is."""
    for z in range(signals.v.size):
        signals.jumps[z] *= decay
        signals.applied[z] = signals.v[z]


@kernel
def gather(
    speeds: Array, wanted: Array, sampled: bool, due: bool, decay: float, rows: Array
) -> bool:
    """Add a control period to the sums of a sample; return False if an error is not finite.

    speeds, wanted : shape (outputs,), chi and r, rad/s
    sampled : whether this period's errors belong to the sample
    due     : whether the sample is complete; :func:`renew` ends the period then
    decay   : share of a known jump that is left after a period
    rows    : the :class:`Signals`
    """
    signals = signals_in(rows)
    for z in range(speeds.size):
        if not math.isfinite(speeds[z] - wanted[z]):
            return False
    for z in range(speeds.size):
        signals.errors[z] = speeds[z] - wanted[z]
        signals.applied_sums[z] += signals.applied[z]
        signals.unforeseen[z] = signals.errors[z] - signals.jumps[z]
        if sampled:
            signals.sums[z] += signals.unforeseen[z]
    if not due:
        hold(signals, decay)
    return True


@kernel
def roll_forward(machine: Machine, past: Past, first: int, offset: float, out: Array) -> None:
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
        past.seen_errors[i] = past.errors[first + i]
    for i in range(1, n_moves):
        past.seen_moves[i] = past.moves[first + i]
    for j in range(out.size):
        if j > 0:
            for i in range(n_errors - 1, 0, -1):
                past.seen_errors[i] = past.seen_errors[i - 1]
            past.seen_errors[0] = out[j - 1]
            for i in range(n_moves - 1, 0, -1):
                past.seen_moves[i] = past.seen_moves[i - 1]
        past.seen_moves[0] = past.planned[j]
        look(machine, past.seen_errors, past.seen_moves, 0)
        out[j] = predict(machine) + offset


@kernel
def free_response(machine: Machine, past: Past, held: float, out: Array) -> None:
    """Write Psi_free (56): what happens when v_p(t-1) = ``held`` is held on, (46), (57)-(59).

    out : shape (n_p,), overwritten (rad/s)
    """
    past.planned[:] = held
    roll_forward(machine, past, 0, past.offsets[0], out)


@kernel
def step_response(
    machine: Machine, past: Past, held: float, probe: float, free: Array, out: Array
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
def response(matrix: Array, changes: Array, free: Array, out: Array) -> None:
    """Write Psi = S dv + Psi_free, (45), (52)-(53) with dv of (55), shape (n_p,), in rad/s."""
    for j in range(out.size):
        out[j] = free[j]
        for i in range(min(j + 1, changes.size)):
            out[j] += matrix[j, i] * changes[i]


@kernel
def foresee(
    machine: Machine,
    past: Past,
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


@kernel
def foretell(jump: float, decays: Array, change: Array, known: Array) -> None:
    """Write the known part of the errors to come: jumps past and to come, dying away by K.

    jump   : what is left of the past ones, rad/s
    decays : shape (n_p + 1,), share of a jump that is left 0, 1, ... periods T later
    change : shape (n_p,), jumps in each period T to come, rad/s
    known  : shape (n_p,), overwritten, rad/s
    """
    for j in range(known.size):
        known[j] = jump * decays[j + 1]
    for j in range(change.size):
        for i in range(j, known.size):
            known[i] += change[j] * decays[i - j]


@kernel
def plan(
    steps: Array,
    free: Array,
    held: float,
    error_weight: float,
    move_weight: float,
    dv_max: float,
    v_max: float,
    matrix: Array,
    space: Space,
    prediction: Array,
) -> int:
    """Write the optimal moves into ``space`` and what they lead to; return the solver's status.

    steps, free  : the step response (48) and Psi_free (56)
    held         : v_p(t-1), inside v_max (rad/s²)
    error_weight, move_weight, dv_max, v_max : mu, pi and the bounds (rad/s²) of the program
    matrix       : S (54), shape (n_p, n_c), overwritten
    prediction   : Psi (52), shape (n_p,), overwritten
    """
    toeplitz(steps, matrix)
    most = 20 * space.slope.size
    status = solve(matrix, free, error_weight, move_weight, held, dv_max, v_max, most, space)
    response(matrix, space.changes, free, prediction)
    return status
