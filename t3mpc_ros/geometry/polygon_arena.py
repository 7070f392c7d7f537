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
"""Arena: the convex polygon in which a path lies, and its map from the unit square."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import ParameterError

_SLICES = 257
"""Vertical lines at which area and height of the arena are tabulated."""


class Arena:
    """A convex polygon; a path in an L-shaped room has the hull as arena and walls to avoid.

    Its numbers are left, bottom, right, top of a rectangle, or x, y of three or more corners
    in turn, m.
    """

    def __init__(self, numbers: Sequence[float]) -> None:
        if len(numbers) == 4:
            left, bottom, right, top = numbers
            numbers = (left, bottom, right, bottom, right, top, left, top)
        if len(numbers) < 6 or len(numbers) % 2:
            raise ParameterError(
                'arena must be left, bottom, right, top, or x, y of at least three corners: '
                f'got {len(numbers)} numbers'
            )
        corners = np.array(numbers, dtype=np.float64).reshape(-1, 2)
        runs = np.roll(corners, -1, axis=0) - corners
        turns = runs[:, 0] * np.roll(runs, -1, axis=0)[:, 1]
        turns -= runs[:, 1] * np.roll(runs, -1, axis=0)[:, 0]
        if turns.sum() < 0.0:
            corners, turns = corners[::-1], -turns[::-1]
        angles = np.arctan2(*(np.roll(corners, -1, axis=0) - corners).T[::-1])
        turned = np.remainder(np.roll(angles, -1) - angles + np.pi, 2.0 * np.pi) - np.pi
        if not (turns > 1e-9).all() or abs(turned.sum() - 2.0 * np.pi) > 1e-6:
            raise ParameterError(
                'arena must be a convex polygon with an area, without three corners in a line: '
                f'got {corners.tolist()}'
            )
        self.corners: Array = corners
        """m, counter-clockwise, shape (n, 2)."""
        self._x = np.linspace(corners[:, 0].min(), corners[:, 0].max(), _SLICES)
        self._low, self._high = self._heights()
        height = self._high - self._low
        areas = np.concatenate([[0.0], np.cumsum(0.5 * (height[1:] + height[:-1]))])
        self._share = areas / areas[-1]

    def _heights(self) -> tuple[Array, Array]:
        """Return the lowest and the highest y of the polygon at each vertical line."""
        low, high = np.full(_SLICES, np.inf), np.full(_SLICES, -np.inf)
        for start, end in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            (x0, y0), (x1, y1) = sorted((tuple(start), tuple(end)))
            rows = (self._x >= x0) & (self._x <= x1)
            if x1 == x0:
                y = np.array([[y0], [y1]])
            else:
                y = (y0 + (self._x[rows] - x0) * (y1 - y0) / (x1 - x0))[None]
            low[rows] = np.minimum(low[rows], y.min(axis=0))
            high[rows] = np.maximum(high[rows], y.max(axis=0))
        return low, high

    def from_unit_square(self, places: Array) -> Array:
        """Return the points (m) of places in the unit square, shape (n, 2); areas keep shares.

        A uniform distribution over the square becomes uniform over the arena (the transformation
        of Rosenblatt, Ann. Math. Stat. 23, 1952, doi 10.1214/aoms/1177729394).
        """
        x = np.interp(places[:, 0], self._share, self._x)
        low, high = (np.interp(x, self._x, each) for each in (self._low, self._high))
        return np.column_stack([x, low + places[:, 1] * (high - low)])

    def contains(self, points: Array, tolerance: float = 1e-9) -> NDArray[np.bool_]:
        """Return whether each point (m), shape (n, 2), is inside or within a tolerance (m)."""
        inside = np.ones(len(points), dtype=np.bool_)
        for start, end in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            run = (end - start) / np.hypot(*(end - start))
            away = points - start
            inside &= run[0] * away[:, 1] - run[1] * away[:, 0] >= -tolerance
        return inside
