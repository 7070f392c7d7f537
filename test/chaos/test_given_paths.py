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
"""Given paths: no limit is exceeded, nothing jumps, and they wait for the robot for a while."""

import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.chaos.pose_reference import (
    GivenPathSource,
    PathClock,
    PathReferenceParameters,
    PauseRamp,
    SmoothingParameters,
    TwistSource,
    WaitParameters,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming
from t3mpc_ros.geometry.polyline import PathError, distance_to_path
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, BodyTwist, Pose
from t3mpc_ros.parameters.table import ParameterError

GEOMETRY, PERIOD = WheelGeometry(), 0.01
PARAMETERS = PathReferenceParameters(source='topic')
LIMITS = PARAMETERS.motion
LINE = np.column_stack([np.linspace(0.0, 2.0, 41), np.zeros(41)])
ANGLE = np.linspace(0.0, math.tau, 63)
CIRCLE = 0.5 * np.column_stack([np.sin(ANGLE), 1.0 - np.cos(ANGLE)])
EIGHT = np.column_stack([np.sin(ANGLE), 0.5 * np.sin(2.0 * ANGLE)])
CUSP = np.column_stack([np.linspace(-1.0, 1.0, 101) ** 2, np.linspace(-1.0, 1.0, 101) ** 3])
STAIRS = np.array([(0.05 * (n - n // 2), 0.05 * (n // 2)) for n in range(41)])
TURN_BACK = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])


def drive(source, periods, rate=1.0):
    """Return poses and twists, shape (n, 5)."""
    return np.array(
        [(*pose, *twist) for pose, twist in (source.advance(rate) for _ in range(periods))]
    )


def check_motion(rows):
    """Assert every limit between any two samples, and that the poses are those of the twists."""
    linear, angular = rows[:, 3], rows[:, 4]
    wheels = linear + np.outer([1.0, -1.0], GEOMETRY.half_separation * angular)
    radius = GEOMETRY.wheel_radius
    for values, speed, acceleration in (
        (linear, LIMITS.linear, LIMITS.linear_acceleration),
        (angular, LIMITS.angular, LIMITS.angular_acceleration),
        (wheels / radius, LIMITS.wheel_speed, LIMITS.wheel_acceleration),
    ):
        assert np.abs(values).max() <= speed
        assert np.abs(np.diff(values)).max() <= acceleration * PERIOD * (1 + 1e-9)
    yaw = 0.5 * (rows[1:, 2] + rows[:-1, 2])
    ahead = 0.5 * PERIOD * (linear[1:] + linear[:-1])
    steps = np.column_stack([ahead * np.cos(yaw), ahead * np.sin(yaw)])
    assert np.abs(np.diff(rows[:, :2], axis=0) - steps).max() < 5e-4
    turns = np.diff(rows[:, 2]) - 0.5 * PERIOD * (angular[1:] + angular[:-1])
    assert np.abs(np.remainder(turns + math.pi, math.tau) - math.pi).max() < 5e-3


def random_path(generator, place):
    """Return a path of any kind, often beginning near a place."""
    shapes = (LINE, CIRCLE, EIGHT, CUSP, STAIRS, TURN_BACK, place[None], np.empty((0, 2)))
    kind = int(generator.integers(-1, len(shapes)))
    size = int(generator.integers(1, 10)), 2
    points = generator.uniform(-1.0, 1.0, size) if kind < 0 else shapes[kind].copy()
    points *= generator.uniform(0.05, 1.5)
    points += generator.normal(0.0, float(generator.choice([0.0, 0.002])), points.shape)
    if len(points) and generator.random() < 0.7:
        points += place - points[0] + generator.normal(0.0, 0.005, 2)
    return points


def replaced_at_random(seed, count):
    generator = np.random.default_rng(seed)
    source, rows, rate = GivenPathSource(PARAMETERS, GEOMETRY, Pose(0.1, 0.2, 0.3)), [], 1.0
    for _ in range(count):
        if generator.random() < 0.3:
            rate = float(generator.choice([0.0, generator.uniform(), 1.0, 1.0]))
        rows.append(drive(source, int(generator.choice([1, 5, 20, 100])), rate))
        points = random_path(generator, rows[-1][-1, :2])
        for _ in range(int(generator.integers(1, 3))):  # also two between two periods
            (source.append if generator.random() < 0.2 else source.replace)(points)
            points = random_path(generator, rows[-1][-1, :2])
    return np.vstack(rows)


@pytest.mark.compiled
@pytest.mark.parametrize('seed', few_of(range(4)))
def test_whatever_replaces_a_path_no_limit_is_exceeded(seed):
    """Paths of every kind, at any moment: in turns, at corners, while braking, at rest, paused."""
    check_motion(replaced_at_random(seed, 40))


@pytest.mark.long
@pytest.mark.compiled
@pytest.mark.parametrize('seed', range(10, 60))
def test_whatever_replaces_a_path_no_limit_is_exceeded_at_length(seed):
    check_motion(replaced_at_random(seed, 100))


@pytest.mark.compiled
@pytest.mark.parametrize('noise', [0.0, 0.002])
def test_a_planner_that_replans_does_not_slow_the_robot_down(noise):
    """Each 0.2 s the rest of a circle, from where the robot is: it went back to the beginning."""
    generator = np.random.default_rng(3)
    source, rows = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, CIRCLE), []
    for _ in range(25):
        rows.append(drive(source, 20))
        place = rows[-1][-1, :2]
        nearest = int(np.hypot(*(CIRCLE - place).T).argmin())
        rest = CIRCLE[nearest + 1 :] + generator.normal(0.0, noise, CIRCLE[nearest + 1 :].shape)
        source.replace(np.vstack([place + generator.normal(0.0, noise, 2), rest]))
    rows = np.vstack(rows)
    check_motion(rows)
    # The tolerance counts from the new path, which begins where the reference is.
    assert distance_to_path(rows[:, :2], CIRCLE).max() < (0.03 if noise else 0.01)
    assert rows[100:, 3].min() > 0.15
    assert rows[100:, 3].mean() > 0.22


def test_the_same_path_again_changes_nothing():
    """Neither under way nor at its end, where the robot would drive back to its beginning."""
    once, again = (GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE) for _ in range(2))
    expected, found = drive(once, 1100), []
    for _ in range(110):
        found.append(drive(again, 10))
        again.replace(LINE.copy())
    np.testing.assert_array_equal(np.vstack(found), expected)
    assert expected[-1, :2] == pytest.approx((2.0, 0.0), abs=1e-9)
    assert not once.under_way


def test_a_goal_that_is_reached_is_not_left_for_a_path_to_it():
    """A planner plans from where the robot is, some millimetres from its reference."""
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE)
    end = drive(source, 1000)[-1]
    source.replace(np.array([[1.996, 0.003], [2.0, 0.0]]))
    assert (drive(source, 100)[:, :3] == end[:3]).all()
    source.replace(np.array([[1.996, 0.003], [2.5, 0.0]]))
    rows = drive(source, 400)
    check_motion(np.vstack([end, rows]))
    assert rows[-1, :2] == pytest.approx((2.5, 0.0), abs=1e-9)
    assert np.abs(rows[:, 2]).max() < 0.1


