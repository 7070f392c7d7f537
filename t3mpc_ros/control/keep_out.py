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
r"""Keep-out: reshapes twists as little as possible so that the robot touches nothing.

For each nearest unsafe cell *o* of the map in a sector around the robot, the distances
:math:`h_c = |o - c| - d` of the centre *c* and of a point *q* at :math:`l` ahead of it must obey
the discrete-time barrier condition :math:`h(t + T) \ge (1 - \lambda T)\,h(t)` (Agrawal and
Sreenath, RSS 2017, doi 10.15607/RSS.2017.XIII.073). To first order in T this is linear in the
twist,

.. math:: n_c^\top (1, 0)^\top v \le \lambda h_c, \qquad
          n_q^\top \begin{pmatrix} 1 & 0 \\ 0 & l \end{pmatrix}
          \begin{pmatrix} v \\ \omega \end{pmatrix} \le \lambda h_q,

with n the direction to *o* in the frame of the robot, so the twist nearest to the wanted one is
the solution of a quadratic program in two unknowns (Ames et al., IEEE Trans. Automatic Control 62,
2017, doi 10.1109/TAC.2016.2638961), solved exactly. The centre alone cannot steer, because omega
does not move it; the point ahead can (Glotfelter et al., IEEE Robotics and Automation Letters 4,
2019, doi 10.1109/LRA.2019.2895125). Standstill satisfies every condition, so a solution always
exists, and a robot that slows down with :math:`\dot v = -\lambda v` stays within its deceleration.

Why a program over cells and not a potential field or a dynamic window: it changes nothing where
nothing is near, it has one meaning (the nearest permitted twist), and its conditions can be
checked on each command.

A robot of 0.22 m that drives straight on does not see what its sides will hit: the eight sensors
look along eight lines, two parallel rays 0.1 m apart look ahead, and no reading of the moment can
prevent that. Cells of the map of the floor therefore count as unsafe until a ray has passed over
them: the robot drives on floor that it has seen.
"""

from collections import deque
from dataclasses import dataclass
import enum
import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.range_fault_detection import RangeMonitor
from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.obstacles import OCCUPIED_PERCENT, Obstacles, OccupancyGrid
from t3mpc_ros.geometry.types import (
    ORIGIN,
    STANDSTILL,
    Array,
    BodyTwist,
    Pose,
    has_moved,
    wrap_angle,
)
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter

Cells = NDArray[np.int8]

UNKNOWN, FREE, OCCUPIED, KNOWN = 0, 1, 2, 3
"""States of a cell; KNOWN is an obstacle of the world file, or one that the robot has touched: no
ray clears it."""
NOBODY, SEVERAL = -2, -1
"""Who marked an occupied cell, in place of one sensor: several, of what stays there."""
NEAREST_TRUSTED = 0.08
"""Distance from the face of a sensor below which a ray neither clears nor marks: a Sharp sensor
reads 13 cm for an object at 3 cm."""
NEAR_HIT = 0.05
"""Distance from that face at which a thing is marked that is nearer than the sensor measures, m:
within the distance that the robot keeps, because at a centimetre it reads as far away."""
STANDING_ROOM = 0.12  # radius of the floor that is free because the robot stands there, m
MEMORY = 60.0  # default time after which floor that was seen to be free counts as unseen, s
MARGIN = 25  # cells of unknown floor around what is published
ENDING = 5.0  # rest of that time with which floor is published as unseen, s
CONFIRMED_WITHIN = 0.06  # distance between two readings of one surface, m: three cells
SURELY_SEEN = 0.7  # share of its range up to which a sensor sees every surface across its beam
SURFACE_HALF_WIDTH, SURFACE_DEPTH = 0.04, 0.1
"""Half the width of what surely is across a beam, and its largest depth, m."""
NEW_WITHIN, NEW_APART, NEW_EXTENT = 0.6, 0.1, 0.2
"""Reading up to which a hit on free floor is a thing that has come (m), its least distance from
what was there (m), and the distance up to which it may extend to its sides and behind (m): one
beam sees one point of it."""
NEW_FOR, JUST_SEEN = 2.0, 0.3
"""Time for which a thing has come, and may move on (s), and time for which floor around it that
was seen to be free is so (s)."""
CLEARINGS = 4  # rays that must pass over an occupied cell to clear it
ALONE = 100
"""That number for a cell that one reading alone has marked on free floor: the next ray over it
clears it."""
SUPPORTED_FOR, SUPPORTED_WITHIN = 0.3, 0.1
"""Time (s) for which the last hit of a sensor supports the next one, and their difference without
the errors of both (m): of one who walks, or of an edge that a beam sweeps over; at the end of its
range a sensor sees a leg in one reading of three."""
DIRECTIONS = 48  # directions among which a detour is chosen
TURNING_SPEED = 0.02  # speed below which the robot may turn in any direction, m/s
SECTORS = 16  # sectors around the robot, each with its nearest unsafe cell
SEARCH_RADIUS = 0.5  # distance from the centre up to which cells are considered, m
CAUTIOUS_SPEED = 0.12
"""Largest speed of a robot that sees less than usual, or where something has come, m/s."""
VISITED_SPEED, VISITED_FOR = 0.2, 30.0
"""Largest speed (m/s) for a time (s) after somebody was about: who steps in between the beams
reckons with the speed of a robot that sets off, and is there before it has been seen."""
VISIT = 0.5
"""Time for which something comes where somebody is about, s: readings of an edge beside its beam
do so for 0.3 s, people for at least 0.6 s."""
TOUCHED_SIZE = 0.15
"""Half the width, and the depth, that a thing is taken to have which the robot has touched and
cannot see, m."""
TOUCHED_NEAR = 1.0  # distance from such a thing within which the robot drives cautiously, m
TRAIL_SPACING, TRAIL_LENGTH = 0.02, 8
"""Distance between two poses of the way that the robot came (m), and their number: it backs off
so far."""
RETREAT_MARGIN = 0.035  # distance that it then may be nearer to obstacles than otherwise, m
RETREAT_SPEED, RETREAT_TURN, RETREAT_TIME = 0.08, 0.5, 6.0
"""Speed (m/s) and longest time (s) of backing off, and the angle to the way back (rad) above which
the robot turns first."""
TURN_WEIGHT = 0.12
"""Change of v (m/s) that is as bad as a change of omega by 1 rad/s: turning is preferred."""


