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
"""A plant of one's own as an ordinary differential equation, and a linear one in state space."""

from pathlib import Path

import numpy as np

import t3mpc_ros as t3

LAG, STIFFNESS, DAMPING = 0.02, 900.0, 12.0  # s, 1/s², 1/s


def flexible_shafts(time, state, command):
    """Return the derivative of (wheels, wheel accelerations, motors) at commanded speeds."""
    wheels, rates, motors = state[:2], state[2:4], state[4:]
    spring = STIFFNESS * (motors - wheels) - DAMPING * rates - 3.0 * np.tanh(wheels / 0.2)
    return np.concatenate([rates, spring, (command - motors) / LAG])


def main(folder=Path('runs/examples'), duration=20.0):
    """Run two methods on a plant with flexible shafts, and on its rigid approximation."""
    folder.mkdir(parents=True, exist_ok=True)
    lag = np.eye(2) / LAG
    plants = {
        'flexible': t3.OdePlant(flexible_shafts, states=6),
        'rigid': t3.StateSpace(A=-lag, B=lag, C=np.eye(2)),
    }
    runs = {}
    for name, plant in plants.items():
        for method in ('PI + feed-forward', 'full'):
            run = t3.simulate(method, plant=plant, duration=duration)
            runs[name, method] = run
            print(f'{name}, {method}: RMSE {run.rmse():.4f} rad/s')
    runs['flexible', 'full'].plot(folder / 'own_plant.png')
    return runs


if __name__ == '__main__':
    main()
