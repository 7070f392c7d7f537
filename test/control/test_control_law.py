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
"""Control law (64)-(84): its sum, E12-E14, the bound along runs, friction, inertia."""

from functools import partial
import math

import numpy as np
import pytest
from support.equations import lyapunov_value, wheel_coriolis
from support.long_tests import few_of

from t3mpc_ros.control.control_law import (
    FRICTION_WEIGHTS,
    INERTIA_WEIGHTS,
    TANH_GAP,
    Certificate,
    LawParameters,
    LinearTerm,
    Nt3fsMpcController,
    Nt3fsMpcParameters,
    add_friction,
    add_inertia,
    compensator,
    law_terms,
    lyapunov_rate_bound,
)
from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters
from t3mpc_ros.evaluation.proposed_method import ProposedParameters
from t3mpc_ros.fuzzy.estimator import (
    AdaptationGains,
    AdaptationParameters,
    FuzzyEstimator,
    adapt,
)
from t3mpc_ros.fuzzy.inference import FuzzyParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.plant.dynamics import (
    BodyParameters,
    dynamics_vector,
    wheel_acceleration,
    wheel_inertia,
)

Sets = partial(FuzzyParameters, sets=3, centre_exponent=1.0)


def _law(speeds, reference, rate, estimate, predictive, gain=8.0, bound=2.0, smoothing=0.5):
    terms, command = np.zeros((5, 2)), np.zeros(2)
    law_terms(
        speeds, reference, rate, estimate, predictive, gain, bound, smoothing, terms, command
    )
    return terms, command


def test_command_is_the_sum_of_the_terms_of_66_and_67():
    rng = np.random.default_rng(1)
    chi, r, rate, g, v_p = rng.normal(size=(5, 2))
    terms, u = _law(chi, r, rate, g, v_p)
    delta = chi - r
    expected = -g - 8.0 * delta + rate - 2.0 * np.tanh(delta / 0.5) + v_p
    np.testing.assert_allclose(u, expected, rtol=1e-14)
    np.testing.assert_allclose(terms.sum(axis=0), u, rtol=1e-14)


def test_e12_with_the_reference_rate_the_error_obeys_68():
    """The printed +omega_i cannot be applied, and without r' a moving reference leaves an error.

    With exact g and no disturbance, (68) is delta' = -K delta + v_c + v_p: the derivative of
    the reference must cancel, which requires r' in the law.
    """
    chi, r, rate = np.array([1.0, -2.0]), np.array([0.5, -1.0]), np.array([3.0, -4.0])
    g = np.array([0.7, -0.3])
    terms, u = _law(chi, r, rate, g, np.zeros(2))
    delta_rate = g + u - rate  # chi' = g + u (64), delta' = chi' - r'
    np.testing.assert_allclose(delta_rate, terms[1] + terms[3] + terms[4], atol=1e-14)
    _, printed = _law(chi, r, np.zeros(2), g, np.zeros(2))
    assert np.all(np.abs(g + printed - rate - (terms[1] + terms[3] + terms[4])) > 1.0)


def test_torque_theta_bar_u_makes_the_plant_of_30_and_64_65():
    """The difference of chi' and u depends on chi alone: it is a function g(chi).

    With a wrong inertia this does not hold: the difference then depends on u.
    """
    body, geometry = BodyParameters(), WheelGeometry()
    nominal, heavy = wheel_inertia(body, geometry), BodyParameters(body_mass=1.5 * body.body_mass)
    rng = np.random.default_rng(3)

    def difference(chi, u, true):
        friction = 0.002 * chi + 0.004 * np.tanh(chi / 0.2)
        torque = nominal @ u - friction
        return np.array(wheel_acceleration(*chi, *torque, dynamics_vector(true, geometry))) - u

    for _ in range(20):
        chi = rng.uniform(-10.0, 10.0, 2)
        friction = 0.002 * chi + 0.004 * np.tanh(chi / 0.2)
        coriolis = wheel_coriolis(WheelSpeeds(*chi), body, geometry) @ chi
        g = np.linalg.solve(nominal, -coriolis - friction)
        accelerations = rng.uniform(-30.0, 30.0, (5, 2))
        for u in accelerations:
            np.testing.assert_allclose(difference(chi, u, body), g, atol=1e-10)
        spread = np.ptp([difference(chi, u, heavy) for u in accelerations], axis=0)
        assert spread.max() > 1.0


