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
"""Predictor of one wheel: responses (45)-(59) with E11, online learning, skill and authority.

The skill compares the predictions of the machine with persistence, the prediction of no change.
The authority is the fraction of the bound of v_p that the skill justifies.
"""

from collections.abc import Mapping
from typing import NamedTuple

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.boltzmann_machine import (
    BoltzmannMachine,
    History,
    RlsState,
    contrastive_divergence_step,
    gradient_step,
    make_history,
    make_rls_state,
    predict_error,
    reset_history,
    rls_step,
    set_visible,
)
from t3mpc_ros.mpc.pretraining import ExcitationParameters, pretrain


@kernel
def roll_forward(
    machine: BoltzmannMachine, history: History, first: int, offset: float, out: Array
) -> None:
    r"""Write the iterated predictions delta_hat(t+1) ... delta_hat(t+n) into ``out`` (rad/s).

    .. math:: \hat\delta(t+j) = y_{BM}(\hat\delta(t+j-1), \ldots, v_p(t+j-1), \ldots) + e(t)

    Equations (46), (49)-(50), (57)-(58). The offset ``e`` is added at *every* step and so passes
    through the machine's own dynamics, which removes the steady error (offset-free control). If
    it were added once to the finished response, as for a model without measured inputs, a steady
    error would remain, because the measured lags already contain part of the disturbance.

    ``history.planned_moves``, v_p for t, t+1, ..., are used instead of moves[first]; errors[first]
    is the one to start from, 0 the present one.
    """
    n_errors = machine.delta_lags
    n_moves = machine.lags.size - n_errors
    for i in range(n_errors):
        history.lagged_errors[i] = history.errors[first + i]
    for i in range(1, n_moves):
        history.lagged_moves[i] = history.moves[first + i]
    for j in range(out.size):
        if j > 0:
            for i in range(n_errors - 1, 0, -1):
                history.lagged_errors[i] = history.lagged_errors[i - 1]
            history.lagged_errors[0] = out[j - 1]
            for i in range(n_moves - 1, 0, -1):
                history.lagged_moves[i] = history.lagged_moves[i - 1]
        history.lagged_moves[0] = history.planned_moves[j]
        set_visible(machine, history.lagged_errors, history.lagged_moves, 0)
        out[j] = predict_error(machine) + offset


@kernel
def free_response(
    machine: BoltzmannMachine, history: History, v_previous: float, out: Array
) -> None:
    """Write Psi_free (56): the response to a constant v_p(t-1), (46), (57)-(59), rad/s."""
    history.planned_moves[:] = v_previous
    roll_forward(machine, history, 0, history.offsets[0], out)


@kernel
def step_response(
    machine: BoltzmannMachine,
    history: History,
    v_previous: float,
    probe: float,
    free: Array,
    out: Array,
) -> None:
    """Write s_0 ... s_{n_p-1}, equation (48), in (rad/s)/(rad/s²).

    s_j = (delta_hat_step(t+j+1) - delta_hat_free(t+j+1)) / dv: the response to a constant
    v_p(t-1) + dv, (49)-(51), minus ``free``, that to a constant v_p(t-1) (59); ``probe`` is dv.
    """
    history.planned_moves[:] = v_previous + probe
    roll_forward(machine, history, 0, history.offsets[0], out)
    for j in range(out.size):
        out[j] = (out[j] - free[j]) / probe


@kernel
def toeplitz(step: Array, out: Array) -> None:
    """Write S, the lower-triangular Toeplitz matrix of the step response, (54) with E11.

    E11: the printed last row repeats s_{n_p-1}; it is s_{n_p-1}, s_{n_p-2}, ..., s_0. Changes
    after n_c periods are zero.
    """
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[j, i] = step[j - i] if j >= i else 0.0


@kernel
def predicted_errors(matrix: Array, changes: Array, free: Array, out: Array) -> None:
    """Write Psi = S dv + Psi_free (rad/s), shape (n_p,), (45), (52)-(53) with dv of (55)."""
    for j in range(out.size):
        out[j] = free[j]
        for i in range(min(j + 1, changes.size)):
            out[j] += matrix[j, i] * changes[i]


