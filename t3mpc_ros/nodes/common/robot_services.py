# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Services ``reset_odometry`` and ``e_stop``, common to the simulated and the real robot."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.robot.interface import RobotInterface


class RobotServices:
    """Offers ``reset_odometry`` and ``e_stop``, which latches until released.

    Parameters
    ----------
    node
        Node that offers the services.
    robot
        Robot that they act on.
    now_ns
        Returns the time of the robot, ns.
    lock
        Held during calls of the robot where several threads use it; None: not needed.
    """

    def __init__(
        self,
        node: Node,
        robot: RobotInterface,
        now_ns: Callable[[], int],
        lock: AbstractContextManager[Any] | None = None,
    ) -> None:
        self._robot = robot
        self._now_ns = now_ns
        self._lock = nullcontext() if lock is None else lock
        node.create_service(Trigger, 'reset_odometry', self._on_reset_odometry)
        node.create_service(SetBool, 'e_stop', self._on_e_stop)

    def _on_reset_odometry(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        with self._lock:
            problem = self._robot.reset_odometry(self._now_ns())
        response.success = not problem
        response.message = problem or 'odometry reset to the origin'
        return response

    def _on_e_stop(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        problem = ''
        with self._lock:
            if request.data:
                self._robot.latch_estop('requested by service e_stop', self._now_ns())
            else:
                problem = self._robot.release_estop(self._now_ns())
        response.success = not problem
        response.message = problem or ('latched' if request.data else 'released')
        return response
