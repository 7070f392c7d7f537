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
r"""Drivetrain: two stepper motors, two tyres and the body in one set of equations.

The rotors turn with chi (rad/s); the ground passes below the wheels with psi, the speeds that
rolling wheels would have, (1) inverted. A rolling tyre has chi = psi; a sliding one pushes with
its full grip:

.. math:: \bar\theta_b \dot\psi + \bar\eta \psi = R F + Q, \qquad
          I_i \dot\chi_i = \tau_i - f(\chi_i) - \tau_{d,i} - R F_i, \qquad |F_i| \le \mu N_i

with theta_bar_b the matrix (11) without the wheels' own inertia and Q the force of a wall. Where
both tyres roll, the sum of the two is (10). A rotor whose wheel is g times as large as the nominal
one turns with chi/g: with I_i/g² and torques divided by g the equations are the same. Not
modelled: sliding sideways, and load transfer between the wheels.
"""

from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.obstacles import Obstacles
from t3mpc_ros.geometry.types import Array, Pose, WheelSpeeds, wrap_angle
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.robot.command_limiter import ramp_towards
from t3mpc_ros.simulation.plant.bumper_contact import Bumper, BumperParameters, contact_force
from t3mpc_ros.simulation.plant.disturbances import (
    Disturbance,
    DisturbanceSignals,
    FrictionConstants,
    FrictionParameters,
    disturbance_torque,
    friction_constants,
    friction_torque,
)
from t3mpc_ros.simulation.plant.dynamics import BodyParameters, coriolis_factor, wheel_inertia
from t3mpc_ros.simulation.plant.stepper_motor import (
    StepperMotor,
    StepperMotorParameters,
    pull_out_torque,
    rotor_torque,
)
from t3mpc_ros.simulation.sensors.imu import low_pass
from t3mpc_ros.simulation.world import World, clearance, grip_at

Integers = npt.NDArray[np.int64]

_NO_OBSTACLES = Obstacles(np.zeros((0, 4)), np.zeros((0, 3)))
ROLLING = 0
"""Mode of a rolling tyre; +1 and -1: it slides and pushes the body in that direction."""
GRAVITY = 9.81  # m/s²
BLOCKED_INERTIA = 1e9  # inertia (kg m²) of a blocked wheel: large enough to be immovable


@dataclass(frozen=True)
class TyreParameters(Parameters):
    """Grip of the tyres."""

    grip: float = parameter(
        0.6, 'coefficient of friction between tyre and floor', bounds=(0.0, 5.0), dynamic=True
    )
    load_share: ClassVar[float] = 0.8
    """Part of the weight on the driven axle, assumed; the rest is on the caster."""


class Load(NamedTuple):
    """Body, friction and tyres that the motors move."""

    body: BodyParameters
    geometry: WheelGeometry
    friction: FrictionParameters
    friction_factor: float
    tyres: TyreParameters
    grip_factor: float
    blocked: tuple[bool, bool]  # blocked wheels, right first
    radius_multipliers: tuple[float, float] = (1.0, 1.0)
    """True wheel radii over the nominal one, right first."""


class PulseTarget(NamedTuple):
    """Target of the pulse generator."""

    right: float  # pulses/s
    left: float
    reach: float  # largest change of a rate, pulses/s²
    volts: float
    """Supply; 0 = no power, the rotors turn freely."""


