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
r"""Pose tracking: an extended Kalman filter beside the particles, as long as it is consistent.

Some hundreds of particles find a place and notice that it is another one, but they need more noise
than the odometry has, and follow the offsets of the sensors. From their estimate on, the pose is
tracked by the readings within the range of their sensors (Thrun, Burgard and Fox, Probabilistic
Robotics, 2005, section 3.3). The state is x, y, yaw, the drift of the odometry's yaw, by how much
of itself its travel is too short, and an offset b of each sensor, which reads :math:`d + b\,d^2`
at the distance d, as a triangulating one does by an offset of its voltage. The noise of the
readings, in standard deviations of the beam model, is followed by the median of the innovations.

Tracking begins anew at the estimate of the particles where that explains the readings better, by a
cumulative sum of log-likelihood ratios (Page, Biometrika 41, 1954, doi 10.1093/biomet/41.1-2.100),
or where half of the innovations are outliers.
"""

import math

import numpy as np

from t3mpc_ros.geometry.types import Array, Pose, wrap_angle
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.localization.distance_field import DistanceField, trace_ray
from t3mpc_ros.localization.particle_filter import SEARCH_SIGMA
from t3mpc_ros.localization.range_model import BEYOND, Beams, RangeModel, weigh

POSE, DRIFT, SCALE, OFFSETS = slice(0, 3), 3, 4, 6
"""Where they are in the state; a scan has the number -1 among the offsets."""
TRAVEL_VARIANCE, YAW_VARIANCE, TURN_VARIANCE = 4e-5, 1.6e-5, 4e-6
"""Growth of the variances of x and y (m²/m) and of the yaw (rad²/m, rad²/rad): at least four times
those of the twin, for robots that are less exact; with a quarter its errors are about the same."""
DRIFT_DEVIATION, SCALE_DEVIATION = 0.002, 0.02
"""Standard deviations of drift (rad/s) and scale at the start; those of the offsets are the growth
of the noise in the beam model."""
DRIFT_TIME, CHANGE_TIME = 100.0, 1e4
"""Times in which the drift, and the others, change by their deviations at the start, s."""
NOISE_GAIN, LARGEST_NOISE, MEDIAN_SQUARE = 0.01, 3.0, 0.455
"""Change of the noise's logarithm by a reading, largest noise, which is that at the start, and
median of a squared normal variable."""
REPEATS = 6.0
"""Number of readings that tell as much as one: as many of a sensor come between two updates, with
the same errors of the map. With 1 the error was twice as large on one patrol of nine."""
OUTLIER, OUTLIER_DECAY = 6.0, 0.02
"""Square of an innovation, in variances, from which on a reading is of something else; decay of
the share of such readings, per reading."""
SLIPPED, SLIP_VARIANCE, INCONSISTENT = 0.2, 4e-4, 0.5
"""Share of outliers from which on the robot may have slipped, growth of the variances (m², rad²)
per update meanwhile, and share from which on tracking ends: two of eight sensors see a person."""
LIKELIER, MEMORY = 15.0, 3.0
"""Logarithm of the ratio of likelihoods with which the estimate of the particles is taken, and
time constant with which the ratio is forgotten, s: never on 18 patrols on which nobody is lost."""
STEP, STEEPEST = 2e-3, 3.0
"""Difference by which a ray is differentiated (m, rad), and derivative from which on it passes an
edge."""


