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
r"""Linear MPC with a disturbance estimate, with and without preview.

Each wheel follows its command c (velocity drive) or integrates its input u (torque drive):

.. math:: \chi_{j+1} = p\,\chi_j + (1-p)\,c_j + \ell (1-p)\,d_j, \quad p = e^{-T/\ell}
          \qquad\text{or}\qquad \chi_{j+1} = \chi_j + T (b\,u_j + d_j)

with the lag l or the gain b scaled by ``model_error``. The moves x, changes of c or u from one
period to the next, minimise

.. math:: \sum_{j=1}^{N} (\chi_j - r_j)^2 + \rho \sum_{j=0}^{N-1} x_j^2

subject to |x_j| <= a T (velocity) or to the torque limit of the motors (torque); the first move is
applied. The disturbance d is the shared estimate plus an integral of the prediction errors of the
model, which removes the offset of a wrong model (Pannocchia and Rawlings 2003,
doi 10.1002/aic.690490213). The horizon starts from the model's prediction, corrected towards the
shared estimate by an observer; this separates the feedback of noise from the tracking bandwidth.
Friction and turning along the reference are known of the nominal robot and enter as a measured
disturbance.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from t3mpc_ros.evaluation.baselines import predictive_baseline
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    NominalModel,
    Observation,
    WheelLoads,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class LinearMpcPreviewParameters(
    predictive_baseline.ObserverParameters, predictive_baseline.PredictiveParameters
):
    """Parameters of linear MPC with preview."""

    load_share: float = parameter(
        1.0,
        'share taken of what friction and turning of the nominal robot do along the reference',
        bounds=(0.0, 2.0),
    )


@dataclass(frozen=True)
class LinearMpcParameters(predictive_baseline.ExtrapolationParameters, LinearMpcPreviewParameters):
    """Parameters of linear MPC without preview."""


class LinearMpc(predictive_baseline.ObserverBaseline):
    """Linear MPC without preview: it extrapolates the reference by its slope."""

    parameters_type: ClassVar[type[Parameters]] = LinearMpcParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table = self.parameters
        n = table.horizon
        self._model = model = predictive_baseline.wheel_model(nominal_model, table.model_error)
        self._loads = WheelLoads(nominal_model, inertia_factor=table.model_error)
        self._decay = model.pole ** np.arange(1, n + 1)[:, np.newaxis]
        once = model.pole ** np.arange(n)
        # What a load, a held command and the moves of either wheel add to the next N speeds.
        self._by_load = predictive_baseline.response_matrix(model.give * once, n)
        steps = model.push * once if self._torque else np.cumsum(model.push * once)
        self._held: Array = (np.zeros(n) if self._torque else steps)[:, np.newaxis]
        self._by_move = predictive_baseline.response_matrix(steps, n)
        squares = self._by_move.T @ self._by_move + self._damping
        hessian = np.asarray(np.kron(self._units.T @ self._units, squares), dtype=np.float64)
        self._program = predictive_baseline.BoxProgram(hessian, self._reach)
        self._expected_speeds: Array | None = None
        """What the last horizon expects for now with no command."""

    @property
    def plan(self) -> Array:
        """The commands planned, c (rad/s) or u (rad/s²), shape (2, N), right wheel first."""
        planned: Array = self._units @ self._program.moves.reshape(2, -1)
        if not self._torque:
            planned[:, 0] = self._command
            planned = np.cumsum(planned, axis=1)
        return planned

    def advise(self, observation: Observation, before: Array, reference: Array) -> Array:
        """Return the best command, c (rad/s) or u (rad/s²)."""
        table, model = self.parameters, self._model
        loads = table.load_share * self._loads(reference)
        expected = self._expected_speeds
        if expected is not None:
            expected = expected + model.push * before
        speeds = self._correct(expected, observation.speeds, model.give)
        # The estimate holds the loads of now; those to come differ from them.
        steady = table.disturbance_share * (observation.unexplained - loads[0]) + self._integral
        self._expected_speeds = model.pole * speeds + model.give * (steady + loads[0])
        errors = self._decay * speeds + self._by_load @ (steady + loads[:-1]) - reference[1:]
        errors += self._held * before
        slopes = self._by_move.T @ errors
        slopes[0] -= self._first * before
        moves = self._program.solve((slopes @ self._units).T.ravel())
        first = self._units @ moves.reshape(2, -1)[:, 0]
        return first if self._torque else before + first


class LinearMpcPreview(LinearMpc):
    """Linear MPC with preview."""

    parameters_type: ClassVar[type[Parameters]] = LinearMpcPreviewParameters
    preview: ClassVar[bool] = True
