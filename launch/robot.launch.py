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
"""Launch the real robot: radio bridge, reference generator, controller and recorder.

``ros2 launch t3mpc_ros robot.launch.py port:=/dev/serial/by-id/... key_file:=~/.t3mpc_key``
"""

from t3mpc_ros.nodes.launch_files import (
    RECORD,
    ROBOT_DESCRIPTION,
    SEED,
    argument,
    describe,
    params_file,
)


def nodes(launched):
    loop = [
        *launched.robot('radio_bridge', {**launched.given('port'), **launched.given('key_file')}),
        # The radio link carries 50 commands and 50 measurements per second; a command is sent
        # one cycle after the measurement that it is computed from.
        launched.node('controller', defaults={'rate': 50.0, 'speed_filter.dead_time': 0.02}),
        launched.node('reference_generator', launched.given('seed', int), defaults={'rate': 50.0}),
    ]
    return [*loop, launched.node('recorder')] if launched.flag('record') else loop


def generate_launch_description():
    port = argument(
        'port',
        'serial port of the dongle, or a pattern of several; empty: that of the '
        'parameter files, /dev/t3mpc_dongle*',
    )
    key_file = argument(
        'key_file', 'key of the robot; empty: that of the parameter files, or no key'
    )
    return describe(nodes, params_file(), ROBOT_DESCRIPTION, port, key_file, SEED, RECORD)
