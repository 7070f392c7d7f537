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
"""Launch two simulated robots: ``ros2 launch t3mpc_ros two_robots.launch.py``.

Each robot has a namespace, which prefixes its topics and frames. With ``use_sim_time`` the first
robot publishes the clock for all nodes. The robots do not collide with each other, only with the
walls of the world.
"""

from t3mpc_ros.nodes.launch_files import (
    ROBOT_DESCRIPTION,
    SEED,
    USE_SIM_TIME,
    argument,
    describe,
    params_file,
)
from t3mpc_ros.nodes.registry import CALIBRATED_GYRO

ROBOTS = {
    'robot_1': {'initial_pose.x': -0.5, 'initial_pose.y': 0.0, 'initial_pose.yaw': 0.0},
    'robot_2': {'initial_pose.x': 0.5, 'initial_pose.y': 0.4, 'initial_pose.yaw': 3.0},
}


def nodes(launched):
    first_seed = launched.given('seed', int)
    made = []
    for number, (name, pose) in enumerate(ROBOTS.items()):
        clock = {'publish_clock': launched.flag('use_sim_time') and number == 0}
        defaults = {'seed': 1 + number}
        given = {key: seed + number for key, seed in first_seed.items()}
        made += [
            *launched.robot(
                'sim_robot',
                {**launched.given('world'), **given},
                defaults={'world': 'room', **defaults, **pose, **clock},
                namespace=name,
            ),
            launched.node('controller', defaults=CALIBRATED_GYRO, namespace=name),
            launched.node('reference_generator', given, defaults=defaults, namespace=name),
        ]
    return made


def generate_launch_description():
    world = argument(
        'world',
        'world of both robots: room, corridor, or a YAML file; empty: that of '
        'params_file, or room',
    )
    return describe(nodes, params_file(), ROBOT_DESCRIPTION, world, SEED, USE_SIM_TIME)
