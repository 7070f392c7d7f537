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
"""Figures of a patrol against theory: coverage, entropies, exponents, skill, baseline paths."""

import math

import numpy as np
import pytest

from t3mpc_ros.evaluation.patrol.baseline_paths import BASELINE_PATHS, LANES, Rectangle
from t3mpc_ros.evaluation.patrol.patrol_metrics import (
    HORIZONS,
    CoverageGrid,
    coverage_at,
    delay_vectors,
    divergence,
    evenness,
    ordinal_shares,
    patrol_metrics,
    permutation_entropy,
    predictability,
    spectral_entropy,
    time_to_cover,
    visits,
)

AREA = Rectangle((-1.8, -1.3), (1.8, 1.3))


def _logistic_map(count):
    series = np.empty(count)
    series[0] = 0.3
    for k in range(count - 1):
        series[k + 1] = 4.0 * series[k] * (1.0 - series[k])
    return series


def _runge_kutta(rate, state, step, count, substeps):
    rows = np.empty((count, len(state)))
    h = step / substeps
    for row in rows:
        row[:] = state
        for _ in range(substeps):
            a = rate(state)
            b = rate(state + 0.5 * h * a)
            c = rate(state + 0.5 * h * b)
            d = rate(state + h * c)
            state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return rows


def _lorenz_rate(s):
    return np.array(
        [10.0 * (s[1] - s[0]), 28.0 * s[0] - s[1] - s[0] * s[2], s[0] * s[1] - 8.0 / 3.0 * s[2]]
    )


# -- coverage -------------------------------------------------------------------------------------


def test_a_straight_line_enters_one_cell_after_the_other():
    grid = CoverageGrid((0.0, 0.0), (4.0, 2.0), columns=8, rows=4)
    t = np.array([5.0, 13.0])  # 0.5 m/s, one cell a second
    found = visits(t, np.array([0.0, 4.0]), np.array([0.6, 0.6]), grid)
    assert found.first[1] == pytest.approx(np.arange(8.0))
    assert found.dwell[1] == pytest.approx(1.0)
    assert np.isinf(np.delete(found.first, 1, axis=0)).all()
    assert coverage_at(found, grid, np.array([0.0, 3.5, 100.0])) == pytest.approx(
        [1 / 32, 4 / 32, 8 / 32]
    )
    assert time_to_cover(found, grid, 0.25) == pytest.approx(7.0)
    assert time_to_cover(found, grid, 0.3) == math.inf


def test_blocked_cells_and_time_outside_do_not_count():
    blocked = np.zeros((1, 4), dtype=bool)
    blocked[0, 1] = True
    grid = CoverageGrid((0.0, 0.0), (4.0, 1.0), columns=4, rows=1, blocked=blocked)
    found = visits(np.array([0.0, 6.0]), np.array([-1.0, 5.0]), np.array([0.5, 0.5]), grid)
    assert found.dwell.tolist() == [[1.0, 0.0, 1.0, 1.0]]
    assert coverage_at(found, grid, np.array([6.0])) == 1.0
    assert evenness(found, grid) == pytest.approx(1.0)


def test_evenness_is_the_entropy_of_the_shares_of_time():
    grid = CoverageGrid((0.0, 0.0), (16.0, 1.0), columns=16, rows=1)
    stand = visits(np.array([0.0, 1.0]), np.array([0.5, 0.5]), np.array([0.5, 0.5]), grid)
    assert evenness(stand, grid) == 0.0
    half = visits(np.array([0.0, 1.0]), np.array([0.0, 8.0]), np.array([0.5, 0.5]), grid)
    assert evenness(half, grid) == pytest.approx(math.log(8.0) / math.log(16.0))
    absent = visits(np.array([0.0, 1.0]), np.array([20.0, 21.0]), np.array([0.5, 0.5]), grid)
    assert math.isnan(evenness(absent, grid))


