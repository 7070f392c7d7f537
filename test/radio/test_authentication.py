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
"""Authentication: a keyed robot accepts signed frames only, each of them once."""

import json
import os
from pathlib import Path
import random

import pytest
from support.firmware_core import CoreVerifier

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import (
    KeyFileError,
    Signer,
    frame_tag,
    key_check,
    read_key,
    session_key,
    sign_hello,
    siphash,
)
from t3mpc_ros.radio.protocol.codec import decode_downlink, encode
from t3mpc_ros.radio.protocol.frames import CommandFlag, RefusalReason

GOLDEN = json.loads((Path(__file__).parents[1] / 'golden' / 'radio_vectors.json').read_text())
VECTORS = GOLDEN['authentication']
KEY = bytes(range(100, 116))
ALIEN = bytes(range(101, 117))
COMMAND = frames.Command(9, 1, CommandFlag.ENABLE, 20, 3000, 3000, 0)
SAMPLES = (
    COMMAND,
    frames.ParamSet(9, 2, 0, 15000),
    frames.Action(9, 3, frames.RESET_ODOMETRY),
)


def meet(key=KEY, host_us=1000, session=9, nonces=(b'HOSTHOST', b'ROBOTROB'), verifier=None):
    """Return both ends of a session."""
    verifier = verifier or CoreVerifier(key)
    assert not verifier.begin_session(sign_hello(key, session, 0, host_us, nonces[0]), nonces[1])
    return Signer(session_key(key, nonces[0], verifier.nonce), host_us), verifier


def test_all_64_vectors_of_the_reference_implementation():
    key, tags = bytes.fromhex(GOLDEN['siphash']['key']), GOLDEN['siphash']['tags']
    assert len(tags) == 64
    for length, tag in enumerate(tags):
        assert siphash(key, bytes(range(length))).hex() == tag


@pytest.mark.parametrize('size', [0, 15, 17])
def test_a_key_of_wrong_length_is_rejected(size):
    with pytest.raises(ValueError, match=f'key must be 16 bytes long: got {size}'):
        siphash(bytes(size), b'')


def test_golden_session_step_by_step():
    verifier = CoreVerifier(bytes.fromhex(VECTORS['key']))
    for row in VECTORS['robot']:
        frame = decode_downlink(bytes.fromhex(row['bytes']))
        if isinstance(frame, frames.Hello):
            why = verifier.begin_session(frame, bytes.fromhex(row['fresh_nonce']))
        else:
            why = verifier.verify(frame)
        assert (not why, why) == (row['accepted'], row['refusal']), row['name']
        assert (verifier.session, verifier.nonce.hex()) == (row['session'], row['robot_nonce'])
    for row in VECTORS['robot_without_key']:
        frame = decode_downlink(bytes.fromhex(row['bytes']))
        assert (not CoreVerifier().begin_session(frame, bytes(8))) == row['accepted']


def test_golden_estops_are_executed_and_verified():
    """Regression: the verifier accepted every ESTOP unseen, the firmware counted signed ones."""
    story = VECTORS['stops']
    verifiers = [CoreVerifier(bytes.fromhex(VECTORS['key'])) for _ in range(2)]
    for verifier in verifiers:
        hello = decode_downlink(bytes.fromhex(story['hello']))
        assert not verifier.begin_session(hello, bytes.fromhex(story['fresh_nonce']))
    counted = []
    for row in story['frames']:
        frame = decode_downlink(bytes.fromhex(row['bytes']))
        counted.append(not verifiers[0].accept(frame))
        assert counted[-1] == row['counted'], row['name']
        stops = bool(frame.flags & CommandFlag.ESTOP)
        assert (not verifiers[1].verify(frame)) == (stops or counted[-1]), row['name']
    assert len(set(counted)) == 2


def test_estop_repeated_for_hours_keeps_the_epoch():
    """Both ends count wraps of the host clock while only ESTOP frames are sent."""
    signer, verifier = meet(host_us=1000)
    stop = frames.Command(9, 0, CommandFlag.ESTOP, 0, 0, 0, 0)
    for number in range(1, 7):
        host_us = (1000 + number * 0x80000001) % (1 << 32)
        assert not verifier.accept(signer.sign(stop._replace(seq=number, host_us=host_us)))
    clear = frames.Command(9, 7, CommandFlag.ESTOP_CLEAR, 0, 0, 0, 0, (host_us + 1) % (1 << 32))
    assert not verifier.verify(signer.sign(clear))
    assert signer.epoch == 3


def test_the_check_value_is_the_published_hash_of_the_key():
    for row in GOLDEN['key_checks']:
        assert key_check(bytes.fromhex(row['key'])) == row['check']


def test_golden_session_keys_and_tags():
    key = bytes.fromhex(VECTORS['key'])
    for row in VECTORS['session_keys']:
        nonces = bytes.fromhex(row['host_nonce']), bytes.fromhex(row['robot_nonce'])
        assert session_key(key, *nonces).hex() == row['session_key']
    for row in VECTORS['tags']:
        frame = decode_downlink(bytes.fromhex(row['bytes']))
        assert frame_tag(frame, bytes.fromhex(row['session_key']), row['epoch']) == frame.tag


@pytest.mark.parametrize('frame', SAMPLES, ids=lambda frame: type(frame).__name__)
def test_every_bit_of_a_signed_frame_is_protected(frame):
    signer, verifier = meet()
    data = encode(signer.sign(frame._replace(host_us=2000)))
    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        assert verifier.receive(bytes(flipped))  # an altered ESTOP stops, but is refused
    # The genuine frame is still valid.
    assert not verifier.accept(decode_downlink(data))


