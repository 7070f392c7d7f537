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
r"""Dynamics of a differential drive on its wheels, equations (10)-(14), with E2-E5 and E16.

The generalised coordinates are q = (x, y, P, theta_R, theta_L): (x, y) is the middle of the
wheel axle in the world frame (m), P the yaw (rad), and the thetas are the angles turned by the
wheels (rad). chi = (theta_R', theta_L') are the wheel speeds (rad/s), right first.

E16: only the body is off the axle, the wheels are not: every first moment of mass is m_c d. The
printed (5) and (6) have m d, which is the same number when d there means the distance to the
centre of mass of the *whole* robot; with the d of (14) it must be m_c d, and only then does the
reduction give (12).
"""

from dataclasses import dataclass

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class BodyParameters(Parameters):
    """Masses and inertias of (14)."""

    body_mass: float = parameter(1.3, 'mass of the body without wheels, m_c', 'kg', (0.01, 1000.0))
    wheel_mass: float = parameter(0.10, 'mass of one wheel, m_w', 'kg', (0.0, 100.0))
    body_inertia: float = parameter(
        0.02,
        'inertia of the body about the vertical through its centre of mass, I_c',
        'kg m²',
        (1e-6, 1000.0),
    )
    wheel_inertia: float = parameter(
        6e-5, 'inertia of one wheel about its axle, I_w', 'kg m²', (1e-8, 10.0)
    )
    wheel_turn_inertia: float = parameter(
        3e-5, 'inertia of one wheel about its diameter, I_m', 'kg m²', (0.0, 10.0)
    )
    com_offset: float = parameter(
        0.02, 'distance of the centre of mass of the body ahead of the axle, d', 'm', (-1.0, 1.0)
    )

    @property
    def total_mass(self) -> float:
        """Total mass m of (14), in kg."""
        return self.body_mass + 2.0 * self.wheel_mass

    def total_inertia(self, geometry: WheelGeometry) -> float:
        """Return I of (14) about the middle of the axle, in kg m²."""
        return (
            self.body_inertia
            + self.body_mass * self.com_offset**2
            + 2.0 * self.wheel_mass * geometry.half_separation**2
            + 2.0 * self.wheel_turn_inertia
        )


def wheel_inertia(body: BodyParameters, geometry: WheelGeometry) -> Array:
    r"""Return theta_bar of (11), shape (2, 2), kg m².

    .. math:: I_w + k(m b^2 + I) \text{ on the diagonal},\quad k(m b^2 - I) \text{ beside it},
              \quad k = R^2/(4 b^2)
    """
    half = geometry.half_separation
    ratio = (0.5 * geometry.wheel_radius / half) ** 2
    straight, turning = body.total_mass * half**2, body.total_inertia(geometry)
    diagonal = body.wheel_inertia + ratio * (straight + turning)
    beside = ratio * (straight - turning)
    return np.array([[diagonal, beside], [beside, diagonal]])


def coriolis_factor(body: BodyParameters, geometry: WheelGeometry) -> float:
    """Return c = R^2 m_c d / (2 b) of (12), in kg m².

    E4: the paper divides by 2 b^2, which lacks the unit of an inertia. Energy does not
    distinguish the two (the matrix is skew either way); the unreduced equations (4) do.
    """
    moment = body.body_mass * body.com_offset
    return geometry.wheel_radius**2 * moment / geometry.wheel_separation


def dynamics_vector(body: BodyParameters, geometry: WheelGeometry) -> Array:
    """Return the constants of :func:`wheel_acceleration`, shape (5,).

    R (m), R/(2b) (1), diagonal and off-diagonal entry of (11) (kg m²), c of (12) (kg m²).
    """
    inertia = wheel_inertia(body, geometry)
    return np.array(
        [
            geometry.wheel_radius,
            0.5 * geometry.wheel_radius / geometry.half_separation,
            inertia[0, 0],
            inertia[0, 1],
            coriolis_factor(body, geometry),
        ]
    )


@kernel
def wheel_acceleration(
    right: float, left: float, torque_right: float, torque_left: float, dynamics: Array
) -> tuple[float, float]:
    """Return chi' of (10), rad/s²: theta_bar^-1 (torque - eta_bar chi).

    right, left : wheel speeds chi, rad/s
    torque_* : drive torque less friction and disturbance (tau - f - tau_d), N m; (13) is identity
    dynamics : shape (5,), see :func:`dynamics_vector`
    """
    diagonal, beside, coriolis = dynamics[2], dynamics[3], dynamics[4]
    pull = coriolis * dynamics[1] * (right - left)
    net_right = torque_right - pull * left
    net_left = torque_left + pull * right
    determinant = (diagonal - beside) * (diagonal + beside)
    return (
        (diagonal * net_right - beside * net_left) / determinant,
        (diagonal * net_left - beside * net_right) / determinant,
    )
