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
"""Boltzmann machine: passes, energy and distribution, learning rules, pretraining, nominal run."""

import itertools

import numpy as np
import pytest
from scipy.linalg import expm
from support.equations import boltzmann_distribution, energy, free_energy

from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    bipolar_sigmoid,
    contrastive_divergence_step,
    gradient_step,
    make_machine,
    make_rls_state,
    predict_error,
    rls_step,
    set_visible,
)
from t3mpc_ros.mpc.pretraining import (
    ExcitationParameters,
    NominalLoopParameters,
    SampleTiming,
    nominal_step_response,
    nominal_transition,
    pretrain,
    ridge_regression,
    simulate_excitation,
)

TIMING = SampleTiming(0.01, 5, 5)
NOMINAL, EXCITATION = NominalLoopParameters(), ExcitationParameters()
SHAPE = LayerSizes(4, 4, 12)


def _machine(seed=0, shape=SHAPE, spread=1.0):
    return make_machine(shape, 3.0, 20.0, spread, np.random.default_rng(seed))


def _excited(generator, excitation=EXCITATION, loop=NOMINAL):
    return simulate_excitation(loop, excitation, TIMING, 20.0, generator)


def _missed(machine, errors, moves, rows=None):
    """Yield the error of each prediction of a run, from the newest on, or of some rows."""
    for i in range(errors.size - 5) if rows is None else rows:
        machine.lags[:4] = errors[i + 1 : i + 5] / 3.0
        machine.lags[4:] = moves[i + 1 : i + 5] / 20.0
        yield errors[i] - predict_error(machine)


def _states(count):
    return [np.array(state) for state in itertools.product((-1.0, 1.0), repeat=count)]


def _slope(function, weights, step=1e-6):
    """Return the gradient of a function of X_v by central differences."""
    out = np.zeros_like(weights)
    for index in np.ndindex(weights.shape):
        for sign in (1.0, -1.0):
            moved = weights.copy()
            moved[index] += sign * step
            out[index] += sign * function(moved) / (2.0 * step)
    return out


def test_cd_step_is_the_gradient_of_the_energy_difference():
    """E9: (43) is E(eta_1, mu_1) - E(eta_0, mu_0) differentiated at fixed states."""
    machine = _machine(spread=1.5)
    machine.lags[:] = np.random.default_rng(1).uniform(-1.0, 1.0, 8)
    predict_error(machine)
    before = machine.visible_weights.copy()
    expected = _slope(
        lambda weights: (
            energy(weights, machine.eta1, machine.mu1) - energy(weights, machine.lags, machine.mu0)
        ),
        before,
    )
    contrastive_divergence_step(machine, 1e-3)
    np.testing.assert_allclose(
        (machine.visible_weights - before) / 1e-3, expected, rtol=1e-6, atol=1e-9
    )


def test_cd_step_estimates_the_likelihood_gradient():
    """E9: ln J' of (41) has the gradient -F(eta_0)' + <F'>; CD-1 replaces the mean by eta_1.

    The sum over hidden units is exact; at temperature 2 the gradient is half of (43).
    """
    machine = _machine(seed=3, spread=1.5)
    machine.lags[:] = np.random.default_rng(4).uniform(-1.0, 1.0, 8)
    predict_error(machine)
    before = machine.visible_weights.copy()
    expected = _slope(
        lambda weights: free_energy(weights, machine.eta1) - free_energy(weights, machine.lags),
        before,
    )
    contrastive_divergence_step(machine, 1e-3)
    np.testing.assert_allclose(
        0.5 * (machine.visible_weights - before) / 1e-3, expected, rtol=1e-6, atol=1e-9
    )


def _likelihood(weights, data):
    """Return the mean ln J' of visible states, by enumerating every state of (41)."""
    visible, hidden = (_states(count) for count in weights.shape)
    energies = np.array([[energy(weights, eta, mu) for mu in hidden] for eta in visible])
    probability = boltzmann_distribution(energies).sum(axis=1)
    index = {tuple(eta): i for i, eta in enumerate(visible)}
    return np.mean([np.log(probability[index[tuple(eta)]]) for eta in data])


