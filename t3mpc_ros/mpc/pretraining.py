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
"""Pretraining of the Boltzmann machine on a simulated or recorded run."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.boltzmann_machine import (
    BoltzmannMachine,
    RlsState,
    contrastive_divergence_step,
    predict_error,
    set_visible,
)
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class NominalLoopParameters(Parameters):
    """Nominal error dynamics, on which the machine is pretrained.

    delta' = -K (delta + noise) + a + w,   lag a' = v_p(t - dead_time) - a.
    """

    feedback_gain: float = parameter(
        8.0, 'feedback K; the controller replaces it by its own', '1/s', (0.01, 1000.0)
    )
    lag: float = parameter(0.02, 'time constant from v_p to acceleration', 's', (1e-3, 1.0))
    dead_time: float = parameter(0.01, 'dead time of v_p', 's', (0.0, 1.0))


@dataclass(frozen=True)
class ExcitationParameters(Parameters):
    """Simulated run of the pretraining, and the learning from it."""

    duration: float = parameter(240.0, 'length of the run', 's', (10.0, 3600.0))
    move: float = parameter(
        0.5, 'maximum v_p of the random levels, as a fraction of its scale', bounds=(0.01, 2.0)
    )
    move_hold: float = parameter(0.3, 'mean duration of a level of v_p', 's', (0.01, 100.0))
    disturbance: float = parameter(
        2.0, 'standard deviation of the disturbance w', 'rad/s²', (0.0, 1000.0)
    )
    disturbance_hold: float = parameter(
        2.0,
        'mean duration of a level of w, which the machine learns to expect',
        's',
        (0.01, 1000.0),
    )
    noise: float = parameter(
        0.15, 'standard deviation of the measured error', 'rad/s', (0.0, 10.0)
    )
    epochs: int = parameter(2, 'epochs of CD-1 (43) over the run', bounds=(0, 100))
    contrast_rate: float = parameter(0.002, 'gamma of (43) in pretraining', bounds=(0.0, 1.0))
    ridge: float = parameter(
        1e-6,
        'ridge penalty, as a fraction of the mean square of the features',
        bounds=(1e-12, 1.0),
    )


def ridge_regression(features: Array, targets: Array, penalty: float) -> Array:
    """Return the X_o that minimises |targets - features X_o|² + p |X_o|².

    Features are the mu_1 of each instant, targets its delta over the scale; ``penalty`` is p as a
    fraction of the mean of the diagonal of featuresᵀ features.
    """
    square = features.T @ features
    weight = penalty * np.trace(square) / square.shape[0] + np.finfo(np.float64).tiny
    return np.linalg.solve(square + weight * np.eye(square.shape[0]), features.T @ targets)


@kernel
def contrastive_divergence_epoch(
    machine: BoltzmannMachine, errors: Array, moves: Array, rate: float, features: Array
) -> None:
    """Learn from every instant of a run by (43), oldest first, and write each mu_1.

    Errors and moves are newest first, NaN where unknown; row i of the features belongs to
    errors[i], and is NaN if a lag is unknown.
    """
    n_errors, n_moves = machine.delta_lags, machine.lags.size - machine.delta_lags
    for i in range(features.shape[0] - 1, -1, -1):
        known = 0.0
        for j in range(n_errors + 1):
            known += errors[i + j]
        for j in range(n_moves):
            known += moves[i + 1 + j]
        if math.isnan(known):
            features[i] = math.nan
            continue
        set_visible(machine, errors, moves, i + 1)
        predict_error(machine)
        for j in range(machine.mu1.size):
            features[i, j] = machine.mu1[j]
        contrastive_divergence_step(machine, rate)


def pretrain(
    machine: BoltzmannMachine,
    rls: RlsState,
    errors: Array,
    moves: Array,
    excitation: ExcitationParameters,
    trust: float,
    noise: float,
) -> None:
    """Fit the machine to a run: CD-1 epochs for X_v (43), then ridge regression for X_o.

    machine, rls : changed in place; the run becomes the prior of the RLS state
    errors, moves : the run, *newest first*, simulated or recorded, NaN in gaps
    trust : weight of the prior, as a number of later instants
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
    for rate in (*[excitation.contrast_rate] * excitation.epochs, 0.0):
        contrastive_divergence_epoch(machine, errors, moves, rate, features)
    known = ~np.isnan(features[:, 0])
    features, targets = features[known], errors[:count][known] / machine.scales[0]
    if targets.size <= hidden:
        raise ValueError(f'errors must hold more than {hidden} finite values: got {targets.size}')
    machine.output_weights[:] = ridge_regression(features, targets, excitation.ridge)
    square = features.T @ features / targets.size
    mean = float(np.trace(square))
    rls.information[:] = 0.0
    rls.prior[:] = trust * (
        square + excitation.ridge * mean / square.shape[0] * np.eye(len(square))
    )
    rls.anchor[:] = machine.output_weights
    quiet = noise**2 / max(float(np.nanmean(errors**2)), noise**2)
    rls.power[:] = (mean, mean, mean * quiet)


