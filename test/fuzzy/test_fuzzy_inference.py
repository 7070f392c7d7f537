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
"""Inference (16)-(33) with E7 and E8: hull, special cases, limits."""

from functools import partial
import itertools
import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp
from support.equations import memberships, output_by_double_sum

from t3mpc_ros.fuzzy.inference import (
    LOWER,
    MAX_COEFFICIENTS,
    UPPER,
    FuzzyParameters,
    FuzzySets,
    build_sets,
    compute_basis,
    firing_strengths,
    fuzzify,
    slice_levels,
    type3_widths,
)
from t3mpc_ros.parameters.table import ParameterError

Sets = partial(FuzzyParameters, sets=3, centre_exponent=1.0)

KINDS = ('type3', 'interval_type2', 'type1')
FAR = [40.0, -80.0, 1e3, 1e9, -1e12, -1.7e308]


def _random_sets(rng, inputs=2, sets=3, slices=4):
    """Return tables without symmetry, which would hide an error in an index."""
    lower = rng.uniform(0.5, 4.0, (inputs, sets, slices, 2))
    upper = lower + rng.uniform(0.0, 3.0, lower.shape)
    return FuzzySets(
        centres=np.sort(rng.uniform(-10.0, 10.0, (inputs, sets)), axis=1),
        widths=np.stack([lower, upper], axis=-1),
        levels=np.sort(rng.uniform(0.05, 1.0, (slices, 2)), axis=1),
        input_fuzziness=float(rng.uniform(0.1, 2.0)),
    )


def _log_firings(u, sets):
    """Return logarithms of (24)-(27), shape (r, lambda, 2, 2), by array operations."""
    square, own = sets.widths**2, sets.input_fuzziness**2
    o = sets.centres[:, :, None, None, None]
    x = (np.asarray(u)[:, None, None, None, None] * square + o * own) / (square + own)
    logs = -((x - o) ** 2) / square
    n, per_input = sets.centres.shape
    rules = itertools.product(range(per_input), repeat=n)
    return np.array([sum(logs[i, h] for i, h in enumerate(rule)) for rule in rules])


def _reference_basis(u, sets):
    """Return (33) with E8 by logarithms, valid at any distance."""
    logs = _log_firings(u, sets)
    both = logsumexp(logs, axis=-1)  # r, lambda, level
    part = np.exp(both - logsumexp(both, axis=0)) * sets.levels / sets.levels.sum()
    return np.concatenate([part[:, :, 0].ravel(), part[:, :, 1].ravel()])


@pytest.mark.parametrize('kind', KINDS)
def test_output_lies_in_the_hull_of_the_coefficients(kind):
    rng = np.random.default_rng(1)
    sets = build_sets(Sets(kind=kind))
    near = rng.uniform(-15.0, 15.0, (50, 2))
    far = np.array(list(itertools.product([0.3, *FAR], repeat=2)))
    for u in np.concatenate([near, far]):
        phi = compute_basis(u, sets)
        assert np.all(phi >= 0.0)
        assert phi.sum() == pytest.approx(1.0, abs=1e-13)
        alpha = rng.normal(scale=100.0, size=(20, sets.size))
        g = alpha @ phi
        slack = 1e-12 * np.abs(alpha).max()
        assert np.all(g >= alpha.min(axis=1) - slack)
        assert np.all(g <= alpha.max(axis=1) + slack)


@pytest.mark.parametrize('inputs, per_input, slices', [(1, 5, 3), (2, 3, 4), (3, 2, 2)])
def test_the_double_sum_29_equals_31_to_33(inputs, per_input, slices):
    rng = np.random.default_rng(2)
    for _ in range(10):
        sets = _random_sets(rng, inputs, per_input, slices)
        lower, upper = rng.normal(size=(2, sets.rules, slices))
        alpha = np.concatenate([lower.ravel(), upper.ravel()])  # the order of (32)
        u = rng.uniform(-12.0, 12.0, inputs)
        expected = output_by_double_sum(u, sets, lower, upper)
        assert alpha @ compute_basis(u, sets) == pytest.approx(expected, rel=1e-11, abs=1e-13)


