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
"""Lagrangian dynamics (4)-(15), against mechanics from first principles."""

from collections.abc import Callable
import math

import numpy as np
import pytest
from support.equations import (
    body_dynamics,
    constrained_acceleration,
    constraint_matrix,
    constraint_rate,
    coriolis_matrix,
    inertia_matrix,
    kinetic_energy,
    null_space,
    pose_rate,
    reduce_to_wheels,
    wheel_coriolis,
)

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.plant.dynamics import (
    BodyParameters,
    coriolis_factor,
    dynamics_vector,
    wheel_acceleration,
    wheel_inertia,
)

SEEDS = range(4)


def random_robot(generator: np.random.Generator) -> tuple[BodyParameters, WheelGeometry]:
    body = BodyParameters(
        body_mass=generator.uniform(0.5, 5.0),
        wheel_mass=generator.uniform(0.02, 0.5),
        body_inertia=generator.uniform(0.005, 0.1),
        wheel_inertia=generator.uniform(1e-5, 1e-3),
        wheel_turn_inertia=generator.uniform(1e-5, 1e-3),
        com_offset=generator.uniform(-0.1, 0.1),
    )
    return body, WheelGeometry(generator.uniform(0.02, 0.1), generator.uniform(0.1, 0.5))


def energy_of_the_parts(
    coordinates: np.ndarray, rates: np.ndarray, body: BodyParameters, geometry: WheelGeometry
) -> float:
    """Return the kinetic energy of one body and two wheels, without (5)."""
    yaw = coordinates[2]
    speed, turn, spins = np.array(rates[:2]), rates[2], rates[3:]
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    aside = np.array([-math.sin(yaw), math.cos(yaw)])
    centre = speed + turn * body.com_offset * aside
    energy = 0.5 * body.body_mass * centre @ centre + 0.5 * body.body_inertia * turn**2
    for side, spin in zip((-1.0, 1.0), spins, strict=True):
        # A point b to the side moves forward or backward as the robot turns.
        hub = speed - side * geometry.half_separation * turn * ahead
        energy += 0.5 * body.wheel_mass * hub @ hub
        energy += 0.5 * body.wheel_turn_inertia * turn**2 + 0.5 * body.wheel_inertia * spin**2
    return float(energy)


def runge_kutta(
    rate: Callable[[np.ndarray], np.ndarray], state: np.ndarray, step: float, count: int
) -> np.ndarray:
    for _ in range(count):
        first = rate(state)
        second = rate(state + 0.5 * step * first)
        third = rate(state + 0.5 * step * second)
        fourth = rate(state + step * third)
        state = state + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    return state


def reduced_rate(dynamics: np.ndarray, torque: tuple[float, float] = (0.0, 0.0)) -> Callable:
    return lambda chi: np.array(wheel_acceleration(chi[0], chi[1], *torque, dynamics))


@pytest.mark.parametrize('seed', SEEDS)
def test_inertia_matrix_follows_from_the_kinetic_energy(seed):
    """E2, (14): entry (2, 2) is m; and the offset terms carry m_c, not m.

    The energy is a quadratic form in the rates, so its matrix follows from it without
    derivatives. The paper prints 0 at (2, 2), which makes motion along y free.
    """
    generator = np.random.default_rng(seed)
    body, geometry = random_robot(generator)
    coordinates = generator.uniform(-3.0, 3.0, 5)

    def energy(rates):
        return energy_of_the_parts(coordinates, rates, body, geometry)

    unit = np.eye(5)
    expected = np.array(
        [[energy(a + b) - energy(a) - energy(b) for b in unit] for a in unit], dtype=float
    )
    matrix = inertia_matrix(coordinates[2], body, geometry)
    assert matrix == pytest.approx(expected, abs=1e-12)
    assert np.all(np.linalg.eigvalsh(matrix) > 0.0)


@pytest.mark.parametrize('seed', SEEDS)
def test_coriolis_matrix_follows_from_the_lagrangian(seed):
    """E2, (6): d/dt dT/dq' - dT/dq at q'' = 0; the terms are in the third column."""
    generator = np.random.default_rng(seed)
    body, geometry = random_robot(generator)
    coordinates, rates = generator.uniform(-3.0, 3.0, 5), generator.uniform(-3.0, 3.0, 5)
    small = 1e-5

    def momentum(q):
        return inertia_matrix(q[2], body, geometry) @ rates

    along = (momentum(coordinates + small * rates) - momentum(coordinates - small * rates)) / (
        2.0 * small
    )
    slope = np.array(
        [
            energy_of_the_parts(coordinates + small * axis, rates, body, geometry)
            - energy_of_the_parts(coordinates - small * axis, rates, body, geometry)
            for axis in np.eye(5)
        ]
    ) / (2.0 * small)
    force = coriolis_matrix(coordinates[2], rates[2], body) @ rates
    assert force == pytest.approx(along - slope, abs=1e-7)


