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
"""Nodes without messages: state after a change, exact levels of the diagnostics, closed files."""

from contextlib import suppress
import json
import os
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from rclpy.parameter import Parameter
from support.bag_messages import STORE
from support.file_watch import no_file_left_open
from support.object_state import state
from support.other_parameters import with_other_value
from support.ros_graph import diagnostic_level

from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.chaos.pose_reference import PortraitSource
from t3mpc_ros.chaos.reference import ChaoticReference
from t3mpc_ros.chaos.salted_seed_hash import matches_fingerprint
from t3mpc_ros.control.range_fault_detection import RangeFault
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist
from t3mpc_ros.nodes.base_node import ERROR, NO_CLOCK, OK, WARN
from t3mpc_ros.nodes.player import PlayerNode
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.registry import NODES, node_class, parameter_class
from t3mpc_ros.nodes.remote_parameters import ParameterWatch
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.statistics import DiagnosticLevel
from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON
from t3mpc_ros.robot.interface import BatteryReading

pytestmark = pytest.mark.ros

START = 1_700_000_000 * 10**9


@pytest.fixture
def bag(tmp_path):
    """Return the folder of a bag of one second."""
    with BagWriter(tmp_path / 'played', metadata_records={}) as made:
        made.add_topic('/a', 'std_msgs/msg/Float64')
        for number in range(2):
            made.write('/a', START + number * 10**9, START, b'\0\1\0\0' + bytes(8))
    return str(tmp_path / 'played')


@pytest.fixture
def start(harness, tmp_path, bag, monkeypatch):
    """Return a function that starts a node, which takes part in no graph until it is spun."""
    given = {
        'recorder': {'storage__uri': str(tmp_path / 'bag'), 'storage__snapshot_duration': 1.0},
        'player': {'storage__uris': [bag], 'play__start_paused': True},
        'sim_robot': {'publish_clock': True},
        'radio_bridge': {'port': str(tmp_path / 'no_port')},
    }

    monkeypatch.setattr(RadioBridgeNode, '_serve_port', lambda node: None)

    def start(name, **parameters):
        return harness.add(node_class(name), **(given.get(name, {}) | parameters))

    return start


def call(node, name, **request):
    """Return the response of a service of a node, without a graph."""
    (service,) = (
        each for each in node.services if each.service_name == node.resolve_service_name(name)
    )
    kind = service.srv_type
    return service.callback(kind.Request(**request), kind.Response())


def changed(node, **values):
    """Set parameters through the service of the node."""
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    results = call(node, '~/set_parameters', parameters=messages).results
    assert [each.reason for each in results] == [''] * len(values)


def published(publisher):
    """Return a list to which the messages of a publisher are appended from now on."""
    messages, publish = [], publisher.publish

    def note(message):
        messages.append(message)
        publish(message)

    publisher.publish = note
    return messages


def whole_state(node, kept=()):
    """Return the state of a node: its own objects, its timers and its publishers."""
    found = {path: value for path, value in state(node).items() if not path.startswith(kept)}
    found['timers'] = sorted(each.timer_period_ns for each in node.timers)
    found['publishers'] = sorted(each.topic_name for each in node.publishers)
    return found


def difference(one, other):
    return {path for path in one.keys() | other.keys() if one.get(path) != other.get(path)}


# -- parameters -----------------------------------------------------------------------------------

DYNAMIC = [name for name in NODES if any(each.dynamic for each in parameter_class(name).specs())]
PREDICTIVE = '_controller._tracker.law.predictive'
SERIALIZED = '_truth', '_odom.'
"""Serialized messages have padding of any value."""
KEPT = {
    'controller': (
        '_journal',
        '_matching',
        '_references',
        '_controller._trajectory.buffer.jump',
        '_controller.status.skill',
        PREDICTIVE,
    ),
    'sim_robot': ('_robot.', '_real_time_factor', '_simulated_time', *SERIALIZED),
    'radio_bridge': ('_wake_read', '_wake_write', *SERIALIZED),  # numbers of open files
    'player': ('_opened_ns', '_thread._timeline._anchor', '_thread._timeline._primed'),
}
"""What depends on the time of the start, or counts changes."""


