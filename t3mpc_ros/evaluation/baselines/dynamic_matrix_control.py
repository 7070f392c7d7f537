# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
from t3mpc_ros.evaluation.baselines.linear_mpc import (
    MAX_ITERATIONS,
    WheelModel,
    known_future,
    load_acceleration,
    load_parameters,
    predict_reference,
    torque_units,
    wheel_model,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

Array = NDArray[np.float64]

SETTLED = 1e-4
"""Where a response ends: this share of its last value is left to come."""
MAX_RESPONSE_LENGTH = 1000
"""Most periods a response may take to settle."""


@dataclass(frozen=True)
class DynamicMatrixPreviewParameters(Parameters):
    """Parameters of dynamic matrix control with preview."""

    model_error: float = parameter(
        1.0, 'inertia that the model believes in over the nominal one', low=0.1, high=10.0
    )
    horizon: int = parameter(40, 'P, periods looked ahead', low=2, high=200)
    moves: int = parameter(
        40, 'M, moves planned; the command stays where they lead', low=1, high=200
    )
    move_time: float = parameter(
        0.01,
        'time over which it smooths, about; the move suppression is (move_time/T)²',
        unit='s',
        low=0.001,
        high=0.5,
    )
    bias_time: float = parameter(
        0.3,
        'time constant of the bias b; the least makes it the latest miss, as first published',
        unit='s',
        low=0.001,
        high=20.0,
    )
    disturbance_share: float = parameter(
        0.3, 'share of the shared disturbance estimate fed forward', low=0.01, high=2.0
    )
    load_share: float = parameter(
        1.0,
        'share compensated of what friction and turning of the nominal robot do at the reference',
        low=0.0,
        high=2.0,
    )
    inner_gain: float = parameter(
        30.0,
        'K0 of the loop around the wheel, torque drive only',
        unit='1/s',
        low=2.0,
        high=80.0,
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` when there are more moves than periods looked ahead."""
        if self.moves > self.horizon:
            raise ParameterError(
                f'moves must be at most horizon = {self.horizon}: got {self.moves}'
            )


@dataclass(frozen=True)
class DynamicMatrixParameters(DynamicMatrixPreviewParameters):
    """Parameters of dynamic matrix control without preview."""

    moves: int = parameter(
        12, 'M, moves planned; the command stays where they lead', low=1, high=200
    )
    slope_time: float = parameter(
        0.2,
        'time constant with which the slope of the reference is expected to die away',
        unit='s',
        low=0.002,
        high=10.0,
    )


class Responses(NamedTuple):
    """Step responses of a wheel 1, 2, ... periods after a unit step, until settled."""

    steps: Array
    """s_j, to the command c, (rad/s)/(rad/s)."""
    loads: Array
    """h_j, to an acceleration that acts on the wheel, (rad/s)/(rad/s²)."""


def identify_step_responses(model: WheelModel, inner_gain: float, least: int) -> Responses:
    """Return the step responses of a wheel from two simulations of ``model``.

    Parameters
    ----------
    model
        Wheel model.
    inner_gain
        K0 of the loop that is closed around it first, 1/s; 0 when it settles by itself.
    least
        At least so many periods are recorded.

    Raises
    ------
    ValueError
        The responses do not settle, because K0 is too high for the period or there is none.
    """
    runs: list[list[float]] = []
    for command, load in ((1.0, 0.0), (0.0, 1.0)):
        speed, run = 0.0, []
        for _ in range(MAX_RESPONSE_LENGTH):
            u = inner_gain * (command - speed) if inner_gain > 0.0 else command
            speed = model.pole * speed + model.push * u + model.give * load
            run.append(speed)
        runs.append(run)
    steps, loads = np.array(runs)
    last = 0
    settled = bool(np.isfinite(steps).all())
    if settled:
        away = np.flatnonzero(np.abs(steps - steps[-1]) > SETTLED * abs(steps[-1]))
        last = int(away[-1]) if away.size else 0
        settled = last < 0.9 * MAX_RESPONSE_LENGTH
    if not settled:
        raise ValueError(
            f'step response must settle within {MAX_RESPONSE_LENGTH} periods: '
            f'inner_gain is {inner_gain}'
        )
    length = max(least, last + 2)
    return Responses(steps[:length].copy(), loads[:length].copy())


class PlantModel(NamedTuple):
    """Model of the robot, read-only."""

    responses: Responses
    static: float
    """Steady speed (rad/s) by which a wheel misses its set point per rad/s² that acts on it."""
    gains: Array
    """Shape (3,): share of the disturbance, share of a miss that the bias takes in, share of the
    loads that is compensated."""
    friction: Array
    """Shape (3,), see :func:`t3mpc_ros.evaluation.baselines.linear_mpc.load_acceleration`."""
    dynamics: Array
    reach: float
    """Largest move that the drive follows, rad/s."""


class ControllerState(NamedTuple):
    """State between steps, one row or entry per wheel."""

    outputs: Array
    """Y_0 ... Y_(n-1), rad/s, shape (2, n)."""
    command: Array
    """c that Y knows of, rad/s, shape (2,)."""
    disturbance: Array
    """Disturbance that Y knows of, rad/s², shape (2,)."""
    bias: Array
    """b, rad/s, shape (2,)."""
    offset: Array
    """c less what was sent: what compensates the loads, rad/s, shape (2,)."""
    begun: Array
    """Shape (1,): 1 when there was a step before."""
    errors: Array
    """Working memory, shape (P,)."""


@kernel
def dmc_step(
    speeds: Array,
    unexplained: Array,
    sent: Array,
    reference: Array,
    plant: PlantModel,
    memory: ControllerState,
    wheels: tuple[Workspace, Workspace],
    out: Array,
) -> None:
    """Write the best command (rad/s) for either wheel into ``out``, shape (2,).

    speeds, unexplained : chi (rad/s) and d (rad/s²), shape (2,)
    sent : the limited command of the last period, rad/s, shape (2,)
    reference : shape (2, P + 1), see :func:`.linear_mpc.predict_reference`
    """
    steps, loads = plant.responses
    gains, errors = plant.gains, memory.errors
    here = load_acceleration(reference[0, 1], reference[1, 1], plant.friction, plant.dynamics)
    for z in range(2):
        space, ahead = wheels[z], memory.outputs[z]
        compensated = gains[2] * here[z]
        offset = plant.static * compensated
        if memory.begun[0] > 0.0:
            command = sent[z] + memory.offset[z]
            for j in range(ahead.size - 1):
                ahead[j] = ahead[j + 1]
            change = command - memory.command[z]
            for j in range(ahead.size):
                ahead[j] += steps[j] * change
        else:
            command = sent[z] + offset
            memory.offset[z] = offset
            ahead[:] = speeds[z]
        memory.command[z] = command
        # A disturbance that begins to act now is in the output one period later.
        change = gains[0] * (unexplained[z] - compensated) - memory.disturbance[z]
        memory.disturbance[z] += change
        for j in range(1, ahead.size):
            ahead[j] += loads[j - 1] * change
        memory.bias[z] += gains[1] * (speeds[z] - ahead[0] - memory.bias[z])
        for j in range(errors.size):
            errors[j] = ahead[j + 1] + memory.bias[z] - reference[z, j + 1]
        for i in range(space.slope.size):
            total = 0.0
            for j in range(i, errors.size):
                total += steps[j - i] * errors[j]
            space.slope[i] = total
        # What is sent moves by the first move less the change of the compensation.
        shifted = offset - memory.offset[z]
        space.low[0], space.high[0] = shifted - plant.reach, shifted + plant.reach
        memory.offset[z] = offset
        shift_plan(space.moves, 0.0)
        solve(space, MAX_ITERATIONS)
        change = min(max(space.moves[0] - shifted, -plant.reach), plant.reach)
        out[z] = sent[z] + change
    memory.begun[0] = 1.0


class DynamicMatrix(BaselineController):
    """Dynamic matrix control without preview: it extrapolates the reference by its slope.

    Raises
    ------
    ValueError
        With preview: a view without a future.
    """

    parameters_type: ClassVar[type[Parameters]] = DynamicMatrixParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        if type(parameters) is not self.parameters_type or not isinstance(
            parameters, DynamicMatrixPreviewParameters
        ):
            raise ValueError(
                f'parameters must be {self.parameters_type.__name__}: got {parameters!r}'
            )
        self.parameters = parameters
        self._knowledge = nominal_model
        self._inner_gain = parameters.inner_gain if nominal_model.drive == 'torque' else 0.0
        period, n = nominal_model.period, parameters.horizon
        model = wheel_model(nominal_model, parameters.model_error)
        self.responses = identify_step_responses(model, self._inner_gain, n + 1)
        """Step responses of the wheel model."""
        response = response_matrix(self.responses.steps[:n], parameters.moves)
        weight = (parameters.move_time / period) ** 2
        reach = nominal_model.acceleration * period
        if self._inner_gain and self.preview:
            # A set point that is planned ahead should not outrun the motors, going straight on.
            reach = float(torque_units(nominal_model)[0].sum()) * period
        self._wheels = (make_workspace(parameters.moves), make_workspace(parameters.moves))
        for space in self._wheels:
            space.hessian[:] = response.T @ response + weight * np.eye(parameters.moves)
            space.low[:], space.high[:] = -reach, reach
        self._fade = 1.0
        if isinstance(parameters, DynamicMatrixParameters):
            self._fade = math.exp(-period / parameters.slope_time)
        friction, dynamics = load_parameters(nominal_model, parameters.model_error)
        self._plant = PlantModel(
            responses=self.responses,
            static=float(self.responses.loads[-1]),
            gains=np.array(
                [
                    parameters.disturbance_share,
                    -math.expm1(-period / parameters.bias_time),
                    parameters.load_share,
                ]
            ),
            friction=friction,
            dynamics=dynamics,
            reach=reach,
        )
        self._memory = ControllerState(
            outputs=np.zeros((2, self.responses.steps.size)),
            command=np.zeros(2),
            disturbance=np.zeros(2),
            bias=np.zeros(2),
            offset=np.zeros(2),
            begun=np.zeros(1),
            errors=np.zeros(n),
        )
        self._reference = np.zeros((2, n + 1))
        self._answer = np.zeros(2)
        self._speeds = np.zeros(2)
        self._begun = False

    @property
    def bias(self) -> Array:
        """Prediction error of the model, b, rad/s, shape (2,)."""
        return self._memory.bias.copy()

    @property
    def plan(self) -> Array:
        """The planned changes of c, rad/s, shape (2, M), right wheel first."""
        return np.array([space.moves for space in self._wheels])

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        future = known_future(observation, self.preview)
        predict_reference(
            observation.reference, observation.next_reference, future, self._fade, self._reference
        )
        if self._inner_gain and not self._begun:
            self._answer[:] = observation.speeds
            self._begun = True
        dmc_step(
            observation.speeds,
            observation.unexplained,
            self._answer if self._inner_gain else observation.command,
            self._reference,
            self._plant,
            self._memory,
            self._wheels,
            self._answer,
        )
        if self._inner_gain:
            self._speeds[:] = observation.speeds
            u: Array = self._inner_gain * (self._answer - observation.speeds)
            return u
        return self._knowledge.acceleration_for(self._answer, observation.speeds)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Go on from the set point that would have made the u that was let through."""
        if self._inner_gain and limited:
            self._answer[:] = self._speeds + acceleration / self._inner_gain


class DynamicMatrixPreview(DynamicMatrix):
    """Dynamic matrix control with preview."""

    parameters_type: ClassVar[type[Parameters]] = DynamicMatrixPreviewParameters
    preview: ClassVar[bool] = True
