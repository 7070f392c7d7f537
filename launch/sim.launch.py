# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Launch the closed loop with the simulated robot: ``ros2 launch t3mpc_ros sim.launch.py``."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

NODES = ('sim_robot', 'controller', 'reference_generator')


def generate_launch_description():
    share = Path(get_package_share_directory('t3mpc_ros'))
    namespace = LaunchConfiguration('namespace')
    use_sim_time = {'use_sim_time': LaunchConfiguration('use_sim_time')}
    # The simulated robot is the source of the simulated time.
    clock = {'publish_clock': LaunchConfiguration('use_sim_time')}
    nodes = [
        Node(
            package='t3mpc_ros',
            executable=name,
            name=name,
            namespace=namespace,
            output='screen',
            parameters=[
                str(share / 'config' / f'{name}.yaml'),
                use_sim_time | (clock if name == 'sim_robot' else {}),
            ],
        )
        for name in NODES
    ]
    recorder = Node(
        package='t3mpc_ros',
        executable='recorder',
        name='recorder',
        namespace=namespace,
        output='screen',
        condition=IfCondition(LaunchConfiguration('record')),
        parameters=[str(share / 'config' / 'recorder.yaml'), use_sim_time],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'namespace', default_value='', description='namespace of all nodes'
            ),
            DeclareLaunchArgument(
                'use_sim_time',
                default_value='false',
                description='simulated time on /clock, from the simulated robot',
            ),
            DeclareLaunchArgument('record', default_value='true', description='record a bag'),
            *nodes,
            recorder,
        ]
    )