@pytest.mark.parametrize('inputs, per_input, slices', [(2, 3, 4), (4, 2, 1)])
def test_kernel_equals_whole_array_reference(inputs, per_input, slices):
    rng = np.random.default_rng(3)
    for _ in range(20):
        sets = _random_sets(rng, inputs, per_input, slices)
        u = rng.uniform(-15.0, 15.0, inputs)
        np.testing.assert_allclose(
            compute_basis(u, sets), _reference_basis(u, sets), rtol=1e-11, atol=1e-300
        )


def test_interval_type2_is_a_nie_tan_system():
    """Nie-Tan: the mean of upper and lower firing is the weight of the rule's constant."""
    parameters = Sets(kind='interval_type2', footprint_of_uncertainty=0.4, input_fuzziness=0.0)
    sets = build_sets(parameters)
    rng = np.random.default_rng(6)
    constants = rng.normal(size=9)
    centres = np.array([-10.0, 0.0, 10.0])
    sigma = parameters.widths[0]
    for u in rng.uniform(-14.0, 14.0, (50, 2)):
        upper = np.exp(-(((u[:, None] - centres) / (1.4 * sigma)) ** 2))
        lower = np.exp(-(((u[:, None] - centres) / (0.6 * sigma)) ** 2))
        weights = 0.5 * (np.outer(*upper) + np.outer(*lower)).ravel()
        nie_tan = weights @ constants / weights.sum()
        assert np.tile(constants, 2) @ compute_basis(u, sets) == pytest.approx(nie_tan, rel=1e-12)


def test_type3_of_one_slice_at_level_one_is_type1():
    parameters = Sets()
    type1 = build_sets(Sets(kind='type1'))
    rng = np.random.default_rng(7)
    points = rng.uniform(-14.0, 14.0, (20, 2))

    def at(level):
        levels = np.array([[level, 1.0]])
        widths = np.broadcast_to(type3_widths(parameters.widths[0], levels), (2, 3, 1, 2, 2))
        return FuzzySets(type1.centres, widths, levels, parameters.input_fuzziness)

    gaps = []
    for level in (1.0, 1.0 - 1e-3, 1.0 - 5e-4):
        sets = at(level)
        gaps.append(
            max(np.abs(compute_basis(u, sets) - compute_basis(u, type1)).max() for u in points)
        )
    assert gaps[0] == 0.0
    assert gaps[1] == pytest.approx(2.0 * gaps[2], rel=0.02)  # linear convergence


def test_fuzzification_maximises_the_product_of_input_and_set():
    """(16)-(19) maximise the product of the two Gaussians for any widths."""
    rng = np.random.default_rng(9)
    sets = _random_sets(rng, slices=2)
    u = np.array([2.0, -3.0])
    found = np.empty(sets.widths.shape)
    fuzzify(u, sets.centres, sets.nonsingleton_gain, found)
    for i, h, j, level, bound in np.ndindex(found.shape):
        o, beta = sets.centres[i, h], sets.widths[i, h, j, level, bound]

        def minus_log_product(x, u=u[i], o=o, beta=beta):
            return ((x - u) / sets.input_fuzziness) ** 2 + ((x - o) / beta) ** 2

        best = minimize_scalar(
            minus_log_product, bounds=(-30.0, 30.0), method='bounded', options={'xatol': 1e-10}
        )
        x = found[i, h, j, level, bound]
        assert x == pytest.approx(best.x, abs=1e-5)
        assert minus_log_product(x) <= best.fun + 1e-12
        # The maximum in closed form is an upper bound.
        height = (u[i] - o) ** 2 / (beta**2 + sets.input_fuzziness**2)
        assert minus_log_product(x) == pytest.approx(height, rel=1e-12)


def test_e7_grades_are_even_about_the_centre_and_at_most_one():
    """The printed exponent of (20)-(23) is linear: its "grade" exceeds one below the centre."""
    sets = _random_sets(np.random.default_rng(10))
    right, left = np.empty(sets.widths.shape), np.empty(sets.widths.shape)
    for offset in (0.0, 0.7, 5.0):
        for h in range(3):
            u = sets.centres[:, h]
            memberships(u + offset, sets.centres, sets.nonsingleton_gain, 1.0 / sets.widths, right)
            memberships(u - offset, sets.centres, sets.nonsingleton_gain, 1.0 / sets.widths, left)
            np.testing.assert_allclose(right[:, h], left[:, h], rtol=1e-11)
            assert right.max() <= 1.0
            assert left.max() <= 1.0
    found = np.empty(sets.widths.shape)
    fuzzify(sets.centres[:, 0] - 5.0, sets.centres, sets.nonsingleton_gain, found)
    printed = np.exp(-(found - sets.centres[:, :, None, None, None]) / sets.widths**2)
    assert printed.max() > 1.0


