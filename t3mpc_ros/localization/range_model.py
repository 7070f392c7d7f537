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
r"""Likelihood of range readings at a pose: the beam model with the limits of a sensor.

With the expected distance e along the beam and a standard deviation :math:`\sigma`, a reading z
within the measuring range has the density

.. math:: p(z) = z_{hit}\,N(z; e, \sigma^2)
                 + z_{short}\,\lambda e^{-\lambda z}\,[z < e] + z_{rand}\,/\,(z_{max} - z_{min})

(Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3). A reading beyond the range
has the probability :math:`z_{hit}\,\Phi((e - z_{max})/\sigma) + z_{max}`, one that is too near
:math:`z_{hit}\,\Phi((z_{min} - e)/\sigma)` and a share of what is short. That no wall was seen
is evidence, too: eight beams of 0.8 m see none in the middle of a room.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.localization.distance_field import DistanceField, distance_at, trace_ray
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

NAMES = 'nav2_amcl'
"""Source of the names."""
BEYOND = 1.3
"""Rays are traced up to this multiple of the largest distance: the likelihood is smooth there."""
IN_OBSTACLE = 1e-3
"""Likelihood of a place at which the robot would be in an obstacle, relative to free floor."""


@dataclass(frozen=True)
class RangeModelParameters(Parameters):
    """Weights and errors of the beam model."""

    z_hit: float = parameter(
        0.67, 'weight of readings that hit what the map has', bounds=(1e-3, 1.0), source=NAMES
    )
    z_short: float = parameter(
        0.05,
        'weight of readings of something nearer than the map has',
        bounds=(0.0, 1.0),
        source=NAMES,
    )
    z_max: float = parameter(
        0.2,
        'weight of readings without a hit, as of a thing that the map has and the room has not',
        bounds=(1e-6, 1.0),
        source=NAMES,
    )
    z_rand: float = parameter(0.08, 'weight of random readings', bounds=(1e-6, 1.0), source=NAMES)
    sigma_hit: float = parameter(
        0.012, 'standard deviation of a short reading', 'm', (1e-3, 1.0), source=NAMES
    )
    sigma_hit_growth: float = parameter(
        0.05,
        'growth of the standard deviation with the square of the distance: triangulating sensors; '
        '0 for a laser',
        '1/m',
        (0.0, 1.0),
    )
    lambda_short: float = parameter(
        1.0, 'decay of the density of short readings', '1/m', (0.0, 100.0), source=NAMES
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` if the weights are more than one together."""
        total = self.z_hit + self.z_short + self.z_max + self.z_rand
        if total > 1.0 + 1e-9:
            raise ParameterError(
                f'z_hit, z_short, z_max and z_rand must sum to at most 1: got {total:g}'
            )


class RangeModel(NamedTuple):
    """Parameters of the model, for kernels; meaning and units as in the table."""

    z_hit: float
    z_short: float
    z_max: float
    z_rand: float
    sigma_hit: float
    sigma_hit_growth: float
    lambda_short: float
    radius: float
    """Distance from obstacles below which the robot cannot stand, m."""

    @classmethod
    def of(cls, parameters: RangeModelParameters, radius: float) -> 'RangeModel':
        """Return the model of a table."""
        return cls(**vars(parameters), radius=radius)


class Beams(NamedTuple):
    """Readings with the beams that they were taken along, in the frame of the robot."""

    origin: Array
    """x, y (m) and direction (rad), shape (n, 3)."""
    reading: Array
    """m (REP 117: -inf too near, inf no hit), shape (n,); never NaN."""
    limits: Array
    """Smallest and largest distance of the sensor, m, shape (n, 2)."""


@kernel
def normal_share(deviations: float) -> float:
    """Return the probability that a normal variable is less than so many deviations."""
    return 0.5 * math.erfc(-deviations / math.sqrt(2.0))


@kernel
def hit_likelihood(
    reading: float, expected: float, least: float, most: float, model: RangeModel
) -> float:
    """Return density or probability of a reading of what is at ``expected`` m; inf: nothing."""
    seen = min(expected, BEYOND * most)
    sigma = math.sqrt(model.sigma_hit**2 + (model.sigma_hit_growth * seen * seen) ** 2)
    if reading >= most:
        return normal_share((seen - most) / sigma)
    if reading <= least:
        return normal_share((least - seen) / sigma)
    if expected == math.inf:
        return 0.0
    deviation = (reading - seen) / sigma
    return math.exp(-0.5 * deviation * deviation) / (math.sqrt(math.tau) * sigma)


@kernel
def other_likelihood(
    reading: float, expected: float, least: float, most: float, model: RangeModel
) -> float:
    """Return density or probability of a reading that is not of what the map has."""
    if reading >= most:
        return model.z_max
    if reading <= least:
        return model.z_short * (1.0 - math.exp(-model.lambda_short * least)) + model.z_rand * 0.1
    short = 0.0
    if reading < expected:
        short = model.z_short * model.lambda_short * math.exp(-model.lambda_short * reading)
    return short + model.z_rand / (most - least)


