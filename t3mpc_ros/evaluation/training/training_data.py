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
"""Training data: what a controller saw and did in a recorded run, by its replay."""

from dataclasses import dataclass, fields
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import TERM_NAMES, Nt3fsMpcParameters
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.evaluation.process_replay import controller_inputs, controller_replay
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, Array, BodyTwist

AGREES = 1e-4
"""Largest difference of a replayed command from the recorded one, m/s and rad/s."""
FREE = ('predictive.dither',)
"""Parameters that may differ within the data of one model, of all that affect the fit."""
_FEEDBACK, _PREDICTIVE = (TERM_NAMES.index(name) for name in ('feedback', 'predictive'))


class TrainingError(RuntimeError):
    """The bag cannot be used for training; the text gives the reason."""


@dataclass(frozen=True)
class TrainingData:
    """One row for each step at which the controller moved the robot, right wheel first.

    Several bags can form one data set: ``begins`` marks the rows without a predecessor.
    """

    errors: Array
    """delta-bar = chi - (r + h) at the instant of effect, rad/s, (n, 2): the error in the
    control law."""
    moves: Array
    """v_p; NaN where the replay does not reproduce the recorded command, rad/s², (n, 2)."""
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

    TrainingError: topics or parameters are missing, or contradict the recorded commands.
    """
    try:
        inputs = controller_inputs.load_inputs(folder)
        controllers = controller_replay.make_controllers(inputs)
    except controller_inputs.ReplayError as error:
        raise TrainingError(str(error)) from error
    revisions = [each for session in inputs.sessions for each in session.parameters.values()]
    parameters = revisions[-1].resolved()
    for each in revisions:
        check_compatible(each, parameters, folder, folder)
    if parameters.composition != 'paper':
        raise TrainingError(
            f'{folder}: composition must be paper: got {parameters.composition}, in which '
            'nothing is learnt about the wheels; record a bag with composition: paper'
        )
    data = _replayed(inputs, controllers, parameters)
    notes = [f'{folder}: {note}' for note in inputs.notes]
    if not len(data):
        raise TrainingError(
            '; '.join([f'{folder}: at no message was the controller moving the robot', *notes])
        )
    reproduced = np.count_nonzero(np.isfinite(data.moves[:, 0]))
    result = f'{folder}: {reproduced} of {len(data)} commands come out of the replay as they were'
    if reproduced < 0.5 * np.count_nonzero(inputs.exact[inputs.commanding]):
        raise TrainingError(
            f'{result}: the run was made under other parameters, or by another version'
        )
    if reproduced < len(data):
        notes.append(f'{result}: the predictor is fitted to these alone')
    return data, parameters, notes


def _replayed(
    inputs: controller_inputs.ControllerInputs,
    controllers: list[Controller],
    parameters: ControllerParameters,
) -> TrainingData:
    """Return inputs and decisions of the controller at each step, by a replay of its journal."""
    recorded = np.stack(
        [inputs.recorded[name] for name in controller_inputs.SPEEDS], axis=1
    ).tolist()
    exact = inputs.exact
    patience = parameters.watchdog.odometry_timeout * NANOSECONDS
    # The residual of announced jumps is evaluated after it has decayed for a period.
    revive = math.exp(parameters.law.gain / parameters.rate)
    rows: list[tuple[Array, ...]] = []
    flags: list[tuple[bool, bool]] = []
    last_ns, last = 0, None
    for row, controller, twist, status in controller_replay.replay_steps(inputs, controllers):
        if not status.reason.moves:
            last = None
        if not status.reason.moves or status.stamp_ns == last_ns:  # at rest, or a duplicate
            continue
        drive, sent = controller.actuation, BodyTwist(*recorded[row])
        same = all(abs(a - b) <= AGREES for a, b in zip(twist, sent, strict=True)) and exact[row]
        if not same and math.isfinite(sum(sent)):  # after a message that the bag lacks
            drive.set_command(np.array(wheels_from_twist(sent, parameters.geometry)))
        terms, known = status.terms, controller.law.predictive.signals.jumps
        rows.append(
            (
                -terms[_FEEDBACK] / parameters.law.gain - revive * known,
                terms[_PREDICTIVE] if same else np.full(2, math.nan),
                drive.speeds.copy(),
                drive.disturbance.copy(),
            )
        )
        begins = last is not controller or status.stamp_ns - last_ns > patience
        flags.append((status.limited, begins))
        last_ns, last = status.stamp_ns, controller
    errors, moves, speeds, unexplained = np.array(rows).reshape(-1, 4, 2).transpose(1, 0, 2)
    limited, starts = np.array(flags, dtype=np.bool_).reshape(-1, 2).T
    return TrainingData(errors, moves, speeds, unexplained, limited, starts)


def check_compatible(
    first: ControllerParameters, other: ControllerParameters, path: Path, other_path: Path
) -> None:
    """Raise :class:`TrainingError` unless data of both can be fitted together."""
    mine, its = first.resolved().to_dict(), other.resolved().to_dict()
    names = [spec.name for spec in Nt3fsMpcParameters.specs() if spec.name not in FREE]
    names += [spec.name for spec in WheelGeometry.specs()]
    if differing := [name for name in names if mine[name] != its[name]]:
        what = f'{path} and {other_path} must have the same parameters; they differ in '
        if path == other_path:
            what = f'{path} must have the same parameters throughout; during the run changed '
        raise TrainingError(
            what + ', '.join(f'{name} ({mine[name]}, {its[name]})' for name in differing)
        )
