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
"""Bags written, continued, interrupted, and read by three independent libraries."""

import errno
import fcntl
import io
import os
import subprocess
import sys
from types import SimpleNamespace

from mcap.reader import NonSeekingReader, make_reader
from mcap.records import DataEnd
from mcap.stream_reader import StreamReader
import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from support.bag_files import kept_messages, messages_of, metadata_of, topics_of
from support.bag_messages import START, STORE, number, odometry_message, serialised, twist_message
import yaml

from t3mpc_ros.bag import writer
from t3mpc_ros.bag.errors import BagError, DataError, UnknownTopicError, UnknownTypeError
from t3mpc_ros.bag.mcap_file import read_mcap_file
from t3mpc_ros.bag.qos import QosProfile, profiles_from_yaml
from t3mpc_ros.bag.reader import missing_sample_ratio, open_bag
from t3mpc_ros.bag.writer import BagWriter, DiskError, FolderError, FolderInUseError

STEP = 10_000_000
ODOM, TWIST, NUMBER = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/Twist', 'std_msgs/msg/Float64'
DETAILS = {
    'settings': {'robot.geometry.wheel_radius': '0.035', 'law.gain': '8.0'},
    'provenance': {'version': '1.2.3', 'commit': 'abc-dirty', 'note': 'µ: "x" # ∞'},
}


def odometry(stamp_ns, linear, angular):
    message = odometry_message(stamp_ns, (linear, angular), (1.0, 2.0, 0.5))
    message.pose.covariance = message.twist.covariance = np.arange(36.0)
    return message


def fill(bag, count=200, start=START, step=STEP):
    """Write ``count`` periods of three topics; return every (topic, received, data)."""
    bag.add_topic('/robot/odom', ODOM, [QosProfile()])
    bag.add_topic('/robot/cmd_vel', TWIST, [QosProfile(depth=1)])
    bag.add_topic('/quiet', NUMBER)
    written = []
    for i in range(count):
        now = start + i * step
        for topic, data in (
            ('/robot/odom', serialised(odometry(now - 3_000_000, 0.01 * i, -0.02 * i))),
            ('/robot/cmd_vel', serialised(twist_message((0.1 * i, np.sin(i))))),
        ):
            bag.write(topic, now, now - 1_000_000, data)
            written.append((topic, now, data))
    return written


def read_with_rosbags(folder):
    with Reader(folder) as reader:
        return [(item.topic, stamp, bytes(data)) for item, stamp, data in reader.messages()]


def read_with_mcap(path, read=messages_of):
    return [(item.topic, item.received_ns, item.data) for item in read(path)]


@pytest.fixture
def folder(tmp_path):
    return tmp_path / 'run'


# -- round trip ---------------------------------------------------------------------------------


def test_every_byte_comes_back_through_rosbags_and_through_mcap(folder):
    with BagWriter(folder, metadata_records=DETAILS) as bag:
        written = fill(bag)
    assert bag.path == folder / 'run_0.mcap'
    assert read_with_rosbags(folder) == written
    assert read_with_mcap(bag.path) == written
    with bag.path.open('rb') as file:
        messages = [each for *_, each in make_reader(file).iter_messages()]
    assert [each.publish_time for each in messages] == [now - 1_000_000 for _, now, _ in written]
    counts = dict.fromkeys({each.channel_id for each in messages}, 0)
    for each in messages:  # by channel: a gap would be a lost message
        assert each.sequence == counts[each.channel_id]
        counts[each.channel_id] += 1


