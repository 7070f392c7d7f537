# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags read by the JavaScript libraries of web viewers: ``test/support/mcap_check/check.mjs``."""

import base64
import json
from pathlib import Path
import shutil
import subprocess

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.mcap_file import Attachment
from t3mpc_ros.bag.qos import QosProfile, profiles_to_yaml
from t3mpc_ros.bag.recovery.finalize_file import finalize_file
from t3mpc_ros.bag.writer import BagWriter

SOURCES = Path(__file__).parents[1] / 'support' / 'mcap_check'
STORE = get_typestore(Stores.ROS2_JAZZY)
ODOM, NUMBER = 'nav_msgs/msg/Odometry', 'std_msgs/msg/Float64'
START = 1_700_000_000_123_456_789
DETAILS = {'settings': {'law.gain': '8.0', 'note': 'µ ∞'}}

pytestmark = pytest.mark.skipif(
    not (shutil.which('node') and shutil.which('npm')), reason='node or npm is not installed'
)


@pytest.fixture(scope='module')
def check(tmp_path_factory):
    """Return a function that runs the script on a file."""
    folder = tmp_path_factory.mktemp('mcap_check')
    for name in ('package.json', 'check.mjs'):
        shutil.copy(SOURCES / name, folder)
    # No lock file: it would carry the address of whatever registry made it. The versions in
    # package.json are exact instead, and no package may run a script of its own.
    options = ['--no-package-lock', '--no-audit', '--no-fund', '--ignore-scripts']
    subprocess.run(['npm', 'install', *options], cwd=folder, check=True, timeout=300)

    def run(*paths):
        command = ['node', 'check.mjs', *map(str, paths)]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)

    return run


def odometry(i):
    types = STORE.types
    stamp = types['builtin_interfaces/msg/Time'](sec=1_700_000_000, nanosec=i)
    pose = types['geometry_msgs/msg/Pose'](
        position=types['geometry_msgs/msg/Point'](x=1.5, y=-2.5, z=0.0),
        orientation=types['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.6, w=0.8),
    )
    vectors = [
        types['geometry_msgs/msg/Vector3'](x=0.1 * i, y=0.0, z=0.0),
        types['geometry_msgs/msg/Vector3'](x=0.0, y=0.0, z=-0.2 * i),
    ]
    return types[ODOM](
        header=types['std_msgs/msg/Header'](stamp=stamp, frame_id='odom'),
        child_frame_id='base_link',
        pose=types['geometry_msgs/msg/PoseWithCovariance'](pose=pose, covariance=np.arange(36.0)),
        twist=types['geometry_msgs/msg/TwistWithCovariance'](
            twist=types['geometry_msgs/msg/Twist'](*vectors), covariance=np.zeros(36)
        ),
    )


def fill(bag, count, first=0):
    bag.add_topic('/odom', ODOM, [QosProfile()])
    bag.add_topic('/number', NUMBER)
    for i in range(first, first + count):
        now = START + i * 10_000_000
        bag.write('/odom', now, now, bytes(STORE.serialize_cdr(odometry(i), ODOM)))
        number = STORE.types[NUMBER](data=float(i))
        bag.write('/number', now, now, bytes(STORE.serialize_cdr(number, NUMBER)))


def test_web_viewers_read_the_whole_bag(tmp_path, check):
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS, chunk_bytes=64 * 1024) as bag:
        fill(bag, 300)
    result = check(bag.path)
    assert result.returncode == 0, result.stderr
    (found,) = json.loads(result.stdout)
    assert found['profile'] == 'ros2'
    assert found['streamed'] == 600
    assert found['statistics'] == '600'
    assert found['topics'] == {'/odom': 300, '/number': 300}
    assert found['chunks'] > 2
    assert found['compression'] == ['zstd']
    assert found['dataSectionCrc'] != 0
    assert found['footerCrc'] != 0
    assert found['metadata']['settings'] == DETAILS['settings']
    channels = {channel['topic']: channel for channel in found['channels']}
    assert channels['/odom']['encoding'] == 'cdr'
    assert channels['/odom']['topic_type_hash'] == STORE.hash_rihs01(ODOM)
    assert channels['/odom']['offered_qos_profiles'] == profiles_to_yaml([QosProfile()])
    last = found['last']['/odom']
    assert last['header'] == {'stamp': {'sec': 1_700_000_000, 'nanosec': 299}, 'frame_id': 'odom'}
    assert last['child_frame_id'] == 'base_link'
    assert last['pose']['pose']['orientation'] == {'x': 0, 'y': 0, 'z': 0.6, 'w': 0.8}
    assert last['pose']['covariance'] == list(range(36))
    assert last['twist']['twist']['linear']['x'] == 0.1 * 299
    assert last['twist']['twist']['angular']['z'] == -0.2 * 299
    assert found['last']['/number'] == {'data': 299}


def test_web_viewers_read_a_finalized_file(tmp_path, check):
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS, chunk_bytes=64 * 1024) as bag:
        fill(bag, 300)
    bag.path.write_bytes(bag.path.read_bytes()[: bag.path.stat().st_size // 2])
    kept = finalize_file(bag.path)
    assert 0 < kept < 600
    (found,) = json.loads(check(bag.path).stdout)
    assert found['streamed'] == kept
    assert found['statistics'] == str(kept)
    assert found['footerCrc'] != 0
    assert found['metadata']['settings'] == DETAILS['settings']


def test_web_viewers_read_every_file_of_a_bag(tmp_path, check):
    paths = []
    for part in range(3):
        with BagWriter(tmp_path / 'run', metadata_records=DETAILS) as bag:
            fill(bag, 40, 40 * part)
        paths.append(bag.path)
    every = json.loads(check(*paths).stdout)
    assert [each['last']['/number']['data'] for each in every] == [39, 79, 119]
    for each in every:
        assert each['topics'] == {'/odom': 40, '/number': 40}
        assert each['metadata']['settings'] == DETAILS['settings']


def test_attachments_are_read_and_their_checksums_verified(tmp_path, check):
    content = b'a model file \x00\xff' * 50
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS) as bag:
        fill(bag, 20)
        bag.add_attachment(Attachment('model.npz', 'application/zip', content, START), START)
        fill(bag, 20, 20)
    path = bag.path
    (found,) = json.loads(check(path).stdout)
    (attached,) = found['attachments']
    assert attached['mediaType'] == 'application/zip'
    assert attached['name'] == 'model.npz'
    assert base64.b64decode(attached['content']) == content
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(content) + 100] ^= 1
    path.write_bytes(damaged)
    result = check(path)
    assert result.returncode != 0
    assert 'CRC' in result.stderr or 'crc' in result.stderr


@pytest.mark.parametrize('part', ['chunk', 'summary'])
def test_the_check_notices_a_flipped_bit(tmp_path, check, part):
    """The script must fail on a damaged bag."""
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS) as bag:
        fill(bag, 50)
    content = bytearray(bag.path.read_bytes())
    place = len(content) // 2 if part == 'chunk' else len(content) - 60
    content[place] ^= 0x10
    bag.path.write_bytes(content)
    result = check(bag.path)
    assert result.returncode != 0
