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
r"""Tuned parameters of all methods: where they are searched, and the JSON file of what was found.

A search works in the unit cube. A parameter x in [a, b] and its coordinate p in [0, 1] are

.. math:: x = a\,(b/a)^p \quad\text{(logarithmic)}, \qquad x = a + p\,(b - a) \quad\text{(linear)}

so that equal steps are equal factors for gains and weights, whose order of magnitude is unknown.
An integer has an interval of equal length around each value: a and b are extended by one half.

The file holds all parameters of a method, not only the tuned ones: it shows what was compared
when a default changes later.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
import json
import math
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.evaluation.loop import Method, MethodSpec, NodeMethod
from t3mpc_ros.evaluation.result_output import Table, strict_json
from t3mpc_ros.evaluation.scenario import PLANT_OF, TUNING_SEEDS, Scenario
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import (
    ParameterError,
    Parameters,
    nearest_hint,
    parameter,
    short_name,
)

Values = dict[str, int | float]
"""Tuned parameters by their dotted names."""


@dataclass(frozen=True, slots=True)
class SearchRange:
    """Where one parameter is searched: bounds, both included, in the unit of the parameter.

    With ``log`` equal steps are equal factors; ``low`` must then be above 0.
    """

    name: str
    low: float
    high: float
    log: bool = True


class SearchSpace:
    """The tuned parameters of one table, as the unit cube; coordinates are in order of ``ranges``.

    ParameterError: a name that the table does not have, or has no number for; a range that is
    empty, or goes beyond the parameter's own bounds.
    """

    def __init__(self, table: type[Parameters], ranges: Sequence[SearchRange]) -> None:
        specs = {spec.name: spec for spec in table.specs()}
        self.ranges = tuple(ranges)
        for each in self.ranges:
            if each.name not in specs:
                hint = nearest_hint(each.name, specs)
                raise ParameterError(f'{table.__name__} has no parameter {each.name}{hint}')
            spec = specs[each.name]
            if spec.many or spec.kind not in (int, float):
                raise ParameterError(f'{each.name} cannot be tuned: it must be one number')
            if not each.low < each.high or (each.log and each.low <= 0.0):
                raise ParameterError(f'{each.name} cannot be tuned: its range is {each}')
            for bound in (each.low, each.high):
                spec.check(spec.kind(bound))
        self._whole = [specs[each.name].kind is int for each in self.ranges]
        self._ends: list[tuple[float, float]] = []
        """What p = 0 and p = 1 stand for, before exp where the range is logarithmic."""
        for each, whole in zip(self.ranges, self._whole, strict=True):
            low, high = (each.low - 0.5, each.high + 0.5) if whole else (each.low, each.high)
            ends = (math.log(low), math.log(high)) if each.log else (float(low), float(high))
            self._ends.append(ends)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tuned parameters, in the order of the coordinates."""
        return tuple(each.name for each in self.ranges)

    def values(self, point: Array) -> Values:
        """Return the parameters at a point of the unit cube, exactly within their ranges."""
        result: Values = {}
        for each, whole, (low, high), p in zip(
            self.ranges, self._whole, self._ends, point.tolist(), strict=True
        ):
            x = low + p * (high - low)
            if each.log:
                x = math.exp(x)
            # Rounding may leave the last digit of an end outside.
            x = min(max(x, each.low), each.high)
            result[each.name] = round(x) if whole else x
        return result

    def of(self, parameters: Parameters) -> Values:
        """Return the tuned parameters of a table as they are."""
        values = parameters.to_dict()
        return {name: values[name] for name in self.names}  # type: ignore[misc]

    def point(self, parameters: Parameters) -> Array:
        """Return the point of the unit cube of a table, which must lie in the ranges, (n,)."""
        values = self.of(parameters)
        result = np.empty(len(self.ranges))
        for i, (each, (low, high)) in enumerate(zip(self.ranges, self._ends, strict=True)):
            x = values[each.name]
            if not each.low <= x <= each.high:
                raise ParameterError(
                    f'{each.name} must be in its range from {each.low:g} to {each.high:g}: '
                    f'got {x:g}'
                )
            result[i] = ((math.log(x) if each.log else x) - low) / (high - low)
        return np.clip(result, 0.0, 1.0)


