# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the nodes do with good, bad and missing input, all in this process over real DDS."""

import math
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
from rcl_interfaces.msg import Log
import rclpy
from rclpy.clock import Clock as RclpyClock
from rclpy.clock import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Int32MultiArray, String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.run.model_file import ModelError, load_model
from t3mpc_ros.bag.writer import BagWriter, DiskError
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import composed
from t3mpc_ros.nodes.common import conversions
from t3mpc_ros.nodes.common.base_node import ERROR, OK, WARN
from t3mpc_ros.nodes.composed import ComposedNode
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.node_parameters import PARAMETER_CLASSES
from t3mpc_ros.nodes.player.node import PlayerNode
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.recorder.node import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

PATIENCE = 30.0
"""Seconds a condition may take on a busy machine; it is met in a fraction of that."""

NODES = {
    'reference': ReferenceGeneratorNode,
    'controller': ControllerNode,
    'sim_robot': SimRobotNode,
    'radio_bridge': RadioBridgeNode,
    'recorder': RecorderNode,
    'replayer': PlayerNode,
    'all_in_one': ComposedNode,
}

LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class World:
    """Nodes in one executor, and a probe that talks to them."""

    def __init__(self):
        self._executor = SingleThreadedExecutor()
        self._nodes = []
        self._steady = RclpyClock(clock_type=ClockType.STEADY_TIME)
        self._strangers = []
        self.probe = Node('probe')
        self._executor.add_node(self.probe)
        self._health = self.hear(DiagnosticArray, '/diagnostics')

    def add(self, kind, arguments=(), namespace=None, **parameters):
        """Make a node of the package; ``law__gain=5.0`` sets ``law.gain``."""
        node = kind(
            namespace=namespace,
            cli_args=['--ros-args', *arguments] if arguments else None,
            parameter_overrides=[
                Parameter(name.replace('__', '.'), value=value)
                for name, value in parameters.items()
            ],
        )
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def remove(self, node):
        """End one node as its process would."""
        node.finish()
        self._executor.remove_node(node)
        self._nodes.remove(node)
        node.destroy_node()

    def stranger(self):
        """Return a node of another process: only there a topic may have another type."""
        context = rclpy.Context()
        rclpy.init(args=[], context=context)
        self._strangers.append(Node('stranger', context=context))
        return self._strangers[-1]

    def until(self, condition, what=''):
        """Spin until ``condition`` holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, f'did not happen: {what or condition}'
            self._executor.spin_once(timeout_sec=0.05)

    def hear(self, kind, topic, quality=100):
        """Return a list that fills with the messages of a topic."""
        heard = []
        self.probe.create_subscription(kind, topic, heard.append, quality)
        return heard

    def speak(self, kind, topic, quality=100):
        """Return a publisher of the probe's."""
        return self.probe.create_publisher(kind, topic, quality)

    def found(self, publisher, count=1):
        """Spin until ``publisher`` has found so many subscribers."""
        self.until(
            lambda: publisher.get_subscription_count() >= count, f'{publisher.topic} finds no one'
        )

    def keep_saying(self, publisher, make, period=0.02):
        """Publish ``make()`` again and again, except while it is None."""

        def say():
            message = make()
            if message is not None:
                publisher.publish(message)

        self.probe.create_timer(period, say, clock=self._steady)

    def call(self, kind, name, **request):
        """Return what a service answers."""
        client = self.probe.create_client(kind, name)
        self.until(client.service_is_ready, f'no service {name}')
        future = client.call_async(kind.Request(**request))
        self.until(future.done, f'no answer of {name}')
        self.probe.destroy_client(client)
        return future.result()

    def said(self, name):
        """Return the diagnostics of one node so far."""
        return [status for array in self._health for status in array.status if status.name == name]

    def diagnosis(self, name):
        """Return the next diagnostics of one node."""
        before = len(self.said(name))
        self.until(lambda: len(self.said(name)) > before, f'no diagnostics of {name}')
        return self.said(name)[-1]

    def close(self):
        for node in list(self._nodes):
            self.remove(node)
        self._executor.remove_node(self.probe)
        self._executor.shutdown()
        self.probe.destroy_node()
        for node in self._strangers:
            node.destroy_node()
            rclpy.try_shutdown(context=node.context)


@pytest.fixture
def world(ros):
    made = World()
    yield made
    made.close()


def reason(node):
    """Return what a node says of itself; :class:`BaseNode` puts it into the diagnostics."""
    return node.produce_diagnostics()[1]


def is_well(node, message):
    """Whether a node says this and no more; a machine that stalls is not the node's fault."""
    level, said, _ = node.produce_diagnostics()
    return (level, said) == (OK, message) or 'the machine is too slow' in said


