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
"""The link against a scripted dongle and robot, in virtual time."""

import math
import random

import numpy as np
import pytest
from support.radio_bench import MS, FakeRobot, LinkBench

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.handshake import Session
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.setpoint_arbitration import SetpointArbiter
from t3mpc_ros.radio.link.statistics import DiagnosticLevel, LinkStatistics
from t3mpc_ros.radio.link.telemetry import CommandTiming, TelemetryDecoder
from t3mpc_ros.radio.link.transaction import TransactionLayer
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import BOARD_PARAMETERS, CommandFlag
from t3mpc_ros.radio.protocol.framing import encode_frame

KEY = bytes(range(60, 76))


@pytest.fixture
def bench():
    """Return a bench with a running link, commands with tags, and a moving robot."""
    made = LinkBench(key=KEY)
    made.connect()
    made.drive(3.0, -2.0)
    made.run(0.5)
    assert made.robot.speeds == (-2.0, 3.0)
    assert made.link.reason(made.now_ns) == ''
    return made


def running(bench):
    return bench.link.state is LinkState.RUN


def moving(bench):
    return bench.robot.speeds == (-2.0, 3.0) and bench.link.reason(bench.now_ns) == ''


def commands(bench, since_ns=0):
    return [
        frame
        for at, frame in bench.robot.log
        if isinstance(frame, frames.Command) and at >= since_ns
    ]


# -- connecting -----------------------------------------------------------------------------------


@pytest.mark.parametrize('key', [b'', KEY])
def test_from_a_closed_port_to_running(key):
    bench = LinkBench(key=key)
    assert bench.link.state is LinkState.CLOSED
    assert bench.connect() < 0.2
    assert [state.name for state in bench.link_states] == ['PING', 'CFG', 'HELLO', 'PARAMS', 'RUN']
    assert bench.robot.speeds == (0.0, 0.0)
    bench.run(0.1)
    assert bench.link.reason(bench.now_ns) == reasons.NO_COMMAND
    assert bench.link.authenticated == bool(key)
    assert all(bool(frame.tag) == bool(key) for frame in commands(bench))
    info = bench.link.info
    assert (info.steps_per_rev, info.microsteps) == (200, 16)


@pytest.mark.parametrize('key', [b'', KEY])
def test_a_state_in_answer_to_hello_leads_to_info(key):
    """The POLL after HELLO is lost, and the first packet fetched a STATE."""
    bench = LinkBench(key=key)
    take = bench.robot.receive

    def plain(data, now_ns):
        take(data, now_ns)
        if data[0] == 0x24:
            bench.robot.answer = None

    bench.robot.receive = plain
    assert bench.connect() < 0.2
    assert bench.link_states[2:5] == [LinkState.HELLO, LinkState.INFO, LinkState.PARAMS]


def test_board_parameters_are_written_and_read_back():
    values = {
        'max_speed': 7.5, 'acceleration': 12.0, 'deceleration': 22.0, 'ttl_max': 0.3,
        'battery_low': 9.9, 'idle_off': 60.0, 'battery_cutoff': 8.8,
    }  # fmt: skip
    parameters = {f'robot.{name}': value for name, value in values.items()}
    bench = LinkBench(LinkParameters.from_dict(parameters | {'robot.invert_right': True}))
    bench.connect()
    expected = {row.name: row.default for row in BOARD_PARAMETERS}
    expected |= {name: round(1000 * value) for name, value in values.items()}
    expected |= {'invert_wheels': 2, 'boots': 1}
    assert bench.link.board_parameters == expected
    assert bench.robot.parameters == list(expected.values())
    order = [type(frame).__name__ for _, frame in bench.robot.log]
    assert order.index('ParamGet') > max(at for at, name in enumerate(order) if name == 'ParamSet')


def test_parameter_defaults_equal_those_of_the_board():
    wire = LinkParameters().robot.to_wire()
    assert len(wire) == 8
    for number, value in wire.items():
        row = BOARD_PARAMETERS[number]
        assert value == row.default
        assert row.low <= value <= row.high
        assert row.low < row.high, 'read-only'


def test_a_dongle_reset_by_opening_the_port_has_time_to_start():
    bench = LinkBench()
    bench.dongle.boot_delay_ns = 1500 * MS
    bench.dongle.restart(bench.now_ns)
    bench.run(1.0)
    assert bench.link.state is LinkState.PING
    assert bench.link.reason(bench.now_ns) == reasons.DONGLE_STARTING
    assert bench.run(3.0, lambda: running(bench)) < 0.8
    assert len(bench.opens) == 1


