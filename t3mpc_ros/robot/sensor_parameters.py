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
"""Parameters of IMU, range sensors and battery by their data sheets, and the byte of a distance.

The driver of the real robot and the simulation share them; the errors of the sensors are
parameters of the simulation alone (:mod:`t3mpc_ros.simulation.sensors`). Figures of the MPU6050
are those of InvenSense's product specification PS-MPU-6000A-00 (revision 3.4) and its register
map RM-MPU-6000A-00, those of the GP2Y0A21YK0F those of Sharp's data sheet E4-A00201EN.
"""

from dataclasses import dataclass
import math
from typing import ClassVar

from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

# -- IMU ------------------------------------------------------------------------------------------

GRAVITY = 9.80665  # m/s² per g of the data sheet
IMU_DATA_SHEET = 'PS-MPU-6000A-00 r3.4'
_LSB_PER_DEGREE = {'250': 131.0, '500': 65.5, '1000': 32.8, '2000': 16.4}
_LSB_PER_G = {'2': 16384.0, '4': 8192.0, '8': 4096.0, '16': 2048.0}
_BANDWIDTH = {'0': 256.0, '1': 188.0, '2': 98.0, '3': 42.0, '4': 20.0, '5': 10.0, '6': 5.0}
_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class ImuParameters(Parameters):
    r"""Registers and noise density of the MPU6050.

    The digital low-pass is modelled by two equal real poles,

    .. math:: H(s) = \left(\frac{p}{s + p}\right)^2, \qquad
              p = \frac{2 \pi f}{\sqrt{\sqrt{2} - 1}},

    so that :math:`f` is its -3 dB frequency. It delays slow signals by 2/p:

    =========  ===  ====  ====  ====  ====  ====  ====
    DLPF_CFG     0     1     2     3     4     5     6
    =========  ===  ====  ====  ====  ====  ====  ====
    gyro, Hz   256   188    98    42    20    10     5
    sheet, ms  0.98  1.9   2.8   4.8   8.3  13.4  18.6
    model, ms  0.80  1.09  2.09  4.88  10.2  20.5  41.0
    =========  ===  ====  ====  ====  ====  ====  ====

    No two real poles reach both figures at the low end. The accelerometer's frequencies (260,
    184, 94, 44, 21, 10, 5 Hz) are within 5 % of these, and are taken as the same.
    """

    gyro_range: str = parameter(
        '500',
        'full scale of the gyro, deg/s (FS_SEL); 8 rad/s are 458 deg/s',
        choices=('250', '500', '1000', '2000'),
    )
    accel_range: ClassVar[str] = '2'
    """Full scale of the accelerometer, g (AFS_SEL), as the firmware sets it."""
    low_pass: str = parameter(
        '3',
        'low-pass of gyro and accelerometer (DLPF_CFG): 256, 188, 98, 42, 20, 10 or 5 Hz',
        choices=('0', '1', '2', '3', '4', '5', '6'),
    )
    gyro_noise: float = parameter(
        0.005,
        'noise density of the gyro',
        'deg/s/√Hz',
        (0.0, 10.0),
        dynamic=True,
        source=f'{IMU_DATA_SHEET} 6.1, at 10 Hz',
    )
    accel_noise: ClassVar[float] = 400.0
    """Noise density of the accelerometer, µg/√Hz (data sheet 6.2, at 10 Hz)."""

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
        """Delay of slow signals, s: 2/p."""
        return 2.0 / self.pole

    @property
    def noise_bandwidth(self) -> float:
        """Hz: noise of density N leaves the low-pass with the variance N² times this, p/8."""
        return self.pole / 8.0


# -- range sensors --------------------------------------------------------------------------------

CODE_STEP = 0.005  # m per step of the range code in a radio frame
NOT_MEASURED, TOO_NEAR, BEYOND, FAULT = 0, 1, 254, 255  # range codes that are not a distance


@dataclass(frozen=True)
class RangeSensorParameters(Parameters):
    """Type, measuring range, beam and mounting of the range sensors."""

    type: ClassVar[str] = 'GP2Y0A21YK0F'  # the sensors whose voltages the board converts
    minimum: ClassVar[float] = 0.10
    """Smallest distance, m (Sharp E4-A00201EN); the board reports anything nearer as too near."""
    maximum: ClassVar[float] = 0.80
    """Largest distance, m (same data sheet); the board reports anything farther as no object."""
    field_of_view: ClassVar[float] = 0.1
    """Opening angle of the beam, rad, assumed: the data sheet does not give it."""

    half_length: float = parameter(
        0.10, 'distance from the axle to the front and rear sensor faces', 'm', (0.01, 1.0)
    )
    half_width: float = parameter(
        0.09, 'distance from the centre line to the side sensor faces', 'm', (0.01, 1.0)
    )
    offset: float = parameter(
        0.05, 'distance of the two sensors of a side from the middle of that side', 'm', (0.0, 1.0)
    )

    def check_consistency(self) -> None:
        """Raise ParameterError when a sensor is mounted beyond the body."""
        side = min(self.half_length, self.half_width)
        if self.offset > side:
            raise ParameterError(
                f'offset must be at most half_length and half_width ({side:g} m): '
                f'got {self.offset:g}'
            )


def encode_range(distance: float) -> int:
    """Return the range code (a byte) of a reading (m, REP 117) in steps of half a centimetre.

    NaN is 0, -inf is 1, inf is 254. The code of a faulty sensor, 255, has no reading.
    """
    steps = distance / CODE_STEP
    if TOO_NEAR < steps < BEYOND:
        return round(steps)
    if math.isnan(steps):
        return NOT_MEASURED
    return BEYOND if steps >= BEYOND else TOO_NEAR


def decode_range(code: int) -> float:
    """Return the reading (m, REP 117) of a range code, a byte; NaN: not measured, or a fault."""
    if not 0 <= code <= 255:
        raise ValueError(f'code must be from 0 to 255: got {code}')
    if code in (NOT_MEASURED, FAULT):
        return math.nan
    if code in (TOO_NEAR, BEYOND):
        return math.inf if code == BEYOND else -math.inf
    return CODE_STEP * code


# -- battery --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BatteryParameters(Parameters):
    """Cells and capacity of the battery."""

    cells: int = parameter(3, 'number of Li-ion cells in series', bounds=(1, 12))
    capacity: float = parameter(2.2, 'charge of the full battery', 'Ah', (0.01, 100.0))
