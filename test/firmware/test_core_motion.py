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
"""Firmware core: wheel speeds, ramps, driver power, and wraps of clocks and counters."""

import math
import struct

import pytest
from support import firmware_core as core


def pulses_of(robot, left, right, us):
    """Return the pulses that a command at a constant speed has issued in a time."""
    before = robot.pulses
    robot.drive(left, right, us)
    return [after - earlier for earlier, after in zip(before, robot.pulses, strict=True)]


@pytest.mark.parametrize(
    'left, right, seconds', [(10_000, -10_000, 10), (1, -3, 100)], ids=['fast', 'slow']
)
def test_wheel_speed_is_exact(robot, left, right, seconds):
    robot.drive(left, right, 1_000_000)
    expected = [0.001 * speed * seconds / core.STEP for speed in (left, right)]
    assert pulses_of(robot, left, right, seconds * 1_000_000) == pytest.approx(expected, abs=1.5)
    assert robot.steps == robot.pulses


def test_speed_crosses_zero_without_a_jump(robot):
    """The counter follows the integral of the speed within two steps at every change of sign."""
    place = 0.0
    for index in range(1500):
        wanted = 300.0 * math.sin(math.tau * index / 300.0)
        robot.send(robot.command(wanted, -wanted))
        for _ in range(20):
            place += robot.speeds[0] * 1e-3
            robot.run(1000)
        assert abs(robot.steps[0] - place / core.STEP) <= 2.0, index
    assert robot.steps == robot.pulses
    assert max(robot.pulses) - min(robot.pulses) < 3
    assert robot.call('hasty_pulses') == 0  # DIR is stable before every STEP


def test_step_rate_is_limited_to_10_000_per_second(robot):
    assert robot.set(core.MAX_SPEED, 19_600) == (core.OK, 19_600)
    robot.drive(32_767, -32_768, 2_000_000)
    assert robot.status & core.LIMITED
    rates = pulses_of(robot, 32_767, -32_768, 1_000_000)
    assert rates == pytest.approx([9982, -9982], abs=2)
    assert robot.call('closest_pulses') >= 100


@pytest.mark.parametrize('microsteps', [1, 32, 256])
@pytest.mark.parametrize('reboot', [False, True])
def test_microsteps_of_the_settings_keep_the_speed(library, microsteps, reboot):
    robot = core.Robot(library)
    robot.run(1000)
    robot.hello()
    assert robot.settings(82, microsteps)[0] == core.OK
    if reboot:
        robot.call('boot', 1, 0)
    info = robot.hello()
    assert struct.unpack_from('<H', info, 10) == (microsteps,)
    assert robot.set(core.MICROSTEPS, microsteps) == (core.READ_ONLY, microsteps)
    robot.drive(10_000, 5_000, 1_000_000)
    rates = pulses_of(robot, 10_000, 5_000, 1_000_000)
    wanted = min(10.0 * 200 * microsteps / math.tau, 10_000.0)
    assert rates == [pytest.approx(wanted, abs=20), pytest.approx(wanted / 2, abs=10)]
    assert rates[0] <= 10_000
    assert bool(robot.status & core.LIMITED) == (microsteps > 31)


@pytest.mark.parametrize(
    'inverted, signs', [(0, (1, 1)), (1, (-1, 1)), (2, (1, -1)), (3, (-1, -1))]
)
def test_an_inverted_wheel_turns_backwards_and_counts_forwards(robot, inverted, signs):
    assert robot.set(core.INVERT, inverted) == (core.OK, inverted)
    robot.drive(3000, 2000, 500_000)
    assert min(robot.steps) > 100
    left, right = robot.steps
    assert robot.pulses == (signs[0] * left, signs[1] * right)


@pytest.mark.parametrize(
    'left, right', [(10_000, 3_000), (-2_000, 9_000), (5_000, -5_000), (7_000, 10)]
)
def test_one_factor_keeps_the_curvature_in_every_ramp(slow_ramps, left, right):
    def check():
        speeds = slow_ramps.speeds
        assert speeds[0] * right == pytest.approx(speeds[1] * left, abs=2.0)
        return speeds

    for _ in range(60):
        slow_ramps.drive(left, right, 20_000, period=5_000)
        check()
    slow_ramps.run(200_000)
    rates = []
    while slow_ramps.status & core.MOVING:
        before = max(map(abs, check()))
        slow_ramps.run(10_000)
        rates.append(before - max(map(abs, slow_ramps.speeds)))
    # 30 rad/s² for the faster wheel, up to the last step but one.
    assert rates[2:-1] == [pytest.approx(0.3, abs=0.01)] * len(rates[2:-1])


def test_acceleration_and_deceleration_rates_differ(slow_ramps):
    slow_ramps.drive(1000, 1000, 200_000)
    start = slow_ramps.speeds[0]
    slow_ramps.drive(9000, 9000, 100_000)
    assert slow_ramps.speeds[0] - start == pytest.approx(1.5, abs=0.03)
    slow_ramps.drive(9000, 9000, 1_000_000)
    slow_ramps.drive(1000, 1000, 100_000)
    assert slow_ramps.speeds[0] == pytest.approx(6.0, abs=0.05)
    # Through zero: deceleration, then acceleration.
    slow_ramps.drive(3000, 3000, 1_000_000)
    slow_ramps.drive(-3000, -3000, 200_000)
    assert slow_ramps.speeds[0] == pytest.approx(-1.5, abs=0.05)