def test_cd_steps_increase_the_exact_likelihood():
    """On a machine small enough for enumeration CD-1 agrees with the true gradient."""
    machine = _machine(seed=5, shape=LayerSizes(2, 2, 4), spread=0.5)
    data = [np.array(s) for s in ((1.0, 1.0, -1.0, 1.0), (-1.0, -1.0, 1.0, 1.0))]
    start = machine.visible_weights.copy()
    true_slope = _slope(lambda weights: _likelihood(weights, data), start, 1e-5)
    for eta in data:
        machine.lags[:] = eta
        predict_error(machine)
        contrastive_divergence_step(machine, 1e-6)  # small enough to leave the weights unchanged
    moved = machine.visible_weights - start
    cosine = np.sum(moved * true_slope) / np.linalg.norm(moved) / np.linalg.norm(true_slope)
    assert cosine > 0.7  # one step of a chain is a biased estimate
    figures = [_likelihood(start, data)]
    for _ in range(4):
        for _ in range(25):
            for eta in data:
                machine.lags[:] = eta
                predict_error(machine)
                contrastive_divergence_step(machine, 0.02)
        figures.append(_likelihood(machine.visible_weights, data))
    assert all(later > earlier for earlier, later in itertools.pairwise(figures))
    assert figures[-1] > figures[0] + 0.5


@pytest.mark.compiled
@pytest.mark.slow
def test_cd_weights_remain_bounded():
    """Data outside [-1, 1] cannot be reconstructed; without the limit X_v diverges."""
    machine = _machine()
    generator = np.random.default_rng(6)
    for _ in range(5_000):
        machine.lags[:] = np.clip(2.0 * generator.standard_normal() + np.zeros(8), -10.0, 10.0)
        predict_error(machine)
        contrastive_divergence_step(machine, 0.01)
    assert np.max(np.abs(machine.visible_weights)) < 20.0


def test_gradient_step_is_the_plain_form_for_unit_features():
    machine = _machine()
    machine.lags[:] = np.random.default_rng(7).uniform(-1.0, 1.0, 8)
    predict_error(machine)
    gradient_step(machine, 0.6, 0.1, 1.0 - float(machine.mu1 @ machine.mu1))
    np.testing.assert_allclose(machine.output_weights, 0.1 * 0.6 / 3.0 * machine.mu1, rtol=1e-13)


def test_gradient_step_is_independent_of_the_amplitude():
    """The plain form (44) with a fixed gamma is stable at one amplitude only."""
    for size in (1e-3, 1.0):
        machine = _machine()
        machine.lags[:] = size
        gradient_step(machine, 1.5 - predict_error(machine), 0.3, 0.0)
        assert predict_error(machine) == pytest.approx(0.45, rel=1e-10)


def test_rls_is_the_anchored_weighted_least_squares_fit():
    generator = np.random.default_rng(8)
    machine, rls = _machine(), make_rls_state(12)
    root = generator.standard_normal((12, 12))
    rls.prior[:] = root @ root.T + np.eye(12)
    rls.anchor[:] = generator.standard_normal(12)
    machine.output_weights[:] = rls.anchor
    rls.power[:] = (1.0, 2.0, 0.0)
    keep, rows, targets, weights = 0.9, [], [], []
    for _ in range(30):
        machine.lags[:] = generator.uniform(-1.0, 1.0, 8)
        error = generator.standard_normal() - predict_error(machine)
        targets.append((error + predict_error(machine)) / 3.0)
        rows.append(machine.mu1.copy())
        assert rls_step(machine, rls, error, keep, 0.95)
        weights.append(rls.power[1] / rls.power[0])
    share = np.array(weights) * keep ** np.arange(29, -1, -1)
    rows = np.array(rows)
    square = rows.T @ (share[:, None] * rows) + rls.prior
    right = rows.T @ (share * np.array(targets)) + rls.prior @ rls.anchor
    np.testing.assert_allclose(machine.output_weights, np.linalg.solve(square, right), rtol=1e-8)


def test_rls_returns_to_the_pretraining_without_excitation():
    """Forgetting without a prior keeps the last weights, and its gain increases to a burst."""
    machine, rls = _machine(), make_rls_state(12)
    rls.anchor[:] = 0.5
    machine.output_weights[:] = -2.0
    rls.power[:] = (1.0, 1.0, 1e-3)
    machine.lags[:] = 0.0
    for _ in range(2000):
        predict_error(machine)
        rls_step(machine, rls, 0.0, 0.99, 0.95)
    np.testing.assert_allclose(machine.output_weights, 0.5, atol=1e-6)
    assert np.max(rls.information) < 1e-6


