# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recomputes recorded inputs with the current controller, offline."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.reader import BagReader
from t3mpc_ros.bag.run.journal import Event
from t3mpc_ros.control.control_law import BOUND, RATE, TERM_NAMES, VALUE
from t3mpc_ros.control.controller import Controller, ControllerParameters, Status
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.bag_report.topic_roles import WHEELS
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    CONTROLLER,
    FIELDS,
    NUMBERS,
    PAIRS,
    ControllerInputs,
    ControllerSession,
    ReplayError,
    inputs_of,
    motions,
)
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, StateArray

Array = NDArray[np.float64]

SCALAR_RATE = 20.0
"""Default of the node's parameter ``terms_rate``, Hz."""

_STEP = int(Event.STEP)  # an enumeration is slower to compare
OPEN_LOOP = (
    'open loop: the robot is the recorded one, driven by the recorded commands; it does '
    'not respond to other ones'
)
"""Remark on every replay with changes."""


TWIST, ERROR, SKILL, APPLIED, TERMS, CERTIFICATE, COMMAND, LIMITED = 0, 2, 4, 6, 8, 18, 22, 24
"""First columns of the quantities in a row of results; LIMITED is a single column."""
WIDTH = 25


class StepResults(NamedTuple):
    """Twist and status of each step, NaN where there is none."""

    numbers: Array
    """Shape (n, WIDTH), columns from TWIST to LIMITED."""
    reasons: NDArray[np.object_]
    """:class:`Reason` of each step, None where there is none, shape (n,)."""

    @classmethod
    def empty(cls, count: int) -> Self:
        """Return ``count`` empty rows."""
        return cls(np.full((count, WIDTH), math.nan), np.full(count, None, dtype=np.object_))

    def part(self, begin: int, end: int) -> 'StepResults':
        """Return a view of some of the rows."""
        return StepResults(self.numbers[begin:end], self.reasons[begin:end])

    def set_row(self, row: int, twist: BodyTwist, status: Status) -> None:
        """Write the result of :meth:`Controller.step` into a row."""
        self.numbers[row] = (
            *twist,
            *status.error.tolist(),
            *status.skill.tolist(),
            *status.applied.tolist(),
            *status.terms.ravel().tolist(),
            *status.certificate_state.tolist(),
            math.nan,
            math.nan,
            float(status.limited),
        )
        self.reasons[row] = status.reason

    @property
    def twists(self) -> Array:
        """Commanded twists, m/s and rad/s, shape (n, 2)."""
        return self.numbers[:, TWIST : TWIST + 2]

    @property
    def pairs(self) -> dict[str, Array]:
        """Quantities of both wheels by name, shape (n, 2), as in :class:`Status`."""
        numbers = self.numbers
        found = {
            'error': numbers[:, ERROR : ERROR + 2],
            'skill': numbers[:, SKILL : SKILL + 2],
            'applied': numbers[:, APPLIED : APPLIED + 2],
            'estimate': 0.0 - numbers[:, TERMS : TERMS + 2],
        }
        for k, name in enumerate(TERM_NAMES):
            found[name] = numbers[:, TERMS + 2 * k : TERMS + 2 * k + 2]
        return found

    @property
    def certificate(self) -> Array:
        """Value and margin of the certificate, see :class:`CertificateReading`, shape (n, 2)."""
        state = self.numbers[:, CERTIFICATE:]
        return np.stack([state[:, VALUE], state[:, BOUND] - state[:, RATE]], axis=1)

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Whether a limit changed the command, shape (n,)."""
        return np.equal(self.numbers[:, LIMITED], 1.0)


@dataclass(frozen=True)
class ReplayResult:
    """Outputs of a replay, one row per event as in :class:`Inputs`; NaN where none."""

    fields: Mapping[str, Array]
    """Outputs by field name (``controller_inputs.FIELDS``), or some of them, shape (n,) each."""
    reasons: tuple[Reason | None, ...]
    """Stop reasons; None at rows that are neither a step nor a timeout."""
    steps: int
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
    for life, controller in zip(inputs.lives, controllers, strict=True):
        own = answers.part(life.first, life.first + len(life.rows))
        _replay_session(controller, life, changes, odometry, references, own)
        parameters = controller.parameters
    reasons = tuple(answers.reasons.tolist())
    steps = len(reasons) - reasons.count(None)
    return ReplayResult(_fields(answers), reasons, steps, parameters, dict(changes))


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
            controller.set_weights(life.model)
        controllers.append(controller)
    return controllers


def recompute_scalars(
    recording: BagReader, namespace: str
) -> tuple[dict[str, dict[str, Array]], ControllerInputs]:
    """Return the scalars of a controller from its journal, and the inputs that they follow from.

    They are those that its node publishes, at the same rate: by relative topic name, the arrays
    that :meth:`BagReader.series` would return for the field ``value``, and ``exact``, which is 1
    where all inputs of the controller are in the bag, else 0.

    Raises
    ------
    ReplayError, TrainingError, ValueError
        The bag has no journal, or its inputs, parameters or model are incomplete.
    BagError
        The bag is damaged.
    """
    inputs = inputs_of(recording, namespace)
    if not inputs.journalled:
        raise ReplayError(f'{recording.folder}: there is no journal of the controller')
    result = replay_controller(inputs)
    steps = np.flatnonzero(inputs.events == Event.STEP)
    every = max(1, round(result.parameters.rate / SCALAR_RATE))
    rows = steps[every - 1 :: every]
    rows = rows[inputs.commands_ns[rows] > 0]
    # A scalar is published right after the command of its step.
    received = (inputs.commands_ns[rows] - recording.start_ns) / NANOSECONDS
    exact = inputs.exact[rows].astype(np.float64)
    found = {}
    for name in NUMBERS:
        values = result.fields[name][rows]
        known = np.isfinite(values)
        times = received[known]
        table = {'received': times, 'stamp': times, 'value': values[known], 'exact': exact[known]}
        found[f'{CONTROLLER}/{name}'] = table
    return found, inputs


def _replay_session(
    controller: Controller,
    life: ControllerSession,
    changes: Mapping[str, object],
    odometry: StateArray,
    references: StateArray,
    answers: StepResults,
) -> None:
    """Process the events of one life in their order."""
    taken = life.taken
    inputs = np.stack([taken.odometry, taken.begin, taken.end], axis=1).tolist()
    rows = zip(life.events.tolist(), life.rows[:, 4].tolist(), inputs, strict=True)
    for k, (event, value, (received, begin, end)) in enumerate(rows):
        for j in range(begin, end):
            controller.add_reference(references[j])
        if event == _STEP:
            if received >= 0:
                answers.set_row(k, *controller.step(odometry[received]))
        elif event == Event.ODOMETRY_TIMEOUT:
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
