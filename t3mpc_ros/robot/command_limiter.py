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
"""Which commands a robot follows: limits, command timeout, emergency stop, slip stop."""

from dataclasses import dataclass
import math
from typing import NamedTuple

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

ESTOP_DECELERATION = 60.0
"""Least deceleration of an emergency stop, rad/s²; that of the board is the same."""
SLIP_RELEASE_TIME = 0.5  # s without a motion command after which the robot follows commands again
SLIP_STOP_REASON = (
    'gyro and steps disagree: a wheel slips, is blocked, or has lost steps; '
    f'stop commanding motion for {SLIP_RELEASE_TIME:g} s to resume'
)


@dataclass(frozen=True)
class CommandLimiterParameters(Parameters):
    """Limits of a command, and the deceleration of a stop."""

    linear_speed: float = parameter(
        0.5,
        'largest forward velocity |v| of a command',
        'm/s',
        (0.0, 5.0),
        name='linear.x.max_velocity',
        dynamic=True,
    )
    angular_speed: float = parameter(
        8.0,
        'largest yaw rate |omega| of a command',
        'rad/s',
        (0.0, 50.0),
        name='angular.z.max_velocity',
        dynamic=True,
    )
    wheel_speed: float = parameter(
        10.0,
        'largest wheel speed of a command; from here a robot without commands stops within '
        'max_stopping_time. The board steps at up to 19.6 rad/s (10 000 microsteps a second)',
        'rad/s',
        (0.0, 200.0),
        name='wheel.max_velocity',
        dynamic=True,
    )
    acceleration: float = parameter(
        30.0,
        'largest acceleration of the faster changing wheel',
        'rad/s²',
        (0.1, 1e5),
        name='wheel.max_acceleration',
        dynamic=True,
    )
    stop_deceleration: float = parameter(
        60.0,
        'deceleration of the faster changing wheel in a stop, whatever its reason; an emergency '
        'stop uses at least 60 rad/s²',
        'rad/s²',
        (0.1, 1e5),
        name='wheel.stop_deceleration',
        dynamic=True,
    )
    command_timeout: float = parameter(
        0.25,
        'age at which a command expires (board level; the host has its own timeout)',
        's',
        (0.01, 0.5),
        name='cmd_vel_timeout',
        dynamic=True,
    )

    max_stopping_time: float = parameter(
        0.5,
        'longest time from the last command to rest that other parameters may lead to: '
        'cmd_vel_timeout plus the stop from wheel.max_velocity; a higher value weakens every stop '
        'but the emergency stop',
        's',
        (0.1, 10.0),
    )

    def check_stopping_time(self, silence: float, deceleration: float, names: str) -> None:
        """Raise ParameterError when the robot could take longer than allowed to stop.

        The stop begins after a ``silence`` (s); ``names`` are those of the parameters it depends
        on.
        """
        time = silence + self.wheel_speed / deceleration
        if time > self.max_stopping_time + 1e-9:
            raise ParameterError(
                f'{names} and wheel.max_velocity must stop the robot within max_stopping_time, '
                f'{self.max_stopping_time:g} s after the last command: got {time:.3g} s'
            )

    def check_consistency(self) -> None:
        """Raise ParameterError when a stop is slower than ordinary deceleration, or too slow."""
        if self.stop_deceleration < self.acceleration:
            raise ParameterError(
                'wheel.stop_deceleration must be at least wheel.max_acceleration '
                f'({self.acceleration:g} rad/s²): got {self.stop_deceleration:g}'
            )
        self.check_stopping_time(
            self.command_timeout,
            self.stop_deceleration,
            'cmd_vel_timeout, wheel.stop_deceleration',
        )


class LimitedCommand(NamedTuple):
    """Output of the limiter for one period."""

    wheels: WheelSpeeds
    target: WheelSpeeds  # end of the ramp
    estop: bool
    timed_out: bool
    limited: bool
    reason: str  # why the target is zero, unless a zero command is the reason; otherwise empty


class _Ramp(NamedTuple):
    """Wheel speeds that change towards a target from an instant on."""

    start: WheelSpeeds
    target: WheelSpeeds
    rate: float  # rad/s²
    since_ns: int
    hold: float  # s, period for which the end of the ramp was returned

    def at(self, elapsed: float) -> WheelSpeeds:
        """Return the wheel speeds after ``elapsed`` seconds."""
        return WheelSpeeds(*ramp_towards(*self.start, *self.target, self.rate * elapsed))


