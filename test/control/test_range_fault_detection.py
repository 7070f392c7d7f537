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
"""Range sensors that are silent, frozen, late or impossible: noticed by name, and what follows."""

import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.control.keep_out import CAUTIOUS_SPEED, OCCUPIED, KeepOut, KeepOutParameters
from t3mpc_ros.control.range_fault_detection import NOTHING_SEEN, RangeFault, RangeMonitor
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.obstacles import Obstacles
from t3mpc_ros.geometry.types import ORIGIN, RANGE_SENSORS, STANDSTILL, BodyTwist, Pose, State
from t3mpc_ros.simulation.world import cast_rays

PERIOD_NS = 10_000_000
NO_CIRCLES = np.empty((0, 3))
TIMEOUT = KeepOutParameters().range_timeout
MOUNTS = np.array(KeepOutParameters().mounts).reshape(-1, 3)
FRONT, SIDES, REAR = (0, 1), (2, 3, 6, 7), (4, 5)


def _monitor():
    return RangeMonitor(MOUNTS, TIMEOUT, 0.8)


class Drive:
    """A monitor on a robot that drives with a twist; sensors report every 40 ms."""

    def __init__(self, twist=STANDSTILL):
        self.monitor, self.twist, self.pose, self.k = _monitor(), twist, ORIGIN, 0
        self.noise = np.random.default_rng(7)

    def run(self, seconds, readings=lambda sensor, time: 0.3):
        """Drive; ``readings`` returns a reading, a pair with a stamp, or None."""
        for _ in range(round(seconds / 0.01)):
            self.k += 1
            self.pose = advance_pose(self.pose, self.twist, 0.01)
            for sensor in range(8) if self.k % 4 == 0 else ():
                found = readings(sensor, 0.01 * self.k)
                if found is not None:
                    reading, stamp = found if isinstance(found, tuple) else (found, None)
                    self.monitor.accept(sensor, reading, stamp)
            self.monitor.update(self.k * PERIOD_NS, self.pose)
        return self.monitor


def _noisy(drive):
    """Return readings of a robot amid things: another one each time."""
    return lambda sensor, time: 0.3 + 0.01 * int(drive.noise.integers(-5, 5))


def test_before_the_first_reading_every_sensor_is_silent():
    monitor = _monitor()
    monitor.update(0, ORIGIN)
    assert monitor.faults() == dict.fromkeys(RANGE_SENSORS, RangeFault.SILENT)
    assert monitor.is_blind(astern=False)
    assert monitor.is_blind(astern=True)
    assert monitor.problem() == 'all range sensors silent'


@pytest.mark.parametrize('sensor', [0, 3, 5])
def test_one_silent_sensor_is_named_after_the_time_out(sensor):
    drive = Drive()
    assert not drive.run(1.0).lost

    def others(one, time):
        return None if one == sensor else 0.3

    assert not drive.run(TIMEOUT - 0.05, others).lost
    monitor = drive.run(0.1, others)
    assert monitor.faults() == {RANGE_SENSORS[sensor]: RangeFault.SILENT}
    assert RANGE_SENSORS[sensor] in monitor.problem()
    assert not monitor.is_blind(astern=False)
    assert not monitor.is_blind(astern=True)
    assert not drive.run(0.1).lost  # it comes back


@pytest.mark.parametrize(
    ('lost', 'ahead', 'astern'),
    [(FRONT, True, False), (REAR, False, True), (SIDES, False, False), (range(8), True, True)],
)
def test_too_few_sensors_are_those_of_the_direction_of_motion(lost, ahead, astern):
    drive = Drive()
    drive.run(1.0)
    drive.run(0.5, lambda sensor, time: None if sensor in lost else 0.3)
    assert drive.monitor.is_blind(astern=False) is ahead
    assert drive.monitor.is_blind(astern=True) is astern


def test_a_robot_brakes_before_the_time_out():
    drive = Drive()
    drive.run(1.0)
    drive.run(0.07, lambda sensor, time: None)
    assert not drive.monitor.waits(astern=False)
    drive.run(0.04, lambda sensor, time: None if sensor in FRONT else 0.3)
    assert drive.monitor.waits(astern=False)
    assert not drive.monitor.waits(astern=True)
    drive.run(0.04, lambda sensor, time: 0.3 if sensor == 1 else None)
    assert not drive.monitor.waits(astern=False)  # one of both is enough


