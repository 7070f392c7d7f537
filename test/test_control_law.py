# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The law (64)-(84): its sum, E12-E14, and the bound along simulated runs."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.law import (
    TANH_GAP,
    Certificate,
    LawSettings,
    compensator,
    law_terms,
    lyapunov_rate_bound,
    lyapunov_value,
    ultimate_bound,
)
from t3mpc_ros.fuzzy.adaptation import AdaptationSettings
from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
from t3mpc_ros.fuzzy.sets import FuzzySettings


def _law(speeds, wanted, rate, estimate, predictive, gain=8.0, bound=2.0, smoothing=0.5):
    terms, command = np.zeros((5, 2)), np.zeros(2)
    law_terms(speeds, wanted, rate, estimate, predictive, gain, bound, smoothing, terms, command)
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

    With exact g and no disturbance, (68) says delta' = -K delta + v_c + v_p: the derivative of
    the reference must drop out. It does with r' in the law, and only then.
    """
    chi, r, rate = np.array([1.0, -2.0]), np.array([0.5, -1.0]), np.array([3.0, -4.0])
    g = np.array([0.7, -0.3])
    terms, u = _law(chi, r, rate, g, np.zeros(2))
    delta_rate = g + u - rate  # chi' = g + u (64), delta' = chi' - r'
    np.testing.assert_allclose(delta_rate, terms[1] + terms[3] + terms[4], atol=1e-14)
    _, printed = _law(chi, r, np.zeros(2), g, np.zeros(2))
    assert np.all(np.abs(g + printed - rate - (terms[1] + terms[3] + terms[4])) > 1.0)


def test_compensator_81_82_opposes_the_error_and_never_exceeds_its_bound():
    for error in np.linspace(-20.0, 20.0, 4001):
        value = compensator(float(error), 3.0, 0.5)
        assert abs(value) <= 3.0
        assert value * error <= 0.0
    assert compensator(1.0, 2.0, 1.0) == pytest.approx(-2.0 * math.tanh(1.0))


def test_e14_the_gap_between_absolute_value_and_tanh_is_0_2785_epsilon():
    """(83) treats tanh as the sign function; the gap it forgets is exactly this large."""
    for epsilon in (0.05, 1.0, 7.0):
        x = np.linspace(-10 * epsilon, 10 * epsilon, 200_001)
        gap = np.abs(x) - x * np.tanh(x / epsilon)
        assert gap.max() <= TANH_GAP * epsilon
        assert gap.max() > 0.999 * TANH_GAP * epsilon


def test_e14_the_printed_claim_83_is_violated_where_the_corrected_one_holds():
    """A constant disturbance at its bound: V rises inside the ball although (83) forbids it."""
    law = LawSettings(gain=2.0, error_bound=1.0, smoothing=1.0)
    delta = np.array([0.3, 0.0])
    disturbance = np.array([1.0, 0.0])
    rate = float(
        delta
        @ (-law.gain * delta + disturbance - law.error_bound * np.tanh(delta / law.smoothing))
    )
    assert rate > -law.gain * float(delta @ delta)
    assert rate <= lyapunov_rate_bound(delta, law.gain, law.error_bound, law.smoothing)


def test_e13_each_wheels_predictive_term_works_on_its_own_error():
    """(76) and (79) print delta_1 v_p2; the derivative of (74) along (73) holds delta_2 v_p2."""
    rng = np.random.default_rng(2)
    delta, v_p, residual = rng.normal(size=(3, 2))
    gain = 4.0
    delta_rate = residual - gain * delta + v_p  # (72)-(73) with v_c = 0
    step = 1e-6
    value = lyapunov_value(delta, np.zeros(1), 1.0)
    moved = lyapunov_value(delta + step * delta_rate, np.zeros(1), 1.0)
    right = -gain * delta @ delta + delta @ residual + delta[0] * v_p[0] + delta[1] * v_p[1]
    wrong = -gain * delta @ delta + delta @ residual + delta[0] * v_p[0] + delta[0] * v_p[1]
    measured = (moved - value) / step
    assert measured == pytest.approx(right, abs=1e-4)
    assert abs(measured - wrong) > 1e-2


@pytest.mark.parametrize('seed', range(4))
def test_e14_bound_holds_at_every_step_of_a_noise_free_run(seed):
    """Plant (64)-(65) with known alpha*, bounded disturbance and bounded v_p, law and adaptation.

    Everything of the proof is real here: V is (74) with the true alpha*, the fuzzy system is the
    package's, the plant's own fuzzy system has other coefficients, the disturbance reaches its
    bound, v_p is as bad as its bound allows. Small steps, so that V' is the derivative.
    """
    rng = np.random.default_rng(seed)
    adaptation = AdaptationSettings(sigma_modification=0.0, dead_zone=0.0)
    learner = FuzzyEstimator(FuzzySettings(), adaptation, outputs=2)
    plant = FuzzyEstimator(FuzzySettings(), adaptation, outputs=2)
    plant.coefficients = rng.uniform(-3.0, 3.0, plant.coefficients.shape)
    gamma = adaptation.gamma
    law = LawSettings(gain=6.0, error_bound=2.0, smoothing=0.4)
    v_bound = 1.5
    bound = law.error_bound + v_bound
    dt = 2e-5
    chi = rng.uniform(-3.0, 3.0, 2)
    terms, u = np.zeros((5, 2)), np.zeros(2)
    phases = rng.uniform(0.0, 2.0 * math.pi, 6)
    worst, ball = -math.inf, ultimate_bound(law.gain, bound, law.smoothing)
    previous = None
    largest_late = 0.0
    for k in range(150_000):
        t = k * dt
        r = np.array([3.0 * math.sin(2 * t + phases[0]), 2.0 * math.cos(3 * t + phases[1])])
        rate = np.array([6.0 * math.cos(2 * t + phases[0]), -6.0 * math.sin(3 * t + phases[1])])
        delta = chi - r
        coefficient_errors = plant.coefficients - learner.coefficients
        value = lyapunov_value(delta, coefficient_errors, gamma)
        if previous is not None:
            worst = max(worst, (value - previous[0]) / dt - previous[1])
        previous = value, lyapunov_rate_bound(delta, law.gain, bound, law.smoothing)
        w = law.error_bound * np.sin(np.array([7.0, 11.0]) * t + phases[2:4])
        v_p = v_bound * np.sign(delta)  # pushes the wrong way, as hard as it may
        truth = plant.evaluate(chi).copy()
        g = learner.evaluate(chi)
        law_terms(chi, r, rate, g, v_p, law.gain, bound, law.smoothing, terms, u)
        learner.adapt(delta, dt)
        chi = chi + dt * (truth + u + w)
        if t > 2.0:
            largest_late = max(largest_late, float(np.linalg.norm(delta)))
    assert worst < 0.05, 'V rose faster than E14 allows'
    assert largest_late < 3.0 * ball


def test_certificate_holds_on_a_decaying_error_and_names_a_rising_one():
    law = LawSettings(gain=5.0, error_bound=0.0, smoothing=1.0)
    watch = Certificate(window=0.2)
    for k in range(200):
        reading = watch.update(np.array([1.0, -1.0]) * math.exp(-5.0 * 0.01 * k), law, 0.0, 0.01)
    assert reading.holds
    assert reading.value < 1e-7
    watch.reset()
    for k in range(50):
        reading = watch.update(np.array([1.0, 1.0]) * (1.0 + 0.05 * k), law, 0.0, 0.01)
    assert not reading.holds
    assert reading.margin < 0.0
