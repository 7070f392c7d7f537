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
r"""Dynamic matrix control, with and without preview.

Cutler and Ramaker (1980), Dynamic matrix control: a computer control algorithm, Joint Automatic
Control Conference, paper WP5-B; with bounds on the moves as in Garcia and Morshedi (1986,
doi 10.1080/00986448608911397). The model consists of the step response s_j of the wheel speed to
the command and its response h_j to a unit disturbance:

.. math:: \hat\chi_{k+j} = Y_j + b + \sum_{i=0}^{\min(j, M) - 1} s_{j-i}\, x_i, \quad j = 1 ... P

Y is the remaining effect of past moves and known disturbances. The bias b, constant over the
horizon, is the prediction error of the model (a constant output disturbance). The moves x minimise
the squared distance of the prediction from the reference plus a weight times their squares (move
suppression), |x_i| <= a T; the first move is applied.

The bounds apply to the command that is sent. It is c less a static feed-forward of the nominal
friction and turning at the next reference speeds. A torque drive integrates, and an integrator has
no finite step response. As in practice, a proportional loop around the wheel, u = K0 (c - chi),
comes first, and the method moves its set point c; the servo of the velocity drive already is such
a loop.
"""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from t3mpc_ros.evaluation.baselines import predictive_baseline
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    NominalModel,
    Observation,
    WheelLoads,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter, with_default

SETTLED = 1e-4
"""Where a response ends: this share of its last value is left to come."""
MAX_RESPONSE_LENGTH = 1000
"""Most periods a response may take to settle."""


