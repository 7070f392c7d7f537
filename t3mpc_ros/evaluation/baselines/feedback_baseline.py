# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Base of the feedback baselines: tracking error without jumps and limits.

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
"""

from dataclasses import dataclass
import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]
Table = TypeVar('Table', bound=Parameters)

# Rows of the memory, shape (n, 2); rows of the individual method follow.
TRANSIENT, CLOSING, REQUESTED, APPLIED, PREDICTED_REFERENCE, OWN = range(6)


@dataclass(frozen=True)
class JumpTransientParameters(Parameters):
    """Parameters of the transient h after a jump of the reference."""

    rate: float = parameter(
        100.0,
        'rate at which the error closes that a jump of the reference or a limit has made',
        unit='1/s',
        low=1.0,
        high=500.0,
    )
    acceleration: float = parameter(
        200.0,
        'largest acceleration requested for it; a torque limit is not reported back, so that with '
        'a torque drive this should be what the motors can do',
        unit='rad/s²',
        low=1.0,
        high=1000.0,
    )


@kernel
def disturbance_error(
    wheel: int,
    speeds: Array,
    reference: Array,
    period: float,
    input_gain: float,
    share: float,
    acceleration: float,
    memory: Array,
) -> float:
    """Return e (rad/s), the error that neither jumps nor limits explain; renew h and v(h).

    speeds, wanted : shape (2,), chi and r, rad/s
    period : T, s
    input_gain : acceleration per unit of u, 1
    share : 1 - exp(-rate T), so that h never overshoots zero however large the rate
    acceleration : largest |v|, rad/s²
    memory : shape (n, 2); an EXPECTED that is not a number means the first step, at which all of
        the error is h: the wheels start from where they are
    """
    error = speeds[wheel] - reference[wheel]
    expected = memory[PREDICTED_REFERENCE, wheel]
    if math.isnan(expected):
        known = error
    else:
        deficit = memory[APPLIED, wheel] - memory[REQUESTED, wheel]
        push = memory[CLOSING, wheel] + input_gain * deficit
        known = memory[TRANSIENT, wheel] + period * push - (reference[wheel] - expected)
    memory[TRANSIENT, wheel] = known
    closing = -share * known / period
    memory[CLOSING, wheel] = min(max(closing, -acceleration), acceleration)
    return float(error - known)


@kernel
def write_acceleration(
    wheel: int, u: float, next_reference: Array, memory: Array, command: Array
) -> None:
    """Write u (rad/s²) of one wheel, and keep what the next :func:`trace` needs.

    All of u counts as applied until :meth:`FeedbackBaseline.applied` corrects it.
    """
    memory[REQUESTED, wheel] = u
    memory[APPLIED, wheel] = u
    memory[PREDICTED_REFERENCE, wheel] = next_reference[wheel]
    command[wheel] = u


def checked_parameters(parameters: Parameters, kind: type[Table]) -> Table:
    """Return ``parameters`` if they are of the type ``kind``.

    Raises
    ------
    ValueError
        They are of another method.
    """
    if not isinstance(parameters, kind):
        raise ValueError(f'parameters must be {kind.__name__}: got {type(parameters).__name__}')
    return parameters


class FeedbackBaseline(BaselineController):
    """Base of baselines that separate the effect of disturbances from that of jumps and limits.

    Parameters
    ----------
    knowledge
        Nominal model of the robot.
    jump_transient
        Rate and acceleration limit of h.
    own
        Number of additional memory rows of the method.
    """

    def __init__(
        self, nominal_model: NominalModel, jump_transient: JumpTransientParameters, own: int
    ) -> None:
        self._period = nominal_model.period
        self._memory: Array = np.zeros((OWN + own, 2))
        self._memory[PREDICTED_REFERENCE] = math.nan
        self._command: Array = np.zeros(2)
        self._closing = (
            1.0 - math.exp(-jump_transient.rate * nominal_model.period),
            jump_transient.acceleration,
        )

    @property
    def transient(self) -> Array:
        """h, the part of the error that jumps and limits explain, rad/s, shape (2,)."""
        transient: Array = self._memory[TRANSIENT].copy()
        return transient

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Store the u after the drive's limits: the remainder adds to h."""
        self._memory[APPLIED] = acceleration
