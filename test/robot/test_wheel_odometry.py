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
"""Wheel odometry: pose and covariance."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.kinematics import (
    WheelGeometry,
    advance_pose,
    twist_from_wheels,
    wheels_from_twist,
)
from t3mpc_ros.geometry.types import BodyTwist, Pose, WheelSpeeds, wrap_angle
from t3mpc_ros.robot.wheel_odometry import WheelOdometry, WheelOdometryParameters

GEOMETRY = WheelGeometry()


def make_odometry(per_metre: float = 1e-5) -> WheelOdometry:
    return WheelOdometry(WheelOdometryParameters(variance_per_metre=per_metre), GEOMETRY)


def test_pose_follows_the_exact_arcs():
    generator = np.random.default_rng(1)
    odometry, pose = make_odometry(), Pose(0.0, 0.0, 0.0)
    for _ in range(100):
        wheels = WheelSpeeds(*generator.uniform(-10.0, 10.0, 2))
        dt = float(generator.uniform(0.0, 0.5))
        odometry.update_from_speeds(wheels, dt)
        pose = advance_pose(pose, twist_from_wheels(wheels, GEOMETRY), dt)
        assert odometry.pose[:2] == pytest.approx(pose[:2], abs=1e-10)
        assert wrap_angle(odometry.pose.yaw - pose.yaw) == pytest.approx(0.0, abs=1e-10)
        assert -math.pi < odometry.pose.yaw <= math.pi


@pytest.mark.parametrize('angular', [0.0, 1e-4, 2e-3])
def test_nearly_straight_motion_keeps_full_accuracy(angular):
    odometry = make_odometry()
    odometry.update_from_speeds(wheels_from_twist(BodyTwist(0.5, angular), GEOMETRY), 0.1)
    expected = advance_pose(Pose(0.0, 0.0, 0.0), BodyTwist(0.5, angular), 0.1)
    assert odometry.pose == pytest.approx(expected, rel=1e-9, abs=1e-16)


def test_covariance_update_uses_exact_arc_derivatives():
    generator = np.random.default_rng(2)
    small = 1e-6
    for case in range(15):
        right, left = generator.uniform(-3.0, 3.0, 2)
        if case < 5:
            left = right + 1e-6  # nearly straight: the series applies
        per_metre = 1e-4
        odometry = make_odometry(per_metre)
        odometry.reset(Pose(0.3, -0.1, generator.uniform(-1.0, 1.0)))
        odometry.update(*generator.uniform(-2.0, 2.0, 2))
        pose, before = odometry.pose, odometry.covariance

        def end(numbers):
            start = Pose(*numbers[:3])
            wheels = WheelSpeeds(
                numbers[3] / GEOMETRY.wheel_radius, numbers[4] / GEOMETRY.wheel_radius
            )
            reached = advance_pose(start, twist_from_wheels(wheels, GEOMETRY), 1.0)
            return np.array([reached.x, reached.y, reached.yaw])

        runs = GEOMETRY.wheel_radius * np.array([right, left])
        at = np.array([*pose, *runs])
        columns = []
        for axis in np.eye(5):
            change = end(at + small * axis) - end(at - small * axis)
            change[2] = wrap_angle(change[2])
            columns.append(change / (2.0 * small))
        jacobian = np.array(columns).T
        uncertain = np.zeros((5, 5))
        uncertain[:3, :3] = before
        uncertain[3:, 3:] = np.diag(per_metre * np.abs(runs))
        odometry.update(right, left)
        expected = jacobian @ uncertain @ jacobian.T
        assert odometry.covariance == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_covariance_of_nearly_straight_motion_follows_the_series():
    # From yaw 0 an arc ends at x = s sin(2h)/(2h), h half the turn; here h is below 1e-4.
    half_turn, run, per_metre = 0.9e-4, 10.0, 1e-4
    runs = run + half_turn * GEOMETRY.wheel_separation * np.array([1.0, -1.0])
    odometry = make_odometry(per_metre)
    odometry.update(*(runs / GEOMETRY.wheel_radius))
    ratio, slope = 1.0 - (2.0 * half_turn) ** 2 / 6.0, -4.0 * half_turn / 3.0
    bend = np.array([0.5, -0.5]) / GEOMETRY.wheel_separation
    effects = 0.5 * ratio + run * slope * bend
    expected = float(np.sum(per_metre * runs * effects**2))
    assert odometry.covariance[0, 0] == pytest.approx(expected, rel=1e-6)


def test_speed_noise_adds_variance_at_standstill():
    odometry = make_odometry(0.0)
    for _ in range(100):
        odometry.update_from_speeds(WheelSpeeds(0.0, 0.0), 0.01, variance=0.04)
    per_wheel = 100 * (GEOMETRY.wheel_radius * 0.01) ** 2 * 0.04
    assert odometry.covariance[2, 2] == pytest.approx(
        2.0 * per_wheel / GEOMETRY.wheel_separation**2, rel=1e-9
    )


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_non_finite_input_is_rejected_without_side_effects(bad):
    odometry = make_odometry()
    odometry.update(1.0, 2.0)
    before = odometry.pose
    for arguments in ((bad, 0.0), (0.0, bad), (0.0, 0.0, bad)):
        with pytest.raises(ValueError, match='finite'):
            odometry.update(*arguments)
    with pytest.raises(ValueError, match='finite'):
        odometry.reset(Pose(0.0, bad, 0.0))
    assert odometry.pose == before
    odometry.reset(Pose(1.0, 2.0, 0.5))
    odometry.covariance[0, 0] = 7.0  # a copy
    assert odometry.pose == (1.0, 2.0, 0.5)
    assert not odometry.covariance.any()
