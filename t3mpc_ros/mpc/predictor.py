# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Predictor of one wheel: online learning, prediction skill and authority."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.boltzmann_machine import (
    BoltzmannMachine,
    History,
    RlsState,
    contrastive_divergence_step,
    gradient_step,
    history_size,
    history_view,
    machine_size,
    machine_view,
    make_history,
    make_rls_state,
    predict_error,
    reset_history,
    rls_state_size,
    rls_state_view,
    rls_step,
    set_visible,
)
from t3mpc_ros.mpc.prediction import roll_forward
from t3mpc_ros.mpc.pretraining import ExcitationParameters, NominalLoopParameters, pretrain
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PredictiveParameters(Parameters):
    """Horizon, bounds, machine, learning and fading of the predictive term."""

    enabled: bool = parameter(
        True, 'whether v_p is applied; when not, the machine still learns', dynamic=True
    )
    decimation: int = parameter(
        5, 'control periods per predictive period T; n_p T should reach 3/K', low=1, high=100
    )
    average: int = parameter(
        5, 'newest errors averaged to one sample, at most every', low=1, high=100
    )
    horizon: int = parameter(10, 'n_p', low=1, high=50)
    control_horizon: int = parameter(5, 'n_c: later moves are zero', low=1, high=50)
    error_weight: float = parameter(
        1.0, 'mu of (60)', unit='s²/rad²', low=0.0, high=1e6, dynamic=True
    )
    move_weight: float = parameter(
        0.029, 'pi of (60)', unit='s⁴/rad²', low=1e-9, high=1e6, dynamic=True
    )
    v_max: float = parameter(
        10.0, 'bound of v_p, v_p-bar of (80)', unit='rad/s²', low=0.0, high=1e4, dynamic=True
    )
    dv_max: float = parameter(
        4.0, 'bound of its change in a period T', unit='rad/s²', low=0.0, high=1e4, dynamic=True
    )
    dither: float = parameter(
        0.0,
        'largest random level added to v_p, a new one each period: switch it on while a bag is '
        'recorded that the predictor is to learn from, because feedback alone moves v_p too '
        'little to show what it does',
        unit='rad/s²',
        low=0.0,
        high=1e3,
        dynamic=True,
    )
    probe: float = parameter(
        1.0, 'dv of the step response (48), (51)', unit='rad/s²', low=1e-3, high=1e3
    )
    delta_lags: int = parameter(4, 'past errors the machine sees, tau of (35)', low=1, high=50)
    move_lags: int = parameter(
        4, 'past v_p it sees; these must cover the dead time', low=1, high=50
    )
    hidden: int = parameter(12, 'hidden units, at least as many as lags', low=2, high=200)
    spread: float = parameter(1.0, 'length of each row of the first X_v', low=1e-3, high=2.0)
    delta_scale: float = parameter(
        3.0, 'error that counts as 1 in the machine', unit='rad/s', low=1e-3, high=1e3
    )
    move_scale: float = parameter(
        20.0, 'v_p that counts as 1 in the machine', unit='rad/s²', low=1e-3, high=1e4
    )
    learning: bool = parameter(True, 'whether the machine learns while it runs', dynamic=True)
    algorithm: str = parameter(
        'recursive',
        'output layer by recursive least squares, or by the normalised gradient (44)',
        choices=('recursive', 'gradient'),
    )
    memory: float = parameter(20.0, 'time constant of forgetting', unit='s', low=0.1, high=1e4)
    trust: float = parameter(
        30.0, 'experience that the pre-training is worth', unit='s', low=0.01, high=1e5
    )
    output_rate: float = parameter(0.05, 'gamma of (44), normalised', low=0.0, high=1.0)
    contrast_rate: float = parameter(1e-4, 'gamma of (43) while running', low=0.0, high=1.0)
    offset_gain: float = parameter(
        0.0032, 'share of the latest miss that the offset e takes in', low=0.0, high=1.0
    )
    noise: float = parameter(
        0.05,
        'standard deviation of a sampled error that is mere noise',
        unit='rad/s',
        low=1e-9,
        high=10.0,
    )
    skill_memory: float = parameter(5.0, 'time constant of the skill', unit='s', low=0.1, high=1e4)
    skill_low: float = parameter(-1.0, 'skill at which v_p is out', low=-100.0, high=1.0)
    skill_high: float = parameter(
        0.0,
        'skill from which v_p has its whole bound; 0 is as good as persistence',
        low=-100.0,
        high=1.0,
    )
    gain_low: float = parameter(
        0.2, 'step response over the nominal one at which v_p is out', low=-1.0, high=1.0
    )
    gain_high: float = parameter(0.5, 'and from which it has its whole bound', low=-1.0, high=1.0)
    seed: int = parameter(1, 'seed of the first weights and of the simulated run', low=0)
    nominal: NominalLoopParameters = group(NominalLoopParameters)
    excitation: ExcitationParameters = group(ExcitationParameters)

    def check_consistency(self) -> None:
        """Raise when settings that are each in range do not fit together."""
        for low, high in (
            ('control_horizon', 'horizon'),
            ('average', 'decimation'),
        ):
            small, large = getattr(self, low), getattr(self, high)
            if small > large:
                raise ParameterError(f'{low} must be at most {high} = {large}: got {small}')
        if self.hidden < self.delta_lags + self.move_lags:
            raise ParameterError(
                f'hidden must be at least delta_lags + move_lags = '
                f'{self.delta_lags + self.move_lags}: got {self.hidden}'
            )
        for low, high in (('skill_low', 'skill_high'), ('gain_low', 'gain_high')):
            if not getattr(self, low) < getattr(self, high):
                raise ParameterError(
                    f'{low} must be below {high} = {getattr(self, high)}: got {getattr(self, low)}'
                )


