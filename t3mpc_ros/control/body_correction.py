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
r"""Body correction: a Kalman filter learns how the body turns under commanded wheel speeds.

The wheels of a stepper follow their command almost exactly; the body does not: wheel radii and
separation differ from the nominal ones, and tyres creep. With the yaw rate expressed as half of
the difference of the wheel speeds, w = b omega / R, the body obeys

.. math:: w_a - w_c = k_m m_c + k(|m_c|, |w_c|) w_c + s w_a + c + \tau \dot w_c + \nu,       E20

          k(|m|, |w|) = k_w + \frac{k_1 |w| + k_2 |m|}{U} + \frac{k_3 |m| |w|}{U^2},

for mean m_c and half difference w_c of the wheel speeds commanded one dead time before. The gains
are properties of the robot: k_m of unequal radii, k_w of a wrong separation or mean radius, k_1 to
k_3 of tyres that creep the more the faster and the tighter it turns. k is a map of Takagi and
Sugeno with two triangular sets for each of |m| and |w|, in its linear parameters. The
others are no gains, and nothing is corrected by them: the scale error s of the gyro, its bias c,
and the error tau of the assumed delay. The filter estimates all eight from means over a quarter of
a second, and starts from what is stated of each.

To steps and gyro, k_w and s are one quantity. How an error is shared between them follows from
the stated deviations, ``wheel_tolerance`` and ``gyro_scale_tolerance``: with a calibrated gyro it
is the robot's, with one that has the tolerance of its data sheet it is the gyro's. A sudden error
that lasts is a jump of the bias first; what contradicts that later returns to the gains, and the
more of it at once the more jumps there have been.

The reference of the law becomes

.. math:: w_r - a (k_m m_r + k w_r) - a v_\psi, \quad v_\psi = \bar v \tanh(k e_\psi/\bar v)  E21

with e_psi the integral of w_a - s w_a - c - w_r: the compensator (81)-(82) in the form of E14, for
the yaw. The authority a in [0, 1] is the measured skill of the gains: the share of the variance
of what they explain, w_a - w_c without the terms of gyro and delay, that they predict *before*
they learn from it. On a robot with nominal geometry there is nothing to predict: a is 0, and
nothing is corrected.

What odometry and gyro cannot measure stays: a scale error common to both wheels changes the
distance only.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple, cast

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import Structure, TypedKernel, kernel
from t3mpc_ros.parameters.table import Parameters, parameter

HISTORY = 64  # number of commands kept
BLOCK = 0.25  # time over which E20 is averaged, s
SKILL_TIME = 5.0  # time constant of the measured skill, s
DEAD_ZONE = 0.010
"""Error of a wheel that is not worth correcting, rad/s: noise of the gyro and of the rotors,
averaged over a block."""
FULL_SKILL, NO_SKILL = 0.85, 0.2
"""Skill from which on the authority is 1, and up to which it is 0. With a smaller first one a gyro
whose scale is off by more than is stated costs more, a wrong body less."""
IMPLAUSIBLE = 0.2
"""Error relative to the commanded wheel speeds above which nothing is corrected: the odometry has
no yaw, or the wheels do not move the robot."""
OUTLIER, RELATIVE_OUTLIER = 1.0, 0.3
"""Error of a single step (rad/s, and share of w_c) that is no property of the robot: a push, or a
slip. Nothing is learnt from its block."""
TORN, TORN_MEMORY = 0.3, 0.01
"""Share of blocks with such a step from which the others are no fair sample, as of a yaw that is
rounded: it stays the same in them. Weight of a block in it: 25 s of driving."""
YAW_JUMP = 20.0
"""Error of a single step (rad/s) that is no motion: the yaw of the odometry was set."""
STANDSTILL_SPEED = 0.05
"""Commanded speed (rad/s, mean square over a block) below which a block shows nothing."""

ASYMMETRY, TURNING, CREEP, GYRO_SCALE, BIAS, DELAY = 0, 1, 2, 5, 6, 7
"""k_m, k_w, k_1 of k_1 to k_3, s, c, tau: rows of the estimate."""
ROWS = 8  # number of rows; those before GYRO_SCALE are gains of the robot
CREEP_SPEED = 5.0  # U, rad/s
BIAS_DEVIATION, DELAY_DEVIATION = 0.01, 0.02
"""Standard deviations of c after a standstill (rad/s of a wheel) and of tau (s) at the start."""
WALK = (0.0005, 0.0005, 0.0005, 0.0005, 0.0005, 0.0, 0.0003, 0.0005)
"""Random walk of each: standard deviation after a second, in its unit."""
NOISE, SLOPE_NOISE = 0.006, 0.01
"""Standard deviation of the mean of a block, rad/s, and per slope of w_c, s."""
SUDDEN = 3.0  # innovation (in its standard deviation) that is not learnt
SLACK, LARGEST, JUMP, JUMP_AGAIN = 1.5, 4.0, 6.0, 4.5
"""Of a cumulative sum of innovations (in their standard deviations, at most LARGEST): what a block
takes off, the sum at which the bias has jumped, three blocks in a row at least, and the one soon
after another jump, two blocks. Page 1954, doi 10.1093/biomet/41.1-2.100."""
JUMP_SHARE, JUMP_GROWTH, JUMP_TIME = 3.0, 30.0, 60.0
"""Variance by which a jump makes k_m and k_w uncertain again, over that of ``wheel_tolerance``;
how often it is added again for each jump of late, beside less for the bias; and the time in
which they are forgotten, s. The bias of a gyro jumps once, a floor that changes does so often.
With 5 at the first jump, one of 0.05 rad/s turns the robot by 0.04 rad, with 0.5 by nothing; but
with that and no growth, two floors in strips cost a quarter more."""
JUMP_LIKELY = 0.1
"""Share of the wheel speeds up to which such a change may be one of the gains: of a robot that
loses steps it is more, and its gains are the same afterwards."""
WARNED_BIAS = 0.01  # bias that is reported, rad/s
WARNED_SCALE, WARNED_DEVIATION = 0.01, 0.004
"""Scale error that is reported, where the error of the robot beside it is so uncertain."""
CLIP = 2.0  # largest innovation that is learnt at once, in its standard deviation

WATCHED = 20
"""Number of blocks that say how well the turn follows the commands: the last five seconds."""
EXCITED = 2e-4
"""Mean square of the change of w_c in a period, (rad/s)², from which a block says it."""
UNEXPLAINED, EXCITED_BLOCKS = 0.8, 8
"""Share of that change which the turn does not make, from which commands are lost or late, and
number of blocks from which it is known. Rotors that ring leave up to 0.64 in nine of ten moments
of a patrol, 0.9 with 10 % of the commands lost; a loss of 30 % leaves 1.3 in half of them."""
ROUGH, CALM_BLOCKS = 0.004, 10
"""Standard deviation of the turn beyond E20 (rad/s of a wheel) from which it is rough, and number
of calm blocks from which it is known. Microsteps leave up to 0.0037, 10 % of the commands lost
0.006 and more."""
WATCHED_QUANTILE = 0.2
"""Quantile of the blocks that counts: in most of them nothing else disturbs the turn."""
RINGING, RINGING_MEMORY = 0.04, 0.98
"""Error of a step (rad/s) beside which the noise of the gyro is small, and forgetting factor of a
block, of the frequency of the rotors."""
RINGING_STEPS, RINGING_CORRELATION = 15.0, 0.97
"""Number of such steps, and correlation of error and acceleration, from which it is known."""
RINGING_RATE = 0.2
"""Frequency, in cycles a period, from which it is noise of the yaw that alternates."""
CALM_CHANGE, CALM_SHARE, CALM_SPEED, RINGING_BLOCKS = 0.06, 0.3, 0.3, 2
"""Of a calm block: largest change of w_c in a period (rad/s, or share of the deviation beyond E20,
beside which it is nothing), least speed of a wheel (rad/s), and number of blocks after a larger
change in which the rotors ring."""


@dataclass(frozen=True)
class BodyCorrectionParameters(Parameters):
    """Correction of the yaw rate, learnt from the yaw of the odometry."""

    enabled: bool = parameter(
        True,
        'whether the yaw rate is corrected; needs an odometry whose yaw comes from a gyro',
        dynamic=True,
    )
    gyro_scale_tolerance: float = parameter(
        0.03,
        'standard deviation of the relative scale error of the gyro: 0.001 after a calibration '
        'over ten turns; the larger it is beside wheel_tolerance, the less is corrected',
        bounds=(0.0, 0.5),
        source='data sheet PS-MPU-6000A r3.4, 6.1: ±3 %',
    )
    wheel_tolerance: float = parameter(
        0.01,
        'standard deviation of the relative errors of wheel radii and separation',
        bounds=(0.0, 0.5),
    )
    yaw_gain: float = parameter(0.15, 'gain k of the yaw error', '1/s', (0.0, 1.0), dynamic=True)
    max_correction: float = parameter(
        1.0, 'bound of the correction of a wheel by the gains', 'rad/s', (0.0, 10.0), dynamic=True
    )
    max_yaw_correction: float = parameter(
        0.06,
        'v-bar: bound of the correction of a wheel by the yaw error, so that a robot that was '
        'turned by a slide turns back slowly: its error is the less',
        'rad/s',
        (0.0, 10.0),
        dynamic=True,
    )


class BodyMemory(Structure):
    """What :func:`correct_body` remembers, in wheel speeds (rad/s) and s.

    Sums are over the present block, powers are means over the past blocks: *raw* of w_a - w_c,
    *error* of what is left of it without the terms of gyro and delay, *residual* of what the gains
    leave of that; the last two without sudden errors.
    """

    yaw: float  # last yaw of the odometry, rad
    started: bool  # whether there is one
    last_reference: float
    yaw_error: float  # integral of w_a - s w_a - c - w_r
    commands: int  # number of known commands, at most HISTORY
    block_time: float
    last: float  # last w_c
    linked: bool  # whether it is that of the last period; a gap belongs to no block
    rise: float  # sum of the changes of w_c
    achieved_sum: float  # sum of w_a
    square_sum: float  # sum of the squared commands of a wheel
    spoilt: bool  # whether nothing is learnt from the block
    torn: bool  # whether a single step of it is no property of the robot
    torn_share: float  # share of such blocks
    jumps: float  # number of jumps of late
    above: float
    below: float  # cumulative sums of positive and of negative innovations
    raw_power: float
    error_power: float
    residual_power: float
    command_power: float
    authority: float  # share of the correction that is in use
    rest_sum: float  # sum of what E20 does not explain of a step, and of its square
    rest_square: float
    rest_product: float  # sum of its product with the change of w_c in the period
    change_square: float  # sum of the squared changes of w_c in a period
    largest_change: float
    slowest: float  # least speed of a wheel
    steps: int
    rings: int  # number of blocks in which the rotors ring still
    chain: int  # number of steps since a gap, at most 2; of the last two steps:
    last_achieved: float
    before_achieved: float
    last_rest: float
    ring_count: float
    """Number of the steps with a large error; sums over them of its square, of its product with
    the angular acceleration of a wheel, and of the square of that."""
    ring_error: float
    ring_product: float
    ring_acceleration: float


WATCH = (
    *('rest_sum', 'rest_square', 'rest_product', 'change_square'),
    *('largest_change', 'slowest', 'steps'),
)
"""Fields of the present block that :func:`watch_block` uses."""
RING_SUMS = 'ring_count', 'ring_error', 'ring_product', 'ring_acceleration'
"""Fields by which :attr:`BodyCorrection.turning_frequency` is known."""
DRIVE = (
    *('started', 'yaw_error', 'commands', 'above', 'below', 'jumps'),
    *('block_time', 'achieved_sum', 'square_sum', 'rise', 'linked', 'spoilt', 'torn'),
    *('before_achieved', 'last_achieved', 'last_rest'),
    *(*WATCH, 'rings', 'chain', *RING_SUMS),
)
"""Fields of the memory that belong to one drive."""
SKILL = 'raw_power', 'error_power', 'residual_power', 'command_power', 'authority'
"""Fields that say how well the gains predict."""


class BodyConstants(NamedTuple):
    """Constants of :func:`correct_body`."""

    turn: float  # R/b
    period: float  # s
    yaw_gain: float  # k, 1/s
    bound: float  # bound of the correction by the gains, rad/s
    yaw_bound: float  # v-bar, rad/s
    jump_variance: float  # variance that a jump adds to those of k_m and k_w


class BodyState(NamedTuple):
    """State of :func:`correct_body`, changed in place."""

    memory: Sequence[BodyMemory]  # array of one
    history: Array  # commands, newest first, rad/s, shape (n, 2)
    sums: Array  # sums over the present block of what the turn is per gain, shape (5,)
    estimate: Array  # gains, s, c, tau, shape (8,)
    covariance: Array  # of the estimate, shape (8, 8)
    work: Array  # work space: row h of E20, and P h, shape (2, 8)
    watched: Array
    """Unexplained share and roughness of the last blocks, newest first, NaN where a block does not
    say it, shape (n, 2)."""


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
        self._memory = BodyMemory.new()
        # Arrays of one, which Python reads ten times faster than fields of a record.
        fields = cast('Any', self._memory)
        self._ring_sums: list[Array] = [fields[name] for name in RING_SUMS]
        self._state = BodyState(
            self._memory,
            np.zeros((HISTORY, 2)),
            np.zeros(GYRO_SCALE),
            np.zeros(ROWS),
            np.zeros((ROWS, ROWS)),
            np.zeros((2, ROWS)),
            np.full((WATCHED, 2), math.nan),
        )
        self._correct_body = TypedKernel(correct_body)
        self.configure(parameters)
        self.reset()

    def configure(self, parameters: BodyCorrectionParameters) -> None:
        """Use new values of the dynamic parameters from the next step on."""
        self.parameters = parameters
        self._constants = BodyConstants(
            self._turn,
            self._period,
            parameters.yaw_gain,
            parameters.max_correction,
            parameters.max_yaw_correction,
            JUMP_SHARE * parameters.wheel_tolerance**2,
        )

    @property
    def authority(self) -> float:
        """Fraction of the correction in use, in [0, 1]."""
        return float(self._memory[0].authority)

    @property
    def yaw_error(self) -> float:
        """Yaw of the robot minus that of the reference since the start of the drive, rad."""
        return float(self._memory[0].yaw_error * self._turn)

    @property
    def estimate(self) -> Array:
        """Copy of k_m, k_w, creep gains, s, c (rad/s of a wheel) and tau (s), shape (8,)."""
        return self._state.estimate.copy()

    @property
    def gyro_bias(self) -> float:
        """Estimated bias of the yaw rate of the odometry, rad/s."""
        return float(self._state.estimate[BIAS] * self._turn)

    @property
    def turning_frequency(self) -> float:
        r"""Frequency (Hz) at which the robot oscillates in yaw; 0 while it is unknown.

        A rotor that is behind its field by the angle e accelerates: w_a' = (2 pi f)² e for the
        yaw, so the second derivative of what w_a leaves of E20 is -(2 pi f)² times it. A dead
        time or a gain that is wrong has no such correlation.
        """
        count, error, product, acceleration = (each.item() for each in self._ring_sums)
        if count < RINGING_STEPS:
            return 0.0
        if not product > RINGING_CORRELATION * math.sqrt(error * acceleration):
            return 0.0
        frequency = math.sqrt(product / error) / (2.0 * math.pi)
        return frequency if frequency * self._period < RINGING_RATE else 0.0

    def problem(self) -> str:
        """Return what the gyro does to the yaw of the odometry, or nothing."""
        bias, estimate = self.gyro_bias, self._state.estimate
        if abs(bias) > WARNED_BIAS:
            return (
                f'the yaw of odom turns by {_compared(bias, ".3f", "rad/s")} the wheels: bias '
                'of the gyro; it is not followed; let the robot stand for two seconds'
            )
        share = estimate[TURNING] + estimate[GYRO_SCALE]
        deviations = np.sqrt(np.diag(self._state.covariance))
        deviation = deviations[TURNING]
        scale = min(abs(estimate[GYRO_SCALE]), abs(share))  # both: else the yaw of odom fits
        if scale > WARNED_SCALE and deviation > WARNED_DEVIATION:
            return (
                f'the yaw of odom turns by {_compared(100.0 * share)} the wheels: scale of '
                'the gyro, or wheel separation; calibrate the robot, or lower '
                'body.gyro_scale_tolerance if the gyro is right'
            )
        least = np.maximum(4.0 * deviations, self.parameters.wheel_tolerance)
        if (np.abs(estimate[:CREEP]) > least[:CREEP]).any():
            turning, asymmetry = 100.0 * estimate[TURNING], 100.0 * estimate[ASYMMETRY]
            return (
                f'the robot turns by {_compared(turning)} the wheels, and by {asymmetry:.1f} '
                '% of their mean speed: wheel separation or radii are not those that are set, or '
                'the gyro is not calibrated; corrected as far as the wheels allow'
            )
        if (np.abs(estimate[CREEP:GYRO_SCALE]) > least[CREEP:GYRO_SCALE]).any():
            creep = 100.0 * float(np.sum(estimate[CREEP:GYRO_SCALE]))
            return (
                f'with wheels at {CREEP_SPEED:g} rad/s the robot turns by '
                f'{_compared(creep)} its slow turns let expect: its tyres creep; corrected as far '
                'as the wheels allow'
            )
        return ''

    def response_problem(self) -> str:
        """Return how the turn of the robot differs from its commands, or nothing."""
        found, columns = [], self._state.watched.T
        for column, least in zip(columns, (EXCITED_BLOCKS, CALM_BLOCKS), strict=True):
            known = column[~np.isnan(column)]
            enough = len(known) >= least
            found.append(float(np.quantile(known, WATCHED_QUANTILE)) if enough else 0.0)
        share, rough = found
        if share > UNEXPLAINED:
            follows = 'only partly follows' if share < 1.0 else 'does not follow'
            return (
                f'the yaw rate of odom {follows} the changes of the commands: commands or '
                'odometry are lost or late, or the dead time has changed; check the link and the '
                'processors'
            )
        if rough > ROUGH:
            return (
                f'the yaw rate of odom is rough by {rough * self._turn:.4f} rad/s beyond the '
                'commands: commands are lost, the floor is uneven, a wheel is loose, the gyro, or '
                'whatever else gives the yaw, is noisy, or its bias is unknown because the robot '
                'has not stood for 1 s since its start'
            )
        return ''

    def restart(self) -> None:
        """Start a drive: clear yaw error and history; gains and skill are kept."""
        self._state.history[:] = 0.0
        self._state.sums[:] = 0.0
        self._state.watched[:] = math.nan
        for name in DRIVE:
            setattr(self._memory[0], name, 0)

    def reset(self) -> None:
        """Discard the gains and their skill too."""
        for name in BodyMemory.__annotations__:
            setattr(self._memory[0], name, 0)
        self._state.estimate[:] = 0.0
        self._state.covariance[:] = self._prior()
        self.restart()

    def _prior(self) -> Array:
        """Return the covariance that follows from what is stated, shape (8, 8)."""
        wheel, gyro = self.parameters.wheel_tolerance, self.parameters.gyro_scale_tolerance
        deviations = [*(GYRO_SCALE * [wheel]), gyro, BIAS_DEVIATION, DELAY_DEVIATION]
        return np.diag(np.square(deviations))

    def get_weights(self) -> Array:
        """Return estimate (row 0) and covariance (the others), shape (9, 8)."""
        return np.vstack([self._state.estimate, self._state.covariance])

    def set_weights(self, weights: Array) -> None:
        """Use what :meth:`get_weights` returned, also before 0.3.0, which had no creep gains."""
        if np.shape(weights) == (6, 5):
            known = [ASYMMETRY, TURNING, GYRO_SCALE, BIAS, DELAY]
            former, weights = weights, np.vstack([np.zeros(ROWS), self._prior()])
            weights[0, known] = former[0]
            weights[1:][np.ix_(known, known)] = former[1:]
        if np.shape(weights) != (1 + ROWS, ROWS):
            shape = np.shape(weights)
            raise ValueError(f'the body correction has shape (9, 8): got {shape}')
        self._state.estimate[:] = weights[0]
        self._state.covariance[:] = weights[1:]

    def snapshot(self) -> tuple[Array, dict[str, float]]:
        """Return gains and skill for :meth:`rollback`."""
        return self.get_weights(), {name: getattr(self._memory[0], name) for name in SKILL}

    def rollback(self, snapshot: tuple[Array, dict[str, float]]) -> None:
        """Restore the gains and their skill; the yaw error since is kept."""
        weights, skill = snapshot
        self.set_weights(weights)
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
        reference : of the wheels now; ``planned``: the one to which the correction is added, rad/s
        sent      : wheel speeds commanded at the last step, rad/s
        delay     : time between a command and the motion it causes, s
        """
        return self._correct_body(
            yaw, elapsed, reference, planned, sent, delay, learn, self._constants, self._state
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
) -> float:
    """Learn from the last period (E20) and return the correction (E21), rad/s.

    Arguments as in :meth:`BodyCorrection.step`.
    """
    turn, period = constants.turn, constants.period
    memory, history, gains = state.memory[0], state.history, state.estimate
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
        moved = abs(achieved - turning) < YAW_JUMP
        if moved:
            of_body = achieved - gains[GYRO_SCALE] * achieved - gains[BIAS]
            memory.yaw_error += elapsed * (of_body - 0.5 * (turning + memory.last_reference))
        # Middle of the last period, one delay earlier; row 0 was sent one period ago.
        position = (delay + 0.5 * elapsed) / period - 1.0
        if moved and position + 2.0 < memory.commands and count == 1:
            add_to_block(achieved, max(position, 0.0), elapsed, learn, state)
        else:
            memory.linked = False
            memory.chain = 0
    memory.yaw, memory.started, memory.last_reference = yaw, True, turning
    if memory.block_time >= BLOCK - 0.5 * period:
        rough = watch_block(state)
        if memory.square_sum > STANDSTILL_SPEED**2 * memory.block_time:
            learn_block(constants, state, rough)
        clear_block(state)
    mean, half = 0.5 * (planned[0] + planned[1]), 0.5 * (planned[0] - planned[1])
    bound = constants.bound
    row, turn_error = state.work[0], 0.0
    write_gain_row(mean, half, row)
    for j in range(GYRO_SCALE):
        turn_error += gains[j] * row[j]
    correction = -min(max(turn_error, -bound), bound)
    bound = constants.yaw_bound
    if bound > 0.0:
        correction -= bound * math.tanh(constants.yaw_gain * memory.yaw_error / bound)
    return float(memory.authority * correction)


