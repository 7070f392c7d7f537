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
"""The paper's plant (10) with velocity or torque drive, and its parameters."""

from dataclasses import dataclass, replace
import math
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import Array, Pose, WheelSpeeds, wrap_angle
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, at_most, group, parameter
from t3mpc_ros.robot.command_limiter import CommandLimiterParameters, ramp_towards
from t3mpc_ros.robot.wheel_odometry import WheelOdometryParameters
from t3mpc_ros.simulation.plant.disturbances import (
    Disturbance,
    DisturbanceParameters,
    DisturbanceSignals,
    FrictionConstants,
    FrictionParameters,
    NoiseParameters,
    SpeedNoise,
    disturbance_torque,
    friction_constants,
    friction_torque,
)
from t3mpc_ros.simulation.plant.dynamics import (
    BodyParameters,
    coriolis_factor,
    dynamics_vector,
    wheel_acceleration,
    wheel_inertia,
)


@dataclass(frozen=True)
class DriveParameters(Parameters):
    """Drive of the wheels."""

    kind: str = parameter(
        'velocity',
        'stepper: digital twin with stepper motors; velocity: a servo tracks the commanded wheel '
        'speeds; torque: the command is the torque, as in the paper',
        choices=('velocity', 'torque', 'stepper'),
    )
    dead_time: float = parameter(
        0.010,
        'time before a velocity command reaches the wheels (radio, decoding)',
        's',
        (0.0, 1.0),
    )
    acceleration: float = parameter(
        60.0,
        'largest wheel acceleration of the drive; 0 = no limit',
        'rad/s²',
        (0.0, 1e5),
        dynamic=True,
    )
    lag: float = parameter(
        0.020,
        'time constant of the wheel speed servo with the nominal body',
        's',
        (1e-3, 2.0),
        dynamic=True,
    )
    torque_limit: float = parameter(
        0.4,
        'largest torque on one wheel',
        'N m',
        (1e-3, 100.0),
        dynamic=True,
        source='holding torque of a common NEMA 17 stepper',
    )
    speed_ceiling: float = parameter(
        39.6,
        'largest wheel speed of the motors, whatever the torque',
        'rad/s',
        (1.0, 1000.0),
        dynamic=True,
        source='stepper, V/(2 L I steps) with 12 V, 2.8 mH, 1.7 A, 200 steps per turn',
    )


STABILITY_LIMIT = 2.0
"""Largest permitted product of step and fastest rate; Runge-Kutta is stable up to 2.78."""


