# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Active disturbance rejection control with an extended state observer."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feedback_baseline import (
    APPLIED,
    CLOSING,
    OWN,
    PREDICTED_REFERENCE,
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
class DisturbanceRejectionParameters(Parameters):
    """Gains of active disturbance rejection."""

    gain: float = parameter(
        30.0, 'bandwidth of the controller, k', unit='1/s', low=0.5, high=100.0
    )
    observer_bandwidth: float = parameter(
        30.0,
        'bandwidth of the extended state observer, omega_o: both poles at exp(-omega_o T)',
        unit='1/s',
        low=0.5,
        high=300.0,
    )
    input_gain: float = parameter(
        1.0, 'what an acceleration that is asked for brings about, b_0', low=0.3, high=3.0
    )
    shared_disturbance: float = parameter(
        0.0,
        "share of the filter's unexplained acceleration, common to all methods, in what is "
        "cancelled; the rest is the observer's own",
        low=0.0,
        high=1.0,
    )
    shared_speed: float = parameter(
        0.0,
        "share of the filter's speed in the feedback; the rest is the observer's own",
        low=0.0,
        high=1.0,
    )
    jump_transient: JumpTransientParameters = group(JumpTransientParameters)


_SPEED, _DISTURBANCE = OWN, OWN + 1


@kernel
def _reject(
    speeds: Array,
    unexplained: Array,
    reference: Array,
    next_reference: Array,
    period: float,
    gains: Array,
    memory: Array,
    command: Array,
) -> None:
    """Write the answer of disturbance rejection, after an observer step.

    gains : k (1/s), l_1 (1), l_2 (1/s), b_0, shares of disturbance and speed, closing share and
        acceleration
    """
    input_gain, share, mix = gains[3], gains[4], gains[5]
    for i in range(2):
        if math.isnan(memory[PREDICTED_REFERENCE, i]):
            memory[_SPEED, i] = speeds[i]
        else:
            push = input_gain * memory[APPLIED, i] + memory[_DISTURBANCE, i]
            memory[_SPEED, i] += period * push
            surprise = speeds[i] - memory[_SPEED, i]
            memory[_SPEED, i] += gains[1] * surprise
            memory[_DISTURBANCE, i] += gains[2] * surprise
        error = disturbance_error(
            i, speeds, reference, period, input_gain, gains[6], gains[7], memory
        )
        error += (1.0 - mix) * (memory[_SPEED, i] - speeds[i])
        load = memory[_DISTURBANCE, i]
        load += share * (unexplained[i] - load)
        feedforward = (next_reference[i] - reference[i]) / period + memory[CLOSING, i]
        u = (feedforward - gains[0] * error - load) / input_gain
        write_acceleration(i, u, next_reference, memory, command)


def observer_gains(bandwidth: float, period: float) -> tuple[float, float]:
    r"""Return (l_1, l_2), in 1 and 1/s, that put both observer poles at beta = exp(-omega_o T).

    Prediction with the model, then correction by L times the surprise, makes the error of the
    estimate follow (I - L C) A with A = [[1, T], [0, 1]], whose trace is 2 - l_1 - l_2 T and
    whose determinant is 1 - l_1; hence l_1 = 1 - beta² and l_2 = (1 - beta)²/T
    (Miklosovic, Radke and Gao 2006).
    """
    beta = math.exp(-bandwidth * period)
    return 1.0 - beta**2, (1.0 - beta) ** 2 / period


class DisturbanceRejection(FeedbackBaseline):
    """Active disturbance rejection: u = (r' + v(h) - k e - f)/b_0 (Han 2009).

    All that is not b_0 u is one number f, which an extended state observer of
    chi' = b_0 u + f estimates from the speed and from the u that was really applied, so that it
    cannot wind up. Both observer poles are at one place (Gao 2003). v(h) is Han's arranged
    transient. doi 10.1109/TIE.2008.2011621.
    """

    parameters_type = DisturbanceRejectionParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        table = checked_parameters(parameters, DisturbanceRejectionParameters)
        super().__init__(nominal_model, table.jump_transient, own=2)
        self._gains: Array = np.array(
            [
                table.gain,
                *observer_gains(table.observer_bandwidth, nominal_model.period),
                table.input_gain,
                table.shared_disturbance,
                table.shared_speed,
                *self._closing,
            ]
        )

    @property
    def observed(self) -> Array:
        """The observer's own chi (rad/s) and f (rad/s²), shape (2, 2), a wheel a column."""
        observed: Array = self._memory[OWN:].copy()
        return observed

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        _reject(
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
