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
"""Nodes in one graph or process: diagnostics, named mistakes, simulated time, names, frames."""

import math
import platform
import sys
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, Range
from std_srvs.srv import SetBool
from support.long_tests import few_of
from support.ros_graph import (
    LATCHED,
    diagnostic,
    diagnostic_level,
    is_ok,
    odometry,
    on_grid,
    reason,
    speed,
    stamp,
    twist,
)
from support.waiting import wait_until

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import ERROR, OK, WARN
from t3mpc_ros.nodes.composed import ComposedNode
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.node_main import make_executor
from t3mpc_ros.nodes.recorder import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.registry import NODES, node_class
from t3mpc_ros.nodes.ros_messages import FrameParameters
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

# -- diagnostics ----------------------------------------------------------------------------------


@pytest.mark.ros
@pytest.mark.timed
def test_every_node_publishes_diagnostics_at_1_hz(harness, tmp_path):
    stamps = {}
    harness.probe.create_subscription(
        DiagnosticArray,
        '/diagnostics',
        lambda m: stamps.setdefault(m.status[0].name, []).append(
            m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec
        ),
        100,
    )
    given = {
        'recorder': {'storage__uri': str(tmp_path / 'bag')},
        'sim_robot': {'seed': 7},
        'radio_bridge': {'port': '/dev/no_dongle'},
    }
    # The controller warns of two robots with one odom.
    arguments = {'radio_bridge': ['-r', 'odom:=bridge/odom']}
    for name in sorted(NODES, key='recorder'.__eq__):
        harness.add(node_class(name), arguments.get(name, ()), **given.get(name, {}))
    harness.add(ComposedNode, namespace='two')
    harness.spin_until(lambda: stamps.keys() == {*NODES, 'two/composed'})
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
        assert (status.level, status.hardware_id) == (OK, platform.node())
        assert status.values
    assert harness.statuses('sim_robot')[-1].hardware_id == 'simulated robot 7'
    assert harness.statuses('radio_bridge')[-1].hardware_id == '/dev/no_dongle'
    for times in stamps.values():  # what changes is published at once
        times.clear()
    harness.spin_until(lambda: all(len(times) >= 4 for times in stamps.values()))
    for name, times in stamps.items():
        assert 0.5 < (times[-1] - times[0]) / (len(times) - 1) < 2.0, name


def wait_for_warning(harness, name, words, levels=(WARN, ERROR)):
    """Wait until the diagnostics of a node contain some words; they have one of the levels."""
    harness.spin_until(lambda: words in harness.next_status(name).message, f'{name}: {words}')
    assert harness.statuses(name)[-1].level in levels


@pytest.mark.ros
@pytest.mark.parametrize('stamped', few_of([False, True]))
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
    for node in (robot, controller):
        words = f' geometry_msgs/msg/{other.__name__} '
        wait_for_warning(harness, node.get_name(), words, [WARN])


@pytest.mark.ros
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


@pytest.mark.ros
def test_two_publishers_of_commands_are_named(harness):
    harness.add(SimRobotNode)
    harness.add(ControllerNode)
    harness.create_publisher(Twist, 'cmd_vel')
    for name in ('sim_robot', 'controller'):
        wait_for_warning(harness, name, '/cmd_vel has 2 publishers: /controller, /probe')


@pytest.mark.ros
@pytest.mark.parametrize('topic', ['odom', 'reference'])
def test_two_publishers_of_an_input_are_named(topic, harness):
    """The controller reported *tracking*, or named a bad link."""
    controller = harness.add(ControllerNode)
    other = Node('other')
    harness.add_foreign(other)
    publishers = [node.create_publisher(Odometry, topic, 100) for node in (harness.probe, other)]
    words = f'/{topic} has 2 publishers: /other, /probe; stop all but one'
    wait_for_warning(harness, 'controller', f'{words}; one that was killed leaves this list')
    for publisher in publishers:
        harness.publish_periodically(publisher, lambda: odometry(controller.now_ns(), 0.0))
    undecided = 'was killed'
    harness.spin_until(
        lambda: (
            words in (text := harness.next_status('controller').message) and undecided not in text
        )
    )


@pytest.mark.ros
@pytest.mark.parametrize('kind, level', [(ControllerNode, WARN), (SimRobotNode, ERROR)])
def test_simulated_time_without_a_clock_is_named(kind, level, harness):
    node = harness.add(kind, use_sim_time=True)
    wait_for_warning(harness, node.get_name(), 'no message on /clock yet', [level])


# -- simulated time -------------------------------------------------------------------------------


