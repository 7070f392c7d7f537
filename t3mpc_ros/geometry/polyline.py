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
"""Polylines: check of their points, length, resampling, and distance of a point."""

from collections.abc import Callable
import math

import numpy as np

from t3mpc_ros.geometry.types import Array

MAX_COORDINATE = 10_000.0
"""m"""


class PathError(ValueError):
    """A path that cannot be followed; the text contains the point, the bound and the value."""


def check_points(points: Array) -> None:
    """Raise :class:`PathError` unless ``points`` has the shape (n, 2) and is within bounds."""
    if points.ndim != 2 or points.shape[1] != 2:
        raise PathError(f'points must have the shape (n, 2): got {points.shape}')
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise PathError(f'points must be finite: point {row} is {points[row].tolist()}')
    beyond = np.abs(points).max(axis=1, initial=0.0) > MAX_COORDINATE
    if beyond.any():
        row = int(np.argmax(beyond))
        raise PathError(
            f'coordinates must be at most {MAX_COORDINATE:g} m: '
            f'point {row} is {points[row].tolist()}'
        )


def polyline_length(points: Array) -> float:
    """Return the length (m) of a polyline, shape (n, 2)."""
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def lengths_along(points: Array) -> Array:
    """Return the length (m) of a polyline, shape (n, 2), up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def resample(points: Array, spacing: float, rounding: Callable[[float], int] = math.ceil) -> Array:
    """Return evenly spaced points along a polyline, shape (n, 2), with both ends.

    Their distance is ``spacing`` (m) at most, or about that with ``rounding`` :func:`round`.
    """
    lengths = lengths_along(points)
    count = max(1, rounding(float(lengths[-1]) / spacing))
    along = np.linspace(0.0, lengths[-1], count + 1)
    return np.column_stack([np.interp(along, lengths, column) for column in points.T])


def distance_to_path(points: Array, path: Array) -> Array:
    """Return the distance (m) of each point, shape (n, 2), to the nearest one of a polyline."""
    starts, runs = path[:-1], np.diff(path, axis=0)
    squares = np.maximum((runs**2).sum(axis=1), 1e-18)
    nearest = np.empty(len(points))
    for first in range(0, len(points), 256):
        away = points[first : first + 256, None, :] - starts[None]
        share = np.clip((away * runs).sum(axis=2) / squares, 0.0, 1.0)
        gap = away - share[:, :, None] * runs
        nearest[first : first + 256] = np.sqrt((gap**2).sum(axis=2).min(axis=1))
    return nearest
