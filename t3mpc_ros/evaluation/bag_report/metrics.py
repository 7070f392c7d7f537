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
"""Metrics of a recorded run: tracking errors, chatter, latencies."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.evaluation.bag_report import tracking_errors
from t3mpc_ros.evaluation.bag_report.diagnostic_history import LinkHistory
from t3mpc_ros.evaluation.bag_report.incidents import (
    Incidents,
    find_incidents,
    prompted_commands,
)
from t3mpc_ros.evaluation.bag_report.motion_continuity import gaps
from t3mpc_ros.evaluation.bag_report.recorded_run import SIGNAL_NAMES, Run, Series
from t3mpc_ros.evaluation.bag_report.verdict import Verdict, judge
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.drive_response import ResponseFit, fit_response
from t3mpc_ros.evaluation.result_output import format_number
from t3mpc_ros.evaluation.run_record import ON_PATH
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.types import Array

WINDOW = 0.2
"""Width (s) over which the target of the estimate is smoothed."""


def variation(series: Series, name: str) -> float:
    """Return the total variation per second of one quantity (chatter), gaps left out."""
    if len(series) < 2:
        return math.nan
    steps = np.diff(series.time)
    counted = ~np.isin(series.time[:-1], [low for low, _ in gaps(series.time)])
    return float(np.abs(np.diff(series[name]))[counted].sum() / steps[counted].sum())


def latencies(run: Run, *, first: bool = False) -> Series | None:
    """Return the delays of :func:`prompted_commands`, s."""
    odometry, commands = run.receipts.get(ODOMETRY), run.receipts.get(COMMAND)
    if odometry is None or commands is None or ODOMETRY in run.untrusted:
        return None
    asked, sent = prompted_commands(odometry, commands, first=first)
    return Series(sent, {'value': sent - asked}) if sent.size else None


def estimation_target(run: Run, wheel: str) -> Series | None:
    r"""Return the target of the estimate g of one wheel: :math:`\dot\chi - u` (64), rad/s².

    The derivative is the slope of a straight line fitted to :data:`WINDOW` seconds of the
    measured wheel speed; the applied u is averaged with the weights that this slope has on the
    derivative, so that both see the same smoothing. It is NaN around switches, where u jumps
    between two of its sparse samples. None when either is absent.
    """
    motion = run.motion
    applied = run.numbers.get(f'controller/terms/applied/{wheel}')
    if motion is None or applied is None:
        return None
    step, half = WINDOW / 20, 10
    start = max(motion.time[0], applied.time[0])
    count = int((min(motion.time[-1], applied.time[-1]) - start) / step) + 1
    if count <= 2 * half + 1:
        return None
    grid = start + step * np.arange(count)
    speed = np.interp(grid, motion.time, motion[wheel])
    control = np.interp(grid, applied.time, applied['value'])
    offsets = np.arange(-half, half + 1.0)
    slope = offsets / (step * np.sum(offsets**2))
    # The slope is a weighted mean of the steps from point to point; their weights:
    weights = -step * np.cumsum(slope)[:-1]
    rate = np.correlate(speed, slope, 'valid')
    mean = np.correlate(0.5 * (control[:-1] + control[1:]), weights, 'valid')
    time = grid[half : count - half]
    reach = WINDOW / 2 + float(np.median(np.diff(applied.time)))
    near = np.searchsorted(run.switches, time - reach) < np.searchsorted(
        run.switches, time + reach
    )
    return Series(time, {'value': np.where(near, np.nan, rate - mean)})


def path_of(motion: Series, start: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return x and y (m) of ``motion``'s twists integrated from a pose, by the arcs of (2)."""
    dt = np.diff(motion.time)
    turn = motion['angular'][:-1] * dt
    chord = motion['linear'][:-1] * dt * np.sinc(turn / math.tau)
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(turn)[:-1]]) + 0.5 * turn
    x = start[0] + np.concatenate([[0.0], np.cumsum(chord * np.cos(yaw))])
    y = start[1] + np.concatenate([[0.0], np.cumsum(chord * np.sin(yaw))])
    return x, y


UNMEASURED = 'not measured'
"""Label of a metric without samples."""


@dataclass(frozen=True)
class ChannelMetrics:
    """Tracking metrics of one channel; NaN where the bag holds no data."""

    overall: tracking_errors.ErrorStatistics
    """RMSE while driven, without the initial transient."""
    settled: tracking_errors.ErrorStatistics
    """RMSE also without the windows around switches."""
    chatter: float
    """Total variation of the commanded speed per second."""
    demand: float
    """The same of the reference: the value of exact tracking."""


