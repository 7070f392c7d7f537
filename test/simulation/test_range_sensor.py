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
"""Simulated range sensors, against the data sheet and REP 117."""

import math

import numpy as np
import pytest

from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.sensor_parameters import (
    BEYOND,
    FAULT,
    NOT_MEASURED,
    TOO_NEAR,
    decode_range,
    encode_range,
)
from t3mpc_ros.simulation.sensors.range_sensor import (
    SimulatedRangeSensorParameters,
    SimulatedRangeSensors,
    distance_from_voltage,
    output_voltage,
)

# Values of the curve of figure 2 of sheet E4-A00201EN (white paper, 90 %): cm and V. The values at
# 5, 6, 7, 8, 10, 15, 20, 25, 30, 40, 50 and 80 cm carry a marker in the lower diagram.
FAR = {
    10: 2.32,
    15: 1.64,
    20: 1.31,
    25: 1.08,
    30: 0.92,
    40: 0.735,
    50: 0.60,
    60: 0.51,
    70: 0.44,
    80: 0.40,
}
NEAR = {1: 0.49, 2: 1.15, 3: 1.85, 4: 2.48, 5: 3.08, 6: 3.14, 7: 2.98, 8: 2.74}
STEP = 5.0 / 1024.0
QUIET = {'voltage_noise': 0.0, 'voltage_offset': 0.0}


def finders(seed: int = 1, **changes: object) -> SimulatedRangeSensors:
    return SimulatedRangeSensors(
        SimulatedRangeSensorParameters.from_dict(changes), np.random.default_rng(seed)
    )


def seen_at(true_distance: float) -> float:
    sensors = finders(**QUIET)
    sensors.measure(0, true_distance)
    return sensors.readings[0]


def test_voltage_matches_the_data_sheet():
    for table, tolerance in ((FAR, 0.025), (NEAR, 0.03)):
        for centimetres, volts in table.items():
            assert output_voltage(0.01 * centimetres) == pytest.approx(volts, rel=tolerance)
    assert output_voltage(0.0) == output_voltage(-0.01) == 0.0
    assert 0.0 < output_voltage(math.inf) < output_voltage(100.0) < output_voltage(0.8)


def test_voltage_has_a_single_peak_between_5_and_7_cm():
    distances = np.linspace(1e-4, 2.0, 2001)
    voltages = np.array([output_voltage(place) for place in distances])
    peak = int(voltages.argmax())
    assert 0.05 < distances[peak] < 0.07
    assert voltages[peak] == pytest.approx(3.14, abs=0.08)
    assert np.all(np.diff(voltages[: peak + 1]) > 0.0)
    assert np.all(np.diff(voltages[peak:]) < 0.0)


def test_board_inverts_the_curve_within_adc_resolution():
    parameters = SimulatedRangeSensorParameters()
    for place in np.linspace(0.1005, 0.79, 300):
        slope = (output_voltage(place - 1e-4) - output_voltage(place + 1e-4)) / 2e-4
        found = distance_from_voltage(parameters.volts(parameters.count(output_voltage(place))))
        # Half a step, and a tenth for the error of the formula near 10 cm.
        assert abs(found - place) <= 0.6 * STEP / slope + 0.002 * place


def test_out_of_range_readings_follow_rep_117():
    assert distance_from_voltage(output_voltage(0.1) + STEP) == -math.inf
    assert distance_from_voltage(output_voltage(0.8) - STEP) == math.inf
    assert distance_from_voltage(5.0) == -math.inf
    for volts in (0.0, -1.0, 0.061, output_voltage(math.inf)):
        assert distance_from_voltage(volts) == math.inf


def test_object_at_5_cm_reads_as_too_near():
    """The extrapolated far branch gives a wrong distance for a near object."""
    # Data sheet: the 3.08 V of 5 cm occur again between 6 and 7 cm.
    assert NEAR[7] < NEAR[5] < NEAR[6]
    extrapolated = distance_from_voltage(output_voltage(0.05), minimum=0.0)
    assert extrapolated == pytest.approx(0.068, abs=0.003)
    assert seen_at(0.05) == -math.inf
    # 4 cm reads as 9 cm.
    assert distance_from_voltage(output_voltage(0.04), minimum=0.0) == pytest.approx(
        0.09, abs=0.003
    )


