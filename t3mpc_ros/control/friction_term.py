# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Coulomb friction as part of the estimate g: a basis for the sign of each wheel's speed.

Coulomb friction changes by twice its value within some tenths of a rad/s about standstill. The
Gaussian sets of (16)-(33), which must be wider than the noise of their inputs, smear this change
out, and the adaptation has to learn the friction anew after each change of direction. It is
linear in its own parameters, though, so g gets one more basis, E23:

    g_i = alpha_i^T Phi + phi_i^T s,    s_j = tanh(r_j/w),    d phi_i/dt = gamma_f s delta_i

This is (77)-(78) for another basis, with the same modifications. Both wheels have both elements
of s, because the inertia of the body couples them. V of (74) gets |phi*_i - phi_i|²/(2 gamma_f)
for each wheel; its derivative along (72)-(73) is (79) as before. The friction is that at r, not
at chi, whose noise would switch it; the difference is part of omega.
"""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrictionTermParameters(Parameters):
    """Adaptation of the Coulomb friction in the estimate g."""

    gamma: float = parameter(
        10.0,
        'adaptation gain of the Coulomb friction in g, as gamma of (77)-(78) for a basis of size '
        'one; for a drive that friction slows. 0: without this basis, g is (31) as printed',
        '1/s²',
        (0.0, 1e4),
        dynamic=True,
    )
    width: float = parameter(
        0.3,
        'wheel speed of the reference at which the friction has 76 % of its value',
        'rad/s',
        (1e-3, 100.0),
        dynamic=True,
    )


class FrictionTables(NamedTuple):
    """Basis and coefficients, for kernels."""

    basis: Array
    """s of the last evaluation, shape (n,)."""
    coefficients: Array
    """phi, rad/s², shape (n, n): row i for the estimate of wheel i."""

    @classmethod
    def of(cls, wheels: int) -> 'FrictionTables':
        """Return tables of a friction that is not known."""
        return cls(np.zeros(wheels), np.zeros((wheels, wheels)))


@kernel
def add_friction(reference: Array, width: float, tables: FrictionTables, outputs: Array) -> None:
    """Write the basis s of E23, and add the friction to the estimates g of (31).

    reference : shape (n,), r, rad/s
    width     : w, rad/s
    outputs   : shape (n,), g, rad/s², updated
    """
    basis, coefficients = tables.basis, tables.coefficients
    for j in range(basis.size):
        basis[j] = math.tanh(reference[j] / width)
    for i in range(outputs.size):
        for j in range(basis.size):
            outputs[i] += coefficients[i, j] * basis[j]