NO_COMMAND = 'no command yet'
CLOCK_JUMPED_BACK = 'the clock jumped back'


class CommandLimiter:
    """Decides which wheel speeds are commanded: every rule of motion, without a clock.

    A command that is not finite, or a clock that jumps back, stops the robot. A command older
    than the timeout, or than the one before it, is rejected. A command beyond a limit is scaled
    in both wheels by the same factor. Changes of speed are ramped, likewise by one factor.

    parameters : replaceable at run time
    geometry : converts wheel speeds to (v, omega) for the limits
    """

    def __init__(self, parameters: CommandLimiterParameters, geometry: WheelGeometry) -> None:
        self.parameters = parameters
        self._geometry = geometry
        self._estop = ''
        self.reason = NO_COMMAND  # why the robot is stopped; empty while it follows a command
        self._command: RobotCommand | None = None
        self.timed_out = False  # whether the last command expired
        self._ramp = _Ramp(ZERO_WHEEL_SPEEDS, ZERO_WHEEL_SPEEDS, 0.0, 0, 0.0)
        self._clock_ns: int | None = None
        ramp_towards(0.0, 0.0, 0.0, 0.0, 0.0)  # compile now, so that no stop waits for it

    @property
    def estop(self) -> bool:
        """Whether the emergency stop is latched."""
        return bool(self._estop)

    def remaining_ns(self, now_ns: int) -> int:
        """Return the time until the current command expires, ns; 0 without one."""
        if self._command is None:
            return 0
        timeout_ns = round(self.parameters.command_timeout * NANOSECONDS)
        return max(self._command.stamp_ns + timeout_ns - now_ns, 0)

    def assume_standstill(self) -> None:
        """Begin the next ramp at standstill: the robot has stopped by itself."""
        self._ramp = self._ramp._replace(start=ZERO_WHEEL_SPEEDS, target=ZERO_WHEEL_SPEEDS)

    def accept(self, command: RobotCommand, now_ns: int) -> str:
        """Accept a command, or return why it is rejected.

        Its age counts from its stamp, or from now if the stamp lies in the future.
        """
        self._check_clock(now_ns)
        # float: an int argument would compile every kernel again, within a step.
        wheels = WheelSpeeds(float(command.wheels.right), float(command.wheels.left))
        twist = twist_from_wheels(wheels, self._geometry)
        if not all(map(math.isfinite, (*wheels, *twist))):
            # The intended value is unknown, zero included.
            self._drop_command(f'command is not finite: got {wheels.right}, {wheels.left} rad/s')
            return self.reason
        if self._estop:
            return self._estop
        if stale := self.staleness(command, now_ns):
            return stale
        stamp_ns = min(command.stamp_ns, now_ns)
        if self._command is not None and stamp_ns < self._command.stamp_ns:
            return 'command is older than the one before it'
        self._command = RobotCommand(wheels, stamp_ns)
        self.timed_out = False
        self.reason = ''
        return ''

    def staleness(self, command: RobotCommand, now_ns: int) -> str:
        """Return why a command is too old, empty when it is not."""
        age = (now_ns - command.stamp_ns) / NANOSECONDS
        return f'command is too old: {age:.3f} s' if age >= self.parameters.command_timeout else ''

    def advance(self, now_ns: int, hold: float) -> LimitedCommand:
        """Return the wheel speeds to command from ``now_ns`` on, for ``hold`` seconds.

        They are the value of the ramp at the end of that period, so a command is not delayed by
        it. The ramp never runs ahead of the returned values, however late the next call is.
        """
        self._check_clock(now_ns)
        parameters = self.parameters
        elapsed = (now_ns - self._ramp.since_ns) / NANOSECONDS
        wheels = self._ramp.at(min(elapsed, self._ramp.hold))
        if self._command is not None:
            age = (now_ns - self._command.stamp_ns) / NANOSECONDS
            if age >= parameters.command_timeout:
                self.expire()
        target, limited = ZERO_WHEEL_SPEEDS, False
        if self._command is not None:
            target, limited = self._within_limits(self._command.wheels)
        stops = target == ZERO_WHEEL_SPEEDS
        rate = parameters.stop_deceleration if stops else parameters.acceleration
        # max_stopping_time presumes that the wheels are not faster than wheel.max_velocity.
        too_fast = max(map(abs, wheels)) > parameters.wheel_speed
        if self._estop or (stops and too_fast):
            rate = max(rate, ESTOP_DECELERATION)
        self._ramp = _Ramp(wheels, target, rate, now_ns, hold)
        return LimitedCommand(
            self._ramp.at(hold), target, self.estop, self.timed_out, limited, self.reason
        )

    def expire(self) -> None:
        """Stop because the command has expired."""
        self._drop_command(f'no command for {self.parameters.command_timeout:g} s')
        self.timed_out = True

    def stop(self, reason: str, now_ns: int) -> None:
        """Drop the command; the next one is accepted again."""
        self._check_clock(now_ns)
        self._drop_command(reason)

    def latch(self, reason: str, now_ns: int) -> None:
        """Drop the command, and reject every other until :meth:`release`."""
        self._check_clock(now_ns)
        self._estop = f'emergency stop: {reason}'
        self._drop_command(self._estop)

    def release(self, now_ns: int) -> str:
        """Release the emergency stop, or return why there is none.

        The dropped command is not resumed.
        """
        self._check_clock(now_ns)
        if not self._estop:
            return 'no emergency stop is latched'
        self._estop = ''
        self._drop_command('no command since the emergency stop was released')
        return ''

    def _drop_command(self, reason: str) -> None:
        self._command = None
        self.timed_out = False
        self.reason = self._estop or reason

    def _check_clock(self, now_ns: int) -> None:
        """Stop when the clock has jumped back."""
        if self._clock_ns is not None and now_ns < self._clock_ns:
            self._drop_command(CLOCK_JUMPED_BACK)
            # Whether or not the period has ended, the end of the ramp was commanded last.
            self._ramp = _Ramp(self._ramp.at(self._ramp.hold), ZERO_WHEEL_SPEEDS, 0.0, now_ns, 0.0)
        self._clock_ns = now_ns

    def _within_limits(self, wheels: WheelSpeeds) -> tuple[WheelSpeeds, bool]:
        """Return the wheels scaled by one factor, and whether it is less than 1.

        Twist and wheel speeds are proportional, so one factor keeps v/omega, the curvature.
        """
        parameters = self.parameters
        twist = twist_from_wheels(wheels, self._geometry)
        factor = min(
            1.0,
            _scale_within(parameters.linear_speed, twist.linear),
            _scale_within(parameters.angular_speed, twist.angular),
            _scale_within(parameters.wheel_speed, wheels.right),
            _scale_within(parameters.wheel_speed, wheels.left),
        )
        if factor == 1.0:
            return wheels, False
        return WheelSpeeds(factor * wheels.right, factor * wheels.left), True


