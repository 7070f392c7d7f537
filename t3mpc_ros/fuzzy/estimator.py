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
"""Fuzzy estimator of the unknown dynamics, (30)-(31), with its adaptation law (77)-(78)."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.fuzzy.inference import (
    FuzzyParameters,
    FuzzyTables,
    build_sets,
    combine,
    compute_basis,
    evaluate_basis,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class AdaptationParameters(Parameters):
    """Gains and bounds of the adaptation."""

    enabled: bool = parameter(True, 'whether the coefficients are adapted', dynamic=True)
    gamma: float = parameter(
        240.0,
        'adaptation gain gamma of (77)-(78). The normalised gain gamma |Phi|² (1/s²) determines '
        'the dynamics of the error: s² + K s + gamma |Phi|² = 0. With the default type-3 sets '
        '|Phi|² is 0.015 to 0.14, so 240 gives about 15; with type1 or interval_type2 it is about '
        'three times larger, so a third of gamma gives the same dynamics',
        '1/s²',
        (0.0, 1e6),
        dynamic=True,
    )
    radius: float = parameter(
        40.0,
        'radius of the ball that the coefficients of an output are projected onto, as a root mean '
        'square: |alpha| <= radius sqrt(2 r lambda), so the largest constant estimate is radius '
        'for any number of rules',
        'rad/s²',
        (0.0, 1e4),
        dynamic=True,
    )
    sigma_modification: float = parameter(
        0.0,
        'rate of the leakage of the coefficients towards zero (gamma times the usual sigma); '
        'bounds them without a known ball, but biases them',
        '1/s',
        (0.0, 10.0),
        dynamic=True,
    )
    dead_zone: float = parameter(
        0.0,
        'error below which the coefficients do not adapt. It should be at least the disturbance '
        'that the coefficients cannot represent, divided by K; even noise of about this size '
        'causes little drift',
        'rad/s',
        (0.0, 10.0),
        dynamic=True,
    )
    step_limit: float = parameter(
        2.0,
        'maximum of gamma |Phi|² dt per step, above which gamma is reduced; the sampled loop is '
        'stable only below K',
        '1/s',
        (0.001, 1000.0),
        dynamic=True,
    )


class AdaptationGains(NamedTuple):
    """Gains and bounds of :func:`adapt`."""

    gamma: float  # 1/s²
    radius: float  # rho, largest Euclidean norm of each output's coefficients, rad/s²
    leakage: float  # sigma, 1/s
    dead_zone: float  # width, rad/s
    step_limit: float  # largest gamma |Phi|² dt, 1/s


@kernel
def beyond_dead_zone(error: float, width: float) -> float:
    """Return the part of ``error`` outside the dead zone, delta - sat(delta), rad/s.

    It is continuous: with a step at the edge, noise would adapt the coefficients fully.
    """
    return error - min(max(error, -width), width)


@kernel
def adapt(
    coefficients: Array, phi: Array, errors: Array, dt: float, gains: AdaptationGains
) -> bool:
    r"""Adapt the coefficients over ``dt``; return whether the errors are finite.

    .. math:: \dot\alpha = \gamma\Phi\,(\delta - \mathrm{sat}(\delta)) - \sigma\alpha,
              \qquad \|\alpha\| \le \rho

    With (77)-(78) alone, V of (74) decreases only without estimation errors omega; under noise
    alpha is a sum of random steps and drifts without bound. With alpha~ = alpha* - alpha, each
    modification has its own proof (Ioannou and Sun, Robust Adaptive Control, 1996, chapter 8;
    Narendra and Annaswamy, Stable Adaptive Systems, 1989, chapter 8):

    - *Dead zone.* Let V contain d = delta - sat(delta) instead of delta. Outside the zone
      d delta = |d|(|d| + width), so V' <= -K d² - |d|(K width - |omega|): V decreases whenever
      the width is at least |omega|/K. Inside, d = 0 and V is constant: there is no drift.
    - *sigma-modification.* The leakage adds (sigma/gamma) alpha~'alpha to V', which is at most
      (sigma/2 gamma)(|alpha*|² - |alpha~|²): negative once alpha~ is larger than alpha*, so
      alpha is bounded for any omega. The decay is computed exactly, hence stable at any dt.
    - *Projection.* Projection onto a convex set does not increase the distance to any of its
      members: while alpha* lies in the ball, |alpha~| and V do not increase. This also applies
      to a finite step, unlike the usual projection of the derivative.
    - *Step limit.* With sampling, delta and the estimate follow the matrix
      [[1 - K dt, dt], [-gamma |Phi|² dt, 1]]. By Jury's conditions it is stable, for K dt < 2,
      exactly when its determinant is below one: gamma |Phi|² dt² < K dt. The step's
      gamma |Phi|² dt is therefore limited to a rate below K, for any gamma and any dt.

    coefficients : shape (m, p), alpha, updated, rad/s²
    phi : shape (p,), basis of the evaluation before the errors
    errors : shape (m,), delta, rad/s
    dt : s, not negative

    Returns False, and changes nothing, when an error is not finite.
    """
    gamma, radius, leakage, dead_zone, step_limit = gains
    for z in range(errors.size):
        if not math.isfinite(errors[z]):
            return False
    power = 0.0
    for k in range(phi.size):
        power += phi[k] * phi[k]
    # Without a basis no coefficient changes at any finite gain.
    gain = gamma * dt if power > 0.0 else 0.0
    if gain * power > step_limit:
        gain = step_limit / power
    keep = math.exp(-leakage * dt)
    for z in range(errors.size):
        # Larger errors than 1e9 give the same point on the ball, and would overflow.
        step = gain * beyond_dead_zone(min(max(errors[z], -1e9), 1e9), dead_zone)
        square = 0.0
        for k in range(phi.size):
            coefficients[z, k] = keep * coefficients[z, k] + step * phi[k]
            square += coefficients[z, k] * coefficients[z, k]
        norm = math.sqrt(square)
        if norm > radius:
            for k in range(phi.size):
                coefficients[z, k] *= radius / norm
    return True


@kernel
def estimate(inputs: Array, tables: FuzzyTables, outputs: Array) -> bool:
    """Write basis and outputs (31); return False, and change nothing, unless inputs are finite."""
    for i in range(inputs.size):
        if not math.isfinite(inputs[i]):
            return False
    evaluate_basis(inputs, tables)
    combine(tables.coefficients, tables.phi, outputs)
    return True


class FuzzyEstimator:
    """Estimates g of chi' = g(U|alpha) + u (30) from the wheel speeds, and adapts to them.

    All outputs share one basis, as in (70)-(71): the inputs and the sets are the same, and an
    error of the coefficients alpha* - alpha causes the error (alpha* - alpha)ᵀ Phi of g. The
    object owns the work space, so a call runs one kernel and allocates only the result.
    """

    def __init__(
        self,
        parameters: FuzzyParameters,
        adaptation: AdaptationParameters,
        outputs: int = 2,
        inputs: int = 2,
    ) -> None:
        self.sets = build_sets(parameters, inputs)
        self.tables = FuzzyTables.of(self.sets, outputs)
        """Sets, basis and coefficients, for kernels."""
        self._phi, self._coefficients = self.tables.phi, self.tables.coefficients
        self.configure(adaptation)

    def configure(self, adaptation: AdaptationParameters) -> None:
        """Replace the adaptation parameters from the next step on; keep the coefficients."""
        self.adaptation = adaptation
        self.gains = AdaptationGains(
            adaptation.gamma,
            adaptation.radius * math.sqrt(self.sets.size),
            adaptation.sigma_modification,
            adaptation.dead_zone,
            adaptation.step_limit,
        )

    def reset(self) -> None:
        """Set all coefficients to zero, and clear the basis until the next evaluation."""
        self._coefficients[:] = 0.0
        self._phi[:] = 0.0

    def warm_up(self) -> None:
        """Compile the kernels now instead of in the first step, without changing the state."""
        phi, coefficients = self._phi.copy(), self._coefficients.copy()
        self.evaluate(np.zeros(len(self.sets.centres)))
        adapt(self._coefficients, self._phi, np.zeros(coefficients.shape[0]), 0.0, self.gains)
        self._phi[:], self._coefficients[:] = phi, coefficients

    def evaluate(self, inputs: Array) -> Array:
        """Return the estimates g (rad/s²), shape (m,), equation (31), and store the basis.

        Inputs are the wheel speeds chi, rad/s. Those that do not fit raise ValueError and change
        nothing.
        """
        values = np.ascontiguousarray(inputs, dtype=np.float64)
        count, outputs = len(self.sets.centres), np.empty(len(self._coefficients))
        if values.shape != (count,) or not estimate(values, self.tables, outputs):
            raise ValueError(f'inputs must be {count} finite numbers: got {inputs}')
        return outputs

    def adapt(self, errors: Array, dt: float) -> None:
        """Adapt the coefficients to the tracking errors delta = chi - r, equations (77)-(78).

        The basis is that of the last :meth:`evaluate`; without one the coefficients do not change.
        Values that do not fit raise ValueError and change nothing.
        """
        values = np.ascontiguousarray(errors, dtype=np.float64)
        if self.adaptation.enabled and (
            values.shape != self._coefficients.shape[:1]
            or not adapt(self._coefficients, self._phi, values, dt, self.gains)
        ):
            raise ValueError(
                f'errors must be {len(self._coefficients)} finite numbers: got {errors}'
            )

    @property
    def basis(self) -> Array:
        """A copy of Phi of the last evaluation, shape (2 r lambda,); zeros before the first."""
        return self._phi.copy()

    @property
    def coefficients(self) -> Array:
        """A copy of alpha, shape (m, 2 r lambda), rad/s², in the order of (32).

        They are the consequents of the rules (28), one at the lower and one at the upper level
        of each slice. The next adaptation step projects coefficients outside the ball onto it.
        """
        return self._coefficients.copy()

    @coefficients.setter
    def coefficients(self, values: Array) -> None:
        table = np.asarray(values, dtype=np.float64)
        if table.shape != self._coefficients.shape:
            raise ValueError(
                f'coefficients must have shape {self._coefficients.shape}: got {table.shape}'
            )
        if not np.isfinite(table).all():
            raise ValueError(
                f'coefficients must be finite: got {np.count_nonzero(~np.isfinite(table))} not'
            )
        self._coefficients[:] = table


def gamma_for(parameters: FuzzyParameters, normalised_gain: float) -> float:
    """Return the gamma (1/s²) of a given mean normalised gain gamma |Phi|².

    |Phi|² depends on the kind and the number of the sets: at the same gamma, fuzzy systems adapt
    at different rates, which would dominate their comparison. The mean is over 400 pairs of
    inputs, uniform between first and last centre, from a fixed seed.
    """
    sets = build_sets(parameters, 2)
    drawn = np.random.default_rng(0).uniform(
        parameters.centre_low, parameters.centre_high, (400, 2)
    )
    power = np.mean([np.sum(compute_basis(point, sets) ** 2) for point in drawn])
    return float(normalised_gain / power)
