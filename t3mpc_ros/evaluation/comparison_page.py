# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tables, HTML page and JSON record of a comparison."""

from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.cases import CASES, NOMINAL
from t3mpc_ros.evaluation.comparison import ComparisonPlan
from t3mpc_ros.evaluation.confidence_intervals import Difference, interval, mean
from t3mpc_ros.evaluation.drivers import MethodSpec, NodeMethod
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.methods import FEED_FORWARD, FULL, TWIN_ADVANCE
from t3mpc_ros.evaluation.metrics import (
    DRIFT,
    METRICS,
    OVERALL,
    SETTLED,
    START,
    STOPPED,
    YAW_RATE,
    YAW_RATE_SETTLED,
    Metric,
)
from t3mpc_ros.evaluation.plotting import new_figure, png_of
from t3mpc_ros.evaluation.reporting import (
    EMPTY_CELL,
    Block,
    Contents,
    Heading,
    Paragraph,
    Picture,
    Table,
    format_interval,
    html_page,
)
from t3mpc_ros.evaluation.scenario import (
    HELD_OUT_SEEDS,
    PRETRAINING_SEEDS,
    TUNING_SEEDS,
    Scenario,
)
from t3mpc_ros.version import VERSION

BETTER, WORSE, INCONCLUSIVE = 'better', 'worse', 'inconclusive'
"""Verdicts on a paired difference: its 95 % interval lies below zero, above it, or contains it."""
OWN_KNOWLEDGE = (
    'the Observation of each step: estimated speeds and disturbance, reference, and with preview '
    'the reference 0.4 s ahead; a class with an argument model: the nominal model'
)
"""What a controller of one's own knows."""


def difference(
    plan: ComparisonPlan, results: ResultTable, case: str, method: str, metric: Metric
) -> Difference | None:
    """Return the paired difference from the method of reference; None for itself or without it."""
    first, second = ({'controller': name, 'case': case} for name in (method, plan.against))
    return None if first == second else results.difference(metric.name, first, second)


def verdict(found: Difference) -> str:
    """Return the verdict on a paired difference; a run that diverged is worse."""
    if math.isnan(found.mean):
        return WORSE
    if not found.certain:
        return INCONCLUSIVE
    return BETTER if found.mean < 0.0 else WORSE


def judged_metrics(case: str) -> tuple[Metric, ...]:
    """Return the metrics that decide a case: of the wheels, or of the body if it is unknown."""
    if CASES[case].gyro:
        return YAW_RATE_SETTLED, YAW_RATE, DRIFT
    return SETTLED, OVERALL


def summary_table(plan: ComparisonPlan, results: ResultTable) -> Table:
    """Return the first judged metric of every method and case, with its verdict."""
    rows = []
    for method in plan.methods:
        cells = [method]
        for case in plan.cases:
            metric = judged_metrics(case)[0]
            found = difference(plan, results, case, method, metric)
            average = mean(results.values(metric.name, case=case, controller=method))
            text = 'diverged' if math.isnan(average) else f'{average:.{metric.digits}f}'
            cells.append(text if found is None else f'{text} {verdict(found)}')
        rows.append(tuple(cells))
    body = [case for case in plan.cases if judged_metrics(case)[0] is not SETTLED]
    title = 'Settled RMSE of the wheel speeds, rad/s'
    if body:
        title += f' ({", ".join(body)}: of the yaw rate of the body)'
    title += f'; verdict against {plan.against}'
    return Table(title, ('method', *plan.cases), rows, (FULL,), wrap=True)


