# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.evaluation.baselines.box_qp import (
    Workspace,
    make_workspace,
    response_matrix,
    shift_plan,
    solve,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import dynamics_vector, wheel_acceleration, wheel_inertia

Array = NDArray[np.float64]

MAX_ITERATIONS = 1000
"""Cap on the steps of the solver; fewer than ten are usual."""


@dataclass(frozen=True)
class LinearMpcPreviewParameters(Parameters):
    """Parameters of linear MPC with preview."""

    model_error: float = parameter(
        1.0, 'inertia that the model believes in over the nominal one', low=0.1, high=10.0
    )
    horizon: int = parameter(40, 'N, periods looked ahead and free moves', low=2, high=200)
    move_time: float = parameter(
        0.01,
        'time over which it smooths, about; the weight rho of a move is (move_time/T)² with the '
        'velocity drive, and (move_time²/T)² with the torque drive',
        unit='s',
        low=0.001,
        high=0.5,
    )
    disturbance_share: float = parameter(
        0.3, 'share taken of the shared disturbance estimate', low=0.01, high=2.0
    )
    load_share: float = parameter(
        1.0,
        'share taken of what friction and turning of the nominal robot do along the reference',
        low=0.0,
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


@dataclass(frozen=True)
class LinearMpcParameters(LinearMpcPreviewParameters):
    """Parameters of linear MPC without preview."""

    slope_time: float = parameter(
        0.2,
        'time constant with which the slope of the reference is expected to die away',
        unit='s',
        low=0.002,
        high=10.0,
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


def load_parameters(nominal_model: NominalModel, model_error: float) -> tuple[Array, Array]:
    """Return friction (3,) and dynamics (5,) as :func:`load_acceleration` wants them."""
    robot = nominal_model.robot
    dynamics = dynamics_vector(robot.body, robot.geometry)
    # A heavier body is moved less by the same friction.
    dynamics[2:4] *= model_error
    friction = robot.friction
    return np.array([friction.viscous, friction.coulomb, friction.coulomb_width]), dynamics


def torque_units(nominal_model: NominalModel) -> Array:
    """Return the u (rad/s²) of both wheels per torque, a torque being a share of its limit."""
    robot = nominal_model.robot
    inverse = np.linalg.inv(wheel_inertia(robot.body, robot.geometry))
    return np.asarray(robot.drive.torque_limit * inverse, dtype=np.float64)


def known_future(observation: Observation, preview: bool) -> Array:
    """Return the known rows of the future, (n, 2), none without preview; or raise ValueError."""
    if not preview:
        return np.zeros((0, 2))
    if observation.future is None:
        raise ValueError('view.future must be given to a method with preview: got None')
    return np.array(observation.future, dtype=np.float64)


def move_weight(nominal_model: NominalModel, move_time: float) -> float:
    """Return the weight rho that makes a plan smooth over about ``move_time`` (s).

    Without bounds and in the limit of a short period, the plan is the reference seen through a
    filter symmetric in time: of second order and width move_time for a lagging servo, of fourth
    order for an integrator.
    """
    if nominal_model.drive == 'torque':
        return (move_time**2 / nominal_model.period) ** 2
    return (move_time / nominal_model.period) ** 2


@kernel
def predict_reference(
    reference: Array, next_reference: Array, future: Array, fade: float, out: Array
) -> None:
    """Write the reference expected 0 ... N periods after the answer begins to act, rad/s.

    reference, next_reference : shape (2,), rad/s; read where ``future`` has no rows
    future : shape (n, 2), rad/s. It is continued by its last slope, or by the one before where
        that is flatter, so that a jump in the last row is not taken for a slope.
    fade : share of the slope that is left after a period, beyond what is known
    out : shape (2, N + 1), overwritten
    """
    known = future.shape[0]
    for z in range(2):
        row = min(known, out.shape[1])
        for j in range(row):
            out[z, j] = future[j, z]
        if known == 0:
            out[z, 0], out[z, 1], row = reference[z], next_reference[z], 2
        slope = out[z, row - 1] - out[z, row - 2]
        if known > 2 and row == known:
            earlier = out[z, row - 2] - out[z, row - 3]
            if slope * earlier <= 0.0:
                slope = 0.0
            elif abs(earlier) < abs(slope):
                slope = earlier
        for j in range(row, out.shape[1]):
            slope *= fade
            out[z, j] = out[z, j - 1] + slope


@kernel
def load_acceleration(
    right: float, left: float, friction: Array, dynamics: Array
) -> tuple[float, float]:
    """Return what friction and turning do to the nominal wheels, rad/s², with no drive.

    right, left : wheel speeds, rad/s
    friction : shape (3,), viscous (N m s/rad), Coulomb (N m), width (rad/s)
    dynamics : shape (5,), see :func:`t3mpc_ros.simulation.plant.dynamics.dynamics_vector`
    """
    return wheel_acceleration(
        right,
        left,
        -friction_torque(right, friction[0], friction[1], friction[2]),
        -friction_torque(left, friction[0], friction[1], friction[2]),
        dynamics,
    )


class StepParameters(NamedTuple):
    """What a step of :func:`advise` needs besides its state; the arrays are only read."""

    model: WheelModel
    lasting: float
    """1 when the unknowns are moves of a command that is kept up (c), 0 when they act once (u)."""
    units: Array
    """Shape (2, 2): the command (c, rad/s; u, rad/s²) per unknown of right and left wheel."""
    first: float
    """Weight of the product of the first command and the one before it."""
    shares: Array
    """Shape (4,): of the shared disturbance estimate, of the loads, and of a prediction error
    what goes into the disturbance and into the speed (per period)."""
    friction: Array
    """Shape (3,), see :func:`load_acceleration`, as ``dynamics``."""
    dynamics: Array


class History(NamedTuple):
    """State between steps, one row or entry per wheel."""

    integral: Array
    """Disturbance from its own prediction errors, rad/s², shape (2,)."""
    speeds: Array
    """chi that the last horizon started from, rad/s, shape (2,)."""
    disturbance: Array
    """What was expected to act after it, rad/s², shape (2,)."""
    begun: Array
    """Shape (1,): 1 when there was a step before."""
    errors: Array
    """Working memory, shape (2, N + 1)."""


@kernel
def linear_mpc_step(
    speeds: Array,
    unexplained: Array,
    before: Array,
    reference: Array,
    tuning: StepParameters,
    past: History,
    space: Workspace,
    out: Array,
) -> None:
    """Write the best command (c, rad/s, or u, rad/s²) into ``out``, shape (2,).

    speeds, unexplained : chi (rad/s) and d (rad/s²), shape (2,)
    before : what was really commanded last, shape (2,), rad/s or rad/s²
    reference : shape (2, N + 1), see :func:`expect_reference`
    space : unknowns of the right wheel, then those of the left
    """
    (pole, push, give), lasting, units = tuning.model, tuning.lasting, tuning.units
    shares, errors = tuning.shares, past.errors
    n = reference.shape[1] - 1
    for j in range(n + 1):
        errors[0, j], errors[1, j] = load_acceleration(
            reference[0, j], reference[1, j], tuning.friction, tuning.dynamics
        )
    for z in range(2):
        speed = speeds[z]
        if past.begun[0] > 0.0:
            speed = pole * past.speeds[z] + push * before[z] + give * past.disturbance[z]
            missed = speeds[z] - speed
            past.integral[z] += shares[2] * missed / give
            speed += shares[3] * missed
        # The estimate holds the loads of now; those to come differ from them.
        steady = shares[0] * (unexplained[z] - shares[1] * errors[z, 0]) + past.integral[z]
        past.speeds[z] = speed
        past.disturbance[z] = steady + shares[1] * errors[z, 0]
        # Free response: ``errors`` turns from loads to chi - r of the next N periods.
        for j in range(n):
            load = steady + shares[1] * errors[z, j]
            speed = pole * speed + push * lasting * before[z] + give * load
            errors[z, j] = speed - reference[z, j + 1]
        # The slope by commands, by the adjoint recursion.
        adjoint, total = 0.0, 0.0
        for j in range(n - 1, -1, -1):
            adjoint = errors[z, j] + pole * adjoint
            total = push * adjoint + lasting * total
            errors[z, j] = total
        errors[z, 0] -= tuning.first * before[z]
        shift_plan(space.moves[z * n : z * n + n], 1.0 - lasting)
    past.begun[0] = 1.0
    for j in range(n):
        space.slope[j] = units[0, 0] * errors[0, j] + units[1, 0] * errors[1, j]
        space.slope[n + j] = units[0, 1] * errors[0, j] + units[1, 1] * errors[1, j]
    solve(space, MAX_ITERATIONS)
    for z in range(2):
        change = units[z, 0] * space.moves[0] + units[z, 1] * space.moves[n]
        out[z] = lasting * before[z] + change


class LinearMpc(BaselineController):
    """Linear MPC without preview: it extrapolates the reference by its slope."""

    parameters_type: ClassVar[type[Parameters]] = LinearMpcParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        if type(parameters) is not self.parameters_type or not isinstance(
            parameters, LinearMpcPreviewParameters
        ):
            raise ValueError(
                f'parameters must be {self.parameters_type.__name__}: got {parameters!r}'
            )
        self.parameters = parameters
        self._knowledge = nominal_model
        self._torque = nominal_model.drive == 'torque'
        n, weight = parameters.horizon, move_weight(nominal_model, parameters.move_time)
        model = wheel_model(nominal_model, parameters.model_error)
        friction, dynamics = load_parameters(nominal_model, parameters.model_error)
        steps: Array = model.push * np.float64(model.pole) ** np.arange(n)
        units: Array = np.eye(2)
        moves = np.eye(n)
        reach = nominal_model.acceleration * nominal_model.period
        if self._torque:
            # A motor bounds its torque, and the inertia couples the two: the unknowns are
            # torques, as shares of their limit.
            units, reach = torque_units(nominal_model), 1.0
            moves -= np.eye(n, k=-1)
        else:
            steps = np.cumsum(steps)
        response = response_matrix(steps, n)
        self._space = make_workspace(2 * n)
        self._space.hessian[:] = np.kron(
            units.T @ units, response.T @ response + weight * moves.T @ moves
        )
        self._space.low[:], self._space.high[:] = -reach, reach
        self._tuning = StepParameters(
            model=model,
            lasting=0.0 if self._torque else 1.0,
            units=units,
            first=weight if self._torque else 0.0,
            shares=np.array(
                [
                    parameters.disturbance_share,
                    parameters.load_share,
                    -math.expm1(-nominal_model.period / parameters.integral_time),
                    -math.expm1(-nominal_model.period / parameters.filter_time),
                ]
            ),
            friction=friction,
            dynamics=dynamics,
        )
        self._past = History(
            integral=np.zeros(2),
            speeds=np.zeros(2),
            disturbance=np.zeros(2),
            begun=np.zeros(1),
            errors=np.zeros((2, n + 1)),
        )
        self._fade = 1.0
        if isinstance(parameters, LinearMpcParameters):
            self._fade = math.exp(-nominal_model.period / parameters.slope_time)
        self._reference = np.zeros((2, n + 1))
        self._answer = np.zeros(2)

    @property
    def plan(self) -> Array:
        """The commands planned, c (rad/s) or u (rad/s²), shape (2, N), right wheel first."""
        planned: Array = self._tuning.units @ self._space.moves.reshape(2, -1)
        if not self._torque:
            planned[:, 0] = self._answer
            planned = np.cumsum(planned, axis=1)
        return planned

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        future = known_future(observation, self.preview)
        predict_reference(
            observation.reference, observation.next_reference, future, self._fade, self._reference
        )
        linear_mpc_step(
            observation.speeds,
            observation.unexplained,
            self._answer if self._torque else observation.command,
            self._reference,
            self._tuning,
            self._past,
            self._space,
            self._answer,
        )
        if self._torque:
            return self._answer.copy()
        return self._knowledge.acceleration_for(self._answer, observation.speeds)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Continue from the u after the limits."""
        if self._torque:
            self._answer[:] = acceleration


class LinearMpcPreview(LinearMpc):
    """Linear MPC with preview."""

    parameters_type: ClassVar[type[Parameters]] = LinearMpcPreviewParameters
    preview: ClassVar[bool] = True
