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
"""Reproduction of the paper: runs experiments, writes results, tables, figures and the page."""

from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from pathlib import Path

from t3mpc_ros.evaluation import open_loop_estimation
from t3mpc_ros.evaluation.experiment import Report, ResultTable, measured_run, run_experiment
from t3mpc_ros.evaluation.methods import EXACT_MODEL, methods
from t3mpc_ros.evaluation.paper.claims import all_claims, markdown
from t3mpc_ros.evaluation.paper.figure_runs import simulate_figure_runs
from t3mpc_ros.evaluation.paper.paper_page import EXHIBITS, ExhibitData, counted, page
from t3mpc_ros.evaluation.paper.paper_tables import Results, all_tables, csv_columns
from t3mpc_ros.evaluation.paper.study import DRIVES, Extent, chosen_extent, measure, study_runs
from t3mpc_ros.evaluation.plotting import write_pictures
from t3mpc_ros.evaluation.reporting import strict_json, write_columns
from t3mpc_ros.evaluation.run_digest import source_digest
from t3mpc_ros.parameters.provenance import machine, provenance
from t3mpc_ros.version import VERSION

RUNS = 'runs.jsonl'
"""Finished runs, in the folder of the output."""


def reproduce(
    output: Path,
    *,
    quick: bool = False,
    seeds: tuple[int, ...] | None = None,
    estimation_seeds: tuple[int, ...] | None = None,
    workers: int | Executor = 1,
    fresh: bool = False,
    report: Report | None = None,
) -> tuple[str, dict[str, object]]:
    """Return a summary in a few lines and the numbers; write everything into the output folder.

    ``results.json``, ``results.csv`` (means), ``runs.csv`` (a row for each run), ``tables.md``,
    ``paper.html`` and ``figures/*.png``. None of them depends on how many processes worked, or on
    which runs were there already; ``fresh`` throws these away. ``report`` receives a line for each
    step; with None there is no progress line either.

    ``seeds`` are held-out ones of each run, by default all, or three with ``quick``;
    ``estimation_seeds`` the same of the comparison (86).
    """
    write = report or (lambda text: None)
    extent = chosen_extent(quick=quick, seeds=seeds)
    results = Results(run_study(extent, output, workers, fresh=fresh, report=report))
    write('  runs for the figures')
    showcase = simulate_figure_runs(extent, results, workers)
    write('  estimation without a controller (86)')
    alone = estimation_seeds or tuple(range(1, 3 if quick else 21))
    variances = (0.0, 0.04) if quick else open_loop_estimation.VARIANCES
    estimated = open_loop_estimation.compare(
        seeds=alone, duration=extent.duration, variances=variances
    )
    write('  figures and page')
    claims = (*all_claims(results.runs, estimated), *showcase.claims())
    tables = all_tables(results, estimated)
    material = ExhibitData(results, showcase, claims, tables)
    compared = [row for row in results.means if EXACT_MODEL not in row['controller']]
    exact = [row for row in results.means if EXACT_MODEL in row['controller']]
    content: dict[str, object] = {
        'version': VERSION,
        'parameters': {
            'quick': quick,
            'seeds': list(extent.seeds),
            'duration': extent.duration,
            'noises': list(extent.noises),
            'cases': list(extent.cases),
            'estimation_seeds': len(alone),
            'estimation_noises': list(variances),
            'methods': {
                drive: {name: asdict(each.parameters) for name, each in methods(drive).items()}
                for drive in DRIVES
            },
            'sources': source_digest(),
        },
        'results': compared,
        'exact_models': exact,
        'stage_differences': results.added.rows,
        'losses': results.lost.rows,
        'estimation': open_loop_estimation.records(estimated),
        'claims': [claim.record() for claim in claims],
    }
    output.mkdir(parents=True, exist_ok=True)
    (output / 'results.json').write_text(strict_json(content), encoding='utf-8')
    origin = provenance() | machine()
    write_columns(output / 'runs.csv', csv_columns([row | origin for row in results.runs]))
    write_columns(output / 'results.csv', csv_columns([*compared, *exact]))
    (output / 'tables.md').write_text(markdown(tables, claims), encoding='utf-8')
    drawn = write_pictures(
        {each.stem: each.draw for each in EXHIBITS if each.draw}, material, output / 'figures'
    )
    title = "The paper's figures and tables, reproduced"
    html = page(title, _origin(extent, quick=quick), material, drawn)
    (output / 'paper.html').write_text(html, encoding='utf-8')
    return f'claims: {counted(claims)}\n{output / "paper.html"}', content


def run_study(
    extent: Extent,
    output: Path,
    workers: int | Executor = 1,
    *,
    fresh: bool = False,
    report: Report | None = None,
) -> ResultTable:
    """Return the runs of the study; those that the folder of the output holds are not repeated."""
    return run_experiment(
        study_runs(extent),
        partial(measured_run, numbers=measure),
        workers,
        store=output / RUNS,
        fresh=fresh,
        report=report,
    )


def _origin(extent: Extent, *, quick: bool) -> str:
    words = [
        f'version {VERSION}, sources {source_digest()}',
        f'{len(extent.seeds)} held-out seeds, runs of {extent.duration:g} s at 100 Hz',
        'RMSE of true wheel speeds, both wheels, first 3 s left out',
    ]
    if quick:
        words.insert(0, 'a quick look: too few seeds and too short runs to conclude from')
    return ' · '.join(words)
