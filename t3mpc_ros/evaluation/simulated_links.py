# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the links between robot and controller: messages that are lost or late."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
import math
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
T = TypeVar('T')


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Faults of the links between robot and controller."""

    command_loss: float = 0.0
    """Fraction of the commands that is lost."""
    command_delay: tuple[float, float] = (0.0, 0.0)
    """Least and largest additional delay of a command, s; uniform between them. A command that
    arrives after a later one is ignored."""
    odometry_loss: float = 0.0
    """Fraction of the measurements that is lost."""
    odometry_delay: tuple[float, float] = (0.0, 0.0)
    """Least and largest delay of a measurement, s; they arrive in order."""
    begin: float = 0.0
    """Begin of the faults, as a share of the run."""
    lasting: float = math.inf
    """Duration of the faults, s."""

    def span(self, duration: float) -> tuple[float, float]:
        """Return begin and end (s) of the faults in a run of ``duration`` seconds."""
        begin = self.begin * duration
        return begin, begin + self.lasting


NO_FAULTS = LinkFaults()
DROPOUTS = LinkFaults(command_loss=0.1, odometry_loss=0.1)
JITTER = LinkFaults(command_delay=(0.0, 0.02), odometry_delay=(0.0, 0.01))
OVERLOAD = LinkFaults(
    command_delay=(0.02, 0.12), odometry_delay=(0.02, 0.12), begin=0.5, lasting=4.0
)
LINK_TEXTS: Mapping[LinkFaults, str] = {
    DROPOUTS: '10 % of the commands and 10 % of the measurements are lost',
    JITTER: 'each command is up to 20 ms late, and each measurement up to 10 ms',
    OVERLOAD: 'for 4 s from half of the run on, each command and each measurement is 20 to 120 ms '
    'late',
}
"""What these faults are, in words."""


def delay_between(bounds: tuple[float, float], share: float) -> float:
    """Return the delay (s) at a share of the way from the least to the largest one."""
    least, most = bounds
    return least + (most - least) * share


class OrderedLink(Generic[T]):
    """Messages under way that arrive in order; the unit of time is the caller's."""

    def __init__(self) -> None:
        self._queue: deque[tuple[int, T]] = deque()
        self._latest = 0

    def send(self, message: T, arrival: int) -> None:
        """Send a message that arrives at ``arrival``, or with the one before it if later."""
        self._latest = max(self._latest, arrival)
        self._queue.append((self._latest, message))

    def arrived(self, now: int) -> Iterator[tuple[int, T]]:
        """Yield (arrival, message) of what has arrived by ``now``."""
        while self._queue and self._queue[0][0] <= now:
            yield self._queue.popleft()


class PeriodicLinks:
    """Links with faults between plant and controller, in whole control periods.

    Parameters
    ----------
    faults, seed
        What is lost or late; equal seeds draw equal numbers, whatever is sent.
    steps, rate
        Control periods of the run, and how many there are in a second.
    """

    def __init__(self, faults: LinkFaults, seed: int, steps: int, rate: float) -> None:
        self._faults, self._rate = faults, rate
        begin = round(faults.begin * steps)
        self._active = range(begin, int(min(begin + faults.lasting * rate, steps)))
        self._drawn: Array = np.random.default_rng((seed, 4)).random((steps, 4))
        self._measurements: OrderedLink[tuple[int, Array]] = OrderedLink()
        self._commands: list[tuple[int, int, Array]] = []
        self._newest = -1
        self._command: Array = np.zeros(2)

    def measured(self, k: int, measured: Array) -> Iterator[tuple[int, Array]]:
        """Send the measurement of period k; yield those that arrive in it, with their periods."""
        lost, late = self._drawn[k, :2].tolist()
        active = k in self._active
        if not active or lost >= self._faults.odometry_loss:
            delay = self._periods(self._faults.odometry_delay, late) if active else 0
            self._measurements.send((k, measured.copy()), k + delay)
        for _, message in self._measurements.arrived(k):
            yield message

    def send(self, k: int, j: int, command: Array) -> None:
        """Send in period k the command that follows from the measurement of period j."""
        lost, late = self._drawn[j, 2:].tolist()
        active = k in self._active
        if not active or lost >= self._faults.command_loss:
            delay = self._periods(self._faults.command_delay, late) if active else 0
            self._commands.append((k + delay, j, command.copy()))

    def command(self, k: int) -> Array:
        """Return the command that has arrived by period k, of the newest measurement."""
        for arrival, j, command in self._commands:
            if arrival <= k and j > self._newest:
                self._newest, self._command = j, command
        self._commands = [each for each in self._commands if each[0] > k]
        return self._command

    def _periods(self, bounds: tuple[float, float], share: float) -> int:
        return round(delay_between(bounds, share) * self._rate)