@dataclass(frozen=True)
class PaperRobotParameters(Parameters):
    """Parameters of a simulated robot with the paper's plant."""

    geometry: WheelGeometry = group(WheelGeometry, inline=True)
    body: BodyParameters = group(BodyParameters)
    friction: FrictionParameters = group(FrictionParameters)
    disturbance: DisturbanceParameters = group(DisturbanceParameters)
    noise: NoiseParameters = group(NoiseParameters)
    drive: DriveParameters = group(DriveParameters)
    limiter: CommandLimiterParameters = group(CommandLimiterParameters, inline=True)
    odometry: WheelOdometryParameters = group(WheelOdometryParameters)
    mass_factor: float = parameter(
        1.0,
        'true over nominal body mass; the drive uses the nominal mass',
        bounds=(0.1, 10.0),
        dynamic=True,
    )
    inertia_factor: float = parameter(
        1.0, 'true over nominal body inertia', bounds=(0.1, 10.0), dynamic=True
    )
    friction_factor: float = parameter(
        1.0, 'true over nominal friction, both kinds', bounds=(0.0, 10.0), dynamic=True
    )
    rate: float = parameter(100.0, 'rate of the reported states', 'Hz', (50.0, 1e3))
    substep: float = parameter(
        0.001,
        'longest integration step; a control period is divided into equal steps',
        's',
        (1e-5, 0.01),
    )
    standstill_speed: ClassVar[float] = 0.1
    """True wheel speed below which the robot is at standstill, rad/s, assumed."""
    max_catch_up_time: ClassVar[float] = 1.0
    """Longest time simulated after a gap between requests, s, assumed; the rest is skipped."""
    seed: int = parameter(1, 'seed of disturbance and noise', bounds=(0, None))

    @property
    def substeps(self) -> int:
        """Number of integration steps of a control period."""
        return max(1, math.ceil(1.0 / (self.rate * self.substep) - 1e-9))

    @property
    def step(self) -> float:
        """Length of an integration step, s."""
        return 1.0 / (self.rate * self.substeps)

    @property
    def true_body(self) -> BodyParameters:
        """The true body, with its factors; the drive uses the nominal body."""
        return replace(
            self.body,
            body_mass=self.body.body_mass * self.mass_factor,
            body_inertia=self.body.body_inertia * self.inertia_factor,
        )

    def check_consistency(self) -> None:
        """Raise ParameterError when the integration would be unstable, or stops too slow."""
        fastest = max_rate(self)
        if self.step * fastest > STABILITY_LIMIT:
            raise ParameterError(
                f'substep must be at most {at_most(STABILITY_LIMIT / fastest, 2)} s with this '
                f'body, drive and friction (fastest rate {fastest:.4g} 1/s): got {self.substep:g}'
            )
        if self.drive.kind == 'velocity':
            self.check_ramp()

    def check_ramp(self) -> None:
        """Raise ParameterError when the drive would slow down stops."""
        drive, limiter = self.drive, self.limiter
        if 0.0 < drive.acceleration < limiter.stop_deceleration:
            raise ParameterError(
                'drive.acceleration must be at least wheel.stop_deceleration '
                f'({limiter.stop_deceleration:g} rad/s²), or 0: got {drive.acceleration:g}'
            )


class PaperPlant:
    """Wheels, body and drive with random disturbance, and measured speeds with noise.

    The physics of :class:`PaperRobot` without limiter, odometry and reports: the arrays of
    :func:`integrate_plant`. Disturbance and noise have separate random generators, which draw the
    same numbers whatever the parameters: changing one does not shift the other. The dead time is
    rounded to whole steps.
    """

    def __init__(self, parameters: PaperRobotParameters) -> None:
        for_disturbance, for_noise = np.random.SeedSequence(parameters.seed).spawn(2)
        self._disturbance = Disturbance(
            parameters.disturbance, np.random.default_rng(for_disturbance)
        )
        self._noise = SpeedNoise(parameters.noise, np.random.default_rng(for_noise))
        self.step = parameters.step  # length of an integration step, s
        self.steps_done = 0  # integration steps since the start: the time base of the disturbances
        self._torque_mode = parameters.drive.kind == 'torque'
        self._arrays = PlantArrays(
            state=np.zeros(7),
            commands=np.zeros((round(parameters.drive.dead_time / self.step), 2)),
            cursor=np.zeros(1, dtype=np.int64),
            limited=np.zeros(2),
            work=np.zeros((3, 7)),
        )
        self._state = self._arrays.state
        self.configure(parameters)

    @property
    def pose(self) -> Pose:
        """True pose."""
        x, y, yaw = self._state[:3].tolist()
        return Pose(x, y, yaw)

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._state[:3] = pose.x, pose.y, wrap_angle(pose.yaw)

    @property
    def angles(self) -> tuple[float, float]:
        """Angles (rad) turned by the wheels, right first."""
        return float(self._state[3]), float(self._state[4])

    @property
    def wheels(self) -> WheelSpeeds:
        """True wheel speeds chi."""
        return WheelSpeeds(float(self._state[5]), float(self._state[6]))

    def configure(self, parameters: PaperRobotParameters) -> None:
        """Continue with other dynamic parameters."""
        self._disturbance.parameters = parameters.disturbance
        self._noise.parameters = parameters.noise
        drive, geometry = parameters.drive, parameters.geometry
        diagonal, beside = wheel_inertia(parameters.body, geometry)[0].tolist()
        self._constants = PlantConstants(
            DriveConstants(
                diagonal,
                beside,
                drive.lag,
                drive.acceleration,
                drive.torque_limit,
                drive.speed_ceiling,
            ),
            dynamics_vector(parameters.true_body, geometry),
            friction_constants(parameters.friction, parameters.friction_factor),
        )

    def run(self, command: tuple[float, float], count: int, *, braking: bool = False) -> None:
        """Integrate ``count`` steps under one command, right first.

        Torques (N m) for a torque drive unless ``braking``, otherwise wheel speeds (rad/s).
        """
        integrate_plant(
            self._arrays,
            self._torque_mode and not braking,
            command[0],
            command[1],
            self._constants,
            self._disturbance.signals,
            self.steps_done,
            count,
            self.step,
        )
        self._state[2] = wrap_angle(self._state[2])
        self.steps_done += count

    def measure(self, dt: float) -> WheelSpeeds:
        """Return chi with noise, and draw the disturbance, ``dt`` seconds after the last time."""
        measured = self._noise.measure(self.wheels)
        self._disturbance.draw(dt)
        return measured