@pytest.mark.parametrize('seed', SEEDS)
def test_null_space_solves_the_constraint_and_gives_rates(seed):
    """(7), (8), E3. With the printed -d in the third row of (7) this product is not 0."""
    generator = np.random.default_rng(seed)
    _, geometry = random_robot(generator)
    yaw = generator.uniform(-3.0, 3.0)
    wheels = WheelSpeeds(*generator.uniform(-10.0, 10.0, 2))
    constraint, basis = constraint_matrix(yaw, geometry), null_space(yaw, geometry)
    assert np.linalg.matrix_rank(constraint) == 3
    assert constraint @ basis == pytest.approx(np.zeros((3, 2)), abs=1e-15)
    rates = basis @ np.array(wheels)
    assert rates[:3] == pytest.approx(pose_rate(yaw, wheels, geometry))
    assert rates[3:] == pytest.approx(wheels)
    printed = constraint.copy()
    printed[0, 2] = -0.02
    assert np.abs(printed @ basis).max() > 1e-4


@pytest.mark.parametrize('seed', SEEDS)
def test_reduction_of_the_full_matrices_is_the_closed_form(seed):
    """(9) and (10) with E3 give (11), (12) with E4, and (13)."""
    generator = np.random.default_rng(seed)
    body, geometry = random_robot(generator)
    yaw = generator.uniform(-3.0, 3.0)
    wheels = WheelSpeeds(*generator.uniform(-20.0, 20.0, 2))
    turn = twist_from_wheels(wheels, geometry).angular
    inertia, coriolis, torques = reduce_to_wheels(yaw, turn, body, geometry)
    assert inertia == pytest.approx(wheel_inertia(body, geometry), rel=1e-12)
    assert coriolis == pytest.approx(wheel_coriolis(wheels, body, geometry), abs=1e-14)
    assert torques == pytest.approx(np.eye(2))
    assert np.all(np.linalg.eigvalsh(inertia) > 0.0)


@pytest.mark.parametrize('seed', SEEDS)
def test_kernel_solves_the_reduced_equations_and_body_form(seed):
    """(10) and, with u1 = tau_R + tau_L and u2 = b (tau_R - tau_L), (15) with E5."""
    generator = np.random.default_rng(seed)
    body, geometry = random_robot(generator)
    wheels = WheelSpeeds(*generator.uniform(-20.0, 20.0, 2))
    torque = generator.uniform(-0.5, 0.5, 2)
    rates = np.array(wheel_acceleration(*wheels, *torque, dynamics_vector(body, geometry)))
    speeds = np.array(wheels)
    assert wheel_inertia(body, geometry) @ rates + wheel_coriolis(
        wheels, body, geometry
    ) @ speeds == pytest.approx(torque, abs=1e-12)

    twist = twist_from_wheels(wheels, geometry)
    push = twist_from_wheels(WheelSpeeds(*rates), geometry)
    inertia, coriolis, forces = body_dynamics(twist.angular, body, geometry)
    inputs = np.array([torque.sum(), geometry.half_separation * (torque[0] - torque[1])])
    assert inertia @ np.array(push) + coriolis @ np.array(twist) == pytest.approx(
        forces @ inputs, abs=1e-11
    )


@pytest.mark.parametrize('seed', SEEDS)
def test_kernel_agrees_with_the_unreduced_equations(seed):
    """(4) is independent of (12), whose printed factor gives another motion (E4)."""
    generator = np.random.default_rng(seed)
    body, geometry = random_robot(generator)
    yaw = generator.uniform(-3.0, 3.0)
    wheels = WheelSpeeds(*generator.uniform(-20.0, 20.0, 2))
    torque = generator.uniform(-0.5, 0.5, 2)
    coordinates = np.array([0.3, -0.2, yaw, 0.0, 0.0])
    rates = null_space(yaw, geometry) @ np.array(wheels)
    full, _ = constrained_acceleration(coordinates, rates, torque, body, geometry)
    dynamics = dynamics_vector(body, geometry)
    assert full[3:] == pytest.approx(
        wheel_acceleration(*wheels, *torque, dynamics), rel=1e-9, abs=1e-9
    )
    dynamics[4] /= geometry.half_separation
    printed = wheel_acceleration(*wheels, *torque, dynamics)
    assert np.abs(full[3:] - printed).max() > 1e-2 * np.abs(full[3:]).max()
    slip = constraint_matrix(yaw, geometry) @ full + constraint_rate(yaw, rates[2]) @ rates
    assert slip == pytest.approx(np.zeros(3), abs=1e-10)


def test_energy_is_conserved_to_integrator_order():
    """E4, first half: energy is conserved, with the printed factor as well.

    The matrix of (12) is skew with any factor, so this test does not distinguish the factors; the
    one with the unreduced equations does.
    """
    body, geometry = BodyParameters(com_offset=0.05), WheelGeometry()
    dynamics = dynamics_vector(body, geometry)
    printed = dynamics.copy()
    printed[4] = coriolis_factor(body, geometry) / geometry.half_separation
    start = np.array([150.0, -90.0])
    before = kinetic_energy(WheelSpeeds(*start), body, geometry)

    def drift(step: float, vector: np.ndarray) -> float:
        end = runge_kutta(reduced_rate(vector), start, step, round(0.4 / step))
        return abs(kinetic_energy(WheelSpeeds(*end), body, geometry) / before - 1.0)

    assert math.log2(drift(0.004, dynamics) / drift(0.002, dynamics)) > 3.9
    assert drift(0.001, dynamics) < 1e-8
    assert drift(0.0001, printed) < 1e-7
    # All rotation becomes translation, centre of mass first.
    end = runge_kutta(reduced_rate(dynamics), start, 0.001, 2000)
    assert abs(end[0] - end[1]) < 1e-3 * abs(start[0] - start[1])
    assert end.sum() > 0.0
