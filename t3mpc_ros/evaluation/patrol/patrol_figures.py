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
"""Pictures of patrols: heat map, path with obstacles and sensor hits, coverage, predictability."""

from collections.abc import Sequence
from itertools import cycle
import math
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.patrol.patrol_comparison import OURS, PatrolStudy
from t3mpc_ros.evaluation.patrol.predictability import HORIZONS
from t3mpc_ros.evaluation.plotting import TitledDrawing, draw_world, new_figure
from t3mpc_ros.evaluation.result_file import Row
from t3mpc_ros.simulation.world import World

PALETTE = (
    '#be123c', '#0284c7', '#65a30d', '#7c3aed', '#a16207', '#15803d', '#4338ca', '#6b7280'
)  # fmt: skip
"""Colours of the paths, ours first."""
_MOST_HITS = 4000


def draw_heat_maps(study: PatrolStudy) -> Any:
    """Return the time spent in each cell of each path, relative to an even spread."""
    figure, panels = _panels(study)
    left, bottom, right, top = study.plan.arena
    image = None
    for axis, row in panels:
        dwell = np.array(row['dwell'])
        image = axis.imshow(
            dwell / max(float(np.nanmean(dwell)), 1e-9),
            origin='lower',
            extent=(left, right, bottom, top),
            cmap='Blues',
            vmin=0.0,
            vmax=3.0,
        )
        _draw_room(axis, study.world)
        axis.grid(False)
    bar = figure.colorbar(image, ax=figure.axes, shrink=0.7, extend='max')
    bar.set_label('time in the cell / even share')
    return figure


def draw_paths(study: PatrolStudy) -> Any:
    """Return the path of each, with walls, boxes and where the range sensors hit."""
    figure, panels = _panels(study)
    for axis, row in panels:
        hits = np.reshape(row['hits'], (-1, 2))
        hits = hits[:: max(1, len(hits) // _MOST_HITS)]
        axis.plot(*hits.T, '.', color='#f59e0b', markersize=0.8, rasterized=True)
        axis.plot(*np.transpose(row['track']), color='#0284c7', linewidth=0.5)
        _draw_room(axis, study.world)
        axis.set_aspect('equal')
    return figure


def draw_coverage(study: PatrolStudy) -> Any:
    """Return the share of cells entered over time, the mean of the seeds."""
    figure = new_figure(3.2)
    axis = figure.subplots()
    for name, style in _styles(study.plan.paths):
        curve = np.mean(study.table.values('curve', controller=name), axis=0)
        time = np.linspace(0.0, study.plan.duration / 60.0, curve.size)
        axis.plot(time, 100.0 * curve, **style)
    axis.axhline(90.0, color='#9ca3af', linewidth=0.8, linestyle=(0, (4, 3)))
    axis.set(xlabel='time / min', ylabel='cells entered / %', ylim=(0.0, 101.0))
    axis.legend(ncols=2, loc='lower right')
    return figure


def draw_predictability(study: PatrolStudy) -> Any:
    """Return the skill of the observer over the horizon, with 95 % intervals over the seeds.

    None for patrols that are too short.
    """
    columns = [f'skill_{horizon:g}' for horizon in HORIZONS]
    if not all(columns[0] in row for row in study.table):
        return None
    figure = new_figure(3.2)
    axis = figure.subplots()
    for place, (name, style) in enumerate(_styles(study.plan.paths)):
        values = [study.table.values(column, controller=name) for column in columns]
        halves = [half if math.isfinite(half := interval(row)) else 0.0 for row in values]
        # Side by side, so that the intervals do not cover each other.
        places = np.array(HORIZONS) * (1.0 + 0.012 * (place - 0.5 * len(study.plan.paths)))
        means = [mean(row) for row in values]
        axis.errorbar(places, means, halves, marker='o', markersize=3, capsize=2, **style)
    axis.set_xscale('log')
    axis.set_xticks(HORIZONS, [f'{horizon:g}' for horizon in HORIZONS])
    axis.minorticks_off()
    axis.set(xlabel='horizon / s', ylabel='skill of the observer', ylim=(-0.03, 1.03))
    axis.legend(ncols=2, loc='lower left')
    return figure


PICTURES = (
    TitledDrawing('coverage', 'Coverage over time', draw_coverage),
    TitledDrawing('heat_maps', 'Time in the cells, first seed', draw_heat_maps),
    TitledDrawing(
        'predictability',
        'Skill of an observer who watched the first half',
        draw_predictability,
    ),
    TitledDrawing('paths', 'Paths, first seed; orange: hits of the range sensors', draw_paths),
)


def _panels(study: PatrolStudy, columns: int = 2) -> tuple[Any, list[tuple[Any, Row]]]:
    """Return a figure, and an axis with its row for each patrol that is drawn."""
    drawn = [row for row in study.table if 'track' in row]
    columns = min(columns, len(drawn))
    rows = -(-len(drawn) // columns)
    left, bottom, right, top = study.plan.arena
    figure = new_figure(0.4 + rows * (0.35 + 5.0 / columns * (top - bottom) / (right - left)))
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axis, row in zip(axes, drawn, strict=False):
        axis.set_title(row['controller'])
    for axis in axes[len(drawn) :]:
        axis.set_visible(False)
    return figure, list(zip(axes, drawn, strict=False))


def _draw_room(axis: Any, world: World | None) -> None:
    if world is None:
        return
    draw_world(axis, world)
    points = world.segments.reshape(-1, 2)
    low, high = points.min(axis=0) - 0.1, points.max(axis=0) + 0.1
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _styles(paths: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Return the paths with label, colour and width of their lines."""
    return [
        (name, {'label': name, 'color': colour, 'linewidth': 1.8 if name == OURS else 1.0})
        for name, colour in zip(paths, cycle(PALETTE), strict=False)
    ]
