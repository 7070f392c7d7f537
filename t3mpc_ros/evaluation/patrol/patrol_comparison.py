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
"""Our patrol and the baselines: the same robot, room, time, speed limits and safety for all.

Every path is a polyline. Timing under the limits of speed and acceleration makes it a reference
(:mod:`t3mpc_ros.geometry.path_timing`), which one of two robots follows: ``exact`` is always where
the reference is, in an empty room; ``twin`` is the digital twin with noise, lag, slip and lost
commands, among boxes that it does not know, with the controller of the nodes and its keep-out.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import cycle
import math
from pathlib import Path
from statistics import mode
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.evaluation import html_page, result_output
from t3mpc_ros.evaluation.confidence_intervals import (
    Difference,
    format_interval,
    interval,
    mean,
    paired,
)
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Row, Run, run_experiment
from t3mpc_ros.evaluation.patrol import patrol_run
from t3mpc_ros.evaluation.patrol.baseline_paths import BASELINE_PATHS, Rectangle
from t3mpc_ros.evaluation.patrol.patrol_metrics import (
    HORIZONS,
    SHARES,
    CoverageGrid,
    coverage_at,
    patrol_metrics,
    visits,
)
from t3mpc_ros.evaluation.patrol.patrol_run import LIMITS
from t3mpc_ros.evaluation.run_cache_key import digest
from t3mpc_ros.evaluation.run_record import Record
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import PathTiming
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.types import ORIGIN, Array
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.robot.sensor_mounts import ray_ends, sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import World, parse_world
from t3mpc_ros.version import VERSION

OURS = 'portraits (85)'
"""Name of our path, the switched portraits of system (85)."""
PATHS = (OURS, *BASELINE_PATHS)
ROBOTS = ('twin', 'exact')
BOXES = 3
"""Unknown boxes in the room of the twin."""
SAMPLE = 0.1
"""Interval of the tracks that are measured, s."""
CLEARANCE = 0.165
"""Cells count whose centre is at least so far from walls and boxes, m: the distance that the
keep-out maintains."""
CURVE = 200
"""Points of the coverage over time."""


@dataclass(frozen=True)
class PatrolPlan:
    """What is compared."""

    paths: Sequence[str] = PATHS
    seeds: Sequence[int] = (101, 102, 103)
    duration: float = 600.0
    """s"""
    robot: str = 'exact'
    planned: bool = False
    """Whether the twin plans its path on the map of its keep-out."""
    arena: tuple[float, ...] = PortraitParameters().arena
    """left, bottom, right, top of the area of the paths, m; the walls of the twin's room are
    0.25 m outside."""

    def __post_init__(self) -> None:
        object.__setattr__(self, 'paths', find_names('path', self.paths, PATHS))
        object.__setattr__(self, 'robot', *find_names('robot', [self.robot], ROBOTS))
        if not self.paths or not self.seeds:
            raise ValueError('at least one path and one seed must be given')
        if not self.duration >= 1.0:
            raise ValueError(f'duration must be at least 1 s: got {self.duration:g}')
        if len(self.arena) != 4:
            raise ValueError(
                f'arena must be left, bottom, right, top: got {len(self.arena)} numbers'
            )
        Arena(self.arena)
        if self.planned and self.robot != 'twin':
            raise ValueError(f'planned needs the robot twin: got {self.robot}')
        left, bottom, right, top = self.arena
        if not (left < 0.0 < right and bottom < 0.0 < top):
            raise ValueError(f'arena must contain the start at (0, 0): got {self.arena}')

    @property
    def area(self) -> Rectangle:
        """The arena, for the baselines."""
        left, bottom, right, top = self.arena
        return Rectangle((left, bottom), (right, top))


class PatrolTrack(NamedTuple):
    """One patrol: where the robot was, where it should be, and what is around it."""

    time: Array
    """s, shape (n,)"""
    position: Array
    """m, shape (n, 2)"""
    reference: Array
    """m, shape (n, 2)"""
    counted: NDArray[np.bool_]
    """Rows in which the path error counts: outside avoidance, shape (n,)."""
    grid: CoverageGrid
    world: World | None = None
    hits: Array = np.empty((0, 2))
    """Where range sensors have hit, m, shape (k, 2)."""
    contacts: int = 0
    """Periods in which the robot touched something."""
    on_path: float = 1.0
    """Share of the time from the third minute on within 50 mm of the reference."""


class PatrolStudy(NamedTuple):
    """What was compared, and what came out."""

    plan: PatrolPlan
    table: ResultTable
    """One row a patrol, see :func:`measured_patrol`; its ``controller`` is the path."""
    world: World | None = None
    """The room of the first seed; None if it is empty."""


class DrivenPath(NamedTuple):
    """A path by its name."""

    name: str
    drawn: bool
    """Whether what is drawn of it is kept."""


def compare_patrols(
    plan: PatrolPlan,
    store: Path | None = None,
    workers: int | Executor = 1,
    report: Report | None = None,
) -> PatrolStudy:
    """Return the patrols of every path and seed; arguments as of :func:`run_experiment`."""
    first = plan.seeds[0]
    runs = []
    for seed in plan.seeds:
        for name in plan.paths:
            own = replace(plan, paths=(name,), seeds=(seed,))
            job = own, DrivenPath(name, seed == first)
            runs.append(Run(job, {'controller': name, 'seed': seed}, digest(job)))
    table = run_experiment(runs, measured_patrol, workers, store=store, report=report)
    room = parse_world(plan_world(plan, first), 'room') if plan.robot == 'twin' else None
    return PatrolStudy(plan, table, room)


def measured_patrol(job: tuple[PatrolPlan, DrivenPath]) -> Row:
    """Return the row of a patrol, by a plan of one path and one seed.

    The numbers of :func:`.patrol_metrics.patrol_metrics`, and ``contacts``, periods in which the
    robot touched something; ``on_path``, see :func:`.share_on_path`; ``avoiding``, share of the
    time in which it avoids an obstacle;
    ``curve``, coverage at :data:`CURVE` even times from 0 to the duration. What is drawn:
    ``track``, positions (m); ``dwell``, time in each cell (s), NaN in those that do not count;
    ``hits`` of the range sensors (m).
    """
    plan, (name, drawn) = job
    track = patrol_track(plan, name, plan.seeds[0])
    reference = np.where(track.counted[:, None], track.reference, math.nan)
    x, y = track.position.T
    found = visits(track.time, x, y, track.grid)
    row = {
        **patrol_metrics(track.time, x, y, track.grid, reference),
        'contacts': track.contacts,
        'on_path': track.on_path,
        'avoiding': 1.0 - float(track.counted.mean()),
        'curve': coverage_at(found, track.grid, np.linspace(0.0, plan.duration, CURVE)).tolist(),
    }
    if drawn:
        row['track'] = track.position.tolist()
        row['dwell'] = np.where(track.grid.free, found.dwell, math.nan).tolist()
        row['hits'] = track.hits.tolist()
    return row


def patrol_track(plan: PatrolPlan, name: str, seed: int) -> PatrolTrack:
    """Return the track of one path and seed; equal arguments give equal tracks."""
    points = path_points(plan, name, seed)
    if plan.robot == 'exact':
        return _exact_track(plan, points)
    text = plan_world(plan, seed)
    walls = text.partition('boxes:')[0]
    with patrol_run.world_file(walls) as known, patrol_run.world_file(text) as path:
        scenario = patrol_run.PatrolScenario(
            seed,
            plan.duration,
            known,
            path,
            plan=PlanParameters(enabled=plan.planned),
            arena=plan.arena,
        )
        record = patrol_run.run_patrol(points, scenario)
    return _twin_track(plan, record, parse_world(text, 'room'))


def path_points(plan: PatrolPlan, name: str, seed: int) -> Iterator[Array]:
    """Return the pieces of a path, m, each of shape (k, 2); they never end before the patrol."""
    if name == OURS:
        parameters = PortraitParameters.from_dict({'arena': list(plan.arena)})
        return patrol_run.portrait_points(seed, parameters)
    length = patrol_run.LIMITS.linear * plan.duration + 10.0
    return iter([BASELINE_PATHS[name](plan.area, length, np.random.default_rng((seed, 21)))])


def plan_world(plan: PatrolPlan, seed: int) -> str:
    """Return the room of a seed as YAML: walls 0.25 m around the arena, boxes, slippery floor."""
    left, bottom, right, top = plan.arena
    size = (2.0 * max(-left, right) + 0.5, 2.0 * max(-bottom, top) + 0.5)
    return patrol_run.room_with_boxes(seed, size, BOXES)


def free_cells(plan: PatrolPlan, world: World | None) -> CoverageGrid:
    """Return the 20 x 20 cells of the arena, those near walls and boxes blocked."""
    grid = CoverageGrid(*plan.area)
    if world is None:
        return grid
    centres = grid.centres()
    blocked = np.array(
        [[not world.is_free(x, y, CLEARANCE) for x, y in row] for row in centres.tolist()]
    )
    return CoverageGrid(*plan.area, blocked=blocked)


def _exact_track(plan: PatrolPlan, points: Iterator[Array]) -> PatrolTrack:
    timing = PathTiming(patrol_run.LIMITS, WheelGeometry(), SAMPLE, ORIGIN)
    count = math.floor(plan.duration / SAMPLE) + 1
    position = np.empty((count, 2))
    for row in position:
        row[:] = timing.advance_along(points)[0][:2]
    time: Array = SAMPLE * np.arange(count, dtype=np.float64)
    always = np.ones(count, dtype=np.bool_)
    return PatrolTrack(time, position, position, always, free_cells(plan, None))


def _twin_track(plan: PatrolPlan, record: Record, world: World) -> PatrolTrack:
    every = max(1, round(SAMPLE / float(record.time[1] - record.time[0])))
    rows = slice(None, None, every)
    return PatrolTrack(
        record.time[rows],
        record['truth'][rows, :2],
        record['reference_pose'][rows, :2],
        patrol_run.outside_avoidance(record)[rows],
        free_cells(plan, world),
        world,
        range_hits(record['truth'][rows], record['ranges'][rows]),
        patrol_run.contact_count(record),
        patrol_run.share_on_path(record),
    )


def range_hits(poses: Array, ranges: Array) -> Array:
    """Return where the rays of the range sensors ended, m, shape (k, 2).

    ``poses`` are x, y (m) and yaw (rad), shape (n, 3), ``ranges`` the readings of the eight
    sensors (m), shape (n, 8); those that are not finite hit nothing.
    """
    ends = ray_ends(poses, ranges, sensor_mounts(RangeSensorParameters())).reshape(-1, 2)
    return ends[np.isfinite(ends).all(axis=1)]


# -- claims, tables, figures and page -------------------------------------------------------------


PALETTE = (
    '#be123c', '#0284c7', '#65a30d', '#7c3aed', '#a16207', '#15803d', '#4338ca', '#6b7280'
)  # fmt: skip
"""Colours of the paths, ours first."""
_MOST_HITS = 4000
COVERED, TIMES_SLOWER = 0.9, 3.0
"""Share of the cells, and how many times longer than the boustrophedon a path may take for it."""
JUDGED_HORIZON, MARGIN = 5.0, 0.05
"""Horizon (s), and by which share of a random walk's skill that of a path may exceed it."""
HOLDS, FAILS, INCONCLUSIVE = 'holds', 'does not hold', 'inconclusive'


