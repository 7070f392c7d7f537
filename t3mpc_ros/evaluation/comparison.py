# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Comparison of methods: a plan of cases, methods and seeds, and its experiment."""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass

from t3mpc_ros.evaluation.cases import cases_for
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Run, run_experiment
from t3mpc_ros.evaluation.loop import Method
from t3mpc_ros.evaluation.methods import (
    FEED_FORWARD,
    FULL,
    STAGES,
    TWIN_PARTS,
    WITHOUT,
    methods_for,
)
from t3mpc_ros.evaluation.scenario import KINDS, Scenario, check_name

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

    def scenario(self, case: str, seed: int) -> Scenario:
        """Return one run without its method."""
        return Scenario(self.robot, case, seed, self.duration, self.noise, self.gyro)

    def runs(self) -> list[Run]:
        """Return every run, methods of one seed next to each other."""
        known = self.known_methods()
        return [
            Run(
                (self.scenario(case, seed), known[method]),
                {
                    'controller': method,
                    'robot': self.robot,
                    'case': case,
                    'seed': seed,
                    'noise': self.noise,
                    'duration': self.duration,
                },
            )
            for case in self.cases
            for seed in self.seeds
            for method in self.methods
        ]


def compare(
    plan: ComparisonPlan, workers: int | Executor = 1, report: Report | None = None
) -> ResultTable:
    """Return the metrics of every run of a plan; ``workers`` as for :class:`WorkerPool`."""
    return run_experiment(plan.runs(), workers=workers, report=report)
