# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How the machine learns: CD-1 (43), its output layer (44), and beforehand from a whole run."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.machine import Machine, Memory, look, predict
from t3mpc_ros.mpc.program import factor, solve_lower, solve_upper
from t3mpc_ros.mpc.settings import Excitation, NominalLoop

Array = NDArray[np.float64]


@kernel
def contrast(machine: Machine, rate: float) -> None:
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
def gradient_step(machine: Machine, error: float, rate: float, floor: float) -> None:
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
def recall(machine: Machine, memory: Memory, error: float, keep: float, smooth: float) -> bool:
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
    if not factor(memory.total, memory.lower):
        return False
    solve_lower(memory.lower, memory.move)
    solve_upper(memory.lower, memory.move)
    for j in range(n):
        machine.output_weights[j] += memory.move[j]
    return True


def ridge(features: Array, targets: Array, penalty: float) -> Array:
    """Return the X_o that minimises |targets - features X_o|² + p |X_o|².

    Parameters
    ----------
    features
        mu_1 of each instant, shape (N, hidden).
    targets
        delta of each instant over its scale, shape (N,).
    penalty
        p as a share of the mean of the diagonal of featuresᵀ features.
    """
    square = features.T @ features
    weight = penalty * np.trace(square) / square.shape[0] + np.finfo(np.float64).tiny
    return np.linalg.solve(square + weight * np.eye(square.shape[0]), features.T @ targets)


@kernel
def study(machine: Machine, errors: Array, moves: Array, rate: float, features: Array) -> None:
    """Pass once through a run, oldest first; learn by (43), and write each mu_1.

    errors, moves : newest first, length N; NaN where they are not known
    rate          : gamma of (43), 0 to only look
    features      : row i belongs to errors[i], shape (N - lags, hidden); NaN if a lag is unknown
    """
    n_errors, n_moves = machine.delta_lags, machine.lags.size - machine.delta_lags
    for i in range(features.shape[0] - 1, -1, -1):
        features[i] = errors[i : i + 1 + n_errors].sum() + moves[i + 1 : i + 1 + n_moves].sum()
        if math.isnan(features[i, 0]):
            continue
        look(machine, errors, moves, i + 1)
        predict(machine)
        features[i] = machine.mu1
        contrast(machine, rate)


def pretrain(
    machine: Machine,
    memory: Memory,
    errors: Array,
    moves: Array,
    how: Excitation,
    trust: float,
    noise: float,
) -> None:
    """Teach the machine a run: CD-1 epochs for X_v (43), then ridge regression for X_o.

    Parameters
    ----------
    machine, memory
        Changed in place; the memory then holds the run as its prior.
    errors, moves
        The run, *newest first*, in rad/s and rad/s²: simulated or recorded, NaN in its gaps.
    how
        Epochs, rate and ridge penalty.
    trust
        How many instants of later experience the prior is worth.
    noise
        Standard deviation of an error that is mere noise, rad/s.

    Raises
    ------
    ValueError
        The arrays differ in length, are infinite, or hold too little to fit the output layer.
    """
    lags = max(machine.delta_lags, machine.lags.size - machine.delta_lags)
    count, hidden = max(errors.size - lags, 0), machine.output_weights.size
    if errors.shape != moves.shape or errors.ndim != 1:
        raise ValueError(
            f'errors and moves must be of one length: got {errors.shape}, {moves.shape}'
        )
    if np.isinf((errors, moves)).any():
        raise ValueError('errors and moves must be finite, or NaN in gaps: got inf')
    features = np.zeros((count, hidden))
    for rate in (*[how.contrast_rate] * how.epochs, 0.0):
        study(machine, errors, moves, rate, features)
    known = ~np.isnan(features[:, 0])
    features, targets = features[known], errors[:count][known] / machine.scales[0]
    if targets.size <= hidden:
        raise ValueError(f'errors must hold more than {hidden} finite values: got {targets.size}')
    machine.output_weights[:] = ridge(features, targets, how.ridge)
    square = features.T @ features / targets.size
    mean = float(np.trace(square))
    memory.information[:] = 0.0
    memory.prior[:] = trust * (square + how.ridge * mean / square.shape[0] * np.eye(len(square)))
    memory.anchor[:] = machine.output_weights
    quiet = noise**2 / max(float(np.nanmean(errors**2)), noise**2)
    memory.power[:] = (mean, mean, mean * quiet)


class Timing(NamedTuple):
    """How predictive periods are made of control periods."""

    period: float
    """Control period, s."""
    every: int
    """Control periods per predictive period."""
    average: int
    """Newest control periods, 1 to ``every``, whose errors are averaged to one sample."""

    @property
    def span(self) -> float:
        """Predictive period T, s."""
        return self.period * self.every


def transition(loop: NominalLoop, duration: float) -> Array:
    """Return the exact map of (delta, a, v_p, w, noise) to (delta, a) after ``duration`` s.

    Rows (delta, a), shape (2, 5). The matrix exponential by Taylor series on a scaled-down
    matrix, squared back up.
    """
    gain, lag = loop.feedback_gain, loop.lag
    rates = np.zeros((5, 5))
    rates[0] = (-gain, 1.0, 0.0, 1.0, -gain)
    rates[1] = (0.0, -1.0 / lag, 1.0 / lag, 0.0, 0.0)
    halvings = max(0, math.ceil(math.log2(max(np.abs(rates).sum() * duration, 1e-9))) + 2)
    small = rates * (duration / 2.0**halvings)
    total, term = np.eye(5), np.eye(5)
    for order in range(1, 16):
        term = term @ small / order
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return np.ascontiguousarray(total[:2])


