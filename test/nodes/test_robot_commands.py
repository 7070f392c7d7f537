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
"""Commands, stops and odometry of the simulated robot node."""

import math

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import (
    CommandSource,
    diagnostic,
    driving_robot,
    on_grid,
    reason,
    speed,
    stamp,
    twist,
)

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import ERROR, WARN
from t3mpc_ros.nodes.sim_robot import SimRobotNode

pytestmark = pytest.mark.ros


FIELDS = [(part, axis) for part in ('linear', 'angular') for axis in 'xyz']


def test_a_non_finite_command_never_moves_the_robot(harness):
    """Fields that have no effect on a differential drive count, too."""
    robot = harness.add(SimRobotNode)
    odom = harness.subscribe(Odometry, 'odom')
    commands = harness.connected_publisher(Twist, 'cmd_vel')
    rejected = 0
    for part, axis in FIELDS:
        for value in (math.nan, math.inf, -math.inf):
            bad = twist(0.3, 2.0)
            setattr(getattr(bad, part), axis, value)
            commands.publish(bad)
            rejected += 1
            harness.spin_until(
                lambda count=rejected: diagnostic(robot, 'commands_rejected') == count,
                f'{part}.{axis} = {value} was not rejected',
            )
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count + 5)
    status = harness.next_status('sim_robot')
    assert status.level == WARN
    assert 'not finite' in status.message
    assert max(map(speed, odom)) < 1e-3
    commands.publish(twist(0.3, 0.0))
    harness.spin_until(
        lambda: odom[-1].twist.twist.linear.x > 0.1, 'a finite command moves the robot'
    )


def test_lateral_and_vertical_commands_are_ignored(harness):
    harness.add(SimRobotNode, disturbance__bound=0.0)
    odom = harness.subscribe(Odometry, 'odom')
    source = CommandSource(harness)
    message = twist()
    message.linear.y = message.linear.z = message.angular.x = message.angular.y = 1.0
    source.message = message
    harness.spin_until(lambda: len(odom) > 30)
    assert max(map(speed, odom)) == 0.0
    message.linear.x = 0.3
    harness.spin_until(lambda: odom[-1].pose.pose.position.x > 0.05)
    assert abs(odom[-1].pose.pose.position.y) < 1e-9
    assert odom[-1].twist.twist.linear.y == 0.0


def test_e_stop_latches_and_release_needs_a_new_command(harness):
    robot, odom, source = driving_robot(harness, 0.3)
    foreign = harness.foreign_node().create_publisher(TwistStamped, 'cmd_vel', 10)
    harness.spin_until(lambda: 'TwistStamped' in reason(robot))
    harness.done(SetBool, 'e_stop', data=True)
    harness.spin_until(lambda: speed(odom[-1]) < 1e-3, 'the robot stops')
    status = harness.next_status('sim_robot')  # no mismatch of types hides the stop
    foreign.destroy()
    assert status.level == ERROR
    assert 'emergency stop' in status.message
    # The robot stays at rest although commands continue.
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count + 20)
    assert max(map(speed, odom[count:])) < 1e-3

    source.message = None
    count = diagnostic(robot, 'commands_rejected')
    assert count > 0
    harness.done(SetBool, 'e_stop', data=False)
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count + 20)
    assert max(map(speed, odom[count:])) < 1e-3, 'the old command stays invalid'
    harness.spin_until(lambda: 'released' in reason(robot))
    source.message = twist(0.3)
    harness.spin_until(lambda: speed(odom[-1]) > 0.28, 'a new command moves the robot')
    assert 'no emergency stop' in harness.refused(SetBool, 'e_stop', data=False)


