# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Actuation of accelerations on a velocity-controlled robot: prediction, command E19, limits.

The plant (64) is chi' = g*(chi) + u + omega. With a torque drive, u is the torque theta_bar u.
With a velocity drive a first-order servo tracks the commanded wheel speeds c after a dead time,
chi' = (c - chi)/lag + ..., and the command

    c = chi + T u / (1 - exp(-T/lag))                                               E19

realises the acceleration u over one control period T, with chi the predicted wheel speed at the
instant the command takes effect. Both drives then have the discrete plant
chi_(k+1) = chi_k + T (u_k + d_k) without dead time. The command starts from the predicted wheel
speed, not from the previous command, so no integrator winds up when a limit is active.

Integrating u from the previous command instead (c_(k+1) = c_k + T u_k) makes the servo a second
integrator of the loop: only the feedback gain K then attenuates measurement noise and friction.
With E19 and K = (1 - exp(-T/lag))/T the measurement cancels in c: the servo provides the
feedback, and the law adds the terms that the servo model does not contain.
"""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.speed_filter import PREDICTED, SpeedFilterParameters, SpeedKalmanFilter
from t3mpc_ros.geometry.kinematics import WheelGeometry, body_speeds
from t3mpc_ros.geometry.types import BodyTwist
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LimitParameters(Parameters):
    """What a command may ask of the robot."""

    linear: float = parameter(
        0.35,
        'largest forward velocity |v|',
        name='linear.x.max_velocity',
        unit='m/s',
        low=0.01,
        high=5.0,
        dynamic=True,
    )
    angular: float = parameter(
        4.5,
        'largest yaw rate |omega|',
        name='angular.z.max_velocity',
        unit='rad/s',
        low=0.05,
        high=50.0,
        dynamic=True,
    )
    wheel_speed: float = parameter(
        10.0,
        'largest wheel speed; from here a robot without commands stops within 0.5 s',
        name='wheel.max_velocity',
        unit='rad/s',
        low=0.1,
        high=200.0,
        dynamic=True,
    )
    linear_acceleration: float = parameter(
        1.0,
        'largest |dv/dt|',
        name='linear.x.max_acceleration',
        unit='m/s²',
        low=0.01,
        high=50.0,
        dynamic=True,
    )
    angular_acceleration: float = parameter(
        14.0,
        'largest |d omega/dt|',
        name='angular.z.max_acceleration',
        unit='rad/s²',
        low=0.05,
        high=500.0,
        dynamic=True,
    )
    wheel_acceleration: float = parameter(
        30.0,
        'largest wheel acceleration, at most what the robot itself allows',
        name='wheel.max_acceleration',
        unit='rad/s²',
        low=0.1,
        high=1e4,
        dynamic=True,
    )


def wheel_limits(parameters: LimitParameters, geometry: WheelGeometry) -> Array:
    """Return the limits as wheels feel them, shape (2, 3).

    Rows: speeds (rad/s), accelerations (rad/s²). Columns: of the mean of both wheels, of half
    their difference, of either wheel; equation (1) turns the first two into v and omega.
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
    """Return the largest factor, at most 1, that brings two wheels within their limits.

    One factor for both keeps the curvature of the path.

    limits : shape (3,), of mean, half difference, either
    """
    mean, half = abs(0.5 * right + 0.5 * left), abs(0.5 * right - 0.5 * left)
    share = min(limits[0] / max(mean, limits[0]), limits[1] / max(half, limits[1]))
    return float(min(share, limits[2] / max(abs(right), abs(left), limits[2])))


@kernel
def limit_command(
    right: float, left: float, before: Array, limits: Array, period: float, out: Array
) -> bool:
    """Write the wheel speeds (rad/s) that may be commanded; decide whether they were cut.

    The wish is scaled into the speed limits, and what is sent is the point nearest to that, on
    the line from the last command, that the acceleration limits let it reach.

    right, left : the wish, rad/s
    before      : last command, rad/s, shape (2,)
    limits      : shape (2, 3), see :func:`limit_vector`
    out         : shape (2,), overwritten; may be ``before``
    """
    within = limit_scale(right, left, limits[0])
    step_right, step_left = within * right - before[0], within * left - before[1]
    reach = limit_scale(step_right / period, step_left / period, limits[1])
    out[0] = before[0] + reach * step_right
    out[1] = before[1] + reach * step_left
    return bool(abs(out[0] - right) > 1e-8 or abs(out[1] - left) > 1e-8)


@kernel
def actuation_command(
    acceleration: Array,
    known: Array,
    command: Array,
    limits: Array,
    period: float,
    stretch: float,
    applied: Array,
) -> bool:
    """Write the command of E19 and what it really means; decide whether a limit cut it.

    acceleration : shape (2,), wanted u, rad/s²
    known        : shape (3, 2), row AHEAD: speeds when the command begins to act, rad/s
    command      : shape (2,), the last one, overwritten by the next, rad/s
    limits       : shape (2, 3), see :func:`limit_vector`
    stretch      : T / (1 - exp(-T/lag)), s
    applied      : shape (2,), overwritten, the u that the command means, rad/s²
    """
    ahead = known[PREDICTED]
    right = ahead[0] + stretch * acceleration[0]
    left = ahead[1] + stretch * acceleration[1]
    limited = limit_command(right, left, command, limits, period, command)
    for i in range(applied.size):
        applied[i] = (command[i] - ahead[i]) / stretch
    return limited


