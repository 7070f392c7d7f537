# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the simulated and the real robot have in common as nodes: commands, stops, states."""

from collections.abc import Mapping
import threading
from typing import Any, TypeVar

from geometry_msgs.msg import Twist, TwistStamped
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.geometry.kinematics import wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist
from t3mpc_ros.nodes import conversions, qos
from t3mpc_ros.nodes.base_node import BaseNode
from t3mpc_ros.nodes.robot_topics import RobotDescription, RobotPublishers, RobotTopicParameters
from t3mpc_ros.robot.interface import RobotCommand, RobotInterface

P = TypeVar('P', bound=RobotTopicParameters)


class RobotNode(BaseNode[P]):
    """A node that is a robot.

    It executes ``cmd_vel``, offers ``reset_odometry`` and ``e_stop``, which latches until it is
    released, and publishes states. Subclasses call :meth:`connect`.
    """

    def connect(self, robot: RobotInterface) -> None:
        """Create the topics and services of a robot."""
        self._robot = robot
        self._lock = threading.Lock()
        """Guards the robot, which several threads may use."""
        self._received = self._rejected = 0
        self._command_problem = ''
        """Why the last command was rejected; empty if it was accepted."""
        self._logged_reason = ''
        stamped = self.parameters.enable_stamped_cmd_vel
        self._command_type = TwistStamped if stamped else Twist
        self._robot_publishers = RobotPublishers(
            self, self.parameters, self.describe(self.parameters)
        )
        self.create_matching_subscription(
            self._command_type, 'cmd_vel', self._on_command, qos.LATEST
        )
        self.offer(Trigger, 'reset_odometry', self._reset_odometry)
        self.offer(SetBool, 'e_stop', self._e_stop)

    def describe(self, parameters: P) -> RobotDescription:
        """Return the properties of the robot."""
        raise NotImplementedError

    def robot_ns(self) -> int:
        """Return the time of the robot, ns."""
        return self.now_ns()

    def has_simulated_time(self) -> bool:
        """Return whether the time of the robot is no measure for the age of a message."""
        return False

    def on_parameters_changed(self, parameters: P) -> None:
        """Apply dynamic parameters to the robot and its messages."""
        with self._lock:
            self._robot.configure(parameters)
        self._robot_publishers.configure(parameters, self.describe(parameters))

    def _on_command(self, message: Twist | TwistStamped, info: dict[str, Any]) -> None:
        """Execute a command unless it is too old; its stamp becomes one in robot time."""
        # First of all: if the process is suspended from here on, the command ages.
        robot_ns = self.robot_ns()
        age_ns = conversions.message_age_ns(info)
        self._received += 1
        problem = conversions.age_problem(age_ns, self.parameters.limiter.command_timeout)
        if problem:
            problem = f'command {problem}'
        else:
            now_ns = self.now_ns()
            twist, stamp_ns = conversions.twist_and_stamp(message, now_ns)
            age_ns = 0 if self.has_simulated_time() else max(age_ns, 0)
            problem = self._apply_command(twist, robot_ns - max(age_ns, now_ns - stamp_ns))
        if problem:
            self._rejected += 1
            if problem != self._command_problem:
                # Texts with the age of a command differ each time.
                self.get_logger().warning(
                    f'cmd_vel rejected: {problem}', throttle_duration_sec=1.0
                )
        self._command_problem = problem

    def _apply_command(self, twist: BodyTwist, stamp_ns: int) -> str:
        command = RobotCommand(wheels_from_twist(twist, self.parameters.geometry), stamp_ns)
        with self._lock:
            return self._robot.apply(command, self.robot_ns())

    def _reset_odometry(self) -> tuple[str, str]:
        with self._lock:
            return self._robot.reset_odometry(self.robot_ns()), 'odometry reset to the origin'

    def _e_stop(self, on: bool) -> tuple[str, str]:
        with self._lock:
            if not on:
                return self._robot.release_estop(self.robot_ns()), 'released'
            self._robot.latch_estop('requested by service e_stop', self.robot_ns())
        return '', 'latched'

    def _log_reason(self, reason: str) -> None:
        if reason != self._logged_reason:
            self._logged_reason = reason
            self.get_logger().info(reason or 'following commands')

    def _command_values(self) -> Mapping[str, object]:
        return {'commands': self._received, 'commands_rejected': self._rejected}

    def _command_type_problem(self) -> str:
        return qos.command_type_problem(self, self._command_type, publish=False)
