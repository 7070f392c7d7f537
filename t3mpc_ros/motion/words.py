# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Poses, twists, wheel speeds and stamped motions, in SI units."""

import math
from typing import NamedTuple

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second: stamps are ``int`` nanoseconds, durations ``float`` seconds."""


class Pose(NamedTuple):
    """Where the middle of the wheel axle is in the world frame, and where it points."""

    x: float
    """m"""
    y: float
    """m"""
    heading: float
    """rad, counter-clockwise from the x axis; the paper's P"""


class BodyTwist(NamedTuple):
    """Speeds in the robot's own frame."""

    linear: float
    """m/s, forward; the paper's v"""
    angular: float
    """rad/s, counter-clockwise; the paper's omega"""


class WheelSpeeds(NamedTuple):
    """Wheel speeds, the paper's chi: right first, forward positive."""

    right: float
    """rad/s"""
    left: float
    """rad/s"""


def check_pose(pose: Pose) -> None:
    """Raise ValueError when a pose is not finite."""
    if not all(map(math.isfinite, pose)):
        raise ValueError(f'pose must be finite: got {pose}')


ORIGIN = Pose(0.0, 0.0, 0.0)
STANDSTILL = BodyTwist(0.0, 0.0)


class Motion(NamedTuple):
    """A pose and a twist at one instant: measured, true or wanted."""

    stamp_ns: int
    pose: Pose
    twist: BodyTwist

    def is_finite(self) -> bool:
        """Whether every number is finite, so that it may be used at all."""
        (x, y, heading), (linear, angular) = self.pose, self.twist
        # A finite sum has finite terms; huge ones may overflow in it, and are looked at singly.
        return math.isfinite(x + y + heading + linear + angular) or all(
            map(math.isfinite, (*self.pose, *self.twist))
        )


def wrap_angle(angle: float) -> float:
    """Return ``angle`` (rad) brought into (-pi, pi]."""
    wrapped = math.remainder(angle, math.tau)
    return math.pi if wrapped == -math.pi else wrapped
