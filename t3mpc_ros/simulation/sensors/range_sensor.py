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
r"""Simulated Sharp GP2Y0A21YK0F range sensors and their analogue-to-digital conversion.

Figures are those of Sharp's data sheet E4-A00201EN (1 December 2006). Its figure 2 is matched
within 2 % from 1 to 80 cm by

.. math:: V(d) = \left(\frac{a}{d + k} + c\right)
                 \left(1 + (w/d)^{p n}\right)^{-1/n}:

triangulation (the spot moves on the detector as the inverse of the distance), times a factor that
dominates nearer than w, where the spot leaves the detector. There the voltage *falls* again, from
3.2 V at 5.7 cm to zero at contact, which the board cannot detect: it reads 13 cm for 3 cm, 23 cm
for 2 cm, and no object for contact. From 3.6 to 10 cm it reads "too near".
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.parameters.table import parameter
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters, decode_range, encode_range

# Least squares through figure 2, in relative errors.
_SLOPE, _SHIFT, _FLOOR = 0.282, 0.0257, 0.061  # V m, m, V: from 10 to 80 cm
NOT_CONVERTED = 0xFFFF  # in place of a count of the converter
_EDGE, _POWER, _SHARPNESS = 0.0558, 1.63, 7.0  # m, 1, 1: from 1 to 8 cm


@dataclass(frozen=True)
class SimulatedRangeSensorParameters(RangeSensorParameters):
    """Timing and errors of the simulated range sensors; converter of the board."""

    update_period: ClassVar[float] = 0.0383
    """Mean time of a measurement, s (data sheet, figure 1); the sensors are not synchronised."""
    period_spread: ClassVar[float] = 0.0096
    """Largest deviation of the period of a sensor from the mean, s (data sheet, figure 1)."""
    voltage_noise: float = parameter(
        0.01, 'standard deviation of the converted voltage', 'V', (0.0, 1.0), dynamic=True
    )
    voltage_offset: float = parameter(
        0.01,
        'bound of the voltage offset, which is drawn for each sensor; the residual of a '
        'calibration (data sheet: 0.15 V at 80 cm without calibration)',
        'V',
        (0.0, 0.5),
        dynamic=True,
    )
    adc_bits: ClassVar[int] = 10  # resolution of the converter of an ATmega
    adc_reference: ClassVar[float] = 5.0  # full-scale voltage of the converter, V: its supply

    @property
    def adc_steps(self) -> int:
        """Number of steps of the converter."""
        return 1 << self.adc_bits

    def count(self, volts: float) -> int:
        """Return the count of the converter for a voltage."""
        steps = self.adc_steps
        return min(max(int(volts * steps / self.adc_reference), 0), steps - 1)

    def volts(self, count: int) -> float:
        """Return the voltage in the middle of the step of a count."""
        return (count + 0.5) * self.adc_reference / self.adc_steps


def output_voltage(true_distance: float) -> float:
    """Return the typical output (V) for white paper at a distance (m) from the sensor's face.

    Infinity means no object; zero and below is contact.
    """
    if true_distance <= 0.0:
        return 0.0
    ratio = true_distance / _EDGE
    # The same formula, inverted nearer than the edge so that no power overflows.
    rise = 1.0 if ratio >= 1.0 else float(ratio**_POWER)
    small = 1.0 / ratio if ratio >= 1.0 else ratio
    rise *= float((1.0 + small ** (_POWER * _SHARPNESS)) ** (-1.0 / _SHARPNESS))
    return rise * (_SLOPE / (true_distance + _SHIFT) + _FLOOR)


def distance_from_voltage(volts: float, minimum: float = 0.10, maximum: float = 0.80) -> float:
    """Return the distance (m, REP 117) that the board computes from a voltage.

    Above the voltage of ``minimum`` it is -inf, too near: the far branch is never extrapolated.
    Below that of ``maximum`` it is inf. The board does not know the near branch.
    """
    if volts <= _FLOOR:
        return math.inf
    found = _SLOPE / (volts - _FLOOR) - _SHIFT
    if found < minimum:
        return -math.inf
    return found if found <= maximum else math.inf


_READINGS = tuple(map(decode_range, range(256)))


class SimulatedRangeSensors:
    """Timing and last reading of each of the eight sensors.

    The generator is their own: 24 numbers at the start, one at each measurement. Parameters
    are replaceable at run time; the periods stay as drawn.
    """

    def __init__(
        self, parameters: SimulatedRangeSensorParameters, generator: np.random.Generator
    ) -> None:
        self._generator = generator
        self.parameters = parameters
        periods, phases, self._offsets = generator.uniform(
            -1.0, 1.0, (3, len(RANGE_SENSORS))
        ).tolist()
        self._periods = [
            parameters.update_period + parameters.period_spread * drawn for drawn in periods
        ]
        self._left = [
            0.5 * (1.0 + drawn) * period
            for drawn, period in zip(phases, self._periods, strict=True)
        ]
        self._readings = [math.nan] * len(RANGE_SENSORS)
        self._counts = [NOT_CONVERTED] * len(RANGE_SENSORS)

    @property
    def parameters(self) -> SimulatedRangeSensorParameters:
        """The parameters in use."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: SimulatedRangeSensorParameters) -> None:
        self._parameters = parameters
        lowest, highest = parameters.minimum, parameters.maximum
        self._table = [
            _READINGS[
                encode_range(distance_from_voltage(parameters.volts(count), lowest, highest))
            ]
            for count in range(parameters.adc_steps)
        ]
        """Reading (m) of the board for every count of its converter."""

    @property
    def periods(self) -> tuple[float, ...]:
        """Measurement period of each sensor, s."""
        return tuple(self._periods)

    @property
    def readings(self) -> tuple[float, ...]:
        """Last readings, m, rounded as in a radio frame (REP 117); NaN before the first."""
        return tuple(self._readings)

    @property
    def counts(self) -> tuple[int, ...]:
        """Counts of the converter at the last measurements; NOT_CONVERTED before the first."""
        return tuple(self._counts)

    def due(self, elapsed: float) -> Sequence[int]:
        """Return the sensors that finished a measurement within the last ``elapsed`` seconds.

        ``elapsed`` is the time since the last call. Each sensor is listed at most once.
        """
        finished = []
        left = self._left
        for index, period in enumerate(self._periods):
            remaining = left[index] - elapsed
            if remaining <= 0.0:
                finished.append(index)
                remaining = period - (-remaining) % period
            left[index] = remaining
        return finished

    def measure(self, index: int, true_distance: float) -> None:
        """Store the reading of sensor ``index`` with an object at ``true_distance``.

        The distance (m) is from the sensor's face; infinity means no object.
        """
        parameters = self._parameters
        volts = output_voltage(true_distance) + parameters.voltage_offset * self._offsets[index]
        volts += parameters.voltage_noise * self._generator.standard_normal()
        self._counts[index] = count = parameters.count(volts)
        self._readings[index] = self._table[count]
