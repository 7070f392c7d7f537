# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Kalman filter of the wheel speeds with a model of the velocity drive."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpeedFilterParameters(Parameters):
    """What the filter assumes about the robot and its sensors."""

    enabled: bool = parameter(True, 'whether the law is fed the estimate instead of raw speeds')
    noise_variance: float = parameter(
        0.04,
        'variance of the measured wheel speeds; 0 trusts them fully',
        unit='(rad/s)²',
        low=0.0,
        high=100.0,
        source='paper: noise of the simulations',
    )
    disturbance: float = parameter(
        15.0,
        'how fast the unknown acceleration wanders, as the square root of its spectral density',
        unit='rad/s²/√s',
        low=1e-3,
        high=1e4,
    )
    lag: float = parameter(
        0.02, 'first-order lag of the velocity drive', unit='s', low=0.001, high=1.0
    )
    dead_time: float = parameter(
        0.01, 'dead time of the velocity drive', unit='s', low=0.0, high=0.5
    )


@kernel
def servo_response(
    speeds: Array, command: Array, unexplained: Array, decay: float, lag: float, out: Array
) -> None:
    """Write the speeds (rad/s) that a lagging servo reaches, (2,): exact for constant inputs.

    chi' = (command - chi)/lag + unexplained, over a time t with decay = exp(-t/lag).
    """
    for i in range(speeds.size):
        goal = command[i] + lag * unexplained[i]
        out[i] = goal + decay * (speeds[i] - goal)


@kernel
def delayed_servo_response(
    speeds: Array,
    commands: Array,
    row: int,
    late: float,
    unexplained: Array,
    lag: float,
    dt: float,
    out: Array,
) -> None:
    """Write the speeds after ``dt`` s, the command changing from a row to the next in between.

    late : share of ``dt`` for which the older command, ``commands[row]``, still acts
    """
    servo_response(speeds, commands[row], unexplained, math.exp(-late * dt / lag), lag, out)
    servo_response(
        out, commands[row + 1], unexplained, math.exp(-(1.0 - late) * dt / lag), lag, out
    )


@kernel
def predict_actuation(
    speeds: Array,
    commands: Array,
    unexplained: Array,
    late: float,
    lag: float,
    period: float,
    out: Array,
) -> None:
    """Write the speeds (rad/s) when a command sent now begins to act, shape (2,).

    commands : shape (n + 2, 2), newest last, rad/s; n whole periods of dead time
    late     : what the dead time has beyond them, as a share of a period
    """
    out[:] = speeds
    whole = commands.shape[0] - 2
    for j in range(whole):
        delayed_servo_response(out, commands, j + 1, late, unexplained, lag, period, out)
    servo_response(out, commands[whole + 1], unexplained, math.exp(-late * period / lag), lag, out)


SPEEDS, DISTURBANCE, PREDICTED = range(3)
"""Rows of what the filter knows."""


@kernel
def predict(
    known: Array,
    commands: Array,
    applied: Array,
    dt: float,
    velocity: bool,
    late: float,
    lag: float,
) -> None:
    """Move the speeds ``dt`` seconds on, under what was applied meanwhile.

    known    : shape (3, 2), rows SPEEDS (rad/s), UNEXPLAINED (rad/s²), AHEAD (rad/s)
    commands : shape (n + 2, 2), newest last, rad/s; with a velocity drive ``applied`` joins them
    applied  : shape (2,), rad/s with a velocity drive, rad/s² with a torque drive
    late, lag: as in :func:`look_ahead`
    """
    speeds, unexplained = known[SPEEDS], known[DISTURBANCE]
    if velocity:
        for j in range(commands.shape[0] - 1):
            for i in range(speeds.size):
                commands[j, i] = commands[j + 1, i]
        commands[-1] = applied
        delayed_servo_response(speeds, commands, 0, late, unexplained, lag, dt, speeds)
    else:
        for i in range(speeds.size):
            speeds[i] += dt * (applied[i] + unexplained[i])


@kernel
def correct(
    known: Array,
    commands: Array,
    measured: Array,
    enabled: bool,
    gain: Array,
    velocity: bool,
    late: float,
    lag: float,
    period: float,
) -> None:
    """Take in measured speeds, and foresee those at which the next command begins to act.

    known, commands   : as in :func:`predict`
    measured          : shape (2,), rad/s
    enabled, gain     : whether to filter, and the stationary gain, shape (2,)
    late, lag, period : as in :func:`look_ahead`
    """
    speeds, unexplained, ahead = known[SPEEDS], known[DISTURBANCE], known[PREDICTED]
    for i in range(speeds.size):
        if enabled:
            innovation = measured[i] - speeds[i]
            speeds[i] += gain[0] * innovation
            unexplained[i] += gain[1] * innovation
        else:
            speeds[i] = measured[i]
        ahead[i] = speeds[i]
    if velocity:
        predict_actuation(speeds, commands, unexplained, late, lag, period, ahead)


