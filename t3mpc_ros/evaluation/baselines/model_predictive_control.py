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
r"""Model predictive control with a disturbance estimate: linear, and nonlinear by CasADi.

Linear: each wheel follows its command c (velocity drive) or integrates its input u (torque drive):

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

Nonlinear: the model is (10) with the nominal friction and with mass and inertia of the body scaled
by ``model_error``, driven by the servo of the velocity drive or by a torque:

.. math:: \bar\theta \dot\chi + \bar\eta(\chi)\chi + f(\chi)
          = \bar\theta_{nom}\,(c - \chi)/\ell \quad\text{or}\quad \bar\theta_{nom}\,u,

plus an additive acceleration, the disturbance estimate. Cost, bounds and observer are the same. A
period is integrated by an exponential Runge-Kutta method of second order (Cox and Matthews 2002,
doi 10.1006/jcph.2002.6995), which is exact in the stiff part, the servo.

It is solved by direct multiple shooting as real-time iterations (Diehl, Bock and Schlöder 2005,
doi 10.1137/S0363012902400713): the previous plan, shifted by a period, is linearised once (or
``iterations`` times), the states are eliminated, and the remaining Gauss-Newton program in the
moves is solved to optimality.
"""

from dataclasses import dataclass, replace
import importlib
from typing import Any, ClassVar

import numpy as np

from t3mpc_ros.evaluation.baselines import predictive_baseline
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    NominalModel,
    Observation,
    WheelLoads,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.simulation.plant.dynamics import BodyParameters, coriolis_factor, wheel_inertia


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


# -- nonlinear, by CasADi -------------------------------------------------------------------------


@dataclass(frozen=True)
class CasadiNmpcParameters(
    predictive_baseline.ObserverParameters, predictive_baseline.PredictiveParameters
):
    """Parameters of nonlinear MPC."""

    model_error: float = parameter(
        1.0,
        'mass and inertia of the body that the model believes in over the nominal ones',
        bounds=(0.1, 10.0),
    )
    horizon: int = parameter(40, 'N, periods looked ahead and free moves', bounds=(2, 100))
    iterations: int = parameter(1, 'linearisations per step', bounds=(1, 20))
    disturbance_share: float = parameter(
        0.3,
        'share taken of the part of the disturbance estimate that the model does not explain',
        bounds=(0.0, 2.0),
    )


def wheel_dynamics(nominal_model: NominalModel, model_error: float, casadi: Any) -> Any:
    """Return a CasADi function of one period: (chi, command, d) to (chi', d chi'/d chi, .../dc).

    All are columns for right and left wheel: rad/s; c in rad/s or u in rad/s²; d in rad/s². The
    derivatives are dense, 2 by 2.
    """
    robot, period = nominal_model.robot, nominal_model.period
    body = scaled_body(nominal_model, model_error)
    friction, geometry = robot.friction, robot.geometry
    nominal, true = wheel_inertia(robot.body, geometry), wheel_inertia(body, geometry)
    turn = 0.5 * geometry.wheel_radius / geometry.half_separation
    pull = coriolis_factor(body, geometry) * turn

    # Straight on and turning, (1, 1) and (1, -1), are eigenvectors of both inertias.
    modes = np.array([[0.5, 0.5], [0.5, -0.5]])
    inertias = np.array([true[0, 0] + true[0, 1], true[0, 0] - true[0, 1]])
    ratio = np.array([nominal[0, 0] + nominal[0, 1], nominal[0, 0] - nominal[0, 1]]) / inertias
    if nominal_model.drive == 'torque':
        keep, follow = np.ones(2), period * ratio
        once, twice = np.full(2, period), np.full(2, 0.5 * period)
    else:
        rate = ratio / nominal_model.lag
        keep = np.exp(-rate * period)
        follow = once = 1.0 - keep
        twice = (rate * period - once) / (rate**2 * period)
        once = once / rate

    chi, command, d = (casadi.SX.sym(name, 2) for name in ('chi', 'command', 'd'))

    def rest(speeds: Any) -> Any:
        """Return the acceleration that the drive does not make, in modes."""
        turning = pull * (speeds[0] - speeds[1])
        loads = friction.viscous * speeds + friction.coulomb * casadi.tanh(
            speeds / friction.coulomb_width
        )
        torque = casadi.vertcat(-turning * speeds[1], turning * speeds[0]) - loads
        return casadi.mtimes(modes, torque) / inertias + casadi.mtimes(modes, d)

    before = rest(chi)
    trial = keep * casadi.mtimes(modes, chi) + follow * casadi.mtimes(modes, command)
    trial = trial + once * before
    back = 2.0 * modes
    after = casadi.mtimes(back, trial + twice * (rest(casadi.mtimes(back, trial)) - before))
    slopes = [casadi.densify(casadi.jacobian(after, symbol)) for symbol in (chi, command)]
    return casadi.Function('wheels', [chi, command, d], [after, *slopes])


def scaled_body(nominal_model: NominalModel, factor: float) -> BodyParameters:
    """Return the nominal body with mass and inertia ``factor`` times as large."""
    body = nominal_model.robot.body
    return replace(
        body, body_mass=factor * body.body_mass, body_inertia=factor * body.body_inertia
    )


