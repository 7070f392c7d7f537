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
r"""Feedback baselines: PI, disturbance rejection, sliding mode, computed torque, adaptive fuzzy.

All of them see the tracking error without what jumps and limits explain of it.

The plant is chi_(k+1) = chi_k + T (u_k + d_k) in each wheel, see :mod:`.baseline_controller`. The
error delta = chi - r then evolves as

.. math:: \delta_{k+1} = \delta_k + T(a_k - \dot r_k + d_k) - \rho_{k+1},

with a the acceleration after the limits, r'_k = (r_(k+1) - r_k)/T as known at step k, and rho the
later deviation of the reference from that: its jumps. All terms but d are known, so a model
computes their part of the error,

.. math:: h_{k+1} = h_k + T v(h_k) + T(a_k - u_k) - \rho_{k+1}, \qquad
          u = \dot r + v(h) + \text{feedback of } e, \qquad e = \delta - h,

and the error of the feedback, e_(k+1) = e_k + T (feedback + d_k), contains neither jumps nor
limits: an integral, a sliding variable or an adapted coefficient that uses e cannot wind up.
This is model recovery anti-windup, back-calculation through the plant's own model (Galeani,
Tarbouriech, Turner and Zaccarian 2009), with the jumps of the reference entering like a deficit
of the drive. v closes h at its own rate, because h contains no noise: two degrees of freedom.

With ``jump_transition.preview`` the reference is the reachable one of
:mod:`t3mpc_ros.control.jump_transition`, as that of the controller: it has no jumps.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
import math
from typing import Generic, TypeVar

import numpy as np

from t3mpc_ros.control.control_law import compensator
from t3mpc_ros.control.jump_transition import JumpTransitionParameters
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    EXACT_INERTIA,
    FRICTION,
    BaselineController,
    NominalModel,
    Observation,
    PlannedReference,
    WheelLoads,
)
from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, gamma_for
from t3mpc_ros.fuzzy.inference import FuzzyParameters
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters, group, parameter


@dataclass(frozen=True)
class JumpTransientParameters(Parameters):
    """Parameters of the transient h after a jump of the reference."""

    rate: float = parameter(
        100.0,
        'rate at which the error closes that a jump of the reference or a limit has made',
        '1/s',
        (1.0, 500.0),
    )
    acceleration: float = parameter(
        200.0,
        'largest acceleration requested for it; a torque limit is not reported back, so that with '
        'a torque drive this should be what the motors can do',
        'rad/s²',
        (1.0, 1000.0),
    )


@dataclass(frozen=True)
class FeedbackParameters(Parameters):
    """Parameters of every feedback baseline."""

    jump_transient: JumpTransientParameters = group(JumpTransientParameters)
    jump_transition: JumpTransitionParameters = group(JumpTransitionParameters, preview=False)


Table = TypeVar('Table', bound=FeedbackParameters)


class FeedbackBaseline(BaselineController, Generic[Table]):
    """Base of baselines that separate the effect of disturbances from that of jumps and limits."""

    parameters: Table
    input_gain = 1.0
    """Acceleration per unit of u."""

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        self._period = nominal_model.period
        # So that h never overshoots zero, however large the rate.
        self._share = 1.0 - math.exp(-self.parameters.jump_transient.rate * self._period)
        self.transient: Array = np.zeros(2)
        """h, the part of the error that jumps and limits explain, rad/s, shape (2,)."""
        self._closing: Array = np.zeros(2)
        self._requested: Array = np.zeros(2)
        self._applied: Array = np.zeros(2)
        self._predicted_reference: Array | None = None
        transition = self.parameters.jump_transition
        self.preview = transition.preview  # type: ignore[misc]
        lag = nominal_model.lag if nominal_model.drive == 'velocity' else 0.0
        self._plan = PlannedReference(transition, nominal_model, lag) if self.preview else None

    @abstractmethod
    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u (rad/s²) by r' + v(h) and e (rad/s), shape (2,) each."""

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        if (plan := self._plan) is not None:
            plan.step(observation)
            reachable = plan.reachable.copy()
            following = reachable + self._period * plan.rate
            observation = replace(observation, reference=reachable, next_reference=following)
        error = self._disturbance_error(observation)
        slope = (observation.next_reference - observation.reference) / self._period
        u = self.feedback(observation, slope + self._closing, error)
        # All of u counts as applied until a limit is reported.
        self._requested = self._applied = u
        self._predicted_reference = observation.next_reference.copy()
        return u.copy()

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Store the u after the drive's limits: the remainder adds to h."""
        self._applied = acceleration.copy()

    def _disturbance_error(self, observation: Observation) -> Array:
        """Return e (rad/s), the error that neither jumps nor limits explain; renew h and v(h)."""
        reference = observation.reference
        error = observation.speeds - reference
        if self._predicted_reference is None:
            # All of the error is h at first: the wheels start from where they are.
            self.transient = error.copy()
        else:
            deficit = self._applied - self._requested
            push = self._closing + self.input_gain * deficit
            known = self.transient + self._period * push
            self.transient = known - (reference - self._predicted_reference)
        closing = -self._share * self.transient / self._period
        limit = self.parameters.jump_transient.acceleration
        self._closing = np.clip(closing, -limit, limit)
        return np.asarray(error - self.transient)


