# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The grid of due samples."""

import numpy as np
import pytest

from t3mpc_ros.motion.pace import Pace

MS = 1_000_000


@pytest.mark.parametrize('rate', [100.0, 30.0, 333.0, 7.3, 60.0, 1000.0])
def test_irregular_calls_give_every_sample_once_and_on_the_grid(rate):
    pace = Pace(rate)
    generator = np.random.default_rng(1)
    start = now = 1_700_000_000_000_000_000
    seen = []
    while now < start + 3_000_000_000:
        due = pace.due(now)
        assert all(stamp <= now for stamp in due)
        seen += due
        now += int(generator.uniform(0.0, 80.0) * MS)
    assert seen == [start + round(n * 1e9 / rate) for n in range(len(seen))]
    assert len(seen) > 2.7 * rate
    assert pace.skipped == 0


def test_a_sample_is_due_at_its_stamp_and_not_a_nanosecond_before():
    pace = Pace(100.0)
    assert pace.due(0) == [0]
    assert pace.due(10 * MS - 1) == []
    assert pace.due(10 * MS) == [10 * MS]
    assert pace.due(10 * MS) == []


def test_a_late_timer_is_caught_up_with_up_to_the_burst():
    pace = Pace(100.0, burst=0.1)
    pace.due(0)
    due = pace.due(1000 * MS)
    assert due == [n * 10 * MS for n in range(91, 101)]
    assert pace.skipped == 90


def test_a_clock_that_jumps_back_starts_a_new_grid():
    pace = Pace(100.0)
    pace.due(5_000 * MS)
    assert pace.due(1_003 * MS) == [1_003 * MS]
    assert pace.due(1_013 * MS) == [1_013 * MS]


def test_standing_still_gives_nothing_twice():
    pace = Pace(100.0)
    assert pace.due(25 * MS) == [25 * MS]
    assert [pace.due(25 * MS) for _ in range(5)] == [[]] * 5
    assert pace.due(36 * MS) == [35 * MS]


def test_lateness_counts_from_the_newest_sample():
    pace = Pace(100.0)
    assert pace.lateness(0) == 0.0
    pace.due(0)
    pace.due(13 * MS)
    assert pace.lateness(14 * MS) == pytest.approx(0.004)


def test_with_slack_a_timer_that_jitters_finds_exactly_one_sample_each_time():
    """Without it a timer a little early found nothing, and the next call two samples."""
    rng = np.random.default_rng(9)
    ticks = [round(k * 10 * MS + rng.uniform(-0.9, 0.9) * MS) for k in range(1, 1000)]
    loose, tight = Pace(100.0, slack=0.002), Pace(100.0)
    counts = [len(loose.due(tick)) for tick in ticks]
    assert set(counts[1:]) == {1}
    assert [len(tight.due(tick)) for tick in ticks].count(1) < 900
