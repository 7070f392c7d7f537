# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Predictive controller: v_p of every wheel from its tracking error, equations (34)-(63)."""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    make_machine,
    reset_history,
)
from t3mpc_ros.mpc.prediction import predict_responses, predicted_errors, toeplitz
from t3mpc_ros.mpc.predictor import (
    Array,
    LearningConstants,
    MoveConstants,
    PredictiveParameters,
    Predictor,
    authority,
    learning_constants_view,
    move_constants_view,
    observe,
    skill_score,
    wheel_state_view,
)
from t3mpc_ros.mpc.pretraining import (
    SampleTiming,
    nominal_step_response,
    simulate_excitation,
    split_runs,
)
from t3mpc_ros.mpc.quadratic_program import (
    OPTIMAL,
    Indices,
    Workspace,
    solve_quadratic_program,
    workspace_size,
    workspace_view,
)
from t3mpc_ros.parameters.table import ParameterError


class Signals(NamedTuple):
    """What each output's v_p is made of from step to step, shape (outputs,) each."""

    sums: Array
    """Sum of the errors of this sample so far, rad/s."""
    applied_sums: Array
    """Sum of the v_p applied since the last sample, rad/s²."""
    applied: Array
    """v_p as applied in this control period, rad/s²."""
    v: Array
    """v_p (63), held between samples, rad/s²."""
    dither: Array
    """Its random part, rad/s²."""
    drawn: Array
    """The random level to be added to the next one, rad/s²."""
    jumps: Array
    """What is left of the known jumps of the error, rad/s."""
    authorities: Array
    """Share of the bound of v_p in force."""
    skills: Array
    """Skill in the middle of the horizon."""
    errors: Array
    """The last errors delta = chi - r, rad/s."""
    unforeseen: Array
    """The same less what was left of the known jumps, rad/s."""


@kernel
def signals_view(rows: Array) -> Signals:
    """Return the rows of a table, shape (11, outputs), as signals."""
    return Signals(
        rows[0],
        rows[1],
        rows[2],
        rows[3],
        rows[4],
        rows[5],
        rows[6],
        rows[7],
        rows[8],
        rows[9],
        rows[10],
    )


@kernel
def end_control_period(signals: Signals, decay: float) -> None:
    """End a control period: known jumps die away, and v_p is taken to be applied as it is."""
    for z in range(signals.v.size):
        signals.jumps[z] *= decay
        signals.applied[z] = signals.v[z]


@kernel
def accumulate_sample(
    speeds: Array, wanted: Array, sampled: bool, due: bool, decay: float, rows: Array
) -> bool:
    """Add a control period to the sums of a sample; return False if an error is not finite.

    speeds, wanted : shape (outputs,), chi and r, rad/s
    sampled : whether this period's errors belong to the sample
    due     : whether the sample is complete; :func:`renew` ends the period then
    decay   : share of a known jump that is left after a period
    rows    : the :class:`Signals`
    """
    signals = signals_view(rows)
    for z in range(speeds.size):
        if not math.isfinite(speeds[z] - wanted[z]):
            return False
    for z in range(speeds.size):
        signals.errors[z] = speeds[z] - wanted[z]
        signals.applied_sums[z] += signals.applied[z]
        signals.unforeseen[z] = signals.errors[z] - signals.jumps[z]
        if sampled:
            signals.sums[z] += signals.unforeseen[z]
    if not due:
        end_control_period(signals, decay)
    return True


@kernel
def predict_known_errors(jump: float, decays: Array, change: Array, known: Array) -> None:
    """Write the known part of the errors to come: jumps past and to come, dying away by K.

    jump   : what is left of the past ones, rad/s
    decays : shape (n_p + 1,), share of a jump that is left 0, 1, ... periods T later
    change : shape (n_p,), jumps in each period T to come, rad/s
    known  : shape (n_p,), overwritten, rad/s
    """
    for j in range(known.size):
        known[j] = jump * decays[j + 1]
    for j in range(change.size):
        for i in range(j, known.size):
            known[i] += change[j] * decays[i - j]


