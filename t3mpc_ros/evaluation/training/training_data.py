# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Training data from a recorded run: errors, moves and residuals of each controller step."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.columns import TopicColumns, read_columns
from t3mpc_ros.bag.reader import BagReader, open_bag
from t3mpc_ros.control.actuation import wheel_limits
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import WHEELS, Controller, ControllerParameters
from t3mpc_ros.evaluation.process_replay.controller_inputs import ReplayError, recorded_parameters
from t3mpc_ros.evaluation.process_replay.controller_replay import recompute_scalars
from t3mpc_ros.evaluation.process_replay.journal_alignment import match_commands
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    JOURNAL,
    ODOMETRY,
    REFERENCE,
    SCALARS,
    find_topics,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, BodyTwist, State

Array = NDArray[np.float64]

MOVES, FEEDBACK = 'controller/terms/predictive', 'controller/terms/feedback'
NEEDED = (
    REFERENCE,
    ODOMETRY,
    COMMAND,
    *(f'{name}/{wheel}' for name in (MOVES, FEEDBACK) for wheel in WHEELS),
)
"""Topics that a bag must hold."""

DISAGREES = 0.2
"""Difference between a reconstructed and the published error that counts as wrong, as a share of
the error; without losses they agree to rounding."""

_FEEDBACK = TERM_NAMES.index('feedback')
_FOLLOWED = [TERM_NAMES.index(name) for name in ('feedback', 'feedforward', 'compensator')]


class TrainingError(RuntimeError):
    """The bag cannot be used for training; the text gives the reason."""


@dataclass(frozen=True)
class TrainingData:
    """One row for each step at which the controller moved the robot, right wheel first.

    Several bags can form one data set: ``begins`` marks the rows without a predecessor.
    """

    time: Array
    """Stamp, s, shape (n,)."""
    errors: Array
    """delta-bar = chi - (r + h) at the instant of effect, rad/s, (n, 2): the error in the
    control law. NaN where the published values contradict it."""
    moves: Array
    """v_p where it was published, else NaN, rad/s², shape (n, 2)."""
    rest: Array
    """u as sent, less the terms of errors and reference alone: v_p - g, rad/s², (n, 2)."""
    speeds: Array
    """Estimated chi, rad/s, shape (n, 2)."""
    unexplained: Array
    """Estimated acceleration that u does not explain, rad/s², shape (n, 2)."""
    limited: NDArray[np.bool_]
    """Whether u as sent lies on a limit, so that it is not all of the wanted u, (n,)."""
    begins: NDArray[np.bool_]
    """Whether the row has no predecessor, shape (n,)."""

    def __len__(self) -> int:
        return len(self.begins)

    @classmethod
    def joined(cls, parts: list['TrainingData']) -> 'TrainingData':
        """Return several data sets as one."""
        each = [[getattr(part, item.name) for part in parts] for item in fields(cls)]
        return cls(*map(np.concatenate, each))


