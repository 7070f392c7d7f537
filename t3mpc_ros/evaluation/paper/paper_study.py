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
"""The paper's study: its runs, what is measured of each, means, paired differences and tables."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.evaluation.cases import CASES, NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean
from t3mpc_ros.evaluation.experiment import ResultTable, Row, Run
from t3mpc_ros.evaluation.loop import MethodSpec
from t3mpc_ros.evaluation.method_table import FULL, methods
from t3mpc_ros.evaluation.method_table import STAGES as METHOD_STAGES
from t3mpc_ros.evaluation.result_output import EMPTY_CELL, Table, columns_of, finite
from t3mpc_ros.evaluation.run_cache_key import digest
from t3mpc_ros.evaluation.run_record import START, Record
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, KINDS, PLANT_OF, Scenario, held_out

DRIVES = ('torque', 'velocity')
"""torque: u is applied as the torque theta_bar u, as in the paper; velocity: the wheels follow
commanded speeds with delay and lag, as on the robot."""
NOISES = (0.0, 0.01, 0.04, 0.1)
"""Noise variance of the measured wheel speeds, (rad/s)²: the paper's range."""
PAPER_NOISE = 0.04
"""The paper's own noise variance, (rad/s)²."""
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
INTENDED_CASES = {
    WITHOUT['NT3FS']: ('mass +30 %', 'friction x3'),
    WITHOUT['compensator']: ('disturbance',),
    WITHOUT['MPC']: (DEAD_TIME, 'friction x3'),
    WITHOUT['MPC, equal bound']: (DEAD_TIME, 'friction x3'),
    WITHOUT['trained predictor']: (DEAD_TIME,),
}
"""The cases beside the nominal one in which the controller runs without a part."""
DURATION = 59.5
"""Length of a run, s: four switches, and an end before the fifth, which methods with preview would
begin to cross without the run seeing what it is good for."""
SETTLING = KINDS['servo'].settling
"""Time before and after each switch that the settled RMSE leaves out, s."""
NUMBERS = ('rmse', 'settled', 'chatter', 'largest_error')
"""Numbers of a run: RMSE of both wheels with and without switches, rad/s, total variation of the
effort per second and wheel, rad/s³, and largest tracking error, rad/s."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is run."""

    seeds: tuple[int, ...] = HELD_OUT_SEEDS
    duration: float = DURATION
    """s"""
    cases: tuple[str, ...] = tuple(name for name, case in CASES.items() if case.reproduced)
    noises: tuple[float, ...] = NOISES
    """Noises of the nominal case."""
    perturbed_noises: tuple[float, ...] = (0.0, PAPER_NOISE)
    """Noises at which the stages of the controller run the other cases."""
    baseline_cases: tuple[str, ...] = ('mass +30 %', 'mass -30 %')
    """The cases beside the nominal one that baselines with preview run."""

    def __post_init__(self) -> None:
        if not self.duration >= 5.0:
            raise ValueError(f'duration must be at least 5 s, 3 do not count: got {self.duration}')


def chosen_extent(*, quick: bool = False, seeds: Sequence[int] | None = None) -> Extent:
    """Return how much is run: everything, or with ``quick`` enough to see that all works."""
    chosen = held_out(seeds or (HELD_OUT_SEEDS[:3] if quick else HELD_OUT_SEEDS))
    if not quick:
        return Extent(chosen)
    cases = (NOMINAL, 'mass +30 %', 'friction x3', 'disturbance', DEAD_TIME)
    return Extent(chosen, 26.0, cases, (0.0, PAPER_NOISE), (PAPER_NOISE,), ())


def study_runs(extent: Extent) -> list[Run]:
    """Return all runs, seed by seed, so that fast and slow methods stay mixed.

    Every baseline and every stage of the controller in the nominal case at every noise; the stages
    in every other case at ``perturbed_noises``; at the paper's noise the controller with one part
    left out in the cases that part is for, and baselines with preview in ``baseline_cases``.
    """
    made = {
        (drive, method.name): digest(method, measure)
        for drive in DRIVES
        for method in methods(drive).values()
    }
    situations = list(_situations(extent))
    found = []
    for seed in extent.seeds:
        for method, drive, noise, case in situations:
            scenario = Scenario(PLANT_OF[drive], case, seed, extent.duration, noise)
            fields = {
                'controller': method.name,
                'baseline': method.baseline,
                'preview': method.preview,
                'drive': drive,
                'noise': noise,
                'case': case,
                'seed': seed,
                'duration': extent.duration,
            }
            key = digest(scenario, made[drive, method.name])
            found.append(Run((scenario, method), fields, key))
    return found


