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
"""A path on a map: around obstacles, not over unseen floor, and on to places that are old."""

import functools
import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.chaos.path_plan import GOAL_MISS
from t3mpc_ros.chaos.path_replanning import (
    FAR_AWAY,
    NOWHERE_TIME,
    PATIENCE,
    PlannedPath,
    PlanParameters,
)
from t3mpc_ros.chaos.pose_reference import PathReferenceParameters
from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.obstacles import OccupancyGrid
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.route_planning import nearest_distances
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, Pose
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.compiled  # without the compiler a drive takes half a minute

PERIOD = 0.05
MAP_PERIOD = 5
"""Periods between two maps."""
LIMITS = MotionLimits()
GEOMETRY = WheelGeometry()
SIZE = 0.04
"""Side of a cell of the room, m."""
ROOM = (4.0, 3.0)
ARENA = (-1.7, -1.2, 1.7, 1.2)
KEEP_OUT = 0.165
"""Distance of the keep-out, with which a planned path does not interfere, m."""


class Room:
    """A room, known or of which the robot sees the floor around it, or in a sector ahead."""

    def __init__(self, reach=0.7, half_angle=math.pi, known=False):
        rows, columns = round(ROOM[1] / SIZE), round(ROOM[0] / SIZE)
        self.occupied = np.zeros((rows, columns), dtype=np.bool_)
        self.occupied[[0, -1]] = self.occupied[:, [0, -1]] = True
        self.hidden = np.zeros_like(self.occupied)
        self.seen = np.full_like(self.occupied, known)
        self.reach, self.half_angle = reach, half_angle
        row, column = np.indices((rows, columns))
        self.x, self.y = SIZE * (column + 0.5) - 2.0, SIZE * (row + 0.5) - 1.5
        self.see(ORIGIN, around=0.35)

    def near(self, x, y, radius):
        return np.hypot(self.x - x, self.y - y) < radius

    def see(self, pose, around=0.2):
        away_x, away_y = self.x - pose.x, self.y - pose.y
        turn = np.arctan2(away_y, away_x) - pose.yaw
        turn = np.abs(np.remainder(turn + math.pi, math.tau) - math.pi)
        distance = np.hypot(away_x, away_y)
        visible = (distance < self.reach) & (turn < self.half_angle) | (distance < around)
        self.seen |= visible & ~self.hidden

    def grid(self):
        cells = np.where(self.seen, np.where(self.occupied, 100, 0), -1).astype(np.int8)
        return OccupancyGrid(cells, SIZE, -2.0, -1.5)

    def distances(self, marked, poses):
        """Return the distance of poses from the centre of the nearest marked cell, m."""
        field = SIZE * nearest_distances(marked)
        column = ((poses[:, 0] + 2.0) / SIZE).astype(int)
        row = ((poses[:, 1] + 1.5) / SIZE).astype(int)
        return field[row, column]


def curve():
    """Return what returns the next points of an endless curve through the room, 1 cm apart."""
    angle = [0.0]

    def following():
        found = []
        for _ in range(100):
            speed = math.hypot(1.6 * math.cos(angle[0]), 1.1 * 1.618 * math.cos(1.618 * angle[0]))
            angle[0] += 0.01 / max(speed, 0.2)
            found.append((1.6 * math.sin(angle[0]), 1.1 * math.sin(1.618 * angle[0])))
        return np.array(found)

    return following


def planned(given=None, seed=1, start=ORIGIN, **values):
    timing = PathTiming(LIMITS, GEOMETRY, PERIOD, start)
    given_values = {name.replace('__', '.'): value for name, value in values.items()}
    parameters = PlanParameters.from_dict({'enabled': True, **given_values})
    path = PlannedPath(parameters, timing, PERIOD, start, given or curve(), Arena(ARENA))
    path.plan.use_random_numbers(SecretRandom(seed, 'revisits'))
    return path


def drive(path, room, seconds, voltage=None, robot=None, rate=lambda k: 1.0, change=None):
    """Return poses and twists, shape (n, 5), of a reference and a robot that is where it is.

    voltage : returns that of the battery at a pose
    robot : pose of a robot that is elsewhere
    change : called with period and pose before each map, which changes the room
    """
    rows = []
    pose = path._pose
    for k in range(round(seconds / PERIOD)):
        if change is not None:
            change(k, pose)
        if k % MAP_PERIOD == 0:
            if robot is None:
                room.see(pose)
            path.set_map(room.grid())
        if voltage is not None and k % round(1.0 / PERIOD) == 0:
            path.observe_battery(voltage(pose))
        pose, twist = path.advance(rate(k))
        path.observe(robot or pose)
        rows.append((*pose, *twist))
    return np.array(rows)