@dataclass(frozen=True)
class FreeSpaceMapParameters(Parameters):
    """Size of the map, and how much a reading is trusted."""

    resolution: ClassVar[float] = 0.02  # side of a cell, m, assumed
    half_size: float = parameter(
        3.0,
        'half the side of the square map around the origin of the odometry; floor beyond it is '
        'not entered',
        'm',
        (0.5, 20.0),
    )
    beam_half_width: ClassVar[float] = 0.025
    """Half the width over which a ray shows the floor to be free, m, assumed: half of the smallest
    obstacle."""
    error_floor: ClassVar[float] = 0.02  # largest error of a short reading, m, assumed
    error_growth: ClassVar[float] = 0.12
    """Growth of the error with the square of the distance, 1/m, assumed; noise and offset of 10 mV
    each make 0.08."""
    range: float = parameter(0.80, 'distance up to which a sensor sees', 'm', (0.1, 10.0))
    memory: float = parameter(
        MEMORY,
        'time after which floor that was seen to be free counts as unseen: the robot looks at it '
        'again before it drives there',
        's',
        (1.0, 1e6),
    )


class MapGrid(NamedTuple):
    """Cells, for kernels."""

    cells: Cells  # state of each cell, shape (n, n), row by y
    cleared: Cells  # rays that passed over an occupied cell, shape (n, n)
    seen: NDArray[np.float32]  # when a cell was last seen to be free, s, shape (n, n)
    author: Cells  # the sensor that marked an occupied cell, or one of these, shape (n, n)
    low: float  # coordinate of the first edge, m
    size: float  # side of a cell, m


