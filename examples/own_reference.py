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
"""References of one's own: a CSV file, a function of time, and way points."""

import math
from pathlib import Path

import t3mpc_ros as t3


def wave(time):
    """Return the speeds of the right and the left wheel (rad/s) at a time (s)."""
    return 4.0 + 2.0 * math.sin(time), 4.0 + 2.0 * math.sin(1.3 * time)


def write_csv(path, duration):
    """Write a figure of eight at 0.15 m/s: columns time (s), linear (m/s), angular (rad/s)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ['time,linear,angular']
    for k in range(int(10 * duration) + 1):
        lines.append(f'{k / 10:.1f},0.15,{0.8 * math.sin(0.5 * k / 10):.6f}')
    path.write_text('\n'.join(lines) + '\n')
    return path


def main(folder=Path('runs/examples'), duration=20.0):
    """Track each of them with the full controller on the digital twin."""
    corners = [(0.0, 0.0), (1.0, 0.0), (1.4, 0.6), (0.4, 1.0), (0.0, 0.0)]
    references = {
        'csv': write_csv(folder / 'reference.csv', duration),
        'function': wave,
        'way points': t3.Waypoints(corners, speed=0.2),
    }
    runs = {}
    for name, reference in references.items():
        runs[name] = t3.simulate('full', reference=reference, duration=duration)
        print(f'{name}: RMSE {runs[name].rmse():.4f} rad/s')
    runs['way points'].plot(folder / 'own_reference.png')
    return runs


if __name__ == '__main__':
    main()