def test_another_device_is_retried_with_growing_intervals():
    """A GPS receiver that sends continuously."""
    bench = LinkBench()
    bench.dongle.receive = lambda data, now_ns: [(now_ns + MS, b'$GPGGA,123519,4807.038,N*47\r\n')]
    bench.run(40.0)
    gaps = np.diff(bench.opens) / 1e9
    np.testing.assert_allclose(gaps, [5.2, 5.4, 5.8, 6.6, 7.0, 7.0][: len(gaps)], atol=0.02)
    assert len(gaps) >= 5
    assert bench.link.reason(bench.now_ns) in (reasons.NO_DONGLE, reasons.DONGLE_STARTING)


def test_a_busy_port_is_retried_ever_less_a_new_one_at_once():
    """Regression: the retry interval outlasted an absence, and a free device waited for 2 s."""
    bench = LinkBench()
    bench.problem = ('/dev/ttyUSB0 is busy', False)
    bench.run(12.0)
    assert bench.link.reason(bench.now_ns) == '/dev/ttyUSB0 is busy'
    np.testing.assert_allclose(np.diff(bench.opens[:7]) / 1e9, [0.2, 0.4, 0.8, 1.6, 2.0, 2.0])
    bench.problem = ('/dev/ttyUSB0 is not there', True)
    bench.unplug()
    bench.run(6.0)
    np.testing.assert_allclose(np.diff(bench.opens[-10:]) / 1e9, 0.2)
    assert bench.link.reason(bench.now_ns) == '/dev/ttyUSB0 is not there'
    # Present, but busy again: the interval grows from its start.
    bench.problem = ('/dev/ttyUSB0 is busy', False)
    since = len(bench.opens)
    bench.run(4.0)
    gaps = np.diff(bench.opens[since : since + 4]) / 1e9
    np.testing.assert_allclose(gaps, [0.2, 0.4, 0.8])
    bench.problem = ('', True)
    bench.plug()
    assert bench.connect() < 2.2
    # An answer of the dongle resets the retry interval.
    bench.problem = ('/dev/ttyUSB0 is busy', False)
    bench.link.port_failed('/dev/ttyUSB0 failed', False, bench.now_ns)
    since = len(bench.opens)
    bench.run(2.0)
    np.testing.assert_allclose(np.diff(bench.opens[since : since + 3]) / 1e9, [0.4, 0.8])


def test_the_usb_port_of_the_robot_is_recognised():
    """Its console answers PING, too: the dongle was said to reject the radio configuration."""
    bench = LinkBench()
    refusal = frames.Refusal(frames.UNKNOWN, 2)
    bench.dongle.change = lambda reply: reply if isinstance(reply, frames.Pong) else refusal
    bench.run(5.0)
    assert bench.link.reason(bench.now_ns) == reasons.ROBOT_USB
    assert len(bench.opens) == 1, 'opening the port resets the robot'


def test_a_rejected_radio_configuration_is_reported():
    """Its radio would reach no robot, or another one."""
    bench = LinkBench()
    sent = bench.dongle.change
    bench.dongle.change = lambda reply: (
        reply._replace(channel=76) if isinstance(reply, frames.Configured) else reply
    )
    bench.run(2.0)
    assert bench.link.reason(bench.now_ns) == reasons.RADIO_NOT_CONFIGURED
    assert LinkState.HELLO not in bench.link_states
    bench.dongle.change = sent
    assert bench.connect() < 0.3


def test_a_rejected_parameter_is_reported_and_nothing_moves():
    bench = LinkBench()
    bench.robot.refuses[1] = frames.OUT_OF_RANGE
    bench.drive(1.0, 1.0)
    bench.run(3.0)
    assert bench.link.state is LinkState.PARAMS
    assert bench.link.reason(bench.now_ns) == (
        'parameter acceleration = 30000 was refused: the robot allows 100 to 100000'
    )
    assert commands(bench) == []
    bench.robot.refuses = {9: frames.UNKNOWN}  # of older firmware, which has fewer
    bench.run(2.0)
    text = 'invert_wheels = 0 was refused: the robot does not support it'
    assert text in bench.link.reason(bench.now_ns)
    bench.robot.refuses.clear()
    keep = bench.robot.set
    bench.robot.set = lambda frame: (keep(frame), bench.robot.parameters.__setitem__(2, 4711))
    bench.run(2.0)
    assert bench.link.reason(bench.now_ns) == (
        'parameter deceleration must be 60000: the robot keeps 4711'
    )
    bench.robot.set = keep
    assert LinkState.RUN not in bench.link_states
    assert bench.connect() < 1.2


