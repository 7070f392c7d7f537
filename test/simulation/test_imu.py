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
"""Simulated IMU, against its data sheet and against theory."""

import math

import numpy as np
import pytest
from support.constants import split_constants
from support.long_tests import few_of

from t3mpc_ros.robot.sensor_parameters import GRAVITY
from t3mpc_ros.simulation.sensors.imu import SimulatedImu, SimulatedImuParameters, low_pass

IDEAL = {
    'gyro_noise': 0.0,
    'accel_noise': 0.0,
    'gyro_offset': 0.0,
    'gyro_drift': 0.0,
    'gyro_scale_error': 0.0,
    'accel_offset': 0.0,
}
# RM-MPU-6000A-00, register 26: bandwidth (Hz) and delay (s) of the gyro.
REGISTER_MAP = {
    '0': (256.0, 0.98e-3),
    '1': (188.0, 1.9e-3),
    '2': (98.0, 2.8e-3),
    '3': (42.0, 4.8e-3),
    '4': (20.0, 8.3e-3),
    '5': (10.0, 13.4e-3),
    '6': (5.0, 18.6e-3),
}
# PS-MPU-6000A-00, 6.1 and 6.2: counts per deg/s and per g.
GYRO = {'250': 131.0, '500': 65.5, '1000': 32.8, '2000': 16.4}
ACCEL = {'2': 16384.0, '4': 8192.0, '8': 4096.0, '16': 2048.0}


def sensor(seed: int = 1, **changes: object) -> SimulatedImu:
    table, values = split_constants(SimulatedImuParameters, changes)
    return SimulatedImu(table.from_dict(values), np.random.default_rng(seed))


def settled(angular: float = 0.0, forward: float = 0.0, sideways: float = 0.0) -> np.ndarray:
    return np.array([[angular] * 2, [forward] * 2, [sideways] * 2])


def rates(imu: SimulatedImu, count: int, dt: float = 0.01) -> np.ndarray:
    """Return yaw rates measured at standstill, deg/s."""
    still = settled()
    return np.degrees([imu.measure(still, dt).angular for _ in range(count)])


@pytest.mark.parametrize(('span', 'force'), [*zip(GYRO, ACCEL, strict=True)])
def test_counts_match_the_data_sheet_and_saturate(span, force):
    imu = sensor(**IDEAL, gyro_range=span, accel_range=force)
    for share in (0.1, -0.5, 0.9):
        degrees, most = share * float(span), float(force)
        imu.measure(settled(math.radians(degrees), share * most * GRAVITY, -share * GRAVITY), 0.01)
        expected = degrees * GYRO[span], share * most * ACCEL[force], -share * ACCEL[force]
        assert np.abs(np.subtract(imu.counts, expected)).max() <= 0.5
    for sign, end in ((1.0, 32767), (-1.0, -32768)):
        for excess in (1.01, math.inf):
            rate = math.radians(sign * excess * float(span))
            sample = imu.measure(settled(rate, sign * 1e3, sign * 1e3), 0.01)
            assert imu.counts == (end, end, end)
            assert math.degrees(sample.angular) == pytest.approx(sign * float(span), rel=2e-3)
            assert sample.forward == pytest.approx(sign * float(force) * GRAVITY, rel=1e-3)


def response(parameters: SimulatedImuParameters, frequency: float) -> complex:
    """Return gain and phase of the low-pass, from its response to a sine in short steps."""
    step = 0.002 / frequency
    share, filtered = parameters.share(step), np.zeros((3, 2))
    # Sampled in the middle of each step, the staircase has no lag.
    times = step * np.arange(5500)
    out = np.empty(times.size)
    for index, time in enumerate(times):
        value = math.sin(math.tau * frequency * (time + 0.5 * step))
        low_pass(filtered, value, -value, 2.0 * value, share)
        out[index] = filtered[0, 1]
        assert filtered[1, 1] == -filtered[0, 1]
        assert filtered[2, 1] == 2.0 * filtered[0, 1]
    tail = slice(5000, 5500)  # one period, long after the start
    wave = np.exp(-1j * math.tau * frequency * (times[tail] + step))
    return complex(2j * np.mean(out[tail] * wave))


@pytest.mark.parametrize('setting', ['0', '3', '6'])
def test_low_pass_cutoff_matches_the_register_map(setting):
    parameters, frequency = SimulatedImuParameters(low_pass=setting), REGISTER_MAP[setting][0]
    gain = response(parameters, frequency)
    assert abs(gain) == pytest.approx(math.sqrt(0.5), rel=1e-3)
    pole = frequency * math.tau / math.sqrt(math.sqrt(2.0) - 1.0)
    ideal = 1.0 / (1.0 + 1j * math.tau * frequency / pole) ** 2
    assert gain == pytest.approx(ideal, abs=1e-3)
    assert abs(response(parameters, 0.1 * frequency)) == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize('setting', ['0', '3', '6'])
def test_low_pass_delay_matches_its_parameters(setting):
    """The delay of slow signals is the area above the step response."""
    parameters = SimulatedImuParameters(low_pass=setting)
    step, filtered = parameters.delay / 200.0, np.zeros((3, 2))
    share, missing = parameters.share(step), [1.0]
    for _ in range(6000):
        low_pass(filtered, 1.0, 0.0, 0.0, share)
        missing.append(1.0 - filtered[0, 1])
    area = step * (sum(missing) - 0.5 * (missing[0] + missing[-1]))
    assert area == pytest.approx(parameters.delay, rel=1e-4)
    if setting != '6':  # even one pole is slower than the data sheet at 5 Hz
        assert parameters.delay == pytest.approx(REGISTER_MAP[setting][1], abs=0.9e-3)


