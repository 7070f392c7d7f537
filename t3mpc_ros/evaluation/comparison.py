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
"""Comparison of methods: a plan of cases, methods and seeds, its experiment, tables and page.

What draws imports the figures itself: they load matplotlib, which a run does without.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
import math
import statistics
from typing import Any, TypeVar

import numpy as np

from t3mpc_ros.evaluation import html_page, run_record
from t3mpc_ros.evaluation.baselines.baseline_controller import EXACT_INERTIA, FRICTION
from t3mpc_ros.evaluation.cases import CASES, NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import (
    Difference,
    format_interval,
    holm,
    interval,
    mean,
)
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Run, run_experiment
from t3mpc_ros.evaluation.loop import ComparedMethod, MethodSpec, NodeMethod, scenario_reports
from t3mpc_ros.evaluation.method_table import FEED_FORWARD, FULL, MODEL_ERROR
from t3mpc_ros.evaluation.result_output import EMPTY_CELL, Table
from t3mpc_ros.evaluation.run_record import METRICS, VARIATION
from t3mpc_ros.evaluation.scenario import LEAD, PRETRAINING_SEEDS, TUNING_SEEDS, Scenario
from t3mpc_ros.parameters.version_and_commit import machine, provenance
from t3mpc_ros.version import VERSION

QUICK_SEEDS = tuple(range(201, 207))
"""Default seeds: none of them was used for tuning, or is in a table of the paper's results."""
BETTER, WORSE, INCONCLUSIVE = 'better', 'worse', 'inconclusive'
"""Verdicts on a paired difference: that it is below zero or above it, or that this is open."""
LEVEL = 0.05
"""Largest probability of one wrong verdict in a table."""
Key = TypeVar('Key', bound=Hashable)
Judged = Mapping[tuple[str, str, run_record.Metric], tuple[Difference, str]]
"""Differences with their verdicts by method, case and metric."""


@dataclass(frozen=True)
class ComparisonPlan:
    """What is compared: methods in cases, with every seed."""

    scenario: Scenario
    """A run without its method; the others differ from it by case and seed."""
    cases: tuple[str, ...]
    methods: Mapping[str, ComparedMethod]
    """By name, in the order of the tables."""
    seeds: tuple[int, ...] = QUICK_SEEDS
    against: str = FEED_FORWARD
    """The method with which every other is compared."""

    def __post_init__(self) -> None:
        for what, chosen in (('case', self.cases), ('method', self.methods), ('seed', self.seeds)):
            if not chosen:
                raise ValueError(f'at least one {what} must be given')

    def runs(self) -> list[Run]:
        """Return every run, methods of one seed next to each other."""
        common = {
            'robot': self.scenario.robot,
            'noise': self.scenario.noise,
            'duration': self.scenario.duration,
        }
        return [
            Run(
                (replace(self.scenario, case=case, seed=seed), method),
                {'controller': name, 'case': case, 'seed': seed, **common},
            )
            for case in self.cases
            for seed in self.seeds
            for name, method in self.methods.items()
        ]


StepTimes = Mapping[str, float]
"""Median time of a step of each method, µs."""
TIMED = 6.0
"""Length of the run in which steps are timed, s."""


def step_times(plan: ComparisonPlan, clock_ns: Callable[[], int]) -> StepTimes:
    """Return the median time of a step of every method, µs, on this machine.

    State estimate and limits are part of a step. It is no number of the runs: those depend on no
    machine. Weights are not pretrained for it, they take no time.
    """
    length = min(TIMED, plan.scenario.duration)
    scenario = replace(plan.scenario, case=plan.cases[0], seed=plan.seeds[0], duration=length)
    found = {}
    for name, method in plan.methods.items():
        if isinstance(method, MethodSpec):
            method = replace(method, pretrained=False)
        driver = method.driver(scenario)
        loop, taken_ns = scenario_reports(scenario, driver), []
        report = next(loop)
        with suppress(StopIteration):
            while True:
                begin = clock_ns()
                command = driver.step(report)
                taken_ns.append(clock_ns() - begin)
                report = loop.send(command)
        found[name] = 1e-3 * statistics.median(taken_ns)
    return found