class PoseTracker:
    """Pose with its covariance from odometry and readings; equal calls give equal poses.

    model : of the readings; sensors : number of range sensors
    """

    def __init__(self, field: DistanceField, model: RangeModel, sensors: int) -> None:
        self._field, self._model = field, model
        self._coarse = model._replace(sigma_hit=max(model.sigma_hit, SEARCH_SIGMA))
        self._correct, self._weigh = TypedKernel(correct), TypedKernel(weigh)
        self._start = np.full(OFFSETS + sensors, model.sigma_hit_growth**2)
        self._start[[DRIFT, SCALE]] = DRIFT_DEVIATION**2, SCALE_DEVIATION**2
        self._growth = self._start / CHANGE_TIME
        self._growth[DRIFT] = self._start[DRIFT] / DRIFT_TIME
        self._state, self._covariance = np.zeros(self._start.size), np.diag(self._start)
        self._spread, self._work = np.empty(2), np.empty((2, self._start.size))
        self._likelier = 0.0  # logarithm of the ratio, from 0 on
        self.active = False  # whether it has a pose

    def begin(self, pose: Pose, covariance: Array) -> None:
        """Begin at a pose with a covariance of x, y (m), yaw (rad), shape (3, 3)."""
        self._state[:] = 0.0
        self._state[POSE] = pose
        self._covariance[:] = np.diag(self._start)
        self._covariance[POSE, POSE] = covariance
        self._spread[:] = 0.0, LARGEST_NOISE
        self._likelier, self.active = 0.0, True

    @property
    def pose(self) -> Pose:
        """The pose."""
        x, y, yaw = self._state[POSE].tolist()
        return Pose(x, y, wrap_angle(yaw))

    @property
    def covariance(self) -> Array:
        """Covariance of x, y (m), yaw (rad), shape (3, 3)."""
        return self._covariance[POSE, POSE].copy()

    def predict(self, last: Pose, new: Pose, elapsed: float) -> None:
        """Move as the odometry went from one pose to another in a time (s)."""
        yaw, turn = self._state[2] - last.yaw, wrap_angle(new.yaw - last.yaw)
        ahead, left = new.x - last.x, new.y - last.y
        x = math.cos(yaw) * ahead - math.sin(yaw) * left
        y = math.sin(yaw) * ahead + math.cos(yaw) * left
        scale, travel = 1.0 + self._state[SCALE], math.hypot(x, y)
        self._state[POSE] += scale * x, scale * y, turn + elapsed * self._state[DRIFT]
        jacobian = np.eye(self._state.size)
        jacobian[:2, [2, SCALE]] = [[-scale * y, x], [scale * x, y]]
        jacobian[2, DRIFT] = elapsed
        growth = elapsed * self._growth
        growth[:2] = TRAVEL_VARIANCE * travel
        growth[2] = YAW_VARIANCE * travel + TURN_VARIANCE * abs(turn)
        self._covariance[:] = jacobian @ self._covariance @ jacobian.T + np.diag(growth)

    def correct(self, beams: Beams, sensor: int) -> None:
        """Correct the pose by the beams of a sensor, -1: a scan."""
        own = self._state, self._covariance, self._spread, self._work
        self._correct(*own, self._field, beams, OFFSETS + sensor, self._model)

    def compare(self, pose: Pose, beams: Beams, elapsed: float) -> None:
        """End if another pose explains the readings of some time better, or none are explained."""
        found = np.empty(2)
        self._weigh(np.array([pose, self.pose]), found, self._field, beams, self._coarse)
        self._likelier *= math.exp(-elapsed / MEMORY)
        self._likelier = max(0.0, self._likelier + float(found[0] - found[1]))
        if self._spread[0] > SLIPPED:
            self._covariance[POSE, POSE] += SLIP_VARIANCE * np.eye(3)
        self.active &= self._likelier < LIKELIER and bool(self._spread[0] < INCONSISTENT)


@kernel
def correct(
    state: Array,
    covariance: Array,
    spread: Array,
    work: Array,
    field: DistanceField,
    beams: Beams,
    offset: int,
    model: RangeModel,
) -> None:
    """Correct a state, shape (n,), by the readings of a sensor within its range.

    covariance : of the state, shape (n, n)
    spread : share of outliers, and noise; work : overwritten, shape (2, n)
    offset : where that of the sensor is in the state
    """
    row, gain = work[0], work[1]
    for i in range(beams.reading.size):
        least, most = beams.limits[i, 0], beams.limits[i, 1]
        expected = traced(state, field, beams, i)
        square = expected * expected
        predicted = expected + state[offset] * square
        noise = spread[1] * math.hypot(model.sigma_hit, model.sigma_hit_growth * square)
        # Nearer to a limit only the readings of one side are within the range.
        if not least + noise < predicted < most - noise:
            continue
        innovation = min(max(beams.reading[i], least), most) - predicted
        within = least < beams.reading[i] < most
        row[:] = steepest = 0.0
        for j in range(3):
            before = state[j]
            state[j] = before + STEP
            row[j] = (traced(state, field, beams, i) - expected) / STEP
            state[j] = before
            steepest = max(steepest, abs(row[j]))
        if not steepest < STEEPEST:
            continue
        row[offset] = square
        variance = 0.0
        for j in range(state.size):
            gain[j] = 0.0
            for k in range(state.size):
                gain[j] += covariance[j, k] * row[k]
            variance += row[j] * gain[j]
        deviation = innovation * innovation / (variance + noise * noise)
        outlier = deviation > OUTLIER
        if within or outlier:
            spread[0] += OUTLIER_DECAY * (outlier - spread[0])
        if not within:
            continue
        change = NOISE_GAIN if deviation > MEDIAN_SQUARE else -NOISE_GAIN
        spread[1] = min(max(spread[1] * math.exp(0.5 * change), 1.0), LARGEST_NOISE)
        if not outlier:
            variance += REPEATS * noise * noise
            for j in range(state.size):
                state[j] += gain[j] * innovation / variance
                for k in range(state.size):
                    covariance[j, k] -= gain[j] * gain[k] / variance


@kernel
def traced(state: Array, field: DistanceField, beams: Beams, i: int) -> float:
    """Return the distance (m) along a beam, inf: nothing within the range."""
    cosine, sine = math.cos(state[2]), math.sin(state[2])
    ahead, left, direction = beams.origin[i, 0], beams.origin[i, 1], beams.origin[i, 2]
    x, y = state[0] + cosine * ahead - sine * left, state[1] + sine * ahead + cosine * left
    return trace_ray(field, x, y, state[2] + direction, BEYOND * beams.limits[i, 1])
