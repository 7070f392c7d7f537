# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Results by method and experiment: means with confidence intervals, JSON and CSV."""

from collections.abc import Iterable, Mapping, Sequence
import csv
from dataclasses import asdict, dataclass, fields
import math
from pathlib import Path

from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.paper.experiment_grid import (
    DURATION,
    NOMINAL,
    PARTS,
    STAGES,
    WITHOUT,
    Experiment,
    ExperimentGrid,
    ExperimentSetup,
)
from t3mpc_ros.evaluation.paper.experiment_runs import RunNumbers


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
    duration
        s of each run.
    complete
        Whether these are all seeds, with the whole duration.
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
    """Return the table of results of a set of runs, the methods in the order of the setup.

    Raises
    ------
    ValueError
        A method is a baseline, or has preview, with one drive and not with the other.
    """
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
    """Write the rows with the names of the JSON's keys on top; empty for what is not finite.

    Raises
    ------
    OSError
        The file cannot be written.
    """
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