class VelocityActuation:
    """Estimates what the wheels do, and makes them accelerate as the law wants (E19).

    Parameters
    ----------
    estimate
        What is assumed about sensors, lag and dead time.
    limits, geometry
        What a command may ask, and the lengths that turn wheel speeds into a twist.
    kind
        ``'velocity'`` or ``'torque'``; limits are for the former alone.
    period
        Nominal control period T, s.

    Raises
    ------
    ValueError
        Another ``kind``, or a period that is not positive.
    """

    def __init__(
        self,
        estimate: SpeedFilterParameters,
        limits: LimitParameters,
        geometry: WheelGeometry,
        kind: str,
        period: float,
    ) -> None:
        if not period > 0.0:
            raise ValueError(f'period must be positive: got {period} s')
        self._estimator = SpeedKalmanFilter(estimate, kind, period)
        self._limits = wheel_limits(limits, geometry)
        self._geometry = geometry
        self._lengths = geometry.wheel_radius, geometry.half_separation
        self._velocity = kind == 'velocity'
        self._period = period
        self._share = 1.0 - math.exp(-period / estimate.lag)
        self._felt = self._share * estimate.lag / period if self._velocity else 1.0
        self.applied: Array = np.zeros(2)
        """The acceleration u that the last command really means, rad/s², shape (2,)."""
        self.command: Array = np.zeros(2)
        """The wheel speeds last commanded, rad/s, shape (2,); zeros with a torque drive."""
        self.reset(np.zeros(2))

    @property
    def speeds(self) -> Array:
        """Estimated chi now, rad/s, shape (2,)."""
        return self._estimator.speeds

    @property
    def ahead(self) -> Array:
        """Estimated chi when the next command begins to act, rad/s, shape (2,)."""
        return self._estimator.ahead

    @property
    def unexplained(self) -> Array:
        """Estimated d of chi_(k+1) = chi_k + T (u_k + d_k), rad/s², shape (2,).

        A lagging servo gives way to a push only in part: with the velocity drive this is
        (1 - exp(-T/lag)) lag/T of the push itself, 79 % by default.
        """
        return self._felt * self._estimator.unexplained

    @property
    def estimator(self) -> SpeedKalmanFilter:
        """What estimates the wheel speeds."""
        return self._estimator

    @property
    def tables(self) -> tuple[Array, Array, float, float, Array]:
        """What :func:`choose_command` reads and writes beside its inputs, in its order."""
        return (
            self.command,
            self._limits,
            self._period,
            self._period / self._share,
            self.applied,
        )

    @property
    def dead_time(self) -> float:
        """Time until the next command begins to act, s."""
        return self._estimator.dead_time

    @property
    def twist(self) -> BodyTwist:
        """The command as a body twist: limited, as sent."""
        right, left = self.command.tolist()
        return BodyTwist(*body_speeds(right, left, *self._lengths))

    def configure(self, limits: LimitParameters) -> None:
        """Use other limits from the next command on."""
        self._limits = wheel_limits(limits, self._geometry)

    def reset(self, speeds: Array) -> None:
        """Start again from measured wheel speeds (rad/s); what is commanded is these speeds."""
        self._estimator.reset(speeds)
        self.applied[:] = 0.0
        self._sent = False
        self.limited = False
        """Whether a limit changed the last command."""
        self.command[:] = 0.0
        if self._velocity:
            right, left = speeds.tolist()
            self.command[:] = speeds * limit_scale(right, left, self._limits[0])

    def observe(self, measured: Array, dt: float) -> None:
        """Take in measured wheel speeds (rad/s), ``dt`` seconds after the last ones."""
        acted = self.command if self._velocity else self.applied
        self._estimator.observe(acted, measured, dt, sent=self._sent)

    def send(self, acceleration: Array) -> Array:
        """Return the accelerations (rad/s²) that will really be applied, shape (2,), by E19.

        Parameters
        ----------
        acceleration
            Wanted wheel accelerations u, rad/s², shape (2,).
        """
        self._sent = True
        if not self._velocity:
            self.applied[:] = acceleration
            return self.applied
        self.limited = actuation_command(
            acceleration,
            self._estimator.known,
            self.command,
            self._limits,
            self._period,
            self._period / self._share,
            self.applied,
        )
        return self.applied

    def aim(self, wheels: Array) -> None:
        """Command wheel speeds (rad/s), shape (2,), within the limits, whatever the robot does."""
        self._sent = True
        right, left = wheels.tolist()
        self.limited = limit_command(
            right, left, self.command, self._limits, self._period, self.command
        )
        self.applied[:] = 0.0

    def tell(self, wheels: Array) -> None:
        """Take note of what was sent in the place of :meth:`send`'s answer, in a recorded run say.

        Parameters
        ----------
        wheels
            Commanded wheel speeds, rad/s, shape (2,); no limit is applied.

        Raises
        ------
        ValueError
            The drive takes torques, or these are not two finite numbers.
        """
        if not self._velocity:
            raise ValueError('only a velocity drive can be told wheel speeds')
        if np.shape(wheels) != (2,) or not np.isfinite(wheels).all():
            raise ValueError(f'wheels must be two finite numbers: got {wheels}')
        self._sent = True
        self.limited = False
        self.command[:] = wheels
        self.applied[:] = (self.command - self.ahead) * (self._share / self._period)
