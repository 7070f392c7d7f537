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
"""Frames: golden bytes, round trips, and decoding as all or nothing."""

import json
from pathlib import Path
import random
from typing import get_args

import pytest

from t3mpc_ros.radio.protocol import codec, frames
from t3mpc_ros.radio.protocol.frames import FrameError, FrameErrorKind
from t3mpc_ros.radio.protocol.framing import encode_frame

GOLDEN = Path(__file__).parents[1] / 'golden'
VECTORS = json.loads((GOLDEN / 'radio_vectors.json').read_text())
DECODERS = {
    'down': codec.decode_downlink,
    'up': codec.decode_uplink,
    'to_dongle': codec.decode_to_dongle,
    'from_dongle': codec.decode_from_dongle,
    'to_board': codec.decode_to_board,
    'from_board': codec.decode_from_board,
}
ROWS = [(way, row) for way in DECODERS for row in VECTORS[way]]
UNIONS = {
    codec.decode_downlink: frames.Downlink,
    codec.decode_uplink: frames.Uplink,
    codec.decode_to_dongle: frames.ToDongle,
    codec.decode_from_dongle: frames.FromDongle,
    codec.decode_to_board: frames.ToBoard,
    codec.decode_from_board: frames.FromBoard,
}
KINDS = [(kind, decode) for decode, union in UNIONS.items() for kind in get_args(union)]


def frame_of(row):
    kind = getattr(frames, row['kind'])
    return kind(
        **{
            name: bytes.fromhex(value) if isinstance(value, str) else value
            for name, value in row['fields'].items()
        }
    )


def columns(kind, signed):
    """Return name -> (code, low, high) of the fields of a frame with a fixed layout."""
    form = codec._LAYOUTS[kind][-1 if signed else 0]
    return {field.name: field for field in form._fields if field.name in kind._fields}


def some(kind, source, extreme=None):
    """Return a frame with random valid fields; with ``extreme``, each at one of its bounds."""
    values = {}
    for name, column in columns(kind, source.random() < 0.5).items():
        if column.code.endswith('s'):
            values[name] = source.randbytes(column.high)
        elif extreme is not None:
            values[name] = (column.low, column.high)[extreme]
        else:
            values[name] = source.randint(column.low, column.high)
    if kind is frames.Transmit:
        values['first'] = source.randbytes(source.randint(1, 32))
        values['second'] = source.randbytes(source.randint(0, 32))
    if kind is frames.Result:
        first, second = source.choice(
            [(0x01, 0x03), (0xF3, 0x21), (0x03, 0xF4), (0x34, 0x08), (0x11, 0x01), (0, 0)]
        )
        values |= {'first': first, 'second': second}
        answered = 2 & (first | second)
        values['payload'] = source.randbytes(source.randint(1, 32)) if answered else b''
    return kind(**values)


def test_constants_equal_the_golden_ones():
    golden = VECTORS['constants']
    assert golden['flags'] == {flag.name: flag.value for flag in frames.CommandFlag}
    assert golden['status'] == {status.name: status.value for status in frames.StatusFlag}
    numbers = golden['results'] | golden['actions'] | golden['polls']
    numbers |= {'VERSION': golden['version'], 'PAYLOAD_LIMIT': golden['payload_limit']}
    assert numbers == {name: getattr(frames, name) for name in numbers}
    rows = [{'id': n} | row._asdict() for n, row in enumerate(frames.BOARD_PARAMETERS)]
    assert golden['parameters'] == rows


@pytest.mark.parametrize('way, row', ROWS, ids=[f'{way}-{row["name"]}' for way, row in ROWS])
def test_golden_vectors_both_ways(way, row):
    frame, data = frame_of(row), bytes.fromhex(row['bytes'])
    assert codec.encode(frame) == data
    decoded = DECODERS[way](data)
    assert decoded == frame
    assert type(decoded) is type(frame)
    if 'wire' in row:
        assert encode_frame(data).hex() == row['wire']


def test_every_kind_has_a_golden_vector():
    assert {row['kind'] for _, row in ROWS} == {kind.__name__ for kind, _ in KINDS}


@pytest.mark.parametrize('row', VECTORS['rejected'], ids=lambda row: row['bytes'][:20])
def test_golden_rejections(row):
    with pytest.raises(FrameError) as error:
        DECODERS[row['direction']](bytes.fromhex(row['bytes']))
    assert error.value.kind is FrameErrorKind(row['fault'])


@pytest.mark.parametrize('kind, decode', KINDS)
def test_every_field_survives_the_round_trip(kind, decode):
    source = random.Random(7)
    for extreme in [0, 1, *200 * [None]]:
        frame = some(kind, source, extreme)
        data = codec.encode(frame)
        again = decode(data)
        assert again == frame
        assert codec.encode(again) == data


