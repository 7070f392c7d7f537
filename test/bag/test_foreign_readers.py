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
"""Bags read by the JavaScript libraries of web viewers.

``test/support/mcap_check/check.mjs`` verifies checksums and indexes and decodes the messages.
"""

import base64
import json
import os
from pathlib import Path
import shutil

from mcap.records import Attachment
import pytest
from support import waiting
from support.bag_messages import STORE, number, odometry_message, serialised
from support.missing_tools import needs, skip

from t3mpc_ros.bag.qos import QosProfile, profiles_to_yaml
from t3mpc_ros.bag.writer import BagWriter

SOURCES = Path(__file__).parents[1] / 'support' / 'mcap_check'
ODOM, NUMBER = 'nav_msgs/msg/Odometry', 'std_msgs/msg/Float64'
START = 1_700_000_000_000_000_000
STEP = 10_000_000
DETAILS = {'settings': {'law.gain': '8.0', 'note': 'µ ∞'}, 'provenance': {'version': '0'}}
ITEM = Attachment(START, START, 'model.npz', 'application/zip', b'a model file \x00\xff' * 50)


@pytest.fixture(scope='module')
def check(tmp_path_factory):
    """Return a function that returns what the program finds in each file."""
    needs('node', 'npm')
    folder = tmp_path_factory.mktemp('mcap_check')
    for name in ('package.json', 'check.mjs'):
        shutil.copy(SOURCES / name, folder)
    usual = os.environ.get('HOME', '')  # npm writes there
    home = {**os.environ, 'HOME': usual if os.access(usual, os.W_OK) else str(folder)}
    # No lock file: it would carry the address of whatever registry made it. The versions in
    # package.json are exact instead, and no package may run a script of its own.
    options = ['--no-package-lock', '--no-audit', '--no-fund', '--ignore-scripts']
    if waiting.run(['npm', 'install', *options], 300.0, cwd=folder, env=home).returncode:
        skip('packages of npm')

    def run(*paths):
        result = waiting.run(['node', 'check.mjs', *map(str, paths)], 120.0, cwd=folder)
        assert result.returncode == 0, result.stderr
        return json.loads(result.stdout)

    return run


@pytest.mark.slow
def test_every_file_of_a_bag_is_read_and_decoded(tmp_path, check):
    """A number each period, odometry every third one, and a file for each 200 periods."""
    paths = []
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS, chunk_bytes=8192) as bag:
        bag.add_topic('/number', NUMBER, [QosProfile()])
        bag.add_topic('/odom', ODOM)
        bag.add_attachment(ITEM)
        for i in range(600):
            now = START + i * STEP
            if i % 200 == 0:
                paths.append(bag.split() if i else bag.path)
            bag.write('/number', now, now - 5, serialised(number(i)))
            if i % 3 == 0:
                message = odometry_message(now, (0.1 * i, -0.2 * i), (1.5, -2.5, 0.0))
                bag.write('/odom', now, now, serialised(message))
    found = check(*paths)
    assert [each['topics']['/number'] for each in found] == [200, 200, 200]
    assert [each['last']['/number']['data'] for each in found] == [199, 399, 599]
    for each in found:
        assert each['profile'] == 'ros2'
        assert each['streamed'] == sum(each['topics'].values())
        assert each['chunks'] > 2
        assert each['compression'] == ['zstd']
        assert 0 not in (each['dataSectionCrc'], each['footerCrc'])
        assert {name: each['metadata'][name] for name in DETAILS} == DETAILS
        channels = {channel['topic']: channel for channel in each['channels']}
        profiles = profiles_to_yaml([QosProfile()])
        assert channels['/number']['offered_qos_profiles'] == profiles
        assert channels['/number']['topic_type_hash'] == STORE.hash_rihs01(NUMBER)
        (attached,) = each['attachments']
        assert (attached['name'], attached['mediaType']) == (ITEM.name, ITEM.media_type)
        assert base64.b64decode(attached['content']) == ITEM.data
    last = found[-1]['last']['/odom']
    sec, nanosec = divmod(START + 597 * STEP, 10**9)
    assert last['header'] == {'stamp': {'sec': sec, 'nanosec': nanosec}, 'frame_id': 'odom'}
    assert last['pose']['pose']['position'] == {'x': 1.5, 'y': -2.5, 'z': 0}
    assert last['twist']['twist']['linear']['x'] == 0.1 * 597
    assert last['twist']['twist']['angular']['z'] == -0.2 * 597