@pytest.mark.parametrize(
    't, x, message',
    [
        ([0.0, 1.0, 1.0], [0.0, 0.0, 0.0], 't must increase'),
        ([0.0, 1.0, 2.0], [0.0, math.nan, 0.0], 'must be finite'),
        ([0.0, 1.0], [0.0, 0.0, 0.0], 'must have one shape'),
    ],
)
def test_what_is_no_path_is_rejected(t, x, message):
    grid = CoverageGrid((0.0, 0.0), (1.0, 1.0))
    with pytest.raises(ValueError, match=message):
        visits(np.array(t), np.array(x), np.array(x), grid)


# -- entropies ------------------------------------------------------------------------------------


def test_patterns_of_the_logistic_map_have_their_exact_shares():
    """The map is conjugate to the tent map, which keeps lengths: three in a row never fall."""
    exact = np.array([1 / 3, 1 / 15, 2 / 15, 4 / 15, 1 / 5, 0.0])
    series = _logistic_map(20_000)
    found = ordinal_shares(series, 3)
    assert found == pytest.approx(exact, abs=0.012)
    assert found[5] == 0.0
    entropy = -(exact[:5] * np.log(exact[:5])).sum() / math.log(6.0)
    assert permutation_entropy(series, 3) == pytest.approx(entropy, abs=0.005)


def test_permutation_entropy_of_noise_is_one_and_of_a_ramp_zero():
    noise = np.random.default_rng(1).standard_normal(20_000)
    assert permutation_entropy(noise) == pytest.approx(1.0 - 23 / (4e4 * math.log(24)), abs=5e-4)
    assert permutation_entropy(np.arange(100.0)) == 0.0


def test_spectral_entropy_of_noise_and_of_a_sine_follow_theory():
    generator = np.random.default_rng(2)
    euler = 0.5772156649
    for segments, loss in ((1, 1.0 - euler), (10, 0.0492)):  # psi(K + 1) - ln K
        noise = generator.standard_normal((400, 64 * segments))
        mean = np.mean([spectral_entropy(each) for each in noise])
        assert mean == pytest.approx(1.0 - loss / math.log(32.0), abs=0.008)
    sine = np.sin(2.0 * np.pi * 8.0 * np.arange(640) / 64.0)
    shares = np.array([1 / 6, 4 / 6, 1 / 6])  # the three lines of a Hann window
    exact = -(shares * np.log(shares)).sum() / math.log(32.0)
    assert spectral_entropy(sine) == pytest.approx(exact, abs=1e-6)
    assert math.isnan(spectral_entropy(np.full(64, 3.0)))


# -- exponents ------------------------------------------------------------------------------------


def test_exponents_of_maps_are_those_of_the_literature():
    logistic = _logistic_map(3000)[:, None]
    assert divergence(logistic, 1.0, 1, 20) == pytest.approx(math.log(2.0), rel=0.03)
    henon = np.empty((3000, 2))
    henon[0] = 0.1, 0.1
    for k in range(2999):
        henon[k + 1] = 1.0 - 1.4 * henon[k, 0] ** 2 + henon[k, 1], 0.3 * henon[k, 0]
    points = delay_vectors(henon[:, :1], (0, 1))  # from x alone
    assert divergence(points, 1.0, 1, 40) == pytest.approx(0.419, rel=0.05)


@pytest.mark.slow
def test_exponent_of_the_lorenz_system_from_two_coordinates():
    states = _runge_kutta(_lorenz_rate, np.array([1.0, 1.0, 20.0]), 0.02, 5000, 4)[500:]
    points = delay_vectors(states[:, :2], (0, 10))
    assert divergence(points, 0.02, 50, 250) == pytest.approx(0.906, rel=0.1)


def test_a_quasi_periodic_path_has_no_exponent():
    t = 0.05 * np.arange(4000)
    path = np.column_stack([np.sin(t), np.sin(1.3 * math.sqrt(2.0) * t)])
    assert abs(divergence(delay_vectors(path, (0, 8)), 0.05, 100, 200)) < 0.03