class DriveConstants(NamedTuple):
    """Constants of the drive, for kernels."""

    diagonal: float  # diagonal entry of the nominal (11), kg m²
    beside: float  # off-diagonal entry of the nominal (11), kg m²
    lag: float  # s
    acceleration: float  # rad/s², 0 = no limit
    torque_limit: float  # N m
    speed_ceiling: float  # rad/s


class PlantConstants(NamedTuple):
    """Constants of :func:`integrate_plant`."""

    drive: DriveConstants
    dynamics: Array  # see :func:`dynamics_vector`
    friction: FrictionConstants


class PlantArrays(NamedTuple):
    """State of :func:`integrate_plant`, changed in place."""

    state: Array  # x, y (m), P, theta_R, theta_L (rad), chi (rad/s), shape (7,)
    commands: Array  # delayed wheel speeds, shape (n, 2), see :func:`delay_command`
    cursor: npt.NDArray[np.int64]  # the next row of ``commands``, shape (1,)
    limited: Array  # delayed command after the acceleration limit, shape (2,)
    work: Array  # work space, shape (3, 7)


def max_rate(parameters: PaperRobotParameters) -> float:
    """Return an upper bound (1/s) of the decay rate of chi."""
    drive, friction, geometry = parameters.drive, parameters.friction, parameters.geometry
    bodies = parameters.body, parameters.true_body
    nominal, true = (wheel_inertia(body, geometry) for body in bodies)
    steepest = friction.viscous + friction.coulomb / friction.coulomb_width
    damping = parameters.friction_factor * steepest
    turning = geometry.wheel_radius / geometry.half_separation
    coupling = 2.0 * turning * drive.speed_ceiling * abs(coriolis_factor(bodies[1], geometry))
    # Both matrices have the eigenvectors (1, 1), straight motion, and (1, -1), turning.
    rates = [
        ((nominal[0, 0] + sign * nominal[0, 1]) / drive.lag + damping + coupling)
        / (true[0, 0] + sign * true[0, 1])
        for sign in (1.0, -1.0)
    ]
    return float(max(rates))


@kernel
def servo_torque(
    right: float, left: float, wanted_right: float, wanted_left: float, drive: DriveConstants
) -> tuple[float, float]:
    """Return the torques (N m) that bring chi to the wanted speeds with the nominal lag.

    theta_bar_nominal (wanted - chi)/lag: with the nominal body and without friction and
    disturbance, (10) becomes chi' = (wanted - chi)/lag.
    """
    pull_right = (wanted_right - right) / drive.lag
    pull_left = (wanted_left - left) / drive.lag
    return (
        clamp(drive.diagonal * pull_right + drive.beside * pull_left, drive.torque_limit),
        clamp(drive.diagonal * pull_left + drive.beside * pull_right, drive.torque_limit),
    )


@kernel
def clamp(value: float, bound: float) -> float:
    """Return ``value`` clamped to [-bound, bound]."""
    return min(max(value, -bound), bound)


