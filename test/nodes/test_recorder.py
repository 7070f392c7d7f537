# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the recorder selects, drops, attaches and hides, and what it does at a fault."""

import os
import shutil
import struct
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
import pytest
from rcl_interfaces.msg import Log
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import Int32, Int64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from test_nodes_behaviour import LATCHED, Driver, World, reason, twist

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.run.model_file import load_model, save_model
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.chaos.seed_fingerprint import matches_fingerprint
from t3mpc_ros.nodes.common.base_node import ERROR, OK, WARN
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.recorder.metadata import SEED_TABLE
from t3mpc_ros.nodes.recorder.node import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

DEEP = QoSProfile(depth=5000)


@pytest.fixture
def world(ros):
    made = World()
    yield made
    made.close()


def record(world, folder, *topics, **more):
    return world.add(RecorderNode, folder=str(folder), topics=list(topics), **more)


def values(recorder):
    return recorder.produce_diagnostics()[2]


def texts(folder, topic='/text'):
    with open_bag(folder) as recording:
        return [message.data for _, message in recording.messages(topic)]


def files(path):
    with path.open('rb') as file:
        return {item.name: item.data for item in make_reader(file).iter_attachments()}


# -- load -----------------------------------------------------------------------------------------


def test_receipt_is_stamped_when_a_message_comes_not_when_it_is_taken(world, tmp_path):
    recorder = record(world, tmp_path, 'text')
    text = world.speak(String, 'text')
    world.found(text)
    sent = []
    for number in range(5):
        sent.append(time.time_ns())
        text.publish(String(data=str(number)))
        time.sleep(0.1)  # nobody spins
    taken = time.time_ns()
    world.until(lambda: values(recorder)['messages'] == 5)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        stamps = [recording.start_ns + round(at * 1e9) for at, _ in recording.messages('/text')]
    for before, received, after in zip(sent, stamps, [*sent[1:], taken], strict=True):
        assert before - 1_000 <= received < after


def test_what_finds_no_room_is_dropped_counted_and_told_at_once(world, tmp_path, monkeypatch):
    log = world.hear(Log, '/rosout', LATCHED)
    recorder = record(world, tmp_path, 'text', 'number', queue_bytes=65_536)
    text, number = world.speak(String, 'text', DEEP), world.speak(Int32, 'number', DEEP)
    world.found(text)
    world.found(number)
    stuck, write = threading.Event(), BagWriter.write
    monkeypatch.setattr(BagWriter, 'write', lambda *given: (stuck.wait(20.0), write(*given)))
    for i in range(400):
        text.publish(String(data=f'{i} {"x" * 200}'))
        number.publish(Int32(data=i))
    world.until(lambda: values(recorder)['dropped'] > 0)
    world.until(lambda: any('the disk is too slow' in entry.msg for entry in log))
    entry = next(entry for entry in log if 'the disk is too slow' in entry.msg)
    assert entry.level == 40
    assert '/text' in entry.msg
    world.until(lambda: any(s.level == ERROR for s in world.said('recorder')))
    assert values(recorder)['queue_bytes'] <= 65_536
    stuck.set()
    world.until(lambda: values(recorder)['queue_bytes'] == 0)
    world.until(lambda: recorder.produce_diagnostics()[0] == WARN)
    text.publish(String(data='again'))
    world.until(lambda: values(recorder)['messages'] == 801)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        lost = recording.metadata_records['losses']
        counts = {name: topic.message_count for name, topic in recording.topics.items()}
    assert counts['/text'] + int(lost['dropped /text']) == 401
    assert counts['/number'] + int(lost['dropped /number']) == 400
    assert int(lost['dropped']) == 801 - sum(counts.values())
    assert texts(tmp_path)[-1] == 'again'


def test_what_falls_out_of_the_middleware_s_queue_is_counted(world, tmp_path):
    """A full KEEP_LAST queue replaces its oldest samples, which DDS does not call lost."""
    recorder = record(world, tmp_path, 'text', chunk_time=0.05)
    text = world.speak(String, 'text', DEEP)
    world.found(text)
    text.publish(String(data='first'))
    world.until(lambda: values(recorder)['messages'] == 1)
    for i in range(1500):  # nobody spins, and the queue holds a thousand
        text.publish(String(data=str(i)))
    assert text.wait_for_all_acked(Duration(seconds=10))
    world.until(lambda: values(recorder)['messages'] == 1001)
    assert values(recorder)['lost'] == 500
    assert recorder.produce_diagnostics()[0] == WARN
    world.remove(recorder)
    assert texts(tmp_path) == ['first', *map(str, range(500, 1500))]
    with open_bag(tmp_path) as recording:
        assert recording.metadata_records['losses']['lost /text'] == '500'


# -- selection ------------------------------------------------------------------------------------


