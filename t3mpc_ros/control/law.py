# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The control law (66)-(67), its compensator (81)-(82) and its certificate (74)-(84)."""

from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.settings import Settings, setting

Array = NDArray[np.float64]

TERMS = ('fuzzy', 'feedback', 'feedforward', 'compensator', 'predictive')
"""What the law adds up, in the order of the rows of ``terms``."""

TANH_GAP = 0.2785
"""E14: the largest value of |x| - x tanh(x), rounded up (0.27846, taken at x = 0.6392)."""


@dataclass(frozen=True)
class LawSettings(Settings):
    """Gains of the law and of the compensator."""

    gain: float = setting(
        15.2,
        'feedback K on the tracking error (66)-(67), found by lab tune for the velocity drive; K '
        'and the slope of the compensator, (omega-bar + v_p-bar)/epsilon, make 41 together, close '
        'to (1 - exp(-T/lag))/T = 39.3, where measured noise does not reach the command by itself',
        unit='1/s',
        low=0.1,
        high=100.0,
        live=True,
    )
    compensator: bool = setting(
        True, 'whether the compensator (81)-(82) is part of the command', live=True
    )
    error_bound: float = setting(
        6.0,
        'bound of the estimation error per wheel that the compensator outweighs, omega-bar (80)',
        unit='rad/s²',
        low=0.0,
        high=100.0,
        live=True,
    )
    smoothing: float = setting(
        0.62,
        'width of the compensator about zero error, epsilon in tanh(delta/epsilon): E14 pays '
        '0.2785 epsilon for it, small values chatter under noise',
        unit='rad/s',
        low=1e-3,
        high=100.0,
        live=True,
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
    return -gain * square_length(errors) + TANH_GAP * smoothing * bound * errors.size


@kernel
def square_length(errors: Array) -> float:
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
        return cls(*remembered[:BEGUN].tolist())

    @property
    def margin(self) -> float:
        """Return bound minus rate: the certificate holds while this is not negative."""
        return self.bound - self.rate

    @property
    def holds(self) -> bool:
        """Whether the measured decrease respects the bound of E14."""
        return self.margin >= 0.0


VALUE, RATE, BOUND, BEGUN = range(4)
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
    value = 0.5 * square_length(errors)
    rate = (value - remembered[VALUE]) / dt if remembered[BEGUN] > 0.0 else 0.0
    allowed = lyapunov_rate_bound(errors, gain, bound, smoothing)
    share = min(1.0, dt / window)
    remembered[RATE] += share * (rate - remembered[RATE])
    remembered[BOUND] += share * (allowed - remembered[BOUND])
    remembered[VALUE] = value
    remembered[BEGUN] = 1.0


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
        self, errors: Array, settings: LawSettings, bound: float, dt: float
    ) -> CertificateReading:
        """Return the reading after an error sample (rad/s) that came ``dt`` seconds later."""
        update_certificate(
            errors, settings.gain, bound, settings.smoothing, dt, self.window, self.remembered
        )
        return self.reading
