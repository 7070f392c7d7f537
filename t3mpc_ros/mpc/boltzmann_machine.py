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
"""Boltzmann machine that predicts the tracking error of one wheel, (35)-(44) with E9.

All values inside the machine are of order one: errors are divided by ``delta_scale``, predictive
signals by ``move_scale``. Time is measured in predictive periods; histories are stored newest
first.
"""

import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel


class LayerSizes(NamedTuple):
    """Number of past values in the visible layer, and of hidden units."""

    delta_lags: int  # past tracking errors in (35), the paper's tau
    move_lags: int  # past predictive signals; (35) has one, which cannot represent a dead time
    hidden: int

    @property
    def visible(self) -> int:
        """Length of the visible vector (35)."""
        return self.delta_lags + self.move_lags


class BoltzmannMachine(NamedTuple):
    """Weights and work space of one machine; kernels change the arrays in place."""

    visible_weights: Array  # X_v, shape (visible, hidden)
    output_weights: Array  # X_o, shape (hidden,)
    delta_lags: int
    """Number of visible units that are tracking errors; the rest are predictive signals."""
    scales: Array  # (delta_scale in rad/s, move_scale in rad/s²)
    lags: Array  # shape (visible,): eta_0 of the last pass, (35)
    mu0: Array  # shape (hidden,): (39)
    eta1: Array  # shape (visible,): (38), the reconstruction of eta_0
    mu1: Array  # shape (hidden,): (37), the features of the output layer


class History(NamedTuple):
    """Past errors and moves of one output, newest first, and how well they were predicted."""

    errors: Array  # tracking errors (rad/s): errors[0] is the newest
    moves: Array
    """Applied v_p (rad/s²): moves[i] was held from errors[i] on; moves[0] is not yet known."""
    offsets: Array  # offsets e (rad/s) used after each instant, shape (middle,)
    residuals: Array
    """Last errors (rad/s) of machine and persistence: one step, then middle of the horizon."""
    prediction_mse: Array  # mean squared error of the machine, (rad/s)²: one step, middle
    persistence_mse: Array  # the same of persistence, which predicts no change
    recent_mse: Array
    """The same of persistence over about one second: the variation there is to predict."""
    planned_moves: Array
    """Work space, shape (n_p,); the next three have lengths delta_lags, move_lags, middle."""
    lagged_errors: Array
    lagged_moves: Array
    half_horizon: Array


class RlsState(NamedTuple):
    """State of the recursive least squares of the output layer, see :func:`rls_step`."""

    information: Array
    """Shape (hidden, hidden): weighted sum of mu_1 mu_1ᵀ over the recent past, A."""
    prior: Array  # shape (hidden, hidden): the same of the pretraining, R_0
    anchor: Array  # shape (hidden,): the pretrained output weights
    total: Array  # work space, shape (hidden, hidden); the next two (hidden, hidden) and (hidden,)
    lower: Array
    move: Array
    power: Array
    """Shape (3,): running mean of |mu_1|², its mean in pretraining, and that of noise alone."""


def make_machine(
    shape: LayerSizes,
    delta_scale: float,
    move_scale: float,
    spread: float,
    generator: np.random.Generator,
) -> BoltzmannMachine:
    """Return a machine with well-conditioned random weights and a zero output layer.

    The rows of X_v are orthogonal and of length ``spread``: X_v X_vᵀ = spread² I. In the linear
    range mu_1 = X_vᵀ X_v X_vᵀ eta_0 / 8, so the three passes preserve every direction of eta_0
    equally (at 2 exactly); with independent random weights their condition number is raised to the
    third power. This requires at least as many hidden as visible units.
    """
    square, _ = np.linalg.qr(generator.standard_normal((shape.hidden, shape.visible)))
    visible, hidden = shape.visible, shape.hidden
    return BoltzmannMachine(
        visible_weights=np.ascontiguousarray(spread * square.T),
        output_weights=np.zeros(hidden),
        delta_lags=shape.delta_lags,
        scales=np.array([delta_scale, move_scale], dtype=np.float64),
        lags=np.zeros(visible),
        mu0=np.zeros(hidden),
        eta1=np.zeros(visible),
        mu1=np.zeros(hidden),
    )


def make_rls_state(hidden: int) -> RlsState:
    """Return an initial RLS state; pretraining sets its prior."""
    return RlsState(
        information=np.zeros((hidden, hidden)),
        prior=np.eye(hidden),
        anchor=np.zeros(hidden),
        total=np.zeros((hidden, hidden)),
        lower=np.zeros((hidden, hidden)),
        move=np.zeros(hidden),
        power=np.ones(3),
    )


