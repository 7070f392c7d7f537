# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The real firmware of both boards in simavr: motion, stops, failures, sensors."""

from collections.abc import Iterator
import statistics

import pytest
from support.avr_boards import (
    DONGLE,
    GAP,
    ROBOT,
    Boards,
    booted,
    cycle,
    drive,
    missing_tools,
    odometry_agrees,
)

from t3mpc_ros.radio.protocol import codec
from t3mpc_ros.radio.protocol.authentication import Signer, session_key, sign_hello
from t3mpc_ros.radio.protocol.frames import (
    OK,
    RESET_ODOMETRY,
    Action,
    CommandFlag,
    Info,
    ParamSet,
    Ping,
    Poll,
    StatusFlag,
    Transmit,
)
from t3mpc_ros.radio.protocol.framing import crc16

pytestmark = pytest.mark.skipif(bool(missing_tools()), reason=f'not installed: {missing_tools()}')

EXTERNAL_RESET, WATCHDOG_RESET = 2, 8
TIMER_0_INTERRUPTS = 0x6E  # TIMSK0 of the ATmega2560
KEY_ADDRESS = 8
SLOW_GAP = 20  # 5 ms: a signed HELLO takes four hashes


@pytest.fixture
def boards() -> Iterator[Boards]:
    yield from booted()


# -- motion and stops -----------------------------------------------------------------------------


def test_wheels_turn_as_fast_as_commanded(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.6, 5000, -2500)
    begun, before = boards.now_us, boards.pulses()
    drive(boards, 0.5, 5000, -2500)
    seconds = (boards.now_us - begun) / 1e6
    turned = [b - a for a, b in zip(before, boards.pulses(), strict=True)]
    revolution = 200 * 16 / 6.283185307179586
    assert turned[0] / seconds / revolution == pytest.approx(5.0, rel=0.002)
    assert turned[1] / seconds / revolution == pytest.approx(-2.5, rel=0.002)


def test_silence_stops_the_wheels(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.5, 5000, 5000)
    boards.run(0.15)  # within the TTL of 0.2 s
    before = boards.pulses()
    boards.run(0.02)
    assert boards.pulses() != before
    boards.run(0.2)  # TTL 0.2 s, ramp 0.17 s
    before = boards.pulses()
    boards.run(0.3)
    assert boards.pulses() == before
    state = boards.request(Poll(0, 0, 0), Poll(0, 0, 0))
    assert state.status & StatusFlag.TTL_EXPIRED
    assert not state.status & StatusFlag.MOVING
    odometry_agrees(boards)


def test_button_stops_and_stays_latched_until_cleared(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.5, 5000, 5000)
    boards.call('press', True)
    state = drive(boards, 0.2, 5000, 5000)
    assert state.status & StatusFlag.ESTOP
    assert not state.status & StatusFlag.MOVING
    before = boards.pulses()
    assert boards.drive(flags=CommandFlag.ESTOP_CLEAR).status & StatusFlag.ESTOP  # still pressed
    boards.call('press', False)
    boards.run(0.03)
    assert boards.drive(flags=CommandFlag.ESTOP_CLEAR).status & StatusFlag.ESTOP  # may bounce
    assert drive(boards, 0.1, 5000, 5000).status & StatusFlag.ESTOP
    assert boards.pulses() == before
    assert not boards.drive(flags=CommandFlag.ESTOP_CLEAR).status & StatusFlag.ESTOP
    drive(boards, 0.2, 5000, 5000)
    assert boards.pulses() > before
    drive(boards, 0.5, 0, 0)
    odometry_agrees(boards)


def test_any_sender_may_stop_the_robot(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.3, 5000, 5000)
    foreign = codec.encode(boards.command(flags=CommandFlag.ESTOP, session=0x77))
    assert boards.call('inject', foreign, len(foreign), len(foreign))
    assert drive(boards, 0.2, 5000, 5000).status & StatusFlag.ESTOP
    before = boards.pulses()
    boards.run(0.1)
    assert boards.pulses() == before


def test_step_pulse_timing_at_full_speed(boards: Boards) -> None:
    """DRV8825: STEP 1.9 us high and low, 0.65 us from DIR to STEP."""
    boards.start()
    boards.request(ParamSet(boards.session, 9, 0, 19600))
    drive(boards, 1.5, 19600, 19600)
    begun, before = boards.now_us, boards.pulses()
    busy = [boards.call('busy_cycles', board) for board in (DONGLE, ROBOT)]
    drive(boards, 0.2, 19600, 19600)
    microseconds = boards.now_us - begun
    rate = (boards.pulses()[0] - before[0]) / microseconds * 1e6
    loads = [
        (boards.call('busy_cycles', board) - busy[board]) / 16 / microseconds
        for board in (DONGLE, ROBOT)
    ]
    print(f'\n{rate:.0f} steps/s per wheel; load: dongle {loads[0]:.1%}, robot {loads[1]:.1%}')
    assert rate == pytest.approx(9982, rel=0.001)
    assert loads[DONGLE] < 0.3
    assert loads[ROBOT] < 0.9
    drive(boards, 1.5, -19600, 10000)
    for wheel in (0, 1):
        seen = boards.wheel(wheel)
        assert min(seen.shortest_high, seen.shortest_low) >= 2 * 16
        assert seen.shortest_setup >= 16
    drive(boards, 1.0, 0, 0)
    odometry_agrees(boards)


