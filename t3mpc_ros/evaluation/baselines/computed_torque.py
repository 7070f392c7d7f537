# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Computed torque control with the nominal dynamics and friction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feedback_baseline import (
    CLOSING,
    OWN,
    TRANSIENT,
    FeedbackBaseline,
    JumpTransientParameters,
    checked_parameters,
    disturbance_error,
    write_acceleration,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, group, parameter
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import dynamics_vector, wheel_acceleration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ComputedTorqueParameters(Parameters):
    """Gains of computed torque, and where and how far its model is believed."""

    gain: float = parameter(30.0, 'feedback K on the error', unit='1/s', low=0.5, high=100.0)
    integral: float = parameter(
        20.0,
        'integral gain, for what the model does not know',
        unit='1/s²',
        low=0.1,
        high=5000.0,
    )
    belief: float = parameter(
        1.0, "share of the model's forces that is cancelled", low=0.0, high=1.5
    )
    measured: float = parameter(
        0.5,
        'where the model is evaluated: 1 at the estimated speeds, which are noisy, 0 at the '
        'followed ones r + h, which the wheels may not have',
        low=0.0,
        high=1.0,
    )
    jump_transient: JumpTransientParameters = group(JumpTransientParameters)


@kernel
def _cancel(
    speeds: Array,
    reference: Array,
    next_reference: Array,
    period: float,
    gains: Array,
    dynamics: Array,
    friction: Array,
    memory: Array,
    command: Array,
) -> None:
    """Write the answer of computed torque.

    gains : K (1/s), K_i (1/s²), what one rad/s² of the model is worth, share measured, closing
        share and acceleration
    dynamics : shape (5,), see ``robot.dynamics.dynamics_vector``
    friction : shape (3,), viscous (N m s/rad), Coulomb (N m), width (rad/s)
    """
    for i in range(2):
        error = disturbance_error(i, speeds, reference, period, 1.0, gains[4], gains[5], memory)
        memory[OWN, i] += period * gains[1] * error
        feedforward = (next_reference[i] - reference[i]) / period + memory[CLOSING, i]
        # u without the model, and the speed at which to evaluate it.
        command[i] = feedforward - gains[0] * error - memory[OWN, i]
        memory[OWN + 1, i] = reference[i] + memory[TRANSIENT, i] + gains[3] * error
    right, left = memory[OWN + 1, 0], memory[OWN + 1, 1]
    force_right, force_left = wheel_acceleration(
        right,
        left,
        -friction_torque(right, friction[0], friction[1], friction[2]),
        -friction_torque(left, friction[0], friction[1], friction[2]),
        dynamics,
    )
    write_acceleration(0, command[0] - gains[2] * force_right, next_reference, memory, command)
    write_acceleration(1, command[1] - gains[2] * force_left, next_reference, memory, command)


class ComputedTorque(FeedbackBaseline):
    """Computed torque of the nominal robot: u = r' + v(h) - K e - I - m(chi).

    m is what (10) of the nominal robot leaves of chi' - u when u is applied as the torque
    theta_bar u: theta_bar^-1 (-eta_bar chi - f(chi)), with viscous and Coulomb friction. A servo
    with lag tau holds against it within the period: the speed then changes by
    tau (1 - exp(-T/tau)) m instead of T m, so that much less is to be cancelled. On the nominal
    robot the error decays as (1 - K T)^k (without the integral, which is for the rest).
    """

    parameters_type = ComputedTorqueParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        table = checked_parameters(parameters, ComputedTorqueParameters)
        super().__init__(nominal_model, table.jump_transient, own=2)
        robot = nominal_model.robot
        felt = 1.0
        if nominal_model.drive == 'velocity':
            felt = nominal_model.lag * nominal_model.share / nominal_model.period
        self._gains: Array = np.array(
            [
                table.gain,
                table.integral,
                table.belief * felt,
                table.measured,
                *self._closing,
            ]
        )
        self._dynamics = dynamics_vector(robot.body, robot.geometry)
        friction = robot.friction
        self._friction: Array = np.array(
            [friction.viscous, friction.coulomb, friction.coulomb_width]
        )

    @property
    def integral(self) -> Array:
        """I, what is opposed beyond the model, rad/s², shape (2,)."""
        integral: Array = self._memory[OWN].copy()
        return integral

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        _cancel(
            observation.speeds,
            observation.reference,
            observation.next_reference,
            self._period,
            self._gains,
            self._dynamics,
            self._friction,
            self._memory,
            self._command,
        )
        return self._command