class LearningConstants(NamedTuple):
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
    def of(cls, parameters: PredictiveParameters, span: float) -> Self:
        """Return what the settings mean for a predictive period of ``span`` s."""
        return cls(
            recursive=parameters.algorithm == 'recursive',
            contrast_rate=parameters.contrast_rate,
            output_rate=parameters.output_rate,
            keep=math.exp(-span / parameters.memory),
            smooth=math.exp(-span / 2.0),
            skill_keep=math.exp(-span / parameters.skill_memory),
            offset_gain=parameters.offset_gain,
            noise=parameters.noise,
        )


@kernel
def learning_constants_view(told: Array) -> LearningConstants:
    """Return the numbers of a row, as plain calls from Python hand them on best, by name."""
    return LearningConstants(
        told[0] != 0.0, told[1], told[2], told[3], told[4], told[5], told[6], told[7]
    )


class MoveConstants(NamedTuple):
    """How v_p is made of what the machine foresees: plain numbers, for kernels."""

    enabled: bool
    learning: bool
    dithered: bool
    quiet_threshold: float
    """Rest of a jump (rad/s) from which on the machine learns nothing: what is left of a large
    one is mostly how the robot's limits spoilt its decay."""
    probe: float
    error_weight: float
    move_weight: float
    v_max: float
    dv_max: float
    skill_low: float
    skill_high: float
    gain_low: float
    gain_high: float

    @classmethod
    def of(cls, parameters: PredictiveParameters) -> Self:
        """Return what the settings say."""
        return cls(
            parameters.enabled,
            parameters.learning,
            parameters.enabled and parameters.dither > 0.0,
            0.1 * parameters.delta_scale,
            parameters.probe,
            parameters.error_weight,
            parameters.move_weight,
            parameters.v_max,
            parameters.dv_max,
            parameters.skill_low,
            parameters.skill_high,
            parameters.gain_low,
            parameters.gain_high,
        )


@kernel
def move_constants_view(told: Array) -> MoveConstants:
    """Return the numbers of a row by name, see :func:`learning_in`."""
    return MoveConstants(
        told[0] != 0.0,
        told[1] != 0.0,
        told[2] != 0.0,
        told[3],
        told[4],
        told[5],
        told[6],
        told[7],
        told[8],
        told[9],
        told[10],
        told[11],
        told[12],
    )


@kernel
def update_mse(past: History, which: int, keep: float, noise: float) -> None:
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
    persistence_mse = past.misses[2 * which + 1] * past.misses[2 * which + 1]
    past.recent[which] += 0.1 * (persistence_mse - past.recent[which])
    power = past.recent[which]
    if power > 0.0:
        share = (1.0 - keep) * power / (power + 4.0 * noise * noise)
        past.predicted[which] += share * (missed - past.predicted[which])
        past.persistence_mse[which] += share * (persistence_mse - past.persistence_mse[which])


@kernel
def skill_score(past: History, which: int) -> float:
    """Return 1 - mean(prediction error²)/mean(persistence error²): 1 perfect, 0 no better.

    Mean squares, not variances: a constant miss is a miss.
    """
    ratio: float = past.predicted[which] / max(past.persistence_mse[which], 1e-300)
    return 1.0 - ratio


