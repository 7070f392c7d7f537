# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Comparison of methods: a plan of cases, methods and seeds, and the metrics of all its runs."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

from t3mpc_ros.evaluation.cases import cases_for
from t3mpc_ros.evaluation.loop import Method, run
from t3mpc_ros.evaluation.methods import (
    FEED_FORWARD,
    FULL,
    STAGES,
    TWIN_PARTS,
    WITHOUT,
    methods_for,
)
from t3mpc_ros.evaluation.metrics import Numbers, measure
from t3mpc_ros.evaluation.scenario import KINDS, Scenario, check_name
from t3mpc_ros.evaluation.workers import Job, map_jobs

QUICK_SEEDS = tuple(range(201, 207))
"""Default seeds: none of them was used for tuning, or is in a table of the paper's results."""


def default_methods(robot: str) -> tuple[str, ...]:
    """Return the full controller and every baseline, without stages and ablations."""
    parts = {*STAGES, *WITHOUT, *TWIN_PARTS} - {FULL}
    return tuple(name for name in methods_for(robot) if name not in parts)


@dataclass(frozen=True)
class ComparisonPlan:
    """What is compared."""

    robot: str
    cases: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = QUICK_SEEDS
    duration: float = 60.0
    noise: float = 0.04
    gyro: bool = False

    @property
    def against(self) -> str:
        """The method with which every other is compared."""
        return FEED_FORWARD

    @property
    def robot_text(self) -> str:
        """What the robot is, in words."""
        return KINDS[self.robot].text

    @property
    def additional_knowledge(self) -> Mapping[str, str]:
        """What methods know that are no method of the robot, for the table of the page."""
        return {}

    def known_methods(self) -> Mapping[str, Method]:
        """Return every method that can be compared, by name."""
        return methods_for(self.robot)

    def __post_init__(self) -> None:
        check_name('robot', self.robot, KINDS)
        known = self.known_methods()
        for case in self.cases:
            check_name('case', case, cases_for(self.robot))
        for method in self.methods:
            check_name('method', method, known)
        if self.gyro and not KINDS[self.robot].has_gyro:
            raise ValueError(f'gyro is for the twin alone: got robot {self.robot}')
        for what, chosen in (
            ('case', self.cases),
            ('method', self.methods),
            ('seed', self.seeds),
        ):
            if not chosen:
                raise ValueError(f'at least one {what} must be given')

    def jobs(self) -> list[tuple[str, str, int]]:
        """Return (case, method, seed) of every run, methods of one seed next to each other."""
        return [
            (case, method, seed)
            for case in self.cases
            for seed in self.seeds
            for method in self.methods
        ]

    def job(self, case: str, method: str, seed: int) -> Job:
        """Return scenario and method of a run."""
        scenario = Scenario(self.robot, case, seed, self.duration, self.noise, self.gyro)
        return scenario, self.known_methods()[method]


Results = Mapping[tuple[str, str], Sequence[Numbers]]
"""Metrics by case and method, one entry for each seed in the order of the plan."""


def compare(
    plan: ComparisonPlan, workers: int | Executor = 1, *, progress: bool = False
) -> Results:
    """Return the metrics of every run of a plan; ``workers`` as for :class:`WorkerPool`."""
    keys = plan.jobs()
    found = map_jobs(measured_run, [plan.job(*key) for key in keys], workers, progress=progress)
    numbers = dict(zip(keys, found, strict=True))
    return {
        (case, method): [numbers[case, method, seed] for seed in plan.seeds]
        for case in plan.cases
        for method in plan.methods
    }


def measured_run(job: Job) -> Numbers:
    """Return the metrics of one run."""
    scenario, method = job
    return measure(scenario, run(scenario, method))