class Drivetrain:
    """Motors, tyres and body: the arrays of :func:`integrate_drivetrain`, and their meaning.

    ``step`` in s; ``share`` of the IMU filter: see ``SimulatedImuParameters.share``.
    """

    def __init__(
        self,
        motor: StepperMotorParameters,
        bumper: BumperParameters,
        world: World,
        step: float,
        share: float,
    ) -> None:
        self.step = step
        self.steps_done = 0  # integration steps since the start: the time base of the disturbances
        self._microstep = motor.microstep
        self._cycle = 2.0 * math.pi / motor.teeth
        self._bumper = bumper
        self._radius = bumper.radius
        self.world = world  # replaceable: its obstacles may move
        self._share = share
        self._arrays = DrivetrainArrays(
            state=np.zeros(9),
            modes=np.zeros(2, dtype=np.int64),
            field=np.zeros(6),
            filtered=np.zeros((3, 2)),
            totals=np.zeros(4),
            work=np.zeros((4, 9)),
        )
        self._state, self._modes, self._field = self._arrays[:3]
        self.filtered = self._arrays.filtered
        """Both stages of the IMU filter for yaw rate, forward and sideways acceleration."""
        self._integrate_steps = TypedKernel(integrate_drivetrain)
        self._blocked = (False, False)
        self._multipliers = (1.0, 1.0)
        self._read()

    # -- state ------------------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """True pose."""
        return Pose(self._now[0], self._now[1], self._now[2])

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._state[:3] = pose.x, pose.y, wrap_angle(pose.yaw)
        self._read()

    @property
    def wheels(self) -> WheelSpeeds:
        """Speeds of the rotors, chi."""
        right, left = self._multipliers
        return WheelSpeeds(self._now[5] / right, self._now[6] / left)

    @property
    def ground(self) -> WheelSpeeds:
        """Speeds that rolling wheels would have, psi: the true motion of the body."""
        return WheelSpeeds(self._now[7], self._now[8])

    @property
    def counters(self) -> tuple[int, int]:
        """Pulses issued since the start of the board, right first."""
        return math.floor(self._pulses[0]), math.floor(self._pulses[1])

    @property
    def phases(self) -> tuple[float, float]:
        """Pulses since the start of the board, with the fraction of the next, right first."""
        return self._pulses[0], self._pulses[1]

    @property
    def pulse_speeds(self) -> WheelSpeeds:
        """Speeds of the fields, rad/s."""
        return WheelSpeeds(self._pulses[2] * self._microstep, self._pulses[3] * self._microstep)

    @property
    def load_angles(self) -> tuple[float, float]:
        """Angles (rad) of the fields ahead of the rotors, lost pitches included."""
        state, field = self._now, self._pulses
        right, left = self._multipliers
        return (
            field[4] + self._microstep * math.floor(field[0]) - state[3] / right,
            field[5] + self._microstep * math.floor(field[1]) - state[4] / left,
        )

    @property
    def lost_steps(self) -> tuple[int, int]:
        """Full steps of the rotors behind their fields, a multiple of four."""
        right, left = self.load_angles
        return 4 * round(right / self._cycle), 4 * round(left / self._cycle)

    @property
    def slid(self) -> tuple[float, float]:
        """Distance (m) slid by each tyre so far."""
        right, left = self._arrays.totals[:2].tolist()
        return right, left

    @property
    def field_work(self) -> float:
        """Work (J) done by the turning fields on the rotors so far."""
        return float(self._arrays.totals[2])

    @property
    def max_contact_force(self) -> float:
        """Largest contact force (N) of a wall so far."""
        return float(self._arrays.totals[3])

    # -- inputs -----------------------------------------------------------------------------------

    def load(self, motor: StepperMotorParameters, load: Load) -> None:
        """Set motor and load from now on."""
        body = load.body
        self._constants = DrivetrainConstants(
            body_constants(body, load.geometry),
            friction_constants(load.friction, load.friction_factor),
            self._bumper.constants(),
            motor.constants(),
            motor.microstep,
            self._share,
            self.step,
            *load.radius_multipliers,
        )
        weight = GRAVITY * body.total_mass * load.tyres.load_share
        self._grip = 0.5 * load.tyres.grip * weight * load.grip_factor
        own = body.wheel_inertia + motor.rotor_inertia
        self._multipliers = right, left = load.radius_multipliers
        self._tyres: Array = np.array([own / right**2, own / left**2, self._grip, self._grip])
        for wheel, (was, now) in enumerate(zip(self._blocked, load.blocked, strict=True)):
            if now:
                self._tyres[wheel] = BLOCKED_INERTIA
            if now and not was:
                self._block(wheel)
        self._blocked = load.blocked

    def restart_board(self) -> None:
        """Reset the pulse generator to zero, as after a power loss.

        The field of the driver starts in its home position; a rotor moves to the nearest one.
        """
        for wheel in (0, 1):
            rotor = float(self._state[3 + wheel]) / self._multipliers[wheel]
            cycles = round(rotor / self._cycle)
            self._field[wheel] = 0.0
            self._field[2 + wheel] = 0.0
            self._field[4 + wheel] = cycles * self._cycle
        self._read()

    def run(
        self,
        wheels: WheelSpeeds,
        acceleration: float,
        volts: float,
        disturbance: Disturbance,
        count: int,
    ) -> None:
        """Integrate ``count`` steps while the pulse generator ramps to ``wheels`` (rad/s).

        The ramp is linear and ends with the last step, or is limited by ``acceleration`` (rad/s²,
        0 = no limit); at zero ``volts`` the motors have no torque.
        """
        now = self.pulse_speeds
        gap = max(abs(wheels.right - now.right), abs(wheels.left - now.left))
        even = max(gap / (count * self.step), 1e-6)
        reach = min(even, acceleration) if acceleration > 0.0 else even
        right, left = wheels.right / self._microstep, wheels.left / self._microstep
        target = PulseTarget(right, left, reach / self._microstep, volts)
        self._integrate(target, disturbance, count)

    def _integrate(self, target: PulseTarget, disturbance: Disturbance, count: int) -> None:
        x, y = self._now[0], self._now[1]
        world = self.world
        obstacles = _NO_OBSTACLES
        if world.segments.size or world.circles.size:
            near = self._radius + 2.0 * self.step * count  # 2 m/s: faster than any wheel
            if clearance(x, y, *world.obstacles) < near:
                obstacles = world.obstacles
        if world.patches.size:
            self._tyres[2:] = self._grip * grip_at(x, y, world.patches)
        self._integrate_steps(
            self._arrays,
            target,
            self._constants,
            self._tyres,
            disturbance.signals,
            obstacles,
            self.steps_done,
            count,
        )
        self._read()
        self.steps_done += count

    def follow_pulses(
        self, right: float, left: float, volts: float, disturbance: Disturbance, count: int
    ) -> None:
        """Integrate ``count`` steps during which the fields turn evenly by these pulses."""
        time = count * self.step
        right, left = right / time, left / time
        if right != self._pulses[2] or left != self._pulses[3]:
            self._field[2], self._field[3] = right, left
        # Nothing to reach.
        self._integrate(PulseTarget(right, left, 1.0, volts), disturbance, count)

    def _block(self, wheel: int) -> None:
        """Stop a wheel at once; its tyre slides until the body has stopped too."""
        self._state[5 + wheel] = 0.0
        ground = float(self._state[7 + wheel])
        self._modes[wheel] = ROLLING if ground == 0.0 else (-1 if ground > 0.0 else 1)
        self._read()

    def _read(self) -> None:
        """Copy the arrays to lists, which are faster to read element by element."""
        self._now = self._state.tolist()
        self._pulses = self._field.tolist()
        if abs(self._now[2]) > math.pi:
            self._now[2] = self._state[2] = wrap_angle(self._now[2])


