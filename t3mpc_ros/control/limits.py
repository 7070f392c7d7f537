# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From wanted acceleration to a velocity command within limits, without wind-up."""

from dataclasses import dataclass

from t3mpc_ros.motion import BodyTwist, Geometry, WheelSpeeds
from t3mpc_ros.motion.kinematics import body_from_wheels, wheels_from_body
from t3mpc_ros.settings import Settings, setting


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
    tracking_time: float = setting(
        0.02,
        'time constant with which the integrated command is pulled back to the limited one',
        unit='s',
        low=0.001,
        high=10.0,
    )


def limit_twist(twist: BodyTwist, settings: LimitSettings, geometry: Geometry) -> BodyTwist:
    """Return ``twist`` scaled into the speed limits by one factor, so that curvature is kept."""
    wheels = wheels_from_body(twist, geometry)
    factor = min(
        _share(twist.linear, settings.linear),
        _share(twist.angular, settings.angular),
        _share(wheels.right, settings.wheel_speed),
        _share(wheels.left, settings.wheel_speed),
    )
    return BodyTwist(twist.linear * factor, twist.angular * factor)


def limit_change(
    wanted: BodyTwist,
    previous: BodyTwist,
    settings: LimitSettings,
    geometry: Geometry,
    dt: float,
) -> BodyTwist:
    """Return the twist nearest to ``wanted``, on the line from ``previous``, reachable in dt."""
    change = BodyTwist(wanted.linear - previous.linear, wanted.angular - previous.angular)
    wheels = wheels_from_body(change, geometry)
    factor = min(
        _share(change.linear, settings.linear_acceleration * dt),
        _share(change.angular, settings.angular_acceleration * dt),
        _share(wheels.right, settings.wheel_acceleration * dt),
        _share(wheels.left, settings.wheel_acceleration * dt),
    )
    return BodyTwist(
        previous.linear + factor * change.linear, previous.angular + factor * change.angular
    )


def _share(value: float, limit: float) -> float:
    """Return the factor, at most 1, that brings ``value`` within ``limit``."""
    return limit / max(abs(value), limit)


class VelocityCommand:
    """Integrates the law's acceleration into the velocity that the robot is told.

    The robot takes velocities, not torques: the command integrates u. Where a limit cuts it, the
    integral is pulled back to what was really sent (back-calculation), so nothing winds up.

    Parameters
    ----------
    settings, geometry
        The limits, and the lengths that turn wheel speeds into a twist.
    """

    def __init__(self, settings: LimitSettings, geometry: Geometry) -> None:
        self._settings = settings
        self._geometry = geometry
        self.reset(WheelSpeeds(0.0, 0.0))

    def configure(self, settings: LimitSettings) -> None:
        """Use other limits from the next step on."""
        self._settings = settings

    def reset(self, wheels: WheelSpeeds) -> None:
        """Go on from the wheel speeds (rad/s) that the robot has now."""
        self._integral = body_from_wheels(wheels, self._geometry)
        self.twist = limit_twist(self._integral, self._settings, self._geometry)
        """The command: limited, as sent."""
        self.limited = False
        """Whether the last step was cut by a limit."""

    @property
    def wheels(self) -> WheelSpeeds:
        """The command as wheel speeds, rad/s."""
        return wheels_from_body(self.twist, self._geometry)

    def step(self, acceleration: WheelSpeeds, dt: float) -> WheelSpeeds:
        """Return the wheel accelerations (rad/s²) that are really applied.

        Parameters
        ----------
        acceleration
            Wanted wheel accelerations u, rad/s².
        dt
            Seconds until the next step.
        """
        before = self.wheels
        push = body_from_wheels(acceleration, self._geometry)
        raw = BodyTwist(
            self._integral.linear + dt * push.linear, self._integral.angular + dt * push.angular
        )
        reachable = limit_twist(raw, self._settings, self._geometry)
        sent = limit_change(reachable, self.twist, self._settings, self._geometry, dt)
        share = min(1.0, dt / self._settings.tracking_time)
        self._integral = BodyTwist(
            raw.linear + share * (sent.linear - raw.linear),
            raw.angular + share * (sent.angular - raw.angular),
        )
        self.limited = (
            abs(sent.linear - raw.linear) > 1e-9 or abs(sent.angular - raw.angular) > 1e-9
        )
        self.twist = sent
        after = self.wheels
        return WheelSpeeds((after.right - before.right) / dt, (after.left - before.left) / dt)
