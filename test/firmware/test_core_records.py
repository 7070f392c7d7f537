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
"""Firmware core: settings and calibration as records, torn at every byte; what the robot uses."""

import struct

import pytest
from support import firmware_core as core
from support.long_tests import few_of

from t3mpc_ros.emulator.robot_board import CELL_US
from t3mpc_ros.radio.protocol.frames import (
    CALIBRATION_DAMAGED,
    CALIBRATION_RECORD,
    SETTINGS_DAMAGED,
    SETTINGS_GOOD,
    SETTINGS_MISSING,
    SETTINGS_OLD,
    SETTINGS_ONE_COPY,
    SETTINGS_RECORD,
    RefusalReason,
)
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.radio.tool.eeprom_records import (
    Calibration,
    DividerCorrection,
    Estimate,
    SharpCurve,
    encode_calibration,
)
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, encode_settings

OLD_SETTINGS = encode_settings(RobotSettings())
NEW_SETTINGS = encode_settings(
    RobotSettings(
        bytes.fromhex('c25a33a6e1'),
        100,
        '250k',
        '-6',
        32,
        400,
        True,
        True,
        3.7,
        False,
        8 * ('GP2Y0A41',),
    )
)
CURVE = SharpCurve(0.3, 0.02, 0.05, 0.003)
OLD_CALIBRATION = encode_calibration(Calibration(wheel_radius=Estimate(0.0351, 1e-5)))
NEW_CALIBRATION = encode_calibration(
    Calibration(
        Estimate(0.036, 2e-5),
        Estimate(0.21, 1e-4),
        Estimate(0.98, 1e-4),
        Estimate(-0.02, 1e-4),
        DividerCorrection(0.05, -0.1, 0.02),
        8 * (CURVE,),
    )
)
NO_CALIBRATION = encode_calibration(Calibration())
RECORDS = {
    'settings': (SETTINGS_RECORD, OLD_SETTINGS, NEW_SETTINGS, (40, 72)),
    'calibration': (CALIBRATION_RECORD, OLD_CALIBRATION, NEW_CALIBRATION, (104, 192)),
}
USABLE = (SETTINGS_GOOD, SETTINGS_ONE_COPY)


