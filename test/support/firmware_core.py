# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The firmware core as a library for this machine, and its driver.

Time is virtual: the step interrupt runs every 50 us, the main loop every 200 us. Framing and
SipHash of the host are the reference of those of the firmware.
"""

import ctypes
import math
from pathlib import Path
import struct
import subprocess

from t3mpc_ros.radio.protocol.authentication import siphash
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

FIRMWARE = Path(__file__).resolve().parents[2] / 'firmware'
KEY = bytes(range(0x80, 0x90))
ENABLE, ESTOP, CLEAR = 1, 2, 4
ENABLED, MOVING, LATCHED, EXPIRED, IMU_FAULT, LOW_BATTERY, NO_SESSION, LIMITED = (
    1 << bit for bit in range(8)
)
OK, UNKNOWN, RANGE, READ_ONLY, BUSY, FAILED = range(6)
MAX_SPEED, ACCELERATION, DECELERATION, TTL_MAX, MICROSTEPS = range(5)
STEPS_PER_REV, GYRO_RANGE, BATTERY_LOW, IDLE_OFF, INVERT, CUTOFF = range(5, 11)
COUNTERS = ('received', 'duplicates', 'bad_session', 'stale', 'expired', 'bad_version', 'short')
PACKET = ('kind', 'session', 'seq', 'what', 'ttl', 'left', 'right', 'value', 'host_us')
STEP = math.tau / 3200
SESSION = 0x5A
INFO_SIZE = 24
"""Without a nonce."""
USE_HELLO, USE_SESSION_KEY = b'\1', b'\2'
ADDRESS = b'T3MPC'


def compile_core(target):
    """Compile the core like ``make host``, but to ``target``; return the library."""
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
    core.t3_host_robot_writing.restype = ctypes.c_bool
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
        if key:
            self.call('store_key', key)
        self.call('boot', 4, ctypes.c_uint32(time))

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
        self.call('run', ctypes.c_uint32(us))

    def poke(self, time):
        """Shift the clock of the robot and all its time stamps, not the clock of the host."""
        self.delay += time - self.now
        self.call('poke_time', ctypes.c_uint32(time))

    def send(self, data):
        self.call('packet', bytes(data), ctypes.c_uint8(len(data)))

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
        aux = self.request(bytes([0x15, 0, 0, 1]))
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
            head += siphash(self.key, USE_HELLO + head)
        info = self.request(head)
        if self.key:
            nonces = USE_SESSION_KEY + nonce + info[INFO_SIZE:]
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
        """Send a command each ``period`` for a time."""
        for begun in range(0, us, period):
            self.send(self.command(left, right, **other))
            self.run(min(period, us - begun))

    def set(self, number, value, session=SESSION):
        """Write a parameter; return (rc, value)."""
        body = struct.pack('<BBBBi', 0x13, session, 9, number, value)
        if self.session_key:
            body = self.sign(body + struct.pack('<I', self.host_us))
        return self.parameter(self.request(body))

    def get(self, number):
        return self.parameter(self.request(bytes([0x12, SESSION, 9, number])))

    def parameter(self, reply):
        assert reply[0] == 0x12
        assert len(reply) == 17
        return reply[4], struct.unpack_from('<i', reply, 5)[0]

    def console(self, frame, us=1000):
        """Send a frame to the USB console; return the replies within a time."""
        wire = encode_frame(frame)
        self.call('usb', wire, ctypes.c_uint32(len(wire)))
        self.run(us)
        room = ctypes.create_string_buffer(4096)
        size = self.call('usb_take', room, ctypes.c_uint32(4096))
        return FrameDecoder().feed(room.raw[:size])

    def settings(self, channel=None, microsteps=16, address=ADDRESS, us=200_000):
        """Store settings over USB, or read them.

        Return result, state, channel, microsteps and address.
        """
        frame = b'\x05\x09'
        if channel is not None:
            frame += struct.pack('<BH', channel, microsteps) + address
        replies = self.console(frame, us)
        if not replies:
            return None
        kind, number, *values = struct.unpack('<BBBBBH5s', replies[0])
        assert (kind, number) == (0x85, 9)
        return tuple(values)

    def act(self, verb, seq, session=SESSION):
        body = struct.pack('<BBBBH', 0x16, session, seq, verb, 0)
        if self.session_key:
            body = self.sign(body + struct.pack('<I', self.host_us))
        return self.request(body)


class Dongle(Part):
    kind = 'dongle'

    def __init__(self, library):
        super().__init__(library, 2)

    def write(self, frame):
        self.call('bytes', encode_frame(frame), ctypes.c_uint32(len(encode_frame(frame))))

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
        return FrameDecoder().feed(self.read())


class Decoder(Part):
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


def c_encode_frame(library, frame):
    room = ctypes.create_string_buffer(82)
    size = library.t3_host_to_wire(frame, ctypes.c_uint8(len(frame)), room)
    return room.raw[:size]


def c_decode(library, data):
    numbers = (ctypes.c_int64 * 11)()
    fault = library.t3_host_decode(data, ctypes.c_uint8(len(data)), numbers)
    return fault, dict(zip((*PACKET, 'nonce', 'tag'), numbers, strict=True))


def c_encode(library, kind, numbers, nonce=False):
    fields = (ctypes.c_int64 * 32)(*numbers)
    room = ctypes.create_string_buffer(32)
    size = library.t3_host_encode(ctypes.c_uint8(kind), fields, ctypes.c_bool(nonce), room)
    return room.raw[:size]
