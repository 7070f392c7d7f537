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
"""No array that a script gets is one on which a run or a result goes on."""

from dataclasses import fields

import numpy as np
import pytest
from support import robot_bags

import t3mpc_ros as t3

SHORT = {'plant': 'servo', 'duration': 1.0}


def test_no_array_of_an_observation_can_be_written():
    """``error = observation.speeds; error -= ...`` once made the error 20 times larger."""
    seen = []

    def step(observation):
        seen.append(observation)
        return np.zeros(2)

    step.preview = True
    t3.simulate(step, plant='servo', duration=0.1)
    names = [each.name for each in fields(seen[0])]
    arrays = [name for name in names if isinstance(getattr(seen[0], name), np.ndarray)]
    assert {'speeds', 'reference', 'future'} <= {*arrays}
    for name in arrays:
        with pytest.raises(ValueError, match='read-only'):
            getattr(seen[0], name)[...] = 0.0


def test_an_observation_that_is_kept_does_not_change():
    kept, shown = [], []

    def step(observation):
        kept.append(observation)
        shown.append(observation.speeds.copy())
        return np.array([3.0 * np.sin(0.05 * len(kept)), 1.0])

    t3.simulate(step, **SHORT)
    assert np.ptp(shown, axis=0).min() > 0.1
    np.testing.assert_array_equal([each.speeds for each in kept], shown)


def test_what_the_limits_let_through_cannot_be_written():
    class Follows:
        def step(self, observation):
            return np.zeros(2)

        def applied(self, acceleration, *, limited):
            acceleration *= 0.0

    with pytest.raises(ValueError, match='read-only'):
        t3.simulate(Follows, **SHORT)


@pytest.mark.parametrize('which', [1, 2])
def test_a_plant_cannot_write_into_state_or_command(which):
    def plant(*given):
        given[which][0] += 1.0
        return (given[2] - given[1]) / 0.02

    with pytest.raises(t3.ScriptError, match='read-only'):
        t3.OdePlant(plant)


def test_the_state_is_not_what_a_plant_returns():
    slope = np.zeros(2)

    def plant(time, state, command):
        slope[:] = (command - state) / 0.02
        return slope

    def fresh(time, state, command):
        return (command - state) / 0.02

    runs = [
        t3.simulate('feed-forward', plant=t3.OdePlant(each), noise=0.0, duration=1.0)
        for each in (plant, fresh)
    ]
    np.testing.assert_array_equal(*(run['speed_right'] for run in runs))


def test_a_noise_law_cannot_change_the_true_speeds():
    def draws(generator, time, speeds):
        speeds *= 0.5
        return np.zeros(2)

    with pytest.raises(t3.ScriptError, match='read-only'):
        t3.simulate('feed-forward', plant='servo', duration=1.0, noise=t3.NoiseLaw(draws, 0.04))


def test_columns_of_a_result_cannot_be_written(tmp_path):
    run = t3.simulate('feed-forward', **SHORT)
    bag = t3.read_bag(robot_bags.write(tmp_path / 'bag', robot_bags.following_rows()))
    odometry = bag['/odom'] if '/odom' in bag else bag[next(iter(bag))]
    solution = t3.chaos(tspan=(0.0, 1.0))
    arrays = [*run.columns.values(), *run.record.columns.values(), *odometry.values()]
    for values in (*arrays, solution.t, solution.y):
        with pytest.raises(ValueError, match='read-only'):
            values[...] = values[0]


def test_results_that_are_made_anew_belong_to_the_script():
    run = t3.simulate('feed-forward', **SHORT)
    before = run.rmse(after=0.5)
    run.error[:] = 0.0
    system = t3.fuzzy('x')
    first = system.basis([0.5])
    first[:] = 0.0
    assert run.rmse(after=0.5) == before
    assert system.basis([0.5]).sum() == pytest.approx(1.0)
