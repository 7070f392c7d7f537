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
"""Drivetrain: Newton, momentum and energy, rolling and sliding."""

import math

import numpy as np
import pytest
from support.constants import with_constants

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.obstacles import Obstacles
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.plant.bumper_contact import BumperParameters
from t3mpc_ros.simulation.plant.disturbances import (
    Disturbance,
    DisturbanceParameters,
    FrictionParameters,
)
from t3mpc_ros.simulation.plant.drivetrain import (
    ROLLING,
    Drivetrain,
    Load,
    TyreParameters,
    begin_rolling,
    body_constants,
    loses_grip,
    mean_pulses,
    mean_rate,
    state_derivative,
    stops_sliding,
)
from t3mpc_ros.simulation.plant.dynamics import (
    BodyParameters,
    coriolis_factor,
    dynamics_vector,
    wheel_acceleration,
    wheel_inertia,
)
from t3mpc_ros.simulation.plant.stepper_motor import StepperMotorParameters
from t3mpc_ros.simulation.world import load_world

GEOMETRY = WheelGeometry()
BODY = BodyParameters(com_offset=0.03)
MOTOR = StepperMotorParameters()
NO_FRICTION = FrictionParameters(viscous=0.0, coulomb=0.0)
RADIUS, HALF = GEOMETRY.wheel_radius, GEOMETRY.half_separation
BUMPER = BumperParameters().constants()
NOWHERE = Obstacles(np.zeros((0, 4)), np.zeros((0, 3)))
VOLTS = 12.0
OWN = BODY.wheel_inertia


def rates(state, modes, torque, grip=1e9):
    slope, pushed = np.zeros(9), np.zeros(3)
    tyres = np.array([OWN, OWN, grip, grip])
    state_derivative(
        state,
        np.array(modes, dtype=np.int64),
        np.array(torque),
        body_constants(BODY, GEOMETRY),
        tyres,
        BUMPER,
        NOWHERE,
        slope,
        pushed,
    )
    return slope, pushed


def random_state(generator):
    state = generator.uniform(-5.0, 5.0, 9)
    state[5:7] = state[7:9]  # both tyres roll
    return state


def drivetrain(
    *,
    grip: float = 5.0,
    grip_factor: float = 1.0,
    friction: FrictionParameters = NO_FRICTION,
    motor: StepperMotorParameters = MOTOR,
    step: float = 0.001,
    blocked: tuple[bool, bool] = (False, False),
) -> Drivetrain:
    made = Drivetrain(motor, BumperParameters(), load_world(''), step, 0.1)
    made.load(motor, load(grip=grip, grip_factor=grip_factor, friction=friction, blocked=blocked))
    return made


def load(
    *,
    grip: float = 5.0,
    grip_factor: float = 1.0,
    friction: FrictionParameters = NO_FRICTION,
    blocked: tuple[bool, bool] = (False, False),
) -> Load:
    tyres = with_constants(TyreParameters, load_share=1.0)(grip=grip)
    return Load(BODY, GEOMETRY, friction, 1.0, tyres, grip_factor, blocked)


def calm() -> Disturbance:
    return Disturbance(DisturbanceParameters(bound=0.0), np.random.default_rng(1))


def kinetic(robot: Drivetrain, motor: StepperMotorParameters = MOTOR) -> float:
    """Energy (J) of body and wheels."""
    ground, wheels = np.array(robot.ground), np.array(robot.wheels)
    inertia = wheel_inertia(BODY, GEOMETRY) - BODY.wheel_inertia * np.eye(2)
    own = BODY.wheel_inertia + motor.rotor_inertia
    return float(0.5 * ground @ inertia @ ground + 0.5 * own * wheels @ wheels)


def magnetic(robot: Drivetrain, motor: StepperMotorParameters = MOTOR) -> float:
    """Energy (J) of the rotors in fields at rest."""
    peak = motor.torque_constant * motor.phase_current
    return sum(
        peak / motor.teeth * (1.0 - math.cos(motor.teeth * angle)) for angle in robot.load_angles
    )


