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
"""PI, disturbance rejection, sliding mode, computed torque, adaptive fuzzy: their own theory."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feedback_control import (
    AdaptiveIntervalType2,
    AdaptiveType1,
    ComputedTorque,
    DisturbanceRejection,
    ProportionalIntegral,
    SlidingMode,
    observer_gains,
)
from t3mpc_ros.fuzzy.inference import build_sets, compute_basis
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import dynamics_vector, wheel_acceleration, wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

T = 0.01
ADAPTIVE = [AdaptiveType1, AdaptiveIntervalType2]
INTEGRATING = [ProportionalIntegral, DisturbanceRejection, SlidingMode, ComputedTorque]
ALL = INTEGRATING + ADAPTIVE


def make(kind, drive='torque', **changes):
    """Return a baseline; double underscores in names of settings stand for dots."""
    values = {name.replace('__', '.'): value for name, value in changes.items()}
    parameters = kind.parameters_type.from_dict(values)
    limit = math.inf if drive == 'torque' else 28.0
    return kind(parameters, NominalModel(drive, T, 0.02, limit, PaperRobotParameters()))


def still(steps):
    """Return r and r' of a reference that does not move."""
    return np.zeros((steps, 2)), np.zeros((steps, 2))


def waves(steps, jump=0.0):
    """Return r and r' of moving wheels, r with a jump in mid-run that r' does not tell."""
    time = T * np.arange(steps)[:, None]
    angular, phase = np.array([3.0, 4.5]), np.array([0.0, 1.0])
    reference = 2.0 * np.sin(angular * time + phase)
    rate = 2.0 * angular * np.cos(angular * time + phase)
    reference[steps // 2 :] += np.array([jump, -jump])
    return reference, rate


def run(
    baseline, reference, load=None, limit=math.inf, ramp=math.inf, start=(0.0, 0.0), noise=0.0
):
    """Return what happened on the plant chi + T (u + d), with a probe of the baseline each step.

    load : d (rad/s²) of step and speeds; limit : largest |u|; ramp : largest change of the
    command c = chi + T u/share per second, as the velocity drive has it
    """
    speeds, rate = reference
    steps = len(speeds)
    rng = np.random.default_rng(5)
    chi = np.array(start, dtype=np.float64)
    stretch = T / (1.0 - math.exp(-T / 0.02))
    told = chi.copy()
    empty = np.zeros(2)
    log = SimpleNamespace(chi=np.empty((steps, 2)), u=np.empty((steps, 2)), probe=[], limited=[])
    for k in range(steps):
        d = np.zeros(2) if load is None else np.asarray(load(k, chi), dtype=np.float64)
        seen = chi + noise * rng.standard_normal(2)
        u = baseline.step(
            Observation(seen, d, speeds[k], speeds[k] + T * rate[k], empty, None)
        ).copy()
        wish = chi + stretch * np.clip(u, -limit, limit)
        told = told + np.clip(wish - told, -ramp * T, ramp * T)
        a = (told - chi) / stretch
        limited = bool(np.any(np.abs(a - u) > 1e-9))
        baseline.applied(a, limited=limited)
        log.chi[k], log.u[k] = chi, u
        log.limited.append(limited)
        log.probe.append(probe(baseline))
        chi = chi + T * (a + d)
    log.error = log.chi - speeds
    log.probe = np.array(log.probe)
    return log


def probe(baseline):
    for name in ('integral', 'observed', 'surface'):
        if hasattr(baseline, name):
            return np.ravel(getattr(baseline, name))
    return baseline.fuzzy.coefficients.ravel()


def kick(step, size):
    """Return a load that pushes both wheels for one step, by ``size`` (rad/s) in opposite ways."""
    return lambda k, _: np.array([size, -size]) / T if k == step else np.zeros(2)


# -- what all of them share -----------------------------------------------------------------------


@pytest.mark.parametrize('kind', INTEGRATING)
def test_neither_jumps_nor_limits_cause_adaptation(kind):
    """Integral, observer and sliding variable are those of the run without jump and limit.

    The linear ones see the same disturbance in both runs. That the limits bite is checked too.
    """
    changes = {'belief': 0.0} if kind is ComputedTorque else {}

    def load(k, _):
        return np.array([3.0 * math.sin(0.05 * k), 4.0])

    free = run(make(kind, **changes), waves(600), load)
    cut = run(make(kind, **changes), waves(600, jump=10.0), load, limit=40.0, ramp=28.0)
    assert sum(cut.limited) > 30
    assert np.max(np.abs(cut.chi - free.chi)) > 5.0
    state = slice(2, None) if kind is DisturbanceRejection else slice(None)  # f, not chi
    np.testing.assert_allclose(cut.probe[:, state], free.probe[:, state], atol=1e-9)
    assert np.max(np.abs(free.probe[:, state])) > 0.1


@pytest.mark.parametrize('kind', ALL)
def test_a_saturated_step_of_10_rad_s_does_not_overshoot(kind):
    changes = {'belief': 0.0, 'integral': 200.0} if kind is ComputedTorque else {}
    reference, rate = still(800)
    reference[400:] = [10.0, -10.0]
    log = run(make(kind, **changes), (reference, rate), lambda k, chi: [4.0, 3.0], limit=28.0)
    assert sum(log.limited) > 20
    over = log.error[400:] * np.array([1.0, -1.0])
    # The fuzzy systems have not learnt the disturbance at the speeds they come to.
    assert np.max(over) < (0.2 if kind in ADAPTIVE else 1e-6)
    # By then a wheel with 28 rad/s² less its load has arrived; no creeping after the limit.
    assert np.max(np.abs(log.error[460:])) < (0.25 if kind in ADAPTIVE else 0.01)


@pytest.mark.parametrize('kind', ALL)
def test_jumps_close_at_the_set_rate_with_exact_tracking(kind):
    changes = {'belief': 0.0} if kind is ComputedTorque else {}
    baseline = make(
        kind, jump_transient__rate=30.0, jump_transient__acceleration=1000.0, **changes
    )
    reference, rate = waves(400, jump=5.0)
    # The slope told is that of the chord, so that nothing but the jump is news.
    smooth, _ = waves(401)
    log = run(baseline, (reference, np.diff(smooth, axis=0) / T), start=reference[0])
    np.testing.assert_allclose(log.error[:200], 0.0, atol=1e-12)
    decay = np.exp(-30.0 * T * np.arange(200))
    np.testing.assert_allclose(log.error[200:, 0], -5.0 * decay, atol=1e-9)
    np.testing.assert_allclose(log.error[200:, 1], 5.0 * decay, atol=1e-9)


@pytest.mark.parametrize('kind', ALL)
def test_it_starts_from_where_the_wheels_are(kind):
    """An error at the start is no disturbance: nothing is learnt from it, nothing overshoots."""
    changes = {'belief': 0.0} if kind is ComputedTorque else {}
    log = run(make(kind, **changes), still(200), start=(4.0, -6.0), limit=28.0)
    learnt = log.probe[:, 2:] if kind is DisturbanceRejection else log.probe
    np.testing.assert_allclose(learnt, 0.0, atol=1e-9)
    assert np.max(log.chi * np.array([-1.0, 1.0])) < 1e-9


@pytest.mark.parametrize(
    'kind, changes',
    [*((kind, {}) for kind in INTEGRATING), (DisturbanceRejection, {'input_gain': 1.6})],
)
def test_a_constant_disturbance_leaves_no_error(kind, changes):
    log = run(make(kind, **changes), still(2000), lambda k, chi: [5.0, -7.0])
    # The model's friction, where there is none, is a disturbance that the integral meets too.
    assert np.max(np.abs(log.error[:50])) > 0.05
    assert np.max(np.abs(log.error[-1])) < 1e-6


# -- PI -------------------------------------------------------------------------------------------


@pytest.mark.parametrize('gain, integral', [(8.0, 16.0), (39.3, 2000.0)])
def test_the_error_under_pi_has_the_poles_promised(gain, integral):
    log = run(make(ProportionalIntegral, gain=gain, integral=integral), still(120), kick(9, 1.0))
    e = log.error[10:, 0]
    trace, determinant = 2.0 - gain * T - integral * T**2, 1.0 - gain * T
    np.testing.assert_allclose(e[2:], trace * e[1:-1] - determinant * e[:-2], atol=1e-13)


def test_noise_cancels_at_the_gain_of_the_servo():
    """The command c = chi + T u/share has no share of chi at K = share/T."""
    share = 1.0 - math.exp(-T / 0.02)
    for gain, reached in ((share / T, 0.0), (0.5 * share / T, 0.5)):
        commands = []
        for speed in (0.0, 0.3):
            baseline = make(ProportionalIntegral, 'velocity', gain=gain, integral=0.1)
            zero = np.zeros(2)
            baseline.step(Observation(zero, zero, zero, zero, zero, None))
            seen = np.full(2, speed)
            u = baseline.step(Observation(seen, zero, zero, zero, zero, None))
            commands.append(speed + T * u[0] / share)
        assert (commands[1] - commands[0]) / 0.3 == pytest.approx(reached, abs=1e-4)


# -- active disturbance rejection -----------------------------------------------------------------


@pytest.mark.parametrize('bandwidth', [5.0, 120.0])
def test_the_observer_has_both_poles_where_they_were_asked_for(bandwidth):
    first, second = observer_gains(bandwidth, T)
    plant = np.array([[1.0, T], [0.0, 1.0]])
    seen = np.eye(2) - np.outer([first, second], [1.0, 0.0])
    beta = math.exp(-bandwidth * T)
    polynomial = np.poly(seen @ plant)
    np.testing.assert_allclose(polynomial, [1.0, -2.0 * beta, beta**2], atol=1e-12)
    # And so has the one that runs: its error after a step of the disturbance.
    baseline = make(DisturbanceRejection, observer_bandwidth=bandwidth)
    log = run(baseline, still(100), lambda k, chi: [5.0, -5.0], limit=3.0)
    assert any(log.limited)
    missing = 5.0 - log.probe[:, 2]
    assert missing[0] == 5.0
    np.testing.assert_allclose(
        missing[2:], 2.0 * beta * missing[1:-1] - beta**2 * missing[:-2], atol=1e-10
    )


@pytest.mark.parametrize(
    'kind, changes', [(DisturbanceRejection, {'shared_speed': 1.0}), (SlidingMode, {})]
)
def test_the_shared_estimate_cancels_a_known_disturbance(kind, changes):
    def load(k, _):
        return np.array([6.0 * math.sin(0.3 * k), 2.0])

    log = run(make(kind, shared_disturbance=1.0, **changes), still(300), load)
    np.testing.assert_allclose(log.error, 0.0, atol=1e-12)
    own = run(make(kind), still(300), load)
    assert np.max(np.abs(own.error)) > 0.02


# -- sliding mode ---------------------------------------------------------------------------------


def test_reaching_law_holds_outside_the_boundary_layer():
    eta, reaching, most = 6.0, 4.0, 5.0

    def load(k, _):
        push = 3.0 / T if k == 20 else 0.0
        return np.array([most * math.cos(0.2 * k) + push, -most - push])

    baseline = make(SlidingMode, switching=eta, reaching=reaching, boundary=0.2, surface=5.0)
    log = run(baseline, still(400), load)
    s = np.abs(log.probe)
    outside = s > 0.2
    assert outside[21:40].all()
    fall = s[:-1] - s[1:]
    counted = outside[:-1].copy()
    counted[20] = False  # the push itself
    assert (fall[counted] >= T * (eta - most + reaching * s[:-1][counted]) - 1e-12).all()
    # Once inside, it stays, and within |d|/(k + eta/phi).
    late = s[250:]
    assert np.max(late) <= most / (reaching + eta / 0.2) + 1e-9
    assert np.max(late) > 0.5 * most / (reaching + eta / 0.2)
    # On s the error follows a first-order lag: |e| <= 2 max |s|.
    assert np.max(np.abs(log.error[350:])) <= 2.0 * np.max(late)


# -- computed torque ------------------------------------------------------------------------------


def nominal_forces(chi):
    """Return chi' - u of the nominal robot, rad/s²."""
    robot = PaperRobotParameters()
    friction = robot.friction
    torque = [
        -friction_torque(speed, friction.viscous, friction.coulomb, friction.coulomb_width)
        for speed in chi
    ]
    return np.array(wheel_acceleration(*chi, *torque, dynamics_vector(robot.body, robot.geometry)))


def test_computed_torque_error_is_linear_on_the_nominal_plant():
    """Friction, Coriolis and all: after a push the error decays as (1 - K T)^k."""
    gain = 12.0
    smooth, _ = waves(301)
    reference = smooth[:300], np.diff(smooth, axis=0) / T

    def load(k, chi):
        return nominal_forces(chi) + kick(100, 2.0)(k, chi)

    baseline = make(ComputedTorque, gain=gain, integral=0.1, measured=1.0)
    log = run(baseline, reference, load, start=smooth[0])
    np.testing.assert_allclose(log.error[:101], 0.0, atol=1e-12)
    e = log.error[101:]
    assert np.max(np.abs(nominal_forces(log.chi[150]))) > 1.0
    # To the last bit it is the recursion of the PI, of which 0.1 1/s² hardly shows.
    np.testing.assert_allclose(
        e[2:], (2.0 - gain * T - 0.1 * T**2) * e[1:-1] - (1.0 - gain * T) * e[:-2], atol=1e-12
    )
    decay = (1.0 - gain * T) ** np.arange(len(e))
    np.testing.assert_allclose(e, decay[:, None] * np.array([2.0, -2.0]), atol=5e-3)
    without = run(
        make(ComputedTorque, gain=gain, integral=0.1, belief=0.0), reference, load, start=smooth[0]
    )
    assert np.max(np.abs(without.error[:101])) > 0.3


@pytest.mark.parametrize('drive, measured', [('torque', 0.0), ('velocity', 0.5)])
def test_computed_torque_scales_its_model_by_the_drive(drive, measured):
    """At constant speeds nothing is left to the feedback, in either drive.

    A servo feels only tau (1 - exp(-T/tau))/T of what acts on the wheels over a period; with
    the whole of it cancelled, as with a torque drive, an error would stay.
    """

    def settle(belief):
        table = PaperRobotParameters.from_dict(
            {'drive.kind': drive, 'drive.dead_time': 0.0, 'disturbance.bound': 0.0}
        )
        robot = PaperRobot(table)
        baseline = make(ComputedTorque, drive, integral=0.1, measured=measured, belief=belief)
        inertia = wheel_inertia(table.body, table.geometry)
        stretch = T / (1.0 - math.exp(-T / 0.02))
        reference, zero = np.array([4.0, 1.5]), np.zeros(2)
        state = robot.state
        for _ in range(150):
            chi = np.array(state.true_wheels)
            u = baseline.step(Observation(chi, zero, reference, reference, zero, None))
            if drive == 'torque':
                state = robot.step_torque(*(inertia @ u))
            else:
                state = robot.step(WheelSpeeds(*(chi + stretch * u)))
        return np.max(np.abs(np.array(state.true_wheels) - reference))

    assert settle(1.0) < 2e-3
    assert settle(0.75) > 0.01
    assert settle(1.25) > 0.01


# -- adaptive fuzzy control -----------------------------------------------------------------------


@pytest.mark.parametrize('kind', ADAPTIVE)
def test_lyapunov_function_falls_by_the_derived_amount(kind):
    """V = |e|²/2 + |alpha* - alpha|²/(2 gamma) in discrete time, not only in its derivative."""
    gain = 12.0
    baseline = make(kind, gain=gain, normalised_gain=300.0, dead_zone=0.0, error_bound=0.0, sets=3)
    sets = build_sets(baseline.parameters_type(sets=3).fuzzy())
    ideal = np.random.default_rng(3).uniform(-8.0, 8.0, (2, sets.size))
    gamma = baseline.fuzzy.adaptation.gamma
    values, squares, errors = [], [], []

    def load(k, chi):
        phi = compute_basis(chi, sets)
        e = baseline.error
        away = ideal - baseline.fuzzy.coefficients
        values.append(0.5 * e @ e + np.sum(away**2) / (2.0 * gamma))
        squares.append(phi @ phi)
        errors.append(e)
        return ideal @ phi

    # The load is asked before the step: V of step k stands in entry k + 1.
    run(baseline, waves(600), load, start=waves(1)[0][0])
    v, e, power = np.array(values[1:]), np.array(errors[1:]), np.array(squares[:-2])
    change = -0.5 * (
        np.sum(e[:-1] ** 2, axis=1)
        - 2.0 * (1.0 - gain * T) * np.sum(e[:-1] * e[1:], axis=1)
        + (1.0 - gamma * power * T**2) * np.sum(e[1:] ** 2, axis=1)
    )
    np.testing.assert_allclose(np.diff(v), change, atol=1e-12)
    assert (np.diff(v) <= 1e-15).all()
    assert v[-1] < 0.95 * v[0]
    assert np.max(np.abs(e[-100:])) < 0.2 * np.max(np.abs(e[:100]))


@pytest.mark.parametrize('kind', ADAPTIVE)
def test_the_step_limit_keeps_any_adaptation_gain_stable(kind):
    baseline = make(kind, gain=5.0, normalised_gain=5000.0, dead_zone=0.0, error_bound=0.0)
    log = run(baseline, waves(1500), lambda k, chi: 7.0 * np.tanh(chi / 0.2))
    assert np.isfinite(log.chi).all()
    assert np.max(np.abs(log.error[500:])) < 1.0


@pytest.mark.parametrize('kind', ADAPTIVE)
def test_adaptation_pauses_at_limits_and_in_the_dead_zone(kind):
    baseline = make(kind, dead_zone=0.02)
    log = run(baseline, waves(600, jump=10.0), lambda k, chi: [4.0, -3.0], ramp=28.0)
    learnt = np.any(np.diff(log.probe, axis=0) != 0.0, axis=1)
    limited = np.array(log.limited[:-1])
    assert limited.sum() > 20
    assert not learnt[limited].any()
    assert learnt[~limited].sum() > 20
    # K e of 1 rad/s² of disturbance stays below a dead zone of 0.05 rad/s at K = 30 1/s.
    quiet = run(make(kind, dead_zone=0.05), still(300), lambda k, chi: [1.0, -1.0])
    np.testing.assert_array_equal(quiet.probe, 0.0)


def test_robust_term_bounds_the_unexplained_error():
    """Without learning, |e| settles where K e + bound tanh(e/epsilon) is the disturbance."""
    changes = {'dead_zone': 2.0, 'gain': 10.0, 'smoothing': 0.1}
    for bound in (0.0, 6.0):
        baseline = make(AdaptiveType1, error_bound=bound, **changes)
        e = run(baseline, still(600), lambda k, chi: [5.0, -5.0]).error[-1]
        np.testing.assert_allclose(10.0 * e + bound * np.tanh(e / 0.1), [5.0, -5.0], rtol=1e-9)
        assert abs(e[0]) == pytest.approx(0.5) if bound == 0.0 else abs(e[0]) < 0.15


@pytest.mark.parametrize('kind, sets', [*zip(ADAPTIVE, [3, 7], strict=True)])
def test_the_adaptation_gain_means_the_same_for_any_sets(kind, sets):
    baseline = make(kind, normalised_gain=150.0, sets=sets)
    drawn = np.random.default_rng(9).uniform(-10.0, 10.0, (500, 2))
    power = np.mean([np.sum(compute_basis(point, baseline.fuzzy.sets) ** 2) for point in drawn])
    assert baseline.fuzzy.adaptation.gamma * power == pytest.approx(150.0, rel=0.03)