@pytest.mark.parametrize(
    ('reading', 'fault'),
    [
        *[(value, RangeFault.IMPOSSIBLE) for value in (math.nan, -0.01, 0.85)],
        *[(value, None) for value in (0.0, float(np.float32(0.8)), math.inf, -math.inf)],
    ],
)
def test_impossible_readings_are_those_that_no_sensor_gives(reading, fault):
    drive = Drive()
    drive.run(1.0)
    monitor = drive.run(0.5, lambda sensor, time: reading if sensor == 3 else 0.3)
    assert monitor.faults() == ({'left_back': fault} if fault else {})


def _stamped(age):
    return lambda sensor, time: (0.3, round(1e9 * (time - age)))


def test_late_repeated_and_overtaken_readings():
    """A reading counts by its stamp: old ones, and those that come again, are none."""
    drive = Drive()
    assert not drive.run(1.0, _stamped(0.0)).lost
    assert set(drive.run(0.5, _stamped(0.5)).faults().values()) == {RangeFault.LATE}
    assert set(drive.run(0.5, _stamped(-5.0)).faults().values()) == {RangeFault.LATE}
    assert not drive.run(0.2, _stamped(0.0)).lost
    last = round(1e9 * 0.01 * drive.k)
    found = drive.run(0.5, lambda sensor, time: (0.3, last)).faults()
    assert len(found) == 8
    assert set(found.values()) <= {RangeFault.REPEATED, RangeFault.LATE}
    assert not drive.run(0.2, _stamped(0.0)).lost
    used = [
        drive.monitor.accept(0, 0.3, round(1e9 * 0.01 * drive.k) + ns) for ns in (20, 10, 20, 30)
    ]
    assert used == [True, False, False, True]


@pytest.mark.parametrize(('twist', 'sensor'), [(BodyTwist(0.2, 0.0), 0), (BodyTwist(0.0, 1.0), 5)])
def test_a_sensor_that_freezes_in_motion_is_found(twist, sensor):
    drive = Drive(twist)
    noisy = _noisy(drive)
    drive.run(1.0, noisy)
    assert not drive.run(0.24, lambda one, time: 0.5).lost  # six equal readings are chance
    drive.run(0.2, noisy)
    drive.run(2.0, lambda one, time: 0.35 if one == sensor else noisy(one, time))
    assert drive.monitor.faults() == {RANGE_SENSORS[sensor]: RangeFault.FROZEN}
    assert not drive.run(0.2, _noisy(drive)).lost


@pytest.mark.parametrize(
    ('twist', 'readings'),
    [
        (STANDSTILL, lambda sensor, time: 0.3),  # a robot that stands sees one thing
        (BodyTwist(0.3, 1.0), lambda sensor, time: math.inf),  # the middle of a hall
        (BodyTwist(0.3, 0.0), lambda sensor, time: 0.12 if sensor in SIDES else math.inf),
    ],
)
def test_constant_readings_that_are_no_fault(twist, readings):
    """The last: along a wall near enough that the noise is below the step of the reading."""
    assert not Drive(twist).run(5.0, readings).lost


def test_a_sensor_that_freezes_with_noise_is_found_on_the_spot():
    """A cable before it: seven healthy sensors were named in its place, and the robot stood."""
    drive = Drive(BodyTwist(0.0, 1.2))
    noisy = _noisy(drive)

    def cable(sensor, time):
        return 0.45 + 0.01 * drive.noise.standard_normal() if sensor == 2 else noisy(sensor, time)

    frozen = {'left_front': RangeFault.FROZEN}
    assert drive.run(2.5, cable).faults() == frozen
    drive.twist = BodyTwist(0.3, 0.0)
    for _ in range(20):
        assert drive.run(0.2, cable).faults() == frozen
    assert not drive.run(0.2, noisy).lost