@pytest.mark.compiled
def test_rls_adapts_faster_than_any_gradient_rate():
    """Lags of one slow signal are nearly parallel, which a scalar gamma cannot handle."""
    before = _excited(np.random.default_rng(9))
    other = NominalLoopParameters(feedback_gain=3.0, lag=0.1)
    after = _excited(np.random.default_rng(9), loop=other)

    def missed(rule):
        machine, rls = _machine(), make_rls_state(12)
        pretrain(machine, rls, *before, EXCITATION, 20.0, 0.05)
        total = 0.0
        for i, error in enumerate(_missed(machine, *after, range(999, -1, -1))):
            total += error * error if i < 500 else 0.0
            rule(machine, rls, error)
        return total

    best = min(
        missed(lambda m, _, e, r=rate: gradient_step(m, e, r, 0.01)) for rate in (0.03, 0.1, 0.3)
    )
    recalled = missed(lambda m, rls, e: rls_step(m, rls, e, 0.9975, 0.95))
    assert recalled < 0.75 * best
    assert recalled < 0.2 * missed(lambda *_: None)


def test_ridge_solves_its_normal_equations():
    generator = np.random.default_rng(10)
    features, targets = generator.standard_normal((50, 6)), generator.standard_normal(50)
    free = ridge_regression(features, targets, 1e-12)
    np.testing.assert_allclose(features.T @ (features @ free - targets), 0.0, atol=1e-9)
    sizes = [
        np.linalg.norm(ridge_regression(features, targets, p)) for p in (1e-12, 0.1, 1.0, 10.0)
    ]
    assert sizes == sorted(sizes, reverse=True)
    parallel = np.repeat(features[:, :1], 6, axis=1)
    assert np.isfinite(ridge_regression(parallel, targets, 1e-6)).all()


@pytest.mark.parametrize('duration', [0.0, 0.01, 0.4])
def test_transition_is_the_matrix_exponential(duration):
    loop = NominalLoopParameters(feedback_gain=8.0, lag=0.02)
    rates = np.zeros((5, 5))
    rates[0] = (-8.0, 1.0, 0.0, 1.0, -8.0)
    rates[1] = (0.0, -50.0, 50.0, 0.0, 0.0)
    expected = expm(rates * duration)[:2]
    np.testing.assert_allclose(
        nominal_transition(loop, duration), expected, rtol=1e-11, atol=1e-14
    )


@pytest.mark.parametrize('dead_time', [0.0, 0.037, 0.12])
def test_nominal_step_is_analytic_for_any_dead_time(dead_time):
    gain, lag = 8.0, 0.02
    loop = NominalLoopParameters(gain, lag, dead_time)
    t = np.maximum(0.05 * np.arange(1, 9) - dead_time, 0.0)
    expected = 1.0 - (np.exp(-gain * t) - gain * lag * np.exp(-t / lag)) / (1.0 - gain * lag)
    np.testing.assert_allclose(
        nominal_step_response(loop, SampleTiming(0.01, 5, 1), 8),
        expected / gain,
        rtol=1e-9,
        atol=1e-15,
    )


def test_samples_are_the_mean_of_the_newest_measurements():
    fine = nominal_step_response(NominalLoopParameters(), SampleTiming(0.01, 1, 1), 40)
    coarse = nominal_step_response(NominalLoopParameters(), SampleTiming(0.01, 5, 3), 8)
    expected = [fine[5 * j - 3 : 5 * j].mean() for j in range(1, 9)]
    np.testing.assert_allclose(coarse, expected, rtol=1e-9)


