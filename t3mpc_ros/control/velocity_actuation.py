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
"""Velocity command for an acceleration: predicted wheel speeds, command E19, limits.

The plant (64) is chi' = g*(chi) + u + omega. With a torque drive, u is the torque theta_bar u.
With a velocity drive a first-order servo tracks the commanded wheel speeds c after a dead time,
chi' = (c - chi)/lag + ..., and the command

    c = chi + T u / (1 - exp(-T/lag))                                               E19

realises the acceleration u over one control period T, with chi the predicted wheel speed at the
instant at which the command takes effect. Both drives then have the discrete plant
chi_(k+1) = chi_k + T (u_k + d_k) without dead time. The command starts from the predicted wheel
speed, not from the previous command, so nothing winds up while a limit is active.

Integrating u from the previous command instead (c_(k+1) = c_k + T u_k) makes the servo a second
integrator of the loop: only the feedback gain K then attenuates measurement noise and friction.
With E19 and K = (1 - exp(-T/lag))/T the measurement cancels in c: the servo provides the
feedback, and the law adds the terms that the servo model does not contain.
"""

from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters, SpeedKalmanFilter
from t3mpc_ros.geometry.kinematics import WheelGeometry, body_speeds
from t3mpc_ros.geometry.types import Array, BodyTwist
from t3mpc_ros.kernels import TypedKernel, contiguous, kernel
from t3mpc_ros.parameters.table import Parameters, parameter

SHORTFALL, LEAST_SHORTFALL = 0.25, 0.3
"""Share of the command, and speed (rad/s), by which a wheel at a limit is slower than commanded:
an offset of friction is smaller, a wrong geometry is less."""
REACH, REACH_MEMORY = 0.85, 20.0
"""Share of the largest speed of a wheel from which it may be at a limit, and the time constant
with which that speed is forgotten, s."""
REST_FACTOR = 5.0
"""A wheel within this multiple of the standard deviation of its measurement may be at rest."""
STANDS, BEHIND, FAST = 0.45, 0.02, 5.0
"""Deadband: its share below which a wheel is to stand; angle (rad) that a slow wheel may be
behind or ahead; acceleration (rad/s²) from which a wheel passes too fast to meet its resonance.
Chosen by the settled error of the twin on seeds 2001 to 2006 and 3001 to 3006, and on creeping."""


@dataclass(frozen=True)
class LimitParameters(Parameters):
    """Limits of the commanded motion."""

    linear: float = parameter(
        0.35,
        'maximum forward speed |v|',
        'm/s',
        (0.01, 5.0),
        name='linear.x.max_velocity',
        dynamic=True,
    )
    angular: float = parameter(
        4.5,
        'maximum yaw rate |omega|',
        'rad/s',
        (0.05, 50.0),
        name='angular.z.max_velocity',
        dynamic=True,
    )
    wheel_speed: float = parameter(
        10.0,
        'maximum wheel speed; from this speed a robot without commands stops within 0.5 s',
        'rad/s',
        (0.1, 200.0),
        name='wheel.max_velocity',
        dynamic=True,
    )
    linear_acceleration: float = parameter(
        1.0,
        'maximum |dv/dt|',
        'm/s²',
        (0.01, 50.0),
        name='linear.x.max_acceleration',
        dynamic=True,
    )
    angular_acceleration: float = parameter(
        14.0,
        'maximum |d omega/dt|',
        'rad/s²',
        (0.05, 500.0),
        name='angular.z.max_acceleration',
        dynamic=True,
    )
    wheel_acceleration: float = parameter(
        30.0,
        'maximum acceleration of a wheel, at most the limit of the robot itself',
        'rad/s²',
        (0.1, 1e4),
        name='wheel.max_acceleration',
        dynamic=True,
    )
    deadband: float = parameter(
        0.055,
        'wheel speed below which stop or this speed is commanded, in turns with the right mean, '
        'where commands are shaped and no path is followed: pulses of a stepper at half of this '
        'speed meet the frequency of its rotor. At most a tenth of wheel.max_velocity acts; '
        '0: none',
        'rad/s',
        (0.0, 0.1),
        name='wheel.deadband_velocity',
        dynamic=True,
        source='twin: least settled error; name of nav2_velocity_smoother',
    )


