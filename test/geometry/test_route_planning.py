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
"""Routes on a grid: distances against brute force, times against geometry, and what is no way."""

import math

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.geometry.obstacles import OccupancyGrid
from t3mpc_ros.geometry.route_planning import (
    NEAR_COST,
    UNSEEN_COST,
    RoutePlanner,
    nearest_distances,
)

DISTANCE = 0.2
SIZE = 0.02
"""Side of a cell, m."""


def planner_of(cells):
    """Return a planner on cells around the origin."""
    planner = RoutePlanner(DISTANCE)
    rows, columns = cells.shape
    planner.update(OccupancyGrid(cells, SIZE, -0.5 * SIZE * columns, -0.5 * SIZE * rows))
    return planner


def floor(width=4.0, height=3.0):
    return np.zeros((round(height / SIZE), round(width / SIZE)), dtype=np.int8)


def box(cells, x, y, half_x, half_y, state=100):
    """Write a state into the cells of a rectangle, m."""
    rows, columns = cells.shape
    row, column = round(y / SIZE) + rows // 2, round(x / SIZE) + columns // 2
    up, along = round(half_y / SIZE), round(half_x / SIZE)
    cells[max(row - up, 0) : row + up, max(column - along, 0) : column + along] = state
    return cells


def length(points):
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def test_distances_are_those_to_the_nearest_marked_cell():
    generator = np.random.default_rng(2)
    for rows, columns in ((7, 12), (12, 7), (1, 9)):
        marked = generator.random((rows, columns)) < 0.15
        marked[0, 0] = True
        at = np.argwhere(marked)
        places = np.indices((rows, columns)).reshape(2, -1).T
        wanted = np.hypot(*(places[:, None, :] - at).transpose(2, 0, 1)).min(axis=1)
        assert nearest_distances(marked).ravel() == pytest.approx(wanted)
    assert np.isinf(nearest_distances(np.zeros((3, 4), dtype=np.bool_))).all()


def test_time_on_free_floor_is_the_distance():
    planner = planner_of(floor())
    planner.spread((-1.0, 0.3))
    generator = np.random.default_rng(3)
    # Not at the edge, beyond which floor is unknown.
    points = generator.uniform([-1.7, -1.2], [1.7, 1.2], (200, 2))
    distance = np.hypot(*(points - [-1.0, 0.3]).T)
    away = distance > 0.5
    assert planner.arrival(points)[away] == pytest.approx(distance[away], rel=0.03, abs=0.06)


@pytest.mark.parametrize('goal', [(1.5, 0.9), (0.3, 1.1)])
def test_a_route_on_free_floor_is_straight(goal):
    planner = planner_of(floor())
    planner.spread((-1.3, 0.2))
    route = planner.route(goal, (-1.3, 0.2))
    straight = math.dist(goal, (-1.3, 0.2))
    assert route[-1] == pytest.approx(goal)
    assert length(np.vstack([(-1.3, 0.2), route])) < 1.01 * straight
    spans = np.hypot(*np.diff(route, axis=0).T)
    assert spans.min() > 0.009
    assert spans.max() < 0.011


def test_a_route_leads_around_a_box_at_its_distance():
    planner = planner_of(box(floor(), 0.0, -0.3, 0.1, 1.2))
    planner.spread((-1.0, -0.8))
    route = planner.route((1.0, -0.8), (-1.0, -0.8))
    assert planner.wall_distance(route).min() >= DISTANCE - SIZE
    assert route[:, 1].max() > 0.9 + DISTANCE - SIZE
    # Around both corners, on circles; obstacles cost up to a tenth of a metre more.
    corner, bounds = math.hypot(0.9, 1.7), []
    for away in (DISTANCE - 2.0 * SIZE, DISTANCE + 0.1):
        turn = math.atan2(1.7, 0.9) + math.asin(away / corner)
        bounds.append(2.0 * (math.sqrt(corner**2 - away**2) + away * turn) + 0.2)
    assert bounds[0] - 0.05 < length(route) < bounds[1] + 0.05
    times = planner.arrival(route[5:])
    assert (np.diff(times) > -2.0 * SIZE * (1.0 + NEAR_COST)).all()


def test_what_is_walled_in_has_no_route():
    cells = box(box(floor(), 1.0, 0.0, 0.5, 0.5), 1.0, 0.0, 0.45, 0.45, state=0)
    planner = planner_of(cells)
    planner.spread((-1.0, 0.0))
    assert planner.route((1.0, 0.0), (-1.0, 0.0)) is None
    assert math.isinf(planner.arrival(np.array([[1.0, 0.0], [9.0, 0.0]])).min())
    assert (np.hypot(*(planner.reached_places() - [1.0, 0.0]).T) > 0.5).all()


def test_a_gap_that_is_too_narrow_is_no_way():
    for gap, passes in ((2.0 * DISTANCE - 0.1, False), (2.0 * DISTANCE + 0.1, True)):
        cells = box(box(floor(), 0.0, 0.0, 0.04, 1.6), 0.0, 0.0, 0.04, 0.5 * gap, state=0)
        planner = planner_of(cells)
        planner.spread((-1.0, 0.0))
        assert (planner.route((1.0, 0.0), (-1.0, 0.0)) is not None) is passes


def test_a_robot_too_near_to_an_obstacle_finds_a_way_from_it():
    """The map has noise: what the robot passes now and then comes nearer than a route may."""
    planner = planner_of(box(floor(), 0.0, 0.5, 2.0, 0.1))
    begin = (0.0, 0.4 - DISTANCE + 0.05)
    assert planner.wall_distance(np.array([begin]))[0] < DISTANCE
    planner.spread(begin)
    route = planner.route((1.0, -0.8), begin)
    assert (planner.wall_distance(route) >= DISTANCE - 0.07).all()
    assert (planner.wall_distance(route)[30:] >= DISTANCE - SIZE).all()
    assert planner.route((0.0, 1.0), begin) is None


@pytest.mark.parametrize('seed', few_of([1, 2, 3]))
def test_what_is_reached_has_a_route_whatever_floor_costs(seed):
    """Around the begin, cheap places beyond dear ones were hollows out of which no way led."""
    generator = np.random.default_rng(seed)
    planner = planner_of(box(floor(2.0, 2.0), 0.3, 0.2, 0.1, 0.3))
    for _ in range(5):
        begin = tuple(generator.uniform(-0.7, -0.1, 2).tolist())
        planner.spread(begin, lambda nodes: 3.0 * generator.integers(0, 2, len(nodes)))
        places = planner.reached_places()
        for place in places[generator.permutation(len(places))[:20]].tolist():
            assert planner.route(tuple(place), begin) is not None


def test_seen_floor_is_preferred_to_unseen():
    cells = box(floor(), 0.0, 0.2, 0.3, 0.6, state=-1)
    planner = planner_of(cells)
    planner.spread((-0.8, 0.0))
    times = planner.arrival(np.array([[0.8, 0.0]]))[0]
    assert 1.6 < times <= 1.6 + UNSEEN_COST * (0.6 + 2.0 * DISTANCE + 4 * SIZE)
    assert planner.unsafe_distance(np.array([[0.0, 0.0], [0.6, 0.2], [5.0, 0.0]])) == (
        pytest.approx([0.0, 0.3, 0.0], abs=SIZE)
    )


def test_without_a_map_nothing_is_safe_and_nothing_is_known():
    planner = RoutePlanner(DISTANCE)
    place = np.array([[0.0, 0.0]])
    assert planner.unsafe_distance(place) == 0.0
    assert planner.wall_distance(place) > 100.0
    assert planner.route((1.0, 0.0), (0.0, 0.0)) is None