def swinging(motor: StepperMotorParameters, step: float) -> Drivetrain:
    """Return a drivetrain whose rotors oscillate in fields that have just stopped."""
    robot = drivetrain(motor=motor, step=step)
    for _ in range(round(0.02 / step)):
        robot.run(WheelSpeeds(2.0, -1.2), 0.0, VOLTS, calm(), 1)
    robot.run(WheelSpeeds(0.0, 0.0), 0.0, VOLTS, calm(), 2)
    return robot


# -- pulses ---------------------------------------------------------------------------------------


def test_mean_field_position_is_that_of_the_staircase():
    generator = np.random.default_rng(8)
    for _ in range(30):
        start, way = generator.uniform(-5.0, 5.0), generator.uniform(-7.0, 7.0)
        fine = np.floor(start + way * (np.arange(200_000) + 0.5) / 200_000)
        assert mean_pulses(start, start + way) == pytest.approx(fine.mean(), abs=2e-4)
    assert mean_pulses(2.3, 2.3) == 2.0
    assert mean_pulses(-2.3, -2.3) == -3.0


def test_mean_rate_holds_the_target_once_reached():
    """Counted as a whole step, a ramp that ends within a step would depend on the step."""
    for rate, target, reach in ((0.0, 10.0, 40.0), (3.0, -5.0, 16.0), (2.0, 50.0, 12.0)):
        times = (np.arange(100_000) + 0.5) / 100_000
        way = target - rate
        courses = rate + np.sign(way) * np.minimum(reach * times, abs(way))
        assert mean_rate(rate, target, abs(way) / reach) == pytest.approx(courses.mean(), abs=1e-4)


# -- Newton ---------------------------------------------------------------------------------------


def test_rolling_tyres_reproduce_equation_10():
    generator = np.random.default_rng(1)
    dynamics = dynamics_vector(BODY, GEOMETRY)
    for _ in range(20):
        state, torque = random_state(generator), generator.uniform(-1.0, 1.0, 2)
        slope, _ = rates(state, (ROLLING, ROLLING), torque)
        expected = wheel_acceleration(state[5], state[6], torque[0], torque[1], dynamics)
        np.testing.assert_allclose(slope[5:7], expected, rtol=1e-10, atol=1e-9)
        np.testing.assert_array_equal(slope[5:7], slope[7:9])


@pytest.mark.parametrize('modes', [(0, 0), (1, 0), (0, -1), (1, -1), (-1, -1)])
def test_body_follows_newton_euler_with_tyre_forces(modes):
    """Newton and Euler of the body: m v' - m_c d w² = F_R + F_L, and the same for turning."""
    generator = np.random.default_rng(2)
    mass, moment = BODY.total_mass, BODY.body_mass * BODY.com_offset
    for _ in range(10):
        state, torque = random_state(generator), generator.uniform(-1.0, 1.0, 2)
        grip = 2.0
        slope, pushed = rates(state, modes, torque, grip)
        force = pushed[:2] / RADIUS
        speed, angular = (
            0.5 * RADIUS * sum(state[7:9]),
            0.5 * RADIUS / HALF * (state[7] - state[8]),
        )
        gain, turning = 0.5 * RADIUS * sum(slope[7:9]), 0.5 * RADIUS / HALF * (slope[7] - slope[8])
        assert mass * gain - moment * angular**2 == pytest.approx(force.sum(), abs=1e-8)
        inertia = BODY.total_inertia(GEOMETRY)
        assert inertia * turning + moment * speed * angular == pytest.approx(
            HALF * (force[0] - force[1]), abs=1e-8
        )
        for wheel, mode in enumerate(modes):
            if mode != ROLLING:
                assert force[wheel] == pytest.approx(mode * grip)
            own = torque[wheel] - OWN * slope[5 + wheel]
            assert pushed[wheel] == pytest.approx(own, abs=1e-8)


