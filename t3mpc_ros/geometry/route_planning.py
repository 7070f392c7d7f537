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
r"""Routes on an occupancy grid: the fastest way around obstacles, and how near a path passes them.

The time of arrival T at each cell solves the eikonal equation :math:`|\nabla T| = w` with a cost
w that grows near obstacles and on floor that has not been seen, by sweeps over the grid (Zhao,
Math. Comp. 74, 2005, doi 10.1090/S0025-5718-04-01678-3). A route descends its gradient, so it is
not bound to the directions of the grid. The cost of a plan is a few sweeps, whatever its length.
"""

from collections.abc import Callable
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.obstacles import OCCUPIED_PERCENT, OccupancyGrid
from t3mpc_ros.geometry.polyline import resample
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel

SPACING = 0.01
"""Distance of the points of a route, m."""
STRIDE = 2
"""Cells of the map per node of the search, in both directions."""
COMFORT = 0.1
"""Distance beyond the least one from which on obstacles do not count, m."""
NEAR_COST, UNSEEN_COST, CLOSE_COST = 1.0, 0.7, 10.0
"""Cost beside that of the length: at the least distance from obstacles, on floor that has not been
seen, and nearer to obstacles than permitted, where a route may only begin."""
ESCAPE = 0.3
"""Distance from its begin up to which a route may be too near to obstacles, m."""
WAY_OUT = 0.75
"""Share of its distance from obstacles that a way keeps which begins too near to them."""
FAR = 1e3
"""Distance from obstacles where there are none, m."""
MAX_SWEEPS = 100


