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
"""Measures how much faster than real time the simulated robots are, without ROS.

    PYTHONPATH=. .venv/bin/python bench/simulation_speed.py

It prints the figures of docs/simulation.md: the twin on the plain and in ``room``, and the paper's
plant, a minute of driving each, the median of five. The time is that of the processor, which other
programs change little.
"""

from statistics import median
import time

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters, make_robot

ROBOTS = {
    'plain': {},
    'room': {'world': 'room'},
    "paper's plant": {'drive.kind': 'velocity'},
}
SECONDS, RUNS = 60, 5


def speed(values: dict[str, object]) -> float:
    """Return simulated time per processor time of one run."""
    robot = make_robot(DigitalTwinParameters.from_dict(values))
    robot.advance(0)
    begin = time.process_time()
    for period in range(100 * SECONDS):
        way = 1.0 if period // 200 % 2 else -1.0
        robot.step(WheelSpeeds(right=way * 3.0, left=way * 2.5))
    return SECONDS / (time.process_time() - begin)


def main() -> None:
    """Print the median of each robot."""
    for name, values in ROBOTS.items():
        speed(values)  # compiles
        print(f'{name}: {median(speed(values) for _ in range(RUNS)):.0f} times real time')


if __name__ == '__main__':
    main()
