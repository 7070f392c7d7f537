# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The predictive term v_p of the control law: one machine and one program per wheel."""

from collections.abc import Mapping
from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.mpc.active_set import OPTIMAL
from t3mpc_ros.mpc.machine import Shape, begin, make_machine
from t3mpc_ros.mpc.program import make_space
from t3mpc_ros.mpc.response import foresee, plan
from t3mpc_ros.mpc.settings import PredictiveSettings
from t3mpc_ros.mpc.skill import Learning, Predictor, fade, gather, observe, skill
from t3mpc_ros.mpc.training import Timing, excite, nominal_step, split_runs
from t3mpc_ros.settings import SettingError

__all__ = ['PredictiveSettings', 'PredictiveTerm']

Array = NDArray[np.float64]


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
        shape = (outputs, settings.horizon)
        self._steps = np.zeros(shape)
        self._free = np.zeros(shape)
        self._prediction = np.zeros(shape)
        self._known = np.zeros(shape)
        self._matrix = np.zeros((settings.horizon, settings.control_horizon))
        self._space = make_space(settings.control_horizon)
        self._sums = np.zeros(outputs)
        self._applied_sums = np.zeros(outputs)
        self._applied = np.zeros(outputs)
        self._v = np.zeros(outputs)
        self._dither = np.zeros(outputs)
        self._jumps = np.zeros(outputs)
        self._fades = np.zeros(outputs)
        self.status: NDArray[np.int64] = np.zeros(outputs, dtype=np.int64)
        """How each output's last program ended, see :mod:`t3mpc_ros.mpc.active_set`."""
        self.settings = settings
        self.configure(settings, feedback_gain)
        self.relearn()

    @property
    def skill(self) -> Array:
        """Skill against persistence in the middle of the horizon, shape (outputs,)."""
        return np.array([skill(wheel.past, 1) for wheel in self._predictors])

    @property
    def skill_next(self) -> Array:
        """Skill against persistence one step ahead, shape (outputs,)."""
        return np.array([skill(wheel.past, 0) for wheel in self._predictors])

    @property
    def fade(self) -> Array:
        """Share of v_p's bound in force, in [0, 1], shape (outputs,)."""
        return self._fades.copy()

    @property
    def prediction(self) -> Array:
        """Predicted errors Psi (52) under the planned moves, rad/s, shape (outputs, n_p)."""
        return self._prediction.copy()

    @property
    def step_response(self) -> Array:
        """Latest s_0 ... s_{n_p-1} (48), (rad/s)/(rad/s²), shape (outputs, n_p)."""
        return self._steps.copy()

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
            self._nominal_steps = nominal_step(self._loop, self._timing, settings.horizon)
        self.settings = settings
        self._how = Learning.of(settings, self._timing.span)

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
        settings, outputs = self.settings, self._v.size
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
        self.reset()

    def reset(self) -> None:
        """Forget the past, and start from v_p = 0; weights and skill are kept."""
        for array in (self._sums, self._applied_sums, self._applied, self._v, self._jumps):
            array[:] = 0.0
        for table in (self._steps, self._free, self._prediction, self._fades, self._dither):
            table[:] = 0.0
        self._generator = np.random.default_rng((self.settings.seed, 1))
        self.status[:] = OPTIMAL
        self._phase = 0
        self._samples = 0
        for predictor in self._predictors:
            begin(predictor.past, 0.0)

    def warm_up(self) -> None:
        """Compile every kernel now, never inside a step; nothing is remembered of it."""
        for _ in range(2 * self._timing.every):
            self.step(np.zeros(self._v.size))
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

    def notify_applied(self, v_p: Array) -> None:
        """Tell what was applied of the v_p last returned (rad/s²), when it was not all of it.

        The machine must learn from what really acted. What goes beyond v_p, or against it, acts
        too, but is no start for the next change: that starts between zero and v_p.
        """
        if np.shape(v_p) != self._v.shape or not np.isfinite(v_p).all():
            raise ValueError(f'v_p must be {self._v.size} finite numbers: got {v_p}')
        self._applied[:] = v_p

    def shift(self, jump: Array) -> None:
        """Tell that the error jumps by ``jump`` (rad/s) at the coming step, because r jumps.

        Call it before :meth:`step` of the same period; jumps add up.
        """
        if np.shape(jump) != self._v.shape or not np.isfinite(jump).all():
            raise ValueError(f'jump must be {self._v.size} finite numbers: got {jump}')
        self._jumps += jump

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
        every, phase = self._timing.every, self._phase
        errors = np.asarray(errors, dtype=np.float64)
        if errors.shape != self._v.shape:
            raise ValueError(f'errors must have shape {self._v.shape}: got {errors.shape}')
        if phase == 0 and known_change is not None:
            shape = (self.settings.horizon, self._v.size)
            if np.shape(known_change) != shape or not np.isfinite(known_change).all():
                raise ValueError(
                    f'known_change must be {shape[0]} by {shape[1]} finite numbers: '
                    f'got {known_change}'
                )
        sampled = phase == 0 or phase > every - self._timing.average
        if not gather(errors, self._jumps, self._applied, sampled, self._sums, self._applied_sums):
            raise ValueError(f'errors must be finite: got {errors}')
        if phase == 0:
            self._set_known(known_change)
            for z, predictor in enumerate(self._predictors):
                self._advance(z, predictor)
            self._sums[:] = 0.0
            self._applied_sums[:] = 0.0
            self._samples += 1
        self._phase = (phase + 1) % every
        self._jumps *= self._decay
        self._applied[:] = self._v
        return self._v.copy()

    @property
    def known_error(self) -> Array:
        """What is left of the jumps told by :meth:`shift`, rad/s, shape (outputs,)."""
        return self._jumps

    @property
    def span(self) -> float:
        """Predictive period T, s."""
        return self._timing.span

    @property
    def due(self) -> bool:
        """Whether the next :meth:`step` solves the program, and reads ``known_change``."""
        return self._phase == 0

    def _set_known(self, known_change: Array | None) -> None:
        """Write the known part of the future error: jumps past and to come, dying away by K."""
        self._known[:] = np.outer(self._jumps, self._decays[1:])
        if known_change is not None:
            for j, row in enumerate(known_change):
                self._known[:, j:] += np.outer(row, self._decays[: self._decays.size - 1 - j])

    def _advance(self, z: int, predictor: Predictor) -> None:
        """Take the sample of one output, and renew its v_p."""
        settings, past = self.settings, predictor.past
        # The first sample has one measurement; nothing was before it.
        sample = self._sums[z] / (self._timing.average if self._samples else 1)
        if not self._samples:
            begin(past, sample)
        known_enough = self._samples > past.errors.size
        # What is left of a large jump is mostly how the robot's limits spoilt its decay.
        calm = abs(self._jumps[z]) < 0.1 * settings.delta_scale
        observe(
            predictor.machine,
            predictor.memory,
            past,
            sample,
            self._applied_sums[z] / self._timing.every,
            known_enough,
            known_enough and calm and settings.learning,
            self._how,
        )
        # (62) starts from v_p(t-1) as applied, less the dither. A bound that has just been lowered
        # is kept at once, because the compensator (81) counts on it: that is no part of dv_max.
        dither = self._dither[z]
        v = self._v[z] - dither
        held = min(max(self._applied[z] - dither, min(v, 0.0)), max(v, 0.0))
        held = min(max(held, -settings.v_max), settings.v_max)
        foresee(
            predictor.machine,
            past,
            held,
            settings.probe,
            self._known[z],
            self._steps[z],
            self._free[z],
        )
        middle = past.offsets.size - 1
        # Whichever is worse: a response that goes to zero is hard to beat half a horizon ahead,
        # but an untaught machine misses the very next error by far.
        share = fade(
            min(skill(past, 0), skill(past, 1)),
            self._steps[z, middle] / self._nominal_steps[middle],
            settings.fade_low,
            settings.fade_high,
            settings.gain_low,
            settings.gain_high,
        )
        self._fades[z] = share if settings.enabled else 0.0
        # A share that falls takes v_p out no faster than dv_max, so that no step is made of it.
        bound = max(self._fades[z] * settings.v_max, abs(held) - settings.dv_max)
        self.status[z] = plan(
            self._steps[z],
            self._free[z],
            held,
            settings.error_weight,
            settings.move_weight,
            settings.dv_max,
            bound,
            self._matrix,
            self._space,
            self._prediction[z],
        )
        # Rounding must not carry v_p over its bound, nor leave dust when it is zero.
        v = min(max(held + self._space.changes[0], -bound), bound)
        self._v[z] = v
        if settings.dither > 0.0 and settings.enabled:
            level = v + settings.dither * self._generator.uniform(-1.0, 1.0)
            self._v[z] = min(max(level, -settings.v_max), settings.v_max)
        self._dither[z] = self._v[z] - v
