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

Worker processes import the main module again: a script that uses more than one worker guards its
work by ``if __name__ == '__main__':``.
"""

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
import fcntl
from io import TextIOWrapper
from itertools import starmap
import json
import multiprocessing
from multiprocessing.context import SpawnContext, SpawnProcess
import os
from pathlib import Path
import pickle
import signal
import sys
from typing import Any, Self, TypeVar

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.baselines.feed_forward import FeedForward, FeedForwardParameters
from t3mpc_ros.evaluation.cases import NOMINAL, PLANTS
from t3mpc_ros.evaluation.confidence_intervals import Difference, paired
from t3mpc_ros.evaluation.loop import Method, MethodSpec, run
from t3mpc_ros.evaluation.modules_on_cluster import ModuleCarrier
from t3mpc_ros.evaluation.result_output import progress_bar
from t3mpc_ros.evaluation.run_record import Record, measure
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.parent_process import end_with_parent

Row = dict[str, Any]
"""Plain data by name."""
KEY = 'run'
"""Name in a line of what tells its run from all others."""


class ResultFile:
    """Finished runs by key in a file of JSON lines; a context that one writer has at a time.

    A line is written as a whole and flushed. Should a writer be killed within one, what is torn
    is that line alone: reading skips it, and the next writer begins on a line of its own. With
    ``fresh``, what the file holds is thrown away on first entry.
    """

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        self.path = path
        self._fresh = fresh
        self.unreadable = 0
        """Lines of the last reading that were torn or of another kind."""
        self._stream: TextIOWrapper | None = None

    def read(self) -> dict[str, Row]:
        """Return every run the file holds, of whatever version; empty when there is no file."""
        self.unreadable = 0
        found: dict[str, Row] = {}
        text = ''
        with suppress(FileNotFoundError):
            text = self.path.read_text(encoding='utf-8', errors='replace')
        for line in text.split('\n'):
            if not line.strip():
                continue
            try:
                row = json.loads(line)
                found[str(row.pop(KEY))] = row
            except (ValueError, KeyError, TypeError, AttributeError):
                self.unreadable += 1
        return found

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """Append a finished run."""
        if self._stream is None:
            raise RuntimeError('the file must be entered before runs are added')
        self._stream.write(_line(key, row))
        self._stream.flush()

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.is_dir():
            raise RuntimeError(f'{self.path} must be a file for the runs: move that folder away')
        stream = self.path.open('a+', encoding='utf-8', errors='replace')
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise RuntimeError(f'another process is writing to {self.path}') from None
        if self._fresh:
            stream.truncate(0)
            self._fresh = False
        content = self.path.read_bytes()
        if content and not content.endswith(b'\n'):
            stream.write('\n')
            stream.flush()
        self._stream = stream
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def remove(self, keys: Collection[str]) -> None:
        """Remove runs from the file, and the file if it holds no others."""
        with self:
            others = {key: row for key, row in self.read().items() if key not in keys}
            if others:
                write_atomically(self.path, ''.join(starmap(_line, others.items())))
            else:
                self.path.unlink()


def _line(key: str, row: Mapping[str, Any]) -> str:
    return json.dumps({KEY: key, **row}, ensure_ascii=False) + '\n'


GUARD = "a script that uses several processes must begin its work with: if __name__ == '__main__':"
LOST_PROCESS = f'a worker process ended before its work was done; {GUARD}'
T = TypeVar('T')
Job = tuple[Scenario, Method]
"""What the task of a job gets; the name of the second part is that of the job in errors."""
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
    """Digest of all that determines its numbers, see :func:`.digest`; needed to keep them."""


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

    def difference(self, metric: str, first: Row, second: Row) -> Difference | None:
        """Return how much larger a metric is in the rows of ``first`` than in those of ``second``.

        Rows are paired by their seed; None where one of both was not measured.
        """
        one, other = (
            {row['seed']: row[metric] for row in self.where(**wanted) if metric in row}
            for wanted in (first, second)
        )
        if not (one and other):
            return None
        if one.keys() != other.keys():
            raise ValueError(f'{metric} must be paired by seed: got {first} and {second}')
        return paired(list(one.values()), [other[key] for key in one])


def recorded_run(job: Job) -> Record:
    """Return the record of one run."""
    return run(*job)


def measured_run(job: Job, numbers: Callable[[Record], Mapping[str, Any]] = measure) -> Row:
    """Return the numbers of one run, by default its metrics."""
    return dict(numbers(run(*job)))


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


# -- who makes the runs ---------------------------------------------------------------------------


class JobError(RuntimeError):
    """A run that failed; the text names method and scenario."""


class _WorkerProcess(SpawnProcess):
    """A worker process: Ctrl-C, which a terminal sends to all, is for its parent."""

    def start(self) -> None:
        """Start it with the signal blocked, which it inherits and so is from its first moment."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _WorkerContext(SpawnContext):
    """Makes worker processes, spawned and not forked, and knows them.

    A fork would copy whatever threads and locks this process has.
    """

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[SpawnProcess] = []

    def Process(self, *arguments: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]
        """Return a new worker process."""
        process = _WorkerProcess(*arguments, **options)
        self.processes.append(process)
        return process


