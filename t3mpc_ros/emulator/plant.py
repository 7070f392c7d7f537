# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Plant of the emulated board: motors, body, world, sensors and battery of the digital twin.

Frames and the board order the wheels left, right; the twin orders them right, left.
"""

from dataclasses import replace
import math

import numpy as np

from t3mpc_ros.emulator.board.hardware import Registers
from t3mpc_ros.geometry.types import Pose, WheelSpeeds
from t3mpc_ros.robot.interface import RANGE_SENSORS, ZERO_WHEEL_SPEEDS
from t3mpc_ros.robot.sensor_conversions import GRAVITY, encode_range
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.plant.disturbances import Disturbance
from t3mpc_ros.simulation.plant.drivetrain import Drivetrain
from t3mpc_ros.simulation.plant.stepper_motor import StepperMotorParameters
from t3mpc_ros.simulation.sensors.battery import SimulatedBattery
from t3mpc_ros.simulation.sensors.imu import SimulatedImu
from t3mpc_ros.simulation.sensors.range_sensor import SimulatedRangeSensors, sensor_mounts
from t3mpc_ros.simulation.world import cast_rays, clearance, grip_at, load_world

_SAMPLE_STEPS = 5
"""Integration steps (1 ms) between two readings of the sensors."""
_DIVIDER = 20_000
"""mV at the end of the converter: 5 V behind a divider by four."""
_CONVERTER = 1024
_TEMPERATURE = round((25.0 - 36.53) * 340.0)
"""Register of the MPU6050 at 25 degrees: data sheet RM-MPU-6000A, 4.18."""


class Plant:
    """Everything of the robot but its board.

    Parameters
    ----------
    settings
        Of the twin; guard, channel, odometry and slip stop belong to its board and play no part.
    clock_rate
        How much longer a second of the board's crystal counts: at 1.005 it counts 1.005 s.
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
        self._ranges = SimulatedRangeSensors(parameters.range_sensor, ranges)
        self._battery = SimulatedBattery(parameters.battery)
        self._world = load_world(parameters.world)
        self._mounts = sensor_mounts(parameters.range_sensor)
        self._distances = np.full(len(RANGE_SENSORS), math.inf)
        self._owed = 0.0
        """Integration steps that have not been made yet."""
        self._wheels = ZERO_WHEEL_SPEEDS
        self._powered = False
        self._field_work = 0.0
        self._measured_at = 0
        self.elapsed = 0.0
        """s that have passed, by a true clock."""
        self.stopped_at: float | None = None
        """When, by :attr:`elapsed`, the motors last got their last pulse; None while they turn."""
        self.imu_absent = False
        """Whether the inertial sensor does not answer."""
        self._make_chassis(parameters.motor, None)

    def _make_chassis(self, motor: StepperMotorParameters, before: Drivetrain | None) -> None:
        parameters = self._parameters
        step, share = parameters.step, parameters.imu.share(parameters.step)
        self._motor = motor
        self._drivetrain = Drivetrain(motor, parameters.bumper, self._world, step, share)
        if before is not None:
            self._drivetrain.pose = before.pose
            self._drivetrain.steps_done = before.steps_done
        self._drivetrain.load(motor, parameters.load_with_faults(parameters.faults))
        self._field_work = 0.0

    # -- for the board ----------------------------------------------------------------------------

    def run(self, elapsed_us: int) -> None:
        """Let time pass, by the board's clock."""
        seconds = elapsed_us / (1e6 * self._clock_rate)
        self.elapsed += seconds
        self._owed += seconds / self._drivetrain.step
        count = math.floor(self._owed + 1e-9)
        self._owed -= count
        while count:
            sampled = self._drivetrain.steps_done % _SAMPLE_STEPS
            part = min(count, _SAMPLE_STEPS - sampled)
            volts = self._battery.voltage if self._powered else 0.0
            self._drivetrain.run(self._wheels, 0.0, volts, self._disturbance, part)
            count -= part
            if self._drivetrain.steps_done % _SAMPLE_STEPS == 0:
                self._measure()

    def turn(self, left: int, right: int) -> None:
        """Step both motors at these speeds (urad/s) from now on."""
        if left or right:
            self.stopped_at = None
        elif self.stopped_at is None:
            self.stopped_at = self.elapsed
        scale = 1e-6 * self._clock_rate
        top = self._motor.top_speed
        self._wheels = WheelSpeeds(
            min(max(scale * right, -top), top), min(max(scale * left, -top), top)
        )

    def power(self, on: bool) -> None:
        """Give power to both drivers, or take it away."""
        self._powered = on

    def boot(self, microsteps: int) -> None:
        """Start with both counters at zero, for drivers set to so many microsteps.

        A change of the microsteps finds the wheels standing, whatever they did.
        """
        if microsteps != self._motor.microsteps:
            self._make_chassis(replace(self._motor, microsteps=microsteps), self._drivetrain)
        self._drivetrain.restart_board()
        self._imu.restart()

    @property
    def counters(self) -> tuple[int, int]:
        """Pulses issued since the start, left first; within a step as its speed lets expect."""
        right, left = self._drivetrain.counters
        part = self._owed * self._drivetrain.step / self._motor.microstep
        speeds = self._drivetrain.pulse_speeds
        # Cut, so that the next whole step is never behind.
        return left + int(part * speeds.left), right + int(part * speeds.right)

    @property
    def registers(self) -> Registers | None:
        """The newest sample of the inertial sensor; None while it does not answer."""
        if self.imu_absent or self._parameters.faults.gyro_dead:
            return None
        turn, ahead, aside = self._imu.counts
        upright = round(GRAVITY / self._parameters.imu.acceleration_step)
        return Registers(ahead, aside, min(upright, 32767), _TEMPERATURE, 0, 0, turn)

    @property
    def ranges(self) -> bytes:
        """A code for each of the eight distance sensors."""
        if self._parameters.faults.ranges_dead:
            return bytes(len(RANGE_SENSORS))
        return bytes(map(encode_range, self._ranges.readings))

    @property
    def battery(self) -> int:
        """mV, as the converter tells them."""
        count = int(1000.0 * self._battery.voltage * _CONVERTER / _DIVIDER)
        return min(count, _CONVERTER - 1) * _DIVIDER // _CONVERTER

    # -- for whoever looks on ---------------------------------------------------------------------

    @property
    def pulses(self) -> tuple[int, int]:
        """Pulses issued since the start, left first, at the last integration step."""
        right, left = self._drivetrain.counters
        return left, right

    @property
    def pose(self) -> Pose:
        """Where the robot truly is."""
        return self._drivetrain.pose

    @property
    def wheels(self) -> WheelSpeeds:
        """How fast the rotors turn, rad/s."""
        return self._drivetrain.wheels

    @property
    def lost_steps(self) -> tuple[int, int]:
        """Full steps the rotors are behind their fields, right first."""
        return self._drivetrain.lost_steps

    @property
    def collapsed(self) -> bool:
        """Whether the supply is too low for the board."""
        return self._battery.collapsed

    def warm_up(self) -> None:
        """Compile everything now: the first packet must not wait for it."""
        other = Plant(self._parameters)
        other.boot(self._motor.microsteps)
        other.power(True)
        other.run(50_000)
        room = load_world('room')
        clearance(0.0, 0.0, room.segments, room.circles)
        grip_at(0.0, 0.0, room.patches)
        every = np.arange(len(RANGE_SENSORS))
        cast_rays(0.0, 0.0, 0.0, self._mounts, every, room.segments, room.circles, self._distances)
        self._distances[:] = math.inf

    def _measure(self) -> None:
        parameters, drivetrain = self._parameters, self._drivetrain
        dt = (drivetrain.steps_done - self._measured_at) * drivetrain.step
        self._measured_at = drivetrain.steps_done
        self._imu.measure(drivetrain.filtered, dt, parameters.faults.gyro_bias_jump)
        self._look(dt)
        self._feed(dt)
        self._disturbance.draw(dt)

    def _look(self, dt: float) -> None:
        due = self._ranges.due(dt)
        world = self._world
        if due and (world.segments.size or world.circles.size):
            pose, which = self._drivetrain.pose, np.array(due)
            walls = world.segments, world.circles
            cast_rays(*pose, self._mounts, which, *walls, self._distances)
        for sensor in due:
            self._ranges.measure(sensor, float(self._distances[sensor]))

    def _feed(self, dt: float) -> None:
        """Take from the battery what motors and board need."""
        done, power = self._drivetrain.field_work, 0.0
        if self._powered:
            # A phase carries I cos or I sin of the field: two of each heat with I²R a motor.
            power = 2.0 * self._motor.phase_current**2 * self._motor.resistance
            power += max(0.0, done - self._field_work) / dt
        self._field_work = done
        self._battery.draw(power, dt, self._parameters.faults.supply_sag)
