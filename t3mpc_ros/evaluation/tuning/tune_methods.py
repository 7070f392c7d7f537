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
"""Tuning of the methods in the closed loop, on both plants and the twin, with equal effort.

On the twin, half of the runs of an evaluation are on the default one, half on the miscalibrated
one, on which the baselines have the gyro.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import BrokenExecutor, Executor
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
import math
from pathlib import Path
from typing import Any, Self

import numpy as np
from tqdm import tqdm

from t3mpc_ros.control.controller import ControllerParameters, StepperControllerParameters
from t3mpc_ros.evaluation.confidence_intervals import Difference, paired, rms
from t3mpc_ros.evaluation.experiment import Job, JobError, Report, WorkerPool
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.method_table import FULL, further_methods, methods, twin_start
from t3mpc_ros.evaluation.proposed_method import ProposedController
from t3mpc_ros.evaluation.result_output import progress_bar
from t3mpc_ros.evaluation.run_record import START, VARIATION, measure, rolling_speeds
from t3mpc_ros.evaluation.scenario import KINDS, TUNING_SEEDS, Scenario
from t3mpc_ros.evaluation.tuning.cma_search import search_best
from t3mpc_ros.evaluation.tuning.tuned_parameters import (
    SMOOTHNESS,
    MethodDefinition,
    SearchRange,
    StoreError,
    TunedEntry,
    TunedParameters,
    TuningBudget,
    Values,
)
from t3mpc_ros.parameters.table import ParameterError, Parameters
from t3mpc_ros.version import VERSION


def objective(job: Job) -> float:
    """Return RMSE + rho chatter of a run, rad/s; infinite for a run that diverged."""
    record = run(*job)
    value = record.rmse() + SMOOTHNESS * record.variation()
    return value if math.isfinite(value) else math.inf


class ClosedLoopObjective:
    """Mean objective of parameters in the closed loop; several are evaluated at the same time.

    To be used in a ``with`` statement: the processes stay warm between generations. ``report``
    receives the error text of parameters with which a run raised an exception; ``cost`` is the
    objective of one run, a function of a module.
    """

    def __init__(
        self,
        budget: TuningBudget,
        workers: int | Executor,
        report: Report | None = None,
        cost: Callable[[Job], float] = objective,
    ) -> None:
        self.workers = WorkerPool(workers)
        self._budget, self._report, self._cost = budget, report, cost
        self._ran: set[tuple[str, str]] = set()

    def __enter__(self) -> Self:
        self.workers.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.workers.__exit__(*error)

    def __call__(
        self, method: MethodDefinition, drive: str, candidates: Sequence[Parameters]
    ) -> list[float]:
        """Return the mean objective of each candidate, infinite where a run diverged or failed.

        JobError if a process was lost, or runs failed with every candidate of a method that never
        ran before: it is at fault then, not the parameters.
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
        """Return the mean objective of each candidate, infinite where a run diverged."""
        scenarios = self._budget.scenarios(drive)
        jobs = [
            (scenario, method.compared(candidate, drive))
            for candidate in candidates
            for scenario in scenarios
        ]
        found = [value for _, value in sorted(self.workers.map(self._cost, jobs))]
        runs = len(scenarios)
        # math.fsum has no order; infinities add to infinity.
        return [math.fsum(found[i : i + runs]) / runs for i in range(0, len(found), runs)]


Evaluate = Callable[[MethodDefinition, str, Sequence[Parameters]], Sequence[float]]
"""Returns the objective of each of several parameters of a method in a drive."""