@pytest.mark.ros
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


@pytest.mark.ros
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
        clock, lambda: Clock(clock=ros_messages.time_from_ns(now_ns())), 0.01
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


# -- names and frames -----------------------------------------------------------------------------


@pytest.mark.ros
def test_topics_can_be_remapped_and_keep_no_old_messages(harness):
    """Old odometry would look like a moving robot."""
    names = ['-r', 'cmd_vel:=/steer', '-r', 'odom:=wheels/odom']
    harness.add(SimRobotNode, names)
    controller = harness.add(ControllerNode, names)
    harness.add(ReferenceGeneratorNode)
    commands = harness.subscribe(Twist, '/steer')
    harness.spin_until(lambda: reason(controller) == 'tracking' and commands)
    for topic in ('/wheels/odom', '/reference'):
        (offer,) = harness.probe.get_publishers_info_by_topic(topic)
        assert offer.qos_profile.durability == DurabilityPolicy.VOLATILE
    for topic in ('/cmd_vel', '/odom'):
        assert not harness.probe.get_publishers_info_by_topic(topic)


@pytest.mark.parametrize(
    'values, namespace, expected',
    [
        ({}, '/', 'odom'),
        ({}, '/robot_1', 'robot_1/odom'),
        ({}, '/fleet/robot_1', 'fleet/robot_1/odom'),
        ({'tf_frame_prefix': 'left'}, '/', 'left/odom'),
        ({'tf_frame_prefix': '/left/'}, '/robot_1', 'left/odom'),
        ({'tf_frame_prefix_enable': False}, '/robot_1', 'odom'),
    ],
)
def test_a_frame_is_prefixed_by_the_namespace(values, namespace, expected):
    frames = FrameParameters.from_dict(values)
    assert frames.prefixed('odom', namespace) == expected
    assert frames.prefixed(expected, namespace) == expected, 'not twice'


@pytest.mark.ros
def test_the_frames_of_a_namespace_have_its_prefix(harness):
    """Two robots published the transforms of one frame ``odom``."""
    wanted = {
        'odom': (Odometry, 'one/odom'),
        'ground_truth/odom': (Odometry, 'map'),
        'reference': (Odometry, 'one/odom'),
        'cmd_vel': (TwistStamped, 'one/base_link'),
        'imu/data_raw': (Imu, 'one/imu_link'),
        'range/front_left': (Range, 'one/front_left_range_link'),
    }
    received = {name: harness.subscribe(kind, f'one/{name}') for name, (kind, _) in wanted.items()}
    paths = harness.subscribe(Path, 'one/reference/path', LATCHED)
    for kind in (SimRobotNode, ControllerNode):
        harness.add(kind, namespace='one', enable_stamped_cmd_vel=True)
    harness.add(ReferenceGeneratorNode, namespace='one')
    harness.spin_until(lambda: all(received.values()) and paths)
    for name, (kind, frame) in wanted.items():
        message = received[name][-1]
        assert message.header.frame_id == frame, name
        if kind is Odometry:
            assert message.child_frame_id == 'one/base_link', name
    assert {paths[-1].header.frame_id, paths[-1].poses[-1].header.frame_id} == {'one/odom'}
    # That of an exact pose was exactly 0, which filters cannot invert.
    covariance = np.reshape(received['odom'][0].pose.covariance, (6, 6))
    assert np.linalg.eigvalsh(covariance).min() > 1e-7


@pytest.mark.ros
def test_the_map_frame_puts_the_robot_at_its_true_pose(harness, monkeypatch):
    """Nothing led from the frame of the ground truth to that of the odometry."""
    sent = []
    broadcaster = SimpleNamespace(sendTransform=sent.append)
    tf2_ros = SimpleNamespace(TransformBroadcaster=lambda node: broadcaster)
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    start = {'initial_pose.x': 1.0, 'initial_pose.y': -0.5, 'initial_pose.yaw': 2.0}
    off = {'enable_static_tf': False, 'noise.variance': 0.5}
    harness.add(SimRobotNode, namespace='one', enable_map_tf=True, **off, **start)
    truths = harness.subscribe(Odometry, 'one/ground_truth/odom')
    commands = harness.connected_publisher(Twist, 'one/cmd_vel')

    def moved():
        commands.publish(twist(0.3, 1.0))
        return len(truths) > 60

    harness.spin_until(moved)
    assert truths[-1].pose.covariance[0] == truths[-1].pose.covariance[35] == 1e-6
    assert truths[-1].twist.covariance[0] == truths[-1].twist.covariance[35] == 1e-6
    by_stamp = {stamp(message): message.pose.pose for message in truths}
    checked = 0
    for odom, origin in sent:
        assert [odom.header.frame_id, odom.child_frame_id] == ['one/odom', 'one/base_link']
        assert [origin.header.frame_id, origin.child_frame_id] == ['map', 'one/odom']
        true = by_stamp.get(ros_messages.ns_from_time(odom.header.stamp))
        if true is None:
            continue
        checked += 1
        turn, half = yaw_of(origin.transform.rotation), yaw_of(odom.transform.rotation)
        x, y = odom.transform.translation.x, odom.transform.translation.y
        place = origin.transform.translation
        assert place.x + x * math.cos(turn) - y * math.sin(turn) == pytest.approx(true.position.x)
        assert place.y + x * math.sin(turn) + y * math.cos(turn) == pytest.approx(true.position.y)
        assert math.remainder(turn + half - yaw_of(true.orientation), math.tau) == pytest.approx(0)
    assert checked > 40


