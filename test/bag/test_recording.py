# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is recorded, what waits, what is kept for a snapshot: all in virtual time."""

import threading

from mcap.reader import make_reader
import pytest
from rosbags.rosbag2 import Reader

from t3mpc_ros.bag import writer
from t3mpc_ros.bag.mcap_file import finalize_file, read_file_summary
from t3mpc_ros.bag.metadata import read_metadata
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recording.diagnostics_monitor import (
    REPORT_TIMEOUT_NS,
    DiagnosticsMonitor,
    SnapshotRateLimiter,
    snapshot_folder_name,
)
from t3mpc_ros.bag.recording.message_queue import MessageQueue
from t3mpc_ros.bag.recording.recording_parameters import RecordingParameters
from t3mpc_ros.bag.recording.snapshot import CircularMessageCache, unused_folder, write_snapshot
from t3mpc_ros.bag.recording.split_writer import SplitWriter, message_loss_record
from t3mpc_ros.bag.topic_filter import TopicFilter, TopicFilterError
from t3mpc_ros.bag.writer import (
    MESSAGE_OVERHEAD,
    Attachment,
    AttachmentError,
    BagWriter,
    DiskError,
    FolderError,
    SerializedMessage,
    TopicMetadata,
    read_attachment,
    read_attachments,
)
from t3mpc_ros.parameters.table import ParameterError

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
NUMBER = 'std_msgs/msg/Float64'
OK, WARN, ERROR, STALE = range(4)


def message(topic, seconds, size=12, fill=1):
    stamp = START + round(seconds * SECOND)
    return SerializedMessage(
        topic, stamp, stamp - 1000, bytes([0, 1, 0, 0]) + bytes([fill]) * (size - 4)
    )


def noise(seconds, size=2000):
    """Return a message that does not become smaller by compression."""
    import random

    data = random.Random(seconds).randbytes(size)
    return message('/n', seconds)._replace(data=data)


def read(path):
    with path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        return [
            SerializedMessage(channel.topic, item.log_time, item.publish_time, item.data)
            for _, channel, item in reader.iter_messages()
        ]


def attachments(path):
    with path.open('rb') as file:
        return list(make_reader(file, validate_crcs=True).iter_attachments())


# -- selection ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'topic, wanted',
    [
        ('/a/odom', True),
        ('/odom', False),
        ('/a/imu/data', True),
        ('/a/imu/deep/data', True),
        ('/a/imu', False),
        ('/diagnostics', True),
        ('/camera/image', True),
        ('/camera/image_raw', False),
        ('/a/camera/image', False),
        ('/a/imu/secret', False),
        ('/a/imu/_hidden', False),
        ('/a/_named', True),
    ],
)
def test_names_patterns_and_expressions_select_and_exclude_has_the_last_word(topic, wanted):
    selection = TopicFilter(
        ['/a/odom', '/diagnostics', '/a/_named', '/a/imu/secret'],
        ['odom', 'imu/*', '/diagnostics', '_named'],
        regex='/camera/(image|info)',
        exclude='.*/secret',
        namespace='/a',
    )
    assert selection.matches(topic) == wanted


def test_a_type_selects_whatever_the_name():
    selection = TopicFilter([], types=[NUMBER], exclude='/not')
    assert selection.matches('/any', ['std_msgs/msg/String', NUMBER])
    assert not selection.matches('/any', ['std_msgs/msg/String'])
    assert not selection.matches('/not', [NUMBER])
    assert not selection.matches('/a/_hidden', [NUMBER])
    assert not selection.matches('/any')


def test_the_controller_s_journal_is_recorded_by_default():
    parameters = RecordingParameters()
    selection = TopicFilter([], parameters.topics, namespace='/robot')
    for name in ('controller/journal', 'controller/parameters', 'controller/terms/reach/left'):
        assert selection.matches(f'/robot/{name}')


@pytest.mark.parametrize('name', ['regex', 'exclude'])
def test_what_is_no_regular_expression_is_refused_with_name_place_and_value(name):
    with pytest.raises(TopicFilterError, match=rf"{name} must be .*'a\(b'.*position 1"):
        TopicFilter([], **{name: 'a(b'})
    with pytest.raises(ParameterError, match=rf"{name} must be .*'a\(b'.*position 1"):
        RecordingParameters.from_dict({name: 'a(b'})


