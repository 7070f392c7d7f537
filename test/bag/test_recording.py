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
"""Topic filter, writer thread, split files, attachments, snapshots, monitor: in virtual time."""

from pathlib import Path
import random
import threading

from mcap.reader import make_reader
from mcap.records import Attachment
import pytest
from rosbags.rosbag2 import Reader
from support.bag_files import kept_messages, messages_of, metadata_of

from t3mpc_ros.bag import writer
from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.mcap_file import MESSAGE_OVERHEAD, SerializedMessage, read_mcap_file
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.metadata_yaml import TopicInformation
from t3mpc_ros.bag.player import PlaybackParameters
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recorder_parameters import RecordingParameters
from t3mpc_ros.bag.recording_metadata import message_loss_notes, message_loss_record
from t3mpc_ros.bag.snapshot_ring_buffer import (
    REPORT_TIMEOUT_NS,
    CircularMessageCache,
    DiagnosticsMonitor,
    SnapshotRateLimiter,
    SnapshotWriter,
    snapshot_folder_name,
    unused_folder,
)
from t3mpc_ros.bag.topic_filter import TopicFilter
from t3mpc_ros.bag.writer import (
    AttachmentError,
    BagWriter,
    DiskError,
    FolderError,
    read_attachment,
)
from t3mpc_ros.bag.writer_thread import WriterThread
from t3mpc_ros.parameters.table import ParameterError

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
NUMBER = 'std_msgs/msg/Float64'
OK, WARN, ERROR, STALE = range(4)
ITEM = Attachment(0, START, 'a', 'text/plain', b'x')


def message(topic, seconds, size=12, fill=1):
    stamp = START + round(seconds * SECOND)
    return SerializedMessage(
        topic, stamp, stamp - 1000, bytes([0, 1, 0, 0]) + bytes([fill]) * (size - 4)
    )


def noise(seconds, size=2000):
    """Return an incompressible message."""
    data = random.Random(seconds).randbytes(size)
    return message('/n', seconds)._replace(data=data)


def attachments(path):
    with path.open('rb') as file:
        return list(make_reader(file, validate_crcs=True).iter_attachments())


# -- topic filter ---------------------------------------------------------------------------------


def test_names_patterns_and_regex_select_exclusion_overrides():
    selection = TopicFilter(
        ['/a/odom', '/diagnostics', '/a/_named', '/a/imu/secret'],
        ['odom', 'imu/*', '/diagnostics', '_named'],
        regex='/camera/(image|info)',
        exclude_regex='.*/secret',
        namespace='/a',
    )
    for topic, recorded in {
        '/a/odom': True, '/odom': False, '/a/imu/data': True, '/a/imu/deep/data': True,
        '/a/imu': False, '/diagnostics': True, '/camera/image': True, '/camera/image_raw': False,
        '/a/camera/image': False, '/a/imu/secret': False, '/a/imu/_hidden': False,
        '/a/_named': True,
    }.items():  # fmt: skip
        assert selection.matches(topic) == recorded, topic
    # Scalars of the controller are left out by default.
    default = TopicFilter([], RecordingParameters().topics, namespace='/a')
    assert default.matches('/a/controller/journal')
    assert not default.matches('/a/controller/error/right')


