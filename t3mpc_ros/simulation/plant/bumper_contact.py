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
r"""Contact force between a round bumper and the walls: spring and damper, no friction.

Each wall that the bumper (radius :math:`r`) overlaps pushes from its nearest point, at distance
:math:`d`, with :math:`f = \max(0, k (r - d) + c \dot\delta)`, where :math:`\dot\delta` is the
closing speed. Walls that share an end point would push from it once each, so the force of the
shared end is subtracted for every wall but one (inclusion and exclusion):

.. math:: F = \sum_{\text{walls}} f n - \sum_{\text{shared ends}} (\text{walls there} - 1) f n

The nearest point of every wall moves smoothly with the bumper, so without damping the force is
continuous and the gradient of a potential: along joints, past corners, and in polygons that
approximate a curve, on either side. Selecting one of the touching walls would have neither
property.
"""

from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.simulation.world import nearest_on_segment


class Bumper(NamedTuple):
    """Bumper, for kernels: m, N/m and N s/m."""

    radius: float
    stiffness: float
    damping: float


@dataclass(frozen=True)
class BumperParameters(Parameters):
    """Circular bumper around the pose of the robot."""

    radius: float = parameter(0.11, 'radius of the bumper', 'm', (0.01, 1.0))
    stiffness: ClassVar[float] = 2e4
    """Force per depth, N/m, assumed. Without damping a robot of 1.5 kg at 0.5 m/s reaches a depth
    of 4.3 mm and leaves the wall after 27 ms."""
    damping: ClassVar[float] = 100.0  # force per closing speed, N s/m, assumed

    def constants(self) -> Bumper:
        """Return the argument of :func:`contact_force`."""
        return Bumper(self.radius, self.stiffness, self.damping)


@kernel
def point_force(
    away_x: float, away_y: float, speed_x: float, speed_y: float, bumper: Bumper
) -> tuple[float, float]:
    """Return the force (N) of one contact point on the bumper; it never pulls.

    away_x, away_y : m, from that point to the centre of the bumper; at (0, 0) the direction is
        undefined and the force zero
    """
    distance = math.sqrt(away_x * away_x + away_y * away_y)
    if distance >= bumper.radius or distance == 0.0:
        return 0.0, 0.0
    normal_x, normal_y = away_x / distance, away_y / distance
    closing = -(speed_x * normal_x + speed_y * normal_y)
    size = max(bumper.stiffness * (bumper.radius - distance) + bumper.damping * closing, 0.0)
    return size * normal_x, size * normal_y


@kernel
def is_end_of_earlier(row: int, x: float, y: float, segments: Array) -> bool:
    """Decide whether a segment before ``row`` ends at exactly (x, y)."""
    for other in range(row):
        if (segments[other, 0] == x and segments[other, 1] == y) or (
            segments[other, 2] == x and segments[other, 3] == y
        ):
            return True
    return False


@kernel
def contact_force(
    x: float,
    y: float,
    speed_x: float,
    speed_y: float,
    bumper: Bumper,
    segments: Array,
    circles: Array,
) -> tuple[float, float]:
    """Return the force (N, world frame) of all walls on a round bumper; its torque is zero.

    Walls push to the side of the bumper's centre; circles are solid and push outwards at any
    depth. Corners require walls with bit-equal end points, as in a
    :class:`~t3mpc_ros.simulation.world.World`.

    x, y : m, the centre of the bumper; speed_x, speed_y : m/s, both in the world frame
    segments : shape (n, 4), m; circles : shape (m, 3), m
    """
    reach = bumper.radius * bumper.radius
    force_x, force_y = 0.0, 0.0
    for row in range(segments.shape[0]):
        ax, ay, bx, by = segments[row, 0], segments[row, 1], segments[row, 2], segments[row, 3]
        near_x, near_y = nearest_on_segment(x, y, ax, ay, bx, by)
        away_x, away_y = x - near_x, y - near_y
        if away_x * away_x + away_y * away_y >= reach:
            continue
        part_x, part_y = point_force(away_x, away_y, speed_x, speed_y, bumper)
        force_x += part_x
        force_y += part_y
        for end_x, end_y in ((ax, ay), (bx, by)):
            away_x, away_y = x - end_x, y - end_y
            # The search runs only when the bumper covers an end of a wall.
            if away_x * away_x + away_y * away_y < reach and is_end_of_earlier(
                row, end_x, end_y, segments
            ):
                part_x, part_y = point_force(away_x, away_y, speed_x, speed_y, bumper)
                force_x -= part_x
                force_y -= part_y
    for row in range(circles.shape[0]):
        away_x, away_y = x - circles[row, 0], y - circles[row, 1]
        touch = bumper.radius + circles[row, 2]
        square = away_x * away_x + away_y * away_y
        if square < touch * touch and square > 0.0:
            distance = math.sqrt(square)
            normal_x, normal_y = away_x / distance, away_y / distance
            closing = -(speed_x * normal_x + speed_y * normal_y)
            size = max(bumper.stiffness * (touch - distance) + bumper.damping * closing, 0.0)
            force_x += size * normal_x
            force_y += size * normal_y
    return force_x, force_y
