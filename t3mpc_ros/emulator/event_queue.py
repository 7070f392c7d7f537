# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Discrete-event queue: runs scheduled callbacks in order of virtual time."""

from collections.abc import Callable
import heapq
from itertools import count

MICROSECOND = 1000  # ns

Callback = Callable[[], None]


class EventQueue:
    """Runs each callback at its time; callbacks of equal time run in the order of scheduling."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns
        """Time of the running callback, or the time up to which all callbacks have run."""
        self._events: list[tuple[int, int, Callback]] = []
        self._numbers = count()

    @property
    def next_ns(self) -> int | None:
        """Time of the next callback; None if the queue is empty."""
        return self._events[0][0] if self._events else None

    def schedule(self, time_ns: int, callback: Callback) -> None:
        """Schedule a callback; a time in the past counts as now."""
        heapq.heappush(self._events, (max(time_ns, self.now_ns), next(self._numbers), callback))

    def schedule_after(self, delay_us: float, callback: Callback) -> None:
        """Schedule a callback ``delay_us`` from now."""
        self.schedule(self.now_ns + round(delay_us * MICROSECOND), callback)

    def run_to(self, now_ns: int) -> None:
        """Run all callbacks due by ``now_ns``."""
        while self._events and self._events[0][0] <= now_ns:
            self.now_ns, _, callback = heapq.heappop(self._events)
            callback()
        self.now_ns = max(self.now_ns, now_ns)
