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

from t3mpc_ros.evaluation.reporting import Progress
from t3mpc_ros.evaluation.twin_closed_loop import (
    FINAL_STANDSTILL,
    STATUS_FLAGS,
    TwinRecord,
    chaotic_course,
    loop_controller,
    loop_robot,
    run_twin,
    straight_course,
)
from t3mpc_ros.geometry.kinematics import twist_from_wheels
from t3mpc_ros.geometry.types import WheelSpeeds, wrap_angle
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
"""s; when a fault comes."""
SETTLED = 3.0
"""s; from here the errors of a run count."""
AFTER = 2.0
"""s after the end of a fault, from which the error counts as that after it."""
ALLOWED = 1.5
"""Errors up to this many times those without the fault count as being back."""
REST = 4.0
"""s; over less than that no error is called back."""
BRAKING_TIME = 0.6
"""s; a robot that has said for so long why it stands must stand."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one trial; errors are root mean squares over time and both wheels."""

    name: str
    course: str
    verdict: str
    """``bounded``: it drives on within its limits, and the error comes back; ``stops``: it says
    why; ``impaired``: within its limits, but the error stays; ``unbounded``: none of these."""
    reason: str
    """Why it stopped, or what was out of bounds."""
    stood: float
    """s for which it said so"""
    goes_on: str
    """How it came to drive again: ``by itself``, ``after a pause`` or ``not``; '' if it drove."""
    before: float
    """Error of the wheel speeds before the fault, rad/s"""
    during: float
    after: float | None
    """None where the robot stands at last, or the fault stays."""
    back: float | None
    """s after the fault until the error is back for good; None if it never is."""
    odometry_before: tuple[float, float]
    """How far odometry is off the truth: m, rad"""
    odometry_after: tuple[float, float]
    """At the end of the run."""
    noticed: tuple[str, ...]
    """What robot or controller say of it: flags, reasons, an error that rises."""
    ranges: str
    """What the distance sensors say of a wall; nothing here acts on it."""
    unseen: tuple[str, ...]
    """What only the truth shows."""


def evaluate_outcome(
    name: str,
    course: str,
    record: TwinRecord,
    healthy: TwinRecord,
    begin: float,
    end: float,
    parameters: DigitalTwinParameters,
) -> Outcome:
    """Return the outcome that a record shows.

    Parameters
    ----------
    name, course
        What the trial is called, and what the controller was to follow.
    record, healthy
        The run, and the same one without the fault.
    begin, end
        When the fault came and went, s; beyond the record's end if it stays.
    settings
        Of the robot, for its limits.
    """
    last = float(record.time[-1])
    stays = end >= last
    told = stop_reasons(record, begin)
    stands = bool(record.robot_says[-1] or record.controller_says[-1])
    back = None if stays or stands else time_to_return(record, healthy, end)
    broken = _broken(record, begin, parameters)
    if broken:
        verdict = 'unbounded'
    elif told:
        verdict = 'stops'
    else:
        verdict = 'bounded' if stays or back is not None else 'impaired'
    goes_on = ('not' if stands else 'by itself') if told else ''
    before, after = _off(record, begin), _off(record, last)
    return Outcome(
        name=name,
        course=course,
        verdict=verdict,
        reason=broken or '; '.join(told),
        stood=sum(told.values()),
        goes_on=goes_on,
        before=wheel_error(record, SETTLED, begin),
        during=wheel_error(record, begin, end),
        after=None if stays or stands else wheel_error(record, end + AFTER, last),
        back=back,
        odometry_before=before,
        odometry_after=after,
        noticed=_noticed(record, healthy, begin, min(end, last)),
        ranges=_ranges(record, begin, min(end, last)),
        unseen=_unseen(record, begin, min(end, last), after, _off(healthy, last)),
    )


def time_to_return(record: TwinRecord, healthy: TwinRecord, end: float) -> float | None:
    """Return how long (s) after ``end`` the wheel error is back for good; None: it is not.

    It is back if from then on to the end of the run it is at most :data:`ALLOWED` times as large
    as in the run without the fault, there or before the fault, whichever is more.
    """
    errors = record.rotors - record.reference, healthy.rotors - healthy.reference
    usual = _rms(errors[1][healthy.rows(SETTLED, BEGIN)])
    last = float(record.time[-1])
    for wait in np.arange(0.0, last - REST - end, 0.5).tolist():
        mine, other = (_rms(error[record.rows(end + wait, last)]) for error in errors)
        if mine <= ALLOWED * max(usual, other):
            return float(wait)
    return None


