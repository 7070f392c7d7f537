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
r"""Calibration of a robot: estimates with uncertainties from marks, counts and gyro samples.

Every estimate is a least-squares solution with the standard uncertainty that follows from the
uncertainty of its inputs (GUM, JCGM 100:2008, 5.1 and 5.2): marks on the floor, tape, meter, step
angle, noise and drift of the gyro, noise and quantisation of the converter. If n repeated runs
scatter by more than that explains with a probability of 5 %, the uncertainty is enlarged by the
Birge ratio :math:`\sqrt{\chi^2 / (n - p)}`, p estimated values.

The uncertainty of an estimate is one standard deviation; the interval of 95 % is 1.96 times as
wide to both sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.parameters.table import Parameters, parameter

Array = npt.NDArray[np.float64]

COVERAGE = 1.96  # half width of an interval of 95 %, in standard uncertainties
STEP_ANGLE = math.radians(0.05 * 1.8) / math.sqrt(3.0)
"""Standard uncertainty of the angle of a resting rotor, rad: at most 5 % of a full step, not
cumulative (17HS4401 data sheet)."""
GYRO_NOISE = math.radians(0.005)
"""Noise density of the MPU6050, rad/s/√Hz: PS-MPU-6000A-00 r3.4, 6.1."""
GYRO_DRIFT = math.radians(0.005)
"""Random walk of its bias, rad/s/√s: standard deviation after one second; assumed."""
GYRO_FULL_SCALE = math.radians(500.0)  # rad/s
MAX_GYRO_BIAS = 20.0  # deg/s, of the data sheet (PS-MPU-6000A 3.4, 6.1)
REFERENCE_VOLTAGE, CONVERTER_COUNTS = 5.0, 1024
"""Full scale (V) and counts of the converter of the board."""
_SATURATION = 0.98  # share of the full scale from which a gyro sample counts as saturated
_MIN_REST = 2.0
_MAX_REST_SPREAD = 0.0035  # rad/s: a gyro at rest scatters by 6e-4
_MAX_GAP = 0.1  # s, in a turn: at 50 samples a second, four in a row are lost
_MIN_DISTANCE, _MIN_TURNS, _MIN_RANGES, _MIN_VOLTAGES = 0.5, 2.0, 4, 2
_MIN_RANGE_RATIO, _MIN_VOLTAGE_SPAN = 2.0, 1.0
PLAUSIBLE = 0.8, 1.2  # least and largest plausible value, in multiples of the nominal one
_MAX_DIFFERENCE, _MAX_UNCERTAINTY = 0.02, 0.01
"""Relative, of repeated runs and of their mean; marks of 1 mm, 2 m apart, leave 0.0005."""
MAX_SHARP_COUNT, MIN_SHARP_COUNT = 983, 12
"""Counts of a Sharp sensor whose wire is not loose: 4.8 V and 0.06 V."""


class CalibrationError(ValueError):
    """Measurements from which nothing can be estimated: names bound, value and remedy."""


class Estimate(NamedTuple):
    """A calibrated value."""

    value: float
    uncertainty: float  # standard uncertainty, greater than 0


class DividerCorrection(NamedTuple):
    """Battery voltage = (1 + gain) · nominal voltage + offset."""

    gain: float
    offset: float  # V
    uncertainty: float  # standard uncertainty of the corrected voltage, V

    def voltage(self, nominal: float) -> float:
        """Return the battery voltage (V) of a nominal one (V)."""
        return (1.0 + self.gain) * nominal + self.offset


class SharpCurve(NamedTuple):
    """Voltage of a distance sensor at the distance d: scale / (d + shift) + offset."""

    scale: float  # V m
    shift: float  # m
    offset: float  # V
    uncertainty: float  # largest standard uncertainty of a distance within the calibrated ones, m

    def voltage(self, distance: float) -> float:
        """Return the voltage (V) at a distance (m)."""
        return self.scale / (distance + self.shift) + self.offset


class Calibration(NamedTuple):
    """Calibration of a robot; None: not calibrated, the nominal value holds."""

    wheel_radius: Estimate | None = None  # m
    track: Estimate | None = None  # distance between the wheels, m
    gyro_scale: Estimate | None = None  # true rate / rate by the scale of the data sheet
    gyro_bias: Estimate | None = None
    """Rate that the gyro reports at rest, by the scale of the data sheet, rad/s."""
    divider: DividerCorrection | None = None
    curves: tuple[SharpCurve | None, ...] = len(RANGE_SENSORS) * (None,)
    """In the order of RANGE_SENSORS."""


class MarkUncertainty(NamedTuple):
    """Standard uncertainties of what a person measures."""

    distance: float = 1e-3  # of each mark on the floor, m
    angle: float = math.radians(1.0)
    """Of each reading of the robot's direction against a mark, rad."""
    range: float = 2e-3  # of the distance between a sensor and a board in front of it, m
    voltage: float = 0.02  # of each reading of the meter, V


