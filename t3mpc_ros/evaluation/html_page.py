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
"""HTML page of a report, from blocks: headings, text, tables, figures, charts and their data."""

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
import json
from pathlib import Path
import re
from typing import Any, Generic, Literal, NamedTuple, TypeVar
import zlib

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.result_output import Mark, Table, finite
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.page.assets import page_file

Subject = TypeVar('Subject')

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


@dataclass(frozen=True, slots=True)
class Heading:
    """Title of what follows."""

    text: str
    mark: Mark | None = None


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A paragraph; its kind is '' or ``quiet``."""

    text: str
    kind: str = ''


@dataclass(frozen=True, slots=True)
class VerdictBox:
    """What a page says first; its kind is ``good``, ``open``, ``bad`` or ``apart``."""

    headline: str
    reasons: Sequence[str]
    kind: str
    subject: str = ''
    """What it is about, where a page has several verdicts."""


@dataclass(frozen=True, slots=True)
class Contents:
    """Links to the headings of the page, then what the cursor of its charts shows."""


@dataclass(frozen=True, slots=True)
class Tiles:
    """Main figures, each with what it is."""

    items: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Items:
    """A list of the kind ``notes``, or ``side`` for one of two columns."""

    items: Sequence[Sequence[str | Mark]]
    kind: str = 'notes'
    title: str = ''


@dataclass(frozen=True, slots=True)
class Picture:
    """An SVG file, contained in the page: sharp at every size, and on paper."""

    title: str
    svg: bytes
    caption: str = ''

    @property
    def base64(self) -> str:
        """The file in the alphabet of a data URL."""
        return base64.b64encode(self.svg).decode()


class TitledDrawing(NamedTuple, Generic[Subject]):
    """What draws a picture of a subject, with its title."""

    stem: str
    title: str
    draw: Callable[[Subject], Any]


@dataclass(frozen=True, slots=True)
class Details:
    """Blocks below a line of summary, which opens and closes them."""

    summary: str
    blocks: 'Sequence[Block]'
    opened: bool = False


@dataclass(frozen=True, slots=True)
class Group:
    """Blocks in one element."""

    blocks: 'Sequence[Block]'
    tag: str = 'section'
    kind: str = ''


Block = (
    Table
    | Heading
    | Paragraph
    | VerdictBox
    | Contents
    | Tiles
    | Items
    | Picture
    | Details
    | Group
    | Chart
    | Plane
    | Timeline
)


def html_page(title: str, blocks: Sequence[Block]) -> str:
    """Return a page that loads nothing from anywhere."""
    every = list(_all_blocks(blocks))
    headings = [each for each in every if isinstance(each, Heading)]
    slugs = [re.sub(r'[^a-z0-9]+', '-', each.text.lower()).strip('-') for each in headings]
    anchors = {id(each): f'{slugs[i]}-{i + 1}' for i, each in enumerate(headings)}
    found = PageData()
    content: dict[str, dict[str, object]] = {'charts': {}, 'planes': {}}
    for i, each in enumerate(every, 1):
        if isinstance(each, Chart):
            anchors[id(each)] = f'chart-{i}'
            content['charts'][f'chart-{i}'] = found.chart(each)
        elif isinstance(each, Plane):
            anchors[id(each)] = f'plane-{i}'
            content['planes'][f'plane-{i}'] = found.plane(each)
    events = [event for each in every if isinstance(each, Timeline) for event in each.events]
    data = {**content, 'columns': found.columns, 'events': events, 'packed': found.packed()}
    drawn = any(content.values())
    written: str = _template().render(
        title=title,
        blocks=blocks,
        headings=headings,
        anchor=lambda block: anchors[id(block)],
        files=page_file,
        # A closing tag in a string would end the script.
        data=json.dumps(finite(data), separators=(',', ':')).replace('<', '\\u003c')
        if drawn
        else '',
    )
    return written


def _all_blocks(blocks: Sequence[Block]) -> Iterator[Block]:
    for block in blocks:
        yield block
        if isinstance(block, Details | Group):
            yield from _all_blocks(block.blocks)


@cache
def _template() -> Any:
    import jinja2  # a simulation does without pages

    folder = Path(__file__).parent
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(folder), autoescape=True)
    environment.globals['own'] = lambda name: (folder / name).read_text(encoding='utf-8')
    return environment.get_template('report_page.html')
