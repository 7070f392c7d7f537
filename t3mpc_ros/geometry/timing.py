# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Sampling at a fixed rate, simulated time, and the real-time factor."""

from t3mpc_ros.geometry.types import NANOSECONDS


class SampleScheduler:
    """Turns irregular calls into samples on an exact grid, none of them lost.

    A timer that comes late is answered with every sample it missed, so a busy machine delays a
    stream but leaves no holes in it.

    Parameters
    ----------
    rate
        Samples a second.
    burst
        Longest time (s) that is caught up with; what is older is skipped and counted.
    slack
        How long (s) before the first call the grid begins. A timer of the same period then
        finds each sample due although it sometimes comes a little early; without slack such a
        call finds none, and the next one two.
    """

    def __init__(self, rate: float, burst: float = 0.5, slack: float = 0.0) -> None:
        self._period_ns = NANOSECONDS / rate
        self._slack_ns = round(slack * NANOSECONDS)
        self._most = max(1, int(burst * rate))
        self.reset()

    def reset(self) -> None:
        """Start a new grid at the next call."""
        self._start_ns: int | None = None
        self._next = 0
        self.skipped = 0
        """Samples given up since the grid began."""

    def due(self, now_ns: int) -> list[int]:
        """Return the stamps (ns) of all samples due at ``now_ns`` that were not returned before.

        The first call starts the grid. A clock that has jumped back starts a new one.
        """
        if self._start_ns is None or now_ns < self._stamp(self._next - 1):
            self.reset()
            self._start_ns = max(now_ns - self._slack_ns, min(now_ns, 0))
        last = int((now_ns - self._start_ns) / self._period_ns)
        if self._stamp(last + 1) <= now_ns:  # the division may have rounded down
            last += 1
        first = max(self._next, last + 1 - self._most)
        self.skipped += first - self._next
        self._next = max(self._next, last + 1)
        return [self._stamp(n) for n in range(first, last + 1)]

    def lateness(self, now_ns: int) -> float:
        """Return how long ago (s) the newest sample returned was due."""
        if self._start_ns is None:
            return 0.0
        return (now_ns - self._stamp(self._next - 1)) / NANOSECONDS

    def _stamp(self, n: int) -> int:
        assert self._start_ns is not None
        return self._start_ns + round(n * self._period_ns)


class SimulatedTime:
    """Decides what time it is where time is made: faster or slower than the machine's, or by hand.

    Samples lie on an exact grid that always starts at the same instant, and none is ever left
    out: on a machine that cannot keep up, time passes more slowly. It never runs ahead of the
    next sample, so nobody hears of a time that has not been computed.

    Parameters
    ----------
    rate
        Samples a second of simulated time.
    speed
        Simulated seconds per second; 0: time stands, and moves by :meth:`step` only.
    most
        Most samples due at once, so that others get their turn between them.
    start_ns
        Where the grid begins: not at 0, which to many means that nobody knows the time.
    """

    def __init__(
        self, rate: float, speed: float, most: int = 50, start_ns: int = NANOSECONDS
    ) -> None:
        self._period_ns = NANOSECONDS / rate
        self._slack_ns = round(0.2 * self._period_ns)
        self._most = most
        self._start_ns = start_ns
        self._next = 0
        self._anchor = start_ns, 0
        """An instant of simulated time, and the machine's time at which it was."""
        self._anchored = False
        self._speed = speed

    @property
    def speed(self) -> float:
        """Simulated seconds per second that are asked for."""
        return self._speed

    def change_speed(self, speed: float, steady_ns: int) -> None:
        """Let time pass at another speed from now on; 0 freezes it."""
        self._anchor = self.now_ns(steady_ns), steady_ns
        self._anchored = False
        self._speed = speed

    def now_ns(self, steady_ns: int) -> int:
        """Return the simulated time when the machine's is ``steady_ns``."""
        if not self._anchored:
            return self._anchor[0]
        return min(self._run(steady_ns), self._stamp(self._next))

    def due(self, steady_ns: int) -> list[int]:
        """Return the stamps (ns) of the samples due now: the first at once, then each in turn."""
        if self._speed == 0.0:
            return self.step(0) if self._next == 0 else []
        if not self._anchored:
            # The grid follows the timer: one that jitters then finds each sample in its turn.
            self._anchor = self._stamp(self._next) + self._slack_ns, steady_ns
            self._anchored = True
        passed = int((self._run(steady_ns) - self._start_ns) / self._period_ns)
        last = min(passed, self._next + self._most - 1)
        stamps = [self._stamp(n) for n in range(self._next, last + 1)]
        self._next = max(self._next, last + 1)
        if last < passed:
            self._anchor = self._stamp(last) + self._slack_ns, steady_ns
        return stamps

    def step(self, count: int) -> list[int]:
        """Return the stamps of the next ``count`` samples, and let time stand at the last.

        The first sample, where time starts, is not one of those counted.

        Raises
        ------
        ValueError
            Time runs by itself.
        """
        if self._speed != 0.0:
            raise ValueError(f'speed must be 0 to go step by step: got {self._speed:g}')
        last = max(self._next - 1, 0) + count
        stamps = [self._stamp(n) for n in range(self._next, last + 1)]
        self._next = last + 1
        if stamps:
            self._anchor = stamps[-1], 0
        return stamps

    def _run(self, steady_ns: int) -> int:
        instant, then = self._anchor
        return instant + round((steady_ns - then) * self._speed)

    def _stamp(self, n: int) -> int:
        return self._start_ns + round(n * self._period_ns)


class RealTimeFactor:
    """Measures how many simulated seconds pass in a second, over the last second or so."""

    def __init__(self) -> None:
        self.value: float | None = None
        """None until the first second is over."""
        self.restart()

    def restart(self) -> None:
        """Begin a new measurement: the speed that is asked for has changed."""
        self.value = None
        self._since: tuple[int, int] | None = None

    def note(self, simulated_ns: int, steady_ns: int) -> None:
        """Take note of what time it is, simulated and by the machine."""
        if self._since is None:
            self._since = simulated_ns, steady_ns
        simulated, steady = self._since
        if steady_ns - steady >= NANOSECONDS:
            self.value = (simulated_ns - simulated) / (steady_ns - steady)
            self._since = simulated_ns, steady_ns
