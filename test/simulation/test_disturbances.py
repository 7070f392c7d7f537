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
"""Friction, disturbance and noise."""

import math

import numpy as np
import pytest
from support.constants import with_constants

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.plant.disturbances import (
    Disturbance,
    DisturbanceParameters,
    NoiseParameters,
    SpeedNoise,
    friction_torque,
    reflect,
)


def test_friction_is_odd_and_dissipative():
    for speed in np.random.default_rng(1).uniform(-50.0, 50.0, 200):
        torque = friction_torque(speed, 2e-4, 0.004, 0.2)
        assert torque == -friction_torque(-speed, 2e-4, 0.004, 0.2)
        assert torque * speed > 0.0
    assert friction_torque(0.0, 2e-4, 0.004, 0.2) == 0.0


def test_friction_is_viscous_plus_smoothed_coulomb():
    assert friction_torque(10.0, 2e-4, 0.004, 0.2) == pytest.approx(0.004 + 2e-3)
    assert friction_torque(0.2, 0.0, 0.004, 0.2) == pytest.approx(0.76 * 0.004, rel=0.01)
    slope = friction_torque(1e-6, 2e-4, 0.004, 0.2) / 1e-6
    assert slope == pytest.approx(2e-4 + 0.004 / 0.2, rel=1e-9)


def test_disturbance_never_exceeds_its_bound():
    generator = np.random.default_rng(2)
    for seed in range(8):
        share = float(generator.choice([0.0, 1.0, generator.uniform()]))
        parameters = with_constants(DisturbanceParameters, walk_share=share)(
            bound=generator.uniform(0.0, 0.1),
            frequencies=tuple(generator.uniform(0.0, 5.0, generator.integers(0, 6)).tolist()),
            walk_rate=float(generator.choice([0.1, 100.0])),
        )
        disturbance = Disturbance(parameters, np.random.default_rng(seed))
        for tick in range(200):
            disturbance.draw(0.01)
            for torque in disturbance.torque(0.01 * tick):
                assert abs(torque) <= parameters.bound


def test_disturbance_reaches_its_bound_on_each_wheel():
    parameters = with_constants(DisturbanceParameters, walk_share=0.0)(bound=1.0)
    disturbance = Disturbance(parameters, np.random.default_rng(3))
    torques = np.array([disturbance.torque(0.05 * tick) for tick in range(3000)])
    assert np.abs(torques).max(axis=0) == pytest.approx([1.0, 1.0], abs=0.1)
    assert abs(np.corrcoef(torques.T)[0, 1]) < 0.9


def test_random_walk_spreads_with_the_square_root_of_time():
    parameters = DisturbanceParameters(walk_rate=0.1)
    ends = []
    for seed in range(200):
        disturbance = Disturbance(parameters, np.random.default_rng(seed))
        for _ in range(100):
            disturbance.draw(0.01)
        ends.append(disturbance.walk.copy())
    assert np.std(ends) == pytest.approx(0.1, rel=0.12)


def test_reflection_is_bounded_and_continuous():
    for value in np.random.default_rng(4).uniform(-50.0, 50.0, 500):
        assert -1.0 <= reflect(value) <= 1.0
        assert abs(reflect(value + 1e-6) - reflect(value)) == pytest.approx(1e-6, rel=1e-3)
    assert reflect(0.3) == pytest.approx(0.3)
    assert reflect(1.2) == pytest.approx(0.8)
    assert reflect(-1.2) == pytest.approx(-0.8)


def test_noise_has_the_set_variance_and_zero_mean():
    noise = SpeedNoise(NoiseParameters(variance=0.04), np.random.default_rng(6))
    drawn = np.array([noise.measure(WheelSpeeds(5.0, -3.0)) for _ in range(20000)])
    deviations = drawn - [5.0, -3.0]
    assert np.mean(deviations, axis=0) == pytest.approx([0.0, 0.0], abs=4.0 * 0.2 / 20000**0.5)
    assert np.var(deviations, axis=0) == pytest.approx([0.04, 0.04], rel=0.05)
    assert abs(np.corrcoef(deviations.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(deviations[1:, 0], deviations[:-1, 0])[0, 1]) < 0.03


def test_zero_variance_is_exact_and_draws_the_same_numbers():
    silent = SpeedNoise(NoiseParameters(), np.random.default_rng(7))
    loud = SpeedNoise(NoiseParameters(variance=0.25), np.random.default_rng(7))
    assert silent.measure(WheelSpeeds(5.0, -3.0)) == (5.0, -3.0)
    loud.measure(WheelSpeeds(5.0, -3.0))
    silent.parameters = NoiseParameters(variance=0.01)
    quiet, strong = silent.measure(WheelSpeeds(0.0, 0.0)), loud.measure(WheelSpeeds(0.0, 0.0))
    assert strong.right == pytest.approx(5.0 * quiet.right)
    assert math.isfinite(quiet.left)
