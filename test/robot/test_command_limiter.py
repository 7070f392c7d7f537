# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The guard: every rule of motion."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import BodyTwist, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.command_limiter import CommandLimiter, CommandLimiterParameters
from t3mpc_ros.robot.interface import RobotCommand

MS = 1_000_000
GEOMETRY = WheelGeometry()


def guard(**parameters: float) -> CommandLimiter:
    return CommandLimiter(CommandLimiterParameters(**parameters), GEOMETRY)


def quick(**parameters: float) -> CommandLimiter:
    """A guard whose ramps are over within a millisecond."""
    return guard(acceleration=1e5, stop_deceleration=1e5, **parameters)


def command(right: float, left: float, stamp_ms: float = 0.0) -> RobotCommand:
    return RobotCommand(WheelSpeeds(right, left), round(stamp_ms * MS))


def test_before_the_first_command_the_target_is_zero_and_the_reason_says_so():
    limited_command = guard().advance(0, 0.01)
    assert limited_command.wheels == (0.0, 0.0)
    assert limited_command.reason == 'no command yet'
    assert not limited_command.timed_out


def test_a_command_within_limits_is_passed_on_unchanged_and_without_delay():
    watch = quick()
    assert watch.accept(command(3.0, -2.0), 0) == ''
    limited_command = watch.advance(0, 0.01)
    assert limited_command.wheels == (3.0, -2.0)
    assert not limited_command.limited
    assert limited_command.reason == ''


def test_twists_and_wheel_speeds_are_two_words_for_one_command():
    watch = quick()
    assert watch.accept_twist(BodyTwist(0.2, 1.0), 0) == ''
    twist = twist_from_wheels(watch.advance(0, 0.01).wheels, GEOMETRY)
    assert twist == pytest.approx((0.2, 1.0))


def test_any_command_is_limited_by_one_factor_so_that_curvature_is_kept():
    generator = np.random.default_rng(1)
    for _ in range(300):
        limits = CommandLimiterParameters(
            linear_speed=generator.uniform(0.05, 1.0),
            angular_speed=generator.uniform(0.5, 10.0),
            wheel_speed=generator.uniform(2.0, 30.0),
            acceleration=1e5,
            stop_deceleration=1e5,
        )
        watch = CommandLimiter(limits, GEOMETRY)
        wanted = BodyTwist(*(generator.uniform(-1.0, 1.0, 2) * 10.0 ** generator.uniform(-2, 6)))
        watch.accept_twist(wanted, 0)
        limited_command = watch.advance(0, 1e4)
        twist = twist_from_wheels(limited_command.wheels, GEOMETRY)
        factor = twist.linear / wanted.linear
        assert twist.angular / wanted.angular == pytest.approx(factor, rel=1e-6)
        assert 0.0 < factor <= 1.0 + 1e-9
        shares = (
            abs(twist.linear) / limits.linear_speed,
            abs(twist.angular) / limits.angular_speed,
            max(map(abs, limited_command.wheels)) / limits.wheel_speed,
        )
        assert max(shares) <= 1.0 + 1e-9
        # No more is taken away than must be.
        assert limited_command.limited == (max(shares) > 1.0 - 1e-9)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_is_refused_with_a_reason_and_stops(bad):
    watch = quick()
    for wrong in (command(bad, 1.0), command(1.0, bad)):
        watch.accept(command(5.0, 5.0), 0)
        assert 'not finite' in watch.accept(wrong, 0)
        limited_command = watch.advance(0, 0.01)
        assert limited_command.target == (0.0, 0.0)
        assert 'not finite' in limited_command.reason
    assert 'not finite' in watch.accept_twist(BodyTwist(0.1, bad), 0)
    assert watch.accept(command(5.0, 5.0), 0) == ''
    assert watch.advance(0, 0.01).reason == ''


def test_a_finite_command_that_overflows_is_refused_like_one_that_is_not():
    watch = quick()
    assert 'not finite' in watch.accept(command(1.7e308, 1.7e308), 0)
    assert 'not finite' in watch.accept_twist(BodyTwist(1.7e308, 0.0), 0)
    assert watch.advance(0, 0.01).wheels == (0.0, 0.0)