def test_opposite_speed_changes_use_the_smaller_rate(slow_ramps):
    slow_ramps.drive(1000, 9000, 1_000_000)
    slow_ramps.drive(9000, 1000, 100_000)
    assert slow_ramps.speeds == pytest.approx((2.5, 7.5), abs=0.03)
    assert slow_ramps.set(core.DECELERATION, 5000) == (core.OK, 5000)
    slow_ramps.drive(1000, 9000, 2_000_000)
    slow_ramps.drive(9000, 1000, 100_000)
    assert slow_ramps.speeds == pytest.approx((1.5, 8.5), abs=0.03)


def test_a_stalled_main_loop_causes_no_speed_jump(slow_ramps):
    slow_ramps.drive(9000, 9000, 1_000_000)
    slow_ramps.send(slow_ramps.command(0, 0))
    slow_ramps.run(2000)
    before = slow_ramps.speeds[0]
    slow_ramps.call('stall', 500_000)
    slow_ramps.run(400)
    assert 0.0 < before - slow_ramps.speeds[0] <= 0.61  # 20 ms at 30 rad/s²
    assert slow_ramps.status == core.ENABLED | core.MOVING | core.EXPIRED


def test_a_command_beyond_the_limit_is_scaled_as_a_whole(robot):
    assert robot.set(core.MAX_SPEED, 4000) == (core.OK, 4000)
    robot.drive(8000, -2000, 1_000_000)
    assert robot.speeds == (4.0, -1.0)
    assert robot.status & core.LIMITED
    robot.drive(4000, -1000, 20_000)
    assert not robot.status & core.LIMITED
    assert robot.set(core.MAX_SPEED, 0) == (core.OK, 0)
    robot.drive(8000, -2000, 1_000_000)
    assert robot.speeds == (0.0, 0.0)
    assert robot.set(core.MAX_SPEED, 10_000)[0] == core.OK
    for left, right in ((-32_768, 32_767), (32_767, -32_768), (-32_768, -32_768), (0, -32_768)):
        robot.drive(left, right, 1_500_000)
        scale = 10.0 / 32_768
        assert robot.speeds == pytest.approx((left * scale, right * scale), abs=0.002)


def test_drivers_switch_off_when_idle_and_on_before_a_step(robot):
    """A robot that had once been idle lost its power as soon as it came to rest again."""
    assert robot.set(core.IDLE_OFF, 1000) == (core.OK, 1000)
    for _ in range(2):
        robot.drive(1000, 1000, 500_000)
        assert robot.call('powered')
        robot.drive(0, 0, 900_000)
        assert robot.call('powered')
        robot.drive(0, 0, 300_000)
        assert not robot.call('powered')
    robot.drive(1000, 1000, 100_000)
    assert robot.call('unpowered_pulses') == 0


@pytest.mark.long
def test_clock_wrap_after_hours_at_rest_has_no_effect(robot):
    """2**32 us later an old time stamp equals now, for the idle time and the command age."""
    assert robot.set(core.IDLE_OFF, 1000) == (core.OK, 1000)
    robot.send(robot.command(0, 0))
    sent = 1 << 32
    for _ in range(4):
        robot.run(1_000_000_000)
        sent -= 1_000_000_000
        assert robot.get(core.MAX_SPEED)[0] == core.OK  # keeps the session
        sent -= 1000
    robot.run(sent - 300_000)
    for _ in range(20):
        robot.run(100_000)
        assert not robot.call('powered')
        assert robot.reply()[22:24] == b'\xff\xff'
    assert robot.status == core.ENABLED | core.EXPIRED


def test_drivers_keep_their_power_until_a_ramp_has_ended(slow_ramps):
    slow_ramps.drive(9000, 9000, 1_000_000)
    slow_ramps.send(slow_ramps.command(9000, 9000, flags=0))
    slow_ramps.run(250_000)
    assert slow_ramps.call('powered')
    slow_ramps.run(60_000)
    assert not slow_ramps.call('powered')
    assert slow_ramps.steps == slow_ramps.pulses


# -- wraps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize('before', [1000, 150_000, 210_000])
@pytest.mark.parametrize('wrap', [1 << 15, 1 << 16, 1 << 31, 1 << 32])
def test_clock_wrap_of_any_width_has_no_effect(robot, wrap, before):
    """Regression: a 16-bit overflow counter made the clock wrap at 35.8 minutes."""
    robot.drive(5000, 5000, 500_000)
    robot.poke(wrap - before)
    robot.send(robot.command(5000, 5000))
    robot.run(190_000)
    assert robot.status == core.ENABLED | core.MOVING
    assert robot.speeds == (5.0, 5.0)
    robot.run(190_000)
    assert robot.status == core.ENABLED | core.EXPIRED
    assert robot.steps == robot.pulses
    assert robot.counters()['stale'] == 0
    robot.drive(5000, 5000, 100_000)
    assert robot.status == core.ENABLED | core.MOVING


def test_the_idle_time_is_kept_across_a_wrap_of_the_clock(robot):
    """With the end of the time compared, not its length, the drivers lost their power at once."""
    assert robot.set(core.IDLE_OFF, 1000) == (core.OK, 1000)
    robot.poke((1 << 32) - 600_000)
    robot.send(robot.command(0, 0))
    robot.run(900_000)
    assert robot.call('powered')
    robot.run(200_000)
    assert not robot.call('powered')


def test_counters_wrap_at_32_bits(robot):
    robot.call('poke_steps', 0, (1 << 31) - 3)
    robot.call('poke_steps', 1, -(1 << 31) + 3)
    robot.drive(1000, -1000, 200_000)
    state = robot.request(b'\x25\0\0\0')
    left, right = struct.unpack_from('<ii', state, 8)
    assert -(1 << 31) <= left < -(1 << 31) + 200
    assert (1 << 31) - 200 < right < 1 << 31
