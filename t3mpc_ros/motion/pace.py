# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Which samples of a fixed grid of time are due now."""

from t3mpc_ros.motion.words import NANOSECONDS


class Pace:
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
