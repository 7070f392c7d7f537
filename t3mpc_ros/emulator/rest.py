# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How long after the last command to move the wheels stood: what a lost link comes down to."""

from t3mpc_ros.emulator.emulator import Emulator
from t3mpc_ros.radio.frames import Command


class RestWatch:
    """Tells each stop but those for which a speed of zero was commanded.

    So after silence, a reset, an emergency stop, and when a host takes its leave.

    Parameters
    ----------
    emulator
        Its board tells of each command that it follows.
    """

    def __init__(self, emulator: Emulator) -> None:
        self._plant = emulator.plant
        self._command: Command | None = None
        self._followed = 0.0
        emulator.board.followed = self._follow

    def news(self) -> str:
        """Return a line when the wheels have come to rest since the last call, else nothing."""
        command, stopped = self._command, self._plant.stopped_at
        if command is None or stopped is None or stopped < self._followed:
            return ''
        self._command = None
        if not command.left and not command.right:
            return ''
        right, left = command.right / 1000.0, command.left / 1000.0
        return (
            f'wheels at rest {stopped - self._followed:.3f} s after the last command '
            f'(right {right:g}, left {left:g} rad/s)'
        )

    def _follow(self, now_us: int, command: Command) -> None:
        self._command, self._followed = command, self._plant.elapsed
