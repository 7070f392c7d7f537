# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Experiments of the paper: which are needed, and the finished runs in a JSON lines file."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, fields, is_dataclass
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.methods import FULL, ComparedMethod
from t3mpc_ros.evaluation.methods import STAGES as METHOD_STAGES
from t3mpc_ros.evaluation.metrics import START
from t3mpc_ros.evaluation.record import Record
from t3mpc_ros.evaluation.reporting import finite
from t3mpc_ros.evaluation.result_file import ResultFile, run_missing_jobs
from t3mpc_ros.evaluation.scenario import KINDS
from t3mpc_ros.parameters.provenance import PACKAGE_DIRECTORY
from t3mpc_ros.version import VERSION

DRIVES = ('torque', 'velocity')
"""torque: u is applied as the torque theta_bar u, as in the paper; velocity: the wheels follow
commanded speeds with delay and lag, as on the robot."""
NOISES = (0.0, 0.01, 0.04, 0.1)
"""Noise variance of the measured wheel speeds, (rad/s)²: the paper's range."""
PAPER_NOISE = 0.04
"""The paper's own noise variance, (rad/s)²."""
NOMINAL = 'nominal'
EXACT = 'exact model'
"""In the name of a baseline whose model has the nominal inertia; the models of all other baselines
with preview believe in one that is 30 % off."""
DEAD_TIME = 'dead time'
"""The case that only the velocity drive has."""
STAGES = tuple(METHOD_STAGES)
"""The controller as it grows; the last step, to :data:`FULL`, adds preview."""
PARTS = ('NT3FS', 'compensator', 'MPC', 'preview')
"""Part that each stage adds."""
WITHOUT = {
    'NT3FS': 'full without NT3FS',
    'compensator': 'full without compensator',
    'MPC': 'full without MPC',
    'MPC, equal bound': 'full without MPC, equal bound',
    'preview': 'full without preview',
    'trained predictor': 'full with random predictor',
}
"""The full controller with one part left out, by that part."""

Jobs = Sequence[tuple[Any, Any]]


@dataclass(frozen=True, slots=True)
class ExperimentSetup:
    """Where methods and runs come from."""

    methods: Callable[[str], Mapping[str, ComparedMethod]]
    """The methods of a drive by name."""
    scenario: Callable[..., Any]
    """Called with drive, noise, case, seed and duration, by name; what
    ``measure_many`` takes."""
    measure_many: Callable[[Jobs, Callable[[Any], Any], Any], Iterable[tuple[int, Any]]]
    """Called with (scenario, method) pairs, what to make of the record of each run, and the team
    that works; yields (index, what was made) in any order."""
    cases: tuple[str, ...]
    """Every case there is, :data:`NOMINAL` first."""
    seeds: tuple[int, ...]
    """Held-out seeds, none of which has tuned anything."""
    team: Callable[[int | Executor], AbstractContextManager[Any]] = nullcontext
    """Called with how many processes, or an executor; what it enters is the team. By default the
    argument itself."""


DURATION = 59.5
"""Length of a run, s: four switches, and an end before the fifth, which methods with preview would
begin to cross without the run seeing what it is good for."""
BASELINE_CASES = ('mass +30 %', 'mass -30 %')
INTENDED_CASES = {
    WITHOUT['NT3FS']: ('mass +30 %', 'friction x3'),
    WITHOUT['compensator']: ('disturbance',),
    WITHOUT['MPC']: (DEAD_TIME, 'friction x3'),
    WITHOUT['MPC, equal bound']: (DEAD_TIME, 'friction x3'),
    WITHOUT['trained predictor']: (DEAD_TIME,),
}
"""The cases beside the nominal one in which the controller runs without a part."""


@dataclass(frozen=True, slots=True)
class ExperimentGrid:
    """How much is run."""

    seeds: tuple[int, ...]
    duration: float
    """s"""
    cases: tuple[str, ...]
    noises: tuple[float, ...] = NOISES
    perturbed_noises: tuple[float, ...] = NOISES
    """Noises at which the stages of the controller run the cases beside the nominal one."""
    missing_noises: tuple[float, ...] = (PAPER_NOISE,)
    """The same of the controller with one part left out."""
    baseline_noises: tuple[float, ...] = (PAPER_NOISE,)
    """The same of the baselines."""
    baseline_cases: tuple[str, ...] = BASELINE_CASES
    """The cases beside the nominal one that baselines with preview run."""
    drives: tuple[str, ...] = DRIVES

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f'seeds must be one or more, each once: got {self.seeds}')
        if not self.duration >= 5.0:
            raise ValueError(f'duration must be at least 5 s, 3 do not count: got {self.duration}')
        if NOMINAL not in self.cases:
            raise ValueError(f'cases must hold {NOMINAL}: got {self.cases}')


@dataclass(frozen=True, slots=True)
class Experiment:
    """One method in one situation: a row of the results."""

    method: str
    drive: str
    noise: float
    case: str


QUICK_CASES = (NOMINAL, 'mass +30 %', 'friction x3', 'disturbance', DEAD_TIME)


def make_grid(
    setup: ExperimentSetup, *, quick: bool = False, seeds: int | None = None
) -> ExperimentGrid:
    """Return how much is run: everything, or with ``quick`` enough to see that all works."""
    count = (3 if quick else len(setup.seeds)) if seeds is None else seeds
    if not 1 <= count <= len(setup.seeds):
        raise ValueError(f'seeds must be from 1 to {len(setup.seeds)}: got {count}')
    if not quick:
        return ExperimentGrid(
            setup.seeds[:count], DURATION, setup.cases, perturbed_noises=(0.0, PAPER_NOISE)
        )
    cases = tuple(case for case in QUICK_CASES if case in setup.cases)
    return ExperimentGrid(
        setup.seeds[:count], 26.0, cases, (0.0, PAPER_NOISE), (PAPER_NOISE,), (PAPER_NOISE,), ()
    )