def yaw_of(rotation):
    return 2.0 * math.atan2(rotation.z, rotation.w)


@pytest.mark.parametrize(
    ('names', 'words'),
    [
        ('a', ''),
        ('aa', 'has 2 publishers: /a, /a; stop all but one'),
        ('ab', 'has 2 publishers: /a, /b; stop all but one'),
        ('aab', 'has 3 publishers: /a, /a, /b; stop all but one'),
    ],
)
def test_no_living_publisher_is_said_to_be_dead(names, words):
    """Two living controllers were reported for 20 s as one that had ended without notice."""
    infos = [SimpleNamespace(node_name=name, node_namespace='/') for name in names]
    node = SimpleNamespace(get_publishers_info_by_topic=lambda topic: infos)
    assert topic_endpoints.publishers_problem(node, '/odom', alive=True) == (
        words and f'/odom {words}'
    )
    doubtful = topic_endpoints.publishers_problem(node, '/odom', alive=False)
    assert doubtful.startswith(words and f'/odom {words}')
    assert ('was killed leaves this list within 20 s' in doubtful) == bool(words)


@pytest.mark.parametrize(
    ('numbers', 'several'),
    [
        ([], False),
        ([1, 2, 3, 7, 8], False),
        ([901, 902, 1, 2, 3], False),  # restarted
        ([901, 1, 902, 2, 903, 3], True),
        ([4, 4, 5, 5], True),  # started together
        ([None, None, None], False),  # another middleware
    ],
)
def test_sequence_numbers_tell_whether_two_publish(numbers, several):
    sequence = topic_endpoints.PublicationSequence()
    for number in numbers:
        sequence.add(number)
    assert sequence.has_several_publishers() is several
    assert not sequence.has_several_publishers()


@pytest.mark.ros
def test_fixed_frames_have_the_names_of_the_messages(harness, monkeypatch):
    """Ranges and accelerations came in frames that no transform led to."""
    sent = []
    broadcaster = SimpleNamespace(sendTransform=sent.append)
    tf2_ros = SimpleNamespace(
        StaticTransformBroadcaster=lambda node: broadcaster, TransformBroadcaster=None
    )
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    mounted = {'range_sensor.half_length': 0.2, 'range_frame_prefix': 'sharp_'}
    harness.add(SimRobotNode, namespace='one', enable_odom_tf=False, **mounted)
    ranges = harness.subscribe(Range, 'one/range/rear_left')
    imu = harness.subscribe(Imu, 'one/imu/data_raw')
    harness.spin_until(lambda: ranges and imu)
    (transforms,) = sent
    found = {transform.child_frame_id: transform for transform in transforms}
    assert {transform.header.frame_id for transform in transforms} == {'one/base_link'}
    assert len(found) == 9
    assert imu[-1].header.frame_id in found
    rear = found[ranges[-1].header.frame_id].transform
    assert rear.translation.x == -0.2
    assert abs(rear.rotation.z) == pytest.approx(1.0), 'it looks backwards'
    sent.clear()
    harness.add(SimRobotNode, namespace='two', enable_odom_tf=False, enable_static_tf=False)
    assert not sent