@pytest.mark.slow
@pytest.mark.parametrize('name', DYNAMIC)
def test_a_changed_node_is_as_one_started_so(name, start, harness):
    node, values = start(name), {}
    for spec in parameter_class(name).specs():
        if spec.dynamic:
            wanted = with_other_value(node.parameters, spec)
            values[spec.name] = wanted.to_dict()[spec.name]
            changed(node, **{spec.name: values[spec.name]})
            assert node.parameters == wanted
            assert node.get_parameter(spec.name).value == values[spec.name]
    kept = ('_Node__', '_fingerprint', '_logged', *KEPT[name])
    found = whole_state(node, kept)
    robot = getattr(node, '_robot', None)
    if name == 'controller':
        call(node, '~/reset')  # until then it keeps what it has learnt
        weights = state(node._controller.get_weights())
    harness.remove(node)
    fresh = start(name, **values)
    assert fresh.parameters == node.parameters
    assert difference(found, whole_state(fresh, kept)) == set()
    if name == 'controller':
        assert difference(weights, state(fresh._controller.get_weights())) == set()
    if name == 'sim_robot':
        assert robot._parameters == fresh._robot._parameters


def test_changed_parameters_are_published_with_their_revision(start):
    """A revision that came one change late was lost in what a busy machine skipped."""
    node = start('controller')
    revisions = published(node._revision_publisher)
    rows = published(node._journal_publisher)
    for number, gain in enumerate((90.0, 95.0), 1):
        changed(node, **{'law.gain': gain})
        content = json.loads(revisions[-1].data)
        listed = json.loads(json.dumps(node.parameters.to_dict()))
        assert content == {'revision': number, 'parameters': listed}
        assert listed['law.gain'] == gain
        assert rows[-1].data[1] == 4  # Event.CONFIGURE
        assert rows[-1].data[4] == number == len(revisions)
    changed(node, **{'law.gain': 95.0})
    assert len(revisions) == 2


# -- services -------------------------------------------------------------------------------------


@pytest.mark.parametrize('name', ['sim_robot', 'radio_bridge'])
def test_an_emergency_stop_lasts_until_its_release(name, start):
    node = start(name)
    assert call(node, 'e_stop', data=False).message == 'no emergency stop is latched'
    for _ in range(2):
        answer = call(node, 'e_stop', data=True)
        # A bridge without a dongle used to answer 'emergency stop latched', too.
        assert answer.success == (name == 'sim_robot')
        said = 'emergency stop latched' if answer.success else 'not confirmed by the robot: '
        assert answer.message.startswith(said)
        assert node._apply_command(BodyTwist(0.1, 0.0), node.robot_ns()).startswith('emerg')
    answer = call(node, 'e_stop', data=False)
    assert (answer.success, answer.message) == (True, 'emergency stop released')
    assert node._apply_command(BodyTwist(0.1, 0.0), node.robot_ns()) == ''
    assert not call(node, 'e_stop', data=False).success


@pytest.mark.parametrize('source', ['signals', 'portrait'])
def test_a_reseeded_generator_is_as_one_of_the_seed(source, start):
    """A manual reseed used to add the remaining time to that of the new seed."""
    node = start('reference_generator', source=source, reseed__shortest=5.0, reseed__longest=9.0)
    parameters = node.parameters
    if source == 'portrait':
        node._source = node._make_source(ORIGIN)
    fingerprints, seeds = {node._fingerprint}, {node._seed}
    for number in range(3):
        for _ in range(7 * number):
            (node._source or node._generator).advance()
        answer = call(node, '~/reseed')
        assert answer.success
        fingerprints.add(node._fingerprint)
        seeds.add(node._seed)
        assert matches_fingerprint(node._fingerprint, node._seed)
        assert node.produce_diagnostics()[2]['seed_fingerprint'] == node._fingerprint
        if source == 'portrait':
            fresh = PortraitSource(parameters, parameters.geometry, ORIGIN, node._seed, int)
            assert node._source._left == fresh._left
            assert node._source._times.uniform(3).tolist() == fresh._times.uniform(3).tolist()
        else:
            fresh = ChaoticReference(parameters, parameters.geometry)
            fresh.reset(node._seed)
            assert node._generator.advance() == fresh.advance()
    assert len(fingerprints) == len(seeds) == 4


def test_each_reseed_of_a_path_has_its_fingerprint(start):
    node = start(
        'reference_generator', source='portrait', reseed__shortest=0.2, reseed__longest=0.2
    )
    node._source = node._make_source(ORIGIN)
    found = {node._fingerprint}
    for _ in range(100):
        node._source.advance()
        found.add(node._fingerprint)
        assert matches_fingerprint(node._fingerprint, node._seed)
    assert len(found) > 3


# -- diagnostics ----------------------------------------------------------------------------------


def report(node):
    return node.produce_diagnostics()[:2]


class Instead:
    """An object with some of its attributes replaced."""

    def __init__(self, original, **replaced):
        self._original = original
        self.__dict__.update(replaced)

    def __getattr__(self, name):
        return getattr(self._original, name)


