# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Everything that can be set of the digital twin, and which robot a table asks for."""

from dataclasses import dataclass, replace

from t3mpc_ros.robot.arena.contact import BumperSettings
from t3mpc_ros.robot.drive import STABLE, DriveSettings
from t3mpc_ros.robot.dynamics import BodySettings
from t3mpc_ros.robot.sensors.battery import BatterySettings
from t3mpc_ros.robot.sensors.fusion import FusedOdometrySettings
from t3mpc_ros.robot.sensors.mpu6050 import ImuSettings
from t3mpc_ros.robot.sensors.sharp import SharpSettings
from t3mpc_ros.robot.simulated import SimulatedRobotSettings
from t3mpc_ros.robot.stepper.chassis import Load, TyreSettings, fastest_rate
from t3mpc_ros.robot.stepper.motor import MotorSettings
from t3mpc_ros.robot.twin.faults import FaultSettings
from t3mpc_ros.settings import SettingError, nested, setting


@dataclass(frozen=True)
class TwinSettings(SimulatedRobotSettings):
    """A simulated robot with stepper motors, tyres, sensors, a world and faults.

    ``drive.kind`` says which parts are at work: ``stepper`` uses all of them, the others are the
    paper's plant and know none.
    """

    drive: DriveSettings = nested(DriveSettings, kind='stepper')
    motor: MotorSettings = nested(MotorSettings)
    tyres: TyreSettings = nested(TyreSettings)
    bumper: BumperSettings = nested(BumperSettings)
    imu: ImuSettings = nested(ImuSettings)
    sharp: SharpSettings = nested(SharpSettings)
    battery: BatterySettings = nested(BatterySettings)
    odometry: FusedOdometrySettings = nested(FusedOdometrySettings)
    faults: FaultSettings = nested(FaultSettings)
    world: str = setting(
        '', 'world to drive in: the name of a shipped one or a YAML file; empty = an endless plain'
    )
    boot_time: float = setting(
        0.5, 'how long the board is away after a loss of power', unit='s', low=0.0, high=10.0
    )
    slip_stop: float = setting(
        1.0,
        'gyro and steps may disagree for so long, then the robot stops until no motion was '
        'commanded for 0.5 s; 0 = it never does',
        unit='s',
        low=0.0,
        high=60.0,
        live=True,
    )

    def body_under(self, faults: FaultSettings) -> BodySettings:
        """Return the body that moves, with what a fault has put on it."""
        true = self.true_body
        return replace(true, body_mass=max(true.body_mass + faults.load_change, 0.01))

    def load_under(self, faults: FaultSettings) -> Load:
        """Return what the motors move, and what holds it back."""
        held = faults.wheel_blocked
        return Load(
            self.body_under(faults),
            self.geometry,
            self.friction,
            self.friction_factor,
            self.tyres,
            faults.slippery,
            (held in ('right', 'both'), held in ('left', 'both')),
        )

    def check_together(self) -> None:
        """Raise SettingError when the integration would be unstable, or a speed cannot be made."""
        if self.drive.kind != 'stepper':
            super().check_together()
            return
        load = self.load_under(self.faults)
        fastest = fastest_rate(self.motor, load, self.bumper, self.friction_factor)
        if self.step * fastest > STABLE:
            raise SettingError(
                f'substep must be at most {STABLE / fastest:.2g} s with this motor, body, bumper '
                f'and friction (fastest rate {fastest:.4g} 1/s): got {self.substep:g}'
            )
        if self.guard.wheel_speed > self.motor.top_speed:
            raise SettingError(
                f'guard.wheel_speed must be at most {self.motor.top_speed:.4g} rad/s, which is '
                f'{self.motor.step_rate:g} pulses a second with {self.motor.microsteps} '
                f'microsteps: got {self.guard.wheel_speed:g}'
            )
        delay, told = self.imu.delay, self.odometry.gyro_delay
        if self.odometry.use_gyro and abs(told - delay) > 0.25 * delay:
            raise SettingError(
                f'odometry.gyro_delay must be about {delay:.2g} s with imu.low_pass '
                f'{self.imu.low_pass}, or quick turns look like slip: got {told:g}'
            )
        self.check_ramp()
