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
"""Control law of the paper for two wheels: Fig. 1, equations (64)-(84)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

import numpy as np

from t3mpc_ros.control.jump_transition import JumpTransitionParameters
from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters
from t3mpc_ros.fuzzy.estimator import (
    AdaptationGains,
    AdaptationParameters,
    FuzzyEstimator,
    adapt,
    estimate,
)
from t3mpc_ros.fuzzy.inference import FuzzyParameters, FuzzyTables
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import TypedKernel, contiguous, kernel
from t3mpc_ros.mpc.predictive_controller import PredictiveController, PredictiveParameters, Signals
from t3mpc_ros.parameters.table import Parameters, group, parameter

TERM_NAMES = ('fuzzy', 'feedback', 'feedforward', 'compensator', 'predictive')
"""Summands of the law, in the order of the rows of ``terms``."""

FRICTION_WEIGHTS = 'friction.coefficients'  # name of the weights of the friction term

INERTIA_WEIGHTS = 'inertia.coefficients'  # name of the weights of the inertia term

MAX_SMOOTHING = 100.0  # largest width epsilon of the compensator, rad/s

CERTIFICATE_TIME = 0.5
"""Time constant of the averages of the certificate, s: single differences are mostly noise."""

TANH_GAP = 0.2785  # E14: the maximum of |x| - x tanh(x), rounded up (0.27846, at x = 0.6392)


@dataclass(frozen=True)
class LawParameters(Parameters):
    """Gains of the law and of the compensator."""

    gain: float = parameter(
        15.2,
        'feedback gain K of the tracking error (66)-(67); 0: by the drive, such that K plus the '
        'slope of the compensator, (omega-bar + v_p-bar)/epsilon, is (1 - exp(-T/lag))/T, at '
        'which measurement noise cancels in the command. 15.2 is tuned for a lag of 0.02 s',
        '1/s',
        (0.0, 1000.0),
        dynamic=True,
    )
    compensator: bool = parameter(
        True, 'whether the command includes the compensator (81)-(82)', dynamic=True
    )
    error_bound: float = parameter(
        6.0,
        'bound omega-bar (80) of the estimation error of a wheel that the compensator outweighs',
        'rad/s²',
        (0.0, 100.0),
        dynamic=True,
    )
    smoothing: float = parameter(
        0.62,
        'width epsilon of the compensator tanh(delta/epsilon): the error bound E14 grows with '
        '0.2785 epsilon, small values chatter with noise',
        'rad/s',
        (1e-3, MAX_SMOOTHING),
        dynamic=True,
    )


@dataclass(frozen=True)
class FrictionTermParameters(Parameters):
    """Adaptation of the Coulomb friction in the estimate g: the term phi_i^T s of E23.

    s_j = tanh(r_j/w) of both wheels, because the inertia of the body couples them; adapted as by
    (77)-(78). The friction is that at r, not at chi, whose noise would switch it; the difference
    is
    part of omega.
    """

    gamma: float = parameter(
        10.0,
        'adaptation gain of the Coulomb friction in g, as gamma of (77)-(78) for a basis of size '
        'one; for a drive that friction slows. 0: without this basis, g is (31) as printed',
        '1/s²',
        (0.0, 1e4),
        dynamic=True,
    )
    width: ClassVar[float] = 0.3
    """w: wheel speed of the reference at which the friction has 76 % of its value, rad/s,
    assumed."""


@dataclass(frozen=True)
class InertiaTermParameters(Parameters):
    """Adaptation of the inertia in the estimate g: the term theta_i^T a of E24, a_j = r'_j/a_0.

    Both wheels have both elements of a, because the inertia of the body couples them.
    """

    gamma: float = parameter(
        0.0,
        'adaptation gain of the inertia in g, as gamma of (77)-(78) for a basis of size one; for '
        'a torque drive. 0: without this basis',
        '1/s²',
        (0.0, 1e4),
        dynamic=True,
    )
    acceleration: ClassVar[float] = 50.0  # a_0, rad/s²


@dataclass(frozen=True)
class Nt3fsMpcParameters(Parameters):
    """The law and its parts, each of which can be disabled."""

    rate: float = parameter(100.0, 'control rate', 'Hz', (5.0, 1000.0))
    use_fuzzy: bool = parameter(
        True, 'whether the fuzzy estimate g is adapted and cancelled (NT3FS)', dynamic=True
    )
    integral_transfer: float = parameter(
        0.025,
        'transfer of a persistent v_p to the fuzzy systems, which learn from '
        'delta - integral_transfer v_p; 0 gives (77)-(78) as printed',
        's',
        (0.0, 10.0),
        dynamic=True,
    )
    law: LawParameters = group(LawParameters)
    jump_transition: JumpTransitionParameters = group(JumpTransitionParameters)
    # The ratio of disturbance and noise sets the filter: the noise is that of the robot.
    speed_filter: SpeedFilterParameters = group(SpeedFilterParameters, fixed=('disturbance',))
    fuzzy: FuzzyParameters = group(
        FuzzyParameters, fixed=('centre_exponent', 'footprint_of_uncertainty', 'spread', 'slices')
    )
    # The ball bounds the coefficients; the other modifications are for comparisons.
    adaptation: AdaptationParameters = group(
        AdaptationParameters, fixed=('sigma_modification', 'dead_zone', 'step_limit')
    )
    friction: FrictionTermParameters = group(FrictionTermParameters)
    # A velocity drive has its own controller of the inertia.
    inertia: InertiaTermParameters = group(InertiaTermParameters, fixed=('gamma',))
    predictive: PredictiveParameters = group(PredictiveParameters)

    @property
    def compensated_bound(self) -> float:
        """Sum omega-bar + v_p-bar of (80)-(82), rad/s², which the compensator outweighs."""
        predictive = self.predictive.v_max if self.predictive.enabled else 0.0
        return self.law.error_bound + predictive


def servo_gain(period: float, lag: float) -> float:
    """Return the gain (1/s) at which the measured speed cancels in the command of E19."""
    return (1.0 - math.exp(-period / lag)) / period


def fitting_gain(parameters: Nt3fsMpcParameters, drive: str) -> tuple[float, float]:
    """Return the gain K (1/s) and the width epsilon (rad/s) that fit drive and noise.

    The slope of the command in the speed error is K plus that of the compensator in its middle,
    (omega-bar + v_p-bar)/epsilon. Their sum is

    - with a velocity drive (1 - exp(-T/lag))/T: by E19 the measured speed then cancels in the
      command, because the servo has the better measurement;
    - with a torque drive half of the bandwidth sqrt(q/(sigma sqrt(T))) of the Kalman filter of the
      wheel speeds, with q the spectral density of the disturbance and sigma² the variance of the
      noise: faster feedback passes noise, slower feedback wastes what the filter knows. It is at
      most 0.3/T.

    Epsilon is ``law.smoothing``, or larger: the compensator has at most half of the slope.

    drive : ``'velocity'`` or ``'torque'``
    """
    period, filtered = 1.0 / parameters.rate, parameters.speed_filter
    if drive == 'velocity':
        total = servo_gain(period, filtered.lag)
    else:
        noise = math.sqrt(max(filtered.noise_variance, 1e-9) * period)
        total = min(0.5 * math.sqrt(filtered.disturbance / noise), 0.3 / period)
    smoothing, bound = parameters.law.smoothing, parameters.compensated_bound
    if not parameters.law.compensator:
        return total, smoothing
    smoothing = min(max(smoothing, 2.0 * bound / total), MAX_SMOOTHING)
    return total - bound / smoothing, smoothing


class LinearTerm(NamedTuple):
    """Basis and coefficients of a term that is linear in its own parameters, for kernels."""

    basis: Array  # of the last evaluation, shape (n,)
    coefficients: Array  # rad/s², shape (n, n): row i for the estimate of wheel i

    @classmethod
    def of(cls, wheels: int) -> 'LinearTerm':
        """Return a term of which nothing is known."""
        return cls(np.zeros(wheels), np.zeros((wheels, wheels)))


@kernel
def add_friction(reference: Array, width: float, term: LinearTerm, outputs: Array) -> None:
    """Write the basis s of E23 at r (rad/s), and add the friction to the estimates g of (31)."""
    for j in range(term.basis.size):
        term.basis[j] = math.tanh(reference[j] / width)
    add_term(term, outputs)


@kernel
def add_inertia(rate: Array, acceleration: float, term: LinearTerm, outputs: Array) -> None:
    """Write the basis a of E24 at r' (rad/s²), and add the wrong inertia to the estimates g."""
    for j in range(term.basis.size):
        term.basis[j] = rate[j] / acceleration
    add_term(term, outputs)


