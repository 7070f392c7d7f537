# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The digital twin in ROS: its sensors, its faults, its time, and two of them in one world."""

import math
from pathlib import Path
import runpy
import sys
import time
import types

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, Range
from std_srvs.srv import Trigger
from test_nodes_behaviour import Driver, World, on_grid, reason, speed, stamp, twist
import yaml

from t3mpc_ros.cli.demo import DemoOptions
from t3mpc_ros.cli.main import _parser
from t3mpc_ros.cli.process_group import ProcessError
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common.base_node import OK, WARN
from t3mpc_ros.nodes.node_parameters import PARAMETER_CLASSES
from t3mpc_ros.nodes.recorder.node import RecorderNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode, SimRobotNodeParameters
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.interface import RANGE_SENSORS

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def world(ros):
    made = World()
    yield made
    made.close()


def paused(world, /, **parameters):
    """Return a robot whose time stands, once it has told its first state."""
    robot = world.add(SimRobotNode, publish_clock=True, speed=0.0, **parameters)
    world.until(
        lambda: robot.produce_diagnostics()[2].get('moving') is not None, 'the first state'
    )
    return robot


def change(world, node, **values):
    """Set parameters over the node's service, as ``ros2 param set`` does; return the results."""
    request = [
        Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
        for name, value in values.items()
    ]
    full = node.get_fully_qualified_name()
    return world.call(SetParameters, f'{full}/set_parameters', parameters=request).results


def truths(node):
    """Return the newest state of a robot, and from now on every one that it tells."""
    states = [] if node._state is None else [node._state]
    publish = node._topics.publish

    def note(state):
        states.append(state)
        publish(state)

    node._topics.publish = note
    return states


def matched(world, robot, *topics):
    """Spin until those of the robot's topics that are heard have found who hears them."""
    names = {robot.resolve_topic_name(topic) for topic in topics}
    publishers = [one for one in robot.publishers if one.topic_name in names]
    assert len(publishers) == len(names)
    for publisher in publishers:
        world.found(publisher)


# -- sensors --------------------------------------------------------------------------------------


def test_the_sensors_tell_what_the_robot_knows(world):
    """In a corner of the room, 0.3 m from the wall in front."""
    heard = {name: world.hear(Range, f'range/{name}') for name in RANGE_SENSORS}
    imu = world.hear(Imu, 'imu/data_raw')
    battery = world.hear(BatteryState, 'battery_state')
    robot = paused(
        world,
        world='room',
        start_x=1.60,
        imu_frame='a/imu',
        range_frame_prefix='a/',
        step_time=0.5,
        noise__variance=0.04,
    )
    states = truths(robot)
    matched(world, robot, 'imu/data_raw', 'battery_state', *(f'range/{n}' for n in RANGE_SENSORS))
    for _ in range(3):
        assert world.call(Trigger, 'sim_robot/step').success
    world.until(lambda: len(imu) >= 100 and battery and all(heard.values()))

    by_stamp = {state.stamp_ns: state for state in states}
    for message in imu:
        state = by_stamp[stamp(message)]
        assert message.angular_velocity.z == state.imu.angular
        assert message.linear_acceleration.x == state.imu.forward
        assert message.linear_acceleration.y == state.imu.sideways
    assert on_grid(imu, 100)
    assert imu[-1].header.frame_id == 'a/imu'
    assert imu[-1].orientation_covariance[0] == -1.0
    gyro, push = imu[-1].angular_velocity_covariance, imu[-1].linear_acceleration_covariance
    assert (gyro[0], gyro[4], push[8]) == (1e6, 1e6, 1e6)
    assert np.count_nonzero(gyro) == np.count_nonzero(push) == 3
    # What is claimed of the noise is what it is: the spread of a gyro that stands.
    rates = np.array([state.imu.angular for state in states])
    assert np.var(rates) == pytest.approx(gyro[8], rel=0.6)

    seen = set()
    for name, messages in heard.items():
        index = RANGE_SENSORS.index(name)
        for message in messages:
            assert message.range == np.float32(by_stamp[stamp(message)].ranges[index])
            assert not math.isnan(message.range)
        last = messages[-1]
        assert last.radiation_type == Range.INFRARED
        assert last.header.frame_id == f'a/{name}_range_link'
        assert (last.min_range, last.max_range) == tuple(np.float32((0.10, 0.80)))
        assert last.field_of_view == np.float32(0.1)
        seen.add('inf' if message.range == math.inf else 'distance')
    assert seen == {'inf', 'distance'}
    assert heard['front_left'][-1].range == pytest.approx(0.3, abs=0.05)

    supply = battery[-1]
    assert supply.voltage == np.float32(by_stamp[stamp(supply)].battery.voltage)
    assert supply.current < 0.0
    assert supply.percentage == np.float32(by_stamp[stamp(supply)].battery.charge)
    assert supply.charge == pytest.approx(2.2 * supply.percentage, rel=1e-6)
    assert supply.power_supply_status == BatteryState.POWER_SUPPLY_STATUS_DISCHARGING


