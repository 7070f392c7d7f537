# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Quadratic program for the moves of v_p, (34), (60)-(62) with E10, and its active-set solver."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Workspace(NamedTuple):
    """Everything the solver writes to, for n = n_c moves; made once by :func:`make_space`."""

    hessian: Array
    """mu SᵀS + pi I, shape (n, n)."""
    slope: Array
    """mu SᵀPsi_free, shape (n,)."""
    lower: Array
    """Cholesky factor L of the Hessian, shape (n, n)."""
    changes: Array
    """The answer dv, shape (n,), rad/s²."""
    multipliers: Array
    """Shape (2, 2n): of the lower bounds and of the upper bounds of the rows, all >= 0."""
    active: Indices
    """Shape (n,): rows held at a bound, in order of adding."""
    sides: Array
    """Shape (n,): 1 where an active row is held by its upper bound, -1 by its lower."""
    weights: Array
    """Shape (n,): multipliers of the active rows."""
    basis: Array
    """Shape (n, n): orthonormal rows that span L⁻¹ times the active normals."""
    triangle: Array
    """Shape (n, n): L⁻¹ times normal k is the sum over j <= k of triangle[j, k] basis[j]."""
    normal: Array
    """Shape (n,): working memory, as the next two."""
    share: Array
    start: Array
    components: Indices
    """Shape (n + 1,): working memory of ``active_set.depends``."""


def make_workspace(moves: int) -> Workspace:
    """Return the working memory of a program with ``moves`` (n_c) unknowns."""
    if moves < 1:
        raise ValueError(f'moves must be at least 1: got {moves}')
    return workspace_view(
        np.zeros(workspace_size(moves)), np.zeros((2, moves + 1), dtype=np.int64), moves
    )


@kernel
def workspace_size(moves: int) -> int:
    """Return how many numbers make the space of a program, whole numbers not counted."""
    return 4 * moves * moves + 11 * moves


@kernel
def workspace_view(store: Array, whole: Indices, moves: int) -> Workspace:
    """Return the views of a flat store, and of whole numbers (2, n + 1), that are a space."""
    tables = store[: 4 * moves * moves].reshape((4, moves, moves))
    rows = store[4 * moves * moves :].reshape((11, moves))
    return Workspace(
        tables[0],
        rows[0],
        tables[1],
        rows[1],
        rows[7:].reshape((2, 2 * moves)),
        whole[0, :moves],
        rows[2],
        rows[3],
        tables[2],
        tables[3],
        rows[4],
        rows[5],
        rows[6],
        whole[1],
    )


@kernel
def cost(
    matrix: Array, free: Array, changes: Array, error_weight: float, move_weight: float
) -> float:
    """Return J = mu PsiᵀPsi + pi dvᵀdv, equations (34) and (60), in units of the weights."""
    total = 0.0
    for j in range(free.size):
        psi = free[j]
        for i in range(changes.size):
            psi += matrix[j, i] * changes[i]
        total += error_weight * psi * psi
    for i in range(changes.size):
        total += move_weight * changes[i] * changes[i]
    return total


@kernel
def normal_equations(
    matrix: Array,
    free: Array,
    error_weight: float,
    move_weight: float,
    hessian: Array,
    slope: Array,
) -> None:
    """Write mu SᵀS + pi I and mu SᵀPsi_free, the two parts of half the gradient (61).

    matrix  : S, shape (n_p, n_c)
    free    : Psi_free, shape (n_p,)
    hessian : shape (n_c, n_c), overwritten
    slope   : shape (n_c,), overwritten
    """
    n = slope.size
    for i in range(n):
        for k in range(i + 1):
            total = 0.0
            for j in range(free.size):
                total += matrix[j, i] * matrix[j, k]
            hessian[i, k] = error_weight * total
            hessian[k, i] = hessian[i, k]
        hessian[i, i] += move_weight
        total = 0.0
        for j in range(free.size):
            total += matrix[j, i] * free[j]
        slope[i] = error_weight * total


