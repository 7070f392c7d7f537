# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Tunable methods: their initial parameters and the search ranges as a unit cube.

A search works in the unit cube. A parameter x in [a, b] and its coordinate p in [0, 1] are

.. math:: x = a\,(b/a)^p \quad\text{(logarithmic)}, \qquad x = a + p\,(b - a) \quad\text{(linear)}

so that equal steps are equal factors for gains and weights, whose order of magnitude is unknown.
An integer has an interval of equal length around each value: a and b are extended by one half.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
import math
import re

import numpy as np
from numpy.typing import ArrayLike, NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.parameters.table import ParameterError, Parameters, ParameterSpec, nearest_hint

Array = NDArray[np.float64]
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

    def __post_init__(self) -> None:
        for bound in (self.low, self.high):
            if not math.isfinite(bound):
                raise ParameterError(f'{self.name}: bounds of a range must be finite: got {bound}')
        if not self.low < self.high:
            raise ParameterError(
                f'{self.name}: a range must end above its begin: got {self.low:g} to {self.high:g}'
            )
        if self.log and not self.low > 0.0:
            raise ParameterError(
                f'{self.name}: a logarithmic range must begin above 0: got {self.low:g}'
            )


class SearchSpace:
    """The tuned parameters of one table, as the unit cube; coordinates are in order of ``ranges``.

    Raises
    ------
    ParameterError
        No range at all, a name twice, a name that the table does not have, a parameter that is
        not a number, or a range that goes beyond the parameter's own bounds.
    """

    def __init__(self, table: type[Parameters], ranges: Sequence[SearchRange]) -> None:
        if not ranges:
            raise ParameterError(f'{table.__name__}: at least one setting must be tuned')
        known = {row.name: row for row in table.specs()}
        self.table = table
        self.ranges = tuple(ranges)
        self._whole: list[bool] = []
        seen: set[str] = set()
        for each in self.ranges:
            if each.name in seen:
                raise ParameterError(f'{each.name} must be tuned once: it has two ranges')
            seen.add(each.name)
            self._whole.append(_check(each, _row(each.name, known, table)))
        self._ends = [_ends(*pair) for pair in zip(self.ranges, self._whole, strict=True)]

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tuned parameters, in the order of the coordinates."""
        return tuple(each.name for each in self.ranges)

    def values(self, point: ArrayLike) -> Values:
        """Return the parameters at a point of the unit cube, exactly within their ranges."""
        where = np.asarray(point, dtype=np.float64)
        if where.shape != (len(self),):
            raise ValueError(f'point must have shape ({len(self)},): got {where.shape}')
        if not ((where >= 0.0) & (where <= 1.0)).all():
            raise ValueError(f'point must lie in the unit cube: got {where}')
        result: Values = {}
        for each, whole, (low, high), p in zip(
            self.ranges, self._whole, self._ends, where.tolist(), strict=True
        ):
            x = low + p * (high - low)
            if each.log:
                x = math.exp(x)
            # Rounding may leave the last digit of an end outside.
            x = min(max(x, each.low), each.high)
            result[each.name] = round(x) if whole else x
        return result

    def point(self, values: Mapping[str, object]) -> Array:
        """Return the point of the unit cube that stands for ``values``, shape (n,).

        Names that are not tuned are passed over, so a whole flat table may be given.
        """
        result = np.empty(len(self))
        for i, (each, (low, high)) in enumerate(zip(self.ranges, self._ends, strict=True)):
            if each.name not in values:
                raise ParameterError(f'{each.name} is tuned, but has no value')
            x = values[each.name]
            if isinstance(x, bool) or not isinstance(x, int | float):
                raise ParameterError(f'{each.name} must be a number: got {x!r}')
            if not each.low <= x <= each.high:
                raise ParameterError(
                    f'{each.name} must be in its range from {each.low:g} to {each.high:g}: '
                    f'got {x:g}'
                )
            p = ((math.log(x) if each.log else x) - low) / (high - low)
            result[i] = min(max(p, 0.0), 1.0)
        return result

    def of(self, parameters: Parameters) -> Values:
        """Return the tuned parameters of a table as they are, checked to be in their ranges."""
        if not isinstance(parameters, self.table):
            raise ParameterError(
                f'parameters must be {self.table.__name__}: got {type(parameters).__name__}'
            )
        to_dict = parameters.to_dict()
        self.point(to_dict)
        return {name: to_dict[name] for name in self.names}  # type: ignore[misc]

    def describe(self) -> list[dict[str, object]]:
        """Return the ranges as plain data: two searches are of one space when it is equal."""
        return [
            {'name': each.name, 'low': float(each.low), 'high': float(each.high), 'log': each.log}
            for each in self.ranges
        ]


def _row(name: str, known: Mapping[str, ParameterSpec], table: type[Parameters]) -> ParameterSpec:
    if name not in known:
        hint = nearest_hint(name, known)
        raise ParameterError(f'{table.__name__} has no setting {name}{hint}')
    return known[name]


def _check(each: SearchRange, row: ParameterSpec) -> bool:
    """Return whether the parameter is a whole number, or raise why it cannot be tuned so."""
    if row.many or row.kind not in (int, float) or row.choices:
        kind = f'a list of {row.kind.__name__}' if row.many else row.kind.__name__
        raise ParameterError(f'{each.name} cannot be tuned: it must be one number, and is {kind}')
    for bound in (each.low, each.high):
        if row.kind is int and bound == int(bound):
            bound = int(bound)
        row.check(bound)
    return row.kind is int


def _ends(each: SearchRange, whole: bool) -> tuple[float, float]:
    """Return what p = 0 and p = 1 stand for, before exp where the range is logarithmic."""
    low, high = (each.low - 0.5, each.high + 0.5) if whole else (each.low, each.high)
    return (math.log(low), math.log(high)) if each.log else (float(low), float(high))


@dataclass(frozen=True)
class MethodDefinition:
    """One line of the table of methods.

    Parameters
    ----------
    name
        As it stands in tables and figures, for example ``'linear MPC'``.
    start
        For each drive, or the twin, the method is meant for, the parameters its maker would
        choose: tuning begins there, and never ends worse.
    ranges
        What is tuned, in either drive. All else stays as in ``start``.
    table
        The table of the parameters; by default that of the controller.
    """

    name: str
    controller_type: type[BaselineController]
    start: Mapping[str, Parameters]
    ranges: tuple[SearchRange, ...]
    table: type[Parameters] | None = None

    def __post_init__(self) -> None:
        if not short_name(self.name):
            raise ParameterError(f'a method must have a name: got {self.name!r}')
        if not self.start:
            raise ParameterError(
                f'{self.name}: there must be start settings for one drive at least'
            )
        try:
            space = self.space
        except ParameterError as error:
            raise ParameterError(f'{self.name}: {error}') from error
        for drive, parameters in self.start.items():
            try:
                space.of(parameters)
            except ParameterError as error:
                raise ParameterError(f'{self.name}, {drive}: {error}') from error

    @property
    def space(self) -> SearchSpace:
        """What is searched."""
        return SearchSpace(self.table or self.controller_type.parameters_type, self.ranges)

    @property
    def short(self) -> str:
        """The name for command lines and files."""
        return short_name(self.name)


def short_name(name: str) -> str:
    """Return ``name`` in lower case with one hyphen for whatever is no letter or digit."""
    return re.sub(r'[^a-z0-9]+', '-', name.lower()).strip('-')


def find_names(kind: str, names: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """Return the named entries of ``known`` in its order; case and punctuation are ignored."""
    by_short_name = {short_name(name): name for name in known}
    for name in names:
        if short_name(name) not in by_short_name:
            near = get_close_matches(short_name(name), by_short_name, n=1)
            hint = f'; did you mean {by_short_name[near[0]]}?' if near else ''
            all_names = ', '.join(by_short_name.values())
            raise ValueError(f'{kind} must be one of {all_names}: got {name}{hint}')
    wanted = {short_name(name) for name in names}
    return tuple(name for short, name in by_short_name.items() if short in wanted)


def check_names(methods: Sequence[MethodDefinition]) -> None:
    """Raise :class:`ValueError` when two methods could be taken for each other."""
    seen: dict[str, str] = {}
    for method in methods:
        if method.short in seen:
            raise ValueError(
                f'methods must have different names: got {seen[method.short]!r} '
                f'and {method.name!r}'
            )
        seen[method.short] = method.name
