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
"""Obstacles: known walls and pillars, and the occupancy grid of the floor."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array

OCCUPIED_PERCENT = 65
"""Occupancy from which on a cell is an obstacle."""


class Obstacles(NamedTuple):
    """Known obstacles in the frame of the odometry."""

    segments: Array = np.empty((0, 4))
    """Walls: ax, ay, bx, by, m, shape (n, 4)."""
    circles: Array = np.empty((0, 3))
    """Pillars: x, y, radius, m, shape (m, 3)."""


class OccupancyGrid(NamedTuple):
    """State of the floor in cells, as of ``nav_msgs/OccupancyGrid``."""

    cells: NDArray[np.int8]
    """0 (free) to 100 (occupied) percent, -1 unknown, shape (rows, columns), row by y."""
    resolution: float
    """Side of a cell, m."""
    x: float
    """Of the corner of the first cell, m."""
    y: float
    """Of the corner of the first cell, m."""
