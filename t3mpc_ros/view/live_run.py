# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""State of a run that goes on: its data, what its nodes report, and the banner from both."""

from collections.abc import Sequence

from t3mpc_ros.view.banner import Banner, Condition, NodeReport, banner
from t3mpc_ros.view.live_data import STEP, LiveData

ODOMETRY = 'odometry'
"""Stream whose samples show that a robot is connected."""


class LiveRun(LiveData):
    """LiveData of a run in real time; the facts include the banner.

    Time of samples is that of the messages; the connection is judged by the time of their
    arrival, because clocks of other machines differ.
    """

    def __init__(self) -> None:
        super().__init__(step=STEP)
        self._reports: dict[str, NodeReport] = {}
        self._odometry_pending = False
        self._last_odometry: float | None = None
        self._time = 0.0
        self._banner: Banner | None = None

    def add(self, stream: str, time: float, values: Sequence[float]) -> None:
        """Add a sample."""
        super().add(stream, time, values)
        if stream == ODOMETRY:
            self._odometry_pending, self._time = True, time

    def node_report(self, name: str, text: str, condition: Condition) -> None:
        """Replace the newest report of a node."""
        self._reports[name] = NodeReport(text, condition)

    def node_gone(self, name: str) -> None:
        """Discard the report of a node that has left the graph."""
        self._reports.pop(name, None)

    def tick(self, now: float) -> None:
        """Update the banner; call it several times a second.

        Parameters
        ----------
        now
            Time that passes steadily, s.
        """
        if self._odometry_pending:
            self._odometry_pending, self._last_odometry = False, now
        age = None if self._last_odometry is None else now - self._last_odometry
        shown = banner(self._reports, age)
        if shown == self._banner:
            return
        previous, self._banner = self._banner, shown
        self.set('banner', shown._asdict())
        if previous is None or shown.kind == previous.kind == 'lost':
            return
        if shown.kind in ('stopped', 'lost'):
            reason = f': {shown.detail}' if shown.detail else ''
            self.report(self._time, 'stop', f'{shown.headline}{reason}')
        elif previous.kind in ('stopped', 'lost'):
            self.report(self._time, 'note', shown.headline)
