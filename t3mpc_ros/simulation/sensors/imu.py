# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated MPU6050: low-pass filter, bias, scale error, noise and counts."""

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.robot.interface import ImuSample

Array = npt.NDArray[np.float64]

GRAVITY = 9.80665
"""m/s² in the g of the data sheet."""

_SHEET = 'PS-MPU-6000A-00 r3.4'
_LSB_PER_DEGREE = {'250': 131.0, '500': 65.5, '1000': 32.8, '2000': 16.4}
_LSB_PER_G = {'2': 16384.0, '4': 8192.0, '8': 4096.0, '16': 2048.0}
_BANDWIDTH = {'0': 256.0, '1': 188.0, '2': 98.0, '3': 42.0, '4': 20.0, '5': 10.0, '6': 5.0}
_LOWEST, _HIGHEST = -32768.0, 32767.0
_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class ImuParameters(Parameters):
    """Registers of the MPU6050, and how far it is from ideal."""

    gyro_range: str = parameter(
        '500',
        'full scale of the gyro, deg/s (FS_SEL); 8 rad/s are 458 deg/s',
        choices=('250', '500', '1000', '2000'),
    )
    accel_range: str = parameter(
        '2', 'full scale of the accelerometer, g (AFS_SEL)', choices=('2', '4', '8', '16')
    )
    low_pass: str = parameter(
        '3',
        'low-pass of both (DLPF_CFG): 256, 188, 98, 42, 20, 10 or 5 Hz',
        choices=('0', '1', '2', '3', '4', '5', '6'),
    )
    gyro_noise: float = parameter(
        0.005,
        'noise density of the gyro',
        unit='deg/s/√Hz',
        low=0.0,
        high=10.0,
        dynamic=True,
        source=f'{_SHEET} 6.1, at 10 Hz',
    )
    accel_noise: float = parameter(
        400.0,
        'noise density of the accelerometer',
        unit='µg/√Hz',
        low=0.0,
        high=1e5,
        dynamic=True,
        source=f'{_SHEET} 6.2, at 10 Hz',
    )
    gyro_offset: float = parameter(
        20.0,
        'zero-rate offset: drawn at each power-up within plus or minus this',
        unit='deg/s',
        low=0.0,
        high=250.0,
        dynamic=True,
        source=f'{_SHEET} 6.1, initial ZRO tolerance',
    )
    gyro_drift: float = parameter(
        0.005,
        'random walk of the bias: its spread after one second (0.12 deg/s after ten minutes)',
        unit='deg/s/√s',
        low=0.0,
        high=10.0,
        dynamic=True,
    )
    gyro_scale_error: float = parameter(
        0.001,
        'scale error: drawn for each sensor within plus or minus this; what a calibration over '
        'ten turns leaves that is read to 3 degrees (data sheet: 0.03 as delivered)',
        low=0.0,
        high=0.5,
        dynamic=True,
    )
    accel_offset: float = parameter(
        50.0,
        'zero-g offset: drawn for each sensor and axis within plus or minus this',
        unit='mg',
        low=0.0,
        high=1000.0,
        dynamic=True,
        source=f'{_SHEET} 6.2, x and y axes',
    )

    @property
    def rate_step(self) -> float:
        """One count of the gyro, rad/s."""
        return _DEGREE / _LSB_PER_DEGREE[self.gyro_range]

    @property
    def acceleration_step(self) -> float:
        """One count of the accelerometer, m/s²."""
        return GRAVITY / _LSB_PER_G[self.accel_range]

    @property
    def pole(self) -> float:
        """Each of the two poles of the low-pass, 1/s."""
        return math.tau * _BANDWIDTH[self.low_pass] / math.sqrt(math.sqrt(2.0) - 1.0)

    @property
    def delay(self) -> float:
        """How far slow signals lag behind, s: 2/p."""
        return 2.0 / self.pole

    @property
    def noise_bandwidth(self) -> float:
        """Hz: noise of density N leaves the low-pass with the variance N² times this, p/8."""
        return self.pole / 8.0

    def share(self, step: float) -> float:
        """Return what :func:`low_pass` needs for steps of ``step`` seconds: 1 - exp(-p step)."""
        return -math.expm1(-step * self.pole)


