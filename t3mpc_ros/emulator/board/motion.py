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

PERIOD_US = 1_000
"""Period of the ramp."""
ESTOP_DECELERATION = 60_000
"""Least deceleration of an emergency stop, mrad/s²."""
MAX_STEP_US = 20_000
"""Longest step of the ramp: after a stall of the main loop the speed does not jump."""


class Wheels:
    """Both wheels of the board: drives the motors along the ramp and counts their steps.

    Parameters
    ----------
    hardware
        Motors and pulse counters.
    parameters
        Acceleration, deceleration, direction and idle time.
    now_us
        Time of boot.
    """

    def __init__(self, hardware: Hardware, parameters: ParameterStore, now_us: int) -> None:
        self.ramp = Ramp()
        self.powered = False
        """Whether the motor drivers have power."""
        self._hardware = hardware
        self._parameters = parameters
        self._period_us = now_us
        self._rest_us: int | None = None
        self._idle = False
        self._base = [0, 0]

    @property
    def counters(self) -> tuple[int, int]:
        """Microsteps in the direction of the command, left first, before the wrap to 32 bits."""
        raw = self._hardware.counters
        left, right = (
            base + sign * count
            for base, sign, count in zip(self._base, self._signs(), raw, strict=True)
        )
        return left, right

    @counters.setter
    def counters(self, values: tuple[int, int]) -> None:
        changes = zip(values, self.counters, self._base, strict=True)
        self._base = [base + value - current for value, current, base in changes]

    def due_times(self) -> list[int]:
        """Return the times (us) at which the wheels need a pass of the main loop."""
        times = [] if self.ramp.settled else [self._period_us + PERIOD_US]
        idle_off_us = 1000 * self._parameters[IDLE_OFF]
        if self._rest_us is not None and idle_off_us and not self._idle:
            times.append(self._rest_us + idle_off_us)
        return times

    def skip_periods(self, until_us: int) -> None:
        """Skip the ramp periods up to a time, if the ramp is settled."""
        if self.ramp.settled and until_us > self._period_us:
            self._period_us += (until_us - self._period_us) // PERIOD_US * PERIOD_US

    def update_power(self, enabled: bool, now_us: int) -> None:
        """Switch the motor drivers on, or off after the idle time at rest."""
        if self.ramp.busy:
            self._rest_us, self._idle = None, False
        else:
            if self._rest_us is None:
                self._rest_us = now_us
            idle_off_us = 1000 * self._parameters[IDLE_OFF]
            self._idle = idle_off_us > 0 and (self._idle or now_us - self._rest_us >= idle_off_us)
        # A motor without power coasts: the drivers keep their power until the end of the ramp.
        on = self.ramp.moving or (enabled and not self._idle)
        if on != self.powered:
            self._hardware.set_power(on)
        self.powered = on

    def update_ramp(self, now_us: int, estop: bool) -> bool:
        """Advance the ramp if its period is over; return whether the speeds changed.

        ``estop``: the emergency stop is latched, which has a least deceleration.
        """
        elapsed = now_us - self._period_us
        if elapsed < PERIOD_US:
            return False
        self._period_us = now_us
        if self.ramp.settled:
            return False
        deceleration = self._parameters[DECELERATION]
        if estop:
            deceleration = max(deceleration, ESTOP_DECELERATION)
        self.ramp.step(self._parameters[ACCELERATION], deceleration, elapsed)
        left, right = (
            sign * speed for sign, speed in zip(self._signs(), self.ramp.speed, strict=True)
        )
        self._hardware.set_speeds(left, right)
        return True

    def _signs(self) -> tuple[int, int]:
        inverted = self._parameters[INVERT_WHEELS]
        return (-1 if inverted & 1 else 1), (-1 if inverted & 2 else 1)


class Ramp:
    """Current and target speeds of both wheels, urad/s."""

    def __init__(self) -> None:
        self.speed = [0, 0]
        self.target = [0, 0]

    @property
    def settled(self) -> bool:
        """Whether both wheels have their target speed."""
        return self.speed == self.target

    @property
    def moving(self) -> bool:
        """Whether a wheel turns."""
        return any(self.speed)

    @property
    def busy(self) -> bool:
        """Whether a wheel turns or has a target speed other than zero."""
        return any(self.speed) or any(self.target)

    def set_target(self, left: int, right: int, limit: int) -> bool:
        """Set the target (mrad/s), both wheels scaled to ``limit``; return whether limited."""
        fastest = max(abs(left), abs(right))
        limited = fastest > limit
        if limited:
            left, right = _scaled(left, limit, fastest), _scaled(right, limit, fastest)
        self.target = [1000 * left, 1000 * right]
        return limited

    def stop(self) -> None:
        """Set the target to zero."""
        self.target = [0, 0]

    def step(self, acceleration: int, deceleration: int, elapsed_us: int) -> None:
        """Advance both speeds towards the target; the rates are in mrad/s².

        Deceleration applies where a wheel slows down. Where one wheel speeds up and the other
        slows down, the smaller rate applies to both.
        """
        gaps = [abs(to - now) for now, to in zip(self.speed, self.target, strict=True)]
        widest = max(gaps)
        rate = self._rate(acceleration, deceleration)
        limit = rate * min(elapsed_us, MAX_STEP_US) // 1000
        if widest <= limit:
            self.speed = list(self.target)
            return
        for wheel, gap in enumerate(gaps):
            size = limit if gap == widest else _proportion(limit, gap, widest)
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
    """Return speed limit / fastest, rounded towards zero like a division in C."""
    size = abs(speed) * limit // fastest
    return size if speed > 0 else -size


def _proportion(limit: int, part: int, whole: int) -> int:
    """Return limit part / whole with the 16-bit resolution of the firmware."""
    while whole > 0xFFFF:
        whole >>= 1
        part >>= 1
    return limit * ((part << 16) // whole) >> 16
