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
"""A path on a map: it goes around what is known, and stops and looks before what is not.

The map is the one of the keep-out, which comes again and again. What of the path leads too near to
an obstacle is replaced by a route around it (:mod:`t3mpc_ros.geometry.route_planning`), and what
no route reaches is left out. The reference gets only as much of the path as leads over floor
that has been seen: it comes to rest before the rest of it, turns to look, and goes on where the
map then shows free floor; what it cannot see counts as an obstacle for a while. Now and then the
path leads to a place that was not visited for long. With a low battery it leads to the charging
place, and on from there when the battery is charged.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.geometry.obstacles import OCCUPIED_PERCENT, OccupancyGrid
from t3mpc_ros.geometry.path_timing import PathTiming
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.polyline import lengths_along, resample
from t3mpc_ros.geometry.route_planning import SPACING, WAY_OUT, RoutePlanner
from t3mpc_ros.geometry.types import Array, BodyTwist, Pose, wrap_angle
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter

REPLAN = 0.02
"""Distance by which a planned path may come nearer to obstacles on a newer map, m: readings have
noise."""
BACK = 30
"""Points before and after an obstacle in which a detour leaves and joins the path."""
HORIZON = 300
"""Points that are planned ahead of the reference."""
SEARCH = 2000
"""Points of the path among which a detour ends."""
SKIP_COST = 0.05
"""Way that a detour may be longer for each length of the path that it then does not leave out."""
TURN_COST = 0.4
"""Way that is as bad as a right angle where a detour joins the path, m."""
FEED = 150
"""Points ahead of the reference that are driven without another look at the map."""
CORNER = 0.04
"""Length that the reference may have passed beyond that which it drove, m: it cuts corners."""
STOP = 5
"""Points before floor that has not been seen at which the path stops."""
WIDTHS = 0.2, 0.15, 0.1, 0.07, 0.04
"""Standard deviations of the windows that smooth a detour, m: the widest that keeps its distance
from obstacles."""
CUT = 0.015
"""Distance by which smoothing may bring a detour nearer to them, m."""
MISS, GOAL_MISS = 0.12, 0.03
"""Distance by which it may pass an old place, and a goal, m."""
RAMP = 50
"""Points over which smoothing begins and ends."""
LOOK_ANGLE, LOOK_RATE, LOOK_ACCELERATION = 0.55, 1.9, 5.8
"""Angle to both sides of the path (rad) and yaw rate (rad/s) of a look; its change (rad/s²)."""
LOOK_AHEAD = 40
"""Point of the path towards which it looks."""
SEEN = 30
"""Points that must have become free for a look to end before its time."""
REST = 0.3
"""Time at rest before floor that has not been seen, before the reference looks around, s: within
which the map comes again."""
UNSEEABLE_RADIUS, UNSEEABLE_TIME = 0.2, 60.0
"""Floor around a place that a look did not show (m), and time for which it then is avoided (s)."""
FAR_AWAY, PATIENCE = 0.3, 5.0
"""Distance of the robot from its reference (m) and time (s) after which the path begins anew where
the robot is."""
CELL = 0.15
"""Side of the cells whose last visit is remembered, m."""
PLACES, APART = 5, 0.25
"""Old places that are visited one after the other, and their least distance, m."""
FRESH_COST = 3.0
"""Cost of floor that was just visited, by the length of a way to old places over it."""
LOOK_AGAIN, MOST_LOOKS, CONTRADICTED = 60.0, 20, 100.0
"""Time for which the path does not lead by the same contradiction of the map again, s, how many
places are looked at in turn, and how long they count: who named them may have fallen silent, s."""
VIEW_DISTANCE, VIEW_DEPTH = 0.8, 0.15
"""Largest distance from which a contradiction is looked at, and by how much farther than from the
nearest place, m."""
VIEW_END = 0.3
"""Last part of the line of sight, m: what the map has there is what is in doubt."""
NOWHERE_TIME, FOLLOWS = 20.0, 0.35
"""Time without a way anywhere after which the robot is boxed in (s): several maps, and the things
that keep it there may be people; and its angle to the reference (rad) above which it does not
follow, and has not seen what a look was to show."""
OLD_SHARE = 0.9
"""Age of the places that are revisited, as a share of the greatest age."""


BATTERY_TIME = 5.0
"""Time for which a voltage must last to count, s: it sags while the robot accelerates."""

_NOWHERE = np.empty((0, 2))


@dataclass(frozen=True)
class ChargingParameters(Parameters):
    """When and where the battery is charged."""

    min_voltage: float = parameter(
        0.0,
        'voltage of battery_state below which the path leads to place; 0: never',
        'V',
        (0.0, 60.0),
    )
    full_voltage: float = parameter(
        12.3, 'voltage of battery_state from which it leads on from there', 'V', (0.0, 60.0)
    )
    place: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'where the battery is charged: x, y in the frame of the reference',
        'm',
        (-1000.0, 1000.0),
    )

    def check_consistency(self) -> None:
        """Raise ParameterError if it would leave at once, or does not know where to."""
        if self.full_voltage <= self.min_voltage:
            raise ParameterError(
                f'full_voltage must be more than min_voltage ({self.min_voltage:g} V): '
                f'got {self.full_voltage:g}'
            )
        if len(self.place) != 2:
            raise ParameterError(f'place must be two numbers, x and y: got {len(self.place)}')


@dataclass(frozen=True)
class PlanParameters(Parameters):
    """How a path is planned on the map of the keep-out."""

    enabled: bool = parameter(
        False,
        'source portrait: plan the path on the map that the controller publishes: around '
        'obstacles, and with a stop to look before floor that has not been seen; needs '
        'keep_out.enabled of the controller',
    )
    distance: float = parameter(
        0.195,
        'least distance of the path from obstacles: keep_out.distance of the controller and a '
        'reserve for the noise of the readings',
        'm',
        (0.02, 2.0),
    )
    reserve: ClassVar[float] = 0.01
    """Distance by which floor must have been seen beside the path less than that, m."""
    revisit_distance: float = parameter(
        4.0,
        'mean length of path after which it leads to a place that was not visited for long; '
        '0: never',
        'm',
        (0.0, 1e6),
    )
    charging: ChargingParameters = group(ChargingParameters)


class PathPlan:
    """Points along an endless path, around what the map shows.

    given : returns the next points of the path, m, shape (k, 2)
    """

    def __init__(
        self,
        parameters: PlanParameters,
        planner: RoutePlanner,
        given: Callable[[], Array],
        arena: Arena,
        start: Pose,
    ) -> None:
        self._parameters, self._planner, self._given = parameters, planner, given
        self._arena = arena
        self.points: Array = np.array([[start.x, start.y]])
        """m, shape (n, 2)"""
        self._next: NDArray[np.int64] = np.zeros(1, dtype=np.int64)
        """Of each point, the first point of the given path that comes after it."""
        self._path, self._base = np.empty((0, 2)), 0
        """Points of the given path from a number on."""
        low, high = arena.corners.min(axis=0), arena.corners.max(axis=0)
        self._low = low
        self._visited = np.zeros(np.ceil((high - low) / CELL).astype(np.int64) + 1)
        """Time of the last visit of each cell, s."""
        self._left = math.inf
        self.goal: tuple[float, float] | None = None
        """Place that is to be visited, and was not yet, m."""
        self._leads_there: bool | None = None
        """Whether a way to the goal is in the plan; None before it was looked for."""
        self._contradiction: tuple[float, float] | None = None
        """Where the map is contradicted, and which is to be looked at, m."""
        self._last_view: tuple[float, float] | None = None
        """The last place from which it is looked at, m; None without a way there in the plan."""
        self._looks: list[tuple[float, float, float]] = []
        """Contradictions of the last minute: x, y (m), and since when it leads by (s)."""

    def lead_by(self, places: Array, fixed: int, time: float) -> None:
        """Lead by the first place where the map is contradicted, unless it did so a minute ago.

        places : m, shape (n, 2)
        """
        self._looks = [each for each in self._looks if time - each[2] < LOOK_AGAIN]
        if self._contradiction in [each[:2] for each in self._looks]:
            return  # one after the other
        self._contradiction = self._last_view = None
        for x, y in places[:MOST_LOOKS].tolist():
            if all(math.hypot(x - each[0], y - each[1]) > APART for each in self._looks):
                self._looks.append((x, y, time))
                self._contradiction = x, y
                self.truncate(max(fixed, 1))
                return

    def lead_to(self, goal: tuple[float, float], fixed: int) -> None:
        """Lead to a place (m) after the first ``fixed`` points, and then on along the path."""
        self.truncate(max(fixed, 1))
        self.goal, self._leads_there = goal, None

    @property
    def goal_point(self) -> int | None:
        """The point that is nearest to the goal; None without a way there."""
        if self.goal is None or not self._leads_there:
            return None
        return self._point_at(self.goal)

    @property
    def unreachable_goal(self) -> tuple[float, float] | None:
        """The goal (m) if no way to it is known; it is looked for again as the path goes on."""
        return self.goal if self._leads_there is False else None

    def _point_at(self, place: tuple[float, float]) -> int:
        """Return the point that is nearest to a place (m)."""
        return int(np.argmin(np.hypot(*(self.points - place).T)))

    def use_random_numbers(self, random: SecretRandom) -> None:
        """Draw where and when places are revisited from these numbers from now on."""
        self._random = random
        self._left = self._draw_length()

    def _draw_length(self) -> float:
        mean = self._parameters.revisit_distance
        return self._random.exponential(mean) if mean > 0.0 else math.inf

    def remember(self, points: Array, time: float) -> None:
        """Remember that the robot was at places (m) at a time (s)."""
        column, row = self._cells(points)
        self._visited[column, row] = time

    def _freshness(self, points: Array) -> Array:
        """Return the cost of places (m): a way leads over floor that was not visited for long."""
        last = self._visited[tuple(self._cells(points))]
        found: Array = FRESH_COST * last / max(float(self._visited.max()), 1e-9)
        return found

    def _cells(self, points: Array) -> NDArray[np.int64]:
        cells = np.floor((points - self._low) / CELL).astype(np.int64)
        found: NDArray[np.int64] = np.clip(cells, 0, np.array(self._visited.shape) - 1).T
        return found

    def forget(self, count: int) -> None:
        """Remove the first points, which have been passed."""
        if (point := self.goal_point) is not None and point <= count:
            self.goal = None
        if self._last_view is not None and self._point_at(self._last_view) <= count:
            self._contradiction = self._last_view = None
        self.points, self._next = self.points[count:], self._next[count:]
        used = int(self._next[0]) - self._base
        self._path, self._base = self._path[used:], self._base + used

    def truncate(self, count: int) -> None:
        """Keep the first points only; what followed is planned anew."""
        if (point := self.goal_point) is not None and point >= count:
            self._leads_there = None
        if self._last_view is not None and self._point_at(self._last_view) >= count:
            self._last_view = None
        self.points, self._next = self.points[:count], self._next[:count]

    def begin_at(self, pose: Pose) -> None:
        """Plan from a place on."""
        self._leads_there, self._last_view = None, None
        self.points, self._next = np.array([[pose.x, pose.y]]), self._next[:1]

    def extend(self, fixed: int, time: float) -> None:
        """Plan ahead; the first ``fixed`` points stay as they are."""
        while len(self.points) < fixed + HORIZON:
            path = self._ahead()
            blocked = self._planner.wall_distance(path) < self._parameters.distance
            gap = math.hypot(*(path[0] - self.points[-1]))
            begin = (float(self.points[-1, 0]), float(self.points[-1, 1]))
            if self.goal is not None and not self._leads_there:
                goal = [self.goal]
                self._leads_there = self._lead_over(goal, GOAL_MISS, begin, path, blocked, fixed)
                if self._leads_there:
                    continue
            if self._contradiction is not None and self._last_view is None:
                places = self._views(self._contradiction, begin)
                if places and self._lead_over(places, MISS, begin, path, blocked, fixed):
                    self._last_view = places[-1]
                    continue
                self._contradiction = None
            if self._left <= 0.0:
                self._left = self._draw_length()
                places = self._old_places(begin, time)
                if places and self._lead_over(places, MISS, begin, path, blocked, fixed):
                    continue
            first = int(np.argmax(blocked)) if blocked.any() else len(blocked)
            free = min(first - BACK, 2 * BACK)
            if gap <= 3.0 * SPACING and free > 0:
                self._append(path[:free], np.arange(1, free + 1))
            elif not self._detour(begin, path, blocked, fixed):
                self._next[-1] += SEARCH // 2  # next time to what follows
                break

    def _ahead(self) -> Array:
        """Return the given path from the end of the plan on."""
        used = int(self._next[-1]) - self._base
        needed = used + SEARCH + 2 * BACK
        while len(self._path) < needed:
            self._path = np.vstack([self._path, self._given()])
        return self._path[used:needed]

    def _append(self, points: Array, following: NDArray[np.int64]) -> None:
        """Append points, with the numbers of points of the given path passed up to each."""
        self._next = np.concatenate([self._next, self._next[-1] + following])
        self.points = np.vstack([self.points, points])
        self._left -= SPACING * len(points)

    def _joint(
        self, path: Array, blocked: NDArray[np.bool_], first: int, begin: Array, direction: Array
    ) -> int:
        """Return where the way that was found joins the given path best; -1: nowhere.

        first : point of the given path from which on it may
        begin, direction : begin of that way, and direction of motion there, shape (2,)
        """
        clear = np.convolve(~blocked, np.ones(BACK), 'valid')[:SEARCH] > BACK - 0.5
        times = self._planner.arrival(path)
        clear &= np.isfinite(times[:SEARCH])
        clear[:first] = False
        where = np.flatnonzero(clear)
        if not where.size:
            return -1
        # The way found runs along the path where its time grows as the length does.
        along = np.clip((times[where + BACK] - times[where]) / (SPACING * BACK), -1.0, 1.0)
        turns = 2.0 - along - alignments(path[where] - begin, direction)
        costs = times[where] + SKIP_COST * SPACING * where + TURN_COST * turns
        return int(where[int(np.argmin(costs))])

    def _detour(
        self, begin: tuple[float, float], path: Array, blocked: NDArray[np.bool_], fixed: int
    ) -> bool:
        """Append a route to where the given path is free again; return whether there is one."""
        self._planner.spread(begin)
        first = int(np.argmax(blocked)) if blocked[: 3 * BACK].any() else 0
        joint = self._joint(path, blocked, first, self.points[-1], self._direction())
        if joint < 0:
            return False
        route = self._planner.route((float(path[joint, 0]), float(path[joint, 1])), begin)
        if route is None:
            return False
        self._append_smoothly(route, path, joint, fixed)
        return True

    def _old_places(self, begin: tuple[float, float], time: float) -> list[tuple[float, float]]:
        """Return places that were not visited for long and have a way, one after the other.

        The first one is drawn, the others are the nearest to the one before.
        """
        places = self._places_from(begin)
        if not len(places):
            return []
        age = time - self._visited[tuple(self._cells(places))]
        places = places[age >= OLD_SHARE * age.max()]
        chosen = [places[self._random.below(len(places))]]
        for _ in range(1, PLACES):
            places = places[np.hypot(*(places - chosen[-1]).T) > APART]
            if not len(places):
                break
            chosen.append(places[int(np.argmin(np.hypot(*(places - chosen[-1]).T)))])
        return [(float(x), float(y)) for x, y in chosen]

    def _places_from(self, begin: tuple[float, float]) -> Array:
        """Return the places (m) that have a way from a place, shape (n, 2)."""
        self._planner.spread(begin)
        places = self._planner.reached_places()
        inside = self._arena.contains(places)
        inside &= self._planner.wall_distance(places) >= self._parameters.distance
        return places[inside]

    def _views(
        self, thing: tuple[float, float], begin: tuple[float, float]
    ) -> list[tuple[float, float]]:
        """Return two places from which a thing (m) is seen, the nearer one first; or none."""
        places = self._places_from(begin)
        away = np.maximum(np.hypot(*(places - thing).T), 1e-9)
        places, away = places[away < VIEW_DISTANCE], away[away < VIEW_DISTANCE]
        share = np.linspace(0.0, 1.0, 16)[:, None] * np.clip(1.0 - VIEW_END / away, 0.0, 1.0)
        sight = places + share[:, :, None] * (thing - places)
        clear = self._planner.wall_distance(sight.reshape(-1, 2)).reshape(share.shape)
        seen = (clear > 2.0 * SPACING).all(axis=0)
        places, away = places[seen], away[seen]
        if not len(places):
            return []
        places = places[away <= away.min() + VIEW_DEPTH]
        first = places[int(np.argmin(self._planner.arrival(places)))]
        second = places[int(np.argmax(np.hypot(*(places - first).T)))]
        return [(float(x), float(y)) for x, y in (first, second)]

    def _lead_over(
        self,
        places: list[tuple[float, float]],
        miss: float,
        begin: tuple[float, float],
        path: Array,
        blocked: NDArray[np.bool_],
        fixed: int,
    ) -> bool:
        """Append a way to places, and on to the given path; return whether there is one.

        miss : distance by which it may pass them, m
        """
        parts: list[Array] = []
        for place in places:
            self._planner.spread(begin, self._freshness)
            part = self._planner.route(place, begin)
            if part is None:
                break
            parts.append(part)
            begin = place
        if not parts:
            return False
        self._planner.spread(begin, self._freshness)
        direction = parts[-1][-1] - parts[-1][max(len(parts[-1]) - BACK, 0)]
        joint = self._joint(path, blocked, 0, parts[-1][-1], direction)
        if joint < 0:
            return False
        back = self._planner.route((float(path[joint, 0]), float(path[joint, 1])), begin)
        if back is None:
            return False
        visited = places[: len(parts)]
        self._append_smoothly(np.vstack([*parts, back]), path, joint, fixed, visited, miss)
        return True

    def _direction(self) -> Array:
        found: Array = self.points[-1] - self.points[max(len(self.points) - BACK, 0)]
        return found

    def _append_smoothly(
        self,
        route: Array,
        path: Array,
        joint: int,
        fixed: int,
        places: Sequence[tuple[float, float]] = (),
        miss: float = MISS,
    ) -> None:
        """Append a route to a point of the given path and the next ones, its corners rounded.

        places, miss : on the route, and how far it may pass them, m
        """
        before = min(RAMP, len(self.points) - max(fixed, 1))
        after = path[joint + 1 : joint + 1 + RAMP]
        kept = len(self.points) - before - 1
        self._append(route, np.zeros(len(route), dtype=np.int64))
        self._append(after, joint + 1 + np.arange(1, RAMP + 1))
        # Smoothing moves points towards each other where the path turns back.
        passed = [(*each, miss) for each in places]
        # The last points of the plan are smoothed again, and may lead to these:
        if self.goal is not None and self._leads_there:
            passed.append((*self.goal, GOAL_MISS))
        if self._last_view is not None:
            passed.append((*self._last_view, MISS))
        points, numbers = self._smoothed(self.points[kept:], passed), self._next[kept:]
        lengths = lengths_along(points)
        points = resample(points, SPACING, round)
        even = np.interp(np.linspace(0.0, lengths[-1], len(points)), lengths, numbers)
        self.points = np.vstack([self.points[:kept], points])
        self._next = np.concatenate([self._next[:kept], even.astype(np.int64)])

    def _smoothed(self, points: Array, places: list[tuple[float, float, float]]) -> Array:
        """Return points with their corners rounded, as wide as obstacles and places permit.

        places : x, y, and how far the points may pass each if they do not do so already, m
        """
        planner = self._planner

        def passes(points: Array) -> Array:
            return np.array([np.hypot(*(points - each[:2]).T).min() for each in places])

        most = np.maximum([each[2] for each in places], passes(points))
        least = np.minimum(planner.wall_distance(points), planner.distance) - CUT
        along = np.arange(len(points))
        share = np.clip(np.minimum(along, along[::-1]) / RAMP, 0.0, 1.0)[:, None]
        share = share * share * (3.0 - 2.0 * share)
        for width in WIDTHS:
            reach = math.ceil(3.0 * width / SPACING)
            window = np.exp(-0.5 * (np.arange(-reach, reach + 1) * SPACING / width) ** 2)
            padded = np.pad(points, ((reach, reach), (0, 0)), mode='edge')
            smooth = np.column_stack(
                [np.convolve(axis, window / window.sum(), 'valid') for axis in padded.T]
            )
            rounded: Array = (1.0 - share) * points + share * smooth
            if (passes(rounded) <= most).all() and (planner.wall_distance(rounded) >= least).all():
                return rounded
        return points


def keeps_off(distances: Array, least: float) -> NDArray[np.bool_]:
    """Return which points of a path are so far (m) from obstacles, or on the way out from there.

    A robot that finds itself too near, because the map or its pose on it has changed, may leave.
    """
    reached = np.maximum.accumulate(distances)
    return distances >= np.where(reached < least, WAY_OUT * reached, least)


def alignments(vectors: Array, direction: Array) -> Array:
    """Return the cosines of the angles between vectors, shape (n, 2), and a direction."""
    sizes = np.maximum(np.hypot(*vectors.T) * math.hypot(*direction), 1e-9)
    found: Array = vectors @ direction / sizes
    return found


class _Look:
    """Turns on the spot from one direction to the next."""

    def __init__(self, pose: Pose, directions: list[float], period: float) -> None:
        self.pose = pose
        self.directions = directions
        self._rate, self._period = 0.0, period

    def advance(self, rate: float) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period; rate : share of the speed, 0 to 1."""
        gap = wrap_angle(self.directions[0] - self.pose.yaw)
        change = LOOK_ACCELERATION * self._period
        fastest = min(LOOK_RATE, math.sqrt(2.0 * LOOK_ACCELERATION * abs(gap)))
        wanted = math.copysign(rate * min(fastest, abs(gap) / self._period), gap)
        self._rate = min(max(wanted, self._rate - change), self._rate + change)
        result = self.pose, BodyTwist(0.0, self._rate)
        x, y, yaw = self.pose
        self.pose = Pose(x, y, yaw + self._rate * self._period)
        if abs(gap) < 0.02 and abs(self._rate) < 0.05:
            self.directions.pop(0)
        return result


