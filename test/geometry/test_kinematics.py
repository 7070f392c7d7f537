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
"""Unicycle kinematics (1)-(3), poses, twists and states."""

import itertools
import math

import numpy as np
import pytest
from support.equations import pose_rate

from t3mpc_ros.geometry.kinematics import (
    WheelGeometry,
    advance_pose,
    twist_from_wheels,
    wheels_from_twist,
)
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, State, WheelSpeeds, wrap_angle
from t3mpc_ros.parameters.table import ParameterError

GEOMETRY = WheelGeometry()


def test_wheel_speeds_to_body_twist_and_back_is_the_identity():
    generator = np.random.default_rng(1)
    for _ in range(100):
        geometry = WheelGeometry(generator.uniform(0.01, 0.2), generator.uniform(0.05, 1.0))
        wheels = WheelSpeeds(*generator.uniform(-30.0, 30.0, 2))
        back = wheels_from_twist(twist_from_wheels(wheels, geometry), geometry)
        assert back == pytest.approx(wheels, rel=1e-12, abs=1e-12)


def test_one_turn_along_the_wheel_tracks_closes_the_circle():
    """E1: the printed (1) divides by twice the *separation* and closes after two turns only.

    The tracks are measured here without (1): on a circle of radius r the right wheel runs
    2 pi (r + b), the left one 2 pi (r - b).
    """
    radius, duration = 0.6, 7.0
    half = 0.5 * GEOMETRY.wheel_separation
    wheels = WheelSpeeds(
        math.tau * (radius + half) / GEOMETRY.wheel_radius / duration,
        math.tau * (radius - half) / GEOMETRY.wheel_radius / duration,
    )
    twist = twist_from_wheels(wheels, GEOMETRY)
    assert twist.angular * duration == pytest.approx(math.tau, rel=1e-12)
    assert twist.linear * duration == pytest.approx(math.tau * radius, rel=1e-12)
    end = advance_pose(ORIGIN, twist, duration)
    assert end == pytest.approx(ORIGIN, abs=1e-12)
    middle = advance_pose(ORIGIN, twist, 0.5 * duration)
    assert (middle.x, middle.y) == pytest.approx((0.0, 2.0 * radius), abs=1e-12)
    assert abs(middle.yaw) == pytest.approx(math.pi)


def test_pose_rate_is_the_derivative_of_the_exact_arc():
    generator = np.random.default_rng(2)
    small = 1e-6
    for _ in range(50):
        wheels = WheelSpeeds(*generator.uniform(-10.0, 10.0, 2))
        pose = Pose(*generator.uniform(-1.0, 1.0, 2), generator.uniform(-3.0, 3.0))
        twist = twist_from_wheels(wheels, GEOMETRY)
        ahead, behind = advance_pose(pose, twist, small), advance_pose(pose, twist, -small)
        slope = (np.array(ahead) - np.array(behind)) / (2.0 * small)
        assert slope == pytest.approx(pose_rate(pose.yaw, wheels, GEOMETRY), abs=1e-8)


def test_arcs_compose_for_any_subdivision():
    generator = np.random.default_rng(3)
    for _ in range(50):
        pose = Pose(*generator.uniform(-2.0, 2.0, 3))
        twist = BodyTwist(*generator.uniform(-3.0, 3.0, 2))
        cuts = np.diff(np.concatenate([[0.0], np.sort(generator.uniform(0.0, 2.0, 6)), [2.0]]))
        walked = pose
        for cut in cuts:
            walked = advance_pose(walked, twist, float(cut))
        whole = advance_pose(pose, twist, 2.0)
        assert walked[:2] == pytest.approx(whole[:2], abs=1e-12)
        assert wrap_angle(walked.yaw - whole.yaw) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize('angular', [0.0, 1e-300, 1e-12, 1e-6, -1e-3])
def test_nearly_straight_motion_has_full_accuracy(angular):
    # The textbook form r (sin(P + w t) - sin P) loses all digits here.
    end = advance_pose(ORIGIN, BodyTwist(2.0, angular), 1.5)
    turn = 1.5 * angular
    assert end.x == pytest.approx(3.0 * (1.0 - turn**2 / 6.0), rel=1e-12)
    assert end.y == pytest.approx(3.0 * (turn / 2.0 - turn**3 / 24.0), rel=1e-12, abs=1e-300)


def test_wrapped_angles_are_equivalent_and_in_range():
    generator = np.random.default_rng(4)
    for angle in [*generator.uniform(-1e3, 1e3, 200), math.pi, -math.pi, 3.0 * math.pi, 0.0]:
        wrapped = wrap_angle(float(angle))
        assert -math.pi < wrapped <= math.pi
        assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
        assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)
    assert wrap_angle(-math.pi) == math.pi


def test_a_state_with_a_non_finite_number_is_not_finite():
    numbers = [0.1, 0.2, 0.3, 0.4, 0.5]
    assert State(0, Pose(*numbers[:3]), BodyTwist(*numbers[3:])).is_finite()
    assert State(0, Pose(1e8, -1e8, 0.0), BodyTwist(0.0, 0.0)).is_finite()
    for bad, place in itertools.product((math.nan, math.inf, -math.inf, -1e308), range(5)):
        wrong = [*numbers[:place], bad, *numbers[place + 1 :]]
        assert not State(0, Pose(*wrong[:3]), BodyTwist(*wrong[3:])).is_finite()


def test_a_geometry_of_zero_size_is_rejected():
    with pytest.raises(ParameterError, match='wheel_radius'):
        WheelGeometry(wheel_radius=0.0)
    with pytest.raises(ParameterError, match='wheel_separation'):
        WheelGeometry(wheel_separation=-0.1)