class SampleTiming(NamedTuple):
    """Control period, predictive period, and averaging of the errors."""

    period: float  # control period, s
    decimation: int  # control periods per predictive period
    average: int  # number of newest errors, 1 to ``decimation``, in the mean of one sample

    @property
    def span(self) -> float:
        """Predictive period T, s."""
        return self.period * self.decimation


def nominal_transition(loop: NominalLoopParameters, duration: float) -> Array:
    """Return the exact map of (delta, a, v_p, w, noise) to (delta, a) after ``duration`` s."""
    gain, lag = loop.feedback_gain, loop.lag
    rates = np.zeros((5, 5))
    rates[0] = (-gain, 1.0, 0.0, 1.0, -gain)
    rates[1] = (0.0, -1.0 / lag, 1.0 / lag, 0.0, 0.0)
    return np.ascontiguousarray(matrix_exponential(rates * duration)[:2])


def matrix_exponential(matrix: Array) -> Array:
    """Return exp of a square matrix by scaling, a Taylor series of 15 terms, and squaring."""
    halvings = max(0, math.ceil(math.log2(max(np.abs(matrix).sum(), 1e-9))) + 2)
    small = matrix / 2.0**halvings
    total, term = np.eye(len(matrix)), np.eye(len(matrix))
    for order in range(1, 16):
        term = term @ small / order
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


@kernel
def simulate_nominal_loop(
    step_matrix: Array,
    late_matrix: Array,
    whole_delay: int,
    decimation: int,
    average: int,
    moves: Array,
    disturbance: Array,
    noise: Array,
    errors: Array,
) -> None:
    """Write the measured errors of the nominal loop, one per predictive period.

    The matrices are the transitions of (delta, a) over the first part of a control period, in
    which the older v_p acts, and over the rest. Moves are per predictive period, disturbance and
    noise per control period; the dead time has ``whole_delay`` control periods.
    """
    delta, actuator = 0.0, 0.0
    errors[:] = 0.0
    for k in range(errors.size * decimation):
        # The sample of a predictive period is the mean of the newest ``average`` measurements.
        if k % decimation == 0 or k % decimation > decimation - average:
            sample = (k + decimation - 1) // decimation
            if sample < errors.size:
                errors[sample] += (delta + noise[k]) / average
        for part in range(2):
            sent = k - whole_delay - (1 - part)
            move = moves[sent // decimation] if sent >= 0 else 0.0
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
    """Return ``count`` random levels in [-1, 1], held for ``mean_hold`` values on average."""
    fresh = generator.random(count) < 1.0 / max(mean_hold, 1.0)
    fresh[0] = True
    levels = generator.uniform(-1.0, 1.0, count)
    held: Array = levels[fresh][np.cumsum(fresh) - 1]
    return held


def simulate_excitation(
    loop: NominalLoopParameters,
    excitation: ExcitationParameters,
    timing: SampleTiming,
    move_scale: float,
    generator: np.random.Generator,
) -> tuple[Array, Array]:
    """Return (errors, moves) of a simulated run, *newest first*, one per predictive period.

    v_p and the disturbance w are random levels of a given mean duration; v_p changes only with
    the predictive period. The feedback acts on the noisy error.
    """
    count = max(round(excitation.duration / timing.span), 2)
    fine = count * timing.decimation
    moves = random_levels(generator, count, excitation.move_hold / timing.span)
    moves *= excitation.move * move_scale
    # Levels uniform in [-1, 1] have a standard deviation of 1/sqrt(3).
    disturbance = random_levels(generator, fine, excitation.disturbance_hold / timing.period)
    disturbance *= excitation.disturbance * math.sqrt(3.0)
    noise = excitation.noise * generator.standard_normal(fine)
    errors = _simulate(loop, timing, moves, disturbance, noise)
    return np.ascontiguousarray(errors[::-1]), np.ascontiguousarray(moves[::-1])


def nominal_step_response(
    loop: NominalLoopParameters, timing: SampleTiming, horizon: int
) -> Array:
    """Return s_0 ... s_{n_p-1} of the nominal loop, in (rad/s)/(rad/s²)."""
    none = np.zeros((horizon + 1) * timing.decimation)
    return _simulate(loop, timing, np.ones(horizon + 1), none, none)[1:]


def _simulate(
    loop: NominalLoopParameters,
    timing: SampleTiming,
    moves: Array,
    disturbance: Array,
    noise: Array,
) -> Array:
    whole, part = divmod(loop.dead_time / timing.period, 1.0)
    errors = np.zeros(moves.size)
    simulate_nominal_loop(
        nominal_transition(loop, part * timing.period),
        nominal_transition(loop, (1.0 - part) * timing.period),
        int(whole),
        timing.decimation,
        timing.average,
        moves,
        disturbance,
        noise,
        errors,
    )
    return errors