@kernel
def add_to_block(
    achieved: float, position: float, elapsed: float, learn: bool, state: BodyState
) -> None:
    """Add the turning ``achieved`` (rad/s) by the commands of a row of the history."""
    memory, history = state.memory[0], state.history
    newer = int(position)
    part = position - newer
    right = (1.0 - part) * history[newer, 0] + part * history[newer + 1, 0]
    left = (1.0 - part) * history[newer, 1] + part * history[newer + 1, 1]
    commanded = 0.5 * (right - left)
    change = commanded - memory.last if memory.linked else 0.0
    memory.rise += change
    memory.last, memory.linked = commanded, True
    memory.block_time += elapsed
    row = state.work[0]
    write_gain_row(0.5 * (right + left), commanded, row)
    row[GYRO_SCALE], row[BIAS], row[DELAY] = achieved, 1.0, change / elapsed
    rest = achieved - commanded
    for j in range(ROWS):
        rest -= row[j] * state.estimate[j]
    for j in range(GYRO_SCALE):
        state.sums[j] += row[j] * elapsed
    if memory.chain == 2 and abs(memory.last_rest) > RINGING:
        bend = achieved - 2.0 * memory.last_achieved + memory.before_achieved
        bend /= -elapsed * elapsed
        memory.ring_count += 1.0
        memory.ring_error += memory.last_rest * memory.last_rest
        memory.ring_product += memory.last_rest * bend
        memory.ring_acceleration += bend * bend
    memory.before_achieved, memory.last_achieved = memory.last_achieved, achieved
    memory.last_rest, memory.chain = rest, min(memory.chain + 1, 2)
    slowest = min(abs(right), abs(left))
    memory.slowest = min(memory.slowest, slowest) if memory.steps else slowest
    memory.largest_change = max(memory.largest_change, abs(change))
    memory.change_square += change * change
    memory.rest_sum += rest
    memory.rest_square += rest * rest
    memory.rest_product += rest * change
    memory.steps += 1
    memory.achieved_sum += achieved * elapsed
    memory.square_sum += 0.5 * (right * right + left * left) * elapsed
    if not learn:
        memory.spoilt = True
    elif abs(achieved - commanded) > OUTLIER + RELATIVE_OUTLIER * abs(commanded):
        memory.spoilt = memory.torn = True


