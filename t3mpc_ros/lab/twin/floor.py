# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of what happens on the floor: paths, headings that drift, a room."""

from collections.abc import Sequence
import math
from typing import Any

from matplotlib.patches import Circle, Polygon
import numpy as np
import numpy.typing as npt

from t3mpc_ros.lab.report.canvas import COLOURS, new_figure
from t3mpc_ros.lab.report.topics import REFERENCE, TRUTH
from t3mpc_ros.lab.twin.courses import Course, Patrol
from t3mpc_ros.lab.twin.drift import NO_SLIP, PART, Drift, group, spread
from t3mpc_ros.robot.arena.world import World, load_world
from t3mpc_ros.robot.sensors.sharp import mounts
from t3mpc_ros.robot.twin.faults import FaultEvent
from t3mpc_ros.robot.twin.settings import TwinSettings

Array = npt.NDArray[np.float64]

TRUE, WANTED = COLOURS[TRUTH], COLOURS[REFERENCE]
STEPS, FUSED, SHEET = '#ea580c', '#15803d', '#be123c'
FAINT = '#9ca3af'
_MARKS = ('o', 's', '^')


def squares(courses: Sequence[Course]) -> Any:
    """Return the squares as driven and as believed."""
    figure = new_figure(3.6)
    axes = figure.subplots(1, 2)
    for axis, course in zip(axes, courses, strict=True):
        draw_square(axis, course)
        axis.set_title(course.name)
        axis.set_xlabel('x / m')
    axes[0].set_ylabel('y / m')
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=3)
    return figure


def draw_square(axis: Any, course: Course) -> None:
    """Draw where a robot was and where it thought it was."""
    for path, colour, width, style, label in (
        (course.steps, STEPS, 1.3, '-', 'odometry, steps alone'),
        (course.truth, TRUE, 2.4, '-', 'where it was'),
        (course.odometry, WANTED, 1.0, '--', 'odometry with gyro'),
    ):
        axis.plot(*path[:, :2].T, color=colour, lw=width, ls=style, label=label)
        axis.plot(*path[-1, :2], 'o', color=colour, ms=4)
    axis.set_aspect('equal', adjustable='datalim')


def turns(course: Course, spells: Sequence[FaultEvent], slip: str) -> Any:
    """Return how wrong the headings are while the robot turns on the spot."""
    figure = new_figure(3.0)
    axis = figure.subplots()
    for number, spell in enumerate(spells):
        if spell.at < course.time[-1]:
            label = slip if number == 0 else None
            axis.axvspan(spell.at, min(spell.until, course.time[-1]), color='#fde68a', lw=0.0,
                         label=label)  # fmt: skip
    for believed, colour, label in (
        (course.steps, STEPS, 'steps alone'),
        (course.odometry, FUSED, 'with gyro'),
    ):
        wrong = np.degrees(believed[:, 2] - course.truth[:, 2])
        axis.plot(course.time, wrong, color=colour, lw=1.5, label=label)
    axis.set_xlabel('time / s')
    axis.set_ylabel('heading error / deg')
    axis.margins(x=0.01)
    figure.legend(*axis.get_legend_handles_labels(), loc='outside upper center', ncols=3)
    return figure


def drift(found: Sequence[Drift]) -> Any:
    """Return the heading errors at the end as bars, and one against the other."""
    figure = new_figure(6.0)
    courses = list(dict.fromkeys(item.course for item in found))
    slips = list(dict.fromkeys(item.slip for item in found))
    grid = figure.add_gridspec(2, len(courses), height_ratios=(1.0, 1.1))
    panels = grid[0, :].subgridspec(1, len(courses)).subplots(sharex=True, sharey=True)
    below = figure.add_subplot(grid[1, :])
    rows = np.arange(len(slips))
    for axis, course in zip(panels, courses, strict=True):
        groups = [group(found, course, slip) for slip in slips]
        steps = [math.degrees(spread(item.steps for item in each)) for each in groups]
        fused = [math.degrees(spread(item.fused for item in each)) for each in groups]
        axis.barh(rows - 0.2, steps, 0.4, color=STEPS, label='steps alone')
        axis.barh(rows + 0.2, fused, 0.4, color=FUSED, label='with gyro')
        axis.set_title(course)
        axis.set_xscale('log')
        axis.set_xlabel('rms error / deg')
        axis.set_axisbelow(True)
        axis.grid(False, axis='y')
    panels[0].set_yticks(rows, slips)
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc='outside upper center', ncols=2)
    for course, mark in zip(courses, _MARKS, strict=False):
        members = [item for item in found if item.course == course and item.slip != NO_SLIP.name]
        wrong = np.degrees(np.abs([(item.steps, item.fused) for item in members]))
        below.plot(*wrong.T, mark, ms=4, alpha=0.7, mew=0.0, label=course)
    edge = np.array((0.1, 1000.0))
    below.plot(edge, PART * edge, color=WANTED, lw=1.0, ls='--', label='a fifth')
    below.set(xscale='log', yscale='log', xlim=(0.1, 1000.0), ylim=(0.005, 50.0))
    below.set_xlabel('heading error of the steps alone / deg')
    below.set_ylabel('with gyro / deg')
    below.legend(loc='lower right', ncols=2, framealpha=0.9, frameon=True, edgecolor='white')
    return figure