def test_the_data_section_has_a_checksum_and_it_is_right(folder):
    with BagWriter(folder, metadata_records=DETAILS) as bag:
        written = fill(bag)
    content = bag.path.read_bytes()
    reader = NonSeekingReader(io.BytesIO(content), validate_crcs=True)
    assert sum(1 for _ in reader.iter_messages()) == len(written)
    (end,) = (item for item in StreamReader(io.BytesIO(content)).records if type(item) is DataEnd)
    assert end.data_section_crc != 0
    # The same bytes with one bit of the first chunk flipped are noticed.
    with bag.path.open('rb') as file:
        chunk = make_reader(file).get_summary().chunk_indexes[0]
    damaged = bytearray(content)
    damaged[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    with pytest.raises(Exception):  # noqa: B017 - of the decompressor or of the checksum
        list(NonSeekingReader(io.BytesIO(bytes(damaged)), validate_crcs=True).iter_messages())


def test_channel_and_header_equal_those_of_the_rosbag2_plugin(folder):
    with BagWriter(folder, metadata_records=DETAILS) as bag:
        fill(bag)
    with bag.path.open('rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        records = {item.name: item.metadata for item in reader.iter_metadata()}
    channels = {channel.topic: channel for channel in summary.channels.values()}
    schemas = {schema.name: schema for schema in summary.schemas.values()}
    assert set(schemas) == {ODOM, TWIST, NUMBER}
    assert {schema.encoding for schema in schemas.values()} == {'ros2msg'}
    for topic, type_name in (('/robot/odom', ODOM), ('/quiet', NUMBER)):
        channel = channels[topic]
        assert channel.message_encoding == 'cdr'
        assert summary.schemas[channel.schema_id].name == type_name
        assert channel.metadata['topic_type_hash'] == STORE.hash_rihs01(type_name)
    profiles = channels['/robot/cmd_vel'].metadata['offered_qos_profiles']
    assert profiles_from_yaml(profiles) == (QosProfile(depth=1),)
    inside = yaml.safe_load(records['rosbag2']['serialized_metadata'])
    assert inside['version'] == 9
    assert inside['ros_distro'] == 'jazzy'


def test_statistics_index_and_metadata_yaml_agree(folder):
    with BagWriter(folder, metadata_records=DETAILS, chunk_bytes=16 * 1024) as bag:
        written = fill(bag)
    with bag.path.open('rb') as file:
        summary = make_reader(file).get_summary()
    statistics = summary.statistics
    assert statistics.message_count == len(written)
    assert statistics.chunk_count == len(summary.chunk_indexes) > 3
    assert statistics.message_start_time == START
    assert statistics.message_end_time == written[-1][1]
    assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}
    assert all(chunk.message_index_length > 0 for chunk in summary.chunk_indexes)
    assert {name: count for name, _, _, count in topics_of(folder)} == {
        '/robot/odom': 200,
        '/robot/cmd_vel': 200,
        '/quiet': 0,
    }
    with Reader(folder) as reader:
        assert reader.message_count == len(written)
        assert (reader.start_time, reader.end_time) == (START, written[-1][1] + 1)
        assert reader.ros_distro == 'jazzy'


def test_an_invalid_hash_from_the_graph_is_replaced(folder):
    """Publishers before type hashes report INVALID; rosbags rejects a bag with this value."""
    with BagWriter(folder, metadata_records={}) as bag:
        bag.add_topic('/a', NUMBER, type_hash='INVALID')
        bag.add_topic('/b', NUMBER, type_hash='RIHS01_' + 'a' * 64)
    hashes = {name: type_hash for name, type_hash, _, _ in topics_of(folder)}
    assert hashes == {'/a': STORE.hash_rihs01(NUMBER), '/b': 'RIHS01_' + 'a' * 64}


def test_newest_metadata_records_are_read(folder):
    with BagWriter(folder, metadata_records=DETAILS) as bag:
        fill(bag, 3)
        bag.add_metadata_record('controller', {'law.gain': '9.5'})
        bag.add_metadata_record('settings', {'law.gain': '10.0'})
        fill(bag, 3, START + 10**9)
    with open_bag(folder) as reader:
        assert reader.metadata_records == {
            'settings': {'law.gain': '10.0'},
            'provenance': DETAILS['provenance'],
            'controller': {'law.gain': '9.5'},
        }
        assert reader.message_count == 12


# -- files, folders, restarts -------------------------------------------------------------------


def test_restarted_recorder_continues_the_bag(folder):
    with BagWriter(folder, metadata_records={'run': {'n': '1'}}) as first:
        one = fill(first, 20)
    with BagWriter(folder, metadata_records={'run': {'n': '2'}}) as second:
        assert metadata_of(folder)['message_count'] == len(one)  # counted from the start
        two = fill(second, 30, START + 10**10)
    assert (first.path.name, second.path.name) == ('run_0.mcap', 'run_1.mcap')
    metadata = metadata_of(folder)
    assert metadata['relative_file_paths'] == ['run_0.mcap', 'run_1.mcap']
    assert metadata['message_count'] == len(one) + len(two)
    assert len(topics_of(folder)) == 3
    assert read_with_rosbags(folder) == one + two
    with open_bag(folder) as reader:
        assert reader.topics['/robot/odom'].message_count == 50
        assert reader.metadata_records == {'run': {'n': '2'}}


def test_topic_with_other_qos_after_restart_keeps_all_messages(folder):
    """A channel is silently dropped by rosbags if its profile is not in metadata.yaml."""
    for depth in (1, 5):
        with BagWriter(folder, metadata_records={}) as bag:
            bag.add_topic('/n', NUMBER, [QosProfile(depth=depth)])
            bag.write('/n', START + depth, START, serialised(number(depth)))
    assert [count for *_, count in topics_of(folder)] == [1, 1]
    assert len(read_with_rosbags(folder)) == 2
    with open_bag(folder) as reader:
        assert reader.series('/n', {'n': 'data'})['n'].tolist() == [1.0, 5.0]


def test_the_next_free_number_comes_after_the_highest(folder):
    folder.mkdir()
    for name in ('run_2.mcap', 'run_10.mcap', 'other_40.mcap', 'run_x.mcap'):
        (folder / name).write_bytes(b'')
    with BagWriter(folder, metadata_records={}) as bag:
        assert bag.path.name == 'run_11.mcap'
    with BagWriter(folder, 'own', metadata_records={}) as bag:
        assert bag.path.name == 'own_0.mcap'
    assert bag.incomplete_files == ('other_40.mcap', 'run_2.mcap', 'run_10.mcap', 'run_x.mcap')


def test_a_truncated_earlier_file_is_named_and_left_alone(folder):
    with BagWriter(folder, metadata_records={}) as bag:
        fill(bag)
    torn = bag.path.read_bytes()[:-100]
    bag.path.write_bytes(torn)
    with BagWriter(folder, metadata_records={}) as again:
        assert again.incomplete_files == ('run_0.mcap',)
        written = fill(again, 10)
    assert bag.path.read_bytes() == torn
    assert metadata_of(folder)['relative_file_paths'] == ['run_1.mcap']
    assert read_with_rosbags(folder) == written
    with open_bag(folder) as reader:
        assert reader.incomplete_files == ('run_0.mcap',)
        assert reader.message_count == len(written)


def test_a_killed_recorder_leaves_a_folder_that_can_be_read(folder):
    """metadata.yaml must not list the current file: readers would reject the folder."""
    with BagWriter(folder, metadata_records={}) as first:
        one = fill(first, 20)
    killed = BagWriter(folder, metadata_records={})
    fill(killed, 20, START + 10**10)
    killed.flush()
    killed._output.abandon()
    assert read_with_rosbags(folder) == one  # and the second is never completed


def test_a_bag_has_one_writer_at_a_time(folder):
    """Two recorders reported *recording*, and the bag held each message twice."""
    first = BagWriter(folder, metadata_records={})
    first.split()
    with pytest.raises(FolderInUseError, match='another recorder writes this bag'):
        BagWriter(folder, metadata_records={})
    written = fill(first, 20)
    first.close()
    with BagWriter(folder, metadata_records={}) as second:
        written += fill(second, 20, START + 10**10)
    assert read_with_rosbags(folder) == written


def test_a_killed_writer_does_not_keep_its_bag(folder):
    code = (
        'import os, sys; from t3mpc_ros.bag.writer import BagWriter; '
        'bag = BagWriter(sys.argv[1], metadata_records={}); os.kill(os.getpid(), 9)'
    )
    process = subprocess.run([sys.executable, '-c', code, folder], check=False)
    assert process.returncode == -9
    with BagWriter(folder, metadata_records={}) as bag:
        assert bag.incomplete_files == ('run_0.mcap',)


def test_a_file_system_without_locks_is_used(folder, monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(errno.ENOLCK, 'No locks available')

    monkeypatch.setattr(fcntl, 'flock', refuse)
    with BagWriter(folder, metadata_records={}) as bag:
        written = fill(bag, 20)
    assert read_with_rosbags(folder) == written


def test_a_bag_without_messages_is_readable(folder):
    with BagWriter(folder, metadata_records=DETAILS) as bag:
        bag.add_topic('/quiet', NUMBER)
    assert read_with_rosbags(folder) == []
    assert metadata_of(folder)['duration'] == {'nanoseconds': 0}
    with open_bag(folder) as reader:
        assert (reader.start_ns, reader.end_ns, reader.duration) == (0, 0, 0.0)
        assert reader.series('/quiet', {'n': 'data'})['n'].shape == (0,)
        assert reader.metadata_records == DETAILS


def test_a_chunk_is_closed_by_time_as_well_as_by_size(folder):
    bag = BagWriter(folder, metadata_records={}, chunk_bytes=2**30, chunk_ns=500_000_000)
    written = fill(bag, 200)  # two seconds
    torn = folder.parent / 'torn.mcap'
    torn.write_bytes(bag.path.read_bytes())  # content of the disk if the process is killed now
    assert read_with_mcap(torn, kept_messages) == written[:300]
    bag.close()


# -- errors -------------------------------------------------------------------------------------


def test_a_folder_that_cannot_be_written_is_refused(folder, disk, monkeypatch):
    def refuse(path):
        raise OSError(errno.EROFS, 'Read-only file system')

    folder.mkdir()
    (folder / 'file').touch()
    with pytest.raises(FolderError, match='cannot record into'):
        BagWriter(folder / 'file' / 'run', metadata_records={})
    disk.room = 100
    with pytest.raises(FolderError, match='No space left'):
        BagWriter(folder, metadata_records=DETAILS)
    monkeypatch.setattr(writer, '_Output', refuse)
    with pytest.raises(FolderError, match='Read-only file system'):
        BagWriter(folder, metadata_records={})
    assert list(folder.glob('*.mcap')) == []


@pytest.fixture
def disk(monkeypatch):
    """A disk of limited size."""

    class Disk:
        room = 2**40

    def status(number):
        free = Disk.room - os.fstat(number).st_size
        return SimpleNamespace(f_bavail=max(0, free), f_frsize=1)

    monkeypatch.setattr(os, 'fstatvfs', status)
    return Disk


@pytest.mark.parametrize('room', [120_000, 130_000])
@pytest.mark.parametrize('chunk_ns', [10**8, 10**10])
def test_before_the_disk_is_full_the_file_is_completed(folder, disk, room, chunk_ns):
    disk.room = room
    bag = BagWriter(folder, metadata_records=DETAILS, chunk_bytes=8 * 1024, chunk_ns=chunk_ns)
    with pytest.raises(DiskError, match=r'No space left.*the file is complete until here'):
        fill(bag, 20_000)
    bag.write('/robot/odom', START, START, b'\0\1\0\0')
    bag.write('/robot/odom', START, START, b'\0\1\0\0')
    bag.flush()
    bag.add_metadata_record('late', {'a': 'b'})
    bag.close()
    assert bag.lost == 2
    assert bag.path.stat().st_size + len((folder / 'metadata.yaml').read_bytes()) <= room
    kept = read_with_mcap(bag.path)
    assert len(kept) > 20
    assert sorted(kept) == sorted(read_with_rosbags(folder))  # equal stamps in any order
    assert [stamp for _, stamp, _ in kept] == [START + (i // 2) * STEP for i in range(len(kept))]
    with open_bag(folder) as reader:
        assert reader.metadata_records == DETAILS
        assert reader.message_count == len(kept)


def test_a_write_error_is_reported_once_and_chunks_are_kept(folder, monkeypatch):
    bag = BagWriter(folder, metadata_records={})
    written = fill(bag, 20)
    bag.flush()

    def fail(data):
        raise OSError(errno.EIO, 'Input/output error')

    monkeypatch.setattr(bag._output, 'write', fail)
    fill(bag, 1)
    with pytest.raises(DiskError, match='Input/output error; t3mpc bag recover keeps'):
        bag.close()
    bag.close()
    assert read_with_rosbags(folder) == []  # metadata.yaml lists complete files only
    assert read_with_mcap(bag.path, kept_messages) == written


def test_invalid_calls_raise_distinct_errors(folder):
    bag = BagWriter(folder, metadata_records={})
    bag.add_topic('/n', NUMBER)
    bag.add_topic('/n', NUMBER)
    with pytest.raises(DataError, match='recorded as std_msgs'):
        bag.add_topic('/n', TWIST)
    with pytest.raises(UnknownTypeError, match='no_msgs/msg/None'):
        bag.add_topic('/x', 'no_msgs/msg/None')
    with pytest.raises(UnknownTopicError, match='/x was not added'):
        bag.write('/x', START, START, b'')
    for data in (bytearray(b'a'), memoryview(b'a'), 'a', None):
        with pytest.raises(DataError, match='must be bytes'):
            bag.write('/n', START, START, data)
    for stamp in (-1, 2**63):
        with pytest.raises(DataError, match='stamp'):
            bag.write('/n', stamp, START, b'')
    for title, table in (('a', {'b': 1}), ('rosbag2', {})):
        with pytest.raises(DataError):
            bag.add_metadata_record(title, table)
    bag.close()
    bag.close()
    with pytest.raises(BagError, match='closed'):
        bag.write('/n', START, START, b'')
    assert metadata_of(folder)['message_count'] == 0


# -- incomplete files ---------------------------------------------------------------------------


def test_one_flipped_bit_at_the_end_of_a_file_is_noticed(folder):
    with BagWriter(folder, metadata_records={}) as bag:
        fill(bag, 10)
    content = bag.path.read_bytes()
    with bag.path.open('rb') as file:
        start = make_reader(file).get_summary().chunk_indexes[0].chunk_length + 3000
    for place in range(start, len(content), 131):
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        bag.path.write_bytes(bytes(damaged))
        assert read_mcap_file(bag.path) is None, place


# -- reading ------------------------------------------------------------------------------------


def test_series_are_arrays_over_time(folder):
    with BagWriter(folder, metadata_records={}) as bag:
        fill(bag, 50)
    with open_bag(folder) as reader:
        assert reader.duration == pytest.approx(0.49)
        found = reader.series(
            '/robot/odom',
            {'v': 'twist.twist.linear.x', 'w': 'twist.twist.angular.z', 'c': 'pose.covariance[7]'},
        )
        np.testing.assert_allclose(found['received'], 0.01 * np.arange(50), atol=1e-12)
        np.testing.assert_allclose(found['stamp'], found['received'] - 0.003, atol=1e-12)
        np.testing.assert_array_equal(found['v'], 0.01 * np.arange(50))
        np.testing.assert_array_equal(found['w'], -0.02 * np.arange(50))
        assert set(found['c']) == {7.0}
        bare = reader.series('/robot/cmd_vel', {'v': 'linear.x'})
        np.testing.assert_array_equal(bare['stamp'], bare['received'])  # a Twist has no header


def test_element_beyond_an_array_is_nan_wrong_field_an_error(folder):
    with BagWriter(folder, metadata_records={}) as bag:
        fill(bag, 2)
    with open_bag(folder) as reader:
        found = reader.series('/robot/odom', {'c': 'pose.covariance[99]'})
        assert np.isnan(found['c']).all()
        for path in ('twist.speed', 'header.frame_id', 'pose.covariance', 'twist[0]'):
            with pytest.raises(DataError, match='/robot/odom'):
                reader.series('/robot/odom', {'x': path})
        with pytest.raises(UnknownTopicError, match=r'/gone is not in .*/robot/odom'):
            reader.series('/gone', {'x': 'data'})


def test_a_message_that_cannot_be_decoded_is_named(folder):
    """It was *unpack_from requires a buffer of at least 4 bytes*, of which message nobody knew."""
    with BagWriter(folder, metadata_records={}) as bag:
        bag.add_topic('/n', NUMBER)
        bag.write('/n', START, START, b'\0\1\0\0' + bytes(8))
        bag.write('/n', START, START, b'\0\1\0\0\0')
    words = f'message 2 of /n in {folder} does not have the layout of std_msgs/msg/Float64'
    with open_bag(folder) as reader, pytest.raises(DataError, match=words):
        reader.series('/n', {'x': 'data'})


# -- missing samples ----------------------------------------------------------------------------


@pytest.mark.parametrize('lost', [0, 1, 17, 250])
def test_missing_sample_ratio_is_exact_for_lost_samples(lost):
    generator = np.random.default_rng(5)
    stamps = np.arange(1000) / 100.0
    inner = generator.permutation(np.arange(1, 999))[:lost]
    left = np.delete(stamps, inner)
    assert missing_sample_ratio(left, 100.0) == pytest.approx(lost / 1000)
    assert missing_sample_ratio(generator.permutation(left), 100.0) == pytest.approx(lost / 1000)


def test_latency_is_no_loss_and_duplicates_hide_none():
    generator = np.random.default_rng(6)
    stamps = np.arange(500) / 50.0
    late = stamps.copy()
    late[1:480] += generator.uniform(0.0, 0.3, 479)
    assert missing_sample_ratio(late, 50.0) == 0.0
    holed = np.delete(stamps, np.arange(100, 200))
    assert missing_sample_ratio(np.concatenate([holed, holed]), 50.0) == pytest.approx(0.2)


def test_fewer_than_two_stamps_miss_nothing():
    for stamps in ([], [1.0], [np.nan, 1.0], [2.0, 2.0]):
        assert missing_sample_ratio(np.array(stamps), 10.0) == 0.0
    for rate in (0.0, -1.0, float('nan')):
        with pytest.raises(ValueError, match='rate must be positive'):
            missing_sample_ratio(np.arange(3.0), rate)
