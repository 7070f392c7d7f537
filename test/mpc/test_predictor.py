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
"""Predictor: responses, skill against persistence, authority, online learning."""

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
from t3mpc_ros.mpc.online_learning_predictor import (
    LearningConstants,
    Predictor,
    authority,
    evaluate_offline,
    free_response,
    observe,
    predict_responses,
    predicted_errors,
    roll_forward,
    skill_score,
    smooth_step,
    step_response,
    toeplitz,
    update_mse,
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
EXCITATION = ExcitationParameters()
HOW = LearningConstants(True, 1e-4, 0.05, 0.9975, 0.975, 0.99, 0.03, 0.05)


def _predictor(seed=0):
    generator = np.random.default_rng(seed)
    machine = make_machine(SHAPE, 3.0, 20.0, 1.0, generator)
    runs = [
        simulate_excitation(NominalLoopParameters(), EXCITATION, TIMING, 20.0, generator)
        for _ in range(2)
    ]
    return Predictor(machine, 10, runs[1]), runs[0]


def _fitted(excitation=EXCITATION):
    predictor, run = _predictor()
    predictor.fit(*run, excitation, 600.0, HOW)
    return predictor, run


def _feed(history, missed, persistence_mse, count):
    for _ in range(count):
        history.residuals[0], history.residuals[1] = missed, persistence_mse
        update_mse(history, 0, 0.99, 0.05)


def test_skill_is_one_minus_the_ratio_of_mean_squares():
    history = make_history(4, 4, 10)
    _feed(history, 0.5, 1.0, 5000)
    assert skill_score(history, 0) == pytest.approx(0.75, abs=1e-3)
    _feed(history, 2.0, 1.0, 5000)
    assert skill_score(history, 0) == pytest.approx(-3.0, abs=1e-2)


def test_in_quiet_times_the_skill_is_constant():
    """Without the floor, noise on a well-controlled robot would determine the skill."""
    history = make_history(4, 4, 10)
    _feed(history, 0.5, 1.0, 5000)
    _feed(history, 1e-4, 1e-5, 5000)
    assert skill_score(history, 0) > 0.6
    _feed(history, 0.0, 0.0, 5000)
    assert skill_score(history, 0) > 0.6


def test_authority_is_smooth_and_needs_skill_and_sign():
    x = np.linspace(-2.0, 1.0, 301)
    values = np.array([authority(v, 1.0, -1.0, 0.0, 0.1, 0.4) for v in x])
    assert values[0] == 0.0
    assert values[-1] == 1.0
    assert np.all(np.diff(values) >= 0.0)
    assert np.max(np.diff(values)) < 1.6 * 0.01
    assert np.max(np.abs(np.diff(values, 2))) < 0.01  # no kink
    for gain in (-1.0, 0.0, 0.1):
        assert authority(0.9, gain, -1.0, 0.0, 0.1, 0.4) == 0.0
    assert 0.0 < authority(0.9, 0.25, -1.0, 0.0, 0.1, 0.4) < 1.0
    assert authority(0.9, 5.0, -1.0, 0.0, 0.1, 0.4) == 1.0
    assert smooth_step(0.5, 0.0, 1.0) == 0.5


@pytest.mark.compiled
def test_a_pretrained_machine_predicts_an_unseen_run():
    predictor, run = _fitted()
    assert skill_score(predictor.history, 0) > 0.5
    assert skill_score(predictor.history, 1) > 0.8


@pytest.mark.compiled
def test_offline_evaluation_changes_no_weights():
    predictor, run = _fitted()
    weights = predictor.get_weights()
    machine, history = predictor.state.machine, make_history(4, 4, 10)
    errors, moves = run
    evaluate_offline(machine, predictor.state.rls, history, errors, moves, HOW)
    for name, before in weights.items():
        np.testing.assert_array_equal(before, predictor.get_weights()[name])
    count = errors.size - 1 - history.errors.size
    stayed = np.mean((errors[:count] - errors[1 : count + 1]) ** 2)
    assert history.persistence_mse[0] == pytest.approx(stayed, rel=1e-10)
    stayed = np.mean((errors[:count] - errors[5 : count + 5]) ** 2)
    assert history.persistence_mse[1] == pytest.approx(stayed, rel=1e-10)


@pytest.mark.compiled
def test_residuals_compare_predictions_with_measurements():
    """The prediction over half a horizon uses the moves that were made since."""
    predictor, _ = _fitted(ExcitationParameters(noise=0.0, disturbance=0.0))
    generator = np.random.default_rng(3)
    quiet = ExcitationParameters(noise=0.0, disturbance=0.0, move_hold=0.05)
    errors, moves = simulate_excitation(NominalLoopParameters(), quiet, TIMING, 20.0, generator)
    history = predictor.history
    reset_history(history, 0.0)
    missed, stayed = [], []
    for i in range(errors.size - 2, -1, -1):
        observe(*predictor.state, errors[i], moves[i + 1], True, False, HOW)
        if i < errors.size - 20:
            missed.append(history.residuals[2])
            stayed.append(errors[i] - errors[i + 5])
            assert history.residuals[3] == pytest.approx(stayed[-1])
    assert np.mean(np.square(missed)) < 0.05 * np.mean(np.square(stayed))


def test_a_prediction_uses_the_offset_of_its_time():
    """The offset e follows a disturbance; a prediction was made with the e of that time.

    With the newest e a prediction over half a horizon would know the disturbance that came later,
    and its skill, which gives the machine its authority, would be flattered.
    """
    predictor, (errors, moves) = _predictor()
    history, newest = predictor.history, []
    for i in range(30, -1, -1):
        observe(*predictor.state, errors[i], moves[i + 1], True, False, HOW)
        newest.insert(0, history.offsets[0])
    count = history.offsets.size
    assert len(set(newest[:count])) == count
    np.testing.assert_array_equal(history.offsets, newest[:count])


@pytest.mark.compiled
def test_an_error_beyond_the_range_is_not_learned():
    predictor, run = _fitted()
    before = predictor.get_weights()
    observe(*predictor.state, 1e200, 0.0, True, True, HOW)
    for name, array in predictor.get_weights().items():
        np.testing.assert_array_equal(array, before[name])
    assert np.isfinite(
        [skill_score(predictor.history, 0), skill_score(predictor.history, 1)]
    ).all()


# -- free, step and forced responses --------------------------------------------------------------


@pytest.fixture(scope='module')
def taught():
    """Return a machine that is pretrained on a simulated run."""
    generator = np.random.default_rng(1)
    machine = make_machine(SHAPE, 3.0, 20.0, 1.0, generator)
    run = simulate_excitation(NominalLoopParameters(), EXCITATION, TIMING, 20.0, generator)
    pretrain(machine, make_rls_state(12), *run, EXCITATION, 600.0, 0.05)
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