def test_drivers_have_no_power_before_the_first_command(boards: Boards) -> None:
    boards.run(0.05)
    assert not boards.call('powered')
    boards.start()
    assert not boards.call('powered')
    boards.drive()
    boards.run(0.002)
    assert boards.call('powered')


# -- failures -------------------------------------------------------------------------------------


def test_robot_stops_during_a_jam_and_recovers(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.4, 5000, 5000)
    boards.call('jam', True)
    lost = sum(cycle(boards, 0.02, 5000, 5000) is None for _ in range(50))
    assert lost == 50
    # Clearing the flag before flushing the packet would restart the chip and hide the count.
    assert boards.exchange(boards.command()).first == 0x44
    before = boards.pulses()
    boards.run(0.05)
    assert boards.pulses() == before
    boards.call('jam', False)
    state = drive(boards, 0.1, 5000, 5000)
    assert state.seq == boards.seq
    assert boards.pulses() > before
    drive(boards, 0.5, 0, 0)
    odometry_agrees(boards)


def test_robot_reboot_is_detected_and_moves_nothing(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.3, 5000, 5000)
    boards.call('reset', ROBOT)
    assert not boards.call('powered')
    before = boards.pulses()
    boards.run(0.15)
    state = drive(boards, 0.2, 5000, 5000)
    assert state.session == 0
    assert state.status & StatusFlag.NO_SESSION
    assert boards.pulses() == before
    info = boards.hello()
    assert isinstance(info, Info)
    assert info.reset_cause == EXTERNAL_RESET
    state = drive(boards, 0.2, 5000, 5000)
    assert (state.left, state.right) != (0, 0)
    drive(boards, 0.5, 0, 0)
    state = boards.drive()
    moved = tuple(b - a for a, b in zip(before, boards.pulses(), strict=True))
    assert (state.left, state.right) == moved


def test_dongle_reset_keeps_the_session(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.3, 3000, 3000)
    boards.call('reset', DONGLE)
    boards.run(0.13)
    pong = boards.ask(Ping(1, b'ping'))
    assert pong.reset_cause == EXTERNAL_RESET
    assert pong.chip_ok
    state = boards.drive(3000, 3000)
    assert (state.session, state.seq) == (boards.session, boards.seq)
    assert state.status & StatusFlag.ENABLED


def test_watchdog_restarts_a_robot_that_hangs(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.3, 5000, 5000)
    boards.call('poke', ROBOT, TIMER_0_INTERRUPTS, 0)
    boards.run(0.2)
    assert boards.call('resets', ROBOT) == 1
    assert not boards.call('powered')
    boards.run(0.15)
    assert boards.hello().reset_cause & WATCHDOG_RESET


def test_imu_may_fail_and_come_back(boards: Boards) -> None:
    boards.start()
    state = boards.drive()
    assert not state.status & StatusFlag.IMU_FAULT
    assert (state.gyro_z, state.accel_x, state.accel_y) == (-131, 100, 200)
    boards.imu(False)
    boards.run(0.01)
    state = boards.drive()
    assert state.status & StatusFlag.IMU_FAULT
    assert (state.gyro_z, state.accel_x, state.accel_y) == (0, 0, 0)
    boards.imu(True, (1, 2, 3, 4, 5, 6, 7))
    boards.run(0.05)
    state = boards.drive()
    assert not state.status & StatusFlag.IMU_FAULT
    assert (state.gyro_z, state.accel_x, state.accel_y) == (7, 1, 2)
    parameters = [boards.call('imu_register', at) for at in (0x6B, 0x19, 0x1A, 0x1B, 0x1C)]
    assert parameters == [0x01, 0x04, 0x03, 0x08, 0x00]


@pytest.mark.parametrize('board', [DONGLE, ROBOT])
def test_a_radio_is_configured_again_after_power_loss(boards: Boards, board: int) -> None:
    boards.start()
    boards.drive()
    boards.rules_broken = True  # the firmware does not notice at once
    boards.call('radio_power', board, False)
    boards.run(0.05)
    boards.call('radio_power', board, True)
    boards.run(0.2)
    answers = []
    for _ in range(5):
        result = boards.ask(Transmit(0, GAP, codec.encode(boards.command())), 200000)
        answers.append(bool(result.first & 1))
        boards.run(0.2)
    assert answers[-1]


