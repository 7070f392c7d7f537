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
"""Launch the closed loop with the simulated robot: ``ros2 launch t3mpc_ros sim.launch.py``."""

from t3mpc_ros.nodes.launch_files import (
    RECORD,
    ROBOT_DESCRIPTION,
    SEED,
    USE_SIM_TIME,
    argument,
    describe,
    params_file,
)
from t3mpc_ros.nodes.registry import CALIBRATED_GYRO


def nodes(launched):
    seed = launched.given('seed', int)
    # The simulated robot is the source of the simulated time.
    clock = {'publish_clock': launched.flag('use_sim_time')}
    loop = [
        *launched.robot('sim_robot', {**launched.given('world'), **seed}, defaults=clock),
        launched.node('controller', defaults=CALIBRATED_GYRO),
        launched.node('reference_generator', seed),
    ]
    return [*loop, launched.node('recorder')] if launched.flag('record') else loop


def generate_launch_description():
    world = argument('world', 'room, corridor, or a YAML file; empty: that of the parameter files')
    return describe(nodes, params_file(), ROBOT_DESCRIPTION, world, SEED, USE_SIM_TIME, RECORD)