def test_every_code_round_trips():
    for byte in range(256):
        value = decode_range(byte)
        if byte == FAULT:
            assert math.isnan(value)
            assert encode_range(value) == NOT_MEASURED  # a fault has no reading of its own
        else:
            assert encode_range(value) == byte
    assert math.isnan(decode_range(NOT_MEASURED))
    assert decode_range(TOO_NEAR) == -math.inf
    assert decode_range(BEYOND) == math.inf
    assert decode_range(20) == pytest.approx(0.10)
    assert decode_range(160) == pytest.approx(0.80)
    for byte in (-1, 256):
        with pytest.raises(ValueError, match=f'from 0 to 255: got {byte}'):
            decode_range(byte)
    for place in np.linspace(0.01, 1.265, 400):
        assert abs(decode_range(encode_range(place)) - place) <= 0.0025 + 1e-12
    assert encode_range(-1.0) == encode_range(0.0) == TOO_NEAR
    assert encode_range(1e6) == BEYOND


def test_sensor_periods_are_within_the_data_sheet():
    sensors = finders()
    counts = np.zeros(8)
    for _ in range(20000):
        for index in sensors.due(0.01):
            counts[index] += 1
    assert 200.0 / counts == pytest.approx(sensors.periods, rel=1e-3)
    assert all(0.0287 <= period <= 0.0479 for period in sensors.periods)
    assert len(set(sensors.periods)) == 8


def test_sensors_start_with_random_phases():
    firsts = []
    for seed in range(100):
        sensors = finders(seed=seed)
        first = dict.fromkeys(range(8), 0)
        for tick in range(50):
            for index in sensors.due(0.001):
                first[index] = first[index] or tick + 1
        firsts.append([first[index] / (1e3 * sensors.periods[index]) for index in range(8)])
    # Uniform within the first period.
    assert np.mean(firsts) == pytest.approx(0.5, abs=0.05)
    assert np.std(firsts) == pytest.approx(1.0 / math.sqrt(12.0), rel=0.1)


def test_due_sensors_are_independent_of_the_time_step():
    coarse, fine = finders(), finders()
    for tick in range(300):
        early = [index for _ in range(10) for index in fine.due(0.001)]
        # Rounding may move a sensor at the end of a period to the next one.
        assert set(coarse.due(0.01)) == set(early), tick


def test_long_gap_makes_each_sensor_due_once_in_phase():
    jumped, patient = finders(), finders()
    assert list(jumped.due(1.0003)) == list(range(8))
    for _ in range(10003):
        patient.due(0.0001)
    assert jumped.due(0.0) == []
    for _ in range(20):
        assert jumped.due(0.007) == patient.due(0.007)


def test_reading_noise_follows_the_curve_slope():
    sensors = finders(voltage_noise=0.01, voltage_offset=0.0)
    assert all(map(math.isnan, sensors.readings))
    found = []
    for _ in range(2000):
        sensors.measure(0, 0.5)
        found.append(sensors.readings[0])
    assert sum(map(math.isnan, sensors.readings)) == 7
    slope = (output_voltage(0.499) - output_voltage(0.501)) / 0.002
    assert np.std(found) == pytest.approx(0.01 / slope, rel=0.08)
    assert np.mean(found) == pytest.approx(0.5, abs=0.004)


def test_each_sensor_has_its_own_offset():
    sensors = finders(voltage_noise=0.0, voltage_offset=0.05)
    for index in range(8):
        sensors.measure(index, 0.5)
    assert len(set(sensors.readings)) > 4
    low, high = (
        distance_from_voltage(output_voltage(0.5) + 0.05 + STEP),
        distance_from_voltage(output_voltage(0.5) - 0.05 - STEP),
    )
    assert all(low - 0.0025 <= value <= high + 0.0025 for value in sensors.readings)


def test_a_sensor_beyond_the_body_is_rejected_by_name():
    with pytest.raises(ParameterError, match='^offset must be'):
        SimulatedRangeSensorParameters.from_dict({'offset': 0.095})
