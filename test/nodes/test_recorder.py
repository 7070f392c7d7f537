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
"""Recorder node: load, selection, snapshots, metadata and attachments."""

import os
import shutil
import struct
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
from nav_msgs.msg import Odometry
import pytest
from rclpy.qos import QoSProfile
from std_msgs.msg import Int32, Int64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import (
    LATCHED,
    CommandSource,
    diagnostic_level,
    odometry,
    reason,
    record,
    recorded,
    twist,
)
from support.waiting import wait_for_acknowledgement
import yaml

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recording_metadata import SEED_RECORD, RecordingMetadata
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.chaos.salted_seed_hash import matches_fingerprint
from t3mpc_ros.cli import bag as bag_cli
from t3mpc_ros.cli.robot_calibrate import calibration_file
from t3mpc_ros.model_file import find_model, load_model, save_model
from t3mpc_ros.nodes.base_node import ERROR, OK, WARN
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.recorder import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.calibration import Calibration, Estimate, SharpCurve

pytestmark = pytest.mark.ros

DEEP = QoSProfile(depth=5000)


def values(recorder):
    return recorder.produce_diagnostics()[2]


def texts(folder, topic='/text'):
    with open_bag(folder) as recording:
        return [message.data for _, message in recording.messages(topic)]


def files(path):
    with path.open('rb') as file:
        return {item.name: item.data for item in make_reader(file).iter_attachments()}


# -- load -----------------------------------------------------------------------------------------


def test_reception_is_stamped_on_arrival_not_on_taking(harness, tmp_path):
    recorder = record(harness, tmp_path, 'text')
    text = harness.connected_publisher(String, 'text')
    sent = []
    for number in range(5):
        sent.append(time.time_ns())
        text.publish(String(data=str(number)))
        time.sleep(0.1)  # no executor spins
    taken = time.time_ns()
    harness.spin_until(lambda: values(recorder)['messages'] == 5)
    with recorded(harness, recorder) as recording:
        stamps = [recording.start_ns + round(at * 1e9) for at, _ in recording.messages('/text')]
    for before, received, after in zip(sent, stamps, [*sent[1:], taken], strict=True):
        assert before - 1_000 <= received < after


def test_messages_beyond_the_queue_are_dropped_and_counted(harness, logged, tmp_path, monkeypatch):
    recorder = record(harness, tmp_path, 'text', 'number', storage__max_cache_size=65_536)
    text, number = (
        harness.create_publisher(String, 'text', DEEP),
        harness.create_publisher(Int32, 'number', DEEP),
    )
    harness.wait_for_subscriber(text)
    harness.wait_for_subscriber(number)
    stuck, write = threading.Event(), BagWriter.write
    monkeypatch.setattr(BagWriter, 'write', lambda *given: (stuck.wait(20.0), write(*given)))
    for i in range(400):
        text.publish(String(data=f'{i} {"x" * 200}'))
        number.publish(Int32(data=i))
    harness.spin_until(lambda: values(recorder)['dropped'] > 0)
    line, *_ = logged('the disk is too slow')
    assert line.startswith('[ERROR]')
    assert '/text' in line
    harness.spin_until(lambda: any(s.level == ERROR for s in harness.statuses('recorder')))
    assert values(recorder)['queue_bytes'] <= 65_536
    stuck.set()
    harness.spin_until(lambda: values(recorder)['queue_bytes'] == 0)
    harness.spin_until(lambda: diagnostic_level(recorder) == WARN)
    text.publish(String(data='again'))
    harness.spin_until(lambda: values(recorder)['messages'] == 801)
    with recorded(harness, recorder) as recording:
        lost = recording.metadata_records['losses']
        counts = {name: topic.message_count for name, topic in recording.topics.items()}
    assert counts['/text'] + int(lost['dropped /text']) == 401
    assert counts['/number'] + int(lost['dropped /number']) == 400
    assert int(lost['dropped']) == 801 - sum(counts.values())
    assert texts(tmp_path)[-1] == 'again'


def test_messages_replaced_in_the_dds_queue_are_counted(harness, tmp_path):
    """A full KEEP_LAST queue replaces its oldest samples, which DDS does not count as lost."""
    recorder = record(harness, tmp_path, 'text', storage__chunk_duration=0.05)
    text = harness.connected_publisher(String, 'text', DEEP)
    text.publish(String(data='first'))
    harness.spin_until(lambda: values(recorder)['messages'] == 1)
    for i in range(1500):  # no executor spins; the queue holds 1000 messages
        text.publish(String(data=str(i)))
    wait_for_acknowledgement(text)
    harness.spin_until(lambda: values(recorder)['messages'] == 1001)
    assert values(recorder)['lost'] == 500
    assert diagnostic_level(recorder) == WARN
    harness.remove(recorder)
    assert texts(tmp_path) == ['first', *map(str, range(500, 1500))]
    with open_bag(tmp_path) as recording:
        assert recording.metadata_records['losses']['lost /text'] == '500'