def test_the_watchdog_lets_go_at_its_time_and_not_a_nanosecond_before():
    watch = quick()
    watch.accept(command(5.0, 5.0), 0)
    before = watch.advance(250 * MS - 1, 0.01)
    assert before.target == (5.0, 5.0)
    assert not before.timed_out
    after = watch.advance(250 * MS, 0.01)
    assert after.target == (0.0, 0.0)
    assert after.timed_out
    assert after.reason == 'no command for 0.25 s'
    # A new command clears it.
    watch.accept(command(1.0, 1.0, 300.0), 300 * MS)
    assert watch.advance(300 * MS, 0.01).reason == ''
    assert not watch.timed_out


def test_repeating_an_old_command_does_not_feed_the_watchdog():
    """A bridge that repeats what it heard last must not keep a robot going for ever."""
    watch = quick()
    old = command(5.0, 5.0, 0.0)
    for now in range(0, 400, 10):
        watch.accept(old, now * MS)
        limited_command = watch.advance(now * MS, 0.01)
        assert (limited_command.target == (5.0, 5.0)) == (now < 250)


def test_stale_and_overtaken_commands_are_not_taken():
    watch = quick()
    watch.accept(command(5.0, 5.0, 400.0), 400 * MS)
    assert 'too old' in watch.accept(command(9.0, 9.0, 100.0), 400 * MS)
    assert 'older than the one before' in watch.accept(command(9.0, 9.0, 399.0), 410 * MS)
    assert watch.advance(410 * MS, 0.01).target == (5.0, 5.0)


def test_a_stamp_in_the_future_does_not_prolong_a_command():
    watch = quick()
    watch.accept(command(5.0, 5.0, 10_000.0), 0)
    assert watch.advance(250 * MS, 0.01).timed_out


def test_a_clock_that_goes_back_stops_until_the_next_command():
    watch = quick()
    watch.accept(command(5.0, 5.0, 1000.0), 1000 * MS)
    watch.advance(1000 * MS, 0.01)
    limited_command = watch.advance(10 * MS, 0.01)
    assert limited_command.target == (0.0, 0.0)
    assert limited_command.reason == 'the clock jumped back'
    assert watch.accept(command(4.0, 4.0, 20.0), 20 * MS) == ''
    assert watch.advance(20 * MS, 0.01).target == (4.0, 4.0)


def test_a_clock_that_goes_back_does_not_make_the_speed_jump():
    watch = guard()
    now = 5_000
    for _ in range(20):
        watch.accept(command(10.0, 10.0, now), now * MS)
        speed = watch.advance(now * MS, 0.01).wheels.right
        now += 10
    assert speed == pytest.approx(6.0)
    assert watch.advance(0, 0.01).wheels.right == pytest.approx(6.0 - 0.6)


def test_stop_is_forgotten_with_the_next_command():
    watch = quick()
    watch.accept(command(5.0, 5.0), 0)
    watch.stop('shutting down', 0)
    limited_command = watch.advance(0, 0.01)
    assert (limited_command.target, limited_command.reason) == ((0.0, 0.0), 'shutting down')
    watch.accept(command(5.0, 5.0), 0)
    assert watch.advance(0, 0.01).target == (5.0, 5.0)


def test_an_emergency_stop_latches_until_it_is_released_and_waits_for_a_new_command():
    watch = quick()
    watch.accept(command(5.0, 5.0), 0)
    watch.latch('button', 0)
    for now in range(0, 1000, 50):
        assert 'button' in watch.accept(command(5.0, 5.0, now), now * MS)
        watch.stop('something else', now * MS)
        watch.accept(command(math.nan, 0.0), now * MS)
        limited_command = watch.advance(now * MS, 0.01)
        assert limited_command.target == (0.0, 0.0)
        assert limited_command.estop
        assert limited_command.reason == 'emergency stop: button'
    # Not even a clock that starts again releases it.
    assert watch.advance(0, 0.01).estop
    assert watch.release(0) == ''
    limited_command = watch.advance(0, 0.01)
    assert limited_command.target == (0.0, 0.0)
    assert not limited_command.estop
    assert 'released' in limited_command.reason
    assert watch.accept(command(5.0, 5.0), 0) == ''
    assert watch.advance(0, 0.01).target == (5.0, 5.0)
    assert 'no emergency stop' in watch.release(0)


