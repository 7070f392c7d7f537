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
"""Wheel odometry: pose and covariance from the wheel angles."""

from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import ORIGIN, Array, Pose, WheelSpeeds, check_pose
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class WheelOdometryParameters(Parameters):
    """Error growth of the wheel odometry."""

    variance_per_metre: float = parameter(
        1e-5, 'variance of the travel of a wheel per metre', 'm²/m', (0.0, 1.0), dynamic=True
    )


@kernel
def wrap_to_pi(angle: float) -> float:
    """Return ``angle`` (rad) wrapped into (-pi, pi]; an angle in that range stays bit-equal."""
    if angle > math.pi or angle <= -math.pi:
        angle -= 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))
    return angle


@kernel
def integrate_arc(
    pose: Array, run_right: float, run_left: float, half: float
) -> tuple[float, float, float, float, float, float, float]:
    """Move ``pose`` along the exact arc of (1)-(3); return the derivatives of its end.

    These are d(x, y) by the yaw at the start (m); d(x, y) by the right travel, by the left travel;
    d yaw by the right travel (1/m), the negative of that by the left one. ``half`` is b (E1), m.
    """
    run = 0.5 * (run_right + run_left)
    half_turn = 0.25 * (run_right - run_left) / half
    if abs(half_turn) > 1e-4:
        ratio = math.sin(half_turn) / half_turn
        ratio_rate = (math.cos(half_turn) - ratio) / half_turn
    else:
        ratio = 1.0 - half_turn * half_turn / 6.0
        ratio_rate = -half_turn / 3.0
    direction = pose[2] + half_turn
    cosine, sine = math.cos(direction), math.sin(direction)

    pose[0] += run * ratio * cosine
    pose[1] += run * ratio * sine
    pose[2] = wrap_to_pi(pose[2] + 2.0 * half_turn)

    bend = 0.25 / half
    along, aside = run * ratio_rate * bend, run * ratio * bend
    return (
        -run * ratio * sine,
        run * ratio * cosine,
        (0.5 * ratio + along) * cosine - aside * sine,
        (0.5 * ratio + along) * sine + aside * cosine,
        (0.5 * ratio - along) * cosine + aside * sine,
        (0.5 * ratio - along) * sine - aside * cosine,
        2.0 * bend,
    )


@kernel
def add_noise(covariance: Array, variance: float, x: float, y: float, yaw: float) -> None:
    """Add the noise of a scalar with ``variance`` that moves the pose by these factors."""
    effect = (x, y, yaw)
    for row in range(3):
        for column in range(3):
            covariance[row, column] += variance * effect[row] * effect[column]


@kernel
def dead_reckon(
    pose: Array,
    covariance: Array,
    right: float,
    left: float,
    radius: float,
    half: float,
    per_metre: float,
    jitter: float,
) -> None:
    """Update ``pose`` by two wheel angles along the exact arc of (1)-(3), and its covariance.

    The travels of the wheels are independent, each with variance
    ``per_metre |travel| + radius² jitter``; the covariance becomes F C F' + G V G' with the exact
    derivatives F by the pose and G by the travels.
    """
    run_right, run_left = radius * right, radius * left
    across_x, across_y, right_x, right_y, left_x, left_y, bend = integrate_arc(
        pose, run_right, run_left, half
    )
    # C <- F C F', with F the identity but for its third column, (across_x, across_y, 1).
    for column in range(3):
        covariance[0, column] += across_x * covariance[2, column]
        covariance[1, column] += across_y * covariance[2, column]
    for row in range(3):
        covariance[row, 0] += across_x * covariance[row, 2]
        covariance[row, 1] += across_y * covariance[row, 2]

    constant = radius * radius * jitter
    add_noise(covariance, per_metre * abs(run_right) + constant, right_x, right_y, bend)
    add_noise(covariance, per_metre * abs(run_left) + constant, left_x, left_y, -bend)


class WheelOdometry:
    """Pose and covariance from measured wheel angles or speeds.

    Commands are never integrated: after a timeout the robot stops despite its last command.

    parameters : replaceable at run time
    geometry : nominal R and 2b
    """

    def __init__(self, parameters: WheelOdometryParameters, geometry: WheelGeometry) -> None:
        self.parameters = parameters
        self._geometry = geometry
        self._pose: Array = np.zeros(3)
        self._covariance: Array = np.zeros((3, 3))

    @property
    def pose(self) -> Pose:
        """Estimated pose."""
        return Pose(float(self._pose[0]), float(self._pose[1]), float(self._pose[2]))

    @property
    def covariance(self) -> Array:
        """Copy of the covariance of (x, y, yaw), shape (3, 3), m², m rad, rad²."""
        return self._covariance.copy()

    def reset(self, pose: Pose = ORIGIN) -> None:
        """Set the pose, and the covariance to zero."""
        check_pose(pose)
        self._pose[:] = pose
        self._covariance[:] = 0.0

    def update(self, right: float, left: float, jitter: float = 0.0) -> None:
        """Add the angles (rad) by which the wheels turned since the last call.

        ``jitter`` is a variance (rad²) of each angle that does not depend on the travel.
        With step counters a lost report costs no accuracy.
        Values that do not fit raise ValueError and change nothing.
        """
        if not (math.isfinite(right) and math.isfinite(left) and math.isfinite(jitter)):
            raise ValueError(f'wheel angles must be finite: got {right}, {left}, {jitter}')
        geometry = self._geometry
        dead_reckon(
            self._pose,
            self._covariance,
            float(right),
            float(left),
            geometry.wheel_radius,
            geometry.half_separation,
            self.parameters.variance_per_metre,
            float(jitter),
        )

    def update_from_speeds(self, wheels: WheelSpeeds, dt: float, variance: float = 0.0) -> None:
        """Add ``dt`` seconds at constant measured speeds, each with ``variance`` ((rad/s)²)."""
        self.update(wheels.right * dt, wheels.left * dt, variance * dt * dt)
