# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recomputes recorded inputs with the current controller, offline."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.run.journal import Event
from t3mpc_ros.control.batch_replay import StepResults, replay_batch
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.bag_report.topic_roles import WHEELS
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    FIELDS,
    PAIRS,
    ControllerInputs,
    ControllerSession,
    motions,
)
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, StateArray

Array = NDArray[np.float64]

_STEP = int(Event.STEP)  # an enumeration is slower to compare
OPEN_LOOP = (
    'open loop: the robot is the recorded one, driven by the recorded commands; it does '
    'not respond to other ones'
)
"""Remark on every replay with changes."""


@dataclass(frozen=True)
class ReplayResult:
    """Outputs of a replay, one row per event as in :class:`Inputs`; NaN where none."""

    fields: Mapping[str, Array]
    """Outputs by field name (``controller_inputs.FIELDS``), or some of them, shape (n,) each."""
    reasons: tuple[Reason | None, ...]
    """Stop reasons; None at rows that are neither a step nor a timeout."""
    steps: int
    plain: int
    """Number of steps computed in compiled batches, see :func:`replay_batch`."""
    parameters: ControllerParameters
    """Parameters at the end."""
    changed: Mapping[str, object]
    """Parameters that replaced the recorded ones."""


def replay_controller(
    inputs: ControllerInputs,
    changes: Mapping[str, object] | None = None,
    controllers: Sequence[Controller] | None = None,
) -> ReplayResult:
    """Return the outputs of today's controller for recorded inputs.

    Parameters
    ----------
    inputs
        Recorded inputs.
    changes
        Parameters by name that replace the recorded ones throughout the run.
    controllers
        Controllers made by :func:`make_controllers`; consumed by the call.

    Raises
    ------
    ParameterError
        A changed parameter is unknown or invalid.
    ValueError
        A model does not fit the parameters.
    """
    changes = changes or {}
    controllers = make_controllers(inputs, changes) if controllers is None else controllers
    answers = StepResults.empty(inputs.events.size)
    odometry, references = motions(inputs.odometry), motions(inputs.references)
    parameters = ControllerParameters()
    plain = 0
    for life, controller in zip(inputs.lives, controllers, strict=True):
        own = answers.part(life.first, life.first + len(life.rows))
        plain += _replay_session(controller, life, changes, odometry, references, own)
        parameters = controller.parameters
    reasons = tuple(answers.reasons.tolist())
    steps = len(reasons) - reasons.count(None)
    return ReplayResult(_fields(answers), reasons, steps, plain, parameters, dict(changes))


def make_controllers(
    inputs: ControllerInputs, changes: Mapping[str, object] | None = None
) -> list[Controller]:
    """Return one compiled controller for each recorded life, initialised as its node did.

    Raises
    ------
    ParameterError, ValueError
        See :func:`replay_controller`.
    """
    controllers = []
    for life in inputs.lives:
        controller = Controller(life.parameters[life.start].with_values(changes or {}))
        controller.warm_up()
        if life.model is not None:
            controller.law.set_weights(life.model)
        controllers.append(controller)
    if controllers:
        _compile_batch_kernels(controllers[0].parameters)
    return controllers


def _compile_batch_kernels(parameters: ControllerParameters) -> None:
    """Compile the batch kernels too, with a robot at standstill."""
    count = 20
    stamps = np.arange(1, count + 1) * round(NANOSECONDS / parameters.rate)
    standing = StateArray(stamps, np.zeros((count, 3)), np.zeros((count, 2)))
    rows = np.zeros((count, 3), dtype=np.int64)
    rows[:, 0] = np.arange(count)
    rows[0, 2], rows[1:, 1:] = count, count
    replay_batch(Controller(parameters), standing, standing, rows, StepResults.empty(count))


def _replay_session(
    controller: Controller,
    life: ControllerSession,
    changes: Mapping[str, object],
    odometry: StateArray,
    references: StateArray,
    answers: StepResults,
) -> int:
    """Process the events of one life; return the number of steps computed in batches."""
    taken, events = life.taken, life.events
    rows = np.stack([taken.odometry, taken.begin, taken.end], axis=1)
    steps = (events == _STEP) & (taken.odometry >= 0)
    plain = done = 0
    for k in [*np.flatnonzero(~steps).tolist(), len(events)]:
        if done < k:
            part = rows[done:k]
            plain += replay_batch(controller, odometry, references, part, answers.part(done, k))
        done = k + 1
        if k == len(events):
            break
        for j in range(int(taken.begin[k]), int(taken.end[k])):
            controller.add_reference(references[j])
        event, value = int(events[k]), int(life.rows[k, 4])
        if event == Event.ODOMETRY_TIMEOUT:
            controller.check_odometry(None, 0)
            answers.set_row(k, STANDSTILL, controller.status)
        elif event == Event.FINISH:
            answers.set_row(k, STANDSTILL, controller.status)
        elif event == Event.CONFIGURE:
            if value in life.parameters:
                controller.configure(life.parameters[value].with_values(changes))
        elif event == Event.RESET:
            controller.enable(bool(value))
            controller.reset()
        elif event == Event.ENABLE:
            controller.enable(bool(value))
    return plain


def _fields(answers: StepResults) -> dict[str, Array]:
    """Return the outputs by field name (``controller_inputs.FIELDS``)."""
    pairs = answers.pairs
    pairs |= {f'terms/{name}': pairs[name] for name in (*TERM_NAMES, 'applied')}
    columns = [*answers.twists.T]
    columns += [pairs[name][:, z] for name in PAIRS for z in range(len(WHEELS))]
    columns += [*answers.certificate.T]
    return {
        name: np.ascontiguousarray(column) for name, column in zip(FIELDS, columns, strict=True)
    }
