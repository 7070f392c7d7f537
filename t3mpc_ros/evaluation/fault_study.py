# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Outcome of the closed loop under each named fault, and the table of docs/faults.md.

Every fault begins and ends while the controller drives the twin; its errors are compared with the
same run without the fault. What the robot can detect is kept apart from what only ground truth
shows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.method import NodeMethod
from t3mpc_ros.evaluation.methods import FULL
from t3mpc_ros.evaluation.record import RATE, STATUS_FLAGS, Record, rolling_speeds
from t3mpc_ros.evaluation.reporting import EMPTY_CELL, Table, progress_bar
from t3mpc_ros.evaluation.scenario import (
    LEAD,
    OwnParts,
    SampledReference,
    Scenario,
    sampled_speeds,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, WheelSpeeds, wrap_angle
from t3mpc_ros.parameters.table import Value
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import (
    FaultEvent,
    FaultParameters,
    FaultSchedule,
    active_faults,
)

Array = NDArray[np.float64]

BEGIN = 10.0
"""Begin of every fault, s."""
SETTLED = 3.0
"""Errors count from here, s."""
AFTER = 2.0
"""Time after the end of a fault before its error after the fault counts, s."""
ALLOWED = 1.5
"""Ratio to the error without the fault up to which an error counts as recovered."""
REST = 4.0
"""Shortest time over which an error can count as recovered, s."""
BRAKING_TIME = 0.6
"""Time after a stop reason by which the robot must stand still, s."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one run; errors are root mean squares over time and both wheels."""

    name: str
    course: str
    verdict: str
    """``bounded``: the robot stays within its limits and the error recovers; ``stops``: it stops
    with a reason; ``impaired``: within limits, but the error remains; ``unbounded``: otherwise."""
    reason: str
    """Reason of the stop, or the violated bound."""
    stopped_for: float
    """Time with a stop reason, s"""
    resumption: str
    """Resumption: ``by itself``, ``after a pause`` or ``not``; '' if the robot never stopped."""
    before: float
    """Error of the wheel speeds before the fault, rad/s"""
    during: float
    after: float | None
    """None if the robot stands at the end, or the fault lasts."""
    recovery_time: float | None
    """Time from the end of the fault until the error stays recovered, s; None if it does not."""
    odometry_before: tuple[float, float]
    """Odometry error before the fault: m, rad"""
    odometry_after: tuple[float, float]
    """Odometry error at the end of the run."""
    detected: tuple[str, ...]
    """Signs that robot or controller show: flags, reasons, a larger error."""
    ranges: str
    """Range readings before and at a wall; the loop does not use them."""
    undetected: tuple[str, ...]
    """Effects that only ground truth shows."""


def evaluate_outcome(
    name: str,
    course: str,
    record: Record,
    undisturbed_run: Record,
    begin: float,
    end: float,
    parameters: DigitalTwinParameters,
) -> Outcome:
    """Return the outcome of a recorded run, beside the same one without the fault.

    ``begin`` and ``end`` (s) are those of the fault; the end may lie beyond the record.
    """
    last = float(record.time[-1])
    stays = end >= last
    reasons = stop_reasons(record, begin)
    stopped = bool(record.robot_reasons[-1] or record.driver_reasons[-1])
    recovery_time = None if stays or stopped else time_to_return(record, undisturbed_run, end)
    violation = _bound_violation(record, begin, parameters)
    if violation:
        verdict = 'unbounded'
    elif reasons:
        verdict = 'stops'
    else:
        verdict = 'bounded' if stays or recovery_time is not None else 'impaired'
    resumption = ('not' if stopped else 'by itself') if reasons else ''
    before, after = _odometry_error(record, begin), _odometry_error(record, last)
    return Outcome(
        name=name,
        course=course,
        verdict=verdict,
        reason=violation or '; '.join(reasons),
        stopped_for=sum(reasons.values()),
        resumption=resumption,
        before=wheel_error(record, SETTLED, begin),
        during=wheel_error(record, begin, end),
        after=None if stays or stopped else wheel_error(record, end + AFTER, last),
        recovery_time=recovery_time,
        odometry_before=before,
        odometry_after=after,
        detected=_detected(record, undisturbed_run, begin, min(end, last)),
        ranges=_ranges(record, begin, min(end, last)),
        undetected=_undetected(
            record, begin, min(end, last), after, _odometry_error(undisturbed_run, last)
        ),
    )


def time_to_return(record: Record, undisturbed_run: Record, end: float) -> float | None:
    """Return the time (s) from ``end`` until the wheel error stays recovered; None if it does not.

    It has recovered if from then on to the end it is at most :data:`ALLOWED` times the error of
    the run without the fault, in the same time or before the fault, whichever is larger.
    """
    errors = record.speeds - record.reference, undisturbed_run.speeds - undisturbed_run.reference
    usual = rms(errors[1][undisturbed_run.rows(SETTLED, BEGIN)])
    last = float(record.time[-1])
    for wait in np.arange(0.0, last - REST - end, 0.5).tolist():
        mine, other = (rms(error[record.rows(end + wait, last)]) for error in errors)
        if mine <= ALLOWED * max(usual, other):
            return float(wait)
    return None


def wheel_error(record: Record, begin: float, end: float) -> float:
    """Return the error (rad/s) of the rotors from ``begin`` to ``end`` (s)."""
    return rms((record.speeds - record.reference)[record.rows(begin, end)])


def _odometry_error(record: Record, time: float) -> tuple[float, float]:
    """Return the odometry error (m, rad) just before ``time`` (s)."""
    row = record.rows(time, time + 1.0).start - 1
    x, y, yaw = (record['odometry'][row] - record['truth'][row]).tolist()
    return float(np.hypot(x, y)), abs(wrap_angle(yaw))


def stop_reasons(record: Record, begin: float) -> dict[str, float]:
    """Return the duration (s) of each stop reason of robot and controller."""
    period = float(record.time[1] - record.time[0])
    reasons: dict[str, float] = {}
    for row in range(record.rows(begin, begin + 1.0).start, len(record.time)):
        text = record.robot_reasons[row] or record.driver_reasons[row]
        if text:
            reasons[text] = reasons.get(text, 0.0) + period
    return reasons


def _bound_violation(record: Record, begin: float, parameters: DigitalTwinParameters) -> str:
    """Return the violated bound as text; '' if there is none."""
    limiter = parameters.limiter
    rows = slice(record.rows(record.start, begin).start, None)
    limit = limiter.wheel_speed
    for what, speeds in (('command', record['commanded'][rows]), ('wheel', record.speeds[rows])):
        fastest = float(np.max(np.abs(speeds)))
        if not fastest <= limit + 1e-6:
            return f'a {what} of {fastest:.1f} rad/s, the limit being {limit:g}'
    for right, left in record['commanded'][rows].tolist():
        twist = twist_from_wheels(WheelSpeeds(right, left), parameters.geometry)
        if abs(twist.linear) > limiter.linear_speed + 1e-6:
            return f'a command of {twist.linear:.2f} m/s'
        if abs(twist.angular) > limiter.angular_speed + 1e-6:
            return f'a command of {twist.angular:.1f} rad/s about the vertical'
    since = None
    for row, text in enumerate(record.robot_reasons):
        since = None if not text else row if since is None else since
        if since is None or record.time[row] - record.time[since] < BRAKING_TIME:
            continue
        if np.any(record['commanded'][row]):
            return f'the robot moves although it reports a stop ({text})'
    return ''


def _detected(
    record: Record, undisturbed_run: Record, begin: float, end: float
) -> tuple[str, ...]:
    """Return the signs of robot and controller from the begin of the fault."""
    found = []
    rows = record.rows(begin, float(record.time[-1]))

    def note(what: str, raised: NDArray[np.bool_]) -> None:
        wait = float(record.time[rows][np.argmax(raised)]) - begin
        found.append(f'{what} after {wait:.1f} s' if wait >= 0.05 else f'{what} at once')

    for name in STATUS_FLAGS:
        raised = record.flag(name)[rows]
        if name == 'enabled':
            name, raised = 'not enabled', ~raised
        if name != 'moving' and raised.any() and not raised.all():
            note(f'`{name}`', raised)
    for text in dict.fromkeys(filter(None, record.robot_reasons[rows])):
        reported = np.array([one == text for one in record.robot_reasons[rows]])
        note(f'"{text.split(":")[0]}"', reported)
    during = record.rows(begin, end)
    if np.isnan(record['ranges'][during]).all():
        found.append('no distances')
    error = rms((record['measured'] - record.reference)[during])
    usual = rms((undisturbed_run['measured'] - undisturbed_run.reference)[during])
    if error > ALLOWED * usual and not any(record.robot_reasons[during]):
        found.append(f'tracking error {error:.2f} rad/s')
    return tuple(found)


def _ranges(record: Record, begin: float, end: float) -> str:
    """Return the nearest range in the last 2 s before ``begin``, and from then on."""
    before, during = (
        np.fmin.reduce(record['ranges'][record.rows(*span)], axis=1)
        for span in ((begin - 2.0, begin), (begin, end))
    )
    if not np.isfinite(before).any():
        return ''
    span = ' to '.join(
        f'{one:.2f} m' if np.isfinite(one) else 'below range'
        for one in dict.fromkeys((np.min(during), np.max(during)))
    )
    return f'distances fall to {np.min(before[np.isfinite(before)]):.2f} m before it, then {span}'


def _undetected(
    record: Record,
    begin: float,
    end: float,
    off: tuple[float, float],
    usual: tuple[float, float],
) -> tuple[str, ...]:
    """Return the effects that only ground truth shows."""
    found = []
    rows = record.rows(begin, end)
    lost = np.abs(record['lost_steps'][record.rows(begin, float(record.time[-1]))]).max(axis=0)
    if lost.any():
        found.append(f'lost steps {lost[0]}, {lost[1]}')
    slide = rms((rolling_speeds(record, WheelGeometry()) - record.speeds)[rows])
    if slide > 0.2:
        found.append(f'tyres slide ({slide:.1f} rad/s)')
    if off[0] > usual[0] + 0.02 or off[1] > usual[1] + 0.05:
        found.append('odometry is wrong')
    return tuple(found)


DURATION = 40.0
"""s; length of a run."""
PAUSE = (5.0, 1.0)
"""Time from the fault to the pause of the controller of a stopped robot, and its length, s."""


def straight_course(duration: float, turn: float = 0.0) -> SampledReference:
    """Return 0.2 m/s straight ahead, or turning (rad/s)."""
    wheels = wheels_from_twist(BodyTwist(0.2, turn), WheelGeometry())
    return sampled_speeds(np.tile(wheels, (round((duration + LEAD) * RATE) + 1, 1)))


REFERENCE_COURSES: Mapping[str, Callable[[float], SampledReference]] = {
    'chaotic': lambda duration: Scenario('servo', 'nominal', 1, duration).reference(),
    'straight': straight_course,
    'arc': lambda duration: straight_course(duration, turn=-0.06),
}
"""Reference courses by name."""


@dataclass(frozen=True, slots=True)
class FaultRun:
    """One run of the study: a course with a fault, or with a wall at its end."""

    name: str
    course: str
    """One of :data:`COURSES`."""
    event: FaultEvent | None
    """None for a wall instead of a fault."""
    world: str = ''
    duration: float = DURATION

    @property
    def fault(self) -> str:
        """The name of the fault, ``collision`` for a wall."""
        return 'collision' if self.event is None else self.event.fault

    def scenario(self, pauses: tuple[tuple[float, float], ...] = ()) -> Scenario:
        """Return the run on the twin, with pauses of the controller (s)."""
        own = OwnParts(
            reference=_course(self.course, self.duration),
            events=FaultSchedule([] if self.event is None else [self.event], self.name),
            robot_parameters={'world': self.world},
            pauses=pauses,
        )
        return Scenario('twin', 'nominal', 1, self.duration, own=own)


def _fault_runs() -> tuple[FaultRun, ...]:
    strengths: tuple[tuple[str, tuple[Value, ...], float], ...] = (
        ('command_delay', (0.05, 0.1, 0.2, 0.3), 5.0),
        ('command_jitter', (0.05, 0.2), 5.0),
        ('command_loss', (0.1, 0.3, 0.9, 1.0), 5.0),
        ('gyro_bias_jump', (0.02, 0.35), 5.0),
        ('gyro_dead', (True,), 5.0),
        ('ranges_dead', (True,), 5.0),
        ('wheel_blocked', ('right', 'both'), 5.0),
        ('load_change', (1.0, 3.0, -0.5), 5.0),
        ('slippery', (0.3, 0.05, 0.0), 5.0),
        ('supply_sag', (2.0, 5.0), 5.0),
        ('brown_out', (True,), 0.1),
    )
    fault_runs = []
    for course in ('chaotic', 'straight'):
        for fault, values, duration in strengths:
            for value in values:
                (name,) = active_faults(FaultParameters().with_values({fault: value}))
                fault_runs.append(
                    FaultRun(name, course, FaultEvent(BEGIN, fault, value, duration))
                )
    fault_runs.append(FaultRun('collision, head-on', 'straight', None, 'room', 25.0))
    fault_runs.append(FaultRun('collision, at a slant', 'arc', None, 'room', 25.0))
    return tuple(fault_runs)


FAULT_RUNS = _fault_runs()
"""Every run, grouped by course."""


def study_faults(fault_runs: Sequence[FaultRun], *, progress: bool = False) -> list[Outcome]:
    """Return the outcome of each run."""
    results = []
    with progress_bar(len(fault_runs), show=progress) as bar:
        for fault_run in fault_runs:
            results.append(run_fault(fault_run))
            bar.update()
    return results


def run_fault(fault_run: FaultRun) -> Outcome:
    """Return the outcome of the closed loop in one run.

    If the robot stands at the end, the run is repeated with a pause of the controller.
    """
    parameters = fault_run.scenario().true_robot()
    assert isinstance(parameters, DigitalTwinParameters)
    record = _run(fault_run)
    undisturbed_run = undisturbed(fault_run.course, fault_run.duration)
    begin, end = _span(fault_run, record, parameters)
    result = evaluate_outcome(
        fault_run.name, fault_run.course, record, undisturbed_run, begin, end, parameters
    )
    if result.verdict == 'stops' and result.resumption == 'not' and fault_run.event is not None:
        again, wait = end + PAUSE[0], PAUSE[1]
        paused = _run(fault_run, ((again, again + wait),))
        remaining = stop_reasons(paused, again + wait + AFTER)
        if not remaining:
            end = again + wait
            result = replace(
                result,
                resumption='after a pause',
                after=wheel_error(paused, end + AFTER, fault_run.duration),
                recovery_time=time_to_return(paused, undisturbed_run, end),
            )
    return result


@lru_cache(maxsize=8)
def undisturbed(course: str, duration: float) -> Record:
    """Return the run on a course without fault and walls."""
    return _run(FaultRun('none', course, None, '', duration))


def _run(fault_run: FaultRun, pauses: tuple[tuple[float, float], ...] = ()) -> Record:
    return run(fault_run.scenario(pauses), NodeMethod(FULL, {}))


@cache
def _course(name: str, duration: float) -> SampledReference:
    return REFERENCE_COURSES[name](duration)


def _span(
    fault_run: FaultRun, record: Record, parameters: DigitalTwinParameters
) -> tuple[float, float]:
    """Return begin and end of the fault or the collision, s."""
    if fault_run.event is None:
        touches = record['contact_force'] > 0.0
        return float(record.time[np.argmax(touches)] if touches.any() else 0.0), fault_run.duration
    away = parameters.boot_time if fault_run.event.fault == 'brown_out' else 0.0
    return fault_run.event.at, fault_run.event.until + away


BEGIN_MARK = '<!-- outcomes: written by `t3mpc faults`, do not edit by hand -->'
END_MARK = '<!-- end of outcomes -->'

TITLES = {
    'chaotic': 'Along the chaotic reference',
    'straight': 'Straight on at 0.2 m/s',
    'arc': 'Along an arc at 0.2 m/s',
}
TABLE_HEAD = (
    'fault',
    'outcome',
    'error of the wheels before, during, after (rad/s)',
    'odometry error before, at the end',
    'detected by robot or controller',
    'shown by ground truth only',
)
UNDETECTED = '**undetected by the robot**: '
UNREPORTED = '**no flag, no reason, and the counters advance**: '


def outcome_sentence(outcome: Outcome) -> str:
    """Return the outcome in words."""
    recovery_time = (
        'error not recovered' if outcome.recovery_time is None
        else f'error recovered after {outcome.recovery_time:g} s'
        if outcome.recovery_time > 0.0 else 'error recovered at once'
    )  # fmt: skip
    if outcome.verdict == 'unbounded':
        return f'unbounded: {outcome.reason}'
    if outcome.verdict == 'impaired':
        return 'within limits, but error not recovered'
    if outcome.verdict == 'bounded':
        return 'bounded' + ('' if outcome.after is None else f', {recovery_time}')
    text = f'stops: {_short(outcome.reason)}'
    if outcome.resumption == 'by itself':
        return f'{text}, for {outcome.stopped_for:.1f} s; resumes by itself, {recovery_time}'
    if outcome.resumption == 'after a pause':
        return f'{text}, until commands pause; then resumes, {recovery_time}'
    return f'{text}, and remains stopped'


def table_row(outcome: Outcome) -> tuple[str, ...]:
    """Return the cells of a table."""
    after = EMPTY_CELL if outcome.after is None else f'{outcome.after:.2f}'
    before_m, before_rad = outcome.odometry_before
    after_m, after_rad = outcome.odometry_after
    undetected = ', '.join(outcome.undetected) or EMPTY_CELL
    if outcome.undetected and not outcome.detected:
        undetected = (UNREPORTED if outcome.ranges else UNDETECTED) + undetected
    known = [*outcome.detected, outcome.ranges] if outcome.ranges else outcome.detected
    return (
        f'`{outcome.name}`',
        outcome_sentence(outcome),
        f'{outcome.before:.2f}, {outcome.during:.2f}, {after}',
        f'{_length(before_m)}, {_degrees(before_rad)}; {_length(after_m)}, {_degrees(after_rad)}',
        ', '.join(known) or EMPTY_CELL,
        undetected,
    )


def markdown_tables(results: Sequence[Outcome]) -> str:
    """Return a table for each course, one row for each outcome."""
    parts = []
    for course, title in TITLES.items():
        rows = [table_row(result) for result in results if result.course == course]
        if rows:
            parts.append(f'### {title}\n\n{Table("", TABLE_HEAD, rows).markdown()}\n')
    return '\n'.join(parts)


def console_text(results: Sequence[Outcome]) -> str:
    """Return the outcomes for a terminal, one line each."""
    lines = []
    for course, title in TITLES.items():
        chosen = [result for result in results if result.course == course]
        lines += [f'{title}:'] if chosen else []
        for result in chosen:
            hidden = (
                ' (not detected by the robot)' if result.undetected and not result.detected else ''
            )
            lines.append(f'  {result.name:24} {outcome_sentence(result)}{hidden}')
    return '\n'.join(lines)


def page_section(results: Sequence[Outcome]) -> str:
    """Return the section of the page from mark to mark."""
    after, pause = PAUSE
    return f"""{BEGIN_MARK}

The controller drives the twin. Each fault begins at {BEGIN:g} s and lasts 5 s; `brown_out`
restarts the board, which takes 0.5 s. A run lasts {DURATION:g} s, one into a wall 25 s, of which
the robot needs 11 s to get there.

Errors are root mean squares over both wheels, of rotor speed against reference:
from 3 s on before the fault, during it, and from 2 s after it to the end. The error has
*recovered* when the rest of the run is no worse than {ALLOWED:g} times the same run without the
fault. Where the robot stands until commands pause, a person pauses the controller for {pause:g} s,
{after:g} s after the fault: the error after the fault then counts after the pause, and the
odometry is that of the run without a pause.

Ground truth shows full steps lost by the right and the left motor at most, and how much
faster (root mean square) the wheels turn than they roll.

{markdown_tables(results)}
{END_MARK}
"""


def update_page(page: Path, results: Sequence[Outcome]) -> None:
    """Replace the section between the marks of a page, which has both once and in this order."""
    text = page.read_text(encoding='utf-8')
    head, begun, rest = text.partition(BEGIN_MARK)
    _, ended, tail = rest.partition(END_MARK)
    if not begun or not ended or BEGIN_MARK in rest or END_MARK in tail:
        raise ValueError(
            f'{page} must hold the lines {BEGIN_MARK} and {END_MARK} once, in this order'
        )
    page.write_text(head + page_section(results).rstrip('\n') + tail, encoding='utf-8')


def _short(reason: str) -> str:
    parts = [part for part in reason.split('; ') if not part.startswith('stop commanding ')]
    return '; '.join(part.split(':')[0] for part in parts)


def _length(metres: float) -> str:
    return f'{100.0 * metres:.1f} cm' if metres < 1.0 else f'{metres:.2f} m'


def _degrees(angle: float) -> str:
    return f'{math.degrees(angle):.1f}°'
