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
"""A robot in a room that the tests simulate: odometry with drift, eight ranges with noise."""

import copy
import functools
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.control.watchdog import ContactMonitor
from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, BodyTwist, Pose, State, wrap_angle
from t3mpc_ros.localization.change_detection import ChangeKind
from t3mpc_ros.localization.distance_field import map_of_world
from t3mpc_ros.localization.localizer import (
    LONGEST_SILENCE,
    SYSTEMATIC,
    Localization,
    Localizer,
    LocalizerParameters,
    PoseCorrection,
    pose_in,
)
from t3mpc_ros.localization.particle_filter import moved_pose, odometry_motion
from t3mpc_ros.localization.range_model import Beams
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import cast_rays, parse_world

MOUNTS = sensor_mounts(RangeSensorParameters())
LEAST, MOST = 0.1, 0.8
PERIOD = 0.05
TEXT = """
walls: [{points: [[-1.3, -1.0], [1.3, -1.0], [1.3, 1.0], [-1.3, 1.0]], closed: true}]
boxes: [{center: [0.1, 0.05], size: [0.5, 0.3], yaw: 0.4}]
circles: [{center: [1.15, 0.8], radius: 0.12}]
"""
ROOM = parse_world(TEXT, 'cell')
SEEN = map_of_world(ROOM)
EVERY = np.arange(len(MOUNTS))


class Drive:
    """A robot on an ellipse in the room, with an odometry that is too long and drifts in yaw."""

    def __init__(self, seed=1, drift=0.004, noise=0.01, start=None):
        self.generator = np.random.default_rng(seed)
        self.phase = 0.0
        self.truth = on_ellipse(0.0) if start is None else start
        self.odometry = ORIGIN
        self.drift, self.noise = drift, noise
        self.offsets = np.zeros(len(MOUNTS))
        """Of the readings per square of the distance, 1/m."""
        self.stamp_ns = 0
        self.room = ROOM

    def distances(self, mounts=MOUNTS):
        out = np.empty(len(mounts))
        which = np.arange(len(mounts))
        cast_rays(*self.truth, mounts, which, self.room.segments, self.room.circles, out)
        return out

    def ranges(self):
        """Return readings with noise, beyond the limits infinite (REP 117)."""
        exact = self.distances()
        found = exact + self.noise * self.generator.standard_normal(exact.size)
        found += self.offsets * np.minimum(exact, 1.0) ** 2
        return np.where(found < LEAST, -math.inf, np.where(found > MOST, math.inf, found))

    def step(self):
        before = on_ellipse(self.phase)
        self.phase += 0.2 * PERIOD / 0.75
        turn, travel, second = odometry_motion(before, on_ellipse(self.phase))
        self.truth = moved_pose(self.truth, (turn, travel, second))
        counted = turn, 1.03 * travel, second + self.drift * PERIOD
        self.odometry = moved_pose(self.odometry, counted)
        self.stamp_ns += round(PERIOD * 1e9)

    def carry(self, by):
        """Put the robot elsewhere on the ellipse; the odometry does not notice."""
        self.phase += by
        self.truth = on_ellipse(self.phase)


def on_ellipse(phase):
    """Return the pose at a phase, counter-clockwise, clear of everything in the room."""
    yaw = math.atan2(0.62 * math.cos(phase), -0.85 * math.sin(phase))
    return Pose(0.85 * math.cos(phase), 0.62 * math.sin(phase), yaw)


def make_localizer(**values):
    start = on_ellipse(0.0)
    given = {f'initial_pose.{name}': value for name, value in start._asdict().items()}
    parameters = LocalizerParameters.from_dict({'set_initial_pose': True, **given, **values})
    return Localizer(parameters, SEEN, MOUNTS, (LEAST, MOST))


def follow(localizer, drive, seconds, loss=0.0):
    """Drive; return distance (m) and angle (rad) of each result from the truth, shape (n, 2)."""
    errors = []
    for _ in range(round(seconds / PERIOD)):
        drive.step()
        for sensor, reading in enumerate(drive.ranges().tolist()):
            if drive.generator.random() >= loss:
                localizer.add_range(sensor, reading)
        if localizer.add_odometry(drive.stamp_ns, drive.odometry):
            errors.append(error(localizer, drive))
    return np.array(errors)


def driven(seconds, drift=0.004):
    """Return localizer and drive after a drive from a known start: copies of one drive.

    A longer drive goes on from a shorter one, in steps of 5 s.
    """
    return copy.deepcopy(_driven(seconds, drift))


@functools.cache
def _driven(seconds, drift):
    if not seconds:
        return make_localizer(), Drive(drift=drift)
    localizer, drive = driven(seconds - 5.0, drift)
    follow(localizer, drive, 5.0)
    return localizer, drive


