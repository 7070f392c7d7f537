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
"""Timing of paths: limits hold on any path, the motion is that of a unicycle, cusps included."""

import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming, time_path
from t3mpc_ros.geometry.polyline import PathError, distance_to_path
from t3mpc_ros.geometry.types import Pose

GEOMETRY = WheelGeometry()
PERIOD = 0.01
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])


def _eight():
    along = np.linspace(0.0, 2.0 * np.pi, 400)
    return np.column_stack([np.sin(along), 0.5 * np.sin(2.0 * along)])


def _cusp():
    along = np.linspace(-1.0, 1.0, 401)
    return np.column_stack([along**2, along**3])


def _random_corners(seed):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (12, 2))


def _random_curve(seed):
    """Return a curve of random Fourier coefficients: of any curvature, also nearly cusps."""
    generator = np.random.default_rng(seed)
    along = np.linspace(0.0, 2.0 * np.pi, 800)
    waves = np.array([[np.sin(k * along), np.cos(k * along)] for k in range(1, 6)])
    return np.einsum('xkw,kwn->nx', generator.normal(0.0, 0.4, (2, 5, 2)), waves)


def _largest_changes(linear, angular):
    """Return speeds and largest changes in a period from rest: of v, omega and the wheels."""
    wheels = linear + np.outer([1.0, -1.0], GEOMETRY.half_separation * angular)
    speeds = linear, angular, wheels / GEOMETRY.wheel_radius
    return [(np.abs(v).max(), np.abs(np.diff(v, prepend=0.0)).max()) for v in speeds]


def _limits_of(limits):
    return (
        (limits.linear, limits.linear_acceleration),
        (limits.angular, limits.angular_acceleration),
        (limits.wheel_speed, limits.wheel_acceleration),
    )


PATHS = {
    'line': np.array([[0.0, 0.0], [2.0, 0.0]]),
    'square': SQUARE,
    'eight': _eight(),
    'cusp': _cusp(),
    'turn back': np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]),
    'corners 1': _random_corners(1),
    'curve 1': _random_curve(1),
    'corners 2': _random_corners(2),
    'curve 2': _random_curve(2),
}
NAMES = few_of(PATHS, 7)


@pytest.mark.compiled
@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize(
    'limits',
    [MotionLimits(), MotionLimits(linear=0.6, angular=1.0, angular_acceleration=1.5)],
    ids=['default', 'slow turns'],
)
@pytest.mark.slow
def test_timing_keeps_every_limit(name, limits):
    """Speeds, accelerations and those of both wheels, between any two samples."""
    path = time_path(PATHS[name], limits, GEOMETRY, PERIOD)
    found = _largest_changes(path.linear, path.angular)
    for (speed, change), (top, acceleration) in zip(found, _limits_of(limits), strict=True):
        assert speed <= top
        assert change <= acceleration * PERIOD
    assert (path.linear[[0, -1]] == 0.0).all()
    assert (path.angular[[0, -1]] == 0.0).all()


@pytest.mark.compiled
@pytest.mark.parametrize('name', NAMES)
@pytest.mark.slow
def test_a_path_that_waits_keeps_every_limit(name):
    """The rate of its time changes at random, to a stop and back, also at cusps and corners."""
    limits, generator = MotionLimits(), np.random.default_rng(8)
    timing = PathTiming(limits, GEOMETRY, PERIOD)
    timing.add_points(PATHS[name])
    timing.finish()
    rows, rates, wanted = [], [], 1.0
    while not timing.finished:
        if generator.random() < 0.03:
            wanted = float(generator.choice([0.0, generator.uniform(), 1.0, 1.0]))
        pose, twist = timing.advance(wanted)
        rows.append((*pose, *twist))
        rates.append(timing.rate)
    x, y, yaw, linear, angular = np.array(rows).T
    found = _largest_changes(linear, angular)
    for (_, change), (_, acceleration) in zip(found, _limits_of(limits), strict=True):
        assert change <= acceleration * PERIOD * (1 + 1e-9)
    assert min(rates) == 0.0
    assert max(rates) == 1.0
    # The twists are those of the poses, and the curve is that of a path that does not wait.
    whole = time_path(PATHS[name], limits, GEOMETRY, PERIOD)
    curve = np.column_stack([whole.x, whole.y])
    assert distance_to_path(np.column_stack([x, y])[::100], curve[::5]).max() < 2e-3
    steps = np.diff(x) * np.cos(yaw[:-1]) + np.diff(y) * np.sin(yaw[:-1])
    assert np.abs(steps - PERIOD * linear[:-1]).max() < 5e-5
    assert len(rows) > 1.1 * len(whole.time)


