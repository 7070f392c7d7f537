# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How far it is from a point to the walls: along a ray, all around; and how a patch grips.

All kernels read the arrays of a :class:`~t3mpc_ros.robot.arena.world.World`: ``segments``
(n, 4: ax, ay, bx, by), ``circles`` (m, 3: x, y, radius), ``patches`` (k, 4: x, y, radius, grip),
all in m in the world frame but the grip; any of them may have no rows.
"""

import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.kernels import kernel

Array = npt.NDArray[np.float64]


@kernel
def cast_ray(x: float, y: float, direction: float, segments: Array, circles: Array) -> float:
    """Return the distance (m) from (x, y) to the first wall in a direction; inf if there is none.

    From inside a circle that is its wall, seen from within. Touching an end point is a hit; a
    wall has no thickness, so whether one seen exactly edge-on is hit is left to rounding.

    x, y : m; direction : rad from the x axis of the world
    """
    cosine, sine = math.cos(direction), math.sin(direction)
    nearest = math.inf
    for row in range(segments.shape[0]):
        start_x, start_y = segments[row, 0] - x, segments[row, 1] - y
        end_x, end_y = segments[row, 2] - x, segments[row, 3] - y
        # On which side of the ray an end lies depends on that end alone. Two walls that share it
        # get the same sign, however it is rounded, so no ray slips through between them.
        start_off = cosine * start_y - sine * start_x
        end_off = cosine * end_y - sine * end_x
        if (start_off > 0.0 and end_off > 0.0) or (start_off < 0.0 and end_off < 0.0):
            continue
        start_on = cosine * start_x + sine * start_y
        end_on = cosine * end_x + sine * end_y
        if start_off != end_off:
            distance = (start_on * end_off - end_on * start_off) / (end_off - start_off)
        elif start_on * end_on <= 0.0:
            distance = 0.0  # both are on the ray's line, and it starts between them
        else:
            distance = min(start_on, end_on)
        if 0.0 <= distance < nearest:
            nearest = distance
    for row in range(circles.shape[0]):
        to_x, to_y = circles[row, 0] - x, circles[row, 1] - y
        off = cosine * to_y - sine * to_x
        square = (circles[row, 2] - off) * (circles[row, 2] + off)
        if square < 0.0:
            continue
        middle, half = cosine * to_x + sine * to_y, math.sqrt(square)
        distance = middle - half
        if distance < 0.0:
            distance = middle + half
        if 0.0 <= distance < nearest:
            nearest = distance
    return nearest


@kernel
def cast_rays(
    x: float,
    y: float,
    heading: float,
    mounts: Array,
    which: npt.NDArray[np.int64],
    segments: Array,
    circles: Array,
    out: Array,
) -> None:
    """Write what some of the sensors on the body see into ``out``, as :func:`cast_ray` does.

    x, y, heading : pose of the body, m, m, rad
    mounts : shape (s, 3), of each sensor x (m, forward), y (m, to the left), direction (rad),
        in the frame of the body
    which : int64, the rows of ``mounts`` to look from
    out : shape (s,), m; ``out[row]`` is written for each row in ``which``, the others are kept
    """
    cosine, sine = math.cos(heading), math.sin(heading)
    for index in range(which.size):
        row = which[index]
        forward, left = mounts[row, 0], mounts[row, 1]
        out[row] = cast_ray(
            x + cosine * forward - sine * left,
            y + sine * forward + cosine * left,
            heading + mounts[row, 2],
            segments,
            circles,
        )


@kernel
def nearest_on_segment(
    x: float, y: float, ax: float, ay: float, bx: float, by: float
) -> tuple[float, float]:
    """Return the point of the segment from a to b that is nearest to (x, y), all in m.

    Where that is an end, it is that end to the last bit.
    """
    run_x, run_y = bx - ax, by - ay
    along = (x - ax) * run_x + (y - ay) * run_y
    length_squared = run_x * run_x + run_y * run_y
    if along <= 0.0:
        return ax, ay
    if along >= length_squared:
        return bx, by
    share = along / length_squared
    return ax + share * run_x, ay + share * run_y


@kernel
def clearance(x: float, y: float, segments: Array, circles: Array) -> float:
    """Return the distance (m) from (x, y) to the nearest wall, on either side; inf without walls.

    Inside a box or circle that is the distance to its wall:
    :meth:`~t3mpc_ros.robot.arena.world.World.is_free` tells inside from outside.
    """
    least = math.inf
    for row in range(segments.shape[0]):
        near_x, near_y = nearest_on_segment(
            x, y, segments[row, 0], segments[row, 1], segments[row, 2], segments[row, 3]
        )
        least = min(least, (x - near_x) * (x - near_x) + (y - near_y) * (y - near_y))
    least = math.sqrt(least)
    for row in range(circles.shape[0]):
        centre = math.hypot(x - circles[row, 0], y - circles[row, 1])
        least = min(least, abs(centre - circles[row, 2]))
    return least


@kernel
def grip_at(x: float, y: float, patches: Array) -> float:
    """Return which part of their grip tyres keep at (x, y): 1 outside all patches.

    Where patches overlap the most slippery one counts: the same oil twice is no worse.
    """
    grip = 1.0
    for row in range(patches.shape[0]):
        to_x, to_y = x - patches[row, 0], y - patches[row, 1]
        if to_x * to_x + to_y * to_y <= patches[row, 2] * patches[row, 2]:
            grip = min(grip, patches[row, 3])
    return grip
