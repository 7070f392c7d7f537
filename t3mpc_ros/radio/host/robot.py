# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The robot on the radio behind the seam of every robot, as a pure function of time and bytes."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import math
import secrets

import numpy as np

from t3mpc_ros.motion import Geometry, Motion, WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels
from t3mpc_ros.motion.words import NANOSECONDS, ORIGIN, STANDSTILL
from t3mpc_ros.radio.link import Link, LinkSettings, Telemetry
from t3mpc_ros.radio.link.words import Deed, Phase
from t3mpc_ros.radio.statistics import Quality
from t3mpc_ros.robot.backend import (
    STILL,
    RobotBackend,
    RobotCommand,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.robot.guard import CommandGuard, GuardSettings
from t3mpc_ros.robot.sensors.fusion import FusedOdometry, FusedOdometrySettings
from t3mpc_ros.robot.twin.slip_stop import SLIPPING, SlipStop
from t3mpc_ros.settings import SettingError, Settings, nested, setting

SILENT = RobotStatus(
    enabled=False, moving=False, estop=False, timed_out=False, limited=False, imu_fault=True
)
"""What is known of a robot that was never heard."""


@dataclass(frozen=True)
class RadioRobotSettings(Settings):
    """Everything that can be set of the real robot, on the host's side."""

    geometry: Geometry = nested(Geometry)
    guard: GuardSettings = nested(GuardSettings)
    odometry: FusedOdometrySettings = nested(FusedOdometrySettings)
    link: LinkSettings = nested(LinkSettings)
    slip_stop: float = setting(
        1.0,
        'gyro and steps may disagree for so long, then the robot stops; 0 = it never does',
        unit='s',
        low=0.0,
        high=60.0,
        live=True,
    )

    def check_together(self) -> None:
        """Raise SettingError when the board would cut or lag behind what the host allows."""
        guard, board = self.guard, self.link.robot
        for name, host, there in (
            ('guard.wheel_speed', guard.wheel_speed, board.max_speed),
            ('guard.acceleration', guard.acceleration, board.acceleration),
            ('guard.stop_deceleration', guard.stop_deceleration, board.deceleration),
        ):
            if host > there:
                raise SettingError(
                    f'{name} must be at most what the board does itself, {there:g} '
                    f'(link.robot): got {host:g}'
                )


class RadioRobot(RobotBackend):
    """Drives the robot through :class:`Link`, and reckons where it is from what it reports.

    Whoever holds the port calls :meth:`step` as :class:`Link` asks for; all times are those of
    one steady clock, in nanoseconds. Stamps of the states are of that clock, too.

    Parameters
    ----------
    settings
        Live ones may be replaced, see :meth:`configure`.
    key
        Of the robot, 16 bytes; empty for an open link.
    entropy
        For session numbers and nonces.
    """

    def __init__(
        self,
        settings: RadioRobotSettings,
        key: bytes = b'',
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._settings = settings
        self.link = Link(settings.link, key, entropy)
        """The connection: its phase, its reason, its quality."""
        self._guard = CommandGuard(settings.guard, settings.geometry)
        self._odometry = FusedOdometry(settings.odometry, settings.geometry)
        self._slip_stop = SlipStop()
        self._period_ns = round(NANOSECONDS / settings.link.cycle_rate)
        self._next_ns = 0
        self._now_ns = 0
        self._seen: Telemetry | None = None
        self._resets = 0
        self._limited = False
        self._commanded = STILL
        self._fresh: deque[RobotState] = deque(maxlen=1024)
        self._state = self._unheard()

    # -- for whoever holds the port ---------------------------------------------------------------

    def step(self, now_ns: int, received: bytes = b'') -> list[Deed]:
        """Return what to do with the port now, see :meth:`Link.step`."""
        self._now_ns = now_ns
        # With the cycle, not beside it: by a clock of its own it would fall behind, and every
        # command would wait for the cycle after the next.
        due_ns = self.link.cycle_ns
        if now_ns >= (self._next_ns if due_ns is None else due_ns):
            self._next_ns = now_ns + self._period_ns
            self._order(now_ns)
        deeds = self.link.step(now_ns, received)
        telemetry = self.link.telemetry
        if telemetry is not None and telemetry is not self._seen:
            self._take(telemetry)
        return deeds

    def take_states(self) -> list[RobotState]:
        """Return the states that have come since the last call, oldest first."""
        states = list(self._fresh)
        self._fresh.clear()
        return states

    def quality(self, now_ns: int) -> Quality:
        """Return how well the link works."""
        return self.link.quality(now_ns)

    def reason(self, now_ns: int) -> str:
        """Return why the robot does not do what it is told; empty when it does."""
        if self.link.phase is not Phase.RUN:
            return self.link.reason(now_ns)
        return self._guard.reason or self.link.reason(now_ns)

    def configure(self, settings: RadioRobotSettings) -> None:
        """Go on with other live settings."""
        self._settings = settings
        self._guard.settings = settings.guard
        self._odometry.settings = settings.odometry

    def shut_down(self) -> None:
        """Bring the robot to rest, take its drives out, close the port."""
        self.link.shut_down()

    # -- the seam ---------------------------------------------------------------------------------

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from the next cycle on; return why not if it is refused."""
        if self._slip_stop.refuses(command, now_ns / NANOSECONDS):
            return SLIPPING
        return self._guard.accept(command, now_ns)

    def advance(self, now_ns: int) -> RobotState:
        """Return the newest state; its reason is of now, its numbers are of its stamp."""
        return self._state._replace(reason=self.reason(now_ns))

    def stop(self, reason: str, now_ns: int) -> None:
        """Come to rest; the next command moves the robot again."""
        self._guard.stop(reason, now_ns)
        self.link.stop(reason)

    def reset_odometry(self, now_ns: int) -> str:
        """Let dead reckoning start at the origin; refused while the robot moves."""
        if self._state.status.moving:
            return 'odometry cannot be reset while the robot moves'
        self._odometry.reset()
        self._state = self._state._replace(
            odometry=self._state.odometry._replace(pose=ORIGIN),
            covariance=self._odometry.covariance,
        )
        return ''

    def latch_estop(self, reason: str, now_ns: int) -> None:
        """Come to rest, and stay so; the robot obeys it from any session."""
        self._guard.latch(reason, now_ns)
        self.link.latch_estop(reason)

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop here and in the robot."""
        here, there = self._guard.release(now_ns), self.link.release_estop(now_ns)
        return there if here else ''

    # -- inside -----------------------------------------------------------------------------------

    def _order(self, now_ns: int) -> None:
        """Tell the link what the guard lets through, once per cycle."""
        guarded = self._guard.advance(now_ns, self._period_ns / NANOSECONDS)
        self._limited = guarded.limited
        # The guard's own ramp down is sent too: it is the gentler way than the board's to stop.
        if guarded.reason and guarded.wheels == STILL:
            self.link.stop(guarded.reason)
            self._commanded = STILL
        else:
            self.link.command(RobotCommand(guarded.wheels, now_ns), now_ns)
            self._commanded = guarded.wheels

    def _take(self, telemetry: Telemetry) -> None:
        before, self._seen = self._seen, telemetry
        resets = self.link.robot_resets
        if resets != self._resets:
            self._resets = resets
            self._odometry.forget_bias()
            before = None  # what it did meanwhile, nobody counted
        if before is not None:
            elapsed = (telemetry.stamp_ns - before.stamp_ns) / NANOSECONDS
            if elapsed > 0.0:
                self._odometry.update(
                    telemetry.angles.right - before.angles.right,
                    telemetry.angles.left - before.angles.left,
                    None if telemetry.imu is None else telemetry.imu.angular,
                    elapsed,
                )
        slipping_for = self._odometry.slipping_for
        now = self._now_ns / NANOSECONDS
        if self._slip_stop.decide(slipping_for, self._settings.slip_stop, now):
            self._guard.stop(SLIPPING, self._now_ns)
        self._state = self._describe(telemetry)
        self._fresh.append(self._state)

    def _describe(self, telemetry: Telemetry) -> RobotState:
        twist = body_from_wheels(telemetry.wheels, self._settings.geometry)
        status = telemetry.status._replace(
            slipping=self._odometry.slipping,
            limited=telemetry.status.limited or self._limited,
        )
        return RobotState(
            stamp_ns=telemetry.stamp_ns,
            wheels=telemetry.wheels,
            angles=telemetry.angles,
            odometry=Motion(telemetry.stamp_ns, self._odometry.pose, twist),
            covariance=self._odometry.covariance,
            commanded=self._commanded,
            status=status,
            reason=self.reason(self._now_ns),
            imu=telemetry.imu,
            ranges=telemetry.ranges,
            battery=self.link.battery,
        )

    def _unheard(self) -> RobotState:
        return RobotState(
            stamp_ns=0,
            wheels=WheelSpeeds(math.nan, math.nan),
            angles=WheelAngles(0.0, 0.0),
            odometry=Motion(0, ORIGIN, STANDSTILL),
            covariance=np.zeros((3, 3)),
            commanded=STILL,
            status=SILENT,
            reason=self.link.reason(0),
        )
