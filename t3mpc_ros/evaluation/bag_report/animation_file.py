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
"""Animation of a recorded run: floor with path and range rays, speeds against the reference.

Each frame draws only what moves, on a background that is drawn once: several times as fast as
``matplotlib.animation``, which draws every frame whole, and a quarter of the size.
"""

from collections.abc import Callable, Iterator
import math
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
import numpy as np
from PIL import Image

from t3mpc_ros.atomic_file import atomic_file
from t3mpc_ros.bag.reader import BagReader, open_bag
from t3mpc_ros.evaluation.bag_report.metrics import path_of
from t3mpc_ros.evaluation.bag_report.patrol_section import followed_reference
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, load_run
from t3mpc_ros.evaluation.bag_report.tracking_errors import tracking_error
from t3mpc_ros.evaluation.figure_style import COLOURS, STYLE, draw_world
from t3mpc_ros.evaluation.result_output import progress_bar
from t3mpc_ros.evaluation.topic_roles import REFERENCE, TRUTH, ReportError, ReportOptions
from t3mpc_ros.geometry.types import RANGE_SENSORS, Array
from t3mpc_ros.parameters.command_line import parsed_value
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.sensor_mounts import ray_ends, sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import World, recorded_world

AHEAD = 1.5
"""Time that the reference is drawn ahead of a robot that tracks speeds, s."""
_FRESH = 0.15
"""Greatest age of a range reading that is drawn, s."""
_RAY, _HIT = '#f59e0b', '#b45309'
_NUMBER_OF_COLOURS = 64


class AnimationOptions(NamedTuple):
    """Part of the run, speed and size of an animation."""

    start: float = 0.0
    """Start of the part, s since the start of the bag."""
    duration: float = math.inf
    """Duration of the part, s; at most to the end."""
    speed: float = 1.0
    """Seconds of the run in a second of the animation."""
    rate: float = 10.0
    """Frames per second of the animation."""
    width: int = 760
    """Pixels; the height is 0.52 of it."""


class RangeReadings(NamedTuple):
    """Readings of the range sensors of a run."""

    times: tuple[Array, ...]
    """s since the start of the bag, of each sensor."""
    distances: tuple[Array, ...]
    """m; inf where nothing is in range (REP 117)."""
    mounts: Array
    """x, y (m) and direction (rad) of each sensor in the body frame, shape (8, 3)."""

    def rays(self, now: float, pose: tuple[float, float, float]) -> Array:
        """Return start and end of each ray that hits at ``now``, m, shape (n, 2, 2)."""
        reach = np.full(len(self.mounts), math.nan)
        for sensor, (time, distance) in enumerate(zip(self.times, self.distances, strict=True)):
            last = int(np.searchsorted(time, now, side='right')) - 1
            if last >= 0 and now - time[last] <= _FRESH:
                reach[sensor] = distance[last]
        ends = [
            ray_ends(np.array([pose]), r[None], self.mounts)[0]
            for r in (np.zeros_like(reach), reach)
        ]
        found: Array = np.stack(ends, axis=1)[np.isfinite(reach)]
        return found