@pytest.mark.parametrize('kind', ['stands', 'is followed', 'turns in a narrow place'])
def test_readings_that_stay_similar_are_no_fault(kind):
    """The second: by somebody at 0.42 m behind it, on straights and on arcs."""
    twist = {'stands': STANDSTILL, 'is followed': BodyTwist(0.2, 0.5)}.get(kind)
    drive = Drive(twist or BodyTwist(0.0, 1.2))
    square = 0.17 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
    walls, far = np.column_stack([square[:-1], square[1:]]), np.empty(8)

    def readings(sensor, time):
        noise = 0.004 * drive.noise.standard_normal()
        if twist is not None:
            return 0.42 + noise
        cast_rays(*drive.pose, MOUNTS, np.arange(8), walls, NO_CIRCLES, far)
        return float(far[sensor]) + noise

    for _ in range(40):
        assert drive.run(0.25, readings).faults() == {}


@pytest.mark.parametrize('radius', [0.3, 0.5, 0.85])
@pytest.mark.parametrize('aside', [0.0, 0.06])
def test_in_a_round_room_no_sensor_is_frozen(radius, aside):
    """They read one distance while the robot turns: all eight were frozen, and the robot stood."""
    angles = np.linspace(0.0, math.tau, 25)
    corners = radius * np.column_stack([np.cos(angles), np.sin(angles)]) + [aside, 0.0]
    walls, far = np.column_stack([corners[:-1], corners[1:]]), np.empty(8)
    keep_out = KeepOut(KeepOutParameters(), BodyTwist(0.3, 2.0))
    noise = np.random.default_rng(7)
    for k in range(150):
        keep_out.map.now += 0.04
        pose = Pose(0.0, 0.0, 0.048 * k)
        cast_rays(*pose, MOUNTS, np.arange(8), walls, NO_CIRCLES, far)
        # The noise of a near reading is less than its step.
        steps = 1000.0 * far + np.where(far < 0.25, 0.0, 15.0 * far**2) * noise.standard_normal(8)
        for sensor, reading in enumerate(np.round(steps) / 1000.0):
            keep_out.add_reading(sensor, float(reading) if reading < 0.8 else math.inf, pose)
        keep_out.ranges.update(4 * (k + 1) * PERIOD_NS, pose)
        assert keep_out.ranges.faults() == {}


def test_a_frozen_sensor_marks_no_floor():
    keep_out = KeepOut(KeepOutParameters(), BodyTwist(0.3, 2.0))
    for k in range(100):
        pose = Pose(0.0, 0.0, 0.05 * k)
        if k == 60:
            assert keep_out.ranges.faults() == {'left_front': RangeFault.FROZEN}
            cells = keep_out.map.grid.cells.copy()
        for sensor in range(8) if k < 60 else [2]:
            keep_out.add_reading(sensor, 0.45 + 0.01 * (k % 3) if sensor == 2 else math.inf, pose)
        keep_out.ranges.update(4 * k * PERIOD_NS, pose)
    assert np.array_equal(keep_out.map.grid.cells, cells)


class Room:
    """A keep-out on an exact robot that circles in a corner of a square room."""

    def __init__(self, world=None):
        square = 1.2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
        self.walls = np.column_stack([square[:-1], square[1:]])
        self.keep_out = KeepOut(KeepOutParameters(), BodyTwist(0.3, 2.0), world)
        self.pose, self.k = Pose(-0.75, -0.95, 0.0), 0

    def run(self, seconds, blind=(), circles=NO_CIRCLES):
        far, which = np.empty(8), np.arange(8)
        for _ in range(round(seconds / 0.04)):
            self.k += 4
            self.keep_out.map.now += 0.04
            self.pose = advance_pose(self.pose, BodyTwist(0.1, 0.5), 0.04)
            cast_rays(*self.pose, MOUNTS, which, self.walls, circles, far)
            for sensor, distance in enumerate(far):
                seen = distance < 0.8 and sensor not in blind
                self.keep_out.add_reading(sensor, distance if seen else math.inf, self.pose)
            self.keep_out.ranges.update(self.k * PERIOD_NS, self.pose)
        return self.keep_out.ranges.faults()


@pytest.mark.compiled
@pytest.mark.parametrize('sensor', few_of(range(8)))
def test_a_sensor_that_sees_nothing_is_found_by_what_others_saw(sensor):
    room = Room()
    assert room.run(20.0) == {}
    found = room.run(40.0, blind=[sensor])
    assert found == {RANGE_SENSORS[sensor]: RangeFault.BLIND}
    cells = room.keep_out.map.grid.cells.copy()
    room.run(20.0, blind=[sensor])
    assert np.count_nonzero(room.keep_out.map.grid.cells == OCCUPIED) >= (
        np.count_nonzero(cells == OCCUPIED)
    )  # its rays clear nothing
    assert room.run(20.0) == {}  # it sees again


