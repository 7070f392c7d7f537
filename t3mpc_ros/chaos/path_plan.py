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
"""What is planned of an endless path: around obstacles, and to places that are to be visited."""

from collections.abc import Callable, Sequence
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.polyline import lengths_along, resample
from t3mpc_ros.geometry.route_planning import SPACING, RoutePlanner
from t3mpc_ros.geometry.types import Array, Pose

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
WIDTHS = 0.2, 0.15, 0.1, 0.07, 0.04
"""Standard deviations of the windows that smooth a detour, m: the widest that keeps its distance
from obstacles."""
CUT = 0.015
"""Distance by which smoothing may bring a detour nearer to them, m."""
MISS, GOAL_MISS = 0.12, 0.03
"""Distance by which it may pass an old place, and a goal, m."""
RAMP = 50
"""Points over which smoothing begins and ends."""
CELL = 0.15
"""Side of the cells whose last visit is remembered, m."""
PLACES, APART = 5, 0.25
"""Old places that are visited one after the other, and their least distance, m."""
FRESH_COST = 3.0
"""Cost of floor that was just visited, by the length of a way to old places over it."""
LOOK_AGAIN, MOST_LOOKS = 60.0, 20
"""Time for which the path does not lead by the same contradiction of the map again, s, and how
many places are looked at in turn."""
VIEW_DISTANCE, VIEW_DEPTH = 0.8, 0.15
"""Largest distance from which a contradiction is looked at, and by how much farther than from the
nearest place, m."""
VIEW_END = 0.3
"""Last part of the line of sight, m: what the map has there is what is in doubt."""
OLD_SHARE = 0.9
"""Age of the places that are revisited, as a share of the greatest age."""


class PathPlan:
    """Points along an endless path, around what the map shows.

    planner : of routes that keep their distance from obstacles
    given : returns the next points of the path, m, shape (k, 2)
    arena : where places are revisited, after a mean length of path (m; 0: never)
    """

    def __init__(
        self,
        planner: RoutePlanner,
        given: Callable[[], Array],
        arena: Arena,
        revisit_distance: float,
        start: Pose,
    ) -> None:
        self._planner, self._given = planner, given
        self._arena, self._revisit_distance = arena, revisit_distance
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
        mean = self._revisit_distance
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
            blocked = self._planner.wall_distance(path) < self._planner.distance
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
        inside &= self._planner.wall_distance(places) >= self._planner.distance
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


def alignments(vectors: Array, direction: Array) -> Array:
    """Return the cosines of the angles between vectors, shape (n, 2), and a direction."""
    sizes = np.maximum(np.hypot(*vectors.T) * math.hypot(*direction), 1e-9)
    found: Array = vectors @ direction / sizes
    return found