def run_plan(plan: ComparisonPlan, workers: Any = 1, report: Report | None = None) -> ResultTable:
    """Return the metrics of every run of a plan; ``workers`` as for :func:`.workers_for`."""
    return run_experiment(plan.runs(), workers=workers, report=report)


# -- tables ---------------------------------------------------------------------------------------


def difference(
    plan: ComparisonPlan, results: ResultTable, case: str, method: str, metric: run_record.Metric
) -> Difference | None:
    """Return the paired difference from the method of reference; None for itself or without it."""
    first, second = ({'controller': name, 'case': case} for name in (method, plan.against))
    return None if first == second else results.difference(metric.name, first, second)


def verdicts(found: Mapping[Key, Difference], seeds: int) -> dict[Key, str]:
    """Return the verdict on every paired difference of a table, with Holm's correction.

    Each is the mean over as many ``seeds``. Whose run diverged is worse than the other, and if
    both have one it is open.
    """
    certain = holm({key: each.p_value(seeds) for key, each in found.items()}, LEVEL)
    certain |= {key for key, each in found.items() if math.isinf(each.mean)}
    return {
        key: INCONCLUSIVE if key not in certain else BETTER if each.mean < 0.0 else WORSE
        for key, each in found.items()
    }


def judge(
    plan: ComparisonPlan, results: ResultTable, cases: Sequence[str], count: int | None = None
) -> Judged:
    """Return the differences that cases are judged by, of each the first ``count`` metrics."""
    found = {
        (method, case, metric): each
        for case in cases
        for metric in judged_metrics(case)[:count]
        for method in plan.methods
        if (each := difference(plan, results, case, method, metric)) is not None
    }
    judged = verdicts(found, len(plan.seeds))
    return {key: (each, judged[key]) for key, each in found.items()}


def first_verdicts(plan: ComparisonPlan, results: ResultTable) -> dict[tuple[str, str], str]:
    """Return the verdict on the first judged metric of every method and case."""
    judged = judge(plan, results, plan.cases, 1)
    return {(method, case): verdict for (method, case, _), (_, verdict) in judged.items()}


def judged_metrics(case: str) -> tuple[run_record.Metric, ...]:
    """Return the metrics that decide a case: of the wheels, or of the body if it is unknown."""
    if CASES[case].body:
        return run_record.YAW_RATE_SETTLED, run_record.YAW_RATE, run_record.DRIFT
    return run_record.SETTLED, run_record.OVERALL


def summary_table(
    plan: ComparisonPlan,
    results: ResultTable,
    judged: Mapping[tuple[str, str], str],
    step_times: StepTimes | None = None,
) -> Table:
    """Return the first judged metric of every method and case, with its verdict in ``judged``.

    Beside it the variation of the command in the first case, and the time of a step, µs.
    """
    firsts = {case: judged_metrics(case)[0] for case in plan.cases}
    rows = []
    for method in plan.methods:
        cells = [method]
        for case, metric in firsts.items():
            cell = _cell(results.values(metric.name, case=case, controller=method), metric)
            cells.append(f'{cell} {judged.get((method, case), "")}'.rstrip())
        variation = results.values(
            run_record.VARIATION.name, case=plan.cases[0], controller=method
        )
        cells.append(_cell(variation, run_record.VARIATION))
        if step_times:
            cells.append(f'{step_times[method]:.0f}')
        rows.append(tuple(cells))
    body = [case for case, metric in firsts.items() if metric is not run_record.SETTLED]
    title = 'Settled RMSE of the wheel speeds, rad/s'
    if body:
        title += f' ({", ".join(body)}: of the yaw rate of the body)'
    title += f'; mean ± half the 95 % interval (seeds); verdict against {plan.against}'
    head = [
        'method',
        *plan.cases,
        f'{run_record.VARIATION.heading}, {plan.cases[0]}, {run_record.VARIATION.unit}',
    ]
    head += ['step, µs'] if step_times else []
    return Table(title, head, rows, (FULL,), wrap=True, notes=_verdict_notes(plan, len(judged)))


