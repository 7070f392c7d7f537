# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Gyro odometry: error-state Kalman filter over wheel angles and yaw gyro, with slip detection."""

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import ORIGIN, Pose, check_pose
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, parameter
from t3mpc_ros.robot.wheel_odometry import (
    WheelOdometryParameters,
    add_noise,
    integrate_arc,
    wrap_to_pi,
)

Array = npt.NDArray[np.float64]

DATA_SHEET = 'data sheet PS-MPU-6000A r3.4'


@dataclass(frozen=True)
class GyroOdometryParameters(WheelOdometryParameters):
    """How far steps and gyro are believed, and when they are said to disagree."""

    use_gyro: bool = parameter(
        True,
        'let the gyro help; without it there are the steps alone, and no slip is seen',
        dynamic=True,
    )
    gyro_noise: float = parameter(
        8.7e-5,
        'noise of the rate: a turn summed for a time t gets the variance noise² t',
        unit='rad/s/√Hz',
        low=1e-7,
        high=1.0,
        dynamic=True,
        source=f'{DATA_SHEET}: 0.005 deg/s/√Hz',
    )
    gyro_scale_tolerance: float = parameter(
        0.001,
        'spread of the relative error of scale, after calibration by ten turns; 0.03 without',
        low=0.0,
        high=0.5,
        dynamic=True,
    )
    gyro_bias_limit: float = parameter(
        0.7,
        'largest bias that is believed; half of it is how uncertain an unknown one is',
        unit='rad/s',
        low=1e-3,
        high=10.0,
        source=f'{DATA_SHEET}: ±20 deg/s, and ±20 over temperature',
    )
    gyro_bias_drift: float = parameter(
        5e-5,
        'random walk of the bias: spread after one second; warming up is faster than later',
        unit='rad/s/√s',
        low=0.0,
        high=1.0,
        dynamic=True,
    )
    gyro_delay: float = parameter(
        0.0048,
        'delay of the low-pass filter in the gyro, here two equal poles (which then pass 43 Hz)',
        unit='s',
        low=1e-4,
        high=0.1,
        dynamic=True,
        source='MPU-6000 register map RM-MPU-6000A r4.2: DLPF_CFG 3, 42 Hz',
    )
    gyro_hold: float = parameter(
        0.05,
        'for how long one sample may speak; of a longer gap the gyro knows but a part',
        unit='s',
        low=1e-3,
        high=10.0,
        dynamic=True,
    )
    slip_threshold: float = parameter(
        0.25,
        'yaw rate by which gyro and steps must disagree for slip; three times the tolerance of '
        'the scale is allowed on top',
        unit='rad/s',
        low=0.01,
        high=10.0,
        dynamic=True,
    )
    slip_time: float = parameter(
        0.15,
        'for how long they must; a third of it smooths the disagreement',
        unit='s',
        low=0.0,
        high=10.0,
        dynamic=True,
    )
    slip_inflation: float = parameter(
        3000.0,
        'factor on the variance of the paths of the wheels while they disagree',
        low=1.0,
        high=1e6,
        dynamic=True,
    )
    standstill_time: float = parameter(
        1.0,
        'time without a step over which the bias is averaged, again and again',
        unit='s',
        low=0.1,
        high=60.0,
        dynamic=True,
    )
    standstill_spread: float = parameter(
        0.0035,
        'largest standard deviation of the samples at a standstill; if larger, or if a standing '
        'robot turns by more than three times this rate, somebody moves it',
        unit='rad/s',
        low=1e-5,
        high=1.0,
        dynamic=True,
    )

    def check_consistency(self) -> None:
        """Raise ParameterError when slip could not be told from a robot being pushed."""
        if self.slip_threshold < 3.0 * self.standstill_spread:
            raise ParameterError(
                'slip_threshold must be at least three times standstill_spread '
                f'({3.0 * self.standstill_spread:g} rad/s): got {self.slip_threshold:g}'
            )


