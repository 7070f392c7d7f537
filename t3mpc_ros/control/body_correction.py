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

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, estimate
from t3mpc_ros.fuzzy.inference import FuzzyTables
from t3mpc_ros.fuzzy.sets import FuzzyParameters
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.parameters.table import Parameters, group, parameter

Array = NDArray[np.float64]

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
    fuzzy: FuzzyParameters = group(
        FuzzyParameters, sets=5, centre_exponent=1.0, input_fuzziness=0.05
    )


(
    YAW, STARTED, BLOCK_TIME, RAW_SUM, RESIDUAL_SUM, RAW_POWER, RESIDUAL_POWER,
    AUTHORITY, YAW_ERROR, LAST_REFERENCE, COMMANDS, COMMAND_SUM, COMMAND_POWER,
    ERROR_SUM, ERROR_POWER,
) = range(15)  # fmt: skip
"""Entries of the memory: yaw, and the rest in wheel speeds (rad/s) and s. RAW is w_a - w_c with
the residual clipped, ERROR without."""


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


class BodyMemory(NamedTuple):
    """State of :func:`correct_body`, changed in place."""

    sums: Array
    """Entries YAW ... ERROR_POWER."""
    history: Array
    """Commands, newest first, rad/s, shape (n, 2)."""
    point: Array
    """Work space: inputs of the map, shape (2,)."""
    output: Array
    """Work space: output of the map, shape (1,)."""


