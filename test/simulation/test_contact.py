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
"""Contact force of walls: along the normal, never a pull, conservative without damping."""

import math

import numpy as np
import pytest

from t3mpc_ros.simulation.plant.bumper_contact import BumperParameters, contact_force
from t3mpc_ros.simulation.world import clearance, join_walls, load_world

NO_SEGMENTS, NO_CIRCLES = np.zeros((0, 4)), np.zeros((0, 3))
RADIUS, STIFFNESS, DAMPING = 0.11, 2e4, 100.0
SPRING = BumperParameters().constants()._replace(damping=0.0)
DAMPED = BumperParameters().constants()
MASS = 1.5
FLOOR = np.array([[-1.0, 0.0, 1.0, 0.0]])
BOX = np.array([[0.0, 0.0, 0.5, 0.0], [0.5, 0, 0.5, 0.3], [0.5, 0.3, 0, 0.3], [0, 0.3, 0, 0]])


def force(x, y, segments=NO_SEGMENTS, circles=NO_CIRCLES, bumper=SPRING, speed=(0.0, 0.0)):
    return np.array(contact_force(x, y, *map(float, speed), bumper, segments, circles))


def polyline(points, closed=False):
    """Return the wall segments between points."""
    points = [tuple(map(float, point)) for point in points]
    pairs = list(zip(points, points[1:], strict=False)) + [(points[-1], points[0])] * closed
    return np.array([[*start, *end] for start, end in pairs])


def round_room(sides, radius):
    angles = np.arange(sides) * math.tau / sides
    return polyline(radius * np.column_stack([np.cos(angles), np.sin(angles)]), closed=True)


def work_around(points, segments, circles=NO_CIRCLES):
    """Return the work along a closed path, and the sum of the magnitudes of its parts."""
    forces = [force(*point, segments, circles) for point in points.tolist()]
    means = 0.5 * (np.array(forces) + np.roll(forces, -1, axis=0))
    steps = np.roll(points, -1, axis=0) - points
    total = np.sum(np.linalg.norm(means, axis=1) * np.linalg.norm(steps, axis=1))
    return float(np.sum(means * steps)), float(total)


def largest_jump(path, segments):
    """Return the largest change of the force from one point of a path to the next, N."""
    forces = np.array([force(*point, segments) for point in path])
    return float(np.linalg.norm(np.diff(forces, axis=0), axis=1).max())


def test_no_force_without_contact():
    generator = np.random.default_rng(1)
    world = load_world('room')
    apart = 0
    for _ in range(1000):
        x, y = generator.uniform((-2.2, -1.7), (2.2, 1.7)).tolist()
        pushed = force(x, y, world.segments, world.circles, DAMPED, generator.normal(size=2))
        if world.is_free(x, y, RADIUS):
            assert not pushed.any()
            apart += 1
    assert apart > 300
    assert not force(0.0, 0.0).any()


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_wall_force_is_spring_and_damper_along_the_normal(side):
    depth = 0.004
    for angle in (0.0, 0.7, 2.5):
        along, across = (
            np.array([math.cos(angle), math.sin(angle)]),
            side * np.array([-math.sin(angle), math.cos(angle)]),
        )
        wall = np.array([[*-along, *along]])
        at = 0.3 * along + (RADIUS - depth) * across
        spring = STIFFNESS * depth
        assert force(*at, wall) == pytest.approx(spring * across, abs=1e-9)
        # Sliding adds no force, closing does, and leaving fast never pulls.
        for closing, sliding in ((0.2, 0.0), (0.2, 1.5), (-0.1, 1.5), (-5.0, 0.3)):
            speed = -closing * across + sliding * along
            expected = max(spring + DAMPING * closing, 0.0)
            assert force(*at, wall, bumper=DAMPED, speed=speed) == pytest.approx(
                expected * across, abs=1e-9
            )


def test_circle_force_points_outwards_at_any_depth():
    pillar = np.array([[1.0, 0.0, 0.2]])
    for angle in np.linspace(0.0, 6.0, 20):
        out = np.array([math.cos(angle), math.sin(angle)])
        for distance in (0.309, 0.25, 0.2, 0.1):
            expected = STIFFNESS * (0.2 + RADIUS - distance) * out
            assert force(1.0 + distance * out[0], distance * out[1], circles=pillar) == (
                pytest.approx(expected, abs=1e-9)
            )
    assert force(1.0, 0.0, circles=pillar).tolist() == [0.0, 0.0]