@kernel
def predict_responses(
    machine: BoltzmannMachine,
    history: History,
    v_previous: float,
    probe: float,
    known: Array,
    steps: Array,
    free: Array,
) -> None:
    """Write the step response (48), and Psi_free (56) plus the ``known`` errors of known jumps."""
    free_response(machine, history, v_previous, free)
    step_response(machine, history, v_previous, probe, free, steps)
    for j in range(free.size):
        free[j] += known[j]


class LearningConstants(NamedTuple):
    """Constants of online learning and of the skill, for kernels."""

    recursive: bool
    """Whether by least squares (:func:`rls_step`), otherwise by the normalised gradient (44)."""
    contrast_rate: float  # gamma of (43)
    output_rate: float  # gamma of (44), normalised
    rls_forgetting: float
    """lambda of :func:`rls_step` per predictive period; the next two are per period as well."""
    power_forgetting: float
    skill_forgetting: float
    offset_gain: float  # gain of the offset e on the last prediction error
    noise: float  # standard deviation of the noise of an error (rad/s)


@kernel
def update_mse(history: History, term: int, forgetting: float, noise: float) -> None:
    """Update the mean squared errors that :func:`skill_score` compares.

    Without variation both errors are noise, and their ratio has no meaning. The weight of a sample
    is therefore power / (power + (2 noise)²); the error of persistence for independent noise is
    sqrt(2) noise. Forgetting is reduced by the same weight, so the skill is constant in quiet
    times. The power is a short-term mean: weighting each sample by its own size would select
    samples. ``term`` is 0 for one step, 1 for the middle of the horizon.
    """
    missed = history.residuals[2 * term] * history.residuals[2 * term]
    persistence = history.residuals[2 * term + 1] * history.residuals[2 * term + 1]
    history.recent_mse[term] += 0.1 * (persistence - history.recent_mse[term])
    power = history.recent_mse[term]
    if power > 0.0:
        share = (1.0 - forgetting) * power / (power + 4.0 * noise * noise)
        history.prediction_mse[term] += share * (missed - history.prediction_mse[term])
        history.persistence_mse[term] += share * (persistence - history.persistence_mse[term])


@kernel
def skill_score(history: History, term: int) -> float:
    """Return 1 - mean(prediction error²)/mean(persistence error²): 1 perfect, 0 no better.

    Mean squares, not variances: a constant error counts.
    """
    ratio: float = history.prediction_mse[term] / max(history.persistence_mse[term], 1e-300)
    return 1.0 - ratio