# -- measuring ------------------------------------------------------------------------------------


def test_a_state_is_converted_to_si_units():
    bench = LinkBench()
    bench.connect()
    bench.run(1.5)
    telemetry = bench.link.telemetry
    assert telemetry.imu.angular == pytest.approx(math.radians(655 / 65.5))
    assert telemetry.imu.forward == pytest.approx(9.80665)
    assert telemetry.imu.sideways == pytest.approx(-9.80665 / 2)
    expected = (math.nan, -math.inf, 0.1, 0.5, 0.8, math.inf, math.nan, 0.3)
    np.testing.assert_array_equal(telemetry.ranges, expected)
    assert telemetry.status.enabled
    assert not telemetry.status.moving
    assert bench.link.battery.voltage == 11.1
    assert math.isnan(bench.link.battery.charge)
    assert bench.link.quality(bench.now_ns).robot.bad_session == 3
    assert bench.link.quality(bench.now_ns).dongle.protocol == frames.VERSION


def test_a_state_not_newer_than_the_last_is_dropped():
    """When the POLL is lost, the payload is an older STATE."""
    robot, decoder = FakeRobot(), TelemetryDecoder()
    old, new = robot.state(0), robot.state(20 * MS)
    assert decoder.decode(new, 21 * MS).raw is new
    assert decoder.decode(old, 41 * MS) is None
    assert decoder.decode(new, 61 * MS) is None
    assert decoder.decode(robot.state(80 * MS), 81 * MS) is not None


def test_only_states_of_the_session_are_measurements():
    """Whether the robot restarted before another session is known only when that has started."""
    robot, decoder = FakeRobot(), TelemetryDecoder()
    of = lambda session, ms: robot.state(ms * MS)._replace(session=session)  # noqa: E731
    assert decoder.start_session(5, 40, 0) == 0
    assert decoder.decode(of(5, 20), 21 * MS) is not None
    assert decoder.decode(of(0, 40), 41 * MS) is None
    assert decoder.decode(of(6, 60), 61 * MS) is None
    assert decoder.start_session(6, 40, 70 * MS) == 0
    assert decoder.decode(of(6, 80), 81 * MS) is not None


@pytest.mark.parametrize(
    'before, after, restarts',
    [(7, 7, 0), (7, 8, 1), (7, 10, 3), (2**31 - 1, 1, 2), (7, 123456, 1), (9, 7, 1), (None, 3, 1)],
)
def test_restarts_are_counted_by_the_count_of_the_robot(before, after, restarts):
    """Modulo 2**31; a count that was lost starts anywhere, and old firmware has none."""
    decoder = TelemetryDecoder()
    assert decoder.start_session(1, before, 0) == 0
    assert decoder.start_session(2, after, 10) == restarts


def test_what_a_restarted_robot_has_counted_is_not_lost():
    """Another host may have driven it: its counters have begun at 0."""
    robot, decoder = FakeRobot(), TelemetryDecoder()
    decoder.start_session(1, 7, 0)
    robot.steps = [100.0, 1000.0]
    assert decoder.decode(robot.state(20 * MS)._replace(session=1), 21 * MS)
    robot.boot(30 * MS, steps=(50, 500))
    assert decoder.start_session(2, 8, 40 * MS) == 1
    found = decoder.decode(robot.state(60 * MS)._replace(session=2), 61 * MS)
    step = math.tau / 3200
    assert found.angles == pytest.approx((500 * step, 50 * step))
    assert found.wheels == (0.0, 0.0)


def test_a_clock_that_wraps_between_two_sessions_is_no_restart():
    """The counters continue, too: the steps between are measured, whatever time has passed."""
    robot, decoder = FakeRobot(), TelemetryDecoder()
    now_ns = 0
    for session, hours in ((1, 0.0), (2, 0.7), (3, 1.3), (4, 26.0)):
        now_ns += round(hours * 3600e9) + MS
        robot.steps[1] += 1000.0
        assert decoder.start_session(session, 4, now_ns) == 0
        state = robot.state(now_ns)._replace(session=session)
        assert decoder.decode(state, now_ns + MS).stamp_ns == now_ns + MS
    assert decoder.angles.right == pytest.approx(3000 * math.tau / 3200)


