# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Control law of the paper for two wheels: Fig. 1, equations (64)-(84)."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.jump_transition import JumpTransitionParameters
from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, adapt, estimate
from t3mpc_ros.fuzzy.sets import FuzzyParameters
from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.predictive_controller import (
    PredictiveController,
    PredictiveParameters,
    signals_view,
)
from t3mpc_ros.parameters.table import Parameters, group, parameter

Array = NDArray[np.float64]

TERM_NAMES = ('fuzzy', 'feedback', 'feedforward', 'compensator', 'predictive')
"""What the law adds up, in the order of the rows of ``terms``."""

TANH_GAP = 0.2785
"""E14: the largest value of |x| - x tanh(x), rounded up (0.27846, taken at x = 0.6392)."""


@dataclass(frozen=True)
class LawParameters(Parameters):
    """Gains of the law and of the compensator."""

    gain: float = parameter(
        15.2,
        'feedback K on the tracking error (66)-(67), found by lab tune for the velocity drive; K '
        'and the slope of the compensator, (omega-bar + v_p-bar)/epsilon, make 41 together, close '
        'to (1 - exp(-T/lag))/T = 39.3, where measured noise does not reach the command by itself',
        unit='1/s',
        low=0.1,
        high=100.0,
        dynamic=True,
    )
    compensator: bool = parameter(
        True, 'whether the compensator (81)-(82) is part of the command', dynamic=True
    )
    error_bound: float = parameter(
        6.0,
        'bound of the estimation error per wheel that the compensator outweighs, omega-bar (80)',
        unit='rad/s²',
        low=0.0,
        high=100.0,
        dynamic=True,
    )
    smoothing: float = parameter(
        0.62,
        'width of the compensator about zero error, epsilon in tanh(delta/epsilon): E14 pays '
        '0.2785 epsilon for it, small values chatter under noise',
        unit='rad/s',
        low=1e-3,
        high=100.0,
        dynamic=True,
    )


@kernel
def compensator(error: float, bound: float, smoothing: float) -> float:
    """Return v_c (rad/s²) for one wheel, equations (81)-(82) with the width of E14.

    Parameters
    ----------
    error
        delta, rad/s.
    bound
        omega-bar + v_p-bar, rad/s².
    smoothing
        epsilon, rad/s; the paper's tanh(delta) is epsilon = 1 rad/s.
    """
    return -bound * math.tanh(error / smoothing)


@kernel
def law_terms(
    speeds: Array,
    wanted: Array,
    wanted_rate: Array,
    estimate: Array,
    predictive: Array,
    gain: float,
    bound: float,
    smoothing: float,
    terms: Array,
    command: Array,
) -> None:
    r"""Write the law's terms and their sum, equations (66)-(67) with E12.

    .. math:: u_i = -g_i(\chi|\alpha_i) - K\delta_i + \dot r_i + v_{c,i} + v_{p,i}, \qquad
              \delta = \chi - r

    E12: the printed :math:`+\omega_i` is the unknown estimation error and cannot be applied; it
    is :math:`\dot r_i`, and with it (68)-(69) follow from (64)-(65), and by (70)-(71) the error
    system (72)-(73) of each wheel,
    :math:`\dot\delta = \tilde\alpha^T\Phi - K\delta + \omega + v_c + v_p`. The compensator is
    (81)-(82),
    :math:`v_c = -(\bar\omega + \bar v_p)\tanh(\delta/\epsilon)`.

    speeds, wanted : shape (n,), chi and r, rad/s
    wanted_rate, estimate, predictive : shape (n,), r', g and v_p, rad/s²
    gain, bound, smoothing : K (1/s), omega-bar + v_p-bar (rad/s²), epsilon (rad/s)
    terms : shape (5, n), overwritten, rows as in ``TERMS``, rad/s²
    command : shape (n,), overwritten, u, rad/s²
    """
    for i in range(speeds.size):
        error = speeds[i] - wanted[i]
        terms[0, i] = -estimate[i]
        terms[1, i] = -gain * error
        terms[2, i] = wanted_rate[i]
        terms[3, i] = compensator(error, bound, smoothing)
        terms[4, i] = predictive[i]
        command[i] = terms[0, i] + terms[1, i] + terms[2, i] + terms[3, i] + terms[4, i]


