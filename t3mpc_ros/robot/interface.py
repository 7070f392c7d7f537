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
"""Robot interface shared by the simulation, the emulator and the robot on the radio.

All of them take a :class:`RobotCommand` and return a :class:`RobotState`; whatever stops the
robot gives a reason.
"""

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.types import State, WheelSpeeds

ZERO_WHEEL_SPEEDS = WheelSpeeds(0.0, 0.0)


class RobotCommand(NamedTuple):
    """Commanded wheel speeds and the time of the command."""

    wheels: WheelSpeeds
    stamp_ns: int


class WheelAngles(NamedTuple):
    """Angles turned by the wheels since the start of the robot, from the step counters."""

    right: float  # rad
    left: float  # rad


class RobotStatus(NamedTuple):
    """Status flags of the robot."""

    enabled: bool  # the drives may move
    moving: bool  # a wheel turns
    estop: bool  # the emergency stop is latched
    timed_out: bool  # the last command has expired
    limited: bool  # the command exceeds a limit and is scaled with its curvature kept
    slipping: bool = False
    """Gyro and steps disagree: a wheel slips, is blocked, or its motor has lost steps."""
    imu_fault: bool = False  # the IMU does not respond
    low_battery: bool = False  # the battery should be charged


class ImuSample(NamedTuple):
    """Planar part of an IMU measurement, in the body frame."""

    angular: float  # rad/s about the vertical, counter-clockwise, bias included
    forward: float  # m/s²
    sideways: float  # m/s², to the left


class BatteryReading(NamedTuple):
    """Supply of motors and board."""

    voltage: float  # V
    current: float  # A, drawn; NaN if not measured
    charge: float  # remaining charge, 0 to 1; NaN if unknown


class RobotState(NamedTuple):
    """Measured and estimated state of the robot at one instant."""

    stamp_ns: int
    wheels: WheelSpeeds  # measured, noise included
    angles: WheelAngles
    odometry: State  # pose of the odometry, twist from the measured wheel speeds
    covariance: npt.NDArray[np.float64]  # of the odometry pose (x, y, yaw), shape (3, 3)
    commanded: WheelSpeeds
    """Wheel speeds sent to the motors, after every limit; estimators use this."""
    status: RobotStatus
    reason: str  # why the robot does not follow the command; empty when it does
    true_wheels: WheelSpeeds | None = None  # known only in simulation
    truth: State | None = None  # known only in simulation
    imu: ImuSample | None = None  # none without an IMU, or when it does not respond
    ranges: tuple[float, ...] = ()
    """m, one for each sensor in :data:`RANGE_SENSORS`: -inf nearer than the measuring range, inf
    beyond it, NaN not measured; empty without range sensors."""
    battery: BatteryReading | None = None  # none if not measured
    lost_steps: tuple[int, int] | None = None
    """Full steps the rotors are behind their fields, right first: known only in simulation."""


class RobotInterface(Protocol):
    """Operations of every robot; a returned text is the reason of a rejection, empty = success."""

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow a command until the next one or until it expires."""

    def advance(self, now_ns: int) -> RobotState:
        """Return the newest state that is not later than ``now_ns``.

        Called for each instant of a time grid in turn, even late, it returns each state once.
        """

    def stop(self, reason: str, now_ns: int) -> None:
        """Stop; the next command moves the robot again."""

    def reset_odometry(self, now_ns: int) -> str:
        """Set the odometry pose to the origin; rejected while the robot moves."""

    def latch_estop(self, reason: str, now_ns: int) -> str:
        """Stop until the emergency stop is released.

        Return why a robot has not got it yet; it is sent to it again until it has.
        """

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop; the robot then waits for a new command."""
