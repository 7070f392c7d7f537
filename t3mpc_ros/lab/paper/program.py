# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``lab paper``: run what is needed, then write numbers, tables, figures, claims and the page."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
import os
from pathlib import Path
import time
from typing import Any

from t3mpc_ros.lab.paper.plan import EXACT, Bench, Extent, cells, extent
from t3mpc_ros.settings.words import whole

RUNS = 'runs.jsonl'
"""Finished runs, in the folder of the output."""


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """What is asked for."""

    output: Path
    quick: bool = False
    seeds: int | None = None
    """Held-out seeds of each cell; None for all, or three when quick."""
    estimation_seeds: int | None = None
    """The same of the comparison (86)."""
    workers: int = 1
    json: Path | None = None
    """Where a second copy of the results goes."""
    fresh: bool = False
    """Whether runs that are there already are thrown away."""


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Return the parser of ``paper``, added to the sub-parsers of a program."""
    parser: argparse.ArgumentParser = commands.add_parser(
        'paper', help='every figure and table of the paper, and what became of its claims'
    )
    parser.add_argument(
        '--quick', action='store_true', help='few seeds and short runs: shows that all works'
    )
    parser.add_argument(
        '--seeds', type=whole(1, 10_000), help='held-out seeds (default: all, quick: 3)'
    )
    parser.add_argument(
        '--estimation-seeds',
        type=whole(1, 10_000),
        help='of the comparison without a controller (86)',
    )
    parser.add_argument(
        '--workers',
        type=whole(1, 10_000),
        default=_processors(),
        help='processes (default: processors)',
    )
    parser.add_argument(
        '--output', type=Path, help='folder (default runs/paper, or runs/paper-quick)'
    )
    parser.add_argument('--json', type=Path, help='also write the results to this file')
    parser.add_argument(
        '--fresh', action='store_true', help='throw away the runs that the folder holds'
    )
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Return 0 after everything was written; the command line's entry."""
    from t3mpc_ros.lab.paper.campaign import Progress

    output = options.output or Path('runs') / ('paper-quick' if options.quick else 'paper')
    chosen = PaperOptions(
        output=output,
        quick=options.quick,
        seeds=options.seeds,
        estimation_seeds=options.estimation_seeds,
        workers=options.workers,
        json=options.json,
        fresh=options.fresh,
    )
    print(reproduce(installed_bench(), chosen, Progress(time.monotonic)))
    return 0


def installed_bench() -> Bench:
    """Return the contestants and the closed loop of this package."""
    from t3mpc_ros.lab.contestants import methods
    from t3mpc_ros.lab.trial.loop import Workers, measure_many
    from t3mpc_ros.lab.trial.scenario import CASES, HELD_OUT, Scenario

    return Bench(methods, Scenario, measure_many, tuple(CASES), HELD_OUT, Workers)


def reproduce(bench: Bench, options: PaperOptions, progress: Any = None) -> str:
    """Return a summary in a few lines, after writing everything into the output folder.

    ``results.json``, ``results.csv``, ``tables.md``, ``paper.html`` and ``figures/*.png``. None
    of them depends on how many processes worked, or on which runs were there already.

    Parameters
    ----------
    bench
        Where methods and runs come from.
    options
        What is asked for.
    progress
        A :class:`t3mpc_ros.lab.paper.campaign.Progress`; None keeps silent.

    Raises
    ------
    OSError
        The output cannot be written.
    RuntimeError
        Another campaign is writing to the same folder.
    ValueError
        More seeds are asked for than there are.
    """
    from t3mpc_ros.lab import estimation
    from t3mpc_ros.lab.paper.campaign import conduct
    from t3mpc_ros.lab.paper.claims import all_claims
    from t3mpc_ros.lab.paper.figures.exhibits import Material, findings, pictures
    from t3mpc_ros.lab.paper.figures.showcase import run_showcase
    from t3mpc_ros.lab.paper.page import counted, page
    from t3mpc_ros.lab.paper.results import results_of, write_csv, write_json
    from t3mpc_ros.lab.paper.store import RunFile, source_digest
    from t3mpc_ros.lab.paper.tables import all_tables, markdown

    say = progress.say if progress is not None else lambda text: None
    scope = extent(bench, quick=options.quick, seeds=options.seeds)
    file = RunFile(options.output / RUNS, fresh=options.fresh)
    sources = source_digest()
    with bench.team(options.workers) as team:
        needed = cells(bench, scope)
        numbers = conduct(bench, scope, needed, file, sources, team=team, progress=progress)
        results = results_of(bench, scope, numbers)
        say('  runs for the figures')
        showcase = run_showcase(bench, scope, results, team)
    say('  estimation without a controller (86)')
    count = options.estimation_seeds or (2 if options.quick else 20)
    variances = (0.0, 0.04) if options.quick else estimation.VARIANCES
    estimated = estimation.compare(seeds=count, duration=scope.duration, variances=variances)
    say('  figures and page')
    claims = (*all_claims(results, estimated), *showcase.claims())
    tables = all_tables(results, estimated)
    material = Material(results, showcase, claims)
    drawn = pictures(material)

    settings = _settings(bench, scope, options, count, variances)
    compared = [row for row in results.rows if EXACT not in row.controller]
    exact = [row for row in results.rows if EXACT in row.controller]
    content = {
        'version': _version(),
        'settings': settings | {'sources': sources},
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
            write_json(path, content)
    write_csv(output / 'results.csv', [*compared, *exact])
    (output / 'tables.md').write_text(markdown(tables, claims), encoding='utf-8')
    (output / 'figures').mkdir(exist_ok=True)
    for stem, png in drawn.items():
        (output / 'figures' / f'{stem}.png').write_bytes(png)
    title = "The paper's figures and tables, reproduced"
    html = page(title, _origin(scope, options, sources), claims, tables, drawn, findings(material))
    (output / 'paper.html').write_text(html, encoding='utf-8')
    return f'claims: {counted(claims)}\n{output / "paper.html"}'


def _settings(
    bench: Bench,
    scope: Extent,
    options: PaperOptions,
    estimation_seeds: int,
    variances: tuple[float, ...],
) -> dict[str, object]:
    from t3mpc_ros.lab.paper.store import plain

    methods: dict[str, Mapping[str, object]] = {
        drive: {name: plain(method.settings) for name, method in bench.methods(drive).items()}
        for drive in scope.drives
    }
    return {
        'quick': options.quick,
        'seeds': list(scope.seeds),
        'duration': scope.duration,
        'noises': list(scope.noises),
        'cases': list(scope.cases),
        'estimation_seeds': estimation_seeds,
        'estimation_noises': list(variances),
        'methods': methods,
    }


def _version() -> str:
    import t3mpc_ros

    return t3mpc_ros.__version__


def _origin(scope: Extent, options: PaperOptions, sources: str) -> str:
    words = [
        f'version {_version()}, sources {sources}',
        f'{len(scope.seeds)} held-out seeds, runs of {scope.duration:g} s at 100 Hz',
        'RMSE of true wheel speeds, both wheels, first 3 s left out',
    ]
    if options.quick:
        words.insert(0, 'a quick look: too few seeds and too short runs to conclude from')
    return ' · '.join(words)


def _processors() -> int:
    return max(1, len(os.sched_getaffinity(0)))