@kernel
def cholesky(matrix: Array, lower: Array) -> bool:
    """Write the Cholesky factor of ``matrix`` into ``lower``; return False if there is none."""
    for i in range(matrix.shape[0]):
        for k in range(i + 1):
            total = matrix[i, k]
            for j in range(k):
                total -= lower[i, j] * lower[k, j]
            if i == k:
                if not (total > 0.0 and math.isfinite(total)):
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    return True


@kernel
def solve_lower(lower: Array, x: Array) -> None:
    """Replace ``x`` by L⁻¹ x."""
    for i in range(x.size):
        for j in range(i):
            x[i] -= lower[i, j] * x[j]
        x[i] /= lower[i, i]


@kernel
def solve_upper(lower: Array, x: Array) -> None:
    """Replace ``x`` by L⁻ᵀ x."""
    for i in range(x.size - 1, -1, -1):
        for j in range(i + 1, x.size):
            x[i] -= lower[j, i] * x[j]
        x[i] /= lower[i, i]


@kernel
def unconstrained_optimum(lower: Array, slope: Array, changes: Array) -> None:
    """Write dv = -mu (mu SᵀS + pi I)⁻¹ SᵀPsi_free, equation (62) with E10.

    E10: the printed right side lacks the minus sign that follows from (61).

    lower   : Cholesky factor of the Hessian
    slope   : mu SᵀPsi_free
    changes : shape (n_c,), overwritten (rad/s²)
    """
    for i in range(changes.size):
        changes[i] = -slope[i]
    solve_lower(lower, changes)
    solve_upper(lower, changes)


@kernel
def row_value(row: int, changes: Array) -> float:
    """Return dv_row, or for the rows after the first n the sum of dv up to that move."""
    n = changes.size
    if row < n:
        value: float = changes[row]
        return value
    total = 0.0
    for i in range(row - n + 1):
        total += changes[i]
    return total


@kernel
def bound(row: int, side: float, n: int, before: float, dv_max: float, v_max: float) -> float:
    """Return the bound of a row on one side, as a bound on side * (row's value)."""
    return dv_max if row < n else v_max - side * before


@kernel
def kkt_residuals(
    space: Workspace, before: float, dv_max: float, v_max: float, out: Array
) -> float:
    """Return the largest of the four Karush-Kuhn-Tucker residuals of the answer in ``space``.

    All are relative, so that one figure serves every scale of weights and bounds. With g the
    larger of |mu SᵀPsi_free| and |H||dv|, and w the larger of the two bounds:

    out[0] stationarity    : |H dv + mu SᵀPsi_free + A'(upper - lower multipliers)| / g
    out[1] primal          : distance outside the bounds / w
    out[2] dual            : most negative multiplier / g
    out[3] complementarity : largest |multiplier * distance to its bound| / (g w)
    """
    n = space.slope.size
    size, steepest, largest = 0.0, 0.0, 0.0
    for i in range(n):
        size = max(size, abs(space.changes[i]))
        steepest = max(steepest, abs(space.slope[i]))
        for k in range(n):
            largest = max(largest, abs(space.hessian[i, k]))
    steepest = max(steepest, largest * size)
    widest = max(dv_max, v_max)
    gradient_scale = steepest if steepest > 0.0 else 1.0
    width_scale = widest if widest > 0.0 else 1.0
    out[:] = 0.0
    for i in range(n):
        total = space.slope[i]
        for k in range(n):
            total += space.hessian[i, k] * space.changes[k]
        for row in range(2 * n):
            if row == i or row - n >= i:
                total += space.multipliers[1, row] - space.multipliers[0, row]
        out[0] = max(out[0], abs(total) / gradient_scale)
    for row in range(2 * n):
        value = row_value(row, space.changes)
        for upper in range(2):
            side = 1.0 if upper == 1 else -1.0
            beyond = side * value - bound(row, side, n, before, dv_max, v_max)
            multiplier = space.multipliers[upper, row]
            out[1] = max(out[1], beyond / width_scale)
            out[2] = max(out[2], -multiplier / gradient_scale)
            out[3] = max(out[3], abs(multiplier * beyond) / (gradient_scale * width_scale))
    worst: float = max(max(out[0], out[1]), max(out[2], out[3]))
    return worst


