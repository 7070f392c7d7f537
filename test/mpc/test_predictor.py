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
"""Predictor: skill against persistence, authority, online learning, state."""

import numpy as np
import pytest

from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    make_history,
    make_machine,
    make_rls_state,
    reset_history,
)
from t3mpc_ros.mpc.predictor import (
    LearningConstants,
    Predictor,
    authority,
    evaluate_offline,
    observe,
    skill_score,
    smooth_step,
    update_mse,
)
from t3mpc_ros.mpc.pretraining import (
    ExcitationParameters,
    NominalLoopParameters,
    SampleTiming,
    simulate_excitation,
)

TIMING = SampleTiming(0.01, 5, 5)
EXCITATION = ExcitationParameters()
HOW = LearningConstants(True, 1e-4, 0.05, 0.9975, 0.975, 0.99, 0.03, 0.05)


def _predictor(seed=0):
    generator = np.random.default_rng(seed)
    machine = make_machine(LayerSizes(4, 4, 12), 3.0, 20.0, 1.0, generator)
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
    _feed(history, 1.0, 1.0, 5000)
    assert skill_score(history, 0) == pytest.approx(0.0, abs=1e-3)
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
def test_an_untrained_machine_has_no_skill():
    predictor, _ = _predictor()
    predictor.state.machine.output_weights[:] = np.random.default_rng(1).standard_normal(12)
    predictor.evaluate(HOW)
    assert skill_score(predictor.history, 0) < 0.0
    assert skill_score(predictor.history, 1) < 0.3


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


def test_a_trial_run_that_is_too_short_is_rejected():
    machine = make_machine(LayerSizes(4, 4, 12), 3.0, 20.0, 1.0, np.random.default_rng(0))
    with pytest.raises(ValueError, match='trial must be longer'):
        Predictor(machine, 10, (np.zeros(5), np.zeros(5)))
    assert make_rls_state(12).power.size == 3
