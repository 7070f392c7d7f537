# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The memory kernel of a fractional integral as a short sum of exponentials."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SumOfExponentials:
    """k(t) as the sum of weight * exp(-rate * t), with the error measured on its range."""

    rates: NDArray[np.float64]
    """Shape (m,), 1/s, ascending and not negative."""
    weights: NDArray[np.float64]
    """Shape (m,), s^(q-1), positive."""
    error: float
    """Bound of abs(sum/k - 1) for shortest <= t <= horizon."""

    def at(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum at each of the times (s)."""
        return np.exp(-np.multiply.outer(time, self.rates)) @ self.weights


def fit_sum_of_exponentials(
    order: float, shortest: float, horizon: float, tolerance: float
) -> SumOfExponentials:
    """Return rates and weights whose sum keeps k(t) within ``tolerance``, relatively.

    Parameters
    ----------
    order
        q, above 0 and at most 1; at 1 the answer is one mode of rate 0 and weight 1, exactly.
    shortest, horizon
        The lags (s) between which the error is bounded.
    tolerance
        Relative, from 1e-12 to 0.1.

    Raises
    ------
    ValueError
        An argument outside its range.
    ArithmeticError
        The tolerance is not reached; rounding allows it for lags up to 15 decades apart.
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
    for _ in range(20):  # one or two are enough; a bound, so that a slip can never run away
        found = _sample_kernel(order, shortest, horizon, tolerance / 8.0, spacing)
        if found.error <= tolerance:
            return found
        spacing *= 0.95
    raise ArithmeticError(f'no sum of exponentials keeps {tolerance}: last error {found.error}')


def _spacing(order: float, tolerance: float) -> float:
    """Return the widest spacing w whose sampling error is near the tolerance.

    Uses the large-argument form abs(Gamma(b + iy)) ~ sqrt(2 pi) y^(b - 1/2) exp(-pi y/2) with
    b = 1 - q; the measured error decides, so an estimate is enough.
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
    # Fast end: what is left out is below C Gamma(q) u^-q exp(-u) of k at the shortest lag.
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
    rates = np.concatenate(([moment / weight], np.exp(x)))
    weights = np.concatenate(([weight], scale * np.exp(beta * x)))
    return SumOfExponentials(
        rates, weights, _measure_error(order, shortest, horizon, rates, weights)
    )


def _measure_error(
    order: float,
    shortest: float,
    horizon: float,
    rates: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> float:
    """Return the largest relative error on a fine grid, with a margin for between its points.

    Modes are narrower than two in ln t, so the error oscillates no faster than that; 48 points
    per unit of ln t miss a crest by well under one per cent.
    """
    count = math.ceil(48.0 * math.log(horizon / shortest)) + 2
    time = np.geomspace(shortest, horizon, count)
    exact = time ** (order - 1.0) / math.gamma(order)
    sums = SumOfExponentials(rates, weights, math.nan).at(time)
    return 1.02 * float(np.max(np.abs(sums / exact - 1.0)))