def on_grid(messages, rate):
    """Whether all stamps lie on one grid, each later than the one before."""
    steps = np.diff([stamp(message) for message in messages])
    return len(steps) > 0 and min(steps) > 0 and not np.any(steps % (NANOSECONDS // rate))


def twist(linear=0.0, angular=0.0):
    message = Twist()
    message.linear.x = linear
    message.angular.z = angular
    return message


def odometry(stamp_ns, linear=0.0, angular=0.0):
    message = Odometry()
    message.header.stamp = conversions.time_from_ns(stamp_ns)
    message.pose.pose.orientation.w = 1.0
    message.twist.twist = twist(linear, angular)
    return message


def stamp(message):
    return conversions.ns_from_time(message.header.stamp)


def speed(message):
    """Return the larger of |v| and a wheel's share of |omega|, m/s."""
    now = message.twist.twist
    return max(abs(now.linear.x), 0.0735 * abs(now.angular.z))


class Driver:
    """Says one command again and again, the way a teleoperation node would."""

    def __init__(self, world, topic='cmd_vel', kind=Twist):
        self.message = None
        self.publisher = world.speak(kind, topic)
        world.keep_saying(self.publisher, lambda: self.message)


# -- the robot ------------------------------------------------------------------------------------

FIELDS = [(part, axis) for part in ('linear', 'angular') for axis in 'xyz']


def test_a_command_that_is_not_finite_never_moves_the_robot(world):
    """The number meant may have been anything; fields a wheeled robot does not use count too."""
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    commands = world.speak(Twist, 'cmd_vel')
    world.found(commands)
    refused = 0
    for part, axis in FIELDS:
        for value in (math.nan, math.inf, -math.inf):
            bad = twist(0.3, 2.0)
            setattr(getattr(bad, part), axis, value)
            commands.publish(bad)
            refused += 1
            world.until(
                lambda count=refused: robot.produce_diagnostics()[2]['commands_refused'] == count,
                f'{part}.{axis} = {value} was not refused',
            )
    count = len(odom)
    world.until(lambda: len(odom) > count + 5)
    said = world.diagnosis('sim_robot')
    assert said.level == WARN
    assert 'not finite' in said.message
    assert max(map(speed, odom)) < 1e-3
    commands.publish(twist(0.3, 0.0))
    world.until(lambda: odom[-1].twist.twist.linear.x > 0.1, 'a good command moves the robot')


def test_a_bad_command_stops_a_moving_robot(world):
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.3)
    world.until(lambda: odom and speed(odom[-1]) > 0.28)
    assert is_well(robot, 'following commands')
    driver.message = twist(0.3, math.nan)
    world.until(lambda: speed(odom[-1]) < 1e-3, 'the robot stops')
    assert 'not finite' in reason(robot)
    driver.message = twist(0.3)
    world.until(lambda: speed(odom[-1]) > 0.28, 'the robot moves again')
    assert is_well(robot, 'following commands')


def test_what_a_wheeled_robot_cannot_do_is_left_out_of_a_command(world):
    world.add(SimRobotNode, disturbance__bound=0.0)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    message = twist()
    message.linear.y = message.linear.z = message.angular.x = message.angular.y = 1.0
    driver.message = message
    world.until(lambda: len(odom) > 30)
    assert max(map(speed, odom)) == 0.0
    message.linear.x = 0.3
    world.until(lambda: odom[-1].pose.pose.position.x > 0.05)
    assert abs(odom[-1].pose.pose.position.y) < 1e-9
    assert odom[-1].twist.twist.linear.y == 0.0


def test_silence_stops_the_robot_with_the_reason_in_its_diagnostics(world):
    world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.3)
    world.until(lambda: odom and speed(odom[-1]) > 0.28)
    driver.message = None
    world.until(lambda: speed(odom[-1]) < 1e-3, 'the robot stops')
    said = world.diagnosis('sim_robot')
    assert said.level == WARN
    assert said.message == 'no command for 0.25 s'
    assert {entry.key: entry.value for entry in said.values}['timed_out'] == 'True'


def test_the_emergency_stop_latches_and_its_release_needs_a_new_command(world):
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.3)
    world.until(lambda: odom and speed(odom[-1]) > 0.28)
    assert world.call(SetBool, 'e_stop', data=True).success
    world.until(lambda: speed(odom[-1]) < 1e-3, 'the robot stops')
    said = world.diagnosis('sim_robot')
    assert said.level == ERROR
    assert 'emergency stop' in said.message
    # More than a second of commands later it still stands.
    count = len(odom)
    world.until(lambda: len(odom) > count + 20)
    assert max(map(speed, odom[count:])) < 1e-3

    driver.message = None
    count = robot.produce_diagnostics()[2]['commands_refused']
    assert count > 0
    assert world.call(SetBool, 'e_stop', data=False).success
    count = len(odom)
    world.until(lambda: len(odom) > count + 20)
    assert max(map(speed, odom[count:])) < 1e-3, 'the old command is not taken up again'
    assert 'released' in reason(robot)
    driver.message = twist(0.3)
    world.until(lambda: speed(odom[-1]) > 0.28, 'a new command moves the robot')
    answer = world.call(SetBool, 'e_stop', data=False)
    assert not answer.success
    assert 'no emergency stop' in answer.message


def test_a_latched_stop_is_an_error_whatever_else_is_wrong(world):
    """A warning about message types once stood in front of the emergency stop."""
    robot = world.add(SimRobotNode)
    world.stranger().create_publisher(TwistStamped, 'cmd_vel', 10)
    world.until(lambda: 'TwistStamped' in reason(robot))
    assert world.call(SetBool, 'e_stop', data=True).success
    world.until(lambda: robot.produce_diagnostics()[0] == ERROR)
    assert 'emergency stop' in reason(robot)


def test_odometry_is_reset_at_rest_only(world):
    world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    truth = world.hear(Odometry, 'ground_truth/odom')
    driver = Driver(world)
    driver.message = twist(0.3)
    world.until(lambda: odom and odom[-1].pose.pose.position.x > 0.05)
    answer = world.call(Trigger, 'reset_odometry')
    assert not answer.success
    assert 'moves' in answer.message
    assert odom[-1].pose.pose.position.x > 0.05
    driver.message = None
    world.until(lambda: speed(odom[-1]) < 1e-3)
    assert world.call(Trigger, 'reset_odometry').success
    world.until(lambda: abs(odom[-1].pose.pose.position.x) < 1e-3)
    world.until(lambda: truth[-1].pose.pose.position.x > 0.05, 'the robot itself stays')


def test_set_pose_moves_the_true_robot_and_not_its_odometry(world):
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    truth = world.hear(Odometry, 'ground_truth/odom')
    values = {'start_x': 1.5, 'start_y': -2.0, 'start_heading': 0.5}
    for name, value in values.items():
        assert robot.set_parameters([Parameter(name, value=value)])[0].successful
    assert world.call(Trigger, 'sim_robot/set_pose').success
    world.until(lambda: truth and abs(truth[-1].pose.pose.position.x - 1.5) < 1e-3)
    pose = conversions.state_from_odometry(truth[-1]).pose
    assert pose == pytest.approx((1.5, -2.0, 0.5), abs=1e-3)
    assert conversions.state_from_odometry(odom[-1]).pose == pytest.approx((0, 0, 0), abs=1e-3)
    answer = robot.set_parameters([Parameter('start_x', value=math.nan)])[0]
    assert not answer.successful
    assert 'start_x must be finite' in answer.reason


