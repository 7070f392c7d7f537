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
"""A plant as a robot: each step obeys the newest command that has arrived by then."""

import numpy as np
import pytest

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters
from t3mpc_ros.simulation.plant_robot import LinkDelay, PlantRobot

MS = 1_000_000
PERIOD = 10 * MS


class NotingPlant:
    """Notes the command of each step, and the configurations."""

    wheels = (0.0, 0.0)

    def __init__(self):
        self.commands, self.configured = [], []

    def configure(self, parameters):
        self.configured.append((len(self.commands), parameters))

    def run(self, command, count):
        self.commands += [command[0]] * count

    def measure(self, dt):
        return 0.0, 0.0


@pytest.mark.parametrize(
    'link, latency',
    [
        (LinkDelay(), 0),
        (LinkDelay(), 3 * MS),
        (LinkDelay(0.0, 0.02), 4 * MS),
        (LinkDelay(0.02, 0.1, 0.2, 0.3, 0.9), 9 * MS),
    ],
)
def test_each_step_obeys_the_newest_command_that_has_arrived(link, latency):
    """A clock that was thought to jump back once dropped all commands under way."""
    periods, plant = 120, NotingPlant()
    robot = PlantRobot(plant, PaperRobotParameters(), link=link, seed=3)
    generator, sent = np.random.default_rng((3, 4)), []
    for k in range(periods):
        state = robot.advance(k * PERIOD)
        now_ns = state.stamp_ns + latency
        robot.apply(RobotCommand(WheelSpeeds(k + 1.0, 0.0), state.stamp_ns), now_ns)
        lost, late = generator.random(2)
        faulty = link.begin * 1e9 <= now_ns < link.end * 1e9
        if not (faulty and lost < link.loss):
            sent.append((now_ns + faulty * 1e9 * (link.delay + late * link.jitter), k + 1.0))
    robot.advance(periods * PERIOD)
    expected = [
        max((command for arrival, command in sent if arrival <= step * MS + 1), default=0.0)
        for step in range(10 * periods)
    ]
    assert plant.commands == expected


def test_the_robot_changes_at_its_instant():
    plant, changed = NotingPlant(), PaperRobotParameters.from_dict({'mass_factor': 1.3})
    robot = PlantRobot(plant, PaperRobotParameters(), changed, 5 * PERIOD)
    for k in range(9):
        robot.advance(k * PERIOD)
    assert plant.configured == [(50, changed)]
