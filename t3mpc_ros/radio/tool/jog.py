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
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand, WheelAngles

LEFT, RIGHT = 'left', 'right'
_CONNECT_TIMEOUT = 15.0
"""s for a dongle that starts, and a robot that is asked who it is."""
_PERIOD_NS = NANOSECONDS // 50
_REPORT_DELAY_NS = NANOSECONDS
_ACCELERATION = 8.0
"""rad/s² up and down: nothing jumps off the bench."""
_FINAL_SPEED = 0.2
"""rad/s at which the end is met: 0.3 degrees in the time of a cycle."""
_APPROACH_GAIN = 3.0
"""1/s by which the speed goes with what is left."""
_NOT_FOLLOWING_TIMEOUT = 1.0
"""s for which the robot may not follow before it is given up."""
_TIME_MARGIN = 15.0
"""s that speeding up and creeping may take, and more."""
_SETTLING_TIME = 0.3
"""s for which it must have stood before the steps count."""


class JogResult(NamedTuple):
    """What the board has counted; microsteps, forward is positive."""

    wanted: int
    counted: int
    other: int
    """Of the wheel that was to stand still."""
    seconds: float


class Jog:
    """Drives the link like a bridge does: greets, commands, stops, takes the drives out.

    Parameters
    ----------
    settings
        Of the link; its ramps are made gentle.
    key
        Of the robot; empty for an open link.
    entropy
        For session numbers and nonces.
    wheel
        LEFT or RIGHT.
    revolutions
        Below 0: backward.
    speed
        rad/s of the wheel, above 0.
    say
        Told what is waited for, whenever that changes.
    """

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes,
        entropy: Callable[[int], bytes],
        wheel: str,
        revolutions: float,
        speed: float,
        say: Callable[[str], None],
    ) -> None:
        if wheel not in (LEFT, RIGHT):
            raise ValueError(f'wheel must be {LEFT} or {RIGHT}: got {wheel}')
        robot = replace(parameters.robot, acceleration=_ACCELERATION, deceleration=_ACCELERATION)
        self.link = Link(replace(parameters, robot=robot), key, entropy)
        self._right = wheel == RIGHT
        self._angle = math.tau * revolutions
        self._speed = speed
        self._say = say
        self._said = self._reason = ''
        self._reason_ns = 0
        self._start: WheelAngles | None = None
        self._start_ns = self._begun_ns = 0
        self._next_ns = 0
        self._followed_ns: int | None = None
        self._stands_ns: int | None = None
        self._patience = abs(self._angle) / speed + _TIME_MARGIN
        self._seconds = 0.0
        self._arrived = False
        self.error = ''
        """Why it was not done; empty if it was."""
        self.result: JogResult | None = None
        """What the board has counted, as far as it went."""

    @property
    def done(self) -> bool:
        """Whether the robot stands, its drives are out, and the port is closed."""
        return self.link.state is LinkState.DONE

    def port_opened(self, now_ns: int) -> None:
        """Take notice that the port is open."""
        self.link.port_opened(now_ns)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Give up: the robot stops by itself within its time to live."""
        self._give_up(text)
        self.link.port_failed(text, absent, now_ns)

    def interrupt(self, now_ns: int) -> None:
        """Bring the wheel to rest, take the drives out, and leave."""
        self._give_up('interrupted')

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return what to do with the port now."""
        if not self._begun_ns:
            self._begun_ns = now_ns
        deeds = self.link.step(now_ns, received)
        if not self.error and not self._arrived:
            self._conduct(now_ns)
        elif self.link.telemetry is not None:
            self._count(self.link.telemetry.angles)
        last = deeds[-1]
        if isinstance(last, Wait):
            deeds[-1] = Wait(min(last.until_ns, now_ns + _PERIOD_NS))
        return deeds

    def _conduct(self, now_ns: int) -> None:
        """Order the next bit of the way."""
        link, telemetry = self.link, self.link.telemetry
        reason = link.reason(now_ns)
        if link.state is not LinkState.RUN or telemetry is None:
            self._tell(reason, now_ns)
            if self._start is not None:
                self._give_up(reason or 'the link was lost')
            elif now_ns - self._begun_ns > _CONNECT_TIMEOUT * NANOSECONDS:
                self._give_up(reason)
            return
        if self._start is None:
            if telemetry.status.moving:
                return
            self._start, self._start_ns = telemetry.angles, now_ns
            self._followed_ns = now_ns
        left = self._angle - self._gone(telemetry.angles)
        passed = (now_ns - self._start_ns) / NANOSECONDS
        self._seconds = passed
        self._count(telemetry.angles)
        if left * math.copysign(1.0, self._angle) <= _FINAL_SPEED / 100.0:
            self._finish(telemetry.status.moving, now_ns)
            return
        if not telemetry.status.estop and telemetry.status.enabled:
            self._followed_ns = now_ns
        elif now_ns - (self._followed_ns or now_ns) > _NOT_FOLLOWING_TIMEOUT * NANOSECONDS:
            self._give_up(reason or 'the robot does not follow')
            return
        if passed > self._patience:
            self._give_up('the wheel does not come as far as it should: are its steps counted?')
            return
        self._order(left, now_ns)

    def _order(self, left: float, now_ns: int) -> None:
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _PERIOD_NS
        size = min(self._speed, max(_FINAL_SPEED, _APPROACH_GAIN * abs(left)))
        speed = math.copysign(size, self._angle)
        wheels = WheelSpeeds(speed, 0.0) if self._right else WheelSpeeds(0.0, speed)
        self.link.command(RobotCommand(wheels, now_ns), now_ns)

    def _finish(self, moving: bool, now_ns: int) -> None:
        """Wait until the wheel stands, then leave."""
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + _PERIOD_NS
            self.link.command(RobotCommand(ZERO_WHEEL_SPEEDS, now_ns), now_ns)
        if moving or self._stands_ns is None:
            self._stands_ns = now_ns
        elif now_ns - self._stands_ns > _SETTLING_TIME * NANOSECONDS:
            self._arrived = True
            self.link.shut_down()

    def _gone(self, angles: WheelAngles) -> float:
        start = self._start or angles
        return angles.right - start.right if self._right else angles.left - start.left

    def _count(self, angles: WheelAngles) -> None:
        info, start = self.link.info, self._start
        if info is None or start is None:
            return
        steps = info.steps_per_rev * info.microsteps
        gone = self._gone(angles)
        other = angles.left - start.left if self._right else angles.right - start.right
        wanted, counted, idle = (
            round(way * steps / math.tau) for way in (self._angle, gone, other)
        )
        self.result = JogResult(wanted, counted, idle, self._seconds)

    def _tell(self, reason: str, now_ns: int) -> None:
        """Say what is waited for, if that takes longer than a blink."""
        if reason != self._reason:
            self._reason, self._reason_ns = reason, now_ns
        elif reason and reason != self._said and now_ns - self._reason_ns >= _REPORT_DELAY_NS:
            self._said = reason
            self._say(reason)

    def _give_up(self, why: str) -> None:
        self.error = self.error or why
        self.link.shut_down()


def format_result(turned: JogResult, wheel: str, revolutions: float) -> str:
    """Return in words what was counted, and what a person must have seen."""
    way, top = ('forward', 'front') if revolutions > 0 else ('backward', 'back')
    other = RIGHT if wheel == LEFT else LEFT
    invert = f'robot.invert_{wheel}'
    return '\n'.join(
        (
            f'{wheel}: {turned.counted} microsteps counted, {turned.wanted} wanted; '
            f'{other}: {turned.other}; {turned.seconds:.1f} s',
            f'You must have seen the {wheel} wheel make {abs(revolutions):g} turns {way} (its top '
            f'moved to the {top}), and the {other} one stand still.',
            '  the other wheel turned: exchange the cables of both drivers',
            f'  it turned the other way: set link.{invert} of the bridge (--set {invert}=true '
            'here), or turn one coil of the motor round',
            '  more or fewer turns: the microsteps of the driver are not those of the board '
            '(t3mpc robot parameters)',
            '  it hummed, or turns were missing: more current, or a lower --speed',
        )
    )
