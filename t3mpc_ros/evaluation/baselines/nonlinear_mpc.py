# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Nonlinear MPC with preview; CasADi generates the model and its derivatives.

The model is (10) with the nominal friction and with mass and inertia of the body scaled by
``model_error``, driven by the servo of the velocity drive or by a torque:

.. math:: \bar\theta \dot\chi + \bar\eta(\chi)\chi + f(\chi)
          = \bar\theta_{nom}\,(c - \chi)/\ell \quad\text{or}\quad \bar\theta_{nom}\,u,

plus an additive acceleration, the disturbance estimate. Cost, bounds and observer are those of
:mod:`t3mpc_ros.evaluation.baselines.linear_mpc`. A period is integrated by an exponential
Runge-Kutta method of second order (Cox and Matthews 2002, doi 10.1006/jcph.2002.6995), which is
exact in the stiff part, the servo.

Solved by direct multiple shooting as real-time iterations (Diehl, Bock and Schlöder 2005,
doi 10.1137/S0363012902400713): the previous plan, shifted by a period, is linearised once (or
``iterations`` times), the states are eliminated, and the remaining Gauss-Newton program in the
moves is solved to optimality.
"""

from dataclasses import dataclass, replace
import importlib
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.evaluation.baselines.box_qp import Workspace, make_workspace, multiply, solve
from t3mpc_ros.evaluation.baselines.linear_mpc import (
    MAX_ITERATIONS,
    known_future,
    load_acceleration,
    move_weight,
    predict_reference,
    torque_units,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.simulation.plant.dynamics import (
    BodyParameters,
    coriolis_factor,
    dynamics_vector,
    wheel_inertia,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CasadiNmpcParameters(Parameters):
    """Parameters of nonlinear MPC."""

    model_error: float = parameter(
        1.0,
        'mass and inertia of the body that the model believes in over the nominal ones',
        low=0.1,
        high=10.0,
    )
    horizon: int = parameter(40, 'N, periods looked ahead and free moves', low=2, high=100)
    iterations: int = parameter(1, 'linearisations per step', low=1, high=20)
    move_time: float = parameter(
        0.01,
        'time over which it smooths, about; the weight rho of a move is (move_time/T)² with the '
        'velocity drive, and (move_time²/T)² with the torque drive',
        unit='s',
        low=0.001,
        high=0.5,
    )
    disturbance_share: float = parameter(
        0.3,
        'share taken of the part of the disturbance estimate that the model does not explain',
        low=0.01,
        high=2.0,
    )
    integral_time: float = parameter(
        1.0,
        'time constant with which its own prediction errors become part of the disturbance',
        unit='s',
        low=0.02,
        high=50.0,
    )
    filter_time: float = parameter(
        0.1,
        'time constant with which its own prediction of the speed is drawn to the estimate; the '
        'least takes the estimate as it is',
        unit='s',
        low=0.001,
        high=5.0,
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
def condense(
    speeds: Array,
    reached: Array,
    by_speed: Array,
    by_command: Array,
    reference: Array,
    units: Array,
    lasting: float,
    errors: Array,
    response: Array,
) -> None:
    """Eliminate the states: write errors and responses of the linearised horizon.

    speeds : shape (N + 1, 2), the states guessed
    reached : shape (N, 2), where the model gets from each in one period
    by_speed, by_command : shape (N, 2, 2), its derivatives; ``[j, k, i]`` is that of wheel i by
        entry k
    reference : shape (2, N + 1)
    units : shape (2, 2), change of the command by each of the two unknowns of a period
    lasting : 1 when a change of the command lasts to the end of the horizon, else 0
    errors : shape (2N,), overwritten: chi - r of periods 1 ... N, right and left in turn, where
        the linearised model leads with the guessed commands, the gaps between states closed
    response : shape (2N, 2N), overwritten below its diagonal blocks: column 2j + m is what
        unknown m of period j adds to the errors
    """
    n = reached.shape[0]
    right, left = 0.0, 0.0
    for j in range(n):
        slope = by_speed[j]
        right, left = (
            slope[0, 0] * right + slope[1, 0] * left + reached[j, 0] - speeds[j + 1, 0],
            slope[0, 1] * right + slope[1, 1] * left + reached[j, 1] - speeds[j + 1, 1],
        )
        errors[2 * j] = speeds[j + 1, 0] + right - reference[0, j + 1]
        errors[2 * j + 1] = speeds[j + 1, 1] + left - reference[1, j + 1]
    for first in range(n):
        for m in range(2):
            right, left = 0.0, 0.0
            for j in range(first, n):
                slope, push = by_speed[j], by_command[j]
                on = 1.0 if j == first else lasting
                c_right, c_left = on * units[0, m], on * units[1, m]
                right, left = (
                    slope[0, 0] * right
                    + slope[1, 0] * left
                    + push[0, 0] * c_right
                    + push[1, 0] * c_left,
                    slope[0, 1] * right
                    + slope[1, 1] * left
                    + push[0, 1] * c_right
                    + push[1, 1] * c_left,
                )
                response[2 * j, 2 * first + m] = right
                response[2 * j + 1, 2 * first + m] = left


@kernel
def solve_linearised(
    errors: Array, response: Array, damping: Array, first: Array, space: Workspace
) -> int:
    """Write the best moves of the linearised horizon, and the errors they lead to.

    errors, response : see :func:`condense`; the errors are changed in place
    damping : shape (2N, 2N), what the weight of the moves adds to the Hessian
    first : shape (2,), and to the slope of the first two, because of the command before
    space : its moves are the guess at which ``errors`` hold
    """
    n = space.slope.size
    hessian, slope, moves, guess = space.hessian, space.slope, space.moves, space.product
    slope[:] = 0.0
    for i in range(n):
        for k in range(i + 1):
            hessian[i, k] = 0.0
    for j in range(n):
        # Later moves than this period's do nothing to it.
        for i in range(2 * (j // 2) + 2):
            entry = response[j, i]
            slope[i] += entry * errors[j]
            for k in range(i + 1):
                hessian[i, k] += entry * response[j, k]
    for i in range(n):
        for k in range(i):
            hessian[k, i] = hessian[i, k]
    # The unknowns are the moves themselves, not what they differ from the guess.
    multiply(hessian, moves, guess)
    for i in range(n):
        slope[i] -= guess[i]
        for k in range(n):
            hessian[i, k] += damping[i, k]
    slope[0] += first[0]
    slope[1] += first[1]
    space.factored[0] = -1
    for j in range(n):
        for i in range(2 * (j // 2) + 2):
            errors[j] -= response[j, i] * moves[i]
    status = solve(space, MAX_ITERATIONS)
    for j in range(n):
        for i in range(2 * (j // 2) + 2):
            errors[j] += response[j, i] * moves[i]
    return status


class CasadiNmpc(BaselineController):
    """Nonlinear MPC with preview.

    Raises
    ------
    ModuleNotFoundError
        CasADi is not installed.
    """

    parameters_type: ClassVar[type[Parameters]] = CasadiNmpcParameters
    preview: ClassVar[bool] = True

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        if not isinstance(parameters, CasadiNmpcParameters):
            raise ValueError(f'parameters must be CasadiNmpcParameters: got {parameters!r}')
        casadi = importlib.import_module('casadi')
        self.parameters = parameters
        self._knowledge = nominal_model
        self._torque = nominal_model.drive == 'torque'
        robot, n = nominal_model.robot, parameters.horizon
        friction = robot.friction
        self._friction = np.array([friction.viscous, friction.coulomb, friction.coulomb_width])
        self._dynamics = dynamics_vector(
            scaled_body(nominal_model, parameters.model_error), robot.geometry
        )
        weight = move_weight(nominal_model, parameters.move_time)
        self._space = make_workspace(2 * n)
        if self._torque:
            # As in the linear one: unknowns are torques, shares of their limit.
            self._units = torque_units(nominal_model)
            changes = np.eye(n) - np.eye(n, k=-1)
            squares = np.kron(changes.T @ changes, self._units.T @ self._units)
            self._damping: Array = np.asarray(weight * squares, dtype=np.float64)
            reach = 1.0
        else:
            self._units = np.eye(2)
            self._damping = weight * np.eye(2 * n)
            reach = nominal_model.acceleration * nominal_model.period
        self._first: Array = weight * self._units if self._torque else np.zeros((2, 2))
        self._space.low[:], self._space.high[:] = -reach, reach

        self._speeds = np.zeros((n + 1, 2))
        self._commands = np.zeros((n, 2))
        self._loads = np.zeros((n, 2))
        self._reached = np.zeros((n, 2))
        self._by_speed = np.zeros((n, 2, 2))
        self._by_command = np.zeros((n, 2, 2))
        self._function = wheel_dynamics(nominal_model, parameters.model_error, casadi).map(n)
        self._buffer, self._evaluate = self._function.buffer()
        for i, array in enumerate((self._speeds[:n], self._commands, self._loads)):
            self._buffer.set_arg(i, array.reshape(-1).data)
        for i, array in enumerate((self._reached, self._by_speed, self._by_command)):
            self._buffer.set_res(i, array.reshape(-1).data)

        self._reference = np.zeros((2, n + 1))
        self._errors = np.zeros(2 * n)
        self._response = np.zeros((2 * n, 2 * n))
        self._integral = np.zeros(2)
        self._shares = tuple(
            -math.expm1(-nominal_model.period / time)
            for time in (parameters.integral_time, parameters.filter_time)
        )
        self._give = nominal_model.period
        if not self._torque:
            self._give = nominal_model.share * nominal_model.lag
        self._answer = np.zeros(2)
        self._begun = False

    @property
    def plan(self) -> Array:
        """The commands planned, c (rad/s) or u (rad/s²), shape (2, N), right wheel first."""
        planned: Array = self._commands.T.copy()
        return planned

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        future = known_future(observation, self.preview)
        predict_reference(
            observation.reference, observation.next_reference, future, 1.0, self._reference
        )
        before = self._answer if self._torque else observation.command
        speeds = self._learn(observation, before)
        moves = self._space.moves
        moves[:-2] = moves[2:]
        if not self._torque:
            moves[-2:] = 0.0
        self._speeds[:-1] = self._speeds[1:]
        if not self._begun:
            self._speeds[:] = speeds
            self._begun = True
        self._speeds[0] = speeds
        np.clip(moves, self._space.low, self._space.high, out=moves)
        self._command(before)
        for _ in range(self.parameters.iterations):
            self._iterate(before)
        self._answer[:] = self._commands[0]
        if self._torque:
            return self._answer.copy()
        return self._knowledge.acceleration_for(self._answer, observation.speeds)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Continue from the u after the limits."""
        if self._torque:
            self._answer[:] = acceleration

    def _learn(self, observation: Observation, before: Array) -> Array:
        """Update the disturbance and return the initial speeds of the horizon, rad/s."""
        speeds = observation.speeds
        if self._begun:
            unlike = before - self._commands[0]
            expected = self._speeds[1] + unlike @ self._by_command[0]
            missed = observation.speeds - expected
            self._integral += self._shares[0] * missed / self._give
            speeds = expected + self._shares[1] * missed
        explained = load_acceleration(
            float(speeds[0]), float(speeds[1]), self._friction, self._dynamics
        )
        share = self.parameters.disturbance_share
        self._loads[:] = self._integral + share * (observation.unexplained - explained)
        return speeds

    def _command(self, before: Array) -> None:
        """Write the commands that the moves mean."""
        changes = self._space.moves.reshape(-1, 2) @ self._units.T
        if self._torque:
            self._commands[:] = changes
        else:
            np.cumsum(changes, axis=0, out=self._commands)
            self._commands += before

    def _iterate(self, before: Array) -> None:
        """Linearise about the guess, solve for the moves, and take where they lead as guess."""
        errors, response = self._errors, self._response
        self._evaluate()
        condense(
            self._speeds,
            self._reached,
            self._by_speed,
            self._by_command,
            self._reference,
            self._units,
            0.0 if self._torque else 1.0,
            errors,
            response,
        )
        first: Array = -self._first @ before
        solve_linearised(errors, response, self._damping, first, self._space)
        self._speeds[1:] = errors.reshape(-1, 2) + self._reference[:, 1:].T
        self._command(before)
