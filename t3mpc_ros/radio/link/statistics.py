# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Link statistics: lost cycles, retransmissions, round trips, counters of both ends.

A cycle is one CMD with its POLL. It counts as lost when its own state did not return, for whatever
reason; the robot may or may not have received the command.
"""

from collections import deque
from enum import IntEnum
from typing import NamedTuple

from t3mpc_ros.radio.protocol.frames import Aux, Pong
from t3mpc_ros.radio.protocol.framing import FrameCounts

_WINDOW_CYCLES = 500
"""Window of the statistics: ten seconds at 50 Hz."""
_MIN_CYCLES = 50
"""Minimum number of cycles for a judgement."""
LOSS_LIMIT = 0.05
"""Loss rate above which the level is WARN."""
ROUND_TRIP_LIMIT = 0.5
"""Fraction of the period above which slow round trips cause WARN."""
RETRY_COUNTS = 16
"""Number of retransmission counts: the radio chip counts to 15."""


class DiagnosticLevel(IntEnum):
    """Level of a diagnostic status."""

    OK = 0
    WARN = 1
    ERROR = 2


class LinkQuality(NamedTuple):
    """Quality of the link; loss rate and round trips over the last 500 cycles."""

    level: DiagnosticLevel
    text: str
    """Reason of the level; empty for OK."""
    cycles: int
    """Since the port was first opened."""
    lost: int
    """Lost cycles since then."""
    lost_share: float
    """0 to 1; NaN before the first cycle, like the next two."""
    round_trip_median: float
    """s"""
    round_trip_p99: float
    """s"""
    retransmissions: tuple[int, ...]
    """Number of packets with 0, 1, … 15 retransmissions, acknowledged or not."""
    age: float
    """Time since the last telemetry, s; inf before the first."""
    robot_resets: int
    """Since the port was first opened, like the next three."""
    dongle_resets: int
    sessions: int
    """Started, including the first."""
    port_failures: int
    host: FrameCounts
    """Frames received by the host."""
    malformed: int
    """Frames with valid CRC and invalid content."""
    dongle: Pong | None
    """Last PONG of the dongle."""
    robot: Aux | None
    """Last AUX of the robot."""


class LinkStatistics:
    """Collects the events of the link and computes its quality.

    ``period`` of the cycles in s; above the age ``timeout`` (s) of the telemetry the level is
    ERROR: the robot has stopped by then.
    """

    def __init__(self, period: float, timeout: float) -> None:
        self._period = period
        self._timeout = timeout
        self._recent: deque[float | None] = deque(maxlen=_WINDOW_CYCLES)
        """Round trip of each cycle, None for a lost one."""
        self._retransmissions = [0] * RETRY_COUNTS
        self._cycles = self._lost = 0
        self.robot_resets = 0
        self.dongle_resets = 0
        self.sessions = 0
        self.port_failures = 0
        self.malformed = 0
        self.dongle: Pong | None = None
        self.robot: Aux | None = None

    def add_exchange(self, retransmissions: int) -> None:
        """Count one transmitted packet."""
        self._retransmissions[retransmissions] += 1

    def add_cycle(self, round_trip: float | None) -> None:
        """Count a cycle with its round trip (s); None for a lost one."""
        self._cycles += 1
        self._recent.append(round_trip)
        if round_trip is None:
            self._lost += 1

    def quality(self, age: float, host: FrameCounts) -> LinkQuality:
        """Return the quality of the link at telemetry age ``age`` (s)."""
        trips = sorted(trip for trip in self._recent if trip is not None)
        recent = len(self._recent)
        lost_share = (recent - len(trips)) / recent if recent else float('nan')
        median, slow = _quantile(trips, 0.5), _quantile(trips, 0.99)
        level, text = DiagnosticLevel.OK, ''
        if age > self._timeout:
            level, text = DiagnosticLevel.ERROR, f'no telemetry for {age:.2f} s'
        elif recent < _MIN_CYCLES:
            pass
        elif lost_share > LOSS_LIMIT:
            level, text = (
                DiagnosticLevel.WARN,
                f'{100.0 * lost_share:.1f} % of the cycles are lost',
            )
        elif slow > ROUND_TRIP_LIMIT * self._period:
            level = DiagnosticLevel.WARN
            milliseconds = 1e3 * slow
            text = f'round trips up to {milliseconds:.1f} ms: is the port in low-latency mode?'
        return LinkQuality(
            level,
            text,
            self._cycles,
            self._lost,
            lost_share,
            median,
            slow,
            tuple(self._retransmissions),
            age,
            self.robot_resets,
            self.dongle_resets,
            self.sessions,
            self.port_failures,
            host,
            self.malformed,
            self.dongle,
            self.robot,
        )


def _quantile(ordered: list[float], share: float) -> float:
    """Return the quantile ``share`` of sorted values; NaN without values."""
    if not ordered:
        return float('nan')
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]
