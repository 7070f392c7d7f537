# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A state estimate in front of the law: a Kalman filter that knows what was commanded."""

from collections import deque
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.settings import Settings, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimateSettings(Settings):
    """What the filter assumes about the robot and its sensors."""

    enabled: bool = setting(True, 'whether the law is fed the estimate instead of raw speeds')
    noise_variance: float = setting(
        0.04,
        'variance of the measured wheel speeds; 0 trusts them fully',
        unit='(rad/s)²',
        low=0.0,
        high=100.0,
        source='paper: noise of the simulations',
    )
    disturbance: float = setting(
        15.0,
        'how fast the unknown acceleration wanders, as the square root of its spectral density',
        unit='rad/s²/√s',
        low=1e-3,
        high=1e4,
    )
    lag: float = setting(
        0.02, 'first-order lag of the velocity drive', unit='s', low=0.001, high=1.0
    )
    dead_time: float = setting(
        0.01, 'dead time of the velocity drive', unit='s', low=0.0, high=0.5
    )


class SpeedEstimator:
    """Estimates each wheel's speed and the acceleration that the model does not explain.

    Two states a wheel, speed chi (rad/s) and unexplained acceleration d (rad/s²), the latter a
    random walk. With a torque drive chi' = u + d, u being the applied acceleration; with a
    velocity drive chi' = (c - chi)/lag + d, c being the command that took effect a dead time
    later. The gain is the stationary one of the discrete Riccati equation for the nominal
    period, so a step costs a handful of multiplications.

    Parameters
    ----------
    settings
        Noise, disturbance, lag and dead time.
    drive
        ``'velocity'`` or ``'torque'``.
    period
        Nominal time between steps, s.
    """

    def __init__(self, settings: EstimateSettings, drive: str, period: float) -> None:
        if drive not in ('velocity', 'torque'):
            raise ValueError(f"drive must be 'velocity' or 'torque': got {drive!r}")
        self._settings = settings
        self._velocity = drive == 'velocity'
        self._gain = stationary_gain(self._transition(period), settings, period)
        steps, self._fraction = divmod(settings.dead_time / period, 1.0)
        self._commands: deque[Array] = deque(maxlen=int(steps) + 2)
        self.reset(np.zeros(2))

    @property
    def gain(self) -> Array:
        """Stationary Kalman gain: share of the innovation given to chi (1) and to d (1/s)."""
        return self._gain

    def reset(self, speeds: Array) -> None:
        """Start again from measured wheel speeds (rad/s), at rest relative to the command."""
        self.speeds: Array = speeds.copy()
        """Estimated wheel speeds, rad/s, shape (2,)."""
        self.unexplained: Array = np.zeros_like(speeds)
        """Estimated acceleration that the model does not explain, rad/s², shape (2,)."""
        self._commands.clear()
        for _ in range(self._commands.maxlen or 1):
            self._commands.append(speeds.copy())

    def predict(self, applied: Array, dt: float) -> None:
        """Move ``dt`` seconds on, under what was applied meanwhile.

        Parameters
        ----------
        applied
            Commanded wheel speeds (rad/s) for a velocity drive, accelerations (rad/s²) for a
            torque drive, shape (2,).
        dt
            Seconds since the last step.
        """
        if self._velocity:
            self._commands.append(applied.copy())
            late = self._fraction
            effective = (1.0 - late) * self._commands[1] + late * self._commands[0]
            decay = math.exp(-dt / self._settings.lag)
            self.speeds = (
                decay * self.speeds
                + (1.0 - decay) * effective
                + self._settings.lag * (1.0 - decay) * self.unexplained
            )
        else:
            self.speeds = self.speeds + dt * (applied + self.unexplained)

    def correct(self, measured: Array) -> Array:
        """Return the estimate after seeing measured wheel speeds (rad/s), shape (2,)."""
        if not self._settings.enabled:
            self.speeds = measured.copy()
            return self.speeds
        innovation = measured - self.speeds
        self.speeds = self.speeds + self._gain[0] * innovation
        self.unexplained = self.unexplained + self._gain[1] * innovation
        return self.speeds

    def _transition(self, period: float) -> Array:
        if not self._velocity:
            return np.array([[1.0, period], [0.0, 1.0]])
        decay = math.exp(-period / self._settings.lag)
        return np.array([[decay, self._settings.lag * (1.0 - decay)], [0.0, 1.0]])


def stationary_gain(transition: Array, settings: EstimateSettings, period: float) -> Array:
    """Return the Kalman gain (2,) that the discrete Riccati recursion settles at.

    The disturbance enters as a random walk of the unexplained acceleration with variance
    ``disturbance² * period`` a step. A variance of zero gives the gain (1, finite).
    """
    process = np.array([[0.0, 0.0], [0.0, settings.disturbance**2 * period]])
    noise = max(settings.noise_variance, 1e-9)
    covariance = np.eye(2) * noise
    gain = np.zeros(2)
    for _ in range(100_000):
        ahead = transition @ covariance @ transition.T + process
        gain_next = ahead[:, 0] / (ahead[0, 0] + noise)
        covariance = ahead - np.outer(gain_next, ahead[0])
        if np.allclose(gain_next, gain, rtol=1e-12, atol=1e-15):
            break
        gain = gain_next
    return gain
