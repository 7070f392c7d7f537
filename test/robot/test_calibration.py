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
"""Estimates of a calibration: coverage of their uncertainty, and refusals.

Each quantity is estimated 100 times from measurements with the noise of the simulated sensors and
of the marks. If the intervals hold 95 % of the true values, their number in 100 is binomial, and
the sum of the squared normalised errors has a chi-squared distribution: a smaller uncertainty
fails the first check, a larger one the second.
"""

import math

import numpy as np
import pytest

from t3mpc_ros.robot import calibration
from t3mpc_ros.robot.calibration import (
    COVERAGE,
    CalibrationError,
    Estimate,
    GyroTurn,
    MarkUncertainty,
    RangeReading,
    Recording,
    SharpCurve,
    StraightRun,
    VoltageReading,
)
from t3mpc_ros.simulation.sensors.imu import SimulatedImu, SimulatedImuParameters
from t3mpc_ros.simulation.sensors.range_sensor import SimulatedRangeSensorParameters

TRIALS = 100
MARKS = MarkUncertainty()
RADIUS, TRACK = 0.035, 0.147
PERIOD = 0.02
"""s between two samples of the telemetry."""
_FEWEST = 87
"""P(fewer of 100 | 95 %) = 0.0004."""
_CHI_SQUARED = 58.0, 154.0
"""100 degrees of freedom: 0.0002 on each side."""


def assert_coverage(errors, uncertainties):
    """Fail if 1.96 standard uncertainties are not an interval of 95 %."""
    normalised = np.abs(np.array(errors)) / np.array(uncertainties)
    assert len(normalised) == TRIALS
    assert np.count_nonzero(normalised <= COVERAGE) >= _FEWEST
    assert _CHI_SQUARED[0] < np.sum(normalised**2) < _CHI_SQUARED[1]


# -- simulated measurements -----------------------------------------------------------------------


def straight_runs(generator, radius, count=2, distance=2.0):
    tape = (3e-4 + 2e-4 * distance) / distance / math.sqrt(3.0) * generator.standard_normal()
    runs = []
    for _ in range(count):
        true = distance / RADIUS + calibration.STEP_ANGLE * generator.standard_normal((2, 2))
        right, left = distance / RADIUS + np.zeros(2)
        travelled = radius * float(np.mean(true[0] - true[1] + right))
        marks = math.sqrt(2.0) * MARKS.distance * generator.standard_normal()
        runs.append(StraightRun((travelled + marks) * (1.0 + tape), right, left))
    return runs


def sample(imu, rate):
    """Return the rate that a gyro reports at a true rate."""
    return imu.measure(np.array([[0.0, rate], [0.0, 0.0], [0.0, 0.0]]), PERIOD).angular


def recorded_turn(generator, imu, yaw, rate=4.0, rest=4.0):
    """Return a recording of a turn by ``yaw``, and the yaw that a person reads from the mark."""
    duration = abs(yaw) / rate
    samples = round((2.0 * rest + duration) / PERIOD)
    begin, end = round(rest / PERIOD), round((rest + duration) / PERIOD)
    speed = yaw / ((end - begin) * PERIOD)
    rates = np.empty(samples)
    for number in range(samples):
        # A linear start and end, over one sample each.
        true = speed if begin < number < end else 0.5 * speed * (number in (begin, end))
        rates[number] = sample(imu, true)
    travel = np.clip((np.arange(samples) - begin) / (end - begin), 0.0, 1.0)
    angle = 0.5 * TRACK * yaw / RADIUS * travel
    recording = Recording(PERIOD * np.arange(samples), angle, -angle, rates, begin, end + 1)
    marks = math.sqrt(2.0) * MARKS.angle * generator.standard_normal()
    return recording, yaw + marks


# -- coverage -------------------------------------------------------------------------------------


def test_wheel_radius_has_its_stated_uncertainty():
    generator = np.random.default_rng(1)
    errors, uncertainties = [], []
    for _ in range(TRIALS):
        radius = RADIUS * (1.0 + 0.03 * generator.standard_normal())
        found = calibration.estimate_wheel_radius(straight_runs(generator, radius))
        errors.append(found.value - radius)
        uncertainties.append(found.uncertainty)
    assert_coverage(errors, uncertainties)
    assert np.mean(uncertainties) < 1e-3 * RADIUS


