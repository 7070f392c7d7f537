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
"""Tables of fuzzy sets: values, special cases, validation."""

from functools import partial

import numpy as np
import pytest

from t3mpc_ros.fuzzy.inference import (
    LOWER,
    MAX_COEFFICIENTS,
    UPPER,
    FuzzyParameters,
    FuzzySets,
    build_sets,
    slice_levels,
    type3_widths,
)
from t3mpc_ros.parameters.table import ParameterError

Sets = partial(FuzzyParameters, sets=3, centre_exponent=1.0)


@pytest.mark.parametrize('slices', [1, 2, 4, 7])
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


def test_type3_footprint_decreases_with_the_level_to_zero():
    footprint = np.diff(type3_widths(1.0, slice_levels(6)), axis=-1).ravel()
    assert np.all(np.diff(footprint) < 0.0)
    assert footprint[-1] == 0.0


def test_default_sets_cross_at_one_half():
    parameters = Sets()
    half_spacing = 0.5 * (parameters.centre_high - parameters.centre_low) / (parameters.sets - 1)
    assert np.exp(-((half_spacing / parameters.widths[0]) ** 2)) == pytest.approx(0.5, abs=0.002)


def test_default_interval_footprint_is_the_type3_mean():
    levels = slice_levels(Sets().slices)
    half = 0.5 * np.diff(type3_widths(1.0, levels), axis=-1)[..., 0]
    mean = float(np.sum(levels * half) / np.sum(levels))
    assert Sets().footprint_of_uncertainty == pytest.approx(mean, abs=0.005)


def test_input_fuzziness_matches_the_noise_variance_0_04():
    """The Gaussians have no 1/2 in the exponent: beta is sqrt(2) standard deviations."""
    assert Sets().input_fuzziness == pytest.approx(np.sqrt(2.0 * 0.04), abs=0.001)


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


def test_interval_type2_without_footprint_is_type1():
    interval = build_sets(Sets(kind='interval_type2', footprint_of_uncertainty=0.0))
    np.testing.assert_array_equal(interval.widths, build_sets(Sets(kind='type1')).widths)


@pytest.mark.parametrize('inputs', [1, 2, 3])
def test_tables_have_the_stated_shapes_for_any_number_of_inputs(inputs):
    sets = build_sets(Sets(sets=4, slices=5), inputs)
    assert sets.centres.shape == (inputs, 4)
    assert sets.widths.shape == (inputs, 4, 5, 2, 2)
    assert sets.levels.shape == (5, 2)
    assert (sets.inputs, sets.rules, sets.slices) == (inputs, 4**inputs, 5)
    assert sets.size == 2 * 4**inputs * 5


def test_a_single_set_is_in_the_middle_of_the_range():
    sets = build_sets(Sets(sets=1, centre_low=-2.0, centre_high=6.0))
    np.testing.assert_array_equal(sets.centres, [[2.0], [2.0]])


def test_shares_add_up_to_one_e8():
    assert build_sets(Sets(slices=7)).shares.sum() == pytest.approx(1.0, abs=1e-15)


def test_tables_are_read_only_and_do_not_alias_their_source():
    sets = build_sets(Sets())
    with pytest.raises(ValueError, match='read-only'):
        sets.centres[0, 0] = 1.0
    centres = np.array(sets.centres)
    other = FuzzySets(centres, sets.widths, sets.levels, 0.1)
    centres[:] = np.nan
    assert np.isfinite(other.centres).all()


@pytest.mark.parametrize(
    'change, message',
    [
        ({'centres': np.zeros(3)}, 'centres must have shape'),
        ({'centres': np.array([[0.0, np.nan], [0.0, 1.0]])}, 'centres must be finite'),
        ({'levels': np.ones((1, 3))}, 'levels must have shape'),
        ({'levels': np.array([[0.0, 1.0]])}, '0 < lower'),
        ({'levels': np.array([[0.8, 0.4]])}, 'lower <= upper'),
        ({'levels': np.array([[0.5, 1.1]])}, 'upper <= 1'),
        ({'levels': np.array([[np.nan, 1.0]])}, '0 < lower'),
        ({'widths': np.ones((2, 2, 1, 2))}, 'widths must have shape'),
        ({'widths': np.zeros((2, 2, 1, 2, 2))}, 'widths must be positive'),
        ({'widths': np.full((2, 2, 1, 2, 2), np.inf)}, 'widths must be positive and finite'),
        ({'widths': np.ones((2, 2, 1, 2, 2)) * np.array([2.0, 1.0])}, 'larger below than above'),
        ({'input_fuzziness': -0.1}, 'input_fuzziness must be'),
        ({'input_fuzziness': np.nan}, 'input_fuzziness must be'),
    ],
)
def test_tables_out_of_range_are_rejected_by_name(change, message):
    tables = {
        'centres': np.array([[0.0, 1.0], [0.0, 1.0]]),
        'widths': np.ones((2, 2, 1, 2, 2)),
        'levels': np.array([[0.5, 1.0]]),
        'input_fuzziness': 0.1,
    }
    FuzzySets(**tables)
    with pytest.raises(ValueError, match=message):
        FuzzySets(**{**tables, **change})


def test_invalid_parameters_are_rejected():
    with pytest.raises(ParameterError, match='centre_high must be above centre_low'):
        Sets(centre_low=1.0, centre_high=1.0)
    with pytest.raises(ParameterError, match='kind must be one of'):
        Sets(kind='type4')
    with pytest.raises(ValueError, match='inputs must be at least 1: got 0'):
        build_sets(Sets(), 0)
    with pytest.raises(ValueError, match=f'at most {MAX_COEFFICIENTS}'):
        build_sets(Sets(), 40)
