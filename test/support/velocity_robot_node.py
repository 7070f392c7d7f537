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
"""The node of a :class:`VelocityRobot`: best-effort ``odom``, ``cmd_vel`` as TwistStamped.

``python -m support.velocity_robot_node RATE --ros-args ...``
"""

from contextlib import suppress
import math
import sys

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from support.velocity_robot import VelocityRobot

TIMEOUT_NS = 500_000_000


class VelocityRobotNode(Node):
    """Publishes the odometry with the rate, and stops without commands, as a driver does."""

    def __init__(self, rate):
        super().__init__('velocity_robot')
        self._robot = VelocityRobot()
        self._odometry = self.create_publisher(Odometry, 'odom', qos_profile_sensor_data)
        self.create_subscription(TwistStamped, 'cmd_vel', self._on_command, 10)
        self._last_ns = self._command_ns = self._published_ns = self._now_ns()
        self.create_timer(1.0 / rate, self._publish)
        self.get_logger().info('velocity_robot ready')

    def _now_ns(self):
        return self.get_clock().now().nanoseconds

    def _advance(self):
        steps = (self._now_ns() - self._last_ns) // 1_000_000
        self._last_ns += steps * 1_000_000
        self._robot.advance(steps / 1000.0)

    def _on_command(self, message):
        self._advance()
        self._command_ns = self._now_ns()
        self._robot.command(message.twist.linear.x, message.twist.angular.z)

    def _publish(self):
        self._advance()
        if self._last_ns == self._published_ns:
            return  # the timer was late, and makes up for it: there is nothing new
        self._published_ns = self._last_ns
        if self._now_ns() - self._command_ns > TIMEOUT_NS:
            self._robot.command(0.0, 0.0)
        (x, y, yaw), linear, angular = self._robot.odometry()
        message = Odometry(child_frame_id='base_footprint')
        message.header.frame_id = 'odom'
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self._last_ns, 10**9)
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        message.pose.pose.orientation.z = math.sin(0.5 * yaw)
        message.pose.pose.orientation.w = math.cos(0.5 * yaw)
        message.twist.twist.linear.x, message.twist.twist.angular.z = linear, angular
        self._odometry.publish(message)


def main(words):
    """Run the node with a rate (Hz)."""
    rclpy.init(args=words)
    node = VelocityRobotNode(float(words[0]))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main(sys.argv[1:])