@pytest.mark.slow
def test_track_and_gyro_scale_have_their_stated_uncertainty():
    generator = np.random.default_rng(2)
    parameters = SimulatedImuParameters(gyro_scale_error=0.03)
    errors, uncertainties = {}, {}
    for trial in range(TRIALS):
        imu = SimulatedImu(parameters, np.random.default_rng(1000 + trial))
        radius = Estimate(RADIUS, 1e-5)
        true_radius = radius.value + radius.uncertainty * generator.standard_normal()
        track = TRACK * (1.0 + 0.03 * generator.standard_normal())
        turns = []
        for turned in (10.0, -10.0):
            # The steps turn the robot by what its true wheels make of them.
            true = turned * math.tau * true_radius / RADIUS * TRACK / track
            recording, read = recorded_turn(generator, imu, true)
            scale = turned * math.tau / true
            recording = recording._replace(
                right=recording.right * scale, left=recording.left * scale
            )
            turns.append((read, calibration.measure_turn(recording)))
        found = {
            'track': (calibration.estimate_track(turns, radius), track),
            'scale': (calibration.estimate_gyro_scale(turns), 1.0 / (1.0 + 0.03 * imu._scale)),
        }
        for name, (estimate, truth) in found.items():
            errors.setdefault(name, []).append(estimate.value - truth)
            uncertainties.setdefault(name, []).append(estimate.uncertainty)
    for name, values in errors.items():
        assert_coverage(values, uncertainties[name])
    assert np.mean(uncertainties['scale']) < 5e-4
    assert np.mean(uncertainties['track']) < 1e-3 * TRACK


@pytest.mark.slow
def test_gyro_bias_has_its_stated_uncertainty():
    errors, uncertainties = [], []
    for trial in range(TRIALS):
        imu = SimulatedImu(SimulatedImuParameters(), np.random.default_rng(trial))
        rates = np.array([sample(imu, 0.0) for _ in range(500)])
        found = calibration.estimate_gyro_bias(rest(rates))
        errors.append(found.value - imu.bias)
        uncertainties.append(found.uncertainty)
    assert_coverage(errors, uncertainties)


def test_divider_has_its_stated_uncertainty():
    """At the battery voltage with the largest one."""
    generator = np.random.default_rng(4)
    errors, uncertainties = [], []
    for _ in range(TRIALS):
        divider = 4.0 * (1.0 + 0.03 * generator.standard_normal())
        readings = []
        for voltage in generator.uniform((9.2, 11.8), (10.0, 12.6)):
            meter = voltage + MARKS.voltage * generator.standard_normal()
            nominal = np.mean([board_voltage(voltage, divider, generator) for _ in range(20)])
            readings.append(VoltageReading(meter, nominal))
        found = calibration.estimate_divider(readings)
        true = 9.0 if readings[0].nominal > 9.8 else 12.6
        nominal = np.mean([board_voltage(true, divider, generator) for _ in range(400)])
        errors.append(found.voltage(nominal) - true)
        uncertainties.append(found.uncertainty)
    normalised = np.abs(np.array(errors)) / np.array(uncertainties)
    # The stated one is the largest of both ends of the range.
    assert np.count_nonzero(normalised <= COVERAGE) >= _FEWEST
    assert np.sum(normalised**2) > 0.5 * _CHI_SQUARED[0]


def board_voltage(voltage, divider, generator):
    """Return the battery voltage that the board computes, with noise of half a count."""
    counts = voltage / divider * 1024.0 / 5.0 + 0.5 * generator.standard_normal()
    return calibration.nominal_battery_voltage(math.floor(counts), 4.0)


def test_sharp_curves_have_their_stated_uncertainty():
    """At 10, 30 and 80 cm: the distance that the curve gives for the true voltage there."""
    generator = np.random.default_rng(5)
    adc = SimulatedRangeSensorParameters()
    errors = {distance: [] for distance in (0.1, 0.3, 0.8)}
    uncertainties = {distance: [] for distance in errors}
    for _ in range(TRIALS):
        scale = 0.282 * (1.0 + 0.05 * generator.standard_normal())
        shift = 0.0257 * (1.0 + 0.05 * generator.standard_normal())
        true = SharpCurve(scale, shift, 0.061 + 0.03 * generator.standard_normal(), 0.0)
        readings = sharp_readings(generator, true, adc)
        found = calibration.estimate_sharp_curve(readings)
        for distance in errors:
            volts = true.voltage(distance)
            errors[distance].append(found.scale / (volts - found.offset) - found.shift - distance)
            (uncertainty,) = calibration.range_uncertainties(readings, found, [distance])
            uncertainties[distance].append(uncertainty)
        assert found.uncertainty >= max(uncertainties[each][-1] for each in errors) * 0.999
    for distance, values in errors.items():
        assert_coverage(values, uncertainties[distance])
    assert np.mean(uncertainties[0.3]) < 0.005


