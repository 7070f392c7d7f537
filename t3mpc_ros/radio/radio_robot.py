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
from t3mpc_ros.radio.link.actions_and_states import LinkState, PortAction
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.standstill_reasons import ANSWERS_AGAIN, ROBOT_SILENT, restarted
from t3mpc_ros.radio.link.statistics import LinkQuality
from t3mpc_ros.radio.link.telemetry import Telemetry
from t3mpc_ros.robot import command_limiter, interface
from t3mpc_ros.robot.calibration import CalibrationParameters
from t3mpc_ros.robot.gyro_odometry import GyroOdometry, GyroOdometryParameters

_COASTING_DECELERATION = 0.5
"""Least deceleration of a robot whose motors lost their power, m/s², assumed."""
_RESTART_WARNING_NS = 10 * NANOSECONDS  # time for which a restart is reported
UNKNOWN_STATUS = interface.RobotStatus(
    enabled=False, moving=False, estop=False, timed_out=False, limited=False, imu_fault=True
)
"""Status before the first telemetry."""


@dataclass(frozen=True)
class RadioRobotParameters(Parameters):
    """Parameters of the real robot on the host."""

    geometry: WheelGeometry = group(WheelGeometry, inline=True)
    limiter: command_limiter.CommandLimiterParameters = group(
        command_limiter.CommandLimiterParameters, inline=True
    )
    # The delay is that of the low-pass filter that the board sets.
    odometry: GyroOdometryParameters = group(GyroOdometryParameters, fixed=('gyro_delay',))
    link: LinkParameters = group(LinkParameters)
    calibration: CalibrationParameters = group(CalibrationParameters)
    slip_stop: float = parameter(
        1.0,
        'duration of a disagreement between gyro and steps after which the robot stops; 0: never',
        's',
        (0.0, 60.0),
        dynamic=True,
    )

    def check_consistency(self) -> None:
        """Raise ParameterError for a limit above that of the board, or a stop that is too slow."""
        limiter, link, board = self.limiter, self.link, self.link.robot
        for name, host, board_limit in (
            ('wheel.max_velocity', limiter.wheel_speed, board.max_speed),
            ('wheel.max_acceleration', limiter.acceleration, board.acceleration),
            ('wheel.stop_deceleration', limiter.stop_deceleration, board.deceleration),
        ):
            if host > board_limit:
                raise ParameterError(
                    f'{name} must be at most the limit of the board, {board_limit:g} '
                    f'(link.robot): got {host:g}'
                )
        # A stop begins and ends with a cycle; the end of the host is noticed after the TTL.
        silence = max(limiter.command_timeout + 1.0 / link.cycle_rate, link.ttl)
        limiter.check_stopping_time(
            silence,
            min(limiter.stop_deceleration, board.deceleration),
            'cmd_vel_timeout, link.cycle_rate, link.ttl, wheel.stop_deceleration, '
            'link.robot.deceleration',
        )


