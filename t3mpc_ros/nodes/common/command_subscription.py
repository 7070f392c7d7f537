# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Subscription of a robot to ``cmd_vel``, and the age of received messages.

The age of a message counts from its publication, by the source timestamp of the middleware. An
executor that was suspended takes messages that have waited: counted from the moment at which it
takes them, an unstamped command would be new, however long ago its publisher ended.
"""

from collections.abc import Callable
import time
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped

from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist
from t3mpc_ros.nodes.common import conversions, qos
from t3mpc_ros.nodes.common.base_node import BaseNode

MAX_CLOCK_LEAD_NS = NANOSECONDS // 20
"""Lead of the publisher's clock beyond which the age of a message is unknown."""


def message_age_ns(info: dict[str, Any]) -> int:
    """Return the time since the publication of a message, ns; 0 if the middleware has no stamp.

    Both times are of the system clock, also with ``use_sim_time``. The age is negative if the
    clock of the publisher leads.
    """
    published_ns = int(info['source_timestamp'])
    return time.time_ns() - published_ns if published_ns > 0 else 0


def age_problem(age_ns: int, timeout: float) -> str:
    """Return why a message of this age must not move a robot; empty if it may.

    Parameters
    ----------
    age_ns
        Age from :func:`message_age_ns`.
    timeout
        Time for which the message is valid, s.
    """
    age = age_ns / NANOSECONDS
    if age_ns < -MAX_CLOCK_LEAD_NS:
        return f'is from the future: {-age:.3f} s, the clocks of the computers differ'
    if age >= timeout:
        return f'is too old: {age:.3f} s, it has waited or the clocks of the computers differ'
    return ''


class CommandSubscription:
    """Receives ``cmd_vel``, rejects commands by age, and counts rejections.

    Parameters
    ----------
    node
        Node of the robot.
    stamped
        Whether commands are TwistStamped.
    timeout
        Returns the time for which a command is valid, s.
    apply
        Applies a twist with its stamp in robot time (ns); returns the reason for a rejection.
    clocks
        Clock of the stamps in messages, and clock of the robot; both return ns.
    simulated
        Returns whether robot time is simulated: then it does not measure the age of a message.
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
        age_ns = message_age_ns(info)
        self.received += 1
        problem = age_problem(age_ns, self._timeout())
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
