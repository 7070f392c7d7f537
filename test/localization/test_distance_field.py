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
"""Map of a localisation and its files: against the rays of the world, and map_saver."""

import math

import numpy as np
import pytest
import yaml

from t3mpc_ros.geometry.obstacles import OccupancyGrid
from t3mpc_ros.geometry.occupancy_map_file import MapError, load_map, save_map
from t3mpc_ros.localization.distance_field import load_grid, map_of_grid, map_of_world, trace_ray
from t3mpc_ros.simulation.world import cast_ray, load_world

REACH = 1.0


@pytest.fixture(scope='module')
def room():
    return load_world('room')


@pytest.fixture(scope='module')
def room_map(room):
    return map_of_world(room)


def rays(places, count, seed):
    generator = np.random.default_rng(seed)
    chosen = places[generator.integers(0, len(places), count)]
    return zip(chosen.tolist(), generator.uniform(-math.pi, math.pi, count).tolist(), strict=True)


@pytest.mark.compiled
def test_rays_end_where_those_of_the_world_end(room, room_map):
    errors, missed = [], 0
    for (x, y), direction in rays(room_map.free_places(0.1), 2000, 1):
        found = trace_ray(room_map.field, x, y, direction, REACH)
        expected = cast_ray(x, y, direction, room.segments, room.circles)
        if math.isfinite(found) and expected < REACH:
            errors.append(abs(found - expected))
        else:
            missed += math.isfinite(found) != (expected < REACH)
    # The rest are rays along a wall or past an edge, at which the distance jumps.
    assert np.quantile(errors, 0.95) < 1e-3
    assert missed < 0.02 * 2000


def test_free_places_are_in_the_room_and_clear_of_it(room, room_map):
    places = room_map.free_places(0.15)
    assert all(room.is_free(x, y, 0.14) for x, y in places[::97].tolist())
    assert np.abs(places).max(axis=0) == pytest.approx([1.85, 1.35], abs=0.011)


def test_a_robot_outside_all_walls_keeps_the_floor_there(tmp_path):
    path = tmp_path / 'pillar.yaml'
    path.write_text('circles: [{center: [0, 0], radius: 0.1}]\n')
    assert len(map_of_world(load_world(path)).free_places(0.1))


def test_a_world_without_obstacles_is_no_map():
    with pytest.raises(MapError, match='plain must have walls'):
        map_of_world(load_world(''))


def walled_grid():
    """Return 60 x 40 cells of 5 cm with walls of one cell at the edge, unknown in a corner."""
    cells = np.zeros((40, 60), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[30:39, 50:59] = -1
    return cells


def test_a_ray_in_a_grid_ends_at_the_face_of_the_cell():
    field = map_of_grid(walled_grid(), 0.05, (-1.0, -1.0, 0.0)).field
    assert trace_ray(field, 1.0, 0.0, 0.0, 2.0) == pytest.approx(0.95, abs=1e-9)
    assert trace_ray(field, 0.0, 0.0, math.pi, 2.0) == pytest.approx(0.95, abs=1e-9)
    assert trace_ray(field, 0.0, 0.0, -0.5 * math.pi, 2.0) == pytest.approx(0.95, abs=1e-9)
    assert trace_ray(field, 1.0, 0.0, 0.0, 0.9) == math.inf


def test_unknown_cells_are_no_free_places():
    places = map_of_grid(walled_grid(), 0.05, (0.0, 0.0, 0.0)).free_places(0.1)
    assert not ((places[:, 0] > 2.5) & (places[:, 1] > 1.5)).any()


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'resolution': 0.0}, 'resolution'),
        ({'origin': (0.0, 0.0, 0.3)}, 'yaw of 0'),
        ({'origin': (math.nan, 0.0, 0.0)}, 'finite'),
        ({'occupancy': np.zeros((5, 5), dtype=np.int8)}, 'a cell of at least'),
        ({'occupancy': np.zeros(25, dtype=np.int8)}, 'cells'),
    ],
)
def test_an_invalid_grid_is_rejected(change, reason):
    values = {'occupancy': walled_grid(), 'resolution': 0.05, 'origin': (0.0, 0.0, 0.0)}
    with pytest.raises(MapError, match=reason):
        map_of_grid(**{**values, **change})


