# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Map of the floor: what the range sensors have seen free, what they have hit, and known walls.

The eight sensors look along eight lines. Two parallel rays 0.1 m apart look ahead, so a robot of
0.22 m that drives straight on does not see what its sides will hit, and no reading of the moment
can prevent that. Cells therefore count as unsafe until a ray has passed over them: the robot
drives on floor that it has seen.
"""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Pose
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]
Cells = NDArray[np.int8]

UNKNOWN, FREE, OCCUPIED, KNOWN = 0, 1, 2, 3
"""States of a cell; KNOWN is an obstacle of the world file."""
NEAREST_TRUSTED = 0.08
"""Distance from the face of a sensor below which a ray neither clears nor marks: a Sharp sensor
reads 13 cm for an object at 3 cm."""
CLEARINGS = 4
"""Rays that must pass over an occupied cell to clear it."""


@dataclass(frozen=True)
class FreeSpaceMapParameters(Parameters):
    """Size of the map, and how much a reading is trusted."""

    resolution: float = parameter(0.02, 'side of a cell', 'm', (0.005, 0.2))
    half_size: float = parameter(
        3.0,
        'half the side of the square map around the origin of the odometry; floor beyond it is '
        'not entered',
        'm',
        (0.5, 20.0),
    )
    beam_half_width: float = parameter(
        0.025,
        'half the width over which a ray shows the floor to be free; half of the smallest '
        'obstacle',
        'm',
        (0.005, 0.2),
    )
    error_floor: float = parameter(0.02, 'largest error of a short reading', 'm', (0.0, 0.2))
    error_growth: float = parameter(
        0.12,
        'growth of the error with the square of the distance; noise and offset of 10 mV each '
        'make 0.08',
        '1/m',
        (0.0, 2.0),
    )
    range: float = parameter(0.80, 'distance up to which a sensor sees', 'm', (0.1, 10.0))


class MapGrid(NamedTuple):
    """Cells, for kernels."""

    cells: Cells
    """State of each cell, shape (n, n), row by y."""
    cleared: Cells
    """Rays that passed over an occupied cell, shape (n, n)."""
    numbers: Array
    """Coordinate of the first edge, resolution, shape (2,)."""


class FreeSpaceMap:
    """Cells around the origin of the odometry.

    Parameters
    ----------
    parameters
        Size and trust.
    mounts
        x, y (m) and direction (rad) of each sensor's face in the frame of the robot, shape (s, 3).
    segments, circles
        Known obstacles: walls (ax, ay, bx, by), shape (n, 4), and pillars (x, y, radius), shape
        (m, 3), in the frame of the odometry, m.
    """

    def __init__(
        self,
        parameters: FreeSpaceMapParameters,
        mounts: Array,
        segments: Array,
        circles: Array,
    ) -> None:
        self.parameters = parameters
        self._mounts = np.ascontiguousarray(mounts, dtype=np.float64)
        self._segments, self._circles = segments, circles
        count = 2 * math.ceil(parameters.half_size / parameters.resolution)
        low = -0.5 * count * parameters.resolution
        self.grid = MapGrid(
            np.zeros((count, count), dtype=np.int8),
            np.zeros((count, count), dtype=np.int8),
            np.array([low, parameters.resolution]),
        )
        """The cells."""
        self._add_ray = TypedKernel(add_ray)
        self.clear()

    def clear(self) -> None:
        """Forget everything but the known obstacles."""
        self.grid.cells[:] = UNKNOWN
        self.grid.cleared[:] = 0
        low, size = self.grid.numbers
        count = len(self.grid.cells)
        spacing = 0.5 * size

        def mark(points: Array) -> None:
            index = np.floor((points - low) / size).astype(np.int64)
            index = index[((index >= 0) & (index < count)).all(axis=1)]
            self.grid.cells[index[:, 1], index[:, 0]] = KNOWN

        for ax, ay, bx, by in self._segments.tolist():
            steps = max(2, math.ceil(math.hypot(bx - ax, by - ay) / spacing) + 1)
            mark(np.column_stack([np.linspace(ax, bx, steps), np.linspace(ay, by, steps)]))
        for x, y, radius in self._circles.tolist():
            angles = np.linspace(0.0, math.tau, math.ceil(math.tau * radius / spacing) + 2)
            mark(np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)]))

    def mark_free(self, x: float, y: float, radius: float) -> None:
        """Mark the floor below a robot that stands there as free."""
        low, size = self.grid.numbers
        centres = low + size * (np.arange(len(self.grid.cells)) + 0.5)
        near = (centres[None, :] - x) ** 2 + (centres[:, None] - y) ** 2 <= radius**2
        self.grid.cells[near & (self.grid.cells == UNKNOWN)] = FREE

    def add_reading(self, sensor: int, reading: float, pose: Pose) -> None:
        """Add a reading (m, REP 117) of a sensor of the robot at ``pose``; NaN changes nothing."""
        if reading != reading:
            return
        ahead, aside, direction = self._mounts[sensor].tolist()
        cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
        parameters = self.parameters
        limit = parameters.range
        near = reading == -math.inf
        hit = 0.0 if near else min(reading, limit)
        error = parameters.error_floor + parameters.error_growth * hit * hit
        self._add_ray(
            self.grid,
            pose.x + cosine * ahead - sine * aside,
            pose.y + sine * ahead + cosine * aside,
            pose.yaw + direction,
            max(hit - error, 0.0),
            0.09 if near else (hit if reading < limit else -1.0),
            parameters.beam_half_width,
        )


@kernel
def has_obstacle(cells: Cells, row: int, column: int, reach: int) -> bool:
    """Return whether a cell at most ``reach`` rows and columns away is occupied."""
    count = cells.shape[0]
    for near_row in range(max(row - reach, 0), min(row + reach + 1, count)):
        for near_column in range(max(column - reach, 0), min(column + reach + 1, count)):
            if cells[near_row, near_column] >= OCCUPIED:
                return True
    return False


@kernel
def add_ray(
    grid: MapGrid,
    x: float,
    y: float,
    direction: float,
    free: float,
    hit: float,
    half_width: float,
) -> None:
    """Mark the cells along a ray as free up to ``free`` m, and the one at ``hit`` m as occupied.

    hit : below zero if the ray met nothing
    """
    low, size = grid.numbers[0], grid.numbers[1]
    count = grid.cells.shape[0]
    cosine, sine = math.cos(direction), math.sin(direction)
    step = 0.5 * size
    aside = int(math.ceil(half_width / step))
    for along in range(int(free / step) + 1):
        for across in range(-aside, aside + 1):
            offset = max(-half_width, min(half_width, across * step))
            column = int(math.floor((x + along * step * cosine - offset * sine - low) / size))
            row = int(math.floor((y + along * step * sine + offset * cosine - low) / size))
            if column < 0 or row < 0 or column >= count or row >= count:
                continue
            state = grid.cells[row, column]
            if state == UNKNOWN:
                grid.cells[row, column] = FREE
            elif (
                state == OCCUPIED
                and across == 0
                and along % 2 == 0
                and along * step > NEAREST_TRUSTED
            ):
                # The margin of free keeps this ray from clearing what it hits.
                grid.cleared[row, column] += 1
                if grid.cleared[row, column] >= CLEARINGS:
                    grid.cells[row, column] = FREE
                    grid.cleared[row, column] = 0
    if hit < 0.0:
        return
    column = int(math.floor((x + hit * cosine - low) / size))
    row = int(math.floor((y + hit * sine - low) / size))
    if not (0 <= column < count and 0 <= row < count) or grid.cells[row, column] == KNOWN:
        return
    # Nearer than the sensor measures: only if nothing is known to be there already.
    if hit < 0.1 and has_obstacle(grid.cells, row, column, 4):
        return
    grid.cells[row, column] = OCCUPIED
    grid.cleared[row, column] = 0
