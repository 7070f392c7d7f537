# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Motor, distance sensor and gyro of the digital twin against their data sheets."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.plant.disturbances import Disturbance
from t3mpc_ros.simulation.plant.drivetrain import Drivetrain
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.stepper_motor import StepperMotorParameters, pull_out_torque
from t3mpc_ros.simulation.sensors.imu import SimulatedImu, SimulatedImuParameters, low_pass
from t3mpc_ros.simulation.sensors.range_sensor import (
    SimulatedRangeSensorParameters,
    SimulatedRangeSensors,
    output_voltage,
)
from t3mpc_ros.simulation.world import load_world

Array = npt.NDArray[np.float64]

SHARP_SHEET = (
    (1, 0.49), (2, 1.15), (3, 1.85), (4, 2.48), (5, 3.08), (6, 3.14), (7, 2.98), (8, 2.74),
    (10, 2.32), (15, 1.64), (20, 1.31), (25, 1.08), (30, 0.92), (40, 0.735), (50, 0.60),
    (60, 0.51), (70, 0.44), (80, 0.40),
)  # fmt: skip
"""cm and V, read off figure 2 of Sharp's data sheet E4-A00201EN (white paper)."""

GYRO_SHEET = (
    (256.0, 0.98), (188.0, 1.9), (98.0, 2.8), (42.0, 4.8), (20.0, 8.3), (10.0, 13.4), (5.0, 18.6),
)  # fmt: skip
"""Hz at -3 dB and delay in ms at DLPF_CFG 0 to 6, InvenSense RM-MPU-6000A-00 r4.2, register 26."""


@dataclass(frozen=True, eq=False)
class TorqueCurve:
    """Pull-out torque of a motor against speed."""

    volts: float
    current: float
    """A, peak of a phase"""
    speed: Array
    """rad/s, shape (n,)"""
    torque: Array
    """N m, shape (n,)"""
    ceiling: float
    """rad/s; V/(2 L I) full steps a second: where the current no longer rises within a step"""


@dataclass(frozen=True, eq=False)
class Ramp:
    """Response of the robot to a ramp of the field up to a speed and down again."""

    acceleration: float
    """rad/s²"""
    time: Array
    """s, shape (n,)"""
    field: Array
    """rad/s that the board asks of the right wheel, shape (n,)"""
    rotor: Array
    """rad/s at which it turns, shape (n,)"""
    behind: Array
    """Full steps the right rotor is behind its field, shape (n,)."""
    counted_distance: Array
    """m driven by the step counters, shape (n,)"""
    driven: Array
    """m driven, shape (n,)"""
    lost_steps: tuple[int, int]
    """At the end, right first."""


@dataclass(frozen=True, eq=False)
class LowPass:
    """Response of one low-pass setting of the gyro, measured with a pulse."""

    frequency: Array
    """Hz, shape (n,)"""
    gain: Array
    """dB, shape (n,)"""
    cutoff: float
    """Hz at -3 dB"""
    delay: float
    """ms, of slow signals"""


@dataclass(frozen=True, eq=False)
class Allan:
    """Allan deviation of a standing gyro."""

    span: Array
    """s that are averaged over, shape (n,)"""
    deviation: Array
    """deg/s, shape (n,)"""


def torque_curve(
    motor: StepperMotorParameters, volts: float, current: float, fastest: float
) -> TorqueCurve:
    """Return the pull-out torque from standstill to ``fastest`` rad/s."""
    set_up = replace(motor, phase_current=current)
    speed = np.linspace(0.0, fastest, 301)
    numbers = set_up.constants()
    torque = np.array([pull_out_torque(float(value), volts, numbers) for value in speed])
    steps = volts / (2.0 * motor.inductance * current)
    return TorqueCurve(volts, current, speed, torque, steps * 2.0 * math.pi / motor.full_steps)


def needed_torque(parameters: DigitalTwinParameters) -> float:
    """Return the torque (N m) of a motor for the command limiter's acceleration and the friction.

    The larger of driving straight and turning on the spot, at the command limiter's top speed.
    """
    inertia = wheel_inertia(parameters.true_body, parameters.geometry)
    own = parameters.motor.rotor_inertia
    hardest = max(inertia[0, 0] + inertia[0, 1], inertia[0, 0] - inertia[0, 1]) + own
    friction = parameters.friction
    rubs = friction.coulomb + friction.viscous * parameters.limiter.wheel_speed
    return float(hardest * parameters.limiter.acceleration + parameters.friction_factor * rubs)


def breaking_acceleration(parameters: DigitalTwinParameters) -> float:
    """Return the acceleration (rad/s²) straight ahead that takes all of the torque at rest."""
    inertia = wheel_inertia(parameters.true_body, parameters.geometry)
    motor = parameters.motor
    pull = motor.torque_constant * motor.phase_current - parameters.friction.coulomb
    return float(pull / (inertia[0, 0] + inertia[0, 1] + motor.rotor_inertia))


