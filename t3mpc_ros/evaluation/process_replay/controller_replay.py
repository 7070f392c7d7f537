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
"""Replay: the outputs of a controller, recomputed from its recorded inputs; also as a bag."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
import struct
from typing import Any

import numpy as np

from t3mpc_ros.bag.controller_input_journal import Event, parameters_to_json, reading_from_value
from t3mpc_ros.bag.reader import BagReader
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.controller import SCALAR_NAMES, Controller, ControllerParameters, Status
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    CONTROLLER,
    FIELDS,
    SCALAR_RATE,
    SPEEDS,
    STEP,
    ControllerInputs,
    ReplayError,
    controller_record,
    inputs_of,
    motions,
)
from t3mpc_ros.evaluation.topic_roles import COMMAND, JOURNAL, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.obstacles import Obstacles, OccupancyGrid
from t3mpc_ros.geometry.occupancy_map_file import MapError, load_map
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, Array, BodyTwist, State
from t3mpc_ros.simulation.world import WorldError, load_world

OPEN_LOOP = (
    'open loop: the robot is the recorded one, driven by the recorded commands; it does '
    'not respond to other ones'
)
"""Remark on every replay with changes."""


# -- replay ---------------------------------------------------------------------------------------


def output_row(twist: BodyTwist, status: Status) -> list[float]:
    """Return the outputs of one step in the order of :data:`FIELDS`."""
    return [*twist, *status.scalars]


@dataclass(frozen=True)
class ReplayResult:
    """Outputs of a replay, one row per event as in :class:`ControllerInputs`; NaN where none."""

    fields: Mapping[str, Array]
    """Outputs by field name (:data:`FIELDS`), shape (n,) each."""
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
    """Return the outputs of the current controller for recorded inputs.

    ``changes`` are parameters by name that replace the recorded ones throughout the run;
    ``controllers``, made by :func:`make_controllers`, are consumed by the call.
    """
    changes = changes or {}
    controllers = make_controllers(inputs, changes) if controllers is None else controllers
    outputs = np.full((inputs.events.size, len(FIELDS)), math.nan)
    reasons: list[Reason | None] = [None] * len(outputs)
    for row, _, twist, status in replay_steps(inputs, controllers, changes):
        outputs[row] = output_row(twist, status)
        reasons[row] = status.reason
    parameters = controllers[-1].parameters if controllers else ControllerParameters()
    fields = dict(zip(FIELDS, np.ascontiguousarray(outputs.T), strict=True))
    steps = len(reasons) - reasons.count(None)
    return ReplayResult(fields, tuple(reasons), steps, parameters, dict(changes))


def replay_steps(
    inputs: ControllerInputs,
    controllers: Sequence[Controller],
    changes: Mapping[str, object] | None = None,
) -> Iterator[tuple[int, Controller, BodyTwist, Status]]:
    """Process all events in their order; yield row, controller, command and status of outputs."""
    odometry, references = [*motions(inputs.odometry)], [*motions(inputs.references)]
    for session, controller in zip(inputs.sessions, controllers, strict=True):
        taken = session.taken
        consumed = np.stack([taken.odometry, taken.begin, taken.end], axis=1).tolist()
        rows = zip(session.rows.tolist(), consumed, strict=True)
        for row, ((_, event, stamp, _, value), (received, begin, end)) in enumerate(
            rows, session.first
        ):
            for reference in references[begin:end]:
                controller.add_reference(reference)
            if event == STEP:
                if received >= 0:
                    yield row, controller, *controller.step(odometry[received])
            elif event == Event.RANGE:
                controller.add_range(stamp, reading_from_value(value))
            elif event == Event.STEP_WITHOUT_ODOMETRY:
                if (found := controller.step_without_odometry(stamp)) is not None:
                    yield row, controller, *found
            elif event in (Event.ODOMETRY_TIMEOUT, Event.FINISH):
                if event == Event.ODOMETRY_TIMEOUT:
                    controller.check_odometry(None, 0)
                yield row, controller, STANDSTILL, controller.status
            elif event == Event.CONFIGURE:
                if value in session.parameters:
                    new = session.parameters[value].with_values(changes or {})
                    controller.configure(new)
            elif event in (Event.RESET, Event.ENABLE):
                controller.enable(bool(value))
                if event == Event.RESET:
                    controller.reset()


def make_controllers(
    inputs: ControllerInputs, changes: Mapping[str, object] | None = None
) -> list[Controller]:
    """Return one compiled controller for each recorded session, initialised as its node did."""
    controllers = []
    for session in inputs.sessions:
        parameters = session.parameters[session.start].with_values(changes or {})
        controller = Controller(parameters, *_keep_out(parameters))
        controller.warm_up()
        if session.model is not None:
            controller.set_weights(session.model)
        controllers.append(controller)
    return controllers


def _keep_out(parameters: ControllerParameters) -> tuple[Obstacles, OccupancyGrid | None]:
    """Return known obstacles and saved map of a keep-out; ReplayError if one is not here."""
    table = parameters.keep_out
    if not table.enabled:
        return Obstacles(), None
    try:
        obstacles = load_world(table.world).obstacles
        return obstacles, load_map(table.yaml_filename) if table.yaml_filename else None
    except WorldError as error:
        raise ReplayError(f'keep_out.world: {error}') from error
    except MapError as error:
        raise ReplayError(f'keep_out.yaml_filename: {error}') from error


def recompute_scalars(
    recording: BagReader, namespace: str
) -> tuple[dict[str, dict[str, Array]], ControllerInputs]:
    """Return the scalars of a controller from its journal, and the inputs that they follow from.

    They are those that its node publishes, at its ``terms_rate``: by relative topic name, the
    arrays that :meth:`BagReader.series` would return for the field ``value``.
    """
    inputs = inputs_of(recording, namespace)
    result = replay_controller(inputs)
    steps = np.flatnonzero(inputs.events == Event.STEP)
    rate = float(controller_record(recording, namespace).get('terms_rate', 0.0)) or SCALAR_RATE
    every = max(1, round(result.parameters.rate / rate))
    rows = steps[every - 1 :: every]
    rows = rows[inputs.commands_ns[rows] > 0]
    # A scalar is published right after the command of its step.
    received = (inputs.commands_ns[rows] - recording.start_ns) / NANOSECONDS
    found = {}
    for name in SCALAR_NAMES:
        values = result.fields[name][rows]
        known = np.isfinite(values)
        times = received[known]
        found[f'{CONTROLLER}/{name}'] = {'received': times, 'stamp': times, 'value': values[known]}
    return found, inputs


# -- bag of a replay ------------------------------------------------------------------------------


PARAMETERS = f'{CONTROLLER}/parameters'
TYPES: Mapping[str, str] = {
    REFERENCE: 'nav_msgs/msg/Odometry',
    ODOMETRY: 'nav_msgs/msg/Odometry',
    COMMAND: 'geometry_msgs/msg/Twist',
    JOURNAL: 'std_msgs/msg/Int64MultiArray',
    PARAMETERS: 'std_msgs/msg/String',
    **{f'{CONTROLLER}/{name}': 'std_msgs/msg/Float64' for name in SCALAR_NAMES},
}
"""Types of the topics by relative name."""
LATER = 20_000
"""ns between a command and the telemetry of the same step."""


class ControllerBag(BagWriter):
    """A bag with the topics and the metadata record of a controller."""

    def __init__(self, folder: Path, parameters: ControllerParameters) -> None:
        own = {CONTROLLER: {key: str(value) for key, value in parameters.to_dict().items()}}
        super().__init__(folder, metadata_records=own)
        for topic, kind in TYPES.items():
            self.add_topic(f'/{topic}', kind)

    def add(self, topic: str, when_ns: int, value: object) -> None:
        """Write a message; receive time and publish time are equal."""
        self.write(f'/{topic}', when_ns, when_ns, cdr_bytes(value))


def write_replay(inputs: ControllerInputs, again: ReplayResult, folder: Path) -> Path:
    """Return the bag file of a replay: its inputs and its computed outputs.

    Scalars are written at every step. Messages have the times of the recorded run, so that both
    bags can be viewed together.
    """
    messages: list[tuple[int, str, object]] = []
    for topic, column in ((REFERENCE, inputs.references), (ODOMETRY, inputs.odometry)):
        for when, motion in zip(column.received_ns.tolist(), motions(column), strict=True):
            messages.append((when, topic, motion))
    times = inputs.start_ns + np.round(inputs.time * NANOSECONDS).astype(np.int64)
    commands = zip(*(again.fields[name].tolist() for name in SPEEDS), strict=True)
    for when, twist in zip(times.tolist(), commands, strict=True):
        if all(map(math.isfinite, twist)):
            messages.append((when - LATER, COMMAND, BodyTwist(*twist)))
    for name in SCALAR_NAMES:
        for when, value in zip(times.tolist(), again.fields[name].tolist(), strict=True):
            if math.isfinite(value):
                messages.append((when + LATER, f'{CONTROLLER}/{name}', value))
    for session in inputs.sessions:
        for when, row in zip(times[session.first :].tolist(), session.rows.tolist(), strict=False):
            messages.append((when, JOURNAL, row))
        first = int(times[session.first]) - 2 * LATER
        for revision, parameters in session.parameters.items():
            data = parameters_to_json(revision, parameters.with_values(again.changed).to_dict())
            messages.append((first, PARAMETERS, data))
    with ControllerBag(folder, again.parameters) as bag:
        for when, topic, value in sorted(messages, key=lambda message: message[0]):
            bag.add(topic, when, value)
        return bag.path


def cdr_bytes(value: Any) -> bytes:
    """Return text, number, command, motion or row of the journal as a message of its type."""
    return b'\x00\x01\x00\x00' + _body(value)  # CDR, little-endian


def _body(value: Any) -> bytes:
    match value:
        case str():
            content = value.encode() + b'\x00'
            return struct.pack('<I', len(content)) + content
        case float():
            return struct.pack('<d', value)
        case BodyTwist():
            return struct.pack('<6d', value.linear, 0.0, 0.0, 0.0, 0.0, value.angular)
        case State():
            body = struct.pack('<iI', *divmod(value.stamp_ns, NANOSECONDS))
            for text in ('odom', 'base_link'):  # the default frames of the nodes
                body += bytes(-len(body) % 4) + _body(text)
            half, no_covariance = 0.5 * value.pose.yaw, bytes(36 * 8)
            pose = (value.pose.x, value.pose.y, 0.0, 0.0, 0.0, math.sin(half), math.cos(half))
            body += bytes(-len(body) % 8) + struct.pack('<7d', *pose) + no_covariance
            return body + _body(value.twist) + no_covariance
        case _:  # a row of the journal
            return struct.pack('<IIIxxxx5q', 0, 0, 5, *value)