def check_limits(rows):
    linear, angular = rows[:, 3], rows[:, 4]
    assert np.abs(linear).max() <= LIMITS.linear
    assert np.abs(angular).max() <= LIMITS.angular
    assert np.abs(np.diff(linear)).max() <= LIMITS.linear_acceleration * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(angular)).max() <= LIMITS.angular_acceleration * PERIOD * (1 + 1e-9)
    moves = np.hypot(*np.diff(rows[:, :2], axis=0).T)
    assert (moves <= LIMITS.linear * PERIOD + 1e-6).all()


def length(rows):
    return float(np.hypot(*np.diff(rows[:, :2], axis=0).T).sum())


@pytest.mark.parametrize('seed', few_of([2, 1]))
def test_it_keeps_its_distance_from_whatever_it_has_seen(seed):
    room = Room()
    generator = np.random.default_rng(seed)
    for x, y in generator.uniform([-1.6, -1.1], [1.6, 1.1], (5, 2)):
        if math.hypot(x, y) > 0.6:
            room.occupied |= room.near(x, y, float(generator.uniform(0.05, 0.25)))
    rows = drive(planned(seed=seed), room, 60.0)
    check_limits(rows)
    assert room.distances(room.occupied, rows).min() > KEEP_OUT
    assert room.distances(~room.seen, rows).min() > KEEP_OUT - SIZE
    assert length(rows) > 7.0


def test_before_unseen_floor_it_rests_and_looks_to_both_sides():
    room, unseen = Room(half_angle=0.15), []

    def note(k, pose):
        room.see(pose)
        unseen.append(room.distances(~room.seen, np.array([pose]))[0])

    rows = drive(planned(), room, 60.0, change=note)
    check_limits(rows)
    assert min(unseen) > KEEP_OUT - SIZE
    turns = rows[:, 3] == 0.0
    looks = turns & (np.abs(rows[:, 4]) > 1.0)
    assert (rows[looks, 4] > 0.0).any()
    assert (rows[looks, 4] < 0.0).any()
    assert length(rows) > 1.2


def test_what_a_look_does_not_show_is_driven_around():
    room = Room()
    room.hidden = room.near(0.9, 0.7, 0.25) | room.near(-0.6, 0.3, 0.2)
    rows = drive(planned(), room, 60.0)
    assert room.distances(room.hidden, rows).min() > KEEP_OUT - 1.5 * SIZE
    assert length(rows) > 6.0


def test_what_is_placed_ahead_of_it_is_not_touched():
    room = Room(known=True)
    generator, away = np.random.default_rng(4), []

    def place(k, pose):
        away.append(room.distances(room.occupied, np.array([pose]))[0])
        if k % 100 == 99:
            angle = pose.yaw + generator.uniform(-0.5, 0.5)
            room.occupied[1:-1, 1:-1] = False
            room.occupied |= room.near(
                pose.x + 0.45 * math.cos(angle), pose.y + 0.45 * math.sin(angle), 0.1
            )

    rows = drive(planned(), room, 60.0, change=place)
    check_limits(rows)
    assert min(away) > 0.12
    assert length(rows) > 4.0  # something is in its way every 5 s


def circle(radius):
    """Yield the points of a circle through the start, which is driven for ever."""
    angle = 0.3
    while True:
        angles = angle + np.arange(100) * 0.01 / radius
        yield radius * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])
        angle += 1.0 / radius


def test_old_places_are_visited_again():
    """The given path is a small circle: what else is entered is due to the visits."""
    shares = []
    for distance in (0.0, 3.0):
        room = Room(known=True)
        rows = drive(planned(circle(0.3).__next__, revisit_distance=distance), room, 60.0)
        cells = np.floor(rows[:, :2] / 0.3).astype(int)
        shares.append(len({*map(tuple, cells.tolist())}) / (3.4 * 2.4 / 0.09))
    assert shares[0] < 0.12
    assert shares[1] > 2.0 * shares[0]


@functools.cache
def drive_by(thing, seconds):
    """Return places from 5 s on, when a robot that drives in a circle is to look at something."""
    room = Room(known=True)
    room.occupied |= room.near(1.1, 0.2, 0.1)
    path = planned(circle(0.3).__next__, revisit_distance=0.0)
    rows = [drive(path, room, 5.0)]
    if thing:
        path.look_at(np.array([thing]))
    rows.append(drive(path, room, seconds))
    check_limits(np.vstack(rows))
    return rows[1][:, :2]


