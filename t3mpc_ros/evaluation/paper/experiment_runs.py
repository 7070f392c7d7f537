# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs the missing experiments and keeps finished runs in a JSON lines file."""

from collections.abc import Callable, Mapping, Sequence
import contextlib
from dataclasses import asdict, dataclass, fields, is_dataclass
import fcntl
import hashlib
from io import TextIOWrapper
import json
import math
from pathlib import Path
from typing import Any, Self

import numpy as np

import t3mpc_ros
from t3mpc_ros.evaluation.closed_loop import LoopRecord
from t3mpc_ros.evaluation.methods import ComparedMethod
from t3mpc_ros.evaluation.paper.experiment_grid import (
    Experiment,
    ExperimentGrid,
    ExperimentSetup,
)
from t3mpc_ros.evaluation.reporting import finite, progress_bar
from t3mpc_ros.parameters.provenance import PACKAGE_DIRECTORY

SETTLING = 1.0
"""Seconds about each switch that the settled RMSE leaves out."""
START = 3.0
"""Seconds at the start that no number counts: the reference grows from zero."""

# Sources that cannot change the result of a run with given method parameters. All others
# invalidate stored runs: a needless repetition is better than an outdated result.
_IRRELEVANT_SOURCES = (
    'nodes/', 'bag/', 'radio/', 'emulator/', 'cli/', 'evaluation/bag_report/',
    'evaluation/process_replay/', 'evaluation/paper/', 'evaluation/tuning/',
    'evaluation/method_comparison/', 'evaluation/baselines/feed_forward.py',
    'evaluation/plotting.py', 'evaluation/reporting.py', 'evaluation/lyapunov_exponents.py',
    'evaluation/open_loop_estimation.py', 'evaluation/methods.py',
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class RunNumbers:
    """The numbers of one run; NaN where a run left the finite numbers."""

    rmse: float
    """Tracking RMSE of both wheels, rad/s."""
    settled: float
    """The same without :data:`SETTLING` about each switch."""
    chatter: float
    """Total variation of the effort per second and wheel, rad/s³."""
    largest_error: float
    """rad/s"""
    finite: bool
    """Whether every number of the run is finite."""


def measure(run: LoopRecord) -> RunNumbers:
    """Return the metrics of a run; the first :data:`START` seconds do not count."""
    arrays = run.reference, run.speeds, run.command, run.terms
    if not all(bool(np.isfinite(values).all()) for values in arrays):
        return RunNumbers(math.nan, math.nan, math.nan, math.nan, False)
    counted = np.abs(run.speeds - run.reference)[run.time >= START]
    return RunNumbers(
        float(run.rmse(START)),
        float(run.rmse(START, cut=SETTLING)),
        float(run.chatter()),
        float(np.max(counted, initial=0.0)),
        True,
    )


def source_digest(package: Path = PACKAGE_DIRECTORY) -> str:
    """Return a digest of every source file that can change the result of a run.

    It covers the Python and array files of the package except those that only display, record or
    select, and includes this file, which measures. Tuned values are part of the method's
    parameters.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob('*')):
        name = path.relative_to(package).as_posix()
        kept = name == 'evaluation/paper/experiment_runs.py' or not name.startswith(
            _IRRELEVANT_SOURCES
        )
        if kept and path.suffix in ('.py', '.npy', '.npz'):
            digest.update(name.encode() + b'\0' + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def fingerprint(method: ComparedMethod, sources: str) -> str:
    """Return a digest of version, sources and method, on which the result of a scenario depends.

    Raises
    ------
    TypeError
        The method, or its parameters, hold something that is not plain data.
    """
    parts = [t3mpc_ros.__version__, sources, plain(method)]
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Return ``value`` as JSON can hold it; long arrays by their digest.

    Raises
    ------
    TypeError
        It is not made of dataclasses, mappings, sequences, arrays, types, numbers and words:
        two equal ones might then look different, or two different ones alike.
    """
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, type):
        return f'{value.__module__}.{value.__qualname__}'
    if is_dataclass(value):
        return {item.name: plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, np.ndarray) and value.dtype != object:
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return f'array {value.dtype} {value.shape} {content}'
    raise TypeError(f'parameters of a method must be plain data: got {type(value).__name__}')


@dataclass(frozen=True, slots=True)
class RunKey:
    """Which run a line of the file is about."""

    experiment: Experiment
    seed: int
    duration: float
    fingerprint: str


class RunFile:
    """Finished runs in a file of JSON lines; a context that one set of runs has at a time.

    A line is written as a whole and flushed. Should a writer be killed within one, what is torn
    is that line alone: reading skips it, and the next writer begins on a line of its own.

    Parameters
    ----------
    path
        The file; it and its folder are made when they are needed.
    fresh
        Whether what the file holds is thrown away on first entry.

    Raises
    ------
    OSError
        On entry: the file cannot be written.
    RuntimeError
        On entry: another set of runs is writing to it.
    """

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        self.path = path
        self._fresh = fresh
        self.unreadable = 0
        """Lines of the last reading that were torn or of another kind."""
        self._stream: TextIOWrapper | None = None

    def read(self) -> dict[RunKey, RunNumbers]:
        """Return every run the file holds, of whatever version; empty when there is no file."""
        self.unreadable = 0
        found: dict[RunKey, RunNumbers] = {}
        text = ''
        with contextlib.suppress(FileNotFoundError):
            text = self.path.read_text(encoding='utf-8', errors='replace')
        for line in text.split('\n'):
            if not line.strip():
                continue
            try:
                key, numbers = _decode(line)
            except (ValueError, KeyError, TypeError):
                self.unreadable += 1
                continue
            found[key] = numbers
        return found

    def add(self, key: RunKey, numbers: RunNumbers) -> None:
        """Append a finished run."""
        if self._stream is None:
            raise RuntimeError('the file must be entered before runs are added')
        self._stream.write(_encode(key, numbers) + '\n')
        self._stream.flush()

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        stream = self.path.open('a+', encoding='utf-8', errors='replace')
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise RuntimeError(f'another campaign is writing to {self.path}') from None
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


