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
"""Ray casting and clearance, against independent geometry."""

import math

import numpy as np
import pytest

from t3mpc_ros.simulation.world import cast_ray, cast_rays, clearance, grip_at, parse_world

NO_SEGMENTS, NO_CIRCLES = np.zeros((0, 4)), np.zeros((0, 3))
SQUARE = np.array([[-1.0, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]])


def random_walls(generator, segments=12, circles=4):
    return (
        generator.uniform(-3.0, 3.0, (segments, 4)),
        np.column_stack(
            [generator.uniform(-3.0, 3.0, (circles, 2)), generator.uniform(0.05, 0.8, circles)]
        ),
    )


def moved(points, angle, shift):
    """Return points (n, 2) rotated about the origin, then shifted."""
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return points @ turn.T + shift


def algebraic_distance(x, y, direction, segments, circles):
    """Return the nearest hit by solving for each wall: linear equations, and a polynomial."""
    origin, ray = np.array([x, y]), np.array([math.cos(direction), math.sin(direction)])
    hits = [math.inf]
    for wall in segments:
        start, run = wall[:2], wall[2:] - wall[:2]
        along, share = np.linalg.solve(np.column_stack([ray, -run]), start - origin)
        if along >= 0.0 and 0.0 <= share <= 1.0:
            hits.append(along)
    for *centre, radius in circles:
        off = origin - centre
        for root in np.roots([1.0, 2.0 * off @ ray, off @ off - radius**2]):
            if abs(root.imag) < 1e-12 and root.real >= 0.0:
                hits.append(root.real)
    return min(hits)


@pytest.mark.slow
def test_ray_length_matches_an_algebraic_solution():
    generator = np.random.default_rng(1)
    seen = 0
    for _ in range(8):
        segments, circles = random_walls(generator)
        for x, y, direction in generator.uniform((-4, -4, -7), (4, 4, 7), (25, 3)).tolist():
            expected = algebraic_distance(x, y, direction, segments, circles)
            assert cast_ray(x, y, direction, segments, circles) == pytest.approx(
                expected, abs=1e-9
            )
            seen += math.isfinite(expected)
    assert 60 < seen < 200  # hits and misses


def test_clearance_matches_a_dense_sampling_of_the_walls():
    generator = np.random.default_rng(2)
    shares = np.linspace(0.0, 1.0, 4001)[:, None]
    angles = np.linspace(0.0, math.tau, 4001)
    for _ in range(20):
        segments, circles = random_walls(generator, 5, 2)
        x, y = generator.uniform(-4.0, 4.0, 2).tolist()
        samples = [start + shares * (end - start) for start, end in segments.reshape(-1, 2, 2)]
        for centre_x, centre_y, radius in circles:
            ring = np.column_stack([np.cos(angles), np.sin(angles)])
            samples.append((centre_x, centre_y) + radius * ring)
        nearest = min(float(np.hypot(*(points - (x, y)).T).min()) for points in samples)
        assert clearance(x, y, segments, circles) <= nearest + 1e-12
        assert clearance(x, y, segments, circles) == pytest.approx(nearest, abs=2e-3)


@pytest.mark.parametrize('yaw', [0.0, 0.3])
def test_no_ray_leaks_through_closed_walls(yaw):
    generator = np.random.default_rng(6)
    room = moved(SQUARE.reshape(-1, 2), yaw, (0.3, -0.7)).reshape(-1, 4)
    for _ in range(2):
        x, y = moved(generator.uniform(-0.99, 0.99, (1, 2)), yaw, (0.3, -0.7))[0].tolist()
        for direction in generator.uniform(-math.pi, math.pi, 500).tolist():
            assert cast_ray(x, y, direction, room, NO_CIRCLES) < 2.9
        # Towards the corners, where rounding decides the side of the ray.
        for corner_x, corner_y in room[:, :2].tolist():
            aim = math.atan2(corner_y - y, corner_x - x)
            apart = math.hypot(corner_x - x, corner_y - y)
            for turn in [0.0, *(generator.normal(0.0, 1e-16, 200))]:
                ray = cast_ray(x, y, aim + float(turn), room, NO_CIRCLES)
                assert ray == pytest.approx(apart, abs=1e-7)
    # From outside the near face occludes the far one.
    for _ in range(1000):
        angle, aim = generator.uniform(-math.pi, math.pi, 2).tolist()
        x, y = 0.3 + 3.0 * math.cos(angle), -0.7 + 3.0 * math.sin(angle)
        # Towards a disc inside the box.
        target_x, target_y = 0.3 + 0.9 * math.cos(aim), -0.7 + 0.9 * math.sin(aim)
        direction = math.atan2(target_y - y, target_x - x)
        ray = cast_ray(x, y, direction, room, NO_CIRCLES)
        assert ray < math.hypot(target_x - x, target_y - y)


