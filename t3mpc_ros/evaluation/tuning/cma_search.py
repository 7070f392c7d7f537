# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
from dataclasses import dataclass
import json
import math
from pathlib import Path
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.tuning.search_space import SearchSpace, Values
from t3mpc_ros.parameters.table import Parameters

Array = NDArray[np.float64]
Objective = Callable[[Sequence[Values]], Sequence[float]]
"""Returns one value for each of several points, which may be evaluated at the same time."""

STEP = 0.15
"""Standard deviation of the first generation, as a share of each range.

Smaller than the 0.2 to 0.3 that is usual: the start is an educated guess and evaluations are few.
"""
RESOLUTION = 1e-4
"""A search that samples closer together than this share of each range has converged."""

_FORMAT = 1
_PENALTY = 1e100
_FEWEST = 5  # generations that a search which begins again must still have before it
_SAME = 1e-6  # how far a point that is asked for again may lie from the one in the history


@dataclass(frozen=True, slots=True)
class Evaluation:
    """One point that was tried."""

    values: Values
    value: float
    """Value of the objective; infinite if that was not finite."""


@dataclass(frozen=True, slots=True)
class SearchProgress:
    """How far a search has come."""

    done: int
    total: int
    best: float


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of a search."""

    values: Values
    """The best tuned parameters of all evaluations, the start included."""
    value: float
    """Their objective; infinite when no evaluation gave a finite number."""
    history: tuple[Evaluation, ...]
    """Every evaluation in order; the first is the start."""

    @property
    def start_value(self) -> float:
        """The objective where the search began."""
        return self.history[0].value


def search_best(
    objective: Objective,
    space: SearchSpace,
    start: Parameters,
    evaluations: int,
    seed: int,
    report: Callable[[SearchProgress], None] | None = None,
    *,
    path: Path | None = None,
    resume: bool = False,
    about: Mapping[str, object] | None = None,
) -> SearchResult:
    """Return the best of exactly ``evaluations`` points, the first of which is ``start``.

    The last point is the mean of the distribution, where the search believes the optimum to be,
    unless no generation was completed before. Equal arguments give equal results, bit for bit,
    however often the search was interrupted and resumed.

    Parameters
    ----------
    objective
        To be made small. Called once for the start and once for each generation.
    report
        Called after each generation.
    path, resume
        File for the history, written after each generation, and whether what it holds is taken as
        already evaluated. Without such a file the search begins anew.
    about
        Plain data that tells this objective from others; a history with another is refused.

    Raises
    ------
    ValueError
        Counts that are too small; an objective that returns another number of values; a
        history that is damaged or belongs to another search.
    """
    if evaluations < 1:
        raise ValueError(f'evaluations must be at least 1: got {evaluations}')
    first = space.of(start)
    head: dict[str, object] = {
        'space': space.describe(),
        'start': start.to_dict(),
        'evaluations': evaluations,
        'seed': seed,
        'about': dict(about or {}),
    }
    course = _Evaluator(objective, space, evaluations, report, _History(path, head, resume))
    origin = space.point(first)
    course.evaluate([origin], [first])
    generations = _Generations(origin, seed)
    while course.left > generations.size:
        values = course.evaluate(generations.ask())
        generations.update(values, course.left)
    if course.left:
        points = generations.ask()[: course.left]
        if generations.learnt:
            points[-1] = generations.mean
        course.evaluate(points)
    return course.result()


class _Evaluator:
    """The evaluations of one search: made, or taken from the history, and counted."""

    def __init__(
        self,
        objective: Objective,
        space: SearchSpace,
        total: int,
        report: Callable[[SearchProgress], None] | None,
        history: '_History',
    ) -> None:
        self._objective = objective
        self._space = space
        self._total = total
        self._report = report
        self._history = history
        self._done: list[Evaluation] = []

    @property
    def left(self) -> int:
        return self._total - len(self._done)

    def evaluate(
        self, points: Sequence[Array], values: Sequence[Values] | None = None
    ) -> list[float]:
        """Return the objective at each point, infinite where it is not a finite number."""
        asked = [self._space.values(point) for point in points] if values is None else values
        known = self._history.recall(points)
        if known is None:
            # Copies: the history stays true whatever the objective does to its argument.
            returned = [float(value) for value in self._objective([dict(each) for each in asked])]
            if len(returned) != len(points):
                raise ValueError(
                    f'objective must return one value a point, {len(points)}: got {len(returned)}'
                )
            known = [value if math.isfinite(value) else math.inf for value in returned]
            self._history.add(points, known)
        self._done += [
            Evaluation(dict(each), value) for each, value in zip(asked, known, strict=True)
        ]
        if self._report is not None:
            best = self.result().value
            self._report(SearchProgress(len(self._done), self._total, best))
        return known

    def result(self) -> SearchResult:
        best = min(self._done, key=lambda each: each.value)  # the earliest of equals
        return SearchResult(best.values, best.value, tuple(self._done))


class _Generations:
    """Points to be tried next, by CMA-ES; begun anew elsewhere once it has converged."""

    def __init__(self, origin: Array, seed: int) -> None:
        self._n = origin.size
        self._random = np.random.default_rng(seed)
        self._largest = 0.0
        self._smallest = 4 + int(3.0 * math.log(max(self._n, 2)))
        self._begin(origin, self._smallest)

    @property
    def size(self) -> int:
        """Points of a generation."""
        return int(self._strategy.popsize)

    @property
    def learnt(self) -> bool:
        """Whether the distribution has moved from where it began."""
        return bool(self._strategy.countiter > 0)

    @property
    def mean(self) -> Array:
        """Mean of the distribution, folded into the cube, shape (n,)."""
        inside = self._strategy.boundary_handler.repair(self._strategy.mean)
        return self._cut(inside)

    def ask(self) -> list[Array]:
        """Return the next generation, points of shape (n,) in the cube."""
        self._asked = self._strategy.ask()
        return [self._cut(point) for point in self._asked]

    def update(self, values: Sequence[float], left: int) -> None:
        """Move the distribution by the values of the points last asked for.

        An infinite value counts as worse than any yet seen; ``left`` is how many evaluations
        there will still be.
        """
        finite = [abs(value) for value in values if math.isfinite(value)]
        self._largest = max([self._largest, *finite])
        # Only the order counts, but the strategy also takes differences: nothing infinite.
        worst = min(2.0 * self._largest + 1.0, _PENALTY)
        self._strategy.tell(self._asked, np.clip(values, -_PENALTY, worst).tolist())
        if self._strategy.stop():
            larger = min(2 * self.size, left // _FEWEST)
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

    def _cut(self, point: Array) -> Array:
        cut: Array = np.clip(np.asarray(point, dtype=np.float64)[: self._n], 0.0, 1.0)
        return cut


class _History:
    """Evaluations in a file; an interrupted search reads them back."""

    def __init__(self, path: Path | None, head: Mapping[str, object], resume: bool) -> None:
        self._path = path
        # As JSON has it, so that what is read back compares equal.
        self._head: dict[str, object] = json.loads(json.dumps(head))
        self._points: list[list[float]] = []
        self._values: list[float] = []
        self._recalled = 0
        if path is not None and resume and path.exists():
            self._load(path)

    def recall(self, points: Sequence[Array]) -> list[float] | None:
        """Return the values of the generation if they are known, None from the first unknown."""
        begin, end = self._recalled, self._recalled + len(points)
        if begin == len(self._points):
            return None
        saved = np.array(self._points[begin:end])
        if saved.shape != (len(points), points[0].size):
            raise ValueError(f'{self._path} ends within a generation: it is damaged')
        if not np.allclose(saved, points, rtol=0.0, atol=_SAME):
            raise ValueError(
                f'{self._path} holds other points than this search asks for '
                f'(evaluations {begin + 1} to {end}): it was made by another version'
            )
        self._recalled = end
        return self._values[begin:end]

    def add(self, points: Sequence[Array], values: Sequence[float]) -> None:
        """Keep a generation, and write the file."""
        self._points += [point.tolist() for point in points]
        self._values += values
        self._recalled = len(self._points)
        if self._path is not None:
            evaluated = [
                # JSON has no infinity.
                {'point': point, 'value': value if math.isfinite(value) else None}
                for point, value in zip(self._points, self._values, strict=True)
            ]
            content = {'format': _FORMAT, **self._head, 'history': evaluated}
            write_atomically(self._path, json.dumps(content, allow_nan=False) + '\n')

    def _load(self, path: Path) -> None:
        try:
            content = json.loads(path.read_text(encoding='utf-8'))
            head = {name: content[name] for name in self._head}
            if content['format'] != _FORMAT:
                raise ValueError(f'format must be {_FORMAT}: got {content["format"]!r}')
            for each in content['history']:
                value = math.inf if each['value'] is None else float(each['value'])
                if math.isnan(value):
                    raise ValueError('a value must be a number or null: got NaN')
                self._points.append([float(p) for p in each['point']])
                self._values.append(value)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f'{path} is no history of a search: {error!r}') from error
        for name, own in self._head.items():
            if head[name] != own:
                raise ValueError(
                    f'{path} is the history of another search: '
                    f'its {name} is {head[name]}, not {own}'
                )
