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

from collections.abc import Generator, Sequence
from dataclasses import replace
import math
from typing import Any, Protocol

import numpy as np

from t3mpc_ros.evaluation.record import RATE, Record, broken_off, stamp_of, switch_times
from t3mpc_ros.evaluation.scenario import LEAD, Scenario
from t3mpc_ros.evaluation.simulated_links import NO_FAULTS, LinkFaults, ReportLink
from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS
from t3mpc_ros.robot.interface import RobotCommand, RobotState
from t3mpc_ros.simulation.plant_robot import Signals, SimulatedRobot

Loop = Generator[RobotState, RobotCommand, Record]
"""Closed loop that yields reports and takes commands."""
_NO_RANGES = (math.nan,) * len(RANGE_SENSORS)


class Driver(Protocol):
    """What closes the loop: the controller of the node, a method, a law for a path."""

    @property
    def reason(self) -> str:
        """Why it stops the robot; empty where it drives."""
        ...

    @property
    def signals(self) -> Signals:
        """What it decided last, beside the command."""
        ...

    def begin(self, k: int, *, enabled: bool) -> None:
        """Begin period k: take the reference that becomes known in it; drive, or stop."""
        ...

    def step(self, state: RobotState) -> RobotCommand:
        """Return the command that follows from a report of the robot."""
        ...


class Method(Protocol):
    """What makes a driver for each run."""

    @property
    def name(self) -> str:
        """Name in tables and errors."""
        ...

    def driver(self, scenario: Scenario) -> Driver:
        """Return a new driver."""
        ...


def run(scenario: Scenario, method: Method) -> Record:
    """Return the record of a new driver of a method and the robot of a scenario.

    Equal arguments give equal records, bit for bit.
    """
    reference, steps = scenario.reference(), scenario.steps
    known = steps + round(LEAD * RATE)
    if len(reference.speeds) < known:
        raise ValueError(f'reference must have at least {known} rows: got {len(reference.speeds)}')
    driver = method.driver(scenario)
    return with_reference(run_loop(scenario_reports(scenario, driver), driver), scenario)


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


def with_reference(record: Record, scenario: Scenario) -> Record:
    """Return the record of a loop with the reference of its scenario."""
    reference, steps = scenario.reference(), scenario.steps
    columns = {
        **record.columns,
        'reference': reference.speeds[:steps],
        'mode': reference.modes[:steps],
    }
    switches = switch_times(reference.time, reference.modes)
    return replace(record, columns=columns, drive=scenario.kind.drive, switches=switches)


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
        whole = all(map(math.isfinite, state.true_wheels or state.wheels))
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
