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
"""Firmware core: sessions, TTL, sequence numbers, emergency stop, echoes, refusals."""

import struct

import pytest
from support import firmware_core as core
from support.long_tests import few_of

from t3mpc_ros.radio.protocol.frames import SETTINGS_RECORD, RefusalReason
from t3mpc_ros.radio.tool import robot_settings

PRESS, RELEASE = 5_200, 50_200  # debounce times of the button and a period of the main loop, us


def test_nothing_moves_before_hello_and_enable(library):
    robot = core.Robot(library)
    assert not robot.call('powered')
    for session in range(256):
        robot.drive(5000, 5000, 20_000, session=session)
    assert robot.status & core.NO_SESSION
    robot.hello()
    robot.drive(5000, 5000, 500_000, flags=0)
    assert robot.status == 0
    assert not robot.call('powered')
    assert robot.pulses == (0, 0)
    robot.drive(5000, 5000, 500_000)
    assert robot.status == core.ENABLED | core.MOVING
    assert robot.speeds == (5.0, 5.0)
    assert robot.pulses[0] > 500


def test_hello_starts_a_session_at_rest_and_keeps_the_counters(robot):
    robot.drive(5000, 5000, 500_000)
    steps = robot.steps
    info = robot.hello(session=77)
    assert (info[0], info[1], info[3], info[7]) == (0x23, 77, 2, 12)
    assert struct.unpack_from('<HH', info, 8) == (200, 16)
    robot.run(300_000)
    assert robot.status == 0
    assert not robot.call('powered')
    assert robot.steps > steps
    robot.drive(5000, 5000, 100_000, session=core.SESSION)
    assert robot.speeds == (0.0, 0.0)


def test_ttl_expiry_ramps_down_and_sets_the_flag(slow_ramps):
    slow_ramps.drive(4500, 4500, 1_000_000)
    slow_ramps.send(slow_ramps.command(4500, 4500, ttl=20))
    slow_ramps.run(199_000)
    assert slow_ramps.speeds == (4.5, 4.5)
    assert slow_ramps.status == core.ENABLED | core.MOVING
    slow_ramps.run(2_000)
    assert slow_ramps.status == core.ENABLED | core.MOVING | core.EXPIRED
    slow_ramps.run(74_000)
    # Half of 4.5 rad/s at 30 rad/s².
    assert slow_ramps.speeds == pytest.approx((2.25, 2.25), abs=0.07)
    slow_ramps.run(76_500)
    assert slow_ramps.speeds == (0.0, 0.0)
    assert slow_ramps.status == core.ENABLED | core.EXPIRED
    assert slow_ramps.call('powered')  # holding torque
    assert slow_ramps.counters()['expired'] == 1
    slow_ramps.drive(1000, 1000, 20_000)
    assert slow_ramps.status == core.ENABLED | core.MOVING


def rest_time(robot, ttl):
    """Return the time (s) from the last command at full speed to standstill."""
    robot.drive(10_000, 10_000, 2_000_000)
    robot.send(robot.command(10_000, 10_000, ttl=ttl))
    assert robot.speeds == (10.0, 10.0)
    elapsed = 0
    while robot.status & core.MOVING:
        robot.run(1000)
        elapsed += 1000
    return elapsed / 1e6


@pytest.mark.parametrize(
    'ttl, deceleration, limit',
    [
        (20, 60_000, 0.37),
        (255, 60_000, 0.42),
        (20, 41_000, 0.45),
        (255, 52_000, 0.45),
        (20, 30_000, 0.536),
    ],
)
def test_stop_time_is_ttl_plus_ramp(robot, ttl, deceleration, limit):
    """Stop time = TTL + speed / deceleration; the first case is the default of both ends.

    Standstill within 0.45 s requires 41 rad/s² at a TTL of 200 ms, and 52 rad/s² at the largest
    TTL that the robot accepts.
    """
    assert robot.get(core.DECELERATION) == (core.OK, 60_000)
    assert robot.set(core.DECELERATION, deceleration) == (core.OK, deceleration)
    assert limit - 0.01 < rest_time(robot, ttl) <= limit


