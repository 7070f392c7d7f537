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
"""Changes that a patrol finds, time to find them, false alarms, and errors of its pose.

``python bench/patrol_changes.py``: the tables of ``docs/patrol.md``, in Markdown. The simulated
robot patrols a known room on a planned path by the pose of its own localisation, with noise, slip
and 10 % of the commands lost:

* 20 planted changes, 5 min each, in ``room`` and in an office: pillars that appear, things of the
  map that are not there, people who walk to and fro for a minute;
* ``--hours`` without a change in ``room``, half an hour each.

A change is first seen when a beam of an exact sensor at the true pose reads something else than in
the known room, by 0.1 m and within 0.75 m. An event is right at less than 0.25 m from the surface
of the thing, anywhere on its way; every other event is a false alarm. Runs are kept in a file, and
an interrupted experiment goes on.
"""

import argparse
from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import tempfile
from typing import Any, NamedTuple

import numpy as np
import yaml

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.evaluation.experiment import ResultTable, Run, print_report, run_experiment
from t3mpc_ros.evaluation.patrol.localization_study import localization_errors
from t3mpc_ros.evaluation.patrol.patrol_run import (
    START,
    PatrolScenario,
    portrait_points,
    run_patrol,
)
from t3mpc_ros.evaluation.run_cache_key import digest
from t3mpc_ros.evaluation.run_record import Record
from t3mpc_ros.geometry.types import NANOSECONDS, Array, State
from t3mpc_ros.localization.change_detection import Change
from t3mpc_ros.localization.localizer import Localizer
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import WORLDS_FOLDER, MovingDisc, World, cast_rays, load_world

OFFICE = """
name: office
walls:
  - points: [[-2.0, -1.6], [2.0, -1.6], [2.0, 1.6], [-2.0, 1.6]]
    closed: true
  - points: [[0.6, 1.6], [0.6, 0.55]]
boxes:
  - {center: [-1.7, 0.2], size: [0.4, 0.9]}
  - {center: [1.4, 1.35], size: [0.7, 0.4]}
  - {center: [0.9, -0.75], size: [0.5, 0.35], yaw: 0.3}
circles:
  - {center: [-0.75, 0.95], radius: 0.05}
  - {center: [-0.35, 0.95], radius: 0.05}
  - {center: [-0.75, -0.95], radius: 0.18}
patches:
  - {center: [0.2, -0.3], radius: 0.3, grip: 0.3}
"""
ROOMS = {'room': (WORLDS_FOLDER / 'room.yaml').read_text(encoding='utf-8'), 'office': OFFICE}
MISSING = {
    'room': (
        ('boxes', {'center': [0.2, 1.0], 'size': [0.35, 0.25], 'yaw': 0.4}),
        ('circles', {'center': [0.9, -0.3], 'radius': 0.12}),
        ('boxes', {'center': [-1.2, 0.0], 'size': [0.3, 0.3]}),
    ),
    'office': (
        ('boxes', {'center': [-1.0, -0.3], 'size': [0.3, 0.2], 'yaw': 0.5}),
        ('circles', {'center': [1.3, 0.3], 'radius': 0.1}),
        ('boxes', {'center': [-0.1, -1.3], 'size': [0.5, 0.3]}),
    ),
}
"""Entries of world files that the map has and the room lacks."""
KINDS = ('new',) * 4 + ('missing',) * 3 + ('moving',) * 3
PLANTED_MINUTES, UNCHANGED_MINUTES = 5.0, 30.0
APPEARS = 30.0, 90.0  # when a change appears, s of the drive
STAYS = 60.0  # time for which a person walks, s
SEEN_DIFFERENCE, SEEN_WITHIN = 0.1, 0.75
"""Difference of two readings, and distance of the nearer one, with which a change is seen, m."""
NEAR = 0.25  # distance of an event from the surface of the thing up to which it is right, m
WANTED_TIME = 60.0  # time after the first sight within which a change is to be found, s


class Planted(NamedTuple):
    """A run with a change."""

    room: str
    number: int  # 0 to 9: the change, see :data:`KINDS`
    minutes: float = PLANTED_MINUTES

    @property
    def kind(self) -> str:
        """What is planted."""
        return KINDS[self.number]

    @property
    def seed(self) -> int:
        """Of robot, path and change."""
        return 200 + self.number + 10 * list(ROOMS).index(self.room)

    @property
    def appears(self) -> float:
        """When it appears, s of the twin; what is missing is so from the start."""
        return float(np.random.default_rng((self.seed, 50)).uniform(*APPEARS))


