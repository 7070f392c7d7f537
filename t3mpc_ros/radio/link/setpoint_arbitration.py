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
"""Setpoint arbitration: the newest wheel speeds, standstill, or emergency stop."""

from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.link_parameters import TTL_UNIT_NS, LinkParameters
from t3mpc_ros.radio.protocol.frames import CommandFlag
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS

_RELEASE_TIMEOUT_NS = NANOSECONDS  # maximum duration of ESTOP_CLEAR frames
_MIN_RELEASE_FRAMES = 3
"""Minimum number of ESTOP_CLEAR frames: the last status may be older than the stop."""


class Setpoint(NamedTuple):
    """Flags and wheel speeds (mrad/s) of a CMD."""

    flags: CommandFlag
    left: int
    right: int
    ttl: int  # time to live, unit 10 ms: it ends with the command that the setpoint is made from


class SetpointArbiter:
    """Selects the setpoint from the newest wheel speeds and the emergency stop."""

    def __init__(self, parameters: LinkParameters) -> None:
        self._parameters = parameters
        self._wheels: WheelSpeeds | None = None
        self._until_ns = 0
        self._reason = reasons.NO_COMMAND
        self.estop = ''  # reason of the emergency stop latched on the host; empty if none is
        self._release_until_ns: int | None = None
        self._release_frames = 0
        self._button_held = False
        self.sent_wheels = ZERO_WHEEL_SPEEDS
        """Wheel speeds of the last setpoint, after every limit."""

    def command(self, wheels: WheelSpeeds, until_ns: int) -> None:
        """Select finite wheel speeds (rad/s) until ``until_ns``, unless others replace them."""
        self._wheels, self._until_ns = wheels, until_ns

    def clear(self, reason: str) -> None:
        """Select standstill until the next command."""
        self._wheels = None
        self._reason = reason

    def latch(self, reason: str) -> None:
        """Latch the emergency stop."""
        self.estop = f'emergency stop: {reason}'
        self.clear(reasons.NO_COMMAND)

    def release(self, robot_latched: bool, now_ns: int) -> str:
        """Release the emergency stop of host and robot; return why that is not needed."""
        if not self.estop and not robot_latched:
            return 'no emergency stop is latched'
        self.estop = ''
        self._button_held = False
        self._release_until_ns = now_ns + _RELEASE_TIMEOUT_NS
        self._release_frames = _MIN_RELEASE_FRAMES
        self.clear('no command since the emergency stop was released')
        return ''

    def next_setpoint(
        self, robot_latched: bool, now_ns: int, robot_silent: bool = False
    ) -> Setpoint:
        """Return the setpoint.

        ``robot_latched``: the last status reports an emergency stop. A silent robot may
        still receive, and would move unobserved.
        """
        self.sent_wheels = ZERO_WHEEL_SPEEDS
        self._button_held &= robot_latched  # a latch that is gone was another one
        ttl = self._parameters.ttl_units
        if self.estop:
            return Setpoint(CommandFlag.ESTOP, 0, 0, ttl)
        if self._release_until_ns is not None:
            self._release_frames -= 1
            if self._release_frames >= 0 or (robot_latched and now_ns < self._release_until_ns):
                return Setpoint(CommandFlag.ESTOP_CLEAR, 0, 0, ttl)
            self._button_held = robot_latched
            self._release_until_ns = None
        if self._wheels is not None and now_ns >= self._until_ns:
            self.clear(reasons.COMMAND_EXPIRED)
        if self._wheels is None or robot_latched or robot_silent:
            return Setpoint(CommandFlag.ENABLE, 0, 0, ttl)
        fastest = max(map(abs, self._wheels))
        limit = self._parameters.robot.max_speed
        scale = 1.0 if fastest <= limit else limit / fastest
        right, left = (round(1000.0 * scale * speed) for speed in self._wheels)
        self.sent_wheels = WheelSpeeds(right / 1000.0, left / 1000.0)
        # If the host dies now, the robot stops when the command expires, not later.
        ttl = min(ttl, max(1, (self._until_ns - now_ns) // TTL_UNIT_NS))
        return Setpoint(CommandFlag.ENABLE, left, right, ttl)

    def reason(self, robot_latched: bool) -> str:
        """Return why standstill is selected; empty while a command is followed."""
        if self.estop:
            return self.estop
        if robot_latched:
            return reasons.ESTOP_BUTTON_HELD if self._button_held else reasons.ROBOT_ESTOP
        return '' if self._wheels is not None else self._reason
