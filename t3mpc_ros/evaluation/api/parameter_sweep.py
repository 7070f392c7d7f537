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
"""Runs over parameters × seeds × cases × controllers: ``sweep`` and its result."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
import itertools
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.api import comparison_runs, result_tables
from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence, sentence
from t3mpc_ros.evaluation.api.own_robot import NoiseLaw
from t3mpc_ros.evaluation.api.script_inputs import as_controllers, check_method, own_scenario
from t3mpc_ros.evaluation.api.single_run import DIVERGED, divergence
from t3mpc_ros.evaluation.cases import NOMINAL, LinkFaults
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean
from t3mpc_ros.evaluation.experiment import (
    Job,
    Report,
    ResultFile,
    ResultTable,
    Row,
    Run,
    measured_run,
    print_report,
    run_experiment,
)
from t3mpc_ros.evaluation.result_output import EMPTY_CELL, Table, columns_of
from t3mpc_ros.evaluation.run_cache_key import digest
from t3mpc_ros.evaluation.run_record import METRICS, SETTLED, Metric, measure
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.parameters.version_and_commit import provenance
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_schedule import FaultSchedule

ROBOT = 'robot.'
"""Prefix of a parameter of the true robot."""
OF_SETTING = ('noise', 'duration')
REMEDY = '; every controller gets every parameter: sweep each with its own, into one output'
RUN, ERROR = 'run', 'error'
"""Columns: digest of all that determines a run, and why it has no numbers; '' with them."""
COLUMNS = {
    *('controller', 'robot', 'reference', 'case', 'seed', RUN, ERROR),
    *provenance(),
    *(metric.name for metric in METRICS),
}
"""Columns that no parameter may have; that of noise or duration is the swept one."""


@dataclass(frozen=True, eq=False, repr=False)
class Sweep(result_tables.ShownAsTables):
    """Result of a sweep: one row for each run.

    A row holds ``controller``, the swept parameters by name, ``robot``, ``reference``, ``case``,
    ``seed``, ``noise``, ``duration``, the metrics of the comparison, ``error``, ``version``,
    ``commit``, ``python``, and ``run``, a digest of all that determines its numbers.
    """

    rows: Sequence[Row]
    parameters: tuple[str, ...]
    """Names of the swept parameters."""
    path: Path | None = None
    """The Parquet file."""

    @property
    def columns(self) -> dict[str, list[Any]]:
        """The rows as columns."""
        return columns_of(self.rows)

    @one_sentence
    def table(self, metric: str = SETTLED.name) -> str:
        """Return a metric in Markdown: mean and 95 % interval over the seeds of each cell."""
        return self._tables(metric)[0].markdown()

    def _summary(self) -> str:
        return f'{", ".join(self.parameters)}; {len(self.rows)} runs'

    def _columns(self) -> result_tables.Columns:
        return self.columns

    def _tables(self, chosen: str | None = None) -> list[Table]:
        metric = comparison_runs.find_metric(chosen or SETTLED.name)
        names = ('controller', *self.parameters, 'case')
        lines: list[tuple[str, ...]] = []
        notes: list[str] = []
        for cell, rows in ResultTable(self.rows).groups(*names).items():
            text = _outcome(rows, metric)
            if reasons := [f'seed {row["seed"]}: {row[ERROR]}' for row in rows if row[ERROR]]:
                text += f' [{len(notes) + 1}]'
                notes.append(f'[{len(notes) + 1}] {reasons[0]}')
            lines.append((*map(str, cell), str(len(rows)), text))
        head = (*names, 'seeds', f'{metric.heading}, {metric.unit}')
        return [Table('', head, lines, text=1 + len(self.parameters) + 1, notes=notes)]

    @one_sentence
    def plot(
        self,
        parameter: str,
        metric: str = SETTLED.name,
        path: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Return a Matplotlib figure of a metric over a swept parameter, a line per controller.

        Means over all else, with 95 % intervals; written to ``path``, a .png, .pdf or .svg, if one
        is given.
        """
        (name,) = find_names('parameter', [parameter], self.parameters)
        wanted = comparison_runs.find_metric(metric)
        if not any(wanted.name in row for row in self.rows):
            known = sorted(set().union(*self.rows) & {each.name for each in METRICS})
            raise ScriptError(f'metric must be one of {", ".join(known)}: got {wanted.name}')
        lines: dict[str, dict[Any, list[float]]] = {}
        for (line, value), rows in ResultTable(self.rows).groups('controller', name).items():
            numbers = [row.get(wanted.name, math.nan) for row in rows]
            lines.setdefault(str(line), {})[value] = numbers
        label = f'{wanted.heading} / ({wanted.unit})'
        return result_tables.drawn(lambda figures: figures.sweep_figure(lines, name, label), path)


def has_failed(row: Row) -> bool:
    """Return whether a run ended with an error; one that diverged has its result."""
    return bool(row[ERROR]) and not row[ERROR].startswith(DIVERGED)


