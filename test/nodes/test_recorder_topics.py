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
"""Topics, types and QoS that the recorder records."""

import sys

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.ros_graph import (
    CommandSource,
    diagnostic,
    diagnostic_level,
    is_ok,
    odometry,
    record,
    recorded,
    twist,
)
from support.waiting import wait_for_acknowledgement
from visualization_msgs.msg import Marker

from t3mpc_ros.bag.topic_filter import TopicFilter
from t3mpc_ros.bag.writer import BagWriter, DiskError
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.base_node import ERROR, OK
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.recorder import TAKE_PERIOD
from t3mpc_ros.nodes.recorder_subscriptions import FULL_DISCOVERY, TopicSubscriptions
from t3mpc_ros.nodes.sim_robot import SimRobotNode

pytestmark = pytest.mark.ros


def _count(harness, recorder, count):
    harness.spin_until(lambda: diagnostic(recorder, 'messages') >= count)


def test_a_type_that_is_not_installed_is_a_warning(harness, logged, tmp_path, monkeypatch):
    marker, message = harness.create_publisher(Marker, 'marker'), Marker()
    text = harness.create_publisher(String, 'text')
    monkeypatch.setitem(sys.modules, 'visualization_msgs.msg', None)
    recorder = record(harness, tmp_path, 'marker', 'text')
    harness.wait_for_subscriber(text)
    harness.spin_until(lambda: logged('/marker is not recorded'))
    marker.publish(message)
    text.publish(String(data='hello'))
    _count(harness, recorder, 1)
    (line,) = logged('/marker')
    assert line.startswith('[WARN]')
    assert diagnostic_level(recorder) == OK
    with recorded(harness, recorder) as recording:
        assert list(recording.topics) == ['/text']


def test_best_effort_publishers_are_recorded(harness, tmp_path):
    """The early subscription to odometry is reliable and must adapt to a best-effort robot."""
    recorder = record(harness, tmp_path, 'odom', 'other')
    strong = harness.connected_publisher(Odometry, 'odom')
    strong.publish(odometry(NANOSECONDS, 0.25))
    _count(harness, recorder, 1)
    # What waits when the subscription is replaced is not lost.
    period_ns = round(TAKE_PERIOD * NANOSECONDS)
    (taking,) = (each for each in recorder.timers if each.timer_period_ns == period_ns)
    taking.cancel()
    strong.publish(odometry(NANOSECONDS, 0.25))
    wait_for_acknowledgement(strong)
    weak = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publishers = [harness.create_publisher(Odometry, name, weak) for name in ('odom', 'other')]
    for publisher in (*publishers, strong):
        harness.wait_for_subscriber(publisher)
        publisher.publish(odometry(NANOSECONDS, 0.5))
    taking.reset()
    _count(harness, recorder, 5)
    with recorded(harness, recorder) as recording:
        counts = {name: topic.message_count for name, topic in recording.topics.items()}
        assert counts == {'/odom': 4, '/other': 1}
        velocity = recording.series('/odom', {'v': 'twist.twist.linear.x'})['v']
        assert velocity.tolist() == [0.25, 0.25, 0.5, 0.5]


@pytest.mark.parametrize('changes', [False, True])
def test_stamped_commands_are_recorded_unless_a_type_changes(changes, harness, logged, tmp_path):
    """The early subscription to cmd_vel has type Twist and must adapt to TwistStamped."""
    recorder = record(harness, tmp_path, 'cmd_vel', 'text')
    text = harness.connected_publisher(String, 'text')
    if changes:
        first = harness.connected_publisher(Twist, 'cmd_vel')
        first.publish(twist(0.5))
        _count(harness, recorder, 1)
        harness.probe.destroy_publisher(first)
    commands = harness.foreign_node().create_publisher(TwistStamped, 'cmd_vel', 10)
    harness.wait_for_subscriber(commands)
    commands.publish(TwistStamped(twist=twist(0.5)))
    if changes:
        harness.spin_until(lambda: logged('/cmd_vel is not recorded'))
    text.publish(String(data='still here'))
    _count(harness, recorder, 2)
    assert diagnostic_level(recorder) == OK
    with recorded(harness, recorder) as recording:
        assert [each.message_count for each in recording.topics.values()] == [1, 1]
        kind, field = ('Twist', '') if changes else ('TwistStamped', 'twist.')
        assert recording.topics['/cmd_vel'].type_name == f'geometry_msgs/msg/{kind}'
        assert recording.series('/cmd_vel', {'v': f'{field}linear.x'})['v'].tolist() == [0.5]


def test_a_full_disk_ends_the_recording_only(harness, logged, tmp_path, monkeypatch):
    recorder = record(harness, tmp_path, 'odom')
    robot = harness.add(SimRobotNode)
    odom = harness.subscribe(Odometry, 'odom')
    CommandSource(harness, twist(0.2))
    _count(harness, recorder, 5)

    def full(*_):
        raise DiskError(tmp_path, 'No space left on device', 'the file is complete')

    monkeypatch.setattr(BagWriter, 'write', full)
    harness.spin_until(lambda: recorder.exit_code == 1)
    assert diagnostic_level(recorder) == ERROR
    status = harness.next_status('recorder')
    assert status.level == ERROR
    assert 'No space left on device' in status.message
    assert [line.split()[0] for line in logged('No space left')] == ['[ERROR]']
    assert 'No space left' in harness.refused(Trigger, 'recorder/split_bagfile')
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count + 20)
    assert is_ok(robot, 'following commands')
    assert robot.exit_code == 0


def test_parameters_are_recorded_by_namespace(harness, tmp_path):
    """Two controllers have the same name in two namespaces."""
    recorder = record(harness, tmp_path, 'odom', namespace='a')
    harness.add(ControllerNode, namespace='a', law__gain=90.0)
    harness.add(ControllerNode, namespace='b', law__gain=95.0)
    harness.spin_until(
        lambda: {'recorder', 'controller', '/b/controller'} <= recorder._metadata.records.keys()
    )
    with recorded(harness, recorder) as recording:
        assert recording.metadata_records['controller']['law.gain'] == '90.0'
        assert recording.metadata_records['/b/controller']['law.gain'] == '95.0'
        assert recording.metadata_records['recorder']['storage.uri'] == str(tmp_path)


def test_publishers_are_queried_when_their_number_changes():
    """The query of all topics at each discovery took most of the time of the recorder."""

    class Graph:
        publishers, queries = 1, 0

        def get_topic_names_and_types(self):
            return [('/a', ['std_msgs/msg/String']), ('/other', ['std_msgs/msg/String'])]

        def count_publishers(self, topic):
            return self.publishers

        def get_publishers_info_by_topic(self, topic):
            self.queries += topic == '/a'
            return []

    graph = Graph()
    discovery = TopicSubscriptions(graph, TopicFilter(['/a']), print)
    for _ in range(FULL_DISCOVERY - 2):
        discovery.discover()
    assert graph.queries == 1
    graph.publishers = 2
    discovery.discover()
    assert graph.queries == 2
    discovery.discover()
    assert graph.queries == 3, 'another publisher may have taken the place of one'
