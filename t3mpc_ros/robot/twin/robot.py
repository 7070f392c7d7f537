# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The digital twin: board, motors, body, sensors and world behind the seam of every robot."""

from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.motion import Motion, Pose, WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels
from t3mpc_ros.motion.words import check_pose
from t3mpc_ros.robot.arena.rays import cast_rays, clearance, grip_at
from t3mpc_ros.robot.arena.world import load_world
from t3mpc_ros.robot.backend import (
    RANGE_SENSORS,
    STILL,
    ImuSample,
    RobotCommand,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.robot.grid import GridRobot
from t3mpc_ros.robot.guard import CommandGuard
from t3mpc_ros.robot.loads import Disturbance, SpeedNoise
from t3mpc_ros.robot.sensors.battery import Battery
from t3mpc_ros.robot.sensors.fusion import FusedOdometry
from t3mpc_ros.robot.sensors.mpu6050 import Mpu6050
from t3mpc_ros.robot.sensors.sharp import RangeFinders, mounts
from t3mpc_ros.robot.simulated import SimulatedRobot
from t3mpc_ros.robot.stepper.chassis import Chassis
from t3mpc_ros.robot.twin.channel import CommandChannel
from t3mpc_ros.robot.twin.faults import FaultSchedule, active, load_schedule
from t3mpc_ros.robot.twin.settings import TwinSettings
from t3mpc_ros.robot.twin.slip_stop import SLIPPING, SlipStop

RESTARTING = 'brown-out: the board restarts'
_NOTHING_THERE = (math.inf,) * len(RANGE_SENSORS)


@dataclass(frozen=True, slots=True)
class Inside:
    """What only a simulation knows of its robot, for diagnostics and pictures."""

    faults: tuple[str, ...]
    """Faults at work, in words."""
    slid: tuple[float, float]
    """m each tyre has slid, right first"""
    load_angles: tuple[float, float]
    """rad the fields are ahead of the rotors"""
    gyro_bias: float
    """rad/s, true"""
    learnt_bias: float
    """rad/s, as the odometry believes"""
    hardest_push: float
    """N, of a wall, so far"""


class TwinRobot(GridRobot[TwinSettings]):
    """A robot that is computed part by part, so that it goes wrong as the real one does.

    Step counters count pulses, so odometry is wrong exactly when steps are lost or a tyre slides;
    the gyro shows what of it turns the robot. Every random part draws from a generator of its own,
    the same numbers whatever the settings: changing one does not shift the others.

    Parameters
    ----------
    settings
        Replaceable while running, as far as they are live.
    schedule
        The faults to play; without one, those that ``faults.schedule`` names.
    """

    def __init__(self, settings: TwinSettings, schedule: FaultSchedule | None = None) -> None:
        guard = CommandGuard(settings.guard, settings.geometry)
        super().__init__(settings, settings.rate, settings.substeps, settings.longest_gap, guard)
        disturbance, noise, imu, ranges, channel = (
            np.random.default_rng(part) for part in np.random.SeedSequence(settings.seed).spawn(5)
        )
        self._disturbance = Disturbance(settings.disturbance, disturbance)
        self._noise = SpeedNoise(settings.noise, noise)
        self._imu = Mpu6050(settings.imu, imu)
        self._ranges = RangeFinders(settings.sharp, ranges)
        self._channel = CommandChannel(channel)
        self._battery = Battery(settings.battery)
        self._odometry = FusedOdometry(settings.odometry, settings.geometry)
        self._world = load_world(settings.world)
        self._mounts = mounts(settings.sharp)
        self._distances = np.full(self._mounts.shape[0], math.inf)
        self._chassis = Chassis(
            settings.motor,
            settings.bumper,
            self._world,
            settings.step,
            settings.imu.share(settings.step),
        )
        self._schedule = load_schedule(settings.faults.schedule) if schedule is None else schedule
        self._faults = settings.faults
        self._boots_until = 0
        """Integration step at which the board is back."""
        self._slip_stop = SlipStop()
        self._measured = STILL
        self._measured_at = 0
        self._counters = (0, 0)
        self._turned = (0.0, 0.0)
        """Angles (rad) by the pulses of all boards since the start."""
        self._field_work = 0.0
        self._sample: ImuSample | None = None
        self._supply = self._battery.draw(0.0, 0.0)
        self._guarded = self._guard.advance(0, 0.0)
        self._take_settings()
        self._reports.append(self._describe(0))

    # -- the seam ---------------------------------------------------------------------------------

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Send ``command`` on its way to the board; return why not if it is refused here.

        What the board makes of it when it arrives shows in the state's reason.
        """
        now_ns = self._run_to(now_ns)
        if self._restarting:
            return RESTARTING
        if self._guard.estop or not all(map(math.isfinite, command.wheels)):
            return self._guard.accept(command, now_ns)
        if stale := self._guard.staleness(command, now_ns):
            return stale
        faults = self._faults
        self._channel.send(
            command,
            now_ns,
            self._settings.drive.dead_time + faults.command_delay,
            faults.command_jitter,
            faults.command_loss,
        )
        return ''

    # -- only in simulation -----------------------------------------------------------------------

    @property
    def inside(self) -> Inside:
        """What nobody outside a simulation can see."""
        chassis = self._chassis
        return Inside(
            faults=active(self._faults),
            slid=chassis.slid,
            load_angles=chassis.load_angles,
            gyro_bias=self._imu.bias,
            learnt_bias=self._odometry.bias,
            hardest_push=chassis.hardest_push,
        )

    def set_pose(self, pose: Pose) -> None:
        """Put the robot elsewhere, its wheels turning as before; odometry does not notice.

        Raises
        ------
        ValueError
            The pose is not finite, or the robot would stand in a wall.
        """
        check_pose(pose)
        radius = self._settings.bumper.radius
        if not self._world.is_free(pose.x, pose.y, radius):
            raise ValueError(
                f'pose must be at least {radius:g} m away from what stands in the world '
                f'{self._world.name}: got x {pose.x:g} m, y {pose.y:g} m'
            )
        self._chassis.pose = pose
        self._describe_again()

    def warm_up(self) -> None:
        """Compile everything that a step needs, on a robot of its own."""
        TwinRobot(self._settings).step(STILL)
        world = load_world('room')
        clearance(0.0, 0.0, world.segments, world.circles)
        grip_at(0.0, 0.0, world.patches)
        which = np.arange(self._mounts.shape[0])
        cast_rays(
            0.0,
            0.0,
            0.0,
            self._mounts,
            which,
            world.segments,
            world.circles,
            np.empty(self._mounts.shape[0]),
        )

    # -- inside -----------------------------------------------------------------------------------

    @property
    def _restarting(self) -> bool:
        return self._chassis.steps_done < self._boots_until

    @property
    def _elapsed(self) -> float:
        """Time since the robot was made, s: it never goes back."""
        return self._chassis.steps_done * self._chassis.step

    def _take_settings(self) -> None:
        settings = self._settings
        self._guard.settings = settings.guard
        self._odometry.settings = settings.odometry
        self._disturbance.settings = settings.disturbance
        self._noise.settings = settings.noise
        self._imu.settings = settings.imu
        self._take_faults()
        self._take_load()

    def _take_faults(self) -> None:
        """Look which faults are at work now, and let those that begin or end do so."""
        before = self._faults
        self._faults = self._schedule.at(self._elapsed, self._settings.faults)
        if self._faults is before:
            return
        if self._faults.brown_out and not before.brown_out:
            self._lose_power()
        self._take_load()

    def _take_load(self) -> None:
        self._chassis.load(self._settings.motor, self._settings.load_under(self._faults))

    def _lose_power(self) -> None:
        """Let the board start anew: counters at zero, sensors too, and no command."""
        chassis = self._chassis
        self._boots_until = chassis.steps_done + round(self._settings.boot_time / chassis.step)
        self._slip_stop.forget()
        self._channel.clear()
        self._guard.stop(RESTARTING, self._now_ns())
        self._imu.restart()
        chassis.filtered[:] = 0.0
        self._odometry.forget_bias()
        chassis.restart_board()
        self._counters = (0, 0)

    def _integrate(self, count: int) -> None:
        done = 0
        while done < count:
            now_ns = self._after(self._since_origin + done)
            for command in self._channel.arrived(now_ns):
                if not self._slip_stop.refuses(command, self._elapsed):
                    self._guard.accept(command, now_ns)
            part = count - done
            arrival_ns = self._channel.next_ns
            if arrival_ns is not None:
                part = min(part, max(1, self._steps_until(arrival_ns - now_ns)))
            self._drive(part, now_ns)
            done += part

    def _drive(self, count: int, now_ns: int) -> None:
        """Run ``count`` steps under one command."""
        chassis = self._chassis
        self._guarded = self._guard.advance(now_ns, count * chassis.step)
        volts = 0.0 if self._restarting else self._supply.voltage
        chassis.run(
            self._guarded.wheels,
            self._settings.drive.acceleration,
            volts,
            self._disturbance,
            count,
        )

    def _measure(self) -> None:
        chassis = self._chassis
        dt = (chassis.steps_done - self._measured_at) * chassis.step
        self._measured_at = chassis.steps_done
        self._take_faults()
        self._count(dt)
        self._look(dt)
        self._feed(dt)
        self._disturbance.draw(dt)

    def _count(self, dt: float) -> None:
        """Read step counters and gyro, and reckon where they say the robot is."""
        microstep = self._settings.motor.microstep
        right, left = self._chassis.counters
        turned = WheelSpeeds(
            (right - self._counters[0]) * microstep, (left - self._counters[1]) * microstep
        )
        self._counters = right, left
        self._turned = self._turned[0] + turned.right, self._turned[1] + turned.left
        sample = self._imu.measure(self._chassis.filtered, dt, self._faults.gyro_bias_jump)
        absent = self._faults.gyro_dead or self._restarting
        self._sample = None if absent else sample
        if dt > 0.0:
            gyro = None if absent else sample.angular
            self._odometry.update(turned.right, turned.left, gyro, dt)
            self._measured = self._noise.measure(WheelSpeeds(turned.right / dt, turned.left / dt))
        slipping_for = self._odometry.slipping_for
        if self._slip_stop.decide(slipping_for, self._settings.slip_stop, self._elapsed):
            self._guard.stop(SLIPPING, self._now_ns())

    def _look(self, dt: float) -> None:
        """Let those distance sensors see whose time has come."""
        world = self._world
        empty = not (world.segments.size or world.circles.size)
        if empty and self._ranges.readings == _NOTHING_THERE:
            return  # and nothing will ever be
        due = self._ranges.due(dt)
        if due and not empty:
            cast_rays(
                *self._chassis.pose,
                self._mounts,
                np.array(due),
                world.segments,
                world.circles,
                self._distances,
            )
        for sensor in due:
            self._ranges.measure(sensor, float(self._distances[sensor]))

    def _feed(self, dt: float) -> None:
        """Take from the battery what motors and board need; too much of it, and the board goes."""
        motor = self._settings.motor
        done = self._chassis.field_work
        power = 0.0
        if dt > 0.0 and not self._restarting:
            # A phase carries I cos or I sin of the field: two of each heat with I²R a motor.
            copper = 2.0 * motor.phase_current**2 * motor.resistance
            power = copper + max(0.0, done - self._field_work) / dt
        self._field_work = done
        self._supply = self._battery.draw(power, dt, self._faults.supply_sag)
        if self._battery.collapsed and not self._restarting:
            self._lose_power()

    def _describe(self, stamp_ns: int) -> RobotState:
        geometry, guard, chassis = self._settings.geometry, self._guard, self._chassis
        odometry, guarded = self._odometry, self._guarded
        status = RobotStatus(
            enabled=not guard.estop and not self._restarting,
            moving=self._moving(),
            estop=guard.estop,
            timed_out=guard.timed_out,
            limited=guarded.limited,
            slipping=odometry.slipping,
            imu_fault=self._sample is None,
            low_battery=self._battery.low,
        )
        return RobotState(
            stamp_ns=stamp_ns,
            wheels=self._measured,
            angles=WheelAngles(*self._turned),
            odometry=Motion(stamp_ns, odometry.pose, body_from_wheels(self._measured, geometry)),
            covariance=odometry.covariance,
            commanded=guarded.wheels,
            status=status,
            reason=guard.reason,
            true_wheels=chassis.wheels,
            truth=Motion(stamp_ns, chassis.pose, body_from_wheels(chassis.ground, geometry)),
            imu=self._sample,
            ranges=() if self._faults.ranges_dead else self._ranges.readings,
            battery=self._supply,
            lost_steps=chassis.lost_steps,
        )

    def _moving(self) -> bool:
        right, left = self._chassis.pulse_speeds
        return max(abs(right), abs(left)) > self._settings.rest_speed

    def _reset_reckoning(self) -> None:
        self._odometry.reset()


def make_robot(settings: TwinSettings) -> SimulatedRobot | TwinRobot:
    """Return the robot that ``drive.kind`` asks for, standing at the origin."""
    if settings.drive.kind == 'stepper':
        return TwinRobot(settings)
    return SimulatedRobot(settings)
