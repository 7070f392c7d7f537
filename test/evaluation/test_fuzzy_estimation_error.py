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
"""Estimation without a controller, (86) with E18: its form, its proof, and what it finds."""

import json

import numpy as np
import pytest
from support.equations import wheel_coriolis

from t3mpc_ros.cli.main import main
from t3mpc_ros.evaluation import fuzzy_estimation_error
from t3mpc_ros.evaluation.confidence_intervals import mean
from t3mpc_ros.evaluation.fuzzy_estimation_error import (
    KINDS,
    NO_FUZZY_SYSTEM,
    OUTPUT_ERROR_GAIN,
    OpenLoopRun,
    compare,
    estimate,
    estimator,
    excitation,
    simulate_open_loop,
    torque_robot,
)
from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator
from t3mpc_ros.fuzzy.inference import FuzzyParameters, compute_basis
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def results():
    return compare(seeds=(1, 2, 3, 4), duration=24.0, variances=(0.0, 0.1))


def _fuzzy(seed=None, **adaptation):
    parameters = {'dead_zone': 0.0, 'radius': 1e4} | adaptation
    fuzzy = FuzzyEstimator(FuzzyParameters(), AdaptationParameters(**parameters))
    if seed is not None:
        shape = fuzzy.coefficients.shape
        fuzzy.coefficients = np.random.default_rng(seed).uniform(-5.0, 5.0, shape)
    return fuzzy


def _matched_run(plant, period, duration=10.0):
    """Plant (30), chi' = g*(chi) + u with g* in the fuzzy family, by Euler steps."""
    steps = round(duration / period)
    push = excitation(period * np.arange(steps), 1)
    speeds = np.zeros((steps, 2))
    for k in range(steps - 1):
        speeds[k + 1] = speeds[k] + period * (plant.evaluate(speeds[k]) + push[k])
    return OpenLoopRun(period, push, speeds, speeds)


def test_a_fuzzy_system_that_is_the_plant_estimates_it_exactly():
    run = _matched_run(_fuzzy(1), 0.01)
    speeds, unknown = estimate(run, _fuzzy(1))
    np.testing.assert_allclose(speeds, run.speeds, atol=1e-11)
    np.testing.assert_allclose(unknown[:-1], run.target, atol=1e-9)


def test_e18_without_u_the_exact_fuzzy_system_misses():
    """(86) prints chi_hat' = g; the same estimator without u is off by u."""
    run = _matched_run(_fuzzy(1), 0.01)
    blind = OpenLoopRun(run.period, np.zeros_like(run.push), run.speeds, run.measured)
    exact = _fuzzy(1, gamma=0.0)
    speeds, _ = estimate(blind, exact, gain=0.0)
    assert np.sqrt(np.mean((speeds - run.speeds) ** 2)) > 1.0


def test_estimator_v_falls_by_the_output_error_spent():
    """The proof of (74)-(79) with chi_hat for r: V(0) - V(T) = a int |chi - chi_hat|² dt.

    Euler steps keep it to first order: the gap halves with the period.
    """
    gaps = []
    for period in (2e-3, 1e-3):
        plant, learner = _fuzzy(1), _fuzzy()
        run = _matched_run(plant, period, 4.0)
        gamma, start = learner.adaptation.gamma, learner.coefficients
        speeds, _ = estimate(run, learner)
        spent = OUTPUT_ERROR_GAIN * period * np.sum((run.speeds - speeds) ** 2)
        before, after = (
            np.sum((plant.coefficients - alpha) ** 2) / (2.0 * gamma)
            for alpha in (start, learner.coefficients)
        )
        last = 0.5 * np.sum((run.speeds[-1] - speeds[-1]) ** 2)
        gaps.append((before - after - last - spent) / spent)
    assert abs(gaps[1]) < 0.05
    assert gaps[0] / gaps[1] == pytest.approx(2.0, rel=0.15)


def test_excitation_is_bounded_seeded_and_zero_mean():
    time = 0.01 * np.arange(60_000)
    push = excitation(time, 3)
    assert np.abs(push).max() <= 10.0 * 2.0 * np.pi * 0.4
    speeds = 0.01 * np.cumsum(push, axis=0)
    assert np.all(np.ptp(speeds, axis=0) <= 20.0)
    assert np.all(speeds.std(axis=0) > 2.5)
    np.testing.assert_array_equal(push, excitation(time, 3))
    assert np.abs(push - excitation(time, 4)).max() > 1.0


