# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Integral sliding mode control with a boundary layer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feedback_baseline import (
    CLOSING,
    OWN,
    FeedbackBaseline,
    JumpTransientParameters,
    checked_parameters,
    disturbance_error,
    write_acceleration,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, group, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SlidingModeParameters(Parameters):
    """Gains of the sliding mode controller.

    Within the boundary layer it is a PI controller with the proportional gain
    surface + reaching + switching/boundary, which should stay below 1/T.
    """

    surface: float = parameter(
        8.0,
        'slope lambda of the surface s = e + lambda ∫e: the rate of the error on it',
        unit='1/s',
        low=0.1,
        high=100.0,
    )
    reaching: float = parameter(
        8.0, 'linear term of the reaching law, k', unit='1/s', low=0.1, high=100.0
    )
    switching: float = parameter(
        6.0,
        'switching gain eta: outweighs any disturbance that is smaller',
        unit='rad/s²',
        low=0.1,
        high=40.0,
    )
    boundary: float = parameter(
        0.5,
        'boundary layer phi, within which the switching term is linear',
        unit='rad/s',
        low=0.02,
        high=5.0,
    )
    shared_disturbance: float = parameter(
        0.0,
        "share of the filter's unexplained acceleration, common to all methods, in the "
        'equivalent control; what is left is for the switching gain to outweigh',
        low=0.0,
        high=1.0,
    )
    jump_transient: JumpTransientParameters = group(JumpTransientParameters)


@kernel
def _slide(
    speeds: Array,
    unexplained: Array,
    reference: Array,
    next_reference: Array,
    period: float,
    gains: Array,
    memory: Array,
    command: Array,
) -> None:
    """Write the answer of sliding mode; the sum of past e and s stand in the last rows of memory.

    gains : lambda (1/s), k (1/s), eta (rad/s²), phi (rad/s), share of the unexplained, closing
        share and acceleration
    """
    slope, reaching, switching, boundary = gains[0], gains[1], gains[2], gains[3]
    for i in range(2):
        error = disturbance_error(i, speeds, reference, period, 1.0, gains[5], gains[6], memory)
        surface = error + slope * memory[OWN, i]
        memory[OWN, i] += period * error
        memory[OWN + 1, i] = surface
        saturated = min(max(surface / boundary, -1.0), 1.0)
        feedforward = (next_reference[i] - reference[i]) / period + memory[CLOSING, i]
        equivalent = feedforward - slope * error - gains[4] * unexplained[i]
        u = equivalent - reaching * surface - switching * saturated
        write_acceleration(i, u, next_reference, memory, command)


class SlidingMode(FeedbackBaseline):
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
        table = checked_parameters(parameters, SlidingModeParameters)
        super().__init__(nominal_model, table.jump_transient, own=2)
        self._gains: Array = np.array(
            [
                table.surface,
                table.reaching,
                table.switching,
                table.boundary,
                table.shared_disturbance,
                *self._closing,
            ]
        )

    @property
    def surface(self) -> Array:
        """The sliding variable s of the last step, rad/s, shape (2,)."""
        surface: Array = self._memory[OWN + 1].copy()
        return surface

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        _slide(
            observation.speeds,
            observation.unexplained,
            observation.reference,
            observation.next_reference,
            self._period,
            self._gains,
            self._memory,
            self._command,
        )
        return self._command
