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
"""Quadratic program for the moves of v_p, (34), (60)-(62) with E10, and its active-set solver.

The problem, for the changes dv of the predictive signal in the next n_c periods:

    minimise    mu |S dv + Psi_free|² + pi |dv|²
    subject to  |dv_i| <= dv_max,   |v_p(t-1) + dv_0 + ... + dv_i| <= v_max.

Row i < n_c of the constraints is dv_i, row n_c + i the sum up to i. Each has a lower and an upper
bound with one multiplier each.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel

Indices = NDArray[np.int64]


OPTIMAL = 0  # the solution satisfies the Karush-Kuhn-Tucker conditions
NOT_POSITIVE = 1  # mu SᵀS + pi I is not positive definite, or a number is not finite; dv is zero
INFEASIBLE = 2  # no dv satisfies the constraints (v_p(t-1) is outside its bound); dv is zero
UNFINISHED = 3  # the maximum number of iterations was reached; dv is zero

BOUND_TOLERANCE = 1e-10  # tolerance of a bound, relative to the larger of the two bounds


class Workspace(NamedTuple):
    """Results and work space of the solver for n = n_c changes."""

    hessian: Array  # mu SᵀS + pi I, shape (n, n)
    gradient: Array  # mu SᵀPsi_free, shape (n,)
    lower: Array  # Cholesky factor L of the Hessian, shape (n, n)
    changes: Array  # solution dv, shape (n,), rad/s²
    multipliers: Array
    """Shape (2, 2n): multipliers of the lower and of the upper bounds of the rows, all >= 0."""
    active: Indices  # shape (n,): active rows, in the order in which they were added
    sides: Array  # shape (n,): 1 where an active row is at its upper bound, -1 at its lower
    active_multipliers: Array  # shape (n,): multipliers of the active rows
    basis: Array  # shape (n, n): orthonormal rows that span L⁻¹ times the active normals
    triangle: Array
    """Shape (n, n): L⁻¹ times normal k is the sum over j <= k of triangle[j, k] basis[j]."""
    normal: Array  # shape (n,): work space, as the next two
    projection: Array
    unconstrained: Array
    components: Indices  # shape (n + 1,): work space of :func:`is_dependent`


def make_workspace(moves: int) -> Workspace:
    """Return the work space for ``moves`` (n_c) unknowns."""
    square, row = (moves, moves), moves
    return Workspace(
        hessian=np.zeros(square),
        gradient=np.zeros(row),
        lower=np.zeros(square),
        changes=np.zeros(row),
        multipliers=np.zeros((2, 2 * moves)),
        active=np.zeros(row, dtype=np.int64),
        sides=np.zeros(row),
        active_multipliers=np.zeros(row),
        basis=np.zeros(square),
        triangle=np.zeros(square),
        normal=np.zeros(row),
        projection=np.zeros(row),
        unconstrained=np.zeros(row),
        components=np.zeros(moves + 1, dtype=np.int64),
    )


@kernel
def solve_quadratic_program(
    matrix: Array,
    free: Array,
    error_weight: float,
    move_weight: float,
    v_previous: float,
    dv_max: float,
    v_max: float,
    max_iterations: int,
    work: Workspace,
) -> int:
    """Write the optimal changes and multipliers into ``work``; return a status.

    Goldfarb and Idnani (1983), a dual active-set method: it starts at the unconstrained optimum
    (62), with E10, and repeatedly adds the bound with the largest violation, dropping active
    bounds whose multiplier would become negative. Usually (62) satisfies the bounds and no
    iteration is needed, so a warm start would gain nothing.

    matrix, free              : S, shape (n_p, n_c); Psi_free, shape (n_p,)
    error_weight, move_weight : mu and pi (> 0)
    v_previous                : v_p(t-1), rad/s²; inside v_max, or the status is INFEASIBLE
    """
    n = work.gradient.size
    normal_equations(matrix, free, error_weight, move_weight, work.hessian, work.gradient)
    fine = cholesky(work.hessian, work.lower)
    total = 0.0
    for i in range(n):
        work.unconstrained[i] = -work.gradient[i]
        total += work.gradient[i]
    work.multipliers[:] = 0.0
    work.changes[:] = 0.0
    if not fine or not math.isfinite(total + v_previous):
        return NOT_POSITIVE
    if dv_max == 0.0 and abs(v_previous) <= v_max:
        # No change is possible: the bounds on the changes balance the whole gradient.
        for i in range(n):
            work.multipliers[0, i] = max(work.gradient[i], 0.0)
            work.multipliers[1, i] = max(-work.gradient[i], 0.0)
        return OPTIMAL
    solve_lower(work.lower, work.unconstrained)
    close = BOUND_TOLERANCE * max(dv_max, v_max)
    count = 0
    solve_with_active_rows(work, count, v_previous, dv_max, v_max)
    worst, side = find_violation(work, count, v_previous, dv_max, v_max, close)
    for _ in range(max_iterations):
        if worst < 0:
            for k in range(count):
                upper = 1 if work.sides[k] > 0.0 else 0
                work.multipliers[upper, work.active[k]] = max(work.active_multipliers[k], 0.0)
            return OPTIMAL
        dependent = is_dependent(worst, work.active, count, work.components)
        row_normal(worst, side, work.lower, work.normal)
        project_out(work, count)
        longest, drop = longest_dual_step(work, count)
        # Step to the new bound, infinite for a dependent normal.
        needed = math.inf
        if not dependent:
            squared = 0.0
            for i in range(n):
                squared += work.normal[i] * work.normal[i]
            gap = side * row_value(worst, work.changes)
            gap -= bound(worst, side, n, v_previous, dv_max, v_max)
            needed = max(gap, 0.0) / squared
        step = min(longest, needed)
        if math.isinf(step):
            work.changes[:] = 0.0
            return INFEASIBLE
        if needed <= longest:
            work.active[count] = worst
            work.sides[count] = side
            count += 1
            rebuild_basis(work, count)
            solve_with_active_rows(work, count, v_previous, dv_max, v_max)
            worst, side = find_violation(work, count, v_previous, dv_max, v_max, close)
        else:
            if not dependent:
                solve_upper(work.lower, work.normal)
                for i in range(n):
                    work.changes[i] -= step * work.normal[i]
            for k in range(count):
                work.active_multipliers[k] -= step * work.projection[k]
            count -= 1
            remove_row(work, drop, count)
    work.changes[:] = 0.0
    return UNFINISHED


@kernel
def longest_dual_step(work: Workspace, count: int) -> tuple[float, int]:
    """Return the largest step before an active multiplier is zero, and its row, -1 without one.

    ``work.projection`` becomes the decrease of the multipliers for each unit of the step.
    """
    longest, drop = math.inf, -1
    for k in range(count - 1, -1, -1):
        rate = work.projection[k]
        for j in range(k + 1, count):
            rate -= work.triangle[k, j] * work.projection[j]
        rate /= work.triangle[k, k]
        work.projection[k] = rate
        if rate > 1e-12 and work.active_multipliers[k] < longest * rate:
            longest, drop = work.active_multipliers[k] / rate, k
    return longest, drop


@kernel
def remove_row(work: Workspace, drop: int, count: int) -> None:
    """Remove active row ``drop``, of which ``count`` remain."""
    for k in range(drop, count):
        work.active[k] = work.active[k + 1]
        work.sides[k] = work.sides[k + 1]
        work.active_multipliers[k] = work.active_multipliers[k + 1]
    rebuild_basis(work, count)


@kernel
def normal_equations(
    matrix: Array,
    free: Array,
    error_weight: float,
    move_weight: float,
    hessian: Array,
    gradient: Array,
) -> None:
    """Write mu SᵀS + pi I and mu SᵀPsi_free, the two terms of half the gradient (61)."""
    n = gradient.size
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
        gradient[i] = error_weight * total


@kernel
def cholesky(matrix: Array, lower: Array) -> bool:
    """Write the Cholesky factor of ``matrix`` into ``lower``; return False without one."""
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
def row_value(row: int, changes: Array) -> float:
    """Return the value of a row: dv_row, or after the first n rows the sum of dv."""
    n = changes.size
    if row < n:
        value: float = changes[row]
        return value
    total = 0.0
    for i in range(row - n + 1):
        total += changes[i]
    return total


@kernel
def bound(row: int, side: float, n: int, v_previous: float, dv_max: float, v_max: float) -> float:
    """Return the bound of a row on one side, as the upper bound of side * value."""
    return dv_max if row < n else v_max - side * v_previous


@kernel
def row_normal(row: int, side: float, lower: Array, out: Array) -> None:
    """Write L⁻¹ times the outward normal of a row's bound into ``out``, shape (n,)."""
    n = out.size
    for i in range(n):
        out[i] = side if i == row or i <= row - n else 0.0
    solve_lower(lower, out)