def test_settings_that_record_nothing_or_name_no_type_are_refused():
    with pytest.raises(ParameterError, match='snapshot_time must be above 0'):
        RecordingParameters.from_dict({'snapshot_only': True, 'snapshot_time': 0.0})
    with pytest.raises(ParameterError, match="types must be .* got 'Odometry'"):
        RecordingParameters.from_dict({'types': ['Odometry']})


# -- what waits -----------------------------------------------------------------------------------


def test_messages_and_orders_come_out_in_the_order_in_which_they_were_put():
    backlog = MessageQueue(10_000)
    one, two, three = (message('/n', i) for i in range(3))
    order = object()
    assert backlog.put([one, two]) == {}
    backlog.order(order)
    assert backlog.put([three]) == {}
    assert backlog.take() == [one, two, order, three]
    assert backlog.take() == []


def test_what_finds_no_room_is_counted_by_topic_and_nothing_after_it_is_let_in():
    backlog = MessageQueue(3 * (12 + MESSAGE_OVERHEAD))
    assert backlog.put([message('/a', 0), message('/a', 1)]) == {}
    big, small = message('/b', 2, size=12 + MESSAGE_OVERHEAD + 1), message('/a', 3)
    assert backlog.put([big, small, small]) == {'/b': 1, '/a': 2}
    assert backlog.put([small]) == {}
    assert backlog.put([small]) == {'/a': 1}
    assert backlog.dropped == {'/b': 1, '/a': 3}
    backlog.order(print)
    assert [type(item) for item in backlog.take()[:3]] == [SerializedMessage] * 3


def test_room_is_free_only_when_what_was_taken_is_done_with():
    """The bound once held for what waited only: twice as much could be in memory."""
    item = message('/a', 0)
    backlog = MessageQueue(2 * item.cost)
    assert backlog.put([item, item]) == {}
    assert len(backlog.take()) == 2
    assert backlog.bytes == 2 * item.cost
    assert backlog.put([item]) == {'/a': 1}
    assert backlog.take() == []
    assert backlog.bytes == 0
    assert backlog.put([item]) == {}


def test_every_message_is_either_taken_or_counted_whatever_the_threads_do():
    backlog = MessageQueue(40 * message('/a', 0).cost)
    taken, count = [], 4000

    def give():
        for number in range(count):
            backlog.put([message('/a', number)])
        backlog.order('end')

    giver = threading.Thread(target=give)
    giver.start()
    while 'end' not in taken:
        taken += backlog.take(0.001)
    giver.join()
    kept = [item.received_ns for item in taken[:-1]]
    assert kept == sorted(kept)
    assert len(kept) + backlog.dropped.get('/a', 0) == count


# -- files of one recording -----------------------------------------------------------------------


def series(folder, **options):
    made = SplitWriter(folder, {'provenance': {'commit': 'abc'}}, **options)
    made.add_topic(TopicMetadata('/n', NUMBER))
    return made


