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
"""The node of the live page: what it collects from a running robot, and its commands."""

from functools import partial
import math
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from std_msgs.msg import Header, Int32MultiArray
from support.page_data import read_all
from support.ros_graph import CommandSource, twist

from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import WARN
from t3mpc_ros.nodes.remote_parameters import parameter_row
from t3mpc_ros.nodes.sim_robot import SimRobotNode, SimRobotParameters
from t3mpc_ros.nodes.viewer import REPLY_TIMEOUT, CommandFailedError, ViewNode
from t3mpc_ros.view.live_data import LiveRun

pytestmark = pytest.mark.ros

LEAD_NS = 400_000_000


class Viewer:
    """A viewer of a robot, polled while the harness spins."""

    def __init__(self, harness, namespace=''):
        self.harness = harness
        self.run = LiveRun()
        self.node = ViewNode(self.run, namespace)
        # As in its process: the events executor of the harness also takes what the node polls.
        self._executor = SingleThreadedExecutor()
        harness.add_foreign(self.node, self._executor)
        self._now = self._next_look = 0.0

    def changes(self):
        return read_all(self.run)[0]

    def facts(self):
        return self.changes().get('facts', {})

    def spin_until(self, condition):
        def met():
            start = time.monotonic()
            if start < self._next_look:
                return False
            self._now += 0.05
            self.node.look_at_graph()
            for _ in range(10):
                self._executor.spin_once(0.0)
            self.node.poll()
            self.run.tick(self._now)
            result = condition()
            # After every event of the robot, on a busy machine, this took the time of the next
            # ones: its commands waited ever longer, until it refused them as too old.
            end = time.monotonic()
            self._next_look = end + max(0.02, 3.0 * (end - start))
            return result

        self.harness.spin_until(met)

    def command(self, name, /, *, asked=None, **arguments):
        command = self.node.command
        asked = time.monotonic() if asked is None else asked
        return self.harness.in_thread(command, name, arguments, asked, spin_until=self.spin_until)

    def parameter(self, name):
        rows = self.facts().get('parameters/sim_robot') or ()
        return next((row for row in rows if row['name'] == name), None)


@pytest.fixture
def robot(harness):
    return harness.add(SimRobotNode, world='room')


@pytest.fixture
def viewer(robot, harness):
    viewer = Viewer(harness)
    viewer.spin_until(lambda: viewer.parameter('wheel_radius'))
    return viewer


def test_a_moving_robot_is_shown(viewer, harness):
    source = CommandSource(harness, twist(0.14))

    def moving():
        streams = viewer.changes().get('streams', {})
        wanted = {'odometry', 'truth', 'command', 'ranges'}
        return wanted <= streams.keys() and streams['odometry']['values'][0][-1] > 3.9

    viewer.spin_until(moving)
    streams, facts = viewer.changes()['streams'], viewer.facts()
    # 0.14 m/s with wheels of 35 mm
    assert streams['command']['values'][0][-1] == pytest.approx(4.0)
    assert len(facts['world']['segments']) > 4
    assert facts['robot'] == {'wheel_radius': 0.035, 'wheel_separation': 0.147}
    viewer.spin_until(lambda: viewer.facts()['banner']['headline'] == 'Following commands')
    source.message = None
    viewer.spin_until(lambda: viewer.facts()['banner']['headline'] == 'Stopped')
    assert 'no command' in viewer.facts()['banner']['detail']


def test_a_switch_has_the_time_of_the_reference_that_it_begins(viewer, harness):
    """It was marked when its message arrived: as much too early as the reference is sent ahead."""
    reference = harness.probe.create_publisher(Odometry, 'reference', topic_endpoints.STREAM)
    signals = harness.probe.create_publisher(
        Int32MultiArray, 'reference/signals', topic_endpoints.LATCHED
    )
    sent, switches = [], []

    def send(mode, *, switch):
        now = harness.probe.get_clock().now().nanoseconds
        if switch:
            signals.publish(Int32MultiArray(data=[mode, 1, 2]))
            switches.append(now + LEAD_NS)
        stamp = ros_messages.time_from_ns(now + LEAD_NS)
        reference.publish(Odometry(header=Header(stamp=stamp)))
        sent.append(now + LEAD_NS)

    def found():
        events = viewer.changes().get('events', ())
        return [event['time'] for event in events if event['kind'] == 'switch']

    for mode in range(5):
        for k in range(4):
            send(mode, switch=k == 2)
            viewer.spin_until(lambda: len(viewer.node._sent_references) == len(sent))
    viewer.spin_until(lambda: len(found()) == 4)  # the first mode is no switch
    origin = viewer.facts()['origin']
    expected = [(stamp - origin * 1_000_000_000) / 1e9 for stamp in switches[1:]]
    assert found() == pytest.approx(expected, abs=1e-6)


