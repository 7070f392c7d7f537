# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Firmware core: settings in EEPROM, and the lock of a robot without valid ones."""

import ctypes
import struct

import pytest
from support.firmware_core import (
    ADDRESS,
    BUSY,
    ENABLED,
    FAILED,
    LATCHED,
    MOVING,
    NO_SESSION,
    OK,
    RANGE,
    Robot,
)

GOOD, ONE_COPY, MISSING, DAMAGED = range(4)
CELL_US = 3400
COPIES = (40, 56)
RECORD_SIZE = 11
OTHER = bytes.fromhex('c25a33a6e1')
OLD, NEW = (82, 16, ADDRESS), (100, 32, OTHER)
WRITE_US = 30 * CELL_US
BAD_SESSION = 'bad_session'


@pytest.fixture
def erased(library):
    """Return a robot that was never set up."""
    made = Robot(library, erased=True)
    made.run(1000)
    return made


def identity(robot):
    """Return state of the settings, channel, microsteps and address in INFO."""
    info = robot.request(b'\x15\0\0\2')
    microsteps, state, channel, address = struct.unpack_from('<HxBB5s', info, 10)
    return state, channel, microsteps, address


def moves(robot):
    """Return whether the robot accepts a session and follows a command."""
    robot.hello()
    robot.drive(3000, 3000, 200_000)
    moving = robot.status & MOVING
    robot.drive(0, 0, 300_000)
    robot.send(robot.command(flags=0))
    robot.run(2000)
    return bool(moving)


def test_two_robots_without_settings_follow_no_command(library):
    """Both once obeyed the first host on the default channel."""
    for _ in range(2):
        robot = Robot(library, erased=True)
        robot.run(1000)
        assert robot.hello()[1] == 0
        robot.drive(5000, 5000, 1_000_000)
        assert robot.status == NO_SESSION
        assert robot.pulses == (0, 0)
        assert not robot.call('powered')
        assert identity(robot) == (MISSING, *OLD)
        assert robot.counters()[BAD_SESSION] > 50
        robot.send(robot.command(flags=2))  # ESTOP
        assert robot.status & LATCHED


def test_settings_over_usb_unlock_the_robot_at_once(erased):
    assert erased.settings() == (OK, MISSING, *OLD)
    assert erased.settings(*NEW) == (OK, GOOD, *NEW)
    assert identity(erased) == (GOOD, *NEW)
    assert moves(erased)
    erased.call('boot', 4, ctypes.c_uint32(0))
    erased.run(1000)
    assert identity(erased) == (GOOD, *NEW)
    assert moves(erased)


def test_pong_and_info_tell_channel_address_and_build(library, robot):
    (pong,) = robot.console(b'\x03\x01ping')
    assert pong[21:] == bytes([GOOD, 82]) + ADDRESS + bytes(4)
    assert robot.request(b'\x15\0\0\2')[13:24] == bytes([GOOD, 82]) + ADDRESS + bytes(4)
    (pong,) = Robot(library, erased=True).console(b'\x03\x01ping')
    assert pong[21] == MISSING


@pytest.mark.parametrize(
    'values',
    [
        (126, 16, OTHER),
        (82, 0, OTHER),
        (82, 3, OTHER),
        (82, 512, OTHER),
        (82, 16, bytes(5)),
        (82, 16, b'\xff' * 5),
    ],
)
def test_impossible_settings_are_rejected(robot, values):
    assert robot.settings(*values) == (RANGE, GOOD, *OLD)
    assert robot.status == 0  # the session continues


def test_settings_are_written_only_at_rest_with_drivers_off(robot):
    robot.drive(3000, 3000, 200_000)
    assert robot.settings(*NEW, us=1000) == (BUSY, GOOD, *OLD)
    robot.drive(0, 0, 400_000)
    assert robot.call('powered')
    assert robot.settings(*NEW, us=1000) == (BUSY, GOOD, *OLD)
    assert robot.status == ENABLED
    robot.send(robot.command(flags=0))
    robot.run(2000)
    steps = robot.steps
    assert robot.settings(*NEW) == (OK, GOOD, *NEW)
    assert robot.status & NO_SESSION
    assert robot.steps == steps


@pytest.mark.parametrize('copy', COPIES)
def test_one_damaged_copy_is_repaired_and_two_lock(library, copy):
    for at in range(RECORD_SIZE):
        robot = Robot(library)
        robot.call('poke_eeprom', ctypes.c_uint8(copy + at), ctypes.c_uint8(0x5C))
        robot.call('boot', 4, ctypes.c_uint32(0))
        robot.call('set_cell_us', ctypes.c_uint32(CELL_US))
        robot.run(1000)
        assert identity(robot)[0] in (ONE_COPY, GOOD)
        assert moves(robot)
        robot.run(WRITE_US)
        assert identity(robot) == (GOOD, *OLD)
        for start in COPIES:
            robot.call('poke_eeprom', ctypes.c_uint8(start + at), ctypes.c_uint8(0x5C))
        robot.call('boot', 4, ctypes.c_uint32(0))
        robot.run(1000)
        assert identity(robot)[0] == DAMAGED
        assert not moves(robot)


def test_a_worn_cell_locks_the_robot_and_is_reported(library):
    for copy in COPIES:
        robot = Robot(library, erased=True)
        robot.run(1000)
        robot.call('wear', ctypes.c_uint8(copy + 3), ctypes.c_bool(True))
        assert robot.settings(*NEW) == (FAILED, DAMAGED, *OLD)
        assert not moves(robot)
