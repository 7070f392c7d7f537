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
"""Firmware core of the dongle: transactions, radio configuration, errors."""

import struct

import pytest
from support.firmware_core import SESSION, Dongle


def tx(number, first, second=b'', gap=6):
    return bytes([1, number, gap, len(first)]) + first + second


def test_one_frame_is_one_transaction_is_one_result(library):
    dongle = Dongle(library)
    dongle.write(tx(9, b'abc'))
    assert dongle.sent() == b'abc'
    dongle.reply(b'', retransmits=2)
    assert dongle.frames() == [b'\x81\x09\x21\x08' + bytes(4)]
    dongle.run(10_000)
    assert dongle.sent() == dongle.read() == b''  # no repetition without the host


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
    assert dongle.frames()[0][8:] == b''  # not the previous reply


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
    dongle.call('set_chip', False)
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
    dongle.call('bytes', b'\x01\x01\x00' + b'\x04abc\x00' + bytes(3), 11)
    dongle.call('overrun')
    assert dongle.read() == b''  # no reply to an unreadable frame
    dongle.write(b'\x03\x07ping')
    (pong,) = dongle.frames()
    assert pong[:6] == b'\x83\x07ping'
    fields = struct.unpack('<IBBBBHHHBBB5sI', pong[6:])
    assert fields == (5000, 2, 2, 1, 1, 1, 1, 1, 2, 0, 82, b'T3MPC', 0)
    dongle.write(b'\x05')
    dongle.write(b'\x03\x07pin')
    dongle.write(b'\x01\x07\x00\x00')
    assert dongle.frames() == [b'\x8f\x01\x05', b'\x8f\x02\x03', b'\x8f\x02\x01']


def test_a_cycle_returns_the_state_after_its_own_command(library, robot):
    """The POLL fetches the state sampled after the CMD of its own cycle."""
    dongle = Dongle(library)
    times = []
    for cycle in range(20):
        command = robot.command(2000, 2000)
        dongle.write(tx(cycle, command, bytes([0x25, SESSION, robot.seq, 0])))
        for _ in range(2):
            payload = dongle.sent()
            dongle.run(800)
            robot.run(400)
            fetched = robot.reply()  # before the packet replaces it
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
