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
"""The firmware core as a library for this machine, and its driver.

Time is virtual: the step interrupt runs every 50 us, the main loop every 200 us. Framing and
SipHash of the host are the reference of those of the firmware.
"""

import ctypes
from functools import cache
import math
from pathlib import Path
import struct
import subprocess

from t3mpc_ros.emulator.firmware_library import compile_library
from t3mpc_ros.radio.protocol.authentication import siphash
from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import SETTINGS_RECORD, Command, RefusalReason
from t3mpc_ros.radio.protocol.framing import FrameDecoder, crc16, encode_frame
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, encode_settings

FIRMWARE = Path(__file__).resolve().parents[2] / 'firmware'
KEY = bytes(range(0x80, 0x90))
ENABLE, ESTOP, CLEAR = 1, 2, 4
ENABLED, MOVING, LATCHED, EXPIRED, IMU_FAULT, LOW_BATTERY, NO_SESSION, LIMITED = (
    1 << bit for bit in range(8)
)
OK, UNKNOWN, RANGE, READ_ONLY, BUSY, FAILED = range(6)
MAX_SPEED, ACCELERATION, DECELERATION, TTL_MAX, MICROSTEPS = range(5)
STEPS_PER_REV, GYRO_RANGE, BATTERY_LOW, IDLE_OFF, INVERT, CUTOFF, BOOTS = range(5, 12)
COUNTERS = (
    'received', 'duplicates', 'bad_session', 'stale', 'expired', 'bad_version', 'malformed',
)  # fmt: skip
PACKET = 'kind', 'session', 'seq', 'what', 'ttl', 'left', 'right', 'value', 'echo_us', 'host_us'
STEP = math.tau / 3200
SESSION = 0x5A
INFO_SIZE = 24  # without a nonce
USE_HELLO, USE_SESSION_KEY = b'\1', b'\2'
ADDRESS = b'T3MPC'


def run_make(folder, *words):
    """Run make for the firmware, with a build folder; return the process."""
    command = ['make', '-s', '-C', FIRMWARE, f'BUILD={folder}', *words]
    return subprocess.run(command, capture_output=True, text=True)


RESULTS = {
    ctypes.c_void_p: 'robot_new dongle_new splitter_new',
    ctypes.c_int32: 'robot_pulses robot_steps robot_speed',
    ctypes.c_uint32: (
        'robot_time robot_loads robot_closest_pulses robot_unpowered_pulses robot_hasty_pulses '
        'robot_eeprom_writes robot_usb_take dongle_take dongle_time dongle_configured '
        'splitter_feed time_us'
    ),
    ctypes.c_uint16: 'crc16',
    ctypes.c_uint8: (
        'robot_ack robot_status robot_levels robot_session dongle_sent to_wire range_code decode '
        'encode'
    ),
    ctypes.c_bool: 'robot_powered robot_writing',
}
"""Functions by the type of their result."""


@cache
def load_core():
    """Return the library of the emulator, with the functions that only tests use."""
    core = ctypes.CDLL(str(compile_library()))
    for kind, names in RESULTS.items():
        for name in names.split():
            getattr(core, f't3_host_{name}').restype = kind
    return core


