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
"""A robot that drives round a known room where something has changed, with a noisy pose."""

import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.geometry.types import NANOSECONDS, Pose
from t3mpc_ros.localization.change_detection import ChangeDetector, ChangeKind, ChangeParameters
from t3mpc_ros.localization.distance_field import map_of_world
from t3mpc_ros.localization.range_model import Beams, RangeModel, RangeModelParameters
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import cast_rays, parse_world

MOUNTS = sensor_mounts(RangeSensorParameters())
LEAST, MOST = 0.1, 0.8
LIMITS = np.tile([LEAST, MOST], (len(MOUNTS), 1))
PERIOD = 0.2
WALLS = 'walls: [{points: [[-1.3, -1.0], [1.3, -1.0], [1.3, 1.0], [-1.3, 1.0]], closed: true}]\n'
BOX = 'boxes: [{center: [0.1, 0.05], size: [0.5, 0.3], yaw: 0.4}]\n'
PILLAR = 'circles: [{center: [1.15, 0.8], radius: 0.12}]\n'
KNOWN = WALLS + BOX + PILLAR
SEEN = map_of_world(parse_world(KNOWN, 'cell')).field
MODEL = RangeModel.of(RangeModelParameters(), 0.1)
DEVIATIONS = 0.012, 0.012, 0.012
"""Standard deviations of the pose (m, m, rad), as the localizer knows and as they are."""
ROUND = 2.0 * math.pi * 0.75 / 0.2
"""Time of a round, s."""


class Patrol:
    """A robot on an ellipse; its pose has an error that lasts for some seconds."""

    def __init__(self, seed=1, **values):
        self.generator = np.random.default_rng(seed)
        self.detector = ChangeDetector(ChangeParameters(**values), SEEN, MODEL)
        self.time = 0.0
        self.error = np.zeros(3)
        self.stated = np.diag(np.square(DEVIATIONS))

    def drive(self, world, seconds, bias=(0.0, 0.0, 0.0)):
        """Drive in a world, or one that depends on the time (s); return the last events."""
        for _ in range(round(seconds / PERIOD)):
            self.time += PERIOD
            now = parse_world(world(self.time), 'now') if callable(world) else world
            pose = on_ellipse(self.time)
            exact = np.empty(len(MOUNTS))
            cast_rays(*pose, MOUNTS, np.arange(len(MOUNTS)), now.segments, now.circles, exact)
            deviation = np.hypot(0.012, 0.05 * np.minimum(exact, 1.0) ** 2)
            read = exact + deviation * self.generator.standard_normal(exact.size)
            read = np.where(read < LEAST, -math.inf, np.where(read > MOST, math.inf, read))
            drawn = self.generator.standard_normal(3) * DEVIATIONS
            self.error = 0.9 * self.error + math.sqrt(1.0 - 0.9**2) * drawn
            taken = Pose(*(np.array(pose) + self.error + bias).tolist())
            beams = Beams(MOUNTS, read, LIMITS)
            self.detector.add(round(self.time * NANOSECONDS), taken, self.stated, beams)
        return self.detector.changes


def on_ellipse(time):
    """Return the pose at a time (s), counter-clockwise, clear of everything in the room."""
    phase = math.tau * time / ROUND
    yaw = math.atan2(0.62 * math.cos(phase), -0.85 * math.sin(phase))
    return Pose(0.85 * math.cos(phase), 0.62 * math.sin(phase), yaw)


def world(text):
    return parse_world(text, 'now')


def test_nothing_is_found_where_nothing_has_changed():
    for seed in (1, 2):
        assert Patrol(seed).drive(world(KNOWN), 4.0 * ROUND) == ()


@pytest.mark.parametrize(
    ('added', 'place', 'size'),
    [
        ('circles: [{center: [-0.95, 0.75], radius: 0.1}]\n', (-0.95, 0.75), 0.2),
        ('circles: [{center: [0.3, -0.95], radius: 0.15}]\n', (0.3, -0.95), 0.3),
    ],
)
def test_a_new_thing_is_one_event_at_its_place(added, place, size):
    changed = world(KNOWN.replace(PILLAR, PILLAR[:-2] + ', ' + added[len('circles: [') :]))
    patrol = Patrol()
    assert patrol.drive(world(KNOWN), 10.0) == ()
    (found,) = patrol.drive(changed, 2.0 * ROUND)
    assert found.kind is ChangeKind.NEW
    assert found.present
    assert math.dist((found.x, found.y), place) < 0.15
    assert 0.5 * size <= found.size <= size + 0.2
    assert found.confidence >= 0.95
    assert found.first_ns <= found.found_ns <= found.last_ns
    (same,) = patrol.drive(changed, ROUND)
    assert same.number == found.number == 1
    assert same.first_ns == found.first_ns
    assert same.last_ns > found.last_ns