def test_e8_printed_normalisation_leaves_the_hull():
    """With 0.5 / (sum of upper levels) a constant 1 on every rule gives 0.9."""
    sets = build_sets(Sets())
    phi = compute_basis(np.array([1.0, 2.0]), sets)
    printed = phi * sets.levels.sum() * 0.5 / sets.levels[:, 1].sum()
    assert np.ones(sets.size) @ phi == pytest.approx(1.0, abs=1e-14)
    assert np.ones(sets.size) @ printed == pytest.approx(0.9, abs=1e-14)


def test_memberships_and_firings_are_the_printed_products():
    sets = _random_sets(np.random.default_rng(11), inputs=3)
    u = np.array([1.0, -2.0, 4.0])
    grades = np.empty(sets.widths.shape)
    firings = np.empty((27, 4, 2, 2))
    memberships(u, sets.centres, sets.nonsingleton_gain, 1.0 / sets.widths, grades)
    firing_strengths(grades, firings)
    for rule, (h1, h2, h3) in enumerate(itertools.product(range(3), repeat=3)):
        np.testing.assert_allclose(
            firings[rule], grades[0, h1] * grades[1, h2] * grades[2, h3], rtol=1e-14
        )
    np.testing.assert_allclose(firings, np.exp(_log_firings(u, sets)), rtol=1e-11)


def test_the_basis_is_exact_where_firing_strengths_underflow():
    """All firing strengths underflow and (33) is 0/0; the reference uses logarithms."""
    sets = build_sets(Sets())
    for u in ([80.0, -90.0], [-300.0, 2.0], [1e4, 1e4]):
        at_lowest_width = np.exp(_log_firings(u, sets))[..., 0, 0, 0]
        assert at_lowest_width.max() == 0.0
        np.testing.assert_allclose(
            compute_basis(np.array(u), sets), _reference_basis(u, sets), rtol=1e-6, atol=1e-300
        )


def test_a_single_firing_rule_28_gives_its_consequents():
    """'If chi_1 is ... and chi_2 is ... then y in [lower alpha, upper alpha]', rule by rule.

    At the centres of narrow sets one rule fires and the others do not. With one slice its two
    consequents are weighed by the two levels.
    """
    rng = np.random.default_rng(13)
    levels = np.array([[0.3, 0.9]])
    centres = np.array([[-6.0, 1.0, 8.0], [-9.0, -2.0, 5.0]])
    sets = FuzzySets(centres, np.full((2, 3, 1, 2, 2), 0.5), levels, 0.1)
    lower, upper = np.sort(rng.uniform(-5.0, 5.0, (2, 9)), axis=0)
    for rule, u in enumerate(itertools.product(*centres)):
        y = np.concatenate([lower, upper]) @ compute_basis(np.array(u), sets)
        assert lower[rule] < y < upper[rule]
        assert y == pytest.approx((0.3 * lower[rule] + 0.9 * upper[rule]) / 1.2, rel=1e-12)


@pytest.mark.parametrize('distance', FAR[2:])
def test_far_outside_only_the_nearest_rule_counts(distance):
    sets = build_sets(Sets())
    phi = compute_basis(np.array([distance, distance]), sets).reshape(2, 9, 4)
    nearest = 8 if distance > 0.0 else 0
    np.testing.assert_allclose(phi[:, nearest].T, sets.shares, rtol=1e-12)


def test_non_finite_inputs_are_rejected():
    sets = build_sets(Sets())
    for wrong in ([0.0], [0.0, math.nan], [math.inf, 0.0], [0.0, 0.0, 0.0]):
        with pytest.raises(ValueError, match='inputs must be 2 finite numbers'):
            compute_basis(np.array(wrong), sets)


# -- tables of the sets ---------------------------------------------------------------------------