class FreeSpaceMap:
    """Cells around the origin of the odometry.

    mounts : x, y (m) and direction (rad) of each sensor's face in the frame of the robot
    segments, circles : walls (ax, ay, bx, by) and pillars (x, y, radius), in the frame of the
        odometry, m
    saved : a map in that frame, of which the obstacles are used: free floor is looked at again
    """

    def __init__(
        self,
        parameters: FreeSpaceMapParameters,
        mounts: Array,
        segments: Array,
        circles: Array,
        saved: OccupancyGrid | None = None,
    ) -> None:
        self.parameters = parameters
        self._saved = np.empty((0, 2)) if saved is None else _occupied_places(saved)
        self._mounts = np.ascontiguousarray(mounts, dtype=np.float64)
        self._segments, self._circles = segments, circles
        count = 2 * math.ceil(parameters.half_size / parameters.resolution)
        low = -0.5 * count * parameters.resolution
        self.grid = MapGrid(
            np.zeros((count, count), dtype=np.int8),
            np.zeros((count, count), dtype=np.int8),
            np.zeros((count, count), dtype=np.float32),
            np.zeros((count, count), dtype=np.int8),
            low,
            parameters.resolution,
        )
        """The cells."""
        self._add_ray = TypedKernel(add_ray)
        self._find_surface = TypedKernel(find_surface)
        self.clear()

    def clear(self) -> None:
        """Forget everything but the known obstacles."""
        self.now = 0.0  # time since then, s
        self.last_come = -math.inf
        """Time of the last reading of a thing that had come, s; see :func:`has_come`."""
        self.last_visit = -math.inf
        """Time of the last one by which something had come for :data:`VISIT`, s."""
        self._first_come = 0.0  # when it began to come, s
        self._hits = [(0.0, -math.inf)] * len(self._mounts)  # last hit of each sensor, m and s
        self.grid.cells[:] = UNKNOWN
        self.grid.cleared[:] = 0
        self.grid.seen[:] = 0.0
        self.grid.author[:] = NOBODY
        low, size = self.grid.low, self.grid.size
        count = len(self.grid.cells)
        spacing = 0.5 * size

        def mark(points: Array, state: int = KNOWN) -> None:
            index = np.floor((points - low) / size).astype(np.int64)
            index = index[((index >= 0) & (index < count)).all(axis=1)]
            self.grid.cells[index[:, 1], index[:, 0]] = state

        mark(self._saved, OCCUPIED)
        for ax, ay, bx, by in self._segments.tolist():
            steps = max(2, math.ceil(math.hypot(bx - ax, by - ay) / spacing) + 1)
            mark(np.column_stack([np.linspace(ax, bx, steps), np.linspace(ay, by, steps)]))
        for x, y, radius in self._circles.tolist():
            angles = np.linspace(0.0, math.tau, math.ceil(math.tau * radius / spacing) + 2)
            mark(np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)]))

    def occupancy(self) -> OccupancyGrid:
        """Return what is known of the floor, with some unknown floor around.

        Floor whose memory ends soon counts as unseen, so that nobody plans to drive on it.
        """
        grid = self.grid
        rows, columns = (
            slice(max(int(seen[0]) - MARGIN, 0), int(seen[-1]) + MARGIN + 1)
            if (seen := np.flatnonzero(grid.cells.any(axis=axis))).size
            else slice(0, 1)
            for axis in (1, 0)
        )
        cells, oldest = grid.cells[rows, columns], self.now - self.parameters.memory + ENDING
        alone = (cells == OCCUPIED) & (grid.cleared[rows, columns] >= ALONE)
        found = np.full(cells.shape, -1, dtype=np.int8)
        found[((cells == FREE) | alone) & (grid.seen[rows, columns] >= oldest)] = 0
        found[(cells >= OCCUPIED) & ~alone] = 100
        low, size = grid.low, grid.size
        return OccupancyGrid(found, size, low + size * columns.start, low + size * rows.start)

    def mark_free(self, x: float, y: float, radius: float) -> None:
        """Mark the floor below a robot that stands there as free."""
        window, near = self._near(x, y, radius)
        cells = self.grid.cells[window]
        cells[near & (cells == UNKNOWN)] = FREE
        self.grid.seen[window][near] = self.now

    def mark_touched(self, pose: Pose, sign: float, distance: float) -> None:
        """Mark what the robot at ``pose`` touches ahead (``sign`` 1) or behind (-1).

        It is beyond a distance (m) from the centre of the robot, which stands on free floor.
        """
        depth, low, size = distance + TOUCHED_SIZE, self.grid.low, self.grid.size
        window, near = self._near(pose.x, pose.y, math.hypot(depth, TOUCHED_SIZE))
        rows, columns = (np.arange(each.start, each.stop) + 0.5 for each in window)
        x, y = low + size * columns[None, :] - pose.x, low + size * rows[:, None] - pose.y
        ahead = sign * (math.cos(pose.yaw) * x + math.sin(pose.yaw) * y)
        left = math.cos(pose.yaw) * y - math.sin(pose.yaw) * x
        thing = (ahead > size) & (ahead < depth) & (abs(left) < TOUCHED_SIZE)
        self.grid.cells[window][near & thing & (x * x + y * y > distance**2)] = KNOWN

    def _near(
        self, x: float, y: float, radius: float
    ) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """Return the rows and columns around a disc, and which of their cells are in it."""
        low, size, count = self.grid.low, self.grid.size, len(self.grid.cells)
        spans, squares = [], []
        for middle in (y, x):
            first = min(max(math.floor((middle - radius - low) / size), 0), count)
            last = min(max(math.floor((middle + radius - low) / size) + 1, first), count)
            spans.append(slice(first, last))
            squares.append((low + size * (np.arange(first, last) + 0.5) - middle) ** 2)
        near: NDArray[np.bool_] = squares[0][:, None] + squares[1][None, :] <= radius**2
        return (spans[0], spans[1]), near

    def _face(self, sensor: int, pose: Pose) -> tuple[float, float, float]:
        """Return place (m) and direction (rad) of the face of a sensor."""
        ahead, aside, direction = self._mounts[sensor].tolist()
        cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
        x, y = pose.x + cosine * ahead - sine * aside, pose.y + sine * ahead + cosine * aside
        return x, y, pose.yaw + direction

    def surface(self, sensor: int, pose: Pose) -> tuple[float, float] | None:
        """Return the surface (m) that a sensor of the robot at ``pose`` must see; None: none."""
        x, y, direction = self._face(sensor, pose)
        reach = SURELY_SEEN * self.parameters.range
        away = self._find_surface(self.grid, x, y, direction, reach)
        if away == math.inf:
            return None
        return x + away * math.cos(direction), y + away * math.sin(direction)

    def has_confirmed(self, sensor: int, reading: float, pose: Pose) -> bool:
        """Return whether another sensor has seen something where a reading (m) says it is."""
        x, y, direction = self._face(sensor, pose)
        x, y = x + reading * math.cos(direction), y + reading * math.sin(direction)
        window, near = self._near(x, y, CONFIRMED_WITHIN)
        others = self.grid.author[window] != sensor
        return bool((near & others & (self.grid.cells[window] >= OCCUPIED)).any())

    def add_reading(self, sensor: int, reading: float, pose: Pose) -> None:
        """Add a reading (m, REP 117) of a sensor of the robot at ``pose``."""
        parameters = self.parameters
        limit = parameters.range
        near = reading == -math.inf
        hit = 0.0 if near else min(reading, limit)
        error = parameters.error_floor + parameters.error_growth * hit * hit
        last, at = self._hits[sensor]
        supported = (
            self.now - at < SUPPORTED_FOR and abs(hit - last) < SUPPORTED_WITHIN + 2.0 * error
        )
        if near or reading < limit:
            self._hits[sensor] = hit, self.now
        come = self._add_ray(
            self.grid,
            self.now,
            *self._face(sensor, pose),
            max(hit - error, 0.0),
            NEAR_HIT if near else (hit if reading < limit else -1.0),
            parameters.beam_half_width,
            sensor,
            supported,
        )
        if come:
            if self.now - self.last_come > NEW_FOR:
                self._first_come = self.now
            self.last_come = self.now
            if self.now - self._first_come > VISIT:
                self.last_visit = self.now


