# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The real robot behind the robot interface, as a pure function of time and bytes."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import math
import secrets

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, STANDSTILL, State, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import LinkState, PortAction
from t3mpc_ros.radio.link.statistics import LinkQuality
from t3mpc_ros.radio.link.telemetry import Telemetry
from t3mpc_ros.robot.command_limiter import CommandLimiter, CommandLimiterParameters
from t3mpc_ros.robot.gyro_odometry import GyroOdometry, GyroOdometryParameters
from t3mpc_ros.robot.interface import (
    ZERO_WHEEL_SPEEDS,
    RobotCommand,
    RobotInterface,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.robot.slip_monitor import SLIP_STOP_REASON, SlipMonitor

UNKNOWN_STATUS = RobotStatus(
    enabled=False, moving=False, estop=False, timed_out=False, limited=False, imu_fault=True
)
"""What is known of a robot that was never heard."""


@dataclass(frozen=True)
class RadioRobotParameters(Parameters):
    """Everything that can be set of the real robot, on the host's side."""

    geometry: WheelGeometry = group(WheelGeometry, inline=True)
    limiter: CommandLimiterParameters = group(CommandLimiterParameters, inline=True)
    odometry: GyroOdometryParameters = group(GyroOdometryParameters)
    link: LinkParameters = group(LinkParameters)
    slip_stop: float = parameter(
        1.0,
        'gyro and steps may disagree for so long, then the robot stops; 0 = it never does',
        unit='s',
        low=0.0,
        high=60.0,
        dynamic=True,
    )

    def check_consistency(self) -> None:
        """Raise ParameterError when the board would cut or lag behind what the host allows."""
        limiter, board = self.limiter, self.link.robot
        for name, host, there in (
            ('wheel.max_velocity', limiter.wheel_speed, board.max_speed),
            ('wheel.max_acceleration', limiter.acceleration, board.acceleration),
            ('wheel.stop_deceleration', limiter.stop_deceleration, board.deceleration),
        ):
            if host > there:
                raise ParameterError(
                    f'{name} must be at most what the board does itself, {there:g} '
                    f'(link.robot): got {host:g}'
                )


class RadioRobot(RobotInterface):
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
        parameters: RadioRobotParameters,
        key: bytes = b'',
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._parameters = parameters
        self.link = Link(parameters.link, key, entropy)
        """The connection: its phase, its reason, its quality."""
        self._limiter = CommandLimiter(parameters.limiter, parameters.geometry)
        self._odometry = GyroOdometry(parameters.odometry, parameters.geometry)
        self._slip_monitor = SlipMonitor()
        self._period_ns = round(NANOSECONDS / parameters.link.cycle_rate)
        self._next_ns = 0
        self._now_ns = 0
        self._seen: Telemetry | None = None
        self._resets = 0
        self._limited = False
        self._commanded = ZERO_WHEEL_SPEEDS
        self._fresh: deque[RobotState] = deque(maxlen=1024)
        self._state = self._unheard()

    # -- for whoever holds the port ---------------------------------------------------------------

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return what to do with the port now, see :meth:`Link.step`."""
        self._now_ns = now_ns
        # With the cycle, not beside it: by a clock of its own it would fall behind, and every
        # command would wait for the cycle after the next.
        due_ns = self.link.next_cycle_ns
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

    def quality(self, now_ns: int) -> LinkQuality:
        """Return how well the link works."""
        return self.link.quality(now_ns)

    def reason(self, now_ns: int) -> str:
        """Return why the robot does not do what it is told; empty when it does."""
        if self.link.state is not LinkState.RUN:
            return self.link.reason(now_ns)
        return self._limiter.reason or self.link.reason(now_ns)

    def configure(self, parameters: RadioRobotParameters) -> None:
        """Go on with other live settings."""
        self._parameters = parameters
        self._limiter.parameters = parameters.limiter
        self._odometry.parameters = parameters.odometry

    def shut_down(self) -> None:
        """Bring the robot to rest, take its drives out, close the port."""
        self.link.shut_down()

    # -- the seam ---------------------------------------------------------------------------------

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from the next cycle on; return why not if it is refused."""
        if self._slip_monitor.refuses(command, now_ns / NANOSECONDS):
            return SLIP_STOP_REASON
        return self._limiter.accept(command, now_ns)

    def advance(self, now_ns: int) -> RobotState:
        """Return the newest state; its reason is of now, its numbers are of its stamp."""
        return self._state._replace(reason=self.reason(now_ns))

    def stop(self, reason: str, now_ns: int) -> None:
        """Come to rest; the next command moves the robot again."""
        self._limiter.stop(reason, now_ns)
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
        self._limiter.latch(reason, now_ns)
        self.link.latch_estop(reason)

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop here and in the robot."""
        here, there = self._limiter.release(now_ns), self.link.release_estop(now_ns)
        return there if here else ''

    # -- inside -----------------------------------------------------------------------------------

    def _order(self, now_ns: int) -> None:
        """Tell the link what the guard lets through, once per cycle."""
        limited_command = self._limiter.advance(now_ns, self._period_ns / NANOSECONDS)
        self._limited = limited_command.limited
        # The guard's own ramp down is sent too: it is the gentler way than the board's to stop.
        if limited_command.reason and limited_command.wheels == ZERO_WHEEL_SPEEDS:
            self.link.stop(limited_command.reason)
            self._commanded = ZERO_WHEEL_SPEEDS
        else:
            self.link.command(RobotCommand(limited_command.wheels, now_ns), now_ns)
            self._commanded = limited_command.wheels

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
        if self._slip_monitor.decide(slipping_for, self._parameters.slip_stop, now):
            self._limiter.stop(SLIP_STOP_REASON, self._now_ns)
        self._state = self._make_state(telemetry)
        self._fresh.append(self._state)

    def _make_state(self, telemetry: Telemetry) -> RobotState:
        twist = twist_from_wheels(telemetry.wheels, self._parameters.geometry)
        status = telemetry.status._replace(
            slipping=self._odometry.slipping,
            limited=telemetry.status.limited or self._limited,
        )
        return RobotState(
            stamp_ns=telemetry.stamp_ns,
            wheels=telemetry.wheels,
            angles=telemetry.angles,
            odometry=State(telemetry.stamp_ns, self._odometry.pose, twist),
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
            odometry=State(0, ORIGIN, STANDSTILL),
            covariance=np.zeros((3, 3)),
            commanded=ZERO_WHEEL_SPEEDS,
            status=UNKNOWN_STATUS,
            reason=self.link.reason(0),
        )
