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
"""Clock synchronisation: sample times of the robot from round trips alone."""

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.radio.protocol import clock_sync

TRAVEL_NS = clock_sync.forward_delay_ns(26, 14)


def drive(seconds, skew, jitter, loss, seed=1, boot_us=0, model=None):
    """Return the errors (s) of stamps by the model and of stamps on arrival, sample by sample.

    Every 20 ms the host sends; bytes come late by up to ``jitter`` seconds each way.
    """
    generator = np.random.default_rng(seed)
    model = model or clock_sync.ClockModel()
    time = clock_sync.CounterUnwrapper()
    model_errors, arrival_errors = [], []
    for cycle in range(round(seconds * 50)):
        there, back, drawn = generator.uniform(0.0, 1.0, 3)
        sent = 1000.0 + 0.02 * cycle
        received = sent + jitter * there + TRAVEL_NS / 1e9
        sampled = received + 0.0008
        returned = received + 0.0034 + jitter * back
        if drawn < loss:
            continue
        tick = (1.0 + skew) * 1e6
        sampled_us = int((sampled - 990.0) * tick) + boot_us
        age = round((sampled - received) * tick / 10.0)
        total = time.add(sampled_us % 2**32)
        model.add(total - 10 * age, round(sent * 1e9), round(returned * 1e9), TRAVEL_NS)
        model_errors.append(model.to_host_ns(total) / 1e9 - sampled)
        arrival_errors.append(returned - sampled)
    return np.array(model_errors), np.array(arrival_errors)


def rms(errors):
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize('seed', few_of(range(4)))
@pytest.mark.parametrize('skew', few_of([0.005, -0.005]))
@pytest.mark.slow
def test_clock_error_of_half_a_percent_with_a_jittery_port(skew, seed):
    errors, arrival = drive(30.0, skew, 1e-3, 0.05, seed)
    assert rms(errors) < 0.13e-3
    # With a full window.
    assert np.abs(errors[500:]).max() < 0.19e-3
    assert rms(arrival) > 20.0 * rms(errors)


def test_the_first_second_is_no_worse_than_arrival_stamps():
    for seed in range(10):
        errors, arrival = drive(1.0, 0.005, 1e-3, 0.05, seed)
        assert np.abs(errors).max() < 1.0e-3
        assert np.abs(errors).max() < np.abs(arrival).max()


def test_slow_transactions_do_not_bias_the_fit():
    """A port that sometimes delays bytes by 30 ms, one way only."""
    model = clock_sync.ClockModel()
    worst = 0.0
    for cycle in range(1000):
        there = 30_000_000 if cycle % 7 == 3 else 0
        back = 30_000_000 if cycle % 11 == 5 else 0
        sent = cycle * 20_000_000
        received = sent + TRAVEL_NS + there
        model.add(received // 1000, sent, sent + 5_000_000 + there + back, TRAVEL_NS)
        if cycle > 20:
            worst = max(worst, abs(model.to_host_ns(received // 1000) - received))
    assert worst < 20_000


@pytest.mark.slow
def test_a_drifting_resonator_is_tracked():
    """Samples older than ten seconds, with another rate, are dropped."""
    model, robot_us = clock_sync.ClockModel(), 0
    for cycle in range(1100):
        robot_us += 20_100 if cycle < 500 else 20_050
        sent = cycle * 20_000_000
        model.add(robot_us, sent, sent + 5_000_000, TRAVEL_NS)
    assert model.skew == pytest.approx(1.0 / 1.0025 - 1.0, abs=1e-5)
    assert model.to_host_ns(robot_us) == pytest.approx(sent + TRAVEL_NS, abs=10_000)


def test_a_model_without_samples_raises():
    model = clock_sync.ClockModel()
    assert not model.is_set
    with pytest.raises(ValueError, match='at least one transaction: got none'):
        model.to_host_ns(0)
    model.add(1000, 0, 5_000_000, 1_000_000)
    assert model.is_set
    model.reset()
    assert not model.is_set
    assert model.skew == 0.0


def test_epoch_times_keep_nanosecond_precision():
    origin = 1_800_000_000 * 10**9
    near, far = clock_sync.ClockModel(), clock_sync.ClockModel()
    for cycle in range(100):
        sent = cycle * 20_000_000 + cycle * cycle % 7000
        for model, base in ((near, 0), (far, origin)):
            model.add(20_000 * cycle, base + sent, base + sent + 5_000_000, TRAVEL_NS)
    assert far.to_host_ns(2_000_000) - origin == pytest.approx(near.to_host_ns(2_000_000), abs=2)


def test_forward_delay_of_a_command():
    """26 bytes at 20 us, 130 us twice, 185 us in the air: 965 us."""
    assert clock_sync.forward_delay_ns(26, 14) == 965_000
    assert clock_sync.forward_delay_ns(34, 22) == (34 * 20 + 260 + 249) * 1000


def test_counters_are_unwrapped():
    counter = clock_sync.CounterUnwrapper()
    total = -5
    counter.add(total)
    generator = np.random.default_rng(2)
    moved = 0
    for step in generator.integers(-(2**31) + 1, 2**31 - 1, 200).tolist():
        total += step
        moved += step
        as_int32 = (total + 2**31) % 2**32 - 2**31
        assert counter.add(as_int32) == moved
        assert counter.total == moved
    counter.rebase()
    assert counter.add(17) == moved
    assert counter.add(20) == moved + 3


def test_wrapped_difference_is_the_shorter_one():
    assert clock_sync.wrapped_difference(0xFFFFFFFF, 1) == 2
    assert clock_sync.wrapped_difference(1, 0xFFFFFFFF) == -2
    assert clock_sync.wrapped_difference(-(2**31), 2**31 - 1) == -1
    assert clock_sync.wrapped_difference(5, 5) == 0
