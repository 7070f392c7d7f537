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
"""The firmware of both boards in simavr: bytes in, bytes out, virtual time."""

from collections.abc import Iterator
import ctypes
from ctypes import (
    POINTER,
    c_bool,
    c_char_p,
    c_double,
    c_int,
    c_int16,
    c_int64,
    c_uint8,
    c_uint16,
    c_uint32,
    c_uint64,
    c_void_p,
)
import fcntl
from functools import cache
from pathlib import Path
import subprocess
from typing import Any, NamedTuple

from t3mpc_ros.radio.protocol import codec
from t3mpc_ros.radio.protocol.frames import Command, Hello, Poll, Result, State, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder, crc16, encode_frame
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, encode_settings

FIRMWARE = Path(__file__).parents[2] / 'firmware'
BUILD = FIRMWARE / 'build'
DONGLE, ROBOT = 0, 1
CYCLES_PER_US = 16
GAP = 6  # gap between the exchanges of a transaction, in 250 us
BATTERY, DIVIDER = 12_000, 4  # supply, mV, and the divider before the converter
SETTINGS_ADDRESSES = (40, 72)  # cells of both copies
IMU = (100, 200, 16384, 3000, 10, 20, -131)  # accel x, y, z, temperature, gyro x, y, z

_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    't3_sim_new': (c_void_p, (c_char_p, c_char_p, c_uint64)),
    't3_sim_free': (None, (c_void_p,)),
    't3_sim_run': (None, (c_void_p, c_uint32)),
    't3_sim_run_to_byte': (c_bool, (c_void_p, c_uint32)),
    't3_sim_cycles': (c_uint64, (c_void_p,)),
    't3_sim_write': (None, (c_void_p, c_char_p, c_uint32)),
    't3_sim_read': (c_uint32, (c_void_p, POINTER(c_uint8), POINTER(c_uint64), c_uint32)),
    't3_sim_overruns': (c_uint32, (c_void_p,)),
    't3_sim_usb_write': (None, (c_void_p, c_char_p, c_uint32)),
    't3_sim_usb_read': (c_uint32, (c_void_p, POINTER(c_uint8), POINTER(c_uint64), c_uint32)),
    't3_sim_usb_overruns': (c_uint32, (c_void_p,)),
    't3_sim_loss': (None, (c_void_p, c_double, c_double)),
    't3_sim_jam': (None, (c_void_p, c_bool)),
    't3_sim_radio_power': (None, (c_void_p, c_int, c_bool)),
    't3_sim_inject': (c_bool, (c_void_p, c_char_p, c_uint8, c_uint8)),
    't3_sim_deafen': (None, (c_void_p, c_char_p, c_uint8)),
    't3_sim_answer': (None, (c_void_p, c_char_p, c_uint8)),
    't3_sim_last_packet': (c_uint8, (c_void_p, POINTER(c_uint8))),
    't3_sim_radio_register': (c_uint8, (c_void_p, c_int, c_uint8)),
    't3_sim_waiting_acks': (c_uint8, (c_void_p,)),
    't3_sim_radio_counts': (None, (c_void_p, c_int, POINTER(c_uint32))),
    't3_sim_reset': (None, (c_void_p, c_int)),
    't3_sim_resets': (c_uint32, (c_void_p, c_int)),
    't3_sim_busy_cycles': (c_uint64, (c_void_p, c_int)),
    't3_sim_peek': (c_uint8, (c_void_p, c_int, c_uint16)),
    't3_sim_poke': (None, (c_void_p, c_int, c_uint16, c_uint8)),
    't3_sim_eeprom': (None, (c_void_p, c_uint16, POINTER(c_uint8), c_uint16, c_bool)),
    't3_sim_press': (None, (c_void_p, c_bool)),
    't3_sim_imu': (None, (c_void_p, c_bool, POINTER(c_int16))),
    't3_sim_imu_reset': (None, (c_void_p,)),
    't3_sim_imu_register': (c_uint8, (c_void_p, c_uint8)),
    't3_sim_millivolts': (None, (c_void_p, c_uint8, c_uint16)),
    't3_sim_powered': (c_bool, (c_void_p,)),
    't3_sim_wheel': (None, (c_void_p, c_int, POINTER(c_int64))),
}