@kernel
def smooth_step(x: float, low: float, high: float) -> float:
    """Return 0 below ``low``, 1 above ``high``, and a smooth cubic in between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@kernel
def authority(
    score: float, gain: float, low: float, high: float, gain_low: float, gain_high: float
) -> float:
    """Return the fraction of the bound of v_p that the machine may use, in [0, 1].

    score : skill; the authority is 0 up to ``low`` and 1 from ``high`` on
    gain  : step response of the machine in the middle of the horizon, over the nominal one. A
            decaying error is predictable without a model of v_p, so the skill alone does not
            detect a wrong sign or a missing effect of v_p. Too large a response only reduces the
            moves.
    """
    return smooth_step(score, low, high) * smooth_step(gain, gain_low, gain_high)


@kernel
def observe(
    machine: BoltzmannMachine,
    rls: RlsState,
    history: History,
    error: float,
    applied: float,
    score: bool,
    learn: bool,
    learning: LearningConstants,
) -> None:
    """Add a measured error: update skill, weights and offset e.

    ``applied`` is the v_p since the previous error; the skill needs a complete history.
    """
    for i in range(history.errors.size - 1, 0, -1):
        history.errors[i] = history.errors[i - 1]
        history.moves[i] = history.moves[i - 1]
    history.errors[0] = error
    history.moves[1] = applied

    middle = history.offsets.size
    # Prediction from half a horizon ago, with the moves made since.
    for i in range(middle):
        history.planned_moves[i] = history.moves[middle - i]
    roll_forward(machine, history, middle, history.offsets[middle - 1], history.half_horizon)
    set_visible(machine, history.errors, history.moves, 1)
    missed = error - predict_error(machine) - history.offsets[0]
    # Squares of very large values must not overflow.
    limit = 10.0 * machine.scales[0]
    history.residuals[0] = min(max(missed, -limit), limit)
    history.residuals[1] = min(max(error - history.errors[1], -limit), limit)
    history.residuals[2] = min(max(error - history.half_horizon[middle - 1], -limit), limit)
    history.residuals[3] = min(max(error - history.errors[middle], -limit), limit)
    if score:
        update_mse(history, 0, learning.skill_forgetting, learning.noise)
        update_mse(history, 1, learning.skill_forgetting, learning.noise)
    # An error larger than the range of the machine is a fault or a shock: do not learn from it.
    if learn and abs(missed) < machine.scales[0]:
        # From the error after the offset: a steady disturbance is not part of the dynamics.
        if learning.recursive:
            rls_step(machine, rls, missed, learning.rls_forgetting, learning.power_forgetting)
        else:
            gradient_step(machine, missed, learning.output_rate, rls.power[2])
        contrastive_divergence_step(machine, learning.contrast_rate)
    for i in range(middle - 1, 0, -1):
        history.offsets[i] = history.offsets[i - 1]
    history.offsets[0] += learning.offset_gain * history.residuals[0]


@kernel
def evaluate_offline(
    machine: BoltzmannMachine,
    rls: RlsState,
    history: History,
    errors: Array,
    moves: Array,
    learning: LearningConstants,
) -> None:
    """Set the mean squared errors of ``history`` to those of a run, without learning."""
    history.prediction_mse[:] = 0.0
    history.persistence_mse[:] = 0.0
    count = errors.size - 1 - history.errors.size
    for i in range(errors.size - 2, -1, -1):
        observe(machine, rls, history, errors[i], moves[i + 1], False, False, learning)
        if i < count:
            for term in range(2):
                missed, persistence = history.residuals[2 * term], history.residuals[2 * term + 1]
                history.prediction_mse[term] += missed * missed / count
                history.persistence_mse[term] += persistence * persistence / count


class WheelState(NamedTuple):
    """Machine, RLS state and history of one output."""

    machine: BoltzmannMachine
    rls: RlsState
    history: History


class Predictor:
    """Machine of one output, with its learning state, its history and a trial run.

    The trial, (errors, moves) newest first, is not used for fitting.
    """

    def __init__(
        self, machine: BoltzmannMachine, horizon: int, trial: tuple[Array, Array]
    ) -> None:
        delta_lags, hidden = machine.delta_lags, machine.output_weights.size
        history = make_history(delta_lags, machine.lags.size - delta_lags, horizon)
        self.state = WheelState(machine, make_rls_state(hidden), history)
        """State that the kernels change."""
        self._trial = trial

    @property
    def history(self) -> History:
        """History of errors and moves."""
        return self.state.history

    def fit(
        self,
        errors: Array,
        moves: Array,
        excitation: ExcitationParameters,
        trust: float,
        learning: LearningConstants,
    ) -> None:
        """Pretrain on a run (*newest first*), and measure the skill on the trial run."""
        pretrain(*self.state[:2], errors, moves, excitation, trust, learning.noise)
        self.evaluate(learning)

    def evaluate(self, learning: LearningConstants) -> None:
        """Set the skill to that of the trial run, and clear the history."""
        reset_history(self.history, 0.0)
        evaluate_offline(*self.state[:2], self.history, *self._trial, learning)
        reset_history(self.history, 0.0)

    def get_weights(self) -> dict[str, Array]:
        """Return copies of all learned arrays, and of the scales that they are valid for."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def set_weights(self, weights: Mapping[str, Array], learning: LearningConstants) -> None:
        """Set validated arrays of :meth:`get_weights`, and measure the skill on the trial run."""
        for name, array in self._arrays().items():
            array[:] = weights[name]
        self.evaluate(learning)

    def _arrays(self) -> dict[str, Array]:
        machine, rls, _ = self.state
        return {
            'visible_weights': machine.visible_weights,
            'output_weights': machine.output_weights,
            'scales': machine.scales,
            'anchor': rls.anchor,
            'prior': rls.prior,
            'information': rls.information,
            'power': rls.power,
        }