def test_what_contradicts_the_map_is_shown_once(viewer, harness):
    publisher = harness.probe.create_publisher(
        DiagnosticArray, 'map_changes', topic_endpoints.LATCHED
    )
    numbers = {'x_m': '0.5', 'y_m': '-0.25', 'size_m': '0.3'}

    def send(kind, present):
        values = {'kind': kind, 'present': str(present), **numbers}
        status = DiagnosticStatus(name='change 1', message=f'{kind} thing')
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        publisher.publish(DiagnosticArray(status=[status, DiagnosticStatus(name='other')]))
        shown = [[0.5, -0.25, 0.3, kind, present]]
        viewer.spin_until(lambda: viewer.facts().get('map_changes') == shown)

    send('new', True)
    numbers['size_m'] = '0.30'
    send('new', True)
    send('moving', False)
    events = [each for each in viewer.changes()['events'] if each['kind'] == 'change']
    assert [each['text'] for each in events] == ['new thing', 'moving thing']


def test_a_command_without_stamp_has_the_time_of_its_sending(viewer):
    """It had that of the newest odometry at the next poll: up to 50 ms off."""
    viewer.spin_until(lambda: 'odometry' in viewer.changes().get('streams', {}))
    origin = viewer.facts()['origin'] * 1_000_000_000
    sent = [origin + 5_000_000_000 + 30_000_000 * k for k in range(10)]
    for sent_ns in sent:
        viewer.node._on_command(serialize_message(twist(0.14)), sent_ns)
    shown = viewer.changes()['streams']['command']
    assert shown['time'] == pytest.approx([(each - origin) / 1e9 for each in sent], abs=1e-4)
    assert shown['values'][0] == pytest.approx([4.0] * 10)
    # A robot that was busy sends its newest stamp late: that moves no command.
    viewer.node._on_state('odometry', odometry(sent[-1]), sent[-1] + 600_000_000)
    viewer.node._on_command(serialize_message(twist(0.14)), sent[-1] + 30_000_000)
    times = viewer.changes()['streams']['command']['time']
    assert len(times) == 11
    assert times[-1] - times[-2] == pytest.approx(0.03, abs=1e-4)


def odometry(stamp_ns):
    return serialize_message(Odometry(header=Header(stamp=ros_messages.time_from_ns(stamp_ns))))


def test_the_e_stop_latches_and_is_shown(viewer, robot):
    assert viewer.command('e_stop', on=True) == 'emergency stop latched'
    viewer.spin_until(lambda: viewer.facts()['banner']['headline'] == 'E-STOP')
    assert 'emergency stop' in viewer.facts()['banner']['detail']
    assert viewer.command('e_stop', on=False) == 'emergency stop released'
    viewer.spin_until(lambda: viewer.facts()['banner']['headline'] != 'E-STOP')
    texts = [event['text'] for event in viewer.changes()['events']]
    done = {'e_stop on: emergency stop latched', 'e_stop off: emergency stop released'}
    assert done <= set(texts)


def test_a_robot_that_stands_latched_is_shown_as_stopped(viewer, robot, harness):
    """A blocked wheel was shown as *Driving, with a warning*, its reason hidden by another one."""
    text = 'a wheel slips; processor overloaded: samples were skipped'
    produced = []

    def produce():
        produced.append(text)
        return WARN, text, {'standstill': 'a wheel slips', 'slipping': True}

    robot.produce_diagnostics = produce

    def shown():
        banner = viewer.facts()['banner']
        return banner['headline'] == 'Stopped' and 'sim_robot: a wheel slips' in banner['detail']

    viewer.spin_until(shown)
    viewer.spin_until(lambda: len(produced) > 2)
    slips = [each for each in viewer.changes()['events'] if each['kind'] == 'slip']
    assert len(slips) == 1, 'reported again with each diagnostics'


