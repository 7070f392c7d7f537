# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Body correction: NT3FS learns how the body turns under commanded wheel speeds.

The wheels of a stepper follow their command almost exactly; the body does not: wheel radii and
separation differ from the nominal ones, and tyres slip. With w the yaw rate expressed as half of
the difference of the wheel speeds, w = b omega / R, the body obeys

.. math:: w_a = w_c + g_b^*(U) + \nu, \qquad U = (\dot\theta_{R,c}, \dot\theta_{L,c})        E20

for the commanded wheel speeds U of one dead time before, with an unknown map g_b* and the noise nu
of the gyro. g_b(U|alpha) is a fuzzy system (31) with the adaptation (77) of its coefficients,

.. math:: \dot\alpha = \gamma \Phi \, \mathrm{clip}(w_a - w_c - g_b(U|\alpha)),

clipped to 0.08 rad/s, so that a slide of the tyres is hardly learnt; the product gamma |Phi|² =
``learning_rate`` normalises. With V = |alpha* - alpha|²/(2 gamma), e = g_b* - g_b and
g_b* = alpha*ᵀ Phi, V' = -e clip(e + nu): V decreases outside the noise. The reference of the law
becomes

.. math:: w_r - a\,g_b(U_r|\alpha) - a\,v_\psi, \qquad v_\psi = \bar v \tanh(k e_\psi/\bar v)  E21

with e_psi the integral of w_a - w_r: the compensator (81)-(82) in the form of E14, for the yaw.
The authority a in [0, 1] is the measured skill of g_b: the share of the variance of w_a - w_c,
averaged over a quarter of a second, that the map predicts *before* it learns from it. On a robot
with nominal geometry there is nothing to predict: a is 0, and nothing is corrected.

What odometry and gyro cannot measure stays: a scale error common to both wheels changes the
distance only.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

import numpy as np

from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, estimate
from t3mpc_ros.fuzzy.inference import FuzzyParameters, FuzzyTables
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import Structure, TypedKernel, kernel
from t3mpc_ros.parameters.table import Parameters, parameter

HISTORY = 64
"""Number of commands kept."""
BLOCK = 0.25
"""Time over which a residual is averaged for the skill, s."""
IMPLAUSIBLE = 0.2
"""Error relative to the commanded wheel speeds above which nothing is corrected: the odometry has
no yaw, or the wheels do not move the robot."""
OUTLIER = 1.0
"""Error of a single step (rad/s) that is no property of the robot: a push, or a slip."""
CLIP = 0.08
"""Largest error that is learnt at once, rad/s. A slide of the tyres, which depends on the floor
and not on the commands, changes the map no more than an error of this size does."""
FULL_SKILL, NO_SKILL = 0.6, 0.2
"""Skill from which on the authority is 1, and up to which it is 0."""


@dataclass(frozen=True)
class BodyCorrectionParameters(Parameters):
    """Correction of the yaw rate, learnt from the yaw of the odometry."""

    enabled: bool = parameter(
        True,
        'whether the yaw rate is corrected; needs an odometry whose yaw comes from a gyro',
        dynamic=True,
    )
    learning_rate: float = parameter(
        2.0,
        'gamma |Phi|²: rate at which the map approaches the present yaw rate',
        '1/s',
        (0.0, 50.0),
        dynamic=True,
    )
    skill_time: float = parameter(5.0, 'time constant of the measured skill', 's', (0.5, 600.0))
    dead_zone: float = parameter(
        0.015,
        'error of a wheel that is not worth correcting: noise of the gyro, averaged over 0.25 s, '
        'and errors of the assumed delay',
        'rad/s',
        (0.0, 10.0),
        dynamic=True,
    )
    yaw_gain: float = parameter(0.15, 'gain k of the yaw error', '1/s', (0.0, 20.0), dynamic=True)
    max_correction: float = parameter(
        1.0, 'bound of the correction of a wheel by the map', 'rad/s', (0.0, 10.0), dynamic=True
    )
    max_yaw_correction: float = parameter(
        0.06,
        'v-bar: bound of the correction of a wheel by the yaw error, so that a robot that was '
        'turned by a slide turns back slowly: its error is the less',
        'rad/s',
        (0.0, 10.0),
        dynamic=True,
    )
    fuzzy: ClassVar[FuzzyParameters] = FuzzyParameters(
        sets=5, centre_exponent=1.0, input_fuzziness=0.05
    )
    """Sets of the map over the wheel speeds, assumed."""


class BodyMemory(Structure):
    """What :func:`correct_body` remembers, in wheel speeds (rad/s) and s.

    Sums are over the present block, powers are means over the past blocks. *raw* is w_a - w_c with
    the residual clipped, *error* without; *residual* is what the map leaves of it.
    """

    yaw: float
    """Last yaw of the odometry, rad."""
    started: bool
    """Whether there is one."""
    last_reference: float
    yaw_error: float
    """Integral of w_a - w_r."""
    commands: int
    """Number of known commands, at most HISTORY."""
    block_time: float
    raw_sum: float
    residual_sum: float
    command_sum: float
    error_sum: float
    raw_power: float
    residual_power: float
    command_power: float
    error_power: float
    authority: float
    """Share of the correction that is in use."""


