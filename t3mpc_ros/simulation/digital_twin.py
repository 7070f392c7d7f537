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
"""Digital twin: board, motors, body, sensors, world and faults behind the robot interface."""

from dataclasses import dataclass, replace
import heapq
import math
from typing import ClassVar

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    RANGE_SENSORS,
    Pose,
    State,
    WheelSpeeds,
    check_pose,
)
from t3mpc_ros.parameters.table import ParameterError, at_most, group, parameter
from t3mpc_ros.robot import interface
from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON, SlipMonitor
from t3mpc_ros.robot.gyro_odometry import GyroOdometry, GyroOdometryParameters
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.simulation.fault_injection import FaultParameters, active_faults
from t3mpc_ros.simulation.fault_schedule import FaultSchedule, load_schedule
from t3mpc_ros.simulation.fixed_step_robot import FixedStepRobot
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.bumper_contact import BumperParameters
from t3mpc_ros.simulation.plant.disturbances import Disturbance, MeasurementNoise, SpeedNoise
from t3mpc_ros.simulation.plant.drivetrain import Drivetrain, Load, TyreParameters, max_rate
from t3mpc_ros.simulation.plant.dynamics import BodyParameters
from t3mpc_ros.simulation.plant.paper_plant import (
    STABILITY_LIMIT,
    DriveParameters,
    PaperRobotParameters,
)
from t3mpc_ros.simulation.plant.stepper_motor import StepperMotorParameters
from t3mpc_ros.simulation.plant_adapter import Signals
from t3mpc_ros.simulation.sensors.battery import SimulatedBattery, SimulatedBatteryParameters
from t3mpc_ros.simulation.sensors.imu import SimulatedImu, SimulatedImuParameters
from t3mpc_ros.simulation.sensors.range_sensor import (
    SimulatedRangeSensorParameters,
    SimulatedRangeSensors,
)
from t3mpc_ros.simulation.world import MovingDisc, cast_rays, compile_kernels, load_world

BROWN_OUT_REASON = 'brown-out: the board restarts'
CAPACITY = 1000  # commands in transit at most: 2 s at 500 Hz
_NO_OBSTACLE = (math.inf,) * len(RANGE_SENSORS)


@dataclass(frozen=True)
class DigitalTwinParameters(PaperRobotParameters):
    """Parameters of a simulated robot with stepper motors, tyres, sensors, a world and faults.

    With ``drive.kind`` ``stepper`` all of them apply; the other kinds use the paper's plant
    without them.
    """

    drive: DriveParameters = group(DriveParameters, kind='stepper')
    motor: StepperMotorParameters = group(StepperMotorParameters)
    tyres: TyreParameters = group(TyreParameters)
    bumper: BumperParameters = group(BumperParameters)
    imu: SimulatedImuParameters = group(SimulatedImuParameters)
    range_sensor: SimulatedRangeSensorParameters = group(SimulatedRangeSensorParameters)
    battery: SimulatedBatteryParameters = group(SimulatedBatteryParameters)
    odometry: GyroOdometryParameters = group(GyroOdometryParameters)
    faults: FaultParameters = group(FaultParameters)
    world: str = parameter(
        '', 'world: name of a bundled world, or path of a YAML file; empty = endless plain'
    )
    right_wheel_radius_multiplier: float = parameter(
        1.0, 'true over nominal radius of the right wheel', bounds=(0.8, 1.25)
    )
    left_wheel_radius_multiplier: float = parameter(
        1.0, 'true over nominal radius of the left wheel', bounds=(0.8, 1.25)
    )
    wheel_separation_multiplier: float = parameter(
        1.0, 'true over nominal wheel separation', bounds=(0.8, 1.25)
    )
    boot_time: ClassVar[float] = 0.5  # restart time of the board after a power loss, s, assumed
    slip_stop: float = parameter(
        1.0,
        'longest disagreement of gyro and steps; beyond it the robot stops until no motion is '
        'commanded for 0.5 s; 0 = no slip stop',
        's',
        (0.0, 60.0),
        dynamic=True,
    )

    @property
    def true_geometry(self) -> WheelGeometry:
        """Nominal wheel radius and true wheel separation: how the speeds of the ground turn."""
        nominal = self.geometry
        return WheelGeometry(
            wheel_radius=nominal.wheel_radius,
            wheel_separation=nominal.wheel_separation * self.wheel_separation_multiplier,
        )

    def body_with_faults(self, faults: FaultParameters) -> BodyParameters:
        """Return the true body with the load of a fault."""
        true = self.true_body
        return replace(true, body_mass=max(true.body_mass + faults.load_change, 0.01))

    def load_with_faults(self, faults: FaultParameters) -> Load:
        """Return the load of the motors."""
        blocked = faults.wheel_blocked
        return Load(
            self.body_with_faults(faults),
            self.true_geometry,
            self.friction,
            self.friction_factor,
            self.tyres,
            faults.slippery,
            (blocked in ('right', 'both'), blocked in ('left', 'both')),
            (self.right_wheel_radius_multiplier, self.left_wheel_radius_multiplier),
        )

    def check_consistency(self) -> None:
        """Raise ParameterError when the integration is unstable, or a speed cannot be reached."""
        if self.drive.kind != 'stepper':
            super().check_consistency()
            return
        load = self.load_with_faults(self.faults)
        fastest = max_rate(self.motor, load, self.bumper)
        if self.step * fastest > STABILITY_LIMIT:
            raise ParameterError(
                f'substep must be at most {at_most(STABILITY_LIMIT / fastest, 2)} s with this '
                f'motor, body, bumper and friction (fastest rate {fastest:.4g} 1/s): got '
                f'{self.substep:g}'
            )
        if self.limiter.wheel_speed > self.motor.top_speed:
            raise ParameterError(
                f'wheel.max_velocity must be at most {at_most(self.motor.top_speed, 4)} rad/s, '
                f'which is {self.motor.step_rate:g} pulses a second with {self.motor.microsteps} '
                f'microsteps: got {self.limiter.wheel_speed:g}'
            )
        delay, assumed = self.imu.delay, self.odometry.gyro_delay
        if self.odometry.use_gyro and abs(assumed - delay) > 0.25 * delay:
            raise ParameterError(
                f'odometry.gyro_delay must be about {delay:.2g} s with imu.low_pass '
                f'{self.imu.low_pass}, or fast turns are detected as slip: got {assumed:g}'
            )
        self.check_ramp()


