# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How well the machine predicts while it runs, how much of v_p that is worth, and that v_p."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.machine import (
    Machine,
    Memory,
    Past,
    begin,
    look,
    machine_in,
    machine_size,
    make_memory,
    make_past,
    memory_in,
    memory_size,
    past_in,
    past_size,
    predict,
)
from t3mpc_ros.mpc.program import Indices, space_in
from t3mpc_ros.mpc.response import foresee, foretell, hold, plan, roll_forward, signals_in
from t3mpc_ros.mpc.settings import Excitation, Learning, learning_in, rules_in
from t3mpc_ros.mpc.training import contrast, gradient_step, pretrain, recall

Array = NDArray[np.float64]


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


class Wheel(NamedTuple):
    """One output's machine with its memory and its past."""

    machine: Machine
    memory: Memory
    past: Past


@kernel
def wheel_size(delta_lags: int, move_lags: int, hidden: int, horizon: int) -> int:
    """Return how many numbers make a wheel."""
    machine = machine_size(delta_lags, move_lags, hidden)
    return machine + memory_size(hidden) + past_size(delta_lags, move_lags, horizon)


@kernel
def wheel_in(store: Array, delta_lags: int, move_lags: int, hidden: int, horizon: int) -> Wheel:
    """Return the views of a flat store that are a wheel."""
    first = machine_size(delta_lags, move_lags, hidden)
    second = first + memory_size(hidden)
    return Wheel(
        machine_in(store[:first], delta_lags, move_lags, hidden),
        memory_in(store[first:second], hidden),
        past_in(store[second:], delta_lags, move_lags, horizon),
    )


@kernel
def renew(
    stores: tuple[Array, ...],
    sizes: Indices,
    rows: Array,
    tables: Array,
    nominal: float,
    decays: Array,
    change: Array,
    samples: int,
    average: int,
    every: int,
    decay: float,
    rules_told: Array,
    how_told: Array,
    numbers: Array,
    whole: Indices,
    status: Indices,
) -> None:
    """Take the sample of each output, and renew its v_p: (34)-(63) in one call.

    stores, sizes : the :class:`Wheel` of each output, and :attr:`Predictor.sizes`
    rows          : the :class:`Signals`
    tables        : shape (4, outputs, n_p), overwritten: step responses (48), Psi_free (56),
                    predictions Psi (52), and the part of the errors to come that is known
    nominal       : nominal step response in the middle of the horizon
    decays        : shape (n_p + 1,), share of a known jump that is left 0, 1, ... periods T later
    change        : shape (n_p, outputs), jumps to come in each period T, rad/s
    samples       : how many were taken before
    average, every: control periods in a sample's mean, and in a period T
    decay         : share of a known jump that is left after a control period
    rules_told, how_told : the numbers of :class:`Rules` and :class:`Learning`
    numbers, whole : working memory: S and the :class:`Space` of the program
    status        : shape (outputs,), overwritten, how each program ended
    """
    rules, how = rules_in(rules_told), learning_in(how_told)
    signals = signals_in(rows)
    horizon = decays.size - 1
    moves = whole.shape[1] - 1
    matrix = numbers[: horizon * moves].reshape((horizon, moves))
    space = space_in(numbers[horizon * moves :], whole, moves)
    for z in range(len(stores)):
        wheel = wheel_in(stores[z], sizes[0], sizes[1], sizes[2], sizes[3])
        machine, past = wheel.machine, wheel.past
        steps, free, known = tables[0, z], tables[1, z], tables[3, z]
        foretell(signals.jumps[z], decays, change[:, z], known)
        # The first sample has one measurement; nothing was before it.
        sample = signals.sums[z] / (average if samples > 0 else 1)
        if samples == 0:
            begin(past, sample)
        enough = samples > past.errors.size
        observe(
            machine,
            wheel.memory,
            past,
            sample,
            signals.applied_sums[z] / every,
            enough,
            enough and abs(signals.jumps[z]) < rules.calm and rules.learning,
            how,
        )
        # (62) starts from v_p(t-1) as applied, less the dither. A bound that has just been lowered
        # is kept at once, because the compensator (81) counts on it: that is no part of dv_max.
        v = signals.v[z] - signals.dither[z]
        held = min(max(signals.applied[z] - signals.dither[z], min(v, 0.0)), max(v, 0.0))
        held = min(max(held, -rules.v_max), rules.v_max)
        foresee(machine, past, held, rules.probe, known, steps, free)
        # Whichever skill is worse: a response that goes to zero is hard to beat half a horizon
        # ahead, but an untaught machine misses the very next error by far.
        signals.skills[z] = skill(past, 1)
        share = fade(
            min(skill(past, 0), signals.skills[z]),
            steps[past.offsets.size - 1] / nominal,
            rules.fade_low,
            rules.fade_high,
            rules.gain_low,
            rules.gain_high,
        )
        signals.fades[z] = share if rules.enabled else 0.0
        # A share that falls takes v_p out no faster than dv_max, so that no step is made of it.
        bound = max(signals.fades[z] * rules.v_max, abs(held) - rules.dv_max)
        status[z] = plan(
            steps,
            free,
            held,
            rules.error_weight,
            rules.move_weight,
            rules.dv_max,
            bound,
            matrix,
            space,
            tables[2, z],
        )
        # Rounding must not carry v_p over its bound, nor leave dust when it is zero.
        v = min(max(held + space.changes[0], -bound), bound)
        signals.v[z] = v
        if rules.dithered:
            signals.v[z] = min(max(v + signals.drawn[z], -rules.v_max), rules.v_max)
        signals.dither[z] = signals.v[z] - v
        signals.sums[z] = 0.0
        signals.applied_sums[z] = 0.0
    hold(signals, decay)


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
        delta_lags, hidden = machine.delta_lags, machine.output_weights.size
        self.sizes = (delta_lags, machine.lags.size - delta_lags, hidden, horizon)
        """Lags of the error and of v_p, hidden units and n_p."""
        self.store: Array = np.zeros(wheel_size(*self.sizes))
        """Everything the kernels change, as :func:`wheel_in` takes it apart."""
        given = Wheel(machine, make_memory(hidden), make_past(*self.sizes[:2], horizon))
        for mine, other in zip(wheel_in(self.store, *self.sizes), given, strict=True):
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
    def machine(self) -> Machine:
        """The machine, as views of ``store``; so are the next two."""
        return wheel_in(self.store, *self.sizes).machine

    @property
    def memory(self) -> Memory:
        """What its output layer remembers."""
        return wheel_in(self.store, *self.sizes).memory

    @property
    def past(self) -> Past:
        """What it has seen."""
        return wheel_in(self.store, *self.sizes).past

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
        machine, memory, _ = wheel_in(self.store, *self.sizes)
        return {
            'visible_weights': machine.visible_weights,
            'output_weights': machine.output_weights,
            'scales': machine.scales,
            'anchor': memory.anchor,
            'prior': memory.prior,
            'information': memory.information,
            'power': memory.power,
        }
