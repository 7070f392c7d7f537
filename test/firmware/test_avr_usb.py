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
"""The real firmware of the robot in simavr: USB console with the key, and all radio rates.

Simulation only: simavr executes the programs of both boards.
"""

import random
import statistics
from typing import Any

import pytest
from support import avr_boards
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import codec, frames
from t3mpc_ros.radio.protocol.authentication import Signer, key_check, session_key, sign_hello
from t3mpc_ros.radio.protocol.framing import crc16, encode_frame

pytestmark = needing(*AVR)

KEY, OTHER = bytes(range(0x80, 0x90)), bytes(range(0x30, 0x40))
KEY_ADDRESS, MARK_ADDRESS = 8, 26
WRITING = 0.3  # sufficient time to write a key, s: about 25 cells of 3.4 ms
HOST_NONCE = b'hostnonc'


def begin_session(boards: avr_boards.Boards, key: bytes, gap: int = 20) -> Signer | None:
    """Begin a signed session; return its signer, None if the robot rejects it."""
    host_us = round(boards.now_us)
    hello = sign_hello(key, boards.session, 0, host_us, HOST_NONCE)
    info = boards.request(hello, frames.Poll(0, 1, 2), gap)
    assert isinstance(info, frames.Info)
    boards.seq = 0
    boards.request(frames.Poll(0, 0, 0))  # for its time: the first echo
    if info.session != boards.session:
        return None
    return Signer(session_key(key, HOST_NONCE, info.nonce), host_us)


def signed(
    boards: avr_boards.Boards, signer: Signer, left: int, right: int, gap: int = avr_boards.GAP
) -> Any:
    """Return the state after one signed command."""
    command = boards.command(left, right)
    stamped = command._replace(host_us=round(boards.now_us) % 2**32, tag=bytes(8))
    return boards.request(signer.sign(stamped), None, gap)


# -- key ------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_key_from_the_console_makes_a_keyed_link(boards: avr_boards.Boards) -> None:
    boards.start()
    assert avr_boards.request(boards, frames.Key(1)) == [
        frames.KeyState(1, frames.OK, frames.NO_KEY, 0)
    ]
    # The simulator writes a cell in 0.4 ms, the chip in 3.4 ms: soon after, it would be done.
    assert avr_boards.request(boards, frames.Key(2, KEY), 0.003) == []
    assert avr_boards.request(boards, frames.Key(3, OTHER), 0.0035) == [
        frames.KeyState(3, frames.BUSY, frames.KEY_DAMAGED, 0)
    ]
    assert boards.hello().session == 0  # locked during the write
    begun = boards.now_us
    reply: list[Any] = []
    while not reply:
        boards.run(0.005)
        reply = avr_boards.console_output(boards)
    print(f'\nwritten and verified after {(boards.now_us - begun) / 1000 + 10:.0f} ms')
    assert reply == [frames.KeyState(2, frames.OK, frames.KEY_HELD, key_check(KEY))]
    assert boards.eeprom(KEY_ADDRESS, 18) == KEY + crc16(KEY).to_bytes(2, 'little')
    assert boards.eeprom(MARK_ADDRESS, 1) == b'\xff'
    assert boards.hello().session == 0  # unsigned
    assert begin_session(boards, OTHER) is None
    signer = begin_session(boards, KEY)
    assert signer is not None
    late = 0
    for _ in range(30):
        late += signed(boards, signer, 4000, 4000).seq != boards.seq
        boards.run(0.015)
    assert late <= 1  # in one of some hundred phases an answer misses its packet
    assert min(boards.pulses()) > 100
    assert avr_boards.request(boards, frames.Key(4, OTHER)) == [
        frames.KeyState(4, frames.BUSY, frames.KEY_HELD, key_check(KEY))
    ]
    boards.call('reset', avr_boards.ROBOT)
    boards.run(0.15)
    assert avr_boards.request(boards, frames.Key(5)) == [
        frames.KeyState(5, frames.OK, frames.KEY_HELD, key_check(KEY))
    ]
    assert begin_session(boards, KEY) is not None
    assert avr_boards.request(boards, frames.Key(6, bytes(16)), WRITING) == [
        frames.KeyState(6, frames.OK, frames.NO_KEY, 0)
    ]
    assert boards.hello().session == boards.session
    assert boards.eeprom(KEY_ADDRESS, 18) == b'\xff' * 18
    assert boards.call('usb_overruns') == 0


