# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wheel motion of the robot board: ramp, driver power, step counters, direction.

All arithmetic is in the integers of the firmware. Both wheels follow one ramp factor, which keeps
the curvature while the robot accelerates or stops. Order: left, right, as in the frames.
"""

from t3mpc_ros.emulator.board.hardware import Hardware
from t3mpc_ros.emulator.board.parameter_store import (
    ACCELERATION,
    DECELERATION,
    IDLE_OFF,
    INVERT_WHEELS,
    ParameterStore,
)

LONGEST_STEP_US = 20_000
"""After a stall of the main loop a ramp continues, it does not jump."""


class Ramp:
    """Speeds and targets of both wheels, urad/s."""

    def __init__(self) -> None:
        self.speed = [0, 0]
        self.target = [0, 0]

    @property
    def settled(self) -> bool:
        """Whether both wheels are as fast as they are to be."""
        return self.speed == self.target

    @property
    def moving(self) -> bool:
        """Whether a wheel turns."""
        return any(self.speed)

    @property
    def busy(self) -> bool:
        """Whether a wheel turns or is going to."""
        return any(self.speed) or any(self.target)

    def aim(self, left: int, right: int, limit: int) -> bool:
        """Take a command (mrad/s), scaled to ``limit`` by one factor; return whether it was."""
        fastest = max(abs(left), abs(right))
        limited = fastest > limit
        if limited:
            left, right = _scaled(left, limit, fastest), _scaled(right, limit, fastest)
        self.target = [1000 * left, 1000 * right]
        return limited

    def halt(self) -> None:
        """Come to rest."""
        self.target = [0, 0]

    def step(self, acceleration: int, deceleration: int, elapsed_us: int) -> None:
        """Go on for some time; the rates are in mrad/s².

        The second one rules where wheels slow down; where one speeds up and the other slows down,
        the smaller of both does.
        """
        gaps = [abs(to - now) for now, to in zip(self.speed, self.target, strict=True)]
        widest = max(gaps)
        rate = self._rate(acceleration, deceleration)
        limit = rate * min(elapsed_us, LONGEST_STEP_US) // 1000
        if widest <= limit:
            self.speed = list(self.target)
            return
        for wheel, gap in enumerate(gaps):
            size = limit if gap == widest else _share(limit, gap, widest)
            self.speed[wheel] += size if self.target[wheel] >= self.speed[wheel] else -size

    def _rate(self, acceleration: int, deceleration: int) -> int:
        faster = slower = False
        for now, to in zip(self.speed, self.target, strict=True):
            up = to > now >= 0 or to < now <= 0
            faster |= up
            slower |= not up and to != now
        if faster and slower:
            return min(acceleration, deceleration)
        return acceleration if faster else deceleration


def _scaled(speed: int, limit: int, fastest: int) -> int:
    """Return speed limit / fastest, cut towards zero as C divides."""
    size = abs(speed) * limit // fastest
    return size if speed > 0 else -size


def _share(limit: int, part: int, whole: int) -> int:
    """Return limit part / whole with the 16 bits that the firmware gives it."""
    while whole > 0xFFFF:
        whole >>= 1
        part >>= 1
    return limit * ((part << 16) // whole) >> 16


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

    def __init__(self, hardware: Hardware, parameters: ParameterStore, now_us: int) -> None:
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
