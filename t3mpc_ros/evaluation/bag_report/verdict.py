# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a recorded run: whether its numbers measure the controller, and why not."""

from dataclasses import dataclass
import math
from typing import Literal, NamedTuple

import numpy as np

from t3mpc_ros.evaluation.bag_report.run_data import Run, moves
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE

MAX_STOPPED = 0.01
"""Largest share of the drive without a command to move."""
MAX_MISSING = 0.02
"""Largest share of missing odometry."""
MAX_ERROR = 0.25
"""Largest RMSE, settled, as a share of the root mean square of the reference."""
MIN_COUNTED = 0.5
"""Least share of the drive in which errors count."""
ON_PATH = 0.05
"""Largest distance from its reference of a robot that is on its path, m."""
MIN_ON_PATH = 0.02
"""Least share of the drive on the path for a robot that follows it at all. Detours around
obstacles, looking around and the way back are no errors; the path itself goes on meanwhile."""
MOSTLY = 0.5
"""Share of the drive on the path below which the headline says so."""
MAX_LATENCY = 0.02
"""99th percentile of the time from odometry to command that shows a slow machine, s."""
COMMAND_TIMEOUT = 0.5
"""Time without a command after which the robot stands, s."""
OVERLOAD = ('processor overloaded', 'real-time factor')
"""Texts of diagnostics that say that the machine is too slow."""
REASON_WINDOW = 1.5
"""Diagnostics come once a second: those of a stop are at most this far from its start, s."""
_MAX_REASONS = 3


class Stop(NamedTuple):
    """A time within the drive without a command to move."""

    start: float
    end: float
    reason: str
    """Diagnostics at that time; empty if there were none."""
    commanded: bool
    """Whether commands of zero stopped the robot, not a lack of commands."""


@dataclass(frozen=True)
class Verdict:
    """Whether the numbers of a run measure the controller, and why not."""

    problems: tuple[str, ...]
    """Empty for a sound run."""
    stopped: float = 0.0
    """Time in which the robot was commanded to stand during the drive, s."""
    stops: tuple[Stop, ...] = ()
    slow: bool = False
    """Whether the machine was too slow, which explains the problems if there are any."""
    missing: bool = False
    """Whether too much of the odometry is missing."""
    judged: bool = True
    """Whether the bag holds a closed loop of this package, which can be judged."""
    damage: tuple[str, ...] = ()
    """Why the recording itself cannot be trusted; also among the problems."""
    lacking: tuple[str, ...] = ()
    """Topics without which there is nothing to judge."""
    on_path: float | None = None
    """Share of the drive within :data:`ON_PATH` of the reference; None unless the controller
    follows a path."""

    @property
    def sound(self) -> bool:
        """Whether nothing speaks against the numbers."""
        return self.judged and not self.problems

    @property
    def kind(self) -> Literal['good', 'open', 'bad']:
        """Whether the run is good, cannot be judged, or is bad."""
        if self.problems:
            return 'bad'
        return 'good' if self.judged and not self._mostly_off_path else 'open'

    @property
    def headline(self) -> str:
        """The verdict in a few words."""
        if self.slow:
            return 'Machine too slow' if self.problems else 'Good run, on a slow machine'
        if self.damage:
            return 'Damaged recording'
        if self.missing and not any(stop.commanded for stop in self.stops):
            return 'Data missing'
        if self.problems and self.stops:
            times = 'once' if len(self.stops) == 1 else f'{len(self.stops)} times'
            return f'Stopped {times}'
        if self.problems:
            return 'No valid measurement'
        if self._mostly_off_path:
            return 'Mostly off its path'
        return 'Good run' if self.judged else 'Data missing: tracking cannot be judged'

    @property
    def _mostly_off_path(self) -> bool:
        return self.on_path is not None and self.on_path < MOSTLY

    def text(self) -> str:
        """Return the verdict in one sentence."""
        if self.problems:
            return f'NO VALID MEASUREMENT: {"; ".join(self.problems)}'
        if not self.judged:
            return f'NO VERDICT ON TRACKING: the bag lacks {", ".join(self.lacking)}'
        return f'sound run: {self._followed()}'

    def _followed(self) -> str:
        """Return what a sound run shows."""
        stopped = f'stopped for {self.stopped:.1f} s'
        if self.on_path is None:
            return f'the robot followed the reference, {stopped}'
        return (
            f'the robot was on its path, within {1e3 * ON_PATH:g} mm of it, for '
            f'{100.0 * self.on_path:.0f} % of the drive, {stopped}; the rest were detours around '
            'obstacles and the ways back'
        )

    def reasons(self) -> list[str]:
        """Return the sentences that explain the headline."""
        found = [f'{each[0].upper()}{each[1:]}.' for each in self.problems]
        if self.stops and self.problems:
            by_length = sorted(self.stops, key=lambda each: each.start - each.end)
            found += [_stop_text(each) for each in sorted(by_length[:_MAX_REASONS])]
            if len(self.stops) > _MAX_REASONS:
                found.append(f'{len(self.stops) - _MAX_REASONS} shorter stops: see the events.')
        if self.sound:
            if self.slow:
                found.append('The machine was too slow at times, which did not spoil the numbers.')
            text = self._followed()
            found.append(f'{text[0].upper()}{text[1:]}.')
        elif self.lacking:
            found.append(f'The bag lacks {", ".join(self.lacking)}.')
        return found


