# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Adaptation of the fuzzy coefficients, equations (77)-(78), and what keeps them bounded."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.settings import Settings, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AdaptationSettings(Settings):
    """How fast the coefficients learn, and what they must not do."""

    enabled: bool = setting(True, 'whether the coefficients are adapted at all', live=True)
    gamma: float = setting(
        240.0,
        'adaptation gain gamma of (77)-(78). What is felt is the normalised gain gamma |Phi|² '
        '(1/s²): the error then obeys s² + K s + gamma |Phi|² = 0. With the default type-3 sets '
        '|Phi|² is 0.015 to 0.14, so 240 makes about 15; with type1 or interval_type2 it is about '
        'three times larger, so a third of gamma does the same',
        unit='1/s²',
        low=0.0,
        high=1e6,
        live=True,
    )
    radius: float = setting(
        40.0,
        'root mean square of the coefficients of an output at the surface of the ball they are '
        'projected onto, |alpha| <= radius sqrt(2 r lambda): a constant estimate of this size '
        'just fits in, whatever the number of rules',
        unit='rad/s²',
        low=0.0,
        high=1e4,
        live=True,
    )
    sigma_modification: float = setting(
        0.0,
        'rate at which coefficients leak towards zero (gamma times the usual sigma); bounds them '
        'without a known ball, at the price of a bias',
        unit='1/s',
        low=0.0,
        high=10.0,
        live=True,
    )
    dead_zone: float = setting(
        0.0,
        'error from which on coefficients adapt; a smaller one counts as noise. At least the '
        'disturbance that no coefficients can explain divided by K; noise about as wide already '
        'drifts little',
        unit='rad/s',
        low=0.0,
        high=10.0,
        live=True,
    )
    step_limit: float = setting(
        2.0,
        'largest gamma |Phi|² dt of one step, beyond which gamma is reduced; the sampled loop is '
        'stable only while it stays below K',
        unit='1/s',
        low=0.001,
        high=1000.0,
        live=True,
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
