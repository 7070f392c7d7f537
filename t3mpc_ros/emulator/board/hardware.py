# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Hardware interface of the robot board; the plant implements it, and so do test doubles."""

from typing import NamedTuple, Protocol


class Registers(NamedTuple):
    """Newest sample of the MPU6050, as raw register values."""

    accel_x: int = 0
    accel_y: int = 0
    accel_z: int = 0
    temperature: int = 0
    gyro_x: int = 0
    gyro_y: int = 0
    gyro_z: int = 0


class Hardware(Protocol):
    """Motors, sensors and battery of the board; wheel order left, right."""

    def run(self, elapsed_us: int) -> None:
        """Advance by a time on the clock of the board."""

    def set_speeds(self, left: int, right: int) -> None:
        """Set the speed of both motors (urad/s)."""

    def set_power(self, on: bool) -> None:
        """Switch the power of both motor drivers."""

    def boot(self, microsteps: int) -> None:
        """Reset both counters, and set the drivers to this number of microsteps per step."""

    @property
    def counters(self) -> tuple[int, int]:
        """Pulses issued since boot, signed by the direction pins."""

    @property
    def registers(self) -> Registers | None:
        """Newest sample of the IMU; None while it does not respond."""

    @property
    def ranges(self) -> bytes:
        """Range code of each of the eight range sensors."""

    @property
    def battery(self) -> int:
        """Battery voltage, mV; 0: not connected to the converter."""