def _outcome(rows: Sequence[Row], metric: Metric) -> str:
    """Return the mean of a cell, or how many of its runs have none: a mean of the others lies."""
    failed = sum(map(has_failed, rows))
    diverged = sum(bool(row[ERROR]) for row in rows) - failed
    if not failed + diverged:
        values = [row[metric.name] for row in rows if metric.name in row]
        if not values:
            return EMPTY_CELL
        return format_interval(mean(values), interval(values), '', metric.digits)
    counts = {'failed': failed, DIVERGED: diverged}
    return ', '.join(
        word if count == len(rows) else f'{count} of {len(rows)} {word}'
        for word, count in counts.items()
        if count
    )


@one_sentence
def sweep(
    controllers: Any,
    parameters: Mapping[str, Sequence[Any]],
    *,
    seeds: Iterable[int] = (1, 2, 3, 4, 5),
    cases: Sequence[str] = (NOMINAL,),
    reference: Any = None,
    plant: Any = 'twin',
    noise: float | NoiseLaw = 0.04,
    faults: LinkFaults | FaultSchedule | str | None = None,
    duration: float = 60.0,
    output: str | os.PathLike[str] | None = None,
    executor: Executor | int | None = None,
    progress: bool = False,
) -> Sweep:
    """Return the metrics of every combination of parameters, seeds, cases and controllers.

    A run that fails, or diverges, is a row with the reason in ``error`` and without numbers. What
    :func:`simulate` refuses, such as a parameter that one of the controllers does not have, is
    refused before the first run. A sweep with a file that is interrupted goes on where it was when
    it is started again; a run that failed is made again then, one that diverged is not.

    Parameters
    ----------
    controllers
        One or more of what :func:`simulate` takes as a controller.
    parameters
        Values by name: parameters of the controllers or keyword arguments of their classes;
        ``noise`` and ``duration``; and ``robot.NAME`` of the true robot, unknown to controllers.
    seeds, cases, reference, plant, noise, faults, duration
        As for :func:`compare`.
    output
        Parquet file; needs the extra ``[compare]``. Rows that it holds of other sweeps stay.
    executor
        None: a process for each processor; a number of processes, 1 for this one; or an
        :class:`concurrent.futures.Executor` or a Dask client. The numbers are the same.
    progress
        Whether lines on standard error show progress and the time left.

    Raises
    ------
    ScriptError
        As for :func:`simulate`, or because every run failed.
    """
    setting = {'plant': plant, 'reference': reference, 'noise': noise, 'faults': faults}
    setting['duration'] = duration
    runs = make_runs(controllers, parameters, comparison_runs.checked_seeds(seeds), cases, setting)
    report = print_report if progress else None
    path = None
    if output is None:
        rows = list(run_experiment(runs, numbers_or_error, executor, report=report))
    else:
        path = result_tables.writable(output, result_tables.PARQUET)
        rows = _run_to_file(path, runs, executor, report)
    if all(map(has_failed, rows)):
        raise ScriptError(f'every run failed: {rows[0][ERROR]}')
    return Sweep(rows, tuple(parameters), path)


def make_runs(
    controllers: Any,
    parameters: Mapping[str, Sequence[Any]],
    seeds: Sequence[int],
    cases: Sequence[str],
    setting: Mapping[str, Any],
) -> list[Run]:
    """Return the runs of a sweep, each with the digest of all that determines it.

    Seed by seed, so that an estimate of the time left holds. ``setting`` has the arguments of
    :func:`own_scenario` that no parameter sweeps.
    """
    combinations = []
    for values in _combinations(parameters):
        swept = {name: values[name] for name in OF_SETTING if name in values}
        true = {k.removeprefix(ROBOT): v for k, v in values.items() if k.startswith(ROBOT)}
        scenario = own_scenario(**{**setting, **swept}, robot_parameters=true)
        combinations.append((values, scenario))
    chosen = comparison_runs.chosen_cases(cases, combinations[0][1])
    prepared, given = [], as_controllers(controllers)
    comparison_runs.check_names([controller.name for controller in given])
    for controller in given:
        for values, scenario in combinations:
            own = {k: v for k, v in values.items() if not (k in OF_SETTING or k.startswith(ROBOT))}
            source = replace(controller, settings={**controller.settings, **own})
            try:
                method = source.method(scenario.robot)
                check_method(method, scenario, chosen)
            except ValueError as error:
                # A grid with holes compares nothing, and a wrong name would cost a night.
                what = ', '.join([controller.name, *(f'{k} {v}' for k, v in values.items())])
                remedy = REMEDY if len(given) > 1 else ''
                raise ScriptError(f'no run was begun: {what}: {error}{remedy}') from None
            prepared.append((controller.name, values, scenario, method))
    origin = provenance()
    runs = []
    for seed in seeds:
        for case in chosen:
            for name, values, some, method in prepared:
                scenario = replace(some, case=case, seed=seed)
                row = {
                    'controller': name,
                    **values,
                    'robot': scenario.robot,
                    'reference': reference_text(setting.get('reference')),
                    'case': case,
                    'seed': seed,
                    'noise': scenario.noise,
                    'duration': float(scenario.duration),
                }
                key = digest(origin['python'], scenario, method)
                runs.append(Run((scenario, method), {**row, **origin, RUN: key}, key))
    if len({run.key for run in runs}) < len(runs):
        raise ScriptError('controllers and values must differ: got two runs that are the same')
    return runs


