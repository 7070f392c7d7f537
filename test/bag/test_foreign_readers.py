# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags read by the Go library of Foxglove and by the JavaScript libraries of web viewers.

The programs are in ``test/support/mcap_check``; both verify checksums and indexes.
"""

import base64
import json
import os
from pathlib import Path
import shutil
import subprocess
import zlib

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from support import waiting
from support.missing_tools import find, needs, skip

from t3mpc_ros.bag.mcap_file import Attachment
from t3mpc_ros.bag.qos import QosProfile, profiles_to_yaml
from t3mpc_ros.bag.writer import BagWriter

SOURCES = Path(__file__).parents[1] / 'support' / 'mcap_check'
STORE = get_typestore(Stores.ROS2_JAZZY)
ODOM, NUMBER = 'nav_msgs/msg/Odometry', 'std_msgs/msg/Float64'
START = 1_700_000_000_123_456_789
STEP = 10_000_000
DETAILS = {'settings': {'law.gain': '8.0', 'note': 'µ ∞'}, 'provenance': {'version': '0'}}


def home(folder):
    """Return an environment with a home folder that can be written: Go and npm do so."""
    usual = os.environ.get('HOME', '')
    return {**os.environ, 'HOME': usual if os.access(usual, os.W_OK) else str(folder)}


def build_go(folder):
    """Return the command of the Go program; skip if it cannot be built."""
    needs('go')
    go = find('go')
    for path in (SOURCES / 'go').iterdir():
        shutil.copy(path, folder)
    # The versions and hashes are in go.mod and go.sum; the toolchain is the one that is there.
    environment = {**home(folder), 'GOTOOLCHAIN': 'local', 'GOFLAGS': '-mod=readonly'}
    options = {'cwd': folder, 'env': environment, 'timeout': 600}
    fetch = [go, 'mod', 'download', 'github.com/foxglove/mcap/go/mcap']
    fetched = subprocess.run(fetch, capture_output=True, text=True, **options)
    if fetched.returncode:
        print(fetched.stderr)
        skip('modules of Go')
    subprocess.run([go, 'build', '-o', 'mcap_check', '.'], check=True, **options)
    return [str(folder / 'mcap_check')]


def install_npm(folder):
    """Return the command of the JavaScript program; skip if its packages cannot be had."""
    needs('node', 'npm')
    for name in ('package.json', 'check.mjs'):
        shutil.copy(SOURCES / name, folder)
    # No lock file: it would carry the address of whatever registry made it. The versions in
    # package.json are exact instead, and no package may run a script of its own.
    options = ['--no-package-lock', '--no-audit', '--no-fund', '--ignore-scripts']
    words = ['npm', 'install', *options]
    if waiting.run(words, 300.0, cwd=folder, env=home(folder)).returncode:
        skip('packages of npm')
    return ['node', 'check.mjs']


# The Go program takes a minute to compile.
READERS = [
    pytest.param(build_go, id='go', marks=pytest.mark.long),
    pytest.param(install_npm, id='javascript'),
]


@pytest.fixture(scope='module', params=READERS)
def check(request, tmp_path_factory):
    """Return a function that runs a program on files."""
    folder = tmp_path_factory.mktemp('mcap_check')
    command = request.param(folder)

    def run(*paths):
        words = [*command, *map(str, paths)]
        return waiting.run(words, 120.0, cwd=folder)

    return run


def found_by(check, *paths):
    """Return the contents that a program finds in each file, with counts by topic."""
    result = check(*paths)
    assert result.returncode == 0, result.stderr
    every = json.loads(result.stdout)
    for found in every:
        found['counts'] = found.get('indexed', found.get('topics'))
        streamed = found['streamed']
        total = sum(streamed.values()) if isinstance(streamed, dict) else streamed
        assert total == sum(found['counts'].values())
    return every


def data_of(kind, i):
    types = STORE.types
    if kind == NUMBER:
        return bytes(STORE.serialize_cdr(types[NUMBER](data=float(i)), NUMBER))
    vector = types['geometry_msgs/msg/Vector3']
    pose = types['geometry_msgs/msg/Pose'](
        position=types['geometry_msgs/msg/Point'](x=1.5, y=-2.5, z=0.0),
        orientation=types['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.6, w=0.8),
    )
    twist = types['geometry_msgs/msg/Twist'](
        vector(x=0.1 * i, y=0.0, z=0.0), vector(x=0.0, y=0.0, z=-0.2 * i)
    )
    stamp = types['builtin_interfaces/msg/Time'](sec=1_700_000_000, nanosec=i)
    message = types[ODOM](
        header=types['std_msgs/msg/Header'](stamp=stamp, frame_id='odom'),
        child_frame_id='base_link',
        pose=types['geometry_msgs/msg/PoseWithCovariance'](pose=pose, covariance=np.arange(36.0)),
        twist=types['geometry_msgs/msg/TwistWithCovariance'](twist=twist, covariance=np.zeros(36)),
    )
    return bytes(STORE.serialize_cdr(message, ODOM))


def write(folder, count, first=0, attachment=None, **options):
    """Write a file with a number each period and odometry every third one."""
    with BagWriter(folder, metadata_records=DETAILS, **options) as bag:
        bag.add_topic('/number', NUMBER, [QosProfile()])
        bag.add_topic('/odom', ODOM)
        bag.add_topic('/never', NUMBER)
        for i in range(first, first + count):
            now = START + i * STEP
            bag.write('/number', now, now - 5, data_of(NUMBER, i))
            if i % 3 == 0:
                bag.write('/odom', now + 1, now, data_of(ODOM, i))
            if i == first + count // 2 and attachment is not None:
                bag.add_attachment(attachment, START)
    return bag.path


def digest(kind, numbers):
    """Return the checksum over all messages of a topic in order."""
    value = 0
    for i in numbers:
        value = zlib.crc32(data_of(kind, i), value)
    return value


@pytest.mark.slow
def test_everything_that_was_written_is_read(tmp_path, check):
    path = write(tmp_path / 'run', 600, chunk_bytes=32 * 1024)
    (found,) = found_by(check, path)
    assert found['profile'] == 'ros2'
    assert {name: n for name, n in found['counts'].items() if n} == {'/number': 600, '/odom': 200}
    assert found['chunks'] > 2
    assert found['compression'] == ['zstd']
    assert 0 not in (found['dataSectionCrc'], found.get('summaryCrc', found.get('footerCrc')))
    assert {name: found['metadata'][name] for name in DETAILS} == DETAILS
    channels = found['channels']
    if isinstance(channels, list):
        channels = {channel['topic']: channel for channel in channels}
    assert channels['/number']['offered_qos_profiles'] == profiles_to_yaml([QosProfile()])
    assert channels['/number']['topic_type_hash'] == STORE.hash_rihs01(NUMBER)
    if 'digests' in found:  # the Go program compares bytes, the other one decodes them
        assert found['digests'] == {
            '/number': digest(NUMBER, range(600)),
            '/odom': digest(ODOM, range(0, 600, 3)),
        }
        assert (found['first'], found['last']) == (START, START + 599 * STEP)
        assert found['schemas'] == {NUMBER: 'ros2msg', ODOM: 'ros2msg'}
        return
    assert found['last']['/number'] == {'data': 599}
    last = found['last']['/odom']
    assert last['header'] == {'stamp': {'sec': 1_700_000_000, 'nanosec': 597}, 'frame_id': 'odom'}
    assert last['child_frame_id'] == 'base_link'
    assert last['pose']['pose']['orientation'] == {'x': 0, 'y': 0, 'z': 0.6, 'w': 0.8}
    assert last['pose']['covariance'] == list(range(36))
    assert last['twist']['twist']['linear']['x'] == 0.1 * 597
    assert last['twist']['twist']['angular']['z'] == -0.2 * 597


@pytest.mark.slow
def test_every_file_of_a_bag_is_read(tmp_path, check):
    paths = [write(tmp_path / 'run', 60, 60 * part) for part in range(3)]
    every = found_by(check, *paths)
    assert [each['counts']['/number'] for each in every] == [60, 60, 60]
    assert all(each['metadata']['settings'] == DETAILS['settings'] for each in every)
    if 'digests' in every[0]:
        digests = [digest(NUMBER, range(60 * part, 60 * part + 60)) for part in range(3)]
        assert [each['digests']['/number'] for each in every] == digests
    else:
        assert [each['last']['/number']['data'] for each in every] == [59, 119, 179]


@pytest.mark.slow
def test_attachments_are_read_and_their_checksums_verified(tmp_path, check):
    content = b'a model file \x00\xff' * 50
    item = Attachment('model.npz', 'application/zip', content, START)
    path = write(tmp_path / 'run', 40, attachment=item)
    (found,) = found_by(check, path)
    (attached,) = found['attachments']
    assert (attached['name'], attached['mediaType']) == (item.name, item.media_type)
    assert base64.b64decode(attached['content']) == content
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(content) + 100] ^= 1
    path.write_bytes(damaged)
    result = check(path)
    assert result.returncode != 0
    assert 'checksum' in result.stderr or 'crc' in result.stderr.lower()


@pytest.mark.parametrize('part', ['chunk', 'summary', 'cut'])
@pytest.mark.slow
def test_the_programs_notice_damage(tmp_path, check, part):
    path = write(tmp_path / 'run', 200)
    content = bytearray(path.read_bytes())
    if part == 'cut':
        del content[-200:]
    else:
        content[len(content) // 4 if part == 'chunk' else len(content) - 60] ^= 0x10
    path.write_bytes(content)
    assert check(path).returncode != 0
