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
"""Lyapunov exponents at order 1: two positive for (85) with E6, none for the printed reading."""

import numpy as np
import pytest

from t3mpc_ros.chaos.system_equations import QuadraticSystem, hyperchaotic_system
from t3mpc_ros.evaluation.lyapunov_exponents import lyapunov_exponents

ORDINARY = (1.0, 1.0, 1.0, 1.0)


@pytest.mark.slow
def test_equation_85_with_e6_has_two_positive_exponents():
    found = lyapunov_exponents(hyperchaotic_system(orders=ORDINARY), duration=120.0)
    assert found[0] == pytest.approx(2.3, abs=0.3)
    assert 0.3 < found[1] < 1.1
    assert abs(found[2]) < 0.1  # along the flow nothing grows or shrinks
    assert found[3] == pytest.approx(-41.0, abs=1.0)
    assert found.sum() == pytest.approx(-38.0, abs=1e-3)


def test_printed_sign_of_e6_leaves_no_positive_exponent():
    found = lyapunov_exponents(hyperchaotic_system(c=-25.0, orders=ORDINARY), np.ones(4), 20.0)
    assert np.all(found < -1.0)


def test_linear_exponents_are_real_parts_of_eigenvalues():
    # A rotation with growth 0.3, coupled to a decay.
    system = QuadraticSystem(
        (1.0, 1.0, 1.0),
        linear=((0, 0, 0.3), (0, 1, -2.0), (1, 0, 2.0), (1, 1, 0.3), (0, 2, 1.0), (2, 2, -4.0)),
    )
    found = lyapunov_exponents(system, np.ones(3), 40.0 * np.pi, settle=10.0)
    np.testing.assert_allclose(found, [0.3, 0.3, -4.0], atol=1e-3)


@pytest.mark.parametrize(
    'arguments, name',
    [
        ((hyperchaotic_system(), np.ones(4), 1.0), 'orders'),
        ((hyperchaotic_system(orders=ORDINARY), np.ones(3), 1.0), 'initial'),
        ((hyperchaotic_system(orders=ORDINARY), np.ones(4), 0.0), 'times'),
    ],
)
def test_arguments_out_of_range_are_refused_by_name(arguments, name):
    with pytest.raises(ValueError, match=name):
        lyapunov_exponents(*arguments)