def case_table(plan: ComparisonPlan, results: ResultTable, case: str) -> Table:
    """Return every metric of a case, and the paired differences of those that decide it."""
    first = results.where(case=case, controller=next(iter(plan.methods)))[0]
    metrics = [
        metric
        for metric in METRICS
        if metric.name in first
        and (
            metric is not STOPPED
            or any(each > 0.0 for each in results.values(STOPPED.name, case=case))
        )
    ]
    judged = judged_metrics(case)
    head = ['method', *(f'{metric.heading}, {metric.unit}' for metric in metrics)]
    compared = plan.against in plan.methods and len(plan.methods) > 1
    if compared:
        for metric in judged:
            head += [f'{metric.heading} − {plan.against}', 'verdict']
    rows = []
    for method in plan.methods:
        cells = [method]
        for metric in metrics:
            numbers = results.values(metric.name, case=case, controller=method)
            cells.append(format_interval(mean(numbers), interval(numbers), '', metric.digits))
        for metric in judged if compared else ():
            found = difference(plan, results, case, method, metric)
            if found is None:
                cells += [EMPTY_CELL, EMPTY_CELL]
            else:
                text = format_interval(found.mean, found.half, '+', metric.digits)
                cells += [text, verdict(found)]
        rows.append(tuple(cells))
    title = f'{case}: {CASES[case].text}'
    return Table(title, head, rows, (FULL,), wrap=True)


def knowledge_table(plan: ComparisonPlan) -> Table:
    """Return what each kind of method knows."""
    rows = {
        'all': 'noise variance, limits, lag and dead time of the estimator (the true dead time '
        'only where the case says that it is known); state estimate and limits are the same for '
        'all',
        'with preview': 'the reference 0.4 s ahead: feed-forward, full, and what has preview in '
        'its name or is an NMPC',
        'predictive with preview': 'a model with 1.3 times the inertia of the body; "exact '
        'model": that of the nominal robot',
    }
    if plan.scenario.robot == 'twin':
        scenario = Scenario('twin', 'nominal', 0)
        model = scenario.nominal_model()
        gyro = [name for name in plan.cases if plan.scenario.gyro or CASES[name].gyro] or [
            'no case'
        ]
        rows |= {
            FULL: 'the controller of the node with the parameters of the node for this robot, and '
            'no learnt weights at the start; likewise with a part left out. It receives the '
            'odometry as it is published: wheel speeds of the step counters, and a pose whose yaw '
            'contains the gyro',
            FEED_FORWARD: f'no measurement; the reference {1e3 * TWIN_ADVANCE:g} ms beyond the '
            'dead time',
            'baselines': 'parameters tuned for this robot, with equal effort (t3mpc tune --robot '
            'twin); no learnt weights at the start. The model is '
            f'a servo with a lag of {1e3 * model.lag:g} ms without friction, which is exact for '
            'a stepper motor but for the oscillation of its rotor',
            'gyro': f'{", ".join(gyro)}: every baseline takes the difference of its wheel speeds '
            'from the yaw of the odometry, which contains the gyro; in other cases from the step '
            'counters',
        }
    else:
        rows |= {
            FULL: 'the tuned parameters of this drive, and the weights of three pretraining runs '
            'on the nominal robot; its stages and ablations likewise',
            FEED_FORWARD: 'no measurement',
            'baselines': 'the tuned parameters of this drive, with equal effort; adaptive ones '
            'start with the weights of the same pretraining runs',
        }
    own = [
        name
        for name, method in plan.methods.items()
        if not isinstance(method, MethodSpec | NodeMethod)
    ]
    if own:
        rows[', '.join(own)] = OWN_KNOWLEDGE
    return Table(
        'What each method knows', ('method', 'knows'), list(rows.items()), text=2, wrap=True
    )


def description(plan: ComparisonPlan) -> str:
    """Return in one paragraph what was run and how it is counted."""
    seeds = ', '.join(map(str, plan.seeds))
    outside = ' (none is used for tuning or in another table)' if _are_outside(plan.seeds) else ''
    text = (
        f'{plan.scenario.text}, {plan.scenario.duration:g} s, '
        f'noise variance {plan.scenario.noise:g} (rad/s)², '
        f'seeds {seeds}{outside}. '
        'True wheel speeds against the reference; mean ± half the 95 % interval over the seeds. '
    )
    kind = plan.scenario.kind
    before, after = kind.settling
    text += (
        f'The first {START:g} s of control do not count. Settled: without {before:g} s before and '
        f'{after:g} s after each switch. '
    )
    if kind.has_gyro:
        text += (
            'Yaw rate and yaw drift are those of the body, from ground truth, against the '
            'reference; the drift is that at the end. '
        )
    return text + (
        'Variation: total variation of the commanded acceleration per second and wheel. '
        f'Differences from {plan.against} are paired by seed; better or worse: their 95 % '
        'interval excludes zero.'
    )


