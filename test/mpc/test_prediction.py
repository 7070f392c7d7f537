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
"""Free, step and forced responses: superposition, indices, steady-state offset."""

import numpy as np
import pytest
from support.equations import forced_response

from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    make_history,
    make_machine,
    make_rls_state,
    predict_error,
    reset_history,
    set_visible,
)
from t3mpc_ros.mpc.predictor import (
    free_response,
    predict_responses,
    predicted_errors,
    roll_forward,
    step_response,
    toeplitz,
)
from t3mpc_ros.mpc.pretraining import (
    ExcitationParameters,
    NominalLoopParameters,
    SampleTiming,
    nominal_step_response,
    pretrain,
    simulate_excitation,
)

TIMING = SampleTiming(0.01, 5, 5)
SHAPE = LayerSizes(4, 4, 12)


@pytest.fixture(scope='module')
def taught():
    """Return a machine that is pretrained on a simulated run."""
    generator = np.random.default_rng(1)
    machine = make_machine(SHAPE, 3.0, 20.0, 1.0, generator)
    run = simulate_excitation(
        NominalLoopParameters(), ExcitationParameters(), TIMING, 20.0, generator
    )
    pretrain(machine, make_rls_state(12), *run, ExcitationParameters(), 600.0, 0.05)
    return machine


def _linear_machine():
    """Return a nearly linear machine, for which superposition holds to rounding."""
    machine = make_machine(SHAPE, 1e5, 1e5, 1.0, np.random.default_rng(2))
    machine.output_weights[:] = np.random.default_rng(3).standard_normal(12)
    return machine


def _past(generator, horizon=10):
    history = make_history(4, 4, horizon)
    history.errors[:] = generator.standard_normal(history.errors.size)
    history.moves[:] = 3.0 * generator.standard_normal(history.moves.size)
    return history


@pytest.mark.compiled
def test_iterated_prediction_uses_its_own_outputs(taught):
    history = _past(np.random.default_rng(4))
    history.planned_moves[:] = np.linspace(-2.0, 2.0, 10)
    out = np.zeros(10)
    roll_forward(taught, history, 0, 0.03, out)
    errors, moves = list(history.errors), list(history.moves[1:])
    for j in range(10):
        moves.insert(0, history.planned_moves[j])
        set_visible(taught, np.array(errors), np.array(moves), 0)
        errors.insert(0, predict_error(taught) + 0.03)
        assert out[j] == pytest.approx(errors[0], rel=1e-12)


def test_free_and_step_response_hold_the_last_move(taught):
    history, out = _past(np.random.default_rng(5)), np.zeros(10)
    history.offsets[0] = 0.02
    free, steps = np.zeros(10), np.zeros(10)
    free_response(taught, history, 1.5, free)
    step_response(taught, history, 1.5, 0.5, free, steps)
    history.planned_moves[:] = 1.5
    roll_forward(taught, history, 0, 0.02, out)
    np.testing.assert_allclose(free, out)
    history.planned_moves[:] = 2.0
    roll_forward(taught, history, 0, 0.02, out)
    np.testing.assert_allclose(steps, (out - free) / 0.5)


def test_step_response_after_pretraining_is_nominal(taught):
    """Without pretraining the step response has a random sign and size."""
    history, free, steps = make_history(4, 4, 10), np.zeros(10), np.zeros(10)
    free_response(taught, history, 0.0, free)
    step_response(taught, history, 0.0, 1.0, free, steps)
    true = nominal_step_response(NominalLoopParameters(), TIMING, 10)
    assert np.all(steps > 0.0)
    np.testing.assert_allclose(steps[2:], true[2:], rtol=0.2)
    assert steps[4] == pytest.approx(true[4], rel=0.1)


def test_toeplitz_shifts_the_step_response_down_the_columns():
    """E11: the printed last row repeats s_(n_p-1); it must end with s_0."""
    steps = np.array([1.0, 2.0, 3.0, 4.0])
    matrix = np.zeros((4, 4))
    toeplitz(steps, matrix)
    np.testing.assert_array_equal(matrix, [[1, 0, 0, 0], [2, 1, 0, 0], [3, 2, 1, 0], [4, 3, 2, 1]])
    short = np.zeros((4, 2))
    toeplitz(steps, short)
    np.testing.assert_array_equal(short, matrix[:, :2])


def test_forced_response_is_causal_and_equals_the_matrix_form():
    """E11: with the printed index t + j - i + 1 a move would act two periods early."""
    generator = np.random.default_rng(6)
    steps, changes = generator.standard_normal(8), generator.standard_normal(5)
    matrix, out = np.zeros((8, 5)), np.zeros(8)
    toeplitz(steps, matrix)
    predicted_errors(matrix, changes, np.zeros(8), out)
    for ahead in range(1, 9):
        assert forced_response(steps, changes, ahead) == pytest.approx(out[ahead - 1], rel=1e-12)
    late = np.zeros(5)
    late[3] = 1.0
    assert [forced_response(steps, late, ahead) for ahead in (1, 2, 3)] == [0.0, 0.0, 0.0]
    assert forced_response(steps, late, 4) == steps[0]


def test_free_plus_forced_is_exact_for_a_linear_machine():
    """(45), (52): this checks every index of (47)-(54) at once."""
    generator = np.random.default_rng(7)
    machine, history = _linear_machine(), _past(generator)
    v_previous, changes = 2.0, generator.standard_normal(6)
    free, steps, psi, true = (np.zeros(10) for _ in range(4))
    predict_responses(machine, history, v_previous, 1.0, np.zeros(10), steps, free)
    matrix = np.zeros((10, 6))
    toeplitz(steps, matrix)
    predicted_errors(matrix, changes, free, psi)
    history.planned_moves[:] = v_previous + np.cumsum(np.r_[changes, np.zeros(4)])
    roll_forward(machine, history, 0, history.offsets[0], true)
    np.testing.assert_allclose(psi, true, atol=1e-6)
    assert np.max(np.abs(psi - free)) > 0.01


def test_a_steady_error_is_predicted_as_constant(taught):
    """Offset-free: the offset is added in every step of the iterated prediction.

    Added once to the finished response it leaves a residual, and v_p would stop at a steady
    error.
    """
    history, out = make_history(4, 4, 10), np.zeros(10)
    reset_history(history, 0.7)
    history.moves[:] = -2.0
    set_visible(taught, history.errors, history.moves, 1)
    history.offsets[0] = 0.7 - predict_error(taught)
    free_response(taught, history, -2.0, out)
    np.testing.assert_allclose(out, 0.7, rtol=1e-12)
    history.planned_moves[:] = -2.0
    once = np.zeros(10)
    roll_forward(taught, history, 0, 0.0, once)
    once += history.offsets[0]
    assert np.max(np.abs(once - 0.7)) > 0.05


def test_known_errors_are_added_to_the_free_response_only(taught):
    history = _past(np.random.default_rng(8))
    plain, known = (np.zeros(10), np.zeros(10)), (np.zeros(10), np.zeros(10))
    coming = np.linspace(0.0, 5.0, 10)
    predict_responses(taught, history, 1.0, 1.0, np.zeros(10), *plain)
    predict_responses(taught, history, 1.0, 1.0, coming, *known)
    np.testing.assert_array_equal(plain[0], known[0])
    np.testing.assert_allclose(known[1] - plain[1], coming, atol=1e-12)
