# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The seam between law and robot: both drives are chi_(k+1) = chi_k + T (u_k + d_k)."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.actuation import LimitParameters, VelocityActuation
from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry

T = 0.01
WIDE = LimitParameters(
    linear=5.0,
    angular=50.0,
    wheel_speed=200.0,
    linear_acceleration=50.0,
    angular_acceleration=500.0,
    wheel_acceleration=1e4,
)


class Servo:
    """Wheels that follow the command with lag and dead time, exactly."""

    def __init__(self, lag=0.02, dead_time=0.01, push=(0.0, 0.0)):
        self.lag, self.push = lag, np.array(push)
        self.late = round(dead_time / 0.001)
        self.told = [np.zeros(2)] * (self.late + 1)
        self.speeds = np.zeros(2)

    def run(self, command):
        decay = math.exp(-0.001 / self.lag)
        for _ in range(10):
            self.told = [*self.told[1:], command.copy()]
            goal = self.told[0] + self.lag * self.push
            self.speeds = goal + decay * (self.speeds - goal)


def _drive(limits=WIDE, kind='velocity', **estimate):
    given = {'noise_variance': 0.0} | estimate
    return VelocityActuation(SpeedFilterParameters(**given), limits, WheelGeometry(), kind, T)


@pytest.mark.parametrize('dead_time', [0.0, 0.004, 0.01, 0.017, 0.03])
def test_e19_wheels_accelerate_by_u_after_the_dead_time(dead_time):
    """Chi at the instant of acting is foreseen, and one period later it is T u further on."""
    drive, servo = _drive(dead_time=dead_time), Servo(dead_time=dead_time)
    rng = np.random.default_rng(1)
    fine = []
    expected = []
    for _ in range(60):
        drive.observe(servo.speeds, T)
        expected.append(drive.predicted.copy())
        u = rng.uniform(-20.0, 20.0, 2)
        np.testing.assert_allclose(drive.send_acceleration(u), u, atol=1e-9)
        expected.append(drive.predicted + T * u)
        for _ in range(10):  # what the servo does, millisecond by millisecond
            fine.append(servo.speeds.copy())
            servo.told = [*servo.told[1:], drive.command.copy()]
            decay = math.exp(-0.001 / servo.lag)
            servo.speeds = servo.told[0] + decay * (servo.speeds - servo.told[0])
    late = round(dead_time / 0.001)
    for k in range(2, 50):
        np.testing.assert_allclose(fine[10 * k + late], expected[2 * k], atol=1e-6)
        np.testing.assert_allclose(fine[10 * (k + 1) + late], expected[2 * k + 1], atol=1e-6)


def test_with_the_servo_gain_the_measurement_cancels():
    """K = (1 - exp(-T/lag))/T: c = r + (r_next - r)/(1 - exp(-T/lag)), whatever is measured."""
    share = 1.0 - math.exp(-T / 0.02)
    rng = np.random.default_rng(2)
    wanted, rate = np.array([2.0, -1.0]), np.array([3.0, 4.0])
    commands = []
    for _ in range(2):
        drive = _drive(noise_variance=0.04)
        for _ in range(20):
            drive.observe(wanted + rng.normal(scale=0.5, size=2), T)
            drive.send_acceleration(rate - share / T * (drive.predicted - wanted))
        commands.append(drive.command.copy())
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-9)
    np.testing.assert_allclose(commands[0], wanted + T * rate / share, atol=1e-9)


def test_a_constant_disturbance_is_estimated_after_the_servo():
    """chi_(k+1) = chi_k + T (u_k + d_k), d_k less than the push, because the servo resists it.

    Told as it is, a law that cancels d cancelled a quarter too much.
    """
    drive, servo = _drive(), Servo(push=(4.0, -3.0))
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
    """Full throttle for ten seconds, then full brake: the command must turn round at once.

    An integral that had gone on growing behind the limit would need as long to come back.
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
    drive, servo = _drive(LimitParameters()), Servo()
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


def test_an_unknown_drive_or_period_is_rejected():
    with pytest.raises(ValueError, match='drive must be'):
        _drive(kind='warp')
    with pytest.raises(ValueError, match='period must be positive: got 0'):
        VelocityActuation(SpeedFilterParameters(), WIDE, WheelGeometry(), 'torque', 0.0)
