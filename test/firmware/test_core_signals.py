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
"""Firmware core: LED and buzzer, and the log of resets and faults."""

import ctypes

import pytest
from support.firmware_core import FAILED, OK, Robot

from t3mpc_ros.radio.protocol.frames import LOG_RECORD, SETTINGS_MISSING, SETTINGS_RECORD
from t3mpc_ros.radio.tool.robot_info import LogKind, decode_log, format_log
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, encode_settings

LED, BUZZER = 1, 2
STEP_US = 100_000
BOOT_US = 1_000_000
CELL_US = 3400


def levels(robot, steps=20):
    """Return the levels of LED and buzzer every 0.1 s."""
    found = []
    for _ in range(steps):
        robot.run(STEP_US)
        found.append(robot.call('levels'))
    return found


def flashes(robot):
    """Return flashes and beeps of 2 s."""
    found = levels(robot)
    edges = list(zip([found[-1], *found], found, strict=False))
    return tuple(
        sum(not before & bit and bool(after & bit) for before, after in edges)
        for bit in (LED, BUZZER)
    )


def log(robot):
    places = []
    for place in range(16):
        (frame,) = robot.console(bytes([6, 9, LOG_RECORD, place]))
        assert frame[:4] == bytes([0x86, 9, OK, LOG_RECORD])
        places.append(frame[7:])
    return decode_log(places)


def kinds(robot):
    return [entry.kind for entry in log(robot)]


def boot(robot, cause=4):
    robot.call('boot', cause, 0)
    robot.run(2000)


def test_states_without_a_fault_have_their_own_patterns(library):
    robot = Robot(library)
    assert set(levels(robot, 9)) == {LED}  # booting
    robot.run(BOOT_US)
    assert flashes(robot) == (1, 0)  # no session: a long one
    assert sum(levels(robot)) == 10
    robot.hello()
    robot.run(STEP_US)
    assert sum(levels(robot)) == 19  # standing in a session: a short gap
    robot.drive(1000, 1000, 200_000)
    assert [robot.call('levels')] == [LED]


@pytest.mark.parametrize('count', [2, 3, 4, 5, 6])
def test_a_fault_flashes_and_beeps_its_number(library, count):
    robot = Robot(library, erased=count == 3)
    robot.hello()
    registers = (ctypes.c_int16 * 7)()
    if count == 2:
        robot.send(robot.command(flags=2))
    elif count == 4:
        robot.call('set_imu', False, registers)
    elif count == 5:
        robot.call('set_chip', False)
    elif count == 6:
        robot.call('set_adc', 8, 500)
    robot.run(BOOT_US)
    first = flashes(robot)
    assert first[0] == count
    assert first[1] in (count - 1, count)  # it may have begun
    assert flashes(robot) == (count, 0)


def test_every_fault_beeps_however_long_the_robot_has_stood(library):
    """The beeps of a fault count from its beginning, not from that of the state before it."""
    robot = Robot(library)
    for _ in range(2):
        robot.hello()
        robot.run(10 * BOOT_US)
        robot.send(robot.command(flags=2))
        assert flashes(robot) == (2, 2)
        robot.send(robot.command(flags=4))


def test_a_low_battery_beeps_again(library):
    robot = Robot(library)
    robot.hello()
    robot.call('set_adc', 8, 500)
    robot.run(BOOT_US)
    beeps = [bool(level & BUZZER) for level in levels(robot, 20 * 31)]
    assert 12 <= sum(beeps) <= 18
    assert any(beeps[20 * 14 :])


def test_resets_and_faults_are_logged_once_a_boot(library):
    robot = Robot(library)
    robot.call('set_cell_us', CELL_US)
    boot(robot, 8)
    for _ in range(3):
        robot.hello()
        robot.drive(1000, 1000, 100_000)
        robot.run(1_000_000)  # expires
        robot.send(robot.command(flags=2))
        robot.run(200_000)
        robot.send(robot.command(flags=4))
    assert kinds(robot) == [LogKind.BOOT, LogKind.BOOT, LogKind.EXPIRED, LogKind.ESTOP]
    assert log(robot)[1].value == 8
    writes = robot.call('eeprom_writes')
    robot.run(5_000_000)
    assert robot.call('eeprom_writes') == writes
    text = format_log(log(robot))
    assert 'boot: watchdog' in text
    assert 'emergency stop' in text


def test_only_a_much_longer_pass_is_logged_again(library):
    robot = Robot(library)
    robot.run(100_000)
    for us in (1500, 5000, 5500, 7000, 8000, 90_000, 90_000):
        robot.call('stall', us)
        robot.run(100_000)
    passes = [entry.value for entry in log(robot) if entry.kind == LogKind.LOOP]
    assert passes == [pytest.approx(5000, abs=400), pytest.approx(8000, abs=400), 65_535]


def test_the_ring_keeps_the_newest_and_survives_torn_entries(library):
    robot = Robot(library)
    robot.call('set_cell_us', CELL_US)
    for number in range(40):
        boot(robot)
        robot.run(100_000 if number % 3 else 20_000)  # every third is torn
        numbers = [entry.number for entry in log(robot)]
        assert numbers == sorted(numbers)
        assert len(numbers) <= 16
        assert set(kinds(robot)) == {LogKind.BOOT}
    assert len(numbers) > 8
    assert numbers[-1] > 25


def test_a_locked_robot_logs_the_reason(library):
    robot = Robot(library, erased=True)
    robot.run(2_000_000)
    assert (log(robot)[-1].kind, log(robot)[-1].value) == (LogKind.RECORDS, SETTINGS_MISSING)
    assert robot.store(SETTINGS_RECORD, encode_settings(RobotSettings())) != FAILED
    assert robot.console(bytes([6, 9, LOG_RECORD, 16]))[0][2] != OK
    assert robot.console(bytes([6, 9, LOG_RECORD, 0]) + bytes(16))[0][2] != OK