@pytest.mark.parametrize('thing', [(1.2, 0.8), (1.1, 0.2)])
def test_what_contradicts_the_map_is_looked_at_once_a_minute(thing):
    """A pillar that the map has is at the last place: it is passed where it can be seen."""
    near, without = (
        np.hypot(*(places - thing).T) < 0.5
        for places in (drive_by(thing, 90.0), drive_by(None, 30.0))
    )
    begins = np.flatnonzero(np.diff(near.astype(int)) == 1) * PERIOD
    assert begins[0] < 25.0
    assert near.sum() * PERIOD > 2.0
    soon = begins[begins < 55.0]
    assert soon[-1] - soon[0] < 10.0  # it passes two places beside it, and then leaves
    assert begins[-1] > 60.0
    assert near[: len(without)].sum() > without.sum() + 2.0 / PERIOD


def test_what_is_named_no_more_is_looked_at_no_more():
    """Of a localizer that has fallen silent: it was looked at once a minute, for ever."""
    room = Room(known=True)
    path, thing = planned(circle(0.3).__next__, revisit_distance=0.0), (-1.4, -0.9)
    path.look_at(np.array([thing]))
    drive(path, room, 110.0)
    near = np.hypot(*(drive(path, room, 30.0)[:, :2] - thing).T) < 0.5
    assert not near.any()


def test_what_cannot_be_looked_at_does_not_hold_it_up():
    """Behind a wall, beyond the arena, where a view is, and several at once."""
    room = Room(known=True)
    room.occupied |= np.abs(room.x - 1.0) < 0.03
    path = planned(circle(0.3).__next__, revisit_distance=0.0)
    node = [-2.0 + 60.5 * SIZE, -1.5 + 50.5 * SIZE]  # of the search: at no distance from itself
    path.look_at(np.array([[1.6, 0.0], [9.0, 9.0], node, [-1.2, 0.6], [-1.2, -0.6]]))
    rows = drive(path, room, 55.0)
    check_limits(rows)
    assert (rows[:, 0] < 1.0 - KEEP_OUT).all()
    for y in (0.6, -0.6):
        assert np.hypot(*(rows[:, :2] - (-1.2, y)).T).min() < 0.3


def test_a_goal_is_led_to_before_what_contradicts_the_map():
    room = Room(known=True)
    path = planned(circle(0.3).__next__, revisit_distance=0.0)
    path.go_to((1.4, 0.8))
    path.look_at(np.array([[-1.4, -0.8]]))
    rows = drive(path, room, 40.0)
    goal, thing = (np.hypot(*(rows[:, :2] - each).T) for each in ((1.4, 0.8), (-1.4, -0.8)))
    assert goal.min() < 0.15
    assert thing.min() < 0.3
    assert np.argmin(goal) < np.argmin(thing)


def test_it_leads_to_a_goal_and_waits_for_a_way_to_one_without():
    room = Room(known=True)
    room.occupied |= room.near(0.5, 0.4, 0.2)
    ring = room.near(-1.0, -0.6, 0.5) & ~room.near(-1.0, -0.6, 0.38)
    room.occupied |= ring
    path = planned(revisit_distance=0.0)
    drive(path, room, 5.0)
    for goal in ((1.3, 0.9), (-1.2, 0.9)):
        path.go_to(goal)
        rows = drive(path, room, 20.0)
        check_limits(rows)
        assert path.plan.goal is path.plan.unreachable_goal is None
        assert np.hypot(*(rows[:, :2] - goal).T).min() < 0.15
    path.go_to((-1.0, -0.6))
    assert path.plan.unreachable_goal is None  # nobody has looked for a way
    drive(path, room, 10.0)
    assert path.plan.goal == path.plan.unreachable_goal == (-1.0, -0.6)
    room.occupied &= ~ring
    rows = drive(path, room, 40.0)
    assert np.hypot(*(rows[:, :2] - (-1.0, -0.6)).T).min() < 0.15


def test_what_is_planned_after_a_goal_does_not_lead_past_it():
    """The last half metre of the plan is smoothed again: it passed a goal by 0.1 m, as visited."""
    goal = (-1.35, 1.0)
    room = Room(known=True)
    path = planned(revisit_distance=0.0)
    path.go_to(goal)
    path.set_map(room.grid())
    assert path.plan.goal_point is not None
    path.plan.truncate(path.plan.goal_point + 6)
    path.plan.extend(path._fed, path._time)
    assert np.hypot(*(path.plan.points - goal).T).min() < GOAL_MISS + 0.001


