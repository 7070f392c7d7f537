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
"""Schema texts and type hashes, from installed files and without them."""

from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.errors import BagError, UnknownTypeError
from t3mpc_ros.bag.message_definitions import SEPARATOR, MessageDefinitions, installation_prefixes

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
