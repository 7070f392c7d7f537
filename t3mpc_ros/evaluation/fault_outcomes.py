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
"""Outcome of the closed loop under each named fault.

Every fault begins and ends while the controller drives the twin; its errors are compared with the
same run without the fault. What the robot can detect is kept apart from what only ground truth
shows.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache, lru_cache
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation import html_page, result_output
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Row, Run, run_experiment
from t3mpc_ros.evaluation.loop import NodeMethod, run
from t3mpc_ros.evaluation.method_table import FULL
from t3mpc_ros.evaluation.run_record import RATE, STATUS_FLAGS, Record, rolling_speeds
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
from t3mpc_ros.simulation.fault_injection import FaultParameters, active_faults
from t3mpc_ros.simulation.fault_schedule import FaultEvent

BEGIN = 10.0
"""Begin of every fault, s."""
SETTLED = 3.0
"""Errors count from here, s."""
AFTER = 2.0
"""Time after the end of a fault, and of the last stop, before the error after it counts, s."""
ALLOWED = 1.5
"""Ratio to the error without the fault up to which an error counts as recovered."""
REST = 4.0
"""Shortest time over which an error can count as recovered, s."""
BRAKING_TIME = 0.6
"""Time after a stop reason by which the robot must stand still, s."""
ODOMETRY_WRONG = 'odometry is wrong'
"""Effect that only ground truth shows: its pose is off by more than without the fault."""
METHOD = NodeMethod(FULL, {})


def evaluate_outcome(
    record: Record,
    undisturbed_run: Record,
    begin: float,
    end: float,
    parameters: DigitalTwinParameters,
) -> Row:
    """Return the outcome of a recorded run, beside the same one without the fault.

    ``verdict``: ``bounded``, the robot stays within its limits and the error recovers; ``stops``,
    it stops with a reason; ``impaired``, within limits, but the error remains; ``unbounded``
    otherwise. ``reason`` of the stop, or the violated bound; ``stopped_for``, time with a stop
    reason (s); ``resumption``: ``by itself``, ``not``, or '' without a stop.

    ``before``, ``during``, ``after``: root mean square error of the speeds of both wheels (rad/s),
    the last one None if the robot stands at the end or the fault lasts; ``recovery_time`` from the
    end of the fault until the error stays recovered (s), None if it does not; ``odometry_before``
    the fault and ``odometry_after``, at the end of the run: its error (m, rad).

    ``detected``: signs that robot or controller show; ``ranges`` before and at a wall, which the
    loop does not use; ``undetected``: effects that only ground truth shows. ``end`` of the fault
    may lie beyond the record.
    """
    last = float(record.time[-1])
    stays = end >= last
    during = begin, min(end, last)
    reasons = stop_reasons(record, begin)
    stopped = bool(record.robot_reasons[-1] or record.driver_reasons[-1])
    resumed = max(end, float(np.max(record.time[record.stopped], initial=0.0)))
    recovery_time = None if stays or stopped else time_to_return(record, undisturbed_run, end)
    violation = _bound_violation(record, begin, parameters)
    if violation:
        verdict = 'unbounded'
    elif reasons:
        verdict = 'stops'
    else:
        verdict = 'bounded' if stays or recovery_time is not None else 'impaired'
    off = _odometry_error(record, last)
    return {
        'verdict': verdict,
        'reason': violation or '; '.join(reasons),
        'stopped_for': sum(reasons.values()),
        'resumption': ('not' if stopped else 'by itself') if reasons else '',
        'before': wheel_error(record, SETTLED, begin),
        'during': wheel_error(record, begin, end),
        'after': None if stays or stopped else wheel_error(record, resumed + AFTER, last),
        'recovery_time': recovery_time,
        'odometry_before': _odometry_error(record, begin),
        'odometry_after': off,
        'detected': _detected(record, undisturbed_run, *during),
        'ranges': _ranges(record, *during),
        'undetected': _undetected(record, *during, off, _odometry_error(undisturbed_run, last)),
    }


def time_to_return(record: Record, undisturbed_run: Record, end: float) -> float | None:
    """Return the time (s) from ``end`` until the wheel error stays recovered; None if it does not.

    It has recovered if from then on to the end it is at most :data:`ALLOWED` times the error of
    the run without the fault, in the same time or before the fault, whichever is larger.
    """
    errors = record.error, undisturbed_run.error
    usual = rms(errors[1][undisturbed_run.rows(SETTLED, BEGIN)])
    last = float(record.time[-1])
    for wait in np.arange(0.0, last - REST - end, 0.5).tolist():
        mine, other = (rms(error[record.rows(end + wait, last)]) for error in errors)
        if mine <= ALLOWED * max(usual, other):
            return float(wait)
    return None


def wheel_error(record: Record, begin: float, end: float) -> float:
    """Return the error (rad/s) of the rotors from ``begin`` to ``end`` (s)."""
    return rms(record.error[record.rows(begin, end)])


def _odometry_error(record: Record, time: float) -> list[float]:
    """Return the odometry error (m, rad) just before ``time`` (s)."""
    row = record.rows(time, time + 1.0).start - 1
    x, y, yaw = (record['odometry'][row] - record['truth'][row]).tolist()
    return [float(np.hypot(x, y)), abs(wrap_angle(yaw))]


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


def _detected(record: Record, undisturbed_run: Record, begin: float, end: float) -> list[str]:
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
    return found


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
    record: Record, begin: float, end: float, off: Sequence[float], usual: Sequence[float]
) -> list[str]:
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
        found.append(ODOMETRY_WRONG)
    return found


DURATION = 40.0
"""s; length of a run."""


def straight_course(duration: float, turn: float = 0.0) -> SampledReference:
    """Return 0.2 m/s straight ahead, or turning (rad/s)."""
    wheels = wheels_from_twist(BodyTwist(0.2, turn), WheelGeometry())
    return sampled_speeds(np.tile(wheels, (round((duration + LEAD) * RATE) + 1, 1)))


QUIET = 25
"""Seed whose wheels jump by 0.5 rad/s only at the switch beside the faults: it hides none."""
REFERENCE_COURSES: Mapping[str, Callable[[float], SampledReference]] = {
    'chaotic': lambda duration: Scenario('servo', 'nominal', QUIET, duration).reference(),
    'straight': straight_course,
    'arc': lambda duration: straight_course(duration, turn=-0.06),
}
"""Reference courses by name."""


@dataclass(frozen=True, slots=True)
class FaultRun:
    """One run of the study: a course with a fault, or with a wall at its end."""

    name: str
    course: str
    """One of :data:`REFERENCE_COURSES`."""
    event: FaultEvent | None
    """None for a wall instead of a fault."""
    world: str = ''
    duration: float = DURATION

    @property
    def fault(self) -> str:
        """The name of the fault, ``collision`` for a wall."""
        return 'collision' if self.event is None else self.event.fault

    def scenario(self) -> Scenario:
        """Return the run on the twin."""
        own = OwnParts(
            reference=_course(self.course, self.duration),
            events=() if self.event is None else (self.event,),
            robot_parameters={'world': self.world},
        )
        return Scenario('twin', 'nominal', 1, self.duration, own=own)


STRENGTHS: Mapping[str, tuple[Value, ...]] = {
    'command_delay': (0.05, 0.1, 0.2, 0.3),
    'command_jitter': (0.05, 0.2),
    'command_loss': (0.1, 0.3, 0.9, 1.0),
    'gyro_bias_jump': (0.02, 0.35),
    'gyro_dead': (True,),
    'ranges_dead': (True,),
    'wheel_blocked': ('right', 'both'),
    'load_change': (1.0, 3.0, -0.5),
    'slippery': (0.3, 0.05, 0.0),
    'supply_sag': (2.0, 5.0),
    'brown_out': (True,),
}
"""Values of each fault."""


def fault_run(course: str, fault: str, value: Value) -> FaultRun:
    """Return the run of a fault on a course."""
    (name,) = active_faults(FaultParameters().with_values({fault: value}))
    lasts = 0.1 if fault == 'brown_out' else 5.0
    return FaultRun(name, course, FaultEvent(BEGIN, fault, value, lasts))


FAULT_RUNS = (
    *(
        fault_run(course, fault, value)
        for course in ('chaotic', 'straight')
        for fault, values in STRENGTHS.items()
        for value in values
    ),
    FaultRun('collision, head-on', 'straight', None, 'room', 25.0),
    FaultRun('collision, at a slant', 'arc', None, 'room', 25.0),
)
"""Every run, grouped by course."""


def study_faults(
    fault_runs: Sequence[FaultRun], workers: int | Executor = 1, report: Report | None = None
) -> ResultTable:
    """Return the outcome of each run by ``name`` and ``course``, see :func:`evaluate_outcome`."""
    runs = [Run((each, METHOD), {'name': each.name, 'course': each.course}) for each in fault_runs]
    return run_experiment(runs, measured_fault, workers, report=report)


def measured_fault(job: tuple[FaultRun, NodeMethod]) -> Row:
    """Return the outcome of the closed loop in one run."""
    trial, _ = job
    event = trial.event
    parameters = trial.scenario().true_robot()
    assert isinstance(parameters, DigitalTwinParameters)
    record = run(trial.scenario(), METHOD)
    undisturbed_run = undisturbed(trial.course, trial.duration)
    if event is None:
        touches = record['contact_force'] > 0.0
        begin = float(record.time[np.argmax(touches)] if touches.any() else 0.0)
        end = trial.duration
    else:
        begin = event.at
        end = event.until + (parameters.boot_time if event.fault == 'brown_out' else 0.0)
    return evaluate_outcome(record, undisturbed_run, begin, end, parameters)


@lru_cache(maxsize=8)
def undisturbed(course: str, duration: float) -> Record:
    """Return the run on a course without fault and walls."""
    return run(FaultRun('none', course, None, '', duration).scenario(), METHOD)


@cache
def _course(name: str, duration: float) -> SampledReference:
    return REFERENCE_COURSES[name](duration)


# -- lines, tables of docs/faults.md, and HTML page -----------------------------------------------


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
_ENDINGS = {
    'bounded': 'stay within the limits and recover',
    'stops': 'stop the robot with a reason',
    'impaired': 'stay within the limits, but the error remains',
    'unbounded': 'exceed a limit',
}


def outcome_sentence(row: Row) -> str:
    """Return the outcome in words."""
    if row['verdict'] == 'unbounded':
        return f'unbounded: {row["reason"]}'
    if row['verdict'] == 'impaired':
        return 'within limits, but error not recovered'
    time = row['recovery_time']
    recovery = 'not recovered' if time is None else f'recovered after {time:g} s'
    recovery = 'error ' + ('recovered at once' if time == 0.0 else recovery)
    if row['verdict'] == 'bounded':
        return 'bounded' + ('' if row['after'] is None else f', {recovery}')
    text = f'stops: {_short(row["reason"])}'
    if row['resumption'] == 'by itself':
        return f'{text}, for {row["stopped_for"]:.1f} s; resumes by itself, {recovery}'
    return f'{text}, and remains stopped'


def hidden(row: Row) -> bool:
    """Return whether only ground truth shows an effect."""
    return bool(row['undetected'] and not row['detected'])


def table_row(row: Row) -> tuple[str, ...]:
    """Return the cells of a table."""
    after = result_output.EMPTY_CELL if row['after'] is None else f'{row["after"]:.2f}'
    undetected = ', '.join(row['undetected']) or result_output.EMPTY_CELL
    if hidden(row):
        undetected = (UNREPORTED if row['ranges'] else UNDETECTED) + undetected
    return (
        f'`{row["name"]}`',
        outcome_sentence(row),
        f'{row["before"]:.2f}, {row["during"]:.2f}, {after}',
        f'{_place(*row["odometry_before"])}; {_place(*row["odometry_after"])}',
        ', '.join(filter(None, [*row['detected'], row['ranges']])) or result_output.EMPTY_CELL,
        undetected,
    )


def by_course(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Return title and rows of each course that was driven."""
    found = [(title, [row for row in rows if row['course'] == course])
             for course, title in TITLES.items()]  # fmt: skip
    return [(title, chosen) for title, chosen in found if chosen]


