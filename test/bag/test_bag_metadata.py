# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``metadata.yaml`` and QoS profiles against rosbag2 of Jazzy.

``ros2 bag`` is not available from PyPI. The functions ``decode_*`` follow the decoder of rosbag2
field by field (``rosbag2_storage/yaml.hpp`` and ``qos.cpp``, branch jazzy): the required keys, and
the text that yaml-cpp accepts for each type.
"""

import errno
import re

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore
from support.bag_files import metadata_of
import yaml

from t3mpc_ros.bag.metadata import (
    NO_START_NS,
    BagMetadata,
    FileInformation,
    TopicInformation,
    read_origin,
    write_metadata,
)
from t3mpc_ros.bag.qos import UNLIMITED, QosError, QosProfile, profiles_from_yaml, profiles_to_yaml
from t3mpc_ros.bag.reader import open_bag

LATCHED = QosProfile(
    history='keep_all',
    depth=0,
    reliability='best_effort',
    durability='transient_local',
    deadline_ns=100_000_000,
    lifespan_ns=0,
    liveliness='manual_by_topic',
    liveliness_lease_ns=2_500_000_000,
    avoid_ros_namespace_conventions=True,
)
BAG = BagMetadata(
    files=(
        FileInformation('run_0.mcap', 1_000, 500, 3),
        FileInformation('run_1.mcap'),
        FileInformation('run_2.mcap', 2_000, 700, 4),
    ),
    topics=(
        TopicInformation('/odom', 'nav_msgs/msg/Odometry', (QosProfile(),), 'RIHS01_ab', 7),
        TopicInformation(
            '/tf', 'tf2_msgs/msg/TFMessage', (QosProfile(), LATCHED), 'RIHS01_0e1', 0
        ),
    ),
    custom_data={'commit': '0123', 'version': '1.0', 'empty': ''},
)


# -- scalar types of yaml-cpp; the loader below returns every scalar as text --------------------


def _string(node):
    assert isinstance(node, str)
    return node


def _unsigned(node):
    assert re.fullmatch(r'\d+', _string(node)), node
    assert int(node) < 2**64
    return int(node)


def _int(node):
    assert re.fullmatch(r'-?\d+', _string(node)), node
    assert -(2**31) <= int(node) < 2**31
    return int(node)


def _bool(node):
    return {'true': True, 'false': False}[_string(node)]


def _list(node):
    assert isinstance(node, list)
    return node


def decode_time(node):
    return _unsigned(node['sec']), _unsigned(node['nsec'])


def decode_profile(node):
    history = _string(node['history'])
    assert history in ('system_default', 'keep_last', 'keep_all', 'unknown')
    _unsigned(node['depth'])
    if history == 'keep_last':
        _int(node['depth'])
    common = ('system_default', 'best_available', 'unknown')
    assert _string(node['reliability']) in (*common, 'reliable', 'best_effort')
    assert _string(node['durability']) in (*common, 'transient_local', 'volatile')
    assert _string(node['liveliness']) in (*common, 'automatic', 'manual_by_topic')
    for key in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        assert decode_time(node[key])[1] < 10**9
    _bool(node['avoid_ros_namespace_conventions'])


def decode_topic(node):
    topic = node['topic_metadata']
    for key in ('name', 'type', 'serialization_format', 'type_description_hash'):
        _string(topic[key])
    for item in _list(topic['offered_qos_profiles']):
        decode_profile(item)
    _unsigned(node['message_count'])


def decode_file(node):
    _string(node['path'])
    _unsigned(node['starting_time']['nanoseconds_since_epoch'])
    _unsigned(node['duration']['nanoseconds'])
    _unsigned(node['message_count'])


def decode_bag(root):
    node = root['rosbag2_bagfile_information']
    assert _int(node['version']) == 9
    assert _string(node['storage_identifier']) == 'mcap'
    _unsigned(node['duration']['nanoseconds'])
    _unsigned(node['starting_time']['nanoseconds_since_epoch'])
    _unsigned(node['message_count'])
    for item in _list(node['topics_with_message_count']):
        decode_topic(item)
    for item in _list(node['relative_file_paths']):
        _string(item)
    assert _string(node['compression_format']) == ''
    assert _string(node['compression_mode']) == ''
    for item in _list(node['files']):
        decode_file(item)
    for key, value in node['custom_data'].items():
        _string(key)
        _string(value)
    assert _string(node['ros_distro']) == 'jazzy'
    return node


def load_as_texts(path):
    return yaml.load(path.read_text(), Loader=yaml.BaseLoader)


@pytest.mark.parametrize('bag', [BAG, BagMetadata()], ids=['full', 'empty'])
def test_rosbag2_decodes_every_field(tmp_path, bag):
    write_metadata(tmp_path, bag)
    decode_bag(load_as_texts(tmp_path / 'metadata.yaml'))


def test_keys_are_those_of_rosbag2_in_its_order(tmp_path):
    write_metadata(tmp_path, BAG)
    root = yaml.safe_load((tmp_path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert list(root) == [
        'version',
        'storage_identifier',
        'duration',
        'starting_time',
        'message_count',
        'topics_with_message_count',
        'compression_format',
        'compression_mode',
        'relative_file_paths',
        'files',
        'custom_data',
        'ros_distro',
    ]
    assert list(root['topics_with_message_count'][0]) == ['topic_metadata', 'message_count']


def test_totals_follow_from_the_files_empty_files_add_nothing():
    assert (BAG.start_ns, BAG.duration_ns, BAG.message_count) == (1_000, 1_700, 7)
    empty = BagMetadata(files=(FileInformation('a.mcap'),))
    assert (empty.start_ns, empty.duration_ns, empty.message_count) == (NO_START_NS, 0, 0)


@pytest.mark.parametrize('bag', [BAG, BagMetadata()], ids=['full', 'empty'])
def test_metadata_come_back_as_they_were(tmp_path, bag):
    write_metadata(tmp_path, bag)
    assert metadata_of(tmp_path) == bag.to_mapping()
    assert read_origin(tmp_path) == (bag.custom_data, 'jazzy')


def test_no_anchors_and_no_folded_lines(tmp_path):
    """Equal profiles must not become ``&id001`` and ``*id001``, nor long texts two lines."""
    long = BagMetadata(topics=BAG.topics * 2, custom_data={'note': 'word ' * 60})
    write_metadata(tmp_path, long)
    text = (tmp_path / 'metadata.yaml').read_text()
    assert '&id' not in text
    assert '*id' not in text
    assert any('word word' in line and line.count('word') == 60 for line in text.splitlines())


def test_a_failed_write_leaves_the_old_metadata_and_no_litter(tmp_path, monkeypatch):
    write_metadata(tmp_path, BAG)
    before = (tmp_path / 'metadata.yaml').read_bytes()

    def full(_):
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(OSError, match='No space'):
        write_metadata(tmp_path, BagMetadata())
    assert (tmp_path / 'metadata.yaml').read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ['metadata.yaml']


@pytest.mark.parametrize(
    'text',
    ['', '{', 'a: 1', 'rosbag2_bagfile_information: {version: 9}', '[]', 'just text'],
)
def test_damaged_or_missing_metadata_have_no_origin(tmp_path, text):
    assert read_origin(tmp_path) is None
    (tmp_path / 'metadata.yaml').write_text(text)
    assert read_origin(tmp_path) is None


def test_channel_metadata_is_the_text_of_yaml_cpp():
    assert profiles_to_yaml([QosProfile()]) == (
        '- history: keep_last\n'
        '  depth: 10\n'
        '  reliability: reliable\n'
        '  durability: volatile\n'
        '  deadline:\n'
        '    sec: 9223372036\n'
        '    nsec: 854775807\n'
        '  lifespan:\n'
        '    sec: 9223372036\n'
        '    nsec: 854775807\n'
        '  liveliness: automatic\n'
        '  liveliness_lease_duration:\n'
        '    sec: 9223372036\n'
        '    nsec: 854775807\n'
        '  avoid_ros_namespace_conventions: false'
    )
    assert profiles_to_yaml([]) == '[]'


@pytest.mark.parametrize('profiles', [(), (QosProfile(),), (QosProfile(), LATCHED)])
def test_profiles_come_back_as_they_were(profiles):
    text = profiles_to_yaml(profiles)
    assert profiles_from_yaml(text) == profiles
    for item in yaml.load(text, Loader=yaml.BaseLoader):
        decode_profile(item)


def test_rosbags_reads_the_same_profile():
    (read,) = parse_qos(profiles_to_yaml([LATCHED]))
    assert read.history.name == 'KEEP_ALL'
    assert read.reliability.name == 'BEST_EFFORT'
    assert read.durability.name == 'TRANSIENT_LOCAL'
    assert read.liveliness.name == 'MANUAL_BY_TOPIC'
    assert (read.liveliness_lease_duration.sec, read.liveliness_lease_duration.nsec) == (
        2,
        500_000_000,
    )
    assert read.avoid_ros_namespace_conventions is True


def test_numeric_policies_and_foxy_infinities_are_parsed():
    mapping = QosProfile().to_mapping()
    mapping |= {'history': 2, 'reliability': 2, 'durability': 1, 'liveliness': 3}
    mapping['deadline'] = {'sec': 0x7FFFFFFF, 'nsec': 0xFFFFFFFF}
    mapping['lifespan'] = {'sec': 0x7FFFFFFF, 'nsec': 0x7FFFFFFF}
    read = QosProfile.from_mapping(mapping)
    assert (read.history, read.reliability) == ('keep_all', 'best_effort')
    assert (read.durability, read.liveliness) == ('transient_local', 'manual_by_topic')
    assert read.deadline_ns == read.lifespan_ns == UNLIMITED


@pytest.mark.parametrize(
    'change',
    [{'history': 'keep_some'}, {'depth': -1}, {'deadline_ns': 0.5}, {'lifespan_ns': 2**63}],
)
def test_a_profile_rosbag2_would_refuse_cannot_be_made(change):
    with pytest.raises(QosError, match=next(iter(change))):
        QosProfile(**change)


@pytest.mark.parametrize('text', ['{', 'a: 1', '- 1', '- {history: keep_last}', '- history: 9'])
def test_invalid_profile_text_is_an_error(text):
    with pytest.raises(QosError):
        profiles_from_yaml(text)


def test_info_reads_a_ros_1_bag_as_the_report_does(tmp_path):
    """``bag info`` said that it was no bag, while ``bag report`` read it."""
    store = get_typestore(Stores.ROS1_NOETIC)
    text = store.types['std_msgs/msg/String']
    path = tmp_path / 'old.bag'
    with Ros1Writer(path) as writer:
        connection = writer.add_connection('/text', 'std_msgs/msg/String', typestore=store)
        for k in range(3):
            data = store.serialize_ros1(text(str(k)), 'std_msgs/msg/String')
            writer.write(connection, 10**18 + k, data)
    with open_bag(path) as recording:
        assert (recording.storage, recording.message_count) == ('ROS 1', 3)
        assert [message.data for _, message in recording.messages('/text')] == ['0', '1', '2']
