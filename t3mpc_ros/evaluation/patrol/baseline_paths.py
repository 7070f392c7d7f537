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
"""Paths of other patrols, as polylines in a rectangle.

Each is what its source describes, with what it leaves open chosen here and stated. None knows of
obstacles: like our own path, they are followed by the same robot with the same keep-out.
"""

from collections.abc import Callable, Mapping
from functools import partial
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.chaos.solver import FractionalSolver
from t3mpc_ros.chaos.system_equations import QuadraticSystem
from t3mpc_ros.geometry.polyline import polyline_length
from t3mpc_ros.geometry.types import Array

LEG = 1.0
"""Length of a straight leg of the random walk and of the logistic path, m: a quarter of a room."""
LANES = 20
"""Lanes of the boustrophedon: one for each row of the grid of coverage."""


class Rectangle(NamedTuple):
    """Where the centre of the robot may be, m."""

    low: tuple[float, float]
    high: tuple[float, float]


PathMaker = Callable[[Rectangle, float, np.random.Generator], Array]
"""Returns the corners of a path of at least some length (m) in a rectangle, shape (n, 2)."""


def random_walk(area: Rectangle, length: float, generator: np.random.Generator) -> Array:
    """Return legs of :data:`LEG` in directions drawn uniformly, those that leave drawn again."""
    count = math.ceil(length / LEG) + 1
    path = np.empty((count + 1, 2))
    path[0] = generator.uniform(area.low, area.high)
    for k in range(count):
        while True:
            direction = generator.uniform(-math.pi, math.pi)
            path[k + 1] = path[k] + LEG * np.array([math.cos(direction), math.sin(direction)])
            if _holds(area, path[k + 1]):
                break
    return path


def random_waypoints(area: Rectangle, length: float, generator: np.random.Generator) -> Array:
    """Return points drawn uniformly, one after the other (random waypoint mobility).

    Johnson and Maltz, Mobile Computing, 1996 (doi 10.1007/978-0-585-29603-6_5), without pauses.
    """
    path = [generator.uniform(area.low, area.high)]
    travelled = 0.0
    while travelled < length:
        path.append(generator.uniform(area.low, area.high))
        travelled += math.dist(path[-1], path[-2])
    return np.array(path)


