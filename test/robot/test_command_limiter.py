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
"""Command limiter: limits, ramps, timeout and stops."""

import math

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
import numpy as np
import pytest
from support.properties import STATEFUL

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.command_limiter import CommandLimiter, CommandLimiterParameters, SlipMonitor
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

MS = 1_000_000
GEOMETRY = WheelGeometry()


def make_limiter(**parameters: float) -> CommandLimiter:
    return CommandLimiter(CommandLimiterParameters(**parameters), GEOMETRY)


def make_fast_limiter(**parameters: float) -> CommandLimiter:
    """Return a limiter whose ramps end within a millisecond."""
    return make_limiter(acceleration=1e5, stop_deceleration=1e5, **parameters)


def command(right: float, left: float, stamp_ms: float = 0.0) -> RobotCommand:
    return RobotCommand(WheelSpeeds(right, left), round(stamp_ms * MS))


def drive(limiter, right, left, seconds):
    """Command wheel speeds from 0 s on; return the last ones that are sent."""
    for now in range(0, round(1000 * seconds), 10):
        limiter.accept(command(right, left, now), now * MS)
        wheels = limiter.advance(now * MS, 0.01).wheels
    return wheels


def test_limits_scale_both_wheels_and_keep_curvature():
    generator = np.random.default_rng(1)
    for _ in range(100):
        limits = CommandLimiterParameters(
            linear_speed=generator.uniform(0.05, 1.0),
            angular_speed=generator.uniform(0.5, 10.0),
            wheel_speed=generator.uniform(2.0, 30.0),
            acceleration=1e5,
            stop_deceleration=1e5,
        )
        limiter = CommandLimiter(limits, GEOMETRY)
        wanted = BodyTwist(*(generator.uniform(-1.0, 1.0, 2) * 10.0 ** generator.uniform(-2, 6)))
        limiter.accept(RobotCommand(wheels_from_twist(wanted, GEOMETRY), 0), 0)
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


@pytest.mark.parametrize('wrong', [(math.nan, 1.0), (1.0, -math.inf), (1.7e308, 1.7e308)])
def test_non_finite_command_is_rejected_and_stops_the_robot(wrong):
    limiter = make_fast_limiter()
    limiter.accept(command(5.0, 5.0), 0)
    assert 'not finite' in limiter.accept(command(*wrong), 0)
    limited_command = limiter.advance(0, 0.01)
    assert limited_command.target == (0.0, 0.0)
    assert 'not finite' in limited_command.reason
    assert limiter.accept(command(3.0, -2.0), 0) == ''
    limited_command = limiter.advance(0, 0.01)
    assert limited_command.wheels == (3.0, -2.0)  # within the limits, without delay
    assert (limited_command.limited, limited_command.reason) == (False, '')


@pytest.mark.parametrize(
    ('now', 'speed', 'expected'),
    [
        (0, None, 6.0 - 0.6),
        (60_000, 10.0, 6.0 + 0.3),
        (200, 5.0, 6.0 - 0.3),
        (200, 0.0, 6.0 - 0.6),
    ],
)
def test_speed_is_continuous_whatever_the_clock(now, speed, expected):
    """When the clock jumps back, and after a pause; a stop is faster than a slower command."""
    limiter = make_limiter()
    assert drive(limiter, 10.0, 10.0, 0.2).right == pytest.approx(6.0)
    if speed is not None:
        limiter.accept(command(speed, speed, now), now * MS)
    assert limiter.advance(now * MS, 0.01).wheels.right == pytest.approx(expected)
    with pytest.raises(ParameterError, match='stop_deceleration'):
        CommandLimiterParameters(acceleration=80.0)


def test_deceleration_to_standstill_keeps_curvature():
    limiter = make_limiter()
    drive(limiter, 10.0, 4.0, 0.5)
    limiter.stop('test', 500 * MS)
    for now in range(500, 640, 10):
        wheels = limiter.advance(now * MS, 0.01).wheels
        assert wheels.left == pytest.approx(0.4 * wheels.right, rel=1e-9)
    assert wheels.right > 0.0
    assert limiter.advance(700 * MS, 0.1).wheels == (0.0, 0.0)


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
    for _ in range(60):
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
        drive(limiter, 40.0, 40.0, 3.0)
        # The output holds for a period, and the age is checked once in it.
        assert stop_time(limiter, 3000, 2990) <= 0.5 + 0.02
    assert accepted > 5