class Claim(NamedTuple):
    """A claim about our path, and what the seeds say of it."""

    text: str
    verdict: str
    numbers: str


def claims(study: PatrolStudy) -> list[Claim]:
    """Return the claims that the compared paths permit to be judged."""
    own, walk, lanes = (
        study.table.where(controller=name) for name in (OURS, 'random walk', 'boustrophedon')
    )
    found = []
    if own and lanes:
        found.append(_coverage_claim(study.plan, own, lanes))
    if own and walk and f'skill_{JUDGED_HORIZON:g}' in own[0]:
        found += [_error_claim(own, walk), _skill_claim(own, walk)]
    if own and study.plan.robot == 'twin':
        touched = sum(row['contacts'] > 0 for row in own)
        numbers = f'contacts in {touched} of {len(own)} patrols'
        found.append(Claim('the robot touches nothing', FAILS if touched else HOLDS, numbers))
    return found


def _verdict(excess: Difference) -> str:
    """Return what the interval of a quantity that should be at most 0 says."""
    if excess.mean + excess.half <= 0.0:
        return HOLDS
    return FAILS if excess.mean - excess.half > 0.0 else INCONCLUSIVE


def _coverage_claim(plan: PatrolPlan, own: Sequence[Row], lanes: Sequence[Row]) -> Claim:
    times, others = (
        [row[f'time_to_{100.0 * COVERED:g}'] for row in rows] for rows in (own, lanes)
    )
    text = (
        f'{100.0 * COVERED:g} % of the cells within {TIMES_SLOWER:g} times what the '
        'boustrophedon needs'
    )
    if not all(map(math.isfinite, others)):
        return Claim(text, INCONCLUSIVE, 'the boustrophedon does not reach it in this time')
    bound = TIMES_SLOWER * mean(others)
    # A patrol that never gets there took longer than it lasted, and nothing more is known of it.
    censored = [min(time, plan.duration) for time in times]
    verdict = _verdict(paired(censored, [TIMES_SLOWER * time for time in others]))
    if verdict == HOLDS and not all(map(math.isfinite, times)):
        verdict = INCONCLUSIVE
    within = sum(time <= bound for time in times)
    numbers = (
        f'in seconds: {_time(times)} against {TIMES_SLOWER:g} × {_time(others)} = {bound:.0f}; '
        f'{within} of {len(times)} seeds within it'
    )
    return Claim(text, verdict, numbers)


