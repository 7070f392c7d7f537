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
"""Equations of the paper written out, which the package computes in another way, and oracles.

The generalised coordinates of (4)-(15) are those of ``t3mpc_ros.simulation.plant.dynamics``.
"""

import math

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from t3mpc_ros.chaos.system_equations import QuadraticSystem, Terms, right_hand_side
from t3mpc_ros.fuzzy.inference import LOWER, UPPER, FuzzySets, fuzzify, square_distances
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import Pose, WheelSpeeds
from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.boltzmann_machine import solve_lower, solve_upper
from t3mpc_ros.simulation.plant.dynamics import BodyParameters, coriolis_factor, wheel_inertia

Array = npt.NDArray[np.float64]


def pose_rate(yaw: float, wheels: WheelSpeeds, geometry: WheelGeometry) -> Pose:
    """Return (x', y', P') in m/s, m/s and rad/s, equations (2)-(3) with E1."""
    twist = twist_from_wheels(wheels, geometry)
    return Pose(twist.linear * math.cos(yaw), twist.linear * math.sin(yaw), twist.angular)


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

    ``torque`` is that of the wheels minus friction and disturbance, right first (N m); gamma are
    the side force and both rolling forces (N).
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


@kernel
def memberships(
    inputs: Array, centres: Array, nonsingleton_gain: Array, sharpness: Array, grades: Array
) -> None:
    r"""Write the grades :math:`\zeta = \exp(-((x^* - o)/\beta)^2)`, (16)-(23) with E7.

    They are (20) and (21) for the upper width at upper and lower level, (22) and (23) for the
    lower width. A control step uses :func:`relative_memberships` instead, which cannot underflow.
    Arguments as in :func:`fuzzify` and :func:`square_distances`; ``grades`` is overwritten.
    """
    fuzzify(inputs, centres, nonsingleton_gain, grades)
    square_distances(grades, centres, sharpness, grades)
    flat = grades.reshape(-1)
    for k in range(flat.size):
        flat[k] = math.exp(-flat[k])


def output_by_double_sum(inputs: Array, sets: FuzzySets, lower: Array, upper: Array) -> float:
    r"""Return the output as the double sum over slices and rules, equation (29) with E7 and E8.

    .. math:: y = \frac{1}{\sum_j(\underline\varsigma_j + \bar\varsigma_j)}
        \sum_j\left(\bar\varsigma_j
        \frac{\sum_l(\bar\Omega^l_{\bar\varsigma_j} + \underline\Omega^l_{\bar\varsigma_j})
        \bar\alpha_{l,j}}{\sum_l(\bar\Omega^l_{\bar\varsigma_j} +
        \underline\Omega^l_{\bar\varsigma_j})} + \underline\varsigma_j\frac{\cdots}{\cdots}\right)

    E8: each slice is a mean of the coefficients weighted by the firing strengths, hence without
    the printed 1/2, and the slices are averaged with their levels as weights. An independent,
    literal implementation that checks (31)-(33): too slow for a control step, and 0/0 far outside
    the centres, where every firing strength underflows. ``lower`` and ``upper`` are the rule
    coefficients at these levels, shape (r, lambda) each, rad/s².
    """
    n, per_input = sets.centres.shape

    def firing(rule: int, j: int, level: int, bound: int) -> float:
        product = 1.0
        for i in range(n):
            h = rule // per_input ** (n - 1 - i) % per_input
            o = float(sets.centres[i, h])
            beta = float(sets.widths[i, h, j, level, bound])
            beta_u = sets.input_fuzziness
            x = (float(inputs[i]) * beta**2 + o * beta_u**2) / (beta**2 + beta_u**2)  # (16)-(19)
            product *= math.exp(-(((x - o) / beta) ** 2))  # (20)-(23) with E7, (24)-(27)
        return product

    numerator = 0.0
    for j in range(sets.slices):
        for level, alpha in ((UPPER, upper), (LOWER, lower)):
            weighted = total = 0.0
            for rule in range(sets.rules):
                both = firing(rule, j, level, UPPER) + firing(rule, j, level, LOWER)
                weighted += both * float(alpha[rule, j])
                total += both
            numerator += float(sets.levels[j, level]) * weighted / total
    return numerator / float(sets.levels.sum())


