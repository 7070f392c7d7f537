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
r"""Smoothing of a given path: no more than its speed needs, and never beyond a tolerance.

Points of planners lie on grids, have noise, or are far apart; a robot that rounds each of them
crawls. The polyline :math:`p(s)` over its length is therefore convolved with Gaussian windows of
several widths, :math:`x_k = G_{\sigma_k} * p`, and at each :math:`s` two of them are blended:

* *allowed* are the widths below the first one with :math:`|x_k(s) - p(s)|` above the tolerance.
  A blend of two points within a disc around :math:`p(s)` lies within it, too: the tolerance holds
  for any blend, from the curve to the path and from the path to the curve.
* *needed* is the smallest of the widths allowed whose local time, from the limits of yaw rate and
  yaw acceleration, is within 3 % of the least: a smooth path stays as it is.

The width changes by a bounded slope over the length, so that the blend itself is smooth. A cusp
remains one: the window shortens it by less than the tolerance.

A path that replaces another one is joined by a polynomial of degree five, whose position,
direction and curvature are at both ends those of the curves.
"""

from collections.abc import Iterator
import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import MotionLimits, PathEnd
from t3mpc_ros.geometry.polyline import distance_to_path, lengths_along
from t3mpc_ros.geometry.types import Array, Pose, wrap_angle

SPACING = 0.005
"""Distance along the given path of the points of the smoothed one, m."""
LEAST_TOLERANCE = SPACING
"""Smallest tolerance, m: below it the points themselves are too far apart."""
SHARE = 0.95
"""Share of the tolerance that smoothing uses; the timing rounds the rest of the corners."""
WIDTHS = (0.01, 0.0125, 0.015, 0.0185, 0.022, 0.027, 0.033, 0.04, 0.05, 0.06, 0.075, 0.09, 0.11)
"""Standard deviations of the windows, m; before the first one there is the path as given."""
REACH = 3.5
"""Half a window in standard deviations."""
RAMP = 12
"""Points over which the width changes from one of the list to the next."""
LEVEL = 36
"""Points over which it falls by one where a wider one is not needed: a change bends the curve."""
BLUR = 8
"""Points before and after over which the width is averaged."""
NEAR = 12
"""Points before and after whose time counts for a choice."""
PIECE = 400
"""Points of the smoothed path made at a time."""
MARGIN = (
    math.ceil(REACH * WIDTHS[-1] / SPACING) + (RAMP + LEVEL) * len(WIDTHS) + 2 * BLUR + NEAR + 4
)
"""Points before and after a piece that determine it."""
SLOWER = 1.03
"""Local time of a width, as a multiple of the least, from which on a larger one is needed."""
RESERVE = 0.5
"""Share of the yaw acceleration that a change of the curvature at a steady speed may take."""
JOINTS = (0.05, 0.08, 0.12, 0.18, 0.27, 0.4, 0.6, 0.9, 1.4)
"""Lengths of the new path, from its nearest place on, that a joint may leave out, m."""
HASTE = 0.05
"""Time by which a longer joint must be faster, s."""
DETOUR = 0.1
"""Distance that a path to the side is worth where a moving robot joins, m; twice for one back."""
SHARP = 1.2
STANDING_SHARP = 0.3
"""Differences of directions at a joint from which on the robot stops and turns, rad."""