MARKS = MarkUncertainty()


class StraightRun(NamedTuple):
    """A run between two marks."""

    distance: float  # between the marks by tape, m; positive also backward
    right: float  # angle of the right wheel from the step counter, rad
    left: float


class Recording(NamedTuple):
    """Samples of a motion between two rests, each array of shape (n,)."""

    times: Array  # s, increasing
    right: Array  # wheel angle, rad
    left: Array
    rates: Array  # gyro, bias included, rad/s
    begin: int  # number of the first sample in motion; n without motion
    end: int  # number of the first sample of the rest after it


class GyroTurn(NamedTuple):
    """A turn as measured by the gyro."""

    rotation: float  # integral of rate minus bias, by the scale of the data sheet, rad
    uncertainty: float  # from noise and drift, rad
    right: float  # wheel angles, rad
    left: float


class VoltageReading(NamedTuple):
    """Battery voltage of the meter, and of the board without correction."""

    meter: float  # V
    nominal: float  # V, see :func:`nominal_battery_voltage`


class RangeReading(NamedTuple):
    """Samples of a distance sensor in front of a board."""

    distance: float  # m
    counts: tuple[int, ...]


# -- plausibility ---------------------------------------------------------------------------------


def plausible(nominal: float) -> tuple[float, float]:
    """Return the least and the largest plausible value, by the nominal one."""
    return PLAUSIBLE[0] * nominal, PLAUSIBLE[1] * nominal


def check_within(
    name: str, value: float, bounds: tuple[float, float], unit: str, remedy: str
) -> None:
    """Raise CalibrationError for a value outside its bounds."""
    low, high = bounds
    if not low <= value <= high:
        raise CalibrationError(
            f'{name} must be from {low:.4g} to {high:.4g}{unit}: got {value:.4g}; {remedy}'
        )


def _certain(name: str, found: Estimate, of_runs: Array) -> Estimate:
    """Return an estimate; CalibrationError if its runs differ, or leave it uncertain."""
    if np.ptp(of_runs) > _MAX_DIFFERENCE * abs(found.value):
        raise CalibrationError(
            f'{name} must be the same in all runs within {100.0 * _MAX_DIFFERENCE:g} %: got '
            f'{" and ".join(f"{each:.4g}" for each in of_runs)}; a mark was misread, or the '
            'wheels slip: measure again'
        )
    if not found.uncertainty <= _MAX_UNCERTAINTY * found.value:
        raise CalibrationError(
            f'standard uncertainty of {name} must be at most {100.0 * _MAX_UNCERTAINTY:g} %: got '
            f'{100.0 * found.uncertainty / found.value:.2g} %; measure again, a longer way or '
            'more turns, and finer marks'
        )
    return found


# -- wheels ---------------------------------------------------------------------------------------