class GyroOdometry:
    """Keeps pose and covariance from step counters and, where there is one, a yaw gyro.

    Until the robot has stood still once the gyro is not used: its bias may be as large as the
    turns themselves. Without a gyro this is :class:`~t3mpc_ros.robot.odometry.WheelOdometry`.

    What it cannot see: wheels that slip alike (the gyro sees turns only); a bias that jumps
    while the robot drives: the heading then drifts at that rate, unflagged below
    ``slip_threshold``, until the next standstill, where about half of the drift is taken back
    and the covariance says what is left; a standing robot that is turned as evenly as by a
    machine, or more slowly than three times ``standstill_spread``.

    Parameters
    ----------
    settings
        Replaceable while running.
    geometry
        R and 2b as the odometry believes them.
    """

    def __init__(self, parameters: GyroOdometryParameters, geometry: WheelGeometry) -> None:
        self._geometry = geometry
        self._pose: Array = np.zeros(3)
        self._covariance: Array = np.zeros((5, 5))
        self._drift: Array = np.zeros((5, 5))
        self._memory: Array = np.zeros(MEMORY_SIZE)
        self.parameters = parameters
        self.update(0.0, 0.0, None, 1.0)  # compiled now, never in mid-step
        self._memory[:] = 0.0
        self._drift[:] = 0.0
        self._covariance[3, 3] = (0.5 * parameters.gyro_bias_limit) ** 2
        self._covariance[4, 4] = 1.0  # in tolerances, so that these may change

    @property
    def parameters(self) -> GyroOdometryParameters:
        """The table in use."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: GyroOdometryParameters) -> None:
        self._parameters = parameters
        self._values: Array = np.array(
            [
                self._geometry.wheel_radius,
                self._geometry.half_separation,
                parameters.variance_per_metre,
                parameters.slip_inflation,
                parameters.gyro_noise,
                parameters.gyro_scale_tolerance,
                parameters.gyro_bias_drift,
                parameters.gyro_delay,
                parameters.gyro_hold,
                parameters.slip_threshold,
                parameters.slip_time,
                parameters.standstill_time,
                parameters.standstill_spread,
                parameters.gyro_bias_limit,
            ]
        )

    @property
    def pose(self) -> Pose:
        """Where the robot is thought to be; a measured bias may move it at a standstill."""
        return Pose(*self._pose.tolist())

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of (x, y, heading), shape (3, 3), m², m rad, rad²."""
        return self._covariance[:3, :3].copy()

    @property
    def bias(self) -> float:
        """What the gyro is thought to show of a robot that does not turn, rad/s."""
        return float(self._memory[BIAS])

    @property
    def bias_std(self) -> float:
        """Standard deviation of :attr:`bias`, rad/s."""
        return math.sqrt(max(self._covariance[3, 3], 0.0))

    @property
    def calibrated(self) -> bool:
        """Whether the bias was measured at a standstill, so that the gyro is used."""
        return bool(self._memory[CALIBRATED] > 0.0)

    @property
    def slipping(self) -> bool:
        """Whether gyro and steps disagree for so long that a wheel slips or is blocked."""
        return bool(self._memory[SLIPPING] > 0.0)

    @property
    def slipping_for(self) -> float:
        """For how long (s) they have disagreed, zero unless :attr:`slipping`."""
        return float(self._memory[DISAGREES_FOR]) if self.slipping else 0.0

    def reset(self, pose: Pose = ORIGIN) -> None:
        """Start again at ``pose`` with full certainty; what is known of the bias stays.

        Raises
        ------
        ValueError
            The pose is not finite.
        """
        check_pose(pose)
        self._pose[:] = pose
        for matrix in (self._covariance, self._drift):
            matrix[:3, :] = 0.0
            matrix[:, :3] = 0.0

    def forget_bias(self) -> None:
        """Take the bias for unknown again, as after the sensor lost its power."""
        self._memory[BIAS] = self._memory[CALIBRATED] = 0.0
        clear_window(self._memory)
        for matrix in (self._covariance, self._drift):
            matrix[3, :] = 0.0
            matrix[:, 3] = 0.0
        self._covariance[3, 3] = (0.5 * self._parameters.gyro_bias_limit) ** 2

    def update(
        self, right: float, left: float, gyro: float | None, dt: float, jitter: float = 0.0
    ) -> None:
        """Add what ``dt`` seconds brought.

        Parameters
        ----------
        right, left
            Angles (rad) the wheels turned since the last call, by the step counters; exactly
            zero without a step.
        gyro
            Yaw rate (rad/s, counter-clockwise) sampled at the end of that time, bias and all;
            None when the sensor does not answer.
        dt
            Seconds since the last call.
        jitter
            Variance (rad²) of each angle that does not depend on the distance.

        Raises
        ------
        ValueError
            A number is not finite, dt not positive, or jitter negative; nothing has changed
            then.
        """
        rate = 0.0 if gyro is None else float(gyro)
        if not math.isfinite(right + left + rate + dt + jitter):
            raise ValueError(
                'wheel angles, gyro, dt and jitter must be finite: '
                f'got {right}, {left}, {gyro}, {dt}, {jitter}'
            )
        if dt <= 0.0 or jitter < 0.0:
            raise ValueError(
                f'dt must be positive and jitter not negative: got {dt} s, {jitter} rad²'
            )
        if gyro is None or not self._parameters.use_gyro:
            rate = math.nan
        update_filter(
            self._pose,
            self._covariance,
            self._drift,
            self._memory,
            self._values,
            float(right),
            float(left),
            rate,
            float(dt),
            float(jitter),
        )