def test_messages_from_before_the_discovery_are_counted(harness, tmp_path):
    """A volatile publisher keeps nothing for the time until the recorder discovers it."""
    text = harness.create_publisher(String, 'text', DEEP)
    latched = harness.create_publisher(String, 'latched', LATCHED)
    for i in range(37):
        text.publish(String(data=str(i)))
        latched.publish(String(data=str(i)))
    recorder = record(harness, tmp_path, 'text', 'latched')
    harness.wait_for_subscriber(text)
    harness.wait_for_subscriber(latched)
    text.publish(String(data='seen'))
    harness.spin_until(lambda: values(recorder)['messages'] == 38)
    assert values(recorder)['undiscovered'] == 37
    assert (values(recorder)['lost'], diagnostic_level(recorder)) == (0, OK)
    harness.remove(recorder)
    assert texts(tmp_path, '/latched') == list(map(str, range(37))), 'all that is kept'
    with open_bag(tmp_path) as recording:
        losses = recording.metadata_records['losses']
    assert {key: value for key, value in losses.items() if '/' in key} == {
        'undiscovered /text': '37'
    }


# -- selection ------------------------------------------------------------------------------------


def test_expressions_and_types_select_in_the_graph(harness, tmp_path):
    recorder = record(
        harness,
        tmp_path,
        record__regex='/cam_[0-9]',
        record__exclude_regex='/.*secret',
        record__topic_types=['std_msgs/msg/Int32'],
    )
    texts_by_topic = {
        name: harness.create_publisher(String, name) for name in ('cam_1', 'cam_x', 'other')
    }
    counts = {name: harness.create_publisher(Int32, name) for name in ('count', 'secret')}
    for name in ('cam_1', 'count'):
        harness.wait_for_subscriber((texts_by_topic | counts)[name])
    for publisher in texts_by_topic.values():
        publisher.publish(String(data='x'))
    for publisher in counts.values():
        publisher.publish(Int32(data=1))
    harness.spin_until(lambda: values(recorder)['messages'] == 2)
    with recorded(harness, recorder) as recording:
        assert sorted(recording.topics) == ['/cam_1', '/count']


def test_an_expected_latched_topic_is_recorded_from_its_start(harness, tmp_path):
    """The early subscription is transient local, so it receives earlier messages."""
    journal = harness.create_publisher(Int64MultiArray, 'controller/journal', LATCHED)
    for number in range(5):
        journal.publish(Int64MultiArray(data=[number]))
    recorder = record(harness, tmp_path, 'controller/*')
    early = recorder._topics._subscriptions['/controller/journal']
    assert early.qos.durability == LATCHED.durability
    harness.spin_until(lambda: values(recorder)['messages'] == 5)
    harness.wait_for_subscriber(journal)
    journal.publish(Int64MultiArray(data=[5]))
    harness.spin_until(lambda: values(recorder)['messages'] == 6)
    with recorded(harness, recorder) as recording:
        numbers = recording.series('/controller/journal', {'n': 'data[0]'})['n']
    assert numbers.tolist() == [0, 1, 2, 3, 4, 5]


# -- snapshots ------------------------------------------------------------------------------------


def snapshots(folder):
    return sorted((folder / 'snapshots').iterdir())


def test_a_requested_snapshot_holds_the_last_seconds(harness, tmp_path):
    recorder = record(harness, tmp_path, 'text', 'map')
    text, latched = (
        harness.create_publisher(String, 'text'),
        harness.create_publisher(String, 'map', LATCHED),
    )
    harness.wait_for_subscriber(text)
    latched.publish(String(data='the map'))
    for number in range(20):
        text.publish(String(data=str(number)))
    harness.spin_until(lambda: values(recorder)['messages'] == 21)
    response = harness.call(Trigger, 'recorder/snapshot')
    assert response.success, response.message
    text.publish(String(data='after'))
    harness.spin_until(lambda: values(recorder)['snapshots'] == 1)
    harness.spin_until(lambda: values(recorder)['messages'] == 22)
    harness.remove(recorder)
    (folder,) = snapshots(tmp_path)
    assert str(folder) in response.message
    assert folder.name.endswith('_requested')
    assert texts(folder) == list(map(str, range(20)))
    assert texts(folder, '/map') == ['the map']
    with open_bag(folder) as recording:
        assert recording.metadata_records['snapshot']['reason'] == 'requested'
        assert recording.metadata_records['provenance']['version']
    assert texts(tmp_path)[-1] == 'after'


