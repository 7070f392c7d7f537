# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Jog: turns one wheel by a number of revolutions, wheels off the ground, to check wiring."""

from collections.abc import Callable
from dataclasses import replace
import math
from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import LinkState, PortAction, Wait
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, WheelAngles

LEFT, RIGHT = 'left', 'right'
_CONNECT_TIMEOUT = 15.0
"""Timeout for the start of the dongle and the handshake, s."""
_PERIOD_NS = NANOSECONDS // 50
_COMMAND_NS = NANOSECONDS // 4
"""Time for which a command is followed."""
_REPORT_DELAY_NS = NANOSECONDS
"""A reason that lasts this long is reported."""
_ACCELERATION = 8.0
"""rad/s², both ways."""
_FINAL_SPEED = 0.2
"""Speed at the target, rad/s: 0.3 degrees per cycle."""
_APPROACH_GAIN = 3.0
"""Speed per remaining angle, 1/s."""
_NOT_FOLLOWING_TIMEOUT = 1.0
"""Time without following after which the jog fails, s."""
_TIME_MARGIN = 15.0
"""Additional time for acceleration and approach, s."""
_SETTLING_TIME = 0.3
"""Standstill before the final count, s."""


class JogResult(NamedTuple):
    """Microsteps counted by the board, forward positive."""

    target: int
    counted: int
    other: int
    """Of the other wheel, expected to be 0."""
    seconds: float


