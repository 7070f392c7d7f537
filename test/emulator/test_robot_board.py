# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rules of the emulated robot board, payload by payload, with a pulse counter as hardware."""

import pytest
from support.emulator_bench import PulseCounter

from t3mpc_ros.emulator.board.eeprom import Setup
from t3mpc_ros.emulator.board.robot_board import PRESS_US, RELEASE_US, RobotBoard
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_uplink, encode
from t3mpc_ros.radio.protocol.frames import (
    Action,
    Command,
    CommandFlag,
    Hello,
    ParamGet,
    ParamSet,
    Poll,
    StatusFlag,
)

SESSION = 90
MOVE = int(CommandFlag.ENABLE)


class Robot:
    """A board in a session, and a host with a delay of 1 ms."""

    def __init__(self):
        self.hardware = PulseCounter()
        self.board = RobotBoard(self.hardware, b'', bytes, self._load)
        self.loaded = b''
        self.seq = 0
        self.run(1_000_000)
        self.hello()

    def _load(self, payload):
        self.loaded = payload

    @property
    def status(self):
        return self.board.status

    def run(self, us):
        self.board.run_to(self.board.now_us + us)

    def request(self, frame):
        self.board.receive(encode(frame) if not isinstance(frame, bytes) else frame)
        self.run(1000)
        return decode_uplink(self.loaded)

    def hello(self):
        self.request(Hello(SESSION, 0, self.board.now_us - 1000))

    def command(self, left=0, right=0, flags=MOVE, ttl=20, seq=None, session=SESSION, late_us=0):
        if seq is None:
            seq = self.seq = (self.seq + 1) % 256
        host_us = self.board.now_us - 1000 - late_us
        return self.request(Command(session, seq, flags, ttl, left, right, host_us))

    def set(self, number, value):
        return self.request(ParamSet(SESSION, 1, number, value))

    def aux(self):
        return self.request(Poll(0, 0, frames.AUX))

    def run_to_rest(self):
        self.run(2_000_000)


@pytest.fixture
def robot():
    return Robot()


def test_nothing_moves_before_hello_and_enable():
    robot = Robot()
    robot.board.boot(1, robot.board.now_us)
    robot.command(5000, 5000)
    assert robot.status == StatusFlag.NO_SESSION
    robot.hello()
    robot.command(5000, 5000, flags=0)
    assert robot.status == 0
    robot.command(5000, 5000)
    assert robot.status == StatusFlag.ENABLED | StatusFlag.MOVING


def test_only_newer_sequence_numbers_are_executed(robot):
    robot.command(1000, 1000, seq=250)
    for seq in (250, 249, 200, 123):
        robot.command(9000, 9000, seq=seq)
    robot.run(100_000)
    assert robot.board.speeds == (1_000_000, 1_000_000)
    assert robot.aux().duplicates == 4
    robot.command(2000, 2000, seq=(250 + 127) % 256)
    robot.run(100_000)
    assert robot.board.speeds == (2_000_000, 2_000_000)


def test_a_command_is_valid_for_its_ttl_up_to_the_maximum(robot):
    for ttl, held in ((10, 100_000), (255, 250_000)):
        robot.command(100, 100, ttl=ttl)
        robot.run(held - 1000 - 1000)
        assert robot.status == StatusFlag.ENABLED | StatusFlag.MOVING
        robot.run(10_000)
        assert robot.status == StatusFlag.ENABLED | StatusFlag.TTL_EXPIRED
    assert robot.aux().expired == 2
    robot.command(100, 100)
    assert not robot.status & StatusFlag.TTL_EXPIRED


def test_a_stale_command_is_rejected_but_a_stale_stop_executed(robot):
    robot.command(1000, 1000)
    robot.run(150_000)
    robot.command(9000, 9000, late_us=251_000)
    robot.run(20_000)
    assert robot.board.speeds == (1_000_000, 1_000_000)
    assert robot.aux().stale == 1
    robot.command(2000, 2000, late_us=249_000)
    robot.run(100_000)
    assert robot.board.speeds == (2_000_000, 2_000_000)
    assert robot.aux().stale == 1
    robot.command(0, 0, late_us=900_000)
    robot.run(140_000)
    assert robot.board.speeds == (0, 0)