# -- sensors and parameters -----------------------------------------------------------------------


def test_ranges_battery_and_temperature_reach_the_host(boards: Boards) -> None:
    boards.start()
    for channel in range(8):
        metres = 0.12 + 0.08 * channel
        boards.call('millivolts', channel, round(1000 * (0.282 / (metres + 0.0257) + 0.061)))
    boards.call('millivolts', 8, 3025)
    boards.run(3.0)  # a low pass of 0.8 s
    state = boards.drive()
    for channel, code in enumerate(state.ranges):
        assert code * 0.005 == pytest.approx(0.12 + 0.08 * channel, rel=0.02)
    aux = boards.request(Poll(0, 0, 1), Poll(0, 0, 1))
    assert aux.battery == pytest.approx(12100, abs=40)
    assert (aux.temperature, aux.accel_z, aux.gyro_x, aux.gyro_y) == (3000, 16384, 10, 20)
    assert not aux.status & StatusFlag.LOW_BATTERY
    boards.call('millivolts', 8, 2450)
    boards.run(0.1)
    assert not boards.drive().status & StatusFlag.LOW_BATTERY
    boards.run(3.0)
    assert boards.drive().status & StatusFlag.LOW_BATTERY
    assert drive(boards, 0.1, 2000, 2000).status & StatusFlag.MOVING
    boards.call('millivolts', 8, 2000)
    boards.run(3.0)
    state = drive(boards, 0.1, 2000, 2000)
    assert not state.status & (StatusFlag.ENABLED | StatusFlag.MOVING)


def test_odometry_is_reset_on_request(boards: Boards) -> None:
    boards.start()
    drive(boards, 0.3, 5000, 5000)
    drive(boards, 0.4, 0, 0)
    assert boards.request(Action(boards.session, 9, RESET_ODOMETRY)).rc == OK
    state = boards.drive()
    assert (state.left, state.right) == (0, 0)


def test_keyed_robot_follows_only_signed_commands(boards: Boards) -> None:
    key = bytes(range(0x80, 0x90))
    boards.store(KEY_ADDRESS, key + crc16(key).to_bytes(2, 'little'))
    boards.run(0.13)
    assert boards.hello().session == 0  # an unsigned HELLO is rejected
    host_us = round(boards.now_us)
    hello = sign_hello(key, boards.session, 0, host_us, b'hostnonc')
    info = boards.request(hello, Poll(0, 1, 2), SLOW_GAP)
    assert info.session == boards.session
    signer = Signer(session_key(key, b'hostnonc', info.nonce), host_us)

    signed = signer.sign(boards.command(5000, 5000)._replace(tag=bytes(8)))
    assert boards.request(signed).status & StatusFlag.ENABLED
    boards.run(0.5)
    before = boards.pulses()
    forged = signer.sign(boards.command(5000, 5000)._replace(tag=bytes(8)))
    forged = forged._replace(left=6000)
    assert boards.request(forged).seq != forged.seq
    assert boards.request(signed).seq == signed.seq  # a replay counts once
    assert boards.drive(5000, 5000).seq == signed.seq  # unsigned
    boards.run(0.3)
    assert boards.pulses() == before
    aux = boards.request(Poll(0, 0, 1), Poll(0, 0, 1))
    assert aux.bad_session == 4  # including the HELLO


def test_signed_commands_are_answered_in_time(boards: Boards) -> None:
    """Two tags of more than 7000 cycles: the state is loaded before the POLL fetches it."""
    key = bytes(range(0x80, 0x90))
    boards.store(KEY_ADDRESS, key + crc16(key).to_bytes(2, 'little'))
    boards.run(0.13)
    host_us = round(boards.now_us)
    hello = sign_hello(key, boards.session, 0, host_us, b'hostnonc')
    info = boards.request(hello, Poll(0, 1, 2), SLOW_GAP)
    assert isinstance(info, Info)
    signer = Signer(session_key(key, b'hostnonc', info.nonce), host_us)
    times = []
    for _ in range(50):
        begun = boards.now_us
        state = boards.request(signer.sign(boards.command(3000, 3000)._replace(tag=bytes(8))))
        assert state.seq == boards.seq
        times.append((boards.now_us - begun) / 1000)
        boards.run_until(begun + 10000)
    print(f'\nsigned: round trip {statistics.median(times):.2f} ms, {max(times):.2f} ms (longest)')
    assert max(times) <= 7.0
    # A tag takes longer than a retransmission; neither disturbs the other.
    boards.call('loss', 0.2, 0.2)
    for _ in range(100):
        boards.request(signer.sign(boards.command(3000, 3000)._replace(tag=bytes(8))))
        boards.run(0.004)
    assert boards.radio(ROBOT).duplicates > 0
    assert boards.radio(ROBOT).ack_damaged == 0