class WorkerPool:
    """Executor that runs jobs, kept warm from one batch to the next.

    Jobs share nothing, so results do not depend on who works. ``workers`` are so many processes of
    this machine, one is this process itself; or an executor, which the caller ends.
    """

    def __init__(self, workers: int | Executor) -> None:
        if isinstance(workers, int) and workers < 1:
            raise ValueError(f'workers must be at least 1: got {workers}')
        self._workers = workers
        self._pool: Executor | None = None
        self._context = _WorkerContext()

    def __enter__(self) -> Self:
        if isinstance(self._workers, Executor):
            self._pool = self._workers
        elif self._workers > 1:
            _check_guarded()
            self._pool = ProcessPoolExecutor(
                self._workers, self._context, _start_worker, (os.getpid(),)
            )
        return self

    def __exit__(self, kind: object = None, *_: object) -> None:
        if kind is not None:
            # After Ctrl-C or an error nobody waits for the runs that have begun.
            for process in self._context.processes:
                if process.is_alive():
                    process.terminate()
        if self._pool is not None and self._pool is not self._workers:
            self._pool.shutdown(cancel_futures=True)
        self._pool = None

    def map(self, task: Callable[[Any], T], jobs: Iterable[Any]) -> Iterator[tuple[int, T]]:
        """Yield (index of the job, ``task`` of it) as the jobs are finished.

        ``task`` is a function of a module. JobError: it raised an exception; the jobs not begun
        are dropped.
        """
        if self._pool is None:
            for index, job in enumerate(jobs):
                try:
                    result = task(job)
                except Exception as error:
                    raise _job_error(job, error) from error
                yield index, result
            return
        begun: dict[Future[T], tuple[int, Any]] = {}
        try:
            for index, job in enumerate(jobs):
                try:
                    begun[self._pool.submit(task, job)] = index, job
                except BrokenExecutor as error:  # a process was lost meanwhile
                    raise _job_error(job, error) from error
            for future in as_completed(begun):
                index, job = begun.pop(future)
                failure = future.exception()
                if failure is not None:
                    raise _job_error(job, failure) from failure
                yield index, future.result()
        finally:
            for future in begun:
                future.cancel()


def map_jobs(
    task: Callable[[Any], T],
    jobs: Sequence[Any],
    workers: int | Executor = 1,
    *,
    progress: bool = False,
) -> list[T]:
    """Return ``task`` of every job in their order; ``workers`` as for :class:`WorkerPool`."""
    found: dict[int, T] = {}
    with WorkerPool(workers) as pool, progress_bar(len(jobs), show=progress) as bar:
        for index, result in pool.map(task, jobs):
            found[index] = result
            bar.update()
    return [found[index] for index in range(len(jobs))]


def _check_guarded() -> None:
    """Raise ValueError if the script that is run begins its work without a guard.

    Each worker would import it, do again what comes before, and end where the processes start.
    """
    main = sys.modules['__main__']
    file, frame = getattr(main, '__file__', None), sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        if file and frame.f_code.co_name == '<module>' and frame.f_code.co_filename == file:
            with suppress(OSError, UnicodeError), open(file, encoding='utf-8') as script:
                if '__name__' not in script.read():
                    raise ValueError(GUARD)


def _job_error(job: Any, error: BaseException) -> JobError:
    text = str(job)
    if isinstance(job, tuple) and len(job) == 2:
        scenario, method = job
        text = f'{getattr(method, "name", method)} on {scenario}'
    return JobError(f'{text} failed: {error!r}')


def _start_worker(parent: int) -> None:
    """Prepare a worker process, which ends with its parent, also if that is killed."""
    end_with_parent(parent)
    warm_up()


def warm_up() -> None:
    """Load, or compile, every kernel of the loop itself, in both drives."""
    for robot in PLANTS:
        scenario = Scenario(robot, NOMINAL, 1, 0.05)
        run(scenario, MethodSpec('warm up', FeedForward, FeedForwardParameters()))


def workers_for(executor: Any, jobs: Sequence[Any]) -> int | Executor:
    """Return who makes runs: a number of processes, or an executor.

    ``executor`` is one, a Dask client, a number of processes, or None for one on each processor.
    One run, and runs of an interactive session, which other processes cannot import, are made
    in this process unless an executor is given.
    """
    if callable(make := getattr(executor, 'get_executor', None)):  # a Dask client
        executor = make(pure=False)
    if isinstance(executor, Executor):
        other_machines = type(executor).__module__.startswith('distributed.')
        return ModuleCarrier(executor) if other_machines else executor
    if executor is not None and (isinstance(executor, bool) or not isinstance(executor, int)):
        raise ValueError(
            'executor must be None, a number of processes, a concurrent.futures.Executor or a '
            f'Dask client: got {executor!r}'
        )
    if executor is not None and executor < 1:
        raise ValueError(f'executor must be at least 1 process: got {executor}')
    if getattr(multiprocessing.process.current_process(), '_inheriting', False):
        # The program of a worker process runs this script again: it would start workers for ever.
        raise SystemExit(f'error: {LOST_PROCESS}')
    if executor == 1 or len(jobs) < 2:
        return 1
    count = executor or len(os.sched_getaffinity(0))
    if executor is None and not hasattr(sys.modules['__main__'], '__file__'):
        return 1
    if count > 1:
        try:
            pickle.dumps(jobs[0])
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ValueError(
                'controller, plant and noise must be defined at the top level of a file to be '
                f'sent to other processes; use executor=1 to stay in this one: got {error}'
            ) from None
    return min(count, len(jobs))