def ramp(parameters: DigitalTwinParameters, acceleration: float, speed: float) -> Ramp:
    """Return a drive straight ahead: up to ``speed`` (rad/s), 0.4 s there, down, 0.2 s of rest.

    The supply has 12 V. The tyres hold whatever comes, so that only the motors can fail; nothing
    disturbs.
    """
    gripping = parameters.with_values({'tyres.grip': 5.0})
    calm = replace(parameters.disturbance, bound=0.0)
    disturbance = Disturbance(calm, np.random.default_rng(parameters.seed))
    step, radius = parameters.step, parameters.geometry.wheel_radius
    drivetrain = Drivetrain(
        parameters.motor, parameters.bumper, load_world(''), step, parameters.imu.share(step)
    )
    drivetrain.load(parameters.motor, gripping.load_with_faults(parameters.faults))
    up = speed / acceleration
    rows = []
    for index in range(round((2.0 * up + 0.6) / step)):
        target = speed if index * step < up + 0.4 else 0.0
        drivetrain.run(WheelSpeeds(target, target), acceleration, 12.0, disturbance, 1)
        rows.append(
            (
                drivetrain.pulse_speeds.right,
                drivetrain.wheels.right,
                drivetrain.load_angles[0] * parameters.motor.full_steps / (2.0 * math.pi),
                0.5 * radius * parameters.motor.microstep * sum(drivetrain.counters),
                drivetrain.pose.x,
            )
        )
    time: Array = step * np.arange(1.0, len(rows) + 1.0)
    field, rotor, behind, counted_distance, driven = np.array(rows).T
    return Ramp(
        acceleration, time, field, rotor, behind, counted_distance, driven, drivetrain.lost_steps
    )


def sharp_curve(distances: Sequence[float] | Array) -> Array:
    """Return the output (V) of the distance sensor at distances (m)."""
    return np.array([output_voltage(float(value)) for value in distances])


def sharp_readings(
    parameters: SimulatedRangeSensorParameters, distances: Array, seed: int
) -> Array:
    """Return the readings (m, REP 117) of all eight sensors, shape (n, 8)."""
    finders = SimulatedRangeSensors(parameters, np.random.default_rng(seed))
    rows = []
    for true_distance in distances.tolist():
        for sensor in range(len(finders.readings)):
            finders.measure(sensor, true_distance)
        rows.append(finders.readings)
    return np.array(rows)


def sharp_deviation() -> float:
    """Return the largest relative difference from the sheet within the measuring range."""
    within = [(0.01 * cm, volts) for cm, volts in SHARP_SHEET if cm >= 10]
    return max(abs(output_voltage(far) / volts - 1.0) for far, volts in within)


def low_pass_response(setting: int) -> LowPass:
    """Return the response of low-pass ``setting`` (DLPF_CFG) to a pulse of 0.1 ms."""
    step, length = 1e-4, 8192
    share = SimulatedImuParameters(low_pass=str(setting)).share(step)
    filtered = np.zeros((3, 2))
    answer = np.empty(length)
    for index in range(length):
        low_pass(filtered, 1.0 if index == 0 else 0.0, 0.0, 0.0, share)
        answer[index] = filtered[0, 1]
    spectrum = np.abs(np.fft.rfft(answer, 8 * length))
    frequency: Array = np.asarray(np.fft.rfftfreq(8 * length, step)[1:], dtype=np.float64)
    gain = 20.0 * np.log10(spectrum[1:] / spectrum[0])
    middle = float(answer @ np.arange(length) / answer.sum()) + 0.5  # the pulse lasts one step
    cutoff = float(np.interp(3.0103, -gain[frequency < 1000.0], frequency[frequency < 1000.0]))
    return LowPass(frequency, gain, cutoff, 1e3 * step * middle)


def stationary_gyro(
    parameters: SimulatedImuParameters, seconds: float, rate: float, seed: int
) -> Array:
    """Return the output of a stationary gyro (deg/s), shape (seconds * rate,)."""
    gyro = SimulatedImu(parameters, np.random.default_rng(seed))
    still = np.zeros((3, 2))
    rates = [gyro.measure(still, 1.0 / rate).angular for _ in range(round(seconds * rate))]
    return (180.0 / math.pi) * np.array(rates)


def allan_deviation(rates: Array, rate: float) -> Allan:
    """Return the overlapping Allan deviation of a rate sampled ``rate`` times a second.

    For spans up to a fifth of the record. White noise of one-sided density N has N / sqrt(2 t),
    a random walk by K after a second K sqrt(t / 3). Source: IEEE Std 952, annex C, where N is
    the square root of the two-sided density.
    """
    turned = np.concatenate(([0.0], np.cumsum(rates))) / rate
    longest = max(2, rates.size // 5)
    sizes = np.unique(np.geomspace(1, longest, 40).astype(int))
    deviations = [
        math.sqrt(
            0.5 * float(np.mean((turned[2 * m :] - 2 * turned[m:-m] + turned[: -2 * m]) ** 2))
        )
        / (m / rate)
        for m in sizes
    ]
    return Allan(sizes / rate, np.array(deviations))
