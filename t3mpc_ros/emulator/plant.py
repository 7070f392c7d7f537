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
"""Plant of the emulated board: motors, body, world, sensors and battery of the digital twin.

Step pulses go in, the counts of the board's converter and the registers of its IMU come out.

Frames and board have the wheel order left, right; the digital twin has right, left.
"""

from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import RANGE_SENSORS, Pose, WheelSpeeds
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import GRAVITY
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.plant.disturbances import Disturbance
from t3mpc_ros.simulation.plant.drivetrain import Drivetrain
from t3mpc_ros.simulation.plant.stepper_motor import StepperMotorParameters
from t3mpc_ros.simulation.sensors.battery import SimulatedBattery
from t3mpc_ros.simulation.sensors.imu import SimulatedImu
from t3mpc_ros.simulation.sensors.range_sensor import NOT_CONVERTED, SimulatedRangeSensors
from t3mpc_ros.simulation.world import cast_rays, compile_kernels, load_world

_SAMPLE_STEPS = 5  # integration steps (1 ms) between two samples of the sensors
_ADC_FULL_SCALE = 20_000
"""Full scale of the battery measurement, mV: 5 V behind a voltage divider by four."""
_ADC_COUNTS = 1024
_TEMPERATURE = round((25.0 - 36.53) * 340.0)
"""Temperature register of the MPU6050 at 25 °C: register map RM-MPU-6000A, 4.18."""


class Registers(NamedTuple):
    """Newest sample of the MPU6050, as raw register values."""

    accel_x: int = 0
    accel_y: int = 0
    accel_z: int = 0
    temperature: int = 0
    gyro_x: int = 0
    gyro_y: int = 0
    gyro_z: int = 0