@dataclass(frozen=True)
class MethodDefinition:
    """One line of the table of methods."""

    name: str
    """As it stands in tables and figures, for example ``'linear MPC'``."""
    controller_type: type[BaselineController]
    start: Mapping[str, Parameters]
    """By drive, or the twin, the parameters that its maker would choose: tuning begins there."""
    ranges: tuple[SearchRange, ...]
    """What is tuned, in either drive. All else stays as in ``start``."""
    table: type[Parameters] | None = None
    """Table of the controller of the node, whose method this is then."""

    def __post_init__(self) -> None:
        for drive, parameters in self.start.items():
            try:
                self.space.point(parameters)
            except ParameterError as error:
                raise ParameterError(f'{self.name}, {drive}: {error}') from error

    @property
    def space(self) -> SearchSpace:
        """What is searched."""
        return SearchSpace(self.table or self.controller_type.parameters_type, self.ranges)

    def compared(self, parameters: Parameters, drive: str) -> Method:
        """Return the method with parameters; on the paper's plant after its pre-training."""
        if self.table is None:
            trained = drive in PLANT_OF
            return MethodSpec(self.name, self.controller_type, parameters, pretrained=trained)
        values = parameters.to_dict()
        return NodeMethod(self.name, {name: values[name] for name in self.space.names})

    @property
    def short(self) -> str:
        """The name for command lines and files."""
        return short_name(self.name)


# -- what a tuning is given, and what was found ---------------------------------------------------


SMOOTHNESS = 1e-5
"""rho, s²: what a unit of chatter (rad/s³) costs in tracking error (rad/s).

Small: 1000 rad/s³ of total variation of u per second cost 0.01 rad/s. It keeps a method from
buying the last percent of tracking with a command that shakes the motors, and decides between
parameters that track alike; it is too small to make any method track worse to be smooth.
"""
PACKAGED_FILE = Path(__file__).resolve().parent / 'tuned.json'
"""Bundled file of tuned parameters."""

_FORMAT = 1
T = TypeVar('T', bound=Parameters)


class StoreError(ValueError):
    """A file of tuned parameters is invalid; the text gives position and reason."""


