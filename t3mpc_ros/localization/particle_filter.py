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
r"""Adaptive Monte Carlo localisation: particles, their motion, weights, number and recovery.

Parts and sources: odometry motion model and augmented MCL with its two averages of the likelihood
(Thrun, Burgard and Fox, Probabilistic Robotics, 2005, sections 5.4 and 8.3.5); number of particles
by the Kullback-Leibler distance (Fox, Int. J. Robotics Research 22, 2003, doi
10.1177/0278364903022012001); low-variance resampling; new particles where the present readings
are likely (Lenser and Veloso, ICRA 2000, doi 10.1109/ROBOT.2000.844766). Parameters have the
names of nav2_amcl.
"""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import Array, Pose, wrap_angle
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.localization.distance_field import DistanceField
from t3mpc_ros.localization.range_model import NAMES, Beams, RangeModel, best_logarithm, weigh
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

CANDIDATES = 16
"""Random poses of which each new particle is the one that fits the readings, on average."""
TOLERATED_FALL = 1.5
"""Ratio of the averages from which on random particles are added (Gutmann and Fox, IROS 2002, doi
10.1109/IRDS.2002.1041434)."""
SHORTEST = 1e-3
"""Travel below which its direction is unknown, m."""
CLUSTER_DISTANCE, CLUSTER_ANGLE = 0.3, 0.5
"""Distance (m) and yaw (rad) from its mean up to which a particle is in a cluster."""
CLUSTER_ROUNDS = 3
KNOWN_SHARE = 0.7
"""Share of the weight in the heaviest cluster from which on the place is known."""
SEARCH_SIGMA = 0.06
"""Least standard deviation of a reading while it is not known, m: particles are farther apart than
the readings are exact, and the nearest to the robot would be dropped."""
NEAR_DISTANCE, NEAR_ANGLE = 0.15, 0.05
"""Standard deviations (m, rad) of half of the new particles from the last estimate: wheels slip
more often than a robot is carried, and a gyro then measures the turn. With more of the angle, some
readings that are wrong alike turn the pose."""
KEPT_SHARE = 0.5
"""Share of the heaviest cluster's weight with which the cluster of the last estimate is kept."""