class SlipMonitor:
    """Decides whether the robot must stop because gyro and steps disagreed for too long.

    A stop of the command limiter lasts until the next command, which arrives one period later:
    the robot would report a stop and drive on. A stop that ended by itself would be followed by
    another push against the obstacle. The stop therefore lasts until motion commands pause.
    """

    def __init__(self) -> None:
        self.stopped = False  # whether the robot must stand still
        self._last_motion_command = 0.0  # time of the last motion command during the stop, s

    def rejects(self, command: RobotCommand, now: float) -> bool:
        """Decide whether a command that arrives at ``now`` (s) is rejected."""
        if self.stopped and command.wheels != ZERO_WHEEL_SPEEDS:
            self._last_motion_command = now
        return self.stopped

    def update(self, slipping_for: float, limit: float, now: float) -> bool:
        """Decide whether the robot must stand still at ``now``, s.

        ``slipping_for`` (s) is 0 when gyro and steps agree; a limit of 0 disables the stop.
        """
        if limit > 0.0 and slipping_for > limit:
            if not self.stopped:
                self.stopped, self._last_motion_command = True, now
        elif limit == 0.0 or now - self._last_motion_command >= SLIP_RELEASE_TIME:
            self.stopped = False
        return self.stopped

    def reset(self) -> None:
        """End the stop, as after a restart of the board."""
        self.stopped = False


def _scale_within(limit: float, value: float) -> float:
    return 1.0 if abs(value) <= limit else limit / abs(value)


@kernel
def ramp_towards(
    right: float, left: float, target_right: float, target_left: float, reach: float
) -> tuple[float, float]:
    """Return the pair (rad/s) moved towards its target by at most ``reach``, unlimited below 0.

    One factor serves both wheels, so that slowing down to zero keeps the curvature of the path.
    """
    gap_right, gap_left = target_right - right, target_left - left
    widest = max(abs(gap_right), abs(gap_left))
    if reach < 0.0 or widest <= reach:
        return target_right, target_left
    factor = reach / widest
    return right + factor * gap_right, left + factor * gap_left
