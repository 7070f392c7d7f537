# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Clock synchronisation: offset and rate of the robot clock, estimated on the host.

Each transaction without a retransmission yields one pair of times: the reception of the CMD by the
robot clock, its transmission by the host clock. Delays of the host are one-sided and show in the
round trip, so fast round trips are the accurate ones. A ceramic resonator is off by up to 0.5 %:
the rate is estimated as well as the offset.
"""

from collections import deque

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS

_WRAP = 1 << 32
_MICROSECOND = 1000
"""ns"""
_WINDOW_NS = 10 * NANOSECONDS
_MAX_SKEW = 0.02
# Weight (s²) of a sample of rate 1 among those measured: spread of a pair (0.2 ms) over spread of
# resonators (0.5 %), squared. It decides nothing once a third of a second is seen.
_SKEW_PRIOR_WEIGHT = (0.2e-3 / 0.005) ** 2

BYTE_NS = 20 * _MICROSECOND
"""One byte on the serial line at 500 000 baud."""


def forward_delay_ns(wire_bytes: int, payload_bytes: int) -> int:
    """Return how long a CMD takes from the first byte written to its arrival at the robot.

    Its bytes on the line, twice 130 us for the radios to settle and to fetch it, and its time in
    the air at 1 Mbit/s: preamble 1, address 5, control 9 bit, CRC 2 (nRF24L01+ data sheet 1.0).
    """
    air_us = (1 + 5 + payload_bytes + 2) * 8 + 9
    return wire_bytes * BYTE_NS + (130 + 130 + air_us) * _MICROSECOND


class CounterUnwrapper:
    """A counter of 32 bits that goes on where it wraps.

    Between two values it must move by less than 2**31: 35 minutes of microseconds.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._total = 0

    @property
    def total(self) -> int:
        """The sum of all moves, from the first value on; from zero after :meth:`rebase`."""
        return self._total

    def add(self, value: int) -> int:
        """Return the total after the counter was seen at ``value`` (signed or not)."""
        if self._last is None:
            self._last = value
            return self._total
        self._total += wrapped_difference(self._last, value)
        self._last = value
        return self._total

    def rebase(self) -> None:
        """Keep the total, and take the next value for where the counter now stands."""
        self._last = None


def wrapped_difference(before: int, after: int) -> int:
    """Return by how much a counter of 32 bits has moved, the shorter way round."""
    return (after - before + (_WRAP >> 1)) % _WRAP - (_WRAP >> 1)


class ClockModel:
    """Turns robot times into host times by a line through the fast half of the last ten seconds.

    Robot times are microseconds that do not wrap (:class:`Unwrapped`).
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int, int]] = deque()
        """Robot time (us), earliest host time (ns) it can be, round trip (ns)."""
        self.reset()

    def reset(self) -> None:
        """Forget everything: the robot has started anew."""
        self._samples.clear()
        self._origin_us = 0
        self._origin_ns = 0
        self._skew = 0.0

    @property
    def is_set(self) -> bool:
        """Whether a single pair of times is known."""
        return bool(self._samples)

    @property
    def skew(self) -> float:
        """By how much a second of the robot is longer than one of the host; 0 if not known."""
        return self._skew

    def add(self, robot_us: int, sent_ns: int, returned_ns: int, travel_ns: int) -> None:
        """Learn from a transaction whose first packet needed no second try.

        Parameters
        ----------
        robot_us
            When the CMD reached the robot, by its own clock.
        sent_ns, returned_ns
            When the host sent it, and when the result was back.
        travel_ns
            What the way to the robot takes at least: :func:`forward_ns`.
        """
        samples = self._samples
        samples.append((robot_us, sent_ns + travel_ns, returned_ns - sent_ns))
        while samples[-1][1] - samples[0][1] > _WINDOW_NS:
            samples.popleft()
        self._fit()

    def to_host_ns(self, robot_us: int) -> int:
        """Return the host time (ns) of a robot time.

        Raises
        ------
        ValueError
            Nothing has been learnt yet.
        """
        if not self._samples:
            raise ValueError('clock model must have seen one transaction at least: got none')
        since = (robot_us - self._origin_us) * _MICROSECOND
        return self._origin_ns + since + round(self._skew * since)

    def _fit(self) -> None:
        last_us, last_ns, _ = self._samples[-1]
        # Relative to the newest sample whole numbers become exact floats.
        table = np.array(self._samples, dtype=np.int64) - (last_us, last_ns, 0)
        robot, host, trip = table[:, 0] * _MICROSECOND, table[:, 1], table[:, 2]
        fast = trip <= np.median(trip)
        # What a round trip takes longer than the shortest was lost there or back: half of it each
        # way is wrong by half of it at most, and by nothing in the mean.
        excess = 0.5 * (trip[fast] - trip.min())
        x = robot[fast] / NANOSECONDS
        y = (host[fast] - robot[fast] + excess) / NANOSECONDS
        x_mean, y_mean = float(x.mean()), float(y.mean())
        x -= x_mean
        skew = float(x @ (y - y_mean)) / (float(x @ x) + _SKEW_PRIOR_WEIGHT)
        self._skew = min(max(skew, -_MAX_SKEW), _MAX_SKEW)
        self._origin_us = last_us
        self._origin_ns = last_ns + round((y_mean - self._skew * x_mean) * NANOSECONDS)
