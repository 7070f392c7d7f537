# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Walls, boxes, pillars and slippery patches, read from a YAML file: see ``docs/worlds.md``.

A file that does not fit is refused, never repaired, and the error says what is wrong where.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import difflib
import math
from pathlib import Path
import re
import reprlib
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml

from t3mpc_ros.robot.arena.joints import join_walls
from t3mpc_ros.robot.arena.rays import clearance

Array = npt.NDArray[np.float64]

SHIPPED = Path(__file__).resolve().parent / 'worlds'
"""Where the worlds are that come with the package."""
FARTHEST = 1000.0
"""m: bound of every coordinate and size."""
SMALLEST = 0.01
"""m: bound of every size. What is thinner than a bumper gives way would push it on both sides."""
MOST_SEGMENTS = 2000
"""Straight pieces of wall, those of boxes included: each is looked at by each ray and step."""
MOST_CIRCLES = 500
MOST_PATCHES = 100
LARGEST_FILE = 1_000_000
"""Bytes."""
_LIKE_A_NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?', re.IGNORECASE)


class WorldError(ValueError):
    """A world that cannot be used; the text names the file, the entry, the bound and the value."""


class Extent(NamedTuple):
    """The smallest upright rectangle around everything there is."""

    left: float
    """m"""
    bottom: float
    """m"""
    right: float
    """m"""
    top: float
    """m"""