def _matched_pair(rng, gamma=600.0):
    """Return a learner and a plant of the same fuzzy family with other coefficients."""
    adaptation = AdaptationParameters(gamma=gamma, dead_zone=0.0, radius=1e4)
    pair = []
    for _ in range(2):
        estimator = FuzzyEstimator(Sets(), adaptation)
        estimator.coefficients = rng.uniform(-5.0, 5.0, estimator.coefficients.shape)
        pair.append(estimator)
    return pair


def test_the_law_and_g_error_70_71_make_the_error_system_72_73():
    """Plant (64)-(65) and law (66)-(67) give (68)-(69), and (72)-(73) in alpha~."""
    rng = np.random.default_rng(4)
    learner, plant = _matched_pair(rng)
    for _ in range(50):
        chi, r, rate, omega, v_p = rng.uniform(-5.0, 5.0, (5, 2))
        truth, g = plant.evaluate(chi), learner.evaluate(chi)
        alpha_error = plant.coefficients - learner.coefficients
        np.testing.assert_allclose(truth - g, alpha_error @ learner.basis, atol=1e-12)
        terms, u = _law(chi, r, rate, g, v_p)
        delta, v_c = chi - r, terms[3]
        delta_rate = truth + u + omega - rate
        np.testing.assert_allclose(
            delta_rate, truth - g - 8.0 * delta + omega + v_c + v_p, atol=1e-12
        )
        np.testing.assert_allclose(
            delta_rate, alpha_error @ learner.basis - 8.0 * delta + omega + v_c + v_p, atol=1e-11
        )


def _slope_of_v(delta, delta_rate, alpha_error, alpha_rate, gamma):
    """Return V' of (74) by central differences, which are exact for a quadratic."""
    step = 1e-4
    ahead, behind = (
        lyapunov_value(
            delta + sign * step * delta_rate, alpha_error - sign * step * alpha_rate, gamma
        )
        for sign in (1.0, -1.0)
    )
    return (ahead - behind) / (2.0 * step)


@pytest.mark.parametrize('tuned', [False, True], ids=['any alpha rate', 'rate of (77)-(78)'])
def test_v_rate_is_75_76_and_79_if_coefficients_follow_77_78(tuned):
    """The terms in alpha~ cancel with the rates of ``adapt`` only."""
    rng = np.random.default_rng(5)
    gamma, dt = 600.0, 1e-7
    for _ in range(20):
        learner, plant = _matched_pair(rng, gamma)
        chi, r, rate, omega, v_p = rng.uniform(-5.0, 5.0, (5, 2))
        truth, g = plant.evaluate(chi), learner.evaluate(chi)
        phi, alpha = learner.basis, learner.coefficients
        alpha_error = plant.coefficients - alpha
        terms, u = _law(chi, r, rate, g, v_p)
        delta, delta_rate = chi - r, truth + u + omega - rate
        alpha_rate = rng.normal(size=alpha.shape)
        if tuned:
            learner.adapt(delta, dt)
            alpha_rate = (learner.coefficients - alpha) / dt
        slope = _slope_of_v(delta, delta_rate, alpha_error, alpha_rate, gamma)
        by_75 = delta @ delta_rate - np.sum(alpha_error * alpha_rate) / gamma
        by_79 = -8.0 * delta @ delta + delta @ (omega + terms[3] + v_p)
        crossed = delta @ (alpha_error @ phi) - np.sum(alpha_error * alpha_rate) / gamma
        assert slope == pytest.approx(by_75, rel=1e-6, abs=1e-6)
        assert slope == pytest.approx(by_79 + crossed, rel=1e-6, abs=1e-6)  # (76)
        if tuned:
            assert slope == pytest.approx(by_79, rel=1e-4, abs=1e-4)
        else:
            assert abs(slope - by_79) > 1e-3