@pytest.mark.parametrize('name', few_of(RECORDS))
@pytest.mark.parametrize('before', ['nothing', 'old', 'first damaged', 'second damaged'])
def test_a_write_torn_at_any_byte_leaves_no_mixture(library, name, before):
    """Power fails after each cell: the old values, the new ones, or a lock with its reason."""
    record, old, new, copies = RECORDS[name]
    blank = OLD_SETTINGS if record == SETTINGS_RECORD else NO_CALIBRATION
    found = set()
    cuts = 0
    while True:
        robot = core.Robot(library, erased=before == 'nothing')
        if before == 'nothing' and record == CALIBRATION_RECORD:
            robot.store(SETTINGS_RECORD, OLD_SETTINGS)
        if before != 'nothing':
            assert robot.store(record, old) == core.OK
        robot.reset(CELL_US)
        if before.endswith('damaged'):
            copy = copies[before == 'second damaged']
            robot.poke_eeprom(copy + 5, b'\x5c')
        result = robot.store(record, new, CELL_US // 2 + CELL_US * cuts)
        robot.reset(CELL_US)
        state, body = robot.record(record)
        drives = state in USABLE or (state, record) == (SETTINGS_MISSING, CALIBRATION_RECORD)
        if (state, body == new) not in found:
            assert robot.moves() == drives
        found.add((state, body == new))
        if state in USABLE:
            assert body in (old, new)
        elif state == SETTINGS_MISSING:
            assert before == 'nothing'
            assert body == blank
        else:
            assert (before, state, body) == ('nothing', SETTINGS_DAMAGED, blank)
            assert robot.hello()[1] == 0
            assert robot.refusal()[0] == RefusalReason.SETTINGS
            expected = CALIBRATION_DAMAGED if record == CALIBRATION_RECORD else SETTINGS_DAMAGED
            assert robot.identity()[0] == expected
        robot.run(700_000)
        assert robot.record(record) == (SETTINGS_GOOD if state in USABLE else state, body)
        cuts += 1
        assert result in (None, core.OK)
        if result == core.OK:
            break
    changed = sum(a != b for a, b in zip(old, new, strict=True))
    assert cuts > 2 * changed  # each of them was cut
    assert (SETTINGS_GOOD, True) in found
    assert before == 'nothing' or (SETTINGS_DAMAGED, False) not in found


@pytest.mark.parametrize('name', RECORDS)
@pytest.mark.parametrize('worn', [(0,), (1,), (0, 1)])
def test_a_worn_cell_locks_the_robot(library, name, worn):
    record, old, new, copies = RECORDS[name]
    for at in (*range(0, len(old) + 2, 5), len(old) + 1):
        robot = core.Robot(library)
        assert robot.store(record, old) == core.OK
        expected = new + crc16(new).to_bytes(2, 'little')
        before = old + crc16(old).to_bytes(2, 'little')
        for number in worn:
            robot.call('wear', copies[number] + at, True)
        if at and expected[at] == before[at]:
            continue
        assert robot.store(record, new) == core.FAILED
        assert robot.record(record) == (SETTINGS_DAMAGED, old)
        assert not robot.moves()


def test_settings_of_version_1_are_refused_with_their_own_state(library):
    """They lack what the robot now needs; 16 microsteps for jumpers of 8 are double speed."""
    body = bytes([1, 100, 8, 0]) + b'\xc2\x5a\x33\xa6\xe1'
    for address in (40, 56):
        robot = core.Robot(library, erased=True)
        robot.poke_eeprom(address, body + crc16(body).to_bytes(2, 'little'))
        robot.reset()
        assert robot.record(SETTINGS_RECORD) == (SETTINGS_OLD, OLD_SETTINGS)
        assert robot.identity()[0] == SETTINGS_OLD
        assert not robot.moves()
        assert robot.store(SETTINGS_RECORD, NEW_SETTINGS) == core.OK
        assert robot.moves()


def test_only_whole_and_possible_records_are_stored(robot):
    robot.stage(SETTINGS_RECORD, NEW_SETTINGS)

    def store(record, crc):
        return robot.console(struct.pack('<BBBH', 7, 9, record, crc))[0][2]

    assert store(SETTINGS_RECORD, crc16(NEW_SETTINGS) ^ 1) == core.UNKNOWN
    assert store(CALIBRATION_RECORD, crc16(NEW_SETTINGS)) == core.UNKNOWN
    assert store(9, 0) == core.UNKNOWN
    assert robot.console(bytes([6, 9, 9, 0]))[0][2] == core.UNKNOWN
    assert robot.console(bytes([6, 9, 0, 2]))[0][2] == core.UNKNOWN
    for record, good, values in (
        (SETTINGS_RECORD, NEW_SETTINGS, {0: 1, 1: 126, 2: 3, 9: 3, 10: 4, 12: 99, 13: 8, 16: 3}),
        (CALIBRATION_RECORD, NEW_CALIBRATION, {0: 2, 4: 99, 5: 0, 14: 0x7F, 19: 0, 25: 0, 28: 99}),
    ):
        for at, value in values.items():
            bad = bytearray(good)
            bad[at] = value
            if at in (5, 19, 25):
                bad[at + 1] = value  # a value without an uncertainty
            assert robot.store(record, bytes(bad), 1000) == core.RANGE, at
    assert robot.status == 0  # the session continues
    robot.drive(1000, 1000, 100_000)
    assert robot.store(CALIBRATION_RECORD, NEW_CALIBRATION, 1000) == core.BUSY
    assert robot.record(CALIBRATION_RECORD) == (SETTINGS_MISSING, NO_CALIBRATION)


def test_the_robot_uses_its_settings_and_calibration(robot):
    for channel in range(8):
        robot.call('set_adc', channel, 200)
    robot.call('set_adc', 8, 800)
    settings = RobotSettings(microsteps=8, steps_per_turn=400, invert_left=True, divider=3.0)
    settings = settings._replace(sensors=('none', 'GP2Y0A41', *6 * ('GP2Y0A21',)))
    assert robot.store(SETTINGS_RECORD, encode_settings(settings)) == core.OK
    assert robot.status & core.NO_SESSION
    robot.run(1_000_000)
    robot.hello()
    assert robot.get(core.STEPS_PER_REV) == (core.OK, 400)
    aux = robot.request(bytes([0x25, 0, 0, 1]))
    nominal = 800 / 1024 * 5000 * 3
    assert struct.unpack_from('<H', aux, 4)[0] == pytest.approx(nominal, abs=8)
    robot.drive(4000, 4000, 1_000_000)
    left, right = robot.pulses
    assert (left, right) == (-right, pytest.approx(4.0 * 3200 / 6.2832, rel=0.1))
    assert robot.steps[0] == -left  # counted in the direction of the command
    # The parameter of the session acts against the settings.
    robot.drive(0, 0, 300_000)
    assert robot.set(core.INVERT, 3) == (core.OK, 3)
    before = robot.pulses
    robot.drive(4000, 4000, 500_000)
    assert robot.pulses[0] > before[0]
    assert robot.pulses[1] < before[1]
    state = robot.request(bytes([0x25, 0, 0, 0]))
    volts = 5 * 200.5 / 1024
    # Typical values of OP13008EN: 0.4 V at 30 cm, 2.65 V at 4 cm.
    scale = (0.30 - 0.04) / (1.0 / 0.4 - 1.0 / 2.65)
    near, far = scale / volts - scale / 0.4 + 0.30, 0.282 / (volts - 0.061) - 0.0257
    expected = [0, round(200 * near), *6 * (round(200 * far),)]
    assert list(state[24:]) == expected
    robot.send(robot.command(flags=0))
    robot.run(500_000)
    calibration = Calibration(
        divider=DividerCorrection(0.05, -0.1, 0.02), curves=(*7 * (None,), CURVE)
    )
    assert robot.store(CALIBRATION_RECORD, encode_calibration(calibration)) == core.OK
    robot.run(1_000_000)
    state = robot.request(bytes([0x25, 0, 0, 0]))
    expected[7] = round(200 * (0.3 / (volts - 0.05) - 0.02))
    assert list(state[24:]) == expected
    aux = robot.request(bytes([0x25, 0, 0, 1]))
    assert struct.unpack_from('<H', aux, 4)[0] == pytest.approx(1.05 * nominal - 100, abs=9)
    (samples,) = robot.console(b'\x08\x09')
    assert struct.unpack_from('<9H', samples, 2) == (*8 * (200,), 800)


DEFAULTS, OTHERS = (82, 16, core.ADDRESS), (100, 32, bytes.fromhex('c25a33a6e1'))
"""Channel, microsteps and address."""


def test_two_robots_without_settings_follow_no_command(library):
    """Both once obeyed the first host on the default channel."""
    for _ in range(2):
        robot = core.Robot(library, erased=True)
        robot.run(1000)
        assert robot.hello()[1] == 0
        robot.drive(5000, 5000, 1_000_000)
        assert robot.status == core.NO_SESSION
        assert robot.pulses == (0, 0)
        assert not robot.call('powered')
        assert robot.identity() == (SETTINGS_MISSING, *DEFAULTS)
        assert robot.counters()['bad_session'] > 50
        robot.send(robot.command(flags=2))  # ESTOP
        assert robot.status & core.LATCHED


def test_pong_and_info_hold_channel_address_and_build(library, robot):
    (pong,) = robot.console(b'\x03\x01ping')
    assert pong[21:] == bytes([SETTINGS_GOOD, 82]) + core.ADDRESS + bytes(4)
    assert robot.request(b'\x25\0\0\2')[13:24] == bytes(
        [SETTINGS_GOOD, 82]
    ) + core.ADDRESS + bytes(4)
    (pong,) = core.Robot(library, erased=True).console(b'\x03\x01ping')
    assert pong[21] == SETTINGS_MISSING


def test_settings_are_written_only_at_rest_with_drivers_off(robot):
    for values in (
        (82, 0, core.ADDRESS),
        (82, 512, core.ADDRESS),
        (82, 16, bytes(5)),
        (82, 16, b'\xff' * 5),
    ):
        assert robot.settings(*values) == (core.RANGE, SETTINGS_GOOD, *DEFAULTS)
    robot.drive(3000, 3000, 200_000)
    assert robot.settings(*OTHERS, us=1000) == (core.BUSY, SETTINGS_GOOD, *DEFAULTS)
    robot.drive(0, 0, 400_000)
    assert robot.call('powered')
    assert robot.settings(*OTHERS, us=1000) == (core.BUSY, SETTINGS_GOOD, *DEFAULTS)
    assert robot.status == core.ENABLED
    robot.send(robot.command(flags=0))
    robot.run(2000)
    steps = robot.steps
    assert robot.settings(*OTHERS) == (core.OK, SETTINGS_GOOD, *OTHERS)
    assert robot.status & core.NO_SESSION
    assert robot.steps == steps
