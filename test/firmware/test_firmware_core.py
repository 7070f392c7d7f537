# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The firmware's portable core, compiled for this machine: bytes, rules of motion, signatures.

Time is virtual: the stepping interrupt runs every 50 us of it, the main loop every 200.
"""

from binascii import crc_hqx
import ctypes
import json
import math
from pathlib import Path
import random
import re
import shutil
import struct
import subprocess

import pytest

from t3mpc_ros.robot.sensor_conversions import encode_range
from t3mpc_ros.simulation.sensors import range_sensor

ROOT = Path(__file__).resolve().parents[2]
FIRMWARE = ROOT / 'firmware'
GOLDEN = ROOT / 'test' / 'golden' / 'radio_vectors.json'
KEY = bytes(range(0x80, 0x90))
ENABLE, ESTOP, CLEAR = 1, 2, 4
ENABLED, MOVING, LATCHED, EXPIRED, IMU_FAULT, LOW_BATTERY, NO_SESSION, LIMITED = (
    1 << bit for bit in range(8)
)
OK, UNKNOWN, RANGE, READ_ONLY, BUSY = range(5)
MAX_SPEED, ACCELERATION, DECELERATION, TTL_MAX, MICROSTEPS = range(5)
STEPS_PER_REV, GYRO_RANGE, BATTERY_LOW, IDLE_OFF, INVERT = range(5, 10)
COUNTERS = ('received', 'duplicates', 'bad_session', 'stale', 'expired', 'bad_version', 'short')
PACKET = ('kind', 'session', 'seq', 'what', 'ttl', 'left', 'right', 'value', 'host_us')
STEP = math.tau / 3200
SESSION = 0x5A

COMMAND = bytes.fromhex('115a0701140088133cf604030201')
TX_WIRE = bytes.fromhex('0a012a060e115a0701140c88133cf604030201155a070398b400')
STATE = bytes.fromhex('115a070315cd5b07e803000018fcffff7dffa40000004c00a0fe013c00145078')
RESULT_WIRE = bytes.fromhex(
    '05812a03130eca5b07115a070315cd5b07e803010818fcffff7dffa40101024c05a0fe013c06145078142300'
)

pytestmark = pytest.mark.skipif(shutil.which('gcc') is None, reason='needs gcc')


# -- the library and what drives it ---------------------------------------------------------------


@pytest.fixture(scope='module')
def library(tmp_path_factory):
    """Return the core as ``make host`` builds it, outside the source tree."""
    target = tmp_path_factory.mktemp('firmware') / 'libt3core.so'
    flags = ['-std=c99', '-pedantic', '-Wall', '-Wextra', '-Werror', '-O2', '-fPIC', '-shared']
    sources = sorted(map(str, [*FIRMWARE.glob('core/*.c'), *FIRMWARE.glob('host/*.c')]))
    folders = [f'-I{FIRMWARE / "core"}', f'-I{FIRMWARE / "host"}']
    subprocess.run(['gcc', *flags, *folders, '-o', target, *sources], check=True)
    core = ctypes.CDLL(str(target))
    for name in ('robot_new', 'dongle_new', 'splitter_new'):
        getattr(core, f't3_host_{name}').restype = ctypes.c_void_p
    for name in ('robot_pulses', 'robot_steps', 'robot_speed'):
        getattr(core, f't3_host_{name}').restype = ctypes.c_int32
    for name in (
        'robot_time',
        'robot_loads',
        'robot_closest_pulses',
        'robot_unpowered_pulses',
        'robot_hasty_pulses',
        'robot_eeprom_writes',
        'robot_usb_take',
        'dongle_take',
        'dongle_time',
        'dongle_configured',
        'splitter_feed',
        'time_us',
    ):
        getattr(core, f't3_host_{name}').restype = ctypes.c_uint32
    for name in ('robot_ack', 'robot_status', 'dongle_sent', 'to_wire', 'range_code', 'decode'):
        getattr(core, f't3_host_{name}').restype = ctypes.c_uint8
    core.t3_host_encode.restype = ctypes.c_uint8
    core.t3_host_crc16.restype = ctypes.c_uint16
    core.t3_host_robot_powered.restype = ctypes.c_bool
    return core


class Part:
    """One object of the library: ``self.call('run', 5)`` is ``t3_host_<kind>_run(object, 5)``."""

    kind = ''

    def __init__(self, library, *arguments):
        self.library = library
        self._object = ctypes.c_void_p(
            getattr(library, f't3_host_{self.kind}_new')(*map(ctypes.c_uint8, arguments))
        )
        self._functions = {}

    def __del__(self):
        self.call('free')

    def call(self, name, *arguments):
        if name not in self._functions:
            self._functions[name] = getattr(self.library, f't3_host_{self.kind}_{name}')
        return self._functions[name](self._object, *arguments)


class Robot(Part):
    """A robot, and a host that never errs unless told to. Times are us, speeds mrad/s."""

    kind = 'robot'

    def __init__(self, library, key=b'', time=0):
        super().__init__(library)
        self.key = key
        self.session_key = b''
        self.seq = 0
        self.travel = 1000  # us from the host's stamp to the robot
        if key:
            self.call('store_key', key)
        self.call('boot', 4, ctypes.c_uint32(time))

    @property
    def now(self):
        return self.call('time')

    @property
    def host_us(self):
        return (self.now - self.travel) % (1 << 32)

    @property
    def status(self):
        return self.call('status')

    @property
    def speeds(self):
        """Of left and right wheel, rad/s, where the ramp is."""
        return self.call('speed', 0) / 1e6, self.call('speed', 1) / 1e6

    @property
    def steps(self):
        return self.call('steps', 0), self.call('steps', 1)

    @property
    def pulses(self):
        return self.call('pulses', 0), self.call('pulses', 1)

    def run(self, us):
        self.call('run', ctypes.c_uint32(us))

    def poke(self, time):
        """Move the robot's clock, and all it remembers of it; not the host's."""
        self.travel += time - self.now
        self.call('poke_time', ctypes.c_uint32(time))

    def send(self, data):
        self.call('packet', bytes(data), ctypes.c_uint8(len(data)))

    def answer(self):
        """Return what an exchange would fetch now."""
        room = ctypes.create_string_buffer(32)
        size = self.call('ack', room)
        return room.raw[:size]

    def ask(self, data):
        """Return what the robot loads after a payload."""
        self.send(data)
        self.run(1000)
        return self.answer()

    def counters(self):
        """Return the seven counters of AUX."""
        aux = self.ask(bytes([0x15, 0, 0, 1]))
        counts = struct.unpack_from('<5H', aux, 14) + struct.unpack_from('<2H', aux, 28)
        return dict(zip(COUNTERS, counts, strict=True))

    def sign(self, body, epoch=0):
        if not self.session_key:
            return body
        return body + siphash(self.session_key, body + epoch.to_bytes(4, 'little'))

    def hello(self, session=SESSION, nonce=b'\1\2\3\4\5\6\7\x08'):
        head = struct.pack('<BBBBI', 0x14, session, 0, bool(self.key), self.host_us)
        if self.key:
            head += nonce
            head += siphash(self.key, head)
        info = self.ask(head)
        if self.key:
            nonces = nonce + info[17:]
            self.session_key = b''.join(siphash(self.key, nonces + bytes([i])) for i in (0, 1))
        return info

    def command(self, left=0, right=0, flags=ENABLE, ttl=20, seq=None, session=SESSION, **other):
        if seq is None:
            self.seq = seq = (self.seq + 1) % 256
        host_us = other.get('host_us', self.host_us)
        body = struct.pack(
            '<BBBBBBhhI', 0x11, session, seq, flags, ttl, 0, round(left), round(right), host_us
        )
        return self.sign(body, other.get('epoch', 0))

    def drive(self, left, right, us, period=20_000, **other):
        """Command for some time, as a host does, 50 times a second."""
        for begun in range(0, us, period):
            self.send(self.command(left, right, **other))
            self.run(min(period, us - begun))

    def set(self, number, value, session=SESSION):
        """Return (rc, value) of a PARAM_SET."""
        body = struct.pack('<BBBBi', 0x13, session, 9, number, value)
        if self.session_key:
            body = self.sign(body + struct.pack('<I', self.host_us))
        return self.parameter(self.ask(body))

    def get(self, number):
        return self.parameter(self.ask(bytes([0x12, SESSION, 9, number])))

    def parameter(self, answer):
        assert answer[0] == 0x12
        assert len(answer) == 17
        return answer[4], struct.unpack_from('<i', answer, 5)[0]

    def cable(self, frame, us=1000):
        """Return what the robot says over its own USB to a frame."""
        wire = to_wire(frame)
        self.call('usb', wire, ctypes.c_uint32(len(wire)))
        self.run(us)
        room = ctypes.create_string_buffer(4096)
        size = self.call('usb_take', room, ctypes.c_uint32(4096))
        return [unwire(piece) for piece in room.raw[:size].split(b'\0')[:-1]]

    def act(self, verb, seq, session=SESSION):
        body = struct.pack('<BBBBH', 0x16, session, seq, verb, 0)
        if self.session_key:
            body = self.sign(body + struct.pack('<I', self.host_us))
        return self.ask(body)


class Dongle(Part):
    kind = 'dongle'

    def __init__(self, library):
        super().__init__(library, 2)

    def write(self, frame):
        self.call('bytes', to_wire(frame), ctypes.c_uint32(len(to_wire(frame))))

    def run(self, us):
        self.call('run', ctypes.c_uint32(us))

    def sent(self):
        room = ctypes.create_string_buffer(32)
        size = self.call('sent', room)
        return room.raw[:size]

    def reply(self, payload=b'', retransmits=0, acknowledged=True):
        self.call(
            'answer',
            ctypes.c_bool(acknowledged),
            ctypes.c_uint8(retransmits),
            payload,
            ctypes.c_uint8(len(payload)),
        )

    def read(self):
        room = ctypes.create_string_buffer(4096)
        size = self.call('take', room, ctypes.c_uint32(4096))
        return room.raw[:size]

    def frames(self):
        return [unwire(piece) for piece in self.read().split(b'\0')[:-1]]


@pytest.fixture
def robot(library):
    """Return a robot without a key, in session, at rest."""
    made = Robot(library)
    made.run(1000)
    made.hello()
    return made


@pytest.fixture
def gentle(robot):
    """Return a robot whose ramps are long enough to look at: 15 rad/s² up, 30 down."""
    assert robot.set(ACCELERATION, 15_000) == (OK, 15_000)
    assert robot.set(DECELERATION, 30_000) == (OK, 30_000)
    return robot


@pytest.fixture
def keyed(library):
    """Return a robot with a key, in session, at rest."""
    made = Robot(library, KEY)
    made.run(1000)
    made.hello()
    return made


# -- references of our own ------------------------------------------------------------------------


def stuff(data):
    return b''.join(bytes([len(run) + 1]) + run for run in data.split(b'\0'))


def unstuff(stuffed):
    runs, rest = [], stuffed
    while rest:
        run, rest = rest[1 : rest[0]], rest[rest[0] :] if len(rest) >= rest[0] else None
        if rest is None:
            return None
        runs.append(run)
    return b'\0'.join(runs)


def to_wire(frame):
    return stuff(frame + crc_hqx(frame, 0xFFFF).to_bytes(2, 'little')) + b'\0'


def unwire(piece):
    data = unstuff(piece)
    assert crc_hqx(data[:-2], 0xFFFF) == int.from_bytes(data[-2:], 'little')
    return data[:-2]


def siphash(key, message):
    """SipHash-2-4 after the paper, in numbers as large as they get."""
    limit = 1 << 64

    def rotate(word, by):
        return (word << by | word >> (64 - by)) % limit

    def rounds(v0, v1, v2, v3, count):
        for _ in range(count):
            v0, v2 = (v0 + v1) % limit, (v2 + v3) % limit
            v1, v3 = rotate(v1, 13) ^ v0, rotate(v3, 16) ^ v2
            v0 = rotate(v0, 32)
            v2, v0 = (v2 + v1) % limit, (v0 + v3) % limit
            v1, v3 = rotate(v1, 17) ^ v2, rotate(v3, 21) ^ v0
            v2 = rotate(v2, 32)
        return v0, v1, v2, v3

    k0, k1 = struct.unpack('<QQ', key)
    start = struct.unpack('>4Q', b'somepseudorandomlygeneratedbytes')
    v = [word ^ half for word, half in zip(start, (k0, k1, k0, k1), strict=True)]
    padded = message + bytes(-(len(message) + 1) % 8) + bytes([len(message) % 256])
    for (word,) in struct.iter_unpack('<Q', padded):
        v[3] ^= word
        v = list(rounds(*v, 2))
        v[0] ^= word
    v[2] ^= 0xFF
    v0, v1, v2, v3 = rounds(*v, 4)
    return (v0 ^ v1 ^ v2 ^ v3).to_bytes(8, 'little')


# -- bytes ----------------------------------------------------------------------------------------


def test_the_crc_is_that_of_the_standard_library(library):
    assert library.t3_host_crc16(b'123456789', 9) == 0x29B1
    generator = random.Random(1)
    for size in range(79):
        data = generator.randbytes(size)
        assert library.t3_host_crc16(data, size) == crc_hqx(data, 0xFFFF)


def c_wire(library, frame):
    room = ctypes.create_string_buffer(82)
    size = library.t3_host_to_wire(frame, ctypes.c_uint8(len(frame)), room)
    return room.raw[:size]


def test_encoded_frames_equal_the_reference(library):
    generator = random.Random(2)
    for size in (*range(1, 79), *generator.choices(range(1, 79), k=2000)):
        frame = bytes(generator.choices((0, 1, 0xFF, generator.randrange(256)), k=size))
        assert c_wire(library, frame) == to_wire(frame)
    assert c_wire(library, b'') == c_wire(library, bytes(79)) == b''


class Splitter(Part):
    kind = 'splitter'

    def feed(self, data):
        found, room, size = [], ctypes.create_string_buffer(78), ctypes.c_uint8()
        while data:
            taken = self.call('feed', data, ctypes.c_uint32(len(data)), room, ctypes.byref(size))
            data = data[taken:]
            if size.value:
                found.append(room.raw[: size.value])
        return found

    def counts(self):
        three = (ctypes.c_uint16 * 3)()
        self.call('counts', three)
        return tuple(three)


def split(data):
    """Return the good frames in a stream, and (good, CRC errors, frame errors)."""
    found, crc_errors, frame_errors = [], 0, 0
    for piece in data.split(b'\0')[:-1]:
        if not piece:
            continue
        body = unstuff(piece) if len(piece) <= 81 else None
        if body is None or len(body) < 3:
            frame_errors += 1
        elif crc_hqx(body[:-2], 0xFFFF) != int.from_bytes(body[-2:], 'little'):
            crc_errors += 1
        else:
            found.append(body[:-2])
    return found, (len(found), crc_errors, frame_errors)


@pytest.mark.parametrize('seed', range(40))
def test_decoder_equals_the_reference_on_a_damaged_stream(library, seed):
    generator = random.Random(seed)
    stream = bytearray()
    for _ in range(300):
        wire = bytearray(to_wire(generator.randbytes(generator.randint(1, 78))))
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
    splitter = Splitter(library)
    found, counts = split(bytes(stream))
    assert splitter.feed(bytes(stream)) == found
    assert splitter.counts() == counts
    assert counts[0] > 100
    assert min(counts[1:]) > 10


def test_siphash_equals_published_vectors_and_reference(library):
    """The paper's appendix, and the first lines of its authors' ``vectors.h``."""
    key = bytes(range(16))
    room = ctypes.create_string_buffer(8)

    def hashed(key, message):
        library.t3_host_siphash(key, message, ctypes.c_uint8(len(message)), room)
        return room.raw

    assert hashed(key, bytes(range(15))) == (0xA129CA6149BE45E5).to_bytes(8, 'little')
    published = ('310e0edd47db6f72', 'fd67dc93c539f874', '5a4fa9d909806c0d', '2d7efbd796666785')
    for size, text in enumerate(published):
        assert hashed(key, bytes(range(size))).hex() == text
    generator = random.Random(3)
    for size in (*range(64), 255):
        key, message = generator.randbytes(16), generator.randbytes(size)
        assert hashed(key, message) == siphash(key, message)


def test_range_codes_equal_those_of_the_simulation(library):
    """Both ends of a simulation must see the same; an open or shorted wire is the board's own."""
    parameters = range_sensor.SimulatedRangeSensorParameters()
    for count in range(984):
        wanted = encode_range(
            range_sensor.distance_from_voltage(parameters.volts(count))
        )
        assert library.t3_host_range_code(count) == wanted, count
    assert {library.t3_host_range_code(count) for count in (984, 1023, 0xFFFE)} == {255}
    assert library.t3_host_range_code(0xFFFF) == 0