def test_the_compensated_bound_is_the_smallest_that_80_permits():
    """For all omega and v_p within their bounds (79) is at most (80), with equality.

    A compensator for omega-bar without v_p-bar would be too weak.
    """
    parameters = Nt3fsMpcParameters()
    omega_bar, v_bar = parameters.law.error_bound, parameters.predictive.v_max
    bound, gain = parameters.compensated_bound, parameters.law.gain
    rng = np.random.default_rng(6)
    gaps = []
    for k in range(500):
        delta = rng.uniform(-3.0, 3.0, 2)
        worst = k % 10 == 0
        omega = omega_bar * (np.sign(delta) if worst else rng.uniform(-1.0, 1.0, 2))
        v_p = v_bar * (np.sign(delta) if worst else rng.uniform(-1.0, 1.0, 2))
        v_c = np.array([compensator(float(e), bound, parameters.law.smoothing) for e in delta])
        by_79 = -gain * delta @ delta + delta @ (omega + v_c + v_p)
        by_80 = -gain * delta @ delta + bound * np.abs(delta).sum() + delta @ v_c
        gaps.append(by_80 - by_79)
        assert gaps[-1] >= -1e-12
        assert worst == (gaps[-1] < 1e-9)
        assert by_79 <= lyapunov_rate_bound(delta, gain, bound, parameters.law.smoothing) + 1e-12
    off = Nt3fsMpcParameters.from_dict({'predictive.enabled': False})
    assert off.compensated_bound == omega_bar < bound


@pytest.mark.compiled
@pytest.mark.parametrize('seed', few_of(range(4)))
@pytest.mark.slow
def test_e17_the_integral_of_84_holds_with_the_initial_v_only(seed):
    """V(t) - V(0) is at most the integral of the bound; the printed (84) omits V(0).

    The printed (84) bounds V, which is not negative, by a negative integral.
    """
    rng = np.random.default_rng(seed)
    gamma, gain, bound, smoothing, dt = 600.0, 6.0, 3.5, 0.4, 2e-4
    learner, plant = _matched_pair(rng, gamma)
    chi, terms, u = rng.uniform(-3.0, 3.0, 2), np.zeros((5, 2)), np.zeros(2)
    values, squares = [], []
    for k in range(7_500):
        t = k * dt
        r = np.array([3.0 * math.sin(2.0 * t), 2.0 * math.cos(3.0 * t)])
        rate = np.array([6.0 * math.cos(2.0 * t), -6.0 * math.sin(3.0 * t)])
        delta = chi - r
        alpha_error = plant.coefficients - learner.coefficients
        values.append(lyapunov_value(delta, alpha_error, gamma))
        squares.append(float(delta @ delta))
        omega = 2.0 * np.sin(np.array([7.0, 11.0]) * t)
        v_p = 1.5 * np.sign(delta)
        truth, g = plant.evaluate(chi).copy(), learner.evaluate(chi)
        law_terms(chi, r, rate, g, v_p, gain, bound, smoothing, terms, u)
        learner.adapt(delta, dt)
        chi = chi + dt * (truth + u + omega)
    value, spent = np.array(values), gain * dt * np.cumsum(squares)
    time = dt * np.arange(1, value.size)
    allowed = value[0] - spent[:-1] + TANH_GAP * smoothing * 2.0 * bound * time
    assert np.all(value[1:] <= allowed + 1e-3 * value[0])
    assert value[-1] < 0.9 * value[0]
    assert np.all(value[1:] > -spent[:-1])  # the printed (84), violated throughout


def test_compensator_81_82_opposes_the_error_within_its_bound():
    for error in np.linspace(-20.0, 20.0, 401):
        value = compensator(float(error), 3.0, 0.5)
        assert abs(value) <= 3.0
        assert value * error <= 0.0
    assert compensator(1.0, 2.0, 1.0) == pytest.approx(-2.0 * math.tanh(1.0))


def test_e14_the_gap_of_abs_and_tanh_is_0_2785_epsilon():
    """(83) treats tanh as the sign function and omits exactly this gap."""
    for epsilon in (0.05, 1.0, 7.0):
        x = np.linspace(-10 * epsilon, 10 * epsilon, 200_001)
        gap = np.abs(x) - x * np.tanh(x / epsilon)
        assert gap.max() <= TANH_GAP * epsilon
        assert gap.max() > 0.999 * TANH_GAP * epsilon


def test_e14_print_83_is_violated_where_the_correction_holds():
    """A constant disturbance at its bound: V rises inside the ball although (83) forbids it."""
    law = LawParameters(gain=2.0, error_bound=1.0, smoothing=1.0)
    delta = np.array([0.3, 0.0])
    disturbance = np.array([1.0, 0.0])
    rate = float(
        delta
        @ (-law.gain * delta + disturbance - law.error_bound * np.tanh(delta / law.smoothing))
    )
    assert rate > -law.gain * float(delta @ delta)
    assert rate <= lyapunov_rate_bound(delta, law.gain, law.error_bound, law.smoothing)