def test_levels_of_the_controller(start):
    node = start('controller')
    assert report(node) == (WARN, 'stopped: no odometry')
    node._steps = 1
    controller = node._controller
    for reason in Reason:
        node._controller = Instead(controller, status=controller.status._replace(reason=reason))
        passing = reason in (Reason.NOT_FOLLOWING, Reason.PAUSED)
        level = OK if reason is Reason.TRACKING else WARN if passing else ERROR
        text = reason.value if passing or reason.moves else f'stopped: {reason.value}'
        assert report(node) == (level, text)
        if passing:  # not after three pauses
            node._controller.drive_monitor = SimpleNamespace(pauses=3)
            assert report(node) == (ERROR, text)
    status = controller.status._replace(reason=Reason.TRACKING)
    for stuck, level in ((False, OK), (True, WARN)):
        ranges = SimpleNamespace(faults=lambda: {'front_left': RangeFault.FROZEN})
        activity = SimpleNamespace(stuck=stuck, value='what it does')
        keep_out = SimpleNamespace(activity=activity, ranges=ranges)
        node._controller = Instead(controller, status=status, keep_out=keep_out)
        assert diagnostic_level(node) == level
        assert node.produce_diagnostics()[2]['range_front_left'].startswith('frozen')
    node._controller = Instead(controller, status=status)
    node._rejected_references = 1
    assert diagnostic_level(node) == WARN
    node._odometry_problem = 'is too old'
    assert report(node) == (ERROR, 'stopped: odom is too old')


def robot_conditions(state):
    """Return changes of a robot state with the level of each."""
    status = state.status._replace(
        enabled=True, estop=False, slipping=False, imu_fault=False, low_battery=False
    )
    good = state._replace(status=status, reason='', lost_steps=None)
    low = BatteryReading(9.0, 1.0, 0.5)
    return [
        (good, OK),
        (good._replace(reason='no command yet'), WARN),
        (good._replace(status=status._replace(slipping=True)), WARN),
        (good._replace(status=status._replace(imu_fault=True)), WARN),
        (good._replace(status=status._replace(low_battery=True), battery=low), WARN),
        (good._replace(lost_steps=(0, 3)), WARN),
        (good._replace(status=status._replace(estop=True), reason='emergency stop: x'), ERROR),
    ]


def test_levels_of_the_simulated_robot(start):
    for clock, simulated, expected in (
        (False, False, (WARN, 'starting')),
        (True, False, (WARN, 'starting')),
        (True, True, (WARN, 'starting')),
        (False, True, (ERROR, NO_CLOCK)),
    ):
        node = start('sim_robot', publish_clock=clock, use_sim_time=simulated)
        assert report(node) == expected
    node = start('sim_robot')
    for found, level in robot_conditions(node._robot.advance(10**7)):
        node._state = found
        assert diagnostic_level(node) == level, found
    node._state = robot_conditions(node._state)[0][0]
    node._scheduler.skipped += 1
    text = 'processor overloaded: samples were skipped'
    assert report(node) == (WARN, text)
    # One skipped sample is no warning for ever, and never hides why the robot stands.
    assert report(node) == (OK, 'following commands')
    node._scheduler.skipped += 1
    node._state = node._state._replace(reason=SLIP_STOP_REASON)
    assert report(node) == (WARN, f'{SLIP_STOP_REASON}; {text}')
    values = dict(node.produce_diagnostics()[2])
    assert values['standstill'] == SLIP_STOP_REASON


def test_levels_of_the_radio_bridge(start):
    node = start('radio_bridge')
    assert diagnostic_level(node) == ERROR
    robot = node._robot
    link, quality = robot.link, robot.quality(0)._replace(level=DiagnosticLevel.OK, text='')

    def level(found, quality=quality, **replaced):
        node._robot = Instead(
            robot,
            link=Instead(link, **({'state': LinkState.RUN} | replaced)),
            advance=lambda now_ns: found,
            quality=lambda now_ns: quality,
        )
        return diagnostic_level(node)

    (good, _), *_ = conditions = robot_conditions(robot.advance(0))
    assert [level(found) for found, _ in conditions] == [wanted for _, wanted in conditions]
    for each in LinkState:
        assert level(good, state=each) == (OK if each is LinkState.RUN else ERROR)
    for found in DiagnosticLevel:
        text = 'why' if found else ''
        assert level(good, quality._replace(level=found, text=text)) == bytes([found])
    node._robot = robot


