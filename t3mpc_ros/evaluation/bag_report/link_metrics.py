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
"""Metrics of a radio link over a recorded run: shares of lost cycles, counters, round trips."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array

SHARES = ('lost_share', 'round_trip_median_ms', 'round_trip_p99_ms', 'telemetry_age_s')
"""Keys of gauges, see ``radio_bridge``."""
COUNTED = {
    'cycles': 'cycles',
    'cycles_lost': 'cycles lost',
    'robot_resets': 'resets of the robot board',
    'dongle_resets': 'resets of the dongle',
    'port_failures': 'port failures',
    'sessions': 'sessions begun after the first report',
    'crc_errors': 'wrong checksums',
    'frame_errors': 'malformed frames',
}
"""Counters that a report shows, with their names."""
COUNTERS = (*COUNTED, 'commands', 'commands_refused')
"""Keys of counters, which only grow."""
LINK_KEYS = ('cycles', 'cycles_lost', 'lost_share', 'round_trip_median_ms', 'round_trip_p99_ms')
"""A status with at least two of these keys describes a link."""


@dataclass(frozen=True)
class LinkHistory:
    """Metrics of one link over time."""

    name: str
    time: Array
    """Receive time, s."""
    values: Mapping[str, Array]
    """Arrays by key, NaN where a value is missing; keys of :data:`SHARES` and :data:`COUNTERS`."""

    def answered(self) -> Array:
        """Return the share of answered cycles since the previous report, shape (n,)."""
        cycles, lost = self.values.get('cycles'), self.values.get('cycles_lost')
        if cycles is None or lost is None:
            share = self.values.get('lost_share')
            return np.full(self.time.size, math.nan) if share is None else 1.0 - share
        made, failed = (np.diff(table, prepend=math.nan) for table in (cycles, lost))
        with np.errstate(invalid='ignore', divide='ignore'):
            known = (made > 0.0) & (failed >= 0.0) & (np.diff(self._starts(), prepend=0) == 0)
            return np.where(known, 1.0 - failed / made, math.nan)

    def grown(self, key: str) -> float:
        """Return the increase of a counter in the recording, over restarts; NaN if unknown."""
        table = self.values.get(key)
        if table is None or not np.isfinite(table).any():
            return math.nan
        rows = np.flatnonzero(np.isfinite(table))
        known = table[rows]
        restarted = np.diff(self._starts()[rows]) > 0
        return float(np.where(restarted, known[1:], np.diff(known)).sum())

    def _starts(self) -> NDArray[np.intp]:
        """Return how often the bridge was started anew up to each report, shape (n,).

        All its counters begin at zero then. The one that falls tells it of those that do not.
        """
        fell = np.zeros(self.time.size, dtype=bool)
        for table in (self.values[key] for key in COUNTERS if key in self.values):
            rows = np.flatnonzero(np.isfinite(table))
            fell[rows[1:]] |= np.diff(table[rows]) < 0.0
        return np.cumsum(fell)


@dataclass(frozen=True)
class LinkMetrics:
    """Quality of a link over a recording; NaN where it is unknown."""

    counts: Mapping[str, float]
    """Increase of each of :data:`COUNTED` over the recording."""
    answered: float
    """Share of the cycles."""
    round_trip: float
    """Median over the reports of the median round trip, s."""
    round_trip_99: float
    """Largest reported 99th percentile, s."""
    oldest: float
    """Largest reported age of the last measurement, s."""


def link_metrics(link: LinkHistory) -> LinkMetrics:
    """Return the summary of a link."""
    counts = {key: link.grown(key) for key in COUNTED}
    answered = _over(np.nanmean, link.answered())
    if counts['cycles'] > 0.0 and math.isfinite(counts['cycles_lost']):
        answered = 1.0 - counts['cycles_lost'] / counts['cycles']
    empty = np.full(1, math.nan)
    return LinkMetrics(
        counts,
        answered,
        1e-3 * _over(np.nanmedian, link.values.get('round_trip_median_ms', empty)),
        1e-3 * _over(np.nanmax, link.values.get('round_trip_p99_ms', empty)),
        _over(np.nanmax, link.values.get('telemetry_age_s', empty)),
    )


def _over(measure: Callable[[Array], Any], values: Array) -> float:
    return float(measure(values)) if np.isfinite(values).any() else math.nan
