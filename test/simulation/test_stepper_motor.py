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
"""Stepper motor: torque against theory, and steps that are lost exactly beyond it."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.constants import with_constants

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.plant.bumper_contact import BumperParameters
from t3mpc_ros.simulation.plant.disturbances import (
    Disturbance,
    DisturbanceParameters,
    FrictionParameters,
)
from t3mpc_ros.simulation.plant.drivetrain import Drivetrain, Load, TyreParameters
from t3mpc_ros.simulation.plant.dynamics import BodyParameters, wheel_inertia
from t3mpc_ros.simulation.plant.stepper_motor import (
    StepperMotorParameters,
    pull_out_torque,
    rotor_torque,
)
from t3mpc_ros.simulation.world import load_world

GEOMETRY = WheelGeometry()
BODY = BodyParameters()
NO_FRICTION = FrictionParameters(viscous=0.0, coulomb=0.0)
HOLDING_ON = TyreParameters(grip=5.0)
VOLTS = 12.0


def calm(bound: float = 0.0) -> Disturbance:
    return Disturbance(DisturbanceParameters(bound=bound), np.random.default_rng(1))


def drivetrain(
    motor: StepperMotorParameters,
    *,
    friction: FrictionParameters = NO_FRICTION,
    tyres: TyreParameters = HOLDING_ON,
    body: BodyParameters = BODY,
    step: float = 0.001,
) -> Drivetrain:
    made = Drivetrain(motor, BumperParameters(), load_world(''), step, 0.1)
    made.load(motor, Load(body, GEOMETRY, friction, 1.0, tyres, 1.0, (False, False)))
    return made


def needed_torque(
    motor: StepperMotorParameters, acceleration: float, body: BodyParameters = BODY
) -> float:
    """Torque of each motor that accelerates the robot straight on, from Newton alone."""
    share = 0.5 * body.total_mass * GEOMETRY.wheel_radius**2
    return acceleration * (share + body.wheel_inertia + motor.rotor_inertia)


# -- motor alone ----------------------------------------------------------------------------------


@pytest.mark.parametrize('volts', [5.0, 12.0, 24.0])
def test_pull_out_torque_satisfies_the_phasor_equation(volts):
    motor = StepperMotorParameters(phase_current=1.7)
    for speed in np.linspace(0.0, 0.999 * volts / motor.torque_constant, 60):
        torque = pull_out_torque(float(speed), volts, motor.constants())
        current = torque / motor.torque_constant
        electric = motor.teeth * speed
        impedance = complex(motor.resistance, electric * motor.inductance)
        needed = abs(impedance * current + motor.torque_constant * speed)
        if current < motor.phase_current * (1.0 - 1e-12):
            assert needed == pytest.approx(volts, rel=1e-9)
        else:
            assert needed <= volts * (1.0 + 1e-9)


def test_pull_out_torque_falls_to_zero_where_emf_equals_supply():
    motor = StepperMotorParameters()
    speeds = np.linspace(0.0, 1.2 * VOLTS / motor.torque_constant, 400)
    torques = [pull_out_torque(float(s), VOLTS, motor.constants()) for s in speeds]
    assert torques[0] == pytest.approx(motor.torque_constant * motor.phase_current)
    assert all(b <= a + 1e-15 for a, b in zip(torques, torques[1:], strict=False))
    assert torques[-1] == 0.0
    assert pull_out_torque(-20.0, VOLTS, motor.constants()) == pull_out_torque(
        20.0, VOLTS, motor.constants()
    )
    assert pull_out_torque(0.0, 0.0, motor.constants()) == 0.0


def test_holding_torque_is_that_of_both_phases_at_rated_current():
    motor = StepperMotorParameters()
    field = math.hypot(motor.rated_current, motor.rated_current)
    assert motor.torque_constant * field == pytest.approx(motor.holding_torque)


def test_load_angle_follows_the_sine_law():
    motor = StepperMotorParameters()
    peak = pull_out_torque(0.0, VOLTS, motor.constants())
    for share in (0.1, 0.5, 0.9):
        angle = math.asin(share) / motor.teeth
        assert rotor_torque(angle, 0.0, peak, motor.constants()) == pytest.approx(share * peak)
    assert rotor_torque(0.01, 1.0, 0.0, motor.constants()) == 0.0


def test_current_above_the_rating_is_rejected():
    with pytest.raises(
        ParameterError, match=r'phase_current must be at most rated_current \(1.7 A'
    ):
        StepperMotorParameters(phase_current=2.0)


@pytest.mark.parametrize('volts', [9.0, 12.0])
def test_motors_pull_more_than_the_robot_needs(volts):
    """At its top speed and acceleration, straight ahead or on the spot, with friction."""
    robot = DigitalTwinParameters()
    motor, limiter, friction = robot.motor, robot.limiter, robot.friction
    inertia = wheel_inertia(robot.true_body, robot.geometry)
    hardest = inertia[0, 0] + abs(inertia[0, 1]) + motor.rotor_inertia
    needed = hardest * limiter.acceleration
    needed += friction.coulomb + friction.viscous * limiter.wheel_speed
    assert pull_out_torque(limiter.wheel_speed, volts, motor.constants()) > needed


# -- lost steps -----------------------------------------------------------------------------------


def test_wheels_turn_exactly_as_far_as_the_pulses():
    motor = StepperMotorParameters()
    robot = drivetrain(motor, friction=FrictionParameters())
    for _ in range(300):
        robot.run(WheelSpeeds(8.0, -5.0), 20.0, VOLTS, calm(), 10)
    for _ in range(200):
        robot.run(WheelSpeeds(0.0, 0.0), 20.0, VOLTS, calm(), 10)
    assert robot.lost_steps == (0, 0)
    right, left = robot.counters
    assert right > 10_000
    assert left < -6_000
    assert max(map(abs, robot.load_angles)) * GEOMETRY.wheel_radius < 0.1e-3


@pytest.mark.compiled
@pytest.mark.slow
def test_commands_within_the_torque_lose_no_steps():
    """Random speeds and ramps that need at most 0.35 of the available torque.

    A rotor overshoots to twice its load angle at the start of a ramp, and to three times when a
    ramp reverses, so about a third of the torque is always usable; damping adds some margin. Of
    200 sequences at 0.45 none lost a step, at 0.5 three did, at 0.9 all.
    """
    motor = StepperMotorParameters()
    generator = np.random.default_rng(4)
    for _ in range(4):
        robot = drivetrain(motor, friction=FrictionParameters())
        for _ in range(6):
            speed = generator.uniform(-12.0, 12.0)
            peak = pull_out_torque(12.0, VOLTS, motor.constants())
            acceleration = 0.35 * (peak - 0.007) / needed_torque(motor, 1.0)
            share = generator.uniform(0.05, 1.0)
            ramp = share * acceleration
            for _ in range(int(generator.integers(10, 120))):
                robot.run(WheelSpeeds(speed, speed), ramp, VOLTS, calm(), 10)
                assert robot.lost_steps == (0, 0)


@pytest.mark.parametrize(('share', 'speed'), [(0.5, 10.0), (1.5, 10.0), (1.5, -10.0)])
def test_the_counters_miss_the_steps_lost_on_a_ramp(share, speed):
    motor, friction = StepperMotorParameters(), FrictionParameters()
    peak = pull_out_torque(0.0, VOLTS, motor.constants()) - friction.coulomb
    robot = drivetrain(motor, friction=friction)
    for target, periods in ((speed, 50), (0.0, 80)):
        for _ in range(periods):
            robot.run(
                WheelSpeeds(target, target), share * peak / needed_torque(motor, 1.0), VOLTS,
                calm(), 10,
            )  # fmt: skip
    lost = robot.lost_steps[0]
    assert (lost * speed >= 40.0) is (share > 1.0)
    # At rest the rotor is whole tooth pitches behind its field.
    rest = robot.load_angles[0] - math.tau * lost / motor.full_steps
    assert abs(rest) < 0.1 * math.tau / motor.teeth
    counted = 0.5 * motor.microstep * sum(robot.counters)
    missed = math.tau * lost / motor.full_steps
    way = GEOMETRY.wheel_radius * (counted - missed)
    assert robot.pose.x == pytest.approx(way, abs=1e-3)


@pytest.mark.parametrize(
    ('current', 'speed', 'light', 'hard'),
    [(0.6, 10.0, (1.3, 12.0), (12.0, 12.0)), (1.0, 18.0, (1.3, 12.0), (1.3, 3.2))],
    ids=['heavier', 'lower supply'],
)
def test_a_heavier_robot_or_a_lower_supply_loses_steps(current, speed, light, hard):
    """Mass of the body (kg) and supply (V) with which none are lost, and some."""
    lost = []
    for mass, volts in (light, hard):
        motor = StepperMotorParameters(phase_current=current)
        body = replace(BODY, body_mass=mass)
        robot = drivetrain(motor, friction=FrictionParameters(), body=body)
        for _ in range(200):
            robot.run(WheelSpeeds(speed, speed), 40.0, volts, calm(), 10)
        lost.append(robot.lost_steps[0])
    assert lost[0] == 0
    assert lost[1] >= 4


def test_rotor_oscillates_at_its_natural_frequency():
    """A released rotor oscillates with sqrt(N T / J), 15 Hz with this body."""
    motor = with_constants(StepperMotorParameters, damping=0.0)(microsteps=256)
    robot = drivetrain(motor, step=0.0005)
    peak = pull_out_torque(0.0, VOLTS, motor.constants())
    inertia = needed_torque(motor, 1.0)
    expected = math.sqrt(motor.teeth * peak / inertia) / (2.0 * math.pi)
    # A single pulse, well within the linear part of the sine, excites the rotor.
    angles = []
    robot.run(WheelSpeeds(5.0, 5.0), 0.0, VOLTS, calm(), 2)
    robot.run(WheelSpeeds(0.0, 0.0), 0.0, VOLTS, calm(), 1)
    for _ in range(2000):
        robot.run(WheelSpeeds(0.0, 0.0), 0.0, VOLTS, calm(), 1)
        angles.append(robot.load_angles[0])
    signs = np.sign(angles)
    crossings = np.flatnonzero(signs[1:] != signs[:-1])
    period = 2.0 * (crossings[-1] - crossings[0]) / (len(crossings) - 1) * 0.0005
    assert 1.0 / period == pytest.approx(expected, rel=0.01)


def test_wheels_coast_without_power():
    motor = StepperMotorParameters()
    robot = drivetrain(motor, friction=FrictionParameters())
    for _ in range(100):
        robot.run(WheelSpeeds(5.0, 5.0), 40.0, VOLTS, calm(), 10)
    before = robot.wheels.right
    for _ in range(20):
        robot.run(WheelSpeeds(0.0, 0.0), 40.0, 0.0, calm(), 10)
    assert 0.2 * before < robot.wheels.right < 0.95 * before  # it coasts
    robot.restart_board()
    assert robot.counters == (0, 0)
