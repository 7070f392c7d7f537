# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes the topics of a controller into a bag without ROS, as the nodes serialize them."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import struct
from typing import Self
import zlib

import numpy as np

from t3mpc_ros.bag.run.journal import Journal, parameters_to_json
from t3mpc_ros.bag.run.model_file import load_model
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.controller import Controller, ControllerParameters, Status
from t3mpc_ros.evaluation.bag_report.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    CONTROLLER,
    FIELDS,
    NUMBERS,
    SPEEDS,
    ControllerInputs,
    motions,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import ReplayResult, output_row
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, State
from t3mpc_ros.parameters.table import Value

MOTION = 'nav_msgs/msg/Odometry'
TYPES: Mapping[str, str] = {
    REFERENCE: MOTION,
    ODOMETRY: MOTION,
    COMMAND: 'geometry_msgs/msg/Twist',
    f'{CONTROLLER}/journal': 'std_msgs/msg/Int64MultiArray',
    f'{CONTROLLER}/parameters': 'std_msgs/msg/String',
    **{f'{CONTROLLER}/{name}': 'std_msgs/msg/Float64' for name in NUMBERS},
}
"""Types of the topics by relative name."""
LATER = 20_000
"""ns between a command and the telemetry of the same step."""

_HEAD = b'\x00\x01\x00\x00'  # CDR, little-endian
_NO_COVARIANCE = bytes(36 * 8)


class ControllerBag:
    """Writes messages into a bag; receive time and publish time are equal.

    Parameters
    ----------
    folder
        Folder of the bag.
    settings
        Parameters of the controller, stored as metadata record as by the recorder.
    details
        Further metadata records.
    """

    def __init__(
        self,
        folder: Path,
        parameters: ControllerParameters,
        metadata_records: Mapping[str, Mapping[str, str]] | None = None,
        name: str | None = None,
    ) -> None:
        own = {CONTROLLER: {key: str(value) for key, value in parameters.to_dict().items()}}
        self._writer = BagWriter(
            folder, name, metadata_records={**own, **(metadata_records or {})}
        )
        for topic, kind in TYPES.items():
            self._writer.add_topic(f'/{topic}', kind)

    @property
    def path(self) -> Path:
        """The written file."""
        return self._writer.path

    def motion(self, topic: str, now_ns: int, motion: State) -> None:
        """Write an odometry message."""
        self.write(topic, now_ns, odometry_bytes(motion))

    def command(self, now_ns: int, twist: BodyTwist) -> None:
        """Write a command."""
        self.write(COMMAND, now_ns, twist_bytes(twist))

    def row(self, now_ns: int, row: Sequence[int]) -> None:
        """Write a row of the journal."""
        self.write(f'{CONTROLLER}/journal', now_ns, row_bytes(row))

    def parameters(self, now_ns: int, revision: int, values: Mapping[str, Value]) -> None:
        """Write a revision of the settings."""
        text = _text(parameters_to_json(revision, values))
        self.write(f'{CONTROLLER}/parameters', now_ns, _HEAD + text)

    def number(self, now_ns: int, name: str, value: float) -> None:
        """Write one scalar of the controller if it is finite."""
        if math.isfinite(value):
            self.write(f'{CONTROLLER}/{name}', now_ns, float_bytes(value))

    def close(self) -> None:
        """Finish the bag."""
        self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def write(self, topic: str, now_ns: int, data: bytes) -> None:
        """Write a message unchanged."""
        self._writer.write(f'/{topic}', now_ns, now_ns, data)


