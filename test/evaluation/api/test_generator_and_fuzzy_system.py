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
"""Generator, fuzzy system and bags alone: the same numbers as inside of the package."""

import numpy as np
import pytest
from support.checkout import ROOT
from support.equations import linear_decay_system, output_by_double_sum, solve_full_memory

import t3mpc_ros as t3
from t3mpc_ros.bag.reader import open_bag

BAG = ROOT / 'test' / 'golden' / 'stops.mcap'


def test_the_solution_is_that_of_the_full_memory():
    orders = 0.9, 0.95, 0.98, 1.0
    solution = t3.chaos(orders, tspan=(2.0, 2.5), dt=0.001, y0=np.ones(4), every=1)
    full = solve_full_memory(solution.system, 0.001, np.ones(4), 500)
    assert solution.t[[0, -1]].tolist() == pytest.approx([2.0, 2.5])
    np.testing.assert_allclose(solution.y, full, rtol=1e-5)


def test_another_system_is_solved_from_ones():
    solution = t3.chaos(system=linear_decay_system(1.0), tspan=(0.0, 3.0))
    np.testing.assert_allclose(solution.y[:, 0], np.exp(-solution.t), atol=1e-6)


def test_rules_are_those_of_the_equations():
    """(32) has all lower levels first: rules by hand meet the literal double sum (29)."""
    system = t3.fuzzy('x', 'y', sets=3, input_fuzziness=0.2)
    generator = np.random.default_rng(3)
    values = generator.normal(size=(3, 3))
    for i in range(3):
        for j in range(3):
            system.add_rule([('x', i), ('y', j)], values[i, j])
    alpha = np.repeat(values.reshape(-1, 1), system.sets.slices, axis=1)
    for point in generator.uniform(-1.2, 1.2, (5, 2)):
        expected = output_by_double_sum(point, system.sets, alpha, alpha)
        assert system.evaluate(point) == pytest.approx(expected, abs=1e-12)
        assert system.evaluate({'y': point[1], 'x': point[0]}) == system.evaluate(point)
    system.add_rule([], 2.5)  # every rule: a convex combination of one number is that number
    np.testing.assert_allclose(system.evaluate(np.zeros((4, 2))), 2.5)


def test_a_fit_meets_a_function_that_the_system_can_be():
    source = t3.fuzzy('x', sets=5)
    for index, value in enumerate((1.0, -2.0, 0.5, 3.0, 0.0)):
        source.add_rule([('x', index)], value)
    points = np.linspace(-1.0, 1.0, 60)[:, None]
    fitted = t3.fuzzy('x', sets=5).fit(points, source.evaluate(points), ridge=1e-10)
    between = np.linspace(-0.97, 0.97, 31)[:, None]
    np.testing.assert_allclose(fitted.evaluate(between), source.evaluate(between), atol=1e-3)


@pytest.mark.slow
def test_columns_of_a_bag_are_its_messages():
    bag = t3.read_bag(BAG)
    with open_bag(BAG) as reader:
        fields = {'x': 'pose.pose.position.x', 'variance': 'pose.covariance[7]'}
        expected = reader.series('/odom', fields)
        assert {*bag} == {*reader.topics}
    odometry = bag['/odom']
    assert np.array_equal(odometry['pose.pose.position.x'], expected['x'])
    assert np.array_equal(odometry['pose.covariance[7]'], expected['variance'])
    assert np.array_equal(odometry['stamp'], expected['stamp'])
    assert '/no_topic' not in bag
    with pytest.raises(t3.ScriptError, match='/odm is not in .* did you mean /odom'):
        bag['/odm']
    with pytest.raises(t3.ScriptError, match='no field twist.linear; did you mean'):
        odometry['twist.linear']