@kernel
def smooth_step(x: float, low: float, high: float) -> float:
    """Return 0 below ``low``, 1 above ``high``, and the cubic with flat ends in between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@kernel
def authority(
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
    machine: BoltzmannMachine,
    memory: RlsState,
    past: History,
    error: float,
    applied: float,
    score: bool,
    learn: bool,
    how: LearningConstants,
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
    set_visible(machine, past.errors, past.moves, 1)
    missed = error - predict_error(machine) - past.offsets[0]
    # Squares of absurd values must not overflow.
    most = 10.0 * machine.scales[0]
    past.misses[0] = min(max(missed, -most), most)
    past.misses[1] = min(max(error - past.errors[1], -most), most)
    past.misses[2] = min(max(error - past.ahead[middle - 1], -most), most)
    past.misses[3] = min(max(error - past.errors[middle], -most), most)
    if score:
        update_mse(past, 0, how.skill_keep, how.noise)
        update_mse(past, 1, how.skill_keep, how.noise)
    # A miss beyond the machine's whole range is a fault or a blow, and teaches nothing.
    if learn and abs(missed) < machine.scales[0]:
        # From what the offset leaves unexplained: a steady disturbance is not dynamics.
        if how.recursive:
            rls_step(machine, memory, missed, how.keep, how.smooth)
        else:
            gradient_step(machine, missed, how.output_rate, memory.power[2])
        contrastive_divergence_step(machine, how.contrast_rate)
    for i in range(middle - 1, 0, -1):
        past.offsets[i] = past.offsets[i - 1]
    past.offsets[0] += how.offset_gain * past.misses[0]


@kernel
def evaluate_offline(
    machine: BoltzmannMachine,
    memory: RlsState,
    past: History,
    errors: Array,
    moves: Array,
    how: LearningConstants,
) -> None:
    """Set the mean squares of ``past`` to those over a whole run, learning nothing.

    errors, moves : *newest first*, longer than the past
    """
    past.predicted[:] = 0.0
    past.persistence_mse[:] = 0.0
    count = errors.size - 1 - past.errors.size
    for i in range(errors.size - 2, -1, -1):
        observe(machine, memory, past, errors[i], moves[i + 1], False, False, how)
        if i < count:
            for which in range(2):
                missed, persistence_mse = past.misses[2 * which], past.misses[2 * which + 1]
                past.predicted[which] += missed * missed / count
                past.persistence_mse[which] += persistence_mse * persistence_mse / count


class WheelState(NamedTuple):
    """One output's machine with its memory and its past."""

    machine: BoltzmannMachine
    memory: RlsState
    past: History


@kernel
def wheel_state_size(delta_lags: int, move_lags: int, hidden: int, horizon: int) -> int:
    """Return how many numbers make a wheel."""
    machine = machine_size(delta_lags, move_lags, hidden)
    return machine + rls_state_size(hidden) + history_size(delta_lags, move_lags, horizon)


@kernel
def wheel_state_view(
    store: Array, delta_lags: int, move_lags: int, hidden: int, horizon: int
) -> WheelState:
    """Return the views of a flat store that are a wheel."""
    first = machine_size(delta_lags, move_lags, hidden)
    second = first + rls_state_size(hidden)
    return WheelState(
        machine_view(store[:first], delta_lags, move_lags, hidden),
        rls_state_view(store[first:second], hidden),
        history_view(store[second:], delta_lags, move_lags, horizon),
    )


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

    def __init__(
        self, machine: BoltzmannMachine, horizon: int, trial: tuple[Array, Array]
    ) -> None:
        delta_lags, hidden = machine.delta_lags, machine.output_weights.size
        self.sizes = (delta_lags, machine.lags.size - delta_lags, hidden, horizon)
        """Lags of the error and of v_p, hidden units and n_p."""
        self.store: Array = np.zeros(wheel_state_size(*self.sizes))
        """Everything the kernels change, as :func:`wheel_in` takes it apart."""
        given = WheelState(machine, make_rls_state(hidden), make_history(*self.sizes[:2], horizon))
        for mine, other in zip(wheel_state_view(self.store, *self.sizes), given, strict=True):
            for here, there in zip(mine, other, strict=True):
                if isinstance(here, np.ndarray):
                    here[:] = there
        if trial[0].size <= self.past.errors.size + 1:
            raise ValueError(
                f'trial must be longer than {self.past.errors.size + 1}: got {trial[0].size}'
            )
        self._trial = trial

    # Made when asked for: a deep copy of views would no longer be views of the copied store.
    @property
    def machine(self) -> BoltzmannMachine:
        """The machine, as views of ``store``; so are the next two."""
        return wheel_state_view(self.store, *self.sizes).machine

    @property
    def memory(self) -> RlsState:
        """What its output layer remembers."""
        return wheel_state_view(self.store, *self.sizes).memory

    @property
    def past(self) -> History:
        """What it has seen."""
        return wheel_state_view(self.store, *self.sizes).past

    def fit(
        self,
        errors: Array,
        moves: Array,
        how: ExcitationParameters,
        trust: float,
        learning: LearningConstants,
    ) -> None:
        """Learn a run (*newest first*) as :func:`pretrain` does; the trial gives the skill."""
        pretrain(self.machine, self.memory, errors, moves, how, trust, learning.noise)
        self.evaluate(learning)

    def evaluate(self, learning: LearningConstants) -> None:
        """Set the skill to that on the trial run, and forget the past."""
        reset_history(self.past, 0.0)
        evaluate_offline(self.machine, self.memory, self.past, *self._trial, learning)
        reset_history(self.past, 0.0)

    def weights(self) -> dict[str, Array]:
        """Return copies of everything learnt, and the scales it is for."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def set_weights(self, weights: Mapping[str, Array], learning: LearningConstants) -> None:
        """Take over what :meth:`weights` returned, checked by the caller; then try it out."""
        for name, array in self._arrays().items():
            array[:] = weights[name]
        self.evaluate(learning)

    def _arrays(self) -> dict[str, Array]:
        machine, memory, _ = wheel_state_view(self.store, *self.sizes)
        return {
            'visible_weights': machine.visible_weights,
            'output_weights': machine.output_weights,
            'scales': machine.scales,
            'anchor': memory.anchor,
            'prior': memory.prior,
            'information': memory.information,
            'power': memory.power,
        }
