# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Closed loop of controller and digital twin without ROS, with faults.

The loop has the timing of the nodes. Each report of the robot carries its stamp to the controller;
the command computed from it leaves at once, carries that stamp to the command limiter, and arrives
after the delay of the twin's channel. Reports may be late or lost on their way to the controller.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.controller import (
    Controller,
    ControllerParameters,
    StepperControllerParameters,
)
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.scenario import RATE, Scenario
from t3mpc_ros.evaluation.simulated_links import NO_FAULTS, LinkFaults, OrderedLink, delay_between
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, BodyTwist, State, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand, RobotState, RobotStatus
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultSchedule
from t3mpc_ros.simulation.plant.disturbances import MeasurementNoise

Array = NDArray[np.float64]

LEAD = 0.4
"""Lead of the reference over the odometry, s."""
INITIAL_STANDSTILL = 1.5
"""Standstill before the run, s; odometry uses the gyro only after it."""
STATUS_FLAGS = RobotStatus._fields
"""Columns of :attr:`TwinRecord.flags`."""


def chaotic_course(duration: float, seed: int = 1) -> Array:
    """Return wheel speeds (rad/s) of the chaotic reference for a run, shape (n, 2).

    It equals the reference of every :class:`Scenario` with that seed.
    """
    scenario = Scenario('velocity', 0.0, 'nominal', seed, duration, LEAD)
    return scenario.reference().speeds


def straight_course(duration: float, turn: float = 0.0) -> Array:
    """Return wheel speeds (rad/s) at 0.2 m/s straight ahead or turning (rad/s), shape (n, 2)."""
    wheels = wheels_from_twist(BodyTwist(0.2, turn), WheelGeometry())
    return np.tile(wheels, (round((duration + LEAD) * RATE) + 1, 1))


def loop_controller() -> ControllerParameters:
    """Return the controller parameters for the stepper twin."""
    return StepperControllerParameters()


def loop_robot(world: str = '', seed: int = 1) -> DigitalTwinParameters:
    """Return the twin with the wheel speed noise that the controller assumes."""
    return DigitalTwinParameters.from_dict({'noise.variance': 0.04, 'world': world, 'seed': seed})


class LoopStatus(Protocol):
    """Part of a controller's status that the loop uses."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the odometry that the command follows from, ns."""
        ...

    @property
    def reason(self) -> Reason:
        """Whether the controller drives, or why not."""
        ...


class LoopController(Protocol):
    """A controller that can drive the twin; :class:`Controller` is one."""

    def enable(self, on: bool) -> None:
        """Enable the robot's motion, or stop the robot."""
        ...

    def add_reference(self, reference: State) -> bool:
        """Add a sample of the reference."""
        ...

    def step(self, odometry: State) -> tuple[BodyTwist, LoopStatus]:
        """Return the command that follows from a report of the robot."""
        ...


@dataclass(frozen=True, slots=True)
class TwinRecord:
    """One run, a row for each report of the robot; wheels are right first.

    ``rotors`` are the true wheel speeds, ``ground`` those of wheels rolling without slip under the
    same body motion; they differ where a tyre slides. Both, the true pose and the lost steps exist
    in simulation only.
    """

    time: Array
    """s since the robot started, shape (n,)"""
    reference: Array
    """rad/s, shape (n, 2)"""
    requested: Array
    """Command of the controller, rad/s, shape (n, 2)"""
    commanded: Array
    """Command after the limiter at the end of the previous period, rad/s, shape (n, 2)"""
    measured: Array
    """By the step counters, rad/s, shape (n, 2)"""
    rotors: Array
    """rad/s, shape (n, 2)"""
    ground: Array
    """rad/s, shape (n, 2)"""
    odometry: Array
    """x, y (m), yaw (rad), shape (n, 3)"""
    truth: Array
    """True pose, columns as in ``odometry``."""
    lost_steps: NDArray[np.int64]
    """Full steps, shape (n, 2)"""
    contact_force: Array
    """Largest contact force of a wall so far, N, shape (n,)"""
    flags: NDArray[np.bool_]
    """Status flags of the robot, columns as in :data:`STATUS_FLAGS`."""
    nearest: Array
    """Smallest range reading, m, as in :attr:`RobotState.ranges`: -inf
    below their range, inf nothing, NaN not measured; shape (n,)"""
    robot_reasons: tuple[str, ...]
    """Reason why the robot does not follow commands; empty where it does."""
    controller_reasons: tuple[str, ...]
    """Stop reason of the controller; empty where it drives."""

    def flag(self, name: str) -> NDArray[np.bool_]:
        """Return one status flag of the robot, a name of :data:`STATUS_FLAGS`, shape (n,)."""
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
    """Return the record of the controller driving the twin, see :func:`drive_twin`."""
    rate = robot_parameters.rate
    if controller_parameters.rate != rate:
        raise ParameterError(
            f'rate of the controller must be that of the robot ({rate:g} Hz): '
            f'got {controller_parameters.rate:g}'
        )
    controller = Controller(controller_parameters)
    controller.warm_up()
    return drive_twin(robot_parameters, controller, course, duration, schedule, pauses)


