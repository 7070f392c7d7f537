# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The controller drives the digital twin: one run without ROS, and all that can be seen of it.

The loop is closed as the nodes close it. Each report of the robot carries its stamp to the
controller; the command that it answers with leaves at once, carries that stamp to the guard, and
is under way for as long as the twin's channel takes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.controller import Controller, ControllerSettings
from t3mpc_ros.lab.trial.scenario import RATE, Scenario
from t3mpc_ros.motion import BodyTwist, Geometry, Motion, WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels, wheels_from_body
from t3mpc_ros.motion.words import NANOSECONDS, ORIGIN
from t3mpc_ros.robot.backend import RobotCommand, RobotState, RobotStatus
from t3mpc_ros.robot.twin.faults import FaultSchedule
from t3mpc_ros.robot.twin.robot import TwinRobot
from t3mpc_ros.robot.twin.settings import TwinSettings
from t3mpc_ros.settings import SettingError

Array = NDArray[np.float64]

LEAD = 0.4
"""How far ahead of the odometry the reference is told, s."""
STAND = 1.5
"""s; the robot stands for so long at first: without that its odometry does not use the gyro."""
FLAGS = RobotStatus._fields
"""What the columns of :attr:`TwinRecord.flags` mean."""


def chaotic_course(duration: float, seed: int = 1) -> Array:
    """Return wheel speeds (rad/s) of the chaotic reference for a run, shape (n, 2).

    It is the reference of every offline trial with that seed, see :class:`Scenario`.
    """
    scenario = Scenario('velocity', 0.0, 'nominal', seed, duration, LEAD)
    return scenario.reference().wanted


def straight_course(duration: float, speed: float = 0.2, turn: float = 0.0) -> Array:
    """Return wheel speeds (rad/s) of a drive at ``speed`` (m/s), shape (n, 2).

    It is straight, or an arc with ``turn`` rad/s.
    """
    wheels = wheels_from_body(BodyTwist(speed, turn), Geometry())
    return np.tile(wheels, (round((duration + LEAD) * RATE) + 1, 1))


def loop_controller() -> ControllerSettings:
    """Return the controller as it is used on the stepper twin."""
    return ControllerSettings.from_flat({'estimate.lag': 0.003, 'estimate.noise_variance': 0.04})


def loop_robot(world: str = '', seed: int = 1) -> TwinSettings:
    """Return the twin as the controller is told it is: its wheel speeds are as noisy."""
    return TwinSettings.from_flat({'noise.variance': 0.04, 'world': world, 'seed': seed})


@dataclass(frozen=True, slots=True)
class TwinRecord:
    """One run, a row for each report of the robot; wheels are right first.

    ``rotors`` are how fast the wheels turn, ``ground`` how fast wheels that roll would have to
    turn for what the body does: they differ where a tyre slides. Both, the true pose and the
    lost steps are known in simulation only.
    """

    time: Array
    """s since the robot started, shape (n,)"""
    wanted: Array
    """rad/s, shape (n, 2)"""
    asked: Array
    """What the controller sent, rad/s, shape (n, 2)"""
    commanded: Array
    """What the guard let through at the end of the period before, rad/s, shape (n, 2)"""
    measured: Array
    """By the step counters, rad/s, shape (n, 2)"""
    rotors: Array
    """rad/s, shape (n, 2)"""
    ground: Array
    """rad/s, shape (n, 2)"""
    odometry: Array
    """x, y (m), heading (rad), shape (n, 3)"""
    truth: Array
    """The same, truly."""
    lost_steps: NDArray[np.int64]
    """Full steps, shape (n, 2)"""
    push: Array
    """N, the hardest that a wall has pushed so far, shape (n,)"""
    flags: NDArray[np.bool_]
    """What the robot says of itself, columns as in :data:`FLAGS`."""
    nearest: Array
    """m, what the distance sensors say of the nearest thing, as in :attr:`RobotState.ranges`: -inf
    nearer than they can tell, inf nothing, NaN not measured; shape (n,)"""
    robot_says: tuple[str, ...]
    """Why the robot does not do what it is told; empty where it does."""
    controller_says: tuple[str, ...]
    """Why the controller does not drive; empty where it does."""

    def flag(self, name: str) -> NDArray[np.bool_]:
        """Return what the robot said of itself under a name of :data:`FLAGS`, shape (n,)."""
        return self.flags[:, FLAGS.index(name)]

    def rows(self, begin: float, end: float) -> slice:
        """Return the rows from ``begin`` up to, and without, ``end`` (s)."""
        first, last = np.searchsorted(self.time, (begin - 1e-6, end - 1e-6)).tolist()
        return slice(first, last)