def test_odometry_comes_on_an_exact_grid_with_its_frames_and_joints(world):
    world.add(
        SimRobotNode,
        odom_frame_id='a/odom',
        base_frame_id='a/base',
        right_wheel_name='r',
        left_wheel_name='l',
        rate=50.0,
        joint_rate=25.0,
    )
    odom = world.hear(Odometry, 'odom')
    joints = world.hear(JointState, 'joint_states')
    driver = Driver(world)
    driver.message = twist(0.2, 1.0)
    world.until(lambda: len(odom) > 40 and len(joints) > 10)
    assert on_grid(odom, 50)
    assert odom[-1].header.frame_id == 'a/odom'
    assert odom[-1].child_frame_id == 'a/base'
    assert joints[-1].name == ['r', 'l']
    assert np.median(np.diff([stamp(message) for message in joints])) == NANOSECONDS // 25
    right, left = joints[-1].velocity
    assert right > left > 0.0


def test_the_robot_takes_stamped_commands_by_parameter_and_no_stale_one(world):
    """A stamped command that was recorded, or held up on its way, must not move a robot."""
    robot = world.add(SimRobotNode, stamped=True)
    odom = world.hear(Odometry, 'odom')
    commands = world.speak(TwistStamped, 'cmd_vel')
    world.found(commands)

    def say(stamp_ns):
        message = TwistStamped(twist=twist(0.3))
        message.header.stamp = conversions.time_from_ns(stamp_ns)
        commands.publish(message)

    say(robot.now_ns() - 2 * NANOSECONDS)
    world.until(lambda: robot.produce_diagnostics()[2]['commands_refused'] == 1)
    count = len(odom)
    world.until(lambda: len(odom) > count + 5)
    assert max(map(speed, odom)) < 1e-3
    say(robot.now_ns())
    world.until(lambda: speed(odom[-1]) > 0.1, 'a fresh one moves the robot')
    world.until(lambda: speed(odom[-1]) < 1e-3)
    say(0)
    world.until(lambda: speed(odom[-1]) > 0.1, 'a stamp of zero means now, as is usual')


def test_a_command_however_large_stays_within_the_limits(world):
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    for value in (1e3, 1e160, 1.7e308):
        driver.message = twist(value, value)
        count = len(odom)
        world.until(lambda start=count: len(odom) > start + 30)
    world.until(lambda: len(odom) > 100)
    limits = robot.parameters.limiter
    assert max(abs(message.twist.twist.linear.x) for message in odom) <= 1.05 * limits.linear_speed
    turning = max(abs(message.twist.twist.angular.z) for message in odom)
    assert turning <= 1.05 * limits.angular_speed


def test_live_limits_of_the_robot_take_effect(world):
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.3)
    world.until(lambda: odom and speed(odom[-1]) > 0.28)
    assert robot.set_parameters([Parameter('linear.x.max_velocity', value=0.1)])[0].successful
    world.until(lambda: abs(speed(odom[-1]) - 0.1) < 0.01)
    assert robot.produce_diagnostics()[2]['limited']


# -- the controller -------------------------------------------------------------------------------


class Bench:
    """A robot that stands, and a reference, both in the test's hand: stamps without a clock."""

    def __init__(self, world, kind=Twist, odometry_timeout=5.0, **parameters):
        self.world = world
        # Long, so that a machine that stalls is not taken for silence.
        parameters['watchdog.odometry_timeout'] = odometry_timeout
        self.controller = controller = world.add(ControllerNode, **parameters)
        self.commands = world.hear(kind, 'cmd_vel')
        self._odom = world.speak(Odometry, 'odom')
        self._reference = world.speak(Odometry, 'reference')
        self.stamp_ns = NANOSECONDS
        world.found(self._odom)
        world.found(self._reference)
        world.until(lambda: controller.count_subscribers('cmd_vel') > 0)

    def refer(self, linear=0.1, angular=0.0, seconds=0.1):
        """Say where to go from now on, for so long; a second of it may pile up."""
        for step in range(round(seconds * 100) + 1):
            stamp_ns = self.stamp_ns + step * NANOSECONDS // 100
            self._reference.publish(odometry(stamp_ns, linear, angular))

    def report(self, linear=0.0):
        """Report the robot's motion once and wait for the step that it brings."""
        count = self.controller.produce_diagnostics()[2]['steps']
        self.stamp_ns += NANOSECONDS // 100
        self._odom.publish(odometry(self.stamp_ns, linear))
        self.world.until(lambda: self.controller.produce_diagnostics()[2]['steps'] > count)

    def run(self, steps, linear=0.0):
        """Report a motion several times."""
        for _ in range(steps):
            self.report(linear)

    def newest(self):
        """Return the last command once all have come."""
        steps = self.controller.produce_diagnostics()[2]['steps']
        self.world.until(lambda: len(self.commands) >= steps)
        return self.commands[-1]


def test_without_odometry_the_controller_says_so_and_moves_nothing(world):
    controller = world.add(ControllerNode)
    reference = world.speak(Odometry, 'reference')
    commands = world.hear(Twist, 'cmd_vel')
    world.found(reference)
    reference.publish(odometry(NANOSECONDS, 0.2))
    said = world.diagnosis('controller')
    assert said.level == WARN
    assert said.message == 'stopped: no odometry'
    assert not any(message.linear.x or message.angular.z for message in commands)
    assert controller.produce_diagnostics()[2]['steps'] == 0


def test_a_stale_reference_gives_a_zero_command_with_the_reason(world):
    bench = Bench(world)
    controller = bench.controller
    bench.report()
    assert reason(controller) == 'stopped: no reference yet'
    bench.refer()
    bench.run(5)
    assert controller.produce_diagnostics()[:2] == (OK, 'tracking')
    assert bench.newest().linear.x > 0.0
    bench.run(30, linear=0.1)  # the reference ends after 0.1 s and is good for 0.15 s more
    assert controller.produce_diagnostics()[:2] == (ERROR, 'stopped: reference is stale')
    assert bench.newest() == Twist()
    said = world.diagnosis('controller')
    assert said.message != 'tracking'