def test_both_wheels_ramp_by_one_factor(robot):
    robot.command(8000, -4000)
    for _ in range(20):
        robot.run(10_000)
        left, right = robot.board.speeds
        assert right == pytest.approx(-left / 2, abs=1000)
        robot.command(8000, -4000)
    assert robot.status & StatusFlag.MOVING
    assert not robot.status & StatusFlag.LIMITED
    robot.command(20_000, -10_000)
    for _ in range(40):
        robot.run(20_000)
        robot.command(20_000, -10_000)
    assert robot.board.speeds == (10_000_000, -5_000_000)
    assert robot.status & StatusFlag.LIMITED


@pytest.mark.parametrize('session, seq', [(SESSION, 1), (SESSION, 0), (7, 200)])
def test_any_sender_may_stop_and_only_the_session_clears(robot, session, seq):
    robot.command(5000, 5000)
    robot.run(100_000)
    robot.command(flags=CommandFlag.ESTOP, session=session, seq=seq)
    robot.run_to_rest()
    assert robot.status == StatusFlag.ESTOP
    robot.command(5000, 5000)
    robot.run(50_000)
    assert robot.status == StatusFlag.ESTOP
    robot.command(flags=CommandFlag.ESTOP_CLEAR, session=7, seq=201)
    robot.command(flags=CommandFlag.ESTOP_CLEAR | CommandFlag.ENABLE)
    robot.command(1, 0, flags=CommandFlag.ESTOP_CLEAR)
    robot.run(100_000)
    assert robot.status == StatusFlag.ESTOP
    robot.command(flags=CommandFlag.ESTOP_CLEAR)
    assert robot.status == 0


def test_no_parameter_weakens_the_emergency_stop(robot):
    """An emergency stop used the deceleration that a host may set: down to 0.1 rad/s²."""
    assert robot.set(2, 100).rc == frames.OK
    stops = (
        lambda: robot.command(flags=CommandFlag.ESTOP),
        lambda: robot.board.press_button(True),
    )
    for stop in stops:
        robot.hello()
        for _ in range(60):
            robot.command(8000, -6000)
            robot.run(15_000)
        assert robot.board.speeds == (8_000_000, -6_000_000)
        stop()
        robot.run(int(8.0 / 60.0 * 1e6) + 3000 + PRESS_US)
        assert robot.board.speeds == (0, 0)
        robot.board.press_button(False)
        robot.run(RELEASE_US)
        robot.command(flags=CommandFlag.ESTOP_CLEAR)
        assert not robot.status & StatusFlag.ESTOP


def test_a_foreign_estop_keeps_the_sequence_of_the_host(robot):
    robot.command(1000, 1000)
    robot.command(flags=CommandFlag.ESTOP, session=7, seq=(robot.seq + 100) % 256)
    robot.command(flags=CommandFlag.ESTOP_CLEAR)
    robot.command(1000, 1000)
    assert robot.status == StatusFlag.ENABLED | StatusFlag.MOVING


def test_estop_is_not_cleared_while_the_button_is_pressed(robot):
    robot.command(5000, 5000)
    robot.run(100_000)
    robot.board.press_button(True)
    robot.run_to_rest()
    robot.command(flags=CommandFlag.ESTOP_CLEAR)
    robot.run(1000)
    assert robot.status == StatusFlag.ESTOP
    robot.board.press_button(False)
    robot.run(40_000)
    robot.command(flags=CommandFlag.ESTOP_CLEAR)
    assert robot.status == StatusFlag.ESTOP
    robot.run(10_000)
    robot.command(flags=CommandFlag.ESTOP_CLEAR)
    assert robot.status == 0


def test_a_spike_on_the_wire_of_the_button_does_not_stop(robot):
    robot.command(5000, 5000, ttl=25)
    robot.board.press_button(True)
    robot.run(4_000)
    robot.board.press_button(False)
    robot.run(1_000)
    assert not robot.status & StatusFlag.ESTOP
    robot.board.press_button(True)
    robot.run(5_200)
    assert robot.status & StatusFlag.ESTOP


