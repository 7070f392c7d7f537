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
"""Faults that the firmware has to find by itself, in simavr: no error bit reports them."""

import pytest
from support.avr_boards import DONGLE, IMU, ROBOT, Boards, build, request
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.protocol import codec
from t3mpc_ros.radio.protocol.frames import Ping, Poll, StatusFlag
from t3mpc_ros.radio.protocol.framing import encode_frame

pytestmark = needing(*AVR)

LINE_RATE = 50_000  # bytes per second
TTL = 0.2  # s
MCUSR, WDTCSR = 0x54, 0x60  # data addresses of both chips
WATCHDOG_RESET = WATCHDOG_RUNS = 8


def _drained(boards: Boards) -> int:
    """Return how many frames came until the line was silent."""
    boards.run(0.05)
    count = 0
    while frames := boards.read():
        count += len(frames)
    return count


@pytest.mark.parametrize('sizes', [range(1500, 1560, 15), range(1500, 1560)])
@pytest.mark.long
def test_a_saturated_line_does_not_reset_the_dongle(sizes: range) -> None:
    """It once read bytes until none waited: on a full line the watchdog ended that."""
    build()
    boards = Boards()
    boards.start()
    resets = boards.call('resets', DONGLE)
    ping = encode_frame(codec.encode(Ping(1, b'ping')))
    boards.write((ping * LINE_RATE)[: round(0.3 * LINE_RATE)])
    boards.run(0.3)
    assert boards.call('resets', DONGLE) == resets
    assert _drained(boards) > 0
    boards.write(b'\0')
    _drained(boards)
    assert boards.drive().session == boards.session
    # Wherever a flood ends in a byte, in a frame or in a full ring: the next request is answered.
    for size in sizes:
        boards.write((ping * size)[:size])
        boards.run(0.08)
        boards.write(b'\0')
        _drained(boards)
        assert boards.ask(Ping(2, b'ping'))[:2] == (2, b'ping'), size
    boards.close()


def test_a_full_receiver_without_its_flag_is_read(boards: Boards) -> None:
    """No interrupt comes any more and every packet is lost: once, until the power was cut."""
    boards.start()
    boards.drive()
    stuck = codec.encode(Poll(0, 0, 0))
    boards.call('deafen', stuck, len(stuck))
    begun = boards.now_us
    while boards.drive() is None:
        assert boards.now_us - begun < 1e6 * TTL
    print(f'\nanswers again after {(boards.now_us - begun) / 1000:.1f} ms')
    assert boards.drive().seq == boards.seq


def test_a_reset_of_the_imu_is_flagged_and_repaired(boards: Boards) -> None:
    """A sensor that resets itself sleeps and answers zeros: once, for ever and without a flag."""
    boards.start()
    boards.drive()
    boards.call('imu_reset')
    begun, faults = boards.now_us, 0
    while boards.now_us - begun < 100_000:
        state = boards.drive()
        faults += bool(state.status & StatusFlag.IMU_FAULT)
        assert state.status & StatusFlag.IMU_FAULT or state.gyro_z == IMU[6]
        boards.run(0.002)
    assert faults
    assert not state.status & StatusFlag.IMU_FAULT
    registers = [boards.call('imu_register', at) for at in (0x6B, 0x19, 0x1A, 0x1B, 0x1C)]
    assert registers == [0x01, 0x04, 0x03, 0x08, 0x00]


@pytest.mark.parametrize('board', [DONGLE, ROBOT])
def test_a_watchdog_that_still_runs_is_stopped_at_once(boards: Boards, board: int) -> None:
    """After its reset it has 15 ms: a boot loader may have used up most of them."""
    boards.start()
    boards.rules_broken = True
    boards.call('reset', board)
    boards.call('poke', board, MCUSR, WATCHDOG_RESET)
    boards.call('poke', board, WDTCSR, WATCHDOG_RUNS)
    boards.run(20e-6)
    assert boards.call('peek', board, MCUSR) == 0
    assert boards.call('peek', board, WDTCSR) == 0
    boards.run(0.2)
    ping = Ping(1, b'ping')
    reply = request(boards, ping)[0] if board == ROBOT else boards.ask(ping)
    assert reply.reset_cause == WATCHDOG_RESET