def test_clock_is_exact_around_a_timer_overflow(library):
    """A timer that wraps between the read of its count and of its flag must not lose 50 us."""
    for start in (0, 0xFFFFFFC8, 0x7FFFFFF0):
        for true in range(200):
            ticks, timer = divmod(true, 50)
            # The interrupt of the last tick may still wait while the timer is young, and the next
            # one may become due just after an old count was read.
            for waits in {False, timer < 25, timer == 49}:
                base = start + 50 * (ticks - (1 if waits and timer < 25 else 0))
                read = library.t3_host_time_us(
                    ctypes.c_uint32(base), ctypes.c_uint8(timer), ctypes.c_bool(waits)
                )
                assert read == (start + true) % (1 << 32)


# -- golden vectors -------------------------------------------------------------------------------


def c_decode(library, data):
    numbers = (ctypes.c_int64 * 11)()
    fault = library.t3_host_decode(data, ctypes.c_uint8(len(data)), numbers)
    return fault, dict(zip((*PACKET, 'nonce', 'tag'), numbers, strict=True))


def c_encode(library, kind, numbers, nonce=False):
    fields = (ctypes.c_int64 * 32)(*numbers)
    room = ctypes.create_string_buffer(32)
    size = library.t3_host_encode(ctypes.c_uint8(kind), fields, ctypes.c_bool(nonce), room)
    return room.raw[:size]


