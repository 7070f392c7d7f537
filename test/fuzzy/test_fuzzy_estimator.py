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
"""Fuzzy estimator and adaptation (77)-(78): the Lyapunov proof, the closed loop, invalid input."""

import dataclasses
from functools import partial
import math

import numpy as np
import pytest
from scipy.stats import norm

from t3mpc_ros.fuzzy.estimator import (
    AdaptationGains,
    AdaptationParameters,
    FuzzyEstimator,
    adapt,
    beyond_dead_zone,
    gamma_for,
)
from t3mpc_ros.fuzzy.inference import FuzzyParameters, build_sets, compute_basis

Sets = partial(FuzzyParameters, sets=3, centre_exponent=1.0)

GAIN = 8.0
"""K, 1/s."""

PLAIN = AdaptationGains(600.0, radius=1e12, leakage=0.0, dead_zone=0.0, step_limit=1e9)
"""Without modifications."""


def _bases(count, seed):
    rng = np.random.default_rng(seed)
    sets = build_sets(Sets())
    return np.array([compute_basis(u, sets) for u in rng.uniform(-10.0, 10.0, (count, 2))])


def _matched_run(dt, parameters, disturbance=0.0, duration=2.0):
    """(64)-(65) with a plant inside the fuzzy family, by Euler steps of dt.

    Returns delta, shape (steps, 2), and |alpha~|² over gamma, shape (steps,), before each step.
    """
    rng = np.random.default_rng(21)
    learner = FuzzyEstimator(Sets(), parameters)
    plant = FuzzyEstimator(Sets(), parameters)
    truth = rng.uniform(-15.0, 15.0, learner.coefficients.shape)
    plant.coefficients = truth
    chi = np.array([2.0, -1.0])
    errors, distances = [], []
    for k in range(round(duration / dt)):
        t = k * dt
        r = np.array([4.0 * np.sin(2.0 * t), 5.0 * np.cos(1.3 * t)])
        rate = np.array([8.0 * np.cos(2.0 * t), -6.5 * np.sin(1.3 * t)])
        delta = chi - r
        errors.append(delta)
        distances.append(np.sum((truth - learner.coefficients) ** 2) / parameters.gamma)
        g = learner.evaluate(chi)
        omega = disturbance * np.array([np.sin(37.0 * t), np.cos(23.0 * t)])
        chi = chi + dt * (plant.evaluate(chi) - g - GAIN * delta + rate + omega)
        learner.adapt(delta, dt)
    return np.array(errors), np.array(distances)


def test_the_law_is_77_and_78():
    rng = np.random.default_rng(20)
    phi = _bases(1, 20)[0]
    alpha = rng.normal(size=(2, phi.size))
    delta = np.array([0.3, -1.2])
    expected = alpha + 0.01 * 600.0 * np.outer(delta, phi)
    assert adapt(alpha, phi, delta, 0.01, PLAIN)
    np.testing.assert_allclose(alpha, expected, rtol=1e-14)


@pytest.mark.compiled
def test_v_decreases_by_the_integral_of_k_delta_squared():
    """Without noise and disturbance, (79) is an equality: V(0) - V(T) = K int |delta|² dt.

    Cross terms left over by a wrong sign or factor in (77)-(78) would break it. Euler steps of
    the plant keep it to first order only: the gap must halve with the step.
    """
    parameters = AdaptationParameters(dead_zone=0.0, radius=1e4)
    gaps = []
    for dt in (1e-3, 5e-4):
        delta, distance = _matched_run(dt, parameters)
        v = 0.5 * np.sum(delta**2, axis=1) + 0.5 * distance
        used = GAIN * dt * np.sum(delta[:-1] ** 2)
        gaps.append((v[0] - v[-1] - used) / used)
    assert abs(gaps[1]) < 0.02
    assert gaps[0] / gaps[1] == pytest.approx(2.0, rel=0.1)