def needed_experiments(setup: ExperimentSetup, grid: ExperimentGrid) -> tuple[Experiment, ...]:
    """Return all needed experiments without duplicates, by drive, case, noise and method.

    Every baseline and every stage of the controller in the nominal case at every noise; the stages
    in every other case at ``perturbed_noises``; the controller with one part left out in the
    cases that part is for, at ``missing_noises``; baselines with preview in ``baseline_cases``
    at ``baseline_noises``.
    """
    found = []
    for drive in grid.drives:
        methods = setup.methods(drive)
        if FULL not in methods or any(name != method.name for name, method in methods.items()):
            names = ', '.join(methods)
            raise ValueError(f'methods of {drive} must hold {FULL}, by their names: got {names}')
        if wrong := [name for name in (*STAGES, *WITHOUT.values()) if _is_baseline(methods, name)]:
            raise ValueError(
                f'stages of the controller must not be baselines: got {", ".join(wrong)}'
            )
        for case in grid.cases:
            if case == DEAD_TIME and drive != 'velocity':
                continue
            for noise in grid.noises:
                for name, method in methods.items():
                    if noise in _noises(grid, method, case):
                        found.append(Experiment(name, drive, noise, case))
    return tuple(found)


def _noises(grid: ExperimentGrid, method: ComparedMethod, case: str) -> tuple[float, ...]:
    """Return the noises at which a method runs a case."""
    if method.name in WITHOUT.values():
        wanted = case == NOMINAL or case in INTENDED_CASES.get(method.name, ())
        return grid.missing_noises if wanted else ()
    if case == NOMINAL:
        return grid.noises
    if method.baseline:
        return grid.baseline_noises if method.preview and case in grid.baseline_cases else ()
    return grid.perturbed_noises


def _is_baseline(methods: Mapping[str, ComparedMethod], name: str) -> bool:
    return name in methods and methods[name].baseline


SETTLING = KINDS['servo'].settling
"""Time before and after each switch that the settled RMSE leaves out, s."""

# Sources that cannot change the result of a run with given method parameters. All others
# invalidate stored runs: a needless repetition is better than an outdated result.
_IRRELEVANT_SOURCES = (
    'nodes/', 'bag/', 'radio/', 'emulator/', 'cli/', 'scripting/', 'evaluation/bag_report/',
    'evaluation/result_file.py',
    'evaluation/process_replay/', 'evaluation/paper/', 'evaluation/tuning/',
    'evaluation/comparison_page.py', 'evaluation/experiment.py', 'evaluation/fault_study.py',
    'evaluation/fault_page.py', 'evaluation/patrol/', 'evaluation/baselines/feed_forward.py',
    'evaluation/plotting.py', 'evaluation/reporting.py', 'evaluation/lyapunov_exponents.py',
    'evaluation/open_loop_estimation.py', 'evaluation/methods.py', 'evaluation/topic_roles.py',
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


def measure(run: Record) -> RunNumbers:
    """Return the metrics of a run; the first :data:`START` seconds do not count."""
    arrays = run.reference, run.speeds, run['acceleration'], run['terms']
    if not all(bool(np.isfinite(values).all()) for values in arrays):
        return RunNumbers(math.nan, math.nan, math.nan, math.nan, False)
    settled = run.rmse(START, margins=SETTLING)
    return RunNumbers(run.rmse(START), settled, run.variation(), run.largest_error(START), True)


def source_digest(package: Path = PACKAGE_DIRECTORY, *, every: bool = False) -> str:
    """Return a digest of every source file that can change the result of a run of the paper.

    It covers the Python and array files of the package except those that only display, record or
    select, and includes this file, which measures. Tuned values are part of the method's
    parameters. With ``every`` it covers all of them, and worlds, schedules and tuned values: what
    a run on the twin or of a script is made of.
    """
    suffixes = ('.py', '.npy', '.npz', *(('.yaml', '.json', '.csv') if every else ()))
    digest = hashlib.sha256()
    for path in sorted(package.rglob('*')):
        name = path.relative_to(package).as_posix()
        kept = every or name == 'evaluation/paper/experiment_runs.py'
        kept = kept or not name.startswith(_IRRELEVANT_SOURCES)
        if kept and path.suffix in suffixes:
            digest.update(name.encode() + b'\0' + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def fingerprint(method: ComparedMethod, sources: str) -> str:
    """Return a digest of version, sources and method: what the result of a scenario needs."""
    parts = [VERSION, sources, plain(method)]
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Return ``value`` as JSON can hold it; long arrays by their digest.

    What is no plain data is refused: two equal values might then look different, or two different
    ones alike.
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


class RunFile(ResultFile[RunKey, RunNumbers]):
    """Finished runs of the paper, see :class:`ResultFile`."""

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        super().__init__(path, _encode, _decode, fresh=fresh)


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
    sources
        Digest of the sources, :func:`source_digest`.
    team
        Who works: how many processes, or what the setup's own ``team`` enters.
    report
        Receives messages; with None there is no progress line either.
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
    jobs = {
        key: (
            setup.scenario(
                drive=key.experiment.drive,
                noise=key.experiment.noise,
                case=key.experiment.case,
                seed=key.seed,
                duration=key.duration,
            ),
            methods[key.experiment.drive][key.experiment.method],
        )
        for key in keys
    }
    found = run_missing_jobs(
        file, jobs, lambda missing: setup.measure_many(missing, measure, team), report
    )
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
