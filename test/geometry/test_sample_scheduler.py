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
"""Sample scheduler, simulated time and real-time factor."""

import numpy as np
import pytest

from t3mpc_ros.geometry.sample_scheduler import RealTimeFactor, SampleScheduler, SimulatedTime

MS = 1_000_000


@pytest.mark.parametrize('rate', [333.0, 7.3, 1000.0])
def test_irregular_calls_give_every_sample_once_on_the_grid(rate):
    scheduler = SampleScheduler(rate)
    generator = np.random.default_rng(1)
    start = now = 1_700_000_000_000_000_000
    seen = []
    while now < start + 3_000_000_000:
        due = scheduler.due(now)
        assert all(stamp <= now for stamp in due)
        seen += due
        now += int(generator.uniform(0.0, 80.0) * MS)
    assert seen == [start + round(n * 1e9 / rate) for n in range(len(seen))]
    assert len(seen) > 2.7 * rate
    assert scheduler.skipped == 0


def test_a_sample_is_due_exactly_at_its_stamp():
    scheduler = SampleScheduler(100.0)
    assert scheduler.due(0) == [0]
    assert scheduler.due(10 * MS - 1) == []
    assert scheduler.due(10 * MS) == [10 * MS]
    assert scheduler.due(10 * MS) == []
    # Of 2/60 s, rounded down to whole nanoseconds, the quotient is less than 2.
    scheduler = SampleScheduler(60.0)
    for stamp in (round(n * 1e9 / 60.0) for n in range(60)):
        assert scheduler.due(stamp) == [stamp]


def test_a_late_timer_catches_up_by_at_most_one_burst():
    scheduler = SampleScheduler(100.0, burst=0.1)
    scheduler.due(0)
    due = scheduler.due(1000 * MS)
    assert due == [n * 10 * MS for n in range(91, 101)]
    assert scheduler.skipped == 90
    assert [scheduler.newly_skipped() for _ in range(2)] == [90, 0]


def test_a_clock_that_jumps_back_starts_a_new_grid():
    scheduler = SampleScheduler(100.0)
    scheduler.due(5_000 * MS)
    assert scheduler.due(1_003 * MS) == [1_003 * MS]
    assert scheduler.due(1_013 * MS) == [1_013 * MS]


def test_lateness_counts_from_the_newest_sample():
    scheduler = SampleScheduler(100.0)
    assert scheduler.lateness(0) == 0.0
    scheduler.due(0)
    scheduler.due(13 * MS)
    assert scheduler.lateness(14 * MS) == pytest.approx(0.004)


def test_with_slack_each_jittering_call_finds_one_sample():
    """Without slack, a call that is slightly early finds no sample, and the next one two."""
    rng = np.random.default_rng(9)
    ticks = [round(k * 10 * MS + rng.uniform(-0.9, 0.9) * MS) for k in range(1, 1000)]
    loose, tight = SampleScheduler(100.0, slack=0.002), SampleScheduler(100.0)
    counts = [len(loose.due(tick)) for tick in ticks]
    assert set(counts[1:]) == {1}
    assert [len(tight.due(tick)) for tick in ticks].count(1) < 900


# -- simulated time -------------------------------------------------------------------------------

SECOND = 1000 * MS


@pytest.mark.parametrize('speed', [0.1, 3.0])
@pytest.mark.slow
def test_simulated_time_follows_its_factor_without_gaps(speed):
    time = SimulatedTime(100.0, speed)
    rng = np.random.default_rng(4)
    begin = steady = 123 * SECOND
    seen = []
    while steady < begin + 20 * SECOND:
        seen += time.due(steady)
        assert seen[-1] <= time.now_ns(steady) <= seen[-1] + 10 * MS
        steady += int(rng.uniform(0.2, 1.8) * 10 * MS / max(speed, 1.0))
    assert seen == [SECOND + n * 10 * MS for n in range(len(seen))]
    assert seen[-1] - seen[0] == pytest.approx(speed * 20 * SECOND, abs=30 * MS)


def test_a_slow_machine_slows_time_and_skips_no_sample():
    """The requested rate is 2000 samples per second, and each takes 10 ms."""
    time = SimulatedTime(100.0, 20.0, max_burst=7)
    steady, seen = 5 * SECOND, []
    for _ in range(50):
        due = time.due(steady)
        assert len(due) <= 7
        seen += due
        steady += len(due) * 10 * MS
        # The clock never shows a time that has not been simulated.
        assert time.now_ns(steady) <= seen[-1] + 10 * MS
    assert seen == [SECOND + n * 10 * MS for n in range(len(seen))]
    assert len(seen) > 300
    # The delay is not made up for when the machine is fast again.
    time.due(steady)
    assert sum(len(time.due(steady + n * MS)) for n in range(1, 101)) in range(195, 206)
    steady += 100 * MS
    time.set_real_time_factor(1.0, steady)
    assert len(time.due(steady)) == 1
    assert [len(time.due(steady + n * 10 * MS)) for n in range(1, 50)] == [1] * 49


def test_simulated_time_is_monotonic():
    rng = np.random.default_rng(8)
    time = SimulatedTime(250.0, 1.0)
    steady, before, seen = 0, 0, []
    for _ in range(1000):
        steady += int(rng.exponential(4 * MS))
        if rng.random() < 0.1:
            time.set_real_time_factor(float(rng.choice([0.0, 0.3, 1.0, 5.0])), steady)
        if time.real_time_factor == 0.0 and rng.random() < 0.5:
            seen += time.step(int(rng.integers(1, 4)))
        else:
            seen += time.due(steady)
        now = time.now_ns(steady)
        assert now >= before
        assert not seen or seen[-1] <= now <= seen[-1] + 4 * MS
        before = now
    assert seen == [SECOND + n * 4 * MS for n in range(len(seen))]
    assert len(seen) > 300


def test_stopped_time_advances_only_by_steps():
    time = SimulatedTime(100.0, 0.0)
    assert time.now_ns(7) == SECOND
    assert time.due(8) == [SECOND]
    assert [time.due(n * SECOND) for n in range(1, 5)] == [[]] * 4
    assert time.now_ns(9 * SECOND) == SECOND
    assert time.step(2) == [SECOND + 10 * MS, SECOND + 20 * MS]
    assert time.now_ns(10 * SECOND) == SECOND + 20 * MS
    time.set_real_time_factor(2.0, 11 * SECOND)
    with pytest.raises(ValueError, match='real_time_factor must be 0 .*: got 2'):
        time.step(1)
    assert time.due(11 * SECOND) == [SECOND + 30 * MS]
    time.set_real_time_factor(0.0, 11 * SECOND + 2 * MS)
    assert time.now_ns(50 * SECOND) == SECOND + 36 * MS, 'stopped between two samples'
    assert time.step(1) == [SECOND + 40 * MS]


def test_real_time_factor_covers_the_last_second():
    factor = RealTimeFactor()
    for n in range(100):
        factor.update(30 * n * MS, 10 * n * MS)
    assert factor.value is None
    for n in range(100, 250):
        factor.update(30 * n * MS, 10 * n * MS)
    assert factor.value == pytest.approx(3.0)
    factor.restart()
    assert factor.value is None
    for n in range(250, 360):
        factor.update(0, 10 * n * MS)
    assert factor.value == 0.0
