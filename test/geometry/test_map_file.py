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
"""Files of maps: what is written is what is read, and as map_saver writes it."""

import numpy as np
import pytest
import yaml

from t3mpc_ros.geometry.arena import OccupancyGrid
from t3mpc_ros.geometry.map_file import MapError, load_map, save_map

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
