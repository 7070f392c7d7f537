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
"""Input watchdog and response monitor; the controller with an unresponsive robot."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule
import numpy as np
import pytest
from support.constants import split_constants
from support.control_loops import GEOMETRY, PERIOD, ServoLoop
from support.properties import PROPERTY, STATEFUL

from t3mpc_ros.control.watchdog import (
    ASTRAY_TIME,
    EVIDENCE_WEIGHT,
    FROZEN_MOTION,
    PAUSE,
    RECOVERY_TIME,
    STANDING_TIME,
    TRIALS,
    ContactMonitor,
    DriveMonitor,
    InputWatchdog,
    Reason,
    ResponseMonitor,
    StopHistory,
    WatchdogParameters,
    WheelMonitor,
)
from t3mpc_ros.geometry.kinematics import advance_pose, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, Pose, State

MS = 1_000_000


def _decide(watchdog, stamp_ms, **changes):
    facts = {'finite': True, 'known': True, 'speed': 1.0, 'error': 0.1} | changes
    return watchdog.decide(stamp_ms * MS, **facts)


class WatchdogMachine(RuleBasedStateMachine):
    """Any sequence of messages: the reason to stop, and each time-out at its very instant.

    A simulation was restarted while the state diverged: the end of the hold was a stamp of the
    old clock, and after a run of ten minutes the robot would have stood still for the next ten.
    """

    def __init__(self):
        super().__init__()
        self.watchdog = InputWatchdog(WatchdogParameters())
        self.last = self.reference = self.held_until = None
        self.now, self.pending, self.enabled, self.restarted = 600_000, False, True, False

    @rule(on=st.sampled_from((True, True, False)))
    def enable(self, on):
        self.watchdog.enabled = self.enabled = on

    @rule()
    def reset(self):
        self.watchdog.reset()
        self.last = self.reference = self.held_until = None
        self.pending = self.restarted = False

    @rule(
        referenced=st.booleans(),
        wait=st.sampled_from((10, 10, 10, 140, 200, 201, 300, 0, -1, -200, -201, -599_000)),
        speed=st.sampled_from((1.0, 1.0, 1.0, 40.0, 40.1)),
        error=st.sampled_from((0.1, 0.1, 0.1, 25.0, 25.1)),
        finite=st.sampled_from((*(True,) * 9, False)),
        known=st.sampled_from((*(True,) * 9, False)),
    )
    def receive_odometry(self, referenced, wait, **facts):
        if referenced:
            self.watchdog.reference_received()
            self.pending = True
        self.receive(self.now + wait, **facts)

    @rule(off=st.sampled_from((-1, 0, 1)), held=st.booleans())
    def receive_odometry_at_an_edge(self, off, held):
        """At the end of a stop with a reference of now, or with the oldest that still counts."""
        self.receive_odometry(
            True, 10, speed=100.0 if held else 1.0, error=0.1, finite=True, known=True
        )
        edge = self.now + (500 if held else 150) + off
        while self.now < edge:
            self.receive_odometry(
                held, min(edge - self.now, 160), speed=1.0, error=0.1, finite=True, known=True
            )

    @rule(
        enabled=st.booleans(),
        finite=st.booleans(),
        reset=st.booleans(),
        wait=st.sampled_from((10, 160)),
    )
    def receive_reference_that_is_not_followed(self, enabled, finite, reset, wait):
        """Before a reset, or with an odometry that stops the robot: it has its age afterwards."""
        facts = {'speed': 1.0, 'error': 0.1, 'known': True}
        self.watchdog.reference_received()
        self.pending = True
        if reset:
            self.reset()
        self.enable(enabled)
        self.receive(self.now + 10, finite=finite, **facts)
        self.enable(True)
        self.receive(self.now + wait, finite=True, **facts)

    def receive(self, now, **facts):
        gap = None if self.last is None else now - self.last
        overtaken = gap is not None and -200 <= gap <= 0
        assert self.watchdog.is_out_of_order(now * MS) == overtaken
        if overtaken:
            return
        elapsed = self.watchdog.elapsed(now * MS)
        assert elapsed == (gap / 1000 if gap is not None and 0 <= gap <= 200 else None)
        if gap is not None and gap < 0:
            self.reference = self.held_until = None
            self.restarted = True
        self.now = self.last = now
        assert _decide(self.watchdog, now, **facts) is self.reason(**facts)

    def reason(self, speed, error, finite, known):
        if self.pending:
            self.reference, self.pending = self.now, False
        if not self.enabled:
            return Reason.DISABLED
        if not finite:
            return Reason.ODOMETRY_BAD
        missing = Reason.ODOMETRY_RESTARTED if self.restarted else Reason.NO_REFERENCE
        if self.reference is None:
            return missing
        if self.now - self.reference > 150:
            return Reason.REFERENCE_STALE
        if not known:
            return missing
        self.restarted = False
        if speed > 40.0 or error > 25.0:
            self.held_until = self.now + 500
        if self.held_until is not None and self.now <= self.held_until:
            return Reason.DIVERGING
        self.held_until = None
        return Reason.TRACKING


@pytest.mark.slow
class TestWatchdog(WatchdogMachine.TestCase):
    settings = settings(STATEFUL, max_examples=60)


def test_the_odometry_timeout_is_measured_with_one_clock():
    watchdog = InputWatchdog(WatchdogParameters(odometry_timeout=0.2))
    assert watchdog.check_silence(None, 0)
    assert not watchdog.check_silence(1000 * MS, 1200 * MS)
    assert watchdog.check_silence(1000 * MS, 1200 * MS + 1)


NEAR = st.sampled_from((0.0, 1.0, 1.5, -3.0, 4.0))


def response_monitor(**changes):
    table, values = split_constants(WatchdogParameters, changes)
    return ResponseMonitor(table(**values), 0.01)


@pytest.mark.parametrize('delay', [0, 12])
def test_a_delayed_and_noisy_robot_is_responsive(delay):
    """A delay of 0.12 s and noise of variance 0.1 are within the window and the bound."""
    generator = np.random.default_rng(delay)
    monitor = response_monitor()
    time = 0.01 * np.arange(1000)
    command = 4.0 * np.sin(np.outer(2.0 * np.pi * time, (0.4, 0.27)))
    for k in range(len(time)):
        monitor.add_command(*command[k])
        measured = command[max(0, k - delay)] + math.sqrt(0.1) * generator.standard_normal(2)
        assert monitor.update(*measured)


def test_a_bound_of_zero_disables_the_check():
    monitor = response_monitor(response_bound=0.0)
    for _ in range(50):
        monitor.add_command(9.0, 9.0)
        assert monitor.update(-9.0, 0.0)


def varying_twist(time):
    return 0.12 + 0.05 * math.sin(0.9 * time), 1.2 * math.sin(0.7 * time)


class StoppingRobot(ServoLoop):
    """A closed loop with a servo robot that can stop responding to commands."""

    def __init__(self, **changes):
        super().__init__(varying_twist, **changes)
        self.reasons = []

    def wanted(self, stamp_ns):
        return np.array(wheels_from_twist(BodyTwist(*varying_twist(stamp_ns / 1e9)), GEOMETRY))

    def run(self, seconds, unresponsive=False):
        """Return the errors of the wheels, shape (n, 2)."""
        self.responsive = not unresponsive
        errors = []
        for _ in range(round(100 * seconds)):
            errors.append(self.speeds - self.wanted(self.now))
            self.reasons.append(self.step().reason)
        return np.array(errors)


def settled(robot):
    return float(np.sqrt(np.mean(robot.run(5.0)[100:] ** 2)))


@pytest.mark.compiled
@pytest.mark.slow
def test_after_5_s_without_response_the_error_is_as_before():
    """Without the response monitor, the adaptation increases the error for 30 s."""
    errors = {}
    for name, changes in (('monitored', {}), ('unmonitored', {'watchdog.response_bound': 0.0})):
        robot = StoppingRobot(**changes)
        robot.run(8.0)
        before = settled(robot)
        robot.run(5.0, unresponsive=True)
        robot.run(1.0)
        errors[name] = settled(robot) / before
        assert (Reason.NOT_FOLLOWING in robot.reasons) == (name == 'monitored')
        assert robot.reasons[-1] is Reason.TRACKING
    assert errors['monitored'] < 1.5
    assert errors['unmonitored'] > 1.3 * errors['monitored']


@pytest.mark.compiled
def test_an_unresponsive_robot_gets_the_reference_as_command():
    robot = StoppingRobot()
    robot.run(5.0)
    robot.run(1.0, unresponsive=True)
    assert robot.controller.status.reason is Reason.NOT_FOLLOWING
    assert Reason.NOT_FOLLOWING.moves  # a restarted board needs commands
    weights = robot.controller.law.get_weights()
    robot.run(0.4, unresponsive=True)
    sent = wheels_from_twist(robot.delayed, GEOMETRY)
    assert sent == pytest.approx(robot.wanted(robot.now - PERIOD), abs=0.05)
    robot.run(20.0, unresponsive=True)
    assert set(robot.reasons[-1500:]) == {Reason.NOT_FOLLOWING, Reason.PAUSED}
    for name, value in robot.controller.law.get_weights().items():
        np.testing.assert_array_equal(value, weights[name])


@pytest.mark.compiled
def test_a_robot_that_follows_again_gets_no_step_of_the_command():
    """The law starts again from the last command, not from a measured speed."""
    robot, sent = StoppingRobot(), []
    robot.run(5.0)
    for unresponsive in (True, False):
        for _ in range(130):
            robot.run(0.01, unresponsive)
            sent.append(wheels_from_twist(robot.delayed, GEOMETRY))
    reasons = robot.reasons[-130:]
    assert reasons[0] is Reason.NOT_FOLLOWING
    assert reasons[-1] is Reason.TRACKING
    limit = robot.controller.parameters.limits.wheel_acceleration
    assert np.abs(np.diff(sent, axis=0)).max() <= limit * 0.01 * (1 + 1e-9)


@pytest.mark.slow
@PROPERTY
@given(
    st.lists(st.tuples(NEAR, NEAR, st.sampled_from((0.0, 1.5, 1.6))), min_size=60, max_size=120)
)
def test_the_decision_is_that_of_the_whole_window(steps):
    """Comparing the last command first only avoids a search; commands near zero count little.

    A distance of just the bound is within it.
    """
    monitor = response_monitor(response_window=0.05, response_timeout=0.03)
    window, evidence, responsive = [], 0, True
    for right, left, away in steps:
        if len(window) == 5:
            lows, highs = map(min, zip(*window, strict=True)), map(max, zip(*window, strict=True))
            ranges = list(zip(lows, highs, strict=True))
            outside = any(not low - 1.5 <= right + away <= high + 1.5 for low, high in ranges[:1])
            outside |= any(not low - 1.5 <= left <= high + 1.5 for low, high in ranges[1:])
            stands = all(low - 1.5 <= 0.0 <= high + 1.5 for low, high in ranges)
            if outside != responsive:
                evidence = 0
            else:
                evidence += 1 if stands and not responsive else EVIDENCE_WEIGHT
            if evidence >= 3 * EVIDENCE_WEIGHT:
                responsive, evidence = not responsive, 0
        assert monitor.update(right + away, left) == responsive
        assert monitor.evidence == evidence
        monitor.add_command(right, left)
        window = [*window, (right, left)][-5:]


@pytest.mark.parametrize('kind', ['curves', 'creeping'])
@pytest.mark.parametrize('seed', range(2))
def test_noise_of_a_pose_is_no_contact(kind, seed):
    """Sums with gaps do not cancel the noise of a pose, which contact was taken from.

    In curves it follows that noise; it creeps as along a path that is planned anew, and stops
    every half a second: it backed off once.
    """
    generator, monitor = np.random.default_rng(seed), ContactMonitor()
    pose, now, lag = Pose(0.0, 0.0, 0.0), STANDSTILL, 0.1 if kind == 'curves' else 0.06
    for k in range(15_000):
        restless = float(generator.normal(0.0, 0.15))
        command = BodyTwist(0.075 * (1.0 - math.cos(0.13 * k)), 0.1)
        if kind == 'curves':
            command = BodyTwist(0.12, 1.2 * (1.0 + 0.3 * math.sin(0.02 * k)) + restless)
        now = BodyTwist(*(n + lag * (c - n) for n, c in zip(now, command, strict=True)))
        pose = advance_pose(pose, now, 0.01)
        x, y, yaw = np.array(pose) + generator.standard_normal(3) * (0.003, 0.003, 0.005)
        odometry = State(k * 10 * MS, Pose(float(x), float(y), float(yaw)), now)
        assert not monitor.is_in_contact(odometry, command, 0.01)


def touches_of(turned, seconds, seed=0):
    """Return when (s) contact is found of a robot that turns as ``turned(time, asked)``, rad/s."""
    generator, monitor, pose = np.random.default_rng(seed), ContactMonitor(), Pose(0.0, 0.0, 0.0)
    now, asked, times = STANDSTILL, [0.0] * 6, []
    for k in range(round(100 * seconds)):
        wanted = 4.0 * (-1.0) ** (k // 150)  # from one curve into the other, at 15 rad/s²
        turn = asked[-1] + min(max(wanted - asked[-1], -0.15), 0.15)
        asked.append(turn)
        # The robot follows after 50 ms, and with a lag of 50 ms.
        now = BodyTwist(0.3, now.angular + (asked[-6] - now.angular) / 6.0)
        driven = BodyTwist(0.3, turned(0.01 * k, now.angular))
        pose = advance_pose(pose, driven, 0.01)
        x, y, yaw = np.array(pose) + generator.standard_normal(3) * (0.003, 0.003, 0.005)
        odometry = State(k * 10 * MS, Pose(float(x), float(y), float(yaw)), driven)
        if monitor.is_in_contact(odometry, BodyTwist(0.3, turn), 0.01):
            times.append(0.01 * k)
    return times


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_a_robot_that_is_thrown_about_has_met_something(sign):
    """It drove on, turned by a radian, and met the same box again at full speed."""
    assert not touches_of(lambda _, asked: asked, 20.0)
    begin = 2.3 if sign > 0.0 else 3.8  # in the middle of a curve to the other side

    def thrown(time, asked):
        return sign * 3.0 if begin < time < begin + 0.4 else asked

    (found, *_) = touches_of(thrown, 5.0)
    assert begin < found < begin + 0.4


# -- pauses of the commands -----------------------------------------------------------------------


class Course:
    """A drive monitor and a robot, of which a test says how it moves under a command."""

    def __init__(self, moves):
        self.monitor, self.moves, self.wanted = DriveMonitor(), moves, BodyTwist(0.2, 0.0)
        self.time = self.silent = 0.0
        self.pose, self.twist = Pose(0.0, 0.0, 0.0), STANDSTILL
        self.log = []

    def run(self, seconds, following=None):
        """Return the reasons of the periods."""
        begin = len(self.log)
        for _ in range(round(seconds * 100)):
            self.time += 0.01
            (x, y, yaw), (linear, angular) = self.pose, self.twist
            yaw += 0.01 * angular
            self.pose = Pose(
                x + 0.01 * linear * math.cos(yaw), y + 0.01 * linear * math.sin(yaw), yaw
            )
            command = self.wanted if self.log and self.log[-1].moves else STANDSTILL
            fits = self.twist == command if following is None else following
            odometry = State(round(self.time * 1e9), self.pose, self.twist)
            self.log.append(self.monitor.decide(odometry, command, 0.01, following=fits))
            command = self.wanted if self.log[-1].moves else STANDSTILL
            self.silent = 0.0 if self.log[-1].moves else self.silent + 0.01
            self.twist = self.moves(self, command)
        return self.log[begin:]

    def changes(self):
        """Return the reasons in turn."""
        return [b for a, b in zip([None, *self.log], self.log, strict=False) if a is not b]


class SlipStop:
    """Moves for ``slips`` s after each pause, then stands until nothing is commanded for 0.5 s."""

    def __init__(self, slips, until=math.inf):
        self.slips, self.until, self.moved = slips, until, 0.0

    def __call__(self, course, command):
        if course.silent >= 0.5:
            self.moved = 0.0
        if course.time < self.until and self.moved >= self.slips:
            return STANDSTILL
        self.moved += 0.01
        return command


def test_a_robot_that_stopped_by_itself_gets_a_pause_and_goes_on():
    """The controller kept on commanding, and the robot stood for ever."""
    course = Course(SlipStop(1.2, until=3.0))
    course.run(20.0)
    assert course.changes() == [Reason.TRACKING, Reason.PAUSED, Reason.TRACKING]
    assert course.log.count(Reason.PAUSED) == pytest.approx(100 * PAUSE, abs=1)
    assert course.monitor.pauses == 0
    assert course.monitor.problem() == ''


def test_a_robot_that_stops_again_after_each_pause_is_left_alone():
    course = Course(SlipStop(1.2))
    course.run(60.0)
    attempts = TRIALS * [Reason.TRACKING, Reason.PAUSED]
    assert course.changes() == [*attempts, Reason.TRACKING, Reason.STOPPED_AGAIN]
    assert '~/enable' in course.monitor.problem()
    assert course.log.index(Reason.STOPPED_AGAIN) * 0.01 == pytest.approx(
        (TRIALS + 1) * (1.2 + STANDING_TIME) + TRIALS * PAUSE, abs=0.6
    )
    course.monitor.begin()  # a gap in the odometry, or a reference that was stale
    assert set(course.run(5.0)) == {Reason.STOPPED_AGAIN}
    course.monitor.reset()
    assert course.run(0.5)[0] is Reason.TRACKING


def test_stops_far_apart_are_not_counted_together():
    course = Course(SlipStop(STANDING_TIME + RECOVERY_TIME))
    course.run(60.0)
    assert Reason.STOPPED_AGAIN not in course.log
    assert course.log.count(Reason.PAUSED) > (TRIALS + 2) * 100 * PAUSE


def test_a_robot_that_never_moves_gets_commands_for_ever():
    """Its emergency stop is released, or its board starts, after any time."""
    course = Course(lambda course, command: command if course.time > 60.0 else STANDSTILL)
    course.run(60.0)
    assert set(course.log) == {Reason.TRACKING, Reason.PAUSED}
    assert course.monitor.pauses > 20
    assert 'emergency stop' in course.monitor.problem()
    reasons = course.run(STANDING_TIME + PAUSE + RECOVERY_TIME)
    assert reasons[-1] is Reason.TRACKING
    assert course.run(1.0)[-1] is Reason.TRACKING
    assert course.monitor.problem() == ''


def test_a_robot_that_moves_otherwise_is_stopped():
    """Swapped wheels, stamps that are a second late, or another publisher of commands."""
    course = Course(lambda course, command: BodyTwist(0.0, 0.5))
    course.run(60.0, following=False)
    assert course.changes()[-1] is Reason.STOPPED_AGAIN
    assert course.log.index(Reason.PAUSED) * 0.01 == pytest.approx(ASTRAY_TIME, abs=0.5)


def test_a_response_disturbed_for_a_short_time_costs_no_pause():
    course = Course(lambda course, command: command)
    for _ in range(6):
        course.run(0.9 * ASTRAY_TIME, following=False)
        course.run(ASTRAY_TIME, following=True)
    assert set(course.log) == {Reason.TRACKING}


@pytest.mark.parametrize(
    'wanted',
    [
        lambda t: BodyTwist(0.1 * math.sin(8.0 * t), 0.0),  # to and fro within 2.5 cm
        lambda t: BodyTwist(0.0, 0.5 * math.sin(8.0 * t)),
        lambda t: BodyTwist(0.02, 0.0),
        lambda t: BodyTwist(0.0, 0.05),
        lambda t: BodyTwist(0.005, 3.0),
        lambda t: STANDSTILL,
    ],
)
def test_a_robot_that_follows_gets_no_pause(wanted):
    course = Course(lambda course, command: command)
    for k in range(1000):
        course.wanted = wanted(0.01 * k)
        course.run(0.01)
    assert set(course.log) == {Reason.TRACKING}


def test_an_odometry_that_is_late_is_no_robot_that_stands():
    course = Course(lambda course, command: command if course.time > 0.6 else STANDSTILL)
    assert set(course.run(5.0, following=True)) == {Reason.TRACKING}


@pytest.mark.parametrize('part', ['pose', 'twist'])
def test_pose_or_twist_alone_show_that_a_robot_moves(part):
    monitor = DriveMonitor()
    for k in range(400):
        moving = BodyTwist(0.2, 0.0) if part == 'twist' else STANDSTILL
        pose = Pose(0.002 * k, 0.0, 0.0) if part == 'pose' else Pose(0.0, 0.0, 0.0)
        state = State(k * 10_000_000, pose, moving)
        reason = monitor.decide(state, BodyTwist(0.2, 0.0), 0.01, following=True)
        assert reason is Reason.TRACKING


def contacts_of(wheels_turn, comes_free):
    """Return whether each pause is for a contact of a robot that stops after a second."""
    monitor, x, found, released = DriveMonitor(feels=True), 0.0, [], False
    for k in range(800):
        paused = bool(found) and monitor.pauses == len(found) and monitor._pause > 0.0
        released |= paused and comes_free
        moves = k < 100 or released
        command = STANDSTILL if paused else BodyTwist(0.2, 0.0)
        x += 0.01 * command.linear * moves
        turning = moves or wheels_turn
        twist = BodyTwist(command.linear * turning, 0.0)
        state = State(k * 10 * MS, Pose(x, 0.0, 0.0), twist)
        before = monitor.pauses
        monitor.decide(state, command, 0.01, following=turning)
        if monitor.pauses > before:
            found.append(monitor.contact)
    return found


def test_a_robot_that_stopped_by_itself_is_not_held():
    """After a slip on oil it stopped its wheels; the floor there was marked for good.

    What does not move after the pause either is held, whether its wheels turn or not.
    """
    assert contacts_of(wheels_turn=False, comes_free=True) == [False]
    assert contacts_of(wheels_turn=True, comes_free=True) == [True]
    assert contacts_of(wheels_turn=False, comes_free=False)[:2] == [False, True]


def test_noise_of_a_standing_robot_is_no_motion():
    generator = np.random.default_rng(5)
    monitor, reasons = DriveMonitor(), []
    for k in range(500):
        twist = BodyTwist(*(generator.normal(size=2) * (0.005, 0.07)).tolist())
        state = State(k * 10_000_000, Pose(0.0, 0.0, 0.0), twist)
        reasons.append(monitor.decide(state, BodyTwist(0.2, 0.0), 0.01, following=False))
    assert Reason.PAUSED in reasons[: round(100 * STANDING_TIME) + 20]


@pytest.mark.parametrize(('axis', 'late'), [(0, 0.2), (1, 0.0)])
def test_a_velocity_of_the_opposite_sign_is_stopped_within_3_s(axis, late):
    """Swapped sides of motors or encoders: errors were fifty times those without feedback."""
    for sign in (-1.0, 1.0):
        monitor, reasons = DriveMonitor(), []
        commands = [
            BodyTwist(0.15 * math.sin(2.0 * t), 1.0 * math.cos(3.0 * t))
            for t in np.arange(0.0, 20.0, 0.01)
        ]
        for k, command in enumerate(commands):
            found = list(commands[max(k - round(100 * late), 0)])
            found[axis] *= sign
            state = State(k * 10_000_000, Pose(0.0, 0.0, 0.0), BodyTwist(*found))
            reasons.append(monitor.decide(state, command, 0.01, following=True))
        if sign > 0.0:
            assert set(reasons) == {Reason.TRACKING}
        else:
            assert 0.01 * reasons.index(Reason.PAUSED) < 3.0
            assert reasons[-1] is Reason.STOPPED_AGAIN


def _feel(drive, seconds, feels=True, noise=0.003):
    """Return a monitor and its reasons; ``drive``: pose at a time (s), command, measured twist."""
    monitor, reasons = DriveMonitor(feels=feels), []
    generator = np.random.default_rng(5)
    for k in range(round(100 * seconds)):
        (x, y, yaw), command, measured = drive(0.01 * k)
        x, y = (np.array([x, y]) + noise * generator.standard_normal(2)).tolist()
        state = State(k * PERIOD, Pose(x, y, yaw), measured)
        reasons.append(monitor.decide(state, command, 0.01, following=True))
    return monitor, reasons


@pytest.mark.parametrize('speed', [0.02, 0.35, -0.08])
def test_wheels_that_turn_under_a_pose_that_stands_are_a_contact(speed):
    """A robot pushed a box that it does not see for five minutes: its wheels turned."""
    command = BodyTwist(speed, 0.0)
    monitor, reasons = _feel(lambda t: ((0.0, 0.0, 0.3), command, command), 30.0)
    assert 0.01 * reasons.index(Reason.PAUSED) < 4.2
    assert monitor.contact
    assert reasons[-1] is Reason.STOPPED_AGAIN
    assert 'call ~/enable' in monitor.problem()
    begins = [k for k in range(1, len(reasons)) if reasons[k - 1] is not reasons[k]]
    assert len(begins) == 2 * TRIALS + 1  # three pauses, then the end
    assert _feel(lambda t: ((0.0, 0.0, 0.3), command, command), 30.0, feels=False)[1] == (
        3000 * [Reason.TRACKING]
    )


@pytest.mark.parametrize(
    ('twist', 'feels'), [((0.25, 0.0), True), ((0.0, 3.0), False), ((-0.1, 0.5), True)]
)
def test_a_frozen_pose_pauses_and_ends(twist, feels):
    """Towards a pose that stayed where it was the robot turned on the spot, without end."""
    monitor, reasons = DriveMonitor(feels=feels, follows_pose=True), []
    command, moved = BodyTwist(*twist), [0.0, 0.0]
    for k in range(1000):
        measured = command if not reasons or reasons[-1].moves else STANDSTILL
        moved = [sum_ + 0.01 * abs(each) for sum_, each in zip(moved, measured, strict=True)]
        state = State(k * PERIOD, Pose(1.0, 0.0, 0.3), measured)
        reasons.append(monitor.decide(state, measured, 0.01, following=True))
        if not reasons[-1].moves:
            assert 'the pose in odom stays the same' in monitor.problem()
    assert reasons[-1] is Reason.STOPPED_AGAIN
    assert 'call ~/enable' in monitor.problem()
    assert monitor.contact is False
    again = TRIALS + 1.2
    assert moved[0] < again * FROZEN_MOTION[0] or moved[1] < again * FROZEN_MOTION[1]


@pytest.mark.parametrize('rate', [5.0, 30.0])
def test_a_pose_of_a_slow_camera_is_not_frozen(rate):
    monitor, command = DriveMonitor(follows_pose=True), BodyTwist(0.35, 0.0)
    for k in range(1000):
        x = 0.35 * math.floor(0.01 * k * rate) / rate
        state = State(k * PERIOD, Pose(x, 0.0, 0.0), command)
        assert monitor.decide(state, command, 0.01, following=True) is Reason.TRACKING


def test_a_robot_turned_or_pushed_aside_touches_something():
    command = BodyTwist(0.2, 0.0)

    def turned(t):
        return (0.2 * t, 0.0, 0.9 * t), command, command

    assert Reason.PAUSED in _feel(turned, 1.0, noise=0.0)[1]
    assert Reason.PAUSED not in _feel(turned, 0.45)[1]  # a place from elsewhere: a tyre slips
    slides = _feel(lambda t: ((0.12 * t, 0.12 * t, 0.0), command, command), 2.0)[1]
    assert Reason.PAUSED in slides


@pytest.mark.parametrize(('turn', 'late'), [(0.0, 0.1), (1.0, 0.0), (4.0, 0.1)])
def test_free_motion_is_no_contact(turn, late):
    """With noise of 3 mm, late poses, stops, turns on the spot and backing off."""
    pose, now, poses, twists = Pose(0.0, 0.0, 0.0), STANDSTILL, [], []
    for k in range(2000):
        phase = (k // 200) % 4
        wanted = BodyTwist((0.35, 0.0, 0.02, -0.1)[phase], turn if phase % 2 else 0.3 * turn)
        step = [min(max(w - n, -a), a) for w, n, a in zip(wanted, now, (0.01, 0.14), strict=True)]
        now = BodyTwist(now.linear + step[0], now.angular + step[1])
        pose = advance_pose(pose, now, 0.01)
        poses.append(pose)
        twists.append(now)

    def drive(t):
        k = round(100 * t)
        return poses[max(k - round(100 * late), 0)], twists[k], twists[k]

    assert set(_feel(drive, 20.0)[1]) == {Reason.TRACKING}


def test_a_stop_between_two_reports_is_in_the_next_one():
    """A stop of 0.1 s fell between two reports of 1 Hz, which said that all was well."""
    second, stops = NANOSECONDS, StopHistory()
    stops.update(Reason.NO_ODOMETRY, 0)
    stops.update(Reason.TRACKING, second)
    assert (stops.number, stops.unreported(second)) == (0, '')
    stops.update(Reason.NO_ODOMETRY, 2 * second)
    stops.update(Reason.ODOMETRY_RESTARTED, 2 * second + second // 20)
    stops.update(Reason.TRACKING, 2 * second + second // 10)
    text = stops.unreported(2 * second + second // 2)
    assert text == 'stopped for 0.1 s, 0.4 s ago: odometry has restarted'
    assert stops.unreported(4 * second) == ''
    stops.update(Reason.NO_ODOMETRY, 5 * second)
    assert (stops.number, stops.age(6 * second), stops.duration(6 * second)) == (2, 0.0, 1.0)
    assert stops.unreported(6 * second) == ''  # the report says so itself
    stops.update(Reason.TRACKING, 7 * second)
    assert stops.unreported(8 * second) == ''


def _problems(of_right, *, seconds=12.0, delay=3):
    """Return what is said of a robot whose right wheel does ``of_right`` of time and command."""
    monitor, random, sent = WheelMonitor(WatchdogParameters(), 0.01), np.random.default_rng(1), []
    found = set()
    for k in range(round(100 * seconds)):
        given = sent[max(k - 1 - delay, 0)] if sent else (0.0, 0.0)
        speeds = of_right(0.01 * k, given[0]), given[1]
        if sent:
            monitor.update(k * 10 * MS, (speeds + random.normal(0.0, 0.2, 2)).tolist(), sent[-1])
        sent.append((5.0 * math.sin(0.02 * k), 4.0 * math.cos(0.013 * k)))
        if k % 100 == 0:
            found.add(monitor.problem())
    return found - {''}


@pytest.mark.parametrize('delay', [0, 3, 14])
def test_nothing_is_said_of_wheels_that_follow_their_commands(delay):
    assert _problems(lambda time, given: given, seconds=120.0, delay=delay) == set()


@pytest.mark.parametrize(
    ('of_right', 'why'),
    [
        (lambda time, given: 0.0 if 4.0 <= time < 4.3 else given, 'commands of it are lost'),
        (lambda time, given: min(max(given, -4.0), 4.0), 'it gets no faster'),
    ],
)
def test_a_wheel_that_is_dead_or_at_a_limit_is_named(of_right, why):
    """Nothing was said of ten times the error, or a wrong radius, or another dead time."""
    found = _problems(of_right)
    assert found
    for text in found:
        assert text.startswith('the right wheel had ')
        assert why in text


def test_a_factor_of_the_measured_speeds_is_no_dead_wheel():
    assert _problems(lambda time, given: 1.04 * given, seconds=30.0) == set()


def test_no_wheel_is_outside_after_a_clock_was_set_back():
    """For an hour after a leap of an hour, no gain of the wheels was found."""
    monitor, hour = WheelMonitor(WatchdogParameters(), 0.01), 3600 * NANOSECONDS
    for k in range(400):
        right = 0.0 if 300 <= k < 330 else 5.0
        monitor.update(hour + k * 10 * MS, [right, 4.0], [5.0, 4.0])
        if k == 330:
            assert monitor.outside
    for k in range(100):
        monitor.update(k * 10 * MS, [5.0, 4.0], [5.0, 4.0])
        assert not monitor.outside
    assert monitor.problem() == ''
