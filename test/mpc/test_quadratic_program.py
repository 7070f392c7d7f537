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
"""Quadratic program: optimum verified by the Karush-Kuhn-Tucker conditions."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls
from support.equations import cost, unconstrained_optimum
from support.properties import PROPERTY

from t3mpc_ros.mpc.boltzmann_machine import cholesky
from t3mpc_ros.mpc.online_learning_predictor import toeplitz
from t3mpc_ros.mpc.quadratic_program import (
    normal_equations,
    solve_quadratic_program,
    sum_rows,
    write_bounds,
)


def _matrix(steps, moves):
    matrix = np.zeros((len(steps), moves))
    toeplitz(np.asarray(steps, dtype=float), matrix)
    return matrix


@st.composite
def programs(draw):
    """Draw a program of any size and scale, degenerate cases and bounds that meet included."""
    moves = draw(st.integers(1, 20))
    horizon = draw(st.integers(moves, 21))
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    steps = draw(
        st.sampled_from(
            (
                0.12 * (1.0 - np.exp(-0.4 * np.arange(1, horizon + 1))),
                generator.standard_normal(horizon),
                np.zeros(horizon),  # a machine without knowledge of v_p
            )
        )
    )
    free = generator.standard_normal(horizon) * 10.0 ** draw(st.integers(-3, 3))
    mu, pi = 10.0 ** draw(st.integers(-2, 2)), 10.0 ** draw(st.integers(-6, 1))
    v_max = draw(st.one_of(st.just(0.0), st.floats(0.01, 100.0)))
    corner = v_max / draw(st.integers(1, 5))
    dv_max = draw(st.one_of(st.sampled_from((0.0, corner)), st.floats(0.01, 100.0)))
    v_previous = v_max * draw(st.one_of(st.sampled_from((-1.0, 1.0)), st.floats(-1.0, 1.0)))
    return _matrix(steps, moves), free, mu, pi, v_previous, dv_max, v_max


def _solve(matrix, free, mu, pi, v_previous, dv_max, v_max):
    moves = matrix.shape[1]
    hessian, gradient = np.zeros((moves, moves)), np.zeros(moves)
    normal_equations(matrix, free, mu, pi, hessian, gradient)
    lower, upper = np.zeros((2, 2 * moves - 1))
    write_bounds(v_previous, dv_max, v_max, lower, upper)
    return solve_quadratic_program(hessian, gradient, sum_rows(moves), lower, upper)


def _beyond(dv, v_previous, dv_max, v_max):
    """Return by how much the largest violation exceeds its bound, rad/s²."""
    return max(np.max(np.abs(dv)) - dv_max, np.max(np.abs(v_previous + np.cumsum(dv))) - v_max)


@pytest.mark.slow
@settings(PROPERTY, max_examples=100)
@given(programs())
def test_any_program_satisfies_karush_kuhn_tucker(program):
    """The multipliers of the bounds in contact, found by nonnegative least squares, balance it.

    Zero bounds, and optima 10⁶ times the bounds, may cycle because of rounding: then there is no
    solution and v_p is held, which is the optimum where no change is allowed.
    """
    matrix, free, mu, pi, v_previous, dv_max, v_max = program
    dv = _solve(*program)
    if dv is None:
        assert dv_max == 0.0 or v_max == 0.0
        return
    moves, width = matrix.shape[1], max(dv_max, v_max)
    assert _beyond(dv, v_previous, dv_max, v_max) < 1e-9
    rows = np.vstack((np.eye(moves), np.tril(np.ones((moves, moves)))))
    rows = np.vstack((rows, -rows))
    upper, down = np.full(moves, v_max - v_previous), np.full(moves, v_max + v_previous)
    bounds = np.r_[np.full(moves, dv_max), upper, np.full(moves, dv_max), down]
    in_contact = rows[rows @ dv > bounds - 1e-8 * max(width, 1.0)]
    hessian = mu * matrix.T @ matrix + pi * np.eye(moves)
    slope = hessian @ dv + mu * matrix.T @ free
    scale = max(np.abs(mu * matrix.T @ free).max(), np.abs(hessian).max() * width) or 1.0
    rest = np.linalg.norm(slope)
    if len(in_contact):
        rest = nnls(in_contact.T, -slope)[1]
    assert rest < 1e-8 * scale


def test_with_bounds_on_changes_it_is_bounded_least_squares():
    generator = np.random.default_rng(4)
    for _ in range(15):
        moves = int(generator.integers(1, 11))
        matrix = _matrix(generator.standard_normal(12), moves)
        free = generator.standard_normal(12)
        dv = _solve(matrix, free, 2.0, 0.1, 0.0, 0.1, 1e3)
        tall = np.vstack((np.sqrt(2.0) * matrix, np.sqrt(0.1) * np.eye(moves)))
        target = np.r_[-np.sqrt(2.0) * free, np.zeros(moves)]
        found = lsq_linear(tall, target, (-0.1, 0.1), method='bvls', tol=1e-14)
        np.testing.assert_allclose(dv, found.x, atol=1e-9)


def test_gradient_61_is_zero_at_the_closed_form_62():
    """E10: as printed, (62) increases the cost."""
    generator = np.random.default_rng(8)
    for moves in (1, 4, 9):
        matrix, free = _matrix(generator.standard_normal(9), moves), generator.standard_normal(9)
        hessian, lower = np.zeros((moves, moves)), np.zeros((moves, moves))
        gradient, closed = np.zeros(moves), np.zeros(moves)
        normal_equations(matrix, free, 1.5, 0.2, hessian, gradient)
        np.testing.assert_allclose(hessian, 1.5 * matrix.T @ matrix + 0.2 * np.eye(moves))
        np.testing.assert_allclose(gradient, 1.5 * matrix.T @ free, atol=1e-14)
        assert cholesky(hessian, lower)
        unconstrained_optimum(lower, gradient, closed)
        np.testing.assert_allclose(hessian @ closed + gradient, 0.0, atol=1e-12)
        dv = _solve(matrix, free, 1.5, 0.2, 0.0, 1e6, 1e6)
        np.testing.assert_allclose(dv, closed, rtol=1e-10, atol=1e-13)
        rest = cost(matrix, free, np.zeros(moves), 1.5, 0.2)
        assert cost(matrix, free, closed, 1.5, 0.2) < rest < cost(matrix, free, -closed, 1.5, 0.2)
        # (61) is the gradient of the cost at any changes, not only where it is zero.
        changes, ahead = generator.standard_normal((2, moves))
        slope = 2.0 * ahead @ (hessian @ changes + gradient)
        steps = (cost(matrix, free, changes + s * ahead, 1.5, 0.2) for s in (1e-5, -1e-5))
        assert np.subtract(*steps) / 2e-5 == pytest.approx(slope, rel=1e-6, abs=1e-7)


def test_clipping_the_closed_form_is_worse_than_the_optimum():
    """Clipping the closed form to the bounds is suboptimal, so the program is solved."""
    steps = 0.12 * (1.0 - np.exp(-0.4 * np.arange(1, 11)))
    matrix, free = _matrix(steps, 5), np.full(10, 1.0)
    square = matrix.T @ matrix + 0.001 * np.eye(5)
    closed = -np.linalg.solve(square, matrix.T @ free)
    v = np.clip(np.cumsum(np.clip(closed, -3.0, 3.0)), -10.0, 10.0)
    clipped = np.diff(v, prepend=0.0)
    ours = cost(matrix, free, _solve(matrix, free, 1.0, 0.001, 0.0, 3.0, 10.0), 1.0, 0.001)
    assert ours < 0.98 * cost(matrix, free, clipped, 1.0, 0.001)


def test_without_a_solution_it_returns_none():
    matrix, free = _matrix(np.linspace(0.1, 0.5, 6), 3), np.ones(6)
    assert _solve(matrix, free, 1.0, 0.01, 5.0, 0.1, 1.0) is None  # v_p(t-1) far outside
    assert _solve(matrix, np.full(6, np.nan), 1.0, 0.01, 0.0, 1.0, 1.0) is None
    assert _solve(np.full((6, 3), np.inf), free, 1.0, 0.01, 0.0, 1.0, 1.0) is None
    assert _solve(matrix, free, 1.0, 0.01, np.nan, 1.0, 1.0) is None
    assert _solve(0.0 * matrix, free, 1.0, 0.0, 0.0, 1.0, 1.0) is None  # no positive Hessian


def test_v_slightly_outside_its_bound_is_brought_back():
    matrix, free = _matrix(np.linspace(0.1, 0.5, 6), 3), np.zeros(6)
    dv = _solve(matrix, free, 1.0, 0.01, 1.05, 0.1, 1.0)
    assert dv[0] == pytest.approx(-0.05)
    assert _beyond(dv, 1.05, 0.1, 1.0) < 1e-9
