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
"""Tables, page, picture and JSON of a comparison of path trackers."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np

from t3mpc_ros.evaluation import html_page, result_output
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean
from t3mpc_ros.evaluation.figure_style import TitledDrawing, new_figure
from t3mpc_ros.evaluation.patrol.path_tracker_comparison import (
    ARRIVED,
    OURS,
    TRACKED_PATHS,
    TUNING_SEEDS,
    TrackingPlan,
    TrackingStudy,
)
from t3mpc_ros.evaluation.patrol.patrol_run import LIMITS
from t3mpc_ros.version import VERSION

VERDICTS = {1: 'ours is better', -1: 'ours is worse', 0: 'inconclusive'}
"""By the sign of how much the error of a method is above ours."""
_DRAWN = {OURS: '#be123c', 'pure pursuit': '#0284c7', 'regulated pure pursuit': '#65a30d'}


def path_table(study: TrackingStudy, path: str) -> result_output.Table:
    """Return errors, time and verdict of each method on a path."""
    head = ['method', 'error rms, mm', 'largest, mm', 'from the timed reference rms, mm']
    head += ['time, s', 'commands within the limits']
    compared = OURS in study.plan.methods
    if compared:
        head += ['rms above ours, mm', 'verdict']
    lines = []
    for name in study.plan.methods:
        rows = study.table.where(path=path, controller=name)
        line: list[str | result_output.Mark] = [name]
        for column in ('cross_track', 'largest', 'timed'):
            line.append(result_output.format_mean([1e3 * row[column] for row in rows], 2))
        line.append(_time([row['time'] for row in rows]))
        line.append('yes' if all(row['within_limits'] for row in rows) else 'no')
        own = {'path': path, 'controller': OURS}
        above = study.table.difference('cross_track', {**own, 'controller': name}, own)
        if name == OURS:
            line += [result_output.EMPTY_CELL, result_output.EMPTY_CELL]
        elif above is not None:
            difference = format_interval(1e3 * above.mean, 1e3 * above.half, '+', 2)
            line += [difference, result_output.verdict_mark(VERDICTS[above.sign])]
        lines.append(line)
    return result_output.Table(path.capitalize(), head, lines, (OURS,), wrap=True)


def summary_table(study: TrackingStudy) -> result_output.Table:
    """Return the rms error and the verdict of each method on each path."""
    lines = []
    for name in study.plan.methods:
        line = [name]
        for path in study.plan.paths:
            errors = [
                1e3 * row['cross_track'] for row in study.table.where(path=path, controller=name)
            ]
            own = {'path': path, 'controller': OURS}
            above = study.table.difference('cross_track', {**own, 'controller': name}, own)
            judged = f'; {VERDICTS[above.sign]}' if name != OURS and above is not None else ''
            line.append(result_output.format_mean(errors, 2) + judged)
        lines.append(line)
    return result_output.Table(
        'Error rms, mm; verdict', ('method', *study.plan.paths), lines, (OURS,)
    )


def _time(times: Sequence[float]) -> str:
    arrived = [time for time in times if math.isfinite(time)]
    if len(arrived) == len(times):
        return format_interval(mean(times), interval(times), digits=1)
    return f'arrived in {len(arrived)} of {len(times)}'


def description(plan: TrackingPlan) -> str:
    """Return in one paragraph what was driven and how it is counted."""
    seeds = len(plan.seeds)
    return (
        'Digital twin with noise, lag, two slippery patches on each path and 10 % of the commands '
        'lost; dead time 0 to 30 ms above the nominal 10 ms, right wheel within 0.5 % and wheel '
        'separation within 1 % of nominal, drawn from the seed; position given within 3 mm, yaw '
        f'within 5 mrad. Every method plans at most {LIMITS.linear:g} m/s, and all '
        f'commands have the limits of the controller. {seeds} seed{"s" * (seeds > 1)}, '
        f'{plan.seeds[0]} to {plan.seeds[-1]}; mean ± half the 95 % interval. Error: distance of '
        'the true position from the path, each piece of the drive counted by its length; largest: '
        'of the drive from the path or of the path from the drive, so that a corner that is cut '
        'counts. The timed reference is that of ours, pure pursuit has none. Time: until the '
        f'robot stays within {1e3 * ARRIVED:g} mm of the goal.'
    )


EXPLANATION = (
    'The verdict compares rms errors seed by seed. Each of its intervals is a 95 % interval by '
    'itself: of twenty comparisons of equal methods, one would be wrong. Errors alone are '
    'compared, not time: ours stops at corners and turns on the spot.'
)


def markdown(study: TrackingStudy) -> str:
    """Return all tables in Markdown."""
    tables = [summary_table(study), *(path_table(study, path) for path in study.plan.paths)]
    texts = [table.markdown() for table in tables]
    return '\n\n'.join([description(study.plan), *texts, EXPLANATION])


def page(study: TrackingStudy, drawn: Mapping[str, bytes]) -> str:
    """Return the page as self-contained HTML, with the pictures by their stems."""
    blocks: list[html_page.Block] = [
        html_page.Contents(),
        html_page.Paragraph(description(study.plan)),
    ]
    if 'tracks' in drawn:
        blocks.append(html_page.Picture(PICTURES[0].title, drawn['tracks'], PICTURES[0].title))
    for path in study.plan.paths:
        blocks += [html_page.Heading(path.capitalize()), path_table(study, path)]
    blocks.append(html_page.Paragraph(EXPLANATION, 'quiet'))
    return html_page.html_page('Path tracking compared', blocks)


def tuning_markdown(found: Mapping[str, Sequence[tuple[str, float]]]) -> str:
    """Return the choices of :func:`.path_tracker_comparison.tune_trackers` in Markdown."""
    tables = [
        result_output.Table(
            f'{name}, seeds {TUNING_SEEDS[0]} to {TUNING_SEEDS[-1]}',
            ('choice', 'error rms, mm'),
            [(choice, f'{1e3 * error:.2f}') for choice, error in each],
        ).markdown()
        for name, each in found.items()
    ]
    return '\n\n'.join(tables)


def record(study: TrackingStudy) -> dict[str, Any]:
    """Return plan and every number for a JSON file."""
    plan = study.plan
    numbers = ('cross_track', 'largest', 'timed', 'time', 'speed', 'acceleration')
    return {
        'format': 1,
        'version': VERSION,
        'seeds': list(plan.seeds),
        'limits': LIMITS.to_dict(),
        'paths': {
            path: {
                method: [
                    {name: row[name] for name in numbers}
                    for row in study.table.where(path=path, controller=method)
                ]
                for method in plan.methods
            }
            for path in plan.paths
        },
    }


def draw_tracks(study: TrackingStudy) -> Any:
    """Return each path with the drives of ours and of the baselines, first seed."""
    figure, axes = new_figure(6.4, (2, 2))
    axes = axes.ravel()
    for axis in axes[len(study.plan.paths) :]:
        axis.set_visible(False)
    for axis, path in zip(axes, study.plan.paths, strict=False):
        axis.plot(*TRACKED_PATHS[path]().T, color='#9ca3af', linewidth=2.5, label='path')
        for method, colour in _DRAWN.items():
            for track in study.table.values('track', path=path, controller=method):
                axis.plot(*np.transpose(track), color=colour, linewidth=0.9, label=method)
        axis.set_title(path)
        axis.set_aspect('equal', adjustable='datalim')
        axis.set(xlabel='x / m', ylabel='y / m')
    axes[0].legend(loc='upper left')
    return figure


PICTURES = (TitledDrawing('tracks', 'Drives of the first seed', draw_tracks),)
