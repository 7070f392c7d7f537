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
"""Quadratic fractional-order systems as data, among them the hyperchaotic system (85) with E6."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel


class Terms(NamedTuple):
    """Non-zero terms of the right-hand side of a quadratic system, as arrays for kernels."""

    constant: Array
    """Shape (d,), 1/s to the order q, as all gains here."""
    linear_index: NDArray[np.int64]
    """Shape (l, 2): equation, state."""
    linear_gain: Array
    """Shape (l,)."""
    quadratic_index: NDArray[np.int64]
    """Shape (p, 3): equation, first state, second state."""
    quadratic_gain: Array
    """Shape (p,)."""


@dataclass(frozen=True)
class QuadraticSystem:
    r"""The system D^q y = c + L y + y Q y, each state with its own Caputo order.

    .. math:: D^{q_i} y_i = c_i + \sum_j L_{ij} y_j + \sum_{jk} Q_{ijk}\, y_j y_k

    Repeated terms are added. States are numbered from zero.
    """

    orders: tuple[float, ...]
    linear: tuple[tuple[int, int, float], ...]
    """(equation, state, gain) for each non-zero entry of L."""
    quadratic: tuple[tuple[int, int, int, float], ...] = ()
    """(equation, first state, second state, gain) for each non-zero entry of Q."""
    constant: tuple[float, ...] = ()
    """One value per state; empty means zero."""

    def __post_init__(self) -> None:
        if not self.orders:
            raise ValueError('orders must name one order per state: got none')
        for order in self.orders:
            if not 0.0 < order <= 1.0:
                raise ValueError(f'orders must be above 0 and at most 1: got {order}')
        if len(self.constant) not in (0, self.size):
            raise ValueError(
                f'constant must have {self.size} values or none: got {len(self.constant)}'
            )
        for *states, gain in (*self.linear, *self.quadratic):
            if not all(0 <= state < self.size for state in states):
                raise ValueError(f'states must be from 0 to {self.size - 1}: got {states}')
            if not math.isfinite(gain):
                raise ValueError(f'gains must be finite: got {gain}')
        if not all(map(math.isfinite, self.constant)):
            raise ValueError(f'constant must be finite: got {self.constant}')

    @property
    def size(self) -> int:
        """Number of states d."""
        return len(self.orders)

    def terms(self) -> Terms:
        """Return the right-hand side as the arrays that kernels take."""
        return Terms(
            np.array(self.constant or (0.0,) * self.size, dtype=np.float64),
            np.array([term[:2] for term in self.linear], dtype=np.int64).reshape(-1, 2),
            np.array([term[2] for term in self.linear], dtype=np.float64),
            np.array([term[:3] for term in self.quadratic], dtype=np.int64).reshape(-1, 3),
            np.array([term[3] for term in self.quadratic], dtype=np.float64),
        )


@kernel
def right_hand_side(terms: Terms, state: Array, out: Array) -> None:
    """Write the right-hand side D^q y at ``state`` into ``out``.

    state, out : shape (d,); ``out`` is overwritten and must not be ``state``
    """
    for i in range(out.size):
        out[i] = terms.constant[i]
    for n in range(terms.linear_gain.size):
        out[terms.linear_index[n, 0]] += terms.linear_gain[n] * state[terms.linear_index[n, 1]]
    for n in range(terms.quadratic_gain.size):
        out[terms.quadratic_index[n, 0]] += (
            terms.quadratic_gain[n]
            * state[terms.quadratic_index[n, 1]]
            * state[terms.quadratic_index[n, 2]]
        )


@kernel
def jacobian(terms: Terms, state: Array, out: Array) -> None:
    """Write the derivative of the right-hand side at ``state`` into ``out``.

    state : shape (d,)
    out   : shape (d, d), overwritten; row = equation, column = state
    """
    out[:, :] = 0.0
    for n in range(terms.linear_gain.size):
        out[terms.linear_index[n, 0], terms.linear_index[n, 1]] += terms.linear_gain[n]
    for n in range(terms.quadratic_gain.size):
        row = terms.quadratic_index[n, 0]
        first = terms.quadratic_index[n, 1]
        second = terms.quadratic_index[n, 2]
        out[row, first] += terms.quadratic_gain[n] * state[second]
        out[row, second] += terms.quadratic_gain[n] * state[first]


def hyperchaotic_system(
    a: float = 35.0,
    b: float = 4.0,
    c: float = 25.0,
    d: float = 5.0,
    k: float = 100.0,
    orders: tuple[float, ...] = (0.98, 0.98, 0.98, 0.98),
) -> QuadraticSystem:
    r"""Return the paper's reference generator, equation (85) with E6.

    .. math:: D^q y_1 &= a (y_2 y_3 + y_2 - y_1) \\
              D^q y_2 &= -d\, y_1 y_3 + c\, y_1 + y_2 + y_4 \\
              D^q y_3 &= -b\, y_3 + y_1 y_2 \\
              D^q y_4 &= -k\, y_2

    E6: the printed second line lost the sign before ``25 y1``. It is plus, as in the original
    publication (Chen, Yang, Qi, Yuan, Phys. Lett. A 360, 2007): with minus (``c=-25``) every state
    decays to zero, with plus two Lyapunov exponents are positive at q = 1. The states then stay
    within about abs(y1) < 36, abs(y2) < 9, 1.5 < y3 < 8.6, abs(y4) < 80.
    """
    if len(orders) != 4:
        raise ValueError(f'orders must be four: got {len(orders)}')
    return QuadraticSystem(
        orders,
        linear=(
            (0, 1, a),
            (0, 0, -a),
            (1, 0, c),
            (1, 1, 1.0),
            (1, 3, 1.0),
            (2, 2, -b),
            (3, 1, -k),
        ),
        quadratic=((0, 1, 2, a), (1, 0, 2, -d), (2, 0, 1, 1.0)),
    )
