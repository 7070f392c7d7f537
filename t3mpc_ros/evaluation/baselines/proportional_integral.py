# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Proportional-integral control with feed-forward."""

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
class ProportionalIntegralParameters(Parameters):
    """Gains of the PI controller."""

    gain: float = parameter(
        30.0, 'proportional gain K on the error', unit='1/s', low=0.5, high=100.0
    )
    integral: float = parameter(
        200.0,
        'integral gain; K²/4 is critical damping in continuous time',
        unit='1/s²',
        low=0.1,
        high=5000.0,
    )
    jump_transient: JumpTransientParameters = group(JumpTransientParameters)


@kernel
def _integrate(
    speeds: Array,
    reference: Array,
    next_reference: Array,
    period: float,
    gains: Array,
    memory: Array,
    command: Array,
) -> None:
    """Write the PI's answer. gains : K (1/s), K_i (1/s²), closing share and acceleration."""
    for i in range(2):
        error = disturbance_error(i, speeds, reference, period, 1.0, gains[2], gains[3], memory)
        memory[OWN, i] += period * gains[1] * error
        feedforward = (next_reference[i] - reference[i]) / period + memory[CLOSING, i]
        u = feedforward - gains[0] * error - memory[OWN, i]
        write_acceleration(i, u, next_reference, memory, command)


class ProportionalIntegral(FeedbackBaseline):
    r"""PI with feed-forward: u = r' + v(h) - K e - I, I_k = I_(k-1) + T K_i e_k.

    The feedback sees e alone, whose poles are the roots of

    .. math:: z^2 - (2 - KT - K_iT^2)\,z + (1 - KT) = 0,

    whatever jumps and limits do (two degrees of freedom, Åström and Hägglund 2006). A constant
    disturbance leaves no error.
    """

    parameters_type = ProportionalIntegralParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        table = checked_parameters(parameters, ProportionalIntegralParameters)
        super().__init__(nominal_model, table.jump_transient, own=1)
        self._gains: Array = np.array([table.gain, table.integral, *self._closing])

    @property
    def integral(self) -> Array:
        """I, what the controller opposes to the disturbance, rad/s², shape (2,)."""
        integral: Array = self._memory[OWN].copy()
        return integral

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        _integrate(
            observation.speeds,
            observation.reference,
            observation.next_reference,
            self._period,
            self._gains,
            self._memory,
            self._command,
        )
        return self._command