@kernel
def cost(
    matrix: Array, free: Array, changes: Array, error_weight: float, move_weight: float
) -> float:
    """Return J = mu PsiᵀPsi + pi dvᵀdv, equations (34) and (60), in units of the weights."""
    total = 0.0
    for j in range(free.size):
        psi = free[j]
        for i in range(changes.size):
            psi += matrix[j, i] * changes[i]
        total += error_weight * psi * psi
    for i in range(changes.size):
        total += move_weight * changes[i] * changes[i]
    return total


@kernel
def unconstrained_optimum(lower: Array, gradient: Array, changes: Array) -> None:
    """Write dv = -mu (mu SᵀS + pi I)⁻¹ SᵀPsi_free, equation (62) with E10.

    E10: the printed right-hand side lacks the minus sign that follows from (61).

    lower   : Cholesky factor of the Hessian
    gradient : mu SᵀPsi_free
    changes : shape (n_c,), overwritten (rad/s²)
    """
    for i in range(changes.size):
        changes[i] = -gradient[i]
    solve_lower(lower, changes)
    solve_upper(lower, changes)


@kernel
def energy(visible_weights: Array, eta: Array, mu: Array) -> float:
    """Return E(eta, mu) = -etaᵀ X_v mu, equation (42); dimensionless."""
    total = 0.0
    for i in range(eta.size):
        for j in range(mu.size):
            total -= eta[i] * visible_weights[i, j] * mu[j]
    return total


@kernel
def free_energy(visible_weights: Array, eta: Array) -> float:
    """Return F(eta) = -ln of the sum of exp(-E/2) over every mu in {-1, 1}^hidden.

    (42) does not couple the hidden units, so the sum is a product of 2 cosh(X_vᵀ eta / 2).
    """
    total = 0.0
    for j in range(visible_weights.shape[1]):
        y = 0.0
        for i in range(eta.size):
            y += visible_weights[i, j] * eta[i]
        # ln(2 cosh(y/2)) without overflow.
        total -= 0.5 * abs(y) + math.log1p(math.exp(-abs(y)))
    return total


def boltzmann_distribution(energies: Array) -> Array:
    """Return the Boltzmann probability of each state, exp(-E/2) / sum exp(-E/2), (41) with E9.

    E9: the printed J' = delta^E / E is no distribution. The temperature is 2 because Xi (40),
    the tanh of *half* its argument, is the mean of a unit in {-1, 1} at exactly that
    temperature; at temperature 1 the passes (36)-(39) do not sample from (41). The temperature
    only scales X_v, and gamma in (43). ``energies`` are those of every possible state, (42).
    """
    weights: Array = np.exp(-0.5 * (energies - energies.min()))
    weights /= weights.sum()
    return weights


@kernel
def forced_response(step: Array, changes: Array, ahead: int) -> float:
    r"""Return delta_hat_forced(t + ahead), equation (47) with E11, in rad/s.

    .. math:: \sum_{\iota=0}^{j-1} s_\iota\, \Delta v_p(t + j - \iota - 1)

    E11: with the printed index t + j - iota + 1 moves would act before they are made.

    step    : shape (n_p,), s_0 ...
    changes : shape (n_c,), changes of v_p at t, t+1, ... (rad/s²), zero after the last
    ahead   : j, from 1 to n_p
    """
    total = 0.0
    for i in range(ahead):
        if ahead - i - 1 < changes.size:
            total += step[i] * changes[ahead - i - 1]
    return total


def lyapunov_value(errors: Array, coefficient_errors: Array, adaptation_gain: float) -> float:
    """Return V of equation (74), rad²/s²: half of |delta|² plus |alpha* - alpha|²/(2 gamma).

    Along the closed loop V' is (75), the sum of delta delta' - alpha~ alpha'/gamma. With the law
    it becomes (76), and (79) if the coefficients follow (77)-(78). Errors delta in rad/s, alpha~
    in rad/s², gain gamma in 1/s².
    """
    squares = float(np.sum(coefficient_errors**2))
    return 0.5 * float(errors @ errors) + squares / (2.0 * adaptation_gain)