def test_the_dongle_restarts_only_if_no_delay_explains_its_clock():
    """Each of two replies may have waited to be read; the time of the dongle lies between."""
    second = 10**9
    for before_read, after_read, elapsed_us, restarted in (
        (0.01, 0.01, 20_000, False),
        (0.01, 2.0, 20_000, False),  # suspended before the second one was read
        (2.0, 0.01, 2_000_000, False),  # suspended before the first one was read
        (2.0, 0.01, 20_000, False),
        (0.01, 0.01, 3_000_000, True),
        (0.01, 0.01, -50_000, True),
        (2.0, 0.01, -50_000, True),
        (2.0, 0.01, 4_000_000, True),
        (0.01, 0.01, -3_000_000_000, True),
    ):
        transactions = TransactionLayer(LinkStatistics(0.02, 0.2))
        now_ns, clock_us = 100 * second, 3_000_000_000
        for read, clock in ((before_read, clock_us), (after_read, clock_us + elapsed_us)):
            transactions.ping(second, now_ns)
            number, echo = transactions._pending.request
            now_ns += round(read * second)
            pong = frames.Pong(
                number, echo, clock % 2**32, 2, 2, 1, 1, 0, 0, 0, 0, 0, 82, bytes(5), 0
            )
            (result,) = transactions.feed(encode_frame(encode(pong)), now_ns)
            now_ns += 10 * MS
        assert result.dongle_restarted == restarted, (before_read, after_read, elapsed_us)


def test_a_dongle_with_another_configuration_has_restarted():
    """Its clock may show nothing: it restarted while the host was suspended."""
    bench = LinkBench(LinkParameters(channel=90))
    bench.connect()
    bench.drive(3.0, -2.0)
    bench.run(1.5)
    bench.dongle.radio = 82, b'T3MPC'
    assert bench.run(3.0, lambda: not running(bench)) < 1.1
    assert bench.link.state is LinkState.CFG
    assert bench.link.quality(bench.now_ns).dongle_resets == 1
    assert bench.run(1.0, lambda: moving(bench)) < 0.3
    assert bench.dongle.radio == (90, b'T3MPC')


def test_a_sample_is_stamped_by_its_age_since_the_command():
    """The age counts in 10 us from the reception of the CMD, sent at 20 ms and 1 ms on its way."""
    state = FakeRobot().state(25 * MS)._replace(age=400)
    telemetry = TelemetryDecoder().decode(state, 30 * MS, CommandTiming(20 * MS, MS))
    assert telemetry.stamp_ns == 25 * MS


# -- commanding -----------------------------------------------------------------------------------


def test_the_newest_command_wins_and_none_is_queued(bench):
    source = random.Random(1)
    for _ in range(50):
        since = bench.now_ns
        for _ in range(7):
            wheels = WheelSpeeds(source.uniform(-5, 5), source.uniform(-5, 5))
            bench.link.command(wheels, bench.now_ns + 250 * MS)
        bench.release_controls()
        bench.run(0.03)
        sent = commands(bench, since)
        assert 1 <= len(sent) <= 2
        wanted = round(1000 * wheels.left), round(1000 * wheels.right)
        assert {(frame.left, frame.right) for frame in sent} == {wanted}
        assert bench.link.sent_wheels == pytest.approx(wheels, abs=5e-4)


def test_commands_are_numbered_and_periodic(bench):
    since = bench.now_ns
    bench.run(2.0)
    times = [at for at, frame in bench.robot.log if isinstance(frame, frames.Command)]
    times = [at for at in times if at > since]
    assert len(times) == pytest.approx(100, abs=1)
    np.testing.assert_allclose(np.diff(times), 20 * MS, atol=4 * MS)
    steps = np.diff([frame.seq for frame in commands(bench, since)]) % 256
    assert set(steps.tolist()) == {1}
    assert bench.link.quality(bench.now_ns).lost == 0


def test_the_robot_stops_when_its_command_expires(bench):
    bench.release_controls()
    bench.run(0.2)
    assert moving(bench)
    bench.run(0.1)
    assert bench.robot.speeds == (0.0, 0.0)
    assert bench.link.reason(bench.now_ns) == reasons.COMMAND_EXPIRED
    assert bench.robot.enabled
    assert commands(bench)[-1].flags == CommandFlag.ENABLE
    bench.drive(3.0, -2.0)
    bench.run(0.1)
    assert moving(bench)


# -- emergency stop -------------------------------------------------------------------------------


