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
"""Numbers of the localisation study, by records whose errors are known."""

from dataclasses import replace
import math
from pathlib import Path
import sys

import numpy as np
import pytest

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.patrol import localization_study
from t3mpc_ros.evaluation.patrol.localization_study import (
    CASES,
    LocalizationPlan,
    compare_localizations,
    localization_errors,
    lost_time,
    markdown,
    measured_localization,
)
from t3mpc_ros.evaluation.patrol.patrol_run import (
    PatrolScenario,
    portrait_points,
    run_patrol,
    world_file,
)
from t3mpc_ros.evaluation.run_record import RATE, Record

BENCH = Path(__file__).parents[2] / 'bench'


def make_record(offset, yaw=0.0, localized=True):
    """Return a record with position errors along x (m), shape (n,), and a constant yaw error."""
    count = len(offset)
    truth = np.zeros((count, 3))
    truth[:, 2] = math.pi - 0.01  # an error of yaw leads past half a turn
    pose = truth + np.column_stack([offset, np.zeros(count), np.full(count, yaw)])
    columns = {
        'time': np.arange(count) / RATE,
        'truth': truth,
        'pose': pose,
        'reference_pose': truth,
        'localized': np.full(count, localized),
        'contact_force': np.zeros(count),
    }
    return Record(columns)


def seconds(*pieces):
    """Return errors (m) that last for some seconds each."""
    return np.concatenate([np.full(round(duration * RATE), error) for error, duration in pieces])


def test_errors_are_those_before_the_robot_is_carried():
    record = make_record(seconds((0.01, 5), (0.02, 5), (1.0, 7), (0.01, 5)), yaw=0.02)
    row = localization_errors(record, carried_at=10.0)
    assert row['position'] == pytest.approx(math.sqrt(0.5 * (1e-4 + 4e-4)))
    assert row['largest'] == pytest.approx(0.02)
    assert row['yaw'] == pytest.approx(0.02)
    assert row['found'] == pytest.approx(7.0, abs=0.02)
    assert row['deceived'] == pytest.approx(7.0)
    assert row['on_path'] == 1.0


def test_a_robot_found_and_lost_again_is_found_at_last():
    record = make_record(seconds((0.0, 2), (1.0, 3), (0.0, 3), (1.0, 2), (0.0, 1)))
    assert localization_errors(record, 2.0)['found'] == pytest.approx(8.0, abs=0.02)
    record = make_record(seconds((0.0, 2), (1.0, 3)), localized=False)
    row = localization_errors(record, 2.0)
    assert row['found'] == math.inf
    assert row['deceived'] == 0.0


def test_without_carrying_nothing_is_found():
    assert math.isnan(localization_errors(make_record(seconds((0.0, 2))))['found'])


def test_lost_is_far_off_for_long():
    assert lost_time(seconds((0.0, 1), (0.4, 9), (0.1, 1), (0.4, 12), (0.0, 1))) == 12.0
    assert lost_time(seconds((0.4, 11))) == 11.0
    assert lost_time(np.zeros(10)) == 0.0


def test_the_table_has_medians_and_counts():
    plan = LocalizationPlan(duration=120.0, seeds=(1, 2))
    row = {'position': 0.01, 'yaw': 0.01, 'largest': 0.03, 'lost': 0.0, 'deceived': 0.0}
    rows = [
        {
            **row,
            'on_path': 0.5 * seed,
            'contacts': seed,
            'controller': name,
            'seed': seed,
            'found': 50.0 * seed,
        }
        for name in CASES
        for seed in plan.seeds
    ]
    lines = markdown(plan, ResultTable(rows)).splitlines()
    assert '2 min in room' in lines[0]
    assert '| on its path from minute 1 on, % |' in lines[2]  # the second half
    assert '| 10.0 (10.0) | 0.57 (0.57) | 30 (30) |' in lines[-1]
    assert '1 of 2' in lines[-1]
    assert lines[-1].endswith('| 75.0 (50.0) | 3 |')
    with pytest.raises(ValueError, match='duration must be at least 90 s'):
        LocalizationPlan(duration=60.0)


@pytest.mark.parametrize('planned', [False, True])
def test_each_seed_drives_each_case_as_planned(monkeypatch, planned):
    monkeypatch.setattr(localization_study, 'run_experiment', lambda runs, *_, **__: runs)
    plan = LocalizationPlan(duration=120.0, seeds=(1, 2), planned=planned)
    cases = [run.job[0] for run in compare_localizations(plan)]
    assert len(cases) == 2 * len(CASES)
    assert {(case.seed, case.duration) for case in cases} == {(1, 120.0), (2, 120.0)}
    assert {case.plan.enabled for case in cases} == {planned}


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize('seed', [104, 110])
def test_three_times_the_noise_does_not_lose_the_place(seed):
    """New particles near the pose had any yaw: it was turned by 10 degrees, and up to 2 m off."""
    case = replace(
        CASES['noise x 3, 20 % of the readings lost'], seed=seed, duration=36.0, known_world='room'
    )
    found = measured_localization((case, 'noise'))
    assert found['largest'] < 0.25
    assert found['lost'] == 0.0


@pytest.mark.slow
@pytest.mark.long
def test_the_filter_knows_what_the_odometry_does_not():
    """In two minutes the odometry is not far off yet: on one of three seeds by no more."""
    for seed in (3, 4):
        error = {}
        for name in ('odometry alone', 'particle filter'):
            case = CASES[name]
            changed = type(case)(
                seed=seed, duration=120.0, known_world='room', localization=case.localization
            )
            error[name] = measured_localization((changed, name))['position']
        assert error['particle filter'] < 0.02
        assert error['odometry alone'] > 1.5 * error['particle filter']


@pytest.mark.long
@pytest.mark.parametrize(('room', 'seed'), [('room', 2205), ('office', 1215)])
def test_a_thing_that_is_gone_does_not_make_a_patrol_lost(room, seed):
    """Where nothing else was in sight, the pose moved until the missing thing fitted: 1.6 m."""
    sys.path.insert(0, str(BENCH))
    try:
        from patrol_changes import ROOMS, Planted, map_text
    finally:
        sys.path.remove(str(BENCH))
    text, _ = map_text(Planted(room, 5))
    with world_file(text) as known, world_file(ROOMS[room]) as there:
        scenario = PatrolScenario(
            seed,
            60.0,
            known_world=known,
            world=there,
            map=known,
            localization='filter',
            plan=PlanParameters(enabled=True),
        )
        row = localization_errors(
            run_patrol(portrait_points(seed, PortraitParameters()), scenario)
        )
    assert row['lost'] == 0.0
    assert row['position'] < 0.12
