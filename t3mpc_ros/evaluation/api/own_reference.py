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
"""References of a script: an array, a CSV file, way points, or a function of time."""

from collections.abc import Callable
import csv
from dataclasses import dataclass
import math
import os
from pathlib import Path
from typing import Any
import warnings

import numpy as np
from numpy.exceptions import ComplexWarning
from numpy.typing import ArrayLike, NDArray

from t3mpc_ros.evaluation.api.one_sentence_errors import described, one_sentence
from t3mpc_ros.evaluation.baselines.baseline_controller import JUMP
from t3mpc_ros.evaluation.run_record import RATE
from t3mpc_ros.evaluation.scenario import SampledReference
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheel_speeds
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.script_error import ScriptError

TIME = 'time'
MAX_SPEED = 200.0
"""Upper end of the range of ``wheel.max_velocity``, rad/s."""
WHEELS, TWIST = ('right', 'left'), ('linear', 'angular')
"""Columns of a CSV file beside the time: wheel speeds (rad/s), or m/s and rad/s of the body."""


@dataclass(frozen=True, eq=False)
class Waypoints:
    """A smooth path through points of the plane, driven at a constant speed from its first point.

    The path is a natural cubic spline over the length of the chords. The robot starts with the
    direction of the path, gains speed and brakes before the end with constant acceleration, and
    stands there.

    Parameters
    ----------
    points
        x and y, m, shape (n, 2), n >= 2; neighbours differ.
    speed, acceleration
        m/s and m/s², along the path.
    """

    points: ArrayLike
    speed: float = 0.2
    acceleration: float = 0.3

    @one_sentence
    def __post_init__(self) -> None:
        points = numbers('points', self.points, '(n, 2), x and y in m')
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise ScriptError(f'points must have the shape (n, 2), n >= 2: got {points.shape}')
        if not np.hypot(*np.diff(points, axis=0).T).all():
            raise ScriptError('points must differ from their neighbours: got two that are equal')
        for name in ('speed', 'acceleration'):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0.0 < value < math.inf):
                raise ScriptError(f'{name} must be a positive number: got {value!r}')
        object.__setattr__(self, 'points', points)

    def twists(self, times: Array) -> Array:
        """Return linear (m/s) and angular speed (rad/s) at times (s), shape (n, 2)."""
        points = np.asarray(self.points, dtype=np.float64)
        knots = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
        fine = np.linspace(0.0, knots[-1], 200 * (len(knots) - 1) + 1)
        x, y = (_natural_spline(knots, column, fine) for column in points.T)
        length = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
        dx, dy = np.gradient(x, length), np.gradient(y, length)
        curvature = dx * np.gradient(dy, length) - dy * np.gradient(dx, length)
        driven, speed = self._progress(times, float(length[-1]))
        return np.column_stack([speed, speed * np.interp(driven, length, curvature)])

    def _progress(self, times: Array, length: float) -> tuple[Array, Array]:
        """Return the length driven (m) and the speed (m/s) at times: a trapezoid of speed."""
        top = min(self.speed, math.sqrt(self.acceleration * length))
        ramp = top / self.acceleration
        end = length / top + ramp
        speed = np.clip(self.acceleration * np.minimum(times, end - times), 0.0, top)
        rising = 0.5 * self.acceleration * np.minimum(times, ramp) ** 2
        even = top * np.clip(times - ramp, 0.0, end - 2.0 * ramp)
        left = np.clip(end - times, 0.0, ramp)
        falling = 0.5 * self.acceleration * (ramp**2 - left**2)
        return rising + even + falling, speed


def _natural_spline(knots: Array, values: Array, at: Array) -> Array:
    """Return the natural cubic spline through ``values`` at some places."""
    count, step = len(knots), np.diff(knots)
    matrix, right = np.eye(count), np.zeros(count)
    for i in range(1, count - 1):
        matrix[i, i - 1 : i + 2] = step[i - 1], 2.0 * (step[i - 1] + step[i]), step[i]
        slopes = (values[i + 1] - values[i]) / step[i], (values[i] - values[i - 1]) / step[i - 1]
        right[i] = 6.0 * (slopes[0] - slopes[1])
    second = np.linalg.solve(matrix, right)
    k = np.clip(np.searchsorted(knots, at, side='right') - 1, 0, count - 2)
    h, before, behind = step[k], at - knots[k], knots[k + 1] - at
    return (
        (second[k] * behind**3 + second[k + 1] * before**3) / (6.0 * h)
        + (values[k] / h - second[k] * h / 6.0) * behind
        + (values[k + 1] / h - second[k + 1] * h / 6.0) * before
    )


def sampled(source: Any, duration: float, geometry: WheelGeometry) -> SampledReference:
    """Return a reference of one's own, sampled for ``duration`` seconds and one more."""
    rows = round(duration * RATE) + round(RATE)
    time = np.arange(rows) / RATE
    if isinstance(source, Waypoints):
        speeds = _wheels(source.twists(time), geometry)
    elif isinstance(source, str | os.PathLike):
        speeds = read_csv(Path(source), time, duration, geometry)
    elif callable(source):
        speeds = np.array([_row(source, t) for t in time.tolist()])
    else:
        given = numbers('reference', source, '(n, 2)')
        if given.ndim != 2 or given.shape[1] != 2 or len(given) < 2:
            raise ScriptError(
                'reference must have the shape (n, 2), n >= 2: right and left wheel speed in '
                f'rad/s, {RATE:g} rows a second: got {given.shape}'
            )
        _check_span('reference', 0.0, (len(given) - 1) / RATE, duration)
        speeds = given[np.minimum(np.arange(rows), len(given) - 1)]
    if (fastest := np.max(np.abs(speeds))) > MAX_SPEED:
        raise ScriptError(
            f'reference must be from {-MAX_SPEED:g} to {MAX_SPEED:g} rad/s, the highest '
            f'wheel speed that a robot may have: got {fastest:.4g} rad/s'
        )
    # A row jumps that leaves the line of the two rows before by a switch's change.
    change = np.zeros_like(speeds)
    change[2:] = speeds[2:] - 2.0 * speeds[1:-1] + speeds[:-2]
    switched: NDArray[np.bool_] = np.max(np.abs(change), axis=1) > JUMP
    switched[1:] &= ~switched[:-1]  # the row after a jump leaves the line of the jump
    modes = np.cumsum(switched, dtype=np.int64)
    return SampledReference(time, speeds, _slopes(speeds, switched), modes, switched)


