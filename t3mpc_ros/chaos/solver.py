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
r"""Solver of fractional-order systems with constant cost and constant memory.

Caputo's equation D^q y = f(y) is the Volterra equation

.. math:: y(t) = y_0 + \frac{1}{\Gamma(q)} \int_0^t (t - s)^{q-1} f(y(s))\,ds,

and the scheme is the predictor-corrector of Diethelm, Ford and Freed (Nonlinear Dynamics 29,
2002): slopes linear over each step, the kernel integrated exactly (product trapezoid), the newest
slope predicted by the product rectangle. One choice is our own: each past step keeps the two
slopes that its corrector integrated, the newer one being the *predicted* slope, and the predictor
uses the same past. Predictor and corrector thus share one past, and at q = 1 the method is exactly
Heun's, which the original is not. On a linear equation with one state both methods coincide; the
order is min(2, 1 + q) for both.

Over the newest step the kernel is the true one, integrated exactly; over everything before it the
kernel is the sum of exponentials of :mod:`t3mpc_ros.chaos.sum_of_exponentials`, valid from a lag
of one step on. A mode

.. math:: z(t) = \int_0^t e^{-\lambda (t - s)} g(s)\,ds

of slopes g that are linear over each step advances exactly:

.. math:: z(t + h) = e^{-a} z(t) + h\,\phi_o(a)\,g(t^+) + h\,\phi_n(a)\,g(t + h^-), \qquad
          a = \lambda h.

The only additional error is that of the kernel, a known fraction of the integral. Cost and memory
are two numbers per mode and state, independent of the number of steps.
"""

import math

import numpy as np

from t3mpc_ros.chaos.sum_of_exponentials import exp, expm1, fit_sum_of_exponentials
from t3mpc_ros.chaos.system_equations import QuadraticSystem, Terms, right_hand_side
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel


def mode_weights(decay: Array) -> tuple[Array, Array]:
    r"""Return the weights of the older and the newer slope in a mode's advance over one step.

    .. math:: \phi_o(a) = \int_0^1 e^{-a u} u\,du = \frac{1 - (1 + a) e^{-a}}{a^2}, \qquad
              \phi_n(a) = \int_0^1 e^{-a u} (1 - u)\,du = \frac{a - 1 + e^{-a}}{a^2}

    Both closed forms cancel for small a (all digits at 1e-8), where the Taylor series is used.
    ``decay`` is a = rate * step, not negative, any shape.
    """
    small = decay < 0.5
    a = np.where(small, 1.0, decay)
    older = (-expm1(-a) - a * exp(-a)) / a**2
    newer = (a + expm1(-a)) / a**2
    a = np.where(small, decay, 0.0)
    older_series = np.zeros_like(a)
    newer_series = np.zeros_like(a)
    power = np.ones_like(a)  # (-a)^n / n!
    for n in range(16):  # 0.5^16 / 16! is far below rounding
        older_series += power / (n + 2.0)
        newer_series += power / ((n + 1.0) * (n + 2.0))
        power *= -a / (n + 1.0)
    return np.where(small, older_series, older), np.where(small, newer_series, newer)


@kernel
def advance_solution(
    steps: int,
    terms: Terms,
    local: Array,
    decays: Array,
    older: Array,
    newer: Array,
    rates: Array,
    initial: Array,
    modes: Array,
    vectors: Array,
) -> None:
    """Advance the solution by ``steps`` steps, in place and without allocation.

    local   : shape (5, d), weights over the newest step: predictor; corrector, older and newer;
              derivative, slope difference and older slope
    decays  : shape (d, m), exp(-rate * step); unused modes have weight zero
    older, newer : shape (d, m), weight times step times phi of the slopes at the two ends
    rates   : shape (d, m), 1/s
    initial : shape (d,)
    modes   : shape (d, m), weighted modes, updated
    vectors : shape (6, d): state, its slope and its time derivative, updated; then history
              at the next step, updated; then predicted state and its slope, work space
    """
    state, current, derivative = vectors[0], vectors[1], vectors[2]
    history, guess, predicted = vectors[3], vectors[4], vectors[5]
    size = state.size
    count = modes.shape[1]
    for n in range(steps):
        for i in range(size):
            base = initial[i] + history[i]
            guess[i] = base + local[0, i] * current[i]
            state[i] = base + local[1, i] * current[i]
        right_hand_side(terms, guess, predicted)
        if n == steps - 1:
            # d/dt of the Volterra equation at the new time; needs the modes before their update.
            for i in range(size):
                total = 0.0
                for k in range(count):
                    total += rates[i, k] * decays[i, k] * modes[i, k]
                derivative[i] = (local[4, i] - local[3, i]) * current[i] - total
        for i in range(size):
            state[i] += local[2, i] * predicted[i]
            total = 0.0
            for k in range(count):
                mode = (
                    decays[i, k] * modes[i, k]
                    + older[i, k] * current[i]
                    + newer[i, k] * predicted[i]
                )
                modes[i, k] = mode
                total += decays[i, k] * mode
            history[i] = total
        right_hand_side(terms, state, current)
        if n == steps - 1:
            for i in range(size):
                derivative[i] += local[3, i] * current[i]


