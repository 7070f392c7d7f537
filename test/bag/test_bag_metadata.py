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
"""``metadata.yaml`` and QoS profiles as rosbag2 of Jazzy writes them.

``ros2 bag`` is not available from PyPI: keys, their order and the text that yaml-cpp accepts for
each type follow ``rosbag2_storage/yaml.hpp`` and ``qos.cpp`` (branch jazzy).
"""

import errno
from textwrap import indent

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore

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
        TopicInformation('/tf', 'tf2_msgs/msg/TFMessage', (QosProfile(), LATCHED), 'RIHS01_0', 7),
    ),
    custom_data={'commit': '0123', 'empty': ''},
)
PROFILES = """\
- history: keep_last
  depth: 10
  reliability: reliable
  durability: volatile
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
- history: keep_all
  depth: 0
  reliability: best_effort
  durability: transient_local
  deadline:
    sec: 0
    nsec: 100000000
  lifespan:
    sec: 0
    nsec: 0
  liveliness: manual_by_topic
  liveliness_lease_duration:
    sec: 2
    nsec: 500000000
  avoid_ros_namespace_conventions: true"""
METADATA = f"""\
rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: 1700
  starting_time:
    nanoseconds_since_epoch: 1000
  message_count: 7
  topics_with_message_count:
  - topic_metadata:
      name: /tf
      type: tf2_msgs/msg/TFMessage
      serialization_format: cdr
      offered_qos_profiles:
{indent(PROFILES, '      ')}
      type_description_hash: RIHS01_0
    message_count: 7
  compression_format: ''
  compression_mode: ''
  relative_file_paths:
  - run_0.mcap
  - run_1.mcap
  - run_2.mcap
  files:
  - path: run_0.mcap
    starting_time:
      nanoseconds_since_epoch: 1000
    duration:
      nanoseconds: 500
    message_count: 3
  - path: run_1.mcap
    starting_time:
      nanoseconds_since_epoch: 9223372036854775807
    duration:
      nanoseconds: 0
    message_count: 0
  - path: run_2.mcap
    starting_time:
      nanoseconds_since_epoch: 2000
    duration:
      nanoseconds: 700
    message_count: 4
  custom_data:
    commit: '0123'
    empty: ''
  ros_distro: jazzy
"""


def test_the_text_is_that_of_rosbag2(tmp_path):
    write_metadata(tmp_path, BAG)
    assert (tmp_path / 'metadata.yaml').read_text() == METADATA
    assert profiles_to_yaml([QosProfile(), LATCHED]) == PROFILES
    assert profiles_to_yaml([]) == '[]'


def test_totals_follow_from_the_files_empty_files_add_nothing():
    assert (BAG.start_ns, BAG.duration_ns, BAG.message_count) == (1_000, 1_700, 7)
    empty = BagMetadata(files=(FileInformation('a.mcap'),))
    assert (empty.start_ns, empty.duration_ns, empty.message_count) == (NO_START_NS, 0, 0)


@pytest.mark.parametrize('bag', [BAG, BagMetadata()], ids=['full', 'empty'])
def test_custom_data_come_back_as_they_were(tmp_path, bag):
    write_metadata(tmp_path, bag)
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


@pytest.mark.parametrize('profiles', [(), (QosProfile(),), (QosProfile(), LATCHED)])
def test_profiles_come_back_as_they_were(profiles):
    assert profiles_from_yaml(profiles_to_yaml(profiles)) == profiles


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
