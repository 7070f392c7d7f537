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
"""Results as CSV, JSON and numbers in text; progress line, and sections of pages."""

from collections.abc import Mapping, Sequence
import csv
from importlib import import_module
from importlib.util import find_spec
import io
import json
import math
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean

if TYPE_CHECKING:
    from tqdm import tqdm
from t3mpc_ros.evaluation.report_table import EMPTY_CELL


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
