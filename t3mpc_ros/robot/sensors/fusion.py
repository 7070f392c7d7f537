# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where steps and gyro together say the robot is, how sure that is, and whether it slips.

The steps of a stepper are pulses issued, not motion; a gyro has a zero-rate offset (bias) and an
error of scale. An error-state Kalman filter over (x, y, heading, bias, scale) joins them:

- The *difference* between the gyro's rate and that of the steps, these delayed as the gyro is,
  corrects the paths of the wheels before the pose follows them: no lag gets into the heading.
- How far is decided by the parts of both that are noise. Bias and scale are errors of another
  kind: against steps alone they cannot be told from unequal wheels and a wrong track width, so
  motion teaches nothing of them. They are states of which only the correlation with the pose
  is kept: ten turns one way leave a heading uncertain by 20 pi times the tolerance of the scale,
  and turning back takes that away again.
- The bias is measured whenever the robot stands. Through the correlation that also takes back
  what the heading has drifted because of it; the scale is never learnt.
"""

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.motion import Geometry, Pose
from t3mpc_ros.motion.words import ORIGIN, check_pose
from t3mpc_ros.robot.odometry import OdometrySettings
from t3mpc_ros.robot.sensors.yaw_filter import (
    BIAS,
    CALIBRATED,
    DISAGREES_FOR,
    MEMORY,
    SLIPPING,
    clear_window,
    fuse,
)
from t3mpc_ros.settings import SettingError, setting

Array = npt.NDArray[np.float64]

MPU6050 = 'data sheet PS-MPU-6000A r3.4'


@dataclass(frozen=True)
class FusedOdometrySettings(OdometrySettings):
    """How far steps and gyro are believed, and when they are said to disagree."""

    use_gyro: bool = setting(
        True,
        'let the gyro help; without it there are the steps alone, and no slip is seen',
        live=True,
    )
    gyro_noise: float = setting(
        8.7e-5,
        'noise of the rate: a turn summed for a time t gets the variance noise² t',
        unit='rad/s/√Hz',
        low=1e-7,
        high=1.0,
        live=True,
        source=f'{MPU6050}: 0.005 deg/s/√Hz',
    )
    gyro_scale_tolerance: float = setting(
        0.001,
        'spread of the relative error of scale, after calibration by ten turns; 0.03 without',
        low=0.0,
        high=0.5,
        live=True,
    )
    gyro_bias_limit: float = setting(
        0.7,
        'largest bias that is believed; half of it is how uncertain an unknown one is',
        unit='rad/s',
        low=1e-3,
        high=10.0,
        source=f'{MPU6050}: ±20 deg/s, and ±20 over temperature',
    )
    gyro_bias_drift: float = setting(
        5e-5,
        'random walk of the bias: spread after one second; warming up is faster than later',
        unit='rad/s/√s',
        low=0.0,
        high=1.0,
        live=True,
    )
    gyro_delay: float = setting(
        0.0048,
        'delay of the low-pass filter in the gyro, here two equal poles (which then pass 43 Hz)',
        unit='s',
        low=1e-4,
        high=0.1,
        live=True,
        source='MPU-6000 register map RM-MPU-6000A r4.2: DLPF_CFG 3, 42 Hz',
    )
    gyro_hold: float = setting(
        0.05,
        'for how long one sample may speak; of a longer gap the gyro knows but a part',
        unit='s',
        low=1e-3,
        high=10.0,
        live=True,
    )
    slip_threshold: float = setting(
        0.25,
        'yaw rate by which gyro and steps must disagree for slip; three times the tolerance of '
        'the scale is allowed on top',
        unit='rad/s',
        low=0.01,
        high=10.0,
        live=True,
    )
    slip_time: float = setting(
        0.15,
        'for how long they must; a third of it smooths the disagreement',
        unit='s',
        low=0.0,
        high=10.0,
        live=True,
    )
    slip_inflation: float = setting(
        3000.0,
        'factor on the variance of the paths of the wheels while they disagree',
        low=1.0,
        high=1e6,
        live=True,
    )
    standstill_time: float = setting(
        1.0,
        'time without a step over which the bias is averaged, again and again',
        unit='s',
        low=0.1,
        high=60.0,
        live=True,
    )
    standstill_spread: float = setting(
        0.0035,
        'largest standard deviation of the samples at a standstill; if larger, or if a standing '
        'robot turns by more than three times this rate, somebody moves it',
        unit='rad/s',
        low=1e-5,
        high=1.0,
        live=True,
    )

    def check_together(self) -> None:
        """Raise SettingError when slip could not be told from a robot being pushed."""
        if self.slip_threshold < 3.0 * self.standstill_spread:
            raise SettingError(
                'slip_threshold must be at least three times standstill_spread '
                f'({3.0 * self.standstill_spread:g} rad/s): got {self.slip_threshold:g}'
            )


class FusedOdometry:
    """Keeps pose and covariance from step counters and, where there is one, a yaw gyro.

    Until the robot has stood still once the gyro is not used: its bias may be as large as the
    turns themselves. Without a gyro this is :class:`~t3mpc_ros.robot.odometry.DeadReckoning`.

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

    def __init__(self, settings: FusedOdometrySettings, geometry: Geometry) -> None:
        self._geometry = geometry
        self._pose: Array = np.zeros(3)
        self._covariance: Array = np.zeros((5, 5))
        self._drift: Array = np.zeros((5, 5))
        self._memory: Array = np.zeros(MEMORY)
        self.settings = settings
        self.update(0.0, 0.0, None, 1.0)  # compiled now, never in mid-step
        self._memory[:] = 0.0
        self._drift[:] = 0.0
        self._covariance[3, 3] = (0.5 * settings.gyro_bias_limit) ** 2
        self._covariance[4, 4] = 1.0  # in tolerances, so that these may change

    @property
    def settings(self) -> FusedOdometrySettings:
        """The table in use."""
        return self._settings

    @settings.setter
    def settings(self, settings: FusedOdometrySettings) -> None:
        self._settings = settings
        self._values: Array = np.array(
            [
                self._geometry.wheel_radius,
                self._geometry.half_separation,
                settings.variance_per_metre,
                settings.slip_inflation,
                settings.gyro_noise,
                settings.gyro_scale_tolerance,
                settings.gyro_bias_drift,
                settings.gyro_delay,
                settings.gyro_hold,
                settings.slip_threshold,
                settings.slip_time,
                settings.standstill_time,
                settings.standstill_spread,
                settings.gyro_bias_limit,
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
        self._covariance[3, 3] = (0.5 * self._settings.gyro_bias_limit) ** 2

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
        if gyro is None or not self._settings.use_gyro:
            rate = math.nan
        fuse(
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