# -- drivers --------------------------------------------------------------------------------------


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
    """A robot and its host. Times are in us, speeds in mrad/s."""

    kind = 'robot'

    def __init__(self, library, key=b'', time=0, erased=False):
        super().__init__(library)
        if erased:
            self.call('erase')
        self.key = key
        self.session_key = b''
        self.seq = 0
        self.delay = 1000  # us from the stamp of the host to reception
        self.echo_age = 1000  # us from the newest STATE of the host to reception
        if key:
            self.call('store_key', key)
        self.call('boot', 4, time)

    @property
    def now(self):
        return self.call('time')

    @property
    def host_us(self):
        return (self.now - self.delay) % (1 << 32)

    @property
    def status(self):
        return self.call('status')

    @property
    def speeds(self):
        """Speeds of the ramp, left and right, rad/s."""
        return self.call('speed', 0) / 1e6, self.call('speed', 1) / 1e6

    @property
    def steps(self):
        return self.call('steps', 0), self.call('steps', 1)

    @property
    def pulses(self):
        return self.call('pulses', 0), self.call('pulses', 1)

    def run(self, us):
        self.call('run', us)

    def reset(self, cell_us=0):
        """Reset the board; then its EEPROM takes a time for a cell."""
        self.call('set_cell_us', cell_us)
        self.call('boot', 4, 0)
        self.run(1000)

    def poke_eeprom(self, address, data):
        for at, value in enumerate(data, address):
            self.call('poke_eeprom', at, value)

    def store_boots(self, count):
        """Store the count of starts."""
        record = struct.pack('<I', count)
        self.poke_eeprom(32, record + crc16(record).to_bytes(2, 'little'))

    def poke(self, time):
        """Shift the clock of the robot and all its time stamps, not the clock of the host."""
        self.delay += time - self.now
        self.call('poke_time', time)

    def send(self, data):
        self.call('packet', bytes(data), len(data))

    def reply(self):
        """Return the payload that the next exchange fetches."""
        room = ctypes.create_string_buffer(32)
        size = self.call('ack', room)
        return room.raw[:size]

    def request(self, data):
        """Send a payload; return the reply."""
        self.send(data)
        self.run(1000)
        return self.reply()

    def counters(self):
        """Return the seven counters of AUX."""
        aux = self.request(bytes([0x25, 0, 0, 1]))
        counts = struct.unpack_from('<7H', aux, 14)
        return dict(zip(COUNTERS, counts, strict=True))

    def refusal(self):
        """Return why the newest refused payload was refused, and its first bytes."""
        aux = self.request(bytes([0x25, 0, 0, 1]))
        return RefusalReason(aux[28]), aux[29:]

    def sign(self, body, epoch=0, host_us=None):
        if not self.session_key:
            return body
        body += struct.pack('<I', self.host_us if host_us is None else host_us)
        return body + siphash(self.session_key, body + epoch.to_bytes(4, 'little'))

    def hello(self, session=SESSION, nonce=b'\1\2\3\4\5\6\7\x08'):
        head = struct.pack('<BBBB', 0x24, session, 0, bool(self.key))
        if self.key:
            head += struct.pack('<I', self.host_us) + nonce
            head += siphash(self.key, USE_HELLO + head)
        info = self.request(head)
        if self.key:
            nonces = USE_SESSION_KEY + nonce + info[INFO_SIZE:]
            self.session_key = b''.join(siphash(self.key, nonces + bytes([i])) for i in (0, 1))
        return info

    def command(self, left=0, right=0, flags=ENABLE, ttl=20, seq=None, session=SESSION, **other):
        if seq is None:
            self.seq = seq = (self.seq + 1) % 256
        echo_us = other.get('echo_us', (self.now - self.echo_age) % (1 << 32))
        body = struct.pack(
            '<BBBBBBhhI', 0x21, session, seq, flags, ttl, 0, round(left), round(right), echo_us
        )
        return self.sign(body, other.get('epoch', 0), other.get('host_us'))

    def drive(self, left, right, us, period=20_000, **other):
        """Send a command each ``period`` for a time."""
        for begun in range(0, us, period):
            self.send(self.command(left, right, **other))
            self.run(min(period, us - begun))

    def moves(self):
        """Return whether the robot accepts a session and follows a command."""
        self.hello()
        self.drive(3000, 3000, 100_000)
        moving = self.status & MOVING
        self.drive(0, 0, 300_000)
        self.send(self.command(flags=0))
        self.run(2000)
        return bool(moving)

    def identity(self):
        """Return state of the records, channel, microsteps and address in INFO."""
        info = self.request(b'\x25\0\0\2')
        microsteps, state, channel, address = struct.unpack_from('<HxBB5s', info, 10)
        return state, channel, microsteps, address

    def set(self, number, value, session=SESSION):
        """Write a parameter; return (rc, value)."""
        body = struct.pack('<BBBBi', 0x23, session, 9, number, value)
        return self.parameter(self.request(self.sign(body)))

    def get(self, number):
        return self.parameter(self.request(bytes([0x22, SESSION, 9, number])))

    def parameter(self, reply):
        assert reply[0] == 0x22
        assert len(reply) == 17
        return reply[4], struct.unpack_from('<i', reply, 5)[0]

    def console(self, frame, us=1000):
        """Send a frame to the USB console; return the replies within a time."""
        wire = encode_frame(frame)
        self.call('usb', wire, len(wire))
        self.run(us)
        room = ctypes.create_string_buffer(4096)
        size = self.call('usb_take', room, 4096)
        return FrameDecoder().feed(room.raw[:size])

    def settings(self, channel=None, microsteps=16, address=ADDRESS, us=700_000):
        """Store settings over USB, other values the defaults, or read them.

        Return result, state, channel, microsteps and address.
        """
        rc = OK
        if channel is not None:
            body = bytearray(encode_settings(RobotSettings()))
            struct.pack_into('<BH5s', body, 1, channel, microsteps, address)
            rc = self.store(SETTINGS_RECORD, bytes(body), us)
        state, body = self.record(SETTINGS_RECORD)
        return rc, state, *struct.unpack_from('<BH5s', body, 1)

    def record(self, record):
        """Return state and content of a record."""
        state, size, body, parts = 0, 1, b'', 0
        while len(body) < size:
            (frame,) = self.console(bytes([6, 9, record, parts]))
            kind, number, rc, which, state, size, part = frame[:7]
            assert (kind, number, rc, which, part) == (0x86, 9, OK, record, parts)
            body, parts = body + frame[7:], parts + 1
        return state, body[:size]

    def stage(self, record, body):
        """Send the parts of a record."""
        for part in range(-(-len(body) // 16)):
            data = body[16 * part :][:16].ljust(16, b'\0')
            (frame,) = self.console(bytes([6, 9, record, part]) + data)
            assert frame[2] == OK

    def store(self, record, body, us=700_000):
        """Stage and store a record; return the result, None within less time than it takes."""
        self.stage(record, body)
        replies = self.console(struct.pack('<BBBH', 7, 9, record, crc16(body)), us)
        return replies[0][2] if replies else None

    def act(self, verb, seq, session=SESSION):
        return self.request(self.sign(struct.pack('<BBBBH', 0x26, session, seq, verb, 0)))


class CoreVerifier:
    """The rules of a session in the core.

    Its methods return why a frame is refused, NONE for a valid one.
    """

    def __init__(self, key=b''):
        self._robot = Robot(load_core(), key)
        self._robot.run(1000)

    @property
    def session(self):
        return self._robot.call('session')

    @property
    def nonce(self):
        return self._robot.request(b'\x25\0\0\2')[INFO_SIZE:]

    def receive(self, data):
        """Return why the robot refuses a payload, NONE if it does not."""
        before = self._refusals()
        self._robot.send(data)
        refused = self._refusals() != before
        return self._robot.refusal()[0] if refused else RefusalReason.NONE

    def begin_session(self, hello, fresh_nonce):
        """Start the session of a HELLO; these 8 bytes become the nonce of the robot."""
        self._robot.call('force_nonce', fresh_nonce)
        return self.receive(encode(hello))

    def accept(self, frame):
        """Return why a frame is not part of the session; a valid one advances the counter."""
        why = self.receive(encode(frame))
        # The session is checked first.
        late = (RefusalReason.SEQUENCE, RefusalReason.STALE)
        return RefusalReason.NONE if why in late else why

    def verify(self, frame):
        """Return why a frame is not followed: an ESTOP always is."""
        why = self.accept(frame)
        estop = isinstance(frame, Command) and frame.flags & ESTOP
        return RefusalReason.NONE if estop else why

    def _refusals(self):
        counts = self._robot.counters()
        return [counts[name] for name in COUNTERS if name not in ('received', 'expired')]


class Dongle(Part):
    kind = 'dongle'

    def __init__(self, library):
        super().__init__(library, 2)

    def write(self, frame):
        self.call('bytes', encode_frame(frame), len(encode_frame(frame)))

    def run(self, us):
        self.call('run', us)

    def sent(self):
        room = ctypes.create_string_buffer(32)
        size = self.call('sent', room)
        return room.raw[:size]

    def reply(self, payload=b'', retransmits=0, acknowledged=True):
        self.call('answer', acknowledged, retransmits, payload, len(payload))

    def read(self):
        room = ctypes.create_string_buffer(4096)
        size = self.call('take', room, 4096)
        return room.raw[:size]

    def frames(self):
        return FrameDecoder().feed(self.read())


class Decoder(Part):
    kind = 'splitter'

    def feed(self, data):
        found, room, size = [], ctypes.create_string_buffer(78), ctypes.c_uint8()
        while data:
            taken = self.call('feed', data, len(data), room, ctypes.byref(size))
            data = data[taken:]
            if size.value:
                found.append(room.raw[: size.value])
        return found

    def counts(self):
        three = (ctypes.c_uint16 * 3)()
        self.call('counts', three)
        return tuple(three)


def c_encode_frame(library, frame):
    room = ctypes.create_string_buffer(82)
    size = library.t3_host_to_wire(frame, len(frame), room)
    return room.raw[:size]


def c_decode(library, data):
    numbers = (ctypes.c_int64 * 12)()
    fault = library.t3_host_decode(data, len(data), numbers)
    return fault, dict(zip((*PACKET, 'nonce', 'tag'), numbers, strict=True))


def c_encode(library, kind, numbers, nonce=False):
    fields = (ctypes.c_int64 * 32)(*numbers)
    room = ctypes.create_string_buffer(32)
    size = library.t3_host_encode(kind, fields, nonce, room)
    return room.raw[:size]
