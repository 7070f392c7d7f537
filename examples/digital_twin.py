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
"""The digital twin: torque of its motors, a stall, a distance sensor, odometry under slip."""

import math
from pathlib import Path

import numpy as np

import t3mpc_ros as t3
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.robot.wheel_odometry import WheelOdometry
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.plant.stepper_motor import StepperMotorParameters, pull_out_torque
from t3mpc_ros.simulation.sensors.range_sensor import output_voltage

CENTIMETRES = (1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 40, 60, 80)
VOLTS = (0.49, 1.15, 1.85, 2.48, 3.14, 2.74, 2.32, 1.64, 1.31, 0.92, 0.735, 0.51, 0.40)
"""Read off figure 2 of Sharp's data sheet E4-A00201EN (white paper)."""


def square_legs(geometry, side, clockwise=False):
    """Return the angles (rad) that the wheels turn on each leg of a square, right first."""
    along = side / geometry.wheel_radius
    corner = 0.5 * math.pi * geometry.half_separation / geometry.wheel_radius
    corner *= -1.0 if clockwise else 1.0
    return [(along, along), (corner, -corner)] * 4


def wheel_speeds(robot, legs):
    """Yield wheel speeds that end each leg at its angles by the step counters."""
    still, exact = WheelSpeeds(0.0, 0.0), 0.5 * robot.parameters.motor.microstep
    yield from [still] * 150  # the gyro's bias is measured at rest
    goal = np.array(robot.state.angles)
    for leg in legs:
        goal += leg
        for _ in range(10_000):
            angles = goal - robot.state.angles
            far = np.abs(angles).max()
            if far <= exact:
                break
            # So slow at the end that a command which is two periods late does not overshoot.
            speed = min(8.0, math.sqrt(24.0 * far), far / 0.06)
            turning = np.abs(angles) > exact
            yield WheelSpeeds(*np.where(turning, np.copysign(speed, angles), 0.0).tolist())
        yield from [still] * 30
    yield from [still] * 120


def drive(parameters, legs, slip=()):
    """Return the robot, and its true pose, odometry and steps alone: x, y, yaw, shape (n, 3)."""
    robot = DigitalTwin(parameters, t3.FaultSchedule(slip))
    robot.advance(0)
    by_steps = WheelOdometry(parameters.odometry, parameters.geometry)
    before, rows = robot.state.angles, []
    for wheels in wheel_speeds(robot, legs):
        state = robot.step(wheels)
        by_steps.update(*np.subtract(state.angles, before).tolist())
        before = state.angles
        rows.append((state.truth.pose, state.odometry.pose, by_steps.pose))
    poses = np.unwrap(np.array(rows), axis=0)  # x and y never jump by half a turn
    return robot, *poses.transpose(1, 0, 2)


def main(folder=Path('runs/examples'), side=4.0):
    """Draw four panels; return lost steps, and true and estimated poses of the square."""
    import matplotlib.figure

    figure = matplotlib.figure.Figure(figsize=(6.2, 5.6), layout='constrained')
    (torque, speed), (voltage, path) = figure.subplots(2, 2)

    motor = StepperMotorParameters()
    speeds = np.linspace(0.0, 140.0, 301)
    for volts in (9.0, 12.0, 24.0):
        pull = [pull_out_torque(each, volts, motor.constants()) for each in speeds.tolist()]
        (line,) = torque.plot(speeds, pull, label=f'{volts:g} V')
        steps = volts / (2.0 * motor.inductance * motor.phase_current)  # full steps a second
        fastest = 2.0 * math.pi * steps / motor.full_steps
        torque.plot(fastest, np.interp(fastest, speeds, pull), 'v', color=line.get_color())
    torque.plot([], [], 'v', color='grey', label='V / (2 L I) steps a second')
    torque.set(title='pull-out torque / N m', xlabel='wheel speed / rad/s', ylim=(0.0, 0.3))

    weak = DigitalTwinParameters.from_dict({'motor.phase_current': 0.15, 'slip_stop': 0.0})
    stalled = DigitalTwin(weak)
    stalled.advance(0)
    states = [stalled.step(WheelSpeeds(10.0 * (k < 80), 10.0 * (k < 80))) for k in range(150)]
    time = 0.01 * np.arange(1, 151)
    speed.plot(time, [state.true_wheels.right for state in states], label='rotor')
    speed.plot(time, [state.commanded.right for state in states], label='field')
    lost = states[-1].lost_steps[0]
    speed.set(title=f'stall at 0.15 A: {lost} steps lost', xlabel='time / s', ylabel='rad/s')

    far = np.linspace(0.0, 1.0, 401)
    voltage.plot(100.0 * far, [output_voltage(each) for each in far.tolist()], label='twin')
    voltage.plot(CENTIMETRES, VOLTS, 'o', mfc='white', label='data sheet')
    voltage.set(title='distance sensor', xlabel='distance / cm', ylabel='V')

    parameters = DigitalTwinParameters.from_dict({'seed': 1, 'slip_stop': 0.0})
    slip = [t3.FaultEvent(at, 'slippery', 0.1, 0.5) for at in (2.0, 17.0, 30.0, 47.0, 62.0)]
    legs = square_legs(parameters.geometry, side)
    _, truth, odometry, steps = drive(parameters, legs, slip)
    for poses, style, label in (
        (truth, '-', 'where it was'), (odometry, '--', 'odometry with gyro'),
        (steps, ':', 'odometry, steps alone'),
    ):  # fmt: skip
        path.plot(*poses[:, :2].T, style, label=label)
    path.set(title='square, grip lost to 10 %', xlabel='x / m', ylabel='y / m')
    path.set_aspect('equal', adjustable='datalim')
    path.margins(y=0.8)  # room for the legend

    for axis in (torque, speed, voltage, path):
        axis.legend(fontsize='x-small', loc='upper right')
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / 'digital_twin.png', dpi=150)
    return lost, (truth, odometry, steps)


if __name__ == '__main__':
    main()
