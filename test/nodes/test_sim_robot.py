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
"""The digital twin as a node: sensors, faults, initial pose, simulated time."""

import math
from pathlib import Path
import time

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, Range
from std_srvs.srv import Trigger
from support.launch_files import nodes_of
from support.ros_graph import (
    CommandSource,
    diagnostic,
    diagnostic_level,
    reason,
    stamp,
    twist,
)

from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import OK, WARN
from t3mpc_ros.nodes.robot_messages import count_variance, imu_message, twist_covariance
from t3mpc_ros.nodes.sim_robot import SimRobotNode, SimRobotParameters
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]


def paused(harness, /, **parameters):
    """Return a robot with paused time that has published its first state."""
    robot = harness.add(SimRobotNode, publish_clock=True, real_time_factor=0.0, **parameters)
    harness.spin_until(lambda: diagnostic(robot, 'moving') is not None, 'the first state')
    return robot


def change(harness, node, **values):
    """Set parameters with the node's service, as ``ros2 param set``; return the results."""
    request = [
        Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
        for name, value in values.items()
    ]
    full = node.get_fully_qualified_name()
    return harness.call(SetParameters, f'{full}/set_parameters', parameters=request).results


def published_states(node):
    """Return a list of the last and all following states of a robot."""
    states = [] if node._state is None else [node._state]
    publish = node.publish_state

    def note(state):
        states.append(state)
        publish(state)

    node.publish_state = note
    return states


def wait_for_subscribers(harness, robot, *topics):
    """Spin until the publishers of the robot's topics have subscribers."""
    names = {robot.resolve_topic_name(topic) for topic in topics}
    publishers = [one for one in robot.publishers if one.topic_name in names]
    assert len(publishers) == len(names)
    for publisher in publishers:
        harness.wait_for_subscriber(publisher)


# -- sensors --------------------------------------------------------------------------------------