def test_a_thing_in_the_way_does_not_make_it_forget_a_goal():
    """What was planned behind it was cut off, and the goal with it."""
    goal = (1.4, 0.0)
    room = Room(reach=0.5, known=True)
    path = planned(revisit_distance=0.0)
    path.go_to(goal)
    drive(path, room, 0.5)
    assert path.plan.goal_point is not None
    room.occupied |= room.near(0.7, 0.0, 0.15)
    rows = drive(path, room, 15.0)
    assert np.hypot(*(rows[:, :2] - goal).T).min() < 0.05
    assert path.plan.goal is None


CHARGER = (-1.2, 0.7)


@pytest.mark.parametrize('seed', few_of([3, 1]))
def test_with_a_low_battery_it_is_charged_and_goes_on(seed):
    room = Room()
    generator = np.random.default_rng(seed)
    for x, y in generator.uniform([-1.6, -1.1], [1.6, 1.1], (5, 2)):
        if min(math.hypot(x, y), math.hypot(x - CHARGER[0], y - CHARGER[1])) > 0.5:
            room.occupied |= room.near(x, y, 0.1)
    volts, charged = [10.2], []

    def voltage(pose):
        there = math.hypot(pose.x - CHARGER[0], pose.y - CHARGER[1]) < 0.06
        volts.append(min(volts[-1] + (0.1 if there and path.charging else -0.02), 12.6))
        charged.append(path.charging)
        return volts[-1]

    limits = {'charging__min_voltage': 10.0, 'charging__full_voltage': 10.8}
    path = planned(seed=seed, charging__place=CHARGER, **limits)
    rows = drive(path, room, 150.0, voltage=voltage)
    check_limits(rows)
    assert min(volts) > 9.0, 'it did not get there'
    changes = np.flatnonzero(np.diff(np.array(charged, dtype=int)))
    assert len(changes) >= 3, 'it did not go on'
    assert room.distances(room.occupied, rows).min() > KEEP_OUT - SIZE


@pytest.mark.parametrize('voltage', [math.nan, math.inf, 0.0])
def test_what_is_no_voltage_changes_nothing(voltage):
    """0 V, of a driver that measures none, led to the charger, and inf on from there."""
    room = Room(known=True)
    path = planned(charging__place=CHARGER, charging__min_voltage=10.0)
    drive(path, room, 7.0, voltage=lambda pose: voltage)
    assert not path.observe_battery(voltage)
    assert not path.charging
    assert path.battery_silence == pytest.approx(7.0)
    drive(path, room, 7.0, voltage=lambda pose: 9.0)
    assert path.charging
    assert path.battery_silence == pytest.approx(1.0)
    drive(path, room, 7.0, voltage=lambda pose: voltage)
    assert path.charging


def test_only_a_voltage_that_lasts_calls_for_the_charger():
    room = Room(known=True)
    path = planned(charging__place=CHARGER, charging__min_voltage=10.0)
    sags = iter([9.0, 9.0, 9.0, 9.0, 9.0, 10.5] * 3 + [math.nan] * 30)
    drive(path, room, 30.0, voltage=lambda pose: next(sags))
    assert not path.charging
    drive(path, room, 7.0, voltage=lambda pose: 9.0)
    assert path.charging
    assert not path.at_charging_place
    drive(path, room, 20.0, voltage=lambda pose: 12.0)
    assert path.at_charging_place
    # Pushed away, it returns.
    drive(path, room, PATIENCE + 1.0, robot=Pose(-0.4, 0.2, 0.0))
    rows = drive(path, room, 30.0, voltage=lambda pose: math.nan)
    assert path.at_charging_place
    assert np.hypot(*(rows[-1, :2] - CHARGER)) < 0.06
    assert np.abs(rows[-1, 3:]).max() == 0.0


@pytest.mark.parametrize(
    'wrong, words',
    [
        ({'full_voltage': 9.5, 'min_voltage': 10.0}, 'full_voltage must be more than min_voltage'),
        ({'place': (1.0,)}, 'place must be two numbers'),
    ],
)
def test_a_charger_that_cannot_be_is_refused(wrong, words):
    with pytest.raises(ParameterError, match=words):
        PlanParameters.from_dict({f'charging.{name}': value for name, value in wrong.items()})


@pytest.mark.parametrize('spacing', few_of([0.002, 0.02, 0.01]))
def test_a_path_of_any_spacing_goes_on(spacing):
    """The plan counted points as if they were 1 cm apart; a patrol stood for 14 minutes.

    In tight curves they are nearer: it fell behind, until all points that may be driven without
    another look at the map lay ahead of where it took the reference to be.
    """
    turn = [0.0]

    def circles():
        turn[0] += 1.0
        angle = np.arange(turn[0] - 1.0, turn[0], spacing / 0.3)
        return 0.3 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])

    path = planned(circles, revisit_distance=0.0)
    rows = drive(path, Room(reach=9.0), 60.0)
    assert min(length(part) for part in np.array_split(rows, 6)) > 1.0
    assert len(path.plan.points) < 2000