def max_rate(motor: StepperMotorParameters, load: Load, bumper: BumperParameters) -> float:
    """Return an upper bound (1/s) of the rates of the coupled equations.

    They are the oscillation of the rotor, which moves the wheel alone when the tyre slides, its
    damping, and the oscillation of the body on its bumper.
    """
    inertia = load.body.wheel_inertia + motor.rotor_inertia
    stiffness = motor.teeth * motor.torque_constant * motor.rated_current
    friction = load.friction
    steepest = friction.viscous + friction.coulomb / friction.coulomb_width
    damping = motor.damping + load.friction_factor * steepest
    mass = load.body.total_mass
    return (
        math.sqrt(stiffness / inertia)
        + damping / inertia
        + (math.sqrt(bumper.stiffness / mass) + bumper.damping / mass)
    )


class Body(NamedTuple):
    """Constants of the body, for kernels."""

    radius: float  # R, m
    turn: float  # R/(2b)
    diagonal: float  # diagonal entry of (11) without the wheels' own inertia, kg m²
    beside: float  # off-diagonal entry of (11), kg m²
    coriolis: float  # c of (12), kg m²
    offset: float  # distance of the centre of mass ahead of the axle, m


class DrivetrainConstants(NamedTuple):
    """Constants of :func:`integrate_drivetrain`."""

    body: Body
    friction: FrictionConstants
    bumper: Bumper
    motor: StepperMotor
    microstep: float  # rad
    share: float  # of the IMU filter
    step: float  # s
    wider_right: float  # true over nominal radius of the right wheel
    wider_left: float


class StepInputs(NamedTuple):
    """What acts on the rotors within a step."""

    rate_right: float  # mean of the pulse rate, pulses/s
    rate_left: float
    position_right: float  # mean position of the field, pulses
    position_left: float
    peak_right: float  # pull-out torque, N m
    peak_left: float
    against_right: float  # disturbance torque, N m
    against_left: float