class Plant:
    """The robot without its board.

    Of the parameters of the twin, command limiter, transport delay, odometry and slip monitor
    are part of the board and unused here. ``clock_rate`` 1.005: 1.005 s per second on the
    clock of the board.
    """

    def __init__(self, parameters: DigitalTwinParameters, clock_rate: float = 1.0) -> None:
        self._parameters = parameters
        self._clock_rate = clock_rate
        disturbance, imu, ranges = (
            np.random.default_rng(part)
            for part in np.random.SeedSequence(parameters.seed).spawn(3)
        )
        self._disturbance = Disturbance(parameters.disturbance, disturbance)
        self._imu = SimulatedImu(parameters.imu, imu)
        self._accel_z = min(round(GRAVITY / parameters.imu.acceleration_step), 32767)
        self._ranges = SimulatedRangeSensors(parameters.range_sensor, ranges)
        self._battery = SimulatedBattery(parameters.battery)
        self._world = load_world(parameters.world)
        self._mounts = sensor_mounts(parameters.range_sensor)
        self._distances = np.full(len(RANGE_SENSORS), math.inf)
        self._pending_steps = 0.0  # integration steps still to run, a fraction of one
        self._issued = [0.0, 0.0]
        """Pulses issued since boot with the fraction of the next, left first."""
        self._powered = False
        self._field_work = 0.0
        self._measured_at = 0
        self.elapsed = 0.0  # true time since the start, s
        self.stopped_at: float | None = None
        """Value of :attr:`elapsed` at the last motor pulse; None while the motors turn."""
        self.imu_absent = False  # whether the IMU does not respond
        self.battery_wire_broken = False
        """Whether the wire from the battery to its divider is broken."""
        self._build_drivetrain(parameters.motor, None)

    def _build_drivetrain(self, motor: StepperMotorParameters, before: Drivetrain | None) -> None:
        parameters = self._parameters
        step, share = parameters.step, parameters.imu.share(parameters.step)
        self._motor = motor
        self._drivetrain = Drivetrain(motor, parameters.bumper, self._world, step, share)
        if before is not None:
            self._drivetrain.pose = before.pose
            self._drivetrain.steps_done = before.steps_done
        self._drivetrain.load(motor, parameters.load_with_faults(parameters.faults))
        self._field_work = 0.0

    # -- pins of the board ------------------------------------------------------------------------

    @property
    def until_sample_us(self) -> int:
        """Time until the sensors measure, on the clock of the board; at least 1."""
        steps = _SAMPLE_STEPS - self._drivetrain.steps_done % _SAMPLE_STEPS - self._pending_steps
        return max(1, math.ceil(steps * self._drivetrain.step * 1e6 * self._clock_rate))

    def run(self, elapsed_us: int, left: float = 0.0, right: float = 0.0) -> bool:
        """Advance by a time on the clock of the board, in which it issues pulses evenly.

        Return whether the sensors have measured. ``left`` and ``right`` are microsteps, signed by
        the direction pins.
        """
        seconds = elapsed_us / (1e6 * self._clock_rate)
        self.elapsed += seconds
        before, passed = self._pending_steps, seconds / self._drivetrain.step
        self._pending_steps += passed
        count = math.floor(self._pending_steps + 1e-9)
        self._pending_steps -= count
        done, measured = -before, False
        while count:
            sampled = self._drivetrain.steps_done % _SAMPLE_STEPS
            part = min(count, _SAMPLE_STEPS - sampled)
            count -= part
            done += part
            # The fields turn to where they are at the end of these steps.
            share = done / passed
            phase_right, phase_left = self._drivetrain.phases
            self._drivetrain.follow_pulses(
                self._issued[1] + share * right - phase_right,
                self._issued[0] + share * left - phase_left,
                self._battery.voltage if self._powered else 0.0,
                self._disturbance,
                part,
            )
            if self._drivetrain.steps_done % _SAMPLE_STEPS == 0:
                self._measure()
                measured = True
        self._issued[0] += left
        self._issued[1] += right
        return measured

    def set_motors(self, powered: bool, turning: bool) -> None:
        """Set whether the motor drivers have power, and whether pulses are being issued."""
        self._powered = powered
        if turning:
            self.stopped_at = None
        elif self.stopped_at is None:
            self.stopped_at = self.elapsed

    def boot(self, microsteps: int) -> None:
        """Reset the counters, and set the microsteps per step; a change stops the wheels."""
        if microsteps != self._motor.microsteps:
            self._build_drivetrain(replace(self._motor, microsteps=microsteps), self._drivetrain)
        self._drivetrain.restart_board()
        self._issued = [0.0, 0.0]
        self._imu.restart()

    @property
    def registers(self) -> Registers | None:
        """Newest sample of the IMU; None while it does not respond."""
        if self.imu_absent or self._parameters.faults.gyro_dead:
            return None
        gyro_z, accel_x, accel_y = self._imu.counts
        return Registers(accel_x, accel_y, self._accel_z, _TEMPERATURE, 0, 0, gyro_z)

    @property
    def adc_counts(self) -> tuple[int, ...]:
        """Counts of the converter: the eight range sensors, then the battery."""
        dead = self._parameters.faults.ranges_dead
        ranges = (NOT_CONVERTED,) * len(RANGE_SENSORS) if dead else self._ranges.counts
        voltage = 0.0 if self.battery_wire_broken else self._battery.voltage
        count = int(1000.0 * voltage * _ADC_COUNTS / _ADC_FULL_SCALE)
        return *ranges, min(count, _ADC_COUNTS - 1)

    # -- ground truth -----------------------------------------------------------------------------

    @property
    def pulses(self) -> tuple[int, int]:
        """Pulses issued since boot, left first, at the last integration step."""
        right, left = self._drivetrain.counters
        return left, right

    @property
    def pose(self) -> Pose:
        """True pose of the robot."""
        return self._drivetrain.pose

    @property
    def wheels(self) -> WheelSpeeds:
        """Speeds of the rotors, rad/s."""
        return self._drivetrain.wheels

    @property
    def lost_steps(self) -> tuple[int, int]:
        """Full steps that the rotors lag behind their fields, right first."""
        return self._drivetrain.lost_steps

    @property
    def undervoltage(self) -> bool:
        """Whether the supply voltage is too low for the board."""
        return self._battery.collapsed

    def warm_up(self) -> None:
        """Compile all kernels, so that the first packet does not wait for it."""
        plant = Plant(self._parameters)
        plant.boot(self._motor.microsteps)
        plant.set_motors(True, True)
        plant.run(50_000, 1.0, 1.0)
        compile_kernels(self._mounts)

    def _measure(self) -> None:
        parameters, drivetrain = self._parameters, self._drivetrain
        dt = (drivetrain.steps_done - self._measured_at) * drivetrain.step
        self._measured_at = drivetrain.steps_done
        self._imu.measure(drivetrain.filtered, dt, parameters.faults.gyro_bias_jump)
        self._measure_ranges(dt)
        self._discharge(dt)
        self._disturbance.draw(dt)

    def _measure_ranges(self, dt: float) -> None:
        due = self._ranges.due(dt)
        if self._world.moving:
            self._drivetrain.world = self._world.at(self.elapsed)
        world = self._drivetrain.world.seen
        if due and (world.segments.size or world.circles.size):
            pose, which = self._drivetrain.pose, np.array(due)
            cast_rays(*pose, self._mounts, which, *world, self._distances)
        for sensor in due:
            self._ranges.measure(sensor, float(self._distances[sensor]))

    def _discharge(self, dt: float) -> None:
        """Discharge the battery by the power of motors and board."""
        done, power = self._drivetrain.field_work, 0.0
        if self._powered:
            # Phase currents are I cos and I sin of the field angle: copper loss I²R per motor.
            power = 2.0 * self._motor.phase_current**2 * self._motor.resistance
            power += max(0.0, done - self._field_work) / dt
        self._field_work = done
        self._battery.draw(power, dt, self._parameters.faults.supply_sag)