# -- predictability -------------------------------------------------------------------------------


def _best(t, x, y):
    return [each.best for each in predictability(t, x, y)]


def test_a_closed_curve_is_predicted_exactly():
    t = np.arange(0.0, 120.0, 0.1)
    skills = predictability(t, np.cos(t / 3.0), np.sin(2.0 * t / 3.0))
    assert [each.horizon for each in skills] == list(HORIZONS)
    assert min(each.best for each in skills) > 0.999
    assert {each.known for each in skills} == {1.0}


@pytest.mark.slow
def test_skill_of_a_gauss_markov_process_is_its_correlation():
    """The best predictor of a Gauss-Markov process has the skill exp(-2 h / T)."""
    generator = np.random.default_rng(4)
    t = np.arange(0.0, 900.0, 0.25)
    keep = math.exp(-0.25 / 6.0)
    path = np.empty((t.size, 2))
    path[0] = generator.standard_normal(2)
    for k in range(1, t.size):
        path[k] = keep * path[k - 1] + math.sqrt(1.0 - keep**2) * generator.standard_normal(2)
    exact = [math.exp(-2.0 * h / 6.0) for h in HORIZONS]
    skills = predictability(t, *path.T)
    assert [skill.best for skill in skills] == pytest.approx(exact, abs=0.08)
    # Two coordinates of variance 1 each.
    errors = [skill.error for skill in skills]
    assert errors == pytest.approx([math.sqrt(2.0 * (1.0 - each)) for each in exact], rel=0.12)
    # Its error has the distribution of Rayleigh.
    for each in skills:
        assert each.median == pytest.approx(each.error * math.sqrt(math.log(2.0)), rel=0.1)
        assert each.known == pytest.approx(1.0 - math.exp(-((0.25 / each.error) ** 2)), abs=0.02)


def test_a_robot_at_rest_is_predicted_and_a_short_path_refused():
    t = np.arange(0.0, 200.0)
    assert _best(t, np.zeros(200), np.zeros(200)) == [1.0] * 4
    with pytest.raises(ValueError, match='must last at least 60 s'):
        predictability(t[:40], t[:40], t[:40])


# -- paths and all figures together ---------------------------------------------------------------


@pytest.mark.parametrize('name', BASELINE_PATHS)
def test_baseline_paths_stay_inside_and_follow_from_the_seed(name):
    make = BASELINE_PATHS[name]
    path, again, other = (make(AREA, 50.0, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert (path >= np.array(AREA.low) - 1e-9).all()
    assert (path <= np.array(AREA.high) + 1e-9).all()
    assert np.hypot(*np.diff(path, axis=0).T).sum() >= 50.0
    assert np.array_equal(path, again)
    assert path.shape != other.shape or not np.array_equal(path, other)


def test_a_boustrophedon_covers_every_cell_once_and_evenly():
    corners = BASELINE_PATHS['boustrophedon'](AREA, 1.0, np.random.default_rng(0))[: 2 * LANES]
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    grid = CoverageGrid(*AREA)
    found = patrol_metrics(length / 0.4, *corners.T, grid)
    assert found['coverage'] == 1.0
    assert found['distance'] == pytest.approx(LANES * 3.6 + (LANES - 1) * 2.6 / LANES)
    assert found['time_to_90'] == pytest.approx(0.9 * found['duration'], rel=0.02)
    assert found['evenness'] > 0.99


def test_path_error_is_the_distance_from_the_reference():
    t = np.arange(0.0, 10.0)
    reference = np.column_stack([t + 0.3, np.full(10, 0.4)])
    reference[5:] = math.nan
    grid = CoverageGrid((0.0, -1.0), (10.0, 1.0))
    found = patrol_metrics(t, t, np.zeros(10), grid, reference)
    assert found['path_error'] == pytest.approx(0.5)
    assert 'skill_1' not in found
    assert math.isnan(found['exponent'])
