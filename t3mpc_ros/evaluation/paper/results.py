# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Results by method and experiment: means with intervals, JSON, CSV, and their tables."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import csv
from dataclasses import asdict, dataclass, fields
import math
from pathlib import Path

from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.methods import FULL
from t3mpc_ros.evaluation.open_loop_estimation import EstimationResult, difference
from t3mpc_ros.evaluation.paper.experiment_runs import (
    DURATION,
    NOMINAL,
    PAPER_NOISE,
    PARTS,
    STAGES,
    WITHOUT,
    Experiment,
    ExperimentGrid,
    ExperimentSetup,
    RunNumbers,
)
from t3mpc_ros.evaluation.reporting import EMPTY_CELL, Table, format_interval


@dataclass(frozen=True, slots=True)
class ResultRow:
    """Result of one method in one situation; NaN where a run diverged."""

    controller: str
    baseline: bool
    preview: bool
    drive: str
    noise: float
    """Variance of the measured wheel speeds, (rad/s)²."""
    case: str
    rmse_mean: float
    """Tracking RMSE, mean over the seeds, rad/s."""
    rmse_ci95: float
    """Half the 95 % interval of that mean; infinite for a single seed."""
    settled_mean: float
    """The same without the second about each switch."""
    settled_ci95: float
    chatter_mean: float
    """Total variation of the effort per second and wheel, rad/s³."""
    largest_error: float
    """rad/s, over all seeds."""
    finite: bool
    """Whether every number of every run is finite."""
    seeds: int
    """How many."""
    duration: float
    """s of each run."""

    @property
    def experiment(self) -> Experiment:
        """Method and situation."""
        return Experiment(self.controller, self.drive, self.noise, self.case)

    def record(self) -> dict[str, object]:
        """Return the row as plain data."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """How much more RMSE one method has than another with the same seeds, rad/s."""

    first: str
    second: str
    drive: str
    noise: float
    case: str
    difference: float
    """Mean of first minus second; negative if the first is better."""
    ci95: float
    """Half the 95 % interval of that mean (Student's t); infinite for a single seed."""
    seeds: int

    @property
    def below(self) -> bool:
        """Whether the whole interval is below zero: the first is better."""
        return self.difference + self.ci95 < 0.0

    def record(self) -> dict[str, object]:
        """Return the comparison as plain data."""
        return asdict(self)


class Results:
    """Every number of a set of runs, by experiment.

    Parameters
    ----------
    kinds
        Of each method: whether it is a baseline, and whether it has preview; in the tables' order.
    numbers
        One entry per seed, in the same order of seeds in all cells.
    duration, complete
        s of each run, and whether these are all seeds with the whole duration.
    """

    def __init__(
        self,
        kinds: Mapping[str, tuple[bool, bool]],
        numbers: Mapping[Experiment, Sequence[RunNumbers]],
        duration: float,
        *,
        complete: bool = True,
    ) -> None:
        self.kinds = dict(kinds)
        self.duration = duration
        self.complete = complete
        self._numbers = {experiment: tuple(runs) for experiment, runs in numbers.items()}
        self._rows = {
            experiment: self._row(experiment, runs) for experiment, runs in self._numbers.items()
        }

    @property
    def rows(self) -> tuple[ResultRow, ...]:
        """Every row, in the order of the plan."""
        return tuple(self._rows.values())

    def row(
        self, controller: str, drive: str, noise: float, case: str = NOMINAL
    ) -> ResultRow | None:
        """Return a row, None when it was not measured."""
        return self._rows.get(Experiment(controller, drive, noise, case))

    def runs(self, experiment: Experiment) -> tuple[RunNumbers, ...]:
        """Return the runs of an experiment, one per seed, in the same order in all of them."""
        return self._numbers[experiment]

    def rows_of(
        self,
        drive: str,
        noise: float,
        case: str = NOMINAL,
        *,
        baseline: bool | None = None,
        preview: bool | None = None,
    ) -> list[ResultRow]:
        """Return the rows of all methods in one situation, those of a kind if one is given."""
        return [
            row
            for name in self.kinds
            if (row := self.row(name, drive, noise, case)) is not None
            and baseline in (None, row.baseline)
            and preview in (None, row.preview)
        ]

    def paired(
        self, first: str, second: str, drive: str, noise: float, case: str = NOMINAL
    ) -> PairedDifference | None:
        """Return how much more RMSE ``first`` has than ``second``, None when not measured."""
        one = self._numbers.get(Experiment(first, drive, noise, case))
        other = self._numbers.get(Experiment(second, drive, noise, case))
        if one is None or other is None:
            return None
        more = [a.rmse - b.rmse for a, b in zip(one, other, strict=True)]
        return PairedDifference(
            first, second, drive, noise, case, mean(more), interval(more), len(more)
        )

    @property
    def drives(self) -> tuple[str, ...]:
        """The drives there are rows of."""
        return tuple(dict.fromkeys(experiment.drive for experiment in self._rows))

    @property
    def noises(self) -> tuple[float, ...]:
        """The noises there are rows of, ascending."""
        return tuple(sorted({experiment.noise for experiment in self._rows}))

    def cases(self, drive: str) -> tuple[str, ...]:
        """The cases there are rows of."""
        return tuple(dict.fromkeys(c.case for c in self._rows if c.drive == drive))

    def stage_differences(self) -> list[PairedDifference]:
        """Return the effect of adding each part, stage by stage, where measured."""
        pairs = zip(STAGES[1:], STAGES[:-1], strict=True)
        return self._everywhere(list(pairs))

    def losses(self) -> list[PairedDifference]:
        """Return the cost of leaving each part out of the full controller, where measured."""
        return self._everywhere([(without, STAGES[-1]) for without in WITHOUT.values()])

    def _everywhere(self, pairs: Sequence[tuple[str, str]]) -> list[PairedDifference]:
        situations = dict.fromkeys((c.drive, c.noise, c.case) for c in self._rows)
        found = (
            self.paired(first, second, drive, noise, case)
            for drive, noise, case in situations
            for first, second in pairs
        )
        return [paired for paired in found if paired is not None]

    def _row(self, experiment: Experiment, runs: Sequence[RunNumbers]) -> ResultRow:
        baseline, preview = self.kinds[experiment.method]
        rmse, settled = [run.rmse for run in runs], [run.settled for run in runs]
        finite = all(run.finite for run in runs)
        return ResultRow(
            controller=experiment.method,
            baseline=baseline,
            preview=preview,
            drive=experiment.drive,
            noise=experiment.noise,
            case=experiment.case,
            rmse_mean=mean(rmse),
            rmse_ci95=interval(rmse),
            settled_mean=mean(settled),
            settled_ci95=interval(settled),
            chatter_mean=mean([run.chatter for run in runs]),
            largest_error=max(run.largest_error for run in runs) if finite else math.nan,
            finite=finite,
            seeds=len(runs),
            duration=self.duration,
        )


def results_of(
    setup: ExperimentSetup,
    grid: ExperimentGrid,
    numbers: Mapping[Experiment, Sequence[RunNumbers]],
) -> Results:
    """Return the table of results of a set of runs, the methods in the order of the setup."""
    kinds: dict[str, tuple[bool, bool]] = {}
    for drive in grid.drives:
        for name, method in setup.methods(drive).items():
            kind = (bool(method.baseline), bool(method.preview))
            if kinds.setdefault(name, kind) != kind:
                raise ValueError(f'{name} must be of the same kind with every drive')
    complete = grid.seeds == tuple(setup.seeds) and grid.duration >= DURATION
    return Results(kinds, numbers, grid.duration, complete=complete)


def step_to(part: str) -> tuple[str, str]:
    """Return the stages (with, without) a part that :data:`PARTS` names."""
    index = PARTS.index(part)
    return STAGES[index + 1], STAGES[index]


def write_csv(path: Path, rows: Iterable[ResultRow]) -> None:
    """Write the rows with the names of the JSON's keys on top; empty for what is not finite."""
    with path.open('w', newline='', encoding='utf-8') as stream:
        writer = csv.DictWriter(
            stream, [item.name for item in fields(ResultRow)], lineterminator='\n'
        )
        writer.writeheader()
        for row in rows:
            writer.writerow({name: _csv_cell(value) for name, value in row.record().items()})


def _csv_cell(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value).lower() if isinstance(value, bool) else value


def comparison(results: Results, drive: str, *, settled: bool = False) -> Table:
    """Return every method's RMSE against noise, the paper's Table 3: best at its noise on top.

    ``settled`` leaves out the second about each switch.
    """
    noises = results.noises
    known = [n for n in results.kinds if any(results.row(n, drive, v) for v in noises)]
    what = 'RMSE settled, without 1 s about each switch' if settled else 'RMSE'
    head = ['method', *(f'noise {noise:g}' for noise in noises)]
    head.append(f'growth from {noises[0]:g} to {noises[-1]:g}')

    def value(row: ResultRow) -> tuple[float, float]:
        return (row.settled_mean, row.settled_ci95) if settled else (row.rmse_mean, row.rmse_ci95)

    def rank(name: str) -> float:
        row = results.row(name, drive, PAPER_NOISE)
        found = math.inf if row is None else value(row)[0]
        return math.inf if math.isnan(found) else found

    lines = []
    for name in sorted(known, key=rank):
        rows = [results.row(name, drive, noise) for noise in noises]
        cells = [EMPTY_CELL if row is None else format_interval(*value(row)) for row in rows]
        first, last = rows[0], rows[-1]
        growth = EMPTY_CELL
        if first is not None and last is not None:
            growth = _growth(value(first)[0], value(last)[0])
        labelled = all(results.kinds[name]) and 'preview' not in name
        mark = ' (preview)' if labelled else ''
        lines.append((name + mark, *cells, growth))
    title = f'{what} (rad/s), {drive} drive, nominal robot'
    return Table(title, tuple(head), tuple(lines), (FULL,))


def chatter(results: Results, drive: str) -> Table:
    """Return every method's total variation of the effort against noise."""
    rows = []
    for name in results.kinds:
        found = [results.row(name, drive, noise) for noise in results.noises]
        if any(found):
            rows.append((name, *(_number(row, lambda r: r.chatter_mean, 0) for row in found)))
    head = ('method', *(f'noise {noise:g}' for noise in results.noises))
    title = f'Total variation of what is asked per second (rad/s³), {drive} drive, nominal robot'
    return Table(title, head, tuple(rows), (FULL,))


def cases(results: Results, drive: str, noise: float, *, baselines: bool) -> Table | None:
    """Return RMSE by case: of the baselines and the full controller, or of its stages.

    None when nothing beside the nominal case was measured at this noise.
    """
    if baselines:
        names = [n for n, (baseline, _) in results.kinds.items() if baseline or n == FULL]
    else:
        names = [*STAGES, *WITHOUT.values()]
    shown = [
        case
        for case in results.cases(drive)
        if any(results.row(name, drive, noise, case) for name in names)
    ]
    if set(shown) <= {NOMINAL}:
        return None
    rows = []
    for name in names:
        found = [results.row(name, drive, noise, case) for case in shown]
        if any(found):
            rows.append((name, *(_rmse(row) for row in found)))
    what = (
        'Methods in every case' if baselines else 'The controller as it grows, and less one part'
    )
    title = f'{what}: RMSE (rad/s), {drive} drive, noise {noise:g}'
    return Table(title, (('method' if baselines else 'stage'), *shown), tuple(rows), (FULL,))


def differences(
    results: Results, pairs: Sequence[PairedDifference], drive: str, noise: float, title: str
) -> Table | None:
    """Return paired differences by case; with an asterisk where the interval excludes zero."""
    here = [pair for pair in pairs if (pair.drive, pair.noise) == (drive, noise)]
    by = {(pair.first, pair.second, pair.case): pair for pair in here}
    shown = [case for case in results.cases(drive) if any(key[2] == case for key in by)]
    rows = [
        (f'{first} less {second}', *(_paired(by.get((first, second, case))) for case in shown))
        for first, second in dict.fromkeys((pair.first, pair.second) for pair in here)
    ]
    if not rows:
        return None
    text = f'{title}: paired difference of RMSE (rad/s), {drive} drive, noise {noise:g}'
    return Table(text, ('', *shown), tuple(rows))


def estimation(results: Sequence[EstimationResult]) -> list[Table]:
    """Return the comparison of (86): RMSE of chi_hat, its excess over type 3, RMSE of g."""
    by = {(result.kind, result.noise_variance): result for result in results}
    kinds = list(dict.fromkeys(result.kind for result in results))
    noises = list(dict.fromkeys(result.noise_variance for result in results))
    if not kinds:
        return []
    head = tuple(f'noise {noise:g}' for noise in noises)

    def by_noise(title: str, key: str) -> Table:
        rows = []
        for kind in kinds:
            records = [by[kind, noise].record() for noise in noises]
            means = [float(str(record[f'{key}_mean'])) for record in records]
            cis = [float(str(record[f'{key}_ci95'])) for record in records]
            cells = [format_interval(m, c, digits=4) for m, c in zip(means, cis, strict=True)]
            rows.append((kind, *cells, _growth(means[0], means[-1])))
        return Table(title, ('kind', *head, 'growth'), tuple(rows), ('type3',))

    more = []
    for kind in kinds:
        if kind != 'type3':
            pairs = [(by[kind, noise], by['type3', noise]) for noise in noises]
            found = [_of_sample(difference(*pair)) for pair in pairs]
            more.append((kind, *(_starred(*item) for item in found)))
    return [
        by_noise('Estimation without a controller (86): RMSE of the speed (rad/s)', 'speed'),
        Table('The same, more than type3 with the same seeds (rad/s)', ('kind', *head), (*more,)),
        by_noise('RMSE of g against what it should be (rad/s²)', 'unknown'),
    ]


def all_tables(results: Results, estimated: Sequence[EstimationResult]) -> dict[str, list[Table]]:
    """Return all tables by their heading."""
    stages, losses = results.stage_differences(), results.losses()
    found: dict[str, list[Table | None]] = {
        'Methods against noise (Table 3)': [],
        'Methods in every case': [],
        'What each part is worth': [],
        'Total variation of the control': [],
        'Estimation without a controller': [*estimation(estimated)],
    }
    methods, perturbed, parts, varied, _ = found.values()
    for drive in results.drives:
        methods += [comparison(results, drive), comparison(results, drive, settled=True)]
        varied.append(chatter(results, drive))
        perturbed += [cases(results, drive, noise, baselines=True) for noise in (PAPER_NOISE,)]
        for noise in results.noises:
            parts += [
                cases(results, drive, noise, baselines=False),
                differences(results, stages, drive, noise, 'Adding a part'),
                differences(results, losses, drive, noise, 'Leaving a part out'),
            ]
    return {heading: [t for t in tables if t is not None] for heading, tables in found.items()}


def _number(row: ResultRow | None, value: Callable[[ResultRow], float], digits: int) -> str:
    if row is None:
        return EMPTY_CELL
    number = value(row)
    return f'{number:.{digits}f}' if math.isfinite(number) else 'diverged'


def _rmse(row: ResultRow | None) -> str:
    return EMPTY_CELL if row is None else format_interval(row.rmse_mean, row.rmse_ci95)


def _paired(pair: PairedDifference | None) -> str:
    return EMPTY_CELL if pair is None else _starred(pair.difference, pair.ci95)


def _starred(mean: float, ci95: float) -> str:
    return format_interval(mean, ci95, '+', 4) + (' *' if abs(mean) > ci95 else '')


def _of_sample(values: Sequence[float]) -> tuple[float, float]:
    return mean(values), interval(values)


def _growth(first: float, last: float) -> str:
    if not (math.isfinite(first) and math.isfinite(last)) or first <= 0.0:
        return EMPTY_CELL
    return f'{last - first:+.3f} ({100.0 * (last / first - 1.0):+.0f} %)'