@dataclass(frozen=True, eq=False)
class World:
    """What stands around the robot, as the arrays that the kernels read; not to be written to.

    They are not locked against that: the compiler would build every kernel once more for arrays
    that are.
    """

    name: str
    segments: Array
    """Straight pieces of wall, shape (n, 4): ax, ay, bx, by, m; those of boxes too."""
    circles: Array
    """Pillars, shape (m, 3): x, y, radius, m."""
    patches: Array
    """Slippery floor, shape (k, 4): x, y, radius (m), grip (part of the tyres' own, 0 to 1)."""
    boxes: Array
    """For the inside, shape (b, 5): x, y, length, width (m), heading of the length (rad)."""

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Decide whether a disc at (x, y) touches no wall and is in no box or circle, all in m.

        What is not finite is not free.

        Raises
        ------
        ValueError
            The radius is negative.
        """
        if radius < 0.0:
            raise ValueError(f'radius must be at least 0 m: got {radius:g}')
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(radius)):
            return False
        x, y = float(x), float(y)  # an int would make the compiler build the kernel once more
        if clearance(x, y, self.segments, self.circles) < radius:
            return False
        if np.any(np.hypot(x - self.circles[:, 0], y - self.circles[:, 1]) <= self.circles[:, 2]):
            return False
        away_x, away_y = x - self.boxes[:, 0], y - self.boxes[:, 1]
        cosine, sine = np.cos(self.boxes[:, 4]), np.sin(self.boxes[:, 4])
        along, across = cosine * away_x + sine * away_y, cosine * away_y - sine * away_x
        inside = (2.0 * abs(along) <= self.boxes[:, 2]) & (2.0 * abs(across) <= self.boxes[:, 3])
        return not inside.any()

    @property
    def extent(self) -> Extent:
        """What a picture has to show; all zero where there is nothing."""
        discs = np.vstack([self.circles, self.patches[:, :3]])
        corners = [self.segments.reshape(-1, 2)]
        corners += [discs[:, :2] + side * discs[:, 2:] for side in (-1.0, 1.0)]
        points = np.vstack(corners)
        if not len(points):
            return Extent(0.0, 0.0, 0.0, 0.0)
        return Extent(*points.min(axis=0).tolist(), *points.max(axis=0).tolist())


def shipped_worlds() -> tuple[str, ...]:
    """Return the names of the worlds that come with the package."""
    return tuple(sorted(path.stem for path in SHIPPED.glob('*.yaml')))


def load_world(path_or_name: str | Path) -> World:
    """Return a world by the name of a shipped one, else by the path of a file.

    An empty name is the empty plain. A file of your own that has the name of a shipped world is
    reached with its folder: ``./room``.

    Raises
    ------
    WorldError
        There is no such world, or the file does not hold one.
    """
    if path_or_name == '':
        return parse_world('name: plain', 'plain')
    names = shipped_worlds()
    path = Path(path_or_name)
    if path_or_name in names:
        path = SHIPPED / f'{path_or_name}.yaml'
    try:
        with path.open('rb') as file:
            content = file.read(LARGEST_FILE + 1)
        if len(content) > LARGEST_FILE:
            raise WorldError(f'{path} must have at most {LARGEST_FILE} bytes: it has more')
        text = content.decode('utf-8')
    except FileNotFoundError:
        raise WorldError(
            f'there is no world {path_or_name}, neither a file nor one of '
            f'{", ".join(names)}{_near(str(path_or_name), names)}'
        ) from None
    except OSError as error:
        raise WorldError(f'{path} cannot be read: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise WorldError(f'{path} must be UTF-8 text: {error}') from error
    return parse_world(text, str(path))


def parse_world(text: str, source: str) -> World:
    """Return the world that a YAML text describes.

    Parameters
    ----------
    text
        See ``docs/worlds.md``.
    source
        What the errors call it; without ``name`` in the text, its stem is the world's name.

    Raises
    ------
    WorldError
        Names ``source``, the entry, the bound and the value.
    """
    try:
        return _world(_parsed(text), Path(source).stem)
    except WorldError as error:
        raise WorldError(f'{source}: {error}') from error.__cause__


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, where YAML would keep the last one in silence."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        seen: set[str] = set()
        for key in (key for key, _ in pairs if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                line = key.start_mark.line + 1
                raise WorldError(f'{key.value} is given twice in one entry, at line {line}')
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _parsed(text: str) -> object:
    try:
        return yaml.load(text, Loader=_Loader)
    except WorldError:
        raise
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        line = f'line {mark.line + 1}: ' if mark else ''
        problem = getattr(error, 'problem', None) or str(error)
        raise WorldError(f'not YAML: {line}{problem}') from error
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        # What the parser lets through: a date that is none, brackets without end, !!int without
        # digits.
        raise WorldError(f'not YAML that can be read: {error}') from error


def _world(content: object, stem: str) -> World:
    read = _entry(content, 'the world', (), ('name', 'walls', 'boxes', 'circles', 'patches'))
    name = read.get('name', stem)
    if not isinstance(name, str) or not name:
        raise WorldError(f'name must be a text: got {reprlib.repr(name)}')
    pieces: list[tuple[float, ...]] = []
    for where, wall in _entries(read, 'walls', MOST_SEGMENTS):
        pieces += _wall(wall, where)
        _check_count(len(pieces))
    boxes = []
    for where, box in _entries(read, 'boxes', MOST_SEGMENTS // 4):
        boxes.append(_box(box, where))
        pieces += _sides(*boxes[-1])
        _check_count(len(pieces))
    segments = join_walls(_rows(pieces, 4))
    _check_count(len(segments))
    circles = [_circle(*each, ()) for each in _entries(read, 'circles', MOST_CIRCLES)]
    patches = [_circle(*each, ('grip',)) for each in _entries(read, 'patches', MOST_PATCHES)]
    return World(name, segments, _rows(circles, 3), _rows(patches, 4), _rows(boxes, 5))


def _wall(content: object, where: str) -> Iterator[tuple[float, ...]]:
    read = _entry(content, where, ('points',), ('closed',))
    closed = read.get('closed', False)
    if not isinstance(closed, bool):
        raise WorldError(f'{where}.closed must be true or false: got {reprlib.repr(closed)}')
    least = 3 if closed else 2
    given = _list(read['points'], f'{where}.points', least, MOST_SEGMENTS + 1)
    points = [_point(point, f'{where}.points[{index}]') for index, point in enumerate(given)]
    for index in range(0 if closed else 1, len(points)):
        length = math.dist(points[index - 1], points[index])
        if length < SMALLEST:
            last = '; leave the last point out, closed adds it' if index == 0 else ''
            raise WorldError(
                f'{where}.points[{index}] must be at least {SMALLEST:g} m from the point before '
                f'it: got {length:g} m{last}'
            )
        yield *points[index - 1], *points[index]


def _box(content: object, where: str) -> tuple[float, ...]:
    read = _entry(content, where, ('center', 'size'), ('heading',))
    size = _list(read['size'], f'{where}.size', 2, 2)
    # More than a full turn is a heading in degrees.
    return (
        *_point(read['center'], f'{where}.center'),
        *(_number(size[i], f'{where}.size[{i}]', SMALLEST, FARTHEST, ' m') for i in (0, 1)),
        _number(read.get('heading', 0.0), f'{where}.heading', -math.tau, math.tau, ' rad'),
    )


def _sides(
    x: float, y: float, length: float, width: float, heading: float
) -> Iterator[tuple[float, ...]]:
    """Return the four sides of a box, counter-clockwise."""
    cosine, sine = 0.5 * math.cos(heading), 0.5 * math.sin(heading)
    corners = [
        (x + cosine * length * p - sine * width * q, y + sine * length * p + cosine * width * q)
        for p, q in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    for index in range(4):
        yield *corners[index - 1], *corners[index]


def _circle(where: str, content: object, more: tuple[str, ...]) -> tuple[float, ...]:
    read = _entry(content, where, ('center', 'radius', *more), ())
    return (
        *_point(read['center'], f'{where}.center'),
        _number(read['radius'], f'{where}.radius', SMALLEST, FARTHEST, ' m'),
        *(_number(read[name], f'{where}.{name}', 0.0, 1.0, '') for name in more),
    )


def _entry(
    content: object, where: str, needed: tuple[str, ...], optional: tuple[str, ...]
) -> dict[str, Any]:
    known = (*needed, *optional)
    if not isinstance(content, dict):
        raise WorldError(
            f'{where} must hold {", ".join(known)} by name: got {reprlib.repr(content)}'
        )
    for name in content:
        if name not in known:
            near = _near(str(name), known) or f'; known are {", ".join(known)}'
            raise WorldError(f'{where} has no {reprlib.repr(name)}{near}')
    for name in needed:
        if name not in content:
            raise WorldError(f'{where} must have a {name}')
    return content


def _entries(read: dict[str, Any], name: str, most: int) -> Iterator[tuple[str, object]]:
    for index, entry in enumerate(_list(read.get(name, []), name, 0, most)):
        yield f'{name}[{index}]', entry


def _list(content: object, where: str, least: int, most: int) -> list[Any]:
    if not isinstance(content, list):
        raise WorldError(f'{where} must be a list: got {reprlib.repr(content)}')
    if not least <= len(content) <= most:
        span = f'{least}' if least == most else f'from {least} to {most}'
        raise WorldError(f'{where} must have {span} entries: got {len(content)}')
    return content


def _point(content: object, where: str) -> tuple[float, float]:
    x, y = _list(content, where, 2, 2)
    return (
        _number(x, f'{where}[0]', -FARTHEST, FARTHEST, ' m'),
        _number(y, f'{where}[1]', -FARTHEST, FARTHEST, ' m'),
    )


def _number(content: object, where: str, low: float, high: float, unit: str) -> float:
    bounds = f'{where} must be a number from {low:g} to {high:g}{unit}'
    if isinstance(content, bool) or not isinstance(content, int | float):
        # PyYAML wants a digit between sign and point, and an exponent with point and sign.
        like_one = isinstance(content, str) and _LIKE_A_NUMBER.fullmatch(content)
        hint = ', a text to YAML; write numbers like -0.9 or 1.0e-3' if like_one else ''
        raise WorldError(f'{bounds}: got {reprlib.repr(content)}{hint}')
    if not low <= content <= high:  # false for NaN, too
        raise WorldError(f'{bounds}: got {reprlib.repr(content)}')
    return float(content)


def _check_count(count: int) -> None:
    if count > MOST_SEGMENTS:
        raise WorldError(
            f'walls and boxes must have at most {MOST_SEGMENTS} straight pieces together: '
            f'got {count} or more'
        )


def _rows(rows: list[tuple[float, ...]], width: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _near(name: str, known: tuple[str, ...]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f'; did you mean {near[0]}?' if near else ''