def load_training_data(folder: Path) -> tuple[TrainingData, ControllerParameters, list[str]]:
    """Return the data of a bag, the parameters of the run, and remarks for the user.

    Raises
    ------
    TrainingError
        Topics or parameters are missing, or the parameters contradict the published values.
    BagError
        The bag cannot be read.
    """
    with open_bag(folder) as recording:
        topics, namespaces = find_topics(recording.topics)
        topics = {name: t for name, t in topics.items() if recording.topics[t].message_count}
        missing = [name for name in NEEDED if name not in topics]
        recomputed = _recomputed(recording, namespaces[0], missing)
        if missing := [name for name in missing if name not in recomputed]:
            raise TrainingError(
                f'{folder}: these topics are missing, or have no message: {", ".join(missing)}'
            )
        notes: list[str] = []
        try:
            parameters = recorded_parameters(recording, namespaces[0], notes)
        except ReplayError as error:
            raise TrainingError(str(error)) from error
        if parameters.composition != 'paper':
            raise TrainingError(
                f'{folder}: composition must be paper: got {parameters.composition}, in which '
                'nothing is learnt about the wheels; record a bag with composition: paper'
            )
        parameters = parameters.resolved()
        recorded = {name: topics[name] for name in NEEDED if name not in recomputed}
        columns = read_columns(recording, recorded.values())
        start_ns = recording.start_ns
        messages = recomputed | {
            name: _table(name, topic, columns[topic], start_ns, notes)
            for name, topic in recorded.items()
        }
    if empty := [name for name, table in messages.items() if not table['received'].size]:
        raise TrainingError(f'{folder}: no message of {", ".join(empty)} is finite')
    replay = _rebuild(parameters, messages, notes)
    if not len(replay):
        reasons = '; '.join(['at no message was the controller moving the robot', *notes])
        raise TrainingError(f'{folder}: {reasons}')
    published = np.isfinite(replay.moves).all(axis=1)
    sound = published & np.isfinite(replay.errors).all(axis=1)
    if np.count_nonzero(sound) < 0.5 * np.count_nonzero(published):
        raise TrainingError(
            f'{folder}: with the settings in the bag only {np.count_nonzero(sound)} of '
            f'{np.count_nonzero(published)} numbers of {FEEDBACK} come out as they were '
            'published: the run was made under other settings, or by another version'
        )
    return replay, parameters, [f'{folder}: {note}' for note in notes]


def _recomputed(
    recording: BagReader, namespace: str, missing: Sequence[str]
) -> dict[str, Mapping[str, Array]]:
    """Return the missing topics that follow exactly from the journal of the controller."""
    if not {*missing} & SCALARS or f'{namespace}/{JOURNAL}' not in recording.topics:
        return {}
    try:
        scalars, _ = recompute_scalars(recording, namespace)
    except ReplayError:
        return {}
    return {
        name: {key: column[scalars[name]['exact'] > 0.0] for key, column in scalars[name].items()}
        for name in missing
        if name in scalars
    }


def _table(
    name: str, topic: str, column: TopicColumns, start_ns: int, notes: list[str]
) -> Mapping[str, Array]:
    """Return the messages of one topic in order of receipt; times count from ``start_ns``."""
    times = {'received': column.received_ns, 'stamp': column.stamps_ns}
    columns = {key: (each - start_ns) / NANOSECONDS for key, each in times.items()}
    if name in (REFERENCE, ODOMETRY, COMMAND):
        columns |= {'linear': column.numbers[:, -2], 'angular': column.numbers[:, -1]}
    else:
        columns['value'] = column.numbers[:, 0]
    bad = ~np.all([np.isfinite(values) for values in columns.values()], axis=0)
    if bad.any():
        notes.append(f'{np.count_nonzero(bad)} messages of {topic} are not finite')
    if name in (REFERENCE, ODOMETRY):
        return columns  # rejected by the controller itself, as in the run
    return {key: values[~bad] for key, values in columns.items()}