OPTIMAL = 0
"""The answer satisfies the Karush-Kuhn-Tucker conditions."""
NOT_POSITIVE = 1
"""mu SᵀS + pi I is not positive definite, or something is not finite; the answer is no move."""
INFEASIBLE = 2
"""No move satisfies the constraints (v_p(t-1) lies outside its bound); the answer is no move."""
UNFINISHED = 3
"""The cap on iterations was met; the answer is no move."""

BOUND_TOLERANCE = 1e-10
"""How far outside a bound still counts as on it, relative to the larger of the two bounds."""


@kernel
def row_normal(row: int, side: float, lower: Array, out: Array) -> None:
    """Write L⁻¹ times the outward normal of a row's bound into ``out``, shape (n,)."""
    n = out.size
    for i in range(n):
        out[i] = side if i == row or i <= row - n else 0.0
    solve_lower(lower, out)


@kernel
def is_dependent(row: int, active: Indices, count: int, components: Indices) -> bool:
    """Decide exactly whether a row is a linear combination of the active ones.

    In the running sums c_i the rows are c_i and c_i - c_(i-1): edges of a graph whose points are
    0 (the ground) and 1 ... n. Edges depend on each other exactly when they close a loop, so
    joining points to islands answers without a tolerance. (Rows 0 and n are twice the same edge.)
    """
    n = components.size - 1
    for point in range(n + 1):
        components[point] = point
    for k in range(count):
        one = active[k] if active[k] < n else 0
        two = active[k] + 1 if active[k] < n else active[k] - n + 1
        kept, lost = components[one], components[two]
        for point in range(n + 1):
            if components[point] == lost:
                components[point] = kept
    one = row if row < n else 0
    two = row + 1 if row < n else row - n + 1
    joined: bool = components[one] == components[two]
    return joined


@kernel
def project_out(space: Workspace, count: int) -> None:
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
def rebuild_basis(space: Workspace, count: int) -> None:
    """Write ``basis`` and ``triangle`` of the first ``count`` active rows, from scratch.

    With a dozen unknowns this costs no more than updating, and rounding cannot build up.
    """
    for k in range(count):
        row_normal(space.active[k], space.sides[k], space.lower, space.normal)
        project_out(space, k)
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
def solve_with_active_rows(
    space: Workspace, count: int, before: float, dv_max: float, v_max: float
) -> None:
    """Write the optimum with the active rows held at their bounds, and their multipliers."""
    n = space.slope.size
    # The part of the unconstrained optimum that the active rows leave free. Splitting it off
    # first keeps the rounding of a distant optimum out of an answer that may be much smaller.
    space.normal[:] = space.start
    project_out(space, count)
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
    space: Workspace, count: int, before: float, dv_max: float, v_max: float, close: float
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
def solve_quadratic_program(
    matrix: Array,
    free: Array,
    error_weight: float,
    move_weight: float,
    before: float,
    dv_max: float,
    v_max: float,
    most: int,
    space: Workspace,
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
    fine = cholesky(space.hessian, space.lower)
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
    close = BOUND_TOLERANCE * max(dv_max, v_max)
    count = 0
    solve_with_active_rows(space, count, before, dv_max, v_max)
    worst, side = find_violation(space, count, before, dv_max, v_max, close)
    for _ in range(most):
        if worst < 0:
            for k in range(count):
                upper = 1 if space.sides[k] > 0.0 else 0
                space.multipliers[upper, space.active[k]] = max(space.weights[k], 0.0)
            return OPTIMAL
        dependent = is_dependent(worst, space.active, count, space.components)
        row_normal(worst, side, space.lower, space.normal)
        project_out(space, count)
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
            rebuild_basis(space, count)
            solve_with_active_rows(space, count, before, dv_max, v_max)
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
            rebuild_basis(space, count)
    space.changes[:] = 0.0
    return UNFINISHED