def test_simulated_run_is_reproducible_and_nominal_at_rest():
    first, again = (_excited(np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first[0], again[0])
    quiet = ExcitationParameters(disturbance=0.0, noise=0.0, move_hold=3.0)
    errors, moves = _excited(np.random.default_rng(2), quiet)
    assert np.max(np.abs(moves)) <= 10.0
    assert 3000.0 / np.count_nonzero(np.diff(moves)) == pytest.approx(40.0, rel=0.5)
    held = np.array([np.ptp(moves[i + 1 : i + 41]) == 0.0 for i in range(moves.size - 41)])
    assert np.count_nonzero(held) > 100
    np.testing.assert_allclose(
        errors[: held.size][held], moves[1 : held.size + 1][held] / 8.0, atol=1e-5
    )


def test_invalid_runs_are_rejected():
    machine, rls = _machine(), make_rls_state(12)
    with pytest.raises(ValueError, match='one length'):
        pretrain(machine, rls, np.zeros(50), np.zeros(40), ExcitationParameters(), 1.0, 0.1)
    with pytest.raises(ValueError, match='must hold more'):
        pretrain(machine, rls, np.zeros(16), np.zeros(16), ExcitationParameters(), 1.0, 0.1)
    with pytest.raises(ValueError, match='finite'):
        pretrain(machine, rls, np.full(50, np.nan), np.zeros(50), ExcitationParameters(), 1.0, 0.1)


# -- passes, energy and distribution -------------------------------------------------------------


SMALL = LayerSizes(3, 2, 7)


def test_sigmoid_is_the_printed_fraction_without_overflow():
    for y in (-30.0, -2.0, -1e-9, 0.0, 0.3, 5.0, 30.0):
        printed = (1.0 - np.exp(-y)) / (1.0 + np.exp(-y))
        assert bipolar_sigmoid(y) == pytest.approx(printed, rel=1e-7, abs=1e-15)
    assert bipolar_sigmoid(-1e6) == -1.0
    assert bipolar_sigmoid(1e6) == 1.0


def test_passes_run_in_the_order_39_38_37_36():
    machine = _machine(shape=SMALL)
    generator = np.random.default_rng(1)
    machine.output_weights[:] = generator.standard_normal(7)
    machine.lags[:] = generator.uniform(-1.0, 1.0, 5)
    weights = machine.visible_weights
    mu0 = np.tanh(0.5 * weights.T @ machine.lags)
    eta1 = np.tanh(0.5 * weights @ mu0)
    mu1 = np.tanh(0.5 * weights.T @ eta1)
    assert predict_error(machine) == pytest.approx(3.0 * machine.output_weights @ mu1, rel=1e-13)
    np.testing.assert_allclose(machine.mu0, mu0, rtol=1e-13)
    np.testing.assert_allclose(machine.eta1, eta1, rtol=1e-13)
    np.testing.assert_allclose(machine.mu1, mu1, rtol=1e-13)


def test_visible_vector_contains_scaled_lags():
    machine = _machine(shape=SMALL)
    errors, moves = np.arange(1.0, 7.0), 10.0 * np.arange(1.0, 7.0)
    set_visible(machine, errors, moves, 1)
    np.testing.assert_allclose(machine.lags, [2 / 3, 3 / 3, 4 / 3, 20 / 20, 30 / 20])


def test_huge_inputs_are_limited_and_predictions_finite():
    machine = _machine(shape=SMALL)
    machine.output_weights[:] = 1.0
    set_visible(machine, np.array([1e300, -1e300, 0.0]), np.array([1e308, -1e308]), 0)
    assert np.max(np.abs(machine.lags)) == 10.0
    assert np.isfinite(predict_error(machine))


def test_initial_weights_have_orthogonal_rows():
    """With independent random weights the condition number is raised to the third power."""
    for spread in (0.3, 1.0, 2.0):
        weights = _machine(shape=SMALL, spread=spread).visible_weights
        np.testing.assert_allclose(weights @ weights.T, spread**2 * np.eye(5), atol=1e-13)


def test_sigmoid_is_the_mean_of_a_hidden_unit():
    """E9: only at temperature 2 the passes (37), (39) are means of the distribution (41)."""
    machine = _machine(shape=LayerSizes(2, 2, 4), spread=1.5)
    for eta in _states(4):
        states = _states(4)
        energies = np.array([energy(machine.visible_weights, eta, mu) for mu in states])
        probability = boltzmann_distribution(energies)
        assert probability.sum() == pytest.approx(1.0, abs=1e-14)
        mean = probability @ np.array(states)
        machine.lags[:] = eta
        predict_error(machine)
        np.testing.assert_allclose(machine.mu0, mean, atol=1e-13)


def test_probability_ratios_follow_boltzmann_for_any_energy():
    """E9: the printed J' = delta^E / E is not even positive."""
    probability = boltzmann_distribution(np.array([1.0, 3.0, -2.0]))
    assert probability[0] / probability[1] == pytest.approx(np.exp(1.0), rel=1e-13)
    np.testing.assert_array_equal(boltzmann_distribution(np.array([-1e5, 1e5])), [1.0, 0.0])


def test_free_energy_sums_over_every_hidden_state():
    machine = _machine(shape=LayerSizes(2, 2, 5), spread=1.7)
    eta = np.array([0.3, -0.9, 1.0, 0.1])
    mu = np.linspace(-1.0, 1.0, 5)
    assert energy(machine.visible_weights, eta, mu) == pytest.approx(
        -eta @ machine.visible_weights @ mu, rel=1e-13
    )
    energies = np.array([energy(machine.visible_weights, eta, mu) for mu in _states(5)])
    assert free_energy(machine.visible_weights, eta) == pytest.approx(
        -np.log(np.sum(np.exp(-0.5 * energies))), rel=1e-13
    )