@dataclass(frozen=True)
class ProportionalIntegralParameters(FeedbackParameters):
    """Gains of the PI controller."""

    gain: float = parameter(30.0, 'proportional gain K on the error', '1/s', (0.5, 100.0))
    integral: float = parameter(
        200.0, 'integral gain; K²/4 is critical damping in continuous time', '1/s²', (0.1, 5000.0)
    )


class ProportionalIntegral(FeedbackBaseline[ProportionalIntegralParameters]):
    r"""PI with feed-forward: u = r' + v(h) - K e - I, I_k = I_(k-1) + T K_i e_k.

    The feedback sees e alone, whose poles are the roots of

    .. math:: z^2 - (2 - KT - K_iT^2)\,z + (1 - KT) = 0,

    whatever jumps and limits do (two degrees of freedom, Åström and Hägglund 2006). A constant
    disturbance leaves no error.
    """

    parameters_type = ProportionalIntegralParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        self.integral: Array = np.zeros(2)
        """I, what the controller opposes to the disturbance, rad/s², shape (2,)."""

    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u, rad/s², shape (2,)."""
        self.integral = self.integral + self._period * self.parameters.integral * error
        return np.asarray(feedforward - self.parameters.gain * error - self.integral)


@dataclass(frozen=True)
class DisturbanceRejectionParameters(FeedbackParameters):
    """Gains of active disturbance rejection."""

    gain: float = parameter(30.0, 'bandwidth of the controller, k', '1/s', (0.5, 100.0))
    observer_bandwidth: float = parameter(
        30.0,
        'bandwidth of the extended state observer, omega_o: both poles at exp(-omega_o T)',
        '1/s',
        (0.5, 300.0),
    )
    input_gain: float = parameter(
        1.0, 'what an acceleration that is asked for brings about, b_0', bounds=(0.3, 3.0)
    )
    shared_disturbance: float = parameter(
        0.0,
        "share of the filter's unexplained acceleration, common to all methods, in what is "
        "cancelled; the rest is the observer's own",
        bounds=(0.0, 1.0),
    )
    shared_speed: float = parameter(
        0.0,
        "share of the filter's speed in the feedback; the rest is the observer's own",
        bounds=(0.0, 1.0),
    )


def observer_gains(bandwidth: float, period: float) -> tuple[float, float]:
    r"""Return (l_1, l_2), in 1 and 1/s, that put both observer poles at beta = exp(-omega_o T).

    Prediction with the model, then correction by L times the surprise, makes the error of the
    estimate follow (I - L C) A with A = [[1, T], [0, 1]], whose trace is 2 - l_1 - l_2 T and
    whose determinant is 1 - l_1; hence l_1 = 1 - beta² and l_2 = (1 - beta)²/T
    (Miklosovic, Radke and Gao 2006).
    """
    beta = math.exp(-bandwidth * period)
    return 1.0 - beta**2, (1.0 - beta) ** 2 / period


class DisturbanceRejection(FeedbackBaseline[DisturbanceRejectionParameters]):
    """Active disturbance rejection: u = (r' + v(h) - k e - f)/b_0 (Han 2009).

    All that is not b_0 u is one number f, which an extended state observer of
    chi' = b_0 u + f estimates from the speed and from the u that was really applied, so that it
    cannot wind up. Both observer poles are at one place (Gao 2003). v(h) is Han's arranged
    transient. doi 10.1109/TIE.2008.2011621.
    """

    parameters_type = DisturbanceRejectionParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        self.input_gain = self.parameters.input_gain
        self._gains = observer_gains(self.parameters.observer_bandwidth, self._period)
        self.observed: Array = np.zeros((2, 2))
        """The observer's own chi (rad/s) and f (rad/s²), shape (2, 2), a wheel a column."""

    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u, rad/s², shape (2,)."""
        table, speeds = self.parameters, observation.speeds
        if self._predicted_reference is None:
            self.observed = np.stack([speeds, np.zeros(2)])
        else:  # predict by the u that was applied, and correct by the measured speeds
            speed, load = self.observed
            speed = speed + self._period * (self.input_gain * self._applied + load)
            surprise = np.outer(self._gains, speeds - speed)
            self.observed = np.stack([speed, load]) + surprise
        speed, load = self.observed
        error = error + (1.0 - table.shared_speed) * (speed - speeds)
        load = load + table.shared_disturbance * (observation.unexplained - load)
        return np.asarray((feedforward - table.gain * error - load) / self.input_gain)


@dataclass(frozen=True)
class SlidingModeParameters(FeedbackParameters):
    """Gains of the sliding mode controller.

    Within the boundary layer it is a PI controller with the proportional gain
    surface + reaching + switching/boundary, which should stay below 1/T.
    """

    surface: float = parameter(
        8.0,
        'slope lambda of the surface s = e + lambda ∫e: the rate of the error on it',
        '1/s',
        (0.1, 100.0),
    )
    reaching: float = parameter(8.0, 'linear term of the reaching law, k', '1/s', (0.1, 100.0))
    switching: float = parameter(
        6.0, 'switching gain eta: outweighs any disturbance that is smaller', 'rad/s²', (0.1, 40.0)
    )
    boundary: float = parameter(
        0.5, 'boundary layer phi, within which the switching term is linear', 'rad/s', (0.02, 5.0)
    )
    shared_disturbance: float = parameter(
        0.0,
        "share of the filter's unexplained acceleration, common to all methods, in the "
        'equivalent control; what is left is for the switching gain to outweigh',
        bounds=(0.0, 1.0),
    )


class SlidingMode(FeedbackBaseline[SlidingModeParameters]):
    r"""Integral sliding mode: u = u_eq - k s - eta sat(s/phi), s = e + lambda ∫e.

    The equivalent control u_eq = r' + v(h) - lambda e, less the known share of the disturbance,
    keeps the nominal plant on s = 0. With S_k the sum of T e_j over j < k, s_k = e_k + lambda S_k
    moves exactly by

    .. math:: s_{k+1} = s_k + T(-k s_k - \eta\,\mathrm{sat}(s_k/\phi) + d_k),

    d being what is left of the disturbance: while |d| < eta and outside the boundary layer, |s|
    falls by at least T (eta - |d|) a step (reaching law of Gao and Hung 1993; boundary layer of
    Slotine and Sastry 1983). A jump of the reference does not leave the surface: e starts at
    zero and contains no jumps, which is integral sliding mode (Utkin and Shi 1996). Within the
    layer, a constant disturbance leaves no error. The share of an estimated disturbance allows a
    smaller eta (Yang, Li and Yu 2013).
    """

    parameters_type = SlidingModeParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        self.surface: Array = np.zeros(2)
        """The sliding variable s of the last step, rad/s, shape (2,)."""
        self._sum: Array = np.zeros(2)

    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u, rad/s², shape (2,)."""
        table = self.parameters
        self.surface = error + table.surface * self._sum
        self._sum = self._sum + self._period * error
        saturated = np.clip(self.surface / table.boundary, -1.0, 1.0)
        known = table.shared_disturbance * observation.unexplained
        equivalent = feedforward - table.surface * error - known
        return np.asarray(equivalent - table.reaching * self.surface - table.switching * saturated)


@dataclass(frozen=True)
class ComputedTorqueParameters(ProportionalIntegralParameters):
    """Gains of computed torque, and where and how far its model is believed."""

    integral: float = parameter(
        20.0, 'integral gain, for what the model does not know', '1/s²', (0.1, 5000.0)
    )
    belief: float = parameter(
        1.0, "share of the model's forces that is cancelled", bounds=(0.0, 1.5)
    )
    measured: float = parameter(
        0.5,
        'where the model is evaluated: 1 at the estimated speeds, which are noisy, 0 at the '
        'followed ones r + h, which the wheels may not have',
        bounds=(0.0, 1.0),
    )


class ComputedTorque(ProportionalIntegral):
    """Computed torque of the nominal robot: u = r' + v(h) - K e - I - m(chi).

    m is what (10) of the nominal robot leaves of chi' - u when u is applied as the torque
    theta_bar u: theta_bar^-1 (-eta_bar chi - f(chi)), with viscous and Coulomb friction. A servo
    with lag tau holds against it within the period: the speed then changes by
    tau (1 - exp(-T/tau)) m instead of T m, so that much less is to be cancelled. On the nominal
    robot the error decays as (1 - K T)^k (without the integral, which is for the rest).
    """

    parameters_type = ComputedTorqueParameters
    known = (EXACT_INERTIA, FRICTION)

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        self._loads = WheelLoads(nominal_model)
        assert isinstance(self.parameters, ComputedTorqueParameters)
        self._felt, self._measured = self.parameters.belief, self.parameters.measured
        if nominal_model.drive == 'velocity':
            self._felt *= nominal_model.lag * nominal_model.share / nominal_model.period

    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u, rad/s², shape (2,)."""
        without_model = super().feedback(observation, feedforward, error)
        at = observation.reference + self.transient + self._measured * error
        return np.asarray(without_model - self._felt * self._loads(at))


# -- adaptive fuzzy control -----------------------------------------------------------------------


@dataclass(frozen=True)
class AdaptiveType1Parameters(FeedbackParameters):
    """Gains and sets of the type-1 controller; the sets cover -10 to 10 rad/s."""

    gain: float = parameter(30.0, 'feedback K on the error', '1/s', (0.5, 100.0))
    normalised_gain: float = parameter(
        100.0,
        'adaptation gain gamma |Phi|², averaged over the inputs: the error obeys '
        's² + K s + gamma |Phi|² = 0',
        '1/s²',
        (0.1, 5000.0),
    )
    dead_zone: float = parameter(
        0.01,
        'error from which on coefficients adapt; a smaller one counts as noise',
        'rad/s',
        (0.0, 2.0),
    )
    error_bound: float = parameter(
        0.5,
        'bound of what the fuzzy system cannot explain, outweighed by the robust term; 0 leaves '
        'the term out',
        'rad/s²',
        (0.0, 30.0),
    )
    smoothing: float = parameter(
        0.5, 'width of the robust term, epsilon in tanh(e/epsilon)', 'rad/s', (0.01, 10.0)
    )
    sets: int = parameter(7, 'Gaussian sets per input', bounds=(2, 9))
    spread: float = parameter(
        0.6, 'width of the sets as a fraction of their spacing', bounds=(0.2, 3.0)
    )
    centre_exponent: float = parameter(
        2.0, 'how much closer together the centres are in the middle', bounds=(0.2, 5.0)
    )

    def fuzzy(self) -> FuzzyParameters:
        """Return the shape of the fuzzy system, type-1; the fuzzifier is a singleton."""
        return FuzzyParameters(
            kind='type1',
            sets=self.sets,
            spread=self.spread,
            centre_exponent=self.centre_exponent,
            input_fuzziness=0.0,
        )


@dataclass(frozen=True)
class AdaptiveIntervalType2Parameters(AdaptiveType1Parameters):
    """Gains and sets of the interval type-2 controller."""

    footprint_of_uncertainty: float = parameter(
        0.23,
        'uncertainty of the sets: widths are (1 - footprint) and (1 + footprint) times the middle',
        bounds=(0.0, 0.9),
    )

    def fuzzy(self) -> FuzzyParameters:
        """Return the shape of the fuzzy system, interval type-2; the fuzzifier is a singleton."""
        return replace(
            super().fuzzy(),
            kind='interval_type2',
            footprint_of_uncertainty=self.footprint_of_uncertainty,
        )


@lru_cache(maxsize=64)
def _unit_gamma(fuzzy: FuzzyParameters) -> float:
    """Return the gamma whose normalised gain is 1 1/s²; many runs share one shape."""
    return gamma_for(fuzzy, 1.0)


class _Adaptive(FeedbackBaseline[AdaptiveType1Parameters]):
    r"""The law both share: u = r' + v(h) - g(chi|alpha) - K e - bound tanh(e/epsilon).

    The coefficients learn by alpha' = gamma Phi e from the error that their own estimate has
    caused, that is with the basis of the step before:

    .. math:: \alpha_{k+1} = \alpha_k + \gamma T \Phi_k e_{k+1}.

    With an exact alpha* and no robust term, V = e²/2 + |alpha* - alpha|²/(2 gamma) then changes by
    -(e_k² - 2(1 - KT) e_k e_(k+1) + (1 - gamma |Phi|² T²) e_(k+1)²)/2, which is negative for any
    errors while gamma |Phi|² T < K (2 - KT): not only in continuous time. The step limit of the
    adaptation is put there.
    """

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table = self.parameters
        fuzzy = table.fuzzy()
        steps = table.gain * nominal_model.period
        self.fuzzy = FuzzyEstimator(
            fuzzy,
            AdaptationParameters(
                gamma=table.normalised_gain * _unit_gamma(fuzzy),
                dead_zone=table.dead_zone,
                step_limit=max(0.001, table.gain * min(1.0, 2.0 - steps)),
            ),
        )
        self.error: Array = np.zeros(2)
        """e, the error that is learnt from, rad/s, shape (2,)."""
        self._limited = False

    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u, rad/s², shape (2,)."""
        table, self.error = self.parameters, error
        if not self._limited:
            self.fuzzy.adapt(error, self._period)
        estimate = self.fuzzy.evaluate(observation.speeds)
        robust = [compensator(e, table.error_bound, table.smoothing) for e in error.tolist()]
        return np.asarray(feedforward - estimate - table.gain * error + robust)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of the u that was applied; adaptation pauses while the drive is limited."""
        super().applied(acceleration, limited=limited)
        self._limited = limited

    def get_weights(self) -> dict[str, Array]:
        """Return the coefficients."""
        return {'coefficients': self.fuzzy.coefficients}

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Begin with other coefficients."""
        self.fuzzy.coefficients = weights['coefficients']


class AdaptiveType1(_Adaptive):
    """Adaptive control with a type-1 fuzzy system (Wang 1993), see :class:`_Adaptive`."""

    parameters_type = AdaptiveType1Parameters


class AdaptiveIntervalType2(_Adaptive):
    """Adaptive control with an interval type-2 fuzzy system (Liang and Mendel 2000).

    See :class:`_Adaptive`.
    """

    parameters_type = AdaptiveIntervalType2Parameters
