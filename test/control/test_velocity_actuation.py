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
"""Actuation and its filter: with both drives the plant is chi_(k+1) = chi_k + T (u_k + d_k)."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.speed_kalman_filter import (
    SpeedFilterParameters,
    SpeedKalmanFilter,
    stationary_gain,
)
from t3mpc_ros.control.velocity_actuation import (
    LimitParameters,
    VelocityActuation,
    limit_command,
    limit_scale,
    wheel_limits,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, WheelSpeeds

T = 0.01
GEOMETRY = WheelGeometry()
LIMITS = LimitParameters()
WIDE = LimitParameters(
    linear=5.0,
    angular=50.0,
    wheel_speed=200.0,
    linear_acceleration=50.0,
    angular_acceleration=500.0,
    wheel_acceleration=1e4,
    deadband=0.0,
)


class Servo:
    """Exact response of the wheels to commands, with lag and dead time."""

    def __init__(self, lag=0.02, dead_time=0.01, disturbance=(0.0, 0.0)):
        self.lag, self.disturbance = lag, np.array(disturbance)
        self.delay = round(dead_time / 0.001)
        self.commands = [np.zeros(2)] * (self.delay + 1)
        self.speeds = np.zeros(2)
        self.fine = []
        """Speeds of every millisecond, before its step."""

    def run(self, command):
        decay = math.exp(-0.001 / self.lag)
        for _ in range(10):
            self.fine.append(self.speeds.copy())
            self.commands = [*self.commands[1:], command.copy()]
            goal = self.commands[0] + self.lag * self.disturbance
            self.speeds = goal + decay * (self.speeds - goal)


def _drive(limits=WIDE, kind='velocity', **changes):
    parameters = SpeedFilterParameters(**({'noise_variance': 0.0} | changes))
    return VelocityActuation(parameters, limits, GEOMETRY, kind, T)


@pytest.mark.parametrize('dead_time', [0.0, 0.017, 0.03])
def test_e19_wheels_accelerate_by_u_after_the_dead_time(dead_time):
    """Chi is predicted for the instant of effect, and increases by T u within a period."""
    drive, servo = _drive(dead_time=dead_time), Servo(dead_time=dead_time)
    rng = np.random.default_rng(1)
    expected = []
    for _ in range(60):
        drive.observe(servo.speeds, T)
        expected.append(drive.predicted.copy())
        u = rng.uniform(-20.0, 20.0, 2)
        np.testing.assert_allclose(drive.send_acceleration(u), u, atol=1e-9)
        expected.append(drive.predicted + T * u)
        servo.run(drive.command)
    delay = round(dead_time / 0.001)
    for k in range(2, 50):
        np.testing.assert_allclose(servo.fine[10 * k + delay], expected[2 * k], atol=1e-6)
        np.testing.assert_allclose(
            servo.fine[10 * (k + 1) + delay], expected[2 * k + 1], atol=1e-6
        )


def test_with_the_servo_gain_the_measurement_cancels():
    """K = (1 - exp(-T/lag))/T makes c = r + (r_next - r)/(1 - exp(-T/lag))."""
    share = 1.0 - math.exp(-T / 0.02)
    rng = np.random.default_rng(2)
    reference, rate = np.array([2.0, -1.0]), np.array([3.0, 4.0])
    commands = []
    for _ in range(2):
        drive = _drive(noise_variance=0.04)
        for _ in range(20):
            drive.observe(reference + rng.normal(scale=0.5, size=2), T)
            drive.send_acceleration(rate - share / T * (drive.predicted - reference))
        commands.append(drive.command.copy())
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-9)
    np.testing.assert_allclose(commands[0], reference + T * rate / share, atol=1e-9)


def test_a_constant_disturbance_is_estimated_after_the_servo():
    """chi_(k+1) = chi_k + T (u_k + d_k) with d_k below the disturbance: the servo attenuates it.

    A law that cancelled the disturbance itself would cancel a quarter too much.
    """
    drive, servo = _drive(), Servo(disturbance=(4.0, -3.0))
    before = None
    for _ in range(200):
        drive.observe(servo.speeds, T)
        if before is not None:
            expected = before[0] + T * (before[1] + drive.disturbance)
        before = drive.predicted.copy(), drive.send_acceleration(np.array([2.0, -1.0])).copy()
        servo.run(drive.command)
    felt = 0.02 / T * (1.0 - math.exp(-T / 0.02))
    np.testing.assert_allclose(drive.disturbance, felt * np.array([4.0, -3.0]), rtol=1e-3)
    np.testing.assert_allclose(before[0], expected, rtol=1e-6)


def test_a_torque_drive_has_no_limits_and_no_dead_time():
    drive = _drive(LimitParameters(), 'torque')
    speeds = np.array([1.0, 2.0])
    drive.reset(speeds)
    drive.observe(speeds, T)
    u = np.array([500.0, -700.0])
    np.testing.assert_array_equal(drive.send_acceleration(u), u)
    assert not drive.limited
    assert drive.dead_time == 0.0
    np.testing.assert_array_equal(drive.predicted, drive.speeds)


def test_the_command_does_not_wind_up_behind_a_limit():
    """After ten seconds of full acceleration, deceleration takes effect at once.

    An integrator that grows behind the limit would need the same time to return.
    """
    limits = LimitParameters()
    drive, servo = _drive(limits), Servo()
    for _ in range(1000):
        drive.observe(servo.speeds, T)
        drive.send_acceleration(np.full(2, 30.0))
        servo.run(drive.command)
    assert drive.twist.linear == pytest.approx(limits.linear)
    assert drive.limited
    top = drive.twist.linear
    for _ in range(3):
        drive.observe(servo.speeds, T)
        drive.send_acceleration(np.full(2, -30.0))
        servo.run(drive.command)
    assert drive.twist.linear < top - 2 * limits.linear_acceleration * T


def test_the_applied_acceleration_is_that_of_the_limited_command():
    rng = np.random.default_rng(5)
    drive, servo = _drive(LimitParameters(deadband=0.0)), Servo()
    stretch = T / (1.0 - math.exp(-T / 0.02))
    limited = 0
    for _ in range(500):
        before = drive.command.copy()
        drive.observe(servo.speeds, T)
        u = rng.normal(scale=60.0, size=2)
        applied = drive.send_acceleration(u)
        np.testing.assert_allclose(drive.command, drive.predicted + stretch * applied, atol=1e-9)
        assert np.max(np.abs(drive.command - before)) <= 30.0 * T * (1 + 1e-9)
        if not drive.limited:
            np.testing.assert_allclose(applied, u, atol=1e-6)
        limited += drive.limited
        servo.run(drive.command)
    assert 100 < limited <= 500


def _commands(limits, goals):
    """Return the commands for wheel speeds that are wanted, shape (n, 2)."""
    drive, commands = _drive(limits), []
    for goal in goals:
        drive.observe(drive.command, T)
        drive.send_speeds(np.array(goal))
        commands.append(drive.command.copy())
    return np.array(commands)


def test_a_robot_that_follows_is_not_shaken_by_a_measurement():
    """The first speeds by the pose in place of a wrong twist were a step of the command."""
    drive = _drive(noise_variance=0.04)
    drive.send_speeds(np.array([3.0, -2.0]))
    sent = drive.command.copy()
    assert sent.any()
    noise = np.array([0.9, -0.7])
    drive.reset(sent + noise, follows=True)
    np.testing.assert_array_equal(drive.command, sent)
    np.testing.assert_array_equal(drive.speeds, sent)
    for measured, follows in ((sent + 1.2, True), (sent + 1.2, False), (np.zeros(2), True)):
        drive.reset(measured, follows=follows)  # another robot, or one that does not follow
        np.testing.assert_allclose(drive.command, measured)
        drive.reset(sent)


@pytest.mark.parametrize('acceleration', [1.0, 30.0])
def test_slow_commands_are_left_out_within_the_limits(acceleration):
    """A sweep through zero commands stop or the deadband; the step between them is limited too."""
    limits = LimitParameters(wheel_acceleration=acceleration, deadband=0.05)
    wanted = [0.2 * math.sin(0.01 * k) * np.array([1.0, -1.0]) for k in range(2000)]
    commands = _commands(limits, wanted)
    slow = np.abs(wanted) < 0.05
    assert np.abs(np.diff(commands, axis=0)).max() <= acceleration * T * (1 + 1e-9)
    assert np.abs(commands - wanted)[~slow].max() <= (0.05 if acceleration < 5.0 else 0.0)
    if acceleration == 30.0:
        assert np.isin(np.abs(commands[slow]), (0.0, 0.05)).all()


@pytest.mark.parametrize('speed', [0.002, 0.01, 0.019, 0.03, 0.05, -0.03])
def test_a_creeping_wheel_has_the_right_mean_speed(speed):
    """With stop or the nearer speed alone, 0.03 rad/s is driven with 0.055, 0.01 not at all."""
    commands = _commands(LimitParameters(), [(speed, -speed)] * 6000)
    behind = np.abs(np.cumsum(np.array([speed, -speed]) - commands, axis=0)) * T
    assert behind.max() < 0.0206  # and one period
    assert np.isin(commands, (0.0, 0.055, -0.055)).all()


def test_a_wheel_that_is_to_stand_makes_up_for_nothing():
    """What a creeping wheel is behind turns none whose reference is at rest, or is faster."""
    for then in (0.0, 0.2):
        commands = _commands(LimitParameters(), [(0.015, 0.03)] * 100 + [(then, then)] * 100)
        assert np.ptp(commands[110:], axis=0).max() == 0.0
        assert commands[-1] == pytest.approx(then)


def test_a_deadband_hides_no_command_that_is_not_a_number():
    """It made 0 of it: the robot stood, and nothing said why."""
    drive = _drive(LimitParameters())
    drive.observe(np.zeros(2), T)
    drive.send_acceleration(np.array([math.nan, 1.0]))
    assert np.isnan(drive.command).all()


def test_a_deadband_is_at_most_a_tenth_of_the_largest_speed():
    """A robot whose wheels may turn at 0.2 rad/s at most still moves slowly."""
    commands = _commands(LimitParameters(wheel_speed=0.2), [(0.021, 0.021)] * 50)
    assert commands[-1] == pytest.approx(0.021)


def test_a_scaled_command_keeps_its_curvature_and_the_limits():
    rng = np.random.default_rng(3)
    for _ in range(500):
        target = BodyTwist(*rng.normal(scale=(2.0, 20.0)))
        wheels = wheels_from_twist(target, GEOMETRY)
        scale = limit_scale(*wheels, wheel_limits(LIMITS, GEOMETRY)[0])
        right, left = scale * wheels.right, scale * wheels.left
        limited = twist_from_wheels(WheelSpeeds(right, left), GEOMETRY)
        assert abs(limited.linear) <= LIMITS.linear * (1 + 1e-12)
        assert abs(limited.angular) <= LIMITS.angular * (1 + 1e-12)
        assert limited.linear * target.angular == pytest.approx(limited.angular * target.linear)
        assert max(abs(right), abs(left)) <= LIMITS.wheel_speed * (1 + 1e-12)
        free = max(map(abs, wheels)) <= LIMITS.wheel_speed
        free &= abs(target.linear) <= LIMITS.linear and abs(target.angular) <= LIMITS.angular
        assert (scale == 1.0) == free


def test_the_command_change_respects_the_acceleration_limits():
    rng = np.random.default_rng(4)
    limits, out = wheel_limits(LIMITS, GEOMETRY), np.zeros(2)
    for _ in range(500):
        previous, target = rng.normal(scale=6.0, size=(2, 2))
        limited = limit_command(*target, previous, limits, 0.01, out)
        assert limited == (not np.allclose(out, target, rtol=0.0, atol=1e-8))
        change = twist_from_wheels(WheelSpeeds(*(out - previous)), GEOMETRY)
        assert abs(change.linear) <= LIMITS.linear_acceleration * 0.01 * (1 + 1e-9)
        assert abs(change.angular) <= LIMITS.angular_acceleration * 0.01 * (1 + 1e-9)
        assert np.max(np.abs(out - previous)) <= LIMITS.wheel_acceleration * 0.01 * (1 + 1e-9)
    assert limit_command(1e300, -1e300, np.zeros(2), limits, 0.01, out)
    assert np.isfinite(out).all()


# -- Kalman filter of the wheel speeds ------------------------------------------------------------


@pytest.mark.parametrize('drive', ['velocity', 'torque'])
def test_the_filter_reduces_noise_and_finds_the_disturbance(drive):
    parameters = SpeedFilterParameters(noise_variance=0.04, disturbance=10.0)
    speed_filter = SpeedKalmanFilter(parameters, drive, 0.01)
    rng = np.random.default_rng(6)
    chi = np.zeros(2)
    disturbance = np.array([4.0, -2.0])  # not in the model, rad/s²
    raw, filtered, estimates = [], [], []
    delayed = [np.zeros(2)] * 2
    for k in range(2000):
        command = 3.0 * np.array([math.sin(0.02 * k), math.cos(0.015 * k)])
        if drive == 'velocity':
            delayed = [delayed[1], command]  # dead time of one period
            decay = math.exp(-0.01 / parameters.lag)
            chi = decay * chi + (1 - decay) * (delayed[0] + parameters.lag * disturbance)
        else:
            chi = chi + 0.01 * (command + disturbance)
        measured = chi + rng.normal(scale=0.2, size=2)
        speed_filter.update(command, measured, 0.01, sent=True)
        if k > 500:
            raw.append(measured - chi)
            filtered.append(speed_filter.state.speeds - chi)
            estimates.append(speed_filter.state.disturbance.copy())
    ratio = np.std(filtered) / np.std(raw)
    assert ratio < 0.6
    np.testing.assert_allclose(np.mean(estimates, axis=0), disturbance, atol=0.6)  # three sigma


def test_the_gain_is_the_fixed_point_of_the_riccati_equation():
    from scipy.linalg import solve_discrete_are

    parameters = SpeedFilterParameters()
    transition = np.array([[1.0, 0.01], [0.0, 1.0]])
    process = np.diag([0.0, parameters.disturbance**2 * 0.01])
    predicted = solve_discrete_are(
        transition.T, np.array([[1.0], [0.0]]), process, np.array([[parameters.noise_variance]])
    )
    expected = predicted[:, 0] / (predicted[0, 0] + parameters.noise_variance)
    np.testing.assert_allclose(stationary_gain(transition, parameters, 0.01), expected, rtol=1e-6)


def test_without_noise_or_disabled_the_measurement_is_used():
    for parameters in (
        SpeedFilterParameters(enabled=False),
        SpeedFilterParameters(noise_variance=0.0),
    ):
        speed_filter = SpeedKalmanFilter(parameters, 'torque', 0.01)
        speed_filter.update(np.array([5.0, 5.0]), np.array([1.0, 2.0]), 0.01, sent=True)
        np.testing.assert_allclose(speed_filter.state.speeds, [1.0, 2.0], rtol=1e-3)
