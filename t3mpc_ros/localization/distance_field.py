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
r"""Map of a localisation: distance to the nearest obstacle on a grid, and rays in it.

World files and occupancy grids become the same field, so that the cost of a ray does not depend on
the number of walls. A ray advances by the distance that is free in every direction (sphere
tracing; Hart, The Visual Computer 12, 1996, doi 10.1007/s003710050084). Near a wall the distance
falls linearly along the ray, and two samples before the last cell give the hit between the nodes.
"""

import math
import os
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.obstacles import OCCUPIED_PERCENT
from t3mpc_ros.geometry.occupancy_map_file import MAX_CELLS, MapError, load_map
from t3mpc_ros.geometry.route_planning import nearest_distances
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.simulation.world import World, clearance

MARGIN = 0.3
"""Width of the field beyond the obstacles of a world, m."""
FINEST_STEP = 0.01
"""Distance of the nodes of the field of a world, m; more in a large one."""
MAX_WORK = 2e8
"""Largest number of nodes times obstacles of a world."""
Mask = NDArray[np.bool_]


class DistanceField(NamedTuple):
    """Distances on a grid, for kernels."""

    distance: Array
    """Distance from each node to the nearest obstacle, m, shape (rows, columns), row by y; 0 in
    obstacles."""
    x: float
    """Of the first node, m."""
    y: float
    """Of the first node, m."""
    step: float
    """Distance of neighbouring nodes, m."""

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point (m) is on the grid."""
        rows, columns = self.distance.shape
        width, height = self.step * (columns - 1), self.step * (rows - 1)
        return bool(self.x <= x < self.x + width and self.y <= y < self.y + height)


class LocalizationMap:
    """What the localisation knows of the surroundings.

    field : distances to the obstacles
    known : which nodes are floor or obstacle, and not unknown, shape (rows, columns)
    """

    def __init__(self, field: DistanceField, known: Mask) -> None:
        self.field = field
        """Distances to the obstacles."""
        self._known = known

    def free_places(self, radius: float) -> Array:
        """Return the nodes at which a disc may stand, x and y (m), shape (n, 2).

        Places that are connected to the edge of the map, outside the walls, are left out, unless
        there are no others.
        """
        field = self.field
        free = self._known & (field.distance >= radius)
        outside = np.zeros_like(free)
        for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
            outside[edge] = free[edge]
        while spread(outside, free):
            pass
        inside = free & ~outside
        rows, columns = np.nonzero(inside if inside.any() else free)
        return np.column_stack([field.x + field.step * columns, field.y + field.step * rows])


def map_of_world(world: World) -> LocalizationMap:
    """Return the map of a world; MapError: it has no obstacle."""
    count = len(world.segments) + len(world.circles)
    if count == 0:
        raise MapError(f'the world {world.name} must have walls, boxes or circles')
    (left, bottom), (right, top) = world.bounds()
    width, height = right - left + 2.0 * MARGIN, top - bottom + 2.0 * MARGIN
    step = max(FINEST_STEP, math.sqrt(width * height * count / MAX_WORK))
    shape = math.ceil(height / step) + 1, math.ceil(width / step) + 1
    field = DistanceField(np.empty(shape), left - MARGIN, bottom - MARGIN, step)
    fill_clearance(field, world.segments, world.circles)
    x = field.x + step * np.arange(shape[1])[None, :]
    y = field.y + step * np.arange(shape[0])[:, None]
    for at_x, at_y, radius in world.circles.tolist():
        field.distance[np.hypot(x - at_x, y - at_y) < radius] = 0.0
    for at_x, at_y, length, breadth, yaw in world.boxes.tolist():
        cosine, sine = math.cos(yaw), math.sin(yaw)
        along = cosine * (x - at_x) + sine * (y - at_y)
        across = cosine * (y - at_y) - sine * (x - at_x)
        inside = (2.0 * abs(along) < length) & (2.0 * abs(across) < breadth)
        field.distance[inside] = 0.0
    return LocalizationMap(field, np.ones(shape, dtype=np.bool_))


def map_of_grid(
    occupancy: NDArray[np.int8], resolution: float, origin: tuple[float, float, float]
) -> LocalizationMap:
    """Return the map of the cells of an :class:`.OccupancyGrid`.

    ``origin`` is x, y (m) and yaw (rad) of the corner of the first cell; MapError: a value is out
    of its range, the yaw is not 0, or no cell is occupied.
    """
    if occupancy.ndim != 2 or not 4 <= occupancy.size <= MAX_CELLS:
        raise MapError(f'the grid must have 4 to {MAX_CELLS} cells: got {occupancy.shape}')
    if not 1e-3 <= resolution <= 10.0:
        raise MapError(f'resolution must be from 0.001 to 10 m: got {resolution:g}')
    if not all(map(math.isfinite, origin)) or abs(origin[2]) > 1e-6:
        raise MapError(f'origin must be finite, with a yaw of 0: got {origin}')
    occupied = occupancy >= OCCUPIED_PERCENT
    if not occupied.any():
        raise MapError(f'the grid must have a cell of at least {OCCUPIED_PERCENT} percent')
    # The surface of an occupied cell is half a cell from its centre.
    distance = np.maximum(resolution * (nearest_distances(occupied) - 0.5), 0.0)
    x, y = origin[0] + 0.5 * resolution, origin[1] + 0.5 * resolution
    return LocalizationMap(DistanceField(distance, x, y, resolution), occupancy >= 0)


def load_grid(path: str | os.PathLike[str]) -> LocalizationMap:
    """Return the map of a YAML file of map_server, see :func:`.load_map`."""
    grid = load_map(path)
    try:
        return map_of_grid(grid.cells, grid.resolution, (grid.x, grid.y, 0.0))
    except MapError as error:
        raise MapError(f'{path}: {error}') from None


@kernel
def fill_clearance(field: DistanceField, segments: Array, circles: Array) -> None:
    """Write the distance of each node to walls and pillars."""
    for row in range(field.distance.shape[0]):
        for column in range(field.distance.shape[1]):
            field.distance[row, column] = clearance(
                field.x + field.step * column, field.y + field.step * row, segments, circles
            )


@kernel
def spread(reached: Mask, free: Mask) -> bool:
    """Add free neighbours of reached nodes in two sweeps; return whether there were any."""
    rows, columns = free.shape
    changed = False
    for row in range(rows):
        for column in range(columns):
            if free[row, column] and not reached[row, column]:
                above = row > 0 and reached[row - 1, column]
                if above or (column > 0 and reached[row, column - 1]):
                    reached[row, column] = changed = True
    for row in range(rows - 1, -1, -1):
        for column in range(columns - 1, -1, -1):
            if free[row, column] and not reached[row, column]:
                below = row < rows - 1 and reached[row + 1, column]
                if below or (column < columns - 1 and reached[row, column + 1]):
                    reached[row, column] = changed = True
    return changed


@kernel
def distance_at(field: DistanceField, x: float, y: float) -> float:
    """Return the distance (m) of (x, y) to the nearest obstacle; -1 outside the field."""
    column, row = (x - field.x) / field.step, (y - field.y) / field.step
    rows, columns = field.distance.shape
    if not (0.0 <= column < columns - 1 and 0.0 <= row < rows - 1):
        return -1.0
    left, below = int(column), int(row)
    across, up = column - left, row - below
    low = field.distance[below, left] * (1.0 - across) + field.distance[below, left + 1] * across
    high = (
        field.distance[below + 1, left] * (1.0 - across)
        + field.distance[below + 1, left + 1] * across
    )
    return float(low * (1.0 - up) + high * up)


@kernel
def trace_ray(field: DistanceField, x: float, y: float, direction: float, reach: float) -> float:
    """Return the distance (m) from (x, y) to the first obstacle in a direction (rad).

    inf if there is none within ``reach`` m, or where the field ends; 0 in an obstacle.
    """
    cosine, sine = math.cos(direction), math.sin(direction)
    step = field.step
    along = 0.0
    while along < reach:
        distance = distance_at(field, x + along * cosine, y + along * sine)
        if distance < 0.0:
            return math.inf
        if distance < step:
            # In the cell of the wall the interpolation is too large: two samples before it.
            near, far = along - step, along - 2.0 * step
            one = distance_at(field, x + near * cosine, y + near * sine)
            other = distance_at(field, x + far * cosine, y + far * sine)
            fall = other - one
            if one > 0.0 and fall > 0.1 * step:
                return max(0.0, near + one * step / fall)
            if distance < 0.5 * step:
                return along
        along += max(distance, 0.5 * step)
    return math.inf
