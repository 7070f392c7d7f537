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
"""Style and layout of all figures."""

from collections.abc import Callable, Mapping, Sequence
import io
import math
from pathlib import Path
from typing import Any, TypeVar

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.html_page import thinned
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.simulation.world import World

Subject = TypeVar('Subject')

WIDTH = 6.2
"""Inches: narrow enough that 9-point text stays legible on a phone at half the size."""

COLOURS = {
    REFERENCE: '#1f2937',
    TRUTH: '#0284c7',
    ODOMETRY: '#7dd3fc',
    COMMAND: '#0f766e',
    'error': '#be123c',
    'estimate': '#7c3aed',
    'target': '#9ca3af',
    'fuzzy': '#7c3aed',
    'feedback': '#ea580c',
    'feedforward': '#15803d',
    'compensator': '#a16207',
    'predictive': '#db2777',
    'applied': '#0f766e',
    'value': '#4338ca',
    'switch': '#d97706',
}
"""Colours by quantity, the same in every figure."""

STYLE = {
    'font.size': 9,
    'axes.titlesize': 9,
    'axes.titlelocation': 'left',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.edgecolor': '#9ca3af',
    'axes.labelcolor': '#374151',
    'axes.grid': True,
    'grid.color': '#e5e7eb',
    'grid.linewidth': 0.6,
    'xtick.color': '#374151',
    'ytick.color': '#374151',
    'legend.frameon': False,
    'legend.fontsize': 8,
    'svg.hashsalt': 't3mpc_ros',  # no random names of parts
}


def drawing(draw: Callable[[Subject], Any], subject: Subject) -> Any:
    """Return the figure of ``subject`` in the style of the package, laid out; None without one."""
    with matplotlib.rc_context(STYLE):
        figure = draw(subject)
        if figure is not None:
            figure.set_dpi(150)
            # savefig would draw the whole figure once more for its layout.
            figure.get_layout_engine().execute(figure)
            figure.set_layout_engine('none')
        return figure


DATES = {'png': '', 'pdf': 'CreationDate', 'svg': 'Date'}
"""Kinds of files, each with what dates it and is left out: equal figures are equal files."""


def file_of(figure: Any, kind: str) -> bytes:
    """Return a figure as a file of :data:`DATES`."""
    buffer, dated = io.BytesIO(), DATES[kind]
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=150, metadata={dated: None} if dated else None)
    return buffer.getvalue()


def write_pictures(
    drawings: Mapping[str, Callable[[Subject], Any]], subject: Subject, folder: Path
) -> dict[str, bytes]:
    """Write the figures with something to draw as PNG, and return them as SVG by their stems."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for stem, draw in drawings.items():
        if (figure := drawing(draw, subject)) is not None:
            found[stem] = file_of(figure, 'svg')
            write_atomically(folder / f'{stem}.png', file_of(figure, 'png'))
    return found


def draw_world(axis: Any, world: World) -> None:
    """Draw walls, boxes, pillars and slippery floor of a world, in m."""
    for x, y, radius, _ in world.patches.tolist():
        axis.add_patch(Circle((x, y), radius, color='#fef3c7', lw=0.0))
    for x, y, radius in world.circles.tolist():
        axis.add_patch(Circle((x, y), radius, fc='#d1d5db', ec='#374151', lw=1.4))
    for x, y, length, width, yaw in world.boxes.tolist():
        left, bottom = x - 0.5 * length, y - 0.5 * width
        angle = math.degrees(yaw)
        box = Rectangle((left, bottom), length, width, angle=angle, rotation_point='center')
        box.set(color='#d1d5db', lw=0.0)
        axis.add_patch(box)
    walls = list(world.segments.reshape(-1, 2, 2))
    axis.add_collection(LineCollection(walls, colors='#374151', linewidths=1.4))


class ShownFigure(Figure):
    """A figure that a notebook shows, without a magic word that sets up pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, dpi=100)
        return buffer.getvalue()