@pytest.mark.compiled
def test_sensors_that_all_see_nothing_are_named():
    """Without their supply they read so: the robot drove at full speed into what it had seen.

    Things that leave make no sensor blind: they are in the map where no ray has passed since.
    """
    room = Room()
    people = np.array([[-0.1, -0.5, 0.12], [-0.6, -0.2, 0.12]])
    assert room.run(20.0, circles=people) == {}
    for _ in range(40):
        assert room.run(0.5) == {}
    found = room.run(20.0, blind=range(8))
    assert found == dict.fromkeys(RANGE_SENSORS, RangeFault.BLIND)
    assert 'all range sensors blind' in room.keep_out.ranges.problem()
    assert room.keep_out.ranges.is_blind(astern=False)
    assert room.run(20.0) == {}  # they see again


def test_who_walks_by_leaves_no_surface_that_another_must_see():
    """Cells along a walk of two metres were five surfaces: healthy sensors were called blind."""
    keep_out = KeepOut(KeepOutParameters(), BodyTwist(0.3, 2.0))
    for k in range(100):  # somebody walks along
        keep_out.map.now += 0.04
        keep_out.add_reading(2, 0.35, Pose(0.02 * k, 0.0, 0.0))
    for k in range(100):  # and is gone
        pose = Pose(0.1 + 0.02 * k, 0.0, math.pi)
        keep_out.add_reading(6, math.inf, pose)
        keep_out.ranges.update(4 * k * PERIOD_NS, pose)
        assert RangeFault.BLIND not in keep_out.ranges.faults().values()


def test_what_a_sensor_missed_long_ago_does_not_count():
    """Four things that left in an hour made a sensor blind that had nothing to see."""
    monitor = _monitor()
    for k in range(4):
        monitor.update(k * 1_000_000_000, ORIGIN)
        monitor.accept(0, 0.5, None)
        monitor.accept(3, math.inf, None)
        monitor.miss(3, (float(k), 0.0))
    monitor.update(4_000_000_000, ORIGIN)
    assert monitor.faults()['left_back'] is RangeFault.BLIND
    assert 'a hand before it' in monitor.problem()
    for k in (0, 40, 80, 120, 160, 200):
        now = (1000 + k) * 1_000_000_000
        monitor.accept(0, 0.5, None)
        monitor.accept(3, math.inf, None)
        monitor.update(now, ORIGIN)
        assert 'left_back' not in monitor.faults()
        monitor.miss(3, (float(k), 1.0))


@pytest.mark.parametrize('noise', [0.0, 0.003])
def test_a_robot_that_sees_nothing_for_long_is_slow_and_says_so(noise):
    """In the open it may be right; one that stands has not driven, whatever its pose's noise."""
    monitor, generator = _monitor(), np.random.default_rng(3)
    for k in range(4000):
        x = 0.003 * max(k - 2000, 0) + noise * generator.standard_normal()
        for sensor in range(8):
            monitor.accept(sensor, math.inf, k * PERIOD_NS)
        monitor.update(k * PERIOD_NS, Pose(x, noise * generator.standard_normal(), 0.0))
        far = 0.003 * (k - 2000) > NOTHING_SEEN
        if abs(0.003 * (k - 2000) - NOTHING_SEEN) > 0.2:
            assert monitor.lost == far
            assert ('no range sensor has seen anything for' in monitor.problem()) == far
    monitor.accept(3, 0.5, 4000 * PERIOD_NS)
    monitor.update(4000 * PERIOD_NS, Pose(x, 0.0, 0.0))
    assert not monitor.lost
    assert monitor.faults() == {}


@pytest.mark.compiled
def test_what_nobody_has_seen_makes_no_sensor_blind():
    """Walls of the world file may be missing, and what was touched is not seen."""
    square = 0.8 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
    known = Obstacles(np.column_stack([square[:-1], square[1:]]), NO_CIRCLES)
    assert Room(known).run(40.0) == {}


