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
"""Firmware core: CRC, framing, SipHash, range codes, clock, and the golden vectors."""

from binascii import crc_hqx
import ctypes
import random
import struct

import pytest
from support import firmware_core as core
from support.long_tests import few_of

from t3mpc_ros.radio.protocol.authentication import siphash
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame
from t3mpc_ros.robot.sensor_parameters import encode_range
from t3mpc_ros.simulation.sensors import range_sensor

COMMAND = bytes.fromhex('215a0701140088133cf615cd5b07')
TX = 0x01
TX_WIRE = bytes.fromhex('0a012a060e215a0701140c88133cf615cd5b07255a0703585400')
STATE = bytes.fromhex('215a070315cd5b07e803000018fcffff7dffa40000004c00a0fe013c00145078')
RESULT_WIRE = bytes.fromhex(
    '05812a03130eca5b07215a070315cd5b07e803010818fcffff7dffa40101024c05a0fe013c061450787a7e00'
)


def test_the_crc_is_that_of_the_standard_library(library):
    assert library.t3_host_crc16(b'123456789', 9) == 0x29B1
    generator = random.Random(1)
    for size in range(79):
        data = generator.randbytes(size)
        assert library.t3_host_crc16(data, size) == crc_hqx(data, 0xFFFF)


def test_encoded_frames_equal_the_reference(library):
    generator = random.Random(2)
    for size in (*range(1, 79), *generator.choices(range(1, 79), k=2000)):
        frame = bytes(generator.choices((0, 1, 0xFF, generator.randrange(256)), k=size))
        assert core.c_encode_frame(library, frame) == encode_frame(frame)
    assert core.c_encode_frame(library, b'') == core.c_encode_frame(library, bytes(79)) == b''


@pytest.mark.parametrize('seed', few_of(range(40), 4))
def test_decoder_equals_the_reference_on_a_damaged_stream(library, seed):
    generator = random.Random(seed)
    stream = bytearray()
    for _ in range(300):
        wire = bytearray(encode_frame(generator.randbytes(generator.randint(1, 78))))
        for _ in range(generator.choice((0, 0, 1, 2))):
            at = generator.randrange(len(wire))
            match generator.randrange(4):
                case 0:
                    wire[at] = generator.randrange(256)
                case 1:
                    del wire[at]
                case 2:
                    wire.insert(at, generator.randrange(256))
                case 3:
                    wire += generator.randbytes(100)
            wire = wire or bytearray(1)
        stream += wire
    stream += b'\0'
    decoder = core.Decoder(library)
    reference = FrameDecoder()
    assert decoder.feed(bytes(stream)) == reference.feed(bytes(stream))
    counts = reference.counts
    assert decoder.counts() == counts
    assert counts[0] > 100
    assert min(counts[1:]) > 10


def test_siphash_equals_that_of_the_host(library):
    room, generator = ctypes.create_string_buffer(8), random.Random(3)
    for size in (*range(64), 255):
        key, message = generator.randbytes(16), generator.randbytes(size)
        library.t3_host_siphash(key, message, size, room)
        assert room.raw == siphash(key, message)


def test_range_codes_equal_those_of_the_simulation(library):
    """Open and shorted wires are codes of the board alone."""
    parameters = range_sensor.SimulatedRangeSensorParameters()
    for count in range(984):
        wanted = encode_range(range_sensor.distance_from_voltage(parameters.volts(count)))
        assert library.t3_host_range_code(count) == wanted, count
    assert {library.t3_host_range_code(count) for count in (984, 1023, 0xFFFE)} == {255}
    assert library.t3_host_range_code(0xFFFF) == 0


def test_clock_is_exact_around_a_timer_overflow(library):
    """An overflow between reading the count and the flag of the timer does not lose 50 us."""
    for start in (0, 0xFFFFFFC8, 0x7FFFFFF0):
        for true in range(200):
            ticks, timer = divmod(true, 50)
            # The last interrupt may be pending shortly after an overflow, and the next one may
            # become pending right after the count was read.
            for pending in {False, timer < 25, timer == 49}:
                base = start + 50 * (ticks - (1 if pending and timer < 25 else 0))
                read = library.t3_host_time_us(base, timer, pending)
                assert read == (start + true) % (1 << 32)


# -- golden vectors -------------------------------------------------------------------------------


