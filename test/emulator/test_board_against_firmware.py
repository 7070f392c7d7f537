# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Differential test of the emulated board and the firmware core: equal packets, equal replies."""

import ctypes
import random
import shutil

import pytest
from support.emulator_bench import SAMPLE, PulseCounter
from support.firmware_core import FIRMWARE, KEY, compile_core
from support.long_tests import few_of

from t3mpc_ros.emulator.board.eeprom import CELL_US, Setup
from t3mpc_ros.emulator.board.robot_board import RobotBoard
from t3mpc_ros.radio.protocol.authentication import frame_tag, key_check, session_key, sign_hello
from t3mpc_ros.radio.protocol.codec import decode_from_board, encode
from t3mpc_ros.radio.protocol.frames import (
    BUSY,
    FAILED,
    KEY_DAMAGED,
    KEY_HELD,
    NO_KEY,
    OK,
    OUT_OF_RANGE,
    SETTINGS_DAMAGED,
    SETTINGS_GOOD,
    SETTINGS_MISSING,
    SETTINGS_ONE_COPY,
    Action,
    Command,
    CommandFlag,
    Hello,
    Key,
    KeyState,
    ParamGet,
    ParamSet,
    Ping,
    Poll,
    Pong,
    Refusal,
    Settings,
    SettingsState,
    StatusFlag,
)
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

WRAP = 1 << 32
WRAP_SOON = (WRAP - 5_000_000) // 1000 * 1000

pytestmark = pytest.mark.skipif(
    not shutil.which('gcc') or not (FIRMWARE / 'host').is_dir(), reason='needs gcc and firmware'
)


@pytest.fixture(scope='module')
def library(tmp_path_factory):
    return compile_core(tmp_path_factory.mktemp('firmware') / 'libt3core.so')


class Pair:
    """The firmware core and the emulated board with the same input."""

    def __init__(self, library, key=b'', erased=False, time=0):
        self.library = library
        self.robot = ctypes.c_void_p(library.t3_host_robot_new())
        self.hardware = PulseCounter()
        self.nonce = bytes(8)
        self.loaded = b''
        setup = None if erased else Setup()
        self.board = RobotBoard(
            self.hardware, key, lambda size: self.nonce, self._load, setup=setup
        )
        if erased:
            self.call('erase')
        if key:
            self.call('store_key', key)
        self.call('set_cell_us', ctypes.c_uint32(CELL_US))
        self.console_output = b''
        self.board.console.reply = self._record
        self.call('boot', ctypes.c_uint8(1), ctypes.c_uint32(time))
        self.board.boot(1, time)
        self.call('set_imu', ctypes.c_bool(True), (ctypes.c_int16 * 7)(*SAMPLE))
        self.now = time

    def _load(self, payload):
        self.loaded = payload

    def _record(self, data):
        self.console_output += data

    def usb(self, data):
        """Send bytes to both consoles."""
        self.call('usb', bytes(data), ctypes.c_uint32(len(data)))
        self.board.console.feed(bytes(data))

    def request(self, frame, us=1000):
        """Send a frame to both consoles; return their common replies within a time."""
        self.usb(encode_frame(encode(frame)))
        self.run(us)
        return [decode_from_board(data) for data in FrameDecoder().feed(self.console_replies())]

    def console_replies(self):
        """Return the output of both consoles since the last call; check that it is equal."""
        room = ctypes.create_string_buffer(4096)
        size = self.call('usb_take', room, ctypes.c_uint32(4096))
        output, self.console_output = self.console_output, b''
        assert output.hex() == room.raw[:size].hex()
        return output

    def __del__(self):
        self.call('free')

    def call(self, name, *arguments):
        return getattr(self.library, f't3_host_robot_{name}')(self.robot, *arguments)

    def packet(self, data):
        self.call('packet', bytes(data), ctypes.c_uint8(len(data)))
        self.board.receive(bytes(data))

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
        self.board.press_button(pressed)

    def imu(self, present):
        self.call('set_imu', ctypes.c_bool(present), (ctypes.c_int16 * 7)(*SAMPLE))
        self.hardware.registers = SAMPLE if present else None

    def supply(self, count):
        """Set the count of the battery measurement."""
        self.call('set_adc', ctypes.c_uint8(8), ctypes.c_uint16(count))
        self.hardware.battery = count * 20_000 // 1024

    def reset(self):
        self.run(-self.now % 1000)
        self.call('boot', ctypes.c_uint8(4), ctypes.c_uint32(0))
        self.board.boot(4)
        self.now = 0
        self.loaded = b''

    def compare(self):
        room = ctypes.create_string_buffer(32)
        size = self.call('ack', room)
        emulated, real = self.loaded, room.raw[:size]
        speeds = self.call('speed', 0), self.call('speed', 1)
        assert self.board.speeds == speeds
        assert self.board.powered == self.call('powered')
        steps = self.call('steps', 0), self.call('steps', 1)
        for emulated_steps, real_steps in zip(self.board.counters, steps, strict=True):
            # The pulse generator of the firmware has ticks of 50 us.
            assert abs(emulated_steps - real_steps) <= 3 + abs(real_steps) * 1e-5
        if emulated[:1] == b'\x11' and len(emulated) == len(real) == 32:
            # Without the step counters, which are compared above.
            emulated, real = emulated[:8] + emulated[16:], real[:8] + real[16:]
        assert emulated.hex() == real.hex()