def error(localizer, drive):
    pose, truth = localizer.result.pose, drive.truth
    away = math.hypot(pose.x - truth.x, pose.y - truth.y)
    return away, abs(wrap_angle(pose.yaw - truth.yaw))


def rms(values):
    return np.sqrt((values**2).mean(axis=0))


@pytest.mark.compiled
def test_a_known_start_is_tracked_while_the_odometry_drifts():
    localizer, drive = make_localizer(), Drive()
    away, turned = rms(follow(localizer, drive, 60.0)[40:])
    assert abs(wrap_angle(drive.odometry.yaw + 0.5 * math.pi - drive.truth.yaw)) > 0.2
    assert away < 0.025
    assert turned < math.radians(1.7)
    assert localizer.state is Localization.LOCALIZED


OFFSETS = 0.1 * np.array([1.0, -0.5, 0.0, 0.5, -1.0, 0.8, 0.2, -0.2])
"""Of the sensors, 1/m: a few centimetres at half a metre."""


@pytest.mark.compiled
@pytest.mark.parametrize(
    ('noise', 'scale', 'most'),
    few_of([(0.03, 1.0, 0.017), (0.05, 0.0, 0.022), (0.01, 1.0, 0.015)], 2),
)
def test_offsets_and_noise_are_found_with_the_pose(noise, scale, most):
    """The pose followed them: it was off by 23, 36 and 18 mm (rms)."""
    localizer, drive = make_localizer(), Drive(noise=noise)
    drive.offsets = scale * OFFSETS
    away, turned = rms(follow(localizer, drive, 60.0)[40:])
    assert away < most
    assert turned < math.radians(1.7)


@pytest.mark.compiled
@pytest.mark.parametrize('way', few_of([2.5, 1.0, 1.4, 4.4]))
def test_a_carried_robot_is_found_with_the_particles(way):
    """The pose that is tracked goes on where the robot is not; it ends when they have found it."""
    localizer, drive = driven(20.0)
    drive.carry(way)
    late = 0
    for _ in range(600):
        follow(localizer, drive, PERIOD)
        particles, pose = localizer._estimate.pose, localizer.result.pose
        near = math.hypot(particles.x - drive.truth.x, particles.y - drive.truth.y) < 0.1
        if near and localizer.state is Localization.LOCALIZED:
            late += math.hypot(pose.x - drive.truth.x, pose.y - drive.truth.y) > 0.15
    assert late <= 10  # half a second
    assert localizer.state is Localization.LOCALIZED
    assert error(localizer, drive)[0] < 0.04


@pytest.mark.compiled
@pytest.mark.parametrize('x, y, yaw', few_of([(0.3, 0.0, 0.0), (0.0, -0.4, 0.5), (0.1, 0.1, 1.0)]))
def test_a_pose_that_is_tracked_wrongly_is_dropped(x, y, yaw):
    localizer, drive = driven(10.0)
    at = localizer._estimate.pose
    localizer._tracker.begin(Pose(at.x + x, at.y + y, at.yaw + yaw), 1e-4 * np.eye(3))
    assert error(localizer, drive)[0] > 0.1
    away, turned = follow(localizer, drive, 8.0)[-10:].T
    assert away.max() < 0.06
    assert turned.max() < 0.06


@pytest.mark.compiled
@pytest.mark.parametrize('fault', ['offset', 'frozen', 'silent', 'all silent'])
def test_sensors_with_a_fault_do_not_lead_the_pose_away(fault):
    """They were off by up to 48 mm with an offset, 49 mm with a frozen sensor."""
    localizer, drive = driven(20.0, drift=0.0)
    frozen = drive.ranges()

    def ranges():
        found = Drive.ranges(drive)
        found[3] = {'offset': found[3] + 0.06, 'frozen': frozen[3]}.get(fault, math.nan)
        return np.full(found.size, math.nan) if fault == 'all silent' else found

    drive.ranges = ranges
    errors = follow(localizer, drive, 10.0)
    assert errors[:, 0].max() < 0.04
    assert localizer.state is Localization.LOCALIZED
    if fault == 'all silent':
        assert np.diag(localizer.result.covariance)[:2].min() > 0.02**2
    del drive.ranges
    assert rms(follow(localizer, drive, 10.0)[-20:])[0] < 0.03