class BodyCorrection:
    """Corrects the reference of the wheels such that the body turns as the reference does: E20.

    Parameters
    ----------
    parameters
        Learning and bounds.
    wheel_radius, half_separation
        Nominal R and b, m.
    period
        Control period, s.
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
        self._state = BodyMemory(
            np.zeros(ERROR_POWER + 1), np.zeros((HISTORY, 2)), np.zeros(2), np.zeros(1)
        )
        self._memory = self._state.sums
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
        return float(self._memory[AUTHORITY])

    @property
    def yaw_error(self) -> float:
        """Yaw of the robot minus that of the reference since the start of the drive, rad."""
        return float(self._memory[YAW_ERROR] * self._turn)

    def restart(self) -> None:
        """Start a drive: clear yaw error and history; map and skill are kept."""
        self._state.history[:] = 0.0
        for entry in (
            STARTED,
            BLOCK_TIME,
            RAW_SUM,
            RESIDUAL_SUM,
            YAW_ERROR,
            COMMANDS,
            COMMAND_SUM,
            ERROR_SUM,
        ):
            self._memory[entry] = 0.0

    def reset(self) -> None:
        """Discard the map and its skill too."""
        self._memory[:] = 0.0
        self.fuzzy.reset()
        self.restart()

    def snapshot(self) -> tuple[Array, Array]:
        """Return copies of map and memory for :meth:`rollback`."""
        return self.fuzzy.coefficients, self._memory.copy()

    def rollback(self, snapshot: tuple[Array, Array]) -> None:
        """Restore the map and its skill; the yaw error since is kept."""
        coefficients, memory = snapshot
        self.fuzzy.coefficients = coefficients
        for entry in (RAW_POWER, RESIDUAL_POWER, COMMAND_POWER, ERROR_POWER, AUTHORITY):
            self._memory[entry] = memory[entry]

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

        Parameters
        ----------
        yaw
            Yaw of the odometry, rad.
        elapsed
            Time since the last step, s.
        reference
            Reference of the wheels now, rad/s, shape (2,).
        planned
            Reference of the wheels to which the correction is added, rad/s, shape (2,).
        sent
            Wheel speeds commanded at the last step, rad/s, shape (2,).
        delay
            Time between a command and the motion it causes, s.
        learn
            Whether the map adapts.
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
    state: BodyMemory,
    fuzzy: FuzzyTables,
) -> float:
    """Learn from the last period (E20) and return the correction (E21), rad/s.

    Arguments as in :meth:`BodyCorrection.step`.
    """
    turn, period = constants.turn, constants.period
    memory, history, point, output = state
    coefficients, phi = fuzzy.coefficients, fuzzy.phi
    # A gap of n periods repeats the last command n times: nothing else was sent.
    count = min(max(int(round(elapsed / period)), 1), history.shape[0])
    for j in range(history.shape[0] - 1, count - 1, -1):
        history[j, 0], history[j, 1] = history[j - count, 0], history[j - count, 1]
    for j in range(count):
        history[j, 0], history[j, 1] = sent[0], sent[1]
    memory[COMMANDS] = min(memory[COMMANDS] + count, 1.0 * history.shape[0])
    turning = 0.5 * (reference[0] - reference[1])
    if memory[STARTED] > 0.0 and elapsed > 0.0:
        change = yaw - memory[YAW]
        change -= 2.0 * math.pi * math.floor(change / (2.0 * math.pi) + 0.5)
        achieved = change / (elapsed * turn)
        memory[YAW_ERROR] += elapsed * (achieved - 0.5 * (turning + memory[LAST_REFERENCE]))
        # Middle of the last period, one delay earlier; row 0 was sent one period ago.
        position = (delay + 0.5 * elapsed) / period - 1.0
        if position + 2.0 < memory[COMMANDS] and count == 1:
            position = max(position, 0.0)
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
                memory[ERROR_SUM] += raw * elapsed
                residual = min(max(residual, -CLIP), CLIP)
                raw = residual + output[0]
                gain = min(constants.learning_rate * elapsed, 1.0) * residual / power
                for k in range(phi.size):
                    coefficients[0, k] += gain * phi[k]
                memory[RAW_SUM] += raw * elapsed
                memory[RESIDUAL_SUM] += residual * elapsed
                memory[COMMAND_SUM] += 0.5 * (point[0] ** 2 + point[1] ** 2) * elapsed
                memory[BLOCK_TIME] += elapsed
    memory[YAW], memory[STARTED], memory[LAST_REFERENCE] = yaw, 1.0, turning
    if memory[BLOCK_TIME] >= BLOCK:
        update_authority(memory, constants.share, constants.dead_zone)
    point[0], point[1] = planned[0], planned[1]
    estimate(point, fuzzy, output)
    bound = constants.bound
    correction = -min(max(output[0], -bound), bound)
    bound = constants.yaw_bound
    if bound > 0.0:
        correction -= bound * math.tanh(constants.yaw_gain * memory[YAW_ERROR] / bound)
    return float(memory[AUTHORITY] * correction)


@kernel
def update_authority(memory: Array, share: float, dead_zone: float) -> None:
    """Update the powers of both residuals by one block, and the authority.

    share : part of the powers that the block replaces
    dead_zone : error that counts as noise, rad/s
    """
    raw, residual = memory[RAW_SUM] / memory[BLOCK_TIME], memory[RESIDUAL_SUM] / memory[BLOCK_TIME]
    memory[RAW_POWER] += share * (raw * raw - memory[RAW_POWER])
    memory[RESIDUAL_POWER] += share * (residual * residual - memory[RESIDUAL_POWER])
    commanded = memory[COMMAND_SUM] / memory[BLOCK_TIME]
    memory[COMMAND_POWER] += share * (commanded - memory[COMMAND_POWER])
    error = memory[ERROR_SUM] / memory[BLOCK_TIME]
    memory[ERROR_POWER] += share * (error * error - memory[ERROR_POWER])
    memory[BLOCK_TIME] = memory[RAW_SUM] = memory[RESIDUAL_SUM] = memory[COMMAND_SUM] = 0.0
    memory[ERROR_SUM] = 0.0
    if memory[ERROR_POWER] > IMPLAUSIBLE**2 * memory[COMMAND_POWER]:
        memory[AUTHORITY] = 0.0
        return
    if memory[RAW_POWER] > 0.0:
        noise = memory[RESIDUAL_POWER] + dead_zone * dead_zone
        skill = 1.0 - noise / memory[RAW_POWER]
        memory[AUTHORITY] = min(max((skill - NO_SKILL) / (FULL_SKILL - NO_SKILL), 0.0), 1.0)