def room(patrol: Patrol, settings: TwinSettings) -> Any:
    """Return the drive through the room, with what the sensors saw and the crash at the end."""
    course = patrol.course
    figure = new_figure(5.0)
    axis = figure.subplots()
    axis.set_axisbelow(True)
    world = load_world(settings.world)
    _draw_world(axis, world)
    faces = mounts(settings.sharp)
    blind = int(np.searchsorted(course.time, patrol.blind_from))
    moments = np.linspace(blind // 6, blind - 1, 5).astype(int)
    for moment in moments:
        _draw_robot(axis, course.truth[moment], settings, FAINT)
        _draw_rays(axis, course.truth[moment], faces, patrol.ranges[moment])
    seen, unseen = course.truth[: blind + 1], course.truth[blind:]
    axis.plot(*seen[:, :2].T, color=TRUE, lw=1.6, label='where it was')
    axis.plot(*unseen[:, :2].T, color=SHEET, lw=1.6, label='the same, sensors dead')
    axis.plot(*course.odometry[:, :2].T, color=WANTED, lw=0.9, ls='--', label='odometry')
    _draw_robot(axis, course.truth[-1], settings, SHEET)
    if math.isfinite(patrol.hit_at):
        hit = course.truth[int(np.searchsorted(course.time, patrol.hit_at))]
        axis.annotate(
            f'{patrol.hardest_push:.0f} N', hit[:2], (-34.0, 10.0), textcoords='offset points',
            color=SHEET, fontsize=8,
        )  # fmt: skip
    axis.plot(*course.truth[0, :2], 'o', color=WANTED, ms=5, label='start')
    around = world.extent
    axis.set_xlim(around.left - 0.4, around.right + 0.4)
    axis.set_ylim(around.bottom - 0.4, around.top + 0.4)
    axis.set_aspect('equal')
    axis.set_xlabel('x / m')
    axis.set_ylabel('y / m')
    figure.legend(*axis.get_legend_handles_labels(), loc='outside upper center', ncols=4)
    return figure


def _draw_world(axis: Any, world: World) -> None:
    for x, y, radius, _ in world.patches:
        axis.add_patch(Circle((x, y), radius, color='#fde68a', lw=0.0))
    for x, y, radius in world.circles:
        axis.add_patch(Circle((x, y), radius, fc='#d1d5db', ec='#374151', lw=1.5))
    for x, y, length, width, heading in world.boxes:
        corners = 0.5 * np.array([(length, width), (-length, width), (-length, -width),
                                  (length, -width)])  # fmt: skip
        turned = corners @ _rotation(heading).T
        axis.add_patch(Polygon(turned + (x, y), color='#d1d5db'))
    for ax, ay, bx, by in world.segments:
        axis.plot((ax, bx), (ay, by), color='#374151', lw=1.5)


def _draw_robot(axis: Any, pose: Array, settings: TwinSettings, colour: str) -> None:
    axis.add_patch(
        Circle((pose[0], pose[1]), settings.bumper.radius, fill=False, color=colour, lw=1.0)
    )
    nose = pose[:2] + _rotation(pose[2]) @ (settings.bumper.radius, 0.0)
    axis.plot(*zip(pose[:2], nose, strict=True), color=colour, lw=1.0)


def _draw_rays(axis: Any, pose: Array, faces: Array, ranges: Array) -> None:
    """Draw a line as long as each reading; a faint one to 0.8 m where nothing was seen."""
    for face, reading in zip(faces, ranges, strict=True):
        start = pose[:2] + _rotation(pose[2]) @ face[:2]
        length = reading if math.isfinite(reading) else (0.8 if reading > 0.0 else 0.1)
        end = start + length * np.array((math.cos(pose[2] + face[2]), math.sin(pose[2] + face[2])))
        seen = math.isfinite(reading)
        style = {'color': FUSED if seen else '#d1d5db', 'lw': 0.9 if seen else 0.6}
        axis.plot(*zip(start, end, strict=True), zorder=1.5, **style)
        if seen:
            axis.plot(*end, '.', color=FUSED, ms=3)


def _rotation(angle: float) -> Array:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([(cosine, -sine), (sine, cosine)])
