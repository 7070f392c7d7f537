# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tunes many methods with an equal budget: mean RMSE and chatter of closed-loop runs."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import BrokenExecutor, Executor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
import math
from pathlib import Path
from typing import Self

from tqdm import tqdm

from t3mpc_ros.evaluation.method import MethodSpec
from t3mpc_ros.evaluation.record import Record
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.scenario import PLANT_OF, TUNING_SEEDS, Scenario
from t3mpc_ros.evaluation.tuning.cma_search import SearchProgress, SearchResult, search_best
from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition, Values, check_names
from t3mpc_ros.evaluation.tuning.tuned_parameters import (
    StoreError,
    TunedEntry,
    TunedParameters,
    TuningBudget,
)
from t3mpc_ros.evaluation.workers import Job, JobError, WorkerPool, measure_many
from t3mpc_ros.parameters.table import ParameterError, Parameters
from t3mpc_ros.version import VERSION

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


def objective(record: Record) -> float:
    """Return RMSE + rho chatter of a run, rad/s; infinite for a run that broke off."""
    value = record.rmse() + SMOOTHNESS * record.variation()
    return value if math.isfinite(value) else math.inf


@dataclass(frozen=True, slots=True)
class TuningScenarios:
    """The runs of one evaluation: one for each seed, none of which is one of the results.

    Run i has noise level i and case i, both counted round; there are seeds enough for each.
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
            Scenario(PLANT_OF[drive], case, seed, self.duration, noise)
            for seed, noise, case in self.runs()
        )


class ClosedLoopObjective:
    """Mean objective of parameters in the closed loop; several are evaluated at the same time.

    To be used in a ``with`` statement: the processes stay warm between generations. ``report``
    receives the error text of parameters with which a run raised an exception.
    """

    def __init__(
        self,
        training: TuningScenarios,
        workers: int | Executor,
        report: Callable[[str], None] | None = None,
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
        """Return the mean objective of each candidate, infinite where a run broke off."""
        scenarios = self.training.scenarios(drive)
        jobs: list[Job] = [
            (scenario, MethodSpec(method.name, method.controller_type, candidate, pretrained=True))
            for candidate in candidates
            for scenario in scenarios
        ]
        return mean_objectives(
            len(candidates), len(scenarios), measure_many(jobs, objective, self.workers)
        )


def mean_objectives(
    candidates: int, runs: int, evaluated: Iterable[tuple[int, float]]
) -> list[float]:
    """Return the mean over the runs of each candidate; the same in whatever order they come.

    ``evaluated`` are (index, objective), each index once: that of run j of candidate i is
    ``i * runs + j``.
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


Evaluate = Callable[[MethodDefinition, str, Sequence[Parameters]], Sequence[float]]
"""Returns the objective of each of several parameters of a method in a drive."""

SEARCH_SEED = 1
"""Of the search itself; the same for every method."""