def test_begin_rolling_keeps_momentum_and_dissipates_energy():
    generator = np.random.default_rng(3)
    inertia = wheel_inertia(BODY, GEOMETRY) - BODY.wheel_inertia * np.eye(2)
    tyres = np.array([OWN, OWN, 1.0, 1.0])
    for modes in ((1, 0), (0, -1), (1, -1), (-1, 1)):
        for _ in range(20):
            state = generator.uniform(-5.0, 5.0, 9)
            for wheel, mode in enumerate(modes):
                if mode == ROLLING:
                    state[5 + wheel] = state[7 + wheel]
                else:  # the sliding speed has just crossed zero
                    state[5 + wheel] = state[7 + wheel] - mode * 0.01
            before = inertia @ state[7:9] + OWN * state[5:7]
            energy = 0.5 * state[7:9] @ inertia @ state[7:9] + 0.5 * OWN * state[5:7] @ state[5:7]
            now = np.array(modes, dtype=np.int64)
            assert stops_sliding(state, now)
            begin_rolling(state, now, body_constants(BODY, GEOMETRY), tyres)
            np.testing.assert_array_equal(now, (ROLLING, ROLLING))
            np.testing.assert_array_equal(state[5:7], state[7:9])
            np.testing.assert_allclose(inertia @ state[7:9] + OWN * state[5:7], before, rtol=1e-12)
            after = 0.5 * state[7:9] @ inertia @ state[7:9] + 0.5 * OWN * state[5:7] @ state[5:7]
            assert after <= energy + 1e-15


def test_tyre_slides_beyond_its_grip_in_the_pushed_direction():
    body = body_constants(BODY, GEOMETRY)
    tyres = np.array([OWN, OWN, 2.0, 2.0])
    for force, mode in ((1.999, 0), (2.001, 1), (-2.001, -1)):
        modes = np.zeros(2, dtype=np.int64)
        assert loses_grip(modes, np.array([RADIUS * force, 0.0, 0.0]), body, tyres) == (mode != 0)
        assert modes.tolist() == [mode, 0]


# -- energy ---------------------------------------------------------------------------------------


def test_undamped_swing_keeps_energy_to_order_four():
    """Without friction the sum of kinetic and magnetic energy is constant to order 4."""
    motor = with_constants(StepperMotorParameters, damping=0.0)(microsteps=256)
    errors = []
    for step in (0.004, 0.002, 0.001):
        robot = swinging(motor, 0.0005)
        coarse = drivetrain(motor=motor, step=step)
        coarse._state[:], coarse._field[:] = robot._state, robot._field
        coarse._read()
        start = kinetic(coarse) + magnetic(coarse)
        assert start > 1e-5
        for _ in range(round(0.4 / step)):
            coarse.run(WheelSpeeds(0.0, 0.0), 0.0, VOLTS, calm(), 1)
        errors.append(abs(kinetic(coarse) + magnetic(coarse) - start) / start)
    assert errors[2] < 1e-5
    assert errors[0] / errors[1] > 12.0
    assert errors[1] / errors[2] > 12.0


def test_damping_and_friction_only_dissipate_energy():
    robot = swinging(StepperMotorParameters(microsteps=256), 0.0005)
    robot.load(StepperMotorParameters(microsteps=256), load(friction=FrictionParameters()))
    energy = kinetic(robot) + magnetic(robot)
    for _ in range(1500):
        robot.run(WheelSpeeds(0.0, 0.0), 0.0, VOLTS, calm(), 2)
        now = kinetic(robot) + magnetic(robot)
        assert now <= energy + 1e-12
        energy = now
    assert energy < 1e-6


def test_field_work_equals_energy_gain():
    """Fields of 256 microsteps turn almost smoothly: their work is the energy of the robot."""
    motor = with_constants(StepperMotorParameters, damping=0.0)(microsteps=256)
    robot = drivetrain(motor=motor, step=0.00025)
    for _ in range(400):
        robot.run(WheelSpeeds(6.0, 3.0), 15.0, VOLTS, calm(), 4)
    gained = kinetic(robot, motor) + magnetic(robot, motor)
    assert gained > 0.02
    assert robot.field_work == pytest.approx(gained, rel=0.003)