@pytest.mark.compiled
def test_a_robot_at_rest_has_its_pose_and_covariance():
    """Its readings repeat their errors, so that many tell no more than one."""
    localizer, drive = driven(20.0, drift=0.0)
    before = localizer.result
    for _ in range(600):
        drive.stamp_ns += round(PERIOD * 1e9)
        for sensor, reading in enumerate(drive.ranges().tolist()):
            localizer.add_range(sensor, reading)
        assert not localizer.add_odometry(drive.stamp_ns, drive.odometry)
    assert localizer.result.pose[:2] == pytest.approx(before.pose[:2], abs=1e-9)
    assert localizer.result.pose.yaw == pytest.approx(before.pose.yaw, abs=0.03)
    assert np.diag(localizer.result.covariance)[2] >= np.diag(before.covariance)[2]
    assert rms(follow(localizer, drive, 5.0))[0] < 0.03


@pytest.mark.compiled
def test_messages_out_of_order_change_little():
    """Pairs of odometry come swapped, while the pose is tracked by the readings."""
    localizer, drive = driven(10.0)
    errors, waiting = [], None
    for k in range(200):
        drive.step()
        for sensor, reading in enumerate(drive.ranges().tolist()):
            localizer.add_range(sensor, reading, drive.stamp_ns)
        message = drive.stamp_ns, drive.odometry
        if k % 4 == 2:
            waiting = message
            continue
        updated = localizer.add_odometry(*message)
        if waiting is not None:
            localizer.add_odometry(*waiting)
            waiting = None
        if updated:
            errors.append(error(localizer, drive))
    assert rms(np.array(errors))[0] < 0.03


@pytest.mark.compiled
def test_a_pose_that_is_given_twice_ends_the_tracking():
    localizer, drive = driven(10.0)
    for k, given in enumerate((Pose(0.5, -0.7, 1.0), on_ellipse(3.0))):
        localizer.set_pose(given, 1e-4 * np.eye(3))
        assert localizer.add_odometry(drive.stamp_ns + 1 + k, drive.odometry)
        assert localizer.result.pose == pytest.approx(given, abs=0.01)
    for _ in range(2):
        localizer.scatter()
        assert not localizer._tracker.active
    follow(localizer, drive, 0.5)
    assert localizer.result is localizer._estimate


@pytest.mark.compiled
def test_the_covariance_covers_the_error():
    localizer, drive = make_localizer(), Drive(seed=3)
    inside = []
    for _ in range(25):
        follow(localizer, drive, 1.0)
        pose, truth = localizer.result.pose, drive.truth
        gap = np.array([pose.x - truth.x, pose.y - truth.y])
        inside.append(gap @ np.linalg.solve(localizer.result.covariance[:2, :2], gap) < 13.8)
    assert np.mean(inside) >= 0.9  # 99.9 % of a normal distribution; readings repeat their errors
    while not localizer.add_odometry(drive.stamp_ns, drive.odometry):
        drive.step()
    frame = localizer.result.odometry_frame
    assert pose_in(frame, drive.odometry) == pytest.approx(localizer.result.pose)


@pytest.mark.compiled
def test_an_unknown_start_is_found():
    localizer = make_localizer(set_initial_pose=False)
    drive = Drive()
    drive.phase, drive.truth = 2.5, on_ellipse(2.5)
    follow(localizer, drive, 0.2)
    assert localizer.state is Localization.SEARCHING
    assert np.diag(localizer.result.covariance).max() > 0.3
    follow(localizer, drive, 20.0)
    assert localizer.state is Localization.LOCALIZED
    assert error(localizer, drive)[0] < 0.05


@pytest.mark.compiled
def test_a_pose_that_is_given_is_taken():
    localizer, drive = make_localizer(set_initial_pose=False), Drive(start=on_ellipse(1.0))
    follow(localizer, drive, 1.0)
    localizer.set_pose(drive.truth, np.diag([1e-4, 1e-4, 1e-4]))
    localizer.add_odometry(drive.stamp_ns + 1, drive.odometry)
    assert error(localizer, drive) == pytest.approx((0.0, 0.0), abs=5e-3)
    assert localizer.state is Localization.LOCALIZED


def test_a_pose_that_is_given_as_exact_can_be_corrected():
    """Without a covariance all particles were at one place, among which readings choose none."""
    localizer = make_localizer()
    for covariance in (np.zeros((3, 3)), np.diag([0.0, 0.01, 0.01])):
        localizer.set_pose(ORIGIN, covariance)
        least = np.maximum(np.sqrt(np.diag(covariance)), SYSTEMATIC)
        assert localizer.filter.poses.std(axis=0) == pytest.approx(least, rel=0.15)


