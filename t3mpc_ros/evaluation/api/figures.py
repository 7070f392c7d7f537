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
"""Figures of the results of a script."""

from collections.abc import Callable, Mapping
import os
from typing import Any

import matplotlib
import numpy as np

from t3mpc_ros.evaluation import plotting
from t3mpc_ros.evaluation.api.result_tables import writable
from t3mpc_ros.evaluation.charts import thinned
from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.topic_roles import REFERENCE, TRUTH
from t3mpc_ros.geometry.types import Array


def drawn(draw: Callable[[], Any], path: str | os.PathLike[str] | None) -> Any:
    """Return a figure in the style of the package, after writing it to ``path`` if given."""
    with matplotlib.rc_context(plotting.STYLE):
        figure = draw()
    if path is not None:
        target = writable(path, *(f'.{kind}' for kind in plotting.DATES))
        target.write_bytes(plotting.file_of(figure, target.suffix.removeprefix('.')))
    return figure


def run_figure(name: str, columns: Mapping[str, Array]) -> Any:
    """Return speeds and error of each wheel over time."""
    figure, axes = plotting.new_panels(3, 1.5)
    time = columns['time']
    for axis, side in zip(axes, ('right', 'left'), strict=False):
        speed, reference = columns[f'speed_{side}'], columns[f'reference_{side}']
        axis.plot(
            *thinned(time, reference), color=plotting.COLOURS[REFERENCE], lw=1.0, label='reference'
        )
        axis.plot(*thinned(time, speed), color=plotting.COLOURS[TRUTH], lw=1.0, label=name)
        axis.set_ylabel('rad/s')
        axis.set_title(f'{side} wheel')
        error = speed - reference
        strength = 1.0 if side == 'right' else 0.45
        label = f'{side} wheel'
        axes[2].plot(
            *thinned(time, error),
            color=plotting.COLOURS['error'],
            lw=0.8,
            alpha=strength,
            label=label,
        )
    axes[2].set_title('error')
    axes[2].set_ylabel('rad/s')
    plotting.name_time(axes)
    plotting.add_legend(axes[0])
    plotting.add_legend(axes[2])
    return figure


def lines_figure(time: Array, lines: Mapping[str, Array]) -> Any:
    """Return one panel for each quantity over time."""
    figure, axes = plotting.new_panels(len(lines), 1.1)
    for axis, (name, values) in zip(axes, lines.items(), strict=True):
        axis.plot(*thinned(time, values), color=plotting.COLOURS['value'], lw=0.9)
        axis.set_title(name)
    plotting.name_time(axes)
    return figure


def plane_figure(x: Array, y: Array, names: tuple[str, str]) -> Any:
    """Return one line in the plane."""
    figure = plotting.new_figure(4.2)
    axis = figure.subplots()
    axis.plot(x, y, color=plotting.COLOURS['value'], lw=0.5)
    axis.set_xlabel(names[0])
    axis.set_ylabel(names[1])
    return figure


def sweep_figure(lines: Mapping[str, Mapping[float, list[float]]], name: str, label: str) -> Any:
    """Return means with 95 % intervals over the values of a parameter, a line for each name."""
    figure = plotting.new_figure(3.2)
    axis = figure.subplots()
    for line, values in lines.items():
        ordered = sorted(values)
        means = [mean(values[value]) for value in ordered]
        halves = [interval(values[value]) for value in ordered]
        shown = [half if np.isfinite(half) else 0.0 for half in halves]
        axis.errorbar(ordered, means, yerr=shown, marker='o', markersize=3, capsize=2, label=line)
    axis.set_xlabel(name)
    axis.set_ylabel(label)
    plotting.add_legend(axis)
    return figure
