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
"""Controller step by step: stops and their reasons, jumps, adaptation, weights."""

from dataclasses import replace
import math
import re
import sys

import numpy as np
import pytest
from support import waiting
from support.control_loops import GEOMETRY, LEAD, PERIOD, Loop, ServoLoop, make_state
from support.long_tests import few_of

from t3mpc_ros.control.body_correction import BodyCorrection
from t3mpc_ros.control.control_law import Nt3fsMpcController, Nt3fsMpcParameters
from t3mpc_ros.control.controller import (
    Controller,
    ControllerParameters,
    StepperControllerParameters,
    SwitchingTracker,
)
from t3mpc_ros.control.jump_transition import JumpTransitionParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.kinematics import twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, State, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError

MS = 1_000_000


pytestmark = pytest.mark.compiled


def test_the_controller_waits_for_a_reference_and_tracks_it():
    loop = Loop()
    assert not loop.controller.add_reference(make_state(0, math.nan, 0.0))
    statuses = loop.run(300)
    assert statuses[0].reason is Reason.NO_REFERENCE
    assert statuses[-1].reason is Reason.TRACKING
    assert loop.twist.linear == pytest.approx(0.1, abs=2e-3)
    assert loop.twist.angular == pytest.approx(0.5, abs=2e-2)


def test_the_command_never_exceeds_the_limits():
    loop = Loop(lambda t: (5.0 * math.sin(9 * t), 60.0 * math.cos(7 * t)))
    limits = loop.controller.parameters.limits
    before = None
    for _ in range(400):
        status = loop.step()
        wheels = wheels_from_twist(loop.twist, GEOMETRY)
        assert abs(loop.twist.linear) <= limits.linear * (1 + 1e-9)
        assert abs(loop.twist.angular) <= limits.angular * (1 + 1e-9)
        assert max(map(abs, wheels)) <= limits.wheel_speed * (1 + 1e-9)
        if before is not None and status.reason is Reason.TRACKING:
            change = np.subtract(wheels, before)
            assert np.max(np.abs(change)) <= limits.wheel_acceleration * 0.01 * (1 + 1e-9)
        before = wheels if status.reason is Reason.TRACKING else None


@pytest.mark.parametrize('late', [0, 200 * MS])
def test_a_repeated_message_does_not_move_a_disabled_robot(late):
    """The command of the last step was returned, with the reason of moving."""
    loop = Loop()
    loop.run(100)
    assert loop.twist.linear > 0.0
    loop.controller.enable(on=False)
    last = loop.now - PERIOD
    twist, status = loop.controller.step(State(last - late, ORIGIN, loop.twist))
    assert (twist, status.reason) == (BodyTwist(0.0, 0.0), Reason.DISABLED)
    assert loop.controller.ignored_odometry == 1
    loop.controller.enable(on=True)
    twist, status = loop.controller.step(State(last, ORIGIN, loop.twist))
    assert twist == BodyTwist(0.0, 0.0)


@pytest.mark.parametrize('composition', few_of(['body', 'paper']))
@pytest.mark.slow
def test_the_first_command_is_within_the_acceleration_limits(composition):
    """A standing robot with noise of 0.2 rad/s was commanded a step to the noise at once."""
    generator = np.random.default_rng(4)
    controller = Controller(
        ControllerParameters.from_dict({'composition': composition, 'law.gain': 0.0})
    )
    limits = controller.parameters.limits
    for run in range(20):
        controller.reset()
        linear, angular = generator.uniform((-0.3, -3.0), (0.3, 3.0)).tolist()
        for k in range(41):
            controller.add_reference(make_state(k * PERIOD, linear, angular))
        noise = WheelSpeeds(*generator.normal(0.0, 0.2, 2).tolist())
        command, status = controller.step(State(0, ORIGIN, twist_from_wheels(noise, GEOMETRY)))
        assert status.reason is Reason.TRACKING, run
        wheels = np.abs(wheels_from_twist(command, GEOMETRY))
        assert abs(command.linear) <= 0.01 * limits.linear_acceleration * (1 + 1e-9)
        assert abs(command.angular) <= 0.01 * limits.angular_acceleration * (1 + 1e-9)
        assert wheels.max() <= 0.01 * limits.wheel_acceleration * (1 + 1e-9)


