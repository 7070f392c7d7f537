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
"""CMA-ES search in the unit cube with a fixed number of evaluations and a resumable history.

CMA-ES samples a generation from a normal distribution and moves its mean and covariance towards
the better half; it uses only the order of the values, so neither their scale nor outliers matter
(N. Hansen, The CMA Evolution Strategy: A Tutorial, arXiv:1604.00772). pycma's ``BoundTransform``
keeps the bounds: a smooth map folds samples beyond a face of the cube back, so no evaluation is
spent outside. A search that converges early restarts at a random point of the cube with
generations up to twice as large (IPOP, A. Auger and N. Hansen, 2005,
doi 10.1109/CEC.2005.1554902): every method uses its whole budget.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
import hashlib
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import cma
import numpy as np

from t3mpc_ros.evaluation.experiment import ResultFile
from t3mpc_ros.evaluation.tuning.tuned_parameters import SearchSpace, Values
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters

Objective = Callable[[Sequence[Values]], Sequence[float]]
"""Returns one value for each of several points, which may be evaluated at the same time."""
Progress = Callable[[int, float], None]
"""Receives the number of evaluations so far, and the best value."""

STEP = 0.15
"""Standard deviation of the first generation, as a share of each range.

Smaller than the 0.2 to 0.3 that is usual: the start is an educated guess and evaluations are few.
"""
RESOLUTION = 1e-4
"""A search that samples closer together than this share of each range has converged."""
GENERATIONS_LEFT = 5
"""Least number of generations that the rest of the budget must allow a search that restarts."""
WORST = 1e100
"""Value of a point whose objective is not finite, for pycma, which takes differences."""


class Evaluation(NamedTuple):
    """One point that was tried; the value is infinite if the objective was not finite."""

    values: Values
    value: float


class SearchResult(NamedTuple):
    """Result of a search."""

    values: Values
    """The best tuned parameters of all evaluations, the start included."""
    value: float
    """Their objective; infinite when no evaluation gave a finite number."""
    history: tuple[Evaluation, ...]
    """Every evaluation in order; the first is the start."""


def search_best(
    objective: Objective,
    space: SearchSpace,
    start: Parameters,
    evaluations: int,
    seed: int,
    report: Progress | None = None,
    *,
    path: Path | None = None,
    resume: bool = False,
    about: Mapping[str, object] | None = None,
) -> SearchResult:
    """Return the best of exactly ``evaluations`` points, the first of which is ``start``.

    The last point is the mean of the distribution, where the search believes the optimum to be,
    unless no generation was completed before. Equal arguments give equal results, bit for bit,
    however often the search was interrupted and resumed. ``objective`` is to be made small.

    ``path`` is the file of the evaluations, one a line; without ``resume`` what it holds is thrown
    away. ``about`` is plain data that tells this objective from others, whose lines in the file
    are left alone. ValueError: too few evaluations, or an objective that returns another number of
    values.
    """
    if evaluations < 1:
        raise ValueError(f'evaluations must be at least 1: got {evaluations}')
    origin = space.point(start)
    search = [dict(about or {}), repr(space.ranges), start.to_dict()]
    digest = hashlib.sha256(json.dumps(search).encode()).hexdigest()
    file = None if path is None else ResultFile(path, fresh=not resume)
    with file or nullcontext():
        evaluator = _Evaluator(objective, evaluations, digest, file, report)
        evaluator.evaluate([space.of(start)])
        generations = _Generations(origin, seed)
        while evaluator.left > generations.size:
            points = generations.ask()
            values = evaluator.evaluate([space.values(point) for point in points])
            generations.update(values, evaluator.left)
        if evaluator.left:
            points = generations.ask()[: evaluator.left]
            if generations.moved:
                points[-1] = generations.mean
            evaluator.evaluate([space.values(point) for point in points])
    best = evaluator.best
    return SearchResult(best.values, best.value, tuple(evaluator.done))


class _Evaluator:
    """The evaluations of one search: made once, or found in its file, and counted."""

    def __init__(
        self,
        objective: Objective,
        total: int,
        digest: str,
        file: ResultFile | None,
        report: Progress | None,
    ) -> None:
        self._objective, self._total, self._digest = objective, total, digest
        self._file, self._report = file, report
        self._known = {} if file is None else file.read()
        """Objective by digest of the search and tried parameters as JSON."""
        self.done: list[Evaluation] = []

    @property
    def left(self) -> int:
        return self._total - len(self.done)

    @property
    def best(self) -> Evaluation:
        return min(self.done, key=lambda each: each.value)  # the earliest of equals

    def evaluate(self, asked: Sequence[Values]) -> list[float]:
        """Return the objective of each, infinite where it is not a finite number."""
        keys = [f'{self._digest} {json.dumps(each)}' for each in asked]
        missing = [i for i, key in enumerate(keys) if key not in self._known]
        returned = self._objective([dict(asked[i]) for i in missing]) if missing else []
        if len(returned) != len(missing):
            raise ValueError(
                f'objective must return one value a point, {len(missing)}: got {len(returned)}'
            )
        for i, value in zip(missing, returned, strict=True):
            number = float(value) if math.isfinite(value) else math.inf
            self._known[keys[i]] = {'objective': number}
            if self._file is not None:
                self._file.add(keys[i], self._known[keys[i]])
        values = [float(self._known[key]['objective']) for key in keys]
        self.done += map(Evaluation, asked, values)
        if self._report is not None:
            self._report(len(self.done), self.best.value)
        return values


class _Generations:
    """Points to be tried next, by CMA-ES; begun anew elsewhere once it has converged."""

    def __init__(self, origin: Array, seed: int) -> None:
        self._n = origin.size
        self._random = np.random.default_rng(seed)
        self._smallest = 4 + int(3.0 * math.log(max(self._n, 2)))
        self._begin(origin, self._smallest)

    @property
    def size(self) -> int:
        """Points of a generation."""
        return int(self._strategy.popsize)

    @property
    def moved(self) -> bool:
        """Whether the distribution has moved from where it began."""
        return bool(self._strategy.countiter > 0)

    @property
    def mean(self) -> Array:
        """Mean of the distribution, folded into the cube, shape (n,)."""
        return self._inside(self._strategy.boundary_handler.repair(self._strategy.mean))

    def ask(self) -> list[Array]:
        """Return the next generation, points of shape (n,) in the cube."""
        self._asked = self._strategy.ask()
        return [self._inside(point) for point in self._asked]

    def update(self, values: Sequence[float], left: int) -> None:
        """Move the distribution by the values of the generation; ``left`` are still to come."""
        self._strategy.tell(self._asked, np.clip(values, -WORST, WORST).tolist())
        if self._strategy.stop():
            larger = min(2 * self.size, left // GENERATIONS_LEFT)
            self._begin(self._random.uniform(size=self._n), max(larger, self._smallest))

    def _begin(self, mean: Array, size: int) -> None:
        # pycma does not support one dimension: a second one that means nothing is added.
        begin = np.append(mean, 0.5) if self._n == 1 else mean
        options = {
            'bounds': [0.0, 1.0],
            'popsize': size,
            'tolx': RESOLUTION,
            'seed': math.nan,  # leaves numpy's global generator alone
            'randn': lambda *shape: self._random.standard_normal(shape),
            'verbose': -10,  # writes nothing, reads no file of signals
        }
        self._strategy: Any = cma.CMAEvolutionStrategy(begin, STEP, options)

    def _inside(self, point: Array) -> Array:
        return np.clip(np.asarray(point, dtype=np.float64)[: self._n], 0.0, 1.0)