def test_sensor_messages_match_the_state_at_their_rates(harness):
    """In a corner of the room, 0.3 m from the wall in front.

    In steps: a running robot on a busy machine publishes faster than the executor, which takes
    one message per cycle, empties the queue of the probe.
    """
    received = {name: harness.subscribe(Range, f'range/{name}') for name in RANGE_SENSORS}
    imu = harness.subscribe(Imu, 'imu/data_raw')
    battery = harness.subscribe(BatteryState, 'battery_state')
    robot = paused(
        harness,
        world='room',
        initial_pose__x=1.60,
        imu_frame_id='a/imu',
        range_frame_prefix='a/',
        range_rate=25.0,
        step_time=0.5,
        noise__variance=0.04,
    )
    states = published_states(robot)
    topics = 'imu/data_raw', 'battery_state', *(f'range/{name}' for name in RANGE_SENSORS)
    wait_for_subscribers(harness, robot, *topics)
    for step in range(1, 6):
        harness.done(Trigger, 'sim_robot/step')
        harness.spin_until(lambda count=50 * step: len(imu) >= count)
    harness.spin_until(lambda: len(battery) > 2 and all(len(x) > 60 for x in received.values()))

    by_stamp = {state.stamp_ns: state for state in states}
    for message in imu:
        state = by_stamp[stamp(message)]
        assert message.angular_velocity.z == state.imu.angular
        assert message.linear_acceleration.x == state.imu.forward
        assert message.linear_acceleration.y == state.imu.sideways
    assert imu[-1].header.frame_id == 'a/imu'
    wanted = imu_message(robot.parameters.imu, 'a/imu')
    for name in ('orientation', 'angular_velocity', 'linear_acceleration'):
        field = f'{name}_covariance'
        assert list(getattr(imu[-1], field)) == list(getattr(wanted, field))

    for index, (name, messages) in enumerate(received.items()):
        for message in messages:
            assert message.range == np.float32(by_stamp[stamp(message)].ranges[index])
        assert messages[-1].header.frame_id == f'a/{name}_range_link'
    assert {math.isinf(messages[-1].range) for messages in received.values()} == {True, False}
    assert received['front_left'][-1].range == pytest.approx(0.3, abs=0.05)

    supply = battery[-1]
    assert supply.voltage == np.float32(by_stamp[stamp(supply)].battery.voltage)
    assert supply.percentage == np.float32(by_stamp[stamp(supply)].battery.charge)
    assert supply.charge == pytest.approx(2.2 * supply.percentage, rel=1e-6)
    for messages, rate in ((received['left_front'], 25), (battery, 1), (imu, 100)):
        assert set(np.diff([stamp(message) for message in messages])) == {NANOSECONDS // rate}
    assert reason(robot) == 'no command yet'


def test_range_infinity_false_publishes_max_range(harness):
    received = harness.subscribe(Range, 'range/front_left')
    robot = harness.add(SimRobotNode)
    harness.spin_until(lambda: received and received[-1].range == math.inf)
    assert change(harness, robot, range_infinity=False)[0].successful
    harness.spin_until(lambda: received[-1].range == received[-1].max_range == np.float32(0.8))


def test_the_paper_plant_has_no_sensors(harness):
    harness.add(SimRobotNode, namespace='servo', drive__kind='velocity')
    harness.add(SimRobotNode, namespace='twin', range_rate=0.0)
    odom = [harness.subscribe(Odometry, f'{name}/odom') for name in ('servo', 'twin')]
    harness.spin_until(lambda: min(map(len, odom)) > 5)
    names = {name for name, _ in harness.probe.get_topic_names_and_types()}
    assert '/twin/imu/data_raw' in names
    assert not any('/range/' in name for name in names)
    for name in ('imu/data_raw', 'battery_state'):
        assert f'/servo/{name}' not in names


def test_twist_covariance_follows_the_noise(harness):
    odom = harness.subscribe(Odometry, 'odom')
    robot = harness.add(SimRobotNode, noise__variance=0.04)
    counted = count_variance(robot.parameters.motor.microstep, 0.01)
    for variance in (0.04, 0.0):
        assert change(harness, robot, noise__variance=variance)[0].successful
        wanted = twist_covariance(robot.parameters.geometry, variance + counted)
        later_ns = robot.now_ns() + NANOSECONDS // 20
        harness.spin_until(lambda at_ns=later_ns: odom and stamp(odom[-1]) > at_ns)
        assert odom[-1].twist.covariance.tolist() == wanted


# -- faults ---------------------------------------------------------------------------------------


def test_a_dead_gyro_is_a_warning_until_it_recovers(harness):
    robot = harness.add(SimRobotNode)
    imu = harness.subscribe(Imu, 'imu/data_raw')
    odom = harness.subscribe(Odometry, 'odom')
    CommandSource(harness, twist(0.1))
    harness.spin_until(
        lambda: imu and (diagnostic_level(robot), reason(robot)) == (OK, 'following commands')
    )
    assert change(harness, robot, faults__gyro_dead=True)[0].successful
    status = harness.next_status('sim_robot')
    # By the stamps: on a busy machine, earlier messages still wait in the queue of the probe.
    silent_ns = robot.now_ns()
    harness.spin_until(lambda: odom and stamp(odom[-1]) > silent_ns + 300_000_000)
    assert max(map(stamp, imu)) <= silent_ns
    assert status.level == WARN
    assert 'inertial sensor does not answer' in status.message
    assert 'faults: gyro_dead' in status.message
    values = {entry.key: entry.value for entry in status.values}
    assert values['faults'] == 'gyro_dead'
    assert values['imu_fault'] == 'True'
    assert change(harness, robot, faults__gyro_dead=False)[0].successful
    harness.spin_until(lambda: stamp(imu[-1]) > silent_ns)
    harness.spin_until(
        lambda: (diagnostic_level(robot), reason(robot)) == (OK, 'following commands')
    )


@pytest.mark.parametrize(
    'given',
    [
        {'world': 'room'},
        {'faults.gyro_dead': True},
        {'faults.schedule': 'rough_ride'},
    ],
)
def test_the_paper_plant_rejects_worlds_and_faults(given):
    """A fault without effect would look like a robot that tolerates it."""
    with pytest.raises(ParameterError, match=f'must be stepper for {next(iter(given))[:5]}'):
        SimRobotParameters.from_dict({'drive.kind': 'velocity', **given})
    SimRobotParameters.from_dict(given)


# -- initial pose ---------------------------------------------------------------------------------


def test_the_initial_pose_is_true_unless_within_a_wall(harness):
    truth = harness.subscribe(Odometry, 'ground_truth/odom')
    odom = harness.subscribe(Odometry, 'odom')
    robot = harness.add(
        SimRobotNode,
        world='room',
        initial_pose__x=-1.0,
        initial_pose__y=0.2,
        initial_pose__yaw=1.0,
    )

    def pose(messages):
        return ros_messages.state_from_odometry(serialize_message(messages[-1])).pose

    harness.spin_until(lambda: truth)
    assert pose(truth) == pytest.approx((-1.0, 0.2, 1.0), abs=1e-3)
    assert change(harness, robot, initial_pose__x=-0.5, initial_pose__yaw=0.5)[0].successful
    response = harness.call(Trigger, 'sim_robot/set_pose')
    assert (response.success, 'x -0.5 m, y 0.2 m, yaw 0.5 rad' in response.message) == (True, True)
    harness.spin_until(lambda: pose(truth) == pytest.approx((-0.5, 0.2, 0.5), abs=1e-3))
    assert pose(odom) == pytest.approx((0, 0, 0), abs=1e-3)
    assert change(harness, robot, initial_pose__x=1.25, initial_pose__y=0.85)[0].successful
    response = harness.call(Trigger, 'sim_robot/set_pose')
    assert not response.success
    assert 'must be at least' in response.message
    assert 'room' in response.message
    count = len(truth)
    harness.spin_until(lambda: len(truth) > count + 3)
    assert pose(truth) == pytest.approx((-0.5, 0.2, 0.5), abs=1e-3)
    (result,) = change(harness, robot, initial_pose__x=math.nan)
    assert 'initial_pose.x must be finite' in result.reason
    words = r'initial_pose.x and initial_pose.y: pose must be .* got x 1.95 m'
    with pytest.raises(ParameterError, match=words):
        harness.add(SimRobotNode, namespace='other', world='room', initial_pose__x=1.95)


# -- simulated time -------------------------------------------------------------------------------


def test_paused_time_advances_by_steps_only(harness):
    odom = harness.subscribe(Odometry, 'odom')
    clock = harness.subscribe(Clock, '/clock')
    robot = paused(harness, step_time=0.02)
    commands = harness.connected_publisher(Twist, 'cmd_vel')
    harness.spin_until(lambda: robot.count_subscribers('odom') and len(clock) > 3)
    states = published_states(robot)
    commands.publish(twist(0.3))
    count = len(clock)
    harness.spin_until(lambda: len(clock) > count + 5, 'the paused time is published')
    assert {(message.clock.sec, message.clock.nanosec) for message in clock} == {(1, 0)}
    assert len(states) == 1
    answers = [harness.call(Trigger, 'sim_robot/step') for _ in range(10)]
    assert [response.message for response in answers] == [
        f'simulated time {1.0 + 0.02 * n:.9f} s' for n in range(1, 11)
    ]
    assert [state.stamp_ns for state in states] == [
        NANOSECONDS + n * 10_000_000 for n in range(21)
    ]
    assert states[-1].truth.pose.x > 0.01
    harness.spin_until(lambda: odom and stamp(odom[-1]) == states[-1].stamp_ns)
    harness.spin_until(lambda: clock[-1].clock == odom[-1].header.stamp)

    assert change(harness, robot, real_time_factor=1.0)[0].successful
    harness.spin_until(lambda: len(states) > 30, 'the time advances')
    assert 'real_time_factor must be 0' in harness.refused(Trigger, 'sim_robot/step')
    assert change(harness, robot, real_time_factor=0.0)[0].successful
    held = ros_messages.time_from_ns(states[-1].stamp_ns)
    harness.spin_until(lambda: clock[-1].clock == held, 'the held time is published')
    count = len(clock)
    harness.spin_until(lambda: len(clock) > count + 5)
    assert all(message.clock == held for message in clock[count:])
    assert all(np.diff([state.stamp_ns for state in states]) == 10_000_000)


def test_simulated_time_needs_publish_clock(harness):
    robot = harness.add(SimRobotNode)
    assert 'publish_clock must be true' in harness.refused(Trigger, 'sim_robot/step')
    (result,) = change(harness, robot, real_time_factor=2.0)
    assert not result.successful
    assert 'publish_clock must be true' in result.reason
    assert robot.parameters.real_time_factor == 1.0


def test_equal_seeds_steps_and_commands_give_equal_messages(harness):
    kinds = {'odom': Odometry, 'imu/data_raw': Imu, 'battery_state': BatteryState}
    kinds |= {f'range/{name}': Range for name in RANGE_SENSORS}
    runs = []
    for name, seed in (('a', 5), ('b', 5), ('c', 6)):
        robot = paused(
            harness,
            namespace=name,
            tf_frame_prefix_enable=False,
            seed=seed,
            world='room',
            noise__variance=0.04,
            step_time=0.2,
        )
        received = {
            topic: harness.subscribe(kind, f'{name}/{topic}', 1000)
            for topic, kind in kinds.items()
        }
        wait_for_subscribers(harness, robot, *kinds)
        commands = harness.connected_publisher(Twist, f'{name}/cmd_vel')
        states = published_states(robot)
        for n in range(8):
            commands.publish(twist(0.05 * n, 0.3 * n))
            harness.spin_until(lambda one=robot, count=n + 1: diagnostic(one, 'commands') == count)
            harness.done(Trigger, f'{name}/sim_robot/step')
        end_ns = states[-1].stamp_ns
        for topic in ('odom', 'imu/data_raw'):
            harness.spin_until(lambda some=received[topic], end=end_ns: stamp(some[-1]) == end)
        # As text: unmeasured fields of the battery are NaN, which is unequal to itself.
        messages = {topic: [str(message) for message in some] for topic, some in received.items()}
        runs.append((messages, [state.truth for state in states]))
        harness.remove(robot)
    (first, path), (same, again), (other, another) = runs
    assert len(first['odom']) == len(path) - 1 == 160
    assert path == again != another
    for topic in kinds:
        assert first[topic] == same[topic]
    assert first['odom'] != other['odom']


@pytest.mark.timed
def test_real_time_factor_10_is_about_ten_times_as_fast(harness):
    clock = []
    harness.probe.create_subscription(
        Clock, '/clock', lambda message: clock.append((time.monotonic(), message.clock.sec)), 100
    )
    robot = harness.add(SimRobotNode, publish_clock=True, real_time_factor=10.0)
    harness.spin_until(lambda: robot.produce_diagnostics()[2].get('real_time_factor', 0.0) > 6.0)
    assert diagnostic(robot, 'real_time_factor') < 11.0

    def pace(seconds):
        (last, end), recent = (
            clock[-1],
            [each for each in clock if clock[-1][0] - each[0] > seconds],
        )
        return (end - recent[-1][1]) / (last - recent[-1][0]) if recent else 0.0

    harness.spin_until(lambda: clock and pace(1.0) > 5.0)  # not while the machine is busy
    (first, begin), (last, end) = clock[0], clock[-1]
    assert (end - begin) / (last - first) < 12.0
    assert change(harness, robot, real_time_factor=1.0)[0].successful
    harness.spin_until(
        lambda: 0.7 < robot.produce_diagnostics()[2].get('real_time_factor', 0.0) < 1.2
    )


def test_an_unreachable_real_time_factor_is_a_warning(harness, monkeypatch):
    robot = harness.add(SimRobotNode, publish_clock=True, real_time_factor=100.0)
    advance = robot._robot.advance

    def slowly(now_ns):
        time.sleep(0.001)
        return advance(now_ns)

    monkeypatch.setattr(robot._robot, 'advance', slowly)
    states = published_states(robot)
    harness.spin_until(lambda: 'processor overloaded' in reason(robot))
    assert 'instead of 100' in reason(robot)
    assert 0.0 < diagnostic(robot, 'real_time_factor') < 20.0
    assert set(np.diff([state.stamp_ns for state in states])) == {10_000_000}
    assert harness.call(Trigger, 'reset_odometry').success, 'services are served'


# -- two robots -----------------------------------------------------------------------------------


def test_two_robots_launch_file_separates_the_robots(harness):
    robots = {
        node.namespace: harness.add(SimRobotNode, namespace=node.namespace, **node.values)
        for node in nodes_of(ROOT / 'launch' / 'two_robots.launch.py', share=ROOT)
        if node.executable == 'sim_robot'
    }
    one, two = robots.values()
    assert one.parameters.seed != two.parameters.seed
    states = {name: published_states(robot) for name, robot in robots.items()}
    imu = {name: harness.subscribe(Imu, f'{name}/imu/data_raw') for name in robots}
    CommandSource(harness, twist(0.2), 'robot_1/cmd_vel')
    harness.spin_until(lambda: states['robot_1'] and states['robot_1'][-1].truth.pose.x > -0.4)
    assert states['robot_2'][-1].truth.pose == pytest.approx(two.parameters.pose, abs=1e-4)
    assert change(harness, two, faults__gyro_dead=True)[0].successful
    harness.spin_until(lambda: all(imu.values()) and diagnostic(two, 'imu_fault'))
    # A busy machine delivers late: the stamps decide.
    end = states['robot_2'][-1].stamp_ns
    harness.spin_until(lambda: stamp(imu['robot_1'][-1]) > end + NANOSECONDS // 5)
    assert stamp(imu['robot_2'][-1]) <= end
    assert imu['robot_1'][-1].header.frame_id == 'robot_1/imu_link'
    topics = {name for name, _ in harness.probe.get_topic_names_and_types()}
    assert not {'/odom', '/cmd_vel', '/battery_state', '/joint_states'} & topics