def estimate_wheel_radius(runs: Sequence[StraightRun], marks: MarkUncertainty = MARKS) -> Estimate:
    r"""Return the mean wheel radius, m, from straight runs between marks.

    .. math:: d_i = R \theta_i + \varepsilon_i, \qquad
              R = \frac{\sum \theta_i d_i}{\sum \theta_i^2}, \qquad
              u^2(R) = \frac{u_d^2}{\sum \theta_i^2} + R^2 u_t^2

    with the mean angle theta of both wheels. u_d holds both marks of a run and the angles at its
    ends; u_t, the tape (class II: at most 0.3 mm and 0.2 mm/m), is common to all runs.
    """
    if not runs:
        raise CalibrationError('runs must be at least 1: got 0; drive between two marks')
    for run in runs:
        check_straight_run(run)
    distances = np.array([run.distance for run in runs])
    angles = np.array([0.5 * abs(run.right + run.left) for run in runs])
    radius = float(angles @ distances / (angles @ angles))
    # Two marks; two wheels, each at both ends of the run.
    variance = 2.0 * marks.distance**2 + (radius * STEP_ANGLE) ** 2
    tape = np.max((3e-4 + 2e-4 * distances) / distances) / math.sqrt(3.0)
    spread = _slope(angles, distances, variance).uncertainty
    found = Estimate(radius, math.hypot(spread, radius * tape))
    return _certain('the wheel radius (m)', found, distances / angles)


def check_straight_run(run: StraightRun) -> None:
    """Raise CalibrationError for a run that is too short, or not straight."""
    if not run.distance >= _MIN_DISTANCE:
        raise CalibrationError(
            f'distance between the marks must be at least {_MIN_DISTANCE} m: got '
            f'{run.distance:g}; measure in metres, and drive 2 m'
        )
    mean = 0.5 * (run.right + run.left)
    if abs(run.right - run.left) > 0.02 * abs(mean):
        raise CalibrationError(
            'the angles of both wheels must agree within 2 %: got '
            f'{run.right:.3f} and {run.left:.3f} rad; drive straight'
        )


def estimate_track(
    turns: Sequence[tuple[float, GyroTurn]], radius: Estimate, marks: MarkUncertainty = MARKS
) -> Estimate:
    r"""Return the distance between the wheels, 2b, in m, from turns on the spot.

    .. math:: R (\theta_r - \theta_l) = 2b\,\psi, \qquad
              2b = R\,\frac{\sum \psi_i (\theta_r - \theta_l)_i}{\sum \psi_i^2}, \qquad
              \left(\frac{u(2b)}{2b}\right)^2 =
              \left(\frac{u(R)}{R}\right)^2 + \frac{u_\psi^2}{\sum \psi_i^2}

    Each turn is given with its true yaw psi, rad, from whole turns and the floor mark; u_psi holds
    both readings of the mark and the step angles. The relation R/2b, which decides on the yaw of
    the odometry, does not depend on R.
    """
    _check_turns(turns)
    yaws = np.array([yaw for yaw, _ in turns])
    angles = np.array([turn.right - turn.left for _, turn in turns])
    ratio = float(yaws @ angles / (yaws @ yaws))
    if not ratio > 0.0:
        raise CalibrationError(
            'the wheels must turn the robot to the side of its yaw: got '
            f'{angles[0]:.1f} rad of the wheels for a yaw of {yaws[0]:.1f}; '
            'left is positive, check invert_left and invert_right'
        )
    variance = 2.0 * (ratio * marks.angle) ** 2 + 4.0 * STEP_ANGLE**2
    relative = _slope(yaws, angles, variance).uncertainty / ratio
    track = radius.value * ratio
    found = Estimate(track, track * math.hypot(relative, radius.uncertainty / radius.value))
    return _certain('the track (m)', found, radius.value * angles / yaws)


# -- gyro -----------------------------------------------------------------------------------------


def estimate_gyro_bias(recording: Recording) -> Estimate:
    r"""Return the rate that the gyro reports at rest, rad/s, from the rest before the motion.

    .. math:: \hat b = \bar\omega, \qquad u^2(b) = \frac{N^2}{T} + \frac{q^2 T}{3}

    with noise density N and random walk q: the value holds for the end of the rest.
    """
    mean, duration = _rest(recording, slice(0, recording.begin), 'before')
    return Estimate(mean, math.sqrt(GYRO_NOISE**2 / duration + GYRO_DRIFT**2 * duration / 3.0))


