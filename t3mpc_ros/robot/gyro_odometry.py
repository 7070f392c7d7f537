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
"""Gyro odometry: error-state Kalman filter over wheel angles and yaw gyro, with slip detection.

The steps of a stepper motor are issued pulses, not motion; a gyro has a zero-rate offset (bias)
and a scale error. The filter over (x, y, yaw, bias, scale) combines both:

- The *difference* between the gyro rate and the rate of the steps, delayed as in the gyro,
  corrects the travels of the wheels before the pose is integrated, so yaw has no lag.
- The gain follows from the white noise of both. Bias and scale are errors of another kind:
  against steps alone they cannot be separated from unequal wheels and a wrong wheel separation,
  so motion does not change their estimates. They are states of which only the correlation with
  the pose is kept: ten turns one way leave a yaw uncertainty of 20 pi times the scale tolerance,
  and turning back removes it.
- The bias is measured at every standstill. Through the correlation this also corrects the yaw
  drift that the bias caused, if the correction is small: the frame of the odometry is continuous
  (REP 105), and after 12 min without a standstill the bias said 33 degrees, of which 3 were true.
  Else the bias alone is updated, as beside a state that is considered but not estimated
  (Schmidt-Kalman filter). The scale is never estimated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import ORIGIN, Array, Pose, check_pose
from t3mpc_ros.kernels import Structure, TypedKernel, kernel
from t3mpc_ros.parameters.table import ParameterError, parameter
from t3mpc_ros.robot.wheel_odometry import (
    WheelOdometryParameters,
    add_noise,
    integrate_arc,
    wrap_to_pi,
)

STANDSTILL_RATE = 1e-4
"""rad/s, far below the gyro noise: the response of its filter to a turn has decayed."""
LARGEST_CORRECTION = 0.02, 0.04
"""Largest correction of the pose by a measured bias, m and rad: the pose may jump by that."""
MIN_SAMPLES = 20  # smallest number of samples for a standard deviation


@dataclass(frozen=True)
class GyroOdometryParameters(WheelOdometryParameters):
    """Errors of steps and gyro, and thresholds of the slip detection."""

    use_gyro: bool = parameter(
        True,
        'use the gyro; without it the odometry uses the steps alone and detects no slip',
        dynamic=True,
    )
    gyro_noise: ClassVar[float] = 8.7e-5
    """Noise density of the gyro, rad/s/√Hz: 0.005 deg/s/√Hz (data sheet PS-MPU-6000A r3.4). A
    turn integrated over a time t has the variance noise² t."""
    gyro_scale: float = parameter(
        1.0,
        'true rate / rate by the data sheet, from t3mpc robot calibrate',
        bounds=(0.8, 1.2),
        dynamic=True,
    )
    gyro_scale_tolerance: float = parameter(
        0.001,
        'standard deviation of the relative scale error after a calibration over ten turns; 0.03 '
        'without calibration',
        bounds=(0.0, 0.5),
        dynamic=True,
    )
    gyro_bias_limit: ClassVar[float] = 0.7
    """Largest accepted bias, rad/s: ±20 deg/s, and ±20 over temperature (data sheet). Half of it
    is the standard deviation of an unknown bias."""
    gyro_bias_drift: ClassVar[float] = 5e-5
    """Random walk of the bias, rad/s/√s, assumed: standard deviation after one second."""
    gyro_delay: float = parameter(
        0.0048,
        'delay of the low-pass filter of the gyro, modelled as two equal poles (43 Hz)',
        's',
        (1e-4, 0.1),
        dynamic=True,
        source='MPU-6000 register map RM-MPU-6000A r4.2: DLPF_CFG 3, 42 Hz',
    )
    gyro_hold: ClassVar[float] = 0.05
    """Longest time that a gyro sample represents, s, assumed; the rest of a gap uses the steps."""
    slip_threshold: float = parameter(
        0.25,
        'yaw rate difference between gyro and steps that indicates slip, plus three times the '
        'scale tolerance',
        'rad/s',
        (0.01, 10.0),
        dynamic=True,
    )
    slip_time: ClassVar[float] = 0.15
    """Time that the difference must last, s, assumed; a third of it is the time constant of the
    smoothing."""
    slip_inflation: ClassVar[float] = 3000.0
    """Factor on the variance of the wheel travel while gyro and steps disagree, assumed."""
    standstill_time: ClassVar[float] = 1.0
    """Standstill over which the bias is averaged, repeatedly, s, assumed."""
    standstill_spread: ClassVar[float] = 0.0035
    """Largest standard deviation of the gyro at a standstill, rad/s, assumed; beyond it, or at a
    yaw rate of more than three times this value, the robot is being moved."""

    def check_consistency(self) -> None:
        """Raise ParameterError when slip and a pushed robot cannot be distinguished."""
        if self.slip_threshold < 3.0 * self.standstill_spread:
            raise ParameterError(
                'slip_threshold must be at least three times standstill_spread '
                f'({3.0 * self.standstill_spread:g} rad/s): got {self.slip_threshold:g}'
            )


class GyroMemory(Structure):
    """Memory of the filter besides pose and covariance; rates in rad/s, times in s."""

    bias: float
    calibrated: bool  # whether the bias has been measured at a standstill; the gyro is then in use
    first_pole: float
    second_pole: float  # state of the low-pass filter of the gyro
    last_rate: float
    last_dt: float  # 0 before the first rate
    disagreement: float  # rate of the gyro beyond that of the steps, smoothed
    disagrees_for: float
    slipping: bool
    standstill_for: float
    pushed_for: float  # time for which a robot at a standstill still counts as pushed
    count: float
    """Samples in the average of a standstill; the next three are their duration and sums."""
    time: float
    total: float
    squares: float
    suspect: float  # measurement of the bias that needs confirmation
    suspect_variance: float  # its variance, (rad/s)²; 0 without one


class GyroConstants(Structure):
    """Constants of :func:`update_filter`: lengths in m, and values of the parameters by name."""

    wheel_radius: float
    half_separation: float
    variance_per_metre: float
    slip_inflation: float
    gyro_noise: float
    gyro_scale_tolerance: float
    gyro_bias_drift: float
    gyro_delay: float
    gyro_hold: float
    slip_threshold: float
    slip_time: float
    standstill_time: float
    standstill_spread: float
    gyro_bias_limit: float


class GyroOdometry:
    """Pose and covariance from step counters and a yaw gyro.

    The gyro is used after the first standstill, because its bias may be as large as the turns.
    Without a gyro the result is that of :class:`~t3mpc_ros.robot.wheel_odometry.WheelOdometry`.

    Not detected: equal slip of both wheels (the gyro measures turns only); a bias jump in
    motion below ``slip_threshold``: yaw then drifts at that rate until the next standstill, which
    adds what it does not correct to the covariance; external rotation at a standstill that is
    perfectly even, or slower than three times ``standstill_spread``.
    """

    def __init__(self, parameters: GyroOdometryParameters, geometry: WheelGeometry) -> None:
        self._geometry = geometry
        self._pose: Array = np.zeros(3)
        self._covariance: Array = np.zeros((5, 5))
        self._drift: Array = np.zeros((5, 5))
        self._memory = GyroMemory.new()
        self._update_filter = TypedKernel(update_filter)
        self.parameters = parameters
        self.update(0.0, 0.0, None, 1.0)  # compile now, not within a step
        self._memory = GyroMemory.new()
        self._drift[:] = 0.0
        self._covariance[3, 3] = (0.5 * parameters.gyro_bias_limit) ** 2
        self._covariance[4, 4] = 1.0  # in units of the tolerance, which may change

    @property
    def parameters(self) -> GyroOdometryParameters:
        """The parameters in use."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: GyroOdometryParameters) -> None:
        self._parameters = parameters
        fields = GyroConstants.__annotations__
        self._constants = GyroConstants.new(
            wheel_radius=self._geometry.wheel_radius,
            half_separation=self._geometry.half_separation,
            **{name: getattr(parameters, name) for name in fields if hasattr(parameters, name)},
        )

    @property
    def pose(self) -> Pose:
        """Estimated pose; a bias measured at a standstill may move it a little."""
        return Pose(*self._pose.tolist())

    @property
    def covariance(self) -> Array:
        """Copy of the covariance of (x, y, yaw), shape (3, 3), m², m rad, rad²."""
        return self._covariance[:3, :3].copy()

    @property
    def bias(self) -> float:
        """Estimated gyro bias, rad/s."""
        return float(self._memory[0].bias)

    @property
    def bias_std(self) -> float:
        """Standard deviation of :attr:`bias`, rad/s."""
        return math.sqrt(max(self._covariance[3, 3], 0.0))

    @property
    def calibrated(self) -> bool:
        """Whether the bias has been measured at a standstill; the gyro is then in use."""
        return bool(self._memory[0].calibrated)

    @property
    def slipping(self) -> bool:
        """Whether gyro and steps have disagreed for ``slip_time``: a wheel slips or is blocked."""
        return bool(self._memory[0].slipping)

    @property
    def slipping_for(self) -> float:
        """Time (s) for which gyro and steps have disagreed, zero unless :attr:`slipping`."""
        return float(self._memory[0].disagrees_for) if self.slipping else 0.0

    def reset(self, pose: Pose = ORIGIN) -> None:
        """Set a finite pose and clear its covariance; the bias estimate is kept."""
        check_pose(pose)
        self._pose[:] = pose
        for matrix in (self._covariance, self._drift):
            matrix[:3, :] = 0.0
            matrix[:, :3] = 0.0

    def forget_bias(self) -> None:
        """Reset the bias estimate, as after a power loss of the sensor."""
        for name in ('bias', 'calibrated', 'count', 'time', 'total', 'squares'):
            setattr(self._memory[0], name, 0)
        for matrix in (self._covariance, self._drift):
            matrix[3, :] = 0.0
            matrix[:, 3] = 0.0
        self._covariance[3, 3] = (0.5 * self._parameters.gyro_bias_limit) ** 2

    def add_unknown_travel(self, right: float, left: float) -> None:
        """Add to the covariance what no step counter has measured; the pose stays.

        Each wheel travelled between 0 and this distance (m, signed), evenly distributed: partly
        both by the same share, partly each by its own.
        """
        yaw, share = float(self._pose[2]), 0.5 / self._geometry.half_separation
        by_right = right * np.array((0.5 * math.cos(yaw), 0.5 * math.sin(yaw), share))
        by_left = left * np.array((0.5 * math.cos(yaw), 0.5 * math.sin(yaw), -share))
        for direction in (by_right + by_left, by_right, by_left):
            self._covariance[:3, :3] += np.outer(direction, direction) / 3.0

    def update(
        self, right: float, left: float, gyro: float | None, dt: float, jitter: float = 0.0
    ) -> None:
        """Update the estimate by the finite measurements of the last ``dt`` seconds.

        right, left : angles (rad) by which the wheels turned since the last call, from the step
                      counters; exactly zero without a step
        gyro        : yaw rate (rad/s, counter-clockwise) sampled at the end of that time, bias
                      included, without ``gyro_scale``; None when the sensor does not respond
        dt          : s, above 0
        jitter      : variance (rad²) of each angle that does not depend on the travel
        """
        rate = 0.0 if gyro is None else self._parameters.gyro_scale * float(gyro)
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
        self._update_filter(
            self._pose,
            self._covariance,
            self._drift,
            self._memory,
            self._constants,
            float(right),
            float(left),
            rate,
            float(dt),
            float(jitter),
        )


