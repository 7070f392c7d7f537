# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Input watchdog and response monitor; the controller with an unresponsive robot."""

import math

import numpy as np
import pytest
from support.control_loops import GEOMETRY, PERIOD, ServoLoop

from t3mpc_ros.control.watchdog import (
    EVIDENCE_WEIGHT,
    InputWatchdog,
    Reason,
    ResponseMonitor,
    WatchdogParameters,
)
from t3mpc_ros.geometry.kinematics import wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist

MS = 1_000_000


def _decide(watchdog, stamp_ms, **changes):
    facts = {'finite': True, 'known': True, 'speed': 1.0, 'error': 0.1} | changes
    return watchdog.decide(stamp_ms * MS, **facts)


def test_every_reason_to_stop_is_detected():
    watchdog = InputWatchdog(WatchdogParameters())
    assert _decide(watchdog, 0) is Reason.NO_REFERENCE
    watchdog.reference_received()
    assert _decide(watchdog, 10) is Reason.TRACKING
    assert _decide(watchdog, 20, finite=False) is Reason.ODOMETRY_BAD
    assert _decide(watchdog, 30, known=False) is Reason.NO_REFERENCE
    assert _decide(watchdog, 150) is Reason.TRACKING
    assert _decide(watchdog, 170) is Reason.REFERENCE_STALE
    watchdog.reference_received()
    assert _decide(watchdog, 180) is Reason.TRACKING
    watchdog.enabled = False
    watchdog.reference_received()
    assert _decide(watchdog, 190) is Reason.DISABLED
    watchdog.enabled = True
    assert _decide(watchdog, 200) is Reason.TRACKING


@pytest.mark.parametrize('fault', [{'speed': 41.0}, {'error': 26.0}])
def test_a_diverging_state_stops_the_robot_for_the_hold_time(fault):
    watchdog = InputWatchdog(WatchdogParameters())
    reasons = []
    for k in range(100):
        watchdog.reference_received()
        reasons.append(_decide(watchdog, 10 * k, **(fault if k == 10 else {})))
    assert reasons[9] is Reason.TRACKING
    assert all(reason is Reason.DIVERGING for reason in reasons[10:61])
    assert all(reason is Reason.TRACKING for reason in reasons[61:])


def test_elapsed_is_none_for_first_messages_gaps_and_restarts():
    watchdog = InputWatchdog(WatchdogParameters())
    assert watchdog.elapsed(1000 * MS) is None
    assert watchdog.elapsed(1010 * MS) == pytest.approx(0.01)
    assert watchdog.elapsed(1300 * MS) is None
    assert watchdog.elapsed(1310 * MS) == pytest.approx(0.01)
    assert watchdog.elapsed(500 * MS) is None


def test_a_clock_that_starts_again_ends_the_hold():
    """A simulation was restarted while the state diverged.

    The end of the hold was a stamp of the old clock: after a run of ten minutes the robot would
    have stood still for the next ten.
    """
    watchdog = InputWatchdog(WatchdogParameters())
    for stamp_ms in (600_000, 600_010):
        watchdog.elapsed(stamp_ms * MS)
    watchdog.reference_received()
    assert _decide(watchdog, 600_010, speed=41.0) is Reason.DIVERGING
    assert watchdog.elapsed(0) is None
    assert _decide(watchdog, 0) is Reason.NO_REFERENCE
    watchdog.reference_received()
    assert _decide(watchdog, 10) is Reason.TRACKING


def test_the_odometry_timeout_is_measured_with_one_clock():
    watchdog = InputWatchdog(WatchdogParameters(odometry_timeout=0.2))
    assert watchdog.odometry_timed_out(None, 0)
    assert not watchdog.odometry_timed_out(1000 * MS, 1199 * MS)
    assert watchdog.odometry_timed_out(1000 * MS, 1201 * MS)


def response_monitor(**changes):
    return ResponseMonitor(WatchdogParameters(**changes), 0.01)


@pytest.mark.parametrize('delay', [0, 1, 5, 12])
def test_a_delayed_and_noisy_robot_is_responsive(delay):
    """A delay of 0.12 s and noise of variance 0.1 are within the window and the bound."""
    generator = np.random.default_rng(delay)
    monitor = response_monitor()
    time = 0.01 * np.arange(4000)
    command = 4.0 * np.sin(np.outer(2.0 * np.pi * time, (0.4, 0.27)))
    for k in range(len(time)):
        monitor.add_command(*command[k])
        measured = command[max(0, k - delay)] + math.sqrt(0.1) * generator.standard_normal(2)
        assert monitor.update(*measured)


