# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Our patrol and the baselines: the same robot, room, time, speed limits and safety for all.

Every path is a polyline. Timing under the limits of speed and acceleration makes it a reference
(:mod:`t3mpc_ros.geometry.path_timing`), which one of two robots follows: ``exact`` is always where
the reference is, in an empty room; ``twin`` is the digital twin with noise, lag, slip and lost
commands, among boxes that it does not know, with the controller of the nodes and its keep-out.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
import hashlib
import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.portrait import PortraitParameters
from t3mpc_ros.evaluation.paper.experiment_runs import source_digest
from t3mpc_ros.evaluation.patrol.baseline_paths import BASELINE_PATHS, Rectangle
from t3mpc_ros.evaluation.patrol.coverage import CoverageGrid, Visits, coverage_at
from t3mpc_ros.evaluation.patrol.patrol_metrics import PatrolMetrics, patrol_metrics
from t3mpc_ros.evaluation.patrol.patrol_run import (
    PatrolScenario,
    contact_count,
    outside_avoidance,
    portrait_points,
    room_with_boxes,
    run_patrol,
    world_file,
)
from t3mpc_ros.evaluation.patrol.predictability import Skill
from t3mpc_ros.evaluation.record import Record
from t3mpc_ros.evaluation.result_file import ResultFile, run_missing_jobs
from t3mpc_ros.evaluation.workers import WorkerPool
from t3mpc_ros.geometry.arena import Arena
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming
from t3mpc_ros.geometry.types import ORIGIN, Array
from t3mpc_ros.robot.description import ray_ends, sensor_mounts
from t3mpc_ros.robot.sensor_conversions import RangeSensorParameters
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
    arena: tuple[float, ...] = PortraitParameters().arena
    """left, bottom, right, top of the area of the paths, m; the walls of the twin's room are
    0.25 m outside."""
    limits: MotionLimits = MotionLimits()

    def __post_init__(self) -> None:
        for name in self.paths:
            if name not in PATHS:
                raise ValueError(f'path must be one of {", ".join(PATHS)}: got {name}')
        if self.robot not in ROBOTS:
            raise ValueError(f'robot must be one of {", ".join(ROBOTS)}: got {self.robot}')
        if not self.paths or not self.seeds:
            raise ValueError('at least one path and one seed must be given')
        if not self.duration >= 1.0:
            raise ValueError(f'duration must be at least 1 s: got {self.duration:g}')
        if len(self.arena) != 4:
            raise ValueError(
                f'arena must be left, bottom, right, top: got {len(self.arena)} numbers'
            )
        Arena(self.arena)
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


class PatrolResult(NamedTuple):
    """Figures of one patrol, and for the first seed its track."""

    metrics: PatrolMetrics
    curve: Array
    """Coverage at :data:`CURVE` even times from 0 to the duration."""
    contacts: int
    avoiding: float
    """Share of the time in which the robot avoids an obstacle."""
    track: PatrolTrack | None


Results = Mapping[str, Sequence[PatrolResult]]
"""Results by path, in the order of the seeds."""


def compare_patrols(
    plan: PatrolPlan,
    file: Path,
    workers: int | Executor = 1,
    report: Callable[[str], None] | None = None,
) -> Results:
    """Return the results of every path and seed of a plan.

    Finished patrols are kept in ``file``, and those that it holds are not run again.
    ``report`` receives messages; with None there is no progress line either.
    """
    keys = {(name, seed): _run_key(plan, name, seed) for seed in plan.seeds for name in plan.paths}
    jobs = {key: ((plan, seed), NamedPath(name)) for (name, seed), key in keys.items()}

    def run(missing: 'Sequence[_Job]') -> Iterator[tuple[int, PatrolResult]]:
        with WorkerPool(workers) as pool:
            yield from pool.map(measured_patrol, missing)

    kept = ResultFile(file, _encoded, partial(_decoded, plan))
    found = run_missing_jobs(kept, jobs, run, report)
    return {name: [found[keys[name, seed]] for seed in plan.seeds] for name in plan.paths}


def _run_key(plan: PatrolPlan, name: str, seed: int) -> str:
    """Return a digest of all that determines a result; that of the first seed has a track."""
    run = replace(plan, paths=(name,), seeds=(seed,)), seed == plan.seeds[0]
    content = repr((VERSION, source_digest(every=True), run))
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def _encoded(key: str, result: PatrolResult) -> str:
    metrics, curve, contacts, avoiding, track = result
    row = {
        'run': key,
        'metrics': {**vars(metrics), 'times': [*metrics.times.items()]},
        'curve': curve,
        'contacts': contacts,
        'avoiding': avoiding,
        'track': track and (*track[:4], track.hits, track.contacts),
    }
    return json.dumps(row, default=np.ndarray.tolist)