def test_emergency_stop_and_release(bench):
    bench.link.latch_estop('asked for')
    bench.run(0.03)
    assert bench.robot.estop
    assert bench.robot.speeds == (0.0, 0.0)
    bench.run(1.0)
    assert bench.link.quality(bench.now_ns).sessions == 1
    assert bench.link.reason(bench.now_ns) == 'emergency stop: asked for'
    bench.release_controls()
    assert bench.link.release_estop(bench.now_ns) == ''
    bench.run(0.3)
    assert not bench.robot.estop
    # The command from before the stop is not resumed.
    assert bench.robot.speeds == (0.0, 0.0)
    assert 'released' in bench.link.reason(bench.now_ns)
    assert bench.link.release_estop(bench.now_ns) == 'no emergency stop is latched'
    bench.drive(3.0, -2.0)
    bench.run(0.1)
    assert moving(bench)


def test_a_setpoint_ends_with_its_command():
    """The host may die after any setpoint: the robot must not drive on longer than it was told.

    The time to live is in units of 10 ms. A part of a unit is not rounded up; only the last
    setpoint of a command has one unit, the least there is.
    """
    arbiter = SetpointArbiter(LinkParameters())
    until_ns = 1000 * MS
    arbiter.command(WheelSpeeds(1.0, 2.0), until_ns)
    left = {200: 20, 199: 19, 105: 10, 100: 10, 99: 9, 20: 2, 19: 1, 10: 1, 3: 1}
    found = {ms: arbiter.next_setpoint(False, until_ns - ms * MS).ttl for ms in left}
    assert found == left
    assert arbiter.next_setpoint(False, until_ns)[1:3] == (0, 0)


def test_the_button_of_the_robot_is_reported_and_released(bench):
    bench.robot.estop = bench.robot.button = True
    bench.run(0.1)
    assert bench.robot.speeds == (0.0, 0.0)
    assert bench.link.reason(bench.now_ns) == reasons.ROBOT_ESTOP
    assert bench.link.release_estop(bench.now_ns) == ''
    bench.run(1.2)
    assert bench.robot.estop
    assert bench.link.reason(bench.now_ns) == reasons.ESTOP_BUTTON_HELD
    bench.robot.button = False
    assert bench.link.release_estop(bench.now_ns) == ''
    bench.run(0.2)
    assert moving(bench)


# -- faults of the link ---------------------------------------------------------------------------


def test_sequence_numbers_are_valid_after_a_long_jam(bench):
    """Eight bits: after 128 lost commands the robot would reject new ones as old."""
    for jam_ns in (2600 * MS, 3500 * MS, 5100 * MS):
        bench.dongle.jam_until_ns = bench.now_ns + jam_ns
        bench.run(jam_ns / 1e9)
        assert bench.run(2.0, lambda: moving(bench)) < 0.4


def test_an_ended_session_is_not_a_restart(bench):
    before = bench.link.quality(bench.now_ns)
    bench.robot.verifier = type(bench.robot.verifier)(bench.robot.key)
    assert bench.run(1.0, lambda: not running(bench)) < 0.05
    assert bench.run(1.0, lambda: moving(bench)) < 0.3
    quality = bench.link.quality(bench.now_ns)
    assert quality.robot_resets == before.robot_resets == 0
    assert quality.sessions == 2
    bench.run(0.5)
    assert bench.link.telemetry.angles.right == pytest.approx(bench.robot.angles[0], abs=0.15)


def test_a_session_with_a_replayed_hello_is_replaced():
    """A replayed HELLO has the right session number and leads to another robot nonce."""
    bench = LinkBench(key=KEY)
    bench.connect()
    old = next(frame for _, frame in bench.robot.log if isinstance(frame, frames.Hello))
    bench.robot.boot(bench.now_ns)
    bench.connect()
    bench.drive(3.0, -2.0)
    bench.run(0.5)
    assert moving(bench)
    bench.robot.verifier.begin_session(old, b'ANEWONE.')
    bench.robot.last_seq = None
    assert bench.run(3.0, lambda: not running(bench)) < 0.7
    assert bench.run(3.0, lambda: moving(bench)) < 0.4


def test_a_shutdown_after_a_pause_disables_the_drives(bench):
    """The first command after the pause has an old echo: its refusal once ended the shutdown."""
    bench.link.shut_down()
    bench.run(0.05)
    bench.now_ns += 600 * MS
    bench.robot.run_to(bench.now_ns)
    assert bench.robot.enabled
    bench.run(1.0, lambda: bench.link.state is LinkState.DONE)
    assert not bench.robot.enabled


