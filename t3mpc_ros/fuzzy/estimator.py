# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fuzzy estimator of the unknown dynamics, (30)-(31), with its adaptation law (77)-(78)."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.fuzzy.inference import basis, basis_of, combine
from t3mpc_ros.fuzzy.sets import FuzzyParameters, FuzzySets, build_sets
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AdaptationParameters(Parameters):
    """How fast the coefficients learn, and what they must not do."""

    enabled: bool = parameter(True, 'whether the coefficients are adapted at all', dynamic=True)
    gamma: float = parameter(
        240.0,
        'adaptation gain gamma of (77)-(78). What is felt is the normalised gain gamma |Phi|² '
        '(1/s²): the error then obeys s² + K s + gamma |Phi|² = 0. With the default type-3 sets '
        '|Phi|² is 0.015 to 0.14, so 240 makes about 15; with type1 or interval_type2 it is about '
        'three times larger, so a third of gamma does the same',
        unit='1/s²',
        low=0.0,
        high=1e6,
        dynamic=True,
    )
    radius: float = parameter(
        40.0,
        'root mean square of the coefficients of an output at the surface of the ball they are '
        'projected onto, |alpha| <= radius sqrt(2 r lambda): a constant estimate of this size '
        'just fits in, whatever the number of rules',
        unit='rad/s²',
        low=0.0,
        high=1e4,
        dynamic=True,
    )
    sigma_modification: float = parameter(
        0.0,
        'rate at which coefficients leak towards zero (gamma times the usual sigma); bounds them '
        'without a known ball, at the price of a bias',
        unit='1/s',
        low=0.0,
        high=10.0,
        dynamic=True,
    )
    dead_zone: float = parameter(
        0.0,
        'error from which on coefficients adapt; a smaller one counts as noise. At least the '
        'disturbance that no coefficients can explain divided by K; noise about as wide already '
        'drifts little',
        unit='rad/s',
        low=0.0,
        high=10.0,
        dynamic=True,
    )
    step_limit: float = parameter(
        2.0,
        'largest gamma |Phi|² dt of one step, beyond which gamma is reduced; the sampled loop is '
        'stable only while it stays below K',
        unit='1/s',
        low=0.001,
        high=1000.0,
        dynamic=True,
    )


@kernel
def beyond_dead_zone(error: float, width: float) -> float:
    """Return the part of ``error`` outside the dead zone, delta - sat(delta), rad/s.

    It is continuous: a switch at the edge would let noise adapt in full steps.
    """
    return error - min(max(error, -width), width)


@kernel
def adapt(
    coefficients: Array,
    phi: Array,
    errors: Array,
    dt: float,
    gamma: float,
    radius: float,
    leakage: float,
    dead_zone: float,
    step_limit: float,
) -> bool:
    r"""Adapt the coefficients over ``dt`` and decide whether the errors could be used.

    .. math:: \dot\alpha = \gamma\Phi\,(\delta - \mathrm{sat}(\delta)) - \sigma\alpha,
              \qquad \|\alpha\| \le \rho

    (77)-(78) alone make V of (74) decrease only while estimation errors omega are absent. Under
    noise alpha is a sum of random steps and drifts without bound. With
    alpha~ = alpha* - alpha, each addition has its own argument (Ioannou and Sun, Robust Adaptive
    Control, 1996, chapter 8; Narendra and Annaswamy, Stable Adaptive Systems, 1989, chapter 8):

    - *Dead zone.* Take V with d = delta - sat(delta) in the place of delta. Outside the zone
      d delta = |d|(|d| + width), so V' <= -K d² - |d|(K width - |omega|): V decreases whenever
      the width is at least |omega|/K. Inside, d = 0 and V rests: nothing drifts.
    - *sigma-modification.* The leakage adds (sigma/gamma) alpha~'alpha to V', which is at most
      (sigma/2 gamma)(|alpha*|² - |alpha~|²): negative once alpha~ is larger than alpha*, so
      alpha is bounded for any omega. Its decay is taken exactly, hence stable at any dt.
    - *Projection.* The nearest point of a convex set is no farther from any member than the
      point was: while alpha* lies in the ball, |alpha~| and so V can only shrink by it. This
      holds for whole steps too, unlike the usual projection of the derivative.
    - *Step limit.* With sampling, delta and the estimate follow the matrix
      [[1 - K dt, dt], [-gamma |Phi|² dt, 1]]. By Jury's conditions it is stable, for K dt < 2,
      exactly when its determinant is below one: gamma |Phi|² dt² < K dt. So the step's
      gamma |Phi|² dt is capped at a rate below K, whatever gamma and however long the step.

    coefficients : shape (m, p), alpha, updated, rad/s²
    phi : shape (p,), basis at which the errors arose
    errors : shape (m,), delta, rad/s
    dt : s, not negative
    gamma : 1/s²
    radius : rho, largest Euclidean norm of each output's coefficients, rad/s²
    leakage : sigma, 1/s
    dead_zone : width, rad/s
    step_limit : largest gamma |Phi|² dt, 1/s

    Returns False, and changes nothing, when an error is not finite.
    """
    for z in range(errors.size):
        if not math.isfinite(errors[z]):
            return False
    power = 0.0
    for k in range(phi.size):
        power += phi[k] * phi[k]
    # Without a basis no coefficient bears any blame; any finite gain then does nothing.
    gain = gamma * dt if power > 0.0 else 0.0
    if gain * power > step_limit:
        gain = step_limit / power
    keep = math.exp(-leakage * dt)
    for z in range(errors.size):
        # Errors beyond 1e9 end on the ball's surface like that one, without overflow.
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


