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
r"""Timing of a path: poses and twists as fast as speed and acceleration limits allow.

A polyline becomes a *pose curve* x(u), y(u), yaw(u), on which the robot drives forward along the
line, turns on the spot at sharp corners and at both ends of a cusp, and rounds all others over
:data:`ROUNDING`. Its parameter is the length of the line plus :data:`TURN_LENGTH` for each radian
of turn, so that both :math:`g = v/\dot u` and :math:`c = \omega/\dot u` are bounded everywhere,
cusps included. With :math:`a = \ddot u` and :math:`b = \dot u^2`,

.. math:: \dot v = g' b + g a, \qquad \dot\omega = c' b + c a,

so every limit is linear in (a, b) at each node of a grid in u, and the fastest motion follows from
one backward and one forward pass (Pham and Pham, IEEE Trans. Robotics 34, 2018, doi
10.1109/TRO.2018.2819195). A path of unknown length is planned with a stop at the end of what is
known: a longer path only raises the largest :math:`b`, so a planned motion remains possible.

The time of the plan may pass at a rate :math:`s \le 1`, so that the path waits for the robot.
The twist then is :math:`s` times the planned one. An unchanged :math:`s` never exceeds a limit,
because accelerations are :math:`s^2` times the planned ones, and the twist is linear in :math:`s`:
the rates possible in the next period are an interval that contains the present one.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.polyline import PathError, check_points
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, Array, BodyTwist, Pose
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

STEP = 0.004
"""Grid of the path parameter u, m."""
TURN_LENGTH = 0.12
"""Length of u for each radian of turn, m."""
ROUNDING = 0.01
"""Length before and after a corner over which the yaw changes, m."""
CORNER = 0.6
"""Turn of the path at one point from which the robot stops and turns on the spot, rad."""
RESOLUTION = 0.002
"""Points nearer than this to the one before are left out, m."""
CREEP = 2e-3
"""Least sum of the speeds du/dt at both ends of an interval, m/s. With less, as between a corner
and an end right behind it, the robot goes from rest to rest."""
WINDOW, COMMIT = 600, 100
"""Nodes planned ahead, and nodes after which the plan is renewed."""
SHARE = 0.97
"""Share of the limits that the plan uses: v and omega are sampled, and B-spline and speed profile
do not agree exactly at sharp turns."""


@dataclass(frozen=True)
class MotionLimits(Parameters):
    """Limits of a motion along a path; lower than those of the robot, which needs a reserve."""

    linear: float = parameter(
        0.25, 'largest speed |v|', 'm/s', (0.01, 5.0), name='linear.x.max_velocity'
    )
    angular: float = parameter(
        2.0, 'largest yaw rate |omega|', 'rad/s', (0.05, 50.0), name='angular.z.max_velocity'
    )
    linear_acceleration: float = parameter(
        0.5, 'largest |dv/dt|', 'm/s²', (0.01, 50.0), name='linear.x.max_acceleration'
    )
    angular_acceleration: float = parameter(
        6.0, 'largest |d omega/dt|', 'rad/s²', (0.05, 500.0), name='angular.z.max_acceleration'
    )
    wheel_speed: float = parameter(
        9.0, 'largest wheel speed', 'rad/s', (0.1, 200.0), name='wheel.max_velocity'
    )
    wheel_acceleration: float = parameter(
        20.0,
        'largest acceleration of a wheel',
        'rad/s²',
        (0.1, 1e4),
        name='wheel.max_acceleration',
    )


class TimedPath(NamedTuple):
    """A path over time, sampled evenly from standstill to standstill; arrays of shape (n,)."""

    time: Array
    """s, from 0"""
    x: Array
    """m"""
    y: Array
    """m"""
    yaw: Array
    """rad, continuous"""
    linear: Array
    """m/s"""
    angular: Array
    """rad/s"""


class CurveLimits(NamedTuple):
    """:class:`MotionLimits` for kernels, and the lengths that relate wheels and twist."""

    linear: float
    angular: float
    linear_acceleration: float
    angular_acceleration: float
    wheel_speed: float
    wheel_acceleration: float
    radius: float
    half_separation: float


class PathEnd(NamedTuple):
    """Where a path ends that goes on elsewhere."""

    pose: Pose
    bend: float = 0.0
    """Curvature there, 1/m."""
    moving: bool = False
    """Whether the robot may pass without a stop."""


class PathTiming:
    """Returns pose and twist period by period along a path that grows while it is driven.

    Without a start, the motion begins at rest in the first point, facing the second.
    ``period`` in s.
    """

    def __init__(
        self,
        limits: MotionLimits,
        geometry: WheelGeometry,
        period: float,
        start: Pose | None = None,
    ) -> None:
        if not period > 0.0:
            raise ValueError(f'period must be positive: got {period} s')
        shares = {name: SHARE * limit for name, limit in vars(limits).items()}
        self._limits = CurveLimits(
            **shares, radius=geometry.wheel_radius, half_separation=geometry.half_separation
        )
        self._period = period
        self._changes = (
            limits.linear_acceleration * period,
            limits.angular_acceleration * period,
            *[limits.wheel_acceleration * period * geometry.wheel_radius] * 2,
        )
        """Largest changes in a period: of v, of omega, of the speed of each wheel on the floor."""
        self._half = geometry.half_separation
        self._sample = np.empty(3)
        self.begin_at(start)

    @property
    def needs_points(self) -> bool:
        """Whether more points are needed to plan on; see also :meth:`finish`."""
        return not self._ended and len(self._nodes) + self._curve.ready < self._place + 2 * WINDOW

    def add_points(self, points: Array) -> None:
        """Append points (m) of the path, shape (n, 2).

        PathError: they are not finite, or the path has ended.
        """
        check_points(points)
        if self._ended:
            raise PathError('the path has ended: no point can be added')
        for x, y in points.tolist():
            self._curve.add(x, y)

    def drive_to_last_point(self) -> None:
        """Drive to the last point now; a path that goes on elsewhere turns there on the spot.

        Without this the motion ends before the last corner, whose turn is not yet known.
        """
        self._curve.run_to_last()

    def finish(self) -> None:
        """End the path at its last point."""
        self._curve.run_to_last()
        self._ended = True

    @property
    def finished(self) -> bool:
        """Whether the robot is at the end of the path."""
        return self._ended and self.arrived

    @property
    def arrived(self) -> bool:
        """Whether the motion is at the end of what is known."""
        return self._place >= len(self._nodes) - 1 and not self._curve.ready

    @property
    def standing(self) -> bool:
        """Whether the last twist was that of a robot at rest."""
        return self._twist == STANDSTILL

    @property
    def _braking(self) -> bool:
        """Whether the robot can no longer rest before the last node of the plan."""
        last = len(self._nodes) - 1
        if self.standing or self._place >= last or self._squares.size <= last:
            return False
        # The accelerations of an interval depend on the next one, too.
        return self._stop() + 1 > last

    def _stop(self) -> int:
        return stopping_node(self._nodes, self._limits, self._place + 1, self._squares)

    def begin_at(self, pose: Pose | None) -> None:
        """Rest at a pose, or where the path will begin, and forget the path."""
        self._pose, self._twist = pose, STANDSTILL
        """Last pose and twist returned."""
        self._curve = _CurveBuilder(pose)
        self._nodes, self._squares = np.empty((0, 3)), np.zeros(1)
        """x, y, yaw of the nodes from the first one planned; b at those of the plan."""
        self._dropped = 0
        """Number of nodes before the first one that is kept."""
        self._place, self._elapsed = 0, 0.0
        """Interval between two nodes, and time since its beginning, s."""
        self.rate = 1.0
        """Rate at which the time of the plan passed in the last period."""
        self._ended = self._renew = False
        """The latter: whether the rest of the plan is that of a path that now leads elsewhere."""

    def cut(self) -> PathEnd:
        """Remove the rest of the path from where the robot can stop; return where that is.

        The motion goes on without a jump whatever points are added, or stops there without any. A
        path whose end is nearer than that keeps it.
        """
        if self._renew:
            self._plan()
        self._ended = False
        if self.standing:
            pose = self._pose or self._curve.first or ORIGIN
            self.begin_at(pose)
            return PathEnd(pose)
        if self._braking:
            pose = Pose(*self._nodes[-1].tolist())
            self._curve = _CurveBuilder(pose)
            self._curve.take()
            self._dropped = 1 - len(self._nodes)
            return PathEnd(pose)
        self._nodes = np.vstack([self._nodes, self._curve.take()])
        count = self._curve.rewind(self._dropped + max(self._stop(), self._place + 1) + 2)
        self._nodes = self._nodes[: count - self._dropped]
        self._squares = self._squares[: self._place + 2]
        self._renew = True
        return self._curve.end()

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose (yaw in the range of floats, not wrapped) and twist, and go on by a period.

        Without enough points the motion stops at the end of what is known. ``rate``, from
        0 (wait) to 1, is how fast the time of the plan shall pass; it is reached as soon
        as the limits allow, see :attr:`rate`.
        """
        self._plan()
        count = len(self._nodes)
        if count < 2:
            self._twist = STANDSTILL
            if count:
                self._pose = Pose(*self._nodes[0].tolist())
            return self._curve.pose(), STANDSTILL
        if self._place >= count - 1:
            self._twist = STANDSTILL
            self._pose = Pose(*self._nodes[-1].tolist())
            return self._pose, STANDSTILL
        sample = sample_curve(self._nodes, self._squares, self._place, self._elapsed, self._sample)
        self._pose = Pose(*sample[:3])
        planned = BodyTwist(*sample[3:])
        self.rate = self._reachable_rate(rate, planned)
        self._elapsed += self.rate * self._period
        self._place, self._elapsed = skip_intervals(self._squares, self._place, self._elapsed)
        self._twist = BodyTwist(self.rate * planned.linear, self.rate * planned.angular)
        return self._pose, self._twist

    def _reachable_rate(self, wanted: float, planned: BodyTwist) -> float:
        """Return the rate nearest to a wanted one that the limits allow after the last twist."""
        if wanted == self.rate:
            return wanted
        lowest, highest = 0.0, 1.0
        speeds, last_speeds = (
            (v, w, v + self._half * w, v - self._half * w) for v, w in (planned, self._twist)
        )
        for value, last, change in zip(speeds, last_speeds, self._changes, strict=True):
            if abs(value) > 1e-9:
                ends = (last - change) / value, (last + change) / value
                lowest, highest = max(lowest, min(ends)), min(highest, max(ends))
        # Rounding must not make the interval empty: the present rate is always possible.
        lowest, highest = min(lowest, self.rate), max(highest, self.rate)
        return min(max(wanted, lowest), highest)

    def advance_along(self, pieces: Iterator[Array], rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """As :meth:`advance`, with points from ``pieces`` as needed; the path ends with them."""
        while self.needs_points:
            points = next(pieces, None)
            if points is None:
                self.finish()
            else:
                self.add_points(points)
        return self.advance(rate)

    def _plan(self) -> None:
        """Renew the plan once enough of it is driven, or when the path has grown."""
        planned = len(self._squares) - 1
        short = planned < WINDOW and self._curve.ready
        if self._place < COMMIT and len(self._nodes) > 1 and not short and not self._renew:
            return
        # Further nodes would change the curve on which the robot comes to rest.
        if self._braking:
            return
        arrived = self._place >= len(self._nodes) - 1
        self._renew = False
        new = self._curve.take()
        drop = len(self._nodes) - 1 if arrived else self._place - 1
        drop = max(drop, 0)
        self._nodes = np.vstack([self._nodes[drop:], new])
        self._curve.forget(self._place + self._dropped)
        self._dropped += drop
        squares = self._squares[drop : self._place + 2]
        self._place -= drop
        if len(self._nodes) < 2:
            self._squares = squares  # rest, from which a path that grows later is planned
            return
        count = min(len(self._nodes), self._place + WINDOW + 1)
        plan = np.zeros(count)
        plan[: squares.size] = squares[:count]
        # The interval that is being driven is kept: its end is where the new plan begins.
        begin = min(self._place + 1, squares.size - 1) if squares.size > 1 else 0
        plan_speeds(self._nodes[:count], self._limits, begin, plan)
        self._squares = plan


def time_path(
    points: Array,
    limits: MotionLimits,
    geometry: WheelGeometry,
    period: float = 0.01,
    start: Pose | None = None,
) -> TimedPath:
    """Return a whole path, driven as fast as the limits allow from rest to rest.

    Points: m, shape (n, 2), at least two that differ; a closed path repeats its first point.
    """
    timing = PathTiming(limits, geometry, period, start)
    timing.add_points(points)
    timing.finish()
    rows = []
    while not timing.finished:
        pose, twist = timing.advance()
        rows.append((*pose, *twist))
    if not rows:
        raise PathError('the path must have two points at least 2 mm apart: got none')
    pose, twist = timing.advance()
    rows.append((*pose, *twist))
    columns: list[Array] = [np.array(column) for column in zip(*rows, strict=True)]
    return TimedPath(period * np.arange(len(rows), dtype=np.float64), *columns)


class _Mark(NamedTuple):
    """State of a :class:`_CurveBuilder` after a point."""

    nodes: int
    """Number of nodes up to there."""
    last: tuple[float, float]
    before: tuple[float, float, float]
    carried: float
    segment: float


class _CurveBuilder:
    """Turns points into the nodes of the pose curve, evenly spaced in u."""

    def __init__(self, start: Pose | None) -> None:
        self._last: tuple[float, float] | None = None
        """Last point kept."""
        self._before: tuple[float, float, float] | None = None
        """x, y, yaw up to which the curve is known."""
        self._nodes: list[tuple[float, float, float]] = []
        self._carried = 0.0
        """Length of u since the last node, m."""
        self._segment = 0.0
        """Rest of the last segment, from ``_before`` to ``_last``, m."""
        self._taken = 0
        self._marks: deque[_Mark] = deque()
        """States after points, to go back to."""
        if start is not None:
            self._last = start.x, start.y
            self._before = start.x, start.y, start.yaw
            self._nodes.append(self._before)

    @property
    def ready(self) -> int:
        """Number of nodes not taken."""
        return len(self._nodes)

    @property
    def first(self) -> Pose | None:
        """The first node that is not taken."""
        return Pose(*self._nodes[0]) if self._nodes else None

    def pose(self) -> Pose:
        """Return the last pose known, the origin without one."""
        return Pose(*(self._before or (0.0, 0.0, 0.0)))

    def take(self) -> Array:
        """Return the new nodes, shape (n, 3), and forget them."""
        nodes = np.array(self._nodes).reshape(-1, 3)
        self._taken += len(self._nodes)
        self._nodes.clear()
        return nodes

    def rewind(self, count: int) -> int:
        """Go back to the first point with ``count`` nodes; return how many there are then.

        All nodes are taken before. Without such a point nothing changes.
        """
        for index, mark in enumerate(self._marks):
            if mark.nodes >= count:
                while len(self._marks) > index + 1:
                    self._marks.pop()
                self._taken, self._last, self._before, self._carried, self._segment = mark
                break
        return self._taken

    def forget(self, count: int) -> None:
        """Forget the points with less than ``count`` nodes, but for what :meth:`end` needs."""
        while len(self._marks) > 3 and self._marks[3].nodes < count:
            self._marks.popleft()

    def end(self) -> PathEnd:
        """Return where the next point continues the curve."""
        assert self._last is not None
        assert self._before is not None
        yaw, bend = self._before[2], 0.0
        if self._segment > 0.0:
            yaw = math.atan2(self._last[1] - self._before[1], self._last[0] - self._before[0])
            points = [mark.last for mark in list(self._marks)[-3:]]
            if len(points) == 3 and points[-1] == self._last:
                (x0, y0), (x1, y1), (x2, y2) = points
                turn = math.atan2(
                    (x1 - x0) * (y2 - y1) - (y1 - y0) * (x2 - x1),
                    (x1 - x0) * (x2 - x1) + (y1 - y0) * (y2 - y1),
                )
                one, other = math.hypot(x1 - x0, y1 - y0), math.hypot(x2 - x1, y2 - y1)
                bend = 2.0 * turn / (one + other)
                yaw += 0.5 * bend * other
        return PathEnd(Pose(*self._last, yaw), bend, moving=self._segment > 0.0)

    def add(self, x: float, y: float) -> None:
        """Append a point: the curve then is known up to shortly before it."""
        if self._last is None:
            self._last = x, y
            return
        run_x, run_y = x - self._last[0], y - self._last[1]
        length = math.hypot(run_x, run_y)
        if length < RESOLUTION:
            return
        direction = math.atan2(run_y, run_x)
        if self._before is None:
            self._before = *self._last, direction
            self._nodes.append(self._before)
        self._turn_to(direction, run_x / length, run_y / length, length)
        self._last = x, y
        nodes = self._taken + len(self._nodes)
        self._marks.append(_Mark(nodes, self._last, self._before, self._carried, self._segment))

    def run_to_last(self) -> None:
        """Make the curve known up to the last point."""
        if self._before is not None and self._last is not None:
            self._run_to(*self._last, self._before[2])
            self._segment = 0.0
            if self._carried > 1e-9:
                self._nodes.append(self._before)
                self._carried = 0.0

    def _turn_to(self, direction: float, ahead_x: float, ahead_y: float, length: float) -> None:
        """Go to the last point, turn there, and go to the middle or to the end of the rounding."""
        assert self._last is not None
        assert self._before is not None
        yaw = self._before[2]
        turn = math.remainder(direction - yaw, math.tau)
        half = 0.5 * min(length, 2.0 * ROUNDING)
        if abs(turn) >= CORNER or self._segment == 0.0:
            self._run_to(*self._last, yaw)
            self._run_to(*self._last, yaw + turn)
        else:
            back = min(self._segment, ROUNDING)
            x, y, _ = self._before
            share = 1.0 - back / self._segment
            self._run_to(x + share * (self._last[0] - x), y + share * (self._last[1] - y), yaw)
            middle = yaw + turn * back / (back + half)
            self._run_to(*self._last, middle)
            self._run_to(
                self._last[0] + half * ahead_x, self._last[1] + half * ahead_y, yaw + turn
            )
            self._segment = length - half
            return
        self._segment = length

    def _run_to(self, x: float, y: float, yaw: float) -> None:
        """Append the nodes of a straight piece of the curve."""
        assert self._before is not None
        x0, y0, yaw0 = self._before
        span = math.hypot(x - x0, y - y0) + TURN_LENGTH * abs(yaw - yaw0)
        if span > 0.0:
            at = STEP - self._carried
            while at <= span:
                share = at / span
                self._nodes.append(
                    (x0 + share * (x - x0), y0 + share * (y - y0), yaw0 + share * (yaw - yaw0))
                )
                at += STEP
            self._carried = span - (at - STEP)
        self._before = x, y, yaw


@kernel
def interval_rates(nodes: Array, k: int) -> tuple[float, float]:
    """Return g and c of the interval after node ``k``; beyond an end those of the last one."""
    k = min(max(k, 0), nodes.shape[0] - 2)
    yaw = 0.5 * (nodes[k, 2] + nodes[k + 1, 2])
    run_x, run_y = nodes[k + 1, 0] - nodes[k, 0], nodes[k + 1, 1] - nodes[k, 1]
    ahead = (run_x * math.cos(yaw) + run_y * math.sin(yaw)) / STEP
    return ahead, (nodes[k + 1, 2] - nodes[k, 2]) / STEP


@kernel
def acceleration_range(nodes: Array, limits: CurveLimits, k: int, b: float) -> tuple[float, float]:
    """Return the bounds of a from node ``k`` to the next with every acceleration in its limits.

    g and c change linearly from the middle of an interval to that of the next one, so that the
    accelerations are linear in u in each half: they are extreme at its two ends.
    """
    g0, c0 = interval_rates(nodes, k - 1)
    g1, c1 = interval_rates(nodes, k)
    g2, c2 = interval_rates(nodes, k + 1)
    lowest, highest = -math.inf, math.inf
    for row in range(4):
        if row == 0:
            before, now, after, limit = g0, g1, g2, limits.linear_acceleration
        elif row == 1:
            before, now, after, limit = c0, c1, c2, limits.angular_acceleration
        else:
            half = limits.half_separation if row == 2 else -limits.half_separation
            before, now, after = g0 + half * c0, g1 + half * c1, g2 + half * c2
            limit = limits.wheel_acceleration * limits.radius
        for end in range(4):
            slope = ((now - before) if end < 2 else (after - now)) / STEP
            rate = now
            if end == 0:
                rate = 0.5 * (before + now)
            elif end == 3:
                rate = 0.5 * (now + after)
            # b grows by 2 a for each metre of u.
            passed = 0.0 if end == 0 else (2.0 * STEP if end == 3 else STEP)
            factor, fixed = rate + slope * passed, slope * b
            if abs(factor) < 1e-9:
                if abs(fixed) > limit:
                    return 1.0, -1.0
                continue
            one, other = (-limit - fixed) / factor, (limit - fixed) / factor
            lowest, highest = max(lowest, min(one, other)), min(highest, max(one, other))
    return lowest, highest


@kernel
def step_range(
    nodes: Array, limits: CurveLimits, k: int, b: float, ceiling: float
) -> tuple[float, float]:
    """Return the bounds of a from node ``k`` to the next, where b must be from 0 to ``ceiling``.

    The lower bound is above the upper one if there is none.
    """
    lowest, highest = acceleration_range(nodes, limits, k, b)
    return max(lowest, -b / (2.0 * STEP)), min(highest, (ceiling - b) / (2.0 * STEP))


@kernel
def speed_ceiling(nodes: Array, limits: CurveLimits, k: int) -> float:
    """Return the largest b at node ``k`` by the speed limits."""
    least = math.inf
    for side in range(2):
        g, c = interval_rates(nodes, k - 1 + side)
        rates = max(abs(g) / limits.linear, abs(c) / limits.angular)
        wheel = (abs(g) + limits.half_separation * abs(c)) / limits.radius
        rates = max(rates, wheel / limits.wheel_speed)
        if rates > 0.0:
            least = min(least, 1.0 / (rates * rates))
    return least


@kernel
def plan_speeds(nodes: Array, limits: CurveLimits, begin: int, squares: Array) -> None:
    """Write the largest b at each node after ``begin``, with a stop at the last node.

    nodes   : x, y, yaw, shape (n, 3)
    squares : b, shape (n,); up to ``begin`` given, then overwritten
    """
    last = nodes.shape[0] - 1
    ceilings = squares  # the backward pass writes K, the forward pass reads it
    start = squares[begin]
    ceilings[last] = 0.0
    for k in range(last - 1, begin, -1):
        low, high = 0.0, speed_ceiling(nodes, limits, k)
        # The set of (a, b) is convex and holds (0, 0), so its values of b are an interval from 0.
        for halvings in range(26):
            middle = high if halvings == 0 else 0.5 * (low + high)
            lowest, highest = step_range(nodes, limits, k, middle, ceilings[k + 1])
            if lowest <= highest:
                low = middle
                if middle == high:
                    break
            else:
                high = middle
        ceilings[k] = low
    squares[begin] = start
    for k in range(begin, last):
        b = squares[k]
        lowest, highest = step_range(nodes, limits, k, b, ceilings[k + 1])
        a = max(highest, lowest)
        squares[k + 1] = min(max(b + 2.0 * STEP * a, 0.0), ceilings[k + 1])
    squares[last] = 0.0


@kernel
def stopping_node(nodes: Array, limits: CurveLimits, begin: int, squares: Array) -> int:
    """Return the first node at which a motion can rest that is planned up to ``begin``.

    squares : b of a plan, which every slower motion may follow
    """
    last = squares.size - 1
    b = squares[min(begin, last)]
    for k in range(begin, last):
        if b < 1e-9:
            return k
        lowest, highest = step_range(nodes, limits, k, b, squares[k + 1])
        b = min(max(b + 2.0 * STEP * min(lowest, highest), 0.0), squares[k + 1])
    return last


@kernel
def interval_time(squares: Array, k: int) -> float:
    """Return the time from node ``k`` to the next, s."""
    speeds = math.sqrt(squares[k]) + math.sqrt(squares[k + 1])
    return 2.0 * STEP / max(speeds, CREEP)


@kernel
def skip_intervals(squares: Array, place: int, elapsed: float) -> tuple[int, float]:
    """Return the interval in which a time after the beginning of ``place`` lies, and the rest."""
    while place < squares.size - 1:
        needed = interval_time(squares, place)
        if elapsed < needed:
            break
        elapsed -= needed
        place += 1
    return place, elapsed


@kernel
def sample_curve(
    nodes: Array, squares: Array, place: int, elapsed: float, place_at: Array
) -> tuple[float, float, float, float, float]:
    """Return x, y, yaw, v and omega at a time after node ``place``.

    The nodes are control points of a uniform quadratic B-spline, whose rates are continuous.

    place_at : shape (3,), overwritten with x, y, yaw
    """
    duration = interval_time(squares, place)
    begin, end = math.sqrt(squares[place]), math.sqrt(squares[place + 1])
    share = elapsed / duration
    if begin + end < CREEP:
        speed = 6.0 * share * (1.0 - share) * STEP / duration
        along = share * share * (3.0 - 2.0 * share)
    else:
        speed = begin + share * (end - begin)
        along = min(max((begin + 0.5 * share * (end - begin)) * elapsed / STEP, 0.0), 1.0)
    middle = place if along < 0.5 else place + 1
    offset = along if along < 0.5 else along - 1.0
    weights = (
        0.5 * (0.5 - offset) * (0.5 - offset),
        0.75 - offset * offset,
        0.5 * (0.5 + offset) * (0.5 + offset),
    )
    last = nodes.shape[0] - 1
    for column in range(3):
        here = nodes[middle, column]
        # Beyond an end the control points go on in a straight line, so that it is reached.
        after = nodes[min(middle + 1, last), column]
        before = nodes[max(middle - 1, 0), column]
        if middle == 0:
            before = 2.0 * here - after
        elif middle == last:
            after = 2.0 * here - before
        place_at[column] = weights[0] * before + weights[1] * here + weights[2] * after
    g0, c0 = interval_rates(nodes, middle - 1)
    g1, c1 = interval_rates(nodes, middle)
    g = (0.5 - offset) * g0 + (0.5 + offset) * g1
    c = (0.5 - offset) * c0 + (0.5 + offset) * c1
    return place_at[0], place_at[1], place_at[2], g * speed, c * speed