def test_odometry_that_goes_silent_gives_zero_commands_with_the_reason(world):
    bench = Bench(world, odometry_timeout=0.2)
    controller = bench.controller
    bench.report()
    bench.refer()
    bench.run(5)
    world.until(lambda: any(message.linear.x > 0.0 for message in bench.commands))
    world.until(lambda: reason(controller) == 'stopped: no odometry')
    count = len(bench.commands)
    world.until(lambda: len(bench.commands) > count + 3, 'it keeps saying stop')
    assert bench.commands[-1] == Twist()


def test_odometry_or_reference_that_is_not_finite_moves_nothing(world):
    bench = Bench(world)
    controller = bench.controller
    bench.report()
    bench.refer(math.nan)
    bench.refer(0.1, math.inf)
    world.until(lambda: controller.produce_diagnostics()[2]['references_refused'] == 22)
    bench.report()
    assert reason(controller) == 'stopped: no reference yet'
    bench.refer()
    bench.run(3)
    assert controller.produce_diagnostics()[0] == WARN, 'tracking, but some were refused'
    assert bench.newest().linear.x > 0.0
    bench.report(math.nan)
    assert controller.produce_diagnostics()[:2] == (ERROR, 'stopped: odometry is not finite')
    assert bench.newest() == Twist()


def test_numbers_however_large_stop_the_robot_and_end_nobody(world):
    bench = Bench(world)
    odom = world.speak(Odometry, 'odom')
    bench.report()
    for value in (1e19, 1e160, 1e200, 1.7e308):
        bench.refer(seconds=0.0)
        bench.report()
        assert reason(bench.controller) == 'tracking'
        bad = odometry(bench.stamp_ns + 1, value, value)
        bad.pose.pose.position.x = bad.pose.pose.orientation.y = value
        steps = bench.controller.produce_diagnostics()[2]['steps']
        odom.publish(bad)
        world.until(lambda count=steps: bench.controller.produce_diagnostics()[2]['steps'] > count)
        assert bench.controller.produce_diagnostics()[0] == ERROR
        assert bench.newest() == Twist()
        bench.refer(value, -value)
        bench.run(60)  # it is held for half a second
        assert bench.controller.produce_diagnostics()[0] == ERROR
        assert bench.newest() == Twist()
        bench.run(80)
    assert all(math.isfinite(message.linear.x) for message in bench.commands)


def test_enable_and_disable(world):
    bench = Bench(world)
    controller = bench.controller
    bench.report()
    bench.refer(seconds=0.5)
    bench.run(5)
    assert bench.newest().linear.x > 0.0
    assert world.call(SetBool, 'controller/enable', data=False).success
    bench.run(2)
    assert controller.produce_diagnostics()[:2] == (ERROR, 'stopped: disabled by request')
    assert bench.newest() == Twist()
    assert world.call(SetBool, 'controller/enable', data=True).success
    bench.run(5)
    assert controller.produce_diagnostics()[:2] == (OK, 'tracking')
    assert bench.newest().linear.x > 0.0


def test_stamped_commands_carry_the_stamp_of_their_odometry_and_a_frame(world):
    bench = Bench(world, TwistStamped, stamped=True, frame_id='a/base')
    bench.report()
    bench.refer()
    bench.run(5)
    newest = bench.newest()
    assert stamp(newest) == bench.stamp_ns
    assert newest.header.frame_id == 'a/base'
    assert newest.twist.linear.x > 0.0
    count = len(bench.commands)
    bench.controller.finish()
    world.until(lambda: len(bench.commands) > count)
    assert bench.commands[-1].twist == Twist(), 'the last word is stop'


def test_what_was_learnt_survives_in_a_model_file_and_is_forgotten_by_reset(world, tmp_path):
    bench = Bench(world, model_output=str(tmp_path / 'model.npz'))

    def saved():
        answer = world.call(Trigger, 'controller/save_model')
        assert answer.success
        assert str(tmp_path / 'model.npz') in answer.message
        return load_model(tmp_path / 'model.npz')

    untaught = saved()
    bench.report()
    bench.refer(0.1, 1.0, seconds=0.8)
    bench.run(50)  # a robot that does not move although it should: much to learn
    learnt = saved()
    change = learnt['fuzzy.coefficients'] - untaught['fuzzy.coefficients']
    assert np.abs(change).max() > 1e-3

    files = {name: str(tmp_path / f'{name}.npz') for name in ('model', 'pupil')}
    world.add(ControllerNode, namespace='pupil', model=files['model'], model_output=files['pupil'])
    assert world.call(Trigger, 'pupil/controller/save_model').success
    taught = load_model(tmp_path / 'pupil.npz')
    assert taught.keys() == learnt.keys()
    for name in learnt:
        np.testing.assert_array_equal(taught[name], learnt[name])

    assert world.call(Trigger, 'controller/reset').success
    for name, value in saved().items():
        np.testing.assert_array_equal(value, untaught[name])
    bench.report()
    assert reason(bench.controller) == 'stopped: no reference yet', 'it earns its motion anew'


def test_a_model_that_cannot_be_written_or_used_is_named(world, tmp_path):
    world.add(ControllerNode, model_output=str(tmp_path / 'no' / 'folder.npz'))
    answer = world.call(Trigger, 'controller/save_model')
    assert not answer.success
    assert 'no/folder.npz' in answer.message
    small = world.add(
        ControllerNode,
        namespace='small',
        fuzzy__sets=5,
        model_output=str(tmp_path / 'small.npz'),
    )
    assert world.call(Trigger, 'small/controller/save_model').success
    world.remove(small)
    with pytest.raises(ModelError, match=r'small.npz does not fit these settings'):
        world.add(ControllerNode, namespace='other', model=str(tmp_path / 'small.npz'))


