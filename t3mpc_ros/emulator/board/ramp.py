# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wheel speeds on their way to a target, in the whole numbers of the firmware.

Both wheels follow one factor, so that the robot keeps its curvature while it speeds up or stops.
Left first, as on the wire.
"""

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
