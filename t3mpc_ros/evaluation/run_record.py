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
"""Record of a run: columns over one time axis, which rows of it count, and its metrics.

Which rows count, and which of them are *settled*, has one definition, here, for simulated runs and
for those in bags; see docs/metrics.md.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheel_speeds
from t3mpc_ros.geometry.types import NANOSECONDS, Array, WheelSpeeds
from t3mpc_ros.robot.interface import RobotStatus

RATE = 100.0
"""Control periods a second in every run."""
ON_PATH = 0.05
"""Largest distance from its reference of a robot that is on its path, m."""
STATUS_FLAGS = RobotStatus._fields
"""Meaning of the column ``flags``."""

START = 3.0
"""Time of control at the start that no metric counts, s: the reference grows from zero. Of a run
of less than twice this time, its first half."""
CROSSING = (0.5, 0.5)
"""Time before and after a switch within which methods cross from one reference to the other, s."""


class SettlingWindow(NamedTuple):
    """Time about a switch in which a robot is not settled, s."""

    before: float
    """With preview it leaves the old reference so much earlier."""
    after: float


EVERYTHING = SettlingWindow(0.0, 0.0)
"""No window: what happens at switches counts."""
PLANT_WINDOW = SettlingWindow(0.4, 0.6)
"""Of the paper's plant, whose wheels do not ring."""
ROBOT_WINDOW = SettlingWindow(0.5, 1.0)
"""Of every robot with a body: the twin, a real one, and any in a bag."""

COLUMNS: Mapping[str, tuple[str, str]] = {
    'time': ('s', 'since the robot was switched on'),
    'reference': ('rad/s', 'reference of the wheels, right first'),
    'mode': ('', 'active switching mode of the reference'),
    'measured': ('rad/s', 'measured wheel speeds, with noise'),
    'speeds': ('rad/s', 'true wheel speeds chi; on the twin those of its rotors'),
    'commanded': ('rad/s', 'command after the limits of the robot, at the end of the last period'),
    'sent': ('rad/s or N m', 'command to the robot; torques with a torque drive'),
    'odometry': ('m, m, rad', 'pose of the odometry'),
    'truth': ('m, m, rad', 'true pose'),
    'twist': ('m/s, rad/s', 'true twist of the body'),
    'lost_steps': ('', 'full steps that each rotor is behind its field'),
    'contact_force': ('N', 'largest force of a contact so far'),
    'flags': ('', f'status flags of the robot: {", ".join(STATUS_FLAGS)}'),
    'ranges': ('m', 'range readings, as in RobotState.ranges'),
    'estimated': ('rad/s', 'estimated chi'),
    'unexplained': ('rad/s²', "estimated acceleration that chi' = u does not explain"),
    'acceleration': ('rad/s²', 'u as the limits of the drive let it through'),
    'limited': ('', 'whether a limit changed u'),
    'terms': ('rad/s²', f'terms of u: {", ".join(TERM_NAMES)}; zeros for a method without them'),
    'reference_pose': ('m, m, rad', 'pose of a reference that is a path'),
    'reference_twist': ('m/s, rad/s', 'its twist'),
    'pose': ('m, m, rad', 'pose that the controller received'),
    'command': ('m/s, rad/s', 'twist that the controller commanded'),
    'localized': ('', 'whether the localisation knows the place'),
    'activity': ('', 'what the keep-out does, an index into its activities'),
    'avoiding': ('', 'whether the keep-out changed the command, or the robot is on its way back'),
}
"""Every column: unit, and meaning. A run has those that its robot and its driver can know."""