@kernel
def add_term(term: LinearTerm, outputs: Array) -> None:
    """Add a term at its basis to ``outputs``, rad/s², shape (n,)."""
    for i in range(outputs.size):
        for j in range(term.basis.size):
            outputs[i] += term.coefficients[i, j] * term.basis[j]


# -- law (66)-(67) and compensator (81)-(82) --------------------------------------------------


@kernel
def law_terms(
    speeds: Array,
    reference: Array,
    reference_rate: Array,
    estimate: Array,
    predictive: Array,
    gain: float,
    bound: float,
    smoothing: float,
    terms: Array,
    command: Array,
) -> None:
    r"""Write the terms of the law, shape (5, n), and their sum, equations (66)-(67) with E12.

    .. math:: u_i = -g_i(\chi|\alpha_i) - K\delta_i + \dot r_i + v_{c,i} + v_{p,i}, \qquad
              \delta = \chi - r

    E12: the printed :math:`+\omega_i` is the unknown estimation error and cannot be applied; the
    correct term is :math:`\dot r_i`. With it, (68)-(69) follow from (64)-(65), and by (70)-(71)
    the error system (72)-(73) of each wheel,
    :math:`\dot\delta = \tilde\alpha^T\Phi - K\delta + \omega + v_c + v_p`.
    ``gain`` is K (1/s); ``bound`` and ``smoothing`` are those of the compensator, (81)-(82).
    """
    for i in range(speeds.size):
        error = speeds[i] - reference[i]
        terms[0, i] = -estimate[i]
        terms[1, i] = -gain * error
        terms[2, i] = reference_rate[i]
        terms[3, i] = compensator(error, bound, smoothing)
        terms[4, i] = predictive[i]
        command[i] = terms[0, i] + terms[1, i] + terms[2, i] + terms[3, i] + terms[4, i]