def _verdict_notes(plan: ComparisonPlan, count: int) -> list[str]:
    """Return how the verdicts on ``count`` differences of a table are made."""
    text = (
        f"Verdict: {BETTER} or {WORSE} than {plan.against} by Student's test of the differences, "
        f"paired by seed, at {100.0 * LEVEL:g} % with Holm's correction for the {count} "
        'comparisons of the table. An interval is that of its mean alone: one that leaves zero '
        f'out may be {INCONCLUSIVE}.'
    )
    return [text] if count else []


def _cell(values: Sequence[float], metric: run_record.Metric) -> str:
    """Return mean ± half the interval and the number of seeds, or how many diverged."""
    if diverged := sum(map(math.isnan, values)):
        return f'{diverged} of {len(values)} diverged'
    text = format_interval(mean(values), interval(values), '', metric.digits)
    return f'{text} ({len(values)})'


def case_table(plan: ComparisonPlan, results: ResultTable, case: str) -> Table:
    """Return every metric of a case, and the paired differences of those that decide it."""
    first = results.where(case=case, controller=next(iter(plan.methods)))[0]
    metrics = [
        metric
        for metric in run_record.METRICS
        if metric.name in first
        and (
            metric is not run_record.STOPPED
            or any(each > 0.0 for each in results.values(run_record.STOPPED.name, case=case))
        )
    ]
    judged = judged_metrics(case)
    head = ['method', *(f'{metric.heading}, {metric.unit}' for metric in metrics)]
    compared = plan.against in plan.methods and len(plan.methods) > 1
    if compared:
        for metric in judged:
            head += [f'{metric.heading} − {plan.against}', 'verdict']
    head.append('knows')
    judgement = judge(plan, results, [case])
    rows = []
    for method in plan.methods:
        cells = [method]
        for metric in metrics:
            cells.append(_cell(results.values(metric.name, case=case, controller=method), metric))
        for metric in judged if compared else ():
            found, verdict = judgement.get((method, case, metric), (None, EMPTY_CELL))
            shown = format_interval(*found, '+', metric.digits) if found else EMPTY_CELL
            cells += [shown, verdict]
        cells.append(known_by(plan, method, case))
        rows.append(tuple(cells))
    title = f'{case}: {CASES[case].text}'
    notes = _verdict_notes(plan, len(judgement)) if compared else []
    return Table(title, head, rows, (FULL,), wrap=True, notes=notes)


def known_by(plan: ComparisonPlan, method: str, case: str) -> str:
    """Return what a method knows in a case, as it states."""
    return plan.methods[method].knowledge(replace(plan.scenario, case=case))


def knowledge_table(plan: ComparisonPlan) -> Table:
    """Return what the words of the column *knows* mean."""
    scenario = replace(plan.scenario, case=plan.cases[0])
    model = scenario.nominal_model()
    rows = {
        'all': 'noise variance, limits, geometry, lag and dead time of the estimator (the true '
        'dead time only where the case says that it is known); state estimate and limits are the '
        'same for all but the controller of the node, which has its own of the same kind',
        'reference ahead': f'the reference up to {LEAD:g} s ahead; "now": up to the present',
        'wheel speeds': 'the measured ones; on the twin those of the step counters',
        'their difference by the gyro': 'the difference of the wheel speeds is that of the yaw of '
        'the odometry, which contains the gyro',
        'estimate of the dead time': 'from commands and measured speeds, by one estimator',
        f'{EXACT_INERTIA}; inertia × {MODEL_ERROR:g}': 'inertia of the nominal robot, or that '
        'with an error: in the model of a prediction, or in the torques of a torque drive. '
        'Where nothing is said, accelerations become torques by the exact one',
        FRICTION: 'friction and turning of the nominal robot, as a function of the speeds',
        'weights': 'learnt on the nominal robot before the run',
        'parameters': f'tuned on other seeds with equal effort for {plan.scenario.kind.tuned_for} '
        '(t3mpc tune); with the ramp those tuned without it, unless they were tuned with it; of '
        'the offset-free MPC those of the linear one with preview; '
        f'{FULL} on the twin and the variants of {FEED_FORWARD} have their defaults',
    }
    if plan.scenario.kind.has_gyro:
        rows['model'] = (
            f'on the twin a servo with a lag of {1e3 * model.lag:g} ms without friction, which is '
            'exact for a stepper motor but for the oscillation of its rotor'
        )
    return Table('What the methods know', ('word', 'means'), list(rows.items()), text=2, wrap=True)


