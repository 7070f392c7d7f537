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
"""Firmware core: parameters, actions, and the replies to each packet."""

import ctypes
import struct

import pytest
from support import firmware_core as core

from t3mpc_ros.robot.sensor_parameters import encode_range
from t3mpc_ros.simulation.sensors import range_sensor

BOUNDS = {
    core.MAX_SPEED: (0, 19_600),
    core.ACCELERATION: (100, 100_000),
    core.DECELERATION: (100, 200_000),
    core.TTL_MAX: (20, 500),
    core.BATTERY_LOW: (0, 30_000),
    core.CUTOFF: (0, 30_000),
    core.IDLE_OFF: (0, 600_000),
    core.INVERT: (0, 3),
}


@pytest.mark.parametrize('number', BOUNDS)
def test_parameters_keep_their_bounds(robot, number):
    low, high = BOUNDS[number]
    assert robot.set(number, low) == (core.OK, low)
    assert robot.set(number, high) == (core.OK, high)
    for value in (low - 1, high + 1, -(1 << 31), (1 << 31) - 1):
        assert robot.set(number, value) == (core.RANGE, high)
    assert robot.get(number) == (core.OK, high)
    reply = robot.request(bytes([0x22, core.SESSION, 44, number]))
    assert reply[2] == 44
    assert struct.unpack_from('<ii', reply, 9) == (low, high)


def test_read_only_and_unknown_parameters_are_rejected(robot):
    assert robot.set(core.STEPS_PER_REV, 400) == (core.READ_ONLY, 200)
    assert robot.set(core.GYRO_RANGE, 250) == (core.READ_ONLY, 500)
    assert robot.set(core.MICROSTEPS, 8) == (core.READ_ONLY, 16)
    assert robot.set(core.BOOTS, 1)[0] == core.READ_ONLY
    for number in (12, 13, 128, 255):
        assert robot.set(number, 1) == (core.UNKNOWN, 0)
        assert robot.get(number) == (core.UNKNOWN, 0)


def test_the_count_of_starts_changes_with_each_start_only(library):
    """Modulo 2**31; a key that is written does not count."""
    robot = core.Robot(library)

    def boots():
        robot.run(200_000)  # the EEPROM is written
        robot.hello()
        return robot.get(core.BOOTS)[1]

    before = boots()
    robot.console(b'\x04\x09' + bytes(range(16)), 500_000)
    robot.console(b'\x04\x0a' + bytes(16), 500_000)
    assert boots() == before
    for count in range(1, 4):
        robot.call('boot', 2, 0)
        assert boots() == (before + count) % 2**31


def test_a_lost_count_of_starts_does_not_begin_where_it_was(library):
    robot = core.Robot(library)
    robot.run(200_000)
    robot.hello()
    before = robot.get(core.BOOTS)[1]
    robot.call('poke_eeprom', 33, 0x5A)  # its CRC is wrong now
    robot.call('set_noise', 777)
    robot.call('boot', 2, 0)
    robot.hello()
    assert robot.get(core.BOOTS)[1] not in (before, before + 1)


def test_the_direction_changes_only_at_rest(robot):
    robot.drive(1000, 1000, 100_000)
    assert robot.set(core.INVERT, 2) == (core.BUSY, 0)
    assert robot.set(core.INVERT, 0) == (core.OK, 0)  # rewritten by the host after a reconnection
    robot.drive(0, 0, 300_000)
    assert robot.set(core.INVERT, 2) == (core.OK, 2)


def test_odometry_is_reset_only_at_rest(robot):
    robot.drive(1000, 1000, 500_000)
    assert robot.act(1, seq=1) == bytes([0x24, core.SESSION, 1, 1, core.BUSY])
    robot.drive(0, 0, 300_000)
    assert min(robot.steps) > 100
    assert robot.act(1, seq=2) == bytes([0x24, core.SESSION, 2, 1, core.OK])
    assert robot.steps == (0, 0)
    assert robot.act(3, seq=3) == bytes([0x24, core.SESSION, 3, 3, core.UNKNOWN])


def test_a_repeated_action_is_acknowledged_but_runs_once(robot):
    """The reply was lost, the host repeats the request, the robot has moved meanwhile."""
    assert robot.act(1, seq=7)[4] == core.OK
    robot.drive(1000, 1000, 500_000)
    robot.drive(0, 0, 300_000)
    steps = robot.steps
    assert robot.act(1, seq=7)[4] == core.OK
    assert robot.steps == steps
    assert robot.act(1, seq=8)[4] == core.OK
    assert robot.steps == (0, 0)


