# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Box-constrained quadratic program of the predictive baselines, by projected Newton steps.

The problem, for n moves x of a command:

    minimise    x'Hx/2 + g'x    subject to    low <= x <= high,

H being positive definite; infinite bounds are allowed. Unlike the program of
:mod:`t3mpc_ros.mpc.quadratic_program`, it has no bounds on running sums of the moves. That solver
starts at the unconstrained optimum and adds one bound at a time, while a planned ramp has up to
forty active bounds. This one starts from the previous plan and changes many bounds at once.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.quadratic_program import NOT_POSITIVE, OPTIMAL, UNFINISHED

__all__ = [
    'NOT_POSITIVE',
    'OPTIMAL',
    'UNFINISHED',
    'Workspace',
    'make_workspace',
    'multiply',
    'response_matrix',
    'shift_plan',
    'solve',
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GRADIENT_TOLERANCE = 1e-13
"""Slope of a free move, relative to its terms, or step, relative to the moves, that is none."""
PIVOT_TOLERANCE = 1e-4
"""Share of the decrease that the slope promises which a step must reach (Armijo)."""
MAX_NEWTON_STEPS = 20
"""Steps that may change many bounds at once; they nearly always do."""


class Workspace(NamedTuple):
    """Program of n moves and the working memory of its solver; made once by :func:`make_space`."""

    hessian: Array
    """H, shape (n, n), written by the caller."""
    slope: Array
    """g, shape (n,), written by the caller."""
    low: Array
    """Shape (n,), written by the caller; -inf allowed."""
    high: Array
    """Shape (n,), at least ``low``; inf allowed."""
    moves: Array
    """x, shape (n,): where to start when the solver is called, the answer afterwards."""
    gradient: Array
    """Hx + g, shape (n,)."""
    direction: Array
    """Shape (n,): working memory, as all that follows."""
    step: Array
    product: Array
    lower: Array
    """Cholesky factor of the rows and columns of H that belong to free moves, shape (n, n)."""
    free: Indices
    """Shape (n,): moves that are not held at a bound, ascending."""
    held: Indices
    """Shape (n,): 1 for a move held at its bound."""
    factored: Indices
    """Shape (n + 1,): how many moves ``lower`` is made for (-1: none), and which."""


def make_workspace(moves: int) -> Workspace:
    """Return a program with ``moves`` unknowns, all bounds infinite and H zero."""
    if moves < 1:
        raise ValueError(f'moves must be at least 1: got {moves}')
    factored = np.zeros(moves + 1, dtype=np.int64)
    factored[0] = -1
    return Workspace(
        hessian=np.zeros((moves, moves)),
        slope=np.zeros(moves),
        low=np.full(moves, -np.inf),
        high=np.full(moves, np.inf),
        moves=np.zeros(moves),
        gradient=np.zeros(moves),
        direction=np.zeros(moves),
        step=np.zeros(moves),
        product=np.zeros(moves),
        lower=np.zeros((moves, moves)),
        free=np.zeros(moves, dtype=np.int64),
        held=np.zeros(moves, dtype=np.int64),
        factored=factored,
    )


def response_matrix(steps: Array, moves: int) -> Array:
    """Return S, shape (N, moves): ``S[j, i]`` is what move i adds to the output after j + 1.

    steps : shape (N,), the output 1 ... N periods after a step of one in the command
    """
    rows, columns = np.indices((steps.size, moves))
    return np.where(rows >= columns, steps[np.maximum(rows - columns, 0)], 0.0)


@kernel
def shift_plan(moves: Array, kept: float) -> None:
    """Shift the last plan by a period as a warm start; the last entry is repeated or 0.

    kept : share of the last entry that the new one has
    """
    for i in range(moves.size - 1):
        moves[i] = moves[i + 1]
    moves[moves.size - 1] *= kept


@kernel
def multiply(matrix: Array, x: Array, out: Array) -> None:
    """Write ``matrix`` x into ``out``; the matrix is symmetric, so its rows serve as columns."""
    out[:] = 0.0
    for k in range(x.size):
        if x[k] != 0.0:
            for i in range(out.size):
                out[i] += matrix[k, i] * x[k]


@kernel
def is_factored(space: Workspace, count: int) -> bool:
    """Decide whether ``lower`` is made for the first ``count`` of ``free``."""
    equal: bool = space.factored[0] == count
    for i in range(count):
        equal = equal and space.factored[i + 1] == space.free[i]
    return equal


@kernel
def factor_free(space: Workspace, count: int) -> bool:
    """Write the Cholesky factor for the first ``count`` of ``free``; False if there is none.

    Nothing is done when the last factor was made for the same moves of the same H.
    """
    free, lower, factored = space.free, space.lower, space.factored
    if is_factored(space, count):
        return True
    factored[0] = -1
    for i in range(count):
        for k in range(i + 1):
            total = space.hessian[free[i], free[k]]
            for j in range(k):
                total -= lower[i, j] * lower[k, j]
            if i == k:
                if not (total > 0.0 and math.isfinite(total)):
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    for i in range(count):
        factored[i + 1] = free[i]
    factored[0] = count
    return True


@kernel
def newton_direction(space: Workspace, count: int) -> None:
    """Write into ``direction`` the step to the optimum of the free moves, the others held."""
    free, lower, work = space.free, space.lower, space.step
    for i in range(count):
        total = -space.gradient[free[i]]
        for j in range(i):
            total -= lower[i, j] * work[j]
        work[i] = total / lower[i, i]
    # Column by column, so that the rows of the factor are read along.
    for i in range(count - 1, -1, -1):
        work[i] /= lower[i, i]
        for j in range(i):
            work[j] -= lower[i, j] * work[i]
    space.direction[:] = 0.0
    for i in range(count):
        space.direction[free[i]] = work[i]


@kernel
def projected_step(space: Workspace, length: float) -> tuple[bool, bool]:
    """Take ``length`` times ``direction``, projected onto the bounds.

    Returns whether the step decreases the cost enough (otherwise nothing changes), and whether it
    was a full step: not projected, or no longer than rounding.
    """
    promised, bent, cut, longest, largest = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(space.moves.size):
        there = space.moves[i] + length * space.direction[i]
        held = min(max(there, space.low[i]), space.high[i])
        cut = max(cut, abs(there - held))
        space.step[i] = held - space.moves[i]
        longest = max(longest, abs(space.step[i]))
        largest = max(largest, abs(space.moves[i]))
        promised += space.gradient[i] * space.step[i]
    if longest <= GRADIENT_TOLERANCE * largest:
        return True, True
    multiply(space.hessian, space.step, space.product)
    for i in range(space.moves.size):
        bent += space.step[i] * space.product[i]
    if not promised + 0.5 * bent <= PIVOT_TOLERANCE * promised:
        return False, False
    for i in range(space.moves.size):
        # Once more from the bounds: adding the step could miss them by rounding.
        there = space.moves[i] + length * space.direction[i]
        space.moves[i] = min(max(there, space.low[i]), space.high[i])
    return True, cut == 0.0 and length == 1.0


@kernel
def update_gradient(space: Workspace) -> float:
    """Write Hx + g into ``gradient`` and return the largest of its terms."""
    multiply(space.hessian, space.moves, space.gradient)
    terms = 0.0
    for i in range(space.moves.size):
        terms = max(terms, max(abs(space.gradient[i]), abs(space.slope[i])))
        space.gradient[i] += space.slope[i]
    return terms


@kernel
def solve_active_set(space: Workspace, most: int) -> int:
    """Solve by changing one bound at a time, and return a status.

    The primal active-set method (Nocedal and Wright 2006, section 16.5), which always
    terminates: it steps to the optimum of the free moves, or to the first bound on the way, which
    becomes active; at that optimum the bound with the largest wrong-signed slope is released.
    """
    moves, low, high, held = space.moves, space.low, space.high, space.held
    n = moves.size
    for i in range(n):
        held[i] = 1 if moves[i] <= low[i] or moves[i] >= high[i] else 0
    for _ in range(most):
        update_gradient(space)
        count = 0
        for i in range(n):
            if held[i] == 0:
                space.free[count] = i
                count += 1
        if not factor_free(space, count):
            return NOT_POSITIVE
        newton_direction(space, count)
        length, first = 1.0, -1
        for i in range(n):
            towards = space.direction[i]
            end = high[i] if towards > 0.0 else low[i]
            if towards != 0.0 and moves[i] + towards * length > high[i]:
                length, first = max(end - moves[i], 0.0) / towards, i
            elif towards != 0.0 and moves[i] + towards * length < low[i]:
                length, first = min(end - moves[i], 0.0) / towards, i
        for i in range(n):
            moves[i] = min(max(moves[i] + length * space.direction[i], low[i]), high[i])
        if first >= 0:
            moves[first] = high[first] if space.direction[first] > 0.0 else low[first]
            held[first] = 1
            continue
        terms = update_gradient(space)
        worst, pull = -1, GRADIENT_TOLERANCE * terms
        for i in range(n):
            if held[i] == 1 and low[i] < high[i]:
                away = -space.gradient[i] if moves[i] <= low[i] else space.gradient[i]
                if away > pull:
                    worst, pull = i, away
        if worst < 0:
            return OPTIMAL
        held[worst] = 0
    return UNFINISHED


@kernel
def solve(space: Workspace, most: int) -> int:
    """Write the optimal moves into ``space.moves`` and return a status.

    Projected Newton steps (Bertsekas 1982, doi 10.1137/0320018): moves at a bound that the slope
    presses against it are held, the others go to their common optimum along a path bent at the
    bounds, and so on until no free move has a slope left. From a good start that takes two or
    three steps; should it take more than BOLD, or a step not pay, :func:`finish` goes on. The
    moves keep their bounds whatever the status.

    Set ``space.factored[0] = -1`` after changing H.

    most : cap on the steps of :func:`finish`
    returned : OPTIMAL, NOT_POSITIVE (H is not, or something is not finite) or UNFINISHED
    """
    moves, low, high, gradient = space.moves, space.low, space.high, space.gradient
    n = moves.size
    for i in range(n):
        if not (low[i] <= high[i] and math.isfinite(space.slope[i])):
            return NOT_POSITIVE
        start = moves[i] if math.isfinite(moves[i]) else 0.0
        moves[i] = min(max(start, low[i]), high[i])
    whole = False
    for _ in range(MAX_NEWTON_STEPS):
        terms = update_gradient(space)
        count, steepest = 0, 0.0
        for i in range(n):
            pressed = (moves[i] <= low[i] and gradient[i] > 0.0) or (
                moves[i] >= high[i] and gradient[i] < 0.0
            )
            if not pressed:
                space.free[count] = i
                count += 1
                steepest = max(steepest, abs(gradient[i]))
        # The optimum of the same free moves cannot be met better than it was.
        if steepest <= GRADIENT_TOLERANCE * terms or (whole and is_factored(space, count)):
            return OPTIMAL
        if not factor_free(space, count):
            return NOT_POSITIVE
        newton_direction(space, count)
        length = 1.0
        paid, whole = projected_step(space, length)
        while not paid and length > 1e-3:
            length *= 0.5
            paid, whole = projected_step(space, length)
        if not paid:
            break
    return solve_active_set(space, most)