def test_numbers_are_published_at_their_rate_and_not_at_all_at_0(world):
    world.add(ControllerNode, namespace='quiet', terms_rate=0.0)
    bench = Bench(world, terms_rate=20.0)
    names = {
        name
        for name, kinds in world.probe.get_topic_names_and_types()
        if 'std_msgs/msg/Float64' in kinds
    }
    assert not any(name.startswith('/quiet/') for name in names)
    assert len(names) >= 20
    heard = {name: world.hear(Float64, name) for name in sorted(names)}
    for name in names:
        world.until(lambda topic=name: bench.controller.count_subscribers(topic) > 0)
    bench.report()
    bench.refer(seconds=0.9)
    bench.run(99)
    world.until(lambda: all(len(values) == 20 for values in heard.values()))
    # The estimate still hopes that the wheels do as they are told, which here they do not.
    assert heard['/controller/error/right'][-1].data == pytest.approx(-0.1 / 0.035, rel=0.03)
    for name in ('terms/applied/right', 'terms/feedback/left', 'lyapunov/value', 'skill/left'):
        assert math.isfinite(heard[f'/controller/{name}'][-1].data), name


def test_live_settings_of_the_controller_take_effect(world):
    bench = Bench(world)
    bench.report()
    bench.refer(0.3, seconds=0.5)
    bench.run(40)
    assert bench.newest().linear.x > 0.1
    lower = Parameter('linear.x.max_velocity', value=0.05)
    assert bench.controller.set_parameters([lower])[0].successful
    bench.refer(0.3, seconds=0.5)
    bench.run(40)
    assert bench.newest().linear.x == pytest.approx(0.05, abs=0.001)
    assert bench.controller.produce_diagnostics()[2]['limited']


# -- message types that do not fit ----------------------------------------------------------------


@pytest.mark.parametrize('stamped', [False, True])
def test_another_type_on_cmd_vel_is_a_warning_that_names_it(stamped, world):
    """ROS 2 connects only equal types and says nothing about the others."""
    robot = world.add(SimRobotNode, stamped=stamped)
    controller = world.add(ControllerNode, stamped=stamped)
    world.add(ReferenceGeneratorNode)
    world.until(lambda: reason(controller) == 'tracking' and is_well(robot, 'following commands'))
    other = Twist if stamped else TwistStamped
    stranger = world.stranger()
    stranger.create_publisher(other, 'cmd_vel', 10)
    stranger.create_subscription(other, 'cmd_vel', print, 10)

    words = f' geometry_msgs/msg/{other.__name__} '
    for node in (robot, controller):
        world.until(lambda one=node: words in reason(one), f'{node.get_name()} warns')
        said = world.diagnosis(node.get_name())
        assert said.level == WARN
        assert words in said.message


# -- parameters -----------------------------------------------------------------------------------


@pytest.mark.parametrize('name', list(PARAMETER_CLASSES))
def test_every_row_of_the_table_is_a_described_parameter(name, world, tmp_path):
    given = {'folder': str(tmp_path / 'bag')} if name == 'recorder' else {}
    node = world.add(NODES[name], **given)
    rows = PARAMETER_CLASSES[name].specs()
    assert rows
    for row in rows:
        described = node.describe_parameter(row.name)
        assert described.description.startswith(row.text)
        if row.unit:
            assert f'[{row.unit}]' in described.description, row.name
        assert described.additional_constraints == row.bounds()
        assert described.read_only == (not row.dynamic)
        if not row.many and (row.low is not None or row.high is not None):
            ranges = described.floating_point_range or described.integer_range
            assert len(ranges) == 1, row.name
            if row.low is not None:
                assert ranges[0].from_value == row.low, row.name
            if row.high is not None:
                assert ranges[0].to_value == row.high, row.name
        value = node.get_parameter(row.name).value
        if row.name not in given:
            assert (tuple(value) if row.many else value) == row.default, row.name


@pytest.mark.parametrize('name', ['controller', 'sim_robot'])
def test_every_live_setting_can_be_set_and_every_fixed_one_is_refused(name, world):
    node = world.add(NODES[name])
    for row in PARAMETER_CLASSES[name].specs():
        held = node.get_parameter(row.name)
        answer = node.set_parameters([held])[0]
        assert answer.successful == row.dynamic, row.name
        if not row.dynamic:
            assert row.name in answer.reason
            assert 'read-only' in answer.reason
            continue
        for edge in (row.low, row.high):
            if edge is None or row.kind is not float:
                continue
            outside = edge - 1.0 if edge == row.low else edge * 2.0
            answer = node.set_parameters([Parameter(row.name, value=outside)])[0]
            assert not answer.successful, row.name
            for word in (row.name, f'{edge}', f'{outside}'):
                assert word in answer.reason
        if row.kind is float:
            answer = node.set_parameters([Parameter(row.name, value=math.nan)])[0]
            assert not answer.successful, row.name
            assert row.name in answer.reason
        assert node.get_parameter(row.name).value == held.value


def test_settings_that_do_not_fit_together_are_refused_with_the_reason(world):
    robot = world.add(SimRobotNode)
    slow = Parameter('wheel.stop_deceleration', value=10.0)
    answer = robot.set_parameters([slow])[0]
    assert not answer.successful
    assert 'stop_deceleration must be at least acceleration (30 rad/s²): got 10' in answer.reason
    assert robot.parameters.limiter.stop_deceleration == 60.0
    both = [Parameter('wheel.max_acceleration', value=5.0), slow]
    assert robot.set_parameters_atomically(both).successful, 'together they fit'
    assert robot.parameters.limiter.stop_deceleration == 10.0
    with pytest.raises(ParameterError, match='drive.kind must be stepper or velocity'):
        world.add(SimRobotNode, namespace='other', drive__kind='torque')


def test_whole_numbers_and_empty_lists_are_taken_at_start(world, tmp_path):
    controller = world.add(ControllerNode, ['-p', 'law.gain:=5', '-p', 'rate:=50'])
    assert controller.parameters.law.gain == 5.0
    assert controller.get_parameter('rate').value == 50.0
    recorder = world.add(RecorderNode, folder=str(tmp_path), topics=[])
    assert recorder.parameters.topics == ()


def test_an_unknown_parameter_is_refused_with_the_nearest_name(world):
    with pytest.raises(ParameterError, match=r'no parameter law.gian; did you mean law.gain\?'):
        world.add(ControllerNode, law__gian=5.0)
    # What another node of the package knows may be said to all of them at once.
    world.add(ControllerNode, publish_clock=True)


