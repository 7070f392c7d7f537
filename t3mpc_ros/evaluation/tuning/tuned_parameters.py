# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tuned parameters of all methods in one JSON file of the package.

The file holds all parameters of a method, not only the tuned ones: a later change of a default
does not change what was compared. A file that does not fit the parameter tables is rejected.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
import json
import math
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Any, Self, TypeVar, get_args, get_origin, get_type_hints

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.reporting import Table
from t3mpc_ros.parameters.table import ParameterError, Parameters, nearest_hint

PACKAGED_FILE = Path(__file__).resolve().parent / 'tuned.json'
"""Bundled file of tuned parameters."""

_FORMAT = 1
T = TypeVar('T', bound=Parameters)


class StoreError(ValueError):
    """A file of tuned parameters is invalid; the text gives position and reason."""


@dataclass(frozen=True, slots=True)
class TuningBudget:
    """What a tuning was given: a comparison is fair when it is equal for all."""

    evaluations: int
    search_seed: int
    training_seeds: tuple[int, ...]
    """Runs of one evaluation; run i has noise level i, counted round."""
    noise_levels: tuple[float, ...]
    """Variances of the measured wheel speeds, (rad/s)²."""
    duration: float
    """Of each run, s."""
    smoothness: float
    """rho of the objective, s²."""
    cases: tuple[str, ...] = ('nominal',)
    """Run i has case i, counted round."""

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


class TunedParameters:
    """Tuned parameters by (method, drive); those for the digital twin have drive ``twin``."""

    def __init__(self, entries: Mapping[tuple[str, str], TunedEntry] | None = None) -> None:
        self._entries = dict(entries or {})

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """Return every (method, drive), in order."""
        return iter(sorted(self._entries))

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, key: object) -> bool:
        return key in self._entries

    @classmethod
    def load(
        cls, path: Path = PACKAGED_FILE, types: Mapping[str, type[Parameters]] | None = None
    ) -> Self:
        """Return the content of a file.

        With ``types``, the table of each method, every value is checked, and a method that is not
        in it is refused.

        Raises
        ------
        StoreError
            What it holds is not what :meth:`save` writes, or does not fit the tables.
        """
        try:
            content = json.loads(
                path.read_text(encoding='utf-8'),
                parse_constant=_refuse_constant,
                object_pairs_hook=_refuse_twice,
            )
            store = cls(_entries(content))
            if types is not None:
                store.check(types)
        except (StoreError, ValueError) as error:
            raise StoreError(f'{path}: {error}') from error
        return store

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        methods: dict[str, dict[str, Any]] = {}
        for method, drive in self:
            entry = self._entries[method, drive]
            found = asdict(replace(entry, values=dict(entry.values)))
            methods.setdefault(method, {})[drive] = found
        content = {'format': _FORMAT, 'methods': methods}
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        write_atomically(path, text + '\n')

    def put(self, method: str, drive: str, entry: TunedEntry) -> None:
        """Add or replace an entry."""
        self._entries[method, drive] = entry

    def entry(self, method: str, drive: str) -> TunedEntry:
        """Return what was found for a method in a drive."""
        try:
            return self._entries[method, drive]
        except KeyError:
            known = ', '.join(' in '.join(key) for key in self) or 'nothing'
            raise StoreError(
                f'{method} was not tuned in drive {drive}; what was: {known}'
            ) from None

    def parameters(self, method: str, drive: str, table: type[T]) -> T:
        """Return the tuned parameters of a method as its table."""
        entry = self.entry(method, drive)
        known = [row.name for row in table.specs()]
        where = f'{method}, {drive}'
        for name in [*entry.values, *entry.tuned]:
            if name not in known:
                raise StoreError(f'{where}: there is no setting {name}{nearest_hint(name, known)}')
        missing = [name for name in known if name not in entry.values]
        if missing:
            raise StoreError(f'{where}: settings are missing: {", ".join(missing)}')
        try:
            return table.from_dict(entry.values)
        except ParameterError as error:
            raise StoreError(f'{where}: {error}') from error

    def applied(self, method: str, drive: str, start: T) -> T:
        """Return ``start`` with the parameters that were tuned; all others stay as they are."""
        entry = self.entry(method, drive)
        try:
            return start.with_values({name: entry.values[name] for name in entry.tuned})
        except ParameterError as error:
            raise StoreError(f'{method}, {drive}: {error}') from error

    def check(self, types: Mapping[str, type[Parameters]]) -> None:
        """Raise :class:`StoreError` unless every entry fits the table of its method."""
        for method, drive in self:
            if method not in types:
                raise StoreError(f'there is no method {method}{nearest_hint(method, types)}')
            self.parameters(method, drive, types[method])

    def check_equal(self) -> None:
        """Raise :class:`StoreError` unless all entries of a drive were given the same budget."""
        first: dict[str, tuple[str, str]] = {}
        for key in self:
            other = first.setdefault(key[1], key)
            ours, others = self._entries[key].budget, self._entries[other].budget
            if ours != others:
                raise StoreError(
                    f'{key[0]}, {key[1]} was tuned with {ours}; '
                    f'{other[0]}, {other[1]} with {others}'
                )

    def table(self) -> str:
        """Return the improvement by tuning as a Markdown table."""
        head = 'method', 'drive', 'objective at start (rad/s)', 'tuned', 'tuned parameters'
        rows = []
        for method, drive in self:
            entry = self._entries[method, drive]
            start = entry.start_objective
            first = 'none' if start is None else f'{start:.4f}'
            numbers = f'{entry.objective:.4f}', str(len(entry.tuned))
            rows.append((method, drive, first, *numbers, str(entry.budget.evaluations)))
        return Table('', (*head, 'evaluations'), rows).markdown()