def test_transaction_with_the_golden_result(library):
    dongle = core.Dongle(library)
    dongle.run(123_456_000 - 3000)
    dongle.call('bytes', TX_WIRE, len(TX_WIRE))
    assert dongle.sent() == COMMAND
    dongle.run(1500)
    dongle.reply(bytes(32))
    dongle.run(1490)
    assert dongle.sent() == b''
    dongle.run(10)
    assert dongle.sent() == b'\x25\x5a\x07\0'
    assert dongle.read() == b''
    dongle.reply(STATE, retransmits=1)
    assert dongle.read() == RESULT_WIRE


DOWN_NAMES = {'flags': 'what', 'id': 'what', 'verb': 'what'}


def test_golden_downlink_payloads_are_decoded(library, golden):
    for vector in golden['down']:
        data, fields = bytes.fromhex(vector['bytes']), vector['fields']
        fault, packet = core.c_decode(library, data)
        assert fault == 0, vector['name']
        for name, value in fields.items():
            if name in ('nonce', 'tag'):
                assert packet[name] == bool(value), vector['name']
            else:
                assert packet[DOWN_NAMES.get(name, name)] == value, (vector['name'], name)


def test_golden_uplink_payloads_are_encoded(library, golden):
    kinds = {'State': 1, 'Param': 2, 'Info': 3, 'Ack': 4, 'Aux': 5}
    for vector in golden['up']:
        numbers, fields = [], vector['fields']
        for value in fields.values():
            numbers += [value] if isinstance(value, int) else bytes.fromhex(value)
        written = core.c_encode(library, kinds[vector['kind']], numbers, bool(fields.get('nonce')))
        assert written.hex() == vector['bytes'], vector['name']


def test_golden_malformed_frames_are_rejected(library, golden):
    faults = {'version': 1, 'kind': 2, 'length': 2, 'value': 2}
    for vector in golden['rejected']:
        data = bytes.fromhex(vector['bytes'])
        if vector['direction'] == 'down':
            assert core.c_decode(library, data)[0] == faults[vector['fault']], vector
        elif vector['direction'] == 'to_dongle' and data:
            dongle = core.Dongle(library)
            dongle.write(data)
            code = 1 if vector['fault'] == 'kind' else 2
            assert dongle.frames() == [bytes([0x8F, code, data[0]])], vector
            assert dongle.sent() == b''


def test_golden_encodings_and_parameters(library, golden):
    for vector in golden['wire']:
        assert core.c_encode_frame(library, bytes.fromhex(vector['bytes'])).hex() == vector['wire']
    robot = core.Robot(library)
    robot.hello()
    for row in golden['constants']['parameters']:
        answer = robot.request(bytes([0x22, core.SESSION, 0, row['id']]))
        value, low, high = struct.unpack_from('<iii', answer, 5)
        expected = value if row['name'] == 'boots' else row['default']
        assert (answer[4], value, low, high) == (0, expected, row['low'], row['high'])


def test_golden_console_frames(library, golden):
    for vector in golden['to_board']:
        robot = core.Robot(library)
        robot.run(1000)
        (reply,) = robot.console(bytes.fromhex(vector['bytes']), 5000)
        frame = bytes.fromhex(vector['bytes'])
        assert core.c_encode_frame(library, frame).hex() == vector['wire']
        if frame[0] == 3:
            assert reply[:6] == b'\x83' + frame[1:]
        elif frame[0] == 7:  # nothing is staged
            assert reply[:3] == bytes([0x86, frame[1], core.UNKNOWN])
        elif frame[0] == 8:
            assert reply[:2] == bytes([0x88, frame[1]])
        else:
            assert reply[:3] == bytes([frame[0] | 0x80, frame[1], core.OK])
    for row in golden['key_checks']:
        robot = core.Robot(library, bytes.fromhex(row['key']))
        assert robot.console(b'\x04\x09') == [b'\x84\x09\0\1' + struct.pack('<I', row['check'])]
    for vector in golden['rejected']:
        data = bytes.fromhex(vector['bytes'])
        # A board on a cable takes TX itself, as a dongle does.
        if vector['direction'] == 'to_board' and data[0] != TX:
            code = 1 if vector['fault'] == 'kind' else 2
            assert core.Robot(library).console(data) == [bytes([0x8F, code, data[0]])], vector
