# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags read by the Go library of Foxglove: ``test/support/mcap_check/go``."""

import base64
import json
import os
from pathlib import Path
import shutil
import subprocess
import zlib

import pytest
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.mcap_file import Attachment
from t3mpc_ros.bag.qos import QosProfile, profiles_to_yaml
from t3mpc_ros.bag.recovery.finalize_file import finalize_file
from t3mpc_ros.bag.writer import BagWriter

SOURCES = Path(__file__).parents[1] / 'support' / 'mcap_check' / 'go'
STORE = get_typestore(Stores.ROS2_JAZZY)
NUMBER, TEXT = 'std_msgs/msg/Float64', 'std_msgs/msg/String'
START = 1_700_000_000_123_456_789
STEP = 10_000_000
DETAILS = {'settings': {'law.gain': '8.0', 'note': 'µ ∞'}, 'provenance': {'version': '0'}}
PLACES = os.pathsep.join([os.environ.get('PATH', ''), '/usr/local/go/bin'])
GO = shutil.which('go', path=PLACES)

pytestmark = pytest.mark.skipif(GO is None, reason='go is not installed')


@pytest.fixture(scope='module')
def check(tmp_path_factory):
    """Return a function that runs the program on files; skip if it cannot be built."""
    folder = tmp_path_factory.mktemp('mcap_check_go')
    for path in SOURCES.iterdir():
        shutil.copy(path, folder)
    # The versions and hashes are in go.mod and go.sum; the toolchain is the one that is there.
    environment = {**os.environ, 'GOTOOLCHAIN': 'local', 'GOFLAGS': '-mod=readonly'}
    fetched = subprocess.run(
        [GO, 'mod', 'download', 'github.com/foxglove/mcap/go/mcap'],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    if fetched.returncode:
        pytest.skip(f'the Go modules cannot be had: {fetched.stderr.strip()[-300:]}')
    build = [GO, 'build', '-o', 'mcap_check', '.']
    subprocess.run(build, cwd=folder, env=environment, check=True, timeout=600)

    def run(*paths):
        command = [str(folder / 'mcap_check'), *map(str, paths)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120)

    return run


def found_by(check, *paths):
    result = check(*paths)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def number(i):
    return bytes(STORE.serialize_cdr(STORE.types[NUMBER](data=float(i)), NUMBER))


def text(i):
    return bytes(STORE.serialize_cdr(STORE.types[TEXT](data=f'{i} µ' * 40), TEXT))


def fill(bag, count, first=0):
    bag.add_topic('/number', NUMBER, [QosProfile()])
    bag.add_topic('/text', TEXT)
    bag.add_topic('/never', TEXT)
    for i in range(first, first + count):
        now = START + i * STEP
        bag.write('/number', now, now - 5, number(i))
        if i % 3 == 0:
            bag.write('/text', now + 1, now, text(i))


def digest(make, numbers):
    """Return the checksum over all messages of a topic in order."""
    value = 0
    for i in numbers:
        value = zlib.crc32(make(i), value)
    return value


def test_go_reads_what_was_written(tmp_path, check):
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS, chunk_bytes=32 * 1024) as bag:
        fill(bag, 900)
    (found,) = found_by(check, bag.path)
    counts = {'/number': 900, '/text': 300}
    assert found['profile'] == 'ros2'
    assert found['streamed'] == counts
    assert found['indexed'] == counts
    assert {name: n for name, n in found['statistics'].items() if n} == counts
    assert found['digests'] == {
        '/number': digest(number, range(900)),
        '/text': digest(text, range(0, 900, 3)),
    }
    assert (found['first'], found['last']) == (START, START + 899 * STEP)
    assert found['schemas'] == {NUMBER: 'ros2msg', TEXT: 'ros2msg'}
    assert found['channels']['/number'] == {
        'offered_qos_profiles': profiles_to_yaml([QosProfile()]),
        'topic_type_hash': STORE.hash_rihs01(NUMBER),
    }
    assert found['chunks'] > 2
    assert found['compression'] == ['zstd']
    assert 0 not in (found['dataSectionCrc'], found['summaryCrc'])
    assert {name: found['metadata'][name] for name in DETAILS} == DETAILS


def test_go_reads_every_file_of_a_bag(tmp_path, check):
    paths = []
    for part in range(3):
        with BagWriter(tmp_path / 'run', metadata_records=DETAILS) as bag:
            fill(bag, 100, 100 * part)
        paths.append(bag.path)
    every = found_by(check, *paths)
    assert [each['streamed']['/number'] for each in every] == [100, 100, 100]
    assert [each['first'] for each in every] == [START + part * 100 * STEP for part in range(3)]
    assert all(each['metadata']['settings'] == DETAILS['settings'] for each in every)
    values = [each['digests']['/number'] for each in every]
    assert values == [digest(number, range(100 * p, 100 * p + 100)) for p in range(3)]


def test_go_reads_a_finalized_file(tmp_path, check):
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS, chunk_bytes=32 * 1024) as bag:
        fill(bag, 900)
    bag.path.write_bytes(bag.path.read_bytes()[: bag.path.stat().st_size // 2])
    kept = finalize_file(bag.path)
    (found,) = found_by(check, bag.path)
    assert 0 < kept < 1200
    assert sum(found['streamed'].values()) == sum(found['indexed'].values()) == kept
    whole = found['streamed']['/number']
    assert found['digests']['/number'] == digest(number, range(whole))


def test_attachments_are_read_and_their_checksums_verified(tmp_path, check):
    content = b'a model file \x00\xff' * 50
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS) as bag:
        fill(bag, 20)
        bag.add_attachment(Attachment('model.npz', 'application/zip', content, START), START)
        fill(bag, 20, 20)
    path = bag.path
    (found,) = found_by(check, path)
    (attached,) = found['attachments']
    assert attached['mediaType'] == 'application/zip'
    assert (attached['name'], attached['size']) == ('model.npz', len(content))
    assert base64.b64decode(attached['content']) == content
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(content) + 100] ^= 1
    path.write_bytes(damaged)
    result = check(path)
    assert result.returncode == 1
    assert 'attachment model.npz: checksum' in result.stderr


@pytest.mark.parametrize('part', ['chunk', 'summary', 'cut'])
def test_the_check_notices_damage(tmp_path, check, part):
    """The program must fail on a damaged bag."""
    with BagWriter(tmp_path / 'run', metadata_records=DETAILS) as bag:
        fill(bag, 300)
    content = bytearray(bag.path.read_bytes())
    if part == 'cut':
        del content[-200:]
    else:
        content[len(content) // 4 if part == 'chunk' else len(content) - 60] ^= 0x10
    bag.path.write_bytes(content)
    result = check(bag.path)
    assert result.returncode == 1, result.stdout
    assert str(bag.path) in result.stderr
