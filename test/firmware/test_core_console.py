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
"""Firmware core: key over the USB console, and power losses while it is written."""

import ctypes

import pytest
from support import firmware_core as core

from t3mpc_ros.emulator.robot_board import CELL_US
from t3mpc_ros.radio.protocol.authentication import key_check
from t3mpc_ros.radio.protocol.codec import decode_from_board, encode
from t3mpc_ros.radio.protocol.frames import (
    KEY_DAMAGED,
    KEY_HELD,
    NO_KEY,
    Key,
    KeyState,
    Refusal,
)

OTHER = bytes(range(0x20, 0x30))
KEY_US = 45 * CELL_US
"""Time to write a key, both marks, the counter of boots and an entry of the log."""


def made(library, key=b'', erased=False):
    """Return a robot that writes its EEPROM as slowly as a real one."""
    robot = core.Robot(library, key, erased=erased)
    robot.call('set_cell_us', CELL_US)
    robot.run(200_000)  # it writes its log and, with a key, the counter of boots
    return robot


def request(robot, frame, us=1000):
    """Send a frame to the console; return the replies within a time."""
    return [decode_from_board(reply) for reply in robot.console(encode(frame), us)]


def lose_power(robot):
    robot.call('boot', 4, 0)
    robot.run(1000)
    robot.call('usb_take', ctypes.create_string_buffer(4096), 4096)


def begins_session(robot, key):
    """Return whether a host with this key can begin a session."""
    robot.key, robot.session_key = key, b''
    return robot.hello()[1] == core.SESSION


def test_a_key_from_the_console_locks_out_other_hosts_at_once(library):
    robot = made(library)
    assert request(robot, Key(1)) == [KeyState(1, core.OK, NO_KEY, 0)]
    assert request(robot, Key(2, core.KEY)) == []
    assert request(robot, Key(3, OTHER)) == [KeyState(3, core.BUSY, KEY_DAMAGED, 0)]
    assert not begins_session(robot, b'')
    robot.run(KEY_US)
    assert request(robot, Key(4))[0] == KeyState(2, core.OK, KEY_HELD, key_check(core.KEY))
    assert not begins_session(robot, b'')
    assert not begins_session(robot, OTHER)
    assert begins_session(robot, core.KEY)
    lose_power(robot)
    assert request(robot, Key(4)) == [KeyState(4, core.OK, KEY_HELD, key_check(core.KEY))]
    assert request(robot, Key(5, bytes(16)), KEY_US) == [KeyState(5, core.OK, NO_KEY, 0)]
    assert begins_session(robot, b'')


def test_no_key_is_written_while_the_drivers_have_power(library):
    robot = made(library)
    robot.hello()
    robot.send(robot.command(3000, 3000, ttl=5))
    busy = KeyState(1, core.BUSY, NO_KEY, 0)
    assert request(robot, Key(1, core.KEY), 400) == [busy]
    robot.run(20_000)
    assert request(robot, Key(1, core.KEY)) == [busy]
    robot.run(1_000_000)  # the TTL has expired, the drivers are on
    assert robot.speeds == (0.0, 0.0)
    assert robot.status & core.ENABLED
    assert request(robot, Key(1, core.KEY)) == [busy]
    robot.send(robot.command(flags=0))
    robot.run(1000)
    assert request(robot, Key(1, core.KEY), KEY_US) == [
        KeyState(1, core.OK, KEY_HELD, key_check(core.KEY))
    ]
    assert robot.status & core.NO_SESSION


@pytest.mark.parametrize('before', [b'', core.KEY], ids=['none', 'another'])
@pytest.mark.parametrize('after', [bytes(16), OTHER], ids=['none', 'one'])
def test_power_loss_leaves_the_old_key_the_new_key_or_a_lock(library, before, after):
    """Power fails at every cell; a locked robot stops on ESTOP, and accepts a new key."""
    states = set()
    for cut_us in range(CELL_US // 2, 22 * CELL_US, CELL_US):
        robot = made(library, before)
        request(robot, Key(1, after), cut_us)
        lose_power(robot)
        ((number, rc, state, check),) = request(robot, Key(2))
        assert (number, rc) == (2, core.OK)
        kept = check == key_check(before) if before else state == NO_KEY
        changed = check == key_check(after) if any(after) else state == NO_KEY
        assert kept or changed or state == KEY_DAMAGED
        states.add('kept' if kept else 'changed' if changed else 'damaged')
        if state == KEY_DAMAGED:
            assert not any(begins_session(robot, key) for key in (b'', core.KEY, OTHER))
            robot.session_key = b''
            robot.send(robot.command(flags=2))
            assert robot.status == core.LATCHED | core.NO_SESSION
            expected = KeyState(3, core.OK, KEY_HELD, key_check(core.KEY))
            assert request(robot, Key(3, core.KEY), KEY_US) == [expected]
    assert states == (
        {'kept', 'damaged', 'changed'} if before or any(after) else {'kept'} | states
    )


def test_frames_for_a_dongle_are_refused(library):
    robot = made(library)
    # 5 was SETTINGS once.
    for frame in (b'\x02\x00', b'\x05\x01'):
        assert decode_from_board(robot.console(frame)[0]) == Refusal(1, frame[0])
    for kind in (b'\x04', b'\x06', b'\x07', b'\x08'):
        assert decode_from_board(robot.console(kind)[0]) == Refusal(2, kind[0])


@pytest.mark.parametrize('address', [8, 20, 25, 26])
def test_a_worn_cell_is_reported_and_locks_the_robot(library, address):
    robot = made(library)
    robot.call('wear', address, True)
    assert request(robot, Key(1, core.KEY), KEY_US) == [KeyState(1, core.FAILED, KEY_DAMAGED, 0)]
    assert not begins_session(robot, b'')
