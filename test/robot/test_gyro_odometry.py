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
"""Gyro odometry: consistency, bias estimation and slip detection."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.constants import split_constants, with_constants
from support.long_tests import few_of

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import Pose
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.gyro_odometry import GyroOdometry, GyroOdometryParameters
from t3mpc_ros.robot.wheel_odometry import WheelOdometry, WheelOdometryParameters

GEOMETRY = WheelGeometry()
RADIUS, TRACK = GEOMETRY.wheel_radius, GEOMETRY.wheel_separation
PARAMETERS = GyroOdometryParameters()
DEGREE = math.pi / 180.0
PERIOD = 0.01
STEP = math.tau / 3200.0
"""Wheel angle of a microstep, rad."""


class Robots:
    """True motion of many robots at once, and the output of their gyros.

    ``bias`` (rad/s), ``scale`` (relative error) and ``rate`` (true, rad/s) have one number each.
    """

    def __init__(self, count, seed, delay=PARAMETERS.gyro_delay):
        self.generator = np.random.default_rng(seed)
        self.pose = np.zeros((3, count))
        self.bias = self.generator.uniform(-20.0, 20.0, count) * DEGREE
        self.scale = np.zeros(count)
        self.rate = np.zeros(count)
        self._pole = 0.5 * delay
        self._lagged = np.zeros((2, count))

    def move(self, right, left, dt):
        """Move by these wheel travels (m) in ``dt``; several rows: each in ``dt``, in turn."""
        run = np.atleast_2d(0.5 * (right + left) + np.zeros_like(self.bias))
        turn = np.atleast_2d((right - left) / TRACK + np.zeros_like(self.bias))
        yaw = self.pose[2] + np.cumsum(turn, axis=0)
        chord, direction = run * np.sinc(0.5 * turn / math.pi), yaw - 0.5 * turn
        self.pose[0] += np.sum(chord * np.cos(direction), axis=0)
        self.pose[1] += np.sum(chord * np.sin(direction), axis=0)
        self.pose[2] = yaw[-1]
        # The filter is 1/(1 + p s)², exactly, with a constant rate in each dt.
        rates, left_over = turn / dt, np.arange(len(turn))[::-1]
        self.rate = rates[-1]
        decay, share = math.exp(-dt / self._pole), dt / self._pole
        weight = (1.0 - decay) * (1.0 + left_over * share) - decay * share
        weights = decay**left_over * (np.full(len(turn), 1.0 - decay), weight)
        first, second = self._lagged * decay ** len(turn)
        self._lagged = weights @ rates + (first, second + len(turn) * share * first)

    def walk_bias(self, dt, drift=PARAMETERS.gyro_bias_drift):
        self.bias += drift * math.sqrt(dt) * self.generator.standard_normal(self.bias.size)

    def gyro(self, noise=PARAMETERS.gyro_noise, delay=PARAMETERS.gyro_delay):
        """Return a sample with white noise behind the filter."""
        sigma = noise / math.sqrt(2.0 * delay)
        noise = sigma * self.generator.standard_normal(self.bias.size)
        return (1.0 + self.scale) * self._lagged[1] + self.bias + noise

    def stand(self, odometries, seconds, push=None):
        """Stand still, or turn at ``push(time)`` (rad/s) without a step."""
        for index in range(round(seconds / PERIOD)):
            path = 0.0 if push is None else 0.5 * TRACK * PERIOD * push(index * PERIOD)
            self.move(path, -path, PERIOD)
            for odometry, sample in zip(odometries, self.gyro(), strict=True):
                odometry.update(0.0, 0.0, sample, PERIOD)

    def yaw_errors(self, odometries):
        """Return estimate minus truth, within half a turn."""
        estimates = np.array([odometry.pose.yaw for odometry in odometries])
        return np.array([math.remainder(x, math.tau) for x in estimates - self.pose[2]])

    def drive(self, odometries, speeds, grip=1.0, period=PERIOD):
        """Turn the wheels at ``speeds`` (rad/s, shape (milliseconds, 2, count)), counted in steps.

        ``grip`` is the part of the travel that moves the robot, shaped like ``speeds``. Yields the
        time (s) after each period.
        """
        angles = np.cumsum(speeds * 1e-3, axis=0)
        counts = np.diff(STEP * np.round(angles / STEP)[:: round(period * 1e3)], axis=0)
        paths = RADIUS * 1e-3 * (speeds * grip)[1:]
        for index, (right, left) in enumerate(counts):
            first = index * round(period * 1e3)
            self.move(*paths[first : first + round(period * 1e3)].swapaxes(0, 1), 1e-3)
            for odometry, *angle, sample in zip(odometries, right, left, self.gyro(), strict=True):
                odometry.update(*angle, sample, period)
            yield (index + 1) * period


def make_odometries(count=1, **changes):
    table, values = split_constants(GyroOdometryParameters, changes)
    parameters = table(**values)
    return [GyroOdometry(parameters, GEOMETRY) for _ in range(count)]


def smooth_speeds(generator, count, periods):
    """Return wheel speeds (rad/s), shape (periods, 2, count): accelerated, cruising, at rest."""
    targets = generator.uniform(-8.0, 10.0, (periods // 100, 2, count))
    speeds, now = np.zeros((periods, 2, count)), np.zeros((2, count))
    for index in range(periods):
        goal = targets[index // 100] if index < periods - 50 else np.zeros_like(now)
        now = now + np.clip(goal - now, -0.3, 0.3)
        speeds[index] = now
    return speeds


def nees(robots, odometries):
    """Return the mean over robots of e' C^-1 e; 3 when the covariance is right."""
    values = []
    yaws = robots.yaw_errors(odometries)
    for index, odometry in enumerate(odometries):
        error = np.array(odometry.pose) - robots.pose[:, index]
        error[2] = yaws[index]
        values.append(error @ np.linalg.solve(odometry.covariance, error))
    return float(np.mean(values))