def _error_claim(own: Sequence[Row], walk: Sequence[Row]) -> Claim:
    column, share = f'prediction_error_{JUDGED_HORIZON:g}', 1.0 - MARGIN
    allowed = [share * row[column] for row in walk]
    above = paired([row[column] for row in own], allowed)
    return Claim(
        f'error of the observer at {JUDGED_HORIZON:g} s at least {100.0 * share:g} % of '
        'that on a random walk',
        _verdict(Difference(-above.mean, above.half)),
        f'in metres: {_cell(own, column)} against {_cell(walk, column)}, of which '
        f'{share * mean([row[column] for row in walk]):.3f}; difference '
        f'{format_interval(*above, "+")}',
    )


def _skill_claim(own: Sequence[Row], walk: Sequence[Row]) -> Claim:
    column = f'skill_{JUDGED_HORIZON:g}'
    allowed = MARGIN * mean([row[column] for row in walk])
    above = paired([row[column] for row in own], [row[column] for row in walk])
    return Claim(
        f'skill of the observer at {JUDGED_HORIZON:g} s within {100.0 * MARGIN:g} % of a random '
        "walk's",
        _verdict(Difference(above.mean - allowed, above.half)),
        f'{_cell(own, column)} against {_cell(walk, column)}; difference '
        f'{format_interval(*above, "+")}, allowed {allowed:.3f}',
    )