@kernel
def delayed_rate(memory: GyroMemory, rate: float, dt: float, delay: float) -> float:
    """Return the output (rad/s) of a gyro with this ``delay`` (s) at the end of ``dt``.

    Within ``dt`` the rate, of which the mean is given, changes linearly with the slope of
    consecutive means; a constant rate would be wrong by half the change of a period. The two
    poles have half the delay each and are integrated exactly.
    """
    slope = 0.0
    if memory.last_dt > 0.0:
        slope = 2.0 * (rate - memory.last_rate) / (dt + memory.last_dt)
    else:  # the first call starts in steady state
        memory.first_pole = memory.second_pole = rate
    memory.last_rate, memory.last_dt = rate, dt
    pole, start = 0.5 * delay, rate - 0.5 * slope * dt
    decay = math.exp(-dt / pole)
    first = memory.first_pole - (start - slope * pole)
    second = memory.second_pole - (start - 2.0 * slope * pole)
    memory.first_pole = start + slope * (dt - pole) + first * decay
    memory.second_pole = start + slope * (dt - 2.0 * pole) + (second + first * dt / pole) * decay
    return float(memory.second_pole)


@kernel
def detect_slip(memory: GyroMemory, excess: float, dt: float, limit: float, time: float) -> bool:
    """Decide whether gyro and steps disagree now; after ``time`` (s) set ``memory.slipping``.

    ``excess`` is gyro minus steps; half of the limit of its smoothed magnitude ends a slip.
    """
    smoothing = time / 3.0
    memory.disagreement += (excess - memory.disagreement) * dt / (smoothing + dt)
    if memory.slipping:
        limit *= 0.5
    if abs(memory.disagreement) <= limit:
        memory.disagrees_for, memory.slipping = 0.0, False
        return False
    memory.disagrees_for += dt
    if memory.disagrees_for >= time:
        memory.slipping = True
    return True


