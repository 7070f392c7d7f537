# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The fuzzy estimator of unknown dynamics, g(U|alpha) of (30), (31), with its adaptation."""

import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.fuzzy.adaptation import AdaptationSettings, adapt
from t3mpc_ros.fuzzy.inference import basis, basis_of, combine
from t3mpc_ros.fuzzy.sets import FuzzySets, FuzzySettings, build_sets
from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]
Tables = tuple[Array, Array, Array, Array, Array, Array, Array, Array]


@kernel
def estimate(
    inputs: Array,
    centres: Array,
    pull: Array,
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
    basis(inputs, centres, pull, sharpness, shares, grades, firings, phi)
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
        settings: FuzzySettings,
        adaptation: AdaptationSettings,
        outputs: int = 2,
        inputs: int = 2,
    ) -> None:
        if outputs < 1:
            raise ValueError(f'outputs must be at least 1: got {outputs}')
        self._sets = build_sets(settings, inputs)
        self._grades = np.zeros(self._sets.widths.shape)
        self._firings = np.zeros((self._sets.rules, self._sets.slices, 2, 2))
        self._phi: Array = np.zeros(self._sets.size)
        self._coefficients: Array = np.zeros((outputs, self._sets.size))
        self.tables: Tables = (
            self._sets.centres,
            self._sets.pull,
            self._sets.sharpness,
            self._sets.shares,
            self._grades,
            self._firings,
            self._phi,
            self._coefficients,
        )
        """What :func:`estimate` reads and writes between inputs and outputs, in its order."""
        self.configure(adaptation)

    def configure(self, adaptation: AdaptationSettings) -> None:
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
    def adaptation(self) -> AdaptationSettings:
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
        settings = self._adaptation
        if values.shape != self._coefficients.shape[:1] or not adapt(
            self._coefficients,
            self._phi,
            values,
            dt,
            settings.gamma,
            self._radius,
            settings.sigma_modification,
            settings.dead_zone,
            settings.step_limit,
        ):
            raise ValueError(
                f'errors must be {len(self._coefficients)} finite numbers: got {errors}'
            )


def gamma_for(
    settings: FuzzySettings, normalised_gain: float, inputs: int = 2, samples: int = 400
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
    sets = build_sets(settings, inputs)
    drawn = np.random.default_rng(0).uniform(
        settings.centre_low, settings.centre_high, (samples, inputs)
    )
    power = np.mean([np.sum(basis_of(point, sets) ** 2) for point in drawn])
    return float(normalised_gain / power)