def wheel_error(record: TwinRecord, begin: float, end: float) -> float:
    """Return the error (rad/s) of the rotors from ``begin`` to ``end`` (s)."""
    return _rms((record.rotors - record.reference)[record.rows(begin, end)])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _off(record: TwinRecord, time: float) -> tuple[float, float]:
    """Return by how much (m, rad) odometry is off the truth just before ``time`` (s)."""
    row = record.rows(time, time + 1.0).start - 1
    x, y, yaw = (record.odometry[row] - record.truth[row]).tolist()
    return float(np.hypot(x, y)), abs(wrap_angle(yaw))


def stop_reasons(record: TwinRecord, begin: float) -> dict[str, float]:
    """Return for how long (s) robot or controller said why they did not drive, by what."""
    period = float(record.time[1] - record.time[0])
    told: dict[str, float] = {}
    for row in range(record.rows(begin, begin + 1.0).start, len(record.time)):
        text = record.robot_says[row] or record.controller_says[row]
        if text:
            told[text] = told.get(text, 0.0) + period
    return told


def _broken(record: TwinRecord, begin: float, parameters: DigitalTwinParameters) -> str:
    """Return what was out of bounds; '' when nothing was."""
    limiter = parameters.limiter
    rows = slice(record.rows(FINAL_STANDSTILL, begin).start, None)
    limit = limiter.wheel_speed
    for what, speeds in (('command', record.commanded[rows]), ('wheel', record.rotors[rows])):
        fastest = float(np.max(np.abs(speeds)))
        if not fastest <= limit + 1e-6:
            return f'a {what} of {fastest:.1f} rad/s, the limit being {limit:g}'
    for right, left in record.commanded[rows].tolist():
        twist = twist_from_wheels(WheelSpeeds(right, left), parameters.geometry)
        if abs(twist.linear) > limiter.linear_speed + 1e-6:
            return f'a command of {twist.linear:.2f} m/s'
        if abs(twist.angular) > limiter.angular_speed + 1e-6:
            return f'a command of {twist.angular:.1f} rad/s about the vertical'
    since = None
    for row, text in enumerate(record.robot_says):
        since = None if not text else row if since is None else since
        if since is None or record.time[row] - record.time[since] < BRAKING_TIME:
            continue
        if np.any(record.commanded[row]):
            return f'it says that it stands, and drives ({text})'
    return ''


def _noticed(record: TwinRecord, healthy: TwinRecord, begin: float, end: float) -> tuple[str, ...]:
    """Return what robot and controller say, from the begin of the fault on."""
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
    for text in dict.fromkeys(filter(None, record.robot_says[rows])):
        said = np.array([one == text for one in record.robot_says[rows]])
        note(f'"{text.split(":")[0]}"', said)
    during = record.rows(begin, end)
    if np.isnan(record.nearest[during]).all():
        found.append('no distances')
    error = _rms((record.measured - record.reference)[during])
    usual = _rms((healthy.measured - healthy.reference)[during])
    if error > ALLOWED * usual and not any(record.robot_says[during]):
        found.append(f'tracking error {error:.2f} rad/s')
    return tuple(found)


def _ranges(record: TwinRecord, begin: float, end: float) -> str:
    """Return the nearest that was measured in the last 2 s before ``begin``, and from then on."""
    before, during = (
        record.nearest[record.rows(*span)] for span in ((begin - 2.0, begin), (begin, end))
    )
    if not np.isfinite(before).any():
        return ''
    span = ' to '.join(
        f'{one:.2f} m' if np.isfinite(one) else 'nearer than they can tell'
        for one in dict.fromkeys((np.min(during), np.max(during)))
    )
    return f'distances fall to {np.min(before[np.isfinite(before)]):.2f} m before it, then {span}'


def _unseen(
    record: TwinRecord,
    begin: float,
    end: float,
    off: tuple[float, float],
    usual: tuple[float, float],
) -> tuple[str, ...]:
    """Return what only the truth shows."""
    found = []
    rows = record.rows(begin, end)
    lost = np.abs(record.lost_steps[record.rows(begin, float(record.time[-1]))]).max(axis=0)
    if lost.any():
        found.append(f'lost steps {lost[0]}, {lost[1]}')
    slide = _rms((record.ground - record.rotors)[rows])
    if slide > 0.2:
        found.append(f'tyres slide ({slide:.1f} rad/s)')
    if off[0] > usual[0] + 0.02 or off[1] > usual[1] + 0.05:
        found.append('odometry is wrong')
    return tuple(found)


DURATION = 40.0
"""s; length of a run."""
PAUSE = (5.0, 1.0)
"""s; how long after the fault a person pauses a controller whose robot stands, for how long."""