def reference_text(reference: Any) -> str:
    """Return what a reference is: ``chaotic``, the path of a file, or the kind of the source."""
    if reference is None:
        return 'chaotic'
    if isinstance(reference, str | os.PathLike):
        return os.fspath(reference)
    return str(getattr(reference, '__name__', type(reference).__name__))


def _combinations(parameters: Mapping[str, Sequence[Any]]) -> list[Row]:
    if not isinstance(parameters, Mapping):
        raise ScriptError(f'parameters must map names to lists of values: got {parameters!r}')
    for name, values in parameters.items():
        if not isinstance(name, str):
            raise ScriptError(f'parameters must map names to lists of values: got {name!r}')
        if name in COLUMNS:
            raise ScriptError(
                f'{name} is a column of every sweep: give the argument of the class another name'
            )
        if isinstance(values, str) or not hasattr(values, '__iter__'):
            raise ScriptError(f'{name} must be a list of values: got {values!r}')
    # NumPy's numbers are no parameter values, and no JSON.
    lists = [
        [value.item() if isinstance(value, np.generic) else value for value in values]
        for values in parameters.values()
    ]
    if not all(lists):
        raise ScriptError('each parameter must have one or more values')
    for name, values in zip(parameters, lists, strict=True):
        try:
            repeated = len({*values}) < len(values)
        except TypeError:
            raise ScriptError(
                f'values of {name} must be numbers, truth values or texts: got {values!r}'
            ) from None
        if repeated:  # the table would count the seeds of one cell twice
            raise ScriptError(f'values must differ: got {values!r} of {name}')
        if wrong := [value for value in values if not _is_finite(value)]:
            raise ScriptError(f'values of {name} must be finite: got {wrong[0]}')
    return [dict(zip(parameters, each, strict=True)) for each in itertools.product(*lists)]


def _is_finite(value: Any) -> bool:
    """Return whether a value is no number, nor the text of one, that is infinite or NaN."""
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return True


def numbers_or_error(job: Job) -> Row:
    """Return the metrics of one run, or its error.

    Errors that say nothing about the run itself, such as a missing library, are raised.
    """
    try:
        return measured_run(job, lambda record: {**measure(record), ERROR: divergence(record)})
    except (ValueError, ArithmeticError) as error:
        return {ERROR: sentence(error)}


@contextmanager
def cluster(address: str, timeout: float = 10.0) -> Iterator[Executor]:
    """Enter the executor of a Dask scheduler, tcp://HOST:PORT, that answers within some s."""
    import distributed

    try:
        client = distributed.Client(address, timeout=timeout)
    except (OSError, TimeoutError, ValueError) as error:
        raise ScriptError(
            f'no Dask scheduler answers at {address}; start one with "dask scheduler" and '
            f'workers with "dask worker ADDRESS": {error}'
        ) from None
    with client:
        found = client.get_executor(pure=False)
        assert isinstance(found, Executor)
        yield found


# -- file -----------------------------------------------------------------------------------------


def _run_to_file(
    path: Path, runs: Sequence[Run], workers: Any, report: Report | None
) -> list[Row]:
    """Run what the file and its journal lack, write the file, and remove them from the journal."""
    stored = _read(path)
    wanted = [run for run in runs if run.key not in stored or has_failed(stored[run.key])]
    if stored and report is not None:
        report(f'{path} holds {len(runs) - len(wanted)} of {len(runs)} runs')
    if not wanted:
        return [{**run.fields, **stored[run.key]} for run in runs]
    fields = [run.fields for run in wanted]
    result_tables.arrow_table(columns_of([*fields, *stored.values()]))  # an error before the runs
    journal = ResultFile(path.with_name(f'{path.name}.runs.jsonl'))
    journal.remove({key for key, row in journal.read().items() if has_failed(row)})
    made = run_experiment(wanted, numbers_or_error, workers, store=journal.path, report=report)
    fresh = {row[RUN]: row for row in made}
    rows = [fresh.get(run.key) or {**run.fields, **stored[run.key]} for run in runs]
    keys = {run.key for run in runs}
    result_tables.write_parquet(
        path, columns_of([*rows, *(row for key, row in stored.items() if key not in keys)])
    )
    journal.remove(made.keys)
    return rows


def _read(path: Path) -> dict[str, Row]:
    """Return the rows of a file by their digest."""
    # Here, so that a missing library is an error before the runs.
    import pyarrow.parquet

    if not path.exists():
        return {}
    try:
        rows = pyarrow.parquet.read_table(path).to_pylist()
    except (pyarrow.ArrowException, OSError) as error:
        raise ScriptError(f'{path} is no Parquet file: {error}') from None
    if any(RUN not in row for row in rows):
        raise ScriptError(f'{path} is no file of a sweep: its rows have no column {RUN}')
    # A run that failed lacks the columns of the others: they are empty in the file.
    known = ({name: v for name, v in row.items() if v is not None} for row in rows)
    return {row[RUN]: row for row in known}