@kernel
def filter_step(
    known: Array,
    commands: Array,
    applied: Array,
    measured: Array,
    sent: bool,
    dt: float,
    enabled: bool,
    gain: Array,
    velocity: bool,
    late: float,
    lag: float,
    period: float,
) -> None:
    """Do :func:`predict`, when something was ``sent``, and :func:`correct` in one call."""
    if sent:
        predict(known, commands, applied, dt, velocity, late, lag)
    correct(known, commands, measured, enabled, gain, velocity, late, lag, period)


class SpeedKalmanFilter:
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

    def __init__(self, parameters: SpeedFilterParameters, drive: str, period: float) -> None:
        if drive not in ('velocity', 'torque'):
            raise ValueError(f"drive must be 'velocity' or 'torque': got {drive!r}")
        self._parameters = parameters
        self._velocity = drive == 'velocity'
        self._period = period
        self._gain = stationary_gain(self._transition(period), parameters, period)
        # Rounded, or a dead time of exactly one period may count as 0.999... periods.
        periods = round(parameters.dead_time / period, 9)
        self._late = periods % 1.0
        self._commands: Array = np.zeros((int(periods) + 2, 2))
        self.known: Array = np.zeros((3, 2))
        """All that is estimated, rows SPEEDS, UNEXPLAINED and AHEAD."""

    # Made when asked for: a deep copy of views would no longer be views of the copied array.
    @property
    def speeds(self) -> Array:
        """Estimated wheel speeds, rad/s, shape (2,)."""
        row: Array = self.known[SPEEDS]
        return row

    @property
    def unexplained(self) -> Array:
        """Estimated acceleration that the model does not explain, rad/s², shape (2,)."""
        row: Array = self.known[DISTURBANCE]
        return row

    @property
    def ahead(self) -> Array:
        """Estimated wheel speeds when what is commanded now begins to act, rad/s, (2,)."""
        row: Array = self.known[PREDICTED]
        return row

    @property
    def tables(self) -> tuple[Array, Array, bool, Array, bool, float, float, float]:
        """What :func:`observe` reads and writes beside its inputs, in its order."""
        how, velocity = self._parameters, self._velocity
        filtered = self.known, self._commands, how.enabled, self._gain
        return *filtered, velocity, self._late, how.lag, self._period

    @property
    def gain(self) -> Array:
        """Stationary Kalman gain: share of the innovation given to chi (1) and to d (1/s)."""
        return self._gain

    @property
    def dead_time(self) -> float:
        """Time before a command acts, s; none with a torque drive."""
        return self._parameters.dead_time if self._velocity else 0.0

    def reset(self, speeds: Array) -> None:
        """Start again from measured wheel speeds (rad/s), at rest relative to the command."""
        self.known[:] = speeds
        self.known[DISTURBANCE] = 0.0
        self._commands[:] = speeds

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
        how = self._parameters
        predict(self.known, self._commands, applied, dt, self._velocity, self._late, how.lag)

    def correct(self, measured: Array) -> Array:
        """Return the estimate after seeing measured wheel speeds (rad/s), shape (2,)."""
        self.observe(self.speeds, measured, self._period, sent=False)
        return self.speeds

    def observe(self, applied: Array, measured: Array, dt: float, *, sent: bool) -> None:
        """Do :meth:`predict`, when something was ``sent``, and :meth:`correct`."""
        filter_step(
            self.known,
            self._commands,
            applied,
            measured,
            sent,
            dt,
            self._parameters.enabled,
            self._gain,
            self._velocity,
            self._late,
            self._parameters.lag,
            self._period,
        )

    def _transition(self, period: float) -> Array:
        if not self._velocity:
            return np.array([[1.0, period], [0.0, 1.0]])
        decay = math.exp(-period / self._parameters.lag)
        return np.array([[decay, self._parameters.lag * (1.0 - decay)], [0.0, 1.0]])


def stationary_gain(transition: Array, parameters: SpeedFilterParameters, period: float) -> Array:
    """Return the Kalman gain (2,) that the discrete Riccati recursion settles at.

    The disturbance enters as a random walk of the unexplained acceleration with variance
    ``disturbance² * period`` a step. A variance of zero gives the gain (1, finite).
    """
    process = np.array([[0.0, 0.0], [0.0, parameters.disturbance**2 * period]])
    noise = max(parameters.noise_variance, 1e-9)
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
