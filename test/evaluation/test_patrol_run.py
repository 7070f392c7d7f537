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
"""Patrols of the twin: repeatable with a seed, within the limits, without contact."""

import numpy as np
import pytest

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.control.velocity_actuation import LimitParameters
from t3mpc_ros.evaluation.patrol import patrol_run
from t3mpc_ros.evaluation.run_record import RATE

PLANNED = PlanParameters(enabled=True)


def _run(seed, duration):
    with patrol_run.world_file(patrol_run.room_with_boxes(seed, (4.0, 3.0), 3)) as world:
        scenario = patrol_run.PatrolScenario(seed=seed, duration=duration, world=world)
        return patrol_run.run_patrol(
            patrol_run.portrait_points(seed, PortraitParameters()), scenario
        )


@pytest.mark.long
def test_a_patrol_with_a_seed_is_repeatable():
    """Every number is equal, bit for bit; another seed gives another path."""
    one, again, other = _run(5, 4.0), _run(5, 4.0), _run(6, 4.0)
    for name, column in one.columns.items():
        np.testing.assert_array_equal(column, again[name])
    assert not np.array_equal(one['reference_pose'], other['reference_pose'])


@pytest.mark.slow
def test_a_patrol_by_the_particle_filter_knows_its_place():
    """Own sensors only, known walls; later the robot is carried, and the pose is wrong at once."""
    scenario = patrol_run.PatrolScenario(
        seed=2, duration=6.1, known_world='room', localization='filter', carried_at=6.0
    )
    record = patrol_run.run_patrol(patrol_run.portrait_points(2, PortraitParameters()), scenario)
    error = np.hypot(*(record['pose'] - record['truth'])[:, :2].T)
    assert error[: round(5.9 * RATE)].max() < 0.05
    row = round(6.02 * RATE)
    assert error[row] == pytest.approx(1.0, abs=0.1)
    turned = record['truth'][row, 2] - record['pose'][row, 2]
    assert abs(np.cos(turned)) < 0.1


@pytest.mark.long
@pytest.mark.parametrize(('seed', 'boxes'), [(11, 3), (12, 5)])
def test_a_planned_patrol_is_on_its_path(seed, boxes):
    with patrol_run.world_file(patrol_run.room_with_boxes(seed, (4.0, 3.0), boxes)) as world:
        scenario = patrol_run.PatrolScenario(seed=seed, duration=300.0, world=world, plan=PLANNED)
        record = patrol_run.run_patrol(
            patrol_run.portrait_points(seed, PortraitParameters()), scenario
        )
    assert patrol_run.share_on_path(record) > 0.95
    assert patrol_run.contact_count(record) == 0
    steps = np.hypot(*np.diff(record['truth'][:, :2], axis=0).T)
    assert steps.sum() > 40.0


@pytest.mark.long
def test_a_patrol_is_charged_and_goes_on(tmp_path):
    """Once in three minutes with a battery of 50 mAh."""
    world, place = tmp_path / 'yard.yaml', (-1.2, 0.7)
    world.write_text(
        'walls: [{points: [[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]], closed: true}]\n'
        'boxes: [{center: [-0.5, 0.5], size: [0.3, 0.3]}]\n'
        f'chargers: [{{center: {list(place)}, radius: 0.06, current: 3.0}}]\n'
    )
    charging = {'place': place, 'min_voltage': 10.4, 'full_voltage': 12.4}
    values = {f'charging.{name}': value for name, value in charging.items()}
    scenario = patrol_run.PatrolScenario(
        seed=3,
        duration=180.0,
        world=str(world),
        plan=PlanParameters.from_dict({'enabled': True, **values}),
        robot={'battery.capacity': 0.05, 'battery.charge': 0.35},
    )
    record = patrol_run.run_patrol(patrol_run.portrait_points(3, PortraitParameters()), scenario)
    assert patrol_run.contact_count(record) == 0
    assert set(record.robot_reasons) == {''}, 'the battery was empty'
    there = np.hypot(*(record['truth'][:, :2] - place).T) < 0.06
    assert there.mean() > 0.1
    assert not there[-round(20.0 * RATE) :].any()


def test_an_unknown_localization_is_rejected():
    with pytest.raises(ValueError, match='localization must be one of given'):
        patrol_run.PatrolScenario(localization='gps')


@pytest.mark.slow
def test_a_patrol_keeps_limits_and_touches_nothing():
    """The robot looks around, drives off and reaches its path, with 10 % of commands lost."""
    record, limits = _run(3, 11.0), LimitParameters()
    assert patrol_run.contact_count(record) == 0
    largest = np.abs(record['command']).max(axis=0)
    sent = np.vstack([np.zeros(2), record['command']])  # the robot stands before
    change = np.abs(np.diff(sent, axis=0)) * RATE
    # A slippery patch leads to a stop, which is sudden.
    stopped = np.array([bool(reason) for reason in record.driver_reasons])
    change = change[~stopped].max(axis=0)
    assert stopped.mean() < 0.1
    assert (largest <= np.array([limits.linear, limits.angular]) + 1e-9).all()
    accelerations = np.array([limits.linear_acceleration, limits.angular_acceleration])
    assert (change <= accelerations * (1.0 + 1e-9)).all()
    assert np.hypot(*(record['truth'][-1] - record['truth'][0])[:2]) > 0.2
