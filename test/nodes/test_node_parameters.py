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
"""ROS parameters of all nodes."""

from fnmatch import fnmatch
import math
from pathlib import Path

import pytest
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from support.ros_graph import record
import yaml

from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.registry import INTERFACES, NODES, node_class, parameter_class
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]

CONDITIONAL = {
    'publishes': ('/clock', '/tf', '/keep_out/map'),
    'subscribes': (
        *('/range/*', '/path', '/target_twist', '/keep_out/map', '/goal_pose'),
        '/map_changes/suspected',
    ),
    'services': ('/controller/save_map',),
}
"""Topics that a node has only with some parameters or libraries."""
FOR_PATHS = {'reference_generator': ('/odom',)}
"""Those of single nodes: the generator begins a path where the robot is."""
FROM_RCLPY = ('/rosout', '/parameter_events', '~/*parameter*', '~/get_type_description', '/clock')
"""Topics and services that rclpy adds to every node."""


@pytest.mark.parametrize('name', NODES)
def test_a_running_node_is_as_it_is_described(name, harness, tmp_path):
    """Its topics, services and parameters."""
    given = {'storage.uri': str(tmp_path / 'bag')} if name == 'recorder' else {}
    node = harness.add(node_class(name), **given)
    _check_interface(node, INTERFACES[name])
    rows = parameter_class(name).specs()
    assert rows
    for row in rows:
        _check_description(node.describe_parameter(row.name), row)
        value = node.get_parameter(row.name).value
        if row.name not in given:
            assert (tuple(value) if row.many else value) == row.default, row.name


def _check_interface(node, interface):
    own = node.get_name(), node.get_namespace()
    found = {
        'subscribes': node.get_subscriber_names_and_types_by_node(*own),
        'publishes': node.get_publisher_names_and_types_by_node(*own),
        'services': node.get_service_names_and_types_by_node(*own),
    }

    def full_name(pattern):
        return pattern.replace('~', f'/{node.get_name()}') if pattern[0] in '~/' else f'/{pattern}'

    ignored = [full_name(pattern) for pattern in FROM_RCLPY]
    for kind, endpoints in found.items():
        patterns = [full_name(pattern) for pattern in getattr(interface, kind)]
        names = [topic for topic, _ in endpoints]
        for topic in names:
            assert any(fnmatch(topic, each) for each in (*patterns, *ignored)), f'{kind} {topic}'
        for pattern in patterns:
            conditional = (*CONDITIONAL[kind], *FOR_PATHS.get(node.get_name(), ()))
            wanted = pattern not in conditional and pattern != '/*'
            assert not wanted or any(fnmatch(topic, pattern) for topic in names), pattern


def _check_description(described, row):
    assert described.description.startswith(row.text)
    assert not row.unit or f'[{row.unit}]' in described.description, row.name
    assert described.additional_constraints == row.bounds_text()
    assert described.read_only == (not row.dynamic)
    if not row.many and (row.low is not None or row.high is not None):
        (limits,) = described.floating_point_range or described.integer_range
        assert row.low is None or limits.from_value == row.low, row.name
        assert row.high is None or limits.to_value == row.high, row.name


def test_only_dynamic_parameters_can_be_set(harness):
    node = harness.add(SimRobotNode)
    for row in parameter_class('sim_robot').specs():
        held = node.get_parameter(row.name)
        response = node.set_parameters([held])[0]
        assert response.successful == row.dynamic, row.name
        if not row.dynamic:
            assert row.name in response.reason
            assert 'read-only' in response.reason
            continue
        for edge in (row.low, row.high):
            if edge is None or row.kind is not float:
                continue
            outside = edge - 1.0 if edge == row.low else edge * 2.0
            response = node.set_parameters([Parameter(row.name, value=outside)])[0]
            assert not response.successful, row.name
            for word in (row.name, f'{edge}', f'{outside}'):
                assert word in response.reason
        if row.kind is float:
            response = node.set_parameters([Parameter(row.name, value=math.nan)])[0]
            assert not response.successful, row.name
            assert row.name in response.reason
        assert node.get_parameter(row.name).value == held.value


def test_an_unknown_parameter_is_named_with_the_nearest_one(harness):
    harness.add(SimRobotNode)
    wrong = Parameter('wheel.max_acelleration', value=5.0).to_parameter_msg()
    for service in (SetParameters, SetParametersAtomically):
        name = 'set_parameters' + ('_atomically' if service is SetParametersAtomically else '')
        response = harness.call(service, f'/sim_robot/{name}', parameters=[wrong])
        result = response.result if service is SetParametersAtomically else response.results[0]
        assert not result.successful
        assert result.reason == (
            'sim_robot has no parameter wheel.max_acelleration; '
            'did you mean wheel.max_acceleration?'
        )


