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
"""Kalman filter of the wheel speeds, with a model of the velocity drive and its dead time."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import TypedKernel, contiguous, kernel
from t3mpc_ros.parameters.table import Parameters, parameter


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


class FilterState(NamedTuple):
    """State of both wheels, for kernels; shape (2,) each."""

    speeds: Array  # estimated chi at the last measurement, rad/s
    disturbance: Array  # estimated disturbance acceleration, rad/s²
    predicted: Array  # predicted chi when a command sent now takes effect, rad/s


class DriveModel(NamedTuple):
    """Constants of :func:`update_filter`."""

    velocity: bool  # whether the drive takes wheel speeds; else accelerations
    filtered: bool  # whether measured speeds are filtered; else they are the estimate
    speed_gain: float  # stationary Kalman gain of chi
    disturbance_gain: float  # stationary Kalman gain of d, 1/s
    lag: float  # s
    period: float  # nominal time between steps, s
    late: float  # dead time beyond whole periods, as a fraction of a period


class SpeedKalmanFilter:
    """Estimates the wheel speeds and the disturbance acceleration of each wheel.

    Each wheel has two states, speed chi (rad/s) and disturbance acceleration d (rad/s²), a random
    walk. With a torque drive chi' = u + d, u the applied acceleration; with a velocity drive
    chi' = (c - chi)/lag + d, c the command that took effect one dead time after it was sent. The
    gain is the stationary solution of the discrete Riccati equation for the nominal ``period``
    (s), so a step needs a few multiplications only.
    """

    def __init__(self, parameters: SpeedFilterParameters, drive: str, period: float) -> None:
        self.parameters = parameters
        velocity, lag = drive == 'velocity', parameters.lag
        transition = np.array([[1.0, period], [0.0, 1.0]])
        if velocity:
            decay = math.exp(-period / lag)
            transition = np.array([[decay, lag * (1.0 - decay)], [0.0, 1.0]])
        gains = stationary_gain(transition, parameters, period).tolist()
        self.model = DriveModel(velocity, parameters.enabled, gains[0], gains[1], lag, period, 0.0)
        self._commands: Array = np.zeros((2, 2))
        self.set_dead_time(parameters.dead_time)
        self.state = FilterState(*np.zeros((3, 2)))
        self._update = TypedKernel(update_filter)

    @property
    def dead_time(self) -> float:
        """Time between sending a command and its effect, s; 0 with a torque drive."""
        return self._dead_time if self.model.velocity else 0.0

    def set_dead_time(self, dead_time: float) -> None:
        """Use another dead time (s) from the next step on; the estimates are kept."""
        self._dead_time = dead_time
        # Rounded: a dead time of exactly one period must not count as 0.999... periods.
        periods = round(dead_time / self.model.period, 9)
        self.model = self.model._replace(late=periods % 1.0)
        before, count = self._commands, int(periods) + 2
        first = np.repeat(before[:1], max(count - len(before), 0), axis=0)
        self._commands = np.concatenate((first, before))[-count:]

    def reset(self, speeds: Array) -> None:
        """Restart at measured wheel speeds (rad/s) with equal commands and no disturbance."""
        self.state.speeds[:] = self.state.predicted[:] = speeds
        self.state.disturbance[:] = 0.0
        self._commands[:] = speeds

    def update(self, applied: Array, measured: Array, dt: float, *, sent: bool) -> None:
        """Propagate over ``dt`` s, if a command was ``sent``, and correct by a measurement.

        ``applied``: commanded wheel speeds (rad/s) or accelerations (rad/s²); ``measured``: wheel
        speeds, rad/s, NaN without a measurement
        """
        self._update(
            self.state, self._commands, applied, contiguous(measured), sent, dt, self.model
        )


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
        if (np.abs(gain_next - gain) <= 1e-15 + 1e-12 * np.abs(gain)).all():
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

    The older command is active for a fraction ``late`` of that time.
    """
    servo_response(speeds, commands[row], disturbance, math.exp(-late * dt / lag), lag, out)
    decay = math.exp(-(1.0 - late) * dt / lag)
    servo_response(out, commands[row + 1], disturbance, decay, lag, out)


@kernel
def predict_actuation(state: FilterState, commands: Array, model: DriveModel) -> None:
    """Write the wheel speeds at which a command sent now takes effect; commands newest last."""
    out, disturbance = state.predicted, state.disturbance
    late, lag, period = model.late, model.lag, model.period
    whole = commands.shape[0] - 2
    for j in range(whole):
        delayed_servo_response(out, commands, j + 1, late, disturbance, lag, period, out)
    decay = math.exp(-late * period / lag)
    servo_response(out, commands[whole + 1], disturbance, decay, lag, out)


@kernel
def propagate(
    state: FilterState, commands: Array, applied: Array, dt: float, model: DriveModel
) -> None:
    """Propagate the wheel speeds over ``dt`` seconds; a velocity drive appends ``applied``."""
    speeds, disturbance = state.speeds, state.disturbance
    if model.velocity:
        last = commands.shape[0] - 1
        for i in range(speeds.size):
            for j in range(last):
                commands[j, i] = commands[j + 1, i]
            commands[last, i] = applied[i]
        delayed_servo_response(speeds, commands, 0, model.late, disturbance, model.lag, dt, speeds)
    else:
        for i in range(speeds.size):
            speeds[i] += dt * (applied[i] + disturbance[i])


@kernel
def update_filter(
    state: FilterState,
    commands: Array,
    applied: Array,
    measured: Array,
    sent: bool,
    dt: float,
    model: DriveModel,
) -> None:
    """Run a step of the filter; arguments as in :meth:`SpeedKalmanFilter.update`."""
    if sent:
        propagate(state, commands, applied, dt, model)
    for i in range(measured.size):
        if math.isnan(measured[i]):
            pass
        elif model.filtered:
            innovation = measured[i] - state.speeds[i]
            state.speeds[i] += model.speed_gain * innovation
            state.disturbance[i] += model.disturbance_gain * innovation
        else:
            state.speeds[i] = measured[i]
        state.predicted[i] = state.speeds[i]
    if model.velocity:
        predict_actuation(state, commands, model)