@pytest.mark.compiled
@pytest.mark.slow
def test_with_a_dead_zone_v_decreases_for_bounded_disturbances():
    """The disturbance has amplitude K * width per wheel, the largest the argument allows.

    Without the dead zone the same V, taken with delta itself, does rise.
    """
    width = 0.1
    rises = {}
    for zone in (width, 0.0):
        parameters = AdaptationParameters(gamma=600.0, dead_zone=zone, radius=1e4)
        delta, distance = _matched_run(5e-4, parameters, GAIN * width, duration=3.0)
        d = delta - np.clip(delta, -zone, zone)
        v = 0.5 * np.sum(d**2, axis=1) + 0.5 * distance
        rises[zone] = np.maximum(np.diff(v), 0.0).sum() / v[0]
    assert rises[width] < 1e-6
    assert rises[0.0] > 1e-4


def test_dead_zone_is_continuous_odd_and_zero_inside():
    errors = np.linspace(-1.0, 1.0, 2001)
    beyond = np.array([beyond_dead_zone(float(e), 0.3) for e in errors])
    assert np.all(beyond[np.abs(errors) <= 0.3] == 0.0)
    np.testing.assert_allclose(beyond, -beyond[::-1], atol=1e-15)
    assert np.abs(np.diff(beyond)).max() <= np.diff(errors).max() * (1.0 + 1e-9)
    np.testing.assert_allclose(
        beyond[errors > 0.3], errors[errors > 0.3] - 0.3, rtol=0.0, atol=1e-15
    )


