# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From a command to motion: dead time, ramp, servo, and the integration of the wheels' run."""

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.kernels import kernel
from t3mpc_ros.motion import Geometry, Pose, WheelSpeeds
from t3mpc_ros.motion.words import wrap_angle
from t3mpc_ros.robot.dynamics import (
    BodySettings,
    coriolis_factor,
    dynamics_vector,
    wheel_acceleration,
    wheel_inertia,
)
from t3mpc_ros.robot.loads import (
    Disturbance,
    FrictionSettings,
    disturbance_torque,
    friction_torque,
)
from t3mpc_ros.settings import Settings, setting

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DriveSettings(Settings):
    """How the wheels are driven."""

    kind: str = setting(
        'velocity',
        'stepper: the digital twin, whose motors turn in steps; velocity: wheels follow commanded '
        'speeds by a servo; torque: the command is the torque itself, as in the paper',
        choices=('velocity', 'torque', 'stepper'),
    )
    dead_time: float = setting(
        0.010,
        'time before a velocity command reaches the wheels (radio, decoding)',
        unit='s',
        low=0.0,
        high=1.0,
    )
    acceleration: float = setting(
        60.0,
        'largest wheel acceleration the drive is asked for; 0 means no limit',
        unit='rad/s²',
        low=0.0,
        high=1e5,
        live=True,
    )
    lag: float = setting(
        0.020,
        'time constant with which the wheels of the nominal body follow',
        unit='s',
        low=1e-3,
        high=2.0,
        live=True,
    )
    torque_limit: float = setting(
        0.4,
        'largest torque on one wheel',
        unit='N m',
        low=1e-3,
        high=100.0,
        live=True,
        source='holding torque of a common NEMA 17 stepper',
    )
    speed_ceiling: float = setting(
        39.6,
        'wheel speed that the motors cannot exceed whatever the torque',
        unit='rad/s',
        low=1.0,
        high=1000.0,
        live=True,
        source='stepper, V/(2 L I steps) with 12 V, 2.8 mH, 1.7 A, 200 steps per turn',
    )


def drive_vector(settings: DriveSettings, body: BodySettings, geometry: Geometry) -> Array:
    """Return what the kernels here need, shape (6,).

    Diagonal and off-diagonal entry of the nominal (11) (kg m²), lag (s), acceleration (rad/s²),
    torque limit (N m), speed ceiling (rad/s).
    """
    nominal = wheel_inertia(body, geometry)
    return np.array(
        [
            nominal[0, 0],
            nominal[0, 1],
            settings.lag,
            settings.acceleration,
            settings.torque_limit,
            settings.speed_ceiling,
        ]
    )


STABLE = 2.0
"""Largest product of step and fastest rate that is allowed; Runge-Kutta is stable up to 2.78."""


def fastest_rate(
    settings: DriveSettings,
    bodies: tuple[BodySettings, BodySettings],
    geometry: Geometry,
    friction: FrictionSettings,
    friction_factor: float,
) -> float:
    """Return an upper bound (1/s) of how fast errors of chi die out; see :meth:`Plant.load`."""
    nominal, true = (wheel_inertia(body, geometry) for body in bodies)
    damping = friction_factor * (friction.viscous + friction.coulomb / friction.coulomb_width)
    turning = geometry.wheel_radius / geometry.half_separation
    coupling = 2.0 * turning * settings.speed_ceiling * abs(coriolis_factor(bodies[1], geometry))
    # Both matrices have the eigenvectors (1, 1) and (1, -1): straight on, and on the spot.
    rates = [
        ((nominal[0, 0] + sign * nominal[0, 1]) / settings.lag + damping + coupling)
        / (true[0, 0] + sign * true[0, 1])
        for sign in (1.0, -1.0)
    ]
    return float(max(rates))


@kernel
def approach(
    right: float, left: float, target_right: float, target_left: float, reach: float
) -> tuple[float, float]:
    """Return the pair (rad/s) moved towards its target by at most ``reach`` in each wheel.

    One factor serves both wheels, so that slowing down to zero keeps the curvature of the path.
    A negative ``reach`` means no limit.
    """
    gap_right, gap_left = target_right - right, target_left - left
    widest = max(abs(gap_right), abs(gap_left))
    if reach < 0.0 or widest <= reach:
        return target_right, target_left
    factor = reach / widest
    return right + factor * gap_right, left + factor * gap_left


@kernel
def servo_torque(
    right: float, left: float, wanted_right: float, wanted_left: float, drive: Array
) -> tuple[float, float]:
    """Return the torques (N m) that bring chi to the wanted speeds with the nominal lag.

    theta_bar_nominal (wanted - chi)/lag: with the nominal body, and nothing else acting, (10)
    becomes chi' = (wanted - chi)/lag. Any other mass, friction or disturbance shows.

    drive : shape (6,), see :func:`drive_vector`
    """
    pull_right = (wanted_right - right) / drive[2]
    pull_left = (wanted_left - left) / drive[2]
    return (
        within(drive[0] * pull_right + drive[1] * pull_left, drive[4]),
        within(drive[0] * pull_left + drive[1] * pull_right, drive[4]),
    )


@kernel
def within(value: float, bound: float) -> float:
    """Return ``value`` brought into [-bound, bound]."""
    return min(max(value, -bound), bound)