@pytest.mark.compiled
def test_an_empty_path_stops_the_robot_within_the_limits():
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, CIRCLE)
    rows = [drive(source, 400)]
    source.replace(np.empty((0, 2)))
    rows.append(drive(source, 30))
    source.cancel()  # twice is as once
    rows.append(drive(source, 200))
    found = np.vstack(rows)
    check_motion(found)
    rest = np.flatnonzero(found[400:, 3] > 0.0)[-1] + 1
    assert rest * PERIOD < 1.2 * LIMITS.linear / LIMITS.linear_acceleration
    assert not source.under_way
    assert (found[400 + rest :, :3] == found[-1, :3]).all()
    # The rest of the path is forgotten, and the same path may be driven again.
    source.replace(CIRCLE)
    assert drive(source, 400)[-1, 3] > 0.0


@pytest.mark.compiled
@pytest.mark.parametrize('points', [[[1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0005]]])
def test_a_path_of_one_place_leads_there(points):
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, np.array(points))
    rows = drive(source, 900)
    check_motion(rows)
    assert rows[-1, :2] == pytest.approx((1.0, 1.0), abs=1e-3)
    assert tuple(rows[-1, 3:]) == STANDSTILL


@pytest.mark.parametrize(
    ('points', 'words'),
    [
        ([[0.0, 0.0], [math.nan, 1.0]], 'point 1 is'),
        ([[0.0, 2e4]], 'at most 10000 m: point 0'),
        ([[0.0, 0.0, 0.0]], 'shape'),
    ],
)
def test_a_path_that_is_refused_leaves_the_one_before(points, words):
    once, again = (GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE) for _ in range(2))
    expected, found = drive(once, 200), [drive(again, 100)]
    for change in (again.replace, again.append):
        with pytest.raises(PathError, match=words):
            change(np.array(points))
    found.append(drive(again, 100))
    np.testing.assert_array_equal(np.vstack(found), expected)


