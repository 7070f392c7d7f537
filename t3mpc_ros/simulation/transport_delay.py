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
"""Transport delay of commands: delay, jitter and loss between host and board."""

import heapq
import math

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.robot.interface import RobotCommand

CAPACITY = 1000
"""Commands in transit at most: 2 s at 500 Hz."""


class TransportDelay:
    """Delays, reorders and loses commands; it never changes, duplicates or creates one.

    All times are those of one clock. When it jumps back, the commands in transit are dropped,
    because their arrival time is undefined; beyond :data:`CAPACITY` the oldest is dropped. Two
    numbers of its own generator are drawn for each command whatever its outcome, so that a change
    of loss does not shift the delays.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self._in_transit: list[tuple[int, int, RobotCommand]] = []
        """A heap of (arrival, number, command); the number keeps ties in the order of sending."""
        self._clock_ns: int | None = None
        self._sent = 0

    def __len__(self) -> int:
        """Number of commands in transit."""
        return len(self._in_transit)

    @property
    def next_ns(self) -> int | None:
        """Arrival time of the next command; None when none is in transit."""
        return self._in_transit[0][0] if self._in_transit else None

    def send(
        self, command: RobotCommand, now_ns: int, delay_s: float, jitter_s: float, loss: float
    ) -> None:
        """Send a command, which arrives after ``delay_s`` to ``delay_s + jitter_s``.

        The part of the jitter is uniform; ``loss`` is the fraction of the commands that is
        lost.
        """
        if not (0.0 <= delay_s < math.inf and 0.0 <= jitter_s < math.inf):
            raise ValueError(
                f'delay_s and jitter_s must be finite and at least 0 s: got {delay_s}, {jitter_s}'
            )
        if not 0.0 <= loss <= 1.0:
            raise ValueError(f'loss must be from 0 to 1: got {loss}')
        self._check_clock(now_ns)
        loss_number, jitter_number = self._generator.random(), self._generator.random()
        self._sent += 1
        if loss_number < loss:
            return
        arrival_ns = now_ns + round((delay_s + jitter_s * jitter_number) * NANOSECONDS)
        if len(self._in_transit) >= CAPACITY:
            self._in_transit.remove(min(self._in_transit, key=lambda entry: entry[1]))
            heapq.heapify(self._in_transit)
        heapq.heappush(self._in_transit, (arrival_ns, self._sent, command))

    def arrived(self, now_ns: int) -> list[RobotCommand]:
        """Return the commands that arrived since the last call, in order of arrival.

        The order of sending may differ: the limiter rejects overtaken commands.
        """
        self._check_clock(now_ns)
        commands = []
        while self._in_transit and self._in_transit[0][0] <= now_ns:
            commands.append(heapq.heappop(self._in_transit)[2])
        return commands

    def clear(self) -> None:
        """Drop the commands in transit, as a restart of the board does."""
        self._in_transit.clear()

    def _check_clock(self, now_ns: int) -> None:
        if self._clock_ns is not None and now_ns < self._clock_ns:
            self.clear()
        self._clock_ns = now_ns
