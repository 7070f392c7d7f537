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
"""Predictive controller: v_p of every wheel from its tracking error, equations (34)-(63)."""

from collections.abc import Mapping
import copy
from dataclasses import dataclass, replace
from functools import lru_cache
import math
from typing import ClassVar, NamedTuple, Self

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import TypedKernel, contiguous, kernel
from t3mpc_ros.mpc.boltzmann_machine import LayerSizes, make_machine, reset_history
from t3mpc_ros.mpc.online_learning_predictor import (
    LearningConstants,
    Predictor,
    WheelState,
    authority,
    observe,
    predict_responses,
    predicted_errors,
    skill_score,
    toeplitz,
)
from t3mpc_ros.mpc.pretraining import (
    ExcitationParameters,
    NominalLoopParameters,
    SampleTiming,
    nominal_step_response,
    simulate_excitation,
)
from t3mpc_ros.mpc.quadratic_program import (
    normal_equations,
    solve_quadratic_program,
    sum_rows,
    write_bounds,
)
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter


@dataclass(frozen=True)
class PredictiveParameters(Parameters):
    """Horizon, bounds, machine and learning of the predictive controller."""

    enabled: bool = parameter(
        True, 'whether v_p is applied; the machine learns in either case', dynamic=True
    )
    decimation: int = parameter(
        5, 'control periods per predictive period T; n_p T should reach 3/K', bounds=(1, 100)
    )
    average: int = parameter(
        5, 'newest errors in the mean of one sample, at most decimation', bounds=(1, 100)
    )
    horizon: int = parameter(10, 'prediction horizon n_p, in periods T', bounds=(1, 50))
    control_horizon: int = parameter(
        5, 'control horizon n_c: later changes of v_p are zero', bounds=(1, 50)
    )
    error_weight: ClassVar[float] = 1.0  # mu of (60), s²/rad²: only its ratio to pi matters
    move_weight: float = parameter(
        0.029, 'pi of (60), with mu = 1 s²/rad²', 's⁴/rad²', (1e-9, 1e6), dynamic=True
    )
    v_max: float = parameter(
        10.0, 'bound of v_p, v_p-bar of (80)', 'rad/s²', (0.0, 1e4), dynamic=True
    )
    dv_max: float = parameter(
        4.0, 'bound of the change of v_p in a period T', 'rad/s²', (0.0, 1e4), dynamic=True
    )
    dither: float = parameter(
        0.0,
        'maximum random level added to v_p, a new one each period. Use it to record bags for '
        'training: with feedback alone v_p varies too little to identify its effect',
        'rad/s²',
        (0.0, 1e3),
        dynamic=True,
    )
    probe: ClassVar[float] = 1.0  # step dv of the step response (48), (51), rad/s², assumed
    delta_lags: ClassVar[int] = 4  # past errors in the visible layer, tau of (35), assumed
    move_lags: ClassVar[int] = 4
    """Past v_p in the visible layer, assumed; they must cover the dead time."""
    hidden: ClassVar[int] = 12  # number of hidden units, assumed; at least that of the lags
    spread: ClassVar[float] = 1.0  # length of each row of the initial X_v, assumed
    delta_scale: ClassVar[float] = 3.0  # error that is 1 inside the machine, rad/s, assumed
    move_scale: ClassVar[float] = 20.0  # v_p that is 1 inside the machine, rad/s², assumed
    learning: bool = parameter(True, 'whether the machine learns online', dynamic=True)
    algorithm: str = parameter(
        'recursive',
        'learning of the output layer: recursive least squares, or the normalised gradient (44)',
        choices=('recursive', 'gradient'),
    )
    memory: ClassVar[float] = 20.0  # time constant of forgetting, s, assumed
    trust: ClassVar[float] = 30.0
    """Weight of the pretraining, as a duration of online learning, s, assumed."""
    output_rate: ClassVar[float] = 0.05  # gamma of (44), normalised, assumed
    contrast_rate: ClassVar[float] = 1e-4  # gamma of (43) online, assumed
    offset_gain: float = parameter(
        0.0032, 'gain of the offset e on the last prediction error', bounds=(0.0, 1.0)
    )
    noise: ClassVar[float] = 0.05
    """Standard deviation of the noise of a sample of the error, rad/s, assumed."""
    skill_memory: ClassVar[float] = 5.0  # time constant of the skill, s, assumed
    skill_low: ClassVar[float] = -1.0  # skill up to which the authority of v_p is 0, assumed
    skill_high: ClassVar[float] = 0.0
    """Skill from which the authority of v_p is 1, assumed; 0 is as good as persistence."""
    gain_low: ClassVar[float] = 0.2
    """Step response over the nominal one up to which the authority is 0, assumed."""
    gain_high: ClassVar[float] = 0.5
    """Step response over the nominal one from which it is 1, assumed."""
    seed: int = parameter(
        1, 'seed of the initial weights and of the simulated run', bounds=(0, None)
    )
    nominal: ClassVar[NominalLoopParameters] = NominalLoopParameters()
    """Loop of the pretraining; the controller replaces its feedback gain by its own."""
    excitation: ClassVar[ExcitationParameters] = ExcitationParameters()  # run of the pretraining

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for horizons or periods in the wrong order."""
        for low, high in (('control_horizon', 'horizon'), ('average', 'decimation')):
            small, large = getattr(self, low), getattr(self, high)
            if small > large:
                raise ParameterError(f'{low} must be at most {high} = {large}: got {small}')


def learning_constants(parameters: PredictiveParameters, span: float) -> LearningConstants:
    """Return the constants of online learning for a predictive period of ``span`` s."""
    return LearningConstants(
        recursive=parameters.algorithm == 'recursive',
        contrast_rate=parameters.contrast_rate,
        output_rate=parameters.output_rate,
        rls_forgetting=math.exp(-span / parameters.memory),
        power_forgetting=math.exp(-span / 2.0),
        skill_forgetting=math.exp(-span / parameters.skill_memory),
        offset_gain=parameters.offset_gain,
        noise=parameters.noise,
    )


class MoveConstants(NamedTuple):
    """Constants of the computation of v_p, for kernels."""

    enabled: bool
    learning: bool
    dithered: bool
    quiet_threshold: float
    """Residual of a jump (rad/s) above which the machine does not learn: limits of the robot
    dominate the decay of a large jump."""
    probe: float
    error_weight: float
    move_weight: float
    v_max: float
    dv_max: float
    skill_low: float
    skill_high: float
    gain_low: float
    gain_high: float
    average: int  # control periods in the mean of a sample
    decimation: int  # control periods in a period T
    nominal_response: float  # nominal step response in the middle of the horizon
    decay: float  # decay of a known jump per control period
    decays: Array  # decay of a known jump after 0, 1, ... periods T, shape (n_p + 1,)

    @classmethod
    def of(
        cls, parameters: PredictiveParameters, loop: NominalLoopParameters, timing: SampleTiming
    ) -> Self:
        """Return the constants of the parameters with the feedback of the nominal loop."""
        horizon, feedback = parameters.horizon, loop.feedback_gain
        steps = nominal_step_response(loop, timing, horizon)
        same = {
            name: getattr(parameters, name) for name in cls._fields if hasattr(parameters, name)
        }
        return cls(
            **same,
            dithered=parameters.enabled and parameters.dither > 0.0,
            quiet_threshold=0.1 * parameters.delta_scale,
            nominal_response=float(steps[max(horizon // 2, 1) - 1]),
            decay=math.exp(-feedback * timing.period),
            decays=np.exp(-feedback * timing.span * np.arange(horizon + 1)),
        )


class Responses(NamedTuple):
    """Responses of each output over the horizon, shape (outputs, n_p) each."""

    steps: Array  # step responses (48), (rad/s)/(rad/s²)
    free: Array  # Psi_free (56), rad/s
    prediction: Array  # predictions Psi (52), rad/s
    known: Array  # future errors of known jumps, rad/s


class Programs(NamedTuple):
    """The quadratic program of each output; the first axis of every array is the output."""

    matrix: Array  # S (54), shape (outputs, n_p, n_c)
    hessian: Array  # shape (outputs, n_c, n_c)
    gradient: Array  # shape (outputs, n_c)
    lower: Array  # bounds of the rows, shape (outputs, 2 n_c - 1), as the next
    upper: Array
    v_previous: Array  # v_p(t-1), rad/s², shape (outputs,)
    v_max: Array  # bound of v_p in this period, rad/s², shape (outputs,)
    changes: Array  # solution dv, rad/s², shape (outputs, n_c); zero where there is none

    @classmethod
    def make(cls, outputs: int, horizon: int, moves: int) -> Self:
        """Return empty programs."""
        shapes = ((horizon, moves), (moves, moves), (moves,), *[(2 * moves - 1,)] * 2, (), ())
        return cls(*(np.zeros((outputs, *shape)) for shape in (*shapes, (moves,))))


class Signals(NamedTuple):
    """State of the computation of v_p, shape (outputs,) each."""

    sums: Array  # sum of the errors of the present sample, rad/s
    applied_sums: Array  # sum of the v_p applied since the last sample, rad/s²
    applied: Array
    """v_p applied in the present control period, rad/s², where a limit reduced it: the machine
    learns from it, and the next change starts from it, limited to the range from zero to v."""
    v: Array  # v_p (63), held between samples, rad/s²
    dither: Array  # random part of v_p, rad/s²
    next_dither: Array  # random part of the next v_p, rad/s²
    jumps: Array  # residual of the known jumps of the error, rad/s
    authorities: Array  # fraction of the bound of v_p in use
    skills: Array  # skill in the middle of the horizon
    errors: Array  # the last errors delta = chi - r, rad/s
    jump_free_errors: Array  # the same without the residual of the known jumps, rad/s


@kernel
def end_control_period(signals: Signals, decay: float) -> None:
    """End a control period: known jumps decay, and v_p is assumed to be applied."""
    for z in range(signals.v.size):
        signals.jumps[z] *= decay
        signals.applied[z] = signals.v[z]


@kernel
def accumulate_sample(
    speeds: Array, reference: Array, sampled: bool, due: bool, decay: float, signals: Signals
) -> bool:
    """Add a control period to the sums of the sample; return False if an error is not finite.

    sampled : whether this period's errors belong to the sample
    due     : whether the sample is complete; the next step then ends the period
    """
    for z in range(speeds.size):
        if not math.isfinite(speeds[z] - reference[z]):
            return False
    for z in range(speeds.size):
        signals.errors[z] = speeds[z] - reference[z]
        signals.applied_sums[z] += signals.applied[z]
        signals.jump_free_errors[z] = signals.errors[z] - signals.jumps[z]
        if sampled:
            signals.sums[z] += signals.jump_free_errors[z]
    if not due:
        end_control_period(signals, decay)
    return True


@kernel
def predict_known_errors(jump: float, decays: Array, change: Array, known: Array) -> None:
    """Write the future errors caused by past and future known jumps, decaying with K.

    ``jump`` is the residual of the past ones; ``change`` has the jumps in each future period T.
    """
    for j in range(known.size):
        known[j] = jump * decays[j + 1]
    for j in range(change.size):
        for i in range(j, known.size):
            known[i] += change[j] * decays[i - j]


@kernel
def prepare_programs(
    wheels: tuple[WheelState, ...],
    signals: Signals,
    responses: Responses,
    change: Array,
    samples: int,
    constants: MoveConstants,
    learning: LearningConstants,
    programs: Programs,
) -> None:
    """Process the sample of each output, and write its quadratic program: (34)-(61).

    ``change``, shape (n_p, outputs), has the jumps in each future period T, rad/s.
    """
    for z in range(len(wheels)):
        wheel = wheels[z]
        machine, history = wheel.machine, wheel.history
        steps, free, known = responses.steps[z], responses.free[z], responses.known[z]
        predict_known_errors(signals.jumps[z], constants.decays, change[:, z], known)
        # The first sample has one measurement and no history.
        sample = signals.sums[z] / (constants.average if samples > 0 else 1)
        if samples == 0:
            reset_history(history, sample)
        enough = samples > history.errors.size
        observe(
            machine,
            wheel.rls,
            history,
            sample,
            signals.applied_sums[z] / constants.decimation,
            enough,
            enough and abs(signals.jumps[z]) < constants.quiet_threshold and constants.learning,
            learning,
        )
        # (62) starts from v_p(t-1) as applied, without the dither. A reduced bound takes effect at
        # once, regardless of dv_max, because the compensator (81) relies on it.
        v = signals.v[z] - signals.dither[z]
        v_previous = min(max(signals.applied[z] - signals.dither[z], min(v, 0.0)), max(v, 0.0))
        v_previous = min(max(v_previous, -constants.v_max), constants.v_max)
        predict_responses(machine, history, v_previous, constants.probe, known, steps, free)
        # The smaller of both skills: half a horizon ahead even an untrained machine may predict
        # a decaying error well, but not one step ahead.
        signals.skills[z] = skill_score(history, 1)
        share = authority(
            min(skill_score(history, 0), signals.skills[z]),
            steps[history.offsets.size - 1] / constants.nominal_response,
            constants.skill_low,
            constants.skill_high,
            constants.gain_low,
            constants.gain_high,
        )
        signals.authorities[z] = share if constants.enabled else 0.0
        # A decreasing authority reduces v_p by at most dv_max per period, without a step.
        bound = max(signals.authorities[z] * constants.v_max, abs(v_previous) - constants.dv_max)
        toeplitz(steps, programs.matrix[z])
        normal_equations(
            programs.matrix[z],
            free,
            constants.error_weight,
            constants.move_weight,
            programs.hessian[z],
            programs.gradient[z],
        )
        write_bounds(v_previous, constants.dv_max, bound, programs.lower[z], programs.upper[z])
        programs.v_previous[z] = v_previous
        programs.v_max[z] = bound


@kernel
def apply_moves(
    signals: Signals, responses: Responses, constants: MoveConstants, programs: Programs
) -> None:
    """Update v_p (63) and the predicted errors (52) by the solutions; end the sample."""
    for z in range(signals.v.size):
        changes, bound = programs.changes[z], programs.v_max[z]
        predicted_errors(programs.matrix[z], changes, responses.free[z], responses.prediction[z])
        # Rounding must not move v_p beyond its bound, or leave a residual when it is zero.
        v = min(max(programs.v_previous[z] + changes[0], -bound), bound)
        signals.v[z] = v
        if constants.dithered:
            signals.v[z] = min(max(v + signals.next_dither[z], -constants.v_max), constants.v_max)
        signals.dither[z] = signals.v[z] - v
        signals.sums[z] = 0.0
        signals.applied_sums[z] = 0.0
    end_control_period(signals, constants.decay)


@lru_cache(maxsize=8)
def _pretrained(
    parameters: PredictiveParameters,
    excitation: ExcitationParameters,
    loop: NominalLoopParameters,
    timing: SampleTiming,
    learning: LearningConstants,
    outputs: int,
) -> list[Predictor]:
    """Return new machines, pretrained on the simulated nominal loop; the caller copies them.

    A process builds many controllers with equal parameters: a node warms up with one of its own,
    a study has one for each run.
    """
    generator = np.random.default_rng(parameters.seed)
    predictors: list[Predictor] = []
    sizes = LayerSizes(parameters.delta_lags, parameters.move_lags, parameters.hidden)
    trial = replace(excitation, duration=max(0.25 * excitation.duration, 10.0))
    for _ in range(outputs):
        machine = make_machine(
            sizes, parameters.delta_scale, parameters.move_scale, parameters.spread, generator
        )
        runs = [
            simulate_excitation(loop, each, timing, parameters.move_scale, generator)
            for each in (excitation, trial)
        ]
        predictor = Predictor(machine, parameters.horizon, runs[1])
        predictor.fit(*runs[0], excitation, parameters.trust / timing.span, learning)
        predictors.append(predictor)
    return predictors


class PredictiveController:
    """Computes v_p of each output from its tracking error, equations (34)-(63).

    :meth:`step` is called in every control period. Every ``decimation`` periods each machine
    processes a sample, learns and predicts, and the quadratic programs are solved; v_p is held in
    between.

    A jump of the reference is a known jump of the error, which decays with the feedback K of the
    control law: exp(-K t). This known part is subtracted from the input of the machine and added
    to its prediction, so a jump of any size is not learned as dynamics and does not saturate the
    machine.

    period : control period, s
    feedback_gain : K of the control law (1/s); it replaces the one in ``parameters.nominal``
    """

    def __init__(
        self,
        parameters: PredictiveParameters,
        period: float,
        feedback_gain: float,
        outputs: int = 2,
    ) -> None:
        self._timing = SampleTiming(period, parameters.decimation, parameters.average)
        self.span = span = self._timing.span  # predictive period T, s
        if parameters.move_lags * span < parameters.nominal.dead_time + span:
            raise ParameterError(
                f'{parameters.move_lags} periods of v_p must cover the dead time of '
                f'{parameters.nominal.dead_time} s and one period: got {span:g} s for a period, '
                'which predictive.decimation sets'
            )
        self.signals = Signals(*np.zeros((len(Signals._fields), outputs)))
        """The signals, for kernels."""
        self.responses = Responses(*np.zeros((4, outputs, parameters.horizon)))
        self._zeros = np.zeros(outputs)
        self._no_change = np.zeros((parameters.horizon, outputs))
        moves = parameters.control_horizon
        self._work = Programs.make(outputs, parameters.horizon, moves)
        self._sums = sum_rows(moves)
        self.solved = np.ones(outputs, dtype=np.bool_)
        """Whether the last program of each output had a solution; without one v_p is held."""
        self._accumulate_sample = TypedKernel(accumulate_sample)
        self._prepare_programs = TypedKernel(prepare_programs)
        self._apply_moves = TypedKernel(apply_moves)
        self.parameters = parameters
        self.configure(parameters, feedback_gain)
        self.pretrain()

    def configure(
        self, parameters: PredictiveParameters, feedback_gain: float | None = None
    ) -> None:
        """Replace dynamic parameters, and K (1/s), from the next step on."""
        self.parameters.check_read_only(parameters)
        if feedback_gain is not None:
            if not feedback_gain > 0.0:
                raise ValueError(f'feedback_gain must be positive: got {feedback_gain}')
            self._loop = replace(parameters.nominal, feedback_gain=feedback_gain)
        self.parameters = parameters
        self._learning = learning_constants(parameters, self._timing.span)
        self._constants = MoveConstants.of(parameters, self._loop, self._timing)

    def pretrain(self) -> None:
        """Create new machines, pretrain them on the simulated nominal loop, then :meth:`reset`."""
        parameters = self.parameters
        made = _pretrained(
            parameters,
            parameters.excitation,
            self._loop,
            self._timing,
            self._learning,
            self.solved.size,
        )
        self._predictors = copy.deepcopy(made)
        self._wheels = tuple(predictor.state for predictor in self._predictors)
        self.reset()

    def reset(self) -> None:
        """Clear the history and set v_p to 0; keep weights and skill."""
        for array in (*self.signals, *self.responses):
            array[:] = 0.0
        self._generator = np.random.default_rng((self.parameters.seed, 1))
        self.solved[:] = True
        self.phase = 0  # control periods since the last sample, below ``decimation``
        self.samples = 0  # number of samples
        for predictor in self._predictors:
            reset_history(predictor.history, 0.0)
        self.skill = np.array(
            [skill_score(predictor.history, 1) for predictor in self._predictors]
        )
        """Skill against persistence in the middle of the horizon, shape (outputs,); read-only."""
        self.signals.skills[:] = self.skill

    def warm_up(self) -> None:
        """Compile every kernel now instead of in the first step, then :meth:`reset`."""
        for _ in range(2 * self._timing.decimation):
            self.step(np.zeros(self.solved.size))
        self.reset()

    def get_weights(self) -> dict[str, Array]:
        """Return all learned arrays, for saving; the first axis is the output."""
        each = [predictor.get_weights() for predictor in self._predictors]
        return {name: np.stack([one[name] for one in each]) for name in each[0]}

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Set the arrays of :meth:`get_weights`, and measure the skill on the trial run.

        Values that do not fit raise ValueError and change nothing.
        """
        now = self.get_weights()
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
            predictor.set_weights(
                {name: value[z] for name, value in weights.items()}, self._learning
            )
        self.reset()

    def notify_jump(self, jump: Array) -> None:
        """Add a known jump of the error (rad/s) at the :meth:`step` of this period."""
        self.signals.jumps[:] += jump

    def step(self, errors: Array, known_change: Array | None = None) -> Array:
        """Return v_p (rad/s²), shape (outputs,), equation (63), for errors delta = chi - r, rad/s.

        known_change : known future jumps of delta, shape (n_p, outputs), rad/s: row j is the sum
            of the jumps between t + jT and t + (j+1)T. Each is added to Psi_free from its time on,
            and decays. Used only in steps that solve the quadratic program, see :attr:`due`.
        """
        self.advance(contiguous(errors), self._zeros, known_change)
        return self.signals.v.copy()

    def advance(self, speeds: Array, reference: Array, known_change: Array | None = None) -> None:
        """Update ``signals`` like :meth:`step`; ValueError if an error is not finite."""
        timing, phase = self._timing, self.phase
        sampled = phase == 0 or phase > timing.decimation - timing.average
        if not self._accumulate_sample(
            speeds, reference, sampled, phase == 0, self._constants.decay, self.signals
        ):
            raise ValueError(f'errors must be finite: got {speeds - reference}')
        if phase == 0:
            if self._constants.dithered:
                next_dither = self._generator.uniform(-1.0, 1.0, self.solved.size)
                self.signals.next_dither[:] = self.parameters.dither * next_dither
            self._prepare_programs(
                self._wheels,
                self.signals,
                self.responses,
                self._no_change if known_change is None else known_change,
                self.samples,
                self._constants,
                self._learning,
                self._work,
            )
            self._solve()
            self._apply_moves(self.signals, self.responses, self._constants, self._work)
            self.skill = self.signals.skills.copy()
            self.samples += 1
        self.phase = (phase + 1) % timing.decimation

    def _solve(self) -> None:
        """Write the changes that solve each program, and whether there were any."""
        programs = self._work
        for z in range(self.solved.size):
            changes = solve_quadratic_program(
                programs.hessian[z],
                programs.gradient[z],
                self._sums,
                programs.lower[z],
                programs.upper[z],
            )
            self.solved[z] = changes is not None
            programs.changes[z] = 0.0 if changes is None else changes

    @property
    def due(self) -> bool:
        """Whether the next :meth:`step` solves the quadratic program, with ``known_change``."""
        return self.phase == 0