@kernel
def pass_command(
    right: float, left: float, commands: Array, cursor: npt.NDArray[np.int64]
) -> tuple[float, float]:
    """Return the command (rad/s) given n steps ago, and put this one in its place.

    commands : shape (n, 2), a ring; n = 0 means no dead time
    cursor : shape (1,), the row that is next; both are changed in place
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
def simulate(
    state: Array,
    torque_mode: bool,
    right: float,
    left: float,
    commands: Array,
    cursor: npt.NDArray[np.int64],
    limited: Array,
    drive: Array,
    dynamics: Array,
    friction: Array,
    load: Array,
    angular: Array,
    phases: Array,
    walk: Array,
    first: int,
    count: int,
    step: float,
    work: Array,
) -> None:
    r"""Integrate (3), (8) and (10) over ``count`` substeps by the classical Runge-Kutta method.

    .. math:: \dot q = \varsigma(q) \chi, \qquad
              \bar\theta \dot\chi = \tau - \bar\eta \chi - f(\chi) - \tau_d(t)

    state : shape (7,), x, y (m), P, theta_R, theta_L (rad), chi (rad/s); changed in place
    torque_mode : whether (right, left) are torques (N m) or wheel speeds for the servo (rad/s)
    commands : shape (n, 2), wheel speeds on their way to the wheels, see pass_command
    cursor : shape (1,), the row that comes out next; changed in place
    limited : shape (2,), what has come out, after the acceleration limit; changed in place
    drive, dynamics : see drive_vector, dynamics_vector
    friction : shape (3,), viscous (N m s/rad), Coulomb (N m), width (rad/s)
    load, angular, phases, walk : see disturbance_torque
    first : number of the first substep since the run began; the time is first times step
    step : s
    work : shape (3, 7), overwritten
    """
    trial, slope, total = work[0], work[1], work[2]
    radius, turn = dynamics[0], dynamics[1]
    for index in range(first, first + count):
        target_right, target_left = right, left
        if torque_mode:
            limited[0], limited[1] = state[5], state[6]
        else:
            target_right, target_left = pass_command(right, left, commands, cursor)
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
                torque_right = within(right, drive[4])
                torque_left = within(left, drive[4])
            else:
                # The limit is a ramp inside the substep too, not a staircase.
                reach = drive[3] * part * step if drive[3] > 0.0 else -1.0
                wanted_right, wanted_left = approach(
                    limited[0], limited[1], target_right, target_left, reach
                )
                torque_right, torque_left = servo_torque(
                    chi_right, chi_left, wanted_right, wanted_left, drive
                )
            torque_right -= friction_torque(chi_right, friction[0], friction[1], friction[2])
            torque_left -= friction_torque(chi_left, friction[0], friction[1], friction[2])
            torque_right -= disturbance_torque(0, time, load, angular, phases, walk)
            torque_left -= disturbance_torque(1, time, load, angular, phases, walk)
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
        state[5] = within(state[5], drive[5])
        state[6] = within(state[6], drive[5])
        if not torque_mode:
            reach = drive[3] * step if drive[3] > 0.0 else -1.0
            limited[0], limited[1] = approach(
                limited[0], limited[1], target_right, target_left, reach
            )


class Plant:
    """Wheels, body and drive in motion: the numbers that :func:`simulate` works on.

    Parameters
    ----------
    settings
        Only the kind and the dead time are fixed here; the rest comes with :meth:`load`.
    step
        Length of an integration step, s. The dead time becomes a whole number of them.
    """

    def __init__(self, settings: DriveSettings, step: float) -> None:
        self.step = step
        self.steps_done = 0
        """Integration steps since the plant was made: the time that its disturbances know."""
        self._torque_mode = settings.kind == 'torque'
        self._commands: Array = np.zeros((round(settings.dead_time / step), 2))
        self._cursor = np.zeros(1, dtype=np.int64)
        self._limited: Array = np.zeros(2)
        self._state: Array = np.zeros(7)
        self._work: Array = np.zeros((3, 7))

    @property
    def pose(self) -> Pose:
        """The true pose."""
        x, y, heading = self._state[:3].tolist()
        return Pose(x, y, heading)

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._state[:3] = pose.x, pose.y, wrap_angle(pose.heading)

    @property
    def angles(self) -> tuple[float, float]:
        """The angles (rad) the wheels have turned, right first."""
        return float(self._state[3]), float(self._state[4])

    @property
    def wheels(self) -> WheelSpeeds:
        """The true wheel speeds chi."""
        return WheelSpeeds(float(self._state[5]), float(self._state[6]))

    def load(
        self,
        settings: DriveSettings,
        bodies: tuple[BodySettings, BodySettings],
        geometry: Geometry,
        friction: FrictionSettings,
        friction_factor: float,
    ) -> None:
        """Take what acts from now on; ``bodies`` are the nominal one and the true one."""
        nominal, true = bodies
        self._drive = drive_vector(settings, nominal, geometry)
        self._dynamics = dynamics_vector(true, geometry)
        self._friction: Array = np.array(
            [
                friction_factor * friction.viscous,
                friction_factor * friction.coulomb,
                friction.coulomb_width,
            ]
        )

    def run(
        self,
        command: tuple[float, float],
        braking: bool,
        disturbance: Disturbance,
        count: int,
    ) -> None:
        """Integrate ``count`` steps under one command, right first.

        It is a torque (N m) for a torque drive unless ``braking``, else wheel speeds (rad/s).
        """
        simulate(
            self._state,
            self._torque_mode and not braking,
            command[0],
            command[1],
            self._commands,
            self._cursor,
            self._limited,
            self._drive,
            self._dynamics,
            self._friction,
            disturbance.load,
            disturbance.angular,
            disturbance.phases,
            disturbance.walk,
            self.steps_done,
            count,
            self.step,
            self._work,
        )
        self._state[2] = wrap_angle(self._state[2])
        self.steps_done += count
