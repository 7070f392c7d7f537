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
"""Arenas keep areas and reject what is no convex polygon; path files are read or rejected."""

import numpy as np
import pytest

from t3mpc_ros.geometry.path_file import load_path
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.polyline import PathError
from t3mpc_ros.parameters.table import ParameterError

POLYGON = (0.0, 0.0, 3.0, -1.0, 4.0, 1.0, 2.0, 2.5, -0.5, 1.5)


@pytest.mark.parametrize('numbers', [(-2.0, -1.5, 2.0, 1.5), POLYGON, POLYGON[::-1]])
def test_uniform_square_is_uniform_in_arena(numbers):
    """Halves of the arena get shares of the points by their areas, and all points are inside."""
    arena = Arena(numbers)
    points = arena.from_unit_square(np.random.default_rng(1).uniform(0.0, 1.0, (40_000, 2)))
    assert arena.contains(points, 1e-3).all()
    x, y = arena.corners.T
    area = 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    low, size = arena.corners.min(axis=0), np.ptp(arena.corners, axis=0)
    grid = low + size * np.random.default_rng(2).uniform(0.0, 1.0, (40_000, 2))
    inside = arena.contains(grid)
    assert inside.mean() * size.prod() == pytest.approx(area, rel=0.02)
    for axis in (0, 1):
        cut = low[axis] + 0.4 * size[axis]
        share = (grid[inside][:, axis] < cut).mean()
        assert (points[:, axis] < cut).mean() == pytest.approx(share, abs=0.015)


@pytest.mark.parametrize(
    'numbers',
    [
        (0.0, 0.0, 1.0),
        (0.0, 0.0, 0.0, 1.0),
        (0.0, 0.0, 2.0, 0.0, 2.0, 2.0, 1.0, 0.5, 0.0, 2.0),
        (0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0),
    ],
)
def test_arena_must_be_convex(numbers):
    with pytest.raises(ParameterError, match='arena must be'):
        Arena(numbers)


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('a.csv', '0,0\n1,0.5\n'),
        ('a.csv', '# recorded\nt,y,x\n0,0,0\n1,0.5,1\n'),
        ('a.yaml', 'points: [[0, 0], [1, 0.5]]\n'),
    ],
)
def test_path_files_are_read(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert load_path(tmp_path / name).tolist() == [[0.0, 0.0], [1.0, 0.5]]


@pytest.mark.parametrize(
    ('name', 'text', 'words'),
    [
        ('a.csv', '0,0\n1,nan\n', 'y of point 1'),
        ('a.csv', 'time,speed\n0,1\n', 'header must have x and y'),
        ('a.csv', '0,0\n1\n', 'point 1'),
        ('a.yaml', 'points: [[0, 0], [1, true]]', r'y of points\[1\]'),
        ('a.yaml', 'points: [[0, 0], [0, 0]]', 'two points'),
        ('a.yaml', 'poses: 3', "has no 'poses'"),
        ('a.yaml', 'points: [[0, 0], [1, 0]]\nclose: true', "has no 'close'; did you mean closed"),
        ('a.txt', '0 0', 'must end in'),
    ],
)
def test_bad_path_files_are_rejected(tmp_path, name, text, words):
    """The error names the file, the entry and the value."""
    (tmp_path / name).write_text(text)
    with pytest.raises(PathError, match=words) as error:
        load_path(tmp_path / name)
    assert name in str(error.value)
