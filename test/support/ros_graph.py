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
"""Harness for node tests: nodes of the package and a probe node in one executor over real DDS."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from support.waiting import wait_until
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import OK
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.node_main import make_executor
from t3mpc_ros.nodes.recorder import RecorderNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode

LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class NodeHarness:
    """Nodes in one executor, and a probe node that publishes, subscribes and calls services."""

    def __init__(self):
        self._executor = make_executor()
        self._nodes = []
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._foreign_nodes = []
        self.probe = Node('probe')
        self._executor.add_node(self.probe)
        self._diagnostics = self.subscribe(DiagnosticArray, '/diagnostics')

    def add(self, node_class, arguments=(), namespace=None, **parameters):
        """Return a new node of the package; ``law__gain=5.0`` sets ``law.gain``."""
        node = node_class(
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
        """Shut one node down as its process does."""
        self._executor.remove_node(node)
        # The events executor still runs what happened before.
        left = self._executor.create_task(lambda: None)
        self.spin_until(left.done)
        node.on_shutdown()
        self._nodes.remove(node)
        node.destroy_node()

    def foreign_node(self):
        """Return a node of another context, which may use a topic with another type."""
        context = rclpy.Context()
        rclpy.init(args=[], context=context)
        self._foreign_nodes.append(Node('foreign', context=context))
        return self._foreign_nodes[-1]

    def add_foreign(self, node, executor=None):
        """Spin a node that is not one of the package's executables; the test spins an executor."""
        (executor or self._executor).add_node(node)
        self._foreign_nodes.append(node)

    def _spin_once(self) -> None:
        """Let the nodes work; the events executor of rclpy 7.1 fails at times as a node leaves."""
        try:
            self._executor.spin_once(timeout_sec=0.05)
        except SystemError as error:
            if 'null argument' not in str(error):
                raise

    def spin_until(self, condition, description=''):
        """Spin until ``condition`` holds."""
        wait_until(condition, description, step=self._spin_once)

    def in_thread(self, function, *arguments, spin_until=None):
        """Return the result of a function that waits for the nodes, which spin meanwhile."""
        with ThreadPoolExecutor(1) as pool:
            reply = pool.submit(function, *arguments)
            (spin_until or self.spin_until)(reply.done)
        return reply.result()

    def subscribe(self, message_type, topic, qos=100):
        """Return a list to which the messages of a topic are appended."""
        received = []
        self.probe.create_subscription(message_type, topic, received.append, qos)
        return received

    def create_publisher(self, message_type, topic, qos=100):
        """Return a publisher of the probe node."""
        return self.probe.create_publisher(message_type, topic, qos)

    def wait_for_subscriber(self, publisher, count=1):
        """Spin until ``publisher`` has ``count`` subscribers."""
        self.spin_until(
            lambda: publisher.get_subscription_count() >= count,
            f'{publisher.topic} has no subscriber',
        )

    def connected_publisher(self, message_type, topic, qos=100):
        """Return a publisher of the probe node once it has a subscriber."""
        publisher = self.create_publisher(message_type, topic, qos)
        self.wait_for_subscriber(publisher)
        return publisher

    def publish_periodically(self, publisher, make, period=0.02):
        """Publish ``make()`` periodically, except while it is None."""

        def publish():
            message = make()
            if message is not None:
                publisher.publish(message)

        self.probe.create_timer(period, publish, clock=self._steady)

    def call(self, service_type, name, **request):
        """Return the response of a service."""
        client = self.probe.create_client(service_type, name)
        self.spin_until(client.service_is_ready, f'no service {name}')
        future = client.call_async(service_type.Request(**request))
        self.spin_until(future.done, f'no response of {name}')
        self.probe.destroy_client(client)
        return future.result()

    def done(self, service_type, name, **request):
        """Return what a service has done; fail if it was refused."""
        response = self.call(service_type, name, **request)
        assert response.success, response.message
        return response.message

    def refused(self, service_type, name, **request):
        """Return why a service was refused; fail if it was not."""
        response = self.call(service_type, name, **request)
        assert not response.success, response.message
        return response.message

    def statuses(self, name):
        """Return the diagnostic statuses of one node so far."""
        return [
            status for array in self._diagnostics for status in array.status if status.name == name
        ]

    def next_status(self, name):
        """Return the next diagnostic status of one node."""
        before = len(self.statuses(name))
        self.spin_until(lambda: len(self.statuses(name)) > before, f'no diagnostics of {name}')
        return self.statuses(name)[-1]

    def close(self):
        for node in list(self._nodes):
            self.remove(node)
        self._executor.remove_node(self.probe)
        self._executor.shutdown()
        self.probe.destroy_node()
        for node in self._foreign_nodes:
            node.destroy_node()
            if node.context is not self.probe.context:
                rclpy.try_shutdown(context=node.context)