def test_an_emergency_stop_has_a_fixed_least_deceleration():
    limiter = make_limiter(acceleration=5.0, stop_deceleration=5.0, max_stopping_time=10.0)
    drive(limiter, 10.0, 10.0, 3.0)
    limiter.latch('test', 3000 * MS)
    assert stop_time(limiter, 3000, 3000) <= 10.0 / 60.0 + 0.01


@pytest.mark.parametrize('right, left', [(10.0, 10.0), (0.0, -10.0)])
def test_a_lowered_speed_limit_does_not_slow_a_stop(right, left):
    limiter = make_limiter()
    drive(limiter, right, left, 1.0)
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


def test_a_robot_that_stopped_by_itself_starts_from_standstill():
    """A bridge that was suspended must not send a standing robot the speed from before."""
    limiter = make_limiter()
    assert drive(limiter, 5.0, 5.0, 0.25).right == pytest.approx(5.0)
    limiter.assume_standstill()
    limiter.accept(command(5.0, 5.0, 2000), 2000 * MS)
    assert limiter.advance(2000 * MS, 0.01).wheels.right == pytest.approx(0.3)


TIMEOUT = 250
"""ms"""


SPEEDS = st.floats(-15.0, 15.0) | st.sampled_from((0.0, 5.0))
WRONG_SPEEDS = SPEEDS | st.sampled_from((math.nan, math.inf, 1e300))