def _situations(extent: Extent) -> Iterator[tuple[MethodSpec, str, float, str]]:
    for drive in DRIVES:
        for case in extent.cases:
            if PLANT_OF[drive] not in CASES[case].robots:
                continue
            for noise in extent.noises:
                for method in methods(drive).values():
                    if noise in _noises(extent, method, case):
                        yield method, drive, noise, case


def _noises(extent: Extent, method: MethodSpec, case: str) -> tuple[float, ...]:
    """Return the noises at which a method runs a case."""
    if method.name in WITHOUT.values():
        wanted = case == NOMINAL or case in INTENDED_CASES.get(method.name, ())
        return (PAPER_NOISE,) if wanted else ()
    if case == NOMINAL:
        return extent.noises
    if method.baseline:
        return (PAPER_NOISE,) if method.preview and case in extent.baseline_cases else ()
    return extent.perturbed_noises


def measure(record: Record) -> dict[str, object]:
    """Return :data:`NUMBERS`, NaN where a run left the finite ones; the start does not count."""
    arrays = record.reference, record.speeds, record['acceleration'], record['terms']
    if not all(bool(np.isfinite(values).all()) for values in arrays):
        return {**dict.fromkeys(NUMBERS, math.nan), 'finite': False}
    return {
        'rmse': record.rmse(START),
        'settled': record.rmse(START, margins=SETTLING),
        'chatter': record.variation(),
        'largest_error': record.largest_error(START),
        'finite': True,
    }


# -- results and tables ---------------------------------------------------------------------------


SITUATION = ('drive', 'noise', 'case')
_GROUP = ('controller', 'baseline', 'preview', *SITUATION)


class Results:
    """Means and paired differences of the runs of a study.

    ``runs`` has one row a run: what it is, see :func:`.study_runs`, and its :data:`.NUMBERS`;
    ``means`` one for each method and situation: means over the seeds with half their 95 %
    intervals, the largest error of all seeds, and whether every number is finite; NaN where a run
    diverged. ``added`` and ``lost`` are what RMSE each stage adds to the one before, and each part
    left out to the full controller: mean with half its 95 % interval of ``first`` less ``second``
    on the same seeds.
    """

    def __init__(self, runs: ResultTable) -> None:
        self.runs = runs
        self.means = ResultTable([_mean_row(rows) for rows in runs.groups(*_GROUP).values()])
        self.drives = self.means.unique('drive')
        self.noises = sorted(self.means.unique('noise'))
        self.added = self._differences(list(zip(STAGES[1:], STAGES[:-1], strict=True)))
        self.lost = self._differences([(each, STAGES[-1]) for each in WITHOUT.values()])

    def row(self, controller: str, drive: str, noise: float, case: str = NOMINAL) -> Row | None:
        """Return a row of the means, None when it was not measured."""
        rows = self.means.where(controller=controller, drive=drive, noise=noise, case=case)
        return rows[0] if rows else None

    def cases(self, drive: str) -> tuple[str, ...]:
        """The cases of the runs with a drive."""
        return self.means.unique('case', drive=drive)

    def methods(self, drive: str) -> list[Row]:
        """Return the nominal rows at the paper's noise, where every method runs."""
        return self.means.where(drive=drive, noise=PAPER_NOISE, case=NOMINAL)

    def compared(self, drive: str) -> list[Row]:
        """Return those of the baselines and of the full controller."""
        rows = self.methods(drive)
        return [row for row in rows if row['baseline'] or row['controller'] == FULL]

    def _differences(self, pairs: Sequence[tuple[str, str]]) -> ResultTable:
        found = []
        for values in self.means.groups(*SITUATION):
            situation = dict(zip(SITUATION, values, strict=True))
            for first, second in pairs:
                sides = ({'controller': name, **situation} for name in (first, second))
                apart = self.runs.difference('rmse', *sides)
                if apart is not None:
                    row = {'first': first, 'second': second, **situation}
                    row |= {'difference': apart.mean, 'ci95': apart.half}
                    seeds = len(self.runs.where(controller=first, **situation))
                    found.append(row | {'seeds': seeds})
        return ResultTable(found)