@kernel
def propagate_covariance(
    matrix: Array,
    across: tuple[float, float],
    fused: tuple[float, float, float],
    dt: float,
    turn: float,
) -> None:
    """Propagate errors of yaw, bias and scale to the pose: ``matrix`` <- F ``matrix`` F'.

    ``across`` is d(x, y) by the yaw, ``fused`` d(pose) by the turn measured by the gyro; ``dt``
    and ``turn`` are the effects of bias and scale on that turn.
    """
    for column in range(5):
        shift = dt * matrix[3, column] + turn * matrix[4, column]
        matrix[0, column] += across[0] * matrix[2, column] - fused[0] * shift
        matrix[1, column] += across[1] * matrix[2, column] - fused[1] * shift
        matrix[2, column] -= fused[2] * shift
    for row in range(5):
        shift = dt * matrix[row, 3] + turn * matrix[row, 4]
        matrix[row, 0] += across[0] * matrix[row, 2] - fused[0] * shift
        matrix[row, 1] += across[1] * matrix[row, 2] - fused[1] * shift
        matrix[row, 2] -= fused[2] * shift


@kernel
def clear_window(memory: GyroMemory) -> None:
    """Start a new standstill average of the gyro."""
    memory.count = memory.time = memory.total = memory.squares = 0.0


