# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Publishers of the robot state, common to the simulated and the real robot."""

from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Range

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.nodes.common import conversions, qos, sensor_messages
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.robot.interface import RANGE_SENSORS, RobotState
from t3mpc_ros.robot.sensor_conversions import (
    BatteryParameters,
    ImuParameters,
    RangeSensorParameters,
)


@dataclass(frozen=True)
class RobotTopicParameters(Parameters):
    """Names, frames and rates of what every robot tells, simulated or real."""

    stamped: bool = parameter(False, 'expect cmd_vel as TwistStamped instead of Twist')
    odom_frame_id: str = parameter('odom', 'frame of the odometry')
    base_frame_id: str = parameter('base_link', 'frame of the robot')
    imu_frame: str = parameter('imu_link', 'frame of imu/data_raw')
    range_frame_prefix: str = parameter(
        '', 'put in front of the frames of range/*, which are called <sensor>_range_link'
    )
    right_wheel_name: str = parameter(
        'right_wheel_joint', 'name of the right wheel in joint_states'
    )
    left_wheel_name: str = parameter('left_wheel_joint', 'name of the left wheel in joint_states')
    joint_rate: float = parameter(
        20.0, 'how often joint_states is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    range_rate: float = parameter(
        20.0, 'how often each of range/* is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    range_infinity: bool = parameter(
        True,
        'tell inf where a distance sensor sees nothing (REP 117); false: max_range, which some '
        'take for a free view (clear_on_max_reading of the range sensor layer)',
        dynamic=True,
    )
    enable_odom_tf: bool = parameter(True, 'publish the transform, where tf2_ros is installed')


BATTERY_RATE = 1.0
"""Hz"""


class RobotDescription(NamedTuple):
    """What a robot is like, for whoever reads its topics."""

    rate: float
    """States per second."""
    geometry: WheelGeometry
    variance: float
    """Of a measured wheel speed, (rad/s)²."""
    sensors: tuple[ImuParameters, RangeSensorParameters, BatteryParameters] | None = None
    """None: it has none, but the wheels."""
    truth_frame: str = ''
    """Frame of ground_truth/odom; empty: nobody knows the truth."""


class RobotPublishers:
    """Publishes each state: what every robot knows, and what the sensors of the stepper robot say.

    Parameters
    ----------
    node
        Whose topics they are.
    settings
        Rates and frames.
    facts
        What the robot is like.
    """

    def __init__(
        self, node: Node, parameters: RobotTopicParameters, facts: RobotDescription
    ) -> None:
        self._node = node
        self._published = 0
        self._odometry = self._motion(parameters.odom_frame_id, parameters)
        self._odom = node.create_publisher(Odometry, 'odom', qos.CONTROLLER_INPUT)
        if facts.truth_frame:
            self._truth = self._motion(facts.truth_frame, parameters)
            self._true_odom = node.create_publisher(Odometry, 'ground_truth/odom', qos.STREAM)
        self._joints = node.create_publisher(JointState, 'joint_states', qos.SCALARS)
        self._broadcaster = self._transforms() if parameters.enable_odom_tf else None
        self._has_sensors = facts.sensors is not None
        if facts.sensors is not None:
            imu, range_sensor, battery = facts.sensors
            self._imu = node.create_publisher(Imu, 'imu/data_raw', qos.STREAM)
            self._battery = node.create_publisher(BatteryState, 'battery_state', qos.SCALARS)
            self._reading = sensor_messages.battery_message(battery)
            self._ranges = [
                (
                    node.create_publisher(Range, f'range/{name}', qos.SCALARS),
                    sensor_messages.range_message(
                        range_sensor, f'{parameters.range_frame_prefix}{name}_range_link'
                    ),
                )
                for name in (RANGE_SENSORS if parameters.range_rate else ())
            ]
        self.configure(parameters, facts)

    def configure(self, parameters: RobotTopicParameters, facts: RobotDescription) -> None:
        """Take over settings, and work out how well what is told is known."""
        self._topic_parameters, self._rate = parameters, facts.rate
        if facts.sensors is not None:
            self._sample = sensor_messages.imu_message(facts.sensors[0], parameters.imu_frame)
        self._twist_covariances = {
            misleading: sensor_messages.twist_covariance(
                facts.geometry, math.inf if misleading else facts.variance
            )
            for misleading in (False, True)
        }
        self._slipping: bool | None = None

    def publish(self, state: RobotState) -> None:
        """Tell one state, each part of it at its rate."""
        self._tell_motion(state)
        if self._has_sensors:
            self._tell_sensors(state)
        self._published += 1

    def _tell_motion(self, state: RobotState) -> None:
        parameters = self._topic_parameters
        self._odometry.pose.covariance = conversions.planar_covariance(state.covariance)
        if state.status.slipping is not self._slipping:
            self._slipping = state.status.slipping
            self._odometry.twist.covariance = self._twist_covariances[self._slipping]
        self._odom.publish(conversions.fill_odometry(self._odometry, state.odometry))
        if state.truth is not None:
            self._true_odom.publish(conversions.fill_odometry(self._truth, state.truth))
        if self._broadcaster is not None:
            frames = parameters.odom_frame_id, parameters.base_frame_id
            self._broadcaster.sendTransform(conversions.transform(state.odometry, *frames))
        if self._is_time_for(parameters.joint_rate):
            names = parameters.right_wheel_name, parameters.left_wheel_name
            self._joints.publish(
                conversions.joint_state(names, state.angles, state.wheels, state.stamp_ns)
            )

    def _tell_sensors(self, state: RobotState) -> None:
        parameters = self._topic_parameters
        if state.imu is not None:
            self._imu.publish(sensor_messages.fill_imu(self._sample, state.imu, state.stamp_ns))
        if self._is_time_for(parameters.range_rate):
            infinity = parameters.range_infinity
            for (publisher, message), distance in zip(self._ranges, state.ranges, strict=False):
                if not math.isnan(distance):
                    publisher.publish(
                        sensor_messages.fill_range(
                            message, distance, state.stamp_ns, infinity=infinity
                        )
                    )
        if state.battery is not None and self._is_time_for(BATTERY_RATE):
            self._battery.publish(
                sensor_messages.fill_battery(self._reading, state.battery, state.stamp_ns)
            )

    def _is_time_for(self, rate: float) -> bool:
        """Return whether something told ``rate`` times a second comes with this state."""
        return rate > 0.0 and self._published % max(1, round(self._rate / rate)) == 0

    def _motion(self, frame: str, parameters: RobotTopicParameters) -> Odometry:
        message = Odometry(child_frame_id=parameters.base_frame_id)
        message.header.frame_id = frame
        return message

    def _transforms(self) -> Any:
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError:
            self._node.get_logger().info('tf2_ros is not installed: no transform is published')
            return None
        return TransformBroadcaster(self._node)