def test_levels_of_the_recorder(start, harness, tmp_path):
    node = start('recorder')
    assert report(node) == (OK, 'recording')
    node._topics.lost['/a'] = 2
    lacks = 'the bag lacks 0 dropped and 2 lost messages'
    assert report(node) == (WARN, lacks)
    node._snapshots.problem = 'no snapshot'
    assert report(node) == (WARN, 'no snapshot')
    node._writer.dropped, node._dropped_ns = {'/a': 3}, node.steady_ns()
    slow = 'the disk is too slow: 3 messages dropped so far'
    assert report(node) == (ERROR, slow)
    node._dropped_ns -= 3 * 10**9
    node._snapshots.problem = ''
    assert diagnostic_level(node) == WARN
    node._failure = 'the disk is full'
    assert report(node) == (ERROR, 'the disk is full')
    harness.remove(node)
    node = start('recorder', storage__snapshot_mode=True)
    assert report(node) == (OK, 'caching for snapshots')
    node._snapshots.problem = 'no snapshot'
    assert report(node) == (ERROR, 'no snapshot')


def test_levels_of_the_player(start):
    assert start('player', storage__uris=[]).produce_diagnostics()[0] == WARN
    node = start('player')
    assert report(node) == (OK, 'waiting for subscribers')
    node._started = True
    assert report(node) == (OK, 'paused')
    node._other_publishers = {'/a': '/b'}
    assert report(node) == (WARN, 'also published by other nodes: /a')
    node._damaged = 3
    assert report(node) == (WARN, '3 messages of damaged chunks are not played')
    node._thread.failure = 'the bag cannot be read'
    assert report(node) == (ERROR, 'the bag cannot be read')


def test_levels_of_the_reference_generator(start):
    node = start('reference_generator')
    assert report(node) == (OK, 'running')
    call(node, '~/pause', data=True)
    assert report(node) == (OK, 'paused')
    call(node, '~/pause', data=False)
    node._path_clock.rate = 0.0
    assert report(node) == (OK, 'waiting for the robot')
    node._scheduler.skipped += 1
    assert diagnostic_level(node) == WARN
    node.clock_started = lambda: False
    assert report(node) == (WARN, NO_CLOCK)
    path = start('reference_generator', source='topic')
    assert path.produce_diagnostics()[0] == WARN


def test_a_warning_raises_the_level_to_a_warning_and_no_further(start):
    node = start('reference_generator')
    statuses = published(node._diagnostics)
    for level in (OK, WARN, ERROR):
        node.produce_diagnostics = lambda level=level: (level, 'text', {})
        node.start_warnings = []
        node._publish_diagnostics()
        assert statuses[-1].status[0].level == level
        node.start_warnings = ['something']
        node._publish_diagnostics()
        status = statuses[-1].status[0]
        wanted = 'something' if level == OK else 'text; something'
        assert (status.level, status.message) == (max(level, WARN), wanted)


# -- files ----------------------------------------------------------------------------------------


def test_a_bridge_that_has_ended_has_no_pipe(start, harness):
    node = start('radio_bridge')
    harness.remove(node)
    for number in (node._wake_read, node._wake_write):
        with pytest.raises(OSError, match='Bad file descriptor'):
            os.fstat(number)


def test_a_player_that_cannot_start_has_no_bag_open(ros, tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / 'a', version=9, storage_plugin=StoragePlugin.SQLITE3) as made:
        connection = made.add_connection('/a', 'std_msgs/msg/Float64', typestore=STORE)
        made.write(connection, START, b'\0\1\0\0' + bytes(8))
    values = {'storage.uris': [str(tmp_path / 'a')], 'play.start_offset': 9.0}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    with no_file_left_open(tmp_path), suppress(ParameterError):
        PlayerNode(parameter_overrides=overrides).destroy_node()


def test_parameters_are_read_once_for_each_start_of_a_node():
    node = Mock()
    request = node.create_client.return_value.call_async
    watch = ParameterWatch(node, lambda name, namespace: name == 'controller', print)
    for there, count in ((True, 1), (True, 1), (False, 1), (True, 2), (True, 2)):
        present = [('controller', '/'), ('talker', '/')] if there else []
        node.get_node_names_and_namespaces.return_value = present
        watch.update()
        assert request.call_count == count
    assert node.destroy_client.call_count == 4, 'the clients of the node that has left'
    # An answer that arrives after the end raised an error: its clients are destroyed.
    watch.close()
    answered = request.return_value.add_done_callback.call_args[0][0]
    answered(SimpleNamespace(result=lambda: pytest.fail('an answer is used')))