@kernel
def is_dependent(row: int, active: Indices, count: int, components: Indices) -> bool:
    """Return whether a row is a linear combination of the active ones, decided exactly.

    In the running sums c_i the rows are c_i and c_i - c_(i-1): edges of a graph with the nodes 0
    (ground) and 1 ... n. Edges are dependent exactly when they form a cycle, which the connected
    components show without a tolerance. (Rows 0 and n are the same edge.)
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
def project_out(work: Workspace, count: int) -> None:
    """Split ``work.normal`` into its projection on the active normals and the remainder.

    Two passes, because the rounding of the first is of the order of the projection.
    """
    for k in range(count):
        work.projection[k] = 0.0
    for _ in range(2):
        for k in range(count):
            part = 0.0
            for i in range(work.normal.size):
                part += work.basis[k, i] * work.normal[i]
            for i in range(work.normal.size):
                work.normal[i] -= part * work.basis[k, i]
            work.projection[k] += part


@kernel
def rebuild_basis(work: Workspace, count: int) -> None:
    """Compute ``basis`` and ``triangle`` of the first ``count`` active rows.

    With a dozen unknowns this costs no more than an update, and rounding does not accumulate.
    """
    for k in range(count):
        row_normal(work.active[k], work.sides[k], work.lower, work.normal)
        project_out(work, k)
        for j in range(k):
            work.triangle[j, k] = work.projection[j]
        length = 0.0
        for i in range(work.normal.size):
            length += work.normal[i] * work.normal[i]
        length = math.sqrt(length)
        work.triangle[k, k] = length
        for i in range(work.normal.size):
            work.basis[k, i] = work.normal[i] / length


@kernel
def solve_with_active_rows(
    work: Workspace, count: int, v_previous: float, dv_max: float, v_max: float
) -> None:
    """Write the optimum with the active rows at their bounds, and their multipliers."""
    n = work.gradient.size
    # The component of the unconstrained optimum that is orthogonal to the active rows, computed
    # first: the rounding of a distant optimum must not affect a much smaller solution.
    for i in range(n):
        work.normal[i] = work.unconstrained[i]
    project_out(work, count)
    for i in range(n):
        work.changes[i] = work.normal[i]
    for k in range(count):
        along = bound(work.active[k], work.sides[k], n, v_previous, dv_max, v_max)
        for j in range(k):
            along -= work.triangle[j, k] * work.active_multipliers[j]
        # Component along basis k that puts the active rows at their bounds.
        work.active_multipliers[k] = along / work.triangle[k, k]
        for i in range(n):
            work.changes[i] += work.active_multipliers[k] * work.basis[k, i]
    for k in range(count - 1, -1, -1):
        total = work.projection[k] - work.active_multipliers[k]
        for j in range(k + 1, count):
            total -= work.triangle[k, j] * work.active_multipliers[j]
        work.active_multipliers[k] = total / work.triangle[k, k]
    solve_upper(work.lower, work.changes)


@kernel
def find_violation(
    work: Workspace, count: int, v_previous: float, dv_max: float, v_max: float, close: float
) -> tuple[int, float]:
    """Return the row with the largest violation of a bound, and its side; row -1 without one."""
    n = work.changes.size
    worst, side, largest = -1, 1.0, close
    total = 0.0
    for row in range(2 * n):
        if row == n:
            total = 0.0
        value = work.changes[row] if row < n else 0.0
        if row >= n:
            total += work.changes[row - n]
            value = total
        for way in (1.0, -1.0):
            beyond = way * value - bound(row, way, n, v_previous, dv_max, v_max)
            if beyond > largest:
                held = False
                for k in range(count):
                    held = held or work.active[k] == row
                if not held:
                    worst, side, largest = row, way, beyond
    return worst, side