def test_first_golden_vectors_byte_for_byte(library):
    fault, packet = c_decode(library, COMMAND)
    assert fault == 0
    assert (packet['session'], packet['seq'], packet['what'], packet['ttl']) == (0x5A, 7, 1, 20)
    assert (packet['left'], packet['right']) == (5000, -2500)
    assert packet['host_us'] == 0x01020304
    numbers = (0x5A, 7, 3, 123456789, 1000, -1000, -131, 164, 0, 76)
    assert c_encode(library, 1, (*numbers, *bytes.fromhex('a0fe013c00145078'))) == STATE
    assert c_wire(library, bytes.fromhex('012a060e') + COMMAND + b'\x15\x5a\x07\0') == TX_WIRE


def test_transaction_with_the_golden_result(library):
    dongle = Dongle(library)
    dongle.run(123_456_000 - 3000)
    dongle.call('bytes', TX_WIRE, ctypes.c_uint32(len(TX_WIRE)))
    assert dongle.sent() == COMMAND
    dongle.run(1500)
    dongle.reply(bytes(32))
    dongle.run(1490)
    assert dongle.sent() == b''
    dongle.run(10)
    assert dongle.sent() == b'\x15\x5a\x07\0'
    assert dongle.read() == b''
    dongle.reply(STATE, retransmits=1)
    assert dongle.read() == RESULT_WIRE


@pytest.fixture(scope='module')
def golden():
    if not GOLDEN.exists():
        pytest.skip('test/golden/radio_vectors.json is not there')
    return json.loads(GOLDEN.read_text())


DOWN_NAMES = {'flags': 'what', 'id': 'what', 'verb': 'what'}


def test_golden_downlink_payloads_are_decoded(library, golden):
    for vector in golden['down']:
        data, fields = bytes.fromhex(vector['bytes']), vector['fields']
        fault, packet = c_decode(library, data)
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
        written = c_encode(library, kinds[vector['kind']], numbers, bool(fields.get('nonce')))
        assert written.hex() == vector['bytes'], vector['name']


def test_golden_malformed_frames_are_rejected(library, golden):
    faults = {'version': 1, 'kind': 1, 'length': 2, 'value': 2}
    for vector in golden['rejected']:
        data = bytes.fromhex(vector['bytes'])
        if vector['direction'] == 'down':
            assert c_decode(library, data)[0] == faults[vector['fault']], vector
        elif vector['direction'] == 'to_dongle' and data:
            dongle = Dongle(library)
            dongle.write(data)
            code = 1 if vector['fault'] == 'kind' else 2
            assert dongle.frames() == [bytes([0x8F, code, data[0]])], vector
            assert dongle.sent() == b''


def test_golden_encodings_parameters_and_hashes(library, golden):
    for vector in golden['wire']:
        assert c_wire(library, bytes.fromhex(vector['bytes'])).hex() == vector['wire']
    robot = Robot(library)
    robot.hello()
    for row in golden['constants']['parameters']:
        answer = robot.ask(bytes([0x12, SESSION, 0, row['id']]))
        value, low, high = struct.unpack_from('<iii', answer, 5)
        assert (answer[4], value, low, high) == (0, row['default'], row['low'], row['high'])
    room = ctypes.create_string_buffer(8)
    for size, tag in enumerate(golden['siphash']['tags']):
        library.t3_host_siphash(bytes(range(16)), bytes(range(size)), ctypes.c_uint8(size), room)
        assert room.raw.hex() == tag


def test_golden_session_of_a_keyed_robot(library, golden):
    story = golden['authentication']
    robot = Robot(library, bytes.fromhex(story['key']))
    robot.run(1000)
    refused = 0
    for event in story['robot']:
        if 'fresh_nonce' in event:
            robot.call('force_nonce', bytes.fromhex(event['fresh_nonce']))
        data = bytes.fromhex(event['bytes'])
        robot.send(data)
        stops = event['kind'] == 'Command' and data[3] & ESTOP
        refused += (
            not event['accepted']
            or (stops and len(data) == 14)
            or (stops and 'bad tag' in event['name'])
        )
        assert robot.counters()['bad_session'] == refused, event['name']
        info = robot.ask(b'\x15\0\0\2')
        assert info[1] == event['session'], event['name']
        assert info[17:].hex() == event['robot_nonce'], event['name']


def test_golden_emergency_stops_are_counted(library, golden):
    story = golden['authentication']['stops']
    robot = Robot(library, bytes.fromhex(golden['authentication']['key']))
    robot.run(1000)
    robot.call('force_nonce', bytes.fromhex(story['fresh_nonce']))
    robot.send(bytes.fromhex(story['hello']))
    refused = 0
    for row in story['frames']:
        data = bytes.fromhex(row['bytes'])
        robot.send(data)
        refused += not row['counted']
        assert robot.counters()['bad_session'] == refused, row['name']
        assert robot.status & LATCHED
        if row['counted']:
            assert robot.ask(b'\x15\0\0\0')[2] == data[2], row['name']
    assert 0 < refused < len(story['frames'])


def test_golden_console_frames(library, golden):
    for vector in golden['to_board']:
        robot = Robot(library)
        robot.run(1000)
        (told,) = robot.cable(bytes.fromhex(vector['bytes']))
        frame = bytes.fromhex(vector['bytes'])
        assert c_wire(library, frame).hex() == vector['wire']
        if frame[0] == 3:
            assert told[:6] == b'\x83' + frame[1:]
        else:
            assert told[:3] == bytes([0x84, frame[1], OK])
    for row in golden['key_checks']:
        robot = Robot(library, bytes.fromhex(row['key']))
        assert robot.cable(b'\x04\x09') == [b'\x84\x09\0\1' + struct.pack('<I', row['check'])]
    for vector in golden['rejected']:
        data = bytes.fromhex(vector['bytes'])
        if vector['direction'] == 'to_board':
            code = 1 if vector['fault'] == 'kind' else 2
            assert Robot(library).cable(data) == [bytes([0x8F, code, data[0]])], vector


# -- when the robot moves -------------------------------------------------------------------------


def test_nothing_moves_before_hello_and_enable(library):
    robot = Robot(library)
    assert not robot.call('powered')
    for session in range(256):
        robot.drive(5000, 5000, 20_000, session=session)
    assert robot.status & NO_SESSION
    robot.hello()
    robot.drive(5000, 5000, 500_000, flags=0)
    assert robot.status == 0
    assert not robot.call('powered')
    assert robot.pulses == (0, 0)
    robot.drive(5000, 5000, 500_000)
    assert robot.status == ENABLED | MOVING
    assert robot.speeds == (5.0, 5.0)
    assert robot.pulses[0] > 500


def test_hello_starts_a_session_at_rest_and_keeps_the_counters(robot):
    robot.drive(5000, 5000, 500_000)
    steps = robot.steps
    info = robot.hello(session=77)
    assert (info[0], info[1], info[3], info[7]) == (0x13, 77, 1, 10)
    assert struct.unpack_from('<HH', info, 8) == (200, 16)
    robot.run(300_000)
    assert robot.status == 0
    assert not robot.call('powered')
    assert robot.steps > steps
    robot.drive(5000, 5000, 100_000, session=SESSION)
    assert robot.speeds == (0.0, 0.0)