@kernel
def plan_moves(
    steps: Array,
    free: Array,
    held: float,
    error_weight: float,
    move_weight: float,
    dv_max: float,
    v_max: float,
    matrix: Array,
    space: Workspace,
    prediction: Array,
) -> int:
    """Write the optimal moves into ``space`` and what they lead to; return the solver's status.

    steps, free  : the step response (48) and Psi_free (56)
    held         : v_p(t-1), inside v_max (rad/s²)
    error_weight, move_weight, dv_max, v_max : mu, pi and the bounds (rad/s²) of the program
    matrix       : S (54), shape (n_p, n_c), overwritten
    prediction   : Psi (52), shape (n_p,), overwritten
    """
    toeplitz(steps, matrix)
    most = 20 * space.slope.size
    status = solve_quadratic_program(
        matrix, free, error_weight, move_weight, held, dv_max, v_max, most, space
    )
    predicted_errors(matrix, space.changes, free, prediction)
    return status


@kernel
def predictive_step(
    stores: tuple[Array, ...],
    sizes: Indices,
    rows: Array,
    tables: Array,
    nominal: float,
    decays: Array,
    change: Array,
    samples: int,
    average: int,
    decimation: int,
    decay: float,
    move_row: Array,
    learning_row: Array,
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
    rules, how = move_constants_view(move_row), learning_constants_view(learning_row)
    signals = signals_view(rows)
    horizon = decays.size - 1
    moves = whole.shape[1] - 1
    matrix = numbers[: horizon * moves].reshape((horizon, moves))
    space = workspace_view(numbers[horizon * moves :], whole, moves)
    for z in range(len(stores)):
        wheel = wheel_state_view(stores[z], sizes[0], sizes[1], sizes[2], sizes[3])
        machine, past = wheel.machine, wheel.past
        steps, free, known = tables[0, z], tables[1, z], tables[3, z]
        predict_known_errors(signals.jumps[z], decays, change[:, z], known)
        # The first sample has one measurement; nothing was before it.
        sample = signals.sums[z] / (average if samples > 0 else 1)
        if samples == 0:
            reset_history(past, sample)
        enough = samples > past.errors.size
        observe(
            machine,
            wheel.memory,
            past,
            sample,
            signals.applied_sums[z] / decimation,
            enough,
            enough and abs(signals.jumps[z]) < rules.quiet_threshold and rules.learning,
            how,
        )
        # (62) starts from v_p(t-1) as applied, less the dither. A bound that has just been lowered
        # is kept at once, because the compensator (81) counts on it: that is no part of dv_max.
        v = signals.v[z] - signals.dither[z]
        held = min(max(signals.applied[z] - signals.dither[z], min(v, 0.0)), max(v, 0.0))
        held = min(max(held, -rules.v_max), rules.v_max)
        predict_responses(machine, past, held, rules.probe, known, steps, free)
        # Whichever skill is worse: a response that goes to zero is hard to beat half a horizon
        # ahead, but an untaught machine misses the very next error by far.
        signals.skills[z] = skill_score(past, 1)
        share = authority(
            min(skill_score(past, 0), signals.skills[z]),
            steps[past.offsets.size - 1] / nominal,
            rules.skill_low,
            rules.skill_high,
            rules.gain_low,
            rules.gain_high,
        )
        signals.authorities[z] = share if rules.enabled else 0.0
        # A share that falls takes v_p out no faster than dv_max, so that no step is made of it.
        bound = max(signals.authorities[z] * rules.v_max, abs(held) - rules.dv_max)
        status[z] = plan_moves(
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
    end_control_period(signals, decay)


__all__ = ['PredictiveParameters', 'PredictiveController']


_APPLIED, _V, _DRAWN, _JUMPS, _AUTHORITIES, _SKILLS = map(
    Signals._fields.index, ('applied', 'v', 'drawn', 'jumps', 'authorities', 'skills')
)


class PredictiveController:
    """Computes v_p for each output from its tracking error, equations (34)-(63).

    :meth:`step` is called every control period; every ``settings.every`` of them the machines
    take a sample, learn from it, predict, and the programs are solved; v_p is held in between.

    A jump of the reference makes the error jump by a known amount, which then dies away as the
    law's own feedback K makes it: exp(-K t). This known part is kept apart from what the machine
    sees and added to what it predicts, so that a jump is neither learnt as dynamics nor
    saturates the machine, whatever its size.

    Parameters
    ----------
    settings
        Everything that can be chosen.
    period
        Control period, s.
    feedback_gain
        K of the law (1/s); it replaces the one in ``settings.nominal``.
    outputs
        Number of wheels.

    Raises
    ------
    ParameterError
        The lags of v_p do not cover the nominal dead time at this period.
    ValueError
        ``period``, ``feedback_gain`` or ``outputs`` is not positive.
    """

    def __init__(
        self,
        parameters: PredictiveParameters,
        period: float,
        feedback_gain: float,
        outputs: int = 2,
    ) -> None:
        if not (period > 0.0 and outputs > 0):
            raise ValueError(f'period and outputs must be positive: got {period}, {outputs}')
        self._timing = SampleTiming(period, parameters.decimation, parameters.average)
        span = self._timing.span
        if parameters.move_lags * span < parameters.nominal.dead_time + span:
            raise ParameterError(
                f'move_lags must cover the dead time of {parameters.nominal.dead_time} s and one '
                f'period of {span:g} s: got {parameters.move_lags}'
            )
        self.rows: Array = np.zeros((len(Signals._fields), outputs))
        """The :class:`Signals`, for kernels."""
        self._tables: Array = np.zeros((4, outputs, parameters.horizon))
        self._zeros = np.zeros(outputs)
        self._no_change = np.zeros((parameters.horizon, outputs))
        moves = parameters.control_horizon
        self._numbers = np.zeros(parameters.horizon * moves + workspace_size(moves))
        self._whole = np.zeros((2, moves + 1), dtype=np.int64)
        self.status: NDArray[np.int64] = np.zeros(outputs, dtype=np.int64)
        """How each output's last program ended, see :mod:`t3mpc_ros.mpc.quadratic_program`."""
        self.parameters = parameters
        self.configure(parameters, feedback_gain)
        self.pretrain()

    @property
    def tables(self) -> tuple[Any, ...]:
        """What :func:`renew` reads and writes but the count of samples, in its order.

        No jump of the error is known in it.
        """
        timing, change = self._timing, self._no_change
        seen = self._stores, self._sizes, self.rows, self._tables, self._nominal_response
        how = timing.average, timing.decimation, self._decay, self._rules, self._learning_row
        return *seen, self._decays, change, *how, self._numbers, self._whole, self.status

    def synchronize(self, phase: int, samples: int) -> None:
        """Take note that kernels have gone on with :attr:`tables`: up to where."""
        self.phase, self.samples = phase, samples
        self._skill = self.rows[_SKILLS].copy()

    @property
    def skill(self) -> Array:
        """Skill against persistence in the middle of the horizon, shape (outputs,): read only."""
        skill: Array = self._skill
        return skill

    @property
    def one_step_skill(self) -> Array:
        """Skill against persistence one step ahead, shape (outputs,)."""
        return np.array([skill_score(wheel.past, 0) for wheel in self._predictors])

    @property
    def fade(self) -> Array:
        """Share of v_p's bound in force, in [0, 1], shape (outputs,)."""
        found: Array = self.rows[_AUTHORITIES]
        return found.copy()

    @property
    def prediction(self) -> Array:
        """Predicted errors Psi (52) under the planned moves, rad/s, shape (outputs, n_p)."""
        found: Array = self._tables[2]
        return found.copy()

    @property
    def step_response(self) -> Array:
        """Latest s_0 ... s_{n_p-1} (48), (rad/s)/(rad/s²), shape (outputs, n_p)."""
        found: Array = self._tables[0]
        return found.copy()

    def configure(
        self, parameters: PredictiveParameters, feedback_gain: float | None = None
    ) -> None:
        """Use other live settings, and another K (1/s), from the next step on.

        Raises
        ------
        ParameterError
            A setting differs that is not live.
        ValueError
            ``feedback_gain`` is not positive.
        """
        now, wanted = self.parameters.to_dict(), parameters.to_dict()
        for row in parameters.specs():
            if not row.dynamic and wanted[row.name] != now[row.name]:
                raise ParameterError(
                    f'{row.name} is fixed while running at {now[row.name]}: got {wanted[row.name]}'
                )
        if feedback_gain is not None:
            if not feedback_gain > 0.0:
                raise ValueError(f'feedback_gain must be positive: got {feedback_gain}')
            self._loop = replace(parameters.nominal, feedback_gain=feedback_gain)
            self._decay = math.exp(-feedback_gain * self._timing.period)
            self._decays = np.exp(
                -feedback_gain * self._timing.span * np.arange(parameters.horizon + 1)
            )
            steps = nominal_step_response(self._loop, self._timing, parameters.horizon)
            self._nominal_response = float(steps[max(parameters.horizon // 2, 1) - 1])
        self.parameters = parameters
        self._how = LearningConstants.of(parameters, self._timing.span)
        self._learning_row = np.array(self._how, dtype=np.float64)
        self._rules = np.array(MoveConstants.of(parameters), dtype=np.float64)
        self.dithered = parameters.enabled and parameters.dither > 0.0

    def pretrain(self, errors: Array | None = None, moves: Array | None = None) -> None:
        """Make new machines and teach them from the beginning, then :meth:`reset`.

        Parameters
        ----------
        errors, moves
            A recorded run, oldest first, one row per predictive period, shape (N, outputs):
            errors (rad/s) and the v_p applied after each (rad/s²), NaN where they are not known,
            and in a row between two runs. Of the last quarter the longest stretch without a gap
            is kept to measure the skill. Without them the nominal loop is simulated, and so is
            the trial.

        Raises
        ------
        ValueError
            The two do not have one shape (N, outputs), are infinite, or too little is known.
        """
        parameters, outputs = self.parameters, self.status.size
        recorded = None
        if errors is not None or moves is not None:
            recorded = split_runs(np.asarray(errors), np.asarray(moves), outputs)
        generator = np.random.default_rng(parameters.seed)
        predictors: list[Predictor] = []
        shape = LayerSizes(parameters.delta_lags, parameters.move_lags, parameters.hidden)
        trial = replace(
            parameters.excitation, duration=max(0.25 * parameters.excitation.duration, 10.0)
        )
        for z in range(outputs):
            machine = make_machine(
                shape, parameters.delta_scale, parameters.move_scale, parameters.spread, generator
            )
            runs = [
                simulate_excitation(
                    self._loop, how, self._timing, parameters.move_scale, generator
                )
                for how in (parameters.excitation, trial)
            ]
            if recorded is not None:
                runs = recorded[z]
            predictor = Predictor(machine, parameters.horizon, runs[1])
            predictor.fit(
                *runs[0], parameters.excitation, parameters.trust / self._timing.span, self._how
            )
            predictors.append(predictor)
        self._predictors = predictors
        self._stores = tuple(predictor.store for predictor in predictors)
        self._sizes = np.array(predictors[0].sizes)
        self.reset()

    def reset(self) -> None:
        """Forget the past, and start from v_p = 0; weights and skill are kept."""
        self.rows[:] = 0.0
        self._tables[:] = 0.0
        self._generator = np.random.default_rng((self.parameters.seed, 1))
        self.status[:] = OPTIMAL
        self.phase = 0
        """Control periods since the last sample, below ``settings.every``."""
        self.samples = 0
        """Samples taken."""
        for predictor in self._predictors:
            reset_history(predictor.past, 0.0)
        self._skill = np.array([skill_score(predictor.past, 1) for predictor in self._predictors])
        self.rows[_SKILLS] = self._skill

    def warm_up(self) -> None:
        """Compile every kernel now, never inside a step; nothing is remembered of it."""
        for _ in range(2 * self._timing.decimation):
            self.step(np.zeros(self.status.size))
        self.reset()

    def weights(self) -> dict[str, Array]:
        """Return everything learnt, to be saved; each array has the outputs in front."""
        each = [predictor.weights() for predictor in self._predictors]
        return {name: np.stack([one[name] for one in each]) for name in each[0]}

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Use what :meth:`weights` returned; its skill is measured anew on a trial run.

        Raises
        ------
        ValueError
            A name is missing or unknown, a shape differs, a number is not finite, or the scales
            are others than this term's. Nothing is changed then.
        """
        now = self.weights()
        if set(weights) != set(now):
            raise ValueError(f'weights must be {sorted(now)}: got {sorted(weights)}')
        for name, value in weights.items():
            if np.shape(value) != now[name].shape:
                raise ValueError(
                    f'{name} must have shape {now[name].shape}: got {np.shape(value)}'
                )
            if not np.isfinite(value).all():
                raise ValueError(f'{name} must be finite: got inf or nan')
        if not np.array_equal(weights['scales'], now['scales']):
            raise ValueError(
                f'scales must be {now["scales"].tolist()}: got {np.asarray(weights["scales"])}'
            )
        for z, predictor in enumerate(self._predictors):
            predictor.set_weights({name: value[z] for name, value in weights.items()}, self._how)
        self.reset()

    def snapshot(self) -> list[Array]:
        """Return what is learnt as it is now, for :meth:`go_back`: much faster than weights."""
        return [store.copy() for store in self._stores]

    def rollback(self, snapshot: list[Array]) -> None:
        """Use what :meth:`copies` returned; its skill is measured anew on a trial run."""
        for predictor, copy in zip(self._predictors, snapshot, strict=True):
            predictor.store[:] = copy
            predictor.evaluate(self._how)
        self.reset()

    def notify_applied(self, v_p: Array) -> None:
        """Tell what was applied of the v_p last returned (rad/s²), when it was not all of it.

        The machine must learn from what really acted. What goes beyond v_p, or against it, acts
        too, but is no start for the next change: that starts between zero and v_p.
        """
        if np.shape(v_p) != self.status.shape or not np.isfinite(v_p).all():
            raise ValueError(f'v_p must be {self.status.size} finite numbers: got {v_p}')
        self.rows[_APPLIED] = v_p

    def notify_jump(self, jump: Array) -> None:
        """Tell that the error jumps by ``jump`` (rad/s) at the coming step, because r jumps.

        Call it before :meth:`step` of the same period; jumps add up.
        """
        if np.shape(jump) != self.status.shape or not np.isfinite(jump).all():
            raise ValueError(f'jump must be {self.status.size} finite numbers: got {jump}')
        self.rows[_JUMPS] += jump

    def step(self, errors: Array, known_change: Array | None = None) -> Array:
        """Return v_p (rad/s²), shape (outputs,), equation (63).

        Parameters
        ----------
        errors
            (Estimated) tracking errors delta = chi - r, rad/s, shape (outputs,).
        known_change
            Jumps of delta that are still to come, shape (n_p, outputs), rad/s: row j holds what
            the reference's jumps add between t + jT and t + (j+1)T, zero where nothing jumps.
            Each is added to Psi_free where it happens, and dies away after it. Read only at the
            steps where the program is solved, see :attr:`due`.

        Raises
        ------
        ValueError
            A shape is wrong or an error is not finite; nothing is changed then.
        """
        errors = np.asarray(errors, dtype=np.float64)
        if errors.shape != self.status.shape:
            raise ValueError(f'errors must have shape {self.status.shape}: got {errors.shape}')
        if self.due and known_change is not None:
            rows, columns = self._no_change.shape
            if np.shape(known_change) != (rows, columns) or not np.isfinite(known_change).all():
                raise ValueError(
                    f'known_change must be {rows} by {columns} finite numbers: got {known_change}'
                )
            known_change = np.asarray(known_change, dtype=np.float64)
        self.advance(errors, self._zeros, known_change)
        v_p: Array = self.rows[_V]
        return v_p.copy()

    def advance(self, speeds: Array, wanted: Array, known_change: Array | None = None) -> None:
        """Renew ``rows`` as :meth:`step` does with speeds - wanted; shapes are not checked."""
        timing, phase = self._timing, self.phase
        sampled = phase == 0 or phase > timing.decimation - timing.average
        if not accumulate_sample(speeds, wanted, sampled, phase == 0, self._decay, self.rows):
            raise ValueError(f'errors must be finite: got {speeds - wanted}')
        if phase == 0:
            self._renew(self._no_change if known_change is None else known_change)
        self.phase = (phase + 1) % timing.decimation

    @property
    def known_error(self) -> Array:
        """What is left of the jumps told by :meth:`shift`, rad/s, shape (outputs,)."""
        left: Array = self.rows[_JUMPS]
        return left

    @property
    def span(self) -> float:
        """Predictive period T, s."""
        return self._timing.span

    @property
    def due(self) -> bool:
        """Whether the next :meth:`step` solves the program, and reads ``known_change``."""
        return self.phase == 0

    def _renew(self, change: Array) -> None:
        """Take the sample of each output, and renew its v_p."""
        if self.dithered:
            drawn = self._generator.uniform(-1.0, 1.0, self.status.size)
            self.rows[_DRAWN] = self.parameters.dither * drawn
        timing = self._timing
        predictive_step(
            self._stores,
            self._sizes,
            self.rows,
            self._tables,
            self._nominal_response,
            self._decays,
            change,
            self.samples,
            timing.average,
            timing.decimation,
            self._decay,
            self._rules,
            self._learning_row,
            self._numbers,
            self._whole,
            self.status,
        )
        self._skill = self.rows[_SKILLS].copy()
        self.samples += 1
