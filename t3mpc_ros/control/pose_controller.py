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
r"""Pose loop E22: from the error of the pose to the twist that the law of section 6 tracks.

With the error of the reference pose in the frame of the robot, :math:`x_e` along, :math:`y_e`
across and :math:`\theta_e` in yaw, and the reference twist :math:`(v_r, \omega_r)`,

.. math::

    v = v_r \cos\theta_e + k_x x_e, \qquad
    \omega = \omega_r + k_y v_r \frac{\sin\theta_e}{\theta_e} y_e + k_\theta \theta_e + v_r z

(Morin and Samson, Springer Handbook of Robotics, 2008, chapter 34; after Kanayama et al., ICRA
1990, doi 10.1109/ROBOT.1990.126006, whose :math:`\sin\theta_e` in place of the last term has a
second equilibrium at half a turn). The integral :math:`\dot z = k_i\,|v_r|\,y_e` removes the
offset of wheels that differ, which bend the path; it is bounded, and rests far from the
reference.

Far from its reference, after a detour, the robot drives to it (*rejoining*): it turns towards the
velocity that closes the gap, and drives on as far as it faces it.
"""

from bisect import bisect_right
from dataclasses import dataclass
import math
from typing import NamedTuple

from t3mpc_ros.geometry.trajectory import REFERENCE_SAMPLES
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, State, wrap_angle
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

CURVATURE_LIMIT = 0.3
"""Largest curvature of the integral, 1/m: wheels that differ by 4 % at a separation of 0.15 m."""
LEARNT_ERROR = 0.02
"""Error across beyond which the integral rests, m: more is an obstacle, a slip or a new path."""