class SmoothedPath:
    """A path smoothed piece by piece: its cost is that of what is driven.

    points    : given path, m, shape (n, 2), finite
    tolerance : largest distance from it, m; 0: the path as given
    closed    : the last point is the first one, and the path is driven again and again
    """

    def __init__(
        self,
        points: Array,
        tolerance: float,
        limits: MotionLimits,
        geometry: WheelGeometry,
        *,
        closed: bool = False,
    ) -> None:
        if tolerance < 0.0 or 0.0 < tolerance < LEAST_TOLERANCE:
            raise ValueError(f'tolerance must be 0 or from {LEAST_TOLERANCE} m: got {tolerance} m')
        self.points = points
        """Given path, m, shape (n, 2)."""
        self.tolerance = tolerance
        """m"""
        self._limits, self._geometry, self._closed = limits, geometry, closed
        self._lengths = lengths_along(points)
        self.length = float(self._lengths[-1])
        """Length of the given path, m."""
        self._count = max(1, math.ceil(self.length / SPACING))
        self._windows = [_window(width) for width in WIDTHS]

    def pieces(self, begin: float = 0.0) -> Iterator[Array]:
        """Yield the points (m) of the smoothed path from a length (m) of the given one on."""
        if self.tolerance == 0.0 or self.length <= 0.0:
            yield self.points[int(np.searchsorted(self._lengths, begin)) :]
            return
        first = min(math.ceil(begin / self.length * self._count), self._count)
        while first <= self._count:
            end = min(first + PIECE, self._count + 1)
            yield self._piece(first, end)
            first = end

    def nearest(self, end: PathEnd) -> tuple[float, float]:
        """Return the length (m) at which a robot joins the path, and its distance from there (m).

        It is the first place that is within the tolerance as near as any other one. For a robot
        that drives, a place where the path leads elsewhere counts as farther away.
        """
        starts, runs = self.points[:-1], np.diff(self.points, axis=0)
        if len(runs) == 0 or self.length <= 0.0:
            return 0.0, math.hypot(*(self.points[0] - end.pose[:2]))
        away = np.array(end.pose[:2]) - starts
        share = np.clip((away * runs).sum(axis=1) / np.maximum((runs**2).sum(axis=1), 1e-18), 0, 1)
        distance = np.hypot(*(away - share[:, None] * runs).T)
        if end.moving:
            heading = np.array([math.cos(end.pose.yaw), math.sin(end.pose.yaw)])
            forward = runs @ heading / np.maximum(np.hypot(*runs.T), 1e-9)
            distance += DETOUR * (1.0 - forward)
        near = distance <= distance.min() + max(self.tolerance, LEAST_TOLERANCE)
        first = int(np.argmax(near))
        apart = np.flatnonzero(~near[first:])
        last = first + int(apart[0]) if apart.size else len(near)
        best = first + int(np.argmin(distance[first:last]))
        along = self._lengths[best] + share[best] * (self._lengths[best + 1] - self._lengths[best])
        place = starts[best] + share[best] * runs[best]
        return float(along), math.hypot(*(place - end.pose[:2]))

    def joined_pieces(self, end: PathEnd, begin: float) -> Iterator[Array]:
        """Yield the points of the path from a length (m) on, after those of a joint to it."""
        pieces = self.pieces(begin)
        first = next(pieces)
        joint = self._joint(end, first) if self.tolerance else None
        yield self._ahead(end, first) if joint is None else joint
        yield from pieces

    def _ahead(self, end: PathEnd, points: Array) -> Array:
        """Return the rest of ``points`` to which the robot turns, and drives straight."""
        away = points - end.pose[:2]
        distance = np.hypot(*away.T)
        # Not to a place beside the robot, for the sake of a few millimetres.
        far = distance > 2.0 * min(float(distance[0]), self.tolerance)
        if far.any():
            return points[int(np.argmax(far)) :]
        heading = math.cos(end.pose.yaw), math.sin(end.pose.yaw)
        return points[-1:] if float(away[-1] @ heading) > 0.0 else points[:0]

    def _joint(self, end: PathEnd, points: Array) -> Array | None:
        """Return ``points`` with the shortest joint among the fast ones before them, or None."""
        joined: list[tuple[float, Array]] = []
        sharp = SHARP if end.moving else STANDING_SHARP
        farthest = max(self.tolerance, math.hypot(*(points[0] - end.pose[:2])))
        lengths = lengths_along(points)
        spans = [span for span in JOINTS if span < lengths[-1]]
        for span in [*spans, lengths[-1]] if len(points) > 2 else []:
            at = min(int(np.searchsorted(lengths, span)), len(points) - 1)
            target = _end_at(points, at)
            if abs(wrap_angle(target.pose.yaw - end.pose.yaw)) > sharp:
                continue
            curve = join_curve(end, target)
            if distance_to_path(curve[::3], points[: at + 40]).max() > farthest:
                continue
            whole = np.vstack([[end.pose[:2]], curve, points[at + 1 :]])
            time = float(local_times(whole[None], self._limits, self._geometry).sum())
            joined.append((time, whole[1:]))
        least = min((time for time, _ in joined), default=0.0)
        return next((whole for time, whole in joined if time <= least + HASTE), None)

    def _given(self, index: Array) -> Array:
        """Return the given path at grid points; beyond its ends its mirror image in them."""
        along = index * (self.length / self._count)
        if self._closed:
            return self._at(along % self.length)
        before, after = (along < 0.0)[:, None], (along > self.length)[:, None]
        places = self._at(np.clip(along, 0.0, self.length))
        ahead = 2.0 * self.points[0] - self._at(np.clip(-along, 0.0, self.length))
        behind = 2.0 * self.points[-1] - self._at(np.clip(2.0 * self.length - along, 0.0, None))
        return np.where(before, ahead, np.where(after, behind, places))

    def _cuts(self, index: Array, given: Array) -> Array:
        """Return how far the corners of the path are from its chords between grid points, m."""
        step = self.length / self._count
        first, end = np.searchsorted(self._lengths, (index[0] * step, index[-1] * step))
        place = self._lengths[first:end] / step - index[0]
        before = np.minimum(place.astype(np.int64), len(given) - 2)
        share = (place - before)[:, None]
        chords = (1.0 - share) * given[before] + share * given[before + 1]
        distance = np.hypot(*(self.points[first:end] - chords).T)
        cuts = np.zeros(len(given))
        np.maximum.at(cuts, before, distance)
        np.maximum.at(cuts, before + 1, distance)
        return cuts

    def _at(self, along: Array) -> Array:
        return np.column_stack([np.interp(along, self._lengths, each) for each in self.points.T])

    def _piece(self, first: int, end: int) -> Array:
        """Return the smoothed points of some grid points."""
        index = np.arange(first - MARGIN, end + MARGIN, dtype=np.float64)
        given = self._given(index)
        curves = np.stack([given, *(_convolved(given, window) for window in self._windows)])
        away = np.hypot(*(curves - given).transpose(2, 0, 1)) + self._cuts(index, given)
        away = away > SHARE * self.tolerance
        away[0] = False
        allowed = np.where(away.any(axis=0), away.argmax(axis=0) - 1, len(WIDTHS))
        times = local_times(curves, self._limits, self._geometry)
        if not self._closed:  # at an end the robot is at rest
            times[:, (index <= 1) | (index >= self._count)] = 0.0
        near = np.ones(2 * NEAR + 1)
        times = np.stack([np.convolve(row, near, 'same') for row in times])
        times[np.arange(len(curves))[:, None] > allowed] = math.inf
        needed = (times <= SLOWER * times.min(axis=0)).argmax(axis=0)
        level = _sloped(needed.astype(np.float64), allowed.astype(np.float64))
        lower = np.minimum(level.astype(np.int64), len(WIDTHS) - 1)
        share = level - lower
        share = (share * share * (3.0 - 2.0 * share))[:, None]
        rows = np.arange(len(given))
        blend = (1.0 - share) * curves[lower, rows] + share * curves[lower + 1, rows]
        found: Array = blend[MARGIN:-MARGIN]
        return found