# -- the reference --------------------------------------------------------------------------------


def test_the_reference_comes_on_an_exact_grid_ahead_by_the_lead(world):
    reference = world.add(
        ReferenceGeneratorNode, lead=0.5, frame_id='a/odom', child_frame_id='a/base', seed=7
    )
    heard = []
    world.probe.create_subscription(
        Odometry, 'reference', lambda m: heard.append((reference.now_ns(), m)), 100
    )
    world.until(lambda: len(heard) > 100)
    stamps = np.array([stamp(message) for _, message in heard])
    assert on_grid([message for _, message in heard], 100)
    ahead = (stamps - np.array([now for now, _ in heard])) / NANOSECONDS
    # A sample is never said before it is due, and soon afterwards if the machine is not busy.
    assert ahead.max() <= 0.5
    assert ahead.max() > 0.4
    newest = heard[-1][1]
    assert newest.header.frame_id == 'a/odom'
    assert newest.child_frame_id == 'a/base'


def test_latched_topics_of_the_reference_reach_those_who_come_late(world):
    reference = world.add(ReferenceGeneratorNode)
    world.until(lambda: reference.produce_diagnostics()[2]['mode'] != 'none')
    mode = reference.produce_diagnostics()[2]['mode']
    world.diagnosis('reference')  # the path follows once a second
    modes = reference.parameters.switching.modes
    signals = world.hear(Int32MultiArray, 'reference/signals', LATCHED)
    path = world.hear(Path, 'reference/path', LATCHED)
    world.until(lambda: signals and path)
    assert list(signals[0].data) == [mode, *modes[2 * mode : 2 * mode + 2]]
    assert path[0].header.frame_id == 'odom'
    stamps = np.array([stamp(pose) for pose in path[-1].poses])
    assert set(np.diff(stamps)) <= {NANOSECONDS // 10}


def test_a_paused_reference_stands_and_goes_on_where_it_was(world):
    reference = world.add(ReferenceGeneratorNode, ramp=0.0)
    heard = world.hear(Odometry, 'reference')
    world.until(lambda: heard and speed(heard[-1]) > 0.0)
    assert world.call(SetBool, 'reference/pause', data=True).success
    world.until(lambda: speed(heard[-1]) == 0.0)
    held = heard[-1].pose.pose
    count = len(heard)
    world.until(lambda: len(heard) > count + 10, 'it goes on saying where to stand')
    assert all(speed(message) == 0.0 for message in heard[count:])
    assert heard[-1].pose.pose == held
    assert reason(reference) == 'paused'
    assert world.call(SetBool, 'reference/pause', data=False).success
    world.until(lambda: speed(heard[-1]) > 0.0)
    assert on_grid(heard, 100)


def _twists(heard, count):
    return [(m.twist.twist.linear.x, m.twist.twist.angular.z) for m in heard[:count]]


def test_one_seed_gives_one_reference(world):
    heard = []
    for name, seed in (('a', 3), ('b', 3), ('c', 4)):
        heard.append(world.hear(Odometry, f'{name}/reference'))
        world.add(ReferenceGeneratorNode, namespace=name, seed=seed, ramp=0.0)
    world.until(lambda: min(map(len, heard)) >= 50)
    first, same, other = (_twists(messages, 50) for messages in heard)
    assert first == same
    assert first != other


def test_reseed_starts_another_reference_and_tells_nobody_the_seed(world):
    """The answer once held the new seed: whoever knows it knows the patrol."""
    seed = 918_273_645
    log = world.hear(Log, '/rosout', LATCHED)
    reference = world.add(ReferenceGeneratorNode, seed=seed, ramp=1.0)
    heard = world.hear(Odometry, 'reference')
    world.until(lambda: len(heard) > 150)
    answer = world.call(Trigger, 'reference/reseed')
    assert answer.success
    count = len(heard)
    world.until(lambda: len(heard) > count + 100)
    said = world.diagnosis('reference')
    telling = [answer.message, str(said), *(entry.msg for entry in log)]
    for text in telling:
        assert not any(character.isdigit() for character in str(answer.message))
        for number in range(seed - 2, seed + 3):
            assert str(number) not in text
    # It grows from zero again, so a robot at rest can follow.
    assert min(speed(message) for message in heard[140:]) < 1e-3
    assert on_grid(heard, 100)
    assert reference.get_parameter('seed').value == seed


# -- diagnostics ----------------------------------------------------------------------------------


def test_every_node_says_how_it_is_once_a_second(world, tmp_path):
    stamps = {}
    world.probe.create_subscription(
        DiagnosticArray,
        '/diagnostics',
        lambda m: stamps.setdefault(m.status[0].name, []).append(time.monotonic()),
        100,
    )
    for name, kind in NODES.items():
        if name != 'recorder':
            world.add(kind)
    world.add(RecorderNode, folder=str(tmp_path / 'bag'))
    world.add(ComposedNode, namespace='two')
    world.until(lambda: stamps.keys() == {*PARAMETER_CLASSES, 'two/all_in_one'})
    world.until(lambda: all(len(times) >= 4 for times in stamps.values()))
    for name, times in stamps.items():
        assert 0.5 < (times[-1] - times[0]) / (len(times) - 1) < 2.0, name
    expected = {'controller': 'tracking', 'recorder': 'recording', 'reference': 'running'}
    world.until(
        lambda: all(world.said(name)[-1].message == text for name, text in expected.items())
    )
    for name in expected:
        said = world.said(name)[-1]
        assert said.level == OK
        assert said.hardware_id
        assert said.values


# -- simulated time -------------------------------------------------------------------------------


def test_the_loop_closes_in_the_time_of_the_simulated_clock(world):
    world.add(SimRobotNode, publish_clock=True)
    controller = world.add(ControllerNode, use_sim_time=True)
    reference = world.add(ReferenceGeneratorNode, use_sim_time=True)
    odom = world.hear(Odometry, 'odom')
    heard = world.hear(Odometry, 'reference')
    world.until(lambda: reason(controller) == 'tracking')
    world.until(lambda: speed(odom[-1]) > 0.02, 'the robot follows')
    away = stamp(heard[-1]) - stamp(odom[-1])
    assert abs(away) < 2 * NANOSECONDS
    for node in (controller, reference):
        assert abs(node.now_ns() - stamp(odom[-1])) < 2 * NANOSECONDS
    assert reference.produce_diagnostics()[2]['skipped_samples'] < 1000


def test_a_clock_that_jumps_back_ends_in_tracking_again(world, tmp_path):
    """Before the clock is first heard a node's time is 0; that was taken for a grid once."""
    clock = world.speak(Clock, '/clock')
    offset_ns = [10**6 * NANOSECONDS]

    def now_ns():
        return offset_ns[0] + time.monotonic_ns()

    kinds = (SimRobotNode, ControllerNode, ReferenceGeneratorNode)
    robot, controller, reference = (world.add(kind, use_sim_time=True) for kind in kinds)
    world.add(RecorderNode, use_sim_time=True, folder=str(tmp_path / 'bag'))
    odom = world.hear(Odometry, 'odom')
    world.found(clock, 4)
    # The nodes run for a while before the clock does.
    for node in (controller, reference):
        world.diagnosis(node.get_name())
    assert not odom
    world.keep_saying(clock, lambda: Clock(clock=conversions.time_from_ns(now_ns())), 0.01)
    world.until(lambda: reason(controller) == 'tracking')
    world.until(lambda: speed(odom[-1]) > 0.02)
    for node in (robot, reference):
        assert node.produce_diagnostics()[2]['skipped_samples'] == 0

    before_ns = stamp(odom[-1])
    offset_ns[0] -= 100 * NANOSECONDS
    world.until(lambda: stamp(odom[-1]) < before_ns - 50 * NANOSECONDS)
    count = len(odom)
    world.until(lambda: reason(controller) == 'tracking' and len(odom) > count + 50)
    world.until(lambda: speed(odom[-1]) > 0.02, 'the robot follows again')
    assert on_grid(odom[count:], 100)


# -- names ----------------------------------------------------------------------------------------


def test_robots_in_two_namespaces_do_not_hear_each_other(world):
    for name in ('a', 'b'):
        world.add(SimRobotNode, namespace=name)
    world.add(ControllerNode, namespace='a')
    world.add(ReferenceGeneratorNode, namespace='a')
    odom = {name: world.hear(Odometry, f'/{name}/odom') for name in ('a', 'b')}
    foreign = world.hear(Twist, '/b/cmd_vel')
    world.until(lambda: odom['a'] and speed(odom['a'][-1]) > 0.05)
    assert odom['b']
    assert max(map(speed, odom['b'])) < 1e-3
    assert not foreign
    world.until(lambda: world.said('a/sim_robot') and world.said('b/sim_robot'))
    assert world.call(SetBool, '/b/e_stop', data=True).success
    count = len(odom['a'])
    world.until(lambda: len(odom['a']) > count + 20)
    assert speed(odom['a'][-1]) > 0.0


def test_topics_can_be_remapped(world):
    world.add(SimRobotNode, ['-r', 'cmd_vel:=/steer', '-r', 'odom:=wheels/odom'])
    controller = world.add(ControllerNode, ['-r', 'cmd_vel:=/steer', '-r', 'odom:=wheels/odom'])
    world.add(ReferenceGeneratorNode)
    commands = world.hear(Twist, '/steer')
    world.until(lambda: reason(controller) == 'tracking' and commands)
    assert not world.probe.get_publishers_info_by_topic('/cmd_vel')
    assert not world.probe.get_publishers_info_by_topic('/odom')


# -- all in one process ---------------------------------------------------------------------------


@pytest.fixture
def together(graph, tmp_path):
    """Return a function that makes ``all_in_one`` as its command line would."""
    nodes = []

    def make(*parameters):
        words = [f'folder:={tmp_path}', *parameters]
        rclpy.init(args=['--ros-args', *(word for item in words for word in ('-p', item))])
        nodes.extend(composed.make())
        return {node.get_name(): node for node in nodes}

    yield make
    for node in nodes:
        node.finish()
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize('order', ['', 'nodes:=[recorder, controller, sim_robot, reference]'])
def test_all_in_one_runs_with_stamped_commands_in_any_order(order, together, tmp_path):
    """The recorder expected a Twist, and ROS refuses a second type in one process."""
    nodes = together('stamped:=true', *filter(None, [order]))
    assert nodes.keys() == PARAMETER_CLASSES.keys() - {'radio_bridge', 'replayer'}
    executor = SingleThreadedExecutor()
    for node in nodes.values():
        executor.add_node(node)
    deadline = time.monotonic() + PATIENCE
    while not is_well(nodes['sim_robot'], 'following commands'):
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.05)
    while not nodes['recorder'].count_subscribers('cmd_vel') > 1:
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.05)
    executor.shutdown()


