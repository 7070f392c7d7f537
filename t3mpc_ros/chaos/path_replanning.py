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

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.path_plan import BACK, PathPlan
from t3mpc_ros.geometry.obstacles import OCCUPIED_PERCENT, OccupancyGrid
from t3mpc_ros.geometry.path_timing import PathTiming
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.polyline import lengths_along
from t3mpc_ros.geometry.route_planning import WAY_OUT, RoutePlanner
from t3mpc_ros.geometry.types import Array, BodyTwist, Pose, wrap_angle
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter

REPLAN = 0.02
"""Distance by which a planned path may come nearer to obstacles on a newer map, m: readings have
noise."""
FEED = 150
"""Points ahead of the reference that are driven without another look at the map."""
CORNER = 0.04
"""Length that the reference may have passed beyond that which it drove, m: it cuts corners."""
STOP = 5
"""Points before floor that has not been seen at which the path stops."""
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
CONTRADICTED = 100.0
"""Time for which a contradiction of the map counts, s: who named it may have fallen silent."""
NOWHERE_TIME, FOLLOWS = 20.0, 0.35
"""Time without a way anywhere after which the robot is boxed in (s): several maps, and the things
that keep it there may be people; and its angle to the reference (rad) above which it does not
follow, and has not seen what a look was to show."""
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


def keeps_off(distances: Array, least: float) -> NDArray[np.bool_]:
    """Return which points of a path are so far (m) from obstacles, or on the way out from there.

    A robot that finds itself too near, because the map or its pose on it has changed, may leave.
    """
    reached = np.maximum.accumulate(distances)
    return distances >= np.where(reached < least, WAY_OUT * reached, least)


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
        self.plan = PathPlan(self._planner, given, arena, parameters.revisit_distance, start)
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