@kernel
def condense(by_speed: Array, push: Array, lasting: bool, response: Array, closing: Array) -> None:
    """Eliminate the states of the linearised horizon.

    by_speed : shape (N, 2, 2), derivative of the model at each period
    push : shape (N, 2, 2), speeds by each of the two unknowns of a period
    lasting : whether a change of the command lasts to the end of the horizon
    response : shape (2N, 2N), zeros, written: column 2j + m is what unknown m of period j adds to
        the speeds of periods 1 ... N, right and left in turn
    closing : shape (N, 2), the gaps from each guessed state to where the model leads; overwritten
        by what closing them adds to these speeds
    """
    for j in range(by_speed.shape[0]):
        slope = by_speed[j]
        for i in range(2):
            if j > 0:
                closing[j, i] += slope[i, 0] * closing[j - 1, 0] + slope[i, 1] * closing[j - 1, 1]
            for column in range(2 * j + 2):
                total = push[j, i, column % 2] if lasting or column >= 2 * j else 0.0
                if j > 0:
                    total += slope[i, 0] * response[2 * j - 2, column]
                    total += slope[i, 1] * response[2 * j - 1, column]
                response[2 * j + i, column] = total


class CasadiNmpc(predictive_baseline.ObserverBaseline):
    """Nonlinear MPC with preview; needs CasADi."""

    parameters_type: ClassVar[type[Parameters]] = CasadiNmpcParameters
    preview: ClassVar[bool] = True

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        casadi = importlib.import_module('casadi')
        table = self.parameters
        n = table.horizon
        self._loads = WheelLoads(nominal_model, scaled_body(nominal_model, table.model_error))
        # Here the unknowns of one period, right and left, stand next to each other.
        self._weights = np.kron(self._damping, self._units.T @ self._units)
        self._program = predictive_baseline.BoxProgram(self._weights + np.eye(2 * n), self._reach)
        self._give = nominal_model.period
        if not self._torque:
            self._give = nominal_model.share * nominal_model.lag
        self._speeds: Array | None = None
        """States guessed, shape (N + 1, 2)."""
        self._commands: Array = np.zeros((n, 2))
        self._by_command: Array = np.zeros((n, 2, 2))
        self._model = wheel_dynamics(nominal_model, table.model_error, casadi).map(n)

    @property
    def plan(self) -> Array:
        """The commands planned, c (rad/s) or u (rad/s²), shape (2, N), right wheel first."""
        return self._commands.T.copy()

    def advise(self, observation: Observation, before: Array, reference: Array) -> Array:
        """Return the best command, c (rad/s) or u (rad/s²)."""
        expected = None
        if self._speeds is not None:
            unlike = before - self._commands[0]
            expected = self._speeds[1] + self._by_command[0] @ unlike
        speeds = self._correct(expected, observation.speeds, self._give)
        unexplained = observation.unexplained - self._loads(speeds)
        loads = self._integral + self.parameters.disturbance_share * unexplained
        # The plan, shifted by a period.
        moves = self._program.moves.reshape(-1, 2)
        moves = np.vstack([moves[1:], moves[-1:] if self._torque else np.zeros((1, 2))])
        if self._speeds is None:
            self._speeds = np.tile(speeds, (len(reference), 1))
        self._speeds = np.vstack([speeds, self._speeds[2:], self._speeds[-1:]])
        self._commands = self._commanded(moves, before)
        for _ in range(self.parameters.iterations):
            moves = self._improve(moves.ravel(), loads, before, reference).reshape(-1, 2)
            self._commands = self._commanded(moves, before)
        return np.asarray(self._commands[0].copy())

    def _commanded(self, moves: Array, before: Array) -> Array:
        """Return the commands that the moves mean, shape (N, 2)."""
        changes: Array = moves @ self._units.T
        return changes if self._torque else np.cumsum(changes, axis=0) + before

    def _improve(self, moves: Array, loads: Array, before: Array, reference: Array) -> Array:
        """Return the best moves of the model linearised about the guess; renew the guess."""
        assert self._speeds is not None
        n = len(self._commands)
        held = np.repeat(loads[:, np.newaxis], n, axis=1)
        found = self._model(self._speeds[:-1].T, self._commands.T, held)
        reached = np.array(found[0]).T
        by_speed, self._by_command = (
            np.array(each).reshape(2, n, 2).transpose(1, 0, 2) for each in found[1:]
        )
        response, closing = np.zeros((2 * n, 2 * n)), reached - self._speeds[1:]
        push = self._by_command @ self._units
        condense(by_speed.copy(), push, not self._torque, response, closing)
        there = self._speeds[1:].ravel() + closing.ravel() - response @ moves
        slope = response.T @ (there - reference[1:].ravel())
        slope[:2] -= self._first * self._units.T @ before
        # In two parts: the threads of a larger product would compete with the other runs.
        upper, lower = response[:n], response[n:]
        squares = upper.T @ upper + lower.T @ lower
        best = self._program.solve(slope, squares + self._weights)
        self._speeds = np.vstack([self._speeds[:1], (there + response @ best).reshape(-1, 2)])
        return best