def make_history(delta_lags: int, move_lags: int, horizon: int) -> History:
    """Return an empty history that is long enough to predict from half a horizon ago."""
    middle = max(horizon // 2, 1)
    length = max(delta_lags, move_lags) + middle
    return History(
        errors=np.zeros(length),
        moves=np.zeros(length),
        offsets=np.zeros(middle),
        residuals=np.zeros(4),
        prediction_mse=np.ones(2),
        persistence_mse=np.ones(2),
        recent_mse=np.zeros(2),
        planned_moves=np.zeros(max(horizon, middle)),
        lagged_errors=np.zeros(delta_lags),
        lagged_moves=np.zeros(move_lags),
        half_horizon=np.zeros(middle),
    )


@kernel
def reset_history(history: History, error: float) -> None:
    """Set the history to a constant ``error`` (rad/s) and zero moves."""
    history.errors[:] = error
    history.moves[:] = 0.0
    history.offsets[:] = 0.0
    history.residuals[:] = 0.0
    history.recent_mse[:] = 0.0


@kernel
def bipolar_sigmoid(y: float) -> float:
    """Return Xi(y) = (1 - exp(-y))/(1 + exp(-y)) = tanh(y/2), equation (40).

    The last form cannot overflow.
    """
    return math.tanh(0.5 * y)


@kernel
def infer_hidden(visible_weights: Array, eta: Array, mu: Array) -> None:
    """Write mu = Xi(X_vᵀ eta), equations (37) and (39), into ``mu``, shape (hidden,)."""
    for j in range(mu.size):
        mu[j] = 0.0
    # By rows, which are contiguous in memory.
    for i in range(eta.size):
        for j in range(mu.size):
            mu[j] += visible_weights[i, j] * eta[i]
    for j in range(mu.size):
        mu[j] = bipolar_sigmoid(mu[j])


@kernel
def infer_visible(visible_weights: Array, mu: Array, eta: Array) -> None:
    """Write eta = Xi(X_v mu), equation (38), into ``eta``, shape (visible,)."""
    for i in range(eta.size):
        total = 0.0
        for j in range(mu.size):
            total += visible_weights[i, j] * mu[j]
        eta[i] = bipolar_sigmoid(total)


@kernel
def set_visible(machine: BoltzmannMachine, errors: Array, moves: Array, first: int) -> None:
    """Write the scaled visible vector (35) into ``machine.lags``, newest lags from ``first`` on.

    The paper's vector contains one v_p only. Further lags are needed because a move acts one
    dead time later; moves[first] is held from the instant of errors[first] on.

    Values are limited to ten scales: beyond, every hidden unit is saturated, and (43) must remain
    finite for any measurement.
    """
    n_errors = machine.delta_lags
    for i in range(n_errors):
        machine.lags[i] = min(max(errors[first + i] / machine.scales[0], -10.0), 10.0)
    for i in range(machine.lags.size - n_errors):
        value = moves[first + i] / machine.scales[1]
        machine.lags[n_errors + i] = min(max(value, -10.0), 10.0)


@kernel
def predict_error(machine: BoltzmannMachine) -> float:
    """Return delta_hat = X_oᵀ mu_1 (36) in rad/s, from ``machine.lags``.

    The order of computation is (39), (38), (37), the reverse of the paper's. The results remain
    in ``machine.mu0``, ``.eta1`` and ``.mu1`` for learning.
    """
    infer_hidden(machine.visible_weights, machine.lags, machine.mu0)
    infer_visible(machine.visible_weights, machine.mu0, machine.eta1)
    infer_hidden(machine.visible_weights, machine.eta1, machine.mu1)
    total: float = 0.0
    for j in range(machine.mu1.size):
        total += machine.output_weights[j] * machine.mu1[j]
    total *= machine.scales[0]
    return total


@kernel
def contrastive_divergence_step(machine: BoltzmannMachine, rate: float) -> None:
    """Update X_v along eta_0 mu_0ᵀ - eta_1 mu_1ᵀ, equation (43), after :func:`predict_error`.

    With the energy (42) this is the slope of E(eta_1, mu_1) - E(eta_0, mu_0) at fixed states:
    the data become more likely than their reconstruction under (41) with E9. The data are limited
    to the range [-1, 1] of a visible unit: no weight is large enough to reconstruct larger
    values, and X_v would grow without bound.
    """
    for i in range(machine.lags.size):
        visible = min(max(machine.lags[i], -1.0), 1.0)
        for j in range(machine.mu0.size):
            machine.visible_weights[i, j] += rate * (
                visible * machine.mu0[j] - machine.eta1[i] * machine.mu1[j]
            )


@kernel
def gradient_step(machine: BoltzmannMachine, error: float, rate: float, floor: float) -> None:
    """Update X_o by rate * error * mu_1 / (floor + |mu_1|²), equation (44) normalised.

    (44) itself is rate * error * mu_1. Normalised by |mu_1|², a rate below 2 is stable at any
    amplitude; without it the useful rate depends on the square of the amplitude. Below ``floor``
    the steps are reduced.
    """
    squared = floor
    for j in range(machine.mu1.size):
        squared += machine.mu1[j] * machine.mu1[j]
    for j in range(machine.mu1.size):
        machine.output_weights[j] += rate * error / machine.scales[0] * machine.mu1[j] / squared


@kernel
def cholesky(matrix: Array, lower: Array) -> bool:
    """Write the Cholesky factor of ``matrix`` into ``lower``; return False without one."""
    for i in range(matrix.shape[0]):
        for k in range(i + 1):
            total = matrix[i, k]
            for j in range(k):
                total -= lower[i, j] * lower[k, j]
            if i == k:
                if not (total > 0.0 and math.isfinite(total)):
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    return True


@kernel
def solve_lower(lower: Array, x: Array) -> None:
    """Replace ``x`` by L⁻¹ x."""
    for i in range(x.size):
        for j in range(i):
            x[i] -= lower[i, j] * x[j]
        x[i] /= lower[i, i]


@kernel
def solve_upper(lower: Array, x: Array) -> None:
    """Replace ``x`` by L⁻ᵀ x."""
    for i in range(x.size - 1, -1, -1):
        for j in range(i + 1, x.size):
            x[i] -= lower[j, i] * x[j]
        x[i] /= lower[i, i]


@kernel
def rls_step(
    machine: BoltzmannMachine,
    rls: RlsState,
    error: float,
    forgetting: float,
    power_forgetting: float,
) -> bool:
    r"""Update X_o by recursive least squares; return False if the matrix is singular.

    .. math:: X_o \leftarrow X_o + (A + R_0)^{-1}
              \left[g \mu_1 (\delta - \hat\delta) + (1 - \lambda) R_0 (X_o^0 - X_o)\right],
              \quad A \leftarrow \lambda A + g \mu_1 \mu_1^T

    (44) with the matrix (A + R_0)^-1 for gamma: recursive least squares that forgets *towards the
    pretrained weights* X_o^0, by ``forgetting``, lambda per step. X_o minimises the sum of
    g lambda^(t-i) (delta_i - X_oᵀ mu_1i)² plus |X_o - X_o^0|² in the metric R_0. Without
    excitation X_o returns to X_o^0, whereas plain forgetting loses information and then bursts.
    The lags of a slow signal are nearly parallel, so a scalar gamma needs thousands of steps where
    this needs dozens. The weight g = (mean |mu_1|² in pretraining) / (recent mean |mu_1|²) is the
    normalisation.
    """
    n = machine.mu1.size
    squared = 0.0
    for j in range(n):
        squared += machine.mu1[j] * machine.mu1[j]
    # Follows a sudden increase at once: one instant has at most ten times the usual weight.
    rls.power[0] = max(
        power_forgetting * rls.power[0] + (1.0 - power_forgetting) * squared, 0.1 * squared
    )
    gain = rls.power[1] / max(rls.power[0], rls.power[2])
    for j in range(n):
        rls.move[j] = gain * machine.mu1[j] * error / machine.scales[0]
        for k in range(n):
            rls.information[j, k] = (
                forgetting * rls.information[j, k] + gain * machine.mu1[j] * machine.mu1[k]
            )
            rls.total[j, k] = rls.information[j, k] + rls.prior[j, k]
            rls.move[j] += (
                (1.0 - forgetting) * rls.prior[j, k] * (rls.anchor[k] - machine.output_weights[k])
            )
    if not cholesky(rls.total, rls.lower):
        return False
    solve_lower(rls.lower, rls.move)
    solve_upper(rls.lower, rls.move)
    for j in range(n):
        machine.output_weights[j] += rls.move[j]
    return True