Tables = tuple[Array, Array, Array, Array, Array, Array, Array, Array]


@kernel
def estimate(
    inputs: Array,
    centres: Array,
    nonsingleton_gain: Array,
    sharpness: Array,
    shares: Array,
    grades: Array,
    firings: Array,
    phi: Array,
    coefficients: Array,
    outputs: Array,
) -> bool:
    """Write basis and outputs (31); return False, and change nothing, unless inputs are finite.

    inputs        : shape (n,), U, rad/s
    centres ... phi : as in :func:`t3mpc_ros.fuzzy.inference.basis`
    coefficients, outputs : as in :func:`t3mpc_ros.fuzzy.inference.combine`
    """
    for i in range(inputs.size):
        if not math.isfinite(inputs[i]):
            return False
    basis(inputs, centres, nonsingleton_gain, sharpness, shares, grades, firings, phi)
    combine(coefficients, phi, outputs)
    return True


class FuzzyEstimator:
    """Estimates g of chi' = g(U|alpha) + u (30) from the wheel speeds, and learns it.

    All outputs share one basis, as in (70)-(71): the inputs and the sets are the same, and an
    error of the coefficients alpha* - alpha makes the error (alpha* - alpha)ᵀ Phi of g. Work
    space belongs to the object, so that a call costs one kernel and no allocation but the result.

    Parameters
    ----------
    settings
        Shape of the fuzzy system.
    adaptation
        How it learns.
    outputs
        Number of outputs m, two for two wheels.
    inputs
        Number of inputs n, two for two wheels.

    Raises
    ------
    ValueError
        Inputs or outputs are fewer than one, or the rules too many.
    """

    def __init__(
        self,
        parameters: FuzzyParameters,
        adaptation: AdaptationParameters,
        outputs: int = 2,
        inputs: int = 2,
    ) -> None:
        if outputs < 1:
            raise ValueError(f'outputs must be at least 1: got {outputs}')
        self._sets = build_sets(parameters, inputs)
        self._grades = np.zeros(self._sets.widths.shape)
        self._firings = np.zeros((self._sets.rules, self._sets.slices, 2, 2))
        self._phi: Array = np.zeros(self._sets.size)
        self._coefficients: Array = np.zeros((outputs, self._sets.size))
        self.tables: Tables = (
            self._sets.centres,
            self._sets.nonsingleton_gain,
            self._sets.sharpness,
            self._sets.shares,
            self._grades,
            self._firings,
            self._phi,
            self._coefficients,
        )
        """What :func:`estimate` reads and writes between inputs and outputs, in its order."""
        self.configure(adaptation)

    def configure(self, adaptation: AdaptationParameters) -> None:
        """Learn differently from the next step on; what was learnt is kept."""
        self._adaptation = adaptation
        self._radius = adaptation.radius * math.sqrt(self._sets.size)

    def reset(self) -> None:
        """Forget what was learnt: all coefficients zero, no basis until the next evaluation."""
        self._coefficients[:] = 0.0
        self._phi[:] = 0.0

    def warm_up(self) -> None:
        """Compile the kernels now, never inside a step; the state is left as it was."""
        phi, coefficients = self._phi.copy(), self._coefficients.copy()
        self.evaluate(np.zeros(self._sets.inputs))
        self._adapt(np.zeros(coefficients.shape[0]), 0.0)
        self._phi[:], self._coefficients[:] = phi, coefficients

    def evaluate(self, inputs: Array) -> Array:
        """Return the estimates g (rad/s²), shape (m,), equation (31), and keep the basis.

        Parameters
        ----------
        inputs
            U, the wheel speeds chi, shape (n,), rad/s.

        Raises
        ------
        ValueError
            The inputs are not n finite numbers; the basis of before is kept.
        """
        values = np.ascontiguousarray(inputs, dtype=np.float64)
        sets = self._sets
        outputs = np.empty(self._coefficients.shape[0])
        if values.shape != (sets.inputs,) or not estimate(values, *self.tables, outputs):
            raise ValueError(f'inputs must be {sets.inputs} finite numbers: got {inputs}')
        return outputs

    def adapt(self, errors: Array, dt: float) -> None:
        """Let the coefficients learn from the tracking errors, equations (77)-(78).

        The basis is that of the last :meth:`evaluate`; without one there is nothing to blame the
        error on and nothing is learnt.

        Parameters
        ----------
        errors
            delta = chi - r of the same instant, shape (m,), rad/s.
        dt
            Seconds since the last step.

        Raises
        ------
        ValueError
            The errors are not m finite numbers, or dt is negative or not finite; nothing is
            learnt.
        """
        if not 0.0 <= dt < math.inf:
            raise ValueError(f'dt must be finite and not negative: got {dt} s')
        if self._adaptation.enabled:
            self._adapt(errors, dt)

    @property
    def radius(self) -> float:
        """Radius of the ball that each output's coefficients stay in, rad/s²."""
        return self._radius

    @property
    def sets(self) -> FuzzySets:
        """The tables of the fuzzy system."""
        return self._sets

    @property
    def adaptation(self) -> AdaptationParameters:
        """How it learns at present."""
        return self._adaptation

    @property
    def basis(self) -> Array:
        """A copy of Phi of the last evaluation, shape (2 r lambda,); zeros before any."""
        return self._phi.copy()

    @property
    def coefficients(self) -> Array:
        """A copy of alpha, shape (m, 2 r lambda), rad/s², in the order of (32).

        They are the consequents of the rules (28), one at the lower and one at the upper level
        of each slice.

        Setting it checks it; coefficients outside the ball are brought back by the next step
        of adaptation.

        Raises
        ------
        ValueError
            When set to another shape, or to numbers that are not all finite.
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

    def _adapt(self, errors: Array, dt: float) -> None:
        values = np.ascontiguousarray(errors, dtype=np.float64)
        parameters = self._adaptation
        if values.shape != self._coefficients.shape[:1] or not adapt(
            self._coefficients,
            self._phi,
            values,
            dt,
            parameters.gamma,
            self._radius,
            parameters.sigma_modification,
            parameters.dead_zone,
            parameters.step_limit,
        ):
            raise ValueError(
                f'errors must be {len(self._coefficients)} finite numbers: got {errors}'
            )


def gamma_for(
    parameters: FuzzyParameters, normalised_gain: float, inputs: int = 2, samples: int = 400
) -> float:
    """Return the gamma (1/s²) whose normalised gain gamma |Phi|² is this on average.

    |Phi|² depends on the kind of sets and their number: systems compared at the same gamma
    would learn at different speeds, and the comparison would be of nothing else.

    Parameters
    ----------
    settings
        Shape of the fuzzy system.
    normalised_gain
        Wanted mean of gamma |Phi|², 1/s².
    inputs
        Number of inputs.
    samples
        Inputs averaged over, uniform between the first and last centre, from a fixed seed.
    """
    sets = build_sets(parameters, inputs)
    drawn = np.random.default_rng(0).uniform(
        parameters.centre_low, parameters.centre_high, (samples, inputs)
    )
    power = np.mean([np.sum(basis_of(point, sets) ** 2) for point in drawn])
    return float(normalised_gain / power)