def _mean_row(runs: Sequence[Row]) -> Row:
    rows = columns_of(runs)
    finite = all(rows['finite'])
    return {name: runs[0][name] for name in _GROUP} | {
        'rmse_mean': mean(rows['rmse']),
        'rmse_ci95': interval(rows['rmse']),
        'settled_mean': mean(rows['settled']),
        'settled_ci95': interval(rows['settled']),
        'chatter_mean': mean(rows['chatter']),
        'largest_error': max(rows['largest_error']) if finite else math.nan,
        'finite': finite,
        'seeds': len(runs),
        'duration': runs[0]['duration'],
    }


def label(row: Row) -> str:
    """Return the name of a method, with a mark if it is a baseline with preview."""
    name = str(row['controller'])
    marked = row['baseline'] and row['preview'] and 'preview' not in name
    return f'{name} (preview)' if marked else name


def csv_columns(rows: Sequence[Row]) -> dict[str, list[object]]:
    """Return the columns of the CSV file, by the keys of the JSON; empty if not finite."""
    return {
        name: [str(each).lower() if isinstance(each, bool) else finite(each) for each in values]
        for name, values in columns_of(rows).items()
    }


def comparison(results: Results, drive: str, *, settled: bool = False) -> Table:
    """Return every method's RMSE against noise, the paper's Table 3: best at its noise on top.

    ``settled`` leaves out the second about each switch.
    """
    noises = results.noises
    name = 'settled' if settled else 'rmse'
    what = 'RMSE settled, without 1 s about each switch' if settled else 'RMSE'
    head = ('method', *_heads(noises), f'growth from {noises[0]:g} to {noises[-1]:g}')
    lines = []
    for method in sorted(results.methods(drive), key=lambda row: rank(row[f'{name}_mean'])):
        rows = [results.row(method['controller'], drive, noise) for noise in noises]
        first, last = rows[0], rows[-1]
        growth = EMPTY_CELL
        if first is not None and last is not None:
            growth = _growth(first[f'{name}_mean'], last[f'{name}_mean'])
        lines.append((label(method), *(_cell(row, name) for row in rows), growth))
    title = f'{what} (rad/s), {drive} drive, nominal robot'
    return Table(title, head, lines, (FULL,))


def chatter(results: Results, drive: str) -> Table:
    """Return every method's total variation of the effort against noise."""
    rows = [
        (name, *(_chatter(results.row(name, drive, noise)) for noise in results.noises))
        for name in (method['controller'] for method in results.methods(drive))
    ]
    title = f'Total variation of what is asked per second (rad/s³), {drive} drive, nominal robot'
    return Table(title, ('method', *_heads(results.noises)), rows, (FULL,))


def cases(results: Results, drive: str, noise: float, *, baselines: bool) -> Table | None:
    """Return RMSE by case: of the baselines and the full controller, or of its stages.

    None when nothing beside the nominal case was measured at this noise.
    """
    what, column = 'The controller as it grows, and less one part', 'stage'
    names = [*STAGES, *WITHOUT.values()]
    if baselines:
        what, column = 'Methods in every case', 'method'
        names = [row['controller'] for row in results.compared(drive)]
    found: dict[str, dict[str, Row]] = {name: {} for name in names}
    for row in results.means.where(drive=drive, noise=noise):
        if row['controller'] in found:
            found[row['controller']][row['case']] = row
    shown = [case for case in results.cases(drive) if any(case in rows for rows in found.values())]
    if set(shown) <= {NOMINAL}:
        return None
    lines = [
        (name, *(_cell(rows.get(case)) for case in shown)) for name, rows in found.items() if rows
    ]
    title = f'{what}: RMSE (rad/s), {drive} drive, noise {noise:g}'
    return Table(title, (column, *shown), lines, (FULL,))


