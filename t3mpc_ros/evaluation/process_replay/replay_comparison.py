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
"""Recorded and recomputed outputs, field by field, each with its tolerance; as text and figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
import math
from pathlib import Path
from typing import Any

from matplotlib.colors import ListedColormap
import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation import figure_style
from t3mpc_ros.evaluation.figure_style import COLOURS
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    FIELDS,
    ControllerInputs,
    ReplayError,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import ReplayResult
from t3mpc_ros.geometry.types import Array

Flags = NDArray[np.bool_]

ABSOLUTE, RELATIVE = 1e-9, 1e-9
"""Default tolerances, for the machine of the recording: there the replay is bit-equal."""
ELSEWHERE = 1e-6
"""Both tolerances for other processors, compilers and linear-algebra libraries, whose rounding
differs; adaptation accumulates the differences."""
BEFORE, AFTER = 0.5, 1.5
"""Half width of the figure's zoomed window, s."""
BINS = 200
"""Time bins of the figure's overview."""


@dataclass(frozen=True)
class Tolerances:
    """Allowed difference of two numbers: absolute + relative |recorded|, in SI units."""

    absolute: float = ABSOLUTE
    relative: float = RELATIVE
    fields: Mapping[str, float] = field(default_factory=dict)
    """Absolute tolerances by field name, ``*`` as a wildcard; the last match counts,
    and the relative tolerance is then zero."""

    def __post_init__(self) -> None:
        given = {'absolute': self.absolute, 'relative': self.relative, **self.fields}
        for name, value in given.items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f'the tolerance {name} must be from 0 to below inf: got {value}')
        for name in self.fields:
            if not any(fnmatchcase(each, name) for each in FIELDS):
                raise ValueError(f'{name} is none of the fields {", ".join(FIELDS)}')

    def of(self, name: str) -> tuple[float, float]:
        """Return the absolute and the relative tolerance of a field."""
        own = [value for pattern, value in self.fields.items() if fnmatchcase(name, pattern)]
        return (own[-1], 0.0) if own else (self.absolute, self.relative)


@dataclass(frozen=True)
class FieldComparison:
    """Comparison of one field."""

    field: str
    count: int
    """Number of compared values."""
    absolute: float
    """Largest difference; infinite where one value is NaN."""
    relative: float
    """Largest difference over |recorded|, over non-zero recorded values."""
    differing: int
    """Number of values beyond the tolerance."""
    first: float
    """Time of the first of them, s since the start of the bag; NaN without one."""
    first_step: int
    """Its row in the journal; -1 without one."""


@dataclass(frozen=True)
class Comparison:
    """Comparison of a whole run."""

    rows: tuple[FieldComparison, ...]
    """Fields of the recording, in the order of :data:`FIELDS`."""
    tolerances: Tolerances
    time: Array
    recorded: Mapping[str, Array]
    computed: Mapping[str, Array]
    compared: Flags
    """Mask of the compared journal rows, shape (n,)."""
    remarks: tuple[str, ...]
    parameters: tuple[str, ...]
    """Parameters that differ from the recorded ones, with both values."""

    @property
    def same(self) -> bool:
        """Whether every number is within its tolerance."""
        return not any(row.differing for row in self.rows)

    @property
    def first(self) -> FieldComparison | None:
        """Field that diverges first; of several at once the first one in the table."""
        differing = [row for row in self.rows if row.differing]
        return min(differing, key=lambda row: row.first_step, default=None)

    def beyond(self, name: str) -> Flags:
        """Return the mask of rows at which a field is beyond its tolerance, shape (n,)."""
        return self.compared & _beyond(
            self.recorded[name], self.computed[name], *self.tolerances.of(name)
        )

    def to_dict(self) -> dict[str, object]:
        """Return the comparison of each field as plain data."""
        fields = {row.field: {**vars(row)} for row in self.rows}
        return {'same': self.same, 'remarks': list(self.remarks), 'fields': fields}

    def table(self) -> str:
        """Return the comparison as text, remarks first."""
        lines = [f'note: {remark}' for remark in self.remarks]
        lines += [f'setting: {text}' for text in self.parameters]
        count, total = int(np.count_nonzero(self.compared)), self.compared.size
        lines.append(f'{count} of {total} events compared')
        wide = max(len(row.field) for row in self.rows)
        lines.append(
            f'{"field":<{wide}}  {"n":>7}  {"max abs":>9}  {"max rel":>9}  {"differ":>7}  '
            f'{"first at":>10}'
        )
        for row in self.rows:
            when = f'{row.first:9.3f} s' if row.differing else '         -'
            lines.append(
                f'{row.field:<{wide}}  {row.count:7d}  {row.absolute:9.2e}  {row.relative:9.2e}  '
                f'{row.differing:7d}  {when}'
            )
        lines.append(self.verdict())
        return '\n'.join(lines)

    def verdict(self) -> str:
        """Return the verdict in one sentence."""
        first = self.first
        if first is None:
            absolute, relative = self.tolerances.absolute, self.tolerances.relative
            return f'same: all within {absolute:g} + {relative:g} |recorded|' + (
                ' or their own tolerance' if self.tolerances.fields else ''
            )
        others = [row.field for row in self.rows if row.differing and row is not first]
        return (
            f'differs: {first.field} first, at {first.first:.3f} s (event {first.first_step})'
            + (f'; then {", ".join(others)}' if others else '')
        )


