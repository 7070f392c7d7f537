# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Animation of a recorded run: floor with path and range rays, speeds against the reference."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
from numpy.typing import NDArray
from PIL import Image

from t3mpc_ros.bag.reader import BagReader, open_bag
from t3mpc_ros.evaluation.bag_report.patrol_section import followed_reference
from t3mpc_ros.evaluation.bag_report.run_data import Run, load_run
from t3mpc_ros.evaluation.plotting import COLOURS, STYLE, draw_world
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.topic_roles import (
    REFERENCE,
    TRUTH,
    ReportError,
    ReportOptions,
)
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.description import ray_ends, sensor_mounts
from t3mpc_ros.robot.interface import RANGE_SENSORS
from t3mpc_ros.robot.sensor_conversions import RangeSensorParameters
from t3mpc_ros.simulation.world import World, recorded_world

Array = NDArray[np.float64]

AHEAD = 1.5
"""Time that the reference is drawn ahead of a robot that tracks speeds, s."""
_FRESH = 0.15
"""Greatest age of a range reading that is drawn, s."""
_RAY, _HIT = '#f59e0b', '#b45309'
_COLOURS = 64
"""Colours of the file."""


@dataclass(frozen=True)
class AnimationOptions:
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

    def __post_init__(self) -> None:
        checks = {
            'start': self.start >= 0.0 and math.isfinite(self.start),
            'duration': self.duration > 0.0,
            'speed': 0.0 < self.speed < math.inf,
            'rate': 0.0 < self.rate <= 50.0,
            'width': 200 <= self.width <= 4000,
        }
        bounds = {
            'start': 'at least 0 s',
            'duration': 'above 0 s',
            'speed': 'above 0',
            'rate': 'above 0 and at most 50 frames per second',
            'width': 'from 200 to 4000 pixels',
        }
        for name, sound in checks.items():
            if not sound:
                raise ValueError(f'{name} must be {bounds[name]}: got {getattr(self, name)}')


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
    """Write the animation of a bag with a pose to ``output``, and return it.

    Parameters
    ----------
    folder
        Folder of the bag, or its one file.
    output
        A GIF file.
    options
        By default the whole run at its own speed.
    wanted
        Namespace, topics and wheel geometry; by default found in the bag.

    Raises
    ------
    BagError
        The bag is missing or cannot be read.
    ReportError
        The bag holds no pose, or none in the part.
    ValueError
        The suffix of ``output`` is not ``.gif``.
    """
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
        table = _palette(list(preview))
        frames = _frames(run, times, ranges, world, options.width, bar.update)
        _write(output, frames, table, 1000.0 / options.rate)
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
    prefix = 'range_sensor.'
    recorded = recording.metadata_records.get(
        'sim_robot', recording.metadata_records.get('radio_bridge', {})
    )
    known = RangeSensorParameters().to_dict()
    values = {
        key.removeprefix(prefix): text
        for key, text in recorded.items()
        if key.startswith(prefix) and key.removeprefix(prefix) in known
    }
    try:
        numbers = {key: float(text) for key, text in values.items() if key != 'type'}
        parameters = RangeSensorParameters.from_dict(numbers)
    except (ParameterError, ValueError):
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
        floor = _Floor(figure, run, times, ranges, world)
        charts = _Charts(figure, run, times)
        canvas.draw()
        still = canvas.copy_from_bbox(figure.bbox)
        for now in times.tolist():
            canvas.restore_region(still)
            floor.draw(now)
            charts.draw(now)
            yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB')
            on_frame()