def test_nodes_that_want_one_topic_in_two_types_cannot_share_a_process(together):
    with pytest.raises(ParameterError, match='controller cannot share a process with sim_robot'):
        together('controller:stamped:=true')


# -- the recorder ---------------------------------------------------------------------------------


def _count(world, recorder, count):
    world.until(lambda: recorder.produce_diagnostics()[2]['messages'] >= count)


def _recorder(world, folder, *topics, **more):
    return world.add(RecorderNode, folder=str(folder), topics=list(topics), **more)


def test_a_type_that_is_not_installed_is_left_out_with_a_warning(world, tmp_path, monkeypatch):
    log = world.hear(Log, '/rosout', LATCHED)
    marker, message = world.speak(Marker, 'marker'), Marker()
    text = world.speak(String, 'text')
    monkeypatch.setitem(sys.modules, 'visualization_msgs.msg', None)
    recorder = _recorder(world, tmp_path, 'marker', 'text')
    world.found(text)
    world.until(lambda: any('/marker is not recorded' in entry.msg for entry in log))
    marker.publish(message)
    text.publish(String(data='hello'))
    _count(world, recorder, 1)
    warned = [entry for entry in log if '/marker' in entry.msg]
    assert len(warned) == 1, 'said once'
    assert warned[0].level == 30
    assert recorder.produce_diagnostics()[0] == OK
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert list(recording.topics) == ['/text']


