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
"""Robots of other makes with our controller, and with ten lines of feed-forward and feedback.

    PYTHONPATH=.:test .venv/bin/python bench/other_robots.py [--seeds 6] [--page FILE] [WORD ...]

It prints the table of docs/your_robot.md, or writes it there with ``--page``; words select robots.
Nodes, messages and robots are in virtual time: each message takes 1 to 3 ms. Both controllers get
the same messages and know what ``config/generic.yaml`` assumes; a seed gives the reference, the
lag and dead time of the drive, and what happens to messages. The robots share no code with the
simulation of the package.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from heapq import heappop, heappush
from itertools import count, pairwise
import math
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from support.velocity_robot import VelocityRobot
import yaml

from bench.page_table import PageTable
from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.evaluation.confidence_intervals import Difference, mean, paired
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, STANDSTILL, BodyTwist, Pose, State
from t3mpc_ros.nodes.controller import GAP_PERIODS, SHORTEST_WATCHDOG_PERIOD, WATCHDOG_PERIOD

CONFIG = Path(__file__).resolve().parents[1] / 'config'
MS = 1_000_000
SEEDS = 6
DURATION, START = 60.0, 10.0
"""Length of a run, and begin of what counts, s."""
REFERENCE_RATE, LEAD_NS = 50.0, 400 * MS
"""Rate and lead of the reference."""
SAMPLE_NS = 10 * MS  # period at which the true motion is compared with the reference
ROBOT_TIMEOUT_NS = 500 * MS  # age of a command at which the robot stops
GAIN = 0.5  # feedback of the ten lines: of 0.25, 0.5 and 1 the best on the calm robot
AROUND_JUMP = 0.5, 1.0  # times before and after a jump that a settled error leaves out, s


@dataclass(frozen=True)
class Toy:
    """A robot, its link, and its odometry."""

    name: str
    rate: float = 50.0
    lag: tuple[float, float] = (0.04, 0.12)  # least and largest lag of the drive, s
    dead_time: tuple[float, float] = (0.01, 0.06)
    robot: dict[str, float] = field(default_factory=dict)  # further fields of the robot
    jitter: float = 0.0  # largest deviation of a period of the odometry, as a share of it
    loss: float = 0.0  # share of the odometry that is lost
    dropout: float = 0.0  # duration of a dropout of the odometry every 5 s, s
    rotation: float = 0.0  # yaw of the frame of the odometry, rad
    reset: float = math.inf  # time between two resets of the pose, s
    old: float = 0.0  # age of its twist when the odometry is stamped, s


TOYS = (
    Toy('calm, 50 Hz'),
    Toy('lag of 0.15 s', lag=(0.15, 0.15)),
    Toy('dead time of 0.15 s', dead_time=(0.15, 0.15)),
    Toy('200 Hz', rate=200.0),
    Toy('30 Hz, best effort: 2 % lost', rate=30.0, loss=0.02),
    Toy('turns by 0.8 times the command', robot={'yaw_gain': 0.8}),
    Toy('odometry jitters by 30 %', jitter=0.3),
    Toy('pose rotated by 2 rad, reset every 10 s', rotation=2.0, reset=10.0),
    Toy('slides sideways at 0.03 m/s', robot={'sideways': 0.03}),
    Toy('30 % of the odometry lost', loss=0.3),
    Toy('no odometry for 0.5 s, every 5 s', dropout=0.5),
    Toy('slower than asked: wheels at most 1.2 rad/s', robot={'fastest': 1.2}),
    Toy('twist is 0.1 s older than its pose', old=0.1),
)


def values_of(node: str) -> dict[str, Any]:
    """Return the parameters of a node in the file for other robots."""
    text = (CONFIG / 'generic.yaml').read_text(encoding='utf-8')
    values: dict[str, Any] = yaml.safe_load(text)[f'/**/{node}']['ros__parameters']
    return values


class Node(Protocol):
    """A controller between the messages."""

    period: float  # of :meth:`wake`, s

    def on_reference(self, state: State) -> None:
        """Take a reference."""
        ...

    def on_odometry(self, state: State, now_ns: int) -> BodyTwist | None:
        """Return what is published at an odometry message."""
        ...

    def wake(self, now_ns: int) -> BodyTwist | None:
        """Return what is published by the timer."""
        ...


class Ours:
    """What ``nodes/controller.py`` does with the core."""

    def __init__(self, rate: float) -> None:
        parameters = StepperControllerParameters.from_dict(
            values_of('controller') | {'rate': rate}
        )
        self.core = Controller(parameters)
        self.core.warm_up()
        self.period = min(max(1.0 / rate, SHORTEST_WATCHDOG_PERIOD), WATCHDOG_PERIOD)
        self._gap_ns = GAP_PERIODS * NANOSECONDS / rate
        self._received_ns = self._stamp_ns = -1

    def on_reference(self, state: State) -> None:
        """Take a reference."""
        self.core.add_reference(state)

    def on_odometry(self, state: State, now_ns: int) -> BodyTwist | None:
        """Return the command of a step."""
        command, _ = self.core.step(state)
        if self.core.odometry_used:
            self._received_ns, self._stamp_ns = now_ns, state.stamp_ns
        return command

    def wake(self, now_ns: int) -> BodyTwist | None:
        """Return the stop after a time-out, or a command in a gap."""
        silence_ns = now_ns - self._received_ns
        if self._received_ns < 0 or silence_ns < self._gap_ns:
            return None
        if self.core.check_odometry(self._received_ns, now_ns):
            return STANDSTILL
        found = self.core.step_without_odometry(self._stamp_ns + silence_ns)
        return None if found is None else found[0]


class TenLines:
    """The reference at the instant at which a command acts, and a share of the error."""

    period = 1.0

    def __init__(self, rate: float, gain: float = GAIN, lead: float | None = None) -> None:
        values = values_of('controller')
        known = values['speed_filter.lag'] + values['speed_filter.dead_time']
        self._gain, self._lead_ns = gain, round((known if lead is None else lead) * NANOSECONDS)
        self._known: deque[State] = deque(maxlen=100)

    def on_reference(self, state: State) -> None:
        """Take a reference."""
        self._known.append(state)

    def _at(self, stamp_ns: int) -> BodyTwist:
        stamps = [state.stamp_ns for state in self._known]
        axes = zip(*(state.twist for state in self._known), strict=True)
        return BodyTwist(*(float(np.interp(stamp_ns, stamps, axis)) for axis in axes))

    def on_odometry(self, state: State, now_ns: int) -> BodyTwist | None:
        """Return feed-forward and feedback."""
        if not self._known or state.stamp_ns < self._known[0].stamp_ns:
            return None
        ahead, now = self._at(state.stamp_ns + self._lead_ns), self._at(state.stamp_ns)
        linear = ahead.linear + self._gain * (now.linear - state.twist.linear)
        angular = ahead.angular + self._gain * (now.angular - state.twist.angular)
        return BodyTwist(linear, angular)

    def wake(self, now_ns: int) -> BodyTwist | None:
        """Return nothing."""
        return None


class Graph:
    """A reference, a controller, and a robot, with messages on their way."""

    def __init__(self, toy: Toy, make: Callable[[float], Node], seed: int) -> None:
        self._toy, self._random = toy, np.random.default_rng((seed, 32))
        lag, dead_time = (self._random.uniform(*each) for each in (toy.lag, toy.dead_time))
        self._geometry = StepperControllerParameters.from_dict(values_of('controller')).geometry
        radius, separation = self._geometry.wheel_radius, 2.0 * self._geometry.half_separation
        self.robot = VelocityRobot(radius, separation, lag, dead_time, 0.0, **toy.robot)
        values = {'rate': REFERENCE_RATE, 'seed': seed}
        values['amplitude'] = values_of('reference_generator')['amplitude']
        self._generator = ChaoticReference(ReferenceParameters.from_dict(values), self._geometry)
        self._node = make(toy.rate)
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._number = count()
        self._now_ns = self._robot_ns = self._command_ns = self._reset_ns = 0
        self._origin = (0.0, 0.0, 0.0)
        self._measured: deque[tuple[float, float]] = deque(maxlen=1 + round(toy.old * toy.rate))
        self._references: list[tuple[float, ...]] = []
        self._motions: list[tuple[float, ...]] = []
        for begin in (self._publish_reference, self._publish_odometry, self._wake, self._sample):
            self._in(0, begin)

    def run(self) -> 'Errors':
        """Return the errors of a run."""
        while self._events[0][0] <= DURATION * NANOSECONDS:
            self._now_ns, _, event = heappop(self._events)
            event()
        return self._errors()

    def _in(self, delay_ns: int, event: Callable[..., None], *given: Any) -> None:
        entry = (self._now_ns + delay_ns, next(self._number), partial(event, *given))
        heappush(self._events, entry)

    def _transport(self) -> int:
        return int(self._random.uniform(1.0, 3.0) * MS)

    def _advance(self) -> None:
        steps = (self._now_ns - self._robot_ns) // MS
        self._robot_ns += steps * MS
        self.robot.advance(steps / 1000.0)

    def _publish_reference(self) -> None:
        state = State(self._now_ns + LEAD_NS, ORIGIN, self._generator.advance().twist)
        self._references.append((state.stamp_ns, *state.twist))
        self._in(self._transport(), self._node.on_reference, state)
        self._in(round(NANOSECONDS / REFERENCE_RATE), self._publish_reference)

    def _publish_odometry(self) -> None:
        toy = self._toy
        self._advance()
        shift = toy.jitter * self._random.uniform(-1.0, 1.0)
        self._in(round((1.0 + shift) / toy.rate * 1e3) * MS, self._publish_odometry)
        if not self._now_ns:
            return
        pose, *twist = self.robot.odometry()
        if self._now_ns - self._reset_ns > toy.reset * NANOSECONDS:
            self._reset_ns, self._origin = self._now_ns, pose
        self._measured.append((twist[0], twist[1]))
        x, y = pose[0] - self._origin[0], pose[1] - self._origin[1]
        turn = toy.rotation - self._origin[2]
        there = Pose(
            math.cos(turn) * x - math.sin(turn) * y,
            math.sin(turn) * x + math.cos(turn) * y,
            pose[2] + turn,
        )
        state = State(self._now_ns, there, BodyTwist(*self._measured[0]))
        lost = self._random.random() < toy.loss
        silent = self._now_ns / NANOSECONDS % 5.0 > 5.0 - toy.dropout
        if not (lost or silent):
            self._in(self._transport(), self._receive_odometry, state)

    def _receive_odometry(self, state: State) -> None:
        self._send(self._node.on_odometry(state, self._now_ns))

    def _wake(self) -> None:
        self._send(self._node.wake(self._now_ns))
        self._in(round(self._node.period * NANOSECONDS), self._wake)

    def _send(self, command: BodyTwist | None) -> None:
        if command is not None:
            self._in(self._transport(), self._receive_command, command)

    def _receive_command(self, command: BodyTwist) -> None:
        self._advance()
        self._command_ns = self._now_ns
        self.robot.command(*command)

    def _sample(self) -> None:
        self._advance()
        if self._now_ns - self._command_ns > ROBOT_TIMEOUT_NS:
            self.robot.command(0.0, 0.0)
        self._motions.append((self._now_ns, *self.robot.twist))
        self._in(SAMPLE_NS, self._sample)

    def _errors(self) -> 'Errors':
        known, found = np.array(self._references), np.array(self._motions)
        found = found[found[:, 0] > START * NANOSECONDS]
        half, radius = self._geometry.half_separation, self._geometry.wheel_radius
        wheels = np.array([[1.0, half], [1.0, -half]]) / radius
        asked = known[:, 1:] @ wheels.T
        wanted = np.stack([np.interp(found[:, 0], known[:, 0], each) for each in asked.T], axis=1)
        error = np.sum((found[:, 1:] @ wheels.T - wanted) ** 2, axis=1)
        settled = np.ones(len(error), dtype=bool)
        for (stamp, *before), (_, *after) in pairwise(zip(known[:, 0], *asked.T, strict=True)):
            if max(abs(b - a) for a, b in zip(before, after, strict=True)) > JUMP:
                since = (found[:, 0] - stamp) / NANOSECONDS
                settled &= (since < -AROUND_JUMP[0]) | (since > AROUND_JUMP[1])
        power = np.sum(wanted**2, axis=1)
        return Errors(
            math.sqrt(error.sum() / power.sum()),
            math.sqrt(error[settled].sum() / power[settled].sum()),
        )


JUMP = 0.35  # change of a wheel of the reference from one sample to the next that is a jump, rad/s


class Errors(NamedTuple):
    """Rms error of the wheel speeds as a share of the rms of the reference."""

    whole: float
    settled: float  # away from the jumps of the reference


class Row(NamedTuple):
    """Errors of both controllers with one robot, a number a seed."""

    ours: list[Errors]
    ten_lines: list[Errors]

    @property
    def difference(self) -> Difference:
        """Difference of the whole errors, ours less that of the ten lines."""
        return paired([each.whole for each in self.ours], [each.whole for each in self.ten_lines])


def measure(toy: Toy, seeds: int) -> Row:
    """Return the errors with a robot, of the seeds 1, 2, ..."""
    runs = [
        [Graph(toy, make, seed).run() for seed in range(1, seeds + 1)] for make in (Ours, TenLines)
    ]
    return Row(*runs)


def format_row(toy: Toy, row: Row) -> str:
    """Return a row of the table."""
    whole = [mean([each.whole for each in some]) for some in row]
    settled = [mean([each.settled for each in some]) for some in row]
    difference = row.difference
    return (
        f'| {toy.name} | {100 * whole[0]:.1f} | {100 * whole[1]:.1f} | '
        f'{100 * difference.mean:+.1f} ± {100 * difference.half:.1f} | '
        f'{100 * settled[0]:.1f}, {100 * settled[1]:.1f} |'
    )


def _measured_row(toy: Toy, seeds: int) -> str:
    return format_row(toy, measure(toy, seeds))


TABLE = PageTable(
    'robots',
    (
        'robot',
        'ours, %',
        'ten lines, %',
        'difference, 95 %',
        'away from jumps: ours, ten lines, %',
    ),
    ('seeds', SEEDS),
    [(toy.name, partial(_measured_row, toy)) for toy in TOYS],
)

if __name__ == '__main__':
    TABLE.main(__doc__)
