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
"""Experiment: runs of scenarios and methods, measured and kept, one row a run.

A study is a list of :class:`Run`; :func:`run_experiment` makes those that its file lacks, here or
on other machines, and returns a :class:`ResultTable`, from which means, paired differences, claims
and pages are made.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
import hashlib
import os
from pathlib import Path
import pickle
import sys
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.code_content import code_content
from t3mpc_ros.evaluation.confidence_intervals import Difference, paired
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.metrics import Numbers, measure
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.result_file import ResultFile, Row
from t3mpc_ros.evaluation.workers import Job, JobError, WorkerPool, map_jobs, workers_for
from t3mpc_ros.parameters.provenance import PACKAGE_DIRECTORY
from t3mpc_ros.version import VERSION

RESTARTS = 3
"""How often a pool of processes that lost one is started anew."""
Report = Callable[[str], None]
"""Receives messages about the progress of long work."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run of an experiment."""

    job: tuple[Any, Any]
    """Scenario and method, or what else the task of the experiment measures."""
    fields: Row
    """Columns that tell the run from the others: ``controller``, ``case``, ``seed`` and so on."""
    key: str = ''
    """Digest of all that determines its numbers, see :func:`digest`; needed to keep them."""


class ResultTable(Sequence[Row]):
    """Measured runs, one row each: what tells the run from others, and its numbers by name."""

    def __init__(self, rows: Sequence[Row], keys: Collection[str] = ()) -> None:
        self.rows = list(rows)
        self.keys = keys
        """Keys of the runs in the file that keeps them."""
        self._groups: dict[tuple[str, ...], dict[tuple[Hashable, ...], list[Row]]] = {}

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    def groups(self, *columns: str) -> dict[tuple[Hashable, ...], list[Row]]:
        """Return the rows by their values in some columns."""
        if columns not in self._groups:
            groups = self._groups[columns] = {}
            for row in self.rows:
                groups.setdefault(tuple(row.get(name) for name in columns), []).append(row)
        return self._groups[columns]

    def where(self, **wanted: Hashable) -> list[Row]:
        """Return the rows with these values, in their order."""
        return self.groups(*wanted).get(tuple(wanted.values()), [])

    def values(self, column: str, **wanted: Hashable) -> list[Any]:
        """Return a column of those rows that have it."""
        return [row[column] for row in self.where(**wanted) if column in row]

    def unique(self, column: str, **wanted: Hashable) -> tuple[Any, ...]:
        """Return the values of a column, each once, in the order of the rows."""
        return tuple(dict.fromkeys(self.values(column, **wanted)))

    def difference(
        self, metric: str, first: Row, second: Row, *, pair: str = 'seed'
    ) -> Difference | None:
        """Return how much larger a metric is in the rows of ``first`` than in those of ``second``.

        Rows are paired by their seed; None where one of both was not measured.
        """
        one, other = (
            {row[pair]: row[metric] for row in self.where(**wanted) if metric in row}
            for wanted in (first, second)
        )
        if not (one and other):
            return None
        if one.keys() != other.keys():
            raise ValueError(f'{metric} must be paired by {pair}: got {first} and {second}')
        return paired(list(one.values()), [other[key] for key in one])


def measured_run(job: Job) -> Numbers:
    """Return the metrics of one run."""
    scenario, method = job
    return measure(scenario, run(scenario, method))


def run_experiment(
    runs: Sequence[Run],
    task: Callable[[Any], Mapping[str, Any]] = measured_run,
    workers: Any = 1,
    *,
    store: Path | None = None,
    fresh: bool = False,
    report: Report | None = None,
) -> ResultTable:
    """Return one row for each run, in their order.

    Numbers depend neither on who works nor on what the file holds: a run that it holds is not
    made again, and each that is made is added to it at once, so that an experiment that was
    interrupted goes on where it was.

    ``task``, a function of a module, makes the numbers of a job, plain data by name; ``workers``
    are those of :func:`.workers_for`; ``store`` is the file, with ``fresh`` emptied before;
    ``report`` receives messages, with None there is no progress line either.
    """
    if store is None:
        jobs = [run.job for run in runs]
        made = map_jobs(task, jobs, workers_for(workers, jobs), progress=report is not None)
        return ResultTable([{**run.fields, **row} for run, row in zip(runs, made, strict=True)])
    by_key = {run.key: run.job for run in runs}
    if len(by_key) < len(runs) or '' in by_key:
        raise ValueError('runs must have different keys')
    with ResultFile(store, fresh=fresh) as file:
        kept = _complete(file, by_key, task, workers, report)
    return ResultTable([{**run.fields, **kept[run.key]} for run in runs], by_key.keys())


