# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Slip monitor: stops the robot when gyro and wheel steps disagree for too long."""

from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

RELEASE_TIME = 0.5
"""s without a command that moves, after which the robot obeys again."""
SLIP_STOP_REASON = (
    'gyro and steps disagree: a wheel slips, is blocked, or has lost steps; '
    f'command nothing, or standstill, for {RELEASE_TIME:g} s to go on'
)


class SlipMonitor:
    """Decides whether a robot must stand because gyro and steps have disagreed for too long.

    A stop of the guard lasts until the next command, and that is there a period later: the robot
    would say that it stands, and drive. A stop that ends by itself would be tried again and
    again, with something in the wheel. So it lasts until whoever commands has let go.
    """

    def __init__(self) -> None:
        self.holds = False
        """Whether the robot is to stand."""
        self._urged = 0.0
        """When a command that moves last came while it stood, s."""

    def refuses(self, command: RobotCommand, now: float) -> bool:
        """Decide whether a command that arrives ``now`` (s) is not to be followed."""
        if self.holds and command.wheels != ZERO_WHEEL_SPEEDS:
            self._urged = now
        return self.holds

    def decide(self, slipping_for: float, limit: float, now: float) -> bool:
        """Decide whether the robot is to stand at ``now`` (s).

        Parameters
        ----------
        slipping_for
            For how long gyro and steps have disagreed, s; 0: they do not.
        limit
            For how long they may, s; 0: for ever.
        now
            s, of the clock of :meth:`refuses`.
        """
        if limit > 0.0 and slipping_for > limit:
            if not self.holds:
                self.holds, self._urged = True, now
        elif limit == 0.0 or now - self._urged >= RELEASE_TIME:
            self.holds = False
        return self.holds

    def forget(self) -> None:
        """Let the robot move, as after a restart of its board."""
        self.holds = False