def _entries(content: object) -> dict[tuple[str, str], TunedEntry]:
    top = _object(content, 'the file', {'format', 'methods'})
    if top['format'] != _FORMAT:
        raise StoreError(f'format must be {_FORMAT}: got {top["format"]!r}')
    return {
        (method, drive): _entry(entry, f'{method}, {drive}')
        for method, drives in _object(top['methods'], 'methods').items()
        for drive, entry in _object(drives, method).items()
    }


def _entry(content: object, where: str) -> TunedEntry:
    entry: TunedEntry = _decoded(TunedEntry, content, where)
    for name in entry.tuned:
        if name not in entry.values:
            raise StoreError(f'{where}: {name} was tuned, but has no value')
    if entry.budget.evaluations < 1:
        raise StoreError(f'{where}: budget: evaluations must be at least 1: got 0')
    return entry


def _decoded(kind: Any, content: Any, where: str) -> Any:
    """Return JSON content as an annotated type, or raise :class:`StoreError` with its place."""
    if kind in (TunedEntry, TuningBudget):
        hints = get_type_hints(kind)
        read = _object(content, where, set(hints))
        return kind(
            **{name: _decoded(hints[name], read[name], f'{where}: {name}') for name in hints}
        )
    arguments = get_args(kind)
    if NoneType in arguments:
        return None if content is None else _decoded(arguments[0], content, where)
    if get_origin(kind) is tuple:
        if not isinstance(content, list) or not content:
            raise StoreError(f'{where} must be a list that is not empty: got {content!r}')
        return tuple(_decoded(arguments[0], each, where) for each in content)
    if kind is str:
        if not isinstance(content, str) or not content:
            raise StoreError(f'{where} must be a text: got {content!r}')
        return content
    if kind in (int, float):
        what, allowed = ('a whole number', int) if kind is int else ('a number', int | float)
        if isinstance(content, bool) or not isinstance(content, allowed):
            raise StoreError(f'{where} must be {what}: got {content!r}')
        if not (math.isfinite(content) and content >= 0):
            raise StoreError(f'{where} must be at least 0 and finite: got {content}')
        return kind(content)
    # JSON has no tuples, and a parameter of many values is one.
    values = _object(content, where).items()
    return MappingProxyType(
        {name: tuple(value) if isinstance(value, list) else value for name, value in values}
    )


def _object(content: object, where: str, names: set[str] | None = None) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise StoreError(f'{where} must be an object: got {type(content).__name__}')
    if names is not None:
        for problem, found in (('lacks', names - set(content)), ('has', set(content) - names)):
            if found:
                raise StoreError(f'{where} {problem} {", ".join(sorted(found))}')
    return content


def _refuse_constant(text: str) -> float:
    raise StoreError(f'every number must be finite: got {text}')


def _refuse_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise StoreError(f'{name} is given twice')
        result[name] = value
    return result