class DrivetrainArrays(NamedTuple):
    """State of :func:`integrate_drivetrain`, changed in place."""

    state: Array
    """See :func:`state_derivative`, shape (9,); wheel angles and chi are those of the rotors
    times the radius multipliers."""
    modes: Integers  # see :data:`ROLLING`, shape (2,)
    field: Array
    """Phase (pulses), rate (pulses/s), position of pulse 0 (rad), right first, shape (6,)."""
    filtered: Array  # filter of the IMU, see :func:`low_pass`, shape (3, 2)
    totals: Array
    """Accumulated, shape (4,): distance (m) slid by each tyre, work (J) of the fields; largest
    force (N) of a wall."""
    work: Array  # work space, shape (4, 9)


def body_constants(body: BodyParameters, geometry: WheelGeometry) -> Body:
    """Return the constants of the body for the kernels."""
    diagonal, beside = wheel_inertia(body, geometry)[0].tolist()
    return Body(
        geometry.wheel_radius,
        0.5 * geometry.wheel_radius / geometry.half_separation,
        diagonal - body.wheel_inertia,
        beside,
        coriolis_factor(body, geometry),
        body.com_offset,
    )


@kernel
def integrate_drivetrain(
    arrays: DrivetrainArrays,
    target: PulseTarget,
    constants: DrivetrainConstants,
    tyres: Array,
    disturbance: DisturbanceSignals,
    obstacles: Obstacles,
    first: int,
    count: int,
) -> None:
    """Integrate rotors, tyres and body over ``count`` steps by the classical Runge-Kutta method.

    Tyres change between rolling and sliding at the end of a step.

    tyres, obstacles : see state_derivative
    first : number of the first step since the start; the time is first times step
    """
    state, totals, step = arrays.state, arrays.totals, constants.step
    for index in range(first, first + count):
        slip_right, slip_left = state[5] - state[7], state[6] - state[8]
        time = (index + 0.5) * step
        inputs = advance_fields(arrays.field, target, constants, time, disturbance)
        work = runge_kutta_step(arrays, inputs, constants, tyres, obstacles)
        change_tyre_modes(arrays, constants, tyres, obstacles)
        filter_motion(arrays, constants)
        radius = constants.body.radius
        totals[0] += 0.5 * step * radius * abs(slip_right + state[5] - state[7])
        totals[1] += 0.5 * step * radius * abs(slip_left + state[6] - state[8])
        totals[2] += step * work
        totals[3] = max(totals[3], abs(arrays.work[3, 4]))


@kernel
def advance_fields(
    field: Array,
    target: PulseTarget,
    constants: DrivetrainConstants,
    time: float,
    disturbance: DisturbanceSignals,
) -> StepInputs:
    """Ramp the pulse rates and advance the phases by one step; return what acts on the rotors.

    The field is constant between two pulses and jumps with each: its position is the whole number
    of pulses in the phase. Evaluated at the stages alone, the jumps would be late by up to half a
    step, an error of first order; within a step the staircase is therefore replaced by the
    straight line with its mean and its slope.

    time : middle of the step, s
    """
    step, microstep, motor = constants.step, constants.microstep, constants.motor
    rate_right, rate_left, reach = field[2], field[3], target.reach * step
    field[2], field[3] = ramp_towards(rate_right, rate_left, target.right, target.left, reach)
    reached = max(abs(target.right - rate_right), abs(target.left - rate_left)) / reach
    mean_right = mean_rate(rate_right, target.right, reached)
    mean_left = mean_rate(rate_left, target.left, reached)
    start_right, start_left = field[0], field[1]
    field[0], field[1] = start_right + step * mean_right, start_left + step * mean_left
    return StepInputs(
        mean_right,
        mean_left,
        mean_pulses(start_right, field[0]),
        mean_pulses(start_left, field[1]),
        pull_out_torque(mean_right * microstep, target.volts, motor),
        pull_out_torque(mean_left * microstep, target.volts, motor),
        disturbance_torque(0, time, disturbance),
        disturbance_torque(1, time, disturbance),
    )


@kernel
def runge_kutta_step(
    arrays: DrivetrainArrays,
    inputs: StepInputs,
    constants: DrivetrainConstants,
    tyres: Array,
    obstacles: Obstacles,
) -> float:
    """Advance the state by one step; return the mean power (W) of the fields.

    The torques of the last stage, at the end of the step, stay in the work space.
    """
    state, work, step = arrays.state, arrays.work, constants.step
    trial, slope, total = work[0], work[1], work[2]
    torque, pushed = work[3, 0:2], work[3, 2:5]
    slope[:] = 0.0
    total[:] = 0.0
    power = 0.0
    for stage in range(4):
        part = 0.5 if stage in (1, 2) else (1.0 if stage == 3 else 0.0)
        weight = 1.0 / 3.0 if stage in (1, 2) else 1.0 / 6.0
        for item in range(9):
            trial[item] = state[item] + part * step * slope[item]
        since = (part - 0.5) * step
        pulled = rotor_torques(trial, arrays.field, inputs, since, constants, torque)
        power += weight * constants.microstep * pulled
        state_derivative(
            trial, arrays.modes, torque, constants.body, tyres, constants.bumper, obstacles, slope,
            pushed,
        )  # fmt: skip
        for item in range(9):
            total[item] += weight * slope[item]
    for item in range(9):
        state[item] += step * total[item]
    return power