def test_a_parameter_is_set_and_its_change_is_shown(viewer, robot, harness):
    viewer.command('set', node='sim_robot', name='faults.command_loss', value=0.25)
    viewer.spin_until(lambda: viewer.parameter('faults.command_loss')['value'] == 0.25)
    assert robot.parameters.faults.command_loss == 0.25
    viewer.spin_until(lambda: any(each['kind'] == 'fault' for each in viewer.changes()['events']))


def test_a_drawn_path_reaches_the_reference_and_no_later_one(viewer, harness):
    paths = []
    listen = partial(
        harness.probe.create_subscription, Path, 'path', paths.append, topic_endpoints.LATCHED
    )
    with pytest.raises(CommandFailedError, match='no node follows a path: start reference_gen'):
        viewer.command('path', points=[[1.0, 2.0]])
    first = listen()
    viewer.spin_until(lambda: viewer.node._path_publisher.get_subscription_count())
    assert viewer.command('path', points=[[0.0, 0.5], [1, 2]]).startswith(
        'path of 2 points to x 1'
    )
    viewer.spin_until(lambda: paths)
    (path,) = paths
    assert [(p.pose.position.x, p.pose.position.y) for p in path.poses] == [(0.0, 0.5), (1.0, 2.0)]
    assert path.header.frame_id == 'odom'
    assert viewer.command('path', points=[[1.0, 2.0]]) == 'goal to x 1.00 m, y 2.00 m'
    viewer.spin_until(lambda: len(paths) == 2)
    # A node that starts when it is old must not drive along it.
    harness.probe.destroy_subscription(first)
    ended = time.monotonic() + 1.2 * REPLY_TIMEOUT
    viewer.spin_until(lambda: time.monotonic() > ended)
    listen()
    viewer.spin_until(lambda: viewer.node._path_publisher.get_subscription_count())
    given = time.monotonic() + 1.0  # an old path would come within milliseconds
    viewer.spin_until(lambda: time.monotonic() > given)
    assert len(paths) == 2
    assert viewer.command('path', points=[[3.0, 3.0]])
    viewer.spin_until(lambda: len(paths) > 2)
    assert [len(each.poses) for each in paths] == [2, 1, 1]
    assert paths[-1].poses[0].pose.position.x == 3.0


def test_a_goal_reaches_a_patrol_that_plans(viewer, harness):
    goals = []
    harness.probe.create_subscription(PoseStamped, 'goal_pose', goals.append, 10)
    viewer.spin_until(lambda: viewer.node._goal_publisher.get_subscription_count())
    assert viewer.command('path', points=[[1.0, 2.0]]) == 'goal to x 1.00 m, y 2.00 m'
    viewer.spin_until(lambda: goals)
    (goal,) = goals
    assert (goal.pose.position.x, goal.pose.position.y) == (1.0, 2.0)
    assert goal.header.frame_id == 'odom'
    with pytest.raises(CommandFailedError, match='a patrol with plan.enabled drives to a goal'):
        viewer.command('path', points=[[0.0, 0.5], [1.0, 2.0]])


def setting(name, value):
    return {'node': 'sim_robot', 'name': name, 'value': value}


@pytest.mark.parametrize(
    ('name', 'arguments', 'words'),
    [
        ('e_stop', {}, 'e_stop needs on, true or false: got None'),
        ('dance', {}, 'the commands are set, path, e_stop,'),
        ('path', {'points': []}, 'path needs points'),
        ('path', {'points': 'all'}, 'path needs points'),
        ('path', {'points': [[0.0, math.nan]]}, 'points must be finite'),
        ('path', {'points': [[0.0], [1.0, 2.0]]}, 'path needs points'),
        ('reseed', {}, 'no node offers the service reference_generator/reseed'),
        ('set', {'node': 'x', 'name': 'y', 'value': 1}, "no node 'x'"),
        ('set', setting('y', 1), 'has no parameter y'),
        ('set', setting('faults.command_loss', 'much'), "command_loss must be float: got 'much'"),
        # Neither reaches the serialization, which would end the node.
        ('set', setting('seed', 2**70), 'seed must be int'),
        ('set', setting('disturbance.frequencies', ['a']), 'frequencies must be list of float'),
        ('set', setting('faults.command_loss', 2.0), 'faults.command_loss'),
    ],
)
def test_a_command_that_cannot_be_executed_has_a_reason(name, arguments, words, viewer):
    with pytest.raises(CommandFailedError, match=words):
        viewer.command(name, **arguments)