def description(plan: ComparisonPlan) -> str:
    """Return in one paragraph what was run and how it is counted."""
    seeds = ', '.join(map(str, plan.seeds))
    known = {*TUNING_SEEDS, *PRETRAINING_SEEDS}
    used = ', '.join(str(seed) for seed in plan.seeds if seed in known)
    told = f' (methods of the package were tuned or trained on {used})' if used else ''
    text = (
        f'{plan.scenario.text}, {plan.scenario.duration:g} s, '
        f'noise variance {plan.scenario.noise:g} (rad/s)², '
        f'seeds {seeds}{told}. '
        'True wheel speeds against the reference; mean ± half the 95 % interval over the seeds. '
    )
    kind = plan.scenario.kind
    before, after = kind.settling
    text += (
        f'The first {run_record.START:g} s of control do not count. Settled: without {before:g} s '
        f'before and {after:g} s after each switch. '
    )
    if kind.has_gyro:
        text += (
            'Yaw rate and yaw drift are those of the body, from ground truth, against the '
            'reference; the drift is that at the end. '
        )
    return text + (
        'Variation: total variation of the commanded acceleration per second and wheel. '
        'In brackets the number of seeds.'
    )


def markdown(
    plan: ComparisonPlan, results: ResultTable, step_times: StepTimes | None = None
) -> str:
    """Return all tables in Markdown."""
    tables = [
        summary_table(plan, results, first_verdicts(plan, results), step_times),
        *(case_table(plan, results, case) for case in plan.cases),
        knowledge_table(plan),
    ]
    return '\n\n'.join([description(plan), *(table.markdown() for table in tables)])


# -- page, figures and JSON record ----------------------------------------------------------------


def verdict_box(
    plan: ComparisonPlan, results: ResultTable, judged: Mapping[tuple[str, str], str]
) -> html_page.VerdictBox:
    """Return in one sentence how the first method does beside the one it is compared with."""
    case = plan.cases[0]
    own = next((each for each in plan.methods if each != plan.against), plan.against)
    metric = judged_metrics(case)[0]
    named = [own, *(each for each in plan.methods if each == plan.against != own)]
    numbers = [results.values(metric.name, case=case, controller=name) for name in named]
    text = ', '.join(
        f'{name} {format_interval(mean(each), interval(each), "", metric.digits)}'
        for name, each in zip(named, numbers, strict=True)
    )
    verdict = judged.get((own, case), '')
    counts = [
        f'{other}: {judged[own, other]}.' for other in plan.cases[1:] if (own, other) in judged
    ]
    return html_page.VerdictBox(
        f'{metric.heading.capitalize()} error ({metric.unit}): {text}'
        f'{f": {verdict}" if verdict else ""}.',
        [f'{case}, {len(plan.seeds)} seeds of {plan.scenario.duration:g} s.', *counts],
        {BETTER: 'good', WORSE: 'bad'}.get(verdict, 'apart'),
    )


