# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How well the machine predicts while it runs, and how much of v_p that is worth."""

from collections.abc import Mapping
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.machine import Machine, Past, begin, look, make_past, predict
from t3mpc_ros.mpc.response import roll_forward
from t3mpc_ros.mpc.settings import Excitation, PredictiveSettings
from t3mpc_ros.mpc.training import (
    Memory,
    contrast,
    gradient_step,
    make_memory,
    pretrain,
    recall,
)

Array = NDArray[np.float64]


class Learning(NamedTuple):
    """How a machine learns and is scored while it runs: plain numbers, for kernels."""

    recursive: bool
    """Whether by least squares (:func:`recall`) or else by the normalised gradient (44)."""
    contrast_rate: float
    """gamma of (43)."""
    output_rate: float
    """gamma of (44), normalised."""
    keep: float
    """lambda of :func:`recall`, per predictive period, as the next two."""
    smooth: float
    skill_keep: float
    offset_gain: float
    """Share of the latest miss that the offset e takes in."""
    noise: float
    """Standard deviation of an error that is mere noise (rad/s)."""

    @classmethod
    def of(cls, settings: PredictiveSettings, span: float) -> Self:
        """Return what the settings mean for a predictive period of ``span`` s."""
        return cls(
            recursive=settings.learner == 'recursive',
            contrast_rate=settings.contrast_rate,
            output_rate=settings.output_rate,
            keep=math.exp(-span / settings.memory),
            smooth=math.exp(-span / 2.0),
            skill_keep=math.exp(-span / settings.skill_memory),
            offset_gain=settings.offset_gain,
            noise=settings.noise,
        )


@kernel
def gather(
    errors: Array, jumps: Array, applied: Array, sampled: bool, sums: Array, applied_sums: Array
) -> bool:
    """Add a control period to the sums of a sample; return False if an error is not finite."""
    for z in range(errors.size):
        if not math.isfinite(errors[z]):
            return False
    for z in range(errors.size):
        applied_sums[z] += applied[z]
        if sampled:
            sums[z] += errors[z] - jumps[z]
    return True


@kernel
def tally(past: Past, which: int, keep: float, noise: float) -> None:
    """Weigh the latest misses into the mean squares that :func:`skill` compares.

    When the error hardly moves, machine and persistence both miss by mere noise and their ratio
    says nothing. So evidence weighs power / (power + (2 noise)²): persistence alone misses
    independent noise by sqrt(2) of it. Forgetting slows down alike: in quiet times the figure
    stays what it last was. The power is a short mean, because weighing each pair by its own
    size would pick instants.

    which : 0 for one step ahead, 1 for the middle of the horizon
    keep  : share of the past kept per step at full evidence
    noise : standard deviation of an error that is mere noise (rad/s)
    """
    missed = past.misses[2 * which] * past.misses[2 * which]
    persisted = past.misses[2 * which + 1] * past.misses[2 * which + 1]
    past.recent[which] += 0.1 * (persisted - past.recent[which])
    power = past.recent[which]
    if power > 0.0:
        share = (1.0 - keep) * power / (power + 4.0 * noise * noise)
        past.predicted[which] += share * (missed - past.predicted[which])
        past.persisted[which] += share * (persisted - past.persisted[which])


@kernel
def skill(past: Past, which: int) -> float:
    """Return 1 - mean(prediction error²)/mean(persistence error²): 1 perfect, 0 no better.

    Mean squares, not variances: a constant miss is a miss.
    """
    ratio: float = past.predicted[which] / max(past.persisted[which], 1e-300)
    return 1.0 - ratio


