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
"""Chaotic path: in the arena, evenly spread, without jumps, and a function of its seed alone."""

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.chaos.chaotic_path import PortraitParameters, PortraitPath
from t3mpc_ros.chaos.pose_reference import PathReferenceParameters, PortraitSource
from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import ORIGIN

pytestmark = pytest.mark.compiled

SQUARE = (-1.75, -1.25, 1.75, 1.25)
TRIANGLE = (0.0, 0.0, 3.0, 0.0, 1.0, 2.0)


def _points(seed, length=60.0, **values):
    path = PortraitPath(
        ReferenceParameters(), PortraitParameters.from_dict(values), speed=0.25, seed=seed
    )
    return path, np.vstack([path.advance(5.0) for _ in range(round(length / 5.0))])


@pytest.mark.parametrize(
    'arena, blend', few_of([(SQUARE, 0.0), (TRIANGLE, 2.0), (SQUARE, 2.0), (TRIANGLE, 0.0)], 2)
)
@pytest.mark.slow
def test_path_is_continuous_within_the_arena(arena, blend):
    path, points = _points(3, 30.0, **{'arena': arena, 'switching.blend': blend})
    assert path.arena.contains(points, 1e-6).all()
    assert np.hypot(*np.diff(points, axis=0).T).max() < 0.0101


@pytest.mark.slow
def test_path_spreads_evenly():
    """Each quarter of each coordinate gets 15 to 35 % of a long path."""
    _, points = _points(4, 250.0)
    for column, size in zip(points.T, (3.5, 2.5), strict=True):
        shares, _ = np.histogram(column, 4, (-0.5 * size, 0.5 * size))
        assert (np.abs(shares / len(points) - 0.25) < 0.10).all()


@pytest.mark.slow
def test_equal_seeds_give_equal_paths_others_do_not():
    one, again, other = (_points(seed, 5.0)[1] for seed in (2**100 + 1, 2**100 + 1, 2**100 + 2))
    assert np.array_equal(one[: len(again)], again)
    count = min(len(one), len(other))
    assert np.abs(one[:count] - other[:count]).max() > 0.5


def test_reseed_continues_without_a_jump():
    """A patrol changes its seed on the way: the path goes on from where it is."""
    path, before = _points(5, 5.0)
    path.reseed(6)
    after = np.vstack([before[-1:], path.advance(5.0)])
    assert np.hypot(*np.diff(after, axis=0).T).max() < 0.0101


def test_a_robot_that_is_held_up_does_not_change_the_path():
    """The next seed comes at a place of the path: the time until it waits with the path."""
    values = {'reseed.shortest': 3.0, 'reseed.longest': 3.0}
    places = []
    for wait in (0, 1000):
        seeds = []
        source = PortraitSource(
            PathReferenceParameters.from_dict(values),
            WheelGeometry(),
            ORIGIN,
            1,
            lambda seeds=seeds: seeds.append(2) or 2,
        )
        for rate, count in ((1.0, 200), (0.0, wait)):
            for _ in range(count):
                source.advance(rate)
        assert not seeds
        while not seeds:
            pose, _ = source.advance()
        places.append((pose.x, pose.y))
    assert places[1] == pytest.approx(places[0], abs=0.01)
