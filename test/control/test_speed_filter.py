# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Limits of the command; the state estimate; freshness."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.actuation import LimitParameters, limit_command, limit_scale, wheel_limits
from t3mpc_ros.control.speed_filter import (
    SpeedFilterParameters,
    SpeedKalmanFilter,
    stationary_gain,
)
from t3mpc_ros.control.watchdog import InputWatchdog, Reason, WatchdogParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, WheelSpeeds

LIMITS = LimitParameters()
GEOMETRY = WheelGeometry()
MS = 1_000_000


def test_a_scaled_command_keeps_its_curvature_and_the_limits():
    rng = np.random.default_rng(3)
    for _ in range(2000):
        wish = BodyTwist(*rng.normal(scale=(2.0, 20.0)))
        asked = wheels_from_twist(wish, GEOMETRY)
        share = limit_scale(*asked, wheel_limits(LIMITS, GEOMETRY)[0])
        limited = twist_from_wheels(WheelSpeeds(share * asked.right, share * asked.left), GEOMETRY)
        assert abs(limited.linear) <= LIMITS.linear * (1 + 1e-12)
        assert abs(limited.angular) <= LIMITS.angular * (1 + 1e-12)
        assert limited.linear * wish.angular == pytest.approx(limited.angular * wish.linear)
        assert max(share * abs(asked.right), share * abs(asked.left)) <= LIMITS.wheel_speed * (
            1 + 1e-12
        )
        free = max(map(abs, asked)) <= LIMITS.wheel_speed
        free &= abs(wish.linear) <= LIMITS.linear and abs(wish.angular) <= LIMITS.angular
        assert (share == 1.0) == free


def test_the_command_change_respects_the_acceleration_limits():
    rng = np.random.default_rng(4)
    limits, out = wheel_limits(LIMITS, GEOMETRY), np.zeros(2)
    for _ in range(2000):
        before, asked = rng.normal(scale=6.0, size=(2, 2))
        cut = limit_command(*asked, before, limits, 0.01, out)
        assert cut == (not np.allclose(out, asked, rtol=0.0, atol=1e-8))
        change = twist_from_wheels(WheelSpeeds(*(out - before)), GEOMETRY)
        assert abs(change.linear) <= LIMITS.linear_acceleration * 0.01 * (1 + 1e-9)
        assert abs(change.angular) <= LIMITS.angular_acceleration * 0.01 * (1 + 1e-9)
        assert np.max(np.abs(out - before)) <= LIMITS.wheel_acceleration * 0.01 * (1 + 1e-9)


def test_a_huge_target_gives_a_finite_command():
    limits, out = wheel_limits(LIMITS, GEOMETRY), np.zeros(2)
    assert limit_command(1e300, -1e300, np.zeros(2), limits, 0.01, out)
    assert np.isfinite(out).all()


@pytest.mark.parametrize('drive', ['velocity', 'torque'])
def test_the_filter_reduces_noise_and_finds_the_disturbance(drive):
    parameters = SpeedFilterParameters(noise_variance=0.04, disturbance=10.0)
    estimator = SpeedKalmanFilter(parameters, drive, 0.01)
    rng = np.random.default_rng(6)
    chi = np.zeros(2)
    push = np.array([4.0, -2.0])  # what the model does not know of, rad/s²
    raw, filtered, unexplained = [], [], []
    late = [np.zeros(2)] * 2
    for k in range(3000):
        command = 3.0 * np.array([math.sin(0.02 * k), math.cos(0.015 * k)])
        if drive == 'velocity':
            late = [late[1], command]  # dead time of one period
            decay = math.exp(-0.01 / parameters.lag)
            chi = decay * chi + (1 - decay) * (late[0] + parameters.lag * push)
        else:
            chi = chi + 0.01 * (command + push)
        estimator.predict(command, 0.01)
        measured = chi + rng.normal(scale=0.2, size=2)
        estimate = estimator.correct(measured)
        if k > 500:
            raw.append(measured - chi)
            filtered.append(estimate - chi)
            unexplained.append(estimator.disturbance.copy())
    ratio = np.std(filtered) / np.std(raw)
    assert ratio < 0.6
    np.testing.assert_allclose(np.mean(unexplained, axis=0), push, atol=0.6)  # three sigma