def tune_methods(
    methods: Sequence[MethodDefinition],
    drives: Sequence[str],
    budget: TuningBudget,
    workers: int | Executor,
    path: Path,
    report: Report | None = None,
    *,
    resume: bool = False,
    evaluate: Evaluate | None = None,
) -> TunedParameters:
    """Return the best parameters of each method in each of its drives.

    Each pair has a search of its own with the same budget; ``resume`` goes on with searches that
    were interrupted. The file ``path`` is written after each, and the history of each search
    beside it; what the file holds of other methods stays.

    ``drives`` are keys of the start parameters: ``'torque'``, ``'velocity'``, or ``'twin'`` with
    its own ``evaluate`` in place of the closed loop. Without ``report`` there is no progress line
    either. ValueError: methods of one name, a drive that no method is meant for, or a file with
    other methods tuned in the same drive with another budget. RuntimeError: for some method no
    parameters gave a finite objective; all others are kept.
    """
    names = [method.short for method in methods]
    if len({*names}) < len(names):
        raise ValueError(f'methods must have different names: got {", ".join(names)}')
    for drive in drives:
        if not any(drive in method.start for method in methods):
            raise ValueError(f'no method to be tuned is meant for drive {drive!r}')
    pairs = [(each, drive) for each in methods for drive in drives if drive in each.start]
    store = _load_existing(path, [(method.name, drive) for method, drive in pairs], budget)
    failed = []
    with ExitStack() as stack:
        if evaluate is None:
            evaluate = stack.enter_context(ClosedLoopObjective(budget, workers, report))
        for method, drive in pairs:
            with progress_bar(budget.evaluations, 'evaluations', show=report is not None) as bar:
                bar.set_description(f'{method.name}, {drive}')
                found = search_best(
                    _objective(method, drive, evaluate),
                    method.space,
                    method.start[drive],
                    budget.evaluations,
                    budget.search_seed,
                    partial(_show_progress, bar),
                    path=history_path(path, method, drive),
                    resume=resume,
                    about=_about(method, drive, budget),
                )
            if not math.isfinite(found.value):
                failed.append(f'{method.name}, {drive}')
                continue
            first = found.history[0].value
            store[method.name, drive] = TunedEntry(
                values=method.start[drive].with_values(found.values).to_dict(),
                tuned=method.space.names,
                objective=found.value,
                start_objective=first if math.isfinite(first) else None,
                budget=budget,
                version=VERSION,
            )
            store.save(path)
    if failed:
        raise RuntimeError(f'no settings gave a finite objective: {"; ".join(failed)}')
    return store


def history_path(path: Path, method: MethodDefinition, drive: str) -> Path:
    """Return where the history of one search is kept: in a folder beside ``path``."""
    return path.with_suffix('.history') / f'{method.short}.{drive}.jsonl'


def _show_progress(bar: 'tqdm[int]', done: int, best: float) -> None:
    bar.set_postfix_str(f'best {best:.4f}', refresh=False)
    bar.update(done - bar.n)


def _load_existing(
    path: Path, replaced: Sequence[tuple[str, str]], budget: TuningBudget
) -> TunedParameters:
    """Return what the file holds besides what is tuned now, if the two can be compared."""
    if not path.exists():
        return TunedParameters()
    store = TunedParameters.load(path)
    drives = {drive for _, drive in replaced}
    for (method, drive), entry in store.items():
        if drive in drives and (method, drive) not in replaced and entry.budget != budget:
            raise StoreError(
                f'{path} holds {method}, {drive}, which was tuned with {entry.budget}; this would '
                f'be {budget}: tune all again, or write to another file'
            )
    return store


def _objective(
    method: MethodDefinition, drive: str, evaluate: Evaluate
) -> Callable[[Sequence[Values]], list[float]]:
    start = method.start[drive]

    def objective(points: Sequence[Values]) -> list[float]:
        candidates: dict[int, Parameters] = {}
        for i, values in enumerate(points):
            # Some are in range each, but do not fit together: as bad as can be.
            with suppress(ParameterError):
                candidates[i] = start.with_values(values)
        found = evaluate(method, drive, [*candidates.values()]) if candidates else ()
        objectives = dict(zip(candidates, found, strict=True))
        return [objectives.get(i, math.inf) for i in range(len(points))]

    return objective


def _about(method: MethodDefinition, drive: str, budget: TuningBudget) -> dict[str, object]:
    """Return what tells this search from others, beside its evaluations and seed."""
    scenarios = asdict(budget)
    del scenarios['evaluations'], scenarios['search_seed']
    controller = method.controller_type.__qualname__
    origin = {'drive': drive, 'version': VERSION}
    return {'method': method.name, 'controller': controller, **origin, **scenarios}


# -- twin -----------------------------------------------------------------------------------------