def _occupied_places(grid: OccupancyGrid) -> Array:
    """Return points (m), shape (n, 2), of the occupied cells, close enough for our cells."""
    rows, columns = np.nonzero(grid.cells >= OCCUPIED_PERCENT)
    parts = max(1, math.ceil(grid.resolution / FreeSpaceMapParameters.resolution))
    inside = (np.arange(parts) + 0.5) / parts
    across, up = (each.ravel() for each in np.meshgrid(inside, inside))
    x, y = np.add.outer(columns, across).ravel(), np.add.outer(rows, up).ravel()
    return np.column_stack([grid.x + grid.resolution * x, grid.y + grid.resolution * y])


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
def find_surface(grid: MapGrid, x: float, y: float, direction: float, reach: float) -> float:
    """Return the distance (m) of a surface that was seen across a ray, at most ``reach``; inf.

    Walls of a world file and what the robot has touched are not counted: nobody has seen them. A
    sensor that sees what is not there, and who has walked by, leave what one sensor has marked.
    """
    count, step = grid.cells.shape[0], 0.5 * grid.size
    cosine, sine = math.cos(direction), math.sin(direction)
    nearest, farthest = math.inf, 0.0
    for aside in range(-2, 3):
        offset = 0.5 * aside * SURFACE_HALF_WIDTH
        found = math.inf
        for along in range(int(NEAREST_TRUSTED / step) + 1, int(reach / step) + 1):
            column = int(
                math.floor((x + along * step * cosine - offset * sine - grid.low) / grid.size)
            )
            row = int(
                math.floor((y + along * step * sine + offset * cosine - grid.low) / grid.size)
            )
            if not (0 <= column < count and 0 <= row < count):
                break
            if grid.cells[row, column] == OCCUPIED and grid.author[row, column] == SEVERAL:
                found = along * step
                break
        nearest, farthest = min(nearest, found), max(farthest, found)
    return nearest if farthest - nearest < SURFACE_DEPTH else math.inf


@kernel
def add_ray(
    grid: MapGrid,
    now: float,
    x: float,
    y: float,
    direction: float,
    free: float,
    hit: float,
    half_width: float,
    sensor: int,
    supported: bool,
) -> bool:
    """Mark the cells along a ray as free up to ``free`` m, and the one at ``hit`` m as occupied.

    Return whether what it met has come, see :func:`has_come`; ``hit`` is below zero for nothing.
    What one reading alone says has not: no other is near, nor is it ``supported`` by the last.
    """
    cosine, sine = math.cos(direction), math.sin(direction)
    mark_free_along(grid, now, x, y, cosine, sine, free, half_width)
    if hit < 0.0:
        return False
    count = grid.cells.shape[0]
    column = int(math.floor((x + hit * cosine - grid.low) / grid.size))
    row = int(math.floor((y + hit * sine - grid.low) / grid.size))
    if not (0 <= column < count and 0 <= row < count) or grid.cells[row, column] == KNOWN:
        return False
    # Nearer than the sensor measures: only if nothing is known to be there already.
    if hit < 0.1 and has_obstacle(grid.cells, row, column, 4):
        return False
    return mark_hit(grid, now, row, column, hit, sensor, supported)


@kernel
def mark_free_along(
    grid: MapGrid,
    now: float,
    x: float,
    y: float,
    cosine: float,
    sine: float,
    free: float,
    half_width: float,
) -> None:
    """Mark the cells along a ray as free up to ``free`` m, and clear what it passes over."""
    low, size = grid.low, grid.size
    count = grid.cells.shape[0]
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
            if state != OCCUPIED or across == 0:  # beside its axis a ray may graze an edge
                grid.seen[row, column] = now
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


@kernel
def mark_hit(
    grid: MapGrid,
    now: float,
    row: int,
    column: int,
    hit: float,
    sensor: int,
    supported: bool,
) -> bool:
    """Mark the cell at the end of a ray as occupied; return whether what is there has come."""
    reach = int(NEW_APART / grid.size)
    new = has_come(grid, now - NEW_FOR, row, column, reach)
    come = new and (supported or has_obstacle(grid.cells, row, column, reach))
    if come and hit < NEW_WITHIN:
        forget_around(grid, now - JUST_SEEN, row, column, int(NEW_EXTENT / grid.size))
    if grid.cells[row, column] != OCCUPIED:
        grid.author[row, column] = sensor
        if new and grid.seen[row, column] < now - NEW_FOR:
            grid.seen[row, column] = now  # it has come now: nothing near it is old for that
    elif grid.author[row, column] != sensor and grid.seen[row, column] < now - NEW_FOR:
        grid.author[row, column] = SEVERAL
    grid.cells[row, column] = OCCUPIED
    grid.cleared[row, column] = ALONE if new and not come else 0
    return come


@kernel
def has_come(grid: MapGrid, since: float, row: int, column: int, reach: int) -> bool:
    """Return whether a cell was free and nothing was near it at an instant (s)."""
    count = grid.cells.shape[0]
    if since <= 0.0 or (grid.cells[row, column] != FREE and grid.seen[row, column] < since):
        return False
    for up in range(max(row - reach, 0), min(row + reach + 1, count)):
        for right in range(max(column - reach, 0), min(column + reach + 1, count)):
            state = grid.cells[up, right]
            # An obstacle was last seen to be free before it came.
            if state == KNOWN or (state == OCCUPIED and grid.seen[up, right] < since):
                return False
    return True


@kernel
def forget_around(grid: MapGrid, since: float, row: int, column: int, reach: int) -> None:
    """Count free floor around a cell as unseen, but where a ray has passed since an instant."""
    count = grid.cells.shape[0]
    for up in range(max(row - reach, 0), min(row + reach + 1, count)):
        for right in range(max(column - reach, 0), min(column + reach + 1, count)):
            apart = (up - row) ** 2 + (right - column) ** 2
            if apart > reach * reach or grid.seen[up, right] >= since:
                continue
            if grid.cells[up, right] == FREE:
                grid.cells[up, right] = UNKNOWN
                grid.seen[up, right] = since  # until now: what comes there next has come


