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
r"""The memory kernel of a fractional integral as a short sum of exponentials.

The fractional integral of order q in (0, 1] weights the past with the kernel

.. math:: k(t) = \frac{t^{q-1}}{\Gamma(q)}
               = \frac{\sin \pi q}{\pi} \int_0^\infty e^{-s t} s^{-q}\,ds
               = \frac{\sin \pi q}{\pi} \int_{-\infty}^{\infty} e^{-t e^x} e^{(1-q) x}\,dx,

the last form by s = e^x. Each exponential is a first-order filter with one state and a constant
cost per step, so a finite sum of them replaces the whole past. It is constructed in four steps:

1. *Sampling.* The trapezoid rule with spacing w in x: rates e^{jw + x_0}, weights
   w e^{(1-q)(jw + x_0)} sin(pi q)/pi. By Poisson's formula its relative error oscillates in ln t
   with amplitude 2 abs(Gamma(1 - q + 2 pi i/w)) / Gamma(1 - q), independent of t, and decreases
   like exp(-pi^2/w).
2. *Fast end.* Terms with e^{-s h} negligible at the shortest lag h are omitted.
3. *Slow end.* Towards s = 0 the weights decrease only like s^{1-q}: for q = 0.98 a thousand
   decades would be needed to reach 1e-20. Over the horizon T those terms are nearly constant, so
   the geometric series of their weights, and of weight times rate, is summed analytically into
   one mode with the same total weight and the same mean rate. The error is of second order in
   s T. As q -> 1 this mode's weight tends to 1 and its rate to 0, all others vanish, and at q = 1
   the kernel *is* that one mode: an ordinary integral.
4. *Verification.* The relative error is evaluated on a grid of [h, T] much finer than its
   oscillation, and the spacing is reduced until the error is within the tolerance.

Beyond T the error grows slowly with (t/T)^2 from the share of the tolerance assigned to the slow
mode, which continues to decay at its small mean rate.
"""

from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.geometry.types import Array

exp, expm1 = (np.vectorize(each, otypes=[np.float64]) for each in (math.exp, math.expm1))
"""Of the C library. Those of NumPy differ in the last bit between kinds of processors, and within
seconds one bit makes another reference of a seed."""


@dataclass(frozen=True)
class SumOfExponentials:
    """k(t) as a sum of weight * exp(-rate * t), with its measured error."""

    rates: Array
    """Shape (m,), 1/s, ascending and not negative."""
    weights: Array
    """Shape (m,), s^(q-1), positive."""
    error: float
    """Bound of abs(sum/k - 1) for shortest <= t <= horizon."""

    def at(self, time: Array) -> Array:
        """Return the sum at each of the times (s)."""
        return np.exp(-np.multiply.outer(time, self.rates)) @ self.weights


def fit_sum_of_exponentials(
    order: float, shortest: float, horizon: float, tolerance: float
) -> SumOfExponentials:
    """Return a sum that approximates k(t) with a relative error of at most ``tolerance``.

    The lags are from ``shortest`` to ``horizon`` (s); at order q = 1 it is exactly one mode of
    rate 0 and weight 1. ArithmeticError: the tolerance is not reached; rounding permits it for
    lags up to 15 decades apart.
    """
    if not 0.0 < order <= 1.0:
        raise ValueError(f'order must be above 0 and at most 1: got {order}')
    if not 0.0 < shortest < horizon < math.inf:
        raise ValueError(f'lags must be 0 < shortest < horizon: got {shortest} and {horizon}')
    if not 1e-12 <= tolerance <= 0.1:
        raise ValueError(f'tolerance must be from 1e-12 to 0.1: got {tolerance}')
    if order == 1.0:
        return SumOfExponentials(np.zeros(1), np.ones(1), 0.0)
    spacing = _spacing(order, 0.5 * tolerance)
    for _ in range(20):  # one or two are enough
        found = _sample_kernel(order, shortest, horizon, tolerance / 8.0, spacing)
        if found.error <= tolerance:
            return found
        spacing *= 0.95
    raise ArithmeticError(f'no sum of exponentials keeps {tolerance}: last error {found.error}')


def _spacing(order: float, tolerance: float) -> float:
    """Return the widest spacing w whose sampling error is near the tolerance.

    Uses the large-argument form abs(Gamma(b + iy)) ~ sqrt(2 pi) y^(b - 1/2) exp(-pi y/2) with
    b = 1 - q. An estimate is enough, because the caller measures the error.
    """
    beta = 1.0 - order
    spacing = 2.0
    while True:
        y = math.tau / spacing
        gamma = math.sqrt(math.tau) * y ** (beta - 0.5) * math.exp(-0.5 * math.pi * y)
        if 2.0 * gamma / math.gamma(beta) <= tolerance:
            return spacing
        spacing *= 0.97


def _sample_kernel(
    order: float, shortest: float, horizon: float, tolerance: float, spacing: float
) -> SumOfExponentials:
    beta = 1.0 - order
    scale = spacing * math.sin(math.pi * beta) / math.pi
    # Fast end: the omitted terms are below C Gamma(q) u^-q exp(-u) of k at the shortest lag.
    share = math.gamma(order) * math.sin(math.pi * beta) / math.pi
    u = 0.5
    while share * u**-order * math.exp(-u) > tolerance:
        u += 0.25
    fastest = math.log(u / shortest)
    # Slow end: lumping errs by at most half the second moment of the lumped rates times T^2.
    lumped = share * spacing / (2.0 * math.expm1((2.0 + beta) * spacing))
    slowest = min(math.log(tolerance / lumped) / (2.0 + beta), 0.0) - math.log(horizon)
    x = fastest - spacing * np.arange(math.ceil((fastest - slowest) / spacing) + 1.0)[::-1]
    # Geometric series over x[0] - w, x[0] - 2w, ... of the weights and of weight times rate.
    weight = scale * math.exp(beta * x[0]) / math.expm1(beta * spacing)
    moment = scale * math.exp((1.0 + beta) * x[0]) / math.expm1((1.0 + beta) * spacing)
    rates = np.concatenate(([moment / weight], exp(x)))
    weights = np.concatenate(([weight], scale * exp(beta * x)))
    return SumOfExponentials(
        rates, weights, _measure_error(order, shortest, horizon, rates, weights)
    )


def _measure_error(
    order: float, shortest: float, horizon: float, rates: Array, weights: Array
) -> float:
    """Return the largest relative error on a fine grid, with a margin for between its points.

    Modes are narrower than two in ln t, which limits how fast the error oscillates; 48 points
    per unit of ln t miss a maximum by well under one per cent.
    """
    count = math.ceil(48.0 * math.log(horizon / shortest)) + 2
    time = np.geomspace(shortest, horizon, count)
    exact = time ** (order - 1.0) / math.gamma(order)
    sums = SumOfExponentials(rates, weights, math.nan).at(time)
    return 1.02 * float(np.max(np.abs(sums / exact - 1.0)))
