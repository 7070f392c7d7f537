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
"""Tracking errors of a recorded run, and the time in which they count; see docs/metrics.md."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.bag_report import incidents
from t3mpc_ros.evaluation.bag_report.motion_continuity import gaps
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, Series
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.result_output import format_number
from t3mpc_ros.evaluation.run_record import ROBOT_WINDOW, counted_from, counted_rows
from t3mpc_ros.evaluation.topic_roles import ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.types import Array

SETTING = 0.5
"""Time before and after the odometry is set in which no distance from the path counts, s."""


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of the tracking error of one channel, in its unit; NaN without a sample."""

    rmse: float
    mae: float
    largest: float
    count: int
    seconds: float
    """Time that the samples cover, s."""


def statistics(error: Array, period: float = math.nan) -> ErrorStatistics:
    """Return statistics of the absolute error, of which each sample stands for ``period`` s."""
    size = np.abs(error[np.isfinite(error)])
    if not size.size:
        return ErrorStatistics(math.nan, math.nan, math.nan, 0, 0.0)
    return ErrorStatistics(
        rms(size), float(size.mean()), float(size.max()), int(size.size), size.size * period
    )


def tracking_error(run: Run, measured: str) -> Series | None:
    """Return measured minus reference of both channels at the stamps of the ``measured`` motion.

    The reference is interpolated linearly; across a switch its earlier sample is held. Outside the
    reference, and in its gaps, the error is undefined. None when either motion is missing.
    """
    motion, reference = run.motions.get(measured), run.motions.get(REFERENCE)
    if motion is None or reference is None:
        return None
    inside = (motion.time >= reference.time[0]) & (motion.time <= reference.time[-1])
    for low, high in gaps(reference.time):
        inside &= (motion.time <= low) | (motion.time >= high)
    time = motion.time[inside]
    before = np.clip(np.searchsorted(reference.time, time, 'right') - 1, 0, None)
    following = np.minimum(before + 1, len(reference) - 1)
    held = np.isin(reference.time[following], run.switches)
    errors = {}
    for wheel, *_ in run.channels:
        wanted = np.interp(time, reference.time, reference[wheel])
        wanted = np.where(held, reference[wheel][before], wanted)
        errors[wheel] = motion[wheel][inside] - wanted
    return Series(time, errors)


