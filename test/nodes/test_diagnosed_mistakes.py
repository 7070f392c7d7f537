# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Mistakes of set-up that left every node at OK: the diagnostics name them."""

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
import pytest
from support.ros_graph import odometry

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.base_node import ERROR, WARN
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode

pytestmark = pytest.mark.ros


def wait_for_warning(harness, name, words, levels=(WARN, ERROR)):
    """Wait until the diagnostics of a node contain some words; they have one of the levels."""
    harness.spin_until(lambda: words in harness.next_status(name).message, f'{name}: {words}')
    assert harness.statuses(name)[-1].level in levels


def test_odometry_of_another_clock_and_rate_is_named(harness):
    """The robot followed a second late, with OK."""
    controller = harness.add(ControllerNode)
    for topic in ('odom', 'reference'):
        publisher = harness.create_publisher(Odometry, topic)
        harness.publish_periodically(
            publisher, lambda: odometry(controller.now_ns() - NANOSECONDS, 0.05), 0.04
        )
    wait_for_warning(harness, 'controller', 'behind the clock of this node')
    wait_for_warning(harness, 'controller', 'but rate is 100 Hz')


def test_two_publishers_of_commands_are_named(harness):
    harness.add(SimRobotNode)
    harness.add(ControllerNode)
    harness.create_publisher(Twist, 'cmd_vel')
    for name in ('sim_robot', 'controller'):
        wait_for_warning(harness, name, '/cmd_vel has 2 publishers: /controller, /probe')


@pytest.mark.parametrize('kind, level', [(ControllerNode, WARN), (SimRobotNode, ERROR)])
def test_simulated_time_without_a_clock_is_named(kind, level, harness):
    node = harness.add(kind, use_sim_time=True)
    wait_for_warning(harness, node.get_name(), 'no message on /clock yet', [level])