@dataclass(frozen=True)
class PoseLoopParameters(Parameters):
    """Gains of the pose loop."""

    enabled: bool = parameter(
        False,
        'whether the pose of the reference is followed, and not only its twist: for paths. The '
        'pose of odom and that of reference must be in one frame',
    )
    gain_along: float = parameter(
        2.5, 'k_x: speed per error along the robot', '1/s', (0.0, 50.0), dynamic=True
    )
    gain_across: float = parameter(
        60.0,
        'k_y: yaw rate per speed and error across; at a speed v the error oscillates with '
        'v sqrt(k_y)',
        '1/m²',
        (0.0, 2000.0),
        dynamic=True,
    )
    gain_yaw: float = parameter(
        4.0, 'k_theta: yaw rate per error of yaw', '1/s', (0.0, 50.0), dynamic=True
    )
    gain_integral: float = parameter(
        150.0,
        'k_i: curvature per error across and distance, for wheels that differ; the offset falls '
        'to a third over k_y/k_i m. Less than k_y k_theta / rejoin_speed. 0: an offset stays',
        '1/m³',
        (0.0, 1e4),
        dynamic=True,
    )
    rejoin_distance: float = parameter(
        0.15,
        'distance from the reference at which the robot leaves it, and drives to where it is',
        'm',
        (0.02, 10.0),
        dynamic=True,
    )
    rejoined_distance: float = parameter(
        0.06, 'distance at which it follows again', 'm', (0.005, 10.0), dynamic=True
    )
    rejoin_speed: float = parameter(
        0.33,
        'largest speed on the way to the reference; above that of the reference, or the robot '
        'never reaches it',
        'm/s',
        (0.01, 5.0),
        dynamic=True,
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for an unstable loop, or bounds that contradict."""
        if self.rejoined_distance >= self.rejoin_distance:
            raise ParameterError(
                f'rejoined_distance must be less than rejoin_distance, {self.rejoin_distance:g} '
                f'm: got {self.rejoined_distance:g}'
            )
        highest = self.gain_across * self.gain_yaw / self.rejoin_speed
        if self.gain_integral and self.gain_integral >= highest:
            raise ParameterError(
                'gain_integral must be less than gain_across * gain_yaw / rejoin_speed, '
                f'{highest:g} 1/m³: got {self.gain_integral:g}'
            )


class PoseError(NamedTuple):
    """Reference pose in the frame of the robot."""

    along: float  # m, positive if the reference is ahead
    across: float  # m, positive if it is to the left
    yaw: float  # rad

    @property
    def distance(self) -> float:
        """M."""
        return math.hypot(self.along, self.across)


def pose_error(reference: Pose, pose: Pose) -> PoseError:
    """Return the reference pose in the frame of the robot."""
    x, y = reference.x - pose.x, reference.y - pose.y
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    return PoseError(
        cosine * x + sine * y, cosine * y - sine * x, wrap_angle(reference.yaw - pose.yaw)
    )


def follow_pose(error: PoseError, twist: BodyTwist, parameters: PoseLoopParameters) -> BodyTwist:
    """Return the twist E22 for an error and the twist of the reference."""
    sinc = math.sin(error.yaw) / error.yaw if abs(error.yaw) > 1e-6 else 1.0
    return BodyTwist(
        twist.linear * math.cos(error.yaw) + parameters.gain_along * error.along,
        twist.angular
        + parameters.gain_across * twist.linear * sinc * error.across
        + parameters.gain_yaw * error.yaw,
    )


class PoseReference:
    """Poses of the reference at their stamps, interpolated; the newest ones are kept."""

    def __init__(self, capacity: int = REFERENCE_SAMPLES) -> None:
        self._capacity = capacity
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def clear(self) -> None:
        """Remove every pose."""
        self._stamps.clear()
        self._poses.clear()

    def add(self, reference: State) -> None:
        """Add the pose of a sample; poses from its stamp on are removed first."""
        stamps, poses = self._stamps, self._poses
        while stamps and stamps[-1] >= reference.stamp_ns:
            del stamps[-1], poses[-1]
        stamps.append(reference.stamp_ns)
        poses.append(reference.pose)
        if len(stamps) > self._capacity:
            del stamps[0], poses[0]

    def at(self, stamp_ns: int) -> Pose | None:
        """Return the pose at a stamp, before the first and after the last one that; or None."""
        stamps, poses = self._stamps, self._poses
        if not stamps:
            return None
        after = bisect_right(stamps, stamp_ns)
        if after in (0, len(stamps)):
            return poses[min(after, len(stamps) - 1)]
        begin, end = stamps[after - 1 : after + 1]
        share = (stamp_ns - begin) / (end - begin)
        (x0, y0, yaw0), (x1, y1, yaw1) = poses[after - 1 : after + 1]
        return Pose(
            x0 + share * (x1 - x0),
            y0 + share * (y1 - y0),
            wrap_angle(yaw0 + share * wrap_angle(yaw1 - yaw0)),
        )


class PoseController:
    """Follows the pose of the reference, and returns to it after a detour.

    parameters : replaceable at run time
    """

    def __init__(self, parameters: PoseLoopParameters) -> None:
        self.parameters = parameters
        self.reset()

    def reset(self) -> None:
        """Follow again from the next step on."""
        self.rejoining = False  # whether the robot is on its way to the reference
        self.error = PoseError(*ORIGIN)  # error of the last step
        self.curvature = 0.0  # integral of the error across, 1/m

    def step(
        self,
        reference: Pose,
        pose: Pose,
        twist: BodyTwist,
        elapsed: float = 0.0,
        *,
        learn: bool = True,
    ) -> BodyTwist:
        """Return the twist to track.

        reference, twist, pose : reference and predicted pose at the instant of effect
        learn : whether the robot did what it was to do, so that its error counts
        """
        parameters = self.parameters
        self.error = error = pose_error(reference, pose)
        if error.distance > parameters.rejoin_distance:
            self.rejoining = True
        elif error.distance < parameters.rejoined_distance:
            self.rejoining = False
        if not self.rejoining:
            if learn and abs(error.across) < LEARNT_ERROR:
                change = parameters.gain_integral * abs(twist.linear) * error.across * elapsed
                limit = CURVATURE_LIMIT
                self.curvature = min(max(self.curvature + change, -limit), limit)
            linear, angular = follow_pose(error, twist, parameters)
            return BodyTwist(linear, angular + self.curvature * twist.linear)
        return self.drive_along(self.closing_velocity(twist))

    def closing_velocity(self, twist: BodyTwist) -> tuple[float, float]:
        """Return the velocity (m/s) in the frame of the robot that closes the gap."""
        error, parameters = self.error, self.parameters
        ahead = twist.linear * math.cos(error.yaw) + parameters.gain_along * error.along
        left = twist.linear * math.sin(error.yaw) + parameters.gain_along * error.across
        scale = min(1.0, parameters.rejoin_speed / max(math.hypot(ahead, left), 1e-9))
        return scale * ahead, scale * left

    def drive_along(self, velocity: tuple[float, float]) -> BodyTwist:
        """Return the twist that turns towards a velocity in the frame of the robot."""
        ahead, left = velocity
        return BodyTwist(max(ahead, 0.0), self.parameters.gain_yaw * math.atan2(left, ahead))