@pytest.mark.parametrize('kind, decode', KINDS)
def test_encoding_errors_name_the_field(kind, decode):
    source = random.Random(8)
    good = some(kind, source)
    for name, column in columns(kind, good[-1] != b'').items():
        if column.code.endswith('s'):
            bad = [bytes(column.high + 1), bytes(column.high - 1), None, 3]
        else:
            bad = [column.low - 1, column.high + 1, None, 1.5, b'']
        for value in bad:
            if value in (b'', bytes(0)) and name == kind._fields[-1]:
                continue
            with pytest.raises(FrameError, match=rf'\.{name} must be .*: got'):
                codec.encode(good._replace(**{name: value}))


@pytest.mark.parametrize('kind, decode', KINDS)
def test_truncated_and_extended_frames_are_rejected(kind, decode):
    source = random.Random(9)
    for _ in range(20):
        data = codec.encode(some(kind, source))
        if kind is frames.Transmit:
            # The variable end has no length field: the CRC of the line protects it.
            shortest = 4 + data[3]
        elif kind is frames.Result and len(data) > 8:
            shortest = 9
        else:
            shortest = len(data)
        for size in range(shortest):
            # Unsigned frames and read requests lack the optional end.
            if size in [form.size for form in codec._LAYOUTS[kind][:-1]] and kind != frames.Hello:
                assert codec.encode(decode(data[:size])) == data[:size]
                continue
            with pytest.raises(FrameError) as error:
                decode(data[:size])
            # The flag of a HELLO shows whether it is signed.
            flagged = kind is frames.Hello and size == 4
            assert error.value.kind is (FrameErrorKind.VALUE if flagged else FrameErrorKind.LENGTH)
        if kind not in (frames.Transmit, frames.Result):
            with pytest.raises(FrameError):
                decode(data + b'\0')


@pytest.mark.parametrize('kind, decode', KINDS)
def test_every_bit_flip_is_rejected_or_decoded_completely(kind, decode):
    """A radio payload has no CRC: an accepted one must encode to the same bytes."""
    source = random.Random(10)
    for _ in range(10):
        data = codec.encode(some(kind, source))
        for bit in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            try:
                frame = decode(bytes(flipped))
            except FrameError:
                continue
            assert codec.encode(frame) == flipped
            assert frame != decode(data) or type(frame) is not kind


def test_payloads_longer_than_32_bytes_are_rejected():
    """A payload width above 32 bytes is a known buffer overrun of the radio chip."""
    for size in range(33, 256):
        for decode in (codec.decode_downlink, codec.decode_uplink):
            for head in (b'\x21', b'\x23', b'\x24'):
                with pytest.raises(FrameError, match='1 to 32 bytes'):
                    decode(head + bytes(size - 1))


def test_wrong_version_and_wrong_kind_are_distinguished():
    for head in range(256):
        for decode in (codec.decode_downlink, codec.decode_uplink):
            with pytest.raises(FrameError) as error:
                decode(bytes([head, 0, 0]))
            assert (error.value.kind is FrameErrorKind.VERSION) == (head >> 4 != frames.VERSION)


def test_a_field_of_signed_frames_is_not_dropped_silently():
    with pytest.raises(FrameError, match=r'PARAM_SET.host_us must be 0 without tag: got 5'):
        codec.encode(frames.ParamSet(1, 2, 3, 4, host_us=5))
    with pytest.raises(FrameError, match=r'HELLO.nonce must be b.. without tag'):
        codec.encode(frames.Hello(1, 2, nonce=bytes(8)))


def test_an_inconsistent_result_is_rejected():
    good = 0
    for first in range(256):
        for payload in (b'', b'\1'):
            try:
                codec.encode(frames.Result(0, first, 0, 0, payload))
            except FrameError:
                continue
            good += 1
            status = codec.decode_exchange_status(first)
            assert bool(payload) == status.has_payload
            assert status.acknowledged + status.failed + status.skipped <= 1
    # Sixteen retransmission counts for each status: acknowledged, with payload, failed, none;
    # skipped has one.
    assert good == 4 * 16 + 1


@pytest.mark.parametrize('decode', list(UNIONS))
def test_random_bytes_are_rejected_or_decoded_completely(decode):
    source = random.Random(11)
    whole = [codec.encode(some(kind, source)) for kind in get_args(UNIONS[decode])]
    decoded = 0
    for _ in range(4000):
        data = source.randbytes(source.randint(0, 80))
        if source.random() < 0.8:
            frame = source.choice(whole)
            # Half of them with a valid length and valid first bytes.
            size = source.choice((len(data), len(frame)))
            data = (frame[: source.randint(1, 4)] + source.randbytes(80))[:size]
        try:
            frame = decode(data)
        except FrameError:
            continue
        decoded += 1
        assert codec.encode(frame) == data
    assert decoded > 10