def test_wall_end_and_corner_push_once():
    """The corner is the nearest point of both walls, whose sum would push twice."""
    for angle in np.linspace(math.pi + 0.01, 1.5 * math.pi - 0.01, 30):
        out = np.array([math.cos(angle), math.sin(angle)])
        at = (RADIUS - 0.005) * out
        assert force(*at, BOX) == pytest.approx(STIFFNESS * 0.005 * out, abs=1e-9)
        speed = -0.3 * out + 0.7 * np.array([-out[1], out[0]])
        assert force(*at, BOX, bumper=DAMPED, speed=speed) == pytest.approx(
            (STIFFNESS * 0.005 + DAMPING * 0.3) * out, abs=1e-9
        )
        assert force(*at, BOX[:1]) == pytest.approx(STIFFNESS * 0.005 * out, abs=1e-9)


def test_walls_sharing_a_point_push_once():
    for count in range(1, 7):
        angles = np.linspace(-1.0, 1.0, count)
        star = np.array([[0.0, 0.0, math.cos(a), math.sin(a)] for a in angles])
        star[::2] = star[::2][:, [2, 3, 0, 1]]  # both orientations
        assert force(-0.1, 0.0, star) == pytest.approx([-STIFFNESS * 0.01, 0.0], abs=1e-9)


def test_both_walls_of_an_inner_corner_push():
    walls = polyline([(0, 1), (0, 0), (1, 0)])
    assert force(RADIUS - 0.004, RADIUS - 0.007, walls) == pytest.approx(
        [STIFFNESS * 0.004, STIFFNESS * 0.007], abs=1e-9
    )


def test_joint_of_collinear_walls_adds_no_force():
    one, two = FLOOR, polyline([(-1, 0), (0.1, 0), (1, 0)])
    three = two[::-1][:, [2, 3, 0, 1]]
    generator = np.random.default_rng(2)
    for _ in range(300):
        x = 0.1 + generator.normal(0.0, 0.1)
        y = float(generator.uniform(0.08, 0.12))
        speed = generator.normal(0.0, 1.0, 2)
        plain = force(x, y, one, bumper=DAMPED, speed=speed)
        assert force(x, y, two, bumper=DAMPED, speed=speed) == pytest.approx(plain, abs=1e-9)
        assert force(x, y, three, bumper=DAMPED, speed=speed) == pytest.approx(plain, abs=1e-9)


@pytest.mark.compiled
@pytest.mark.slow
def test_force_is_continuous_at_joints_and_corners():
    """A force that jumps at a joint would shake a robot that slides along the wall."""
    step = 5e-5
    # Bound of the change per metre of a segment, a corner, or a sum of two.
    bound = 4.0 * STIFFNESS * step
    for turn, depth in ((-1.5, 0.004), (-0.05, 0.02), (0.002, 0.004), (0.5, 0.0005), (1.5, 0.02)):
        walls = polyline([(-0.3, 0), (0, 0), (0.3 * math.cos(turn), 0.3 * math.sin(turn))])
        path = [(x, RADIUS - depth) for x in np.arange(-0.2, 0.15, step).tolist()]
        # Up to the contact with the other wall.
        free = [clearance(*point, walls, NO_CIRCLES) > 0.06 for point in path]
        assert largest_jump(path[: [*free, False].index(False)], walls) < bound


@pytest.mark.parametrize('sides', [24, 180])
def test_polygon_approximates_a_circle_on_both_sides(sides):
    """In a shallow inner corner two walls touch at once, but must push like one."""
    radius = 0.6
    room = round_room(sides, radius)
    sagitta = radius * (1.0 - math.cos(math.pi / sides))
    depth = 0.006
    for side in (-1.0, 1.0):
        for angle in np.linspace(0.0, 1.0, 100):
            out = np.array([math.cos(angle), math.sin(angle)])
            pushed = force(*((radius + side * (RADIUS - depth)) * out), room)
            # The depth differs by as much as the polygon from the circle, for both walls inside.
            assert abs(side * pushed @ out / STIFFNESS - depth) <= 1.5 * sagitta + 1e-6
            aslant = abs(pushed[0] * out[1] - pushed[1] * out[0])
            assert aslant <= 1.01 * math.tan(math.pi / sides) * abs(pushed @ out)


