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
"""Reference trajectory: interpolation, jumps, restarts and capacity."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.trajectory import ReferenceTrajectory
from t3mpc_ros.geometry.types import BodyTwist, Pose, State

JUMP = BodyTwist(5.0, 20.0)
MS = 1_000_000


def sample(stamp_ms: float, linear: float, angular: float = 0.0) -> State:
    return State(round(stamp_ms * MS), Pose(0.0, 0.0, 0.0), BodyTwist(linear, angular))


def filled(*samples: State, capacity: int = 512) -> ReferenceTrajectory:
    trajectory = ReferenceTrajectory(JUMP, capacity)
    for item in samples:
        assert trajectory.add(item)
    return trajectory


def test_a_straight_line_is_reproduced_exactly_with_its_rate():
    trajectory = filled(*(sample(10.0 * n, 0.02 * n, -0.1 * n) for n in range(20)))
    for now_ms in np.random.default_rng(1).uniform(0.0, 189.9, 100):
        point = trajectory.at(int(now_ms * MS))
        steps = int(now_ms * MS) / (10.0 * MS)
        assert point.twist == pytest.approx((0.02 * steps, -0.1 * steps), abs=1e-12)
        assert point.rate == pytest.approx((2.0, -10.0), rel=1e-9)


def test_a_curve_is_interpolated_with_second_order():
    def error(period_ms: float) -> float:
        count = round(1000.0 / period_ms) + 1
        trajectory = filled(
            *(sample(n * period_ms, math.sin(3.0 * n * period_ms / 1e3)) for n in range(count))
        )
        times = np.linspace(0.0, 999.0, 997)
        return max(
            abs(trajectory.at(int(t * MS)).twist.linear - math.sin(3.0 * int(t * MS) / 1e9))
            for t in times
        )

    order = math.log2(error(40.0) / error(20.0))
    assert order == pytest.approx(2.0, abs=0.1)


def test_the_value_outside_the_samples_is_unknown():
    trajectory = ReferenceTrajectory(JUMP)
    assert trajectory.at(0) is None
    assert trajectory.newest_ns is None
    trajectory.add(sample(10.0, 0.1))
    assert trajectory.at(10 * MS - 1) is None
    assert trajectory.at(10 * MS).twist.linear == 0.1
    assert trajectory.at(10 * MS + 1) is None
    trajectory.add(sample(20.0, 0.11))
    assert trajectory.at(10 * MS).twist.linear == 0.1
    assert trajectory.at(20 * MS) == ((0.11, 0.0), (0.0, 0.0))
    assert trajectory.at(20 * MS + 1) is None
    assert trajectory.newest_ns == 20 * MS


@pytest.mark.parametrize('after', [BodyTwist(0.3, 0.0), BodyTwist(0.1, 0.5)])
def test_a_jump_happens_at_the_later_sample_and_has_no_rate(after):
    trajectory = filled(sample(0.0, 0.1), sample(10.0, 0.1))
    trajectory.add(State(20 * MS, Pose(0.0, 0.0, 0.0), after))
    trajectory.add(State(30 * MS, Pose(0.0, 0.0, 0.0), after))
    for now_ns in (10 * MS, 15 * MS, 20 * MS - 1):
        point = trajectory.at(now_ns)
        assert point.twist == (0.1, 0.0)
        assert point.rate == (0.0, 0.0)
    assert trajectory.at(20 * MS).twist == after
    assert trajectory.at(20 * MS).rate == (0.0, 0.0)


def test_a_change_just_within_the_limit_is_no_jump():
    trajectory = filled(sample(0.0, 0.0), sample(10.0, 0.0499))
    assert trajectory.at(5 * MS).rate.linear == pytest.approx(4.99)


def test_a_restarted_source_replaces_later_samples():
    trajectory = filled(*(sample(10.0 * n, 0.1) for n in range(10)))
    trajectory.add(sample(40.0, 0.2))
    assert trajectory.newest_ns == 40 * MS
    assert trajectory.at(50 * MS) is None
    assert trajectory.at(40 * MS).twist.linear == 0.2
    assert trajectory.at(30 * MS).twist.linear == 0.1
    trajectory.add(sample(-500.0, 0.3))  # before every earlier sample
    assert trajectory.newest_ns == -500 * MS
    assert trajectory.at(30 * MS) is None


def test_a_replaced_jump_is_no_longer_reported():
    """The source planned a step, then started again and took it back.

    The controller prepares for a reported jump: it would have slowed down for one that never
    comes.
    """
    speeds = (0.0, 0.0, 0.3, 0.0)
    trajectory = filled(*(sample(10.0 * n, speed) for n, speed in enumerate(speeds)))
    trajectory.add(sample(30.0, 0.3))
    (kept,) = trajectory.pop_jumps()
    assert (kept.stamp_ns, kept.change.linear) == (20 * MS, pytest.approx(0.3))
    trajectory.add(sample(40.0, 0.0))
    trajectory.add(sample(40.0, 0.3))
    assert trajectory.pop_jumps() == []


def test_a_stamp_far_ahead_does_not_block_later_samples():
    trajectory = filled(sample(0.0, 0.1), sample(3_600_000.0, 0.4))
    trajectory.add(sample(10.0, 0.12))
    trajectory.add(sample(20.0, 0.14))
    assert trajectory.newest_ns == 20 * MS
    assert trajectory.at(15 * MS).twist.linear == pytest.approx(0.13)


def test_lead_time_makes_the_value_independent_of_arrival():
    lead_ms = 50.0
    prompt, late = ReferenceTrajectory(JUMP), ReferenceTrajectory(JUMP)
    generator = np.random.default_rng(2)
    queue = []
    for tick in range(200):
        item = sample(10.0 * tick + lead_ms, 0.2 * math.sin(0.1 * tick))
        prompt.add(item)
        queue.append((10.0 * tick + generator.uniform(0.0, 30.0), item))
        while queue and queue[0][0] <= 10.0 * tick:
            late.add(queue.pop(0)[1])
        if tick > 10:
            assert late.at(10 * tick * MS) == prompt.at(10 * tick * MS)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf, 1e308])
def test_a_non_finite_sample_is_rejected_without_effect(bad):
    trajectory = filled(sample(0.0, 0.1), sample(10.0, 0.2))
    before = trajectory.at(5 * MS)
    assert not trajectory.add(sample(5.0, bad))
    assert not trajectory.add(sample(20.0, 0.0, bad))
    assert not trajectory.add(State(20 * MS, Pose(bad, 0.0, 0.0), BodyTwist(0.0, 0.0)))
    assert trajectory.newest_ns == 10 * MS
    assert trajectory.at(5 * MS) == before


def test_numbers_near_the_largest_one_make_a_jump_and_never_nan():
    trajectory = filled(sample(0.0, -9e8), sample(10.0, 9e8))
    point = trajectory.at(5 * MS)
    assert point.twist.linear == -9e8
    assert point.rate == (0.0, 0.0)


def test_the_newest_samples_are_kept_for_any_number():
    """The move of the samples to the front of their array has no effect on the values."""
    small, large = ReferenceTrajectory(JUMP, 16), ReferenceTrajectory(JUMP, 4096)
    generator = np.random.default_rng(3)
    for n in range(1000):
        item = sample(10.0 * n, math.sin(0.02 * n), math.cos(0.3 * n) + (n // 50) % 2)
        assert small.add(item)
        assert large.add(item)
        assert small.pop_jumps() == large.pop_jumps()
        for now_ms in (10.0 * n, 10.0 * n - generator.uniform(0.0, 149.0)):
            if n >= 15:
                assert small.at(int(now_ms * MS)) == large.at(int(now_ms * MS))
        if n >= 16:
            assert small.at(int((10.0 * n - 150.1) * MS)) is None