def test_an_emergency_stop_is_not_weakened_by_a_parameter(robot):
    """It used the deceleration that a host may set: from 10 rad/s it took 100 s at the lowest."""
    assert robot.set(core.DECELERATION, 100) == (core.OK, 100)
    robot.drive(10_000, 10_000, 2_000_000)
    robot.send(robot.command(flags=core.ESTOP))
    robot.run(170_000)
    assert robot.speeds == (0.0, 0.0)


def test_a_ttl_of_zero_stops_without_the_expiry_flag(robot):
    robot.drive(5000, 5000, 500_000)
    robot.drive(5000, 5000, 500_000, ttl=0)
    assert robot.status == core.ENABLED
    assert robot.counters()['expired'] == 0


def test_only_newer_sequence_numbers_count(robot):
    """(int8)(seq - last) > 0, for every last one and every difference."""
    for last in (0, 1, 127, 128, 254, 255):
        for difference in range(256):
            robot.hello()
            robot.send(robot.command(0, 0, seq=last))
            before = robot.counters()['duplicates']
            robot.send(robot.command(3000, 3000, seq=(last + difference) % 256))
            robot.run(2000)
            moved = bool(robot.status & core.MOVING)
            assert moved == (1 <= difference <= 127), (last, difference)
            assert robot.counters()['duplicates'] - before == (not moved)


def test_a_repeated_command_does_not_extend_its_ttl(robot):
    frame = robot.command(3000, 3000, seq=9)
    for _ in range(30):
        robot.send(frame)
        robot.run(10_000)
    assert robot.status & core.EXPIRED


def test_frames_of_another_session_are_counted_and_ignored(robot):
    for session in set(range(256)) - {core.SESSION}:
        robot.drive(5000, 5000, 20_000, session=session)
    assert robot.pulses == (0, 0)
    assert robot.counters()['bad_session'] == 255
    assert robot.request(struct.pack('<BBBBi', 0x23, 3, 9, core.MAX_SPEED, 1))[0] == 0x21
    assert robot.get(core.MAX_SPEED) == (core.OK, 10_000)


@pytest.mark.parametrize('session', [0, core.SESSION, 255])
@pytest.mark.parametrize('flags', [core.ESTOP, core.ESTOP | core.ENABLE, 7, 0xFF])
def test_an_emergency_stop_is_accepted_from_any_sender(robot, session, flags):
    robot.drive(5000, 5000, 500_000)
    robot.send(robot.command(5000, 5000, flags, seq=0, session=session, echo_us=0))
    robot.run(1000)
    assert robot.status == core.LATCHED | core.MOVING  # on the ramp to rest
    robot.drive(5000, 5000, 400_000)
    assert robot.status == core.LATCHED
    assert robot.speeds == (0.0, 0.0)
    robot.hello(session=5)
    robot.drive(5000, 5000, 100_000, session=5)
    assert robot.status == core.LATCHED


def test_only_a_valid_clear_of_the_session_clears_the_estop(robot):
    robot.send(robot.command(flags=core.ESTOP))
    for rejected in (
        {'flags': 0},
        {'flags': core.CLEAR | core.ENABLE},
        {'flags': core.CLEAR | core.ESTOP},
        {'flags': core.CLEAR, 'left': 1},
        {'flags': core.CLEAR, 'right': -1},
        {'flags': core.CLEAR, 'session': 3},
        {'flags': core.CLEAR, 'seq': robot.seq},
        {'flags': core.CLEAR, 'echo_us': (robot.now - 1_000_000) % (1 << 32)},
    ):
        robot.send(robot.command(**rejected))
        robot.run(20_000)
        assert robot.status & core.LATCHED, rejected
    robot.call('press', True)
    robot.send(robot.command(flags=core.CLEAR))
    assert robot.status & core.LATCHED
    robot.run(PRESS)
    robot.call('press', False)
    robot.run(RELEASE - 1000)
    robot.send(robot.command(flags=core.CLEAR))
    assert robot.status & core.LATCHED
    robot.run(1000)
    robot.send(robot.command(flags=core.CLEAR))
    assert robot.status == 0
    robot.drive(1000, 1000, 200_000)
    assert robot.status == core.ENABLED | core.MOVING


