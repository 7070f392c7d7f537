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
"""Results as tables (text, Markdown, HTML, LaTeX), CSV and JSON; numbers in text; progress."""

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass, replace
import html
from importlib import import_module
from importlib.util import find_spec
import io
import json
import math
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean
from t3mpc_ros.parameters.table import find_names

if TYPE_CHECKING:
    from tqdm import tqdm

EMPTY_CELL = '–'


class Mark(NamedTuple):
    """A coloured word; its kind is ``yes``, ``no``, ``open`` or ``apart``."""

    text: str
    kind: str


def verdict_mark(verdict: str) -> Mark:
    """Return a verdict of any page in its colour: ``apart`` where it is left open."""
    kinds = {'not measured': 'open', 'inconclusive': 'apart', 'not comparable': 'apart'}
    kinds |= dict.fromkeys(('held', 'holds', 'ours is better'), 'yes')
    return Mark(verdict, kinds.get(verdict, 'no'))


@dataclass(frozen=True, slots=True)
class Table:
    """A table of words; its first column names the rows."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str | Mark]]
    bold: tuple[str, ...] = ()
    """Names of highlighted rows."""
    text: int = 1
    """How many of the first columns are text; the others are numbers."""
    wrap: bool = False
    """Whether long cells of a page have several lines."""
    notes: Sequence[str] = ()
    """Paragraphs below the table: why a cell has no number, how a verdict is made."""

    def with_columns(self, names: Sequence[str]) -> 'Table':
        """Return the table with its first column and some others, by their headings.

        A heading may lack its unit; one that is named twice takes the next column of this heading.
        """
        short = [head.partition(',')[0] for head in self.head]
        chosen = [0]
        for name in names:
            full = name if name in self.head else find_names('column', [name], short)[0]
            known = self.head if full in self.head else short
            chosen += [k for k, head in enumerate(known) if head == full and k not in chosen][:1]
        rows = [[row[k] for k in chosen] for row in self.rows]
        text = sum(k < self.text for k in chosen)
        return replace(self, head=[self.head[k] for k in chosen], rows=rows, text=text)

    def markdown(self) -> str:
        """Return the table with its title in Markdown."""
        lines = [f'**{self.title}**', ''] if self.title else []
        lines += [_line(self.head), '|---' * len(self.head) + '|']
        for row in self.rows:
            name, *cells = _words(row)
            lines.append(_line([f'**{name}**' if name in self.bold else name, *cells]))
        for note in self.notes:
            lines += ['', note]
        return '\n'.join(lines)

    def html(self) -> str:
        """Return the table as HTML without a style of its own, as for a cell of a notebook."""
        title = f'<caption>{html.escape(self.title)}</caption>' if self.title else ''
        lines = [_html_row('th', self.head, self.text)]
        for row in self.rows:
            lines.append(_html_row('td', _words(row), self.text, row[0] in self.bold))
        notes = ''.join(f'<p><small>{html.escape(note)}</small></p>' for note in self.notes)
        return f'<table>{title}' + ''.join(lines) + f'</table>{notes}'

    def latex(self, label: str = '') -> str:
        """Return the table as a LaTeX float with the rules of the package ``booktabs``."""
        places = 'l' * self.text + 'r' * (len(self.head) - self.text)
        lines = [r'\begin{table}', r'  \centering']
        if self.title:
            lines.append(rf'  \caption{{{_latex(self.title)}}}')
        if label:
            lines.append(rf'  \label{{{label}}}')
        lines += [rf'  \begin{{tabular}}{{{places}}}', r'    \toprule', _latex_row(self.head)]
        lines.append(r'    \midrule')
        lines += [_latex_row(_words(row), row[0] in self.bold) for row in self.rows]
        lines += [r'    \bottomrule', r'  \end{tabular}']
        lines += [rf'  \par\smallskip{{\footnotesize {_latex(note)}\par}}' for note in self.notes]
        lines.append(r'\end{table}')
        return '\n'.join(lines) + '\n'


def _words(row: Sequence[str | Mark]) -> list[str]:
    return [each if isinstance(each, str) else each.text for each in row]


def _html_row(kind: str, cells: Sequence[str], text: int, bold: bool = False) -> str:
    shown = [html.escape(cell) for cell in cells]
    if bold:
        shown[0] = f'<b>{shown[0]}</b>'
    ways = ['left' if i < text else 'right' for i in range(len(shown))]
    pairs = zip(ways, shown, strict=True)
    return (
        f'<tr>{"".join(f"<{kind} style=text-align:{way}>{x}</{kind}>" for way, x in pairs)}</tr>'
    )


LATEX = {
    '\\': r'\textbackslash{}',
    **{sign: f'\\{sign}' for sign in '&%$#_{}'},
    '~': r'\textasciitilde{}',
    '^': r'\textasciicircum{}',
    '±': r'$\pm$',
    '−': '$-$',
    '×': r'$\times$',
    '·': r'$\cdot$',
    '≤': r'$\le$',
    '≥': r'$\ge$',
    '∞': r'$\infty$',
    'ω': r'$\omega$',
    '°': r'\textdegree{}',
    '²': '$^2$',
    '³': '$^3$',
    '→': r'$\to$',
}
"""How LaTeX writes what it reads otherwise, or does not have in every font."""


def _latex(text: str) -> str:
    return ''.join(LATEX.get(sign, sign) for sign in text)


def _latex_row(cells: Sequence[str], bold: bool = False) -> str:
    written = [_latex(cell) for cell in cells]
    if bold:
        written[0] = rf'\textbf{{{written[0]}}}'
    return f'    {" & ".join(written)} ' + r'\\'


def _line(cells: Sequence[str]) -> str:
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


# -- files, numbers and progress ------------------------------------------------------------------


def progress_bar(
    total: int, unit: str = 'runs', *, show: bool = True, title: str = '', delay: float = 0.0
) -> 'tqdm[int]':
    """Return a line on standard error with pace and time left; ``update()`` counts.

    A terminal or a notebook gets one line that is rewritten, or the widget of a notebook that has
    ipywidgets; anything else a line at intervals. Nothing is shown before ``delay``, s.
    """
    notebook = type(sys.stderr).__module__.startswith('ipykernel')
    widget = notebook and find_spec('ipywidgets') is not None
    kind = import_module('tqdm.notebook' if widget else 'tqdm').tqdm
    bar: tqdm[int] = kind(
        total=total,
        unit=f' {unit}',
        unit_scale=unit == 'B',
        desc=title or None,
        delay=delay,
        disable=not show,
        dynamic_ncols=True,
        mininterval=0.5 if notebook or sys.stderr.isatty() else 15.0,
    )
    return bar


def replace_section(page: Path, begin: str, end: str, section: str) -> None:
    """Replace the text between two marks of a page, which has both once and in this order."""
    head, begun, rest = page.read_text(encoding='utf-8').partition(begin)
    _, ended, tail = rest.partition(end)
    if not begun or not ended or begin in rest or end in tail:
        raise ValueError(f'{page} must hold the lines {begin} and {end} once, in this order')
    write_atomically(page, head + begin + section + end + tail)


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return rows as columns; None where a row does not have a column of another one."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def write_columns(
    path: Path, columns: Mapping[str, Sequence[object] | NDArray[np.generic]]
) -> None:
    """Write columns as CSV with one line of names, numbers with all their digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(columns)
    values = [each.tolist() if isinstance(each, np.ndarray) else each for each in columns.values()]
    writer.writerows(zip(*values, strict=True))
    write_atomically(path, stream.getvalue())


def strict_json(content: object) -> str:
    """Return JSON that every reader accepts: null for numbers that are not finite."""
    return json.dumps(finite(content), indent=1, ensure_ascii=False, allow_nan=False) + '\n'


def finite(value: object) -> object:
    """Return plain data with None in place of numbers that are not finite.

    A tuple with names becomes a mapping, bytes become hexadecimal digits.
    """
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, tuple) and hasattr(value, '_asdict'):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def format_number(value: float) -> str:
    """Return three significant digits, a count in full, or a dash for an unknown value."""
    if isinstance(value, int):
        return str(value)
    if not math.isfinite(value):
        return '–'
    return f'{value:.0f}' if abs(value) >= 99.95 else f'{value:#.3g}'


def format_mean(values: Sequence[float], digits: int = 3) -> str:
    """Return the mean of the finite values ± half its interval; an empty cell if there is none."""
    known = [value for value in values if math.isfinite(value)]
    return format_interval(mean(known), interval(known), digits=digits) if known else EMPTY_CELL
