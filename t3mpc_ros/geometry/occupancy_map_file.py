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
"""Maps in files: YAML of nav2_map_server with an image as PGM beside it."""

import os
from pathlib import Path

import numpy as np

from t3mpc_ros.geometry.obstacles import OccupancyGrid
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters import yaml_loader

MAX_CELLS = 25_000_000
"""Largest number of cells of a grid."""
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""Those that map_saver writes."""
FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY = 254, 205, 0
"""Grey levels that map_saver writes in mode trinary."""


class MapError(ValueError):
    """An invalid map; the text names the file or the entry, the bound and the value."""


def save_map(path: str | os.PathLike[str], grid: OccupancyGrid) -> None:
    """Write a grid as map_saver does in mode trinary: a YAML file, and its image beside it.

    MapError: a file cannot be written, or its name does not end in ``.yaml``.
    """
    file = Path(path)
    if file.suffix not in ('.yaml', '.yml'):
        raise MapError(f'{file} must end in .yaml')
    image = file.with_suffix('.pgm')
    grey = np.full(grid.cells.shape, UNKNOWN_GREY, dtype=np.uint8)
    share = grid.cells / 100.0
    grey[(share >= 0.0) & (share < FREE_THRESHOLD)] = FREE_GREY
    grey[share > OCCUPIED_THRESHOLD] = OCCUPIED_GREY
    rows, columns = grid.cells.shape
    entries = {
        'image': image.name,
        'mode': 'trinary',
        'resolution': float(grid.resolution),
        'origin': [float(grid.x), float(grid.y), 0.0],
        'negate': 0,
        'occupied_thresh': OCCUPIED_THRESHOLD,
        'free_thresh': FREE_THRESHOLD,
    }
    try:
        image.write_bytes(b'P5\n%d %d\n255\n' % (columns, rows) + grey[::-1].tobytes())
        text = ''.join(f'{name}: {value}\n' for name, value in entries.items())
        file.write_text(text, encoding='utf-8')
    except OSError as error:
        raise MapError(f'{error.filename} cannot be written: {error.strerror}') from error


def load_map(path: str | os.PathLike[str]) -> OccupancyGrid:
    """Return the grid of a YAML file of map_server, with its image as PGM beside it.

    MapError: a file cannot be read, an entry is invalid, or the image is no PGM of 8 bits.
    """
    file = Path(path)
    names = 'image', 'resolution', 'origin', 'negate', 'occupied_thresh', 'free_thresh'
    with yaml_loader.file_errors(file, MapError):
        read = yaml_loader.check_entry(yaml_loader.read_yaml(file), 'the map', names, ('mode',))
        if read.get('mode', 'trinary') not in ('trinary', 'scale'):
            raise yaml_loader.EntryError(f'mode must be trinary or scale: got {read["mode"]}')
        resolution = yaml_loader.check_number(read['resolution'], 'resolution', 1e-3, 10.0, 'm')
        x, y, yaw = (
            yaml_loader.check_number(number, f'origin[{index}]', -1e4, 1e4)
            for index, number in enumerate(yaml_loader.check_list(read['origin'], 'origin', 3, 3))
        )
        occupied = yaml_loader.check_number(read['occupied_thresh'], 'occupied_thresh', 0.0, 1.0)
        free = yaml_loader.check_number(read['free_thresh'], 'free_thresh', 0.0, occupied)
        negate = yaml_loader.check_number(read['negate'], 'negate', 0, 1) != 0
        if not isinstance(read['image'], str):
            raise yaml_loader.EntryError('image must be the name of a file')
    image = file.parent / read['image']
    share = _read_pgm(image)[::-1]
    darkness = share if negate else 1.0 - share
    cells = np.full(share.shape, -1, dtype=np.int8)
    cells[darkness < free] = 0
    cells[darkness > occupied] = 100
    if abs(yaw) > 1e-6:
        raise MapError(f'{file}: origin must have a yaw of 0: got {yaw:g}')
    return OccupancyGrid(cells, resolution, x, y)


def _read_pgm(path: Path) -> Array:
    """Return the grey levels of a PGM, 0 to 1, shape (rows, columns), from the top."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MapError(f'{path} cannot be read: {error.strerror}') from error
    words: list[bytes] = []
    begin = 0
    while len(words) < 4 and begin < len(content):
        end = content.find(b'\n', begin) % (len(content) + 1)
        line = content[begin:end].partition(b'#')[0]
        words += line.split()
        begin = end + 1
    kind, *numbers = [*words, b'', b'', b'', b''][:4]
    if kind not in (b'P2', b'P5') or not all(number.isdigit() for number in numbers):
        raise MapError(f'{path} must be a PGM (P2 or P5)')
    width, height, largest = map(int, numbers)
    if not (0 < largest < 256 and 4 <= width * height <= MAX_CELLS):
        raise MapError(
            f'{path} must have 4 to {MAX_CELLS} pixels of 8 bits: got {width} x {height} of '
            f'{largest}'
        )
    try:
        pixels = (
            np.frombuffer(content[begin:], dtype=np.uint8)
            if kind == b'P5'
            else np.array(content[begin:].split(), dtype=np.int64)
        )
    except ValueError:
        raise MapError(f'{path} must hold numbers after its header') from None
    if pixels.size < width * height:
        raise MapError(f'{path} must have {width * height} pixels: got {pixels.size}')
    return pixels[: width * height].reshape(height, width) / largest