def new_figure(height: float, shape: tuple[int, int] | None = None, **options: Any) -> Any:
    """Return a figure of ``height`` inches, independent of pyplot, and its axis.

    With a shape (rows, columns) the axes, an array of it.
    """
    figure = ShownFigure(figsize=(WIDTH, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure, figure.subplots(*shape or (1, 1), squeeze=shape is None, **options)


def new_panels(count: int, height: float) -> tuple[Any, list[Any]]:
    """Return a figure and ``count`` panels of ``height`` inches with one common time axis."""
    figure, axes = new_figure(0.7 + height * count, (count, 1), sharex=True)
    return figure, list(axes[:, 0])


def whisker(half: float) -> float:
    """Return the length of an error bar: none for a single seed, whose interval is infinite."""
    return half if math.isfinite(half) else 0.0


def mark_switches(axis: Any, times: Array) -> None:
    """Mark the switches with dashed lines."""
    style = {'color': COLOURS['switch'], 'linewidth': 0.8, 'linestyle': (0, (4, 3))}
    for switch in times:
        axis.axvline(switch, zorder=1.5, **style)


def name_time(axes: list[Any]) -> None:
    """Label the common time axis, with ticks at round numbers."""
    for axis in axes:
        axis.margins(x=0.01)
        axis.xaxis.set_major_locator(MaxNLocator(steps=(1, 2, 5, 10)))
    axes[-1].set_xlabel('time / s')


def scale_by_size(panel: Any, name: str, values: Sequence[float], near: float = 0.0) -> None:
    """Make axis ``name`` (x or y) logarithmic, if its values differ much, with plain numbers.

    With ``near`` values of both signs are shown, and those below it on a linear part.
    """
    axis = {'x': panel.xaxis, 'y': panel.yaxis}[name]
    sizes = [max(abs(value), near) for value in values if value or near]
    if not sizes or max(sizes) <= 3.0 * min(sizes):
        axis.set_major_locator(MaxNLocator(5))
        return
    scale = {'value': 'symlog', 'linthresh': near} if near else {'value': 'log'}
    {'x': panel.set_xscale, 'y': panel.set_yscale}[name](**scale)
    axis.set_major_formatter(lambda value, _: f'{value:.3g}')
    if not near:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axis.set_minor_formatter(NullFormatter())


def add_legend(axis: Any) -> None:
    """Put the legend above the axis, to the right of its title."""
    handles, labels = axis.get_legend_handles_labels()
    if handles:
        place = {'loc': 'lower right', 'bbox_to_anchor': (1.0, 1.0), 'ncols': len(labels)}
        spacing = {'borderaxespad': 0.1, 'handlelength': 1.6, 'columnspacing': 1.2}
        axis.legend(handles, labels, **place, **spacing)


def legend_above(figure: Any, *axes: Any, columns: int = 5) -> None:
    """Put the lines of some axes into one legend above all panels."""
    entries: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    columns = min(columns, len(entries))
    figure.legend(entries.values(), entries.keys(), loc='outside upper center', ncols=columns)


# -- results of scripts ---------------------------------------------------------------------------


def run_figure(name: str, columns: Mapping[str, Array]) -> Any:
    """Return speeds and error of each wheel over time."""
    figure, axes = new_panels(3, 1.5)
    time = columns['time']
    for axis, side in zip(axes, ('right', 'left'), strict=False):
        speed, reference = columns[f'speed_{side}'], columns[f'reference_{side}']
        axis.plot(*thinned(time, reference), color=COLOURS[REFERENCE], lw=1.0, label='reference')
        axis.plot(*thinned(time, speed), color=COLOURS[TRUTH], lw=1.0, label=name)
        axis.set(title=f'{side} wheel', ylabel='rad/s')
        style = {'color': COLOURS['error'], 'alpha': 1.0 if side == 'right' else 0.45}
        axes[2].plot(*thinned(time, speed - reference), lw=0.8, label=f'{side} wheel', **style)
    axes[2].set(title='error', ylabel='rad/s')
    name_time(axes)
    add_legend(axes[0])
    add_legend(axes[2])
    return figure


def lines_figure(time: Array, lines: Mapping[str, Array]) -> Any:
    """Return one panel for each quantity over time."""
    figure, axes = new_panels(len(lines), 1.1)
    for axis, (name, values) in zip(axes, lines.items(), strict=True):
        axis.plot(*thinned(time, values), color=COLOURS['value'], lw=0.9)
        axis.set_title(name)
    name_time(axes)
    return figure


def plane_figure(x: Array, y: Array, names: Sequence[str]) -> Any:
    """Return one line in the plane."""
    figure, axis = new_figure(4.2)
    axis.plot(x, y, color=COLOURS['value'], lw=0.5)
    axis.set(xlabel=names[0], ylabel=names[1])
    return figure


def sweep_figure(lines: Mapping[str, Mapping[float, list[float]]], name: str, label: str) -> Any:
    """Return means with 95 % intervals over the values of a parameter, a line for each name."""
    figure, axis = new_figure(3.2)
    for line, values in lines.items():
        ordered = sorted(values)
        means = [mean(values[value]) for value in ordered]
        shown = [whisker(interval(values[value])) for value in ordered]
        axis.errorbar(ordered, means, yerr=shown, marker='o', markersize=3, capsize=2, label=line)
    axis.set(xlabel=name, ylabel=label)
    add_legend(axis)
    return figure