def test_ttl_expiry_ramps_down_and_sets_the_flag(gentle):
    gentle.drive(4500, 4500, 1_000_000)
    gentle.send(gentle.command(4500, 4500, ttl=20))
    gentle.run(199_000)
    assert gentle.speeds == (4.5, 4.5)
    assert gentle.status == ENABLED | MOVING
    gentle.run(2_000)
    assert gentle.status == ENABLED | MOVING | EXPIRED
    gentle.run(74_000)
    # Half of 4.5 rad/s at 30 rad/s²
    assert gentle.speeds == pytest.approx((2.25, 2.25), abs=0.07)
    gentle.run(76_500)
    assert gentle.speeds == (0.0, 0.0)
    assert gentle.status == ENABLED | EXPIRED
    assert gentle.call('powered')  # holds its place
    assert gentle.counters()['expired'] == 1
    gentle.drive(1000, 1000, 20_000)
    assert gentle.status == ENABLED | MOVING


def rest_time(robot, ttl):
    """Return how long (s) after the last command at full speed the wheels still turn."""
    robot.drive(10_000, 10_000, 2_000_000)
    robot.send(robot.command(10_000, 10_000, ttl=ttl))
    assert robot.speeds == (10.0, 10.0)
    elapsed = 0
    while robot.status & MOVING:
        robot.run(1000)
        elapsed += 1000
    return elapsed / 1e6


@pytest.mark.parametrize(
    'ttl, deceleration, limit',
    [
        (20, 60_000, 0.37),
        (255, 60_000, 0.42),
        (20, 41_000, 0.45),
        (255, 52_000, 0.45),
        (20, 30_000, 0.536),
    ],
)
def test_stop_time_is_ttl_plus_ramp(robot, ttl, deceleration, limit):
    """TTL + speed / deceleration: the first line is the default of both ends.

    Within 0.45 s of the last command takes 41 rad/s² at a TTL of 200 ms, and 52 at the longest
    the robot allows.
    """
    assert robot.get(DECELERATION) == (OK, 60_000)
    assert robot.set(DECELERATION, deceleration) == (OK, deceleration)
    assert limit - 0.01 < rest_time(robot, ttl) <= limit


def test_the_robot_limits_the_ttl(robot):
    robot.send(robot.command(1000, 1000, ttl=255))
    robot.run(249_000)
    assert not robot.status & EXPIRED
    robot.run(2_000)
    assert robot.status & EXPIRED


def test_a_ttl_of_zero_stops_without_the_expiry_flag(robot):
    robot.drive(5000, 5000, 500_000)
    robot.drive(5000, 5000, 500_000, ttl=0)
    assert robot.status == ENABLED
    assert robot.counters()['expired'] == 0


def test_only_newer_sequence_numbers_count(robot):
    """(int8)(seq - last) > 0, for every last one and every difference."""
    for last in (0, 1, 127, 128, 254, 255):
        for difference in range(256):
            robot.hello()
            robot.send(robot.command(0, 0, seq=last))
            before = robot.counters()['duplicates']
            robot.send(robot.command(3000, 3000, seq=(last + difference) % 256))
            robot.run(2000)
            moved = bool(robot.status & MOVING)
            assert moved == (1 <= difference <= 127), (last, difference)
            assert robot.counters()['duplicates'] - before == (not moved)


def test_a_repeated_command_does_not_extend_its_ttl(robot):
    frame = robot.command(3000, 3000, seq=9)
    for _ in range(30):
        robot.send(frame)
        robot.run(10_000)
    assert robot.status & EXPIRED


def test_frames_of_another_session_are_counted_and_ignored(robot):
    for session in set(range(256)) - {SESSION}:
        robot.drive(5000, 5000, 20_000, session=session)
    assert robot.pulses == (0, 0)
    assert robot.counters()['bad_session'] == 255
    assert robot.ask(struct.pack('<BBBBi', 0x13, 3, 9, MAX_SPEED, 1))[0] == 0x11
    assert robot.get(MAX_SPEED) == (OK, 10_000)


@pytest.mark.parametrize('session', [0, 1, SESSION, 255])
@pytest.mark.parametrize('flags', [ESTOP, ESTOP | ENABLE, ESTOP | CLEAR, 7, 0xFF])
def test_an_emergency_stop_is_accepted_from_any_sender(robot, session, flags):
    robot.drive(5000, 5000, 500_000)
    robot.send(robot.command(5000, 5000, flags, seq=0, session=session, host_us=0))
    robot.run(1000)
    assert robot.status & LATCHED
    robot.drive(5000, 5000, 400_000)
    assert robot.status == LATCHED
    assert robot.speeds == (0.0, 0.0)
    robot.hello(session=5)
    robot.drive(5000, 5000, 100_000, session=5)
    assert robot.status == LATCHED


def test_only_a_valid_clear_of_the_session_clears_the_estop(robot):
    robot.send(robot.command(flags=ESTOP))
    for refused in (
        {'flags': 0},
        {'flags': CLEAR | ENABLE},
        {'flags': CLEAR | ESTOP},
        {'flags': CLEAR, 'left': 1},
        {'flags': CLEAR, 'right': -1},
        {'flags': CLEAR, 'session': 3},
        {'flags': CLEAR, 'seq': robot.seq},
        {'flags': CLEAR, 'host_us': (robot.host_us - 1_000_000) % (1 << 32)},
    ):
        robot.send(robot.command(**refused))
        robot.run(20_000)
        assert robot.status & LATCHED, refused
    robot.call('press', ctypes.c_bool(True))
    robot.send(robot.command(flags=CLEAR))
    assert robot.status & LATCHED
    robot.call('press', ctypes.c_bool(False))
    robot.send(robot.command(flags=CLEAR))
    assert robot.status == 0
    robot.drive(1000, 1000, 200_000)
    assert robot.status == ENABLED | MOVING


def test_the_button_latches_after_the_shortest_press(robot):
    robot.drive(5000, 5000, 500_000)
    robot.call('press', ctypes.c_bool(True))
    robot.run(200)
    robot.call('press', ctypes.c_bool(False))
    robot.drive(5000, 5000, 500_000)
    assert robot.status == LATCHED
    assert not robot.call('powered')


# -- commands that come late ----------------------------------------------------------------------


@pytest.mark.parametrize('silence', [1.0, 6.0, 15.0, 100.0, 1500.0])
def test_commands_held_and_released_at_once_are_rejected(robot, silence):
    """A stalled USB hub holds 15 commands and then lets them all go.

    Forgetting the ordinary delay after two windows would take the burst of a long hold for it.
    """
    robot.drive(0, 0, 500_000)
    held = [
        robot.command(5000, 5000, host_us=(robot.now + 20_000 * i) % (1 << 32)) for i in range(15)
    ]
    robot.run(round(silence * 1e6))
    for frame in held:
        robot.send(frame)
        robot.run(500)
    assert robot.counters()['stale'] == 15
    assert robot.pulses == (0, 0)
    robot.drive(5000, 5000, 40_000)
    assert robot.status & MOVING


@pytest.mark.parametrize('skew', [-0.005, 0.005])
@pytest.mark.parametrize('start', [0, (1 << 32) - 30_000_000])
def test_a_clock_error_of_half_a_percent_is_not_stale(library, skew, start):
    robot = Robot(library, time=start)
    generator = random.Random(4)
    robot.travel = 0
    robot.run(1000)
    robot.hello()
    for index in range(3000):
        stamp = round((1.0 + skew) * 20_000 * index) + start
        late = generator.randrange(5000)
        robot.run(late)
        robot.send(robot.command(100, 100, host_us=stamp % (1 << 32)))
        robot.run(20_000 - late)
    assert robot.counters()['stale'] == 0
    assert robot.status == ENABLED | MOVING


def test_a_silence_of_a_minute_is_not_stale(library):
    """Clocks drift apart meanwhile: 0.3 s within a minute at 0.5 %."""
    for skew in (-0.005, 0.005):
        robot = Robot(library)
        robot.travel = 0
        robot.run(1000)
        robot.hello()
        for second in (0, 1, 61, 62, 63, 70):
            robot.run(second * 1_000_000 - robot.now + 2000)
            robot.send(robot.command(100, 100, host_us=round(second * 1e6 * (1 + skew))))
        assert robot.counters()['stale'] == 0