def _encode(key: RunKey, numbers: RunNumbers) -> str:
    row = asdict(key.experiment) | {'seed': key.seed, 'duration': key.duration}
    row |= asdict(numbers) | {'fingerprint': key.fingerprint}
    return json.dumps(finite(row), ensure_ascii=False)


def _decode(line: str) -> tuple[RunKey, RunNumbers]:
    row = json.loads(line)
    experiment = Experiment(
        str(row['method']), str(row['drive']), float(row['noise']), str(row['case'])
    )
    key = RunKey(experiment, int(row['seed']), float(row['duration']), str(row['fingerprint']))
    names = ('rmse', 'settled', 'chatter', 'largest_error')
    values = [math.nan if row[name] is None else float(row[name]) for name in names]
    if not isinstance(row['finite'], bool):
        raise TypeError(f'finite must be true or false: got {row["finite"]!r}')
    rmse, settled, chatter, largest = values
    return key, RunNumbers(rmse, settled, chatter, largest, row['finite'])


Numbers = Mapping[Experiment, tuple[RunNumbers, ...]]


def run_missing(
    setup: ExperimentSetup,
    grid: ExperimentGrid,
    needed: Sequence[Experiment],
    file: RunFile,
    sources: str,
    *,
    team: Any = 1,
    report: Callable[[str], None] | None = None,
) -> Numbers:
    """Return the numbers of every needed experiment, one per seed in the grid's order.

    Runs that ``file`` holds with the same fingerprint are not run again; what is run is added to
    it at once, so that a set of runs that is stopped goes on where it was. The answer does not
    depend on what was there, nor on how many processes worked.

    Parameters
    ----------
    setup
        Where methods and runs come from.
    grid, needed
        Seeds and duration, and which cells.
    file
        Entered by this function.
    sources
        Digest of the sources, :func:`t3mpc_ros.evaluation.paper.experiment_runs.source_digest`.
    team
        Who works: how many processes, or what the setup's own ``team`` enters.
    report
        Receives messages; with None there is no progress line either.

    Raises
    ------
    RuntimeError
        The runner gave fewer runs than it was asked for, or another set of runs has the file.
    """
    methods = {drive: setup.methods(drive) for drive in grid.drives}
    prints = {
        (drive, name): fingerprint(method, sources)
        for drive, table in methods.items()
        for name, method in table.items()
    }
    # Seed by seed: cheap and dear methods stay mixed, so the estimate of the time left holds.
    keys = [
        RunKey(experiment, seed, grid.duration, prints[experiment.drive, experiment.method])
        for seed in grid.seeds
        for experiment in needed
    ]
    with file:
        known = file.read()
        found = {key: known[key] for key in keys if key in known}
        missing = [key for key in keys if key not in found]
        write = report or (lambda text: None)
        write(_resume_message(file, len(keys), len(found), len(known) - len(found)))
        jobs = [
            (
                setup.scenario(
                    drive=key.experiment.drive,
                    noise=key.experiment.noise,
                    case=key.experiment.case,
                    seed=key.seed,
                    duration=key.duration,
                ),
                methods[key.experiment.drive][key.experiment.method],
            )
            for key in missing
        ]
        try:
            with contextlib.ExitStack() as stack:
                bar = stack.enter_context(progress_bar(len(missing), show=report is not None))
                runs = setup.measure_many(jobs, measure, team) if jobs else ()
                if close := getattr(runs, 'close', None):
                    stack.callback(close)  # its processes end with this loop, however it ends
                for index, numbers in runs:
                    file.add(missing[index], numbers)
                    found[missing[index]] = numbers
                    bar.update()
        except BaseException:
            write(
                f'{len(found)} of {len(keys)} runs are kept in {file.path}: '
                'the same command goes on from there'
            )
            raise
    if len(found) != len(keys):
        raise RuntimeError(f'{len(keys) - len(found)} runs never came back')
    return {
        experiment: tuple(
            found[
                RunKey(
                    experiment, seed, grid.duration, prints[experiment.drive, experiment.method]
                )
            ]
            for seed in grid.seeds
        )
        for experiment in needed
    }


def _resume_message(file: RunFile, total: int, found: int, others: int) -> str:
    text = f'{total} runs; {found} are there already, {total - found} to do'
    if others:
        text += f'; {others} of other versions, settings or extents are left alone'
    if file.unreadable:
        text += f'; {file.unreadable} torn lines are skipped'
    return text