@pytest.mark.parametrize(
    'exclusion, excluded',
    [
        ({}, []),
        ({'exclude_topics': ['odom']}, ['/odom']),
        ({'exclude_topics': ['/range/*']}, ['/range/left', '/range/right']),
        ({'exclude_topics': ['range/l*', '/tf']}, ['/range/left', '/tf']),
        ({'exclude_topics': ['*/left']}, ['/range/left']),
        ({'exclude_topics': ['range']}, []),
        ({'exclude_topics': ['/range/(left|right)']}, []),
        ({'exclude_regex': '/range/(left|right)'}, ['/range/left', '/range/right']),
        ({'exclude_regex': '/range/*'}, []),
        ({'exclude_regex': 'odom'}, []),
        ({'exclude_topics': ['tf'], 'exclude_regex': '.*dom'}, ['/odom', '/tf']),
    ],
)
def test_recorder_and_player_exclude_the_same_topics(exclusion, excluded):
    """Names with wildcards and a regular expression on the full name, in both."""
    topics = ['/odom', '/range/left', '/range/right', '/tf']
    kept = [topic for topic in topics if topic not in excluded]
    assert [t for t in topics if TopicFilter(topics, **exclusion).matches(t)] == kept
    play = PlaybackParameters.from_dict({f'play.{name}': exclusion[name] for name in exclusion})
    assert [t for t in topics if play.topic_filter().matches(t)] == kept


def test_relative_exclusion_is_in_the_namespace_of_the_recorder():
    selection = TopicFilter(
        ['/a/odom', '/odom'], exclude_topics=['odom', '*/secret'], namespace='/a'
    )
    assert not selection.matches('/a/odom')
    assert selection.matches('/odom')
    both = TopicFilter([], ['/*'], exclude_topics=['*/secret'], namespace='/a')
    assert not both.matches('/b/secret')


def test_a_type_selects_whatever_the_name():
    selection = TopicFilter([], types=[NUMBER], exclude_regex='/not')
    assert selection.matches('/any', ['std_msgs/msg/String', NUMBER])
    assert not selection.matches('/any', ['std_msgs/msg/String'])
    assert not selection.matches('/not', [NUMBER])
    assert not selection.matches('/a/_hidden', [NUMBER])
    assert not selection.matches('/any')


@pytest.mark.parametrize('name', ['regex', 'exclude_regex'])
def test_invalid_regex_is_rejected_with_name_position_and_value(name):
    with pytest.raises(ParameterError, match=rf"record\.{name} must be .*'a\(b'.*position 1"):
        TopicFilter([], **{name: 'a(b'})
    with pytest.raises(ParameterError, match=rf"record\.{name} must be .*'a\(b'.*position 1"):
        RecordingParameters.from_dict({f'record.{name}': 'a(b'})


def test_empty_recording_or_invalid_type_is_rejected():
    with pytest.raises(ParameterError, match='storage.snapshot_duration must be above 0'):
        RecordingParameters.from_dict(
            {'storage.snapshot_mode': True, 'storage.snapshot_duration': 0.0}
        )
    with pytest.raises(ParameterError, match="record.topic_types must be .* got 'Odometry'"):
        RecordingParameters.from_dict({'record.topic_types': ['Odometry']})


# -- writer thread --------------------------------------------------------------------------------


class SlowBag:
    """Bag whose messages wait for the test, and then fail if it says so."""

    path = Path('bag_0.mcap')

    def __init__(self):
        self.go, self.error, self.written = threading.Event(), None, []

    def write(self, *given):
        assert self.go.wait(30.0)
        if self.error:
            raise self.error
        self.written.append(SerializedMessage(*given))

    def tick(self, now_ns):
        self.now_ns = now_ns

    def close(self):
        self.written.append('closed')


@pytest.fixture
def slow():
    bag = SlowBag()
    bag.thread = WriterThread(bag, 3 * (12 + MESSAGE_OVERHEAD), lambda: 7)
    yield bag
    bag.go.set()
    bag.thread.close()


def test_messages_and_tasks_are_processed_in_order(slow):
    one, two, three = (message('/n', i) for i in range(3))
    slow.thread.put([one, two])
    result = slow.thread.submit(lambda bag: bag.written.append('task') or 'result')
    slow.thread.put([three])
    slow.go.set()
    assert result.result(30.0) == 'result'
    assert slow.thread.close() == ''
    assert slow.written == [one, two, 'task', three, 'closed']
    assert (slow.now_ns, slow.thread.file_name) == (7, 'bag_0.mcap')


