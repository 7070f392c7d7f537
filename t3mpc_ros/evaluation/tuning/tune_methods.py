# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tunes many methods with an equal budget and stores the result."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
import math
from pathlib import Path

from tqdm import tqdm

import t3mpc_ros
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.tuning.cma_search import SearchProgress, SearchResult, search_best
from t3mpc_ros.evaluation.tuning.objective import SMOOTHNESS, ClosedLoopObjective, TuningScenarios
from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition, Values, check_names
from t3mpc_ros.evaluation.tuning.tuned_parameters import (
    StoreError,
    TunedEntry,
    TunedParameters,
    TuningBudget,
)
from t3mpc_ros.parameters.table import ParameterError, Parameters

Evaluate = Callable[[MethodDefinition, str, Sequence[Parameters]], Sequence[float]]
"""Returns the objective of each of several parameters of a method in a drive."""

SEARCH_SEED = 1
"""Of the search itself; the same for every method."""


def tune_methods(
    methods: Sequence[MethodDefinition],
    drives: Sequence[str],
    evaluations: int,
    workers: int,
    path: Path,
    report: Callable[[str], None] | None = None,
    *,
    resume: bool = False,
    training: TuningScenarios | None = None,
    evaluate: Evaluate | None = None,
    seed: int = SEARCH_SEED,
) -> TunedParameters:
    """Return the best parameters of each method in each of its drives.

    Each pair has a search of its own with ``evaluations`` evaluations. The file is written after
    each, and the history of each search beside it; what the file holds of other methods stays.

    Parameters
    ----------
    methods
        Of different names.
    drives
        Keys of the start parameters: ``'torque'``, ``'velocity'``, or ``'twin'`` with its own
        ``evaluate``; a method without start parameters for one is left out there.
    evaluations
        Of each search.
    workers
        How many processes run the closed loop.
    path
        Where the tuned parameters are kept.
    report
        Receives messages; with None there is no progress line either.
    resume
        Go on with searches that were interrupted.
    training
        The runs of an evaluation.
    evaluate
        In place of the closed loop.
    seed
        Of every search.

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
        seed,
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
                    seed,
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
    return path.with_suffix('.history') / f'{method.short}.{drive}.json'


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
    return {
        'method': method.name,
        'controller': method.controller_type.__qualname__,
        'drive': drive,
        'training_seeds': budget.training_seeds,
        'noise_levels': budget.noise_levels,
        'duration': budget.duration,
        'smoothness': budget.smoothness,
        'cases': budget.cases,
        'version': t3mpc_ros.__version__,
    }


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
        version=t3mpc_ros.__version__,
    )