def test_sensors_come_at_their_rates_in_the_time_of_the_robot(world):
    imu = world.hear(Imu, 'imu/data_raw')
    left = world.hear(Range, 'range/left_front')
    battery = world.hear(BatteryState, 'battery_state')
    robot = world.add(SimRobotNode, publish_clock=True, speed=5.0, range_rate=25.0)
    world.until(lambda: len(battery) > 3 and len(left) > 20)
    assert set(np.diff([stamp(message) for message in left])) == {NANOSECONDS // 25}
    assert set(np.diff([stamp(message) for message in battery])) == {NANOSECONDS}
    assert set(np.diff([stamp(message) for message in imu])) == {NANOSECONDS // 100}
    assert reason(robot) == 'no command yet'


def test_a_free_view_is_max_range_for_those_who_want_it(world):
    heard = world.hear(Range, 'range/front_left')
    robot = world.add(SimRobotNode)
    world.until(lambda: heard and heard[-1].range == math.inf)
    assert change(world, robot, range_infinity=False)[0].successful
    world.until(lambda: heard[-1].range == heard[-1].max_range == np.float32(0.8))


def test_the_papers_plant_has_no_sensors_and_ranges_can_be_turned_off(world):
    world.add(SimRobotNode, namespace='servo', drive__kind='velocity')
    world.add(SimRobotNode, namespace='twin', range_rate=0.0)
    odom = [world.hear(Odometry, f'{name}/odom') for name in ('servo', 'twin')]
    world.until(lambda: min(map(len, odom)) > 5)
    names = {name for name, _ in world.probe.get_topic_names_and_types()}
    assert '/twin/imu/data_raw' in names
    assert not any('/range/' in name for name in names)
    for name in ('imu/data_raw', 'battery_state'):
        assert f'/servo/{name}' not in names


def test_the_recorder_keeps_the_sensors_without_being_told(world, tmp_path):
    world.add(SimRobotNode)
    recorder = world.add(RecorderNode, folder=str(tmp_path / 'bag'))
    wanted = {'/imu/data_raw', '/battery_state', *(f'/range/{name}' for name in RANGE_SENSORS)}
    world.until(lambda: wanted <= recorder._added.keys(), 'all are recorded')


def test_odometry_says_how_well_its_twist_is_known(world):
    odom = world.hear(Odometry, 'odom')
    robot = world.add(SimRobotNode, noise__variance=0.04)
    driver = Driver(world)
    driver.message = twist(0.2)
    world.until(lambda: len(odom) > 300)
    told = np.array(odom[-1].twist.covariance).reshape(6, 6)
    assert [told[i, i] for i in (1, 2, 3, 4)] == [1e6] * 4
    steady = odom[100:]
    linear = np.var([message.twist.twist.linear.x for message in steady])
    angular = np.var([message.twist.twist.angular.z for message in steady])
    assert linear == pytest.approx(told[0, 0], rel=0.5)
    assert angular == pytest.approx(told[5, 5], rel=0.5)
    assert change(world, robot, noise__variance=0.0)[0].successful
    count = len(odom)
    world.until(lambda: len(odom) > count + 5)
    assert odom[-1].twist.covariance[0] < 0.2 * told[0, 0]


# -- faults ---------------------------------------------------------------------------------------


def test_a_dead_gyro_is_silent_and_a_warning_until_it_answers_again(world):
    robot = world.add(SimRobotNode)
    imu = world.hear(Imu, 'imu/data_raw')
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.1)
    world.until(lambda: imu and robot.produce_diagnostics()[:2] == (OK, 'following commands'))
    assert change(world, robot, faults__gyro_dead=True)[0].successful
    said = world.diagnosis('sim_robot')
    world.until(lambda: len(odom) > 0)
    silent, told = len(imu), len(odom)
    world.until(lambda: len(odom) > told + 30)
    assert len(imu) == silent
    assert said.level == WARN
    assert 'inertial sensor does not answer' in said.message
    assert 'faults: gyro_dead' in said.message
    values = {entry.key: entry.value for entry in said.values}
    assert values['faults'] == 'gyro_dead'
    assert values['imu_fault'] == 'True'
    assert change(world, robot, faults__gyro_dead=False)[0].successful
    world.until(lambda: len(imu) > silent + 5)
    world.until(lambda: robot.produce_diagnostics()[:2] == (OK, 'following commands'))


def test_a_brown_out_stops_the_robot_with_the_reason_and_it_drives_again(world):
    robot = world.add(SimRobotNode)
    odom = world.hear(Odometry, 'odom')
    driver = Driver(world)
    driver.message = twist(0.1)
    world.until(lambda: odom and speed(odom[-1]) > 0.08)
    states = truths(robot)
    assert change(world, robot, faults__brown_out=True)[0].successful
    world.until(lambda: 'brown-out: the board restarts' in reason(robot))
    assert not robot.produce_diagnostics()[2]['enabled']
    world.until(lambda: states[-1].reason == '', 'the board is back')
    count = len(odom)
    world.until(lambda: len(odom) > count + 20)
    world.until(lambda: speed(odom[-1]) > 0.08, 'it drives again, for commands still come')
    away = [state for state in states if state.reason]
    assert away[-1].stamp_ns - away[0].stamp_ns == pytest.approx(0.5 * NANOSECONDS, rel=0.2)
    # Nothing brakes it: without current the wheels run down by themselves.
    assert min(state.truth.twist.linear for state in away) < 0.02
    assert robot.produce_diagnostics()[2]['commands_refused'] > 0


def test_a_blocked_wheel_loses_steps_and_the_robot_says_so(world):
    robot = world.add(SimRobotNode)
    driver = Driver(world)
    driver.message = twist(0.2)
    world.until(lambda: robot.produce_diagnostics()[2].get('moving'))
    assert change(world, robot, faults__wheel_blocked='right')[0].successful
    world.until(lambda: 'steps lost: ' in reason(robot))
    assert 'wheel_blocked right' in reason(robot)
    assert robot.produce_diagnostics()[2]['lost_steps_right'] > 0


@pytest.mark.parametrize(
    'given',
    [
        {'world': 'room'},
        {'faults.gyro_dead': True},
        {'faults.schedule': 'rough_ride'},
    ],
)
def test_what_the_papers_plant_does_not_have_is_refused(given):
    """A fault that was set and did nothing would be taken for a robot that copes."""
    with pytest.raises(ParameterError, match=f'must be stepper for {next(iter(given))[:5]}'):
        SimRobotNodeParameters.from_dict({'drive.kind': 'velocity', **given})
    SimRobotNodeParameters.from_dict(given)


# -- places ---------------------------------------------------------------------------------------


def test_a_robot_starts_where_it_is_told_and_never_in_a_wall(world):
    truth = world.hear(Odometry, 'ground_truth/odom')
    robot = world.add(
        SimRobotNode, world='room', world_frame='map', start_x=-1.0, start_y=0.2, start_heading=1.0
    )
    world.until(lambda: truth)
    where = truth[0].pose.pose.position
    assert (where.x, where.y) == pytest.approx((-1.0, 0.2))
    assert truth[0].header.frame_id == 'map'
    assert change(world, robot, start_x=1.25, start_y=0.85)[0].successful
    answer = world.call(Trigger, 'sim_robot/set_pose')
    assert not answer.success
    assert 'must be at least' in answer.message
    assert 'room' in answer.message
    count = len(truth)
    world.until(lambda: len(truth) > count + 3)
    assert truth[-1].pose.pose.position.x == pytest.approx(-1.0)
    with pytest.raises(ParameterError, match=r'start_x and start_y: pose must be .* got x 1.95 m'):
        world.add(SimRobotNode, namespace='other', world='room', start_x=1.95)


@pytest.mark.parametrize(
    'given, words',
    [
        ({'world': 'rome'}, ['rome', 'did you mean room?']),
        ({'faults.schedule': 'rough_rid'}, ['rough_rid', 'did you mean rough_ride?']),
        ({'speed': 10.0}, ['publish_clock must be true', 'got speed 10']),
    ],
)
def test_what_cannot_be_used_ends_the_process_with_one_line_and_code_2(given, words, fleet):
    fleet.start('sim_robot', parameters=given)
    with pytest.raises(ProcessError, match='code 2'):
        fleet.wait_ready('sim_robot')
    lines = fleet.log('sim_robot').read_text().splitlines()
    (line,) = (line for line in lines if line.startswith('sim_robot: '))
    for word in words:
        assert word in line
    assert not any('Traceback' in line for line in lines)


# -- time -----------------------------------------------------------------------------------------


def test_while_time_stands_only_a_step_moves_the_robot(world):
    odom = world.hear(Odometry, 'odom')
    clock = world.hear(Clock, '/clock')
    robot = paused(world, step_time=0.02)
    commands = world.speak(Twist, 'cmd_vel')
    world.found(commands)
    world.until(lambda: robot.count_subscribers('odom') and len(clock) > 3)
    states = truths(robot)
    commands.publish(twist(0.3))
    count = len(clock)
    world.until(lambda: len(clock) > count + 5, 'the time that stands is told to late comers')
    assert {(message.clock.sec, message.clock.nanosec) for message in clock} == {(1, 0)}
    assert len(states) == 1
    answers = [world.call(Trigger, 'sim_robot/step') for _ in range(10)]
    assert [answer.message for answer in answers] == [
        f'it is {1.0 + 0.02 * n:.9f} s' for n in range(1, 11)
    ]
    assert [state.stamp_ns for state in states] == [
        NANOSECONDS + n * 10_000_000 for n in range(21)
    ]
    assert states[-1].truth.pose.x > 0.01
    world.until(lambda: odom and stamp(odom[-1]) == states[-1].stamp_ns)
    world.until(lambda: clock[-1].clock == odom[-1].header.stamp)

    assert change(world, robot, speed=1.0)[0].successful
    world.until(lambda: len(states) > 30, 'time runs')
    answer = world.call(Trigger, 'sim_robot/step')
    assert not answer.success
    assert 'speed must be 0' in answer.message
    assert change(world, robot, speed=0.0)[0].successful
    count = len(clock)
    world.until(lambda: len(clock) > count + 5)
    assert clock[-1] == clock[-5]
    assert all(np.diff([state.stamp_ns for state in states]) == 10_000_000)


def test_time_of_its_own_must_be_told(world):
    robot = world.add(SimRobotNode)
    answer = world.call(Trigger, 'sim_robot/step')
    assert not answer.success
    assert 'publish_clock must be true' in answer.message
    (result,) = change(world, robot, speed=2.0)
    assert not result.successful
    assert 'publish_clock must be true' in result.reason
    assert robot.parameters.speed == 1.0


def test_one_seed_and_one_sequence_of_steps_and_commands_give_the_same_messages(world):
    kinds = {'odom': Odometry, 'imu/data_raw': Imu, 'battery_state': BatteryState}
    kinds |= {f'range/{name}': Range for name in RANGE_SENSORS}
    stories = []
    for name, seed in (('a', 5), ('b', 5), ('c', 6)):
        robot = paused(
            world, namespace=name, seed=seed, world='room', noise__variance=0.04, step_time=0.2
        )
        heard = {topic: world.hear(kind, f'{name}/{topic}', 1000) for topic, kind in kinds.items()}
        matched(world, robot, *kinds)
        commands = world.speak(Twist, f'{name}/cmd_vel')
        world.found(commands)
        states = truths(robot)
        for n in range(8):
            commands.publish(twist(0.05 * n, 0.3 * n))
            world.until(
                lambda one=robot, count=n + 1: one.produce_diagnostics()[2]['commands'] == count
            )
            assert world.call(Trigger, f'{name}/sim_robot/step').success
        end_ns = states[-1].stamp_ns
        for topic in ('odom', 'imu/data_raw'):
            world.until(lambda some=heard[topic], end=end_ns: stamp(some[-1]) == end)
        # As text: a battery has numbers that nobody measures, and NaN equals nothing.
        told = {topic: [str(message) for message in some] for topic, some in heard.items()}
        stories.append((told, [state.truth for state in states]))
        world.remove(robot)
    (first, path), (same, again), (other, another) = stories
    assert len(first['odom']) == len(path) - 1 == 160
    assert path == again != another
    for topic in kinds:
        assert first[topic] == same[topic]
    assert first['odom'] != other['odom']


def test_ten_times_as_fast_is_about_ten_times_as_fast(world):
    clock = []
    world.probe.create_subscription(
        Clock, '/clock', lambda message: clock.append((time.monotonic(), message.clock.sec)), 100
    )
    robot = world.add(SimRobotNode, publish_clock=True, speed=10.0)
    world.until(lambda: robot.produce_diagnostics()[2].get('real_time_factor', 0.0) > 6.0)
    assert robot.produce_diagnostics()[2]['real_time_factor'] < 11.0
    world.until(lambda: clock and clock[-1][0] - clock[0][0] > 1.0)
    (first, begin), (last, end) = clock[0], clock[-1]
    assert 5.0 < (end - begin) / (last - first) < 12.0
    assert change(world, robot, speed=1.0)[0].successful
    world.until(lambda: 0.7 < robot.produce_diagnostics()[2].get('real_time_factor', 0.0) < 1.2)


def test_a_speed_that_cannot_be_reached_is_a_warning_and_leaves_no_state_out(world, monkeypatch):
    robot = world.add(SimRobotNode, publish_clock=True, speed=100.0)
    advance = robot._robot.advance

    def slowly(now_ns):
        time.sleep(0.001)
        return advance(now_ns)

    monkeypatch.setattr(robot._robot, 'advance', slowly)
    states = truths(robot)
    world.until(lambda: 'the machine is too slow' in reason(robot))
    assert 'instead of 100 simulated seconds per second' in reason(robot)
    assert 0.0 < robot.produce_diagnostics()[2]['real_time_factor'] < 20.0
    assert set(np.diff([state.stamp_ns for state in states])) == {10_000_000}
    assert world.call(Trigger, 'reset_odometry').success, 'others get their turn'


# -- two robots -----------------------------------------------------------------------------------


class _Recorded:
    """Stands in for what launch files are written with; remembers the arguments."""

    def __init__(self, *arguments, **named):
        self.arguments = arguments
        self.named = named


@pytest.fixture
def launched(monkeypatch):
    """Return a function that gives the nodes of a launch file: ``launch`` comes with apt only."""
    words = {
        'launch': ['LaunchDescription'],
        'launch.actions': ['DeclareLaunchArgument'],
        'launch.conditions': ['IfCondition'],
        'launch.substitutions': ['LaunchConfiguration'],
        'launch_ros': [],
        'launch_ros.actions': ['Node'],
        'launch_ros.parameter_descriptions': ['ParameterValue'],
        'ament_index_python.packages': [],
    }
    for name, classes in words.items():
        module = types.ModuleType(name)
        for word in classes:
            setattr(module, word, type(word, (_Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules['ament_index_python.packages'].get_package_share_directory = lambda name: ROOT

    def nodes(name):
        file = runpy.run_path(str(ROOT / 'launch' / name))
        items = file['generate_launch_description']().arguments[0]
        defaults = {
            item.arguments[0]: yaml.safe_load(item.named['default_value'] or '""')
            for item in items
            if type(item).__name__ == 'DeclareLaunchArgument'
        }

        def value(given):
            if type(given).__name__ == 'ParameterValue':
                return given.named['value_type'](value(given.arguments[0]))
            return defaults[given.arguments[0]] if isinstance(given, _Recorded) else given

        found = []
        for item in items:
            if type(item).__name__ == 'Node':
                file, given = item.named['parameters']
                assert Path(file).is_file()
                values = {key: value(one) for key, one in given.items()}
                found.append(
                    (value(item.named.get('namespace', '')), item.named['executable'], values)
                )
        return found

    return nodes


@pytest.mark.parametrize('file', ['sim.launch.py', 'two_robots.launch.py', 'robot.launch.py'])
def test_what_a_launch_file_says_fits_its_nodes(file, launched):
    for _, name, values in launched(file):
        given = {key: value for key, value in values.items() if key != 'use_sim_time'}
        parameters = PARAMETER_CLASSES[name].from_dict(given)
        if name == 'controller':
            assert parameters.speed_filter.lag == 0.003  # what a stepper needs


def test_the_two_robots_of_the_launch_file_do_not_hear_each_other(world, launched):
    nodes = launched('two_robots.launch.py')
    assert sorted(name for _, name, _ in nodes) == sorted(
        2 * ['controller', 'reference', 'sim_robot']
    )
    robots = {}
    for namespace, name, values in nodes:
        if name == 'sim_robot':
            robots[namespace] = world.add(SimRobotNode, namespace=namespace, **values)
    one, two = robots.values()
    assert one.parameters.seed != two.parameters.seed
    states = {name: truths(robot) for name, robot in robots.items()}
    imu = {name: world.hear(Imu, f'{name}/imu/data_raw') for name in robots}
    driver = Driver(world, 'robot_1/cmd_vel')
    driver.message = twist(0.2)
    world.until(lambda: states['robot_1'] and states['robot_1'][-1].truth.pose.x > -0.4)
    assert states['robot_2'][-1].truth.pose == pytest.approx(two.parameters.start, abs=1e-4)
    assert change(world, two, faults__gyro_dead=True)[0].successful
    world.until(lambda: two.produce_diagnostics()[2]['imu_fault'])
    world.until(lambda: all(imu.values()))
    silent, told = len(imu['robot_2']), len(imu['robot_1'])
    world.until(lambda: len(imu['robot_1']) > told + 20)
    assert len(imu['robot_2']) <= silent + 1
    assert imu['robot_1'][-1].header.frame_id == 'robot_1/imu_link'
    topics = {name for name, _ in world.probe.get_topic_names_and_types()}
    for part in ('odom', 'cmd_vel', 'battery_state', 'range/front_left', 'joint_states'):
        assert {f'/robot_1/{part}', f'/robot_2/{part}'} <= topics
        assert f'/{part}' not in topics


# -- the demonstration ----------------------------------------------------------------------------


def test_the_demonstration_drives_the_robot_that_was_asked_for():
    asked = {
        words: _parser().parse_args(['demo', *words.split()]).robot
        for words in ('', '--robot twin', '--robot servo')
    }
    assert list(asked.values()) == ['twin', 'twin', 'servo']
    for robot, kind, lag in (('twin', 'stepper', 0.003), ('servo', 'velocity', 0.02)):
        given = DemoOptions(robot=robot, seed=7).parameters()
        tables = {
            name: PARAMETER_CLASSES[name].from_dict(values) for name, values in given.items()
        }
        assert tables['sim_robot'].drive.kind == kind
        assert tables['sim_robot'].noise.variance == 0.04
        assert tables['controller'].speed_filter.lag == lag
        assert tables['sim_robot'].seed == tables['reference'].seed == 7
