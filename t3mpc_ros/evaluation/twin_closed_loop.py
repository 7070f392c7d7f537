# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Closed loop of controller and digital twin without ROS, with faults.

The loop has the timing of the nodes. Each report of the robot carries its stamp to the controller;
the command computed from it leaves at once, carries that stamp to the command limiter, and arrives
after the delay of the twin's channel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.evaluation.scenario import RATE, Scenario
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, BodyTwist, State, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.interface import RobotCommand, RobotState, RobotStatus
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultSchedule

Array = NDArray[np.float64]

LEAD = 0.4
"""How far ahead of the odometry the reference is told, s."""
FINAL_STANDSTILL = 1.5
"""s; the robot stands for so long at first: without that its odometry does not use the gyro."""
STATUS_FLAGS = RobotStatus._fields
"""What the columns of :attr:`TwinRecord.flags` mean."""


def chaotic_course(duration: float, seed: int = 1) -> Array:
    """Return wheel speeds (rad/s) of the chaotic reference for a run, shape (n, 2).

    It is the reference of every offline trial with that seed, see :class:`Scenario`.
    """
    scenario = Scenario('velocity', 0.0, 'nominal', seed, duration, LEAD)
    return scenario.reference().speeds


def straight_course(duration: float, speed: float = 0.2, turn: float = 0.0) -> Array:
    """Return wheel speeds (rad/s) of a drive at ``speed`` (m/s), shape (n, 2).

    It is straight, or an arc with ``turn`` rad/s.
    """
    wheels = wheels_from_twist(BodyTwist(speed, turn), WheelGeometry())
    return np.tile(wheels, (round((duration + LEAD) * RATE) + 1, 1))


def loop_controller() -> ControllerParameters:
    """Return the controller as it is used on the stepper twin."""
    return ControllerParameters.from_dict(
        {'speed_filter.lag': 0.003, 'speed_filter.noise_variance': 0.04}
    )


def loop_robot(world: str = '', seed: int = 1) -> DigitalTwinParameters:
    """Return the twin as the controller is told it is: its wheel speeds are as noisy."""
    return DigitalTwinParameters.from_dict({'noise.variance': 0.04, 'world': world, 'seed': seed})


@dataclass(frozen=True, slots=True)
class TwinRecord:
    """One run, a row for each report of the robot; wheels are right first.

    ``rotors`` are how fast the wheels turn, ``ground`` how fast wheels that roll would have to
    turn for what the body does: they differ where a tyre slides. Both, the true pose and the
    lost steps are known in simulation only.
    """

    time: Array
    """s since the robot started, shape (n,)"""
    reference: Array
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
        return self.flags[:, STATUS_FLAGS.index(name)]

    def rows(self, begin: float, end: float) -> slice:
        """Return the rows from ``begin`` up to, and without, ``end`` (s)."""
        first, last = np.searchsorted(self.time, (begin - 1e-6, end - 1e-6)).tolist()
        return slice(first, last)


def run_twin(
    robot_parameters: DigitalTwinParameters,
    controller_parameters: ControllerParameters,
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
    ParameterError
        The robot is no stepper, or robot and controller differ in their rate.
    """
    if robot_parameters.drive.kind != 'stepper':
        raise ParameterError(f'drive.kind must be stepper: got {robot_parameters.drive.kind}')
    rate = robot_parameters.rate
    if controller_parameters.rate != rate:
        raise ParameterError(
            f'rate of the controller must be that of the robot ({rate:g} Hz): '
            f'got {controller_parameters.rate:g}'
        )
    count, lead = round(duration * rate), round(LEAD * rate)
    if course.ndim != 2 or course.shape[1] != 2 or len(course) < count + lead:
        raise ValueError(
            f'course must have the shape (at least {count + lead}, 2): got {course.shape}'
        )
    geometry = robot_parameters.geometry
    robot = DigitalTwin(robot_parameters, schedule)
    controller = Controller(controller_parameters)
    controller.warm_up()
    notes = _RecordWriter(count)

    def stamp(k: int) -> int:
        return round(k * NANOSECONDS / rate)

    paused = [(0.0, FINAL_STANDSTILL), *pauses]

    def tell(k: int) -> None:
        twist = twist_from_wheels(WheelSpeeds(*course[k].tolist()), geometry)
        controller.add_reference(State(stamp(k), ORIGIN, twist))

    for k in range(lead):
        tell(k)
    for k in range(count):
        tell(k + lead)
        state = robot.advance(stamp(k))
        now = state.stamp_ns / NANOSECONDS
        controller.enable(not any(begin <= now < end for begin, end in paused))
        twist, status = controller.step(state.odometry)
        wheels = wheels_from_twist(twist, geometry)
        robot.apply(RobotCommand(wheels, status.stamp_ns), state.stamp_ns)
        reason = '' if status.reason.moves else status.reason.value
        notes.take(k, state, wheels, reason, geometry, robot.diagnostics.max_contact_force)
    return notes.record(course[:count])


class _RecordWriter:
    """The rows of a record while they are written."""

    def __init__(self, count: int) -> None:
        self._time = np.empty(count)
        self._wheels = np.empty((5, count, 2))
        self._poses = np.empty((2, count, 3))
        self._lost = np.empty((count, 2), dtype=np.int64)
        self._push = np.empty(count)
        self._flags = np.empty((count, len(STATUS_FLAGS)), dtype=np.bool_)
        self._nearest = np.empty(count)
        self._robot_says: list[str] = []
        self._controller_says: list[str] = []

    def take(
        self,
        k: int,
        state: RobotState,
        asked: WheelSpeeds,
        reason: str,
        geometry: WheelGeometry,
        push: float,
    ) -> None:
        if state.truth is None or state.true_wheels is None or state.lost_steps is None:
            raise ValueError('the state of a simulated robot must hold the truth')
        self._time[k] = state.stamp_ns / NANOSECONDS
        ground = wheels_from_twist(state.truth.twist, geometry)
        self._wheels[:, k] = asked, state.commanded, state.wheels, state.true_wheels, ground
        self._poses[:, k] = state.odometry.pose, state.truth.pose
        self._lost[k] = state.lost_steps
        self._push[k] = push
        self._flags[k] = state.status
        self._nearest[k] = min((one for one in state.ranges if one == one), default=math.nan)
        self._robot_says.append(state.reason)
        self._controller_says.append(reason)

    def record(self, reference: Array) -> TwinRecord:
        asked, commanded, measured, rotors, ground = self._wheels
        odometry, truth = self._poses
        return TwinRecord(
            time=self._time,
            reference=reference,
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