class RoutePlanner:
    """Distances and routes on the newest grid.

    distance : least distance of a route from obstacles, m
    """

    def __init__(self, distance: float) -> None:
        self.distance = distance
        """m"""
        self._origin = np.zeros(2)
        self._step = 1.0
        self._walls: Array = np.full((1, 1), FAR)
        self._unsafe: Array = np.zeros((1, 1))
        self._times: Array = np.full((1, 1), math.inf)
        self._scale = 1.0

    def update(self, grid: OccupancyGrid) -> None:
        """Use another grid from now on; beyond it, floor counts as unknown."""
        occupied = grid.cells >= OCCUPIED_PERCENT
        self._step = grid.resolution
        self._origin = np.array([grid.x, grid.y]) + 0.5 * grid.resolution
        self._walls = np.minimum(grid.resolution * nearest_distances(occupied), FAR)
        unknown = np.pad(occupied | (grid.cells < 0), 1, constant_values=True)
        self._unsafe = grid.resolution * nearest_distances(unknown)[1:-1, 1:-1]

    def wall_distance(self, points: Array) -> Array:
        """Return the distance of points, shape (n, 2), from the centre of an occupied cell, m."""
        return self._at(self._walls, points, math.inf)

    def unsafe_distance(self, points: Array) -> Array:
        """Return their distance from a cell that is occupied or unknown, m."""
        return self._at(self._unsafe, points, 0.0)

    def _at(self, field: Array, points: Array, outside: float) -> Array:
        rows, columns = field.shape
        place = (points - self._origin) / self._step
        inside = ((place > -0.5) & (place < np.array([columns, rows]) - 0.5)).all(axis=1)
        place = np.clip(place, 0.0, np.array([columns - 1.0, rows - 1.0]))
        column = np.clip(place[:, 0].astype(np.int64), 0, max(columns - 2, 0))
        row = np.clip(place[:, 1].astype(np.int64), 0, max(rows - 2, 0))
        across, up = place[:, 0] - column, place[:, 1] - row
        right, above = np.minimum(column + 1, columns - 1), np.minimum(row + 1, rows - 1)
        low = (1.0 - across) * field[row, column] + across * field[row, right]
        high = (1.0 - across) * field[above, column] + across * field[above, right]
        return np.where(inside, (1.0 - up) * low + up * high, outside)

    def spread(
        self, begin: tuple[float, float], extra: Callable[[Array], Array] | None = None
    ) -> None:
        """Find the way from a place (m) to every other one: see the methods below.

        extra : returns further costs of places, shape (n, 2), by their length: shape (n,)
        """
        walls, unsafe = self._walls[::STRIDE, ::STRIDE], self._unsafe[::STRIDE, ::STRIDE]
        self._scale = STRIDE * self._step
        near = np.clip((self.distance + COMFORT - walls) / COMFORT, 0.0, 1.0)
        costs = 1.0 + NEAR_COST * near + UNSEEN_COST * (unsafe < self.distance)
        place = (np.array(begin) - self._origin) / self._scale
        rows, columns = costs.shape
        if extra is not None:
            row, column = np.indices(costs.shape).reshape(2, -1)
            nodes = self._origin + self._scale * np.column_stack([column, row])
            costs += extra(nodes).reshape(costs.shape)
        away = np.hypot(
            np.arange(columns)[None, :] - place[0], np.arange(rows)[:, None] - place[1]
        )
        allowed = WAY_OUT * float(self.wall_distance(np.array([begin]))[0])
        escape = (away * self._scale < ESCAPE) & (walls >= min(allowed, self.distance))
        costs[escape & (walls < self.distance)] = CLOSE_COST
        costs[(walls < self.distance) & ~escape] = math.inf
        times: Array = np.full(costs.shape, math.inf)
        # Exact around the begin, where the front is more curved than the grid can show.
        start = (away < 3.0) & np.isfinite(costs)
        dearest = float(costs[start].max(initial=0.0))
        # Times that grow with the distance: cheap places beyond dear ones were no way down.
        np.copyto(times, away * dearest, where=start)
        for _ in range(MAX_SWEEPS):
            if not sweep_times(times, costs):
                break
        self._times = times

    def arrival(self, points: Array) -> Array:
        """Return the cost (m) of the way to points, shape (n, 2); inf: there is none."""
        rows, columns = self._times.shape
        place = np.floor((points - self._origin) / self._scale + 0.5).astype(np.int64)
        inside = ((place >= 0) & (place < [columns, rows])).all(axis=1)
        column, row = np.clip(place, 0, [columns - 1, rows - 1]).T
        return np.where(inside, self._scale * self._times[row, column], math.inf)

    def reached_places(self) -> Array:
        """Return the nodes of the search that have a way, x and y (m), shape (n, 2)."""
        rows, columns = np.nonzero(np.isfinite(self._times))
        return self._origin + self._scale * np.column_stack([columns, rows])

    def route(self, end: tuple[float, float], begin: tuple[float, float]) -> Array | None:
        """Return the points (m) of the way found to ``end``, without its begin; None: no way.

        begin : that of the last :meth:`spread`
        """
        goal = np.array(end)
        if not math.isfinite(float(self.arrival(goal[None])[0])):
            return None
        places = np.empty((8 * self._times.size, 2))
        start = (np.array(begin) - self._origin) / self._scale
        here = (goal - self._origin) / self._scale
        count = descend_times(self._times, here, start, places)
        if count < 0:
            return None
        found = self._origin + self._scale * places[:count]
        return resample(np.vstack([begin, found[::-1], goal]), SPACING, round)[1:]


def nearest_distances(marked: NDArray[np.bool_]) -> Array:
    """Return the distance, in cells, of each cell to the nearest marked one; inf without any."""
    squares = np.where(marked, 0.0, math.inf)
    longest = max(squares.shape)
    distance_transform(
        squares, np.empty(longest), np.empty(longest, dtype=np.int64), np.empty(longest + 1)
    )
    return np.sqrt(squares)


@kernel
def distance_transform(
    squares: Array, line: Array, parabolas: NDArray[np.int64], bounds: Array
) -> None:
    """Replace 0 (obstacle) and inf by the squared distance, in cells, to the nearest obstacle.

    Lower envelope of parabolas along each column and then along each row (Felzenszwalb and
    Huttenlocher, Theory of Computing 8, 2012, doi 10.4086/toc.2012.v008a019).

    line, parabolas : shape (n,), bounds : shape (n + 1,), with the longer side n; overwritten
    """
    rows, columns = squares.shape
    for column in range(columns):
        for row in range(rows):
            line[row] = squares[row, column]
        _envelope(squares[:, column], line, parabolas, bounds)
    for row in range(rows):
        for column in range(columns):
            line[column] = squares[row, column]
        _envelope(squares[row], line, parabolas, bounds)