def test_a_command_that_has_waited_too_long_is_not_executed(viewer, robot, monkeypatch):
    """A page whose program was suspended must not enable a robot much later."""
    monkeypatch.setattr('t3mpc_ros.nodes.viewer.REPLY_TIMEOUT', 0.01)
    with pytest.raises(CommandFailedError, match='no answer to e_stop'):
        viewer.node.command('e_stop', {'on': True}, 0.0)  # nothing is polled meanwhile
    monkeypatch.undo()
    with pytest.raises(CommandFailedError, match='no emergency stop is latched'):
        viewer.command('e_stop', on=False)


def test_a_release_from_before_the_stop_is_refused(viewer, robot):
    early = time.monotonic()
    viewer.command('e_stop', on=True)
    with pytest.raises(CommandFailedError, match='before the last stop'):
        viewer.command('e_stop', on=False, asked=early)
    viewer.spin_until(lambda: robot._state.status.estop)  # with its next step


def test_a_node_that_leaves_takes_its_parameters_along(viewer, robot, harness):
    harness.remove(robot)
    viewer.spin_until(lambda: not viewer.facts().get('parameters/sim_robot'))
    assert viewer.facts()['nodes'] == []
    assert 'sim_robot' not in viewer.run._reports, 'it stood on the page with its last report'
    with pytest.raises(CommandFailedError, match='no node offers the service e_stop'):
        viewer.command('e_stop', on=True)
    harness.add(SimRobotNode)  # its parameters are read again
    viewer.spin_until(lambda: viewer.parameter('wheel_radius'))


def test_robots_of_other_namespaces_are_left_alone(robot, harness):
    other = harness.add(SimRobotNode, namespace='east', world='corridor')
    viewer = Viewer(harness, 'east')
    viewer.spin_until(lambda: viewer.parameter('world'))
    assert viewer.parameter('world')['value'] == 'corridor'
    viewer.command('e_stop', on=True)
    viewer.spin_until(lambda: viewer.facts()['banner']['headline'] == 'E-STOP')
    assert other._state.status.estop
    assert not robot._state.status.estop
    # A goal that is given meanwhile: the robot would start at the release, without a word.
    harness.probe.create_subscription(
        Path, '/east/path', lambda path: None, topic_endpoints.LATCHED
    )
    viewer.spin_until(lambda: viewer.node._path_publisher.get_subscription_count())
    text = viewer.command('path', points=[[1.0, 2.0]])
    assert text.endswith('the robot drives there as soon as the emergency stop is released')


def test_a_page_without_a_robot_names_those_of_other_namespaces(harness):
    """It said that no odometry was on the graph."""
    harness.add(SimRobotNode, namespace='east')
    viewer = Viewer(harness)
    viewer.spin_until(lambda: '/east' in viewer.facts().get('banner', {}).get('detail', ''))
    assert viewer.facts()['banner']['headline'] == 'Waiting for a robot'


def test_parameters_of_other_packages_have_rows_too(harness):
    """A foreign node has descriptions without unit, and ranges without bounds."""
    harness.probe.declare_parameter('speed', 1.5)
    row = parameter_row(
        harness.probe.describe_parameter('speed'),
        harness.probe.get_parameter('speed').get_parameter_value(),
    )
    assert (row['type'], row['value'], row['low'], row['high']) == ('float', 1.5, None, None)
    assert (row['unit'], row['text'], row['dynamic']) == ('', '', True)


def test_rows_have_unit_range_and_text_of_the_table(viewer):
    for spec in SimRobotParameters.specs():
        row = viewer.parameter(spec.name)
        source = '' if spec.source == 'assumed' else f' ({spec.source})'
        assert (row['unit'], row['text']) == (spec.unit, f'{spec.text}{source}')
        assert row['dynamic'] == spec.dynamic
        assert row['choices'] == list(spec.choices)
        if spec.kind in (int, float) and not spec.many:
            assert (row['low'], row['high']) == (spec.low, spec.high)