class CommandSource:
    """Publishes one command periodically, as a teleoperation node does."""

    def __init__(self, harness, message=None, topic='cmd_vel'):
        self.message = message
        publisher = harness.create_publisher(Twist, topic)
        harness.publish_periodically(publisher, lambda: self.message)


def driving_robot(harness, linear):
    """Return a simulated robot, its odometry and the source of its commands, once it drives."""
    robot = harness.add(SimRobotNode)
    odom = harness.subscribe(Odometry, 'odom')
    source = CommandSource(harness, twist(linear))
    harness.spin_until(lambda: odom and speed(odom[-1]) > 0.9 * linear, 'the robot drives')
    return robot, odom, source


def record(harness, folder, *topics, **parameters):
    """Return a recorder of some topics."""
    parameters |= {'storage__uri': str(folder), 'record__topics': list(topics)}
    return harness.add(RecorderNode, **parameters)


@contextmanager
def recorded(harness, recorder):
    """End a recorder and yield its bag."""
    harness.remove(recorder)
    with open_bag(recorder.parameters.uri) as recording:
        yield recording


class ControllerHarness:
    """A controller with odometry and reference of the test, stamped without a clock."""

    def __init__(self, harness, message_type=Twist, odometry_timeout=5.0, **parameters):
        self.harness = harness
        # Long, so that a stall of the machine is no odometry timeout.
        parameters['watchdog.odometry_timeout'] = odometry_timeout
        self.controller = controller = harness.add(ControllerNode, **parameters)
        self.commands = harness.subscribe(message_type, 'cmd_vel')
        self.odom_publisher = harness.create_publisher(Odometry, 'odom')
        self.reference_publisher = harness.create_publisher(Odometry, 'reference')
        self.stamp_ns = NANOSECONDS
        harness.wait_for_subscriber(self.odom_publisher)
        harness.wait_for_subscriber(self.reference_publisher)
        harness.spin_until(lambda: controller.count_subscribers('cmd_vel') > 0)

    def publish_reference(self, linear=0.1, angular=0.0, seconds=0.1):
        """Publish a constant reference from now on; up to one second of it is queued."""
        for step in range(round(seconds * 100) + 1):
            stamp_ns = self.stamp_ns + step * NANOSECONDS // 100
            self.reference_publisher.publish(odometry(stamp_ns, linear, angular))

    def publish_odometry(self, linear=0.0):
        """Publish one odometry message and wait for the step of the controller."""
        count = diagnostic(self.controller, 'steps')
        self.stamp_ns += NANOSECONDS // 100
        self.odom_publisher.publish(odometry(self.stamp_ns, linear))
        self.harness.spin_until(lambda: diagnostic(self.controller, 'steps') > count)

    def run(self, steps, linear=0.0):
        """Publish several odometry messages with one velocity."""
        for _ in range(steps):
            self.publish_odometry(linear)

    def last_command(self):
        """Return the last command once all have been received."""
        steps = diagnostic(self.controller, 'steps')
        self.harness.spin_until(lambda: len(self.commands) >= steps)
        return self.commands[-1]


def diagnostic_level(node):
    """Return the diagnostic level of a node."""
    return node.produce_diagnostics()[0]


def reason(node):
    """Return the diagnostic message of a node."""
    return node.produce_diagnostics()[1]


def diagnostic(node, key):
    """Return a diagnostic value of a node, None without it."""
    return node.produce_diagnostics()[2].get(key)


def is_ok(node, message):
    """Return whether a node reports this message at level OK, or an overload of the machine."""
    return (diagnostic_level(node), reason(node)) == (
        OK,
        message,
    ) or 'processor overloaded' in reason(node)


def on_grid(messages, rate):
    """Return whether all stamps lie on one time grid, in ascending order."""
    steps = np.diff([stamp(message) for message in messages])
    return len(steps) > 0 and min(steps) > 0 and not np.any(steps % (NANOSECONDS // rate))


def twist(linear=0.0, angular=0.0):
    message = Twist()
    message.linear.x = linear
    message.angular.z = angular
    return message


def odometry(stamp_ns, linear=0.0, angular=0.0):
    message = Odometry()
    message.header.stamp = ros_messages.time_from_ns(stamp_ns)
    message.pose.pose.orientation.w = 1.0
    message.twist.twist = twist(linear, angular)
    return message


def stamp(message):
    return ros_messages.ns_from_time(message.header.stamp)


def speed(message):
    """Return the larger of |v| and the share of |omega| in a wheel speed, m/s."""
    now = message.twist.twist
    return max(abs(now.linear.x), 0.0735 * abs(now.angular.z))