@pytest.mark.compiled
@pytest.mark.parametrize('spacing', [0.001])
def test_ten_thousand_points_are_a_path(spacing):
    along = spacing * np.arange(10_000)
    wave = np.column_stack([along, 0.3 * np.sin(along / max(1.0, 5.0 * spacing))])
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, wave)
    rows = drive(source, 1500)
    check_motion(rows)
    assert distance_to_path(rows[::20, :2], wave[:4000]).max() < PARAMETERS.path.tolerance
    assert rows[300:, 3].mean() > 0.9 * LIMITS.linear


@pytest.mark.compiled
def test_a_path_beside_is_joined_without_a_stop():
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE)
    rows = [drive(source, 300)]
    source.replace(LINE + [0.0, 0.2])
    rows.append(drive(source, 700))
    rows = np.vstack(rows)
    check_motion(rows)
    assert rows[100:600, 3].min() > 0.15
    assert rows[-1, :2] == pytest.approx((2.0, 0.2), abs=1e-6)


@pytest.mark.compiled
def test_a_path_back_is_joined_after_a_stop():
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE)
    rows = [drive(source, 300)]
    source.replace(LINE[::-1])
    rows.append(drive(source, 900))
    rows = np.vstack(rows)
    check_motion(rows)
    turned_at = rows[rows[:, 3] > 0.2][:, 0].max()
    assert rows[:, 0].max() < turned_at + 0.08
    assert np.abs(rows[:, 1]).max() < 1e-3
    assert rows[-1, :2] == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.compiled
@pytest.mark.parametrize('given', [LINE, CIRCLE], ids=['line', 'circle'])
def test_the_robot_can_stop_where_it_leaves_its_path(given):
    """The corner there changes the accelerations before it: braking was up to a quarter harder."""
    for periods in range(40, 340, 60):
        source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, given)
        rows = [drive(source, periods)]
        source.replace(rows[-1][-1, :2] + np.array([[-0.1, 0.0], [-0.5, 0.1]]))
        rows.append(drive(source, 150))
        check_motion(np.vstack(rows))


@pytest.mark.compiled
def test_an_end_right_behind_a_corner_is_reached_without_a_jump():
    """From rest to rest within one step of the grid: the robot stood, and then was there."""
    for length in np.arange(0.0025, 0.009, 0.0005).tolist():
        timing = PathTiming(LIMITS, GEOMETRY, PERIOD)
        timing.add_points(np.array([[0.0, 0.0], [0.2, 0.0], [0.2, length]]))
        timing.finish()
        rows = []
        while not timing.finished:
            pose, twist = timing.advance()
            rows.append((*pose, *twist))
        check_motion(np.array(rows))
        assert rows[-1][:2] == pytest.approx((0.2, length), abs=1e-3)


