# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Walls that meet share their end points to the last bit, as the force at corners needs it."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

JOIN = 1e-4
"""m: ends nearer to each other, or to a wall, than this are meant to touch."""


def join_walls(segments: Array) -> Array:
    """Return the walls with every meeting point an end of all walls there, shape (n', 4).

    Ends within :data:`JOIN` of one another become one; a wall on which another one ends is cut
    there, and of what then stands twice one is kept. Walls that cross are left alone: at a
    crossing the bumper is always in a corner.

    Parameters
    ----------
    segments
        Shape (n, 4), m; each longer than twice :data:`JOIN`.
    """
    points: Array = segments.reshape(-1, 2).copy()
    for index in range(1, len(points)):
        near = np.hypot(*(points[:index] - points[index]).T) <= JOIN
        if near.any():
            points[index] = points[int(near.argmax())]
    joined: dict[tuple[tuple[float, ...], ...], tuple[float, ...]] = {}
    for start, end in points.reshape(-1, 2, 2):
        stops = [start, *_ends_between(start, end, points), end]
        for here, there in zip(stops, stops[1:], strict=False):
            ends = tuple(here.tolist()), tuple(there.tolist())
            joined.setdefault(tuple(sorted(ends)), (*ends[0], *ends[1]))
    return np.array(list(joined.values()), dtype=np.float64).reshape(-1, 4)


def _ends_between(start: Array, end: Array, points: Array) -> list[Array]:
    """Return the points that lie on a wall between its ends, in order from its start."""
    length = float(np.hypot(*(end - start)))
    direction = (end - start) / length
    away = points - start
    along = away @ direction
    off = np.abs(away @ np.array([-direction[1], direction[0]]))
    # Ends nearer than JOIN to those of this wall are one with them by now.
    on = np.flatnonzero((off <= JOIN) & (along > 0.5 * JOIN) & (along < length - 0.5 * JOIN))
    between = {tuple(points[index].tolist()): index for index in on[np.argsort(along[on])]}
    return [points[index] for index in between.values()]