@dataclass(frozen=True)
class Record:
    """Record of one run, one row per control period; wheels are right first.

    Row k holds what was known and decided at ``time[k]``, and the state of the robot then. From a
    row on at which the driver answered with a number that is not finite, or the robot has such a
    speed, all numbers are NaN but time, reference and mode: the run ended there.
    """

    columns: Mapping[str, NDArray[np.generic]]
    """One array each, the first dimension is time; see :data:`COLUMNS`."""
    drive: str = 'velocity'
    """Meaning of the command: ``velocity`` or ``torque``."""
    start: float = 0.0
    """When the robot may first move, s."""
    switches: Array = field(default_factory=lambda: np.zeros(0))
    """Instants of the switches, also of those after the end that preview reaches, s."""
    robot_reasons: Sequence[str] = ()
    """Of each row why the robot does not follow commands; empty where it does."""
    driver_reasons: Sequence[str] = ()
    """Of each row why the driver stops the robot; empty where it drives."""
    settling: tuple[float, float] = ROBOT_WINDOW
    """Time before and after each switch that the settled errors leave out, s."""
    fault_span: tuple[float, float] | None = None
    """Begin and end (s) of what does not last for the whole run; None without."""
    geometry: WheelGeometry = WheelGeometry()
    """Wheels by which the reference turns the body."""

    def __getitem__(self, name: str) -> Array:
        """Return a column."""
        if name not in self.columns:
            raise KeyError(f'this run has no column {name}: it has {", ".join(self.columns)}')
        found: Array = self.columns[name]  # type: ignore[assignment]
        return found

    def __len__(self) -> int:
        return len(self.columns['time'])

    @property
    def time(self) -> Array:
        """Time since the robot was switched on, s, shape (n,)."""
        return self['time']

    @property
    def reference(self) -> Array:
        """Reference wheel speeds, rad/s, shape (n, 2)."""
        return self['reference']

    @property
    def speeds(self) -> Array:
        """True wheel speeds, rad/s, shape (n, 2)."""
        return self['speeds']

    @property
    def error(self) -> Array:
        """True tracking error chi - r, rad/s, shape (n, 2)."""
        return self.speeds - self.reference

    @property
    def effort(self) -> Array:
        """Acceleration asked of the robot, rad/s², shape (n, 2).

        u with a torque drive; with a velocity drive the rate of change of the commanded speeds.
        """
        if self.drive == 'torque':
            return self['acceleration']
        return np.diff(self['sent'], axis=0, prepend=0.0) / (1.0 / RATE)

    @property
    def finite(self) -> bool:
        """Whether the run went to its end: it did not diverge."""
        return bool(np.isfinite(self.speeds).all() and np.isfinite(self['sent']).all())

    @property
    def stopped(self) -> NDArray[np.bool_]:
        """Rows in which robot or driver have a reason not to move, shape (n,)."""
        both = zip(self.robot_reasons, self.driver_reasons, strict=True)
        return np.array([bool(robot or driver) for robot, driver in both])

    def flag(self, name: str) -> NDArray[np.bool_]:
        """Return one status flag of the robot, a name of :data:`STATUS_FLAGS`, shape (n,)."""
        return self['flags'][:, STATUS_FLAGS.index(name)].astype(np.bool_)

    def rows(self, begin: float, end: float) -> slice:
        """Return the rows from ``begin`` up to, and without, ``end`` (s)."""
        first, last = np.searchsorted(self.time, (begin - 1e-6, end - 1e-6)).tolist()
        return slice(first, last)

    def counted(
        self, after: float = START, margins: tuple[float, float] = EVERYTHING
    ) -> NDArray[np.bool_]:
        """Return which rows count, from ``after`` s of control on.

        ``margins`` (s) about a switch do not, see :func:`counted_rows`. ValueError if none counts.
        """
        return some_rows(self.time, self.switches, self.start + after, margins)

    def rmse(self, after: float = START, *, margins: tuple[float, float] = EVERYTHING) -> float:
        """Return the tracking RMSE over both wheels, rad/s; NaN when the run diverged."""
        return rms(self.error[self.counted(after, margins)])

    def largest_error(self, after: float = START) -> float:
        """Return the largest tracking error of a wheel from ``after`` (s) on, rad/s."""
        return float(np.max(np.abs(self.error[self.counted(after)])))

    def variation(self, rows: NDArray[np.bool_] | None = None) -> float:
        """Return the total variation of the effort per second and wheel over rows, rad/s³."""
        if len(self) < 2:
            raise ValueError(f'a record must have at least 2 rows: got {len(self)}')
        counted = slice(None) if rows is None else rows
        time, effort = self.time[counted], self.effort[counted]
        return float(np.abs(np.diff(effort, axis=0)).sum() / (2.0 * (time[-1] - time[0])))


def stamp_of(k: int) -> int:
    """Return the instant at which period k begins, ns."""
    return round(k * NANOSECONDS / RATE)


def counted_from(begin: float, end: float) -> float:
    """Return from when on samples count in a run that is controlled from begin to end, s."""
    return begin + min(START, 0.5 * (end - begin))


def counted_rows(
    time: Array,
    switches: Array,
    after: float,
    end: float,
    window: tuple[float, float] = EVERYTHING,
) -> NDArray[np.bool_]:
    """Return which samples count: from ``after`` to ``end``, outside ``window`` about switches.

    All in s. With the :class:`SettlingWindow` of the robot these are the *settled* samples. Those
    from a switch on whose crossing the run does not contain whole never count, nor those before it
    in which preview leaves the old reference: what that costs would count, and not what it gains.
    """
    rows: NDArray[np.bool_] = (time >= after) & (time <= end)
    before, behind = window
    leaving, crossed = CROSSING
    for switch in switches.tolist():
        rows &= (time < switch - before) | (time >= switch + behind)
        if switch + crossed > end:
            rows &= time < switch - leaving
    return rows