@dataclass(frozen=True)
class ReportMetrics:
    """Summary metrics of a run; NaN where the bag holds no data."""

    report: Path
    run: Run
    messages: int
    wheels: Mapping[str, ChannelMetrics]
    """Metrics of ``right`` and ``left``; without wheel geometry ``linear`` and ``angular``."""
    responses: Mapping[str, ResponseFit]
    """Fitted response of the robot to its commands, by channel, where it is identifiable."""
    latency: float
    """Median time (s) from the receipt of odometry to that of the command."""
    latency_99: float
    """Its 99th percentile (s)."""
    missing: Mapping[str, float]
    """Share of missing samples by relative topic name."""
    verdict: Verdict
    """What happened, and whether the numbers measure the controller."""
    incidents: Incidents
    path_error: float = math.nan
    """Root mean square of the distance from the path of a reference that is one, m."""
    path_error_99: float = math.nan
    """Its 99th percentile, m."""

    def delay(self, channel: str) -> float:
        """Return the time from command to motion of a channel, s; NaN if it is not clear."""
        fit = self.responses.get(channel)
        return fit.delay if fit and fit.clear else math.nan

    def numbers(self) -> list[tuple[str, str]]:
        """Return the main numbers that are known, each with its unit, and what it is.

        Those of the path come first where the robot follows one.
        """
        found = [
            (f'{format_number(number)} {unit}', title)
            for title, unit, value in PATH_NUMBERS
            if math.isfinite(number := value(self))
        ]
        names = ' / '.join(each.short for each in self.run.channels)
        follows_path = self.verdict.on_path is not None
        for title, unit, value in CHANNEL_NUMBERS[len(SPEED_ERRORS) if follows_path else 0 :]:
            pair = [value(self, each.name) for each in self.run.channels]
            if any(map(math.isfinite, pair)):
                units = [unit.format(each.unit) for each in self.run.channels]
                found.append((tracking_errors.format_pair(pair, units), f'{title}, {names}'))
        rows = [(title, unit, value(self)) for title, unit, value in RUN_NUMBERS]
        return found + [
            (f'{format_number(number)} {unit}'.rstrip(), title)
            for title, unit, number in (*rows, *self._link_rows())
            if math.isfinite(number)
        ]

    def to_dict(self) -> dict[str, object]:
        """Return verdict and main numbers as plain data, unrounded; those of channels by name."""
        rows = [(title, unit, value(self)) for title, unit, value in (*PATH_NUMBERS, *RUN_NUMBERS)]
        rows += [
            (f'{title}, {each.name}', unit.format(each.unit), value(self, each.name))
            for title, unit, value in CHANNEL_NUMBERS
            for each in self.run.channels
        ]
        rows += self._link_rows()
        numbers = {f'{title} ({unit})' if unit else title: number for title, unit, number in rows}
        verdict = {'kind': self.verdict.kind, 'text': self.verdict.text()}
        return {'report': str(self.report), 'verdict': verdict, 'numbers': numbers}

    def _link_rows(self) -> list[tuple[str, str, float]]:
        """Return what it is, unit and value of each number of each link."""
        return [
            (f'{title}, {link.name}', unit, value(link))
            for link in self.run.links
            for title, unit, value in LINK_NUMBERS
        ]

    def summary(self) -> str:
        """Return the main numbers, a line each, and where the report is."""
        rows = [(title, number) for number, title in self.numbers()]
        width = max(len(title) for title, _ in rows)
        lines = [f'  {title:{width}}  {number}' for title, number in rows]
        return '\n'.join([*lines, str(self.report)])


