# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated Sharp GP2Y0A21YK0F range sensors and their analogue-to-digital conversion."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter
from t3mpc_ros.robot.interface import RANGE_SENSORS

Array = npt.NDArray[np.float64]

CODE_STEP = 0.005
"""m in one step of the code that the radio carries."""
NOT_MEASURED, TOO_NEAR, BEYOND, FAULT = 0, 1, 254, 255
"""Codes that are no distance."""

_SHEET = 'Sharp E4-A00201EN'
# Least squares through figure 2, in relative errors.
_SLOPE, _SHIFT, _FLOOR = 0.282, 0.0257, 0.061  # V m, m, V: from 10 to 80 cm
_EDGE, _POWER, _SHARPNESS = 0.0558, 1.63, 7.0  # m, 1, 1: from 1 to 8 cm


@dataclass(frozen=True)
class RangeSensorParameters(Parameters):
    """The distance sensors, their mounting, and the converter behind them."""

    type: str = parameter(
        'GP2Y0A21YK0F', 'the sensor that is mounted', choices=('GP2Y0A21YK0F',), source=_SHEET
    )
    minimum: float = parameter(
        0.10,
        'nearer than this the board says too near',
        unit='m',
        low=0.07,
        high=0.5,
        source=f'{_SHEET}, distance measuring range',
    )
    maximum: float = parameter(
        0.80,
        'farther than this the board says nothing there',
        unit='m',
        low=0.2,
        high=1.2,
        source=f'{_SHEET}, distance measuring range',
    )
    update_period: float = parameter(
        0.0383,
        'mean time of a measurement; sensors are not synchronised',
        unit='s',
        low=0.001,
        high=1.0,
        source=f'{_SHEET}, figure 1',
    )
    period_spread: float = parameter(
        0.0096,
        'the period of each sensor lies within plus or minus this',
        unit='s',
        low=0.0,
        high=0.5,
        source=f'{_SHEET}, figure 1',
    )
    voltage_noise: float = parameter(
        0.01, 'spread of the voltage that is converted', unit='V', low=0.0, high=1.0, dynamic=True
    )
    voltage_offset: float = parameter(
        0.01,
        'offset of each sensor, drawn within plus or minus this: what calibration leaves '
        '(data sheet: 0.15 V at 80 cm as delivered)',
        unit='V',
        low=0.0,
        high=0.5,
        dynamic=True,
    )
    adc_bits: int = parameter(
        10, 'resolution of the converter', unit='bit', low=6, high=16, source='ATmega: 10 bit'
    )
    adc_reference: float = parameter(
        5.0, 'voltage the converter reaches its end at', unit='V', low=1.0, high=10.0
    )
    field_of_view: float = parameter(
        0.1,
        'opening of the beam, which the data sheet does not give',
        unit='rad',
        low=0.0,
        high=1.0,
    )
    half_length: float = parameter(
        0.10, 'from the axle to the faces in front and behind', unit='m', low=0.01, high=1.0
    )
    half_width: float = parameter(
        0.09, 'from the middle line to the faces at the sides', unit='m', low=0.01, high=1.0
    )
    offset: float = parameter(
        0.05, 'of the two on each side from the middle of that side', unit='m', low=0.0, high=1.0
    )

    def check_consistency(self) -> None:
        """Raise ParameterError when bounds cross, or sensors would hang in the air."""
        if self.maximum <= self.minimum:
            raise ParameterError(
                f'maximum must be more than minimum ({self.minimum:g} m): got {self.maximum:g}'
            )
        if self.period_spread >= self.update_period:
            raise ParameterError(
                f'period_spread must be less than update_period ({self.update_period:g} s): '
                f'got {self.period_spread:g}'
            )
        side = min(self.half_length, self.half_width)
        if self.offset > side:
            raise ParameterError(
                f'offset must be at most half_length and half_width ({side:g} m): '
                f'got {self.offset:g}'
            )

    @property
    def adc_steps(self) -> int:
        """How many steps the converter has."""
        return 1 << self.adc_bits

    def count(self, volts: float) -> int:
        """Return what the converter makes of a voltage."""
        steps = self.adc_steps
        return min(max(int(volts * steps / self.adc_reference), 0), steps - 1)

    def volts(self, count: int) -> float:
        """Return the voltage the board believes in: the middle of the converter's step."""
        return (count + 0.5) * self.adc_reference / self.adc_steps