@dataclass(frozen=True)
class TuningBudget(Parameters):
    """What a tuning is given: a comparison is fair when it is equal for all.

    An evaluation is one run for each seed, none of which is one of the results. Run i has noise
    level i and case i, both counted round; there are seeds enough for each.
    """

    evaluations: int = parameter(1, 'evaluations of the objective', bounds=(1, None))
    search_seed: int = parameter(1, 'seed of the search')
    training_seeds: tuple[int, ...] = parameter(TUNING_SEEDS, 'runs of one evaluation')
    noise_levels: tuple[float, ...] = parameter(
        (0.0, 0.04, 0.1),
        'noise of the wheel speeds, counted round the runs',
        '(rad/s)²',
        (0.0, None),
    )
    duration: float = parameter(
        26.0, 'length of each run; in 26 s the reference switches twice', 's', (0.0, None)
    )
    smoothness: float = parameter(SMOOTHNESS, 'rho of the objective', 's²', (0.0, None))
    cases: tuple[str, ...] = parameter(('nominal',), 'cases, counted round the runs')

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` unless there is a seed for each noise level and case."""
        seeds = len(self.training_seeds)
        if len({*self.training_seeds}) != seeds:
            raise ParameterError(f'training_seeds must differ: got {self.training_seeds}')
        for name, values in (('noise_levels', self.noise_levels), ('cases', self.cases)):
            if not 1 <= len(values) <= seeds:
                raise ParameterError(f'{name} must be 1 to {seeds}, a seed each: got {values}')

    def scenarios(self, drive: str) -> list[Scenario]:
        """Return the runs of one evaluation on the paper's plant with a drive, or on the twin."""
        return [
            Scenario(
                PLANT_OF.get(drive, drive),
                self.cases[i % len(self.cases)],
                seed,
                self.duration,
                self.noise_levels[i % len(self.noise_levels)],
            )
            for i, seed in enumerate(self.training_seeds)
        ]

    def __str__(self) -> str:
        seeds = ', '.join(map(str, self.training_seeds))
        levels = ', '.join(f'{level:g}' for level in self.noise_levels)
        return (
            f'{self.evaluations} evaluations (search seed {self.search_seed}) of '
            f'{self.duration:g} s on seeds {seeds} at noise {levels}, {", ".join(self.cases)}, '
            f'rho = {self.smoothness:g} s²'
        )


@dataclass(frozen=True, slots=True)
class TunedEntry:
    """What was found for one method in one drive, or on the twin."""

    values: Mapping[str, object]
    """Every parameter of the method by its dotted name."""
    tuned: tuple[str, ...]
    """The names among them that were searched."""
    objective: float
    """Mean objective of ``values``, rad/s."""
    start_objective: float | None
    """That of the parameters the search began with, rad/s; None when they did not even run."""
    budget: TuningBudget
    version: str
    """Of this package, when it was found."""

    @classmethod
    def from_dict(
        cls,
        values: Mapping[str, object],
        tuned: Sequence[str],
        budget: Mapping[str, object],
        **others: Any,
    ) -> Self:
        """Return an entry of the file; JSON has lists in place of tuples."""
        made = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
        if missing := {*tuned} - {*made}:
            raise StoreError(f'{", ".join(sorted(missing))} was tuned, but has no value')
        return cls(made, tuple(tuned), budget=TuningBudget.from_dict(budget), **others)


class TunedParameters(dict[tuple[str, str], TunedEntry]):
    """Tuned parameters by (method, drive); those for the digital twin have drive ``twin``."""

    @classmethod
    def load(cls, path: Path = PACKAGED_FILE) -> Self:
        """Return the content of a file; raise :class:`StoreError` if it is no such file."""
        try:
            content = json.loads(path.read_text(encoding='utf-8'))
            if content['format'] != _FORMAT:
                raise StoreError(f'format must be {_FORMAT}: got {content["format"]!r}')
            return cls(
                {
                    (method, drive): TunedEntry.from_dict(**found)
                    for method, drives in content['methods'].items()
                    for drive, found in drives.items()
                }
            )
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise StoreError(f'{path} holds no tuned parameters: {error}') from error

    def to_dict(self) -> dict[str, object]:
        """Return the content of the file as plain data."""
        methods: dict[str, dict[str, object]] = {}
        for (method, drive), entry in sorted(self.items()):
            methods.setdefault(method, {})[drive] = asdict(
                replace(entry, values=dict(entry.values))
            )
        return {'format': _FORMAT, 'methods': methods}

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, strict_json(self.to_dict()))

    def entry(self, method: str, drive: str) -> TunedEntry:
        """Return what was found for a method in a drive."""
        if (method, drive) not in self:
            known = ', '.join(' in '.join(key) for key in self) or 'nothing'
            raise StoreError(f'{method} was not tuned in drive {drive}; what was: {known}')
        return self[method, drive]

    def applied(self, method: str, drive: str, start: T) -> T:
        """Return ``start`` with the parameters that were tuned; all others stay as they are."""
        entry = self.entry(method, drive)
        try:
            return start.with_values({name: entry.values[name] for name in entry.tuned})
        except ParameterError as error:
            raise StoreError(f'{method}, {drive}: {error}') from error

    def check_equal(self) -> None:
        """Raise :class:`StoreError` unless all entries of a drive were given the same budget."""
        first: dict[str, tuple[str, str]] = {}
        for key, entry in self.items():
            other = first.setdefault(key[1], key)
            if entry.budget != self[other].budget:
                raise StoreError(
                    f'{key[0]}, {key[1]} was tuned with {entry.budget}; '
                    f'{other[0]}, {other[1]} with {self[other].budget}'
                )

    def table(self) -> str:
        """Return the improvement by tuning as a Markdown table."""
        head = 'method', 'drive', 'objective at start (rad/s)', 'tuned', 'tuned parameters'
        rows = []
        for (method, drive), entry in sorted(self.items()):
            start = entry.start_objective
            first = 'none' if start is None else f'{start:.4f}'
            numbers = f'{entry.objective:.4f}', str(len(entry.tuned))
            rows.append((method, drive, first, *numbers, str(entry.budget.evaluations)))
        return Table('', (*head, 'evaluations'), rows).markdown()