def _drift(noise, dead_zone):
    """Return the RMS of |alpha| over the columns after a quarter and after all of a run.

    Every error is noise; each column of ``noise`` is an output, so an independent repetition.
    """
    phi = _bases(len(noise), 22)
    alpha = np.zeros((noise.shape[1], phi.shape[1]))
    norms = []
    for k, values in enumerate(noise):
        adapt(alpha, phi[k], values, 0.01, PLAIN._replace(dead_zone=dead_zone))
        if k + 1 in (len(noise) // 4, len(noise)):
            norms.append(float(np.sqrt(np.mean(np.sum(alpha**2, axis=1)))))
    return norms


@pytest.mark.compiled
def test_noise_makes_the_plain_law_drift_a_dead_zone_stops_it():
    """Noise of 0.2 rad/s for 20 s takes |alpha| to 14 rad/s², and on with the root of time.

    A dead zone of two standard deviations leaves a ninth of the drift of Gaussian noise, 1.5
    rad/s², as theory has it; one as wide as bounded noise leaves none.
    """
    rng = np.random.default_rng(23)
    gaussian = 0.2 * rng.normal(size=(2000, 60))
    quarter, whole = _drift(gaussian, 0.0)
    steps = 0.01 * 600.0 * 0.2 * np.linalg.norm(_bases(2000, 22), axis=1)
    assert whole == pytest.approx(np.sqrt(np.sum(steps**2)), rel=0.15)
    assert whole / quarter == pytest.approx(2.0, rel=0.15)
    outside = 2.0 * (5.0 * norm.sf(2.0) - 2.0 * norm.pdf(2.0))  # remaining part of the variance
    assert _drift(gaussian, 0.4)[1] == pytest.approx(np.sqrt(outside) * whole, rel=0.15)
    bounded = rng.uniform(-0.2, 0.2, (2000, 20))
    assert _drift(bounded, 0.0)[1] > 5.0
    assert _drift(bounded, 0.2)[1] == 0.0


def test_leakage_bounds_the_coefficients_under_noise():
    """With -sigma alpha in (77), |alpha| stays below gamma |Phi||delta| / sigma for ever."""
    rng = np.random.default_rng(24)
    phi = _bases(200, 24)
    alpha = np.zeros((1, phi.shape[1]))
    limits = PLAIN._replace(leakage=0.5)
    bound = 0.01 * 600.0 * np.linalg.norm(phi, axis=1).max() * 0.2 / -np.expm1(-0.5 * 0.01)
    largest = 0.0
    for k in range(10_000):
        # Errors of one sign are the worst case.
        error = np.array([rng.uniform(0.0, 0.2)])
        adapt(alpha, phi[k % 200], error, 0.01, limits)
        largest = max(largest, float(np.linalg.norm(alpha)))
    assert largest < bound
    unlimited = 0.01 * 600.0 * 10_000 * 0.1 * phi.mean(axis=0)
    assert np.linalg.norm(unlimited) > 10.0 * bound


@pytest.mark.parametrize('dt', [1e-3, 10.0])
def test_leakage_decays_exactly_at_any_step(dt):
    alpha = np.full((2, 6), 3.0)
    adapt(alpha, np.full(6, 1.0 / 6.0), np.zeros(2), dt, PLAIN._replace(leakage=2.0))
    np.testing.assert_allclose(alpha, 3.0 * np.exp(-2.0 * dt), rtol=1e-13)


def test_projection_keeps_the_ball_and_reduces_the_distance():
    rng = np.random.default_rng(26)
    phi = _bases(300, 26)
    radius, outside = 10.0, 0
    alpha = np.zeros((2, phi.shape[1]))
    for k in range(300):
        delta = rng.normal(scale=20.0, size=2)
        free = alpha.copy()
        adapt(free, phi[k], delta, 0.01, PLAIN)
        adapt(alpha, phi[k], delta, 0.01, PLAIN._replace(radius=radius))
        norms = np.linalg.norm(alpha, axis=1)
        assert np.all(norms <= radius * (1.0 + 1e-14))
        for z in range(2):
            outside += np.linalg.norm(free[z]) > radius
            truth = rng.normal(size=phi.shape[1])
            truth *= radius * rng.uniform() / np.linalg.norm(truth)
            without = np.linalg.norm(truth - free[z])
            assert np.linalg.norm(truth - alpha[z]) <= without * (1.0 + 1e-14)
    assert outside > 100  # the projection was used


def test_step_limit_bounds_the_change_of_the_estimate():
    """One step changes g by gamma |Phi|² dt delta; that is at most limit * delta, at any dt."""
    phi = _bases(1, 27)[0]
    for gamma, dt in ((600.0, 0.01), (600.0, 1.0), (1e6, 0.01), (1e6, 1e6), (1e6, 1e300)):
        alpha = np.zeros((1, phi.size))
        adapt(alpha, phi, np.array([0.5]), dt, PLAIN._replace(gamma=gamma, step_limit=2.0))
        wanted = min(gamma * (phi @ phi) * dt, 2.0) * 0.5
        assert alpha[0] @ phi == pytest.approx(wanted, rel=1e-12)


def test_huge_finite_errors_end_on_the_ball():
    phi = _bases(1, 28)[0]
    alpha = np.zeros((2, phi.size))
    limits = PLAIN._replace(gamma=1e6, radius=5.0, step_limit=1000.0)
    assert adapt(alpha, phi, np.array([1.7e308, -1e300]), 1e300, limits)
    np.testing.assert_allclose(np.linalg.norm(alpha, axis=1), 5.0, rtol=1e-12)
    np.testing.assert_allclose(alpha[0] / 5.0, phi / np.linalg.norm(phi), rtol=1e-12)
    before = alpha.copy()
    for wrong in (np.nan, np.inf, -np.inf):  # changes no output
        assert not adapt(alpha, phi, np.array([0.5, wrong]), 0.01, PLAIN)
    np.testing.assert_array_equal(alpha, before)


# -- closed loop and object -----------------------------------------------------------------------

KINDS = ('type3', 'interval_type2', 'type1')
DT = 0.01


def _friction(chi):
    """Unknown part of the dynamics, rad/s²: viscous, Coulomb (smooth) and a little coupling."""
    return np.array(
        [
            -1.5 * chi[0] - 3.0 * math.tanh(chi[0] / 0.5) + 0.3 * chi[1],
            -1.2 * chi[1] - 2.5 * math.tanh(chi[1] / 0.5) - 0.3 * chi[0],
        ]
    )


def _closed_loop(sets, adaptation, truth=_friction, noise=0.0, duration=20.0, gain=GAIN):
    """Return tracking errors delta and estimation errors g - g*, shape (steps, 2) each.

    The law is (66)-(67) with E12, without compensator and predictive term.
    """
    rng = np.random.default_rng(30)
    estimator = FuzzyEstimator(sets, adaptation)
    chi = np.zeros(2)
    tracking, estimation = [], []
    for k in range(round(duration / DT)):
        t = k * DT
        r = np.array(
            [
                5.0 * math.sin(0.7 * t) + 2.0 * math.sin(1.9 * t),
                4.0 * math.sin(0.9 * t + 1.0) + 3.0 * math.sin(1.3 * t),
            ]
        )
        rate = np.array(
            [
                3.5 * math.cos(0.7 * t) + 3.8 * math.cos(1.9 * t),
                3.6 * math.cos(0.9 * t + 1.0) + 3.9 * math.cos(1.3 * t),
            ]
        )
        measured = chi + noise * rng.normal(size=2)
        g = estimator.evaluate(measured)
        delta = measured - r
        estimator.adapt(delta, DT)
        tracking.append(chi - r)
        estimation.append(g - truth(chi))
        u = -g - gain * delta + rate
        for _ in range(3):
            chi = chi + DT / 3.0 * (truth(chi) + u)
    return np.array(tracking), np.array(estimation)


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.compiled
@pytest.mark.parametrize('kind', KINDS)
def test_adaptation_reduces_tracking_and_estimation_errors(kind):
    """K = 8 1/s at 100 Hz, friction unknown: 0.79 rad/s RMS without adaptation, 0.21 with."""
    sets = Sets(kind=kind)
    parameters = AdaptationParameters(gamma=gamma_for(sets, 40.0))
    without, unknown = _closed_loop(sets, dataclasses.replace(parameters, enabled=False))
    tracking, estimation = _closed_loop(sets, parameters)
    half = len(tracking) // 2
    assert _rms(tracking[half:]) < 0.4 * _rms(without[half:])
    assert _rms(estimation[half:]) < 0.4 * _rms(unknown[half:])
    if kind == 'type3':  # also on noisy speeds
        noisy, _ = _closed_loop(sets, AdaptationParameters(), noise=0.2)
        assert _rms(noisy[half:]) < 0.5 * _rms(without[half:])


@pytest.mark.compiled
@pytest.mark.slow
def test_a_target_of_the_same_family_is_learned():
    """With a plant that some alpha* describes exactly, the estimate keeps improving."""
    sets = Sets()
    plant = FuzzyEstimator(sets, AdaptationParameters())
    plant.coefficients = np.random.default_rng(31).uniform(-15.0, 15.0, plant.coefficients.shape)
    parameters = AdaptationParameters(gamma=2000.0, dead_zone=0.0)
    _, estimation = _closed_loop(sets, parameters, plant.evaluate, duration=80.0)
    quarters = [_rms(part) for part in np.array_split(estimation, 4)]
    assert quarters == sorted(quarters, reverse=True)
    assert quarters[-1] < 0.25 * quarters[0]


def test_a_huge_gamma_does_not_destabilise_the_sampled_loop():
    """Without the step limit the same gamma makes the coefficients oscillate between bounds."""
    sets = Sets()
    limited = AdaptationParameters(gamma=1e6, radius=1e4)
    limits = (limited, dataclasses.replace(limited, step_limit=1000.0))
    safe, unsafe = (_rms(_closed_loop(sets, limit, duration=5.0)[0][100:]) for limit in limits)
    assert safe < 0.2
    assert unsafe > 20.0 * safe


def test_outputs_share_one_basis_and_equal_alpha_times_phi():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters(), outputs=3)
    rng = np.random.default_rng(32)
    alpha = rng.normal(size=(3, 72))
    estimator.coefficients = alpha
    u = np.array([1.0, -4.0])
    g = estimator.evaluate(u)
    assert g.shape == (3,)
    np.testing.assert_array_equal(estimator.basis, compute_basis(u, build_sets(Sets())))
    np.testing.assert_allclose(g, alpha @ estimator.basis, rtol=1e-13)


