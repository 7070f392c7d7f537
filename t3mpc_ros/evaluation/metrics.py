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
"""Metrics of a simulated run: a name, a unit, and a function of the run; smaller is better."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.counted_time import counted_from
from t3mpc_ros.evaluation.record import Record
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.geometry.kinematics import twist_from_wheels
from t3mpc_ros.geometry.types import Array, WheelSpeeds

Rows = NDArray[np.bool_]

AFTER = 2.0
"""Time after faults before the error after them counts, s."""


class MeasuredRun:
    """A run that went to its end, and which of its rows count."""

    def __init__(self, scenario: Scenario, record: Record) -> None:
        self.scenario, self.record = scenario, record
        start = counted_from(0.0, float(record.time[-1]) - record.start)
        self.start = record.start + start
        """From when on rows count, s."""
        self.counted = record.counted(start)
        """Rows that count, with the switches that the run contains whole."""
        self.settled = record.counted(start, scenario.kind.settling)
        """Those away from the switches."""

    @property
    def yaw_rate_error(self) -> Array | None:
        """Yaw rate of the body less that of the reference, rad/s; None without a body."""
        if 'twist' not in self.record.columns:
            return None
        right, left = self.record.reference.T
        geometry = self.scenario.true_robot().geometry
        per_difference = twist_from_wheels(WheelSpeeds(1.0, 0.0), geometry).angular
        error: Array = self.record['twist'][:, 1] - per_difference * (right - left)
        return error

    def drift(self) -> float | None:
        """Return the difference of the angles turned, rad."""
        rate = self.yaw_rate_error
        if rate is None:
            return None
        turned = 0.5 * (rate[1:] + rate[:-1]) * np.diff(self.record.time)
        return abs(float(np.sum(turned[self.counted[1:]])))

    def stopped(self) -> float | None:
        """Return the time in which robot or driver stop, s; None without a body."""
        if 'twist' not in self.record.columns:
            return None
        share = float(np.mean(self.record.stopped[self.counted]))
        return share * (float(self.record.time[-1]) - self.start)

    def rms_yaw_rate(self, rows: Rows) -> float | None:
        """Return the root mean square of :attr:`yaw_rate_error` over rows."""
        rate = self.yaw_rate_error
        return None if rate is None else rms(rate[rows])

    def rms_part(self, part: int) -> float | None:
        """Return the settled error before, during or after what does not last for the run."""
        if not (span := self.scenario.fault_span):
            return None
        time, (begin, end) = self.record.time, span
        parts = time < begin, (time >= begin) & (time < end), time >= end + AFTER
        rows = self.settled & parts[part]
        return rms(self.record.error[rows]) if rows.any() else None


@dataclass(frozen=True, slots=True)
class Metric:
    """One number of a run."""

    name: str
    heading: str
    unit: str
    digits: int
    value: Callable[[MeasuredRun], float | None]
    """None where a run has no such number."""


SETTLED = Metric('settled', 'settled', 'rad/s', 4, lambda run: rms(run.record.error[run.settled]))
OVERALL = Metric(
    'overall', 'with switches', 'rad/s', 4, lambda run: rms(run.record.error[run.counted])
)
VARIATION = Metric(
    'variation', 'variation', 'rad/s³', 1, lambda run: run.record.variation(run.counted)
)
YAW_RATE_SETTLED = Metric(
    'yaw_rate_settled', 'yaw rate settled', 'rad/s', 4, lambda run: run.rms_yaw_rate(run.settled)
)
YAW_RATE = Metric('yaw_rate', 'yaw rate', 'rad/s', 4, lambda run: run.rms_yaw_rate(run.counted))
DRIFT = Metric('drift', 'yaw drift', 'rad', 3, MeasuredRun.drift)
STOPPED = Metric('stopped', 'stopped', 's', 2, MeasuredRun.stopped)
BEFORE = Metric('before', 'settled before', 'rad/s', 4, lambda run: run.rms_part(0))
DURING = Metric('during', 'settled during', 'rad/s', 4, lambda run: run.rms_part(1))
RECOVERED = Metric('after', 'settled after', 'rad/s', 4, lambda run: run.rms_part(2))
METRICS = (
    SETTLED,
    OVERALL,
    VARIATION,
    YAW_RATE_SETTLED,
    YAW_RATE,
    DRIFT,
    STOPPED,
    BEFORE,
    DURING,
    RECOVERED,
)
"""All metrics; a run without one leaves it out."""
Numbers = Mapping[str, float]
"""Metrics of a run by name; NaN where the run diverged."""


def measure(scenario: Scenario, record: Record) -> Numbers:
    """Return the metrics of a run; NaN for each that it would have, where the run diverged."""
    run = MeasuredRun(scenario, record)
    with np.errstate(invalid='ignore', over='ignore'):
        found = {metric.name: metric.value(run) for metric in METRICS}
    known = {name: value for name, value in found.items() if value is not None}
    return known if record.finite else dict.fromkeys(known, math.nan)
