# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes in one graph: message types, diagnostics, simulated time, namespaces."""

import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import pytest
from rclpy.qos import DurabilityPolicy
from rosgraph_msgs.msg import Clock
from support.ros_graph import NODE_CLASSES, diagnostic, is_ok, on_grid, reason, speed, stamp

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import conversions
from t3mpc_ros.nodes.base_node import OK, WARN
from t3mpc_ros.nodes.composed import ComposedNode
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.recorder.node import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.registry import NODES
from t3mpc_ros.nodes.sim_robot import SimRobotNode

pytestmark = pytest.mark.ros


# -- mismatched message types ---------------------------------------------------------------------


@pytest.mark.parametrize('stamped', [False, True])
def test_another_type_on_cmd_vel_is_a_warning(stamped, harness):
    """ROS 2 connects only endpoints of equal type and reports nothing about the others."""
    robot = harness.add(SimRobotNode, enable_stamped_cmd_vel=stamped)
    controller = harness.add(ControllerNode, enable_stamped_cmd_vel=stamped)
    harness.add(ReferenceGeneratorNode)
    harness.spin_until(
        lambda: reason(controller) == 'tracking' and is_ok(robot, 'following commands')
    )
    other = Twist if stamped else TwistStamped
    foreign = harness.foreign_node()
    foreign.create_publisher(other, 'cmd_vel', 10)
    foreign.create_subscription(other, 'cmd_vel', print, 10)

    words = f' geometry_msgs/msg/{other.__name__} '
    for node in (robot, controller):
        harness.spin_until(lambda one=node: words in reason(one), f'{node.get_name()} warns')
        status = harness.next_status(node.get_name())
        assert status.level == WARN
        assert words in status.message


# -- diagnostics ----------------------------------------------------------------------------------


@pytest.mark.timed
def test_every_node_publishes_diagnostics_at_1_hz(harness, tmp_path):
    stamps = {}
    harness.probe.create_subscription(
        DiagnosticArray,
        '/diagnostics',
        lambda m: stamps.setdefault(m.status[0].name, []).append(time.monotonic()),
        100,
    )
    for name, kind in NODE_CLASSES.items():
        if name != 'recorder':
            harness.add(kind)
    harness.add(RecorderNode, storage__uri=str(tmp_path / 'bag'))
    harness.add(ComposedNode, namespace='two')
    harness.spin_until(lambda: stamps.keys() == {*NODES, 'two/composed'})
    harness.spin_until(lambda: all(len(times) >= 4 for times in stamps.values()))
    for name, times in stamps.items():
        assert 0.5 < (times[-1] - times[0]) / (len(times) - 1) < 2.0, name
    expected = {
        'controller': 'tracking',
        'recorder': 'recording',
        'reference_generator': 'running',
    }
    harness.spin_until(
        lambda: all(harness.statuses(name)[-1].message == text for name, text in expected.items())
    )
    for name in expected:
        status = harness.statuses(name)[-1]
        assert status.level == OK
        assert status.hardware_id
        assert status.values


# -- simulated time -------------------------------------------------------------------------------


def test_the_loop_closes_in_simulated_time(harness):
    harness.add(SimRobotNode, publish_clock=True)
    controller = harness.add(ControllerNode, use_sim_time=True)
    reference = harness.add(ReferenceGeneratorNode, use_sim_time=True)
    odom = harness.subscribe(Odometry, 'odom')
    received = harness.subscribe(Odometry, 'reference')
    harness.spin_until(lambda: reason(controller) == 'tracking')
    harness.spin_until(lambda: speed(odom[-1]) > 0.02, 'the robot follows')
    away = stamp(received[-1]) - stamp(odom[-1])
    assert abs(away) < 2 * NANOSECONDS
    for node in (controller, reference):
        assert abs(node.now_ns() - stamp(odom[-1])) < 2 * NANOSECONDS
    assert diagnostic(reference, 'skipped_samples') < 1000


def test_tracking_resumes_after_the_clock_jumps_back(harness, tmp_path):
    """Before the first message on /clock the time of a node is 0, which must not start a grid."""
    clock = harness.create_publisher(Clock, '/clock')
    offset_ns = [10**6 * NANOSECONDS]

    def now_ns():
        return offset_ns[0] + time.monotonic_ns()

    kinds = (SimRobotNode, ControllerNode, ReferenceGeneratorNode)
    robot, controller, reference = (harness.add(kind, use_sim_time=True) for kind in kinds)
    harness.add(RecorderNode, use_sim_time=True, storage__uri=str(tmp_path / 'bag'))
    odom = harness.subscribe(Odometry, 'odom')
    harness.wait_for_subscriber(clock, 4)
    # The nodes run for a while before the clock starts.
    for node in (controller, reference):
        harness.next_status(node.get_name())
    assert not odom
    harness.publish_periodically(
        clock, lambda: Clock(clock=conversions.time_from_ns(now_ns())), 0.01
    )
    harness.spin_until(lambda: reason(controller) == 'tracking')
    harness.spin_until(lambda: speed(odom[-1]) > 0.02)
    for node in (robot, reference):
        assert diagnostic(node, 'skipped_samples') == 0

    before_ns = stamp(odom[-1])
    offset_ns[0] -= 100 * NANOSECONDS
    harness.spin_until(lambda: stamp(odom[-1]) < before_ns - 50 * NANOSECONDS)
    count = len(odom)
    harness.spin_until(lambda: reason(controller) == 'tracking' and len(odom) > count + 50)
    harness.spin_until(lambda: speed(odom[-1]) > 0.02, 'the robot follows again')
    assert on_grid(odom[count:], 100)


# -- durability -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'kind, topic', [(SimRobotNode, '/odom'), (ReferenceGeneratorNode, '/reference')]
)
def test_late_subscribers_receive_no_old_messages(kind, topic, harness):
    """Old odometry would look like a moving robot."""
    harness.add(kind)
    (offer,) = harness.probe.get_publishers_info_by_topic(topic)
    assert offer.qos_profile.durability == DurabilityPolicy.VOLATILE


# -- remapping ------------------------------------------------------------------------------------


def test_topics_can_be_remapped(harness):
    harness.add(SimRobotNode, ['-r', 'cmd_vel:=/steer', '-r', 'odom:=wheels/odom'])
    controller = harness.add(ControllerNode, ['-r', 'cmd_vel:=/steer', '-r', 'odom:=wheels/odom'])
    harness.add(ReferenceGeneratorNode)
    commands = harness.subscribe(Twist, '/steer')
    harness.spin_until(lambda: reason(controller) == 'tracking' and commands)
    assert not harness.probe.get_publishers_info_by_topic('/cmd_vel')
    assert not harness.probe.get_publishers_info_by_topic('/odom')
