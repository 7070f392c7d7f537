# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Boltzmann machine that predicts the tracking error of one wheel, (35)-(44) with E9."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.quadratic_program import cholesky, solve_lower, solve_upper

Array = NDArray[np.float64]


class LayerSizes(NamedTuple):
    """How many past values the machine sees, and how many hidden units it has."""

    delta_lags: int
    """The paper's tau: past tracking errors in (35)."""
    move_lags: int
    """Past predictive signals; (35) has one, which cannot cover a dead time."""
    hidden: int

    @property
    def visible(self) -> int:
        """Length of the visible vector (35)."""
        return self.delta_lags + self.move_lags


class BoltzmannMachine(NamedTuple):
    """Weights of one machine and its working memory; kernels change the arrays in place."""

    visible_weights: Array
    """X_v, shape (visible, hidden)."""
    output_weights: Array
    """X_o, shape (hidden,)."""
    delta_lags: int
    """How many of the visible units are tracking errors; the rest are predictive signals."""
    scales: Array
    """(delta_scale in rad/s, move_scale in rad/s²)."""
    lags: Array
    """Shape (visible,): eta_0 of the latest pass, (35)."""
    mu0: Array
    """Shape (hidden,): (39)."""
    eta1: Array
    """Shape (visible,): (38), the reconstruction of eta_0."""
    mu1: Array
    """Shape (hidden,): (37), the features the output layer sees."""


class History(NamedTuple):
    """What one output has seen, newest first, and how it was predicted; kernels change it."""

    errors: Array
    """Tracking errors (rad/s): errors[0] is the latest."""
    moves: Array
    """Applied v_p (rad/s²): moves[i] was held from errors[i] on; moves[0] is not known yet."""
    offsets: Array
    """Offsets e (rad/s) in force after each instant, shape (middle,)."""
    misses: Array
    """Latest errors (rad/s) of machine and persistence: one step, then middle of the horizon."""
    predicted: Array
    """Mean squares of the machine's errors, (rad/s)²: one step, middle."""
    persistence_mse: Array
    """The same of persistence, which predicts that nothing changes."""
    recent: Array
    """The same over a second or so: tells whether there is anything to predict."""
    planned: Array
    """Working memory, shape (n_p,); the next are delta_lags, move_lags and middle long."""
    lagged_errors: Array
    lagged_moves: Array
    ahead: Array


class RlsState(NamedTuple):
    """What the output layer remembers, see ``training.recall``; kernels change it in place."""

    information: Array
    """Shape (hidden, hidden): weighted sum of mu_1 mu_1ᵀ over the recent past."""
    prior: Array
    """Shape (hidden, hidden): the same of the pre-training, R_0."""
    anchor: Array
    """Shape (hidden,): the pre-trained output weights."""
    total: Array
    """Working memory, shape (hidden, hidden), then (hidden, hidden) and (hidden,)."""
    lower: Array
    move: Array
    power: Array
    """Shape (3,): running mean of |mu_1|², its mean in pre-training, and that of mere noise."""


@kernel
def table_view(store: Array, first: int, rows: int, columns: int) -> Array:
    """Return a part of a flat store as a table, shape (rows, columns): a view, no copy."""
    return store[first : first + rows * columns].reshape((rows, columns))


@kernel
def machine_size(delta_lags: int, move_lags: int, hidden: int) -> int:
    """Return how many numbers make a machine."""
    return (delta_lags + move_lags) * (hidden + 2) + 3 * hidden + 2


@kernel
def machine_view(store: Array, delta_lags: int, move_lags: int, hidden: int) -> BoltzmannMachine:
    """Return the views of a flat store that are a machine.

    A call from Python costs time for every array, so whoever calls kernels often hands them one
    store in place of a dozen arrays.
    """
    visible = delta_lags + move_lags
    hidden_rows = table_view(store, visible * hidden, 3, hidden)
    visible_rows = table_view(store, (visible + 3) * hidden, 2, visible)
    return BoltzmannMachine(
        table_view(store, 0, visible, hidden),
        hidden_rows[0],
        delta_lags,
        store[store.size - 2 :],
        visible_rows[0],
        hidden_rows[1],
        visible_rows[1],
        hidden_rows[2],
    )


