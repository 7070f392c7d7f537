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

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from t3mpc_ros.evaluation import fuzzy_estimation_error, html_page, result_output
from t3mpc_ros.evaluation.experiment import Report, ResultTable, measured_run, run_experiment
from t3mpc_ros.evaluation.figure_style import write_pictures
from t3mpc_ros.evaluation.method_table import EXACT_MODEL, methods
from t3mpc_ros.evaluation.paper import paper_figures, paper_study
from t3mpc_ros.evaluation.paper.claims import VERDICTS, Claim, all_claims, markdown
from t3mpc_ros.evaluation.paper.paper_study import Results, all_tables, csv_columns
from t3mpc_ros.evaluation.run_cache_key import source_digest
from t3mpc_ros.parameters.version_and_commit import machine, provenance
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
    extent = paper_study.chosen_extent(quick=quick, seeds=seeds)
    results = Results(run_study(extent, output, workers, fresh=fresh, report=report))
    write('  runs for the figures')
    showcase = paper_figures.simulate_figure_runs(extent, results, workers)
    write('  estimation without a controller (86)')
    alone = estimation_seeds or tuple(range(1, 3 if quick else 21))
    variances = (0.0, 0.04) if quick else fuzzy_estimation_error.VARIANCES
    estimated = fuzzy_estimation_error.compare(
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
                for drive in paper_study.DRIVES
            },
            'sources': source_digest(),
        },
        'results': compared,
        'exact_models': exact,
        'stage_differences': results.added.rows,
        'losses': results.lost.rows,
        'estimation': fuzzy_estimation_error.records(estimated),
        'claims': [claim.record() for claim in claims],
    }
    output.mkdir(parents=True, exist_ok=True)
    (output / 'results.json').write_text(result_output.strict_json(content), encoding='utf-8')
    origin = provenance() | machine()
    result_output.write_columns(
        output / 'runs.csv', csv_columns([row | origin for row in results.runs])
    )
    result_output.write_columns(output / 'results.csv', csv_columns([*compared, *exact]))
    (output / 'tables.md').write_text(markdown(tables, claims), encoding='utf-8')
    drawn = write_pictures(
        {each.stem: each.draw for each in EXHIBITS if each.draw}, material, output / 'figures'
    )
    title = "The paper's figures and tables, reproduced"
    html = page(title, _origin(extent, quick=quick), material, drawn)
    (output / 'paper.html').write_text(html, encoding='utf-8')
    return f'claims: {counted(claims)}\n{output / "paper.html"}', content


def run_study(
    extent: paper_study.Extent,
    output: Path,
    workers: int | Executor = 1,
    *,
    fresh: bool = False,
    report: Report | None = None,
) -> ResultTable:
    """Return the runs of the study; those that the folder of the output holds are not repeated."""
    return run_experiment(
        paper_study.study_runs(extent),
        partial(measured_run, numbers=paper_study.measure),
        workers,
        store=output / RUNS,
        fresh=fresh,
        report=report,
    )


def _origin(extent: paper_study.Extent, *, quick: bool) -> str:
    words = [
        f'version {VERSION}, sources {source_digest()}',
        f'{len(extent.seeds)} held-out seeds, runs of {extent.duration:g} s at 100 Hz',
        'RMSE of true wheel speeds, both wheels, first 3 s left out',
    ]
    if quick:
        words.insert(0, 'a quick look: too few seeds and too short runs to conclude from')
    return ' · '.join(words)


# -- page -----------------------------------------------------------------------------------------

BEYOND = 'Not in the paper.'


@dataclass(frozen=True, slots=True)
class ExhibitData:
    """What exhibits are made of."""

    results: Results
    showcase: paper_figures.FigureRuns
    claims: Sequence[Claim]
    tables: Mapping[str, Sequence[result_output.Table]]


@dataclass(frozen=True, slots=True)
class Exhibit:
    """A figure or a group of tables, with its words."""

    title: str
    paper: str
    """Statement of the paper, paraphrased."""
    caption: str
    claims: tuple[str, ...] = ()
    """Beginnings of the names of the claims that decide it."""
    stem: str = ''
    """Name of the picture's file; empty for tables."""
    draw: Callable[[ExhibitData], Any] | None = None
    tables: str = ''
    """Heading of its tables, as in :func:`.all_tables`."""
    comparable: bool = True
    finding: Callable[[ExhibitData], str] | None = None
    """What was found where there is no claim to decide."""

    def decided_by(self, claims: Sequence[Claim]) -> list[Claim]:
        """Return the claims this exhibit is about."""
        return [claim for claim in claims if self.claims and claim.name.startswith(self.claims)]

    def mark(self, claims: Sequence[Claim]) -> str:
        """Decide: held when all its claims are, not held when one is not, else unknown."""
        verdicts = {claim.verdict for claim in self.decided_by(claims)}
        if not self.comparable:
            return 'not comparable'
        for verdict in ('not held', 'inconclusive'):
            if verdict in verdicts:
                return verdict
        return 'held' if verdicts == {'held'} else 'not measured'


