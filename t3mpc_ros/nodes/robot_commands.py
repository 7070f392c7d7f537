# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How a robot is commanded: ``cmd_vel``, and the services ``reset_odometry`` and ``e_stop``."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.geometry.types import BodyTwist
from t3mpc_ros.nodes import conversions, qos
from t3mpc_ros.nodes.base_node import BaseNode
from t3mpc_ros.robot.interface import RobotInterface


class CommandSubscription:
    """Receives ``cmd_vel``, rejects commands by age, and counts rejections.

    ``timeout`` returns the time for which a command is valid, s; ``apply`` takes a twist with its
    stamp in robot time (ns) and returns the reason for a rejection; ``clocks`` are that of the
    stamps in messages and that of the robot, ns. ``simulated`` returns whether robot time is
    simulated: then it does not measure the age of a message.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        stamped: bool,
        timeout: Callable[[], float],
        apply: Callable[[BodyTwist, int], str],
        clocks: tuple[Callable[[], int], Callable[[], int]],
        simulated: Callable[[], bool] = lambda: False,
    ) -> None:
        self.message_type = TwistStamped if stamped else Twist
        self.received = 0
        """Number of received commands."""
        self.rejected = 0
        """Number of rejected ones."""
        self.problem = ''
        """Why the last command was rejected; empty if it was accepted."""
        self._node = node
        self._timeout = timeout
        self._apply = apply
        self._clock_ns, self._robot_ns = clocks
        self._simulated = simulated
        node.create_matching_subscription(
            self.message_type, 'cmd_vel', self._on_message, qos.LATEST
        )

    def _on_message(self, message: Twist | TwistStamped, info: dict[str, Any]) -> None:
        # First of all: if the process is suspended from here on, the command ages.
        robot_ns = self._robot_ns()
        age_ns = conversions.message_age_ns(info)
        self.received += 1
        problem = conversions.age_problem(age_ns, self._timeout())
        if problem:
            problem = f'command {problem}'
        else:
            clock_ns = self._clock_ns()
            twist, stamp_ns = conversions.twist_and_stamp(message, clock_ns)
            age_ns = 0 if self._simulated() else max(age_ns, 0)
            problem = self._apply(twist, robot_ns - max(age_ns, clock_ns - stamp_ns))
        if problem:
            self.rejected += 1
            if problem != self.problem:
                # Texts with the age of a command differ each time.
                self._node.get_logger().warning(
                    f'cmd_vel rejected: {problem}', throttle_duration_sec=1.0
                )
        self.problem = problem


def offer_services(
    node: Node,
    robot: RobotInterface,
    now_ns: Callable[[], int],
    lock: AbstractContextManager[Any] | None = None,
) -> None:
    """Offer ``reset_odometry`` and ``e_stop``, which latches until released.

    ``now_ns`` returns the time of the robot; ``lock`` guards a robot that several threads use.
    """
    guard = nullcontext() if lock is None else lock

    def reset_odometry(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with guard:
            problem = robot.reset_odometry(now_ns())
        response.success = not problem
        response.message = problem or 'odometry reset to the origin'
        return response

    def e_stop(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        problem = ''
        with guard:
            if request.data:
                robot.latch_estop('requested by service e_stop', now_ns())
            else:
                problem = robot.release_estop(now_ns())
        response.success = not problem
        response.message = problem or ('latched' if request.data else 'released')
        return response

    node.create_service(Trigger, 'reset_odometry', reset_odometry)
    node.create_service(SetBool, 'e_stop', e_stop)
