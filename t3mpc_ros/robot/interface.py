# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Robot interface shared by the simulation, the emulator and the robot on the radio."""

from typing import NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, State, WheelSpeeds

ZERO_WHEEL_SPEEDS = WheelSpeeds(0.0, 0.0)

RANGE_SENSORS = (
    'front_left',
    'front_right',
    'left_front',
    'left_back',
    'rear_left',
    'rear_right',
    'right_front',
    'right_back',
)
"""The eight distance sensors, two on each side, in the order of every list of them."""


class RobotCommand(NamedTuple):
    """Wheel speeds that are wanted, and when they were."""

    wheels: WheelSpeeds
    stamp_ns: int

    @classmethod
    def from_twist(cls, twist: BodyTwist, geometry: WheelGeometry, stamp_ns: int) -> Self:
        """Return the command for a body twist, by the inverse of (1)."""
        return cls(wheels_from_twist(twist, geometry), stamp_ns)


class WheelAngles(NamedTuple):
    """How far the wheels have turned since the robot started, as step counters tell it."""

    right: float
    """rad"""
    left: float
    """rad"""


class RobotStatus(NamedTuple):
    """What the robot says of itself."""

    enabled: bool
    """The drives may move."""
    moving: bool
    """A wheel turns."""
    estop: bool
    """The emergency stop is latched."""
    timed_out: bool
    """The last command is too old to follow."""
    limited: bool
    """The command was larger than the limits allow; curvature was kept."""
    slipping: bool = False
    """Gyro and steps disagree: a wheel slips, is blocked, or its motor has lost steps."""
    imu_fault: bool = False
    """The inertial sensor does not answer."""
    low_battery: bool = False
    """The supply is so low that it should be charged."""


class ImuSample(NamedTuple):
    """What a planar robot needs of its inertial sensor, in the frame of the body."""

    angular: float
    """rad/s about the vertical, counter-clockwise, bias and all"""
    forward: float
    """m/s²"""
    sideways: float
    """m/s², to the left"""


class BatteryReading(NamedTuple):
    """The supply of motors and board."""

    voltage: float
    """V"""
    current: float
    """A, drawn; NaN where nobody measures it"""
    charge: float
    """What is left, 0 to 1; NaN where nobody knows"""


class RobotState(NamedTuple):
    """What a robot knows at one instant."""

    stamp_ns: int
    wheels: WheelSpeeds
    """Measured, noise and all."""
    angles: WheelAngles
    odometry: State
    """Pose by dead reckoning, twist from the measured wheels."""
    covariance: npt.NDArray[np.float64]
    """Of the odometry pose (x, y, heading), shape (3, 3)."""
    commanded: WheelSpeeds
    """What is really asked of the wheels, after every limit: estimators use this."""
    status: RobotStatus
    reason: str
    """Why the robot does not do what it is told; empty when it does."""
    true_wheels: WheelSpeeds | None = None
    """Known only in simulation."""
    truth: State | None = None
    """Known only in simulation."""
    imu: ImuSample | None = None
    """None where there is no such sensor, or it does not answer."""
    ranges: tuple[float, ...] = ()
    """m, one for each sensor in :data:`RANGE_SENSORS`: -inf nearer than the sensor can tell, inf
    beyond its range, NaN not measured; empty where there are none."""
    battery: BatteryReading | None = None
    """None where it is not measured."""
    lost_steps: tuple[int, int] | None = None
    """Full steps the rotors are behind their fields, right first: known only in simulation."""


class RobotInterface(Protocol):
    """What every robot can do. Texts returned say why a request was refused; empty is yes."""

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Take a command, to be followed until the next one or until it is too old."""

    def advance(self, now_ns: int) -> RobotState:
        """Return the newest state that is not later than ``now_ns``.

        Asked for each instant of a grid in turn, even late, it returns each state once.
        """

    def stop(self, reason: str, now_ns: int) -> None:
        """Come to rest; the next command moves the robot again."""

    def reset_odometry(self, now_ns: int) -> str:
        """Let dead reckoning start at the origin; refused while the robot moves."""

    def latch_estop(self, reason: str, now_ns: int) -> None:
        """Come to rest, and stay so until the emergency stop is released."""

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop; the robot then waits for a new command."""
