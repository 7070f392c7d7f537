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
"""The hyperchaotic system as data: equation (85) with E6."""

import numpy as np
import pytest

from t3mpc_ros.chaos.solver import FractionalSolver
from t3mpc_ros.chaos.system import QuadraticSystem, hyperchaotic_system, jacobian, right_hand_side

STATES = np.random.default_rng(3).normal(0.0, (10.0, 2.0, 4.0, 20.0), (20, 4))


def slope_of(system, state):
    out = np.full(system.size, np.nan)
    right_hand_side(system.terms(), state, out)
    return out


def test_terms_are_those_of_equation_85_with_e6():
    for y1, y2, y3, y4 in STATES:
        expected = [
            35 * (y2 * y3 + (y2 - y1)),
            -5 * y1 * y3 + 25 * y1 + y2 + y4,
            -4 * y3 + y1 * y2,
            -100 * y2,
        ]
        found = slope_of(hyperchaotic_system(), np.array([y1, y2, y3, y4]))
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-11)


def test_jacobian_is_the_derivative_of_the_slope():
    # Central differences of a quadratic function are exact up to rounding.
    system = hyperchaotic_system()
    out = np.full((4, 4), np.nan)
    for state in STATES:
        jacobian(system.terms(), state, out)
        for column in range(4):
            shift = np.eye(4)[column]
            difference = slope_of(system, state + shift) - slope_of(system, state - shift)
            np.testing.assert_allclose(out[:, column], difference / 2.0, rtol=1e-9, atol=1e-9)
        assert np.trace(out) == pytest.approx(-38.0)  # the rate at which volume contracts


def test_repeated_terms_and_squares_are_added():
    system = QuadraticSystem(
        (1.0, 1.0),
        linear=((0, 0, 1.0), (0, 0, 2.0)),
        quadratic=((1, 0, 0, 3.0), (1, 0, 1, 1.0)),
        constant=(0.5, -1.0),
    )
    state = np.array([2.0, 5.0])
    np.testing.assert_allclose(slope_of(system, state), [0.5 + 6.0, -1.0 + 12.0 + 10.0])
    out = np.empty((2, 2))
    jacobian(system.terms(), state, out)
    np.testing.assert_allclose(out, [[3.0, 0.0], [12.0 + 5.0, 2.0]])


@pytest.mark.compiled
@pytest.mark.parametrize('order', [0.98])
def test_plus_sign_of_e6_is_chaotic_and_minus_sign_decays(order):
    """The paper prints (85) with '- 5 y1 y3 25 y1'.

    With minus the origin attracts every state; with plus, as in the original publication, the
    states cover their full range.
    """
    # The range for q = 1 is sufficient to distinguish both cases for both orders.
    for sign, alive in ((1.0, True), (-1.0, False)):
        system = hyperchaotic_system(c=sign * 25.0, orders=(order,) * 4)
        solver = FractionalSolver(system, 1e-3, np.ones(4))
        solver.advance(8000)
        late = np.array([solver.advance(10) for _ in range(400)])
        if alive:
            assert np.all(np.ptp(late, axis=0) > (30.0, 6.0, 3.0, 40.0))
        else:
            assert np.all(np.abs(late) < 1e-2)


@pytest.mark.parametrize(
    'arguments, name',
    [
        (((), ()), 'orders'),
        (((0.0,), ()), 'orders'),
        (((1.2,), ()), 'orders'),
        (((1.0,), ((0, 1, 1.0),)), 'states'),
        (((1.0,), ((0, -1, 1.0),)), 'states'),
        (((1.0,), ((0, 0, np.nan),)), 'gains'),
        (((1.0,), (), ((0, 0, 1, 1.0),)), 'states'),
        (((1.0,), (), (), (1.0, 2.0)), 'constant'),
        (((1.0,), (), (), (np.inf,)), 'constant'),
    ],
)
def test_invalid_systems_are_rejected_by_name(arguments, name):
    with pytest.raises(ValueError, match=name):
        QuadraticSystem(*arguments)


def test_four_states_need_four_orders():
    with pytest.raises(ValueError, match='orders must be four'):
        hyperchaotic_system(orders=(0.98,))
