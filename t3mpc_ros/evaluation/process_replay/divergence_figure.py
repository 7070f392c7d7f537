# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Figure of the first divergence between recorded and recomputed outputs."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.plotting import COLOURS, add_legend, name_time, new_figure, png_of
from t3mpc_ros.evaluation.process_replay.comparison import Comparison

Array = NDArray[np.float64]

BEFORE, AFTER = 0.5, 1.5
"""Half width of the zoomed window, s."""
STRIPS = 400
"""Maximum number of time bins of the overview."""


def write_divergence_figure(outcome: Comparison, path: Path) -> None:
    """Write a PNG of the first divergence of the replay from the recording."""
    content = png_of(_draw, outcome)
    if content is not None:
        path.write_bytes(content)


def _draw(outcome: Comparison) -> Any:
    first = outcome.first
    fields = [row.field for row in outcome.rows]
    figure = new_figure(2.0 + 0.16 * len(fields) + (3.6 if first else 0.0))
    if first is None:
        _overview(figure.subplots(), outcome, fields)
        figure.suptitle(outcome.verdict(), fontsize=9)
        return figure
    close, apart, all_of_it = figure.subplots(
        3, 1, height_ratios=[1.8, 1.4, 0.6 + 0.16 * len(fields)]
    )
    close.sharex(apart)
    _close_up(close, apart, outcome, first.field, first.first)
    _overview(all_of_it, outcome, fields)
    return figure


def _close_up(close: Any, apart: Any, outcome: Comparison, name: str, when: float) -> None:
    """Draw both runs around the first divergence, and their difference on a logarithmic scale."""
    time = outcome.time
    shown = (time >= when - BEFORE) & (time <= when + AFTER) & ~np.isnan(outcome.recorded[name])
    was, now = outcome.recorded[name][shown], outcome.computed[name][shown]
    # The recorded line is wide, so that it stays visible below the other.
    close.plot(time[shown], was, color=COLOURS['odom'], label='recorded', linewidth=4.0)
    close.plot(time[shown], now, color=COLOURS['error'], label='recomputed', linewidth=1.0)
    close.set_title(name)
    absolute, relative = outcome.tolerances.of(name)
    with np.errstate(invalid='ignore'):
        far = np.abs(now - was)
    allowed = np.maximum(absolute + relative * np.abs(was), 1e-18)
    # Bit-equal values have no logarithm.
    floor = 0.1 * float(allowed.min())
    apart.plot(time[shown], np.maximum(far, floor), color=COLOURS['error'], label='difference')
    apart.plot(time[shown], allowed, color=COLOURS['target'], label='tolerance')
    apart.set_yscale('log')
    apart.set_title(f'difference of {name}')
    for axis in (close, apart):
        axis.axvline(when, color=COLOURS['switch'], linewidth=0.8, linestyle=(0, (4, 3)))
        add_legend(axis)
    name_time([close, apart])
    apart.set_xlim(max(when - BEFORE, time[0]), min(when + AFTER, time[-1]))
    close.tick_params(labelbottom=False)


def _overview(axis: Any, outcome: Comparison, fields: list[str]) -> None:
    """Draw for each field where it is compared (pale) and where it exceeds its tolerance."""
    time = outcome.time
    span = max(float(time[-1] - time[0]), 1e-3)
    bins = np.minimum(((time - time[0]) / span * STRIPS).astype(int), STRIPS - 1)
    level = np.full((len(fields), STRIPS), math.nan)
    for k, name in enumerate(fields):
        there = outcome.compared & ~np.isnan(outcome.recorded[name])
        level[k] = _spread(bins[there], bins[outcome.beyond(name)])
    axis.imshow(
        level,
        aspect='auto',
        interpolation='nearest',
        extent=(float(time[0]), float(time[0]) + span, len(fields) - 0.5, -0.5),
        cmap=_colours(),
        vmin=0.0,
        vmax=1.0,
    )
    axis.set_yticks(range(len(fields)), fields, fontsize=6)
    axis.set_title('compared (pale), beyond the tolerance (dark)')
    axis.grid(visible=False)
    name_time([axis])


def _spread(there: NDArray[np.int64], beyond: NDArray[np.int64]) -> Array:
    """Return 1 where a value exceeds its tolerance, 0 where all agree, NaN where unknown.

    Values are sparser than the bins: each holds until the next.
    """
    row = np.full(STRIPS, math.nan)
    row[there] = 0.0
    row[beyond] = 1.0
    known = np.flatnonzero(~np.isnan(row))
    for place, following in zip(known, [*known[1:], STRIPS], strict=True):
        reach = min(int(following), int(place) + STRIPS // 40)
        row[place:reach] = row[place]
    return row


def _colours() -> Any:
    from matplotlib.colors import ListedColormap

    return ListedColormap(['#d1fae5', COLOURS['error']])