def markdown_tables(rows: Sequence[Row]) -> str:
    """Return a table for each course, one row for each outcome."""
    tables = [
        (title, result_output.Table('', TABLE_HEAD, [*map(table_row, chosen)]))
        for title, chosen in by_course(rows)
    ]
    return '\n'.join(f'### {title}\n\n{table.markdown()}\n' for title, table in tables)


def console_text(rows: Sequence[Row]) -> str:
    """Return the outcomes for a terminal, one line each."""
    lines = []
    for title, chosen in by_course(rows):
        lines.append(f'{title}:')
        for row in chosen:
            note = ' (not detected by the robot)' if hidden(row) else ''
            lines.append(f'  {row["name"]:24} {outcome_sentence(row)}{note}')
    return '\n'.join(lines)


def page_section(rows: Sequence[Row]) -> str:
    """Return the section of the page between the marks."""
    return f"""

The controller drives the twin. Each fault begins at {BEGIN:g} s and lasts 5 s; `brown_out`
restarts the board, which takes 0.5 s. A run lasts {DURATION:g} s, one into a wall 25 s, of which
the robot needs 11 s to get there.

Errors are root mean squares over both wheels, of rotor speed against reference:
from 3 s on before the fault, during it, and from 2 s after it and the last stop to the end. The
error has *recovered* when the rest of the run is no worse than {ALLOWED:g} times the same run
without the fault.

Ground truth shows full steps lost by the right and the left motor at most, and how much
faster (root mean square) the wheels turn than they roll.

{markdown_tables(rows)}
"""


