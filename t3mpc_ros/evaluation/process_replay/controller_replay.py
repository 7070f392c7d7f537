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
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.obstacles import Obstacles, OccupancyGrid
from t3mpc_ros.geometry.occupancy_map_file import MapError, load_map
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, Array, BodyTwist, State
from t3mpc_ros.parameters.table import Value
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


TYPES: Mapping[str, str] = {
    REFERENCE: 'nav_msgs/msg/Odometry',
    ODOMETRY: 'nav_msgs/msg/Odometry',
    COMMAND: 'geometry_msgs/msg/Twist',
    f'{CONTROLLER}/journal': 'std_msgs/msg/Int64MultiArray',
    f'{CONTROLLER}/parameters': 'std_msgs/msg/String',
    **{f'{CONTROLLER}/{name}': 'std_msgs/msg/Float64' for name in SCALAR_NAMES},
}
"""Types of the topics by relative name."""
LATER = 20_000
"""ns between a command and the telemetry of the same step."""

_HEAD = b'\x00\x01\x00\x00'  # CDR, little-endian
_NO_COVARIANCE = bytes(36 * 8)


def controller_bag(folder: Path, parameters: ControllerParameters) -> BagWriter:
    """Return the writer of a bag with the topics and the metadata record of a controller."""
    own = {CONTROLLER: {key: str(value) for key, value in parameters.to_dict().items()}}
    writer = BagWriter(folder, metadata_records=own)
    for topic, kind in TYPES.items():
        writer.add_topic(f'/{topic}', kind)
    return writer


def write_replay(inputs: ControllerInputs, again: ReplayResult, folder: Path) -> Path:
    """Return the bag file of a replay: its inputs and its computed outputs.

    Scalars are written at every step. Messages have the times of the recorded run, so that both
    bags can be viewed together.
    """
    messages: list[tuple[int, str, bytes]] = []
    for topic, column in ((REFERENCE, inputs.references), (ODOMETRY, inputs.odometry)):
        for when, motion in zip(column.received_ns.tolist(), motions(column), strict=True):
            messages.append((when, topic, odometry_bytes(motion)))
    times = inputs.start_ns + np.round(inputs.time * NANOSECONDS).astype(np.int64)
    commands = zip(*(again.fields[name].tolist() for name in SPEEDS), strict=True)
    for when, twist in zip(times.tolist(), commands, strict=True):
        if all(map(math.isfinite, twist)):
            messages.append((when - LATER, COMMAND, twist_bytes(BodyTwist(*twist))))
    for name in SCALAR_NAMES:
        for when, value in zip(times.tolist(), again.fields[name].tolist(), strict=True):
            if math.isfinite(value):
                messages.append((when + LATER, f'{CONTROLLER}/{name}', float_bytes(value)))
    for session in inputs.sessions:
        for when, row in zip(times[session.first :].tolist(), session.rows.tolist(), strict=False):
            messages.append((when, f'{CONTROLLER}/journal', row_bytes(row)))
        first = int(times[session.first]) - 2 * LATER
        for revision, parameters in session.parameters.items():
            data = revision_bytes(revision, parameters.with_values(again.changed).to_dict())
            messages.append((first, f'{CONTROLLER}/parameters', data))
    with controller_bag(folder, again.parameters) as writer:
        for when, topic, data in sorted(messages, key=lambda message: message[0]):
            writer.write(f'/{topic}', when, when, data)
        return writer.path


def twist_bytes(twist: BodyTwist) -> bytes:
    """Return a ``geometry_msgs/msg/Twist`` as CDR."""
    return _HEAD + struct.pack('<6d', twist.linear, 0.0, 0.0, 0.0, 0.0, twist.angular)


def float_bytes(value: float) -> bytes:
    """Return a ``std_msgs/msg/Float64`` as CDR."""
    return _HEAD + struct.pack('<d', value)


def row_bytes(row: Sequence[int]) -> bytes:
    """Return a row of the journal, a ``std_msgs/msg/Int64MultiArray``, as CDR."""
    return _HEAD + struct.pack('<IIIxxxx5q', 0, 0, 5, *row)


def revision_bytes(revision: int, values: Mapping[str, Value]) -> bytes:
    """Return a revision of the parameters, a ``std_msgs/msg/String``, as CDR."""
    return _HEAD + _text(parameters_to_json(revision, values))


def odometry_bytes(motion: State) -> bytes:
    """Return a ``nav_msgs/msg/Odometry`` as CDR, with the default frames of the nodes."""
    seconds, rest = divmod(motion.stamp_ns, NANOSECONDS)
    body = struct.pack('<iI', seconds, rest)
    for text in ('odom', 'base_link'):
        body += bytes(-len(body) % 4) + _text(text)
    body += bytes(-len(body) % 8)
    half = 0.5 * motion.pose.yaw
    pose = (motion.pose.x, motion.pose.y, 0.0, 0.0, 0.0, math.sin(half), math.cos(half))
    body += struct.pack('<7d', *pose) + _NO_COVARIANCE
    body += twist_bytes(motion.twist)[len(_HEAD) :] + _NO_COVARIANCE
    return _HEAD + body


def _text(text: str) -> bytes:
    content = text.encode() + b'\x00'
    return struct.pack('<I', len(content)) + content