def differences(
    results: Results, pairs: ResultTable, drive: str, noise: float, title: str
) -> Table | None:
    """Return paired differences by case; with an asterisk where the interval excludes zero."""
    by = {
        (pair['first'], pair['second'], pair['case']): _starred(pair['difference'], pair['ci95'])
        for pair in pairs.where(drive=drive, noise=noise)
    }
    shown = [case for case in results.cases(drive) if any(key[2] == case for key in by)]
    rows = [
        (f'{first} less {second}', *(by.get((first, second, case), EMPTY_CELL) for case in shown))
        for first, second in dict.fromkeys(key[:2] for key in by)
    ]
    if not rows:
        return None
    text = f'{title}: paired difference of RMSE (rad/s), {drive} drive, noise {noise:g}'
    return Table(text, ('', *shown), rows)


def estimation(results: ResultTable) -> list[Table]:
    """Return the comparison of (86): RMSE of chi_hat, its excess over type 3, RMSE of g."""
    kinds, noises = results.unique('kind'), results.unique('noise_variance')
    if not kinds:
        return []

    def by_noise(title: str, column: str) -> Table:
        rows = []
        for kind in kinds:
            samples = [results.values(column, kind=kind, noise_variance=each) for each in noises]
            cells = [format_interval(mean(each), interval(each), digits=4) for each in samples]
            rows.append((kind, *cells, _growth(mean(samples[0]), mean(samples[-1]))))
        return Table(title, ('kind', *_heads(noises), 'growth'), rows, ('type3',))

    more = []
    for kind in (each for each in kinds if each != 'type3'):
        sides = [
            [{'kind': each, 'noise_variance': noise} for each in (kind, 'type3')]
            for noise in noises
        ]
        apart = [results.difference('speed', *each) for each in sides]
        more.append((kind, *(_starred(*each) for each in apart if each)))
    title = 'The same, more than type3 with the same seeds (rad/s)'
    return [
        by_noise('Estimation without a controller (86): RMSE of the speed (rad/s)', 'speed'),
        Table(title, ('kind', *_heads(noises)), more),
        by_noise('RMSE of g against what it should be (rad/s²)', 'unknown'),
    ]


def all_tables(results: Results, estimated: ResultTable) -> dict[str, list[Table]]:
    """Return all tables by their heading."""
    methods: list[Table | None] = []
    perturbed: list[Table | None] = []
    parts: list[Table | None] = []
    for drive in results.drives:
        methods += [comparison(results, drive), comparison(results, drive, settled=True)]
        perturbed.append(cases(results, drive, PAPER_NOISE, baselines=True))
        for noise in results.noises:
            parts += [
                cases(results, drive, noise, baselines=False),
                differences(results, results.added, drive, noise, 'Adding a part'),
                differences(results, results.lost, drive, noise, 'Leaving a part out'),
            ]
    found: dict[str, Sequence[Table | None]] = {
        'Methods against noise (Table 3)': methods,
        'Methods in every case': perturbed,
        'What each part is worth': parts,
        'Total variation of the control': [chatter(results, drive) for drive in results.drives],
        'Estimation without a controller': estimation(estimated),
    }
    return {heading: [t for t in tables if t is not None] for heading, tables in found.items()}


def _heads(noises: Iterable[float]) -> list[str]:
    return [f'noise {noise:g}' for noise in noises]


def rank(value: float) -> float:
    """Return what puts a mean that diverged last."""
    return math.inf if math.isnan(value) else value


def _cell(row: Row | None, name: str = 'rmse') -> str:
    if row is None:
        return EMPTY_CELL
    return format_interval(row[f'{name}_mean'], row[f'{name}_ci95'])


def _chatter(row: Row | None) -> str:
    if row is None:
        return EMPTY_CELL
    return f'{row["chatter_mean"]:.0f}' if math.isfinite(row['chatter_mean']) else 'diverged'


def _starred(mean: float, ci95: float) -> str:
    return format_interval(mean, ci95, '+', 4) + (' *' if abs(mean) > ci95 else '')


def _growth(first: float, last: float) -> str:
    if not (math.isfinite(first) and math.isfinite(last)) or first <= 0.0:
        return EMPTY_CELL
    return f'{last - first:+.3f} ({100.0 * (last / first - 1.0):+.0f} %)'
