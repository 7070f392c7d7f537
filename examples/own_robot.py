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
"""A robot of one's own by its geometry, lag and limits."""

from pathlib import Path

import t3mpc_ros as t3

# About a TurtleBot3 Burger: slow servos, and a dead time of three control periods.
ROBOT = t3.Robot(
    wheel_radius=0.033,
    wheel_separation=0.16,
    lag=0.1,
    dead_time=0.03,
    linear_velocity=0.22,
    angular_velocity=2.84,
)


def main(folder=Path('runs/examples'), duration=30.0, executor=None):
    """Compare three methods on it, tracking a path that it can drive."""
    folder.mkdir(parents=True, exist_ok=True)
    path = t3.Waypoints([(0.0, 0.0), (0.8, 0.2), (1.0, 1.0), (0.2, 0.8)], speed=0.15)
    table = t3.compare(
        ['full', 'PI + feed-forward', 'ADRC'],
        plant=ROBOT,
        reference=path,
        seeds=range(1, 6),
        duration=duration,
        executor=executor,
    )
    print(table)
    table.to_csv(folder / 'own_robot.csv')
    return table


if __name__ == '__main__':
    main()