COURSES: Mapping[str, Callable[[float], Array]] = {
    'chaotic': chaotic_course,
    'straight': straight_course,
    'arc': lambda duration: straight_course(duration, turn=-0.06),
}
"""What the controller is to follow."""


@dataclass(frozen=True, slots=True)
class FaultRun:
    """One run to be: a course, and a fault on the way or a wall at its end."""

    name: str
    course: str
    """One of :data:`COURSES`."""
    event: FaultEvent | None
    """None: what goes wrong is the world."""
    world: str = ''
    duration: float = DURATION

    @property
    def fault(self) -> str:
        """The name of the fault, ``collision`` for a wall."""
        return 'collision' if self.event is None else self.event.fault

    @property
    def schedule(self) -> FaultSchedule:
        """What the robot is to play."""
        return FaultSchedule([] if self.event is None else [self.event], self.name)


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
    trials = []
    for course in ('chaotic', 'straight'):
        for fault, values, duration in strengths:
            for value in values:
                (name,) = active_faults(FaultParameters().with_values({fault: value}))
                trials.append(FaultRun(name, course, FaultEvent(BEGIN, fault, value, duration)))
    trials.append(FaultRun('collision, head-on', 'straight', None, 'room', 25.0))
    trials.append(FaultRun('collision, at a slant', 'arc', None, 'room', 25.0))
    return tuple(trials)


FAULT_RUNS = _fault_runs()
"""Every run, those of one course together."""


def study_faults(trials: Sequence[FaultRun], progress: Progress | None = None) -> list[Outcome]:
    """Return what becomes of each trial; ``progress`` is told how far it is."""
    if progress is not None:
        progress.begin(len(trials))
    results = []
    for trial in trials:
        results.append(run_fault(trial))
        if progress is not None:
            progress.done(len(results))
    return results


def run_fault(trial: FaultRun) -> Outcome:
    """Return what becomes of the closed loop in one trial.

    If the robot stands at last, the run is repeated with a person who pauses the controller.
    """
    parameters = loop_robot(trial.world)
    record = _run(trial, parameters)
    healthy = undisturbed(trial.course, trial.duration)
    begin, end = _span(trial, record, parameters)
    result = evaluate_outcome(trial.name, trial.course, record, healthy, begin, end, parameters)
    if result.verdict == 'stops' and result.goes_on == 'not' and trial.event is not None:
        again, wait = end + PAUSE[0], PAUSE[1]
        paused = _run(trial, parameters, ((again, again + wait),))
        told = stop_reasons(paused, again + wait + AFTER)
        if not told:
            end = again + wait
            result = replace(
                result,
                goes_on='after a pause',
                after=wheel_error(paused, end + AFTER, trial.duration),
                back=time_to_return(paused, healthy, end),
            )
    return result


@lru_cache(maxsize=8)
def undisturbed(course: str, duration: float) -> TwinRecord:
    """Return the run on a course with no fault and an endless plain around it."""
    return _run(FaultRun('none', course, None, '', duration), loop_robot())


def _run(
    trial: FaultRun,
    parameters: DigitalTwinParameters,
    pauses: tuple[tuple[float, float], ...] = (),
) -> TwinRecord:
    return run_twin(
        parameters,
        loop_controller(),
        _course(trial.course, trial.duration),
        trial.duration,
        trial.schedule,
        pauses,
    )


@cache
def _course(name: str, duration: float) -> Array:
    return COURSES[name](duration)


def _span(
    trial: FaultRun, record: TwinRecord, parameters: DigitalTwinParameters
) -> tuple[float, float]:
    """Return when what goes wrong begins and ends, s."""
    if trial.event is None:
        touches = record.push > 0.0
        return float(record.time[np.argmax(touches)] if touches.any() else 0.0), trial.duration
    away = parameters.boot_time if trial.event.fault == 'brown_out' else 0.0
    return trial.event.at, trial.event.until + away


BEGIN_MARK = '<!-- outcomes: written by `t3mpc faults`, do not edit by hand -->'
END_MARK = '<!-- end of outcomes -->'

TITLES = {
    'chaotic': 'Along the chaotic reference',
    'straight': 'Straight on at 0.2 m/s',
    'arc': 'Along an arc at 0.2 m/s',
}
TABLE_HEAD = (
    '| fault | outcome | error of the wheels before, during, after (rad/s) '
    '| odometry off the truth before, at the end | what the robot can know '
    '| what only the truth shows |\n'
    '|---|---|---|---|---|---|\n'
)
UNDETECTED = '**not seen by the robot, only ground truth shows it**: '
UNREPORTED = '**no flag and no reason, the counters go on**: '


