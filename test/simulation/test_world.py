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
"""World files: contents, validation and error messages."""

import math
from pathlib import Path
import re
import shutil

import numpy as np
import pytest

from t3mpc_ros.evaluation.patrol.patrol_run import world_file
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.plant.bumper_contact import BumperParameters
from t3mpc_ros.simulation.world import (
    JOIN_TOLERANCE,
    MAX_CHARGERS,
    MAX_CIRCLES,
    MAX_COORDINATE,
    MAX_MOVING,
    MAX_PATCHES,
    MAX_SEGMENTS,
    MIN_SIZE,
    WORLDS_FOLDER,
    WorldError,
    bundled_worlds,
    cast_ray,
    grip_at,
    join_walls,
    load_world,
    parse_world,
)

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'simulation.md'
EXAMPLE = re.search(r'```yaml\n(.*?)```', PAGE.read_text(), re.DOTALL).group(1)
BUMPER = BumperParameters().radius


# --- valid files -------------------------------------------------------------------------------


def test_documented_example_is_a_valid_world():
    world = parse_world(EXAMPLE, 'page.yaml')
    assert world.name == 'workshop'
    # Four walls, one of them split where the partition begins, the partition, and two boxes.
    assert world.segments.shape == (4 + 1 + 1 + 8, 4)
    assert world.circles.tolist() == [[-0.6, 0.9, 0.12]]
    assert world.patches.tolist() == [[0.4, -0.6, 0.3, 0.2]]
    assert world.bounds() == ((-1.5, -1.0), (2.5, 2.0))
    assert world.is_free(0.0, 0.0, BUMPER)
    assert grip_at(0.4, -0.5, world.patches) == 0.2
    # Along the yaw of the first box its end is half its length away, across half its width.
    for turn, half in ((0.0, 0.3), (math.pi / 2, 0.15)):
        ray = cast_ray(1.8, 0.2, 0.7854 + turn, world.segments, world.circles)
        assert ray == pytest.approx(half)


def test_documentation_lists_bounds_worlds_and_error():
    page = PAGE.read_text()
    assert f'| -{MAX_COORDINATE:g} to {MAX_COORDINATE:g} m |' in page
    assert f'| {MIN_SIZE:g} to {MAX_COORDINATE:g} m |' in page
    assert f'| {MAX_SEGMENTS} together |' in page
    assert f'| {MAX_CIRCLES}, {MAX_PATCHES}, {MAX_MOVING}, {MAX_CHARGERS} |' in page
    assert f'nearer than {1e3 * JOIN_TOLERANCE:g} mm' in page
    assert set(re.findall(r'^\| `(\w+)` \| a ', page, re.MULTILINE)) == set(bundled_worlds())
    wrong = EXAMPLE.replace('[0.4, 0.4]', '[-0.4, 0.4]')
    with pytest.raises(WorldError) as caught:
        parse_world(wrong, 'workshop.yaml')
    assert f'\n    {caught.value}\n' in page


@pytest.mark.parametrize('name', bundled_worlds())
def test_bundled_world_loads_and_is_free_at_the_origin(name):
    world = load_world(name)
    assert world.name == name
    assert world.is_free(0.0, 0.0, BUMPER + 0.2)
    for array, width in ((world.segments, 4), (world.circles, 3), (world.patches, 4)):
        assert array.shape[1] == width
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
    across = math.dist(*world.bounds())
    for direction in np.linspace(-3.0, 3.0, 200).tolist():  # it is closed
        ray = cast_ray(0.0, 0.0, direction, world.segments, world.circles)
        assert ray < across


def test_empty_name_is_the_empty_plain():
    world = load_world('')
    assert world.segments.shape == (0, 4)
    assert world.circles.shape == (0, 3)
    assert world.patches.shape == (0, 4)
    assert world.is_free(1e6, -1e6, 100.0)