class Deadband:
    """Commands stop or :attr:`speed`, whichever is nearer, in place of slower speeds of a wheel.

    A stepper that creeps meets the frequency of its rotor with its pulses. Where the angle that is
    turned too little or too much exceeds :data:`BEHIND`, the other one is commanded until it is
    made up, so that the mean speed is right.
    """

    def __init__(self) -> None:
        self.speed = 0.0  # rad/s; 0: nothing is left out
        self.reset(0.0)

    def reset(self, wanted: float) -> None:
        """Begin at a speed (rad/s), with nothing to make up for."""
        self._wanted, self._behind, self._makes_up = wanted, 0.0, False

    def step(self, wanted: float, elapsed: float) -> float:
        """Return the speed (rad/s) to command for ``elapsed`` s in place of the wanted one."""
        rate = abs(wanted - self._wanted) / elapsed
        if not 0.0 < abs(wanted) < self.speed or rate > FAST:  # or it is not a number
            self.reset(wanted)
            return wanted
        self._wanted = wanted
        moves = abs(wanted) > STANDS * self.speed
        behind = math.copysign(1.0, wanted) * self._behind * (-1.0 if moves else 1.0)
        self._makes_up = behind > (0.0 if self._makes_up else BEHIND)
        moves ^= self._makes_up
        commanded = math.copysign(self.speed, wanted) if moves else 0.0
        self._behind += (wanted - commanded) * elapsed
        return commanded