def some_rows(
    time: Array, switches: Array, after: float, margins: tuple[float, float] = EVERYTHING
) -> NDArray[np.bool_]:
    """Return which rows of a run count, up to its end; ValueError if there is none."""
    end = float(time[-1]) if time.size else 0.0
    counted = counted_rows(time, switches, after, end, margins)
    if not counted.any():
        raise ValueError(
            f'after and margins must leave rows of a run that ends at {end:g} s: '
            f'got {after:g} s, {margins[0]:g} s and {margins[1]:g} s'
        )
    return counted


def spans_of(rows: NDArray[np.bool_]) -> list[slice]:
    """Return the stretches of rows that are true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]])))
    return [slice(*each) for each in edges.reshape(-1, 2).tolist()]


def switch_times(time: Array, modes: NDArray[np.generic]) -> Array:
    """Return the instants (s) of the first row of each new mode."""
    instants: Array = time[1:][modes[1:] != modes[:-1]]
    return instants


def rolling_speeds(record: Record, geometry: WheelGeometry) -> Array:
    """Return the speeds of wheels that roll without slip under the true motion, shape (n, 2)."""
    linear, angular = record['twist'].T
    lengths = geometry.wheel_radius, geometry.half_separation
    return np.column_stack(wheel_speeds(linear, angular, *lengths))


def broken_off(record: Record, row: int, rows: int) -> Record:
    """Return a record of ``rows`` rows that ended at ``row``: from there all numbers are NaN."""
    columns: dict[str, NDArray[np.generic]] = {}
    for name, values in record.columns.items():
        filler = np.zeros if values.dtype == np.bool_ else partial(np.full, fill_value=math.nan)
        missing = filler((rows - row, *values.shape[1:]))
        columns[name] = np.concatenate([values[:row], missing]).astype(missing.dtype)
    columns['time'] = np.arange(rows) / RATE
    silent = ('',) * (rows - row)
    return replace(
        record,
        columns=columns,
        robot_reasons=(*record.robot_reasons[:row], *silent),
        driver_reasons=(*record.driver_reasons[:row], *silent),
    )


# -- metrics --------------------------------------------------------------------------------------

AFTER = 2.0
"""Time after faults before the error after them counts, s."""


class MeasuredRun:
    """A run that went to its end, and which of its rows count."""

    def __init__(self, record: Record) -> None:
        self.record = record
        start = counted_from(0.0, float(record.time[-1]) - record.start)
        self.start = record.start + start
        """From when on rows count, s."""
        self.counted = record.counted(start)
        """Rows that count, with the switches that the run contains whole."""
        self.settled = record.counted(start, record.settling)
        """Those away from the switches."""

    @property
    def yaw_rate_error(self) -> Array | None:
        """Yaw rate of the body less that of the reference, rad/s; None without a body."""
        if 'twist' not in self.record.columns:
            return None
        right, left = self.record.reference.T
        per_difference = twist_from_wheels(WheelSpeeds(1.0, 0.0), self.record.geometry).angular
        error: Array = self.record['twist'][:, 1] - per_difference * (right - left)
        return error

    def drift(self) -> float | None:
        """Return the difference of the angles turned, rad."""
        if (rate := self.yaw_rate_error) is None:
            return None
        turned = 0.5 * (rate[1:] + rate[:-1]) * np.diff(self.record.time)
        return abs(float(np.sum(turned[self.counted[1:]])))

    def stopped(self) -> float | None:
        """Return the time in which robot or driver stop, s; None without a body."""
        if 'twist' not in self.record.columns:
            return None
        share = float(np.mean(self.record.stopped[self.counted]))
        return share * (float(self.record.time[-1]) - self.start)

    def rms_yaw_rate(self, rows: NDArray[np.bool_]) -> float | None:
        """Return the root mean square of :attr:`yaw_rate_error` over rows."""
        rate = self.yaw_rate_error
        return None if rate is None else rms(rate[rows])

    def rms_part(self, part: int) -> float | None:
        """Return the settled error before, during or after what does not last for the run."""
        if not (span := self.record.fault_span):
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


def measure(record: Record) -> Numbers:
    """Return the metrics of a run; NaN for each that it would have, where the run diverged."""
    run = MeasuredRun(record)
    with np.errstate(invalid='ignore', over='ignore'):
        found = {metric.name: metric.value(run) for metric in METRICS}
    known = {name: value for name, value in found.items() if value is not None}
    return known if record.finite else dict.fromkeys(known, math.nan)