class KeptOut:
    """A controller with keep-out and an ideal robot on a straight reference of 0.3 m/s."""

    def __init__(self):
        self.controller = Controller(
            StepperControllerParameters.from_dict(
                {'pose.enabled': True, 'keep_out.enabled': True, 'keep_out.map.half_size': 6.0}
            )
        )
        self.k, self.pose, self.twist = 0, ORIGIN, STANDSTILL
        self.speeds, self.reasons = [], []

    def run(self, seconds, sensors=range(8), reading=math.inf, fresh=True):
        for _ in range(round(seconds / 0.01)):
            self.k += 1
            now = self.k * PERIOD_NS
            ahead = now + 40 * PERIOD_NS
            place = ORIGIN._replace(x=self.pose.x + 0.3 * 0.4)
            self.controller.add_reference(State(ahead, place, BodyTwist(0.3, 0.0)))
            for sensor in sensors if self.k % 4 == 0 else ():
                self.controller.add_range(sensor, reading, now if fresh else now - 500_000_000)
            self.pose = advance_pose(self.pose, self.twist, 0.01)
            self.twist, status = self.controller.step(State(now, self.pose, self.twist))
            self.speeds.append(self.twist.linear)
            self.reasons.append(status.reason)
        return self

    def run_until_fast(self):
        """Drive on until the robot is fast: it looks around first, and now and then."""
        while not self.speeds or self.speeds[-1] < 0.25:
            assert self.run(0.05).k < 4000
        return len(self.speeds)


@pytest.mark.compiled
def test_all_silent_brakes_stops_and_goes_on_by_itself():
    robot = KeptOut().run(0.5, sensors=())
    assert robot.reasons[-1] is Reason.TOO_FEW_RANGES  # none before the first reading
    assert robot.pose == ORIGIN
    cut = robot.run_until_fast()
    robot.run(1.0, sensors=())
    fastest = max(robot.speeds)
    assert max(robot.speeds[cut + 18 :]) < fastest - 0.05  # it brakes before the time-out
    assert robot.reasons[cut + 30] is Reason.TOO_FEW_RANGES
    assert set(robot.speeds[cut + 30 :]) == {0.0}
    assert 'all range sensors silent' in robot.controller.problems()
    robot.run(4.0, fresh=False)
    assert robot.reasons[-1] is Reason.TOO_FEW_RANGES
    robot.controller.enable(False)  # is said whatever the sensors say
    assert robot.run(0.2, sensors=()).reasons[-1] is Reason.DISABLED
    robot.controller.enable(True)
    robot.run_until_fast()
    assert robot.reasons[-1] is Reason.TRACKING


@pytest.mark.compiled
def test_a_pose_that_jumps_is_no_fault_of_the_sensors():
    """A pose in mm stopped the robot because of "all range sensors silent"."""
    robot = KeptOut()
    begin = robot.run_until_fast()
    for sign in (1.0, -1.0, 1.0):
        robot.pose = robot.pose._replace(x=robot.pose.x + sign)
        robot.run(0.3)
    assert Reason.TOO_FEW_RANGES not in robot.reasons[begin:]
    assert 'silent' not in ' '.join(robot.controller.problems())


@pytest.mark.compiled
@pytest.mark.parametrize('lost', few_of(range(8), step=5))
def test_with_one_sensor_lost_the_robot_drives_slowly(lost):
    robot = KeptOut()
    begin = robot.run_until_fast()
    robot.run(2.0, sensors=[each for each in range(8) if each != lost])
    assert max(robot.speeds[begin + 60 :]) < CAUTIOUS_SPEED + 0.01
    assert RANGE_SENSORS[lost] in ' '.join(robot.controller.problems())
    assert Reason.TOO_FEW_RANGES not in robot.reasons[begin:]


@pytest.mark.compiled
def test_rejected_readings_change_no_command():
    """A replay has only those that were used: its commands must be those of the run."""
    one, other = KeptOut(), KeptOut()
    for robot, extra in ((one, True), (other, False)):
        for _ in range(30):
            robot.run(0.1)
            if extra:
                now = robot.k * PERIOD_NS
                for stamp in (now - 600_000_000, now - 100_000_000, now):
                    robot.controller.add_range(0, math.nan, stamp)
                assert not robot.controller.add_range(1, 5.0)
    assert one.speeds == other.speeds
    assert one.pose == other.pose
