# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Both wheels of the board: ramp, power of the drivers, counters, direction."""

from t3mpc_ros.emulator.board.hardware import Hardware
from t3mpc_ros.emulator.board.parameters import (
    ACCELERATION,
    DECELERATION,
    IDLE_OFF,
    INVERT_WHEELS,
    Parameters,
)
from t3mpc_ros.emulator.board.ramp import Ramp

PERIOD_US = 1_000
"""The ramp moves on so often."""


class Wheels:
    """Turns the ramp into what the hardware is told, and what it counts into what the host hears.

    Parameters
    ----------
    hardware
        Steps and counts.
    parameters
        Rates, direction and the time to power off.
    now_us
        The board starts.
    """

    def __init__(self, hardware: Hardware, parameters: Parameters, now_us: int) -> None:
        self.ramp = Ramp()
        self.powered = False
        """Whether the drivers have power."""
        self._hardware = hardware
        self._parameters = parameters
        self._period_us = now_us
        self._rest_us: int | None = None
        self._idle = False
        self._base = [0, 0]

    @property
    def counters(self) -> tuple[int, int]:
        """Microsteps issued as the host is to see them, left first, but for the wrap."""
        raw = self._hardware.counters
        left, right = (
            base + sign * count
            for base, sign, count in zip(self._base, self._signs(), raw, strict=True)
        )
        return left, right

    @counters.setter
    def counters(self, wanted: tuple[int, int]) -> None:
        now = zip(wanted, self.counters, self._base, strict=True)
        self._base = [base + to - is_now for to, is_now, base in now]

    def due_us(self) -> list[int]:
        """Return when there is something to do."""
        times = [] if self.ramp.settled else [self._period_us + PERIOD_US]
        allowed = 1000 * self._parameters[IDLE_OFF]
        if self._rest_us is not None and allowed and not self._idle:
            times.append(self._rest_us + allowed)
        return times

    def catch_up(self, until_us: int) -> None:
        """Count the periods up to then in which the ramp had nothing to do."""
        if self.ramp.settled and until_us > self._period_us:
            self._period_us += (until_us - self._period_us) // PERIOD_US * PERIOD_US

    def switch_power(self, enabled: bool, now_us: int) -> None:
        """Give the drivers power, or take it from those that have stood for long enough."""
        if self.ramp.busy:
            self._rest_us, self._idle = None, False
        else:
            if self._rest_us is None:
                self._rest_us = now_us
            allowed = 1000 * self._parameters[IDLE_OFF]
            self._idle = allowed > 0 and (self._idle or now_us - self._rest_us >= allowed)
        # A motor without power rolls on: the drivers keep it until the ramp has ended.
        on = self.ramp.moving or (enabled and not self._idle)
        if on != self.powered:
            self._hardware.power(on)
        self.powered = on

    def move_on(self, now_us: int) -> bool:
        """Let the ramp go on if its period is over; return whether the wheels changed speed."""
        elapsed = now_us - self._period_us
        if elapsed < PERIOD_US:
            return False
        self._period_us = now_us
        if self.ramp.settled:
            return False
        self.ramp.step(self._parameters[ACCELERATION], self._parameters[DECELERATION], elapsed)
        left, right = (
            sign * speed for sign, speed in zip(self._signs(), self.ramp.speed, strict=True)
        )
        self._hardware.turn(left, right)
        return True

    def _signs(self) -> tuple[int, int]:
        inverted = self._parameters[INVERT_WHEELS]
        return (-1 if inverted & 1 else 1), (-1 if inverted & 2 else 1)