def page(plan: ComparisonPlan, results: ResultTable, step_times: StepTimes | None = None) -> str:
    """Return the page as self-contained HTML."""
    from t3mpc_ros.evaluation.figure_style import drawing, file_of

    judged = first_verdicts(plan, results)
    blocks: list[html_page.Block] = [verdict_box(plan, results, judged)]
    figures: Mapping[str, Callable[[ComparisonPlan, ResultTable, str], Any]] = {
        f'Difference from {plan.against}, left is better; 95 % intervals are of each by itself, '
        'verdicts are stricter because there are many': _draw_differences,
        'Error against variation of the command; joined: no method is better in both': draw_pareto,
        'Every seed, and the mean': draw_seeds,
    }
    for case in plan.cases:
        blocks.append(html_page.Heading(case))
        for caption, draw in figures.items():
            if figure := drawing(partial(draw, plan, results), case):
                blocks.append(
                    html_page.Picture(f'{caption}: {case}', file_of(figure, 'svg'), caption)
                )
            if draw is _draw_differences and case == plan.cases[0]:
                summary = summary_table(plan, results, judged, step_times)
                blocks += [html_page.Contents(), html_page.Paragraph(description(plan)), summary]
        blocks.append(case_table(plan, results, case))
    blocks += [html_page.Heading('What the methods know'), knowledge_table(plan)]
    return html_page.html_page(f'Comparison of methods: {plan.scenario.robot}', blocks)


def record(
    plan: ComparisonPlan, results: ResultTable, step_times: StepTimes | None = None
) -> dict[str, Any]:
    """Return plan, runs and differences for a JSON file; NaN where a run diverged."""
    cases: dict[str, Any] = {}
    for case in CASES:
        if case in plan.cases:
            found = {name: _method_record(plan, results, case, name) for name in plan.methods}
            cases[case] = {'text': CASES[case].text, 'methods': found}
    return {
        'format': 1,
        'version': VERSION,
        'origin': provenance() | machine(),
        'step_time_us': dict(step_times or {}),
        'robot': plan.scenario.robot,
        'drive_of_tuning': plan.scenario.kind.tuned_for,
        'seeds': list(plan.seeds),
        'duration': plan.scenario.duration,
        'noise': plan.scenario.noise,
        'gyro': plan.scenario.gyro,
        'units': {metric.name: metric.unit for metric in METRICS},
        'parameters': {
            name: _parameters(plan.scenario.robot, method) for name, method in plan.methods.items()
        },
        'knowledge': {name: known_by(plan, name, plan.cases[0]) for name in plan.methods},
        'cases': cases,
    }


def _parameters(robot: str, method: Any) -> dict[str, object]:
    if isinstance(method, NodeMethod):
        return dict(method.parameters_for(Scenario(robot, NOMINAL, 0)).to_dict())
    if isinstance(method, MethodSpec):
        return dict(method.parameters.to_dict())
    # The settings of a controller of one's own may be of any kind.
    plain = bool, int, float, str
    return {name: v if isinstance(v, plain) else repr(v) for name, v in method.settings}


def _method_record(
    plan: ComparisonPlan, results: ResultTable, case: str, method: str
) -> dict[str, Any]:
    runs = results.where(case=case, controller=method)
    names = [metric.name for metric in METRICS if metric.name in runs[0]]
    judged = judge(plan, results, [case])
    differences = {
        metric.name: {
            'mean': found.mean,
            'half_interval': found.half,
            'p': found.p_value(len(plan.seeds)),
            'verdict': judged.get((method, case, metric), (None, ''))[1],
        }
        for metric in METRICS
        if (found := difference(plan, results, case, method, metric)) is not None
    }
    return {
        'mean': {name: mean([run[name] for run in runs]) for name in names},
        'runs': [{name: run[name] for name in ('seed', *names)} for run in runs],
        f'difference_from_{plan.against.replace("-", "_")}': differences,
    }