@dataclass(frozen=True)
class DynamicMatrixPreviewParameters(predictive_baseline.PredictiveParameters):
    """Parameters of dynamic matrix control with preview."""

    moves: int = parameter(
        40, 'M, moves planned; the command stays where they lead', bounds=(1, 200)
    )
    bias_time: float = parameter(
        0.3,
        'time constant of the bias b; the least makes it the latest miss, as first published',
        's',
        (0.001, 20.0),
    )
    load_share: float = parameter(
        1.0,
        'share compensated of what friction and turning of the nominal robot do at the reference',
        bounds=(0.0, 2.0),
    )
    inner_gain: float = parameter(
        30.0, 'K0 of the loop around the wheel, torque drive only', '1/s', (2.0, 80.0)
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` when there are more moves than periods looked ahead."""
        if self.moves > self.horizon:
            raise ParameterError(
                f'moves must be at most horizon = {self.horizon}: got {self.moves}'
            )


@dataclass(frozen=True)
class DynamicMatrixParameters(
    predictive_baseline.ExtrapolationParameters, DynamicMatrixPreviewParameters
):
    """Parameters of dynamic matrix control without preview."""

    moves: int = with_default(DynamicMatrixPreviewParameters, 'moves', 12)


def identify_step_responses(
    model: predictive_baseline.WheelModel, inner_gain: float, least: int
) -> tuple[Array, Array]:
    """Return the step responses of a wheel from two simulations of ``model``, until settled.

    s_j, to the command c, (rad/s)/(rad/s), and h_j, to an acceleration that acts on the wheel,
    (rad/s)/(rad/s²), 1, 2, ... periods after a unit step. ``inner_gain`` is K0 of the loop that is
    closed around it first, 1/s, 0 when it settles by itself; at least ``least`` periods.
    """
    responses = np.empty((2, MAX_RESPONSE_LENGTH))
    for response, (command, load) in zip(responses, ((1.0, 0.0), (0.0, 1.0)), strict=True):
        speed = 0.0
        for k in range(MAX_RESPONSE_LENGTH):
            u = inner_gain * (command - speed) if inner_gain > 0.0 else command
            response[k] = speed = model.pole * speed + model.push * u + model.give * load
    steps, loads = responses
    last = MAX_RESPONSE_LENGTH
    if np.isfinite(steps).all():
        away = np.flatnonzero(np.abs(steps - steps[-1]) > SETTLED * abs(steps[-1]))
        last = int(away[-1]) if away.size else 0
    if last >= 0.9 * MAX_RESPONSE_LENGTH:
        raise ValueError(
            f'step response must settle within {MAX_RESPONSE_LENGTH} periods: '
            f'inner_gain is {inner_gain}'
        )
    length = max(least, last + 2)
    return steps[:length].copy(), loads[:length].copy()


class DynamicMatrix(predictive_baseline.PredictiveBaseline):
    """Dynamic matrix control without preview: it extrapolates the reference by its slope."""

    parameters_type: ClassVar[type[Parameters]] = DynamicMatrixParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table, period = self.parameters, nominal_model.period
        self._inner_gain = table.inner_gain if self._torque else 0.0
        model = predictive_baseline.wheel_model(nominal_model, table.model_error)
        n = table.horizon
        self.responses = identify_step_responses(model, self._inner_gain, n + 1)
        """Step responses of the wheel model."""
        steps, loads = self.responses
        self._static = float(loads[-1])
        """Steady speed (rad/s) by which a wheel misses its set point per rad/s² on it."""
        self._response = predictive_baseline.response_matrix(steps[:n], table.moves)
        weight = (table.move_time / period) ** 2
        self._reach = nominal_model.acceleration * period
        if self._inner_gain and self.preview:
            # A set point that is planned ahead should not outrun the motors, going straight on.
            self._reach = float(predictive_baseline.torque_units(nominal_model)[0].sum()) * period
        hessian = self._response.T @ self._response + weight * np.eye(table.moves)
        self._wheels = [predictive_baseline.BoxProgram(hessian, self._reach) for _ in range(2)]
        self._loads = WheelLoads(nominal_model, inertia_factor=table.model_error)
        self._bias_share = -math.expm1(-period / table.bias_time)
        self._outputs: Array | None = None
        """Y_0 ... Y_(n-1), rad/s, shape (n, 2)."""
        self._known_command: Array = np.zeros(2)
        """c that Y knows of, rad/s."""
        self._disturbance: Array = np.zeros(2)
        """Disturbance that Y knows of, rad/s²."""
        self.bias: Array = np.zeros(2)
        """Prediction error of the model, b, rad/s, shape (2,)."""
        self._offset: Array = np.zeros(2)
        """c less what was sent: what compensates the loads, rad/s."""

    @property
    def plan(self) -> Array:
        """The planned changes of c, rad/s, shape (2, M), right wheel first."""
        return np.array([program.moves for program in self._wheels])

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        if not self._inner_gain:
            return super().step(observation)
        self._speeds = observation.speeds.copy()
        if self._outputs is None:
            self._command = self._speeds
        self._command = self.advise(observation, self._command, self._expected(observation))
        return np.asarray(self._inner_gain * (self._command - self._speeds))

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Go on from the set point that would have made the u that was let through."""
        if self._inner_gain and limited:
            self._command = self._speeds + acceleration / self._inner_gain

    def advise(self, observation: Observation, before: Array, reference: Array) -> Array:
        """Return the best command after the limited one of the last period, rad/s."""
        table, (steps, loads) = self.parameters, self.responses
        compensated = table.load_share * self._loads(reference[1])
        offset = self._static * compensated
        if self._outputs is None:
            self._offset = offset
            self._known_command = before + offset
            ahead = np.tile(observation.speeds, (steps.size, 1))
        else:
            command = before + self._offset
            ahead = np.vstack([self._outputs[1:], self._outputs[-1:]])
            ahead += np.outer(steps, command - self._known_command)
            self._known_command = command
        # A disturbance that begins to act now is in the output one period later.
        change = table.disturbance_share * (observation.unexplained - compensated)
        change -= self._disturbance
        self._disturbance = self._disturbance + change
        ahead[1:] += np.outer(loads[:-1], change)
        self._outputs = ahead
        self.bias = self.bias + self._bias_share * (observation.speeds - ahead[0] - self.bias)
        errors = ahead[1 : len(reference)] + self.bias - reference[1:]
        slopes = self._response.T @ errors
        # What is sent moves by the first move less the change of the compensation.
        shifted = offset - self._offset
        self._offset = offset
        first = np.empty(2)
        for z, program in enumerate(self._wheels):
            program.low[0], program.high[0] = shifted[z] - self._reach, shifted[z] + self._reach
            first[z] = program.solve(slopes[:, z].copy())[0]
        return np.asarray(before + np.clip(first - shifted, -self._reach, self._reach))


class DynamicMatrixPreview(DynamicMatrix):
    """Dynamic matrix control with preview."""

    parameters_type: ClassVar[type[Parameters]] = DynamicMatrixPreviewParameters
    preview: ClassVar[bool] = True