def write_map(folder, cells, kind='P5', **changes):
    """Write a map as map_server saves it; return the path of its YAML file."""
    grey = np.select([cells == 0, cells == 100], [254, 0], 205)[::-1]
    rows, columns = cells.shape
    head = f'{kind}\n# CREATOR: map_saver\n{columns} {rows}\n255\n'.encode()
    text = b' '.join(str(value).encode() for value in grey.ravel().tolist())
    (folder / 'map.pgm').write_bytes(
        head + (grey.astype(np.uint8).tobytes() if kind == 'P5' else text)
    )
    values = {'image': 'map.pgm', 'resolution': 0.05, 'origin': [-1.0, -1.0, 0.0], 'negate': 0}
    values |= {'occupied_thresh': 0.65, 'free_thresh': 0.196, **changes}
    path = folder / 'map.yaml'
    path.write_text(''.join(f'{name}: {value}\n' for name, value in values.items()))
    return path


@pytest.mark.parametrize('kind', ['P5', 'P2'])
def test_a_saved_map_is_the_grid_that_was_saved(tmp_path, kind):
    loaded = load_grid(write_map(tmp_path, walled_grid(), kind))
    given = map_of_grid(walled_grid(), 0.05, (-1.0, -1.0, 0.0))
    assert np.array_equal(loaded.field.distance, given.field.distance)
    assert loaded.field[1:] == given.field[1:]
    assert np.array_equal(loaded.free_places(0.1), given.free_places(0.1))


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'mode': 'raw'}, 'mode must be trinary or scale'),
        ({'image': 'none.pgm'}, 'cannot be read'),
        ({'image': 'map.yaml'}, 'must be a PGM'),
        ({'free_thresh': 0.9}, 'free_thresh'),
        ({'origin': [0.0, 0.0]}, 'origin'),
        ({'origin': [0.0, 0.0, 0.5]}, 'yaw'),
    ],
)
def test_an_invalid_map_file_is_rejected_with_its_name(tmp_path, change, reason):
    path = write_map(tmp_path, walled_grid(), **change)
    with pytest.raises(MapError, match=reason) as raised:
        load_grid(path)
    assert str(tmp_path) in str(raised.value)


def test_a_truncated_image_is_rejected(tmp_path):
    path, image = write_map(tmp_path, walled_grid()), tmp_path / 'map.pgm'
    whole = image.read_bytes()
    for kept in (0, 2, 30, -100):
        image.write_bytes(whole[:kept])
        with pytest.raises(MapError, match='map.pgm'):
            load_grid(path)


CELLS = np.array([[-1, 0, 100], [0, 0, 100]], dtype=np.int8)


def test_a_map_is_read_as_it_was_written(tmp_path):
    path = tmp_path / 'room.yaml'
    save_map(path, OccupancyGrid(CELLS, 0.02, -1.24, 0.56))
    read = load_map(path)
    assert np.array_equal(read.cells, CELLS)
    assert read[1:] == (0.02, -1.24, 0.56)
    text = yaml.safe_load(path.read_text())
    assert (text['image'], text['mode'], text['negate']) == ('room.pgm', 'trinary', 0)
    assert (text['occupied_thresh'], text['free_thresh']) == (0.65, 0.196)
    image = (tmp_path / 'room.pgm').read_bytes()
    # The first row of the image is the one with the largest y.
    assert image == b'P5\n3 2\n255\n' + bytes([254, 254, 0, 205, 254, 0])


def test_a_map_that_cannot_be_written_is_an_error(tmp_path):
    grid = OccupancyGrid(CELLS, 0.02, 0.0, 0.0)
    with pytest.raises(MapError, match='must end in .yaml'):
        save_map(tmp_path / 'room.pgm', grid)
    with pytest.raises(MapError, match='none.room.pgm cannot be written'):
        save_map(tmp_path / 'none' / 'room.yaml', grid)