def _draw_differences(plan: ComparisonPlan, results: ResultTable, case: str) -> Any:
    """Return a figure of the paired differences of the first judged metric, or None."""
    from t3mpc_ros.evaluation.figure_style import new_figure, scale_by_size, whisker

    metric = judged_metrics(case)[0]
    rows = [
        (method, *found)
        for (method, _, judged), found in judge(plan, results, [case]).items()
        if judged is metric and math.isfinite(found[0].mean)
    ]
    if not rows:
        return None
    figure, axis = new_figure(0.9 + 0.2 * len(rows))
    places = np.arange(len(rows))[::-1]
    colours = {BETTER: '#15803d', WORSE: '#be123c', INCONCLUSIVE: '#6b7280'}
    ends: list[float] = []
    for place, (_, found, verdict) in zip(places, rows, strict=True):
        half = whisker(found.half)
        ends += [found.mean - half, found.mean + half]
        axis.errorbar(found.mean, place, xerr=half, fmt='o', color=colours[verdict], markersize=4)
    axis.axvline(0.0, color='#1f2937', linewidth=0.8)
    axis.set_yticks(places, [name for name, *_ in rows])
    scale_by_size(axis, 'x', ends, near=0.01)
    axis.set_xlabel(f'{metric.heading} / ({metric.unit})')
    return figure


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points that no other is below in both numbers, by the first."""
    found: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if not found or points[i][1] < points[found[-1]][1]:
            found.append(i)
    return found


def draw_pareto(plan: ComparisonPlan, results: ResultTable, case: str) -> Any:
    """Return a figure of the first judged metric against the variation, or None."""
    from t3mpc_ros.evaluation.figure_style import new_figure, scale_by_size

    metric = judged_metrics(case)[0]
    chosen, points = [], []
    for method in plan.methods:
        variation, error = (
            mean(results.values(name, case=case, controller=method))
            for name in (VARIATION.name, metric.name)
        )
        if math.isfinite(variation) and math.isfinite(error):
            chosen.append(method)
            points.append((variation, error))
    if len(points) < 2:
        return None
    figure, axis = new_figure(3.6)
    best = front(points)
    axis.step(*zip(*(points[i] for i in best), strict=True), where='post', color='#9ca3af')
    for i, (method, point) in enumerate(zip(chosen, points, strict=True)):
        axis.plot(*point, 'o', color='#15803d' if i in best else '#6b7280', markersize=4)
        axis.annotate(method, point, xytext=(3, 3), textcoords='offset points', fontsize=6)
    for name, values in zip('xy', zip(*points, strict=True), strict=True):
        scale_by_size(axis, name, values)
    axis.set_xlabel(f'{VARIATION.heading} / ({VARIATION.unit})')
    axis.set_ylabel(f'{metric.heading} / ({metric.unit})')
    return figure


def draw_seeds(plan: ComparisonPlan, results: ResultTable, case: str) -> Any:
    """Return a figure of the first judged metric of every seed and method, or None."""
    from t3mpc_ros.evaluation.figure_style import new_figure, scale_by_size

    metric = judged_metrics(case)[0]
    rows = {
        method: values
        for method in plan.methods
        if (values := results.values(metric.name, case=case, controller=method))
    }
    finite = [each for values in rows.values() for each in values if math.isfinite(each)]
    if not finite:
        return None
    figure, axis = new_figure(0.9 + 0.2 * len(rows))
    places = np.arange(len(rows))[::-1]
    names = []
    for place, (method, values) in zip(places, rows.items(), strict=True):
        diverged = sum(map(math.isnan, values))
        names.append(f'{method} ({diverged} diverged)' if diverged else method)
        axis.plot(values, np.full(len(values), place), '|', color='#0284c7', markersize=8)
        if not diverged:  # a mean of the others would praise it
            axis.plot(mean(values), place, 'o', color='#1f2937', markersize=4)
    axis.set_yticks(places, names)
    scale_by_size(axis, 'x', finite)
    axis.set_xlabel(f'{metric.heading} / ({metric.unit})')
    return figure