def test_a_growing_delay_is_detected_beyond_ttl_and_slack(robot):
    start, delays = robot.now, []
    for index in range(200):
        robot.run(22_000)
        sent = 20_000 * index
        robot.travel = robot.now - start - sent  # grows by 100 ms in a second of the host's
        before = robot.counters()['stale']
        robot.send(robot.command(1000, 1000))
        if robot.counters()['stale'] > before:
            delays.append(robot.travel)
    # 200 ms of TTL and 50 of slack beyond the delay of the HELLO, found by the next command
    assert 250_000 < delays[0] - 1000 <= 255_000
    assert len(delays) > 50  # and stays found
    robot.run(250_000)
    assert robot.speeds == (0.0, 0.0)


def test_a_stale_stop_still_stops(robot):
    robot.drive(5000, 5000, 500_000)
    robot.travel = 400_000
    robot.send(robot.command(0, 0))
    assert robot.counters()['stale'] == 1
    robot.run(170_000)
    assert robot.speeds == (0.0, 0.0)


def test_a_session_ends_after_half_an_hour_of_silence(robot):
    """Beyond 35 minutes a delay of 32-bit clocks has no sign: nothing may be judged by it."""
    robot.drive(1000, 1000, 100_000)
    robot.run(1_799_000_000)
    assert not robot.status & NO_SESSION
    robot.run(2_000_000)
    assert robot.status == NO_SESSION | EXPIRED
    robot.drive(1000, 1000, 100_000)
    assert robot.status == NO_SESSION | EXPIRED
    robot.hello()
    assert robot.status == 0


# -- wheels ---------------------------------------------------------------------------------------


def test_wheel_speed_is_exact_at_10_rad_per_s(robot):
    robot.drive(10_000, -10_000, 1_000_000)
    before = robot.pulses
    robot.drive(10_000, -10_000, 10_000_000)
    left, right = (
        (after - earlier) * STEP / 10.0
        for earlier, after in zip(before, robot.pulses, strict=True)
    )
    assert left == pytest.approx(10.0, abs=0.0003)
    assert right == pytest.approx(-10.0, abs=0.0003)
    assert robot.steps == robot.pulses


def test_wheel_speed_is_exact_at_low_speed(robot):
    robot.drive(1, -3, 100_000)
    before = robot.pulses
    robot.drive(1, -3, 100_000_000)
    assert [after - earlier for earlier, after in zip(before, robot.pulses, strict=True)] == [
        pytest.approx(0.1 / STEP, abs=1),
        pytest.approx(-0.3 / STEP, abs=1),
    ]


def test_speed_crosses_zero_without_a_jump(robot):
    """The counter follows the integral of the speed to a step, through every change of sign."""
    place = 0.0
    for index in range(1500):
        wanted = 300.0 * math.sin(math.tau * index / 300.0)
        robot.send(robot.command(wanted, -wanted))
        for _ in range(20):
            place += robot.speeds[0] * 1e-3
            robot.run(1000)
        assert abs(robot.steps[0] - place / STEP) <= 2.0, index
    assert robot.steps == robot.pulses
    assert max(robot.pulses) - min(robot.pulses) < 3
    assert robot.call('hasty_pulses') == 0  # DIR is settled before every STEP


def test_step_rate_is_limited_to_10_000_per_second(robot):
    assert robot.set(MAX_SPEED, 19_600) == (OK, 19_600)
    robot.drive(32_767, -32_768, 2_000_000)
    assert robot.status & LIMITED
    before = robot.pulses
    robot.drive(32_767, -32_768, 1_000_000)
    rates = [after - earlier for earlier, after in zip(before, robot.pulses, strict=True)]
    assert rates == [pytest.approx(9982, abs=2), pytest.approx(-9982, abs=2)]
    assert robot.call('closest_pulses') >= 100


@pytest.mark.parametrize('microsteps', [1, 8, 32, 256])
def test_microsteps_take_effect_at_boot_and_keep_the_speed(library, microsteps):
    robot = Robot(library)
    robot.hello()
    assert robot.set(MICROSTEPS, microsteps) == (OK, microsteps)
    assert robot.set(MICROSTEPS, microsteps) == (OK, microsteps)
    assert robot.call('eeprom_writes') == 1
    assert struct.unpack_from('<H', robot.ask(b'\x15\0\0\2'), 10) == (16,)
    robot.call('boot', 1, 0)
    info = robot.hello()
    assert info[6] == 1
    assert struct.unpack_from('<H', info, 10) == (microsteps,)
    robot.drive(10_000, 5_000, 1_000_000)
    before = robot.pulses
    robot.drive(10_000, 5_000, 1_000_000)
    rates = [after - earlier for earlier, after in zip(before, robot.pulses, strict=True)]
    wanted = min(10.0 * 200 * microsteps / math.tau, 10_000.0)
    assert rates == [pytest.approx(wanted, abs=20), pytest.approx(wanted / 2, abs=10)]
    assert rates[0] <= 10_000
    assert bool(robot.status & LIMITED) == (microsteps > 31)


@pytest.mark.parametrize(
    'inverted, signs', [(0, (1, 1)), (1, (-1, 1)), (2, (1, -1)), (3, (-1, -1))]
)
def test_an_inverted_wheel_turns_backwards_and_counts_forwards(robot, inverted, signs):
    assert robot.set(INVERT, inverted) == (OK, inverted)
    robot.drive(3000, 2000, 500_000)
    assert min(robot.steps) > 100
    assert robot.pulses == tuple(
        sign * count for sign, count in zip(signs, robot.steps, strict=True)
    )


@pytest.mark.parametrize(
    'left, right', [(10_000, 3_000), (-2_000, 9_000), (5_000, -5_000), (7_000, 10)]
)
def test_one_factor_keeps_the_curvature_in_every_ramp(gentle, left, right):
    def check():
        speeds = gentle.speeds
        assert speeds[0] * right == pytest.approx(speeds[1] * left, abs=2.0)
        return speeds

    for _ in range(60):
        gentle.drive(left, right, 20_000, period=5_000)
        check()
    gentle.run(200_000)
    rates = []
    while gentle.status & MOVING:
        before = max(map(abs, check()))
        gentle.run(10_000)
        rates.append(before - max(map(abs, gentle.speeds)))
    # 30 rad/s² for the faster wheel, to the last step but one
    assert rates[2:-1] == [pytest.approx(0.3, abs=0.01)] * len(rates[2:-1])


def test_acceleration_and_deceleration_rates_differ(gentle):
    gentle.drive(1000, 1000, 200_000)
    start = gentle.speeds[0]
    gentle.drive(9000, 9000, 100_000)
    assert gentle.speeds[0] - start == pytest.approx(1.5, abs=0.03)
    gentle.drive(9000, 9000, 1_000_000)
    gentle.drive(1000, 1000, 100_000)
    assert gentle.speeds[0] == pytest.approx(6.0, abs=0.05)
    # Through zero: down fast, then up gently.
    gentle.drive(3000, 3000, 1_000_000)
    gentle.drive(-3000, -3000, 200_000)
    assert gentle.speeds[0] == pytest.approx(-1.5, abs=0.05)


def test_opposite_speed_changes_use_the_smaller_rate(gentle):
    gentle.drive(1000, 9000, 1_000_000)
    gentle.drive(9000, 1000, 100_000)
    assert gentle.speeds == pytest.approx((2.5, 7.5), abs=0.03)
    assert gentle.set(DECELERATION, 5000) == (OK, 5000)
    gentle.drive(1000, 9000, 2_000_000)
    gentle.drive(9000, 1000, 100_000)
    assert gentle.speeds == pytest.approx((1.5, 8.5), abs=0.03)


def test_a_stalled_main_loop_causes_no_speed_jump(gentle):
    gentle.drive(9000, 9000, 1_000_000)
    gentle.send(gentle.command(0, 0))
    gentle.run(2000)
    before = gentle.speeds[0]
    gentle.call('stall', ctypes.c_uint32(500_000))
    gentle.run(400)
    assert 0.0 < before - gentle.speeds[0] <= 0.61  # 20 ms at 30 rad/s²
    assert gentle.status == ENABLED | MOVING | EXPIRED


def test_a_command_beyond_the_limit_is_scaled_as_a_whole(robot):
    assert robot.set(MAX_SPEED, 4000) == (OK, 4000)
    robot.drive(8000, -2000, 1_000_000)
    assert robot.speeds == (4.0, -1.0)
    assert robot.status & LIMITED
    robot.drive(4000, -1000, 20_000)
    assert not robot.status & LIMITED
    assert robot.set(MAX_SPEED, 0) == (OK, 0)
    robot.drive(8000, -2000, 1_000_000)
    assert robot.speeds == (0.0, 0.0)