class Jog:
    """Turns one wheel over the link: handshake, commands, stop, drives disabled.

    Parameters
    ----------
    parameters
        Parameters of the link; acceleration and deceleration are replaced by 8 rad/s².
    key
        Key of the robot; empty for an open link.
    entropy
        Source of session numbers and nonces.
    wheel
        LEFT or RIGHT.
    revolutions
        Negative: backward.
    speed
        Maximum wheel speed, rad/s, positive.
    report
        Receives the reason for waiting when it changes.
    """

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes,
        entropy: Callable[[int], bytes],
        wheel: str,
        revolutions: float,
        speed: float,
        report: Callable[[str], None],
    ) -> None:
        if wheel not in (LEFT, RIGHT):
            raise ValueError(f'wheel must be {LEFT} or {RIGHT}: got {wheel}')
        robot = replace(parameters.robot, acceleration=_ACCELERATION, deceleration=_ACCELERATION)
        self.link = Link(replace(parameters, robot=robot), key, entropy)
        self._right = wheel == RIGHT
        self._angle = math.tau * revolutions
        self._speed = speed
        self._report = report
        self._reported = self._reason = ''
        self._reason_ns = 0
        self._start: WheelAngles | None = None
        self._start_ns = self._begin_ns = 0
        self._next_ns = 0
        self._following_ns: int | None = None
        self._standstill_ns: int | None = None
        self._timeout = abs(self._angle) / speed + _TIME_MARGIN
        self._seconds = 0.0
        self._finished = False
        self.error = ''
        """Reason of a failure; empty on success."""
        self.result: JogResult | None = None
        """Counts of the board so far."""

    @property
    def done(self) -> bool:
        """Whether the drives are disabled and the port is closed."""
        return self.link.state is LinkState.DONE

    def port_opened(self, now_ns: int) -> None:
        """Report that the port is open."""
        self.link.port_opened(now_ns)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Fail with ``text``; the robot stops by itself within the TTL."""
        self._fail(text)
        self.link.port_failed(text, absent, now_ns)

    def interrupt(self, now_ns: int) -> None:
        """Stop the wheel, disable the drives, and end."""
        self._fail('interrupted')

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return the actions to execute now; the last one is the time of the next call."""
        if not self._begin_ns:
            self._begin_ns = now_ns
        actions = self.link.step(now_ns, received)
        if not self.error and not self._finished:
            self._advance(now_ns)
        elif self.link.telemetry is not None:
            self._count(self.link.telemetry.angles)
        last = actions[-1]
        if isinstance(last, Wait):
            actions[-1] = Wait(min(last.until_ns, now_ns + _PERIOD_NS))
        return actions

    def _advance(self, now_ns: int) -> None:
        """Advance the jog by one step."""
        link, telemetry = self.link, self.link.telemetry
        reason = link.reason(now_ns)
        if link.state is not LinkState.RUN or telemetry is None:
            self._report_reason(reason, now_ns)
            if self._start is not None:
                self._fail(reason or 'the link was lost')
            elif now_ns - self._begin_ns > _CONNECT_TIMEOUT * NANOSECONDS:
                self._fail(reason)
            return
        if self._start is None:
            if telemetry.status.moving:
                return
            self._start, self._start_ns = telemetry.angles, now_ns
            self._following_ns = now_ns
        remaining = self._angle - self._travelled(telemetry.angles)
        elapsed = (now_ns - self._start_ns) / NANOSECONDS
        self._seconds = elapsed
        self._count(telemetry.angles)
        if remaining * math.copysign(1.0, self._angle) <= _FINAL_SPEED / 100.0:
            self._finish(telemetry.status.moving, now_ns)
            return
        if not telemetry.status.estop and telemetry.status.enabled:
            self._following_ns = now_ns
        elif now_ns - (self._following_ns or now_ns) > _NOT_FOLLOWING_TIMEOUT * NANOSECONDS:
            self._fail(reason or 'the robot does not follow')
            return
        if elapsed > self._timeout:
            self._fail('the wheel does not reach its target: does the board count its steps?')
            return
        self._command(remaining, now_ns)

    def _command(self, remaining: float, now_ns: int) -> None:
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _PERIOD_NS
        size = min(self._speed, max(_FINAL_SPEED, _APPROACH_GAIN * abs(remaining)))
        speed = math.copysign(size, self._angle)
        wheels = WheelSpeeds(speed, 0.0) if self._right else WheelSpeeds(0.0, speed)
        self.link.command(wheels, now_ns + _COMMAND_NS)

    def _finish(self, moving: bool, now_ns: int) -> None:
        """Wait for standstill, then shut the link down."""
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + _PERIOD_NS
            self.link.command(ZERO_WHEEL_SPEEDS, now_ns + _COMMAND_NS)
        if moving or self._standstill_ns is None:
            self._standstill_ns = now_ns
        elif now_ns - self._standstill_ns > _SETTLING_TIME * NANOSECONDS:
            self._finished = True
            self.link.shut_down()

    def _travelled(self, angles: WheelAngles) -> float:
        start = self._start or angles
        return angles.right - start.right if self._right else angles.left - start.left

    def _count(self, angles: WheelAngles) -> None:
        info, start = self.link.info, self._start
        if info is None or start is None:
            return
        steps = info.steps_per_rev * info.microsteps
        travelled = self._travelled(angles)
        other = angles.left - start.left if self._right else angles.right - start.right
        target, counted, idle = (
            round(way * steps / math.tau) for way in (self._angle, travelled, other)
        )
        self.result = JogResult(target, counted, idle, self._seconds)

    def _report_reason(self, reason: str, now_ns: int) -> None:
        """Report the reason for waiting once it has lasted a second."""
        if reason != self._reason:
            self._reason, self._reason_ns = reason, now_ns
        elif reason and reason != self._reported and now_ns - self._reason_ns >= _REPORT_DELAY_NS:
            self._reported = reason
            self._report(reason)

    def _fail(self, reason: str) -> None:
        self.error = self.error or reason
        self.link.shut_down()


def format_result(result: JogResult, wheel: str, revolutions: float) -> str:
    """Return the result as text, with the expected motion and remedies."""
    way, top = ('forward', 'front') if revolutions > 0 else ('backward', 'back')
    other = RIGHT if wheel == LEFT else LEFT
    invert = f'robot.invert_{wheel}'
    return '\n'.join(
        (
            f'{wheel}: {result.counted} microsteps counted, target {result.target}; '
            f'{other}: {result.other}; {result.seconds:.1f} s',
            f'Expected: {abs(revolutions):g} turns {way} of the {wheel} wheel (its top moves to '
            f'the {top}), standstill of the {other} wheel. Otherwise:',
            '  the other wheel turned: swap the cables of the two drivers',
            f'  reverse direction: set link.{invert} of the bridge (--set {invert}=true here), or '
            'swap the wires of one motor coil',
            '  more or fewer turns: microsteps of driver and board (t3mpc robot parameters)',
            '  humming or lost steps: more motor current, or a lower --speed',
        )
    )