@dataclass(frozen=True, slots=True)
class TwinDiagnostics:
    """True internal values of the twin, for diagnostics and figures."""

    faults: tuple[str, ...]  # active faults, as text
    slid: tuple[float, float]  # distance slid by each tyre, m, right first
    load_angles: tuple[float, float]  # angles of the fields ahead of the rotors, rad
    gyro_bias: float  # true gyro bias, rad/s
    estimated_bias: float  # gyro bias estimated by the odometry, rad/s
    max_contact_force: float  # largest contact force of a wall so far, N


class DigitalTwin(FixedStepRobot[DigitalTwinParameters]):
    """Simulated robot with the components, errors and faults of the real one.

    Step counters count pulses, so the odometry is wrong exactly when steps are lost or a tyre
    slides; the gyro measures the resulting turn. Every random component has its own generator,
    which draws the same numbers whatever the parameters: changing one does not shift the
    others. Without a schedule the one that ``faults.schedule`` names applies; without noise of
    the wheel speeds it is white, with the variance ``noise.variance``.
    """

    def __init__(
        self,
        parameters: DigitalTwinParameters,
        schedule: FaultSchedule | None = None,
        speed_noise: MeasurementNoise | None = None,
    ) -> None:
        super().__init__(parameters)
        disturbance, noise, imu, ranges, channel = (
            np.random.default_rng(part)
            for part in np.random.SeedSequence(parameters.seed).spawn(5)
        )
        self._disturbance = Disturbance(parameters.disturbance, disturbance)
        self._white_noise = SpeedNoise(parameters.noise, noise)
        self._noise: MeasurementNoise = speed_noise or self._white_noise
        self._imu = SimulatedImu(parameters.imu, imu)
        self._ranges = SimulatedRangeSensors(parameters.range_sensor, ranges)
        self._channel = TransportDelay(channel)
        self._battery = SimulatedBattery(parameters.battery)
        self._odometry = GyroOdometry(parameters.odometry, parameters.geometry)
        self._world = load_world(parameters.world)
        self._mounts = sensor_mounts(parameters.range_sensor)
        self._distances = np.full(self._mounts.shape[0], math.inf)
        self._drivetrain = Drivetrain(
            parameters.motor,
            parameters.bumper,
            self._world,
            parameters.step,
            parameters.imu.share(parameters.step),
        )
        self._schedule = (
            load_schedule(parameters.faults.schedule) if schedule is None else schedule
        )
        self._faults = parameters.faults
        self._boots_until = 0  # integration step at which the board has restarted
        self._slip_monitor = SlipMonitor()
        self._measured = interface.ZERO_WHEEL_SPEEDS
        self._measured_at = 0
        self._counters = (0, 0)
        self._turned = (0.0, 0.0)
        """Angles (rad) from the pulses since the start, over all restarts of the board."""
        self._field_work = 0.0
        self._sample: interface.ImuSample | None = None
        self._supply = self._battery.draw(0.0, 0.0)
        self._limited_command = self._limiter.advance(0, 0.0)
        self._apply_parameters()
        self._reports.append(self._make_state(0))

    # -- robot interface --------------------------------------------------------------------------

    def apply(self, command: interface.RobotCommand, now_ns: int) -> str:
        """Send ``command`` to the board, or return why the host rejects it.

        The reason of the state shows the decision of the board on arrival.
        """
        now_ns = self._run_to(now_ns)
        if self._restarting:
            return BROWN_OUT_REASON
        if self._limiter.estop or not all(map(math.isfinite, command.wheels)):
            return self._limiter.accept(command, now_ns)
        if stale := self._limiter.staleness(command, now_ns):
            return stale
        faults = self._faults
        delay = self._parameters.drive.dead_time + faults.command_delay
        self._channel.send(command, now_ns, delay, faults.command_jitter, faults.command_loss)
        return ''

    # -- simulation only --------------------------------------------------------------------------

    @property
    def signals(self) -> Signals:
        """Columns of a record beside those of the state."""
        return {'contact_force': self._drivetrain.max_contact_force}

    @property
    def diagnostics(self) -> TwinDiagnostics:
        """True internal values."""
        drivetrain = self._drivetrain
        return TwinDiagnostics(
            faults=active_faults(self._faults),
            slid=drivetrain.slid,
            load_angles=drivetrain.load_angles,
            gyro_bias=self._imu.bias,
            estimated_bias=self._odometry.bias,
            max_contact_force=drivetrain.max_contact_force,
        )

    def set_pose(self, pose: Pose) -> None:
        """Move the robot to ``pose``; wheel speeds and odometry are unchanged.

        ValueError: the pose is not finite, or overlaps an obstacle of the world.
        """
        check_pose(pose)
        radius = self._parameters.bumper.radius
        if not self._drivetrain.world.is_free(pose.x, pose.y, radius):
            raise ValueError(
                f'pose must be at least {radius:g} m away from every obstacle of the world '
                f'{self._world.name}: got x {pose.x:g} m, y {pose.y:g} m'
            )
        self._drivetrain.pose = pose
        self._refresh_state()

    def add_obstacle(self, disc: MovingDisc) -> None:
        """Add a disc to the world, at a time since the start."""
        self._world = replace(self._world, moving=(*self._world.moving, disc))

    def warm_up(self) -> None:
        """Compile every kernel of a step, on a separate robot."""
        DigitalTwin(self._parameters).step(interface.ZERO_WHEEL_SPEEDS)
        compile_kernels(self._mounts)

    # -- simulation step --------------------------------------------------------------------------

    @property
    def _restarting(self) -> bool:
        return self._drivetrain.steps_done < self._boots_until

    @property
    def _elapsed(self) -> float:
        """Time since the start, s; it never decreases."""
        return self._drivetrain.steps_done * self._drivetrain.step

    def _apply_parameters(self) -> None:
        parameters = self._parameters
        self._limiter.parameters = parameters.limiter
        self._odometry.parameters = parameters.odometry
        self._disturbance.parameters = parameters.disturbance
        self._white_noise.parameters = parameters.noise
        self._imu.parameters = parameters.imu
        if parameters.range_sensor != self._ranges.parameters:
            self._ranges.parameters = parameters.range_sensor
        self._battery.parameters = parameters.battery
        self._update_faults()
        self._update_load()

    def _update_faults(self) -> None:
        """Update the active faults, and apply those that begin or end."""
        before = self._faults
        self._faults = self._schedule.at(self._elapsed, self._parameters.faults)
        if self._faults is before:
            return
        if self._faults.brown_out and not before.brown_out:
            self._lose_power()
        self._update_load()

    def _update_load(self) -> None:
        self._drivetrain.load(
            self._parameters.motor, self._parameters.load_with_faults(self._faults)
        )

    def _lose_power(self) -> None:
        """Restart the board: counters and sensors are reset, commands are dropped."""
        drivetrain = self._drivetrain
        self._boots_until = drivetrain.steps_done + round(
            self._parameters.boot_time / drivetrain.step
        )
        self._slip_monitor.reset()
        self._channel.clear()
        self._limiter.stop(BROWN_OUT_REASON, self._reached_ns)
        self._imu.restart()
        drivetrain.filtered[:] = 0.0
        self._odometry.forget_bias()
        drivetrain.restart_board()
        self._counters = (0, 0)

    def _integrate(self, count: int) -> None:
        if self._world.moving:
            self._drivetrain.world = self._world.at(self._elapsed)
        done = 0
        while done < count:
            now_ns = self._stamp_after(self._steps_since_origin + done)
            for command in self._channel.arrived(now_ns):
                if not self._slip_monitor.rejects(command, self._elapsed):
                    self._limiter.accept(command, now_ns)
            part = count - done
            arrival_ns = self._channel.next_ns
            if arrival_ns is not None:
                part = min(part, max(1, self._steps_until(arrival_ns - now_ns)))
            self._run_drivetrain(part, now_ns)
            done += part

    def _run_drivetrain(self, count: int, now_ns: int) -> None:
        """Run ``count`` steps under one command."""
        drivetrain = self._drivetrain
        self._limited_command = self._limiter.advance(now_ns, count * drivetrain.step)
        volts = 0.0 if self._restarting else self._supply.voltage
        drivetrain.run(
            self._limited_command.wheels,
            self._parameters.drive.acceleration,
            volts,
            self._disturbance,
            count,
        )

    def _measure(self) -> None:
        drivetrain = self._drivetrain
        dt = (drivetrain.steps_done - self._measured_at) * drivetrain.step
        self._measured_at = drivetrain.steps_done
        self._update_faults()
        self._update_odometry(dt)
        self._update_ranges(dt)
        self._update_battery(dt)
        self._disturbance.draw(dt)

    def _update_odometry(self, dt: float) -> None:
        """Read step counters and gyro, and update odometry and slip monitor."""
        microstep = self._parameters.motor.microstep
        right, left = self._drivetrain.counters
        turned = WheelSpeeds(
            (right - self._counters[0]) * microstep, (left - self._counters[1]) * microstep
        )
        self._counters = right, left
        self._turned = self._turned[0] + turned.right, self._turned[1] + turned.left
        sample = self._imu.measure(self._drivetrain.filtered, dt, self._faults.gyro_bias_jump)
        absent = self._faults.gyro_dead or self._restarting
        self._sample = None if absent else sample
        if dt > 0.0:
            gyro = None if absent else sample.angular
            self._odometry.update(turned.right, turned.left, gyro, dt)
            speeds = WheelSpeeds(turned.right / dt, turned.left / dt)
            self._measured = self._noise.measure(speeds, self._elapsed)
        slipping_for = self._odometry.slipping_for
        if self._slip_monitor.update(slipping_for, self._parameters.slip_stop, self._elapsed):
            self._limiter.stop(SLIP_STOP_REASON, self._reached_ns)

    def _update_ranges(self, dt: float) -> None:
        """Measure with the range sensors that are due."""
        world = self._drivetrain.world.seen
        empty = not (world.segments.size or world.circles.size)
        if empty and self._ranges.readings == _NO_OBSTACLE:
            return  # the readings cannot change
        due = self._ranges.due(dt)
        if due and not empty:
            pose, which = self._drivetrain.pose, np.array(due)
            cast_rays(*pose, self._mounts, which, *world, self._distances)
        for sensor in due:
            self._ranges.measure(sensor, float(self._distances[sensor]))

    def _update_battery(self, dt: float) -> None:
        """Draw the power of motors and board from the battery; a collapse restarts the board."""
        motor = self._parameters.motor
        done = self._drivetrain.field_work
        power = 0.0
        if dt > 0.0 and not self._restarting:
            # The phases carry I cos and I sin of the field: copper loss I²R per motor.
            copper = 2.0 * motor.phase_current**2 * motor.resistance
            power = copper + max(0.0, done - self._field_work) / dt
        self._field_work = done
        charger = self._world.charging_current(*self._drivetrain.pose[:2])
        self._supply = self._battery.draw(power, dt, self._faults.supply_sag, charger)
        if self._battery.collapsed and not self._restarting:
            self._lose_power()

    def _make_state(self, stamp_ns: int) -> interface.RobotState:
        geometry, limiter, drivetrain = self._parameters.geometry, self._limiter, self._drivetrain
        odometry, limited_command = self._odometry, self._limited_command
        status = interface.RobotStatus(
            enabled=not limiter.estop and not self._restarting,
            moving=self._moving(),
            estop=limiter.estop,
            timed_out=limiter.timed_out,
            limited=limited_command.limited,
            slipping=odometry.slipping,
            imu_fault=self._sample is None,
            low_battery=self._battery.low,
        )
        return interface.RobotState(
            stamp_ns=stamp_ns,
            wheels=self._measured,
            angles=interface.WheelAngles(*self._turned),
            odometry=State(stamp_ns, odometry.pose, twist_from_wheels(self._measured, geometry)),
            covariance=odometry.covariance,
            commanded=limited_command.wheels,
            status=status,
            reason=limiter.reason,
            true_wheels=drivetrain.wheels,
            truth=State(
                stamp_ns,
                drivetrain.pose,
                twist_from_wheels(drivetrain.ground, self._parameters.true_geometry),
            ),
            imu=self._sample,
            ranges=() if self._faults.ranges_dead else self._ranges.readings,
            battery=self._supply,
            lost_steps=drivetrain.lost_steps,
        )

    def _moving(self) -> bool:
        right, left = self._drivetrain.pulse_speeds
        return max(abs(right), abs(left)) > self._parameters.standstill_speed

    def _reset_odometry(self) -> None:
        self._odometry.reset()


