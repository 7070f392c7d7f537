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
"""Charts of the reports, and their data as a page contains it."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal
import zlib

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array

MAX_POINTS = 8000
"""Points of a line: a minute at 100 Hz is contained whole, of more the extremes."""
TICK = 1e-5
"""Resolution of the times in a page, s."""
PRECISION = 14
"""Bits of the mantissa that are kept, a relative error of 3e-5: the others do not compress."""

LineStyle = Literal['line', 'steps', 'points']


@dataclass(frozen=True, slots=True)
class Line:
    """One quantity over time; NaN interrupts it."""

    label: str
    colour: str
    """Variable of the style sheet."""
    time: Array
    """s, ascending"""
    value: Array
    dash: tuple[int, ...] = ()
    style: LineStyle = 'line'


@dataclass(frozen=True, slots=True)
class Chart:
    """Quantities of one unit over time."""

    title: str
    unit: str
    lines: Sequence[Line]
    summary: str
    """What is seen in it."""
    extent: tuple[float, float] | None = None
    """Values that are shown; None: those of the lines."""


@dataclass(frozen=True, slots=True)
class Curve:
    """A curve in a plane; NaN interrupts it."""

    label: str
    colour: str
    time: Array
    """s, ascending: the cursor of the charts moves a point on the curve"""
    x: Array
    y: Array
    dash: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Plane:
    """Curves in a plane with one unit, such as paths on the floor."""

    title: str
    unit: str
    curves: Sequence[Curve]
    summary: str
    """What is seen in it."""
    world: Mapping[str, Any] | None = None
    """Walls, as of :func:`.world_outline`."""
    marks: Sequence[tuple[float, float, float, str]] = ()
    """Points, each with its time (s), place and colour."""


@dataclass(frozen=True, slots=True)
class Timeline:
    """Events in order: time (s), kind, text.

    The kinds ``switch``, ``stop``, ``stall``, ``gap``, ``jump`` and ``slip`` are marked in the
    charts of the page; ``note`` is not.
    """

    events: Sequence[tuple[float, str, str]]


@dataclass
class PageData:
    """Collects the data of all charts of a page; equal columns are contained once."""

    columns: list[tuple[str, int]] = field(default_factory=list)
    """Kind, ``t`` for times and ``f`` for values, and number of rows."""
    content: list[bytes] = field(default_factory=list)
    known: dict[tuple[str, bytes], int] = field(default_factory=dict)

    def add(self, kind: str, values: Array) -> int:
        """Return the number of a column with these values."""
        packed = _pack_times(values) if kind == 't' else _pack_values(values)
        key = kind, packed
        if key not in self.known:
            self.known[key] = len(self.columns)
            self.columns.append((kind, values.size))
            self.content.append(packed)
        return self.known[key]

    def chart(self, shown: Chart) -> dict[str, Any]:
        """Return the description of a chart for its script."""
        lines = []
        for line in shown.lines:
            time, value = thinned(line.time, line.value)
            rows = {'time': self.add('t', time), 'value': self.add('f', value)}
            look = {'label': line.label, 'colour': line.colour, 'dash': list(line.dash)}
            lines.append({**look, 'style': line.style, **rows})
        named = {'title': shown.title, 'unit': shown.unit, 'summary': shown.summary}
        extent = None if shown.extent is None else [float(f'{v:.4g}') for v in shown.extent]
        return {**named, 'lines': lines, 'extent': extent}

    def plane(self, shown: Plane) -> dict[str, Any]:
        """Return the description of a plane for its script."""
        curves = []
        for curve in shown.curves:
            few = slice(None, None, max(1, -(-curve.time.size // (MAX_POINTS // 4))))
            rows = {'x': self.add('f', curve.x[few]), 'y': self.add('f', curve.y[few])}
            look = {'label': curve.label, 'colour': curve.colour, 'dash': list(curve.dash)}
            curves.append({**look, 'time': self.add('t', curve.time[few]), **rows})
        marks = [[*(round(each, 4) for each in at), colour] for *at, colour in shown.marks]
        named = {'title': shown.title, 'unit': shown.unit, 'summary': shown.summary}
        return {**named, 'curves': curves, 'world': shown.world, 'marks': marks}

    def packed(self) -> str:
        """Return all columns: one after the other, compressed, in base64."""
        return base64.b64encode(zlib.compress(b''.join(self.content), 6)).decode()


def thinned(time: Array, value: Array) -> tuple[Array, Array]:
    """Return the extremes of segments of a long line: the same picture from fewer points.

    A gap between two segments stays one.
    """
    if time.size <= MAX_POINTS:
        return time, value
    stretch = -(-time.size // (MAX_POINTS // 2))
    starts = np.arange(0, time.size, stretch)
    low, high = np.fmin.reduceat(value, starts), np.fmax.reduceat(value, starts)
    return np.repeat(time[starts], 2), np.column_stack([low, high]).ravel()


def _pack_times(times: Array) -> bytes:
    """Return the steps of the times, which are small whole numbers and so compress well."""
    ticks = np.round(times / TICK)
    return _shuffled(np.diff(ticks, prepend=0.0).astype('<f8'))


def _pack_values(values: Array) -> bytes:
    with np.errstate(over='ignore'):
        few = values.astype('<f4')
    bits, drop = few.view('<u4').copy(), 23 - PRECISION
    finite = np.isfinite(few)
    bits[finite] += np.uint32(1 << (drop - 1))
    bits[finite] &= np.uint32((0xFFFFFFFF << drop) & 0xFFFFFFFF)
    return _shuffled(bits)


def _shuffled(values: NDArray[Any]) -> bytes:
    """Return all first bytes, then all second ones and so on: equal bytes stand together."""
    return values.view(np.uint8).reshape(values.size, -1).T.tobytes()
