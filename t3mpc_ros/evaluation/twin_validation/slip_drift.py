# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Yaw drift under wheel slip, with the gyro and by the wheels alone."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.reporting import EMPTY_CELL, Table, progress_bar
from t3mpc_ros.evaluation.twin_validation.courses import (
    Course,
    Slip,
    gyro_limit,
    place_error,
    spin,
    umbmark,
    yaw_drift,
)
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultEvent

PART = 0.2
"""The gyro shall leave no more than this part of the drift that steps alone have."""
LONGEST = 100.0
"""s after which no slip event starts; no course here takes as long."""

NO_SLIP = Slip('no slip', 'slippery', 1.0, 1e9, 0.0)
SLIPS = (
    Slip('grip lost to 20 %', 'slippery', 0.2, 2.0, 0.5),
    Slip('grip lost to 10 %', 'slippery', 0.1, 2.0, 0.5),
    Slip('grip lost to 5 %', 'slippery', 0.05, 2.0, 0.5),
    Slip('wheel held every 30 s', 'wheel_blocked', 1.0, 30.0, 0.2),
    Slip('wheel held every 15 s', 'wheel_blocked', 1.0, 15.0, 0.2),
    Slip('wheel held every 7.5 s', 'wheel_blocked', 1.0, 7.5, 0.2),
)
"""Two kinds of slip, each in three strengths.

With the default grip of 0.6 a slip event leaves 0.12, 0.06 or 0.03: wet floor, oil, ice. To speed
up by 30 rad/s² takes 0.13 straight ahead, and 0.36 on the spot because of the body's inertia.
A wheel that is held, by a cable say, stops its motor, which loses steps until the next halt, and
lets the robot turn about that wheel.
"""

COURSES: dict[str, Callable[..., Course]] = {
    'square ccw': lambda parameters, events: umbmark(parameters, False, events),
    'square cw': lambda parameters, events: umbmark(parameters, True, events),
    '10 turns': lambda parameters, events: spin(parameters, 10, events),
}


class Drift(NamedTuple):
    """Yaw errors of one course."""

    course: str
    slip: str
    seed: int
    steps: float
    """rad, of the steps alone"""
    fused: float
    """rad, with the gyro"""
    limit: float
    """rad that the gyro's own errors may come to, see ``gyro_limit``"""
    steps_place: float
    """m that the end is off by the steps alone"""
    fused_place: float
    """m, with the gyro"""
    slid: float
    """m that the tyres have slid, the mean of both"""
    lost: int
    """Full steps lost by both motors."""
    detected: float
    """s during which the robot reported slip"""

    @property
    def holds(self) -> bool:
        """Whether the gyro leaves at most :data:`PART` of the drift."""
        return abs(self.fused) <= PART * abs(self.steps)


def robot(seed: int) -> DigitalTwinParameters:
    """Return the robot that drives the courses: all defaults, but it does not stop for slip."""
    return DigitalTwinParameters.from_dict({'seed': seed, 'slip_stop': 0.0})


def slip_events(name: str, slip: Slip, seed: int) -> tuple[FaultEvent, ...]:
    """Return the slip events of a course; they depend on every argument."""
    numbers = [seed, list(COURSES).index(name), *slip.name.encode()]
    return slip.slip_events(np.random.default_rng(numbers), LONGEST)


def drive_course(name: str, slip: Slip, seed: int) -> Course:
    """Return one of :data:`COURSES` under ``slip``, driven by :func:`robot`."""
    return COURSES[name](robot(seed), slip_events(name, slip, seed))


def measure_drift(
    course: Course, slip: Slip, seed: int, parameters: DigitalTwinParameters
) -> Drift:
    """Return the figures of a course."""
    return Drift(
        course=course.name,
        slip=slip.name,
        seed=seed,
        steps=yaw_drift(course, by_steps=True),
        fused=yaw_drift(course),
        limit=gyro_limit(parameters, course),
        steps_place=place_error(course, by_steps=True),
        fused_place=place_error(course),
        slid=0.5 * sum(course.slid),
        lost=sum(map(abs, course.lost_steps)),
        detected=course.detected,
    )


def measure_drifts(
    seeds: Sequence[int],
    slips: Sequence[Slip],
    courses: Sequence[str] = tuple(COURSES),
    *,
    progress: bool = False,
) -> list[Drift]:
    """Return every course under every slip with every seed."""
    found = []
    runs = [(name, slip, seed) for name in courses for slip in slips for seed in seeds]
    with progress_bar(len(runs), show=progress) as bar:
        for name, slip, seed in runs:
            course = drive_course(name, slip, seed)
            found.append(measure_drift(course, slip, seed, robot(seed)))
            bar.update()
    return found


def select_drifts(found: Iterable[Drift], course: str, slip: str) -> list[Drift]:
    """Return those of one course under one slip."""
    return [drift for drift in found if drift.course == course and drift.slip == slip]


def holds_from(found: Iterable[Drift]) -> float:
    """Return the drift by steps (rad) from which on the gyro always leaves a fifth or less.

    That of the largest drift for which it does not; 0 when it always does.
    """
    return max((abs(drift.steps) for drift in found if not drift.holds), default=0.0)


def drift_table(found: Sequence[Drift]) -> Table:
    """Return a row for each course and slip."""
    rows = []
    for course in dict.fromkeys(drift.course for drift in found):
        for slip in dict.fromkeys(drift.slip for drift in found):
            members = select_drifts(found, course, slip)
            if not members:
                continue
            steps = rms([drift.steps for drift in members])
            fused = rms([drift.fused for drift in members])
            slips = slip != NO_SLIP.name
            rows.append(
                (
                    course,
                    slip,
                    f'{np.degrees(steps):.1f}',
                    f'{np.degrees(fused):.1f}',
                    f'{fused / steps:.3f}' if slips else EMPTY_CELL,
                    f'{sum(d.holds for d in members)} of {len(members)}' if slips else EMPTY_CELL,
                    f'{rms([d.steps_place for d in members]):.2f}',
                    f'{rms([d.fused_place for d in members]):.2f}',
                    f'{np.mean([d.slid for d in members]):.2f}',
                    f'{np.mean([d.lost for d in members]):.0f}',
                )
            )
    return Table(
        'Errors at the end of a course, root mean square over the seeds',
        (
            'course', 'slip', 'yaw by steps / deg', 'with gyro / deg', 'ratio',
            'at most 1/5', 'place by steps / m', 'with gyro / m', 'slid / m', 'lost steps',
        ),
        rows,
    )  # fmt: skip