class Visitor:
    """A pillar that appears, or a person who walks to and fro ahead of the robot for a minute."""

    def __init__(self, planted: Planted, room: World) -> None:
        self._planted, self._room = planted, room
        self._generator = np.random.default_rng((planted.seed, 51))
        self.disc: MovingDisc | None = None  # what has come

    def __call__(self, time: float, state: State) -> MovingDisc | None:
        """Return what appears at a time of the twin (s), where it does not touch the robot."""
        if self.disc is not None or time < self._planted.appears:
            return None
        draw, pose = self._generator.uniform, state.pose
        if self._planted.kind == 'new':
            radius, speed, vanishes = float(draw(0.05, 0.15)), 0.0, math.inf
            points = draw([-1.75, -1.3], [1.75, 1.3])[None]
            room = 0.15
            if math.dist(points[0], pose[:2]) < radius + 0.45:
                return None
        else:
            radius, speed, vanishes = 0.12, float(draw(0.15, 0.3)), time + STAYS
            direction = pose.yaw + float(draw(-0.6, 0.6))
            ahead = np.array([math.cos(direction), math.sin(direction)])
            middle = np.array(pose[:2]) + draw(0.5, 0.8) * ahead
            aside = draw(0.4, 0.8) * np.array([-ahead[1], ahead[0]])
            points, room = np.array([middle + aside, middle - aside]), 0.1
        way = np.linspace(points[0], points[-1], 9).tolist()
        if all(self._room.is_free(x, y, radius + room) for x, y in way):
            self.disc = MovingDisc(radius, points, speed, time, time, vanishes, True)
        return self.disc


def is_right(change: Change, disc: MovingDisc) -> bool:
    """Return whether an event is at a thing, on its way."""
    way = np.linspace(disc.points[0], disc.points[-1], 30)
    gaps = np.hypot(*(way - np.array([change.x, change.y])).T) - disc.radius
    later = change.found_ns / NANOSECONDS >= disc.appears
    return later and float(gaps.min()) < NEAR


def first_sight(truth: Array, times: Array, known: World, there: World) -> float:
    """Return when (s of the twin) exact sensors see something else than in the known room.

    truth, times : poses, shape (n, 3), and times of the twin (s), shape (n,)
    """
    mounts = sensor_mounts(RangeSensorParameters())
    which, far = np.arange(len(mounts)), np.empty(len(mounts))
    near = far.copy()
    for pose, time in zip(truth.tolist(), times.tolist(), strict=True):
        now = there.at(time)
        cast_rays(*pose, mounts, which, known.segments, known.circles, far)
        cast_rays(*pose, mounts, which, now.segments, now.circles, near)
        apart = np.abs(np.minimum(far, 1.0) - np.minimum(near, 1.0)) > SEEN_DIFFERENCE
        if (apart & (np.minimum(far, near) < SEEN_WITHIN)).any():
            return time
    return math.inf


def planted_row(
    planted: Planted, changes: Sequence[Change], record: Record, disc: MovingDisc, known: World
) -> dict[str, Any]:
    """Return what was found of a change."""
    rows = slice(0, None, 5)
    there = load_text(ROOMS[planted.room])
    if planted.kind != 'missing':
        there = World(**{**vars(there), 'moving': (disc,)})
    sight = first_sight(record['truth'][rows], START + record.time[rows], known, there)
    right = [each for each in changes if is_right(each, disc)]
    found = min((each.found_ns / NANOSECONDS for each in right), default=math.inf)
    size = 2.0 * disc.radius
    named = [each for each in right if each.kind.name.lower() == planted.kind]
    best = (named or right or [None])[0]
    return {
        **localization_errors(record),
        'sight': sight,
        'found': found - sight,
        'named': bool(named),
        'events': len(right),
        'false': len(changes) - len(right),
        'size': size,
        'size_found': math.nan if best is None else best.size,
        'confidence': math.nan if best is None else best.confidence,
    }