@kernel
def compensator(error: float, bound: float, smoothing: float) -> float:
    r"""Return v_c (rad/s²) for one wheel, equations (81)-(82) with the width of E14.

    .. math:: v_c = -(\bar\omega + \bar v_p)\tanh(\delta/\epsilon)

    bound : omega-bar + v_p-bar, rad/s²; smoothing : epsilon, 1 rad/s in the paper
    """
    return -bound * math.tanh(error / smoothing)


# -- stability: the bound E14 of V (74), and the certificate at run time --------------------------


def lyapunov_rate_bound(
    errors: Sequence[float], gain: float, bound: float, smoothing: float
) -> float:
    r"""Return the upper bound of V' under the law, rad²/s³: (83) as corrected by E14.

    .. math:: \dot V \le -K\|\delta\|^2 + 0.2785\,\epsilon \sum_i(\bar\omega_i + \bar v_{p,i})

    E14: tanh is not the sign function, so (83)-(84) do not hold as printed. Since
    :math:`|x| - x\tanh(x/\epsilon) \le 0.2785\,\epsilon` (Polycarpou and Ioannou 1996), the
    compensator outweighs the bounded terms of (79)-(80) up to that amount, and the error is
    ultimately bounded by :func:`ultimate_bound` instead of vanishing. E13: the last cross term
    of (76) and (79) is delta_2 v_p2.

    E17: the printed (84) omits V(0); its integral is negative, V is not. Integrated, the bound is
    :math:`V(t) \le V(0) - K\int\|\delta\|^2 + 0.2785\,\epsilon\, t
    \sum_i(\bar\omega_i + \bar v_{p,i})`.
    """
    return -gain * squared_norm(errors) + TANH_GAP * smoothing * bound * len(errors)


def squared_norm(errors: Sequence[float]) -> float:
    """Return |delta|², rad²/s²; ``sum`` rounds differently from one Python to the next."""
    total = 0.0
    for error in errors:
        total += error * error
    return total


def ultimate_bound(gain: float, bound: float, smoothing: float, wheels: int = 2) -> float:
    """Return the radius (rad/s) outside which V of (74) decreases: the ball of E14."""
    return math.sqrt(TANH_GAP * smoothing * bound * wheels / gain)


