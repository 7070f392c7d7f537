# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a run under a fault shows: whether the loop stayed bounded, or stopped, and who saw it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.lab.faults.closed_loop import FLAGS, STAND, TwinRecord
from t3mpc_ros.motion import WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels
from t3mpc_ros.motion.words import wrap_angle
from t3mpc_ros.robot.twin.settings import TwinSettings

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
BRAKING = 0.6
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


def judge(
    name: str,
    course: str,
    record: TwinRecord,
    healthy: TwinRecord,
    begin: float,
    end: float,
    settings: TwinSettings,
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
    told = reasons(record, begin)
    stands = bool(record.robot_says[-1] or record.controller_says[-1])
    back = None if stays or stands else time_to_return(record, healthy, end)
    broken = _broken(record, begin, settings)
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
    errors = record.rotors - record.wanted, healthy.rotors - healthy.wanted
    usual = _rms(errors[1][healthy.rows(SETTLED, BEGIN)])
    last = float(record.time[-1])
    for wait in np.arange(0.0, last - REST - end, 0.5).tolist():
        mine, other = (_rms(error[record.rows(end + wait, last)]) for error in errors)
        if mine <= ALLOWED * max(usual, other):
            return float(wait)
    return None


def wheel_error(record: TwinRecord, begin: float, end: float) -> float:
    """Return the error (rad/s) of the rotors from ``begin`` to ``end`` (s)."""
    return _rms((record.rotors - record.wanted)[record.rows(begin, end)])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _off(record: TwinRecord, time: float) -> tuple[float, float]:
    """Return by how much (m, rad) odometry is off the truth just before ``time`` (s)."""
    row = record.rows(time, time + 1.0).start - 1
    x, y, heading = (record.odometry[row] - record.truth[row]).tolist()
    return float(np.hypot(x, y)), abs(wrap_angle(heading))


def reasons(record: TwinRecord, begin: float) -> dict[str, float]:
    """Return for how long (s) robot or controller said why they did not drive, by what."""
    period = float(record.time[1] - record.time[0])
    told: dict[str, float] = {}
    for row in range(record.rows(begin, begin + 1.0).start, len(record.time)):
        text = record.robot_says[row] or record.controller_says[row]
        if text:
            told[text] = told.get(text, 0.0) + period
    return told


def _broken(record: TwinRecord, begin: float, settings: TwinSettings) -> str:
    """Return what was out of bounds; '' when nothing was."""
    guard = settings.guard
    rows = slice(record.rows(STAND, begin).start, None)
    limit = guard.wheel_speed
    for what, speeds in (('command', record.commanded[rows]), ('wheel', record.rotors[rows])):
        fastest = float(np.max(np.abs(speeds)))
        if not fastest <= limit + 1e-6:
            return f'a {what} of {fastest:.1f} rad/s, the limit being {limit:g}'
    for right, left in record.commanded[rows].tolist():
        twist = body_from_wheels(WheelSpeeds(right, left), settings.geometry)
        if abs(twist.linear) > guard.linear_speed + 1e-6:
            return f'a command of {twist.linear:.2f} m/s'
        if abs(twist.angular) > guard.angular_speed + 1e-6:
            return f'a command of {twist.angular:.1f} rad/s about the vertical'
    since = None
    for row, text in enumerate(record.robot_says):
        since = None if not text else row if since is None else since
        if since is None or record.time[row] - record.time[since] < BRAKING:
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

    for name in FLAGS:
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
    error = _rms((record.measured - record.wanted)[during])
    usual = _rms((healthy.measured - healthy.wanted)[during])
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