def sharp_readings(generator, curve, adc, distances=(0.1, 0.15, 0.2, 0.3, 0.5, 0.8)):
    readings = []
    for distance in distances:
        placed = distance + MARKS.range * generator.standard_normal()
        volts = curve.voltage(placed) + adc.voltage_noise * generator.standard_normal(20)
        readings.append(RangeReading(distance, tuple(adc.count(each) for each in volts)))
    return readings


# -- properties -----------------------------------------------------------------------------------


def test_runs_that_scatter_too_much_enlarge_the_uncertainty():
    run = StraightRun(2.0, 2.0 / RADIUS, 2.0 / RADIUS)
    alike = calibration.estimate_wheel_radius([run, run._replace(distance=2.001)])
    apart = calibration.estimate_wheel_radius([run, run._replace(distance=2.02)])
    assert apart.value == pytest.approx(2.01 / run.right)
    # Half the difference of both runs, and what the tape adds.
    assert apart.uncertainty == pytest.approx(0.01 / 2.0 * RADIUS, rel=0.01)
    assert alike.uncertainty < 0.2 * apart.uncertainty


def test_the_uncertainty_falls_with_the_number_of_turns():
    turn = GyroTurn(20.0 * math.pi, 0.001, 132.0, -132.0)
    one = calibration.estimate_gyro_scale([(20.0 * math.pi, turn)])
    half = turn._replace(rotation=10.0 * math.pi, right=66.0, left=-66.0)
    assert calibration.whole_turns(turn._replace(rotation=10.2 * math.tau), -0.7 * math.tau) == 11
    assert calibration.whole_turns(turn._replace(rotation=-9.9 * math.tau), 0.0) == -10
    five = calibration.estimate_gyro_scale([(10.0 * math.pi, half)])
    assert one.uncertainty == pytest.approx(math.sqrt(2.0) * MARKS.angle / (20.0 * math.pi), 0.01)
    assert five.uncertainty == pytest.approx(2.0 * one.uncertainty, 0.01)


# -- refusals -------------------------------------------------------------------------------------


def rest(rates):
    """Return a recording of a robot that never moves."""
    count = len(rates)
    still = np.zeros(count)
    return Recording(PERIOD * np.arange(count), still, still, np.asarray(rates), count, count)


def turned(**changes):
    """Return an ideal recording of two turns at 1 rad/s between rests of 3 s."""
    count, begin, end = 928, 150, 778
    rates = np.zeros(count)
    rates[begin:end] = 1.0
    angles = 2.1 * np.clip(PERIOD * (np.arange(count) - begin), 0.0, 12.56)
    recording = Recording(PERIOD * np.arange(count), angles, -angles, rates, begin, end)
    return recording._replace(**changes)


TURN = GyroTurn(10.0 * math.tau, 0.001, 132.0, -132.0)
CURVE = SharpCurve(0.282, 0.0257, 0.061, 0.0)


def exact_readings(distances):
    return [
        RangeReading(distance, 2 * (round(CURVE.voltage(distance) * 204.8 - 0.5),))
        for distance in distances
    ]


def with_rates(values):
    recording = turned()
    rates = recording.rates.copy()
    for place, value in values.items():
        rates[place] = value
    return recording._replace(rates=rates)


def spaced(step):
    recording = turned()
    times = recording.times.copy()
    times[400:] += step
    return recording._replace(times=times)