def _time(times: Sequence[float]) -> str:
    """Return a time (s) with its interval, or in how many seeds it was reached."""
    if all(map(math.isfinite, times)):
        return format_interval(mean(times), interval(times), digits=0)
    reached = sum(map(math.isfinite, times))
    return f'reached in {reached} of {len(times)}' if reached else 'not reached'


def claims_table(study: PatrolStudy) -> result_output.Table:
    """Return the claims with their verdicts."""
    rows = [
        (text, result_output.verdict_mark(verdict), numbers)
        for text, verdict, numbers in claims(study)
    ]
    return result_output.Table('', ('claim', 'verdict', 'measured'), rows, text=3, wrap=True)


def coverage_table(study: PatrolStudy) -> result_output.Table:
    """Return coverage, times, evenness and, on the twin, errors and contacts of each path."""
    shares = [f'{100.0 * share:g}' for share in SHARES]
    head = ['path', 'coverage, %', *(f'{share} %, s' for share in shares), 'evenness']
    twin = study.plan.robot == 'twin'
    if twin:
        head += ['path error, mm', 'on the path, %', 'avoiding, %', 'patrols with contacts']
    lines = []
    for name in study.plan.paths:
        rows = study.table.where(controller=name)
        line = [name, _cell(rows, 'coverage', 1, 100.0)]
        line += [_time([row[f'time_to_{share}'] for row in rows]) for share in shares]
        line.append(_cell(rows, 'evenness'))
        if twin:
            line.append(_cell(rows, 'path_error', 1, 1e3))
            line.append(_cell(rows, 'on_path', 1, 100.0))
            line.append(_cell(rows, 'avoiding', 1, 100.0))
            line.append(str(sum(row['contacts'] > 0 for row in rows)))
        lines.append(line)
    return result_output.Table('Coverage of a 20 × 20 grid', head, lines, (OURS,), wrap=True)