def test_no_wheel_changes_faster_than_allowed_whatever_is_commanded():
    generator = np.random.default_rng(2)
    watch, now, before = guard(), 0, (0.0, 0.0)
    for _ in range(2000):
        if generator.uniform() < 0.1:
            watch.accept(command(*generator.uniform(-15.0, 15.0, 2), now), now * MS)
        if generator.uniform() < 0.02:
            watch.stop('test', now * MS)
        limited_command = watch.advance(now * MS, 0.01)
        rate = 60.0 if limited_command.target == (0.0, 0.0) else 30.0
        change = np.abs(np.array(limited_command.wheels) - before).max()
        assert change <= rate * 0.01 + 1e-9
        before = limited_command.wheels
        now += 10


def test_slowing_down_to_rest_keeps_the_curvature():
    watch = guard()
    for now in range(0, 500, 10):
        watch.accept(command(10.0, 4.0, now), now * MS)
        watch.advance(now * MS, 0.01)
    watch.stop('test', 500 * MS)
    for now in range(500, 640, 10):
        wheels = watch.advance(now * MS, 0.01).wheels
        assert wheels.left == pytest.approx(0.4 * wheels.right, rel=1e-9)
    assert wheels.right > 0.0
    assert watch.advance(700 * MS, 0.1).wheels == (0.0, 0.0)


def test_stopping_may_be_quicker_than_driving_and_never_gentler():
    watch = guard()
    for now in range(0, 500, 10):
        watch.accept(command(10.0, 10.0, now), now * MS)
        watch.advance(now * MS, 0.01)
    watch.accept(command(5.0, 5.0, 500), 500 * MS)
    assert watch.advance(500 * MS, 0.01).wheels.right == pytest.approx(10.0 - 0.3)
    watch.accept(command(0.0, 0.0, 510), 510 * MS)
    assert watch.advance(510 * MS, 0.01).wheels.right == pytest.approx(9.7 - 0.6)
    with pytest.raises(ParameterError, match='stop_deceleration'):
        CommandLimiterParameters(acceleration=80.0)


def test_the_ramp_does_not_depend_on_how_often_it_is_asked():
    ends = []
    for period in (1, 5, 10, 50):
        watch = guard()
        watch.accept(command(10.0, -5.0), 0)
        for now in range(0, 200, period):
            limited_command = watch.advance(now * MS, period / 1e3)
        ends.append(limited_command.wheels)
    assert np.ptp(np.array(ends), axis=0) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert ends[0].right == pytest.approx(6.0)


def test_a_guard_that_was_not_asked_for_long_does_not_leap():
    watch = guard()
    watch.accept(command(10.0, 10.0), 0)
    assert watch.advance(0, 0.01).wheels.right == pytest.approx(0.3)
    watch.accept(command(10.0, 10.0, 60_000), 60_000 * MS)
    assert watch.advance(60_000 * MS, 0.01).wheels.right == pytest.approx(0.6)


def test_limits_may_change_while_running():
    watch = quick()
    watch.accept(command(10.0, 10.0), 0)
    watch.parameters = CommandLimiterParameters(
        wheel_speed=2.0, acceleration=1e5, stop_deceleration=1e5
    )
    assert watch.advance(0, 0.01).wheels == pytest.approx((2.0, 2.0))
    watch.parameters = CommandLimiterParameters(
        wheel_speed=0.0, acceleration=1e5, stop_deceleration=1e5
    )
    assert watch.advance(10 * MS, 0.01).wheels == (0.0, 0.0)
