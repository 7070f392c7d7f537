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
r"""Pure pursuit and regulated pure pursuit: baselines of the pose loop.

Pure pursuit drives the arc through a point of the path at the distance :math:`L`, the lookahead,
which is at :math:`y` to the left of the robot; the arc has the curvature :math:`2 y/L^2`
(Coulter, CMU-RI-TR-92-01, 1992). The regulated form (Macenski et al., Autonomous Robots 47, 2023,
doi 10.1007/s10514-023-10097-6) has a lookahead proportional to the speed, and slows down where
the arc is tighter than a radius :math:`r`, :math:`v' = v/(r |\kappa|)`. Before the goal both slow
down: plain pure pursuit as late as a deceleration allows, the regulated one in proportion to the
distance, as its implementation in Nav2 does. Its regulation near obstacles has no effect here,
where there are none. As there, it can turn on the spot towards a target far beside.
"""

from dataclasses import dataclass
import math
from typing import Protocol

import numpy as np

from t3mpc_ros.control.velocity_actuation import LimitParameters, limit_command, wheel_limits
from t3mpc_ros.evaluation.run_record import RATE
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.polyline import check_points, polyline_length, resample
from t3mpc_ros.geometry.types import STANDSTILL, Array, BodyTwist, Pose, WheelSpeeds, wrap_angle

SPACING = 0.002
"""Distance of the points at which the path is searched, m."""
REACHED = 0.004
"""Rest of the path at which the robot has reached the goal, m."""


@dataclass(frozen=True)
class PurePursuitParameters:
    """Parameters of pure pursuit."""

    lookahead: float = 0.1
    """L, m"""
    speed: float = 0.25
    """m/s"""
    deceleration: float = 0.5
    """Before the goal, m/s²"""
    slowest: float = 0.02
    """Least speed before the goal, m/s"""

    def target(self, speed: float) -> float:
        """Return the lookahead (m) at a speed (m/s)."""
        return self.lookahead

    def regulated(self, curvature: float, remaining: float) -> float:
        """Return the speed (m/s) on an arc of a curvature (1/m) with so much path (m) left."""
        braking = math.sqrt(2.0 * self.deceleration * max(remaining, 0.0))
        return min(self.speed, max(braking, self.slowest))


@dataclass(frozen=True)
class RegulatedParameters:
    """Parameters of regulated pure pursuit."""

    lookahead_time: float = 0.4
    """Lookahead per speed, s"""
    shortest: float = 0.03
    """Least lookahead, m"""
    longest: float = 0.5
    """Largest lookahead, m"""
    min_radius: float = 0.2
    """Radius of the arc below which the robot slows down, m"""
    speed: float = 0.25
    """m/s"""
    slowest: float = 0.05
    """Least speed of the regulation, m/s"""
    approach: float = 0.1
    """Rest of the path below which the robot slows down, m"""
    rotate_from: float = math.inf
    """Bearing of the target from which on the robot turns on the spot, rad; Nav2: 0.785"""
    rotation_speed: float = 1.8
    """Yaw rate on the spot, rad/s"""

    def target(self, speed: float) -> float:
        """Return the lookahead (m) at a speed (m/s)."""
        return min(max(self.lookahead_time * speed, self.shortest), self.longest)

    def regulated(self, curvature: float, remaining: float) -> float:
        """Return the speed (m/s) on an arc of a curvature (1/m) with so much path (m) left."""
        tightness = self.min_radius * abs(curvature)
        speed = self.speed / max(tightness, 1.0)
        return max(speed * min(remaining / self.approach, 1.0), self.slowest)


class PathTracker(Protocol):
    """A law from the pose of the robot to its command, in place of the controller."""

    def step(self, pose: Pose) -> BodyTwist:
        """Return the commanded twist for a pose; called once per period."""


def pursuit_curvature(pose: Pose, target: tuple[float, float]) -> float:
    """Return the curvature 2 y/L² (1/m) of the arc from a pose through a point (m)."""
    x, y = target[0] - pose.x, target[1] - pose.y
    left = math.cos(pose.yaw) * y - math.sin(pose.yaw) * x
    return 2.0 * left / max(x * x + y * y, 1e-12)


