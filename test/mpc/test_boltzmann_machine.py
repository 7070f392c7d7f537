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
"""Boltzmann machine: passes, energy and distribution."""

import itertools

import numpy as np
import pytest
from support.equations import boltzmann_distribution, energy, free_energy

from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    bipolar_sigmoid,
    make_machine,
    predict_error,
    set_visible,
)

SHAPE = LayerSizes(3, 2, 7)


def _machine(seed=0, shape=SHAPE, spread=1.0):
    return make_machine(shape, 3.0, 20.0, spread, np.random.default_rng(seed))


def _states(count):
    return [np.array(state) for state in itertools.product((-1.0, 1.0), repeat=count)]


def test_sigmoid_is_the_printed_fraction_without_overflow():
    for y in (-30.0, -2.0, -1e-9, 0.0, 0.3, 5.0, 30.0):
        printed = (1.0 - np.exp(-y)) / (1.0 + np.exp(-y))
        assert bipolar_sigmoid(y) == pytest.approx(printed, rel=1e-7, abs=1e-15)
    assert bipolar_sigmoid(-1e6) == -1.0
    assert bipolar_sigmoid(1e6) == 1.0


def test_passes_run_in_the_order_39_38_37_36():
    machine = _machine()
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
    machine = _machine()
    errors, moves = np.arange(1.0, 7.0), 10.0 * np.arange(1.0, 7.0)
    set_visible(machine, errors, moves, 1)
    np.testing.assert_allclose(machine.lags, [2 / 3, 3 / 3, 4 / 3, 20 / 20, 30 / 20])


def test_huge_inputs_are_limited_and_predictions_finite():
    machine = _machine()
    machine.output_weights[:] = 1.0
    set_visible(machine, np.array([1e300, -1e300, 0.0]), np.array([1e308, -1e308]), 0)
    assert np.max(np.abs(machine.lags)) == 10.0
    assert np.isfinite(predict_error(machine))


def test_initial_weights_have_orthogonal_rows():
    """With independent random weights the condition number is raised to the third power."""
    for spread in (0.3, 1.0, 2.0):
        weights = _machine(spread=spread).visible_weights
        np.testing.assert_allclose(weights @ weights.T, spread**2 * np.eye(5), atol=1e-13)


def test_small_signals_pass_linearly():
    machine = _machine(spread=0.8)
    generator = np.random.default_rng(2)
    gaps = []
    for size in (0.1, 0.05):
        machine.lags[:] = size * generator.uniform(-1.0, 1.0, 5)
        predict_error(machine)
        weights = machine.visible_weights
        linear = weights.T @ weights @ weights.T @ machine.lags / 8.0
        gaps.append(np.max(np.abs(machine.mu1 - linear)) / np.max(np.abs(linear)))
    assert gaps[0] < 2e-3
    assert gaps[1] < 0.5 * gaps[0]  # the remainder is of second order


def test_invalid_shapes_and_scales_are_rejected():
    generator = np.random.default_rng(0)
    with pytest.raises(ValueError, match='hidden must be at least'):
        make_machine(LayerSizes(3, 3, 5), 1.0, 1.0, 1.0, generator)
    with pytest.raises(ValueError, match='at least one lag'):
        make_machine(LayerSizes(3, 0, 5), 1.0, 1.0, 1.0, generator)
    with pytest.raises(ValueError, match='positive'):
        make_machine(LayerSizes(3, 2, 5), 0.0, 1.0, 1.0, generator)


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