def _check_span(name: str, first: float, last: float, duration: float) -> None:
    """Raise :class:`ScriptError` unless times (s) from first to last are those of a run.

    Beyond them a row would be held, and the robot would be judged by how it stands.
    """
    if first > 1.0 / RATE:
        raise ScriptError(
            f'{name} must begin at 0 s, where the run begins: got {first:.10g} s; subtract the '
            'first time from all'
        )
    if last < duration - 1.5 / RATE:
        raise ScriptError(
            f'{name} must last as long as the run, {duration:g} s: got {last:.4g} s; choose a '
            'shorter duration, or repeat the last row if the robot is to go on with it'
        )


def numbers(name: str, given: Any, shape: str) -> Array:
    """Return finite numbers as an array, or raise :class:`ScriptError` with the name."""
    try:
        with warnings.catch_warnings(action='error', category=ComplexWarning):
            found = np.array(given, dtype=np.float64)
    except ComplexWarning:
        raise ScriptError(f'{name} must be real numbers: got complex ones') from None
    except (TypeError, ValueError):
        raise ScriptError(
            f'{name} must be numbers of the shape {shape}: got {type(given).__name__} '
            f'{_short(given)}'
        ) from None
    if not np.isfinite(found).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(found))[0])
        raise ScriptError(f'{name} must be finite: got {found[place]} at {list(place)}')
    return found


def _short(given: Any) -> str:
    text = repr(given)
    return text if len(text) <= 60 else f'{text[:57]}...'


def _row(function: Callable[[float], Any], time: float) -> Array:
    try:
        given = function(time)
    except Exception as error:
        raise ScriptError(f'reference raised {described(error)}, at {time:g} s') from None
    found = numbers(f'reference({time:g})', given, '(2,)')
    if found.shape != (2,):
        raise ScriptError(
            f'reference({time:g}) must be two numbers, the speeds of the right and the left wheel '
            f'in rad/s: got {_short(given)}'
        )
    return found


def read_csv(path: Path, time: Array, duration: float, geometry: WheelGeometry) -> Array:
    """Return wheel speeds (rad/s) at some times from a CSV file, interpolated, shape (n, 2).

    Its first line names the columns: ``time`` (s) with ``right`` and ``left`` (rad/s), or with
    ``linear`` (m/s) and ``angular`` (rad/s). It lasts for the run; the last row is held after it.
    """
    try:
        with path.expanduser().open(newline='', encoding='utf-8-sig') as stream:
            head, *rows = [row for row in csv.reader(stream) if row] or [[]]
    except OSError as error:
        raise ScriptError(f'{path} cannot be read: {error.strerror}') from None
    except (UnicodeDecodeError, csv.Error):
        raise ScriptError(f'{path} must be a CSV file: got one that is no text in UTF-8') from None
    names = [name.strip() for name in head]
    kind = next((pair for pair in (WHEELS, TWIST) if {TIME, *pair} <= {*names}), None)
    if kind is None:
        raise ScriptError(
            f'{path} must have the columns time,right,left (s, rad/s) or time,linear,angular '
            f'(s, m/s, rad/s) in its first line: got {",".join(names)}'
        )
    places = [names.index(name) for name in (TIME, *kind)]
    try:
        table = np.array([[float(row[i]) for i in places] for row in rows]).reshape(-1, 3)
    except (IndexError, ValueError) as error:
        raise ScriptError(f'{path} must hold a number in each cell: {error}') from None
    table = numbers(str(path), table, '(n, 3)')
    if len(table) < 2 or not (np.diff(table[:, 0]) > 0.0).all():
        raise ScriptError(f'{path} must have two rows or more, with ascending times')
    _check_span(str(path), float(table[0, 0]), float(table[-1, 0]), duration)
    found = np.column_stack([np.interp(time, table[:, 0], table[:, i]) for i in (1, 2)])
    return found if kind == WHEELS else _wheels(found, geometry)


def _wheels(twists: Array, geometry: WheelGeometry) -> Array:
    """Return wheel speeds (rad/s) of rows of linear and angular speed, shape (n, 2)."""
    linear, angular = twists.T
    half = geometry.half_separation
    return np.column_stack(wheel_speeds(linear, angular, geometry.wheel_radius, half))


def _slopes(speeds: Array, switched: NDArray[np.bool_]) -> Array:
    """Return r' (rad/s²) from the rows up to each one: a method without preview gets no future.

    At the start and at a jump, where there are none, it is that of the row after.
    """
    backward = np.zeros_like(speeds)
    backward[1:] = np.diff(speeds, axis=0)
    first = switched.copy()
    first[0] = True
    backward[first] = np.roll(backward, -1, axis=0)[first]
    return backward * RATE
