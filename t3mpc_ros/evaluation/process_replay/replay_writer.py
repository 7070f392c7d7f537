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
"""A replay written as a bag: the inputs of the controller and its recomputed outputs."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import struct

import numpy as np

from t3mpc_ros.bag.controller_input_journal import parameters_to_json
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.controller import SCALAR_NAMES, ControllerParameters
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    CONTROLLER,
    SPEEDS,
    ControllerInputs,
    motions,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import ReplayResult
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist, State
from t3mpc_ros.parameters.table import Value

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