@pytest.mark.long
def test_a_flood_on_the_console_does_not_delay_replies(boards: avr_boards.Boards) -> None:
    """50 000 bytes per second, frames and noise, while the robot verifies tags and drives.

    The POLL fetches the reply to its own CMD; in one of several runs, one in a hundred was a cycle
    old.
    """
    boards.store(KEY_ADDRESS, KEY + crc16(KEY).to_bytes(2, 'little'))
    boards.run(0.13)
    signer = begin_session(boards, KEY)
    assert signer is not None
    source = random.Random(1)
    ping = encode_frame(codec.encode(frames.Ping(1, b'ping')))
    times, late = [], 0
    for number in range(40):
        flood = b''.join(
            ping if source.random() < 0.5 else source.randbytes(12) for _ in range(70)
        )
        boards.call('usb_write', flood[:1000], 1000)
        begun = boards.now_us
        state = signed(boards, signer, 5000, -5000)
        assert state is not None, number
        late += state.seq != boards.seq
        times.append((boards.now_us - begun) / 1000)
        boards.run_until(begun + 20000)
    print(f'\nflood: round trip {statistics.median(times):.2f} ms, {max(times):.2f} ms (longest)')
    assert max(times) <= 7.0
    assert late <= 1
    assert boards.call('resets', avr_boards.ROBOT) == 0
    boards.run(0.1)  # of its buffer of 256 bytes the robot takes one frame in 2 ms
    for _ in range(2):  # they end the partial frame; the first may be lost with the flood
        boards.call('usb_write', b'\0', 1)
        boards.run(0.01)
    while avr_boards.console_output(boards):
        pass
    (pong,) = avr_boards.request(boards, frames.Ping(9, b'ping'))
    print(f'console overruns: {pong.overruns} counted, {boards.call("usb_overruns")} bytes')
    assert pong.overruns > 0
    boards.run(0.4)
    avr_boards.odometry_agrees(boards)


# -- radio rates ----------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize('rate', ['250k', '1M', '2M'])
def test_cycles_work_at_every_rate(rate: str) -> None:
    """The robot by its settings, the dongle by CFG; open and signed, with refreshes and losses."""
    avr_boards.build()
    parameters = LinkParameters(rate=rate)
    wanted, gap = parameters.configure(1), parameters.gap
    boards = avr_boards.Boards()
    for address in avr_boards.SETTINGS_ADDRESSES:
        boards.store(address, avr_boards.settings_record(rate=rate))
    boards.run(0.13)
    assert boards.ask(wanted) == (*wanted, 1)
    greeting = frames.Hello(boards.session, 0)
    assert boards.request(greeting, frames.Poll(0, 0, 2), gap).session == boards.session
    boards.request(frames.Poll(0, 0, 0), None, gap)
    times, ages = [], []
    for phase in range(0, 4000, 160):
        begun = boards.now_us
        command = boards.command(4000, 4000)
        state = boards.request(command, None, gap)
        assert state.seq == command.seq, f'phase {phase} us'
        times.append((boards.now_us - begun) / 1000)
        ages.append(10 * state.age)
        assert boards.call('waiting_acks') <= 1
        boards.run(0.0956 + phase / 1e6)
    print(f'\n{rate}: round trip {statistics.median(times):.2f} ms, {max(times):.2f} ms')
    print(f'state sampled {statistics.median(ages)} us after its command')
    assert max(times) < 12.0
    assert max(ages) < 4000
    # A refresh concurrent with a packet costs at most one acknowledgement.
    before = boards.radio(avr_boards.ROBOT).ack_damaged
    boards.call('loss', 0.2, 0.2)
    for _ in range(120):
        command = boards.command()
        result = boards.exchange(command, None, gap)
        if result.second & 2:
            assert codec.decode_uplink(result.payload).seq == command.seq
        boards.run(0.005)
    counts = boards.radio(avr_boards.ROBOT)
    assert counts.duplicates > 10
    assert counts.ack_damaged == before <= 1
    boards.call('loss', 0.0, 0.0)
    boards.request(boards.command(0, 0)._replace(flags=0), None, gap)
    boards.run(1.0)
    assert avr_boards.request(boards, frames.Key(1, KEY), WRITING)[0].rc == frames.OK
    signer = begin_session(
        boards, KEY, parameters.gap_after(frames.Hello(1, 0, 0, bytes(8), bytes(8)))
    )
    assert signer is not None
    boards.request(frames.Poll(0, 0, 0), None, gap)
    for _ in range(40):
        state = signed(boards, signer, 3000, 3000, gap)
        assert state.seq == boards.seq
        assert state.age != 0xFFFF
        boards.run(0.012)
    assert avr_boards.cycle(boards, 0.01) is not None
    assert (
        boards.radio(avr_boards.ROBOT).queued_acks == boards.radio(avr_boards.ROBOT).overfull == 0
    )
    boards.close()
