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
"""Keep-out: the nearest permitted twist, conditions that hold, floor that must be seen first."""

from itertools import pairwise
import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.control.keep_out import (
    CAUTIOUS_SPEED,
    CLEARINGS,
    FREE,
    KNOWN,
    MEMORY,
    NEW_FOR,
    OCCUPIED,
    UNKNOWN,
    VISIT,
    VISITED_FOR,
    VISITED_SPEED,
    Activity,
    KeepOut,
    KeepOutParameters,
    nearest_permitted,
)
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.obstacles import Obstacles, OccupancyGrid
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, BodyTwist, Pose, State

LIMITS = BodyTwist(0.35, 4.5)
PERIOD = 0.01
PARAMETERS = KeepOutParameters(enabled=True)
WALL = np.array([[1.0, -3.0, 1.0, 3.0]])


def _seen(obstacles=None):
    """Return a keep-out that has looked around and knows all floor but the given obstacles."""
    keep_out = KeepOut(PARAMETERS, LIMITS, obstacles)
    keep_out.step(BodyTwist(0.0, 0.0), ORIGIN, PERIOD)
    keep_out._targets.clear()
    cells = keep_out.map.grid.cells
    cells[cells == UNKNOWN] = FREE
    return keep_out


def _state(keep_out, x, y):
    """Return the state of the cell at a place (m)."""
    grid = keep_out.map.grid
    low, size = grid.low, grid.size
    return grid.cells[math.floor((y - low) / size), math.floor((x - low) / size)]


@pytest.mark.parametrize('seed', few_of(range(30), 10))
@pytest.mark.slow
def test_permitted_twist_is_the_nearest_one(seed):
    """Against a fine grid of all twists: permitted, and no permitted one is nearer."""
    generator = np.random.default_rng(seed)
    rows = np.column_stack([generator.normal(size=(6, 2)), generator.uniform(0.0, 1.0, 6)])
    wanted = generator.uniform(-2.0, 2.0, 2)
    found = np.array(nearest_permitted(rows, *wanted.tolist()))
    assert (rows[:, :2] @ found <= rows[:, 2] + 1e-9).all()
    axis = np.linspace(-3.0, 3.0, 601)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    permitted = grid[(grid @ rows[:, :2].T <= rows[:, 2] + 1e-9).all(axis=1)]
    best = np.hypot(*(permitted - wanted).T).min()
    assert np.hypot(*(found - wanted)) <= best + 1e-9


@pytest.mark.compiled
@pytest.mark.parametrize('direction', [-1.4, 0.0, 0.7])
@pytest.mark.parametrize('turn', [0.0, 1.0])
@pytest.mark.parametrize('speed', [0.35, -0.35])
def test_robot_never_enters_the_distance(direction, turn, speed):
    """Towards a wall at any angle, ahead or astern: the centre keeps its distance.

    Less half a cell. Astern only the condition of the centre protects it: no test failed when
    that condition ignored the distance.
    """
    keep_out = _seen(Obstacles(segments=WALL))
    pose = Pose(0.4, 0.0, direction if speed > 0.0 else direction + math.pi)
    for _ in range(500):
        wanted = BodyTwist(speed, turn)
        pose = advance_pose(pose, keep_out.step(wanted, pose, PERIOD), PERIOD)
        assert 1.0 - pose.x > PARAMETERS.distance - 0.02


def test_approach_slows_down_within_the_deceleration():
    """The barrier lets the distance shrink so slowly that less than 1 m/s² is needed.

    Where nothing is near nothing is changed.
    """
    keep_out = _seen(Obstacles(segments=WALL))
    wanted = BodyTwist(0.31, -1.7)
    assert keep_out.step(wanted, ORIGIN, PERIOD) == pytest.approx(wanted)
    assert not keep_out.changed
    assert keep_out.activity is Activity.FREE
    pose, speeds = Pose(0.0, 0.0, 0.0), []
    for _ in range(600):
        twist = keep_out.step(BodyTwist(0.35, 0.0), pose, PERIOD)
        speeds.append(twist.linear)
        pose = advance_pose(pose, twist, PERIOD)
    assert np.diff(speeds).min() > -1.0 * PERIOD
    assert speeds[-1] < 0.01