def measure_turn(recording: Recording) -> GyroTurn:
    r"""Return the turn between two rests as measured by the gyro.

    The bias is measured in both rests, of lengths :math:`T_0` and :math:`T_1`, and interpolated
    over the time T of the motion; the rate is integrated by trapezoids. With noise density N and
    random walk q, the rotation has the variance

    .. math:: N^2 \left(T + \frac{T^2}{4 T_0} + \frac{T^2}{4 T_1}\right)
              + q^2 \left(\frac{T^3}{12} + \frac{T^2 (T_0 + T_1)}{12}\right).
    """
    times, rates = recording.times, recording.rates
    if recording.begin >= recording.end:
        raise CalibrationError('the robot must turn between two rests: got no motion')
    limit = _SATURATION * GYRO_FULL_SCALE
    largest = float(np.max(np.abs(rates)))
    if not largest < limit:
        raise CalibrationError(
            f'the rate of the gyro must be below {math.degrees(limit):.0f} deg/s: got '
            f'{math.degrees(largest):.0f}, saturated; turn more slowly'
        )
    before, rest_before = _rest(recording, slice(0, recording.begin), 'before')
    after, rest_after = _rest(recording, slice(recording.end, len(times)), 'after')
    motion = slice(recording.begin - 1, recording.end + 1)
    gap = float(np.max(np.diff(times[motion])))
    if gap > _MAX_GAP:
        raise CalibrationError(
            f'samples of a turn must be at most {_MAX_GAP} s apart: got {gap:.2f}; '
            't3mpc robot ping shows the losses of the link'
        )
    middle = times[motion]
    duration = float(middle[-1] - middle[0])
    inside = rates[motion] - 0.5 * (before + after)
    rotation = float(np.sum(0.5 * (inside[1:] + inside[:-1]) * np.diff(middle)))
    noise = duration + 0.25 * duration**2 * (1.0 / rest_before + 1.0 / rest_after)
    drift = duration**3 / 12.0 + duration**2 * (rest_before + rest_after) / 12.0
    return GyroTurn(
        rotation,
        math.sqrt(GYRO_NOISE**2 * noise + GYRO_DRIFT**2 * drift),
        float(recording.right[-1] - recording.right[0]),
        float(recording.left[-1] - recording.left[0]),
    )


def estimate_gyro_scale(
    turns: Sequence[tuple[float, GyroTurn]], marks: MarkUncertainty = MARKS
) -> Estimate:
    r"""Return true rate / rate by the data sheet, from turns of known yaw.

    .. math:: k = \frac{\sum w_i \psi_i G_i}{\sum w_i G_i^2}, \qquad
              u^2(k) = \frac{1}{\sum w_i G_i^2}, \qquad
              w_i = \frac{1}{u_\psi^2 + k^2 u^2(G_i)}

    with the rotations G of the gyro and the true yaws psi, from whole turns and a mark.
    """
    _check_turns(turns)
    yaws = np.array([yaw for yaw, _ in turns])
    rotations = np.array([turn.rotation for _, turn in turns])
    variances = 2.0 * marks.angle**2 + np.array([turn.uncertainty**2 for _, turn in turns])
    scale = _slope(rotations, yaws, variances)
    name, remedy = 'the scale of the gyro', 'count the turns, left is positive'
    check_within(name, scale.value, plausible(1.0), '', remedy)
    return _certain(name, scale, yaws / rotations)


def whole_turns(turn: GyroTurn, beyond: float) -> int:
    """Return the whole turns of the yaw nearest to the gyro's that ends ``beyond`` a mark, rad.

    The scale of an MPU6050 is within 3 %, which identifies up to 16 turns.
    """
    return round((turn.rotation - beyond) / math.tau)


def _check_turns(turns: Sequence[tuple[float, GyroTurn]]) -> None:
    if not turns:
        raise CalibrationError('turns must be at least 1: got 0; turn the robot on the spot')
    for yaw, _ in turns:
        if not abs(yaw) >= _MIN_TURNS * math.tau * 0.99:
            raise CalibrationError(
                f'a turn must have at least {_MIN_TURNS:g} whole turns: got '
                f'{abs(yaw) / math.tau:.2f}; ten are better, because the mark is read only twice'
            )