TWIN = KINDS['twin'].tuned_for
CASES = ('nominal', 'miscalibrated')
TRAINING = TuningBudget(training_seeds=TUNING_SEEDS[:2], noise_levels=(0.04,), cases=CASES)
"""Runs of one evaluation."""
VALIDATION_SEEDS = TUNING_SEEDS[2:]
"""Seeds on which the tuned parameters of the full controller are compared with its defaults."""
FULL_RANGES = (
    SearchRange('body.wheel_tolerance', 0.002, 0.1),
    SearchRange('body.yaw_gain', 0.02, 1.0),
    SearchRange('body.max_yaw_correction', 0.01, 1.0),
)
"""What is free in the full controller after the rule for the gains."""
GAIN_RANGE = SearchRange('gain', 5.0, 100.0)
"""Range of the feedback gain of a baseline; it includes that of :func:`twin_start`."""


def twin_definitions(known: Iterable[MethodDefinition]) -> list[MethodDefinition]:
    """Return the methods as they are tuned on the twin.

    Baselines start from the parameters for the velocity drive, see :func:`twin_start`; the full
    controller from the defaults of the node.
    """
    tuned = methods('velocity') | further_methods('velocity')
    found = []
    for each in known:
        if each.name == FULL:
            start: Parameters = StepperControllerParameters()
            found.append(
                MethodDefinition(
                    FULL, ProposedController, {TWIN: start}, FULL_RANGES, ControllerParameters
                )
            )
            continue
        ranges = tuple(GAIN_RANGE if one.name == 'gain' else one for one in each.ranges)
        start = each.start.get(TWIN) or twin_start(tuned[each.name].parameters)
        found.append(replace(each, start={TWIN: start}, ranges=ranges))
    return found


def twin_objective(job: Job) -> float:
    """Return RMSE + rho times the variation of a run, rad/s; infinite if it is not finite.

    On the default twin the error is that of the rotors. Where the baselines have the gyro it is
    that of wheels rolling without slip under the true motion of the body: a method that corrects
    the body must not lose by it.
    """
    scenario, method = job
    record = run(scenario, method)
    counted = record.time >= record.start + START
    speeds = record.speeds
    if scenario.uses_gyro:
        speeds = rolling_speeds(record, scenario.true_robot().geometry)
    rmse = rms((speeds - record.reference)[counted])
    value = rmse + SMOOTHNESS * measure(record)[VARIATION.name]
    return value if math.isfinite(value) else math.inf


def validate(
    method: MethodDefinition, tuned: TunedEntry, objective: ClosedLoopObjective
) -> Difference:
    """Return the paired difference (rad/s) of the objective, tuned parameters less start.

    Each of :data:`VALIDATION_SEEDS` is driven in every case.
    """
    start = method.start[TWIN]
    found = start.with_values({name: tuned.values[name] for name in tuned.tuned})
    jobs = [
        (Scenario(TWIN, case, seed, TRAINING.duration), method.compared(parameters, TWIN))
        for seed in VALIDATION_SEEDS
        for case in CASES
        for parameters in (found, start)
    ]
    values = np.array([value for _, value in sorted(objective.workers.map(twin_objective, jobs))])
    with_tuned, with_start = values.reshape(-1, len(CASES), 2).mean(axis=1).T.tolist()
    return paired(with_tuned, with_start)


def tune_twin(
    selected: Sequence[MethodDefinition],
    evaluations: int,
    workers: int | Executor,
    path: Path,
    report: Report,
    *,
    resume: bool = False,
) -> TunedParameters:
    """Return the best parameters of each method on the twin; arguments as :func:`tune_methods`.

    The full controller keeps its defaults unless the tuned parameters are better on seeds that
    they were not tuned on, by more than the 95 % interval of the paired difference.
    """
    budget = replace(TRAINING, evaluations=evaluations)
    with ClosedLoopObjective(budget, workers, report, twin_objective) as objective:
        store = tune_methods(
            selected, [TWIN], budget, workers, path, report, resume=resume, evaluate=objective
        )
        for method in selected:
            if method.name != FULL:
                continue
            tuned = store.entry(FULL, TWIN)
            difference = validate(method, tuned, objective)
            better = difference.sign < 0
            report(
                f'  {FULL}, {TWIN}: on seeds {VALIDATION_SEEDS[0]} to {VALIDATION_SEEDS[-1]} the '
                f'tuned parameters differ from the defaults by {difference.mean:+.5f} ± '
                f'{difference.half:.5f} rad/s: {"they are stored" if better else "kept defaults"}'
            )
            if not better:
                assert tuned.start_objective is not None
                values = method.start[TWIN].to_dict()
                store[FULL, TWIN] = replace(tuned, values=values, objective=tuned.start_objective)
                store.save(path)
    return store
