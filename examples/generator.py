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
"""The chaotic generator alone: the attractor of (85), and how fast two neighbours separate."""

from pathlib import Path

import numpy as np

import t3mpc_ros as t3


def main(folder=Path('runs/examples'), duration=20.0):
    """Draw the attractor, and print the distance of two solutions that begin almost alike."""
    folder.mkdir(parents=True, exist_ok=True)
    solution = t3.chaos(alpha=0.98, tspan=(0.0, duration), dt=0.001, every=2)
    solution.plot(folder / 'generator.png', plane=True)
    solution.to_csv(folder / 'generator.csv')
    start = np.array([1.0, 1.0, 1.0, 1.0])
    pair = [t3.chaos(alpha=0.98, tspan=(0.0, 2.0), y0=start + change) for change in (0.0, 1e-9)]
    distance = np.linalg.norm(pair[1].y - pair[0].y, axis=1)
    for time in (0.0, 0.5, 1.0, 2.0):
        print(f'{time:g} s: {np.interp(time, pair[0].t, distance):.2g}')
    return solution, distance


if __name__ == '__main__':
    main()