EXHIBITS = (
    Exhibit(
        'Path of the robot on the floor (Fig. 8)',
        'A real robot follows a complicated chaotic path well, even in very noisy conditions.',
        'Simulated robot, velocity drive: the body motion (1)-(3) integrated from true and from '
        'wanted wheel speeds. What is tracked are speeds, not places, so the paths part slowly.',
        stem='fig08_path',
        draw=lambda m: paper_figures.path(m.showcase),
        finding=lambda m: paper_figures.path_in_words(m.showcase),
        comparable=False,
    ),
    Exhibit(
        'Phase portrait of the robot (Fig. 9)',
        'The same real run as a phase portrait: the robot follows the chaotic reference.',
        'Simulated robot, velocity drive, both panels with the same axes.',
        stem='fig09_robot_portrait',
        draw=lambda m: paper_figures.portrait(m.showcase.velocity),
        finding=lambda m: paper_figures.portrait_in_words(m.showcase),
        comparable=False,
    ),
    Exhibit(
        'Switching modes (Fig. 10)',
        'Which of the four chaotic signals drives each output; it changes four times in the run.',
        'The paper does not state its switch times; here every 12 s.',
        ('four switches',),
        'fig10_modes',
        lambda m: paper_figures.modes(m.showcase),
    ),
    Exhibit(
        'Output signals (Fig. 11)',
        'The outputs follow their references closely in spite of the sudden changes.',
        'Full controller, torque drive, noise variance 0.04 (rad/s)². Dashed: switches.',
        ('outputs follow', 'settled, torque'),
        'fig11_outputs',
        lambda m: paper_figures.outputs(m.showcase),
    ),
    Exhibit(
        'Control signals (Fig. 12)',
        'The control signals have no high-frequency fluctuation.',
        'u is an acceleration; the torque is theta_bar u. The same run.',
        ('no chatter',),
        'fig12_control',
        lambda m: paper_figures.control(m.showcase),
    ),
    Exhibit(
        'Estimated signals (Fig. 13)',
        'The outputs of the fuzzy systems follow their targets.',
        'The target is the acceleration that u does not explain, by the difference of true speeds '
        'over a period. The same run.',
        ('estimates follow',),
        'fig13_estimates',
        lambda m: paper_figures.estimates(m.showcase),
    ),
    Exhibit(
        'Phase portrait of the outputs (Fig. 14)',
        'One output against the other: acceptable accuracy along a chaotic, secure path.',
        'Full controller, torque drive, noise variance 0.04 (rad/s)².',
        ('outputs follow',),
        'fig14_portrait',
        lambda m: paper_figures.portrait(m.showcase.torque),
    ),
    Exhibit(
        'Fuzzy systems as estimators, without a controller (Fig. 15, Table 3)',
        'With noise of variance 0.04, non-singleton type 3 is about 50 % better than the other '
        'fuzzy systems, and barely worse for noise up to 0.1, where theirs grows by over 50 %.',
        'Equation (86) as it must be read to work: with a known push and with output error '
        'feedback. All kinds have the same sets and learn equally fast. Black: true speeds.',
        ('estimation',),
        'fig15_estimation',
        lambda m: paper_figures.estimation_portraits(m.showcase),
        'Estimation without a controller',
    ),
    Exhibit(
        'Phase portraits of several methods (Fig. 15)',
        'The accuracy of the suggested method is seen to surpass that of the others.',
        'Torque drive, noise variance 0.04 (rad/s)²; RMSE in rad/s of the run shown. Black: '
        'reference.',
        ('half of the best baseline',),
        'fig15_portraits',
        lambda m: paper_figures.portraits(m.showcase, m.results),
    ),
    Exhibit(
        'Comparison with baselines at the noise of the paper (Table 3)',
        'The suggested method is about 50 % more accurate than the others.',
        'Every method had the same budget of tuning on other seeds, the same state estimate and '
        'the same drive. Whiskers: 95 % interval over seeds.',
        (
            'half of the best baseline',
            'share of the best baseline',
            'baselines with preview',
            'noise-free',
        ),
        'table3_rmse',
        lambda m: paper_figures.rmse_bars(m.results),
        'Methods in every case',
    ),
    Exhibit(
        'RMSE against noise (Table 3)',
        'When the noise variance grows from 0 to 0.1, the RMSE of the suggested method grows only '
        'slightly, that of the others by more than 50 %.',
        'Above: RMSE with its 95 % interval; below: what the noise adds.',
        ('grows only slightly', 'others grow', 'smallest growth'),
        'noise_growth',
        lambda m: paper_figures.noise_growth(m.results),
        'Methods against noise (Table 3)',
    ),
    Exhibit(
        'The controller as it grows',
        BEYOND + ' Its parts are never taken apart there.',
        'Each bar adds one part to the one before; the last one adds preview.',
        ('settled', 'NT3FS lowers', 'compensator lowers', 'MPC lowers', 'preview lowers'),
        'stages',
        lambda m: paper_figures.ablation_bars(m.results),
    ),
    Exhibit(
        'What each part is worth',
        BEYOND,
        'Paired differences on the same seeds with their 95 % intervals at noise 0.04: a part '
        'helps where the whole interval lies left of zero. An asterisk in the tables: it excludes '
        'zero.',
        tuple(f'{part} is missed' for part in paper_study.WITHOUT),
        'parts',
        lambda m: paper_figures.parts(m.results),
        'What each part is worth',
    ),
    Exhibit(
        'What preview does at a switch',
        BEYOND + ' The generator of the reference knows its own near future.',
        'Velocity drive, noise 0.04: the same switch with and without it.',
        ('preview',),
        'preview',
        lambda m: paper_figures.preview(m.showcase),
    ),
    Exhibit(
        'Total variation of the control',
        'The control signals have no high-frequency fluctuation.',
        'How much the acceleration asked of the robot moves up and down in a second: u with the '
        'torque drive, the rate of change of the commanded speed with the velocity drive.',
        ('no chatter',),
        tables='Total variation of the control',
    ),
)
"""In the order of the page."""