@kernel
def delay_command(
    right: float, left: float, commands: Array, cursor: npt.NDArray[np.int64]
) -> tuple[float, float]:
    """Return the command (rad/s) of n steps ago, and store this one in its place.

    commands : shape (n, 2), a ring buffer; n = 0 means no dead time
    cursor : shape (1,), the next row; both are changed in place
    """
    if commands.shape[0] == 0:
        return right, left
    row = cursor[0]
    delayed = commands[row, 0], commands[row, 1]
    commands[row, 0] = right
    commands[row, 1] = left
    cursor[0] = (row + 1) % commands.shape[0]
    return delayed


@kernel
def integrate_plant(
    arrays: PlantArrays,
    torque_mode: bool,
    right: float,
    left: float,
    constants: PlantConstants,
    disturbance: DisturbanceSignals,
    first: int,
    count: int,
    step: float,
) -> None:
    r"""Integrate (3), (8) and (10) over ``count`` substeps by the classical Runge-Kutta method.

    .. math:: \dot q = \varsigma(q) \chi, \qquad
              \bar\theta \dot\chi = \tau - \bar\eta \chi - f(\chi) - \tau_d(t)

    torque_mode : whether (right, left) are torques (N m) or wheel speeds for the servo (rad/s)
    first : number of the first substep since the start; the time is first times step
    step : s
    """
    state, limited, work = arrays.state, arrays.limited, arrays.work
    drive, dynamics = constants.drive, constants.dynamics
    viscous, coulomb, width = constants.friction
    trial, slope, total = work[0], work[1], work[2]
    radius, turn = dynamics[0], dynamics[1]
    for index in range(first, first + count):
        target_right, target_left = right, left
        if torque_mode:
            limited[0], limited[1] = state[5], state[6]
        else:
            target_right, target_left = delay_command(right, left, arrays.commands, arrays.cursor)
        slope[:] = 0.0
        total[:] = 0.0
        for stage in range(4):
            part = 0.5 if stage in (1, 2) else (1.0 if stage == 3 else 0.0)
            weight = 1.0 / 3.0 if stage in (1, 2) else 1.0 / 6.0
            time = (index + part) * step
            for item in range(7):
                trial[item] = state[item] + part * step * slope[item]
            chi_right, chi_left = trial[5], trial[6]
            if torque_mode:
                torque_right = clamp(right, drive.torque_limit)
                torque_left = clamp(left, drive.torque_limit)
            else:
                # The limit is a ramp within the substep too, not a staircase.
                reach = drive.acceleration * part * step if drive.acceleration > 0.0 else -1.0
                wanted_right, wanted_left = ramp_towards(
                    limited[0], limited[1], target_right, target_left, reach
                )
                torque_right, torque_left = servo_torque(
                    chi_right, chi_left, wanted_right, wanted_left, drive
                )
            torque_right -= friction_torque(chi_right, viscous, coulomb, width)
            torque_left -= friction_torque(chi_left, viscous, coulomb, width)
            torque_right -= disturbance_torque(0, time, disturbance)
            torque_left -= disturbance_torque(1, time, disturbance)
            along = 0.5 * radius * (chi_right + chi_left)
            slope[0] = along * math.cos(trial[2])
            slope[1] = along * math.sin(trial[2])
            slope[2] = turn * (chi_right - chi_left)
            slope[3] = chi_right
            slope[4] = chi_left
            slope[5], slope[6] = wheel_acceleration(
                chi_right, chi_left, torque_right, torque_left, dynamics
            )
            for item in range(7):
                total[item] += weight * slope[item]
        for item in range(7):
            state[item] += step * total[item]
        state[5] = clamp(state[5], drive.speed_ceiling)
        state[6] = clamp(state[6], drive.speed_ceiling)
        if not torque_mode:
            reach = drive.acceleration * step if drive.acceleration > 0.0 else -1.0
            limited[0], limited[1] = ramp_towards(
                limited[0], limited[1], target_right, target_left, reach
            )