PATH_NUMBERS: tuple[tuple[str, str, Callable[[ReportMetrics], float]], ...] = (
    ('path error, root mean square', 'mm', lambda found: 1e3 * found.path_error),
    ('path error, 99 % below', 'mm', lambda found: 1e3 * found.path_error_99),
    (
        f'of the drive within {1e3 * ON_PATH:g} mm of the path', '%',
        lambda found: math.nan if found.verdict.on_path is None else 100.0 * found.verdict.on_path,
    ),
)  # fmt: skip
"""Main numbers of a robot that follows a path."""
ChannelNumber = tuple[str, str, Callable[[ReportMetrics, str], float]]
SPEED_ERRORS: tuple[ChannelNumber, ...] = (
    ('RMSE while driven', '{}', lambda found, name: found.wheels[name].overall.rmse),
    ('RMSE while driven and settled', '{}', lambda found, name: found.wheels[name].settled.rmse),
    ('largest error', '{}', lambda found, name: found.wheels[name].overall.largest),
)
"""Main numbers of the error of each channel, which mean nothing where the reference is a path."""
CHANNEL_NUMBERS: tuple[ChannelNumber, ...] = (
    *SPEED_ERRORS,
    ('variation of the command per second', '{}', lambda found, name: found.wheels[name].chatter),
    ('variation of the reference per second', '{}', lambda found, name: found.wheels[name].demand),
    ('command to motion', 'ms', lambda found, name: 1e3 * found.delay(name)),
)
"""Main numbers of each channel: what it is, unit with ``{}`` for that of the channel, value."""
RUN_NUMBERS: tuple[tuple[str, str, Callable[[ReportMetrics], float]], ...] = (
    ('duration', 's', lambda found: found.run.duration),
    ('messages', '', lambda found: found.messages),
    (
        'switches', '',
        lambda found: (
            found.run.switches.size if {*SIGNAL_NAMES} & {*found.run.numbers} else math.nan
        ),
    ),
    (
        'stood although it was to move', 's',
        lambda found: math.nan if found.run.motion is None else found.incidents.stopped,
    ),
    ('odometry to command, median', 'ms', lambda found: 1e3 * found.latency),
    ('odometry to command, 99 % below', 'ms', lambda found: 1e3 * found.latency_99),
    ('odometry missing', '%', lambda found: 100.0 * found.missing.get(ODOMETRY, math.nan)),
)  # fmt: skip
LINK_NUMBERS: tuple[tuple[str, str, Callable[[LinkHistory], float]], ...] = (
    ('cycles answered', '%', lambda link: 100.0 * link.total_answered()),
    (
        'round trip, median', 'ms',
        lambda link: 1e3 * link.over(np.nanmedian, 'round_trip_median_ms', 1e-3),
    ),
    (
        'round trip, worst 99 %', 'ms',
        lambda link: 1e3 * link.over(np.nanmax, 'round_trip_p99_ms', 1e-3),
    ),
    ('oldest measurement', 's', lambda link: link.over(np.nanmax, 'telemetry_age_s')),
)  # fmt: skip


def compute_metrics(run: Run, report: Path, messages: int) -> ReportMetrics:
    """Return the summary metrics of ``run``."""
    errors = tracking_errors.errors_of(run, run.measured)
    command, reference = run.motions.get(COMMAND), run.motions.get(REFERENCE)
    wheels = {
        wheel: ChannelMetrics(
            *errors[wheel],
            math.nan if command is None else variation(command, wheel),
            math.nan if reference is None else variation(reference, wheel),
        )
        for wheel, *_ in run.channels
    }
    delays = latencies(run)
    missing = {
        name: each.missing for name, each in run.timing.items() if name not in run.untrusted
    }
    incidents = find_incidents(run)
    verdict = judge(
        run,
        incidents,
        counted=max(each.overall.seconds for each in wheels.values()),
        missing=missing.get(ODOMETRY, math.nan),
        latency_99=_percentile(latencies(run, first=True), 99.0),
    )
    distance = tracking_errors.path_distance(run)
    return ReportMetrics(
        report=report,
        run=run,
        messages=messages,
        wheels=wheels,
        responses=responses(run),
        latency=_percentile(delays, 50.0),
        latency_99=_percentile(delays, 99.0),
        missing=missing,
        verdict=verdict,
        incidents=incidents,
        path_error=math.nan if distance is None else rms(distance['value']),
        path_error_99=_percentile(distance, 99.0),
    )


def _percentile(series: Series | None, percent: float) -> float:
    return math.nan if series is None else float(np.percentile(series['value'], percent))


def responses(run: Run) -> Mapping[str, ResponseFit]:
    """Return the fitted response of each channel that is identifiable."""
    command, motion = run.motions.get(COMMAND), run.motion
    if command is None or motion is None:
        return {}
    fits = {each.name: fit_response(command, motion, each.name) for each in run.channels}
    return {name: fit for name, fit in fits.items() if fit is not None}
