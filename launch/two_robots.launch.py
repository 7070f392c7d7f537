# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Launch two simulated robots: ``ros2 launch t3mpc_ros two_robots.launch.py``.

Each robot has a namespace, which prefixes its topics and frames. With ``use_sim_time`` the first
robot publishes the clock for all nodes. The robots do not collide with each other, only with the
walls of the world.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

ROBOTS = {
    'robot_1': {'seed': 1, 'initial_pose.x': -0.5, 'initial_pose.y': 0.0, 'initial_pose.yaw': 0.0},
    'robot_2': {'seed': 2, 'initial_pose.x': 0.5, 'initial_pose.y': 0.4, 'initial_pose.yaw': 3.0},
}


def generate_launch_description():
    share = Path(get_package_share_directory('t3mpc_ros'))
    # A text in any case: an empty value would have no type.
    world = ParameterValue(LaunchConfiguration('world'), value_type=str)
    use_sim_time = LaunchConfiguration('use_sim_time')
    nodes = []
    for name, robot in ROBOTS.items():
        clock = {'publish_clock': use_sim_time} if name == min(ROBOTS) else {}
        parameters = {
            'sim_robot': {
                'world': world,
                **robot,
                **clock,
            },
            'controller': {},
            'reference_generator': {'seed': robot['seed']},
        }
        nodes += [
            Node(
                package='t3mpc_ros',
                executable=executable,
                name=executable,
                namespace=name,
                output='screen',
                parameters=[
                    str(share / 'config' / f'{executable}.yaml'),
                    {'use_sim_time': use_sim_time, **values},
                ],
            )
            for executable, values in parameters.items()
        ]
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'world', default_value='room', description='world of both robots'
            ),
            DeclareLaunchArgument(
                'use_sim_time',
                default_value='false',
                description='the first robot publishes /clock',
            ),
            *nodes,
        ]
    )