DRIVE = (
    *('started', 'yaw_error', 'commands'),
    *('block_time', 'raw_sum', 'residual_sum', 'command_sum', 'error_sum'),
)
"""Fields of the memory that belong to one drive."""
SKILL = 'raw_power', 'residual_power', 'command_power', 'error_power', 'authority'
"""Fields that say how well the map predicts."""


class BodyConstants(NamedTuple):
    """Constants of :func:`correct_body`."""

    turn: float
    """R/b"""
    period: float
    """s"""
    learning_rate: float
    """gamma |Phi|², 1/s"""
    share: float
    """Part of the powers that a block replaces."""
    yaw_gain: float
    """k, 1/s"""
    bound: float
    """Bound of the map's correction, rad/s"""
    yaw_bound: float
    """v-bar, rad/s"""
    dead_zone: float
    """rad/s"""


class BodyState(NamedTuple):
    """State of :func:`correct_body`, changed in place."""

    memory: Sequence[BodyMemory]
    """Array of one."""
    history: Array
    """Commands, newest first, rad/s, shape (n, 2)."""
    point: Array
    """Work space: inputs of the map, shape (2,)."""
    output: Array
    """Work space: output of the map, shape (1,)."""


class BodyCorrection:
    """Corrects the reference of the wheels such that the body turns as the reference does: E20.

    ``wheel_radius`` and ``half_separation`` are the nominal R and b, m; ``period`` is that of
    control, s.
    """

    def __init__(
        self,
        parameters: BodyCorrectionParameters,
        wheel_radius: float,
        half_separation: float,
        period: float,
    ) -> None:
        self._turn = wheel_radius / half_separation
        self._period = period
        self.fuzzy = FuzzyEstimator(parameters.fuzzy, AdaptationParameters(), outputs=1)
        self._memory = BodyMemory.new()
        self._state = BodyState(self._memory, np.zeros((HISTORY, 2)), np.zeros(2), np.zeros(1))
        self._correct_body = TypedKernel(correct_body)
        self.configure(parameters)

    def configure(self, parameters: BodyCorrectionParameters) -> None:
        """Use new values of the dynamic parameters from the next step on."""
        self.parameters = parameters
        self._constants = BodyConstants(
            self._turn,
            self._period,
            parameters.learning_rate,
            BLOCK / parameters.skill_time,
            parameters.yaw_gain,
            parameters.max_correction,
            parameters.max_yaw_correction,
            parameters.dead_zone,
        )

    @property
    def authority(self) -> float:
        """Fraction of the correction in use, in [0, 1]."""
        return float(self._memory[0].authority)

    @property
    def yaw_error(self) -> float:
        """Yaw of the robot minus that of the reference since the start of the drive, rad."""
        return float(self._memory[0].yaw_error * self._turn)

    def restart(self) -> None:
        """Start a drive: clear yaw error and history; map and skill are kept."""
        self._state.history[:] = 0.0
        for name in DRIVE:
            setattr(self._memory[0], name, 0)

    def reset(self) -> None:
        """Discard the map and its skill too."""
        for name in BodyMemory.__annotations__:
            setattr(self._memory[0], name, 0)
        self.fuzzy.reset()
        self.restart()

    def snapshot(self) -> tuple[Array, dict[str, float]]:
        """Return map and skill for :meth:`rollback`."""
        return self.fuzzy.coefficients, {name: getattr(self._memory[0], name) for name in SKILL}

    def rollback(self, snapshot: tuple[Array, dict[str, float]]) -> None:
        """Restore the map and its skill; the yaw error since is kept."""
        self.fuzzy.coefficients, skill = snapshot
        for name, value in skill.items():
            setattr(self._memory[0], name, value)

    def step(
        self,
        yaw: float,
        elapsed: float,
        reference: Array,
        planned: Array,
        sent: Array,
        delay: float,
        *,
        learn: bool = True,
    ) -> float:
        """Return the correction (rad/s): added to the right, subtracted from the left wheel.

        yaw       : of the odometry, rad, ``elapsed`` s after the last one
        reference : of the wheels now, rad/s, shape (2,)
        planned   : reference to which the correction is added, rad/s, shape (2,)
        sent      : wheel speeds commanded at the last step, rad/s, shape (2,)
        delay     : time between a command and the motion it causes, s
        learn     : whether the map adapts
        """
        return self._correct_body(
            yaw,
            elapsed,
            reference,
            planned,
            sent,
            delay,
            learn,
            self._constants,
            self._state,
            self.fuzzy.tables,
        )