class RadioRobot(interface.RobotInterface):
    """Commands the robot through :class:`Link` and computes its odometry from the telemetry.

    The owner of the port calls :meth:`step` as for :class:`Link`. All times and stamps are
    nanoseconds of one steady clock. ``key`` and ``entropy`` as of :class:`Link`.
    """

    def __init__(
        self,
        parameters: RadioRobotParameters,
        key: bytes = b'',
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._parameters = parameters
        self.link = Link(parameters.link, key, entropy)  # connection to the robot
        self._limiter = command_limiter.CommandLimiter(parameters.limiter, parameters.geometry)
        self._odometry = GyroOdometry(parameters.odometry, parameters.geometry)
        self._slip_monitor = command_limiter.SlipMonitor()
        self._period_ns = round(NANOSECONDS / parameters.link.cycle_rate)
        self._ttl_ns = round(NANOSECONDS * parameters.link.ttl)
        self._next_ns = 0
        self._now_ns = 0
        self._telemetry: Telemetry | None = None
        self._resets = 0
        self._restart, self._restart_ns = '', 0
        self.unknown_travel = 0.0
        """Sum of the greatest path lengths that restarts in motion left unmeasured, m."""
        self._limited = False
        self._silence = ''  # reason of a stop for a robot that does not answer; empty when it does
        self._expiry_ns = 0  # time at which the robot stops by itself without another command
        self._commanded = interface.ZERO_WHEEL_SPEEDS
        self._new_states: deque[interface.RobotState] = deque(maxlen=1024)
        self._state = self._initial_state()

    # -- port -------------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return the actions to execute now, see :meth:`Link.step`."""
        self._now_ns = now_ns
        # The limiter runs in phase with the cycle of the link; with an independent period,
        # commands could wait for the cycle after the next.
        due_ns = self.link.next_cycle_ns
        if now_ns >= (self._next_ns if due_ns is None else due_ns):
            self._next_ns = now_ns + self._period_ns
            self._send_command(now_ns)
        actions = self.link.step(now_ns, received)
        telemetry = self.link.telemetry
        if telemetry is not None and telemetry is not self._telemetry:
            self._update(telemetry)
        return actions

    def take_states(self) -> list[interface.RobotState]:
        """Return the new states since the last call, oldest first."""
        states = list(self._new_states)
        self._new_states.clear()
        return states

    def quality(self, now_ns: int) -> LinkQuality:
        """Return the quality of the link."""
        return self.link.quality(now_ns)

    def reason(self, now_ns: int) -> str:
        """Return why the robot does not follow commands; empty when it does."""
        # First what is between host and robot: a stop of the host may not have arrived.
        if not self._answers(now_ns):
            return self.link.reason(now_ns) or ROBOT_SILENT
        return self._limiter.reason or self.link.reason(now_ns)

    def restart(self, now_ns: int) -> str:
        """Return what a restart of the robot in the last seconds left unknown; empty without."""
        return self._restart if now_ns - self._restart_ns < _RESTART_WARNING_NS else ''

    def configure(self, parameters: RadioRobotParameters) -> None:
        """Apply changed dynamic parameters."""
        self._parameters = parameters
        self._limiter.parameters = parameters.limiter
        self._odometry.parameters = parameters.odometry

    def shut_down(self) -> None:
        """Stop the robot, disable its drives, close the port."""
        self.link.shut_down()

    # -- robot interface --------------------------------------------------------------------------

    def apply(self, command: interface.RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from the next cycle on; return the reason for a rejection."""
        if self._slip_monitor.rejects(command, now_ns / NANOSECONDS):
            return command_limiter.SLIP_STOP_REASON
        return self._limiter.accept(command, now_ns)

    def advance(self, now_ns: int) -> interface.RobotState:
        """Return the newest state, with the current reason."""
        return self._state._replace(reason=self.reason(now_ns))

    def stop(self, reason: str, now_ns: int) -> None:
        """Stop until the next command."""
        self._limiter.stop(reason, now_ns)
        self.link.stop(reason)

    def reset_odometry(self, now_ns: int) -> str:
        """Reset the odometry to the origin; rejected while the robot moves."""
        if self._state.status.moving:
            return 'odometry cannot be reset while the robot moves'
        self._odometry.reset()
        self._state = self._state._replace(
            odometry=self._state.odometry._replace(pose=ORIGIN),
            covariance=self._odometry.covariance,
        )
        return ''

    def latch_estop(self, reason: str, now_ns: int) -> str:
        """Latch the emergency stop of host and robot; return why the robot does not get it."""
        why = '' if self._answers(now_ns) else self.reason(now_ns)
        self._limiter.latch(reason, now_ns)
        self.link.latch_estop(reason)
        return why

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop of host and robot."""
        host_error, robot_error = self._limiter.release(now_ns), self.link.release_estop(now_ns)
        return robot_error if host_error else ''

    # -- internal ---------------------------------------------------------------------------------

    def _answers(self, now_ns: int) -> bool:
        return self.link.state is LinkState.RUN and not self.link.is_silent(now_ns)

    def _send_command(self, now_ns: int) -> None:
        """Pass the limited command to the link, once per cycle."""
        if self.link.is_silent(now_ns):
            self._silence = self.link.reason(now_ns)
            self._limiter.stop(self._silence, now_ns)
        elif self._silence:
            if self._limiter.reason == self._silence:
                self._limiter.stop(ANSWERS_AGAIN, now_ns)
            self._silence = ''
        if 0 < self._limiter.remaining_ns(now_ns) < self._period_ns:
            self._limiter.expire()  # within this cycle
        if now_ns > self._expiry_ns + 2 * self._period_ns:
            # This process was suspended: the end of the ramp would move a robot that has stopped.
            self._limiter.assume_standstill()
        limited_command = self._limiter.advance(now_ns, self._period_ns / NANOSECONDS)
        self._limited = limited_command.limited
        wheels = self._commanded = limited_command.wheels
        stops = limited_command.target == interface.ZERO_WHEEL_SPEEDS
        if stops and not self._stops_gently():
            wheels = (
                interface.ZERO_WHEEL_SPEEDS
            )  # the board has the same ramp, and no late cycle delays it
        # A step of a stop expires after two cycles, and the board continues by itself.
        valid_ns = 2 * self._period_ns if stops else self._limiter.remaining_ns(now_ns)
        valid_ns = min(valid_ns, self._ttl_ns)
        self._expiry_ns = now_ns + valid_ns
        if limited_command.reason and wheels == interface.ZERO_WHEEL_SPEEDS:
            self.link.stop(limited_command.reason)
        else:
            self.link.command(wheels, self._expiry_ns)

    def _stops_gently(self) -> bool:
        """Return whether the stop of the host is slower than that of the board."""
        board = self._parameters.link.robot
        return self._limiter.parameters.stop_deceleration < board.deceleration

    def _update(self, telemetry: Telemetry) -> None:
        before, self._telemetry = self._telemetry, telemetry
        resets = self.link.robot_resets
        if resets != self._resets:
            self._resets = resets
            self._odometry.forget_bias()
            self._report_restart(before, telemetry)
            before = None  # motion during the restart was not counted
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
        if self._slip_monitor.update(slipping_for, self._parameters.slip_stop, now):
            self._limiter.stop(command_limiter.SLIP_STOP_REASON, self._now_ns)
        self._state = self._make_state(telemetry)
        self._new_states.append(self._state)

    def _report_restart(self, before: Telemetry | None, after: Telemetry) -> None:
        """Add the greatest travel since the last measurement to the uncertainty of the pose.

        The robot followed its last command until the restart, or until that expired, then it
        rolled without power.
        """
        right = left = 0.0
        if before is not None:
            booted_ns = after.stamp_ns - 1000 * after.raw.time_us
            longest = self._parameters.limiter.max_stopping_time
            driven = min(max(booted_ns - before.stamp_ns, 0) / NANOSECONDS, longest)
            right, left = (
                self._unmeasured_travel(measured, commanded, driven)
                for measured, commanded in zip(before.wheels, self._state.commanded, strict=True)
            )
            self._odometry.add_unknown_travel(right, left)
        unknown = max(abs(right), abs(left))
        self.unknown_travel += unknown
        cause = 0 if self.link.info is None else self.link.info.reset_cause
        self._restart, self._restart_ns = restarted(cause, unknown), self._now_ns

    def _unmeasured_travel(self, measured: float, commanded: float, driven: float) -> float:
        """Return the greatest distance (m) of a wheel after ``driven`` seconds at its speed."""
        radius = self._parameters.geometry.wheel_radius
        speed = radius * max(measured, commanded, key=abs)
        return speed * driven + speed * abs(speed) / (2.0 * _COASTING_DECELERATION)

    def _make_state(self, telemetry: Telemetry) -> interface.RobotState:
        twist = twist_from_wheels(telemetry.wheels, self._parameters.geometry)
        status = telemetry.status._replace(
            slipping=self._odometry.slipping,
            limited=telemetry.status.limited or self._limited,
        )
        return interface.RobotState(
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

    def _initial_state(self) -> interface.RobotState:
        return interface.RobotState(
            stamp_ns=0,
            wheels=WheelSpeeds(math.nan, math.nan),
            angles=interface.WheelAngles(0.0, 0.0),
            odometry=State(0, ORIGIN, STANDSTILL),
            covariance=np.zeros((3, 3)),
            commanded=interface.ZERO_WHEEL_SPEEDS,
            status=UNKNOWN_STATUS,
            reason=self.link.reason(0),
        )
