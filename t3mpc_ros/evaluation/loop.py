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
"""The closed loop of a driver and a robot, without ROS, with the timing of the nodes.

Each report of the robot carries its stamp to the driver; the command computed from it leaves at
once, carries that stamp back, and the robot follows it when it has arrived. Reports may be late
or lost on their way; what happens to a command on its way is a matter of the robot.
"""

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
import math
from typing import Any, Protocol

import numpy as np

from t3mpc_ros.evaluation.cases import NO_FAULTS, LinkFaults
from t3mpc_ros.evaluation.run_record import RATE, Record, broken_off, stamp_of, switch_times
from t3mpc_ros.evaluation.scenario import LEAD, Scenario
from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS
from t3mpc_ros.robot.interface import RobotCommand, RobotState
from t3mpc_ros.simulation.plant_adapter import Signals, SimulatedRobot

Loop = Generator[RobotState, RobotCommand, Record]
"""Closed loop that yields reports and takes commands."""
DIVERGED_SPEED = 1e4
"""Wheel speed from which on a run has diverged, rad/s: fifty times what a robot may have."""
_NO_RANGES = (math.nan,) * len(RANGE_SENSORS)


class Driver(Protocol):
    """What closes the loop: the controller of the node, a method, a law for a path."""

    @property
    def reason(self) -> str:
        """Why it stops the robot; empty where it drives."""

    @property
    def signals(self) -> Signals:
        """What it decided last, beside the command."""

    def begin(self, k: int, *, enabled: bool) -> None:
        """Begin period k: take the reference that becomes known in it; drive, or stop."""

    def step(self, state: RobotState) -> RobotCommand:
        """Return the command that follows from a report of the robot."""


class Method(Protocol):
    """What makes a driver for each run."""

    @property
    def name(self) -> str:
        """Name in tables and errors."""

    def driver(self, scenario: Scenario) -> Driver:
        """Return a new driver."""


class ComparedMethod(Method, Protocol):
    """A method that states what it knows."""

    def knowledge(self, scenario: Scenario) -> str:
        """Return what it knows of robot and reference, for tables."""


def run(scenario: Scenario, method: Method) -> Record:
    """Return the record of a new driver of a method and the robot of a scenario.

    Equal arguments give equal records, bit for bit.
    """
    known, rows = scenario.steps + round(LEAD * RATE), len(scenario.reference().speeds)
    if rows < known:
        raise ValueError(f'reference must have at least {known} rows: got {rows}')
    driver = method.driver(scenario)
    return with_scenario(run_loop(scenario_reports(scenario, driver), driver), scenario)


def scenario_reports(scenario: Scenario, driver: Driver) -> Loop:
    """Return the loop of a driver and the robot of a scenario, see :func:`reports_of`."""
    return reports_of(
        scenario.simulation(),
        driver,
        scenario.steps,
        start=scenario.kind.start,
        pauses=scenario.own.pauses,
        links=scenario.links,
        seed=scenario.seed,
    )


def with_scenario(record: Record, scenario: Scenario) -> Record:
    """Return the record of a loop with what its metrics need of its scenario."""
    reference, steps = scenario.reference(), scenario.steps
    columns = {
        **record.columns,
        'reference': reference.speeds[:steps],
        'mode': reference.modes[:steps],
    }
    return replace(
        record,
        columns=columns,
        drive=scenario.kind.drive,
        switches=switch_times(reference.time, reference.modes),
        settling=scenario.kind.settling,
        fault_span=scenario.fault_span,
        geometry=scenario.true_robot().geometry,
    )


def run_loop(loop: Loop, driver: Driver) -> Record:
    """Return the record of a loop whose every report goes to its driver."""
    try:
        report = next(loop)
        while True:
            report = loop.send(driver.step(report))
    except StopIteration as end:
        record: Record = end.value
        return record