class TwistLimiter:
    """Commands within the limits of the controller."""

    def __init__(self) -> None:
        self._geometry = WheelGeometry()
        self._limits = wheel_limits(LimitParameters(), self._geometry)
        self._command: Array = np.zeros(2)

    def limited(self, wanted: BodyTwist) -> BodyTwist:
        """Return the command of a period for a wanted twist."""
        wheels = wheels_from_twist(wanted, self._geometry)
        limit_command(
            wheels.right, wheels.left, self._command, self._limits, 1.0 / RATE, self._command
        )
        return twist_from_wheels(WheelSpeeds(*self._command.tolist()), self._geometry)


class Pursuit:
    """Pure pursuit of a path (m, shape (n, 2)), plain or regulated by the kind of its parameters.

    Every command has the limits of the controller.
    """

    def __init__(
        self, points: Array, parameters: PurePursuitParameters | RegulatedParameters
    ) -> None:
        check_points(points)
        self._parameters = parameters
        self._limiter = TwistLimiter()
        path = resample(points, SPACING)
        self._spacing = polyline_length(path) / (len(path) - 1)
        self._goal = len(path) - 1
        # The path goes on straight: a target exists also near the goal.
        run = path[-1] - path[-2]
        beyond = np.arange(1, round(1.0 / SPACING))[:, None] * (run / np.hypot(*run)) * SPACING
        self._path = np.vstack([path, path[-1] + beyond])
        self._place = 0
        self._speed = 0.0

    @property
    def remaining(self) -> float:
        """Length of the path that is left, m."""
        return (self._goal - self._place) * self._spacing

    def step(self, pose: Pose) -> BodyTwist:
        """Return the commanded twist for a pose; called once per period."""
        lookahead = self._parameters.target(self._speed)
        self._advance(pose, lookahead)
        wanted = STANDSTILL
        if self.remaining > REACHED:
            wanted = self._towards(pose, self._target(pose, lookahead))
        command = self._limiter.limited(wanted)
        self._speed = abs(command.linear)
        return command

    def _towards(self, pose: Pose, target: tuple[float, float]) -> BodyTwist:
        """Return the twist of the arc to a target, or of a turn on the spot towards it."""
        parameters = self._parameters
        if isinstance(parameters, RegulatedParameters):
            bearing = math.atan2(target[1] - pose.y, target[0] - pose.x)
            turn = wrap_angle(bearing - pose.yaw)
            if abs(turn) > parameters.rotate_from:
                return BodyTwist(0.0, math.copysign(parameters.rotation_speed, turn))
        curvature = pursuit_curvature(pose, target)
        speed = parameters.regulated(curvature, self.remaining)
        return BodyTwist(speed, speed * curvature)

    def _advance(self, pose: Pose, lookahead: float) -> None:
        """Go on to the nearest point ahead, within the lookahead: paths may cross themselves."""
        reach = self._place + 1 + math.ceil(lookahead / self._spacing)
        ahead = self._path[self._place : min(reach, self._goal) + 1]
        self._place += int(np.argmin(np.hypot(*(ahead - pose[:2]).T)))

    def _target(self, pose: Pose, lookahead: float) -> tuple[float, float]:
        """Return the first point from the nearest one on that is a lookahead away, m."""
        distance = np.hypot(*(self._path[self._place :] - pose[:2]).T)
        outside = np.flatnonzero(distance >= lookahead)
        first = int(outside[0]) if outside.size else distance.size - 1
        x, y = self._path[self._place + first].tolist()
        if first == 0:
            return x, y
        # Between two points: where the distance is the lookahead.
        before, after = distance[first - 1], distance[first]
        share = float((lookahead - before) / max(after - before, 1e-12))
        x0, y0 = self._path[self._place + first - 1].tolist()
        share = min(max(share, 0.0), 1.0)
        return x0 + share * (x - x0), y0 + share * (y - y0)