def boustrophedon(area: Rectangle, length: float, generator: np.random.Generator) -> Array:
    """Return :data:`LANES` parallel lanes to and fro, then the same way back, again and again.

    Choset and Pignon, Field and Service Robotics, 1998 (doi 10.1007/978-1-4471-1273-0_32). Lanes
    are along the longer side, in the middle of the rows; the seed draws the corner of the start.
    """
    (x0, y0), (x1, y1) = area
    along = 0 if x1 - x0 >= y1 - y0 else 1
    ends = (area.low[along], area.high[along])
    across = 1 - along
    width = (area.high[across] - area.low[across]) / LANES
    lanes = area.low[across] + width * (np.arange(LANES) + 0.5)
    corners = np.empty((2 * LANES, 2))
    corners[:, across] = np.repeat(lanes, 2)
    corners[:, along] = [ends[((k + 1) // 2) % 2] for k in range(2 * LANES)]
    mirrors = generator.integers(0, 2, 2)
    middle = np.array([x0 + x1, y0 + y1])
    corners = np.where(mirrors[None, :] == 1, middle - corners, corners)
    there_and_back = np.vstack([corners, corners[-2:0:-1]])
    once = polyline_length(corners)
    laps = math.ceil(length / (2.0 * once)) + 1
    return np.tile(there_and_back, (laps, 1))


def arnold(area: Rectangle, length: float, generator: np.random.Generator) -> Array:
    """Return the path whose direction is a state of Arnold's flow, mirrored at the walls.

    Nakamura and Sekiguchi, IEEE Trans. Robot. Autom. 17, 2001 (doi 10.1109/70.976022): the first
    chaotic patrol. Parameters A = 1, B = C = 0.5; a unit of time is half a metre of path.
    """
    step, metres = 0.02, 0.5
    state = generator.uniform(-math.pi, math.pi, 3)

    def rate(s: Array) -> Array:
        return np.array(
            [
                math.sin(s[2]) + 0.5 * math.cos(s[1]),
                0.5 * math.sin(s[0]) + math.cos(s[2]),
                0.5 * math.sin(s[1]) + 0.5 * math.cos(s[0]),
            ]
        )

    count = math.ceil(length / (metres * step)) + 1
    direction = np.empty(count)
    for k in range(count):
        direction[k] = state[2]
        a = rate(state)
        b = rate(state + 0.5 * step * a)
        c = rate(state + 0.5 * step * b)
        d = rate(state + step * c)
        state = state + step / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    moves = metres * step * np.column_stack([np.cos(direction), np.sin(direction)])
    start = generator.uniform(area.low, area.high)
    return _mirrored(start + np.vstack([np.zeros(2), np.cumsum(moves, axis=0)]), area)


def logistic(area: Rectangle, length: float, generator: np.random.Generator) -> Array:
    """Return legs of :data:`LEG` in eight directions, chosen by three bits of the logistic map.

    Petavratzis et al., Technologies 7, 2019 (doi 10.3390/technologies7040084), with the plain map,
    bits of x -> 4 x (1 - x) against its median 1/2, and without their pheromones. A leg that
    leaves the area is skipped.
    """
    count = math.ceil(length / LEG) + 1
    value = float(generator.uniform(0.01, 0.99))
    path = [generator.uniform(area.low, area.high)]
    while len(path) <= count:
        number = 0
        for _ in range(3):
            value = 4.0 * value * (1.0 - value)
            if not 1e-12 < value < 1.0 - 1e-12:  # rounding fell onto the fixed point 0
                value = float(generator.uniform(0.01, 0.99))
            number = 2 * number + (value > 0.5)
        direction = 0.25 * math.pi * number
        end = path[-1] + LEG * np.array([math.cos(direction), math.sin(direction)])
        if _holds(area, end):
            path.append(end)
    return np.array(path)


def portrait(
    system: QuadraticSystem,
    initial: tuple[float, float, float],
    area: Rectangle,
    length: float,
    generator: np.random.Generator,
) -> Array:
    """Return y3 over y1 of a chaotic system, stretched to touch all four sides of the area."""
    solver = FractionalSolver(system, 1e-3, np.array(initial) + generator.uniform(-0.5, 0.5, 3))
    solver.advance(20_000)
    size = np.array(area.high) - area.low
    found: list[Array] = []
    while True:
        found += [solver.advance(4)[[0, 2]] for _ in range(2000)]
        points = np.array(found)
        low, high = points.min(axis=0), points.max(axis=0)
        path: Array = area.low + size * (points - low) / (high - low)
        if polyline_length(path) >= length:
            return path


LORENZ = QuadraticSystem(
    (1.0,) * 3,
    ((0, 0, -10.0), (0, 1, 10.0), (1, 0, 28.0), (1, 1, -1.0), (2, 2, -8.0 / 3.0)),
    ((1, 0, 2, -1.0), (2, 0, 1, 1.0)),
)
"""With the classical parameters 10, 28, 8/3.

J. Atmos. Sci. 20, 1963, doi 10.1175/1520-0469(1963)020<0130:DNF>2.0.CO;2.
"""
CHEN = QuadraticSystem(
    (1.0,) * 3,
    ((0, 0, -35.0), (0, 1, 35.0), (1, 0, -7.0), (1, 1, 28.0), (2, 2, -3.0)),
    ((1, 0, 2, -1.0), (2, 0, 1, 1.0)),
)
"""With the parameters 35, 3, 28.

Chen and Ueta, Int. J. Bifurcation Chaos 9, 1999, doi 10.1142/S0218127499001024.
"""
BASELINE_PATHS: Mapping[str, PathMaker] = {
    'Lorenz': partial(portrait, LORENZ, (1.0, 1.0, 25.0)),
    'Chen': partial(portrait, CHEN, (1.0, 1.0, 20.0)),
    'Arnold': arnold,
    'logistic': logistic,
    'random walk': random_walk,
    'random waypoints': random_waypoints,
    'boustrophedon': boustrophedon,
}
"""Path by name, in the order of the tables."""


def _holds(area: Rectangle, point: Array) -> bool:
    return bool((point >= area.low).all() and (point <= area.high).all())


def _mirrored(points: Array, area: Rectangle) -> Array:
    """Return the points folded into the area as by mirrors at its sides, with the corners there.

    A corner is added where a line meets a side, so that no line leaves the area.
    """
    low, size = np.array(area.low), np.array(area.high) - area.low
    unfolded = (points - low) / size
    pieces = [unfolded[:1]]
    for start, end in zip(unfolded, unfolded[1:], strict=False):
        if (np.floor(start) != np.floor(end)).any():
            shares = sorted(
                (k - start[axis]) / (end[axis] - start[axis])
                for axis in (0, 1)
                for k in range(
                    math.ceil(min(start[axis], end[axis])),
                    math.floor(max(start[axis], end[axis])) + 1,
                )
                if start[axis] != end[axis]
            )
            pieces.append(start + np.array(shares)[:, None] * (end - start))
        pieces.append(end[None, :])
    folded = np.abs(np.mod(np.vstack(pieces) + 1.0, 2.0) - 1.0)
    return low + size * folded
