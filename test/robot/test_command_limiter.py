# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Command limiter: limits, ramps, timeout and stops."""

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


def make_limiter(**parameters: float) -> CommandLimiter:
    return CommandLimiter(CommandLimiterParameters(**parameters), GEOMETRY)


def make_fast_limiter(**parameters: float) -> CommandLimiter:
    """Return a limiter whose ramps end within a millisecond."""
    return make_limiter(acceleration=1e5, stop_deceleration=1e5, **parameters)


def command(right: float, left: float, stamp_ms: float = 0.0) -> RobotCommand:
    return RobotCommand(WheelSpeeds(right, left), round(stamp_ms * MS))


def test_initial_target_is_zero_with_a_reason():
    limited_command = make_limiter().advance(0, 0.01)
    assert limited_command.wheels == (0.0, 0.0)
    assert limited_command.reason == 'no command yet'
    assert not limited_command.timed_out


def test_command_within_limits_passes_unchanged_without_delay():
    limiter = make_fast_limiter()
    assert limiter.accept(command(3.0, -2.0), 0) == ''
    limited_command = limiter.advance(0, 0.01)
    assert limited_command.wheels == (3.0, -2.0)
    assert not limited_command.limited
    assert limited_command.reason == ''


def test_twist_and_wheel_speed_commands_are_equivalent():
    limiter = make_fast_limiter()
    assert limiter.accept(RobotCommand.from_twist(BodyTwist(0.2, 1.0), GEOMETRY, 0), 0) == ''
    twist = twist_from_wheels(limiter.advance(0, 0.01).wheels, GEOMETRY)
    assert twist == pytest.approx((0.2, 1.0))


def test_limits_scale_both_wheels_and_keep_curvature():
    generator = np.random.default_rng(1)
    for _ in range(300):
        limits = CommandLimiterParameters(
            linear_speed=generator.uniform(0.05, 1.0),
            angular_speed=generator.uniform(0.5, 10.0),
            wheel_speed=generator.uniform(2.0, 30.0),
            acceleration=1e5,
            stop_deceleration=1e5,
        )
        limiter = CommandLimiter(limits, GEOMETRY)
        wanted = BodyTwist(*(generator.uniform(-1.0, 1.0, 2) * 10.0 ** generator.uniform(-2, 6)))
        limiter.accept(RobotCommand.from_twist(wanted, GEOMETRY, 0), 0)
        limited_command = limiter.advance(0, 1e4)
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
        # The command is not reduced further than necessary.
        assert limited_command.limited == (max(shares) > 1.0 - 1e-9)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_non_finite_command_is_rejected_and_stops_the_robot(bad):
    limiter = make_fast_limiter()
    for wrong in (command(bad, 1.0), command(1.0, bad)):
        limiter.accept(command(5.0, 5.0), 0)
        assert 'not finite' in limiter.accept(wrong, 0)
        limited_command = limiter.advance(0, 0.01)
        assert limited_command.target == (0.0, 0.0)
        assert 'not finite' in limited_command.reason
    assert 'not finite' in limiter.accept(
        RobotCommand.from_twist(BodyTwist(0.1, bad), GEOMETRY, 0), 0
    )
    assert limiter.accept(command(5.0, 5.0), 0) == ''
    assert limiter.advance(0, 0.01).reason == ''


def test_overflowing_command_is_rejected_as_non_finite():
    limiter = make_fast_limiter()
    assert 'not finite' in limiter.accept(command(1.7e308, 1.7e308), 0)
    assert 'not finite' in limiter.accept(
        RobotCommand.from_twist(BodyTwist(1.7e308, 0.0), GEOMETRY, 0), 0
    )
    assert limiter.advance(0, 0.01).wheels == (0.0, 0.0)


def test_command_times_out_exactly_at_cmd_vel_timeout():
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0), 0)
    before = limiter.advance(250 * MS - 1, 0.01)
    assert before.target == (5.0, 5.0)
    assert not before.timed_out
    after = limiter.advance(250 * MS, 0.01)
    assert after.target == (0.0, 0.0)
    assert after.timed_out
    assert after.reason == 'no command for 0.25 s'
    # A new command ends the timeout.
    limiter.accept(command(1.0, 1.0, 300.0), 300 * MS)
    assert limiter.advance(300 * MS, 0.01).reason == ''
    assert not limiter.timed_out


def test_repeating_an_old_command_does_not_reset_the_timeout():
    """A bridge that repeats its last command must not keep the robot moving."""
    limiter = make_fast_limiter()
    old = command(5.0, 5.0, 0.0)
    for now in range(0, 400, 10):
        limiter.accept(old, now * MS)
        limited_command = limiter.advance(now * MS, 0.01)
        assert (limited_command.target == (5.0, 5.0)) == (now < 250)