def test_a_fault_starts_one_snapshot_with_its_reason(harness, logged, tmp_path):
    recorder = record(harness, tmp_path, 'text')
    text = harness.create_publisher(String, 'text')
    reports = harness.create_publisher(DiagnosticArray, '/diagnostics')
    harness.wait_for_subscriber(text)
    harness.wait_for_subscriber(reports, 2)  # the probe subscribes, too

    def report(level, reason, name='controller'):
        status = DiagnosticStatus(level=level, name=name, message=reason)
        reports.publish(DiagnosticArray(status=[status]))
        text.publish(String(data=reason))

    report(ERROR, 'no time yet')
    report(OK, 'following commands')
    report(ERROR, 'not of this robot', name='other/controller')
    for _ in range(3):
        report(ERROR, 'e-stop latched')
    harness.spin_until(lambda: values(recorder)['snapshots'] == 1)
    report(OK, 'following commands')
    report(ERROR, 'e-stop latched')  # again within snapshot_pause
    harness.spin_until(lambda: logged('snapshot.min_interval'))
    harness.remove(recorder)
    (folder,) = snapshots(tmp_path)
    assert 'controller-e-stop-latched' in folder.name
    with open_bag(folder) as recording:
        assert recording.metadata_records['snapshot']['reason'] == 'controller: e-stop latched'
    assert 'following commands' in texts(folder)


def test_snapshot_mode_writes_snapshots_only(harness, tmp_path):
    recorder = record(
        harness, tmp_path, 'text', storage__snapshot_mode=True, storage__snapshot_duration=60.0
    )
    assert harness.call(Trigger, 'recorder/split_bagfile').success is False
    assert 'no message was received' in harness.refused(Trigger, 'recorder/snapshot')
    text = harness.connected_publisher(String, 'text')
    text.publish(String(data='kept'))
    harness.spin_until(lambda: values(recorder)['messages'] == 1)
    assert list(tmp_path.glob('*')) == []
    harness.done(Trigger, 'recorder/snapshot')
    harness.spin_until(lambda: values(recorder)['snapshots'] == 1)
    assert list(tmp_path.glob('*.mcap')) == []
    assert texts(snapshots(tmp_path)[0]) == ['kept']
    assert diagnostic_level(recorder) == OK
    record(harness, tmp_path / 'off', 'text', namespace='off', storage__snapshot_duration=0.0)
    assert 'storage.snapshot_duration must be above 0' in harness.refused(
        Trigger, 'off/recorder/snapshot'
    )


def test_a_failed_snapshot_is_reported_and_recording_continues(harness, logged, tmp_path):
    (tmp_path / 'snapshots').write_text('a file where a folder is wanted')
    recorder = record(harness, tmp_path, 'text')
    text = harness.connected_publisher(String, 'text')
    text.publish(String(data='one'))
    harness.spin_until(lambda: values(recorder)['messages'] == 1)
    harness.done(Trigger, 'recorder/snapshot')
    harness.spin_until(lambda: diagnostic_level(recorder) == WARN)
    text.publish(String(data='two'))
    harness.spin_until(lambda: values(recorder)['messages'] == 2)
    # Not before: what a thread prints while the terminal is read over and over may be lost.
    harness.spin_until(lambda: logged('no snapshot of'))
    assert logged('no snapshot of')[0].startswith('[ERROR]')
    harness.remove(recorder)
    assert recorder.exit_code == 0
    assert texts(tmp_path) == ['one', 'two']


# -- metadata and attachments ---------------------------------------------------------------------


