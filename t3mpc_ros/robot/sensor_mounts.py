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
"""Where the faces of the range sensors are on the robot, and where their rays end."""

import math

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters


def sensor_mounts(parameters: RangeSensorParameters) -> Array:
    """Return x, y (m) and direction (rad) of each sensor's face in the body frame, shape (8, 3).

    x is forward and y to the left of the middle of the axle; in the order of RANGE_SENSORS.
    """
    ahead, aside, offset = parameters.half_length, parameters.half_width, parameters.offset
    quarter = 0.5 * math.pi
    return np.array(
        [
            [ahead, offset, 0.0],
            [ahead, -offset, 0.0],
            [offset, aside, quarter],
            [-offset, aside, quarter],
            [-ahead, offset, math.pi],
            [-ahead, -offset, math.pi],
            [offset, -aside, -quarter],
            [-offset, -aside, -quarter],
        ]
    )


def ray_ends(poses: Array, ranges: Array, mounts: Array) -> Array:
    """Return where the rays of range sensors end, m, shape (n, k, 2).

    ``poses``: x, y (m), yaw (rad), shape (n, 3). ``ranges`` (m, shape (n, k)): 0 gives the
    faces of the sensors, and a reach that is not finite NaN. ``mounts``: as
    :func:`sensor_mounts`.
    """
    x, y, yaw = (column[:, None] for column in poses.T)
    ahead, left, direction = (column[None, :] for column in mounts.T)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    reach = np.where(np.isfinite(ranges), ranges, math.nan)
    return np.stack(
        [
            x + cosine * ahead - sine * left + reach * np.cos(yaw + direction),
            y + sine * ahead + cosine * left + reach * np.sin(yaw + direction),
        ],
        axis=-1,
    )
