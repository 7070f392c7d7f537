# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The topics on which a robot tells its state."""

import math
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Range

from t3mpc_ros.nodes.plumbing import convert, quality
from t3mpc_ros.nodes.robot import sensors
from t3mpc_ros.nodes.tables import SimRobotNodeSettings
from t3mpc_ros.robot.backend import RANGE_SENSORS, RobotState

BATTERY_RATE = 1.0
"""Hz"""


class RobotTopics:
    """Publishes each state: what every robot knows, and what the sensors of the stepper robot say.

    Parameters
    ----------
    node
        Whose topics they are.
    settings
        Rates, frames, and what the sensors are like.
    """

    def __init__(self, node: Node, settings: SimRobotNodeSettings) -> None:
        self._node = node
        self._published = 0
        self._odometry = self._motion(settings.odom_frame, settings)
        self._truth = self._motion(settings.world_frame, settings)
        self._odom = node.create_publisher(Odometry, 'odom', quality.STREAM)
        self._true_odom = node.create_publisher(Odometry, 'ground_truth/odom', quality.STREAM)
        self._joints = node.create_publisher(JointState, 'joint_states', quality.SCALARS)
        self._broadcaster = self._transforms() if settings.publish_tf else None
        self._has_sensors = settings.drive.kind == 'stepper'
        if self._has_sensors:
            self._imu = node.create_publisher(Imu, 'imu/data_raw', quality.STREAM)
            self._battery = node.create_publisher(BatteryState, 'battery_state', quality.SCALARS)
            self._reading = sensors.battery_message(settings.battery)
            self._ranges = [
                (
                    node.create_publisher(Range, f'range/{name}', quality.SCALARS),
                    sensors.range_message(
                        settings.sharp, f'{settings.range_frame_prefix}{name}_range_link'
                    ),
                )
                for name in (RANGE_SENSORS if settings.range_rate else ())
            ]
        self.configure(settings)

    def configure(self, settings: SimRobotNodeSettings) -> None:
        """Take over settings, and work out how well what is told is known."""
        self._settings = settings
        variance = settings.noise.variance
        if self._has_sensors:
            variance += sensors.count_variance(settings.motor.microstep, 1.0 / settings.rate)
            self._sample = sensors.imu_message(settings.imu, settings.imu_frame)
        self._twist_covariances = {
            misleading: sensors.twist_covariance(
                settings.geometry, math.inf if misleading else variance
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
        return rate > 0.0 and self._published % max(1, round(self._settings.rate / rate)) == 0

    def _motion(self, frame: str, settings: SimRobotNodeSettings) -> Odometry:
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