def output_voltage(true_distance: float) -> float:
    """Return the typical output (V) for white paper at a distance (m) from the sensor's face.

    Inf is nothing there; zero and less is contact.
    """
    if true_distance <= 0.0:
        return 0.0
    ratio = true_distance / _EDGE
    # What the formula says, turned round nearer than the edge so that no power overflows.
    rise = 1.0 if ratio >= 1.0 else float(ratio**_POWER)
    small = 1.0 / ratio if ratio >= 1.0 else ratio
    rise *= float((1.0 + small ** (_POWER * _SHARPNESS)) ** (-1.0 / _SHARPNESS))
    return rise * (_SLOPE / (true_distance + _SHIFT) + _FLOOR)


def distance_from_voltage(volts: float, minimum: float = 0.10, maximum: float = 0.80) -> float:
    """Return the distance (m) the board makes of a voltage; REP 117 beyond what it can tell.

    Above the voltage of ``minimum`` it is -inf, too near: the far branch is never extrapolated.
    Below that of ``maximum`` it is inf. The near branch is out of the board's sight.
    """
    if volts <= _FLOOR:
        return math.inf
    found = _SLOPE / (volts - _FLOOR) - _SHIFT
    if found < minimum:
        return -math.inf
    return found if found <= maximum else math.inf


def encode_range(distance_reading: float) -> int:
    """Return the byte that stands for a reading (m, REP 117) on the radio: half centimetres.

    NaN is 0, -inf is 1, inf is 254. A fault, 255, is for whoever knows of one.
    """
    steps = distance_reading / CODE_STEP
    if TOO_NEAR < steps < BEYOND:
        return round(steps)
    if math.isnan(steps):
        return NOT_MEASURED
    return BEYOND if steps >= BEYOND else TOO_NEAR


def decode_range(code: int) -> float:
    """Return the reading (m, REP 117) a byte stands for; a fault is NaN, as not measured is.

    Raises
    ------
    ValueError
        It is no byte.
    """
    if not 0 <= code <= 255:
        raise ValueError(f'code must be from 0 to 255: got {code}')
    if code in (NOT_MEASURED, FAULT):
        return math.nan
    if code in (TOO_NEAR, BEYOND):
        return math.inf if code == BEYOND else -math.inf
    return CODE_STEP * code


_READINGS = tuple(map(decode_range, range(256)))


def sensor_mounts(parameters: RangeSensorParameters) -> Array:
    """Return x, y (m) and direction (rad) of each sensor's face in the body frame, shape (8, 3).

    x is forward and y to the left of the middle of the axle; in the order of RANGE_SENSORS.
    """
    ahead, aside, offset = parameters.half_length, parameters.half_width, parameters.offset
    quarter = 0.5 * math.pi
    return np.array(
        [
            [ahead, offset, 0.0],
            [ahead, -offset, 0.0],
            [offset, aside, quarter],
            [-offset, aside, quarter],
            [-ahead, offset, math.pi],
            [-ahead, -offset, math.pi],
            [offset, -aside, -quarter],
            [-offset, -aside, -quarter],
        ]
    )


class SimulatedRangeSensors:
    """Keeps when each of the eight sensors measures, and what the board last read of it.

    Parameters
    ----------
    settings
        Replaceable while running; periods stay as they were drawn.
    generator
        Used for nothing else: 24 numbers at the start, one at each measurement.
    """

    def __init__(self, parameters: RangeSensorParameters, generator: np.random.Generator) -> None:
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

    @property
    def parameters(self) -> RangeSensorParameters:
        """The table in use."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: RangeSensorParameters) -> None:
        self._parameters = parameters
        self._table = self._read_all()

    @property
    def periods(self) -> tuple[float, ...]:
        """How long each sensor takes for a measurement, s."""
        return tuple(self._periods)

    @property
    def readings(self) -> tuple[float, ...]:
        """m, as the radio tells them (half centimetres, REP 117); NaN until first measured."""
        return tuple(self._readings)

    def due(self, elapsed: float) -> Sequence[int]:
        """Return the sensors that have finished a measurement within the last ``elapsed`` seconds.

        ``elapsed`` is the time since the last call. Each is named once, however long that is.
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
        """Keep what the board reads of sensor ``index`` when something is at ``true_distance``.

        The distance (m) is from the sensor's face; inf is nothing there.
        """
        parameters = self._parameters
        volts = output_voltage(true_distance) + parameters.voltage_offset * self._offsets[index]
        volts += parameters.voltage_noise * self._generator.standard_normal()
        self._readings[index] = self._table[parameters.count(volts)]

    def _read_all(self) -> list[float]:
        """Return what the board reads (m) at every count of its converter."""
        parameters = self._parameters
        lowest, highest = parameters.minimum, parameters.maximum
        return [
            _READINGS[
                encode_range(distance_from_voltage(parameters.volts(count), lowest, highest))
            ]
            for count in range(parameters.adc_steps)
        ]
