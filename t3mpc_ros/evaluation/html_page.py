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
"""HTML page of a report, from blocks: headings, text, tables, figures and charts."""

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
import json
from pathlib import Path
import re
from typing import Any

from t3mpc_ros.evaluation.charts import Chart, PageData, Plane, Timeline
from t3mpc_ros.evaluation.report_table import Mark, Table
from t3mpc_ros.evaluation.result_output import finite
from t3mpc_ros.page.assets import page_file


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
