# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The emulated board against the firmware's core: the same packets, the same answers."""

import ctypes
from pathlib import Path
import random
import shutil
import subprocess

from emulator_bench import SAMPLE, PulseCounter
import pytest

from t3mpc_ros.emulator.board import Board
from t3mpc_ros.radio.authentication import session_key, sign_hello, tag_of
from t3mpc_ros.radio.codec import encode
from t3mpc_ros.radio.frames import Action, Command, Flag, Hello, ParamGet, ParamSet, Poll

FIRMWARE = Path(__file__).resolve().parent.parent / 'firmware'
KEY = bytes(range(0x80, 0x90))
WRAP = 1 << 32

pytestmark = pytest.mark.skipif(
    not shutil.which('gcc') or not (FIRMWARE / 'host').is_dir(), reason='needs gcc and firmware'
)


@pytest.fixture(scope='module')
def library(tmp_path_factory):
    target = tmp_path_factory.mktemp('firmware') / 'libt3core.so'
    sources = sorted(map(str, [*FIRMWARE.glob('core/*.c'), *FIRMWARE.glob('host/*.c')]))
    folders = [f'-I{FIRMWARE / "core"}', f'-I{FIRMWARE / "host"}']
    flags = ['-std=c99', '-O2', '-fPIC', '-shared']
    subprocess.run(['gcc', *flags, *folders, '-o', target, *sources], check=True)
    core = ctypes.CDLL(str(target))
    core.t3_host_robot_new.restype = ctypes.c_void_p
    core.t3_host_robot_ack.restype = ctypes.c_uint8
    core.t3_host_robot_powered.restype = ctypes.c_bool
    core.t3_host_robot_speed.restype = ctypes.c_int32
    core.t3_host_robot_steps.restype = ctypes.c_int32
    return core


class Pair:
    """The C core and the emulated board, told the same."""

    def __init__(self, library, key=b''):
        self.library = library
        self.robot = ctypes.c_void_p(library.t3_host_robot_new())
        self.hardware = PulseCounter()
        self.nonce = bytes(8)
        self.loaded = b''
        self.board = Board(self.hardware, key, lambda size: self.nonce, self._load)
        if key:
            self.call('store_key', key)
        self.call('boot', ctypes.c_uint8(1), ctypes.c_uint32(0))
        self.call('set_imu', ctypes.c_bool(True), (ctypes.c_int16 * 7)(*SAMPLE))
        self.now = 0

    def _load(self, payload):
        self.loaded = payload

    def __del__(self):
        self.call('free')

    def call(self, name, *arguments):
        return getattr(self.library, f't3_host_robot_{name}')(self.robot, *arguments)

    def packet(self, data):
        self.call('packet', bytes(data), ctypes.c_uint8(len(data)))
        self.board.packet(bytes(data))

    def hello(self, frame, nonce):
        self.nonce = nonce
        self.call('force_nonce', nonce)
        self.packet(encode(frame))

    def run(self, us):
        self.call('run', ctypes.c_uint32(us))
        self.now += us
        self.board.run_to(self.now)

    def press(self, pressed):
        self.call('press', ctypes.c_bool(pressed))
        self.board.press(pressed)

    def imu(self, answers):
        self.call('set_imu', ctypes.c_bool(answers), (ctypes.c_int16 * 7)(*SAMPLE))
        self.hardware.registers = SAMPLE if answers else None

    def reset(self):
        self.run(-self.now % 1000)
        self.call('boot', ctypes.c_uint8(4), ctypes.c_uint32(0))
        self.board.boot(4)
        self.now = 0
        self.loaded = b''

    def compare(self):
        room = ctypes.create_string_buffer(32)
        size = self.call('ack', room)
        ours, theirs = self.loaded, room.raw[:size]
        speeds = self.call('speed', 0), self.call('speed', 1)
        assert self.board.speeds == speeds
        assert self.board.powered == self.call('powered')
        steps = self.call('steps', 0), self.call('steps', 1)
        for mine, its in zip(self.board.counters, steps, strict=True):
            # A pulse generator in 50 us ticks rounds otherwise than one without.
            assert abs(mine - its) <= 3 + abs(its) * 1e-5
        if ours[:1] == b'\x11' and len(ours) == len(theirs) == 32:
            ours, theirs = ours[:8] + ours[16:], theirs[:8] + theirs[16:]
        assert ours.hex() == theirs.hex()