def test_file_loads_by_path_and_is_named_after_it(tmp_path, monkeypatch):
    path = tmp_path / 'yard.yaml'
    path.write_text('circles: [{center: [1, 2], radius: 0.5}]\n')
    for given in (path, str(path)):
        world = load_world(given)
        assert world.name == 'yard'
        assert world.circles.tolist() == [[1.0, 2.0, 0.5]]
        assert world.bounds() == ((0.5, 1.5), (1.5, 2.5))
    # A local file does not hide a bundled world, nor vice versa.
    monkeypatch.chdir(tmp_path)
    shutil.copy(path, 'room')
    assert len(load_world('room').segments) == 12
    assert len(load_world('./room').segments) == 0
    assert len(load_world(str(WORLDS_FOLDER / 'room.yaml')).segments) == 12


def test_is_free_matches_a_dense_sampling():
    world = parse_world(
        'boxes: [{center: [1, 2], size: [0.8, 0.4], yaw: 0.5}]\n'
        'circles: [{center: [-1, 0], radius: 0.6}]',
        'a',
    )
    generator = np.random.default_rng(1)
    # Points that fill box and circle; a free disc covers none of them.
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 161), np.linspace(-0.2, 0.2, 81)), -1)
    cosine, sine = math.cos(0.5), math.sin(0.5)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    box = grid.reshape(-1, 2) @ turn + (1.0, 2.0)
    both = {True: 0, False: 0}
    for _ in range(200):
        x, y = generator.uniform((-2, -1), (2, 3)).tolist()
        radius = float(generator.choice([0.0, 0.11, 0.3]))
        gap = min(float(np.hypot(*(box - (x, y)).T).min()), max(math.hypot(x + 1.0, y) - 0.6, 0.0))
        if abs(gap - radius) > 0.005 or (radius == 0.0 and math.hypot(x + 1.0, y) < 0.6):
            assert world.is_free(x, y, radius) == (gap > radius)
            both[gap > radius] += 1
    assert min(both.values()) > 20
    for numbers in ((1.0, 2.0, 0.0), (-1.0, 0.0, 0.0), (math.nan, 0.0, 0.1), (9.0, 9.0, math.inf)):
        assert not world.is_free(*numbers)
    assert world.is_free(9, 9, 0)
    with pytest.raises(ValueError, match='radius must be at least 0 m: got -0.1'):
        world.is_free(0.0, 0.0, -0.1)


# --- joints ------------------------------------------------------------------------------------


def test_nearly_touching_walls_share_exact_end_points():
    """0.3333 and 1/3 denote the same corner."""
    joined = join_walls(np.array([[0, 0, 1 / 3, 0], [0.3333, 0.00005, 0.3333, 1.0]], dtype=float))
    assert joined[0, 2:].tolist() == joined[1, :2].tolist()
    assert len(joined) == 2


def test_wall_is_split_where_other_walls_end_on_it():
    generator = np.random.default_rng(2)
    for _ in range(5):
        shares = generator.uniform(0.05, 0.95, 5)
        angle = generator.uniform(0.0, 6.0)
        along = np.array([math.cos(angle), math.sin(angle)])
        across = np.array([-along[1], along[0]])
        walls = [[*(-2.0 * along), *(2.0 * along)]]
        for share in shares:
            foot = (4.0 * share - 2.0) * along + generator.uniform(-9e-5, 9e-5) * across
            walls.append([*foot, *(foot + across)])
        walls.append([*(0.3 * along + 0.01 * across), *(0.3 * along + across)])  # stops short
        joined = join_walls(np.array(walls))
        pieces = joined[:6]
        assert len(joined) == 6 + 6
        assert (pieces[1:, :2] == pieces[:-1, 2:]).all()
        total = np.hypot(*(pieces[:, 2:] - pieces[:, :2]).T).sum()
        assert total == pytest.approx(4.0, abs=1e-6)
        assert {tuple(wall[:2]) for wall in joined[6:11]} == {tuple(p) for p in pieces[1:, :2]}


def test_separate_walls_stay_unchanged():
    generator = np.random.default_rng(3)
    walls = generator.uniform(-100.0, 100.0, (60, 4))
    assert (join_walls(walls) == walls).all()
    assert join_walls(np.zeros((0, 4))).shape == (0, 4)


# --- invalid files -----------------------------------------------------------------------------