def run_twin(
    robot_settings: TwinSettings,
    controller_settings: ControllerSettings,
    course: Array,
    duration: float,
    schedule: FaultSchedule | None = None,
    pauses: Sequence[tuple[float, float]] = (),
) -> TwinRecord:
    """Return what happened when the controller drove the twin along a course.

    The robot stands for :data:`STAND` seconds before the controller is enabled; the reference
    runs on all the time. Equal arguments give equal runs, bit for bit.

    Parameters
    ----------
    robot_settings
        Of the stepper twin, its world included.
    controller_settings
        Of the controller; it runs at the robot's rate.
    course
        Wanted wheel speeds (rad/s) of each period, shape (n, 2), up to :data:`LEAD` seconds
        beyond the end.
    duration
        s
    schedule
        The faults to play, in place of those that the robot's settings name.
    pauses
        When a person disables the controller, and enables it again, s.

    Raises
    ------
    ValueError
        The course is too short, or has another shape.
    SettingError
        The robot is no stepper, or robot and controller differ in their rate.
    """
    if robot_settings.drive.kind != 'stepper':
        raise SettingError(f'drive.kind must be stepper: got {robot_settings.drive.kind}')
    rate = robot_settings.rate
    if controller_settings.rate != rate:
        raise SettingError(
            f'rate of the controller must be that of the robot ({rate:g} Hz): '
            f'got {controller_settings.rate:g}'
        )
    count, lead = round(duration * rate), round(LEAD * rate)
    if course.ndim != 2 or course.shape[1] != 2 or len(course) < count + lead:
        raise ValueError(
            f'course must have the shape (at least {count + lead}, 2): got {course.shape}'
        )
    geometry = robot_settings.geometry
    robot = TwinRobot(robot_settings, schedule)
    controller = Controller(controller_settings)
    controller.warm_up()
    notes = _Notes(count)

    def stamp(k: int) -> int:
        return round(k * NANOSECONDS / rate)

    paused = [(0.0, STAND), *pauses]

    def tell(k: int) -> None:
        twist = body_from_wheels(WheelSpeeds(*course[k].tolist()), geometry)
        controller.add_reference(Motion(stamp(k), ORIGIN, twist))

    for k in range(lead):
        tell(k)
    for k in range(count):
        tell(k + lead)
        state = robot.advance(stamp(k))
        now = state.stamp_ns / NANOSECONDS
        controller.enable(not any(begin <= now < end for begin, end in paused))
        twist, status = controller.step(state.odometry)
        wheels = wheels_from_body(twist, geometry)
        robot.apply(RobotCommand(wheels, status.stamp_ns), state.stamp_ns)
        reason = '' if status.reason.moves else status.reason.value
        notes.take(k, state, wheels, reason, geometry, robot.inside.hardest_push)
    return notes.record(course[:count])


class _Notes:
    """The rows of a record while they are written."""

    def __init__(self, count: int) -> None:
        self._time = np.empty(count)
        self._wheels = np.empty((5, count, 2))
        self._poses = np.empty((2, count, 3))
        self._lost = np.empty((count, 2), dtype=np.int64)
        self._push = np.empty(count)
        self._flags = np.empty((count, len(FLAGS)), dtype=np.bool_)
        self._nearest = np.empty(count)
        self._robot_says: list[str] = []
        self._controller_says: list[str] = []

    def take(
        self,
        k: int,
        state: RobotState,
        asked: WheelSpeeds,
        reason: str,
        geometry: Geometry,
        push: float,
    ) -> None:
        if state.truth is None or state.true_wheels is None or state.lost_steps is None:
            raise ValueError('the state of a simulated robot must hold the truth')
        self._time[k] = state.stamp_ns / NANOSECONDS
        ground = wheels_from_body(state.truth.twist, geometry)
        self._wheels[:, k] = asked, state.commanded, state.wheels, state.true_wheels, ground
        self._poses[:, k] = state.odometry.pose, state.truth.pose
        self._lost[k] = state.lost_steps
        self._push[k] = push
        self._flags[k] = state.status
        self._nearest[k] = min((one for one in state.ranges if one == one), default=math.nan)
        self._robot_says.append(state.reason)
        self._controller_says.append(reason)

    def record(self, wanted: Array) -> TwinRecord:
        asked, commanded, measured, rotors, ground = self._wheels
        odometry, truth = self._poses
        return TwinRecord(
            time=self._time,
            wanted=wanted,
            asked=asked,
            commanded=commanded,
            measured=measured,
            rotors=rotors,
            ground=ground,
            odometry=odometry,
            truth=truth,
            lost_steps=self._lost,
            push=self._push,
            flags=self._flags,
            nearest=self._nearest,
            robot_says=tuple(self._robot_says),
            controller_says=tuple(self._controller_says),
        )