def lyapunov_value(errors: Array, coefficient_errors: Array, adaptation_gain: float) -> float:
    """Return V of equation (74), rad²/s²: half of |delta|² plus |alpha* - alpha|²/(2 gamma).

    Along the loop V' is (75), the sum of delta delta' - alpha~ alpha'/gamma. With the law in it
    that is (76), and (79) when the coefficients follow (77)-(78).

    Parameters
    ----------
    errors
        delta, shape (n,), rad/s.
    coefficient_errors
        alpha~ = alpha* - alpha of all outputs, rad/s².
    adaptation_gain
        gamma, 1/s².
    """
    squares = float(np.sum(coefficient_errors**2))
    return 0.5 * float(errors @ errors) + squares / (2.0 * adaptation_gain)


@kernel
def lyapunov_rate_bound(errors: Array, gain: float, bound: float, smoothing: float) -> float:
    r"""Return the largest V' that the law allows, rad²/s³: (83) as corrected by E14.

    .. math:: \dot V \le -K\|\delta\|^2 + 0.2785\,\epsilon \sum_i(\bar\omega_i + \bar v_{p,i})

    E14: tanh is not the sign function, so (83)-(84) do not hold as printed. Since
    :math:`|x| - x\tanh(x/\epsilon) \le 0.2785\,\epsilon` (Polycarpou and Ioannou 1996), the
    compensator outweighs the bounded terms of (79)-(80) up to that amount, and the error is
    ultimately bounded by :func:`ultimate_bound` instead of vanishing. E13: the last cross term
    of (76) and (79) is delta_2 v_p2.

    E17: (84) also lost V(0); its integral is negative, V is not. Integrated, the bound says
    :math:`V(t) \le V(0) - K\int\|\delta\|^2 + 0.2785\,\epsilon\, t
    \sum_i(\bar\omega_i + \bar v_{p,i})`.
    """
    return -gain * squared_norm(errors) + TANH_GAP * smoothing * bound * errors.size


@kernel
def squared_norm(errors: Array) -> float:
    """Return |delta|², rad²/s²."""
    total: float = 0.0
    for i in range(errors.size):
        total += errors[i] * errors[i]
    return total


def ultimate_bound(gain: float, bound: float, smoothing: float, wheels: int = 2) -> float:
    """Return the radius (rad/s) outside which V of (74) must fall: the ball of E14."""
    return math.sqrt(TANH_GAP * smoothing * bound * wheels / gain)


class CertificateReading(NamedTuple):
    """What the run-time certificate says at one step."""

    value: float
    """Half of |delta|², rad²/s²: the part of V (74) that can be measured."""
    rate: float
    """Its measured rate of change, averaged over the window, rad²/s³."""
    bound: float
    """The largest rate E14 allows, averaged alike, rad²/s³."""

    @classmethod
    def of(cls, remembered: Array) -> Self:
        """Return what :func:`update_certificate` has written."""
        return cls(*remembered[:STARTED].tolist())

    @property
    def margin(self) -> float:
        """Return bound minus rate: the certificate holds while this is not negative."""
        return self.bound - self.rate

    @property
    def holds(self) -> bool:
        """Whether the measured decrease respects the bound of E14."""
        return self.margin >= 0.0


VALUE, RATE, BOUND, STARTED = range(4)
"""Places of what a certificate remembers: the numbers of a :class:`CertificateReading`, and
whether there was a step before, 0 or 1."""


@kernel
def update_certificate(
    errors: Array,
    gain: float,
    bound: float,
    smoothing: float,
    dt: float,
    window: float,
    remembered: Array,
) -> None:
    """Compare the rate of V with the bound of E14, both averaged over the window.

    errors     : shape (n,), rad/s
    gain, bound, smoothing : as in :func:`law_terms`
    dt, window : s
    remembered : shape (4,), at VALUE, RATE, BOUND, BEGUN
    """
    value = 0.5 * squared_norm(errors)
    rate = (value - remembered[VALUE]) / dt if remembered[STARTED] > 0.0 else 0.0
    allowed = lyapunov_rate_bound(errors, gain, bound, smoothing)
    share = min(1.0, dt / window)
    remembered[RATE] += share * (rate - remembered[RATE])
    remembered[BOUND] += share * (allowed - remembered[BOUND])
    remembered[VALUE] = value
    remembered[STARTED] = 1.0