def _rest(recording: Recording, part: slice, when: str) -> tuple[float, float]:
    """Return mean rate (rad/s) and duration (s) of a rest."""
    times, rates = recording.times[part], recording.rates[part]
    duration = float(times[-1] - times[0]) if len(times) > 1 else 0.0
    if duration < _MIN_REST:
        raise CalibrationError(
            f'the rest {when} the motion must last at least {_MIN_REST:g} s: got {duration:.1f}; '
            'do not touch the robot until it is asked for'
        )
    spread = float(np.std(rates, ddof=1))
    blocks = [float(np.mean(block)) for block in np.array_split(rates, 4)]
    wander = max(blocks) - min(blocks)
    if not max(spread, wander) <= _MAX_REST_SPREAD:
        raise CalibrationError(
            f'the gyro at rest must scatter by at most {_MAX_REST_SPREAD:g} rad/s: got '
            f'{max(spread, wander):.4f} {when} the motion; the robot was moved, or its floor '
            'shakes: repeat the step'
        )
    moved = any(float(np.ptp(angles[part])) > 0.0 for angles in (recording.right, recording.left))
    if moved:
        raise CalibrationError(
            f'the wheels must rest {when} the motion: got steps; stop other programs that drive'
        )
    return float(np.mean(rates)), duration


# -- converter ------------------------------------------------------------------------------------


def nominal_battery_voltage(count: float, divider: float) -> float:
    """Return the battery voltage, V, as the board computes it without correction."""
    return REFERENCE_VOLTAGE * count / CONVERTER_COUNTS * divider


def estimate_divider(
    readings: Sequence[VoltageReading],
    divider: float = 4.0,
    marks: MarkUncertainty = MARKS,
    span: tuple[float, float] = (9.0, 12.6),
) -> DividerCorrection:
    r"""Return the correction of the battery voltage from readings of a meter.

    .. math:: V = (1 + g)\,V_n + o

    by linear least squares; each reading has the variance of the meter and that of one step of
    the converter behind the divider, :math:`(q \Delta)^2 / 12`. The uncertainty is the largest of
    a corrected voltage within ``span`` (V): three Li-ion cells.
    """
    if len(readings) < _MIN_VOLTAGES:
        raise CalibrationError(
            f'voltages must be at least {_MIN_VOLTAGES}: got {len(readings)}; measure a full and '
            'an empty battery, or use a bench supply'
        )
    nominal = np.array([reading.nominal for reading in readings])
    meter = np.array([reading.meter for reading in readings])
    check_voltages(readings)
    step = REFERENCE_VOLTAGE / CONVERTER_COUNTS * divider
    variance = marks.voltage**2 + step**2 / 12.0
    design = np.column_stack((nominal, np.ones_like(nominal)))
    solution, covariance = _least_squares(design, meter, variance)
    slope, offset = solution.tolist()
    check_within('gain of the battery voltage', slope, plausible(1.0), '', 'measure both again')
    ends = np.array([[voltage, 1.0] for voltage in span])
    worst = max(float(end @ covariance @ end) for end in ends)
    return DividerCorrection(slope - 1.0, offset, math.sqrt(worst))


def check_voltages(readings: Sequence[VoltageReading]) -> None:
    """Raise CalibrationError if meter and robot disagree, or the readings are alike."""
    for meter, nominal in readings:
        remedy = (
            f'the robot measured {nominal:.2f} V: read the meter again, or correct the divider '
            '(t3mpc robot setup --divider) and its wire at A8'
        )
        check_within('voltage of the meter', meter, plausible(nominal), ' V', remedy)
    measured = [reading.nominal for reading in readings]
    if len(measured) > 1 and not max(measured) - min(measured) >= _MIN_VOLTAGE_SPAN:
        raise CalibrationError(
            f'the voltages must be at least {_MIN_VOLTAGE_SPAN:g} V apart: got '
            f'{" and ".join(f"{each:.2f}" for each in measured)} V, measured by the robot; '
            'measure a full and an empty battery, or use a bench supply'
        )