class _Floor:
    """Walls, path, robot and range rays, seen from above."""

    def __init__(
        self,
        figure: Any,
        run: Run,
        times: Array,
        ranges: RangeReadings | None,
        world: World | None,
    ) -> None:
        self._motion, self._ranges = run.motions[run.measured], ranges
        self._begin = float(times[0])
        self._yaw = np.unwrap(self._motion['yaw'])
        self._followed = followed_reference(run)
        self._reference = run.motions.get(REFERENCE)
        self._hits: list[Array] = []
        axis = self._axis = figure.add_axes((0.085, 0.1, 0.43, 0.83))
        axis.set_aspect('equal')
        axis.set(xlabel='x / m', ylabel='y / m')
        if world is not None:
            draw_world(axis, world)
        self._frame_view(times, world)
        blue = COLOURS[run.measured]
        style = {'animated': True, 'zorder': 3}
        self._line = axis.plot([], [], color=COLOURS[REFERENCE], linewidth=0.8, **style)[0]
        self._trail = axis.plot([], [], color=blue, linewidth=2.0, **style)[0]
        self._points = axis.plot([], [], '.', color=_HIT, markersize=1.6, **style)[0]
        self._rays = LineCollection([], colors=_RAY, linewidths=0.9, **style)
        axis.add_collection(self._rays)
        self._body = Circle((0.0, 0.0), 0.1, facecolor='white', edgecolor=blue, **style)
        axis.add_patch(self._body)
        self._nose = axis.plot([], [], color=blue, linewidth=1.6, **style)[0]
        self._legend(run)

    def _legend(self, run: Run) -> None:
        """Name the lines above the floor, with copies that are not animated."""
        line = COLOURS[REFERENCE]
        ahead = 'reference' if self._followed is not None else f'reference, next {AHEAD:g} s'
        truth = ' (ground truth)' if run.measured == TRUTH else ' (odometry)'
        entries = [(COLOURS[run.measured], f'robot{truth}')]
        entries += [(line, ahead)] if self._reference is not None else []
        entries += [(_RAY, 'range sensors')] if self._ranges is not None else []
        handles = [Line2D([], [], color=colour, linewidth=1.4) for colour, _ in entries]
        place = {'loc': 'lower left', 'bbox_to_anchor': (0.0, 1.0), 'ncols': len(entries)}
        spacing = {'borderaxespad': 0.1, 'handlelength': 1.2, 'columnspacing': 1.0}
        self._axis.legend(handles, [text for _, text in entries], **place, **spacing)

    def _frame_view(self, times: Array, world: World | None) -> None:
        shown = (self._motion.time >= times[0]) & (self._motion.time <= times[-1])
        points = [np.column_stack([self._motion['x'][shown], self._motion['y'][shown]])]
        if world is not None and len(world.segments):
            points.append(world.segments.reshape(-1, 2))
        low, high = np.vstack(points).min(axis=0) - 0.2, np.vstack(points).max(axis=0) + 0.2
        self._axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))

    def _pose(self, now: float) -> tuple[float, float, float]:
        time = self._motion.time
        x, y = (float(np.interp(now, time, self._motion[axis])) for axis in 'xy')
        return x, y, float(np.interp(now, time, self._yaw))

    def draw(self, now: float) -> None:
        """Draw the robot at ``now``, and what led there."""
        pose = self._pose(now)
        x, y, yaw = pose
        time = self._motion.time
        rows = slice(*np.searchsorted(time, (self._begin, now)).tolist())
        self._trail.set_data(
            np.append(self._motion['x'][rows], x), np.append(self._motion['y'][rows], y)
        )
        self._line.set_data(*self._reference_line(now, pose))
        if self._ranges is not None:
            rays = self._ranges.rays(now, pose)
            self._rays.set_segments(list(rays))
            self._hits += list(rays[:, 1])
            self._points.set_data(*np.array(self._hits).reshape(-1, 2).T)
        self._body.center = x, y
        self._nose.set_data([x, x + 0.1 * math.cos(yaw)], [y, y + 0.1 * math.sin(yaw)])
        for artist in (
            self._trail, self._line, self._points, self._rays, self._body, self._nose
        ):  # fmt: skip
            self._axis.draw_artist(artist)

    def _reference_line(self, now: float, pose: tuple[float, float, float]) -> tuple[Array, Array]:
        """Return the path that is followed up to ``now``; else where the speeds lead from here."""
        if self._followed is not None:
            rows = slice(*np.searchsorted(self._followed.time, (self._begin, now)).tolist())
            return self._followed['x'][rows], self._followed['y'][rows]
        reference = self._reference
        if reference is None:
            return np.empty(0), np.empty(0)
        rows = slice(*np.searchsorted(reference.time, (now, now + AHEAD)).tolist())
        step = np.diff(reference.time[rows], append=reference.time[rows][-1:])
        yaw = pose[2] + np.cumsum(reference['angular'][rows] * step)
        run = reference['linear'][rows] * step
        return (
            pose[0] + np.cumsum(run * np.cos(yaw)),
            pose[1] + np.cumsum(run * np.sin(yaw)),
        )


