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
"""Sources of a reference with a pose: the chaotic path, a given path, and commanded twists."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import itertools
import math
from typing import Protocol

import numpy as np

from t3mpc_ros.chaos.chaotic_path import PortraitParameters, PortraitPath
from t3mpc_ros.chaos.path_replanning import PlannedPath, PlanParameters
from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose
from t3mpc_ros.geometry.path_smoothing import LEAST_TOLERANCE, SmoothedPath
from t3mpc_ros.geometry.path_timing import MotionLimits, PathEnd, PathTiming
from t3mpc_ros.geometry.polyline import check_points
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, Array, BodyTwist, Pose
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter

APPROACH = 0.02
"""Distance from which on a robot has come nearer or set off, m: above the noise of a pose."""
MAX_REFERENCES = 4096
"""Samples of the reference that are kept until the robot has reported where it was."""


@dataclass(frozen=True)
class ReseedParameters(Parameters):
    """Times at which a chaotic path gets another seed."""

    shortest: float = parameter(
        0.0, 'shortest time between two seeds, drawn evenly; 0: the seed is kept', 's', (0.0, 1e6)
    )
    longest: float = parameter(0.0, 'longest time between two seeds', 's', (0.0, 1e6))

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` unless the times ascend."""
        if self.longest < self.shortest:
            raise ParameterError(
                f'reseed.longest must be at least reseed.shortest, {self.shortest:g} s: '
                f'got {self.longest:g}'
            )


@dataclass(frozen=True)
class WaitParameters(Parameters):
    """Where and how long a path waits for the robot."""

    distance: float = parameter(
        0.05,
        'distance of the robot from its reference from which on the path goes more slowly; it '
        'waits from twice the distance on. A chaotic path does so only until the robot sets off. '
        '0: it never waits',
        'm',
        (0.0, 10.0),
    )
    patience: float = parameter(
        3.0,
        'time for which the path waits for a robot on its way that comes no nearer; it then goes '
        'on for as long, so that it leaves an obstacle that it leads through',
        's',
        (0.1, 1e6),
    )