def test_drivers_switch_off_when_idle_and_on_before_a_step(robot):
    assert robot.set(IDLE_OFF, 1000) == (OK, 1000)
    robot.drive(1000, 1000, 500_000)
    robot.drive(0, 0, 900_000)
    assert robot.call('powered')
    robot.drive(0, 0, 300_000)
    assert not robot.call('powered')
    robot.drive(1000, 1000, 100_000)
    assert robot.call('powered')
    assert robot.call('unpowered_pulses') == 0


def test_clock_wrap_after_hours_at_rest_has_no_effect(robot):
    """2**32 us later an old time looks like now: to drivers at rest, to the age of a command."""
    assert robot.set(IDLE_OFF, 1000) == (OK, 1000)
    robot.send(robot.command(0, 0))
    sent = 1 << 32
    for _ in range(4):
        robot.run(1_000_000_000)
        sent -= 1_000_000_000
        assert robot.get(MAX_SPEED)[0] == OK  # the host is still there
        sent -= 1000
    robot.run(sent - 300_000)
    for _ in range(20):
        robot.run(100_000)
        assert not robot.call('powered')
        assert robot.answer()[22:24] == b'\xff\xff'
    assert robot.status == ENABLED | EXPIRED


def test_drivers_keep_their_power_until_a_ramp_has_ended(gentle):
    gentle.drive(9000, 9000, 1_000_000)
    gentle.send(gentle.command(9000, 9000, flags=0))
    gentle.run(250_000)
    assert gentle.call('powered')
    gentle.run(60_000)
    assert not gentle.call('powered')
    assert gentle.steps == gentle.pulses


# -- wraps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize('before', [1000, 50_000, 150_000, 210_000, 350_000])
@pytest.mark.parametrize('wrap', [1 << 15, 1 << 16, 1 << 31, 1 << 32])
def test_clock_wrap_of_any_width_has_no_effect(robot, wrap, before):
    """A 16-bit count of overflows made the proof's clock wrap at 35.8 minutes."""
    robot.drive(5000, 5000, 500_000)
    robot.poke(wrap - before)
    robot.send(robot.command(5000, 5000))
    robot.run(190_000)
    assert robot.status == ENABLED | MOVING
    assert robot.speeds == (5.0, 5.0)
    robot.run(190_000)
    assert robot.status == ENABLED | EXPIRED
    assert robot.steps == robot.pulses
    assert robot.counters()['stale'] == 0
    robot.drive(5000, 5000, 100_000)
    assert robot.status == ENABLED | MOVING


def test_driving_for_more_than_71_minutes(robot):
    for _ in range(4400):
        robot.drive(100, 100, 1_000_000, period=200_000, ttl=25)
    assert robot.now < 200_000_000
    assert robot.status == ENABLED | MOVING
    counters = robot.counters()
    assert (counters['stale'], counters['expired']) == (0, 0)
    assert robot.steps == robot.pulses
    assert robot.steps[0] * STEP == pytest.approx(440.0, abs=0.1)


def test_counters_wrap_at_32_bits(robot):
    robot.call('poke_steps', 0, (1 << 31) - 3)
    robot.call('poke_steps', 1, -(1 << 31) + 3)
    robot.drive(1000, -1000, 200_000)
    state = robot.ask(b'\x15\0\0\0')
    left, right = struct.unpack_from('<ii', state, 8)
    assert -(1 << 31) <= left < -(1 << 31) + 200
    assert (1 << 31) - 200 < right < 1 << 31


def test_extreme_speeds_are_scaled(robot):
    for left, right in ((-32_768, 32_767), (32_767, -32_768), (-32_768, -32_768), (0, -32_768)):
        robot.drive(left, right, 1_500_000)
        scale = 10.0 / 32_768
        assert robot.speeds == pytest.approx((left * scale, right * scale), abs=0.002)


# -- parameters, actions, answers -----------------------------------------------------------------

BOUNDS = {
    MAX_SPEED: (0, 19_600),
    ACCELERATION: (100, 100_000),
    DECELERATION: (100, 200_000),
    TTL_MAX: (20, 500),
    MICROSTEPS: (1, 256),
    BATTERY_LOW: (0, 30_000),
    IDLE_OFF: (0, 600_000),
    INVERT: (0, 3),
}


@pytest.mark.parametrize('number', BOUNDS)
def test_parameters_keep_their_bounds(robot, number):
    low, high = BOUNDS[number]
    assert robot.set(number, low) == (OK, low)
    assert robot.set(number, high) == (OK, high)
    for value in (low - 1, high + 1, -(1 << 31), (1 << 31) - 1):
        assert robot.set(number, value) == (RANGE, high)
    assert robot.get(number) == (OK, high)
    answer = robot.ask(bytes([0x12, SESSION, 44, number]))
    assert answer[2] == 44
    assert struct.unpack_from('<ii', answer, 9) == (low, high)


def test_read_only_and_unknown_parameters_are_rejected(robot):
    assert robot.set(STEPS_PER_REV, 400) == (READ_ONLY, 200)
    assert robot.set(GYRO_RANGE, 250) == (READ_ONLY, 500)
    for number in (10, 11, 128, 255):
        assert robot.set(number, 1) == (UNKNOWN, 0)
        assert robot.get(number) == (UNKNOWN, 0)


@pytest.mark.parametrize('number', [MICROSTEPS, INVERT])
def test_microsteps_and_direction_change_only_at_rest(robot, number):
    before = robot.get(number)[1]
    robot.drive(1000, 1000, 100_000)
    assert robot.set(number, 2) == (BUSY, before)
    assert robot.set(number, before) == (OK, before)  # the host's settings after a reconnection
    robot.drive(0, 0, 300_000)
    assert robot.set(number, 2) == (OK, 2)


def test_boot_restores_the_parameter_defaults(robot):
    assert robot.set(MAX_SPEED, 123) == (OK, 123)
    robot.call('boot', 1, 0)
    robot.hello()
    assert robot.get(MAX_SPEED) == (OK, 10_000)


def test_odometry_is_reset_only_at_rest(robot):
    robot.drive(1000, 1000, 500_000)
    assert robot.act(1, seq=1) == bytes([0x14, SESSION, 1, 1, BUSY])
    robot.drive(0, 0, 300_000)
    assert min(robot.steps) > 100
    assert robot.act(1, seq=2) == bytes([0x14, SESSION, 2, 1, OK])
    assert robot.steps == (0, 0)
    assert robot.act(3, seq=3) == bytes([0x14, SESSION, 3, 3, UNKNOWN])


def test_a_repeated_action_is_acknowledged_but_runs_once(robot):
    """The answer was lost, the host asks again, and the robot has moved meanwhile."""
    assert robot.act(1, seq=7)[4] == OK
    robot.drive(1000, 1000, 500_000)
    robot.drive(0, 0, 300_000)
    steps = robot.steps
    assert robot.act(1, seq=7)[4] == OK
    assert robot.steps == steps
    assert robot.act(1, seq=8)[4] == OK
    assert robot.steps == (0, 0)


def test_counters_are_cleared_by_the_action(robot):
    robot.send(robot.command(session=3))
    assert robot.counters()['bad_session'] == 1
    assert robot.act(2, seq=1)[4] == OK
    assert set(robot.counters().values()) == {0, 1}


def test_reply_to_each_kind_of_packet(robot):
    kinds = {
        'CMD': (robot.command(), 0x11),
        'PARAM_GET': (bytes([0x12, SESSION, 1, 0]), 0x12),
        'PARAM_SET': (struct.pack('<BBBBi', 0x13, SESSION, 1, 0, 1), 0x12),
        'POLL state': (b'\x15\0\1\0', 0x11),
        'POLL aux': (b'\x15\0\1\1', 0x15),
        'POLL info': (b'\x15\0\1\2', 0x13),
        'ACTION': (struct.pack('<BBBBH', 0x16, SESSION, 1, 2, 0), 0x14),
        'HELLO': (struct.pack('<BBBBI', 0x14, SESSION, 1, 0, robot.host_us), 0x13),
        'other session': (bytes([0x12, 3, 1, 0]), 0x11),
        'other version': (b'\x25\0\1\1', 0x11),
        'nothing': (b'', 0x11),
    }
    for name, (data, head) in kinds.items():
        answer = robot.ask(data)
        assert answer[0] == head, name
        if name in ('CMD', 'PARAM_GET', 'PARAM_SET', 'POLL info', 'ACTION', 'HELLO'):
            assert answer[1] == SESSION
    assert len(robot.answer()) == 32