HEADLINE = 'table3_rmse'
"""Stem of the exhibit that the page shows first."""


def page(title: str, origin: str, material: ExhibitData, pictures: Mapping[str, bytes]) -> str:
    """Return the page as HTML that loads nothing from anywhere.

    ``origin`` says where the numbers come from; pictures are by the stem of their exhibit.
    """
    headline, *others = (
        _exhibit(each, material, pictures)
        for each in sorted(EXHIBITS, key=lambda each: each.stem != HEADLINE)
    )
    return html_page.html_page(
        title,
        [
            html_page.Paragraph(origin, 'quiet'),
            html_page.VerdictBox(f'Claims: {counted(material.claims)}.', [], 'apart'),
            headline,
            html_page.Contents(),
            html_page.Heading('Claims'),
            _claims('What this project claims', material.claims, 'ours'),
            _claims('What the paper claims', material.claims, 'paper'),
            *others,
        ],
    )


def counted(claims: Sequence[Claim]) -> str:
    """Return how many claims are held, not held, inconclusive and not measured."""
    verdicts = [claim.verdict for claim in claims]
    return ', '.join(f'{verdicts.count(kind)} {kind}' for kind in VERDICTS)


def _claims(title: str, claims: Sequence[Claim], origin: str) -> html_page.Details:
    chosen = [claim for claim in claims if claim.origin == origin]
    rows = [
        (claim.text, claim.found, result_output.verdict_mark(claim.verdict)) for claim in chosen
    ]
    table = result_output.Table('', ('claim', 'found', ''), rows, text=3, wrap=True)
    return html_page.Details(f'{title}: {counted(chosen)}', [table], opened=True)


def _exhibit(
    exhibit: Exhibit, material: ExhibitData, pictures: Mapping[str, bytes]
) -> html_page.Group:
    claims = exhibit.decided_by(material.claims)
    found: list[Sequence[str | result_output.Mark]] = [
        (f'{claim.text}: {claim.found}', result_output.verdict_mark(claim.verdict))
        for claim in claims
    ]
    if not found:
        found = [(exhibit.finding(material) if exhibit.finding else exhibit.caption,)]
    sides = [
        html_page.Items([(exhibit.paper,)], 'side', 'The paper'),
        html_page.Items(found, 'side', 'Found here'),
    ]
    blocks: list[html_page.Block] = [
        html_page.Heading(
            exhibit.title, result_output.verdict_mark(exhibit.mark(material.claims))
        ),
        html_page.Group(sides, 'div', 'sides'),
    ]
    if figure := pictures.get(exhibit.stem):
        blocks.append(html_page.Picture(exhibit.title, figure, exhibit.caption))
    elif exhibit.stem:
        blocks.append(html_page.Paragraph('Left out: nothing of it was measured.', 'quiet'))
    shown = material.tables.get(exhibit.tables, ())
    blocks += shown[:2]
    if more := shown[2:]:
        blocks.append(html_page.Details(f'{len(more)} more tables', more))
    return html_page.Group(blocks)
