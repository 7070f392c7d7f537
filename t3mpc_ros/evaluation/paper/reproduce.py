# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reproduction of the paper: runs experiments, writes results, tables, figures and the page."""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from t3mpc_ros.evaluation import open_loop_estimation
from t3mpc_ros.evaluation.cases import CASES
from t3mpc_ros.evaluation.methods import methods
from t3mpc_ros.evaluation.paper.claims import all_claims, markdown
from t3mpc_ros.evaluation.paper.experiment_runs import (
    EXACT,
    ExperimentGrid,
    ExperimentSetup,
    RunFile,
    make_grid,
    needed_experiments,
    plain,
    run_missing,
    source_digest,
)
from t3mpc_ros.evaluation.paper.figure_runs import simulate_figure_runs
from t3mpc_ros.evaluation.paper.paper_page import EXHIBITS, ExhibitData, counted, findings, page
from t3mpc_ros.evaluation.paper.results import all_tables, results_of, write_csv
from t3mpc_ros.evaluation.plotting import write_pictures
from t3mpc_ros.evaluation.reporting import strict_json
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, PLANT_OF, Scenario
from t3mpc_ros.evaluation.workers import WorkerPool, measure_many
from t3mpc_ros.version import VERSION

RUNS = 'runs.jsonl'
"""Finished runs, in the folder of the output."""


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """Options of the reproduction."""

    output: Path
    quick: bool = False
    seeds: int | None = None
    """Held-out seeds of each experiment; None for all, or three when quick."""
    estimation_seeds: int | None = None
    """The same of the comparison (86)."""
    workers: int | Executor = 1
    """As for :class:`WorkerPool`."""
    json: Path | None = None
    """Path of a second copy of the results."""
    fresh: bool = False
    """Whether runs that are there already are thrown away."""


def paper_scenario(drive: str, noise: float, case: str, seed: int, duration: float) -> Scenario:
    """Return a run on the paper's plant."""
    return Scenario(PLANT_OF[drive], case, seed, duration, noise)


def default_setup() -> ExperimentSetup:
    """Return the methods and the closed loop of this package."""
    return ExperimentSetup(
        methods,
        paper_scenario,
        measure_many,
        tuple(name for name, case in CASES.items() if case.reproduced),
        HELD_OUT_SEEDS,
        WorkerPool,
    )


def reproduce(
    setup: ExperimentSetup, options: PaperOptions, report: Callable[[str], None] | None = None
) -> str:
    """Return a summary in a few lines, after writing everything into the output folder.

    ``results.json``, ``results.csv``, ``tables.md``, ``paper.html`` and ``figures/*.png``. None
    of them depends on how many processes worked, or on which runs were there already. ``report``
    receives a line for each step; with None there is no progress line either.
    """
    write = report or (lambda text: None)
    grid = make_grid(setup, quick=options.quick, seeds=options.seeds)
    file = RunFile(options.output / RUNS, fresh=options.fresh)
    sources = source_digest()
    with setup.team(options.workers) as team:
        needed = needed_experiments(setup, grid)
        numbers = run_missing(setup, grid, needed, file, sources, team=team, report=report)
        results = results_of(setup, grid, numbers)
        write('  runs for the figures')
        showcase = simulate_figure_runs(setup, grid, results, team)
    write('  estimation without a controller (86)')
    count = options.estimation_seeds or (2 if options.quick else 20)
    variances = (0.0, 0.04) if options.quick else open_loop_estimation.VARIANCES
    estimated = open_loop_estimation.compare(
        seeds=count, duration=grid.duration, variances=variances
    )
    write('  figures and page')
    claims = (*all_claims(results, estimated), *showcase.claims())
    tables = all_tables(results, estimated)
    material = ExhibitData(results, showcase, claims)

    parameters = _parameters(setup, grid, options, count, variances)
    compared = [row for row in results.rows if EXACT not in row.controller]
    exact = [row for row in results.rows if EXACT in row.controller]
    content = {
        'version': VERSION,
        'parameters': parameters | {'sources': sources},
        'results': [row.record() for row in compared],
        'exact_models': [row.record() for row in exact],
        'stage_differences': [pair.record() for pair in results.stage_differences()],
        'losses': [pair.record() for pair in results.losses()],
        'estimation': [result.record() for result in estimated],
        'claims': [claim.record() for claim in claims],
    }
    output = options.output
    for path in (output / 'results.json', options.json):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(strict_json(content), encoding='utf-8')
    write_csv(output / 'results.csv', [*compared, *exact])
    (output / 'tables.md').write_text(markdown(tables, claims), encoding='utf-8')
    drawn = write_pictures(EXHIBITS, material, output / 'figures')
    title = "The paper's figures and tables, reproduced"
    html = page(title, _origin(grid, options, sources), claims, tables, drawn, findings(material))
    (output / 'paper.html').write_text(html, encoding='utf-8')
    return f'claims: {counted(claims)}\n{output / "paper.html"}'


def _parameters(
    setup: ExperimentSetup,
    grid: ExperimentGrid,
    options: PaperOptions,
    estimation_seeds: int,
    variances: tuple[float, ...],
) -> dict[str, object]:
    parameters: dict[str, Mapping[str, object]] = {
        drive: {name: plain(method.parameters) for name, method in setup.methods(drive).items()}
        for drive in grid.drives
    }
    return {
        'quick': options.quick,
        'seeds': list(grid.seeds),
        'duration': grid.duration,
        'noises': list(grid.noises),
        'cases': list(grid.cases),
        'estimation_seeds': estimation_seeds,
        'estimation_noises': list(variances),
        'methods': parameters,
    }


def _origin(grid: ExperimentGrid, options: PaperOptions, sources: str) -> str:
    words = [
        f'version {VERSION}, sources {sources}',
        f'{len(grid.seeds)} held-out seeds, runs of {grid.duration:g} s at 100 Hz',
        'RMSE of true wheel speeds, both wheels, first 3 s left out',
    ]
    if options.quick:
        words.insert(0, 'a quick look: too few seeds and too short runs to conclude from')
    return ' · '.join(words)
