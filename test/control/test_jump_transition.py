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
"""Transition across a jump: reachable, optimal, and withdrawn with the jump."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.controller import ControllerParameters, SwitchingTracker
from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters, MotorLimit

T = 0.01
NS = 10_000_000
A = 28.0


def _transition(jump, slopes=(0.0, 0.0), *, lag=0.0, known=100, at=100, steps=250):
    """Return r, rbar and commands for a jump at step ``at``, announced at step ``known``."""
    transition = JumpTransition(JumpTransitionParameters(acceleration=A), lag, T)
    before, after = slopes
    k = np.arange(steps + 1)
    r = np.where(k < at, before * T * (k - at), after * T * (k - at) + jump)
    r = np.stack([r, -r], axis=1)
    servo_step = 1.0 - math.exp(-T / lag) if lag else 1.0
    reachable, commands = np.zeros((steps, 2)), np.zeros((steps, 2))
    for n in range(steps):
        if n == known:
            transition.announce(at * NS, np.array([jump, -jump]), np.array([after, -after]))
        transition.step(n * NS, r[n], r[n + 1])
        reachable[n] = r[n] + transition.plan.offset
        reachable_next = r[n + 1] + transition.plan.offset_next
        commands[n] = reachable[n] + (reachable_next - reachable[n]) / servo_step
    assert transition.count == 0
    return r[:-1], reachable, commands


@pytest.mark.parametrize('jump', [0.5, 10.0])
@pytest.mark.parametrize('known', [40, 100])
def test_the_reachable_reference_respects_the_acceleration(jump, known):
    _, reachable, _ = _transition(jump, known=known)
    assert np.max(np.abs(np.diff(reachable, axis=0))) <= A * T * (1 + 1e-9)


@pytest.mark.parametrize('slopes', [(0.0, 0.0), (10.0, -8.0)])
def test_no_reachable_path_has_a_smaller_squared_error(slopes):
    """Compare with a quadratic program over all speeds that change by at most a T per step."""
    from scipy.optimize import lsq_linear

    jump, at, steps = 4.0, 40, 90
    r, reachable, _ = _transition(jump, slopes, known=0, at=at, steps=steps)
    sums = np.tril(np.ones((steps, steps)))
    # The start of the program is free, as that of the transition: its first step may jump to r.
    first = r[0, 0]
    best = lsq_linear(sums[:, 1:], r[:, 0] - first, bounds=(-A * T, A * T), tol=1e-12)
    least = np.sum((sums[:, 1:] @ best.x + first - r[:, 0]) ** 2)
    ours = np.sum((reachable - r)[:, 0] ** 2)
    assert least <= ours * (1.0 + 1e-6)
    assert ours <= 1.04 * least


@pytest.mark.parametrize('jump', [(30.0, 30.0), (12.0, -12.0), (-6.0, 21.0)])
@pytest.mark.slow
def test_a_torque_drive_crosses_with_the_torque_of_its_motors(jump):
    """A fixed 200 rad/s² was 1.2 times the torque for a turn, 0.5 of it for a push."""
    from scipy.optimize import lsq_linear

    inertia, torque = np.array([[0.0017, -0.00075], [-0.00075, 0.0017]]), 0.4
    limit = MotorLimit(inertia, torque)
    transition = JumpTransition(JumpTransitionParameters(acceleration=1.0), 0.0, T, limit)
    at, steps = 30, 60
    r = np.where(np.arange(steps + 1)[:, None] < at, 0.0, np.array(jump))
    transition.announce(at * NS, np.array(jump), np.zeros(2))
    reachable = np.empty((steps, 2))
    for n in range(steps):
        transition.step(n * NS, r[n], r[n + 1])
        reachable[n] = transition.reachable
    assert transition.count == 0
    needed = np.abs(np.diff(reachable, axis=0) / T @ inertia)
    assert needed.max() <= 1.01 * torque
    assert needed.max() >= 0.95 * torque
    # The best that any torques within the limit can do, by a bounded least-squares program.
    sums = np.kron(np.tril(np.ones((steps, steps)), -1) * T, np.linalg.inv(inertia))
    best = lsq_linear(sums, r[:-1].ravel(), bounds=(-torque, torque), tol=1e-12)
    least, ours = 2.0 * best.cost, np.sum((reachable - r[:-1]) ** 2)
    assert least <= ours * (1.0 + 1e-6)
    # Exactly the best for a push or a turn; unequal jumps leave torque of one motor unused.
    assert ours <= (1.0 + 1e-9 if abs(jump[0]) == abs(jump[1]) else 1.5) * least


def test_with_servo_lag_the_command_respects_the_acceleration():
    """A ramp of chi itself would need command steps of lag * a at both ends."""
    r, reachable, commands = _transition(6.0, lag=0.02, known=30)
    assert np.max(np.abs(np.diff(commands, axis=0))) <= A * T * (1 + 1e-9)
    energy = T * np.sum((reachable - r)[:, 0] ** 2)
    assert energy == pytest.approx(6.0**3 / (12.0 * A), rel=0.05)


@pytest.mark.compiled
@pytest.mark.parametrize('interval', [0.62, 0.9, 1.3, 2.4])
@pytest.mark.parametrize('lag', [0.003, 0.02])
def test_a_ramp_is_the_same_whatever_the_interval(interval, lag):
    """Steps of 0.62 of a period went on by a whole one: the ramp was 1.6 times too steep."""

    def reachable(interval):
        parameters = ControllerParameters.from_dict(
            {'speed_filter.lag': lag, 'jump_transition.acceleration': A, 'law.gain': 0.0}
        )
        tracker = SwitchingTracker(parameters.resolved(), 'velocity')
        tracker.transition.announce(100 * NS, np.array([6.0, -3.0]), np.zeros(2))
        times = np.arange(0.0, 200.0, interval)
        found = []
        for time in times:
            r = [np.array([6.0, -3.0]) if at >= 100.0 else np.zeros(2) for at in (time, time + 1)]
            found.append(tracker.plan(round(time * NS), *r, interval * T)[0].copy())
        assert tracker.transition.count == 0
        return times, np.array(found)

    times, regular = reachable(1.0)
    others, found = reachable(interval)
    for i in range(2):
        expected = np.interp(others, times, regular[:, i])
        np.testing.assert_allclose(found[:, i], expected, atol=0.55 * A * T)
        assert np.sqrt(np.mean((found[:, i] - expected) ** 2)) < 0.08 * A * T


def test_two_transitions_may_overlap():
    transition = JumpTransition(JumpTransitionParameters(acceleration=A), 0.02, T)
    k = np.arange(201)
    r = np.where(k < 100, 0.0, np.where(k < 105, 4.0, -2.0))
    r = np.stack([r, r], axis=1)
    transition.announce(100 * NS, np.full(2, 4.0), np.zeros(2))
    transition.announce(105 * NS, np.full(2, -6.0), np.zeros(2))
    reachable = []
    for n in range(200):
        transition.step(n * NS, r[n], r[n + 1])
        reachable.append(r[n] + transition.plan.offset)
    assert np.max(np.abs(np.diff(reachable, axis=0))) <= 2.0 * A * T
    np.testing.assert_allclose(reachable[-1], -2.0, atol=1e-9)
    assert transition.count == 0


def test_a_withdrawn_jump_leaves_no_offset():
    """The source of the reference restarts: the announced jump does not occur."""
    transition = JumpTransition(JumpTransitionParameters(acceleration=A), 0.02, T)
    r = np.array([1.0, -1.0])
    transition.announce(30 * NS, np.array([6.0, 6.0]), np.zeros(2))
    offsets = []
    for n in range(150):
        if n == 25:
            transition.withdraw(25 * NS)
        transition.step(n * NS, r, r)
        offsets.append(transition.plan.offset.copy())
    assert np.max(np.abs(offsets)) > 0.5  # the transition had started
    assert np.max(np.abs(np.diff(offsets, axis=0))) <= A * T * (1 + 1e-9)
    np.testing.assert_allclose(offsets[-1], 0.0, atol=1e-9)
    assert transition.count == 0


def test_jumps_from_the_instant_of_a_withdrawal_on_do_not_occur():
    transition = JumpTransition(JumpTransitionParameters(), 0.0, T)
    jumps = {instant: np.array([1.0, -2.0]) * instant for instant in (24, 25, 26)}
    for instant, jump in jumps.items():
        transition.announce(instant * NS, jump, np.zeros(2))
    transition.withdraw(25 * NS)
    np.testing.assert_array_equal(transition.pop_passed(100 * NS), jumps[24])


def test_future_jumps_enter_psi_free_in_their_period():
    transition = JumpTransition(JumpTransitionParameters(), 0.0, T)
    transition.announce(7 * NS, np.array([2.0, -1.0]), np.zeros(2))
    transition.announce(10 * NS, np.array([0.5, 0.5]), np.zeros(2))
    change = transition.future_jumps(0, 5 * T, 4)
    np.testing.assert_allclose(change, [[0.0, 0.0], [-2.5, 0.5], [0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(transition.future_jumps(7 * NS, 5 * T, 4)[0], [-0.5, -0.5])
    np.testing.assert_allclose(transition.pop_passed(8 * NS), [2.0, -1.0])
    np.testing.assert_allclose(transition.pop_passed(8 * NS), 0.0)