def _stop_text(stop: Stop) -> str:
    why = stop.reason or 'the bag holds no diagnostics of that time'
    return f'At {stop.start:.1f} s for {stop.end - stop.start:.2f} s: {why}.'


def judge(
    run: Run,
    drive: tuple[float, float],
    rmse: float,
    counted: float,
    missing: float,
    latency_99: float,
) -> Verdict:
    """Return the verdict on a run.

    ``drive`` are its first and last command other than zero, ``counted`` is the time in which
    errors count, s; ``rmse`` the largest settled one of the channels, ``missing`` the share of
    odometry, ``latency_99`` the 99th percentile from odometry to command, s; NaN if unknown.
    """
    damage = run.damage
    if lacking := _lacking(run):
        return Verdict(damage, judged=False, damage=damage, lacking=lacking)
    if not drive[0] < drive[1]:
        return Verdict((*damage, 'the robot was never driven'), damage=damage)
    length = drive[1] - drive[0]
    stops, stopped = find_stops(run, *drive)
    on_path = share_on_path(run, drive) if run.follows_path else None
    problems = []
    if on_path is None and stopped > MAX_STOPPED * length:
        problems.append(f'the robot was stopped for {stopped:.1f} of {length:.1f} s')
    if missing > MAX_MISSING:
        problems.append(f'{100.0 * missing:.1f} % of {ODOMETRY} is missing')
    if on_path is None:
        problems += _speed_problems(run, rmse, counted, length)
    elif on_path < MIN_ON_PATH:
        problems.append(
            f'the robot was within {1e3 * ON_PATH:g} mm of its path for only '
            f'{100.0 * on_path:.0f} % of the drive'
        )
    overloaded = any(text in what for *_, what in run.complaints for text in OVERLOAD)
    slow = overloaded or latency_99 > MAX_LATENCY
    if slow and problems:
        # By itself it does not spoil the numbers.
        problems.insert(0, 'the machine was too slow')
    found, lost = (*problems, *damage), missing > MAX_MISSING
    return Verdict(found, stopped, stops, slow, lost, damage=damage, on_path=on_path)


def _lacking(run: Run) -> tuple[str, ...]:
    """Return what a closed loop of this package has, and the run has not."""
    lacking = [name for name in (REFERENCE, COMMAND) if name not in run.motions]
    if not run.measured:
        lacking.append(ODOMETRY)
    if not (lacking or run.ours):
        lacking.append('the topics of the controller of this package')
    return tuple(lacking)


def share_on_path(run: Run, drive: tuple[float, float]) -> float:
    """Return the share of the drive in which the robot is within :data:`ON_PATH` of its path."""
    motion, reference = run.motions[run.measured].between(*drive), run.motions[REFERENCE]
    if not len(motion) or 'x' not in reference.values or 'x' not in motion.values:
        return 0.0
    away = [
        motion[axis] - np.interp(motion.time, reference.time, reference[axis]) for axis in 'xy'
    ]
    return float(np.mean(np.hypot(*away) <= ON_PATH))


def _speed_problems(run: Run, rmse: float, counted: float, length: float) -> list[str]:
    """Return what speaks against the errors of the speeds; arguments as of :func:`judge`."""
    reference = run.motions[REFERENCE]
    problems = []
    if counted < MIN_COUNTED * length:
        problems.append(f'only {counted:.1f} of {length:.1f} s count')
    size = max(rms(reference[each.name]) for each in run.channels)
    if not np.isfinite(rmse):
        problems.append('no settled motion was measured')
    elif rmse > MAX_ERROR * size:
        unit = run.channels[0].unit
        problems.append(f'settled RMSE {rmse:.2g} {unit} on a reference of {size:.2g} {unit}')
    return problems


def find_stops(run: Run, first: float, last: float) -> tuple[tuple[Stop, ...], float]:
    """Return the stops from ``first`` to ``last``, in order, and their time together, s."""
    command = run.motions[COMMAND].between(first, last)
    time, moving = command.time, moves(command)
    steps = np.diff(time)
    waits = np.where(moving[:-1], np.maximum(steps - COMMAND_TIMEOUT, 0.0), steps)
    spans: list[tuple[float, float, bool]] = []
    for k in np.flatnonzero(waits > 0.0).tolist():
        start = float(time[k]) + (COMMAND_TIMEOUT if moving[k] else 0.0)
        end, commanded = float(time[k + 1]), not moving[k]
        if spans and start <= spans[-1][1] + 1e-9:
            start, _, before = spans.pop()
            commanded = commanded or before
        spans.append((start, end, commanded))
    stops = (Stop(start, end, _reason(run, start, end), each) for start, end, each in spans)
    return tuple(stops), float(waits.sum())


def _reason(run: Run, start: float, end: float) -> str:
    """Return the errors, else the warnings, of the nodes about the start of a stop."""
    until = max(math.nextafter(start, end), min(end, start + 10.0)) + REASON_WINDOW
    near = [each for each in run.changes if start - 0.5 <= each[0] <= until]
    worst = [each for each in near if each[1] == 'error'] or near
    return '; '.join(dict.fromkeys(f'{name}: {text}' for _, _, name, text in worst[:2]))