def test_rejected_commands_are_reported_and_end_the_session(bench):
    bench.robot.rejects_commands = True
    assert bench.run(2.0, lambda: not running(bench)) == pytest.approx(0.5, abs=0.1)
    assert 'overtaken by newer' in bench.link.reason(bench.now_ns)
    bench.robot.rejects_commands = False
    assert bench.run(2.0, lambda: moving(bench)) < 0.4


def test_a_fast_dongle_restart_is_detected_by_its_clock(bench):
    """After a watchdog reset no frame is lost, but the radio is not configured."""
    bench.run(2.0)
    bench.dongle.restart(bench.now_ns)
    assert bench.run(1.0, lambda: not running(bench)) < 0.05
    assert bench.run(1.0, lambda: moving(bench)) < 0.3
    assert bench.link.quality(bench.now_ns).dongle_resets == 1


def test_a_busy_dongle_costs_cycles_only(bench):
    bench.dongle.busy = 20
    bench.run(1.0)
    assert moving(bench)
    assert bench.link.quality(bench.now_ns).lost == pytest.approx(20, abs=2)
    assert running(bench)


def test_lost_results_time_out_without_a_new_search(bench):
    bench.dongle.drop_replies = 4
    bench.run(0.4)
    assert moving(bench)
    assert bench.link.quality(bench.now_ns).lost in (3, 4)
    assert LinkState.PING not in bench.link_states[1:]


def test_the_wrap_of_the_host_clock_has_no_effect():
    made = LinkBench(key=KEY)
    made.now_ns = (2**32 - 2_000_000) * 1000
    made.dongle.restart(made.now_ns)
    made.robot.boot(made.now_ns)
    made.connect()
    made.drive(3.0, -2.0)
    made.run(4.0)
    assert moving(made)
    assert made.link.quality(made.now_ns).lost == 0
    assert made.link.quality(made.now_ns).sessions == 1


def test_a_late_reply_is_not_matched_to_the_next_request():
    """A late result does not count as the result of the next command."""
    transactions = TransactionLayer(LinkStatistics(0.02, 0.2))
    command, poll = frames.Command(1, 1, 0, 0, 0, 0, 5), frames.Poll(1, 1, frames.STATE)
    transactions.transact(command, poll, 6, 0)
    assert transactions.expire(49 * MS) is None
    assert transactions.expire(50 * MS).reply is None
    assert transactions.timeouts == 1
    transactions.transact(command, poll, 6, 60 * MS)
    late, due = (encode_frame(encode(frames.Result(number, 0x34, 0x08, 0))) for number in (1, 2))
    assert transactions.feed(late, 61 * MS) == []
    (result,) = transactions.feed(due + due, 64 * MS)
    assert result.round_trip == 0.004
    assert transactions.timeouts == 0
    transactions.ping(50 * MS, 70 * MS)
    pong = frames.Pong(3, b'late', 0, 1, 1, 0, 1, 0, 0, 0, 0, 0, 82, b'T3MPC', 0)
    assert transactions.feed(encode_frame(encode(pong)), 71 * MS) == []
    assert transactions.deadline_ns == 120 * MS


@pytest.mark.parametrize('tries', [0, 1])
def test_only_commands_without_retransmission_time_the_clock(tries):
    transactions = TransactionLayer(LinkStatistics(0.02, 0.2))
    command, poll = frames.Command(1, 1, 0, 0, 0, 0, 5), frames.Poll(1, 1, frames.STATE)
    payload = encode(FakeRobot().state(0))
    for first in (command, poll):
        transactions.transact(first, poll, 6, 10 * MS)
        number = 1 if first is command else 2
        result = frames.Result(number, 0x03 | tries << 4, 0x03, 0, payload)
        (result,) = transactions.feed(encode_frame(encode(result)), 14 * MS)
        assert result.uplink == FakeRobot().state(0)
        assert (result.timing is not None) == (first is command and tries == 0)
        if result.timing is not None:
            assert result.timing == (10 * MS, 965_000)


# -- requests, shutdown, timing -------------------------------------------------------------------


def test_requests_are_sent_at_a_hundred_cycles_per_second():
    """Regression: requests starved, because a 10 ms period has no idle time."""
    bench = LinkBench(LinkParameters(cycle_rate=100.0))
    bench.connect()
    bench.drive(0.0, 0.0)
    bench.run(0.5)
    since = bench.now_ns
    bench.run(3.0)
    quality = bench.link.quality(bench.now_ns)
    assert quality.robot is not None
    assert bench.now_ns / 1e3 - quality.dongle.time_us < 1.2e6
    assert len(commands(bench, since)) > 285


