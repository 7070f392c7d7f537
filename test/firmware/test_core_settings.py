# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Firmware core: settings in EEPROM, and the lock of a robot without valid ones."""

import pytest
from support.firmware_core import (
    ADDRESS,
    BUSY,
    ENABLED,
    LATCHED,
    NO_SESSION,
    OK,
    RANGE,
    Robot,
)

from t3mpc_ros.emulator.robot_board import CELL_US
from t3mpc_ros.radio.tool.robot_records import RobotSettings, encode_settings

GOOD, ONE_COPY, MISSING, DAMAGED = range(4)
COPIES = (40, 72)
RECORD_SIZE = len(encode_settings(RobotSettings())) + 2
OTHER = bytes.fromhex('c25a33a6e1')
OLD, NEW = (82, 16, ADDRESS), (100, 32, OTHER)
WRITE_US = 60 * CELL_US
BAD_SESSION = 'bad_session'


@pytest.fixture
def erased(library):
    """Return a robot that was never set up."""
    made = Robot(library, erased=True)
    made.run(1000)
    return made


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
        assert robot.identity() == (MISSING, *OLD)
        assert robot.counters()[BAD_SESSION] > 50
        robot.send(robot.command(flags=2))  # ESTOP
        assert robot.status & LATCHED


def test_settings_over_usb_unlock_the_robot_at_once(erased):
    assert erased.settings() == (OK, MISSING, *OLD)
    assert erased.settings(*NEW) == (OK, GOOD, *NEW)
    assert erased.identity() == (GOOD, *NEW)
    assert erased.moves()
    erased.reset()
    assert erased.identity() == (GOOD, *NEW)
    assert erased.moves()


def test_pong_and_info_hold_channel_address_and_build(library, robot):
    (pong,) = robot.console(b'\x03\x01ping')
    assert pong[21:] == bytes([GOOD, 82]) + ADDRESS + bytes(4)
    assert robot.request(b'\x25\0\0\2')[13:24] == bytes([GOOD, 82]) + ADDRESS + bytes(4)
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
        robot.poke_eeprom(copy + at, b'\x5c')
        robot.reset(CELL_US)
        assert robot.identity()[0] in (ONE_COPY, GOOD)
        assert robot.moves()
        robot.run(WRITE_US)
        assert robot.identity() == (GOOD, *OLD)
        for start in COPIES:
            robot.poke_eeprom(start + at, b'\x5c')
        robot.reset(CELL_US)
        assert robot.identity()[0] == DAMAGED
        assert not robot.moves()