def _rebuild(
    parameters: ControllerParameters, messages: Mapping[str, Mapping[str, Array]], notes: list[str]
) -> TrainingData:
    """Return inputs and decisions of the controller at each step, from the recorded messages."""
    controller = Controller(parameters)
    odometry, reference, sent = messages[ODOMETRY], messages[REFERENCE], messages[COMMAND]
    motions, times = _motions(odometry), odometry['received']
    steps = match_commands(times, sent['received'])
    commands = np.full((times.size, 2), math.nan)
    commands[steps[steps >= 0]] = _wheels(sent, parameters.geometry)[steps >= 0]
    if lost := np.count_nonzero(np.isnan(commands[:, 0])):
        notes.append(f'{lost} of {times.size} messages of {ODOMETRY} have no {COMMAND} after them')
    coming = deque(zip(reference['received'].tolist(), _motions(reference), strict=True))
    gain, patience = parameters.law.gain, parameters.watchdog.odometry_timeout * NANOSECONDS
    # The residual of announced jumps is evaluated after it has decayed for a period.
    revive = math.exp(gain / parameters.rate)
    errors, feedback, rest, speeds, unexplained = np.full((5, times.size, 2), math.nan)
    begins = np.zeros(times.size, dtype=np.bool_)
    last_ns: int | None = None
    for i, motion in enumerate(motions):
        while coming and coming[0][0] <= times[i]:
            controller.add_reference(coming.popleft()[1])
        if motion.stamp_ns == last_ns:  # a duplicate
            continue
        _, status = controller.step(motion)
        if not status.reason.moves:
            last_ns = None
            continue
        drive, terms = controller.actuation, status.terms
        if math.isfinite(commands[i, 0]):  # else the recomputed command is the best guess
            drive.set_command(commands[i])
        commands[i] = drive.command
        begins[i] = last_ns is None or motion.stamp_ns - last_ns > patience
        last_ns = motion.stamp_ns
        feedback[i] = terms[_FEEDBACK]
        errors[i] = -terms[_FEEDBACK] / gain - revive * controller.law.predictive.known_error
        rest[i] = drive.applied - terms[_FOLLOWED].sum(axis=0)
        speeds[i], unexplained[i] = drive.speeds, drive.disturbance
    moves, recorded = (
        _published(messages, name, sent['received'], steps, times.size)
        for name in (MOVES, FEEDBACK)
    )
    # At standstill the controller publishes zeros, and restarts afterwards.
    still = (recorded == 0.0).any(axis=1)
    begins[1:] |= still[:-1]
    tolerance = gain * DISAGREES * parameters.predictive.noise
    wrong = still | (np.abs(recorded - feedback) > tolerance).any(axis=1)
    reach = parameters.predictive.decimation - 1
    for i in np.flatnonzero(wrong).tolist():
        errors[max(i - reach, 0) : i + reach + 1] = math.nan
    limits = wheel_limits(parameters.limits, parameters.geometry)
    changes = np.diff(commands, axis=0, prepend=commands[:1]) * parameters.rate
    limited = _at_limit(commands, limits[0]) | (_at_limit(changes, limits[1]) & ~begins)
    arrays = (odometry['stamp'], errors, moves, rest, speeds, unexplained, limited, begins)
    return TrainingData(*(array[np.isfinite(speeds[:, 0])] for array in arrays))


def _at_limit(wheels: Array, limits: Array) -> NDArray[np.bool_]:
    """Return the mask of wheel pairs at the limits of :func:`share_within`, shape (n,)."""
    mean, half = np.abs(wheels @ [0.5, 0.5]), np.abs(wheels @ [0.5, -0.5])
    used = np.stack([mean, half, np.abs(wheels).max(axis=1)], axis=1) / limits
    return np.asarray(used.max(axis=1) > 1.0 - 1e-6)


def _published(
    messages: Mapping[str, Mapping[str, Array]],
    name: str,
    sent: Array,
    steps: NDArray[np.int64],
    count: int,
) -> Array:
    """Return both wheels' scalars in the rows of their steps, (count, 2).

    They are published right after the command of the same step.
    """
    table = np.full((count, 2), math.nan)
    for z, wheel in enumerate(WHEELS):
        numbers = messages[f'{name}/{wheel}']
        last = np.searchsorted(sent, numbers['received'], side='right') - 1
        rows = np.where(last >= 0, steps[last], -1)
        table[rows[rows >= 0], z] = numbers['value'][rows >= 0]
    return table


def _motions(table: Mapping[str, Array]) -> list[State]:
    stamps = np.round(table['stamp'] * NANOSECONDS).astype(np.int64).tolist()
    twists = zip(table['linear'].tolist(), table['angular'].tolist(), strict=True)
    return [
        State(stamp, ORIGIN, BodyTwist(*twist))
        for stamp, twist in zip(stamps, twists, strict=True)
    ]


def _wheels(table: Mapping[str, Array], geometry: WheelGeometry) -> Array:
    twists = zip(table['linear'].tolist(), table['angular'].tolist(), strict=True)
    return np.array([wheels_from_twist(BodyTwist(*twist), geometry) for twist in twists])