class CertificateReading(NamedTuple):
    """Value of V, its rate and the bound of the rate at one step."""

    value: float = 0.0  # half of |delta|², rad²/s²: the measurable part of V (74)
    rate: float = 0.0  # measured rate of the value, averaged over the window, rad²/s³
    bound: float = 0.0  # upper bound of the rate by E14, averaged over the window, rad²/s³

    @property
    def margin(self) -> float:
        """Bound minus rate; the certificate holds while it is not negative."""
        return self.bound - self.rate

    @property
    def holds(self) -> bool:
        """Whether the measured rate is within the bound of E14."""
        return self.margin >= 0.0


class Certificate:
    """Checks at run time that the error decreases as E14 predicts.

    The ideal coefficients alpha* in (74) are unknown at run time, so the certificate uses the
    measurable part V = |delta|²/2. Its rate obeys the same bound (83)/E14 as long as the *whole*
    estimation error, g* - g plus disturbance, is within omega-bar. A negative margin shows a
    larger error, or a recent jump of the reference.

    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Clear the averages."""
        self.reading = CertificateReading()  # reading at the last step
        self._started = False

    def update(
        self, errors: Sequence[float], gain: float, bound: float, smoothing: float, dt: float
    ) -> CertificateReading:
        """Return the reading after errors (rad/s), ``dt`` s after the last ones."""
        last, value = self.reading, 0.5 * squared_norm(errors)
        rate = (value - last.value) / dt if self._started and dt > 0.0 else 0.0
        allowed = lyapunov_rate_bound(errors, gain, bound, smoothing)
        weight = min(1.0, dt / CERTIFICATE_TIME)
        self._started = True
        self.reading = CertificateReading(
            value,
            last.rate + weight * (rate - last.rate),
            last.bound + weight * (allowed - last.bound),
        )
        return self.reading


# -- the controller ----------------------------------------------------------------------