def test_odometry_is_reset_at_rest_only(harness):
    harness.add(SimRobotNode)
    odom = harness.subscribe(Odometry, 'odom')
    truth = harness.subscribe(Odometry, 'ground_truth/odom')
    source = CommandSource(harness, twist(0.3))
    harness.spin_until(lambda: odom and odom[-1].pose.pose.position.x > 0.05)
    assert 'moves' in harness.refused(Trigger, 'reset_odometry')
    assert odom[-1].pose.pose.position.x > 0.05
    source.message = None
    harness.spin_until(lambda: speed(odom[-1]) < 1e-3)
    harness.done(Trigger, 'reset_odometry')
    harness.spin_until(lambda: abs(odom[-1].pose.pose.position.x) < 1e-3)
    harness.spin_until(lambda: truth[-1].pose.pose.position.x > 0.05, 'the true pose is unchanged')


def test_odometry_has_an_exact_grid_frames_and_joints(harness):
    harness.add(
        SimRobotNode,
        odom_frame_id='a/odom',
        base_frame_id='a/base',
        right_wheel_name='r',
        left_wheel_name='l',
        rate=50.0,
        joint_rate=25.0,
    )
    odom = harness.subscribe(Odometry, 'odom')
    joints = harness.subscribe(JointState, 'joint_states')
    CommandSource(harness, twist(0.2, 1.0))
    harness.spin_until(lambda: len(odom) > 40 and len(joints) > 10)
    assert on_grid(odom, 50)
    assert odom[-1].header.frame_id == 'a/odom'
    assert odom[-1].child_frame_id == 'a/base'
    assert joints[-1].name == ['r', 'l']
    assert np.median(np.diff([stamp(message) for message in joints])) == NANOSECONDS // 25
    right, left = joints[-1].velocity
    assert right > left > 0.0


@pytest.mark.parametrize(
    ('published', 'stamped'), [(TwistStamped, False), (Twist, True), (TwistStamped, True)]
)
def test_a_robot_accepts_either_type_without_a_parameter(published, stamped, harness):
    """A stamped command needed a parameter of the robot, and was received by nobody."""
    robot = harness.add(SimRobotNode, enable_stamped_cmd_vel=stamped)
    odom = harness.subscribe(Odometry, 'odom')
    publisher = harness.foreign_node().create_publisher(published, 'cmd_vel', 10)
    message = published()
    (message.twist if published is TwistStamped else message).linear.x = 0.2

    def moves():
        publisher.publish(message)
        return odom and speed(odom[-1]) > 0.1

    harness.spin_until(moves)
    assert '/cmd_vel' in {each.topic_name for each in robot.subscriptions}


def test_a_robot_without_detection_says_what_is_published(harness):
    robot = harness.add(SimRobotNode, detect_cmd_vel_type=False)
    publisher = harness.foreign_node().create_publisher(TwistStamped, 'cmd_vel', 10)
    words = 'another node publishes geometry_msgs/msg/TwistStamped on cmd_vel'
    harness.spin_until(lambda: words in reason(robot) and publisher)


def test_stamped_commands_are_accepted_and_stale_ones_rejected(harness):
    """A played or delayed stamped command must not move a robot."""
    robot = harness.add(SimRobotNode, enable_stamped_cmd_vel=True)
    odom = harness.subscribe(Odometry, 'odom')
    commands = harness.connected_publisher(TwistStamped, 'cmd_vel')

    def say(stamp_ns):
        message = TwistStamped(twist=twist(0.3))
        message.header.stamp = ros_messages.time_from_ns(stamp_ns)
        commands.publish(message)

    say(robot.now_ns() - 2 * NANOSECONDS)
    harness.spin_until(lambda: diagnostic(robot, 'commands_rejected') == 1)
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count + 5)
    assert max(map(speed, odom)) < 1e-3
    say(robot.now_ns())
    harness.spin_until(lambda: speed(odom[-1]) > 0.1, 'a present stamp moves the robot')
    harness.spin_until(lambda: speed(odom[-1]) < 1e-3)
    say(0)
    harness.spin_until(lambda: speed(odom[-1]) > 0.1, 'a stamp of zero means now')