class Driver:
    """A host that errs in every way, by dice."""

    def __init__(self, pair, key, seed):
        self.pair, self.key = pair, key
        self.dice = random.Random(seed)
        self.session, self.seq, self.epoch = 0, 0, 0
        self.travel = 1000
        self.session_key = b''
        self.sent = [bytes(14)]

    @property
    def host_us(self):
        return (self.pair.now - self.travel) % WRAP

    def greet(self):
        self.session = self.dice.randint(1, 255)
        self.seq = 0
        nonce, theirs = self.dice.randbytes(8), self.dice.randbytes(8)
        if self.key:
            hello = sign_hello(self.key, self.session, 0, self.host_us, nonce)
            self.session_key = session_key(self.key, nonce, theirs)
        else:
            hello = Hello(self.session, 0, self.host_us)
        self.pair.hello(hello, theirs)

    def signed(self, frame):
        if not self.key:
            return encode(frame)
        frame = frame._replace(host_us=self.host_us)
        return encode(frame._replace(tag=tag_of(frame, self.session_key, 0)))

    def command(self):
        dice = self.dice
        flags = dice.choices((1, 0, 2, 4, 5, 3), (90, 3, 0 if self.key else 1, 4, 1, 0))[0]
        self.seq = (self.seq + dice.choices((1, 0, -1, 2, 100, 200), (90, 2, 2, 3, 2, 1))[0]) % 256
        session = dice.choices((self.session, dice.randrange(256)), (60, 1))[0]
        top = dice.choice((1000, 8000, 32767))
        still = dice.random() < 0.2 or flags == 4
        left, right = (0 if still else dice.randint(-top, top) for _ in range(2))
        ttl = dice.choice((20, 20, 20, 5, 0, 255))
        stamp = self.host_us - dice.choices((0, 400_000, 90_000), (30, 1, 2))[0]
        return self.signed(Command(session, self.seq, flags, ttl, left, right, stamp % WRAP))

    def request(self):
        dice = self.dice
        number = dice.randrange(12)
        session = dice.choices((self.session, dice.randrange(256)), (20, 1))[0]
        match dice.randrange(6):
            case 0:
                return encode(ParamGet(session, dice.randrange(256), number))
            case 1 | 2:
                # Far enough from 1 that the microsteps of the next start are usual ones.
                value = dice.choice((0, 1, 3, 16, 32, 100, 250, 5000, 9000, 30000, 10**6))
                return self.signed(ParamSet(session, dice.randrange(256), number, value))
            case 3:
                return self.signed(Action(session, dice.randrange(4), dice.randrange(4)))
            case _:
                return encode(Poll(dice.randrange(256), dice.randrange(256), dice.randrange(3)))

    def damaged(self):
        dice = self.dice
        data = bytearray(dice.choice(self.sent))
        match dice.randrange(4):
            case 0:
                pass
            case 1:
                bit = dice.randrange(8 * len(data))
                data[bit // 8] ^= 1 << bit % 8
                if self.key and data[0] & 15 == 1 and len(data) > 3:
                    data[3] &= ~Flag.ESTOP
            case 2:
                del data[dice.randrange(len(data)) :]
                data = data or bytearray(1)
            case 3:
                data += dice.randbytes(dice.randrange(20))
        return bytes(data)

    def act(self):
        pair, dice = self.pair, self.dice
        match dice.choices(range(8), (60, 15, 6, 1, 1, 1, 1, 0.4))[0]:
            case 0:
                self.send(self.command())
            case 1:
                self.send(self.request())
            case 2:
                pair.packet(self.damaged())
            case 3:
                pair.press(dice.random() < 0.5)
            case 4:
                pair.imu(dice.random() < 0.7)
            case 5:
                self.greet()
            case 6:
                pair.run(dice.choice((300_000, 1_000_000, 6_000_000)))
            case 7:
                pair.reset()

    def send(self, data):
        self.sent.append(data)
        self.pair.packet(data)


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
@pytest.mark.parametrize('seed', range(12))
def test_board_and_firmware_answer_alike(library, key, seed):
    """600 random packets, requests, resets and silences; every answer and every ramp compared."""
    pair = Pair(library, key)
    driver = Driver(pair, key, seed)
    pair.run(1000)
    driver.greet()
    moved, kinds = False, set()
    for _ in range(600):
        pair.run(driver.dice.choice((700, 1500, 5000, 20_000, 19_950)))
        pair.compare()
        driver.act()
        moved |= any(pair.board.speeds)
        kinds.add(pair.loaded[:1])
    pair.run(1000)
    pair.compare()
    assert moved
    assert kinds >= {b'\x11', b'\x12', b'\x13', b'\x14', b'\x15'}