class _Charts:
    """Both speeds against their references, and the errors below."""

    def __init__(self, figure: Any, run: Run, times: Array) -> None:
        motion, reference = run.motions[run.measured], run.motions.get(REFERENCE)
        self._lines: list[tuple[Any, Any, Array, Array]] = []
        begin, end = float(times[0]), float(times[-1])
        rows = [(each, [(motion, run.measured)]) for each in run.channels]
        if reference is not None:
            for _, shown in rows:
                shown.append((reference, REFERENCE))
        count = len(rows) + (reference is not None)
        height = 0.87 / count
        for place, (channel, shown) in enumerate(rows):
            axis = self._panel(figure, count - 1 - place, height, begin, end)
            axis.set_title(f'{channel.title} / ({channel.unit})', pad=2)
            for series, name in shown:
                width = 0.7 if name == REFERENCE else 2.2
                self._add(
                    axis, series.time, series[channel.name], COLOURS[name], width, begin, end
                )
            self._tidy(axis, place == count - 1)
        if reference is not None:
            axis = self._panel(figure, 0, height, begin, end)
            units = ' and '.join(dict.fromkeys(each.unit for each in run.channels))
            axis.set_title(f'errors / ({units})', pad=2)
            for channel, colour in zip(run.channels, (COLOURS['error'], '#fb923c'), strict=True):
                inside = (motion.time >= reference.time[0]) & (motion.time <= reference.time[-1])
                time = motion.time[inside]
                wanted = np.interp(time, reference.time, reference[channel.name])
                error = motion[channel.name][inside] - wanted
                self._add(axis, time, error, colour, 0.9, begin, end)
            self._tidy(axis, True)

    @staticmethod
    def _panel(figure: Any, place: int, height: float, begin: float, end: float) -> Any:
        axis = figure.add_axes((0.58, 0.1 + place * height + 0.02, 0.4, height - 0.08))
        axis.set_xlim(begin, end)
        return axis

    def _add(
        self,
        axis: Any,
        time: Array,
        value: Array,
        colour: str,
        width: float,
        begin: float,
        end: float,
    ) -> None:
        shown = (time >= begin) & (time <= end)
        time, value = time[shown], value[shown]
        every = max(1, time.size // 1500)
        line = axis.plot([], [], color=colour, linewidth=width, animated=True)[0]
        self._lines.append((axis, line, time[::every], value[::every]))

    def _tidy(self, axis: Any, last: bool) -> None:
        """Set the limits of the values, between which almost all of them lie."""
        values = [value for other, _, _, value in self._lines if other is axis and value.size]
        if values:
            low, high = np.percentile(np.concatenate(values), (0.5, 99.5)).tolist()
            margin = 0.12 * max(high - low, 1e-3)
            axis.set_ylim(low - margin, high + margin)
        if last:
            axis.set_xlabel('time / s')
        else:
            axis.tick_params(labelbottom=False)

    def draw(self, now: float) -> None:
        """Draw the lines up to ``now``."""
        for axis, line, time, value in self._lines:
            count = int(np.searchsorted(time, now, side='right'))
            line.set_data(time[:count], value[:count])
            axis.draw_artist(line)


def _write(
    output: Path, frames: Iterator[Image.Image], table: NDArray[np.int64], period: float
) -> None:
    """Write a GIF of frames that last ``period`` ms each, in the colours of a table."""
    nearest = _nearest(table)
    few = []
    for each in frames:
        red, green, blue = np.moveaxis(np.asarray(each) >> 3, 2, 0)
        few.append(Image.fromarray(nearest[red, green, blue]))
        few[-1].putpalette(table.astype(np.uint8).tobytes())
    # With ``optimize`` a frame holds only the pixels that change.
    few[0].save(
        output,
        save_all=True,
        append_images=few[1:],
        duration=round(period),
        loop=0,
        optimize=True,
        disposal=1,
    )


def _palette(pictures: list[Image.Image]) -> NDArray[np.int64]:
    """Return the most frequent colours, shape (n, 3), 0 to 255."""
    pixels = np.vstack([np.asarray(each).reshape(-1, 3) for each in pictures]).astype(np.int64)
    colours, counts = np.unique(pixels @ (1 << 16, 1 << 8, 1), return_counts=True)
    most = colours[np.argsort(-counts)[:_COLOURS]]
    return np.stack([most >> 16, (most >> 8) & 255, most & 255], axis=1)


def _nearest(table: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the row of the nearest colour for the first five bits of each, shape (32, 32, 32)."""
    levels = np.round(np.arange(32) * 255.0 / 31.0)
    cube = np.stack(np.meshgrid(levels, levels, levels, indexing='ij'), axis=-1).reshape(-1, 3)
    squares = ((cube[:, None, :] - table[None, :, :]) ** 2).sum(axis=2)
    rows: NDArray[np.uint8] = squares.argmin(axis=1).astype(np.uint8)
    return rows.reshape(32, 32, 32)