def test_equal_seeds_give_equal_paths_and_others_do_not():
    def positions(seed):
        room = Room(known=True)
        return drive(planned(seed=seed, revisit_distance=0.5), room, 8.0)

    first = positions(1)
    assert np.array_equal(first, positions(1))
    assert not np.array_equal(first, positions(2))


def test_without_a_map_it_rests():
    path = planned()
    for _ in range(20):
        assert path.advance() == (ORIGIN, STANDSTILL)


def test_a_robot_that_is_walled_in_rests_until_it_is_free():
    room = Room()
    ring = room.near(0.0, 0.0, 0.45) & ~room.near(0.0, 0.0, 0.3)
    room.occupied |= ring
    path = planned()
    assert length(drive(path, room, 10.0)) < 0.5
    room.occupied &= ~ring
    assert length(drive(path, room, 30.0)) > 3.0


def test_a_robot_that_has_nowhere_to_go_is_boxed_in():
    """It stood between two chairs for ever, and nothing said so; a look is no way out."""
    room = Room()
    ring = room.near(0.0, 0.0, 0.45) & ~room.near(0.0, 0.0, 0.3)
    room.occupied |= ring
    path = planned()
    drive(path, room, 0.9 * NOWHERE_TIME)
    assert not path.boxed_in
    drive(path, room, NOWHERE_TIME)
    assert path.boxed_in
    room.occupied &= ~ring
    drive(path, room, 5.0)
    assert not path.boxed_in


def test_a_robot_that_does_not_turn_to_look_is_not_boxed_in():
    """Its controller is disabled, say: what the looks were to show is not seen."""
    path = planned()
    for _ in range(round(3.0 * NOWHERE_TIME)):
        drive(path, Room(half_angle=0.1), 1.0, robot=Pose(0.0, 0.0, 2.0))
        assert not path.boxed_in


@pytest.mark.parametrize(('aside', 'boxed_in'), [(0.3, True), (0.4, False)])
def test_only_a_robot_that_faces_as_its_reference_is_boxed_in(aside, boxed_in):
    room = Room()
    room.occupied |= room.near(0.0, 0.0, 0.45) & ~room.near(0.0, 0.0, 0.3)
    path = planned()
    drive(path, room, 5.0)
    assert path.advance()[1] == STANDSTILL
    drive(path, room, 2.0 * NOWHERE_TIME, robot=path._pose._replace(yaw=path._pose.yaw + aside))
    assert path.boxed_in == boxed_in


@pytest.mark.parametrize('direction', few_of([1.0, -1.5, 2.5]))
def test_a_robot_too_near_to_what_is_marked_leaves(direction):
    """A place marked a hand's breadth before it, which was none, kept it there for ever."""
    room = Room()
    path = planned()
    drive(path, room, 10.0)
    x, y, _ = path._pose
    there = x + 0.19 * math.cos(direction), y + 0.19 * math.sin(direction)
    room.occupied |= room.near(*there, 0.05)
    rows = drive(path, room, 40.0)
    assert length(rows) > 4.0
    away = room.distances(room.near(*there, 0.05), rows[:, :2])
    first = int(np.argmax(away > 0.18))
    assert (np.diff(away[:first]) > -SIZE - 1e-9).all()
    assert away[first:].min() > 0.14


def test_it_begins_anew_at_a_robot_that_does_not_come():
    room = Room(known=True)
    path = planned()
    drive(path, room, 5.0)
    place = Pose(-0.9, -0.6, 2.0)
    rows = drive(path, room, PATIENCE + 2.0, robot=place, rate=lambda k: 0.0)
    away = np.hypot(*(rows[:, :2] - place[:2]).T)
    assert (away[: round(PATIENCE / PERIOD) - 1] > FAR_AWAY).all()
    assert rows[-1, :3] == pytest.approx(place)
    assert length(drive(path, room, 20.0)) > 2.0


def test_a_pause_stops_it_within_the_limits_at_any_moment():
    rows = drive(
        planned(), Room(half_angle=0.15), 20.0, rate=lambda k: 0.0 if k % 60 > 40 else 1.0
    )
    assert not rows[59::60, 3:].any()
    check_limits(rows)


def test_only_portraits_are_planned():
    with pytest.raises(ParameterError, match='plan.enabled needs source portrait'):
        PathReferenceParameters.from_dict({'source': 'topic', 'plan.enabled': True})
