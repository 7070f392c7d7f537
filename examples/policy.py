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
"""A policy that is trained in the environment of Gymnasium, in a table against our controllers."""

import numpy as np

import t3mpc_ros as t3
from t3mpc_ros.gym import TrackingEnv, accelerations_of, vector_of


class Policy:
    """A linear policy: one weight each for error, slopes of the reference and disturbance."""

    preview = True

    def __init__(self, weights):
        self.weights = np.asarray(weights, dtype=float)

    def action(self, seen):
        """Return the action for what is seen, shape (2,)."""
        error, unexplained = seen[0:2], seen[6:8]
        change, later = seen[8:10], seen[10:12]
        return np.column_stack([error, change, later, unexplained]) @ self.weights

    def step(self, observation):
        """Return the accelerations of the wheels, rad/s²: it is a controller, too."""
        return accelerations_of(self.action(vector_of(observation)))


def episode(env, weights, seed):
    """Return the mean reward of an episode."""
    policy, rewards = Policy(weights), []
    seen, _ = env.reset(seed=seed)
    ended = False
    while not ended:
        seen, reward, terminated, truncated, _ = env.step(policy.action(seen))
        rewards.append(reward)
        ended = terminated or truncated
    return float(np.mean(rewards))


def train(env, generations, seed=1):
    """Return weights after an evolution strategy: the mean of the best quarter, smaller steps."""
    random = np.random.default_rng(seed)
    mean, width = np.array([-0.3, 5.0, 0.0, 0.0]), np.array([0.3, 5.0, 1.0, 0.5])
    for k in range(generations):
        tried = mean + width * random.normal(size=(8, len(mean)))
        tried[0] = mean
        rewards = [episode(env, weights, 100_000 + k) for weights in tried]
        best = tried[np.argsort(rewards)[-2:]]
        mean, width = best.mean(axis=0), 0.7 * width
        print(f'generation {k + 1}: reward {max(rewards):.4f}, weights {mean.round(3).tolist()}')
    return mean


def main(duration=20.0, generations=10, episodes=8.0, executor=None):
    """Train on the paper's plant, and compare on seeds that no training has seen."""
    env = TrackingEnv('servo', duration=episodes)
    weights = train(env, generations)
    table = t3.compare(
        ['PI + feed-forward', t3.Controller(Policy(weights), name='policy'), 'feed-forward'],
        plant='servo',
        seeds=range(1, 4),
        duration=duration,
        executor=executor,
    )
    print(table)
    return table


if __name__ == '__main__':
    main()
