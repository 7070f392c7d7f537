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
"""Comparison of methods: a plan of cases, methods and seeds, and its experiment."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import statistics
from typing import Any, Protocol

from t3mpc_ros.evaluation.drivers import MethodSpec
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Run, run_experiment
from t3mpc_ros.evaluation.loop import Driver, Method, run
from t3mpc_ros.evaluation.methods import FEED_FORWARD
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.robot.interface import RobotCommand, RobotState

QUICK_SEEDS = tuple(range(201, 207))
"""Default seeds: none of them was used for tuning, or is in a table of the paper's results."""


class ComparedMethod(Method, Protocol):
    """A method that states what it knows."""

    def knowledge(self, scenario: Scenario) -> str:
        """Return what it knows of robot and reference, for tables."""
        ...


@dataclass(frozen=True)
class ComparisonPlan:
    """What is compared: methods in cases, with every seed."""

    scenario: Scenario
    """A run without its method; the others differ from it by case and seed."""
    cases: tuple[str, ...]
    methods: Mapping[str, ComparedMethod]
    """By name, in the order of the tables."""
    seeds: tuple[int, ...] = QUICK_SEEDS
    against: str = FEED_FORWARD
    """The method with which every other is compared."""

    def __post_init__(self) -> None:
        for what, chosen in (
            ('case', self.cases),
            ('method', self.methods),
            ('seed', self.seeds),
        ):
            if not chosen:
                raise ValueError(f'at least one {what} must be given')

    def runs(self) -> list[Run]:
        """Return every run, methods of one seed next to each other."""
        found = []
        for case in self.cases:
            for seed in self.seeds:
                scenario = replace(self.scenario, case=case, seed=seed)
                for name, method in self.methods.items():
                    row = {
                        'controller': name,
                        'robot': scenario.robot,
                        'case': case,
                        'seed': seed,
                        'noise': scenario.noise,
                        'duration': scenario.duration,
                    }
                    found.append(Run((scenario, method), row))
        return found


StepTimes = Mapping[str, float]
"""Median time of a step of each method, µs."""
TIMED = 6.0
"""Length of the run in which steps are timed, s."""


def step_times(plan: ComparisonPlan, clock_ns: Callable[[], int]) -> StepTimes:
    """Return the median time of a step of every method, µs, on this machine.

    State estimate and limits are part of a step. It is no number of the runs: those depend on no
    machine. Weights are not pretrained for it, they take no time.
    """
    case, seed = plan.cases[0], plan.seeds[0]
    length = min(TIMED, plan.scenario.duration)
    scenario = replace(plan.scenario, case=case, seed=seed, duration=length)
    found = {}
    for name, method in plan.methods.items():
        if isinstance(method, MethodSpec):
            method = replace(method, pretrained=False)
        timed = TimedMethod(method, clock_ns)
        run(scenario, timed)
        found[name] = 1e-3 * statistics.median(timed.taken_ns)
    return found


class TimedMethod:
    """A method whose driver is asked how long each step takes."""

    def __init__(self, method: Method, clock_ns: Callable[[], int]) -> None:
        self.name, self._method, self._clock_ns = method.name, method, clock_ns
        self.taken_ns: list[int] = []

    def driver(self, scenario: Scenario) -> Driver:
        """Return a new driver."""
        driver, clock_ns, taken_ns = self._method.driver(scenario), self._clock_ns, self.taken_ns
        step = driver.step

        def timed_step(state: RobotState) -> RobotCommand:
            begin = clock_ns()
            command = step(state)
            taken_ns.append(clock_ns() - begin)
            return command

        driver.step = timed_step  # type: ignore[method-assign]
        return driver


def run_plan(plan: ComparisonPlan, workers: Any = 1, report: Report | None = None) -> ResultTable:
    """Return the metrics of every run of a plan; ``workers`` as for :func:`.workers_for`."""
    return run_experiment(plan.runs(), workers=workers, report=report)
