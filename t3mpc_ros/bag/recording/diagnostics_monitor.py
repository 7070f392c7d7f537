# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fault detection from /diagnostics and the rate limit of automatic snapshots."""

from collections.abc import Iterable
from dataclasses import dataclass
import re

from t3mpc_ros.geometry.types import NANOSECONDS

ERROR_LEVEL = 2
"""Level of a fault, ``diagnostic_msgs/msg/DiagnosticStatus.ERROR``; above it only STALE."""
WAITING_PREFIX = 'stopped'
"""How a node of this package begins the report that it has not begun to work."""
REPORT_TIMEOUT_NS = 5 * NANOSECONDS
"""After so long without a report, of which there is one a second, a node is taken for dead."""


@dataclass(frozen=True, slots=True)
class NodeFault:
    """That one node does not work any more, and why."""

    node: str
    reason: str


class DiagnosticsMonitor:
    """Decides which report is the begin of a fault.

    A fault begins when a node that was well reports an error, such as a controller that stops
    the robot, an emergency stop, or a link that is lost; or when it reports no longer. It ends
    with the next report that is none, and only then can another one of that node begin. What has
    never been well, because it still waits for another node, has no fault.

    Parameters
    ----------
    names
        Names in the diagnostics of those to watch.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = frozenset(names)
        self._well: dict[str, int] = {}
        """When each node that is well has reported last, steady nanoseconds."""

    def update(self, name: str, level: int, text: str, now_ns: int) -> NodeFault | None:
        """Return the fault that begins with this report, if one does."""
        if name not in self._names:
            return None
        if level >= ERROR_LEVEL:
            return NodeFault(name, text) if self._well.pop(name, None) is not None else None
        if text.startswith(WAITING_PREFIX):
            self._well.pop(name, None)  # it was started anew
        else:
            self._well[name] = now_ns
        return None

    def silent(self, now_ns: int) -> list[NodeFault]:
        """Return the faults of those that were well and have not reported for a while."""
        gone = [name for name, last in self._well.items() if now_ns - last > REPORT_TIMEOUT_NS]
        for name in gone:
            del self._well[name]
        return [NodeFault(name, 'reports no longer') for name in gone]


class SnapshotRateLimiter:
    """Decides how many snapshots may be taken unasked: a link that comes and goes has no end.

    Parameters
    ----------
    pause_ns
        Shortest time between two.
    most
        Most in one run.
    """

    def __init__(self, pause_ns: int, most: int) -> None:
        self._pause_ns = pause_ns
        self._most = most
        self._count = 0
        self._last_ns: int | None = None

    def acquire(self, now_ns: int) -> str:
        """Return why there is to be no snapshot now; empty, and it is counted, when there is."""
        if self._count >= self._most:
            return f'there have been {self._count} already (snapshot_most)'
        if self._last_ns is not None and now_ns - self._last_ns < self._pause_ns:
            ago = (now_ns - self._last_ns) / NANOSECONDS
            return f'the last one was {ago:.1f} s ago (snapshot_pause)'
        self._count += 1
        self._last_ns = now_ns
        return ''


def snapshot_folder_name(time: str, reason: str) -> str:
    """Return the name of a snapshot's folder: ``time``, and ``reason`` in plain letters."""
    words = re.sub(r'[^a-z0-9]+', '-', reason.lower()).strip('-')[:48].rstrip('-')
    return f'{time}_{words}' if words else time
