# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: dynamics, loads, drive, guard and odometry on one fixed time grid."""

from collections import deque
from dataclasses import dataclass, replace
from fractions import Fraction
import math

from t3mpc_ros.motion import Geometry, Motion, Pose, WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.robot.backend import (
    STILL,
    RobotBackend,
    RobotCommand,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.robot.drive import STABLE, DriveSettings, Plant, fastest_rate
from t3mpc_ros.robot.dynamics import BodySettings
from t3mpc_ros.robot.guard import CLOCK_WENT_BACK, CommandGuard, GuardSettings
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
        drive, guard = self.drive, self.guard
        if drive.kind == 'velocity' and 0.0 < drive.acceleration < guard.stop_deceleration:
            raise SettingError(
                'drive.acceleration must be at least guard.stop_deceleration '
                f'({guard.stop_deceleration:g} rad/s²), or 0: got {drive.acceleration:g}'
            )


class SimulatedRobot(RobotBackend):
    """A robot that exists in numbers only.

    Time runs on a fixed grid that starts at the first instant it hears of. States are reported
    once per control period; a command takes effect at the integration step in which it arrives.
    What comes out depends on the settings and the calls alone: equal runs are equal bit for bit.

    Disturbance and noise come from generators of their own, and draw the same numbers whatever
    their settings: changing one does not shift the other.
    """

    def __init__(self, settings: SimulatedRobotSettings) -> None:
        self._settings = settings
        for_disturbance, for_noise = generators(settings.seed)
        self._guard = CommandGuard(settings.guard, settings.geometry)
        self._odometry = DeadReckoning(settings.odometry, settings.geometry)
        self._disturbance = Disturbance(settings.disturbance, for_disturbance)
        self._noise = SpeedNoise(settings.noise, for_noise)
        self._substeps = settings.substeps
        # A ratio of whole numbers: stamps stay exact however long the robot runs.
        self._frequency = Fraction(settings.rate) * self._substeps / NANOSECONDS
        self._plant = Plant(settings.drive, settings.step)
        self._measured = STILL
        self._torque = (0.0, 0.0)
        self._guarded = self._guard.advance(0, 0.0)
        self._origin_ns: int | None = None
        self._since_origin = 0
        """Integration steps since the origin of the grid."""
        self._reported_at = 0
        """Integration steps the plant had done at the last report."""
        self._take_settings()
        self._reports = deque([self._describe(0)], maxlen=1024)
        """The newest, and older ones that nobody has asked for."""

    # -- the seam ---------------------------------------------------------------------------------

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from now on; return why not if it is refused.

        Raises
        ------
        ValueError
            The drive takes torques; then see :meth:`step_torque`.
        """
        if self._settings.drive.kind == 'torque':
            raise ValueError('drive.kind must be velocity to take wheel speeds: got torque')
        return self._guard.accept(command, self._run_to(now_ns))

    def advance(self, now_ns: int) -> RobotState:
        """Return the state at the last point of the grid that is not later than ``now_ns``."""
        self._run_to(now_ns, whole_periods=True)
        reports = self._reports
        while len(reports) > 1 and reports[1].stamp_ns <= now_ns:
            reports.popleft()
        return reports[0]

    def stop(self, reason: str, now_ns: int) -> None:
        """Come to rest; the next command moves the robot again."""
        self._guard.stop(reason, self._run_to(now_ns))

    def reset_odometry(self, now_ns: int) -> str:
        """Let dead reckoning start at the origin; refused while the robot moves."""
        self._run_to(now_ns)
        if self._moving():
            return 'odometry cannot be reset while the robot moves'
        self._odometry.reset()
        self._reports[-1] = self._describe(self._reports[-1].stamp_ns)
        return ''

    def latch_estop(self, reason: str, now_ns: int) -> None:
        """Come to rest, and stay so until :meth:`release_estop`."""
        self._guard.latch(reason, self._run_to(now_ns))

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop; the robot then waits for a new command."""
        return self._guard.release(self._run_to(now_ns))

    # -- only in simulation -----------------------------------------------------------------------

    @property
    def settings(self) -> SimulatedRobotSettings:
        """The table in force."""
        return self._settings

    @property
    def state(self) -> RobotState:
        """The state last reported."""
        return self._reports[-1]

    def step(self, wheels: WheelSpeeds) -> RobotState:
        """Command ``wheels`` now and return the state one control period later.

        For closed loops without a clock: the robot's own grid is the time.
        """
        now_ns = self._now_ns()
        self.apply(RobotCommand(wheels, now_ns), now_ns)
        return self._advance_period()

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
        if not all(map(math.isfinite, pose)):
            raise ValueError(f'pose must be finite: got {pose}')
        self._plant.pose = pose
        self._reports[-1] = self._describe(self._reports[-1].stamp_ns)

    def configure(self, settings: SimulatedRobotSettings) -> None:
        """Go on with other settings, a heavier load say.

        Raises
        ------
        SettingError
            A setting differs that is fixed once the robot is made.
        """
        before, after = self._settings.flat(), settings.flat()
        for row in SimulatedRobotSettings.rows():
            if not row.live and before[row.name] != after[row.name]:
                raise SettingError(
                    f'{row.name} is fixed while the robot runs '
                    f'(it is {before[row.name]}): got {after[row.name]}'
                )
        self._settings = settings
        self._take_settings()

    def warm_up(self) -> None:
        """Compile everything that a step needs, on a robot of its own."""
        robot = SimulatedRobot(self._settings)
        if self._settings.drive.kind == 'torque':
            robot.step_torque(0.0, 0.0)
        else:
            robot.step(STILL)

    # -- inside -----------------------------------------------------------------------------------

    def _advance_period(self) -> RobotState:
        return self.advance(self._after(self._since_origin + self._substeps))

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

    def _now_ns(self) -> int:
        """Return the time of the last finished substep."""
        return self._after(self._since_origin)

    def _after(self, steps: int) -> int:
        """Return the instant (ns) that lies ``steps`` integration steps after the origin."""
        top, bottom = self._frequency.as_integer_ratio()
        return (self._origin_ns or 0) + (2 * steps * bottom + top) // (2 * top)

    def _run_to(self, now_ns: int, whole_periods: bool = False) -> int:
        """Integrate up to ``now_ns`` and return the instant reached, within a step before it.

        Reports are made on the way. A clock that went back to before the state last handed out,
        or that left the longest gap behind, starts a new grid. One that went back by less is a
        late question for a report that was made already.
        """
        latest_ns = self._now_ns() + round(self._settings.longest_gap * NANOSECONDS)
        if self._origin_ns is None:
            self._reports.clear()
            self._start_grid(now_ns)
        elif now_ns < self._reports[0].stamp_ns:
            self._guard.stop(CLOCK_WENT_BACK, now_ns)
            self._reports.clear()
            self._start_grid(now_ns)
        elif now_ns > latest_ns:
            self._integrate_to(latest_ns, whole_periods)
            self._start_grid(now_ns)
        else:
            self._integrate_to(now_ns, whole_periods)
        return self._now_ns()

    def _start_grid(self, now_ns: int) -> None:
        self._origin_ns = now_ns
        self._since_origin = 0
        self._make_report()

    def _integrate_to(self, now_ns: int, whole_periods: bool) -> None:
        substeps = self._substeps
        # Half a nanosecond more, because stamps are rounded to whole ones.
        elapsed = 2 * (now_ns - (self._origin_ns or 0)) + 1
        top, bottom = self._frequency.as_integer_ratio()
        goal = elapsed * top // (2 * bottom)
        if whole_periods:
            goal -= goal % substeps
        while self._since_origin < goal:
            count = min(substeps - self._since_origin % substeps, goal - self._since_origin)
            self._integrate(count)
            if self._since_origin % substeps == 0:
                self._make_report()

    def _integrate(self, count: int) -> None:
        """Run ``count`` steps under one command."""
        self._guarded = self._guard.advance(self._now_ns(), count * self._plant.step)
        braking = bool(self._guarded.reason)
        torque_mode = self._settings.drive.kind == 'torque' and not braking
        command = self._torque if torque_mode else self._guarded.wheels
        self._plant.run(command, braking, self._disturbance, count)
        self._since_origin += count

    def _make_report(self) -> None:
        """Measure, reckon, describe, and draw what disturbs the next period."""
        dt = (self._plant.steps_done - self._reported_at) * self._plant.step
        self._reported_at = self._plant.steps_done
        before, now = self._measured, self._noise.measure(self._plant.wheels)
        mean = WheelSpeeds(0.5 * (before.right + now.right), 0.5 * (before.left + now.left))
        self._odometry.drive(mean, dt, self._settings.noise.variance)
        self._measured = now
        self._disturbance.draw(dt)
        self._reports.append(self._describe(self._now_ns()))

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