class Nt3fsMpcController:
    """Computes the wheel accelerations with which two wheels track a reference.

    The plant is (64)-(65): chi' = g*(chi) + u + omega for each wheel, with unknown g*.
    :class:`~t3mpc_ros.control.velocity_actuation.VelocityActuation` provides this plant on a
    robot, and reports by :meth:`set_applied` the u within the limits, because the estimates must
    use the acceleration that was applied. Inputs are speeds, outputs accelerations; the law uses
    no pose and no clock.

    **Integral transfer.** The adaptation and the offset-free predictive term both integrate.
    Without further measures their shares of a persistent disturbance are arbitrary and may oppose
    each other. The fuzzy systems therefore learn from delta - integral_transfer v_p. A v_p that
    compensates the unlearnt part, v_p = -(g* - g), adds -integral_transfer (g* - g)² to (76):
    the stability proof remains valid.
    """

    def __init__(self, parameters: Nt3fsMpcParameters) -> None:
        self._parameters = parameters
        self._period = 1.0 / parameters.rate
        self.fuzzy = FuzzyEstimator(parameters.fuzzy, parameters.adaptation, outputs=2)
        self._friction = LinearTerm.of(wheels=2)
        self._inertia = LinearTerm.of(wheels=2)
        self.predictive = PredictiveController(
            parameters.predictive, self._period, parameters.law.gain, outputs=2
        )
        self._certificate = Certificate()
        self._output = LawOutput(
            np.zeros(2), np.zeros(2), np.zeros((len(TERM_NAMES), 2)), np.zeros(2)
        )
        self.terms, self.command = self._output.terms, self._output.command
        """Terms of the last step, rows as in ``TERM_NAMES``, and their sum u, rad/s²."""
        self.saturated = False  # whether a limit changed the last command
        self._step_law = TypedKernel(step_law)
        self._set_applied_term = TypedKernel(set_applied_term)
        self._gains = self._law_gains()
        self.reset()

    def warm_up(self) -> None:
        """Compile every kernel and pretrain the predictor, so that no step has to."""
        self.fuzzy.warm_up()
        self.predictive.warm_up()
        coefficients, friction = self.fuzzy.coefficients, self.friction.copy()
        inertia = self.inertia.copy()
        self.step(np.zeros(2), np.zeros(2), np.zeros(2), self._period)
        self.set_applied(self.command, saturated=True)
        self.fuzzy.reset()
        self.fuzzy.coefficients, self.friction[:] = coefficients, friction
        self.inertia[:] = inertia
        self.reset()
        self.terms[:] = 0.0
        self.command[:] = 0.0

    def configure(self, parameters: Nt3fsMpcParameters) -> None:
        """Use new values of the dynamic parameters from the next step on; weights are kept."""
        self._parameters = parameters
        self.fuzzy.configure(parameters.adaptation)
        self.predictive.configure(parameters.predictive, parameters.law.gain)
        self._gains = self._law_gains()

    def get_weights(self) -> dict[str, Array]:
        """Return all adapted arrays by name: coefficients of g, and predictor weights."""
        weights = self.predictive.get_weights()
        found = {
            'fuzzy.coefficients': self.fuzzy.coefficients,
            FRICTION_WEIGHTS: self.friction.copy(),
        }
        if self._gains.inertia.gamma > 0.0:
            found[INERTIA_WEIGHTS] = self.inertia.copy()
        return found | {f'predictive.{name}': value for name, value in weights.items()}

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Use weights of :meth:`get_weights`; those of friction and inertia may be missing.

        Values that do not fit raise ValueError; the predictor is then unchanged.
        """
        predictive = {
            name.removeprefix('predictive.'): value
            for name, value in weights.items()
            if name.startswith('predictive.')
        }
        if 'fuzzy.coefficients' not in weights:
            raise ValueError('fuzzy.coefficients are missing')
        terms = {FRICTION_WEIGHTS: self.friction, INERTIA_WEIGHTS: self.inertia}
        given = {}
        for name, term in terms.items():
            given[name] = np.asarray(weights.get(name, np.zeros((2, 2))), dtype=np.float64)
            if given[name].shape != term.shape or not np.isfinite(given[name]).all():
                raise ValueError(
                    f'{name} must be finite, of shape {term.shape}: got shape {given[name].shape}'
                )
        self.fuzzy.coefficients = weights['fuzzy.coefficients']
        self.predictive.set_weights(predictive)
        for name, term in terms.items():
            term[:] = given[name]

    def reset_estimate(self) -> None:
        """Discard what is known of the estimate g."""
        self.fuzzy.reset()
        self.friction[:] = 0.0
        self.inertia[:] = 0.0

    def reset(self) -> None:
        """Start a new run; the weights are kept."""
        self.predictive.reset()
        self._certificate.reset()
        self.saturated = False

    @property
    def friction(self) -> Array:
        """Coefficients of the Coulomb friction in g (E23), rad/s², shape (2, 2)."""
        return self._friction.coefficients

    @property
    def inertia(self) -> Array:
        """Coefficients of the wrong inertia in g (E24), rad/s², shape (2, 2)."""
        return self._inertia.coefficients

    @property
    def certificate(self) -> CertificateReading:
        """Reading of the certificate at the last step."""
        return self._certificate.reading

    @property
    def ultimate_bound(self) -> float:
        """Radius (rad/s) of the ball in which the error ends by E14."""
        gains = self._gains
        return ultimate_bound(gains.gain, gains.bound, gains.smoothing)

    def step(
        self,
        speeds: Array,
        reference: Array,
        reference_rate: Array,
        dt: float,
        future_jumps: Array | None = None,
    ) -> Array:
        """Return the wheel accelerations u (rad/s²) of (66)-(67), shape (2,).

        speeds, reference : chi predicted for the instant at which u takes effect, and reachable r
        reference_rate : derivative of r until the next step, rad/s²
        future_jumps : future jumps of the error, see :meth:`PredictiveController.step`
        """
        speeds, reference = contiguous(speeds), contiguous(reference)
        self.predictive.advance(speeds, reference, future_jumps)
        if not self._step_law(
            speeds,
            reference,
            contiguous(reference_rate),
            dt,
            self.saturated,
            self._gains,
            self.predictive.signals,
            self.fuzzy.tables,
            self._friction,
            self._inertia,
            self._output,
        ):
            raise ValueError(f'speeds must be finite: got {speeds}')
        gains = self._gains
        self._certificate.update(
            self.predictive.signals.errors.tolist(), gains.gain, gains.bound, gains.smoothing, dt
        )
        return self.command

    def set_applied(self, acceleration: Array, *, saturated: bool) -> None:
        """Set the acceleration (rad/s²) that the actuation applied at the last step.

        If a limit changed the command, the adaptation pauses, because the error is not an
        estimation
        error, and the predictor uses the applied part of v_p.
        """
        self.saturated = saturated
        if saturated and not self._set_applied_term(
            contiguous(acceleration), self._output, self.predictive.signals
        ):
            raise ValueError(f'acceleration must be finite: got {acceleration}')

    def _law_gains(self) -> 'LawGains':
        parameters, law = self._parameters, self._parameters.law
        adaptation = parameters.adaptation
        linear = self.fuzzy.gains._replace(radius=math.sqrt(2.0) * adaptation.radius)
        return LawGains(
            use_fuzzy=parameters.use_fuzzy,
            adapted=parameters.use_fuzzy and adaptation.enabled,
            integral_transfer=parameters.integral_transfer,
            gain=law.gain,
            bound=parameters.compensated_bound if law.compensator else 0.0,
            smoothing=law.smoothing,
            fuzzy=self.fuzzy.gains,
            friction=linear._replace(gamma=parameters.friction.gamma),
            friction_width=parameters.friction.width,
            inertia=linear._replace(gamma=parameters.inertia.gamma),
            inertia_acceleration=parameters.inertia.acceleration,
        )


class LawGains(NamedTuple):
    """Parameters of :func:`step_law`."""

    use_fuzzy: bool
    adapted: bool
    integral_transfer: float
    gain: float
    bound: float
    smoothing: float
    fuzzy: AdaptationGains
    friction: AdaptationGains
    friction_width: float
    inertia: AdaptationGains
    inertia_acceleration: float


class LawOutput(NamedTuple):
    """Results of :func:`step_law`."""

    estimate: Array  # g, rad/s², shape (n,)
    adaptation_error: Array  # error from which the fuzzy systems learn, rad/s, shape (n,)
    terms: Array  # terms of u, rows as in ``TERM_NAMES``, rad/s², shape (5, n)
    command: Array  # u, rad/s², shape (n,)


@kernel
def step_law(
    speeds: Array,
    reference: Array,
    reference_rate: Array,
    dt: float,
    saturated: bool,
    gains: LawGains,
    predictive: Signals,
    fuzzy: FuzzyTables,
    friction: LinearTerm,
    inertia: LinearTerm,
    output: LawOutput,
) -> bool:
    """Write terms and command of the law, and adapt the fuzzy systems, unless ``saturated``.

    Return False, and change nothing, if a speed is not finite. ``fuzzy``, ``friction`` and
    ``inertia`` are parts of the estimate g by (31), E23 and E24.
    """
    fuzzy_estimate, adaptation_error = output.estimate, output.adaptation_error
    fuzzy_estimate[:] = 0.0
    if gains.use_fuzzy and not estimate(speeds, fuzzy, fuzzy_estimate):
        return False
    has_friction = gains.use_fuzzy and gains.friction.gamma > 0.0
    if has_friction:
        add_friction(reference, gains.friction_width, friction, fuzzy_estimate)
    has_inertia = gains.use_fuzzy and gains.inertia.gamma > 0.0
    if has_inertia:
        add_inertia(reference_rate, gains.inertia_acceleration, inertia, fuzzy_estimate)
    law_terms(
        speeds,
        reference,
        reference_rate,
        fuzzy_estimate,
        predictive.v,
        gains.gain,
        gains.bound,
        gains.smoothing,
        output.terms,
        output.command,
    )
    if gains.adapted and not saturated:
        # The residual of an announced jump is excluded from adaptation.
        for i in range(adaptation_error.size):
            adaptation_error[i] = (
                predictive.jump_free_errors[i] - gains.integral_transfer * predictive.v[i]
            )
        adapt(fuzzy.coefficients, fuzzy.phi, adaptation_error, dt, gains.fuzzy)
        if has_friction:
            adapt(friction.coefficients, friction.basis, adaptation_error, dt, gains.friction)
        if has_inertia:
            adapt(inertia.coefficients, inertia.basis, adaptation_error, dt, gains.inertia)
    return True


@kernel
def set_applied_term(acceleration: Array, output: LawOutput, predictive: Signals) -> bool:
    """Write the v_p that was applied when a limit changed u; return whether it is finite."""
    for i in range(acceleration.size):
        predictive.applied[i] = output.terms[4, i] + (acceleration[i] - output.command[i])
        if not math.isfinite(predictive.applied[i]):
            return False
    return True
