# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Setpoint arbitration: the newest wheel speeds, standstill, or emergency stop."""

import math
from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol.frames import BUSY, OK, Ack, Action, CommandFlag, Uplink
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

_RELEASE_TIMEOUT_NS = NANOSECONDS
"""How long the robot is asked to release its emergency stop."""
_MIN_RELEASE_FRAMES = 3
"""How often it is asked at least: what it said last may be from before the stop."""


_MAX_ATTEMPTS = 20
"""Of a request."""


class Setpoint(NamedTuple):
    """What a CMD says; speeds in mrad/s."""

    flags: CommandFlag
    left: int
    right: int


class SetpointArbiter:
    """Keeps the newest command and the emergency stop, and decides between them.

    Parameters
    ----------
    settings
        Its command_timeout and the robot's max_speed count.
    """

    def __init__(self, parameters: LinkParameters) -> None:
        self._parameters = parameters
        self._command: RobotCommand | None = None
        self._why = reasons.NO_COMMAND
        self._estop = ''
        self._release_until_ns: int | None = None
        self._releases = 0
        self._button = False
        self._sent = ZERO_WHEEL_SPEEDS
        self._requests: list[int] = []
        self._tries = 0
        self.answers: dict[int, str] = {}
        """What became of requests, by verb: empty is done."""

    @property
    def estop(self) -> str:
        """Why the emergency stop is latched here; empty when it is not."""
        return self._estop

    @property
    def sent(self) -> WheelSpeeds:
        """The wheel speeds that were last ordered, after every limit."""
        return self._sent

    def take(self, command: RobotCommand, now_ns: int) -> str:
        """Take a command in place of the one before, or return why not.

        One that is not finite stops the robot: the number meant may have been anything.
        """
        if not all(map(math.isfinite, command.wheels)):
            right, left = command.wheels
            self.drop(f'command is not finite: got {right}, {left} rad/s')
            return self._why
        if self._estop:
            return self._estop
        stamp_ns = min(command.stamp_ns, now_ns)
        if self._command is not None and stamp_ns < self._command.stamp_ns <= now_ns:
            return 'command is older than the one before it'
        if now_ns - stamp_ns >= self._timeout_ns:
            return f'command is too old: {(now_ns - stamp_ns) / NANOSECONDS:.3f} s'
        self._command = command._replace(stamp_ns=stamp_ns)
        return ''

    def drop(self, reason: str) -> None:
        """Order standstill until the next command."""
        self._command = None
        self._why = reason

    def latch(self, reason: str) -> None:
        """Order the emergency stop from now on."""
        self._estop = f'emergency stop: {reason}'
        self._release_until_ns = None
        self.drop(reasons.NO_COMMAND)

    def release(self, latched_there: bool, now_ns: int) -> str:
        """Order its release, here and in the robot, or return why that is not needed."""
        if not self._estop and not latched_there:
            return 'no emergency stop is latched'
        self._estop = ''
        self._button = False
        self._release_until_ns = now_ns + _RELEASE_TIMEOUT_NS
        self._releases = _MIN_RELEASE_FRAMES
        self.drop('no command since the emergency stop was released')
        return ''

    def next(self, latched_there: bool, now_ns: int) -> Setpoint:
        """Return what to order; ``latched_there`` is what the robot last said of its stop."""
        self._sent = ZERO_WHEEL_SPEEDS
        if self._estop:
            return Setpoint(CommandFlag.ESTOP, 0, 0)
        if self._release_until_ns is not None:
            self._releases -= 1
            if self._releases >= 0 or (latched_there and now_ns < self._release_until_ns):
                return Setpoint(CommandFlag.ESTOP_CLEAR, 0, 0)
            self._button = latched_there
            self._release_until_ns = None
        if self._command is not None and now_ns - self._command.stamp_ns >= self._timeout_ns:
            self.drop(f'no command for {self._parameters.cmd_vel_timeout:g} s')
        if self._command is None or latched_there:
            return Setpoint(CommandFlag.ENABLE, 0, 0)
        wheels = self._command.wheels
        fastest = max(map(abs, wheels))
        limit = self._parameters.robot.max_speed
        scale = 1.0 if fastest <= limit else limit / fastest
        right, left = (round(1000.0 * scale * speed) for speed in wheels)
        self._sent = WheelSpeeds(right / 1000.0, left / 1000.0)
        return Setpoint(CommandFlag.ENABLE, left, right)

    def reason(self, latched_there: bool) -> str:
        """Return why standstill is ordered; empty when a command is."""
        if self._estop:
            return self._estop
        if latched_there:
            return reasons.ESTOP_BUTTON_HELD if self._button else reasons.ROBOT_ESTOP
        return '' if self._command is not None else self._why

    @property
    def requested(self) -> int | None:
        """The verb of an action that is to be sent next."""
        return self._requests[0] if self._requests else None

    def request(self, verb: int) -> None:
        """Ask for an action, until it is answered."""
        self.answers.pop(verb, None)
        if verb not in self._requests:
            self._requests.append(verb)

    def hear(self, action: Action, answer: Uplink | None) -> None:
        """Take the answer to an action, if it is one."""
        if not self._requests or self._requests[0] != action.verb:
            return
        self._tries += 1
        if isinstance(answer, Ack) and (answer.verb, answer.seq) == (action.verb, action.seq):
            why = '' if answer.rc == OK else 'the robot does not know this action'
            if answer.rc == BUSY:
                why = 'refused while the robot moves'
        elif self._tries >= _MAX_ATTEMPTS:
            why = 'the robot does not answer'
        else:
            return
        self.answers[action.verb] = why
        self._requests.pop(0)
        self._tries = 0

    @property
    def _timeout_ns(self) -> int:
        return round(self._parameters.cmd_vel_timeout * NANOSECONDS)
