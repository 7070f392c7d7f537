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
"""Pose tracking: a covariance is that of poses that move; a beam corrects what it measures."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.types import ORIGIN, Pose
from t3mpc_ros.localization.distance_field import map_of_world
from t3mpc_ros.localization.pose_tracking import (
    DRIFT_DEVIATION,
    SCALE_DEVIATION,
    TRAVEL_VARIANCE,
    TURN_VARIANCE,
    YAW_VARIANCE,
    PoseTracker,
)
from t3mpc_ros.localization.range_model import Beams, RangeModel, RangeModelParameters
from t3mpc_ros.simulation.world import parse_world

WALLS = map_of_world(
    parse_world('walls: [{points: [[-1, -1], [1, -1], [1, 1], [-1, 1]], closed: true}]', 'box')
)
MODEL = RangeModel.of(RangeModelParameters(), 0.1)


def make_tracker(pose, covariance):
    tracker = PoseTracker(WALLS.field, MODEL, 8)
    tracker.begin(pose, covariance)
    return tracker


@pytest.mark.parametrize(('ahead', 'turn'), [(0.1, 0.3), (-0.1, -0.3), (0.0, 1.0), (0.1, 0.0)])
def test_the_covariance_is_that_of_poses_that_move(ahead, turn):
    begin, odometry, elapsed = Pose(0.2, -0.3, 0.7), Pose(3.0, 2.0, -3.0), 1.0
    covariance = 1e-4 * np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 1.0, 9.0]])
    moved = Pose(
        3.0 + ahead * math.cos(-3.0), 2.0 + ahead * math.sin(-3.0), odometry.yaw + turn - math.tau
    )
    tracker = make_tracker(begin, covariance)
    tracker.predict(odometry, moved, elapsed)
    generator = np.random.default_rng(1)
    x, y, yaw = generator.multivariate_normal(begin, covariance, 100_000).T
    drift, scale, *noise = generator.standard_normal((5, x.size))
    travel = ahead * (1.0 + SCALE_DEVIATION * scale)
    across = math.sqrt(TRAVEL_VARIANCE * abs(ahead))
    x, y = x + travel * np.cos(yaw) + across * noise[0], y + travel * np.sin(yaw)
    y += across * noise[1]
    yaw = yaw + turn + elapsed * DRIFT_DEVIATION * drift
    yaw += math.sqrt(YAW_VARIANCE * abs(ahead) + TURN_VARIANCE * abs(turn)) * noise[2]
    assert tracker.pose == pytest.approx((x.mean(), y.mean(), yaw.mean()), abs=1e-3)
    assert tracker.covariance == pytest.approx(np.cov([x, y, yaw]), abs=2e-5)


def test_a_beam_corrects_what_it_measures():
    """Straight to the wall in front it tells x, and neither y nor the yaw."""
    tracker = make_tracker(Pose(0.5, 0.0, 0.0), np.diag([1e-2, 1e-2, 1e-4]))
    before = tracker.covariance
    beams = Beams(np.zeros((20, 3)), np.full(20, 0.45), np.tile([0.1, 0.8], (20, 1)))
    tracker.correct(beams, 0)
    assert tracker.pose.x == pytest.approx(0.55, abs=0.02)
    assert tracker.pose[1:] == pytest.approx((0.0, 0.0), abs=1e-3)
    after = tracker.covariance
    assert after[0, 0] < 0.1 * before[0, 0]
    assert np.diag(after)[1:] == pytest.approx(np.diag(before)[1:], rel=0.05)


@pytest.mark.parametrize('reading', [math.inf, -math.inf, 0.2])
def test_readings_of_something_else_end_the_tracking(reading):
    tracker = make_tracker(Pose(0.5, 0.0, 0.0), 1e-6 * np.eye(3))
    beams = Beams(np.zeros((20, 3)), np.full(20, reading), np.tile([0.1, 0.8], (20, 1)))
    for _ in range(2):
        assert tracker.active
        tracker.correct(beams, 0)
        tracker.compare(tracker.pose, beams, 0.1)
    assert not tracker.active


def test_a_pose_that_explains_the_readings_better_ends_it():
    tracker = make_tracker(ORIGIN, 1e-4 * np.eye(3))
    seen = Beams(np.zeros((1, 3)), np.array([0.5]), np.array([[0.1, 0.8]]))
    for elapsed, ends in ((10.0, False), (0.1, True)):  # evidence of long ago is forgotten
        for _ in range(20):
            tracker.compare(Pose(0.5, 0.0, 0.0), seen, elapsed)
        assert tracker.active is not ends