def compare(
    inputs: ControllerInputs, again: ReplayResult, tolerances: Tolerances | None = None
) -> Comparison:
    """Return the comparison of a replay with the recorded run.

    Only events with complete inputs count. Without any, all are compared, and a remark states it.
    """
    remarks = list(inputs.notes)
    compared = inputs.exact
    if not compared.any():
        compared = np.ones_like(compared)
        remarks.append(
            'approximate: the state of the controller is not known at any step, so small '
            'differences say nothing'
        )
    elif not compared.all():
        first = inputs.time[np.flatnonzero(~compared)[0]]
        remarks.append(
            f'{np.count_nonzero(~compared)} events, the first at {first:.3f} s, are left out: '
            'the inputs of the controller are not all in the bag'
        )
    values, now = _recorded_values(inputs), again.parameters.to_dict()
    differing = [
        f'{name} is {value}, recorded {_format_values(values[name])}'
        for name, value in again.changed.items()
        if set(values[name]) != {_plain(now[name])}
    ]
    return compare_columns(
        inputs.time, inputs.recorded, again.fields, compared, tolerances, remarks, differing
    )


def compare_bags(
    one: ControllerInputs, other: ControllerInputs, tolerances: Tolerances | None = None
) -> Comparison:
    """Return the comparison of two bags of one run, such as a bag and its replay.

    Events are matched by their number in the journal.
    """
    keys = [
        [(k, n) for k, each in enumerate(inputs.sessions) for n in each.rows[:, 0].tolist()]
        for inputs in (one, other)
    ]
    places = {key: row for row, key in enumerate(keys[1])}
    rows = np.array([places.get(key, -1) for key in keys[0]], dtype=np.int64)
    there = rows >= 0
    if not there.any():
        raise ReplayError(f'{one.bag} and {other.bag} have no step of the controller in common')
    computed = {}
    for name in FIELDS:
        computed[name] = np.full(rows.size, np.nan)
        computed[name][there] = other.recorded[name][rows[there]]
    # A topic that only one bag holds cannot be compared.
    recorded = {
        name: np.where(np.isnan(computed[name]), np.nan, one.recorded[name]) for name in FIELDS
    }
    remarks = [f'{each.bag}: {note}' for each in (one, other) for note in each.notes]
    if missing := int(np.count_nonzero(~there)):
        remarks.append(f'{missing} of {rows.size} events of {one.bag} are not in {other.bag}')
    mine, its = _recorded_values(one), _recorded_values(other)
    differing = [
        f'{name} is {_format_values(its[name])} in {other.bag}, '
        f'{_format_values(values)} in {one.bag}'
        for name, values in mine.items()
        if values != its[name]
    ]
    return compare_columns(one.time, recorded, computed, there, tolerances, remarks, differing)


def compare_columns(
    time: Array,
    recorded: Mapping[str, Array],
    computed: Mapping[str, Array],
    compared: Flags,
    tolerances: Tolerances | None = None,
    remarks: Sequence[str] = (),
    parameters: Sequence[str] = (),
) -> Comparison:
    """Return the comparison of columns where they were recorded; arrays have shape (n,)."""
    tolerances = tolerances or Tolerances()
    rows = []
    for name in FIELDS:
        chosen = compared & ~np.isnan(recorded[name])
        if not chosen.any():
            continue
        was, now = recorded[name], computed[name]
        with np.errstate(invalid='ignore'):
            far = np.abs(now - was)[chosen]
        far[np.isnan(far)] = math.inf
        share = far[was[chosen] != 0.0] / np.abs(was[chosen][was[chosen] != 0.0])
        beyond = np.flatnonzero(chosen & _beyond(was, now, *tolerances.of(name)))
        rows.append(
            FieldComparison(
                name,
                int(np.count_nonzero(chosen)),
                float(far.max()),
                float(share.max()) if share.size else 0.0,
                int(beyond.size),
                float(time[beyond[0]]) if beyond.size else math.nan,
                int(beyond[0]) if beyond.size else -1,
            )
        )
    if not rows:
        raise ReplayError('nothing was recorded that could be compared')
    return Comparison(
        tuple(rows),
        tolerances,
        time,
        recorded,
        computed,
        compared,
        tuple(remarks),
        tuple(parameters),
    )