class TransportDelay:
    """Delays, reorders and loses commands; it never changes, duplicates or creates one.

    All times are those of one clock. When it jumps back, the commands in transit are dropped,
    because their arrival time is undefined; beyond :data:`CAPACITY` the oldest is dropped. Two
    numbers of its own generator are drawn for each command whatever its outcome, so that a change
    of loss does not shift the delays.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self._in_transit: list[tuple[int, int, interface.RobotCommand]] = []
        """A heap of (arrival, number, command); the number keeps ties in the order of sending."""
        self._clock_ns: int | None = None
        self._sent = 0

    def __len__(self) -> int:
        """Number of commands in transit."""
        return len(self._in_transit)

    @property
    def next_ns(self) -> int | None:
        """Arrival time of the next command; None when none is in transit."""
        return self._in_transit[0][0] if self._in_transit else None

    def send(
        self,
        command: interface.RobotCommand,
        now_ns: int,
        delay_s: float,
        jitter_s: float,
        loss: float,
    ) -> None:
        """Send a command, which arrives after ``delay_s`` to ``delay_s + jitter_s``.

        The part of the jitter is uniform; ``loss`` is the fraction of the commands that is
        lost.
        """
        self._check_clock(now_ns)
        loss_number, jitter_number = self._generator.random(), self._generator.random()
        self._sent += 1
        if loss_number < loss:
            return
        arrival_ns = now_ns + round((delay_s + jitter_s * jitter_number) * NANOSECONDS)
        if len(self._in_transit) >= CAPACITY:
            self._in_transit.remove(min(self._in_transit, key=lambda entry: entry[1]))
            heapq.heapify(self._in_transit)
        heapq.heappush(self._in_transit, (arrival_ns, self._sent, command))

    def arrived(self, now_ns: int) -> list[interface.RobotCommand]:
        """Return the commands that arrived since the last call, in order of arrival.

        The order of sending may differ: the limiter rejects overtaken commands.
        """
        self._check_clock(now_ns)
        commands = []
        while self._in_transit and self._in_transit[0][0] <= now_ns:
            commands.append(heapq.heappop(self._in_transit)[2])
        return commands

    def clear(self) -> None:
        """Drop the commands in transit, as a restart of the board does."""
        self._in_transit.clear()

    def _check_clock(self, now_ns: int) -> None:
        if self._clock_ns is not None and now_ns < self._clock_ns:
            self.clear()
        self._clock_ns = now_ns


def make_robot(parameters: DigitalTwinParameters) -> PaperRobot | DigitalTwin:
    """Return the robot of ``drive.kind``, at standstill in the origin."""
    if parameters.drive.kind == 'stepper':
        return DigitalTwin(parameters)
    return PaperRobot(parameters)