def update_page(page: Path, rows: Sequence[Row]) -> None:
    """Replace the section between the marks of a page."""
    result_output.replace_section(page, BEGIN_MARK, END_MARK, page_section(rows))


def _short(reason: str) -> str:
    parts = [part for part in reason.split('; ') if not part.startswith('stop commanding ')]
    return '; '.join(part.split(':')[0] for part in parts)


def _place(metres: float, angle: float) -> str:
    length = f'{100.0 * metres:.1f} cm' if metres < 1.0 else f'{metres:.2f} m'
    return f'{length}, {math.degrees(angle):.1f}°'


def page(rows: Sequence[Row]) -> str:
    """Return the page as self-contained HTML."""
    from t3mpc_ros.evaluation.figure_style import drawing, file_of  # a run does without them

    blocks: list[html_page.Block] = [_verdict(rows)]
    for number, (title, chosen) in enumerate(by_course(rows)):
        worst = max(chosen, key=lambda row: row['during'])
        seen = (
            f'{title}: error of the wheels before, during and after each fault; the largest '
            f'during one is {worst["during"]:.2f} rad/s, of {worst["name"]}.'
        )
        blocks.append(html_page.Heading(title))
        if figure := drawing(_draw_errors, chosen):
            blocks.append(html_page.Picture(seen, file_of(figure, 'svg'), seen))
        if number == 0:
            blocks.append(html_page.Contents())
        cells = [[cell.replace('`', '').replace('**', '') for cell in table_row(row)]
                 for row in chosen]  # fmt: skip
        blocks.append(result_output.Table('', TABLE_HEAD, cells, text=len(TABLE_HEAD), wrap=True))
    return html_page.html_page('Fault study of the closed loop', blocks)