def test_adaptation_uses_the_basis_of_the_last_evaluation():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters(dead_zone=0.0))
    estimator.adapt(np.array([5.0, 5.0]), DT)  # before the first one nothing is learnt
    assert not estimator.coefficients.any()
    estimator.evaluate(np.array([9.0, 9.0]))
    estimator.evaluate(np.array([1.0, -4.0]))
    estimator.adapt(np.array([1.0, -0.5]), DT)
    expected = DT * estimator.adaptation.gamma * np.outer([1.0, -0.5], estimator.basis)
    np.testing.assert_allclose(estimator.coefficients, expected, rtol=1e-13)


def test_radius_is_the_root_mean_square_of_the_coefficients():
    for kind in KINDS:
        estimator = FuzzyEstimator(Sets(kind=kind), AdaptationParameters(radius=7.0))
        estimator.coefficients = np.full(estimator.coefficients.shape, 6.99)
        estimator.evaluate(np.zeros(2))
        estimator.adapt(np.zeros(2), DT)
        np.testing.assert_array_equal(estimator.coefficients, 6.99)
        estimator.coefficients = np.full(estimator.coefficients.shape, 9.0)
        estimator.adapt(np.zeros(2), DT)
        np.testing.assert_allclose(estimator.coefficients, 7.0, rtol=1e-13)