@dataclass(frozen=True)
class ParticleFilterParameters(Parameters):
    """Noise of the odometry, number of particles, and recovery."""

    alpha1: float = parameter(
        0.001, 'variance of a turn per square of the turn', bounds=(0.0, 10.0), source=NAMES
    )
    alpha2: float = parameter(
        0.001, 'variance of a turn per square of the travel', 'rad²/m²', (0.0, 10.0), source=NAMES
    )
    alpha3: float = parameter(
        0.005, 'variance of a travel per square of the travel', bounds=(0.0, 10.0), source=NAMES
    )
    alpha4: float = parameter(
        0.0001, 'variance of a travel per square of the turn', 'm²/rad²', (0.0, 10.0), source=NAMES
    )
    yaw_drift: float = parameter(
        1e-5,
        'variance of the yaw per time: bias of a gyro, for which turn and travel say nothing; '
        'from 3e-5 on the corrections of the pose look like contacts',
        'rad²/s',
        (0.0, 1.0),
    )
    min_particles: int = parameter(
        500, 'smallest number of particles', bounds=(10, 100_000), source=NAMES
    )
    max_particles: int = parameter(
        5000, 'largest number of particles', bounds=(10, 100_000), source=NAMES
    )
    pf_err: float = parameter(
        0.05,
        'bound of the Kullback-Leibler distance of the particles from the distribution',
        bounds=(1e-3, 1.0),
        source=NAMES,
    )
    pf_z: float = parameter(
        0.99,
        'quantile of the standard normal distribution with which the bound holds',
        bounds=(0.0, 5.0),
        source=NAMES,
    )
    spatial_resolution: float = parameter(
        0.1, 'side of the bins that are counted for the number of particles', 'm', (0.01, 10.0)
    )
    angular_resolution: float = parameter(0.17, 'angle of these bins', 'rad', (0.01, 3.2))
    recovery_alpha_slow: float = parameter(
        0.005,
        'decay of the slow average of the likelihood, per update; 0: no random particles',
        bounds=(0.0, 1.0),
        source=NAMES,
    )
    recovery_alpha_fast: float = parameter(
        0.1,
        'decay of the fast average of the likelihood; where it falls below the slow one, random '
        'particles are added',
        bounds=(0.0, 1.0),
        source=NAMES,
    )
    seed: int = parameter(1, 'seed of the random numbers', bounds=(0, 2**53))

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` if numbers or decays do not ascend."""
        if self.max_particles < self.min_particles:
            raise ParameterError(
                f'max_particles must be at least min_particles, {self.min_particles}: '
                f'got {self.max_particles}'
            )
        if self.recovery_alpha_slow > 0.0 and self.recovery_alpha_fast <= self.recovery_alpha_slow:
            raise ParameterError(
                'recovery_alpha_fast must be above recovery_alpha_slow, '
                f'{self.recovery_alpha_slow:g}: got {self.recovery_alpha_fast:g}'
            )


class Estimate(NamedTuple):
    """Pose of the heaviest cluster of particles."""

    pose: Pose
    covariance: Array
    """Of x, y (m), yaw (rad) in the cluster, shape (3, 3)."""
    share: float
    """Share of all weight in it."""


class ParticleFilter:
    """Particles with weights; equal calls give equal particles, bit for bit.

    field : the map
    places : x, y (m) where the robot may be, shape (k, 2)
    model : of the range readings
    """

    def __init__(
        self,
        parameters: ParticleFilterParameters,
        field: DistanceField,
        places: Array,
        model: RangeModel,
    ) -> None:
        if len(places) == 0:
            raise ValueError('the map must have free floor for the robot')
        self.parameters = parameters
        self._field, self._places, self._model = field, places, model
        self._search_model = model._replace(sigma_hit=max(model.sigma_hit, SEARCH_SIGMA))
        self._generator = np.random.default_rng(parameters.seed)
        self._weigh = TypedKernel(weigh)
        self._move = TypedKernel(move)
        size = 1 << (2 * parameters.max_particles - 1).bit_length()
        self._table = np.empty(size, dtype=np.int64)
        self._last: Pose | None = None
        self.poses: Array = np.empty((0, 3))
        """x, y (m), yaw (rad), shape (n, 3)."""
        self.weights: Array = np.empty(0)
        """Their sum is 1, shape (n,)."""
        self.scatter()

    def place(self, pose: Pose, covariance: Array) -> None:
        """Begin at a pose with a covariance of x, y (m), yaw (rad), shape (3, 3)."""
        drawn = self._generator.multivariate_normal(
            pose, covariance, self.parameters.min_particles, method='eigh'
        )
        self._begin(drawn)
        self._last = pose

    def scatter(self) -> None:
        """Begin anywhere on the free floor."""
        self._begin(self._anywhere(self.parameters.max_particles))
        self._last = None

    def _begin(self, poses: Array) -> None:
        self.poses = np.ascontiguousarray(poses, dtype=np.float64)
        self.weights = np.full(len(poses), 1.0 / len(poses))
        self.slow = self.fast = 0.0
        """Averages of the likelihood of a reading; 0 before the first."""
        self._share = 0.0

    def _anywhere(self, count: int) -> Array:
        """Return random poses on the free floor, shape (count, 3)."""
        generator, half = self._generator, 0.5 * self._field.step
        chosen = self._places[generator.integers(0, len(self._places), count)]
        poses = np.empty((count, 3))
        poses[:, :2] = chosen + generator.uniform(-half, half, (count, 2))
        poses[:, 2] = generator.uniform(-math.pi, math.pi, count)
        return poses

    def predict(self, begin: Pose, end: Pose, elapsed: float = 0.0) -> None:
        """Move every particle as the odometry went in a time (s), with noise."""
        parameters = self.parameters
        noise = self._generator.standard_normal((len(self.poses), 3))
        motion = odometry_motion(begin, end)
        first, travel, second = motion
        turns = _least_turn(first) ** 2, _least_turn(second) ** 2
        deviations = (
            math.sqrt(parameters.alpha1 * turns[0] + parameters.alpha2 * travel**2),
            math.sqrt(parameters.alpha3 * travel**2 + parameters.alpha4 * sum(turns)),
            math.sqrt(
                parameters.alpha1 * turns[1]
                + parameters.alpha2 * travel**2
                + parameters.yaw_drift * elapsed
            ),
        )
        self._move(self.poses, noise, np.array([motion, deviations]))
        if self._last is not None:
            self._last = moved_pose(self._last, motion)

    def correct(self, beams: Beams, doubt: float = 0.0) -> None:
        """Weigh the particles by readings; resample, and add random ones, where needed.

        doubt : smallest share of random particles, 0 to 1
        """
        if beams.reading.size == 0:
            return
        known = self._share >= KNOWN_SHARE and doubt == 0.0
        model = self._model if known else self._search_model
        logarithms = np.empty(len(self.poses))
        self._weigh(self.poses, logarithms, self._field, beams, model)
        # A mean per reading, relative to one that fits: updates differ in number and distances.
        best = best_logarithm(beams, model)
        each = np.exp((logarithms - best) / beams.reading.size)
        self._average(float(self.weights @ each))
        weights = self.weights * np.exp(logarithms - logarithms.max())
        total = float(weights.sum())
        if not total > 0.0:  # the particles with weight are the ones that became impossible
            weights = np.exp(logarithms - logarithms.max())
            total = float(weights.sum())
        if not math.isfinite(total):  # a likelihood was no number
            self.scatter()
            return
        self.weights = weights / total
        lost = 0.0
        if self.parameters.recovery_alpha_slow > 0.0:
            lost = max(1.0 - TOLERATED_FALL * self.fast / self.slow, doubt, 0.0)
        effective = 1.0 / float(self.weights @ self.weights)
        if lost > 0.0 or effective < 0.5 * len(self.weights):
            self.resample(lost, beams)

    def _average(self, likelihood: float) -> None:
        parameters = self.parameters
        if self.slow == 0.0:
            self.slow = self.fast = likelihood
        self.slow += parameters.recovery_alpha_slow * (likelihood - self.slow)
        self.fast += parameters.recovery_alpha_fast * (likelihood - self.fast)

    def resample(self, lost: float, beams: Beams) -> None:
        """Draw particles by their weights, and a share ``lost`` by the readings alone."""
        parameters, generator = self.parameters, self._generator
        cumulative = np.cumsum(self.weights)
        cumulative /= cumulative[-1]
        drawn = np.searchsorted(cumulative, generator.random(parameters.max_particles))
        bins = self._bins(self.poses)[np.minimum(drawn, len(self.poses) - 1)]
        count = needed_particles(
            bins, self._table, parameters.pf_err, parameters.pf_z, parameters.min_particles
        )
        added = round(lost * count)
        kept = max(count - added, 1)
        comb = (np.arange(kept) + generator.random()) / kept
        rows = np.minimum(np.searchsorted(cumulative, comb), len(self.poses) - 1)
        parts = [self.poses[rows]]
        if added:
            parts.append(self._likely(added, beams))
        self.poses = np.concatenate(parts)
        self.weights = np.full(len(self.poses), 1.0 / len(self.poses))

    def _likely(self, count: int, beams: Beams) -> Array:
        """Return random poses drawn by the likelihood of readings, shape (count, 3).

        Half of them are near the last estimate, if there is one.
        """
        near = 0 if self._last is None else count // 2
        parts = [self._drawn(self._anywhere(CANDIDATES * (count - near)), count - near, beams)]
        if near:
            drawn = self._generator.standard_normal((CANDIDATES * near, 3))
            poses = np.array(self._last) + drawn * (NEAR_DISTANCE, NEAR_DISTANCE, NEAR_ANGLE)
            parts.append(self._drawn(poses, near, beams))
        return np.concatenate(parts)

    def _drawn(self, poses: Array, count: int, beams: Beams) -> Array:
        """Return some of poses, drawn by the likelihood of readings, shape (count, 3)."""
        logarithms = np.empty(len(poses))
        self._weigh(poses, logarithms, self._field, beams, self._search_model)
        cumulative = np.cumsum(np.exp(logarithms - logarithms.max()))
        comb = cumulative[-1] * (np.arange(count) + self._generator.random()) / count
        found: Array = poses[np.minimum(np.searchsorted(cumulative, comb), len(poses) - 1)]
        return found

    def _bins(self, poses: Array) -> NDArray[np.int64]:
        """Return the number of the bin of each pose, shape (n,), from 0 on."""
        parameters, field = self.parameters, self._field
        side, angle = parameters.spatial_resolution, parameters.angular_resolution
        column = np.floor((poses[:, 0] - field.x) / side).astype(np.int64) + 1024
        row = np.floor((poses[:, 1] - field.y) / side).astype(np.int64) + 1024
        turn = np.floor(np.remainder(poses[:, 2], math.tau) / angle).astype(np.int64)
        found: NDArray[np.int64] = (np.clip(column, 0, 2**20) << 36) + (
            np.clip(row, 0, 2**20) << 12
        )
        return found + turn

    def estimate(self) -> Estimate:
        """Return pose and covariance of the heaviest cluster.

        That of the last estimate, moved, is kept while it has half of its weight: two clusters
        of about the same weight do not alternate.
        """
        side, angle = CLUSTER_DISTANCE, CLUSTER_ANGLE
        keys = np.floor(self.poses / np.array([side, side, angle])).astype(np.int64)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        heavy = int(np.argmax(np.bincount(inverse.ravel(), self.weights)))
        found = self._cluster(Pose(*self.poses[first[heavy]].tolist()))
        if self._last is not None:
            same = self._cluster(self._last)
            if same.share >= KEPT_SHARE * found.share:
                found = same
        self._last, self._share = found.pose, found.share
        return found

    def _cluster(self, centre: Pose) -> Estimate:
        """Return the cluster around a centre, which moves to its mean."""
        pose, covariance, share = centre, np.zeros((3, 3)), 0.0
        for _ in range(CLUSTER_ROUNDS):
            gap = self._gaps(pose)
            near = np.hypot(gap[:, 0], gap[:, 1]) < CLUSTER_DISTANCE
            near &= np.abs(gap[:, 2]) < CLUSTER_ANGLE
            weights = self.weights[near]
            share = float(weights.sum())
            if share <= 0.0:
                return Estimate(pose, covariance, 0.0)
            part, weights = gap[near], weights / share
            mean = weights @ part
            covariance = (part - mean).T @ ((part - mean) * weights[:, None])
            pose = Pose(
                pose.x + float(mean[0]),
                pose.y + float(mean[1]),
                wrap_angle(pose.yaw + float(mean[2])),
            )
        return Estimate(pose, covariance, share)

    def spread(self, pose: Pose) -> Array:
        """Return the mean square distance of all particles from a pose, shape (3, 3)."""
        gap = self._gaps(pose)
        return gap.T @ (gap * self.weights[:, None])

    def _gaps(self, pose: Pose) -> Array:
        """Return the particles less a pose, yaw wrapped, shape (n, 3)."""
        gap: Array = self.poses - np.array(pose)
        gap[:, 2] = np.remainder(gap[:, 2] + math.pi, math.tau) - math.pi
        return gap


def odometry_motion(begin: Pose, end: Pose) -> tuple[float, float, float]:
    """Return turn (rad), travel (m) and turn that lead from one pose to another."""
    x, y = end.x - begin.x, end.y - begin.y
    travel = math.hypot(x, y)
    first = wrap_angle(math.atan2(y, x) - begin.yaw) if travel > SHORTEST else 0.0
    return first, travel, wrap_angle(end.yaw - begin.yaw - first)


def moved_pose(pose: Pose, motion: tuple[float, float, float]) -> Pose:
    """Return a pose after turn (rad), travel (m) and turn."""
    first, travel, second = motion
    yaw = pose.yaw + first
    return Pose(
        pose.x + travel * math.cos(yaw), pose.y + travel * math.sin(yaw), wrap_angle(yaw + second)
    )


def _least_turn(turn: float) -> float:
    """Return the size of a turn, up to half a turn less: backwards is no turn."""
    return min(abs(turn), math.pi - abs(turn))


@kernel
def move(poses: Array, noise: Array, motion: Array) -> None:
    """Turn, drive and turn each pose.

    poses : x, y (m), yaw (rad), shape (n, 3), changed in place
    noise : standard normal numbers, shape (n, 3)
    motion : turn (rad), travel (m), turn; and their standard deviations, shape (2, 3)
    """
    for k in range(poses.shape[0]):
        yaw = poses[k, 2] + motion[0, 0] + motion[1, 0] * noise[k, 0]
        travel = motion[0, 1] + motion[1, 1] * noise[k, 1]
        poses[k, 0] += travel * math.cos(yaw)
        poses[k, 1] += travel * math.sin(yaw)
        yaw += motion[0, 2] + motion[1, 2] * noise[k, 2]
        poses[k, 2] = yaw - math.tau * math.floor(yaw / math.tau + 0.5)


@kernel
def needed_particles(
    bins: NDArray[np.int64], table: NDArray[np.int64], error: float, quantile: float, least: int
) -> int:
    """Return how many of drawn particles are enough, by the number of bins that they are in.

    bins : bin of each drawn particle, from 0 on; its size is the largest number
    table : a power of two of numbers, more than there are bins; overwritten
    error, quantile : bound of the Kullback-Leibler distance, and quantile with which it holds
    """
    mask = table.size - 1
    table[:] = -1
    occupied = 0
    needed = float(least)
    for k in range(bins.size):
        if k >= needed and k >= least:
            return k
        slot = (bins[k] * 0x9E3779B1 >> 7) & mask
        while table[slot] not in (-1, bins[k]):
            slot = (slot + 1) & mask
        if table[slot] == -1:
            table[slot] = bins[k]
            occupied += 1
            if occupied > 1:
                share = 2.0 / (9.0 * (occupied - 1))
                root = 1.0 - share + math.sqrt(share) * quantile
                needed = (occupied - 1) / (2.0 * error) * root**3
    return bins.size