def test_publishers_that_offer_less_are_recorded_too(world, tmp_path):
    """The recorder waits for odometry as reliable, and once did not hear a robot that is not."""
    recorder = _recorder(world, tmp_path, 'odom', 'other')
    weak = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publishers = world.speak(Odometry, 'odom', weak), world.speak(Odometry, 'other', weak)
    for publisher in publishers:
        world.found(publisher)
        publisher.publish(odometry(NANOSECONDS, 0.25))
    _count(world, recorder, 2)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert {name: topic.message_count for name, topic in recording.topics.items()} == {
            '/odom': 1,
            '/other': 1,
        }
        assert recording.series('/odom', {'v': 'twist.twist.linear.x'})['v'][0] == 0.25


def test_a_second_publisher_that_offers_less_is_recorded_as_well(world, tmp_path):
    recorder = _recorder(world, tmp_path, 'text')
    strong = world.speak(String, 'text')
    world.found(strong)
    strong.publish(String(data='strong'))
    _count(world, recorder, 1)
    weak = world.speak(
        String, 'text', QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    world.found(weak)
    world.found(strong)
    weak.publish(String(data='weak'))
    strong.publish(String(data='strong again'))
    _count(world, recorder, 3)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        heard = {message.data for _, message in recording.messages('/text')}
    assert heard == {'strong', 'weak', 'strong again'}


def test_stamped_commands_are_recorded_as_what_they_are(world, tmp_path):
    """The recorder expects a Twist on cmd_vel, and once heard nothing when it was stamped."""
    recorder = _recorder(world, tmp_path, 'cmd_vel')
    commands = world.stranger().create_publisher(TwistStamped, 'cmd_vel', 10)
    world.found(commands)
    commands.publish(TwistStamped(twist=twist(0.5)))
    _count(world, recorder, 1)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert recording.topics['/cmd_vel'].type_name == 'geometry_msgs/msg/TwistStamped'
        assert recording.series('/cmd_vel', {'v': 'twist.linear.x'})['v'][0] == 0.5


def test_a_topic_that_changes_its_type_does_not_end_the_recording(world, tmp_path):
    log = world.hear(Log, '/rosout', LATCHED)
    recorder = _recorder(world, tmp_path, 'cmd_vel', 'text')
    first = world.speak(Twist, 'cmd_vel')
    text = world.speak(String, 'text')
    world.found(first)
    world.found(text)
    first.publish(twist(0.5))
    _count(world, recorder, 1)
    world.probe.destroy_publisher(first)
    second = world.stranger().create_publisher(TwistStamped, 'cmd_vel', 10)
    world.found(second)
    second.publish(TwistStamped())
    world.until(lambda: any('/cmd_vel is not recorded' in entry.msg for entry in log))
    text.publish(String(data='still here'))
    _count(world, recorder, 2)
    assert recorder.produce_diagnostics()[0] == OK
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert recording.topics['/cmd_vel'].message_count == 1
        assert recording.topics['/text'].message_count == 1


def test_latched_messages_from_before_the_recorder_came_are_recorded(world, tmp_path):
    latched = world.speak(String, 'map', LATCHED)
    latched.publish(String(data='once'))
    recorder = _recorder(world, tmp_path, 'map')
    _count(world, recorder, 1)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert [message.data for _, message in recording.messages('/map')] == ['once']


def test_split_goes_on_in_another_file_and_loses_nothing(world, tmp_path):
    recorder = _recorder(world, tmp_path, 'text')
    text = world.speak(String, 'text')
    world.found(text)
    for part in range(3):
        for number in range(5):
            text.publish(String(data=f'{part} {number}'))
        _count(world, recorder, 5 * (part + 1))
        if part < 2:
            answer = world.call(Trigger, 'recorder/split')
            assert answer.success
            assert f'_{part + 1}.mcap' in answer.message
    world.remove(recorder)
    assert len(list(tmp_path.glob('*.mcap'))) == 3
    with open_bag(tmp_path) as recording:
        heard = [message.data for _, message in recording.messages('/text')]
    assert heard == [f'{part} {number}' for part in range(3) for number in range(5)]


def test_a_full_disk_ends_the_recording_and_nothing_else(world, tmp_path, monkeypatch):
    log = world.hear(Log, '/rosout', LATCHED)
    recorder = _recorder(world, tmp_path, 'odom')
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.2)
    _count(world, recorder, 5)

    def full(*_):
        raise DiskError('recording into x failed: No space left on device; 5 messages are kept')

    monkeypatch.setattr(BagWriter, 'write', full)
    world.until(lambda: recorder.exit_code == 1)
    assert recorder.produce_diagnostics()[0] == ERROR
    said = world.diagnosis('recorder')
    assert said.level == ERROR
    assert 'No space left on device' in said.message
    assert [entry.level for entry in log if 'No space left' in entry.msg] == [40]
    answer = world.call(Trigger, 'recorder/split')
    assert not answer.success, 'a recording that has failed cannot go on'
    assert 'No space left' in answer.message
    count = len(odom)
    world.until(lambda: len(odom) > count + 20)
    assert is_well(robot, 'following commands')
    assert robot.exit_code == 0


def test_the_settings_of_every_robot_in_the_graph_are_kept_apart(world, tmp_path):
    """Two controllers share a name in two namespaces; one's gain once stood for the other's."""
    recorder = _recorder(world, tmp_path, 'odom', namespace='a')
    world.add(ControllerNode, namespace='a', law__gain=3.0)
    world.add(ControllerNode, namespace='b', law__gain=4.0)
    world.until(lambda: len(recorder._details) >= 4)  # provenance, itself, two controllers
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert recording.metadata_records['controller']['law.gain'] == '3.0'
        assert recording.metadata_records['/b/controller']['law.gain'] == '4.0'
        assert recording.metadata_records['recorder']['folder'] == str(tmp_path)