CIRCLE = 'center: [0, 0], radius: 0.1'
BAD = {
    'boxes: [{center: [0, 0], size: [1, 0]}]': (
        'boxes[0].size[1] must be a number from 0.01 to 1000 m: got 0'
    ),
    'circles: [{center: [0, 0], radius: .inf}]': 'circles[0].radius must be a number',
    f'circles: [{{center: [0, {10**400}], radius: 1}}]': 'circles[0].center[1] must be a number',
    'circles: [{center: [0, 1e-3], radius: 1}]': "got '1e-3', which YAML reads as text; write",
    'circles: [{center: [0, true], radius: 1}]': 'circles[0].center[1] must be a number',
    'circles: [{center: [0], radius: 1}]': 'circles[0].center must have 2 entries: got 1',
    'circles: [{center: 3, radius: 1}]': 'circles[0].center must be a list: got 3',
    'circles: [{center: [0, 0]}]': 'circles[0] must have radius',
    'circles: [7]': 'circles[0] must hold center, radius, unseen by name: got 7',
    f'patches: [{{{CIRCLE}, grip: 1.2}}]': 'patches[0].grip must be a number from 0 to 1: got 1.2',
    'boxes: [{center: [0, 0], size: [1, 1], yaw: 45}]': (
        'boxes[0].yaw must be a number from -6.28319 to 6.28319 rad: got 45'
    ),
    'boxes: [{centre: [0, 0], size: [1, 1]}]': "boxes[0] has no 'centre'; did you mean center?",
    'wals: []': "the world has no 'wals'; did you mean walls?",
    'walls: [{points: [[0, 0], [1, 1]], closed: true}]': 'must have from 3 to 2001 entries: got 2',
    'walls: [{points: [[0, 0], [1, 1]], closed: 1}]': 'walls[0].closed must be true or false',
    'walls: [{points: [[0, 0], [1, 1], [0, 1], [0, 0]], closed: true}]': (
        'walls[0].points[0] must be at least 0.01 m from the point before it: got 0 m; leave the '
        'last point out'
    ),
    'walls:': 'walls must be a list: got None',
    'name: 7': 'name must be a text: got 7',
    '': 'the world must hold name, walls, boxes, circles, patches, moving, chargers by name: got',
    f'chargers: [{{{CIRCLE}, current: -1}}]': (
        'chargers[0].current must be a number from 0 to 100 A: got -1'
    ),
}


def test_a_charger_charges_where_it_stands():
    world = parse_world('chargers: [{center: [1, 2], radius: 0.1, current: 2}]', 'yard.yaml')
    assert world.charging_current(1.05, 2.05) == 2.0
    assert world.charging_current(1.1, 2.05) == 0.0
    assert parse_world('walls: []', 'yard.yaml').charging_current(0.0, 0.0) == 0.0


def test_invalid_file_error_names_entry_bound_and_value():
    for text, words in BAD.items():
        with pytest.raises(WorldError) as caught:
            parse_world(text, 'yard.yaml')
        assert str(caught.value).startswith('yard.yaml: ')
        assert words in str(caught.value)
        assert len(str(caught.value)) < 250


@pytest.mark.slow
def test_list_lengths_and_segment_count_are_bounded():
    box = '{center: [0, 0], size: [1, 1]}'
    zigzag = ', '.join(f'[{index % 2}, {0.4 * (index - 1000):g}]' for index in range(2001))
    wall = f'walls: [{{points: [{zigzag}]}}]'
    feet = ', '.join(f'{{points: [[{0.1 * i:g}, 0], [{0.1 * i:g}, 1]]}}' for i in range(1500))
    for text, words in (
        (f'circles: [{", ".join(501 * ["7"])}]', 'circles must have from 0 to 500 entries'),
        (f'{wall}\nboxes: [{box}]', 'at most 2000 segments together: got 2004'),
        (wall.replace('points: [', 'points: [[5, 5], '), 'from 2 to 2001 entries: got 2002'),
        # One wall, split where 1500 others begin.
        (f'walls: [{{points: [[-1, 0], [999, 0]]}}, {feet}]', 'segments together: got 3001'),
    ):
        with pytest.raises(WorldError, match=re.escape(words)):
            parse_world(text, 'yard.yaml')