def test_sliding_energy_loss_equals_tyre_friction_work():
    """Both wheels are blocked at speed: tyre friction dissipates the energy of the body."""
    robot = drivetrain(grip=0.6)
    for _ in range(100):
        robot.run(WheelSpeeds(8.0, 8.0), 30.0, VOLTS, calm(), 10)
    speed = RADIUS * robot.ground.right
    body = 0.5 * BODY.total_mass * speed**2
    robot.load(MOTOR, load(grip=0.6, blocked=(True, True)))
    for _ in range(100):
        robot.run(WheelSpeeds(8.0, 8.0), 30.0, VOLTS, calm(), 10)
    force = 0.6 * 9.81 * BODY.total_mass  # of both tyres together
    assert tuple(robot.ground) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert np.mean(robot.slid) == pytest.approx(body / force, rel=0.01)
    assert np.mean(robot.slid) == pytest.approx(speed**2 / (2.0 * 0.6 * 9.81), rel=0.01)


# -- momentum -------------------------------------------------------------------------------------


def test_without_grip_wheels_spin_and_the_body_keeps_its_energy():
    robot = drivetrain()
    for _ in range(200):
        robot.run(WheelSpeeds(6.0, 2.0), 10.0, VOLTS, calm(), 10)
    robot.load(MOTOR, load(grip_factor=0.0))
    robot.run(WheelSpeeds(6.0, 2.0), 10.0, VOLTS, calm(), 1)  # at its end the tyres slide
    inertia = wheel_inertia(BODY, GEOMETRY) - BODY.wheel_inertia * np.eye(2)
    before = np.array(robot.ground)
    for _ in range(100):
        robot.run(WheelSpeeds(10.0, -10.0), 30.0, VOLTS, calm(), 10)
    assert tuple(robot.wheels) == pytest.approx((10.0, -10.0), abs=1.0)
    assert robot.lost_steps == (0, 0)
    ground = np.array(robot.ground)
    assert coriolis_factor(BODY, GEOMETRY) > 0.0  # (12) does no work, but exchanges v and w
    assert ground @ inertia @ ground == pytest.approx(before @ inertia @ before, rel=1e-9)


def test_acceleration_is_limited_by_grip():
    """The acceleration is at most mu g; the step counters do not show it."""
    robot = drivetrain(grip=0.1)
    for _ in range(30):
        robot.run(WheelSpeeds(12.0, 12.0), 120.0, VOLTS, calm(), 10)
    assert robot.lost_steps == (0, 0)
    assert np.all(np.array(robot.wheels) > robot.ground)  # both tyres slide
    expected = 0.1 * 9.81 * 0.3  # v = mu g t
    assert RADIUS * robot.ground.right == pytest.approx(expected, rel=0.02)
    assert robot.slid[0] > 0.05


def test_robot_pivots_about_a_blocked_wheel():
    robot = drivetrain(grip=2.0, blocked=(True, False))
    for _ in range(200):
        robot.run(WheelSpeeds(3.0, 3.0), 10.0, VOLTS, calm(), 10)
    assert robot.wheels.right == pytest.approx(0.0, abs=1e-6)
    assert robot.ground.right == pytest.approx(0.0, abs=1e-3)
    assert robot.wheels.left == pytest.approx(3.0, abs=0.3)
    assert robot.lost_steps[0] >= 4
    assert robot.lost_steps[1] == 0
    yaw = robot.pose.yaw
    for _ in range(100):
        robot.run(WheelSpeeds(3.0, 3.0), 10.0, VOLTS, calm(), 10)
    turned = math.remainder(robot.pose.yaw - yaw, math.tau)
    assert turned == pytest.approx(-RADIUS * 3.0 / (2.0 * HALF), rel=0.02)