@pytest.mark.parametrize(
    ('x', 'deviation', 'reason'),
    [
        (1.19, 0.0, ''),  # closer to the wall than the map says that it can be
        (1.5, 0.11, ''),
        (1.5, 0.09, 'm from the free floor of the map, more than 3 standard deviations'),
        (100.0, 0.1, 'x -1.19 to 1.19 m, y -0.89 to 0.89 m: got x 100 m, y 0.6 m'),
        (1e300, 0.1, 'got x 1e'),
        (math.nan, 0.1, 'not finite'),
        (0.9, math.inf, 'not finite'),
        (0.9, 6.0, 'variances must be at most 25 m² and 10 rad²: got 36, 36 and 36'),
    ],
)
def test_a_pose_where_the_robot_cannot_be_is_named(x, deviation, reason):
    problem = make_localizer().pose_problem(Pose(x, 0.6, 0.0), np.diag([deviation**2] * 3))
    assert re.search(reason, problem)
    assert bool(problem) == bool(reason)


def test_a_place_off_the_map_is_not_known():
    localizer = make_localizer()
    localizer.set_pose(Pose(100.0, 100.0, 0.0), np.eye(3) * 1e-4)
    localizer.add_odometry(0, ORIGIN)
    assert localizer.state is Localization.OFF_MAP
    localizer.set_pose(on_ellipse(0.0), np.eye(3) * 1e-4)
    localizer.add_odometry(1, ORIGIN)
    assert localizer.state is Localization.LOCALIZED


@pytest.mark.compiled
def test_readings_without_a_likelihood_do_not_lose_it_for_ever():
    localizer, drive = driven(5.0)
    broken = Beams(np.zeros((1, 3)), np.array([0.5]), np.full((1, 2), math.nan))
    localizer.add_scan(broken)
    while not localizer.add_odometry(drive.stamp_ns, drive.odometry):
        drive.step()
    assert localizer.state is not Localization.LOCALIZED
    follow(localizer, drive, 25.0)
    assert localizer.state is Localization.LOCALIZED
    assert error(localizer, drive)[0] < 0.05


@pytest.mark.compiled
@pytest.mark.parametrize('jump', ['far', 'in yaw', 'near', 'stamp'])
def test_odometry_that_jumps_moves_neither_particle_nor_pose(jump):
    """A board that restarts counts from zero again; the robot has not moved.

    A jump of 0.76 m and 33 degrees, below a metre, was taken for a motion: the robot was lost for
    five seconds, and the used pose 0.2 m off for half a minute.
    """
    (localizer, drive), correction = driven(20.0), PoseCorrection()
    correction.step(drive.stamp_ns, drive.odometry, localizer)
    at, before = localizer.filter.poses.copy(), drive.odometry
    used = pose_in(localizer.result.odometry_frame, before)
    x, y, yaw = before
    drive.odometry = {
        'far': Pose(3.0, -2.0, 1.0),
        'in yaw': Pose(x, y, yaw - 1.2),
        'near': Pose(x + 0.57, y + 0.5, yaw + 0.58),
        'stamp': Pose(x - 0.4, y + 0.2, yaw),
    }[jump]
    drive.stamp_ns = 0 if jump == 'stamp' else drive.stamp_ns + 10_000_000
    kept = correction.step(drive.stamp_ns, drive.odometry, localizer)
    assert kept == pytest.approx(used, abs=1e-9)
    assert localizer.add_odometry(drive.stamp_ns, drive.odometry)
    assert localizer.result.pose == pytest.approx(used, abs=1e-9)
    assert np.array_equal(localizer.filter.poses, at)
    kept = correction.step(drive.stamp_ns + 10_000_000, drive.odometry, localizer)
    assert kept == pytest.approx(used, abs=1e-9)
    assert rms(follow(localizer, drive, 10.0))[0] < 0.03


@pytest.mark.parametrize('disorder', ['every pair', 'each twice', 'one late'])
def test_odometry_out_of_order_is_no_restart(disorder):
    """A swapped pair each 0.2 s was a restart each time: the robot drove, the estimate stood."""
    poses = [(10_000_000 * k, Pose(0.002 * k, 0.0, 0.0)) for k in range(1, 301)]
    if disorder == 'each twice':
        sent = [each for each in poses for _ in range(2)]
    else:
        sent, every = [*poses], 2 if disorder == 'every pair' else 300
        for k in range(every - 1, len(sent), every):
            sent[k - 1], sent[k] = sent[k], sent[k - 1]
        if disorder == 'one late':
            sent.insert(150, poses[140])
    ordered, localizer = make_localizer(), make_localizer()
    updates = sum(ordered.add_odometry(*each) for each in poses)
    assert abs(sum(localizer.add_odometry(*each) for each in sent) - updates) <= 1
    assert localizer.result.pose.x == pytest.approx(ordered.result.pose.x, abs=0.03)
    assert updates >= 10


