# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Command line of the node executables: help, version, rejection of unknown arguments."""

from fnmatch import fnmatch
import subprocess

import pytest

import t3mpc_ros
from t3mpc_ros.cli.process_group import executable
from t3mpc_ros.nodes.arguments import unknown_arguments, unmatched_files, user_arguments
from t3mpc_ros.nodes.composed import ComposedNode
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.player.node import PlayerNode
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.recorder.node import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.registry import INTERFACES, NODES, parameter_class
from t3mpc_ros.nodes.sim_robot import SimRobotNode

NODE_CLASSES = {
    'reference_generator': ReferenceGeneratorNode,
    'controller': ControllerNode,
    'sim_robot': SimRobotNode,
    'radio_bridge': RadioBridgeNode,
    'recorder': RecorderNode,
    'player': PlayerNode,
    'composed': ComposedNode,
}
CONDITIONAL = ('/clock', '/tf')
"""Topics that a node publishes only with some parameters or libraries."""
FROM_RCLPY = ('/rosout', '/parameter_events', '~/*parameter*', '~/get_type_description', '/clock')
"""Topics and services that rclpy adds to every node."""


def _run(name, *arguments):
    return subprocess.run(
        [executable(name), *arguments], capture_output=True, text=True, timeout=60
    )


def test_ros_arguments_end_at_a_double_dash():
    argv = ['node', 'a', '--ros-args', '-p', 'b:=1', '--', 'c', '--ros-args', '-r', 'd:=e']
    assert user_arguments(argv) == ['a', 'c']


@pytest.mark.parametrize(
    'node, words, expected',
    [
        ('controller', ['--gain', '30'], ['--gain 30', '-p law.gain:=']),
        ('controller', ['law.gain:=30'], ['law.gain:=30', '-p law.gain:=']),
        ('player', ['mybag'], ['mybag', '-p NAME:=VALUE']),
        ('sim_robot', ['--ros-args', '-p', 'rate:=50.0', '--', '-v'], ['argument -v:']),
    ],
)
def test_unknown_arguments_are_named(node, words, expected):
    problem = unknown_arguments(node, [node, *words])
    for text in expected:
        assert text in problem


@pytest.mark.parametrize(
    'content, node, matches',
    [
        ('controller: {ros__parameters: {rate: 50.0}}', '/controller', True),
        ('/**/controller: {ros__parameters: {rate: 50.0}}', '/controller', True),
        ('/**/controller: {ros__parameters: {rate: 50.0}}', '/a/robot_1/controller', True),
        ('/**: {ros__parameters: {rate: 50.0}}', '/robot_1/controller', True),
        ('/*/controller: {ros__parameters: {rate: 50.0}}', '/robot_1/controller', True),
        ('robot_1: {controller: {ros__parameters: {rate: 5.0}}}', '/robot_1/controller', True),
        ('sim_robot: {ros__parameters: {rate: 50.0}}', '/controller', True),
        ('controller: {ros__parameters: {rate: 50.0}}', '/robot_1/controller', False),
        ('contoller: {ros__parameters: {rate: 50.0}}', '/controller', False),
        ('controller: {rate: 50.0}', '/controller', False),
    ],
)
def test_a_parameter_file_without_effect_is_named(content, node, matches, tmp_path):
    """A key without the namespace of the node, or misspelt, was ignored."""
    file = tmp_path / 'own.yaml'
    file.write_text(content)
    problems = unmatched_files(['x', '--ros-args', '--params-file', str(file)], [node])
    assert [str(file) in problem and node in problem for problem in problems] == (
        [] if matches else [True]
    )


@pytest.mark.ros
@pytest.mark.parametrize(
    'name, words', [('controller', ['--gain', '30']), ('player', ['mybag']), ('composed', ['-x'])]
)
def test_unknown_arguments_end_the_process_with_code_2(name, words, graph):
    """The words were ignored and the node started."""
    done = _run(name, *words)
    assert done.returncode == 2
    assert done.stderr.startswith(f'{name}: unknown argument')
    assert done.stderr.count('\n') == 1


@pytest.mark.ros
@pytest.mark.parametrize('name', NODES)
def test_help_lists_topics_services_and_parameters(name, graph):
    """``--help`` started the node."""
    done = _run(name, '--help')
    assert (done.returncode, done.stderr) == (0, '')
    interface = INTERFACES[name]
    for word in (*interface.subscribes, *interface.publishes, *interface.services):
        assert word in done.stdout
    for spec in parameter_class(name).specs():
        assert f' {spec.name} = ' in done.stdout


@pytest.mark.parametrize('name', [*NODES, 't3mpc'])
def test_version_is_printed(name):
    done = _run(name, '--version')
    assert (done.returncode, done.stdout) == (0, f't3mpc_ros {t3mpc_ros.__version__}\n')


@pytest.mark.ros
@pytest.mark.parametrize('name', NODES)
def test_interfaces_describe_the_running_nodes(name, harness, tmp_path):
    given = {'storage.uri': str(tmp_path / 'bag')} if name == 'recorder' else {}
    node = harness.add(NODE_CLASSES[name], **given)
    own = node.get_name(), node.get_namespace()
    found = {
        'subscribes': node.get_subscriber_names_and_types_by_node(*own),
        'publishes': node.get_publisher_names_and_types_by_node(*own),
        'services': node.get_service_names_and_types_by_node(*own),
    }

    def full_name(pattern):
        return pattern.replace('~', f'/{node.get_name()}') if pattern[0] in '~/' else f'/{pattern}'

    for kind, endpoints in found.items():
        patterns = [full_name(pattern) for pattern in getattr(INTERFACES[name], kind)]
        ignored = [full_name(pattern) for pattern in FROM_RCLPY]
        names = [topic for topic, _ in endpoints]
        for topic in names:
            assert any(fnmatch(topic, each) for each in (*patterns, *ignored)), f'{kind} {topic}'
        for pattern in patterns:
            wanted = pattern not in CONDITIONAL and pattern != '/*'
            assert not wanted or any(fnmatch(topic, pattern) for topic in names), pattern
