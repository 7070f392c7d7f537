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
"""Switching signal: deterministic, unbounded in time, with smooth transitions."""

from dataclasses import replace
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import kstest
from support.properties import PROPERTY

from t3mpc_ros.chaos.switching_signal import SwitchingParameters, SwitchingSchedule
from t3mpc_ros.parameters.table import ParameterError

RANDOM = SwitchingParameters(kind='random', shortest_dwell=2.0, longest_dwell=5.0)


def _switches(schedule, end):
    """Return the times of the switches up to and including ``end``, and the modes from then on."""
    times, modes = [], []
    while (until := schedule.at(times[-1] if times else 0.0).until) <= end:
        times.append(until)
        modes.append(schedule.at(until).mode)
    return times, modes


def test_default_switches_four_times_as_in_the_paper():
    schedule = SwitchingSchedule(SwitchingParameters())
    assert _switches(schedule, 59.99) == ([12.0, 24.0, 36.0, 48.0], [1, 2, 3, 0])
    found = [schedule.at(time) for time in (0.0, 11.99, 12.0, 47.99)]
    assert [each.mode for each in found] == [0, 0, 1, 3]
    assert all((each.blend, each.blend_rate) == (1.0, 0.0) for each in found)
    assert {*schedule.pairs} == {(1, 2), (2, 3), (3, 4), (4, 1)}


def test_fixed_switching_repeats_the_last_dwell_on_its_grid():
    schedule = SwitchingSchedule(SwitchingParameters(times=(3.0, 10.0, 10.5)))
    assert _switches(schedule, 12.0)[0] == [3.0, 10.0, 10.5, 11.0, 11.5, 12.0]
    late = schedule.at(5010.5)  # 10 000 half seconds after the last listed time
    assert (late.switches, late.since, late.until) == (10_003, 5010.5, 5011.0)
    assert late.mode == 10_003 % 4


def test_one_switch_time_is_a_period_and_none_is_no_switching():
    once = SwitchingSchedule(SwitchingParameters(times=(7.0,)))
    assert _switches(once, 30.0)[0] == [7.0, 14.0, 21.0, 28.0]
    never = SwitchingSchedule(SwitchingParameters(times=()))
    assert never.at(1e9).until == math.inf
    for kind in ('fixed', 'random', 'memoryless'):
        one = SwitchingSchedule(SwitchingParameters(kind=kind, modes=(2, 4)))
        assert one.at(1e7) == (0, 0, 1.0, 0.0, 0, 0.0, math.inf)


TIMES = st.floats(0.0, 300.0) | st.integers(0, 25).map(lambda n: 12.0 * n)


@pytest.mark.slow
@PROPERTY
@given(
    st.sampled_from((SwitchingParameters(blend=1.0), RANDOM, replace(RANDOM, kind='memoryless'))),
    st.integers(0, 2**128),
    st.lists(TIMES, min_size=5),
)
def test_the_mode_does_not_depend_on_earlier_queries(parameters, seed, times):
    """Neither do the switch times, at which the new mode is active."""
    asked = SwitchingSchedule(parameters, seed)
    for time in times:
        mode = asked.at(time)
        assert mode == SwitchingSchedule(parameters, seed).at(time)
        assert mode.since <= time < mode.until
        if mode.switches:
            before = asked.at(np.nextafter(mode.since, 0.0))
            assert (before.until, before.mode, before.switches) == (
                mode.since,
                mode.previous,
                mode.switches - 1,
            )


def test_random_dwells_are_uniform_between_their_bounds():
    dwells = np.diff([0.0, *_switches(SwitchingSchedule(RANDOM, seed=2), 7000.0)[0]])
    assert dwells.size > 1900
    assert dwells.min() >= 2.0
    assert dwells.max() <= 5.0
    assert kstest(dwells, 'uniform', args=(2.0, 3.0)).pvalue > 0.01


def test_random_modes_are_uniform_among_the_other_modes():
    changes = np.diff([0, *_switches(SwitchingSchedule(RANDOM, seed=3), 14_000.0)[1]]) % 4
    shares = np.bincount(changes, minlength=4) / changes.size
    assert shares[0] == 0.0
    np.testing.assert_allclose(shares[1:], 1.0 / 3.0, atol=0.03)


def test_blend_is_continuous_with_a_continuous_derivative():
    schedule = SwitchingSchedule(SwitchingParameters(blend=2.0))
    times = np.linspace(11.0, 15.0, 40_001)
    selections = [schedule.at(time) for time in times]
    # The weight of the new mode starts at its switch at 12 s.
    share = np.array([s.blend if s.switches else 0.0 for s in selections])
    rate = np.array([s.blend_rate for s in selections])
    step = times[1] - times[0]
    np.testing.assert_allclose(np.gradient(share, step)[1:-1], rate[1:-1], atol=1e-4)
    assert np.abs(np.diff(rate)).max() < 2.0 * 6.0 / 2.0**2 * step
    assert np.all(np.diff(share) >= 0.0)
    assert (share[0], share[-1]) == (0.0, 1.0)
    assert schedule.at(12.0).previous == 0
    assert schedule.at(13.0).blend == 0.5


@pytest.mark.parametrize(
    'values, name',
    [
        ({'modes': ()}, 'modes'),
        ({'modes': (1, 2, 3)}, 'modes'),
        ({'modes': (1, 5)}, 'modes'),
        ({'times': (3.0, 2.0)}, 'times'),
        ({'times': (0.0,)}, 'times'),
        ({'times': (5.0, 6.0), 'blend': 2.0}, 'blend'),
        ({'kind': 'random', 'blend': 9.0}, 'blend'),
        ({'shortest_dwell': 20.0}, 'longest_dwell'),
        ({'kind': 'sometimes'}, 'kind'),
    ],
)
def test_inconsistent_parameters_are_rejected_by_name(values, name):
    with pytest.raises(ParameterError, match=name):
        SwitchingParameters(**values)


def test_times_outside_the_run_are_rejected():
    for time in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match='time'):
            SwitchingSchedule(SwitchingParameters()).at(time)


MEMORYLESS = SwitchingParameters(kind='memoryless', mean_dwell=4.0, blend=2.0)


def test_a_dwell_without_memory_has_no_bound():
    """With dwells of at least 8 s the next seconds after a switch were known."""
    dwells = np.diff([0.0, *_switches(SwitchingSchedule(MEMORYLESS, seed=2), 8000.0)[0]])
    assert kstest(dwells, 'expon', args=(0.0, 4.0)).pvalue > 0.01
    assert dwells.min() < 0.05
    assert (dwells[1:] < MEMORYLESS.blend).mean() > 0.3
    # Given that a dwell has lasted, its rest is as long as any.
    assert np.mean(dwells[dwells > 4.0] - 4.0) == pytest.approx(4.0, abs=0.5)


def test_the_first_mode_is_as_any_other():
    """It was pair 1 for every seed."""
    first = [SwitchingSchedule(MEMORYLESS, seed).at(0.0).mode for seed in range(400)]
    np.testing.assert_allclose(np.bincount(first) / 400, 0.25, atol=0.07)
    times, modes = _switches(SwitchingSchedule(MEMORYLESS, seed=3), 8000.0)
    assert (np.diff(modes) != 0).all()
    np.testing.assert_allclose(np.bincount(modes) / len(modes), 0.25, atol=0.03)
