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
"""World: obstacles, slippery patches and chargers from a YAML file; ray casting.

A file with an error is rejected, never repaired; the error names the entry. The kernels read the
arrays of a :class:`World`: ``segments`` (n, 4: ax, ay, bx, by), ``circles`` (m, 3: x, y, radius),
``patches`` (k, 4: x, y, radius, grip), all in m in the world frame except the grip; any of them
may be empty.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from t3mpc_ros.geometry.obstacles import Obstacles
from t3mpc_ros.geometry.polyline import lengths_along
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters import yaml_loader
from t3mpc_ros.parameters.table import nearest_hint

WORLDS_FOLDER = Path(__file__).resolve().parent / 'worlds'  # folder of the bundled worlds
MAX_COORDINATE = 1000.0  # m, bound of every coordinate and size
MIN_SIZE = 0.01
"""m, lower bound of every size: a thinner obstacle would push the bumper on both sides."""
MAX_SEGMENTS = 2000
"""Straight wall segments, those of boxes included: every ray and every step visits each."""
MAX_CIRCLES = 500
MAX_PATCHES = 100
MAX_MOVING = 100
MAX_CHARGERS = 20
MAX_CURRENT = 100.0  # A, of a charger
MAX_SPEED = 5.0  # m/s, of a disc that moves
JOIN_TOLERANCE = 1e-4  # m: ends nearer than this to each other, or to a wall, touch


class WorldError(ValueError):
    """An invalid world; the text contains the file, the entry, the bound and the value."""


class MovingDisc(NamedTuple):
    """A round obstacle that follows a polyline at one speed, and stays at its end."""

    radius: float  # m
    points: Array  # m, shape (n, 2)
    speed: float  # m/s
    start: float  # time at which it leaves its first point, s
    appears: float  # time before which it is nowhere, s
    vanishes: float = math.inf  # time from which on it is nowhere, s
    repeat: bool = False  # whether it goes back and forth
    unseen: bool = False  # whether the range sensors do not see it

    def position(self, time: float) -> tuple[float, float]:
        """Return where its centre is at a time (s), m."""
        lengths = lengths_along(self.points)
        along, whole = max(time - self.start, 0.0) * self.speed, float(lengths[-1])
        if self.repeat and whole > 0.0:
            along = whole - abs(along % (2.0 * whole) - whole)
        x, y = (float(np.interp(along, lengths, axis)) for axis in self.points.T)
        return x, y


@dataclass(frozen=True, eq=False)
class World:
    """Obstacles and patches as arrays for the kernels; read-only by convention.

    They are not locked, because the kernels would be compiled again for read-only arrays.
    """

    name: str
    segments: Array
    """Wall segments, shape (n, 4): ax, ay, bx, by, m; those of boxes included."""
    circles: Array  # pillars, shape (m, 3): x, y, radius, m
    patches: Array
    """Slippery floor, shape (k, 4): x, y, radius (m), grip (factor on the tyre grip, 0 to 1)."""
    boxes: Array
    """Interior of the boxes, shape (b, 5): x, y, length, width (m), yaw of the length (rad)."""
    unseen: Obstacles = Obstacles()  # which of them the range sensors do not see
    moving: tuple[MovingDisc, ...] = ()  # they are in :attr:`circles` of :meth:`at` only
    chargers: Array = field(default_factory=lambda: np.zeros((0, 4)))
    """Floor on which a battery is charged, shape (k, 4): x, y, radius (m), current (A)."""

    @property
    def obstacles(self) -> Obstacles:
        """What a robot must not touch."""
        return Obstacles(self.segments, self.circles)

    @property
    def seen(self) -> Obstacles:
        """What the beams of the range sensors meet."""
        return Obstacles(
            _without(self.segments, self.unseen.segments),
            _without(self.circles, self.unseen.circles),
        )

    def at(self, time: float) -> 'World':
        """Return the world with its moving discs where they are at a time (s)."""
        if not self.moving:
            return self
        there = [each for each in self.moving if each.appears <= time < each.vanishes]
        circles = [(*each.position(time), each.radius) for each in there]
        hidden = [disc for disc, each in zip(circles, there, strict=True) if each.unseen]
        unseen = np.vstack([self.unseen.circles, _rows(hidden, 3)])
        return replace(
            self,
            circles=np.vstack([self.circles, _rows(circles, 3)]),
            unseen=Obstacles(self.unseen.segments, unseen),
        )

    def charging_current(self, x: float, y: float) -> float:
        """Return the current (A) that charges a robot whose centre is at a place (m)."""
        for at_x, at_y, radius, current in self.chargers.tolist():
            if math.hypot(x - at_x, y - at_y) <= radius:
                return float(current)
        return 0.0

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Decide whether a disc at (x, y) touches no wall and is in no box or circle, all in m.

        Non-finite arguments are not free.
        """
        if radius < 0.0:
            raise ValueError(f'radius must be at least 0 m: got {radius:g}')
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(radius)):
            return False
        x, y = float(x), float(y)  # an int would compile the kernel again
        if clearance(x, y, self.segments, self.circles) < radius:
            return False
        if np.any(np.hypot(x - self.circles[:, 0], y - self.circles[:, 1]) <= self.circles[:, 2]):
            return False
        away_x, away_y = x - self.boxes[:, 0], y - self.boxes[:, 1]
        cosine, sine = np.cos(self.boxes[:, 4]), np.sin(self.boxes[:, 4])
        along, across = cosine * away_x + sine * away_y, cosine * away_y - sine * away_x
        inside = (2.0 * abs(along) <= self.boxes[:, 2]) & (2.0 * abs(across) <= self.boxes[:, 3])
        return not inside.any()

    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the smallest and the largest x and y (m) of obstacles and patches, if any."""
        discs = np.vstack([self.circles, self.patches[:, :3]])
        corners = [self.segments.reshape(-1, 2)]
        corners += [discs[:, :2] + side * discs[:, 2:] for side in (-1.0, 1.0)]
        points = np.vstack(corners)
        low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return (low[0], low[1]), (high[0], high[1])


def recorded_world(name: str) -> World | None:
    """Return the world that a bag names.

    None for an empty name, and for a file that is not here: it belongs to another machine.
    """
    try:
        return load_world(name) if name else None
    except WorldError:
        return None


def world_outline(name: str) -> dict[str, list[list[float]]] | None:
    """Return segments, circles and patches of a recorded world as lists, for a picture.

    None as for :func:`recorded_world`.
    """
    world = recorded_world(name)
    if world is None:
        return None
    return {
        'segments': world.segments.tolist(),
        'circles': world.circles.tolist(),
        'patches': world.patches.tolist(),
    }


def bundled_worlds() -> tuple[str, ...]:
    """Return the names of the bundled worlds."""
    return tuple(sorted(path.stem for path in WORLDS_FOLDER.glob('*.yaml')))


def load_world(path_or_name: str | Path) -> World:
    """Return a world by the name of a bundled one, otherwise by the path of a file.

    An empty name is the empty plain. A file with the name of a bundled world needs its folder:
    ``./room``.
    """
    if path_or_name == '':
        return parse_world('name: plain', 'plain')
    names = bundled_worlds()
    path = Path(path_or_name)
    if path_or_name in names:
        path = WORLDS_FOLDER / f'{path_or_name}.yaml'
    try:
        text = yaml_loader.read_text(path)
    except yaml_loader.YamlError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise WorldError(f'{path} {error}') from error
        raise WorldError(
            f'there is no world {path_or_name}, neither a file nor one of '
            f'{", ".join(names)}{nearest_hint(str(path_or_name), names)}'
        ) from None
    return parse_world(text, str(path))


def parse_world(text: str, source: str) -> World:
    """Return the world of a YAML text.

    Errors begin with ``source``; without ``name`` in the text, its stem is that of the world.
    """
    with yaml_loader.file_errors(source, WorldError):
        return _world(yaml_loader.parse_yaml(text), Path(source).stem)


def _world(content: object, stem: str) -> World:
    lists = ('walls', 'boxes', 'circles', 'patches', 'moving', 'chargers')
    read = yaml_loader.check_entry(content, 'the world', (), ('name', *lists))
    name = read.get('name', stem)
    if not isinstance(name, str) or not name:
        raise yaml_loader.EntryError(f'name must be a text: got {yaml_loader.shortened(name)}')
    pieces: dict[bool, list[tuple[float, ...]]] = {False: [], True: []}
    """Walls by whether they are unseen."""
    boxes = []
    size = 'center', 'size'
    for where, wall in _entries(read, 'walls', MAX_SEGMENTS, ('points',), 'closed', 'unseen'):
        pieces[_flag(wall, where, 'unseen')] += _wall(wall, where)
        _check_count(sum(map(len, pieces.values())))
    for where, box in _entries(read, 'boxes', MAX_SEGMENTS // 4, size, 'yaw', 'unseen'):
        boxes.append(_box(box, where))
        pieces[_flag(box, where, 'unseen')] += _sides(*boxes[-1])
        _check_count(sum(map(len, pieces.values())))
    seen, unseen = (join_walls(_rows(pieces[key], 4)) for key in (False, True))
    segments = np.vstack([seen, unseen])
    _check_count(len(segments))
    disc = 'center', 'radius'
    found = [*_entries(read, 'circles', MAX_CIRCLES, disc, 'unseen')]
    circles = [_disc(*each) for each in found]
    hidden = [
        row for row, each in zip(circles, found, strict=True) if _flag(*each[::-1], 'unseen')
    ]
    way = 'radius', 'points', 'speed'
    options = 'start', 'appears', 'vanishes', 'repeat', 'unseen'
    moving = [_moving(*each) for each in _entries(read, 'moving', MAX_MOVING, way, *options)]
    patches = _floor(read, 'patches', MAX_PATCHES, 'grip', 1.0)
    chargers = _floor(read, 'chargers', MAX_CHARGERS, 'current', MAX_CURRENT, 'A')
    return World(
        name,
        segments,
        _rows(circles, 3),
        patches,
        _rows(boxes, 5),
        Obstacles(unseen, _rows(hidden, 3)),
        tuple(moving),
        chargers,
    )


def _floor(
    read: dict[str, Any], name: str, count: int, key: str, most: float, unit: str = ''
) -> Array:
    """Return discs on the floor, and a number of each from 0 to ``most``, shape (k, 4)."""
    rows = [
        (
            *_disc(where, each),
            yaml_loader.check_number(each[key], f'{where}.{key}', 0.0, most, unit),
        )
        for where, each in _entries(read, name, count, ('center', 'radius', key))
    ]
    return _rows(rows, 4)


def _flag(read: dict[str, Any], where: str, key: str) -> bool:
    return yaml_loader.check_flag(read.get(key, False), f'{where}.{key}')


def _moving(where: str, read: dict[str, Any]) -> MovingDisc:
    def number(key: str, low: float, high: float, unit: str, default: float = 0.0) -> float:
        value = read.get(key, default)
        return yaml_loader.check_number(value, f'{where}.{key}', low, high, unit)

    given = yaml_loader.check_list(read['points'], f'{where}.points', 1, MAX_SEGMENTS)
    points = [_pair(point, f'{where}.points[{index}]') for index, point in enumerate(given)]
    return MovingDisc(
        number('radius', MIN_SIZE, MAX_COORDINATE, 'm'),
        _rows(points, 2),
        number('speed', 0.0, MAX_SPEED, 'm/s'),
        number('start', 0.0, math.inf, 's'),
        number('appears', 0.0, math.inf, 's'),
        number('vanishes', 0.0, math.inf, 's', math.inf),
        _flag(read, where, 'repeat'),
        _flag(read, where, 'unseen'),
    )


def _without(rows: Array, others: Array) -> Array:
    """Return the rows that are none of the others; the same array where there are no others."""
    if not len(others):
        return rows
    found: Array = rows[~(rows[:, None, :] == others[None, :, :]).all(axis=2).any(axis=1)]
    return found


def _wall(read: dict[str, Any], where: str) -> Iterator[tuple[float, ...]]:
    closed = _flag(read, where, 'closed')
    given = yaml_loader.check_list(
        read['points'], f'{where}.points', 3 if closed else 2, MAX_SEGMENTS + 1
    )
    points = [_pair(point, f'{where}.points[{index}]') for index, point in enumerate(given)]
    for index in range(0 if closed else 1, len(points)):
        length = math.dist(points[index - 1], points[index])
        if length < MIN_SIZE:
            last = '; leave the last point out, closed adds it' if index == 0 else ''
            raise yaml_loader.EntryError(
                f'{where}.points[{index}] must be at least {MIN_SIZE:g} m from the point before '
                f'it: got {length:g} m{last}'
            )
        yield *points[index - 1], *points[index]


def _box(read: dict[str, Any], where: str) -> tuple[float, float, float, float, float]:
    # More than a full turn is a yaw in degrees.
    yaw = yaml_loader.check_number(
        read.get('yaw', 0.0), f'{where}.yaw', -math.tau, math.tau, 'rad'
    )
    size = _pair(read['size'], f'{where}.size', MIN_SIZE)
    return *_pair(read['center'], f'{where}.center'), *size, yaw


def _disc(where: str, read: dict[str, Any]) -> tuple[float, float, float]:
    radius = yaml_loader.check_number(
        read['radius'], f'{where}.radius', MIN_SIZE, MAX_COORDINATE, 'm'
    )
    return *_pair(read['center'], f'{where}.center'), radius


def _sides(
    x: float, y: float, length: float, width: float, yaw: float
) -> Iterator[tuple[float, ...]]:
    """Return the four sides of a box, counter-clockwise."""
    cosine, sine = 0.5 * math.cos(yaw), 0.5 * math.sin(yaw)
    corners = [
        (x + cosine * length * p - sine * width * q, y + sine * length * p + cosine * width * q)
        for p, q in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    for index in range(4):
        yield *corners[index - 1], *corners[index]


def _entries(
    read: dict[str, Any], name: str, most: int, needed: tuple[str, ...], *optional: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    for index, content in enumerate(yaml_loader.check_list(read.get(name, []), name, 0, most)):
        where = f'{name}[{index}]'
        yield where, yaml_loader.check_entry(content, where, needed, optional)


def _pair(content: object, where: str, low: float = -MAX_COORDINATE) -> tuple[float, float]:
    x, y = yaml_loader.check_list(content, where, 2, 2)
    return (
        yaml_loader.check_number(x, f'{where}[0]', low, MAX_COORDINATE, 'm'),
        yaml_loader.check_number(y, f'{where}[1]', low, MAX_COORDINATE, 'm'),
    )


def _check_count(count: int) -> None:
    if count > MAX_SEGMENTS:
        raise yaml_loader.EntryError(
            f'walls and boxes must have at most {MAX_SEGMENTS} segments together: '
            f'got {count} or more'
        )


def _rows(rows: Sequence[tuple[float, ...]], width: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def join_walls(segments: Array) -> Array:
    """Return the walls with every point of contact an end of all walls there, shape (n', 4).

    Ends within :data:`JOIN_TOLERANCE` of one another become bit-equal; a wall on which another
    one ends is split there, and duplicates are removed. Crossing walls are unchanged: at a
    crossing the bumper is always in a corner. Each wall (m, shape (n, 4)) is longer than twice
    the tolerance.
    """
    points: Array = segments.reshape(-1, 2).copy()
    for index in range(1, len(points)):
        near = np.hypot(*(points[:index] - points[index]).T) <= JOIN_TOLERANCE
        if near.any():
            points[index] = points[int(near.argmax())]
    joined: dict[tuple[tuple[float, ...], ...], tuple[float, ...]] = {}
    for start, end in points.reshape(-1, 2, 2):
        stops = [start, *_ends_between(start, end, points), end]
        for here, there in zip(stops, stops[1:], strict=False):
            ends = tuple(here.tolist()), tuple(there.tolist())
            joined.setdefault(tuple(sorted(ends)), (*ends[0], *ends[1]))
    return np.array(list(joined.values()), dtype=np.float64).reshape(-1, 4)


def _ends_between(start: Array, end: Array, points: Array) -> list[Array]:
    """Return the points on a wall between its ends, in order from its start."""
    length = float(np.hypot(*(end - start)))
    direction = (end - start) / length
    away = points - start
    along = away @ direction
    off = np.abs(away @ np.array([-direction[1], direction[0]]))
    # Ends within the tolerance of the ends of this wall are equal to them already.
    on = np.flatnonzero(
        (off <= JOIN_TOLERANCE)
        & (along > 0.5 * JOIN_TOLERANCE)
        & (along < length - 0.5 * JOIN_TOLERANCE)
    )
    between = {tuple(points[index].tolist()): index for index in on[np.argsort(along[on])]}
    return [points[index] for index in between.values()]


@kernel
def cast_ray(x: float, y: float, direction: float, segments: Array, circles: Array) -> float:
    """Return the distance (m) from (x, y) to the first wall in a direction; inf if there is none.

    From inside a circle it is the distance to that circle. Touching an end point is a hit; a
    wall has no thickness, so rounding decides whether a wall exactly edge-on is hit.

    x, y : m; direction : rad from the x axis of the world
    """
    cosine, sine = math.cos(direction), math.sin(direction)
    nearest = math.inf
    for row in range(segments.shape[0]):
        start_x, start_y = segments[row, 0] - x, segments[row, 1] - y
        end_x, end_y = segments[row, 2] - x, segments[row, 3] - y
        # The side of the ray on which an end lies depends on that end alone. Two walls that share
        # it get the same sign, however it is rounded, so no ray passes between them.
        start_off = cosine * start_y - sine * start_x
        end_off = cosine * end_y - sine * end_x
        if (start_off > 0.0 and end_off > 0.0) or (start_off < 0.0 and end_off < 0.0):
            continue
        start_on = cosine * start_x + sine * start_y
        end_on = cosine * end_x + sine * end_y
        if start_off != end_off:
            distance = (start_on * end_off - end_on * start_off) / (end_off - start_off)
        elif start_on * end_on <= 0.0:
            distance = 0.0  # both ends are on the line of the ray, which starts between them
        else:
            distance = min(start_on, end_on)
        if 0.0 <= distance < nearest:
            nearest = distance
    for row in range(circles.shape[0]):
        to_x, to_y = circles[row, 0] - x, circles[row, 1] - y
        off = cosine * to_y - sine * to_x
        square = (circles[row, 2] - off) * (circles[row, 2] + off)
        if square < 0.0:
            continue
        middle, half = cosine * to_x + sine * to_y, math.sqrt(square)
        distance = middle - half
        if distance < 0.0:
            distance = middle + half
        if 0.0 <= distance < nearest:
            nearest = distance
    return nearest


@kernel
def cast_rays(
    x: float,
    y: float,
    yaw: float,
    mounts: Array,
    which: npt.NDArray[np.int64],
    segments: Array,
    circles: Array,
    out: Array,
) -> None:
    """Write the distances of some sensors on the body into ``out``, see :func:`cast_ray`.

    x, y, yaw : pose of the body, m, m, rad
    mounts : shape (s, 3), of each sensor x (m, forward), y (m, to the left), direction (rad),
        in the frame of the body
    which : int64, the rows of ``mounts`` to use
    out : shape (s,), m; ``out[row]`` is written for each row in ``which``, the others are kept
    """
    cosine, sine = math.cos(yaw), math.sin(yaw)
    for index in range(which.size):
        row = which[index]
        forward, left = mounts[row, 0], mounts[row, 1]
        out[row] = cast_ray(
            x + cosine * forward - sine * left,
            y + sine * forward + cosine * left,
            yaw + mounts[row, 2],
            segments,
            circles,
        )


@kernel
def nearest_on_segment(
    x: float, y: float, ax: float, ay: float, bx: float, by: float
) -> tuple[float, float]:
    """Return the point of the segment from a to b that is nearest to (x, y), all in m.

    If it is an end, it is bit-equal to that end.
    """
    run_x, run_y = bx - ax, by - ay
    along = (x - ax) * run_x + (y - ay) * run_y
    length_squared = run_x * run_x + run_y * run_y
    if along <= 0.0:
        return ax, ay
    if along >= length_squared:
        return bx, by
    share = along / length_squared
    return ax + share * run_x, ay + share * run_y


@kernel
def clearance(x: float, y: float, segments: Array, circles: Array) -> float:
    """Return the distance (m) from (x, y) to the nearest wall, on either side; inf without walls.

    Inside a box or circle it is the distance to its wall:
    :meth:`~t3mpc_ros.simulation.world.World.is_free` distinguishes inside and outside.
    """
    least = math.inf
    for row in range(segments.shape[0]):
        near_x, near_y = nearest_on_segment(
            x, y, segments[row, 0], segments[row, 1], segments[row, 2], segments[row, 3]
        )
        least = min(least, (x - near_x) * (x - near_x) + (y - near_y) * (y - near_y))
    least = math.sqrt(least)
    for row in range(circles.shape[0]):
        centre = math.hypot(x - circles[row, 0], y - circles[row, 1])
        least = min(least, abs(centre - circles[row, 2]))
    return least


@kernel
def grip_at(x: float, y: float, patches: Array) -> float:
    """Return the grip factor of the tyres at (x, y): 1 outside all patches.

    Where patches overlap the lowest grip applies.
    """
    grip = 1.0
    for row in range(patches.shape[0]):
        to_x, to_y = x - patches[row, 0], y - patches[row, 1]
        if to_x * to_x + to_y * to_y <= patches[row, 2] * patches[row, 2]:
            grip = min(grip, patches[row, 3])
    return grip


def compile_kernels(mounts: Array) -> None:
    """Compile the kernels that an empty plain does not need; ``mounts``: see cast_rays."""
    room, count = load_world('room'), len(mounts)
    clearance(0.0, 0.0, *room.obstacles)
    grip_at(0.0, 0.0, room.patches)
    cast_rays(0.0, 0.0, 0.0, mounts, np.arange(count), *room.seen, np.empty(count))
