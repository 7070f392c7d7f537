# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A dual active-set solver for the program of :mod:`t3mpc_ros.mpc.program`."""

import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.program import (
    Space,
    bound,
    factor,
    normal_equations,
    row_value,
    solve_lower,
    solve_upper,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

OPTIMAL = 0
"""The answer satisfies the Karush-Kuhn-Tucker conditions."""
NOT_POSITIVE = 1
"""mu SᵀS + pi I is not positive definite, or something is not finite; the answer is no move."""
INFEASIBLE = 2
"""No move satisfies the constraints (v_p(t-1) lies outside its bound); the answer is no move."""
UNFINISHED = 3
"""The cap on iterations was met; the answer is no move."""

CLOSE = 1e-10
"""How far outside a bound still counts as on it, relative to the larger of the two bounds."""


@kernel
def row_normal(row: int, side: float, lower: Array, out: Array) -> None:
    """Write L⁻¹ times the outward normal of a row's bound into ``out``, shape (n,)."""
    n = out.size
    for i in range(n):
        out[i] = side if i == row or i <= row - n else 0.0
    solve_lower(lower, out)


@kernel
def depends(row: int, active: Indices, count: int, islands: Indices) -> bool:
    """Decide exactly whether a row is a linear combination of the active ones.

    In the running sums c_i the rows are c_i and c_i - c_(i-1): edges of a graph whose points are
    0 (the ground) and 1 ... n. Edges depend on each other exactly when they close a loop, so
    joining points to islands answers without a tolerance. (Rows 0 and n are twice the same edge.)
    """
    n = islands.size - 1
    for point in range(n + 1):
        islands[point] = point
    for k in range(count):
        one = active[k] if active[k] < n else 0
        two = active[k] + 1 if active[k] < n else active[k] - n + 1
        kept, lost = islands[one], islands[two]
        for point in range(n + 1):
            if islands[point] == lost:
                islands[point] = kept
    one = row if row < n else 0
    two = row + 1 if row < n else row - n + 1
    joined: bool = islands[one] == islands[two]
    return joined


@kernel
def split(space: Space, count: int) -> None:
    """Split ``space.normal`` into its share in the span of the active normals and the rest.

    Twice, because the first pass leaves rounding of the order of what it removed.
    """
    for k in range(count):
        space.share[k] = 0.0
    for _ in range(2):
        for k in range(count):
            part = 0.0
            for i in range(space.normal.size):
                part += space.basis[k, i] * space.normal[i]
            for i in range(space.normal.size):
                space.normal[i] -= part * space.basis[k, i]
            space.share[k] += part


@kernel
def rebuild(space: Space, count: int) -> None:
    """Write ``basis`` and ``triangle`` of the first ``count`` active rows, from scratch.

    With a dozen unknowns this costs no more than updating, and rounding cannot build up.
    """
    for k in range(count):
        row_normal(space.active[k], space.sides[k], space.lower, space.normal)
        split(space, k)
        for j in range(k):
            space.triangle[j, k] = space.share[j]
        length = 0.0
        for i in range(space.normal.size):
            length += space.normal[i] * space.normal[i]
        length = math.sqrt(length)
        space.triangle[k, k] = length
        for i in range(space.normal.size):
            space.basis[k, i] = space.normal[i] / length


@kernel
def settle(space: Space, count: int, before: float, dv_max: float, v_max: float) -> None:
    """Write the optimum with the active rows held at their bounds, and their multipliers."""
    n = space.slope.size
    # The part of the unconstrained optimum that the active rows leave free. Splitting it off
    # first keeps the rounding of a distant optimum out of an answer that may be much smaller.
    space.normal[:] = space.start
    split(space, count)
    space.changes[:] = space.normal
    for k in range(count):
        along = bound(space.active[k], space.sides[k], n, before, dv_max, v_max)
        for j in range(k):
            along -= space.triangle[j, k] * space.weights[j]
        # Where the answer must lie along basis k, for the active rows to be at their bounds.
        space.weights[k] = along / space.triangle[k, k]
        for i in range(n):
            space.changes[i] += space.weights[k] * space.basis[k, i]
    for k in range(count - 1, -1, -1):
        total = space.share[k] - space.weights[k]
        for j in range(k + 1, count):
            total -= space.triangle[k, j] * space.weights[j]
        space.weights[k] = total / space.triangle[k, k]
    solve_upper(space.lower, space.changes)


@kernel
def find_violation(
    space: Space, count: int, before: float, dv_max: float, v_max: float, close: float
) -> tuple[int, float]:
    """Return the row furthest outside a bound and the side it is on; row -1 when none is."""
    n = space.changes.size
    worst, side, most = -1, 1.0, close
    total = 0.0
    for row in range(2 * n):
        if row == n:
            total = 0.0
        value = space.changes[row] if row < n else 0.0
        if row >= n:
            total += space.changes[row - n]
            value = total
        for way in (1.0, -1.0):
            beyond = way * value - bound(row, way, n, before, dv_max, v_max)
            if beyond > most:
                held = False
                for k in range(count):
                    held = held or space.active[k] == row
                if not held:
                    worst, side, most = row, way, beyond
    return worst, side


@kernel
def solve(
    matrix: Array,
    free: Array,
    error_weight: float,
    move_weight: float,
    before: float,
    dv_max: float,
    v_max: float,
    most: int,
    space: Space,
) -> int:
    """Write the optimal changes and multipliers into ``space``; return a status.

    Goldfarb and Idnani (1983), a dual active-set method: it starts at the unconstrained optimum
    (62), with E10, and adds the bound that is violated most, dropping active bounds whose
    multiplier would turn negative. When (62) keeps the bounds nothing more is done, which is the
    usual case; so there is nothing to gain from remembering the last active set.

    matrix, free              : S, shape (n_p, n_c); Psi_free, shape (n_p,)
    error_weight, move_weight : mu and pi (> 0)
    before                    : v_p(t-1), rad/s²; inside v_max, or the status is INFEASIBLE
    dv_max, v_max             : rad/s², zero allowed
    most                      : cap on additions and droppings together
    """
    n = space.slope.size
    normal_equations(matrix, free, error_weight, move_weight, space.hessian, space.slope)
    fine = factor(space.hessian, space.lower)
    total = 0.0
    for i in range(n):
        space.start[i] = -space.slope[i]
        total += space.slope[i]
    space.multipliers[:] = 0.0
    space.changes[:] = 0.0
    if not fine or not math.isfinite(total + before):
        return NOT_POSITIVE
    if dv_max == 0.0 and abs(before) <= v_max:
        # Nothing can move: the bounds on the changes carry the whole slope.
        for i in range(n):
            space.multipliers[0, i] = max(space.slope[i], 0.0)
            space.multipliers[1, i] = max(-space.slope[i], 0.0)
        return OPTIMAL
    solve_lower(space.lower, space.start)
    close = CLOSE * max(dv_max, v_max)
    count = 0
    settle(space, count, before, dv_max, v_max)
    worst, side = find_violation(space, count, before, dv_max, v_max, close)
    for _ in range(most):
        if worst < 0:
            for k in range(count):
                upper = 1 if space.sides[k] > 0.0 else 0
                space.multipliers[upper, space.active[k]] = max(space.weights[k], 0.0)
            return OPTIMAL
        dependent = depends(worst, space.active, count, space.islands)
        row_normal(worst, side, space.lower, space.normal)
        split(space, count)
        # Longest dual step before an active multiplier reaches zero.
        longest, drop = math.inf, -1
        for k in range(count - 1, -1, -1):
            rate = space.share[k]
            for j in range(k + 1, count):
                rate -= space.triangle[k, j] * space.share[j]
            space.share[k] = rate / space.triangle[k, k]
            if space.share[k] > 1e-12 and space.weights[k] < longest * space.share[k]:
                longest, drop = space.weights[k] / space.share[k], k
        # Step that reaches the new bound; a dependent normal cannot get there.
        needed = math.inf
        if not dependent:
            squared = 0.0
            for i in range(n):
                squared += space.normal[i] * space.normal[i]
            gap = side * row_value(worst, space.changes)
            gap -= bound(worst, side, n, before, dv_max, v_max)
            needed = max(gap, 0.0) / squared
        step = min(longest, needed)
        if math.isinf(step):
            space.changes[:] = 0.0
            return INFEASIBLE
        if needed <= longest:
            space.active[count] = worst
            space.sides[count] = side
            count += 1
            rebuild(space, count)
            settle(space, count, before, dv_max, v_max)
            worst, side = find_violation(space, count, before, dv_max, v_max, close)
        else:
            if not dependent:
                solve_upper(space.lower, space.normal)
                for i in range(n):
                    space.changes[i] -= step * space.normal[i]
            for k in range(count):
                space.weights[k] -= step * space.share[k]
            count -= 1
            for k in range(drop, count):
                space.active[k] = space.active[k + 1]
                space.sides[k] = space.sides[k + 1]
                space.weights[k] = space.weights[k + 1]
            rebuild(space, count)
    space.changes[:] = 0.0
    return UNFINISHED
