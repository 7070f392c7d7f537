# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The best changes of v_p within its bounds, equations (34), (60)-(62) with E10.

The problem, for changes dv of the predictive signal at the next n_c periods:

    minimise    mu |S dv + Psi_free|² + pi |dv|²
    subject to  |dv_i| <= dv_max,   |v_p(t-1) + dv_0 + ... + dv_i| <= v_max.

Row i < n_c of the constraints is dv_i, row n_c + i the sum up to i. Each has a lower and an upper
bound, with one multiplier for either.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Space(NamedTuple):
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
    islands: Indices
    """Shape (n + 1,): working memory of ``active_set.depends``."""


def make_space(moves: int) -> Space:
    """Return the working memory of a program with ``moves`` (n_c) unknowns."""
    if moves < 1:
        raise ValueError(f'moves must be at least 1: got {moves}')
    return space_in(np.zeros(space_size(moves)), np.zeros((2, moves + 1), dtype=np.int64), moves)


@kernel
def space_size(moves: int) -> int:
    """Return how many numbers make the space of a program, whole numbers not counted."""
    return 4 * moves * moves + 11 * moves


@kernel
def space_in(store: Array, whole: Indices, moves: int) -> Space:
    """Return the views of a flat store, and of whole numbers (2, n + 1), that are a space."""
    tables = store[: 4 * moves * moves].reshape((4, moves, moves))
    rows = store[4 * moves * moves :].reshape((11, moves))
    return Space(
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
def factor(matrix: Array, lower: Array) -> bool:
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
def unconstrained(lower: Array, slope: Array, changes: Array) -> None:
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
def residual(space: Space, before: float, dv_max: float, v_max: float, out: Array) -> float:
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