def test_shutdown_stops_disables_the_drives_and_closes(bench):
    since = bench.now_ns
    bench.link.shut_down()
    assert bench.run(1.5, lambda: bench.link.state is LinkState.DONE) < 0.2
    sent = commands(bench, since)
    assert len(sent) >= 4
    assert [frame.flags for frame in sent] == [CommandFlag.ENABLE] * (len(sent) - 1) + [0]
    assert all((frame.left, frame.right) == (0, 0) for frame in sent)
    assert not bench.robot.enabled
    assert not bench.is_open
    assert bench.link.reason(bench.now_ns) == reasons.SHUT_DOWN
    opened = len(bench.opens)
    bench.link.port_failed('too late', False, bench.now_ns)
    bench.run(3.0)
    assert len(bench.opens) == opened
    assert bench.link.state is LinkState.DONE


def test_drives_are_disabled_only_at_standstill(bench):
    """Motors without power roll on: they have to stop first."""
    follow = bench.robot.follow

    def slow(frame, now_ns):
        follow(frame, now_ns)
        if bench.robot.enabled and now_ns < end_ns:
            bench.robot.speeds, bench.robot.until_ns = (1.0, 1.0), end_ns

    end_ns = bench.now_ns + 400 * MS
    bench.robot.follow = slow
    bench.link.shut_down()
    assert bench.run(1.5, lambda: bench.link.state is LinkState.DONE) > 0.4
    assert [frame.flags for frame in commands(bench)].count(0) == 1


@pytest.mark.parametrize('fault', ['the robot is absent', 'the robot restarts'])
def test_a_shutdown_ends_in_time_and_starts_no_session(bench, fault):
    if fault == 'the robot is absent':
        bench.dongle.jam_until_ns = bench.now_ns + 60_000 * MS
        bench.run(0.5)
    bench.link.shut_down()
    if fault == 'the robot restarts':
        bench.robot.boot(bench.now_ns)
    bench.dongle.requests.clear()
    assert bench.run(1.5, lambda: bench.link.state is LinkState.DONE) < 1.3
    assert not any(isinstance(frame, frames.Hello) for _, frame in bench.dongle.requests)


def test_a_port_failure_drops_the_request_in_flight(bench):
    bench.run(0.5, lambda: bench.link._transactions.deadline_ns is not None)
    bench.link.port_failed('failed', True, bench.now_ns)
    assert bench.link.step(bench.now_ns)[-1].until_ns - bench.now_ns == 200 * MS


@pytest.mark.parametrize('seconds', [0.0, 0.03])
def test_shutdown_before_the_session(seconds):
    bench = LinkBench()
    bench.run(seconds)
    bench.link.shut_down()
    bench.run(0.1)
    assert bench.link.state is LinkState.DONE
    assert not bench.is_open


def test_the_link_does_not_poll_busily(bench):
    calls = 0
    step = bench.link.step

    def counted(now_ns, received):
        nonlocal calls
        calls += 1
        return step(now_ns, received)

    bench.link.step = counted
    bench.run(2.0)
    assert calls < 2 * 50 * 6
    bench.unplug()
    bench.release_controls()
    bench.run(0.1)
    calls = 0
    bench.run(3.0)
    assert calls < 3 * 5 * 4


def test_stamps_increase_strictly_with_a_stopped_clock():
    session = Session(KEY, random.Random(1).randbytes, 0, 5_000_000)
    stamps = [session.hello(5_000_000).host_us]
    info = FakeRobot(KEY).info(0, 0)._replace(session=session.number)
    assert session.accept(info) == ''
    for now_ns in (5_000_000, 5_000_000, 4_000_000, 5_000_400, 9_000_000):
        stamps.append(session.command(0, 0, 0, 0, now_ns).host_us)
    assert stamps == [5001, 5002, 5003, 5004, 5005, 9000]


def test_each_signed_hello_has_a_new_stamp_and_the_same_nonce():
    """The robot recognises a repetition by its nonce."""
    bench = LinkBench(key=KEY)
    bench.dongle.loss = 1.0
    bench.run(5.0)
    sent = [(at, frame) for at, frame in bench.dongle.requests if isinstance(frame, frames.Hello)]
    assert len(sent) > 20
    for at, frame in sent:
        assert 0 <= at // 1000 - frame.host_us < 20_000
    assert len({frame.nonce for _, frame in sent}) == 1
    bench.dongle.loss = 0.0
    assert bench.connect() < 1.0