def _are_outside(seeds: Sequence[int]) -> bool:
    return not {*seeds} & {*TUNING_SEEDS, *PRETRAINING_SEEDS, *HELD_OUT_SEEDS}


def markdown(plan: ComparisonPlan, results: ResultTable) -> str:
    """Return all tables in Markdown."""
    tables = [
        summary_table(plan, results),
        *(case_table(plan, results, case) for case in plan.cases),
        knowledge_table(plan),
    ]
    return '\n\n'.join([description(plan), *(table.markdown() for table in tables)])


def page(plan: ComparisonPlan, results: ResultTable) -> str:
    """Return the page as self-contained HTML."""
    blocks: list[Block] = []
    caption = f'Difference from {plan.against}, with 95 % interval'
    for case in plan.cases:
        blocks.append(Heading(case))
        if picture := png_of(lambda of: _draw_differences(plan, results, of), case):
            blocks.append(Picture(f'{caption}: {case}', picture, caption))
        if case == plan.cases[0]:
            blocks += [Contents(), Paragraph(description(plan)), summary_table(plan, results)]
        blocks.append(case_table(plan, results, case))
    blocks += [Heading('What each method knows'), knowledge_table(plan)]
    return html_page(f'Comparison of methods: {plan.scenario.robot}', blocks)


def record(plan: ComparisonPlan, results: ResultTable) -> dict[str, Any]:
    """Return plan, runs and differences for a JSON file; NaN where a run diverged."""
    cases: dict[str, Any] = {}
    for case in CASES:
        if case in plan.cases:
            found = {name: _method_record(plan, results, case, name) for name in plan.methods}
            cases[case] = {'text': CASES[case].text, 'methods': found}
    return {
        'format': 1,
        'version': VERSION,
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
    differences = {}
    for metric in METRICS:
        found = difference(plan, results, case, method, metric)
        if found is not None:
            differences[metric.name] = {
                'mean': found.mean,
                'half_interval': found.half,
                'verdict': verdict(found),
            }
    return {
        'mean': {name: mean([run[name] for run in runs]) for name in names},
        'runs': [{name: run[name] for name in names} for run in runs],
        f'difference_from_{plan.against.replace("-", "_")}': differences,
    }


def _draw_differences(plan: ComparisonPlan, results: ResultTable, case: str) -> Any:
    """Return a figure of the paired differences of the first judged metric, or None."""
    metric = judged_metrics(case)[0]
    rows: Sequence[tuple[str, Difference]] = [
        (method, found)
        for method in plan.methods
        if (found := difference(plan, results, case, method, metric)) and math.isfinite(found.mean)
    ]
    if not rows:
        return None
    figure = new_figure(0.9 + 0.2 * len(rows))
    axis = figure.subplots()
    places = np.arange(len(rows))[::-1]
    colours = {BETTER: '#15803d', WORSE: '#be123c', INCONCLUSIVE: '#6b7280'}
    for place, (_, found) in zip(places, rows, strict=True):
        half = found.half if math.isfinite(found.half) else 0.0
        colour = colours[verdict(found)]
        axis.errorbar(found.mean, place, xerr=half, fmt='o', color=colour, markersize=4)
    axis.axvline(0.0, color='#1f2937', linewidth=0.8)
    axis.set_yticks(places, [name for name, _ in rows])
    axis.set_xscale('symlog', linthresh=0.01)
    axis.set_xlabel(f'{metric.heading} / ({metric.unit})')
    return figure
