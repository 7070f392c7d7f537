# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tuning objective: mean RMSE plus weighted chatter of closed-loop runs on the tuning seeds."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
import math
from typing import Self

from t3mpc_ros.evaluation.closed_loop import Job, JobError, LoopRecord, MethodSpec, WorkerPool
from t3mpc_ros.evaluation.scenario import TUNING_SEEDS, Scenario
from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition
from t3mpc_ros.parameters.table import Parameters

SMOOTHNESS = 1e-5
"""rho, s²: what a unit of chatter (rad/s³) costs in tracking error (rad/s).

Small: 1000 rad/s³ of total variation of u per second cost 0.01 rad/s. It keeps a method from
buying the last percent of tracking with a command that shakes the motors, and decides between
parameters that track alike; it is too small to make any method track worse to be smooth.
"""
NOISE_LEVELS = (0.0, 0.04, 0.1)
"""Variances of the measured wheel speeds met in training, (rad/s)²: one parameter for them all."""
DURATION = 26.0
"""Length of a training run, s: the reference switches twice in it."""


def objective(record: LoopRecord) -> float:
    """Return RMSE + rho chatter of a run, rad/s; infinite for a run that broke off."""
    value = record.rmse() + SMOOTHNESS * record.chatter()
    return value if math.isfinite(value) else math.inf


@dataclass(frozen=True, slots=True)
class TuningScenarios:
    """The runs of one evaluation.

    Parameters
    ----------
    seeds
        One run each; a seed is never one on which results are reported.
    noise_levels
        Run i has level i, counted round; there are seeds enough for each.
    duration
        s
    cases
        Run i has case i, counted round.
    """

    seeds: tuple[int, ...] = TUNING_SEEDS
    noise_levels: tuple[float, ...] = NOISE_LEVELS
    duration: float = DURATION
    cases: tuple[str, ...] = ('nominal',)

    def __post_init__(self) -> None:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f'training seeds must differ: got {self.seeds}')
        if not 1 <= len(self.noise_levels) <= len(self.seeds):
            raise ValueError(
                f'there must be noise levels, and a seed for each: got {len(self.noise_levels)} '
                f'levels and {len(self.seeds)} seeds'
            )
        if not 1 <= len(self.cases) <= len(self.seeds):
            raise ValueError(
                f'there must be cases, and a seed for each: got {len(self.cases)} cases and '
                f'{len(self.seeds)} seeds'
            )

    def runs(self) -> tuple[tuple[int, float, str], ...]:
        """Return (seed, noise variance, case) of each run."""
        return tuple(
            (
                seed,
                self.noise_levels[i % len(self.noise_levels)],
                self.cases[i % len(self.cases)],
            )
            for i, seed in enumerate(self.seeds)
        )

    def scenarios(self, drive: str) -> tuple[Scenario, ...]:
        """Return the runs on the paper's plant with a drive."""
        return tuple(
            Scenario(drive, noise, case, seed, self.duration) for seed, noise, case in self.runs()
        )


class ClosedLoopObjective:
    """Mean objective of parameters in the closed loop; several are evaluated at the same time.

    To be used in a ``with`` statement: the processes stay warm between generations.

    Parameters
    ----------
    training
        The runs of one evaluation.
    workers
        How many processes.
    report
        Receives the error text of parameters with which a run raised an exception.
    """

    def __init__(
        self, training: TuningScenarios, workers: int, report: Callable[[str], None] | None = None
    ) -> None:
        self.training = training
        self.workers = WorkerPool(workers)
        self._report = report
        self._ran: set[tuple[str, str]] = set()

    def __enter__(self) -> Self:
        self.workers.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.workers.__exit__()

    def __call__(
        self, method: MethodDefinition, drive: str, candidates: Sequence[Parameters]
    ) -> list[float]:
        """Return the mean objective of each candidate, infinite where a run broke off or failed.

        Raises
        ------
        JobError
            Runs failed with every candidate of a method that never ran before: it is at fault
            then, not the parameters. Or a process was lost.
        """
        try:
            objectives: list[float | None] = [*self.objectives(method, drive, candidates)]
        except JobError as error:
            if isinstance(error.__cause__, BrokenExecutor):
                raise
            objectives = [self._alone(method, drive, candidate) for candidate in candidates]
            if (method.name, drive) not in self._ran and all(each is None for each in objectives):
                raise
        self._ran.add((method.name, drive))
        return [math.inf if each is None else each for each in objectives]

    def _alone(self, method: MethodDefinition, drive: str, candidate: Parameters) -> float | None:
        """Return the objective of one candidate, None when a run raised an exception."""
        try:
            return self.objectives(method, drive, [candidate])[0]
        except JobError as error:
            if isinstance(error.__cause__, BrokenExecutor):
                raise
            if self._report is not None:
                self._report(f'  counted as worst: {error}')
            return None

    def objectives(
        self, method: MethodDefinition, drive: str, candidates: Sequence[Parameters]
    ) -> list[float]:
        """Return the mean objective of each candidate, infinite where a run broke off.

        Raises
        ------
        JobError
            A run raised an exception.
        """
        scenarios = self.training.scenarios(drive)
        jobs: list[Job] = [
            (scenario, MethodSpec(method.name, method.controller_type, candidate, pretrained=True))
            for candidate in candidates
            for scenario in scenarios
        ]
        return mean_objectives(len(candidates), len(scenarios), self.workers.run(jobs, objective))


def mean_objectives(
    candidates: int, runs: int, evaluated: Iterable[tuple[int, float]]
) -> list[float]:
    """Return the mean over the runs of each candidate; the same in whatever order they come.

    Parameters
    ----------
    candidates, runs
        Run j of candidate i has index ``i * runs + j``.
    evaluated
        (index, objective), each index once.

    Raises
    ------
    ValueError
        An index is missing, comes twice, or is none.
    """
    objectives: dict[int, float] = {}
    for index, value in evaluated:
        if index in objectives or not 0 <= index < candidates * runs:
            raise ValueError(f'each run must be evaluated once: got run {index} once more')
        objectives[index] = value
    if len(objectives) != candidates * runs:
        raise ValueError(f'{candidates * runs} runs must be evaluated: got {len(objectives)}')
    # math.fsum has no order; infinities add to infinity.
    return [
        math.fsum(objectives[i * runs + j] for j in range(runs)) / runs for i in range(candidates)
    ]
