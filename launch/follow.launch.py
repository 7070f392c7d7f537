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
"""Let a differential-drive robot that runs already follow a reference.

``ros2 launch t3mpc_ros follow.launch.py params_file:=turtlebot3.yaml``; the robot subscribes to
``cmd_vel`` (Twist or TwistStamped) and publishes ``odom``. See docs/your_robot.md.
"""

from t3mpc_ros.nodes.launch_files import (
    RECORD,
    SEED,
    USE_SIM_TIME,
    argument,
    describe,
    flag,
    params_file,
)


def nodes(launched):
    rate = launched.given('rate', float)
    remappings = [(name, launched.text(f'{name}_topic')) for name in ('odom', 'cmd_vel')]
    made = [launched.node('controller', rate, remappings=remappings)]
    if launched.flag('generate_reference'):
        seed = launched.given('seed', int)
        made.append(launched.node('reference_generator', {**rate, **seed}))
    if launched.flag('record'):
        made.append(launched.node('recorder', remappings=remappings))
    return made


def generate_launch_description():
    return describe(
        nodes,
        params_file('generic.yaml'),
        argument('odom_topic', 'odometry of the robot', 'odom'),
        argument('cmd_vel_topic', 'velocity commands of the robot', 'cmd_vel'),
        argument('rate', 'rate of the odometry, Hz; empty: that of params_file'),
        flag(
            'generate_reference',
            'start the reference generator; false: another node publishes reference',
            'true',
        ),
        SEED,
        USE_SIM_TIME,
        RECORD,
    )