def test_stale_and_out_of_order_commands_are_rejected():
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0, 400.0), 400 * MS)
    assert 'too old' in limiter.accept(command(9.0, 9.0, 100.0), 400 * MS)
    assert 'older than the one before' in limiter.accept(command(9.0, 9.0, 399.0), 410 * MS)
    assert limiter.advance(410 * MS, 0.01).target == (5.0, 5.0)


def test_future_stamp_does_not_extend_the_timeout():
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0, 10_000.0), 0)
    assert limiter.advance(250 * MS, 0.01).timed_out


def test_backward_time_jump_stops_until_the_next_command():
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0, 1000.0), 1000 * MS)
    limiter.advance(1000 * MS, 0.01)
    limited_command = limiter.advance(10 * MS, 0.01)
    assert limited_command.target == (0.0, 0.0)
    assert limited_command.reason == 'the clock jumped back'
    assert limiter.accept(command(4.0, 4.0, 20.0), 20 * MS) == ''
    assert limiter.advance(20 * MS, 0.01).target == (4.0, 4.0)


def test_backward_time_jump_keeps_speed_continuous():
    limiter = make_limiter()
    now = 5_000
    for _ in range(20):
        limiter.accept(command(10.0, 10.0, now), now * MS)
        speed = limiter.advance(now * MS, 0.01).wheels.right
        now += 10
    assert speed == pytest.approx(6.0)
    assert limiter.advance(0, 0.01).wheels.right == pytest.approx(6.0 - 0.6)


def test_stop_lasts_until_the_next_command():
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0), 0)
    limiter.stop('shutting down', 0)
    limited_command = limiter.advance(0, 0.01)
    assert (limited_command.target, limited_command.reason) == ((0.0, 0.0), 'shutting down')
    limiter.accept(command(5.0, 5.0), 0)
    assert limiter.advance(0, 0.01).target == (5.0, 5.0)


def test_emergency_stop_latches_until_release_and_new_command():
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0), 0)
    limiter.latch('button', 0)
    for now in range(0, 1000, 50):
        assert 'button' in limiter.accept(command(5.0, 5.0, now), now * MS)
        limiter.stop('something else', now * MS)
        limiter.accept(command(math.nan, 0.0), now * MS)
        limited_command = limiter.advance(now * MS, 0.01)
        assert limited_command.target == (0.0, 0.0)
        assert limited_command.estop
        assert limited_command.reason == 'emergency stop: button'
    # A restarted clock does not release it.
    assert limiter.advance(0, 0.01).estop
    assert limiter.release(0) == ''
    limited_command = limiter.advance(0, 0.01)
    assert limited_command.target == (0.0, 0.0)
    assert not limited_command.estop
    assert 'released' in limited_command.reason
    assert limiter.accept(command(5.0, 5.0), 0) == ''
    assert limiter.advance(0, 0.01).target == (5.0, 5.0)
    assert 'no emergency stop' in limiter.release(0)


def test_wheel_acceleration_never_exceeds_its_limit():
    generator = np.random.default_rng(2)
    limiter, now, before = make_limiter(), 0, (0.0, 0.0)
    for _ in range(2000):
        if generator.uniform() < 0.1:
            limiter.accept(command(*generator.uniform(-15.0, 15.0, 2), now), now * MS)
        if generator.uniform() < 0.02:
            limiter.stop('test', now * MS)
        limited_command = limiter.advance(now * MS, 0.01)
        rate = 60.0 if limited_command.target == (0.0, 0.0) else 30.0
        change = np.abs(np.array(limited_command.wheels) - before).max()
        assert change <= rate * 0.01 + 1e-9
        before = limited_command.wheels
        now += 10


def test_deceleration_to_standstill_keeps_curvature():
    limiter = make_limiter()
    for now in range(0, 500, 10):
        limiter.accept(command(10.0, 4.0, now), now * MS)
        limiter.advance(now * MS, 0.01)
    limiter.stop('test', 500 * MS)
    for now in range(500, 640, 10):
        wheels = limiter.advance(now * MS, 0.01).wheels
        assert wheels.left == pytest.approx(0.4 * wheels.right, rel=1e-9)
    assert wheels.right > 0.0
    assert limiter.advance(700 * MS, 0.1).wheels == (0.0, 0.0)


def test_stop_deceleration_is_at_least_the_acceleration():
    limiter = make_limiter()
    for now in range(0, 500, 10):
        limiter.accept(command(10.0, 10.0, now), now * MS)
        limiter.advance(now * MS, 0.01)
    limiter.accept(command(5.0, 5.0, 500), 500 * MS)
    assert limiter.advance(500 * MS, 0.01).wheels.right == pytest.approx(10.0 - 0.3)
    limiter.accept(command(0.0, 0.0, 510), 510 * MS)
    assert limiter.advance(510 * MS, 0.01).wheels.right == pytest.approx(9.7 - 0.6)
    with pytest.raises(ParameterError, match='stop_deceleration'):
        CommandLimiterParameters(acceleration=80.0)