def drive_twin(
    robot_parameters: DigitalTwinParameters,
    controller: LoopController,
    course: Array,
    duration: float,
    schedule: FaultSchedule | None = None,
    pauses: Sequence[tuple[float, float]] = (),
    links: LinkFaults = NO_FAULTS,
    speed_noise: MeasurementNoise | None = None,
) -> TwinRecord:
    """Return the record of any controller driving the twin.

    The robot rests for :data:`INITIAL_STANDSTILL` seconds before the controller is enabled; the
    reference runs from the start. Equal arguments give equal runs, bit for bit.

    Parameters
    ----------
    robot_parameters, controller
        The stepper twin with its world, and a new controller of the same rate.
    course
        Reference wheel speeds (rad/s) of each period, shape (n, 2), up to :data:`LEAD` seconds
        beyond the end.
    duration
        s
    schedule
        Faults in place of those of the robot's parameters, those of the commands included.
    pauses
        Times at which a person disables and re-enables the controller, s.
    links
        Faults of the reports on their way to the controller, with the seed of the robot.
    speed_noise
        Noise of the wheel speeds in place of the white one of the robot's parameters.
    """
    if robot_parameters.drive.kind != 'stepper':
        raise ParameterError(f'drive.kind must be stepper: got {robot_parameters.drive.kind}')
    rate = robot_parameters.rate
    count, lead = round(duration * rate), round(LEAD * rate)
    if course.ndim != 2 or course.shape[1] != 2 or len(course) < count + lead:
        raise ValueError(
            f'course must have the shape (at least {count + lead}, 2): got {course.shape}'
        )
    geometry = robot_parameters.geometry
    robot = DigitalTwin(robot_parameters, schedule, speed_noise)
    reports: OrderedLink[State] = OrderedLink()
    generator = np.random.default_rng((robot_parameters.seed, 3))
    faults_begin, faults_end = links.span(duration)
    times, rows, reasons = [], [], []

    def stamp(k: int) -> int:
        return round(k * NANOSECONDS / rate)

    paused = [(0.0, INITIAL_STANDSTILL), *pauses]

    def add_reference(k: int) -> None:
        twist = twist_from_wheels(WheelSpeeds(*course[k].tolist()), geometry)
        controller.add_reference(State(stamp(k), ORIGIN, twist))

    for k in range(lead):
        add_reference(k)
    wheels, reason = ZERO_WHEEL_SPEEDS, ''
    for k in range(count):
        add_reference(k + lead)
        state = robot.advance(stamp(k))
        now = state.stamp_ns / NANOSECONDS
        controller.enable(not any(begin <= now < end for begin, end in paused))
        # Two numbers for each report, so that a change of loss does not shift delays.
        lost, late = generator.random(2).tolist()
        active = faults_begin <= now < faults_end
        if not active or lost >= links.odometry_loss:
            delay = delay_between(links.odometry_delay, late) if active else 0.0
            reports.send(state.odometry, state.stamp_ns + round(delay * NANOSECONDS))
        for arrival_ns, odometry in reports.arrived(stamp(k + 1) - 1):
            twist, status = controller.step(odometry)
            wheels = wheels_from_twist(twist, geometry)
            reason = '' if status.reason.moves else status.reason.value
            robot.apply(RobotCommand(wheels, status.stamp_ns), arrival_ns)
        times.append(now)
        rows.append(_row(state, wheels, geometry, robot.diagnostics.max_contact_force))
        reasons.append((state.reason, reason))
    columns: list[Any] = [np.array(column) for column in zip(*rows, strict=True)]
    columns = [np.array(times), course[:count], *columns, *zip(*reasons, strict=True)]
    return TwinRecord(*columns)


def _row(
    state: RobotState, requested: WheelSpeeds, geometry: WheelGeometry, contact_force: float
) -> tuple[object, ...]:
    """Return one report in the order of :class:`TwinRecord`, after the reference."""
    if state.truth is None or state.true_wheels is None or state.lost_steps is None:
        raise ValueError('the state of a simulated robot must hold the truth')
    return (
        requested,
        state.commanded,
        state.wheels,
        state.true_wheels,
        wheels_from_twist(state.truth.twist, geometry),
        state.odometry.pose,
        state.truth.pose,
        state.lost_steps,
        contact_force,
        state.status,
        min((one for one in state.ranges if one == one), default=math.nan),
    )