@pytest.mark.parametrize('pressed', [PRESS // 2, PRESS])
def test_the_button_latches_after_its_debounce_time_only(robot, pressed):
    """A spike on its wire once stopped the robot for good."""
    robot.drive(5000, 5000, 500_000)
    for _ in range(20):
        robot.call('press', True)
        robot.run(pressed)
        robot.call('press', False)
        robot.run(1000)
    latched = robot.status & core.LATCHED
    assert bool(latched) == (pressed == PRESS)
    robot.drive(5000, 5000, 500_000)
    assert robot.status == (core.LATCHED if latched else core.ENABLED | core.MOVING)
    assert robot.call('powered') == (not latched)


# -- battery --------------------------------------------------------------------------------------


def supply(robot, millivolts, us):
    """Set the voltage of the battery for a time."""
    robot.call('set_adc', 8, millivolts * 1024 // 20_000)
    robot.drive(3000, 3000, us)


def test_a_dip_of_the_supply_is_no_low_battery(robot):
    """The warning once flickered with every start of the motors."""
    supply(robot, 11_000, 500_000)
    for _ in range(10):
        supply(robot, 8_000, 60_000)
        assert not robot.status & core.LOW_BATTERY
        supply(robot, 11_000, 940_000)
    assert robot.status == core.ENABLED | core.MOVING


def test_an_empty_battery_stops_the_robot_until_charged(robot):
    supply(robot, 11_000, 500_000)
    supply(robot, 9_500, 5_000_000)
    assert robot.status == core.ENABLED | core.MOVING | core.LOW_BATTERY
    supply(robot, 8_500, 5_000_000)
    assert robot.status == core.LOW_BATTERY
    assert not robot.call('powered')
    supply(robot, 9_900, 5_000_000)  # without load the voltage rises
    assert robot.status == core.LOW_BATTERY
    supply(robot, 10_500, 5_000_000)
    assert robot.status == core.ENABLED | core.MOVING
    robot.call('set_adc', 8, 0)  # nothing is connected
    robot.drive(3000, 3000, 1_000_000)
    assert robot.status == core.ENABLED | core.MOVING
    assert robot.set(core.CUTOFF, 0)[0] == core.OK
    supply(robot, 5_000, 5_000_000)
    assert robot.status == core.ENABLED | core.MOVING | core.LOW_BATTERY


def wired(library):
    """Return a robot whose settings say that its battery is measured."""
    robot = core.Robot(library)
    settings = robot_settings.RobotSettings(battery_wired=True)
    assert robot.store(SETTINGS_RECORD, robot_settings.encode_settings(settings)) == core.OK
    robot.hello()
    return robot


def test_a_broken_wire_of_a_wired_battery_stops_the_robot(library):
    """It read 0 V, as if nothing were connected: the cut-off was gone without a word."""
    robot = wired(library)
    supply(robot, 11_000, 3_000_000)
    assert robot.status == core.ENABLED | core.MOVING
    robot.call('set_adc', 8, 0)
    robot.drive(3000, 3000, 50_000)  # a loose contact is no broken wire
    supply(robot, 11_000, 2_000_000)
    assert robot.status == core.ENABLED | core.MOVING
    robot.call('set_adc', 8, 0)
    robot.drive(3000, 3000, 5_000_000)
    assert robot.status == core.LOW_BATTERY
    assert not robot.call('powered')
    supply(robot, 11_000, 5_000_000)
    assert robot.status == core.ENABLED | core.MOVING


def test_a_wired_battery_that_was_never_there_lets_nothing_move(library):
    robot = wired(library)
    robot.call('set_adc', 8, 0)
    robot.drive(3000, 3000, 2_000_000)
    assert robot.status == core.LOW_BATTERY
    assert robot.steps == (0, 0)


# -- echoes ---------------------------------------------------------------------------------------


def test_golden_echoes_shorten_the_ttl_or_refuse_the_command(library, golden):
    """A CMD is followed for its TTL, less what its echo is older than 50 ms."""
    for row in golden['echoes']:
        robot = core.Robot(library, time=(row['received_us'] - 10_000) % (1 << 32))
        robot.run(1000)
        robot.hello()
        robot.run((row['received_us'] - robot.now) % (1 << 32))
        robot.send(robot.command(3000, 3000, ttl=row['ttl'], echo_us=row['echo_us']))
        follows, name = row['follows_us'], row['name']
        refused = robot.call('status') & core.ENABLED == 0
        assert refused == (follows is None), name
        if follows:
            # The main loop sees the end of the TTL up to 200 us later.
            robot.run(max(follows - 1000, 0))
            assert not robot.status & core.EXPIRED or follows < 1000, name
            robot.run(min(follows, 1000) + 400)
            assert robot.status & core.EXPIRED, name
        elif follows is None:
            reason, refused_bytes = robot.refusal()
            assert reason is RefusalReason.STALE, name
            assert refused_bytes == bytes([0x21, core.SESSION, robot.seq]), name


@pytest.mark.parametrize('silence', few_of([0.3, 100.0, 1500.0], 2))
def test_commands_held_and_released_at_once_are_refused(robot, silence):
    """A stalled USB hub holds 15 commands, then releases them."""
    robot.drive(0, 0, 500_000)
    held = [robot.command(5000, 5000) for _ in range(15)]
    robot.run(round(silence * 1e6))
    for frame in held:
        robot.send(frame)
        robot.run(500)
    assert robot.counters()['stale'] == 15
    assert robot.pulses == (0, 0)
    robot.drive(5000, 5000, 40_000)
    assert robot.status & core.MOVING


@pytest.mark.parametrize('growth', [5, 20, 100])
def test_no_growing_delay_is_followed_beyond_ttl_and_slack(robot, growth):
    """With an estimate of the delay, one that grew by 20 ms/s was followed until 2.4 s late.

    ``growth`` is in ms of delay per second. Each way has the same delay, so an echo is two delays
    old, and its command one.
    """
    followed = refused = latest = 0
    start = robot.now
    while refused < 100:
        robot.run(20_000)
        delay = growth * (robot.now - start) // 1000
        robot.send(robot.command(1000, 1000, echo_us=(robot.now - 2 * delay) % (1 << 32)))
        if robot.request(b'\x25\0\0\0')[2] == robot.seq:
            followed, latest = followed + 1, delay
        else:
            refused += 1
    assert followed > 20
    assert 120_000 < latest <= 125_000
    robot.run(250_000)
    assert robot.speeds == (0.0, 0.0)


def test_a_stale_stop_still_stops(robot):
    robot.drive(5000, 5000, 500_000)
    robot.echo_age = 400_000
    robot.send(robot.command(0, 0))
    assert robot.counters()['stale'] == 1
    robot.run(170_000)
    assert robot.speeds == (0.0, 0.0)


def test_a_refused_command_uses_no_sequence_number(robot):
    """After 128 stale commands, the first prompt one was refused as repeated."""
    for _ in range(300):
        robot.send(robot.command(1000, 1000, echo_us=(robot.now - 400_000) % (1 << 32)))
        robot.run(1000)
    assert robot.counters()['stale'] == 300
    state = robot.request(b'\x25\0\0\0')
    assert (state[2], state[22:24]) == (0, b'\xff\xff')
    robot.seq = 0
    robot.drive(1000, 1000, 20_000)
    assert robot.status == core.ENABLED | core.MOVING


# -- refusals -------------------------------------------------------------------------------------


def test_each_refusal_is_reported_with_its_reason(library, robot, keyed):
    reason = RefusalReason
    stale = (robot.now - 10**6) % (1 << 32)
    moving = robot.command(1000, 1000)
    refused = [
        (robot, b'\x11' + moving[1:], reason.VERSION),
        (robot, moving[:-1], reason.FORM),
        (robot, b'\x2f' + moving[1:], reason.FORM),
        (robot, robot.command(session=core.SESSION + 1), reason.SESSION),
        (robot, moving + bytes(12), reason.SIGNED),
        (robot, robot.command(seq=0, echo_us=stale), reason.STALE),
        (robot, b'\x24' + moving[1:2] + b'\7\1' + bytes(20), reason.SIGNED),
        (keyed, moving, reason.UNSIGNED),
        (keyed, keyed.command()[:-1] + b'?', reason.TAG),
        (keyed, b'\x24' + moving[1:2] + b'\7\1' + bytes(20), reason.TAG),
        (keyed, b'\x24' + moving[1:2] + b'\7\0', reason.UNSIGNED),
        (core.Robot(library), moving, reason.SESSION),
        (core.Robot(library, erased=True), b'\x24\5\6\0', reason.SETTINGS),
    ]
    for made, data, expected in refused:
        made.run(1000)
        made.send(data)
        assert made.refusal() == (expected, data[:3]), data.hex()
        assert made.request(b'\x25\0\0\2')[12] == expected
        assert not made.status & core.MOVING
    robot.send(moving)
    robot.send(moving)
    assert robot.refusal() == (reason.SEQUENCE, moving[:3])
    robot.hello(session=9)
    assert robot.refusal()[0] is reason.NONE
    locked = core.Robot(library, core.KEY)
    locked.call('poke_eeprom', 26, 0)
    locked.call('boot', 1, 0)
    locked.run(1000)
    locked.send(b'\x24\5\6\0')
    assert locked.refusal() == (reason.KEY, b'\x24\5\6')


@pytest.mark.parametrize('key', [b'', core.KEY], ids=['open', 'keyed'])
def test_a_host_of_another_version_learns_that_of_the_robot(library, golden, key):
    """It is refused, in an INFO that it can read; the session goes on."""
    robot = core.Robot(library, key)
    robot.run(1000)
    robot.hello()
    for row in golden['foreign']:
        robot.drive(3000, 3000, 60_000)
        data = bytes.fromhex(row['bytes'])
        answer = robot.request(data)
        assert answer[0] == int(row['answer'], 16), row['name']
        assert robot.refusal() == (RefusalReason.VERSION, data[:3])
        assert robot.status == core.ENABLED | core.MOVING
        if answer[0] & 15 == 3:
            assert len(answer) == (32 if key else 24)
            assert answer[1:4] == bytes([core.SESSION, row['seq'], 2]), row['name']
            # What a host of version 1 checks before the version: settings and channel.
            assert answer[13] <= 3
            assert answer[14] <= 125
    stop = bytes([0x11, 0, 0, core.ESTOP]) + bytes(10)
    robot.send(stop)
    assert robot.status & core.LATCHED


def test_a_session_ends_after_half_an_hour_of_silence(robot):
    """Beyond 35 minutes the sign of a difference of 32-bit clocks is ambiguous."""
    robot.drive(1000, 1000, 100_000)
    robot.run(1_799_000_000)
    assert not robot.status & core.NO_SESSION
    robot.run(2_000_000)
    assert robot.status == core.NO_SESSION | core.EXPIRED
    robot.drive(1000, 1000, 100_000)
    assert robot.status == core.NO_SESSION | core.EXPIRED
    robot.hello()
    assert robot.status == 0
