# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the robot board, held in RAM; the microsteps are those of the settings."""

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
    BATTERY_CUTOFF,
) = range(len(BOARD_PARAMETERS))
_ONLY_AT_REST = (INVERT_WHEELS,)


class ParameterStore:
    """Current parameter values by id; read with ``store[MAX_SPEED]``."""

    def __init__(self) -> None:
        self.reset()

    def __getitem__(self, number: int) -> int:
        return self._values[number]

    def reset(self) -> None:
        """Restore the defaults."""
        self._values = [parameter.default for parameter in BOARD_PARAMETERS]

    def use_microsteps(self, value: int) -> None:
        """Set the read-only microsteps, from the settings."""
        self._values[MICROSTEPS] = value

    def set(self, number: int, value: int, busy: bool) -> int:
        """Write a parameter if it exists, is writable and in range; return the result code."""
        if number >= len(BOARD_PARAMETERS):
            return frames.UNKNOWN
        parameter = BOARD_PARAMETERS[number]
        if parameter.read_only:
            return frames.READ_ONLY
        if not parameter.low <= value <= parameter.high:
            return frames.OUT_OF_RANGE
        if number in _ONLY_AT_REST and busy and value != self._values[number]:
            return frames.BUSY
        self._values[number] = value
        return frames.OK