@pytest.mark.compiled
@pytest.mark.slow
def test_undamped_force_is_conservative():
    generator = np.random.default_rng(3)
    worlds = [
        (BOX, np.array([[0.6, 0.4, 0.05]])),
        (polyline([(-0.3, 0.02), (0, 0), (0.3, 0.04)]), NO_CIRCLES),
        (polyline([(0, 0.5), (0, 0), (0.5, 0)]), NO_CIRCLES),
        (join_walls(np.array([[-1.0, 0, 1, 0], [0, 0, 0, 1]])), NO_CIRCLES),
    ]
    turns = np.arange(4000) * math.tau / 4000
    ring = np.column_stack([np.cos(turns), np.sin(turns)])
    tested = 0
    for segments, circles in worlds:
        corners = np.unique(segments.reshape(-1, 2), axis=0)
        for _ in range(4):
            angle = generator.uniform(0.0, math.tau)
            corner = corners[generator.integers(len(corners))]
            middle = corner + 0.1 * np.array([math.cos(angle), math.sin(angle)])
            free = clearance(*middle.tolist(), segments, circles)
            # A path through a wall would not be closed.
            way = middle + min(0.04, 0.9 * free) * ring * generator.uniform(0.3, 1.0, 2)
            work, total = work_around(way, segments, circles)
            assert abs(work) <= 2e-6 * total + 1e-12
            tested += total > 0.1
    assert tested > 8


def test_damper_never_adds_energy():
    generator = np.random.default_rng(4)
    world = load_world('room')
    rooms = [(world.segments, world.circles), (round_room(24, 0.5), NO_CIRCLES)]
    touching = 0
    for segments, circles in rooms:
        for wall in segments.tolist() * 150:
            share = generator.uniform(-0.1, 1.1)
            foot = np.array(wall[:2]) + share * (np.array(wall[2:]) - wall[:2])
            x, y = (foot + generator.normal(0.0, 0.08, 2)).tolist()
            if clearance(x, y, segments, circles) < 0.08:
                continue
            speed = generator.normal(0.0, 1.0, 2)
            spring = force(x, y, segments, circles)
            damped = force(x, y, segments, circles, DAMPED, speed)
            assert (damped - spring) @ speed <= 1e-9
            touching += bool(spring.any())
    assert touching > 500


def thrown(speed, dt, start=0.12):
    """Return lowest y and last speed of a point mass thrown at the floor; semi-implicit Euler."""
    y, lowest, speed_y = start, start, -speed
    for _ in range(round(1.0 / dt)):
        speed_y += dt / MASS * contact_force(0.0, y, 0.0, speed_y, DAMPED, FLOOR, NO_CIRCLES)[1]
        y += dt * speed_y
        lowest = min(lowest, y)
        if y > start:
            break
    return lowest, speed_y


@pytest.mark.parametrize('speed', [0.05, 3.0])
def test_one_millisecond_steps_suffice_for_the_defaults(speed):
    _, fine = thrown(speed, 1e-5)
    lowest, coarse = thrown(speed, 1e-3)
    assert lowest > 0.05
    assert coarse == pytest.approx(fine, abs=0.1 * speed)


def test_wall_ending_on_a_wall_is_not_felt_on_the_far_side():
    """A partition that only touches the wall would push through it, in addition to the wall."""
    apart = np.array([[-1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, -1.0]])
    joined = join_walls(apart)
    assert len(joined) == 3
    for x in np.linspace(-0.2, 0.2, 41).tolist():
        assert force(x, 0.105, joined) == pytest.approx([0.0, STIFFNESS * 0.005], abs=1e-9)
    assert force(0.0, 0.105, apart)[1] == pytest.approx(2.0 * STIFFNESS * 0.005)
