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
from scipy.optimize import lsq_linear
from support.equations import cost, unconstrained_optimum
from support.properties import PROPERTY

from t3mpc_ros.mpc.online_learning_predictor import toeplitz
from t3mpc_ros.mpc.quadratic_program import (
    INFEASIBLE,
    NOT_POSITIVE,
    OPTIMAL,
    UNFINISHED,
    cholesky,
    is_dependent,
    make_workspace,
    normal_equations,
    solve_quadratic_program,
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


def _kkt(matrix, free, mu, pi, v_previous, dv_max, v_max, work):
    """Return the four relative residuals of the conditions, by their definition."""
    moves = matrix.shape[1]
    rows = np.vstack((np.eye(moves), np.tril(np.ones((moves, moves)))))
    upper = np.r_[np.full(moves, dv_max), np.full(moves, v_max - v_previous)]
    lower = np.r_[np.full(moves, -dv_max), np.full(moves, -v_max - v_previous)]
    hessian = mu * matrix.T @ matrix + pi * np.eye(moves)
    gradient = mu * matrix.T @ free
    dv, (down, up) = work.changes, work.multipliers
    scale = max(np.abs(gradient).max(), np.abs(hessian).max() * np.abs(dv).max()) or 1.0
    width = max(dv_max, v_max) or 1.0
    value = rows @ dv
    return (
        np.abs(hessian @ dv + gradient + rows.T @ (up - down)).max() / scale,
        max((value - upper).max(), (lower - value).max(), 0.0) / width,
        max(-up.min(), -down.min(), 0.0) / scale,
        max(np.abs(up * (value - upper)).max(), np.abs(down * (value - lower)).max())
        / (scale * width),
    )


@pytest.mark.slow
@settings(PROPERTY, max_examples=100)
@given(programs())
def test_any_program_satisfies_karush_kuhn_tucker(program):
    """Zero bounds, and optima 10⁶ times the bounds, may cycle because of rounding."""
    work = make_workspace(program[0].shape[1])
    assert solve_quadratic_program(*program, 50 * work.gradient.size, work) == OPTIMAL
    assert max(_kkt(*program, work)) < 1e-10


def test_with_bounds_on_changes_it_is_bounded_least_squares():
    generator = np.random.default_rng(4)
    for _ in range(15):
        moves = int(generator.integers(1, 11))
        matrix = _matrix(generator.standard_normal(12), moves)
        free = generator.standard_normal(12)
        work = make_workspace(moves)
        assert solve_quadratic_program(matrix, free, 2.0, 0.1, 0.0, 0.1, 1e3, 500, work) == OPTIMAL
        tall = np.vstack((np.sqrt(2.0) * matrix, np.sqrt(0.1) * np.eye(moves)))
        target = np.r_[-np.sqrt(2.0) * free, np.zeros(moves)]
        found = lsq_linear(tall, target, (-0.1, 0.1), method='bvls', tol=1e-14)
        np.testing.assert_allclose(work.changes, found.x, atol=1e-9)


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
        work = make_workspace(moves)
        assert solve_quadratic_program(matrix, free, 1.5, 0.2, 0.0, 1e6, 1e6, 100, work) == OPTIMAL
        np.testing.assert_allclose(work.changes, closed, rtol=1e-10, atol=1e-13)
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
    work = make_workspace(5)
    solve_quadratic_program(matrix, free, 1.0, 0.001, 0.0, 3.0, 10.0, 100, work)
    square = matrix.T @ matrix + 0.001 * np.eye(5)
    closed = -np.linalg.solve(square, matrix.T @ free)
    v = np.clip(np.cumsum(np.clip(closed, -3.0, 3.0)), -10.0, 10.0)
    clipped = np.diff(v, prepend=0.0)
    ours = cost(matrix, free, work.changes, 1.0, 0.001)
    assert ours < 0.98 * cost(matrix, free, clipped, 1.0, 0.001)


@PROPERTY
@given(st.integers(1, 6).flatmap(lambda moves: st.permutations(range(2 * moves))))
def test_dependence_of_rows_agrees_with_their_rank(order):
    moves = len(order) // 2
    rows = np.vstack((np.eye(moves), np.tril(np.ones((moves, moves)))))
    active: list[int] = []
    for row in order:
        joined = np.array([*active, 0], dtype=np.int64)
        answer = is_dependent(row, joined, len(active), np.zeros(moves + 1, dtype=np.int64))
        assert answer == (np.linalg.matrix_rank(rows[[*active, row]]) == len(active))
        if not answer:
            active.append(row)


def test_every_failure_status_gives_zero_changes():
    matrix, free = _matrix(np.linspace(0.1, 0.5, 6), 3), np.ones(6)
    work = make_workspace(3)
    assert solve_quadratic_program(matrix, free, 1.0, 0.01, 5.0, 0.1, 1.0, 100, work) == INFEASIBLE
    np.testing.assert_array_equal(work.changes, 0.0)
    assert solve_quadratic_program(matrix, free, 1.0, 0.01, 0.0, 0.1, 0.15, 1, work) == UNFINISHED
    np.testing.assert_array_equal(work.changes, 0.0)
    assert (
        solve_quadratic_program(matrix, np.full(6, np.nan), 1.0, 0.01, 0.0, 1.0, 1.0, 9, work)
        == NOT_POSITIVE
    )
    assert (
        solve_quadratic_program(0.0 * matrix, free, 1.0, 0.0, 0.0, 1.0, 1.0, 9, work)
        == NOT_POSITIVE
    )
    np.testing.assert_array_equal(work.changes, 0.0)


def test_v_slightly_outside_its_bound_is_brought_back():
    matrix, free = _matrix(np.linspace(0.1, 0.5, 6), 3), np.zeros(6)
    work = make_workspace(3)
    program = (matrix, free, 1.0, 0.01, 1.05, 0.1, 1.0)
    assert solve_quadratic_program(*program, 100, work) == OPTIMAL
    assert work.changes[0] == pytest.approx(-0.05)
    assert max(_kkt(*program, work)) < 1e-10