@kernel
def weigh(
    poses: Array, logarithms: Array, field: DistanceField, beams: Beams, model: RangeModel
) -> None:
    """Write the logarithm of the likelihood of all readings at each pose.

    poses : x, y (m), yaw (rad), shape (n, 3); logarithms : shape (n,)
    """
    for k in range(poses.shape[0]):
        x, y, yaw = poses[k, 0], poses[k, 1], poses[k, 2]
        total = 0.0
        if distance_at(field, x, y) < model.radius:
            total = math.log(IN_OBSTACLE)
        cosine, sine = math.cos(yaw), math.sin(yaw)
        for i in range(beams.reading.size):
            ahead, left = beams.origin[i, 0], beams.origin[i, 1]
            least, most = beams.limits[i, 0], beams.limits[i, 1]
            expected = trace_ray(
                field,
                x + cosine * ahead - sine * left,
                y + sine * ahead + cosine * left,
                yaw + beams.origin[i, 2],
                BEYOND * most,
            )
            reading = beams.reading[i]
            hit = model.z_hit * hit_likelihood(reading, expected, least, most, model)
            total += math.log(hit + other_likelihood(reading, expected, least, most, model))
        logarithms[k] = total


@kernel
def best_logarithm(beams: Beams, model: RangeModel) -> float:
    """Return the logarithm of the likelihood of readings that all are as expected."""
    total = 0.0
    for i in range(beams.reading.size):
        least, most = beams.limits[i, 0], beams.limits[i, 1]
        reading = min(max(beams.reading[i], 0.0), BEYOND * most)
        hit = model.z_hit * hit_likelihood(beams.reading[i], reading, least, most, model)
        total += math.log(hit + other_likelihood(beams.reading[i], reading, least, most, model))
    return total


@kernel
def explain_readings(
    pose: Array, field: DistanceField, beams: Beams, model: RangeModel, found: Array
) -> None:
    """Write of each reading at a pose whether it fits to the map, and where.

    A reading without a hit says nothing where the map has nothing within the range.

    pose : x, y (m), yaw (rad), shape (3,)
    found : shape (n, 3), overwritten: 1 if it fits, -1 if it contradicts the map, 0 if it says
        nothing; x, y of the nearer of what the map has and what was read, m
    """
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    for i in range(beams.reading.size):
        ahead, left = beams.origin[i, 0], beams.origin[i, 1]
        least, most = beams.limits[i, 0], beams.limits[i, 1]
        x, y = pose[0] + cosine * ahead - sine * left, pose[1] + sine * ahead + cosine * left
        direction = pose[2] + beams.origin[i, 2]
        expected = trace_ray(field, x, y, direction, BEYOND * most)
        reading = beams.reading[i]
        away = max(min(expected, reading, most), least)
        found[i, 1] = x + away * math.cos(direction)
        found[i, 2] = y + away * math.sin(direction)
        found[i, 0] = 0.0
        if reading < most or expected < most:
            hit = model.z_hit * hit_likelihood(reading, expected, least, most, model)
            other = other_likelihood(reading, expected, least, most, model)
            found[i, 0] = 1.0 if hit > other else -1.0


def beams_of_scan(
    reading: Array, first: float, increment: float, limits: tuple[float, float], count: int
) -> Beams:
    """Return at most ``count`` beams, evenly spaced, in the frame of a laser; NaN is left out.

    reading : m, shape (n,); first, increment : of their directions, rad
    limits : smallest and largest distance, m

    ValueError: no scan has such directions or limits; with them no particle has a likelihood.
    """
    least, most = limits
    turns = math.isfinite(increment) and (increment != 0.0 or reading.size < 2)
    positive, ascending = 0.0 <= least < math.inf, least < most < math.inf
    for name, value, possible, wanted in (
        ('angle_min', first, math.isfinite(first), 'finite'),
        ('angle_increment', increment, turns, 'finite and not 0'),
        ('range_min or laser_min_range', least, positive, 'finite and at least 0 m'),
        ('range_max or laser_max_range', most, ascending, f'finite and above {least:g} m'),
    ):
        if not possible:
            raise ValueError(f'{name} must be {wanted}: got {value:g}')
    chosen = np.unique(np.linspace(0, max(reading.size - 1, 0), count).astype(np.int64))
    chosen = chosen[~np.isnan(reading[chosen])] if reading.size else chosen[:0]
    rays = np.zeros((chosen.size, 3))
    rays[:, 2] = first + increment * chosen
    return Beams(rays, reading[chosen], np.tile([least, most], (chosen.size, 1)))


def joined(parts: Sequence[Beams]) -> Beams:
    """Return the beams of several sensors."""
    nothing = Beams(np.empty((0, 3)), np.empty(0), np.empty((0, 2)))
    return Beams(*map(np.concatenate, zip(nothing, *parts, strict=True)))
