# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tables, page, picture and JSON of a comparison of path trackers."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

from t3mpc_ros.evaluation.confidence_intervals import Difference, interval, mean, paired
from t3mpc_ros.evaluation.patrol.path_tracking import (
    ARRIVED,
    OURS,
    TRACKED_PATHS,
    TUNING_SEEDS,
    TrackingPlan,
    TrackingResults,
    TrackingRun,
)
from t3mpc_ros.evaluation.plotting import TitledDrawing, new_figure
from t3mpc_ros.evaluation.reporting import (
    EMPTY_CELL,
    Block,
    Contents,
    Heading,
    Mark,
    Paragraph,
    Picture,
    Table,
    format_interval,
    html_page,
)
from t3mpc_ros.version import VERSION

BETTER, WORSE, INCONCLUSIVE = 'ours is better', 'ours is worse', 'inconclusive'
_KINDS = {BETTER: 'yes', WORSE: 'no', INCONCLUSIVE: 'open'}
_DRAWN = {OURS: '#be123c', 'pure pursuit': '#0284c7', 'regulated pure pursuit': '#65a30d'}


def verdict(difference: Difference) -> str:
    """Return what the error of a method above ours says."""
    if not difference.certain:
        return INCONCLUSIVE
    return BETTER if difference.mean > 0.0 else WORSE


def path_table(path: str, runs: Mapping[str, Sequence[TrackingRun]]) -> Table:
    """Return errors, time and verdict of each method on a path."""
    head = ['method', 'error rms, mm', 'largest, mm', 'from the timed reference rms, mm']
    head += ['time, s', 'commands within the limits']
    if OURS in runs:
        head += ['rms above ours, mm', 'verdict']
    rows = []
    for name, each in runs.items():
        row: list[str | Mark] = [name]
        for value in (_cross_track, _largest, _timed):
            row.append(_cell([1e3 * value(run) for run in each]))
        row.append(_time([run.time for run in each]))
        row.append('yes' if all(run.within_limits for run in each) else 'no')
        if name == OURS:
            row += [EMPTY_CELL, EMPTY_CELL]
        elif OURS in runs:
            found = paired(
                [1e3 * run.cross_track for run in each],
                [1e3 * run.cross_track for run in runs[OURS]],
            )
            judged = verdict(found)
            row += [format_interval(found.mean, found.half, '+', 2), Mark(judged, _KINDS[judged])]
        rows.append(tuple(row))
    return Table(path.capitalize(), head, rows, (OURS,), wrap=True)


def _cross_track(run: TrackingRun) -> float:
    return run.cross_track


def _largest(run: TrackingRun) -> float:
    return run.largest


def _timed(run: TrackingRun) -> float:
    return run.timed


def _cell(values: Sequence[float]) -> str:
    if not all(map(math.isfinite, values)):
        return EMPTY_CELL
    return format_interval(mean(values), interval(values), digits=2)


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
        f'within 5 mrad. Every method plans at most {plan.limits.linear:g} m/s, and all '
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


def markdown(plan: TrackingPlan, results: TrackingResults) -> str:
    """Return all tables in Markdown."""
    tables = [path_table(path, runs).markdown() for path, runs in results.items()]
    return '\n\n'.join([description(plan), *tables, EXPLANATION])


def page(plan: TrackingPlan, results: TrackingResults, drawn: Mapping[str, bytes]) -> str:
    """Return the page as self-contained HTML, with the picture (PNG) by its stem."""
    blocks: list[Block] = [Contents(), Paragraph(description(plan))]
    if 'tracks' in drawn:
        blocks.append(Picture(PICTURES[0].title, drawn['tracks'], PICTURES[0].title))
    for path, runs in results.items():
        blocks += [Heading(path.capitalize()), path_table(path, runs)]
    blocks.append(Paragraph(EXPLANATION, 'quiet'))
    return html_page('Path tracking compared', blocks)


def tuning_markdown(found: Mapping[str, Sequence[tuple[str, float]]]) -> str:
    """Return the choices of :func:`.path_tracking.tune_trackers` as tables in Markdown."""
    tables = [
        Table(
            f'{name}, seeds {TUNING_SEEDS[0]} to {TUNING_SEEDS[-1]}',
            ('choice', 'error rms, mm'),
            [(choice, f'{1e3 * error:.2f}') for choice, error in each],
        ).markdown()
        for name, each in found.items()
    ]
    return '\n\n'.join(tables)


def record(plan: TrackingPlan, results: TrackingResults) -> dict[str, Any]:
    """Return plan and every number for a JSON file."""
    return {
        'format': 1,
        'version': VERSION,
        'seeds': list(plan.seeds),
        'limits': plan.limits.to_dict(),
        'paths': {
            path: {
                method: [_numbers(run) for run in each] for method, each in runs.items()
            }
            for path, runs in results.items()
        },
    }  # fmt: skip


def _numbers(run: TrackingRun) -> dict[str, Any]:
    return {name: value for name, value in run._asdict().items() if name != 'track'}


def draw_tracks(results: TrackingResults) -> Any:
    """Return each path with the drives of ours and of the baselines, first seed."""
    figure = new_figure(6.4)
    axes = figure.subplots(2, 2, squeeze=False).ravel()
    for axis in axes[len(results) :]:
        axis.set_visible(False)
    for axis, (path, runs) in zip(axes, results.items(), strict=False):
        axis.plot(*TRACKED_PATHS[path]().T, color='#9ca3af', linewidth=2.5, label='path')
        for method, colour in _DRAWN.items():
            if method in runs:
                axis.plot(*runs[method][0].track.T, color=colour, linewidth=0.9, label=method)
        axis.set_title(path)
        axis.set_aspect('equal', adjustable='datalim')
        axis.set(xlabel='x / m', ylabel='y / m')
    axes[0].legend(loc='upper left')
    return figure


PICTURES = (TitledDrawing('tracks', 'Drives of the first seed', draw_tracks),)