@pytest.mark.parametrize('late', [-500_000_000, 500_000_000])
def test_readings_of_another_time_are_not_used(late):
    """Half a second late, they were taken where the robot no longer is."""
    localizer = make_localizer()
    localizer.add_odometry(10**9, Pose(0.0, 0.0, 0.0))
    reason = localizer.add_range(0, 0.3, 10**9 + late)
    assert reason == f'it is stamped 0.5 s {"before" if late < 0 else "after"} odom'
    assert localizer._pending == {}
    for stamp_ns in (None, 10**9, 10**9 - 100_000_000):
        localizer._pending.clear()
        assert not localizer.add_range(0, 0.3, stamp_ns)
        assert set(localizer._pending) == {0}


def test_odometry_alone_leaves_the_spread_of_all_particles():
    """That of the particles within 0.3 m of each other is smaller, and does not grow."""
    localizer = make_localizer()
    localizer.set_pose(ORIGIN, np.diag([0.18**2, 0.18**2, 1e-4]))
    for k in range(4):
        localizer.silence = LONGEST_SILENCE
        localizer.add_odometry(10**8 * k, Pose(0.05 * k, 0.0, 0.0))
    assert localizer.share < 0.9
    assert np.diag(localizer.result.covariance)[:2] == pytest.approx(0.18**2, rel=0.2)


@pytest.mark.parametrize('reading', [0.4, math.inf, -math.inf])
def test_a_pose_by_odometry_alone_is_noticed_and_ends(reading):
    localizer, stamp_ns = make_localizer(), 0

    def stand(seconds, period, late_ns=0):
        nonlocal stamp_ns
        for k in range(round(seconds / PERIOD)):
            if k % round(period / PERIOD) == 0:
                localizer.add_range(0, reading, stamp_ns - late_ns)
            stamp_ns += round(PERIOD * 1e9)
            localizer.add_odometry(stamp_ns, ORIGIN)
            yield localizer.silent

    assert not any(stand(5.0, PERIOD))
    assert not any(stand(5.0, 1.0)), 'a slow scanner'
    assert [*stand(2.0 * LONGEST_SILENCE, PERIOD, late_ns=300_000_000)][-1]
    assert not any(stand(1.0, PERIOD))
    assert not any(stand(1.0, 0.5, late_ns=300_000_000))
    stamp_ns += 10_000_000_000
    localizer.add_odometry(stamp_ns, ORIGIN)
    assert not localizer.silent, 'there was no odometry meanwhile'


@pytest.mark.compiled
def test_things_that_the_map_lacks_do_not_lead_it_away():
    """A person goes along at the right: two of the eight ranges are short."""
    localizer, drive = driven(5.0)

    def ranges():
        found = Drive.ranges(drive)
        return np.where(EVERY >= 6, np.minimum(found, 0.2), found)

    drive.ranges = ranges
    assert follow(localizer, drive, 10.0)[:, 0].max() < 0.15


@pytest.mark.compiled
@pytest.mark.parametrize('missing', few_of(['boxes', 'circles']))
def test_a_thing_that_is_gone_does_not_make_it_doubt_its_place(missing):
    """It was lost after 20 readings that passed where a box had been: it was no event yet."""
    localizer, drive = driven(5.0)
    drive.room = parse_world(re.sub(rf'^{missing}: .*$', '', TEXT, flags=re.MULTILINE), 'cell')
    errors = []
    for _ in range({'boxes': 6, 'circles': 12}[missing]):
        errors.extend(follow(localizer, drive, 5.0))
        assert localizer.state is Localization.LOCALIZED
        assert localizer.agreement > 0.6
    assert np.array(errors)[:, 0].max() < 0.1
    (found,) = localizer.changes.changes
    assert found.kind is ChangeKind.MISSING


@pytest.mark.compiled
@pytest.mark.parametrize('gone, lost', [(1, False), (3, True)])
def test_one_place_that_contradicts_the_map_loses_nobody(gone, lost):
    """Beams meet nothing but pillars that are gone, while the robot turns about itself.

    All readings that said something were of them, so it counted as lost after a turn.
    """
    angles = math.tau * np.arange(gone) / 3.0
    pillars = [
        f'{{center: [{0.5 * math.cos(a)}, {0.5 * math.sin(a)}], radius: 0.12}}' for a in angles
    ]
    text = 'walls: [{points: [[-3, -3], [3, -3], [3, 3], [-3, 3]], closed: true}]\n'
    known = map_of_world(parse_world(f'{text}circles: [{", ".join(pillars)}]', 'pillars'))
    parameters = LocalizerParameters.from_dict({'set_initial_pose': True})
    localizer = Localizer(parameters, known, MOUNTS, (LEAST, MOST))
    for k in range(1, 400):
        for sensor in range(len(MOUNTS)):
            localizer.add_range(sensor, math.inf)
        localizer.add_odometry(round(k * PERIOD * 1e9), Pose(0.0, 0.0, wrap_angle(0.025 * k)))
        if localizer.state is Localization.LOST:
            break
    assert (localizer.state is Localization.LOST) is lost
    if not lost:
        assert math.hypot(localizer.result.pose.x, localizer.result.pose.y) < 0.3