@kernel
def low_pass(
    filtered: Array, angular: float, forward: float, sideways: float, share: float
) -> None:
    """Move the low-pass of three quantities by one step during which they are constant.

    Exact, so that one long step does what many short ones do: the first stage decays as
    exp(-p step), the second follows it as p step exp(-p step).

    filtered : shape (3, 2), both stages of yaw rate (rad/s), forward and sideways acceleration
        (m/s²); changed in place. Column 1 is what the sensor measures
    share : 1 - exp(-p step), see ImuParameters.share
    """
    rest = 1.0 - share
    follow = -rest * math.log(rest) if rest > 0.0 else 0.0
    for row in range(3):
        value = angular if row == 0 else (forward if row == 1 else sideways)
        first = filtered[row, 0] - value
        filtered[row, 1] = value + rest * (filtered[row, 1] - value) + follow * first
        filtered[row, 0] = value + rest * first


class SimulatedImu:
    """Turns filtered motion into what the chip's registers hold.

    The noise passes the same two poles as the motion: its density at low frequencies is that of
    the data sheet at every setting and rate, not only the spread of single samples.

    Parameters
    ----------
    settings
        Replaceable while running.
    generator
        Used for nothing else. Three numbers are drawn for the sensor, one at each power-up, and
        seven at each measurement, whatever the settings say.
    """

    def __init__(self, parameters: ImuParameters, generator: np.random.Generator) -> None:
        self._generator = generator
        self._scale, self._forward, self._sideways = generator.uniform(-1.0, 1.0, 3).tolist()
        self.restart()
        self.parameters = parameters

    @property
    def parameters(self) -> ImuParameters:
        """The table in force."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: ImuParameters) -> None:
        self._parameters = parameters
        self._dt = -1.0  # so that the next measurement works out its noise anew
        root = math.sqrt(parameters.noise_bandwidth)
        # Everything in counts from here on: one multiplication gets there.
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
        """The true bias of the gyro at the last measurement, rad/s: known only in simulation."""
        offset = self._parameters.gyro_offset * self._offset
        return (offset + self._walk) * _DEGREE + self._jump

    @property
    def counts(self) -> tuple[int, int, int]:
        """Registers of the last measurement: yaw rate, forward and sideways acceleration."""
        return self._counts

    def restart(self) -> None:
        """Power up again: a new zero-rate offset, nothing measured yet."""
        self._offset: float = self._generator.uniform(-1.0, 1.0)
        self._walk = 0.0  # deg/s
        self._jump = 0.0  # rad/s
        self._noise = (0.0,) * 6
        self._counts = (0, 0, 0)

    def measure(self, filtered: Array, dt: float, bias_jump: float = 0.0) -> ImuSample:
        """Return what is measured ``dt`` seconds after the last measurement.

        Parameters
        ----------
        filtered
            See :func:`low_pass`; its second column is measured.
        dt
            s; bias and noise have moved on by that much.
        bias_jump
            rad/s on top of the bias for as long as it is given: a fault.

        Raises
        ------
        ValueError
            ``dt`` is negative or not finite.
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
        self._counts = turn, ahead, aside
        return ImuSample(turn * rate_step, ahead * step, aside * step)

    def _tune(self, dt: float) -> None:
        """Work out how noise of spread 1 behind two poles goes on over ``dt`` seconds.

        With P = [[2, 1], [1, 1]] the covariance of both stages at rest and F their decay, what
        has to be added is P - F P F'; it is drawn through its Cholesky factor.
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
        # Less than rounding can tell when dt is short.
        self._colour = keep, follow, own, shared, math.sqrt(max(left, 0.0))