# What the filter remembers besides pose and covariance; rates in rad/s, times in s.
(
    BIAS, CALIBRATED,
    FIRST_POLE, SECOND_POLE, LAST_RATE, LAST_DT,
    DISAGREEMENT, DISAGREES_FOR, SLIPPING,
    STANDS_FOR, PUSHED, COUNT, TIME, SUM, SQUARES,
    SUSPECT, SUSPECT_VARIANCE,
) = range(17)  # fmt: skip
MEMORY_SIZE = 17
"""How many these are."""
STANDSTILL_RATE = 1e-4
"""rad/s, far below the gyro's noise: what is left of a turn in its filter is over."""
MIN_SAMPLES = 20
"""Fewer tell no spread."""


@kernel
def delayed_rate(memory: Array, rate: float, dt: float, delay: float) -> float:
    """Return the rate (rad/s) that a gyro of this ``delay`` (s) shows at the end of ``dt``.

    ``rate`` is the mean over ``dt``. Within it the rate is taken to change evenly, by what the
    means tell: taken as constant, it would be wrong by half a period's change. The two poles
    have half the delay each and are integrated exactly.
    """
    slope = 0.0
    if memory[LAST_DT] > 0.0:
        slope = 2.0 * (rate - memory[LAST_RATE]) / (dt + memory[LAST_DT])
    else:  # the first call: as if it had always been so
        memory[FIRST_POLE] = memory[SECOND_POLE] = rate
    memory[LAST_RATE], memory[LAST_DT] = rate, dt
    pole, start = 0.5 * delay, rate - 0.5 * slope * dt
    decay = math.exp(-dt / pole)
    first = memory[FIRST_POLE] - (start - slope * pole)
    second = memory[SECOND_POLE] - (start - 2.0 * slope * pole)
    memory[FIRST_POLE] = start + slope * (dt - pole) + first * decay
    memory[SECOND_POLE] = start + slope * (dt - 2.0 * pole) + (second + first * dt / pole) * decay
    return float(memory[SECOND_POLE])


@kernel
def detect_slip(memory: Array, excess: float, dt: float, limit: float, time: float) -> bool:
    """Decide whether gyro and steps disagree now; ``memory`` tells whether for long enough.

    excess : gyro less steps; limit : for its smoothed size, half of it ends a slip, rad/s
    time : after which it is slip, s
    """
    smoothing = time / 3.0
    memory[DISAGREEMENT] += (excess - memory[DISAGREEMENT]) * dt / (smoothing + dt)
    if memory[SLIPPING] > 0.0:
        limit *= 0.5
    if abs(memory[DISAGREEMENT]) <= limit:
        memory[DISAGREES_FOR] = memory[SLIPPING] = 0.0
        return False
    memory[DISAGREES_FOR] += dt
    if memory[DISAGREES_FOR] >= time:
        memory[SLIPPING] = 1.0
    return True


