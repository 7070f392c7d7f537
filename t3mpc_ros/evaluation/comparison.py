# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Comparison of methods: a plan of cases, methods and seeds, and its experiment."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from t3mpc_ros.evaluation.experiment import Report, ResultTable, Run, run_experiment
from t3mpc_ros.evaluation.loop import Method
from t3mpc_ros.evaluation.methods import FEED_FORWARD
from t3mpc_ros.evaluation.scenario import Scenario

QUICK_SEEDS = tuple(range(201, 207))
"""Default seeds: none of them was used for tuning, or is in a table of the paper's results."""


@dataclass(frozen=True)
class ComparisonPlan:
    """What is compared: methods in cases, with every seed."""

    scenario: Scenario
    """A run without its method; the others differ from it by case and seed."""
    cases: tuple[str, ...]
    methods: Mapping[str, Method]
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


def run_plan(plan: ComparisonPlan, workers: Any = 1, report: Report | None = None) -> ResultTable:
    """Return the metrics of every run of a plan; ``workers`` as for :func:`.workers_for`."""
    return run_experiment(plan.runs(), workers=workers, report=report)