@pytest.mark.ros
@pytest.mark.slow
def test_a_robot_that_slipped_gets_going_again_three_times(harness):
    """The robot asked for a pause of the commands, which never came."""
    robot = harness.add(
        SimRobotNode, rate=50.0, publish_clock=True, real_time_factor=0.0, step_time=0.02
    )
    controller = harness.add(ControllerNode, rate=50.0, watchdog__odometry_timeout=5.0)
    references = harness.connected_publisher(Odometry, 'reference')
    harness.spin_until(lambda: robot._state is not None)
    for publisher, count in ((robot._odom_publisher, 1), (controller._command_publisher, 1)):
        harness.wait_for_subscriber(publisher, count)

    def drive(seconds, until=None):
        for _ in range(round(50 * seconds)):
            stamp_ns = robot._state.stamp_ns
            moving = stamp_ns > 2 * NANOSECONDS  # the gyro needs a standstill before
            references.publish(odometry(stamp_ns + 400_000_000, 0.2 if moving else 0.0))
            steps, commands = diagnostic(controller, 'steps'), robot._received
            robot._step()
            harness.spin_until(lambda before=steps: diagnostic(controller, 'steps') > before)
            harness.spin_until(lambda before=commands: robot._received > before)
            if until and reason(controller) == until:
                return True
        return not until

    def block(wheel):
        value = Parameter('faults.wheel_blocked', value=wheel)
        assert robot.set_parameters([value])[0].successful

    drive(4.0)
    assert reason(controller) == 'tracking'
    block('right')
    assert drive(6.0, 'commands pause because the robot does not follow them')
    assert diagnostic_level(controller) == WARN
    assert 'slip' in reason(robot)
    block('none')
    drive(8.0)
    assert reason(controller) == 'tracking'
    assert (diagnostic(controller, 'pauses'), diagnostic(robot, 'moving')) == (0, True)
    block('right')
    assert drive(30.0, 'stopped: the robot has stopped again after each of three pauses')
    assert diagnostic_level(controller) == ERROR
    assert 'call ~/enable' in '; '.join(controller.warnings())
    block('none')
    drive(2.0)
    assert not diagnostic(robot, 'moving')
    harness.done(SetBool, 'controller/enable', data=True)
    drive(2.0)
    assert reason(controller) == 'tracking'
    assert diagnostic(robot, 'moving')


# -- several nodes in one process -----------------------------------------------------------------


@pytest.fixture
def compose(graph, tmp_path):
    """Return a function that makes the nodes of ``composed`` from parameters."""
    nodes = []

    def make(*parameters):
        words = [f'storage.uri:={tmp_path}', *parameters]
        words = ['--ros-args', *(word for item in words for word in ('-p', item))]
        rclpy.init(args=words)
        nodes.extend(ComposedNode.make(cli_args=words))
        return {node.get_name(): node for node in nodes}

    yield make
    for node in nodes:
        node.on_shutdown()
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.ros
@pytest.mark.parametrize(
    'order', ['', 'nodes:=[recorder, controller, sim_robot, reference_generator]']
)
def test_composed_runs_with_stamped_commands_in_any_order(order, compose, tmp_path):
    """An early subscription of the recorder must not fix the type of cmd_vel in the process."""

    def spin_until(condition):
        wait_until(condition, step=lambda: executor.spin_once(timeout_sec=0.05))

    nodes = compose('enable_stamped_cmd_vel:=true', *filter(None, [order]))
    assert nodes.keys() == set(NODES) - {'radio_bridge', 'player', 'localizer'}
    executor = make_executor()
    for node in nodes.values():
        executor.add_node(node)
    spin_until(lambda: is_ok(nodes['sim_robot'], 'following commands'))
    spin_until(lambda: nodes['recorder'].count_subscribers('cmd_vel') > 1)
    expected = 'geometry_msgs/msg/TwistStamped'
    spin_until(lambda: nodes['recorder']._recorded_types.get('/cmd_vel') == expected)
    spin_until(lambda: nodes['sim_robot']._state.status.moving)
    count = diagnostic(nodes['recorder'], 'messages')
    spin_until(lambda: diagnostic(nodes['recorder'], 'messages') > count + 500)
    executor.shutdown()
    nodes['recorder'].on_shutdown()
    with open_bag(tmp_path) as recording:
        odometry = recording.series('/odom', {'v': 'twist.twist.linear.x'})
        steps = np.diff(odometry['stamp']) / 0.01
        assert np.allclose(steps, np.round(steps), atol=1e-4)
        assert steps.min() > 0.5
        assert np.ptp(odometry['v']) > 0.0
        assert recording.topics['/cmd_vel'].type_name == expected


@pytest.mark.ros
def test_two_types_on_one_topic_cannot_share_a_process(compose):
    with pytest.raises(ParameterError, match='controller cannot share a process with sim_robot'):
        compose('controller:enable_stamped_cmd_vel:=true')
