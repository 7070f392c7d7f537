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
"""Tuned parameters of all methods in one JSON file of the package, and what each tuning was given.

The file holds all parameters of a method, not only the tuned ones: it shows what was compared
when a default changes later.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
import json
from pathlib import Path
from typing import Any, Self, TypeVar

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.result_output import Table, strict_json
from t3mpc_ros.evaluation.scenario import PLANT_OF, TUNING_SEEDS, Scenario
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

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
