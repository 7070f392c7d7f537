# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Speeds of the robot from an odometry whose twist is always zero."""

import math

from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, State, wrap_angle

MOVED, TURNED = 0.01, 0.05
"""Change of the pose (m, rad) with a twist of zero after which the odometry has no twist."""


class OdometryTwist:
    """The twist of the odometry, or the change of its pose where it has none.

    Some robots publish a pose only. Their twist of zero would be a robot that does not follow.
    """

    def __init__(self) -> None:
        self.missing = False
        """Whether the odometry has no twist: speeds are differences of its pose."""
        self.reset()

    def reset(self) -> None:
        """Start again with the next message; what the odometry has is kept."""
        self._anchor: Pose | None = None
        """Pose of the first message with a twist of zero since the last other one."""
        self._last = ORIGIN

    def measured(self, odometry: State, elapsed: float | None) -> State:
        """Return an odometry with its twist, ``elapsed`` s after the last one, None at a start."""
        pose, last, self._last = odometry.pose, self._last, odometry.pose
        if odometry.twist != (0.0, 0.0) or not odometry.is_finite():
            self.missing, self._anchor = False, None
            return odometry
        if self._anchor is None:
            self._anchor = pose
        moved = math.hypot(pose.x - self._anchor.x, pose.y - self._anchor.y)
        turned = abs(wrap_angle(pose.yaw - self._anchor.yaw))
        self.missing = self.missing or moved > MOVED or turned > TURNED
        if not (self.missing and elapsed):
            return odometry
        turn = wrap_angle(pose.yaw - last.yaw)
        middle = last.yaw + 0.5 * turn
        forward = (pose.x - last.x) * math.cos(middle) + (pose.y - last.y) * math.sin(middle)
        return odometry._replace(twist=BodyTwist(forward / elapsed, turn / elapsed))