def counted(time: Array, run: Run) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which stamps of an error (s) count while the robot was driven, and settled as well.

    Driven is what is not before the drive has started, nor after it, nor in a stop, from
    :data:`BRAKING` s before standstill to the end of the settling after it. Settled leaves out
    the switches, too, as in a simulated run.
    """
    first, last = incidents.driving(run)
    if not time.size or not first < last:
        nothing = np.zeros(time.size, dtype=np.bool_)
        return nothing, nothing
    last = min(last, float(time[-1]))
    span = counted_from(max(first, float(time[0])), last), last
    stops = [(stop.start - incidents.BRAKING, stop.end) for stop in incidents.find_stops(run)]
    driven = counted_rows(time, run.switches, *span) & apart_from(time, stops)
    return driven, driven & counted_rows(time, run.switches, *span, ROBOT_WINDOW)


def apart_from(time: Array, spans: Sequence[incidents.Span]) -> NDArray[np.bool_]:
    """Return which instants are in no span, nor in the time in which a robot settles after it."""
    away = np.ones(time.size, dtype=np.bool_)
    for start, end in spans:
        away &= (time < start) | (time >= end + ROBOT_WINDOW.after)
    return away


def errors_of(run: Run, measured: str) -> dict[str, tuple[ErrorStatistics, ErrorStatistics]]:
    """Return the statistics while driven and those while driven and settled, by wheel."""
    error = None if measured in run.untrusted else tracking_error(run, measured)
    if error is None:
        nothing = statistics(np.empty(0))
        return dict.fromkeys((each.name for each in run.channels), (nothing, nothing))
    moving, calm = counted(error.time, run)
    period = float(np.median(np.diff(error.time))) if len(error) > 1 else math.nan
    return {
        wheel: (statistics(error[wheel][moving], period), statistics(error[wheel][calm], period))
        for wheel, *_ in run.channels
    }


def odometry_sets(run: Run) -> list[float]:
    """Return when the odometry was set, s: it jumps, and the ground truth of the robot does not.

    None with the localizer of this package: its odometry is the pose on the map, as ground truth
    is, so that a jump of it is an error of the pose, or the end of one.
    """
    truth, odometry = run.motions.get(TRUTH), run.motions.get(ODOMETRY)
    if truth is None or odometry is None or 'localizer' in run.parameters:
        return []
    found = []
    for jump in incidents.find_jumps(run):
        if jump.name != ODOMETRY or not truth.time[0] < jump.time < truth.time[-1]:
            continue
        row = int(np.searchsorted(odometry.time, jump.time))
        step = [np.diff(np.interp(odometry.time[row - 1 : row + 1], truth.time, truth[axis]))
                for axis in 'xy']  # fmt: skip
        if np.hypot(*step) < 0.5 * jump.distance:
            found.append(jump.time)
    return found


def on_reference_frame(run: Run) -> Series | None:
    """Return the measured motion with positions in the frame of the odometry and the reference.

    From each time on at which the odometry was set, ground truth is laid on it anew. Positions are
    NaN about that time, while the reference may still be, or is interpolated, in the old frame.
    """
    motion, reference = run.motion, run.motions.get(REFERENCE)
    sets = odometry_sets(run)
    if motion is None or reference is None or not sets:
        return motion
    odometry = run.motions[ODOMETRY]
    x, y, yaw = (motion[name].copy() for name in ('x', 'y', 'yaw'))
    unknown = np.zeros(len(motion), dtype=np.bool_)
    for time in sets:
        row, first = np.searchsorted(odometry.time, time), np.searchsorted(motion.time, time)
        turn = odometry['yaw'][row] - yaw[first]
        c, s = np.cos(turn), np.sin(turn)
        dx, dy = x[first:] - x[first], y[first:] - y[first]
        x[first:] = odometry['x'][row] + c * dx - s * dy
        y[first:] = odometry['y'][row] + s * dx + c * dy
        yaw[first:] += turn
        old, new = reference.time < time, reference.time >= time + run.lead
        start = min(time - SETTING, np.max(reference.time[old], initial=-math.inf))
        end = max(time + run.lead + SETTING, np.min(reference.time[new], initial=math.inf))
        unknown |= (motion.time > start) & (motion.time < end)
    x[unknown] = y[unknown] = math.nan
    return Series(motion.time, {**motion.values, 'x': x, 'y': y, 'yaw': yaw})


def path_distance(run: Run) -> Series | None:
    """Return how far the robot is from the place of its reference at the same time, m.

    From the first to the last command to move, in the frame of the reference. None for a robot
    that follows no path, or without the positions of either.
    """
    reference = run.motions.get(REFERENCE)
    if not run.follows_path or reference is None or 'x' not in reference.values:
        return None
    motion = on_reference_frame(run)
    if motion is None:
        return None
    motion = motion.between(*incidents.driving(run)).between(
        float(reference.time[0]), float(reference.time[-1])
    )
    away = np.hypot(
        *(motion[axis] - np.interp(motion.time, reference.time, reference[axis]) for axis in 'xy')
    )
    known = np.isfinite(away)
    return Series(motion.time[known], {'value': away[known]}) if known.any() else None


def settled_rmse(
    run: Run, until: float = math.inf, spared: Sequence[incidents.Span] = ()
) -> tuple[float, float]:
    """Return the settled RMSE of both channels while driven, up to a time, apart from some spans.

    Times in s, errors in the units of the channels; NaN without a sample.
    """
    error = tracking_error(run, run.measured)
    if error is None:
        return math.nan, math.nan
    rows = counted(error.time, run)[1] & (error.time < until)
    rows &= apart_from(error.time, spared)
    right, left = (statistics(error[each.name][rows]).rmse for each in run.channels)
    return right, left


def format_pair(values: Sequence[float], units: Sequence[str]) -> str:
    """Return the numbers of both channels with their units, which may differ."""
    one, other = map(format_number, values)
    if units[0] == units[1]:
        return f'{one} / {other} {units[0]}'
    return f'{one} {units[0]} / {other} {units[1]}'
