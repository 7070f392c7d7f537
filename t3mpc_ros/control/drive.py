# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The seam between a law that chooses accelerations and the robot: estimate, servo, limits.

The paper's plant (64) is chi' = g*(chi) + u + omega. With a torque drive u is the torque
theta_bar u. With a velocity drive a servo pulls the wheels towards the commanded speeds c,
chi' = (c - chi)/lag + ..., a dead time later, so the acceleration u is had by commanding

    c = chi + T u / (1 - exp(-T/lag)),                                              E19

chi being the speed at which the wheels will be when c begins to act, and T the control period.
Both drives are then one plant, chi_(k+1) = chi_k + T (u_k + d_k), without a dead time. This is
the integral of u from where the wheels really are, so nothing can wind up behind a limit.

Integrating u into c from the *last command* instead (c_(k+1) = c_k + T u_k) takes the servo for
a second integrator of the law: measured noise and friction then reach the wheels filtered by the
law's own K only. With E19 and K = (1 - exp(-T/lag))/T the measurement drops out of c altogether:
the servo is the feedback, and the law adds what the servo cannot know.
"""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.estimate import AHEAD, EstimateSettings, SpeedEstimator
from t3mpc_ros.kernels import kernel
from t3mpc_ros.motion import BodyTwist, Geometry
from t3mpc_ros.motion.kinematics import body_speeds
from t3mpc_ros.settings import Settings, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LimitSettings(Settings):
    """What a command may ask of the robot."""

    linear: float = setting(
        0.35, 'largest forward speed |v|', unit='m/s', low=0.01, high=5.0, live=True
    )
    angular: float = setting(
        4.5, 'largest turning speed |omega|', unit='rad/s', low=0.05, high=50.0, live=True
    )
    wheel_speed: float = setting(
        10.0,
        'largest wheel speed; from here a robot that hears nothing more rests within 0.5 s',
        unit='rad/s',
        low=0.1,
        high=200.0,
        live=True,
    )
    linear_acceleration: float = setting(
        1.0, 'largest |dv/dt|', unit='m/s²', low=0.01, high=50.0, live=True
    )
    angular_acceleration: float = setting(
        14.0, 'largest |d omega/dt|', unit='rad/s²', low=0.05, high=500.0, live=True
    )
    wheel_acceleration: float = setting(
        30.0,
        'largest acceleration of a wheel, no more than the robot itself allows',
        unit='rad/s²',
        low=0.1,
        high=1e4,
        live=True,
    )


def limit_vector(settings: LimitSettings, geometry: Geometry) -> Array:
    """Return the limits as wheels feel them, shape (2, 3).

    Rows: speeds (rad/s), accelerations (rad/s²). Columns: of the mean of both wheels, of half
    their difference, of either wheel; equation (1) turns the first two into v and omega.
    """
    radius, half = geometry.wheel_radius, geometry.half_separation
    return np.array(
        [
            [settings.linear / radius, settings.angular * half / radius, settings.wheel_speed],
            [
                settings.linear_acceleration / radius,
                settings.angular_acceleration * half / radius,
                settings.wheel_acceleration,
            ],
        ]
    )


@kernel
def share_within(right: float, left: float, limits: Array) -> float:
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
    within = share_within(right, left, limits[0])
    step_right, step_left = within * right - before[0], within * left - before[1]
    reach = share_within(step_right / period, step_left / period, limits[1])
    out[0] = before[0] + reach * step_right
    out[1] = before[1] + reach * step_left
    return bool(abs(out[0] - right) > 1e-8 or abs(out[1] - left) > 1e-8)


@kernel
def choose_command(
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
    ahead = known[AHEAD]
    right = ahead[0] + stretch * acceleration[0]
    left = ahead[1] + stretch * acceleration[1]
    limited = limit_command(right, left, command, limits, period, command)
    for i in range(applied.size):
        applied[i] = (command[i] - ahead[i]) / stretch
    return limited


class Drive:
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
        estimate: EstimateSettings,
        limits: LimitSettings,
        geometry: Geometry,
        kind: str,
        period: float,
    ) -> None:
        if not period > 0.0:
            raise ValueError(f'period must be positive: got {period} s')
        self._estimator = SpeedEstimator(estimate, kind, period)
        self._limits = limit_vector(limits, geometry)
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
    def estimator(self) -> SpeedEstimator:
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

    def configure(self, limits: LimitSettings) -> None:
        """Use other limits from the next command on."""
        self._limits = limit_vector(limits, self._geometry)

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
            self.command[:] = speeds * share_within(right, left, self._limits[0])

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
        self.limited = choose_command(
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
