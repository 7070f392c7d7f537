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
"""A message that has waited, or that comes from another clock, moves no robot.

An executor that does not run is, for its nodes, the same as a suspended process: the middleware
receives, and what has waited is taken afterwards.
"""

import time
from types import SimpleNamespace

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import pytest
from support.ros_graph import (
    CommandSource,
    ControllerHarness,
    diagnostic,
    diagnostic_level,
    odometry,
    reason,
    speed,
    twist,
)

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import ERROR
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.radio.link.actions_and_states import Write

pytestmark = [pytest.mark.ros, pytest.mark.timed]

SUSPENDED = 0.4
"""Longer than the command timeout of 0.25 s and the odometry timeout of the test, s."""


def suspend():
    """Let time pass while no callback of the test's process runs."""
    time.sleep(SUSPENDED)


@pytest.mark.parametrize('simulated_time', [False, True])
def test_a_command_that_waited_does_not_move_sim_robot(harness, simulated_time):
    """An unstamped command counted as new when it was taken: the robot drove after a pause."""
    robot = harness.add(SimRobotNode, publish_clock=simulated_time)
    odom = harness.subscribe(Odometry, 'odom')
    commands = harness.connected_publisher(Twist, 'cmd_vel')
    harness.spin_until(lambda: odom)
    commands.publish(twist(0.3))
    suspend()
    harness.spin_until(lambda: diagnostic(robot, 'commands') == 1)
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count + 40)
    assert max(map(speed, odom)) < 1e-3
    assert diagnostic(robot, 'commands_rejected') == 1
    assert 'command is too old' in reason(robot)
    CommandSource(harness, twist(0.3))
    harness.spin_until(lambda: speed(odom[-1]) > 0.28, 'a new command moves the robot')


@pytest.mark.parametrize('kind', [Twist, TwistStamped])
def test_a_command_that_waited_is_rejected_by_the_bridge(harness, tmp_path, kind):
    stamped = kind is TwistStamped
    given = {'port': str(tmp_path / 'none'), 'enable_stamped_cmd_vel': stamped}
    node = harness.add(RadioBridgeNode, **given)
    commands = harness.connected_publisher(kind, 'cmd_vel')
    commands.publish(TwistStamped(twist=twist(0.3)) if stamped else twist(0.3))
    suspend()
    harness.spin_until(lambda: diagnostic(node, 'commands') == 1)
    assert diagnostic(node, 'commands_rejected') == 1
    assert node._robot.reason(node.steady_ns())
    assert node._command_problem.startswith('command is too old: 0.')


def test_a_command_from_the_future_is_rejected(harness, monkeypatch):
    """A clock that leads hides the time that a command has waited."""
    robot = harness.add(SimRobotNode)
    odom = harness.subscribe(Odometry, 'odom')
    source = CommandSource(harness)
    now_ns, lead_ns = time.time_ns, NANOSECONDS
    monkeypatch.setattr(ros_messages.time, 'time_ns', lambda: now_ns() - lead_ns)
    source.message = twist(0.3)
    harness.spin_until(lambda: diagnostic(robot, 'commands_rejected') > 20)
    assert max(map(speed, odom)) < 1e-3
    assert 'the clocks of the computers differ' in reason(robot)
    lead_ns = 0
    harness.spin_until(lambda: speed(odom[-1]) > 0.28, 'equal clocks')
    assert 'clocks' not in reason(robot)


def test_a_frame_of_a_suspended_bridge_is_not_written(harness, tmp_path):
    """A process may be suspended between the decision on a command and its write."""
    node = harness.add(RadioBridgeNode, port=str(tmp_path / 'none'))
    written = []
    port = SimpleNamespace(write=written.append)
    with node._lock:
        before, node._port = node._port, port
        for late_ns in (0, 3 * NANOSECONDS):
            node._execute(Write(b'%d' % late_ns), node.steady_ns() - late_ns)
        node._port = before
    assert written == [b'0']


def test_odometry_that_waited_is_no_step_of_the_controller(harness):
    """A suspended controller computed fresh commands from the odometry of seconds ago."""
    bench = ControllerHarness(harness, odometry_timeout=0.3)
    controller = bench.controller
    bench.publish_reference(seconds=1.0)
    bench.stamp_ns += NANOSECONDS // 100
    bench.odom_publisher.publish(odometry(bench.stamp_ns))
    suspend()
    harness.spin_until(lambda: diagnostic(controller, 'odometry_rejected') == 1)
    assert diagnostic(controller, 'steps') == 0
    assert bench.commands == []
    assert diagnostic_level(controller) == ERROR
    assert 'odom is too old' in reason(controller)
    bench.publish_odometry()
    assert 'odom' not in reason(controller)


def test_the_controller_recovers_from_a_backlog_of_odometry(harness):
    """One message per cycle of the executor, and one more arriving: a queue once full stayed so.

    In a process shared with other nodes the controller ran on odometry of a second ago.
    """
    controller = harness.add(ControllerNode)
    odom = harness.create_publisher(Odometry, 'odom')
    reference = harness.create_publisher(Odometry, 'reference')
    for publisher in (odom, reference):
        harness.wait_for_subscriber(publisher)
        for _ in range(100):
            publisher.publish(odometry(controller.now_ns(), 0.05))
    suspend()
    # Work between two cycles, as of a robot in the same process.
    harness.publish_periodically(odom, lambda: odometry(controller.now_ns(), 0.05), 0.01)
    lead_ns = 4 * NANOSECONDS // 10
    harness.publish_periodically(
        reference, lambda: odometry(controller.now_ns() + lead_ns, 0.05), 0.01
    )

    def tracking():
        time.sleep(0.005)
        return reason(controller) == 'tracking'

    harness.spin_until(tracking)
    assert diagnostic(controller, 'odometry_rejected') == 100
