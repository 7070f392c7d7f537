# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The topics on which a robot tells its state."""

import math
from typing import Any, NamedTuple

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Range

from t3mpc_ros.motion import Geometry
from t3mpc_ros.nodes.plumbing import convert, quality
from t3mpc_ros.nodes.robot import sensors
from t3mpc_ros.nodes.tables import RobotTopicSettings
from t3mpc_ros.robot.backend import RANGE_SENSORS, RobotState
from t3mpc_ros.robot.sensors.battery import BatterySettings
from t3mpc_ros.robot.sensors.mpu6050 import ImuSettings
from t3mpc_ros.robot.sensors.sharp import SharpSettings

BATTERY_RATE = 1.0
"""Hz"""


class Facts(NamedTuple):
    """What a robot is like, for whoever reads its topics."""

    rate: float
    """States per second."""
    geometry: Geometry
    variance: float
    """Of a measured wheel speed, (rad/s)²."""
    sensors: tuple[ImuSettings, SharpSettings, BatterySettings] | None = None
    """None: it has none, but the wheels."""
    truth_frame: str = ''
    """Frame of ground_truth/odom; empty: nobody knows the truth."""


class RobotTopics:
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

    def __init__(self, node: Node, settings: RobotTopicSettings, facts: Facts) -> None:
        self._node = node
        self._published = 0
        self._odometry = self._motion(settings.odom_frame, settings)
        self._odom = node.create_publisher(Odometry, 'odom', quality.INPUT)
        if facts.truth_frame:
            self._truth = self._motion(facts.truth_frame, settings)
            self._true_odom = node.create_publisher(Odometry, 'ground_truth/odom', quality.STREAM)
        self._joints = node.create_publisher(JointState, 'joint_states', quality.SCALARS)
        self._broadcaster = self._transforms() if settings.publish_tf else None
        self._has_sensors = facts.sensors is not None
        if facts.sensors is not None:
            imu, sharp, battery = facts.sensors
            self._imu = node.create_publisher(Imu, 'imu/data_raw', quality.STREAM)
            self._battery = node.create_publisher(BatteryState, 'battery_state', quality.SCALARS)
            self._reading = sensors.battery_message(battery)
            self._ranges = [
                (
                    node.create_publisher(Range, f'range/{name}', quality.SCALARS),
                    sensors.range_message(
                        sharp, f'{settings.range_frame_prefix}{name}_range_link'
                    ),
                )
                for name in (RANGE_SENSORS if settings.range_rate else ())
            ]
        self.configure(settings, facts)

    def configure(self, settings: RobotTopicSettings, facts: Facts) -> None:
        """Take over settings, and work out how well what is told is known."""
        self._settings, self._rate = settings, facts.rate
        if facts.sensors is not None:
            self._sample = sensors.imu_message(facts.sensors[0], settings.imu_frame)
        self._twist_covariances = {
            misleading: sensors.twist_covariance(
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
        settings = self._settings
        self._odometry.pose.covariance = convert.planar_covariance(state.covariance)
        if state.status.slipping is not self._slipping:
            self._slipping = state.status.slipping
            self._odometry.twist.covariance = self._twist_covariances[self._slipping]
        self._odom.publish(convert.fill_odometry(self._odometry, state.odometry))
        if state.truth is not None:
            self._true_odom.publish(convert.fill_odometry(self._truth, state.truth))
        if self._broadcaster is not None:
            frames = settings.odom_frame, settings.base_frame
            self._broadcaster.sendTransform(convert.transform(state.odometry, *frames))
        if self._is_time_for(settings.joint_rate):
            names = settings.right_joint, settings.left_joint
            self._joints.publish(
                convert.wheel_joints(names, state.angles, state.wheels, state.stamp_ns)
            )

    def _tell_sensors(self, state: RobotState) -> None:
        settings = self._settings
        if state.imu is not None:
            self._imu.publish(sensors.fill_imu(self._sample, state.imu, state.stamp_ns))
        if self._is_time_for(settings.range_rate):
            infinity = settings.range_infinity
            for (publisher, message), distance in zip(self._ranges, state.ranges, strict=False):
                if not math.isnan(distance):
                    publisher.publish(
                        sensors.fill_range(message, distance, state.stamp_ns, infinity=infinity)
                    )
        if state.battery is not None and self._is_time_for(BATTERY_RATE):
            self._battery.publish(
                sensors.fill_battery(self._reading, state.battery, state.stamp_ns)
            )

    def _is_time_for(self, rate: float) -> bool:
        """Return whether something told ``rate`` times a second comes with this state."""
        return rate > 0.0 and self._published % max(1, round(self._rate / rate)) == 0

    def _motion(self, frame: str, settings: RobotTopicSettings) -> Odometry:
        message = Odometry(child_frame_id=settings.base_frame)
        message.header.frame_id = frame
        return message

    def _transforms(self) -> Any:
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError:
            self._node.get_logger().info('tf2_ros is not installed: no transform is published')
            return None
        return TransformBroadcaster(self._node)