class VelocityActuation:
    """Estimates the wheel speeds and sends the commands that realise accelerations (E19).

    The limits apply to the drive ``'velocity'`` only, not to ``'torque'``; ``period`` is T, s.
    """

    def __init__(
        self,
        filter_parameters: SpeedFilterParameters,
        limits: LimitParameters,
        geometry: WheelGeometry,
        drive: str,
        period: float,
    ) -> None:
        self.speed_filter = SpeedKalmanFilter(filter_parameters, drive, period)
        state = self.speed_filter.state
        self.speeds = state.speeds  # estimated chi at the last measurement, rad/s, shape (2,)
        self.predicted = state.predicted
        """Predicted chi when the next command takes effect, rad/s, shape (2,)."""
        self._geometry = geometry
        self._deadbands = Deadband(), Deadband()
        self.configure(limits)
        self._lengths = geometry.wheel_radius, geometry.half_separation
        self.takes_speeds = drive == 'velocity'
        """Whether the drive takes wheel speeds, not torques."""
        self._period = period
        self._rest_speed = REST_FACTOR * math.sqrt(filter_parameters.noise_variance)
        lag = filter_parameters.lag
        self._servo_step = 1.0 - math.exp(-period / lag)
        self._disturbance_gain = self._servo_step * lag / period if self.takes_speeds else 1.0
        self.applied: Array = np.zeros(2)
        """Acceleration u that the last command realises before the deadband, rad/s², (2,)."""
        self.command: Array = np.zeros(2)
        """Last commanded wheel speeds, rad/s, shape (2,); zeros with a torque drive."""
        self._wanted = np.zeros(2)  # the same before the deadband, from which the limits go on
        self._actuation_command = TypedKernel(actuation_command)
        self._limit_command = TypedKernel(limit_command)
        self.reset(np.zeros(2))

    @property
    def disturbance(self) -> Array:
        """Estimated d of chi_(k+1) = chi_k + T (u_k + d_k), rad/s², shape (2,).

        A servo attenuates a disturbance: with the velocity drive, d is (1 - exp(-T/lag)) lag/T
        of the physical disturbance acceleration, 79 % by default.
        """
        return self._disturbance_gain * self.speed_filter.state.disturbance

    @property
    def dead_time(self) -> float:
        """Time until the next command takes effect, s."""
        return self.speed_filter.dead_time

    def set_dead_time(self, dead_time: float) -> None:
        """Use another dead time (s) from the next step on."""
        self.speed_filter.set_dead_time(dead_time)

    @property
    def twist(self) -> BodyTwist:
        """Body twist of the last command, after the limits."""
        right, left = self.command.tolist()
        return BodyTwist(*body_speeds(right, left, *self._lengths))

    def configure(self, limits: LimitParameters) -> None:
        """Use new limits from the next command on."""
        self._limits = wheel_limits(limits, self._geometry)
        for each in self._deadbands:
            each.speed = min(limits.deadband, 0.1 * limits.wheel_speed)

    def reset(
        self, speeds: Array, last_command: Array | None = None, *, follows: bool = False
    ) -> None:
        """Restart at measured wheel speeds, rad/s, shape (2,).

        The next command is within the acceleration limits of the last one; without that one the
        robot was commanded to stop, or by others. A robot that moves is taken over at its speed.
        One that may as well stand starts from standstill, and one that ``follows`` at the speed
        that was commanded last: the first command would otherwise be a step to the noise of one
        measurement.
        """
        expected = self.command.copy() if follows else np.zeros(2)
        if self.takes_speeds and np.abs(speeds - expected).max() <= self._rest_speed:
            speeds = expected
        self.speed_filter.reset(speeds)
        self.applied[:] = 0.0
        self._sent = False
        self.limited = False  # whether a limit changed the last command
        self.command[:] = 0.0
        if last_command is not None:
            self.command[:] = last_command
        elif self.takes_speeds:
            right, left = speeds.tolist()
            self.command[:] = speeds * limit_scale(right, left, self._limits[0])
        self._wanted[:] = self.command
        for each, speed in zip(self._deadbands, self.command.tolist(), strict=True):
            each.reset(speed)

    def _apply_deadbands(self, elapsed: float) -> None:
        """Command what is wanted, or what takes its place, within the limits."""
        if not self._deadbands[0].speed:
            self.command[:] = self._wanted
            return
        right, left = (
            each.step(wanted, elapsed)
            for each, wanted in zip(self._deadbands, self._wanted.tolist(), strict=True)
        )
        self._limit_command(right, left, self.command, self._limits, elapsed, self.command)

    def observe(self, measured: Array, dt: float) -> None:
        """Update the filter with wheel speeds (rad/s) measured ``dt`` s after the last update.

        NaN: there is no measurement, the wheels are where the commands have led them.
        """
        applied = self.command if self.takes_speeds else self.applied
        self.speed_filter.update(applied, measured, dt, sent=self._sent)

    def send_acceleration(self, acceleration: Array, elapsed: float = 0.0) -> Array:
        """Command u by E19, and return the part within the limits, rad/s², shape (2,).

        The change of the command is what the accelerations permit in ``elapsed`` s, one period at
        least.
        """
        self._sent = True
        if not self.takes_speeds:
            self.applied[:] = acceleration
            return self.applied
        elapsed = max(elapsed, self._period)
        self.limited = self._actuation_command(
            contiguous(acceleration),
            self.predicted,
            self._wanted,
            self._limits,
            elapsed,
            self._period / self._servo_step,
            self.applied,
        )
        self._apply_deadbands(elapsed)
        return self.applied

    def send_speeds(self, wheels: Array) -> None:
        """Command wheel speeds (rad/s), shape (2,), within the limits, without feedback."""
        self._sent = True
        right, left = wheels.tolist()
        self.limited = self._limit_command(
            right, left, self._wanted, self._limits, self._period, self._wanted
        )
        self._apply_deadbands(self._period)
        self.applied[:] = 0.0

    def set_command(self, wheels: Array) -> None:
        """Replace the last command by wheel speeds (rad/s) of a recorded run, without limits."""
        if not self.takes_speeds:
            raise ValueError('only a velocity drive has a command of wheel speeds')
        if np.shape(wheels) != (2,) or not np.isfinite(wheels).all():
            raise ValueError(f'wheels must be two finite numbers: got {wheels}')
        self._sent = True
        self.limited = False
        self.command[:] = self._wanted[:] = wheels
        self.applied[:] = (self.command - self.predicted) * (self._servo_step / self._period)