@kernel
def _envelope(out: Array, line: Array, parabolas: NDArray[np.int64], bounds: Array) -> None:
    """Write min over j of (i - j)² + line[j] into ``out[i]``."""
    count, last = out.size, -1
    for j in range(count):
        if line[j] == math.inf:
            continue
        begin = -math.inf
        while last >= 0:
            k = parabolas[last]
            begin = ((line[j] + j * j) - (line[k] + k * k)) / (2.0 * (j - k))
            if begin > bounds[last]:
                break
            last -= 1
        if last < 0:
            begin = -math.inf
        last += 1
        parabolas[last], bounds[last] = j, begin
    if last < 0:
        return
    bounds[last + 1] = math.inf
    piece = 0
    for i in range(count):
        while bounds[piece + 1] < i:
            piece += 1
        away = i - parabolas[piece]
        out[i] = away * away + line[parabolas[piece]]


@kernel
def sweep_times(times: Array, costs: Array) -> bool:
    """Improve the times by the upwind scheme of Godunov in four sweeps; return whether any fell.

    costs : time per cell, inf where there is no way, shape (rows, columns), as ``times``
    """
    rows, columns = times.shape
    changed = False
    for direction in range(4):
        for i in range(rows):
            row = i if direction < 2 else rows - 1 - i
            for j in range(columns):
                column = j if direction % 2 == 0 else columns - 1 - j
                cost = costs[row, column]
                if cost == math.inf:
                    continue
                a = times[row, column - 1] if column > 0 else math.inf
                if column < columns - 1:
                    a = min(a, times[row, column + 1])
                b = times[row - 1, column] if row > 0 else math.inf
                if row < rows - 1:
                    b = min(b, times[row + 1, column])
                least = min(a, b)
                if least == math.inf:
                    continue
                if abs(a - b) >= cost:
                    found = least + cost
                else:
                    found = 0.5 * (a + b + math.sqrt(2.0 * cost * cost - (a - b) * (a - b)))
                if found < times[row, column] - 1e-9:
                    times[row, column] = found
                    changed = True
    return changed


@kernel
def slope(times: Array, row: int, column: int, along_row: bool) -> float:
    """Return the upwind derivative of the times at a node along x or, ``along_row``, along y."""
    rows, columns = times.shape
    here = times[row, column]
    before = after = math.inf
    if along_row:
        if row > 0:
            before = times[row - 1, column]
        if row < rows - 1:
            after = times[row + 1, column]
    else:
        if column > 0:
            before = times[row, column - 1]
        if column < columns - 1:
            after = times[row, column + 1]
    if min(before, after) >= here:
        return 0.0
    return float(here - before if before < after else after - here)


@kernel
def descend_times(times: Array, here: Array, goal: Array, places: Array) -> int:
    """Write the places from ``here`` down to the node of time 0, by half a cell each.

    here, goal : column and row, shape (2,); ``here`` is overwritten
    places : shape (n, 2), overwritten
    Return how many there are; -1: they do not fit.
    """
    rows, columns = times.shape
    for count in range(places.shape[0]):
        if math.hypot(here[0] - goal[0], here[1] - goal[1]) < 1.5:
            return count
        column = max(0, min(int(here[0]), columns - 2))
        row = max(0, min(int(here[1]), rows - 2))
        share_x, share_y = here[0] - column, here[1] - row
        x = y = 0.0
        for i in range(2):
            for j in range(2):
                if times[row + i, column + j] < math.inf:
                    weight = (share_y if i else 1.0 - share_y) * (share_x if j else 1.0 - share_x)
                    x += weight * slope(times, row + i, column + j, False)
                    y += weight * slope(times, row + i, column + j, True)
        size = math.hypot(x, y)
        if size > 1e-6:
            here[0] -= 0.5 * x / size
            here[1] -= 0.5 * y / size
        column = max(0, min(int(here[0] + 0.5), columns - 1))
        row = max(0, min(int(here[1] + 0.5), rows - 1))
        if size <= 1e-6 or times[row, column] == math.inf:
            # At a kink, or over the edge of the floor: to the best node around.
            best, best_row, best_column = math.inf, row, column
            for i in range(max(row - 1, 0), min(row + 2, rows)):
                for j in range(max(column - 1, 0), min(column + 2, columns)):
                    if times[i, j] < best:
                        best, best_row, best_column = times[i, j], i, j
            if best == math.inf:
                return -1
            here[0], here[1] = best_column, best_row
        places[count, 0], places[count, 1] = here[0], here[1]
    return -1
