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
"""Topics, parameters, services and e-stop without a ROS installation."""

from contextlib import closing
from itertools import islice

import pytest
from rclpy.node import Node
from std_srvs.srv import SetBool
import yaml

from t3mpc_ros.nodes import graph_client
from t3mpc_ros.nodes.graph_client import Graph, GraphError, message_text, rate_text
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.ros_messages import quaternion_from_yaw
from t3mpc_ros.nodes.sim_robot import SimRobotNode


class Asked:
    """Asks the graph in a thread while the harness spins its nodes."""

    def __init__(self, harness, graph):
        self._harness, self._graph = harness, graph

    def __call__(self, method, *arguments):
        return self._harness.in_thread(getattr(self._graph, method), *arguments)

    def messages(self, topic, count):
        found = filter(None, self._graph.messages(topic))
        return self._harness.in_thread(lambda: list(islice(found, count)))


@pytest.fixture
def asked(harness, monkeypatch):
    monkeypatch.setattr(graph_client, 'QUIET', 0.5)
    node = Node('asking')
    with closing(Graph(node)) as graph:
        yield Asked(harness, graph)
    node.destroy_node()


@pytest.fixture
def nothing_comes(monkeypatch):
    """Return a function after which a thing that is not there is not waited for long."""
    return lambda: monkeypatch.setattr(graph_client, 'DISCOVERY', 0.2)


@pytest.mark.ros
def test_topics_have_types_and_messages(asked, harness, nothing_comes):
    harness.add(SimRobotNode)
    assert asked('topics')['/odom'] == ['nav_msgs/msg/Odometry']
    first, second = asked.messages('odom', 2)
    # The numbers of its covariances are those of an array, which YAML refused.
    assert len(yaml.safe_load(message_text(first))['pose']['covariance']) == 36
    assert yaml.safe_load(message_text(first, 'header.frame_id')) == 'odom'
    assert second.header.stamp != first.header.stamp
    lines = asked('topic_text', 'odom').splitlines()
    assert lines[:2] == ['type: nav_msgs/msg/Odometry', 'publishers: 1']
    assert lines[2] == '  /sim_robot (nav_msgs/msg/Odometry; reliable, volatile)'
    assert asked('topic_text', '/cmd_vel').splitlines()[1:3] == [
        'publishers: 0',
        'subscriptions: 1',
    ]
    nothing_comes()
    with pytest.raises(GraphError, match='nothing publishes or receives /odam'):
        asked('topic_text', 'odam')
    with pytest.raises(GraphError, match='no messages of /odam: nothing publishes it'):
        asked.messages('odam', 1)


@pytest.mark.ros
def test_parameters_are_listed_read_and_set(asked, harness, nothing_comes):
    robot = harness.add(SimRobotNode)
    assert '/sim_robot' in asked('nodes')
    assert 'faults.command_loss' in asked('parameter_names', '/sim_robot')
    text = asked('parameter_text', '/sim_robot', 'drive.kind')
    assert text == f'String value is: {robot.parameters.drive.kind}'
    assert asked('set_parameter', '/sim_robot', 'faults.command_loss', 0.5) == ''
    described = asked('parameter_description', '/sim_robot', 'faults.command_loss').splitlines()
    assert described[0].startswith('faults.command_loss: ')
    words = ['type: float', 'value: 0.5', 'least: 0.0', 'largest: 1.0']
    assert [line.strip() for line in described[1:]] == [
        *words,
        'can be set while the node runs: yes',
    ]
    described = asked('parameter_description', '/sim_robot', 'drive.kind')
    assert 'one of: velocity, torque, stepper' in described
    assert described.endswith(': no')
    assert robot.parameters.faults.command_loss == 0.5
    assert 'read-only' in asked('set_parameter', '/sim_robot', 'drive.kind', 'velocity')
    with pytest.raises(GraphError, match='has no parameter no_such'):
        asked('parameter_text', '/sim_robot', 'no_such')
    nothing_comes()
    with pytest.raises(GraphError, match='no node offers the service /nobody/get_parameters'):
        asked('parameter_text', '/nobody', 'rate')


