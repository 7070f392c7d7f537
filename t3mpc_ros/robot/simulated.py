# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: dynamics, loads, drive, guard and odometry on one fixed time grid."""

from dataclasses import dataclass, replace
import math

from t3mpc_ros.motion import Geometry, Motion, Pose, WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels
from t3mpc_ros.motion.words import check_pose
from t3mpc_ros.robot.backend import (
    STILL,
    RobotCommand,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.robot.drive import STABLE, DriveSettings, Plant, fastest_rate
from t3mpc_ros.robot.dynamics import BodySettings
from t3mpc_ros.robot.grid import GridRobot
from t3mpc_ros.robot.guard import CommandGuard, GuardSettings
from t3mpc_ros.robot.loads import (
    Disturbance,
    DisturbanceSettings,
    FrictionSettings,
    NoiseSettings,
    SpeedNoise,
    generators,
)
from t3mpc_ros.robot.odometry import DeadReckoning, OdometrySettings
from t3mpc_ros.settings import SettingError, Settings, nested, setting


@dataclass(frozen=True)
class SimulatedRobotSettings(Settings):
    """Everything that can be set of a simulated robot."""

    geometry: Geometry = nested(Geometry)
    body: BodySettings = nested(BodySettings)
    friction: FrictionSettings = nested(FrictionSettings)
    disturbance: DisturbanceSettings = nested(DisturbanceSettings)
    noise: NoiseSettings = nested(NoiseSettings)
    drive: DriveSettings = nested(DriveSettings)
    guard: GuardSettings = nested(GuardSettings)
    odometry: OdometrySettings = nested(OdometrySettings)
    mass_factor: float = setting(
        1.0,
        'true over nominal body mass; the drive knows the nominal one',
        low=0.1,
        high=10.0,
        live=True,
    )
    inertia_factor: float = setting(
        1.0, 'true over nominal body inertia', low=0.1, high=10.0, live=True
    )
    friction_factor: float = setting(
        1.0, 'true over nominal friction, both kinds', low=0.0, high=10.0, live=True
    )
    rate: float = setting(100.0, 'how often the state is reported', unit='Hz', low=50.0, high=1e3)
    substep: float = setting(
        0.001,
        'longest step of the integration; a control period is cut into equal ones',
        unit='s',
        low=1e-5,
        high=0.01,
    )
    rest_speed: float = setting(
        0.1,
        'true wheel speed below which the robot counts as standing',
        unit='rad/s',
        low=0.0,
        high=1.0,
    )
    longest_gap: float = setting(
        1.0,
        'time that is made up for when nobody asked for the state; what is longer is skipped',
        unit='s',
        low=0.5,
        high=60.0,
    )
    seed: int = setting(1, 'seed of disturbance and noise', low=0)

    @property
    def substeps(self) -> int:
        """How many integration steps a control period takes."""
        return max(1, math.ceil(1.0 / (self.rate * self.substep) - 1e-9))

    @property
    def step(self) -> float:
        """Length of an integration step, s."""
        return 1.0 / (self.rate * self.substeps)

    @property
    def true_body(self) -> BodySettings:
        """The body with its factors: what moves, as opposed to what the drive believes."""
        return replace(
            self.body,
            body_mass=self.body.body_mass * self.mass_factor,
            body_inertia=self.body.body_inertia * self.inertia_factor,
        )

    def check_together(self) -> None:
        """Raise SettingError when the integration would be unstable, or stops be cut short."""
        bodies = self.body, self.true_body
        fastest = fastest_rate(
            self.drive, bodies, self.geometry, self.friction, self.friction_factor
        )
        if self.step * fastest > STABLE:
            raise SettingError(
                f'substep must be at most {STABLE / fastest:.2g} s with this body, drive and '
                f'friction (fastest rate {fastest:.4g} 1/s): got {self.substep:g}'
            )
        if self.drive.kind == 'velocity':
            self.check_ramp()

    def check_ramp(self) -> None:
        """Raise SettingError when the drive would cut stops short."""
        drive, guard = self.drive, self.guard
        if 0.0 < drive.acceleration < guard.stop_deceleration:
            raise SettingError(
                'drive.acceleration must be at least guard.stop_deceleration '
                f'({guard.stop_deceleration:g} rad/s²), or 0: got {drive.acceleration:g}'
            )


class SimulatedRobot(GridRobot[SimulatedRobotSettings]):
    """A robot that exists in numbers only: the paper's plant, on a :class:`GridRobot`'s time.

    Disturbance and noise come from generators of their own, and draw the same numbers whatever
    their settings: changing one does not shift the other.
    """

    def __init__(self, settings: SimulatedRobotSettings) -> None:
        if settings.drive.kind == 'stepper':
            raise ValueError(
                'drive.kind must be velocity or torque here: stepper is for TwinRobot'
            )
        guard = CommandGuard(settings.guard, settings.geometry)
        super().__init__(settings, settings.rate, settings.substeps, settings.longest_gap, guard)
        for_disturbance, for_noise = generators(settings.seed)
        self._odometry = DeadReckoning(settings.odometry, settings.geometry)
        self._disturbance = Disturbance(settings.disturbance, for_disturbance)
        self._noise = SpeedNoise(settings.noise, for_noise)
        self._plant = Plant(settings.drive, settings.step)
        self._measured = STILL
        self._torque = (0.0, 0.0)
        self._guarded = self._guard.advance(0, 0.0)
        self._measured_at = 0
        """Integration steps the plant had done at the last measurement."""
        self._take_settings()
        self._reports.append(self._describe(0))

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from now on; return why not if it is refused.

        Raises
        ------
        ValueError
            The drive takes torques; then see :meth:`step_torque`.
        """
        if self._settings.drive.kind == 'torque':
            raise ValueError('drive.kind must be velocity to take wheel speeds: got torque')
        return super().apply(command, now_ns)

    def step_torque(self, right: float, left: float) -> RobotState:
        """Apply torques (N m) for one control period and return the state at its end.

        Torques that are not finite brake the wheels, as an emergency stop does.

        Raises
        ------
        ValueError
            The drive takes wheel speeds.
        """
        if self._settings.drive.kind != 'torque':
            raise ValueError('drive.kind must be torque to take torques: got velocity')
        # A torque is no wheel speed: the guard only says whether it may act at all.
        finite = math.isfinite(right) and math.isfinite(left)
        wheels = STILL if finite else WheelSpeeds(math.nan, math.nan)
        now_ns = self._run_to(self._now_ns())
        self._guard.accept(RobotCommand(wheels, now_ns), now_ns)
        self._torque = (float(right), float(left))
        return self._advance_period()

    def set_pose(self, pose: Pose) -> None:
        """Put the robot elsewhere, its wheels turning as before; odometry does not notice.

        Raises
        ------
        ValueError
            The pose is not finite.
        """
        check_pose(pose)
        self._plant.pose = pose
        self._describe_again()

    def warm_up(self) -> None:
        """Compile everything that a step needs, on a robot of its own."""
        robot = SimulatedRobot(self._settings)
        if self._settings.drive.kind == 'torque':
            robot.step_torque(0.0, 0.0)
        else:
            robot.step(STILL)

    # -- inside -----------------------------------------------------------------------------------

    def _take_settings(self) -> None:
        settings = self._settings
        self._guard.settings = settings.guard
        self._odometry.settings = settings.odometry
        self._disturbance.settings = settings.disturbance
        self._noise.settings = settings.noise
        self._plant.load(
            settings.drive,
            (settings.body, settings.true_body),
            settings.geometry,
            settings.friction,
            settings.friction_factor,
        )

    def _integrate(self, count: int) -> None:
        """Run ``count`` steps under one command."""
        self._guarded = self._guard.advance(self._now_ns(), count * self._plant.step)
        braking = bool(self._guarded.reason)
        torque_mode = self._settings.drive.kind == 'torque' and not braking
        command = self._torque if torque_mode else self._guarded.wheels
        self._plant.run(command, braking, self._disturbance, count)

    def _measure(self) -> None:
        dt = (self._plant.steps_done - self._measured_at) * self._plant.step
        self._measured_at = self._plant.steps_done
        before, now = self._measured, self._noise.measure(self._plant.wheels)
        mean = WheelSpeeds(0.5 * (before.right + now.right), 0.5 * (before.left + now.left))
        self._odometry.drive(mean, dt, self._settings.noise.variance)
        self._measured = now
        self._disturbance.draw(dt)

    def _describe(self, stamp_ns: int) -> RobotState:
        geometry, guard, plant = self._settings.geometry, self._guard, self._plant
        status = RobotStatus(
            enabled=not guard.estop,
            moving=self._moving(),
            estop=guard.estop,
            timed_out=guard.timed_out,
            limited=self._guarded.limited,
        )
        return RobotState(
            stamp_ns=stamp_ns,
            wheels=self._measured,
            angles=WheelAngles(*plant.angles),
            odometry=Motion(
                stamp_ns, self._odometry.pose, body_from_wheels(self._measured, geometry)
            ),
            covariance=self._odometry.covariance,
            commanded=self._guarded.wheels,
            status=status,
            reason=guard.reason,
            true_wheels=plant.wheels,
            truth=Motion(stamp_ns, plant.pose, body_from_wheels(plant.wheels, geometry)),
        )

    def _moving(self) -> bool:
        return max(map(abs, self._plant.wheels)) > self._settings.rest_speed

    def _reset_reckoning(self) -> None:
        self._odometry.reset()
