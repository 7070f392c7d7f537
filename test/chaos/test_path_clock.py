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
"""A path waits for the robot, but not forever for one that cannot come."""

import numpy as np
import pytest

from t3mpc_ros.chaos.pose_reference import (
    GivenPathSource,
    PathClock,
    PathReferenceParameters,
    TwistSource,
    WaitParameters,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, BodyTwist, Pose

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
