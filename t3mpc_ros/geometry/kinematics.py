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
"""Unicycle kinematics of a differential drive, equations (1)-(3) with E1."""

from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.geometry.types import Array, BodyTwist, Pose, WheelSpeeds, wrap_angle
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class WheelGeometry(Parameters):
    """Wheel radius and separation, which relate wheel speeds to the body twist."""

    wheel_radius: float = parameter(
        0.035, 'wheel radius R', 'm', (0.005, 1.0), source='paper: 7 cm wheels'
    )
    wheel_separation: float = parameter(0.147, 'distance between the wheels, 2b', 'm', (0.01, 5.0))

    @property
    def half_separation(self) -> float:
        """The paper's iota, b (m). E1: *half* the separation; the full one would halve omega."""
        return 0.5 * self.wheel_separation


# Plain Python: reading a bag must not need the compiler. The controller makes a kernel of it.
def body_speeds(
    right: float, left: float, radius: float, half_separation: float
) -> tuple[float, float]:
    r"""Return v (m/s) and omega (rad/s) of two wheel speeds (rad/s), equation (1) with E1.

    .. math:: v = R(\dot\theta_R + \dot\theta_L)/2, \qquad
              \omega = R(\dot\theta_R - \dot\theta_L)/(2b)
    """
    return 0.5 * radius * (right + left), 0.5 * radius * (right - left) / half_separation


def wheel_speeds(
    linear: float, angular: float, radius: float, half_separation: float
) -> tuple[float, float]:
    """Return right and left wheel speed (rad/s) of a body twist, the inverse of equation (1)."""
    turn = angular * half_separation
    return (linear + turn) / radius, (linear - turn) / radius


def twist_from_wheels(wheels: WheelSpeeds, geometry: WheelGeometry) -> BodyTwist:
    """Return the body twist of two wheel speeds, equation (1) with E1."""
    half = geometry.half_separation
    return BodyTwist(*body_speeds(wheels.right, wheels.left, geometry.wheel_radius, half))


def wheels_from_twist(twist: BodyTwist, geometry: WheelGeometry) -> WheelSpeeds:
    """Return the wheel speeds of a body twist, the inverse of equation (1)."""
    half = geometry.half_separation
    return WheelSpeeds(*wheel_speeds(twist.linear, twist.angular, geometry.wheel_radius, half))


def advance_pose(pose: Pose, twist: BodyTwist, dt: float) -> Pose:
    """Return the pose after ``dt`` seconds of constant twist: the exact arc of (2).

    The chord formula with sin(x)/x is accurate for straight motion as well.
    """
    half_turn = 0.5 * twist.angular * dt
    chord = twist.linear * dt * (math.sin(half_turn) / half_turn if half_turn else 1.0)
    direction = pose.yaw + half_turn
    return Pose(
        pose.x + chord * math.cos(direction),
        pose.y + chord * math.sin(direction),
        wrap_angle(pose.yaw + 2.0 * half_turn),
    )


def frame_between(outer: Pose, inner: Pose) -> Pose:
    """Return the frame in which a robot has the pose ``inner`` that has ``outer`` outside of it.

    With the true pose and that of the odometry: the origin of the odometry in the map.
    """
    yaw = wrap_angle(outer.yaw - inner.yaw)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return Pose(
        outer.x - cosine * inner.x + sine * inner.y,
        outer.y - sine * inner.x - cosine * inner.y,
        yaw,
    )


def points_from_frame(frame: Pose, points: Array) -> Array:
    """Return points (m) of a frame, shape (n, 2), in the frame in which its pose is given."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    x, y = points.T
    return np.column_stack([frame.x + cosine * x - sine * y, frame.y + sine * x + cosine * y])
