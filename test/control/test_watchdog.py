# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A robot that does not do what it is told is no plant to learn from."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.watchdog import EVIDENCE_WEIGHT, Reason, ResponseMonitor, WatchdogParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, State, WheelSpeeds

PERIOD = 0.01
STEP = 10_000_000
GEOMETRY = WheelGeometry()


def following(**changes):
    return ResponseMonitor(WatchdogParameters(**changes), PERIOD)


@pytest.mark.parametrize('late', [0, 1, 5, 12])
def test_a_delayed_and_noisy_robot_is_responsive(late):
    """0.12 s late, noise of variance 0.1: all within the window and the bound."""
    generator = np.random.default_rng(late)
    watch = following()
    time = PERIOD * np.arange(4000)
    told = 4.0 * np.sin(np.outer(2.0 * np.pi * time, (0.4, 0.27)))
    for k in range(len(time)):
        watch.add_command(*told[k])
        seen = told[max(0, k - late)] + math.sqrt(0.1) * generator.standard_normal(2)
        assert watch.update(*seen)


def test_a_standing_robot_is_unresponsive_after_the_timeout():
    watch = following()
    steps = 0
    while watch.responsive:
        watch.add_command(3.0, -3.0)
        watch.update(0.0, 0.0)
        steps += 1
    assert steps * PERIOD == pytest.approx(0.15 + 0.1, abs=0.03)


def test_one_unresponsive_wheel_is_enough():
    watch = following()
    for _ in range(60):
        watch.add_command(3.0, 3.0)
        watch.update(3.0, 0.0)
    assert not watch.responsive


def test_standing_at_a_zero_command_is_weak_evidence():
    """A reference that crosses zero made a deaf robot seem to obey, and the law learn from it."""
    watch = following()
    for _ in range(60):
        watch.add_command(3.0, 3.0)
        watch.update(0.0, 0.0)
    assert not watch.responsive
    steps = 0
    while not watch.responsive:
        watch.add_command(0.2, 0.1)
        watch.update(0.0, 0.0)
        steps += 1
    assert steps >= EVIDENCE_WEIGHT * 10  # 2 s; with a proof it takes 0.1 s
    again = following()
    for _ in range(60):
        again.add_command(3.0, 3.0)
        again.update(0.0, 0.0)
    for _ in range(11):
        again.add_command(3.0, 3.0)
        again.update(2.9, 3.1)
    assert again.responsive


def test_a_bound_of_zero_disables_the_check():
    watch = following(response_bound=0.0)
    for _ in range(500):
        watch.add_command(9.0, 9.0)
        assert watch.update(-9.0, 0.0)


class Deaf:
    """A servo robot that hears nothing for a while, and the controller that drives it."""

    def __init__(self, **changes):
        self.controller = Controller(
            ControllerParameters.from_dict({'speed_filter.noise_variance': 0.0} | changes)
        )
        self.speeds = np.zeros(2)
        self.late = BodyTwist(0.0, 0.0)
        self.now = 0
        self.reasons = []

    def wanted(self, stamp_ns):
        time = stamp_ns / 1e9
        return BodyTwist(0.12 + 0.05 * math.sin(0.9 * time), 1.2 * math.sin(0.7 * time))

    def run(self, seconds, deaf=False):
        """Return the errors of the wheels, shape (n, 2)."""
        errors = []
        for _ in range(round(seconds / PERIOD)):
            stamp = self.now + 40 * STEP
            self.controller.add_reference(State(stamp, ORIGIN, self.wanted(stamp)))
            twist = twist_from_wheels(WheelSpeeds(*self.speeds.tolist()), GEOMETRY)
            errors.append(self.speeds - wheels_from_twist(self.wanted(self.now), GEOMETRY))
            sent, status = self.controller.step(State(self.now, ORIGIN, twist))
            self.reasons.append(status.reason)
            told = np.zeros(2) if deaf else np.array(wheels_from_twist(self.late, GEOMETRY))
            self.speeds = told + math.exp(-0.5) * (self.speeds - told)
            self.late = sent
            self.now += STEP
        return np.array(errors)


def settled(robot):
    return float(np.sqrt(np.mean(robot.run(5.0)[100:] ** 2)))


def test_after_5_s_without_response_the_error_is_as_before():
    """The law had learnt that commands do nothing: the error was five times as large for 30 s."""
    errors = {}
    for name, changes in (('watched', {}), ('not', {'watchdog.response_bound': 0.0})):
        robot = Deaf(**changes)
        robot.run(8.0)
        before = settled(robot)
        robot.run(5.0, deaf=True)
        robot.run(1.0)
        errors[name] = settled(robot) / before
        assert (Reason.NOT_FOLLOWING in robot.reasons) == (name == 'watched')
        assert robot.reasons[-1] is Reason.TRACKING
    assert errors['watched'] < 1.5
    assert errors['not'] > 1.3 * errors['watched']


def test_an_unresponsive_robot_gets_the_reference_as_command():
    robot = Deaf()
    robot.run(5.0)
    robot.run(1.0, deaf=True)
    assert robot.controller.status.reason is Reason.NOT_FOLLOWING
    assert Reason.NOT_FOLLOWING.moves  # a board that restarts waits for commands
    learnt = robot.controller.law.get_weights()
    robot.run(2.0, deaf=True)
    for name, value in robot.controller.law.get_weights().items():
        np.testing.assert_array_equal(value, learnt[name])
    sent = wheels_from_twist(robot.late, GEOMETRY)
    wanted = wheels_from_twist(robot.wanted(robot.now - STEP), GEOMETRY)
    assert sent == pytest.approx(wanted, abs=0.05)


def test_the_shortcut_for_the_last_command_keeps_the_decision():
    """The newest command is looked at first, to save the search: the verdict is the same."""
    generator = np.random.default_rng(4)
    watch, whole = following(), following()
    verdicts = []
    for k in range(3000):
        told = 3.0 * np.sin(0.02 * k) + generator.normal(size=2)
        off = 5.0 if k % 700 > 600 else 0.0
        seen = told + off + generator.normal(scale=0.8, size=2)
        verdicts.append(watch.update(*seen))
        # The same commands in another order are the same window: the nearest comes first.
        if len(whole._commands) == whole._commands.maxlen:
            far = max(whole._commands, key=lambda one: abs(one[0] - seen[0]))
            kept = list(whole._commands)
            whole._commands.remove(far)
            whole._commands.append(far)
            assert whole.update(*seen) == verdicts[-1]
            whole._commands.clear()
            whole._commands.extend(kept)
        else:
            assert whole.update(*seen) == verdicts[-1]
        watch.add_command(*told)
        whole.add_command(*told)
    assert True in verdicts
    assert False in verdicts
