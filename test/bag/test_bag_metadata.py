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
"""``metadata.yaml``, QoS profiles and definitions of types as rosbag2 of Jazzy writes them.

``ros2 bag`` is not available from PyPI: keys, their order and the text that yaml-cpp accepts for
each type follow ``rosbag2_storage/yaml.hpp`` and ``qos.cpp`` (branch jazzy).
"""

from pathlib import Path
from textwrap import indent

import pytest
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.errors import BagError, UnknownTypeError
from t3mpc_ros.bag.message_definitions import SEPARATOR, MessageDefinitions, installation_prefixes
from t3mpc_ros.bag.metadata_yaml import (
    NO_START_NS,
    BagMetadata,
    FileInformation,
    TopicInformation,
    read_origin,
    write_metadata,
)
from t3mpc_ros.bag.qos import UNLIMITED, QosError, QosProfile, profiles_from_yaml, profiles_to_yaml

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
    # Equal profiles must not become ``&id001`` and ``*id001``, nor long texts two lines.
    long = {'note': 'word ' * 60}
    write_metadata(tmp_path, BagMetadata(topics=BAG.topics * 2, custom_data=long))
    text = (tmp_path / 'metadata.yaml').read_text()
    assert '&id' not in text
    assert any(line.count('word') == 60 for line in text.splitlines())


def test_what_is_written_comes_back(tmp_path):
    for bag in (BAG, BagMetadata()):
        write_metadata(tmp_path, bag)
        assert read_origin(tmp_path) == (bag.custom_data, 'jazzy')
    for profiles in ((), (QosProfile(),), (QosProfile(), LATCHED)):
        assert profiles_from_yaml(profiles_to_yaml(profiles)) == profiles


def test_totals_follow_from_the_files_empty_files_add_nothing():
    assert (BAG.start_ns, BAG.duration_ns, BAG.message_count) == (1_000, 1_700, 7)
    empty = BagMetadata(files=(FileInformation('a.mcap'),))
    assert (empty.start_ns, empty.duration_ns, empty.message_count) == (NO_START_NS, 0, 0)


@pytest.mark.parametrize(
    'text',
    ['', '{', 'a: 1', 'rosbag2_bagfile_information: {version: 9}', '[]', 'just text'],
)
def test_damaged_or_missing_metadata_have_no_origin(tmp_path, text):
    assert read_origin(tmp_path) is None
    (tmp_path / 'metadata.yaml').write_text(text)
    assert read_origin(tmp_path) is None


def test_rosbags_reads_the_same_profile():
    (read,) = parse_qos(profiles_to_yaml([LATCHED]))
    policies = read.history, read.reliability, read.durability, read.liveliness
    assert [each.name for each in policies] == [
        'KEEP_ALL', 'BEST_EFFORT', 'TRANSIENT_LOCAL', 'MANUAL_BY_TOPIC',
    ]  # fmt: skip
    lease = read.liveliness_lease_duration
    assert (lease.sec, lease.nsec) == (2, 500_000_000)
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


# -- definitions of types -------------------------------------------------------------------------


JAZZY = get_typestore(Stores.ROS2_JAZZY)


def install(prefix, name, text):
    package, _, own = name.partition('/msg/')
    folder = prefix / 'share' / package / 'msg'
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f'{own}.msg').write_text(text)


@pytest.mark.parametrize('prefixes', [None, []], ids=['installed', 'nothing installed'])
def test_the_hash_is_that_of_jazzy(prefixes):
    """It depends on every field of the type and of those that it contains."""
    definitions = MessageDefinitions(prefixes)
    for name in (
        'nav_msgs/msg/Odometry', 'geometry_msgs/msg/TwistStamped', 'std_msgs/msg/Int32MultiArray',
        'sensor_msgs/msg/Imu', 'diagnostic_msgs/msg/DiagnosticArray', 'rosgraph_msgs/msg/Clock',
    ):  # fmt: skip
        assert definitions.type_hash(name) == JAZZY.hash_rihs01(name), name


def test_installed_definitions_and_first_prefix_take_precedence(tmp_path):
    install(tmp_path / 'overlay', 'std_msgs/msg/Float64', 'float64 data\nfloat64 more\n')
    install(tmp_path / 'underlay', 'std_msgs/msg/Float64', 'float64 other\n')
    found = MessageDefinitions([tmp_path / 'overlay', tmp_path / 'underlay'])
    assert found.schema('std_msgs/msg/Float64') == 'float64 data\nfloat64 more\n'


def test_custom_type_mixes_installed_and_library_definitions(tmp_path):
    text = (
        '# a comment with a Type in it\n'
        'byte OK=0   # a constant\n'
        'string<=10 name "none # of these"\n'
        'Part[<=4] parts\n'
        'geometry_msgs/Point[2] ends\n'
        'float64[] free\n'
    )
    install(tmp_path, 'own_msgs/msg/Whole', text)
    install(tmp_path, 'own_msgs/msg/Part', 'std_msgs/Header header\nwstring word')
    found = MessageDefinitions([tmp_path])
    schema = found.schema('own_msgs/msg/Whole')
    assert schema.startswith(text)
    lines = schema.splitlines()
    assert [lines[i + 1] for i, line in enumerate(lines) if line == SEPARATOR == '=' * 80] == [
        'MSG: own_msgs/Part',
        'MSG: std_msgs/Header',
        'MSG: builtin_interfaces/Time',
        'MSG: geometry_msgs/Point',
    ]


def test_unknown_type_error_lists_the_searched_paths(tmp_path):
    install(tmp_path, 'own_msgs/msg/Whole', 'gone_msgs/Lost lost\n')
    with pytest.raises(UnknownTypeError) as caught:
        MessageDefinitions([tmp_path]).schema('own_msgs/msg/Whole')
    assert 'gone_msgs/msg/Lost' in str(caught.value)
    assert 'needed by own_msgs/msg/Whole' in str(caught.value)
    assert str(tmp_path / 'share/gone_msgs/msg/Lost.msg') in str(caught.value)
    assert isinstance(caught.value, BagError)


@pytest.mark.parametrize('name', ['', 'Twist', 'a/b/c/d', '../../etc/passwd', 'a b/msg/C'])
def test_invalid_type_name_is_rejected(name):
    with pytest.raises(UnknownTypeError, match='must be package/msg/Name'):
        MessageDefinitions([]).schema(name)


def test_prefixes_come_from_the_ament_path_and_then_from_python(monkeypatch):
    monkeypatch.setattr('sys.prefix', '/python')
    found = installation_prefixes({'AMENT_PREFIX_PATH': '/one::/two'})
    assert [*map(str, found)] == ['/one', '/two', '/python']
    assert installation_prefixes({}) == (Path('/python'),)