def test_unreadable_file_is_rejected_by_name(tmp_path):
    with pytest.raises(WorldError, match=r'there is no world rooom, .* did you mean room\?'):
        load_world('rooom')
    with pytest.raises(WorldError, match='there is no world .*none.yaml, neither a file nor one'):
        load_world(tmp_path / 'none.yaml')
    with pytest.raises(WorldError, match='cannot be read: Is a directory'):
        load_world(tmp_path)
    broken = tmp_path / 'broken.yaml'
    broken.write_text('boxes: 1')
    with pytest.raises(WorldError, match=r'broken\.yaml: boxes must be a list: got 1'):
        load_world(broken)


@pytest.mark.slow
def test_damaged_file_is_parsed_or_rejected():
    generator = np.random.default_rng(4)
    read = 0
    for _ in range(60):
        text = list(EXAMPLE)
        for _ in range(generator.integers(1, 4)):
            place = int(generator.integers(len(text)))
            text[place] = str(generator.choice(list('[]{}:,-.#!&*?|>"\'%@ \n\t0e~ax')))
        try:
            world = parse_world(''.join(text), 'a')
        except WorldError:
            continue
        read += 1
        assert np.isfinite(world.segments).all()
    assert 5 < read < 55


MOVING = """
walls: [{points: [[2, -1], [2, 1]]}]
boxes: [{center: [1, 1], size: [0.2, 0.2], unseen: true}]
circles: [{center: [-1, 0], radius: 0.2, unseen: true}, {center: [-2, 0], radius: 0.2}]
moving:
  - {radius: 0.1, points: [[1, 0], [1, 1], [2, 1]], speed: 0.5, start: 2}
  - {radius: 0.2, points: [[0, -1], [0.6, -1]], speed: 0.3, repeat: true}
  - {radius: 0.3, points: [[0, 3]], speed: 0, appears: 5, vanishes: 6, unseen: true}
"""


def _discs(time):
    return np.round(parse_world(MOVING, 'a').at(time).circles[2:], 9).tolist()


def test_moving_discs_are_where_their_way_and_time_say():
    first, second, third = [1.0, 0.0, 0.1], [0.0, -1.0, 0.2], [0.0, 3.0, 0.3]
    assert _discs(0.0) == [first, second]
    assert _discs(2.0) == [first, [0.6, -1.0, 0.2]]
    assert _discs(3.0) == [[1.0, 0.5, 0.1], [0.3, -1.0, 0.2]]
    assert _discs(5.0) == [[1.5, 1.0, 0.1], [0.3, -1.0, 0.2], third]
    assert _discs(6.0) == [[2.0, 1.0, 0.1], [0.6, -1.0, 0.2]]  # the second went back and returned
    assert _discs(1e5)[0] == [2.0, 1.0, 0.1]


def test_unseen_things_collide_and_are_not_measured():
    world = parse_world(MOVING, 'a').at(5.5)
    seen = world.seen
    assert len(seen.segments) == 1
    assert seen.circles[:, 0] == pytest.approx([-2.0, 1.75, 0.45])
    assert cast_ray(0.0, 0.0, math.pi, *seen) == pytest.approx(1.8)
    assert cast_ray(0.0, 0.0, math.pi, *world.obstacles) == pytest.approx(0.8)
    assert not world.is_free(0.0, 2.6, 0.11)
    assert parse_world(MOVING, 'a').at(6.0).is_free(0.0, 2.6, 0.11)
    plain = load_world('room')
    assert plain.at(3.0) is plain
    assert plain.seen.segments is plain.segments  # as before there were unseen things


def test_a_disc_that_comes_pushes_a_robot_that_stands():
    text = 'moving: [{radius: 0.1, points: [[1, 0], [0.15, 0]], speed: 1}]'
    with world_file(text) as path:
        twin = DigitalTwin(DigitalTwinParameters.from_dict({'world': path}))
        states = [twin.step(WheelSpeeds(0.0, 0.0)) for _ in range(120)]
    assert abs(states[70].truth.pose.x) < 1e-5
    assert states[-1].truth.pose.x < -0.03
    assert min(state.ranges[0] for state in states[20:]) < 0.2
