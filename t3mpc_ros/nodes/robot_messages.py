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
"""Parameters, messages and diagnostics of a robot's topics, for the simulated and the real one."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import NamedTuple

from sensor_msgs.msg import BatteryState, Imu, Range

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.ros_messages import UNKNOWN_VARIANCE, FrameParameters
from t3mpc_ros.parameters.table import parameter
from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON
from t3mpc_ros.robot.description import FrameNames
from t3mpc_ros.robot.interface import BatteryReading, ImuSample, RobotState
from t3mpc_ros.robot.sensor_parameters import (
    GRAVITY,
    BatteryParameters,
    ImuParameters,
    RangeSensorParameters,
)
from t3mpc_ros.simulation.digital_twin import TwinDiagnostics


@dataclass(frozen=True)
class RobotTopicParameters(FrameParameters):
    """Names, frames and rates of the topics of a simulated or real robot."""

    enable_stamped_cmd_vel: bool = parameter(
        False, 'subscribe to cmd_vel as TwistStamped instead of Twist'
    )
    detect_cmd_vel_type: bool = parameter(
        True,
        'subscribe to cmd_vel with the type of its publishers, Twist or TwistStamped, if none '
        'publishes that of enable_stamped_cmd_vel for 2 s',
    )
    odom_frame_id: str = parameter('odom', 'frame of the odometry')
    base_frame_id: str = parameter('base_link', 'frame of the robot')
    imu_frame_id: str = parameter('imu_link', 'frame of imu/data_raw')
    range_frame_prefix: str = parameter(
        '', 'prefix of the frames of range/*, which are named <sensor>_range_link'
    )
    right_wheel_name: str = parameter(
        'right_wheel_joint', 'name of the right wheel in joint_states'
    )
    left_wheel_name: str = parameter('left_wheel_joint', 'name of the left wheel in joint_states')
    joint_rate: float = parameter(20.0, 'rate of joint_states; 0 = never', 'Hz', (0.0, 1000.0))
    range_rate: float = parameter(
        20.0, 'rate of each topic range/*; 0 = never', 'Hz', (0.0, 1000.0)
    )
    range_infinity: bool = parameter(
        True,
        'publish inf beyond the range of a distance sensor (REP 117); false: max_range, which '
        'some consumers take for free space (clear_on_max_reading of the range sensor layer)',
        dynamic=True,
    )
    enable_odom_tf: bool = parameter(
        True, 'publish the transform from odom_frame_id to base_frame_id, if tf2_ros is installed'
    )
    enable_static_tf: bool = parameter(
        True,
        'publish the fixed transforms of imu_frame_id and of the range sensors, if tf2_ros is '
        'installed; false where robot_state_publisher does',
    )

    @property
    def frame_names(self) -> FrameNames:
        """Names of the frames and wheel joints, without prefix."""
        return FrameNames(
            self.base_frame_id,
            self.imu_frame_id,
            self.range_frame_prefix,
            self.right_wheel_name,
            self.left_wheel_name,
        )


class RobotDescription(NamedTuple):
    """Properties of a robot that its messages depend on."""

    rate: float
    """States per second."""
    geometry: WheelGeometry
    variance: float
    """Variance of a measured wheel speed, (rad/s)²."""
    sensors: tuple[ImuParameters, RangeSensorParameters, BatteryParameters] | None = None
    """None: wheel encoders only."""
    truth_frame: str = ''
    """Frame of ground_truth/odom; empty: no ground truth."""
    publishes_map: bool = False
    """Whether the transform from that frame to the one of the odometry is published."""


def imu_message(parameters: ImuParameters, frame: str) -> Imu:
    """Return an Imu message with frame and covariances, without a sample.

    Orientation is not measured (its covariance begins with -1, REP 145), nor are quantities out
    of the plane. The acceleration contains gravity (REP 145): its z is that of a level robot, with
    the variance of an unknown. The other variances are those of noise and quantisation, without
    bias and scale error.
    """
    message = Imu(header=ros_messages.header(0, frame))
    message.orientation_covariance[0] = -1.0
    message.linear_acceleration.z = GRAVITY
    rate = _noise_variance(math.radians(parameters.gyro_noise), parameters.rate_step, parameters)
    acceleration = _noise_variance(
        1e-6 * GRAVITY * parameters.accel_noise, parameters.acceleration_step, parameters
    )
    message.angular_velocity_covariance = _diagonal(UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, rate)
    message.linear_acceleration_covariance = _diagonal(
        acceleration, acceleration, UNKNOWN_VARIANCE
    )
    return message


def fill_imu(message: Imu, sample: ImuSample, stamp_ns: int) -> Imu:
    """Write a sample into ``message``."""
    message.header.stamp = ros_messages.time_from_ns(stamp_ns)
    message.angular_velocity.z = sample.angular
    message.linear_acceleration.x = sample.forward
    message.linear_acceleration.y = sample.sideways
    return message


def range_message(parameters: RangeSensorParameters, frame: str) -> Range:
    """Return a Range message with the limits of the sensor, without a distance."""
    return Range(
        header=ros_messages.header(0, frame),
        radiation_type=Range.INFRARED,
        field_of_view=parameters.field_of_view,
        min_range=parameters.minimum,
        max_range=parameters.maximum,
        range=math.nan,
    )


def fill_range(message: Range, distance: float, stamp_ns: int, *, infinity: bool) -> Range:
    """Write a distance (m) into ``message``.

    REP 117: -inf is closer than the minimum range, inf beyond the maximum range. Without
    ``infinity`` the latter becomes ``max_range``, which some consumers take for free space.
    """
    message.header.stamp = ros_messages.time_from_ns(stamp_ns)
    message.range = message.max_range if distance == math.inf and not infinity else distance
    return message


def battery_message(parameters: BatteryParameters) -> BatteryState:
    """Return a BatteryState message with the type of the battery, without a reading."""
    return BatteryState(
        temperature=math.nan,
        capacity=math.nan,
        design_capacity=parameters.capacity,
        power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
        power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_LION,
        present=True,
        cell_voltage=[math.nan] * parameters.cells,
        cell_temperature=[math.nan] * parameters.cells,
    )


def fill_battery(message: BatteryState, reading: BatteryReading, stamp_ns: int) -> BatteryState:
    """Write a reading into ``message``; the current of a discharging battery is negative there."""
    message.header.stamp = ros_messages.time_from_ns(stamp_ns)
    message.voltage = reading.voltage
    message.current = -reading.current
    message.percentage = reading.charge
    message.charge = reading.charge * message.design_capacity
    return message


def twist_covariance(geometry: WheelGeometry, variance: float) -> list[float]:
    """Return the 36 numbers for a twist from wheel speeds of variance ``variance`` ((rad/s)²).

    By (1), v and omega are the mean and the difference of the wheel speeds. Lateral speed is not
    measured. With infinite variance (slipping wheels) all variances are that of an unknown.
    """
    linear = 0.5 * variance * geometry.wheel_radius**2
    angular = linear / geometry.half_separation**2
    return ros_messages.planar_covariance(
        (
            (min(linear, UNKNOWN_VARIANCE), 0.0, 0.0),
            (0.0, UNKNOWN_VARIANCE, 0.0),
            (0.0, 0.0, min(angular, UNKNOWN_VARIANCE)),
        )
    )


def count_variance(step: float, period: float) -> float:
    """Return the variance ((rad/s)²) of a speed from a counter read every ``period`` seconds.

    The quantisation error of both readings is uniform over one ``step`` (rad).
    """
    return (step / period) ** 2 / 6.0


def _noise_variance(density: float, step: float, parameters: ImuParameters) -> float:
    """Return the variance of a noise density behind the low-pass filter, with quantisation."""
    return density**2 * parameters.noise_bandwidth + step**2 / 12.0


def _diagonal(x: float, y: float, z: float) -> list[float]:
    return [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z]


FOLLOWING = 'following commands'
"""Report of a robot with which nothing is wrong."""


def state_warnings(
    state: RobotState, twin: TwinDiagnostics | None = None, command_problem: str = ''
) -> tuple[str, ...]:
    """Return the warnings about a robot state, most important first.

    ``command_problem`` says why the last command was rejected, '' if it was accepted.
    """
    status = state.status
    found = [state.reason] if state.reason else []
    if command_problem and command_problem != state.reason:
        found.append(f'cmd_vel rejected: {command_problem}')
    if status.slipping and state.reason != SLIP_STOP_REASON:
        found.append('a wheel slips, is blocked, or has lost steps')
    if status.imu_fault:
        found.append('the inertial sensor does not answer')
    if status.low_battery:
        volts = f': {state.battery.voltage:.1f} V' if state.battery else ''
        found.append(f'the battery is low{volts}')
    if twin is not None and twin.faults:
        found.append(f'faults: {", ".join(twin.faults)}')
    if state.lost_steps is not None and any(state.lost_steps):
        right, left = state.lost_steps
        found.append(f'steps lost: {right} right, {left} left')
    return tuple(found)


def state_values(state: RobotState, twin: TwinDiagnostics | None = None) -> Mapping[str, object]:
    """Return the status and the measured quantities of a robot state by diagnostic key."""
    found: dict[str, object] = {'standstill': state.reason, **state.status._asdict()}
    if state.battery is not None:
        found['battery_v'] = state.battery.voltage
    if state.lost_steps is not None:
        found['lost_steps_right'], found['lost_steps_left'] = state.lost_steps
    if twin is not None:
        found |= {
            'slid_right_m': twin.slid[0],
            'slid_left_m': twin.slid[1],
            'gyro_bias_rad_s': twin.gyro_bias,
            'gyro_bias_estimate_rad_s': twin.estimated_bias,
            'faults': ', '.join(twin.faults) or 'none',
        }
    return found