def test_certificate_holds_for_a_decaying_error_only():
    watch = Certificate()
    for k in range(2000):
        error = math.exp(-0.5 * 0.01 * k)
        reading = watch.update([error, -error], 0.5, 0.0, 1.0, 0.01)
    assert reading.holds
    assert reading.value < 1e-7
    watch.reset()
    for k in range(50):
        reading = watch.update(2 * [1.0 + 0.05 * k], 5.0, 0.0, 1.0, 0.01)
    assert not reading.holds
    assert reading.margin < 0.0


@pytest.mark.compiled
def test_the_law_takes_columns_and_integers_after_plain_arrays():
    """Its kernels keep the types of their first arguments and would misread other arrays."""
    numbers = np.random.default_rng(1).integers(-9, 9, (6, 3, 2))
    forms = [
        lambda values: values.astype(np.float64),
        lambda values: np.stack([values, values + 1.0], axis=1)[:, 0],
        lambda values: values,
    ]

    def run(forms):
        law = Nt3fsMpcController(Nt3fsMpcParameters())
        transition = JumpTransition(JumpTransitionParameters(), 0.02, 0.01)
        outputs = []
        for k, triple in enumerate(numbers):
            speeds, now, later = map(forms[k % len(forms)], triple)
            transition.step(k * 10_000_000, now, later)
            u = law.step(speeds, now, later, 0.01).copy()
            law.set_applied(now, saturated=True)
            outputs.append([u, transition.rate.copy(), law.predictive.signals.applied.copy()])
        return np.array(outputs)

    np.testing.assert_array_equal(run(forms), run(forms[:1]))


# -- Coulomb friction (E23) and wrong inertia (E24) in the estimate g -----------------------------

DT = 0.01
FRICTION = np.array([[9.0, 4.0], [4.0, 9.0]])
"""Accelerations (rad/s²) by the friction of the two wheels of a body."""
HEAVY = np.array([[1.3, 0.1], [0.1, 1.3]])
"""True over assumed inertia of both wheels."""


def controller(**changes):
    parameters = {'predictive.enabled': False, 'jump_transition.preview': False}
    return Nt3fsMpcController(Nt3fsMpcParameters.from_dict(parameters | changes))


def heavy_controller(**changes):
    parameters = {'predictive.enabled': False, 'adaptation.gamma': 0.0, 'friction.gamma': 0.0}
    return Nt3fsMpcController(ProposedParameters.from_dict(parameters | changes))


