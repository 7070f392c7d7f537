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
"""QoS of the endpoints: best-effort robots, overrides, mismatches in the diagnostics."""

import sys

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from support.ros_graph import diagnostic, odometry, reason, twist

from t3mpc_ros.nodes import topic_endpoints
from t3mpc_ros.nodes.base_node import WARN, BaseNode
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.node_main import make_executor
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
ODOM_OVERRIDE = 'qos_overrides./odom.{}.reliability:={}'


def test_best_effort_inputs_are_received_early_and_late(harness):
    """A reliable subscription does not receive them: TurtleBot 4 and micro-ROS were ignored."""
    controller = harness.add(ControllerNode)
    reference = harness.create_publisher(Odometry, 'reference', BEST_EFFORT)
    reliable = harness.create_publisher(Odometry, 'odom')
    for publisher, lead_ns in ((reference, 400_000_000), (reliable, 0)):
        harness.publish_periodically(
            publisher, lambda lead=lead_ns: odometry(controller.now_ns() + lead, 0.05), 0.01
        )
    harness.spin_until(lambda: reason(controller) == 'tracking', 'no reference received')
    late = harness.create_publisher(Odometry, 'odom', BEST_EFFORT)
    harness.spin_until(lambda: late.get_subscription_count() > 0, 'the publisher has no match')
    assert reliable.get_subscription_count() > 0


def test_a_robot_executes_best_effort_commands(harness):
    robot = harness.add(SimRobotNode)
    commands = harness.create_publisher(Twist, 'cmd_vel', BEST_EFFORT)
    harness.publish_periodically(commands, lambda: twist(0.05))
    harness.spin_until(lambda: diagnostic(robot, 'commands') > 0, 'no command received')


def test_overrides_of_the_user_are_the_qos_of_the_publisher(harness, logged):
    """They were accepted without effect; one without an endpoint is a warning."""
    offered = topic_endpoints.STREAM.reliability
    overrides = [
        ODOM_OVERRIDE.format(kind, 'best_effort') for kind in ('publisher', 'subscription')
    ]
    harness.add(SimRobotNode, [word for each in overrides for word in ('-p', each)])
    (offer,) = harness.probe.get_publishers_info_by_topic('/odom')
    assert offer.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert topic_endpoints.STREAM.reliability == offered, (
        'the profile of the other endpoints is unchanged'
    )
    words = 'qos_overrides./odom.subscription.reliability has no effect'
    harness.spin_until(lambda: logged(words))


def test_an_overridden_request_is_kept_and_its_mismatch_named(harness):
    controller = harness.add(
        ControllerNode, ['-p', ODOM_OVERRIDE.format('subscription', 'reliable')]
    )
    harness.create_publisher(Odometry, 'odom', BEST_EFFORT)
    words = 'no message passes between /probe and this node on /odom: best effort publisher'

    harness.spin_until(lambda: words in harness.next_status('controller').message.lower())
    assert harness.statuses('controller')[-1].level == WARN
    assert diagnostic(controller, 'steps') == 0


def test_a_subscriber_that_requests_too_much_is_named(harness):
    harness.add(ReferenceGeneratorNode)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    harness.subscribe(Odometry, 'reference', latched)
    words = '/probe and this node on /reference: volatile publisher and transient local'
    harness.spin_until(lambda: words in harness.next_status('reference_generator').message.lower())


@pytest.mark.parametrize(
    'override, words',
    [
        ('publisher.reliability:=sometimes', 'must be one of .*best_effort.*: got .sometimes'),
        ('publisher.relibility:=reliable', 'must end with one of .*reliability'),
    ],
)
def test_an_invalid_override_is_rejected_with_the_reason(override, words, harness):
    with pytest.raises(ParameterError, match=words):
        harness.add(SimRobotNode, ['-p', f'qos_overrides./odom.{override}'])


@pytest.mark.parametrize('expected', [Twist, TwistStamped])
def test_the_command_has_the_type_that_the_robot_expects(expected, harness):
    """A robot that expects the other type received nothing; the recorder expects either."""
    foreign = harness.foreign_node()
    received = []
    foreign.create_subscription(expected, 'cmd_vel', received.append, 10)
    controller = harness.add(ControllerNode, enable_stamped_cmd_vel=expected is Twist)
    harness.spin_until(
        lambda: any(
            info.topic_type.endswith(f'/{expected.__name__}')
            for info in foreign.get_publishers_info_by_topic('/cmd_vel')
        ),
        'the type has not changed',
    )
    assert reason(controller) == 'stopped: no odometry'


@pytest.mark.parametrize('events', [True, False])
def test_each_executor_calls_back_and_leaves_polled_messages(events, harness, monkeypatch):
    """Executors differ: one passes message and information as a tuple and asks no group."""
    if not events:  # rclpy before 7.1.4
        monkeypatch.setitem(sys.modules, 'rclpy.experimental', None)
    executor = make_executor()
    assert isinstance(executor, SingleThreadedExecutor) != events
    node = BaseNode('listener')
    received = []
    node.create_matching_subscription(
        Twist, 'called', lambda *arguments: received.append(arguments), topic_endpoints.STREAM
    )
    polled = node.create_matching_subscription(Twist, 'polled', None, topic_endpoints.STREAM)
    executor.add_node(node)
    try:
        for topic in ('polled', 'called'):
            harness.connected_publisher(Twist, topic).publish(twist(0.25))
        while not received:
            executor.spin_once(timeout_sec=0.05)
        ((message, info),) = received
        assert message.linear.x == 0.25
        assert info['source_timestamp'] > 0
        assert [each.linear.x for each in polled.take_waiting()] == [0.25]
        assert polled.subscription.topic_name not in {
            each.topic_name for each in node.subscriptions
        }
    finally:
        executor.remove_node(node)
        executor.shutdown()
        node.destroy_node()


def test_the_type_is_kept_while_another_robot_expects_it(harness):
    harness.subscribe(Twist, 'cmd_vel')
    foreign = harness.foreign_node()
    foreign.create_subscription(TwistStamped, 'cmd_vel', print, 10)
    controller = harness.add(ControllerNode)
    words = 'expects geometry_msgs/msg/TwistStamped'
    harness.spin_until(lambda: words in harness.next_status('controller').message)
    assert controller._command_type is Twist