class RecordedController:
    """A controller whose inputs and outputs are written to a bag, as by node and recorder.

    Every event has its time, which must not decrease.

    Parameters
    ----------
    settings
        Parameters of the controller.
    tape
        Bag for its topics.
    now_ns
        Start time.
    every
        Steps between two publications of its scalars.
    model
        Model file to start from.
    """

    def __init__(
        self,
        parameters: ControllerParameters,
        tape: ControllerBag,
        now_ns: int,
        every: int = 5,
        model: Path | None = None,
    ) -> None:
        self._tape, self._every, self._steps = tape, every, 0
        self._journal = Journal()
        self.controller = Controller(parameters)
        self.controller.warm_up()
        tape.parameters(now_ns, 0, parameters.to_dict())
        if model is not None:
            self.controller.set_weights(load_model(model))
            tape.row(now_ns, self._journal.model(zlib.crc32(model.read_bytes())))

    def add_reference(self, now_ns: int, motion: State) -> None:
        """Pass a reference to the controller."""
        self._tape.motion(REFERENCE, now_ns, motion)
        self._journal.count_reference(motion.stamp_ns)
        self.controller.add_reference(motion)

    def step(self, now_ns: int, measured: State) -> tuple[BodyTwist, Status]:
        """Return command and status for one odometry message."""
        self._tape.motion(ODOMETRY, now_ns, measured)
        command, status = self.controller.step(measured)
        self._tape.command(now_ns + LATER, command)
        self._tape.row(now_ns + 2 * LATER, self._journal.step(measured.stamp_ns))
        self._steps += 1
        if self._steps % self._every == 0:
            for name, value in zip(FIELDS, output_row(command, status), strict=True):
                if name in NUMBERS:
                    self._tape.number(now_ns + 3 * LATER, name, value)
        return command, status

    def silent(self, now_ns: int) -> None:
        """Handle missing odometry: stop."""
        self.controller.check_odometry(None, now_ns)
        self._tape.command(now_ns, STANDSTILL)
        row = self._journal.odometry_timeout(self.controller.status.stamp_ns)
        self._tape.row(now_ns + LATER, row)

    def enable(self, now_ns: int, on: bool) -> None:
        """Enable or disable motion."""
        self.controller.enable(on)
        self._tape.row(now_ns, self._journal.enable(on))

    def reset(self, now_ns: int) -> None:
        """Reset the controller."""
        self.controller.reset()
        self._tape.row(now_ns, self._journal.reset())

    def configure(self, now_ns: int, changes: Mapping[str, object]) -> None:
        """Apply other dynamic parameters."""
        parameters = self.controller.parameters.with_values(changes)
        self.controller.configure(parameters)
        row = self._journal.configure()
        self._tape.parameters(now_ns, self._journal.revision, parameters.to_dict())
        self._tape.row(now_ns, row)

    def finish(self, now_ns: int) -> None:
        """Publish the final stop."""
        self._tape.command(now_ns, STANDSTILL)
        self._tape.row(now_ns + LATER, self._journal.finish())


def write_replay(inputs: ControllerInputs, again: ReplayResult, folder: Path) -> Path:
    """Return the bag file of a replay: its inputs and its computed outputs.

    Scalars are written at every step. Messages have the times of the recorded run, so that both
    bags can be viewed together.

    Raises
    ------
    BagError
        The bag cannot be written.
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
    for name in (name for name in NUMBERS if name in again.fields):
        for when, value in zip(times.tolist(), again.fields[name].tolist(), strict=True):
            if math.isfinite(value):
                messages.append((when + LATER, f'{CONTROLLER}/{name}', float_bytes(value)))
    for life in inputs.lives:
        for when, row in zip(times[life.first :].tolist(), life.rows.tolist(), strict=False):
            if inputs.journalled:
                messages.append((when, f'{CONTROLLER}/journal', row_bytes(row)))
        first = int(times[life.first]) - 2 * LATER
        for revision, parameters in life.parameters.items():
            text = parameters_to_json(revision, parameters.with_values(again.changed).to_dict())
            messages.append((first, f'{CONTROLLER}/parameters', _HEAD + _text(text)))
    with ControllerBag(folder, again.parameters) as tape:
        for when, topic, data in sorted(messages, key=lambda message: message[0]):
            tape.write(topic, when, data)
        return tape.path


def twist_bytes(twist: BodyTwist) -> bytes:
    """Return a ``geometry_msgs/msg/Twist`` as CDR."""
    return _HEAD + struct.pack('<6d', twist.linear, 0.0, 0.0, 0.0, 0.0, twist.angular)


def float_bytes(value: float) -> bytes:
    """Return a ``std_msgs/msg/Float64`` as CDR."""
    return _HEAD + struct.pack('<d', value)


def row_bytes(row: Sequence[int]) -> bytes:
    """Return a row of the journal, a ``std_msgs/msg/Int64MultiArray``, as CDR."""
    return _HEAD + struct.pack('<IIIxxxx5q', 0, 0, 5, *row)


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