class Certificate:
    """Checks at run time that the error falls as E14 promises.

    The ideal coefficients alpha* in (74) are unknown while the robot runs, so the certificate
    watches the measurable part V = |delta|²/2. Its rate obeys the same bound (83)/E14 as long as
    the *whole* estimation error, g* - g plus disturbance, stays within omega-bar; a negative
    margin says that it did not, or that the reference has just jumped.

    Parameters
    ----------
    window
        Time constant (s) of the averages: single differences are mostly measurement noise.
    """

    def __init__(self, window: float = 0.5) -> None:
        self.window = window
        self.remembered: Array = np.zeros(4)
        """What :func:`update_certificate` remembers."""
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.remembered[:] = 0.0

    @property
    def reading(self) -> CertificateReading:
        """What the certificate says now."""
        return CertificateReading.of(self.remembered)

    def update(
        self, errors: Array, parameters: LawParameters, bound: float, dt: float
    ) -> CertificateReading:
        """Return the reading after an error sample (rad/s) that came ``dt`` seconds later."""
        update_certificate(
            errors, parameters.gain, bound, parameters.smoothing, dt, self.window, self.remembered
        )
        return self.reading


@dataclass(frozen=True)
class Nt3fsMpcParameters(Parameters):
    """Everything the law is made of; each part can be left out."""

    rate: float = parameter(100.0, 'control steps a second', unit='Hz', low=5.0, high=1000.0)
    use_fuzzy: bool = parameter(
        True, 'whether the fuzzy estimate g is learnt and cancelled (NT3FS)', dynamic=True
    )
    integral_transfer: float = parameter(
        0.025,
        'how strongly a lasting v_p teaches the fuzzy systems, which then take it over: they '
        'learn from delta - integral_transfer v_p; 0 is (77)-(78) as printed',
        unit='s',
        low=0.0,
        high=10.0,
        dynamic=True,
    )
    law: LawParameters = group(LawParameters)
    switches: JumpTransitionParameters = group(JumpTransitionParameters)
    estimate: SpeedFilterParameters = group(SpeedFilterParameters)
    fuzzy: FuzzyParameters = group(FuzzyParameters)
    adaptation: AdaptationParameters = group(AdaptationParameters)
    predictive: PredictiveParameters = group(PredictiveParameters)

    @property
    def compensated_bound(self) -> float:
        """omega-bar + v_p-bar of (80)-(82), rad/s²: what the compensator must outweigh."""
        predictive = self.predictive.v_max if self.predictive.enabled else 0.0
        return self.law.error_bound + predictive


class LawGains(NamedTuple):
    """What :func:`compose` is told of the settings: plain numbers, for kernels."""

    use_fuzzy: bool
    adapted: bool
    integral_transfer: float
    gain: float
    bound: float
    smoothing: float
    window: float
    gamma: float
    radius: float
    leakage: float
    dead_zone: float
    step_limit: float


@kernel
def unpack_gains(told: Array) -> LawGains:
    """Return the numbers of a row by name."""
    return LawGains(
        told[0] != 0.0,
        told[1] != 0.0,
        told[2],
        told[3],
        told[4],
        told[5],
        told[6],
        told[7],
        told[8],
        told[9],
        told[10],
        told[11],
    )


@kernel
def step_law(
    speeds: Array,
    wanted: Array,
    wanted_rate: Array,
    rows: Array,
    dt: float,
    frozen: bool,
    gains_told: Array,
    centres: Array,
    nonsingleton_gain: Array,
    sharpness: Array,
    shares: Array,
    grades: Array,
    firings: Array,
    phi: Array,
    coefficients: Array,
    work: Array,
    terms: Array,
    command: Array,
    remembered: Array,
) -> bool:
    """Write terms and command of the law, adapt, and renew the certificate.

    Returns False, and changes nothing, when a speed is not finite.

    speeds ... wanted_rate : as in :func:`t3mpc_ros.control.control_law.law_terms`
    rows           : :class:`t3mpc_ros.mpc.predictive_controller.Signals` of the predictive term
    dt             : s since the last step
    frozen         : whether a limit cut the last command
    gains_told     : the numbers of :class:`Gains`
    centres ... coefficients : as in :func:`t3mpc_ros.fuzzy.estimator.estimate`
    work           : shape (2, n), overwritten: g, and what the coefficients learn from
    terms, command : overwritten
    remembered     : as in :func:`t3mpc_ros.control.control_law.update_certificate`
    """
    gains, predictive = unpack_gains(gains_told), signals_view(rows)
    guess, blame = work[0], work[1]
    guess[:] = 0.0
    if gains.use_fuzzy and not estimate(
        speeds,
        centres,
        nonsingleton_gain,
        sharpness,
        shares,
        grades,
        firings,
        phi,
        coefficients,
        guess,
    ):
        return False
    law_terms(
        speeds,
        wanted,
        wanted_rate,
        guess,
        predictive.v,
        gains.gain,
        gains.bound,
        gains.smoothing,
        terms,
        command,
    )
    if gains.adapted and not frozen:
        # What is left of a jump that was announced is nobody's fault, and teaches nothing.
        for i in range(blame.size):
            blame[i] = predictive.jump_free_errors[i] - gains.integral_transfer * predictive.v[i]
        adapt(
            coefficients,
            phi,
            blame,
            dt,
            gains.gamma,
            gains.radius,
            gains.leakage,
            gains.dead_zone,
            gains.step_limit,
        )
    update_certificate(
        predictive.errors, gains.gain, gains.bound, gains.smoothing, dt, gains.window, remembered
    )
    return True