@pytest.mark.compiled
def test_robot_looks_before_it_enters_unseen_floor():
    """The robot stops before floor that no ray has crossed, and turns to look."""
    keep_out = KeepOut(PARAMETERS, LIMITS)
    pose, looked = ORIGIN, False
    for _ in range(2000):
        twist = keep_out.step(BodyTwist(0.3, 0.0), pose, PERIOD)
        looked |= keep_out.activity is Activity.LOOKING and pose.x > 0.01
        pose = advance_pose(pose, twist, PERIOD)
    assert math.hypot(pose.x, pose.y) < 0.15  # no reading ever came
    assert looked
    assert keep_out.activity.stuck or keep_out.activity is Activity.LOOKING


def test_rays_clear_and_mark():
    """Floor up to a hit is free, the hit is occupied, and later rays beyond it clear it."""
    keep_out = KeepOut(PARAMETERS, LIMITS)
    keep_out.map.add_reading(0, 0.5, ORIGIN)
    assert _state(keep_out, 0.3, 0.05) == FREE
    assert _state(keep_out, 0.601, 0.051) == OCCUPIED
    assert _state(keep_out, 0.7, 0.05) == UNKNOWN
    for _ in range(6):
        keep_out.map.add_reading(0, math.inf, ORIGIN)
    assert _state(keep_out, 0.601, 0.051) == FREE


def test_an_obstacle_seen_again_must_be_cleared_anew():
    """Misses from before it was last seen do not count: the robot would drive into it."""
    keep_out = KeepOut(PARAMETERS, LIMITS)
    pose = Pose(0.005, 0.0, 0.0)  # each ray passes once over the cell
    for _ in range(3):
        keep_out.map.add_reading(0, 0.5, pose)
        for _ in range(CLEARINGS - 1):
            keep_out.map.add_reading(0, math.inf, pose)
            assert _state(keep_out, 0.605, 0.05) == OCCUPIED
    keep_out.map.add_reading(0, math.inf, pose)
    assert _state(keep_out, 0.605, 0.05) == FREE


@pytest.mark.compiled
def test_a_reading_counts_at_the_pose_of_the_last_odometry():
    """A robot that had been carried while its controller was disabled marked the wrong floor."""
    controller = Controller(
        StepperControllerParameters.from_dict({'pose.enabled': True, 'keep_out.enabled': True})
    )
    place = Pose(0.5, -0.3, 1.0)
    for stamp, pose in enumerate((ORIGIN, place, Pose(math.nan, 0.0, 0.0))):
        controller.step(State(stamp, pose, STANDSTILL))
    controller.add_range(0, 0.4)
    wanted = KeepOut(KeepOutParameters(), BodyTwist(0.35, 4.5))
    wanted.map.add_reading(0, 0.4, place)
    assert np.array_equal(controller.keep_out.map.grid.cells, wanted.map.grid.cells)


@pytest.mark.compiled
@pytest.mark.parametrize(
    ('x', 'yaw', 'forgotten'), [(0.2, 0.0, False), (0.3, 0.0, True), (0.0, 0.6, True)]
)
def test_a_robot_found_elsewhere_forgets_what_it_marked(x, yaw, forgotten):
    """A localisation finds a carried robot: the marks would block free floor."""
    parameters = {'pose.enabled': True, 'keep_out.enabled': True}
    controller = Controller(StepperControllerParameters.from_dict(parameters))
    controller.step(State(0, ORIGIN, STANDSTILL))
    controller.keep_out.map.grid.cells[10, 10] = OCCUPIED
    controller.step(State(10_000_000, Pose(x, 0.0, yaw), STANDSTILL))
    assert bool(controller.keep_out.map.grid.cells[10, 10] == UNKNOWN) is forgotten


@pytest.mark.compiled
def test_floor_that_was_seen_long_ago_is_looked_at_again():
    """A cell was free for ever: what was placed there later was driven into."""
    keep_out = _seen()
    keep_out.map.grid.seen[:] = 0.0
    wanted = BodyTwist(0.3, 0.0)
    keep_out.map.now = MEMORY - 1.0
    assert keep_out.step(wanted, ORIGIN, PERIOD) == pytest.approx(wanted)
    keep_out.map.now = MEMORY + 1.0
    looked = False
    for _ in range(100):
        assert keep_out.step(wanted, ORIGIN, PERIOD).linear < 0.1
        looked |= keep_out.activity is Activity.LOOKING
    assert looked
    keep_out.map.grid.seen[:] = keep_out.map.now  # as the rays of a look would
    keep_out._targets.clear()
    assert keep_out.step(wanted, ORIGIN, PERIOD) == pytest.approx(wanted)


