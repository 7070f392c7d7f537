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
"""Safety of a patrol: sensors that fail, things that are placed later, people, what is not seen.

Each case is a patrol (:mod:`t3mpc_ros.evaluation.patrol.patrol_run`) with a fault of the sensors
or with obstacles that depend on where the robot is; its row says what the robot touched, how
often, how fast and for how long, and how it came to rest.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Row, Run, run_experiment
from t3mpc_ros.evaluation.patrol import patrol_run
from t3mpc_ros.evaluation.result_output import EMPTY_CELL, Table
from t3mpc_ros.evaluation.run_record import RATE, Record, spans_of
from t3mpc_ros.geometry.types import Array, State
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.plant.bumper_contact import BumperParameters
from t3mpc_ros.simulation.world import MovingDisc, World, cast_rays, clearance, parse_world

ROOM = (4.0, 3.0)
"""Size of the room, m."""
BOXES = 3
"""Boxes that the sensors see."""
PERSON_SPEED, PERSON_RADIUS, PERSON_GAP = 0.3, 0.12, 0.15
"""Speed of a person (m/s), radius of the legs (m), and distance ahead of the robot at which the
person stops (m)."""
PERSON_STAYS = 6.0
"""s"""
PUSHES = 1e-4
"""Dent of the bumper from which on something pushes it, m: 2 N."""
SAME_PLACE = 0.3
"""Distance between two contacts that are at one place, m."""
BOUNCE = 1.0
"""Longest gap within one contact, s: a bumper bounces."""
SEEN_WITHIN, SEEN_FOR = 0.75, 0.5
"""Distance at which a sensor surely sees what is across its beam (m), and the time for which a
beam must have met a thing that the robot has seen: that in which it comes to rest (s)."""
OWN_SPEED = 0.005
"""Speed towards what it touches above which the robot has run into it, m/s."""
RADIUS = BumperParameters().radius


class PlacedThings:
    """Pillars that appear and go after 30 s, one every 4 s: ahead of the robot, or anywhere."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.default_rng((seed, 41))

    def __call__(self, time: float, state: State) -> MovingDisc | None:
        """Return what appears at a time of the twin (s), given the true state of the robot."""
        if round(time * RATE) % (4 * RATE) or time < 10.0:
            return None
        draw = self._generator.uniform
        radius, gap = float(draw(0.03, 0.15)), float(draw(0.25, 1.0))
        angle = state.pose.yaw + float(draw(-0.7, 0.7))
        away = RADIUS + gap + radius
        x, y = state.pose.x + away * math.cos(angle), state.pose.y + away * math.sin(angle)
        if round(time) % 8:
            x, y = draw(-0.5, 0.5, 2) * np.array(ROOM)
            if math.dist((x, y), state.pose[:2]) < RADIUS + radius + 0.25:
                return None
        return MovingDisc(radius, np.array([[x, y]]), 0.0, 0.0, time, time + 30.0)