@dataclass(frozen=True)
class SmoothingParameters(Parameters):
    """Smoothing of a given path."""

    tolerance: float = parameter(
        0.02,
        'sources file and topic: how far from the given path the reference may be where that '
        'saves time, because its points lie on a grid or have noise; 0: the path is driven as '
        'given, its corners rounded within 2 mm',
        'm',
        (0.0, 1.0),
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for a tolerance below that of the smoothing."""
        if 0.0 < self.tolerance < LEAST_TOLERANCE:
            raise ParameterError(
                f'path.tolerance must be 0 or at least {LEAST_TOLERANCE:g} m: '
                f'got {self.tolerance:g}'
            )


@dataclass(frozen=True)
class PathReferenceParameters(ReferenceParameters):
    """Source of the reference, and the limits of a motion along a path."""

    source: str = parameter(
        'signals',
        'signals: two chaotic signals are the speeds of the wheels, as in the paper; portrait: a '
        'chaotic path in an arena; file: the path of path_file; topic: each nav_msgs/Path on '
        'path; twist: the twists on target_twist. All but signals begin at the pose of the first '
        'odom message and need pose.enabled of the controller',
        choices=('signals', 'portrait', 'file', 'topic', 'twist'),
    )
    path_file: str = parameter('', 'path of source file: .csv or .yaml, m')
    repeat: bool = parameter(False, 'source file: drive the path again and again')
    path_mode: str = parameter(
        'replace',
        'source topic: replace: a path is joined where it is nearest, and replaces the one that '
        'is under way; append: it is driven after those before. An empty path stops the robot',
        choices=('replace', 'append'),
    )
    twist_timeout: float = parameter(
        0.5,
        'source twist: age at which a twist expires, and the reference stops',
        's',
        (0.05, 10.0),
    )
    path: SmoothingParameters = group(SmoothingParameters)
    portrait: PortraitParameters = group(PortraitParameters)
    plan: PlanParameters = group(PlanParameters)
    reseed: ReseedParameters = group(ReseedParameters)
    wait: WaitParameters = group(WaitParameters)
    motion: MotionLimits = group(MotionLimits)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` if source and file contradict."""
        super().check_consistency()
        if (self.source == 'file') != bool(self.path_file):
            raise ParameterError(
                'path_file must name a file with source file, and only then: '
                f'got source {self.source} with path_file {self.path_file!r}'
            )
        if self.plan.enabled and self.source != 'portrait':
            raise ParameterError(f'plan.enabled needs source portrait: got {self.source}')


class PathClock:
    """Rate at which the time of a path passes: less than 1 while the robot is away from it.

    A path waits for a robot that has not set off, whose controller starts later, say, or that
    looks around or makes a detour. It does not know what holds the robot up, and so does not
    wait forever: where it leads through an obstacle, no robot can follow. ``on_the_way``: it
    also waits for a robot that has set off.
    """

    def __init__(self, parameters: WaitParameters, *, on_the_way: bool = True) -> None:
        self._parameters, self._on_the_way = parameters, on_the_way
        self._references: deque[tuple[int, Pose]] = deque(maxlen=MAX_REFERENCES)
        self._start: Pose | None = None
        """First pose of the robot."""
        self._set_off = False
        self._stamp_ns = 0
        """Stamp of the last pose of the robot."""
        self._nearest = math.inf
        self._held = 0.0
        """Time without approach, s; negative while the path goes on regardless."""
        self.rate = 1.0
        """Rate, from 0 (wait) to 1, for :meth:`PathSource.advance`."""

    def add_reference(self, stamp_ns: int, pose: Pose) -> None:
        """Store a sample of the reference; samples with later stamps are removed."""
        references = self._references
        while references and references[-1][0] >= stamp_ns:
            references.pop()
        references.append((stamp_ns, pose))

    def observe(self, stamp_ns: int, pose: Pose) -> None:
        """Update :attr:`rate` with the pose of the robot at a stamp."""
        references = self._references
        while len(references) > 1 and references[1][0] <= stamp_ns:
            references.popleft()
        if not references:
            return
        if self._start is None:
            self._start, self._stamp_ns = pose, stamp_ns
        self._set_off = self._set_off or math.dist(self._start[:2], pose[:2]) > APPROACH
        elapsed, self._stamp_ns = (stamp_ns - self._stamp_ns) / NANOSECONDS, stamp_ns
        self.rate = self._rate(math.dist(references[0][1][:2], pose[:2]), max(elapsed, 0.0))

    def _rate(self, distance: float, elapsed: float) -> float:
        begin = self._parameters.distance
        if distance <= begin or begin == 0.0 or (self._set_off and not self._on_the_way):
            self._nearest, self._held = math.inf, 0.0
            return 1.0
        if self._set_off:
            self._held += elapsed
        if self._held < 0.0:
            self._nearest = distance
            return 1.0
        if distance < self._nearest - APPROACH:
            self._nearest, self._held = distance, 0.0
        if self._held >= self._parameters.patience:
            self._held = -self._parameters.patience
        return max(2.0 - distance / begin, 0.0)


class PauseRamp:
    """Scales a twist down to rest, and up again, within limits of acceleration."""

    def __init__(self, limits: MotionLimits, geometry: WheelGeometry, period: float) -> None:
        self._changes = (
            limits.linear_acceleration * period,
            limits.angular_acceleration * period,
            limits.wheel_acceleration * geometry.wheel_radius * period,
        )
        self._half = geometry.half_separation
        self.share = 1.0
        """Share of the twist, from 0 at rest to 1."""

    def step(self, twist: BodyTwist, *, paused: bool) -> BodyTwist:
        """Return the twist of the next period; while the share is below 1, ``twist`` must stay."""
        linear, angular = map(abs, twist)
        speeds = linear, angular, linear + self._half * angular
        change = min(
            limit / max(speed, 1e-12) for limit, speed in zip(self._changes, speeds, strict=True)
        )
        self.share = max(self.share - change, 0.0) if paused else min(self.share + change, 1.0)
        return BodyTwist(self.share * twist.linear, self.share * twist.angular)


class PathSource(Protocol):
    """Source of one sample of the reference in each period."""

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""


class PortraitSource:
    """The chaotic path of a seed, and of others after random times.

    The first seed also determines the times of the next ones, which ``next_seed`` returns.
    """

    def __init__(
        self,
        parameters: PathReferenceParameters,
        geometry: WheelGeometry,
        start: Pose,
        seed: int,
        next_seed: Callable[[], int],
    ) -> None:
        self._reseed, self._next_seed = parameters.reseed, next_seed
        self._path = PortraitPath(parameters, parameters.portrait, parameters.motion.linear, seed)
        self._period = 1.0 / parameters.rate
        self._timing = PathTiming(parameters.motion, geometry, self._period, start)
        self.planned: PlannedPath | None = None
        """The path on the map; None: it does not know the map."""
        if parameters.plan.enabled:
            self.planned = PlannedPath(
                parameters.plan,
                self._timing,
                self._period,
                start,
                self._path.advance,
                self._path.arena,
            )
        self._draw(seed)

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""
        # In the time of the path: where a seed ends does not depend on the robot.
        self._left -= self._timing.rate * self._period
        if self._left <= 0.0:
            self.reseed(self._next_seed())
        if self.planned is not None:
            return self.planned.advance(rate)
        while self._timing.needs_points:
            self._timing.add_points(self._path.advance(1.0))
        return self._timing.advance(rate)

    def reseed(self, seed: int) -> None:
        """Continue with another seed, from where the path planned so far ends."""
        self._path.reseed(seed)
        self._draw(seed)

    def _draw(self, seed: int) -> None:
        """Draw from a seed what is not in the path itself."""
        self._times = SecretRandom(seed, 'reseed')
        self._left = self._draw_time()
        if self.planned is not None:
            self.planned.plan.use_random_numbers(SecretRandom(seed, 'revisits'))

    def _draw_time(self) -> float:
        """Return the time until the next seed, s."""
        reseed = self._reseed
        if reseed.longest <= 0.0:
            return math.inf
        share = float(self._times.uniform(1)[0])
        return reseed.shortest + share * (reseed.longest - reseed.shortest)


class GivenPathSource:
    """Paths that arrive now and then, one after the other or each in place of the one before.

    Each is smoothed within the tolerance of the parameters. The robot rests at the end of the
    last one. First path: points, m, shape (n, 2); with ``repeat`` it is driven again and again.
    """

    def __init__(
        self,
        parameters: PathReferenceParameters,
        geometry: WheelGeometry,
        start: Pose,
        points: Array | None = None,
        repeat: bool = False,
    ) -> None:
        self._parameters, self._geometry = parameters, geometry
        self._timing = PathTiming(parameters.motion, geometry, 1.0 / parameters.rate, start)
        self._paths: deque[Iterator[Array]] = deque()
        """Rest of the path that is driven, and further ones."""
        self._newest: Array | None = None
        """Points of the last path."""
        self._canceled = False
        if points is not None and len(points):
            self._begin(points, PathEnd(start), repeat)

    @property
    def under_way(self) -> bool:
        """Whether the reference has not reached the end of the last path."""
        return bool(self._paths) or not self._timing.arrived

    def append(self, points: Array) -> None:
        """Drive a path (m, shape (n, 2)) after those that are known."""
        check_points(points)
        if self.under_way and not self._canceled and len(points):
            self._newest = points
            self._paths.append(self._smoothed(points).pieces())
        else:
            self._newest = None
            self.replace(points)

    def replace(self, points: Array) -> None:
        """Drive another path (m, shape (n, 2)) from now on, without a jump of the speed.

        A path that is under way is left where the robot could stop, and the new one is joined
        where it is nearest; from rest it is begun at its first point. The same path again changes
        nothing.
        """
        check_points(points)
        if not len(points):
            self.cancel()
        elif self._newest is None or not np.array_equal(points, self._newest):
            under_way = self.under_way and not self._canceled
            self._paths.clear()
            self._canceled = False
            self._begin(points, self._timing.cut(), under_way=under_way)

    def cancel(self) -> None:
        """Stop as soon as the limits allow, and forget every path."""
        self._canceled = self.under_way
        self._newest = None

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""
        if self._canceled and self._timing.standing:
            self._paths.clear()
            self._timing.cut()
            self._canceled = False
        while self._paths and self._timing.needs_points:
            piece = next(self._paths[0], None)
            if piece is not None:
                self._timing.add_points(piece)
            else:
                self._paths.popleft()
                self._timing.drive_to_last_point()
        return self._timing.advance(0.0 if self._canceled else rate)

    def _smoothed(self, points: Array, *, closed: bool = False) -> SmoothedPath:
        parameters = self._parameters
        tolerance = parameters.path.tolerance
        return SmoothedPath(points, tolerance, parameters.motion, self._geometry, closed=closed)

    def _begin(
        self, points: Array, end: PathEnd, repeat: bool = False, *, under_way: bool = False
    ) -> None:
        """Drive a path from where the reference can leave what it drives."""
        self._newest = points
        tolerance = self._parameters.path.tolerance
        closed = repeat and math.hypot(*(points[-1] - points[0])) < LEAST_TOLERANCE
        path = self._smoothed(points, closed=closed)
        along, distance = path.nearest(end)
        first = math.hypot(*(points[0] - end.pose[:2]))
        if not tolerance or not (under_way or first <= tolerance):
            pieces = path.pieces(along if under_way else 0.0)
        elif path.length - along < LEAST_TOLERANCE and distance <= tolerance and not end.moving:
            return  # the reference rests at its end
        else:
            pieces = path.joined_pieces(end, along)
        self._paths.append(pieces)
        if repeat and path.length > LEAST_TOLERANCE:
            again = (path.pieces() for _ in itertools.repeat(None))
            self._paths[-1] = itertools.chain(pieces, itertools.chain.from_iterable(again))


class TwistSource:
    """Commanded twists as a reference within the limits, with the pose that they lead to."""

    def __init__(self, parameters: PathReferenceParameters, start: Pose) -> None:
        self._limits = parameters.motion
        self._period = 1.0 / parameters.rate
        self._timeout = parameters.twist_timeout
        self._pose, self._twist = start, STANDSTILL
        self._target, self._age = STANDSTILL, math.inf

    def set_target(self, twist: BodyTwist) -> bool:
        """Follow a twist from now on; return False, and stop, when it is not finite."""
        finite = all(map(math.isfinite, twist))
        self._target, self._age = (twist, 0.0) if finite else (STANDSTILL, math.inf)
        return finite

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""
        limits, period = self._limits, self._period
        self._age += period
        target = self._target if self._age <= self._timeout else STANDSTILL
        scale = rate * min(
            1.0,
            limits.linear / max(abs(target.linear), 1e-12),
            limits.angular / max(abs(target.angular), 1e-12),
        )
        gaps = (
            scale * target.linear - self._twist.linear,
            scale * target.angular - self._twist.angular,
        )
        # One factor for both: the robot keeps to the curve while it speeds up or slows down.
        part = min(
            1.0,
            limits.linear_acceleration * period / max(abs(gaps[0]), 1e-12),
            limits.angular_acceleration * period / max(abs(gaps[1]), 1e-12),
        )
        result = self._pose, self._twist
        self._twist = BodyTwist(
            self._twist.linear + part * gaps[0], self._twist.angular + part * gaps[1]
        )
        self._pose = advance_pose(self._pose, self._twist, period)
        return result