def animate_bag(
    folder: Path | str,
    output: Path,
    options: AnimationOptions | None = None,
    wanted: ReportOptions | None = None,
    *,
    progress: bool = False,
) -> Path:
    """Write the animation of a bag with a pose to ``output``, a GIF file, and return it."""
    options = options or AnimationOptions()
    if output.suffix.lower() != '.gif':
        raise ValueError(
            f'output must end in .gif: got {output.name} (other formats need another program: '
            'ffmpeg -i FILE.gif FILE.mp4)'
        )
    with open_bag(folder) as recording:
        run = load_run(recording, wanted)
        if not run.measured or len(run.motions[run.measured]) < 2:
            raise ReportError(f'{recording.folder}: the bag holds no pose: no odometry of a robot')
        ranges = read_ranges(recording, run)
        world = recorded_world(run.world)
    time = run.motions[run.measured].time
    begin = max(options.start, float(time[0]))
    end = min(begin + options.duration, float(time[-1]))
    if end <= begin:
        raise ReportError(
            f'start must be before the last pose, at {time[-1]:.1f} s: got {options.start:g} s'
        )
    count = max(2, math.floor((end - begin) / options.speed * options.rate) + 1)
    times: Array = begin + np.arange(count, dtype=np.float64) * options.speed / options.rate
    output.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar(count, 'frames', show=progress) as bar:
        preview = _frames(run, times[[0, count // 2, -1]], ranges, world, options.width)
        shown = Image.fromarray(np.vstack([np.asarray(each) for each in preview]))
        palette = shown.quantize(_NUMBER_OF_COLOURS, Image.Quantize.MAXCOVERAGE)
        few = [
            frame.quantize(palette=palette, dither=Image.Dither.NONE)
            for frame in _frames(run, times, ranges, world, options.width, bar.update)
        ]
    # With ``optimize`` a frame holds only the pixels that change.
    with atomic_file(output) as file:
        few[0].save(
            file,
            'GIF',
            save_all=True,
            append_images=few[1:],
            duration=round(1000.0 / options.rate),
            loop=0,
            optimize=True,
            disposal=1,
        )
    return output


def read_ranges(recording: BagReader, run: Run) -> RangeReadings | None:
    """Return the readings of the range sensors; None where none of them ever hit anything."""
    space = run.namespaces[0]
    times, distances = [], []
    # Both ends of the poses relate receive times to their clock.
    received = run.receipts[run.measured][[0, -1]]
    stamped = run.motions[run.measured].time[[0, -1]]
    for name in RANGE_SENSORS:
        topic = f'{space}/range/{name}'
        if topic not in recording.topics or not recording.topics[topic].message_count:
            times.append(np.empty(0))
            distances.append(np.empty(0))
            continue
        table = recording.series(topic, {'range': 'range'})
        times.append(np.interp(table['received'], received, stamped))
        distances.append(table['range'])
    if not any(np.isfinite(each).any() for each in distances):
        return None
    recorded = recording.metadata_records.get(
        'sim_robot', recording.metadata_records.get('radio_bridge', {})
    )
    known = {f'range_sensor.{name}': name for name in RangeSensorParameters().to_dict()}
    values = {known[key]: parsed_value(text) for key, text in recorded.items() if key in known}
    try:
        parameters = RangeSensorParameters.from_dict(values)
    except ParameterError:
        parameters = RangeSensorParameters()
    return RangeReadings(tuple(times), tuple(distances), sensor_mounts(parameters))


def _frames(
    run: Run,
    times: Array,
    ranges: RangeReadings | None,
    world: World | None,
    width: int,
    on_frame: Callable[[], object] = int,
) -> Iterator[Image.Image]:
    """Yield the pictures of the run at some times."""
    with matplotlib.rc_context(
        STYLE | {'font.size': 8, 'axes.titlesize': 8, 'legend.fontsize': 7}
    ):
        figure = Figure(figsize=(7.6, 3.95), dpi=width / 7.6)
        canvas = FigureCanvasAgg(figure)
        draw_floor = _floor(figure, run, times, ranges, world)
        lines = _panels(figure, run, times)
        canvas.draw()
        still = canvas.copy_from_bbox(figure.bbox)
        for now in times.tolist():
            canvas.restore_region(still)
            draw_floor(now)
            for line, time, value in lines:
                rows = slice(int(np.searchsorted(time, now, side='right')))
                line.set_data(time[rows], value[rows])
                line.axes.draw_artist(line)
            yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB')
            on_frame()


def _floor(
    figure: Any, run: Run, times: Array, ranges: RangeReadings | None, world: World | None
) -> Callable[[float], None]:
    """Draw the walls from above; return what draws path, robot and range rays at a time."""
    motion, reference = run.motions[run.measured], run.motions.get(REFERENCE)
    followed, yaws = followed_reference(run), np.unwrap(motion['yaw'])
    axis = figure.add_axes((0.085, 0.1, 0.43, 0.83))
    axis.set_aspect('equal')
    shown = motion.between(times[0], times[-1])
    points = np.column_stack([shown['x'], shown['y']])
    if world is not None:
        draw_world(axis, world)
        points = np.vstack([points, world.segments.reshape(-1, 2)])
    (left, bottom), (right, top) = points.min(axis=0) - 0.2, points.max(axis=0) + 0.2
    axis.set(xlim=(left, right), ylim=(bottom, top), xlabel='x / m', ylabel='y / m')
    blue, grey = COLOURS[run.measured], COLOURS[REFERENCE]
    style = {'animated': True, 'zorder': 3}
    line = axis.plot([], [], color=grey, linewidth=0.8, **style)[0]
    trail = axis.plot([], [], color=blue, linewidth=2.0, **style)[0]
    hit = axis.plot([], [], '.', color=_HIT, markersize=1.6, **style)[0]
    rays = axis.add_collection(LineCollection([], colors=_RAY, linewidths=0.9, **style))
    body = axis.add_patch(Circle((0.0, 0.0), 0.1, facecolor='white', edgecolor=blue, **style))
    nose = axis.plot([], [], color=blue, linewidth=1.6, **style)[0]
    hits: list[Array] = []

    # The legend has copies of the lines that are not animated.
    entries = [(blue, f'robot ({"ground truth" if run.measured == TRUTH else "odometry"})')]
    if reference is not None:
        ahead = '' if followed is not None else f', next {AHEAD:g} s'
        entries.append((grey, f'reference{ahead}'))
    if ranges is not None:
        entries.append((_RAY, 'range sensors'))
    handles = [Line2D([], [], color=colour, linewidth=1.4) for colour, _ in entries]
    place = {'loc': 'lower left', 'bbox_to_anchor': (0.0, 1.0), 'ncols': len(entries)}
    spacing = {'borderaxespad': 0.1, 'handlelength': 1.2, 'columnspacing': 1.0}
    axis.legend(handles, [text for _, text in entries], **place, **spacing)

    def draw(now: float) -> None:
        columns = motion['x'], motion['y'], yaws
        x, y, yaw = (float(np.interp(now, motion.time, each)) for each in columns)
        rows = slice(*np.searchsorted(motion.time, (times[0], now)).tolist())
        trail.set_data(np.append(motion['x'][rows], x), np.append(motion['y'][rows], y))
        if followed is not None:
            rows = slice(*np.searchsorted(followed.time, (times[0], now)).tolist())
            line.set_data(followed['x'][rows], followed['y'][rows])
        elif reference is not None:
            line.set_data(*path_of(reference.between(now, now + AHEAD), (x, y, yaw)))
        if ranges is not None:
            found = ranges.rays(now, (x, y, yaw))
            rays.set_segments(list(found))
            hits.extend(found[:, 1])
            hit.set_data(*np.array(hits).reshape(-1, 2).T)
        body.center = x, y
        nose.set_data([x, x + 0.1 * math.cos(yaw)], [y, y + 0.1 * math.sin(yaw)])
        for artist in (trail, line, hit, rays, body, nose):
            axis.draw_artist(artist)

    return draw


def _panels(figure: Any, run: Run, times: Array) -> list[tuple[Any, Array, Array]]:
    """Return the lines of both speeds and of their errors, each with its data over time."""
    motion, reference = run.motions[run.measured], run.motions.get(REFERENCE)
    error = tracking_error(run, run.measured)
    panels = []
    for channel in run.channels:
        shown = [(motion, channel.name, COLOURS[run.measured], 2.2)]
        if reference is not None:
            shown.append((reference, channel.name, COLOURS[REFERENCE], 0.7))
        panels.append((f'{channel.title} / ({channel.unit})', shown))
    if error is not None:
        units = ' and '.join(dict.fromkeys(each.unit for each in run.channels))
        right, left = (each.name for each in run.channels)
        shown = [(error, right, COLOURS['error'], 0.9), (error, left, '#fb923c', 0.9)]
        panels.append((f'errors / ({units})', shown))
    height, found = 0.87 / len(panels), []
    for place, (title, shown) in enumerate(panels, 1):
        bottom = 0.12 + (len(panels) - place) * height
        axis = figure.add_axes((0.58, bottom, 0.4, height - 0.08))
        axis.set_xlim(times[0], times[-1])
        axis.set_title(title, pad=2)
        values = []
        for series, name, colour, width in shown:
            part = series.between(times[0], times[-1])
            every = slice(None, None, max(1, len(part) // 1500))
            line = axis.plot([], [], color=colour, linewidth=width, animated=True)[0]
            found.append((line, part.time[every], part[name][every]))
            values.append(part[name][every])
        if np.concatenate(values).size:
            # Between these limits almost all values lie.
            low, high = np.percentile(np.concatenate(values), (0.5, 99.5)).tolist()
            margin = 0.12 * max(high - low, 1e-3)
            axis.set_ylim(low - margin, high + margin)
        axis.tick_params(labelbottom=place == len(panels))
    axis.set_xlabel('time / s')
    return found
