# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Kalman filter of the wheel speeds, with a model of the velocity drive and its dead time."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpeedFilterParameters(Parameters):
    """Noise model of the sensors, and time constants of the velocity drive."""

    enabled: bool = parameter(
        True, 'whether the law uses the filtered wheel speeds; false: the measured ones'
    )
    noise_variance: float = parameter(
        0.04,
        'variance of the measured wheel speeds; 0: the measurement is exact',
        '(rad/s)²',
        (0.0, 100.0),
        source='paper: noise of the simulations',
    )
    disturbance: float = parameter(
        15.0,
        'square root of the spectral density of the random walk of the disturbance acceleration',
        'rad/s²/√s',
        (1e-3, 1e4),
    )
    lag: float = parameter(0.02, 'first-order lag of the velocity drive', 's', (0.001, 1.0))
    dead_time: float = parameter(0.01, 'dead time of the velocity drive', 's', (0.0, 0.5))


SPEEDS, DISTURBANCE, PREDICTED = range(3)
"""Rows of the filter state: wheel speeds, disturbance acceleration, and wheel speeds at the
instant at which the next command takes effect."""


class SpeedKalmanFilter:
    """Estimates the wheel speeds and the disturbance acceleration of each wheel.

    Each wheel has two states, speed chi (rad/s) and disturbance acceleration d (rad/s²), a random
    walk. With a torque drive chi' = u + d, u the applied acceleration; with a velocity drive
    chi' = (c - chi)/lag + d, c the command that took effect one dead time after it was sent. The
    gain is the stationary solution of the discrete Riccati equation for the nominal period, so a
    step needs a few multiplications only.

    Parameters
    ----------
    parameters
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
        self._commands: Array = np.zeros((2, 2))
        self.set_dead_time(parameters.dead_time)
        self.state: Array = np.zeros((3, 2))
        """Rows SPEEDS, DISTURBANCE and PREDICTED."""

    # Properties, not stored views: after a deep copy stored views would not share memory with
    # the copied state.
    @property
    def speeds(self) -> Array:
        """Estimated wheel speeds, rad/s, shape (2,)."""
        row: Array = self.state[SPEEDS]
        return row

    @property
    def disturbance(self) -> Array:
        """Estimated disturbance acceleration, rad/s², shape (2,)."""
        row: Array = self.state[DISTURBANCE]
        return row

    @property
    def predicted(self) -> Array:
        """Predicted wheel speeds when a command sent now takes effect, rad/s, shape (2,)."""
        row: Array = self.state[PREDICTED]
        return row

    @property
    def parameters(self) -> SpeedFilterParameters:
        """Noise model, lag and configured dead time."""
        return self._parameters

    @property
    def gain(self) -> Array:
        """Stationary Kalman gain of chi (1) and of d (1/s)."""
        return self._gain

    @property
    def dead_time(self) -> float:
        """Time between sending a command and its effect, s; 0 with a torque drive."""
        return self._dead_time if self._velocity else 0.0

    def set_dead_time(self, dead_time: float) -> None:
        """Use another dead time (s) from the next step on; the estimates are kept."""
        self._dead_time = dead_time
        # Rounded: a dead time of exactly one period must not count as 0.999... periods.
        periods = round(dead_time / self._period, 9)
        self._late = periods % 1.0
        before, count = self._commands, int(periods) + 2
        first = np.repeat(before[:1], max(count - len(before), 0), axis=0)
        self._commands = np.concatenate((first, before))[-count:]

    def reset(self, speeds: Array) -> None:
        """Restart at measured wheel speeds (rad/s) with equal commands and no disturbance."""
        self.state[:] = speeds
        self.state[DISTURBANCE] = 0.0
        self._commands[:] = speeds

    def predict(self, applied: Array, dt: float) -> None:
        """Propagate the state over ``dt`` seconds.

        Parameters
        ----------
        applied
            Commanded wheel speeds (rad/s) of a velocity drive, or accelerations (rad/s²) of a
            torque drive, shape (2,).
        dt
            Time since the last step, s.
        """
        lag = self._parameters.lag
        predict(self.state, self._commands, applied, dt, self._velocity, self._late, lag)

    def correct(self, measured: Array) -> Array:
        """Return the estimate (rad/s) corrected by measured wheel speeds (rad/s), shape (2,)."""
        self.update(self.speeds, measured, self._period, sent=False)
        return self.speeds

    def update(self, applied: Array, measured: Array, dt: float, *, sent: bool) -> None:
        """Run :meth:`predict`, if a command was ``sent``, and :meth:`correct`."""
        update_filter(
            self.state,
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
    """Return the Kalman gain, shape (2,), at which the discrete Riccati recursion converges.

    The disturbance acceleration is a random walk with variance ``disturbance² * period`` per
    step. A noise variance of zero gives the gain (1, finite).
    """
    process = np.array([[0.0, 0.0], [0.0, parameters.disturbance**2 * period]])
    noise = max(parameters.noise_variance, 1e-9)
    covariance = np.eye(2) * noise
    gain = np.zeros(2)
    for _ in range(100_000):
        predicted = transition @ covariance @ transition.T + process
        gain_next = predicted[:, 0] / (predicted[0, 0] + noise)
        covariance = predicted - np.outer(gain_next, predicted[0])
        if np.allclose(gain_next, gain, rtol=1e-12, atol=1e-15):
            break
        gain = gain_next
    return gain


@kernel
def servo_response(
    speeds: Array, command: Array, disturbance: Array, decay: float, lag: float, out: Array
) -> None:
    """Write the wheel speeds (rad/s) after a constant command, shape (2,): the exact solution.

    chi' = (command - chi)/lag + disturbance, over a time t with decay = exp(-t/lag).
    """
    for i in range(speeds.size):
        goal = command[i] + lag * disturbance[i]
        out[i] = goal + decay * (speeds[i] - goal)


@kernel
def delayed_servo_response(
    speeds: Array,
    commands: Array,
    row: int,
    late: float,
    disturbance: Array,
    lag: float,
    dt: float,
    out: Array,
) -> None:
    """Write the wheel speeds after ``dt`` s in which the command changes from a row to the next.

    late : fraction of ``dt`` during which the older command, ``commands[row]``, is active
    """
    servo_response(speeds, commands[row], disturbance, math.exp(-late * dt / lag), lag, out)
    decay = math.exp(-(1.0 - late) * dt / lag)
    servo_response(out, commands[row + 1], disturbance, decay, lag, out)


@kernel
def predict_actuation(
    speeds: Array,
    commands: Array,
    disturbance: Array,
    late: float,
    lag: float,
    period: float,
    out: Array,
) -> None:
    """Write the wheel speeds (rad/s) at which a command sent now takes effect, shape (2,).

    commands : shape (n + 2, 2), newest last, rad/s; n whole periods of dead time
    late     : the remaining dead time, as a fraction of a period
    """
    for i in range(speeds.size):
        out[i] = speeds[i]
    whole = commands.shape[0] - 2
    for j in range(whole):
        delayed_servo_response(out, commands, j + 1, late, disturbance, lag, period, out)
    decay = math.exp(-late * period / lag)
    servo_response(out, commands[whole + 1], disturbance, decay, lag, out)


@kernel
def predict(
    state: Array,
    commands: Array,
    applied: Array,
    dt: float,
    velocity: bool,
    late: float,
    lag: float,
) -> None:
    """Propagate the wheel speeds over ``dt`` seconds.

    state    : shape (3, 2), rows SPEEDS (rad/s), DISTURBANCE (rad/s²), PREDICTED (rad/s)
    commands : shape (n + 2, 2), newest last, rad/s; a velocity drive appends ``applied``
    applied  : shape (2,), rad/s with a velocity drive, rad/s² with a torque drive
    late, lag: as in :func:`predict_actuation`
    """
    speeds, disturbance = state[SPEEDS], state[DISTURBANCE]
    if velocity:
        last = commands.shape[0] - 1
        for i in range(speeds.size):
            for j in range(last):
                commands[j, i] = commands[j + 1, i]
            commands[last, i] = applied[i]
        delayed_servo_response(speeds, commands, 0, late, disturbance, lag, dt, speeds)
    else:
        for i in range(speeds.size):
            speeds[i] += dt * (applied[i] + disturbance[i])


@kernel
def correct(
    state: Array,
    commands: Array,
    measured: Array,
    enabled: bool,
    gain: Array,
    velocity: bool,
    late: float,
    lag: float,
    period: float,
) -> None:
    """Correct the state by measured speeds, and predict the speeds at the next command's effect.

    state, commands   : as in :func:`predict`
    measured          : shape (2,), rad/s
    enabled, gain     : whether to filter, and the stationary gain, shape (2,)
    late, lag, period : as in :func:`predict_actuation`
    """
    speeds, disturbance, predicted = state[SPEEDS], state[DISTURBANCE], state[PREDICTED]
    for i in range(speeds.size):
        if enabled:
            innovation = measured[i] - speeds[i]
            speeds[i] += gain[0] * innovation
            disturbance[i] += gain[1] * innovation
        else:
            speeds[i] = measured[i]
        predicted[i] = speeds[i]
    if velocity:
        predict_actuation(speeds, commands, disturbance, late, lag, period, predicted)


@kernel
def update_filter(
    state: Array,
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
    """Run :func:`predict`, if a command was ``sent``, and :func:`correct` in one call."""
    if sent:
        predict(state, commands, applied, dt, velocity, late, lag)
    correct(state, commands, measured, enabled, gain, velocity, late, lag, period)