def test_both_ends_count_the_same_wraps_of_host_us():
    """With commands 20 ms apart and losses of up to a minute, over five wraps: six hours."""
    source = random.Random(3)
    signer, verifier = meet(host_us=0xFFFFFFF0)
    now, taken = 0xFFFFFFF0, 0
    while now < 6 << 32:
        now += source.choice((20_000, 60_000_000, source.randrange(1, 600_000_000)))
        signed = signer.sign(COMMAND._replace(host_us=now & 0xFFFFFFFF))
        assert signer.epoch == (now >> 32)
        if source.random() < 0.5:  # the other frames are lost
            assert not verifier.verify(signed)
            taken += 1
    assert taken > 50


def test_the_signer_rejects_a_repeated_host_us():
    signer, _ = meet()
    signer.sign(COMMAND._replace(host_us=7000))
    with pytest.raises(ValueError, match='host_us must increase: got 7000 twice'):
        signer.sign(COMMAND._replace(host_us=7000))


def test_estop_needs_no_tag_but_its_release_does():
    signer, verifier = meet()
    stop = frames.Command(0, 0, CommandFlag.ESTOP, 0, 0, 0, 0)
    clear = frames.Command(9, 1, CommandFlag.ESTOP_CLEAR, 0, 0, 0, 0, 5000)
    for frame in (stop, stop._replace(session=77, tag=bytes(8)), stop._replace(flags=7)):
        assert not verifier.verify(frame)
        assert not CoreVerifier(KEY).verify(frame)
        assert not CoreVerifier().verify(frame)
    assert verifier.verify(clear._replace(host_us=0)) is RefusalReason.UNSIGNED
    assert verifier.verify(clear._replace(tag=bytes(8)))
    assert not verifier.verify(signer.sign(clear))


@pytest.mark.parametrize('text', ['6465' * 8, '64 65 ' * 8, ('6465' * 8).upper() + '\n'])
def test_a_key_file_of_32_digits_is_read(tmp_path, monkeypatch, text):
    """A launch argument such as ``key_file:=~/key`` is not expanded by the shell."""
    monkeypatch.setenv('HOME', str(tmp_path))
    path = tmp_path / 'key'
    path.write_text(text)
    for mode in (0o600, 0o400):
        path.chmod(mode)
        assert read_key(path) == read_key(Path('~/key')) == b'de' * 8


@pytest.mark.parametrize(
    'text, mode, expected',
    [
        ('6465' * 8, 0o640, 'closed to all but its owner: got mode 0640; chmod 600'),
        ('6465' * 8, 0o604, 'closed to all but its owner'),
        ('6465' * 7, 0o600, 'must hold 32 hexadecimal digits: got 28'),
        ('secret' * 5 + 'zz', 0o600, 'must hold hexadecimal digits only'),
        ('schlüssel', 0o600, 'must hold hexadecimal digits only'),
        ('00' * 16, 0o600, 'holds zeros only, which is no key'),
    ],
)
def test_an_invalid_key_file_is_rejected_without_quoting_it(tmp_path, text, mode, expected):
    path = tmp_path / 'key'
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(KeyFileError, match=expected) as error:
        read_key(path)
    assert text[:6] not in str(error.value)
    assert error.value.__cause__ is None


def test_a_path_without_a_key_file_is_rejected(tmp_path):
    """A FIFO without a writer blocked the start for ever."""
    os.mkfifo(tmp_path / 'fifo', 0o600)
    for name in (tmp_path / 'fifo', tmp_path, '/dev/zero', tmp_path / 'nothing', '~no_such/key'):
        with pytest.raises(KeyFileError, match='must be a regular file|cannot be read: '):
            read_key(Path(name))


def test_a_frame_from_before_a_wrap_is_rejected_after_it():
    signer, verifier = meet(host_us=0xFFFFFF00)
    late = signer.sign(COMMAND._replace(host_us=0xFFFFFFFE))
    assert not verifier.verify(signer.sign(COMMAND._replace(host_us=3)))
    assert verifier.verify(late)
    # The robot tests only the next epoch for it.
    assert not verifier.verify(signer.sign(COMMAND._replace(host_us=4)))


def test_replays_from_an_earlier_session_are_rejected():
    """Session numbers and times may repeat: each HELLO leads to a new robot nonce."""
    signer, verifier = meet()
    recorded = [signer.sign(COMMAND._replace(host_us=2000 + step)) for step in range(20)]
    for frame in recorded:
        assert not verifier.verify(frame)
    hello = sign_hello(KEY, 9, 0, 1000, b'HOSTHOST')
    meet(verifier=verifier, nonces=(b'NEWHOST.', b'NEWROBOT'))
    for frame in recorded:
        assert verifier.verify(frame)
    # Nor after a replay of the HELLO: the session key of the new session is unknown.
    assert not verifier.begin_session(hello, b'THIRDROB')
    for frame in recorded:
        assert verifier.verify(frame)


def test_a_tag_is_bound_to_its_kind_and_session():
    signer, _ = meet()
    signed = [signer.sign(frame._replace(host_us=10 + at)) for at, frame in enumerate(SAMPLES)]
    assert len({frame.tag for frame in signed}) == 3
    for key in (KEY, ALIEN, session_key(KEY, b'HOSTHOST', b'OTHERROB')):
        for frame in signed:
            for epoch in (0, 1):
                if (key, epoch) != (session_key(KEY, b'HOSTHOST', b'ROBOTROB'), 0):
                    assert frame_tag(frame, key, epoch) != frame.tag
