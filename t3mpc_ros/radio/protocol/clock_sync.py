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
_MICROSECOND = 1000  # ns
_WINDOW_NS = 10 * NANOSECONDS
_MAX_SKEW = 0.02
# Weight (s²) of the prior skew 0 against the measured samples: standard deviation of a sample
# (0.2 ms) over that of resonators (0.5 %), squared. Negligible after a third of a second.
_SKEW_PRIOR_WEIGHT = (0.2e-3 / 0.005) ** 2

BYTE_NS = 20 * _MICROSECOND  # duration of one byte on the serial line at 500 000 baud, ns


def forward_delay_ns(wire_bytes: int, payload_bytes: int) -> int:
    """Return the delay (ns) of a CMD from its first byte written to its reception by the robot.

    Sum of its bytes on the line, twice 130 us of radio settling and transfer, and the air time at
    1 Mbit/s: preamble 1, address 5, control 9 bit, CRC 2 (nRF24L01+ data sheet 1.0).
    """
    air_us = (1 + 5 + payload_bytes + 2) * 8 + 9
    return wire_bytes * BYTE_NS + (130 + 130 + air_us) * _MICROSECOND


class CounterUnwrapper:
    """Unwraps a 32-bit counter whose consecutive values differ by less than 2**31."""

    def __init__(self) -> None:
        self._last: int | None = None
        self.total = 0  # sum of all differences since the first value

    def add(self, value: int) -> int:
        """Return the total at the counter value ``value`` (signed or unsigned)."""
        if self._last is None:
            self._last = value
            return self.total
        self.total += wrapped_difference(self._last, value)
        self._last = value
        return self.total

    def rebase(self) -> None:
        """Keep the total; the next value is the new origin of the counter."""
        self._last = None


def wrapped_difference(before: int, after: int) -> int:
    """Return the difference of two 32-bit counter values, modulo 2**32, in [-2**31, 2**31)."""
    return (after - before + (_WRAP >> 1)) % _WRAP - (_WRAP >> 1)


class ClockModel:
    """Maps robot time (unwrapped us) to host time: a line through the fast half of ten seconds."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int, int]] = deque()
        """Robot time (us), earliest possible host time (ns), round trip (ns)."""
        self.reset()

    def reset(self) -> None:
        """Drop all samples, after a restart of the robot."""
        self._samples.clear()
        self._origin_us = 0
        self._origin_ns = 0
        self.skew = 0.0  # relative excess of a robot second over a host second; 0 without samples

    @property
    def is_set(self) -> bool:
        """Whether at least one sample is available."""
        return bool(self._samples)

    def add(self, robot_us: int, sent_ns: int, returned_ns: int, travel_ns: int) -> None:
        """Add a transaction whose first packet had no retransmission.

        ``robot_us`` is the reception of the CMD by the robot clock, ``travel_ns`` the
        minimum delay to the robot: :func:`forward_delay_ns`.
        """
        samples = self._samples
        samples.append((robot_us, sent_ns + travel_ns, returned_ns - sent_ns))
        while samples[-1][1] - samples[0][1] > _WINDOW_NS:
            samples.popleft()
        self._fit()

    def to_host_ns(self, robot_us: int) -> int:
        """Return the host time (ns) of a robot time."""
        if not self._samples:
            raise ValueError('clock model must have at least one transaction: got none')
        since = (robot_us - self._origin_us) * _MICROSECOND
        return self._origin_ns + since + round(self.skew * since)

    def _fit(self) -> None:
        last_us, last_ns, _ = self._samples[-1]
        # Differences to the newest sample are exact as floats.
        table = np.array(self._samples, dtype=np.int64) - (last_us, last_ns, 0)
        robot, host, trip = table[:, 0] * _MICROSECOND, table[:, 1], table[:, 2]
        fast = trip <= np.median(trip)
        # The excess over the shortest round trip arose on the way there or back: assigning half to
        # each way is wrong by at most half of it, and by zero on average.
        excess = 0.5 * (trip[fast] - trip.min())
        x = robot[fast] / NANOSECONDS
        y = (host[fast] - robot[fast] + excess) / NANOSECONDS
        x_mean, y_mean = float(x.mean()), float(y.mean())
        x -= x_mean
        skew = float(x @ (y - y_mean)) / (float(x @ x) + _SKEW_PRIOR_WEIGHT)
        self.skew = min(max(skew, -_MAX_SKEW), _MAX_SKEW)
        self._origin_us = last_us
        self._origin_ns = last_ns + round((y_mean - self.skew * x_mean) * NANOSECONDS)