def test_ray_along_a_wall_hits_its_end():
    wall = np.array([[1.0, 0.5, 3.0, 0.5]])
    assert cast_ray(0.0, 0.5, 0.0, wall, NO_CIRCLES) == 1.0
    assert cast_ray(2.0, 0.5, 0.0, wall, NO_CIRCLES) == 0.0
    assert cast_ray(4.0, 0.5, 0.0, wall, NO_CIRCLES) == math.inf
    assert cast_ray(0.0, 0.4999, 0.0, wall, NO_CIRCLES) == math.inf
    assert cast_ray(0.0, 0.4999, 0.0, SQUARE, NO_CIRCLES) == 1.0
    nearly = np.array([[1.0, -1e-9, 3.0, 1e-9]])
    assert cast_ray(0.0, 0.0, 0.0, nearly, NO_CIRCLES) == pytest.approx(2.0)
    # Just inside a wall and parallel to it, the ray hits the wall ahead.
    assert cast_ray(0.0, -1.0 + 1e-12, 0.0, SQUARE, NO_CIRCLES) == pytest.approx(1.0)


def test_ray_touching_a_wall_end_is_a_hit():
    wall = np.array([[1.0, 0.0, 1.0, 1.0]])
    assert cast_ray(0.0, 0.0, 0.0, wall, NO_CIRCLES) == 1.0
    assert cast_ray(0.0, 1.0, 0.0, wall, NO_CIRCLES) == 1.0
    assert cast_ray(0.0, 1.0 + 1e-12, 0.0, wall, NO_CIRCLES) == math.inf


def test_circle_is_hit_from_outside_and_inside_only():
    circle = np.array([[2.0, 0.0, 0.5]])
    assert cast_ray(0.0, 0.0, 0.0, NO_SEGMENTS, circle) == pytest.approx(1.5)
    assert cast_ray(2.1, 0.0, 0.0, NO_SEGMENTS, circle) == pytest.approx(0.4)
    assert cast_ray(2.1, 0.0, math.pi, NO_SEGMENTS, circle) == pytest.approx(0.6)
    assert cast_ray(3.0, 0.0, 0.0, NO_SEGMENTS, circle) == math.inf
    assert clearance(2.1, 0.0, NO_SEGMENTS, circle) == pytest.approx(0.4)


def test_rays_start_at_the_mounts_of_selected_sensors():
    generator = np.random.default_rng(7)
    segments, circles = random_walls(generator)
    mounts = generator.uniform((-0.1, -0.1, -3.0), (0.1, 0.1, 3.0), (8, 3))
    for _ in range(50):
        x, y, yaw = generator.uniform(-3.0, 3.0, 3).tolist()
        which = generator.permutation(8)[: generator.integers(0, 9)].astype(np.int64)
        out = np.full(8, -1.0)
        cast_rays(x, y, yaw, mounts, which, segments, circles, out)
        at = moved(mounts[:, :2], yaw, (x, y)).tolist()
        for row in range(8):
            expected = -1.0
            if row in which:
                expected = cast_ray(*at[row], yaw + mounts[row, 2], segments, circles)
            assert out[row] == pytest.approx(expected, abs=1e-9)


def test_overlapping_patches_use_the_lowest_grip():
    patches = np.array([[0.0, 0.0, 1.0, 0.5], [0.5, 0.0, 1.0, 0.2], [0.0, 0.0, 0.1, 0.9]])
    assert grip_at(-0.9, 0.0, patches) == 0.5
    assert grip_at(-1.0, 0.0, patches) == 0.5
    assert grip_at(-1.0000001, 0.0, patches) == 1.0
    assert grip_at(0.0, 0.0, patches) == 0.2
    assert grip_at(1.4, 0.0, patches) == 0.2


def test_box_corners_from_a_file_are_tight():
    """Corners computed per side would differ in the last bit and leak rays."""
    generator = np.random.default_rng(8)
    for _ in range(10):
        x, y, length, width, yaw = generator.uniform(
            (-5, -5, 0.1, 0.1, -6), (5, 5, 2, 2, 6)
        ).tolist()
        box = f'center: [{x}, {y}], size: [{length}, {width}], yaw: {yaw}'
        world = parse_world(f'boxes: [{{{box}}}]', 'box')
        for corner_x, corner_y in world.segments[:, :2].tolist():
            aim = math.atan2(corner_y - y, corner_x - x)
            for turn in [0.0, *generator.normal(0.0, 2e-16, 100)]:
                ray = cast_ray(x, y, aim + float(turn), world.segments, world.circles)
                assert ray == pytest.approx(0.5 * math.hypot(length, width), abs=1e-7)