@pytest.mark.compiled
@pytest.mark.slow
def test_normalized_estimation_error_matches_the_covariance():
    count = 80
    robots, odometries = Robots(count, 1), make_odometries(count)
    generator = robots.generator
    robots.scale = PARAMETERS.gyro_scale_tolerance * generator.standard_normal(count)
    robots.stand(odometries, 3.0)
    for speeds in smooth_speeds(generator, count, 2000):
        runs = RADIUS * PERIOD * speeds
        spread = np.sqrt(PARAMETERS.variance_per_metre * np.abs(runs))
        robots.walk_bias(PERIOD)
        robots.move(*(runs + spread * generator.standard_normal(runs.shape)), PERIOD)
        angles = runs / RADIUS
        for index, sample in enumerate(robots.gyro()):
            odometries[index].update(angles[0, index], angles[1, index], sample, PERIOD)
    before = nees(robots, odometries)
    robots.stand(odometries, 2.0)
    # 95 % of chi-square with 240 degrees of freedom, divided by 80 robots
    assert 2.49 < before < 3.56
    assert 2.49 < nees(robots, odometries) < 3.56
    assert not any(odometry.slipping for odometry in odometries)


@pytest.mark.compiled
@pytest.mark.slow
def test_a_standstill_does_not_make_the_pose_jump():
    """After 12 min without one it moved the pose by 0.76 m and 33 degrees in a period."""
    count = 40
    changes = {'gyro_scale_tolerance': 0.0, 'gyro_bias_drift': 5e-4}
    robots, odometries = Robots(count, 2), make_odometries(count, **changes)
    robots.stand(odometries, 3.0)
    for speeds in smooth_speeds(robots.generator, count, 2000):
        robots.walk_bias(PERIOD, drift=5e-4)
        robots.move(*(RADIUS * PERIOD * speeds), PERIOD)
        for index, sample in enumerate(robots.gyro()):
            odometries[index].update(*(PERIOD * speeds[:, index]), sample, PERIOD)
    poses, before = [odometry.pose for odometry in odometries], [each.bias for each in odometries]
    robots.stand(odometries, 2.0)
    jumps = np.abs(np.array([odometry.pose for odometry in odometries]) - poses)
    assert np.hypot(*jumps[:, :2].T).max() < 0.021
    assert 0.01 < jumps[:, 2].max() < 0.041
    assert np.std(robots.bias - before) > 5.0 * np.std(robots.bias - [o.bias for o in odometries])
    sure = np.sqrt([odometry.covariance[2, 2] for odometry in odometries])
    assert np.std(robots.yaw_errors(odometries) / sure) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize('gyro_state', ['none', 'failed', 'disabled', 'unknown bias'])
