# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Discrete-event queue: runs scheduled callbacks in order of virtual time."""

from collections.abc import Callable
import heapq
from itertools import count

MICROSECOND = 1000
"""ns"""

Callback = Callable[[], None]


class EventQueue:
    """Does each deed at its time, in order; those of one time in the order they were noted."""

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._deeds: list[tuple[int, int, Callback]] = []
        self._numbers = count()

    @property
    def now_ns(self) -> int:
        """Time of the deed that is being done, or up to which all are."""
        return self._now_ns

    @property
    def next_ns(self) -> int | None:
        """When the next deed is due; None if there is none."""
        return self._deeds[0][0] if self._deeds else None

    def at(self, time_ns: int, deed: Callback) -> None:
        """Note a deed; one that should have been done already is done next."""
        heapq.heappush(self._deeds, (max(time_ns, self._now_ns), next(self._numbers), deed))

    def after_us(self, delay_us: float, deed: Callback) -> None:
        """Note a deed for so many microseconds from now."""
        self.at(self._now_ns + round(delay_us * MICROSECOND), deed)

    def run_to(self, now_ns: int) -> None:
        """Do all that is due by then."""
        while self._deeds and self._deeds[0][0] <= now_ns:
            self._now_ns, _, deed = heapq.heappop(self._deeds)
            deed()
        self._now_ns = max(self._now_ns, now_ns)
