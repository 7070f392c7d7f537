# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Fractional systems solved with their full memory: the oracle for the running solver.

Caputo's equation D^q y = f(y) is the Volterra equation

.. math:: y(t) = y_0 + \frac{1}{\Gamma(q)} \int_0^t (t - s)^{q-1} f(y(s))\,ds,

and the scheme is the predictor-corrector of Diethelm, Ford and Freed (Nonlinear Dynamics 29,
2002): slopes linear over each step, the kernel integrated exactly (product trapezoid), the newest
slope predicted by the product rectangle. One choice is ours, shared with the running solver: each
past step keeps the two slopes its own corrector integrated, the newer one being the *predicted*
slope, and the predictor uses that same past. So one past serves predictor and corrector, and at
q = 1 the method is Heun's, step for step, which the original is not. On a linear equation with
one state the two coincide; the order is min(2, 1 + q) for both.

The cost is O(N) a step and O(N^2) a run: for tests and figures, never for a node.
"""

import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.system import QuadraticSystem, Terms, slope
from t3mpc_ros.kernels import kernel


def interval_weights(order: float, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r"""Return the product-trapezoid weights of the older and the newer end of past intervals.

    Entry m belongs to the interval of lags [m, m + 1], in units of the step:

    .. math:: \text{older}_m = \frac{1}{\Gamma(q)} \int_m^{m+1} u^{q-1} (u - m)\,du, \qquad
              \text{newer}_m = \frac{1}{\Gamma(q)} \int_m^{m+1} u^{q-1} (m + 1 - u)\,du

    The closed form is a difference of powers that loses digits like m^2; beyond the first interval
    the integrand is smooth, and 14 Gauss points give it to rounding instead.

    Returns
    -------
    older, newer
        Shape (count,) each; multiply by step**order.
    """
    older = np.empty(count)
    newer = np.empty(count)
    older[:1] = order / math.gamma(order + 2.0)
    newer[:1] = 1.0 / math.gamma(order + 2.0)
    if count > 1:
        nodes, shares = np.polynomial.legendre.leggauss(14)
        nodes = 0.5 * (nodes + 1.0)
        shares = 0.5 * shares / math.gamma(order)
        lag = np.arange(1.0, count)[:, None] + nodes
        older[1:] = (lag ** (order - 1.0) * nodes) @ shares
        newer[1:] = (lag ** (order - 1.0) * (1.0 - nodes)) @ shares
    return older, newer


def solve_full_memory(
    system: QuadraticSystem, step: float, initial: NDArray[np.float64], steps: int
) -> NDArray[np.float64]:
    """Return the states at 0, step, ... , steps * step, remembering every slope.

    Parameters
    ----------
    system
        Each state may have its own order.
    step
        s, positive.
    initial
        Shape (d,).
    steps
        How many, not negative.

    Returns
    -------
    states
        Shape (steps + 1, d).

    Raises
    ------
    ValueError
        A step that is not positive, an initial state of the wrong size.
    """
    if not 0.0 < step < math.inf:
        raise ValueError(f'step must be positive and finite: got {step}')
    if np.shape(initial) != (system.size,):
        raise ValueError(f'initial must have shape ({system.size},): got {np.shape(initial)}')
    if steps < 0:
        raise ValueError(f'steps must not be negative: got {steps}')
    older = np.empty((steps, system.size))
    newer = np.empty((steps, system.size))
    rectangle = np.empty(system.size)
    for state, order in enumerate(system.orders):
        ends = interval_weights(order, steps)
        older[:, state] = step**order * ends[0]
        newer[:, state] = step**order * ends[1]
        rectangle[state] = step**order / math.gamma(order + 1.0)
    states = np.empty((steps + 1, system.size))
    states[0] = initial
    _march(
        system.terms(),
        older,
        newer,
        rectangle,
        np.empty((steps + 1, system.size)),
        np.empty((steps + 1, system.size)),
        states,
        np.empty(system.size),
    )
    return states


@kernel
def _march(
    terms: Terms,
    older: NDArray[np.float64],
    newer: NDArray[np.float64],
    rectangle: NDArray[np.float64],
    slopes: NDArray[np.float64],
    predicted: NDArray[np.float64],
    states: NDArray[np.float64],
    guess: NDArray[np.float64],
) -> None:
    """Fill ``states`` from its first row on.

    older, newer      : shape (N, d), weights by lag, scaled by the step
    rectangle         : shape (d,), the predictor's weight of the newest slope
    slopes, predicted : shape (N + 1, d), work; f at the corrected and at the predicted state
    states            : shape (N + 1, d), first row given
    guess             : shape (d,), work
    """
    slope(terms, states[0], slopes[0])
    for n in range(states.shape[0] - 1):
        for i in range(guess.size):
            past = 0.0
            for j in range(n):
                past += older[n - j, i] * slopes[j, i] + newer[n - j, i] * predicted[j + 1, i]
            guess[i] = states[0, i] + past + rectangle[i] * slopes[n, i]
            states[n + 1, i] = states[0, i] + past + older[0, i] * slopes[n, i]
        slope(terms, guess, predicted[n + 1])
        for i in range(guess.size):
            states[n + 1, i] += newer[0, i] * predicted[n + 1, i]
        slope(terms, states[n + 1], slopes[n + 1])