def test_reply_to_each_kind_of_packet(robot):
    kinds = {
        'CMD': (robot.command(), 0x21),
        'PARAM_GET': (bytes([0x22, core.SESSION, 1, 0]), 0x22),
        'PARAM_SET': (struct.pack('<BBBBi', 0x23, core.SESSION, 1, 0, 1), 0x22),
        'POLL state': (b'\x25\0\1\0', 0x21),
        'POLL aux': (b'\x25\0\1\1', 0x25),
        'POLL info': (b'\x25\0\1\2', 0x23),
        'ACTION': (struct.pack('<BBBBH', 0x26, core.SESSION, 1, 2, 0), 0x24),
        'HELLO': (bytes([0x24, core.SESSION, 1, 0]), 0x23),
        'other session': (bytes([0x22, 3, 1, 0]), 0x21),
        'other version': (b'\x35\0\1\1', 0x21),
        'nothing': (b'', 0x21),
    }
    for name, (data, head) in kinds.items():
        reply = robot.request(data)
        assert reply[0] == head, name
        if name in ('CMD', 'PARAM_GET', 'PARAM_SET', 'POLL info', 'ACTION', 'HELLO'):
            assert reply[1] == core.SESSION
    assert len(robot.reply()) == 32


def test_a_reply_is_loaded_after_the_acknowledgement_is_sent(robot):
    robot.run(5000)
    loads = robot.call('loads')
    robot.send(robot.command())
    robot.run(500)
    assert robot.call('loads') == loads
    robot.run(400)
    assert robot.call('loads') == loads + 1
    state = robot.reply()
    # Sampled after the settling time; STATE contains its age.
    assert 60 <= struct.unpack_from('<H', state, 22)[0] <= 90
    robot.run(99_000)
    assert robot.call('loads') == loads + 1
    robot.run(2_000)
    assert robot.call('loads') == loads + 2


def test_the_age_is_none_when_it_does_not_fit(robot):
    assert robot.request(b'\x25\0\0\0')[22:24] == b'\xff\xff'
    robot.send(robot.command())
    robot.run(600_000)
    assert struct.unpack_from('<H', robot.request(b'\x25\0\0\0'), 22)[0] == pytest.approx(
        60_080, abs=40
    )
    robot.run(60_000)
    assert robot.request(b'\x25\0\0\0')[22:24] == b'\xff\xff'


def test_state_contains_the_sensor_readings(robot):
    seven = (ctypes.c_int16 * 7)(164, -5, 8192, -4000, -12, 13, -131)
    robot.call('set_imu', True, seven)
    for channel, count in enumerate((0xFFFF, 0xFFFE, 300, 150, 600, 60, 0, 1023)):
        robot.call('set_adc', channel, count)
    robot.run(10_000)  # one channel per millisecond
    state = robot.request(b'\x25\0\0\0')
    assert struct.unpack_from('<hhh', state, 16) == (-131, 164, -5)
    parameters = range_sensor.SimulatedRangeSensorParameters()
    middle = [
        encode_range(range_sensor.distance_from_voltage(parameters.volts(count)))
        for count in (300, 150)
    ]
    assert list(state[24:]) == [0, 255, *middle, 1, 254, 254, 255]
    robot.call('set_adc', 8, 522)
    robot.run(100_000)  # the first measurement
    aux = robot.request(b'\x25\0\0\1')
    assert struct.unpack_from('<Hhhhh', aux, 4) == (10_195, -4000, 8192, -12, 13)
    assert robot.status & core.LOW_BATTERY
    assert robot.set(core.BATTERY_LOW, 10_000)[0] == core.OK
    assert not robot.status & core.LOW_BATTERY
    robot.call('set_imu', False, seven)
    state = robot.request(b'\x25\0\0\0')
    assert state[3] & core.IMU_FAULT
    assert state[16:22] == bytes(6)


def test_an_oversized_payload_is_ignored(robot):
    """A crafted packet makes some nRF24 report widths above 32."""
    for size in range(33, 256):
        robot.send((robot.command(5000, 5000, core.ESTOP) + bytes(300))[:size])
    robot.run(20_000)
    assert robot.status == 0
    assert robot.counters()['malformed'] == 223


def test_malformed_packets_are_ignored_and_counted_by_kind(robot):
    good = robot.command(5000, 5000)
    for size in range(32):
        if size not in (14, 26):
            robot.send((good + bytes(32))[:size])
    for version in (0, 1, 3, 15):
        robot.send(bytes([version << 4 | 1]) + good[1:])
    for kind in (0, *range(7, 16)):
        robot.send(bytes([0x20 | kind]) + good[1:])
    robot.send(good[:3] + b'\x09' + good[4:])
    robot.send(good[:5] + b'\x01' + good[6:])
    counters = robot.counters()
    assert counters['malformed'] == 30 + 10 + 2
    assert counters['bad_version'] == 4
    robot.run(20_000)
    assert robot.status == 0
