# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Command limiter: velocity and acceleration limits, command timeout, emergency stop."""

from dataclasses import dataclass
import math
from typing import NamedTuple

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist, WheelSpeeds
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand


@kernel
def ramp_towards(
    right: float, left: float, target_right: float, target_left: float, reach: float
) -> tuple[float, float]:
    """Return the pair (rad/s) moved towards its target by at most ``reach`` in each wheel.

    One factor serves both wheels, so that slowing down to zero keeps the curvature of the path.
    A negative ``reach`` means no limit.
    """
    gap_right, gap_left = target_right - right, target_left - left
    widest = max(abs(gap_right), abs(gap_left))
    if reach < 0.0 or widest <= reach:
        return target_right, target_left
    factor = reach / widest
    return right + factor * gap_right, left + factor * gap_left


@dataclass(frozen=True)
class CommandLimiterParameters(Parameters):
    """Limits of a command, and how a robot stops."""

    linear_speed: float = parameter(
        0.5, 'largest |v| that is passed on', unit='m/s', low=0.0, high=5.0, dynamic=True
    )
    angular_speed: float = parameter(
        8.0, 'largest |omega| that is passed on', unit='rad/s', low=0.0, high=50.0, dynamic=True
    )
    wheel_speed: float = parameter(
        10.0,
        'largest wheel speed that is passed on; from here silence brings the wheels to rest '
        'within 0.5 s. The board steps at up to 19.6 rad/s (10 000 microsteps a second)',
        unit='rad/s',
        low=0.0,
        high=200.0,
        dynamic=True,
    )
    acceleration: float = parameter(
        30.0,
        'how fast the faster changing wheel may change its speed',
        unit='rad/s²',
        low=0.1,
        high=1e5,
        dynamic=True,
    )
    stop_deceleration: float = parameter(
        60.0,
        'the same when the robot is to stand, for whatever reason',
        unit='rad/s²',
        low=0.1,
        high=1e5,
        dynamic=True,
    )
    command_timeout: float = parameter(
        0.25,
        'age at which a command is no longer followed (board level; the host has its own)',
        unit='s',
        low=0.01,
        high=0.5,
        dynamic=True,
    )

    def check_consistency(self) -> None:
        """Raise ParameterError when a stop would be gentler than ordinary driving."""
        if self.stop_deceleration < self.acceleration:
            raise ParameterError(
                'stop_deceleration must be at least acceleration '
                f'({self.acceleration:g} rad/s²): got {self.stop_deceleration:g}'
            )


class LimitedCommand(NamedTuple):
    """What may go to the wheels now."""

    wheels: WheelSpeeds
    target: WheelSpeeds
    """Where the ramp leads."""
    estop: bool
    timed_out: bool
    limited: bool
    reason: str
    """Why the target is zero although somebody may want otherwise; empty when it is not so."""


class _Ramp(NamedTuple):
    """Wheel speeds on their way to a target, from an instant on."""

    start: WheelSpeeds
    target: WheelSpeeds
    rate: float
    """rad/s²"""
    since_ns: int
    hold: float
    """s, for how long the end of the ramp was handed out"""

    def at(self, elapsed: float) -> WheelSpeeds:
        """Return the wheel speeds ``elapsed`` seconds on."""
        return WheelSpeeds(*ramp_towards(*self.start, *self.target, self.rate * elapsed))


NO_COMMAND = 'no command yet'
CLOCK_JUMPED_BACK = 'the clock went back'