class FractionalSolver:
    r"""Solves D^q y = f(y) step by step at constant cost and constant memory.

    ``initial`` (shape (d,)) is the state at time zero, where the integral starts; the memory
    kernel has the relative error ``tolerance`` at lags from one step to ``horizon`` (s), and
    longer runs are safe.
    """

    def __init__(
        self,
        system: QuadraticSystem,
        step: float,
        initial: Array,
        horizon: float = 1e5,
        tolerance: float = 1e-8,
    ) -> None:
        kernels = [
            fit_sum_of_exponentials(order, step, horizon, tolerance) for order in system.orders
        ]
        shape = (system.size, max(each.rates.size for each in kernels))
        self.step = step
        self._terms = system.terms()
        self._local = np.empty((5, system.size))
        self._decays = np.zeros(shape)
        self._older = np.zeros(shape)
        self._newer = np.zeros(shape)
        self._rates = np.zeros(shape)
        for state, (order, each) in enumerate(zip(system.orders, kernels, strict=True)):
            used = each.rates.size
            older, newer = mode_weights(each.rates * step)
            self._rates[state, :used] = each.rates
            self._decays[state, :used] = exp(-each.rates * step)
            self._older[state, :used] = each.weights * step * older
            self._newer[state, :used] = each.weights * step * newer
            self._local[:, state] = (
                step**order / math.gamma(order + 1.0),
                order * step**order / math.gamma(order + 2.0),
                step**order / math.gamma(order + 2.0),
                step ** (order - 1.0) / math.gamma(order + 1.0),
                step ** (order - 1.0) / math.gamma(order),
            )
        self._orders = np.array(system.orders)
        self._initial = np.zeros(system.size)
        self._modes = np.empty(shape)
        self._vectors: Array = np.empty((6, system.size))
        self.reset(initial)

    def reset(self, initial: Array | None = None) -> None:
        """Reset to time zero with an empty memory, to another initial state if one is given."""
        if initial is not None:
            if np.shape(initial) != self._initial.shape:
                raise ValueError(
                    f'initial must have shape {self._initial.shape}: got {np.shape(initial)}'
                )
            if not np.isfinite(initial).all():
                raise ValueError(f'initial must be finite: got {initial}')
            self._initial[:] = initial
        self._steps = 0
        self._modes[:] = 0.0
        self._vectors[:] = 0.0
        self._vectors[0] = self._initial
        right_hand_side(self._terms, self._vectors[0], self._vectors[1])
        self._vectors[2] = np.where(self._orders == 1.0, self._vectors[1], np.nan)

    @property
    def time(self) -> float:
        """Time since the reset, s."""
        return self._steps * self.step

    @property
    def state(self) -> Array:
        """A copy of y, shape (d,)."""
        return np.array(self._vectors[0])

    @property
    def rate(self) -> Array:
        r"""A copy of dy/dt (1/s), shape (d,); NaN at time zero unless the order is 1.

        It is the derivative of the Volterra equation, not of order q: with the newest step's
        kernel exact and integration by parts in each mode,

        .. math:: \dot y(t) = k(h) f(t-h) - \sum_j \lambda_j w_j e^{-\lambda_j h} z_j(t-h)
                  + \frac{h^{q-1}}{\Gamma(q+1)} \bigl(f(t) - f(t-h)\bigr).

        At time zero a solution of order below 1 increases like t^q and has no derivative.
        """
        return np.array(self._vectors[2])

    def advance(self, steps: int = 1) -> Array:
        """Advance by ``steps`` steps and return a copy of the new state, shape (d,).

        FloatingPointError: the step is too long, or the solution grows without bound.
        """
        if steps < 0:
            raise ValueError(f'steps must not be negative: got {steps}')
        advance_solution(
            steps,
            self._terms,
            self._local,
            self._decays,
            self._older,
            self._newer,
            self._rates,
            self._initial,
            self._modes,
            self._vectors,
        )
        self._steps += steps
        if not np.isfinite(self._vectors[:2]).all():
            raise FloatingPointError(f'state is not finite at {self.time} s: {self._vectors[0]}')
        return self.state