def test_a_signed_hello_has_a_longer_gap():
    """Regression: an AVR loads INFO after more than 1.5 ms; the POLL fetched an older frame."""
    parameters = LinkParameters()
    session = Session(KEY, random.Random(1).randbytes, 0, 0)
    assert parameters.gap_after(session.hello(1000)) * 250e-6 == pytest.approx(5e-3)
    open_one = Session(b'', random.Random(1).randbytes, 0, 0)
    assert parameters.gap_after(open_one.hello(1000)) == parameters.gap
    assert parameters.gap_after(session.command(0, 0, 0, 0, 2000)) == parameters.gap


def test_requests_and_commands_are_numbered_separately():
    """Otherwise the robot would reject a command as old after 128 lost requests."""
    session = Session(b'', random.Random(1).randbytes, 0, 0)
    before = session.command(0, 0, 0, 0, 1000).seq
    numbers = {session.get(0).seq for _ in range(200)} | {session.set(0, 1, 2000).seq}
    assert len(numbers) == 201
    assert session.command(0, 0, 0, 0, 4000).seq == before + 1


def test_invalid_link_parameters_are_rejected():
    with pytest.raises(ParameterError, match='ttl must be at most robot.ttl_max'):
        LinkParameters(ttl=0.3)
    for address in ('c25a33a6', 'c25a33a6zz', 'c2 5a 33 a6', 'c25a33a6e1e1'):
        with pytest.raises(ParameterError, match='address must be 10 hexadecimal digits'):
            LinkParameters(address=address)
    slow = LinkParameters(rate='250k')
    assert (slow.gap, slow.configure(1).retry_delay, slow.configure(1).rate) == (11, 5, 0)
    assert (LinkParameters().gap, LinkParameters().configure(1).rate) == (6, 1)


def test_a_jam_stops_the_robot_and_the_link_recovers(bench):
    bench.dongle.jam_until_ns = bench.now_ns + 1000 * MS
    bench.run(0.22)
    bench.robot.run_to(bench.now_ns)
    assert bench.robot.speeds == (0.0, 0.0)
    assert bench.robot.expired
    bench.run(0.28)
    assert 'does not answer' in bench.link.reason(bench.now_ns)
    quality = bench.link.quality(bench.now_ns)
    assert quality.level is DiagnosticLevel.ERROR
    assert 'no telemetry for 0.5' in quality.text
    session = bench.robot.verifier.session
    bench.run(0.5)
    assert bench.run(1.0, lambda: moving(bench)) < 0.05
    assert bench.robot.verifier.session == session
    quality = bench.link.quality(bench.now_ns)
    assert 45 <= quality.lost <= 52
    assert quality.level is DiagnosticLevel.WARN
    assert 'of the cycles are lost' in quality.text


def test_an_emergency_stop_survives_a_jammed_link(bench):
    bench.dongle.jam_until_ns = bench.now_ns + 300 * MS
    bench.link.latch_estop('asked for')
    bench.run(0.4)
    assert bench.robot.estop


def test_another_host_on_the_robot_is_detected():
    bench = LinkBench()
    bench.connect()
    ours = bench.robot.verifier.session
    theirs = ours % 255 + 1
    bench.robot.receive(bytes([0x24, theirs, 0, 0]), bench.now_ns)
    bench.run(0.05, lambda: not running(bench))
    assert bench.link.reason(bench.now_ns) == 'the robot has lost its session'
    bench.run(1.0, lambda: running(bench))
    assert bench.robot.verifier.session not in (0, ours)


def test_unplugged_and_plugged_in_again(bench):
    bench.run(1.0)
    start = bench.link.telemetry.angles.right
    for away in (0.05, 0.7, 13.0):
        bench.unplug()
        closes = bench.closes
        opened = len(bench.opens)
        bench.run(0.02)
        # With the next cycle: while the dead device is open, it reappears under another name.
        assert bench.closes == closes + 1
        bench.problem = ('dongle is not there', True)
        bench.run(away)
        assert bench.link.reason(bench.now_ns) == 'dongle is not there'
        assert len(bench.opens) - opened <= 5 * away + 2
        bench.plug()
        assert bench.run(2.0, lambda: moving(bench)) < 1.0
    quality = bench.link.quality(bench.now_ns)
    assert quality.port_failures == 3
    assert quality.robot_resets == 0
    bench.run(0.5)
    assert bench.link.telemetry.angles.right > start
    assert bench.link.telemetry.angles.right == pytest.approx(bench.robot.angles[0], abs=0.15)