def test_model_files_are_attached_to_every_file(harness, tmp_path):
    model, output = tmp_path / 'start.npz', tmp_path / 'learnt.npz'
    first = harness.add(ControllerNode)
    save_model(model, first._controller.get_weights(), first.parameters.to_dict())
    harness.remove(first)
    shutil.copy(model, output)
    os.utime(output, (1, 1))  # saved by an earlier run
    world_map = tmp_path / 'room.yaml'
    world_map.write_text('walls: []')
    bag = tmp_path / 'bag'
    recorder = record(harness, bag, 'odom', record__attachments=[str(world_map)])
    harness.add(ControllerNode, model=str(model), model_output=str(output))
    harness.add(ControllerNode, namespace='paper', model='servo')
    harness.spin_until(
        lambda: {'controller', '/paper/controller'} <= set(recorder._metadata.records)
    )
    response = harness.call(Trigger, 'recorder/split_bagfile')
    assert (response.success, response.message) == (True, 'continues in bag_1.mcap')
    harness.done(Trigger, 'controller/save_model')
    harness.remove(recorder)
    one, two = sorted(bag.glob('*.mcap'))
    assert files(one) == {
        'room.yaml': b'walls: []',
        'controller/start.npz': model.read_bytes(),
        'paper/controller/servo.npz': find_model('servo').read_bytes(),
    }
    assert files(two) == files(one) | {'controller/saved_learnt.npz': output.read_bytes()}
    (tmp_path / 'again.npz').write_bytes(files(two)['controller/saved_learnt.npz'])
    assert load_model(tmp_path / 'again.npz').keys() == load_model(model).keys()


def test_metadata_that_are_not_new_are_not_written_again(tmp_path):
    """What an earlier run left in its place is not what this controller has learnt."""
    output = tmp_path / 'learnt.npz'
    output.write_bytes(b'weights')
    metadata = RecordingMetadata([], 1000, True, 2_000_000_000)
    new = [metadata.add_seed('/a', text) for text in '11221']
    assert new == [True, False, True, False, True]
    metadata.add_parameters('controller', 'controller', {'model_output': str(output)}, 0)
    os.utime(output, (1, 1))
    assert metadata.saved_models(3_000_000_000) == []
    os.utime(output, (3, 3))
    assert [item.name for item in metadata.saved_models(4_000_000_000)] == [
        'controller/saved_learnt.npz'
    ]


def test_parameters_of_a_restarted_node_are_recorded_again(harness, tmp_path):
    """A restarted node may have other parameters."""
    recorder = record(harness, tmp_path, 'odom')
    robot = harness.add(SimRobotNode, seed=3)
    harness.spin_until(lambda: recorder._metadata.records.get('sim_robot', {}).get('seed') == '3')
    harness.remove(robot)
    harness.spin_until(lambda: 'sim_robot' not in recorder.get_node_names())
    harness.spin_until(lambda: '/sim_robot' not in recorder._parameter_watch.nodes)
    harness.add(SimRobotNode, seed=4)
    harness.spin_until(lambda: recorder._metadata.records['sim_robot']['seed'] == '4')
    with recorded(harness, recorder) as recording:
        assert recording.metadata_records['sim_robot']['seed'] == '4'


def all_bytes(folder):
    """Return all bytes of a bag that a reader can access: raw, decompressed, metadata."""
    found = [path.read_bytes() for path in folder.rglob('*') if path.is_file()]
    for path in folder.rglob('*.mcap'):
        with path.open('rb') as file:
            reader = make_reader(file)
            found += [message.data for _, _, message in reader.iter_messages()]
            found += [str(item.metadata).encode() for item in reader.iter_metadata()]
    return b'\n'.join(found)


def forms(seed):
    """Return how a seed of 128 bits may be written: decimal, hexadecimal, halves in memory."""
    halves = seed % 2**64, seed >> 64
    packed = [struct.pack(order, half) for half in halves for order in ('<Q', '>Q')]
    return [str(seed).encode(), f'{seed:x}'.encode(), f'{seed:X}'.encode(), *packed]


@pytest.mark.parametrize('source', ['signals', 'portrait'])
def test_a_bag_holds_the_fingerprint_of_a_secret_seed_only(harness, tmp_path, source):
    topics = 'reference', 'reference/*', '/diagnostics', '/rosout', '/parameter_events'
    recorder = record(harness, tmp_path, *topics)
    chosen = {'source': source} if source == 'portrait' else {'secret_seed': True}
    reference = harness.add(ReferenceGeneratorNode, **chosen)
    robot = harness.create_publisher(Odometry, 'odom')  # a path begins where the robot is
    harness.publish_periodically(robot, lambda: odometry(0))
    seeds = [reference._seed]
    harness.spin_until(
        lambda: {SEED_RECORD, 'reference_generator'} <= recorder._metadata.records.keys()
    )
    first = recorder._metadata.records[SEED_RECORD]['reference_generator']
    harness.done(Trigger, 'reference_generator/reseed')
    seeds.append(reference._seed)
    harness.spin_until(
        lambda: recorder._metadata.records[SEED_RECORD]['reference_generator'] != first
    )
    harness.spin_until(lambda: values(recorder)['messages'] > 100)
    harness.remove(recorder)
    assert all(seed.bit_length() > 64 for seed in seeds)
    assert seeds[0] != seeds[1]
    with open_bag(tmp_path) as recording:
        text = recording.metadata_records[SEED_RECORD]['reference_generator']
        assert recording.metadata_records['reference_generator']['seed'] == '0'
        assert recording.topics['/reference'].message_count
    assert matches_fingerprint(first, seeds[0])
    assert matches_fingerprint(text, seeds[1])
    assert not matches_fingerprint(text, seeds[0])
    content = all_bytes(tmp_path)
    assert text.encode() in content, 'the search finds text that is present'
    assert not [form for seed in seeds for form in forms(seed) if form in content]


