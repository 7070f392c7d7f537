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
"""Framing: the decoder finds all valid frames and no other in a damaged stream."""

import json
from pathlib import Path
import random

import pytest

from t3mpc_ros.radio.protocol import framing

VECTORS = json.loads((Path(__file__).parents[1] / 'golden' / 'radio_vectors.json').read_text())


def random_frame(source, longest=framing.FRAME_LIMIT):
    # 0 and 255 are the special cases of COBS.
    size = source.randint(1, longest)
    return bytes(source.choice((0, 255, source.randrange(256))) for _ in range(size))


def damage(wire, source):
    """Return the bytes of a frame with one random damage."""
    at = source.randrange(len(wire))
    match source.randrange(4):
        case 0:
            return wire[:at] + bytes([wire[at] ^ 1 << source.randrange(8)]) + wire[at + 1 :]
        case 1:
            return wire[:at] + wire[at + 1 :]
        case 2:
            return wire[:at] + source.randbytes(source.randint(1, 5)) + wire[at:]
        case _:
            return wire[:at] + wire[at : at + 1] + wire[at:]


def test_crc_check_value_and_golden_vectors():
    assert framing.crc16(b'123456789') == 0x29B1
    for row in VECTORS['crc16']:
        assert framing.crc16(bytes.fromhex(row['bytes'])) == row['crc']


def test_cobs_golden_vectors():
    for row in VECTORS['cobs']:
        data, encoded = bytes.fromhex(row['bytes']), bytes.fromhex(row['stuffed'])
        assert framing.cobs_encode(data) == encoded
        assert framing.cobs_decode(encoded) == data
    for row in VECTORS['wire']:
        assert framing.encode_frame(bytes.fromhex(row['bytes'])).hex() == row['wire']


def test_cobs_adds_one_byte_removes_zeros_and_is_invertible():
    source = random.Random(2)
    for size in range(254):
        data = bytes(source.choice((0, source.randrange(256))) for _ in range(size))
        encoded = framing.cobs_encode(data)
        assert len(encoded) == size + 1
        assert 0 not in encoded
        assert framing.cobs_decode(encoded) == data
    with pytest.raises(ValueError, match='at most 254 bytes long: got 255'):
        framing.cobs_encode(bytes(255))
    for frame in (b'', bytes(framing.FRAME_LIMIT + 1)):
        with pytest.raises(ValueError, match=f'must have 1 to 78 bytes: got {len(frame)}'):
            framing.encode_frame(frame)


def test_only_valid_cobs_decodes():
    source = random.Random(3)
    decoded = 0
    for _ in range(20000):
        encoded = bytes(source.randint(0, 6) for _ in range(source.randint(0, 8)))
        data = framing.cobs_decode(encoded)
        if data is not None:
            decoded += 1
            assert framing.cobs_encode(data) == encoded
    assert decoded > 500


def test_the_stream_may_be_split_anywhere():
    source = random.Random(4)
    sent = [random_frame(source) for _ in range(40)]
    stream = b''.join(framing.encode_frame(frame) for frame in sent)
    stream = stream[:500] + b'rubbish' + stream[500:1200] + b'\0\0\0' + stream[1200:]
    whole = framing.FrameDecoder()
    expected = whole.feed(stream)
    assert len(expected) > 35
    for step in (1, 2, 3, 7, 64, 1000):
        decoder = framing.FrameDecoder()
        found = []
        for at in range(0, len(stream), step):
            found += decoder.feed(stream[at : at + step])
        assert found == expected
        assert decoder.counts == whole.counts
    for cut in range(0, len(stream), 3):
        decoder = framing.FrameDecoder()
        assert decoder.feed(stream[:cut]) + decoder.feed(stream[cut:]) == expected


def test_zeros_in_a_row_are_no_errors():
    decoder, frame = framing.FrameDecoder(), framing.encode_frame(b'abc')
    assert decoder.feed(b'\0\0' + frame + b'\0\0\0' + frame) == [b'abc', b'abc']
    assert decoder.counts == (2, 0, 0)


def test_each_kind_of_error_is_counted_once():
    good = framing.encode_frame(b'good')
    for bad, counted in (
        (framing.cobs_encode(b'wrong' + b'\0\0') + b'\0', (0, 1, 0)),
        (framing.cobs_encode(b'\1\2') + b'\0', (0, 0, 1)),  # a CRC and nothing before it
        (b'\x01\0', (0, 0, 1)),
        (b'\x09\x01\0', (0, 0, 1)),  # a run beyond the end
        (bytes([7]) * 500 + b'\0', (0, 0, 1)),
        (
            framing.cobs_encode(bytes(79) + framing.crc16(bytes(79)).to_bytes(2, 'little'))
            + b'\0',
            (0, 0, 1),
        ),
    ):
        decoder = framing.FrameDecoder()
        assert decoder.feed(bad + good) == [b'good']
        assert decoder.counts == (counted[0] + 1, *counted[1:])


def test_random_bytes_yield_no_frame_or_growth():
    """CRC-16 passes one in 65 536 valid COBS blocks; noise rarely is valid COBS."""
    source = random.Random(5)
    decoder, found = framing.FrameDecoder(), []
    for _ in range(200):
        found += decoder.feed(source.randbytes(1000))
        assert len(decoder._buffer) <= framing._ENCODED_LIMIT
    counts = decoder.counts
    assert counts.frames == len(found) <= 1
    assert counts.crc_errors + counts.frame_errors > 700  # a zero every 256 bytes
    decoder.feed(b'\0')
    assert decoder.feed(framing.encode_frame(b'still here')) == [b'still here']


def test_every_single_bit_flip_is_detected():
    source = random.Random(6)
    for _ in range(20):
        wire = framing.encode_frame(random_frame(source))
        for bit in range(8 * len(wire)):
            flipped = bytearray(wire)
            flipped[bit // 8] ^= 1 << bit % 8
            assert framing.FrameDecoder().feed(bytes(flipped) + b'\0') == []


@pytest.mark.slow
def test_damaged_frames_never_pass_and_the_decoder_recovers():
    """A damaged frame may destroy the next one (lost zero), never the one after that."""
    source = random.Random(7)
    decoder = framing.FrameDecoder()
    wrong = damaged = neighbours = 0
    after_good = False
    for number in range(20000):
        # Unique by number: a frame from another round is wrong.
        frame = number.to_bytes(4, 'little') + random_frame(source, 30)
        hit = source.random() < 0.6
        wire = damage(framing.encode_frame(frame), source) if hit else framing.encode_frame(frame)
        found = decoder.feed(wire)
        damaged += hit
        wrong += sum(one != frame for one in found)
        if not hit:
            neighbours += frame not in found
            assert frame in found or not after_good
        after_good = not hit
    assert damaged > 11000
    # The CRC passes one in 65 536; there are 12 000 damaged frames.
    assert wrong <= 2
    assert neighbours < 0.1 * damaged