def estimate_sharp_curve(
    readings: Sequence[RangeReading], marks: MarkUncertainty = MARKS
) -> SharpCurve:
    r"""Return the curve of a distance sensor from counts at known distances.

    .. math:: V(d) = \frac{a}{d + s} + c

    by Gauss-Newton on (a, s, c), with the effective variance of each reading

    .. math:: u_i^2 = \frac{\sigma_i^2}{n_i} + \frac{\Delta^2}{12}
              + \left(\frac{a}{(d_i + s)^2}\right)^2 u_d^2

    from the scatter of its samples, one step of the converter, and the distance that was set. The
    uncertainty of a distance is that of the curve there, divided by its slope.
    """
    readings = sorted(readings)
    _check_ranges(readings)
    distances, volts, noise = _converter_readings(readings)
    if np.any(np.diff(volts) >= 0.0):
        raise CalibrationError(
            'the voltage must fall with the distance: got '
            + ', '.join(f'{v:.2f} V at {d:.2f} m' for d, v in zip(distances, volts, strict=True))
            + '; below 0.1 m it rises, and another object may be in the beam'
        )
    curve = SharpCurve(*_fit_curve(distances, volts, noise, marks.range), 0.0)
    between = np.linspace(distances[0], distances[-1], 50).tolist()
    return curve._replace(uncertainty=max(range_uncertainties(readings, curve, between, marks)))


def range_uncertainties(
    readings: Sequence[RangeReading],
    curve: SharpCurve,
    at: Sequence[float],
    marks: MarkUncertainty = MARKS,
) -> list[float]:
    """Return the standard uncertainty, m, that the readings of a curve leave at distances (m)."""
    distances, volts, noise = _converter_readings(readings)
    values = np.array(curve[:3])
    gradients = _curve_gradients(values, distances)
    variances = noise + (gradients[:, 1] * marks.range) ** 2
    residuals = volts - curve.scale / (distances + curve.shift) - curve.offset
    _, covariance = _least_squares(gradients, residuals, variances)
    there = _curve_gradients(values, np.array(at))
    found: list[float] = (
        np.sqrt(np.einsum('ij,jk,ik->i', there, covariance, there)) / np.abs(there[:, 1])
    ).tolist()
    return found


def _converter_readings(readings: Sequence[RangeReading]) -> tuple[Array, Array, Array]:
    """Return distance (m), mean voltage (V) and its variance (V²) of each reading."""
    step = REFERENCE_VOLTAGE / CONVERTER_COUNTS
    counts = [np.array(reading.counts, dtype=float) for reading in readings]
    means = [float(np.mean(each)) for each in counts]
    return (
        np.array([reading.distance for reading in readings]),
        # The middle of the step of a count.
        np.array([REFERENCE_VOLTAGE * (mean + 0.5) / CONVERTER_COUNTS for mean in means]),
        step**2 * np.array([np.var(each, ddof=1) / len(each) + 1.0 / 12.0 for each in counts]),
    )


def _check_ranges(readings: Sequence[RangeReading]) -> None:
    if len(readings) < _MIN_RANGES:
        raise CalibrationError(
            f'distances must be at least {_MIN_RANGES}: got {len(readings)}; '
            '0.1, 0.15, 0.2, 0.3, 0.5 and 0.8 m are good ones'
        )
    nearest, farthest = readings[0].distance, readings[-1].distance
    if not 0.0 < nearest * _MIN_RANGE_RATIO <= farthest:
        raise CalibrationError(
            f'the largest distance must be at least {_MIN_RANGE_RATIO:g} times the smallest: got '
            f'{nearest:g} and {farthest:g} m'
        )
    for reading in readings:
        check_range_reading(reading)


def check_range_reading(reading: RangeReading) -> None:
    """Raise CalibrationError for a sensor that does not measure."""
    if len(reading.counts) < 2:
        raise CalibrationError(
            f'samples at {reading.distance:g} m must be at least 2: got {len(reading.counts)}'
        )
    for count in (min(reading.counts), max(reading.counts)):
        if not MIN_SHARP_COUNT <= count <= MAX_SHARP_COUNT:
            raise CalibrationError(
                f'counts must be from {MIN_SHARP_COUNT} to {MAX_SHARP_COUNT}: got {count} '
                f'at {reading.distance:g} m, saturated; check the wires of the sensor'
            )


def _curve_gradients(curve: Array, distances: Array) -> Array:
    """Return dV/d(a, s, c) at distances, shape (n, 3)."""
    shifted = distances + curve[1]
    return np.column_stack((1.0 / shifted, -curve[0] / shifted**2, np.ones_like(distances)))