def test_dropped_messages_are_counted_and_the_rest_dropped_too(slow):
    assert slow.thread.put([message('/a', 0), message('/a', 1)]) == []
    big, small = message('/b', 2, size=12 + MESSAGE_OVERHEAD + 1), message('/a', 3)
    assert slow.thread.put([big, small, small]) == ['/b', '/a']
    assert slow.thread.put([small]) == []
    assert slow.thread.put([small]) == ['/a']
    assert slow.thread.dropped == {'/b': 1, '/a': 3}
    assert slow.thread.bytes == 3 * small.memory_size, 'also of the messages being written'
    slow.go.set()
    slow.thread.close()
    assert slow.thread.bytes == 0
    assert len(slow.written) == 4


@pytest.mark.parametrize(
    ('error', 'text'),
    [
        (BagError('disk full'), 'disk full'),
        (TypeError('a mistake'), 'writing failed: TypeError: a mistake'),
    ],
)
def test_after_an_error_nothing_is_written_and_nobody_waits(slow, error, text):
    slow.error = error
    slow.thread.put([message('/a', 0)])
    futures = [slow.thread.submit(lambda bag: bag.written.append('task')) for _ in range(2)]
    slow.go.set()
    for future in futures:
        with pytest.raises(BagError, match=text):
            future.result(30.0)
    with pytest.raises(BagError, match=text):
        slow.thread.submit(print).result(30.0)
    assert slow.thread.close() == slow.thread.failure == text
    assert set(slow.written) == {'closed'}
    assert slow.thread.bytes == 0


def test_the_recording_goes_on_between_the_slices_of_a_snapshot(slow):
    slow.go.set()
    seen = []

    def slices():
        for number in range(3):
            slow.thread.submit(lambda bag, number=number: seen.append(number))
            yield
            seen.append('slice')

    slow.thread.run_in_slices(slices())
    slow.thread.close()
    assert seen == [0, 'slice', 1, 'slice', 2, 'slice']


# -- split files ----------------------------------------------------------------------------------


def series(folder, **options):
    made = BagWriter(folder, metadata_records={'provenance': {'commit': 'abc'}}, **options)
    made.add_topic('/n', NUMBER)
    return made