@kernel
def rotor_torques(
    now: Array,
    field: Array,
    inputs: StepInputs,
    since: float,
    constants: DrivetrainConstants,
    torque: Array,
) -> float:
    """Write motor minus friction and disturbance; return torque times rate of the fields.

    The result is in N m pulses/s: times the microstep it is their power.

    since : time from the middle of the step, s
    torque : shape (2,), written, N m, for wheels of the nominal radius
    """
    microstep = constants.microstep
    viscous, coulomb, width = constants.friction
    power = 0.0
    for wheel in range(2):
        wider = constants.wider_left if wheel else constants.wider_right
        rate = inputs.rate_left if wheel else inputs.rate_right
        position = inputs.position_left if wheel else inputs.position_right
        rotor = now[5 + wheel] / wider
        pull = rotor_torque(
            field[4 + wheel] + microstep * (position + since * rate) - now[3 + wheel] / wider,
            microstep * rate - rotor,
            inputs.peak_left if wheel else inputs.peak_right,
            constants.motor,
        )
        power += pull * rate
        against = inputs.against_left if wheel else inputs.against_right
        torque[wheel] = pull - against - friction_torque(rotor, viscous, coulomb, width)
        torque[wheel] /= wider
    return power


@kernel
def change_tyre_modes(
    arrays: DrivetrainArrays, constants: DrivetrainConstants, tyres: Array, obstacles: Obstacles
) -> None:
    """Let tyres roll or slide after a step, with the torques of its last stage."""
    state, modes, work, body = arrays.state, arrays.modes, arrays.work, constants.body
    slope, torque, pushed = work[1], work[3, 0:2], work[3, 2:5]
    bumper = constants.bumper
    stopped = stops_sliding(state, modes)
    state_derivative(state, modes, torque, body, tyres, bumper, obstacles, slope, pushed)
    slides = loses_grip(modes, pushed, body, tyres)
    if stopped:
        # Only tyres that the grip can hold: without grip no momentum is transferred.
        begin_rolling(state, modes, body, tyres)
    if stopped or slides:
        state_derivative(state, modes, torque, body, tyres, bumper, obstacles, slope, pushed)


@kernel
def filter_motion(arrays: DrivetrainArrays, constants: DrivetrainConstants) -> None:
    """Advance the filter of the IMU by one step, with state and slope at its end."""
    state, slope, body = arrays.state, arrays.work[1], constants.body
    radius, offset = body.radius, body.offset
    speed = 0.5 * radius * (state[7] + state[8])
    turning = body.turn * (state[7] - state[8])
    low_pass(
        arrays.filtered,
        turning,
        0.5 * radius * (slope[7] + slope[8]) - offset * turning * turning,
        speed * turning + offset * body.turn * (slope[7] - slope[8]),
        constants.share,
    )


