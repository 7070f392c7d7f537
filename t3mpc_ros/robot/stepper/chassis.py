# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Two steppers, two tyres and a body as one object, with what a person may do to them."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from t3mpc_ros.motion import Geometry, Pose, WheelSpeeds
from t3mpc_ros.motion.words import wrap_angle
from t3mpc_ros.robot.arena.contact import BumperSettings
from t3mpc_ros.robot.arena.rays import clearance, grip_at
from t3mpc_ros.robot.arena.world import World
from t3mpc_ros.robot.dynamics import BodySettings, coriolis_factor, wheel_inertia
from t3mpc_ros.robot.loads import Disturbance, FrictionSettings
from t3mpc_ros.robot.stepper.coupled import ROLLS, run_coupled
from t3mpc_ros.robot.stepper.motor import MotorSettings
from t3mpc_ros.settings import Settings, setting

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

GRAVITY = 9.81
HELD = 1e9
"""Inertia (kg m²) of a wheel that something holds: large enough that nothing here moves it."""

_NO_SEGMENTS = np.zeros((0, 4))
_NO_CIRCLES = np.zeros((0, 3))


@dataclass(frozen=True)
class TyreSettings(Settings):
    """How the wheels hold on to the floor."""

    grip: float = setting(
        0.6, 'coefficient of friction between tyre and floor', low=0.0, high=5.0, live=True
    )
    load_share: float = setting(
        0.8, 'part of the weight on the driven axle; the rest is on the caster', low=0.0, high=1.0
    )


class Load(NamedTuple):
    """What the motors move, and what holds it back."""

    body: BodySettings
    geometry: Geometry
    friction: FrictionSettings
    friction_factor: float
    tyres: TyreSettings
    grip_factor: float
    blocked: tuple[bool, bool]
    """Wheels that something holds, right first."""


def body_vector(body: BodySettings, geometry: Geometry) -> Array:
    """Return what the coupled kernels need of the body, shape (6,).

    R (m), R/(2b) (1), diagonal and off-diagonal entry of (11) without the wheels' own inertia
    (kg m²), c of (12) (kg m²), how far the centre of mass lies ahead of the axle (m).
    """
    inertia = wheel_inertia(body, geometry)
    return np.array(
        [
            geometry.wheel_radius,
            0.5 * geometry.wheel_radius / geometry.half_separation,
            inertia[0, 0] - body.wheel_inertia,
            inertia[0, 1],
            coriolis_factor(body, geometry),
            body.com_offset,
        ]
    )


def robot_vector(
    motor: MotorSettings, load: Load, bumper: BumperSettings, share: float, step: float
) -> Array:
    """Return all constants of :func:`run_coupled` in one row, shape (22,): fewer to hand over.

    body_vector (6); viscous (N m s/rad) and Coulomb friction (N m), its width (rad/s);
    BumperSettings.vector (3); MotorSettings.vector (7); microstep (rad), share of the inertial
    sensor's filter, length of a step (s).
    """
    friction, factor = load.friction, load.friction_factor
    rubs = [factor * friction.viscous, factor * friction.coulomb, friction.coulomb_width]
    return np.concatenate(
        [
            body_vector(load.body, load.geometry),
            rubs,
            bumper.vector(),
            motor.vector(),
            [motor.microstep, share, step],
        ]
    )


def fastest_rate(
    motor: MotorSettings, load: Load, bumper: BumperSettings, factor: float = 1.0
) -> float:
    """Return an upper bound (1/s) of how fast the coupled equations can change.

    The rotor's swing, with the wheel alone to move when the tyre slides; what damps it; and the
    body's swing on its bumper.
    """
    inertia = load.body.wheel_inertia + motor.rotor_inertia
    stiffness = motor.teeth * motor.torque_constant * motor.rated_current
    friction = load.friction
    damping = motor.damping + factor * (
        friction.viscous + friction.coulomb / friction.coulomb_width
    )
    mass = load.body.total_mass
    return (
        math.sqrt(stiffness / inertia)
        + damping / inertia
        + (math.sqrt(bumper.stiffness / mass) + bumper.damping / mass)
    )


