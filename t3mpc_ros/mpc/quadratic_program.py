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
"""Quadratic program for the moves of v_p, (34), (60)-(62) with E10, solved by DAQP.

The problem, for the changes dv of the predictive signal in the next n_c periods:

    minimise    mu |S dv + Psi_free|² + pi |dv|²
    subject to  |dv_i| <= dv_max,   |v_p(t-1) + dv_0 + ... + dv_i| <= v_max.

DAQP is a dual active-set solver (Arnström, Bemporad and Axehill 2022, doi
10.1109/TAC.2022.3176430): it starts at the unconstrained optimum (62), which usually satisfies
the bounds, so that a warm start would gain nothing.
"""

import math

import daqp
import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel

TOLERANCE = 1e-10
"""Tolerance of a bound, rad/s², and of the sign of a multiplier."""


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
def write_bounds(
    v_previous: float, dv_max: float, v_max: float, lower: Array, upper: Array
) -> None:
    """Write the bounds of dv_0 ... dv_(n-1), then those of the sums up to dv_1 ... dv_(n-1).

    The sum up to dv_0 is dv_0 itself, which has the narrower of both bounds.
    """
    n = (lower.size + 1) // 2
    for row in range(lower.size):
        lower[row] = -dv_max if row < n else -v_max - v_previous
        upper[row] = dv_max if row < n else v_max - v_previous
    lower[0] = max(lower[0], min(-v_max - v_previous, upper[0]))
    upper[0] = min(upper[0], max(v_max - v_previous, lower[0]))


def solve_quadratic_program(
    hessian: Array, gradient: Array, sums: Array, lower: Array, upper: Array
) -> Array | None:
    """Return the optimal changes dv, shape (n,); None without one, or where one is not found.

    hessian, gradient : as :func:`normal_equations` writes them
    sums              : :func:`sum_rows`
    lower, upper      : as :func:`write_bounds` writes them
    """
    if not (math.isfinite(hessian.sum()) and math.isfinite(gradient.sum() + lower.sum())):
        return None
    # No state between calls: a copy of a controller computes the same to the last bit.
    changes, _, status, _ = daqp.solve(
        hessian,
        gradient,
        sums,
        upper,
        lower,
        primal_tol=TOLERANCE,
        dual_tol=TOLERANCE,
        eps_prox=0.0,
    )
    return np.asarray(changes, dtype=np.float64) if status > 0 else None


def sum_rows(moves: int) -> Array:
    """Return the matrix of the sums dv_0 + ... + dv_i, i >= 1, shape (moves - 1, moves)."""
    return np.tril(np.ones((moves, moves)))[1:]