@pytest.mark.compiled
@pytest.mark.parametrize(
    ('sensor', 'wrong', 'seconds'),
    few_of([(6, math.inf, 20.0), (3, 0.3, 20.0), (5, -math.inf, 60.0)]),
)
def test_a_sensor_that_contradicts_the_map_is_not_used(sensor, wrong, seconds):
    """A patrol with a sensor that was blind was 12 to 18 mm off, with all of them 10."""
    localizer, drive = driven(20.0)
    assert localizer.doubtful == ()
    drive.ranges = lambda: np.where(sensor == EVERY, wrong, Drive.ranges(drive))
    follow(localizer, drive, seconds)
    assert localizer.doubtful == (sensor,)
    assert localizer.state is Localization.LOCALIZED
    del drive.ranges
    assert rms(follow(localizer, drive, 20.0))[0] < 0.03
    assert localizer.doubtful == ()


@pytest.mark.compiled
def test_no_change_excuses_readings_where_a_place_was_just_found():
    """A robot that took its place for the mirrored one called every contradiction a change."""
    lowest = {}
    for scattered in (False, True):
        localizer, drive = driven(0.0 if scattered else 20.0, drift=0.0)
        if scattered:
            localizer.scatter()
            follow(localizer, drive, 20.0)
        drive.room = parse_world(re.sub('boxes.*', '', TEXT), 'without the box')
        lowest[scattered] = 1.0
        for _ in range(40):
            follow(localizer, drive, 1.0)
            assert localizer.state is Localization.LOCALIZED
            lowest[scattered] = min(lowest[scattered], localizer.agreement)
        (gone,) = localizer.changes.changes
        assert gone.present
    assert lowest[True] < lowest[False] - 0.05


@pytest.mark.compiled
@pytest.mark.parametrize('way', few_of([4.4, 1.0, 1.4]))
def test_a_carried_robot_is_found_and_what_it_saw_is_withdrawn(way):
    """Until it knows that it is lost, the map seems to have changed: up to four false events."""
    localizer, drive = driven(20.0)
    drive.carry(way)
    states = set()
    for _ in range(30):
        follow(localizer, drive, 1.0)
        states.add(localizer.state)
    assert Localization.LOST in states
    assert localizer.state is Localization.LOCALIZED
    assert error(localizer, drive)[0] < 0.05
    assert localizer.changes.changes
    assert not any(each.present for each in localizer.changes.changes)


@pytest.mark.compiled
def test_a_scan_is_used_like_the_ranges():
    localizer, drive = make_localizer(sigma_hit_growth=0.0), Drive(seed=7)
    angles = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    beams = np.column_stack([np.zeros(24), np.zeros(24), angles])
    limits = np.tile([0.05, 3.0], (24, 1))
    errors = []
    for _ in range(200):
        drive.step()
        found = drive.distances(beams) + 0.01 * drive.generator.standard_normal(24)
        localizer.add_scan(Beams(beams, np.where(found > 3.0, math.inf, found), limits))
        if localizer.add_odometry(drive.stamp_ns, drive.odometry):
            errors.append(error(localizer, drive))
    away, turned = rms(np.array(errors)[20:])
    assert away < 0.015
    assert turned < math.radians(1.0)


def test_a_robot_without_range_sensors_has_no_doubtful_one():
    """With a scan alone each update warned of the mean of nothing."""
    localizer = Localizer(make_localizer().parameters, SEEN, np.empty((0, 3)), (LEAST, MOST))
    assert localizer.doubtful == ()
    assert PoseCorrection().step(0, ORIGIN, localizer) is None  # the place is not known yet
    localizer.add_odometry(0, ORIGIN)
    nothing = Beams(np.empty((0, 3)), np.empty(0), np.empty((0, 2)))
    assert localizer.add_scan(nothing) == 'it has no reading'


@pytest.mark.compiled
def test_equal_inputs_give_equal_bits():
    results = []
    for _ in range(2):
        localizer, drive = make_localizer(set_initial_pose=False, seed=4), Drive()
        follow(localizer, drive, 2.0)
        results.append((localizer.result.pose, localizer.filter.poses.tobytes()))
    assert results[0] == results[1]
    other, drive = make_localizer(set_initial_pose=False, seed=5), Drive()
    follow(other, drive, 2.0)
    assert other.filter.poses.tobytes() != results[0][1]


