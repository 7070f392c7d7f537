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
"""Base of the predictive baselines: common parameters, wheel model, expected reference, program.

The quadratic programs have bounds on each move alone. They are solved by DAQP, as that of v_p in
:mod:`t3mpc_ros.mpc.quadratic_program`, but from the active bounds of the step before.
"""

from dataclasses import dataclass
import math
from typing import NamedTuple

import daqp
import numpy as np

from t3mpc_ros.evaluation.baselines.baseline_controller import (
    EXACT_INERTIA,
    FRICTION,
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia

TOLERANCES = {'primal_tol': 1e-12, 'dual_tol': 1e-12, 'eps_prox': 0.0}
"""The answer is exact to rounding for the bounds that are found active."""


@dataclass(frozen=True)
class PredictiveParameters(Parameters):
    """Parameters of every predictive baseline."""

    model_error: float = parameter(
        1.0, 'inertia that the model believes in over the nominal one', bounds=(0.1, 10.0)
    )
    horizon: int = parameter(40, 'N, periods looked ahead', bounds=(2, 200))
    move_time: float = parameter(
        0.01,
        'time over which it smooths, about; the weight of a move is (move_time/T)², but '
        '(move_time²/T)² where the moves are those of a torque',
        's',
        (0.001, 0.5),
    )
    disturbance_share: float = parameter(
        0.3, 'share taken of the shared disturbance estimate', bounds=(0.0, 2.0)
    )


@dataclass(frozen=True)
class ObserverParameters(Parameters):
    """Parameters of the observer of linear and nonlinear MPC."""

    integral_time: float = parameter(
        1.0,
        'time constant with which its own prediction errors become part of the disturbance',
        's',
        (0.02, 50.0),
    )
    filter_time: float = parameter(
        0.1,
        'time constant with which its own prediction of the speed is drawn to the estimate; the '
        'least takes the estimate as it is',
        's',
        (0.001, 5.0),
    )


@dataclass(frozen=True)
class ExtrapolationParameters(Parameters):
    """Parameter of the methods without preview."""

    slope_time: float = parameter(
        0.2,
        'time constant with which the slope of the reference is expected to die away',
        's',
        (0.002, 10.0),
    )


class WheelModel(NamedTuple):
    """One wheel as a first-order system: chi_(j+1) = pole chi_j + push command_j + give d_j."""

    pole: float
    push: float
    give: float


def wheel_model(nominal_model: NominalModel, model_error: float) -> WheelModel:
    """Return the response of a wheel to c (velocity drive) or u (torque drive) and a disturbance.

    model_error : inertia that is believed in over the nominal one; it makes the servo of the
        velocity drive slower, and what a torque drive's u achieves smaller.
    """
    if nominal_model.drive == 'torque':
        return WheelModel(1.0, nominal_model.period / model_error, nominal_model.period)
    lag = model_error * nominal_model.lag
    pole = math.exp(-nominal_model.period / lag)
    return WheelModel(pole, 1.0 - pole, lag * (1.0 - pole))


def torque_units(nominal_model: NominalModel) -> Array:
    """Return the u (rad/s²) of both wheels per torque, a torque being a share of its limit."""
    robot = nominal_model.robot
    inverse = np.linalg.inv(wheel_inertia(robot.body, robot.geometry))
    return np.asarray(robot.drive.torque_limit * inverse, dtype=np.float64)


def move_weight(nominal_model: NominalModel, move_time: float) -> float:
    """Return the weight rho that makes a plan smooth over about ``move_time`` (s).

    Without bounds and in the limit of a short period, the plan is the reference seen through a
    filter symmetric in time: of second order and width move_time for a lagging servo, of fourth
    order for an integrator.
    """
    if nominal_model.drive == 'torque':
        return (move_time**2 / nominal_model.period) ** 2
    return (move_time / nominal_model.period) ** 2


def response_matrix(steps: Array, moves: int) -> Array:
    """Return S, shape (N, moves): ``S[j, i]`` is what move i adds to the output after j + 1.

    steps : shape (N,), the output 1 ... N periods after a step of one in the command
    """
    rows, columns = np.indices((steps.size, moves))
    return np.where(rows >= columns, steps[np.maximum(rows - columns, 0)], 0.0)


def predict_reference(known: Array, fade: float, rows: int, *, preview: bool) -> Array:
    """Return the reference expected 0 ... N periods after the answer begins to act, rad/s.

    known : the first rows, shape (n, 2), n >= 2. With preview, in which they may contain jumps,
        they are continued by their last slope, or by the one before where that is flatter, so that
        a jump in the last row is not taken for a slope
    fade : share of the slope that is left after a period, beyond what is known
    rows : N + 1
    """
    missing = rows - len(known)
    if missing <= 0:
        return known[:rows]
    slope = known[-1] - known[-2]
    if preview and len(known) > 2:
        earlier = known[-2] - known[-3]
        flatter = np.where(np.abs(earlier) < np.abs(slope), earlier, slope)
        slope = np.where(slope * earlier <= 0.0, 0.0, flatter)
    fading = fade ** np.arange(1, missing + 1)
    return np.vstack([known, known[-1] + np.cumsum(np.outer(fading, slope), axis=0)])


class BoxProgram:
    """Quadratic program minimise x'Hx/2 + g'x subject to low <= x <= high, solved many times.

    H is positive definite, shape (n, n); ``reach`` is -low and high of every move.
    """

    def __init__(self, hessian: Array, reach: float) -> None:
        n = len(hessian)
        self.low, self.high = np.full(n, -reach), np.full(n, reach)
        self.moves: Array = np.zeros(n)
        """x of the last program that was solved."""
        self._model = daqp.Model()
        self._model.settings = TOLERANCES
        self._model.setup(hessian, np.zeros(n), np.zeros((0, n)), self.high, self.low)

    def solve(self, slope: Array, hessian: Array | None = None) -> Array:
        """Return x for another g, the present bounds, and another H if one is given.

        A program without an optimum, because something is not finite, leaves the last x.
        """
        if np.isfinite(slope).all():
            self._model.update(H=hessian, f=slope, bupper=self.high, blower=self.low)
            moves, _, status, _ = self._model.solve()
            if status > 0:
                self.moves = np.clip(moves, self.low, self.high)
        return self.moves


class PredictiveBaseline(BaselineController):
    """Base of methods that plan a command: c (velocity drive) or u (torque drive).

    A method without preview extrapolates the reference by its slope.
    """

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        factor = self.parameters.model_error
        self.known = (EXACT_INERTIA if factor == 1.0 else f'inertia × {factor:g}',)
        if getattr(parameters, 'load_share', 1.0):
            self.known += (FRICTION,)
        self._torque = nominal_model.drive == 'torque'
        slope_time = getattr(parameters, 'slope_time', math.inf)
        self._fade = math.exp(-nominal_model.period / slope_time)
        self._command: Array = np.zeros(2)
        """First command of the plan, or the u that the limits let through."""

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        before = self._command if self._torque else observation.command
        self._command = self.advise(observation, before, self._expected(observation))
        if self._torque:
            return self._command.copy()
        return self._nominal_model.acceleration_for(self._command, observation.speeds)

    def advise(self, observation: Observation, before: Array, reference: Array) -> Array:
        """Return the best command after ``before``, for a reference of shape (N + 1, 2)."""
        raise NotImplementedError

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Continue from the u after the limits."""
        if self._torque:
            self._command = acceleration.copy()

    def _expected(self, observation: Observation) -> Array:
        known = observation.future
        if not self.preview:
            known = np.stack([observation.reference, observation.next_reference])
        elif known is None:
            raise ValueError('future must be given to a method with preview: got None')
        rows = self.parameters.horizon + 1
        return predict_reference(known, self._fade, rows, preview=self.preview)


class ObserverBaseline(PredictiveBaseline):
    """Base of methods with an observer of the speeds and an integral of its prediction errors.

    The moves are changes of c, or with a torque drive torques of both motors as shares of their
    limit: the inertia couples the wheels.
    """

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table, period = self.parameters, nominal_model.period
        self._integral_share = -math.expm1(-period / table.integral_time)
        self._filter_share = -math.expm1(-period / table.filter_time)
        self._integral: Array = np.zeros(2)
        """Disturbance from its own prediction errors, rad/s², shape (2,)."""
        n, weight = table.horizon, move_weight(nominal_model, table.move_time)
        self._units: Array = torque_units(nominal_model) if self._torque else np.eye(2)
        """Shape (2, 2): the command per unknown of right and left wheel."""
        changes = np.eye(n) - np.eye(n, k=-1) if self._torque else np.eye(n)
        self._damping: Array = weight * changes.T @ changes
        """Weight of the moves of one wheel, shape (N, N)."""
        self._first = weight if self._torque else 0.0
        """Weight of the product of the first command and the one before it."""
        self._reach = 1.0 if self._torque else nominal_model.acceleration * period

    def _correct(self, expected: Array | None, speeds: Array, give: float) -> Array:
        """Return the speeds (rad/s) that the horizon starts from; update the integral.

        ``expected`` is None at the first step; ``give`` is the speed per disturbance.
        """
        if expected is None:
            return speeds.copy()
        missed = speeds - expected
        self._integral = self._integral + self._integral_share * missed / give
        return np.asarray(expected + self._filter_share * missed)