@pytest.mark.compiled
@pytest.mark.parametrize('name', NAMES)
@pytest.mark.slow
def test_poses_follow_path_and_twists(name):
    """The poses lie on the path within 2 mm, and are the integral of the twists (2)."""
    points = PATHS[name]
    path = time_path(points, MotionLimits(), GEOMETRY, PERIOD)
    poses = np.column_stack([path.x, path.y])
    assert distance_to_path(poses, points).max() < 2e-3
    assert distance_to_path(points, poses).max() < 2e-3
    assert poses[-1] == pytest.approx(points[-1], abs=2e-3)
    ahead = 0.5 * (path.linear[1:] + path.linear[:-1]) * PERIOD
    yaw = 0.5 * (path.yaw[1:] + path.yaw[:-1])
    steps = np.column_stack([ahead * np.cos(yaw), ahead * np.sin(yaw)])
    assert np.abs(np.diff(poses, axis=0) - steps).max() < 2e-4
    turned = 0.5 * (path.angular[1:] + path.angular[:-1]) * PERIOD
    assert np.abs(np.diff(path.yaw) - turned).max() < 2e-3


def test_straight_line_takes_the_least_time():
    """A trapezoid of speed is the fastest motion: length / v + v / a, at the planned share."""
    limits = MotionLimits()
    speed, acceleration = 0.97 * limits.linear, 0.97 * limits.linear_acceleration
    path = time_path(PATHS['line'], limits, GEOMETRY, PERIOD)
    assert path.time[-1] == pytest.approx(2.0 / speed + speed / acceleration, abs=0.03)


def test_robot_stops_and_turns_at_a_cusp():
    """At the cusp of y² = x³ the robot turns by half a turn while it hardly moves."""
    path = time_path(_cusp(), MotionLimits(), GEOMETRY, PERIOD)
    near = np.hypot(path.x, path.y) < 2e-3
    assert np.ptp(path.yaw[near]) > 0.8 * math.pi
    assert path.linear[near].max() < 0.06


@pytest.mark.compiled
def test_growing_path_gives_the_same_motion():
    """Points may arrive while the robot drives: the motion is that of the known path."""
    whole = time_path(_eight(), MotionLimits(), GEOMETRY, PERIOD)
    timing = PathTiming(MotionLimits(), GEOMETRY, PERIOD)
    points, rows = _eight(), []
    while not timing.finished:
        while timing.needs_points and len(points):
            timing.add_points(points[:10])
            points = points[10:]
        if not len(points):
            timing.finish()
        pose, twist = timing.advance()
        rows.append((*pose, *twist))
    count = min(len(rows), len(whole.x))
    assert abs(len(rows) - len(whole.x)) < 5
    table = np.array(rows)[:count]
    gap = np.hypot(table[:, 0] - whole.x[:count], table[:, 1] - whole.y[:count])
    assert gap.max() < 2e-3


def test_late_points_stop_the_robot_in_time():
    """A path whose next point is late ends in a stop within the limits, and then goes on."""
    limits = MotionLimits()
    timing = PathTiming(limits, GEOMETRY, PERIOD)
    timing.add_points(np.array([[0.0, 0.0], [1.0, 0.0]]))
    timing.drive_to_last_point()
    speeds = [timing.advance()[1].linear for _ in range(800)]
    timing.add_points(np.array([[2.0, 0.0]]))
    timing.finish()
    while not timing.finished:
        speeds.append(timing.advance()[1].linear)
    assert speeds[799] == 0.0
    assert max(speeds[:800]) > 0.9 * limits.linear
    assert max(speeds[800:]) > 0.9 * limits.linear
    assert np.abs(np.diff(speeds)).max() <= limits.linear_acceleration * PERIOD


@pytest.mark.compiled
def test_a_path_that_grows_after_a_rest_begins_at_rest():
    """Where the rest came in the last part of a plan, it began at the speeds of long before."""
    for length in np.arange(0.9, 1.3, 0.04):
        timing = PathTiming(MotionLimits(), GEOMETRY, 0.05)
        along = np.linspace(0.0, length, 100)
        speeds = []
        for begin in (0.0, length):
            timing.add_points(np.column_stack([begin + along, np.zeros(100)])[int(begin > 0.0) :])
            while not (speeds and timing.standing and timing.arrived):
                speeds.append(timing.advance()[1].linear)
            speeds += [timing.advance()[1].linear for _ in range(2)]
        assert np.abs(np.diff(speeds)).max() <= MotionLimits().linear_acceleration * 0.05
        assert sum(speeds) * 0.05 == pytest.approx(2.0 * length, abs=0.03)


def test_start_pose_is_left_at_rest():
    """From another pose the robot turns towards the path, and drives to it."""
    start = Pose(-0.5, 0.2, 2.0)
    path = time_path(SQUARE, MotionLimits(), GEOMETRY, PERIOD, start)
    assert (path.x[0], path.y[0], path.yaw[0]) == pytest.approx(start, abs=1e-9)
    assert path.linear[0] == path.angular[0] == 0.0


def test_a_path_of_one_place_is_rejected():
    with pytest.raises(PathError, match='2 mm'):
        time_path(np.array([[1.0, 1.0], [1.0, 1.0005]]), MotionLimits(), GEOMETRY)
