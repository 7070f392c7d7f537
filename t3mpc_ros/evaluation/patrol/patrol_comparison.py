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

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Row, Run, run_experiment
from t3mpc_ros.evaluation.own_code import digest
from t3mpc_ros.evaluation.patrol import patrol_run
from t3mpc_ros.evaluation.patrol.baseline_paths import BASELINE_PATHS, Rectangle
from t3mpc_ros.evaluation.patrol.patrol_metrics import (
    CoverageGrid,
    coverage_at,
    patrol_metrics,
    visits,
)
from t3mpc_ros.evaluation.run_record import Record
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import PathTiming
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.types import ORIGIN, Array
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.robot.sensor_mounts import ray_ends, sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import World, parse_world

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