def linear_decay_system(order: float) -> QuadraticSystem:
    """Return D^q y = -y, whose solution from 1 is the Mittag-Leffler function E_q(-t^q)."""
    return QuadraticSystem((order,), linear=((0, 0, -1.0),))


def interval_weights(order: float, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r"""Return the product-trapezoid weights of the older and the newer end of past intervals.

    Entry m belongs to the interval of lags [m, m + 1], in units of the step:

    .. math:: \text{older}_m = \frac{1}{\Gamma(q)} \int_m^{m+1} u^{q-1} (u - m)\,du, \qquad
              \text{newer}_m = \frac{1}{\Gamma(q)} \int_m^{m+1} u^{q-1} (m + 1 - u)\,du

    The closed form is a difference of powers that loses digits like m^2. Beyond the first
    interval the integrand is smooth, so 14 Gauss points integrate it to rounding. Both have the
    shape (count,), to be multiplied by step**order.
    """
    older = np.empty(count)
    newer = np.empty(count)
    older[:1] = order / math.gamma(order + 2.0)
    newer[:1] = 1.0 / math.gamma(order + 2.0)
    if count > 1:
        nodes, shares = np.polynomial.legendre.leggauss(14)
        nodes = 0.5 * (nodes + 1.0)
        shares = 0.5 * shares / math.gamma(order)
        lag = np.arange(1.0, count)[:, None] + nodes
        older[1:] = (lag ** (order - 1.0) * nodes) @ shares
        newer[1:] = (lag ** (order - 1.0) * (1.0 - nodes)) @ shares
    return older, newer


def solve_full_memory(
    system: QuadraticSystem, step: float, initial: NDArray[np.float64], steps: int
) -> NDArray[np.float64]:
    """Return the states at each step (s) from 0 on, from every past slope, (steps + 1, d)."""
    older = np.empty((steps, system.size))
    newer = np.empty((steps, system.size))
    rectangle = np.empty(system.size)
    for state, order in enumerate(system.orders):
        ends = interval_weights(order, steps)
        older[:, state] = step**order * ends[0]
        newer[:, state] = step**order * ends[1]
        rectangle[state] = step**order / math.gamma(order + 1.0)
    states = np.empty((steps + 1, system.size))
    states[0] = initial
    _integrate_full_memory(
        system.terms(),
        older,
        newer,
        rectangle,
        np.empty((steps + 1, system.size)),
        np.empty((steps + 1, system.size)),
        states,
        np.empty(system.size),
    )
    return states


@kernel
def _integrate_full_memory(
    terms: Terms,
    older: NDArray[np.float64],
    newer: NDArray[np.float64],
    rectangle: NDArray[np.float64],
    slopes: NDArray[np.float64],
    predicted: NDArray[np.float64],
    states: NDArray[np.float64],
    guess: NDArray[np.float64],
) -> None:
    """Write ``states`` after its given first row.

    older, newer      : shape (N, d), weights by lag, scaled by the step
    rectangle         : shape (d,), the predictor's weight of the newest slope
    slopes, predicted : shape (N + 1, d), work space; f at the corrected and the predicted state
    states            : shape (N + 1, d), first row given
    guess             : shape (d,), work space
    """
    right_hand_side(terms, states[0], slopes[0])
    for n in range(states.shape[0] - 1):
        for i in range(guess.size):
            past = 0.0
            for j in range(n):
                past += older[n - j, i] * slopes[j, i] + newer[n - j, i] * predicted[j + 1, i]
            guess[i] = states[0, i] + past + rectangle[i] * slopes[n, i]
            states[n + 1, i] = states[0, i] + past + older[0, i] * slopes[n, i]
        right_hand_side(terms, guess, predicted[n + 1])
        for i in range(guess.size):
            states[n + 1, i] += newer[0, i] * predicted[n + 1, i]
        right_hand_side(terms, states[n + 1], slopes[n + 1])