class _Unseeable(NamedTuple):
    """Floor that a look did not show."""

    x: float
    y: float
    until: float
    """s"""


class PlannedPath:
    """Pose and twist period by period along a planned path; at rest without a map.

    timing : at rest at the start
    period : s
    given : returns the next points of the path, m, shape (k, 2)
    arena : where places are revisited
    """

    def __init__(
        self,
        parameters: PlanParameters,
        timing: PathTiming,
        period: float,
        start: Pose,
        given: Callable[[], Array],
        arena: Arena,
    ) -> None:
        self._parameters, self._timing, self._period = parameters, timing, period
        self._planner = RoutePlanner(parameters.distance)
        self.plan = PathPlan(parameters, self._planner, given, arena, start)
        """What is known of the path."""
        self._pose = start
        self._fed = 1
        """Points of the plan that the reference has."""
        self._time = 0.0
        """s"""
        self._rested = 0.0
        """Time at rest before floor that has not been seen, s."""
        self._driven = 0.0
        """Length that the reference drove beyond the first point of the plan, m."""
        self._near_time = 0.0
        """When the robot was near the reference last, s."""
        self._look: _Look | None = None
        self._looked = False
        """Whether it has looked around since it came to rest."""
        self._unseeable: list[_Unseeable] = []
        self._leads_nowhere = False
        """Whether the last map leaves no way from where the reference rests."""
        self._nowhere = 0.0
        """Time of that since the reference moved, s."""
        self._observed = 0.0
        """When the robot was observed last, s."""
        self._seen = 0
        """Points of the plan that lead over floor that has been seen."""
        self.charging = False
        """Whether the path leads to the charging place, or rests there."""
        self._contradictions: Array = _NOWHERE
        """Where the map is contradicted, m, shape (n, 2)."""
        self._contradicted = 0.0
        """When they were given, s."""
        self._battery_time = math.inf
        """Since when the voltage has called for a change, s."""
        self._voltage_time = 0.0
        """When the last voltage was observed, s."""

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of the path's time."""
        self._time += self._period
        if self._look is not None:
            self._pose, twist = self._look.advance(rate)
            if not self._look.directions:  # it rests in the last one
                self._begin_at(self._look.pose)
                self._feed()
            return self._pose, twist
        self._pose, twist = self._timing.advance(rate)
        self._driven += abs(twist.linear) * self._period
        resting = self._timing.standing and self._timing.arrived
        self._rested = self._rested + self._period if resting else 0.0
        if not resting:
            self._looked = False
            self._nowhere = 0.0
        return self._pose, twist

    def _begin_at(self, pose: Pose) -> None:
        """Rest at a pose."""
        self._pose, self._look, self._rested = pose, None, 0.0
        self._timing.begin_at(pose)

    def observe(self, pose: Pose) -> None:
        """Begin anew where the robot is, when it has not come near the reference for long."""
        elapsed, self._observed = self._time - self._observed, self._time
        if math.hypot(pose.x - self._pose.x, pose.y - self._pose.y) < FAR_AWAY:
            self._near_time = self._time
            if self._leads_nowhere and abs(wrap_angle(pose.yaw - self._pose.yaw)) < FOLLOWS:
                self._nowhere += elapsed
        elif self._time - self._near_time > PATIENCE:
            self._near_time = self._time
            self.plan.begin_at(pose)
            self._fed = 1
            self._begin_at(pose)
            if self.charging:
                self.plan.goal = self._charging_place

    def observe_battery(self, voltage: float) -> bool:
        """Lead to the charging place with a low battery, and on from there with a full one.

        Return whether the voltage is one: what is not finite or not above 0 V changes nothing.

        voltage : V; one that lasts for 5 s counts
        """
        if not 0.0 < voltage < math.inf:
            return False
        self._voltage_time = self._time
        parameters = self._parameters.charging
        enough = voltage >= parameters.full_voltage
        if not (enough if self.charging else voltage < parameters.min_voltage):
            self._battery_time = math.inf
            return True
        self._battery_time = min(self._battery_time, self._time)
        if self._time - self._battery_time >= BATTERY_TIME:
            self.charging, self._battery_time = not self.charging, math.inf
            if self.charging:
                self.go_to(self._charging_place)
        return True

    @property
    def boxed_in(self) -> bool:
        """Whether the robot has had nowhere to go for :data:`NOWHERE_TIME`."""
        return self._nowhere >= NOWHERE_TIME

    @property
    def battery_silence(self) -> float:
        """Time without a voltage, s."""
        return self._time - self._voltage_time

    @property
    def _charging_place(self) -> tuple[float, float]:
        x, y = self._parameters.charging.place
        return x, y

    @property
    def at_charging_place(self) -> bool:
        """Whether the path rests where the battery is charged."""
        return self.charging and self.plan.goal is None

    def set_map(self, grid: OccupancyGrid) -> None:
        """Plan on another map from now on."""
        self._planner.update(self._with_unseeable(grid))
        self._go_on()
        self._leave_unsafe()
        if self._time - self._contradicted > CONTRADICTED:
            self._contradictions = _NOWHERE
        self.plan.lead_by(self._contradictions, self._fed, self._time)
        self.plan.extend(self._fed, self._time)
        goes_on = self._feed()
        self._leads_nowhere = (
            self._rested > REST
            and self._fed >= len(self.plan.points)
            and not self.at_charging_place
        )
        if self._look is not None:
            if self._seen >= self._fed + SEEN:
                del self._look.directions[:-1]
        elif self._rested > REST and not goes_on and not self.at_charging_place:
            self._look_around()

    def _with_unseeable(self, grid: OccupancyGrid) -> OccupancyGrid:
        self._unseeable = [each for each in self._unseeable if each.until > self._time]
        if not self._unseeable:
            return grid
        cells = grid.cells.copy()
        rows, columns = cells.shape
        x = grid.x + grid.resolution * (np.arange(columns) + 0.5)
        y = grid.y + grid.resolution * (np.arange(rows) + 0.5)
        for each in self._unseeable:
            near = (x[None, :] - each.x) ** 2 + (y[:, None] - each.y) ** 2
            cells[(near < UNSEEABLE_RADIUS**2) & (cells < 0)] = OCCUPIED_PERCENT
        return grid._replace(cells=cells)

    def _go_on(self) -> None:
        """Remove the points that the reference has passed."""
        points = self.plan.points[: self._fed]
        lengths = lengths_along(points)
        place = self._fed - 1
        if not (self._timing.standing and self._timing.arrived):
            # Not farther than it drove: where the path crosses itself, another place is as near.
            near = points[lengths <= self._driven + CORNER]
            place = int(np.argmin(np.hypot(*(near - np.array(self._pose[:2])).T)))
        self._driven = min(max(self._driven - float(lengths[place]), 0.0), CORNER)
        self.plan.remember(self.plan.points[: place + 1], self._time)
        self.plan.forget(place)
        self._fed -= place

    def _leave_unsafe(self) -> None:
        """Leave the path where it leads too near to an obstacle, or over floor not seen."""
        least = self._parameters.distance - REPLAN
        points = self.plan.points
        walls = ~keeps_off(self._planner.wall_distance(points), least)
        unseen = ~keeps_off(self._planner.unsafe_distance(points[: self._fed]), least - REPLAN)
        fed = self._fed
        if self._look is None and (walls[1:fed].any() or unseen[1:].any()):
            self._cut()
            fed = self._fed
        if walls[fed:].any():
            first = fed + int(np.argmax(walls[fed:]))
            self.plan.truncate(max(fed, first - BACK))
        elif walls[1:fed].any():
            self.plan.truncate(fed)

    def _cut(self) -> None:
        """Leave the path where the reference can stop."""
        end = self._timing.cut()
        away = np.hypot(*(self.plan.points[: self._fed] - np.array(end.pose[:2])).T)
        self._fed = int(np.argmin(away)) + 1

    def look_at(self, places: Array) -> None:
        """Lead soon by places (m), shape (n, 2), where the map is contradicted: once a minute.

        It does so for :data:`CONTRADICTED` s, unless others are given, or the same again.
        """
        self._contradictions, self._contradicted = places, self._time

    def go_to(self, goal: tuple[float, float]) -> None:
        """Lead to a place (m) now, and then on along the path."""
        if self._look is None:
            self._cut()
        self.plan.lead_to(goal, self._fed)

    def _feed(self) -> bool:
        """Let the reference have what of the path leads over seen floor; return whether it has.

        During a look it gets nothing: the look ends with a new begin.
        """
        points = self.plan.points[self._fed :]
        away = self._planner.unsafe_distance(self.plan.points[self._fed - 1 :])
        seen = keeps_off(away, self._parameters.distance - self._parameters.reserve)[1:]
        free = len(points) if seen.all() else int(np.argmin(seen))
        self._seen = self._fed + free
        if free < len(points):
            free -= STOP
        if self._look is not None or self.at_charging_place:
            return False
        if self.charging and (point := self.plan.goal_point) is not None:
            free = min(free, point + 1 - self._fed)
        count = min(free, FEED - self._fed)
        if count > 0:
            self._timing.add_points(points[:count])
            self._fed += count
            if self.charging and self.plan.goal_point == self._fed - 1:
                self._timing.drive_to_last_point()
        return count > 0

    def _look_around(self) -> None:
        """Turn to both sides of the path; where that has been of no use, avoid what is unseen."""
        points = self.plan.points
        if self._fed >= len(points):
            return
        ahead = points[min(self._fed + LOOK_AHEAD, len(points) - 1)]
        x, y, yaw = self._pose
        if self._looked:
            place_x, place_y = points[min(self._seen, len(points) - 1)].tolist()
            self._unseeable.append(_Unseeable(place_x, place_y, self._time + UNSEEABLE_TIME))
            self.plan.truncate(self._fed)
            self._looked = False
            self._rested = 0.0
            return
        middle = math.atan2(ahead[1] - y, ahead[0] - x)
        side = math.copysign(LOOK_ANGLE, wrap_angle(yaw - middle))
        directions = [middle + side, middle - side, middle]
        self._look = _Look(self._pose, directions, self._period)
        self._looked = True