def test_without_calibrated_gyro_equals_wheel_odometry(gyro_state):
    generator = np.random.default_rng(3)
    odometry = make_odometries(use_gyro=gyro_state != 'disabled')[0]
    if gyro_state == 'failed':
        Robots(1, 10).stand([odometry], 2.0)
    plain = WheelOdometry(WheelOdometryParameters(), GEOMETRY)
    odometry.reset(Pose(0.3, -0.2, 1.0))
    plain.reset(Pose(0.3, -0.2, 1.0))
    for index in range(300):
        right, left = generator.uniform(-0.2, 0.3, 2)
        jitter = 1e-6 * (index % 3)
        gyro = None if gyro_state in ('none', 'failed') else generator.uniform(-0.4, 0.4)
        odometry.update(right, left, gyro, generator.uniform(0.001, 0.1), jitter)
        plain.update(right, left, jitter)
    assert odometry.pose == pytest.approx(plain.pose, abs=1e-12)
    assert odometry.covariance == pytest.approx(plain.covariance, rel=1e-10, abs=1e-18)
    assert odometry.calibrated == (gyro_state == 'failed')
    assert not odometry.slipping


def run(moves, acceleration=30.0):
    """Return speeds (rad/s, each millisecond) of moves (right, left, seconds), with ramps."""
    speeds, now = [], np.zeros(2)
    for right, left, seconds in moves:
        for _ in range(round(seconds * 1e3)):
            change = np.array([right, left]) - now
            now = now + np.clip(change, -acceleration * 1e-3, acceleration * 1e-3)
            speeds.append(now)
    return np.array(speeds)


def square(sign):
    """UMBmark: four sides of 4 m at 0.3 m/s, with right angles on the spot."""
    wheel, spin = 0.3 / RADIUS, 3.0
    side = (wheel, wheel, 4.0 / 0.3), (0.0, 0.0, 0.5)
    turn = 0.25 * math.pi * TRACK / RADIUS / spin
    return run(4 * [*side, (sign * spin, -sign * spin, turn), (0.0, 0.0, 0.5)])


def ten_turns(sign):
    """Ten turns on the spot at 4 rad/s of yaw."""
    wheel = sign * 2.0 * TRACK / RADIUS
    return run([(wheel, -wheel, 5.0 * math.pi), (0.0, 0.0, 0.5)])


def slip_in_bursts(speeds):
    """Return the grip: the right wheel loses 3 % for the first half of every second."""
    grip = np.ones_like(speeds)
    grip[:, 0] -= 0.03 * (np.arange(len(speeds)) % 1000 < 500)[:, None]
    return grip


@pytest.mark.parametrize('course', few_of([ten_turns, square]))
@pytest.mark.slow
def test_gyro_reduces_slip_yaw_error_to_a_fifth(course):
    """Both directions; the scale error of 0.1 % is the remaining error of the turns."""
    speeds = np.stack([course(1.0), course(-1.0)], axis=-1)
    errors = []
    for use_gyro in (True, False):
        odometries, robots = make_odometries(2, use_gyro=use_gyro), Robots(2, 5)
        robots.scale[:] = 0.001, -0.001
        robots.stand(odometries, 2.0)
        for _ in robots.drive(odometries, speeds, slip_in_bursts(speeds)):
            assert not any(odometry.slipping for odometry in odometries)  # below the threshold
        errors.append(np.abs(robots.yaw_errors(odometries)))
        if use_gyro:
            sure = np.sqrt([odometry.covariance[2, 2] for odometry in odometries])
            assert np.all(errors[0] < 2.0 * sure)
    assert np.all(errors[1] > 0.4)
    assert np.all(errors[0] < 0.2 * errors[1])


