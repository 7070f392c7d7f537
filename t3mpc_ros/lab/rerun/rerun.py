# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The recorded inputs through the controller as it is today: no clock, as fast as it goes."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.controller import Controller, ControllerSettings, Status
from t3mpc_ros.control.freshness import Reason
from t3mpc_ros.control.law import TERMS
from t3mpc_ros.lab.report.topics import WHEELS
from t3mpc_ros.lab.rerun.inputs import FIELDS, PAIRS, SPEEDS, Inputs, Life, motions
from t3mpc_ros.motion import BodyTwist, Motion
from t3mpc_ros.motion.words import STANDSTILL
from t3mpc_ros.record.run.journal import Event

Array = NDArray[np.float64]

_STEP = int(Event.STEP)  # an enumeration is slower to compare
_CERTIFICATE = attrgetter('certificate')
BLOCK = 4096
"""Steps after which what was collected is put into arrays."""
OPEN_LOOP = (
    'open loop: the robot is the recorded one, which was driven by the recorded commands; it does '
    'not answer to other ones'
)
"""What has to be said of every rerun that is not made as the run was."""


@dataclass(frozen=True)
class Rerun:
    """What the controller answered, a row an event as in :class:`Inputs`; NaN where nothing."""

    fields: Mapping[str, Array]
    """By :data:`~t3mpc_ros.lab.rerun.inputs.FIELDS`, or some of them, shape (n,) each."""
    reasons: tuple[Reason | None, ...]
    """Why the robot moved or did not; None at rows that are no step and no silence."""
    steps: int
    settings: ControllerSettings
    """At the end."""
    changed: Mapping[str, object]
    """Settings that were given in place of the recorded ones."""


def rerun(inputs: Inputs, changes: Mapping[str, object] | None = None) -> Rerun:
    """Return what today's controller makes of recorded inputs.

    Parameters
    ----------
    inputs
        Of the run.
    changes
        Settings by flat name that differ from the recorded ones, all through the run.

    Raises
    ------
    SettingError
        A changed setting is unknown or cannot be used.
    ValueError
        A model does not fit the settings.
    """
    collected = _Collected(inputs.events.size)
    settings = ControllerSettings()
    odometry, references = motions(inputs.odometry), motions(inputs.references)
    for life in inputs.lives:
        controller = _start(life, changes or {})
        _live(controller, life, changes or {}, odometry, references, collected)
        settings = controller.settings
    collected.settle()
    return Rerun(
        collected.fields(),
        tuple(collected.reasons),
        collected.steps,
        settings,
        dict(changes or {}),
    )


def _start(life: Life, changes: Mapping[str, object]) -> Controller:
    """Return a controller as the node makes it."""
    controller = Controller(life.settings[life.start].changed(changes))
    controller.warm_up()
    if life.model is not None:
        controller.law.restore(life.model)
    return controller


def _live(
    controller: Controller,
    life: Life,
    changes: Mapping[str, object],
    odometry: list[Motion],
    references: list[Motion],
    collected: '_Collected',
) -> None:
    """Let the events of one life happen."""
    taken = life.taken
    add, step = controller.add_reference, controller.step
    tell, rows = collected.answers.append, collected.rows.append
    table = zip(
        range(life.first, life.first + len(life.rows)),
        life.events.tolist(),
        taken.odometry.tolist(),
        taken.begin.tolist(),
        taken.end.tolist(),
        life.rows[:, 4].tolist(),
        strict=True,
    )
    for row, event, heard, begin, end, value in table:
        while begin < end:
            add(references[begin])
            begin += 1
        if event == _STEP:
            if heard >= 0:
                tell(step(odometry[heard]))
                rows(row)
        elif event == Event.SILENT:
            controller.silent(None, 0)
            tell((STANDSTILL, controller.status))
            rows(row)
        elif event == Event.FINISH:
            tell((STANDSTILL, controller.status))
            rows(row)
        elif event == Event.CONFIGURE:
            if value in life.settings:
                controller.configure(life.settings[value].changed(changes))
        elif event == Event.RESET:
            controller.enable(bool(value))
            controller.reset()
        elif event == Event.ENABLE:
            controller.enable(bool(value))
        if not row % BLOCK:
            collected.settle()


class _Collected:
    """Answers, put into arrays now and then: one array operation costs more than a step of it."""

    def __init__(self, count: int) -> None:
        self._speeds = np.full((count, len(SPEEDS)), np.nan)
        self._pairs = {name: np.full((count, 2), np.nan) for name in PAIRS}
        self._terms = np.full((count, len(TERMS), 2), np.nan)
        self._lyapunov = np.full((count, 2), np.nan)
        self.reasons: list[Reason | None] = [None] * count
        self.steps = 0
        self.rows: list[int] = []
        self.answers: list[tuple[BodyTwist, Status]] = []

    def settle(self) -> None:
        """Put what was collected into the arrays."""
        if not self.rows:
            return
        rows = np.array(self.rows)
        commands, statuses = zip(*self.answers, strict=True)
        flat = chain.from_iterable
        self._speeds[rows] = np.fromiter(flat(commands), np.float64).reshape(-1, len(SPEEDS))
        for name in ('error', 'estimate', 'skill', 'applied'):
            found = np.concatenate(list(map(attrgetter(name), statuses)))
            name = f'terms/{name}' if name == 'applied' else name
            self._pairs[name][rows] = found.reshape(-1, 2)
        terms = np.concatenate(list(map(attrgetter('terms'), statuses)))
        self._terms[rows] = terms.reshape(-1, len(TERMS), 2)
        readings = map(attrgetter('value', 'bound', 'rate'), map(_CERTIFICATE, statuses))
        value, bound, rate = np.fromiter(flat(readings), np.float64).reshape(-1, 3).T
        self._lyapunov[rows] = np.stack([value, bound - rate], axis=1)
        for row, status in zip(self.rows, statuses, strict=True):
            self.reasons[row] = status.reason
        self.steps += len(self.rows)
        self.rows.clear()
        self.answers.clear()

    def fields(self) -> dict[str, Array]:
        """Return the arrays by name."""
        for k, term in enumerate(TERMS):
            self._pairs[f'terms/{term}'] = self._terms[:, k]
        columns = [*self._speeds.T]
        columns += [self._pairs[name][:, z] for name in PAIRS for z in range(len(WHEELS))]
        columns += [*self._lyapunov.T]
        return {
            name: np.ascontiguousarray(column)
            for name, column in zip(FIELDS, columns, strict=True)
        }