def _complete(
    file: ResultFile,
    jobs: Mapping[str, Any],
    task: Callable[[Any], Mapping[str, Any]],
    workers: Any,
    report: Report | None,
) -> dict[str, Row]:
    """Return the row of every job; those that the file lacks are made, and added to it at once."""
    write = report or (lambda text: None)
    known = file.read()
    found = {key: known[key] for key in jobs if key in known}
    text = f'{len(jobs)} runs; {len(found)} are there already, {len(jobs) - len(found)} to do'
    if others := len(known) - len(found):
        text += f'; {others} of other versions, settings or extents are left alone'
    if file.unreadable:
        text += f'; {file.unreadable} lines that are torn or of an older version are skipped'
    write(text)
    restarts = RESTARTS
    try:
        while missing := [key for key in jobs if key not in found]:
            todo = [jobs[key] for key in missing]
            pool = WorkerPool(workers_for(workers, todo))
            try:
                with pool, progress_bar(len(todo), show=report is not None) as bar:
                    for index, numbers in pool.map(task, todo):
                        found[missing[index]] = row = dict(numbers)
                        file.add(missing[index], row)
                        bar.update()
            except JobError as error:
                restarts -= 1
                if restarts < 0 or not isinstance(error.__cause__, BrokenExecutor):
                    raise
                write('a worker process was lost; its runs are begun again')
    except BaseException:
        write(
            f'{len(found)} of {len(jobs)} runs are kept in {file.path}: '
            'the same command goes on from there'
        )
        raise
    return found


def print_report(line: str) -> None:
    """Print a message about the progress on standard error."""
    print(line, file=sys.stderr, flush=True)


# -- what determines the numbers of a run ---------------------------------------------------------


def digest(*parts: Any) -> str:
    """Return a digest of version, sources of this package, and the content of ``parts``.

    Functions and classes of a script count with their source and with what they use, files with
    their content.
    """
    content = VERSION, source_digest(), [content_of(part) for part in parts]
    return hashlib.sha256(repr(content).encode()).hexdigest()[:16]


# Sources that only display, record or select. All others, and the tuned values, make stored runs
# invalid: a needless repetition is better than an outdated result.
_IRRELEVANT_SOURCES = (
    'nodes/', 'bag/', 'radio/', 'emulator/', 'cli/', 'view/', 'page/', 'evaluation/bag_report/',
    'evaluation/process_replay/', 'evaluation/comparison',
    'evaluation/fault_page.py', 'evaluation/plotting.py', 'evaluation/reporting.py',
    'evaluation/result_file.py', 'evaluation/paper/',
    'evaluation/patrol/patrol_page.py', 'evaluation/patrol/patrol_figures.py',
    'evaluation/patrol/tracking_page.py',
)  # fmt: skip


@cache
def source_digest(package: Path = PACKAGE_DIRECTORY) -> str:
    """Return a digest of every source and data file that can change the numbers of a run."""
    suffixes = ('.py', '.npy', '.npz', '.yaml', '.json', '.csv')
    found = hashlib.sha256()
    for path in sorted(package.rglob('*')):
        name = path.relative_to(package).as_posix()
        if path.suffix in suffixes and not name.startswith(_IRRELEVANT_SOURCES):
            found.update(name.encode() + b'\0' + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:16]


def content_of(value: Any) -> object:
    """Return what a value is, as text and numbers; equal ones have equal content."""
    if isinstance(value, str | os.PathLike):
        return os.fspath(value), _file_digest(value)
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return str(value.dtype), value.shape, content
    if isinstance(value, Mapping):
        return [(str(key), content_of(item)) for key, item in value.items()]
    if isinstance(value, list | tuple):
        return [content_of(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        items = [content_of(getattr(value, item.name)) for item in fields(value)]
        used = getattr(value, 'resolve', None)  # of a file: what it uses of other files
        code = [] if used is None else _code(used())
        return _code(type(value)), items, code
    return _code(value)


def _file_digest(value: str | os.PathLike[str]) -> str:
    """Return a digest of a file, such as a world or a model; '' if it is none.

    A word without suffix and folder is a name, whatever files there are where the program runs.
    """
    path = Path(os.path.expanduser(value))
    if isinstance(value, str) and not path.suffix and path.name == value:
        return ''
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ''
    except OSError:
        return ''


def _code(value: Any) -> object:
    """Return the source of a function or class, or of the class of an object and its state."""
    if hasattr(value, '__qualname__'):
        return code_content(value, content_of)
    code = code_content(type(value), content_of)
    try:
        return *code, hashlib.sha256(pickle.dumps(value)).hexdigest()
    except (pickle.PicklingError, AttributeError, TypeError):
        return code
