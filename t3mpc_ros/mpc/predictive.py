# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The predictive term v_p of the control law: one machine and one program per wheel."""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.mpc.active_set import OPTIMAL
from t3mpc_ros.mpc.machine import Shape, begin, make_machine
from t3mpc_ros.mpc.program import space_size
from t3mpc_ros.mpc.response import Signals, gather
from t3mpc_ros.mpc.settings import Learning, PredictiveSettings, Rules
from t3mpc_ros.mpc.skill import Predictor, renew, skill
from t3mpc_ros.mpc.training import Timing, excite, nominal_step, split_runs
from t3mpc_ros.settings import SettingError

__all__ = ['PredictiveSettings', 'PredictiveTerm']

Array = NDArray[np.float64]

_APPLIED, _V, _DRAWN, _JUMPS, _FADES, _SKILLS = map(
    Signals._fields.index, ('applied', 'v', 'drawn', 'jumps', 'fades', 'skills')
)


class PredictiveTerm:
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
    SettingError
        The lags of v_p do not cover the nominal dead time at this period.
    ValueError
        ``period``, ``feedback_gain`` or ``outputs`` is not positive.
    """

    def __init__(
        self, settings: PredictiveSettings, period: float, feedback_gain: float, outputs: int = 2
    ) -> None:
        if not (period > 0.0 and outputs > 0):
            raise ValueError(f'period and outputs must be positive: got {period}, {outputs}')
        self._timing = Timing(period, settings.every, settings.average)
        span = self._timing.span
        if settings.move_lags * span < settings.nominal.dead_time + span:
            raise SettingError(
                f'move_lags must cover the dead time of {settings.nominal.dead_time} s and one '
                f'period of {span:g} s: got {settings.move_lags}'
            )
        self.rows: Array = np.zeros((len(Signals._fields), outputs))
        """The :class:`Signals`, for kernels."""
        self._tables: Array = np.zeros((4, outputs, settings.horizon))
        self._zeros = np.zeros(outputs)
        self._no_change = np.zeros((settings.horizon, outputs))
        moves = settings.control_horizon
        self._numbers = np.zeros(settings.horizon * moves + space_size(moves))
        self._whole = np.zeros((2, moves + 1), dtype=np.int64)
        self.status: NDArray[np.int64] = np.zeros(outputs, dtype=np.int64)
        """How each output's last program ended, see :mod:`t3mpc_ros.mpc.active_set`."""
        self.settings = settings
        self.configure(settings, feedback_gain)
        self.relearn()

    @property
    def tables(self) -> tuple[Any, ...]:
        """What :func:`renew` reads and writes but the count of samples, in its order.

        No jump of the error is known in it.
        """
        timing, change = self._timing, self._no_change
        seen = self._stores, self._sizes, self.rows, self._tables, self._nominal_response
        how = timing.average, timing.every, self._decay, self._rules, self._how_told
        return *seen, self._decays, change, *how, self._numbers, self._whole, self.status

    def went_on(self, phase: int, samples: int) -> None:
        """Take note that kernels have gone on with :attr:`tables`: up to where."""
        self.phase, self.samples = phase, samples
        self._skill = self.rows[_SKILLS].copy()

    @property
    def skill(self) -> Array:
        """Skill against persistence in the middle of the horizon, shape (outputs,): read only."""
        skill: Array = self._skill
        return skill

    @property
    def skill_next(self) -> Array:
        """Skill against persistence one step ahead, shape (outputs,)."""
        return np.array([skill(wheel.past, 0) for wheel in self._predictors])

    @property
    def fade(self) -> Array:
        """Share of v_p's bound in force, in [0, 1], shape (outputs,)."""
        found: Array = self.rows[_FADES]
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

    def configure(self, settings: PredictiveSettings, feedback_gain: float | None = None) -> None:
        """Use other live settings, and another K (1/s), from the next step on.

        Raises
        ------
        SettingError
            A setting differs that is not live.
        ValueError
            ``feedback_gain`` is not positive.
        """
        now, wanted = self.settings.flat(), settings.flat()
        for row in settings.rows():
            if not row.live and wanted[row.name] != now[row.name]:
                raise SettingError(
                    f'{row.name} is fixed while running at {now[row.name]}: got {wanted[row.name]}'
                )
        if feedback_gain is not None:
            if not feedback_gain > 0.0:
                raise ValueError(f'feedback_gain must be positive: got {feedback_gain}')
            self._loop = replace(settings.nominal, feedback_gain=feedback_gain)
            self._decay = math.exp(-feedback_gain * self._timing.period)
            self._decays = np.exp(
                -feedback_gain * self._timing.span * np.arange(settings.horizon + 1)
            )
            steps = nominal_step(self._loop, self._timing, settings.horizon)
            self._nominal_response = float(steps[max(settings.horizon // 2, 1) - 1])
        self.settings = settings
        self._how = Learning.of(settings, self._timing.span)
        self._how_told = np.array(self._how, dtype=np.float64)
        self._rules = np.array(Rules.of(settings), dtype=np.float64)
        self.dithered = settings.enabled and settings.dither > 0.0

    def relearn(self, errors: Array | None = None, moves: Array | None = None) -> None:
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
        settings, outputs = self.settings, self.status.size
        recorded = None
        if errors is not None or moves is not None:
            recorded = split_runs(np.asarray(errors), np.asarray(moves), outputs)
        generator = np.random.default_rng(settings.seed)
        predictors: list[Predictor] = []
        shape = Shape(settings.delta_lags, settings.move_lags, settings.hidden)
        trial = replace(
            settings.excitation, duration=max(0.25 * settings.excitation.duration, 10.0)
        )
        for z in range(outputs):
            machine = make_machine(
                shape, settings.delta_scale, settings.move_scale, settings.spread, generator
            )
            runs = [
                excite(self._loop, how, self._timing, settings.move_scale, generator)
                for how in (settings.excitation, trial)
            ]
            if recorded is not None:
                runs = recorded[z]
            predictor = Predictor(machine, settings.horizon, runs[1])
            predictor.teach(
                *runs[0], settings.excitation, settings.trust / self._timing.span, self._how
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
        self._generator = np.random.default_rng((self.settings.seed, 1))
        self.status[:] = OPTIMAL
        self.phase = 0
        """Control periods since the last sample, below ``settings.every``."""
        self.samples = 0
        """Samples taken."""
        for predictor in self._predictors:
            begin(predictor.past, 0.0)
        self._skill = np.array([skill(predictor.past, 1) for predictor in self._predictors])
        self.rows[_SKILLS] = self._skill

    def warm_up(self) -> None:
        """Compile every kernel now, never inside a step; nothing is remembered of it."""
        for _ in range(2 * self._timing.every):
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

    def copies(self) -> list[Array]:
        """Return what is learnt as it is now, for :meth:`go_back`: much faster than weights."""
        return [store.copy() for store in self._stores]

    def go_back(self, copies: list[Array]) -> None:
        """Use what :meth:`copies` returned; its skill is measured anew on a trial run."""
        for predictor, copy in zip(self._predictors, copies, strict=True):
            predictor.store[:] = copy
            predictor.try_out(self._how)
        self.reset()

    def notify_applied(self, v_p: Array) -> None:
        """Tell what was applied of the v_p last returned (rad/s²), when it was not all of it.

        The machine must learn from what really acted. What goes beyond v_p, or against it, acts
        too, but is no start for the next change: that starts between zero and v_p.
        """
        if np.shape(v_p) != self.status.shape or not np.isfinite(v_p).all():
            raise ValueError(f'v_p must be {self.status.size} finite numbers: got {v_p}')
        self.rows[_APPLIED] = v_p

    def shift(self, jump: Array) -> None:
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
        sampled = phase == 0 or phase > timing.every - timing.average
        if not gather(speeds, wanted, sampled, phase == 0, self._decay, self.rows):
            raise ValueError(f'errors must be finite: got {speeds - wanted}')
        if phase == 0:
            self._renew(self._no_change if known_change is None else known_change)
        self.phase = (phase + 1) % timing.every

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
            self.rows[_DRAWN] = self.settings.dither * drawn
        timing = self._timing
        renew(
            self._stores,
            self._sizes,
            self.rows,
            self._tables,
            self._nominal_response,
            self._decays,
            change,
            self.samples,
            timing.average,
            timing.every,
            self._decay,
            self._rules,
            self._how_told,
            self._numbers,
            self._whole,
            self.status,
        )
        self._skill = self.rows[_SKILLS].copy()
        self.samples += 1