def test_a_path_that_comes_while_the_robot_waits_begins_there():
    """Stopped by an obstacle or paused, it does not drive on before it turns away."""
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE)
    rows = [drive(source, 300), drive(source, 100, rate=0.0)]
    rest = rows[-1][-1]
    source.replace(np.array([rest[:2], rest[:2] + [-0.5, 0.5]]))
    rows.append(drive(source, 100, rate=0.0))
    assert (rows[-1][:, :3] == rest[:3]).all()
    rows.append(drive(source, 700))
    rows = np.vstack(rows)
    check_motion(rows)
    assert rows[:, 0].max() < rest[0] + 1e-3
    assert rows[-1, :2] == pytest.approx(rest[:2] + [-0.5, 0.5], abs=1e-6)


@pytest.mark.compiled
def test_appended_paths_are_driven_one_after_the_other():
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, LINE)
    rows = [drive(source, 890)]  # while it brakes before the end
    source.append(LINE[::-1])
    source.append(LINE)
    rows.append(drive(source, 2400))
    rows = np.vstack(rows)
    check_motion(rows)
    turns = rows[np.flatnonzero(np.abs(rows[:, 4]) > 1.0), 0]
    assert {round(x) for x in turns.tolist()} == {0, 2}
    assert rows[-1, :2] == pytest.approx((2.0, 0.0), abs=1e-6)


def test_a_repeated_path_of_no_length_ends():
    points = np.array([[0.5, 0.0], [0.5005, 0.0]])
    source = GivenPathSource(PARAMETERS, GEOMETRY, ORIGIN, points, repeat=True)
    assert drive(source, 400)[-1, 0] == pytest.approx(0.5, abs=1e-3)


def test_a_tolerance_is_none_or_at_least_that_of_the_smoothing():
    assert SmoothingParameters(0.0).tolerance == 0.0
    with pytest.raises(ParameterError, match=r'path\.tolerance'):
        SmoothingParameters(0.001)


def test_a_timing_without_a_start_can_be_cut_before_it_begins():
    timing = PathTiming(MotionLimits(), GEOMETRY, PERIOD)
    timing.add_points(LINE)
    assert timing.cut().pose == ORIGIN


@pytest.mark.parametrize('twist', [BodyTwist(0.24, 0.0), BodyTwist(0.2, -4.0), STANDSTILL])
def test_a_pause_ramps_the_twist_down_and_up(twist):
    """Paused twice, resumed twice, and again before the ramp has ended."""
    ramp = PauseRamp(LIMITS, GEOMETRY, PERIOD)
    orders = [True] * 200 + [False] * 30 + [True] * 10 + [False] * 200
    found = np.array([ramp.step(twist, paused=paused) for paused in orders])
    changes = np.abs(np.diff(found, axis=0, prepend=np.array([twist])))
    assert (changes[:, 0] <= LIMITS.linear_acceleration * PERIOD * (1 + 1e-9)).all()
    assert (changes[:, 1] <= LIMITS.angular_acceleration * PERIOD * (1 + 1e-9)).all()
    wheels = changes @ [1.0, GEOMETRY.half_separation] / GEOMETRY.wheel_radius
    assert (wheels <= LIMITS.wheel_acceleration * PERIOD * (1 + 1e-9)).all()
    assert tuple(found[199]) == STANDSTILL
    assert tuple(found[-1]) == twist


PERIOD_NS = 10_000_000
WAIT = WaitParameters()
AWAY = Pose(-1.0, 0.0, 0.0)


def _rates(distances, parameters=WAIT, *, begin=AWAY, **options):
    """Return the rate after each distance of a robot from its reference.

    The robot comes from ``begin`` and is at the origin then.
    """
    clock, rates = PathClock(parameters, **options), []
    clock.add_reference(0, begin)
    clock.observe(0, begin)
    for k, distance in enumerate(distances, 1):
        clock.add_reference(k * PERIOD_NS, Pose(distance, 0.0, 0.0))
        clock.observe(k * PERIOD_NS, ORIGIN)
        rates.append(clock.rate)
    return np.array(rates)


