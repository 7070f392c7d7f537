# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Hardware interface of the robot board; the plant implements it, and so do test doubles."""

from typing import NamedTuple, Protocol


class Registers(NamedTuple):
    """What the MPU6050 last measured, as its registers hold it."""

    accel_x: int = 0
    accel_y: int = 0
    accel_z: int = 0
    temperature: int = 0
    gyro_x: int = 0
    gyro_y: int = 0
    gyro_z: int = 0


class Hardware(Protocol):
    """What the board drives and reads; left first."""

    def run(self, elapsed_us: int) -> None:
        """Let time pass, by the board's clock."""

    def turn(self, left: int, right: int) -> None:
        """Step both motors at these speeds (urad/s) from now on."""

    def power(self, on: bool) -> None:
        """Give power to both drivers, or take it away."""

    def boot(self, microsteps: int) -> None:
        """Start with both counters at zero, for drivers set to so many microsteps."""

    @property
    def counters(self) -> tuple[int, int]:
        """Pulses issued since the start, by the direction of the pins."""

    @property
    def registers(self) -> Registers | None:
        """The newest sample of the inertial sensor; None while it does not answer."""

    @property
    def ranges(self) -> bytes:
        """A code for each of the eight distance sensors."""

    @property
    def battery(self) -> int:
        """mV; 0: nothing is wired to the converter."""