@kernel
def clear_block(state: BodyState) -> None:
    """Begin another block."""
    memory = state.memory[0]
    memory.block_time = memory.achieved_sum = memory.square_sum = memory.rise = 0.0
    memory.rest_sum = memory.rest_square = memory.rest_product = memory.change_square = 0.0
    memory.largest_change = memory.slowest = 0.0
    memory.steps = 0
    memory.spoilt = memory.torn = False
    state.sums[:] = 0.0


@kernel
def watch_block(state: BodyState) -> float:
    """Add what the block says of the response: unexplained share, and roughness if it is calm.

    Return the least roughness of the blocks (rad/s), 0 if none is known or that is usual.

    The share says nothing where the changes are below the roughness, as of a pose with noise. It
    is what no delay explains: blocks as long as half a swing do not tell tau from k_w.
    """
    memory, watched = state.memory[0], state.watched
    least = math.inf
    for j in range(watched.shape[0] - 1, 0, -1):
        watched[j, 0], watched[j, 1] = watched[j - 1, 0], watched[j - 1, 1]
        if watched[j, 1] < least:
            least = watched[j, 1]
    noise = least**2 if least < math.inf else 0.0
    steps = memory.steps
    variance = max(memory.rest_square / steps - (memory.rest_sum / steps) ** 2, 0.0)
    change, rough = memory.change_square / steps, math.sqrt(variance)
    small = memory.largest_change < max(CALM_CHANGE, CALM_SHARE * rough)
    if change > max(EXCITED, noise):
        timed = (memory.rest_product / steps) ** 2 / change
        watched[0, 0] = max(variance - timed, 0.0) / change
    else:
        watched[0, 0] = math.nan
    calm = small and memory.slowest > CALM_SPEED and memory.rings == 0
    watched[0, 1] = rough if calm else math.nan
    least = min(least, rough) if calm else least
    memory.rings = max(memory.rings - 1, 0) if small else RINGING_BLOCKS
    memory.ring_count *= RINGING_MEMORY
    memory.ring_error *= RINGING_MEMORY
    memory.ring_product *= RINGING_MEMORY
    memory.ring_acceleration *= RINGING_MEMORY
    return least if ROUGH < least < math.inf else 0.0