def test_default_gamma_does_not_oscillate():
    """s² + K s + gamma |Phi|² = 0 has real roots over all of the input range.

    ``gamma_for`` gives the mean of the normalised gain.
    """
    sets = build_sets(FuzzyParameters())
    drawn = np.random.default_rng(34).uniform(-10.0, 10.0, (500, 2))
    powers = np.array([np.sum(compute_basis(u, sets) ** 2) for u in drawn])
    assert gamma_for(FuzzyParameters(), 40.0) * powers.mean() == pytest.approx(40.0, rel=0.05)
    gains = AdaptationParameters().gamma * powers
    assert gains.min() > 2.0
    assert 4.0 * gains.max() < 15.2**2


def test_configure_takes_effect_and_keeps_coefficients():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    estimator.evaluate(np.zeros(2))
    estimator.adapt(np.ones(2), DT)
    learnt = estimator.coefficients
    estimator.configure(AdaptationParameters(enabled=False))
    estimator.adapt(np.ones(2), DT)
    np.testing.assert_array_equal(estimator.coefficients, learnt)
    estimator.warm_up()
    estimator.coefficients[:] = 1.0  # a copy
    np.testing.assert_array_equal(estimator.coefficients, learnt)
    estimator.configure(AdaptationParameters(radius=0.0))
    estimator.adapt(np.ones(2), DT)
    assert not estimator.coefficients.any()
    estimator.reset()
    assert not estimator.basis.any()


@pytest.mark.parametrize('wrong', [[0.0], [0.0, math.nan], [math.inf, 0.0], [[0.0, 0.0]]])
def test_invalid_inputs_are_rejected_without_effect(wrong):
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    estimator.evaluate(np.array([1.0, 2.0]))
    estimator.adapt(np.ones(2), DT)
    phi, alpha = estimator.basis, estimator.coefficients
    with pytest.raises(ValueError, match='inputs must be 2 finite numbers'):
        estimator.evaluate(np.array(wrong))
    with pytest.raises(ValueError, match='errors must be 2 finite numbers'):
        estimator.adapt(np.array(wrong), DT)
    np.testing.assert_array_equal(estimator.basis, phi)
    np.testing.assert_array_equal(estimator.coefficients, alpha)


def test_invalid_coefficients_are_rejected():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    with pytest.raises(ValueError, match=r'coefficients must have shape \(2, 72\)'):
        estimator.coefficients = np.zeros((2, 71))
    table = np.zeros((2, 72))
    table[1, 3] = math.nan
    with pytest.raises(ValueError, match='coefficients must be finite: got 1 not'):
        estimator.coefficients = table


def test_non_contiguous_and_integer_inputs_are_accepted():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    estimator.coefficients = np.random.default_rng(35).normal(size=(2, 72))
    expected = estimator.evaluate(np.array([1.0, -4.0]))
    strided = np.array([1.0, 99.0, -4.0, 99.0])[::2]
    np.testing.assert_array_equal(estimator.evaluate(strided), expected)
    np.testing.assert_array_equal(estimator.evaluate(np.array([1, -4])), expected)
