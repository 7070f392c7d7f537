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
"""Detection of node faults in ``/diagnostics``, and the rate limit of automatic snapshots.

Nodes report once per second. A shorter fault is not detected, but its messages are in the bag.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from t3mpc_ros.geometry.types import NANOSECONDS

ERROR_LEVEL = 2
"""``diagnostic_msgs/msg/DiagnosticStatus.ERROR``; STALE is higher."""
WAITING_PREFIX = 'stopped'
"""Beginning of the status message of a node that is not active yet."""
REPORT_TIMEOUT_NS = 5 * NANOSECONDS
"""Time without a report after which a node has failed; nodes report once per second."""


@dataclass(frozen=True, slots=True)
class NodeFault:
    """Beginning of a fault of one node."""

    node: str
    reason: str


class DiagnosticsMonitor:
    """Detects the beginning of faults of the monitored nodes, by their names in the diagnostics.

    A fault begins when a healthy node reports an error (a stopped controller, an emergency stop,
    a lost link) or stops reporting. It ends with the next report below the error level; only then
    can the next fault of that node begin. A node that has not been healthy yet, because it waits
    for another node, has no fault.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = frozenset(names)
        self._healthy: dict[str, int] = {}
        """Time of the last report of each healthy node, steady nanoseconds."""

    def update(self, name: str, level: int, text: str, now_ns: int) -> NodeFault | None:
        """Return the fault that begins with this report, or None."""
        if name not in self._names:
            return None
        if level >= ERROR_LEVEL:
            return NodeFault(name, text) if self._healthy.pop(name, None) is not None else None
        if text.startswith(WAITING_PREFIX):
            self._healthy.pop(name, None)  # the node was restarted
        else:
            self._healthy[name] = now_ns
        return None

    def check_timeouts(self, now_ns: int) -> list[NodeFault]:
        """Return the faults of healthy nodes whose reports have timed out."""
        expired = [
            name for name, last in self._healthy.items() if now_ns - last > REPORT_TIMEOUT_NS
        ]
        for name in expired:
            del self._healthy[name]
        return [NodeFault(name, 'diagnostics timed out') for name in expired]


class SnapshotRateLimiter:
    """Limits the number of automatic snapshots in a run, and the time between two."""

    def __init__(self, min_interval_ns: int, max_count: int) -> None:
        self._min_interval_ns = min_interval_ns
        self._max_count = max_count
        self._count = 0
        self._last_ns: int | None = None

    def acquire(self, now_ns: int) -> str:
        """Return an empty text and count a permitted snapshot, or return why it is rejected."""
        if self._count >= self._max_count:
            return f'there have been {self._count} already (snapshot.max_count)'
        if self._last_ns is not None and now_ns - self._last_ns < self._min_interval_ns:
            ago = (now_ns - self._last_ns) / NANOSECONDS
            return f'the last one was {ago:.1f} s ago (snapshot.min_interval)'
        self._count += 1
        self._last_ns = now_ns
        return ''