@kernel
def propagate_covariance(
    matrix: Array,
    across: tuple[float, float],
    fused: tuple[float, float, float],
    dt: float,
    turn: float,
) -> None:
    """Let errors of heading, bias and scale move the pose: ``matrix`` <- F ``matrix`` F'.

    matrix : shape (5, 5), of (x, y, heading, bias, scale); changed in place
    across : d(x, y) by the heading; fused : d(pose) by the turn that the gyro tells
    dt : s, effect of the bias on that turn; turn : rad, effect of the scale
    """
    for column in range(5):
        told = dt * matrix[3, column] + turn * matrix[4, column]
        matrix[0, column] += across[0] * matrix[2, column] - fused[0] * told
        matrix[1, column] += across[1] * matrix[2, column] - fused[1] * told
        matrix[2, column] -= fused[2] * told
    for row in range(5):
        told = dt * matrix[row, 3] + turn * matrix[row, 4]
        matrix[row, 0] += across[0] * matrix[row, 2] - fused[0] * told
        matrix[row, 1] += across[1] * matrix[row, 2] - fused[1] * told
        matrix[row, 2] -= fused[2] * told


@kernel
def clear_window(memory: Array) -> None:
    """Start another average of the standing gyro."""
    memory[COUNT] = memory[TIME] = memory[SUM] = memory[SQUARES] = 0.0


@kernel
def estimate_bias(
    pose: Array,
    covariance: Array,
    drift: Array,
    memory: Array,
    variance: float,
    spread: float,
    limit: float,
) -> None:
    """Take the window's mean for the bias if nobody moved the robot; correct the pose by it.

    A mean that is not to be expected (5 sigma) waits for a second one that agrees with it: a
    hand does not turn a robot so evenly. It is then a jump that may have come at any time since
    the last standstill, which is what ``drift``, grown to its size, stands for.

    covariance : shape (5, 5); drift, memory : see :func:`fuse`
    variance : of the mean, by the noise alone, above 0, (rad/s)²
    spread : largest standard deviation of the samples; limit : largest bias, rad/s
    """
    count = memory[COUNT]
    surprise = memory[SUM] / count
    scatter = max(memory[SQUARES] - surprise * memory[SUM], 0.0) / (count - 1.0)
    clear_window(memory)
    if scatter > spread * spread or abs(memory[BIAS] + surprise) > limit:
        memory[SUSPECT_VARIANCE] = 0.0
        return
    variance = max(variance, scatter / count)
    if memory[CALIBRATED] > 0.0 and surprise**2 > 25.0 * (covariance[3, 3] + variance):
        alone = memory[SUSPECT_VARIANCE] == 0.0
        apart = (surprise - memory[SUSPECT]) ** 2
        if alone or apart > 25.0 * (memory[SUSPECT_VARIANCE] + variance):
            memory[SUSPECT], memory[SUSPECT_VARIANCE] = surprise, variance
            return
        factor = surprise * surprise / drift[3, 3]
        for row in range(4):
            for column in range(4):
                covariance[row, column] += factor * drift[row, column]
    memory[SUSPECT_VARIANCE] = 0.0
    memory[CALIBRATED] = 1.0
    drift[:] = 0.0

    total = covariance[3, 3] + variance
    for row in range(3):
        pose[row] += covariance[row, 3] / total * surprise
    pose[2] = wrap_to_pi(pose[2])
    memory[BIAS] += covariance[3, 3] / total * surprise
    beside = (covariance[0, 3], covariance[1, 3], covariance[2, 3], covariance[3, 3])
    for row in range(4):
        for column in range(4):
            covariance[row, column] -= beside[row] * beside[column] / total