@kernel
def set_applied_term(terms: Array, acceleration: Array, command: Array, rows: Array) -> bool:
    """Write the v_p that was applied where a limit cut u; return False if it is not finite.

    terms, command : of :func:`compose`
    acceleration   : shape (2,), what the limits made of the command, rad/s²
    rows           : :class:`t3mpc_ros.mpc.predictive_controller.Signals` of the predictive term
    """
    predictive = signals_view(rows)
    for i in range(acceleration.size):
        predictive.applied[i] = terms[4, i] + (acceleration[i] - command[i])
        if not math.isfinite(predictive.applied[i]):
            return False
    return True


class Nt3fsMpcController:
    """Computes the wheel accelerations that make two wheels follow a reference.

    The plant it expects is (64)-(65): chi' = g*(chi) + u + omega for each wheel, g* unknown.
    :class:`t3mpc_ros.control.actuation.VelocityActuation` makes that plant of a robot, and tells by
    :meth:`applied` what its limits made of u, because estimates must use the acceleration that
    was really applied. The law knows neither poses nor clocks: speeds in, accelerations out.

    **Handover.** The adaptation and the offset-free predictive term both integrate; left alone
    they may share a lasting disturbance in any way, even against each other. The fuzzy systems
    therefore learn from delta - integral_transfer v_p. A v_p that opposes what they have not learnt,
    v_p = -(g* - g), adds -integral_transfer (g* - g)² to (76): it can only help the proof.

    Parameters
    ----------
    settings
        The parts and their gains.
    """

    def __init__(self, parameters: Nt3fsMpcParameters) -> None:
        self._parameters = parameters
        self._period = 1.0 / parameters.rate
        self.fuzzy = FuzzyEstimator(parameters.fuzzy, parameters.adaptation, outputs=2)
        self.predictive = PredictiveController(
            parameters.predictive, self._period, parameters.law.gain, outputs=2
        )
        self._certificate = Certificate()
        self._work: Array = np.zeros((2, 2))
        self.terms: Array = np.zeros((len(TERM_NAMES), 2))
        """The law's terms of the last step, rows as in ``law.TERMS``, rad/s²."""
        self.command: Array = np.zeros(2)
        """Their sum u, rad/s²."""
        self.frozen = False
        """Whether a limit cut the last command."""
        self._gains = self._make_gains()
        self.reset()

    def warm_up(self) -> None:
        """Compile every kernel and pre-train the predictor now, never inside a step."""
        self.fuzzy.warm_up()
        self.predictive.warm_up()
        coefficients = self.fuzzy.coefficients
        self.step(np.zeros(2), np.zeros(2), np.zeros(2), self._period)
        self.applied(self.command, limited=True)
        self.fuzzy.reset()
        self.fuzzy.coefficients = coefficients
        self.reset()
        self.terms[:] = 0.0
        self.command[:] = 0.0

    def configure(self, parameters: Nt3fsMpcParameters) -> None:
        """Use other live settings from the next step on; what was learnt is kept."""
        self._parameters = parameters
        self.fuzzy.configure(parameters.adaptation)
        self.predictive.configure(parameters.predictive, parameters.law.gain)
        self._gains = self._make_gains()

    def learnt(self) -> dict[str, Array]:
        """Return everything learnt, by name, to be saved: coefficients and predictor weights."""
        weights = self.predictive.get_weights()
        return {'fuzzy.coefficients': self.fuzzy.coefficients.copy()} | {
            f'predictive.{name}': value for name, value in weights.items()
        }

    def restore(self, learnt: Mapping[str, Array]) -> None:
        """Use what :meth:`learnt` returned.

        Raises
        ------
        ValueError
            A name is missing or unknown, a shape does not fit these settings, or a number is not
            finite; nothing is changed then but the fuzzy coefficients.
        """
        weights = {
            name.removeprefix('predictive.'): value
            for name, value in learnt.items()
            if name.startswith('predictive.')
        }
        if 'fuzzy.coefficients' not in learnt:
            raise ValueError('fuzzy.coefficients are missing')
        self.fuzzy.coefficients = learnt['fuzzy.coefficients']
        self.predictive.set_weights(weights)

    def snapshot(self) -> tuple[Array, list[Array]]:
        """Return what is learnt as it is now, for :meth:`go_back`: much faster than learnt."""
        return self.fuzzy.coefficients, self.predictive.snapshot()

    def rollback(self, snapshot: tuple[Array, list[Array]]) -> None:
        """Use what :meth:`copies` returned, as :meth:`restore` does."""
        coefficients, predictors = snapshot
        self.fuzzy.coefficients = coefficients
        self.predictive.rollback(predictors)

    def reset(self) -> None:
        """Start a new run; what was learnt is kept."""
        self.predictive.reset()
        self._certificate.reset()
        self.frozen = False

    @property
    def tables(self) -> tuple[Array, ...]:
        """What :func:`compose` reads and writes beside its inputs, in its order."""
        remembered = self._certificate.remembered
        return self._gains, *self.fuzzy.tables, self._work, self.terms, self.command, remembered

    @property
    def watched(self) -> Array:
        """What the certificate remembers, see :func:`update_certificate`."""
        return self._certificate.remembered

    @property
    def reading(self) -> CertificateReading:
        """What the certificate says."""
        return self._certificate.reading

    @property
    def ball(self) -> float:
        """Radius (rad/s) of the ball that E14 promises the error ends in."""
        law = self._parameters.law
        return ultimate_bound(law.gain, self._bound(), law.smoothing)

    def step(
        self,
        speeds: Array,
        wanted: Array,
        wanted_rate: Array,
        dt: float,
        known_change: Array | None = None,
    ) -> Array:
        """Return the wheel accelerations u (rad/s²) of (66)-(67), shape (2,).

        Parameters
        ----------
        speeds
            Wheel speeds chi (estimated, for the instant at which u begins to act), rad/s, (2,).
        wanted, wanted_rate
            Reference r (rad/s) at that instant and its time derivative until the next step
            (rad/s²), shape (2,): a reference that the wheels can follow.
        dt
            Seconds since the last step.
        known_change
            Jumps of the error still to come, see :meth:`PredictiveController.step`.
        """
        self.predictive.advance(speeds, wanted, known_change)
        if not step_law(
            speeds,
            wanted,
            wanted_rate,
            self.predictive.rows,
            dt,
            self.frozen,
            self._gains,
            *self.fuzzy.tables,
            self._work,
            self.terms,
            self.command,
            self._certificate.remembered,
        ):
            raise ValueError(f'speeds must be finite: got {speeds}')
        return self.command

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of what the drive made of the last command.

        Parameters
        ----------
        acceleration
            Wheel accelerations really applied, rad/s², shape (2,).
        limited
            Whether a limit cut the command: the error is then not the estimate's fault, so
            adaptation pauses, and the predictor is told that less of v_p arrived.
        """
        self.frozen = limited
        if limited and not set_applied_term(
            self.terms, acceleration, self.command, self.predictive.rows
        ):
            raise ValueError(f'acceleration must be finite: got {acceleration}')

    def _make_gains(self) -> Array:
        parameters, law, adaptation = (
            self._parameters,
            self._parameters.law,
            self._parameters.adaptation,
        )
        return np.array(
            LawGains(
                use_fuzzy=parameters.use_fuzzy,
                adapted=parameters.use_fuzzy and adaptation.enabled,
                integral_transfer=parameters.integral_transfer,
                gain=law.gain,
                bound=self._bound(),
                smoothing=law.smoothing,
                window=self._certificate.window,
                gamma=adaptation.gamma,
                radius=self.fuzzy.radius,
                leakage=adaptation.sigma_modification,
                dead_zone=adaptation.dead_zone,
                step_limit=adaptation.step_limit,
            ),
            dtype=np.float64,
        )

    def _bound(self) -> float:
        return self._parameters.compensated_bound if self._parameters.law.compensator else 0.0
