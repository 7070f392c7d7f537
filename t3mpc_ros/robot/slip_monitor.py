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
"""Slip monitor: stops the robot when gyro and wheel steps disagree for too long."""

from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

RELEASE_TIME = 0.5
"""s without a motion command after which the robot follows commands again."""
SLIP_STOP_REASON = (
    'gyro and steps disagree: a wheel slips, is blocked, or has lost steps; '
    f'stop commanding motion for {RELEASE_TIME:g} s to resume'
)


class SlipMonitor:
    """Decides whether the robot must stop because gyro and steps disagreed for too long.

    A stop of the command limiter lasts until the next command, which arrives one period later:
    the robot would report a stop and drive on. A stop that ended by itself would be followed by
    another push against the obstacle. The stop therefore lasts until motion commands pause.
    """

    def __init__(self) -> None:
        self.stopped = False
        """Whether the robot must stand still."""
        self._last_motion_command = 0.0
        """Time of the last motion command during the stop, s."""

    def rejects(self, command: RobotCommand, now: float) -> bool:
        """Decide whether a command that arrives at ``now`` (s) is rejected."""
        if self.stopped and command.wheels != ZERO_WHEEL_SPEEDS:
            self._last_motion_command = now
        return self.stopped

    def update(self, slipping_for: float, limit: float, now: float) -> bool:
        """Decide whether the robot must stand still at ``now`` (s).

        slipping_for : time for which gyro and steps have disagreed, s; 0 when they agree
        limit : largest permitted ``slipping_for``, s; 0 disables the stop
        now : s, of the clock of :meth:`rejects`
        """
        if limit > 0.0 and slipping_for > limit:
            if not self.stopped:
                self.stopped, self._last_motion_command = True, now
        elif limit == 0.0 or now - self._last_motion_command >= RELEASE_TIME:
            self.stopped = False
        return self.stopped

    def reset(self) -> None:
        """End the stop, as after a restart of the board."""
        self.stopped = False