def test_the_gain_is_the_fixed_point_of_the_riccati_equation():
    from scipy.linalg import solve_discrete_are

    parameters = SpeedFilterParameters()
    transition = np.array([[1.0, 0.01], [0.0, 1.0]])
    process = np.diag([0.0, parameters.disturbance**2 * 0.01])
    ahead = solve_discrete_are(
        transition.T, np.array([[1.0], [0.0]]), process, np.array([[parameters.noise_variance]])
    )
    expected = ahead[:, 0] / (ahead[0, 0] + parameters.noise_variance)
    np.testing.assert_allclose(stationary_gain(transition, parameters, 0.01), expected, rtol=1e-6)


def test_without_noise_or_disabled_the_measurement_is_used():
    for parameters in (
        SpeedFilterParameters(enabled=False),
        SpeedFilterParameters(noise_variance=0.0),
    ):
        estimator = SpeedKalmanFilter(parameters, 'torque', 0.01)
        estimator.predict(np.array([5.0, 5.0]), 0.01)
        np.testing.assert_allclose(estimator.correct(np.array([1.0, 2.0])), [1.0, 2.0], rtol=1e-3)


def test_an_unknown_drive_is_rejected():
    with pytest.raises(ValueError, match='drive'):
        SpeedKalmanFilter(SpeedFilterParameters(), 'warp', 0.01)


def _decide(watchdog, stamp_ms, **changes):
    facts = {'finite': True, 'known': True, 'speed': 1.0, 'error': 0.1} | changes
    return watchdog.decide(stamp_ms * MS, **facts)


def test_every_reason_to_stop_is_detected():
    watchdog = InputWatchdog(WatchdogParameters())
    assert _decide(watchdog, 0) is Reason.NO_REFERENCE
    watchdog.reference_received()
    assert _decide(watchdog, 10) is Reason.TRACKING
    assert _decide(watchdog, 20, finite=False) is Reason.ODOMETRY_BAD
    assert _decide(watchdog, 30, known=False) is Reason.NO_REFERENCE
    assert _decide(watchdog, 150) is Reason.TRACKING
    assert _decide(watchdog, 170) is Reason.REFERENCE_STALE
    watchdog.reference_received()
    assert _decide(watchdog, 180) is Reason.TRACKING
    watchdog.enabled = False
    watchdog.reference_received()
    assert _decide(watchdog, 190) is Reason.DISABLED
    watchdog.enabled = True
    assert _decide(watchdog, 200) is Reason.TRACKING


@pytest.mark.parametrize('fault', [{'speed': 41.0}, {'error': 26.0}])
def test_a_diverging_state_stops_the_robot_for_the_hold_time(fault):
    watchdog = InputWatchdog(WatchdogParameters())
    reasons = []
    for k in range(100):
        watchdog.reference_received()
        reasons.append(_decide(watchdog, 10 * k, **(fault if k == 10 else {})))
    assert reasons[9] is Reason.TRACKING
    assert all(reason is Reason.DIVERGING for reason in reasons[10:61])
    assert all(reason is Reason.TRACKING for reason in reasons[61:])


def test_elapsed_is_none_for_first_messages_gaps_and_restarts():
    watchdog = InputWatchdog(WatchdogParameters())
    assert watchdog.elapsed(1000 * MS) is None
    assert watchdog.elapsed(1010 * MS) == pytest.approx(0.01)
    assert watchdog.elapsed(1300 * MS) is None
    assert watchdog.elapsed(1310 * MS) == pytest.approx(0.01)
    assert watchdog.elapsed(500 * MS) is None


def test_the_odometry_timeout_is_measured_with_one_clock():
    watchdog = InputWatchdog(WatchdogParameters(odometry_timeout=0.2))
    assert watchdog.odometry_timed_out(None, 0)
    assert not watchdog.odometry_timed_out(1000 * MS, 1199 * MS)
    assert watchdog.odometry_timed_out(1000 * MS, 1201 * MS)
