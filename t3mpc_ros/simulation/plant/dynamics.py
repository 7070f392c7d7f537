# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Lagrangian dynamics of a differential drive, equations (4)-(15) with E2-E5.

The generalised coordinates are q = (x, y, P, theta_R, theta_L): (x, y) is the middle of the
wheel axle in the world frame (m), P the yaw (rad), and the thetas are the angles turned by the
wheels (rad). chi = (theta_R', theta_L') are the wheel speeds (rad/s), right first.

E16: only the body is off the axle, the wheels are not: every first moment of mass is m_c d. The
printed (5) and (6) have m d, which is the same number when d there means the distance to the
centre of mass of the *whole* robot; with the d of (14) it must be m_c d, and only then does the
reduction give (12).
"""

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = npt.NDArray[np.float64]


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


def inertia_matrix(yaw: float, body: BodyParameters, geometry: WheelGeometry) -> Array:
    """Return theta(q) of (5) with E2: shape (5, 5), symmetric, positive definite.

    E2: entry (2, 2) is m, not 0: the robot has mass along y as well as along x. E16: the offset
    terms carry m_c, not m.
    """
    mass, moment = body.total_mass, body.body_mass * body.com_offset
    result = np.zeros((5, 5))
    result[0, 0] = result[1, 1] = mass
    result[0, 2] = result[2, 0] = -moment * math.sin(yaw)
    result[1, 2] = result[2, 1] = moment * math.cos(yaw)
    result[2, 2] = body.total_inertia(geometry)
    result[3, 3] = result[4, 4] = body.wheel_inertia
    return result


def coriolis_matrix(yaw: float, yaw_rate: float, body: BodyParameters) -> Array:
    """Return eta(q, q') of (6) with E2: shape (5, 5), so that eta q' is the centrifugal force.

    E2: the terms are in the third column and carry P', because they derive from P'^2. E16: they
    carry m_c, not m.
    """
    pull = body.body_mass * body.com_offset * yaw_rate
    result = np.zeros((5, 5))
    result[0, 2] = -pull * math.cos(yaw)
    result[1, 2] = -pull * math.sin(yaw)
    return result


def input_matrix() -> Array:
    """Return W of (4): shape (5, 2); the torques act on the wheel angles."""
    result = np.zeros((5, 2))
    result[3, 0] = result[4, 1] = 1.0
    return result


def constraint_matrix(yaw: float, geometry: WheelGeometry) -> Array:
    """Return Q of (7), shape (3, 5): Q q' = 0 means no side slip, both wheels roll.

    E15: the printed first column holds -d in its third row, which belongs to coordinates at the
    centre of mass. Here (x, y) is on the axle, as (5) and (8) have it, so that entry is 0; with
    -d the null space (8) would not be one.
    """
    sine, cosine = math.sin(yaw), math.cos(yaw)
    half, radius = geometry.half_separation, geometry.wheel_radius
    return np.array(
        [
            [-sine, cosine, 0.0, 0.0, 0.0],
            [cosine, sine, half, -radius, 0.0],
            [cosine, sine, -half, 0.0, -radius],
        ]
    )


def constraint_rate(yaw: float, yaw_rate: float) -> Array:
    """Return the time derivative of (7), shape (3, 5), in 1/s."""
    sine, cosine = yaw_rate * math.sin(yaw), yaw_rate * math.cos(yaw)
    result = np.zeros((3, 5))
    result[0, :2] = -cosine, -sine
    result[1, :2] = result[2, :2] = -sine, cosine
    return result


def null_space(yaw: float, geometry: WheelGeometry) -> Array:
    """Return varsigma of (8), shape (5, 2), with q' = varsigma chi.

    E3: the paper prints chi' = varsigma chi; varsigma maps the wheel speeds to q'.
    """
    half_radius = 0.5 * geometry.wheel_radius
    turn = half_radius / geometry.half_separation
    along, across = half_radius * math.cos(yaw), half_radius * math.sin(yaw)
    return np.array([[along, along], [across, across], [turn, -turn], [1.0, 0.0], [0.0, 1.0]])


def null_space_rate(yaw: float, yaw_rate: float, geometry: WheelGeometry) -> Array:
    """Return the time derivative of varsigma (8), shape (5, 2), in m/s and 1/s."""
    speed = 0.5 * geometry.wheel_radius * yaw_rate
    result = np.zeros((5, 2))
    result[0] = -speed * math.sin(yaw)
    result[1] = speed * math.cos(yaw)
    return result


def reduce_to_wheels(
    yaw: float, yaw_rate: float, body: BodyParameters, geometry: WheelGeometry
) -> tuple[Array, Array, Array]:
    """Return (theta_bar, eta_bar, W_bar) of (10), each (2, 2), by projecting (4) as in (9).

    E3: in (9) it is eta varsigma chi; the paper omits chi. The multipliers vanish because
    varsigma^T Q^T = 0. The last one is the identity (13).
    """
    basis = null_space(yaw, geometry)
    basis_rate = null_space_rate(yaw, yaw_rate, geometry)
    inertia = inertia_matrix(yaw, body, geometry)
    coriolis = coriolis_matrix(yaw, yaw_rate, body)
    return (
        basis.T @ inertia @ basis,
        basis.T @ (inertia @ basis_rate + coriolis @ basis),
        basis.T @ input_matrix(),
    )


def constrained_acceleration(
    coordinates: Array, rates: Array, torque: Array, body: BodyParameters, geometry: WheelGeometry
) -> tuple[Array, Array]:
    """Return (q'', gamma) of (4): the unreduced equations solved with their multipliers.

    The plant does not run on these; they check the reduction.

    Parameters
    ----------
    coordinates, rates
        q and q', shape (5,).
    torque
        Wheel torques minus friction and disturbance, right first, shape (2,), N m.

    Returns
    -------
    q'' of shape (5,) and gamma of shape (3,): side force (N), rolling forces (N).
    """
    yaw, yaw_rate = float(coordinates[2]), float(rates[2])
    constraint = constraint_matrix(yaw, geometry)
    system = np.block(
        [[inertia_matrix(yaw, body, geometry), constraint.T], [constraint, np.zeros((3, 3))]]
    )
    force = input_matrix() @ torque - coriolis_matrix(yaw, yaw_rate, body) @ rates
    pull = -constraint_rate(yaw, yaw_rate) @ rates
    solution = np.linalg.solve(system, np.concatenate([force, pull]))
    return solution[:5], solution[5:]


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


def wheel_coriolis(wheels: WheelSpeeds, body: BodyParameters, geometry: WheelGeometry) -> Array:
    """Return eta_bar of (12) with E4: c P' [[0, 1], [-1, 0]], in N m s/rad."""
    rate = 0.5 * geometry.wheel_radius * (wheels.right - wheels.left) / geometry.half_separation
    pull = coriolis_factor(body, geometry) * rate
    return np.array([[0.0, pull], [-pull, 0.0]])


def kinetic_energy(wheels: WheelSpeeds, body: BodyParameters, geometry: WheelGeometry) -> float:
    """Return half chi^T theta_bar chi in J; constant while no torque acts."""
    speeds = np.array(wheels)
    return float(0.5 * speeds @ wheel_inertia(body, geometry) @ speeds)


def body_dynamics(
    angular: float, body: BodyParameters, geometry: WheelGeometry
) -> tuple[Array, Array, Array]:
    """Return the inertia, Coriolis and input matrices of (15) with E5, each (2, 2).

    They appear in ``inertia (v', omega') + coriolis (v, omega) = input (u1, u2)`` with
    u1 = tau_R + tau_L and u2 = b (tau_R - tau_L), both in N m and N m².

    E5: the printed first matrix repeats (12); the inertia in (v, omega) is
    diag(m + 2 I_w/R^2, I + 2 b^2 I_w/R^2).
    """
    radius, half = geometry.wheel_radius, geometry.half_separation
    rolling = 2.0 * body.wheel_inertia / radius**2
    pull = body.body_mass * body.com_offset * angular
    return (
        np.diag([body.total_mass + rolling, body.total_inertia(geometry) + half**2 * rolling]),
        np.array([[0.0, -pull], [pull, 0.0]]),
        np.diag([1.0 / radius, 1.0 / radius]),
    )


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