def _decoded(plan: PatrolPlan, line: str) -> tuple[str, PatrolResult]:
    row = json.loads(line)
    metrics, track = row['metrics'], row['track']
    first, dwell, duration = metrics['visits']
    metrics['visits'] = Visits(np.array(first), np.array(dwell), duration)
    metrics['times'] = dict(metrics['times'])
    metrics['skills'] = tuple(Skill(*each) for each in metrics['skills'])
    if track is not None:
        *rows, contacts = track
        time, position, reference, counted, hits = map(np.array, rows)
        twin = plan.robot == 'twin'
        world = parse_world(plan_world(plan, plan.seeds[0]), 'room') if twin else None
        cells, hits = free_cells(plan, world), hits.reshape(-1, 2)
        track = PatrolTrack(time, position, reference, counted, cells, world, hits, contacts)
    curve, contacts, avoiding = np.array(row['curve']), row['contacts'], row['avoiding']
    return row['run'], PatrolResult(PatrolMetrics(**metrics), curve, contacts, avoiding, track)


class NamedPath(NamedTuple):
    """A path by its name."""

    name: str


_Job = tuple[tuple[PatrolPlan, int], NamedPath]


def measured_patrol(job: _Job) -> PatrolResult:
    """Return the result of a plan's seed and a path."""
    (plan, seed), path = job
    track = patrol_track(plan, path.name, seed)
    reference = np.where(track.counted[:, None], track.reference, math.nan)
    x, y = track.position.T
    metrics = patrol_metrics(track.time, x, y, track.grid, reference)
    times = np.linspace(0.0, plan.duration, CURVE)
    assert metrics.visits is not None
    return PatrolResult(
        metrics,
        coverage_at(metrics.visits, track.grid, times),
        track.contacts,
        1.0 - float(track.counted.mean()),
        track if seed == plan.seeds[0] else None,
    )


def patrol_track(plan: PatrolPlan, name: str, seed: int) -> PatrolTrack:
    """Return the track of one path and seed; equal arguments give equal tracks."""
    points = path_points(plan, name, seed)
    if plan.robot == 'exact':
        return _exact_track(plan, points)
    text = plan_world(plan, seed)
    walls = text.partition('boxes:')[0]
    with world_file(walls) as known, world_file(text) as path:
        scenario = PatrolScenario(
            seed=seed,
            duration=plan.duration,
            known_world=known,
            world=path,
            limits=plan.limits,
        )
        record = run_patrol(points, scenario)
    return _twin_track(plan, record, parse_world(text, 'room'))


def path_points(plan: PatrolPlan, name: str, seed: int) -> Iterator[Array]:
    """Return the pieces of a path, m, each of shape (k, 2); they never end before the patrol."""
    if name == OURS:
        parameters = PortraitParameters.from_dict({'arena': list(plan.arena)})
        return portrait_points(seed, plan.limits, parameters)
    length = plan.limits.linear * plan.duration + 10.0
    return iter([BASELINE_PATHS[name](plan.area, length, np.random.default_rng((seed, 21)))])


def plan_world(plan: PatrolPlan, seed: int) -> str:
    """Return the room of a seed as YAML: walls 0.25 m around the arena, boxes, slippery floor."""
    left, bottom, right, top = plan.arena
    size = (2.0 * max(-left, right) + 0.5, 2.0 * max(-bottom, top) + 0.5)
    return room_with_boxes(seed, size, BOXES)


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
    timing = PathTiming(plan.limits, WheelGeometry(), SAMPLE, ORIGIN)
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
        outside_avoidance(record)[rows],
        free_cells(plan, world),
        world,
        range_hits(record['truth'][rows], record['ranges'][rows]),
        contact_count(record),
    )


def range_hits(poses: Array, ranges: Array) -> Array:
    """Return where the rays of the range sensors ended, m, shape (k, 2).

    Parameters
    ----------
    poses
        x, y (m), yaw (rad), shape (n, 3).
    ranges
        Readings of the eight sensors, m, shape (n, 8); those that are not finite hit nothing.
    """
    ends = ray_ends(poses, ranges, sensor_mounts(RangeSensorParameters())).reshape(-1, 2)
    found: Array = ends[np.isfinite(ends).all(axis=1)]
    return found