def test_a_moving_robot_is_taken_over_at_its_speed():
    """A controller that starts again, while the robot drives, does not brake it first."""
    loop = Loop(lambda t: (0.2, 0.5))
    for k in range(41):
        loop.controller.add_reference(make_state(k * PERIOD, 0.2, 0.5))
    assert loop.step(make_state(0, 0.2, 0.5)).reason is Reason.TRACKING
    assert loop.twist.linear == pytest.approx(0.2, abs=0.02)


def test_a_missing_reference_stops_the_robot_despite_preview():
    """Samples are stamped ahead; without new ones the robot stops within 0.16 s."""
    loop = Loop()
    loop.run(100)
    loop.reference_active = False
    statuses = loop.run(40)
    moving = [status.reason is Reason.TRACKING for status in statuses]
    assert sum(moving) * 10 <= 160
    assert statuses[-1].reason is Reason.REFERENCE_STALE
    assert loop.twist == BodyTwist(0.0, 0.0)
    loop.reference_active = True
    assert loop.run(30)[-1].reason is Reason.TRACKING


@pytest.mark.parametrize(
    'speed, enabled, reason',
    [
        (math.nan, True, Reason.ODOMETRY_BAD),
        (-math.inf, True, Reason.ODOMETRY_BAD),
        (1e307, True, Reason.ODOMETRY_BAD),
        (3.0, True, Reason.DIVERGING),  # 86 rad/s at the wheels
        (0.1, False, Reason.DISABLED),
    ],
)
def test_a_reason_to_stop_stops_the_robot_until_it_has_passed(speed, enabled, reason):
    loop = Loop()
    loop.run(100)
    loop.controller.enable(enabled)
    status = loop.step(make_state(loop.now, speed, 0.0))
    assert status.reason is reason
    assert loop.twist == BodyTwist(0.0, 0.0)
    found = ' '.join(loop.controller.problems())  # neither value nor bound was said
    assert ('85.7 rad/s (watchdog.speed_bound 40)' in found) == (reason is Reason.DIVERGING)
    loop.controller.enable(True)
    statuses = loop.run(60)
    assert statuses[-1].reason is Reason.TRACKING
    assert all(np.isfinite(status.applied).all() for status in statuses)
    assert np.isfinite(loop.controller.law.fuzzy.coefficients).all()


