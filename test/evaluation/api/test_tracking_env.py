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
"""The environment of Gymnasium is the loop of every other run, with a policy as its controller."""

import importlib
import inspect
import runpy
import sys
import warnings

import numpy as np
import pytest
from support.checkout import ROOT

import t3mpc_ros as t3

gymnasium = pytest.importorskip('gymnasium')

from gymnasium.utils.env_checker import check_env  # noqa: E402

from t3mpc_ros.gym import (  # noqa: E402
    ACCELERATION,
    SIZE,
    TrackingEnv,
    vector_of,
)

NAME = 't3mpc_ros.gym:t3mpc_ros/Tracking-v0'
SHORT = {'plant': 'servo', 'duration': 4.0}
LOSSES = t3.LinkFaults(odometry_loss=0.2, odometry_repeated=2, odometry_swapped=9)


class Proportional:
    """A controller and a policy: feed-forward of the slope, and feedback."""

    preview = True

    def action(self, seen):
        return 0.16 * 10.0 * seen[8:10] * 10.0 / 6.0 - 0.4 * seen[0:2]

    def step(self, observation):
        asked = self.action(vector_of(observation)).astype(np.float32).astype(np.float64)
        return ACCELERATION * np.clip(asked, -1.0, 1.0)


def driven(env, seed, policy=None):
    """Return observations, rewards and the last info of an episode."""
    policy = policy or Proportional()
    seen, info = env.reset(seed=seed)
    assert info == {'seed': seed}
    found, rewards, ended = [seen], [], False
    while not ended:
        action = policy.action(seen).astype(np.float32)
        seen, reward, terminated, truncated, info = env.step(action)
        found.append(seen)
        rewards.append(reward)
        ended = terminated or truncated
    return np.array(found), np.array(rewards), info


def test_the_checker_of_gymnasium_has_nothing_to_say():
    with warnings.catch_warnings(action='error'):
        check_env(gymnasium.make(NAME, **SHORT).unwrapped, skip_render_check=True)


@pytest.mark.parametrize('plant, faults', [('twin', LOSSES), ('twin', None), ('torque', None)])
def test_an_episode_is_the_run_of_the_same_controller(plant, faults):
    """To the last bit: what is learnt here is what the tables measure."""
    env = TrackingEnv(plant, faults=faults, duration=4.0)
    seen, rewards, info = driven(env, seed=7)
    run = t3.simulate(Proportional, plant=plant, faults=faults, seed=7, duration=4.0)
    assert info['metrics'] == dict(run.metrics)
    assert seen.shape[1] == SIZE
    assert np.all(rewards < 0.0)
    if faults is None:  # each period has a step, and the reward is the error of the next one
        steps = len(rewards)
        error = run.error[-steps:][1:] if plant != 'twin' else run.error[-steps + 1 :]
        plain = -np.sum(error**2, axis=1)
        assert np.all(rewards[: len(plain)] <= plain + 1e-9)
        assert np.mean(plain - rewards[: len(plain)]) < 0.01


class Watched(gymnasium.Wrapper):
    def step(self, action):
        *found, self.info = self.env.step(action)
        return *found, self.info


def test_the_policy_of_the_example_is_the_controller_it_trains():
    """It rounded its actions to float32 for the environment alone: 0.2256281296(7150|5436)."""
    example = runpy.run_path(str(ROOT / 'examples' / 'policy.py'))
    env, weights = Watched(gymnasium.make(NAME, **SHORT)), [-0.37, 5.3, 0.1, 0.2]
    example['episode'](env, weights, 7)
    run = t3.simulate(example['Policy'](weights), seed=7, **SHORT)
    assert env.info['metrics'] == dict(run.metrics)


def test_a_policy_sees_what_the_page_says():
    future = np.arange(82.0).reshape(41, 2)
    pairs = [np.array(pair) for pair in ((9.0, 8.0), (30.0, 60.0), (1.0, 3.0), (5.0, -10.0))]
    speeds, unexplained, reference, command = pairs
    observation = t3.Observation(
        speeds, unexplained, reference, reference, command, future, yaw_rate=4.0
    )
    ahead = np.concatenate([future[k] - reference for k in (1, 5, 10, 20, 40)]) / 10.0
    wanted = [8.0, 5.0, 0.1, 0.3, 0.5, -1.0, 0.5, 1.0, *ahead, 0.5]
    assert vector_of(observation) == pytest.approx(wanted)
    assert inspect.getdoc(t3.Observation).count('shape (2,)') == 5, 'help() says what they are'


def test_equal_seeds_are_equal_episodes_and_other_ones_differ():
    env, other = (TrackingEnv('servo', duration=2.0) for _ in range(2))
    for seed in (0, 100_000):
        first, again = driven(env, seed), driven(other, seed)
        assert np.array_equal(first[0], again[0])
        assert np.array_equal(first[1], again[1])
    assert not np.array_equal(driven(env, 0)[1], first[1])
    # Without a seed the run's own follows from that of the environment.
    seeds = []
    for each in (env, other):
        each.reset(seed=3)
        seeds.append([each.reset()[1]['seed'] for _ in range(3)])
    assert seeds[0] == seeds[1]
    assert len({*seeds[0]}) == 3
    assert min(seeds[0]) >= 100_000


def test_wrong_use_of_an_episode_is_one_sentence():
    env = TrackingEnv('servo', duration=0.5)
    for _ in range(2):
        with pytest.raises(t3.ScriptError, match='must begin with reset'):
            env.step(np.zeros(2))
        driven(env, 1)
    env.reset(seed=1)
    for action in (np.array([np.nan, 0.0]), np.zeros(3)):
        with pytest.raises(t3.ScriptError, match='action must be two finite numbers: got'):
            env.step(action)
    assert np.isfinite(env.step(np.array([5.0, -5.0]))[0]).all(), 'an action is clipped'


def test_a_robot_that_diverges_ends_the_episode():
    unstable = t3.OdePlant(lambda time, state, command: 50.0 * state * np.abs(state) + command)
    env = TrackingEnv(unstable, duration=4.0)
    env.reset(seed=1)
    for _ in range(500):
        seen, reward, terminated, truncated, _ = env.step(np.ones(2))
        if terminated or truncated:
            break
    assert terminated
    assert reward < -50.0
    assert env.observation_space.contains(seen)


def test_wrong_use_is_an_error_when_it_is_made():
    with pytest.raises(t3.ScriptError, match='plant must be'):
        TrackingEnv('no robot')
    with pytest.raises(t3.ScriptError, match='a policy needs preview'):
        t3.simulate(lambda observation: np.zeros(2) * vector_of(observation)[0], **SHORT)


def test_a_missing_gymnasium_is_named_with_its_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, 't3mpc_ros.gym', raising=False)
    monkeypatch.setitem(sys.modules, 'gymnasium', None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install .*with its extra \[gym\]'):
        importlib.import_module('t3mpc_ros.gym')