def outcome_sentence(outcome: Outcome) -> str:
    """Return what became of a trial in words."""
    back = (
        'error not back' if outcome.back is None else f'error back after {outcome.back:g} s'
        if outcome.back > 0.0 else 'error back at once'
    )  # fmt: skip
    if outcome.verdict == 'unbounded':
        return f'unbounded: {outcome.reason}'
    if outcome.verdict == 'impaired':
        return 'within limits, but error not back'
    if outcome.verdict == 'bounded':
        return 'bounded' + ('' if outcome.after is None else f', {back}')
    text = f'stops: {_short(outcome.reason)}'
    if outcome.goes_on == 'by itself':
        return f'{text}, for {outcome.stood:.1f} s; goes on by itself, {back}'
    if outcome.goes_on == 'after a pause':
        return f'{text}, until commands pause; then goes on, {back}'
    return f'{text}, and stays so'


def table_row(outcome: Outcome) -> str:
    """Return the line of a Markdown table."""
    after = '–' if outcome.after is None else f'{outcome.after:.2f}'
    before_m, before_rad = outcome.odometry_before
    after_m, after_rad = outcome.odometry_after
    unseen = ', '.join(outcome.unseen) or '–'
    if outcome.unseen and not outcome.noticed:
        unseen = (UNREPORTED if outcome.ranges else UNDETECTED) + unseen
    known = [*outcome.noticed, outcome.ranges] if outcome.ranges else outcome.noticed
    cells = (
        f'`{outcome.name}`',
        outcome_sentence(outcome),
        f'{outcome.before:.2f}, {outcome.during:.2f}, {after}',
        f'{_length(before_m)}, {_degrees(before_rad)}; {_length(after_m)}, {_degrees(after_rad)}',
        ', '.join(known) or '–',
        unseen,
    )
    return '| ' + ' | '.join(cells) + ' |\n'


def markdown_tables(results: Sequence[Outcome]) -> str:
    """Return a table for each course, one row for each outcome."""
    parts = []
    for course, title in TITLES.items():
        rows = [table_row(result) for result in results if result.course == course]
        if rows:
            parts.append(f'### {title}\n\n{TABLE_HEAD}{"".join(rows)}')
    return '\n'.join(parts)


def console_text(results: Sequence[Outcome]) -> str:
    """Return the same for a terminal, a line for each outcome."""
    lines = []
    for course, title in TITLES.items():
        chosen = [result for result in results if result.course == course]
        lines += [f'{title}:'] if chosen else []
        for result in chosen:
            hidden = ' (not noticed by the robot)' if result.unseen and not result.noticed else ''
            lines.append(f'  {result.name:24} {outcome_sentence(result)}{hidden}')
    return '\n'.join(lines)


def page_section(results: Sequence[Outcome]) -> str:
    """Return what stands in the page between the marks, these included."""
    after, pause = PAUSE
    return f"""{BEGIN_MARK}

The controller drives the twin. Each fault comes at {BEGIN:g} s and lasts 5 s; `brown_out` restarts
the board, which is then away for 0.5 s. A run lasts {DURATION:g} s, one into a wall 25 s, of which
the robot needs 11 s to get there.

Errors are root mean squares over both wheels, of the speed of the rotors against what was wanted:
from 3 s on before the fault, during it, and from 2 s after it to the end. The error is *back* when
the rest of the run is no worse than {ALLOWED:g} times the same run without the fault. Where the
robot stands until commands pause, a person pauses the controller for {pause:g} s, {after:g} s
after the fault: the error after it is then that after the pause, the odometry that of a robot
left alone.

What only the truth shows: full steps lost by the right and the left motor at most, and how much
faster (root mean square) the wheels turn than the floor goes by.

{markdown_tables(results)}
{END_MARK}
"""


def update_page(page: Path, results: Sequence[Outcome]) -> None:
    """Replace what stands between the marks of a page.

    Raises
    ------
    ValueError
        The page does not have both marks, once and in this order.
    """
    text = page.read_text(encoding='utf-8')
    head, begun, rest = text.partition(BEGIN_MARK)
    _, ended, tail = rest.partition(END_MARK)
    if not begun or not ended or BEGIN_MARK in rest or END_MARK in tail:
        raise ValueError(
            f'{page} must hold the lines {BEGIN_MARK} and {END_MARK} once, in this order'
        )
    page.write_text(head + page_section(results).rstrip('\n') + tail, encoding='utf-8')


def _short(reason: str) -> str:
    return '; '.join(
        part.split(':')[0] for part in reason.split('; ') if 'command ' not in part[:8]
    )


def _length(metres: float) -> str:
    return f'{100.0 * metres:.1f} cm' if metres < 1.0 else f'{metres:.2f} m'


def _degrees(angle: float) -> str:
    return f'{math.degrees(angle):.1f}°'