def test_expressions_and_types_select_in_the_graph(world, tmp_path):
    recorder = record(
        world, tmp_path, regex='/cam_[0-9]', exclude='/.*secret', types=['std_msgs/msg/Int32']
    )
    says = {name: world.speak(String, name) for name in ('cam_1', 'cam_x', 'other')}
    counts = {name: world.speak(Int32, name) for name in ('count', 'secret')}
    for name in ('cam_1', 'count'):
        world.found((says | counts)[name])
    for publisher in says.values():
        publisher.publish(String(data='x'))
    for publisher in counts.values():
        publisher.publish(Int32(data=1))
    world.until(lambda: values(recorder)['messages'] == 2)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert sorted(recording.topics) == ['/cam_1', '/count']


def test_a_bad_expression_is_refused_with_its_place(world, tmp_path):
    with pytest.raises(ParameterError, match=r'regex must be a regular expression.*position 0'):
        record(world, tmp_path, regex='*')


def test_a_topic_that_is_expected_and_turns_out_latched_is_heard_from_its_begin(world, tmp_path):
    """The recorder subscribed beforehand, as volatile, and so missed what was latched by then."""
    journal = world.speak(Int64MultiArray, 'controller/journal', LATCHED)
    for number in range(5):
        journal.publish(Int64MultiArray(data=[number]))
    recorder = record(world, tmp_path, 'controller/*')
    world.until(lambda: values(recorder)['messages'] == 5)
    world.found(journal)
    journal.publish(Int64MultiArray(data=[5]))
    world.until(lambda: values(recorder)['messages'] == 6)
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        numbers = recording.series('/controller/journal', {'n': 'data[0]'})['n']
    assert numbers.tolist() == [0, 1, 2, 3, 4, 5]


# -- snapshots ------------------------------------------------------------------------------------


def snapshots(folder):
    return sorted((folder / 'snapshots').iterdir())


def test_a_snapshot_asked_for_has_the_last_seconds_and_the_recording_goes_on(world, tmp_path):
    recorder = record(world, tmp_path, 'text', 'map')
    text, latched = world.speak(String, 'text'), world.speak(String, 'map', LATCHED)
    world.found(text)
    latched.publish(String(data='the map'))
    for number in range(20):
        text.publish(String(data=str(number)))
    world.until(lambda: values(recorder)['messages'] == 21)
    answer = world.call(Trigger, 'recorder/snapshot')
    assert answer.success, answer.message
    text.publish(String(data='after'))
    world.until(lambda: values(recorder)['snapshots'] == 1)
    world.until(lambda: values(recorder)['messages'] == 22)
    world.remove(recorder)
    (folder,) = snapshots(tmp_path)
    assert str(folder) in answer.message
    assert folder.name.endswith('_asked-for')
    assert texts(folder) == list(map(str, range(20)))
    assert texts(folder, '/map') == ['the map']
    with open_bag(folder) as recording:
        assert recording.metadata_records['snapshot']['reason'] == 'asked for'
        assert recording.metadata_records['provenance']['version']
    assert texts(tmp_path)[-1] == 'after'


def test_a_fault_takes_one_snapshot_and_says_why(world, tmp_path):
    log = world.hear(Log, '/rosout', LATCHED)
    recorder = record(world, tmp_path, 'text')
    text = world.speak(String, 'text')
    reports = world.speak(DiagnosticArray, '/diagnostics')
    world.found(text)
    world.found(reports, 2)  # the probe listens, too

    def report(level, reason, name='sim_robot'):
        status = DiagnosticStatus(level=level, name=name, message=reason)
        reports.publish(DiagnosticArray(status=[status]))
        text.publish(String(data=reason))

    report(ERROR, 'no time yet')
    report(OK, 'following commands')
    report(ERROR, 'not of this robot', name='other/sim_robot')
    for _ in range(3):
        report(ERROR, 'e-stop latched')
    world.until(lambda: values(recorder)['snapshots'] == 1)
    report(OK, 'following commands')
    report(ERROR, 'e-stop latched')  # at once again: too soon
    world.until(lambda: any('snapshot_pause' in entry.msg for entry in log))
    world.remove(recorder)
    (folder,) = snapshots(tmp_path)
    assert 'sim-robot-e-stop-latched' in folder.name
    with open_bag(folder) as recording:
        assert recording.metadata_records['snapshot']['reason'] == 'sim_robot: e-stop latched'
    assert 'following commands' in texts(folder)