@kernel
def estimate_bias(
    pose: Array,
    covariance: Array,
    drift: Array,
    memory: GyroMemory,
    constants: GyroConstants,
) -> None:
    """Update the bias by the mean of the window if the robot was not moved.

    The correlation corrects the pose, too, by at most :data:`LARGEST_CORRECTION`.

    A mean beyond 5 sigma is used only when a second one confirms it: a robot turned by hand does
    not turn so evenly. It is then a jump at an unknown time since the last standstill, which
    ``drift``, scaled to its size, represents in the covariance.
    """
    count, spread = memory.count, constants.standstill_spread
    single = max(1.0 / memory.time, 0.5 / (constants.gyro_delay * count))
    variance = constants.gyro_noise * constants.gyro_noise * single  # of the mean, by the noise
    innovation = memory.total / count
    scatter = max(memory.squares - innovation * memory.total, 0.0) / (count - 1.0)
    clear_window(memory)
    if scatter > spread * spread or abs(memory.bias + innovation) > constants.gyro_bias_limit:
        memory.suspect_variance = 0.0
        return
    variance = max(variance, scatter / count)
    if memory.calibrated and innovation**2 > 25.0 * (covariance[3, 3] + variance):
        first = memory.suspect_variance == 0.0
        apart = (innovation - memory.suspect) ** 2
        if first or apart > 25.0 * (memory.suspect_variance + variance):
            memory.suspect, memory.suspect_variance = innovation, variance
            return
        factor = innovation * innovation / drift[3, 3]
        for row in range(4):
            for column in range(4):
                covariance[row, column] += factor * drift[row, column]
    memory.suspect_variance = 0.0
    memory.calibrated = True
    drift[:] = 0.0

    total = covariance[3, 3] + variance
    gain = covariance[3, 3] / total
    by_x, by_y, by_yaw = (
        covariance[0, 3] / total,
        covariance[1, 3] / total,
        covariance[2, 3] / total,
    )
    away, turn = math.hypot(by_x, by_y) * abs(innovation), abs(by_yaw * innovation)
    memory.bias += gain * innovation
    if away <= LARGEST_CORRECTION[0] and turn <= LARGEST_CORRECTION[1]:
        pose[0] += by_x * innovation
        pose[1] += by_y * innovation
        pose[2] = wrap_to_pi(pose[2] + by_yaw * innovation)
        bias_column = (covariance[0, 3], covariance[1, 3], covariance[2, 3])
        for row in range(3):
            for column in range(3):
                covariance[row, column] -= bias_column[row] * bias_column[column] / total
    for row in range(4):
        covariance[row, 3] *= 1.0 - gain
        if row != 3:
            covariance[3, row] *= 1.0 - gain