def test_a_reply_is_loaded_after_the_acknowledgement_is_sent(robot):
    robot.run(5000)
    loads = robot.call('loads')
    robot.send(robot.command())
    robot.run(500)
    assert robot.call('loads') == loads
    robot.run(400)
    assert robot.call('loads') == loads + 1
    state = robot.answer()
    # Sampled after the settling time, and it says how long after the command.
    assert 60 <= struct.unpack_from('<H', state, 22)[0] <= 90
    robot.run(99_000)
    assert robot.call('loads') == loads + 1
    robot.run(2_000)
    assert robot.call('loads') == loads + 2


def test_the_age_is_none_when_it_does_not_fit(robot):
    assert robot.ask(b'\x15\0\0\0')[22:24] == b'\xff\xff'
    robot.send(robot.command())
    robot.run(600_000)
    assert struct.unpack_from('<H', robot.ask(b'\x15\0\0\0'), 22)[0] == pytest.approx(
        60_080, abs=40
    )
    robot.run(60_000)
    assert robot.ask(b'\x15\0\0\0')[22:24] == b'\xff\xff'


def test_state_contains_the_sensor_readings(robot):
    seven = (ctypes.c_int16 * 7)(164, -5, 8192, -4000, -12, 13, -131)
    robot.call('set_imu', ctypes.c_bool(True), seven)
    for channel, count in enumerate((0xFFFF, 0xFFFE, 300, 150, 600, 60, 0, 1023)):
        robot.call('set_adc', channel, ctypes.c_uint16(count))
    robot.run(10_000)  # one of them is read every millisecond
    state = robot.ask(b'\x15\0\0\0')
    assert struct.unpack_from('<hhh', state, 16) == (-131, 164, -5)
    parameters = range_sensor.SimulatedRangeSensorParameters()
    middle = [
        encode_range(range_sensor.distance_from_voltage(parameters.volts(count)))
        for count in (300, 150)
    ]
    assert list(state[24:]) == [0, 255, *middle, 1, 254, 254, 255]
    robot.call('set_adc', 8, ctypes.c_uint16(522))
    aux = robot.ask(b'\x15\0\0\1')
    assert struct.unpack_from('<Hhhhh', aux, 4) == (10_195, -4000, 8192, -12, 13)
    assert robot.status & LOW_BATTERY
    assert robot.set(BATTERY_LOW, 10_000)[0] == OK
    assert not robot.status & LOW_BATTERY
    robot.call('set_imu', ctypes.c_bool(False), seven)
    state = robot.ask(b'\x15\0\0\0')
    assert state[3] & IMU_FAULT
    assert state[16:22] == bytes(6)


def test_an_oversized_payload_is_ignored(robot):
    """Some nRF24 report widths over 32 when a packet is crafted so."""
    for size in range(33, 256):
        robot.send((robot.command(5000, 5000, ESTOP) + bytes(300))[:size])
    robot.run(20_000)
    assert robot.status == 0
    assert robot.counters()['short'] == 223


def test_malformed_packets_are_ignored_and_counted_by_kind(robot):
    good = robot.command(5000, 5000)
    for size in range(32):
        if size not in (14, 22):
            robot.send((good + bytes(32))[:size])
    for version in (0, 2, 15):
        robot.send(bytes([version << 4 | 1]) + good[1:])
    for kind in (0, *range(7, 16)):
        robot.send(bytes([0x10 | kind]) + good[1:])
    robot.send(good[:3] + b'\x09' + good[4:])
    robot.send(good[:5] + b'\x01' + good[6:])
    counters = robot.counters()
    assert counters['short'] == 30 + 2
    assert counters['bad_version'] == 13
    robot.run(20_000)
    assert robot.status == 0


# -- signed sessions ------------------------------------------------------------------------------


def test_a_key_at_one_end_only_is_rejected_and_reported(library, robot, keyed):
    refused = struct.pack('<BBBBI', 0x14, 7, 0, 0, 0)
    info = keyed.ask(refused)
    assert (info[0], info[1], len(info)) == (0x13, SESSION, 25)
    signed = struct.pack('<BBBBI', 0x14, 7, 0, 1, 0) + bytes(8)
    info = robot.ask(signed + siphash(KEY, signed))
    assert (info[0], info[1], len(info)) == (0x13, SESSION, 17)
    assert keyed.counters()['bad_session'] == robot.counters()['bad_session'] == 1
    keyed.session_key = b''
    keyed.drive(5000, 5000, 100_000)
    assert keyed.status == 0
    robot.send(robot.command(5000, 5000) + bytes(8))
    robot.run(10_000)
    assert robot.status == 0


def test_a_signed_session_drives_and_writes_parameters(keyed):
    keyed.drive(5000, 5000, 1_000_000)
    assert keyed.status == ENABLED | MOVING
    keyed.run(20_000)
    assert keyed.set(MAX_SPEED, 3000) == (OK, 3000)
    keyed.run(20_000)
    assert keyed.act(2, seq=1)[4] == OK
    keyed.drive(5000, 5000, 500_000)
    assert keyed.speeds == (3.0, 3.0)
    assert keyed.counters()['bad_session'] == 0


def test_a_new_hello_draws_a_nonce_and_a_repeated_one_does_not(keyed):
    first = keyed.hello()
    keyed.drive(5000, 5000, 500_000)
    assert keyed.hello()[17:] == first[17:]
    assert keyed.status == ENABLED | MOVING
    keyed.drive(5000, 5000, 100_000)
    assert keyed.status == ENABLED | MOVING
    seen = {first[17:]}
    for index in range(200):
        seen.add(keyed.hello(nonce=index.to_bytes(8, 'big'))[17:])
        if index % 20 == 0:
            keyed.call('boot', 1, 0)  # the same time, and none of what it knew
    assert len(seen) == 201


def test_a_damaged_key_locks_the_robot(library):
    for address in range(8, 26):
        robot = Robot(library, KEY)
        robot.call('poke_eeprom', ctypes.c_uint8(address), ctypes.c_uint8(0x55))
        robot.call('boot', 1, 0)
        info = robot.hello()
        assert (info[1], len(info)) == (0, 25)
        robot.key, robot.session_key = b'', b''
        assert robot.hello()[1] == 0
        robot.drive(5000, 5000, 100_000)
        assert robot.status == NO_SESSION


def test_a_key_can_be_removed(library):
    robot = Robot(library, KEY)
    robot.call('store_key', None)
    robot.call('boot', 1, 0)
    robot.key = b''
    assert robot.hello()[1] == SESSION


def test_signed_clock_may_wrap_but_not_decrease(library):
    robot = Robot(library, KEY)
    robot.run(1000)
    robot.travel = robot.now + 5_000_000  # the host's clock wraps 5 s from now
    robot.hello()
    accepted = []
    for index in range(500):
        robot.run(20_000)
        epoch = int(index * 20_000 + 21_000 > 5_000_000)
        accepted.append(robot.command(1000, 1000, epoch=epoch))
        robot.send(accepted[-1])
    assert robot.counters()['bad_session'] == 0
    assert robot.status == ENABLED | MOVING
    for frame in accepted:
        robot.send(frame)
    assert robot.counters()['bad_session'] == 500