def _verdict(rows: Sequence[Row]) -> html_page.VerdictBox:
    """Return how many faults end in which way."""
    count = Counter(row['verdict'] for row in rows)
    reasons = [f'{count[kind]} {text}.' for kind, text in _ENDINGS.items() if count[kind]]
    if names := sorted({row['name'] for row in rows if hidden(row)}):
        reasons.append(f'Not detected by robot or controller: {", ".join(names)}.')
    if count['unbounded']:
        beyond = '; '.join(map(_run_name, [row for row in rows if row['verdict'] == 'unbounded']))
        return html_page.VerdictBox(f'Not every fault stays bounded: {beyond}', reasons, 'bad')
    lost = [row for row in rows if ODOMETRY_WRONG in row['undetected']]
    if not lost:
        return html_page.VerdictBox('Every fault stays bounded', reasons, 'good')
    worst = max(lost, key=lambda row: row['odometry_after'][0])
    headline = (
        f'Every fault stays within the limits, but the odometry is wrong at the end of '
        f'{len(lost)} of {len(rows)} runs, by up to {_place(*worst["odometry_after"])} '
        f'({_run_name(worst)})'
    )
    return html_page.VerdictBox(headline, reasons, 'open')


def _run_name(row: Row) -> str:
    """Return fault and course of a run, as its table names them."""
    title = TITLES[row['course']]
    return f'{row["name"]}, {title[0].lower()}{title[1:]}'


def _draw_errors(rows: Sequence[Row]) -> Any:
    """Return a figure of the errors of each fault."""
    from t3mpc_ros.evaluation.figure_style import COLOURS, legend_above, new_figure, scale_by_size

    colours = {'before': '#6b7280', 'during': COLOURS['error'], 'after': COLOURS['applied']}
    figure, axis = new_figure(0.9 + 0.19 * len(rows))
    places = np.arange(len(rows))[::-1]
    for name, colour in colours.items():
        known = [(row[name], place) for row, place in zip(rows, places, strict=True)
                 if row[name] is not None]  # fmt: skip
        if known:
            axis.plot(*zip(*known, strict=True), 'o', color=colour, markersize=4, label=name)
    scale_by_size(axis, 'x', [row[name] for row in rows for name in colours if row[name]])
    axis.margins(y=0.5 / len(rows))
    axis.set_yticks(places, [row['name'] for row in rows])
    axis.set_xlabel('error of the wheels / (rad/s)')
    legend_above(figure, axis)
    return figure