@kernel
def smooth_step(x: float, low: float, high: float) -> float:
    """Return 0 below ``low``, 1 above ``high``, and the cubic with flat ends in between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@kernel
def fade(
    score: float, gain: float, low: float, high: float, gain_low: float, gain_high: float
) -> float:
    """Return the share of v_p's bound that the machine deserves, in [0, 1].

    score : skill; no share at or below ``low``, the whole from ``high``
    gain  : the machine's step response half a horizon ahead over the nominal one; no share at or
            below ``gain_low``, the whole from ``gain_high``. An error that dies away by itself
            can be predicted without knowing what v_p does, so skill alone would trust a machine
            whose v_p has the wrong sign, or no effect. Too large a response only makes moves
            smaller, and needs no bound.
    """
    return smooth_step(score, low, high) * smooth_step(gain, gain_low, gain_high)


@kernel
def observe(
    machine: Machine,
    memory: Memory,
    past: Past,
    error: float,
    applied: float,
    score: bool,
    learn: bool,
    how: Learning,
) -> None:
    """Take in a measured error, score the predictions of it, learn, and renew the offset e.

    error   : the newest tracking error (rad/s)
    applied : v_p that was applied since the one before (rad/s²)
    score   : whether the past is long enough for the predictions to count
    learn   : whether weights may change
    """
    for i in range(past.errors.size - 1, 0, -1):
        past.errors[i] = past.errors[i - 1]
        past.moves[i] = past.moves[i - 1]
    past.errors[0] = error
    past.moves[1] = applied

    middle = past.offsets.size
    # What the machine would have said half a horizon ago, had it known the moves made since.
    for i in range(middle):
        past.planned[i] = past.moves[middle - i]
    roll_forward(machine, past, middle, past.offsets[middle - 1], past.ahead)
    look(machine, past.errors, past.moves, 1)
    missed = error - predict(machine) - past.offsets[0]
    # Squares of absurd values must not overflow.
    most = 10.0 * machine.scales[0]
    past.misses[0] = min(max(missed, -most), most)
    past.misses[1] = min(max(error - past.errors[1], -most), most)
    past.misses[2] = min(max(error - past.ahead[middle - 1], -most), most)
    past.misses[3] = min(max(error - past.errors[middle], -most), most)
    if score:
        tally(past, 0, how.skill_keep, how.noise)
        tally(past, 1, how.skill_keep, how.noise)
    # A miss beyond the machine's whole range is a fault or a blow, and teaches nothing.
    if learn and abs(missed) < machine.scales[0]:
        # From what the offset leaves unexplained: a steady disturbance is not dynamics.
        if how.recursive:
            recall(machine, memory, missed, how.keep, how.smooth)
        else:
            gradient_step(machine, missed, how.output_rate, memory.power[2])
        contrast(machine, how.contrast_rate)
    for i in range(middle - 1, 0, -1):
        past.offsets[i] = past.offsets[i - 1]
    past.offsets[0] += how.offset_gain * past.misses[0]


@kernel
def rehearse(
    machine: Machine, memory: Memory, past: Past, errors: Array, moves: Array, how: Learning
) -> None:
    """Set the mean squares of ``past`` to those over a whole run, learning nothing.

    errors, moves : *newest first*, longer than the past
    """
    past.predicted[:] = 0.0
    past.persisted[:] = 0.0
    count = errors.size - 1 - past.errors.size
    for i in range(errors.size - 2, -1, -1):
        observe(machine, memory, past, errors[i], moves[i + 1], False, False, how)
        if i < count:
            for which in range(2):
                missed, persisted = past.misses[2 * which], past.misses[2 * which + 1]
                past.predicted[which] += missed * missed / count
                past.persisted[which] += persisted * persisted / count


class Predictor:
    """One output's machine, with its memory, its past and a run to try it on.

    Parameters
    ----------
    machine
        Shapes and first weights.
    horizon
        n_p.
    trial
        (errors, moves) of a run it is not taught, *newest first*.

    Raises
    ------
    ValueError
        The trial is too short to predict anything in it.
    """

    def __init__(self, machine: Machine, horizon: int, trial: tuple[Array, Array]) -> None:
        self.machine = machine
        self.memory = make_memory(machine.output_weights.size)
        delta_lags = machine.delta_lags
        self.past = make_past(delta_lags, machine.lags.size - delta_lags, horizon)
        if trial[0].size <= self.past.errors.size + 1:
            raise ValueError(
                f'trial must be longer than {self.past.errors.size + 1}: got {trial[0].size}'
            )
        self._trial = trial

    def teach(
        self, errors: Array, moves: Array, how: Excitation, trust: float, learning: Learning
    ) -> None:
        """Learn a run (*newest first*) as :func:`pretrain` does; the trial gives the skill."""
        pretrain(self.machine, self.memory, errors, moves, how, trust, learning.noise)
        self.try_out(learning)

    def try_out(self, learning: Learning) -> None:
        """Set the skill to that on the trial run, and forget the past."""
        begin(self.past, 0.0)
        rehearse(self.machine, self.memory, self.past, *self._trial, learning)
        begin(self.past, 0.0)

    def weights(self) -> dict[str, Array]:
        """Return copies of everything learnt, and the scales it is for."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def set_weights(self, weights: Mapping[str, Array], learning: Learning) -> None:
        """Take over what :meth:`weights` returned, checked by the caller; then try it out."""
        for name, array in self._arrays().items():
            array[:] = weights[name]
        self.try_out(learning)

    def _arrays(self) -> dict[str, Array]:
        return {
            'visible_weights': self.machine.visible_weights,
            'output_weights': self.machine.output_weights,
            'scales': self.machine.scales,
            'anchor': self.memory.anchor,
            'prior': self.memory.prior,
            'information': self.memory.information,
            'power': self.memory.power,
        }