def test_inconsistent_parameters_are_rejected_with_the_reason(harness):
    robot = harness.add(SimRobotNode)
    slow = Parameter('wheel.stop_deceleration', value=10.0)
    response = robot.set_parameters([slow])[0]
    assert not response.successful
    assert (
        'wheel.stop_deceleration must be at least wheel.max_acceleration (30 rad/s²): got 10'
        in response.reason
    )
    assert robot.parameters.limiter.stop_deceleration == 60.0
    both = [Parameter('wheel.max_acceleration', value=5.0), slow]
    response = robot.set_parameters_atomically(both)
    assert not response.successful
    assert 'within max_stopping_time, 0.5 s after the last command: got 1.25 s' in response.reason
    all_three = [*both, Parameter('wheel.max_velocity', value=2.0)]
    assert robot.set_parameters_atomically(all_three).successful, 'together they fit'
    assert robot.parameters.limiter.stop_deceleration == 10.0
    with pytest.raises(ParameterError, match='drive.kind must be stepper or velocity'):
        harness.add(SimRobotNode, namespace='other', drive__kind='torque')


def test_integers_and_empty_lists_are_accepted_at_start(harness, tmp_path):
    controller = harness.add(ControllerNode, ['-p', 'law.gain:=50', '-p', 'rate:=50'])
    assert (controller.parameters.law.gain, controller.get_parameter('rate').value) == (50.0, 50.0)
    assert record(harness, tmp_path).parameters.topics == ()


def test_an_unknown_parameter_is_rejected_with_a_suggestion(harness):
    with pytest.raises(ParameterError, match=r'no parameter law.gian; did you mean law.gain\?'):
        harness.add(ControllerNode, law__gian=5.0)
    with pytest.raises(ParameterError, match=r'no parameter publish_clock \(sim_robot has\)'):
        harness.add(ControllerNode, publish_clock=True)
    # A former one is accepted with its value.
    harness.add(SimRobotNode, boot_time=0.5)
    with pytest.raises(ParameterError, match='boot_time is no longer a parameter, .* 0.5: got 2'):
        harness.add(SimRobotNode, namespace='other', boot_time=2.0)


# -- files of config/ -----------------------------------------------------------------------------

CHANGED = {
    'controller': ('terms_rate', 12.5),
    'localizer': ('max_particles', 2000),
    'recorder': ('storage.chunk_size', 4096),
    'player': ('play.rate', 2.5),
    'radio_bridge': ('port', '/dev/other'),
    'reference_generator': ('seed', 77),
    'sim_robot': ('noise.variance', 0.0625),
}
"""One parameter of each node with a value that is not its default."""


@pytest.mark.parametrize('name', CHANGED)
def test_each_yaml_reaches_its_node_with_and_without_a_namespace(name, harness, tmp_path):
    """The key matches ``/controller`` and ``/robot_1/controller``.

    The file is loaded, then a copy with one value that differs from the default: a key that
    matches no node fails.
    """
    installed = ROOT / 'config' / f'{name}.yaml'
    parameter, value = CHANGED[name]
    assert parameter_class(name).from_dict({}).to_dict()[parameter] != value
    content = yaml.safe_load(installed.read_text())
    (entry,) = content.values()
    *parents, leaf = parameter.split('.')
    branch = entry['ros__parameters']
    for parent in parents:
        branch = branch.setdefault(parent, {})
    branch[leaf] = value
    changed = tmp_path / 'changed.yaml'
    changed.write_text(yaml.safe_dump(content))
    files = ['--params-file', str(installed), '--params-file', str(changed)]
    for namespace in ('/', '/robot_1') if name == 'controller' else ('/robot_1',):
        given = {'storage.uri': f'{tmp_path}/{namespace}/bag'} if name == 'recorder' else {}
        node = harness.add(node_class(name), files, namespace=namespace, **given)
        assert node.get_parameter(parameter).value == value


def test_every_yaml_is_tested():
    # The files of other robots: test_launch_files.py
    tested = set(CHANGED) | {'generic', 'paper_robot', 'turtlebot3'}
    assert {path.stem for path in (ROOT / 'config').glob('*.yaml')} == tested