def _beyond(was: Array, now: Array, absolute: float, relative: float) -> Flags:
    """Return the mask of differences beyond the tolerance; a missing number always differs."""
    with np.errstate(invalid='ignore'):
        near = np.abs(now - was) <= absolute + relative * np.abs(was)
    return np.asarray(~near & ~np.isnan(was))


def _recorded_values(inputs: ControllerInputs) -> dict[str, list[object]]:
    """Return the values of each parameter over the run, in order."""
    tables = [
        each.to_dict() for session in inputs.sessions for each in session.parameters.values()
    ]
    return {
        name: list(dict.fromkeys(_plain(table[name]) for table in tables)) for name in tables[0]
    }


def _plain(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _format_values(values: Sequence[object]) -> str:
    return ', then '.join(map(str, values))


def write_divergence_figure(outcome: Comparison, path: Path) -> None:
    """Write a PNG of the first divergence of the replay from the recording."""
    figure = figure_style.drawing(_draw, outcome)
    if figure is not None:
        write_atomically(path, figure_style.file_of(figure, 'png'))


def _draw(outcome: Comparison) -> Any:
    first = outcome.first
    fields = [row.field for row in outcome.rows]
    height = 2.0 + 0.16 * len(fields)
    if first is None:
        figure, axis = figure_style.new_figure(height)
        _overview(axis, outcome, fields)
        figure.suptitle(outcome.verdict(), fontsize=9)
        return figure
    ratios = [1.8, 1.4, 0.6 + 0.16 * len(fields)]
    figure, axes = figure_style.new_figure(height + 3.6, (3, 1), height_ratios=ratios)
    close, apart, all_of_it = axes[:, 0]
    close.sharex(apart)
    _close_up(close, apart, outcome, first.field, first.first)
    _overview(all_of_it, outcome, fields)
    return figure


def _close_up(close: Any, apart: Any, outcome: Comparison, name: str, when: float) -> None:
    """Draw both runs around the first divergence, and their difference on a logarithmic scale."""
    time = outcome.time
    shown = (time >= when - BEFORE) & (time <= when + AFTER) & ~np.isnan(outcome.recorded[name])
    was, now = outcome.recorded[name][shown], outcome.computed[name][shown]
    # The recorded line is wide, so that it stays visible below the other.
    close.plot(time[shown], was, color=COLOURS['odom'], label='recorded', linewidth=4.0)
    close.plot(time[shown], now, color=COLOURS['error'], label='recomputed', linewidth=1.0)
    close.set_title(name)
    absolute, relative = outcome.tolerances.of(name)
    with np.errstate(invalid='ignore'):
        far = np.abs(now - was)
    allowed = np.maximum(absolute + relative * np.abs(was), 1e-18)
    # Bit-equal values have no logarithm.
    floor = 0.1 * float(allowed.min())
    apart.plot(time[shown], np.maximum(far, floor), color=COLOURS['error'], label='difference')
    apart.plot(time[shown], allowed, color=COLOURS['target'], label='tolerance')
    apart.set_yscale('log')
    apart.set_title(f'difference of {name}')
    for axis in (close, apart):
        axis.axvline(when, color=COLOURS['switch'], linewidth=0.8, linestyle=(0, (4, 3)))
        figure_style.add_legend(axis)
    figure_style.name_time([close, apart])
    apart.set_xlim(max(when - BEFORE, time[0]), min(when + AFTER, time[-1]))
    close.tick_params(labelbottom=False)


def _overview(axis: Any, outcome: Comparison, fields: list[str]) -> None:
    """Draw for each field where it is compared (pale) and where it exceeds its tolerance."""
    span = float(outcome.time[0]), max(float(outcome.time[-1]), float(outcome.time[0]) + 1e-3)
    level = np.full((len(fields), BINS), math.nan)
    for row, name in zip(level, fields, strict=True):
        compared = outcome.compared & ~np.isnan(outcome.recorded[name])
        for value, mask in ((0.0, compared), (1.0, outcome.beyond(name))):
            row[np.histogram(outcome.time[mask], BINS, span)[0] > 0] = value
    colours = ListedColormap(['#d1fae5', COLOURS['error']])
    extent = (*span, len(fields) - 0.5, -0.5)
    axis.imshow(level, colours, aspect='auto', interpolation='none', extent=extent, vmin=0, vmax=1)
    axis.set_yticks(range(len(fields)), fields, fontsize=6)
    axis.set_title('compared (pale), beyond the tolerance (dark)')
    axis.grid(visible=False)
    figure_style.name_time([axis])