def local_times(curves: Array, limits: MotionLimits, geometry: WheelGeometry) -> Array:
    """Return the least time (s) around each point of curves, shape (k, n, 2), as (k, n).

    The speed is limited by yaw rate, wheel speed and yaw acceleration; the time for speeding up
    and slowing down is not contained. A curve gains nothing by being shorter than another one.
    """
    runs = np.diff(curves, axis=1)
    spans = np.maximum(np.hypot(runs[..., 0], runs[..., 1]), 1e-6)
    cross = runs[:, :-1, 0] * runs[:, 1:, 1] - runs[:, :-1, 1] * runs[:, 1:, 0]
    turns = np.arctan2(cross, (runs[:, :-1] * runs[:, 1:]).sum(axis=2))
    middle = 0.5 * (spans[:, 1:] + spans[:, :-1])
    bends, turns = turns / middle, np.abs(turns)
    half = geometry.half_separation
    times = np.maximum(SPACING / limits.linear, turns / limits.angular)
    fastest = limits.wheel_speed * geometry.wheel_radius
    times = np.maximum(times, (SPACING + half * turns) / fastest)
    # v² dκ/ds is the yaw acceleration at a steady speed; a reserve is for changes of the speed.
    changes = np.abs(np.diff(bends, axis=1, prepend=bends[:, :1])) * middle
    times = np.maximum(times, np.sqrt(changes / (RESERVE * limits.angular_acceleration)))
    return np.pad(times, ((0, 0), (1, 1)), mode='edge')