def track(law, seconds, friction=FRICTION, inertia=None):
    """Return the RMS error (rad/s) over the last half of slow turns back and forth."""
    chi, errors = np.zeros(2), []
    inertia, pace = (np.eye(2), 2.0) if inertia is None else (inertia, 3.0)
    for k in range(round(seconds / DT)):
        time = k * DT + np.array([0.0, 1.1])
        reference, rate = 2.0 * np.sin(pace * time), 2.0 * pace * np.cos(pace * time)
        errors.append(chi - reference)
        u = law.step(chi, reference, rate, DT)
        law.set_applied(u, saturated=False)
        chi = chi + DT * (np.linalg.solve(inertia, u) - friction @ np.tanh(chi / 0.2))
    return np.sqrt(np.mean(np.square(errors[len(errors) // 2 :])))


def track_heavy(law, seconds):
    return track(law, seconds, 0.0 * FRICTION, HEAVY)


@pytest.mark.parametrize('term', ['friction', 'inertia'])
def test_the_estimate_is_the_fuzzy_one_plus_the_term_e23_e24(term):
    rng = np.random.default_rng(1)
    tables = LinearTerm(np.zeros(2), rng.normal(size=(2, 2)))
    given, fuzzy = rng.normal(size=(2, 2))
    estimate = fuzzy.copy()
    if term == 'friction':
        add_friction(given, 0.3, tables, estimate)
        basis = np.tanh(given / 0.3)
    else:
        add_inertia(given, 50.0, tables, estimate)
        basis = given / 50.0
    np.testing.assert_allclose(tables.basis, basis, rtol=1e-15)
    np.testing.assert_allclose(estimate, fuzzy + tables.coefficients @ basis, rtol=1e-14)


def test_v_rate_is_79_if_the_coefficients_follow_e23():
    """(76) contains delta_i phi~_i's; the adaptation of the same form as (77) cancels it."""
    rng = np.random.default_rng(2)
    gamma, dt = 10.0, 1e-7
    for _ in range(20):
        truth, known = rng.normal(size=(2, 2, 2))
        basis, delta, others = np.tanh(rng.normal(size=2)), rng.normal(size=2), rng.normal(size=2)
        adapted = known.copy()
        assert adapt(adapted, basis, delta, dt, AdaptationGains(gamma, 100.0, 0.0, 0.0, 2.0))
        delta_rate = (truth - known) @ basis + others
        change = 2.0 * delta @ delta_rate * dt / 2.0
        change += (np.sum((truth - adapted) ** 2) - np.sum((truth - known) ** 2)) / (2.0 * gamma)
        assert change / dt == pytest.approx(delta @ others, rel=1e-4, abs=1e-4)


@pytest.mark.compiled
def test_friction_of_both_wheels_is_learnt_through_the_body():
    law = controller(**{'adaptation.gamma': 0.0, 'friction.gamma': 30.0})
    track(law, 40.0)
    # g is what the robot adds to u: friction acts against the motion.
    np.testing.assert_allclose(law.friction, -FRICTION, atol=1.5)


@pytest.mark.compiled
@pytest.mark.slow
def test_with_much_friction_the_error_is_less_than_half():
    with_term, without = (track(controller(**{'friction.gamma': g}), 20.0) for g in (10.0, 0.0))
    assert with_term < 0.5 * without
    smooth = [
        track(controller(**{'friction.gamma': g}), 20.0, 0.0 * FRICTION) for g in (10.0, 0.0)
    ]
    assert smooth[0] < 1.02 * smooth[1] + 1e-6


@pytest.mark.compiled
def test_a_wrong_inertia_of_both_wheels_is_learnt():
    with_term = track_heavy(heavy_controller(**{'inertia.gamma': 3000.0}), 30.0)
    assert with_term < 0.2 * track_heavy(heavy_controller(), 30.0)


@pytest.mark.compiled
def test_without_gamma_g_is_31_as_printed():
    law = controller(**{'friction.gamma': 0.0})
    track(law, 2.0)
    assert not law.friction.any()
    assert not law.inertia.any()
    assert INERTIA_WEIGHTS not in law.get_weights()
    chi = np.array([1.0, -2.0])
    law.step(chi, chi, np.zeros(2), DT)
    np.testing.assert_array_equal(-law.terms[0], law.fuzzy.evaluate(chi))


@pytest.mark.compiled
def test_coefficients_stay_in_the_ball_under_any_error():
    law = controller(**{'adaptation.radius': 3.0, 'friction.gamma': 1e4})
    rng = np.random.default_rng(3)
    for _ in range(500):
        law.step(*rng.uniform(-20.0, 20.0, (3, 2)), DT)
        assert np.linalg.norm(law.friction, axis=1).max() <= np.sqrt(2.0) * 3.0 * (1.0 + 1e-12)


@pytest.mark.compiled
@pytest.mark.parametrize('name', [FRICTION_WEIGHTS, INERTIA_WEIGHTS])
def test_weights_of_the_term_are_kept_and_discarded(name):
    """A model from before the term has none."""
    term = name.split('.')[0]
    changes = {f'{term}.gamma': 300.0}
    law, other = (
        (controller(), controller())
        if term == 'friction'
        else (heavy_controller(**changes), heavy_controller(**changes))
    )
    (track if term == 'friction' else track_heavy)(law, 2.0)
    weights = law.get_weights()
    assert np.abs(weights[name]).max() > 0.01
    other.set_weights(weights)
    np.testing.assert_array_equal(getattr(other, term), getattr(law, term))
    del weights[name]
    other.set_weights(weights)
    assert not getattr(other, term).any()
    with pytest.raises(ValueError, match=rf'{term}\.coefficients must be finite, of shape'):
        other.set_weights(weights | {name: np.zeros(2)})
    law.reset_estimate()
    assert not getattr(law, term).any()
    assert not law.fuzzy.coefficients.any()