def test_a_robot_at_rest_updates_nothing():
    localizer, drive = make_localizer(), Drive()
    assert localizer.state is Localization.NO_ODOMETRY
    assert localizer.add_odometry(0, ORIGIN)
    for k in range(20):
        for sensor in EVERY.tolist():
            localizer.add_range(sensor, 0.2)
        assert not localizer.add_odometry(k + 1, drive.odometry)


def drive_corrected(localizer, drive, correction, seconds):
    """Drive; return the changes of the corrected pose less those of the odometry, and it."""
    changes, before, previous = [], None, None
    for _ in range(round(seconds / PERIOD)):
        drive.step()
        pose = correction.step(drive.stamp_ns, drive.odometry, localizer)
        for sensor, reading in enumerate(drive.ranges().tolist()):
            localizer.add_range(sensor, reading)
        localizer.add_odometry(drive.stamp_ns, drive.odometry)
        if before is not None and pose is not None:
            motion = odometry_motion(previous, drive.odometry)
            expected = moved_pose(before, motion)
            away = math.hypot(pose.x - expected.x, pose.y - expected.y)
            changes.append((away, abs(wrap_angle(pose.yaw - expected.yaw))))
        before, previous = pose, drive.odometry
    return np.array(changes), before


@pytest.mark.compiled
def test_the_corrected_pose_is_exact_and_moves_slowly():
    """The corrections of the filter are up to centimetres at once; the wheels feel none."""
    localizer, drive, correction = make_localizer(), Drive(), PoseCorrection()
    follow(localizer, drive, 1.0)
    changes, pose = drive_corrected(localizer, drive, correction, 20.0)
    assert changes[:, 0].max() <= 0.05 * PERIOD + 1e-9
    assert changes[:, 1].max() <= 0.2 * PERIOD + 1e-9
    assert math.hypot(pose.x - drive.truth.x, pose.y - drive.truth.y) < 0.06


@pytest.mark.compiled
def test_the_corrected_pose_jumps_where_the_robot_is_found():
    localizer, drive, correction = make_localizer(), Drive(), PoseCorrection()
    drive_corrected(localizer, drive, correction, 10.0)
    drive.carry(2.5)
    changes, pose = drive_corrected(localizer, drive, correction, 25.0)
    assert changes[:, 0].max() > 0.25
    assert math.hypot(pose.x - drive.truth.x, pose.y - drive.truth.y) < 0.06


@pytest.mark.parametrize('x, y', few_of([(0.2, 0.0), (0.0, 0.2), (-0.2, 0.0), (0.0, -0.2)]))
def test_a_correction_is_no_contact(x, y):
    """A robot backed off, twice, from nothing, and then took itself to be walled in for ever.

    In tight curves it still did so: most of the way of its centre is then the correction.
    """
    monitor, correction, pose, now = ContactMonitor(), PoseCorrection(), ORIGIN, STANDSTILL
    frame, touches = ORIGIN, []
    for k in range(8500):
        phase = k // 200 % 6
        wanted = [(0.3, 0.0), (0.0, 2.0), (0.011, 1.2), (0.1, 0.5), (0.02, 0.0), (0.04, 2.0)][
            phase
        ]
        step = [min(max(w - n, -a), a) for w, n, a in zip(wanted, now, (0.01, 0.14), strict=True)]
        now = BodyTwist(now.linear + step[0], now.angular + step[1])
        pose = advance_pose(pose, now, 0.01)
        if k % 1400 == 0:  # at each of them once
            frame = Pose(frame.x + x, frame.y + y, frame.yaw)
        localizer = SimpleNamespace(
            result=SimpleNamespace(odometry_frame=frame), state=Localization.LOCALIZED
        )
        found = correction.step(k * 10_000_000, pose, localizer)
        touches.append(monitor.is_in_contact(State(k * 10_000_000, found, now), now, 0.01))
    assert not any(touches)


@pytest.mark.parametrize('impossible', [math.nan, -0.3])
def test_impossible_readings_are_no_readings(impossible):
    poses = []
    for reading in ((), (impossible,)):
        localizer, drive = make_localizer(), Drive()
        for each in reading:
            localizer.add_range(0, 0.3)  # before any odometry
            assert not localizer.add_odometry(0, Pose(each, 0.0, math.nan))
        for _ in range(100):
            drive.step()
            for sensor in range(2):
                localizer.add_range(sensor, 0.4)
            for each in reading:
                localizer.add_range(5, each)
            localizer.add_odometry(drive.stamp_ns, drive.odometry)
        poses.append(localizer.result.pose)
    assert poses[0] == poses[1]