@pytest.mark.long
def test_yaw_variance_of_ten_turns_cancels_when_turning_back():
    tolerance = 0.003
    robots, odometries = Robots(1, 6), make_odometries(gyro_scale_tolerance=tolerance)
    robots.stand(odometries, 2.0)
    for _ in robots.drive(odometries, ten_turns(1.0)[:, :, None]):
        pass
    sure = math.sqrt(odometries[0].covariance[2, 2])
    assert sure == pytest.approx(20.0 * math.pi * tolerance, rel=0.02)
    for _ in robots.drive(odometries, ten_turns(-1.0)[:, :, None]):
        pass
    assert math.sqrt(odometries[0].covariance[2, 2]) < 0.05 * sure


@pytest.mark.compiled
def test_bias_is_estimated_at_standstill_and_again_after_a_jump():
    count = 10
    robots, odometries = Robots(count, 7), make_odometries(count)
    robots.bias[0] = PARAMETERS.gyro_bias_limit + 0.01  # it is rejected
    robots.stand(odometries, 3.0)
    assert not odometries[0].calibrated
    robots.bias[0] = 0.1
    robots, odometries = Robots(count, 7), make_odometries(count)
    robots.stand(odometries, 0.95)
    assert not any(odometry.calibrated for odometry in odometries)
    robots.stand(odometries, 5.1)

    def misses():
        assert all(odometry.calibrated for odometry in odometries)
        return np.array([odometry.bias for odometry in odometries]) - robots.bias

    assert np.abs(misses()).max() < 0.01 * DEGREE
    assert max(odometry.bias_std for odometry in odometries) < 0.005 * DEGREE
    speeds = np.repeat(run([(6.0, 5.0, 3.0), (0.0, 0.0, 0.5)])[:, :, None], count, axis=2)
    for _ in robots.drive(odometries, speeds):
        pass
    robots.bias += DEGREE
    robots.stand(odometries, 5.1)
    assert np.abs(misses()).max() < 0.01 * DEGREE


@pytest.mark.parametrize('part', few_of([0.25, 0.5, 0.75]))
@pytest.mark.slow
def test_a_bias_jump_in_motion_is_in_the_covariance(part):
    """A jump of 1 deg/s is not flagged; the next standstill measures it, but not its time."""
    robots, odometries = Robots(1, 8), make_odometries()
    robots.stand(odometries, 3.0)
    for time in robots.drive(odometries, run([(6.0, 5.0, 10.0), (0.0, 0.0, 0.5)])[:, :, None]):
        robots.bias += DEGREE * (abs(time - 10.0 * part) < 0.5 * PERIOD)
        assert not odometries[0].slipping
    drifted = robots.yaw_errors(odometries)[0]
    assert drifted == pytest.approx((1.0 - part) * 10.0 * DEGREE, abs=0.6 * DEGREE)
    robots.stand(odometries, 3.0)
    # Until the jump is confirmed it looks like a robot that somebody turns.
    assert robots.yaw_errors(odometries)[0] == pytest.approx(drifted, abs=2.5 * DEGREE)
    assert odometries[0].bias == pytest.approx(robots.bias[0], abs=0.01 * DEGREE)
    sure = math.sqrt(odometries[0].covariance[2, 2])
    assert sure == pytest.approx(10.0 * DEGREE / math.sqrt(3.0), rel=0.3)