@kernel
def update_filter(
    pose: Array,
    covariance: Array,
    drift: Array,
    memories: Sequence[GyroMemory],
    settings: Sequence[GyroConstants],
    right: float,
    left: float,
    gyro: float,
    dt: float,
    jitter: float,
) -> None:
    """Update pose and covariance by two wheel angles and the gyro rate at the end of ``dt``.

    With the variances V of the two travels and N of the turn measured by the gyro, and
    h = 1 / 2b, the excess of the gyro over the steps changes the travels by ``K excess dt``,
    ``K = V (h, -h) / (h² sum V + N)``. ``drift`` is the covariance that a random walk of the bias
    by 1 rad/s/√s would have added since the last bias measurement; ``gyro`` is NaN without one.
    """
    memory, constants = memories[0], settings[0]
    radius, half, per_metre = (
        constants.wheel_radius,
        constants.half_separation,
        constants.variance_per_metre,
    )
    has_gyro = not math.isnan(gyro)
    run_right, run_left, share = radius * right, radius * left, 0.5 / half
    steps_rate = share * (run_right - run_left) / dt
    delayed = delayed_rate(memory, steps_rate, dt, constants.gyro_delay)
    still = right == 0.0 and left == 0.0 and abs(delayed) < STANDSTILL_RATE
    memory.standstill_for = memory.standstill_for + dt if still else 0.0

    # Variance of the travels, and gain of the gyro.
    gyro_excess = turn = noise_turn = gain_right = gain_left = 0.0
    constant = radius * radius * jitter
    path_right, path_left, rough = abs(run_right), abs(run_left), per_metre
    if has_gyro and memory.calibrated:
        rate = gyro - memory.bias
        excess = rate - delayed
        if is_disturbed(memory, excess, rate, dt, still, constants):
            # Travel that the steps do not count.
            rough *= constants.slip_inflation
            path_right += half * abs(excess) * dt
            path_left += half * abs(excess) * dt
        elif right == 0.0 and left == 0.0 and not still:
            # The gyro still responds to the end of the turn.
            path_right = path_left = half * abs(delayed) * dt
        noise_right, noise_left = rough * path_right + constant, rough * path_left + constant
        noise_steps = share * share * (noise_right + noise_left)
        if noise_steps > 0.0:
            # One sample represents all of dt, but its noise does not average over it.
            noise_turn = (
                constants.gyro_noise
                * constants.gyro_noise
                * dt
                * max(1.0, 0.5 * dt / constants.gyro_delay)
            )
            noise_turn += noise_steps * max(0.0, dt / constants.gyro_hold - 1.0)
            gain_right = share * noise_right / (noise_steps + noise_turn)
            gain_left = -share * noise_left / (noise_steps + noise_turn)
        gyro_excess, turn = excess * dt, constants.gyro_scale_tolerance * rate * dt
    else:
        memory.disagreement = memory.disagrees_for = memory.pushed_for = 0.0
        memory.slipping = False
        noise_right, noise_left = rough * path_right + constant, rough * path_left + constant

    across_x, across_y, right_x, right_y, left_x, left_y, bend = integrate_arc(
        pose, run_right + gain_right * gyro_excess, run_left + gain_left * gyro_excess, half
    )
    fused = (
        right_x * gain_right + left_x * gain_left,
        right_y * gain_right + left_y * gain_left,
        bend * (gain_right - gain_left),
    )
    propagate_covariance(covariance, (across_x, across_y), fused, dt, turn)
    propagate_covariance(drift, (across_x, across_y), fused, dt, 0.0)
    part_x, part_y, part_bend = share * fused[0], share * fused[1], share * fused[2]
    add_noise(covariance, noise_right, right_x - part_x, right_y - part_y, bend - part_bend)
    add_noise(covariance, noise_left, left_x + part_x, left_y + part_y, part_bend - bend)
    add_noise(covariance, noise_turn, fused[0], fused[1], fused[2])
    covariance[3, 3] += constants.gyro_bias_drift * constants.gyro_bias_drift * dt
    drift[3, 3] += dt

    if still and has_gyro:
        average_standstill(pose, covariance, drift, memory, gyro - memory.bias, dt, constants)
    else:
        clear_window(memory)
        memory.suspect_variance = 0.0
    for row in range(1, 5):  # keep it symmetric despite rounding over hours
        for column in range(row):
            mean = 0.5 * (covariance[row, column] + covariance[column, row])
            covariance[row, column] = covariance[column, row] = mean


