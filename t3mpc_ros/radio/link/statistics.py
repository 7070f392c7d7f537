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
"""Link statistics: lost cycles by the hop that lost them, retransmissions, round trips, counters.

A cycle is one CMD with its POLL. It counts as lost when its own state did not return; the robot
may or may not have received the command. The reply of the dongle tells the hop: none, one without
an acknowledgement, or one without a new state.
"""

from collections import deque
from collections.abc import Mapping
from enum import Enum, IntEnum
from typing import NamedTuple

from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.protocol.frames import Aux, Pong
from t3mpc_ros.radio.protocol.framing import FrameCounts

_WINDOW_CYCLES = 500  # window of the statistics: ten seconds at 50 Hz
_MIN_CYCLES = 50  # minimum number of cycles for a judgement
LOSS_LIMIT = 0.05  # loss rate above which the level is WARN
ROUND_TRIP_LIMIT = 0.5  # fraction of the period above which slow round trips cause WARN
_WRAP = 1 << 16
RETRY_COUNTS = 16  # number of retransmission counts: the radio chip counts to 15


class DiagnosticLevel(IntEnum):
    """Level of a diagnostic status."""

    OK = 0
    WARN = 1
    ERROR = 2


class Loss(Enum):
    """Where a cycle was lost."""

    NO_REPLY = 'no reply'
    """Between host and dongle: the cable damaged a frame, or the dongle did not answer."""
    RADIO = 'radio'  # a packet was not acknowledged
    ROBOT = 'robot'  # all packets were acknowledged, but no new state came with them


class CableErrors(NamedTuple):
    """Damaged frames and lost bytes on the serial line, since the port was first opened."""

    host: int = 0  # counted by the host: frames from the dongle
    dongle: int = 0  # counted by the dongle: frames to it


class LinkQuality(NamedTuple):
    """Quality of the link; loss rate and round trips over the last 500 cycles."""

    level: DiagnosticLevel
    text: str  # reason of the level; empty for OK
    cycles: int  # since the port was first opened
    lost: int  # lost cycles since then
    losses: Mapping[Loss, int]  # lost cycles by hop
    cable_errors: CableErrors
    lost_share: float  # 0 to 1; NaN before the first cycle, like the next two
    round_trip_median: float  # s
    round_trip_p99: float  # s
    retransmissions: tuple[int, ...]
    """Number of packets with 0, 1, … 15 retransmissions, acknowledged or not."""
    age: float  # time since the last telemetry, s; inf before the first
    robot_resets: int  # since the port was first opened, like the next three
    dongle_resets: int
    sessions: int  # started, including the first
    collisions: int  # number of answers that showed a second robot with the same address
    port_failures: int
    host: FrameCounts  # frames received by the host
    malformed: int  # frames with valid CRC and invalid content
    dongle: Pong | None  # last PONG of the dongle
    robot: Aux | None  # last AUX of the robot


class LinkStatistics:
    """Collects the events of the link and computes its quality.

    ``period`` of the cycles in s; above the age ``timeout`` (s) of the telemetry the level is
    ERROR: the robot has stopped by then.
    """

    def __init__(self, period: float, timeout: float) -> None:
        self._period = period
        self._timeout = timeout
        self._recent: deque[tuple[float | Loss, CableErrors]] = deque(maxlen=_WINDOW_CYCLES)
        """Round trip of each cycle or where it was lost, and the errors counted by then."""
        self._losses = dict.fromkeys(Loss, 0)
        self._cable_errors = CableErrors()
        self._retransmissions = [0] * RETRY_COUNTS
        self._cycles = 0
        self.robot_resets = self.dongle_resets = self.sessions = 0
        self.collisions = self.port_failures = self.malformed = 0
        self.dongle: Pong | None = None
        self.robot: Aux | None = None

    def add_exchange(self, retransmissions: int) -> None:
        """Count one transmitted packet."""
        self._retransmissions[retransmissions] += 1

    def add_cycle(self, outcome: float | Loss) -> None:
        """Count a cycle with its round trip (s), or where it was lost."""
        self._cycles += 1
        self._recent.append((outcome, self._cable_errors))
        if isinstance(outcome, Loss):
            self._losses[outcome] += 1

    def add_pong(self, pong: Pong, restarted: bool) -> None:
        """Take the counters of the dongle, which start at 0 when it does."""
        before, self.dongle = self.dongle, pong
        new = 0
        for name in ('crc_errors', 'frame_errors', 'overruns'):
            earlier = 0 if before is None or restarted else getattr(before, name)
            new += (getattr(pong, name) - earlier) % _WRAP
        self._cable_errors = self._cable_errors._replace(dongle=self._cable_errors.dongle + new)

    def count_host_errors(self, counts: FrameCounts) -> None:
        """Take the counters of the host."""
        self._cable_errors = self._cable_errors._replace(
            host=counts.crc_errors + counts.frame_errors
        )

    def worst_hop(self) -> str:
        """Return the text for the hop that lost most of the recent cycles; empty without any."""
        lost = [outcome for outcome, _ in self._recent if isinstance(outcome, Loss)]
        if not lost:
            return ''
        worst = max(Loss, key=lost.count)
        before, after = self._recent[0][1], self._recent[-1][1]
        errors = after.host - before.host, after.dongle - before.dongle
        return reasons.lost_cycles(worst.value, *errors)

    def explain_losses(self) -> None:
        """Leave the cycles lost so far out of the judgement: their cause is known."""
        kept = [each for each in self._recent if not isinstance(each[0], Loss)]
        self._recent.clear()
        self._recent.extend(kept)

    def lost_before_radio(self) -> bool:
        """Return whether most cycles since the last state were lost before the radio."""
        unanswered = 0
        for outcome, _ in reversed(self._recent):
            if not isinstance(outcome, Loss):
                break
            unanswered += 1 if outcome is Loss.NO_REPLY else -1
        return unanswered > 0

    def quality(self, age: float, host: FrameCounts) -> LinkQuality:
        """Return the quality of the link at telemetry age ``age`` (s)."""
        trips = sorted(trip for trip, _ in self._recent if not isinstance(trip, Loss))
        recent = len(self._recent)
        lost_share = (recent - len(trips)) / recent if recent else float('nan')
        median, slow = _quantile(trips, 0.5), _quantile(trips, 0.99)
        level, text = DiagnosticLevel.OK, ''
        if age > self._timeout:
            level, text = DiagnosticLevel.ERROR, f'no telemetry for {age:.2f} s'
        elif recent < _MIN_CYCLES:
            pass
        elif lost_share > LOSS_LIMIT:
            level = DiagnosticLevel.WARN
            text = f'{100.0 * lost_share:.1f} % of the cycles are lost {self.worst_hop()}'
        elif slow > ROUND_TRIP_LIMIT * self._period:
            level = DiagnosticLevel.WARN
            text = f'round trips up to {1e3 * slow:.1f} ms: is the port in low-latency mode?'
        return LinkQuality(
            level,
            text,
            self._cycles,
            sum(self._losses.values()),
            dict(self._losses),
            self._cable_errors,
            lost_share,
            median,
            slow,
            tuple(self._retransmissions),
            age,
            self.robot_resets,
            self.dongle_resets,
            self.sessions,
            self.collisions,
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