@pytest.mark.compiled
def test_a_search_ends_when_readings_fit_for_some_time():
    """Where half of them happened to fit, a carried robot took the place for known."""
    localizer, drive = make_localizer(seed=3), Drive(seed=3)
    follow(localizer, drive, 10.0)
    drive.carry(2.5)
    lost = early = False
    for _ in range(600):
        follow(localizer, drive, 0.1)
        lost = lost or localizer.state is Localization.LOST
        known = localizer.state is Localization.LOCALIZED
        early = early or (lost and known and localizer.agreement < 0.85)
        if lost and known and localizer.agreement >= 0.9:
            break
    assert lost
    assert known
    assert not early


def turned_too_far(localizer, drive, seconds):
    """Drive; return the mean of the estimated yaw less the true one, rad."""
    gaps = []
    for _ in range(round(seconds / PERIOD)):
        follow(localizer, drive, PERIOD)
        gaps.append(wrap_angle(localizer.result.pose.yaw - drive.truth.yaw))
    return float(np.mean(gaps))


def yaw_errors(drift):
    """Return mean errors of 20 s: after a drift of 40 s, and 40 s after it."""
    localizer, drive = driven(40.0, drift)
    drifting = turned_too_far(localizer, drive, 20.0)
    drive.drift = 0.0
    turned_too_far(localizer, drive, 40.0)
    return np.array([drifting, turned_too_far(localizer, drive, 20.0)])


@pytest.mark.compiled
def test_the_drift_of_a_gyro_is_measured_by_the_map():
    """A patrol was 2 degrees and 24 mm off after its gyro had drifted for twelve minutes.

    At its next rest the gyro measures its bias, and the odometry drifts no more. The errors of a
    drive without a drift come from the length of its odometry.
    """
    assert abs(yaw_errors(-0.009) - yaw_errors(0.0)).max() < 0.005


@pytest.mark.compiled
def test_a_robot_at_rest_does_not_turn_with_its_gyro():
    """Its pose loop followed the odometry, which did not turn then, and the robot did."""
    localizer, drive = driven(40.0, drift=-0.009)
    yaw = drive.truth.yaw
    for _ in range(round(10.0 / PERIOD)):
        drive.stamp_ns += round(PERIOD * 1e9)
        drive.odometry = moved_pose(drive.odometry, (0.0, 0.0, drive.drift * PERIOD))
        for sensor, reading in enumerate(drive.ranges().tolist()):
            localizer.add_range(sensor, reading)
        localizer.add_odometry(drive.stamp_ns, drive.odometry)
        used = pose_in(localizer.result.odometry_frame, drive.odometry)
        assert abs(wrap_angle(used.yaw - yaw)) < 0.03  # 0.09 by the odometry


@pytest.mark.compiled
@pytest.mark.parametrize('angle', few_of([-0.3, 0.3]))
def test_a_slip_is_no_drift(angle):
    assert abs(turned_after_slip(angle) - turned_after_slip(0.0)) < 0.003


@functools.cache
def turned_after_slip(angle):
    localizer, drive = driven(60.0, drift=0.0)
    drive.odometry = moved_pose(drive.odometry, (0.0, 0.0, angle))
    turned_too_far(localizer, drive, 10.0)
    return turned_too_far(localizer, drive, 10.0)


@pytest.mark.compiled
def test_a_slip_is_no_reason_to_look_elsewhere():
    """A turn that the odometry missed led to another place that looked alike, 1.4 m away."""
    for seed in (1, 2):
        localizer, drive = make_localizer(seed=seed), Drive(seed=seed)
        follow(localizer, drive, 10.0)
        x, y, yaw = drive.odometry
        drive.odometry = Pose(x, y, wrap_angle(yaw - 0.25))
        away, turned = follow(localizer, drive, 15.0).T
        assert away.max() < 0.25
        assert away[-20:].max() < 0.06
        assert turned[-20:].max() < 0.06


def test_an_estimate_that_jumps_must_fit_for_some_time():
    localizer, drive = driven(5.0)
    assert localizer.state is Localization.LOCALIZED
    localizer.filter.place(Pose(-0.9, 0.8, 1.0), 1e-4 * np.eye(3))  # as if readings fitted there
    follow(localizer, drive, 0.6)
    assert localizer.result.pose.x < -0.5
    assert localizer.state is not Localization.LOCALIZED


def test_the_yaw_drifts_with_time():
    made = [make_localizer(yaw_drift=drift) for drift in (0.0, 1e-3)]
    for localizer in made:
        for k in range(40):
            localizer.add_odometry(k * 10**9, Pose(0.06 * k, 0.0, 0.0))
    narrow, wide = (localizer.filter.poses[:, 2].std() for localizer in made)
    assert wide > math.sqrt(narrow**2 + 0.9 * 39e-3)
