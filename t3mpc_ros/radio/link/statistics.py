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
"""Ten seconds at 50 Hz are looked back on."""
_MIN_CYCLES = 50
"""Cycles below which a share says nothing."""
LOSS_LIMIT = 0.05
"""Share of lost cycles above which the link is worth a warning."""
ROUND_TRIP_LIMIT = 0.5
"""Share of the period above which the slowest round trips are."""
RETRY_COUNTS = 16
"""The radio chip counts to 15."""


class DiagnosticLevel(IntEnum):
    """How bad it is, as diagnostics count."""

    OK = 0
    WARN = 1
    ERROR = 2


class LinkQuality(NamedTuple):
    """The link as it is now; shares and round trips over the last 500 cycles."""

    level: DiagnosticLevel
    text: str
    """Why the level is not OK; empty when it is."""
    cycles: int
    """Since the port was opened first."""
    lost: int
    """Of these."""
    lost_in_a_row: int
    """Up to now."""
    lost_share: float
    """0 to 1; NaN before the first cycle, as the two below."""
    round_trip_median: float
    """s"""
    round_trip_p99: float
    """s"""
    retransmissions: tuple[int, ...]
    """How many exchanges needed 0, 1, … 15 tries more; of both packets, acknowledged or not."""
    age: float
    """s since the last measurement was taken; inf before the first"""
    robot_resets: int
    """Seen since the port was opened first, as the next three."""
    dongle_resets: int
    sessions: int
    """Begun, the first included."""
    port_failures: int
    host: FrameCounts
    """Frames the host has received."""
    malformed: int
    """Good ones by their CRC that made no sense."""
    dongle: Pong | None
    """What the dongle last said of itself."""
    robot: Aux | None
    """What the robot last said of itself."""


class LinkStatistics:
    """Collects what happens on the link, and judges it.

    Parameters
    ----------
    period
        s, from one cycle to the next.
    patience
        s without a measurement after which the link counts as lost: the robot stops by then.
    """

    def __init__(self, period: float, patience: float) -> None:
        self._period = period
        self._patience = patience
        self._recent: deque[float | None] = deque(maxlen=_WINDOW_CYCLES)
        """Round trip of each cycle, None of a lost one."""
        self._retransmissions = [0] * RETRY_COUNTS
        self._cycles = self._lost = self._lost_in_a_row = 0
        self.robot_resets = 0
        self.dongle_resets = 0
        self.sessions = 0
        self.port_failures = 0
        self.malformed = 0
        self.dongle: Pong | None = None
        self.robot: Aux | None = None

    @property
    def lost_in_a_row(self) -> int:
        """Cycles lost up to now."""
        return self._lost_in_a_row

    def add_exchange(self, retransmissions: int) -> None:
        """Count one packet that went on the air."""
        self._retransmissions[retransmissions] += 1

    def add_cycle(self, round_trip: float | None) -> None:
        """Count a cycle that took ``round_trip`` seconds; None: lost."""
        self._cycles += 1
        self._recent.append(round_trip)
        if round_trip is None:
            self._lost += 1
            self._lost_in_a_row += 1
        else:
            self._lost_in_a_row = 0

    def quality(self, age: float, host: FrameCounts) -> LinkQuality:
        """Return the link as it is, ``age`` seconds after the last measurement was taken."""
        trips = sorted(trip for trip in self._recent if trip is not None)
        recent = len(self._recent)
        lost_share = (recent - len(trips)) / recent if recent else float('nan')
        median, slow = _quantile(trips, 0.5), _quantile(trips, 0.99)
        level, text = DiagnosticLevel.OK, ''
        if age > self._patience:
            level, text = DiagnosticLevel.ERROR, f'no word of the robot for {age:.2f} s'
        elif recent < _MIN_CYCLES:
            pass
        elif lost_share > LOSS_LIMIT:
            level, text = (
                DiagnosticLevel.WARN,
                f'{100.0 * lost_share:.1f} % of the cycles are lost',
            )
        elif slow > ROUND_TRIP_LIMIT * self._period:
            level = DiagnosticLevel.WARN
            text = f'round trips take up to {1e3 * slow:.1f} ms: serial port not at low latency?'
        return LinkQuality(
            level,
            text,
            self._cycles,
            self._lost,
            self._lost_in_a_row,
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
    """Return the value that ``share`` of the others do not exceed; NaN of none."""
    if not ordered:
        return float('nan')
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]