def test_secret_seed_excludes_a_given_seed(harness):
    with pytest.raises(ParameterError, match='lead must be at most 0.973 s at a rate of 2000 Hz'):
        harness.add(ReferenceGeneratorNode, lead=1.0, rate=2000.0)
    with pytest.raises(ParameterError, match='seed must be 0 with secret_seed: got 7'):
        harness.add(ReferenceGeneratorNode, secret_seed=True, seed=7)


def test_an_e_stop_of_the_own_robot_starts_a_snapshot(harness, tmp_path):
    recorder = record(harness, tmp_path, 'odom', 'cmd_vel', namespace='a')
    robots = [harness.add(SimRobotNode, namespace=name) for name in ('a', 'b')]
    for name in ('a', 'b'):
        CommandSource(harness, twist(0.1), f'{name}/cmd_vel')
    for name in ('a', 'b'):
        harness.spin_until(
            lambda name=name: any(s.level == OK for s in harness.statuses(f'{name}/sim_robot'))
        )
    harness.call(SetBool, 'b/e_stop', data=True)
    harness.spin_until(lambda: harness.statuses('b/sim_robot')[-1].level == ERROR)
    assert not recorder._snapshots.busy
    assert values(recorder)['snapshots'] == 0, 'only the own robot starts a snapshot'
    harness.call(SetBool, 'a/e_stop', data=True)
    harness.spin_until(lambda: values(recorder)['snapshots'] == 1)
    harness.remove(recorder)
    (folder,) = snapshots(tmp_path)
    assert '_a-sim-robot-emergency-stop' in folder.name
    with open_bag(folder) as recording:
        assert recording.topics['/a/odom'].message_count > 50
        assert recording.topics['/a/cmd_vel'].message_count > 10
        status = recording.metadata_records['snapshot']['reason']
    assert status == f'a/sim_robot: {reason(robots[0])}'


FOUND = Calibration(
    wheel_radius=Estimate(0.0356, 2e-5),
    track=Estimate(0.1514, 9e-5),
    gyro_scale=Estimate(0.9873, 3e-4),
    curves=(SharpCurve(0.2793, 0.0261, 0.0553, 0.004), *7 * (None,)),
)


def test_the_calibration_is_in_the_bag(harness, tmp_path, capsys):
    files = yaml.safe_load(calibration_file(FOUND, '2026-11-22', {}))
    values = {
        node: {
            name.replace('.', '__'): value
            for name, value in files[f'/**/{node}']['ros__parameters'].items()
        }
        for node in ('radio_bridge', 'controller')
    }
    recorder = harness.add(RecorderNode, storage__uri=str(tmp_path / 'bag'))
    harness.add(RadioBridgeNode, port=str(tmp_path / 'none'), **values['radio_bridge'])
    harness.add(ControllerNode, **values['controller'])
    harness.spin_until(lambda: {'radio_bridge', 'controller'} <= set(recorder._metadata.records))
    with recorded(harness, recorder) as recording:
        bridge = recording.metadata_records['radio_bridge']
        controller = recording.metadata_records['controller']
    assert float(bridge['wheel_radius']) == float(controller['wheel_radius']) == 0.0356
    assert float(bridge['calibration.wheel_radius_uncertainty']) == 2e-5
    assert float(bridge['odometry.gyro_scale']) == 0.9873
    assert '0.2793' in bridge['calibration.range_scale']
    assert bag_cli.main(['info', str(tmp_path / 'bag')]) == 0
    shown = capsys.readouterr().out
    assert 'calibration of radio_bridge' in shown
    assert '2026-11-22' in shown