def load_text(text: str) -> World:
    """Return the world of a text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'world.yaml'
        path.write_text(text, encoding='utf-8')
        return load_world(path)


def map_text(planted: Planted) -> tuple[str, MovingDisc | None]:
    """Return the world file of the map, and what the room lacks as a disc of its size."""
    if planted.kind != 'missing':
        return ROOMS[planted.room], None
    name, entry = MISSING[planted.room][planted.number - KINDS.index('missing')]
    content = yaml.safe_load(ROOMS[planted.room])
    content.setdefault(name, []).append(entry)
    radius = entry['radius'] if name == 'circles' else 0.5 * max(entry['size'])
    return yaml.safe_dump(content), MovingDisc(radius, np.array([entry['center']]), 0.0, 0.0, 0.0)


def patrol(
    room: str, known: str, seed: int, minutes: float, visitor: Visitor | None = None
) -> tuple[Record, tuple[Change, ...]]:
    """Return the record of a patrol and its events; room and map are texts of world files."""
    localizers: list[Localizer] = []
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / name for name in ('room.yaml', 'map.yaml')]
        for path, text in zip(paths, (room, known), strict=True):
            path.write_text(text, encoding='utf-8')
        scenario = PatrolScenario(
            seed=seed,
            duration=60.0 * minutes,
            world=str(paths[0]),
            known_world=str(paths[1]),
            map=str(paths[1]),
            localization='filter',
            plan=PlanParameters(enabled=True),
        )
        points = portrait_points(seed, PortraitParameters())
        record = run_patrol(points, scenario, None, visitor, localizers.append)
    return record, localizers[0].changes.changes


def measured(job: tuple[Any, str]) -> Mapping[str, Any]:
    """Return the row of a run: a change, or the seed and minutes of a patrol without one."""
    planted, room = job
    if not isinstance(planted, Planted):
        seed, minutes = planted
        record, changes = patrol(ROOMS[room], ROOMS[room], seed, minutes)
        return {'false': len(changes), **localization_errors(record)}
    text, disc = map_text(planted)
    visitor = None if disc else Visitor(planted, load_text(ROOMS[room]))
    record, changes = patrol(ROOMS[room], text, planted.seed, planted.minutes, visitor)
    disc = visitor.disc if visitor else disc
    if disc is None:
        raise RuntimeError(f'no place for {planted}')
    return planted_row(planted, changes, record, disc, load_text(text))


def planted_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of the planted changes, in Markdown."""
    head = '| room | change | seed | found after, s | named | size, m: true, found | false '
    lines = [f'{head}| position rms, mm | lost, s |', '|---' * 9 + '|']
    for row in rows:
        found = f'{row["found"]:.1f}' if math.isfinite(row['found']) else 'not found'
        found = found if math.isfinite(row['sight']) else 'not in sight'
        size = f'{row["size"]:.2f}, {row["size_found"]:.2f}'
        named = 'yes' if row['named'] else 'no'
        pose = f'{1e3 * row["position"]:.1f}', f'{row["lost"]:.0f}'
        cells = row['room'], row['change'], row['seed'], found, named, size, row['false'], *pose
        lines.append('| ' + ' | '.join(map(str, cells)) + ' |')
    seen = [row for row in rows if math.isfinite(row['sight'])]
    soon = sum(row['found'] <= WANTED_TIME for row in seen)
    lines.append(
        f'\n{soon} of {len(seen)} found within {WANTED_TIME:g} s of the first sight, '
        f'{sum(row["named"] for row in seen)} with the right kind, '
        f'{sum(row["false"] for row in rows)} false alarms.'
    )
    return '\n'.join(lines)


def unchanged_table(rows: Sequence[Mapping[str, Any]], minutes: float) -> str:
    """Return the table of the patrols without a change, in Markdown."""
    lines = ['| seed | position rms, mm | yaw rms, degrees | largest, mm | lost, s | false |']
    lines += ['|---' * 6 + '|']
    for row in rows:
        cells = (
            row['seed'],
            f'{1e3 * row["position"]:.1f}',
            f'{math.degrees(row["yaw"]):.2f}',
            f'{1e3 * row["largest"]:.0f}',
            f'{row["lost"]:.0f}',
            row['false'],
        )
        lines.append('| ' + ' | '.join(map(str, cells)) + ' |')
    hours = len(rows) * minutes / 60.0
    lines.append(f'\n{sum(row["false"] for row in rows)} false alarms in {hours:g} h.')
    return '\n'.join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--hours', type=float, default=10.0, help='without a change (default 10)')
    parser.add_argument('--workers', type=int, default=1, help='processes (default 1)')
    parser.add_argument('--output', type=Path, default=Path('runs/patrol'), help='folder of runs')
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    store = options.output / 'changes.runs.jsonl'

    def rows_of(jobs: Sequence[tuple[Any, str]], kinds: Sequence[str]) -> ResultTable:
        runs = [
            Run(job, {'change': kind, 'room': job[1], 'seed': seed_of(job[0])}, digest(job))
            for job, kind in zip(jobs, kinds, strict=True)
        ]
        workers = options.workers
        return run_experiment(runs, measured, workers, store=store, report=print_report)

    planted = [(Planted(room, number), room) for number in range(len(KINDS)) for room in ROOMS]
    kinds = [each.kind for each, _ in planted]
    print(planted_table(rows_of(planted, kinds)), flush=True)
    count = round(60.0 * options.hours / UNCHANGED_MINUTES)
    unchanged = [((seed, UNCHANGED_MINUTES), 'room') for seed in range(101, 101 + count)]
    print(unchanged_table(rows_of(unchanged, ['none'] * count), UNCHANGED_MINUTES))


def seed_of(run: Planted | tuple[int, float]) -> int:
    """Return the seed of a run."""
    return run.seed if isinstance(run, Planted) else run[0]


if __name__ == '__main__':
    main()