def join_curve(begin: PathEnd, end: PathEnd) -> Array:
    """Return points (m) of the curve of degree five between two ends, without the first one."""
    chord = math.hypot(end.pose.x - begin.pose.x, end.pose.y - begin.pose.y)
    conditions = []
    for pose, bend, _ in (begin, end):
        ahead = np.array([math.cos(pose.yaw), math.sin(pose.yaw)])
        left = np.array([-ahead[1], ahead[0]])
        conditions += [np.array(pose[:2]), chord * ahead, chord * chord * bend * left]
    share = np.linspace(0.0, 1.0, max(2, math.ceil(chord / SPACING)) + 1)[1:, None]
    curve: Array = sum(
        np.polynomial.polynomial.polyval(share, each) * condition
        for each, condition in zip(_HERMITE, conditions, strict=True)
    )
    return curve


_HERMITE = (
    (1.0, 0.0, 0.0, -10.0, 15.0, -6.0),
    (0.0, 1.0, 0.0, -6.0, 8.0, -3.0),
    (0.0, 0.0, 0.5, -1.5, 1.5, -0.5),
    (0.0, 0.0, 0.0, 10.0, -15.0, 6.0),
    (0.0, 0.0, 0.0, -4.0, 7.0, -3.0),
    (0.0, 0.0, 0.0, 0.5, -1.0, 0.5),
)
"""Coefficients, lowest first, of place, first and second derivative at 0, and at 1."""


def _end_at(points: Array, index: int) -> PathEnd:
    """Return place, direction and curvature of a curve at one of its points."""
    middle = min(max(index, 1), len(points) - 2)
    one, other = points[middle] - points[middle - 1], points[middle + 1] - points[middle]
    turn = math.atan2(one[0] * other[1] - one[1] * other[0], float(one @ other))
    spans = math.hypot(*one), math.hypot(*other)
    bend = 2.0 * turn / max(sum(spans), 1e-9)
    yaw = math.atan2(one[1], one[0]) + bend * (0.5 * spans[0] + (index - middle) * spans[1])
    x, y = points[index].tolist()
    return PathEnd(Pose(x, y, yaw), bend, moving=True)


def _window(width: float) -> Array:
    reach = math.ceil(REACH * width / SPACING)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * SPACING / width) ** 2)
    found: Array = weights / weights.sum()
    return found


def _convolved(points: Array, window: Array) -> Array:
    return np.column_stack([np.convolve(column, window, 'same') for column in points.T])


def _sloped(needed: Array, allowed: Array) -> Array:
    """Return a smooth function from ``needed``, where it can be, to ``allowed``, never above."""
    along = np.arange(needed.size) / RAMP
    raised = -_lower_envelope(-needed, np.arange(needed.size) / LEVEL)
    padded = np.pad(allowed, BLUR, mode='edge')
    bound = sliding_window_view(padded, 2 * BLUR + 1).min(axis=1)
    level = _lower_envelope(np.minimum(raised, bound), along)
    blur = np.full(2 * BLUR + 1, 1.0 / (2 * BLUR + 1))
    return np.convolve(np.pad(level, BLUR, mode='edge'), blur, 'valid')


def _lower_envelope(values: Array, along: Array) -> Array:
    """Return the largest function below ``values`` with slopes of at most 1 over ``along``."""
    rising = np.minimum.accumulate(values - along) + along
    falling = np.minimum.accumulate((values + along)[::-1])[::-1] - along
    return np.minimum(rising, falling)