class Chassis:
    """The numbers that :func:`run_coupled` works on, and their meaning.

    Parameters
    ----------
    motor, bumper
        Both motors, and the disc that touches walls.
    world
        Where the robot drives.
    step
        Length of an integration step, s.
    share
        Of the inertial sensor's filter, see ``ImuSettings.share``.
    """

    def __init__(
        self, motor: MotorSettings, bumper: BumperSettings, world: World, step: float, share: float
    ) -> None:
        self.step = step
        self.steps_done = 0
        """Integration steps since the chassis was made: the time that its disturbances know."""
        self.filtered: Array = np.zeros((3, 2))
        """Both stages of the inertial sensor's filter for yaw rate, forward, sideways."""
        self._microstep = motor.microstep
        self._cycle = 2.0 * math.pi / motor.teeth
        self._bumper = bumper
        self._radius = bumper.radius
        self._world = world
        self._share = share
        self._state: Array = np.zeros(9)
        self._modes: Integers = np.zeros(2, dtype=np.int64)
        self._field: Array = np.zeros(6)
        self._tally: Array = np.zeros(4)
        self._work: Array = np.zeros((4, 9))
        self._blocked = (False, False)
        self._read()

    # -- what is so -------------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """The true pose."""
        return Pose(self._now[0], self._now[1], self._now[2])

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._state[:3] = pose.x, pose.y, wrap_angle(pose.heading)
        self._read()

    @property
    def wheels(self) -> WheelSpeeds:
        """How fast the rotors turn, chi."""
        return WheelSpeeds(self._now[5], self._now[6])

    @property
    def ground(self) -> WheelSpeeds:
        """How fast wheels that roll would turn, psi: what the body really does."""
        return WheelSpeeds(self._now[7], self._now[8])

    @property
    def counters(self) -> tuple[int, int]:
        """Pulses issued since the board was started, right first."""
        return math.floor(self._pulses[0]), math.floor(self._pulses[1])

    @property
    def pulse_speeds(self) -> WheelSpeeds:
        """How fast the fields turn, rad/s."""
        return WheelSpeeds(self._pulses[2] * self._microstep, self._pulses[3] * self._microstep)

    @property
    def load_angles(self) -> tuple[float, float]:
        """How far (rad) the fields are ahead of the rotors, whole lost pitches included."""
        state, field = self._now, self._pulses
        return (
            field[4] + self._microstep * math.floor(field[0]) - state[3],
            field[5] + self._microstep * math.floor(field[1]) - state[4],
        )

    @property
    def lost_steps(self) -> tuple[int, int]:
        """Full steps the rotors are behind their fields: always a multiple of four."""
        right, left = self.load_angles
        return 4 * round(right / self._cycle), 4 * round(left / self._cycle)

    @property
    def slid(self) -> tuple[float, float]:
        """Way (m) that each tyre has slid over the floor so far."""
        right, left = self._tally[:2].tolist()
        return right, left

    @property
    def field_work(self) -> float:
        """Work (J) that the turning fields have done on the rotors so far."""
        return float(self._tally[2])

    @property
    def hardest_push(self) -> float:
        """Largest force (N) with which a wall has pushed so far."""
        return float(self._tally[3])

    @property
    def sliding(self) -> tuple[bool, bool]:
        """Whether each tyre slides, right first."""
        right, left = self._modes.tolist()
        return right != ROLLS, left != ROLLS

    # -- what happens to it -----------------------------------------------------------------------

    def load(self, motor: MotorSettings, load: Load) -> None:
        """Take what acts from now on."""
        self._robot = robot_vector(motor, load, self._bumper, self._share, self.step)
        weight = GRAVITY * load.body.total_mass * load.tyres.load_share
        self._grip = 0.5 * load.tyres.grip * weight * load.grip_factor
        own = load.body.wheel_inertia + motor.rotor_inertia
        self._tyres: Array = np.array([own, own, self._grip, self._grip])
        for wheel, (was, now) in enumerate(zip(self._blocked, load.blocked, strict=True)):
            if now:
                self._tyres[wheel] = HELD
            if now and not was:
                self._hold(wheel)
        self._blocked = load.blocked

    def restart_board(self) -> None:
        """Let the pulse generator start at zero, as after a loss of power.

        The driver's field starts in its home position; a rotor is pulled to the nearest one.
        """
        for wheel in (0, 1):
            cycles = round(float(self._state[3 + wheel]) / self._cycle)
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
        """Integrate ``count`` steps while the pulse generator goes for ``wheels`` (rad/s).

        It goes there evenly, to arrive with the last step, unless ``acceleration`` (rad/s², 0 =
        no limit) lets it not; without ``volts`` nothing pulls.
        """
        now = self.pulse_speeds
        gap = max(abs(wheels.right - now.right), abs(wheels.left - now.left))
        even = max(gap / (count * self.step), 1e-6)
        reach = min(even, acceleration) if acceleration > 0.0 else even
        x, y = self._now[0], self._now[1]
        world = self._world
        segments, circles = _NO_SEGMENTS, _NO_CIRCLES
        if world.segments.size or world.circles.size:
            near = self._radius + 2.0 * self.step * count  # 2 m/s: no wheel is as fast
            if clearance(x, y, world.segments, world.circles) < near:
                segments, circles = world.segments, world.circles
        if world.patches.size:
            self._tyres[2:] = self._grip * grip_at(x, y, world.patches)
        run_coupled(
            self._state,
            self._modes,
            self._field,
            wheels.right / self._microstep,
            wheels.left / self._microstep,
            reach / self._microstep,
            volts,
            self._robot,
            self._tyres,
            disturbance.load,
            disturbance.angular,
            disturbance.phases,
            disturbance.walk,
            segments,
            circles,
            self.filtered,
            self.steps_done,
            count,
            self._tally,
            self._work,
        )
        self._read()
        self.steps_done += count

    def _hold(self, wheel: int) -> None:
        """Stop a wheel at once; the tyre slides until the body has stopped too."""
        self._state[5 + wheel] = 0.0
        passing = float(self._state[7 + wheel])
        self._modes[wheel] = ROLLS if passing == 0.0 else (-1 if passing > 0.0 else 1)
        self._read()

    def _read(self) -> None:
        """Take the numbers out of the arrays: reading them there one by one is slow."""
        self._now = self._state.tolist()
        self._pulses = self._field.tolist()
        if abs(self._now[2]) > math.pi:
            self._now[2] = self._state[2] = wrap_angle(self._now[2])