def damage(generator, recorded):
    """Return a recorded frame, replayed, forged or altered."""
    frame = bytearray(generator.choice(recorded))
    match generator.randrange(6):
        case 0:
            pass
        case 1 | 2:
            for _ in range(generator.choice((1, 1, 1, 2, 3))):
                bit = generator.randrange(8 * len(frame))
                frame[bit // 8] ^= 1 << bit % 8
        case 3:
            frame[-8:] = generator.randbytes(8)
        case 4:
            frame[2] = generator.randrange(256)
            frame[-8:] = generator.choice(recorded)[-8:]
        case 5:
            if len(frame) == 22:
                frame[10:14] = generator.randbytes(4)
            else:
                frame[-12:-8] = generator.randbytes(4)
    return bytes(frame)


def test_no_forged_replayed_or_altered_frame_is_executed(library):
    """100 000 tries of somebody who has heard two sessions, but not the key.

    Stopping is always allowed, so a bit that makes a frame an emergency stop is honoured; but that
    one stays until a good frame clears it.
    """
    generator = random.Random(5)
    robot = Robot(library, KEY)
    robot.run(1000)
    recorded = []
    for nonce in (bytes(8), bytes(range(8))):
        robot.hello(nonce=nonce)
        for index in range(100):
            robot.run(20_000)
            if index % 10 == 9:
                body = struct.pack('<BBBBiI', 0x13, SESSION, 9, 0, 5000 + index, robot.host_us)
            else:
                body = None
            frame = robot.sign(body) if body else robot.command(3000, -3000)
            robot.send(frame)
            recorded.append(frame)
    assert robot.get(MAX_SPEED) == (OK, 5099)
    robot.send(robot.command(0, 0, flags=0))
    robot.run(1_000_000)
    assert robot.status == 0
    pulses, stops = robot.pulses, 0
    for _ in range(100_000):
        frame = damage(generator, recorded)
        robot.send(frame)
        if frame[0] == 0x11 and frame[3] & ESTOP:
            stops += 1
            assert robot.status == LATCHED
            robot.run(1000)
            robot.send(robot.command(flags=CLEAR))
        assert robot.status == 0, frame.hex()
        robot.run(400)
    assert robot.pulses == pulses
    assert robot.get(MAX_SPEED) == (OK, 5099)
    assert stops > 100
    robot.drive(3000, 3000, 100_000)
    assert robot.status == ENABLED | MOVING


# -- dongle ---------------------------------------------------------------------------------------


def tx(number, first, second=b'', gap=6):
    return bytes([1, number, gap, len(first)]) + first + second


def test_one_frame_is_one_transaction_is_one_result(library):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc'))
    assert dongle.sent() == b'abc'
    dongle.reply(b'', retransmits=2)
    assert dongle.frames() == [b'\x81\x09\x21\x08' + bytes(4)]
    dongle.run(10_000)
    assert dongle.sent() == dongle.read() == b''  # nothing is repeated by itself


def test_the_second_payload_is_skipped_without_acknowledgement(library):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc', b'def'))
    dongle.sent()
    dongle.reply(acknowledged=False, retransmits=3)
    assert dongle.frames() == [b'\x81\x09\x34\x08' + bytes(4)]
    dongle.run(10_000)
    assert dongle.sent() == b''


@pytest.mark.parametrize(
    'second, statuses, payload',
    [
        ((b'two', 0, True), (3, 3), b'two'),
        ((b'', 15, True), (3, 0xF1), b'one'),
        ((b'', 3, False), (3, 0x34), b'one'),
    ],
)
def test_the_last_reply_is_reported(library, second, statuses, payload):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc', b'def', gap=0))
    dongle.reply(b'one')
    dongle.run(10)
    assert dongle.sent() == b'def'
    dongle.reply(*second)
    (result,) = dongle.frames()
    assert tuple(result[2:4]) == statuses
    assert result[8:] == payload
    dongle.write(tx(10, b'abc'))
    dongle.reply()
    assert dongle.frames()[0][8:] == b''  # not the answer of before


def test_nothing_is_queued(library):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc', b'def'))
    dongle.write(tx(10, b'ghi'))
    assert dongle.frames() == [b'\x8f\x03\x0a']
    dongle.write(b'\x02\x0b' + bytes(10))
    assert dongle.frames() == [b'\x8f\x03\x0b']
    dongle.write(b'\x03\x0cping')
    assert dongle.frames()[0][:6] == b'\x83\x0cping'
    assert dongle.sent() == b'abc'


def test_a_dead_chip_times_out_and_is_configured_again(library):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc', b'def'))
    dongle.call('set_chip', ctypes.c_bool(False))
    dongle.run(200_000)
    (result,) = dongle.frames()
    assert result[:4] == b'\x81\x09\x04\x08'
    assert dongle.call('configured') == 2
    dongle.write(b'\x03\x0cping')
    assert dongle.frames()[0][13] == 0
    dongle.reply(b'late')
    assert dongle.read() == b''


def test_an_oversized_reply_is_dropped(library):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc'))
    dongle.reply(bytes(33))
    assert dongle.frames() == [b'\x81\x09\x01\x08' + bytes(4)]


def test_radio_configuration_is_written_and_read_back(library):
    dongle = Dongle(library)
    dongle.write(b'\x02\x01')
    (standard,) = dongle.frames()
    assert standard[:7] == bytes([0x82, 1, 82, 1, 3, 1, 4])
    assert (len(standard), standard[12]) == (13, 1)
    wanted = bytes([2, 5, 100, 2, 1, 5, 15]) + b'nodes'
    dongle.write(wanted)
    assert dongle.frames() == [b'\x82' + wanted[1:] + b'\x01']
    for place, value in ((2, 126), (3, 3), (4, 4), (5, 16), (6, 16)):
        bad = bytearray(wanted)
        bad[place] = value
        dongle.write(bytes(bad))
        assert dongle.frames() == [b'\x8f\x02\x02']
    dongle.write(b'\x02\x06')
    assert dongle.frames() == [b'\x82\x06' + wanted[2:] + b'\x01']


def test_pong_reports_the_errors_of_the_line(library):
    dongle = Dongle(library)
    dongle.run(5000)
    dongle.call('bytes', b'\x01\x01\x00' + b'\x04abc\x00' + bytes(3), ctypes.c_uint32(11))
    dongle.call('overrun')
    assert dongle.read() == b''  # what cannot be read is not answered either
    dongle.write(b'\x03\x07ping')
    (pong,) = dongle.frames()
    assert pong[:6] == b'\x83\x07ping'
    fields = struct.unpack('<IBBBBHHHB', pong[6:])
    assert fields == (5000, 1, 1, 0, 1, 1, 1, 1, 2)
    dongle.write(b'\x05')
    dongle.write(b'\x03\x07pin')
    dongle.write(b'\x01\x07\x00\x00')
    assert dongle.frames() == [b'\x8f\x01\x05', b'\x8f\x02\x03', b'\x8f\x02\x01']


def test_a_cycle_returns_the_state_after_its_own_command(library, robot):
    """The POLL fetches what was sampled after the CMD of the same cycle, not of the one before."""
    dongle = Dongle(library)
    times = []
    for cycle in range(20):
        command = robot.command(2000, 2000)
        dongle.write(tx(cycle, command, bytes([0x15, SESSION, robot.seq, 0])))
        for _ in range(2):
            payload = dongle.sent()
            dongle.run(800)
            robot.run(400)
            fetched = robot.answer()  # before the packet loads another
            robot.send(payload)
            robot.run(400)
            dongle.reply(fetched)
            dongle.run(1500)
            robot.run(1500)
        (result,) = dongle.frames()
        state = result[8:]
        assert result[:4] == bytes([0x81, cycle, 3, 3])
        assert state[2] == robot.seq
        assert struct.unpack_from('<H', state, 22)[0] <= 90
        times.append(struct.unpack_from('<I', state, 4)[0])
        robot.run(20_000)
    assert min(map(int.__sub__, times[1:], times)) > 20_000


# -- programs -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_fuzzers_find_no_error(tmp_path):
    """Ten million bytes and a million packets under the sanitizers."""
    if shutil.which('make') is None:
        pytest.skip('needs make')
    run = subprocess.run(
        ['make', '-C', FIRMWARE, 'test', f'BUILD={tmp_path}'], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.count('robot, ') == 2


@pytest.mark.skipif(
    not (shutil.which('make') and shutil.which('avr-gcc') and shutil.which('simavr')),
    reason='needs make, avr-gcc and simavr',
)
def test_results_are_independent_of_the_int_width(tmp_path):
    """4500 packets through robot and dongle, on this machine and on a simulated ATmega2560."""
    run = subprocess.run(
        ['make', '-C', FIRMWARE, '-s', 'same', f'BUILD={tmp_path}'],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr
    said = run.stdout + run.stderr  # where the simulator puts the board's words
    assert len(re.findall(r'moving, \w+ 1[0-9]{3}', said)) == 6
    first, second = re.findall(r'checksum (\d+)', said)
    assert first == second
    cycles = dict(re.findall(r'cycles of (an? [\w ]+?) (\d+)\.', said))
    # The answer to a signed CMD must be loaded before the POLL comes 2.3 ms after it, with a third
    # of the time gone to the stepping interrupt.
    parts = ('a signed CMD', 'a round with ramp', 'a round with STATE')
    assert 0 < sum(int(cycles[part]) for part in parts) < 2 / 3 * 2.3e-3 * 16e6
