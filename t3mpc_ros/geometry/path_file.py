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
"""Paths from files: CSV with x, y per line, or YAML with a list of points."""

import csv
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.geometry.polyline import MAX_COORDINATE, PathError
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters import yaml_loader

MAX_FILE_SIZE = 20_000_000
"""Bytes."""


def load_path(file: str | Path) -> Array:
    """Return the points (m) of a path file, shape (n, 2).

    A file ``.csv`` has x and y in the columns of that name, or in the first two without a header;
    other columns are ignored. A file ``.yaml`` has the key ``points`` with a list of [x, y], and
    optionally ``closed: true``.
    """
    path = Path(file)
    readers = {'.csv': _csv_rows, '.yaml': _yaml_rows, '.yml': _yaml_rows}
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise PathError(f'{path} must end in .csv or .yaml: got {path.suffix or "no suffix"!r}')
    with yaml_loader.file_errors(path, PathError):
        rows = readers[suffix](yaml_loader.read_text(path, MAX_FILE_SIZE))
        points = np.array([_point(where, row) for where, row in rows]).reshape(-1, 2)
        if len(points) < 2 or not np.ptp(points, axis=0).any():
            raise yaml_loader.EntryError(f'two points that differ are needed: got {len(points)}')
    return points


def _csv_rows(text: str) -> list[tuple[str, object]]:
    rows = [row for row in csv.reader(text.splitlines()) if row and not row[0].startswith('#')]
    columns = (0, 1)
    if rows and not _is_number(rows[0][0]):
        header = [name.strip().lower() for name in rows.pop(0)]
        if 'x' not in header or 'y' not in header:
            raise yaml_loader.EntryError(f'the header must have x and y: got {", ".join(header)}')
        columns = header.index('x'), header.index('y')
    found: list[tuple[str, object]] = []
    for number, row in enumerate(rows):
        if len(row) <= max(columns):
            raise yaml_loader.EntryError(f'point {number} must have x and y: got {row}')
        found.append((f'point {number}', [row[column] for column in columns]))
    return found


def _yaml_rows(text: str) -> list[tuple[str, object]]:
    content = yaml_loader.check_entry(
        yaml_loader.parse_yaml(text), 'the path', ('points',), ('closed', 'name')
    )
    points = yaml_loader.check_list(content['points'], 'points')
    closed = yaml_loader.check_flag(content.get('closed', False), 'closed')
    return [(f'points[{n}]', point) for n, point in enumerate(points + points[:1] * closed)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _point(where: str, row: object) -> tuple[float, float]:
    if not isinstance(row, list) or len(row) != 2:
        raise yaml_loader.EntryError(
            f'{where} must be [x, y] in m: got {yaml_loader.shortened(row)}'
        )
    found = []
    for name, value in zip('xy', row, strict=True):
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not abs(number) <= MAX_COORDINATE:
            raise yaml_loader.EntryError(
                f'{name} of {where} must be a number of at most {MAX_COORDINATE:g} m: '
                f'got {yaml_loader.shortened(value)}'
            )
        found.append(number)
    return found[0], found[1]
