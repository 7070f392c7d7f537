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
"""Fuzzy estimator in the closed loop, and with invalid input."""

import dataclasses
from functools import partial
import math

import numpy as np
import pytest

from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, gamma_for
from t3mpc_ros.fuzzy.inference import FuzzyParameters, build_sets, compute_basis

Sets = partial(FuzzyParameters, sets=3, centre_exponent=1.0)

KINDS = ('type3', 'interval_type2', 'type1')
GAIN, DT = 8.0, 0.01


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


@pytest.mark.compiled
@pytest.mark.parametrize('noise', [0.1, 0.2])
def test_adaptation_still_helps_on_noisy_speeds(noise):
    sets = Sets()
    without, _ = _closed_loop(sets, AdaptationParameters(enabled=False), noise=noise)
    tracking, _ = _closed_loop(sets, AdaptationParameters(), noise=noise)
    half = len(tracking) // 2
    assert _rms(tracking[half:]) < 0.5 * _rms(without[half:])


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
    estimator.evaluate(np.array([9.0, 9.0]))
    estimator.evaluate(np.array([1.0, -4.0]))
    estimator.adapt(np.array([1.0, -0.5]), DT)
    expected = DT * estimator.adaptation.gamma * np.outer([1.0, -0.5], estimator.basis)
    np.testing.assert_allclose(estimator.coefficients, expected, rtol=1e-13)


def test_before_the_first_evaluation_nothing_is_learned():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    estimator.adapt(np.array([5.0, 5.0]), DT)
    assert not estimator.coefficients.any()


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


def test_gamma_for_gives_the_mean_normalised_gain():
    drawn = np.random.default_rng(33).uniform(-10.0, 10.0, (500, 2))
    for kind in KINDS:
        parameters = Sets(kind=kind)
        sets = build_sets(parameters)
        power = np.mean([np.sum(compute_basis(u, sets) ** 2) for u in drawn])
        assert gamma_for(parameters, 40.0) * power == pytest.approx(40.0, rel=0.05)


def test_default_gamma_does_not_oscillate():
    """s² + K s + gamma |Phi|² = 0 has real roots over all of the input range."""
    sets = build_sets(FuzzyParameters())
    drawn = np.random.default_rng(34).uniform(-10.0, 10.0, (500, 2))
    gains = AdaptationParameters().gamma * np.array(
        [np.sum(compute_basis(u, sets) ** 2) for u in drawn]
    )
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
    estimator.configure(AdaptationParameters(radius=0.0))
    estimator.adapt(np.ones(2), DT)
    assert not estimator.coefficients.any()


def test_reset_clears_and_warm_up_changes_nothing():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters(sigma_modification=1.0))
    estimator.evaluate(np.array([1.0, 2.0]))
    estimator.adapt(np.ones(2), DT)
    phi, alpha = estimator.basis, estimator.coefficients
    estimator.warm_up()
    np.testing.assert_array_equal(estimator.basis, phi)
    np.testing.assert_array_equal(estimator.coefficients, alpha)
    estimator.reset()
    assert not estimator.coefficients.any()
    assert not estimator.basis.any()


def test_coefficients_and_basis_are_copies():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    estimator.evaluate(np.zeros(2))
    estimator.coefficients[:] = 1.0
    estimator.basis[:] = 0.0
    assert not estimator.coefficients.any()
    assert estimator.basis.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    'wrong', [[0.0], [0.0, math.nan], [math.inf, 0.0], [[0.0, 0.0]], [0.0, 0.0, 0.0]]
)
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


@pytest.mark.parametrize('dt', [-0.01, math.nan, math.inf])
def test_an_invalid_duration_is_rejected(dt):
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    with pytest.raises(ValueError, match='dt must be finite and not negative'):
        estimator.adapt(np.zeros(2), dt)


def test_invalid_coefficients_are_rejected():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    with pytest.raises(ValueError, match=r'coefficients must have shape \(2, 72\)'):
        estimator.coefficients = np.zeros((2, 71))
    table = np.zeros((2, 72))
    table[1, 3] = math.nan
    with pytest.raises(ValueError, match='coefficients must be finite: got 1 not'):
        estimator.coefficients = table
    with pytest.raises(ValueError, match='outputs must be at least 1'):
        FuzzyEstimator(Sets(), AdaptationParameters(), outputs=0)


def test_other_numbers_of_inputs_work_as_well():
    for inputs in (1, 3):
        estimator = FuzzyEstimator(Sets(), AdaptationParameters(), 1, inputs)
        estimator.coefficients = np.full(estimator.coefficients.shape, 2.5)
        assert estimator.evaluate(np.zeros(inputs))[0] == pytest.approx(2.5)


def test_non_contiguous_and_integer_inputs_are_accepted():
    estimator = FuzzyEstimator(Sets(), AdaptationParameters())
    estimator.coefficients = np.random.default_rng(35).normal(size=(2, 72))
    expected = estimator.evaluate(np.array([1.0, -4.0]))
    strided = np.array([1.0, 99.0, -4.0, 99.0])[::2]
    np.testing.assert_array_equal(estimator.evaluate(strided), expected)
    np.testing.assert_array_equal(estimator.evaluate(np.array([1, -4])), expected)