def stop_time(limiter, now, begin):
    """Return the time from ``begin`` (ms) to the end of the ramp, s."""
    while limiter.advance(now * MS, 0.01).wheels != (0.0, 0.0):
        now += 10
    return (now - begin) / 1e3


@pytest.mark.slow
def test_settings_that_stop_too_late_are_rejected():
    """Silence and ramp were bounded one by one: 0.5 s and 3.3 s were possible together."""
    for changes in (
        {'acceleration': 30.0, 'stop_deceleration': 30.0, 'command_timeout': 0.5},
        {'acceleration': 3.0, 'stop_deceleration': 3.3},
        {'wheel_speed': 20.0},
        {'command_timeout': 0.4},
        {'max_stopping_time': 0.4},
    ):
        with pytest.raises(ParameterError, match='within max_stopping_time'):
            CommandLimiterParameters(**changes)
    assert CommandLimiterParameters(command_timeout=0.4, max_stopping_time=0.6)
    generator = np.random.default_rng(2)
    accepted = 0
    for _ in range(200):
        changes = {
            'wheel_speed': generator.uniform(0.5, 30.0),
            'acceleration': (rate := generator.uniform(5.0, 100.0)),
            'stop_deceleration': rate * generator.uniform(1.0, 3.0),
            'command_timeout': generator.uniform(0.05, 0.5),
        }
        try:
            limiter = make_limiter(linear_speed=5.0, **changes)
        except ParameterError:
            continue
        accepted += 1
        for now in range(0, 3000, 10):
            limiter.accept(command(40.0, 40.0, now), now * MS)
            limiter.advance(now * MS, 0.01)
        # The output holds for a period, and the age is checked once in it.
        assert stop_time(limiter, 3000, 2990) <= 0.5 + 0.02
    assert accepted > 20


def test_an_emergency_stop_has_a_fixed_least_deceleration():
    limiter = make_limiter(acceleration=5.0, stop_deceleration=5.0, max_stopping_time=10.0)
    for now in range(0, 3000, 10):
        limiter.accept(command(10.0, 10.0, now), now * MS)
        limiter.advance(now * MS, 0.01)
    limiter.latch('test', 3000 * MS)
    assert stop_time(limiter, 3000, 3000) <= 10.0 / 60.0 + 0.01


def test_a_lowered_speed_limit_does_not_slow_a_stop():
    limiter = make_limiter()
    for now in range(0, 1000, 10):
        limiter.accept(command(10.0, 10.0, now), now * MS)
        limiter.advance(now * MS, 0.01)
    limiter.parameters = CommandLimiterParameters(
        wheel_speed=0.5, acceleration=2.0, stop_deceleration=2.0
    )
    limiter.stop('test', 1000 * MS)
    assert stop_time(limiter, 1000, 1000) <= 9.5 / 60.0 + 0.25 + 0.02


def test_ramp_is_independent_of_the_update_rate():
    ends = []
    for period in (1, 5, 10, 50):
        limiter = make_limiter()
        limiter.accept(command(10.0, -5.0), 0)
        for now in range(0, 200, period):
            limited_command = limiter.advance(now * MS, period / 1e3)
        ends.append(limited_command.wheels)
    assert np.ptp(np.array(ends), axis=0) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert ends[0].right == pytest.approx(6.0)


def test_ramp_does_not_jump_after_a_long_pause():
    limiter = make_limiter()
    limiter.accept(command(10.0, 10.0), 0)
    assert limiter.advance(0, 0.01).wheels.right == pytest.approx(0.3)
    limiter.accept(command(10.0, 10.0, 60_000), 60_000 * MS)
    assert limiter.advance(60_000 * MS, 0.01).wheels.right == pytest.approx(0.6)


def test_a_robot_that_stopped_by_itself_starts_from_standstill():
    """A bridge that was suspended must not send a standing robot the speed from before."""
    limiter = make_limiter()
    for now in range(0, 250, 10):
        limiter.accept(command(5.0, 5.0, now), now * MS)
        before = limiter.advance(now * MS, 0.01)
    assert before.wheels.right == pytest.approx(5.0)
    limiter.assume_standstill()
    limiter.accept(command(5.0, 5.0, 2000), 2000 * MS)
    assert limiter.advance(2000 * MS, 0.01).wheels.right == pytest.approx(0.3)


def test_limits_change_while_running():
    limiter = make_fast_limiter()
    limiter.accept(command(10.0, 10.0), 0)
    limiter.parameters = CommandLimiterParameters(
        wheel_speed=2.0, acceleration=1e5, stop_deceleration=1e5
    )
    assert limiter.advance(0, 0.01).wheels == pytest.approx((2.0, 2.0))
    limiter.parameters = CommandLimiterParameters(
        wheel_speed=0.0, acceleration=1e5, stop_deceleration=1e5
    )
    assert limiter.advance(10 * MS, 0.01).wheels == (0.0, 0.0)
