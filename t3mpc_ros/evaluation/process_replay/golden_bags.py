# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Golden bags: short closed-loop runs, recorded as by the nodes, which replay bit-equal."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path
import struct
import tempfile
from typing import Self
import zlib

import numpy as np

from t3mpc_ros.bag.run.journal import Journal, parameters_to_json
from t3mpc_ros.bag.run.model_file import load_model
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.controller import SCALAR_NAMES, Controller, ControllerParameters, Status
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    CONTROLLER,
    FIELDS,
    SPEEDS,
    ControllerInputs,
    motions,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import ReplayResult, output_row
from t3mpc_ros.evaluation.scenario import RATE
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.evaluation.twin_closed_loop import LEAD, chaotic_course, loop_controller, loop_robot
from t3mpc_ros.geometry.arena import Obstacles
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, STANDSTILL, BodyTwist, State, WheelSpeeds
from t3mpc_ros.parameters.table import Value
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin
from t3mpc_ros.simulation.fault_injection import FaultEvent, FaultSchedule

MOTION = 'nav_msgs/msg/Odometry'
TYPES: Mapping[str, str] = {
    REFERENCE: MOTION,
    ODOMETRY: MOTION,
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


class ControllerBag:
    """Writes messages into a bag; receive time and publish time are equal.

    The parameters of the controller are stored as metadata record as by the recorder.
    """

    def __init__(self, folder: Path, parameters: ControllerParameters) -> None:
        own = {CONTROLLER: {key: str(value) for key, value in parameters.to_dict().items()}}
        self._writer = BagWriter(folder, metadata_records=own)
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

    Every event has its time, which must not decrease. ``every`` is how many steps lie between two
    publications of its scalars; ``model`` is the file to start from; ``obstacles`` are those that
    its keep-out knows.
    """

    def __init__(
        self,
        parameters: ControllerParameters,
        tape: ControllerBag,
        now_ns: int,
        every: int = 5,
        model: Path | None = None,
        obstacles: Obstacles | None = None,
    ) -> None:
        self._tape, self._every, self._steps = tape, every, 0
        self._journal = Journal()
        self.controller = Controller(parameters, obstacles)
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
                if name in SCALAR_NAMES:
                    self._tape.number(now_ns + 3 * LATER, name, value)
        return command, status

    def add_range(self, now_ns: int, sensor: int, reading: float) -> None:
        """Pass a range reading (m) to the controller."""
        self._tape.row(now_ns, self._journal.range(sensor, reading))
        self.controller.add_range(sensor, reading)

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
    for name in (name for name in SCALAR_NAMES if name in again.fields):
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


START_NS = 1_700_000_000 * NANOSECONDS
RECEIPT_DELAY = 500_000
"""ns from the stamp of an odometry message to its arrival at the controller."""
WATCHDOG_PERIOD = 0.05
"""s between two checks of the odometry watchdog."""


@dataclass(frozen=True)
class GoldenScenario:
    """One golden run."""

    seed: int
    """Seed of reference and robot."""
    stretches: tuple[tuple[float, float], ...]
    """Intervals in which the reference is followed, s; it switches every 12 s and between them."""
    deeds: Mapping[float, tuple[str, object]]
    """By time (s): ``enable`` (bool), ``reset`` (None), ``configure`` (changes)."""
    faults: tuple[FaultEvent, ...] = ()
    quiet_reference: tuple[float, float] = (math.inf, math.inf)
    """Interval without reference, s."""
    quiet_odometry: tuple[float, float] = (math.inf, math.inf)
    """Interval without odometry, s."""
    bad_odometry: tuple[float, ...] = ()
    """Times of odometry messages that are not finite, s."""
    parameters: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the controller other than those of :func:`loop_controller`."""


GOLDEN_SCENARIOS: Mapping[str, GoldenScenario] = {
    'switches': GoldenScenario(2, ((9.5, 14.0), (22.5, 27.4)), {}),
    'stops': GoldenScenario(
        4,
        ((3.0, 12.4),),
        {
            1.5: ('enable', False),
            2.0: ('enable', True),
            6.5: ('reset', None),
        },
        quiet_reference=(3.0, 3.7),
        quiet_odometry=(4.5, 5.0),
        bad_odometry=(5.8, 5.81),
    ),
    'changes': GoldenScenario(
        6,
        ((8.0, 17.4),),
        {
            1.5: ('configure', {'law.gain': 20.0}),
            2.5: ('configure', {'law.compensator': False, 'adaptation.gamma': 300.0}),
            3.5: ('configure', {'use_fuzzy': False}),
            4.5: ('configure', {'linear.x.max_velocity': 0.15, 'use_fuzzy': True}),
            5.5: (
                'configure',
                {'jump_transition.preview': False, 'predictive.move_weight': 0.01},
            ),
        },
        (
            FaultEvent(2.0, 'load_change', 0.5, 3.0),
            FaultEvent(4.0, 'slippery', 0.3, 1.5),
            FaultEvent(6.0, 'command_delay', 0.03, 1.0),
            FaultEvent(7.5, 'brown_out', True, 0.1),
        ),
        parameters={'composition': 'paper'},
    ),
}
"""Golden runs by the name of their file."""


def write_golden(folder: Path, progress: Callable[[str], None] = print) -> list[Path]:
    """Write the golden bags to ``folder`` with the current controller, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, recipe in GOLDEN_SCENARIOS.items():
        path = folder / f'{name}.mcap'
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            run_golden_scenario(recipe, Path(scratch)).replace(path)
        progress(f'{path}: {path.stat().st_size} bytes')
        written.append(path)
    return written


def run_golden_scenario(recipe: GoldenScenario, folder: Path) -> Path:
    """Return the bag file of a run in ``folder``; equal recipes give equal messages."""
    parameters = loop_controller().with_values(recipe.parameters)
    robot = DigitalTwin(loop_robot(seed=recipe.seed), FaultSchedule(recipe.faults))
    whole = chaotic_course(recipe.stretches[-1][1], recipe.seed)
    course = np.concatenate(
        [whole[round(begin * RATE) : round(end * RATE)] for begin, end in recipe.stretches]
    )
    lead = round(LEAD * RATE)
    geometry = parameters.geometry
    with ControllerBag(folder, parameters) as tape:
        loop = _Loop(recipe, RecordedController(parameters, tape, START_NS, every=10))
        for k in range(lead):
            loop.reference(k, 0, course[k].tolist(), geometry)
        for k in range(len(course) - lead):
            loop.reference(k + lead, k, course[k + lead].tolist(), geometry)
            state = robot.advance(_stamp(k))
            wheels, stamp_ns = loop.step(k, state.odometry)
            robot.apply(RobotCommand(wheels, stamp_ns), state.stamp_ns)
        loop.finish()
        return tape.path


class _Loop:
    """Executes a recipe in virtual time."""

    def __init__(self, recipe: GoldenScenario, taped: RecordedController) -> None:
        self._recipe, self._taped = recipe, taped
        self._deeds = dict(recipe.deeds)
        self._heard = 0.0
        self._watched = 0.0
        self._now_ns = START_NS
        self._wheels = WheelSpeeds(0.0, 0.0)
        self._told_ns = 0

    def reference(self, k: int, now: int, wheels: list[float], geometry: WheelGeometry) -> None:
        """Pass sample ``k`` of the reference at period ``now``."""
        begin, end = self._recipe.quiet_reference
        if not begin <= now / RATE < end:
            twist = twist_from_wheels(WheelSpeeds(*wheels), geometry)
            self._taped.add_reference(self._later(now), State(START_NS + _stamp(k), ORIGIN, twist))

    def step(self, k: int, odometry: State) -> tuple[WheelSpeeds, int]:
        """Return the newest command and the stamp of its odometry."""
        now, recipe = k / RATE, self._recipe
        for when in [when for when in self._deeds if when <= now]:
            self._do(k, *self._deeds.pop(when))
        begin, end = recipe.quiet_odometry
        if begin <= now < end:
            self._watch(k, now)
            return self._wheels, self._told_ns
        if now in recipe.bad_odometry:
            odometry = State(odometry.stamp_ns, odometry.pose, BodyTwist(math.nan, 0.0))
        stamp_ns = START_NS + odometry.stamp_ns
        twist, _ = self._taped.step(
            self._later(k) + RECEIPT_DELAY, State(stamp_ns, odometry.pose, odometry.twist)
        )
        self._heard, self._told_ns = now, odometry.stamp_ns
        self._wheels = wheels_from_twist(twist, self._taped.controller.parameters.geometry)
        return self._wheels, self._told_ns

    def finish(self) -> None:
        """End the run."""
        self._taped.finish(self._now_ns + NANOSECONDS // 100)

    def _watch(self, k: int, now: float) -> None:
        """Check for missing odometry, as the node does periodically."""
        timeout = self._taped.controller.parameters.watchdog.odometry_timeout
        if now - self._heard > timeout and now - self._watched > WATCHDOG_PERIOD - 1e-9:
            self._watched = now
            self._taped.silent(self._later(k))
            self._wheels = WheelSpeeds(0.0, 0.0)

    def _do(self, k: int, deed: str, how: object) -> None:
        now_ns = self._later(k)
        if deed == 'enable':
            self._taped.enable(now_ns, bool(how))
        elif deed == 'reset':
            self._taped.reset(now_ns)
        elif isinstance(how, Mapping):
            self._taped.configure(now_ns, how)

    def _later(self, k: int) -> int:
        """Return the time of period ``k``, slightly later with each call."""
        self._now_ns = max(START_NS + _stamp(k), self._now_ns + 1000)
        return self._now_ns


def _stamp(k: int) -> int:
    return round(k * NANOSECONDS / RATE)