def test_what_is_gone_is_missing_until_it_is_back():
    patrol = Patrol()
    (found,) = patrol.drive(world(WALLS + PILLAR), 3.0 * ROUND)
    assert found.kind is ChangeKind.MISSING
    assert math.dist((found.x, found.y), (0.1, 0.05)) < 0.15
    (back,) = patrol.drive(world(KNOWN), 3.0 * ROUND)
    assert not back.present
    assert back.kind is ChangeKind.MISSING
    (again,) = patrol.drive(world(WALLS + PILLAR), 3.0 * ROUND)
    assert again.present
    assert again.number == 1


def test_events_since_a_stamp_are_withdrawn_and_found_again():
    patrol = Patrol()
    (found,) = patrol.drive(world(WALLS + PILLAR), 3.0 * ROUND)
    patrol.detector.withdraw(found.found_ns + 1)
    assert patrol.detector.changes == (found,)
    patrol.detector.withdraw(found.found_ns)
    (withdrawn,) = patrol.detector.changes
    assert withdrawn == found._replace(present=False, withdrawn=True)
    assert 'withdrawn: the robot was lost' in withdrawn.text
    (again,) = patrol.drive(world(WALLS + PILLAR), 3.0 * ROUND)
    assert again.present
    assert not again.withdrawn
    assert again.number == 1


def test_what_appears_and_disappears_moves():
    def visited(time):
        phase = math.tau * min(time + 3.0, 9.0) / ROUND
        x, y = 1.15 * math.cos(phase), 0.85 * math.sin(phase)
        person = f'circles: [{{center: [{x}, {y}], radius: 0.1}}]\n'
        return WALLS + BOX + (person if 2.0 <= time < 9.0 else '')

    found = Patrol().drive(visited, 2.0 * ROUND)
    walker = found[0]
    assert walker.kind is ChangeKind.MOVING
    assert not walker.present
    assert walker.last_ns < 12 * NANOSECONDS


def test_a_robot_that_is_not_sure_of_its_place_finds_nothing():
    patrol = Patrol()
    patrol.stated = np.diag(np.square([0.05, 0.05, 0.03]))
    assert patrol.drive(world(KNOWN), 2.0 * ROUND, bias=(0.08, -0.08, 0.05)) == ()
    # The same error of a robot that takes its place for exact is a change of the room.
    patrol = Patrol()
    assert patrol.drive(world(KNOWN), 2.0 * ROUND, bias=(0.08, -0.08, 0.15)) != ()


def test_what_is_no_event_yet_is_suspected_and_forgotten():
    added = world(WALLS + BOX + 'circles: [{center: [-0.95, 0.75], radius: 0.1}]\n')
    patrol = Patrol(min_confidence=0.9999, min_views=100)
    assert patrol.detector.suspected.shape == (0, 2)
    assert patrol.drive(added, ROUND) == ()
    assert np.hypot(*(patrol.detector.suspected - (-0.95, 0.75)).T).min() < 0.15
    patrol.detector.forget()
    assert patrol.detector.changes == ()
    assert patrol.detector.suspected.shape == (0, 2)


def test_equal_readings_give_equal_events():
    changed = world(WALLS + BOX + 'circles: [{center: [-0.95, 0.75], radius: 0.1}]\n')
    patrol = Patrol(seed=5)
    first, second = (each.drive(changed, ROUND) for each in (patrol, Patrol(seed=5)))
    assert first == second
    (event,) = first
    # What is an event is suspected no more.
    assert np.hypot(*(patrol.detector.suspected - (event.x, event.y)).T).min() > 0.5


@pytest.mark.compiled
@pytest.mark.parametrize('seed', few_of(range(4)))
def test_no_readings_of_a_fan_of_beams_are_too_much(seed):
    """One beam saw a thing over which another one passed: its place had no cell, and no middle."""
    generator = np.random.default_rng(seed)
    detector = ChangeDetector(ChangeParameters(), SEEN, MODEL)
    origin = np.column_stack([np.zeros((60, 2)), np.linspace(-1.0, 1.0, 60)])
    limits = np.tile([LEAST, MOST], (60, 1))
    for k in range(50):
        beams = Beams(origin, generator.uniform(0.05, 0.9, 60), limits)
        stamp_ns = round(PERIOD * k * NANOSECONDS)
        detector.add(stamp_ns, on_ellipse(PERIOD * k), np.diag(np.square(DEVIATIONS)), beams)
    for each in detector.changes:
        assert math.isfinite(each.x + each.y + each.size)
        assert 0.0 < each.confidence <= 1.0