@kernel
def run_nominal(
    step_matrix: Array,
    late_matrix: Array,
    whole_delay: int,
    every: int,
    average: int,
    moves: Array,
    disturbance: Array,
    noise: Array,
    errors: Array,
) -> None:
    """Write the measured errors of the nominal loop, one per predictive period.

    step_matrix, late_matrix : shape (2, 5), transitions of (delta, a) over the first part of a
        control period, where the older v_p still acts, and over the rest; inputs v_p, w, noise
    whole_delay              : whole control periods of dead time
    every, average           : control periods per sample, and measurements in its mean
    moves                    : v_p of each predictive period
    disturbance, noise       : of each control period
    """
    delta, actuator = 0.0, 0.0
    errors[:] = 0.0
    for k in range(errors.size * every):
        # The sample at a predictive instant is the mean of the newest ``average`` measurements.
        if k % every == 0 or k % every > every - average:
            sample = (k + every - 1) // every
            if sample < errors.size:
                errors[sample] += (delta + noise[k]) / average
        for part in range(2):
            sent = k - whole_delay - (1 - part)
            move = moves[sent // every] if sent >= 0 else 0.0
            m = step_matrix if part == 0 else late_matrix
            new = (
                m[0, 0] * delta
                + m[0, 1] * actuator
                + m[0, 2] * move
                + m[0, 3] * disturbance[k]
                + m[0, 4] * noise[k]
            )
            actuator = m[1, 1] * actuator + m[1, 2] * move
            delta = new


def random_levels(generator: np.random.Generator, count: int, mean_hold: float) -> Array:
    """Return ``count`` levels in [-1, 1], each lasting ``mean_hold`` values on average."""
    fresh = generator.random(count) < 1.0 / max(mean_hold, 1.0)
    fresh[0] = True
    levels = generator.uniform(-1.0, 1.0, count)
    held: Array = levels[fresh][np.cumsum(fresh) - 1]
    return held


def excite(
    loop: NominalLoop,
    excitation: Excitation,
    timing: Timing,
    move_scale: float,
    generator: np.random.Generator,
) -> tuple[Array, Array]:
    """Return (errors, moves) of a simulated run, *newest first*, one per predictive period.

    v_p and the disturbance w jump between random levels that last a while on average; v_p
    changes only with the predictive period. The feedback acts on the noisy error.

    Parameters
    ----------
    loop, excitation, timing
        The nominal dynamics, the signals and the periods.
    move_scale
        v_p (rad/s²) of which ``excitation.move`` is a share.
    generator
        Source of every random number.
    """
    count = max(round(excitation.duration / timing.span), 2)
    fine = count * timing.every
    moves = random_levels(generator, count, excitation.move_hold / timing.span)
    moves *= excitation.move * move_scale
    # Levels uniform in [-1, 1] have a standard deviation of 1/sqrt(3).
    disturbance = random_levels(generator, fine, excitation.disturbance_hold / timing.period)
    disturbance *= excitation.disturbance * math.sqrt(3.0)
    noise = excitation.noise * generator.standard_normal(fine)
    errors = _run(loop, timing, moves, disturbance, noise)
    return np.ascontiguousarray(errors[::-1]), np.ascontiguousarray(moves[::-1])


def nominal_step(loop: NominalLoop, timing: Timing, horizon: int) -> Array:
    """Return the true s_0 ... s_{n_p-1} of the nominal loop, in (rad/s)/(rad/s²)."""
    none = np.zeros((horizon + 1) * timing.every)
    return _run(loop, timing, np.ones(horizon + 1), none, none)[1:]


def _run(
    loop: NominalLoop, timing: Timing, moves: Array, disturbance: Array, noise: Array
) -> Array:
    whole, part = divmod(loop.dead_time / timing.period, 1.0)
    errors = np.zeros(moves.size)
    run_nominal(
        transition(loop, part * timing.period),
        transition(loop, (1.0 - part) * timing.period),
        int(whole),
        timing.every,
        timing.average,
        moves,
        disturbance,
        noise,
        errors,
    )
    return errors


def split_runs(errors: Array, moves: Array, outputs: int) -> list[list[tuple[Array, Array]]]:
    """Return for each output the first three quarters and the rest of a run, *newest first*.

    Of the rest it is the longest stretch without a gap: a trial goes through it step by step.

    Parameters
    ----------
    errors, moves
        A recorded run, oldest first, shape (N, outputs); NaN where it is not known.

    Raises
    ------
    ValueError
        The two do not have one shape, or not as many columns as there are outputs.
    """
    if errors.shape != moves.shape or errors.shape[1:] != (outputs,):
        raise ValueError(
            f'errors and moves must be (N, {outputs}): got {errors.shape}, {moves.shape}'
        )
    cut = (3 * len(errors)) // 4
    gaps = cut + np.flatnonzero(np.isnan(errors[cut:] + moves[cut:]).any(axis=1))
    edges = [cut - 1, *gaps.tolist(), len(errors)]
    longest = int(np.argmax(np.diff(edges)))
    rest = slice(edges[longest] + 1, edges[longest + 1])
    return [
        [
            (
                np.ascontiguousarray(errors[part, z][::-1]),
                np.ascontiguousarray(moves[part, z][::-1]),
            )
            for part in (slice(None, cut), rest)
        ]
        for z in range(outputs)
    ]
