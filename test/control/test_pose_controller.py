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
"""Pose loop E22: the Lyapunov function decreases, from any pose and on any reference."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.control.pose_controller import (
    PoseController,
    PoseLoopParameters,
    PoseReference,
    follow_pose,
    pose_error,
)
from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, BodyTwist, Pose, State, wrap_angle
from t3mpc_ros.parameters.table import ParameterError

PARAMETERS = PoseLoopParameters(enabled=True)
DT = 0.004


def _lyapunov(error):
    return 0.5 * (error.along**2 + error.across**2 + error.yaw**2 / PARAMETERS.gain_across)


def _reference_twist(kind, time):
    return {
        'straight': BodyTwist(0.2, 0.0),
        'arc': BodyTwist(0.2, 1.0),
        'backwards': BodyTwist(-0.2, 0.3),
        'varying': BodyTwist(0.15 + 0.1 * math.sin(time), 2.0 * math.cos(1.7 * time)),
    }[kind]


@pytest.mark.parametrize('kind', ['straight', 'backwards', 'varying'])
@pytest.mark.parametrize('seed', few_of(range(5), 2))
@pytest.mark.slow
def test_errors_vanish_and_never_grow(kind, seed):
    """V decreases along every motion, whatever the pose at its start; the error vanishes."""
    generator = np.random.default_rng(seed)
    pose = Pose(*generator.uniform(-1.0, 1.0, 2).tolist(), float(generator.uniform(-3.1, 3.1)))
    reference = Pose(0.0, 0.0, 0.0)
    values = []
    for step in range(round(30.0 / DT)):
        twist = _reference_twist(kind, step * DT)
        error = pose_error(reference, pose)
        values.append(_lyapunov(error))
        pose = advance_pose(pose, follow_pose(error, twist, PARAMETERS), DT)
        reference = advance_pose(reference, twist, DT)
    assert np.diff(values).max() < 1e-6
    assert values[-1] < 1e-6 * values[0] + 1e-12


@pytest.mark.parametrize('distance', few_of([2.0, 0.5]))
@pytest.mark.parametrize('bearing', [0.0, 1.5, 3.0])
def test_robot_rejoins_a_moving_reference(distance, bearing):
    """From far away, in any direction, the robot reaches a reference that drives on."""
    controller = PoseController(PARAMETERS)
    reference = Pose(0.0, 0.0, 0.0)
    pose = Pose(distance * math.cos(bearing), distance * math.sin(bearing), 2.0)
    for _ in range(round(40.0 / DT)):
        twist = BodyTwist(0.2, 0.5)
        command = controller.step(reference, pose, twist)
        assert not controller.rejoining or 0.0 <= command.linear <= PARAMETERS.rejoin_speed + 1e-9
        pose = advance_pose(pose, command, DT)
        reference = advance_pose(reference, twist, DT)
    assert not controller.rejoining
    assert controller.error.distance < 1e-3


def test_reference_poses_are_interpolated_the_short_way_round():
    """Between yaws of 3 and -3 rad lies half a turn, not 0; a restart replaces later poses."""
    poses = PoseReference(capacity=4)
    assert poses.at(0) is None
    for k in range(20):
        poses.add(State(k * 10, Pose(float(k), 0.0, 3.0 if k % 2 else -3.0), STANDSTILL))
    assert poses.at(185).x == pytest.approx(18.5)
    assert abs(wrap_angle(poses.at(185).yaw - math.pi)) < 1e-9
    assert poses.at(1000).x == 19.0
    poses.add(State(170, Pose(-1.0, 0.0, 0.0), STANDSTILL))
    assert poses.at(1000).x == -1.0


def _offset(parameters, bend, speed=0.2, seconds=30.0):
    """Return the error across at the end of a line, by wheels that bend the path (1/m)."""
    controller, reference, pose = PoseController(parameters), Pose(0.0, 0.0, 0.0), ORIGIN
    for _ in range(round(seconds / DT)):
        twist = BodyTwist(speed, 0.0)
        linear, angular = controller.step(reference, pose, twist, DT)
        pose = advance_pose(pose, BodyTwist(linear, angular + bend * linear), DT)
        reference = advance_pose(reference, twist, DT)
    return controller.error.across


@pytest.mark.parametrize('speed', [0.2, -0.2])
def test_wheels_that_differ_leave_no_offset(speed):
    """2 % of a wheel bend the path by 0.136 1/m: the robot drove 2.3 mm beside it."""
    bend = 0.02 / 0.147
    without = replace(PARAMETERS, gain_integral=0.0)
    assert abs(_offset(without, bend, speed)) == pytest.approx(bend / 60.0, rel=1e-3)
    assert abs(_offset(PARAMETERS, bend, speed)) < 1e-6


def test_the_loop_with_integral_is_stable_below_its_bound():
    """By eigenvalues over the distance, for random gains on both sides of the bound."""
    generator = np.random.default_rng(4)
    for _ in range(100):
        across, yaw, speed = 10.0 ** generator.uniform([0.0, -1.0, -2.0], [3.0, 1.5, 0.5])
        share = float(generator.choice([0.9, 1.1]))
        integral = share * across * yaw / speed
        loop = np.array([[0.0, 1.0, 0.0], [-across, -yaw / speed, -1.0], [integral, 0.0, 0.0]])
        assert (np.linalg.eigvals(loop).real.max() < 0.0) == (share < 1.0)
    with pytest.raises(ParameterError, match='gain_integral'):
        PoseLoopParameters(gain_across=10.0, gain_yaw=1.0, gain_integral=31.0)
    assert PoseLoopParameters(gain_across=0.0, gain_integral=0.0).gain_across == 0.0


@pytest.mark.parametrize('seed', few_of(range(3)))
def test_errors_vanish_with_the_integral_from_any_pose(seed):
    generator = np.random.default_rng(seed)
    pose = Pose(*generator.uniform(-1.0, 1.0, 2).tolist(), float(generator.uniform(-3.1, 3.1)))
    controller, reference = PoseController(PARAMETERS), Pose(0.0, 0.0, 0.0)
    for step in range(round(45.0 / DT)):
        twist = _reference_twist('arc' if seed else 'varying', step * DT)
        linear, angular = controller.step(reference, pose, twist, DT)
        pose = advance_pose(pose, BodyTwist(linear, angular + 0.1 * linear), DT)
        reference = advance_pose(reference, twist, DT)
    assert controller.error.distance < 2e-4


def test_the_integral_neither_winds_up_nor_learns_from_a_detour():
    """Beside its path, on its way back and while something holds it the robot learns nothing."""
    controller = PoseController(PARAMETERS)

    def curvature(across, seconds=10.0, **options):
        for _ in range(round(seconds / DT)):
            twist = controller.step(
                Pose(0.0, across, 0.0), ORIGIN, BodyTwist(0.25, 0.0), DT, **options
            )
        assert all(map(math.isfinite, twist))
        return controller.curvature

    assert curvature(0.01, learn=False) == 0.0
    assert curvature(0.03) == 0.0
    assert curvature(0.5) == 0.0
    assert controller.rejoining
    assert curvature(0.01) == 0.3
    assert curvature(-0.01, 0.1) < 0.3
    controller.reset()
    assert controller.curvature == 0.0