@kernel
def rls_state_size(hidden: int) -> int:
    """Return how many numbers make a memory."""
    return 4 * hidden * hidden + 2 * hidden + 3


@kernel
def rls_state_view(store: Array, hidden: int) -> RlsState:
    """Return the views of a flat store that are a memory."""
    square = hidden * hidden
    rows = table_view(store, 4 * square, 2, hidden)
    return RlsState(
        table_view(store, 0, hidden, hidden),
        table_view(store, square, hidden, hidden),
        rows[0],
        table_view(store, 2 * square, hidden, hidden),
        table_view(store, 3 * square, hidden, hidden),
        rows[1],
        store[store.size - 3 :],
    )


@kernel
def history_size(delta_lags: int, move_lags: int, horizon: int) -> int:
    """Return how many numbers make a past."""
    middle = max(horizon // 2, 1)
    length = max(delta_lags, move_lags) + middle
    return 2 * length + 2 * middle + max(horizon, middle) + delta_lags + move_lags + 10


@kernel
def history_view(store: Array, delta_lags: int, move_lags: int, horizon: int) -> History:
    """Return the views of a flat store that are a past, long enough to predict half a horizon."""
    middle = max(horizon // 2, 1)
    length = max(delta_lags, move_lags) + middle
    lengths = table_view(store, 0, 2, length)
    middles = table_view(store, 2 * length, 2, middle)
    pairs = table_view(store, 2 * (length + middle), 5, 2)
    rest = store[2 * (length + middle) + 10 :]
    return History(
        lengths[0],
        lengths[1],
        middles[0],
        store[2 * (length + middle) : 2 * (length + middle) + 4],
        pairs[2],
        pairs[3],
        pairs[4],
        rest[delta_lags + move_lags :],
        rest[:delta_lags],
        rest[delta_lags : delta_lags + move_lags],
        middles[1],
    )


def make_machine(
    shape: LayerSizes,
    delta_scale: float,
    move_scale: float,
    spread: float,
    generator: np.random.Generator,
) -> BoltzmannMachine:
    """Return a machine with small, well-conditioned random weights and a zero output layer.

    The rows of X_v are orthogonal and of length ``spread``: X_v X_vᵀ = spread² I. In the linear
    range mu_1 = X_vᵀ X_v X_vᵀ eta_0 / 8, so the three passes keep all of eta_0 and favour no
    direction of it. Independent random weights would raise their condition number to the third
    power. This needs as many hidden as visible units.

    Parameters
    ----------
    shape
        Sizes of the layers.
    delta_scale, move_scale
        What counts as 1 inside the machine: rad/s and rad/s².
    spread
        Length of each row of X_v; at 2 an eta_0 in the linear range is reconstructed whole.
    generator
        Source of the random directions.

    Raises
    ------
    ValueError
        Fewer hidden than visible units, a lag count below one, or a scale that is not positive.
    """
    if shape.delta_lags < 1 or shape.move_lags < 1:
        raise ValueError(f'shape must have at least one lag of each kind: got {shape}')
    if shape.hidden < shape.visible:
        raise ValueError(
            f'hidden must be at least the {shape.visible} visible units: got {shape.hidden}'
        )
    if not (delta_scale > 0.0 and move_scale > 0.0 and spread > 0.0):
        raise ValueError(
            f'scales and spread must be positive: got {delta_scale}, {move_scale}, {spread}'
        )
    square, _ = np.linalg.qr(generator.standard_normal((shape.hidden, shape.visible)))
    size = machine_size(shape.delta_lags, shape.move_lags, shape.hidden)
    machine = machine_view(np.zeros(size), shape.delta_lags, shape.move_lags, shape.hidden)
    machine.visible_weights[:] = spread * square.T
    machine.scales[:] = (delta_scale, move_scale)
    return machine


def make_rls_state(hidden: int) -> RlsState:
    """Return an empty memory; its prior is filled by ``training.pretrain``."""
    memory = rls_state_view(np.zeros(rls_state_size(hidden)), hidden)
    memory.prior[:] = np.eye(hidden)
    memory.power[:] = 1.0
    return memory


def make_history(delta_lags: int, move_lags: int, horizon: int) -> History:
    """Return an empty past that is long enough to predict from half a horizon ago."""
    size = history_size(delta_lags, move_lags, horizon)
    past = history_view(np.zeros(size), delta_lags, move_lags, horizon)
    past.predicted[:] = 1.0
    past.persistence_mse[:] = 1.0
    return past


@kernel
def reset_history(past: History, error: float) -> None:
    """Make the past as if ``error`` (rad/s) had always been measured, and nothing done."""
    past.errors[:] = error
    past.moves[:] = 0.0
    past.offsets[:] = 0.0
    past.misses[:] = 0.0
    past.recent[:] = 0.0


@kernel
def bipolar_sigmoid(y: float) -> float:
    """Return Xi(y) = (1 - exp(-y))/(1 + exp(-y)) = tanh(y/2), equation (40).

    The second form cannot overflow.
    """
    return math.tanh(0.5 * y)


@kernel
def infer_hidden(visible_weights: Array, eta: Array, mu: Array) -> None:
    """Write mu = Xi(X_vᵀ eta), equations (37) and (39), into ``mu``, shape (hidden,)."""
    for j in range(mu.size):
        mu[j] = 0.0
    # Along the rows, which lie together in memory.
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
    """Write the scaled visible vector (35) into ``machine.lags``.

    The paper's vector holds one v_p only. Further lags are needed because a move that left one
    dead time ago acts only now.

    errors : delta, newest first (rad/s), at least first + delta_lags values
    moves  : v_p, newest first (rad/s²), at least first + move_lags values; moves[first] is held
             from the instant of errors[first] on
    first  : where the newest lag stands: 0 to predict the future, more to predict the past again

    Values beyond ten scales are cut to ten: there every hidden unit is saturated anyway, and
    (43) must stay finite whatever is measured.
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

    The passes run (39), (38), (37): the paper prints them in the reverse order of computing.
    They stay in ``machine.mu0``, ``.eta1`` and ``.mu1`` for learning.
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
def energy(visible_weights: Array, eta: Array, mu: Array) -> float:
    """Return E(eta, mu) = -etaᵀ X_v mu, equation (42); dimensionless."""
    total = 0.0
    for i in range(eta.size):
        for j in range(mu.size):
            total -= eta[i] * visible_weights[i, j] * mu[j]
    return total


@kernel
def free_energy(visible_weights: Array, eta: Array) -> float:
    """Return F(eta) = -ln of the sum of exp(-E/2) over every mu in {-1, 1}^hidden.

    The hidden units of (42) do not meet, so the sum is a product of 2 cosh(X_vᵀ eta / 2).
    """
    total = 0.0
    for j in range(visible_weights.shape[1]):
        y = 0.0
        for i in range(eta.size):
            y += visible_weights[i, j] * eta[i]
        # ln(2 cosh(y/2)) without overflow.
        total -= 0.5 * abs(y) + math.log1p(math.exp(-abs(y)))
    return total


def boltzmann_distribution(energies: Array) -> Array:
    """Return the Boltzmann probability of each state, exp(-E/2) / sum exp(-E/2), (41) with E9.

    E9: the printed J' = delta^E / E is no distribution. The temperature is 2 because Xi (40),
    the tanh of *half* its argument, is the mean of a unit in {-1, 1} at exactly that
    temperature; at temperature 1 the passes (36)-(39) would not sample from (41). It only
    scales X_v, and its gradient only scales gamma in (43).

    Parameters
    ----------
    energies
        E of every state that can occur, equation (42).
    """
    weights: Array = np.exp(-0.5 * (energies - energies.min()))
    weights /= weights.sum()
    return weights


@kernel
def contrastive_divergence_step(machine: BoltzmannMachine, rate: float) -> None:
    """Move X_v along eta_0 mu_0ᵀ - eta_1 mu_1ᵀ, equation (43), after :func:`predict`.

    With the energy (42) this is the slope of E(eta_1, mu_1) - E(eta_0, mu_0) at fixed states:
    the data become likelier than their own reconstruction under (41) with E9. A visible unit
    lives in [-1, 1]; what lies beyond is cut, or no weight would be large enough to reconstruct
    it and X_v would grow for ever.
    """
    for i in range(machine.lags.size):
        seen = min(max(machine.lags[i], -1.0), 1.0)
        for j in range(machine.mu0.size):
            machine.visible_weights[i, j] += rate * (
                seen * machine.mu0[j] - machine.eta1[i] * machine.mu1[j]
            )


@kernel
def gradient_step(machine: BoltzmannMachine, error: float, rate: float, floor: float) -> None:
    """Move X_o by rate * error * mu_1 / (floor + |mu_1|²), equation (44) normalised.

    (44) itself is rate * error * mu_1. Divided by |mu_1|², a rate below 2 is stable at any
    amplitude; with the plain form the useful rate depends on the square of the amplitude.

    error : delta - delta_hat (rad/s)
    floor : share of |mu_1|² (dimensionless) below which steps get shorter
    """
    squared = floor
    for j in range(machine.mu1.size):
        squared += machine.mu1[j] * machine.mu1[j]
    for j in range(machine.mu1.size):
        machine.output_weights[j] += rate * error / machine.scales[0] * machine.mu1[j] / squared


@kernel
def rls_step(
    machine: BoltzmannMachine, memory: RlsState, error: float, keep: float, smooth: float
) -> bool:
    r"""Move X_o to the best fit of the recent past, given the pre-training; False if it cannot.

    .. math:: X_o \leftarrow X_o + (A + R_0)^{-1}
              \left[g \mu_1 (\delta - \hat\delta) + (1 - \lambda) R_0 (X_o^0 - X_o)\right],
              \quad A \leftarrow \lambda A + g \mu_1 \mu_1^T

    (44) with the matrix (A + R_0)^-1 for gamma: recursive least squares that forgets *towards the
    pre-trained weights* X_o^0. X_o minimises the sum of g lambda^(t-i) (delta_i - X_oᵀ mu_1i)²
    plus |X_o - X_o^0|² in the metric R_0. Plain forgetting would lose what a quiet time cannot
    show, and burst afterwards; this falls back to X_o^0. The lags of a slow signal are nearly
    parallel, so that a scalar gamma needs thousands of steps where this needs dozens. The weight
    g = (mean |mu_1|² in pre-training) / (recent mean |mu_1|²) is the normalisation.

    error  : delta - delta_hat (rad/s)
    keep   : lambda, share of the past kept per step
    smooth : share of the recent mean of |mu_1|² kept per step
    """
    n = machine.mu1.size
    squared = 0.0
    for j in range(n):
        squared += machine.mu1[j] * machine.mu1[j]
    # Rises at once with a sudden signal, so that no instant weighs more than ten ordinary ones.
    memory.power[0] = max(smooth * memory.power[0] + (1.0 - smooth) * squared, 0.1 * squared)
    gain = memory.power[1] / max(memory.power[0], memory.power[2])
    for j in range(n):
        memory.move[j] = gain * machine.mu1[j] * error / machine.scales[0]
        for k in range(n):
            memory.information[j, k] = (
                keep * memory.information[j, k] + gain * machine.mu1[j] * machine.mu1[k]
            )
            memory.total[j, k] = memory.information[j, k] + memory.prior[j, k]
            memory.move[j] += (
                (1.0 - keep) * memory.prior[j, k] * (memory.anchor[k] - machine.output_weights[k])
            )
    if not cholesky(memory.total, memory.lower):
        return False
    solve_lower(memory.lower, memory.move)
    solve_upper(memory.lower, memory.move)
    for j in range(n):
        machine.output_weights[j] += memory.move[j]
    return True
