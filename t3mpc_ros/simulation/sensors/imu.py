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
"""Simulated MPU6050: low-pass filter, bias, scale error, noise and counts."""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import parameter
from t3mpc_ros.robot.interface import ImuSample
from t3mpc_ros.robot.sensor_parameters import GRAVITY, IMU_DATA_SHEET, ImuParameters

_LOWEST, _HIGHEST = -32768.0, 32767.0
_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class SimulatedImuParameters(ImuParameters):
    """Bias, drift and scale error of the simulated MPU6050."""

    gyro_offset: float = parameter(
        20.0,
        'bound of the zero-rate offset, which is drawn at each power-up',
        'deg/s',
        (0.0, 250.0),
        dynamic=True,
        source=f'{IMU_DATA_SHEET} 6.1, initial ZRO tolerance',
    )
    gyro_drift: float = parameter(
        0.005,
        'random walk of the bias: standard deviation after one second (0.12 deg/s after ten '
        'minutes)',
        'deg/s/√s',
        (0.0, 10.0),
        dynamic=True,
    )
    gyro_scale_error: float = parameter(
        0.001,
        'bound of the scale error, which is drawn for each sensor; the residual of a calibration '
        'over ten turns read to 3 degrees (data sheet: 0.03 without calibration)',
        bounds=(0.0, 0.5),
        dynamic=True,
    )
    accel_offset: ClassVar[float] = 50.0
    """Bound of the zero-g offset, mg, drawn for each sensor and axis (data sheet 6.2, x and y)."""

    def share(self, step: float) -> float:
        """Return the argument of :func:`low_pass` for steps of ``step`` s: 1 - exp(-p step)."""
        return -math.expm1(-step * self.pole)


@kernel
def low_pass(
    filtered: Array, angular: float, forward: float, sideways: float, share: float
) -> None:
    """Advance the low-pass of three quantities by one step during which they are constant.

    The solution is exact, so one long step equals many short ones: the first stage decays as
    exp(-p step), the second follows it as p step exp(-p step).

    filtered : shape (3, 2), both stages of yaw rate (rad/s), forward and sideways acceleration
        (m/s²); changed in place. Column 1 is the filtered value
    share : 1 - exp(-p step), see SimulatedImuParameters.share
    """
    rest = 1.0 - share
    follow = -rest * math.log(rest) if rest > 0.0 else 0.0
    for row in range(3):
        value = angular if row == 0 else (forward if row == 1 else sideways)
        first = filtered[row, 0] - value
        filtered[row, 1] = value + rest * (filtered[row, 1] - value) + follow * first
        filtered[row, 0] = value + rest * first


class SimulatedImu:
    """Converts filtered motion to the register values of the chip.

    The noise passes the same two poles as the motion, so its low-frequency density is that of
    the data sheet at every setting and rate. The generator is its own: three numbers are drawn
    for the sensor, one at each power-up and seven at each measurement, whatever the
    parameters, which are replaceable at run time.
    """

    def __init__(self, parameters: SimulatedImuParameters, generator: np.random.Generator) -> None:
        self._generator = generator
        self._scale, self._forward, self._sideways = generator.uniform(-1.0, 1.0, 3).tolist()
        self.restart()
        self.parameters = parameters

    @property
    def parameters(self) -> SimulatedImuParameters:
        """The parameters in use."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: SimulatedImuParameters) -> None:
        self._parameters = parameters
        self._dt = -1.0  # the next measurement recomputes its noise model
        root = math.sqrt(parameters.noise_bandwidth)
        # In counts from here on: one multiplication converts to SI units.
        rate, milli = parameters.rate_step, 1e-3 * GRAVITY / parameters.acceleration_step
        self._gain = (1.0 + parameters.gyro_scale_error * self._scale) / rate
        self._rate_noise = parameters.gyro_noise * root * _DEGREE / rate
        self._acceleration_noise = 1e-3 * parameters.accel_noise * root * milli
        self._offsets = (
            parameters.accel_offset * self._forward * milli,
            parameters.accel_offset * self._sideways * milli,
        )
        self._steps = rate, parameters.acceleration_step

    @property
    def bias(self) -> float:
        """True bias of the gyro at the last measurement, rad/s: known only in simulation."""
        offset = self._parameters.gyro_offset * self._offset
        return (offset + self._walk) * _DEGREE + self._jump

    def restart(self) -> None:
        """Power up again: draw a new zero-rate offset and clear the measurement."""
        self._offset: float = self._generator.uniform(-1.0, 1.0)
        self._walk = 0.0  # deg/s
        self._jump = 0.0  # rad/s
        self._noise = (0.0,) * 6
        self.counts = (0, 0, 0)
        """Registers of the last measurement: yaw rate, forward and sideways acceleration."""

    def measure(self, filtered: Array, dt: float, bias_jump: float = 0.0) -> ImuSample:
        """Return the sample measured ``dt`` seconds after the last measurement.

        ``filtered``: see :func:`low_pass`; ``bias_jump`` (rad/s) is a fault.
        """
        if dt != self._dt:
            self._tune(dt)
        walk, n1, n2, n3, n4, n5, n6 = self._generator.standard_normal(7).tolist()
        (_, angular), (_, forward), (_, sideways) = filtered.tolist()
        self._walk += self._walk_step * walk
        self._jump = bias_jump
        keep, follow, own, shared, rest = self._colour
        a, rate_noise, b, forward_noise, c, sideways_noise = self._noise
        rate_noise = keep * rate_noise + follow * a + shared * n1 + rest * n2
        forward_noise = keep * forward_noise + follow * b + shared * n3 + rest * n4
        sideways_noise = keep * sideways_noise + follow * c + shared * n5 + rest * n6
        self._noise = (
            keep * a + own * n1,
            rate_noise,
            keep * b + own * n3,
            forward_noise,
            keep * c + own * n5,
            sideways_noise,
        )
        rate_step, step = self._steps
        noise = self._acceleration_noise
        z = self._gain * angular + self.bias / rate_step + self._rate_noise * rate_noise
        x = forward / step + self._offsets[0] + noise * forward_noise
        y = sideways / step + self._offsets[1] + noise * sideways_noise
        turn = round(min(max(z, _LOWEST), _HIGHEST))
        ahead = round(min(max(x, _LOWEST), _HIGHEST))
        aside = round(min(max(y, _LOWEST), _HIGHEST))
        self.counts = turn, ahead, aside
        return ImuSample(turn * rate_step, ahead * step, aside * step)

    def _tune(self, dt: float) -> None:
        """Set up the transition over ``dt`` seconds of unit-variance noise behind two poles.

        With P = [[2, 1], [1, 1]] the stationary covariance of both stages and F their decay, the
        driving noise has the covariance P - F P F'; it is drawn through its Cholesky factor.
        """
        if not 0.0 <= dt < math.inf:
            raise ValueError(f'dt must be finite and at least 0 s: got {dt}')
        self._dt = dt
        self._walk_step = self._parameters.gyro_drift * math.sqrt(dt)
        turn = self._parameters.pole * dt
        keep = math.exp(-turn)
        follow = turn * keep
        own = math.sqrt(-2.0 * math.expm1(-2.0 * turn))
        shared = (1.0 - keep * (2.0 * follow + keep)) / own if own > 0.0 else 0.0
        left = 1.0 - 2.0 * follow * (follow + keep) - keep * keep - shared * shared
        # Rounding may make it negative when dt is short.
        self._colour = keep, follow, own, shared, math.sqrt(max(left, 0.0))