@pytest.mark.ros
def test_services_are_called_with_the_type_of_the_graph(asked, harness, nothing_comes):
    generator = harness.add(ReferenceGeneratorNode)
    assert asked('call_by_name', 'reference_generator/pause', {'data': True}).success
    assert generator.produce_diagnostics()[1] == 'paused'
    for name, values, words in (
        ('reference_generator/pause', {'on': True}, 'has no field on; its fields: data'),
        ('reference_generator/pause', {'data': 'yes'}, 'data of std_srvs/srv/SetBool: '),
    ):
        with pytest.raises(GraphError, match=words):
            asked('call_by_name', name, values)
    nothing_comes()
    with pytest.raises(GraphError, match='no node offers the service /pause'):
        asked('call_by_name', 'pause', {})


@pytest.mark.ros
def test_stop_stops_every_robot_whatever_its_namespace(asked, harness, monkeypatch):
    monkeypatch.setattr(graph_client, 'DISCOVERY', 0.5)
    assert asked('stop_robots') == {}
    robots = [harness.add(SimRobotNode, namespace=name) for name in (None, 'east', 'far/west')]

    def refuse(request, response):
        response.message = 'out of order'
        return response

    harness.probe.create_service(SetBool, 'broken/e_stop', refuse)
    harness.spin_until(lambda: len(asked('stop_robots')) == 4)
    problems = asked('stop_robots')
    assert problems == {
        '/e_stop': '',
        '/east/e_stop': '',
        '/far/west/e_stop': '',
        '/broken/e_stop': 'out of order',
    }
    for robot in robots:
        harness.spin_until(lambda each=robot: each._state.status.estop)


def test_messages_are_yaml_with_fields_in_their_order():
    message = quaternion_from_yaw(0.0)
    assert message_text(message) == 'x: 0.0\ny: 0.0\nz: 0.0\nw: 1.0\n'
    assert message_text(message, 'w') == '1.0\n'
    with pytest.raises(GraphError, match='no field v; its fields: x, y, z, w'):
        message_text(message, 'v')


def test_the_rate_is_that_of_the_arrivals():
    times = [0.01 * k + (0.001 if k % 2 else 0.0) for k in range(11)]
    assert rate_text(times[:1]) == ''
    assert rate_text(times) == (
        'average rate: 100.000\n\tmin: 0.009s max: 0.011s std dev: 0.00100s window: 11'
    )


@pytest.mark.ros
def test_a_robot_that_is_discovered_late_is_stopped(asked, harness, monkeypatch):
    """One of three was not asked, and not named: the list was made 1.5 s after the first."""
    monkeypatch.setattr(graph_client, 'QUIET', 0.8)
    monkeypatch.setattr(graph_client, 'REPLY', 0.2)
    first, late, e_stops = harness.add(SimRobotNode, namespace='first'), [], asked._graph._e_stops

    def with_late_ones():
        stopped = first._robot._limiter.estop
        if stopped and len(late) < 2:  # it is asked before others are there
            name = f'late_{len(late)}'
            late.append(Node(name, namespace=name))
            late[-1].create_service(SetBool, 'e_stop', lambda request, response: response)
        return e_stops()

    monkeypatch.setattr(asked._graph, '_e_stops', with_late_ones)
    problems = asked('stop_robots')
    assert sorted(problems) == ['/first/e_stop', '/late_0/e_stop', '/late_1/e_stop']
    assert problems['/first/e_stop'] == ''
    assert all('no answer' in problems[f'/late_{k}/e_stop'] for k in (0, 1))
    for node in late:
        node.destroy_node()


@pytest.mark.ros
def test_a_graph_without_nodes_is_no_empty_list(monkeypatch):
    """``topic list`` printed one topic of its own, with exit code 0."""
    monkeypatch.setattr(graph_client, 'DISCOVERY', 0.3)
    with graph_client.graph() as graph:
        for method in (graph.topics, graph.nodes):
            with pytest.raises(GraphError, match='no node was discovered within 0.3 s: is ROS_DO'):
                method()


@pytest.mark.ros
def test_a_name_that_cannot_be_is_one_sentence():
    """A traceback, or the line of a source file of rcl, was shown."""
    for ask in ('parameter_names', 'topic_text'):
        with (
            pytest.raises(GraphError, match="^Invalid .*: 'a b.*'$"),
            graph_client.graph() as graph,
        ):
            getattr(graph, ask)('a b')
