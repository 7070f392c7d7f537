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
"""Tables of a script as CSV and Parquet files."""

from collections.abc import Mapping, Sequence
import os
from pathlib import Path
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.reporting import write_columns
from t3mpc_ros.parameters.command_line import check_writable
from t3mpc_ros.parameters.provenance import provenance

Columns = Mapping[str, Sequence[Any] | np.ndarray[Any, Any]]


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return rows as columns; None where a row does not have a column of another one."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {name: [row.get(name) for row in rows] for name in names}


def write_csv(path: str | os.PathLike[str], columns: Columns) -> Path:
    """Write columns as CSV with one line of names, numbers with all their digits."""
    target = writable(path)
    write_columns(target, columns)
    return target


def write_parquet(
    path: str | os.PathLike[str], columns: Columns, details: Mapping[str, str] | None = None
) -> Path:
    """Write columns as one Parquet file, with version, commit and ``details`` in its metadata."""
    import pyarrow
    import pyarrow.parquet

    target = writable(path)
    table = pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()})
    texts = {**provenance(), **(details or {})}
    table = table.replace_schema_metadata({name: str(text) for name, text in texts.items()})
    # A reader of an interrupted write finds the old file or none, never half of one.
    part = target.with_name(f'{target.name}.part')
    pyarrow.parquet.write_table(table, part)
    part.replace(target)
    return target


def writable(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file; ParameterError if it cannot be written, as in no folder."""
    target = Path(path).expanduser()
    check_writable(target)
    return target