def test_what_is_older_than_the_chunk_time_is_in_the_file_also_in_silence(tmp_path):
    """A chunk was once closed by the next message only: after the last one none came."""
    bag = series(tmp_path / 'bag', chunk_ns=SECOND // 2)
    for step in range(40):  # two seconds, ticks of 50 ms
        now = step * SECOND // 20
        if step % 2 == 0 and step < 10:
            bag.write(message('/n', step / 20), now)
        bag.tick(now)
        torn = tmp_path / f'torn_{step}.mcap'
        torn.write_bytes(bag.path.read_bytes())
        there = finalize_file(torn)
        due = len([i for i in range(0, 10, 2) if i * SECOND // 20 <= now - SECOND // 2])
        assert there >= due, f'at {now / SECOND:.2f} s'
    assert there == 5


def test_the_disk_is_waited_for_at_most_once_a_second_and_only_when_something_is_new(
    tmp_path, monkeypatch
):
    bag = series(tmp_path / 'bag', chunk_ns=SECOND // 10)
    synced = []
    monkeypatch.setattr(writer.os, 'fsync', synced.append)
    for step in range(100):  # five seconds; messages in the first half of them
        now = SECOND + step * SECOND // 20
        if step < 50:
            bag.write(message('/n', step / 20), now)
        bag.tick(now)
    assert 3 <= len(synced) <= 4


@pytest.mark.parametrize('options', [{'split_bytes': 20_000}, {'split_ns': SECOND}])
def test_a_split_recording_has_everything_once_and_each_file_stands_alone(tmp_path, options):
    folder = tmp_path / 'bag'
    bag = series(folder, chunk_bytes=8000, **options)
    bag.add_attachment(Attachment('model.npz', 'application/zip', b'weights', 5), START)
    bag.add_metadata_record('controller', {'law.gain': '8.0'})
    written = [noise(i / 10) for i in range(50)]
    for i, item in enumerate(written):
        bag.write(item, i * SECOND // 10)
        if i % 10 == 9:  # metadata.yaml is written with each split
            files = sorted(path.name for path in folder.glob('*.mcap'))
            assert len(read_metadata(folder).files) == len(files) - 1
    bag.close()
    files = [folder / file.path for file in read_metadata(folder).files]
    assert len(files) >= 5
    parts = [read(path) for path in files]
    assert [item for part in parts for item in part] == written
    for path in files:
        assert read_file_summary(path).metadata_records['controller'] == {'law.gain': '8.0'}
        assert read_file_summary(path).metadata_records['provenance'] == {'commit': 'abc'}
        assert [(item.name, item.data) for item in attachments(path)] == [
            ('model.npz', b'weights')
        ]
        if 'split_bytes' in options and path != files[-1]:
            assert 20_000 <= path.stat().st_size < 20_000 + 12_000
    if 'split_ns' in options:
        assert {len(part) for part in parts} == {10}
    with Reader(folder) as reader:
        assert reader.message_count == 50


def test_a_silent_recording_is_not_split(tmp_path):
    bag = series(tmp_path / 'bag', split_ns=SECOND, split_bytes=1)
    for step in range(100):
        bag.tick(step * SECOND)
    bag.close()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) == 1


def test_a_disk_that_is_full_at_a_split_leaves_the_file_before_it_complete(tmp_path, monkeypatch):
    bag = series(tmp_path / 'bag')
    bag.write(message('/n', 0), 0)

    def full(path, mode):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(writer, 'open_unbuffered', full)
    with pytest.raises(FolderError, match='No space left'):
        bag.split()
    with open_bag(tmp_path / 'bag') as recording:
        assert recording.message_count == 1


def test_losses_are_told_by_cause_and_topic():
    assert message_loss_record({'/b': 2, '/a': 1}, {'/a': 5}) == {
        'dropped': '3',
        'lost': '5',
        'dropped /a': '1',
        'dropped /b': '2',
        'lost /a': '5',
    }
    assert message_loss_record({}, {}) == {'dropped': '0', 'lost': '0'}


# -- attachments ----------------------------------------------------------------------------------


def test_a_file_comes_back_byte_by_byte_with_its_kind_and_time(tmp_path):
    path = tmp_path / 'model.npz'
    path.write_bytes(bytes(range(256)))
    item = read_attachment(path, 256, 'controller/model.npz')
    with BagWriter(tmp_path / 'bag', metadata_records={}) as bag:
        bag.add_attachment(item, START)
        bag.add_topic('/n', NUMBER)
        bag.write('/n', START, START, message('/n', 0).data)
    (found,) = attachments(bag.path)
    assert (found.name, found.media_type) == ('controller/model.npz', 'application/zip')
    assert found.data == bytes(range(256))
    assert (found.create_time, found.log_time) == (path.stat().st_mtime_ns, START)
    assert read_attachments(bag.path) == {item.name: item}
    assert len(read(bag.path)) == 1
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 1


def test_of_two_files_of_one_name_the_newer_one_is_meant(tmp_path):
    with BagWriter(tmp_path / 'bag', metadata_records={}) as bag:
        for i in (1, 2):
            bag.add_attachment(Attachment('a', 'text/plain', b'%d' % i), START + i)
    assert read_attachments(bag.path)['a'].data == b'2'
    bag.path.write_bytes(bag.path.read_bytes()[:-20])
    with pytest.raises(AttachmentError, match='cannot be read'):
        read_attachments(bag.path)


def test_a_file_that_is_missing_or_too_large_is_refused_with_the_bound(tmp_path):
    with pytest.raises(AttachmentError, match='none.npz cannot be attached: No such file'):
        read_attachment(tmp_path / 'none.npz', 10)
    (tmp_path / 'big').write_bytes(bytes(11))
    with pytest.raises(AttachmentError, match='at most 10 bytes'):
        read_attachment(tmp_path / 'big', 10)


def test_finishing_a_torn_file_keeps_its_attachments_and_gives_up_a_torn_one(tmp_path):
    bag = BagWriter(tmp_path / 'bag', metadata_records={'a': {'b': 'c'}})
    bag.add_topic('/n', NUMBER)
    sizes = []
    for i in range(3):
        bag.add_attachment(Attachment(f'file_{i}', 'text/plain', bytes([i]) * 500), START)
        bag.write('/n', START + i, START, message('/n', i).data)
        bag.flush()
        sizes.append(bag.size)
    whole = bag.path.read_bytes()
    torn = tmp_path / 'torn.mcap'
    for size, messages, files in ((sizes[2], 3, 3), (sizes[1], 2, 2), (sizes[1] + 300, 2, 2)):
        torn.write_bytes(whole[:size])
        assert finalize_file(torn) == messages
        assert len(read(torn)) == messages
        found = attachments(torn)
        assert [item.name for item in found] == [f'file_{i}' for i in range(files)]
        assert [item.data for item in found] == [bytes([i]) * 500 for i in range(files)]
        with torn.open('rb') as file:
            statistics = make_reader(file).get_summary().statistics
        assert (statistics.attachment_count, statistics.message_count) == (files, messages)
    damaged = bytearray(whole[: sizes[1]])
    damaged[sizes[0] + 100] ^= 1  # inside the second attachment
    torn.write_bytes(damaged)
    assert finalize_file(torn) == 1
    assert len(attachments(torn)) == 1


def test_a_full_disk_is_reported_by_an_attachment_too(tmp_path, monkeypatch):
    bag = BagWriter(tmp_path / 'bag', metadata_records={})

    def full(data):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(bag._output, 'write', full)
    with pytest.raises(DiskError, match='No space left'):
        bag.add_attachment(Attachment('a', 'text/plain', b'x'), START)


# -- snapshots ------------------------------------------------------------------------------------


def test_a_ring_holds_the_last_seconds_and_no_more_memory_than_it_may():
    ring = CircularMessageCache(10 * SECOND, 10**6)
    for step in range(300):
        ring.add([message('/n', step / 10)])
    now = START + 30 * SECOND
    held = ring.held(now)
    assert [item.received_ns for item in held] == [
        START + step * SECOND // 10 for step in range(200, 300)
    ]
    assert ring.held(now + 5 * SECOND) == held[50:], 'in silence it grows old'
    small = CircularMessageCache(10 * SECOND, 5 * message('/n', 0).cost)
    for step in range(300):
        small.add([message('/n', step / 10)])
        assert small.bytes <= 5 * message('/n', 0).cost
    assert small.held(now) == held[-5:]


def test_latched_messages_are_kept_however_old_one_of_each_publisher():
    ring = CircularMessageCache(10 * SECOND, 10**6)
    ring.latch('/map', 1)
    ring.latch('/static', 2)
    ring.add([message('/map', 0, fill=1), message('/map', 1, fill=2)])
    ring.add([message('/static', 2 + i, fill=10 + i) for i in range(3)])
    ring.add([message('/n', 15 + i) for i in range(30)])
    held = ring.held(START + 44 * SECOND)
    begin = START + 34 * SECOND
    assert [(item.topic, item.data[-1], item.received_ns) for item in held[:3]] == [
        ('/map', 2, begin),
        ('/static', 11, begin),
        ('/static', 12, begin),
    ]
    assert held[0].published_ns == START + SECOND - 1000, 'the other stamp tells how old it is'
    assert {item.topic for item in held[3:]} == {'/n'}
    assert held == sorted(held, key=lambda item: item.received_ns)


def test_a_latched_message_that_is_recent_stands_once_with_its_own_time():
    ring = CircularMessageCache(10 * SECOND, 10**6)
    ring.latch('/map', 1)
    ring.add([message('/n', 0), message('/map', 5)])
    held = ring.held(START + 9 * SECOND)
    assert [(item.topic, item.received_ns) for item in held] == [
        ('/n', START),
        ('/map', START + 5 * SECOND),
    ]


def test_a_snapshot_is_a_bag_of_its_own_that_says_why(tmp_path):
    messages = [message('/n', i / 10) for i in range(450)] + [message('/unknown', 50)]
    pauses = []
    count = write_snapshot(
        tmp_path / 'snap',
        messages,
        topics={'/n': TopicMetadata('/n', NUMBER), '/quiet': TopicMetadata('/quiet', NUMBER)},
        metadata_records={'snapshot': {'reason': 'link lost'}},
        attachments=[(Attachment('a', 'text/plain', b'x'), START)],
        pause=lambda: pauses.append(1),
    )
    assert count == 450
    assert len(pauses) == 2
    with open_bag(tmp_path / 'snap') as recording:
        assert recording.message_count == 450
        assert recording.metadata_records['snapshot'] == {'reason': 'link lost'}
        assert list(recording.topics) == ['/n']


def test_snapshots_of_one_second_do_not_share_a_folder(tmp_path):
    names = []
    for _ in range(3):
        names.append(unused_folder(tmp_path, 'x').name)
        (tmp_path / names[-1]).mkdir()
    assert names == ['x', 'x_2', 'x_3']


def test_a_reason_becomes_a_name_that_every_file_system_takes():
    assert snapshot_folder_name('2026', 'sim_robot: e-stop /latched: Ö "x"!') == (
        '2026_sim-robot-e-stop-latched-x'
    )
    assert len(snapshot_folder_name('', 'a' * 500)) <= 60
    assert snapshot_folder_name('2026', '…') == '2026'


# -- faults ---------------------------------------------------------------------------------------


def test_one_fault_for_one_change_to_an_error_and_none_while_it_lasts():
    watch = DiagnosticsMonitor(['robot'])
    levels = [OK, WARN, ERROR, ERROR, STALE, ERROR, WARN, ERROR, OK, OK]
    found = [watch.update('robot', level, 'e-stop', i * SECOND) for i, level in enumerate(levels)]
    assert [i for i, fault in enumerate(found) if fault] == [2, 7]
    assert found[2].node == 'robot'
    assert found[2].reason == 'e-stop'
    assert watch.update('stranger', OK, '', 0) is None
    assert watch.update('stranger', ERROR, '', SECOND) is None


def test_what_has_not_begun_to_work_has_no_fault():
    """A controller says "stopped" as a warning before its first odometry, then as an error."""
    watch = DiagnosticsMonitor(['controller', 'radio_bridge'])
    assert watch.update('controller', WARN, 'stopped: waiting', 0) is None
    assert watch.update('controller', ERROR, 'stopped: no reference', 1) is None
    assert watch.update('radio_bridge', ERROR, 'handshake', 2) is None
    assert watch.silent(100 * SECOND) == []
    assert watch.update('controller', OK, 'tracking', 3) is None
    assert watch.update('controller', ERROR, 'stopped: no reference', 4)


def test_a_node_that_falls_silent_is_a_fault_once():
    watch = DiagnosticsMonitor(['controller'])
    watch.update('controller', OK, 'tracking', 0)
    assert watch.silent(REPORT_TIMEOUT_NS) == []
    (fault,) = watch.silent(REPORT_TIMEOUT_NS + 1)
    assert (fault.node, fault.reason) == ('controller', 'reports no longer')
    assert watch.silent(10 * REPORT_TIMEOUT_NS) == []
    watch.update('controller', OK, 'tracking', 11 * REPORT_TIMEOUT_NS)
    assert len(watch.silent(13 * REPORT_TIMEOUT_NS)) == 1


def test_a_node_that_was_started_anew_and_waits_is_not_taken_for_dead():
    watch = DiagnosticsMonitor(['controller'])
    watch.update('controller', OK, 'tracking', 0)
    watch.update('controller', WARN, 'stopped: waiting', SECOND)
    assert watch.silent(20 * SECOND) == []


def test_snapshots_unasked_for_are_spaced_and_numbered():
    budget = SnapshotRateLimiter(10 * SECOND, 3)
    answers = [budget.acquire(second * SECOND) for second in (0, 1, 9.9, 10, 30, 60)]
    assert [not answer for answer in answers] == [True, False, False, True, True, False]
    assert '1.0 s ago (snapshot_pause)' in answers[1]
    assert '3 already (snapshot_most)' in answers[5]
