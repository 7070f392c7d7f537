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
"""The sum of exponentials approximates the memory kernel within its stated error."""

import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.chaos.sum_of_exponentials import fit_sum_of_exponentials

ORDERS = (0.05, 0.5, 0.98, 1.0 - 1e-9, 1.0)


def relative_error(memory, order, time):
    return memory.at(time) * math.gamma(order) * time ** (1.0 - order) - 1.0


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('tolerance', few_of([1e-8, 1e-3, 1e-6, 1e-11]))
def test_stated_error_bounds_the_error_on_a_dense_grid(order, tolerance):
    memory = fit_sum_of_exponentials(order, 1e-3, 1e5, tolerance)
    error = np.abs(relative_error(memory, order, np.geomspace(1e-3, 1e5, 40_009)))
    assert memory.error <= tolerance
    # 1e-14: at order 1 both errors are zero, apart from rounding here.
    assert error.max() <= memory.error + 1e-14
    if order in (0.5, 0.98):  # it is tight, with not far more modes than the tolerance requires
        assert error.max() > 0.9 * memory.error
        assert memory.error > 0.1 * tolerance
    if order == 1.0:
        assert memory.rates.tolist() == [memory.error] == [0.0]
        assert memory.weights.tolist() == [1.0]
    # Positive modes: the kernel is monotone.
    assert (memory.weights > 0.0).all()
    assert (memory.rates >= 0.0).all()
    assert (np.diff(memory.rates) > 0.0).all()


def test_kernel_tends_to_a_single_mode_as_the_order_tends_to_1():
    """For q near 1 the weight s^-q is almost not integrable at s = 0.

    Truncating the integral there, as for q = 0.5, would lose nearly the whole kernel; the lumped
    slow mode represents it.
    """
    for distance in (1e-4, 1e-8, 1e-12):
        memory = fit_sum_of_exponentials(1.0 - distance, 1e-3, 1e5, 1e-8)
        assert memory.weights[0] == pytest.approx(1.0, abs=40.0 * distance)
        assert memory.weights[1:].sum() < 40.0 * distance
        assert memory.rates[0] < distance


def test_number_of_modes_grows_like_the_logarithm_of_the_horizon():
    sizes = [fit_sum_of_exponentials(0.98, 1e-3, 10.0**n, 1e-8).rates.size for n in (2, 4, 6, 8)]
    growth = np.diff(sizes)
    assert growth.max() - growth.min() <= 1
    assert sizes[-1] < 70


def test_error_grows_slowly_beyond_the_horizon():
    memory = fit_sum_of_exponentials(0.98, 1e-3, 1e3, 1e-8)
    assert abs(relative_error(memory, 0.98, np.array([1e4]))[0]) < 2e-7
    assert abs(relative_error(memory, 0.98, np.array([1e5]))[0]) < 2e-5


@pytest.mark.parametrize(
    'arguments, name',
    [
        ((0.0, 1e-3, 1.0, 1e-8), 'order'),
        ((1.1, 1e-3, 1.0, 1e-8), 'order'),
        ((0.9, 0.0, 1.0, 1e-8), 'lags'),
        ((0.9, 1.0, 1.0, 1e-8), 'lags'),
        ((0.9, 1e-3, math.inf, 1e-8), 'lags'),
        ((0.9, 1e-3, 1.0, 1e-14), 'tolerance'),
        ((math.nan, 1e-3, 1.0, 1e-8), 'order'),
    ],
)
def test_arguments_out_of_range_are_rejected_by_name(arguments, name):
    with pytest.raises(ValueError, match=name):
        fit_sum_of_exponentials(*arguments)
