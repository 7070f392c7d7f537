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
"""How the results of a script are shown: in a terminal, a notebook, a paper, and as files."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from io import BytesIO
import os
from pathlib import Path
import sys
from typing import Any

import numpy as np

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.evaluation.result_output import Table, write_columns
from t3mpc_ros.parameters.command_line import check_writable
from t3mpc_ros.parameters.version_and_commit import provenance
from t3mpc_ros.script_error import ScriptError

PARQUET = '.parquet'
Columns = Mapping[str, Sequence[Any] | np.ndarray[Any, Any]]


class ShownAsTables(ABC):
    """A result whose numbers are tables.

    Its ``repr`` is one line, its ``str`` Markdown; as the last value of a cell of a notebook it is
    shown as tables.
    """

    @abstractmethod
    def _summary(self) -> str:
        """Return what it is, in one line."""

    @abstractmethod
    def _tables(self, chosen: str | None = None) -> list[Table]:
        """Return the tables of what is chosen, or of all."""

    @abstractmethod
    def _columns(self) -> Columns:
        """Return what the files hold."""

    def _details(self) -> Mapping[str, str]:
        """Return what a Parquet file says beside version and commit."""
        return {}

    def __repr__(self) -> str:
        return f'<{type(self).__name__}: {self._summary()}>'

    def __str__(self) -> str:
        return '\n\n'.join(table.markdown() for table in self._tables())

    def _repr_html_(self) -> str:
        return '\n'.join(table.html() for table in self._tables())

    def _paper_columns(self, table: Table) -> Sequence[str]:
        """Return the columns that a paper needs, by their headings."""
        return table.head

    @one_sentence
    def to_latex(
        self,
        chosen: str | None = None,
        *,
        columns: Sequence[str] | None = None,
        label: str = '',
        caption: str = '',
    ) -> str:
        """Return the tables in LaTeX, with the rules of its package ``booktabs``.

        Parameters
        ----------
        chosen
            A case of a comparison, or a metric of a sweep or a run; by default as ``str`` shows.
        columns
            Columns beside the first one, by their headings, with or without the unit. By default
            all; of a comparison those of the metric that decides, its difference and verdict.
        label, caption
            Of a single table; by default without a label, and with the caption of ``str``.
        """
        tables = self._tables(chosen)
        if (label or caption) and len(tables) > 1:
            raise ScriptError(
                f'label and caption are of one table: choose one of {len(tables)} cases'
            )
        return '\n'.join(
            replace(
                table.with_columns(self._paper_columns(table) if columns is None else columns),
                title=caption or table.title,
            ).latex(label)
            for table in tables
        )

    @one_sentence
    def to_frame(self) -> Any:
        """Return the columns as a data frame of pandas, which no extra of the package installs."""
        try:
            # No requirement of the package, which makes no frame itself.
            pandas = import_module('pandas')
        except ModuleNotFoundError:
            text = f'a data frame needs pandas: {sys.executable} -m pip install pandas'
            raise ScriptError(text) from None
        return pandas.DataFrame(dict(self._columns()))

    @one_sentence
    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns as CSV, one row for each run or period, and return the path."""
        target = writable(path, '.csv')
        write_columns(target, self._columns())
        return target

    @one_sentence
    def to_parquet(self, path: str | os.PathLike[str]) -> Path:
        """Write them as Parquet and return the path; needs the extra ``[compare]``."""
        return write_parquet(writable(path, PARQUET), self._columns(), self._details())


def write_parquet(
    path: str | os.PathLike[str], columns: Columns, details: Mapping[str, str] | None = None
) -> Path:
    """Write columns as one Parquet file, with version, commit and ``details`` in its metadata."""
    import pyarrow.parquet

    target = writable(path)
    table = arrow_table(columns)
    texts = {**provenance(), **(details or {})}
    table = table.replace_schema_metadata({name: str(text) for name, text in texts.items()})
    content = BytesIO()
    pyarrow.parquet.write_table(table, content)
    write_atomically(target, content.getvalue())
    return target


def arrow_table(columns: Columns) -> Any:
    """Return columns as a table of Arrow; ScriptError names the one that Parquet cannot hold."""
    import pyarrow

    arrays = {}
    for name, values in columns.items():
        try:
            arrays[name] = pyarrow.array(values)
        except pyarrow.ArrowException as error:
            raise ScriptError(
                f'values of {name} must be of one kind, numbers or texts, in a Parquet file: '
                f'{error}'
            ) from None
    return pyarrow.table(arrays)


def drawn(draw: Callable[[Any], Any], path: str | os.PathLike[str] | None) -> Any:
    """Return what ``draw`` makes by the module of the figures, written to ``path`` if given."""
    import matplotlib

    from t3mpc_ros.evaluation import figure_style  # it loads matplotlib, which a run does without

    with matplotlib.rc_context(figure_style.STYLE):
        figure = draw(figure_style)
    if path is not None:
        target = writable(path, *(f'.{kind}' for kind in figure_style.DATES))
        write_atomically(target, figure_style.file_of(figure, target.suffix.removeprefix('.')))
    return figure


def writable(path: str | os.PathLike[str], *suffixes: str) -> Path:
    """Return the path of a file; ValueError if it cannot be written, or has another suffix."""
    try:
        target = Path(path).expanduser()
    except TypeError:
        raise ScriptError(f'path must be a text or a Path: got {path!r}') from None
    if suffixes and target.suffix not in suffixes:
        raise ScriptError(f'path must end in {", ".join(suffixes)}: got {target}')
    check_writable(target)
    return target