def test_the_rate_falls_with_the_distance_without_a_step():
    distances = np.linspace(0.0, 2.5 * WAIT.distance, 200)[1:]
    rates = _rates(distances)
    assert (rates[distances <= WAIT.distance] == 1.0).all()
    assert (rates[distances >= 2.0 * WAIT.distance] == 0.0).all()
    assert np.abs(np.diff(rates)).max() < 0.02
    assert (_rates(distances, WaitParameters(distance=0.0)) == 1.0).all()


def test_the_path_waits_for_a_robot_that_approaches_slowly():
    """At 20 mm/s the way back takes much longer than the patience."""
    distances = np.arange(1.0, 2.0 * WAIT.distance, -2e-4)
    assert len(distances) * 0.01 > 10.0 * WAIT.patience
    assert (_rates(distances) == 0.0).all()


def test_the_path_leaves_an_obstacle_that_it_leads_through():
    """A reference inside an obstacle would wait forever for a robot that goes round it."""
    noise = np.random.default_rng(3).normal(0.0, 0.003, 6000)
    rates = _rates(0.5 + noise)
    assert set(rates) == {0.0, 1.0}
    assert 0.45 < rates.mean() < 0.55
    changes = np.flatnonzero(np.diff(rates)) * 0.01
    assert np.diff(changes).min() > 0.9 * WAIT.patience


def test_the_distance_is_that_at_the_stamp_of_the_odometry():
    """The reference is published ahead: its newest sample is where the robot will be."""
    clock = PathClock(WAIT, on_the_way=True)
    for k in range(100):
        clock.add_reference(k * PERIOD_NS, Pose(0.01 * k, 0.0, 0.0))
    clock.observe(20 * PERIOD_NS, Pose(0.2, 0.0, 0.0))
    assert clock.rate == 1.0
    clock.observe(60 * PERIOD_NS, Pose(0.2, 0.0, 0.0))
    assert clock.rate == 0.0


def test_the_path_waits_as_long_as_the_robot_has_not_set_off():
    """A controller that started 30 s later had to catch up with a path that was far away."""
    assert (_rates(np.full(6000, 0.5), begin=ORIGIN) == 0.0).all()
    assert (_rates(np.full(6000, 0.5), begin=ORIGIN, on_the_way=False) == 0.0).all()
    assert (_rates(np.full(6000, 0.5), on_the_way=False) == 1.0).all()


@pytest.mark.parametrize('used', [0.3, 0.9, 1.1, 1.9, 2.5])
def test_each_wait_has_the_whole_patience(used):
    """Also if the one before ended with little patience left, or while the path went on."""
    away, steps = 0.5, round(WAIT.patience / 0.01)
    first = np.full(round(used * steps), away)
    rates = _rates([*first, 0.0, *np.full(4 * steps, away)])
    expected = _rates(np.full(4 * steps, away))
    assert (rates[: len(first)] == expected[: len(first)]).all()
    assert rates[len(first)] == 1.0
    np.testing.assert_array_equal(rates[len(first) + 1 :], expected)


def _twists(source, count=400):
    return np.array([source.advance()[1] for _ in range(count)])


def _send_twist(source, _):
    source.set_target(BodyTwist(0.2, 1.0))


def _send_points(source, k):
    source.append(np.array([[0.1, 0.0], [0.2, 0.0], [0.3, 0.0]]) + [0.3 * k, 0.0])


SOURCES = {
    'twist': (lambda p: TwistSource(p, ORIGIN), _send_twist),
    'topic': (lambda p: GivenPathSource(p, WheelGeometry(), ORIGIN), _send_points),
}


@pytest.mark.parametrize('name', SOURCES)
def test_a_source_answers_each_time_as_the_first_time(name):
    """It is at rest before and after, and what it was given expires or is driven to its end."""
    make, send = SOURCES[name]
    source, found = make(PathReferenceParameters()), []
    for k in range(3):
        send(source, k)
        found.append(_twists(source))
        assert tuple(found[k][-1]) == STANDSTILL
    assert found[0][:, 0].max() > 0.1
    # A path begins within a period, and its speed grows by 0.005 m/s in one.
    np.testing.assert_allclose(found[1:], [found[0]] * 2, atol=0.01)
