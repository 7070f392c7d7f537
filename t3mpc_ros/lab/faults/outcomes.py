# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What becomes of the closed loop under each named fault, measured run by run.

Every fault comes while the controller drives the twin, lasts, and goes; the same run without it
is what its errors are compared with. What the robot can know of the fault is kept apart from
what only ground truth shows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.lab.faults.closed_loop import (
    TwinRecord,
    chaotic_course,
    loop_controller,
    loop_robot,
    run_twin,
    straight_course,
)
from t3mpc_ros.lab.faults.verdict import (
    AFTER,
    BEGIN,
    Outcome,
    judge,
    reasons,
    time_to_return,
    wheel_error,
)
from t3mpc_ros.lab.paper.campaign import Progress
from t3mpc_ros.robot.twin.faults import FaultEvent, FaultSchedule, FaultSettings, active
from t3mpc_ros.robot.twin.settings import TwinSettings
from t3mpc_ros.settings.table import Value

Array = NDArray[np.float64]

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
class Trial:
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


def _trials() -> tuple[Trial, ...]:
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
                (name,) = active(FaultSettings().changed({fault: value}))
                trials.append(Trial(name, course, FaultEvent(BEGIN, fault, value, duration)))
    trials.append(Trial('collision, head-on', 'straight', None, 'room', 25.0))
    trials.append(Trial('collision, at a slant', 'arc', None, 'room', 25.0))
    return tuple(trials)


TRIALS = _trials()
"""Every run, those of one course together."""


def outcomes(trials: Sequence[Trial], progress: Progress | None = None) -> list[Outcome]:
    """Return what becomes of each trial; ``progress`` is told how far it is."""
    if progress is not None:
        progress.begin(len(trials))
    results = []
    for trial in trials:
        results.append(outcome(trial))
        if progress is not None:
            progress.done(len(results))
    return results


def outcome(trial: Trial) -> Outcome:
    """Return what becomes of the closed loop in one trial.

    If the robot stands at last, the run is repeated with a person who pauses the controller.
    """
    settings = loop_robot(trial.world)
    record = _run(trial, settings)
    healthy = undisturbed(trial.course, trial.duration)
    begin, end = _span(trial, record, settings)
    result = judge(trial.name, trial.course, record, healthy, begin, end, settings)
    if result.verdict == 'stops' and result.goes_on == 'not' and trial.event is not None:
        again, wait = end + PAUSE[0], PAUSE[1]
        paused = _run(trial, settings, ((again, again + wait),))
        told = reasons(paused, again + wait + AFTER)
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
    return _run(Trial('none', course, None, '', duration), loop_robot())


def _run(
    trial: Trial, settings: TwinSettings, pauses: tuple[tuple[float, float], ...] = ()
) -> TwinRecord:
    return run_twin(
        settings,
        loop_controller(),
        _course(trial.course, trial.duration),
        trial.duration,
        trial.schedule,
        pauses,
    )


@cache
def _course(name: str, duration: float) -> Array:
    return COURSES[name](duration)


def _span(trial: Trial, record: TwinRecord, settings: TwinSettings) -> tuple[float, float]:
    """Return when what goes wrong begins and ends, s."""
    if trial.event is None:
        touches = record.push > 0.0
        return float(record.time[np.argmax(touches)] if touches.any() else 0.0), trial.duration
    away = settings.boot_time if trial.event.fault == 'brown_out' else 0.0
    return trial.event.at, trial.event.until + away