class CommandLimiter:
    """Decides what may reach the wheels: every rule of motion, in one place and without a clock.

    A command that is not finite, or a clock that goes back, stops the robot; a command that is
    older than the timeout, or than the one before it, is not taken; one that is too fast is
    scaled in both wheels by the same factor. Changes of speed are ramped, likewise by one factor.

    Parameters
    ----------
    settings
        Replaceable while running.
    geometry
        Turns wheel speeds into (v, omega) for the limits.
    """

    def __init__(self, parameters: CommandLimiterParameters, geometry: WheelGeometry) -> None:
        self.parameters = parameters
        self._geometry = geometry
        self._estop = ''
        self._reason = NO_COMMAND
        self._command: RobotCommand | None = None
        self._timed_out = False
        self._ramp = _Ramp(ZERO_WHEEL_SPEEDS, ZERO_WHEEL_SPEEDS, 0.0, 0, 0.0)
        self._clock_ns: int | None = None
        ramp_towards(0.0, 0.0, 0.0, 0.0, 0.0)  # compiled now: no stop ever waits for it

    @property
    def estop(self) -> bool:
        """Whether the emergency stop is latched."""
        return bool(self._estop)

    @property
    def timed_out(self) -> bool:
        """Whether the last command was dropped because of its age."""
        return self._timed_out

    @property
    def reason(self) -> str:
        """Why the robot is to stand; empty when a command is followed."""
        return self._reason

    def accept(self, command: RobotCommand, now_ns: int) -> str:
        """Take a command, or return why not.

        Its age counts from its stamp, or from now if the stamp lies in the future.
        """
        self._notice(now_ns)
        # float: an int would make the compiler build every kernel once more, in mid-step.
        wheels = WheelSpeeds(float(command.wheels.right), float(command.wheels.left))
        twist = twist_from_wheels(wheels, self._geometry)
        if not all(map(math.isfinite, (*wheels, *twist))):
            # The number meant may have been anything, zero included.
            self._drop(f'command is not finite: got {wheels.right}, {wheels.left} rad/s')
            return self._reason
        if self._estop:
            return self._estop
        if stale := self.staleness(command, now_ns):
            return stale
        stamp_ns = min(command.stamp_ns, now_ns)
        if self._command is not None and stamp_ns < self._command.stamp_ns:
            return 'command is older than the one before it'
        self._command = RobotCommand(wheels, stamp_ns)
        self._timed_out = False
        self._reason = ''
        return ''

    def staleness(self, command: RobotCommand, now_ns: int) -> str:
        """Return that a command is too old to be followed, empty when it is not."""
        age = (now_ns - command.stamp_ns) / NANOSECONDS
        return f'command is too old: {age:.3f} s' if age >= self.parameters.command_timeout else ''

    def accept_twist(self, twist: BodyTwist, now_ns: int) -> str:
        """Take a body twist that is wanted now, or return why not."""
        return self.accept(RobotCommand.from_twist(twist, self._geometry, now_ns), now_ns)

    def advance(self, now_ns: int, hold: float) -> LimitedCommand:
        """Return the wheel speeds to command from ``now_ns`` on, for ``hold`` seconds.

        That is where the ramp will be when they are replaced: a command then loses no time. The
        ramp never runs ahead of what was handed out, however late the next call comes.
        """
        self._notice(now_ns)
        parameters = self.parameters
        elapsed = (now_ns - self._ramp.since_ns) / NANOSECONDS
        wheels = self._ramp.at(min(elapsed, self._ramp.hold))
        if self._command is not None:
            age = (now_ns - self._command.stamp_ns) / NANOSECONDS
            if age >= parameters.command_timeout:
                self._drop(f'no command for {parameters.command_timeout:g} s')
                self._timed_out = True
        target, limited = ZERO_WHEEL_SPEEDS, False
        if self._command is not None:
            target, limited = self._within_limits(self._command.wheels)
        rate = (
            parameters.stop_deceleration
            if target == ZERO_WHEEL_SPEEDS
            else parameters.acceleration
        )
        self._ramp = _Ramp(wheels, target, rate, now_ns, hold)
        return LimitedCommand(
            self._ramp.at(hold), target, self.estop, self._timed_out, limited, self._reason
        )

    def stop(self, reason: str, now_ns: int) -> None:
        """Forget the command; the next one is taken again."""
        self._notice(now_ns)
        self._drop(reason)

    def latch(self, reason: str, now_ns: int) -> None:
        """Forget the command, and take none until :meth:`release`."""
        self._notice(now_ns)
        self._estop = f'emergency stop: {reason}'
        self._drop(self._estop)

    def release(self, now_ns: int) -> str:
        """Release the emergency stop, or return why that was not needed.

        The command from before is not taken up again.
        """
        self._notice(now_ns)
        if not self._estop:
            return 'no emergency stop is latched'
        self._estop = ''
        self._drop('no command since the emergency stop was released')
        return ''

    def _drop(self, reason: str) -> None:
        self._command = None
        self._timed_out = False
        self._reason = self._estop or reason

    def _notice(self, now_ns: int) -> None:
        if self._clock_ns is not None and now_ns < self._clock_ns:
            self._drop(CLOCK_JUMPED_BACK)
            # The hold may have run out or not: where it leads is what was handed out last.
            self._ramp = _Ramp(self._ramp.at(self._ramp.hold), ZERO_WHEEL_SPEEDS, 0.0, now_ns, 0.0)
        self._clock_ns = now_ns

    def _within_limits(self, wheels: WheelSpeeds) -> tuple[WheelSpeeds, bool]:
        """Return the wheels scaled by one factor, and whether that was less than 1.

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


def _scale_within(limit: float, value: float) -> float:
    return 1.0 if abs(value) <= limit else limit / abs(value)
