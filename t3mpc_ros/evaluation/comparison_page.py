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
"""HTML page, figures and JSON record of a comparison."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import math
from typing import Any

import numpy as np

from t3mpc_ros.evaluation import html_page
from t3mpc_ros.evaluation.cases import CASES, NOMINAL
from t3mpc_ros.evaluation.comparison import (
    BETTER,
    INCONCLUSIVE,
    WORSE,
    ComparisonPlan,
    StepTimes,
    case_table,
    description,
    difference,
    first_verdicts,
    judge,
    judged_metrics,
    knowledge_table,
    known_by,
    summary_table,
)
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.figure_style import drawing, file_of, new_figure, scale_by_size, whisker
from t3mpc_ros.evaluation.loop import MethodSpec, NodeMethod
from t3mpc_ros.evaluation.run_record import METRICS, VARIATION
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.parameters.version_and_commit import machine, provenance
from t3mpc_ros.version import VERSION


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
