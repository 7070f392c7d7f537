# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Launch the real robot: radio bridge, reference generator, controller and recorder.

``ros2 launch t3mpc_ros robot.launch.py port:=/dev/serial/by-id/... key_file:=~/.t3mpc_key``
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description():
    share = Path(get_package_share_directory('t3mpc_ros'))

    def text(name):
        return ParameterValue(LaunchConfiguration(name), value_type=str)

    def node(name, parameters, condition=None):
        return Node(
            package='t3mpc_ros',
            executable=name,
            name=name,
            output='screen',
            condition=condition,
            parameters=[str(share / 'config' / f'{name}.yaml'), parameters],
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'port',
                default_value='/dev/t3mpc_dongle*',
                description='serial port of the dongle, or a pattern of several',
            ),
            DeclareLaunchArgument(
                'key_file', default_value='', description='key of the robot; empty: no key'
            ),
            DeclareLaunchArgument('record', default_value='true', description='record a bag'),
            node('radio_bridge', {'port': text('port'), 'key_file': text('key_file')}),
            # The radio link carries 50 commands and 50 measurements per second; a command is sent
            # one cycle after the measurement that it is computed from.
            node('controller', {'rate': 50.0, 'speed_filter.dead_time': 0.02}),
            node('reference_generator', {'rate': 50.0}),
            node('recorder', {}, IfCondition(LaunchConfiguration('record'))),
        ]
    )