@pytest.mark.parametrize(
    'lead_ms, words',
    [(10000, ''), (400, ''), (20, ''), (0, '0.000 s ahead of'), (-100, '0.100 s behind')],
)
def test_a_reference_that_is_followed_late_is_named(lead_ms, words):
    """With stamps 0.1 s late the error was 64 times as large, and nothing was said.

    A lead of more than 5 s was allowed, and moved nothing.
    """
    controller = Controller(ControllerParameters())
    twist = BodyTwist(0.0, 0.0)
    for k in range(min(0, -lead_ms // 10), 300):
        controller.add_reference(make_state(k * PERIOD + lead_ms * MS, 0.1, 0.5))
        if k >= 0:
            twist, status = controller.step(State(k * PERIOD, ORIGIN, twist))
    assert status.reason is Reason.TRACKING
    found = [each for each in controller.problems() if 'newest reference' in each]
    assert bool(found) == bool(words)
    assert all(f'is stamped {words} odom' in each for each in found)
    controller.reset()
    assert controller.problems() == []


@pytest.mark.parametrize('huge', [1e10, 1e200, 1e307, 1e308])
def test_no_huge_number_makes_a_command_that_is_not_finite(huge):
    """A reference of 1e307 m/s once made a NaN, a pose of 1e308 m each later step an exception."""
    for pose_loop in (False, True):
        loop = Loop(**{'pose.enabled': pose_loop})
        loop.run(50)
        loop.controller.add_reference(make_state(loop.now + LEAD - PERIOD, huge, -huge))
        loop.run(50)
        for x, yaw in ((huge, 0.0), (-huge, 0.0), (0.0, huge), (0.0, -huge)):
            state = make_state(loop.now, 0.1, 0.0)
            status = loop.step(state._replace(pose=Pose(x, 0.0, yaw)))
            assert status.reason is Reason.ODOMETRY_BAD
            assert loop.twist == BodyTwist(0.0, 0.0)
        assert loop.run(60)[-1].reason is Reason.TRACKING
        assert np.isfinite(loop.twist).all()


def _assert_no_jump_after_a_gap(loop):
    loop.now += 1000 * MS
    for k in range(30):  # the reference continued in the gap
        stamp = loop.now + LEAD - (30 - k) * PERIOD
        loop.controller.add_reference(make_state(stamp, *loop.reference(stamp / 1e9)))
    before = loop.twist
    loop.step()  # this stamp is not believed before the next one confirms it
    assert loop.twist == before
    status = loop.step()
    assert status.reason is Reason.TRACKING
    assert loop.twist.linear == pytest.approx(before.linear, abs=0.02)


def test_a_gap_or_a_jump_back_in_the_odometry_restarts_the_law():
    loop = Loop()
    loop.run(200)
    loop.now = 0  # the robot, or the simulated clock, has restarted
    statuses = loop.run(200)
    assert [status.reason for status in statuses[1:10]] == [Reason.ODOMETRY_RESTARTED] * 9
    assert statuses[-1].reason is Reason.TRACKING
    _assert_no_jump_after_a_gap(loop)


@pytest.mark.parametrize('leap', [-2000, -10_000, 300, 10_000, None])
def test_one_message_whose_stamp_leaps_changes_nothing(leap):
    """It was a restart: the reference was cleared, and the robot stood for 0.4 s."""
    loop, exact = Loop(), Loop()
    for each in (loop, exact):
        each.run(200)
    stamp = 0 if leap is None else loop.now + leap * MS
    for k in range(3):
        status = loop.controller.status
        found = loop.controller.step(State(stamp, ORIGIN, loop.twist))
        assert found == (loop.twist, status)
        assert loop.controller.doubts_odometry
        assert not loop.controller.odometry_used
        assert loop.controller.ignored_odometry == k
        assert loop.step().reason is Reason.TRACKING
        exact.step()
        assert loop.twist == exact.twist
        assert loop.controller.odometry_used
        assert loop.controller.ignored_odometry == k + 1


def test_a_horizon_that_is_sent_again_changes_nothing():
    """Its jumps were withdrawn and not announced again: up to 1.7 times the error."""

    def reference(t):
        return (0.1 if t % 1.0 < 0.5 else 0.2), (0.5 if t % 0.7 < 0.3 else -0.5)

    whole, again = ServoLoop(reference), ServoLoop(reference)
    for k in range(300):
        for loop in (whole, again) if k == 0 else (again,) if k % 5 == 0 else ():
            for stamp in range(loop.now, loop.now + LEAD, PERIOD):
                assert loop.controller.add_reference(make_state(stamp, *reference(stamp / 1e9)))
        for loop in (whole, again):
            assert loop.step().reason is Reason.TRACKING
        assert again.twist == whole.twist


@pytest.mark.parametrize('leap', [-1500, 300])
def test_a_stamp_after_a_silence_is_believed_at_once(leap):
    """The time-out of the node has stopped the robot, so that messages are missing indeed."""
    loop = Loop()
    loop.run(200)
    assert loop.controller.check_odometry(0, 201 * MS)
    loop.now += leap * MS
    loop.step()
    assert loop.controller.odometry_used
    assert loop.controller.ignored_odometry == 0
    assert loop.controller.status.stamp_ns == loop.now - PERIOD


@pytest.mark.parametrize('lag, composition', [(0.003, 'body'), (0.1, 'paper')])
def test_noise_of_the_measurement_cancels_in_the_command(lag, composition):
    """A fixed gain of 15.2 passed 57 % of the noise to the motors of the default robot."""
    commands = []
    for noise in (0.0, 0.02):
        loop = Loop(
            lambda t: (0.1 * math.sin(t), 0.5),
            **{'composition': composition, 'law.gain': 0.0, 'speed_filter.lag': lag,
               'use_fuzzy': False, 'predictive.enabled': False, 'speed_filter.enabled': False},
        )  # fmt: skip
        generator = np.random.default_rng(1)
        sent = []
        for _ in range(200):
            speeds = BodyTwist(*(np.array(loop.twist) + generator.normal(0.0, noise, 2)))
            loop.step(State(loop.now, ORIGIN, speeds))
            sent.append(loop.twist.linear)
        commands.append(np.array(sent))
    passed = np.std((commands[1] - commands[0])[60:]) / 0.02
    assert passed < 0.1


@pytest.mark.parametrize(('deviation', 'named'), [(0.0, False), (0.2, False), (0.45, True)])
def test_more_noise_than_is_set_is_named(deviation, named):
    """It was said to be late commands, or not at all."""
    loop = Loop(
        lambda t: (0.12 + 0.1 * math.sin(2.1 * t), 1.5 * math.sin(1.7 * t)),
        composition='body',
        estimate_dead_time=True,
        **{'law.gain': 0.0, 'speed_filter.noise_variance': 0.04, 'speed_filter.lag': 0.003},
    )
    generator = np.random.default_rng(3)
    for _ in range(400):
        noise = generator.normal(0.0, deviation, 2)
        wheels = np.array(wheels_from_twist(loop.twist, GEOMETRY)) + noise
        loop.step(State(loop.now, ORIGIN, twist_from_wheels(WheelSpeeds(*wheels), GEOMETRY)))
    found = [each for each in loop.controller.problems() if 'noise_variance is 0.04' in each]
    assert bool(found) == named


def test_a_dead_time_that_nobody_configured_is_found():
    """Robot with 50 ms in place of 10 ms: the plan is then early by the missing 40 ms."""

    def reference(t):
        return 0.12 + 0.1 * math.sin(2.1 * t), 1.5 * math.sin(1.7 * t)

    loop = Loop(
        reference,
        composition='body',
        estimate_dead_time=True,
        mean_speeds=False,
        **{'law.gain': 0.0, 'speed_filter.noise_variance': 0.04, 'speed_filter.lag': 0.003},
    )
    sent = [BodyTwist(0.0, 0.0)] * 5
    generator = np.random.default_rng(2)
    for _ in range(1500):
        wheels = np.array(wheels_from_twist(sent[-5], GEOMETRY)) + generator.normal(0.0, 0.2, 2)
        loop.step(State(loop.now, ORIGIN, twist_from_wheels(WheelSpeeds(*wheels), GEOMETRY)))
        sent.append(loop.twist)
    estimate = loop.controller.dead_time
    assert loop.controller.actuation.dead_time == pytest.approx(0.0425, abs=0.004)
    assert abs(estimate.dead_time - 0.0425) < 4.0 * estimate.standard_deviation + 0.003
    # Without the estimate, the configured dead time is back and nothing is disturbed.
    estimate.estimate.disturbed = True
    loop.step(State(loop.now, ORIGIN, loop.twist))
    assert loop.controller.disturbed
    parameters = loop.controller.parameters
    loop.controller.configure(parameters.with_values({'estimate_dead_time': False}))
    loop.step(State(loop.now, ORIGIN, loop.twist))
    assert not loop.controller.disturbed
    assert loop.controller.actuation.dead_time == parameters.speed_filter.dead_time
    loop.controller.configure(parameters)
    loop.step(State(loop.now, ORIGIN, loop.twist))
    assert not loop.controller.disturbed


def test_the_body_composition_has_no_wheel_parts():
    """Wheels follow exactly; predictive jumps were once silently treated as a ramp."""
    loop = Loop(composition='body', **{'law.gain': 0.0})
    statuses = loop.run(100)
    assert not np.any(loop.controller.law.fuzzy.coefficients)
    assert not np.any([statuses[-1].terms[row] for row in (0, 3, 4)])
    with pytest.raises(ParameterError, match='composition body'):
        ControllerParameters.from_dict(
            {'composition': 'body', 'jump_transition.method': 'predictive'}
        )


# --- the control law -----------------------------------------------------------------------------


def _ideal_run(steps, reference, parameters, disturbance=(0.0, 0.0), jumps=()):
    """Run a torque drive on chi' = u + disturbance; return errors, coefficients and the law.

    ``jumps`` are pairs of instant and size of the jumps of the reference.
    """
    tracker = SwitchingTracker(parameters, 'torque')
    law = tracker.law
    law.warm_up()
    chi = np.zeros(2)
    errors, learning = [], []
    for k in range(steps):
        (r, _), (later, _) = reference(k * 0.01), reference(k * 0.01 + 0.01)
        if k == 0:
            tracker.begin(0, chi, r)
        for instant, size in jumps:
            if k == round(100 * instant):
                tracker.transition.announce(k * PERIOD, np.full(2, size), np.zeros(2))
                later = reference(k * 0.01 + 0.01)[0]
        if any(k == round(100 * instant) - 1 for instant, _ in jumps):
            later = r  # the jump is not known yet
        u = tracker.step(k * PERIOD, chi, r, later, 0.01).copy()
        tracker.law.set_applied(u, saturated=False)
        errors.append(chi - r)
        learning.append(law.fuzzy.coefficients.copy())
        chi = chi + 0.01 * (u + np.array(disturbance))
    return np.array(errors), learning, law


QUIET = Nt3fsMpcParameters.from_dict({'speed_filter.noise_variance': 0.0})


@pytest.mark.parametrize('method', ['ramp', 'predictive'])
def test_a_jump_is_followed_without_a_persistent_error(method):
    """A jump of r is no estimation error: adaptation must not change g because of it."""

    def reference(t):
        return np.array([1.0, -1.0]) + (3.0 if t >= 0.999 else 0.0), np.zeros(2)

    parameters = QUIET.with_values({'jump_transition.method': method})
    errors, learning, _ = _ideal_run(300, reference, parameters, jumps=[(1.0, 3.0)])
    before = errors[99]
    np.testing.assert_allclose(before, 0.0, atol=0.02)
    assert errors[100] == pytest.approx([-3.0, -3.0], abs=0.05)
    if method == 'ramp':  # in time and without overshoot
        assert errors[100:].max() < 0.05
        arrival = 1.0 + 3.0 / parameters.jump_transition.acceleration + 0.03
        drift = np.linalg.norm(learning[-1] - learning[99])
        assert drift < 0.4, 'the fuzzy systems have adapted to the jump'
    else:  # v_p compensates the compensator as a disturbance, with a small overshoot
        assert errors[100:].max() < 0.2
        arrival = 1.0 + 5.0 / parameters.law.gain
    assert np.abs(errors[round(100 * arrival) :]).max() < 0.1


def test_with_preview_a_jump_costs_a_quarter_of_squared_error():
    """The controller on a robot with lag and dead time, with and without preview."""
    energy = []
    for preview in (True, False):
        loop = ServoLoop(
            lambda t: (0.1, 0.0) if t < 1.5 else (-0.1, 0.0),
            **{'jump_transition.preview': preview},
        )
        energy.append(loop.squared_error(3.0, after=1.0))
    jump = 0.2 / GEOMETRY.wheel_radius
    a = JumpTransitionParameters().acceleration
    # The delay adds dead time and servo: 10 ms + 15.4 ms (20 ms less half a period, sampled).
    assert energy[0] == pytest.approx(jump**3 / (12 * a), rel=0.1)
    assert energy[1] == pytest.approx(jump**3 / (3 * a) + (0.0254 + 0.005) * jump**2, rel=0.1)


def test_the_source_may_restart_while_a_jump_is_announced():
    """The generator restarts after the announcement of a jump and does not jump."""
    loop = ServoLoop(lambda t: (0.1, 0.0) if t < 1.5 else (-0.1, 0.0))
    loop.run(1.3)
    loop.reference = lambda t: (0.1, 0.0)
    stamp = loop.now - PERIOD
    while stamp <= loop.now + LEAD:  # new samples for the same stamps
        loop.controller.add_reference(make_state(stamp, 0.1, 0.0))
        stamp += PERIOD
    speeds = loop.run(1.0)
    np.testing.assert_allclose(speeds[-1], 0.1 / GEOMETRY.wheel_radius, rtol=0.02)
    assert np.min(speeds) > 0.0  # no transition of the withdrawn jump


@pytest.mark.slow
def test_a_constant_disturbance_moves_to_the_fuzzy_estimate():
    """Adaptation and MPC both integrate: without the transfer, g and v_p share a disturbance.

    Their shares are then arbitrary: g and -v_p may stay at 2 rad/s² against each other.
    """

    def reference(t):
        return np.array([2.0, 1.0]), np.zeros(2)

    disturbance = np.array([3.0, -2.0])
    errors, _, law = _ideal_run(3000, reference, QUIET, disturbance)
    assert np.abs(errors[-100:]).max() < 0.08
    np.testing.assert_allclose(-law.terms[0], disturbance, atol=0.35)  # g is the disturbance
    np.testing.assert_allclose(law.terms[4], 0.0, atol=0.35)  # v_p vanishes
    without = replace(QUIET, integral_transfer=0.0)
    _, _, other = _ideal_run(3000, reference, without, disturbance)
    assert np.abs(other.terms[4]).max() > np.abs(law.terms[4]).max()


def test_the_certificate_holds_along_a_noise_free_run():
    """E14 at run time: |delta|²/2 decreases while the disturbance is within its bound."""

    def reference(t):
        return (
            np.array([2.0 * math.sin(2 * t), 1.5 * math.cos(t)]),
            np.array([4.0 * math.cos(2 * t), -1.5 * math.sin(t)]),
        )

    law = Nt3fsMpcController(QUIET)
    law.warm_up()
    chi = np.array([0.0, 1.5])
    margins = []
    for k in range(2000):
        r, rate = reference(k * 0.01)
        u = law.step(chi, r, rate, 0.01).copy()
        law.set_applied(u, saturated=False)
        margins.append(law.certificate.margin)
        disturbance = 0.9 * np.array([math.sin(5.0 * k * 0.01), math.cos(3.0 * k * 0.01)])
        chi = chi + 0.01 * (u + disturbance)
    assert min(margins[100:]) > 0.0
    assert np.linalg.norm(chi - r) < law.ultimate_bound
    law.reset()  # a new run: without this the jump to its first error would seem a failure
    assert law.certificate == Nt3fsMpcController(QUIET).certificate


def test_the_weights_survive_saving_and_loading(tmp_path, monkeypatch):
    from t3mpc_ros import model_file
    from t3mpc_ros.model_file import ModelError, load_model, save_model

    def reference(t):
        return np.array([2.0 * math.sin(t), 1.0]), np.array([2.0 * math.cos(t), 0.0])

    _, _, law = _ideal_run(500, reference, QUIET, (2.0, -1.0))
    path = tmp_path / 'model.npz'
    save_model(path, law.get_weights(), QUIET.to_dict())
    other = Nt3fsMpcController(QUIET)
    other.set_weights(load_model(path))
    for name, value in law.get_weights().items():
        np.testing.assert_array_equal(other.get_weights()[name], value, err_msg=name)

    with pytest.raises(ModelError, match='cannot read'):
        load_model(tmp_path / 'none.npz')
    (tmp_path / 'text.npz').write_text('no model')
    with pytest.raises(ModelError, match='not a model file'):
        load_model(tmp_path / 'text.npz')
    with pytest.raises(ModelError, match='cannot write'):
        save_model(tmp_path / 'none' / 'x.npz', law.get_weights(), {})
    smaller = Nt3fsMpcController(replace(QUIET, fuzzy=replace(QUIET.fuzzy, sets=2)))
    with pytest.raises(ValueError, match='coefficients must have shape'):
        smaller.set_weights(load_model(path))
    monkeypatch.setattr(model_file, 'FORMAT', 2)
    with pytest.raises(ModelError, match='format 1, this is format 2'):
        load_model(path)


COMPILES = """
import sys
from t3mpc_ros.control import controller as control
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, State

def signatures():
    modules = [module for name, module in sys.modules.items() if name.startswith('t3mpc_ros')]
    kernels = {one for module in modules for one in vars(module).values()
               if hasattr(one, 'compiled') and not isinstance(one, type)}
    return {(one.__module__, one.__name__): len(one.compiled.signatures) for one in kernels}

controller = control.Controller(getattr(control, sys.argv[1])())
controller.warm_up()
before = signatures()
twist = BodyTwist(0.0, 0.0)
for k in range(100):
    jumped = 0.2 if k > 50 else 0.0
    controller.add_reference(State((k + 40) * 10_000_000, ORIGIN, BodyTwist(jumped, 0.1)))
    twist, status = controller.step(State(k * 10_000_000, ORIGIN, twist))
assert status.reason.name == 'TRACKING', status
after = signatures()
print({name for name in after if after[name] != before[name]} or 'nothing')
"""


@pytest.mark.parametrize(
    'parameters', few_of(['StepperControllerParameters', 'ControllerParameters'])
)
@pytest.mark.slow
def test_after_the_warm_up_no_step_compiles(parameters):
    """A separate process, because other tests compile in this one."""
    done = waiting.run([sys.executable, '-c', COMPILES, parameters], 300.0)
    assert done.stdout.strip() == 'nothing', done.stdout + done.stderr


# -- values that leave no margin ------------------------------------------------------------------


@pytest.mark.parametrize(
    'changes, words',
    [
        ({'law.gain': 10.0}, 'law.gain must be from 77.2 to 115 1/s'),
        ({'law.gain': 0.02}, 'got 0.02; law.gain 0 chooses'),
        ({'law.gain': 140.0}, 'got 140'),
        ({'law.gain': 95.0, 'rate': 50.0}, 'from 40 to 59.9 1/s at this rate'),
        (
            {'law.gain': 200.0, 'composition': 'paper'},
            'law.gain plus the slope of the compensator',
        ),
        ({'law.gain': 60.0, 'composition': 'paper', 'speed_filter.lag': 0.02}, 'to 55 1/s'),
        (
            {'predictive.v_max': 1e4, 'composition': 'paper'},
            'law.error_bound plus predictive.v_max',
        ),
    ],
)
def test_feedback_without_margin_is_refused_with_its_bound(changes, words):
    """With ``composition: body`` a gain of 10 had 16 times the error of feed-forward."""
    with pytest.raises(ParameterError, match=re.escape(words)):
        StepperControllerParameters.from_dict(changes)


@pytest.mark.parametrize('composition', ['body', 'paper'])
@pytest.mark.parametrize('lag', [0.001, 0.02, 1.0])
@pytest.mark.parametrize('rate', [5.0, 100.0, 120.0, 1000.0])
def test_the_gain_that_fits_is_accepted_at_every_rate_and_lag(rate, lag, composition):
    """Above 104 Hz the controller of the default robot refused its own gain."""
    changes = {'rate': rate, 'speed_filter.lag': lag, 'composition': composition}
    parameters = StepperControllerParameters.from_dict(changes)
    fitted = parameters.resolved()
    assert 0.0 < fitted.law.gain <= 1.0 / lag
    again = parameters.with_values(
        {'law.gain': fitted.law.gain, 'law.smoothing': fitted.law.smoothing}
    )
    assert again.resolved().law == fitted.law


@pytest.mark.parametrize('straight, turning', [(1000.0, 1.0), (0.0, 1.0)])
def test_a_found_frequency_takes_no_other_beyond_its_bound(straight, turning, monkeypatch):
    """The straight frequency is scaled alike, and 10 000 Hz was an exception of a moving robot."""
    monkeypatch.setattr(BodyCorrection, 'turning_frequency', 10.0)
    changes = {
        'composition': 'body',
        'law.gain': 0.0,
        'command_shaper.straight_frequency': straight,
        'command_shaper.turning_frequency': turning,
    }
    loop = ServoLoop(lambda t: (0.12, 0.5), **changes)
    loop.run(1)
    assert loop.step().reason is Reason.TRACKING
    assert any('oscillates in yaw with 10.0 Hz' in text for text in loop.controller.problems())


def test_an_odometry_faster_than_the_rate_is_thinned_out():
    """At half the rate of the odometry, the plan was behind: six times the error."""
    loop = ServoLoop(lambda t: (0.12 + 0.1 * math.sin(2.0 * t), math.sin(1.7 * t)), rate=100.0)
    fast = ServoLoop(lambda t: (0.12 + 0.1 * math.sin(2.0 * t), math.sin(1.7 * t)), rate=50.0)
    commands = []
    for one in (loop, fast):
        one.run(8)
        commands.append([(one.step().stamp_ns, one.twist) for _ in range(100)])
    stamps = {stamp for stamp, _ in commands[1]}
    assert len(stamps) == pytest.approx(50, abs=1)
    difference = np.array([twist for _, twist in commands[0]]) - [t for _, t in commands[1]]
    assert np.abs(difference).max() < 0.06
    early = make_state(fast.now - PERIOD + 1_000_000, math.nan)
    command, status = fast.controller.step(early)
    assert (command, status.reason) == ((0.0, 0.0), Reason.ODOMETRY_BAD)


def test_the_body_composition_refuses_predictive_jumps():
    """It was once silently treated as a ramp."""
    with pytest.raises(ParameterError, match='composition body'):
        ControllerParameters.from_dict(
            {'composition': 'body', 'jump_transition.method': 'predictive'}
        )


def test_a_gap_in_the_odometry_restarts_the_law_without_a_jump():
    loop = Loop()
    loop.run(200)
    _assert_no_jump_after_a_gap(loop)
