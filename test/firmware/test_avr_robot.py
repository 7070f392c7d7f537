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
"""The real firmware of both boards in simavr: motion, stops, failures, sensors."""

import pytest
from support import avr_boards
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.protocol import codec, frames

pytestmark = needing(*AVR)

EXTERNAL_RESET, WATCHDOG_RESET = 2, 8
TIMER_0_INTERRUPTS = 0x6E  # TIMSK0 of the ATmega2560


# -- motion and stops -----------------------------------------------------------------------------


def test_step_pulse_timing_at_full_speed(boards: avr_boards.Boards) -> None:
    """DRV8825: STEP 1.9 us high and low, 0.65 us from DIR to STEP."""
    boards.start()
    for number, value in ((0, 19600), (1, 100_000), (2, 200_000)):  # speed and ramps
        boards.request(frames.ParamSet(boards.session, 9, number, value))
    avr_boards.drive(boards, 0.3, 19600, 19600)
    begun, before = boards.now_us, boards.pulses()
    busy = [boards.call('busy_cycles', board) for board in (avr_boards.DONGLE, avr_boards.ROBOT)]
    avr_boards.drive(boards, 0.1, 19600, 19600)
    microseconds = boards.now_us - begun
    rate = (boards.pulses()[0] - before[0]) / microseconds * 1e6
    loads = [
        (boards.call('busy_cycles', board) - busy[board]) / 16 / microseconds
        for board in (avr_boards.DONGLE, avr_boards.ROBOT)
    ]
    print(f'\n{rate:.0f} steps/s per wheel; load: dongle {loads[0]:.1%}, robot {loads[1]:.1%}')
    assert rate == pytest.approx(9982, rel=0.001)
    assert loads[avr_boards.DONGLE] < 0.3
    assert loads[avr_boards.ROBOT] < 0.9
    avr_boards.drive(boards, 0.4, -19600, 10000)
    assert boards.pulses()[0] < before[0]
    for wheel in (0, 1):
        seen = boards.wheel(wheel)
        assert min(seen.shortest_high, seen.shortest_low) >= 2 * 16
        assert seen.shortest_setup >= 16
    avr_boards.drive(boards, 0.3, 0, 0)
    avr_boards.odometry_agrees(boards)


def test_drivers_have_no_power_before_the_first_command(boards: avr_boards.Boards) -> None:
    boards.run(0.05)
    assert not boards.call('powered')
    boards.start()
    assert not boards.call('powered')
    boards.drive()
    boards.run(0.002)
    assert boards.call('powered')


# -- failures -------------------------------------------------------------------------------------


def test_a_jam_is_reported_and_loses_no_step(boards: avr_boards.Boards) -> None:
    boards.start()
    avr_boards.drive(boards, 0.1, 3000, 3000)
    boards.call('jam', True)
    # Clearing the flag before flushing the packet would restart the chip and hide the count.
    assert [boards.exchange(boards.command()).first for _ in range(3)] == [0x44] * 3
    boards.call('jam', False)
    state = avr_boards.drive(boards, 0.1, 3000, 3000)
    assert state.seq == boards.seq
    avr_boards.drive(boards, 0.2, 0, 0)
    avr_boards.odometry_agrees(boards)


def test_a_reset_of_the_robot_moves_nothing_and_has_a_cause(boards: avr_boards.Boards) -> None:
    boards.start()
    avr_boards.drive(boards, 0.1, 5000, 5000)
    boards.call('reset', avr_boards.ROBOT)
    assert not boards.call('powered')
    before = boards.pulses()
    boards.run(0.15)
    state = avr_boards.drive(boards, 0.06, 5000, 5000)
    assert state.status == frames.StatusFlag.NO_SESSION
    assert boards.pulses() == before
    info = boards.hello()
    assert isinstance(info, frames.Info)
    assert info.reset_cause == EXTERNAL_RESET


def test_a_reset_of_the_dongle_keeps_the_session(boards: avr_boards.Boards) -> None:
    boards.start()
    avr_boards.drive(boards, 0.1, 3000, 3000)
    boards.call('reset', avr_boards.DONGLE)
    boards.run(0.13)
    pong = boards.ask(frames.Ping(1, b'ping'))
    assert pong.reset_cause == EXTERNAL_RESET
    assert pong.chip_ok
    state = boards.drive(3000, 3000)
    assert (state.session, state.seq) == (boards.session, boards.seq)
    assert state.status & frames.StatusFlag.ENABLED


def test_watchdog_restarts_a_robot_that_hangs(boards: avr_boards.Boards) -> None:
    boards.start()
    avr_boards.drive(boards, 0.1, 5000, 5000)
    boards.call('poke', avr_boards.ROBOT, TIMER_0_INTERRUPTS, 0)
    boards.run(0.2)
    assert boards.call('resets', avr_boards.ROBOT) == 1
    assert not boards.call('powered')
    boards.run(0.15)
    assert boards.hello().reset_cause & WATCHDOG_RESET


def test_the_robots_radio_is_configured_again_after_power_loss(boards: avr_boards.Boards) -> None:
    boards.start()
    boards.rules_broken = True  # the firmware does not notice at once
    boards.call('radio_power', avr_boards.ROBOT, False)
    boards.run(0.05)
    boards.call('radio_power', avr_boards.ROBOT, True)
    boards.run(0.2)
    answers = []
    while not answers or not answers[-1] and len(answers) < 5:
        result = boards.ask(
            frames.Transmit(0, avr_boards.GAP, codec.encode(boards.command())), 200000
        )
        answers.append(bool(result.first & 1))
        boards.run(0.1)
    assert answers[-1]


# -- sensors and parameters -----------------------------------------------------------------------


def test_ranges_battery_and_temperature_reach_the_host(boards: avr_boards.Boards) -> None:
    for channel in range(8):
        metres = 0.12 + 0.08 * channel
        boards.call('millivolts', channel, round(1000 * (0.282 / (metres + 0.0257) + 0.061)))
    boards.call('millivolts', 8, 2450)
    boards.start()
    state = boards.drive()
    for channel, code in enumerate(state.ranges):
        assert code * 0.005 == pytest.approx(0.12 + 0.08 * channel, rel=0.02)
    aux = boards.request(frames.Poll(0, 0, 1), frames.Poll(0, 0, 1))
    assert aux.battery == pytest.approx(9800, abs=40)
    assert (aux.temperature, aux.accel_z, aux.gyro_x, aux.gyro_y) == (3000, 16384, 10, 20)
    assert (state.gyro_z, state.accel_x, state.accel_y) == (-131, 100, 200)
    assert state.status == frames.StatusFlag.ENABLED | frames.StatusFlag.LOW_BATTERY