@kernel
def state_derivative(
    now: Array,
    modes: Integers,
    torque: Array,
    body: Body,
    tyres: Array,
    bumper: Bumper,
    obstacles: Obstacles,
    slope: Array,
    pushed: Array,
) -> None:
    """Write the derivative of the state, and the forces of tyres and wall.

    now : shape (9,), x, y (m), P, theta_R, theta_L (rad), chi and psi (rad/s, right first)
    modes : shape (2,), see ROLLING
    torque : shape (2,), motor minus friction and disturbance, N m
    tyres : shape (4,), inertia of each wheel (kg m²), largest force of each tyre (N)
    bumper, obstacles : see contact_force; empty arrays = no wall is near
    slope : shape (9,), written
    pushed : shape (3,), written: R F of both tyres (N m), force of the wall along the robot (N)
    """
    radius, turn = body.radius, body.turn
    right, left = now[7], now[8]
    along, angular = 0.5 * radius * (right + left), turn * (right - left)
    cosine, sine = math.cos(now[2]), math.sin(now[2])
    wall = 0.0
    segments, circles = obstacles
    if segments.shape[0] + circles.shape[0] > 0:
        push_x, push_y = contact_force(
            now[0], now[1], along * cosine, along * sine, bumper, segments, circles
        )
        wall = push_x * cosine + push_y * sine
    pull = body.coriolis * angular
    outer_right = 0.5 * radius * wall - pull * left
    outer_left = 0.5 * radius * wall + pull * right
    grip_right = radius * tyres[2] * modes[0]
    grip_left = radius * tyres[3] * modes[1]
    own_right, own_left = body.diagonal, body.diagonal
    drive_right, drive_left = outer_right + grip_right, outer_left + grip_left
    if modes[0] == ROLLING:
        own_right += tyres[0]
        drive_right = outer_right + torque[0]
    if modes[1] == ROLLING:
        own_left += tyres[1]
        drive_left = outer_left + torque[1]
    beside = body.beside
    determinant = own_right * own_left - beside * beside
    rate_right = (own_left * drive_right - beside * drive_left) / determinant
    rate_left = (own_right * drive_left - beside * drive_right) / determinant
    slope[0] = along * cosine
    slope[1] = along * sine
    slope[2] = angular
    slope[3] = now[5]
    slope[4] = now[6]
    slope[5] = rate_right if modes[0] == ROLLING else (torque[0] - grip_right) / tyres[0]
    slope[6] = rate_left if modes[1] == ROLLING else (torque[1] - grip_left) / tyres[1]
    slope[7] = rate_right
    slope[8] = rate_left
    pushed[0] = body.diagonal * rate_right + beside * rate_left - outer_right
    pushed[1] = beside * rate_right + body.diagonal * rate_left - outer_left
    pushed[2] = wall


@kernel
def begin_rolling(state: Array, modes: Integers, body: Body, tyres: Array) -> None:
    """Give body and wheel of a tyre that begins to roll one speed, with momentum conserved.

    A tyre whose chi and psi are equal is unchanged.
    """
    right = body.diagonal * state[7] + body.beside * state[8]
    left = body.beside * state[7] + body.diagonal * state[8]
    own_right, own_left = body.diagonal, body.diagonal
    if modes[0] == ROLLING:
        right += tyres[0] * state[5]
        own_right += tyres[0]
    if modes[1] == ROLLING:
        left += tyres[1] * state[6]
        own_left += tyres[1]
    determinant = own_right * own_left - body.beside * body.beside
    state[7] = (own_left * right - body.beside * left) / determinant
    state[8] = (own_right * left - body.beside * right) / determinant
    if modes[0] == ROLLING:
        state[5] = state[7]
    if modes[1] == ROLLING:
        state[6] = state[8]


@kernel
def stops_sliding(state: Array, modes: Integers) -> bool:
    """Return whether a tyre stopped sliding, chi - psi changing sign; it rolls from now on."""
    changed = False
    for wheel in range(2):
        if modes[wheel] != ROLLING and modes[wheel] * (state[5 + wheel] - state[7 + wheel]) <= 0.0:
            modes[wheel] = ROLLING
            changed = True
    return changed


@kernel
def loses_grip(modes: Integers, pushed: Array, body: Body, tyres: Array) -> bool:
    """Return whether the force of a rolling tyre exceeded its grip; it slides from now on."""
    changed = False
    for wheel in range(2):
        if modes[wheel] == ROLLING and abs(pushed[wheel]) > body.radius * tyres[2 + wheel]:
            modes[wheel] = 1 if pushed[wheel] > 0.0 else -1
            changed = True
    return changed


@kernel
def mean_pulses(start: float, end: float) -> float:
    """Return the mean of floor(phase) while the phase (pulses) changes linearly from start to end.

    The integral of floor is n (n - 1)/2 + n (p - n) with n = floor(p).
    """
    whole_start, whole_end = math.floor(start), math.floor(end)
    if whole_start == whole_end:
        return float(whole_start)
    below_start = whole_start * (start - 0.5 * (whole_start + 1))
    below_end = whole_end * (end - 0.5 * (whole_end + 1))
    return float((below_end - below_start) / (end - start))


@kernel
def mean_rate(rate: float, target: float, reached: float) -> float:
    """Return the mean of a rate that changes linearly to its target within ``reached`` of a step.

    reached : part of the step after which the rate is constant; more than 1 if not reached
    """
    if reached >= 1.0:
        return rate + 0.5 * (target - rate) / reached
    return target - 0.5 * reached * (target - rate)
