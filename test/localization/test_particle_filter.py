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
"""Particle filter: motion, number of particles, resampling, and the beam model, by their laws."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose
from t3mpc_ros.localization.distance_field import map_of_world
from t3mpc_ros.localization.particle_filter import (
    ParticleFilter,
    ParticleFilterParameters,
    moved_pose,
    needed_particles,
    odometry_motion,
)
from t3mpc_ros.localization.range_model import (
    Beams,
    RangeModel,
    RangeModelParameters,
    beams_of_scan,
    hit_likelihood,
    other_likelihood,
)
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.simulation.world import load_world

SEEN = map_of_world(load_world('room'))
MODEL = RangeModel.of(RangeModelParameters(), 0.1)


LARGE = {'min_particles': 20000, 'max_particles': 20000}


def make_filter(**values):
    parameters = ParticleFilterParameters.from_dict(values)
    return ParticleFilter(parameters, SEEN.field, SEEN.free_places(0.1), MODEL)


@pytest.mark.parametrize(('linear', 'angular'), [(0.3, 1.0), (-0.3, -0.2), (0.0, 1.0), (0.3, 0.0)])
def test_motion_of_the_odometry_leads_from_pose_to_pose(linear, angular):
    begin = Pose(0.3, -0.2, 2.9)
    end = advance_pose(begin, BodyTwist(linear, angular), 0.5)
    assert moved_pose(begin, odometry_motion(begin, end)) == pytest.approx(end)


def test_the_cloud_moves_and_spreads_as_the_alphas_say():
    found = make_filter(alpha1=0.0, alpha2=0.04, alpha3=0.01, alpha4=0.0, **LARGE)
    found.place(ORIGIN, np.zeros((3, 3)))
    found.predict(
        Pose(5.0, 5.0, 0.5), Pose(5.0 + 0.5 * math.cos(0.5), 5.0 + 0.5 * math.sin(0.5), 0.5)
    )
    along, across, turned = found.poses.T
    assert along.mean() == pytest.approx(0.5 * math.exp(-0.5 * 0.01), abs=2e-3)
    assert along.std() == pytest.approx(0.1 * 0.5, rel=0.05)
    assert across.std() == pytest.approx(0.2 * 0.5 * 0.5, rel=0.05)
    assert turned.std() == pytest.approx(math.sqrt(2.0) * 0.2 * 0.5, rel=0.05)


def test_driving_backwards_is_no_turn():
    found = make_filter(alpha1=1.0, alpha2=0.0, alpha3=0.0, alpha4=0.0)
    found.place(ORIGIN, np.zeros((3, 3)))
    found.predict(ORIGIN, Pose(-0.2, 0.0, 0.0))
    assert found.poses == pytest.approx(np.tile([-0.2, 0.0, 0.0], (500, 1)), abs=1e-9)


@pytest.mark.parametrize('occupied', [1, 2, 100])
def test_the_number_of_particles_is_that_of_the_bound(occupied):
    """Fox (2003), equation (7), with the bins that the drawn particles are in."""
    bins = np.arange(20000) % occupied
    table = np.empty(65536, dtype=np.int64)
    count = needed_particles(bins.astype(np.int64) << 36, table, 0.05, 2.33, 50)
    share = 2.0 / (9.0 * max(occupied - 1, 1))
    bound = (occupied - 1) / 0.1 * (1.0 - share + math.sqrt(share) * 2.33) ** 3
    assert count == max(50, math.ceil(bound))
    everywhere = np.arange(3000, dtype=np.int64)
    assert needed_particles(everywhere, table, 0.05, 0.99, 10) == 3000


def test_resampling_keeps_the_mean_and_shrinks_the_number():
    found = make_filter(recovery_alpha_slow=0.0)
    assert len(found.poses) == 5000
    near = Beams(np.array([[0.0, 0.0, 0.0]]), np.array([0.5]), np.array([[0.1, 0.8]]))
    place = Pose(1.4, -0.2, 0.0)
    found.place(place, np.diag([0.01, 0.01, 0.01]))
    for _ in range(3):
        found.correct(near)
    assert len(found.poses) == 500
    assert found.weights.sum() == pytest.approx(1.0)
    # The wall at x = 2 - 0.1 is 0.5 m ahead.
    x = (found.weights @ found.poses)[0]
    assert x == pytest.approx(1.5, abs=0.03)


def test_without_a_likelihood_particles_are_scattered():
    found = make_filter()
    found.place(ORIGIN, np.zeros((3, 3)))
    found.correct(Beams(np.zeros((1, 3)), np.array([math.inf]), np.full((1, 2), math.nan)))
    assert len(found.poses) == 5000
    assert found.weights.sum() == pytest.approx(1.0)
    assert np.isfinite(found.poses).all()


def test_the_estimate_is_the_heaviest_cluster_and_not_the_mean():
    found = make_filter()
    left, right = np.tile([-1.0, 0.0, 3.1], (40, 1)), np.tile([1.0, 0.5, 0.0], (60, 1))
    left[::2, 2] = -3.1  # the mean yaw of both is half a turn
    found.poses = np.concatenate([left, right])
    found.weights = np.full(100, 0.01)
    estimate = found.estimate()
    assert estimate.pose == pytest.approx(Pose(1.0, 0.5, 0.0))
    assert estimate.share == pytest.approx(0.6)
    found.weights = np.concatenate([np.full(40, 0.6 / 40), np.full(60, 0.4 / 60)])
    assert found.estimate().pose.x == pytest.approx(1.0)  # kept: more than half of the other's
    found.weights = np.concatenate([np.full(40, 0.9 / 40), np.full(60, 0.1 / 60)])
    assert found.estimate().pose.x == pytest.approx(-1.0)
    assert abs(found.estimate().pose.yaw) == pytest.approx(math.pi)


@pytest.mark.parametrize('expected', [0.05, 0.75, math.inf])
def test_the_readings_at_a_place_have_probability_one(expected):
    """Density within the limits, and what is beyond them on either side."""
    least, most = 0.1, 0.8
    grid = np.linspace(least, most, 4001)[1:-1]
    hit = [hit_likelihood(z, expected, least, most, MODEL) for z in grid]
    beyond = hit_likelihood(math.inf, expected, least, most, MODEL)
    near = hit_likelihood(-math.inf, expected, least, most, MODEL)
    total = float(np.sum(hit)) * (grid[1] - grid[0]) + beyond + near
    assert total == pytest.approx(1.0, abs=2e-3)


def test_something_in_front_of_the_map_is_likelier_than_behind():
    short = other_likelihood(0.3, 0.6, 0.1, 0.8, MODEL)
    long = other_likelihood(0.7, 0.6, 0.1, 0.8, MODEL)
    assert short > long > 0.0


@pytest.mark.parametrize(
    ('table', 'change', 'reason'),
    [
        (ParticleFilterParameters, {'max_particles': 100}, 'max_particles must be at least'),
        (ParticleFilterParameters, {'recovery_alpha_fast': 0.001}, 'alpha_fast must be above'),
        (RangeModelParameters, {'z_rand': 0.5}, 'sum to at most 1'),
    ],
)
def test_parameters_that_contradict_are_rejected(table, change, reason):
    with pytest.raises(ParameterError, match=reason):
        table.from_dict(change)


def test_beams_of_a_scan_are_evenly_spaced_without_nan():
    reading = np.array([0.1, math.nan, 0.3, 0.4, math.inf])
    beams = beams_of_scan(reading, -1.0, 0.5, (0.05, 3.0), 5)
    assert beams.origin[:, 2] == pytest.approx([-1.0, 0.0, 0.5, 1.0])
    assert beams.reading.tolist() == [0.1, 0.3, 0.4, math.inf]
    assert beams.limits.tolist() == [[0.05, 3.0]] * 4
    assert beams_of_scan(reading, -1.0, 0.5, (0.05, 3.0), 3).origin[:, 2].tolist() == [-1.0, 0, 1]
    assert beams_of_scan(reading[:1], 0.0, 0.0, (0.05, 3.0), 60).reading.tolist() == [0.1]
    assert beams_of_scan(reading[:0], 0.0, 0.0, (0.05, 3.0), 60).reading.tolist() == []


@pytest.mark.parametrize(
    ('first', 'increment', 'limits', 'reason'),
    [
        (math.nan, 0.1, (0.1, 3.0), 'angle_min must be finite: got nan'),
        (0.0, 0.0, (0.1, 3.0), 'angle_increment must be finite and not 0: got 0'),
        (0.0, 0.1, (math.nan, 3.0), 'range_min .* must be finite and at least 0 m: got nan'),
        (0.0, 0.1, (0.1, math.inf), 'range_max .* must be finite and above 0.1 m: got inf'),
        (0.0, 0.1, (0.1, 0.1), 'range_max .* must be finite and above 0.1 m: got 0.1'),
    ],
)
def test_a_scan_that_is_impossible_is_rejected(first, increment, limits, reason):
    with pytest.raises(ValueError, match=reason):
        beams_of_scan(np.array([0.5, 0.6]), first, increment, limits, 60)
