# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the robot board: held in RAM, except the microsteps for the next boot."""

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import BOARD_PARAMETERS

(
    MAX_SPEED,
    ACCELERATION,
    DECELERATION,
    TTL_MAX,
    MICROSTEPS,
    STEPS_PER_REV,
    GYRO_RANGE,
    BATTERY_LOW,
    IDLE_OFF,
    INVERT_WHEELS,
) = range(len(BOARD_PARAMETERS))
_AT_REST = (MICROSTEPS, INVERT_WHEELS)


class ParameterStore:
    """The values in force, by id; read them with ``parameters[MAX_SPEED]``."""

    def __init__(self) -> None:
        self._stored = BOARD_PARAMETERS[MICROSTEPS].default
        self.restart()

    def __getitem__(self, number: int) -> int:
        return self._values[number]

    def restart(self) -> None:
        """Forget what was written, but for the microsteps, which hold from now on."""
        self._values = [parameter.default for parameter in BOARD_PARAMETERS]
        self._values[MICROSTEPS] = self._stored

    def set(self, number: int, value: int, busy: bool) -> int:
        """Change a parameter if everything allows it; return the result for the host."""
        if number >= len(BOARD_PARAMETERS):
            return frames.UNKNOWN
        row = BOARD_PARAMETERS[number]
        if row.low == row.high:
            return frames.READ_ONLY
        if not row.low <= value <= row.high:
            return frames.OUT_OF_RANGE
        if number in _AT_REST and busy and value != self._values[number]:
            return frames.BUSY
        self._values[number] = value
        if number == MICROSTEPS:
            self._stored = value
        return frames.OK