def test_an_emergency_stop_of_the_own_robot_takes_a_snapshot(world, tmp_path):
    recorder = record(world, tmp_path, 'odom', 'cmd_vel', namespace='a')
    robots = [world.add(SimRobotNode, namespace=name) for name in ('a', 'b')]
    drivers = [Driver(world, f'{name}/cmd_vel') for name in ('a', 'b')]
    for driver in drivers:
        driver.message = twist(0.1)
    for name in ('a', 'b'):
        world.until(lambda name=name: any(s.level == OK for s in world.said(f'{name}/sim_robot')))
    world.call(SetBool, 'b/e_stop', data=True)
    world.until(lambda: world.said('b/sim_robot')[-1].level == ERROR)
    assert not recorder._camera.busy
    assert values(recorder)['snapshots'] == 0, 'another robot is no concern of this recorder'
    world.call(SetBool, 'a/e_stop', data=True)
    world.until(lambda: values(recorder)['snapshots'] == 1)
    world.remove(recorder)
    (folder,) = snapshots(tmp_path)
    assert '_a-sim-robot-emergency-stop' in folder.name
    with open_bag(folder) as recording:
        assert recording.topics['/a/odom'].message_count > 50
        assert recording.topics['/a/cmd_vel'].message_count > 10
        said = recording.metadata_records['snapshot']['reason']
    assert said == f'a/sim_robot: {reason(robots[0])}'


def test_a_controller_that_stops_takes_a_snapshot(world, tmp_path):
    recorder = record(world, tmp_path, 'odom', 'controller/*')
    world.add(SimRobotNode)
    world.add(ReferenceGeneratorNode)
    controller = world.add(ControllerNode)
    world.until(lambda: any(s.level == OK for s in world.said('controller')))
    assert values(recorder)['snapshots'] == 0, 'nothing was wrong while they found each other'
    assert world.call(SetBool, 'controller/enable', data=False).success
    world.until(lambda: values(recorder)['snapshots'] == 1)
    stopped = reason(controller)
    world.remove(recorder)
    with open_bag(snapshots(tmp_path)[0]) as recording:
        assert recording.metadata_records['snapshot']['reason'] == f'controller: {stopped}'
        assert float(recording.metadata_records['controller']['law.gain']) > 0.0
        assert '/controller/error/left' in recording.topics


def test_snapshots_alone_write_nothing_else(world, tmp_path):
    recorder = record(world, tmp_path, 'text', snapshot_only=True, snapshot_time=60.0)
    assert world.call(Trigger, 'recorder/split').success is False
    answer = world.call(Trigger, 'recorder/snapshot')
    assert not answer.success
    assert 'nothing has been received' in answer.message
    text = world.speak(String, 'text')
    world.found(text)
    text.publish(String(data='kept'))
    world.until(lambda: values(recorder)['messages'] == 1)
    assert list(tmp_path.glob('*')) == []
    assert world.call(Trigger, 'recorder/snapshot').success
    world.until(lambda: values(recorder)['snapshots'] == 1)
    assert list(tmp_path.glob('*.mcap')) == []
    assert texts(snapshots(tmp_path)[0]) == ['kept']
    assert recorder.produce_diagnostics()[0] == OK


def test_snapshots_can_be_turned_off(world, tmp_path):
    record(world, tmp_path, 'text', snapshot_time=0.0)
    answer = world.call(Trigger, 'recorder/snapshot')
    assert not answer.success
    assert 'snapshot_time must be above 0' in answer.message


def test_a_snapshot_that_cannot_be_written_is_told_and_the_recording_goes_on(world, tmp_path):
    (tmp_path / 'snapshots').write_text('a file where a folder is wanted')
    log = world.hear(Log, '/rosout', LATCHED)
    recorder = record(world, tmp_path, 'text')
    text = world.speak(String, 'text')
    world.found(text)
    text.publish(String(data='one'))
    world.until(lambda: values(recorder)['messages'] == 1)
    assert world.call(Trigger, 'recorder/snapshot').success
    world.until(lambda: any(e.level == 40 and 'no snapshot of' in e.msg for e in log))
    assert recorder.produce_diagnostics()[0] == WARN
    text.publish(String(data='two'))
    world.until(lambda: values(recorder)['messages'] == 2)
    world.remove(recorder)
    assert recorder.exit_code == 0
    assert texts(tmp_path) == ['one', 'two']


# -- where the numbers come from ------------------------------------------------------------------


def test_the_models_of_a_controller_are_attached_to_every_file(world, tmp_path):
    model, output = tmp_path / 'start.npz', tmp_path / 'learnt.npz'
    first = world.add(ControllerNode)
    save_model(model, first._controller.law.get_weights(), first.parameters.to_dict())
    world.remove(first)
    shutil.copy(model, output)
    os.utime(output, (1, 1))  # of a run before
    world_map = tmp_path / 'room.yaml'
    world_map.write_text('walls: []')
    bag = tmp_path / 'bag'
    recorder = record(world, bag, 'odom', attach=[str(world_map)])
    world.add(ControllerNode, model=str(model), model_output=str(output))
    world.until(lambda: 'controller' in recorder._details)
    assert world.call(Trigger, 'recorder/split').success
    assert world.call(Trigger, 'controller/save_model').success
    world.remove(recorder)
    one, two = sorted(bag.glob('*.mcap'))
    assert files(one) == {
        'room.yaml': b'walls: []',
        'controller/start.npz': model.read_bytes(),
    }
    assert files(two) == files(one) | {'controller/saved_learnt.npz': output.read_bytes()}
    (tmp_path / 'again.npz').write_bytes(files(two)['controller/saved_learnt.npz'])
    assert load_model(tmp_path / 'again.npz').keys() == load_model(model).keys()