@kernel
def correct_body(
    yaw: float,
    elapsed: float,
    reference: Array,
    planned: Array,
    sent: Array,
    delay: float,
    learn: bool,
    constants: BodyConstants,
    state: BodyState,
    fuzzy: FuzzyTables,
) -> float:
    """Learn from the last period (E20) and return the correction (E21), rad/s.

    Arguments as in :meth:`BodyCorrection.step`.
    """
    turn, period = constants.turn, constants.period
    memory, history, point, output = state.memory[0], state.history, state.point, state.output
    # A gap of n periods repeats the last command n times: nothing else was sent.
    count = min(max(int(round(elapsed / period)), 1), history.shape[0])
    for j in range(history.shape[0] - 1, count - 1, -1):
        history[j, 0], history[j, 1] = history[j - count, 0], history[j - count, 1]
    for j in range(count):
        history[j, 0], history[j, 1] = sent[0], sent[1]
    memory.commands = min(memory.commands + count, history.shape[0])
    turning = 0.5 * (reference[0] - reference[1])
    if memory.started and elapsed > 0.0:
        change = yaw - memory.yaw
        change -= 2.0 * math.pi * math.floor(change / (2.0 * math.pi) + 0.5)
        achieved = change / (elapsed * turn)
        memory.yaw_error += elapsed * (achieved - 0.5 * (turning + memory.last_reference))
        # Middle of the last period, one delay earlier; row 0 was sent one period ago.
        position = (delay + 0.5 * elapsed) / period - 1.0
        if position + 2.0 < memory.commands and count == 1:
            learn_turning(achieved, max(position, 0.0), elapsed, learn, constants, state, fuzzy)
    memory.yaw, memory.started, memory.last_reference = yaw, True, turning
    if memory.block_time >= BLOCK:
        update_authority(memory, constants.share, constants.dead_zone)
    point[0], point[1] = planned[0], planned[1]
    estimate(point, fuzzy, output)
    bound = constants.bound
    correction = -min(max(output[0], -bound), bound)
    bound = constants.yaw_bound
    if bound > 0.0:
        correction -= bound * math.tanh(constants.yaw_gain * memory.yaw_error / bound)
    return float(memory.authority * correction)


@kernel
def learn_turning(
    achieved: float,
    position: float,
    elapsed: float,
    learn: bool,
    constants: BodyConstants,
    state: BodyState,
    fuzzy: FuzzyTables,
) -> None:
    """Adapt the map to the turning ``achieved`` (rad/s) by the commands of a row (E20)."""
    memory, history, point, output = state.memory[0], state.history, state.point, state.output
    coefficients, phi = fuzzy.coefficients, fuzzy.phi
    row = int(position)
    part = position - row
    for i in range(2):
        point[i] = (1.0 - part) * history[row, i] + part * history[row + 1, i]
    estimate(point, fuzzy, output)
    raw = achieved - 0.5 * (point[0] - point[1])
    residual = raw - output[0]
    power = 0.0
    for k in range(phi.size):
        power += phi[k] * phi[k]
    if learn and power > 0.0 and abs(residual) < OUTLIER:
        memory.error_sum += raw * elapsed
        residual = min(max(residual, -CLIP), CLIP)
        raw = residual + output[0]
        gain = min(constants.learning_rate * elapsed, 1.0) * residual / power
        for k in range(phi.size):
            coefficients[0, k] += gain * phi[k]
        memory.raw_sum += raw * elapsed
        memory.residual_sum += residual * elapsed
        memory.command_sum += 0.5 * (point[0] ** 2 + point[1] ** 2) * elapsed
        memory.block_time += elapsed


@kernel
def update_authority(memory: BodyMemory, share: float, dead_zone: float) -> None:
    """Update the powers of both residuals by one block, and the authority.

    share : part of the powers that the block replaces
    dead_zone : error that counts as noise, rad/s
    """
    raw, residual = memory.raw_sum / memory.block_time, memory.residual_sum / memory.block_time
    memory.raw_power += share * (raw * raw - memory.raw_power)
    memory.residual_power += share * (residual * residual - memory.residual_power)
    commanded = memory.command_sum / memory.block_time
    memory.command_power += share * (commanded - memory.command_power)
    error = memory.error_sum / memory.block_time
    memory.error_power += share * (error * error - memory.error_power)
    memory.block_time = memory.raw_sum = memory.residual_sum = memory.command_sum = 0.0
    memory.error_sum = 0.0
    if memory.error_power > IMPLAUSIBLE**2 * memory.command_power:
        memory.authority = 0.0
        return
    if memory.raw_power > 0.0:
        noise = memory.residual_power + dead_zone * dead_zone
        skill = 1.0 - noise / memory.raw_power
        memory.authority = min(max((skill - NO_SKILL) / (FULL_SKILL - NO_SKILL), 0.0), 1.0)
