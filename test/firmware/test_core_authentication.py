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
"""Firmware core: signed sessions and attacks on them."""

import random
import struct

from support import firmware_core as core

from t3mpc_ros.radio.protocol.authentication import siphash


def test_a_key_at_one_end_only_is_rejected_and_reported(library, robot, keyed):
    unsigned = struct.pack('<BBBB', 0x24, 7, 0, 0)
    info = keyed.request(unsigned)
    assert (info[0], info[1], len(info)) == (0x23, core.SESSION, core.INFO_SIZE + 8)
    signed = struct.pack('<BBBBI', 0x24, 7, 0, 1, 0) + bytes(8)
    info = robot.request(signed + siphash(core.KEY, signed))
    assert (info[0], info[1], len(info)) == (0x23, core.SESSION, core.INFO_SIZE)
    assert keyed.counters()['bad_session'] == robot.counters()['bad_session'] == 1
    keyed.session_key = b''
    keyed.drive(5000, 5000, 100_000)
    assert keyed.status == 0
    robot.send(robot.command(5000, 5000) + bytes(8))
    robot.run(10_000)
    assert robot.status == 0


def test_a_signed_session_drives_and_writes_parameters(keyed):
    keyed.drive(5000, 5000, 1_000_000)
    assert keyed.status == core.ENABLED | core.MOVING
    keyed.run(20_000)
    assert keyed.set(core.MAX_SPEED, 3000) == (core.OK, 3000)
    keyed.run(20_000)
    assert keyed.act(2, seq=1)[4] == core.OK
    keyed.drive(5000, 5000, 500_000)
    assert keyed.speeds == (3.0, 3.0)
    assert keyed.counters()['bad_session'] == 0


def test_a_new_hello_draws_a_nonce_and_a_repeated_one_does_not(keyed):
    first = keyed.hello()
    keyed.drive(5000, 5000, 500_000)
    assert keyed.hello()[core.INFO_SIZE :] == first[core.INFO_SIZE :]
    assert keyed.status == core.ENABLED | core.MOVING
    keyed.drive(5000, 5000, 100_000)
    assert keyed.status == core.ENABLED | core.MOVING
    seen = {first[core.INFO_SIZE :]}
    for index in range(200):
        seen.add(keyed.hello(nonce=index.to_bytes(8, 'big'))[core.INFO_SIZE :])
        if index % 20 == 0:
            keyed.call('boot', 1, 0)  # same time, empty RAM
    assert len(seen) == 201


def test_a_nonce_of_the_robot_is_no_tag_of_a_hello(library):
    """Both are hashes under the long-term key; without a separation this HELLO was accepted.

    The robot draws its nonce from its counters and clock, 16 bytes as many as a HELLO has before
    its tag: some values of the counter of boots are the beginning of a HELLO.
    """
    robot = core.Robot(library, core.KEY)
    session, first_noise = 0x5B, 1013904223
    boots = 0x0100_0014 | session << 8
    robot.store_boots(boots - 1)
    robot.call('boot', 4, 0)
    robot.run(1000)
    forged = struct.pack('<IIII', boots, 1, robot.now, first_noise)
    info = robot.hello()
    assert info[1] == core.SESSION
    assert robot.request(forged + info[core.INFO_SIZE :])[1] == core.SESSION


def test_a_damaged_key_locks_the_robot(library):
    for address in range(8, 26):
        robot = core.Robot(library, core.KEY)
        robot.call('poke_eeprom', address, 0x55)
        robot.call('boot', 1, 0)
        info = robot.hello()
        assert (info[1], len(info)) == (0, core.INFO_SIZE + 8)
        robot.key, robot.session_key = b'', b''
        assert robot.hello()[1] == 0
        robot.drive(5000, 5000, 100_000)
        assert robot.status == core.NO_SESSION


def test_signed_clock_may_wrap_but_not_decrease(library):
    robot = core.Robot(library, core.KEY)
    robot.run(1000)
    robot.delay = robot.now + 5_000_000  # the clock of the host wraps 5 s from now
    robot.hello()
    accepted = []
    for index in range(500):
        robot.run(20_000)
        epoch = int(index * 20_000 + 21_000 > 5_000_000)
        accepted.append(robot.command(1000, 1000, epoch=epoch))
        robot.send(accepted[-1])
    assert robot.counters()['bad_session'] == 0
    assert robot.status == core.ENABLED | core.MOVING
    for frame in accepted:
        robot.send(frame)
    assert robot.counters()['bad_session'] == 500


def damage(generator, recorded):
    """Return a recorded frame: replayed, forged or altered."""
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
            at = generator.choice((10, len(frame) - 12))  # echo_us of a CMD, host_us
            frame[at : at + 4] = generator.randbytes(4)
    return bytes(frame)


def test_no_forged_replayed_or_altered_frame_is_executed(library):
    """100 000 attempts by an attacker who has recorded two sessions but does not have the key.

    A frame altered into an emergency stop is executed, because stopping is always allowed; a valid
    frame clears it again.
    """
    generator = random.Random(5)
    robot = core.Robot(library, core.KEY)
    robot.run(1000)
    recorded = []
    for nonce in (bytes(8), bytes(range(8))):
        robot.hello(nonce=nonce)
        for index in range(100):
            robot.run(20_000)
            if index % 10 == 9:
                body = struct.pack('<BBBBi', 0x23, core.SESSION, 9, 0, 5000 + index)
            else:
                body = None
            frame = robot.sign(body) if body else robot.command(3000, -3000)
            robot.send(frame)
            recorded.append(frame)
    assert robot.get(core.MAX_SPEED) == (core.OK, 5099)
    robot.send(robot.command(0, 0, flags=0))
    robot.run(1_000_000)
    assert robot.status == 0
    pulses, stops = robot.pulses, 0
    for _ in range(100_000):
        frame = damage(generator, recorded)
        robot.send(frame)
        if frame[0] in (0x11, 0x21) and frame[3] & core.ESTOP:
            stops += 1
            assert robot.status == core.LATCHED
            robot.run(1000)
            robot.send(robot.command(flags=core.CLEAR))
        assert robot.status == 0, frame.hex()
        robot.run(400)
    assert robot.pulses == pulses
    assert robot.get(core.MAX_SPEED) == (core.OK, 5099)
    assert stops > 100
    robot.drive(3000, 3000, 100_000)
    assert robot.status == core.ENABLED | core.MOVING
