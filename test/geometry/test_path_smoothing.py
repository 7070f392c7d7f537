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
"""Smoothing of paths: never beyond the tolerance, and as fast as the path without its sampling."""

import itertools
import math

import numpy as np
import pytest

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_smoothing import (
    LEAST_TOLERANCE,
    PIECE,
    SmoothedPath,
    join_curve,
    local_times,
)
from t3mpc_ros.geometry.path_timing import MotionLimits, PathEnd, time_path
from t3mpc_ros.geometry.polyline import distance_to_path, polyline_length, resample
from t3mpc_ros.geometry.types import Pose

LIMITS, GEOMETRY = MotionLimits(), WheelGeometry()
TOLERANCE = 0.02


def line(spacing):
    along = np.linspace(0.0, 2.0, round(2.0 / spacing) + 1)
    return np.column_stack([along, np.zeros_like(along)])


def circle(spacing, radius=0.5):
    angle = np.linspace(0.0, math.tau, round(math.tau * radius / spacing) + 1)
    return radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def staircase(cell, steps):
    corners = [(cell * (n - n // 2), cell * (n // 2)) for n in range(2 * steps + 1)]
    return np.array(corners)


def noisy(points, deviation, seed=1):
    return points + np.random.default_rng(seed).normal(0.0, deviation, points.shape)


def smoothed(points, tolerance=TOLERANCE, **options):
    return np.vstack(list(SmoothedPath(points, tolerance, LIMITS, GEOMETRY, **options).pieces()))


def deviation(timed, points):
    """Return the largest distance of the motion from the path, and of the path from the motion."""
    driven = np.column_stack([timed.x, timed.y])
    dense = np.vstack([points, resample(points, 0.01)])
    return max(
        distance_to_path(driven[::3], points).max(), distance_to_path(dense, driven[::3]).max()
    )


@pytest.mark.compiled
@pytest.mark.parametrize('noise', [0.0, 0.002])
@pytest.mark.parametrize('spacing', [0.005, 0.05, 0.2])
@pytest.mark.parametrize('shape', [line, circle])
def test_sampling_and_noise_cost_at_most_a_tenth_of_the_time(shape, spacing, noise):
    """A circle of points every 5 cm took three times its time, a line with noise 27 times."""
    points = noisy(shape(spacing), noise)
    timed = time_path(smoothed(points), LIMITS, GEOMETRY)
    least = polyline_length(shape(0.005)) / LIMITS.linear
    least += LIMITS.linear / LIMITS.linear_acceleration
    assert timed.time[-1] < 1.1 * least
    assert deviation(timed, points) < TOLERANCE


@pytest.mark.compiled
def test_steps_of_a_grid_are_smoothed_within_the_tolerance():
    points = staircase(0.05, 28)
    timed = time_path(smoothed(points), LIMITS, GEOMETRY)
    assert deviation(timed, points) < TOLERANCE
    assert timed.time[-1] < 0.15 * time_path(points, LIMITS, GEOMETRY).time[-1]
    tight = time_path(smoothed(points, 0.01), LIMITS, GEOMETRY)
    assert deviation(tight, points) < 0.01
    assert tight.time[-1] > timed.time[-1]


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('tolerance', [LEAST_TOLERANCE, 0.015, 0.3])
def test_no_path_is_left_by_more_than_the_tolerance(seed, tolerance):
    """Corners of any angle, legs of any length, noise, and a place visited twice."""
    generator = np.random.default_rng(seed)
    corners = generator.uniform(-0.4, 0.4, (5, 2))
    points = np.vstack([corners, corners[2], resample(corners[:3], 0.03)])
    points[6:] += generator.normal(0.0, 0.002, points[6:].shape)
    found = smoothed(points, tolerance)
    assert distance_to_path(found, points).max() <= tolerance
    given = np.vstack([points, resample(points, 0.004)])
    assert distance_to_path(given, found).max() <= tolerance
    assert found[[0, -1]] == pytest.approx(points[[0, -1]], abs=1e-9)


def test_a_path_that_is_smooth_stays_as_it_is():
    angle = np.linspace(0.0, math.tau, 2001)
    points = np.column_stack([np.sin(angle), 0.5 * np.sin(2.0 * angle)])
    found = smoothed(points)
    assert distance_to_path(found[::10], points).max() < 2e-3
    assert distance_to_path(smoothed(circle(0.005)), circle(0.005)).max() < 5e-4


@pytest.mark.compiled
def test_a_robot_turns_where_the_path_turns_back():
    """A path that leads back on itself is not rounded: the robot stops at its far end."""
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    timed = time_path(smoothed(points), LIMITS, GEOMETRY)
    assert timed.x.max() > 1.0 - 2e-3
    assert abs(timed.y).max() < 1e-6
    assert timed.time[-1] < 1.01 * time_path(points, LIMITS, GEOMETRY).time[-1]


def test_pieces_make_up_the_whole():
    """A piece does not depend on where the smoothing begins, nor on how far it has come."""
    points = noisy(circle(0.02, 1.0), 0.002)
    path = SmoothedPath(points, TOLERANCE, LIMITS, GEOMETRY)
    whole = np.vstack(list(path.pieces()))
    assert len(whole) > 3 * PIECE
    for begin in (0.4, 0.5 * path.length, path.length):
        later = np.vstack(list(path.pieces(begin)))
        np.testing.assert_allclose(later, whole[-len(later) :], atol=1e-9)


def test_a_closed_path_has_no_seam():
    points = circle(0.05)
    path = smoothed(points, closed=True)
    twice = np.vstack([path, path[1:]])
    times = local_times(twice[None], LIMITS, GEOMETRY)[0]
    assert np.ptp(times[20:-20]) < 0.2 * times[20:-20].mean()


def test_the_beginning_of_an_endless_path_is_soon_known():
    """The cost of a piece is its own: a path of 1000 km has 200 million points."""
    points = noisy(line(0.005), 0.001)
    far = np.vstack([points, [[1e4, 0.0], [-1e4, 0.0]] * 25])
    first, second = itertools.islice(SmoothedPath(far, 0.02, LIMITS, GEOMETRY).pieces(), 2)
    assert len(first) == len(second) == PIECE


def test_without_tolerance_the_path_stays_as_given():
    points = staircase(0.05, 3)
    path = SmoothedPath(points, 0.0, LIMITS, GEOMETRY)
    np.testing.assert_array_equal(np.vstack(list(path.pieces())), points)
    np.testing.assert_array_equal(np.vstack(list(path.pieces(0.12))), points[3:])
    for wrong in (-0.01, 0.5 * LEAST_TOLERANCE):
        with pytest.raises(ValueError, match='tolerance'):
            SmoothedPath(points, wrong, LIMITS, GEOMETRY)


def test_a_joint_has_place_direction_and_curvature_of_both():
    """Between two places of a circle it is the circle, to a twentieth of a millimetre."""
    begin, end = (
        PathEnd(Pose(math.sin(a), 1.0 - math.cos(a), a), 1.0, moving=True) for a in (0.2, 0.5)
    )
    curve = np.vstack([[begin.pose[:2]], join_curve(begin, end)])
    assert curve[-1] == pytest.approx(end.pose[:2])
    assert np.abs(np.hypot(curve[:, 0], curve[:, 1] - 1.0) - 1.0).max() < 5e-5
    runs = np.diff(curve, axis=0)
    turns = np.diff(np.arctan2(runs[:, 1], runs[:, 0])) / np.hypot(*runs.T)[1:]
    assert turns[[0, -1]] == pytest.approx(1.0, abs=0.05)


def _end(x, y, yaw=0.0, *, moving=False):
    return PathEnd(Pose(x, y, yaw), moving=moving)


def test_a_path_is_joined_where_it_is_nearest_first():
    """On a closed path the beginning, at a crossing the branch that leads forward."""
    closed = SmoothedPath(circle(0.05), TOLERANCE, LIMITS, GEOMETRY)
    assert closed.nearest(_end(0.0, 0.0))[0] == pytest.approx(0.0, abs=1e-6)
    cross = np.array([[-1.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, -1.0]])
    path = SmoothedPath(cross, TOLERANCE, LIMITS, GEOMETRY)
    assert path.nearest(_end(0.0, 0.001, moving=True))[0] == pytest.approx(1.0, abs=0.01)
    downwards = path.nearest(_end(0.001, 0.0, -1.57, moving=True))
    assert downwards == pytest.approx((5.0, 0.001), abs=0.01)
    same = SmoothedPath(np.array([[1.0, 2.0]] * 2), TOLERANCE, LIMITS, GEOMETRY)
    assert same.nearest(_end(1.0, 1.0)) == (0.0, 1.0)
