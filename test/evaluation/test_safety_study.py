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
"""Safety of a patrol: contacts as geometry says, and a robot whose sensors all fail."""

import math

import numpy as np
import pytest

from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.patrol import safety_study
from t3mpc_ros.evaluation.patrol.patrol_run import START, FaultyRanges, SensorFault
from t3mpc_ros.evaluation.run_record import RATE, Record
from t3mpc_ros.geometry.types import BodyTwist, Pose, State
from t3mpc_ros.simulation.world import parse_world

WALL = 'walls: [{points: [[1, -2], [1, 2]]}]'


def _record(places, speed):
    """Return the record of a robot that faces a wall at x = 1 m."""
    n = len(places)
    truth = np.column_stack([places, np.zeros(n), np.zeros(n)])
    twist = np.column_stack([np.full(n, speed), np.zeros(n)])
    return Record({'time': np.arange(n) / RATE, 'truth': truth, 'twist': twist})


def test_contacts_bounces_and_pushes():
    """Two touches within a second are one contact; each push lasts until the bumper is free."""
    free, dent = 1.0 - safety_study.RADIUS - 0.05, 1.0 - safety_study.RADIUS + 0.001
    places = [*[free] * 50, *[dent] * 30, *[free] * 40, *[dent] * 20, *[free] * 200, *[dent] * 10]
    found = safety_study.contacts(_record(np.array(places), 0.1), parse_world(WALL, 'a'))
    assert [each.begin for each in found] == [0.5, 3.4]
    assert [each.pushing for each in found] == [0.3, 0.1]
    assert found[0].speed == pytest.approx(0.1, rel=1e-6)
    assert len(safety_study.at_places(found)) == 1
    assert safety_study.contacts(_record(np.full(100, free), 0.1), parse_world(WALL, 'a')) == []


def test_one_who_walks_into_a_standing_robot_is_not_touched():
    text = f'moving: [{{radius: 0.1, points: [[1, 0], [0, 0]], speed: 0.3, start: {START}}}]'
    (found,) = safety_study.contacts(_record(np.zeros(400), 0.0), parse_world(text, 'a'))
    assert found.begin == pytest.approx((1.0 - safety_study.RADIUS - 0.1) / 0.3, abs=0.02)
    assert found.speed == 0.0


def test_visitors_come_where_their_rule_says():
    state = State(0, Pose(0.3, -0.2, 0.5), BodyTwist(0.3, 0.0))
    people = safety_study.People(3)
    person = people(20.0, state)
    assert people(20.01, state) is None
    assert people(40.0, state._replace(twist=BodyTwist(0.0, 0.0))) is None
    walk = math.dist(*person.points.tolist())
    ahead = math.dist(person.points[1], state.pose[:2]) - 0.3 * walk / person.speed
    assert ahead - safety_study.RADIUS - person.radius == pytest.approx(0.15)
    placed = [
        safety_study.PlacedThings(seed)(time, state) for seed in range(20) for time in (12.0, 16.0)
    ]
    there = [each for each in placed if each is not None]
    assert len(there) > 30
    for each in there:
        gap = math.dist(each.points[0], state.pose[:2]) - safety_study.RADIUS - each.radius
        assert gap > 0.24


def test_faults_of_sensors_change_what_arrives():
    def arrived(kind):
        faulty = FaultyRanges((SensorFault(2, kind, 1.0, 2.0),))
        times = [0.9, 1.1, 1.3, 1.5, 2.1]
        return [
            [(reading, stamp / 1e9) for reading, stamp in faulty.received(2, t, round(1e9 * t))]
            for t in times
        ]

    plain = [[(t, t)] for t in (0.9, 1.1, 1.3, 1.5, 2.1)]
    assert arrived('silent') == [plain[0], [], [], [], plain[-1]]
    assert arrived('frozen')[1:4] == [[(0.9, t)] for t in (1.1, 1.3, 1.5)]
    assert arrived('blind')[1:4] == [[(math.inf, t)] for t in (1.1, 1.3, 1.5)]
    assert arrived('repeated')[1:4] == [[(t, 0.9)] for t in (1.1, 1.3, 1.5)]
    assert arrived('late')[1:4] == [[(t, pytest.approx(t - 0.5))] for t in (1.1, 1.3, 1.5)]
    assert arrived('disordered')[1:4] == [[], [(1.3, 1.3), (1.1, 1.1)], []]
    assert arrived('negative')[1][0][0] < 0.0
    assert FaultyRanges((SensorFault(1, 'silent', 0.0),)).received(2, 0.3, 5) == [(0.3, 5)]


@pytest.mark.slow
@pytest.mark.parametrize('planned', [False, True])
def test_a_robot_whose_sensors_fail_rests_within_half_a_second(planned):
    """It drove 9.4 m after the last reading, with diagnostics that said OK."""
    row = safety_study.measured_safety((('sensors silent', 9.0, planned), 11))
    assert row['rest'] < 0.5
    assert row['after'] < 0.12
    assert row['driven'] > 0.1
    assert row['ended'] == 'too few range sensors work to drive on'
    counts = {'controller': 'sensors silent', 'contacts': 2, 'contacts_seen': 0, 'places': 3}
    table = safety_study.safety_table(ResultTable([{**row, **counts}]))
    cells = dict(zip(table.head, table.rows[0], strict=True))
    assert cells['rest after the fault, s'] == f'{row["rest"]:.2f}'
    names = 'runs with contact', 'with what was seen', 'places touched'
    assert [cells[name] for name in names] == ['1', '0', '3']


def test_a_run_that_ends_before_the_sensors_fail_is_refused():
    with pytest.raises(ValueError, match=r'at least 40 s \(0\.67 min\).* got 6 s'):
        safety_study.compare_safety([1], 6.0)


@pytest.mark.parametrize('ahead', [0.5, -0.1, -0.4])
def test_only_what_a_beam_had_met_was_seen(ahead):
    """Two beams look ahead, 0.1 m apart: who comes from beside them is met by the bumper."""
    text = f'moving: [{{radius: 0.1, points: [[1, {ahead}], [0.16, {ahead / 4}]], speed: 0.3}}]'
    (found,) = safety_study.contacts(_record(np.zeros(500), 0.0), parse_world(text, 'a'))
    assert found.seen == (abs(ahead) < 0.2)
    wall = safety_study.contacts(_record(np.full(9, 1.0), 0.0), parse_world(WALL, 'a'))
    assert [each.seen for each in wall] == [True]
    hidden = 'circles: [{center: [1, 0], radius: 0.1, unseen: true}]'
    below = safety_study.contacts(_record(np.full(9, 1.0), 0.0), parse_world(hidden, 'a'))
    assert [each.seen for each in below] == [False]