def reports_of(
    robot: SimulatedRobot,
    driver: Driver,
    periods: int,
    *,
    start: float = 0.0,
    pauses: Sequence[tuple[float, float]] = (),
    links: LinkFaults = NO_FAULTS,
    seed: int = 0,
    latency_ns: int = 0,
) -> Loop:
    """Yield each report that arrives at the driver, take the command, and return the record.

    Equal arguments and commands give equal records, bit for bit. Robot and driver are new; the
    columns of the reference are the caller's. The driver is disabled until ``start``, and in the
    ``pauses`` (s) of a person. ``links`` and their ``seed`` are those of the reports;
    ``latency_ns`` is from the arrival of a report to the departure of the command.
    """
    reports = ReportLink(links, seed, periods / RATE)
    paused = [(0.0, start), *pauses]
    columns: dict[str, list[Any]] = {'time': []}
    robot_reasons, driver_reasons = [], []
    sent: tuple[float, float] = (0.0, 0.0)
    ended = -1
    for k in range(periods):
        now = stamp_of(k) / NANOSECONDS
        driver.begin(k, enabled=not any(begin <= now < end for begin, end in paused))
        state = robot.advance(stamp_of(k))
        whole = all(abs(speed) < DIVERGED_SPEED for speed in state.true_wheels or state.wheels)
        if whole:
            reports.send(state)
            for arrival_ns, report in reports.arrived(stamp_of(k + 1) - 1):
                command = yield report
                sent = command.wheels
                whole = whole and all(map(math.isfinite, sent))
                if whole:
                    robot.apply(command, arrival_ns + latency_ns)
        row = {'time': now, 'sent': sent, **_of_state(state), **robot.signals, **driver.signals}
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
        robot_reasons.append(state.reason)
        driver_reasons.append(driver.reason)
        if not whole:
            ended = k
            break
    record = Record(
        {name: np.array(values) for name, values in columns.items()},
        start=start,
        robot_reasons=tuple(robot_reasons),
        driver_reasons=tuple(driver_reasons),
    )
    return record if ended < 0 else broken_off(record, ended, periods)


class ReportLink:
    """Reports of a robot on their way to the driver; they arrive in order but for the swapped.

    Equal seeds draw equal numbers, whatever is sent; ``duration`` is that of the run, s.
    """

    def __init__(self, faults: LinkFaults, seed: int, duration: float) -> None:
        self._faults = faults
        self._begin, self._end = faults.span(duration)
        self._generator = np.random.default_rng((seed, 3))
        self._queue: deque[tuple[int, RobotState]] = deque()
        self._sent = 0
        self._overtaken: RobotState | None = None

    def send(self, state: RobotState) -> None:
        """Send a report; one that is not late arrives after those before it all the same."""
        # Two numbers for each report, so that a change of loss does not shift delays.
        lost, late = self._generator.random(2).tolist()
        arrival, delay = state.stamp_ns, 0.0
        if self._begin <= state.stamp_ns / NANOSECONDS < self._end:
            if lost < self._faults.odometry_loss:
                return
            least, most = self._faults.odometry_delay
            delay = least + (most - least) * late
            self._sent += 1
            if self._sent % self._faults.odometry_kept:
                return
            swapped = self._faults.odometry_swapped
            if swapped and self._overtaken is None and self._sent % swapped == 0:
                self._overtaken = state
                return
        arrival += round(delay * NANOSECONDS)
        arrival = max(arrival, self._queue[-1][0] if self._queue else 0)
        self._queue.extend([(arrival, state)] * self._faults.odometry_repeated)
        if self._overtaken is not None:
            self._queue.append((arrival, self._overtaken))
            self._overtaken = None

    def arrived(self, now_ns: int) -> Iterator[tuple[int, RobotState]]:
        """Yield (arrival, report) of what has arrived by ``now_ns``."""
        while self._queue and self._queue[0][0] <= now_ns:
            yield self._queue.popleft()


def _of_state(state: RobotState) -> Signals:
    """Return the columns that a report fills."""
    found: dict[str, Any] = {
        'measured': state.wheels,
        'speeds': state.true_wheels or state.wheels,
        'commanded': state.commanded,
        'odometry': state.odometry.pose,
        'flags': state.status,
    }
    if state.truth is not None:
        found['truth'], found['twist'] = state.truth.pose, state.truth.twist
        found['ranges'] = state.ranges or _NO_RANGES
    if state.lost_steps is not None:
        found['lost_steps'] = state.lost_steps
    return found