def test_messages_older_than_the_chunk_duration_are_in_the_file(tmp_path):
    """A chunk must be written without a further message."""
    bag = series(tmp_path / 'bag', chunk_ns=SECOND // 2)
    for step in range(40):  # two seconds, ticks of 50 ms
        now = step * SECOND // 20
        if step % 2 == 0 and step < 10:
            bag.write(*message('/n', step / 20))
        bag.tick(now)
        torn = tmp_path / f'torn_{step}.mcap'
        torn.write_bytes(bag.path.read_bytes())
        there = len(kept_messages(torn))
        due = len([i for i in range(0, 10, 2) if i * SECOND // 20 <= now - SECOND // 2])
        assert there >= due, f'at {now / SECOND:.2f} s'
    assert there == 5
    bag.close()


def test_disk_sync_at_most_once_per_second_and_only_for_new_data(tmp_path, monkeypatch):
    bag = series(tmp_path / 'bag', chunk_ns=SECOND // 10)
    synced = []
    monkeypatch.setattr(writer.os, 'fsync', synced.append)
    for step in range(100):  # five seconds; messages in the first half of them
        now = SECOND + step * SECOND // 20
        if step < 50:
            bag.write(*message('/n', step / 20))
        bag.tick(now)
    assert 3 <= len(synced) <= 4
    bag.close()


@pytest.mark.parametrize('options', [{'max_file_bytes': 20_000}, {'max_file_ns': SECOND}])
def test_split_recording_is_complete_in_self_contained_files(tmp_path, options):
    folder = tmp_path / 'bag'
    bag = series(folder, chunk_bytes=8000, **options)
    bag.add_attachment(Attachment(5, START, 'model.npz', 'application/zip', b'weights'))
    bag.add_metadata_record('controller', {'law.gain': '8.0'})
    written = [noise(i / 10) for i in range(50)]
    for i, item in enumerate(written):
        bag.write(*item)
        if i % 10 == 9:  # metadata.yaml is written with each split
            files = sorted(path.name for path in folder.glob('*.mcap'))
            assert len(metadata_of(folder)['files']) == len(files) - 1
    bag.close()
    files = [folder / path for path in metadata_of(folder)['relative_file_paths']]
    assert len(files) >= 5
    parts = [messages_of(path) for path in files]
    assert [item for part in parts for item in part] == written
    for path in files:
        assert read_mcap_file(path).metadata_records['controller'] == {'law.gain': '8.0'}
        assert read_mcap_file(path).metadata_records['provenance'] == {'commit': 'abc'}
        assert [(item.name, item.data) for item in attachments(path)] == [
            ('model.npz', b'weights')
        ]
        if 'max_file_bytes' in options and path != files[-1]:
            assert 20_000 <= path.stat().st_size < 20_000 + 12_000
    if 'max_file_ns' in options:
        assert {len(part) for part in parts} == {10}
    with Reader(folder) as reader:
        assert reader.message_count == 50


def test_a_silent_recording_is_not_split(tmp_path):
    bag = series(tmp_path / 'bag', max_file_ns=SECOND, max_file_bytes=1)
    for step in range(100):
        bag.tick(step * SECOND)
    bag.close()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) == 1


def test_full_disk_at_a_split_leaves_the_previous_file_complete(tmp_path, monkeypatch):
    bag = series(tmp_path / 'bag')
    bag.write(*message('/n', 0))

    def full(path):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(writer, '_Output', full)
    with pytest.raises(FolderError, match='No space left'):
        bag.split()
    with open_bag(tmp_path / 'bag') as reader:
        assert reader.message_count == 1


def test_losses_are_listed_by_cause_and_topic():
    record = message_loss_record({'/b': 2, '/a': 1}, {'/a': 5}, {'/c': 7})
    assert record == {
        'dropped': '3',
        'lost': '5',
        'undiscovered': '7',
        'dropped /a': '1',
        'dropped /b': '2',
        'lost /a': '5',
        'undiscovered /c': '7',
    }
    notes = message_loss_notes({'losses': record})
    assert len(notes) == 4
    assert notes[-1].startswith('7 messages of /c are missing: published before')
    assert message_loss_notes({'losses': message_loss_record({}, {}, {})}) == []
    assert message_loss_notes({}) == []


# -- attachments ----------------------------------------------------------------------------------


def test_attachment_is_read_back_with_media_type_and_time(tmp_path):
    path = tmp_path / 'model.npz'
    with pytest.raises(AttachmentError, match='model.npz cannot be attached: No such file'):
        read_attachment(path, 256, START)
    path.write_bytes(bytes(range(256)))
    with pytest.raises(AttachmentError, match='at most 255 bytes'):
        read_attachment(path, 255, START)
    item = read_attachment(path, 256, START, 'controller/model.npz')
    with BagWriter(tmp_path / 'bag', metadata_records={}) as bag:
        bag.add_attachment(item)
        bag.add_topic('/n', NUMBER)
        bag.write('/n', START, START, message('/n', 0).data)
    (found,) = attachments(bag.path)
    assert (found.name, found.media_type) == ('controller/model.npz', 'application/zip')
    assert found.data == bytes(range(256))
    assert (found.create_time, found.log_time) == (path.stat().st_mtime_ns, START)
    with open_bag(bag.path) as reader:
        assert reader.attachments() == {item.name: item}
    assert len(messages_of(bag.path)) == 1
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 1


def test_newest_attachment_of_a_name_is_read(tmp_path):
    with BagWriter(tmp_path / 'bag', metadata_records={}) as bag:
        for i in (1, 2):
            bag.add_attachment(Attachment(0, START + i, 'a', 'text/plain', b'%d' % i))
    with open_bag(bag.path) as reader:
        assert reader.attachments()['a'].data == b'2'
        content = bag.path.read_bytes()
        bag.path.write_bytes(
            content.replace(
                b'text/plain\1\0\0\0\0\0\0\0002', b'text/plain' + b'\1' + bytes(7) + b'3'
            )
        )
        with pytest.raises(BagError, match='the attachment a of .* is damaged'):
            reader.attachments()


def test_a_full_disk_is_reported_by_an_attachment_too(tmp_path, monkeypatch):
    bag = BagWriter(tmp_path / 'bag', metadata_records={})

    def full(data):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(bag._output, 'write', full)
    with pytest.raises(DiskError, match='No space left'):
        bag.add_attachment(ITEM)


# -- snapshots ------------------------------------------------------------------------------------


def test_latched_messages_are_kept_one_per_publisher():
    cache = CircularMessageCache(10 * SECOND, 10**6)
    cache.keep_last('/map', 1)
    cache.keep_last('/static', 2)
    cache.add([message('/map', 0, fill=1), message('/map', 1, fill=2)])
    cache.add([message('/static', 2 + i, fill=10 + i) for i in range(3)])
    cache.add([message('/n', 15 + i) for i in range(30)])
    kept = cache.messages(START + 44 * SECOND)
    begin = START + 34 * SECOND
    assert [(item.topic, item.data[-1], item.received_ns) for item in kept[:3]] == [
        ('/map', 2, begin),
        ('/static', 11, begin),
        ('/static', 12, begin),
    ]
    assert kept[0].published_ns == START + SECOND - 1000, 'the publish stamp is unchanged'
    assert {item.topic for item in kept[3:]} == {'/n'}
    assert kept == sorted(kept, key=lambda item: item.received_ns)


@pytest.fixture
def snapshots(tmp_path):
    """A snapshot writer with a function that takes a snapshot and returns its folder."""
    thread = WriterThread(None, 0, lambda: 0)
    cache = CircularMessageCache(100 * SECOND, 10**6)
    made = SnapshotWriter(tmp_path, cache, MessageDefinitions(), thread)
    made.add_topic(TopicInformation('/n', NUMBER))

    def take(attachments=()):
        done, results = threading.Event(), []
        at_ns = START + 60 * SECOND
        folder = made.start(
            'fault', at_ns, {}, attachments, lambda *result: (results.append(result), done.set())
        )
        assert done.wait(30.0)
        return folder, *results[0]

    made.take = take
    yield made
    thread.close()


def test_snapshot_is_a_bag_with_its_reason(snapshots):
    snapshots.add_topic(TopicInformation('/quiet', NUMBER))
    snapshots.add([message('/n', i / 10) for i in range(450)] + [message('/unknown', 50)])
    folder, success, text = snapshots.take([ITEM])
    assert success
    assert text == f'snapshot of "fault": 450 messages in {folder}'
    with open_bag(folder) as reader:
        assert reader.message_count == 450
        assert reader.metadata_records['snapshot']['reason'] == 'fault'
        assert list(reader.attachments()) == ['a']
        assert list(reader.topics) == ['/n']


def test_a_topic_that_appears_meanwhile_is_not_in_the_snapshot(snapshots):
    """The thread that writes a snapshot reads the topics while the recorder discovers others.

    Without its own table a new topic could end the snapshot of a fault: a dictionary must not
    grow while it is read.
    """
    snapshots.add([message('/n', i) for i in range(5)] + [message('/late', 5)])

    def attachments():
        snapshots.add_topic(TopicInformation('/late', NUMBER))
        yield ITEM

    folder, success, _ = snapshots.take(attachments())
    assert success
    with open_bag(folder) as reader:
        assert list(reader.topics) == ['/n']


def test_a_failed_snapshot_is_reported_until_the_next_one(snapshots, tmp_path):
    with pytest.raises(BagError, match='no message was received within'):
        snapshots.take()
    snapshots.add([message('/n', 0)])
    (tmp_path / 'snapshots').write_text('in the way')
    assert snapshots.take()[1:] == (False, snapshots.problem)
    assert snapshots.problem.startswith('no snapshot of "fault": ')
    (tmp_path / 'snapshots').unlink()
    assert snapshots.take()[1]
    assert (snapshots.problem, snapshots.completed) == ('', 1)


def test_snapshots_of_one_second_do_not_share_a_folder(tmp_path):
    names = []
    for _ in range(3):
        names.append(unused_folder(tmp_path, 'x').name)
        (tmp_path / names[-1]).mkdir()
    assert names == ['x', 'x_2', 'x_3']


def test_snapshot_reason_becomes_a_portable_folder_name():
    assert snapshot_folder_name('2026', 'sim_robot: e-stop /latched: Ö "x"!') == (
        '2026_sim-robot-e-stop-latched-x'
    )
    assert len(snapshot_folder_name('', 'a' * 500)) <= 60
    assert snapshot_folder_name('2026', '…') == '2026'


# -- diagnostics monitor --------------------------------------------------------------------------


def test_one_fault_per_change_to_an_error():
    monitor = DiagnosticsMonitor(['robot'])
    levels = [OK, WARN, ERROR, ERROR, STALE, ERROR, WARN, ERROR, OK, OK]
    found = [
        monitor.update('robot', level, 'e-stop', i * SECOND) for i, level in enumerate(levels)
    ]
    assert [i for i, fault in enumerate(found) if fault] == [2, 7]
    assert found[2] == 'robot: e-stop'
    assert monitor.update('stranger', OK, '', 0) == ''
    assert monitor.update('stranger', ERROR, '', SECOND) == ''


def test_node_that_was_never_healthy_has_no_fault():
    """A controller reports "stopped" as a warning before its first odometry, then as an error."""
    monitor = DiagnosticsMonitor(['controller', 'radio_bridge'])
    assert monitor.update('controller', WARN, 'stopped: waiting', 0) == ''
    assert monitor.update('controller', ERROR, 'stopped: no reference', 1) == ''
    assert monitor.update('radio_bridge', ERROR, 'handshake', 2) == ''
    assert monitor.check_timeouts(100 * SECOND) == []
    assert monitor.update('controller', OK, 'tracking', 3) == ''
    assert monitor.update('controller', ERROR, 'stopped: no reference', 4)


def test_report_timeout_is_one_fault():
    monitor = DiagnosticsMonitor(['controller'])
    monitor.update('controller', OK, 'tracking', 0)
    assert monitor.check_timeouts(REPORT_TIMEOUT_NS) == []
    (fault,) = monitor.check_timeouts(REPORT_TIMEOUT_NS + 1)
    assert fault == 'controller: diagnostics timed out'
    assert monitor.check_timeouts(10 * REPORT_TIMEOUT_NS) == []
    monitor.update('controller', OK, 'tracking', 11 * REPORT_TIMEOUT_NS)
    assert len(monitor.check_timeouts(13 * REPORT_TIMEOUT_NS)) == 1
    # One that was started again waits.
    monitor.update('controller', OK, 'tracking', 14 * REPORT_TIMEOUT_NS)
    monitor.update('controller', WARN, 'stopped: waiting', 15 * REPORT_TIMEOUT_NS)
    assert monitor.check_timeouts(20 * REPORT_TIMEOUT_NS) == []


def test_automatic_snapshots_are_limited_in_rate_and_number():
    limiter = SnapshotRateLimiter(10 * SECOND, 3)
    reasons = [limiter.acquire(second * SECOND) for second in (0, 1, 9.9, 10, 30, 60)]
    assert [not reason for reason in reasons] == [True, False, False, True, True, False]
    assert '1.0 s ago (snapshot.min_interval)' in reasons[1]
    assert '3 already (snapshot.max_count)' in reasons[5]