class Driver:
    """A host that sends random valid, invalid and damaged packets."""

    def __init__(self, pair, key, seed):
        self.pair, self.key = pair, key
        self.rng = random.Random(seed)
        self.session, self.seq, self.epoch_start = 0, 0, 0
        self.delay = 1000
        self.session_key = b''
        self.sent = [bytes(14)]

    @property
    def host_us(self):
        return (self.pair.now - self.delay) % WRAP

    def hello(self):
        self.session = self.rng.randint(1, 255)
        self.seq = 0
        self.epoch_start = (self.pair.now - self.delay) // WRAP
        nonce, robot_nonce = self.rng.randbytes(8), self.rng.randbytes(8)
        if self.key:
            hello = sign_hello(self.key, self.session, 0, self.host_us, nonce)
            self.session_key = session_key(self.key, nonce, robot_nonce)
        else:
            hello = Hello(self.session, 0, self.host_us)
        self.pair.hello(hello, robot_nonce)

    def signed(self, frame):
        if not self.key:
            return encode(frame)
        frame = frame._replace(host_us=self.host_us)
        epoch = max((self.pair.now - self.delay) // WRAP - self.epoch_start, 0)
        return encode(frame._replace(tag=frame_tag(frame, self.session_key, epoch)))

    def command(self):
        rng = self.rng
        clear = 60 if self.pair.board.status & StatusFlag.ESTOP else 4
        flags = rng.choices((1, 0, 2, 4, 5, 3), (90, 3, 1, clear, 1, 1))[0]
        steps = rng.choices((1, 0, -1, 2, 100, 127, 128), (90, 2, 2, 3, 2, 1, 1))[0]
        self.seq = (self.seq + steps) % 256
        session = rng.choices((self.session, rng.randrange(256)), (60, 1))[0]
        top = rng.choice((1000, 8000, 32767))
        still = rng.random() < 0.2 or flags == 4
        left, right = (0 if still else rng.randint(-top, top) for _ in range(2))
        ttl = rng.choice((20, 20, 20, 5, 0, 255))
        stamp = self.host_us - rng.choices((0, 400_000, 90_000), (30, 1, 2))[0]
        return self.signed(Command(session, self.seq, flags, ttl, left, right, stamp % WRAP))

    def request(self):
        rng = self.rng
        number = rng.randrange(13)
        session = rng.choices((self.session, rng.randrange(256)), (20, 1))[0]
        match rng.randrange(6):
            case 0:
                return encode(ParamGet(session, rng.randrange(256), number))
            case 1 | 2:
                value = rng.choice((0, 1, 3, 16, 32, 100, 250, 5000, 9000, 30000, 10**6))
                return self.signed(ParamSet(session, rng.randrange(256), number, value))
            case 3:
                return self.signed(Action(session, rng.randrange(4), rng.randrange(4)))
            case _:
                return encode(Poll(rng.randrange(256), rng.randrange(256), rng.randrange(3)))

    def damaged(self):
        rng = self.rng
        data = bytearray(rng.choice(self.sent))
        match rng.randrange(4):
            case 0:
                pass
            case 1:
                bit = rng.randrange(8 * len(data))
                data[bit // 8] ^= 1 << bit % 8
            case 2:
                del data[rng.randrange(len(data)) :]
                data = data or bytearray(1)
            case 3:
                data += rng.randbytes(rng.randrange(20))
        return bytes(data)

    def act(self):
        pair, rng = self.pair, self.rng
        match rng.choices(range(9), (60, 15, 6, 1, 1, 1, 1, 0.4, 2))[0]:
            case 0:
                self.send(self.command())
            case 1:
                self.send(self.request())
            case 2:
                pair.packet(self.damaged())
            case 3:
                self.press_and_clear()
            case 4:
                pair.imu(rng.random() < 0.7)
            case 5:
                self.hello()
            case 6:
                pair.run(rng.choice((300_000, 1_000_000, 6_000_000)))
            case 7:
                pair.reset()
            case 8:
                pair.supply(rng.choice((0, 400, 500, 520, 600, 600, 600)))

    def send(self, data):
        self.sent.append(data)
        self.pair.packet(data)

    def press_and_clear(self):
        """Press the button, or release it, for about its debounce time; then clear the latch."""
        pressed, rng = not self.pair.board.button_pressed, self.rng
        self.pair.press(pressed)
        self.pair.run(1000 * (rng.randint(3, 7) if pressed else rng.randint(44, 54)))
        self.seq = (self.seq + 1) % 256
        clear = Command(self.session, self.seq, CommandFlag.ESTOP_CLEAR, 0, 0, 0, self.host_us)
        self.send(self.signed(clear))


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
@pytest.mark.parametrize('seed', few_of(range(12), 8))
def test_emulated_board_and_firmware_reply_alike(library, key, seed):
    """600 random packets, requests, resets and silences; all replies and ramps are compared."""
    # The clock of every second pair wraps after five seconds.
    pair = Pair(library, key, time=seed % 2 * WRAP_SOON)
    driver = Driver(pair, key, seed)
    pair.run(1000)
    driver.hello()
    moved, kinds = False, set()
    for _ in range(600):
        pair.run(driver.rng.choice((700, 1500, 5000, 20_000, 19_950)))
        pair.compare()
        driver.act()
        moved |= any(pair.board.speeds)
        kinds.add(pair.loaded[:1])
    pair.run(1000)
    pair.compare()
    assert moved
    assert kinds >= {b'\x11', b'\x12', b'\x13', b'\x14', b'\x15'}


def test_board_and_firmware_agree_after_a_session_timeout(library):
    """INFO still contains the last nonce; the emulator once reported zeros."""
    pair = Pair(library, KEY)
    pair.run(1000)
    driver = Driver(pair, KEY, 1)
    driver.hello()
    pair.run(1_801_000_000)
    assert pair.board.session == 0
    pair.packet(encode(Poll(0, 0, 2)))
    pair.run(1000)
    pair.compare()
    assert pair.loaded[-8:] != bytes(8)
    driver.hello()
    pair.run(1000)
    pair.compare()
    assert pair.board.session == driver.session


# -- USB console ----------------------------------------------------------------------------------

OTHER = bytes(range(0x20, 0x30))
WRITTEN_US = 25 * CELL_US
"""Time to write a key, both marks and the boot counter."""


@pytest.fixture
def pair(library):
    made = Pair(library)
    made.run(1000)
    return made


def test_a_key_from_the_console_locks_out_other_hosts_at_once(pair):
    assert pair.request(Key(1)) == [KeyState(1, OK, NO_KEY, 0)]
    assert pair.request(Key(2, KEY)) == []
    assert pair.call('writing')
    assert pair.request(Key(3, OTHER)) == [KeyState(3, BUSY, KEY_DAMAGED, 0)]
    pair.packet(encode(Hello(0x5A, 0, pair.now)))
    pair.run(WRITTEN_US)
    (state,) = [decode_from_board(data) for data in FrameDecoder().feed(pair.console_replies())]
    assert state == KeyState(2, OK, KEY_HELD, key_check(KEY))
    pair.packet(encode(Hello(0x5A, 0, pair.now)))  # unsigned
    pair.run(1000)
    pair.compare()
    assert pair.board.session == 0
    driver = Driver(pair, KEY, 1)
    driver.hello()
    assert pair.board.session == driver.session
    pair.reset()
    pair.run(1000)
    assert pair.request(Key(4)) == [KeyState(4, OK, KEY_HELD, key_check(KEY))]
    assert pair.request(Key(5, bytes(16)), WRITTEN_US) == [KeyState(5, OK, NO_KEY, 0)]
    driver = Driver(pair, b'', 1)
    driver.hello()
    pair.run(1000)
    pair.compare()
    assert pair.board.session == driver.session


def test_no_key_is_written_while_the_drivers_have_power(pair):
    driver = Driver(pair, b'', 1)
    driver.hello()
    drive = Command(driver.session, 1, CommandFlag.ENABLE, 5, 3000, 3000, driver.host_us)
    pair.packet(encode(drive))
    assert pair.request(Key(1, KEY), 10) == [KeyState(1, BUSY, NO_KEY, 0)]
    pair.run(20_000)
    assert pair.request(Key(2, KEY)) == [KeyState(2, BUSY, NO_KEY, 0)]
    pair.run(1_000_000)  # the TTL has expired, the drivers are on
    assert pair.board.speeds == (0, 0)
    assert pair.request(Key(3, KEY)) == [KeyState(3, BUSY, NO_KEY, 0)]
    pair.packet(encode(Command(driver.session, 2, 0, 0, 0, 0, driver.host_us)))
    pair.run(1000)
    assert pair.request(Key(4, KEY), WRITTEN_US) == [KeyState(4, OK, KEY_HELD, key_check(KEY))]
    assert pair.board.session == 0
    pair.compare()


@pytest.mark.parametrize('before', [b'', KEY], ids=['none', 'another'])
@pytest.mark.parametrize('after', [bytes(16), OTHER], ids=['none', 'one'])
def test_power_loss_leaves_the_old_key_the_new_key_or_a_lock(library, before, after):
    """Power fails at every cell; a locked robot does not move, and accepts a new key."""
    states = set()
    for cut_us in range(CELL_US // 2, 22 * CELL_US, CELL_US):
        pair = Pair(library, before)
        pair.run(50_000)  # a robot with a key increments its boot counter
        pair.request(Key(1, after), cut_us)
        pair.console_replies()
        pair.reset()
        pair.run(1000)
        ((number, rc, state, check),) = pair.request(Key(2))
        assert (number, rc) == (2, OK)
        kept = check == key_check(before) if before else state == NO_KEY
        changed = check == key_check(after) if any(after) else state == NO_KEY
        assert kept or changed or state == KEY_DAMAGED
        states.add('kept' if kept else 'changed' if changed else 'damaged')
        if state == KEY_DAMAGED:
            driver = Driver(pair, OTHER, 1)
            driver.hello()
            pair.run(1000)
            pair.compare()
            assert pair.board.session == 0
            pair.packet(encode(Command(0, 0, CommandFlag.ESTOP, 0, 0, 0, 0)))
            pair.run(1000)
            pair.compare()
            assert pair.board.status & StatusFlag.ESTOP
            expected = KeyState(3, OK, KEY_HELD, key_check(KEY))
            assert pair.request(Key(3, KEY), WRITTEN_US) == [expected]
    assert states == (
        {'kept', 'damaged', 'changed'} if before or any(after) else {'kept'} | states
    )


@pytest.mark.parametrize('seed', range(6))
def test_no_damaged_console_frame_changes_the_key(pair, seed):
    rng = random.Random(seed)
    whole = encode_frame(encode(Key(7, OTHER)))
    for _ in range(300):
        wire = bytearray(whole)
        match rng.randrange(4):
            case 0:
                bit = rng.randrange(8 * len(wire))
                wire[bit // 8] ^= 1 << bit % 8
            case 1:
                del wire[rng.randrange(len(wire) - 1)]
            case 2:
                wire.insert(rng.randrange(len(wire)), rng.randrange(256))
            case 3:
                wire = bytearray(encode_frame(encode(Key(7, OTHER))[: rng.randrange(3, 18)]))
        if bytes(wire).strip(b'\0') == whole.strip(b'\0'):
            continue
        pair.usb(wire + b'\0')
        pair.run(200)
        pair.console_replies()
    assert not pair.call('writing')
    assert pair.request(Key(1)) == [KeyState(1, OK, NO_KEY, 0)]
    (pong,) = pair.request(Ping(2, b'ping'))
    assert isinstance(pong, Pong)
    assert pong.crc_errors > 50


def test_frames_for_a_dongle_are_refused(pair):
    for frame in (b'\x01\x00\x00\x01\x15', b'\x02\x00', b'\x06'):
        pair.usb(encode_frame(frame))
        (state,) = FrameDecoder().feed(pair.console_replies())
        assert decode_from_board(state) == Refusal(1, frame[0])
    for kind in (4, 5):
        pair.usb(encode_frame(bytes([kind])))
        (state,) = FrameDecoder().feed(pair.console_replies())
        assert decode_from_board(state) == Refusal(2, kind)


def test_a_worn_cell_is_reported_and_locks_the_robot(library):
    """The firmware alone: EEPROM wear is not emulated."""
    for address in (8, 20, 25, 26):
        pair = Pair(library)
        pair.run(1000)
        pair.call('wear', ctypes.c_uint8(address), ctypes.c_bool(True))
        pair.call('usb', encode_frame(encode(Key(1, KEY))), ctypes.c_uint32(22))
        pair.call('run', ctypes.c_uint32(WRITTEN_US))
        room = ctypes.create_string_buffer(64)
        size = pair.call('usb_take', room, ctypes.c_uint32(64))
        (state,) = FrameDecoder().feed(room.raw[:size])
        assert decode_from_board(state) == KeyState(1, FAILED, KEY_DAMAGED, 0)


# -- settings -------------------------------------------------------------------------------------

NEW = Settings(2, 100, 32, bytes.fromhex('c25a33a6e1'))
SET_US = 30 * CELL_US
"""Time to write both copies of the settings."""


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
def test_a_robot_without_settings_is_locked_until_they_are_set(library, key):
    pair = Pair(library, key, erased=True)
    pair.run(50_000)
    driver = Driver(pair, key, 1)
    driver.hello()
    pair.packet(driver.command())
    pair.run(1000)
    pair.compare()
    assert pair.board.session == 0
    missing = SettingsState(1, OK, SETTINGS_MISSING, 82, 16, b'T3MPC')
    assert pair.request(Settings(1)) == [missing]
    assert pair.request(NEW._replace(microsteps=3)) == [missing._replace(id=2, rc=OUT_OF_RANGE)]
    assert pair.request(NEW) == []
    busy = SettingsState(3, BUSY, SETTINGS_DAMAGED, 82, 16, b'T3MPC')
    assert pair.request(NEW._replace(id=3)) == [busy]
    assert pair.request(Key(4, OTHER))[0].rc == BUSY
    driver.hello()
    assert pair.board.session == 0
    stored = SettingsState(2, OK, SETTINGS_GOOD, *NEW[1:])
    pair.run(SET_US)
    (reply,) = FrameDecoder().feed(pair.console_replies())
    assert decode_from_board(reply) == stored
    (pong,) = pair.request(Ping(5, b'ping'))
    assert pong[-4:-1] == (SETTINGS_GOOD, 100, NEW.address)
    driver.hello()
    pair.run(1000)
    pair.compare()
    assert pair.board.session == driver.session


@pytest.mark.parametrize('erased', [False, True])
def test_power_loss_leaves_old_settings_new_ones_or_a_lock(library, erased):
    """Power fails at every cell; both boards agree on what is left, and on the repair."""
    states = set()
    for cut_us in range(CELL_US // 2, SET_US, CELL_US):
        pair = Pair(library, erased=erased)
        pair.run(1000)
        pair.request(NEW, cut_us)
        pair.console_replies()
        pair.reset()
        pair.run(1000)
        (found,) = pair.request(Settings(1))
        states.add(found.state)
        assert found[3:] in (Setup(), NEW[1:])
        driver = Driver(pair, b'', 1)
        driver.hello()
        pair.run(1000)
        pair.compare()
        assert bool(pair.board.session) == (found.state in (SETTINGS_GOOD, SETTINGS_ONE_COPY))
        pair.run(SET_US)
        (repaired,) = pair.request(Settings(1))
        assert repaired.state in (SETTINGS_GOOD, found.state)
        assert repaired[3:] == found[3:]
    lost = {SETTINGS_MISSING, SETTINGS_DAMAGED} if erased else set()
    assert states == {SETTINGS_GOOD, SETTINGS_ONE_COPY} | lost
