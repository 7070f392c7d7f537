# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Transport delay of commands: delay, jitter and loss between host and board."""

import heapq
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.robot.interface import RobotCommand

CAPACITY = 1000
"""Commands that can be under way at once: 2 s of them at 500 Hz."""


class TransportCounts(NamedTuple):
    """What became of the commands of a channel since it was made.

    ``sent`` is the sum of the others and of what is still under way.
    """

    sent: int
    arrived: int
    lost: int
    """By chance."""
    dropped: int
    """The oldest, when more were under way than the channel holds."""
    cleared: int
    """Those under way when the channel was cleared, or its clock went back."""


class TransportDelay:
    """Keeps commands until they arrive; changes, doubles and invents none.

    All stamps come from one clock, that of whoever asks what arrived. If it goes back, what was
    under way is gone: nobody could say when it is due.

    Parameters
    ----------
    generator
        Used for nothing else. Two numbers are drawn for each command whatever becomes of it, so
        that a change of loss does not shift the delays.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self._under_way: list[tuple[int, int, RobotCommand]] = []
        """A heap of (arrival, number, command); the number keeps ties in the order of sending."""
        self._clock_ns: int | None = None
        self._sent = self._arrived = self._lost = self._dropped = self._cleared = 0

    def __len__(self) -> int:
        """How many commands are under way."""
        return len(self._under_way)

    @property
    def next_ns(self) -> int | None:
        """When the next command arrives; None when none is under way."""
        return self._under_way[0][0] if self._under_way else None

    @property
    def counts(self) -> TransportCounts:
        """What became of the commands so far."""
        return TransportCounts(self._sent, self._arrived, self._lost, self._dropped, self._cleared)

    def send(
        self, command: RobotCommand, now_ns: int, delay_s: float, jitter_s: float, loss: float
    ) -> None:
        """Put a command on its way: it arrives after ``delay_s`` to ``delay_s + jitter_s``.

        Parameters
        ----------
        command
            Anything, even what a guard will refuse.
        now_ns
            When it leaves.
        delay_s, jitter_s
            s; the part of the jitter is drawn evenly.
        loss
            Share of the commands that never arrive, 0 to 1.

        Raises
        ------
        ValueError
            A delay is negative or not finite, or the loss is no share.
        """
        if not (0.0 <= delay_s < math.inf and 0.0 <= jitter_s < math.inf):
            raise ValueError(
                f'delay_s and jitter_s must be finite and at least 0 s: got {delay_s}, {jitter_s}'
            )
        if not 0.0 <= loss <= 1.0:
            raise ValueError(f'loss must be from 0 to 1: got {loss}')
        self._notice(now_ns)
        chance, part = self._generator.random(), self._generator.random()
        self._sent += 1
        if chance < loss:
            self._lost += 1
            return
        arrival_ns = now_ns + round((delay_s + jitter_s * part) * NANOSECONDS)
        if len(self._under_way) >= CAPACITY:
            self._drop_oldest()
        heapq.heappush(self._under_way, (arrival_ns, self._sent, command))

    def arrived(self, now_ns: int) -> list[RobotCommand]:
        """Return what has arrived by ``now_ns`` and was not returned before, first to last.

        That order is not always the order of sending: a guard refuses what was overtaken.
        """
        self._notice(now_ns)
        commands = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            commands.append(heapq.heappop(self._under_way)[2])
        self._arrived += len(commands)
        return commands

    def clear(self) -> None:
        """Forget what is under way, as a board does that restarts."""
        self._cleared += len(self._under_way)
        self._under_way.clear()

    def _drop_oldest(self) -> None:
        oldest = min(self._under_way, key=lambda entry: entry[1])
        self._under_way.remove(oldest)
        heapq.heapify(self._under_way)
        self._dropped += 1

    def _notice(self, now_ns: int) -> None:
        if self._clock_ns is not None and now_ns < self._clock_ns:
            self.clear()
        self._clock_ns = now_ns