def surprise_table(study: PatrolStudy) -> result_output.Table:
    """Return skill of the observer, entropies and exponent of each path."""
    numbers = {
        **{f'skill at {horizon:g} s': f'skill_{horizon:g}' for horizon in HORIZONS},
        'error at 5 s, m': 'prediction_error_5',
        'median error at 5 s, m': 'prediction_median_5',
        'known to 25 cm at 5 s, share': 'known_5',
        'best predictor at 5 s': 'predictor_5',
        'permutation entropy': 'permutation_entropy',
        'spectral entropy': 'spectral_entropy',
        'exponent, 1/s': 'exponent',
    }
    lines = []
    for name in study.plan.paths:
        rows = study.table.where(controller=name)
        line = [name]
        for column in numbers.values():
            values = [row[column] for row in rows if column in row]
            words = bool(values) and isinstance(values[0], str)
            line.append(mode(values) if words else _cell(rows, column))
        lines.append(line)
    return result_output.Table(
        'How hard the path is to predict', ['path', *numbers], lines, (OURS,), wrap=True
    )


def _cell(rows: Sequence[Row], column: str, digits: int = 3, factor: float = 1.0) -> str:
    return result_output.format_mean(
        [factor * row[column] for row in rows if column in row], digits
    )


def description(plan: PatrolPlan) -> str:
    """Return in one paragraph what was driven and how it is counted."""
    left, bottom, right, top = plan.arena
    robots = {
        'exact': 'A robot that is always where its reference is, in an empty room',
        'twin': 'Digital twin with noise, lag, slip and 10 % of the commands lost, position '
        f'given within 3 mm, among {BOXES} unknown boxes, with the controller and the keep-out of '
        'the nodes',
    }
    cells = (
        f' Cells whose centre is within {CLEARANCE:g} m of a wall or box do not count.'
        if plan.robot == 'twin'
        else ''
    )
    return (
        f'{robots[plan.robot]}; {right - left:g} m × {top - bottom:g} m, '
        f'{plan.duration / 60.0:g} min, at most {LIMITS.linear:g} m/s and '
        f'{LIMITS.angular:g} rad/s for every path; '
        f'{len(plan.seeds)} seeds, {plan.seeds[0]} to {plan.seeds[-1]}. '
        'Mean ± half the 95 % interval over the seeds. A cell is covered when the centre of the '
        f'robot has entered it.{cells}'
    )


EXPLANATION = (
    'Evenness: entropy of the time in the cells, 1 for an even spread. Skill: an observer who '
    'learnt from the first half predicts positions in the second half; 1 exact, 0 no better than '
    'the mean position; the best of six predictors counts, and its error is in metres, because '
    'a path that covers more of the room has a higher skill at the same error. Entropies: 1 for '
    'white noise. The exponent is fitted to the path as driven; any data give a number, and a '
    'random path has no exponent, so it compares paths and proves no chaos.'
)