@kernel
def write_gain_row(mean: float, half: float, row: Array) -> None:
    """Write what the turn is per gain, rad/s, for mean and half difference of wheel speeds."""
    row[ASYMMETRY], row[TURNING] = mean, half
    turn, drive = abs(half) / CREEP_SPEED, abs(mean) / CREEP_SPEED
    row[CREEP], row[CREEP + 1], row[CREEP + 2] = turn * half, drive * half, turn * drive * half


@kernel
def learn_block(constants: BodyConstants, state: BodyState, rough: float) -> None:
    """Update the skill, then the estimate by the means of a block: a step of a Kalman filter.

    A sudden innovation is not learnt, and counts for no skill; if it lasts, the bias has jumped.
    ``rough``: noise of the turn in a step beyond that of any robot, rad/s.
    """
    memory, covariance = state.memory[0], state.covariance
    row, gain = state.work[0], state.work[1]
    time = memory.block_time
    for j in range(GYRO_SCALE):
        row[j] = state.sums[j] / time
    row[BIAS], row[DELAY] = 1.0, memory.rise / time
    achieved, turn = memory.achieved_sum / time, row[TURNING]
    for j in range(ROWS):
        if j != GYRO_SCALE:
            turn += row[j] * state.estimate[j]
    residual = achieved - state.estimate[GYRO_SCALE] * achieved - turn
    # As E20 predicts it, not w_a: the noise of that would be taken for its scale.
    row[GYRO_SCALE] = turn
    error = residual
    for j in range(GYRO_SCALE):
        error += row[j] * state.estimate[j]
    share = time / SKILL_TIME
    memory.raw_power += share * ((achieved - row[TURNING]) ** 2 - memory.raw_power)
    memory.command_power += share * (memory.square_sum / time - memory.command_power)
    memory.torn_share += TORN_MEMORY * (memory.torn - memory.torn_share)
    if memory.spoilt or memory.torn_share > TORN:
        update_authority(memory)
        return
    for j in range(ROWS):
        covariance[j, j] += WALK[j] * WALK[j] * time
    noise = NOISE * NOISE + (SLOPE_NOISE * row[DELAY]) ** 2 + rough**2 / memory.steps
    variance = spread(row, covariance, gain) + noise
    score = residual / math.sqrt(variance)
    sudden = abs(score) > SUDDEN
    if not sudden:
        memory.error_power += share * (error * error - memory.error_power)
        memory.residual_power += share * (residual * residual - memory.residual_power)
    update_authority(memory)
    score = min(max(score, -LARGEST), LARGEST)
    memory.jumps -= min(time / JUMP_TIME, 1.0) * memory.jumps
    memory.above = max(memory.above + score - SLACK, 0.0)
    memory.below = max(memory.below - score - SLACK, 0.0)
    if max(memory.above, memory.below) >= (JUMP if memory.jumps < 1.0 else JUMP_AGAIN):
        memory.above = memory.below = 0.0
        likely = abs(residual) < JUMP_LIKELY * (abs(row[ASYMMETRY]) + abs(row[TURNING]))
        covariance[BIAS, BIAS] += residual * residual / (1.0 + likely * memory.jumps)
        if likely:
            for j in (ASYMMETRY, TURNING):
                covariance[j, j] += (1.0 + JUMP_GROWTH * memory.jumps) * constants.jump_variance
            memory.jumps += 1.0
        variance = spread(row, covariance, gain) + noise
    elif sudden:
        return
    limit = CLIP * math.sqrt(variance)
    innovation = min(max(residual, -limit), limit)
    for j in range(ROWS):
        state.estimate[j] += gain[j] / variance * innovation
        for i in range(ROWS):
            covariance[j, i] -= gain[j] * gain[i] / variance


@kernel
def spread(row: Array, covariance: Array, gain: Array) -> float:
    """Set ``gain`` to P h and return h' P h, for the row h of E20."""
    total = 0.0
    for j in range(ROWS):
        gain[j] = 0.0
        for i in range(ROWS):
            gain[j] += covariance[j, i] * row[i]
        total += gain[j] * row[j]
    return total


@kernel
def update_authority(memory: BodyMemory) -> None:
    """Set the authority from the powers."""
    implausible = memory.raw_power > IMPLAUSIBLE**2 * memory.command_power
    if implausible or memory.torn_share > TORN:
        memory.authority = 0.0
    elif memory.error_power > 0.0:
        skill = 1.0 - (memory.residual_power + DEAD_ZONE**2) / memory.error_power
        memory.authority = min(max((skill - NO_SKILL) / (FULL_SKILL - NO_SKILL), 0.0), 1.0)


def _compared(value: float, digits: str = '.1f', unit: str = '%') -> str:
    """Return by how much more or less something is than another thing."""
    return f'{abs(value):{digits}} {unit} {"less" if value < 0.0 else "more"} than'
