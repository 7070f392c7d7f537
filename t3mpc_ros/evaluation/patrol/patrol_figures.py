# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of patrols: heat map, path with obstacles and sensor hits, coverage, predictability."""

from collections.abc import Mapping, Sequence
import math
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.patrol.coverage import visits
from t3mpc_ros.evaluation.patrol.patrol_comparison import (
    OURS,
    PatrolPlan,
    PatrolTrack,
    Results,
)
from t3mpc_ros.evaluation.plotting import TitledDrawing, draw_world, new_figure

PALETTE = (
    '#be123c', '#0284c7', '#65a30d', '#7c3aed', '#a16207', '#15803d', '#4338ca', '#6b7280'
)  # fmt: skip
"""Colours of the paths, ours first."""
_MOST_HITS = 4000


class Comparison(NamedTuple):
    """What the pictures are drawn of."""

    plan: PatrolPlan
    results: Results

    @property
    def tracks(self) -> dict[str, PatrolTrack]:
        """Tracks of the first seed by path."""
        return {name: track for name, each in self.results.items() if (track := each[0].track)}


def draw_heat_maps(compared: Comparison) -> Any:
    """Return the time spent in each cell of each path, relative to an even spread."""
    return heat_maps(compared.tracks)


def draw_paths(compared: Comparison) -> Any:
    """Return the path of each, with walls, boxes and where the range sensors hit."""
    return path_panels(compared.tracks)


def heat_maps(tracks: Mapping[str, PatrolTrack]) -> Any:
    """Return the time spent in each cell of each track, relative to an even spread."""
    figure, axes = _grid_of_panels(tracks)
    image = None
    for axis, (name, track) in zip(axes, tracks.items(), strict=False):
        x, y = track.position.T
        dwell = visits(track.time, x, y, track.grid).dwell
        even = dwell.sum() / track.grid.free.sum()
        shown = np.where(track.grid.free, dwell / max(even, 1e-9), math.nan)
        (left, bottom), (right, top) = track.grid.low, track.grid.high
        image = axis.imshow(
            shown,
            origin='lower',
            extent=(left, right, bottom, top),
            cmap='Blues',
            vmin=0.0,
            vmax=3.0,
        )
        _walls(axis, track)
        axis.set_title(name)
        axis.grid(False)
    if image is not None:
        bar = figure.colorbar(image, ax=axes.tolist(), shrink=0.7, extend='max')
        bar.set_label('time in the cell / even share')
    return figure


def path_panels(tracks: Mapping[str, PatrolTrack]) -> Any:
    """Return the path of each track, with walls, boxes and where the range sensors hit."""
    figure, axes = _grid_of_panels(tracks)
    for axis, (name, track) in zip(axes, tracks.items(), strict=False):
        hits = track.hits[:: max(1, len(track.hits) // _MOST_HITS)]
        axis.plot(*hits.T, '.', color='#f59e0b', markersize=0.8, rasterized=True)
        axis.plot(*track.position.T, color='#0284c7', linewidth=0.5)
        _walls(axis, track)
        axis.set_title(name)
        axis.set_aspect('equal')
    return figure


def draw_coverage(compared: Comparison) -> Any:
    """Return the share of cells entered over time, the mean of the seeds."""
    plan, results = compared
    figure = new_figure(3.2)
    axis = figure.subplots()
    for (name, each), colour in zip(results.items(), _colours(results), strict=True):
        curve = np.mean([result.curve for result in each], axis=0)
        time = np.linspace(0.0, plan.duration / 60.0, curve.size)
        axis.plot(time, 100.0 * curve, color=colour, label=name, linewidth=_width(name))
    axis.axhline(90.0, color='#9ca3af', linewidth=0.8, linestyle=(0, (4, 3)))
    axis.set(xlabel='time / min', ylabel='cells entered / %', ylim=(0.0, 101.0))
    axis.legend(ncols=2, loc='lower right')
    return figure


def draw_predictability(compared: Comparison) -> Any:
    """Return the skill of the observer over the horizon, with 95 % intervals over the seeds.

    None for patrols that are too short.
    """
    results = compared.results
    if not all(one.metrics.skills for each in results.values() for one in each):
        return None
    figure = new_figure(3.2)
    axis = figure.subplots()
    count = len(results)
    for place, ((name, each), colour) in enumerate(
        zip(results.items(), _colours(results), strict=True)
    ):
        horizons = [skill.horizon for skill in each[0].metrics.skills]
        values = [[one.metrics.skill(horizon) for one in each] for horizon in horizons]
        means = [mean(row) for row in values]
        halves = [half if math.isfinite(half := interval(row)) else 0.0 for row in values]
        # Side by side, so that the intervals do not cover each other.
        places = np.array(horizons) * (1.0 + 0.012 * (place - 0.5 * count))
        axis.errorbar(
            places,
            means,
            halves,
            color=colour,
            label=name,
            linewidth=_width(name),
            marker='o',
            markersize=3,
            capsize=2,
        )
    axis.set_xscale('log')
    axis.set_xticks([1.0, 2.0, 5.0, 10.0], ['1', '2', '5', '10'])
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


def _grid_of_panels(tracks: Mapping[str, PatrolTrack], columns: int = 2) -> tuple[Any, Any]:
    columns = min(columns, len(tracks))
    rows = -(-len(tracks) // columns)
    track = next(iter(tracks.values()))
    width, height = np.subtract(track.grid.high, track.grid.low)
    figure = new_figure(0.4 + rows * (0.35 + 5.0 / columns * height / width))
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axis in axes[len(tracks) :]:
        axis.set_visible(False)
    return figure, axes


def _walls(axis: Any, track: PatrolTrack) -> None:
    if track.world is None:
        return
    draw_world(axis, track.world)
    points = track.world.segments.reshape(-1, 2)
    low, high = points.min(axis=0) - 0.1, points.max(axis=0) + 0.1
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _colours(results: Results) -> Sequence[str]:
    return [PALETTE[k % len(PALETTE)] for k in range(len(results))]


def _width(name: str) -> float:
    return 1.8 if name == OURS else 1.0