@pytest.mark.parametrize('yaw', [0.0, 2.5])
def test_what_was_touched_is_marked_ahead_and_no_ray_clears_it(yaw):
    keep_out = KeepOut(PARAMETERS, LIMITS)
    pose = Pose(0.3, -0.2, yaw)

    def at(ahead, left):
        cosine, sine = math.cos(yaw), math.sin(yaw)
        x, y = pose.x + cosine * ahead - sine * left, pose.y + sine * ahead + cosine * left
        return _state(keep_out, x, y)

    keep_out.touch(pose, astern=False)
    for _ in range(CLEARINGS + 2):
        for sensor in range(8):
            keep_out.map.add_reading(sensor, math.inf, pose)
    assert [at(0.2, 0.0), at(0.1, 0.12), at(0.1, -0.12)] == 3 * [KNOWN]
    assert KNOWN not in [at(0.0, 0.0), at(-0.2, 0.0), at(0.2, 0.2), at(-0.05, 0.12), at(0.4, 0.0)]
    keep_out.reset()
    assert at(0.2, 0.0) == UNKNOWN
    assert not keep_out.touched
    assert not keep_out.retreats


class Touching:
    """A controller whose robot sees nothing, and is held at a circle around the origin."""

    def __init__(self, radius, side=math.pi):
        self.controller = Controller(
            StepperControllerParameters.from_dict({'pose.enabled': True, 'keep_out.enabled': True})
        )
        self.radius, self.side = radius, side
        self.k, self.pose, self.twist = 0, ORIGIN, STANDSTILL
        self.touches, self.reasons, self.astern = [], [], []
        self.wall = -math.inf
        """Coordinate of a wall behind the robot, m."""

    def run(self, seconds):
        generator = np.random.default_rng(3)
        for _ in range(round(seconds / PERIOD)):
            self.k += 1
            now = self.k * 10_000_000
            target = self.pose._replace(x=self.pose.x + 0.3)
            self.controller.add_reference(
                State(now + 400_000_000, target._replace(yaw=0.0), BodyTwist(0.2, 0.0))
            )
            for sensor in range(8) if self.k % 4 == 0 else ():
                reading = self.pose.x - self.wall - 0.1 if sensor in (4, 5) else math.inf
                self.controller.add_range(sensor, reading, now)
            moved = advance_pose(self.pose, self.twist, PERIOD)
            outside = math.hypot(moved.x, moved.y) > self.radius
            held = outside and abs(math.atan2(moved.y, moved.x)) < self.side
            if held and math.hypot(moved.x, moved.y) > math.hypot(self.pose.x, self.pose.y):
                self.touches.append((self.k, self.pose, self.twist.linear))
                moved = self.pose._replace(yaw=moved.yaw)
            self.pose = moved
            x, y = (0.002 * generator.standard_normal(2)).tolist()
            measured = Pose(moved.x + x, moved.y + y, moved.yaw)
            self.twist, status = self.controller.step(State(now, measured, self.twist))
            self.reasons.append(status.reason)
            if self.controller.keep_out.activity is Activity.BACKING_OFF:
                self.astern.append(self.twist.linear)
        return self


@pytest.mark.compiled
def test_a_held_robot_backs_off_and_does_not_touch_again():
    """It pressed against a box below its beams for five minutes."""
    robot = Touching(0.35, side=0.8).run(20.0)
    rows = np.array([k for k, _, _ in robot.touches])
    ends = [0, *(np.flatnonzero(np.diff(rows) > 100) + 1).tolist(), len(rows)]
    spans = [robot.touches[begin:end] for begin, end in pairwise(ends)]
    first, *later = spans
    assert first[-1][0] - first[0][0] < 60  # it pushed for 0.6 s
    assert Reason.PAUSED in robot.reasons
    assert min(robot.astern) < -0.05
    for each in later:
        assert math.dist(each[0][1][:2], first[0][1][:2]) > 0.1
        assert each[0][2] < 0.15


SHOVED = [
    pytest.param((-0.06, 0.0, 0.0), id='back'),
    pytest.param((-0.045, -0.04, 1.1), id='back and aside, and turned'),
]


