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
"""Patrol of the simulated robot: ``ros2 launch t3mpc_ros patrol.launch.py``.

With ``robot:=false`` only generator, controller and recorder start, for a robot that runs already
and publishes ``odom`` and ``range/*``. See docs/patrol.md.
"""

from t3mpc_ros.nodes.launch_files import (
    RECORD,
    USE_SIM_TIME,
    argument,
    describe,
    flag,
    params_file,
)
from t3mpc_ros.nodes.registry import CALIBRATED_GYRO


def nodes(launched):
    seed = launched.given('seed', int)
    known = launched.text('known_world')
    known = {'keep_out.world': known} if known else {}
    # With a given place, the pose of both nodes is that of the simulator.
    place = [('odom', 'ground_truth/odom')] if launched.flag('localised') else []
    # The pose on the map takes the place of odom, for recorder, replay and report, too.
    localized = launched.flag('localizer')
    raw = [('odom', 'odom/raw')] if localized else []
    path = {'pose.enabled': True, 'keep_out.enabled': True}
    if launched.flag('robot'):
        path |= CALIBRATED_GYRO
    # Seed 0 of a portrait is a secret one.
    # A planned path does not leave the robot behind: it need not be slower than the way back.
    fast = {'motion.linear.x.max_velocity': 0.33, 'motion.wheel.max_velocity': 10.0}
    source = {'source': 'portrait', 'seed': 0, 'plan.enabled': True, **fast}
    if localized:
        source['frame_id'] = 'map'  # as odom then is: goals and what is suspected are of the map
    made = [
        launched.node('controller', known, defaults=path, remappings=place),
        launched.node('reference_generator', seed, defaults=source, remappings=place),
    ]
    if launched.flag('robot'):
        robot = {
            'world': 'room',
            'noise.variance': 0.04,
            'publish_clock': launched.flag('use_sim_time'),
        }
        given = {**launched.given('world'), **seed}
        made.insert(0, launched.node('sim_robot', given, defaults=robot, remappings=raw))
    if localized:
        world = launched.text('known_world') or launched.text('world')
        start = {'world': world or 'room', 'set_initial_pose': True}
        filtered = ('odometry/filtered', 'odom')
        made.append(launched.node('localizer', defaults=start, remappings=[*raw, filtered]))
    return [*made, launched.node('recorder')] if launched.flag('record') else made


def generate_launch_description():
    return describe(
        nodes,
        params_file(),
        argument(
            'world',
            'world of the simulated robot: room, corridor, or a YAML file; empty: '
            'that of params_file, else room',
        ),
        argument(
            'known_world', 'walls that the keep-out knows, as world; empty: none, it sees them'
        ),
        argument(
            'seed',
            'seed of an experiment that can be repeated; empty: that of params_file, '
            'else a secret one from the operating system',
        ),
        flag('localised', 'use the true pose of the simulator in place of the odometry'),
        flag(
            'localizer',
            'find the place on known_world, else on world, by the range sensors; the pose on the '
            'map is odom, the odometry of the robot odom/raw',
        ),
        flag('robot', 'start the simulated robot', 'true'),
        USE_SIM_TIME,
        RECORD,
    )