class LimiterMachine(RuleBasedStateMachine):
    """Any sequence of calls: what is followed, why not, until when, and how fast it changes.

    A command expires exactly at its time-out, whatever its stamp and however often it is repeated;
    nothing but a release ends an emergency stop, and nothing resumes a command that was dropped.
    """

    def __init__(self):
        super().__init__()
        self.limiter, self.now = make_limiter(), 1000
        self.followed, self.estop, self.timed_out = None, False, False
        self.last, self.last_now = (0.0, 0.0), -(10**9)

    def drop(self, timed_out=False):
        self.followed, self.timed_out = None, timed_out

    @rule(ms=st.sampled_from((0, 1, 9, 10, 20, TIMEOUT - 1, TIMEOUT, TIMEOUT + 1, 9999)))
    def wait(self, ms):
        self.now += ms

    @precondition(lambda self: self.followed)
    @rule(off=st.sampled_from((-1, 0)))
    def wait_until_it_expires(self, off):
        self.now = max(self.now, self.followed[1] + TIMEOUT + off)
        self.advance()

    @rule()
    def jump_back(self):
        self.limiter.advance(self.now * MS, 0.01)  # the limiter has seen this time
        self.now -= 500
        reason = self.limiter.advance(self.now * MS, 0.01).reason
        assert reason == ('emergency stop: button' if self.estop else 'the clock jumped back')
        self.drop()
        self.last_now = -(10**9)

    @rule(
        wheels=st.tuples(WRONG_SPEEDS, WRONG_SPEEDS),
        age=st.sampled_from((0, 1, 10, TIMEOUT - 1, TIMEOUT, TIMEOUT + 1, -20, -9999)),
    )
    def accept_or_reject(self, wheels, age):
        self.accept(wheels, age)

    @rule(wheels=st.tuples(SPEEDS, SPEEDS), age=st.sampled_from((0, 10)))
    def accept(self, wheels, age):
        stamp = self.now - age
        why = self.limiter.accept(command(*wheels, stamp), self.now * MS)
        if not all(map(math.isfinite, wheels)):
            assert why
            self.drop()
        elif self.estop:
            assert 'emergency stop' in why
        elif age >= TIMEOUT:
            assert 'too old' in why
        elif self.followed and min(stamp, self.now) < self.followed[1]:
            assert 'older than the one before' in why
        else:
            assert why == ''
            self.followed, self.timed_out = (wheels, min(stamp, self.now)), False

    @precondition(lambda self: not self.estop)
    @rule(wheels=st.tuples(SPEEDS, SPEEDS), repeated=st.integers(1, 3))
    def accept_and_let_expire(self, wheels, repeated):
        for _ in range(repeated):
            self.accept(wheels, 0)
            self.tells_what_it_follows()
            if self.followed:
                self.wait_until_it_expires(0)
                self.tells_what_it_follows()

    @rule()
    def stop(self):
        self.limiter.stop('because', self.now * MS)
        self.drop()
        assert self.estop or self.limiter.reason == 'because'

    @rule()
    def latch(self):
        self.limiter.latch('button', self.now * MS)
        self.estop = True
        self.drop()

    @rule()
    def release(self):
        assert ('no emergency stop' in self.limiter.release(self.now * MS)) != self.estop
        if self.estop:
            self.drop()
        self.estop = False

    @rule()
    def advance(self):
        found = self.limiter.advance(self.now * MS, 0.01)
        if self.followed and self.now - self.followed[1] >= TIMEOUT:
            self.drop(timed_out=True)
            assert found.reason == 'no command for 0.25 s'
        wheels = self.followed[0] if self.followed else (0.0, 0.0)
        twist = twist_from_wheels(found.target, GEOMETRY)
        assert abs(twist.linear) <= 0.5 * (1.0 + 1e-9)
        assert abs(twist.angular) <= 8.0 * (1.0 + 1e-9)
        assert max(map(abs, found.target)) <= 10.0 * (1.0 + 1e-9)
        assert found.target[0] * wheels[1] == pytest.approx(found.target[1] * wheels[0])
        assert (found.target == wheels) == (not found.limited)
        assert (found.estop, found.timed_out) == (self.estop, self.timed_out)
        if self.now - self.last_now >= 10:
            rate = 60.0 if found.target == (0.0, 0.0) else 30.0
            change = np.abs(np.subtract(found.wheels, self.last)).max()
            assert change <= rate * 0.01 + 1e-9 or self.last_now < 0
        self.last, self.last_now = found.wheels, self.now

    @invariant()
    def tells_what_it_follows(self):
        limiter, now_ns = self.limiter, self.now * MS
        assert (limiter.reason == '') == (self.followed is not None)
        assert limiter.timed_out == self.timed_out
        assert limiter.estop == self.estop == limiter.reason.startswith('emergency stop')
        until = self.followed[1] + TIMEOUT if self.followed else self.now
        assert limiter.remaining_ns(now_ns) == max(until - self.now, 0) * MS


@pytest.mark.slow
class TestLimiter(LimiterMachine.TestCase):
    settings = settings(STATEFUL, max_examples=60)


# -- slip monitor: when it stops the robot, and when it lets it go --------------------------------

STAND, DRIVE = RobotCommand(ZERO_WHEEL_SPEEDS, 0), RobotCommand(WheelSpeeds(1.0, 0.0), 0)


def test_a_stop_begins_and_ends_at_its_bounds():
    """The largest permitted slip is permitted; a pause of just half a second ends the stop."""
    monitor = SlipMonitor()
    assert not monitor.update(1.0, 1.0, 10.0)
    assert not monitor.rejects(DRIVE, 10.0)
    assert monitor.update(1.001, 1.0, 20.0)
    assert monitor.rejects(DRIVE, 20.25)
    assert monitor.rejects(STAND, 20.5)
    assert monitor.update(0.0, 1.0, 20.625)
    assert not monitor.update(0.0, 1.0, 20.75)
    assert not monitor.rejects(DRIVE, 20.75)


def test_a_limit_of_zero_disables_the_stop():
    monitor = SlipMonitor()
    assert monitor.update(2.0, 1.0, 0.0)
    assert not monitor.update(2.0, 0.0, 0.1)
    assert not monitor.update(99.0, 0.0, 0.2)