@pytest.mark.parametrize('slices', [1, 7])
def test_slice_levels_lie_in_order_between_zero_and_one(slices):
    levels = slice_levels(slices)
    assert levels.shape == (slices, 2)
    assert np.all(levels > 0.0)
    assert levels.max() == 1.0
    assert np.all(np.diff(levels.ravel()) > 0.0)  # lower_1 < upper_1 < lower_2 < ...


def test_type3_widths_are_powers_of_the_grade():
    x = np.linspace(-4.0, 4.0, 41)
    grade = np.exp(-((x / 1.7) ** 2))
    levels = slice_levels(3)
    widths = type3_widths(1.7, levels)
    for place in np.ndindex(levels.shape):
        upper = np.exp(-((x / widths[(*place, UPPER)]) ** 2))
        lower = np.exp(-((x / widths[(*place, LOWER)]) ** 2))
        np.testing.assert_allclose(upper, grade ** levels[place], rtol=1e-12)
        np.testing.assert_allclose(lower, grade ** (1.0 / levels[place]), rtol=1e-12)


def test_defaults_are_derived():
    """Sets cross at one half, the footprint is the mean of the type-3 ones, the fuzziness noise.

    The Gaussians have no 1/2 in the exponent: beta is sqrt(2) standard deviations.
    """
    parameters = Sets()
    assert parameters.input_fuzziness == pytest.approx(np.sqrt(2.0 * 0.04), abs=0.001)
    levels = slice_levels(parameters.slices)
    half = 0.5 * np.diff(type3_widths(1.0, levels), axis=-1)[..., 0]
    mean = float(np.sum(levels * half) / np.sum(levels))
    assert parameters.footprint_of_uncertainty == pytest.approx(mean, abs=0.005)
    half_spacing = 0.5 * (parameters.centre_high - parameters.centre_low) / (parameters.sets - 1)
    assert np.exp(-((half_spacing / parameters.widths[0]) ** 2)) == pytest.approx(0.5, abs=0.002)


def test_kinds_differ_only_in_the_numbers_of_the_tables():
    tables = {kind: build_sets(Sets(kind=kind)) for kind in ('type3', 'interval_type2', 'type1')}
    for sets in tables.values():
        np.testing.assert_array_equal(sets.centres, tables['type3'].centres)
        assert sets.input_fuzziness == tables['type3'].input_fuzziness
    assert tables['type3'].size == 2 * 9 * 4
    assert tables['type1'].size == tables['interval_type2'].size == 2 * 9
    np.testing.assert_array_equal(
        tables['type1'].widths[..., LOWER], tables['type1'].widths[..., UPPER]
    )
    widths, sigma = tables['interval_type2'].widths, Sets().widths[0]
    np.testing.assert_allclose(widths[..., LOWER], 0.77 * sigma)
    np.testing.assert_allclose(widths[..., UPPER], 1.23 * sigma)


@pytest.mark.parametrize('inputs', [1, 3])
def test_tables_have_the_stated_shapes_for_any_number_of_inputs(inputs):
    sets = build_sets(Sets(sets=4, slices=5), inputs)
    assert sets.centres.shape == (inputs, 4)
    assert sets.widths.shape == (inputs, 4, 5, 2, 2)
    assert sets.levels.shape == (5, 2)
    assert (sets.rules, sets.slices) == (4**inputs, 5)
    assert sets.shares.sum() == pytest.approx(1.0, abs=1e-15)  # E8
    one = build_sets(Sets(sets=1, centre_low=-2.0, centre_high=6.0), inputs)
    np.testing.assert_array_equal(one.centres, [[2.0]] * inputs)
    assert sets.size == 2 * 4**inputs * 5


def test_invalid_parameters_are_rejected():
    with pytest.raises(ParameterError, match='centre_high must be above centre_low'):
        Sets(centre_low=1.0, centre_high=1.0)
    with pytest.raises(ParameterError, match='kind must be one of'):
        Sets(kind='type4')
    with pytest.raises(ValueError, match='inputs must be at least 1: got 0'):
        build_sets(Sets(), 0)
    with pytest.raises(ValueError, match=f'at most {MAX_COEFFICIENTS}'):
        build_sets(Sets(), 40)