@kernel
def update_filter(
    pose: Array,
    covariance: Array,
    drift: Array,
    memory: Array,
    values: Array,
    right: float,
    left: float,
    gyro: float,
    dt: float,
    jitter: float,
) -> None:
    """Move pose and covariance by two wheel angles and the gyro's rate at the end of ``dt``.

    With the variances V of the two paths and N of the gyro's turn, and h = 1 / 2b, the gyro's
    excess over the steps moves the paths by ``K excess dt``, ``K = V (h, -h) / (h² sum V + N)``.

    pose : shape (3,), m, m, rad; covariance : shape (5, 5); both changed in place
    drift : shape (5, 5), what a random walk of the bias by 1 rad/s/√s would have added to
        the covariance since the bias was last measured
    memory : shape (MEMORY,); values : shape (14,), see ``GyroOdometry.settings``
    right, left : rad; gyro : rad/s, NaN without one; dt : s; jitter : rad², of each angle
    """
    radius, half, per_metre, inflation = values[0], values[1], values[2], values[3]
    noise, tolerance, walk, delay, hold = values[4], values[5], values[6], values[7], values[8]
    limit, slip_time, window, spread = values[9], values[10], values[11], values[12]
    heard = not math.isnan(gyro)
    run_right, run_left, share = radius * right, radius * left, 0.5 / half
    delayed = delayed_rate(memory, share * (run_right - run_left) / dt, dt, delay)
    still = right == 0.0 and left == 0.0 and abs(delayed) < STANDSTILL_RATE
    memory[STANDS_FOR] = memory[STANDS_FOR] + dt if still else 0.0

    # How uncertain the paths are, and how far the gyro may correct them.
    told = turn = noise_turn = gain_right = gain_left = 0.0
    constant = radius * radius * jitter
    path_right, path_left, rough = abs(run_right), abs(run_left), per_metre
    if heard and memory[CALIBRATED] > 0.0:
        rate = gyro - memory[BIAS]
        excess, brief = rate - delayed, min(dt, hold)
        disagrees = detect_slip(
            memory, excess, brief, limit + 3.0 * tolerance * abs(rate), slip_time
        )
        # A hand that pushes back and forth passes through zero: it is heard to the end.
        memory[PUSHED] = max(memory[PUSHED] - dt, 0.0)
        if memory[STANDS_FOR] > slip_time and abs(memory[DISAGREEMENT]) > 3.0 * spread:
            memory[PUSHED] = window
        pushed = still and memory[PUSHED] > 0.0
        if disagrees or pushed:  # the path that the steps know nothing of is one as well
            rough *= inflation
            path_right += half * abs(excess) * dt
            path_left += half * abs(excess) * dt
        elif right == 0.0 and left == 0.0 and not still:
            # The gyro still shows the end of the turn: hear it to the end.
            path_right = path_left = half * abs(delayed) * dt
        noise_right, noise_left = rough * path_right + constant, rough * path_left + constant
        noise_steps = share * share * (noise_right + noise_left)
        if noise_steps > 0.0:
            # One sample stands for all of dt, though its noise does not average out over it.
            noise_turn = noise * noise * dt * max(1.0, 0.5 * dt / delay)
            noise_turn += noise_steps * max(0.0, dt / hold - 1.0)
            gain_right = share * noise_right / (noise_steps + noise_turn)
            gain_left = -share * noise_left / (noise_steps + noise_turn)
        told, turn = excess * dt, tolerance * rate * dt
    else:
        memory[DISAGREEMENT] = memory[DISAGREES_FOR] = memory[SLIPPING] = 0.0
        memory[PUSHED] = 0.0
        noise_right, noise_left = rough * path_right + constant, rough * path_left + constant

    across_x, across_y, right_x, right_y, left_x, left_y, bend = integrate_arc(
        pose, run_right + gain_right * told, run_left + gain_left * told, half
    )
    fused = (
        right_x * gain_right + left_x * gain_left,
        right_y * gain_right + left_y * gain_left,
        bend * (gain_right - gain_left),
    )
    propagate_covariance(covariance, (across_x, across_y), fused, dt, turn)
    propagate_covariance(drift, (across_x, across_y), fused, dt, 0.0)
    mine, yours, bent = share * fused[0], share * fused[1], share * fused[2]
    add_noise(covariance, noise_right, right_x - mine, right_y - yours, bend - bent)
    add_noise(covariance, noise_left, left_x + mine, left_y + yours, bent - bend)
    add_noise(covariance, noise_turn, fused[0], fused[1], fused[2])
    covariance[3, 3] += walk * walk * dt
    drift[3, 3] += dt

    if not (still and heard):
        clear_window(memory)
        memory[SUSPECT_VARIANCE] = 0.0
    else:
        deviation = gyro - memory[BIAS]
        memory[COUNT] += 1.0
        memory[TIME] += dt
        memory[SUM] += deviation
        memory[SQUARES] += deviation * deviation
        if memory[TIME] >= window and memory[COUNT] >= MIN_SAMPLES:
            single = max(1.0 / memory[TIME], 0.5 / (delay * memory[COUNT]))
            estimate_bias(
                pose, covariance, drift, memory, noise * noise * single, spread, values[13]
            )
    for row in range(1, 5):  # rounding must not tear it apart over hours
        for column in range(row):
            mean = 0.5 * (covariance[row, column] + covariance[column, row])
            covariance[row, column] = covariance[column, row] = mean