def test_target_is_the_friction_and_coriolis_of_the_robot():
    """Without disturbance, chi' - u is theta_bar^-1 (-eta_bar chi - f), (10), (30)."""
    parameters = torque_robot(0.04, 1).with_values({'disturbance.bound': 0.0})
    run = simulate_open_loop(parameters, 20.0, 1)
    body, geometry, friction = parameters.body, parameters.geometry, parameters.friction
    inertia = wheel_inertia(body, geometry)
    middle = 0.5 * (run.speeds[:-1] + run.speeds[1:])
    expected = []
    for chi in middle:
        loss = [
            friction_torque(w, friction.viscous, friction.coulomb, friction.coulomb_width)
            for w in chi.tolist()
        ]
        pull = wheel_coriolis(WheelSpeeds(*chi.tolist()), body, geometry) @ chi
        expected.append(np.linalg.solve(inertia, -pull - np.array(loss)))
    np.testing.assert_allclose(run.target, expected, atol=0.05)
    assert np.std(expected) > 1.0


def test_noise_is_in_the_measurement_only():
    quiet, noisy = (simulate_open_loop(torque_robot(v, 2), 20.0, 2) for v in (0.0, 0.09))
    np.testing.assert_array_equal(quiet.measured, quiet.speeds)
    np.testing.assert_array_equal(quiet.speeds, noisy.speeds)
    assert np.var(noisy.measured - noisy.speeds) == pytest.approx(0.09, rel=0.1)


@pytest.mark.parametrize('kind', KINDS)
def test_every_kind_learns_at_the_same_rate(kind):
    fuzzy = estimator(kind, 0.04, 40.0)
    drawn = np.random.default_rng(1).uniform(-10.0, 10.0, (300, 2))
    power = np.mean([np.sum(compute_basis(point, fuzzy.sets) ** 2) for point in drawn])
    assert fuzzy.adaptation.gamma * power == pytest.approx(40.0, rel=0.05)
    assert fuzzy.sets.input_fuzziness == pytest.approx(np.sqrt(2.0 * 0.04))


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_every_kind_estimates_better_than_none_at_any_noise(results, kind, noise):
    both = [{'kind': each, 'noise_variance': noise} for each in (NO_FUZZY_SYSTEM, kind)]
    more = results.difference('speed', *both)
    assert more.mean - more.half > 0.0
    assert results.difference('unknown', *both).mean > 0.0


def test_kinds_at_equal_rates_differ_by_a_few_percent(results):
    """The paper finds type 3 some 50 % better, and the others alone hurt by noise; we do not."""
    quiet, loud = (
        np.array([mean(results.values('speed', kind=kind, noise_variance=v)) for kind in KINDS])
        for v in (0.0, 0.1)
    )
    for speeds in (quiet, loud):
        assert speeds == pytest.approx(speeds[KINDS.index('type3')], rel=0.1)
    growth = loud / quiet
    assert max(growth) - min(growth) < 0.1


def test_what_cannot_be_driven_is_refused():
    parameters = torque_robot(0.0, 1)
    with pytest.raises(ValueError, match='duration'):
        simulate_open_loop(parameters, 0.01, 1)
    with pytest.raises(ValueError, match='torque'):
        simulate_open_loop(parameters.with_values({'drive.kind': 'velocity'}), 1.0, 1)


def test_the_program_prints_the_table_and_writes_the_numbers(tmp_path, capsys, monkeypatch):
    """The interval of one seed once was infinite, which no reader of JSON accepts."""
    path = tmp_path / 'figures.json'
    assert main(['estimation', '--duration', '10']) == 1
    assert 'duration must be more than 10 s' in capsys.readouterr().err
    monkeypatch.setattr(fuzzy_estimation_error, 'SETTLE', 1.0)
    words = ['estimation', '--duration', '2', '--json', str(path), '--seeds']
    assert main([*words, '1-2']) == 0
    said = capsys.readouterr().out
    for record in json.loads(path.read_text()):
        assert f'{record["speed_mean"]:.4f} ± {record["speed_ci95"]:.4f}' in said
    assert main([*words, '1-1']) == 0
    assert 'inf' not in capsys.readouterr().out
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert {record['speed_ci95'] for record in found} == {None}