@kernel
def is_disturbed(
    memory: GyroMemory,
    excess: float,
    rate: float,
    dt: float,
    still: bool,
    constants: GyroConstants,
) -> bool:
    """Decide whether a wheel slips now, or somebody pushes a robot that is ``still``."""
    limit = constants.slip_threshold + 3.0 * constants.gyro_scale_tolerance * abs(rate)
    disagrees = detect_slip(
        memory, excess, min(dt, constants.gyro_hold), limit, constants.slip_time
    )
    # A hand that pushes back and forth passes through zero: the push lasts until the end.
    memory.pushed_for = max(memory.pushed_for - dt, 0.0)
    rests = memory.standstill_for > constants.slip_time
    if rests and abs(memory.disagreement) > 3.0 * constants.standstill_spread:
        memory.pushed_for = constants.standstill_time
    return disagrees or (still and memory.pushed_for > 0.0)


@kernel
def average_standstill(
    pose: Array,
    covariance: Array,
    drift: Array,
    memory: GyroMemory,
    deviation: float,
    dt: float,
    constants: GyroConstants,
) -> None:
    """Add a sample of the gyro (rad/s, without bias); measure the bias over a full window."""
    memory.count += 1.0
    memory.time += dt
    memory.total += deviation
    memory.squares += deviation * deviation
    if memory.time >= constants.standstill_time and memory.count >= MIN_SAMPLES:
        estimate_bias(pose, covariance, drift, memory, constants)