@dataclass(frozen=True)
class KeepOutParameters(Parameters):
    """Distances and times of the keep-out."""

    enabled: bool = parameter(
        False, 'whether twists are reshaped so that the robot touches nothing'
    )
    distance: float = parameter(
        0.165,
        'least distance of the centre from unsafe floor: radius of the robot, 0.11 m, half a '
        'beam, and the errors of pose and map',
        'm',
        (0.02, 2.0),
    )
    ahead: ClassVar[float] = 0.05  # l: distance of the point ahead, m, assumed
    rate: float = parameter(
        2.0,
        'lambda: speed of the approach per distance; times the speed at most the deceleration',
        '1/s',
        (0.1, 20.0),
    )
    range_timeout: float = parameter(
        0.2,
        'time without a valid reading after which a range sensor is lost; the robot brakes after '
        '0.4 of it. With one lost it drives slowly, without any in the direction of motion it '
        'stops',
        's',
        (0.05, 5.0),
    )
    scan_rate: float = parameter(
        1.2, 'yaw rate at which the robot looks around', 'rad/s', (0.1, 5.0)
    )
    scan_angle: ClassVar[float] = 1.2
    """Angle to both sides by which the robot looks around before floor that it has not seen, rad,
    assumed."""
    stuck_time: float = parameter(
        6.0, 'time without progress after which the robot is stuck', 's', (0.5, 600.0)
    )
    stuck_distance: ClassVar[float] = 0.05  # motion that is progress, m, assumed
    world: str = parameter(
        '',
        'known walls and pillars: name of a bundled world, or path of a YAML file, in the frame '
        'of the odometry; empty: none',
    )
    yaml_filename: str = parameter(
        '',
        'saved map whose obstacles are known at the start: YAML file of map_server, as ~/save_map '
        'writes it, in the frame of the odometry; rays clear what is no longer there; empty: none',
        source='nav2_map_server',
    )
    mounts: tuple[float, ...] = parameter(
        (
            *(0.10, 0.05, 0.0, 0.10, -0.05, 0.0),
            *(0.05, 0.09, 0.5 * math.pi, -0.05, 0.09, 0.5 * math.pi),
            *(-0.10, 0.05, math.pi, -0.10, -0.05, math.pi),
            *(0.05, -0.09, -0.5 * math.pi, -0.05, -0.09, -0.5 * math.pi),
        ),
        'x (m), y (m) and direction (rad) of the face of each range sensor in the frame of the '
        'robot, in the order of the sensors',
        bounds=(-10.0, 10.0),
    )
    map: FreeSpaceMapParameters = group(FreeSpaceMapParameters)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` unless each sensor has three numbers."""
        if len(self.mounts) % 3:
            raise ParameterError(
                f'mounts must have x, y, direction of each sensor: got {len(self.mounts)} numbers'
            )


class Activity(enum.Enum):
    """What the keep-out does, in words for the diagnostics."""

    FREE = 'the path is free'
    AVOIDING = 'avoiding an obstacle'
    LOOKING = 'looking around before floor that has not been seen'
    STUCK_OBSTACLE = 'stuck: obstacles block the way to the path'
    STUCK_UNSEEN = 'stuck: floor that cannot be seen blocks the way to the path'
    STUCK_DRIVE = 'stuck: commands do not move the robot'
    BACKING_OFF = 'backing off from something that the range sensors do not see'
    WAITING = 'waiting for a reading of the range sensors'

    @property
    def stuck(self) -> bool:
        """Whether the robot makes no progress."""
        return self.value.startswith('stuck')


class KeepOut:
    """Reshapes twists by the map that it builds from the range readings.

    limits : largest |v| (m/s) and |omega| (rad/s)
    obstacles, saved : what is known at the start, in the frame of the odometry
    """

    def __init__(
        self,
        parameters: KeepOutParameters,
        limits: BodyTwist,
        obstacles: Obstacles | None = None,
        saved: OccupancyGrid | None = None,
    ) -> None:
        self.parameters = parameters
        known = Obstacles() if obstacles is None else obstacles
        mounts = np.array(parameters.mounts).reshape(-1, 3)
        self.map = FreeSpaceMap(parameters.map, mounts, *known, saved)
        """What is known of the floor."""
        self.ranges = RangeMonitor(mounts, parameters.range_timeout, parameters.map.range)
        """Which range sensors can be relied on."""
        self.limits = limits  # replaceable at run time
        self._nearest = np.zeros((SECTORS, 4))
        self._rows = np.zeros((2 * SECTORS + 4, 3))
        self._find_nearest = TypedKernel(find_nearest)
        self.reset()

    def reset(self) -> None:
        """Begin as new: the robot looks around first."""
        self.ranges.reset()
        self._begin(looks=True)

    def relocate(self) -> None:
        """Begin at a new place with the same sensors; the robot looks around before it moves."""
        self._begin(looks=False)

    def _begin(self, *, looks: bool) -> None:
        self._looks, self._has_looked = looks, False
        self.map.clear()
        self.activity = Activity.FREE  # what it does
        self.changed = False  # whether the last twist was changed
        self._standing_room = False
        self._fastest = math.inf  # largest speed for now, m/s
        self._targets: deque[float] = deque()
        self._seen_from: Pose | None = None
        self._blocked_for = 0.0
        self._detour: float | None = None
        self._progress: Pose | None = None
        self._waited = 0.0
        self._looked_at = 0.0  # time of the map at which the robot began to look around, s
        self.touched: list[tuple[float, float]] = []
        """Where the robot was when it touched something that it cannot see, m."""
        self._trail: deque[Pose] = deque(maxlen=TRAIL_LENGTH)  # the way that the robot came
        self._thing = ORIGIN  # where that is which it touched last
        self._retreat_time = 0.0  # time left to back off, s

    def add_reading(
        self, sensor: int, reading: float, pose: Pose, stamp_ns: int | None = None
    ) -> bool:
        """Add a reading (m, REP 117) of a sensor; return whether it is possible and new."""
        if not self.ranges.accept(sensor, reading, stamp_ns):
            return False
        if reading == math.inf and (surface := self.map.surface(sensor, pose)) is not None:
            self.ranges.miss(sensor, surface)
        if self.ranges.suspects(sensor) and self.map.has_confirmed(sensor, reading, pose):
            self.ranges.confirm(sensor)
        if self.ranges.sees(sensor, reading):
            self.map.add_reading(sensor, reading, pose)
        return True

    def step(self, wanted: BodyTwist, pose: Pose, elapsed: float) -> BodyTwist:
        """Return the permitted twist nearest to ``wanted``, or one that looks around.

        pose : predicted pose at the instant at which the twist takes effect
        """
        if not self._standing_room:
            # The robot stands where it stands.
            self._standing_room = True
            room = self.parameters.distance + self.parameters.ahead + 0.06
            self.map.mark_free(pose.x, pose.y, room)
        if not self._has_looked and (self._looks or wanted != STANDSTILL):
            self._has_looked = True
            self._look_around(pose, math.pi)
        self.map.now += elapsed
        self.map.mark_free(pose.x, pose.y, STANDING_ROOM)
        if self.ranges.waits(astern=wanted.linear < 0.0):
            # A stop of the fastest robot takes longer than what then is left of half a second.
            self.changed, self.activity = True, Activity.WAITING
            return STANDSTILL
        if self.retreats:
            return self._back_off(pose, elapsed)
        measured = self.ranges.pose  # what stops or shoves the robot, no prediction knows
        last = self._trail[-1] if self._trail else None
        if (
            wanted.linear > 0.0
            and measured is not None
            and has_moved(last, measured, TRAIL_SPACING, math.inf)
        ):
            self._trail.append(measured)
        return self._reshaped(wanted, pose, elapsed)

    @property
    def retreats(self) -> bool:
        """Whether the robot backs off from what it has touched."""
        return self._retreat_time > 0.0

    def touch(self, pose: Pose, *, astern: bool) -> None:
        """Remember that something holds the robot at ``pose``; then back off the way it came."""
        self.map.mark_touched(
            pose, -1.0 if astern else 1.0, self.parameters.distance - RETREAT_MARGIN - 0.005
        )
        self.touched.append((pose.x, pose.y))
        self._thing = advance_pose(pose, BodyTwist(self.parameters.distance, 0.0), 1.0)
        self._targets.clear()
        self._retreat_time = 0.0 if astern else RETREAT_TIME

    def _back_off(self, pose: Pose, elapsed: float) -> BodyTwist:
        """Return the twist back along the trail, as far as the floor behind is free."""
        self._retreat_time -= elapsed
        gap = 0.0
        while self._trail:
            x, y = self._trail[-1].x - pose.x, self._trail[-1].y - pose.y
            gap = wrap_angle(math.atan2(y, x) - pose.yaw - math.pi)
            # A robot that was shoved may have the end of its way between it and the thing.
            away = x * (pose.x - self._thing.x) + y * (pose.y - self._thing.y) > 0.0
            if away and math.hypot(x, y) > TRAIL_SPACING:
                break
            self._trail.pop()
        if not self._trail:
            self._retreat_time = 0.0
        if not self.retreats:
            self._trail.clear()
            self._look_around(pose, self.parameters.scan_angle)
            return STANDSTILL
        self.changed, self.activity = True, Activity.BACKING_OFF
        # It came over this floor, and the sensors at its back see what has come there since.
        self._update_nearest(pose, OCCUPIED)
        self._nearest[self._nearest[:, 0] > -0.5, 3] = math.inf  # beside it, as on its way here
        if abs(gap) > RETREAT_TURN:  # what it touched has turned it
            limit = self.parameters.scan_rate
            return BodyTwist(0.0, min(max(4.0 * gap, -limit), limit))
        distance = self.parameters.distance - RETREAT_MARGIN
        return self._permitted(BodyTwist(-RETREAT_SPEED, 2.0 * gap), distance)

    def _update_nearest(self, pose: Pose, least: int) -> None:
        """Find the nearest unsafe cells around a pose, see :func:`find_nearest`."""
        oldest = self.map.now - self.parameters.map.memory
        self._find_nearest(self.map.grid, *pose, oldest, self._nearest, least)

    def _reshaped(self, wanted: BodyTwist, pose: Pose, elapsed: float) -> BodyTwist:
        """Return the permitted twist, or one that looks around."""
        self._update_nearest(pose, UNKNOWN)
        visited = self.map.now - self.map.last_visit < VISITED_FOR
        comes = self.map.now - self.map.last_come < NEW_FOR
        touches = any(math.dist(each, pose[:2]) < TOUCHED_NEAR for each in self.touched)
        self._fastest = VISITED_SPEED if visited else math.inf
        if comes or self.ranges.lost or touches:
            self._fastest = CAUTIOUS_SPEED
        if self._targets:
            self.changed = True
            self.activity = Activity.LOOKING
            return self._look(pose)  # a round robot may turn anywhere
        permitted = self._permitted(wanted, self.parameters.distance)
        if abs(permitted.linear) < TURNING_SPEED:
            # The point ahead is a means to steer; a round robot that stands may turn anywhere.
            limit = self.limits.angular
            turn = min(max(wanted.angular, -limit), limit)
            permitted = BodyTwist(permitted.linear, turn)
        change = abs(permitted.linear - wanted.linear) + TURN_WEIGHT * abs(
            permitted.angular - wanted.angular
        )
        self.changed = change > 0.01
        self._decide_activity(wanted, permitted, pose, elapsed)
        return permitted

    def guide(self, velocity: tuple[float, float], pose: Pose) -> tuple[float, float]:
        """Return a velocity (m/s, frame of the robot) turned to the nearest free direction.

        A direction is free if a robot that drives straight on passes every unsafe cell nearby.
        The direction last taken is preferred, so that the robot does not turn to and fro between
        the two ways round an obstacle. Where none is free the velocity is unchanged.
        """
        ahead, left = velocity
        speed, wanted = math.hypot(ahead, left), math.atan2(left, ahead)
        angles = np.append(wanted, np.arange(DIRECTIONS) * (math.tau / DIRECTIONS))
        is_free = np.empty(angles.size, dtype=np.bool_)
        find_free(self._nearest, np.cos(angles), np.sin(angles), self.parameters.distance, is_free)
        free = angles[is_free]
        if speed < 1e-6 or not free.size or free[0] == wanted:
            self._detour = None
            return velocity
        cost = np.abs(np.remainder(free - wanted + math.pi, math.tau) - math.pi)
        if self._detour is not None:
            last = self._detour - pose.yaw
            cost += 1.5 * np.abs(np.remainder(free - last + math.pi, math.tau) - math.pi)
        chosen = float(free[int(np.argmin(cost))])
        self._detour = pose.yaw + chosen
        return speed * math.cos(chosen), speed * math.sin(chosen)

    def _permitted(self, wanted: BodyTwist, distance: float) -> BodyTwist:
        """Return the twist nearest to ``wanted`` that keeps a distance (m) from what is near."""
        parameters = self.parameters
        count = write_conditions(
            self._nearest, distance, parameters.ahead, parameters.rate, self._rows
        )
        limits = self.limits
        fastest = min(limits.linear, self._fastest)
        # Where no sensor looks behind it, the robot does not back away from what is ahead.
        astern = 0.0 if self.ranges.is_blind(astern=True) else fastest
        for sign, most in ((1.0, fastest), (-1.0, astern)):
            self._rows[count] = sign, 0.0, most
            self._rows[count + 1] = 0.0, sign / TURN_WEIGHT, limits.angular
            count += 2
        v, turn = nearest_permitted(
            self._rows[:count], wanted.linear, TURN_WEIGHT * wanted.angular
        )
        return BodyTwist(v, turn / TURN_WEIGHT)

    def _look_around(self, pose: Pose, angle: float) -> None:
        """Begin to look around, by an angle to both sides."""
        half = [pose.yaw + angle * share for share in (0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0)]
        if angle >= math.pi:
            half = [pose.yaw + math.tau * share for share in (0.25, 0.5, 0.75, 1.0)]
        self._targets = deque(map(wrap_angle, half))
        self._seen_from, self._looked_at = pose, self.map.now

    def _look(self, pose: Pose) -> BodyTwist:
        """Return the turn towards the next direction."""
        gap = wrap_angle(self._targets[0] - pose.yaw)
        if abs(gap) < 0.08:
            self._targets.popleft()
        limit = self.parameters.scan_rate
        return BodyTwist(0.0, min(max(4.0 * gap, -limit), limit))

    def _decide_activity(
        self, wanted: BodyTwist, permitted: BodyTwist, pose: Pose, elapsed: float
    ) -> None:
        """Decide what blocks the robot, and whether it must look around or is stuck."""
        speed = abs(wanted.linear)
        blocked = self.changed and speed > 0.05 and abs(permitted.linear) < 0.3 * speed
        self._blocked_for = self._blocked_for + elapsed if blocked else 0.0
        self.activity = Activity.AVOIDING if self.changed else Activity.FREE
        if self._blocked_for > 0.2 and self._blocked_by_unseen() and self._may_look(pose):
            self._blocked_for = 0.0
            self._look_around(pose, self.parameters.scan_angle)
            return
        self._update_stuck(wanted, pose, elapsed)

    def _may_look(self, pose: Pose) -> bool:
        """Whether it is of use to look around: the robot has moved, or what it saw is old."""
        return (
            has_moved(self._seen_from, pose, 0.04, 0.6)
            or self.map.now - self._looked_at > self.parameters.map.memory
        )

    def _blocked_by_unseen(self) -> bool:
        """Whether the nearest cell ahead is one that has not been seen."""
        ahead = self._nearest[:, 0] > 0.3
        if not ahead.any():
            return False
        rows = self._nearest[ahead]
        return bool(rows[int(np.argmin(rows[:, 3])), 2] == UNKNOWN)

    def _update_stuck(self, wanted: BodyTwist, pose: Pose, elapsed: float) -> None:
        """Count the time without progress of a robot that wants to move."""
        parameters = self.parameters
        moved = has_moved(self._progress, pose, parameters.stuck_distance, 1.0)
        if moved or abs(wanted.linear) < 0.02:
            self._progress, self._waited = pose, 0.0
            return
        self._waited += elapsed
        if self._waited < parameters.stuck_time:
            return
        if not self.changed:
            self.activity = Activity.STUCK_DRIVE
        elif self._blocked_by_unseen():
            self.activity = Activity.STUCK_UNSEEN
        else:
            self.activity = Activity.STUCK_OBSTACLE
        if self._waited % parameters.stuck_time < elapsed:
            self._detour = None
            self._look_around(pose, self.parameters.scan_angle)


@kernel
def find_nearest(
    grid: MapGrid, x: float, y: float, yaw: float, oldest: float, nearest: Array, least: int
) -> None:
    """Write the nearest unsafe cell of each sector.

    least : UNKNOWN; OCCUPIED if floor that has not been seen is no reason
    oldest : time before which a cell must have been seen to count as unseen, s
    nearest : shape (SECTORS, 4): direction to the cell in the frame of the robot (2 numbers), its
        state, its distance in m; a distance of inf without one
    """
    low, size = grid.low, grid.size
    count = grid.cells.shape[0]
    nearest[:, 3] = math.inf
    nearest[:, :3] = 0.0
    reach = int(SEARCH_RADIUS / size) + 1
    column0, row0 = int(math.floor((x - low) / size)), int(math.floor((y - low) / size))
    cosine, sine = math.cos(yaw), math.sin(yaw)
    for row in range(row0 - reach, row0 + reach + 1):
        for column in range(column0 - reach, column0 + reach + 1):
            outside = row < 0 or column < 0 or row >= count or column >= count
            state = UNKNOWN if outside else int(grid.cells[row, column])
            if state == FREE:
                if grid.seen[row, column] >= oldest:
                    continue
                state = UNKNOWN
            if state < least:
                continue
            away_x, away_y = low + (column + 0.5) * size - x, low + (row + 0.5) * size - y
            square = away_x * away_x + away_y * away_y
            if square > SEARCH_RADIUS * SEARCH_RADIUS or square == 0.0:
                continue
            ahead, left = cosine * away_x + sine * away_y, cosine * away_y - sine * away_x
            sector = int((math.atan2(left, ahead) / math.tau + 1.0) * SECTORS) % SECTORS
            distance = math.sqrt(square)
            if distance < nearest[sector, 3]:
                nearest[sector, 0], nearest[sector, 1] = ahead / distance, left / distance
                nearest[sector, 2], nearest[sector, 3] = state, distance


@kernel
def find_free(
    nearest: Array, cosine: Array, sine: Array, distance: float, free: NDArray[np.bool_]
) -> None:
    """Write which directions are free, given their cosines and sines; see :func:`find_nearest`."""
    for k in range(cosine.size):
        free[k] = True
        for sector in range(nearest.shape[0]):
            reach = nearest[sector, 3]
            if reach == math.inf:
                continue
            ahead, left = nearest[sector, 0], nearest[sector, 1]
            along = (ahead * cosine[k] + left * sine[k]) * reach
            aside = abs(left * cosine[k] - ahead * sine[k]) * reach
            # A cell that is already nearer than the distance blocks only what approaches it.
            near = aside < min(distance, reach - 0.01) and along < distance + 0.12
            if along > 0.0 and near:
                free[k] = False


@kernel
def write_conditions(
    nearest: Array, distance: float, ahead: float, rate: float, rows: Array
) -> int:
    """Write the barrier conditions as rows (a, b, c) of a v + b (TURN_WEIGHT omega) <= c.

    Return their number. A cell that is too near already permits no approach.
    """
    count = 0
    for sector in range(nearest.shape[0]):
        reach = nearest[sector, 3]
        if reach == math.inf:
            continue
        x, y = nearest[sector, 0] * reach, nearest[sector, 1] * reach
        rows[count, 0], rows[count, 1] = nearest[sector, 0], 0.0
        rows[count, 2] = rate * max(reach - distance, 0.0)
        count += 1
        away_x = x - ahead
        gap = math.sqrt(away_x * away_x + y * y)
        if gap > 1e-6:
            rows[count, 0] = away_x / gap
            rows[count, 1] = ahead * y / gap / TURN_WEIGHT
            rows[count, 2] = rate * max(gap - distance, 0.0)
            count += 1
    return count


@kernel
def nearest_permitted(rows: Array, first: float, second: float) -> tuple[float, float]:
    """Return the point nearest to (first, second) with a x + b y <= c for each row, c >= 0.

    Incremental: a row that the best point so far violates is active at the optimum of all rows up
    to it, which then is the nearest permitted point of its line. (0, 0) satisfies every row.
    """
    x, y = first, second
    for i in range(rows.shape[0]):
        a, b, c = rows[i, 0], rows[i, 1], rows[i, 2]
        if a * x + b * y <= c + 1e-12:
            continue
        norm = a * a + b * b
        if norm < 1e-18:
            continue
        excess = (a * first + b * second - c) / norm
        base_x, base_y = first - excess * a, second - excess * b
        lowest, highest = -math.inf, math.inf
        for j in range(i):
            slope = rows[j, 1] * a - rows[j, 0] * b
            room = rows[j, 2] - rows[j, 0] * base_x - rows[j, 1] * base_y
            if slope > 1e-12:
                highest = min(highest, room / slope)
            elif slope < -1e-12:
                lowest = max(lowest, room / slope)
        if lowest > highest:
            return 0.0, 0.0
        along = min(max(0.0, lowest), highest)
        x, y = base_x - along * b, base_y + along * a
    return x, y