def tune_methods(
    methods: Sequence[MethodDefinition],
    drives: Sequence[str],
    evaluations: int,
    workers: int | Executor,
    path: Path,
    report: Callable[[str], None] | None = None,
    *,
    resume: bool = False,
    training: TuningScenarios | None = None,
    evaluate: Evaluate | None = None,
) -> TunedParameters:
    """Return the best parameters of each method in each of its drives.

    Each pair has a search of its own with ``evaluations`` evaluations. The file is written after
    each, and the history of each search beside it; what the file holds of other methods stays.

    Parameters
    ----------
    drives
        Keys of the start parameters: ``'torque'``, ``'velocity'``, or ``'twin'`` with its own
        ``evaluate``; a method without start parameters for one is left out there.
    path
        Where the tuned parameters are kept.
    report
        Receives messages; with None there is no progress line either.
    resume
        Go on with searches that were interrupted.
    training, evaluate
        The runs of an evaluation, and what evaluates in place of the closed loop.

    Raises
    ------
    ValueError
        Methods of the same name; a drive no method is meant for; or a file that holds other
        methods tuned in the same drive with another budget, which could not be compared.
    RuntimeError
        For some method no parameters gave a finite objective; all others are kept.
    """
    check_names(methods)
    for drive in drives:
        if not any(drive in method.start for method in methods):
            raise ValueError(f'no method to be tuned is meant for drive {drive!r}')
    training = training or TuningScenarios()
    budget = TuningBudget(
        evaluations,
        SEARCH_SEED,
        training.seeds,
        training.noise_levels,
        training.duration,
        SMOOTHNESS,
        training.cases,
    )
    pairs = [(each, drive) for each in methods for drive in drives if drive in each.start]
    store = _load_existing(path, [(method.name, drive) for method, drive in pairs], budget)
    failed = []
    with ExitStack() as stack:
        if evaluate is None:
            evaluate = stack.enter_context(ClosedLoopObjective(training, workers, report))
        for method, drive in pairs:
            with progress_bar(evaluations, 'evaluations', show=report is not None) as bar:
                bar.set_description(f'{method.name}, {drive}')
                found = search_best(
                    _objective(method, drive, evaluate),
                    method.space,
                    method.start[drive],
                    evaluations,
                    SEARCH_SEED,
                    partial(_show_progress, bar),
                    path=history_path(path, method, drive),
                    resume=resume,
                    about=_about(method, drive, budget),
                )
            if math.isfinite(found.value):
                store.put(method.name, drive, _entry(method, drive, found, budget))
                store.save(path)
            else:
                failed.append(f'{method.name}, {drive}')
    if failed:
        raise RuntimeError(f'no settings gave a finite objective: {"; ".join(failed)}')
    return store


def history_path(path: Path, method: MethodDefinition, drive: str) -> Path:
    """Return where the history of one search is kept: in a folder beside ``path``."""
    return path.with_suffix('.history') / f'{method.short}.{drive}.jsonl'


def _show_progress(bar: 'tqdm[int]', standing: SearchProgress) -> None:
    bar.set_postfix_str(f'best {standing.best:.4f}', refresh=False)
    bar.update(standing.done - bar.n)


def _load_existing(
    path: Path, replaced: Sequence[tuple[str, str]], budget: TuningBudget
) -> TunedParameters:
    """Return what the file holds besides what is tuned now, if the two can be compared."""
    if not path.exists():
        return TunedParameters()
    store = TunedParameters.load(path)
    drives = {drive for _, drive in replaced}
    for method, drive in store:
        if drive not in drives:
            continue
        other = store.entry(method, drive).budget
        if (method, drive) not in replaced and other != budget:
            raise StoreError(
                f'{path} holds {method}, {drive}, which was tuned with {other}; this would be '
                f'{budget}: tune all again, or write to another file'
            )
    return store


def _objective(
    method: MethodDefinition, drive: str, evaluate: Evaluate
) -> Callable[[Sequence[Values]], list[float]]:
    start = method.start[drive]

    def objective(points: Sequence[Values]) -> list[float]:
        objectives = [math.inf] * len(points)
        candidates: dict[int, Parameters] = {}
        for i, values in enumerate(points):
            try:
                candidates[i] = start.with_values(values)
            except ParameterError:
                continue  # each in range, but they do not fit together: as bad as can be
        if candidates:
            found = evaluate(method, drive, list(candidates.values()))
            for i, value in zip(candidates, found, strict=True):
                objectives[i] = value
        return objectives

    return objective


def _about(method: MethodDefinition, drive: str, budget: TuningBudget) -> dict[str, object]:
    """Return what tells this search from others, beside its evaluations and seed."""
    scenarios = asdict(budget)
    del scenarios['evaluations'], scenarios['search_seed']
    controller = method.controller_type.__qualname__
    origin = {'drive': drive, 'version': VERSION}
    return {'method': method.name, 'controller': controller, **origin, **scenarios}


def _entry(
    method: MethodDefinition, drive: str, found: SearchResult, budget: TuningBudget
) -> TunedEntry:
    first = found.start_value
    return TunedEntry(
        values=method.start[drive].with_values(found.values).to_dict(),
        tuned=method.space.names,
        objective=found.value,
        start_objective=first if math.isfinite(first) else None,
        budget=budget,
        version=VERSION,
    )