def test_a_node_that_comes_again_with_other_settings_is_asked_again(world, tmp_path):
    """The bag once kept the settings of the first of two controllers."""
    recorder = record(world, tmp_path, 'odom')
    robot = world.add(SimRobotNode, seed=3)
    world.until(lambda: recorder._details.get('sim_robot', {}).get('seed') == '3')
    world.remove(robot)
    world.until(lambda: 'sim_robot' not in recorder.get_node_names())
    world.until(lambda: '/sim_robot' not in recorder._questions._asked)
    world.add(SimRobotNode, seed=4)
    world.until(lambda: recorder._details['sim_robot']['seed'] == '4')
    world.remove(recorder)
    with open_bag(tmp_path) as recording:
        assert recording.metadata_records['sim_robot']['seed'] == '4'


def everything(folder):
    """Return all bytes that a reader of the bag could get at: raw, unpacked, details."""
    found = [path.read_bytes() for path in folder.rglob('*') if path.is_file()]
    for path in folder.rglob('*.mcap'):
        with path.open('rb') as file:
            reader = make_reader(file)
            found += [message.data for _, _, message in reader.iter_messages()]
            found += [str(item.metadata).encode() for item in reader.iter_metadata()]
    return b'\n'.join(found)


def test_a_secret_seed_can_be_checked_against_the_bag_and_not_be_found_in_it(world, tmp_path):
    topics = 'reference', 'reference/*', '/diagnostics', '/rosout', '/parameter_events'
    recorder = record(world, tmp_path, *topics)
    reference = world.add(ReferenceGeneratorNode, secret_seed=True)
    seeds = [reference._seed]
    world.until(lambda: SEED_TABLE in recorder._details and 'reference' in recorder._details)
    first = recorder._details[SEED_TABLE]['reference']
    assert world.call(Trigger, 'reference/reseed').success
    seeds.append(reference._seed)
    world.until(lambda: recorder._details[SEED_TABLE]['reference'] != first)
    world.until(lambda: values(recorder)['messages'] > 100)
    world.remove(recorder)
    assert all(seed.bit_length() > 64 for seed in seeds)
    assert seeds[0] != seeds[1]
    with open_bag(tmp_path) as recording:
        text = recording.metadata_records[SEED_TABLE]['reference']
        assert recording.metadata_records['reference']['seed'] == '0'
        assert recording.metadata_records['reference']['secret_seed'] == 'True'
    assert matches_fingerprint(first, seeds[0])
    assert matches_fingerprint(text, seeds[1])
    assert not matches_fingerprint(text, seeds[0])
    content = everything(tmp_path)
    assert text.encode() in content, 'or the search would find nothing whatever there was'
    for seed in seeds:
        low = struct.pack('<Q', seed % 2**64), struct.pack('>Q', seed % 2**64)
        high = struct.pack('<Q', seed >> 64), struct.pack('>Q', seed >> 64)
        for form in (str(seed).encode(), f'{seed:x}'.encode(), *low, *high):
            assert form not in content


def test_a_secret_seed_and_a_given_one_exclude_each_other(world):
    with pytest.raises(ParameterError, match='seed must be 0 with secret_seed: got 7'):
        world.add(ReferenceGeneratorNode, secret_seed=True, seed=7)


def test_a_mistake_in_the_writing_thread_is_told_and_does_not_look_like_a_recording(
    world, tmp_path, monkeypatch
):
    recorder = record(world, tmp_path, 'text')
    text = world.speak(String, 'text')
    world.found(text)
    text.publish(String(data='kept'))
    world.until(lambda: values(recorder)['messages'] == 1)
    assert world.call(Trigger, 'recorder/split').success

    def wrong(*_):
        raise TypeError('a mistake')

    monkeypatch.setattr(BagWriter, 'write', wrong)
    text.publish(String(data='lost'))
    world.until(lambda: recorder.exit_code == 1)
    assert recorder.produce_diagnostics()[:2] == (
        ERROR,
        'writing has failed: TypeError: a mistake',
    )
    assert not world.call(Trigger, 'recorder/split').success
    world.remove(recorder)
    assert texts(tmp_path) == ['kept']