def test_an_empty_battery_stops_the_robot_until_charged(robot):
    for millivolts, status in (
        (11_000, StatusFlag.ENABLED | StatusFlag.MOVING),
        (9_500, StatusFlag.ENABLED | StatusFlag.MOVING | StatusFlag.LOW_BATTERY),
        (8_500, StatusFlag.LOW_BATTERY),
        (9_900, StatusFlag.LOW_BATTERY),
        (10_500, StatusFlag.ENABLED | StatusFlag.MOVING),
    ):
        robot.hardware.battery = millivolts
        for _ in range(500):
            robot.command(5000, 5000)
            robot.run(10_000)
        assert robot.status == status


def test_only_the_settings_survive_a_reboot(robot):
    assert robot.set(0, 19_601).rc == frames.OUT_OF_RANGE
    assert robot.set(5, 200).rc == frames.READ_ONLY
    assert robot.set(4, 32).rc == frames.READ_ONLY
    assert robot.set(11, 1).rc == frames.UNKNOWN
    reply = robot.set(0, 5000)
    assert (reply.rc, reply.value) == (frames.OK, 5000)
    robot.board.settings_store.store(Setup(82, 32), robot.board.now_us)
    robot.run(200_000)
    robot.board.boot(4, robot.board.now_us)
    robot.hello()
    info = robot.request(Poll(0, 0, frames.INFO))
    assert (info.microsteps, info.reset_cause) == (32, 4)
    assert robot.request(ParamGet(SESSION, 1, 0)).value == 10_000
    # The limit of 10 000 pulses per second is 9.8 rad/s now.
    for _ in range(100):
        robot.command(10_000, 10_000)
        robot.run(10_000)
    assert robot.board.speeds[0] == 9_817_000


def test_an_action_runs_once_and_no_reset_while_moving(robot):
    robot.command(5000, 5000)
    assert robot.request(Action(SESSION, 1, frames.RESET_ODOMETRY)).rc == frames.BUSY
    robot.run_to_rest()
    assert min(robot.board.counters) > 100
    assert robot.request(Action(SESSION, 1, frames.RESET_ODOMETRY)).rc == frames.BUSY  # repeated
    assert robot.request(Action(SESSION, 2, frames.RESET_ODOMETRY)).rc == frames.OK
    assert robot.board.counters == (0, 0)


def test_drivers_switch_off_after_idle_time_but_not_while_moving(robot):
    robot.set(8, 500)
    robot.command(5000, 5000)
    robot.run(100_000)
    assert robot.hardware.on
    robot.command(flags=0)
    assert robot.hardware.on
    robot.run_to_rest()
    assert not robot.hardware.on
    robot.command()
    assert not robot.hardware.on  # idle time exceeded
    robot.command(1000, 1000)
    assert robot.hardware.on


def test_a_session_ends_after_half_an_hour_of_silence(robot):
    robot.run(1_799_000_000)
    assert not robot.status & StatusFlag.NO_SESSION
    robot.run(1_100_000)
    assert robot.status == StatusFlag.NO_SESSION


def test_clock_wrap_while_driving():
    robot = Robot()
    robot.board.boot(1, (1 << 32) - 500_000)
    robot.seq = 0
    board = robot.board
    robot.request(Hello(SESSION, 0, (board.now_us - 1000) % (1 << 32)))
    for index in range(100):
        host_us = (board.now_us - 1000) % (1 << 32)
        robot.request(Command(SESSION, (index + 1) % 256, MOVE, 20, 3000, 3000, host_us))
        robot.run(19_000)
        assert board.status == StatusFlag.ENABLED | StatusFlag.MOVING
    assert board.now_us > 1 << 32
    assert robot.aux().stale == 0
    assert robot.request(Poll(0, 0, frames.STATE)).time_us < 2_000_000


def test_an_oversized_payload_is_ignored(robot):
    stop = encode(Command(SESSION, 1, CommandFlag.ESTOP, 0, 0, 0, 0))
    robot.board.receive(stop + bytes(19))
    assert robot.status == 0
    assert robot.aux().short == 1