@pytest.mark.compiled
@pytest.mark.parametrize('shove', SHOVED)
def test_a_shoved_robot_backs_off_from_what_it_touched(shove):
    """Predicted poses ran ahead of one that was held: it turned by half a turn, and pushed."""
    keep_out = _seen()
    begin = Pose(0.3, 0.0, 0.0)
    for k in range(60):
        x = min(0.007 * k, 0.3)
        y = 0.1 * math.cos(x / 0.3 * math.pi / 2.0) if shove[1] else 0.0
        for sensor in range(8):
            keep_out.ranges.accept(sensor, 0.5 + 0.001 * (k % 7), None)
        keep_out.ranges.update(10_000_000 * k, Pose(x, y, 0.0))
        ahead = 0.02 * (k // 3 % 3)  # of a held robot, commands and predictions come and go
        keep_out.step(BodyTwist(0.2, 0.0), Pose(x + ahead, y, 0.0), PERIOD)
    keep_out.touch(begin, astern=False)
    x, y, yaw = shove
    pose = Pose(begin.x + x, begin.y + y, yaw)
    thing = begin.x + 0.125, begin.y
    away = math.dist(pose[:2], thing)
    for _ in range(1000):
        last = math.dist(pose[:2], thing)
        twist = keep_out.step(STANDSTILL, pose, PERIOD)
        if not keep_out.retreats:
            break
        pose = advance_pose(pose, twist, PERIOD)
        assert yaw or abs(pose.yaw) < 0.1
        assert math.dist(pose[:2], thing) > last - 1e-3
    assert math.dist(pose[:2], thing) > away + 0.04


@pytest.mark.compiled
def test_a_robot_does_not_back_off_into_what_it_sees():
    robot = Touching(0.35, side=0.8)
    while not robot.controller.keep_out.touched:
        robot.run(0.05)
    robot.wall = robot.pose.x - 0.16
    while robot.controller.keep_out.retreats or robot.reasons[-1] is Reason.PAUSED:
        robot.run(0.05)
        assert robot.pose.x - robot.wall > 0.12


def test_it_begins_with_the_obstacles_of_a_saved_map():
    cells = np.full((40, 40), -1, dtype=np.int8)
    cells[18:22] = 0
    cells[19, 30] = 100  # x 0.5 to 0.55 m, y -0.05 to 0 m
    keep_out = KeepOut(PARAMETERS, LIMITS, None, OccupancyGrid(cells, 0.05, -1.0, -1.0))
    for _ in range(2):
        places = [(0.51, -0.04), (0.54, -0.01), (0.51, 0.03), (0.3, -0.03)]
        assert [_state(keep_out, *place) for place in places] == 2 * [OCCUPIED] + 2 * [UNKNOWN]
        for _ in range(2 * CLEARINGS):  # a ray of the right one of both front sensors
            keep_out.map.add_reading(1, 0.75, Pose(0.0, 0.02, 0.0))
        assert _state(keep_out, 0.51, -0.03) == FREE
        keep_out.reset()


@pytest.mark.parametrize('looks', [True, False])
def test_a_robot_that_rests_at_a_new_place_may_rest(looks):
    """After reset_odometry a paused robot turned by a full circle."""
    keep_out = _seen()
    (keep_out.reset if looks else keep_out.relocate)()
    turns = [keep_out.step(STANDSTILL, ORIGIN, PERIOD).angular for _ in range(50)]
    assert any(turns) == looks
    assert keep_out.activity is (Activity.LOOKING if looks else Activity.FREE)
    assert keep_out.step(BodyTwist(0.2, 0.0), ORIGIN, PERIOD).angular != 0.0
    assert keep_out.activity is Activity.LOOKING


# -- things that come ------------------------------------------------------------------------


class Floor:
    """A keep-out on floor that was seen free for ten seconds, in an open place."""

    def __init__(self, obstacles=None):
        self.keep_out = _seen(obstacles)
        self.map = self.keep_out.map
        self.map.now = 10.0
        self.map.grid.seen[self.map.grid.cells == FREE] = 9.0

    def read(self, distance, seconds=0.0):
        """Let sensor 0 of a robot at the origin, at (0.10, 0.05), read a distance (m)."""
        self.map.now += seconds
        self.keep_out.map.add_reading(0, distance, ORIGIN)

    def hit(self, distance, seconds=0.0):
        """Let it read that twice: what one reading alone says has not come."""
        self.read(distance, seconds)
        self.read(distance)

    def is_free(self, x, y):
        return _state(self.keep_out, x, y) == FREE


def test_floor_around_a_thing_that_came_counts_as_unseen():
    """A pillar 30 cm wide is one hit for a beam: the robot turned from it into its side."""
    floor = Floor()
    floor.hit(0.4)
    x, y = 0.5, 0.05
    assert _state(floor.keep_out, x, y) == OCCUPIED
    hidden = [(x + 0.18, y), (x, y + 0.18), (x, y - 0.18), (x - 0.08, y + 0.15)]
    assert not any(floor.is_free(*place) for place in hidden)
    assert floor.is_free(x + 0.24, y)
    assert floor.is_free(x, y + 0.24)
    assert floor.is_free(0.3, y)  # the beam has just passed over it


def test_floor_that_a_beam_has_just_seen_beside_it_stays_free():
    floor = Floor()
    floor.keep_out.map.add_reading(1, math.inf, ORIGIN)
    floor.hit(0.4, 0.2)
    assert floor.is_free(0.45, -0.05)
    assert not floor.is_free(0.45, 0.2)


def test_one_who_walks_on_takes_the_unseen_floor_along():
    """Hits of somebody who walks are near the last one: each is where nothing was before."""
    floor = Floor()
    for k in range(12):
        floor.hit(0.5 - 0.02 * k, 0.067)
        floor.map.grid.seen[floor.map.grid.cells == FREE] = floor.map.now - 0.5
    assert not floor.is_free(0.38 - 0.08, 0.05 + 0.15)


def test_one_who_walks_alongside_has_come_all_the_time():
    """What the walk had left made the newest hit old: the robot was fast, and touched a leg."""
    floor = Floor()
    for k in range(60):
        for _ in range(2):
            floor.map.now += 0.05
            floor.map.add_reading(2, 0.3, Pose(0.02 * k, 0.0, 0.0))
        assert floor.map.now - floor.map.last_come < NEW_FOR


def test_a_thing_that_stays_has_come_only_once():
    floor = Floor()
    floor.hit(0.4)
    floor.map.grid.cells[floor.map.grid.cells == UNKNOWN] = FREE  # it was looked at
    floor.hit(0.4, 3.0)
    floor.hit(0.42)
    assert floor.is_free(0.5, 0.2)


@pytest.mark.parametrize('kind', ['world', 'seen for long', 'far'])
def test_what_was_there_or_is_far_has_not_come(kind):
    """Noise of a wall, and a reading of things that are hardly seen, hide no floor."""
    wall = np.array([[0.55, -1.0, 0.55, 1.0]])
    floor, far = Floor(Obstacles(segments=wall) if kind == 'world' else None), kind == 'far'
    if kind == 'seen for long':
        grid = floor.map.grid
        column = math.floor((0.55 - grid.low) / grid.size)
        grid.cells[:, column], grid.seen[:, column] = OCCUPIED, 0.0
    for k in range(40):
        floor.hit((0.66 if far else 0.45) + 0.03 * math.sin(k), 0.04)
    assert floor.is_free(0.7 if far else 0.5, 0.2)


def test_a_ray_over_an_old_edge_does_not_make_it_new():
    """Rays that graze a box hid the floor beside it: robots on their path stopped to look."""
    floor = Floor()
    grid = floor.map.grid
    row, column = (math.floor((each - grid.low) / grid.size) for each in (0.05, 0.55))
    edge = slice(row - 1, row + 2), column
    grid.cells[edge], grid.seen[edge] = OCCUPIED, 0.0
    floor.hit(math.inf)
    assert (grid.cells[edge] == OCCUPIED).all()
    floor.hit(0.4, 0.1)
    assert floor.is_free(0.5, 0.2)


@pytest.mark.parametrize('distance', [0.4, 0.65])
def test_a_robot_drives_slowly_where_a_thing_has_come(distance):
    """People who stepped in from between the beams were touched at 0.2 m/s: more may follow."""
    floor = Floor()

    def speed(seconds):
        floor.map.now += seconds
        floor.map.grid.seen[floor.map.grid.cells == FREE] = floor.map.now
        return floor.keep_out.step(BodyTwist(-0.24, 0.0), ORIGIN, 0.0).linear

    assert speed(0.0) == pytest.approx(-0.24)
    floor.map.grid.seen[:] = floor.map.now - 0.5
    floor.hit(distance)
    assert speed(0.0) == speed(0.9 * NEW_FOR) == pytest.approx(-CAUTIOUS_SPEED)
    floor.hit(distance)  # it has stood there for a while
    assert speed(0.2 * NEW_FOR) == pytest.approx(-0.24)
    floor.hit(distance - 0.2)
    assert speed(0.0) == pytest.approx(-CAUTIOUS_SPEED)
    floor.keep_out.reset()
    assert floor.map.last_come == -math.inf


@pytest.mark.parametrize(('hits', 'visited'), [(2, False), (3, True)])
def test_a_robot_drives_more_slowly_while_somebody_is_about(hits, visited):
    """Eleven of 27 robots touched one who stepped in as they set off; an edge comes briefly."""
    floor = Floor()
    for k in range(hits):
        floor.hit(0.6 - 0.15 * k, 0.6 * VISIT if k else 0.0)
        floor.map.grid.seen[floor.map.grid.cells == FREE] = floor.map.now
    assert floor.map.last_come == floor.map.now
    floor.map.now += NEW_FOR + 0.1
    floor.map.grid.seen[floor.map.grid.cells == FREE] = floor.map.now
    assert _speed_astern(floor) == pytest.approx(-VISITED_SPEED if visited else -0.24)
    floor.map.now += VISITED_FOR
    floor.map.grid.seen[floor.map.grid.cells == FREE] = floor.map.now
    assert _speed_astern(floor) == pytest.approx(-0.24)


@pytest.mark.parametrize('folded', [0.2, 0.5, math.inf])
def test_a_thing_too_near_to_be_measured_is_not_approached(folded):
    """A leg at a centimetre read as far away, and the robot that stood at it touched it again."""
    floor = Floor()
    floor.hit(-math.inf)
    for _ in range(2 * CLEARINGS):
        floor.read(folded, 0.038)
    assert floor.keep_out.step(BodyTwist(0.24, 0.0), ORIGIN, 0.0).linear < 1e-3
    assert floor.keep_out.step(BodyTwist(-0.1, 0.0), ORIGIN, 0.0).linear == pytest.approx(-0.1)


def test_a_robot_that_begins_knows_of_nothing_that_came():
    floor = Floor()
    floor.map.now = 1.0
    floor.hit(0.4)
    assert floor.is_free(0.5, 0.2)


def _speed_astern(floor):
    """Return the speed (m/s) at which a robot that wants 0.24 m/s may back away."""
    return floor.keep_out.step(BodyTwist(-0.24, 0.0), ORIGIN, 0.0).linear


def test_a_single_reading_hides_no_floor_and_is_soon_cleared():
    """One short reading in fifty that was of nothing let a patrol drive 1.4 m of 8 m a minute."""
    floor = Floor()
    floor.read(0.4)
    assert _state(floor.keep_out, 0.5, 0.05) == OCCUPIED  # the robot brakes for it all the same
    assert floor.is_free(0.5, 0.2)
    assert _speed_astern(floor) == pytest.approx(-0.24)
    floor.read(math.inf, 0.038)
    assert floor.is_free(0.5, 0.05)


@pytest.mark.parametrize('second', [0.4, 0.42, 0.35])
def test_what_is_read_again_is_no_single_reading(second):
    floor = Floor()
    floor.read(0.4)
    floor.read(second, 0.038)
    for _ in range(CLEARINGS - 1):
        floor.read(math.inf, 0.038)
    assert not floor.is_free(0.1 + second, 0.2)
    assert _state(floor.keep_out, 0.1 + second, 0.05) == OCCUPIED
    assert _speed_astern(floor) == pytest.approx(-CAUTIOUS_SPEED)


def test_a_thing_that_is_hit_and_missed_in_turn_stays():
    """The edge of a leg, say: only its first reading is alone."""
    floor = Floor()
    for distance in (0.4, math.inf, 0.4, math.inf):
        floor.read(distance, 0.038)
    assert _state(floor.keep_out, 0.5, 0.05) == OCCUPIED
    assert not floor.is_free(0.5, 0.2)


def test_a_map_for_planning_has_no_single_readings():
    """A planned path left its way for each of them."""
    floor = Floor()
    for published in (False, True):
        floor.read(0.4, 0.038)
        assert (floor.map.occupancy().cells == 100).any() == published
