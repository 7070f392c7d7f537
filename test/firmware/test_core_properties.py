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
"""Firmware core: every bit flip of a frame on a serial line, and the wrap of every counter."""

import ctypes

import pytest
from support.firmware_core import ADDRESS, COUNTERS, INFO_SIZE, KEY, OK, Dongle, Robot

from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import SETTINGS_RECORD, Configure, Key, Store, Transmit
from t3mpc_ros.radio.protocol.framing import crc16, encode_frame
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, encode_settings


def damaged(frame):
    """Yield each wire form of a frame with one bit flipped, or one byte lost or doubled."""
    wire = encode_frame(frame)
    for bit in range(8 * len(wire)):
        flipped = bytearray(wire)
        flipped[bit // 8] ^= 1 << bit % 8
        yield bytes(flipped)
    for at in range(len(wire) - 1):
        yield wire[:at] + wire[at + 1 :]
        if wire[at : at + 1] * 2 not in (wire[at : at + 2], b'\0\0'):
            yield wire[: at + 1] + wire[at:]


# -- bits -----------------------------------------------------------------------------------------


def test_no_damaged_frame_sends_or_configures_anything(library):
    dongle = Dongle(library)
    transmit = encode(Transmit(9, 6, bytes(range(14)), b'poll'))
    configure = encode(Configure(9, 100, 2, 1, 3, 5, b'other'))
    configured = dongle.call('configured')
    tried = 0
    for frame in (transmit, configure):
        for wire in damaged(frame):
            dongle.call('bytes', wire + b'\0', len(wire) + 1)
            assert dongle.sent() == b''
            assert dongle.call('configured') == configured
            tried += 1
    assert tried > 400
    dongle.write(transmit)
    assert dongle.sent() == bytes(range(14))


def test_no_damaged_frame_writes_a_key_or_settings(library):
    robot = Robot(library)
    robot.run(1000)
    before = robot.settings(), robot.console(b'\x04\x01')
    settings = encode_settings(RobotSettings(ADDRESS[::-1], 100))
    robot.stage(SETTINGS_RECORD, settings)
    writes = robot.call('eeprom_writes')
    for frame in (encode(Key(9, KEY)), encode(Store(9, SETTINGS_RECORD, crc16(settings)))):
        for wire in damaged(frame):
            robot.call('usb', wire + b'\0', len(wire) + 1)
            robot.run(400)
            assert robot.call('eeprom_writes') == writes
    robot.call('usb_take', ctypes.create_string_buffer(4096), 4096)
    assert (robot.settings(), robot.console(b'\x04\x01')) == before
    assert robot.store(SETTINGS_RECORD, settings) == OK
    assert robot.settings()[2:] == (100, 16, ADDRESS[::-1])


# -- wraps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'name, packet',
    [
        ('received', b'\x25\0\0\0'),
        ('bad_version', b'\x3f'),
        ('malformed', b'\x2f'),
        ('bad_session', b'\x22\0\0\0'),
    ],
)
def test_each_counter_of_packets_wraps_alone(robot, name, packet):
    before = robot.counters()
    send, size = robot.library.t3_host_robot_packet, len(packet)
    for _ in range(1 << 16):
        send(robot._object, packet, size)
    after = robot.counters()
    assert after[name] == (before[name] + (name == 'received')) % (1 << 16)
    for other in set(COUNTERS) - {name, 'received'}:
        assert after[other] == before[other]


def test_no_nonce_repeats_when_the_counter_of_boots_wraps(library):
    robot = Robot(library, KEY)
    robot.store_boots((1 << 32) - 3)
    seen = set()
    for _ in range(6):
        robot.call('boot', 1, 0)
        robot.run(1000)
        for nonce in (b'first...', b'second..'):
            seen.add(robot.hello(nonce=nonce)[INFO_SIZE:])
    assert len(seen) == 12


def test_the_clock_of_the_dongle_wraps_within_a_gap(library):
    dongle = Dongle(library)
    start = (1 << 32) - 1000
    dongle.call('tick', start)
    dongle.write(encode(Transmit(9, 8, b'first', b'second')))
    assert dongle.sent() == b'first'
    dongle.reply(b'state')
    for us in (0, 999, 1999):
        dongle.call('tick', (start + us) % (1 << 32))
        assert dongle.sent() == b''
    dongle.call('tick', (start + 2000) % (1 << 32))
    assert dongle.sent() == b'second'
    for us in (2000, 151_999):
        dongle.call('tick', (start + us) % (1 << 32))
        assert dongle.frames() == []
    dongle.call('tick', (start + 152_000) % (1 << 32))
    ((kind, number, first, second, *_),) = dongle.frames()
    assert (kind, number, first, second) == (0x81, 9, 3, 4)
