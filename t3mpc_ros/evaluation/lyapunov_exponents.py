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
"""Lyapunov exponents of a quadratic system at order 1, by Benettin's method."""

import math

import numpy as np

from t3mpc_ros.chaos.system_equations import QuadraticSystem, Terms, jacobian, right_hand_side
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel


def lyapunov_exponents(
    system: QuadraticSystem,
    initial: Array | None = None,
    duration: float = 400.0,
    step: float = 1e-3,
    settle: float = 20.0,
    interval: int = 50,
) -> Array:
    """Return the exponents (1/s), the largest first, shape (d,).

    State and tangent vectors are integrated together by the classical Runge-Kutta method. Every
    ``interval`` steps the tangent vectors are made orthonormal by a QR factorisation; an exponent
    is the mean logarithmic growth of its diagonal entry of R. Their sum is the mean divergence of
    the flow: for (85) with E6 at order 1 the trace -38.

    Every order must be 1: a fractional system has no flow on its state alone. ``initial``, shape
    (d,), is ones by default; the average is over ``duration`` after ``settle``, to land on the
    attractor, with steps of ``step``, all in s. For (85) 400 s give the first exponent within 0.1
    and the second within 0.2; 10 000 s give 2.29, 0.62, 0.00 and -40.92.
    """
    if any(order != 1.0 for order in system.orders):
        raise ValueError(f'orders must all be 1: got {system.orders}')
    if initial is None:
        initial = np.ones(system.size)
    if np.shape(initial) != (system.size,):
        raise ValueError(f'initial must have shape ({system.size},): got {np.shape(initial)}')
    if not (0.0 < step < math.inf and step * interval <= duration < math.inf and settle >= 0.0):
        raise ValueError(
            'times must be 0 < step, interval steps <= duration, 0 <= settle: '
            f'got {step}, {interval}, {duration}, {settle}'
        )
    size, terms = system.size, system.terms()
    now = np.column_stack([initial, np.eye(size)])
    work = np.empty((4, size, size + 1))
    growth = np.zeros(size)
    settling, rounds = (round(time / step / interval) for time in (settle, duration))
    for k in range(settling + rounds):
        _integrate(terms, now, work, step, interval)
        now[:, 1:], stretched = np.linalg.qr(now[:, 1:])
        if k >= settling:  # before, the tangent vectors turn into their own directions
            growth += np.log(np.abs(np.diag(stretched)))
    return np.sort(growth / (rounds * interval * step))[::-1]


@kernel
def _slopes(terms: Terms, point: Array, out: Array, derivative: Array) -> None:
    """Write the slope of state (column 0) and tangents (the others), shape (d, d + 1)."""
    size = point.shape[0]
    right_hand_side(terms, point[:, 0], out[:, 0])
    jacobian(terms, point[:, 0], derivative)
    for i in range(size):
        for j in range(1, size + 1):
            total = 0.0
            for k in range(size):
                total += derivative[i, k] * point[k, j]
            out[i, j] = total


@kernel
def _shift(base: Array, factor: float, slopes: Array, out: Array) -> None:
    """Write base + factor * slopes into ``out``, which may be ``base``; nothing is allocated."""
    for i in range(base.shape[0]):
        for j in range(base.shape[1]):
            out[i, j] = base[i, j] + factor * slopes[i, j]


@kernel
def _integrate(terms: Terms, now: Array, work: Array, step: float, count: int) -> None:
    """Advance state and tangents ``count`` steps.

    now, work : shapes (d, d + 1) and (4, d, d + 1)
    """
    trial, total, stage = work[0], work[1], work[2]
    derivative = work[3, :, : now.shape[0]]
    for _ in range(count):
        _slopes(terms, now, stage, derivative)
        _shift(now, 0.5 * step, stage, trial)
        _shift(now, step / 6.0, stage, total)
        _slopes(terms, trial, stage, derivative)
        _shift(now, 0.5 * step, stage, trial)
        _shift(total, step / 3.0, stage, total)
        _slopes(terms, trial, stage, derivative)
        _shift(now, step, stage, trial)
        _shift(total, step / 3.0, stage, total)
        _slopes(terms, trial, stage, derivative)
        _shift(total, step / 6.0, stage, now)