def test_a_standing_robot_is_unresponsive_after_the_timeout():
    monitor = response_monitor()
    steps = 0
    while monitor.responsive:
        monitor.add_command(3.0, -3.0)
        monitor.update(0.0, 0.0)
        steps += 1
    assert steps * 0.01 == pytest.approx(0.15 + 0.1, abs=0.03)


def test_one_unresponsive_wheel_is_enough():
    monitor = response_monitor()
    for _ in range(60):
        monitor.add_command(3.0, 3.0)
        monitor.update(3.0, 0.0)
    assert not monitor.responsive


def test_standing_at_a_zero_command_is_weak_evidence():
    """Zero crossings of the reference must not end the pause of the adaptation."""
    monitor = response_monitor()
    for _ in range(60):
        monitor.add_command(3.0, 3.0)
        monitor.update(0.0, 0.0)
    assert not monitor.responsive
    steps = 0
    while not monitor.responsive:
        monitor.add_command(0.2, 0.1)
        monitor.update(0.0, 0.0)
        steps += 1
    assert steps >= EVIDENCE_WEIGHT * 10  # 2 s; other samples need 0.1 s
    again = response_monitor()
    for _ in range(60):
        again.add_command(3.0, 3.0)
        again.update(0.0, 0.0)
    for _ in range(11):
        again.add_command(3.0, 3.0)
        again.update(2.9, 3.1)
    assert again.responsive


def test_a_bound_of_zero_disables_the_check():
    monitor = response_monitor(response_bound=0.0)
    for _ in range(500):
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


def test_an_unresponsive_robot_gets_the_reference_as_command():
    robot = StoppingRobot()
    robot.run(5.0)
    robot.run(1.0, unresponsive=True)
    assert robot.controller.status.reason is Reason.NOT_FOLLOWING
    assert Reason.NOT_FOLLOWING.moves  # a restarted board needs commands
    weights = robot.controller.law.get_weights()
    robot.run(2.0, unresponsive=True)
    for name, value in robot.controller.law.get_weights().items():
        np.testing.assert_array_equal(value, weights[name])
    sent = wheels_from_twist(robot.delayed, GEOMETRY)
    assert sent == pytest.approx(robot.wanted(robot.now - PERIOD), abs=0.05)


def test_a_robot_that_follows_again_gets_no_step_of_the_command():
    """The law starts again from the last command, not from a measured speed."""
    robot, sent = StoppingRobot(), []
    robot.run(5.0)
    for unresponsive in (True, False):
        for _ in range(200):
            robot.run(0.01, unresponsive)
            sent.append(wheels_from_twist(robot.delayed, GEOMETRY))
    reasons = robot.reasons[-200:]
    assert reasons[0] is Reason.NOT_FOLLOWING
    assert reasons[-1] is Reason.TRACKING
    limit = robot.controller.parameters.limits.wheel_acceleration
    assert np.abs(np.diff(sent, axis=0)).max() <= limit * 0.01 * (1 + 1e-9)


def test_the_shortcut_for_the_last_command_keeps_the_decision():
    """Comparing the last command first avoids a search and gives the same decision."""
    generator = np.random.default_rng(4)
    monitor, whole = response_monitor(), response_monitor()
    decisions = []
    for k in range(3000):
        command = 3.0 * np.sin(0.02 * k) + generator.normal(size=2)
        off = 5.0 if k % 700 > 600 else 0.0
        measured = command + off + generator.normal(scale=0.8, size=2)
        decisions.append(monitor.update(*measured))
        # Reorder the window to disable the shortcut: the most distant command is the last.
        if len(whole._commands) == whole._commands.maxlen:
            far = max(whole._commands, key=lambda one: abs(one[0] - measured[0]))
            kept = list(whole._commands)
            whole._commands.remove(far)
            whole._commands.append(far)
            assert whole.update(*measured) == decisions[-1]
            whole._commands.clear()
            whole._commands.extend(kept)
        else:
            assert whole.update(*measured) == decisions[-1]
        monitor.add_command(*command)
        whole.add_command(*command)
    assert True in decisions
    assert False in decisions