def reversals(acceleration=200.0, top=8.0):
    """Return speeds (ms, 2, 1): yaw between ±top every 150 ms, at 0.1 m/s, from rest to rest."""
    yaw, forward, now = [], [], 0.0
    for index in range(4000):
        goal = 0.0 if index > 3800 else top * (-1.0) ** (index // 150)
        now += float(np.clip(goal - now, -1e-3 * acceleration, 1e-3 * acceleration))
        yaw.append(now)
        forward.append(min(index, 3999 - index, 100) * 1e-3)
    turn, run = 0.5 * TRACK * np.array(yaw), np.array(forward)
    return np.stack([run + turn, run - turn], axis=1)[:, :, None] / RADIUS


@pytest.mark.parametrize('period, error', few_of([(0.01, 0.001), (0.005, 0.001), (0.02, 0.015)]))
@pytest.mark.slow
def test_fast_reversals_are_not_detected_as_slip(period, error):
    """The gyro lags by 4.8 ms: 1 rad/s at 200 rad/s², which without delay would indicate slip.

    At 50 Hz the corners of the motion fall between the samples and cause a small error.
    """
    covariances = {}
    for delay in (PARAMETERS.gyro_delay, 1e-4):
        for inflation in (1.0, 3000.0):
            robots = Robots(1, 11)
            odometries = make_odometries(slip_inflation=inflation, gyro_delay=delay)
            robots.stand(odometries, 2.0)
            for _ in robots.drive(odometries, reversals(), period=period):
                assert not odometries[0].slipping
            covariances[delay, inflation] = odometries[0].covariance
            if delay == PARAMETERS.gyro_delay:
                assert abs(robots.yaw_errors(odometries)[0]) < error
    # No disagreement, except with an assumed delay that is too short.
    same = PARAMETERS.gyro_delay
    assert np.array_equal(covariances[same, 1.0], covariances[same, 3000.0])
    assert not np.array_equal(covariances[1e-4, 1.0], covariances[1e-4, 3000.0])


@pytest.mark.parametrize('speed', few_of([0.05, 0.1, 0.3]))
def test_blocked_wheel_is_flagged_within_300_ms(speed):
    wheel = speed / RADIUS
    speeds = run([(wheel, wheel, 3.0), (0.0, 0.0, 0.5)])[:, :, None]
    grip = np.ones_like(speeds)
    grip[1500:2500, 0] = 0.0
    robots, odometries = Robots(1, 12), make_odometries()
    odometry = odometries[0]
    robots.stand(odometries, 2.0)
    traces = []
    for time in robots.drive(odometries, speeds, grip):
        if time < 1.5 or time > 2.7:
            assert not odometry.slipping
            assert odometry.slipping_for == 0.0
        elif 1.8 < time < 2.5:
            assert odometry.slipping
            assert PARAMETERS.slip_time <= odometry.slipping_for < time - 1.5 + 1e-9
        if time < 2.99:
            traces.append(np.trace(odometry.covariance[:2, :2]))
    growth = np.diff(traces)
    assert np.all(growth > 0.0)
    assert growth[180:240].mean() > 50.0 * growth[50:140].mean()
    assert abs(robots.yaw_errors(odometries)[0]) < 0.005
    error = np.array(odometry.pose[:2]) - robots.pose[:2, 0]
    assert error @ np.linalg.solve(odometry.covariance[:2, :2], error) < 9.0


@pytest.mark.compiled
@pytest.mark.parametrize('rate', few_of([1.0, 0.1, 0.01]))
def test_external_rotation_at_standstill_keeps_the_bias(rate):
    count = 20
    robots, odometries = Robots(count, 13), make_odometries(count)
    robots.stand(odometries, 3.0)
    frequency, phase = robots.generator.uniform([[0.1], [0.0]], [[2.0], [6.28]], (2, count))

    def push(time):
        return rate * (1.0 + 2.0 * np.sin(math.tau * frequency * time + phase))

    worst = 0.0
    for start in range(8):
        robots.stand(odometries, 1.0, push=lambda time, start=start: push(start + time))
        biases = np.array([odometry.bias for odometry in odometries])
        worst = max(worst, np.abs(biases - robots.bias).max())
    assert worst < 0.02 * DEGREE
    assert np.abs(robots.pose[2]).min() > 5.0 * rate
    assert np.abs(robots.yaw_errors(odometries)).max() < 0.02 + 0.01 * rate


@pytest.mark.parametrize('period', [0.01, 0.04])
def test_yaw_variance_is_that_of_noise_and_bias(period):
    """One sample represents the whole period, but its noise is that of 9.6 ms."""
    noise, delay = 1e-3, PARAMETERS.gyro_delay
    changes = {'gyro_scale_tolerance': 0.0, 'gyro_bias_drift': 0.0, 'standstill_spread': 0.02}
    odometry = make_odometries(variance_per_metre=0.1, gyro_noise=noise, **changes)[0]
    Robots(1, 19).stand([odometry], 5.0)
    odometry.reset()
    for _ in range(round(10.0 / period)):
        odometry.update(0.1, 0.1, odometry.bias, period)
    summed = noise**2 * 10.0 * max(1.0, period / (2.0 * delay))
    expected = summed + (10.0 * odometry.bias_std) ** 2
    assert summed > 0.1 * expected
    assert odometry.covariance[2, 2] == pytest.approx(expected, rel=0.01)


def test_sample_after_a_long_gap_counts_for_gyro_hold_only():
    often, seldom, plain = make_odometries(3)
    for odometry in (often, seldom, plain):
        Robots(1, 14).stand([odometry], 2.0)
    for _ in range(200):
        often.update(0.05, 0.04, often.bias + 0.01 * RADIUS / TRACK / PERIOD, PERIOD)
    for _ in range(2):
        seldom.update(5.0, 4.0, seldom.bias + 0.01 * RADIUS / TRACK / PERIOD, 1.0)
        plain.update(5.0, 4.0, None, 1.0)
    assert often.covariance[2, 2] < 0.05 * plain.covariance[2, 2]
    assert 0.8 * plain.covariance[2, 2] < seldom.covariance[2, 2] < plain.covariance[2, 2]


def test_slip_detection_has_hysteresis():
    odometry = make_odometries()[0]
    Robots(1, 21).stand([odometry], 2.0)
    for disagreement, slipping in ((0.2, False), (0.4, True), (0.2, True), (0.1, False)):
        for _ in range(50):
            odometry.update(0.05, 0.05, odometry.bias + disagreement, PERIOD)
        assert odometry.slipping == slipping


@pytest.mark.parametrize('tolerance', few_of([0.003, 0.03]))
@pytest.mark.slow
def test_scale_error_within_tolerance_is_not_slip(tolerance):
    robots, odometries = Robots(1, 22), make_odometries(gyro_scale_tolerance=tolerance)
    robots.scale[:] = 0.05
    robots.stand(odometries, 2.0)
    flagged = False
    for _ in robots.drive(odometries, 2.0 * ten_turns(1.0)[:, :, None]):
        flagged |= odometries[0].slipping
    assert flagged == (tolerance < 0.01)


@pytest.mark.parametrize('period', few_of([0.01, 0.02]))
@pytest.mark.slow
def test_short_turns_include_the_gyro_delay(period):
    """The gyro outputs the end of a turn after the last step; ignored, each cost 0.2 mrad."""
    robots, odometries = Robots(1, 23), make_odometries()
    speeds = run(20 * [(8.0, -8.0, 0.2), (0.0, 0.0, 0.3)], acceleration=60.0)[:, :, None]
    robots.stand(odometries, 3.0)
    for _ in robots.drive(odometries, speeds, period=period):
        pass
    assert abs(robots.yaw_errors(odometries)[0]) < 20 * 1e-4


@pytest.mark.compiled
@pytest.mark.slow
def test_covariance_stays_symmetric_and_positive_definite():
    generator = np.random.default_rng(15)
    for _ in range(8):
        odometry = make_odometries()[0]
        for _ in range(60):
            kind, count = generator.integers(5), generator.integers(1, 130)
            size, dt = 10.0 ** generator.uniform(-6.0, 1.0), 10.0 ** generator.uniform(-4.0, 0.0)
            bias = generator.uniform(-0.3, 0.3)
            for _ in range(count):
                right, left, gyro = size * generator.uniform(-1.0, 1.0, 3)
                if kind == 0:
                    right = left = 0.0
                    gyro, dt = bias + 1e-3 * gyro / size, PERIOD
                dead = kind == 1
                odometry.update(right, left, None if dead else gyro, dt, 1e-6 * (kind == 2))
            matrix = odometry.covariance
            assert np.array_equal(matrix, matrix.T)
            sizes = np.sqrt(np.diag(matrix)) + 1e-30
            assert np.linalg.eigvalsh(matrix / np.outer(sizes, sizes)).min() > -1e-9
            assert math.isfinite(odometry.bias)
            assert all(map(math.isfinite, odometry.pose))


def test_reset_keeps_the_bias_estimate():
    robots, odometries = Robots(1, 17), make_odometries()
    odometry = odometries[0]
    robots.stand(odometries, 3.0)
    for _ in robots.drive(odometries, run([(6.0, 5.0, 2.0)])[:, :, None]):
        pass
    bias, sure = odometry.bias, odometry.bias_std
    odometry.reset(Pose(1.0, 2.0, 0.5))
    assert odometry.pose == (1.0, 2.0, 0.5)
    assert not odometry.covariance.any()
    assert (odometry.bias, odometry.bias_std, odometry.calibrated) == (bias, sure, True)
    # What is learnt of the bias from now on corrects no drift from before the reset.
    robots.bias += DEGREE
    robots.stand(odometries, 3.0)
    assert odometry.bias - bias > 0.5 * DEGREE
    assert odometry.pose[:2] == (1.0, 2.0)
    assert 0.0 <= odometry.pose.yaw - 0.5 < 0.6 * DEGREE  # until the standstill is detected
    odometry.reset()
    assert odometry.pose == (0.0, 0.0, 0.0)


def test_parameters_change_while_running():
    robots, odometries = Robots(1, 18), make_odometries()
    robots.stand(odometries, 2.0)
    odometry = odometries[0]
    odometry.parameters = replace(PARAMETERS, use_gyro=False)
    robots.move(0.0, 0.01, PERIOD)
    odometry.update(0.3, 0.3, robots.gyro()[0], PERIOD)
    assert odometry.pose.yaw == 0.0
    odometry.parameters = PARAMETERS
    odometry.update(0.3, 0.3, odometry.bias - 1.0, PERIOD)
    assert odometry.pose.yaw < -0.005


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_non_finite_input_is_rejected_without_side_effects(bad):
    odometry = make_odometries()[0]
    odometry.update(1.0, 2.0, 0.1, PERIOD)
    before, covariance = odometry.pose, odometry.covariance
    cases = (
        (bad, 0.0, 0.0, 1.0),
        (0.0, bad, 0.0, 1.0),
        (0.0, 0.0, bad, 1.0),
        (0.0, 0.0, None, bad),
    )
    for arguments in (*cases, (0.0, 0.0, None, 1.0, bad)):
        with pytest.raises(ValueError, match='finite'):
            odometry.update(*arguments)
    with pytest.raises(ValueError, match='finite'):
        odometry.reset(Pose(0.0, bad, 0.0))
    for arguments in ((0.1, 0.1, None, 0.0), (0.1, 0.1, None, -1.0), (0.1, 0.1, None, 1.0, -1.0)):
        with pytest.raises(ValueError, match='positive'):
            odometry.update(*arguments)
    assert odometry.pose == before
    assert np.array_equal(odometry.covariance, covariance)
    with pytest.raises(ParameterError, match='slip_threshold'):
        with_constants(GyroOdometryParameters, standstill_spread=0.01)(slip_threshold=0.02)


def test_uncertainty_grows_in_motion_not_at_standstill():
    robots, odometries = Robots(1, 16), make_odometries()
    robots.stand(odometries, 2.5)
    traces = []
    for _ in robots.drive(odometries, run([(6.0, 5.0, 2.0)])[:, :, None]):
        traces.append(np.trace(odometries[0].covariance))
    assert np.all(np.diff(traces) > 0.0)
    robots.stand(odometries, 0.5)
    moved = np.trace(odometries[0].covariance)
    robots.stand(odometries, 0.4)
    assert np.trace(odometries[0].covariance) == moved
    robots.stand(odometries, 3.0)
    assert np.trace(odometries[0].covariance) < moved