@cache
def build() -> str:
    """Build both programs and the simulator; return the table of their sizes.

    Of several processes that start together one builds and the others wait: one of them once
    loaded a library of which another had written the first half.
    """
    BUILD.mkdir(exist_ok=True)
    with (BUILD / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(
            ['make', '-C', str(FIRMWARE), 'avr', 'simavr'], capture_output=True, text=True
        )
    if done.returncode:
        raise RuntimeError(f'make avr simavr must succeed: got\n{done.stdout}{done.stderr}')
    sizes = subprocess.run(
        ['avr-size', 'dongle.elf', 'robot.elf'],
        cwd=BUILD,
        capture_output=True,
        text=True,
        check=True,
    )
    return sizes.stdout


def settings_record(
    channel: int = 82, microsteps: int = 16, address: bytes = b'T3MPC', rate: str = '1M'
) -> bytes:
    """Return a copy of the settings as it stands in EEPROM."""
    settings = RobotSettings(address, channel, rate, microsteps=microsteps)
    body = encode_settings(settings)
    return body + crc16(body).to_bytes(2, 'little')


class Wheel(NamedTuple):
    """Statistics of the pins of a stepper driver; times in cycles."""

    pulses: int
    unpowered: int
    hasty: int
    shortest_high: int
    shortest_low: int
    shortest_setup: int


class RadioCounts(NamedTuple):
    """Counters of a radio chip; from ``early_spi`` on, violations of its data sheet."""

    sent: int
    received: int
    duplicates: int
    attempts: int
    early_spi: int
    early_ce: int
    ack_damaged: int
    overfull: int
    queued_acks: int
    unknown: int
    rx_overflows: int


class Boards:
    """A dongle and a robot, and a host that exchanges whole frames with them."""

    def __init__(self, seed: int = 1, erased: bool = False) -> None:
        self._library = ctypes.CDLL(str(BUILD / 'libt3simavr.so'))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        self._sim = self._library.t3_sim_new(
            str(BUILD / 'dongle.elf').encode(), str(BUILD / 'robot.elf').encode(), seed
        )
        if not self._sim:
            raise RuntimeError('simavr must know both chips and read both programs')
        self.splitter = FrameDecoder()
        self.session = 0x5A
        self.echo_us = 0
        self.seq = 0
        self.id = 0
        self.rules_broken = False  # the test itself violated the data sheet of the radio
        if not erased:
            for address in SETTINGS_ADDRESSES:
                self.store(address, settings_record())
        self.imu(True)
        for channel in range(8):
            self.call('millivolts', channel, 1000)
        self.call('millivolts', 8, BATTERY // DIVIDER)

    def close(self) -> None:
        self._library.t3_sim_free(self._sim)

    def call(self, name: str, *arguments: Any) -> Any:
        return getattr(self._library, f't3_sim_{name}')(self._sim, *arguments)

    # -- time -------------------------------------------------------------------------------------

    @property
    def now_us(self) -> float:
        return self.call('cycles') / CYCLES_PER_US

    def run(self, seconds: float) -> None:
        self.call('run', round(seconds * 1e6))

    def run_until(self, time_us: float) -> None:
        self.call('run', max(0, round(time_us - self.now_us)))

    # -- serial line ------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        self.call('write', data, len(data))

    def received(self, line: str = 'read') -> tuple[bytes, list[float]]:
        """Return the received bytes of the dongle or, ``usb_read``, of the console; times (us)."""
        data, at = (c_uint8 * 4096)(), (c_uint64 * 4096)()
        count = self.call(line, data, at, 4096)
        return bytes(data[:count]), [at[i] / CYCLES_PER_US for i in range(count)]

    def read(self) -> list[tuple[bytes, float]]:
        """Return the received frames, each with the time (us) of its last byte."""
        frames = []
        for byte, time_us in zip(*self.received(), strict=True):
            frames += [(frame, time_us) for frame in self.splitter.feed(bytes([byte]))]
        return frames

    def wait(self, limit_us: float = 20000.0) -> tuple[bytes, float] | None:
        """Return the next frame with the time of its last byte; None after the limit."""
        end = self.now_us + limit_us
        while self.now_us < end:
            if self.call('run_to_byte', round(end - self.now_us)):
                for found in self.read():
                    return found
        return None

    def ask(self, frame: Any, limit_us: float = 20000.0) -> Any:
        """Return the reply of the dongle to a frame, None if there is none."""
        self.write(encode_frame(codec.encode(frame)))
        found = self.wait(limit_us)
        return codec.decode_from_dongle(found[0]) if found else None

    # -- robot ------------------------------------------------------------------------------------

    def exchange(self, first: Any, second: Any = None, gap: int = GAP) -> Result:
        """Return the RESULT of a transaction; the second payload defaults to a POLL."""
        self.id = (self.id + 1) % 256
        second = Poll(self.session, 0, 0) if second is None else second
        frame = Transmit(self.id, gap, codec.encode(first), codec.encode(second))
        result = self.ask(frame, 60000.0)
        assert isinstance(result, Result), result
        assert result.id == self.id
        uplink = codec.decode_uplink(result.payload) if result.payload else None
        if isinstance(uplink, State):
            self.echo_us = uplink.time_us
        return result

    def request(self, first: Any, second: Any = None, gap: int = GAP) -> Any:
        """Return the reply of the robot, None if there is none."""
        result = self.exchange(first, second, gap)
        return codec.decode_uplink(result.payload) if result.payload else None

    def command(
        self, left: int = 0, right: int = 0, flags: int = 1, ttl: int = 20, session: int = -1
    ) -> Command:
        """Return the next CMD."""
        self.seq = (self.seq + 1) % 256
        session = self.session if session < 0 else session
        return Command(session, self.seq, flags, ttl, left, right, self.echo_us)

    def drive(self, left: int = 0, right: int = 0, flags: int = 1, ttl: int = 20) -> Any:
        """Return the state after one command, None if it was lost."""
        return self.request(self.command(left, right, flags, ttl))

    def hello(self) -> Any:
        """Start a session; return the INFO."""
        self.seq = 0
        info = self.request(Hello(self.session, 0), Poll(self.session, 1, 2))
        self.request(Poll(self.session, 0, 0))  # for its time: the first echo
        return info

    def start(self) -> Any:
        """Boot both boards and start a session; return the INFO."""
        self.run(0.13)
        return self.hello()

    # -- hardware ---------------------------------------------------------------------------------

    def imu(self, present: bool, seven: tuple[int, ...] = IMU) -> None:
        self.call('imu', present, (c_int16 * 7)(*seven))

    def wheel(self, wheel: int) -> Wheel:
        six = (c_int64 * 6)()
        self.call('wheel', wheel, six)
        return Wheel(*six)

    def pulses(self) -> tuple[int, int]:
        return self.wheel(0).pulses, self.wheel(1).pulses

    def radio(self, board: int) -> RadioCounts:
        eleven = (c_uint32 * 11)()
        self.call('radio_counts', board, eleven)
        return RadioCounts(*eleven)

    def last_packet(self) -> bytes:
        """Return the last packet that the radio of the robot received."""
        data = (c_uint8 * 32)()
        size = self.call('last_packet', data)
        return bytes(data[:size])

    def eeprom(self, address: int, size: int) -> bytes:
        data = (c_uint8 * size)()
        self.call('eeprom', address, data, size, False)
        return bytes(data)

    def store(self, address: int, data: bytes) -> None:
        self.call('eeprom', address, (c_uint8 * len(data))(*data), len(data), True)

    def symbol(self, board: int, name: str) -> int:
        """Return the data address of a variable."""
        elf = BUILD / ('dongle.elf', 'robot.elf')[board]
        table = subprocess.run(['avr-nm', str(elf)], capture_output=True, text=True, check=True)
        for line in table.stdout.splitlines():
            address, _, found = line.split()
            if found == name:
                return int(address, 16) - 0x800000
        raise KeyError(f'{elf.name} must have the symbol: got {name!r}')


def booted(seed: int = 1, erased: bool = False) -> Iterator[Boards]:
    """Yield a new pair of boards; then check the conditions that hold after every test."""
    build()
    pair = Boards(seed, erased)
    yield pair
    # No data sheet is violated, and no step is lost.
    for board in (DONGLE, ROBOT):
        counts = pair.radio(board)
        assert counts.unknown == counts.overfull == counts.queued_acks == 0
        assert pair.rules_broken or counts.early_spi == counts.early_ce == 0
    for wheel in (0, 1):
        assert pair.wheel(wheel).unpowered == pair.wheel(wheel).hasty == 0
    assert pair.call('overruns') == 0
    pair.close()


def console_output(boards: Boards) -> list[Any]:
    """Return the frames that the USB console of the robot has sent."""
    data, _ = boards.received('usb_read')
    return [codec.decode_from_board(frame) for frame in FrameDecoder().feed(data)]


def request(boards: Boards, frame: Any, seconds: float = 0.005) -> list[Any]:
    """Send a frame to the console; return the replies within a time."""
    wire = encode_frame(codec.encode(frame))
    boards.call('usb_write', wire, len(wire))
    boards.run(seconds)
    return console_output(boards)


def cycle(boards: Boards, period: float, left: int = 0, right: int = 0) -> object:
    """Return the state after one cycle of ``period`` seconds."""
    end = boards.now_us + period * 1e6
    state = boards.drive(left, right)
    boards.run_until(end)
    return state


def drive(boards: Boards, seconds: float, left: int, right: int, period: float = 0.02) -> object:
    """Return the last state after driving for some seconds."""
    state = None
    for _ in range(round(seconds / period)):
        state = cycle(boards, period, left, right)
    return state


def odometry_agrees(boards: Boards) -> None:
    state = boards.request(Poll(0, 0, 0), Poll(0, 0, 0))
    assert (state.left, state.right) == boards.pulses()
