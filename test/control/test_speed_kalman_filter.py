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
"""Kalman filter of the wheel speeds."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.speed_kalman_filter import (
    SpeedFilterParameters,
    SpeedKalmanFilter,
    stationary_gain,
)


@pytest.mark.parametrize('drive', ['velocity', 'torque'])
def test_the_filter_reduces_noise_and_finds_the_disturbance(drive):
    parameters = SpeedFilterParameters(noise_variance=0.04, disturbance=10.0)
    speed_filter = SpeedKalmanFilter(parameters, drive, 0.01)
    rng = np.random.default_rng(6)
    chi = np.zeros(2)
    disturbance = np.array([4.0, -2.0])  # not in the model, rad/s²
    raw, filtered, estimates = [], [], []
    delayed = [np.zeros(2)] * 2
    for k in range(2000):
        command = 3.0 * np.array([math.sin(0.02 * k), math.cos(0.015 * k)])
        if drive == 'velocity':
            delayed = [delayed[1], command]  # dead time of one period
            decay = math.exp(-0.01 / parameters.lag)
            chi = decay * chi + (1 - decay) * (delayed[0] + parameters.lag * disturbance)
        else:
            chi = chi + 0.01 * (command + disturbance)
        measured = chi + rng.normal(scale=0.2, size=2)
        speed_filter.update(command, measured, 0.01, sent=True)
        if k > 500:
            raw.append(measured - chi)
            filtered.append(speed_filter.state.speeds - chi)
            estimates.append(speed_filter.state.disturbance.copy())
    ratio = np.std(filtered) / np.std(raw)
    assert ratio < 0.6
    np.testing.assert_allclose(np.mean(estimates, axis=0), disturbance, atol=0.6)  # three sigma


def test_the_gain_is_the_fixed_point_of_the_riccati_equation():
    from scipy.linalg import solve_discrete_are

    parameters = SpeedFilterParameters()
    transition = np.array([[1.0, 0.01], [0.0, 1.0]])
    process = np.diag([0.0, parameters.disturbance**2 * 0.01])
    predicted = solve_discrete_are(
        transition.T, np.array([[1.0], [0.0]]), process, np.array([[parameters.noise_variance]])
    )
    expected = predicted[:, 0] / (predicted[0, 0] + parameters.noise_variance)
    np.testing.assert_allclose(stationary_gain(transition, parameters, 0.01), expected, rtol=1e-6)


def test_without_noise_or_disabled_the_measurement_is_used():
    for parameters in (
        SpeedFilterParameters(enabled=False),
        SpeedFilterParameters(noise_variance=0.0),
    ):
        speed_filter = SpeedKalmanFilter(parameters, 'torque', 0.01)
        speed_filter.update(np.array([5.0, 5.0]), np.array([1.0, 2.0]), 0.01, sent=True)
        np.testing.assert_allclose(speed_filter.state.speeds, [1.0, 2.0], rtol=1e-3)