class People:
    """A person who comes from a side or from ahead, and stops closely ahead of the robot."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.default_rng((seed, 42))
        self._next = 10.0

    def __call__(self, time: float, state: State) -> MovingDisc | None:
        """Return a person who sets off at a time of the twin (s) towards a robot that drives."""
        pose, twist = state.pose, state.twist
        if time < self._next or twist.linear < 0.1 or abs(twist.angular) > 0.5:
            return None
        self._next = time + PERSON_STAYS + 6.0
        walk = float(self._generator.uniform(0.3, 0.9))
        side = float(self._generator.choice([-1.0, 0.0, 1.0])) * 0.5 * math.pi
        away = walk / PERSON_SPEED * twist.linear + RADIUS + PERSON_GAP + PERSON_RADIUS
        end = np.array([math.cos(pose.yaw), math.sin(pose.yaw)]) * away + pose[:2]
        heading = pose.yaw + side
        begin = end + walk * np.array([math.cos(heading), math.sin(heading)])
        leaves = time + walk / PERSON_SPEED + PERSON_STAYS
        points = np.array([begin, end])
        return MovingDisc(PERSON_RADIUS, points, PERSON_SPEED, time, time, leaves)


def unseen_boxes(seed: int) -> str:
    """Return boxes and a pillar below the beams, as entries of a world file."""
    generator = np.random.default_rng((seed, 43))
    places: list[tuple[float, float]] = []
    while len(places) < 3:
        x, y = generator.uniform([-1.6, -1.1], [1.6, 1.1]).tolist()
        if min(math.dist((x, y), each) for each in [(0.0, 0.0), *places]) > 0.7:
            places.append((x, y))
    boxes = [
        f'  - {{center: [{x:.3f}, {y:.3f}], size: [0.3, 0.2], yaw: {y:.3f}, unseen: true}}'
        for x, y in places[:2]
    ]
    x, y = places[2]
    pillar = f'  - {{center: [{x:.3f}, {y:.3f}], radius: 0.08, unseen: true}}'
    return '\n'.join([*boxes, 'circles:', pillar])


@dataclass(frozen=True)
class SafetyCase:
    """What is special about a patrol."""

    visitors: Callable[[int], Callable[[float, State], MovingDisc | None]] | None = None
    """By seed, what comes while the robot drives."""
    unseen: bool = False
    """Whether there are boxes that the sensors do not see."""
    faults: tuple[patrol_run.FaultKind, int] | None = None
    """Fault of the range sensors, and how many of them have it."""


FAULTS_BEGIN, FAULTS_END = 8.0, 38.0
"""First and last instant at which sensors fail, s of the twin."""
LEAST_DURATION = FAULTS_END + 2.0
"""Length of a run in which the robot also comes to rest after that, s."""


def cut_time(seed: int) -> float:
    """Return when the sensors of a seed fail, s of the twin."""
    return float(np.random.default_rng((seed, 44)).uniform(FAULTS_BEGIN, FAULTS_END))


CASES: Mapping[str, SafetyCase] = {
    'standing': SafetyCase(),
    'placed later': SafetyCase(visitors=PlacedThings),
    'people': SafetyCase(visitors=People),
    'unseen': SafetyCase(unseen=True),
    'sensors silent': SafetyCase(faults=('silent', 8)),
    'front sensors frozen': SafetyCase(faults=('frozen', 2)),
}
"""The cases by name."""


class Contact(NamedTuple):
    """One contact, with the bounces of the bumper."""

    begin: float
    """s of the record"""
    pushing: float
    """Longest time without release, s."""
    speed: float
    """Speed of the robot towards what it touches at the begin, m/s; 0 where it was run into."""
    place: tuple[float, float]
    """Where the robot was, m."""
    seen: bool
    """Whether a beam had met the thing for :data:`SEEN_FOR` before."""


def gaps(record: Record, world: World) -> tuple[Array, Array]:
    """Return the gap between bumper and obstacles (m), and its rate by the robot's own motion.

    The world is that with all that moved; its time is that of the twin.
    """
    truth, twist = record['truth'], record['twist']
    gap, closing = np.empty(len(record)), np.zeros(len(record))
    for row, ((x, y, yaw), (speed, _)) in enumerate(
        zip(truth.tolist(), twist.tolist(), strict=True)
    ):
        now = world.at(patrol_run.START + float(record.time[row]))
        gap[row] = clearance(x, y, *now.obstacles) - RADIUS
        if gap[row] < 0.01:
            step = 1e-3 * math.copysign(1.0, speed)
            ahead = clearance(x + step * math.cos(yaw), y + step * math.sin(yaw), *now.obstacles)
            closing[row] = abs(speed) * (gap[row] + RADIUS - ahead) / 1e-3
    return gap, closing


def contacts(record: Record, world: World) -> list[Contact]:
    """Return the contacts of a run, in their order."""
    gap, closing = gaps(record, world)
    apart = np.flatnonzero(gap < 0.0)
    touches = gap < 0.0
    for last, following in pairwise(apart):
        if following - last < BOUNCE * RATE:
            touches[last:following] = True
    found = []
    for rows in spans_of(touches):
        begin = rows.start
        pushes = [each.stop - each.start for each in spans_of(gap[rows] < -PUSHES)]
        speed = max(float(closing[max(begin - 3, 0) : begin + 1].max()), 0.0)
        place = tuple(record['truth'][begin, :2].tolist())
        pushing = max(pushes, default=0) / RATE
        found.append(Contact(begin / RATE, pushing, speed, place, was_seen(record, world, begin)))
    return found


def was_seen(record: Record, world: World, begin: int) -> bool:
    """Return whether a beam had met what is touched at a row; walls and boxes always were."""
    x, y, _ = record['truth'][begin].tolist()
    time = patrol_run.START + float(record.time[begin])
    plain, hidden = clearance(x, y, world.segments, world.circles), clearance(x, y, *world.unseen)
    there = [each for each in world.moving if each.appears <= time < each.vanishes]
    away = [math.dist(each.position(time), (x, y)) - each.radius for each in there]
    if not away or min(away) > min(plain, hidden):
        return plain < hidden
    thing = there[int(np.argmin(away))]
    mounts = sensor_mounts(RangeSensorParameters())
    which, out, nothing = np.arange(len(mounts)), np.empty(len(mounts)), np.empty((0, 4))
    for row in range(max(begin - round(SEEN_FOR * RATE), 0), -1, -1):
        time = patrol_run.START + float(record.time[row])
        if time < thing.appears:
            return False
        circle = np.array([[*thing.position(time), thing.radius]])
        x, y, yaw = record['truth'][row].tolist()
        cast_rays(x, y, yaw, mounts, which, nothing, circle, out)
        if out.min() < SEEN_WITHIN:
            return True
    return False


def at_places(found: Sequence[Contact]) -> list[list[Contact]]:
    """Return the contacts by place."""
    places: list[list[Contact]] = []
    for each in found:
        for known in places:
            if math.dist(known[0].place, each.place) < SAME_PLACE:
                known.append(each)
                break
        else:
            places.append([each])
    return places


def safety_run(
    case: str, seed: int, duration: float, *, planned: bool = False
) -> tuple[Record, World]:
    """Return the record of a case, and its world with all that came."""
    kind = CASES[case]
    text = patrol_run.room_with_boxes(seed, ROOM, BOXES)
    if kind.unseen:
        walls, _, patches = text.partition('patches:')
        text = f'{walls}{unseen_boxes(seed)}\npatches:{patches}'
    came: list[MovingDisc] = []
    visitors = kind.visitors(seed) if kind.visitors else None

    def visit(time: float, state: State) -> MovingDisc | None:
        found = visitors(time, state) if visitors else None
        came.extend([found] if found else [])
        return found

    fault, count = kind.faults or ('silent', 0)
    faults = [patrol_run.SensorFault(each, fault, cut_time(seed)) for each in range(count)]
    with patrol_run.world_file(text) as path:
        scenario = patrol_run.PatrolScenario(
            seed,
            duration,
            world=path,
            faults=tuple(faults),
            plan=PlanParameters(enabled=planned),
        )
        record = patrol_run.run_patrol(
            patrol_run.portrait_points(seed, PortraitParameters()), scenario, visitors=visit
        )
    world = parse_world(text, 'room')
    return record, replace(world, moving=tuple(came))


def measured_safety(job: tuple[tuple[str, float, bool], int]) -> Row:
    """Return the row of a case.

    ``contacts``, those to which the robot moved; ``contacts_seen``, those of them with what a beam
    had met for :data:`SEEN_FOR`; ``run_into``, those to which it did not;
    ``most_at_a_place``; ``fastest_again``, speed of the fastest contact after the first at its
    place (m/s); ``pushing``, longest time of pushing (s); ``driven`` (m); ``ended``, reason of a
    stop that lasts to the end. Of a case with faults ``rest``, time from the fault to the last
    pulse of a motor (s), NaN without, and ``after``, distance driven after it (m).
    """
    (case, duration, planned), seed = job
    record, world = safety_run(case, seed, duration, planned=planned)
    found = contacts(record, world)
    own = [each for each in found if each.speed > OWN_SPEED]
    places = at_places(own)
    again = [each.speed for known in places for each in known[1:]]
    steps = np.hypot(*np.diff(record['truth'][:, :2], axis=0).T)
    row: Row = {
        'contacts': len(own),
        'contacts_seen': sum(each.seen for each in own),
        'places': len(places),
        'run_into': len(found) - len(own),
        'most_at_a_place': max(map(len, places), default=0),
        'fastest': max((each.speed for each in own), default=0.0),
        'fastest_again': max(again, default=0.0),
        'pushing': max((each.pushing for each in found), default=0.0),
        'driven': float(steps.sum()),
        'ended': record.driver_reasons[-1],
        'stopped': float(np.mean([bool(each) for each in record.driver_reasons])),
        'came': len(world.moving),
    }
    if CASES[case].faults:
        first = round((cut_time(seed) - patrol_run.START) * RATE)
        moves = (record['commanded'][first:] != 0.0).any(axis=1)
        ends = float(np.flatnonzero(moves)[-1] + 1) / RATE if moves.any() else 0.0
        row['rest'] = math.nan if moves[-1] else ends
        row['after'] = float(steps[first:].sum())
    return row


def compare_safety(
    seeds: Sequence[int],
    duration: float,
    workers: int | Executor = 1,
    report: Report | None = None,
    *,
    planned: bool = False,
) -> ResultTable:
    """Return one row a case and seed; arguments as of :func:`run_experiment`, :func:`safety_run`.

    ValueError: the runs end before the last sensors have failed.
    """
    if duration < LEAST_DURATION:
        raise ValueError(
            f'a run must last at least {LEAST_DURATION:g} s ({LEAST_DURATION / 60.0:.2g} min): '
            f'sensors fail until {FAULTS_END:g} s: got {duration:g} s'
        )
    runs = [
        Run(((case, duration, planned), seed), {'controller': case, 'seed': seed})
        for case in CASES
        for seed in seeds
    ]
    return run_experiment(runs, measured_safety, workers, report=report)


WORST: Mapping[str, tuple[str, int]] = {
    'most contacts at a place': ('most_at_a_place', 0),
    'fastest after the first, m/s': ('fastest_again', 3),
    'longest push, s': ('pushing', 2),
    'rest after the fault, s': ('rest', 2),
    'driven after it, m': ('after', 3),
}
"""Number and digits of the columns with the worst of a case, by their headings."""


def safety_table(table: ResultTable) -> Table:
    """Return counts and the worst of each case."""
    head = ('case', 'runs', 'runs with contact', 'with what was seen', 'places touched', *WORST)
    lines = []
    for case, rows in (
        (case, table.where(controller=case)) for case in table.unique('controller')
    ):
        names = 'contacts', 'contacts_seen'
        touched, seen = (sum(bool(row[name]) for row in rows) for name in names)
        counts = len(rows), touched, seen, sum(row['places'] for row in rows)
        lines.append([case, *map(str, counts), *(_worst(rows, *each) for each in WORST.values())])
    return Table('', head, lines)


def _worst(rows: Sequence[Row], column: str, digits: int) -> str:
    values = [float(row[column]) for row in rows if column in row]
    if not values:
        return EMPTY_CELL
    if goes_on := sum(map(math.isnan, values)):
        return f'{goes_on} of {len(rows)} drive on'
    return f'{max(values):.{digits}f}'