def test_low_pass_is_independent_of_the_step():
    parameters, ends = SimulatedImuParameters(), []
    for count in (1, 8, 80):
        filtered = np.array([[0.3, -0.2], [1.0, 2.0], [0.0, 0.0]])
        share = parameters.share(0.008 / count)
        for _ in range(count):
            low_pass(filtered, 1.0, -2.0, 0.5, share)
        ends.append(filtered)
    assert ends[1] == pytest.approx(ends[0], abs=1e-12)
    assert ends[2] == pytest.approx(ends[0], abs=1e-12)


def test_accelerometer_noise_follows_its_density():
    imu, still = sensor(), settled()
    found = np.array([imu.measure(still, 0.01)[1:] for _ in range(20000)])
    expected = 400e-6 * GRAVITY * math.sqrt(SimulatedImuParameters().noise_bandwidth)
    assert found.std(axis=0) == pytest.approx([expected, expected], rel=0.02)
    assert abs(np.corrcoef(found.T)[0, 1]) < 0.03


def allan(samples: np.ndarray, size: int) -> float:
    """Return the Allan deviation over groups of ``size`` samples."""
    count = samples.size // size
    means = samples[: count * size].reshape(count, size).mean(axis=1)
    return float(math.sqrt(0.5 * np.mean(np.diff(means) ** 2)))


@pytest.mark.parametrize('setting', ['0', '3', '6'])
@pytest.mark.parametrize('dt', few_of([0.01, 0.002]))
def test_allan_deviation_matches_the_noise_density(setting, dt):
    """N/sqrt(2 tau) plus aliasing, at any low-pass and rate.

    White samples of equal variance would average out too fast at 5 Hz, where consecutive samples
    are nearly equal.
    """
    parameters = SimulatedImuParameters(gyro_drift=0.0, low_pass=setting, gyro_range='250')
    imu, size = SimulatedImu(parameters, np.random.default_rng(1)), round(1.0 / dt)
    found = allan(rates(imu, 400 * size, dt), size)
    # Aliasing of the band above half the rate: the sum over the autocorrelation.
    lags = parameters.pole * dt * np.arange(1, 200)
    folded = (
        2.0 * dt * parameters.noise_bandwidth * (1.0 + 2.0 * np.sum((1.0 + lags) * np.exp(-lags)))
    )
    assert folded > 0.999
    assert found == pytest.approx(0.005 * math.sqrt(0.5 * folded), rel=0.15)


@pytest.mark.slow
def test_allan_deviation_rises_with_bias_drift():
    """K sqrt(tau/3) for a random walk K, far above the remaining noise."""
    imu = sensor(seed=3, gyro_drift=0.05, gyro_offset=0.0)
    found = rates(imu, 30000)
    expected = 0.05 * math.sqrt(10.0 / 3.0)
    assert allan(found, 1000) == pytest.approx(expected, rel=0.3)
    assert allan(found, 100) < allan(found, 1000)


def test_bias_is_the_mean_excess_of_the_samples():
    imu = sensor(seed=4, **{**IDEAL, 'gyro_offset': 20.0, 'gyro_drift': 0.5})
    for _ in range(50):
        sample = imu.measure(settled(1.0), 0.01)
        assert sample.angular - 1.0 == pytest.approx(imu.bias, abs=imu.parameters.rate_step)
    sample = imu.measure(settled(1.0), 0.01, bias_jump=0.2)
    assert sample.angular - 1.0 == pytest.approx(imu.bias, abs=imu.parameters.rate_step)
    jumped = imu.bias
    imu.measure(settled(1.0), 0.0)
    assert jumped - imu.bias == pytest.approx(0.2)


def test_each_power_up_draws_an_offset_within_the_data_sheet():
    imu, found = sensor(seed=5), []
    for _ in range(500):
        found.append(math.degrees(imu.bias))
        imu.restart()
        assert imu.counts == (0, 0, 0)
    assert max(map(abs, found)) <= 20.0
    assert max(found) > 19.0
    assert min(found) < -19.0
    assert np.std(found) == pytest.approx(20.0 / math.sqrt(3.0), rel=0.1)


def test_scale_and_acceleration_offsets_persist_over_power_up():
    errors = []
    for seed in range(60):
        imu = sensor(seed=seed, **{**IDEAL, 'gyro_scale_error': 0.03, 'accel_offset': 50.0})
        before = imu.measure(settled(5.0), 0.01)
        imu.restart()
        assert imu.measure(settled(5.0), 0.01) == before
        errors.append((before.angular / 5.0 - 1.0, *before[1:]))
    assert np.all(np.abs(errors).max(axis=0) <= [0.0301, 0.4905, 0.4905])
    assert np.std(errors, axis=0) == pytest.approx(
        np.array([0.03, 0.050 * GRAVITY, 0.050 * GRAVITY]) / math.sqrt(3.0), rel=0.2
    )


def test_a_time_step_of_zero_repeats_the_sample():
    imu = sensor()
    first = imu.measure(settled(), 0.01)
    assert imu.measure(settled(), 0.0) == first
    for dt in (-0.01, math.nan, math.inf):
        with pytest.raises(ValueError, match='dt must be finite'):
            imu.measure(settled(), dt)