# -- figures --------------------------------------------------------------------------------------


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
    from t3mpc_ros.evaluation.figure_style import new_figure  # a run does without it

    figure, axis = new_figure(3.2)
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
    from t3mpc_ros.evaluation.figure_style import new_figure, whisker

    columns = [f'skill_{horizon:g}' for horizon in HORIZONS]
    if not all(columns[0] in row for row in study.table):
        return None
    figure, axis = new_figure(3.2)
    for place, (name, style) in enumerate(_styles(study.plan.paths)):
        values = [study.table.values(column, controller=name) for column in columns]
        halves = [whisker(interval(row)) for row in values]
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
    html_page.TitledDrawing('coverage', 'Coverage over time', draw_coverage),
    html_page.TitledDrawing('heat_maps', 'Time in the cells, first seed', draw_heat_maps),
    html_page.TitledDrawing(
        'predictability', 'Skill of an observer who watched the first half', draw_predictability
    ),
    html_page.TitledDrawing(
        'paths', 'Paths, first seed; orange: hits of the range sensors', draw_paths
    ),
)


def _panels(study: PatrolStudy) -> tuple[Any, list[tuple[Any, Row]]]:
    """Return a figure, and an axis with its row for each patrol that is drawn."""
    from t3mpc_ros.evaluation.figure_style import new_figure

    drawn = [row for row in study.table if 'track' in row]
    columns = min(2, len(drawn))
    rows = -(-len(drawn) // columns)
    left, bottom, right, top = study.plan.arena
    height = 0.4 + rows * (0.35 + 5.0 / columns * (top - bottom) / (right - left))
    figure, axes = new_figure(height, (rows, columns), sharex=True, sharey=True)
    axes = axes.ravel()
    for axis, row in zip(axes, drawn, strict=False):
        axis.set_title(row['controller'])
    for axis in axes[len(drawn) :]:
        axis.set_visible(False)
    return figure, list(zip(axes, drawn, strict=False))


def _draw_room(axis: Any, world: World | None) -> None:
    from t3mpc_ros.evaluation.figure_style import draw_world

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


# -- page -----------------------------------------------------------------------------------------


def markdown(study: PatrolStudy) -> str:
    """Return all tables in Markdown."""
    tables = [coverage_table(study), surprise_table(study)]
    if claims(study):
        tables.append(claims_table(study))
    texts = [description(study.plan), *(each.markdown() for each in tables), EXPLANATION]
    return '\n\n'.join(texts)


def page(study: PatrolStudy, drawn: Mapping[str, bytes]) -> str:
    """Return the page as self-contained HTML, with pictures by their stems."""
    shown = {each.stem: [html_page.Picture(each.title, drawn[each.stem], each.title)]
             for each in PICTURES if each.stem in drawn}  # fmt: skip
    blocks: list[html_page.Block] = [*shown.get('coverage', ()), html_page.Contents()]
    blocks.append(html_page.Paragraph(description(study.plan)))
    if claims(study):
        blocks += [html_page.Heading('Does our path do what it should?'), claims_table(study)]
    blocks += [html_page.Heading('Coverage'), coverage_table(study), *shown.get('heat_maps', ())]
    blocks += [html_page.Heading('Predictability'), surprise_table(study)]
    blocks += [*shown.get('predictability', ()), html_page.Paragraph(EXPLANATION, 'quiet')]
    blocks += [html_page.Heading('Paths'), *shown.get('paths', ())]
    return html_page.html_page('Patrols compared', blocks)


def record(study: PatrolStudy) -> dict[str, Any]:
    """Return plan, claims and every number for a JSON file."""
    plan = study.plan
    paths = {}
    for name in plan.paths:
        rows = study.table.where(controller=name)
        paths[name] = {
            'runs': [
                {key: value for key, value in row.items()
                 if key != 'seed' and isinstance(value, int | float)}
                for row in rows
            ],
            'coverage': np.mean([row['curve'] for row in rows], axis=0).tolist(),
        }  # fmt: skip
    return {
        'format': 1,
        'version': VERSION,
        'robot': plan.robot,
        'seeds': list(plan.seeds),
        'duration': plan.duration,
        'arena': list(plan.arena),
        'limits': LIMITS.to_dict(),
        'claims': [claim._asdict() for claim in claims(study)],
        'paths': paths,
    }