def _fit_curve(
    distances: Array, volts: Array, noise: Array, mark: float
) -> tuple[float, float, float]:
    """Return (a, s, c)."""
    curve = np.array([0.282, 0.0257, 0.061])
    for _ in range(100):
        gradients = _curve_gradients(curve, distances)
        variances = noise + (gradients[:, 1] * mark) ** 2
        residuals = volts - curve[0] / (distances + curve[1]) - curve[2]
        change, _ = _least_squares(gradients, residuals, variances)
        # A step that would bring the pole of the curve near the distances is shortened.
        while distances[0] + curve[1] + change[1] < 0.5 * (distances[0] + curve[1]):
            change = 0.5 * change
        curve = curve + change
        if np.all(np.abs(change) < 1e-9):
            scale, shift, offset = curve.tolist()
            return scale, shift, offset
    raise CalibrationError(
        'the readings must follow scale / (d + shift) + offset: got no solution after 100 steps; '
        'check the distances'
    )


def _slope(x: Array, y: Array, variances: float | Array) -> Estimate:
    """Return k of y = k x, with the variances of y."""
    solution, covariance = _least_squares(x[:, np.newaxis], y, variances)
    return Estimate(float(solution[0]), math.sqrt(covariance[0, 0]))


def _least_squares(design: Array, y: Array, variances: float | Array) -> tuple[Array, Array]:
    """Return x of design (n, p) x = y and its covariance, enlarged by the Birge ratio."""
    root: Array = 1.0 / np.sqrt(variances + np.zeros(y.shape))
    weighted = design * root[:, np.newaxis]
    x = np.linalg.lstsq(weighted, y * root, rcond=None)[0]
    chi_squared = float(np.sum(((y - design @ x) * root) ** 2))
    covariance = np.linalg.inv(weighted.T @ weighted)
    if (freedom := len(y) - design.shape[1]) > 0:
        # Above 1 if the scatter has a probability below 5 %: the 95 % quantile of chi squared,
        # Wilson and Hilferty (1931).
        part = 2.0 / (9.0 * freedom)
        if chi_squared > freedom * (1.0 - part + 1.645 * math.sqrt(part)) ** 3:
            covariance *= max(1.0, chi_squared / freedom)
    return x.astype(np.float64), covariance.astype(np.float64)


# -- record ---------------------------------------------------------------------------------------

_NONE = len(RANGE_SENSORS) * (0.0,)


@dataclass(frozen=True)
class CalibrationParameters(Parameters):
    """What a calibration found beside the parameters in use; 0 where nothing was calibrated.

    Nothing reads these parameters: the recorder stores them in every bag.
    """

    date: str = parameter('', 'day of the calibration; empty: not calibrated')
    wheel_radius_uncertainty: float = parameter(
        0.0, 'standard uncertainty of wheel_radius', 'm', (0.0, None)
    )
    wheel_separation_uncertainty: float = parameter(
        0.0, 'standard uncertainty of wheel_separation', 'm', (0.0, None)
    )
    gyro_bias: float = parameter(0.0, 'bias of the gyro at the calibration', 'rad/s')
    gyro_bias_uncertainty: float = parameter(
        0.0, 'standard uncertainty of gyro_bias', 'rad/s', (0.0, None)
    )
    battery_gain: float = parameter(
        0.0, 'battery voltage = (1 + gain) nominal voltage + offset; applied by the robot'
    )
    battery_offset: float = parameter(0.0, 'offset of the same', 'V')
    battery_uncertainty: float = parameter(
        0.0, 'standard uncertainty of the battery voltage', 'V', (0.0, None)
    )
    range_scale: tuple[float, ...] = parameter(
        _NONE,
        'voltage of each range sensor = scale / (distance + shift) + offset; applied by the robot',
        'V m',
    )
    range_shift: tuple[float, ...] = parameter(_NONE, 'shift of the same', 'm')
    range_offset: tuple[float, ...] = parameter(_NONE, 'offset of the same', 'V')
    range_uncertainty: tuple[float, ...] = parameter(
        _NONE, 'largest standard uncertainty of a distance', 'm', (0.0, None)
    )