RUN = StraightRun(2.0, 57.0, 57.0)
TEN, SURE = 10.0 * math.tau, Estimate(RADIUS, 1e-5)
PUSHED = dict.fromkeys(range(50, 60), 0.1), dict.fromkeys(range(800, 830), 0.02)
FULL, EMPTY = VoltageReading(12.0, 11.9), VoltageReading(9.5, 9.4)
RADII, TRACKS = calibration.estimate_wheel_radius, calibration.estimate_track
SCALES, DIVIDERS = calibration.estimate_gyro_scale, calibration.estimate_divider
BIASES, TURNS = calibration.estimate_gyro_bias, calibration.measure_turn
CURVES = calibration.estimate_sharp_curve
REFUSALS = [
    (RADII, [[]], r'at least 1: got 0'),
    (RADII, [[RUN._replace(distance=0.0)]], r'marks must be at least 0.5 m: got 0; .* drive 2 m'),
    (RADII, [[RUN._replace(distance=math.nan)]], r'at least 0.5 m: got nan'),
    (RADII, [[RUN._replace(left=50.0)]], r'within 2 %: got 57.000 and 50.000 rad; drive straight'),
    (
        RADII,
        [[StraightRun(2.04, 57.0, 57.0), StraightRun(1.04, -57.0, -57.0)]],
        r'in all runs within 2 %: got 0.03579 and 0.01825; a mark was misread.*measure again',
    ),
    (
        RADII,
        [[RUN], MarkUncertainty(distance=0.1)],
        r'standard uncertainty of the wheel radius .* at most 1 %: got 7.1 %; measure again',
    ),
    (
        TRACKS,
        [[(TEN, TURN), (1.1 * TEN, TURN)], SURE],
        r'the track \(m\) must be the same in all runs within 2 %: got 0.1471 and 0.1337',
    ),
    (TRACKS, [[(-TEN, TURN)], SURE], r'left is positive, check invert_left'),
    (SCALES, [[(math.tau, TURN)]], r'at least 2 whole turns: got 1.00; ten are better'),
    (SCALES, [[(0.7 * TEN, TURN)]], r'from 0.8 to 1.2: got 0.7; count the turns'),
    (TURNS, [with_rates({400: 8.72})], r'below 490 deg/s: got 500, saturated; turn more slowly'),
    (TURNS, [with_rates(PUSHED[0])], r'0.0035 rad/s: got 0.0\d+ before the motion; .* was moved'),
    (TURNS, [with_rates(PUSHED[1])], r'got 0.0\d+ after the motion'),
    (TURNS, [turned(begin=400)], r'at most 0.0035|must rest before the motion: got steps'),
    (TURNS, [rest(np.zeros(500))], r'must turn between two rests: got no motion'),
    (TURNS, [spaced(0.3)], r'at most 0.1 s apart: got 0.32; t3mpc robot ping'),
    (BIASES, [rest(np.linspace(0.0, 0.01, 500))], r'at most 0.0035 rad/s'),  # turned evenly
    (BIASES, [rest(np.zeros(50))], r'must last at least 2 s: got 1.0; do not touch'),
    (DIVIDERS, [[FULL]], r'at least 2: got 1; measure a full and an empty battery'),
    (
        DIVIDERS,
        [[FULL, VoltageReading(11.5, 11.4)]],
        r'at least 1 V apart: got 11.90 and 11.40 V, measured by the robot',
    ),
    (
        DIVIDERS,
        [[FULL._replace(meter=120.0), EMPTY]],
        r'from 9.52 to 14.28 V: got 120; the robot measured 11.90 V: read the meter again',
    ),
    (
        DIVIDERS,
        [[VoltageReading(10.0, 12.0), VoltageReading(10.5, 10.0)]],
        r'gain of the battery voltage must be from 0.8 to 1.2: got -0.25; measure both again',
    ),
    (CURVES, [exact_readings((0.1, 0.2, 0.4))], r'must be at least 4: got 3; 0.1, 0.15'),
    (
        CURVES,
        [exact_readings((0.3, 0.35, 0.4, 0.45))],
        r'2 times the smallest: got 0.3 and 0.45 m',
    ),
    (
        CURVES,
        [[RangeReading(0.03, (300, 301)), *exact_readings((0.1, 0.2, 0.4))]],
        r'must fall with the distance: got 1.47 V at 0.03 m, 2.30 V at 0.10 m.*below 0.1 m',
    ),
    (
        CURVES,
        [[RangeReading(0.1, (1023, 1023)), *exact_readings((0.2, 0.4, 0.8))]],
        r'from 12 to 983: got 1023 at 0.1 m, saturated; check the wires',
    ),
]


@pytest.mark.parametrize(('estimate', 'arguments', 'words'), REFUSALS)
def test_bad_measurements_are_refused_with_a_remedy(estimate, arguments, words):
    with pytest.raises(CalibrationError, match=words):
        estimate(*arguments)