class ReachMonitor:
    """Whether a wheel is at a limit of the robot that the controller does not know.

    The error is then no estimation error: an estimate that learns it pushes the wheel on when it
    is long asked for less, as any integral does that winds up.
    """

    def __init__(self) -> None:
        self._largest = [0.0, 0.0]

    def update(
        self, speeds: list[float], command: list[float], unexplained: list[float], elapsed: float
    ) -> bool:
        """Return whether a wheel is at a limit; all rad/s, ``elapsed`` s since the last call.

        speeds      : estimated
        command     : sent last
        unexplained : by which the wheel is faster than its commands explain
        """
        kept, at_limit = max(1.0 - elapsed / REACH_MEMORY, 0.0), False
        for i, (speed, given, excess) in enumerate(zip(speeds, command, unexplained, strict=True)):
            self._largest[i] = max(abs(speed), kept * self._largest[i])
            short = max(SHORTFALL * abs(given), LEAST_SHORTFALL)
            slower = excess * given < 0.0 and abs(excess) > short
            at_limit |= slower and abs(speed) > REACH * self._largest[i]
        return at_limit


def wheel_limits(parameters: LimitParameters, geometry: WheelGeometry) -> Array:
    """Return the limits of the wheel motion, shape (2, 3).

    Rows: speeds (rad/s), accelerations (rad/s²). Columns: mean of both wheels, half of their
    difference, each wheel; equation (1) relates the first two to v and omega.
    """
    radius, half = geometry.wheel_radius, geometry.half_separation
    return np.array(
        [
            [
                parameters.linear / radius,
                parameters.angular * half / radius,
                parameters.wheel_speed,
            ],
            [
                parameters.linear_acceleration / radius,
                parameters.angular_acceleration * half / radius,
                parameters.wheel_acceleration,
            ],
        ]
    )


@kernel
def limit_scale(right: float, left: float, limits: Array) -> float:
    """Return the largest factor, at most 1, that scales two wheels into their limits.

    A common factor preserves the curvature of the path. ``limits``: a row of :func:`wheel_limits`.
    """
    mean, half = abs(0.5 * right + 0.5 * left), abs(0.5 * right - 0.5 * left)
    scale = min(limits[0] / max(mean, limits[0]), limits[1] / max(half, limits[1]))
    return float(min(scale, limits[2] / max(abs(right), abs(left), limits[2])))


@kernel
def limit_command(
    right: float, left: float, previous: Array, limits: Array, period: float, out: Array
) -> bool:
    """Write the admissible wheel speeds (rad/s); return whether a limit changed the target.

    The target is scaled into the speed limits. The result is the nearest point to it, on the line
    from the previous command, that the acceleration limits permit. ``out`` may be ``previous``.
    """
    scale = limit_scale(right, left, limits[0])
    step_right, step_left = scale * right - previous[0], scale * left - previous[1]
    reach = limit_scale(step_right / period, step_left / period, limits[1])
    out[0] = previous[0] + reach * step_right
    out[1] = previous[1] + reach * step_left
    return bool(abs(out[0] - right) > 1e-8 or abs(out[1] - left) > 1e-8)


@kernel
def actuation_command(
    acceleration: Array,
    predicted: Array,
    command: Array,
    limits: Array,
    period: float,
    command_gain: float,
    applied: Array,
) -> bool:
    """Write the command of E19 and the u (rad/s²) it realises; return whether it is limited.

    ``command`` is the previous command, ``period`` s old; ``command_gain`` is T / (1 -
    exp(-T/lag)).
    """
    right = predicted[0] + command_gain * acceleration[0]
    left = predicted[1] + command_gain * acceleration[1]
    limited = limit_command(right, left, command, limits, period, command)
    for i in range(applied.size):
        applied[i] = (command[i] - predicted[i]) / command_gain
    return limited
