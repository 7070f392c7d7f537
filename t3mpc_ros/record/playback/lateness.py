# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How late messages went out, in percentiles, without keeping them all."""

import math

_RATIO = math.log(1.02)
_SMALLEST_NS = 1_000


class Lateness:
    """A histogram of delays whose bins grow by two percent, from one microsecond up."""

    def __init__(self) -> None:
        self._bins: dict[int, int] = {}
        self.count = 0
        self.largest_ns = 0

    def note(self, late_ns: int) -> None:
        """Count one delay; what is not late at all counts as one microsecond."""
        late_ns = max(late_ns, _SMALLEST_NS)
        number = math.ceil(math.log(late_ns / _SMALLEST_NS) / _RATIO)
        self._bins[number] = self._bins.get(number, 0) + 1
        self.count += 1
        self.largest_ns = max(self.largest_ns, late_ns)

    def percentile_ns(self, percent: float) -> int:
        """Return the delay that so many percent do not exceed, within two percent; 0 for none."""
        rank, seen = math.ceil(percent / 100.0 * self.count), 0
        for number in sorted(self._bins.copy()):
            seen += self._bins[number]
            if seen >= max(rank, 1):
                return min(round(_SMALLEST_NS * math.exp(number * _RATIO)), self.largest_ns)
        return 0
